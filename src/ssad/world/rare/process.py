"""Processes that the estimators run: parallel random episodes, each with a score of its closeness to failure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from ssad.core.driving import STEP, Believer, Branching, WorldState
from ssad.core.errors import ConfigError
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import F64, Bool, Controller, End, Episode
from ssad.world.noise import Keys, Noise
from ssad.world.rare.branching import branch_obstacle, refusal
from ssad.world.rollout import Loop
from ssad.world.world import World

_HARD = 8.0  # m/s^2
_LEAST_GAIN = 0.3  # with less, a stretch would need more than 3 times the movement of a start to make up for it
Rows = npt.NDArray[np.intp]


class Process(Protocol):
    """B episodes side by side (rows). Their chance comes from a key each, by standard normal numbers at every step.

    Attributes:
        name: Name in errors.
        batch: B.
        steps: Steps after which every episode has ended.
        width: D, how many sums of normal numbers a row has; see `push`.
        external: Whether code that may have a memory of its own takes part, such as a driver's: then splitting tests
            that rows branch.
    """

    name: str
    batch: int
    steps: int
    width: int
    external: bool

    def reset(self, keys: Keys) -> None:
        """Restart all rows with these keys [B], without shifted means."""

    def step(self) -> None:
        """Advance every row that has not ended."""

    def running(self) -> Bool:
        """Return the mask of rows that have not ended, [B]."""

    def score(self) -> F64:
        """Return the closeness of each row to failure, [B], in [0, 1]; 1 where it has failed, and only there."""

    def snapshot(self) -> Mapping[str, npt.NDArray[Any]]:
        """Return everything that changes, [B, ...]; copy the arrays to keep them.

        ConfigError: Rows cannot branch.
        """

    def put(self, rows: Rows, states: Mapping[str, npt.NDArray[Any]]) -> None:
        """Set rows to states of `snapshot`, [n, ...]."""

    def rekey(self, rows: Rows, keys: Keys) -> None:
        """Give rows an independent future."""

    def push(self, means: F64) -> None:
        """Shift the means of the normal numbers of each row, [B, D].

        One shift applies to all numbers of one group of steps, one agent and one kind.
        """

    def later(self, means: F64) -> F64:
        """[M, D] means that do at M later times what means [D] do from the start; M is 0 where there is no such time.

        They need not do exactly the same: estimates are right for any, and better for good ones.
        """

    def totals(self) -> tuple[F64, F64]:
        """Return the sums of the normal numbers used so far, and their counts, both [B, D]."""

    def work(self) -> float:
        """Return the amount simulated so far, in agent-steps."""


class WorldProcess:
    """A world with noise and its drivers as a `Process`; failure is a collision of the ego.

    Any driver can be run from start to end. Rows of drivers with a memory of their own branch if the driver is a
    `Branching`.
    """

    def __init__(self, loop: Loop) -> None:
        """Wrap a loop over a world. ConfigError: the world has no noise."""
        world = loop.simulator
        if not isinstance(world, World) or world.chance is None:
            raise ConfigError("how often a driver fails needs chance: a World with noise")
        self.loop, self.world, self.noise = loop, world, world.chance
        self.batch = world.batch
        self.steps = max(
            min(int(episode.limits.max_steps), int(np.ceil(episode.limits.max_time / world.dt)))
            for episode in world.episodes
        )
        self._used = used_numbers(world)
        self.width = int(self._used.sum())
        external_drivers = [driver for _, driver in loop.drivers if driver.controller == Controller.EXTERNAL]
        self.external = bool(external_drivers)
        self.name = " and ".join(dict.fromkeys(driver.name for driver in external_drivers)) or "world"
        # Only the loop passes a belief on, and lets a selector choose.
        self._inside = not self.external and not any(
            isinstance(driver, Believer) or not isinstance(target, int) for target, driver in loop.drivers
        )
        history_sensors = [name for name, sensor in loop.sensors.items() if hasattr(sensor, "follow")]
        obstacles = [branch_obstacle(driver, history_sensors) for _, driver in loop.drivers]
        self._obstacle = next(filter(None, obstacles), "")
        self._branching = {
            f"driver.{number}.": driver
            for number, driver in enumerate(external_drivers)
            if isinstance(driver, Branching)
        }
        self._forms: dict[str, dict[str, tuple[tuple[int, ...], Any]]] = {}
        self._work = 0.0
        self._pushed = self._recorded = False

    def reset(self, keys: Keys) -> None:
        """Restart all rows. What drivers draw at random hangs on the keys too, by the seeds of their episodes."""
        self.loop.reset(seeds=driver_seeds(keys))
        self._forms = {}
        self.world.rekey(keys)
        if self._pushed:
            self.push(np.zeros((self.batch, self.width)))
            self._pushed = False

    def step(self) -> None:
        """Advance every row that has not ended."""
        present = self.world.array("active") != 0
        self._work += float(present[self.running()].sum())
        if self._inside:
            self.world.plan()
            self.world.advance()
        else:
            self.loop.step()

    def run(self) -> Bool:
        """Run all rows, which have just been reset, to their ends (one launch on CUDA); return the failures [B]."""
        if self.world.device == "cpu" or not self._inside:
            while self.running().any():
                self.step()
            return self.failed()
        if self._recorded:
            self.world.step()
        else:
            for _ in range(self.steps):
                self.world.step()
            self.world.capture(steps=self.steps)
            self._recorded = True
        # Agents that leave before the end count as well.
        self._work += float((self.world.array("step") * self._is_inside()).sum())
        return self.failed()

    def _is_inside(self) -> npt.NDArray[np.int64]:
        counts = np.array([sum(1 for _ in episode.agents) for episode in self.world.episodes])
        return np.asarray(counts[self.world.array("episode")])

    def running(self) -> Bool:
        """Return the mask of rows that have not ended, [B]."""
        return np.asarray(self.world.ended() == End.RUNNING)

    def failed(self) -> Bool:
        """Return the mask of egos that have collided, [B]."""
        return np.asarray(self.world.ended() == End.COLLISION)

    def score(self) -> F64:
        """Return the closeness of the most critical agent, [B]; 1: collision."""
        return np.where(self.failed(), 1.0, np.minimum(closeness(self.world.state()), 0.999))

    def snapshot(self) -> Mapping[str, npt.NDArray[Any]]:
        """Return everything that changes except the keys and the means; views on CPU.

        Raises:
            ConfigError: The episodes of a driver cannot branch, or its snapshot is not of the form of `Branching`.
        """
        if self._obstacle:
            raise ConfigError(refusal(self._obstacle))
        names = [array_name for array_name in self.world.names if array_name not in ("noise.key", "noise.push")]
        states = {name: self.world.array(name) for name in names}
        for prefix, driver in self._branching.items():
            states |= {prefix + name: value for name, value in self._driver_states(prefix, driver).items()}
        return states

    def _driver_states(self, prefix: str, driver: Branching) -> dict[str, npt.NDArray[Any]]:
        """Return the checked snapshot of a driver: arrays [B, ...] of one form since the last reset."""
        name = self.name
        snapshot = driver.snapshot()
        if not isinstance(snapshot, Mapping):
            raise ConfigError(f"{name}: snapshot() returned a {type(snapshot).__name__}; expected arrays by name")
        states = {str(key): np.asarray(value) for key, value in snapshot.items()}
        for key, value in states.items():
            if value.dtype.hasobject or value.ndim == 0 or len(value) != self.batch:
                raise ConfigError(
                    f"{name}: snapshot()['{key}'] has shape {value.shape} and type {value.dtype}; expected numbers, "
                    f"and a row for each of the {self.batch} episodes"
                )
        form = {key: (value.shape, value.dtype) for key, value in states.items()}
        changed = sorted(key for key, _ in form.items() ^ self._forms.setdefault(prefix, form).items())
        if changed:
            raise ConfigError(
                f"{name}: snapshot()['{changed[0]}'] changed its shape or type in an episode; make it in reset()"
            )
        return states

    def put(self, rows: Rows, states: Mapping[str, npt.NDArray[Any]]) -> None:
        """Set rows to states of `snapshot`."""
        for name in self.world.names:
            if name in states:
                current = self.world.array(name)
                current[rows] = states[name]
                if self.world.device != "cpu":
                    self.world.put(name, current)
        for prefix, driver in self._branching.items():
            driver_states = {name: value.copy() for name, value in self._driver_states(prefix, driver).items()}
            for name, value in driver_states.items():
                value[rows] = states[prefix + name]
            driver.restore(driver_states)

    def rekey(self, rows: Rows, keys: Keys) -> None:
        """Give rows an independent future."""
        self.world.rekey(keys, rows)

    def push(self, means: F64) -> None:
        """Shift the means of the normal numbers of each row."""
        shifts = np.zeros(self.world.array("noise.push").shape, np.float32)
        shifts[:, self._used] = means
        self.world.put("noise.push", shifts)
        self._pushed = True

    def later(self, means: F64) -> F64:
        """Return [M, D] copies that begin 1, 2, ... stretches later than means [D].

        Stretch s of a copy delayed by k is shifted as stretch s - k of the original. The shift of the first step,
        where processes begin, is reproduced by the stretch before the delayed ones: at its end they are as far from
        0. A last stretch that is longer than the others is not shifted.
        """
        stretch_count, length = self.noise.stretches, self.noise.stretch
        copies = np.zeros((max(stretch_count - 2, 0), *self._used.shape))
        original = np.zeros(self._used.shape)
        original[self._used] = means
        memory = np.exp(-self.world.dt / np.array([self.noise.accel_time, self.noise.choice_time]))
        # by how much a stretch whose means are moved by 1 moves the process at its end; one that hardly forgets cannot
        end_gain = np.sqrt(1.0 - memory**2) * (memory ** np.arange(length)[:, None]).sum(axis=0)
        compensation = np.divide(
            original[:, 0], end_gain, out=np.zeros_like(original[:, 0]), where=end_gain > _LEAST_GAIN
        )
        for delay in range(1, stretch_count - 1):
            copies[delay - 1, :, delay] = compensation
            copies[delay - 1, :, delay + 1 :] = original[:, 1 : stretch_count - delay]
        if self.steps > 1 + length * (stretch_count - 1):
            copies[:, :, -1] = 0.0
        return copies[:, self._used]

    def totals(self) -> tuple[F64, F64]:
        """Return the sums of the normal numbers and their counts."""
        sums = self.world.array("noise.total").astype(np.float64)
        step, stretch_index = self.world.array("step")[:, None], np.arange(self.noise.stretches)
        first_step = np.where(stretch_index > 0, 1 + self.noise.stretch * (stretch_index - 1), 0)
        last_step = np.append(first_step[1:], 1 << 30)
        count = np.clip(step - first_step, 0, last_step - first_step).astype(np.float64)
        counts = np.broadcast_to(count[:, None, :, None], sums.shape)
        return sums[:, self._used], counts[:, self._used]

    def work(self) -> float:
        """Return the number of agent-steps so far."""
        return self._work


def driver_seeds(keys: Keys) -> list[int]:
    """Return the seeds, of 32 bits, that drivers find in their episodes where the world has these keys."""
    return [int(key) & 0xFFFFFFFF for key in keys]


class ReplayedWorld(World):
    """World of one scene that replays a given future: keys by step, and shifted means."""

    def __init__(
        self,
        episodes: Sequence[Episode],
        graphs: Mapping[str, LaneGraph],
        *,
        keys: Mapping[int, int],
        means: Sequence[float],
        device: str,
        noise: Noise,
        dt: float = STEP,
        substeps: int = 2,
    ) -> None:
        """Take keys by step, and the means of `Process.push` (none: not shifted)."""
        self._keys = keys
        (seed,) = driver_seeds(np.array([keys[0]], np.uint64))
        super().__init__(
            [replace(episode, seed=seed) for episode in episodes],
            graphs,
            device=device,
            noise=noise,
            dt=dt,
            substeps=substeps,
        )
        if means:
            shifts = np.zeros(self.array("noise.push").shape, np.float32)
            shifts[:, used_numbers(self)] = means
            self.put("noise.push", shifts)

    def step(self, controls: npt.ArrayLike | None = None) -> None:
        """Advance by one step with the key of that step."""
        key = self._keys.get(int(self.array("step")[0]))
        if key is not None:
            self.rekey(np.array([key], np.uint64))
        super().step(controls)


def used_numbers(world: World) -> Bool:
    """Return the sums of normal numbers [A, L, 2] that influence anything; the others have no place in a proposal."""
    noise = world.chance
    assert noise is not None
    used = np.zeros((world.agents, noise.stretches, 2), bool)
    # The ego's acceleration is never perturbed; only its lapses are random.
    used[0, :, 1] = noise.lapse > 0.0
    used[1:, :, 0], used[1:, :, 1] = noise.accel > 0.0, noise.careless > 0.0
    return used


def closeness(state: WorldState) -> F64:
    """Return the closeness of each ego to a collision, [B] in [0, 1): the maximum over the other agents.

    For each agent whose path the ego's crosses: a / (a + 8 m/s^2), where a is the braking that the rear one needs if
    the front one stops with 8 m/s^2; or, for one beside, 1 / (1 + t), where t is the time in s until the gap between
    them closes, 0.2 m/s faster than it does.
    """
    pose = state.pose.astype(np.float64)
    ego_cos, ego_sin = np.cos(pose[:, :1, 2]), np.sin(pose[:, :1, 2])
    relative_yaw = pose[..., 2] - pose[:, :1, 2]
    ego_speed, along, aside = state.speed[:, :1], state.speed * np.cos(relative_yaw), state.speed * np.sin(relative_yaw)
    offset = pose[..., :2] - pose[:, :1, :2]
    dx, dy = ego_cos * offset[..., 0] + ego_sin * offset[..., 1], ego_cos * offset[..., 1] - ego_sin * offset[..., 0]
    half = 0.5 * state.size.astype(np.float64)
    cos, sin = np.abs(np.cos(relative_yaw)), np.abs(np.sin(relative_yaw))
    longitudinal_gap = np.abs(dx) - (half[:, :1, 0] + half[..., 0] * cos + half[..., 1] * sin)
    lateral_gap = np.abs(dy) - (half[:, :1, 1] + half[..., 0] * sin + half[..., 1] * cos)
    candidates = state.active.copy()
    candidates[:, 0] = False

    behind, front = np.where(dx > 0.0, ego_speed, along), np.where(dx > 0.0, along, ego_speed)
    stopping_distance = front * np.abs(front) / (2.0 * _HARD)  # negative where it comes towards the other
    needed_braking = np.maximum(behind, 0.0) ** 2 / (2.0 * np.maximum(longitudinal_gap + stopping_distance, 0.1))
    time_to_close = np.maximum(longitudinal_gap, 0.0) / np.maximum(behind - front, 1.0)
    paths_cross = np.abs(dy + aside * np.minimum(time_to_close, 2.0)) < np.abs(dy) - lateral_gap
    following_risk = np.where(
        candidates & (longitudinal_gap > 0.0) & paths_cross, needed_braking / (needed_braking + _HARD), 0.0
    )

    lateral_time = np.maximum(lateral_gap, 0.0) / (np.maximum(-aside * np.sign(dy), 0.0) + 0.2)
    paths_cross = np.abs(dx + (along - ego_speed) * np.minimum(lateral_time, 2.0)) < np.abs(dx) - longitudinal_gap
    side_risk = np.where(candidates & (lateral_gap > 0.0) & paths_cross, 1.0 / (1.0 + lateral_time), 0.0)
    return np.asarray(np.maximum(following_risk, side_risk).max(axis=1))
