"""Collisions and completed routes, in sentences."""

from __future__ import annotations

import math

from ssad.report.load import Run
from ssad.report.records import metric_of
from ssad.report.verdict import event_sentence, lines_by, mean_of


def verdict(run: Run) -> list[str]:
    """Return collisions and routes of each system, and what its failed drives leave open."""
    sentences = []
    for system, lines in lines_by(run, "system", failed=True).items():
        completion = mean_of(metric_of(line, "route_completion") for line in lines)
        route_text = "" if math.isnan(completion) else f", and completed {completion:.0%} of its routes"
        collision_text = event_sentence(system, "collided in", lines, "collision", rate="collision rate", noun="drives")
        sentences.append(f"{collision_text}{route_text}.")
    return sentences
