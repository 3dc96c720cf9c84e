"""What a run has found, in plain words: the sentences that its page begins with."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from ssad.metrics import CaseValue, estimate
from ssad.report.kinds import gap
from ssad.report.load import Run
from ssad.report.tables import Cell

Line = Mapping[str, Any]


def verdict(run: Run) -> list[str]:
    """What a part has found, in plain words, from its records."""
    say = VERDICTS.get(run.kind)
    sentences = [] if say is None else say(run)
    return [sentence for sentence in sentences if sentence] or ["See the table."]


def _driving(run: Run) -> list[str]:
    """Collisions and routes of each system."""
    found = []
    for system, lines in _by(run, "system").items():
        hit = [bool(_metric(line, "collision")) for line in lines]
        done = _mean(_metric(line, "route_completion") for line in lines)
        found.append(f"{system} collided in {sum(hit)} of {len(hit)} drives and completed {done:.0%} of its routes.")
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
    """The mAP clean, under the strongest attack and under noise of the same size."""
    found = []
    for detector, lines in _by(run, "detector").items():
        scores = {str(line.get("attack") or ""): _metric(line, "mAP") for line in lines}
        noise = scores.pop("noise", math.nan)
        found.append(_worst(detector, "mAP", scores, "attack"))
        if not math.isnan(noise):
            found.append(
                f"Random noise of the same size leaves {detector} an mAP of {noise:.0%}: what was lost is the attack's."
            )
    return found


def _physical(run: Run) -> list[str]:
    """Share of the targets that the best attack and the best control hide."""
    found = []
    for detector, lines in _by(run, "detector").items():
        best: dict[bool, tuple[float, str]] = {}
        for line in lines:
            score, name = _metric(line, "ASR_25"), str(line.get("attack") or "")
            control = name in ("random", "grey") or "shuffled" in name
            if name and not math.isnan(score) and score >= best.get(control, (-1.0, ""))[0]:
                best[control] = score, name
        if False in best:
            found.append(f"{best[False][1]} hides {best[False][0]:.0%} of the cars from {detector}.")
        if True in best:
            found.append(f"The strongest control ({best[True][1]}) hides {best[True][0]:.0%}.")
    return found


def _adversarial(run: Run) -> list[str]:
    """Collisions that each generator finds."""
    found = []
    for generator, lines in _by(run, "generator").items():
        alive = [line for line in lines if _metric(line, "survived") == 1.0]
        hit = sum(_metric(line, "CR") == 1.0 for line in alive)
        found.append(
            f"{generator} makes the system collide in {hit} of {len(alive)} scenarios that it survives unchanged."
        )
    return found


def _gap(run: Run) -> list[str]:
    """Each perceiving system beside its ceiling, and what its perturbations do to component and system."""
    found = []
    every = gap.conditions(run)
    for system, perturbation, severity in every:
        lines = every[system, perturbation, severity]
        rate = _mean(_metric(line, "collision") for line in lines)
        if not severity:
            part = _mean(_metric(line, "AP") for line in lines)
            sees = "" if math.isnan(part) else f" It found objects with an AP of {part:.2f} on the way."
            found.append(f"{system} collided in {rate:.0%} of {len(lines)} drives.{sees}")
            continue
        fall, rise = (gap.change(run, (system, perturbation, severity), name) for name in ("AP", "collision"))
        if not math.isnan(fall.mean) and not math.isnan(rise.mean):
            found.append(
                f"{perturbation} {severity} changes the AP of {system} by {_sure(fall)} and its collision rate by "
                f"{_sure(rise)}, in {rise.n} drives."
            )
    return found


def _sure(change: Cell) -> str:
    """A change with its interval; where there is none, it says so."""
    known = change.method not in ("range", "none") and change.interval
    return f"{change.mean:+.2f} ({change.interval if known else 'too few drives for an interval'})"


VERDICTS: dict[str, Callable[[Run], list[str]]] = {
    "driving": _driving, "detection": _detection, "digital": _digital, "physical": _physical,
    "adversarial": _adversarial, "gap": _gap,
}  # fmt: skip
"""Kind of a part -> what says its verdict."""


def _worst(who: str, metric: str, scores: Mapping[str, float], what: str) -> str:
    """Clean ("") beside the lowest of the others."""
    others = {name: value for name, value in scores.items() if name and name != "clean" and not math.isnan(value)}
    clean = scores.get("", scores.get("clean", math.nan))
    if not others or math.isnan(clean):
        return ""
    name = min(others, key=lambda one: others[one])
    return f"{who}: {metric} {clean:.0%} clean; the {what} that costs most is {name}, which leaves {others[name]:.0%}."


def _by(run: Run, field: str) -> dict[str, list[Line]]:
    found: dict[str, list[Line]] = {}
    for line in run.lines:
        if line["status"] == "ok":
            found.setdefault(str(line.get(field) or ""), []).append(line)
    return found


def _metric(line: Line, name: str) -> float:
    value = (line.get("metrics") or {}).get(name)
    return math.nan if value is None else float(value)


def _mean(values: Any) -> float:
    known = [CaseValue(value, str(k), str(k)) for k, value in enumerate(values) if not math.isnan(value)]
    return estimate(known, "mean").mean if known else math.nan
