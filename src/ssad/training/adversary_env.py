"""One adversary a scene as a vector environment of stable-baselines3: the ego and everybody else are part of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from stable_baselines3.common.vec_env import VecEnv

from ssad.core.driving import Driver, WorldState
from ssad.core.lane_graph import LaneGraph
from ssad.core.seeding import generator
from ssad.core.types import F64, I32, Bool, Controller, End, Episode
from ssad.drivers import make_system
from ssad.training.hindsight import Hindsight
from ssad.world.actions import ACTIONS, WIDTHS, to_controls
from ssad.world.rewards import adversary as adversary_reward
from ssad.world.rewards import colliding, cost_of, distance_to_goal, feasible, hit_ego
from ssad.world.rollout import Loop
from ssad.world.sb3 import Alike
from ssad.world.selection import FreaSelection, Note
from ssad.world.sensors import SENSORS
from ssad.world.world import World

_ADVERSARY = 1_000  # number of the driver of adversaries, beyond those of the loop


class AdversaryEnv(Alike, VecEnv):  # type: ignore[misc]  # stable-baselines3 may not be installed
    """`num_envs` scenes with one adversary at a time, which FREA's rules choose and let go.

    An adversary's time from choice to release is an episode of the learner. It is terminated by a contact or by the
    goal, truncated when it is let go for another reason or the scene ends. Where a scene has no adversary, its row is
    an episode of one step with zeros for an observation and no reward.

    Args:
        episodes: What scenes run.
        graphs: Lane graphs of their towns.
        num_envs: Scenes.
        ego: Drives the egos.
        seed: Of the draws of episodes.
        reward: `adversary`, `colliding` (equation 5) or `feasible` of `ssad.world.rewards`.
        literal: Equation 6 as it is printed, see `ssad.world.rewards.adversary`.
        off_road: What a step off the road costs, likewise.
        scale: The reward is multiplied by it.
        action: As in `ssad.world.actions.to_controls`.
    """

    def __init__(
        self,
        episodes: Sequence[Episode],
        graphs: Mapping[str, LaneGraph],
        num_envs: int,
        *,
        ego: Driver,
        seed: int = 0,
        reward: str = "adversary",
        literal: bool = False,
        off_road: float = 0.0,
        scale: float = 0.05,
        action: str = "adversary",
    ) -> None:
        bound = np.float32(1.0e4)
        space = gym.spaces.Box(-bound, bound, (WIDTHS["adversary"],), np.float32)
        self.render_mode = None
        super().__init__(num_envs, space, gym.spaces.Box(-1.0, 1.0, (ACTIONS[action],), np.float32))
        self.world = World(episodes, graphs, assign=np.arange(num_envs) % len(episodes))
        self.loop = Loop(self.world, {0: ego}, policies=make_system)
        self.select = FreaSelection(count=1)
        self._reward: Any = {
            "adversary": partial(adversary_reward, literal=literal, off_road=off_road),
            "colliding": colliding,
            "feasible": partial(self._feasible, off_road=off_road),
        }[reward]
        self._hindsight = Hindsight(num_envs, self.world.agents, dt=self.world.dt) if reward == "feasible" else None
        self._before = cost_of if reward == "colliding" else distance_to_goal
        self._scale, self._action = scale, action
        self._random = generator("adversary episodes", seed)
        self._who = np.full(num_envs, -1)  # agent of each scene's adversary, -1: none
        self._returns, self._lengths = np.zeros(num_envs), np.zeros(num_envs, np.int64)
        self._actions: npt.NDArray[Any] = np.zeros((num_envs, 2), np.float32)

    def reset(self) -> npt.NDArray[np.float32]:
        """Start all scenes."""
        self._start()
        self._who[:] = -1
        self._returns[:], self._lengths[:] = 0.0, 0
        self._choose()
        return self._observe(self._who)

    def step_async(self, actions: npt.NDArray[Any]) -> None:
        """Keep the actions of the next step."""
        self._actions = actions

    def step_wait(
        self,
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32], npt.NDArray[np.bool_], list[dict[str, Any]]]:
        """One step of 0.1 s in every scene."""
        world, who = self.world, self._who.copy()
        acting = np.flatnonzero(who >= 0)
        agents = np.stack([acting, who[acting]], 1).astype(np.int32)
        before = self._before(world.state(), agents)
        controls = np.zeros((self.num_envs, world.agents, 4), np.float32)
        controls[acting, who[acting]] = to_controls(self._action, self._actions[acting])
        self.loop.step(controls)
        state = world.state()
        if self._hindsight is not None:
            self._hindsight.note(state)
        reward = np.zeros(self.num_envs)
        gain: F64 = self._reward(state, agents, before)
        reward[acting] = self._scale * gain
        self._returns[acting] += gain
        self._lengths[acting] += 1
        seen = self._observe(who)  # before anybody leaves
        touched = np.zeros(self.num_envs, bool)
        touched[acting] = state.touch[acting, who[acting]] != 0
        ended = world.ended() != End.RUNNING
        self._choose()
        arrived = np.zeros(self.num_envs, bool)
        arrived[acting] = (world.state().note[acting, who[acting]] & Note.ARRIVED) != 0  # type: ignore[index]
        released = (who >= 0) & ((self._who != who) | ended)
        terminated = released & (touched | arrived)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for b in np.flatnonzero(released).tolist():
            infos[b] = {
                "terminal_observation": seen[b],
                "TimeLimit.truncated": not terminated[b],
                "episode": {"r": float(self._returns[b]) * self._scale, "l": int(self._lengths[b]), "t": 0.0},
            }
        self._returns[released], self._lengths[released] = 0.0, 0
        over = np.flatnonzero(ended)
        if len(over):
            self._start(over)
            self._who[over] = -1
        return self._observe(self._who), reward.astype(np.float32), released | (who < 0), infos

    def _start(self, scenes: npt.NDArray[np.intp] | None = None) -> None:
        """Start scenes again, None: all."""
        self.loop.reset(scenes, episodes=self._draw(self.num_envs if scenes is None else len(scenes)))
        if self._hindsight is not None:
            self._hindsight.forget(np.arange(self.num_envs) if scenes is None else scenes)

    def _feasible(self, state: WorldState, agents: I32, before: F64, *, off_road: float) -> F64:
        """`feasible`, with hindsight for those who touch the ego."""
        assert self._hindsight is not None
        avoided = hit_ego(state, agents)
        if avoided.any():
            avoided[avoided] = self._hindsight.avoided(state, agents[avoided])
        return feasible(state, agents, before, avoided, off_road=off_road)

    def _draw(self, count: int) -> I32:
        return self._random.integers(len(self.world.episodes), size=count).astype(np.int32)

    def _choose(self) -> None:
        """Let adversaries go and choose new ones, in the order in which `Loop` does."""
        choice = self.select(self.world.state())
        running = self.world.ended() == End.RUNNING
        chosen: Bool = choice.agents & running[:, None]
        now = np.where(chosen.any(1), chosen.argmax(1), -1)
        self.world.keep_note(choice.note)
        if choice.remove.any():
            self.world.remove(choice.remove)
        had = np.zeros(chosen.shape, bool)
        held = np.flatnonzero(self._who >= 0)
        had[held, self._who[held]] = True
        if (had & ~chosen).any():
            self.world.take(had & ~chosen, None)
        if (chosen & ~had).any():
            self.world.take(chosen & ~had, Controller.EXTERNAL, policy=_ADVERSARY)
        self._who = now

    def _observe(self, who: npt.NDArray[np.integer[Any]]) -> npt.NDArray[np.float32]:
        """[num_envs, 24]; zeros where there is no adversary."""
        agents = np.stack([np.arange(self.num_envs), np.maximum(who, 0)], 1).astype(np.int32)
        rows = SENSORS["adversary"](self.world, agents)
        return np.where((who >= 0)[:, None], rows, 0.0).astype(np.float32)
