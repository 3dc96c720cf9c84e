"""CAT: the adversary takes the likely trajectory that most probably meets the ego, by a product of three terms.

The probability that the opponent drives trajectory j and collides is summed over what the ego may do (the paper's
Eq. 8): P1, how likely traffic drives j from there; P2, how likely the ego does i, for which its last rollouts stand;
P3, how likely i and j collide, more so the earlier. CAT takes P1 from a network for motion forecasts that must be
downloaded. Here it is learned from recorded traffic: the candidates are recorded motions that began at about the same
speed, and one that leaves the road or meets others has no place in traffic.

Source: Zhang et al., CAT: Closed-loop adversarial training for safe end-to-end driving, CoRL 2023 (arXiv 2310.12432),
sections 3.2 and 4.1 with its constants: 32 candidates, the ego's last 5 rollouts, 0.99^k at steps of 0.5 s.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
import torch

from ssad.core.generators import Base, Outcome, Proposal
from ssad.core.geometry import obb_distance, to_local, to_world
from ssad.core.rotations import wrap_angle
from ssad.core.seeding import generator
from ssad.core.types import F64, AgentKind, Bool, Controller, EpisodeTrace
from ssad.scenarios.dynamic.episode import build_episode
from ssad.scenarios.dynamic.frozen import frozen, with_motion
from ssad.scenarios.dynamic.sets import load_scenarios
from ssad.scenarios.dynamic.transition.kinematics import STEP, King, adversaries, sampled
from ssad.scenarios.dynamic.transition.road import raster_of

LENGTH: Final = 32  # steps of 0.25 s: 8 s, as CAT's forecast
CANDIDATES: Final = 32  # M
ANSWERS: Final = 5  # N rollouts of the ego
STRIDE: Final = 2  # steps: overlaps are looked for every 0.5 s
DECAY: Final = 0.99
SPREAD: Final = 0.5  # m/s: how near a recorded motion's first speed must be to the opponent's
STARTS: Final = 4  # steps between the moments from which the opponent may drive otherwise: 1 s
EPISODES: Final = 16  # of natural traffic that the prior is learned from


@dataclass(frozen=True)
class _Candidate:
    """A trajectory that an opponent may take: the recorded one up to step `start`, then another.

    Attributes:
        agent: The opponent.
        start: Step.
        pose: [LENGTH + 1, 3] x, y, yaw from there.
        prior: P1.
    """

    agent: int
    start: int
    pose: F64
    prior: float


class Cat:
    """The likely trajectory that meets the ego's last rollouts (CAT), its prior learned from natural traffic."""

    name = "cat"
    check = staticmethod(King.check)

    def __init__(self, bases: Sequence[Base], *, seeds: Sequence[int], budget: int) -> None:
        self.bases = list(bases)
        self._frozen = [frozen(base.episode, base.trace) for base in bases]
        self._motion = [sampled(base.trace) for base in bases]
        self._left = [self._candidates(k, seed) for k, seed in enumerate(seeds)]
        self._egos: list[deque[F64]] = [deque([motion[0]], maxlen=ANSWERS) for motion in self._motion]

    def ask(self, count: int) -> list[list[Proposal]]:
        """The candidates of the largest products that have not been tried."""
        return [self._best(k, count) for k in range(len(self.bases))]

    def tell(self, outcomes: Sequence[Sequence[Outcome]]) -> None:
        """Keep how the ego drove."""
        for egos, row in zip(self._egos, outcomes, strict=True):
            egos.extend(sampled(o.trace)[0] for o in row if o.trace is not None)

    def _best(self, base: int, count: int) -> list[Proposal]:
        left = self._left[base]
        scores = [self._score(base, candidate) for candidate in left]
        order = sorted(range(len(left)), key=lambda j: scores[j], reverse=True)[:count]
        self._left[base] = [c for j, c in enumerate(left) if j not in set(order)]
        return [self._proposal(base, left[j]) for j in order]

    def _score(self, base: int, candidate: _Candidate) -> tuple[float, float]:
        """The product of the three terms, summed over the ego's rollouts; where it is 0, minus the least distance."""
        size = self._motion[base][candidate.agent, 0, 3:5]
        at = np.arange(candidate.start, min(candidate.start + LENGTH, self._motion[base].shape[1] - 1) + 1, STRIDE)
        pose = candidate.pose[at - candidate.start]
        body = np.concatenate([pose, np.broadcast_to(size, (len(at), 2))], 1)
        total, least = 0.0, np.inf
        for ego in self._egos[base]:
            there = ego[at, 5] > 0.5
            apart = np.where(there, np.hypot(*(ego[at, :2] - pose[:, :2]).T), np.inf)
            least = min(least, float(apart.min(initial=np.inf)))
            near = np.flatnonzero(apart < 8.0)
            touch = near[obb_distance(body[near], ego[at][near, :5]) <= 0.0] if len(near) else near
            if len(touch):
                total += candidate.prior * DECAY ** float(touch[0])
        return total, -least

    def _proposal(self, base: int, candidate: _Candidate) -> Proposal:
        before = self._motion[base][candidate.agent, : candidate.start, :3]
        pose = np.concatenate([before, candidate.pose])
        rows = np.concatenate([STEP * np.arange(len(pose))[:, None], pose], 1)
        name = self.bases[base].trace.names[candidate.agent]
        return Proposal(with_motion(self._frozen[base], name, rows), adversaries=(name,))

    def _candidates(self, base: int, seed: int) -> list[_Candidate]:
        """All trajectories of all opponents and moments that traffic might drive, each with its prior."""
        motions, speeds = traffic()
        motion = self._motion[base]
        last = int(np.flatnonzero(motion[0, :, 5] > 0.5)[-1])
        random = generator("cat", seed)
        found: list[_Candidate] = []
        for agent in adversaries(self.bases[base]):
            for start in range(0, max(last - LENGTH // 4, 1), STARTS):
                now = motion[agent, start]
                if now[5] < 0.5:
                    continue
                speed = float(np.hypot(*(motion[agent, start + 1, :2] - now[:2]))) / STEP
                weight = np.exp(-0.5 * ((speeds - speed) / SPREAD) ** 2)
                # equal weights fall to chance and not to the order of the recordings
                pick = np.argsort(-weight - 1e-9 * random.random(len(weight)))[:CANDIDATES]
                pose = np.concatenate([to_world(now[:3], motions[pick, :, :2]), motions[pick, :, 2:] + now[2]], -1)
                chance = weight[pick] * self._plausible(base, agent, start, pose)
                if chance.sum() > 0.0:
                    chance = chance / chance.sum()
                found += [_Candidate(agent, start, p, float(c)) for p, c in zip(pose, chance, strict=True) if c > 0.0]
        return found

    def _plausible(self, base: int, agent: int, start: int, pose: F64) -> F64:
        """1 where trajectories [M, LENGTH + 1, 3] stay on the road and clear of all but the ego, else 0."""
        motion = self._motion[base]
        at = np.minimum(np.arange(start, start + LENGTH + 1), motion.shape[1] - 1)[::STRIDE]
        path = pose[:, ::STRIDE]
        road = raster_of([self.bases[base].graph], [path[..., :2].reshape(-1, 2)])
        edge = road(torch.from_numpy(np.ascontiguousarray(path[..., :2])), torch.zeros(len(path), dtype=torch.long))
        good: Bool = np.asarray((edge.numpy() < 0.0).all(1))
        size = motion[agent, 0, 3:5]
        for other in range(1, len(motion)):
            if other == agent:
                continue
            box, there = motion[other, at, :5], motion[other, at, 5] > 0.5
            near = there & (np.hypot(*np.moveaxis(path[..., :2] - box[:, :2], -1, 0)) < 9.0)
            row, column = np.nonzero(near)
            if len(row):
                body = np.concatenate([path[row, column], np.broadcast_to(size, (len(row), 2))], 1)
                good[row[obb_distance(body, box[column]) <= 0.0]] = False
        return np.asarray(good, np.float64)


@lru_cache(maxsize=1)
def traffic() -> tuple[F64, F64]:
    """What the prior is learned from: motions of vehicles in natural scenarios that the Autopilot drives.

    Returns:
        Motions [K, LENGTH + 1, 3], x, y, yaw in the frame of their first pose, and their first speeds [K], m/s.
    """
    from ssad.world.roads import load_town
    from ssad.world.rollout import rollout
    from ssad.world.world import World

    scenarios = load_scenarios("natural")
    chosen = scenarios[:: max(1, len(scenarios) // EPISODES)][:EPISODES]
    graphs = {name: load_town(name) for name in {s.town for s in chosen}}
    # a seed of its own: what is searched is not what is learned from
    episodes = [build_episode(s, graphs[s.town], seed=1_000_003) for s in chosen]
    found = [windows(trace) for trace in rollout(World(episodes, graphs, ego=Controller.AUTOPILOT), {})]
    return np.concatenate([m for m, _ in found]), np.concatenate([s for _, s in found])


def windows(trace: EpisodeTrace) -> tuple[F64, F64]:
    """All motions of 8 s in a trace, one of each vehicle every second: as `traffic` returns them."""
    motion = sampled(trace)
    motions, speeds = [np.zeros((0, LENGTH + 1, 3))], [0.0][:0]
    for agent in np.flatnonzero(trace.kind <= AgentKind.BICYCLE).tolist():
        for start in range(0, motion.shape[1] - LENGTH - 1, STARTS):
            part = motion[agent, start : start + LENGTH + 1]
            if (part[:, 5] > 0.5).all() and np.hypot(*np.ptp(part[:, :2], axis=0)) > 1.0:
                local = to_local(part[0, :3], part[:, :2])
                turned = np.asarray(wrap_angle(part[:, 2:3] - part[0, 2]))
                motions.append(np.concatenate([local, turned], 1)[None].astype(np.float64))
                speeds.append(float(np.hypot(*(part[1, :2] - part[0, :2]))) / STEP)
    return np.concatenate(motions), np.array(speeds)
