"""The scenario types of leaderboard 2.0 and Bench2Drive: who takes part, what sets them off, in which order.

Each function puts the actors of a type at their `Site`. Facts (places, speeds, seconds): the documentation and sources
of ScenarioRunner 0.9.15 (MIT) and, for the types that Bench2Drive adds, its list of scenarios.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Final

import numpy as np

from ssad.core.types import Condition, LaneType, Phase, Pose, SignalPlan
from ssad.interchange.leaderboard_site import CARS, SPEED, Site
from ssad.scenarios.dynamic.knowledge._meeting import meeting_place, time_to_cover
from ssad.scenarios.dynamic.knowledge._placing import behind, beside, lane_path, pose_at
from ssad.world.models import MODELS

Play = Callable[[Site], None]
ONCOMING: Final = math.pi
LEFT: Final = -0.5 * math.pi  # a car from the left is headed to the right
RIGHT: Final = 0.5 * math.pi
KMH: Final = 1.0 / 3.6
_LANES = (LaneType.DRIVING, LaneType.BIKING)


# ---------------------------------------------------------------- things and cars in the way


def _warning(site: Site) -> None:
    """What warns of an obstacle: a cone beside the road where the scenario starts."""
    side = site.side()
    site.add("warning", "cone", site.pose(site.start, side * (site.edge(site.start, side) + 0.6)))


def accident(site: Site, *, two_ways: bool) -> None:
    """A police car and two cars that have crashed stand in the lane."""
    _warning(site)
    distance, side = site.number("distance", 120.0, 0.0, 500.0), site.side()
    first = site.point(distance)
    for name, further in (("police car", 0.0), ("first car", 10.0), ("second car", 16.0)):
        index = site.point(distance + further)
        right = side * 0.3 * site.width(index)
        site.add(name, "car" if name == "police car" else "compact", site.pose(index, right))
    if two_ways:
        site.oncoming_cars(first, site.interval("frequency", (20.0, 100.0), 8.0, 1000.0))


def parked(site: Site, *, two_ways: bool) -> None:
    """A car stands in the lane."""
    _warning(site)
    index = site.point(site.number("distance", 120.0, 0.0, 500.0))
    site.add("parked car", site.car(), site.pose(index, site.side() * 0.35 * site.width(index)))
    if two_ways:
        site.oncoming_cars(index, site.interval("frequency", (20.0, 100.0), 8.0, 1000.0))


def construction(site: Site, *, two_ways: bool) -> None:
    """A sign and cones close the lane."""
    _warning(site)
    side = site.side()
    index = site.point(site.number("distance", 100.0, 0.0, 500.0), in_junction=True)
    site.add("sign", "barrier", site.pose(max(index - 5, 0), 0.0, 0.5 * math.pi))
    half = 0.425 * site.width(index)
    for k, right in enumerate([*(-half * side,) * 5, *(side * half * share for share in (-0.3, 0.3, 1.0))]):
        here = index + min(2 * k, 8)
        site.add(f"cone {k}", "cone", site.pose(min(here, len(site.route.xy) - 1), right))
    if two_ways:
        site.oncoming_cars(index, site.interval("frequency", (20.0, 100.0), 8.0, 1000.0))


def bicycles(site: Site, *, two_ways: bool) -> None:
    """Two bicycles ride slowly at the edge of the lane, from when the ego passes the trigger, and then stop."""
    distance, way = site.number("distance", 100.0, 0.0, 500.0), site.number("bicycle_drive_distance", 50.0, 1.0, 500.0)
    speed = site.number("bicycle_speed", 10.0, 1.0, 40.0) * KMH  # the leaderboard gives it in km/h
    for k, further in enumerate((0.0, 9.0)):
        index = site.point(distance + further)
        right = 0.275 * site.width(index)
        pose = site.pose(index, right)
        phases = (Phase(speed, site.reaches(site.start, pose)), Phase(0.0, Condition("travelled", way)))
        site.add(f"cyclist {k}", "bicycle", pose, phases, site.along(index, way + 10.0, right))
    if two_ways:
        site.oncoming_cars(site.point(distance), site.interval("frequency", (100.0, 100.0), 8.0, 1000.0))


def blocked(site: Site) -> None:
    """A car stands where the ego leaves the junction, and goes on 10 s after the ego has come to the junction.

    In the leaderboard the 10 s begin where the ego is within 13 m of the car, where an ego that waits before the
    junction never comes.
    """
    enter, leave = site.junction()
    index = min(leave + 5, len(site.route.xy) - 3)
    pose = site.pose(index)
    site.signals = SignalPlan("green", "red")
    near = site.reaches(enter - 12, pose)  # who waits for its exit to be free comes no further
    site.add(
        "stopped car",
        site.car(),
        pose,
        (Phase(0.0, near), Phase(SPEED, Condition("after", 10.0))),
        lane_path(site.graph, site.place(index), 120.0),
    )


def hard_brake(site: Site) -> None:
    """The car ahead drives as the ego does, stops hard as the ego passes the trigger, and goes on after 10 s."""
    index = min(14, len(site.route.xy) - 3)
    way = max(10.0, site.start * site.route.spacing)
    stop, go = Phase(0.0, Condition("travelled", way)), Phase(SPEED, Condition("after", 10.0))
    phases = (Phase(SPEED, Condition("ego_speed", 0.5)), stop, go)
    site.add("car ahead", site.car(), site.pose(index), phases, site.along(index, 1000.0, 0.0))


# ---------------------------------------------------------------- people and bicycles that cross


def _crossing(
    site: Site,
    name: str,
    model: str,
    pose: Pose,
    index: int,
    *,
    way: float,
    speed: float,
    seconds: float,
    least: float,
    idle: float = 0.0,
) -> None:
    """Somebody who goes straight across `idle` s after the ego is near route point `index`; stops behind the road."""
    near, gone = site.seconds_before(index, seconds, least, pose), Phase(0.0, Condition("travelled", way))
    waits = (Phase(0.0, near), Phase(speed, Condition("after", idle))) if idle else (Phase(speed, near),)
    site.add(name, model, pose, (*waits, gone))


def _from_side(site: Site, index: int, side: float, further: float, angle: float = 0.0) -> tuple[Pose, float]:
    """A pose beside the road that faces it, and how far the other edge is."""
    out = side * (site.edge(index, side) + further)
    across = site.edge(index, 1.0) + site.edge(index, -1.0) + 2.0 * further
    return site.pose(index, out, side * (0.5 * math.pi + angle)), across / max(math.cos(angle), 0.2)


def walker(site: Site, *, vehicle: bool) -> None:
    """A walker steps onto the road from behind something that stands at its edge."""
    angle = site.number("crossing_angle", 0.0, -90.0, 90.0)
    side, index = site.side(), site.point(site.number("distance", 12.0, 0.0, 500.0), in_junction=True)
    body = (
        "compact"
        if vehicle or "vehicle" in site.word("blocker_model", "static.prop.vendingmachine")
        else "vending_machine"
    )
    half = 0.5 * (MODELS[body].length if body == "compact" else MODELS[body].width)
    aside = site.edge(index, side) + 0.5 * MODELS[body].width + 0.2
    there = min(index + math.ceil(half + 0.5), len(site.route.xy) - 1)
    pose, across = _from_side(site, there, side, 0.6, math.radians(angle))
    seconds = (2.15 if vehicle else 2.1) + 0.1 * math.floor(angle / 5.0)
    _crossing(site, "walker", "walker", pose, there, way=across, speed=2.0, seconds=seconds, least=6.0)
    turn = 0.0 if body == "compact" else 0.5 * math.pi
    site.add("car" if body == "compact" else "thing", body, site.pose(index, side * aside, turn))


def pedestrians(site: Site) -> None:
    """Three walkers cross before the junction, one shortly after another."""
    index = max(site.junction()[0] - 1, 1)
    for k, (ahead, aside) in enumerate(((0.4, 1.5), (1.0, 2.5), (1.6, 0.5))):
        pose, across = _from_side(site, index, 1.0, aside)
        pose = Pose(pose.x + ahead * math.cos(pose.yaw - RIGHT), pose.y + ahead * math.sin(pose.yaw - RIGHT), pose.yaw)
        idle, speed = float(site.random.uniform(0.0, 1.5)), float(site.random.uniform(1.3, 2.0))
        _crossing(
            site,
            f"walker {k}",
            "walker",
            pose,
            index,
            way=1.15 * across,
            speed=round(speed, 3),
            seconds=3.5,
            least=12.0,
            idle=round(idle, 3),
        )


def turning(site: Site, *, model: str) -> None:
    """Somebody crosses the road that the ego turns into."""
    enter, leave = site.junction()
    turn = float(np.unwrap(site.route.yaw[[max(enter - 1, 0), min(leave, len(site.route.yaw) - 1)]])[1])
    turn -= float(site.route.yaw[max(enter - 1, 0)])
    index = min(leave + (11 if model == "bicycle" else 1), len(site.route.xy) - 1)
    side = 1.0 if model == "bicycle" or turn > 0.0 else -1.0  # a walker comes from the outer side of the turn
    pose, across = _from_side(site, index, side, 1.0)
    seconds = 1.8 if model == "bicycle" else 2.2
    name = "cyclist" if model == "bicycle" else "walker"
    _crossing(site, name, model, pose, index, way=across, speed=1.8, seconds=seconds, least=6.0)


# ---------------------------------------------------------------- cars that cut in


def parking_cut_in(site: Site) -> None:
    """A car that is parked pulls out in front of the ego, from behind another one that stays."""
    side = site.side()
    for name, distance, seconds in (("parked car", 28.0, 0.0), ("adversary", 35.0, 2.35)):
        index = site.point(distance, in_junction=True)
        right = side * (site.edge(index, side, _LANES) + 0.5 * MODELS["compact"].width + 0.1)
        pose = site.pose(index, right)
        if not seconds:
            site.add(name, "compact", pose)
            continue
        phases = (Phase(20.0 * KMH, site.seconds_before(index, seconds, 10.0, pose)),)
        site.add(name, "compact", pose, phases, site.along(index, 1000.0, right, into=10.0))


def static_cut_in(site: Site) -> None:
    """One of a queue that stands in the next lane cuts in."""
    side, first = site.side(), site.number("distance", 100.0, 0.0, 500.0)
    for k in range(6):
        index = site.point(first + 11.0 * k, in_junction=True)
        lane = beside(site.graph, site.place(index), "right" if side > 0.0 else "left")
        if lane is None or site.graph.kind[lane.lane] not in (LaneType.DRIVING, LaneType.PARKING):
            raise site.fail("StaticCutIn needs a lane beside the ego's")
        pose, here = pose_at(site.graph, lane), site.pose(index)
        pose = Pose(pose.x, pose.y, here.yaw)
        if k != 2:
            site.add(f"standing car {k}", "compact", pose)
            continue
        right = side * math.dist((pose.x, pose.y), (here.x, here.y))
        phases = (Phase(60.0 * KMH, site.seconds_before(index, 2.7, 15.0, pose)),)
        site.add("adversary", "compact", pose, phases, site.along(index, 1000.0, right, into=9.0))


def highway_cut_in(site: Site) -> None:
    """A car comes from a ramp as the ego passes, and changes into its lane close ahead of it."""
    start = site.lane_at("other_actor_location")
    way = lane_path(site.graph, start, 400.0)
    own = site.route.xy.astype(np.float64)
    gap = np.hypot(*(way[:, None] - own[None]).transpose(2, 0, 1))
    near = np.flatnonzero((gap.min(1) < 5.0) & (gap.argmin(1) < len(own) - 2))
    steps = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(way, axis=0).T))])
    if not len(near):
        raise site.fail("the car of HighwayCutIn never comes beside the ego's way")
    meet, speed, body = int(near[0]), 0.8 * SPEED, MODELS["coupe"]
    begin = float(steps[meet]) + 5.0
    keep = steps < begin + 60.0
    way, steps = way[keep], steps[keep]
    at = gap[: len(way)].argmin(1)
    yaw = site.route.yaw[at]
    left = np.cos(yaw) * (own[at, 1] - way[:, 1]) - np.sin(yaw) * (own[at, 0] - way[:, 0])
    part = np.clip((steps - begin) / (2.0 * speed), 0.0, 1.0)
    way = site.offset(way, -left * 0.5 * (1.0 - np.cos(np.pi * part)))
    # it is 10 m ahead of the ego where both come together: soon enough, or as fast as it must be
    wanted, fast = site.arrival(max(int(at[meet]) - 10, 0)), SPEED
    while time_to_cover(begin, fast, body.max_accel) > wanted and fast < 25.0:
        fast += 0.1
    wait = int(at[meet]) - 10 - round(SPEED * time_to_cover(begin, fast, body.max_accel))
    pose = pose_at(site.graph, start)
    when = site.reaches(wait, pose) if wait > 10 else Condition("ego_speed", 0.5)
    phases = (Phase(round(fast, 3), when), Phase(speed, Condition("travelled", begin)))
    site.add("car from the ramp", body.name, pose, phases, way)


# ---------------------------------------------------------------- flows


def _flow_speed(site: Site, default: float) -> float:
    return site.number("flow_speed", default, 1.0, 40.0)


def _gaps(site: Site, default: tuple[float, float]) -> tuple[float, float]:
    return site.interval("source_dist_interval", default, 5.0, 1000.0)


def turn_flow(site: Site, *, sides: tuple[float, ...], signals: SignalPlan, back: float, on: float) -> None:
    """Cars go straight on through the junction in which the ego turns."""
    speed, gaps = _flow_speed(site, 20.0), _gaps(site, (25.0, 50.0))
    entry, inside = site.approach(sides)
    start = site.before_junction(entry, back * speed)
    way = site.way(start, site.beyond(entry, float(site.graph.length[inside]) + on * speed))
    site.signals = signals
    site.flow(way, gaps, speed)


def actor_flow(site: Site, *, lanes: bool = False, back: bool = False) -> None:
    """Cars go from one place of the file to another.

    Args:
        site: Where.
        lanes: Also in the lanes beside.
        back: Also the other way, in the lane to the left.
    """
    speed, gaps = _flow_speed(site, 10.0), _gaps(site, (20.0, 50.0))
    start, end = site.lane_at("start_actor_flow"), site.lane_at("end_actor_flow")
    site.flow(site.way(start, end), gaps, speed)
    site.target_speed = max(SPEED, min(speed, float(site.route.speed_limit[site.start])))
    for side in ("left", "right") if lanes else ():
        a, b = beside(site.graph, start, side), beside(site.graph, end, side)
        kind, same = site.graph.kind, site.graph.same_direction
        if a and b and kind[a.lane] == kind[b.lane] == LaneType.DRIVING and same(start.lane, a.lane):
            site.flow(site.way(a, b), gaps, speed)
    if back:
        a, b = beside(site.graph, end, "left"), beside(site.graph, start, "left")
        if a is None or b is None or LaneType.DRIVING not in (site.graph.kind[a.lane], site.graph.kind[b.lane]):
            raise site.fail(f"{site.item.get('type')} needs a lane for the second flow")
        site.flow(site.way(a, b), gaps, speed)


def bicycle_flow(site: Site) -> None:
    """Bicycles cross the road that the ego takes."""
    speed, gaps = min(_flow_speed(site, 10.0), 12.0), _gaps(site, (20.0, 50.0))
    start, end = site.lane_at("start_actor_flow"), site.lane_at("end_actor_flow")
    site.signals = SignalPlan("green", "red")
    site.flow(site.way(start, site.beyond(end, 40.0)), gaps, speed, models=("bicycle",))


def invading(site: Site) -> None:
    """Cars that come towards the ego drive partly in its lane, beside cones in their own."""
    distance, offset = site.number("distance", 100.0, 20.0, 500.0), site.number("offset", 0.25, -1.0, 1.5)
    far = site.point(distance + 30.0, in_junction=True)
    source, sink = site.oncoming(far), site.oncoming(site.start)
    for k in range(1 + math.ceil(0.1 * distance)):
        here = site.beyond(source, 15.0 + 5.0 * k)
        pose, width = pose_at(site.graph, here), float(site.graph.at(here.lane, here.s)[3])
        out = 0.4 * width
        site.add(f"cone {k}", "cone", Pose(pose.x + out * math.sin(pose.yaw), pose.y - out * math.cos(pose.yaw)))
    width = float(site.graph.at(sink.lane, sink.s)[3])
    way = site.offset(site.way(source, sink), -(offset + 0.5 * width - 0.7))
    site.flow(way, (40.0, 40.0), min(float(site.route.speed_limit[far]), SPEED), models=CARS)


# ---------------------------------------------------------------- single cars


def taking_priority(site: Site, *, signals: SignalPlan) -> None:
    """A car comes fast into the junction, from the side that the file names, as the ego does."""
    told = site.word("direction", "right", ("left", "right", "opposite"))
    side = {"left": LEFT, "right": RIGHT, "opposite": ONCOMING}[told]
    speed = 60.0 * KMH
    place = meeting_place(
        site.graph, site.scenario, site.route, sides=(side,), trigger_distance=35.0, speed=speed, body="coupe"
    )
    site.signals = signals
    when = Condition("ego_distance", 35.0, len(site.actors))
    way = lane_path(site.graph, place, 150.0)
    site.add("emergency car", "coupe", pose_at(site.graph, place), (Phase(speed, when),), way)


def emergency(site: Site) -> None:
    """A car comes from behind, 25 km/h faster than the ego, and wants to pass."""
    back = site.number("distance", 140.0, 10.0, 500.0)
    start = behind(site.graph, site.place(0), back)
    if site.apart(start, site.place(0)) < 8.0:
        raise site.fail("there is no road behind the ego")
    site.driver("emergency car", start, back + site.route.length + 50.0, SPEED + 25.0 * KMH)


def nobody(site: Site, *, signals: SignalPlan = SignalPlan()) -> None:  # noqa: B008  frozen
    """Only the ego takes part."""
    site.signals = signals


_GREEN, _OFF = SignalPlan("green", "green"), SignalPlan("off", "off")
_left_turn = partial(turn_flow, sides=(ONCOMING,), back=4.0, on=2.5)
_right_turn = partial(turn_flow, sides=(LEFT,), back=5.0, on=3.0)

TYPES: Final[Mapping[str, Play]] = {
    "Accident": partial(accident, two_ways=False),
    "AccidentTwoWays": partial(accident, two_ways=True),
    "BlockedIntersection": blocked,
    "ConstructionObstacle": partial(construction, two_ways=False),
    "ConstructionObstacleTwoWays": partial(construction, two_ways=True),
    "CrossingBicycleFlow": bicycle_flow,
    "DynamicObjectCrossing": partial(walker, vehicle=False),
    "EnterActorFlow": partial(actor_flow, lanes=True),
    "HardBreakRoute": hard_brake,
    "HazardAtSideLane": partial(bicycles, two_ways=False),
    "HazardAtSideLaneTwoWays": partial(bicycles, two_ways=True),
    "HighwayCutIn": highway_cut_in,
    "HighwayExit": actor_flow,
    "InterurbanActorFlow": actor_flow,
    "InterurbanAdvancedActorFlow": partial(actor_flow, back=True),
    "InvadingTurn": invading,
    "MergerIntoSlowTraffic": actor_flow,
    "MergerIntoSlowTrafficV2": actor_flow,
    "NonSignalizedJunctionLeftTurn": partial(_left_turn, signals=_OFF),
    "NonSignalizedJunctionLeftTurnEnterFlow": partial(_left_turn, signals=_OFF),
    "NonSignalizedJunctionRightTurn": partial(_right_turn, signals=_OFF),
    "OppositeVehicleRunningRedLight": partial(taking_priority, signals=SignalPlan("green", "red")),
    "OppositeVehicleTakingPriority": partial(taking_priority, signals=_OFF),
    "ParkedObstacle": partial(parked, two_ways=False),
    "ParkedObstacleTwoWays": partial(parked, two_ways=True),
    "ParkingCrossingPedestrian": partial(walker, vehicle=True),
    "ParkingCutIn": parking_cut_in,
    "PedestrianCrossing": pedestrians,
    "SequentialLaneChange": nobody,
    "SignalizedJunctionLeftTurn": partial(_left_turn, signals=_GREEN),
    "SignalizedJunctionLeftTurnEnterFlow": partial(_left_turn, signals=_GREEN),
    "SignalizedJunctionRightTurn": partial(_right_turn, signals=_GREEN),
    "StaticCutIn": static_cut_in,
    "T_Junction": nobody,
    "VanillaNonSignalizedTurn": nobody,
    "VanillaNonSignalizedTurnEncounterStopsign": nobody,
    "VanillaSignalizedTurnEncounterGreenLight": partial(nobody, signals=SignalPlan("green", "red")),
    "VanillaSignalizedTurnEncounterRedLight": partial(nobody, signals=SignalPlan("red", "green", until=15.0)),
    "VehicleTurningRoute": partial(turning, model="bicycle"),
    "VehicleTurningRoutePedestrian": partial(turning, model="walker"),
    "YieldToEmergencyVehicle": emergency,
}
"""Type of leaderboard 2.0 or Bench2Drive -> what puts its actors in their places."""

UNPLAYED: Final[Mapping[str, str]] = {
    "ControlLoss": "it disturbs the ego's own controls, which is no matter of a scenario here",
    "ParkingExit": "the ego would start beside the road, and here it starts on its route",
    "VehicleOpensDoorTwoWays": "no vehicle here has doors",
}
"""The types of Bench2Drive that are not played, and why."""
