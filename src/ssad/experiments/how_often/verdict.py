"""Collision rates by the method with the best estimate, in sentences."""

from __future__ import annotations

import math

from ssad.report.load import Run
from ssad.report.verdict import Line, lines_by, metric_of

METHODS = {"monte-carlo": "plain Monte Carlo", "importance": "importance sampling"}


def verdict(run: Run) -> list[str]:
    """How rare collisions are, by the method that knows best, and what plain Monte Carlo saw of them."""
    found = []
    for system, lines in lines_by(run, "system").items():
        by_scenario: dict[str, list[Line]] = {}
        for line in lines:
            by_scenario.setdefault(str(((line.get("spec") or {}).get("scenario") or {}).get("name", "")), []).append(
                line
            )
        for scenario, rows in by_scenario.items():
            found += _rare(system, scenario, rows)
    return found


def _rare(system: str, scenario: str, rows: list[Line]) -> list[str]:
    """The sentences of one driver in one scenario."""

    def limits(row: Line) -> tuple[float, float]:
        return metric_of(row, "low"), metric_of(row, "high")

    seen = [row for row in rows if metric_of(row, "per_million") > 0]
    if not seen:
        most = max(rows, key=lambda row: metric_of(row, "episodes"))
        top = limits(most)[1]
        sure = "" if math.isnan(top) else f": fewer than {_million(top)} in a million (95 % limit)"
        return [f"{system} did not collide in {metric_of(most, 'episodes'):,.0f} episodes of {scenario}{sure}."]
    # with an interval if there is one, then by how many collisions the estimate is worth
    best = max(seen, key=lambda row: (not math.isnan(limits(row)[1]), metric_of(row, "effective")))
    low, high = limits(best)
    sure = "too few repeats for an interval" if math.isnan(high) else f"95 %: {_million(low)} to {_million(high)}"
    said = [
        f"{system} collides in about {_million(metric_of(best, 'per_million'))} of a million episodes of {scenario} "
        f"({sure}; by {_method(best)}), {metric_of(best, 'per_hour'):.3g} times in 1,000 h."
    ]
    for row in rows:
        if row is not best and row.get("method") == "monte-carlo":
            hits, tried = metric_of(row, "events"), metric_of(row, "episodes")
            said.append(f"Plain Monte Carlo saw {f'{hits:.0f}' if hits else 'none'} in {tried:,.0f} episodes.")
    known = [row for row in rows if not math.isnan(limits(row)[1])]
    for other in known:
        if other is not best and best in known and (limits(other)[1] < low or limits(other)[0] > high):
            said.append(
                f"The interval of {_method(other)} does not meet it: take more episodes before you trust either."
            )
    return said


def _method(row: Line) -> str:
    return METHODS.get(str(row.get("method")), str(row.get("method")))


def _million(value: float) -> str:
    """A number of episodes in a million, to two digits where it is small."""
    return f"{value:,.0f}" if value >= 10 else f"{value:.2g}"
