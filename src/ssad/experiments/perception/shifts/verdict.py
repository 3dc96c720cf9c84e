"""Clean accuracy and the shift that costs most, in sentences."""

from __future__ import annotations

from ssad.report.load import Run
from ssad.report.records import metric_of
from ssad.report.verdict import lines_by, mean_of, worst_condition


def verdict(run: Run) -> list[str]:
    """Return the mAP clean and under the shift that costs most."""
    sentences = []
    for detector, lines in lines_by(run, "detector").items():
        scores: dict[str, list[float]] = {}
        for line in lines:
            scores.setdefault(str(line.get("shift") or ""), []).append(metric_of(line, "mAP"))
        sentences.append(
            worst_condition(
                detector, "mAP", {name: mean_of(shift_scores) for name, shift_scores in scores.items()}, "shift"
            )
        )
    return sentences
