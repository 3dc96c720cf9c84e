"""Conformance tests of simulators and drivers: what the rest of SSAD relies on, tried out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import cast

import numpy as np
import numpy.typing as npt

from ssad.core.driving import Driver, Reproducible, Sensor, Simulator
from ssad.core.errors import ConfigError
from ssad.core.seeding import generator
from ssad.core.types import ENDS, AgentKind, Controller, End
from ssad.world.observation import observe
from ssad.world.rollout import Loop, step_limit
from ssad.world.sensors import SENSORS

MakeSimulator = Callable[[Sequence[int]], Simulator]


class WorldCheckError(AssertionError):
    """A simulator or a driver breaks a promise; the message says which."""


def _need(ok: bool, promise: str) -> None:
    if not ok:
        raise WorldCheckError(promise)


def _controls(world: Simulator, seeds: Sequence[int], step: int) -> npt.NDArray[np.float32]:
    """Controls [B, A, 3] that depend on the scene's seed and the step alone."""
    rows = [generator("check_simulator", seed, step).random(3) for seed in seeds]
    out = np.zeros((world.batch, world.agents, 3), np.float32)
    out[:, 0] = rows
    out[:, 0, 1] *= out[:, 0, 1] > 0.8  # brake now and then
    out[:, 0, 2] = 0.4 * (out[:, 0, 2] - 0.5)
    return out


def _egos(world: Simulator) -> npt.NDArray[np.bool_]:
    return np.tile(np.arange(world.agents) == 0, (world.batch, 1))


def _ready(world: Simulator) -> Simulator:
    """The simulator at its start, its egos driven from outside."""
    world.reset()
    world.take(_egos(world), Controller.EXTERNAL, policy=0)
    return world


def check_simulator(make: MakeSimulator, *, episodes: int, steps: int = 60) -> None:
    """Hold a simulator to its protocol, and a reproducible one to the bits.

    Args:
        make: Builds the simulator with scene b running episode `assign[b]` of a bank of `episodes`.
        episodes: How many there are.
        steps: How long to drive.

    Raises:
        WorldCheckError: A promise is broken; names it.
    """
    order = list(range(min(episodes, 6)))
    world = make(order)
    _need(isinstance(world, Simulator), "it has the methods and attributes of ssad.core.driving.Simulator")
    _need(world.batch == len(order), "its batch is as long as the assignment")
    _need(list(world.assigned) == order, "it says which episodes its scenes run")
    _need(all(e.town in world.graphs for e in world.episodes), "it has the lane graph of every town")
    _check_state(world)
    if isinstance(world, Reproducible):
        _check_bits(make, order, steps)
    _check_physics(_ready(make(order)), order, steps)
    _check_takeover(make(order))
    _check_bad_controls(_ready(make(order)))


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
        _need(getattr(state, name).shape == shape, f"state().{name} is [B, A]")
    for name, wide in (("pose", 3), ("size", 2), ("control", 4), ("route", 2)):
        _need(getattr(state, name).shape == (*shape, wide), f"state().{name} is [B, A, {wide}]")
    _need(bool((state.time == 0).all()), "time is 0 at the start")
    _need(bool((world.ended() == End.RUNNING).all()), "nobody has ended at the start")
    _need(bool(state.active[:, 0].all()), "the ego is there at the start")
    _need(bool((state.route[:, 0, 1] > 1).all()), "the ego has a route")
    points = state.route.sum(-1)
    _need(bool((points <= len(state.roads.path)).all()), "routes lie in state().roads")
    _need(not bool((state.active & (state.kind == AgentKind.NONE)).any()), "nobody is where the slot is empty")


def _run(world: Simulator, seeds: Sequence[int], steps: int, first: int = 0) -> list[list[str]]:
    """Hashes after each step: [steps][B]."""
    out = []
    for step in range(first, first + steps):
        world.step(_controls(world, seeds, step))
        out.append(cast(Reproducible, world).hashes())
    return out


def _check_bits(make: MakeSimulator, order: list[int], steps: int) -> None:
    def hashes(world: Simulator) -> list[str]:
        return cast(Reproducible, world).hashes()

    world = _ready(make(order))
    start = hashes(world)
    told = _run(world, order, steps)
    _need(hashes(_ready(world)) == start, "reset brings back the start, bit for bit")
    _need(_run(world, order, steps) == told, "the same controls give the same bits after a reset")
    _need(_run(_ready(make(order)), order, steps) == told, "two worlds give the same bits")

    back = order[::-1]
    turned = _run(_ready(make(back)), back, steps)
    _need([row[::-1] for row in turned] == told, "the order of scenes does not matter")
    for k in order[:2]:
        alone = _run(_ready(make([k])), [k], steps)
        _need(
            [row[0] for row in alone] == [row[k] for row in told],
            "a scene alone gives the bits it gives in a batch",
        )

    world = _ready(make(order))
    half = steps // 2
    _run(world, order, half)
    kept = cast(Reproducible, world).snapshot()
    _run(world, order, 5, first=1000)
    cast(Reproducible, world).restore(kept)
    _need(_run(world, order, steps - half, first=half) == told[half:], "a restored snapshot continues as before")

    world = _ready(make(order))
    _run(world, order, half)
    before = hashes(world)
    world.reset([0])
    world.take(_egos(world) & (np.arange(world.batch) == 0)[:, None], Controller.EXTERNAL, policy=0)
    after = hashes(world)
    _need(after[0] == start[0], "resetting one scene brings back its start")
    _need(after[1:] == before[1:], "resetting one scene leaves the others alone")


def _check_physics(world: Simulator, order: Sequence[int], steps: int) -> None:
    last = world.state().pose.copy()
    there = world.state().active.copy()
    for step in range(steps):
        ended = world.ended() != End.RUNNING
        world.step(_controls(world, order, step))
        state = world.state()
        pose = state.pose
        _need(bool(np.isfinite(pose).all() and np.isfinite(state.speed).all()), "poses and speeds stay finite")
        moved = np.hypot(*np.moveaxis(pose[..., :2] - last[..., :2], -1, 0))
        _need(bool((moved[there & state.active] <= 60.0 * world.dt).all()), "nobody jumps")
        _need(bool((pose[ended] == last[ended]).all()), "an ended scene stands still")
        _need(bool((np.abs(pose[..., 2]) <= np.pi + 1e-5).all()), "yaw stays in [-pi, pi]")
        _need(bool((world.ended() < len(ENDS)).all()), "ended() is an index into ENDS")
        going = world.ended() == End.RUNNING
        _need(bool(np.allclose(state.time[going], (step + 1) * world.dt)), "time goes by dt a step")
        last, there = pose.copy(), state.active.copy()


def _check_takeover(world: Simulator) -> None:
    world.reset()
    state = world.state()
    said = state.controller.copy()
    mask = np.zeros(said.shape, bool)
    mask[0] = state.active[0]
    world.take(mask, Controller.EXTERNAL, policy=3)
    state = world.state()
    _need(bool((state.controller[mask] == Controller.EXTERNAL).all()), "who is taken over is driven from outside")
    _need(bool((state.policy[mask] == 3).all()), "the state says by which driver")
    _need(bool((state.controller[~mask] == said[~mask]).all()), "a takeover leaves everybody else alone")
    world.take(mask, None)
    state = world.state()
    _need(bool((state.controller == said).all()), "who is given back is driven as the episode says")
    _need(bool((state.policy[mask] == -1).all()), "who is given back has no driver")


def _check_bad_controls(world: Simulator) -> None:
    bad: list[npt.ArrayLike] = [
        np.zeros((world.batch + 1, world.agents, 3)),
        np.zeros((world.batch, world.agents, 2)),
        np.full((world.batch, world.agents, 3), np.nan),
    ]
    for controls in bad:
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
    known = SENSORS | dict(sensors or {})
    driver = make()
    _need(isinstance(driver, Driver), "it has the methods and attributes of ssad.core.driving.Driver")
    _need(isinstance(driver.controller, Controller), "its controller is a ssad.core.types.Controller")
    order = list(range(min(episodes, 4)))
    drive = partial(_driven, steps=steps, sensors=known)
    told = drive(driver, simulator(order))
    _need(drive(driver, simulator(order)) == told, "reset makes it forget: the same again is driven the same")
    _need(drive(make(), simulator(order[::-1]))[::-1] == told, "the order of scenes does not matter")
    _need(drive(make(), simulator(order[:1])) == told[:1], "a scene alone is driven as it is in a batch")
    if driver.controller == Controller.EXTERNAL:
        _check_controls(make(), simulator(order), steps, known)


def _driven(driver: Driver, world: Simulator, *, steps: int, sensors: Mapping[str, Sensor]) -> list[bytes]:
    """How the ego of each scene moves."""
    loop = Loop(world, {0: driver}, sensors=sensors)
    loop.reset()
    poses = []
    for _ in range(min(steps, step_limit(world))):
        loop.step()
        poses.append(world.state().pose[:, 0].copy())
    return [np.stack(poses)[:, b].tobytes() for b in range(world.batch)]


def _check_controls(driver: Driver, world: Simulator, steps: int, known: Mapping[str, Sensor]) -> None:
    """What it returns is in range, for agents of any number, and it changes nothing."""
    sensors = {name: known[name] for name in getattr(driver, "sensors", ())}
    everybody = np.argwhere(_ready(world).state().active).astype(np.int32)
    driver.reset([world.episodes[k] for k in world.assigned])
    for step in range(min(steps, 5)):
        ended = world.ended() != End.RUNNING
        readings = {name: sensor(world, everybody) for name, sensor in sensors.items()}
        pose = world.state().pose.copy()
        given = np.asarray(driver.act(observe(world.state(), everybody, ended, readings)), np.float32)
        _need(given.shape in [(len(everybody), n) for n in (3, 4)], "act returns [N, 3] for the N agents that it sees")
        _need(bool(np.isfinite(given).all()), "its controls are finite")
        low = np.array([0.0, 0.0, -1.0], np.float32)
        _need(bool(((given[:, :3] >= low) & (given[:, :3] <= 1.0)).all()), "its controls are in range")
        _need(bool((world.state().pose == pose).all()), "it moves nobody itself")
        world.step(_controls(world, range(world.batch), step))
