"""Clean accuracy, the strongest attack and noise of the same size, in sentences."""

from __future__ import annotations

import math

from ssad.report.load import Run
from ssad.report.verdict import lines_by, metric_of, worst_condition


def verdict(run: Run) -> list[str]:
    """The mAP clean, under the strongest attack and under noise of the same size, by the rows of the main table.

    Points of curves, of other budgets and on fewer scenes, and pictures made against others, are not compared.
    """
    found = []
    for detector, every in lines_by(run, "detector").items():
        lines = [line for line in every if line.get("row", True) and not line.get("subset") and not line.get("defence")]
        clean = [metric_of(line, "mAP") for line in lines if (line.get("attack") or "clean") == "clean"]
        attacks = [line for line in lines if (line.get("attack") or "clean") not in ("clean", "noise")]
        attacks = [line for line in attacks if not math.isnan(metric_of(line, "mAP"))]
        if not clean or not attacks:
            continue
        best = min(attacks, key=lambda line: metric_of(line, "mAP"))
        lowest, name = metric_of(best, "mAP"), " on ".join(filter(None, map(best.get, ("attack", "loss"))))
        found.append(worst_condition(detector, "mAP", {"": clean[0], name: lowest}, "attack"))
        size = [best.get(key) for key in ("norm", "radius")]
        alike = [
            line
            for line in lines
            if line.get("attack") == "noise" and [line.get(k) for k in ("norm", "radius")] == size
        ]
        noise = min((metric_of(line, "mAP") for line in alike), default=math.nan)
        if found[-1] and not math.isnan(noise):
            told = "what lies between is the attack's" if lowest < noise else "the attack does no more than that"
            found.append(f"Random noise of the same size leaves {detector} an mAP of {noise:.0%}: {told}.")
    return found
