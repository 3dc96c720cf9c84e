"""The world as a vector environment of stable-baselines3; needs the extra `train`."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.spaces import Discrete
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from ssad.world.actions import CHOICES
from ssad.world.env import VectorEnv


class SharedAttributes:
    """Attribute access of a stable-baselines3 vector environment whose scenes have no attributes of their own."""

    num_envs: int

    def close(self) -> None:
        """Do nothing: there is no process or window to close."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of this environment, once for each scene."""
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of this environment, shared by all scenes."""
        setattr(self, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **options: Any) -> list[Any]:
        """Call a method of this environment, once for each scene."""
        return [getattr(self, method_name)(*args, **options) for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Return False for each scene: scenes are never wrapped."""
        return [False for _ in self._get_indices(indices)]

    def _get_indices(self, indices: Any) -> Sequence[int]:
        scene_indices: Sequence[int] = range(self.num_envs) if indices is None else np.atleast_1d(indices).tolist()
        return scene_indices


class SB3VecEnv(SharedAttributes, VecEnv):  # type: ignore[misc]  # stable-baselines3 may not be installed
    """All scenes of a `VectorEnv` in stable-baselines3's interface, without a process or a wrapper per scene.

    An ended scene starts another episode in the same step. `infos` of its row then hold `terminal_observation`,
    `TimeLimit.truncated`, `episode` (return `r`, length `l`, seconds `t`) and `end`, the reason; other rows are
    empty.
    """

    def __init__(self, environment: VectorEnv) -> None:
        self.environment = environment
        self.render_mode = None
        self._actions: npt.NDArray[Any] = np.zeros(0, np.float32)
        self._returns = np.zeros(environment.num_envs)
        self._lengths = np.zeros(environment.num_envs, np.int64)
        self._began = time.time()
        super().__init__(environment.num_envs, environment.single_observation_space, environment.single_action_space)

    def reset(self) -> npt.NDArray[np.float32]:
        """Start all scenes with the seed given to `seed` and the scenario given to `set_options`, if any."""
        given = {key for options in self._options for key in options}
        # Scenes to which `set_options` gives no scenario draw theirs.
        options = {key: [options.get(key) for options in self._options] for key in given}
        observation, _ = self.environment.reset(seed=self._seeds[0], options=options)
        self._reset_seeds()
        self._reset_options()
        self._returns[:] = 0.0
        self._lengths[:] = 0
        return observation

    def step_async(self, actions: npt.NDArray[Any]) -> None:
        """Store the actions of the next step."""
        self._actions = actions

    def step_wait(
        self,
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32], npt.NDArray[np.bool_], list[dict[str, Any]]]:
        """Advance every scene by one step of 0.1 s."""
        observation, reward, terminated, truncated, info = self.environment.step(self._actions)
        ended = terminated | truncated
        self._returns += reward
        self._lengths += 1
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for scene in np.flatnonzero(ended).tolist():
            episode = {
                "r": float(self._returns[scene]),
                "l": int(self._lengths[scene]),
                "t": round(time.time() - self._began, 6),
            }
            infos[scene] = {
                "terminal_observation": info["final_obs"][scene],
                "TimeLimit.truncated": bool(truncated[scene]),
                "episode": episode,
                "end": info["end"][scene],
            }
        self._returns[ended] = 0.0
        self._lengths[ended] = 0
        return observation, reward.astype(np.float32), ended, infos


class DiscreteActions(VecEnvWrapper):  # type: ignore[misc]  # stable-baselines3 may not be installed
    """Wrapper for algorithms with discrete actions: actions are row numbers of `ssad.world.actions.CHOICES`."""

    def __init__(self, venv: VecEnv) -> None:
        super().__init__(venv, action_space=Discrete(len(CHOICES)))

    def reset(self) -> Any:
        """Start all scenes."""
        return self.venv.reset()

    def step_async(self, actions: npt.NDArray[np.integer[Any]]) -> None:
        """Store the actions of the next step [num_envs]."""
        self.venv.step_async(CHOICES[actions])

    def step_wait(self) -> Any:
        """Advance every scene by one step."""
        return self.venv.step_wait()
