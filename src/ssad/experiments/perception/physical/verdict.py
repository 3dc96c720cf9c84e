"""Share of targets that the best attack hides, and the best control, in sentences."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ssad.experiments.perception.physical import physical_run as physical
from ssad.metrics.attack_success import N0
from ssad.report.load import Run
from ssad.report.records import Line, metric_of
from ssad.report.verdict import lines_by

RATE = "ASR_25"


def verdict(run: Run) -> list[str]:
    """Return the share of targets that the strongest attack hides, and that of the best control of its carrier."""
    sentences = []
    for detector, detector_lines in lines_by(run, "detector").items():
        lines = [
            line for line in detector_lines if line.get("view", "drive") == "drive" and not math.isnan(_hidden(line))
        ]
        attacks = [line for line in lines if not physical.is_control(line["attack"])]
        if not attacks:
            sentences += _refusal(detector, detector_lines, physical.floor_of(run))
            continue
        strongest = max(attacks, key=_hidden)
        town_text = f" in {strongest['test']}" if len({line["test"] for line in lines}) > 1 else ""
        sentences.append(
            f"{strongest['attack']} hides {_hidden(strongest):.0%} of the {metric_of(strongest, N0[RATE]):.0f} targets "
            f"that {detector} finds clean{town_text}."
        )
        controls = [
            line
            for line in lines
            if all(line[key] == strongest[key] for key in ("test", "carrier"))
            and physical.learns_nothing(line["attack"], strongest["attack"])
        ]
        if controls:
            control = max(controls, key=_hidden)
            sentences.append(f"The strongest control ({control['attack']}) hides {_hidden(control):.0%}.")
    return sentences


def _hidden(line: Line) -> float:
    """Return the attack success rate; NaN in records without its n0."""
    return metric_of(line, RATE) if N0[RATE] in line["metrics"] else math.nan


def _refusal(detector: str, lines: Sequence[Line], floor: float) -> list[str]:
    """Return the sentence about a detector that finds too few of the clean targets for a success rate."""
    counts = [
        (line["metrics"][N0[RATE]], line["n"])
        for line in lines
        if N0[RATE] in (line.get("metrics") or {}) and math.isnan(_hidden(line))
    ]
    if not counts:
        return []
    n0, count = max(counts)
    return [
        f"{detector} finds {n0} of {count} clean targets with a score above 0.25, less than {floor:.0%}: attacks on it "
        "have no success rate."
    ]
