"""Effect of each perturbation on component and system, in sentences."""

from __future__ import annotations

import math

from ssad.experiments.gap import page as gap
from ssad.report.load import Run
from ssad.report.records import metric_of
from ssad.report.tables import TableCell
from ssad.report.verdict import event_sentence, mean_of


def verdict(run: Run) -> list[str]:
    """Return the effect of each perturbation on component and system, the largest effect on the system first."""
    sentences: list[str] = []
    lines_by_condition = gap.conditions(run)
    systems = list(dict.fromkeys(system for system, *_ in lines_by_condition))
    sentences_by_system: dict[str, list[tuple[float, str]]] = {system: [] for system in systems}
    for system, perturbation, severity in lines_by_condition:
        lines = lines_by_condition[system, perturbation, severity]
        if not severity:
            precision = mean_of(metric_of(line, "AP") for line in lines)
            precision_text = (
                "" if math.isnan(precision) else f" It found objects with an AP of {precision:.2f} on the way."
            )
            sentences_by_system[system].append(
                (
                    math.inf,
                    event_sentence(system, "collided in", lines, "collision", rate="collision rate", noun="drives")
                    + f".{precision_text}",
                )
            )
            continue
        ap_change, collision_change = (
            gap.change(run, (system, perturbation, severity), name) for name in ("AP", "collision")
        )
        if not math.isnan(ap_change.mean) and not math.isnan(collision_change.mean):
            remark = "" if _has_interval(ap_change) or _has_interval(collision_change) else ", too few for intervals"
            drives = "drive" if collision_change.n == 1 else "drives"
            change_text = (
                f"{perturbation} {severity} changes the AP of {system} by {_interval_text(ap_change)} and its "
                "collision rate by "
            )
            sentences_by_system[system].append(
                (
                    abs(collision_change.mean),
                    f"{change_text}{_interval_text(collision_change)}, in {collision_change.n} {drives}{remark}.",
                )
            )
    for system in systems:
        sentences += [sentence for _, sentence in sorted(sentences_by_system[system], key=lambda ranked: -ranked[0])]
    return sentences


def _has_interval(change: TableCell) -> bool:
    return change.method not in ("range", "none") and bool(change.interval)


def _interval_text(change: TableCell) -> str:
    """Return a change with its interval, if there is one."""
    return f"{change.mean:+.2f} {change.interval}" if _has_interval(change) else f"{change.mean:+.2f}"
