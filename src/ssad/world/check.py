"""Conformance tests of simulators and drivers for the guarantees that the rest of SSAD relies on."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import cast

import numpy as np
import numpy.typing as npt

from ssad.core.driving import Branching, Driver, Reproducible, Sensor, Simulator
from ssad.core.errors import ConfigError
from ssad.core.seeding import generator
from ssad.core.types import ENDS, AgentKind, Controller, End
from ssad.world.observation import observe
from ssad.world.rollout import Loop, step_limit
from ssad.world.sensors import SENSORS

MakeSimulator = Callable[[Sequence[int]], Simulator]


class WorldCheckError(AssertionError):
    """Violation of a guarantee by a simulator or driver; the message names the guarantee."""


def _require(is_met: bool, guarantee: str) -> None:
    if not is_met:
        raise WorldCheckError(guarantee)


def _controls(world: Simulator, seeds: Sequence[int], step: int) -> npt.NDArray[np.float32]:
    """Return controls [B, A, 3] that depend only on the scene's seed and the step."""
    pedals = [generator("check_simulator", seed, step).random(3) for seed in seeds]
    controls = np.zeros((world.batch, world.agents, 3), np.float32)
    controls[:, 0] = pedals
    controls[:, 0, 1] *= controls[:, 0, 1] > 0.8  # brake now and then
    controls[:, 0, 2] = 0.4 * (controls[:, 0, 2] - 0.5)
    return controls


def _egos(world: Simulator) -> npt.NDArray[np.bool_]:
    return np.tile(np.arange(world.agents) == 0, (world.batch, 1))


def _take_egos(world: Simulator) -> Simulator:
    """Reset a simulator and let its egos be driven externally."""
    world.reset()
    world.take(_egos(world), Controller.EXTERNAL, policy=0)
    return world


def check_simulator(make: MakeSimulator, *, episodes: int, steps: int = 60) -> None:
    """Check that a simulator keeps its protocol, and that a reproducible one is bit-exact.

    Args:
        make: Builds the simulator with scene b running episode `assign[b]` of a bank of `episodes`.
        episodes: Number of episodes in the bank.
        steps: Number of steps to run.

    Raises:
        WorldCheckError: A guarantee is broken; the message names it.
    """
    assignment = list(range(min(episodes, 6)))
    world = make(assignment)
    _require(isinstance(world, Simulator), "it has the methods and attributes of ssad.core.driving.Simulator")
    _require(world.batch == len(assignment), "its batch is as long as the assignment")
    _require(list(world.assigned) == assignment, "it says which episodes its scenes run")
    _require(all(episode.town in world.graphs for episode in world.episodes), "it has the lane graph of every town")
    _check_state(world)
    if isinstance(world, Reproducible):
        _check_bits(make, assignment, steps)
    _check_physics(_take_egos(make(assignment)), assignment, steps)
    _check_takeover(make(assignment))
    _check_bad_controls(_take_egos(make(assignment)))


def _check_state(world: Simulator) -> None:
    world.reset()
    state = world.state()
    shape = (world.batch, world.agents)
    for name in (
        "speed",
        "accel",
        "active",
        "kind",
        "controller",
        "policy",
        "target_speed",
        "touch",
        "lane",
        "progress",
    ):
        _require(getattr(state, name).shape == shape, f"state().{name} is [B, A]")
    for name, width in (("pose", 3), ("size", 2), ("control", 4), ("route", 2)):
        _require(getattr(state, name).shape == (*shape, width), f"state().{name} is [B, A, {width}]")
    _require(bool((state.time == 0).all()), "time is 0 at the start")
    _require(bool((world.ended() == End.RUNNING).all()), "nobody has ended at the start")
    _require(bool(state.active[:, 0].all()), "the ego is there at the start")
    _require(bool((state.route[:, 0, 1] > 1).all()), "the ego has a route")
    last_points = state.route.sum(-1)
    _require(bool((last_points <= len(state.roads.path)).all()), "routes lie in state().roads")
    _require(not bool((state.active & (state.kind == AgentKind.NONE)).any()), "nobody is where the slot is empty")


def _run(world: Simulator, seeds: Sequence[int], steps: int, first: int = 0) -> list[list[str]]:
    """Run a simulator and return its hashes after each step, [steps][B]."""
    hash_rows = []
    for step in range(first, first + steps):
        world.step(_controls(world, seeds, step))
        hash_rows.append(cast(Reproducible, world).hashes())
    return hash_rows


def _check_bits(make: MakeSimulator, order: list[int], steps: int) -> None:
    def hashes(world: Simulator) -> list[str]:
        return cast(Reproducible, world).hashes()

    world = _take_egos(make(order))
    start_hashes = hashes(world)
    reference = _run(world, order, steps)
    _require(hashes(_take_egos(world)) == start_hashes, "reset brings back the start, bit for bit")
    _require(_run(world, order, steps) == reference, "the same controls give the same bits after a reset")
    _require(_run(_take_egos(make(order)), order, steps) == reference, "two worlds give the same bits")

    reversed_order = order[::-1]
    reversed_run = _run(_take_egos(make(reversed_order)), reversed_order, steps)
    _require([row[::-1] for row in reversed_run] == reference, "the order of scenes does not matter")
    for scene in order[:2]:
        single_run = _run(_take_egos(make([scene])), [scene], steps)
        _require(
            [row[0] for row in single_run] == [row[scene] for row in reference],
            "a scene alone gives the bits it gives in a batch",
        )

    world = _take_egos(make(order))
    half_steps = steps // 2
    _run(world, order, half_steps)
    saved = cast(Reproducible, world).snapshot()
    # Drive away from the snapshot, so that restoring it has something to undo.
    _run(world, order, 5, first=1000)
    cast(Reproducible, world).restore(saved)
    _require(
        _run(world, order, steps - half_steps, first=half_steps) == reference[half_steps:],
        "a restored snapshot continues as before",
    )

    world = _take_egos(make(order))
    _run(world, order, half_steps)
    hashes_before = hashes(world)
    world.reset([0])
    world.take(_egos(world) & (np.arange(world.batch) == 0)[:, None], Controller.EXTERNAL, policy=0)
    hashes_after = hashes(world)
    _require(hashes_after[0] == start_hashes[0], "resetting one scene brings back its start")
    _require(hashes_after[1:] == hashes_before[1:], "resetting one scene leaves the others alone")


def _check_physics(world: Simulator, order: Sequence[int], steps: int) -> None:
    previous_pose = world.state().pose.copy()
    was_active = world.state().active.copy()
    for step in range(steps):
        ended = world.ended() != End.RUNNING
        world.step(_controls(world, order, step))
        state = world.state()
        pose = state.pose
        _require(bool(np.isfinite(pose).all() and np.isfinite(state.speed).all()), "poses and speeds stay finite")
        distance = np.hypot(*np.moveaxis(pose[..., :2] - previous_pose[..., :2], -1, 0))
        _require(bool((distance[was_active & state.active] <= 60.0 * world.dt).all()), "nobody jumps")
        _require(bool((pose[ended] == previous_pose[ended]).all()), "an ended scene stands still")
        _require(bool((np.abs(pose[..., 2]) <= np.pi + 1e-5).all()), "yaw stays in [-pi, pi]")
        _require(bool((world.ended() < len(ENDS)).all()), "ended() is an index into ENDS")
        running = world.ended() == End.RUNNING
        _require(bool(np.allclose(state.time[running], (step + 1) * world.dt)), "time goes by dt a step")
        previous_pose, was_active = pose.copy(), state.active.copy()


def _check_takeover(world: Simulator) -> None:
    world.reset()
    state = world.state()
    original = state.controller.copy()
    agent_mask = np.zeros(original.shape, bool)
    agent_mask[0] = state.active[0]
    world.take(agent_mask, Controller.EXTERNAL, policy=3)
    state = world.state()
    _require(
        bool((state.controller[agent_mask] == Controller.EXTERNAL).all()), "who is taken over is driven from outside"
    )
    _require(bool((state.policy[agent_mask] == 3).all()), "the state says by which driver")
    _require(
        bool((state.controller[~agent_mask] == original[~agent_mask]).all()), "a takeover leaves everybody else alone"
    )
    world.take(agent_mask, None)
    state = world.state()
    _require(bool((state.controller == original).all()), "who is given back is driven as the episode says")
    _require(bool((state.policy[agent_mask] == -1).all()), "who is given back has no driver")


def _check_bad_controls(world: Simulator) -> None:
    invalid_inputs: list[npt.ArrayLike] = [
        np.zeros((world.batch + 1, world.agents, 3)),
        np.zeros((world.batch, world.agents, 2)),
        np.full((world.batch, world.agents, 3), np.nan),
    ]
    for controls in invalid_inputs:
        try:
            world.step(controls)
        except ConfigError:
            continue
        raise WorldCheckError("controls of a wrong shape or not finite are refused with ConfigError")


def check_driver(
    make: Callable[[], Driver],
    simulator: MakeSimulator,
    *,
    episodes: int,
    steps: int = 40,
    sensors: Mapping[str, Sensor] | None = None,
) -> None:
    """Hold a driver to its protocol, as the ego of a simulator and as another agent of it.

    Args:
        make: Builds the driver.
        simulator: As for `check_simulator`.
        episodes: How many there are.
        steps: How long to drive.
        sensors: What it may ask for besides `ssad.world.sensors.SENSORS`.

    Raises:
        WorldCheckError: A promise is broken; names it.
    """
    available = SENSORS | dict(sensors or {})
    driver = make()
    _require(isinstance(driver, Driver), "it has the methods and attributes of ssad.core.driving.Driver")
    _require(isinstance(driver.controller, Controller), "its controller is a ssad.core.types.Controller")
    assignment = list(range(min(episodes, 4)))
    run_driver = partial(_ego_poses, steps=steps, sensors=available)
    reference = run_driver(driver, simulator(assignment))
    _require(
        run_driver(driver, simulator(assignment)) == reference,
        "reset makes it forget: the same again is driven the same",
    )
    _require(run_driver(make(), simulator(assignment[::-1]))[::-1] == reference, "the order of scenes does not matter")
    _require(
        run_driver(make(), simulator(assignment[:1])) == reference[:1], "a scene alone is driven as it is in a batch"
    )
    if driver.controller == Controller.EXTERNAL:
        _check_controls(make(), simulator(assignment), steps, available)
        world = simulator(assignment)
        if isinstance(driver, Branching) and isinstance(world, Reproducible):
            _check_branches(driver, world, steps, available)


def _ego_poses(driver: Driver, world: Simulator, *, steps: int, sensors: Mapping[str, Sensor]) -> list[bytes]:
    """Return the poses of each scene's ego, as bytes."""
    loop = Loop(world, {0: driver}, sensors=sensors)
    loop.reset()
    poses = []
    for _ in range(min(steps, step_limit(world))):
        loop.step()
        poses.append(world.state().pose[:, 0].copy())
    return [np.stack(poses)[:, scene].tobytes() for scene in range(world.batch)]


def _check_branches(driver: Driver, world: Simulator, steps: int, sensors: Mapping[str, Sensor]) -> None:
    """Check that a driver continues from a restored snapshot as before."""
    assert isinstance(driver, Branching)
    assert isinstance(world, Reproducible)
    loop = Loop(world, {0: driver}, sensors=sensors)
    loop.reset()
    for _ in range(steps // 2):
        loop.step()
    saved = world.snapshot()
    states = {name: np.array(values) for name, values in driver.snapshot().items()}
    _require(
        all(values.ndim > 0 and len(values) == world.batch for values in states.values()),
        "snapshot has a row for each episode",
    )
    runs = []
    for _ in range(2):
        poses = []
        for _ in range(steps - steps // 2):
            loop.step()
            poses.append(world.state().pose.copy())
        runs.append(np.stack(poses).tobytes())
        world.restore(saved)
        driver.restore({name: values.copy() for name, values in states.items()})
    _require(runs[0] == runs[1], "a restored snapshot continues as before")


def _check_controls(driver: Driver, world: Simulator, steps: int, known_positions: Mapping[str, Sensor]) -> None:
    """Check that the controls are in range for any number of agents, and that the driver changes no input."""
    sensors = {name: known_positions[name] for name in getattr(driver, "sensors", ())}
    all_agents = np.argwhere(_take_egos(world).state().active).astype(np.int32)
    driver.reset([world.episodes[index] for index in world.assigned])
    for step in range(min(steps, 5)):
        ended = world.ended() != End.RUNNING
        readings = {name: sensor(world, all_agents) for name, sensor in sensors.items()}
        pose_before = world.state().pose.copy()
        controls = np.asarray(driver.act(observe(world.state(), all_agents, ended, readings)), np.float32)
        _require(
            controls.shape in [(len(all_agents), width) for width in (3, 4)],
            "act returns [N, 3] for the N agents that it sees",
        )
        _require(bool(np.isfinite(controls).all()), "its controls are finite")
        lower_bounds = np.array([0.0, 0.0, -1.0], np.float32)
        _require(
            bool(((controls[:, :3] >= lower_bounds) & (controls[:, :3] <= 1.0)).all()), "its controls are in range"
        )
        _require(bool((world.state().pose == pose_before).all()), "it moves nobody itself")
        world.step(_controls(world, range(world.batch), step))
