"""Selection and release of adversaries: FREA's rule, as a selector for `ssad.world.rollout`.

    from ssad.world.selection import FreaSelection
    traces = rollout(world, {0: ego, FreaSelection(): adversary})

Its memory (chosen agents and agents that have reached the goal) is noted on the agents, so that snapshots and
hashes of the world hold it.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag
from typing import Literal

import numpy as np

from ssad.core.driving import Choice, WorldState
from ssad.core.errors import ConfigError
from ssad.core.geometry import to_local
from ssad.core.types import F64, I32, AgentKind, Bool
from ssad.world.rewards import GOAL_AHEAD, GOAL_RADIUS, goals

VEHICLES = (AgentKind.CAR, AgentKind.TRUCK, AgentKind.BUS, AgentKind.MOTORCYCLE, AgentKind.BICYCLE)
_PERIOD = 0.2  # s from one choice to the next: every second step


class Note(IntFlag):
    """Note of the selector on an agent."""

    CHOSEN = 1
    ARRIVED = 2  # it has reached the goal, and is not chosen again


@dataclass(frozen=True)
class FreaSelection:
    """FREA's rule-based choice of adversaries ("critical background vehicles").

    Every 0.2 s, while fewer than `count` are chosen, it chooses the nearest agent to the ego within `radius` that can
    interact with it and is not blocked by a vehicle that has reached the goal. An adversary is released, and can be
    chosen again, when it can no longer interact (with looser limits) or is blocked. It is released for good when it
    has reached the goal. After a contact it leaves the scene.

    Attributes:
        count: Simultaneous adversaries per scene.
        radius: m.
        kinds: Kinds of agents that can be adversaries.
        remove: Whether an adversary leaves the scene after a contact; else it is released for good.
        blocked: Vehicles that a vehicle at the goal blocks: "ahead", as FREA's code has it, those directly in front
            of it; "behind", as its comments say, those that have it directly in front of them.

    Source: FREA (Chen et al. 2024), `CBVs_selection`, `get_CBV_candidates`, `check_interaction` and
    `check_CBV_BV_stuck` of its code.
    """

    count: int = 2
    radius: float = 25.0
    kinds: tuple[AgentKind, ...] = VEHICLES
    remove: bool = True
    blocked: Literal["ahead", "behind"] = "ahead"

    def __call__(self, state: WorldState) -> Choice:
        """Select the adversaries of a state. Raises ConfigError in a simulator that keeps no notes."""
        if state.note is None:
            raise ConfigError(
                "the selection of adversaries remembers whom it has chosen: this simulator keeps no notes"
            )
        selected = (state.note & Note.CHOSEN) != 0
        arrived = (state.note & Note.ARRIVED) != 0
        collided = selected & (state.touch != 0)
        goal_points = goals(state).astype(np.float64)
        goal_distance = np.hypot(*np.moveaxis(state.pose[..., :2] - goal_points[:, None], -1, 0))
        arrived = arrived | (selected & (goal_distance < GOAL_RADIUS)) | collided
        remaining = selected & state.active & ~arrived
        remaining &= ~_behind_ego(state, 100.0, 100.0) & ~self._blocked(state, arrived & ~collided, 8.0, 10.0)
        eligible = self._candidates(state) & ~arrived & ~remaining
        eligible &= ~self._blocked(state, arrived & ~collided, 12.0, 15.0)
        distance = np.where(eligible, _to_ego(state), np.inf)
        nearest = distance.argmin(1)
        scenes = np.arange(len(nearest))
        # At the very start no agent's lane is known yet.
        is_selection_step = (np.rint(state.time / _PERIOD * 2.0).astype(np.int64) % 2 == 0) & (state.time > 0.0)
        added = is_selection_step & np.isfinite(distance[scenes, nearest]) & (remaining.sum(1) < self.count)
        remaining[scenes[added], nearest[added]] = True
        notes: I32 = (remaining * int(Note.CHOSEN) + arrived * int(Note.ARRIVED)).astype(np.int32)
        return Choice(remaining, notes, collided if self.remove else np.zeros_like(collided))

    def _candidates(self, state: WorldState) -> Bool:
        """Return the agents [B, A] that are near, drive in the goal's direction, and can interact with the ego."""
        eligible = state.active & np.isin(state.kind, self.kinds) & (_to_ego(state) <= self.radius)
        eligible[:, 0] = False
        roads = state.roads
        first_point, point_count = np.moveaxis(state.route[:, 0], -1, 0)
        goal_point = np.minimum(state.progress[:, 0] + round(GOAL_AHEAD), point_count - 1)
        goal_lane, ego_lane = roads.lane[first_point + goal_point], state.lane[:, 0]
        in_junction = _lane_values(roads.junction, goal_lane) & _lane_values(roads.junction, ego_lane)
        goal_side = np.where(goal_lane >= 0, roads.side[goal_lane], 0)[:, None]
        agent_sides = np.where(state.lane >= 0, roads.side[state.lane], 0)
        return np.asarray(
            eligible & (in_junction[:, None] | (goal_side * agent_sides >= 0)) & ~_behind_ego(state, 90.0, 90.0)
        )

    def _blocked(self, state: WorldState, arrived: Bool, reach: float, angle: float) -> Bool:
        """Return the agents [B, A] blocked by one at the goal, within `reach` m and `angle` degrees."""
        blocked_agents: Bool = np.zeros(arrived.shape, bool)
        for scene, agent in np.argwhere(arrived & state.active).tolist():
            poses = state.pose[scene]
            if self.blocked == "ahead":
                x, y = to_local(poses[agent], poses[:, :2]).T
            else:
                x, y = to_local(poses, poses[agent, :2]).T
            distance = np.hypot(x, y)
            blocked_agents[scene] |= (distance <= reach) & (x > distance * np.cos(np.radians(angle)))
            blocked_agents[scene, agent] = False
        return blocked_agents


def _lane_values(table: Bool, lane: I32) -> Bool:
    return np.asarray((lane >= 0) & table[lane])


def _to_ego(state: WorldState) -> F64:
    """Return the distance of centres [B, A], m."""
    offset = state.pose[..., :2] - state.pose[:, :1, :2]
    return np.asarray(np.hypot(offset[..., 0], offset[..., 1]), np.float64)


def _behind_ego(state: WorldState, bearing: float, turn: float) -> Bool:
    """Return the agents [B, A] behind the ego, at `bearing` degrees or more from its heading, that head away from it.

    An agent that is nearer than the ego's length, or heads as the ego within `turn` degrees, can always interact.
    """
    distance = _to_ego(state)
    x = to_local(state.pose[:, :1], state.pose[..., :2])[..., 0]
    heading_cosine = np.cos(state.pose[..., 2] - state.pose[:, :1, 2])
    behind = x <= distance * np.cos(np.radians(bearing))
    return np.asarray((distance >= state.size[:, :1, 0]) & behind & (heading_cosine < np.cos(np.radians(turn))))
