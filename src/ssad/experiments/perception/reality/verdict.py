"""Findings of a run on photographs in sentences: objects found and missed, and textures beside their controls."""

from __future__ import annotations

import math

from ssad.experiments.perception.reality.worn_textures import CLEAN, TRAINED
from ssad.report.load import Run
from ssad.report.records import metric_of
from ssad.report.verdict import lines_by


def verdict(run: Run) -> list[str]:
    """Return recall and wrong boxes of each detector, and the cars that each texture and its strongest control hide."""
    sentences = []
    for detector, lines in lines_by(run, "detector").items():
        for line in lines:
            recall = metric_of(line, "recall")
            if line["pasted"] == CLEAN and not math.isnan(recall):
                sentences.append(
                    f"{detector} finds {100 * recall:.0f} % of {line['n']} objects in {line['images']} photographs, "
                    f"with {metric_of(line, 'wrong'):.1f} wrong boxes in each."
                )
        textures = {line["texture"] for line in lines if line["pasted"] == TRAINED}
        for texture in sorted(textures):
            hidden = {
                line["pasted"]: metric_of(line, "hidden")
                for line in lines
                if line["texture"] == texture and not math.isnan(metric_of(line, "hidden"))
            }
            controls = {name: share for name, share in hidden.items() if name != TRAINED}
            if TRAINED not in hidden or not controls:
                continue
            strongest = max(controls, key=lambda name: controls[name])
            comparison = f"{texture} hides {100 * hidden[TRAINED]:.0f} % of the cars that {detector} finds, "
            comparison += f"its control {strongest} {100 * controls[strongest]:.0f} %"
            remark = "; so it proves nothing" if controls[strongest] >= hidden[TRAINED] > 0 else ""
            sentences.append(f"{comparison}{remark}.")
    return sentences
