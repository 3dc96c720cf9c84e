"""Effect of each perturbation on component and system, in sentences."""

from __future__ import annotations

import math

from ssad.experiments.gap import page as gap
from ssad.report.load import Run
from ssad.report.tables import Cell
from ssad.report.verdict import mean_of, metric_of


def verdict(run: Run) -> list[str]:
    """Each perceiving system, and what its perturbations do to component and system: most to the system first."""
    found: list[str] = []
    every = gap.conditions(run)
    systems = list(dict.fromkeys(system for system, *_ in every))
    told: dict[str, list[tuple[float, str]]] = {system: [] for system in systems}
    for system, perturbation, severity in every:
        lines = every[system, perturbation, severity]
        hits = sum(metric_of(line, "collision") == 1.0 for line in lines)
        if not severity:
            part = mean_of(metric_of(line, "AP") for line in lines)
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


def _known(change: Cell) -> bool:
    return change.method not in ("range", "none") and bool(change.interval)


def _sure(change: Cell) -> str:
    """A change with its interval, if there is one."""
    return f"{change.mean:+.2f} {change.interval}" if _known(change) else f"{change.mean:+.2f}"
