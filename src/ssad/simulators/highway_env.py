"""highway-env as a simulator: its intersection and its highway, with SSAD's drivers, sensors, metrics and reports.

highway-env moves all vehicles by its own models; a `World` mirrors them at each step, each placed where highway-env
has it. The mirror knows lanes, routes and contacts, so that SSAD's own tools work here too, including the Autopilot
and the blind follower, which plan in the mirror and act in highway-env.

Needs the extra `highway`. highway-env's y axis points down: it is flipped here and nowhere else.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from ssad.core.driving import Scenes
from ssad.core.errors import ConfigError
from ssad.core.lane_graph import LaneGraph, Marking, empty_signal_arrays
from ssad.core.types import (
    F32,
    I32,
    AgentKind,
    Controller,
    Episode,
    EpisodeAgent,
    EpisodeLimits,
    LaneType,
    Model,
    Pose,
    Route,
    Scenario,
)
from ssad.scenarios.dynamic.knowledge._kind import ScenarioType
from ssad.simulators.mirrored import MirroredSimulator, check_phases
from ssad.world.kernels.data import Presence
from ssad.world.world import World

TYPE = "ssad.simulators.highway_env:SCENARIO"  # type of the scenarios of this module
SPARE = 12  # slots of an episode for vehicles that appear while it runs
SUBSTEPS = 2  # of highway-env in a step of 0.1 s, as in `World`
LONGEST_LANE = 1500.0  # m, mapped part of its highway, which is 10 km long
MAX_STEER = np.pi / 4  # rad, highway-env's own limits of a continuous action
MAX_ACCELERATION = 5.0  # m/s^2
# highway-env's bicycle turns about the middle of a body of 5 m, as the world's does with that wheelbase
CAR = Model("car", AgentKind.CAR, 5.0, 2.0, 1.5, 5.0, MAX_STEER, MAX_ACCELERATION, MAX_ACCELERATION, 40.0)


@dataclass(frozen=True)
class HighwayEnvironment:
    """One of highway-env's environments.

    Attributes:
        environment: Its name.
        route: Nodes of the ego's route; empty: straight on.
        target_speed: Target speed of the ego, m/s.
        duration: Time limit, s.
        spawn_every: Steps between possible new vehicles; 0: none appear.
    """

    environment: str
    route: tuple[str, ...]
    target_speed: float
    duration: float
    spawn_every: int = 0


PLACES: dict[str, HighwayEnvironment] = {
    "HighwayIntersection": HighwayEnvironment("intersection-v2", ("o0", "ir0", "il1", "o1"), 9.0, 20.0, spawn_every=10),
    "HighwayStraight": HighwayEnvironment("highway-fast-v0", (), 25.0, 20.0),
}
"""Town of a scenario -> what runs there."""


def highway_scenarios(count: int = 4) -> tuple[Scenario, ...]:
    """Return `count` scenarios of each place; the seed determines the traffic."""
    scenarios = []
    for town, place in PLACES.items():
        limits = EpisodeLimits(max_steps=round(place.duration * 10), max_time=place.duration)
        for seed in range(count):
            ego = highway_episode(Scenario("", TYPE, town, (), seed=seed, limits=limits)).agents[0]
            assert ego.route is not None
            ends = tuple(Pose(*(float(coordinate) for coordinate in ego.route.xy[end_index])) for end_index in (0, -1))
            name = f"{town}/{seed:02d}"
            scenarios.append(
                Scenario(name, TYPE, town, ends, seed=seed, limits=limits, target_speed=place.target_speed, group=town)
            )
    return tuple(scenarios)


def _make_environment(place: HighwayEnvironment, seed: int) -> Any:
    """Return a running environment of highway-env. ConfigError if it is not installed."""
    try:
        import gymnasium
        import highway_env  # noqa: F401  registers its environments
        from highway_env.vehicle.behavior import IDMVehicle
    except ImportError as error:
        raise ConfigError(f"highway-env is not installed ({error}); install the extra 'highway'") from None
    for name, value in _DEFAULTS.items():  # its intersection changes them for all environments of the process
        setattr(IDMVehicle, name, value)
    config = {"simulation_frequency": 10 * SUBSTEPS, "policy_frequency": 10, "action": {"type": "ContinuousAction"}}
    environment: Any = gymnasium.make(place.environment, config=config, disable_env_checker=True).unwrapped
    environment.reset(seed=seed)
    environment.vehicle.collidable = False  # the mirror detects contacts; highway-env would push bodies apart before
    return environment


# IDMVehicle's parameters before an environment changes them
_DEFAULTS = {"DISTANCE_WANTED": 10.0, "COMFORT_ACC_MAX": 3.0, "COMFORT_ACC_MIN": -5.0}


def _pose(vehicle: Any) -> tuple[float, float, float]:
    x, y = (float(coordinate) for coordinate in vehicle.position)
    # The angle of a unit complex number lies in (-pi, pi]; highway-env's headings are not wrapped.
    return x, -y, -float(np.angle(np.exp(1j * vehicle.heading)))


def _lane_points(lane: Any) -> tuple[F32, F32, F32]:
    """Return points [n, 2], headings and arc lengths of a lane of highway-env."""
    length = min(float(lane.length), LONGEST_LANE)
    step = 5.0 if type(lane).__name__ == "StraightLane" else 0.5
    arc_lengths = np.linspace(0.0, length, max(int(np.ceil(length / step)) + 1, 2))
    points = np.array([lane.position(distance, 0.0) for distance in arc_lengths]) * [1.0, -1.0]
    yaw = -np.array([lane.heading_at(distance) for distance in arc_lengths])
    yaw = np.angle(np.exp(1j * yaw))
    return points.astype(np.float32), yaw.astype(np.float32), arc_lengths.astype(np.float32)


@lru_cache(maxsize=4)
def highway_town(name: str) -> LaneGraph:
    """Return the lane graph of one of highway-env's places."""
    graph = _make_environment(PLACES[name], 0).road.network.graph
    edges = [(start_node, end_node) for start_node in graph for end_node in graph[start_node]]
    lane_keys = {
        (start_node, end_node, lane_index): None
        for start_node, end_node in edges
        for lane_index in range(len(graph[start_node][end_node]))
    }
    lane_numbers = {key: position for position, key in enumerate(lane_keys)}
    lanes = [graph[start_node][end_node][lane_index] for start_node, end_node, lane_index in lane_keys]
    geometry = [_lane_points(lane) for lane in lanes]
    offset = np.cumsum([0, *(len(part[2]) for part in geometry)])
    successors = [
        [
            lane_numbers[end_node, following_node, following_index]
            for following_node in graph.get(end_node, {})
            for following_index in range(len(graph[end_node][following_node]))
            if len(graph[end_node][following_node]) == 1 or following_index == lane_index
        ]
        for start_node, end_node, lane_index in lane_keys
    ]
    ways_in = {end_node: sum(1 for edge in edges if edge[1] == end_node) for _, end_node in edges}
    is_junction = [len(graph[start_node]) > 1 and ways_in[end_node] > 1 for start_node, end_node, _ in lane_keys]
    marking_of_line = {0: Marking.NONE, 1: Marking.BROKEN, 2: Marking.SOLID, 3: Marking.SOLID}
    lane_count = len(lanes)
    return LaneGraph(
        name=name,
        xy=np.concatenate([part[0] for part in geometry]),
        z=np.zeros(offset[-1], np.float32),
        yaw=np.concatenate([part[1] for part in geometry]),
        width=np.full(offset[-1], 4.0, np.float32),
        s=np.concatenate([part[2] for part in geometry]),
        offset=offset.astype(np.int32),
        kind=np.full(lane_count, LaneType.DRIVING, np.uint8),
        road=np.array([edges.index(key[:2]) for key in lane_keys], np.int32),
        section=np.zeros(lane_count, np.int32),
        lane_id=np.array([-1 - lane_index for _, _, lane_index in lane_keys], np.int32),
        junction=np.where(is_junction, 0, -1).astype(np.int32),
        speed_limit=np.array([lane.speed_limit or 30.0 for lane in lanes], np.float32),
        left=np.array(
            [
                lane_numbers.get((start_node, end_node, lane_index - 1), -1)
                for start_node, end_node, lane_index in lane_keys
            ],
            np.int32,
        ),
        right=np.array(
            [
                lane_numbers.get((start_node, end_node, lane_index + 1), -1)
                for start_node, end_node, lane_index in lane_keys
            ],
            np.int32,
        ),
        left_marking=np.array([marking_of_line[lane.line_types[0]] for lane in lanes], np.uint8),
        right_marking=np.array([marking_of_line[lane.line_types[1]] for lane in lanes], np.uint8),
        succ_offset=np.cumsum([0, *(len(lane_successors) for lane_successors in successors)]).astype(np.int32),
        succ=np.array([lane_index for lane_successors in successors for lane_index in lane_successors], np.int32),
        **empty_signal_arrays(),
    )


def _ego_route(environment: Any, place: HighwayEnvironment) -> Route:
    """A point a metre, from the ego along its lanes: to the end, or as far as it comes at its target speed."""
    network, ego = environment.road.network, environment.vehicle
    node_pairs = list(zip(place.route, place.route[1:], strict=False)) or [ego.lane_index[:2]]
    lane_keys = [(*key, ego.lane_index[2] if not place.route else 0) for key in node_pairs]
    numbers = {key: key_index for key_index, key in enumerate(network.lanes_dict())}
    start_distance = float(network.get_lane(lane_keys[0]).local_coordinates(ego.position)[0])
    rows = []
    for key_index, key in enumerate(lane_keys):
        lane = network.get_lane(key)
        start = start_distance if key_index == 0 else 0.0
        end = float(lane.length) if place.route else start_distance + place.duration * place.target_speed
        for distance in np.arange(start, end, 0.25):
            rows.append(
                (*lane.position(distance, 0.0), lane.heading_at(distance), numbers[key], lane.speed_limit or 30.0)
            )
    table = np.array(rows)
    arc_lengths = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(table[:, :2], axis=0).T))])
    point_distances = np.arange(0.0, arc_lengths[-1])
    nearest = np.searchsorted(arc_lengths, point_distances)
    points = np.stack(
        [np.interp(point_distances, arc_lengths, table[:, 0]), -np.interp(point_distances, arc_lengths, table[:, 1])], 1
    )
    yaw = np.angle(np.exp(-1j * table[nearest, 2]))
    return Route(
        xy=points.astype(np.float32),
        yaw=yaw.astype(np.float32),
        lane=table[nearest, 3].astype(np.int32),
        speed_limit=table[nearest, 4].astype(np.float32),
        width=np.full(len(point_distances), 4.0, np.float32),
    )


def highway_episode(scenario: Scenario, seed: int | None = None) -> Episode:
    """Return the episode of a scenario of `highway_scenarios`: the ego, its traffic, and slots for later vehicles.

    Args:
        scenario: The scenario.
        seed: Draws other traffic than the scenario's own; None: the scenario's seed.
    """
    place = PLACES[scenario.town]
    seed = scenario.seed if seed is None else seed
    environment = _make_environment(place, seed)
    x, y, yaw = _pose(environment.vehicle)
    ego = EpisodeAgent(
        "ego",
        "car",
        Controller.FOLLOW,
        Pose(x, y, yaw),
        float(environment.vehicle.speed),
        place.target_speed,
        route=_ego_route(environment, place),
    )
    traffic_vehicles = [vehicle for vehicle in environment.road.vehicles if vehicle is not environment.vehicle]
    agents = [
        EpisodeAgent(f"vehicle {number}", "car", Controller.PLACED, Pose(*_pose(vehicle)), float(vehicle.speed))
        for number, vehicle in enumerate(traffic_vehicles, 1)
    ]
    spare_count = SPARE if place.spawn_every else 0
    spare_agents = [
        EpisodeAgent(f"later {number}", "car", Controller.PLACED, Pose(x, y, yaw)) for number in range(spare_count)
    ]
    return Episode(
        scenario.name, scenario, scenario.town, (ego, *agents, *spare_agents), limits=scenario.limits, seed=seed
    )


def _traffic(
    scenario: Scenario, graph: LaneGraph, route: Route, random_generator: np.random.Generator
) -> list[EpisodeAgent]:
    """Return the agents after the ego; highway-env draws them by the scenario's seed."""
    return list(highway_episode(scenario).agents[1:])


SCENARIO = ScenarioType("HighwayEnv", "highway-env", "none: the traffic of highway-env", _traffic)


class HighwayEnv(MirroredSimulator):
    """A `Simulator` of `ssad.core.driving` in which highway-env moves everybody; a scene is one of its environments.

    `mirror` is the `World` that mirrors it. Agents that a driver takes over are driven by their controls or planned in
    the mirror; all others by highway-env. Vehicles that appear take free slots; more than there are slots stay unseen.
    """

    def __init__(self, episodes: Sequence[Episode], graphs: Mapping[str, LaneGraph], *, assign: Scenes | None = None):
        check_phases(episodes, "highway-env")
        self.mirror = World(episodes, graphs, assign=assign, models={"car": CAR})
        self.dt, self.batch, self.agents = self.mirror.dt, self.mirror.batch, self.mirror.agents
        self.episodes, self.graphs = self.mirror.episodes, self.mirror.graphs
        self._environments: list[Any] = [None] * self.batch
        self._slots: list[list[Any]] = [[] for _ in range(self.batch)]
        self._class_defaults: list[dict[str, float]] = [{} for _ in range(self.batch)]
        self._controls = np.zeros((self.batch, self.agents, 4), np.float32)
        self.reset()

    @property
    def assigned(self) -> I32:
        """[B] number of the episode of each scene."""
        return self.mirror.assigned

    def reset(self, scenes: Scenes | None = None, *, episodes: Scenes | None = None) -> None:
        """Restart scenes, with other episodes if given."""
        from highway_env.vehicle.behavior import IDMVehicle

        self.mirror.reset(scenes, episodes=episodes)
        absent = np.zeros((self.batch, self.agents), bool)
        for scene_index in range(self.batch) if scenes is None else np.asarray(scenes).tolist():
            episode = self.episodes[self.assigned[scene_index]]
            environment = _make_environment(PLACES[episode.town], episode.seed)
            traffic_vehicles = [vehicle for vehicle in environment.road.vehicles if vehicle is not environment.vehicle]
            self._environments[scene_index] = environment
            self._slots[scene_index] = [
                environment.vehicle,
                *traffic_vehicles,
                *[None] * (self.agents - 1 - len(traffic_vehicles)),
            ]
            self._class_defaults[scene_index] = {name: getattr(IDMVehicle, name) for name in _DEFAULTS}
            absent[scene_index] = [vehicle is None for vehicle in self._slots[scene_index]]
            self._controls[scene_index] = 0.0
        self.mirror.remove(absent)

    def step(self, controls: npt.ArrayLike | None = None) -> None:
        """Advance all running scenes by 0.1 s."""
        world = self.mirror
        if controls is not None:
            world.set_controls(controls)
            self._controls[:] = world.array("controls")
        world.plan()
        controllers = world.array("controller").copy()
        control = np.where((controllers == Controller.EXTERNAL)[..., None], self._controls, world.array("control"))
        placements = np.concatenate([world.array("pose"), world.array("speed")[..., None]], -1)
        active = world.array("active").copy()
        for scene_index in np.flatnonzero(world.ended() == 0).tolist():
            self._advance_scene(scene_index, controllers[scene_index], control[scene_index])
            for agent_index, vehicle in enumerate(self._slots[scene_index]):
                active[scene_index, agent_index] = Presence.ABSENT if vehicle is None else Presence.AWAKE
                if vehicle is not None:
                    placements[scene_index, agent_index] = *_pose(vehicle), vehicle.speed
        world.put("control", control.astype(np.float32))
        world.put("active", active)
        world.place(placements)
        # while the mirror advances, highway-env alone moves agents
        world.put("controller", np.full_like(controllers, Controller.PLACED))
        world.advance()
        world.put("controller", controllers)

    def _advance_scene(self, scene_index: int, controller: I32, control: F32) -> None:
        """Let highway-env move a scene by a step."""
        from highway_env.vehicle.behavior import IDMVehicle

        environment, slots = self._environments[scene_index], self._slots[scene_index]
        # These are class attributes, shared by all environments of the process: set this scene's before it moves.
        for name, value in self._class_defaults[scene_index].items():
            setattr(IDMVehicle, name, value)
        controlled = [
            agent_index
            for agent_index, candidate in enumerate(slots)
            if candidate is not None and (agent_index == 0 or controller[agent_index] != Controller.PLACED)
        ]
        for _ in range(SUBSTEPS):
            environment.road.act()
            for agent_index in controlled:
                slots[agent_index].action = self._action(slots[agent_index], control[agent_index])
            environment.road.step(self.dt / SUBSTEPS)
            for agent_index in controlled:  # the brake holds, it does not reverse
                if slots[agent_index].speed < 0.0 and control[agent_index, 3] <= 0.5:
                    slots[agent_index].speed = 0.0
        environment.time += self.dt
        place = PLACES[self.episodes[self.assigned[scene_index]].town]
        step = int(self.mirror.array("step")[scene_index]) + 1
        if place.spawn_every and step % place.spawn_every == 0:
            environment._clear_vehicles()
            environment._spawn_vehicle(spawn_probability=environment.config["spawn_probability"])
        free_slots = [
            agent_index for agent_index, candidate in enumerate(slots) if candidate is None
        ]  # who left in this step leaves a slot for the next one
        present_ids = {id(candidate) for candidate in environment.road.vehicles}
        tracked_ids = {id(candidate) for candidate in slots if candidate is not None}
        for agent_index, vehicle in enumerate(slots):
            if vehicle is not None and id(vehicle) not in present_ids:
                slots[agent_index] = None
        appeared = [candidate for candidate in environment.road.vehicles if id(candidate) not in tracked_ids]
        for agent_index, vehicle in zip(free_slots, appeared, strict=False):
            slots[agent_index] = vehicle

    @staticmethod
    def _action(vehicle: Any, control: F32) -> dict[str, float]:
        throttle, brake, steer, reverse = (float(value) for value in np.clip(control, [0, 0, -1, 0], 1))
        drive_acceleration = throttle * MAX_ACCELERATION * (-1.0 if reverse > 0.5 else 1.0)
        brake_deceleration = brake * MAX_ACCELERATION * float(np.sign(vehicle.speed))
        return {"acceleration": drive_acceleration - brake_deceleration, "steering": -steer * MAX_STEER}
