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


def _add_warning_cone(builder: ScenarioBuilder) -> None:
    """Add the warning of an obstacle: a cone beside the road where the scenario starts."""
    side = builder.side()
    builder.add(
        "warning", "cone", builder.pose(builder.start, side * (builder.edge_distance(builder.start, side) + 0.6))
    )


def add_accident(builder: ScenarioBuilder, *, two_ways: bool) -> None:
    """Add a police car and two crashed cars that stand in the lane."""
    _add_warning_cone(builder)
    distance, side = builder.number("distance", 120.0, 0.0, 500.0), builder.side()
    accident_point = builder.point(distance)
    for name, offset in (("police car", 0.0), ("first car", 10.0), ("second car", 16.0)):
        index = builder.point(distance + offset)
        lateral_offset = side * 0.3 * builder.width(index)
        builder.add(name, "car" if name == "police car" else "compact", builder.pose(index, lateral_offset))
    if two_ways:
        builder.add_oncoming_cars(accident_point, builder.interval("frequency", (20.0, 100.0), 8.0, 1000.0))


def add_parked_car(builder: ScenarioBuilder, *, two_ways: bool) -> None:
    """Add a car that stands in the lane."""
    _add_warning_cone(builder)
    index = builder.point(builder.number("distance", 120.0, 0.0, 500.0))
    builder.add(
        "parked car", builder.draw_car_model(), builder.pose(index, builder.side() * 0.35 * builder.width(index))
    )
    if two_ways:
        builder.add_oncoming_cars(index, builder.interval("frequency", (20.0, 100.0), 8.0, 1000.0))


def add_construction_site(builder: ScenarioBuilder, *, two_ways: bool) -> None:
    """Add a sign and cones that close the lane."""
    _add_warning_cone(builder)
    side = builder.side()
    index = builder.point(builder.number("distance", 100.0, 0.0, 500.0), in_junction=True)
    builder.add("sign", "barrier", builder.pose(max(index - 5, 0), 0.0, 0.5 * math.pi))
    half_width = 0.425 * builder.width(index)
    for cone_index, lateral_offset in enumerate(
        [*(-half_width * side,) * 5, *(side * half_width * width_share for width_share in (-0.3, 0.3, 1.0))]
    ):
        cone_point = index + min(2 * cone_index, 8)
        builder.add(
            f"cone {cone_index}", "cone", builder.pose(min(cone_point, len(builder.route.xy) - 1), lateral_offset)
        )
    if two_ways:
        builder.add_oncoming_cars(index, builder.interval("frequency", (20.0, 100.0), 8.0, 1000.0))


def add_bicycles(builder: ScenarioBuilder, *, two_ways: bool) -> None:
    """Add two slow bicycles at the edge of the lane: they start when the ego passes the trigger, and then stop."""
    distance, ride_distance = (
        builder.number("distance", 100.0, 0.0, 500.0),
        builder.number("bicycle_drive_distance", 50.0, 1.0, 500.0),
    )
    speed = builder.number("bicycle_speed", 10.0, 1.0, 40.0) * KMH  # the leaderboard gives it in km/h
    for cyclist_index, offset in enumerate((0.0, 9.0)):
        index = builder.point(distance + offset)
        lateral_offset = 0.275 * builder.width(index)
        pose = builder.pose(index, lateral_offset)
        phases = (
            Phase(speed, builder.ego_reaches(builder.start, pose)),
            Phase(0.0, PhaseTrigger("travelled", ride_distance)),
        )
        builder.add(
            f"cyclist {cyclist_index}",
            "bicycle",
            pose,
            phases,
            builder.parallel_path(index, ride_distance + 10.0, lateral_offset),
        )
    if two_ways:
        builder.add_oncoming_cars(builder.point(distance), builder.interval("frequency", (100.0, 100.0), 8.0, 1000.0))


def add_blocking_car(builder: ScenarioBuilder) -> None:
    """Add a car that stands at the exit of the junction, and leaves 10 s after the ego has reached the junction.

    In the leaderboard the 10 s begin when the ego is within 13 m of the car; an ego that waits before the
    junction never comes that close.
    """
    entry_point, exit_point = builder.junction()
    index = min(exit_point + 5, len(builder.route.xy) - 3)
    pose = builder.pose(index)
    builder.signals = SignalPlan("green", "red")
    arrival = builder.ego_reaches(entry_point - 12, pose)  # an ego that waits for a free exit comes no further
    builder.add(
        "stopped car",
        builder.draw_car_model(),
        pose,
        (Phase(0.0, arrival), Phase(SPEED, PhaseTrigger("after", 10.0))),
        lane_path(builder.graph, builder.place(index), 120.0),
    )


def add_braking_car(builder: ScenarioBuilder) -> None:
    """Add a car ahead that drives like the ego, brakes hard as the ego passes the trigger, and leaves after 10 s."""
    index = min(14, len(builder.route.xy) - 3)
    brake_distance = max(10.0, builder.start * builder.route.spacing)
    stop, restart = Phase(0.0, PhaseTrigger("travelled", brake_distance)), Phase(SPEED, PhaseTrigger("after", 10.0))
    phases = (Phase(SPEED, PhaseTrigger("ego_speed", 0.5)), stop, restart)
    builder.add(
        "car ahead", builder.draw_car_model(), builder.pose(index), phases, builder.parallel_path(index, 1000.0, 0.0)
    )


# ---------------------------------------------------------------- people and bicycles that cross


def _add_crossing_actor(
    builder: ScenarioBuilder,
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
        builder.ego_is_seconds_before(index, seconds, min_distance, pose),
        Phase(0.0, PhaseTrigger("travelled", way)),
    )
    start_phases = (
        (Phase(0.0, trigger), Phase(speed, PhaseTrigger("after", delay))) if delay else (Phase(speed, trigger),)
    )
    builder.add(name, model, pose, (*start_phases, final_stop))


def _roadside_pose(
    builder: ScenarioBuilder, index: int, side: float, extra_distance: float, angle: float = 0.0
) -> tuple[Pose, float]:
    """A pose beside the road that faces it, and how far the other edge is."""
    lateral_offset = side * (builder.edge_distance(index, side) + extra_distance)
    road_width = builder.edge_distance(index, 1.0) + builder.edge_distance(index, -1.0) + 2.0 * extra_distance
    return builder.pose(index, lateral_offset, side * (0.5 * math.pi + angle)), road_width / max(math.cos(angle), 0.2)


def add_walker(builder: ScenarioBuilder, *, vehicle: bool) -> None:
    """Add a walker that steps onto the road from behind an obstacle at its edge."""
    angle = builder.number("crossing_angle", 0.0, -90.0, 90.0)
    side, index = builder.side(), builder.point(builder.number("distance", 12.0, 0.0, 500.0), in_junction=True)
    blocker = (
        "compact"
        if vehicle or "vehicle" in builder.word("blocker_model", "static.prop.vendingmachine")
        else "vending_machine"
    )
    half_length = 0.5 * (MODELS[blocker].length if blocker == "compact" else MODELS[blocker].width)
    lateral_offset = builder.edge_distance(index, side) + 0.5 * MODELS[blocker].width + 0.2
    walker_point = min(index + math.ceil(half_length + 0.5), len(builder.route.xy) - 1)
    pose, crossing_distance = _roadside_pose(builder, walker_point, side, 0.6, math.radians(angle))
    seconds = (2.15 if vehicle else 2.1) + 0.1 * math.floor(angle / 5.0)
    _add_crossing_actor(
        builder,
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
    builder.add(
        "car" if blocker == "compact" else "thing", blocker, builder.pose(index, side * lateral_offset, blocker_turn)
    )


def add_pedestrians(builder: ScenarioBuilder) -> None:
    """Add three walkers that cross before the junction, one shortly after another."""
    index = max(builder.junction()[0] - 1, 1)
    for walker_index, (forward_offset, margin) in enumerate(((0.4, 1.5), (1.0, 2.5), (1.6, 0.5))):
        pose, crossing_distance = _roadside_pose(builder, index, 1.0, margin)
        pose = Pose(
            pose.x + forward_offset * math.cos(pose.yaw - RIGHT),
            pose.y + forward_offset * math.sin(pose.yaw - RIGHT),
            pose.yaw,
        )
        start_delay, speed = float(builder.random.uniform(0.0, 1.5)), float(builder.random.uniform(1.3, 2.0))
        _add_crossing_actor(
            builder,
            f"walker {walker_index}",
            "walker",
            pose,
            index,
            way=1.15 * crossing_distance,
            speed=round(speed, 3),
            seconds=3.5,
            min_distance=12.0,
            delay=round(start_delay, 3),
        )


def add_crossing_agent(builder: ScenarioBuilder, *, model: str) -> None:
    """Add an agent that crosses the road into which the ego turns."""
    entry_point, exit_point = builder.junction()
    turn = float(
        np.unwrap(builder.route.yaw[[max(entry_point - 1, 0), min(exit_point, len(builder.route.yaw) - 1)]])[1]
    )
    turn -= float(builder.route.yaw[max(entry_point - 1, 0)])
    index = min(exit_point + (11 if model == "bicycle" else 1), len(builder.route.xy) - 1)
    side = 1.0 if model == "bicycle" or turn > 0.0 else -1.0  # a walker comes from the outer side of the turn
    pose, crossing_distance = _roadside_pose(builder, index, side, 1.0)
    seconds = 1.8 if model == "bicycle" else 2.2
    name = "cyclist" if model == "bicycle" else "walker"
    _add_crossing_actor(
        builder, name, model, pose, index, way=crossing_distance, speed=1.8, seconds=seconds, min_distance=6.0
    )


# ---------------------------------------------------------------- cars that cut in


def add_parking_cut_in(builder: ScenarioBuilder) -> None:
    """Add a parked car that pulls out in front of the ego from behind another parked car."""
    side = builder.side()
    for name, distance, seconds in (("parked car", 28.0, 0.0), ("adversary", 35.0, 2.35)):
        index = builder.point(distance, in_junction=True)
        lateral_offset = side * (builder.edge_distance(index, side, _LANES) + 0.5 * MODELS["compact"].width + 0.1)
        pose = builder.pose(index, lateral_offset)
        if not seconds:
            builder.add(name, "compact", pose)
            continue
        phases = (Phase(20.0 * KMH, builder.ego_is_seconds_before(index, seconds, 10.0, pose)),)
        builder.add(name, "compact", pose, phases, builder.parallel_path(index, 1000.0, lateral_offset, into=10.0))


def add_static_cut_in(builder: ScenarioBuilder) -> None:
    """Add a queue that stands in the next lane; one car of it cuts in."""
    side, first_distance = builder.side(), builder.number("distance", 100.0, 0.0, 500.0)
    for car_index in range(6):
        index = builder.point(first_distance + 11.0 * car_index, in_junction=True)
        neighbour_lane = adjacent_place(builder.graph, builder.place(index), "right" if side > 0.0 else "left")
        if neighbour_lane is None or builder.graph.kind[neighbour_lane.lane] not in (
            LaneType.DRIVING,
            LaneType.PARKING,
        ):
            raise builder.error("StaticCutIn needs a lane beside the ego's")
        pose, route_pose = pose_at(builder.graph, neighbour_lane), builder.pose(index)
        pose = Pose(pose.x, pose.y, route_pose.yaw)
        if car_index != 2:
            builder.add(f"standing car {car_index}", "compact", pose)
            continue
        lateral_offset = side * math.dist((pose.x, pose.y), (route_pose.x, route_pose.y))
        phases = (Phase(60.0 * KMH, builder.ego_is_seconds_before(index, 2.7, 15.0, pose)),)
        builder.add(
            "adversary", "compact", pose, phases, builder.parallel_path(index, 1000.0, lateral_offset, into=9.0)
        )


def add_highway_cut_in(builder: ScenarioBuilder) -> None:
    """Add a car that comes from a ramp as the ego passes, and changes into its lane close ahead of it."""
    start = builder.lane_at("other_actor_location")
    car_path = lane_path(builder.graph, start, 400.0)
    ego_path = builder.route.xy.astype(np.float64)
    distances = np.hypot(*(car_path[:, None] - ego_path[None]).transpose(2, 0, 1))
    meeting_indices = np.flatnonzero((distances.min(1) < 5.0) & (distances.argmin(1) < len(ego_path) - 2))
    path_distances = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(car_path, axis=0).T))])
    if not len(meeting_indices):
        raise builder.error("the car of HighwayCutIn never comes beside the ego's way")
    meeting_index, speed, car_model = int(meeting_indices[0]), 0.8 * SPEED, MODELS["coupe"]
    change_start = float(path_distances[meeting_index]) + 5.0
    is_kept = path_distances < change_start + 60.0
    car_path, path_distances = car_path[is_kept], path_distances[is_kept]
    nearest_points = distances[: len(car_path)].argmin(1)
    route_headings = builder.route.yaw[nearest_points]
    lateral_offsets = np.cos(route_headings) * (ego_path[nearest_points, 1] - car_path[:, 1]) - np.sin(
        route_headings
    ) * (ego_path[nearest_points, 0] - car_path[:, 0])
    change_share = np.clip((path_distances - change_start) / (2.0 * speed), 0.0, 1.0)
    car_path = builder.offset_path(car_path, -lateral_offsets * 0.5 * (1.0 - np.cos(np.pi * change_share)))
    # it must be 10 m ahead of the ego where both paths meet: it starts early enough, or drives faster
    ego_arrival, approach_speed = builder.arrival_time(max(int(nearest_points[meeting_index]) - 10, 0)), SPEED
    while time_to_cover(change_start, approach_speed, car_model.max_accel) > ego_arrival and approach_speed < 25.0:
        approach_speed += 0.1
    waiting_point = (
        int(nearest_points[meeting_index])
        - 10
        - round(SPEED * time_to_cover(change_start, approach_speed, car_model.max_accel))
    )
    pose = pose_at(builder.graph, start)
    start_condition = builder.ego_reaches(waiting_point, pose) if waiting_point > 10 else PhaseTrigger("ego_speed", 0.5)
    phases = (Phase(round(approach_speed, 3), start_condition), Phase(speed, PhaseTrigger("travelled", change_start)))
    builder.add("car from the ramp", car_model.name, pose, phases, car_path)


# ---------------------------------------------------------------- flows


def _flow_speed(builder: ScenarioBuilder, default: float) -> float:
    return builder.number("flow_speed", default, 1.0, 40.0)


def _gaps(builder: ScenarioBuilder, default: tuple[float, float]) -> tuple[float, float]:
    return builder.interval("source_dist_interval", default, 5.0, 1000.0)


def add_turn_flow(
    builder: ScenarioBuilder, *, sides: tuple[float, ...], signals: SignalPlan, back: float, on: float
) -> None:
    """Cars go straight on through the junction in which the ego turns."""
    speed, gaps = _flow_speed(builder, 20.0), _gaps(builder, (25.0, 50.0))
    entry_place, junction_lane = builder.approach(sides)
    start = builder.before_junction(entry_place, back * speed)
    flow_path = builder.path_between(
        start, builder.place_ahead(entry_place, float(builder.graph.length[junction_lane]) + on * speed)
    )
    builder.signals = signals
    builder.add_flow(flow_path, gaps, speed)


def add_actor_flow(builder: ScenarioBuilder, *, lanes: bool = False, back: bool = False) -> None:
    """Cars go from one place of the file to another.

    Args:
        builder: Where.
        lanes: Also in the lanes beside.
        back: Also the other way, in the lane to the left.
    """
    speed, gaps = _flow_speed(builder, 10.0), _gaps(builder, (20.0, 50.0))
    start, end = builder.lane_at("start_actor_flow"), builder.lane_at("end_actor_flow")
    builder.add_flow(builder.path_between(start, end), gaps, speed)
    builder.target_speed = max(SPEED, min(speed, float(builder.route.speed_limit[builder.start])))
    for side in ("left", "right") if lanes else ():
        flow_start, flow_end = adjacent_place(builder.graph, start, side), adjacent_place(builder.graph, end, side)
        lane_kinds, same_direction = builder.graph.kind, builder.graph.is_same_direction
        if (
            flow_start
            and flow_end
            and lane_kinds[flow_start.lane] == lane_kinds[flow_end.lane] == LaneType.DRIVING
            and same_direction(start.lane, flow_start.lane)
        ):
            builder.add_flow(builder.path_between(flow_start, flow_end), gaps, speed)
    if back:
        flow_start, flow_end = adjacent_place(builder.graph, end, "left"), adjacent_place(builder.graph, start, "left")
        if (
            flow_start is None
            or flow_end is None
            or LaneType.DRIVING not in (builder.graph.kind[flow_start.lane], builder.graph.kind[flow_end.lane])
        ):
            raise builder.error(f"{builder.item.get('type')} needs a lane for the second flow")
        builder.add_flow(builder.path_between(flow_start, flow_end), gaps, speed)


def add_bicycle_flow(builder: ScenarioBuilder) -> None:
    """Add bicycles that cross the road of the ego."""
    speed, gaps = min(_flow_speed(builder, 10.0), 12.0), _gaps(builder, (20.0, 50.0))
    start, end = builder.lane_at("start_actor_flow"), builder.lane_at("end_actor_flow")
    builder.signals = SignalPlan("green", "red")
    builder.add_flow(builder.path_between(start, builder.place_ahead(end, 40.0)), gaps, speed, models=("bicycle",))


def add_invading_cars(builder: ScenarioBuilder) -> None:
    """Add oncoming cars that drive partly in the ego's lane, beside cones in their own."""
    distance, offset = builder.number("distance", 100.0, 20.0, 500.0), builder.number("offset", 0.25, -1.0, 1.5)
    far_point = builder.point(distance + 30.0, in_junction=True)
    flow_start, flow_end = builder.oncoming_lane(far_point), builder.oncoming_lane(builder.start)
    for cone_index in range(1 + math.ceil(0.1 * distance)):
        cone_place = builder.place_ahead(flow_start, 15.0 + 5.0 * cone_index)
        pose, lane_width = pose_at(builder.graph, cone_place), float(builder.graph.at(cone_place.lane, cone_place.s)[3])
        cone_offset = 0.4 * lane_width
        builder.add(
            f"cone {cone_index}",
            "cone",
            Pose(pose.x + cone_offset * math.sin(pose.yaw), pose.y - cone_offset * math.cos(pose.yaw)),
        )
    lane_width = float(builder.graph.at(flow_end.lane, flow_end.s)[3])
    flow_path = builder.offset_path(builder.path_between(flow_start, flow_end), -(offset + 0.5 * lane_width - 0.7))
    builder.add_flow(flow_path, (40.0, 40.0), min(float(builder.route.speed_limit[far_point]), SPEED), models=CARS)


# ---------------------------------------------------------------- single cars


def add_priority_violator(builder: ScenarioBuilder, *, signals: SignalPlan) -> None:
    """Add a car that enters the junction fast, from the side that the file names, at the same time as the ego."""
    direction = builder.word("direction", "right", ("left", "right", "opposite"))
    side = {"left": LEFT, "right": RIGHT, "opposite": ONCOMING}[direction]
    speed = 60.0 * KMH
    place = meeting_place(
        builder.graph, builder.scenario, builder.route, sides=(side,), trigger_distance=35.0, speed=speed, body="coupe"
    )
    builder.signals = signals
    start_condition = PhaseTrigger("ego_distance", 35.0, len(builder.actors))
    car_path = lane_path(builder.graph, place, 150.0)
    builder.add("emergency car", "coupe", pose_at(builder.graph, place), (Phase(speed, start_condition),), car_path)


def add_emergency_car(builder: ScenarioBuilder) -> None:
    """Add a car that comes from behind, 25 km/h faster than the ego, and wants to pass."""
    start_distance = builder.number("distance", 140.0, 10.0, 500.0)
    start = place_behind(builder.graph, builder.place(0), start_distance)
    if builder.distance_between(start, builder.place(0)) < 8.0:
        raise builder.error("there is no road behind the ego")
    builder.add_driver("emergency car", start, start_distance + builder.route.length + 50.0, SPEED + 25.0 * KMH)


def add_no_actors(builder: ScenarioBuilder, *, signals: SignalPlan = SignalPlan()) -> None:  # noqa: B008  frozen
    """Add no actors: the ego is alone."""
    builder.signals = signals


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
