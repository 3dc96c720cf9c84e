"""Driving metrics of one episode: SafeBench's ten metrics, CARLA's driving score and their components.

Definitions, units and sources of all metrics: docs/reference/metrics.md. All metrics are functions of an
`EpisodeTrace`. Row 0 of a trace is the start, before anything was driven, so means over steps leave it out.
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

_SHARE, _COUNT, _LENGTH, _TIME = (0.0, 1.0), (0.0, 1e9), (0.0, 1e7), (0.0, 1e9)
LIMITS: Mapping[str, tuple[float | None, float | None]] = {
    "collision": _SHARE,
    "collision_events": _COUNT,
    **dict.fromkeys(COLLISIONS, _COUNT),
    "off_road": _LENGTH,
    "off_road_fraction": _SHARE,
    "distance_to_route": _LENGTH,
    "route_completion": _SHARE,
    "route_following": _SHARE,
    "time": _TIME,
    "driven": _LENGTH,
    "red_lights": _COUNT,
    "stop_signs": _COUNT,
    "acceleration": (0.0, 1e5),
    "yaw_velocity": (0.0, 1e3),
    "lane_invasions": _COUNT,
    "in_route_failure": _SHARE,
    "driving_score": (0.0, 100.0),
    "min_ttc": (0.0, 10.0),
    "pet": (0.0, 10.0),
    "min_distance": _LENGTH,
    "impact_speed": (0.0, 1e3),
    "lane_crossings": _COUNT,
    **dict.fromkeys(("avoided_by_cc", "avoided_by_reg157", "avoided_by_rss", "avoided_by_fsm"), _SHARE),
    "avoided_by_limit": _SHARE,
}
"""Least and greatest possible value of each field of `EpisodeMetrics`."""

MAX_ROUTE_DISTANCE = 30.0
OFF_ROUTE_DISTANCE = 15.0
OFF_ROUTE_SHARE = 0.30
SAME_AGENT_TIME = 5.0
SAME_PLACE = 3.0
PLACE_FORGOTTEN = 5.0


@dataclass(frozen=True)
class EpisodeMetrics:
    """Raw metrics of one episode; NaN where the trace has nothing to measure, None where the world lacks it.

    Attributes:
        collision: Whether the ego hit anything.
        collision_events: Number of collision events.
        collisions_vehicle: Events with vehicles.
        collisions_walker: Events with pedestrians.
        collisions_cyclist: Events with cyclists.
        collisions_static: Events with anything else.
        off_road: Distance driven off the road, m.
        off_road_fraction: Share of the distance driven.
        distance_to_route: Mean distance to the route, m.
        route_completion: 0 to 1.
        route_following: 0 to 1.
        time: Duration, s.
        driven: Distance, m.
        red_lights: Number of red lights run.
        stop_signs: Number of stop signs run; None in a world without stop signs, whose driving score leaves them
            out.
        acceleration: Mean acceleration, m/s^2.
        yaw_velocity: Mean yaw rate, rad/s.
        lane_invasions: Number of lane invasions.
        in_route_failure: Whether the ego left its route too far or for too long (see `in_route_failure`).
        driving_score: 0 to 100.
        min_ttc: Minimum time to collision, s (10: none).
        pet: Post-encroachment time, s (10: none).
        min_distance: Minimum distance to another agent, m (NaN: there is none).
        impact_speed: Relative speed at the ego's first contact, m/s (NaN: no contact).
        lane_crossings: Lane markings crossed by the simulator's own sensor (NaN: it has none).
        avoided_by_cc: 1 if the careful and competent human driver of UN R157 avoids the collision, else 0 (NaN:
            no collision, or not graded); likewise the others.
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
        """Return the values by field name."""
        return asdict(self)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> EpisodeMetrics:
        """Build metrics from `as_dict` or its JSON form.

        None or a missing value becomes NaN (stop_signs: None); other keys are ignored.
        """
        converters: dict[str, Any] = {"bool": bool, "int": int, "int | None": int, "float": float}
        values: dict[str, Any] = {}
        for metric_field in fields(cls):
            value = data.get(metric_field.name)
            missing = None if metric_field.type == "int | None" else math.nan
            values[metric_field.name] = missing if value is None else converters[str(metric_field.type)](value)
        return cls(**values)


def episode_metrics(trace: EpisodeTrace, *, stop_signs: bool = False) -> EpisodeMetrics:
    """Compute all metrics of one episode.

    Args:
        trace: The trace of the episode.
        stop_signs: Whether the town of the trace has stop signs.

    Raises:
        ValueError: The trace has no row.
    """
    if len(trace.contact) == 0:
        raise ValueError(f"trace {trace.key}: no rows")
    events = collision_events(trace)
    counts = {name: int(((trace.contact[events] & kind) != 0).sum()) for name, kind in COLLISIONS.items()}
    off_road_metres, driven_length = off_road_distance(trace), float(trace.driven[-1])
    off_road_fraction = min(off_road_metres / driven_length, 1.0) if driven_length > 0.0 else 0.0
    completion = min(max(float(trace.route_complete[-1]) / 100.0, 0.0), 1.0)
    deviation = _mean(trace.route_distance[1:])
    # bodies may touch between two rows
    has_contact = bool((trace.contact_agent >= 0).any())
    infractions = counts | {"red_lights": int(trace.red_light.sum())}
    stop_sign_count = int(trace.stop_sign.sum()) if stop_signs else None
    return EpisodeMetrics(
        collision=has_collision(trace),
        collision_events=int(events.sum()),
        off_road=off_road_metres,
        off_road_fraction=off_road_fraction,
        distance_to_route=deviation,
        route_completion=completion,
        route_following=1.0 - min(deviation / DIVISORS["DR"], 1.0) if math.isfinite(deviation) else math.nan,
        time=(len(trace.contact) - 1) * float(trace.dt),
        driven=driven_length,
        acceleration=mean_acceleration(trace),
        yaw_velocity=mean_yaw_velocity(trace),
        lane_invasions=int(trace.lane_invasion.sum()),
        in_route_failure=in_route_failure(trace),
        driving_score=driving_score(completion, infractions | {"stop_signs": stop_sign_count or 0}, off_road_fraction),
        min_ttc=0.0 if has_contact else min_ttc(trace),
        pet=0.0 if has_contact else post_encroachment_time(trace),
        min_distance=0.0 if has_contact else min_distance(trace),
        stop_signs=stop_sign_count,
        impact_speed=impact_speed(trace),
        **infractions,
    )


def has_collision(trace: EpisodeTrace) -> bool:
    """Return whether the ego hit anything.

    SafeBench reads its last record, whose collision flag stays set once raised.
    """
    return bool((trace.contact != 0).any()) or trace.end == "collision"


def first_contact(trace: EpisodeTrace) -> tuple[int, int]:
    """Return the first contact of an episode.

    Args:
        trace: The trace of the episode.

    Returns:
        Its step, and the agent that was hit; -1 for an object that is no agent.

    Raises:
        ValueError: There is no contact.
    """
    steps = np.flatnonzero(trace.contact)
    if len(steps) == 0:
        raise ValueError(f"trace {trace.key}: no contact")
    return int(steps[0]), max(int(trace.contact_agent[steps[0]]), -1)


def impact_speed(trace: EpisodeTrace) -> float:
    """Return the relative speed of the ego and the first body it hit, m/s; NaN without contact.

    It is the length of the difference of their velocities, the severity by which NeuroNCAP weighs collisions.
    """
    if not (trace.contact != 0).any():
        return math.nan
    step, agent = first_contact(trace)
    bodies = [0] if agent < 1 else [0, agent]
    speed, yaw = trace.speed[step, bodies].astype(np.float64), trace.yaw[step, bodies].astype(np.float64)
    signs = np.array([1.0, -1.0])[: len(bodies)]
    return float(np.hypot((signs * speed * np.cos(yaw)).sum(), (signs * speed * np.sin(yaw)).sum()))


def collision_events(trace: EpisodeTrace) -> Bool:
    """Return the steps [T] that begin a collision event, as CARLA's leaderboard and FREA count them.

    A contact is no new event within 5 s of the last event with the same agent, or while the ego is within 3 m of
    the place of an event (a place is dropped once the ego is more than 5 m from it).
    """
    events = np.zeros(len(trace.contact), np.bool_)
    steps = np.flatnonzero(trace.contact)
    if len(steps) == 0:
        return events
    ego = np.stack([trace.x[:, 0], trace.y[:, 0]], axis=-1).astype(np.float64)
    accepted: list[int] = []
    for step in steps:
        event_distances = [np.hypot(*(ego[event : step + 1] - ego[event]).T) for event in accepted]
        known_place = any(
            distances[-1] <= SAME_PLACE and distances.max() <= PLACE_FORGOTTEN for distances in event_distances
        )
        agent = trace.contact_agent[step]
        known_agent = agent >= 0 and any(
            trace.contact_agent[event] == agent and (step - event) * trace.dt <= SAME_AGENT_TIME for event in accepted
        )
        if not (known_place or known_agent):
            accepted.append(int(step))
    events[accepted] = True
    return events


def off_road_distance(trace: EpisodeTrace) -> float:
    """Return the metres driven in steps that begin or end off the road (SafeBench `cal_out_of_road_length`)."""
    step_distance = np.diff(trace.driven.astype(np.float64))
    return float(step_distance[trace.off_road[1:] | trace.off_road[:-1]].sum())


def mean_acceleration(trace: EpisodeTrace) -> float:
    """Mean size of the ego's acceleration, m/s^2: along the heading as recorded, across it speed x yaw rate."""
    if len(trace.accel) < 2:
        return math.nan
    lateral = trace.speed[1:, 0].astype(np.float64) * _turns(trace, wrap=True) / trace.dt
    return _mean(np.hypot(trace.accel[1:].astype(np.float64), lateral))


def mean_yaw_velocity(trace: EpisodeTrace, *, wrap: bool = True) -> float:
    """Return the mean |yaw rate|, rad/s; `wrap=False` repeats SafeBench, which counts pi to -pi as a full turn."""
    turns = np.abs(_turns(trace, wrap=wrap))
    return float(turns.sum() / (len(turns) * trace.dt)) if len(turns) else math.nan


def in_route_failure(trace: EpisodeTrace) -> bool:
    """Ever more than 30 m off the route, or more than 15 m off it for metres worth over 30 % of its length.

    CARLA's InRouteTest ends the episode here; SafeBench only records it.
    """
    distance = trace.route_distance[1:]
    length = float(np.hypot(*np.diff(trace.route.astype(np.float64), axis=0).T).sum())
    off_route_metres = float(np.diff(trace.driven.astype(np.float64))[distance > OFF_ROUTE_DISTANCE].sum())
    return bool((distance > MAX_ROUTE_DISTANCE).any()) or off_route_metres > OFF_ROUTE_SHARE * length


def driving_score(completion: float, infractions: Mapping[str, int], off_road_fraction: float) -> float:
    """CARLA leaderboard 1.0 driving score in [0, 100]: route completion times a factor for each infraction.

    Args:
        completion: Route completion in [0, 1].
        infractions: Counts by the names of `PENALTIES`.
        off_road_fraction: Share of the distance driven.
    """
    factor = math.prod(PENALTIES[name] ** count for name, count in infractions.items())
    return 100.0 * completion * factor * (1.0 - off_road_fraction)


def normalise_metric(name: str, value: float) -> float:
    """Return a metric of `DIVISORS` scaled to [0, 1], 1 the worst."""
    return min(value / DIVISORS[name], 1.0)


def overall_score(means: Mapping[str, float], *, time_out: float = DIVISORS["TS"]) -> float:
    """Return SafeBench's overall score, LOWER is better, from means over episodes of CR, OR, DR, RC and TS.

    As in its code, each term is divided by its divisor, rounded to two decimals, not clipped, and weighted.
    """
    terms = {**means, "IR": 1.0 - means["RC"]}
    divisors = {**DIVISORS, "TS": time_out}
    # Rounding each term repeats SafeBench's code, so that published scores are comparable.
    return sum(weight * round(terms[name] / divisors[name], 2) for name, weight in WEIGHTS.items())


def frea_score(means: Mapping[str, float], *, time_out: float = DIVISORS["TS"]) -> float:
    """Return FREA's overall score, 1 - SafeBench's, HIGHER is better; FREA uses collision events an episode as CR."""
    return 1.0 - overall_score(means, time_out=time_out)


def _turns(trace: EpisodeTrace, *, wrap: bool) -> F64:
    """Return the change of the ego's yaw in each step [T - 1], rad."""
    turns = np.diff(trace.yaw[:, 0].astype(np.float64))
    return np.asarray(wrap_angle(turns) if wrap else turns, np.float64)


def _mean(values: np.typing.NDArray[Any]) -> float:
    return float(np.mean(values, dtype=np.float64)) if len(values) else math.nan
