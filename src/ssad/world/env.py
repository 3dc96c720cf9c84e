"""The world as Gymnasium environments: one vector environment over a whole batch, and its single-scene form."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.vector.utils import batch_space

from ssad.core.errors import ConfigError
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import Controller, Episode
from ssad.world.kernels.data import End
from ssad.world.world import ENDS, World

Observation = Literal["safebench", "frea"]
Action = Literal["safebench", "frea", "controls"]
_SLICE = {"safebench": slice(0, 4), "frea": slice(4, 28)}
_BOUND = np.float32(1.0e4)


def observation_space(kind: Observation) -> gym.spaces.Box:
    """`safebench`: [4] lateral offset m, heading error rad, speed m/s, hazard 0/1; `frea`: [24], see kernels.look."""
    if kind not in _SLICE:
        raise ConfigError(f"unknown observation '{kind}'; known: {', '.join(_SLICE)}")
    n = _SLICE[kind].stop - _SLICE[kind].start
    return gym.spaces.Box(-_BOUND, _BOUND, (n,), np.float32)


def action_space(kind: Action) -> gym.spaces.Box:
    """`safebench`: [2] acceleration / 3 m/s^2 and steer / 0.3; `frea`: [3] throttle, steer / 0.3, brake; all in
    [-1, 1]. `controls`: [3] throttle, brake in [0, 1] and steer in [-1, 1]."""
    if kind == "controls":
        return gym.spaces.Box(np.array([0, 0, -1], np.float32), np.ones(3, np.float32))
    if kind not in ("safebench", "frea"):
        raise ConfigError(f"unknown action '{kind}'; known: safebench, frea, controls")
    return gym.spaces.Box(-1.0, 1.0, (2 if kind == "safebench" else 3,), np.float32)


def to_controls(kind: Action, action: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.float32]:
    """Policy actions [B, n] to throttle, brake, steer [B, 3], by the rules of SafeBench and FREA."""
    a = np.asarray(action, np.float32)
    out = np.zeros((len(a), 3), np.float32)
    if kind == "controls":
        out[:] = a
    elif kind == "safebench":
        push = np.clip(a[:, 0], -1, 1) * 3.0
        out[:, 0] = np.where(push > 0, np.clip(push / 3.0, 0, 1), 0)
        out[:, 1] = np.where(push > 0, 0, np.clip(-push / 8.0, 0, 1))
        out[:, 2] = np.clip(a[:, 1], -1, 1) * 0.3
    else:
        throttle = np.clip(np.clip(a[:, 0], -1, 1) * 0.5 + 0.5, 0, 1)
        brake = np.clip(a[:, 2], -1, 1) * 0.5 + 0.5
        brake = np.where((brake < 0.05) | (throttle > brake), 0.0, brake)
        out[:, 0], out[:, 1], out[:, 2] = throttle, brake, np.clip(a[:, 1], -1, 1) * 0.3
    return out


class VectorEnv(gym.vector.VectorEnv[Any, Any, Any]):
    """`num_envs` scenes, each an episode drawn from the bank; an ended scene starts another one in the same step.

    Observations [num_envs, 4 | 24] float32, actions as `action_space`, reward SafeBench's
    (-1 collision + speed along the lane - 10 above 8 m/s - 1 beyond 4 m - 5 steer^2 - 0.2 |steer| v^2).
    Terminated by collision or completion, truncated by the episode's limits. `info["end"]` names why.
    """

    metadata = {"autoreset_mode": gym.vector.AutoresetMode.SAME_STEP, "render_modes": []}  # noqa: RUF012

    def __init__(
        self,
        episodes: Sequence[Episode],
        graphs: Mapping[str, LaneGraph],
        num_envs: int,
        *,
        observation: Observation = "safebench",
        action: Action = "safebench",
        device: str = "cpu",
    ) -> None:
        super().__init__()
        if num_envs < 1:
            raise ConfigError(f"num_envs must be at least 1, not {num_envs}")
        self.num_envs = num_envs
        self.single_observation_space = observation_space(observation)
        self.single_action_space = action_space(action)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._slice = _SLICE[observation]
        self._action: Action = action
        self.world = World(
            episodes,
            graphs,
            assign=np.arange(num_envs) % len(episodes),
            device=device,
            ego=Controller.EXTERNAL,
        )

    def _observe(self) -> npt.NDArray[np.float32]:
        rows = self.world.observe()[:, self._slice]
        return np.clip(rows, -_BOUND, _BOUND).astype(np.float32)

    def _draw(self, count: int) -> npt.NDArray[np.int32]:
        return self.np_random.integers(len(self.world.episodes), size=count).astype(np.int32)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[np.float32], dict[str, Any]]:
        """Start all scenes; `options={"episodes": [...]}` says which episode of the bank each one runs."""
        one = seed[0] if isinstance(seed, list) else seed
        super().reset(seed=one)
        chosen = (options or {}).get("episodes")
        order = self._draw(self.num_envs) if chosen is None else np.asarray(chosen, np.int32)
        self.world.reset(episodes=order)
        return self._observe(), {"episode": order.copy()}

    def step(
        self, actions: npt.NDArray[np.floating[Any]]
    ) -> tuple[
        npt.NDArray[np.float32],
        npt.NDArray[np.float64],
        npt.NDArray[np.bool_],
        npt.NDArray[np.bool_],
        dict[str, Any],
    ]:
        """One step of 0.1 s in every scene."""
        self.world.step(to_controls(self._action, actions))
        end = self.world.ended().copy()
        reward = self.world.array("ego.reward").astype(np.float64)
        terminated = (end == End.COLLISION) | (end == End.COMPLETE)
        truncated = (end != 0) & ~terminated
        info: dict[str, Any] = {}
        done = np.flatnonzero(end != 0)
        observation = self._observe()
        if len(done):
            final = np.full(self.num_envs, None, dtype=object)
            for b in done:
                final[b] = observation[b].copy()
            info = {
                "final_obs": final,
                "_final_obs": end != 0,
                "end": np.array([ENDS[k] for k in end], dtype=object),
                "_end": end != 0,
            }
            self.world.reset(done, episodes=self._draw(len(done)))
            observation = self._observe()
        return observation, reward, terminated, truncated, info


class SingleEnv(gym.Env[Any, Any]):
    """One scene of the same world; reset draws the episode from its seeded generator."""

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(
        self,
        episodes: Sequence[Episode],
        graphs: Mapping[str, LaneGraph],
        *,
        observation: Observation = "safebench",
        action: Action = "safebench",
        device: str = "cpu",
    ) -> None:
        self.observation_space = observation_space(observation)
        self.action_space = action_space(action)
        self._slice = _SLICE[observation]
        self._action: Action = action
        self.world = World(episodes, graphs, assign=[0], device=device, ego=Controller.EXTERNAL)

    def _observe(self) -> npt.NDArray[np.float32]:
        row = self.world.observe()[0, self._slice]
        return np.clip(row, -_BOUND, _BOUND).astype(np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[np.float32], dict[str, Any]]:
        """Start an episode; `options={"episode": k}` chooses it."""
        super().reset(seed=seed)
        chosen = (options or {}).get("episode")
        k = int(self.np_random.integers(len(self.world.episodes))) if chosen is None else int(chosen)
        self.world.reset([0], episodes=[k])
        return self._observe(), {"episode": k}

    def step(
        self, action: npt.NDArray[np.float32]
    ) -> tuple[npt.NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """One step of 0.1 s."""
        self.world.step(to_controls(self._action, np.asarray(action)[None]))
        end = int(self.world.ended()[0])
        terminated = end in (End.COLLISION, End.COMPLETE)
        reward = float(self.world.array("ego.reward")[0])
        info = {"end": ENDS[end]} if end else {}
        return self._observe(), reward, terminated, end != 0 and not terminated, info
