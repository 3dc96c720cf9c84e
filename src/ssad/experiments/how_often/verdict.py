"""Collision rates by the method with the best estimate, in sentences."""

from __future__ import annotations

import math

from ssad.report.load import Run
from ssad.report.records import Line, metric_of
from ssad.report.verdict import lines_by

METHODS = {"monte-carlo": "plain Monte Carlo", "importance": "importance sampling"}


def verdict(run: Run) -> list[str]:
    """Return how rare collisions are, by the best estimate, and how many of them plain Monte Carlo found."""
    sentences = []
    for system, lines in lines_by(run, "system").items():
        by_scenario: dict[str, list[Line]] = {}
        for line in lines:
            by_scenario.setdefault(str(((line.get("spec") or {}).get("scenario") or {}).get("name", "")), []).append(
                line
            )
        for scenario, scenario_lines in by_scenario.items():
            sentences += _rare(system, scenario, scenario_lines)
    return sentences


def _rare(system: str, scenario: str, rows: list[Line]) -> list[str]:
    """Return the sentences of one driver in one scenario."""

    def limits(row: Line) -> tuple[float, float]:
        return metric_of(row, "low"), metric_of(row, "high")

    with_collisions = [row for row in rows if metric_of(row, "per_million") > 0]
    if not with_collisions:
        largest_row = max(rows, key=lambda row: metric_of(row, "episodes"))
        upper_limit = limits(largest_row)[1]
        interval_text = (
            "" if math.isnan(upper_limit) else f": fewer than {_million(upper_limit)} in a million (95 % limit)"
        )
        return [
            f"{system} did not collide in {metric_of(largest_row, 'episodes'):,.0f} episodes of "
            f"{scenario}{interval_text}."
        ]
    # estimates with an interval first, then by their effective number of collisions
    best_row = max(with_collisions, key=lambda row: (not math.isnan(limits(row)[1]), metric_of(row, "effective")))
    lower, upper = limits(best_row)
    interval_text = (
        "too few repeats for an interval" if math.isnan(upper) else f"95 %: {_million(lower)} to {_million(upper)}"
    )
    sentences = [
        f"{system} collides in about {_million(metric_of(best_row, 'per_million'))} of a million episodes of "
        f"{scenario} ({interval_text}; by {_method(best_row)}), {metric_of(best_row, 'per_hour'):.3g} times in 1,000 h."
    ]
    for row in rows:
        if row is not best_row and row.get("method") == "monte-carlo":
            collisions, episode_count = metric_of(row, "events"), metric_of(row, "episodes")
            sentences.append(
                f"Plain Monte Carlo saw {f'{collisions:.0f}' if collisions else 'none'} in "
                f"{episode_count:,.0f} episodes."
            )
    with_interval = [row for row in rows if not math.isnan(limits(row)[1])]
    for other_row in with_interval:
        if (
            other_row is not best_row
            and best_row in with_interval
            and (limits(other_row)[1] < lower or limits(other_row)[0] > upper)
        ):
            sentences.append(
                f"The interval of {_method(other_row)} does not meet it: take more episodes before you trust either."
            )
    return sentences


def _method(row: Line) -> str:
    return METHODS.get(str(row.get("method")), str(row.get("method")))


def _million(value: float) -> str:
    """Return a number of episodes in a million, to two digits where it is small."""
    return f"{value:,.0f}" if value >= 10 else f"{value:.2g}"
