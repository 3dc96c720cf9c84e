"""What the estimators run: many episodes side by side, with chance in them, and how near each is to failure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from ssad.core.driving import Believer, WorldState
from ssad.core.errors import ConfigError
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import F64, Bool, Controller, End, Episode
from ssad.world.noise import Keys, Noise
from ssad.world.rollout import Loop
from ssad.world.world import World

_HARD = 8.0  # m/s^2
_LEAST_GAIN = 0.3  # with less, a stretch would need more than 3 times the movement of a start to make up for it
Rows = npt.NDArray[np.intp]


class Process(Protocol):
    """B episodes side by side (rows). Their chance comes from a key each, by standard normal numbers at every step.

    Attributes:
        batch: B.
        steps: Steps after which every episode has ended.
        width: D, how many sums of normal numbers a row has; see `push`.
    """

    batch: int
    steps: int
    width: int

    def reset(self, keys: Keys) -> None:
        """Start all rows again, with these keys [B] and means that are not moved."""

    def step(self) -> None:
        """Advance every row that has not ended."""

    def running(self) -> Bool:
        """[B] which rows have not ended."""

    def score(self) -> F64:
        """[B] how near each is to failure now, from 0 to 1; exactly 1 where it has failed, and only there."""

    def snapshot(self) -> Mapping[str, npt.NDArray[Any]]:
        """Everything that changes, [B, ...]; what is kept must be copied."""

    def put(self, rows: Rows, states: Mapping[str, npt.NDArray[Any]]) -> None:
        """Put rows into states of `snapshot`, [n, ...]."""

    def rekey(self, rows: Rows, keys: Keys) -> None:
        """Give rows another future."""

    def push(self, means: F64) -> None:
        """Move the means of the normal numbers of each row, [B, D]: those of a group of steps, agent and kind alike."""

    def later(self, means: F64) -> F64:
        """[M, D] means that do at M later times what means [D] do from the start; M is 0 where there is no such time.

        They need not do exactly the same: estimates are right for any, and better for good ones.
        """

    def totals(self) -> tuple[F64, F64]:
        """Sums of the normal numbers so far as they were used, and how many they are, both [B, D]."""

    def work(self) -> float:
        """What has been simulated so far, in agent-steps."""


class WorldProcess:
    """A world with noise, and drivers in it, as a `Process`: failure is a collision of the ego.

    The drivers must not remember anything themselves (what runs inside the world, and learned policies, do not).
    """

    def __init__(self, loop: Loop) -> None:
        """Take a loop over a world. ConfigError: the world has no noise, or a driver is none of this kind."""
        world = loop.simulator
        if not isinstance(world, World) or world.chance is None:
            raise ConfigError("how often a driver fails needs chance: a World with noise")
        for _, driver in loop.drivers:
            if isinstance(driver, Believer):
                raise ConfigError(f"how often {driver.name} fails cannot be estimated: it remembers what it has seen")
        self.loop, self.world, self.noise = loop, world, world.chance
        self.batch = world.batch
        self.steps = max(
            min(int(e.limits.max_steps), int(np.ceil(e.limits.max_time / world.dt))) for e in world.episodes
        )
        self._used = used_numbers(world)
        self.width = int(self._used.sum())
        self._inside = all(driver.controller != Controller.EXTERNAL for _, driver in loop.drivers)
        self._work = 0.0
        self._pushed = self._recorded = False

    def reset(self, keys: Keys) -> None:
        """Start all rows again."""
        self.loop.reset()
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
        """Advance all rows, which have just been reset, to their ends (on CUDA with one launch); [B] who has failed."""
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
        # who leaves before the end is counted on
        self._work += float((self.world.array("step") * self._there()).sum())
        return self.failed()

    def _there(self) -> npt.NDArray[np.int64]:
        kinds = np.array([sum(1 for _ in e.agents) for e in self.world.episodes])
        return np.asarray(kinds[self.world.array("episode")])

    def running(self) -> Bool:
        """[B] which rows have not ended."""
        return np.asarray(self.world.ended() == End.RUNNING)

    def failed(self) -> Bool:
        """[B] which egos have collided."""
        return np.asarray(self.world.ended() == End.COLLISION)

    def score(self) -> F64:
        """[B] closeness of the nearest danger; 1: collision."""
        return np.where(self.failed(), 1.0, np.minimum(closeness(self.world.state()), 0.999))

    def snapshot(self) -> Mapping[str, npt.NDArray[Any]]:
        """Everything that changes but the keys and the means; on CPU views."""
        names = [n for n in self.world.names if n not in ("noise.key", "noise.push")]
        return {name: self.world.array(name) for name in names}

    def put(self, rows: Rows, states: Mapping[str, npt.NDArray[Any]]) -> None:
        """Put rows into states of `snapshot`."""
        for name, value in states.items():
            array = self.world.array(name)
            array[rows] = value
            if self.world.device != "cpu":
                self.world.put(name, array)

    def rekey(self, rows: Rows, keys: Keys) -> None:
        """Give rows another future."""
        self.world.rekey(keys, rows)

    def push(self, means: F64) -> None:
        """Move the means of the normal numbers of each row."""
        push = np.zeros(self.world.array("noise.push").shape, np.float32)
        push[:, self._used] = means
        self.world.put("noise.push", push)
        self._pushed = True

    def later(self, means: F64) -> F64:
        """[M, D] copies that begin 1, 2, ... stretches later than means [D].

        Stretch s of a copy that begins k later is moved as stretch s - k of the original. What the first step moves,
        where processes begin, the stretch before the shifted ones makes up for: at its end they are as far from 0.
        A last stretch that goes on for longer than the others is not moved.
        """
        number, length = self.noise.stretches, self.noise.stretch
        full = np.zeros((max(number - 2, 0), *self._used.shape))
        one = np.zeros(self._used.shape)
        one[self._used] = means
        keep = np.exp(-self.world.dt / np.array([self.noise.accel_time, self.noise.choice_time]))
        # by how much a stretch whose means are moved by 1 moves the process at its end; one that hardly forgets cannot
        gain = np.sqrt(1.0 - keep**2) * (keep ** np.arange(length)[:, None]).sum(axis=0)
        start = np.divide(one[:, 0], gain, out=np.zeros_like(one[:, 0]), where=gain > _LEAST_GAIN)
        for by in range(1, number - 1):
            full[by - 1, :, by] = start
            full[by - 1, :, by + 1 :] = one[:, 1 : number - by]
        if self.steps > 1 + length * (number - 1):
            full[:, :, -1] = 0.0
        return full[:, self._used]

    def totals(self) -> tuple[F64, F64]:
        """Sums of the normal numbers and how many they are."""
        total = self.world.array("noise.total").astype(np.float64)
        step, number = self.world.array("step")[:, None], np.arange(self.noise.stretches)
        first = np.where(number > 0, 1 + self.noise.stretch * (number - 1), 0)
        end = np.append(first[1:], 1 << 30)
        count = np.clip(step - first, 0, end - first).astype(np.float64)
        full = np.broadcast_to(count[:, None, :, None], total.shape)
        return total[:, self._used], full[:, self._used]

    def work(self) -> float:
        """Agent-steps so far."""
        return self._work


class Told(World):
    """A world of one scene whose future is told: from which step on which key, and by how much means are moved."""

    def __init__(
        self,
        episodes: Sequence[Episode],
        graphs: Mapping[str, LaneGraph],
        *,
        keys: Mapping[int, int],
        means: Sequence[float],
        device: str,
        noise: Noise,
    ) -> None:
        """Take keys by step, and the means of `Process.push` (none: not moved)."""
        self._keys = keys
        super().__init__(episodes, graphs, device=device, noise=noise)
        if means:
            push = np.zeros(self.array("noise.push").shape, np.float32)
            push[:, used_numbers(self)] = means
            self.put("noise.push", push)

    def step(self, controls: npt.ArrayLike | None = None) -> None:
        """Advance by one step, with the key of that step."""
        key = self._keys.get(int(self.array("step")[0]))
        if key is not None:
            self.rekey(np.array([key], np.uint64))
        super().step(controls)


def used_numbers(world: World) -> Bool:
    """Which sums of normal numbers [A, L, 2] anything can hang on: the others have no business in a proposal."""
    noise = world.chance
    assert noise is not None
    used = np.zeros((world.agents, noise.stretches, 2), bool)
    used[0, :, 1] = noise.lapse > 0.0
    used[1:, :, 0], used[1:, :, 1] = noise.accel > 0.0, noise.careless > 0.0
    return used


def closeness(state: WorldState) -> F64:
    """How near each ego is to a collision, [B] in [0, 1).

    For each other agent whose path the ego's crosses: a / (a + 8 m/s^2), where a is how hard the one behind would have
    to brake if the one in front now stopped with 8 m/s^2; or, for one beside, 1 / (1 + t), where t is the time in s
    until the gap between them closes, 0.2 m/s faster than it does. The greatest counts.
    """
    pose = state.pose.astype(np.float64)
    c, s = np.cos(pose[:, :1, 2]), np.sin(pose[:, :1, 2])
    turn = pose[..., 2] - pose[:, :1, 2]
    own, along, aside = state.speed[:, :1], state.speed * np.cos(turn), state.speed * np.sin(turn)
    d = pose[..., :2] - pose[:, :1, :2]
    dx, dy = c * d[..., 0] + s * d[..., 1], c * d[..., 1] - s * d[..., 0]
    half = 0.5 * state.size.astype(np.float64)
    cos, sin = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    gap = np.abs(dx) - (half[:, :1, 0] + half[..., 0] * cos + half[..., 1] * sin)
    room = np.abs(dy) - (half[:, :1, 1] + half[..., 0] * sin + half[..., 1] * cos)
    others = state.active.copy()
    others[:, 0] = False

    behind, front = np.where(dx > 0.0, own, along), np.where(dx > 0.0, along, own)
    stops = front * np.abs(front) / (2.0 * _HARD)  # negative where it comes towards the other
    brake = np.maximum(behind, 0.0) ** 2 / (2.0 * np.maximum(gap + stops, 0.1))
    soon = np.maximum(gap, 0.0) / np.maximum(behind - front, 1.0)
    meets = np.abs(dy + aside * np.minimum(soon, 2.0)) < np.abs(dy) - room
    follows = np.where(others & (gap > 0.0) & meets, brake / (brake + _HARD), 0.0)

    time = np.maximum(room, 0.0) / (np.maximum(-aside * np.sign(dy), 0.0) + 0.2)
    meets = np.abs(dx + (along - own) * np.minimum(time, 2.0)) < np.abs(dx) - gap
    beside = np.where(others & (room > 0.0) & meets, 1.0 / (1.0 + time), 0.0)
    return np.asarray(np.maximum(follows, beside).max(axis=1))
