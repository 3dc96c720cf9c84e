"""Encounters of careful drivers: other agents in the frame of the driver's own route."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from ssad.core.driving import Belief, Observation
from ssad.core.geometry import to_local
from ssad.core.types import F64, AgentKind, Bool
from ssad.core.visibility import is_visible
from ssad.drivers.careful.encounter import Encounter

BEHIND, BEYOND = 20.0, 80.0  # m of straight extension before the first and after the last point of the route
ALONG = np.deg2rad(30.0)  # an agent that moves at less than this angle to the path is assumed to stay on it


class Path:
    """Next metres of N routes, each in the frame of its driver, as a chain of segments."""

    def __init__(self, route: npt.NDArray[np.floating], beyond: float | F64 = BEYOND) -> None:
        """Take the route [N, R, 2] as `Observation.route` has it; repeated points at its end are left out.

        Args:
            route: Routes of N drivers, m.
            beyond: Straight extension after the last point, m, of all or of each [N].
        """
        points = np.asarray(route, np.float64)
        steps = np.diff(points, axis=1)
        lengths = np.hypot(steps[..., 0], steps[..., 1])
        is_segment = lengths > 1e-3
        first_direction = _unit_vectors(np.where(is_segment[:, :1, None], steps[:, :1], [1.0, 0.0]))
        # past the end the last point is repeated: its direction is that of the last step that moves
        last_segment = np.maximum.accumulate(np.where(is_segment, np.arange(is_segment.shape[1]), 0), axis=1)
        directions = np.take_along_axis(
            np.where(is_segment[..., None], _unit_vectors(steps), first_direction), last_segment[..., None], 1
        )
        extended_start = points[:, :1] - BEHIND * first_direction
        self.a = np.concatenate([extended_start, points], 1)
        self.t = np.concatenate([first_direction, directions, directions[:, -1:]], 1)
        extension = np.broadcast_to(np.asarray(beyond, np.float64), len(points))[:, None]
        self.size = np.concatenate([np.full((len(points), 1), BEHIND), lengths, extension], 1)
        self.s = np.concatenate([np.zeros((len(points), 1)), np.cumsum(self.size[:, :-1], 1)], 1)

    def project(self, points: F64) -> tuple[F64, F64, F64]:
        """Return the nearest point on the chain.

        Args:
            points: [N, K, 2], m.

        Returns:
            m along the chain, m left of it, and its heading there, rad; [N, K] each.
        """
        offsets = points[:, :, None] - self.a[:, None]  # [N, K, S, 2]
        projections = np.clip((offsets * self.t[:, None]).sum(-1), 0.0, self.size[:, None])
        residuals = offsets - projections[..., None] * self.t[:, None]
        nearest = np.argmin((residuals * residuals).sum(-1), axis=-1)[..., None]
        gather = np.take_along_axis
        rows = np.arange(len(points))[:, None]
        direction = self.t[rows, nearest[..., 0]]
        residual = gather(residuals, nearest[..., None], 2)[..., 0, :]
        left = direction[..., 0] * residual[..., 1] - direction[..., 1] * residual[..., 0]
        return (
            self.s[rows, nearest[..., 0]] + gather(projections, nearest, 2)[..., 0],
            left,
            np.arctan2(direction[..., 1], direction[..., 0]),
        )

    def at(self, s: F64, left: F64) -> F64:
        """Return the points [N, 2] at `s` [N] m along the chains and `left` [N] m to their left."""
        segment = np.maximum((self.s <= s[:, None]).sum(1) - 1, 0)
        rows = np.arange(len(s))
        direction = self.t[rows, segment]
        normal = np.stack([-direction[:, 1], direction[:, 0]], 1)
        point: F64 = self.a[rows, segment] + (s - self.s[rows, segment])[:, None] * direction + left[:, None] * normal
        return point

    def heading(self, s: F64) -> F64:
        """Return the headings of the chains [N], rad, at `s` [N] m along them."""
        segment = np.maximum((self.s <= s[:, None]).sum(1) - 1, 0)
        direction = self.t[np.arange(len(s)), segment]
        return np.asarray(np.arctan2(direction[:, 1], direction[:, 0]))


def encounters(
    view: Observation, path: Path, *, half: F64, reach: float | F64, moved: F64, dt: float
) -> tuple[Encounter, Bool, F64]:
    """Return all agents in line of sight as encounters of careful models.

    An agent that moves along the path within 30 degrees is assumed to stay on it (in either direction); other agents
    cross it in a straight line at their speed.

    Args:
        view: Observation of N drivers, with the sensor `truth`.
        path: Their paths.
        half: [N, 2] half length and width of their bodies, m.
        reach: Visual range, m, of all or of each [N].
        moved: [N, K] lateral travel of each agent towards the path so far, m.
        dt: Time since then, s.

    Returns:
        The encounters [N, K], the visibility of the agents, and the updated `moved`.
    """
    belief: Belief = view.readings["truth"]
    visible = is_visible(view.pose[:, :2], belief, reach) & (belief.kind != AgentKind.NONE)
    encounter = encounters_on_paths(
        path,
        half_extent=half,
        places=np.asarray(to_local(view.pose[:, None], belief.pose[..., :2]), np.float64),
        yaw=np.asarray(belief.pose[..., 2] - view.pose[:, None, 2], np.float64),
        speed=np.asarray(belief.speed),
        size=np.asarray(belief.size),
        own_speed=np.asarray(view.speed),
        own_accel=np.asarray(view.accel),
    )
    is_approaching = visible & (encounter.approach > 0.05)
    lateral_travel = np.where(is_approaching, moved + np.maximum(encounter.approach, 0.0) * dt, 0.0)
    return replace(encounter, moved=lateral_travel), visible, lateral_travel


def encounters_on_paths(
    path: Path,
    *,
    half_extent: F64,
    places: F64,
    yaw: F64,
    speed: npt.NDArray[np.floating],
    size: npt.NDArray[np.floating],
    own_speed: npt.NDArray[np.floating],
    own_accel: npt.NDArray[np.floating],
) -> Encounter:
    """Return other agents in the frame of drivers' paths, [N, K], with no lateral travel yet.

    Args:
        path: The paths of N drivers.
        half_extent: [N, 2] half length and width of their bodies, m.
        places: [N, K, 2] positions of the agents in the drivers' frames, m.
        yaw: [N, K] their headings, rad.
        speed: [N, K] m/s.
        size: [N, K, 2] length and width of their bodies, m.
        own_speed: [N] speed of the drivers, m/s.
        own_accel: [N] acceleration of the drivers, m/s^2.
    """
    ego_position, _, _ = path.project(np.zeros((len(places), 1, 2)))
    position, left, heading = path.project(places)
    relative_yaw = yaw - heading
    speeds: F64 = np.asarray(speed, np.float64)
    along_speed, lateral_speed = speeds * np.cos(relative_yaw), speeds * np.sin(relative_yaw)
    cosine, sine = np.abs(np.cos(relative_yaw)), np.abs(np.sin(relative_yaw))
    half_size = np.asarray(size, np.float64) / 2.0
    half_length, half_width = (
        half_size[..., 0] * cosine + half_size[..., 1] * sine,
        half_size[..., 0] * sine + half_size[..., 1] * cosine,
    )
    clearance = half_extent[:, 1:] + half_width
    lateral = np.abs(left) - clearance
    in_path = lateral <= 0.0
    approach = np.where(in_path, np.abs(lateral_speed), -np.sign(left) * lateral_speed)
    stays_on_path = (cosine > np.cos(ALONG)) | (np.abs(lateral_speed) < 0.1)
    through = np.where(stays_on_path, np.inf, clearance - left * np.sign(lateral_speed))
    return Encounter(
        speed=np.broadcast_to(np.asarray(own_speed, np.float64)[:, None], position.shape),
        accel=np.broadcast_to(np.asarray(own_accel, np.float64)[:, None], position.shape),
        gap=position - ego_position - half_extent[:, :1] - half_length,
        lead=along_speed,
        lateral=lateral,
        approach=approach,
        through=np.maximum(through, 0.0),
        length=2.0 * (half_extent[:, :1] + half_length),
        moved=np.zeros(position.shape),
    )


def _unit_vectors(vectors: F64) -> F64:
    return np.asarray(vectors / np.maximum(np.hypot(vectors[..., :1], vectors[..., 1:]), 1e-9))
