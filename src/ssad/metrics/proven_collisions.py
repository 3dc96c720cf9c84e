"""Proven collisions: those that say something about the ego, and not only about who was steered into it.

A collision is proven if the ego moves, the agent that it touches is an adversary that drives on its lawful side, within
the limits of its vehicle, and without touching anybody else, and a careful driver avoids the collision. Everything but
the last is measured here, from the trace and the lanes of the town. Right of way is no condition.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from ssad.core.geometry import obb_distance
from ssad.core.lane_graph import LaneGraph
from ssad.core.rotations import wrap_angle
from ssad.core.types import F64, I32, MOVING, AgentKind, Bool, EpisodeTrace, LaneType
from ssad.metrics.criticality import trace_boxes
from ssad.metrics.driving import first_contact

AGAINST: Final = 2.0 * np.pi / 3.0  # rad between course and lane from which an agent drives against traffic
WRONG_WAY_TIME: Final = 0.3  # s on the wrong side that count; at the contact itself any time does
LIMIT_TOLERANCE: Final = 1.1  # factor up to which a limit counts as respected
_CHUNK: Final = 16  # steps whose lanes are looked up together, so that few lanes are near all of them


@dataclass(frozen=True)
class Accelerations:
    """Accelerations of a vehicle, m/s^2, none negative: the limits of its body, or the peaks of a motion.

    Attributes:
        forward: Speeding up.
        braking: Slowing down.
        lateral: Across the heading.
    """

    forward: float
    braking: float
    lateral: float

    def within(self, limits: Accelerations) -> bool:
        """Return True if no value exceeds its limit by more than 10 %."""
        return (
            self.forward <= LIMIT_TOLERANCE * limits.forward
            and self.braking <= LIMIT_TOLERANCE * limits.braking
            and self.lateral <= LIMIT_TOLERANCE * limits.lateral
        )


@dataclass(frozen=True)
class CollisionProof:
    """Conditions of a proven collision; unmeasured ones are None.

    Attributes:
        has_adversary: The agent that the ego touches is an adversary.
        ego_moves: The ego is faster than 0.5 m/s at the contact.
        lawful_side: The adversary has not driven against traffic; true of walkers.
        within_limits: It has kept to the limits of its vehicle. None: it is no vehicle, or was present too briefly.
        hits_others: It has touched an agent other than the ego.
        avoidable: A careful driver avoids the collision. None: not graded.
    """

    has_adversary: bool
    ego_moves: bool
    lawful_side: bool
    within_limits: bool | None
    hits_others: bool
    avoidable: bool | None = None

    @property
    def is_candidate(self) -> bool:
        """True if all conditions hold except that of the careful driver, which is not asked."""
        return (
            self.has_adversary
            and self.ego_moves
            and self.lawful_side
            and self.within_limits is not False
            and not self.hits_others
        )

    @property
    def is_proven(self) -> bool | None:
        """Return whether all conditions hold; None where that depends on a grade that was not made."""
        return self.avoidable if self.is_candidate else False


def prove_collision(
    trace: EpisodeTrace,
    graph: LaneGraph,
    adversaries: Collection[int],
    limits: Accelerations | None,
    *,
    avoidable: bool | None = None,
) -> CollisionProof:
    """Check the conditions of a proven collision at the first contact of an episode.

    Args:
        trace: The drive, at the steps of the world.
        graph: Lane graph of the town.
        adversaries: Indices of the agents that are adversaries.
        limits: Limits of the agent that is hit; None: it has none.
        avoidable: Whether a careful driver avoids the collision; None: not graded.

    Returns:
        The conditions.

    Raises:
        ValueError: There is no contact.
    """
    contact, agent = first_contact(trace)
    ego_moves = abs(float(trace.speed[contact, 0])) > MOVING
    if agent < 1 or agent not in adversaries:
        return CollisionProof(False, ego_moves, True, None, False, avoidable)
    peaks = None if limits is None else peak_accelerations(trace, agent, until=contact)
    return CollisionProof(
        has_adversary=True,
        ego_moves=ego_moves,
        lawful_side=not takes_wrong_side(trace, graph, agent, contact=contact),
        within_limits=None if limits is None or peaks is None else peaks.within(limits),
        hits_others=touches_others(trace, agent, until=contact),
        avoidable=avoidable,
    )


def peak_accelerations(trace: EpisodeTrace, agent: int, *, until: int | None = None) -> Accelerations | None:
    """Measure the largest accelerations of an agent from step to step, without any mean.

    Speed is that of its positions: the recorded speed of an agent on a trajectory is that of the trajectory's rows.

    Args:
        trace: The trace.
        agent: The agent.
        until: Last step that counts; None: that of the trace.

    Returns:
        The peaks; None if it is nowhere present for three steps on end.
    """
    end = len(trace.active) if until is None else until + 1
    present = trace.active[:end, agent]
    dt = float(trace.dt)
    x, y, yaw = (getattr(trace, name)[:end, agent].astype(np.float64) for name in ("x", "y", "yaw"))
    dx, dy = np.diff(x) / dt, np.diff(y) / dt
    # Reversing has a negative speed, so that a change of direction is not taken for a standstill.
    speed = np.copysign(np.hypot(dx, dy), dx * np.cos(yaw[:-1]) + dy * np.sin(yaw[:-1]))
    moved = present[1:] & present[:-1]
    measured = moved[1:] & moved[:-1]
    if not measured.any():
        return None
    rate = (np.diff(speed) * np.sign(speed[1:] + speed[:-1]))[measured] / dt
    lateral = np.abs(speed * np.asarray(wrap_angle(np.diff(yaw))))[moved] / dt
    return Accelerations(max(float(rate.max()), 0.0), max(float(-rate.min()), 0.0), float(lateral.max()))


def takes_wrong_side(trace: EpisodeTrace, graph: LaneGraph, agent: int, *, contact: int | None = None) -> bool:
    """Return True if an agent drives against traffic for 0.3 s, or at the contact.

    Args:
        trace: The trace.
        graph: Lane graph of the town.
        agent: The agent.
        contact: Step of the contact, the last that counts; None: there is none.
    """
    wrong_way = wrong_way_steps(trace, graph, agent)
    if contact is not None:
        wrong_way = wrong_way[: contact + 1]
        if wrong_way[-1]:
            return True
    return longest_run(wrong_way) >= round(WRONG_WAY_TIME / trace.dt)


def wrong_way_steps(trace: EpisodeTrace, graph: LaneGraph, agent: int) -> Bool:
    """Return the steps [T] at which a vehicle drives against the direction of every driving lane under its centre.

    Its course must differ from each lane's direction by more than 120 degrees, so that turning and crossing do not
    count; where lanes overlap, in a junction, one that it follows is enough. Off the lanes there is no wrong way. Who
    drives backwards has the course of its motion, not that of its heading. Walkers have no direction of traffic.
    """
    wrong_way = np.zeros(len(trace.active), bool)
    speed = trace.speed[:, agent].astype(np.float64)
    steps = np.flatnonzero(trace.active[:, agent] & (np.abs(speed) > MOVING))
    if not AgentKind.NONE < trace.kind[agent] <= AgentKind.BICYCLE or not len(steps):
        return wrong_way
    course = trace.yaw[steps, agent].astype(np.float64) + np.where(speed[steps] < 0.0, np.pi, 0.0)
    centre = np.stack([trace.x[steps, agent], trace.y[steps, agent]], 1).astype(np.float64)
    point, direction = lane_directions(graph, centre)
    is_against = np.abs(np.asarray(wrap_angle(course[point] - direction))) > AGAINST
    against, along = (np.bincount(point[mask], minlength=len(steps)) > 0 for mask in (is_against, ~is_against))
    wrong_way[steps] = against & ~along
    return wrong_way


def lane_directions(graph: LaneGraph, xy: npt.ArrayLike) -> tuple[I32, F64]:
    """Return the directions of the driving lanes under points.

    Args:
        graph: Lane graph of the town.
        xy: Points [n, 2], m.

    Returns:
        Index of a point [k], and direction of a part of a lane that contains it [k], rad; a point on no lane has none.
    """
    points = np.asarray(xy, np.float64).reshape(-1, 2)
    start, end, half_width = _driving_segments(graph)
    low = np.minimum(start, end) - half_width.max(1, keepdims=True)
    high = np.maximum(start, end) + half_width.max(1, keepdims=True)
    indices, directions = [np.zeros(0, np.int32)], [np.zeros(0)]
    for first in range(0, len(points), _CHUNK):
        chunk = points[first : first + _CHUNK]
        near = np.flatnonzero(((low <= chunk.max(0)) & (high >= chunk.min(0))).all(1))
        along = end[near] - start[near]
        offset = chunk[:, None] - start[near]
        squared_length = np.maximum((along**2).sum(-1), 1e-12)
        share = np.clip((offset * along).sum(-1) / squared_length, 0.0, 1.0)
        distance = np.hypot(*np.moveaxis(offset - share[..., None] * along, -1, 0))
        reach = half_width[near, 0] + share * (half_width[near, 1] - half_width[near, 0])
        point, segment = np.nonzero(distance <= reach)
        indices.append((point + first).astype(np.int32))
        directions.append(np.arctan2(along[segment, 1], along[segment, 0]))
    return np.concatenate(indices), np.concatenate(directions)


def touches_others(trace: EpisodeTrace, agent: int, *, until: int | None = None, boxes: F64 | None = None) -> bool:
    """Return True if an agent touches another one, not the ego, that it did not touch from the start.

    Walkers who brush against each other do not count: those of a group walk shoulder to shoulder.

    Args:
        trace: The trace.
        agent: The agent.
        until: Last step that counts; None: that of the trace.
        boxes: `trace_boxes(trace)`, for callers that have them.
    """
    end = len(trace.active) if until is None else until + 1
    box = (trace_boxes(trace) if boxes is None else boxes)[:end]
    reach = 0.5 * np.hypot(trace.length, trace.width)
    for other_agent in range(1, len(trace.kind)):
        if trace.kind[agent] == trace.kind[other_agent] == AgentKind.WALKER:
            continue
        both_present = trace.active[:end, agent] & trace.active[:end, other_agent]
        centre_distance = np.hypot(*(box[:, agent, :2] - box[:, other_agent, :2]).T)
        # The circle test is cheap and excludes nearly all rows before the exact box distance.
        near_rows = np.flatnonzero(both_present & (centre_distance <= reach[agent] + reach[other_agent]))
        if other_agent != agent and len(near_rows):
            touching = obb_distance(box[near_rows, agent], box[near_rows, other_agent]) <= 0.0
            if touching.any() and not (touching[0] and near_rows[0] == np.flatnonzero(both_present)[0]):
                return True
    return False


def _driving_segments(graph: LaneGraph) -> tuple[F64, F64, F64]:
    """Return starts and ends [M, 2] and half widths at both [M, 2] of the parts of all driving lanes, m."""
    segments: tuple[F64, F64, F64] | None = graph.cache.get("driving_segments")
    if segments is not None:
        return segments
    lane = np.repeat(np.arange(graph.lane_count), np.diff(graph.offset))
    index = np.flatnonzero((lane[:-1] == lane[1:]) & (graph.kind[lane[:-1]] == LaneType.DRIVING))
    half_width = 0.5 * np.stack([graph.width[index], graph.width[index + 1]], 1)
    segments = (
        graph.xy[index].astype(np.float64),
        graph.xy[index + 1].astype(np.float64),
        half_width.astype(np.float64),
    )
    graph.cache["driving_segments"] = segments
    return segments


def longest_run(flags: Bool) -> int:
    """Return the length of the longest run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return int((edges[1::2] - edges[::2]).max(initial=0))
