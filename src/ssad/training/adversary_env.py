"""Vector environment of stable-baselines3 with one adversary in each scene; all other agents are part of it."""

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
from ssad.core.rotations import wrap_angle
from ssad.core.seeding import generator
from ssad.core.types import DEFAULT_FRICTION, F32, F64, I32, MOVING, Bool, Controller, End, Episode
from ssad.drivers import make_system
from ssad.metrics.proven_collisions import LIMIT_TOLERANCE, WRONG_WAY_TIME
from ssad.training.feasibility import FeasibleRegion, region_states
from ssad.training.hindsight import Hindsight
from ssad.world.actions import ACTIONS, WIDTHS, to_controls
from ssad.world.models import lateral_grip
from ssad.world.rewards import adversary as adversary_reward
from ssad.world.rewards import (
    colliding,
    cost_of,
    distance_to_goal,
    drives_against,
    feasible,
    hit_ego,
    hit_others,
    lawful,
    proving,
)
from ssad.world.rollout import Loop
from ssad.world.sb3 import SharedAttributes
from ssad.world.selection import FreaSelection, Note
from ssad.world.sensors import SENSORS
from ssad.world.world import World

_ADVERSARY = 1_000  # index of the adversaries' driver, beyond those of the loop


class Conduct:
    """Record of whether each adversary has met the conditions of a proven collision since it was selected.

    It must not drive against traffic for 0.3 s or at present, leave the road, turn harder than its tyres allow, or
    touch another agent than the ego. See `ssad.metrics.proven_collisions`.
    """

    def __init__(self, scenes: int, *, dt: float) -> None:
        self._dt = dt
        self._wrong_steps = np.zeros(scenes, np.int64)
        self._is_flawed = np.zeros(scenes, bool)
        self._was_on_road = np.zeros(scenes, bool)

    def begin(self, scenes: npt.ArrayLike) -> None:
        """Start anew in scenes with another adversary."""
        index = np.asarray(scenes)
        self._wrong_steps[index], self._is_flawed[index], self._was_on_road[index] = 0, False, False

    def record(self, state: WorldState, agents: I32, alignment: F32, previous_yaw: F32) -> Bool:
        """Record a step; return [N] whether the adversaries have met the conditions until now.

        Args:
            state: After the step.
            agents: [N, 2] scene and agent of the adversaries.
            alignment: [N] first number of the sensor `road`.
            previous_yaw: [N] heading before the step, rad.
        """
        scene, agent = agents.T
        is_against = drives_against(state, agents, alignment)
        self._wrong_steps[scene] = np.where(is_against, self._wrong_steps[scene] + 1, 0)
        on_road = state.lane[scene, agent] >= 0
        turn = np.abs(np.asarray(wrap_angle(state.pose[scene, agent, 2] - previous_yaw)))
        lateral = np.abs(state.speed[scene, agent]) * turn / self._dt
        self._is_flawed[scene] |= (
            (self._wrong_steps[scene] >= round(WRONG_WAY_TIME / self._dt))
            | (self._was_on_road[scene] & ~on_road)
            | (lateral > LIMIT_TOLERANCE * lateral_grip(DEFAULT_FRICTION))
            | hit_others(state, agents)
        )
        self._was_on_road[scene] |= on_road
        is_unflawed: Bool = ~self._is_flawed[scene] & ~is_against
        return is_unflawed


class AdversaryEnv(SharedAttributes, VecEnv):  # type: ignore[misc]  # stable-baselines3 may not be installed
    """`num_envs` scenes with one adversary at a time, selected and released by FREA's rules.

    The time from selection to release of an adversary is an episode of the learner. A contact or the goal terminates
    it; release for another reason or the end of the scene truncates it. A scene without an adversary yields episodes
    of one step with a zero observation and no reward.

    Args:
        episodes: Episodes of the scenes.
        graphs: Lane graphs of their towns.
        num_envs: Number of scenes.
        ego: Driver of the egos.
        seed: Seed of the draws of episodes.
        reward: `adversary`, `colliding` (equation 5), `feasible`, `lawful` or `proving` of `ssad.world.rewards`.
        literal: Equation 6 as it is printed, see `ssad.world.rewards.adversary`.
        off_road: Cost of a step off the road, likewise.
        against: Cost of a step against traffic; of the rewards `lawful` and `proving`.
        scale: Factor on the reward.
        action: As in `ssad.world.actions.to_controls`.
        observation: Sensor that the adversaries look at.
        region: Feasible region whose values `region_values` holds; None: none.

    Attributes:
        region_values: [2, num_envs] value of the region before and after the last step; 0 without an adversary.
        is_driven: [num_envs] whether there was an adversary in the last step.
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
        against: float = 1.0,
        scale: float = 0.05,
        action: str = "adversary",
        observation: str = "adversary",
        region: FeasibleRegion | None = None,
    ) -> None:
        bound = np.float32(1.0e4)
        space = gym.spaces.Box(-bound, bound, (WIDTHS[observation],), np.float32)
        self.render_mode = None
        super().__init__(num_envs, space, gym.spaces.Box(-1.0, 1.0, (ACTIONS[action],), np.float32))
        self.world = World(episodes, graphs, assign=np.arange(num_envs) % len(episodes))
        self.loop = Loop(self.world, {0: ego}, policies=make_system)
        self.select = FreaSelection(count=1)
        self._reward: Any = {
            "adversary": partial(adversary_reward, literal=literal, off_road=off_road),
            "colliding": colliding,
            "feasible": partial(self._feasible, off_road=off_road),
            "lawful": partial(self._lawful, off_road=off_road, against=against),
            "proving": partial(self._proving, off_road=off_road, against=against),
        }[reward]
        is_judged = reward in ("feasible", "proving")
        self._hindsight = Hindsight(num_envs, self.world.agents, dt=self.world.dt) if is_judged else None
        self._conduct = Conduct(num_envs, dt=self.world.dt) if reward == "proving" else None
        self._previous_yaw = np.zeros(0, np.float32)
        self._observation, self._region = observation, region
        self.region_values, self.is_driven = np.zeros((2, num_envs), np.float32), np.zeros(num_envs, bool)
        self._previous_cost = cost_of if reward == "colliding" else distance_to_goal
        self._scale, self._action = scale, action
        self._random = generator("adversary episodes", seed)
        self._adversaries = np.full(num_envs, -1)  # agent of each scene's adversary, -1: none
        self._returns, self._lengths = np.zeros(num_envs), np.zeros(num_envs, np.int64)
        self._actions: npt.NDArray[Any] = np.zeros((num_envs, 2), np.float32)

    def reset(self) -> npt.NDArray[np.float32]:
        """Start all scenes."""
        self._start()
        self._adversaries[:] = -1
        self._returns[:], self._lengths[:] = 0.0, 0
        self._choose()
        return self._observe(self._adversaries)

    def step_async(self, actions: npt.NDArray[Any]) -> None:
        """Store the actions of the next step."""
        self._actions = actions

    def step_wait(
        self,
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32], npt.NDArray[np.bool_], list[dict[str, Any]]]:
        """Advance every scene by one step of 0.1 s."""
        world, adversary = self.world, self._adversaries.copy()
        active_scenes = np.flatnonzero(adversary >= 0)
        agents = np.stack([active_scenes, adversary[active_scenes]], 1).astype(np.int32)
        state = world.state()
        before_step = self._previous_cost(state, agents)
        self._previous_yaw = state.pose[active_scenes, adversary[active_scenes], 2].copy()
        self.is_driven = adversary >= 0
        self.region_values[:] = 0.0
        self.region_values[0, active_scenes] = self._region_value(state, agents)
        controls = np.zeros((self.num_envs, world.agents, 4), np.float32)
        controls[active_scenes, adversary[active_scenes]] = to_controls(self._action, self._actions[active_scenes])
        self.loop.step(controls)
        state = world.state()
        self.region_values[1, active_scenes] = self._region_value(state, agents)
        if self._hindsight is not None:
            self._hindsight.record(state)
        reward = np.zeros(self.num_envs)
        rewards: F64 = self._reward(state, agents, before_step)
        reward[active_scenes] = self._scale * rewards
        self._returns[active_scenes] += rewards
        self._lengths[active_scenes] += 1
        observation = self._observe(adversary)  # before agents are released or removed
        in_contact = np.zeros(self.num_envs, bool)
        in_contact[active_scenes] = state.touch[active_scenes, adversary[active_scenes]] != 0
        has_ended = world.ended() != End.RUNNING
        self._choose()
        arrived = np.zeros(self.num_envs, bool)
        arrived[active_scenes] = (world.state().note[active_scenes, adversary[active_scenes]] & Note.ARRIVED) != 0  # type: ignore[index]
        is_released = (adversary >= 0) & ((self._adversaries != adversary) | has_ended)
        terminated = is_released & (in_contact | arrived)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for scene in np.flatnonzero(is_released).tolist():
            infos[scene] = {
                "terminal_observation": observation[scene],
                "TimeLimit.truncated": not terminated[scene],
                "episode": {"r": float(self._returns[scene]) * self._scale, "l": int(self._lengths[scene]), "t": 0.0},
            }
        self._returns[is_released], self._lengths[is_released] = 0.0, 0
        ended_scenes = np.flatnonzero(has_ended)
        if len(ended_scenes):
            self._start(ended_scenes)
            self._adversaries[ended_scenes] = -1
        return self._observe(self._adversaries), reward.astype(np.float32), is_released | (adversary < 0), infos

    def _start(self, scenes: npt.NDArray[np.intp] | None = None) -> None:
        """Restart scenes; None: all."""
        self.loop.reset(scenes, episodes=self._draw(self.num_envs if scenes is None else len(scenes)))
        if self._hindsight is not None:
            self._hindsight.forget(np.arange(self.num_envs) if scenes is None else scenes)

    def _feasible(self, state: WorldState, agents: I32, previous_cost: F64, *, off_road: float) -> F64:
        """Return the reward `feasible`, with hindsight for adversaries in contact with the ego."""
        assert self._hindsight is not None
        avoidable = hit_ego(state, agents)
        if avoidable.any():
            avoidable[avoidable] = self._hindsight.is_avoidable(state, agents[avoidable])
        return feasible(state, agents, previous_cost, avoidable, off_road=off_road)

    def _lawful(self, state: WorldState, agents: I32, previous_cost: F64, *, off_road: float, against: float) -> F64:
        """Return the reward `lawful`."""
        alignment = self._alignment(agents)
        return lawful(state, agents, previous_cost, alignment, off_road=off_road, against=against)

    def _proving(self, state: WorldState, agents: I32, previous_cost: F64, *, off_road: float, against: float) -> F64:
        """Return the reward `proving`, with hindsight for adversaries in contact with the ego."""
        assert self._hindsight is not None
        assert self._conduct is not None
        alignment = self._alignment(agents)
        proven = self._conduct.record(state, agents, alignment, self._previous_yaw)
        proven &= hit_ego(state, agents) & (np.abs(state.speed[agents[:, 0], 0]) > MOVING)
        if proven.any():
            proven[proven] = self._hindsight.is_avoidable(state, agents[proven])
        return proving(state, agents, previous_cost, alignment, proven, off_road=off_road, against=against)

    def _alignment(self, agents: I32) -> F32:
        """Return how well the road under adversaries [N, 2] fits their course, [N]; see the sensor `road`."""
        alignment: F32 = SENSORS["road"](self.world, self._rows(agents))[agents[:, 0], 0]
        return alignment

    def _rows(self, agents: I32) -> I32:
        """Return an agent of every scene [num_envs, 2], those of `agents` where there are any.

        Sensors keep their buffers as long as they are asked for as many agents.
        """
        rows = np.stack([np.arange(self.num_envs), np.zeros(self.num_envs, np.int64)], 1).astype(np.int32)
        rows[agents[:, 0], 1] = agents[:, 1]
        return rows

    def _region_value(self, state: WorldState, agents: I32) -> F32:
        """Return the value [N] of the feasible region for the egos of adversaries; 0 without a region."""
        if self._region is None or not len(agents):
            return np.zeros(len(agents), np.float32)
        return self._region.value(region_states(state, agents[:, 0], agents[:, 1]))

    def _draw(self, count: int) -> I32:
        return self._random.integers(len(self.world.episodes), size=count).astype(np.int32)

    def _choose(self) -> None:
        """Release adversaries and select new ones, in the same order as `Loop`."""
        choice = self.select(self.world.state())
        running = self.world.ended() == End.RUNNING
        selected: Bool = choice.agents & running[:, None]
        adversary = np.where(selected.any(1), selected.argmax(1), -1)
        self.world.keep_note(choice.note)
        if choice.remove.any():
            self.world.remove(choice.remove)
        is_taken = np.zeros(selected.shape, bool)
        occupied_scenes = np.flatnonzero(self._adversaries >= 0)
        is_taken[occupied_scenes, self._adversaries[occupied_scenes]] = True
        if (is_taken & ~selected).any():
            self.world.take(is_taken & ~selected, None)
        if (selected & ~is_taken).any():
            self.world.take(selected & ~is_taken, Controller.EXTERNAL, policy=_ADVERSARY)
            if self._conduct is not None:
                self._conduct.begin(np.flatnonzero((selected & ~is_taken).any(1)))
        self._adversaries = adversary

    def _observe(self, agent_indices: npt.NDArray[np.integer[Any]]) -> npt.NDArray[np.float32]:
        """[num_envs, n]; zeros where there is no adversary."""
        # The sensor needs a valid agent in every row; rows without an adversary are zeroed below.
        agents = np.stack([np.arange(self.num_envs), np.maximum(agent_indices, 0)], 1).astype(np.int32)
        rows = SENSORS[self._observation](self.world, agents)
        return np.where((agent_indices >= 0)[:, None], rows, 0.0).astype(np.float32)
