"""How well one episode was driven: SafeBench's ten metrics, CARLA's driving score and what lies under them.

Definitions, units and sources of all metrics: docs/metrics.md. Everything is a function of an `EpisodeTrace`. Row 0 of
a trace is the start, before anything was driven, so means over steps leave it out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from ssad.core.rotations import wrap_angle
from ssad.core.types import F64, Bool, Contact, EpisodeTrace
from ssad.metrics.criticality import min_distance, min_ttc, post_encroachment_time

DIVISORS = {"CR": 1.0, "OR": 10.0, "DR": 5.0, "IR": 1.0, "TS": 30.0, "ACC": 8.0, "YV": 1.0}
"""What SafeBench divides a metric by (IR: incomplete route, 1 - RC; ACC and YV: FREA's, not part of the score)."""

WEIGHTS = {"CR": 0.4, "OR": 0.1, "DR": 0.1, "IR": 0.3, "TS": 0.1}
"""Weights of SafeBench's overall score."""

PENALTIES = {
    "collisions_walker": 0.50,
    "collisions_cyclist": 0.60,
    "collisions_vehicle": 0.60,
    "collisions_static": 0.65,
    "red_lights": 0.70,
    "stop_signs": 0.80,
}
"""CARLA leaderboard: factor of the driving score for each infraction (a cyclist is a vehicle there)."""

COLLISIONS = {
    "collisions_vehicle": Contact.VEHICLE,
    "collisions_walker": Contact.WALKER,
    "collisions_cyclist": Contact.CYCLIST,
    "collisions_static": Contact.STATIC,
}

MAX_ROUTE_DISTANCE = 30.0
OFF_ROUTE_DISTANCE = 15.0
OFF_ROUTE_SHARE = 0.30
SAME_AGENT_TIME = 5.0
SAME_PLACE = 3.0
PLACE_FORGOTTEN = 5.0


@dataclass(frozen=True)
class EpisodeMetrics:
    """Raw metrics of one episode; NaN where the trace has nothing to measure, None where the world has not.

    Attributes:
        collision: Whether there was one.
        collision_events: Number of them.
        collisions_vehicle: Events with vehicles.
        collisions_walker: Events with pedestrians.
        collisions_cyclist: Events with cyclists.
        collisions_static: Events with anything else.
        off_road: Distance driven off the road, m.
        off_road_fraction: Share of the distance driven.
        distance_to_route: m.
        route_completion: 0 to 1.
        route_following: 0 to 1.
        time: s.
        driven: Distance, m.
        red_lights: Number of red lights run.
        stop_signs: Number of stop signs run; None in a world without, whose driving score then leaves them out.
        acceleration: m/s^2.
        yaw_velocity: rad/s.
        lane_invasions: Number of them.
        in_route_failure: Whether the ego left its route too far or for too long (see the function of this name).
        driving_score: 0 to 100.
        min_ttc: Least time to collision, s (10: none).
        pet: Post-encroachment time, s (10: none).
        min_distance: Least distance to another agent, m (NaN: there is none).
        impact_speed: Speed of the ego against what it hit first, m/s (NaN: it hit nothing).
        lane_crossings: Times that the simulator's own sensor saw lane markings crossed (NaN: it has none).
        avoided_by_cc: 1 if the careful and competent human driver of UN R157 avoids the collision that was, else 0
            (NaN: there was none, or it was not graded); likewise the others.
        avoided_by_reg157: Of UN R157, 5.2.5.2.
        avoided_by_rss: Of RSS.
        avoided_by_fsm: Of the FSM.
        avoided_by_limit: By some manoeuvre of the search for the kinematic limit, or by a careful driver.
    """

    collision: bool
    collision_events: int
    collisions_vehicle: int
    collisions_walker: int
    collisions_cyclist: int
    collisions_static: int
    off_road: float
    off_road_fraction: float
    distance_to_route: float
    route_completion: float
    route_following: float
    time: float
    driven: float
    red_lights: int
    stop_signs: int | None
    acceleration: float
    yaw_velocity: float
    lane_invasions: int
    in_route_failure: bool
    driving_score: float
    min_ttc: float
    pet: float
    min_distance: float
    impact_speed: float = math.nan
    lane_crossings: float = math.nan
    avoided_by_cc: float = math.nan
    avoided_by_reg157: float = math.nan
    avoided_by_rss: float = math.nan
    avoided_by_fsm: float = math.nan
    avoided_by_limit: float = math.nan

    def as_dict(self) -> dict[str, Any]:
        """Field name -> value."""
        return asdict(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> EpisodeMetrics:
        """From `as_dict` or its JSON form: None or absent is NaN (stop_signs: None); other keys are ignored."""
        read: dict[str, Any] = {"bool": bool, "int": int, "int | None": int, "float": float}
        values: dict[str, Any] = {}
        for f in fields(cls):
            value = data.get(f.name)
            missing = None if f.type == "int | None" else math.nan
            values[f.name] = missing if value is None else read[str(f.type)](value)
        return cls(**values)


def episode_metrics(trace: EpisodeTrace, *, stop_signs: bool = False) -> EpisodeMetrics:
    """All metrics of one episode.

    Args:
        trace: what happened.
        stop_signs: whether the town that the trace is from has stop signs.

    Raises:
        ValueError: the trace has no row.
    """
    if len(trace.contact) == 0:
        raise ValueError(f"trace {trace.key}: no rows")
    events = collision_events(trace)
    kinds = {name: int(((trace.contact[events] & kind) != 0).sum()) for name, kind in COLLISIONS.items()}
    off, driven = off_road_distance(trace), float(trace.driven[-1])
    fraction = min(off / driven, 1.0) if driven > 0.0 else 0.0
    completion = min(max(float(trace.route_complete[-1]) / 100.0, 0.0), 1.0)
    deviation = _mean(trace.route_distance[1:])
    # bodies may touch between two rows
    touched = bool((trace.contact_agent >= 0).any())
    infractions = kinds | {"red_lights": int(trace.red_light.sum())}
    signs = int(trace.stop_sign.sum()) if stop_signs else None
    return EpisodeMetrics(
        collision=collided(trace),
        collision_events=int(events.sum()),
        off_road=off,
        off_road_fraction=fraction,
        distance_to_route=deviation,
        route_completion=completion,
        route_following=1.0 - min(deviation / DIVISORS["DR"], 1.0) if math.isfinite(deviation) else math.nan,
        time=(len(trace.contact) - 1) * float(trace.dt),
        driven=driven,
        acceleration=mean_acceleration(trace),
        yaw_velocity=mean_yaw_velocity(trace),
        lane_invasions=int(trace.lane_invasion.sum()),
        in_route_failure=in_route_failure(trace),
        driving_score=driving_score(completion, infractions | {"stop_signs": signs or 0}, fraction),
        min_ttc=0.0 if touched else min_ttc(trace),
        pet=0.0 if touched else post_encroachment_time(trace),
        min_distance=0.0 if touched else min_distance(trace),
        stop_signs=signs,
        impact_speed=impact_speed(trace),
        **infractions,
    )


def collided(trace: EpisodeTrace) -> bool:
    """Whether the ego hit anything. SafeBench reads its last record, whose collision flag stays set once raised."""
    return bool((trace.contact != 0).any()) or trace.end == "collision"


def first_contact(trace: EpisodeTrace) -> tuple[int, int]:
    """The first contact of a drive.

    Args:
        trace: The drive.

    Returns:
        Its step, and the agent that was hit; -1: something that is no agent.

    Raises:
        ValueError: There is none.
    """
    steps = np.flatnonzero(trace.contact)
    if len(steps) == 0:
        raise ValueError(f"trace {trace.key}: no contact")
    return int(steps[0]), max(int(trace.contact_agent[steps[0]]), -1)


def impact_speed(trace: EpisodeTrace) -> float:
    """Speed of the ego against what it hit first, m/s: the length of the difference of their velocities; NaN: nothing.

    It is the severity that NeuroNCAP weighs collisions by.
    """
    if not (trace.contact != 0).any():
        return math.nan
    step, agent = first_contact(trace)
    who = [0] if agent < 1 else [0, agent]
    speed, yaw = trace.speed[step, who].astype(np.float64), trace.yaw[step, who].astype(np.float64)
    sides = np.array([1.0, -1.0])[: len(who)]
    return float(np.hypot((sides * speed * np.cos(yaw)).sum(), (sides * speed * np.sin(yaw)).sum()))


def collision_events(trace: EpisodeTrace) -> Bool:
    """[T] steps that begin a collision event, as CARLA's leaderboard and FREA count them.

    A contact is no new event within 5 s of the last event with the same agent, or while the ego is within 3 m of the
    place of an event (a place is forgotten once the ego is more than 5 m from it).
    """
    events = np.zeros(len(trace.contact), np.bool_)
    steps = np.flatnonzero(trace.contact)
    if len(steps) == 0:
        return events
    ego = np.stack([trace.x[:, 0], trace.y[:, 0]], axis=-1).astype(np.float64)
    accepted: list[int] = []
    for i in steps:
        distance = [np.hypot(*(ego[event : i + 1] - ego[event]).T) for event in accepted]
        known_place = any(d[-1] <= SAME_PLACE and d.max() <= PLACE_FORGOTTEN for d in distance)
        agent = trace.contact_agent[i]
        known_agent = agent >= 0 and any(
            trace.contact_agent[event] == agent and (i - event) * trace.dt <= SAME_AGENT_TIME for event in accepted
        )
        if not (known_place or known_agent):
            accepted.append(int(i))
    events[accepted] = True
    return events


def off_road_distance(trace: EpisodeTrace) -> float:
    """Metres driven in steps that begin or end off the road (SafeBench `cal_out_of_road_length`)."""
    gone = np.diff(trace.driven.astype(np.float64))
    return float(gone[trace.off_road[1:] | trace.off_road[:-1]].sum())


def mean_acceleration(trace: EpisodeTrace) -> float:
    """Mean size of the ego's acceleration, m/s^2: along the heading as recorded, across it speed x yaw rate."""
    if len(trace.accel) < 2:
        return math.nan
    across = trace.speed[1:, 0].astype(np.float64) * _turns(trace, wrap=True) / trace.dt
    return _mean(np.hypot(trace.accel[1:].astype(np.float64), across))


def mean_yaw_velocity(trace: EpisodeTrace, *, wrap: bool = True) -> float:
    """Mean |yaw rate|, rad/s. `wrap=False` repeats SafeBench, which counts a step from pi to -pi as a full turn."""
    turns = np.abs(_turns(trace, wrap=wrap))
    return float(turns.sum() / (len(turns) * trace.dt)) if len(turns) else math.nan


def in_route_failure(trace: EpisodeTrace) -> bool:
    """Ever more than 30 m off the route, or more than 15 m off it for metres worth over 30 % of its length.

    CARLA's InRouteTest ends the episode here; SafeBench only records it.
    """
    distance = trace.route_distance[1:]
    length = float(np.hypot(*np.diff(trace.route.astype(np.float64), axis=0).T).sum())
    away = float(np.diff(trace.driven.astype(np.float64))[distance > OFF_ROUTE_DISTANCE].sum())
    return bool((distance > MAX_ROUTE_DISTANCE).any()) or away > OFF_ROUTE_SHARE * length


def driving_score(completion: float, infractions: Mapping[str, int], off_road_fraction: float) -> float:
    """CARLA leaderboard 1.0 driving score in [0, 100]: route completion times a factor for each infraction.

    Args:
        completion: Route completion in [0, 1].
        infractions: Counts by the names of `PENALTIES`.
        off_road_fraction: Share of the distance driven.
    """
    factor = math.prod(PENALTIES[name] ** count for name, count in infractions.items())
    return 100.0 * completion * factor * (1.0 - off_road_fraction)


def normalised(name: str, value: float) -> float:
    """A metric of `DIVISORS` brought into [0, 1], 1 the worst."""
    return min(value / DIVISORS[name], 1.0)


def overall_score(means: Mapping[str, float], *, time_out: float = DIVISORS["TS"]) -> float:
    """SafeBench's overall score, LOWER is better, from means over episodes of CR, OR, DR, RC and TS.

    As its code has it: a term is divided by its divisor, rounded to two decimals, not clipped, and weighted.
    """
    terms = {**means, "IR": 1.0 - means["RC"]}
    divisors = {**DIVISORS, "TS": time_out}
    return sum(weight * round(terms[name] / divisors[name], 2) for name, weight in WEIGHTS.items())


def frea_score(means: Mapping[str, float], *, time_out: float = DIVISORS["TS"]) -> float:
    """FREA's overall score, HIGHER is better: 1 - SafeBench's. FREA puts collision events an episode in place of CR."""
    return 1.0 - overall_score(means, time_out=time_out)


def _turns(trace: EpisodeTrace, *, wrap: bool) -> F64:
    """[T - 1] change of the ego's yaw in each step, rad."""
    turns = np.diff(trace.yaw[:, 0].astype(np.float64))
    return np.asarray(wrap_angle(turns) if wrap else turns, np.float64)


def _mean(values: np.typing.NDArray[Any]) -> float:
    return float(np.mean(values, dtype=np.float64)) if len(values) else math.nan
