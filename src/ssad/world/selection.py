"""Who becomes an adversary, and when it is let go: FREA's choice, as a selector for `ssad.world.rollout`.

    from ssad.world.selection import FreaSelection
    traces = rollout(world, {0: ego, FreaSelection(): adversary})

What it has to remember (whom it has chosen, who has reached the goal) is noted on the agents, so that snapshots and
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
    """What is noted on an agent."""

    CHOSEN = 1
    ARRIVED = 2  # it has reached the goal, and is not chosen again


@dataclass(frozen=True)
class FreaSelection:
    """FREA's rule-based choice of adversaries ("critical background vehicles").

    Every 0.2 s, while fewer than `count` are chosen, it chooses the nearest to the ego within `radius` of those that
    can interact with it and that no vehicle blocks which has reached the goal. An adversary is let go, and can be
    chosen again, when it can no longer interact (with looser limits) or is blocked; it is let go for good when it has
    reached the goal; after a contact it leaves the scene.

    Attributes:
        count: Adversaries at once in a scene.
        radius: m.
        kinds: Who can be one.
        remove: Whether an adversary that touches somebody leaves the scene; else it is let go for good.
        blocked: Whom a vehicle that has reached the goal blocks: "ahead", as FREA's code has it, those that it has
            right before it; "behind", as its comments say, those that have it right before them.

    Source: FREA (Chen et al. 2024), `CBVs_selection`, `get_CBV_candidates`, `check_interaction` and
    `check_CBV_BV_stuck` of its code.
    """

    count: int = 2
    radius: float = 25.0
    kinds: tuple[AgentKind, ...] = VEHICLES
    remove: bool = True
    blocked: Literal["ahead", "behind"] = "ahead"

    def __call__(self, state: WorldState) -> Choice:
        """Decide from a state; raises ConfigError in a simulator that keeps no notes."""
        if state.note is None:
            raise ConfigError(
                "the selection of adversaries remembers whom it has chosen: this simulator keeps no notes"
            )
        chosen = (state.note & Note.CHOSEN) != 0
        arrived = (state.note & Note.ARRIVED) != 0
        hit = chosen & (state.touch != 0)
        goal = goals(state).astype(np.float64)
        gap = np.hypot(*np.moveaxis(state.pose[..., :2] - goal[:, None], -1, 0))
        arrived = arrived | (chosen & (gap < GOAL_RADIUS)) | hit
        stays = chosen & state.active & ~arrived
        stays &= ~_passed(state, 100.0, 100.0) & ~self._blocked(state, arrived & ~hit, 8.0, 10.0)
        can = self._candidates(state) & ~arrived & ~stays
        can &= ~self._blocked(state, arrived & ~hit, 12.0, 15.0)
        distance = np.where(can, _to_ego(state), np.inf)
        nearest = distance.argmin(1)
        rows = np.arange(len(nearest))
        # at the very start nobody's lane is known yet
        turn = (np.rint(state.time / _PERIOD * 2.0).astype(np.int64) % 2 == 0) & (state.time > 0.0)
        new = turn & np.isfinite(distance[rows, nearest]) & (stays.sum(1) < self.count)
        stays[rows[new], nearest[new]] = True
        note: I32 = (stays * int(Note.CHOSEN) + arrived * int(Note.ARRIVED)).astype(np.int32)
        return Choice(stays, note, hit if self.remove else np.zeros_like(hit))

    def _candidates(self, state: WorldState) -> Bool:
        """[B, A] who is near, goes the goal's way, and can interact with the ego."""
        can = state.active & np.isin(state.kind, self.kinds) & (_to_ego(state) <= self.radius)
        can[:, 0] = False
        roads = state.roads
        first, count = np.moveaxis(state.route[:, 0], -1, 0)
        at = np.minimum(state.progress[:, 0] + round(GOAL_AHEAD), count - 1)
        goal_lane, ego_lane = roads.lane[first + at], state.lane[:, 0]
        inside = _of_lane(roads.junction, goal_lane) & _of_lane(roads.junction, ego_lane)
        side = np.where(goal_lane >= 0, roads.side[goal_lane], 0)[:, None]
        others = np.where(state.lane >= 0, roads.side[state.lane], 0)
        return np.asarray(can & (inside[:, None] | (side * others >= 0)) & ~_passed(state, 90.0, 90.0))

    def _blocked(self, state: WorldState, arrived: Bool, reach: float, angle: float) -> Bool:
        """[B, A] whom somebody who has reached the goal blocks within `reach` m and `angle` degrees."""
        found: Bool = np.zeros(arrived.shape, bool)
        for scene, agent in np.argwhere(arrived & state.active).tolist():
            poses = state.pose[scene]
            if self.blocked == "ahead":
                x, y = to_local(poses[agent], poses[:, :2]).T
            else:
                x, y = to_local(poses, poses[agent, :2]).T
            far = np.hypot(x, y)
            found[scene] |= (far <= reach) & (x > far * np.cos(np.radians(angle)))
            found[scene, agent] = False
        return found


def _of_lane(table: Bool, lane: I32) -> Bool:
    return np.asarray((lane >= 0) & table[lane])


def _to_ego(state: WorldState) -> F64:
    """[B, A] m between centres."""
    gap = state.pose[..., :2] - state.pose[:, :1, :2]
    return np.asarray(np.hypot(gap[..., 0], gap[..., 1]), np.float64)


def _passed(state: WorldState, bearing: float, turn: float) -> Bool:
    """[B, A] who lies behind the ego, at `bearing` degrees or more from its heading, and heads away from it.

    Who is nearer than the ego's length, or heads the ego's way within `turn` degrees, can always interact.
    """
    far = _to_ego(state)
    x = to_local(state.pose[:, :1], state.pose[..., :2])[..., 0]
    ahead = np.cos(state.pose[..., 2] - state.pose[:, :1, 2])
    behind = x <= far * np.cos(np.radians(bearing))
    return np.asarray((far >= state.size[:, :1, 0]) & behind & (ahead < np.cos(np.radians(turn))))
