"""What a run has found, in plain words: the sentences that its page begins with."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from ssad.metrics import CaseValue, estimate
from ssad.report.kinds import gap, physical
from ssad.report.load import Run
from ssad.report.tables import Cell

Line = Mapping[str, Any]


def verdict(run: Run) -> list[str]:
    """What a part has found, in plain words, from its records."""
    say = VERDICTS.get(run.kind)
    sentences = [] if say is None else say(run)
    if len(run.lines) < run.planned:
        sentences = [f"Not finished: {len(run.lines)} of {run.planned} cells have run.", *sentences]
    return [sentence for sentence in sentences if sentence] or ["See the table."]


def _driving(run: Run) -> list[str]:
    """Collisions and routes of each system; drives that failed count, as in the tables."""
    found = []
    for system, lines in _by(run, "system", failed=True).items():
        hits = sum(_metric(line, "collision") == 1.0 for line in lines)
        done = _mean(_metric(line, "route_completion") for line in lines)
        routes = "" if math.isnan(done) else f" and completed {done:.0%} of its routes"
        found.append(f"{system} collided in {hits} of {len(lines)} drives{routes}.")
    return found


def _detection(run: Run) -> list[str]:
    """The mAP clean and under the shift that costs most."""
    found = []
    for detector, lines in _by(run, "detector").items():
        scores: dict[str, list[float]] = {}
        for line in lines:
            scores.setdefault(str(line.get("shift") or ""), []).append(_metric(line, "mAP"))
        found.append(_worst(detector, "mAP", {name: _mean(v) for name, v in scores.items()}, "shift"))
    return found


def _digital(run: Run) -> list[str]:
    """The mAP clean, under the strongest attack and under noise of the same size, by the rows of the main table.

    Points of curves, of other budgets and on fewer scenes, and pictures made against others, are not compared.
    """
    found = []
    for detector, every in _by(run, "detector").items():
        lines = [line for line in every if line.get("row", True) and not line.get("subset") and not line.get("defence")]
        clean = [_metric(line, "mAP") for line in lines if (line.get("attack") or "clean") == "clean"]
        attacks = [line for line in lines if (line.get("attack") or "clean") not in ("clean", "noise")]
        attacks = [line for line in attacks if not math.isnan(_metric(line, "mAP"))]
        if not clean or not attacks:
            continue
        best = min(attacks, key=lambda line: _metric(line, "mAP"))
        lowest, name = _metric(best, "mAP"), " on ".join(filter(None, map(best.get, ("attack", "loss"))))
        found.append(_worst(detector, "mAP", {"": clean[0], name: lowest}, "attack"))
        size = [best.get(key) for key in ("norm", "radius")]
        alike = [
            line
            for line in lines
            if line.get("attack") == "noise" and [line.get(k) for k in ("norm", "radius")] == size
        ]
        noise = min((_metric(line, "mAP") for line in alike), default=math.nan)
        if found[-1] and not math.isnan(noise):
            told = "what lies between is the attack's" if lowest < noise else "the attack does no more than that"
            found.append(f"Random noise of the same size leaves {detector} an mAP of {noise:.0%}: {told}.")
    return found


def _physical(run: Run) -> list[str]:
    """Share of the targets that the best attack hides as they drive, and the best control of its carrier there."""
    found = []
    for detector, every in _by(run, "detector").items():
        lines = [line for line in every if line.get("view", "drive") == "drive" and not math.isnan(_hidden(line))]
        attacks = [line for line in lines if not physical.is_control(line["attack"])]
        if not attacks:
            continue
        best = max(attacks, key=_hidden)
        town = f" in {best['test']}" if len({line["test"] for line in lines}) > 1 else ""
        found.append(f"{best['attack']} hides {_hidden(best):.0%} of the targets from {detector}{town}.")
        alike = [
            line
            for line in lines
            if all(line[key] == best[key] for key in ("test", "carrier"))
            and physical.learns_nothing(line["attack"], best["attack"])
        ]
        if alike:
            control = max(alike, key=_hidden)
            found.append(f"The strongest control ({control['attack']}) hides {_hidden(control):.0%}.")
    return found


def _hidden(line: Line) -> float:
    return _metric(line, "ASR_25")


def _adversarial(run: Run) -> list[str]:
    """Collisions that generators find, a sentence a system; of many generators the best three and random search.

    Searches that failed count, as in the tables.
    """
    found = []
    for system, lines in _by(run, "system", failed=True).items():
        counts: dict[str, tuple[int, int, int]] = {}
        for generator in dict.fromkeys(str(line.get("generator") or "") for line in lines):
            own = [line for line in lines if line.get("generator") == generator]
            alive = sum(_metric(line, "survived") == 1.0 for line in own)
            if alive:
                failed = sum(line["status"] != "ok" for line in own)
                counts[generator] = sum(_metric(line, "CR") == 1.0 for line in own), alive + failed, failed
        if not counts:
            if any(line["status"] == "ok" for line in lines):
                found.append(f"{system} survives none of its scenarios unchanged: there is nothing to find.")
            continue
        best = sorted(counts, key=lambda name: -counts[name][0] / counts[name][1])
        shown = list(counts) if len(best) <= 4 else [*best[:3], *(["random"] if "random" in best[3:] else [])]
        said = ", ".join(_found_in(name, *counts[name]) for name in shown)
        more = f" (the best three of {len(best)}{', and random search' * (len(shown) > 3)})" if len(best) > 4 else ""
        what = f"{system} is made to collide" if counts[best[0]][0] else f"No generator makes {system} collide"
        found.append(f"{what} in scenarios that it survives unchanged: {said}{more}.")
    return found


def _found_in(generator: str, hits: int, tried: int, failed: int) -> str:
    return f"{generator} in {hits} of {tried}{f' ({failed} failed)' if failed else ''}"


def _gap(run: Run) -> list[str]:
    """Each perceiving system, and what its perturbations do to component and system: most to the system first."""
    found: list[str] = []
    every = gap.conditions(run)
    systems = list(dict.fromkeys(system for system, *_ in every))
    told: dict[str, list[tuple[float, str]]] = {system: [] for system in systems}
    for system, perturbation, severity in every:
        lines = every[system, perturbation, severity]
        hits = sum(_metric(line, "collision") == 1.0 for line in lines)
        if not severity:
            part = _mean(_metric(line, "AP") for line in lines)
            sees = "" if math.isnan(part) else f" It found objects with an AP of {part:.2f} on the way."
            told[system].append((math.inf, f"{system} collided in {hits} of {len(lines)} drives.{sees}"))
            continue
        fall, rise = (gap.change(run, (system, perturbation, severity), name) for name in ("AP", "collision"))
        if not math.isnan(fall.mean) and not math.isnan(rise.mean):
            few = "" if _known(fall) or _known(rise) else ", too few for intervals"
            said = f"{perturbation} {severity} changes the AP of {system} by {_sure(fall)} and its collision rate by "
            told[system].append((abs(rise.mean), f"{said}{_sure(rise)}, in {rise.n} drives{few}."))
    for system in systems:
        found += [sentence for _, sentence in sorted(told[system], key=lambda one: -one[0])]
    return found


METHODS = {"monte-carlo": "plain Monte Carlo", "importance": "importance sampling"}


def _how_often(run: Run) -> list[str]:
    """How rare collisions are, by the method that knows best, and what plain Monte Carlo saw of them."""
    found = []
    for system, lines in _by(run, "system").items():
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
        return _metric(row, "low"), _metric(row, "high")

    seen = [row for row in rows if _metric(row, "per_million") > 0]
    if not seen:
        most = max(rows, key=lambda row: _metric(row, "episodes"))
        top = limits(most)[1]
        sure = "" if math.isnan(top) else f": fewer than {_million(top)} in a million (95 % limit)"
        return [f"{system} did not collide in {_metric(most, 'episodes'):,.0f} episodes of {scenario}{sure}."]
    # with an interval if there is one, then by how many collisions the estimate is worth
    best = max(seen, key=lambda row: (not math.isnan(limits(row)[1]), _metric(row, "effective")))
    low, high = limits(best)
    sure = "too few repeats for an interval" if math.isnan(high) else f"95 %: {_million(low)} to {_million(high)}"
    said = [
        f"{system} collides in about {_million(_metric(best, 'per_million'))} of a million episodes of {scenario} "
        f"({sure}; by {_method(best)}), {_metric(best, 'per_hour'):.3g} times in 1,000 h."
    ]
    for row in rows:
        if row is not best and row.get("method") == "monte-carlo":
            hits, tried = _metric(row, "events"), _metric(row, "episodes")
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


def _known(change: Cell) -> bool:
    return change.method not in ("range", "none") and bool(change.interval)


def _sure(change: Cell) -> str:
    """A change with its interval, if there is one."""
    return f"{change.mean:+.2f} {change.interval}" if _known(change) else f"{change.mean:+.2f}"


VERDICTS: dict[str, Callable[[Run], list[str]]] = {
    "driving": _driving,
    "detection": _detection,
    "digital": _digital,
    "physical": _physical,
    "adversarial": _adversarial,
    "gap": _gap,
    "how-often": _how_often,
}
"""Kind of a part -> what says its verdict."""


def _worst(who: str, metric: str, scores: Mapping[str, float], what: str) -> str:
    """Clean ("") beside the lowest of the others."""
    others = {name: value for name, value in scores.items() if name and name != "clean" and not math.isnan(value)}
    clean = scores.get("", scores.get("clean", math.nan))
    if not others or math.isnan(clean):
        return ""
    name = min(others, key=lambda one: others[one])
    if others[name] >= clean:
        return f"{who}: {metric} {clean:.0%} clean; no {what} takes any of it."
    return f"{who}: {metric} {clean:.0%} clean; the {what} that costs most is {name}, which leaves {others[name]:.0%}."


def _by(run: Run, field: str, *, failed: bool = False) -> dict[str, list[Line]]:
    found: dict[str, list[Line]] = {}
    for line in run.lines:
        if line["status"] == "ok" or failed:
            found.setdefault(str(line.get(field) or ""), []).append(line)
    return found


def _metric(line: Line, name: str) -> float:
    value = (line.get("metrics") or {}).get(name)
    return math.nan if value is None else float(value)


def _mean(values: Any) -> float:
    known = [CaseValue(value, str(k), str(k)) for k, value in enumerate(values) if not math.isnan(value)]
    return estimate(known, "mean").mean if known else math.nan
