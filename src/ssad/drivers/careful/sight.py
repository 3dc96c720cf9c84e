"""From what a driver sees to the encounters that careful models judge: others in the frame of its own route."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from ssad.core.driving import Belief, Observation
from ssad.core.geometry import to_local
from ssad.core.types import F64, AgentKind, Bool
from ssad.drivers.belief import in_sight
from ssad.drivers.careful.encounter import Encounter

BEHIND, BEYOND = 20.0, 80.0  # m that the route is taken to go straight on before its first and after its last point
ALONG = np.deg2rad(30.0)  # who moves at less than this angle to the path is taken to stay on it


class Path:
    """The next metres of N routes, each in its driver's frame, as a chain of segments."""

    def __init__(self, route: npt.NDArray[np.floating]) -> None:
        """Take the route [N, R, 2] as `Observation.route` has it; repeated points at its end are left out."""
        points = np.asarray(route, np.float64)
        step = np.diff(points, axis=1)
        size = np.hypot(step[..., 0], step[..., 1])
        moves = size > 1e-3
        first = _unit(np.where(moves[:, :1, None], step[:, :1], [1.0, 0.0]))
        # past the end the last point is repeated: its direction is that of the last step that moves
        latest = np.maximum.accumulate(np.where(moves, np.arange(moves.shape[1]), 0), axis=1)
        heading = np.take_along_axis(np.where(moves[..., None], _unit(step), first), latest[..., None], 1)
        start = points[:, :1] - BEHIND * first
        self.a = np.concatenate([start, points], 1)
        self.t = np.concatenate([first, heading, heading[:, -1:]], 1)
        self.size = np.concatenate([np.full((len(points), 1), BEHIND), size, np.full((len(points), 1), BEYOND)], 1)
        self.s = np.concatenate([np.zeros((len(points), 1)), np.cumsum(self.size[:, :-1], 1)], 1)

    def project(self, xy: F64) -> tuple[F64, F64, F64]:
        """The nearest place on the chain.

        Args:
            xy: [N, K, 2], m.

        Returns:
            m along the chain, m left of it, and its heading there, rad; [N, K] each.
        """
        away = xy[:, :, None] - self.a[:, None]  # [N, K, S, 2]
        along = np.clip((away * self.t[:, None]).sum(-1), 0.0, self.size[:, None])
        off = away - along[..., None] * self.t[:, None]
        best = np.argmin((off * off).sum(-1), axis=-1)[..., None]
        pick = np.take_along_axis
        row = np.arange(len(xy))[:, None]
        t = self.t[row, best[..., 0]]
        rest = pick(off, best[..., None], 2)[..., 0, :]
        left = t[..., 0] * rest[..., 1] - t[..., 1] * rest[..., 0]
        return self.s[row, best[..., 0]] + pick(along, best, 2)[..., 0], left, np.arctan2(t[..., 1], t[..., 0])

    def at(self, s: F64, left: F64) -> F64:
        """The points [N, 2] at `s` [N] m along the chains and `left` [N] m to their left."""
        k = np.maximum((self.s <= s[:, None]).sum(1) - 1, 0)
        row = np.arange(len(s))
        t = self.t[row, k]
        normal = np.stack([-t[:, 1], t[:, 0]], 1)
        point: F64 = self.a[row, k] + (s - self.s[row, k])[:, None] * t + left[:, None] * normal
        return point

    def heading(self, s: F64) -> F64:
        """Where the chains head [N], rad, at `s` [N] m along them."""
        k = np.maximum((self.s <= s[:, None]).sum(1) - 1, 0)
        t = self.t[np.arange(len(s)), k]
        return np.asarray(np.arctan2(t[:, 1], t[:, 0]))


def encounters(
    view: Observation, path: Path, *, half: F64, reach: float, moved: F64, dt: float
) -> tuple[Encounter, Bool, F64]:
    """Everybody in line of sight, as careful models see them.

    Whoever moves along the path within 30 degrees is taken to stay on it (also against it); others cross it straight on
    at their speed.

    Args:
        view: What N drivers see, with the sensor `truth`.
        path: Their routes.
        half: [N, 2] half length and width of their bodies, m.
        reach: How far they see, m.
        moved: [N, K] how far each has moved towards the path since it began to, m.
        dt: s since that was so.

    Returns:
        The encounters [N, K], who of them is seen, and `moved` now.
    """
    belief: Belief = view.readings["truth"]
    seen = in_sight(view.pose[:, :2], belief, reach) & (belief.kind != AgentKind.NONE)
    e = meet(
        path,
        half=half,
        place=np.asarray(to_local(view.pose[:, None], belief.pose[..., :2]), np.float64),
        yaw=np.asarray(belief.pose[..., 2] - view.pose[:, None, 2], np.float64),
        speed=np.asarray(belief.speed),
        size=np.asarray(belief.size),
        own_speed=np.asarray(view.speed),
        own_accel=np.asarray(view.accel),
    )
    comes = seen & (e.approach > 0.05)
    now = np.where(comes, moved + np.maximum(e.approach, 0.0) * dt, 0.0)
    return replace(e, moved=now), seen, now


def meet(
    path: Path,
    *,
    half: F64,
    place: F64,
    yaw: F64,
    speed: npt.NDArray[np.floating],
    size: npt.NDArray[np.floating],
    own_speed: npt.NDArray[np.floating],
    own_accel: npt.NDArray[np.floating],
) -> Encounter:
    """Others in the frame of drivers' paths, [N, K]; none of them has moved towards its path yet.

    Args:
        path: The paths of N drivers.
        half: [N, 2] half length and width of their bodies, m.
        place: [N, K, 2] where the others are, in the drivers' frames, m.
        yaw: [N, K] where these head, rad.
        speed: [N, K] m/s.
        size: [N, K, 2] length and width of their bodies, m.
        own_speed: [N] of the drivers, m/s.
        own_accel: [N] of the drivers, m/s^2.
    """
    here, _, _ = path.project(np.zeros((len(place), 1, 2)))
    s, left, heading = path.project(place)
    turn = yaw - heading
    fast: F64 = np.asarray(speed, np.float64)
    ahead, across = fast * np.cos(turn), fast * np.sin(turn)
    c, sn = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    own = np.asarray(size, np.float64) / 2.0
    long, wide = own[..., 0] * c + own[..., 1] * sn, own[..., 0] * sn + own[..., 1] * c
    room = half[:, 1:] + wide
    lateral = np.abs(left) - room
    inside = lateral <= 0.0
    approach = np.where(inside, np.abs(across), -np.sign(left) * across)
    stays = (c > np.cos(ALONG)) | (np.abs(across) < 0.1)
    through = np.where(stays, np.inf, room - left * np.sign(across))
    return Encounter(
        speed=np.broadcast_to(np.asarray(own_speed, np.float64)[:, None], s.shape),
        accel=np.broadcast_to(np.asarray(own_accel, np.float64)[:, None], s.shape),
        gap=s - here - half[:, :1] - long,
        lead=ahead,
        lateral=lateral,
        approach=approach,
        through=np.maximum(through, 0.0),
        length=2.0 * (half[:, :1] + long),
        moved=np.zeros(s.shape),
    )


def _unit(v: F64) -> F64:
    return np.asarray(v / np.maximum(np.hypot(v[..., :1], v[..., 1:]), 1e-9))
