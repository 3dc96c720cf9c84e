"""Collision rates by the method with the best estimate, in sentences; methods that contradict each other come first."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import combinations

from ssad.metrics.intervals import MIN_DIFFERENT
from ssad.report.load import Run
from ssad.report.records import Line, metric_of
from ssad.report.verdict import lines_by
from ssad.world.rare.branching import NO_METHODS

METHODS = {"monte-carlo": "plain Monte Carlo", "importance": "importance sampling"}


def verdict(run: Run) -> list[str]:
    """Return which methods contradict each other, how rare collisions are, and which systems lack methods."""
    sentences = contradictions(run)
    for system, scenario, lines in _cases(run):
        if not _contradictory(lines):
            sentences += _rare(system, scenario, lines)
    return sentences + unbranched(run)


def contradictions(run: Run) -> list[str]:
    """Return a sentence for each system and scenario in which the intervals of two methods exclude each other."""
    sentences = []
    for system, scenario, lines in _cases(run):
        contradictory = _contradictory(lines)
        if contradictory:
            estimates = " and ".join(f"{_rate(line)} by {_method(line)} ({_interval(line)})" for line in contradictory)
            sentences.append(
                f"The methods contradict each other for {system} in {scenario}: {estimates} collisions in a million "
                "episodes. Trust none of them until more episodes bring them together."
            )
    return sentences


def unbranched(run: Run) -> list[str]:
    """Return a sentence for each system that is measured by Monte Carlo alone as its episodes cannot branch."""
    sentences = []
    for system, lines in lines_by(run, "system", failed=True).items():
        obstacle = next((str(line["obstacle"]) for line in lines if line.get("obstacle")), "")
        if obstacle and all(line.get("method") == "monte-carlo" for line in lines):
            gain = (
                "; with these two methods (ssad.core.driving.Branching), splitting and importance sampling would "
                f"measure {system} too, and find collisions that are too rare to be counted"
                if NO_METHODS in obstacle
                else ""
            )
            sentences.append(f"{system} is measured by plain Monte Carlo alone: {obstacle}{gain}.")
    return sentences


def without_interval(run: Run) -> list[str]:
    """Return why estimates by splitting have no limits, in a sentence; none if all have some."""
    if not any(line.get("status") == "ok" and math.isnan(metric_of(line, "high")) for line in run.lines):
        return []
    return [
        f"Limits need {MIN_DIFFERENT} repeats of splitting with unlike estimates: set repeats={MIN_DIFFERENT} or more, "
        "and more particles where repeats end alike."
    ]


def _cases(run: Run) -> Iterator[tuple[str, str, list[Line]]]:
    """Yield the lines of each system in each scenario, without failed ones."""
    for system, lines in lines_by(run, "system").items():
        by_scenario: dict[str, list[Line]] = {}
        for line in lines:
            by_scenario.setdefault(str(((line.get("spec") or {}).get("scenario") or {}).get("name", "")), []).append(
                line
            )
        for scenario, scenario_lines in by_scenario.items():
            yield system, scenario, scenario_lines


def _contradictory(lines: list[Line]) -> list[Line]:
    """Return the lines whose interval excludes that of another one."""
    indices: set[int] = set()
    for (first, first_line), (second, second_line) in combinations(enumerate(lines), 2):
        # A missing limit, NaN, makes both comparisons false.
        if metric_of(first_line, "high") < metric_of(second_line, "low") or metric_of(second_line, "high") < metric_of(
            first_line, "low"
        ):
            indices |= {first, second}
    return [lines[index] for index in sorted(indices)]


def _rare(system: str, scenario: str, rows: list[Line]) -> list[str]:
    """Return the sentences of one driver in one scenario."""
    with_collisions = [row for row in rows if metric_of(row, "per_million") > 0]
    if not with_collisions:
        largest_row = max(rows, key=lambda row: metric_of(row, "episodes"))
        upper_limit = metric_of(largest_row, "high")
        interval_text = (
            "" if math.isnan(upper_limit) else f": fewer than {_million(upper_limit)} in a million (95 % limit)"
        )
        return [
            f"{system} did not collide in {metric_of(largest_row, 'episodes'):,.0f} episodes of "
            f"{scenario}{interval_text}."
        ]
    # estimates with an interval first, then by their effective number of collisions
    best_row = max(
        with_collisions, key=lambda row: (not math.isnan(metric_of(row, "high")), metric_of(row, "effective"))
    )
    sentences = [
        f"{system} collides in about {_rate(best_row)} of a million episodes of "
        f"{scenario} ({_interval(best_row)}; by {_method(best_row)}), {metric_of(best_row, 'per_hour'):.3g} times in "
        "1,000 h."
    ]
    for row in rows:
        if row is not best_row and row.get("method") == "monte-carlo":
            collisions, episode_count = metric_of(row, "events"), metric_of(row, "episodes")
            sentences.append(
                f"Plain Monte Carlo saw {f'{collisions:.0f}' if collisions else 'none'} in "
                f"{episode_count:,.0f} episodes."
            )
    return sentences


def _method(row: Line) -> str:
    return METHODS.get(str(row.get("method")), str(row.get("method")))


def _rate(row: Line) -> str:
    return _million(metric_of(row, "per_million"))


def _interval(row: Line) -> str:
    """Return the 95 % limits, or why there are none."""
    lower, upper = metric_of(row, "low"), metric_of(row, "high")
    return "too few repeats for an interval" if math.isnan(upper) else f"95 %: {_million(lower)} to {_million(upper)}"


def _million(value: float) -> str:
    """Return a number of episodes in a million, to two digits where it is small."""
    return f"{value:,.0f}" if value >= 10 or value == 0.0 else f"{value:.2g}"
