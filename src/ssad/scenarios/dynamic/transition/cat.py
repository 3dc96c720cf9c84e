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
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from ssad.core import safeio
from ssad.core.errors import FormatError
from ssad.core.generators import Base, Outcome, Proposal
from ssad.core.geometry import obb_distance, to_local, to_world
from ssad.core.rotations import wrap_angle
from ssad.core.seeding import generator
from ssad.core.types import F64, Bool, EpisodeTrace
from ssad.scenarios.dynamic.frozen import freeze_episode, with_motion
from ssad.scenarios.dynamic.transition.king import STEP, King, adversary_candidates, resample_trace
from ssad.scenarios.dynamic.transition.road import raster_of

LENGTH: Final = 32  # steps of 0.25 s: 8 s, as CAT's forecast
CANDIDATES: Final = 32  # M
ANSWERS: Final = 5  # N rollouts of the ego
STRIDE: Final = 2  # steps: overlaps are looked for every 0.5 s
DECAY: Final = 0.99
SPREAD: Final = 0.5  # m/s: kernel width on the difference of initial speeds
STARTS: Final = 4  # steps between the moments from which the opponent may drive otherwise: 1 s
MOTIONS: Final = Path(__file__).with_name("motions.npz")
UNITS: Final = (0.01, 0.01, 0.0001)  # m, m, rad: steps of the poses in the library


@dataclass(frozen=True)
class _Candidate:
    """Trajectory that an opponent may take: the recorded one up to step `start`, then another.

    Attributes:
        agent: Index of the opponent.
        start: Step.
        pose: [HORIZON_STEPS + 1, 3] x, y, yaw from that step on.
        prior: P1.
    """

    agent: int
    start: int
    pose: F64
    prior: float


class Cat:
    """Plausible trajectory that hits the ego's last rollouts (CAT), with a prior learned from natural traffic."""

    name = "cat"
    check = staticmethod(King.check)

    def __init__(self, bases: Sequence[Base], *, seeds: Sequence[int], budget: int) -> None:
        self.bases = list(bases)
        self._frozen = [freeze_episode(base.episode, base.trace) for base in bases]
        self._motion = [resample_trace(base.trace) for base in bases]
        self._untried = [self._candidates(base_index, seed) for base_index, seed in enumerate(seeds)]
        self._egos: list[deque[F64]] = [deque([motion[0]], maxlen=ANSWERS) for motion in self._motion]

    def ask(self, count: int) -> list[list[Proposal]]:
        """Propose the untried candidates with the largest products."""
        return [self._best_proposals(base_index, count) for base_index in range(len(self.bases))]

    def tell(self, outcomes: Sequence[Sequence[Outcome]]) -> None:
        """Store the ego's trajectories."""
        for egos, base_outcomes in zip(self._egos, outcomes, strict=True):
            egos.extend(resample_trace(outcome.trace)[0] for outcome in base_outcomes if outcome.trace is not None)

    def _best_proposals(self, base: int, count: int) -> list[Proposal]:
        untried = self._untried[base]
        scores = [self._score(base, candidate) for candidate in untried]
        best_indices = sorted(range(len(untried)), key=lambda index: scores[index], reverse=True)[:count]
        self._untried[base] = [remaining for index, remaining in enumerate(untried) if index not in set(best_indices)]
        return [self._proposal(base, untried[index]) for index in best_indices]

    def _score(self, base: int, candidate: _Candidate) -> tuple[float, float]:
        """Return the product of the three terms, summed over the ego's rollouts, and minus the minimum distance."""
        size = self._motion[base][candidate.agent, 0, 3:5]
        steps = np.arange(candidate.start, min(candidate.start + LENGTH, self._motion[base].shape[1] - 1) + 1, STRIDE)
        pose = candidate.pose[steps - candidate.start]
        body = np.concatenate([pose, np.broadcast_to(size, (len(steps), 2))], 1)
        score, min_distance = 0.0, np.inf
        for ego in self._egos[base]:
            ego_present = ego[steps, 5] > 0.5
            distance = np.where(ego_present, np.hypot(*(ego[steps, :2] - pose[:, :2]).T), np.inf)
            min_distance = min(min_distance, float(distance.min(initial=np.inf)))
            near_rows = np.flatnonzero(distance < 8.0)
            contact_rows = (
                near_rows[obb_distance(body[near_rows], ego[steps][near_rows, :5]) <= 0.0]
                if len(near_rows)
                else near_rows
            )
            if len(contact_rows):
                score += candidate.prior * DECAY ** float(contact_rows[0])
        return score, -min_distance

    def _proposal(self, base: int, candidate: _Candidate) -> Proposal:
        recorded = self._motion[base][candidate.agent, : candidate.start, :3]
        pose = np.concatenate([recorded, candidate.pose])
        rows = np.concatenate([STEP * np.arange(len(pose))[:, None], pose], 1)
        name = self.bases[base].trace.names[candidate.agent]
        return Proposal(with_motion(self._frozen[base], name, rows), adversaries=(name,))

    def _candidates(self, base: int, seed: int) -> list[_Candidate]:
        """Return all plausible trajectories of all opponents and start steps, each with its prior."""
        motions, speeds = traffic_motions()
        motion = self._motion[base]
        last_step = int(np.flatnonzero(motion[0, :, 5] > 0.5)[-1])
        random = generator("cat", seed)
        candidates: list[_Candidate] = []
        for agent in adversary_candidates(self.bases[base]):
            for start in range(0, max(last_step - LENGTH // 4, 1), STARTS):
                current = motion[agent, start]
                if current[5] < 0.5:
                    continue
                speed = float(np.hypot(*(motion[agent, start + 1, :2] - current[:2]))) / STEP
                weights = np.exp(-0.5 * ((speeds - speed) / SPREAD) ** 2)
                # equal weights fall to chance and not to the order of the recordings
                selected = np.argsort(-weights - 1e-9 * random.random(len(weights)))[:CANDIDATES]
                pose = np.concatenate(
                    [to_world(current[:3], motions[selected, :, :2]), motions[selected, :, 2:] + current[2]], -1
                )
                priors = weights[selected] * self._plausibility(base, agent, start, pose)
                if priors.sum() > 0.0:
                    priors = priors / priors.sum()
                candidates += [
                    _Candidate(agent, start, trajectory, float(prior))
                    for trajectory, prior in zip(pose, priors, strict=True)
                    if prior > 0.0
                ]
        return candidates

    def _plausibility(self, base: int, agent: int, start: int, pose: F64) -> F64:
        """Return 1 for trajectories [M, T + 1, 3] on the road and clear of all agents but the ego, else 0."""
        motion = self._motion[base]
        steps = np.minimum(np.arange(start, start + LENGTH + 1), motion.shape[1] - 1)[::STRIDE]
        path = pose[:, ::STRIDE]
        road = raster_of([self.bases[base].graph], [path[..., :2].reshape(-1, 2)])
        edge = road(torch.from_numpy(np.ascontiguousarray(path[..., :2])), torch.zeros(len(path), dtype=torch.long))
        plausible: Bool = np.asarray((edge.numpy() < 0.0).all(1))
        size = motion[agent, 0, 3:5]
        for other_agent in range(1, len(motion)):
            if other_agent == agent:
                continue
            other_boxes, other_present = motion[other_agent, steps, :5], motion[other_agent, steps, 5] > 0.5
            near_mask = other_present & (np.hypot(*np.moveaxis(path[..., :2] - other_boxes[:, :2], -1, 0)) < 9.0)
            row, column = np.nonzero(near_mask)
            if len(row):
                body = np.concatenate([path[row, column], np.broadcast_to(size, (len(row), 2))], 1)
                plausible[row[obb_distance(body, other_boxes[column]) <= 0.0]] = False
        return np.asarray(plausible, np.float64)


@lru_cache(maxsize=4)
def traffic_motions(path: Path = MOTIONS) -> tuple[F64, F64]:
    """Return the motions that the prior is learned from: motor vehicles of SSAD's own traffic.

    Args:
        path: Library, made by `python -m benchmarks.traffic_reference`.

    Returns:
        Motions [K, LENGTH + 1, 3], x, y, yaw in the frame of their first pose, and their first speeds [K], m/s.

    Raises:
        FormatError: The file is no library of motions.
    """
    arrays = safeio.load_npz(path)
    if set(arrays) != {"pose", "speed"} or arrays["pose"].shape[1:] != (LENGTH + 1, 3):
        raise FormatError(f"{path}: no library of motions; make it with python -m benchmarks.traffic_reference")
    return arrays["pose"] * np.array(UNITS), arrays["speed"].astype(np.float64)


def library_data(motions: F64, speeds: F64) -> dict[str, np.ndarray[Any, Any]]:
    """Return the content of a library of motions: poses in steps of 1 cm and 0.0001 rad, and speeds."""
    pose = np.clip(np.round(motions / np.array(UNITS)), -32768, 32767).astype(np.int16)
    return {"pose": pose, "speed": speeds.astype(np.float32)}


def motion_windows(trace: EpisodeTrace, agents: Sequence[int]) -> tuple[F64, F64]:
    """Return all motions of 8 s of some agents in a trace, one of each agent every second, as `traffic_motions` does.

    Args:
        trace: The trace of the episode.
        agents: Indices of the agents.
    """
    motion = resample_trace(trace)
    motions, speeds = [np.zeros((0, LENGTH + 1, 3))], [0.0][:0]
    for agent in agents:
        for start in range(0, motion.shape[1] - LENGTH - 1, STARTS):
            window = motion[agent, start : start + LENGTH + 1]
            if (window[:, 5] > 0.5).all() and np.hypot(*np.ptp(window[:, :2], axis=0)) > 1.0:
                local = to_local(window[0, :3], window[:, :2])
                relative_yaw = np.asarray(wrap_angle(window[:, 2:3] - window[0, 2]))
                motions.append(np.concatenate([local, relative_yaw], 1)[None].astype(np.float64))
                speeds.append(float(np.hypot(*(window[1, :2] - window[0, :2]))) / STEP)
    return np.concatenate(motions), np.array(speeds)
