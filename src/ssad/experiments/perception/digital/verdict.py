"""Clean accuracy, the strongest attack and noise of the same size, in sentences."""

from __future__ import annotations

import math

from ssad.report.load import Run
from ssad.report.records import metric_of
from ssad.report.verdict import lines_by, worst_condition


def verdict(run: Run) -> list[str]:
    """The mAP clean, under the strongest attack and under noise of the same size, by the rows of the main table.

    Points of curves, of other budgets and on fewer scenes, and pictures made against others, are not compared.
    """
    sentences = []
    for detector, detector_lines in lines_by(run, "detector").items():
        lines = [
            line
            for line in detector_lines
            if line.get("row", True) and not line.get("subset") and not line.get("defence")
        ]
        clean_scores = [metric_of(line, "mAP") for line in lines if (line.get("attack") or "clean") == "clean"]
        attacks = [line for line in lines if (line.get("attack") or "clean") not in ("clean", "noise")]
        attacks = [line for line in attacks if not math.isnan(metric_of(line, "mAP"))]
        if not clean_scores or not attacks:
            continue
        strongest = min(attacks, key=lambda line: metric_of(line, "mAP"))
        lowest_score, name = (
            metric_of(strongest, "mAP"),
            " on ".join(filter(None, map(strongest.get, ("attack", "loss")))),
        )
        sentences.append(worst_condition(detector, "mAP", {"": clean_scores[0], name: lowest_score}, "attack"))
        budget = [strongest.get(key) for key in ("norm", "radius")]
        noise_lines = [
            line
            for line in lines
            if line.get("attack") == "noise" and [line.get(field) for field in ("norm", "radius")] == budget
        ]
        noise_score = min((metric_of(line, "mAP") for line in noise_lines), default=math.nan)
        if sentences[-1] and not math.isnan(noise_score):
            judgement = (
                "what lies between is the attack's"
                if lowest_score < noise_score
                else "the attack does no more than that"
            )
            sentences.append(
                f"Random noise of the same size leaves {detector} an mAP of {noise_score:.0%}: {judgement}."
            )
    return sentences
