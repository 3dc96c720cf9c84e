"""Realism of motion: the histogram score of the sim-agents challenge, and Wasserstein distances.

The challenge scores simulated agents against the log of the same agents. Generated scenarios have no log, so a motion
is scored under histograms of a named reference, pooled over its agents and steps. Bins, weights and pseudo-count are
the challenge's.

Source: Montali et al., The Waymo Open Sim Agents Challenge, 2023, with the configuration of 2025.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from ssad.core.geometry import obb_distance
from ssad.core.rotations import wrap_angle
from ssad.core.types import F64, EpisodeTrace
from ssad.metrics.criticality import time_to_collision, trace_boxes

PSEUDO_COUNT: Final = 0.1


@dataclass(frozen=True)
class Feature:
    """A feature of motion: range and number of its bins (two for a yes-or-no feature), weight and unit."""

    low: float
    high: float
    bins: int
    weight: float
    unit: str


FEATURES: Final[Mapping[str, Feature]] = {
    "speed": Feature(0.0, 25.0, 10, 0.05, "m/s"),
    "acceleration": Feature(-12.0, 12.0, 11, 0.05, "m/s^2"),
    "yaw_rate": Feature(-0.628, 0.628, 11, 0.05, "rad/s"),
    "yaw_acceleration": Feature(-3.14, 3.14, 11, 0.05, "rad/s^2"),
    "nearest": Feature(-5.0, 40.0, 10, 0.10, "m"),
    "ttc": Feature(0.0, 5.0, 10, 0.10, "s"),
    "road_edge": Feature(-20.0, 40.0, 10, 0.05, "m"),
    "collision": Feature(0.0, 1.0, 2, 0.25, ""),
    "off_road": Feature(0.0, 1.0, 2, 0.25, ""),
}
"""Name -> feature. The challenge's red lights (weight 0.05) are left out: only the ego's are recorded. Collisions are
those with others than the ego, since a collision with the ego is what a generator is asked for."""


def motion_features(trace: EpisodeTrace, agent: int, road_edge: F64) -> dict[str, F64]:
    """Return the features of one agent's motion.

    Args:
        trace: The trace of the episode.
        agent: The agent.
        road_edge: [T] signed distance of its centre from the edge of the road, m, positive off the road.

    Returns:
        Feature -> values, one for each step with the agent present and the feature defined; collision and
        off_road have one.
    """
    active_steps = np.flatnonzero(trace.active[:, agent])
    dt, body_boxes = float(trace.dt), trace_boxes(trace)
    speed = trace.speed[active_steps, agent].astype(np.float64)
    yaw_rate = np.asarray(wrap_angle(np.diff(trace.yaw[active_steps, agent].astype(np.float64)))) / dt
    other_agents = [other_agent for other_agent in range(len(trace.kind)) if other_agent != agent]
    distances = np.full((len(active_steps), len(other_agents)), np.inf)
    collision_times = np.full((len(active_steps), len(other_agents)), np.inf)
    velocity = trace.speed[..., None] * np.stack([np.cos(trace.yaw), np.sin(trace.yaw)], -1)
    for other_column, other_index in enumerate(other_agents):
        both_active = trace.active[active_steps, other_index]
        rows = active_steps[both_active]
        distances[both_active, other_column] = obb_distance(body_boxes[rows, agent], body_boxes[rows, other_index])
        closing_velocity = (velocity[rows, agent] - velocity[rows, other_index]).astype(np.float64)
        collision_times[both_active, other_column] = time_to_collision(
            body_boxes[rows, agent], body_boxes[rows, other_index], closing_velocity
        )
    nearest = distances.min(axis=1, initial=np.inf)
    # Agent 0 is left out: a collision with the ego is the goal of a generator.
    touched_agents = [
        other_agent
        for other_column, other_agent in enumerate(other_agents)
        if other_agent != 0 and (distances[:, other_column] <= 0.0).any()
    ]
    return {
        "speed": np.abs(speed),
        "acceleration": np.diff(speed) / dt,
        "yaw_rate": yaw_rate,
        "yaw_acceleration": np.diff(yaw_rate) / dt,
        "nearest": nearest[np.isfinite(nearest)],
        "ttc": np.minimum(collision_times.min(axis=1, initial=np.inf), FEATURES["ttc"].high),
        "road_edge": road_edge[active_steps],
        "collision": np.array([float(bool(touched_agents))]),
        "off_road": np.array([float((road_edge[active_steps] > 0.0).any())]),
    }


def pool_motions(motions: Sequence[Mapping[str, F64]]) -> dict[str, F64]:
    """Return the values of several motions together, by feature."""
    return {name: np.concatenate([motion[name] for motion in motions] or [np.zeros(0)]) for name in FEATURES}


def histogram(values: F64, feature: Feature) -> F64:
    """Return the probabilities [bins] with the pseudo-count; outliers count in the first or last bin."""
    counts = np.bincount(_bin_indices(values, feature), minlength=feature.bins) + PSEUDO_COUNT
    return np.asarray(counts / counts.sum())


def realism(motions: Mapping[str, F64], reference: Mapping[str, F64]) -> float:
    """Return the weighted mean of the features' likelihoods under the reference, 0 to 1; NaN without values.

    The likelihood of a feature is the geometric mean of the probabilities of its values' bins.

    Args:
        motions: Feature -> values of the scored motion.
        reference: Feature -> values of ordinary traffic.
    """
    total = weight = 0.0
    for name, feature in FEATURES.items():
        if len(motions[name]) and len(reference[name]):
            probabilities = histogram(reference[name], feature)[_bin_indices(motions[name], feature)]
            total += feature.weight * math.exp(float(np.log(probabilities).mean()))
            weight += feature.weight
    return total / weight if weight else math.nan


def wasserstein(motions: Mapping[str, F64], reference: Mapping[str, F64]) -> dict[str, float]:
    """Wasserstein distance of each feature's values from the reference's, in the feature's unit; NaN without values."""
    from scipy.stats import wasserstein_distance

    return {
        name: float(wasserstein_distance(motions[name], reference[name]))
        if len(motions[name]) and len(reference[name])
        else math.nan
        for name in FEATURES
    }


def _bin_indices(values: F64, feature: Feature) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    fraction = (np.asarray(values, np.float64) - feature.low) / (feature.high - feature.low)
    return np.clip(np.floor(fraction * feature.bins), 0, feature.bins - 1).astype(np.int64)
