"""From episodes to the numbers of a table, with the denominator always in sight.

A failed episode is never dropped in silence: it counts in the denominator of every proportion as "not known" (the mean
takes it as no event, the upper limit of the interval as an event), its route completion and driving score are 0, and
every other mean is over the episodes that ran, whose number is `Estimate.n`. What was not measured is left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from ssad.metrics.driving import DIVISORS, WEIGHTS, EpisodeMetrics, overall_score
from ssad.metrics.uncertainty import NOTHING, CaseValue, Estimate, Kind, estimate

PRECRASH_GROUPS = (
    "StraightObstacle",
    "TurningObstacle",
    "LaneChanging",
    "VehiclePassing",
    "RedlightRunning",
    "UnprotectedLeftTurn",
    "RightTurn",
    "CrossingNegotiation",
)
"""The eight scenarios of the paper's table of pre-crash scenarios, whose mean is its column Avg."""

FAMILIES = {"pre-crash": "Avg.", "natural": "Avg. natural", "other": "Avg. other"}
"""Families of groups, each with the name of its average: the unweighted mean of the family's groups."""


@dataclass(frozen=True)
class Metric:
    """A column of a table: its symbol, the field of `EpisodeMetrics` behind it, its unit and which way is better.

    Attributes:
        kind: "share" of episodes where the field is not 0, "bounded" by 0 and `scale`, or "mean".
        failed: what a failed episode counts as; NaN: not at all, or as unknown in a share.
    """

    symbol: str
    field: str
    unit: str
    better: Literal["lower", "higher", ""]
    kind: Kind
    title: str
    scale: float = 1.0
    failed: float = math.nan


METRICS: dict[str, Metric] = {
    m.symbol: m
    for m in (
        Metric("CR", "collision", "", "lower", "share", "collision rate"),
        Metric("OR", "off_road", "m", "lower", "mean", "distance driven off the road"),
        Metric("DR", "distance_to_route", "m", "lower", "mean", "distance to the route"),
        Metric("RC", "route_completion", "", "higher", "bounded", "route completion", failed=0.0),
        Metric("TS", "time", "s", "lower", "mean", "time spent"),
        Metric("RR", "red_lights", "", "lower", "mean", "red lights run"),
        Metric("SS", "stop_signs", "", "lower", "mean", "stop signs run"),
        Metric("RF", "route_following", "", "higher", "bounded", "route following"),
        Metric("ACC", "acceleration", "m/s^2", "lower", "mean", "acceleration"),
        Metric("YV", "yaw_velocity", "rad/s", "lower", "mean", "yaw velocity"),
        Metric("LI", "lane_invasions", "", "lower", "mean", "lane invasions"),
        Metric("LC", "lane_crossings", "", "lower", "mean", "lane markings crossed, by CARLA's own sensor"),
        Metric("CE", "collision_events", "", "lower", "mean", "collision events an episode (FREA)"),
        Metric("IS", "impact_speed", "m/s", "lower", "mean", "impact speed of collisions"),
        Metric("AV_cc", "avoided_by_cc", "", "", "bounded", "collisions that the human of UN R157 avoids"),
        Metric("AV_157", "avoided_by_reg157", "", "", "bounded", "collisions that UN R157, 5.2.5.2 avoids"),
        Metric("AV_rss", "avoided_by_rss", "", "", "bounded", "collisions that RSS avoids"),
        Metric("AV_fsm", "avoided_by_fsm", "", "", "bounded", "collisions that the FSM avoids"),
        Metric("AV_max", "avoided_by_limit", "", "", "bounded", "collisions that anybody could have avoided"),
        Metric("CR_vehicle", "collisions_vehicle", "", "lower", "share", "episodes that hit a vehicle"),
        Metric("CR_walker", "collisions_walker", "", "lower", "share", "episodes that hit a walker"),
        Metric("CR_cyclist", "collisions_cyclist", "", "lower", "share", "episodes that hit a cyclist"),
        Metric("CR_static", "collisions_static", "", "lower", "share", "episodes that hit something else"),
        Metric("IF", "in_route_failure", "", "lower", "share", "episodes that left the route"),
        Metric("DS", "driving_score", "", "higher", "bounded", "CARLA driving score", scale=100.0, failed=0.0),
        Metric("TTC", "min_ttc", "s", "higher", "bounded", "least time to collision", scale=10.0),
        Metric("PET", "pet", "s", "higher", "bounded", "least post-encroachment time", scale=10.0),
        Metric("MD", "min_distance", "m", "higher", "mean", "least distance to another agent"),
        Metric("OS", "", "", "lower", "mean", "SafeBench overall score"),
    )
}


@dataclass(frozen=True)
class Outcome:
    """What one episode gave, and what tells it from others.

    Attributes:
        metrics: None if the episode failed.
        group: what it is shown under: the pre-crash scenario, the town.
        cluster: what episodes share: the scenario or route.
        case: names the motion; two outcomes of one system with the same case are copies.
        family: a key of `FAMILIES`.
    """

    metrics: EpisodeMetrics | None
    group: str
    cluster: str
    case: str
    family: str = "other"

    @classmethod
    def from_record(cls, line: Mapping[str, Any], trace_hash: str = "") -> Outcome:
        """From a line of results.jsonl; `trace_hash` stands in for the case where the line names none.

        Runs from before lines named their case wrote 0 stop signs without a world that has any: not measured.
        """
        scenario = line["spec"]["scenario"]
        metrics = EpisodeMetrics.from_dict(line["metrics"]) if line["status"] == "ok" else None
        if metrics is not None and "case" not in line:
            metrics = replace(metrics, stop_signs=None)
        group = str(line["group"])
        natural = "natural" if scenario.get("type") == "NaturalJunction" else "other"
        return cls(
            metrics,
            group,
            str(line.get("cluster") or scenario["name"]),
            str(line.get("case") or trace_hash or line["key"]),
            "pre-crash" if group in PRECRASH_GROUPS else natural,
        )


@dataclass(frozen=True)
class GroupRow:
    """One system in one group of scenarios, or the average of the groups of a family."""

    system: str
    group: str
    values: dict[str, Estimate]


def aggregate(outcomes: Sequence[Outcome]) -> dict[str, Estimate]:
    """Estimates of all metrics of one system, by their symbols in `METRICS`; the order of the outcomes does not matter.

    Within one group, the estimate is the mean over its distinct episodes; over several groups, it is the unweighted
    mean of the groups' means. All driving figures come from here: tables, cards, figures and files show these
    estimates.

    Args:
        outcomes: The episodes of one system.

    Returns:
        Symbol of `METRICS` -> its estimate.
    """
    result = {}
    for symbol, metric in METRICS.items():
        if metric.field:
            values = [_value(o, metric) for o in outcomes]
            result[symbol] = estimate(values, metric.kind, scale=metric.scale, least=0.0)
    return {symbol: result.get(symbol) or _overall(outcomes) for symbol in METRICS}


def aggregate_groups(outcomes: Iterable[tuple[str, Outcome]]) -> list[GroupRow]:
    """Rows for (system, outcome) pairs: each system's groups as they come, then the averages of their families.

    A family other than the paper's has an average only if it has several groups.
    """
    found: dict[str, list[Outcome]] = {}
    for system, outcome in outcomes:
        found.setdefault(system, []).append(outcome)
    rows = []
    for system, own in found.items():
        for group in dict.fromkeys(o.group for o in own):
            rows.append(GroupRow(system, group, aggregate([o for o in own if o.group == group])))
        for family, name in FAMILIES.items():
            members = [o for o in own if o.family == family]
            if len({o.group for o in members}) > (family != "pre-crash"):
                rows.append(GroupRow(system, name, aggregate(members)))
    return rows


def _value(outcome: Outcome, metric: Metric) -> CaseValue:
    """What an episode gives to a metric."""
    number = None if outcome.metrics is None else getattr(outcome.metrics, metric.field)
    if outcome.metrics is None:
        number = metric.failed
    value = math.nan if number is None else float(number)
    if metric.kind == "share" and not math.isnan(value):
        value = float(value > 0.0)
    return CaseValue(value, outcome.cluster, outcome.case, outcome.group, outcome.metrics is None)


def _overall(outcomes: Sequence[Outcome]) -> Estimate:
    """SafeBench's score of the means, averaged over the groups; the interval is that of the unrounded score.

    The score is a weighted sum of means, so an episode has one too: its collision, distances, incomplete route and
    time. Of a failed episode the distances and the time are taken as the group's mean; whether it collided is unknown.
    """
    groups: dict[str, list[Outcome]] = {}
    for o in outcomes:
        groups.setdefault(o.group, []).append(o)
    scores: list[float] = []
    least: list[CaseValue] = []
    most: list[CaseValue] = []
    for group, members in groups.items():
        means = {
            name: estimate([_value(o, METRICS[name]) for o in members], METRICS[name].kind).mean
            for name in ("CR", "OR", "DR", "RC", "TS")
        }
        if any(math.isnan(value) for value in means.values()):
            continue
        scores.append(overall_score(means))
        for into, unknown in ((least, 0.0), (most, 1.0)):
            for o in members:
                own = dict(means) | {"CR": unknown, "RC": 0.0}
                if o.metrics is not None:
                    own = {name: float(getattr(o.metrics, METRICS[name].field)) for name in means}
                own["IR"] = 1.0 - own["RC"]
                score = math.fsum(WEIGHTS[name] * own[name] / DIVISORS[name] for name in WEIGHTS)
                into.append(CaseValue(score, o.cluster, o.case, group, o.metrics is None))
    if not scores:
        return replace(NOTHING, failed=sum(o.metrics is None for o in outcomes))
    mean = math.fsum(scores) / len(scores)
    first, second = estimate(least, "mean", least=0.0), estimate(most, "mean")
    return replace(first, mean=mean, low=min(first.low, mean), high=max(second.high, mean))
