"""The scenario types of leaderboard 2.0 and Bench2Drive: actors, triggers, and order of events.

Each function adds the actors of a type to a `ScenarioBuilder`. Facts (places, speeds, seconds): the documentation and
sources of ScenarioRunner 0.9.15 (MIT) and, for the types that Bench2Drive adds, its list of scenarios.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Final

import numpy as np

from ssad.core.types import LaneType, Phase, PhaseTrigger, Pose, SignalPlan
from ssad.interchange.leaderboard_site import CARS, SPEED, ScenarioBuilder
from ssad.scenarios.dynamic.knowledge._meeting import meeting_place, time_to_cover
from ssad.scenarios.dynamic.knowledge._placing import adjacent_place, lane_path, place_behind, pose_at
from ssad.world.models import MODELS

Play = Callable[[ScenarioBuilder], None]
ONCOMING: Final = math.pi
LEFT: Final = -0.5 * math.pi  # rad; a car from the left is headed to the right
RIGHT: Final = 0.5 * math.pi
KMH: Final = 1.0 / 3.6
_LANES = (LaneType.DRIVING, LaneType.BIKING)


# ---------------------------------------------------------------- obstacles and standing cars


def _add_warning_cone(site: ScenarioBuilder) -> None:
    """Add the warning of an obstacle: a cone beside the road where the scenario starts."""
    side = site.side()
    site.add("warning", "cone", site.pose(site.start, side * (site.edge_distance(site.start, side) + 0.6)))


def add_accident(site: ScenarioBuilder, *, two_ways: bool) -> None:
    """Add a police car and two crashed cars that stand in the lane."""
    _add_warning_cone(site)
    distance, side = site.number("distance", 120.0, 0.0, 500.0), site.side()
    accident_point = site.point(distance)
    for name, offset in (("police car", 0.0), ("first car", 10.0), ("second car", 16.0)):
        index = site.point(distance + offset)
        lateral_offset = side * 0.3 * site.width(index)
        site.add(name, "car" if name == "police car" else "compact", site.pose(index, lateral_offset))
    if two_ways:
        site.add_oncoming_cars(accident_point, site.interval("frequency", (20.0, 100.0), 8.0, 1000.0))


def add_parked_car(site: ScenarioBuilder, *, two_ways: bool) -> None:
    """Add a car that stands in the lane."""
    _add_warning_cone(site)
    index = site.point(site.number("distance", 120.0, 0.0, 500.0))
    site.add("parked car", site.draw_car_model(), site.pose(index, site.side() * 0.35 * site.width(index)))
    if two_ways:
        site.add_oncoming_cars(index, site.interval("frequency", (20.0, 100.0), 8.0, 1000.0))


def add_construction_site(site: ScenarioBuilder, *, two_ways: bool) -> None:
    """Add a sign and cones that close the lane."""
    _add_warning_cone(site)
    side = site.side()
    index = site.point(site.number("distance", 100.0, 0.0, 500.0), in_junction=True)
    site.add("sign", "barrier", site.pose(max(index - 5, 0), 0.0, 0.5 * math.pi))
    half_width = 0.425 * site.width(index)
    for cone_index, lateral_offset in enumerate(
        [*(-half_width * side,) * 5, *(side * half_width * width_share for width_share in (-0.3, 0.3, 1.0))]
    ):
        cone_point = index + min(2 * cone_index, 8)
        site.add(f"cone {cone_index}", "cone", site.pose(min(cone_point, len(site.route.xy) - 1), lateral_offset))
    if two_ways:
        site.add_oncoming_cars(index, site.interval("frequency", (20.0, 100.0), 8.0, 1000.0))


def add_bicycles(site: ScenarioBuilder, *, two_ways: bool) -> None:
    """Add two slow bicycles at the edge of the lane: they start when the ego passes the trigger, and then stop."""
    distance, ride_distance = (
        site.number("distance", 100.0, 0.0, 500.0),
        site.number("bicycle_drive_distance", 50.0, 1.0, 500.0),
    )
    speed = site.number("bicycle_speed", 10.0, 1.0, 40.0) * KMH  # the leaderboard gives it in km/h
    for cyclist_index, offset in enumerate((0.0, 9.0)):
        index = site.point(distance + offset)
        lateral_offset = 0.275 * site.width(index)
        pose = site.pose(index, lateral_offset)
        phases = (
            Phase(speed, site.ego_reaches(site.start, pose)),
            Phase(0.0, PhaseTrigger("travelled", ride_distance)),
        )
        site.add(
            f"cyclist {cyclist_index}",
            "bicycle",
            pose,
            phases,
            site.parallel_path(index, ride_distance + 10.0, lateral_offset),
        )
    if two_ways:
        site.add_oncoming_cars(site.point(distance), site.interval("frequency", (100.0, 100.0), 8.0, 1000.0))


def add_blocking_car(site: ScenarioBuilder) -> None:
    """Add a car that stands at the exit of the junction, and leaves 10 s after the ego has reached the junction.

    In the leaderboard the 10 s begin when the ego is within 13 m of the car; an ego that waits before the
    junction never comes that close.
    """
    entry_point, exit_point = site.junction()
    index = min(exit_point + 5, len(site.route.xy) - 3)
    pose = site.pose(index)
    site.signals = SignalPlan("green", "red")
    arrival = site.ego_reaches(entry_point - 12, pose)  # an ego that waits for a free exit comes no further
    site.add(
        "stopped car",
        site.draw_car_model(),
        pose,
        (Phase(0.0, arrival), Phase(SPEED, PhaseTrigger("after", 10.0))),
        lane_path(site.graph, site.place(index), 120.0),
    )


def add_braking_car(site: ScenarioBuilder) -> None:
    """Add a car ahead that drives like the ego, brakes hard as the ego passes the trigger, and leaves after 10 s."""
    index = min(14, len(site.route.xy) - 3)
    brake_distance = max(10.0, site.start * site.route.spacing)
    stop, restart = Phase(0.0, PhaseTrigger("travelled", brake_distance)), Phase(SPEED, PhaseTrigger("after", 10.0))
    phases = (Phase(SPEED, PhaseTrigger("ego_speed", 0.5)), stop, restart)
    site.add("car ahead", site.draw_car_model(), site.pose(index), phases, site.parallel_path(index, 1000.0, 0.0))


# ---------------------------------------------------------------- people and bicycles that cross


def _add_crossing_actor(
    site: ScenarioBuilder,
    name: str,
    model: str,
    pose: Pose,
    index: int,
    *,
    way: float,
    speed: float,
    seconds: float,
    min_distance: float,
    delay: float = 0.0,
) -> None:
    """Somebody who goes straight across `delay` s after the ego is near route point `index`; stops behind the road."""
    trigger, final_stop = (
        site.ego_is_seconds_before(index, seconds, min_distance, pose),
        Phase(0.0, PhaseTrigger("travelled", way)),
    )
    start_phases = (
        (Phase(0.0, trigger), Phase(speed, PhaseTrigger("after", delay))) if delay else (Phase(speed, trigger),)
    )
    site.add(name, model, pose, (*start_phases, final_stop))


def _roadside_pose(
    site: ScenarioBuilder, index: int, side: float, extra_distance: float, angle: float = 0.0
) -> tuple[Pose, float]:
    """A pose beside the road that faces it, and how far the other edge is."""
    lateral_offset = side * (site.edge_distance(index, side) + extra_distance)
    road_width = site.edge_distance(index, 1.0) + site.edge_distance(index, -1.0) + 2.0 * extra_distance
    return site.pose(index, lateral_offset, side * (0.5 * math.pi + angle)), road_width / max(math.cos(angle), 0.2)


def add_walker(site: ScenarioBuilder, *, vehicle: bool) -> None:
    """Add a walker that steps onto the road from behind an obstacle at its edge."""
    angle = site.number("crossing_angle", 0.0, -90.0, 90.0)
    side, index = site.side(), site.point(site.number("distance", 12.0, 0.0, 500.0), in_junction=True)
    blocker = (
        "compact"
        if vehicle or "vehicle" in site.word("blocker_model", "static.prop.vendingmachine")
        else "vending_machine"
    )
    half_length = 0.5 * (MODELS[blocker].length if blocker == "compact" else MODELS[blocker].width)
    lateral_offset = site.edge_distance(index, side) + 0.5 * MODELS[blocker].width + 0.2
    walker_point = min(index + math.ceil(half_length + 0.5), len(site.route.xy) - 1)
    pose, crossing_distance = _roadside_pose(site, walker_point, side, 0.6, math.radians(angle))
    seconds = (2.15 if vehicle else 2.1) + 0.1 * math.floor(angle / 5.0)
    _add_crossing_actor(
        site,
        "walker",
        "walker",
        pose,
        walker_point,
        way=crossing_distance,
        speed=2.0,
        seconds=seconds,
        min_distance=6.0,
    )
    blocker_turn = 0.0 if blocker == "compact" else 0.5 * math.pi
    site.add("car" if blocker == "compact" else "thing", blocker, site.pose(index, side * lateral_offset, blocker_turn))


def add_pedestrians(site: ScenarioBuilder) -> None:
    """Add three walkers that cross before the junction, one shortly after another."""
    index = max(site.junction()[0] - 1, 1)
    for walker_index, (forward_offset, margin) in enumerate(((0.4, 1.5), (1.0, 2.5), (1.6, 0.5))):
        pose, crossing_distance = _roadside_pose(site, index, 1.0, margin)
        pose = Pose(
            pose.x + forward_offset * math.cos(pose.yaw - RIGHT),
            pose.y + forward_offset * math.sin(pose.yaw - RIGHT),
            pose.yaw,
        )
        idle, speed = float(site.random.uniform(0.0, 1.5)), float(site.random.uniform(1.3, 2.0))
        _add_crossing_actor(
            site,
            f"walker {walker_index}",
            "walker",
            pose,
            index,
            way=1.15 * crossing_distance,
            speed=round(speed, 3),
            seconds=3.5,
            min_distance=12.0,
            delay=round(idle, 3),
        )


def add_crossing_agent(site: ScenarioBuilder, *, model: str) -> None:
    """Add an agent that crosses the road into which the ego turns."""
    entry_point, exit_point = site.junction()
    turn = float(np.unwrap(site.route.yaw[[max(entry_point - 1, 0), min(exit_point, len(site.route.yaw) - 1)]])[1])
    turn -= float(site.route.yaw[max(entry_point - 1, 0)])
    index = min(exit_point + (11 if model == "bicycle" else 1), len(site.route.xy) - 1)
    side = 1.0 if model == "bicycle" or turn > 0.0 else -1.0  # a walker comes from the outer side of the turn
    pose, crossing_distance = _roadside_pose(site, index, side, 1.0)
    seconds = 1.8 if model == "bicycle" else 2.2
    name = "cyclist" if model == "bicycle" else "walker"
    _add_crossing_actor(
        site, name, model, pose, index, way=crossing_distance, speed=1.8, seconds=seconds, min_distance=6.0
    )


# ---------------------------------------------------------------- cars that cut in


def add_parking_cut_in(site: ScenarioBuilder) -> None:
    """Add a parked car that pulls out in front of the ego from behind another parked car."""
    side = site.side()
    for name, distance, seconds in (("parked car", 28.0, 0.0), ("adversary", 35.0, 2.35)):
        index = site.point(distance, in_junction=True)
        lateral_offset = side * (site.edge_distance(index, side, _LANES) + 0.5 * MODELS["compact"].width + 0.1)
        pose = site.pose(index, lateral_offset)
        if not seconds:
            site.add(name, "compact", pose)
            continue
        phases = (Phase(20.0 * KMH, site.ego_is_seconds_before(index, seconds, 10.0, pose)),)
        site.add(name, "compact", pose, phases, site.parallel_path(index, 1000.0, lateral_offset, into=10.0))


def add_static_cut_in(site: ScenarioBuilder) -> None:
    """Add a queue that stands in the next lane; one car of it cuts in."""
    side, first_distance = site.side(), site.number("distance", 100.0, 0.0, 500.0)
    for car_index in range(6):
        index = site.point(first_distance + 11.0 * car_index, in_junction=True)
        neighbour_lane = adjacent_place(site.graph, site.place(index), "right" if side > 0.0 else "left")
        if neighbour_lane is None or site.graph.kind[neighbour_lane.lane] not in (LaneType.DRIVING, LaneType.PARKING):
            raise site.error("StaticCutIn needs a lane beside the ego's")
        pose, route_pose = pose_at(site.graph, neighbour_lane), site.pose(index)
        pose = Pose(pose.x, pose.y, route_pose.yaw)
        if car_index != 2:
            site.add(f"standing car {car_index}", "compact", pose)
            continue
        lateral_offset = side * math.dist((pose.x, pose.y), (route_pose.x, route_pose.y))
        phases = (Phase(60.0 * KMH, site.ego_is_seconds_before(index, 2.7, 15.0, pose)),)
        site.add("adversary", "compact", pose, phases, site.parallel_path(index, 1000.0, lateral_offset, into=9.0))


def add_highway_cut_in(site: ScenarioBuilder) -> None:
    """Add a car that comes from a ramp as the ego passes, and changes into its lane close ahead of it."""
    start = site.lane_at("other_actor_location")
    car_path = lane_path(site.graph, start, 400.0)
    ego_path = site.route.xy.astype(np.float64)
    distances = np.hypot(*(car_path[:, None] - ego_path[None]).transpose(2, 0, 1))
    meeting_indices = np.flatnonzero((distances.min(1) < 5.0) & (distances.argmin(1) < len(ego_path) - 2))
    path_distances = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(car_path, axis=0).T))])
    if not len(meeting_indices):
        raise site.error("the car of HighwayCutIn never comes beside the ego's way")
    meeting_index, speed, car_model = int(meeting_indices[0]), 0.8 * SPEED, MODELS["coupe"]
    change_start = float(path_distances[meeting_index]) + 5.0
    is_kept = path_distances < change_start + 60.0
    car_path, path_distances = car_path[is_kept], path_distances[is_kept]
    nearest_points = distances[: len(car_path)].argmin(1)
    route_headings = site.route.yaw[nearest_points]
    lateral_offsets = np.cos(route_headings) * (ego_path[nearest_points, 1] - car_path[:, 1]) - np.sin(
        route_headings
    ) * (ego_path[nearest_points, 0] - car_path[:, 0])
    change_share = np.clip((path_distances - change_start) / (2.0 * speed), 0.0, 1.0)
    car_path = site.offset_path(car_path, -lateral_offsets * 0.5 * (1.0 - np.cos(np.pi * change_share)))
    # it must be 10 m ahead of the ego where both paths meet: it starts early enough, or drives faster
    ego_arrival, approach_speed = site.arrival_time(max(int(nearest_points[meeting_index]) - 10, 0)), SPEED
    while time_to_cover(change_start, approach_speed, car_model.max_accel) > ego_arrival and approach_speed < 25.0:
        approach_speed += 0.1
    waiting_point = (
        int(nearest_points[meeting_index])
        - 10
        - round(SPEED * time_to_cover(change_start, approach_speed, car_model.max_accel))
    )
    pose = pose_at(site.graph, start)
    start_condition = site.ego_reaches(waiting_point, pose) if waiting_point > 10 else PhaseTrigger("ego_speed", 0.5)
    phases = (Phase(round(approach_speed, 3), start_condition), Phase(speed, PhaseTrigger("travelled", change_start)))
    site.add("car from the ramp", car_model.name, pose, phases, car_path)


# ---------------------------------------------------------------- flows


def _flow_speed(site: ScenarioBuilder, default: float) -> float:
    return site.number("flow_speed", default, 1.0, 40.0)


def _gaps(site: ScenarioBuilder, default: tuple[float, float]) -> tuple[float, float]:
    return site.interval("source_dist_interval", default, 5.0, 1000.0)


def add_turn_flow(
    site: ScenarioBuilder, *, sides: tuple[float, ...], signals: SignalPlan, back: float, on: float
) -> None:
    """Cars go straight on through the junction in which the ego turns."""
    speed, gaps = _flow_speed(site, 20.0), _gaps(site, (25.0, 50.0))
    entry_place, junction_lane = site.approach(sides)
    start = site.before_junction(entry_place, back * speed)
    flow_path = site.path_between(
        start, site.place_ahead(entry_place, float(site.graph.length[junction_lane]) + on * speed)
    )
    site.signals = signals
    site.add_flow(flow_path, gaps, speed)


def add_actor_flow(site: ScenarioBuilder, *, lanes: bool = False, back: bool = False) -> None:
    """Cars go from one place of the file to another.

    Args:
        site: Where.
        lanes: Also in the lanes beside.
        back: Also the other way, in the lane to the left.
    """
    speed, gaps = _flow_speed(site, 10.0), _gaps(site, (20.0, 50.0))
    start, end = site.lane_at("start_actor_flow"), site.lane_at("end_actor_flow")
    site.add_flow(site.path_between(start, end), gaps, speed)
    site.target_speed = max(SPEED, min(speed, float(site.route.speed_limit[site.start])))
    for side in ("left", "right") if lanes else ():
        flow_start, flow_end = adjacent_place(site.graph, start, side), adjacent_place(site.graph, end, side)
        lane_kinds, same_direction = site.graph.kind, site.graph.is_same_direction
        if (
            flow_start
            and flow_end
            and lane_kinds[flow_start.lane] == lane_kinds[flow_end.lane] == LaneType.DRIVING
            and same_direction(start.lane, flow_start.lane)
        ):
            site.add_flow(site.path_between(flow_start, flow_end), gaps, speed)
    if back:
        flow_start, flow_end = adjacent_place(site.graph, end, "left"), adjacent_place(site.graph, start, "left")
        if (
            flow_start is None
            or flow_end is None
            or LaneType.DRIVING not in (site.graph.kind[flow_start.lane], site.graph.kind[flow_end.lane])
        ):
            raise site.error(f"{site.item.get('type')} needs a lane for the second flow")
        site.add_flow(site.path_between(flow_start, flow_end), gaps, speed)


def add_bicycle_flow(site: ScenarioBuilder) -> None:
    """Add bicycles that cross the road of the ego."""
    speed, gaps = min(_flow_speed(site, 10.0), 12.0), _gaps(site, (20.0, 50.0))
    start, end = site.lane_at("start_actor_flow"), site.lane_at("end_actor_flow")
    site.signals = SignalPlan("green", "red")
    site.add_flow(site.path_between(start, site.place_ahead(end, 40.0)), gaps, speed, models=("bicycle",))


def add_invading_cars(site: ScenarioBuilder) -> None:
    """Add oncoming cars that drive partly in the ego's lane, beside cones in their own."""
    distance, offset = site.number("distance", 100.0, 20.0, 500.0), site.number("offset", 0.25, -1.0, 1.5)
    far_point = site.point(distance + 30.0, in_junction=True)
    flow_start, flow_end = site.oncoming_lane(far_point), site.oncoming_lane(site.start)
    for cone_index in range(1 + math.ceil(0.1 * distance)):
        cone_place = site.place_ahead(flow_start, 15.0 + 5.0 * cone_index)
        pose, lane_width = pose_at(site.graph, cone_place), float(site.graph.at(cone_place.lane, cone_place.s)[3])
        cone_offset = 0.4 * lane_width
        site.add(
            f"cone {cone_index}",
            "cone",
            Pose(pose.x + cone_offset * math.sin(pose.yaw), pose.y - cone_offset * math.cos(pose.yaw)),
        )
    lane_width = float(site.graph.at(flow_end.lane, flow_end.s)[3])
    flow_path = site.offset_path(site.path_between(flow_start, flow_end), -(offset + 0.5 * lane_width - 0.7))
    site.add_flow(flow_path, (40.0, 40.0), min(float(site.route.speed_limit[far_point]), SPEED), models=CARS)


# ---------------------------------------------------------------- single cars


def add_priority_violator(site: ScenarioBuilder, *, signals: SignalPlan) -> None:
    """Add a car that enters the junction fast, from the side that the file names, at the same time as the ego."""
    direction = site.word("direction", "right", ("left", "right", "opposite"))
    side = {"left": LEFT, "right": RIGHT, "opposite": ONCOMING}[direction]
    speed = 60.0 * KMH
    place = meeting_place(
        site.graph, site.scenario, site.route, sides=(side,), trigger_distance=35.0, speed=speed, body="coupe"
    )
    site.signals = signals
    start_condition = PhaseTrigger("ego_distance", 35.0, len(site.actors))
    car_path = lane_path(site.graph, place, 150.0)
    site.add("emergency car", "coupe", pose_at(site.graph, place), (Phase(speed, start_condition),), car_path)


def add_emergency_car(site: ScenarioBuilder) -> None:
    """Add a car that comes from behind, 25 km/h faster than the ego, and wants to pass."""
    start_distance = site.number("distance", 140.0, 10.0, 500.0)
    start = place_behind(site.graph, site.place(0), start_distance)
    if site.distance_between(start, site.place(0)) < 8.0:
        raise site.error("there is no road behind the ego")
    site.add_driver("emergency car", start, start_distance + site.route.length + 50.0, SPEED + 25.0 * KMH)


def add_no_actors(site: ScenarioBuilder, *, signals: SignalPlan = SignalPlan()) -> None:  # noqa: B008  frozen
    """Add no actors: the ego is alone."""
    site.signals = signals


_GREEN, _OFF = SignalPlan("green", "green"), SignalPlan("off", "off")
_left_turn = partial(add_turn_flow, sides=(ONCOMING,), back=4.0, on=2.5)
_right_turn = partial(add_turn_flow, sides=(LEFT,), back=5.0, on=3.0)

TYPES: Final[Mapping[str, Play]] = {
    "Accident": partial(add_accident, two_ways=False),
    "AccidentTwoWays": partial(add_accident, two_ways=True),
    "BlockedIntersection": add_blocking_car,
    "ConstructionObstacle": partial(add_construction_site, two_ways=False),
    "ConstructionObstacleTwoWays": partial(add_construction_site, two_ways=True),
    "CrossingBicycleFlow": add_bicycle_flow,
    "DynamicObjectCrossing": partial(add_walker, vehicle=False),
    "EnterActorFlow": partial(add_actor_flow, lanes=True),
    "HardBreakRoute": add_braking_car,
    "HazardAtSideLane": partial(add_bicycles, two_ways=False),
    "HazardAtSideLaneTwoWays": partial(add_bicycles, two_ways=True),
    "HighwayCutIn": add_highway_cut_in,
    "HighwayExit": add_actor_flow,
    "InterurbanActorFlow": add_actor_flow,
    "InterurbanAdvancedActorFlow": partial(add_actor_flow, back=True),
    "InvadingTurn": add_invading_cars,
    "MergerIntoSlowTraffic": add_actor_flow,
    "MergerIntoSlowTrafficV2": add_actor_flow,
    "NonSignalizedJunctionLeftTurn": partial(_left_turn, signals=_OFF),
    "NonSignalizedJunctionLeftTurnEnterFlow": partial(_left_turn, signals=_OFF),
    "NonSignalizedJunctionRightTurn": partial(_right_turn, signals=_OFF),
    "OppositeVehicleRunningRedLight": partial(add_priority_violator, signals=SignalPlan("green", "red")),
    "OppositeVehicleTakingPriority": partial(add_priority_violator, signals=_OFF),
    "ParkedObstacle": partial(add_parked_car, two_ways=False),
    "ParkedObstacleTwoWays": partial(add_parked_car, two_ways=True),
    "ParkingCrossingPedestrian": partial(add_walker, vehicle=True),
    "ParkingCutIn": add_parking_cut_in,
    "PedestrianCrossing": add_pedestrians,
    "SequentialLaneChange": add_no_actors,
    "SignalizedJunctionLeftTurn": partial(_left_turn, signals=_GREEN),
    "SignalizedJunctionLeftTurnEnterFlow": partial(_left_turn, signals=_GREEN),
    "SignalizedJunctionRightTurn": partial(_right_turn, signals=_GREEN),
    "StaticCutIn": add_static_cut_in,
    "T_Junction": add_no_actors,
    "VanillaNonSignalizedTurn": add_no_actors,
    "VanillaNonSignalizedTurnEncounterStopsign": add_no_actors,
    "VanillaSignalizedTurnEncounterGreenLight": partial(add_no_actors, signals=SignalPlan("green", "red")),
    "VanillaSignalizedTurnEncounterRedLight": partial(add_no_actors, signals=SignalPlan("red", "green", until=15.0)),
    "VehicleTurningRoute": partial(add_crossing_agent, model="bicycle"),
    "VehicleTurningRoutePedestrian": partial(add_crossing_agent, model="walker"),
    "YieldToEmergencyVehicle": add_emergency_car,
}
"""Type of leaderboard 2.0 or Bench2Drive -> what puts its actors in their places."""

UNPLAYED: Final[Mapping[str, str]] = {
    "ControlLoss": "it disturbs the ego's own controls, which is no matter of a scenario here",
    "ParkingExit": "the ego would start beside the road, and here it starts on its route",
    "VehicleOpensDoorTwoWays": "no vehicle here has doors",
}
"""The types of Bench2Drive that are not played, and why."""
