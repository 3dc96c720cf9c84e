"""From episodes to the numbers of a table, with the denominator always in sight.

A failed episode (None) is never dropped in silence: it counts in the denominator of every proportion as "not known"
(the mean takes it as no event, the upper limit of the interval as an event), its route completion and driving score
are 0, and every other mean is over the episodes that ran, whose number is `Estimate.n`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ssad.core.types import F64
from ssad.metrics.driving import DIVISORS, WEIGHTS, EpisodeMetrics, overall_score
from ssad.metrics.uncertainty import (
    Estimate,
    mean_estimate,
    mean_of_estimates,
    percentile_interval,
    resample_counts,
    wilson,
)

AVERAGE = "Avg."


@dataclass(frozen=True)
class Metric:
    """A column of a table: its symbol, the field of `EpisodeMetrics` behind it, its unit and which way is better.

    kind: `share` of episodes where the field is not 0, `mean` over the episodes that ran, or `mean0`, where a failed
    episode counts as 0.
    """

    symbol: str
    field: str
    unit: str
    better: Literal["lower", "higher", ""]
    kind: Literal["share", "mean", "mean0"]
    title: str


METRICS: dict[str, Metric] = {
    m.symbol: m
    for m in (
        Metric("CR", "collision", "", "lower", "share", "collision rate"),
        Metric("OR", "off_road", "m", "lower", "mean", "distance driven off the road"),
        Metric("DR", "distance_to_route", "m", "lower", "mean", "distance to the route"),
        Metric("RC", "route_completion", "", "higher", "mean0", "route completion"),
        Metric("TS", "time", "s", "lower", "mean", "time spent"),
        Metric("RR", "red_lights", "", "lower", "mean", "red lights run"),
        Metric("SS", "stop_signs", "", "lower", "mean", "stop signs run"),
        Metric("RF", "route_following", "", "higher", "mean", "route following"),
        Metric("ACC", "acceleration", "m/s^2", "lower", "mean", "acceleration"),
        Metric("YV", "yaw_velocity", "rad/s", "lower", "mean", "yaw velocity"),
        Metric("LI", "lane_invasions", "", "lower", "mean", "lane invasions"),
        Metric("CE", "collision_events", "", "lower", "mean", "collision events an episode (FREA)"),
        Metric("CR_vehicle", "collisions_vehicle", "", "lower", "share", "episodes that hit a vehicle"),
        Metric("CR_walker", "collisions_walker", "", "lower", "share", "episodes that hit a walker"),
        Metric("CR_cyclist", "collisions_cyclist", "", "lower", "share", "episodes that hit a cyclist"),
        Metric("CR_static", "collisions_static", "", "lower", "share", "episodes that hit something else"),
        Metric("IF", "in_route_failure", "", "lower", "share", "episodes that left the route"),
        Metric("DS", "driving_score", "", "higher", "mean0", "CARLA driving score"),
        Metric("TTC", "min_ttc", "s", "higher", "mean", "least time to collision"),
        Metric("PET", "pet", "s", "higher", "mean", "least post-encroachment time"),
        Metric("MD", "min_distance", "m", "higher", "mean", "least distance to another agent"),
        Metric("OS", "", "", "lower", "mean", "SafeBench overall score"),
    )
}


@dataclass(frozen=True)
class GroupRow:
    """One system in one group of scenarios (`Avg.`: the mean of its groups' values)."""

    system: str
    group: str
    values: dict[str, Estimate]


def aggregate(episodes: Sequence[EpisodeMetrics | None]) -> dict[str, Estimate]:
    """symbol of `METRICS` -> Estimate over the episodes; None is a failed episode. The order does not matter."""
    ran = [e for e in episodes if e is not None]
    failed = len(episodes) - len(ran)
    result = {symbol: _estimate(metric, ran, failed) for symbol, metric in METRICS.items() if metric.field}
    result["OS"] = _overall(ran, failed, {name: result[name].mean for name in ("CR", "OR", "DR", "RC", "TS")})
    return result


def aggregate_groups(episodes: Iterable[tuple[str, str, EpisodeMetrics | None]]) -> list[GroupRow]:
    """Rows for (system, group, episode) triples: each system's groups as they come, then their average."""
    found: dict[str, dict[str, list[EpisodeMetrics | None]]] = {}
    for system, group, episode in episodes:
        found.setdefault(system, {}).setdefault(group, []).append(episode)
    rows = []
    for system, groups in found.items():
        own = [GroupRow(system, group, aggregate(members)) for group, members in groups.items()]
        average = {symbol: mean_of_estimates([row.values[symbol] for row in own]) for symbol in METRICS}
        rows += [*own, GroupRow(system, AVERAGE, average)]
    return rows


def _estimate(metric: Metric, ran: Sequence[EpisodeMetrics], failed: int) -> Estimate:
    values = [float(getattr(e, metric.field)) for e in ran]
    if metric.kind == "share":
        return wilson(sum(v > 0.0 for v in values), len(ran) + failed, failed=failed)
    if metric.kind == "mean0":
        values += [0.0] * failed
    return mean_estimate(values, failed=failed)


def _overall(ran: Sequence[EpisodeMetrics], failed: int, means: dict[str, float]) -> Estimate:
    """SafeBench's score of the means; its interval resamples whole episodes and rounds nothing."""
    n = len(ran) + failed
    if any(math.isnan(value) for value in means.values()):
        return Estimate(math.nan, math.nan, math.nan, n, failed)
    score = overall_score(means)
    if n < 2:
        return Estimate(score, math.nan, math.nan, n, failed)
    rows = [(float(e.collision), e.off_road, e.distance_to_route, 1.0 - e.route_completion, e.time) for e in ran]
    table: F64 = np.array(sorted(rows) + [(0.0, math.nan, math.nan, 1.0, math.nan)] * failed)
    known = ~np.isnan(table)
    counts = resample_counts(n)
    weight = counts @ known.astype(np.float64)
    # a resample of failed episodes alone has no mean of some terms and is left out
    usable = (weight > 0.0).all(axis=1)
    mean = (counts @ np.where(known, table, 0.0))[usable] / weight[usable]
    scale = np.array([WEIGHTS[name] / DIVISORS[name] for name in ("CR", "OR", "DR", "IR", "TS")])
    low, high = percentile_interval(mean @ scale)
    return Estimate(score, min(low, score), max(high, score), n, failed, "percentile")
