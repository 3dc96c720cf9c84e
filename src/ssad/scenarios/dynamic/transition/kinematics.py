"""KING: one adversary's controls are optimised by gradients through the differentiable twin of the world.

It starts from what everybody did in a base that the ego survived. The loop is not part of the gradient: a chain of
controls is optimised against the ego as it drove in the chain's last rollout, then the world shows how the ego answers,
and so on. Many chains of many bases are optimised at once.

Source: Hanselmann et al., KING: Generating safety-critical driving scenarios for robust imitation via kinematics
gradients, ECCV 2022 (arXiv 2204.13683); its gradients too leave out how the ego answers.
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
from ssad.scenarios.dynamic.frozen import frozen, with_motion
from ssad.scenarios.dynamic.transition.road import raster_of
from ssad.world.models import model
from ssad.world.twin import Bodies, MotionState, advance, bodies_of, box_gap, unroll

STEP: Final = 0.25  # s, as KING's
STEPS: Final = 80
KNOT: Final = 4  # steps between the values that are optimised: an effort changes within a second, as a driver's does
NEAREST: Final = 4  # vehicles of a base that may become the adversary
ITERATIONS: Final = 30  # of the optimiser before each rollout
RATE: Final = 0.05  # of Adam
BETAS: Final = 0.8, 0.99  # KING's
SOFT: Final = 1.0  # m; the least gap is taken softly
PURSUIT: Final = 0.2  # weight of the mean gap, KING's own objective: the adversary stays with an ego that waits
CLEAR: Final = 1.25  # m that KING keeps between agents
OTHERS: Final = 3.0  # weight of coming nearer than that; KING's
ROAD: Final = 20.0  # weight of corners off the road; KING's
AFTER: Final = 0.2  # weight of what happens after the ego is nearest, when the episode is over
FAR: Final = 6.0  # m
EFFORT: Final = 0.02  # weight of changing what was recorded
PATIENCE: Final = 5  # rollouts of a chain before it starts anew with another adversary
HOPELESS: Final = 10.0  # m; who has not come nearer after two is left alone while there are others
JITTER: Final = 0.25  # spread of the controls that a chain starts with when its adversary has been tried before


@dataclass
class _Chain:
    """One adversary's controls as they develop.

    Attributes:
        base: Number of the base.
        agent: The adversary.
        change: [K, 2] effort and steering added to what was recorded.
        ego: The ego's box and presence [T + 1, 6] in the last rollout.
        weight: Of the road and the others.
        tried: Rollouts so far.
    """

    base: int
    agent: int
    change: F64
    ego: F64
    weight: float = 1.0
    tried: int = 0


class King:
    """Gradients of kinematic states through the differentiable twin (KING), against the ego's last answer."""

    name = "king"

    def __init__(self, bases: Sequence[Base], *, seeds: Sequence[int], budget: int) -> None:
        self.bases = list(bases)
        self.budget = budget
        self._seeds = list(seeds)
        self._frozen = [frozen(base.episode, base.trace) for base in bases]
        self._agents = [adversaries(base) for base in bases]
        self._motion = [sampled(base.trace) for base in bases]
        self._recorded = self._as_recorded()
        self._road = raster_of(
            [base.graph for base in bases],
            [
                np.concatenate([m[..., :2].reshape(-1, 2), b.trace.route])
                for m, b in zip(self._motion, bases, strict=True)
            ],
        )
        self._started = [0] * len(self.bases)
        self._away: list[set[int]] = [set() for _ in self.bases]
        self._chains: list[list[_Chain]] = [[] for _ in self.bases]

    @staticmethod
    def check(episode: Episode) -> None:
        """Whether an episode has a vehicle that could become the adversary.

        Raises:
            ConfigError: It has none.
        """
        if not any(model(agent.model).kind <= AgentKind.BICYCLE for agent in episode.agents[1:]):
            raise _nobody(episode.scenario)

    def ask(self, count: int) -> list[list[Proposal]]:
        """Each chain, further optimised."""
        for k, chains in enumerate(self._chains):
            while len(chains) < count:
                chains.append(self._new_chain(k))
            del chains[count:]
        flat = [chain for chains in self._chains for chain in chains]
        poses = self._optimise(flat)
        proposals: list[list[Proposal]] = [[] for _ in self.bases]
        for chain, pose in zip(flat, poses, strict=True):
            name = self.bases[chain.base].trace.names[chain.agent]
            rows = np.concatenate([STEP * np.arange(STEPS + 1)[:, None], pose], 1)
            scenario = with_motion(self._frozen[chain.base], name, rows)
            proposals[chain.base].append(Proposal(scenario, adversaries=(name,)))
        return proposals

    def tell(self, outcomes: Sequence[Sequence[Outcome]]) -> None:
        """Chains learn how the ego answered; those that are done, or stuck, start anew."""
        for k, row in enumerate(outcomes):
            for at, outcome in enumerate(row):
                chain = self._chains[k][at]
                chain.tried += 1
                away = outcome.gap is None or outcome.gap > HOPELESS
                if away and chain.tried >= 2:
                    self._away[k].add(chain.agent)
                if outcome.trace is None or outcome.valid or chain.tried >= (2 if away else PATIENCE):
                    self._chains[k][at] = self._new_chain(k)
                    continue
                chain.ego = sampled(outcome.trace)[0]
                if outcome.off_road or outcome.hit_others:
                    chain.weight *= 2.0

    def _new_chain(self, base: int) -> _Chain:
        """The next adversary in turn; from the second turn on with other controls to begin with."""
        agents = [a for a in self._agents[base] if a not in self._away[base]] or self._agents[base]
        turn, which = divmod(self._started[base], len(agents))
        agent = agents[which]
        draws = generator("king", self._seeds[base], self._started[base])
        self._started[base] += 1
        change = JITTER * min(turn, 1) * draws.standard_normal((STEPS // KNOT + 1, 2))
        if np.abs(self.bases[base].trace.speed[:, agent]).max() < 0.5:
            change[:, 0] += 0.1  # who stands without throttle has no gradient
        return _Chain(base, agent, change, self._motion[base][0])

    def _as_recorded(self) -> list[dict[int, tuple[MotionState, Tensor]]]:
        """Start and controls [T, 4] with which the twin repeats what each of the adversaries of each base did."""
        who = [(k, agent) for k, agents in enumerate(self._agents) for agent in agents]
        bodies = bodies_of([self.bases[k].trace.models[agent] for k, agent in who], dtype=torch.float64)
        motion = torch.from_numpy(np.stack([self._motion[k][agent] for k, agent in who]))
        speed = torch.tensor([float(self.bases[k].trace.speed[0, agent]) for k, agent in who], dtype=torch.float64)
        start = MotionState(motion[:, 0, :3], speed, torch.zeros_like(speed))
        controls = tracked(start, motion[..., :3].transpose(0, 1), bodies)
        found: list[dict[int, tuple[MotionState, Tensor]]] = [{} for _ in self.bases]
        for i, (k, agent) in enumerate(who):
            found[k][agent] = MotionState(*(part[i] for part in start)), controls[:, i]
        return found

    def _optimise(self, chains: Sequence[_Chain]) -> F64:
        """Improves the chains' controls, and returns the poses [N, T + 1, 3] that they lead to."""
        recorded = [self._recorded[c.base][c.agent] for c in chains]
        start = MotionState(*(torch.stack(parts) for parts in zip(*(r[0] for r in recorded), strict=True)))
        told = torch.stack([r[1] for r in recorded], 1)
        bodies = bodies_of([self.bases[c.base].trace.models[c.agent] for c in chains], dtype=torch.float64)
        ego = torch.from_numpy(np.stack([c.ego for c in chains]))
        others = torch.from_numpy(self._others(chains))
        weight = torch.tensor([c.weight for c in chains], dtype=torch.float64)
        place = torch.tensor([c.base for c in chains])
        change = torch.from_numpy(np.stack([c.change for c in chains])).requires_grad_()

        def moved() -> MotionState:
            states = unroll(start, _controls(told, change), bodies, dt=STEP, substeps=1)
            sound = change.isfinite().all(-1).all(-1) & states.pose.isfinite().all(-1).all(0)
            if not bool(sound.all()):
                bad = self.bases[chains[int((~sound).nonzero()[0])].base].scenario.name
                raise ConfigError(f"generator king: the optimisation diverged in {bad} (a motion that is not finite)")
            return states

        first, second = torch.zeros_like(change), torch.zeros_like(change)
        for step in range(1, ITERATIONS + 1):
            cost = self._cost(moved(), bodies, ego=ego, others=others, weight=weight, place=place)
            cost = cost + EFFORT * change.square().mean((1, 2))
            (slope,) = torch.autograd.grad(cost.sum(), change)
            # Adam; that of torch.optim imports torch's compiler first, which takes 4 s
            with torch.no_grad():
                first.lerp_(slope, 1.0 - BETAS[0])
                second.lerp_(slope.square(), 1.0 - BETAS[1])
                size = (second / (1.0 - BETAS[1] ** step)).sqrt() + 1e-8
                change -= RATE / (1.0 - BETAS[0] ** step) * first / size
        with torch.no_grad():
            states = moved()
        for chain, values in zip(chains, change.detach().numpy(), strict=True):
            chain.change = values.copy()
        return states.pose.transpose(0, 1).numpy()

    def _others(self, chains: Sequence[_Chain]) -> F64:
        """Boxes and presence [N, O, T + 1, 6] of all but the ego and the adversary, as they were recorded."""
        most = max(len(self._motion[c.base]) for c in chains)
        found = np.zeros((len(chains), most, STEPS + 1, 6))
        for row, chain in zip(found, chains, strict=True):
            motion = self._motion[chain.base]
            row[: len(motion)] = motion
            row[[0, chain.agent], :, 5] = 0.0
        return found

    def _cost(
        self, states: MotionState, bodies: Bodies, *, ego: Tensor, others: Tensor, weight: Tensor, place: Tensor
    ) -> Tensor:
        """Costs [N]: near the ego is good, near others or off the road is bad."""
        pose = states.pose.transpose(0, 1)
        size = torch.stack([bodies.length, bodies.width], -1)[:, None].expand(-1, STEPS + 1, -1)
        box = torch.cat([pose, size], -1)
        there = ego[..., 5] > 0.5
        gap = torch.where(there, _gap(box, ego[..., :5]), 1.0e3)
        near = -SOFT * torch.logsumexp(-gap / SOFT, -1)
        present = there.sum(-1).clamp_min(1)
        pursuit = torch.where(there, gap.clamp(0.0, 50.0), 0.0).sum(-1) / present
        near = near + PURSUIT * pursuit
        # the episode ends where the two meet
        time = torch.arange(STEPS + 1)
        counts = torch.where(time <= gap.detach().argmin(1)[:, None] + 2, 1.0, AFTER)
        apart = (pose.detach()[:, None, :, :2] - others[..., :2]).square().sum(-1)
        pick = torch.where(others[..., 5] > 0.5, apart, 1.0e9).argmin(1)
        nearest = torch.take_along_dim(others, pick[:, None, :, None], 1)[:, 0]
        close = torch.where(nearest[..., 5] > 0.5, (CLEAR - _gap(box, nearest[..., :5])).clamp_min(0.0), 0.0)
        off = self._road(_corners(box), place).clamp(0.0, 5.0).sum(-1)
        beside = self._road(pose[..., :2], place).add(0.5).clamp(0.0, 5.0)
        road = ((off + 4.0 * beside) * counts).mean(1)
        return near + weight * (OTHERS * (close * counts).amax(1) + ROAD * road)


def adversaries(base: Base) -> list[int]:
    """The vehicles of a base that could become adversaries: present from the start, nearest to the ego's route first.

    Raises:
        ConfigError: There are none.
    """
    trace = base.trace
    found = []
    for agent in range(1, len(trace.names)):
        if trace.active[0, agent] and AgentKind.NONE < trace.kind[agent] <= AgentKind.BICYCLE:
            there = trace.active[:, agent]
            path = np.stack([trace.x[there, agent], trace.y[there, agent]], 1)[::5]
            apart = np.hypot(*np.moveaxis(path[:, None] - trace.route[None], -1, 0))
            found.append((float(apart.min()), agent))
    if not found:
        raise _nobody(base.scenario)
    return [agent for _, agent in sorted(found)[:NEAREST]]


def _nobody(scenario: Scenario) -> ConfigError:
    return ConfigError(
        f"scenario {scenario.name}: there is no vehicle in it that could be an adversary; "
        "add one, or take another scenario"
    )


def tracked(start: MotionState, poses: Tensor, bodies: Bodies) -> Tensor:
    """Controls [T, N, 4] with which the twin follows recorded poses [T + 1, N, 3], as near as the bodies allow."""
    state, controls = start, []
    for now, then in pairwise(poses):
        x, y, yaw = state.pose.unbind(-1)
        cos, sin = torch.cos(now[:, 2]), torch.sin(now[:, 2])
        ahead = (then[:, 0] - x) * cos + (then[:, 1] - y) * sin
        left = (x - now[:, 0]) * -sin + (y - now[:, 1]) * cos
        speed = 2.0 * ahead / STEP - state.speed  # the mean over the step covers the distance
        wanted = 0.5 * (speed + torch.hypot(then[:, 0] - now[:, 0], then[:, 1] - now[:, 1]) / STEP)
        effort = (wanted - state.speed) / STEP
        effort = torch.where(effort > 0.0, effort / bodies.max_accel, effort / bodies.max_brake).clamp(-1.0, 1.0)
        fast = state.speed.clamp_min(1.0)
        turn = torch.remainder(then[:, 2] - yaw + torch.pi, 2 * torch.pi) - torch.pi - torch.atan(0.7 * left / fast)
        slip = torch.asin((turn / STEP * bodies.wheelbase / (2.0 * fast)).clamp(-0.9, 0.9))
        wheel = torch.atan(2.0 * torch.tan(slip))
        steer = torch.where(state.speed > 0.3, (wheel / bodies.max_steer).clamp(-1.0, 1.0), 0.0)
        control = torch.stack([effort.clamp(0.0, 1.0), (-effort).clamp(0.0, 1.0), steer, torch.zeros_like(steer)], -1)
        controls.append(control)
        state = advance(state, control, bodies, dt=STEP, substeps=1)
    return torch.stack(controls)


def _controls(told: Tensor, change: Tensor) -> Tensor:
    """Controls [T, N, 4]: those told, and what is added to effort and steering, linear between knots [N, K, 2]."""
    times, knots = torch.arange(STEPS)[:, None] / KNOT, torch.arange(change.shape[1])
    share = (1.0 - (times - knots).abs()).clamp_min(0.0).to(change.dtype)
    added = torch.einsum("tk,nkc->tnc", share, change)
    effort = told[..., 0] - told[..., 1] + added[..., 0]
    steer = told[..., 2] + added[..., 1]
    return torch.stack([effort.clamp(0.0, 1.0), (-effort).clamp(0.0, 1.0), steer.clamp(-1.0, 1.0), told[..., 3]], -1)


def _gap(first: Tensor, second: Tensor) -> Tensor:
    """How far boxes [..., 5] are apart: exact up to `FAR`; beyond it, where most pairs are, from their centres."""
    reach = 0.5 * (torch.hypot(first[..., 3], first[..., 4]) + torch.hypot(second[..., 3], second[..., 4]))
    rough = torch.hypot(first[..., 0] - second[..., 0], first[..., 1] - second[..., 1]) - 0.7 * reach
    near = (rough < FAR).nonzero(as_tuple=True)
    return rough.index_put(near, box_gap(first[near], second[near]))


def _corners(box: Tensor) -> Tensor:
    """Corners [..., 4, 2] of boxes [..., 5]."""
    cos, sin = torch.cos(box[..., 2:3]), torch.sin(box[..., 2:3])
    along = 0.5 * box[..., 3:4] * box.new_tensor([1.0, -1.0, -1.0, 1.0])
    across = 0.5 * box[..., 4:5] * box.new_tensor([1.0, 1.0, -1.0, -1.0])
    return torch.stack([box[..., 0:1] + cos * along - sin * across, box[..., 1:2] + sin * along + cos * across], -1)


def sampled(trace: EpisodeTrace) -> F64:
    """Boxes and presence [A, T + 1, 6] of a trace at the steps of the optimisation; after its end nobody is there."""
    at = STEP * np.arange(STEPS + 1) / trace.dt
    last = len(trace.active) - 1
    low = np.minimum(np.floor(at + 1e-9).astype(int), last)
    high = np.minimum(low + 1, last)
    share = np.clip(at - low, 0.0, 1.0)[:, None]
    yaw = np.unwrap(trace.yaw.astype(np.float64), axis=0)
    values = [trace.x.astype(np.float64), trace.y.astype(np.float64), yaw]
    columns = [v[low] + share * (v[high] - v[low]) for v in values]
    size = [np.broadcast_to(v.astype(np.float64), columns[0].shape) for v in (trace.length, trace.width)]
    there = trace.active[low] & (at <= last + 1e-9)[:, None]
    return np.stack([*columns, *size, there.astype(np.float64)], -1).transpose(1, 0, 2)
