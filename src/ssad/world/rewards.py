"""Rewards and costs as functions over batch arrays: of one step of the ego's, or of an adversary's.

Each takes `WorldState`s and agents [N, 2] (scene, agent) and gives [N] or [B]. Since a state may be a view that holds
until the next step, what a reward needs of the step before is measured then (`distance_to_goal`).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ssad.core.driving import WorldState
from ssad.core.geometry import obb_distance, to_local
from ssad.core.types import F32, F64, I32, Bool, Contact

GOAL_AHEAD = 6.5  # m along the ego's route from its centre to the adversary's goal (FREA's waypoint buffer)
GOAL_RADIUS = 2.0  # m

Reward = Callable[[WorldState], F64]
_ASIDE = 0.5  # m from the route that cost nothing


def _ego_reward(state: WorldState, *, desired_speed: float, collision: float, living: float, aside: float = 0.0) -> F64:
    point = state.roads.path[state.route[:, 0, 0] + state.route_point]
    x, y, yaw = (state.pose[:, 0] - point[:, :3]).T
    offset = np.cos(point[:, 2]) * y - np.sin(point[:, 2]) * x
    along = state.speed[:, 0] * np.cos(yaw)
    steer = np.abs(state.control[:, 0, 2])
    reward = along - collision * (state.contact != Contact.NONE) - 10.0 * (along > desired_speed)
    reward = reward - (np.abs(offset) > 4.0) - 5.0 * steer * steer - 0.2 * steer * along * along - living
    reward = reward - aside * np.maximum(np.abs(offset) - _ASIDE, 0.0)
    found: F64 = reward.astype(np.float64)
    return found


def safebench(state: WorldState) -> F64:
    """SafeBench's reward of the egos, [B].

    -1 for a collision, + speed along the lane, -10 above 8 m/s, -1 beyond 4 m from the route, -5 steer^2, -0.2 |steer|
    times the speed squared. Source: SafeBench (Xu et al. 2022), its environment's `_get_reward`.
    """
    return _ego_reward(state, desired_speed=8.0, collision=1.0, living=0.0)


def frea(state: WorldState) -> F64:
    """FREA's reward of the egos, [B]: as SafeBench's, with -10 for a collision, 6 m/s desired, and -0.1 a step."""
    return _ego_reward(state, desired_speed=6.0, collision=10.0, living=0.1)


def driver(state: WorldState) -> F64:
    """What the shipped drivers learned from, [B]: SafeBench's with -100 for a contact, -5 off the road, -0.1 a step.

    With SafeBench's -1 or FREA's -10 a contact costs what at most one or two steps bring at 8 m/s.
    """
    return _ego_reward(state, desired_speed=8.0, collision=100.0, living=0.1) - 5.0 * state.off_road


def lane(state: WorldState) -> F64:
    """A reward that keeps drivers on their route, [B]: `driver`, and -1.5 for each metre beyond half a metre from it.

    Without that, policies cut left turns by 2 to 3 m, into those who wait there.
    """
    return _ego_reward(state, desired_speed=8.0, collision=100.0, living=0.1, aside=1.5) - 5.0 * state.off_road


REWARDS: dict[str, Reward] = {"safebench": safebench, "frea": frea, "driver": driver, "lane": lane}


def goals(state: WorldState) -> F32:
    """Where adversaries want to be, [B, 2]: the point of the ego's route that the ego reaches next, 6.5 m ahead."""
    first, count = np.moveaxis(state.route[:, 0], -1, 0)
    path = state.roads.path
    part = to_local(path[first + state.progress[:, 0], :3], state.pose[:, 0, :2])[:, 0]
    at = np.clip(state.progress[:, 0] + part + GOAL_AHEAD, 0.0, count - 1.0)
    index = np.minimum(at.astype(np.int64), count - 2)
    share = (at - index)[:, None]
    a, b = path[first + index, :2], path[first + index + 1, :2]
    goal: F32 = (a + share * (b - a)).astype(np.float32)
    return goal


def distance_to_goal(state: WorldState, agents: I32) -> F64:
    """[N] m from each adversary to the goal of its scene."""
    scene, agent = agents.T
    gap = state.pose[scene, agent, :2] - goals(state)[scene]
    found: F64 = np.hypot(gap[:, 0], gap[:, 1]).astype(np.float64)
    return found


def hit_ego(state: WorldState, agents: I32) -> Bool:
    """[N] whether an adversary touches the ego."""
    scene, agent = agents.T
    found: Bool = (state.touch[scene, agent] & np.int64(1)) != 0
    return found


def hit_others(state: WorldState, agents: I32) -> Bool:
    """[N] whether an adversary touches anybody but the ego."""
    scene, agent = agents.T
    found: Bool = (state.touch[scene, agent] & ~np.int64(1)) != 0
    return found


def adversary(state: WorldState, agents: I32, before: F64, *, literal: bool = False, off_road: float = 0.0) -> F64:
    """The reward of goal-seeking adversaries (Adv.PPO), [N].

    clip(before - now, -1, 1) - 15 for a contact with anybody but the ego + 15 within 2 m of the goal: what the code
    that gave the published results computes.

    Args:
        state: After the step.
        agents: [N, 2] scene and agent of the adversaries.
        before: [N] `distance_to_goal` before the step.
        literal: Equation 6 as it is printed instead: now - before - 15 r_col - 15 r_fin with r_col = -1 and r_fin = 1.
            Its signs reward driving away and contacts, and punish reaching the goal.
        off_road: What each step with its centre off the road costs; neither the paper nor FREA has such a term.

    Source: the paper's equation 6; FREA (Chen et al. 2024).
    """
    now = distance_to_goal(state, agents)
    hit, there = hit_others(state, agents), now < GOAL_RADIUS
    cost = off_road * (state.lane[agents[:, 0], agents[:, 1]] < 0)
    if literal:
        found: F64 = now - before + 15.0 * hit - 15.0 * there - cost
        return found
    gain: F64 = np.clip(before - now, -1.0, 1.0) - 15.0 * hit + 15.0 * there - cost
    return gain


def collision_cost(
    state: WorldState,
    adversaries: Bool,
    *,
    safe_distance: float = 1.25,
    weight_between: float = 3.0,
    weight_off_road: float = 20.0,
) -> F64:
    """The cost that a set of colliding adversaries makes small, [B], in m.

    The least distance between the ego's body and an adversary's, less `weight_between` times the least distance of two
    adversaries (at most `safe_distance`), plus `weight_off_road` for each adversary whose centre is off the road.

    Args:
        state: The state.
        adversaries: [B, A] who they are. A scene without any costs 0.
        safe_distance: m.
        weight_between: The paper's lambda.
        weight_off_road: The paper's gamma.

    Source: the paper's equation 5; KING (Hanselmann et al. 2022). KING blurs the drivable area with a Gaussian so that
    this term has a gradient; here it is what the Gaussian blurs.
    """
    mine = np.asarray(adversaries, bool) & state.active
    boxes = np.concatenate([state.pose, state.size], -1)
    to_ego = np.where(mine, obb_distance(boxes[:, :1], boxes), np.inf).min(1)
    left, right = np.triu_indices(mine.shape[1], 1)
    between = np.where(mine[:, left] & mine[:, right], obb_distance(boxes[:, left], boxes[:, right]), np.inf)
    nearest = np.where(mine.sum(1) > 1, np.minimum(between.min(1, initial=np.inf), safe_distance), 0.0)
    off = (mine & (state.lane < 0)).sum(1)
    cost = np.where(mine.any(1), to_ego, 0.0) - weight_between * nearest + weight_off_road * off
    found: F64 = cost.astype(np.float64)
    return found


def colliding(state: WorldState, agents: I32, before: F64) -> F64:
    """A reward of adversaries from the paper's equation 5, [N]: how much `collision_cost` fell in a step, in m.

    Its sum over an episode is minus the cost at the end, so an adversary is not paid for ending one early.

    Args:
        state: After the step.
        agents: [N, 2] scene and agent of the adversaries.
        before: [N] `cost_of` before the step.
    """
    return before - cost_of(state, agents)


def cost_of(state: WorldState, agents: I32) -> F64:
    """[N] `collision_cost` of the scene of each adversary."""
    mine = np.zeros(state.active.shape, bool)
    mine[agents[:, 0], agents[:, 1]] = True
    return np.asarray(collision_cost(state, mine)[agents[:, 0]])


def feasible(state: WorldState, agents: I32, before: F64, avoided: Bool, *, off_road: float = 0.0) -> F64:
    """The reward of a feasibility-guided adversary, [N]: a contact with the ego counts by who could have avoided it.

    A collision that nobody could avoid says nothing about the ego. So a contact is paid with 30 if a careful driver
    would have avoided it, and costs 10 if not. On the way there, a metre nearer to the goal brings 0.3; the goal itself
    brings nothing. Others and the road cost what they cost `adversary`.

    Args:
        state: After the step.
        agents: [N, 2] scene and agent of the adversaries.
        before: [N] `distance_to_goal` before the step.
        avoided: [N] whether a careful driver in the ego's place would have stayed clear; of those who touch the ego.
        off_road: As of `adversary`.

    Source: FREA (Chen et al. 2024), for the aim. FREA learns from recorded drives which states leave a way out, and
    turns the adversary back where there is none; here the encounter is judged when it is over.
    """
    scene, agent = agents.T
    nearer = np.clip(before - distance_to_goal(state, agents), -1.0, 1.0)
    contact = np.where(hit_ego(state, agents), np.where(avoided, 30.0, -10.0), 0.0)
    gain: F64 = 0.3 * nearer - 15.0 * hit_others(state, agents) + contact - off_road * (state.lane[scene, agent] < 0)
    return gain
