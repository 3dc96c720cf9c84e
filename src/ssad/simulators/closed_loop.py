"""Scenarios driven in the closed loop: towns, systems, episodes, and one loop over all available simulators."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from importlib.metadata import version
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Protocol

from ssad.core import safeio
from ssad.core.driving import (
    STEP,
    Driver,
    LoopChanges,
    ReadingChange,
    Sensor,
    Simulator,
    step_options,
    steps_per_trace_step,
    with_finer_steps,
)
from ssad.core.errors import ConfigError
from ssad.core.lane_graph import LaneGraph
from ssad.core.machine import start_warp_quietly
from ssad.core.nuscenes_names import CAMERAS, LIDAR
from ssad.core.registry import Reference, check_arguments, make, resolve
from ssad.core.source import plugin_version, source_version
from ssad.core.traces import merge_steps
from ssad.core.types import Episode, EpisodeTrace, Scenario

if TYPE_CHECKING:
    from ssad.core.frames import Camera, DepthCamera, SemanticCamera
    from ssad.drivers.careful.grade import Grade
    from ssad.rendering.lidar import Lidar

    RequestedSensor = Camera | DepthCamera | SemanticCamera | tuple[str, Lidar]

WIDTH = 640  # pixels of a picture of nuScenes' rig
HIGHWAY = "highway-env"  # as a set of scenarios
EMBEDDED = "embedded"
SIMULATORS: dict[str, str] = {EMBEDDED: "ssad.world.world:World"}
"""Simulator -> "module:object", called with episodes, lane graphs and a keyword `device`; carla://HOST:PORT apart."""
MEMBERS = ("dt", "batch", "agents", "episodes", "assigned", "graphs", "reset", "step", "state", "ended", "take")
HIGHWAY_TYPE = "ssad.simulators.highway_env:SCENARIO"


class EpisodeRequest(Protocol):
    """Request to drive one episode, as plain data."""

    @property
    def key(self) -> str:
        """Key of the episode and of its trace."""

    @property
    def system(self) -> str:
        """Name of the driving system."""

    @property
    def seed(self) -> int:
        """Seed of the episode."""

    @property
    def spec(self) -> Mapping[str, Any]:
        """Scenario (see `scenario_json`), repetition (0: nominal), spread, and any external simulator."""


def is_carla(simulator: str | None) -> bool:
    """Return True for the address of a CARLA server."""
    return simulator is not None and simulator.partition(":")[0] == "carla"


def simulator_version(name: str) -> str:
    """Return 12 hex digits over the source of a simulator of the user's own; "" for SSAD's own world.

    Raises:
        UnknownNameError: There is no such simulator.
        ConfigError: It takes no such arguments.
    """
    target = resolve("simulator", SIMULATORS, Reference.parse(name).name)
    check_arguments("simulator", name, target, extra_arguments={"episodes": (), "graphs": {}, "device": "cpu"})
    return plugin_version("simulator", SIMULATORS, name)


def make_simulator(
    name: str, episodes: Sequence[Episode], graphs: Mapping[str, LaneGraph], *, device: str
) -> Simulator:
    """Return a simulator that runs some episodes side by side.

    Args:
        name: Key of `SIMULATORS`, entry point of the group `ssad.simulators`, or "module:object"; arguments may follow.
        episodes: The episodes.
        graphs: Lane graph of each of their towns.
        device: cpu or cuda.

    Raises:
        UnknownNameError: There is no such simulator.
        ConfigError: It cannot be made, or lacks an attribute or a method of `ssad.core.driving.Simulator`.
    """
    reference = Reference.parse(name)
    target = resolve("simulator", SIMULATORS, reference.name)
    options = {"episodes": episodes, "graphs": graphs, "device": device, **reference.options}
    simulator: Simulator = make("simulator", reference.name, target, options, MEMBERS)
    return simulator


def load_kernels(device: str) -> None:
    """Load the world's kernels, which are compiled on first use."""
    import warp

    import ssad.world.rollout  # noqa: F401  its kernels are what is loaded

    start_warp_quietly()
    warp.force_load(device=device)


@lru_cache(maxsize=8)
def cached_town(name: str) -> LaneGraph:
    """Return a town, read once per process."""
    from ssad.simulators.highway_env import PLACES, highway_town
    from ssad.world.roads import load_town

    return highway_town(name) if name in PLACES else load_town(name)


@lru_cache(maxsize=4)
def system_of(name: str) -> Driver:
    """Return a driving system, built once per process."""
    from ssad.drivers import make_system

    return make_system(name)


def system_version(name: str) -> str:
    """12 hex digits over the source of a system and all that it imports, and those of its weights if it was trained.

    Raises:
        UnknownNameError, ConfigError: there is no such system.
        FormatError: its weights cannot be used.
    """
    from ssad.drivers import find_system, weights_version

    system_type = find_system(name)
    if not callable(getattr(system_type, "act", None)) or not callable(getattr(system_type, "reset", None)):
        raise ConfigError(f"system '{name}' needs the methods reset(episodes) and act(observation)")
    # A system may be registered as a class or as an instance.
    source_hash = source_version((system_type if isinstance(system_type, type) else type(system_type)).__module__)
    weights_name = getattr(system_type, "weights", "")
    if weights_name:  # of a perceiving system, with the weights that are shipped
        from ssad.detectors import SHIPPED

        return f"{source_hash} {safeio.read_json(SHIPPED / f'{weights_name}.json')['hash'][:12]}"
    version_of_parts = getattr(system_type, "version_of_parts", None)
    if callable(version_of_parts):  # of a perceiving system whose parts are named by its arguments
        return f"{source_hash} {version_of_parts(**Reference.parse(name).options)}".strip()
    return f"{source_hash} {weights_version(name)[:12]}".strip()


def policies_of(scenario: Scenario) -> list[str]:
    """Return the distinct drivers that a scenario names for its actors, sorted."""
    return sorted({actor.policy for actor in scenario.actors} - {""})


def type_version(name: str) -> str:
    """Return 12 hex digits over the source of a user's scenario type; "" for a built-in one.

    The type that highway-env runs has the version of highway-env appended.
    """
    from ssad.scenarios.dynamic.catalogue import TYPES

    source_hash = plugin_version("scenario", TYPES, name)
    return f"{source_hash} {version('highway-env')}".strip() if name == HIGHWAY_TYPE else source_hash


def runs_in_highway_env(request: EpisodeRequest) -> bool:
    """Return True if highway-env runs an episode, and not the embedded world."""
    return bool(request.spec["scenario"]["type"] == HIGHWAY_TYPE)


def runs_embedded(request: EpisodeRequest) -> bool:
    """Return True if SSAD's own world runs an episode."""
    return not runs_in_highway_env(request) and "simulator" not in request.spec


def town_version(graph: LaneGraph) -> str:
    """12 hex digits over every array of a lane graph."""
    array_hash = hashlib.sha256()
    for name, value in sorted(vars(graph).items()):
        if hasattr(value, "tobytes"):
            # Type and shape are hashed too: equal bytes can hold different arrays.
            array_hash.update(f"{name}{value.dtype.str}{value.shape}".encode() + value.tobytes())
    return array_hash.hexdigest()[:12]


def scenario_json(scenario: Scenario) -> dict[str, Any]:
    """Return a scenario as plain data, as it stands in YAML, with its defaults written out."""
    from ssad.scenarios.dynamic import scenario_data

    data: dict[str, Any] = safeio.parse_json(safeio.dump_json(scenario_data(scenario, defaults=True)))
    return data


def build_requested_episode(request: EpisodeRequest) -> Episode:
    """The concrete episode of a request.

    Raises:
        RouteError: It cannot be built.
        MapError: It cannot be built.
        ConfigError: It cannot be built.
    """
    from ssad.scenarios.dynamic import build_episode, scenario_from
    from ssad.simulators.highway_env import highway_episode

    scenario = scenario_from(request.spec["scenario"])
    if runs_in_highway_env(request):
        seed = request.seed if request.spec["repetition"] else scenario.seed
        return replace(highway_episode(scenario, seed), key=request.key)
    return replace(
        build_episode(scenario, cached_town(scenario.town), seed=request.seed, spread=request.spec["spread"]),
        key=request.key,
    )


def drive(
    requests: Sequence[EpisodeRequest],
    *,
    device: str,
    driver: Driver | None = None,
    sensors: Mapping[str, Sensor] | None = None,
    perturbation: LoopChanges | Mapping[str, ReadingChange] | None = None,
    key: Callable[[EpisodeRequest], str] = attrgetter("key"),
) -> tuple[list[Episode], list[EpisodeTrace], Mapping[str, Any]]:
    """Return episodes and traces of requests that share a system and a simulator, run as one batch.

    The third is what a simulator counts by sensors of its own (`ssad.simulators.carla.events`), which drives one
    request at a time; else it is empty.

    Args:
        requests: What is to be driven.
        device: Where the world computes.
        driver: Who drives; None: the system that the requests name.
        sensors: What drivers may ask for; None: `onboard_sensors`.
        perturbation: Changes between sensors, driver and vehicle; see `ssad.world.rollout.rollout`.
        key: Of the episodes, on which the noise of sensors depends; traces have those of their requests.
    """
    from ssad.drivers import make_system
    from ssad.simulators.highway_env import HighwayEnv
    from ssad.world.rollout import rollout
    from ssad.world.world import World

    # Runs that are to be compared can share the noise of their sensors through this key.
    episodes = [replace(build_requested_episode(request), key=key(request)) for request in requests]
    graphs = {episode.town: cached_town(episode.town) for episode in episodes}
    system = driver or system_of(requests[0].system)
    policies = {name: make_system(name) for episode in episodes for name in policies_of(episode.scenario)}
    for agent_driver in (system, *policies.values()):
        if callable(getattr(agent_driver, "to", None)):
            agent_driver.to(device)  # type: ignore[attr-defined]
    simulator_name = requests[0].spec.get("simulator", EMBEDDED)
    is_embedded = simulator_name == EMBEDDED and not runs_in_highway_env(requests[0])
    steps_in_one = steps_per_trace_step(system) if is_embedded or is_carla(simulator_name) else 1
    run_episodes, step = with_finer_steps(episodes, steps_in_one), STEP / steps_in_one
    simulator: Simulator
    if is_carla(simulator_name):
        from ssad.simulators.carla.sensors import CarlaSensor, sensor_blueprints
        from ssad.simulators.carla.server import Server
        from ssad.simulators.carla.simulator import Carla

        server = Server.of(simulator_name)
        carla_cameras = (
            sensor_blueprints(requested_sensors([system]), step)
            if server.sensors == "carla" and sensors is None
            else {}
        )
        simulator = Carla(run_episodes, graphs, server=server, blueprints=carla_cameras, dt=step)
        if carla_cameras:
            sensors = onboard_sensors(list(policies.values()), device) | {
                name: CarlaSensor(name) for name in carla_cameras
            }
    elif runs_in_highway_env(requests[0]):
        simulator = HighwayEnv(episodes, graphs)
    elif steps_in_one > 1:
        simulator = World(run_episodes, graphs, device=device, **step_options(steps_in_one))
    else:
        simulator = make_simulator(simulator_name, episodes, graphs, device=device)
    if sensors is None:
        sensors = onboard_sensors([system, *policies.values()], device)
    try:
        traces = rollout(simulator, system, sensors=sensors, perturbation=perturbation, policies=policies.__getitem__)
        # Traces have steps of 0.1 s, however often a driver is asked.
        traces = [merge_steps(trace, steps_in_one) for trace in traces]
        simulator_metrics = dict(getattr(simulator, "measured", {})) if is_carla(simulator_name) else {}
    finally:
        # External simulators hold a connection, which must end even if a driver raises.
        getattr(simulator, "close", lambda: None)()
    return (
        episodes,
        [replace(trace, key=request.key) for trace, request in zip(traces, requests, strict=True)],
        simulator_metrics,
    )


def requested_sensors(drivers: Sequence[Driver]) -> dict[str, RequestedSensor]:
    """Return the sensors that drivers name in `sensors`, by name.

    Returns:
        Cameras, depth and semantic cameras, and pairs ("lidar" or "radar", model).
    """
    from ssad.core.frames import DepthCamera, SemanticCamera
    from ssad.rendering.camera.rig import rig_camera
    from ssad.rendering.lidar import HDL32E

    sensors: dict[str, RequestedSensor] = {}
    for driver in drivers:
        # A driver's own models take precedence over the sensors of nuScenes with the same name.
        driver_sensors: dict[str, RequestedSensor] = dict(getattr(driver, "cameras", {}))
        driver_sensors |= {name: DepthCamera(camera) for name, camera in getattr(driver, "depth_cameras", {}).items()}
        driver_sensors |= {
            name: SemanticCamera(camera) for name, camera in getattr(driver, "semantic_cameras", {}).items()
        }
        driver_sensors |= {
            name: ("lidar", sensor_model) for name, sensor_model in getattr(driver, "lidars", {}).items()
        }
        driver_sensors |= {
            name: ("radar", sensor_model) for name, sensor_model in getattr(driver, "radars", {}).items()
        }
        for name in getattr(driver, "sensors", ()):
            if name in driver_sensors:
                sensors[name] = driver_sensors[name]
            elif name in CAMERAS:
                sensors[name] = rig_camera(name, WIDTH)
            elif name == LIDAR:
                sensors[name] = "lidar", HDL32E
    return sensors


def onboard_sensors(drivers: Sequence[Driver], device: str) -> dict[str, Sensor]:
    """The cameras and the LiDAR of nuScenes, by channel, where a driver asks for one, and the drivers' own sensors."""
    required = requested_sensors(drivers)
    if not required:
        return {}
    from ssad.core.frames import DepthCamera, SemanticCamera
    from ssad.rendering.onboard import Onboard
    from ssad.rendering.radar import OnboardRadar
    from ssad.rendering.semantic import OnboardSemanticCamera

    onboard = Onboard(device=device)
    sensors: dict[str, Sensor] = {**onboard.rig(), LIDAR: onboard.lidar()}
    for name, sensor_model in required.items():
        if isinstance(sensor_model, tuple):
            sensors[name] = (
                onboard.lidar(sensor_model[1]) if sensor_model[0] == "lidar" else OnboardRadar(onboard, sensor_model[1])
            )
        elif isinstance(sensor_model, DepthCamera):
            sensors[name] = onboard.depth_camera(sensor_model.camera)
        elif isinstance(sensor_model, SemanticCamera):
            sensors[name] = OnboardSemanticCamera(onboard, sensor_model.camera)
        else:
            sensors[name] = onboard.camera(sensor_model)
    return sensors


def grade_of(episode: Episode, trace: EpisodeTrace, device: str) -> Grade:
    """Grade the collision of a drive by the drivers that could have avoided it."""
    return grades_of([(episode, trace)], device)[0]


def grades_of(drives: Sequence[tuple[Episode, EpisodeTrace]], device: str) -> list[Grade]:
    """Grade the collisions of drives by the drivers that could have avoided them; all are replayed side by side."""
    from ssad.drivers.careful.grade import grade_collisions

    return grade_collisions(_graded_drives(drives), **_grading_options(drives, device))


def avoiders_of(drives: Sequence[tuple[Episode, EpisodeTrace]], device: str) -> list[Mapping[str, bool]]:
    """Return which careful drivers avoid the collisions of drives, by short name; `grades_of` without the limit."""
    from ssad.drivers.careful.grade import careful_drivers_avoid

    return careful_drivers_avoid(_graded_drives(drives), **_grading_options(drives, device))


def _graded_drives(drives: Sequence[tuple[Episode, EpisodeTrace]]) -> list[tuple[Episode, LaneGraph, EpisodeTrace]]:
    """Return drives with their towns."""
    return [(episode, cached_town(episode.town), trace) for episode, trace in drives]


def _grading_options(drives: Sequence[tuple[Episode, EpisodeTrace]], device: str) -> dict[str, Any]:
    """Return where a grading computes, and who drives the others."""
    from ssad.drivers import make_system

    names = dict.fromkeys(name for episode, _ in drives for name in policies_of(episode.scenario))
    sensors = onboard_sensors([make_system(name) for name in names], device)
    return {"device": device, "policies": make_system, "sensors": sensors}
