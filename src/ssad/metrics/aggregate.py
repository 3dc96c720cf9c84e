"""Aggregation of episodes to the numbers of a table, with explicit denominators.

Every mean is over the episodes that ran, whose number is `Estimate.n`. A failed episode is never dropped silently:
`Estimate.failed` counts it, and the limits of every share and of every bounded value hold whatever it was. A system
all of whose episodes failed has no numbers. Unmeasured values are left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from ssad.metrics.driving import DIVISORS, WEIGHTS, EpisodeMetrics, overall_score
from ssad.metrics.intervals import MIN_ROUTES
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
    """A column of a table: symbol, field of `EpisodeMetrics`, unit and direction of improvement.

    Attributes:
        kind: "share" of episodes where the field is not 0, "bounded" by 0 and `scale`, or "mean".
    """

    symbol: str
    field: str
    unit: str
    better: Literal["lower", "higher", ""]
    kind: Kind
    title: str
    scale: float = 1.0


METRICS: dict[str, Metric] = {
    m.symbol: m
    for m in (
        Metric("CR", "collision", "", "lower", "share", "collision rate"),
        Metric("OR", "off_road", "m", "lower", "mean", "distance driven off the road"),
        Metric("DR", "distance_to_route", "m", "lower", "mean", "distance to the route"),
        Metric("RC", "route_completion", "", "higher", "bounded", "route completion"),
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
        Metric("DS", "driving_score", "", "higher", "bounded", "CARLA driving score", scale=100.0),
        Metric("TTC", "min_ttc", "s", "higher", "bounded", "least time to collision", scale=10.0),
        Metric("PET", "pet", "s", "higher", "bounded", "least post-encroachment time", scale=10.0),
        Metric("MD", "min_distance", "m", "higher", "mean", "least distance to another agent"),
        Metric("OS", "", "", "lower", "mean", "SafeBench overall score"),
    )
}


@dataclass(frozen=True)
class EpisodeOutcome:
    """Result of one episode, with the keys that group it.

    Attributes:
        metrics: None if the episode failed.
        group: Group in tables: the pre-crash scenario, the town.
        cluster: Key that dependent episodes share: their town and route, or their scenario.
        case: Key of the motion; two outcomes of one system with the same case are copies.
        family: A key of `FAMILIES`.
    """

    metrics: EpisodeMetrics | None
    group: str
    cluster: str
    case: str
    family: str = "other"

    @classmethod
    def from_record(cls, line: Mapping[str, Any], trace_hash: str = "") -> EpisodeOutcome:
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


def aggregate(outcomes: Sequence[EpisodeOutcome]) -> dict[str, Estimate]:
    """Return estimates of all metrics of one system, by symbol; the order of the outcomes does not matter.

    Within one group, the estimate is the mean over its distinct episodes; over several groups, the unweighted
    mean of the groups' means. All driving figures in tables, cards, plots and files are these estimates.

    Args:
        outcomes: The episodes of one system.

    Returns:
        Symbol of `METRICS` -> its estimate.
    """
    estimates = {}
    for symbol, metric in METRICS.items():
        if metric.field:
            values = [_value(outcome, metric) for outcome in outcomes]
            estimates[symbol] = estimate(
                values, metric.kind, scale=metric.scale, min_value=0.0, min_clusters=MIN_ROUTES
            )
    return {symbol: estimates.get(symbol) or _overall(outcomes) for symbol in METRICS}


def aggregate_groups(outcomes: Iterable[tuple[str, EpisodeOutcome]]) -> list[GroupRow]:
    """Rows for (system, outcome) pairs: each system's groups as they come, then the averages of their families.

    A family other than the paper's has an average only if it has several groups.
    """
    outcomes_by_system: dict[str, list[EpisodeOutcome]] = {}
    for system, outcome in outcomes:
        outcomes_by_system.setdefault(system, []).append(outcome)
    rows = []
    for system, system_outcomes in outcomes_by_system.items():
        for group in dict.fromkeys(episode.group for episode in system_outcomes):
            rows.append(
                GroupRow(system, group, aggregate([episode for episode in system_outcomes if episode.group == group]))
            )
        for family, name in FAMILIES.items():
            members = [episode for episode in system_outcomes if episode.family == family]
            # The average of a single group would repeat its row.
            if len({episode.group for episode in members}) > (family != "pre-crash"):
                rows.append(GroupRow(system, name, aggregate(members)))
    return rows


def _value(outcome: EpisodeOutcome, metric: Metric) -> CaseValue:
    """Return the value that an episode contributes to a metric."""
    number = None if outcome.metrics is None else getattr(outcome.metrics, metric.field)
    value = math.nan if number is None else float(number)
    if metric.kind == "share" and not math.isnan(value):
        value = float(value > 0.0)
    return CaseValue(value, outcome.cluster, outcome.case, outcome.group, outcome.metrics is None)


def _overall(outcomes: Sequence[EpisodeOutcome]) -> Estimate:
    """Return SafeBench's score of the means, averaged over the groups, with the interval of the unrounded score.

    The score is a weighted sum of means, so an episode has one too: from its collision, distances, incomplete
    route and time. For a failed episode, distances and time are the group's means; whether it collided and how far it
    came is unknown.
    """
    groups: dict[str, list[EpisodeOutcome]] = {}
    for outcome in outcomes:
        groups.setdefault(outcome.group, []).append(outcome)
    scores: list[float] = []
    optimistic: list[CaseValue] = []
    pessimistic: list[CaseValue] = []
    for group, members in groups.items():
        means = {
            name: estimate([_value(outcome, METRICS[name]) for outcome in members], METRICS[name].kind).mean
            for name in ("CR", "OR", "DR", "RC", "TS")
        }
        if any(math.isnan(value) for value in means.values()):
            continue
        scores.append(overall_score(means))
        # The lower limit assumes that failed episodes completed their routes, the upper one that they collided at once.
        for case_values, unknown in ((optimistic, 0.0), (pessimistic, 1.0)):
            for outcome in members:
                terms = dict(means) | {"CR": unknown, "RC": 1.0 - unknown}
                if outcome.metrics is not None:
                    terms = {name: float(getattr(outcome.metrics, METRICS[name].field)) for name in means}
                terms["IR"] = 1.0 - terms["RC"]
                score = math.fsum(WEIGHTS[name] * terms[name] / DIVISORS[name] for name in WEIGHTS)
                case_values.append(CaseValue(score, outcome.cluster, outcome.case, group, outcome.metrics is None))
    failed = estimate([_value(outcome, METRICS["CR"]) for outcome in outcomes], "share").failed
    if not scores:
        return replace(NOTHING, failed=failed)
    mean = math.fsum(scores) / len(scores)
    lower_estimate, upper_estimate = (
        estimate(values, "mean", min_value=0.0, min_clusters=MIN_ROUTES) for values in (optimistic, pessimistic)
    )
    return replace(
        lower_estimate,
        mean=mean,
        low=min(lower_estimate.low, mean),
        high=max(upper_estimate.high, mean),
        n=lower_estimate.n - lower_estimate.failed,
        failed=failed,
    )
