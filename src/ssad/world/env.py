"""Gymnasium environments of the world: a vector environment over a whole batch, and its single-scene form."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, get_args

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.vector.utils import batch_space

from ssad.core.driving import Policies
from ssad.core.errors import ConfigError, unknown_name
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
# Observations are clipped to this, so that the spaces have finite bounds.
_BOUND = np.float32(1.0e4)


def observation_space(kind: Observation) -> gym.spaces.Box:
    """Return the space of `safebench` [4], `frea` [24] or `traffic` [69]; see `ssad.world.sensors.SENSORS`."""
    if kind not in get_args(Observation):
        raise ConfigError(f"unknown observation '{kind}'; known: {', '.join(get_args(Observation))}")
    return gym.spaces.Box(-_BOUND, _BOUND, (WIDTHS[kind],), np.float32)


def reward_of(reward: str | Reward) -> Reward:
    """Return a reward by its name in `ssad.world.rewards.REWARDS`; functions are returned unchanged."""
    if callable(reward):
        return reward
    if reward not in REWARDS:
        raise ConfigError(f"unknown reward '{reward}'; known: {', '.join(REWARDS)}")
    return REWARDS[reward]


def action_space(kind: Action) -> gym.spaces.Box:
    """Return the range of an action.

    `safebench` [2], `frea` [3] and `pedals` [2] in [-1, 1]: see `ssad.world.actions.to_controls`. `controls`: [3]
    throttle, brake in [0, 1] and steer in [-1, 1].
    """
    if kind == "controls":
        return gym.spaces.Box(np.array([0, 0, -1], np.float32), np.ones(3, np.float32))
    if kind not in get_args(Action):
        raise ConfigError(f"unknown action '{kind}'; known: {', '.join(get_args(Action))}")
    return gym.spaces.Box(-1.0, 1.0, (ACTIONS[kind],), np.float32)


def _check_options(options: Mapping[str, Any] | None, allowed: Sequence[str]) -> Mapping[str, Any]:
    """Return the options of a reset. ConfigError for keys that it does not know, or that exclude each other."""
    for key in options or {}:
        if key not in allowed:
            raise ConfigError(f"unknown option '{key}' of reset; known: {', '.join(allowed)}")
    given = {key: value for key, value in (options or {}).items() if value is not None}
    if len(given) > 1:
        raise ConfigError(f"reset takes one of the options {' and '.join(given)}: both choose what is driven")
    return given


def _draw_episode(episodes: Sequence[Episode], scenario: str | None, random: np.random.Generator) -> int:
    """Return the number of a random episode of a scenario or a group of scenarios; None: of the whole bank."""
    if scenario is None:
        return int(random.integers(len(episodes)))
    candidates = [index for index, episode in enumerate(episodes) if episode.scenario.name == scenario]
    candidates = candidates or [index for index, episode in enumerate(episodes) if episode.scenario.group == scenario]
    if not candidates:
        raise unknown_name("scenario", str(scenario), {item.scenario.name for item in episodes})
    return candidates[int(random.integers(len(candidates)))]


class VectorEnv(gym.vector.VectorEnv[Any, Any, Any]):
    """Vector environment of `num_envs` scenes, each an episode sampled from the bank.

    Observations are [num_envs, 4 | 24 | 69] float32, actions as `action_space`. An episode is terminated by collision
    or completion and truncated by its limits; `info["end"]` names the reason.

    Args:
        episodes: The bank.
        graphs: Lane graphs by town.
        num_envs: Number of scenes.
        observation: Sensor that is observed.
        action: Kind of action.
        reward: Name of a reward, or a function of the state.
        drivers: Drivers of other agents than the ego, as in `rollout`.
        policies: Makes the drivers that episodes name, as in `rollout`.
        device: Warp device.
        restart: Whether an ended scene starts another episode in the same step; else it stands still.
        render_mode: "rgb_array" or None.
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
        # Agent 0 of each scene is the ego.
        self._egos = np.stack([np.arange(num_envs), np.zeros(num_envs)], 1).astype(np.int32)
        self._controls = np.zeros((num_envs, self.world.agents, 3), np.float32)
        self.views = SceneViews(self.world)

    def render(self) -> tuple[npt.NDArray[np.uint8], ...] | None:
        """Return each scene from above, RGB uint8 [540, 960, 3], with `render_mode="rgb_array"`."""
        if self.render_mode is None:
            return None
        return tuple(self.views.draw(scene) for scene in range(self.num_envs))

    def _observe(self) -> npt.NDArray[np.float32]:
        rows: npt.NDArray[np.float32] = self._sensor(self.world, self._egos)
        return np.minimum(np.maximum(rows, -_BOUND), _BOUND)

    def _draw(self, count: int) -> npt.NDArray[np.int32]:
        return self.np_random.integers(len(self.world.episodes), size=count).astype(np.int32)

    def _choose_episodes(self, options: Mapping[str, Any]) -> npt.NDArray[np.int32]:
        """Return the episode of each scene, as the options of `reset` ask."""
        if not options:
            return self._draw(self.num_envs)
        key, value = next(iter(options.items()))
        values = [value] * self.num_envs if isinstance(value, str) else value
        if np.shape(values) != (self.num_envs,):
            raise ConfigError(
                f"option '{key}' of reset needs one for each of {self.num_envs} scenes, not {value!r:.60}"
            )
        if key == "episodes":
            return np.asarray(values, np.int32)
        return np.array([_draw_episode(self.world.episodes, name, self.np_random) for name in values], np.int32)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[np.float32], dict[str, Any]]:
        """Start all scenes, each with an episode drawn from the bank.

        Args:
            seed: Seed of this and all later draws; of a list the first.
            options: `{"scenario": NAME}` draws from the episodes of that scenario or group of scenarios;
                `{"scenario": [NAME, ...]}` names one for each scene, None: any. `{"episodes": [...]}` gives the number
                of the episode in the bank for each scene.

        Returns:
            Observations [num_envs, n], and the numbers of the episodes as `info["episode"]`.

        Raises:
            ConfigError: An option is unknown or does not fit the number of scenes.
            UnknownNameError: The bank has no such scenario.
        """
        chosen = _check_options(options, ("scenario", "episodes"))
        scalar_seed = seed[0] if isinstance(seed, list) else seed
        super().reset(seed=scalar_seed)
        assignment = self._choose_episodes(chosen)
        self._loop.reset(episodes=assignment)
        return self._observe(), {"episode": assignment.copy()}

    def step(
        self, actions: npt.NDArray[np.floating[Any]]
    ) -> tuple[
        npt.NDArray[np.float32],
        npt.NDArray[np.float64],
        npt.NDArray[np.bool_],
        npt.NDArray[np.bool_],
        dict[str, Any],
    ]:
        """Advance every scene by one step of 0.1 s."""
        values = np.asarray(actions, np.float32)
        self._controls[:, 0] = values if self._action == "controls" else to_controls(self._action, values)[:, :3]
        self._loop.step(self._controls)
        # On CPU it is a view that the restart below overwrites.
        end = self.world.ended().copy()
        reward = self._reward(self.world.state())
        terminated = (end == End.COLLISION) | (end == End.COMPLETE)
        truncated = (end != 0) & ~terminated
        info: dict[str, Any] = {}
        ended = np.flatnonzero(end != 0)
        observation = self._observe()
        if len(ended):
            final_observations = np.full(self.num_envs, None, dtype=object)
            for scene in ended:
                final_observations[scene] = observation[scene].copy()
            info = {
                "final_obs": final_observations,
                "_final_obs": end != 0,
                "end": np.array([ENDS[code] for code in end], dtype=object),
                "_end": end != 0,
            }
            if self._restart:
                self._loop.reset(ended, episodes=self._draw(len(ended)))
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
        """Start an episode.

        Args:
            seed: Seed of this and all later draws.
            options: `{"scenario": NAME}` draws from the episodes of that scenario or group of scenarios;
                `{"episode": k}` takes number k of the bank.

        Returns:
            Observation [n], and the number of the episode as `info["episode"]`.

        Raises:
            ConfigError: An option is unknown, or the bank has no such episode.
            UnknownNameError: The bank has no such scenario.
        """
        chosen = _check_options(options, ("scenario", "episode"))
        super().reset(seed=seed)
        episode_index = (
            int(chosen["episode"])
            if "episode" in chosen
            else _draw_episode(self.world.episodes, chosen.get("scenario"), self.np_random)
        )
        observation, _ = self._many.reset(options={"episodes": [episode_index]})
        self._show()
        return observation[0], {"episode": episode_index}

    def step(
        self, action: npt.NDArray[np.float32]
    ) -> tuple[npt.NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Advance the scene by one step of 0.1 s."""
        observation, reward, terminated, truncated, info = self._many.step(np.asarray(action)[None])
        step_info = {"end": info["end"][0]} if "end" in info else {}
        self._show()
        return observation[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), step_info

    def _show(self) -> None:
        if self._window is not None:
            self._window.show(self._many.views.draw(0))

    def render(self) -> Any:
        """Return the scene from above, RGB uint8 [540, 960, 3]; None with "human" or without a render mode."""
        return self._many.views.draw(0) if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Close the window."""
        if self._window is not None:
            self._window.close()
