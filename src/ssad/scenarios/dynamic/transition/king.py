"""KING: gradient-based optimisation of one adversary's controls through the differentiable twin of the world.

The search starts from the recorded motion of a base that the ego survived. The ego's reaction is not part of the
gradient: a chain of controls is optimised against the ego of the chain's last rollout, then a new rollout records how
the ego responds, and so on. Many chains of many bases are optimised at once.

Source: Hanselmann et al., KING: Generating safety-critical driving scenarios for robust imitation via kinematics
gradients, ECCV 2022 (arXiv 2204.13683); its gradients also exclude the ego's reaction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
import torch
from torch import Tensor

from ssad.core.errors import ConfigError
from ssad.core.generators import Base, Outcome, Proposal
from ssad.core.seeding import generator
from ssad.core.types import F64, AgentKind, Episode, EpisodeTrace, Scenario
from ssad.scenarios.dynamic.frozen import freeze_episode, with_motion
from ssad.scenarios.dynamic.transition.road import raster_of
from ssad.world.models import agent_model, model
from ssad.world.twin import Bodies, MotionState, advance, bodies_of, box_gap, unroll

STEP: Final = 0.25  # s, as KING's
STEPS: Final = 80
KNOT: Final = 4  # steps between the values that are optimised: an effort changes within a second, as a driver's does
NEAREST: Final = 4  # vehicles of a base that may become the adversary
ITERATIONS: Final = 30  # of the optimiser before each rollout
RATE: Final = 0.05  # of Adam
BETAS: Final = 0.8, 0.99  # KING's
SOFT: Final = 1.0  # m; scale of the soft minimum of the gap over time
PURSUIT: Final = 0.2  # weight of the mean gap, KING's own objective: the adversary stays with an ego that waits
CLEAR: Final = 1.25  # m that KING keeps between agents
OTHERS: Final = 3.0  # weight of violating this clearance; KING's
ROAD: Final = 20.0  # weight of corners off the road; KING's
AFTER: Final = 0.2  # weight of what happens after the ego is nearest, when the episode is over
FAR: Final = 6.0  # m
EFFORT: Final = 0.02  # weight of changing what was recorded
PATIENCE: Final = 5  # rollouts of a chain before it starts anew with another adversary
HOPELESS: Final = 10.0  # m; after two rollouts beyond this gap an adversary is given up while others remain
JITTER: Final = 0.25  # spread of the controls that a chain starts with when its adversary has been tried before


@dataclass
class _Chain:
    """Controls of one adversary during the optimisation.

    Attributes:
        base: Index of the base.
        agent: Index of the adversary.
        change: [K, 2] change of effort and steering at the knots, added to the recorded controls.
        ego: The ego's box and presence [T + 1, 6] in the last rollout.
        weight: Weight of the costs of the road and other agents.
        tried_count: Rollouts so far.
    """

    base: int
    agent: int
    change: F64
    ego: F64
    weight: float = 1.0
    tried_count: int = 0


class King:
    """Gradients of kinematic states through the differentiable twin (KING), against the ego's last answer."""

    name = "king"

    def __init__(self, bases: Sequence[Base], *, seeds: Sequence[int], budget: int) -> None:
        self.bases = list(bases)
        self.budget = budget
        self._seeds = list(seeds)
        self._frozen = [freeze_episode(base.episode, base.trace) for base in bases]
        self._agents = [adversary_candidates(base) for base in bases]
        self._motion = [resample_trace(base.trace) for base in bases]
        self._recorded = self._recorded_controls()
        self._road = raster_of(
            [base.graph for base in bases],
            [
                np.concatenate([motion[..., :2].reshape(-1, 2), motion_base.trace.route])
                for motion, motion_base in zip(self._motion, bases, strict=True)
            ],
        )
        self._start_counts = [0] * len(self.bases)
        self._abandoned: list[set[int]] = [set() for _ in self.bases]
        self._chains: list[list[_Chain]] = [[] for _ in self.bases]

    @staticmethod
    def check(episode: Episode) -> None:
        """Check that an episode has a vehicle that could become the adversary.

        Raises:
            ConfigError: It has none.
        """
        if not any(model(agent.model).kind <= AgentKind.BICYCLE for agent in episode.agents[1:]):
            raise _no_adversary_error(episode.scenario)

    def ask(self, count: int) -> list[list[Proposal]]:
        """Optimise each chain further and propose its scenario."""
        for base_index, chains in enumerate(self._chains):
            while len(chains) < count:
                chains.append(self._new_chain(base_index))
            del chains[count:]
        active_chains = [chain for chains in self._chains for chain in chains]
        poses = self._optimise(active_chains)
        proposals: list[list[Proposal]] = [[] for _ in self.bases]
        for chain, pose in zip(active_chains, poses, strict=True):
            name = self.bases[chain.base].trace.names[chain.agent]
            rows = np.concatenate([STEP * np.arange(STEPS + 1)[:, None], pose], 1)
            scenario = with_motion(self._frozen[chain.base], name, rows)
            proposals[chain.base].append(Proposal(scenario, adversaries=(name,)))
        return proposals

    def tell(self, outcomes: Sequence[Sequence[Outcome]]) -> None:
        """Update chains with the ego's response; restart those that are finished or stuck."""
        for base_index, base_outcomes in enumerate(outcomes):
            for chain_index, outcome in enumerate(base_outcomes):
                chain = self._chains[base_index][chain_index]
                chain.tried_count += 1
                is_hopeless = outcome.gap is None or outcome.gap > HOPELESS
                if is_hopeless and chain.tried_count >= 2:
                    self._abandoned[base_index].add(chain.agent)
                if outcome.trace is None or outcome.is_valid or chain.tried_count >= (2 if is_hopeless else PATIENCE):
                    self._chains[base_index][chain_index] = self._new_chain(base_index)
                    continue
                chain.ego = resample_trace(outcome.trace)[0]
                if outcome.off_road or outcome.hit_others:
                    chain.weight *= 2.0

    def _new_chain(self, base: int) -> _Chain:
        """Start a chain with the next adversary in turn; from the second turn on with random controls."""
        agents = [
            candidate for candidate in self._agents[base] if candidate not in self._abandoned[base]
        ] or self._agents[base]
        turn, agent_position = divmod(self._start_counts[base], len(agents))
        agent = agents[agent_position]
        random = generator("king", self._seeds[base], self._start_counts[base])
        self._start_counts[base] += 1
        change = JITTER * min(turn, 1) * random.standard_normal((STEPS // KNOT + 1, 2))
        if np.abs(self.bases[base].trace.speed[:, agent]).max() < 0.5:
            change[:, 0] += 0.1  # a standing vehicle without throttle has no gradient
        return _Chain(base, agent, change, self._motion[base][0])

    def _recorded_controls(self) -> list[dict[int, tuple[MotionState, Tensor]]]:
        """Return start state and controls [T, 4] with which the twin repeats each candidate of each base."""
        candidates = [(base_index, agent) for base_index, agents in enumerate(self._agents) for agent in agents]
        bodies = self._bodies(candidates)
        motion = torch.from_numpy(np.stack([self._motion[base_index][agent] for base_index, agent in candidates]))
        speed = torch.tensor(
            [float(self.bases[base_index].trace.speed[0, agent]) for base_index, agent in candidates],
            dtype=torch.float64,
        )
        start = MotionState(motion[:, 0, :3], speed, torch.zeros_like(speed))
        controls = follow_poses(start, motion[..., :3].transpose(0, 1), bodies)
        recorded: list[dict[int, tuple[MotionState, Tensor]]] = [{} for _ in self.bases]
        for row, (base_index, agent) in enumerate(candidates):
            recorded[base_index][agent] = MotionState(*(part[row] for part in start)), controls[:, row]
        return recorded

    def _bodies(self, candidates: Sequence[tuple[int, int]]) -> Bodies:
        """Return the bodies of agents, given by the number of their base and their own."""
        episodes = [self.bases[base_index].episode for base_index, _ in candidates]
        models = [agent_model(episode.agents[agent]) for episode, (_, agent) in zip(episodes, candidates, strict=True)]
        return bodies_of(models, friction=[episode.friction for episode in episodes], dtype=torch.float64)

    def _optimise(self, chains: Sequence[_Chain]) -> F64:
        """Improve the controls of the chains, and return their poses [N, T + 1, 3]."""
        recorded = [self._recorded[member.base][member.agent] for member in chains]
        start = MotionState(
            *(torch.stack(parts) for parts in zip(*(replayed[0] for replayed in recorded), strict=True))
        )
        recorded_controls = torch.stack([replayed[1] for replayed in recorded], 1)
        bodies = self._bodies([(member.base, member.agent) for member in chains])
        ego = torch.from_numpy(np.stack([member.ego for member in chains]))
        other_boxes = torch.from_numpy(self._recorded_boxes(chains))
        weight = torch.tensor([member.weight for member in chains], dtype=torch.float64)
        base_index = torch.tensor([member.base for member in chains])
        change = torch.from_numpy(np.stack([member.change for member in chains])).requires_grad_()

        def unroll_changed() -> MotionState:
            states = unroll(start, _controls(recorded_controls, change), bodies, dt=STEP, substeps=1)
            is_finite = change.isfinite().all(-1).all(-1) & states.pose.isfinite().all(-1).all(0)
            if not bool(is_finite.all()):
                diverged_scenario = self.bases[chains[int((~is_finite).nonzero()[0])].base].scenario.name
                raise ConfigError(
                    f"generator king: the optimisation diverged in {diverged_scenario} (a motion that is not finite)"
                )
            return states

        first_moment, second_moment = torch.zeros_like(change), torch.zeros_like(change)
        for step in range(1, ITERATIONS + 1):
            cost = self._cost(
                unroll_changed(), bodies, ego=ego, other_boxes=other_boxes, weight=weight, base_index=base_index
            )
            cost = cost + EFFORT * change.square().mean((1, 2))
            (gradient,) = torch.autograd.grad(cost.sum(), change)
            # Adam; that of torch.optim imports torch's compiler first, which takes 4 s
            with torch.no_grad():
                first_moment.lerp_(gradient, 1.0 - BETAS[0])
                second_moment.lerp_(gradient.square(), 1.0 - BETAS[1])
                denominator = (second_moment / (1.0 - BETAS[1] ** step)).sqrt() + 1e-8
                change -= RATE / (1.0 - BETAS[0] ** step) * first_moment / denominator
        with torch.no_grad():
            states = unroll_changed()
        for chain, values in zip(chains, change.detach().numpy(), strict=True):
            chain.change = values.copy()
        return states.pose.transpose(0, 1).numpy()

    def _recorded_boxes(self, chains: Sequence[_Chain]) -> F64:
        """Return recorded boxes and presence [N, O, T + 1, 6] of all agents but the ego and the adversary."""
        agent_count = max(len(self._motion[member.base]) for member in chains)
        boxes = np.zeros((len(chains), agent_count, STEPS + 1, 6))
        for row, chain in zip(boxes, chains, strict=True):
            motion = self._motion[chain.base]
            row[: len(motion)] = motion
            row[[0, chain.agent], :, 5] = 0.0
        return boxes

    def _cost(
        self,
        states: MotionState,
        bodies: Bodies,
        *,
        ego: Tensor,
        other_boxes: Tensor,
        weight: Tensor,
        base_index: Tensor,
    ) -> Tensor:
        """Return costs [N]: low near the ego, high near other agents or off the road."""
        pose = states.pose.transpose(0, 1)
        size = torch.stack([bodies.length, bodies.width], -1)[:, None].expand(-1, STEPS + 1, -1)
        box = torch.cat([pose, size], -1)
        ego_present = ego[..., 5] > 0.5
        gap = torch.where(ego_present, _gap(box, ego[..., :5]), 1.0e3)
        ego_cost = -SOFT * torch.logsumexp(-gap / SOFT, -1)
        present = ego_present.sum(-1).clamp_min(1)
        pursuit = torch.where(ego_present, gap.clamp(0.0, 50.0), 0.0).sum(-1) / present
        ego_cost = ego_cost + PURSUIT * pursuit
        # the episode ends where the two meet
        time = torch.arange(STEPS + 1)
        time_weight = torch.where(time <= gap.detach().argmin(1)[:, None] + 2, 1.0, AFTER)
        # Only the nearest agent of each step gets an exact gap; the choice itself needs no gradient.
        squared_distance = (pose.detach()[:, None, :, :2] - other_boxes[..., :2]).square().sum(-1)
        nearest_index = torch.where(other_boxes[..., 5] > 0.5, squared_distance, 1.0e9).argmin(1)
        nearest = torch.take_along_dim(other_boxes, nearest_index[:, None, :, None], 1)[:, 0]
        intrusion = torch.where(nearest[..., 5] > 0.5, (CLEAR - _gap(box, nearest[..., :5])).clamp_min(0.0), 0.0)
        corner_cost = self._road(_corners(box), base_index).clamp(0.0, 5.0).sum(-1)
        centre_cost = self._road(pose[..., :2], base_index).add(0.5).clamp(0.0, 5.0)
        road_cost = ((corner_cost + 4.0 * centre_cost) * time_weight).mean(1)
        return ego_cost + weight * (OTHERS * (intrusion * time_weight).amax(1) + ROAD * road_cost)


def adversary_candidates(base: Base) -> list[int]:
    """Return the vehicles present from the start, nearest to the ego's route first.

    Raises:
        ConfigError: There are none.
    """
    trace = base.trace
    candidates = []
    for agent in range(1, len(trace.names)):
        if trace.active[0, agent] and AgentKind.NONE < trace.kind[agent] <= AgentKind.BICYCLE:
            present = trace.active[:, agent]
            path = np.stack([trace.x[present, agent], trace.y[present, agent]], 1)[::5]
            route_distance = np.hypot(*np.moveaxis(path[:, None] - trace.route[None], -1, 0))
            candidates.append((float(route_distance.min()), agent))
    if not candidates:
        raise _no_adversary_error(base.scenario)
    return [agent for _, agent in sorted(candidates)[:NEAREST]]


def _no_adversary_error(scenario: Scenario) -> ConfigError:
    return ConfigError(
        f"scenario {scenario.name}: there is no vehicle in it that could be an adversary; "
        "add one, or take another scenario"
    )


def follow_poses(start: MotionState, poses: Tensor, bodies: Bodies) -> Tensor:
    """Return controls [T, N, 4] with which the twin follows poses [T + 1, N, 3] as closely as the bodies allow."""
    state, controls = start, []
    for pose, next_pose in pairwise(poses):
        x, y, yaw = state.pose.unbind(-1)
        cos, sin = torch.cos(pose[:, 2]), torch.sin(pose[:, 2])
        distance_ahead = (next_pose[:, 0] - x) * cos + (next_pose[:, 1] - y) * sin
        lateral_error = (x - pose[:, 0]) * -sin + (y - pose[:, 1]) * cos
        speed = 2.0 * distance_ahead / STEP - state.speed  # the mean over the step covers the distance
        mean_speed = 0.5 * (speed + torch.hypot(next_pose[:, 0] - pose[:, 0], next_pose[:, 1] - pose[:, 1]) / STEP)
        effort = (mean_speed - state.speed) / STEP
        effort = torch.where(effort > 0.0, effort / bodies.max_accel, effort / bodies.max_brake).clamp(-1.0, 1.0)
        safe_speed = state.speed.clamp_min(1.0)
        turn = (
            torch.remainder(next_pose[:, 2] - yaw + torch.pi, 2 * torch.pi)
            - torch.pi
            - torch.atan(0.7 * lateral_error / safe_speed)
        )
        slip = torch.asin((turn / STEP * bodies.wheelbase / (2.0 * safe_speed)).clamp(-0.9, 0.9))
        wheel = torch.atan(2.0 * torch.tan(slip))
        steer = torch.where(state.speed > 0.3, (wheel / bodies.max_steer).clamp(-1.0, 1.0), 0.0)
        control = torch.stack([effort.clamp(0.0, 1.0), (-effort).clamp(0.0, 1.0), steer, torch.zeros_like(steer)], -1)
        controls.append(control)
        state = advance(state, control, bodies, dt=STEP, substeps=1)
    return torch.stack(controls)


def _controls(recorded: Tensor, change: Tensor) -> Tensor:
    """Return the recorded controls [T, N, 4] plus a change of effort and steering, linear between knots [N, K, 2]."""
    step_times, knots = torch.arange(STEPS)[:, None] / KNOT, torch.arange(change.shape[1])
    # Hat functions: each step blends the two adjacent knots.
    share = (1.0 - (step_times - knots).abs()).clamp_min(0.0).to(change.dtype)
    added = torch.einsum("tk,nkc->tnc", share, change)
    effort = recorded[..., 0] - recorded[..., 1] + added[..., 0]
    steer = recorded[..., 2] + added[..., 1]
    return torch.stack(
        [effort.clamp(0.0, 1.0), (-effort).clamp(0.0, 1.0), steer.clamp(-1.0, 1.0), recorded[..., 3]], -1
    )


def _gap(first: Tensor, second: Tensor) -> Tensor:
    """Return the gap between boxes [..., 5]: exact up to `FAR`; beyond it, where most pairs are, from their centres."""
    reach = 0.5 * (torch.hypot(first[..., 3], first[..., 4]) + torch.hypot(second[..., 3], second[..., 4]))
    # The exact distance of boxes is expensive, and most pairs are far apart.
    approximate = torch.hypot(first[..., 0] - second[..., 0], first[..., 1] - second[..., 1]) - 0.7 * reach
    near_pairs = (approximate < FAR).nonzero(as_tuple=True)
    return approximate.index_put(near_pairs, box_gap(first[near_pairs], second[near_pairs]))


def _corners(box: Tensor) -> Tensor:
    """Return the corners [..., 4, 2] of boxes [..., 5]."""
    cos, sin = torch.cos(box[..., 2:3]), torch.sin(box[..., 2:3])
    along = 0.5 * box[..., 3:4] * box.new_tensor([1.0, -1.0, -1.0, 1.0])
    across = 0.5 * box[..., 4:5] * box.new_tensor([1.0, 1.0, -1.0, -1.0])
    return torch.stack([box[..., 0:1] + cos * along - sin * across, box[..., 1:2] + sin * along + cos * across], -1)


def resample_trace(trace: EpisodeTrace) -> F64:
    """Resample a trace to boxes and presence [A, T + 1, 6] at the optimisation steps; absent after its end."""
    row_position = STEP * np.arange(STEPS + 1) / trace.dt
    last_row = len(trace.active) - 1
    row_before = np.minimum(np.floor(row_position + 1e-9).astype(int), last_row)
    row_after = np.minimum(row_before + 1, last_row)
    share = np.clip(row_position - row_before, 0.0, 1.0)[:, None]
    # Linear interpolation must not cross the jump at pi.
    yaw = np.unwrap(trace.yaw.astype(np.float64), axis=0)
    values = [trace.x.astype(np.float64), trace.y.astype(np.float64), yaw]
    columns = [column[row_before] + share * (column[row_after] - column[row_before]) for column in values]
    size = [np.broadcast_to(column.astype(np.float64), columns[0].shape) for column in (trace.length, trace.width)]
    present = trace.active[row_before] & (row_position <= last_row + 1e-9)[:, None]
    return np.stack([*columns, *size, present.astype(np.float64)], -1).transpose(1, 0, 2)
