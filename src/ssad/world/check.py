"""The conformance test of worlds: what the rest of SSAD relies on, tried out."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from ssad.core.errors import ConfigError
from ssad.core.protocols import Simulator
from ssad.core.seeding import generator
from ssad.world.kernels.data import End, Presence

MakeWorld = Callable[[Sequence[int]], Simulator]


class WorldCheckError(AssertionError):
    """A world breaks a promise; the message says which."""


def _need(ok: bool, promise: str) -> None:
    if not ok:
        raise WorldCheckError(promise)


def _actions(world: Simulator, seeds: Sequence[int], step: int) -> npt.NDArray[np.float32]:
    """Controls [B, 3] that depend on the scene's seed and the step alone."""
    rows = [generator("check_world", seed, step).random(3) for seed in seeds]
    out = np.array(rows, np.float32)
    out[:, 1] *= out[:, 1] > 0.8  # brake now and then
    out[:, 2] = 0.4 * (out[:, 2] - 0.5)
    return out


def _run(world: Simulator, seeds: Sequence[int], steps: int, first: int = 0) -> list[list[str]]:
    """Hashes after each step: [steps][B]."""
    out = []
    for step in range(first, first + steps):
        world.step(_actions(world, seeds, step))
        out.append(world.hashes())
    return out


def check_world(make: MakeWorld, *, episodes: int, steps: int = 60) -> None:
    """Hold a world to its protocol; raises WorldCheckError naming the broken promise.

    `make(assign)` builds the world with scene b running episode `assign[b]` of a bank of `episodes`, egos external.
    """
    order = list(range(min(episodes, 6)))
    world = make(order)
    _need(isinstance(world, Simulator), "it has the methods and attributes of ssad.core.protocols.Simulator")
    _need(world.batch == len(order), "its batch is as long as the assignment")
    start = world.hashes()
    told = _run(world, order, steps)

    world.reset()
    _need(world.hashes() == start, "reset brings back the start, bit for bit")
    _need(_run(world, order, steps) == told, "the same actions give the same bits after a reset")
    _need(_run(make(order), order, steps) == told, "two worlds give the same bits")

    back = order[::-1]
    turned = _run(make(back), back, steps)
    _need([row[::-1] for row in turned] == told, "the order of scenes does not matter")
    for k in order[:2]:
        alone = _run(make([k]), [k], steps)
        _need(
            [row[0] for row in alone] == [row[k] for row in told],
            "a scene alone gives the bits it gives in a batch",
        )

    world = make(order)
    half = steps // 2
    _run(world, order, half)
    kept = world.snapshot()
    _run(world, order, 5, first=1000)
    world.restore(kept)
    _need(_run(world, order, steps - half, first=half) == told[half:], "a restored snapshot continues as before")

    world = make(order)
    _run(world, order, half)
    before = world.hashes()
    world.reset([0])
    after = world.hashes()
    _need(after[0] == start[0], "resetting one scene brings back its start")
    _need(after[1:] == before[1:], "resetting one scene leaves the others alone")

    _check_physics(make(order), order, steps)
    _check_bad_actions(make(order))


def _check_physics(world: Simulator, order: Sequence[int], steps: int) -> None:
    last = world.array("pose").copy()
    for step in range(steps):
        ended = world.ended() != End.RUNNING
        frozen = np.array(world.hashes())
        world.step(_actions(world, order, step))
        pose = world.array("pose")
        speed = world.array("speed")
        _need(bool(np.isfinite(pose).all() and np.isfinite(speed).all()), "poses and speeds stay finite")
        here = world.array("active") != Presence.ABSENT
        moved = np.hypot(*np.moveaxis(pose[..., :2] - last[..., :2], -1, 0))
        _need(bool((moved[here] <= 60.0 * world.dt).all()), "nobody jumps")
        _need(bool((np.array(world.hashes())[ended] == frozen[ended]).all()), "an ended scene stands still")
        _need(bool((np.abs(pose[..., 2]) <= np.pi + 1e-5).all()), "yaw stays in [-pi, pi]")
        last = pose.copy()


def _check_bad_actions(world: Simulator) -> None:
    bad: list[npt.ArrayLike] = [
        np.zeros((world.batch + 1, 3)),
        np.zeros((world.batch, 2)),
        np.full((world.batch, 3), np.nan),
    ]
    for actions in bad:
        try:
            world.step(actions)
        except ConfigError:
            continue
        raise WorldCheckError("actions of a wrong shape or not finite are refused with ConfigError")
