"""Share of targets that the best attack hides, and the best control, in sentences."""

from __future__ import annotations

import math

from ssad.experiments.perception.physical import page as physical
from ssad.report.load import Run
from ssad.report.verdict import Line, lines_by, metric_of


def verdict(run: Run) -> list[str]:
    """Share of the targets that the best attack hides as they drive, and the best control of its carrier there."""
    found = []
    for detector, every in lines_by(run, "detector").items():
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
    return metric_of(line, "ASR_25")
