"""highway-env as a simulator: its intersection and its highway, with SSAD's drivers, sensors, metrics and reports.

highway-env moves everybody by its own models; its vehicles are mirrored, step by step, in a `World` in which each is
placed where highway-env has it. The mirror knows lanes, routes and contacts, so that all that SSAD has for its own
world works here too: also the Autopilot and the blind follower, which plan in the mirror and act in highway-env.

Needs the extra `highway`. highway-env's y axis points down: it is turned here and nowhere else.
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
from ssad.core.lane_graph import LaneGraph, Marking, no_signals
from ssad.core.types import (
    F32,
    I32,
    AgentKind,
    Controller,
    Episode,
    EpisodeAgent,
    LaneType,
    Limits,
    Model,
    Pose,
    Route,
    Scenario,
)
from ssad.scenarios.dynamic.knowledge._kind import ScenarioType
from ssad.simulators.mirrored import Mirrored
from ssad.world.kernels.data import Presence
from ssad.world.world import World

TYPE = "ssad.simulators.highway_env:SCENARIO"  # of the scenarios made here
SPARE = 12  # slots of an episode for vehicles that appear while it runs
SUBSTEPS = 2  # of highway-env in a step of 0.1 s, as in `World`
LONGEST_LANE = 1500.0  # m of its highway, which is 10 km long, that are mapped
MAX_STEER = np.pi / 4  # rad, highway-env's own limits of a continuous action
MAX_ACCELERATION = 5.0  # m/s^2
# highway-env's bicycle turns about the middle of a body of 5 m, as the world's does with that wheelbase
CAR = Model("car", AgentKind.CAR, 5.0, 2.0, 1.5, 5.0, MAX_STEER, MAX_ACCELERATION, MAX_ACCELERATION, 40.0)


@dataclass(frozen=True)
class Place:
    """One of highway-env's environments.

    Attributes:
        environment: Its name.
        route: Nodes of the ego's route; empty: straight on.
        target_speed: m/s.
        duration: s.
        spawn_every: Steps after which a vehicle may appear; 0: never.
    """

    environment: str
    route: tuple[str, ...]
    target_speed: float
    duration: float
    spawn_every: int = 0


PLACES: dict[str, Place] = {
    "HighwayIntersection": Place("intersection-v2", ("o0", "ir0", "il1", "o1"), 9.0, 20.0, spawn_every=10),
    "HighwayStraight": Place("highway-fast-v0", (), 25.0, 20.0),
}
"""Town of a scenario -> what runs there."""


def highway_scenarios(count: int = 4) -> tuple[Scenario, ...]:
    """`count` scenarios of each place; the seed says which traffic meets the ego."""
    found = []
    for town, place in PLACES.items():
        limits = Limits(max_steps=round(place.duration * 10), max_time=place.duration)
        for seed in range(count):
            ego = highway_episode(Scenario("", TYPE, town, (), seed=seed, limits=limits)).agents[0]
            assert ego.route is not None
            ends = tuple(Pose(*(float(v) for v in ego.route.xy[k])) for k in (0, -1))
            name = f"{town}/{seed:02d}"
            found.append(
                Scenario(name, TYPE, town, ends, seed=seed, limits=limits, target_speed=place.target_speed, group=town)
            )
    return tuple(found)


def _gymnasium(place: Place, seed: int) -> Any:
    """A running environment of highway-env. ConfigError if it is not installed."""
    try:
        import gymnasium
        import highway_env  # noqa: F401  registers its environments
        from highway_env.vehicle.behavior import IDMVehicle
    except ImportError as error:
        raise ConfigError(f"highway-env is not installed ({error}); install the extra 'highway'") from None
    for name, value in _DEFAULTS.items():  # its intersection changes them for everybody
        setattr(IDMVehicle, name, value)
    config = {"simulation_frequency": 10 * SUBSTEPS, "policy_frequency": 10, "action": {"type": "ContinuousAction"}}
    env: Any = gymnasium.make(place.environment, config=config, disable_env_checker=True).unwrapped
    env.reset(seed=seed)
    env.vehicle.collidable = False  # contacts are told by the mirror; highway-env would push bodies apart before
    return env


# IDMVehicle's parameters before an environment changes them
_DEFAULTS = {"DISTANCE_WANTED": 10.0, "COMFORT_ACC_MAX": 3.0, "COMFORT_ACC_MIN": -5.0}


def _pose(vehicle: Any) -> tuple[float, float, float]:
    x, y = (float(v) for v in vehicle.position)
    return x, -y, -float(np.angle(np.exp(1j * vehicle.heading)))


def _lane_points(lane: Any) -> tuple[F32, F32, F32]:
    """Points [n, 2], headings and arc lengths of a lane of highway-env."""
    length = min(float(lane.length), LONGEST_LANE)
    step = 5.0 if type(lane).__name__ == "StraightLane" else 0.5
    s = np.linspace(0.0, length, max(int(np.ceil(length / step)) + 1, 2))
    xy = np.array([lane.position(v, 0.0) for v in s]) * [1.0, -1.0]
    yaw = -np.array([lane.heading_at(v) for v in s])
    yaw = np.angle(np.exp(1j * yaw))
    return xy.astype(np.float32), yaw.astype(np.float32), s.astype(np.float32)


@lru_cache(maxsize=4)
def highway_town(name: str) -> LaneGraph:
    """The lane graph of one of highway-env's places."""
    graph = _gymnasium(PLACES[name], 0).road.network.graph
    edges = [(a, b) for a in graph for b in graph[a]]
    index = {(a, b, k): None for a, b in edges for k in range(len(graph[a][b]))}
    number = {key: n for n, key in enumerate(index)}
    lanes = [graph[a][b][k] for a, b, k in index]
    parts = [_lane_points(lane) for lane in lanes]
    offset = np.cumsum([0, *(len(p[2]) for p in parts)])
    succ = [
        [number[b, c, j] for c in graph.get(b, {}) for j in range(len(graph[b][c])) if len(graph[b][c]) == 1 or j == k]
        for a, b, k in index
    ]
    ways_in = {b: sum(1 for edge in edges if edge[1] == b) for _, b in edges}
    inside = [len(graph[a]) > 1 and ways_in[b] > 1 for a, b, _ in index]
    marks = {0: Marking.NONE, 1: Marking.BROKEN, 2: Marking.SOLID, 3: Marking.SOLID}
    count = len(lanes)
    return LaneGraph(
        name=name,
        xy=np.concatenate([p[0] for p in parts]),
        z=np.zeros(offset[-1], np.float32),
        yaw=np.concatenate([p[1] for p in parts]),
        width=np.full(offset[-1], 4.0, np.float32),
        s=np.concatenate([p[2] for p in parts]),
        offset=offset.astype(np.int32),
        kind=np.full(count, LaneType.DRIVING, np.uint8),
        road=np.array([edges.index(key[:2]) for key in index], np.int32),
        section=np.zeros(count, np.int32),
        lane_id=np.array([-1 - k for _, _, k in index], np.int32),
        junction=np.where(inside, 0, -1).astype(np.int32),
        speed_limit=np.array([lane.speed_limit or 30.0 for lane in lanes], np.float32),
        left=np.array([number.get((a, b, k - 1), -1) for a, b, k in index], np.int32),
        right=np.array([number.get((a, b, k + 1), -1) for a, b, k in index], np.int32),
        left_marking=np.array([marks[lane.line_types[0]] for lane in lanes], np.uint8),
        right_marking=np.array([marks[lane.line_types[1]] for lane in lanes], np.uint8),
        succ_offset=np.cumsum([0, *(len(s) for s in succ)]).astype(np.int32),
        succ=np.array([k for s in succ for k in s], np.int32),
        **no_signals(),
    )


def _ego_route(env: Any, place: Place) -> Route:
    """A point a metre, from the ego along its lanes: to the end, or as far as it comes at its target speed."""
    network, ego = env.road.network, env.vehicle
    keys = list(zip(place.route, place.route[1:], strict=False)) or [ego.lane_index[:2]]
    index = [(*key, ego.lane_index[2] if not place.route else 0) for key in keys]
    numbers = {key: n for n, key in enumerate(network.lanes_dict())}
    first = float(network.get_lane(index[0]).local_coordinates(ego.position)[0])
    rows = []
    for n, key in enumerate(index):
        lane = network.get_lane(key)
        start = first if n == 0 else 0.0
        end = float(lane.length) if place.route else first + place.duration * place.target_speed
        for s in np.arange(start, end, 0.25):
            rows.append((*lane.position(s, 0.0), lane.heading_at(s), numbers[key], lane.speed_limit or 30.0))
    table = np.array(rows)
    u = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(table[:, :2], axis=0).T))])
    at = np.arange(0.0, u[-1])
    near = np.searchsorted(u, at)
    xy = np.stack([np.interp(at, u, table[:, 0]), -np.interp(at, u, table[:, 1])], 1)
    yaw = np.angle(np.exp(-1j * table[near, 2]))
    return Route(
        xy=xy.astype(np.float32),
        yaw=yaw.astype(np.float32),
        lane=table[near, 3].astype(np.int32),
        speed_limit=table[near, 4].astype(np.float32),
        width=np.full(len(at), 4.0, np.float32),
    )


def highway_episode(scenario: Scenario, seed: int | None = None) -> Episode:
    """The concrete episode of a scenario of `highway_scenarios`: the ego, its traffic, slots for who comes later.

    `seed` draws other traffic than the scenario's own.
    """
    place = PLACES[scenario.town]
    seed = scenario.seed if seed is None else seed
    env = _gymnasium(place, seed)
    x, y, yaw = _pose(env.vehicle)
    ego = EpisodeAgent(
        "ego",
        "car",
        Controller.FOLLOW,
        Pose(x, y, yaw),
        float(env.vehicle.speed),
        place.target_speed,
        route=_ego_route(env, place),
    )
    others = [v for v in env.road.vehicles if v is not env.vehicle]
    agents = [
        EpisodeAgent(f"vehicle {k}", "car", Controller.PLACED, Pose(*_pose(v)), float(v.speed))
        for k, v in enumerate(others, 1)
    ]
    spare = SPARE if place.spawn_every else 0
    later = [EpisodeAgent(f"later {k}", "car", Controller.PLACED, Pose(x, y, yaw)) for k in range(spare)]
    return Episode(scenario.name, scenario, scenario.town, (ego, *agents, *later), limits=scenario.limits, seed=seed)


def _traffic(scenario: Scenario, graph: LaneGraph, route: Route, rng: np.random.Generator) -> list[EpisodeAgent]:
    """The agents after the ego; highway-env draws them by the scenario's seed."""
    return list(highway_episode(scenario).agents[1:])


SCENARIO = ScenarioType("HighwayEnv", "highway-env", "none: the traffic of highway-env", _traffic)


class HighwayEnv(Mirrored):
    """A `Simulator` of `ssad.core.driving` in which highway-env moves everybody; a scene is one of its environments.

    `mirror` is the `World` that mirrors it. Agents that a driver takes over are driven by their controls or planned in
    the mirror; all others by highway-env. Vehicles that appear take free slots; more than there are slots stay unseen.
    """

    def __init__(self, episodes: Sequence[Episode], graphs: Mapping[str, LaneGraph], *, assign: Scenes | None = None):
        self.mirror = World(episodes, graphs, assign=assign, models={"car": CAR})
        self.dt, self.batch, self.agents = self.mirror.dt, self.mirror.batch, self.mirror.agents
        self.episodes, self.graphs = self.mirror.episodes, self.mirror.graphs
        self._environments: list[Any] = [None] * self.batch
        self._slots: list[list[Any]] = [[] for _ in range(self.batch)]
        self._habits: list[dict[str, float]] = [{} for _ in range(self.batch)]
        self._controls = np.zeros((self.batch, self.agents, 4), np.float32)
        self.reset()

    @property
    def assigned(self) -> I32:
        """[B] number of the episode that each scene runs."""
        return self.mirror.assigned

    def reset(self, scenes: Scenes | None = None, *, episodes: Scenes | None = None) -> None:
        """Start scenes again, with other episodes if given."""
        from highway_env.vehicle.behavior import IDMVehicle

        self.mirror.reset(scenes, episodes=episodes)
        gone = np.zeros((self.batch, self.agents), bool)
        for b in range(self.batch) if scenes is None else np.asarray(scenes).tolist():
            episode = self.episodes[self.assigned[b]]
            env = _gymnasium(PLACES[episode.town], episode.seed)
            others = [v for v in env.road.vehicles if v is not env.vehicle]
            self._environments[b] = env
            self._slots[b] = [env.vehicle, *others, *[None] * (self.agents - 1 - len(others))]
            self._habits[b] = {name: getattr(IDMVehicle, name) for name in _DEFAULTS}
            gone[b] = [v is None for v in self._slots[b]]
            self._controls[b] = 0.0
        self.mirror.remove(gone)

    def step(self, controls: npt.ArrayLike | None = None) -> None:
        """Advance every running scene by 0.1 s."""
        world = self.mirror
        if controls is not None:
            world.set_controls(controls)
            self._controls[:] = world.array("controls")
        world.plan()
        said = world.array("controller").copy()
        control = np.where((said == Controller.EXTERNAL)[..., None], self._controls, world.array("control"))
        places = np.concatenate([world.array("pose"), world.array("speed")[..., None]], -1)
        active = world.array("active").copy()
        for b in np.flatnonzero(world.ended() == 0).tolist():
            self._advance(b, said[b], control[b])
            for i, vehicle in enumerate(self._slots[b]):
                active[b, i] = Presence.ABSENT if vehicle is None else Presence.AWAKE
                if vehicle is not None:
                    places[b, i] = *_pose(vehicle), vehicle.speed
        world.put("control", control.astype(np.float32))
        world.put("active", active)
        world.place(places)
        # who moves here is highway-env alone
        world.put("controller", np.full_like(said, Controller.PLACED))
        world.advance()
        world.put("controller", said)

    def _advance(self, b: int, controller: I32, control: F32) -> None:
        """Let highway-env move a scene by a step."""
        from highway_env.vehicle.behavior import IDMVehicle

        env, slots = self._environments[b], self._slots[b]
        for name, value in self._habits[b].items():
            setattr(IDMVehicle, name, value)
        ours = [i for i, v in enumerate(slots) if v is not None and (i == 0 or controller[i] != Controller.PLACED)]
        for _ in range(SUBSTEPS):
            env.road.act()
            for i in ours:
                slots[i].action = self._action(slots[i], control[i])
            env.road.step(self.dt / SUBSTEPS)
            for i in ours:  # the brake holds, it does not reverse
                if slots[i].speed < 0.0 and control[i, 3] <= 0.5:
                    slots[i].speed = 0.0
        env.time += self.dt
        place = PLACES[self.episodes[self.assigned[b]].town]
        step = int(self.mirror.array("step")[b]) + 1
        if place.spawn_every and step % place.spawn_every == 0:
            env._clear_vehicles()
            env._spawn_vehicle(spawn_probability=env.config["spawn_probability"])
        free = [i for i, v in enumerate(slots) if v is None]  # who left in this step leaves a slot for the next one
        present = {id(v) for v in env.road.vehicles}
        known = {id(v) for v in slots if v is not None}
        for i, vehicle in enumerate(slots):
            if vehicle is not None and id(vehicle) not in present:
                slots[i] = None
        appeared = [v for v in env.road.vehicles if id(v) not in known]
        for i, vehicle in zip(free, appeared, strict=False):
            slots[i] = vehicle

    @staticmethod
    def _action(vehicle: Any, control: F32) -> dict[str, float]:
        throttle, brake, steer, reverse = (float(v) for v in np.clip(control, [0, 0, -1, 0], 1))
        push = throttle * MAX_ACCELERATION * (-1.0 if reverse > 0.5 else 1.0)
        drag = brake * MAX_ACCELERATION * float(np.sign(vehicle.speed))
        return {"acceleration": push - drag, "steering": -steer * MAX_STEER}
