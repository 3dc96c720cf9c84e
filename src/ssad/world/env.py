"""The world as Gymnasium environments: one vector environment over a whole batch, and its single-scene form."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, get_args

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.vector.utils import batch_space

from ssad.core.driving import Policies
from ssad.core.errors import ConfigError
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import ENDS, Controller, End, Episode
from ssad.world.actions import ACTIONS, WIDTHS, to_controls
from ssad.world.rewards import REWARDS, Reward
from ssad.world.rollout import Drivers, Loop
from ssad.world.scene_view import SceneViews, Window
from ssad.world.sensors import SENSORS
from ssad.world.world import World

Observation = Literal["safebench", "frea", "traffic"]
Action = Literal["safebench", "frea", "pedals", "controls"]
_BOUND = np.float32(1.0e4)


def observation_space(kind: Observation) -> gym.spaces.Box:
    """`safebench` [4], `frea` [24] and `traffic` [69]: the sensors of that name, see `ssad.world.sensors.SENSORS`."""
    if kind not in get_args(Observation):
        raise ConfigError(f"unknown observation '{kind}'; known: {', '.join(get_args(Observation))}")
    return gym.spaces.Box(-_BOUND, _BOUND, (WIDTHS[kind],), np.float32)


def reward_of(reward: str | Reward) -> Reward:
    """A reward by its name in `ssad.world.rewards.REWARDS`, or a function from a state to [B] as it is."""
    if callable(reward):
        return reward
    if reward not in REWARDS:
        raise ConfigError(f"unknown reward '{reward}'; known: {', '.join(REWARDS)}")
    return REWARDS[reward]


def action_space(kind: Action) -> gym.spaces.Box:
    """Ranges of the actions.

    `safebench` [2], `frea` [3] and `pedals` [2] in [-1, 1]: see `ssad.world.actions.to_controls`. `controls`: [3]
    throttle, brake in [0, 1] and steer in [-1, 1].
    """
    if kind == "controls":
        return gym.spaces.Box(np.array([0, 0, -1], np.float32), np.ones(3, np.float32))
    if kind not in get_args(Action):
        raise ConfigError(f"unknown action '{kind}'; known: {', '.join(get_args(Action))}")
    return gym.spaces.Box(-1.0, 1.0, (ACTIONS[kind],), np.float32)


class VectorEnv(gym.vector.VectorEnv[Any, Any, Any]):
    """`num_envs` scenes, each an episode drawn from the bank; an ended scene starts another one in the same step.

    Observations [num_envs, 4 | 24] float32, actions as `action_space`, `reward` "safebench", "frea" or a function of
    the state. `drivers` act for other agents than the ego, and `policies` makes those that episodes name, as in
    `rollout`. Without `restart` ended scenes stand still.
    Terminated by collision or completion, truncated by the episode's limits. `info["end"]` names why.
    """

    metadata = {  # noqa: RUF012
        "autoreset_mode": gym.vector.AutoresetMode.SAME_STEP,
        "render_modes": ["rgb_array"],
        "render_fps": 10,
    }

    def __init__(
        self,
        episodes: Sequence[Episode],
        graphs: Mapping[str, LaneGraph],
        num_envs: int,
        *,
        observation: Observation = "safebench",
        action: Action = "safebench",
        reward: str | Reward = "safebench",
        drivers: Drivers | None = None,
        policies: Policies | None = None,
        device: str = "cpu",
        restart: bool = True,
        render_mode: str | None = None,
    ) -> None:
        super().__init__()
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ConfigError(f"unknown render_mode '{render_mode}'; known: {', '.join(self.metadata['render_modes'])}")
        self.render_mode = render_mode
        if num_envs < 1:
            raise ConfigError(f"num_envs must be at least 1, not {num_envs}")
        self.num_envs = num_envs
        self.single_observation_space = observation_space(observation)
        self.single_action_space = action_space(action)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._sensor = SENSORS[observation]
        self._action: Action = action
        self._restart = restart
        self._reward = reward_of(reward)
        self.world = World(
            episodes,
            graphs,
            assign=np.arange(num_envs) % len(episodes),
            device=device,
            ego=Controller.EXTERNAL,
        )
        self._loop = Loop(self.world, drivers or {}, policies=policies)
        self._egos = np.stack([np.arange(num_envs), np.zeros(num_envs)], 1).astype(np.int32)
        self._controls = np.zeros((num_envs, self.world.agents, 3), np.float32)
        self.views = SceneViews(self.world)

    def render(self) -> tuple[npt.NDArray[np.uint8], ...] | None:
        """Each scene from above, RGB uint8 [540, 960, 3], with `render_mode="rgb_array"`."""
        if self.render_mode is None:
            return None
        return tuple(self.views.draw(b) for b in range(self.num_envs))

    def _observe(self) -> npt.NDArray[np.float32]:
        rows: npt.NDArray[np.float32] = self._sensor(self.world, self._egos)
        return np.minimum(np.maximum(rows, -_BOUND), _BOUND)

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
        self._loop.reset(episodes=order)
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
        given = np.asarray(actions, np.float32)
        self._controls[:, 0] = given if self._action == "controls" else to_controls(self._action, given)[:, :3]
        self._loop.step(self._controls)
        end = self.world.ended().copy()
        reward = self._reward(self.world.state())
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
            if self._restart:
                self._loop.reset(done, episodes=self._draw(len(done)))
                observation = self._observe()
        return observation, reward, terminated, truncated, info


class SingleEnv(gym.Env[Any, Any]):
    """One scene of the same world; reset draws the episode from its seeded generator. Options as `VectorEnv`.

    With `render_mode` "rgb_array" `render` returns the scene from above, [540, 960, 3]; with "human" each step shows it
    in a window, which needs the extra `window`.
    """

    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": 10}  # noqa: RUF012

    def __init__(
        self,
        episodes: Sequence[Episode],
        graphs: Mapping[str, LaneGraph],
        *,
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ConfigError(f"unknown render_mode '{render_mode}'; known: {', '.join(self.metadata['render_modes'])}")
        self.render_mode = render_mode
        self._window = Window(self.metadata["render_fps"]) if render_mode == "human" else None
        self._many = VectorEnv(episodes, graphs, 1, restart=False, **options)
        self.world = self._many.world
        self.observation_space = self._many.single_observation_space
        self.action_space = self._many.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[np.float32], dict[str, Any]]:
        """Start an episode; `options={"episode": k}` chooses it."""
        super().reset(seed=seed)
        chosen = (options or {}).get("episode")
        k = int(self.np_random.integers(len(self.world.episodes))) if chosen is None else int(chosen)
        observation, _ = self._many.reset(options={"episodes": [k]})
        self._show()
        return observation[0], {"episode": k}

    def step(
        self, action: npt.NDArray[np.float32]
    ) -> tuple[npt.NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """One step of 0.1 s."""
        observation, reward, terminated, truncated, info = self._many.step(np.asarray(action)[None])
        about = {"end": info["end"][0]} if "end" in info else {}
        self._show()
        return observation[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), about

    def _show(self) -> None:
        if self._window is not None:
            self._window.show(self._many.views.draw(0))

    def render(self) -> Any:
        """The scene from above, RGB uint8 [540, 960, 3]; None where a window shows it, or nothing was asked for."""
        return self._many.views.draw(0) if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Close the window."""
        if self._window is not None:
            self._window.close()
