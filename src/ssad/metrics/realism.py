"""Realism of motion: the histogram score of the sim-agents challenge, Wasserstein distances, published limits.

The challenge scores simulated agents against the log of the same agents. Generated scenarios have no log, so a motion
is scored under histograms of SSAD's own traffic (`traffic_reference`), pooled over its agents and steps. Bins, weights
and pseudo-count are the challenge's. A second reference needs no simulation: the highest values that are published of
ordinary human driving (`published_limits`).

Source: Montali et al., The Waymo Open Sim Agents Challenge, 2023, with the configuration of 2025.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np

from ssad.core import safeio
from ssad.core.errors import FormatError
from ssad.core.geometry import obb_distance
from ssad.core.rotations import wrap_angle
from ssad.core.types import F64, Bool, EpisodeTrace
from ssad.metrics.criticality import time_to_collision, trace_boxes
from ssad.metrics.human_driving import spread

PSEUDO_COUNT: Final = 0.1
REFERENCE: Final = Path(__file__).with_name("traffic_reference.json")
QUANTILES: Final = 500  # of each feature that the reference keeps
JERK_WINDOW: Final = 0.5  # s over which accelerations are averaged before their difference is taken


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


@dataclass(frozen=True)
class PublishedLimits:
    """Highest published values of ordinary human driving.

    Attributes:
        acceleration: Acceleration from rest, m/s^2.
        deceleration: Largest deceleration of a routine stop, m/s^2.
        lateral: Acceleration to the side in turns, m/s^2.
        jerk: Jerk of a careful and competent driver, m/s^3.
    """

    acceleration: float
    deceleration: float
    lateral: float
    jerk: float


@cache
def published_limits() -> PublishedLimits:
    """Return the limits from `ssad.metrics.human_driving`, where each value has its source and certainty."""
    return PublishedLimits(
        acceleration=spread("acceleration from rest")[1],
        deceleration=spread("largest deceleration of a routine stop")[1],
        lateral=spread("lateral acceleration in turns")[1],
        jerk=spread("jerk")[1],
    )


def within_published(trace: EpisodeTrace, agent: int) -> Bool:
    """Return in which steps an agent drives within the published limits.

    Args:
        trace: The trace of the episode.
        agent: The agent.

    Returns:
        [N - 1] for the N steps in which the agent is present, from its second on. Jerk is the difference between the
        accelerations of two successive windows of 0.5 s.
    """
    limits, dt = published_limits(), float(trace.dt)
    present = np.flatnonzero(trace.active[:, agent])
    speed = trace.speed[present, agent].astype(np.float64)
    acceleration = np.diff(speed) / dt
    rate = np.asarray(wrap_angle(np.diff(trace.yaw[present, agent].astype(np.float64)))) / dt
    within: Bool = (acceleration <= limits.acceleration) & (acceleration >= -limits.deceleration)
    within &= np.abs(0.5 * (speed[1:] + speed[:-1]) * rate) <= limits.lateral
    window = max(1, round(JERK_WINDOW / dt))
    if len(speed) > 2 * window:
        change = speed[2 * window :] - 2.0 * speed[window:-window] + speed[: -2 * window]
        within[2 * window - 1 :] &= np.abs(change) / (window * dt) ** 2 <= limits.jerk
    return within


def pool_motions(motions: Sequence[Mapping[str, F64]]) -> dict[str, F64]:
    """Return the values of several motions together, by feature."""
    return {name: np.concatenate([motion[name] for motion in motions] or [np.zeros(0)]) for name in FEATURES}


def reference_data(motions: Sequence[Mapping[str, F64]], **about: object) -> dict[str, object]:
    """Return the content of a reference file.

    Args:
        motions: Features of the motions of ordinary traffic.
        **about: Origin of the motions.
    """
    values: dict[str, object] = {}
    for name, samples in pool_motions(motions).items():
        if FEATURES[name].bins == 2:
            values[name] = {"count": len(samples), "true": int(samples.sum())}
        else:
            shares = (np.arange(QUANTILES) + 0.5) / QUANTILES
            values[name] = np.round(np.quantile(samples, shares), 4).tolist()
    return {"about": {**about, "motions": len(motions)}, "values": values}


def traffic_reference(path: Path = REFERENCE) -> dict[str, F64]:
    """Return the features of ordinary traffic: those of SSAD's population of drivers, unless a file is given.

    Args:
        path: File of `python -m benchmarks.traffic_reference`.

    Returns:
        Feature -> values, as for `realism` and `wasserstein`; of continuous features 500 quantiles.

    Raises:
        FormatError: The file is no reference.
    """
    data = safeio.read_json(path)
    values = data.get("values") if isinstance(data, dict) else None
    if not isinstance(values, dict) or set(values) != set(FEATURES):
        raise FormatError(f"{path}: no reference of traffic; make it with python -m benchmarks.traffic_reference")
    return {
        name: np.asarray(
            np.arange(entry["count"]) < entry["true"] if isinstance(entry, dict) else entry, dtype=np.float64
        )
        for name, entry in values.items()
    }


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
