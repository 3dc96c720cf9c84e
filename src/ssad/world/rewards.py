"""Rewards and costs as functions over batch arrays, for one step of the egos or of adversaries.

Each takes `WorldState`s and agents [N, 2] (scene, agent) and returns [N] or [B]. A state may be a view that is valid
until the next step only, so rewards that need the step before take a quantity measured then (`distance_to_goal`).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ssad.core.driving import WorldState
from ssad.core.geometry import obb_distance, to_local
from ssad.core.types import F32, F64, I32, MOVING, Bool, Contact
from ssad.metrics.proven_collisions import AGAINST

GOAL_AHEAD = 6.5  # m along the ego's route from its centre to the adversary's goal (FREA's waypoint buffer)
GOAL_RADIUS = 2.0  # m

Reward = Callable[[WorldState], F64]
_ASIDE = 0.5  # m from the route that cost nothing


def _ego_reward(
    state: WorldState, *, desired_speed: float, collision: float, step_reward: float, lateral_weight: float = 0.0
) -> F64:
    route_point = state.roads.path[state.route[:, 0, 0] + state.route_point]
    x, y, yaw = (state.pose[:, 0] - route_point[:, :3]).T
    offset = np.cos(route_point[:, 2]) * y - np.sin(route_point[:, 2]) * x
    speed_along = state.speed[:, 0] * np.cos(yaw)
    steer = np.abs(state.control[:, 0, 2])
    reward = speed_along - collision * (state.contact != Contact.NONE) - 10.0 * (speed_along > desired_speed)
    reward = (
        reward - (np.abs(offset) > 4.0) - 5.0 * steer * steer - 0.2 * steer * speed_along * speed_along - step_reward
    )
    reward = reward - lateral_weight * np.maximum(np.abs(offset) - _ASIDE, 0.0)
    rewards: F64 = reward.astype(np.float64)
    return rewards


def safebench(state: WorldState) -> F64:
    """Return SafeBench's reward of the egos, [B].

    -1 for a collision, + speed along the lane, -10 above 8 m/s, -1 beyond 4 m from the route, -5 steer^2, -0.2
    |steer| times the speed squared. Source: SafeBench (Xu et al. 2022), its environment's `_get_reward`.
    """
    return _ego_reward(state, desired_speed=8.0, collision=1.0, step_reward=0.0)


def frea(state: WorldState) -> F64:
    """Return FREA's reward of the egos, [B]: SafeBench's with -10 for a collision, 6 m/s desired, and -0.1 a step."""
    return _ego_reward(state, desired_speed=6.0, collision=10.0, step_reward=0.1)


def driver(state: WorldState) -> F64:
    """Return the reward of the shipped drivers, [B]: SafeBench's with -100 for a contact, -5 off the road, -0.1 a step.

    With SafeBench's -1 or FREA's -10 a contact costs what at most one or two steps bring at 8 m/s.
    """
    return _ego_reward(state, desired_speed=8.0, collision=100.0, step_reward=0.1) - 5.0 * state.off_road


def lane(state: WorldState) -> F64:
    """A reward that keeps drivers on their route, [B]: `driver`, and -1.5 for each metre beyond half a metre from it.

    Without that, policies cut left turns by 2 to 3 m, into waiting vehicles.
    """
    return (
        _ego_reward(state, desired_speed=8.0, collision=100.0, step_reward=0.1, lateral_weight=1.5)
        - 5.0 * state.off_road
    )


REWARDS: dict[str, Reward] = {"safebench": safebench, "frea": frea, "driver": driver, "lane": lane}


def goals(state: WorldState) -> F32:
    """Return the adversaries' goals, [B, 2]: the next point of the ego's route 6.5 m ahead of the ego."""
    first_point, point_count = np.moveaxis(state.route[:, 0], -1, 0)
    route_points = state.roads.path
    offset = to_local(route_points[first_point + state.progress[:, 0], :3], state.pose[:, 0, :2])[:, 0]
    goal_distance = np.clip(state.progress[:, 0] + offset + GOAL_AHEAD, 0.0, point_count - 1.0)
    # The last segment also serves its end point.
    segment = np.minimum(goal_distance.astype(np.int64), point_count - 2)
    fraction = (goal_distance - segment)[:, None]
    segment_start, segment_end = route_points[first_point + segment, :2], route_points[first_point + segment + 1, :2]
    goal: F32 = (segment_start + fraction * (segment_end - segment_start)).astype(np.float32)
    return goal


def distance_to_goal(state: WorldState, agents: I32) -> F64:
    """Return the distance [N] from each adversary to the goal of its scene, m."""
    scene, agent = agents.T
    offset = state.pose[scene, agent, :2] - goals(state)[scene]
    distances: F64 = np.hypot(offset[:, 0], offset[:, 1]).astype(np.float64)
    return distances


def hit_ego(state: WorldState, agents: I32) -> Bool:
    """Return whether each adversary touches the ego, [N]."""
    scene, agent = agents.T
    # `touch` has one bit per agent; the ego is agent 0.
    touches: Bool = (state.touch[scene, agent] & np.int64(1)) != 0
    return touches


def hit_others(state: WorldState, agents: I32) -> Bool:
    """Return whether each adversary touches an agent other than the ego, [N]."""
    scene, agent = agents.T
    touches: Bool = (state.touch[scene, agent] & ~np.int64(1)) != 0
    return touches


def adversary(
    state: WorldState, agents: I32, previous_cost: F64, *, literal: bool = False, off_road: float = 0.0
) -> F64:
    """Return the reward of goal-seeking adversaries (Adv.PPO), [N].

    clip(before - now, -1, 1) - 15 for a contact with an agent other than the ego + 15 within 2 m of the goal, as the
    code that produced the published results computes it.

    Args:
        state: After the step.
        agents: [N, 2] scene and agent of the adversaries.
        previous_cost: [N] `distance_to_goal` before the step.
        literal: Equation 6 as printed instead: now - before - 15 r_col - 15 r_fin with r_col = -1 and r_fin = 1.
            Its signs reward driving away and contacts, and punish reaching the goal.
        off_road: Cost of each step with its centre off the road; neither the paper nor FREA has such a term.

    Source: the paper's equation 6; FREA (Chen et al. 2024).
    """
    distance = distance_to_goal(state, agents)
    hit, at_goal = hit_others(state, agents), distance < GOAL_RADIUS
    road_cost = off_road * (state.lane[agents[:, 0], agents[:, 1]] < 0)
    if literal:
        literal_reward: F64 = distance - previous_cost + 15.0 * hit - 15.0 * at_goal - road_cost
        return literal_reward
    reward: F64 = np.clip(previous_cost - distance, -1.0, 1.0) - 15.0 * hit + 15.0 * at_goal - road_cost
    return reward


def collision_cost(
    state: WorldState,
    adversaries: Bool,
    *,
    safe_distance: float = 1.25,
    weight_between: float = 3.0,
    weight_off_road: float = 20.0,
) -> F64:
    """Return the cost that a set of colliding adversaries minimises, [B], in m.

    The smallest distance between the bodies of the ego and an adversary, minus `weight_between` times the smallest
    distance of two adversaries (at most `safe_distance`), plus `weight_off_road` for each adversary whose centre is
    off the road.

    Args:
        state: The state.
        adversaries: [B, A] mask of the adversaries. A scene without any costs 0.
        safe_distance: m.
        weight_between: The paper's lambda.
        weight_off_road: The paper's gamma.

    Source: the paper's equation 5; KING (Hanselmann et al. 2022). KING blurs the drivable area with a Gaussian so
    that this term has a gradient; here the unblurred area is used.
    """
    active_adversaries = np.asarray(adversaries, bool) & state.active
    boxes = np.concatenate([state.pose, state.size], -1)
    to_ego = np.where(active_adversaries, obb_distance(boxes[:, :1], boxes), np.inf).min(1)
    first_index, second_index = np.triu_indices(active_adversaries.shape[1], 1)
    between = np.where(
        active_adversaries[:, first_index] & active_adversaries[:, second_index],
        obb_distance(boxes[:, first_index], boxes[:, second_index]),
        np.inf,
    )
    # A single adversary has no other to keep away from.
    nearest = np.where(active_adversaries.sum(1) > 1, np.minimum(between.min(1, initial=np.inf), safe_distance), 0.0)
    off_road_count = (active_adversaries & (state.lane < 0)).sum(1)
    cost = (
        np.where(active_adversaries.any(1), to_ego, 0.0) - weight_between * nearest + weight_off_road * off_road_count
    )
    costs: F64 = cost.astype(np.float64)
    return costs


def colliding(state: WorldState, agents: I32, previous_cost: F64) -> F64:
    """A reward of adversaries from the paper's equation 5, [N]: how much `collision_cost` fell in a step, in m.

    Its sum over an episode is minus the cost at the end, so an adversary is not paid for ending one early.

    Args:
        state: After the step.
        agents: [N, 2] scene and agent of the adversaries.
        previous_cost: [N] `cost_of` before the step.
    """
    return previous_cost - cost_of(state, agents)


def cost_of(state: WorldState, agents: I32) -> F64:
    """Return `collision_cost` of the scene of each adversary, [N]."""
    mask = np.zeros(state.active.shape, bool)
    mask[agents[:, 0], agents[:, 1]] = True
    return np.asarray(collision_cost(state, mask)[agents[:, 0]])


def feasible(state: WorldState, agents: I32, previous_cost: F64, avoided: Bool, *, off_road: float = 0.0) -> F64:
    """The reward of a feasibility-guided adversary, [N]: a contact with the ego counts by who could have avoided it.

    An unavoidable collision says nothing about the ego. So a contact brings 30 if a careful driver would have avoided
    it, and costs 10 otherwise. A metre nearer to the goal brings 0.3, and reaching the goal nothing. Contacts with
    other agents and the road cost as in `adversary`.

    Args:
        state: After the step.
        agents: [N, 2] scene and agent of the adversaries.
        previous_cost: [N] `distance_to_goal` before the step.
        avoided: [N] whether a careful driver in the ego's place would have avoided a contact with the ego.
        off_road: As of `adversary`.

    Source: FREA (Chen et al. 2024), for the aim. FREA learns a feasible region from recorded drives, and the
    adversary keeps the ego in it (`ssad.training.feasible_ppo`); here the encounter is judged when it is over.
    """
    scene, agent = agents.T
    progress = np.clip(previous_cost - distance_to_goal(state, agents), -1.0, 1.0)
    contact = np.where(hit_ego(state, agents), np.where(avoided, 30.0, -10.0), 0.0)
    reward: F64 = (
        0.3 * progress - 15.0 * hit_others(state, agents) + contact - off_road * (state.lane[scene, agent] < 0)
    )
    return reward


def unlawful_cost(state: WorldState, agents: I32, alignment: F32, *, off_road: float, against: float) -> F64:
    """Return the cost of a step that each adversary spends off the road or against traffic, [N].

    Args:
        state: After the step.
        agents: [N, 2] scene and agent of the adversaries.
        alignment: [N] first number of the sensor `road`.
        off_road: Cost of a step with the centre off the road.
        against: Cost of a step whose course differs from that of each lane under the centre by more than 120 degrees.
    """
    scene, agent = agents.T
    is_against = drives_against(state, agents, alignment)
    cost: F64 = off_road * (state.lane[scene, agent] < 0) + against * is_against
    return cost


def drives_against(state: WorldState, agents: I32, alignment: F32) -> Bool:
    """Return whether each adversary moves against traffic, [N]; see `ssad.metrics.proven_collisions`."""
    scene, agent = agents.T
    moves = np.abs(state.speed[scene, agent]) > MOVING
    against: Bool = moves & (alignment < np.cos(AGAINST)) & (alignment >= -1.0 - 1e-3)
    return against


def lawful(
    state: WorldState,
    agents: I32,
    previous_cost: F64,
    alignment: F32,
    *,
    off_road: float = 0.5,
    against: float = 1.0,
) -> F64:
    """Return `adversary`, less the cost of being off the road or against traffic, [N].

    Args:
        state: After the step.
        agents: [N, 2] scene and agent of the adversaries.
        previous_cost: [N] `distance_to_goal` before the step.
        alignment: [N] first number of the sensor `road`.
        off_road: As of `unlawful_cost`.
        against: As of `unlawful_cost`.
    """
    return adversary(state, agents, previous_cost) - unlawful_cost(
        state, agents, alignment, off_road=off_road, against=against
    )


def proving(
    state: WorldState,
    agents: I32,
    previous_cost: F64,
    alignment: F32,
    proven: Bool,
    *,
    off_road: float = 0.5,
    against: float = 1.0,
) -> F64:
    """Return the reward of adversaries that seek proven collisions, [N]; see `ssad.metrics.proven_collisions`.

    A contact with the ego brings 30 if the collision is proven, and costs 3 otherwise. A metre nearer to the goal
    brings 0.3, and reaching the goal nothing. A contact with another agent costs 15, as in `adversary`.

    Args:
        state: After the step.
        agents: [N, 2] scene and agent of the adversaries.
        previous_cost: [N] `distance_to_goal` before the step.
        alignment: [N] first number of the sensor `road`.
        proven: [N] whether a contact with the ego meets the conditions of a proven collision.
        off_road: As of `unlawful_cost`.
        against: As of `unlawful_cost`.
    """
    progress = np.clip(previous_cost - distance_to_goal(state, agents), -1.0, 1.0)
    contact = np.where(hit_ego(state, agents), np.where(proven, 30.0, -3.0), 0.0)
    cost = unlawful_cost(state, agents, alignment, off_road=off_road, against=against)
    reward: F64 = 0.3 * progress - 15.0 * hit_others(state, agents) + contact - cost
    return reward
