"""Share of targets that the best attack hides, and the best control, in sentences."""

from __future__ import annotations

import math

from ssad.experiments.perception.physical import page as physical
from ssad.report.load import Run
from ssad.report.records import Line, metric_of
from ssad.report.verdict import lines_by


def verdict(run: Run) -> list[str]:
    """Return the share of targets that the strongest attack hides, and that of the best control of its carrier."""
    sentences = []
    for detector, detector_lines in lines_by(run, "detector").items():
        lines = [
            line for line in detector_lines if line.get("view", "drive") == "drive" and not math.isnan(_hidden(line))
        ]
        attacks = [line for line in lines if not physical.is_control(line["attack"])]
        if not attacks:
            continue
        strongest = max(attacks, key=_hidden)
        town_text = f" in {strongest['test']}" if len({line["test"] for line in lines}) > 1 else ""
        sentences.append(
            f"{strongest['attack']} hides {_hidden(strongest):.0%} of the targets from {detector}{town_text}."
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
    return metric_of(line, "ASR_25")
