"""Collisions and completed routes, in sentences."""

from __future__ import annotations

import math

from ssad.report.load import Run
from ssad.report.records import metric_of
from ssad.report.verdict import lines_by, mean_of


def verdict(run: Run) -> list[str]:
    """Return collisions and routes of each system; drives that failed count, as in the tables."""
    sentences = []
    for system, lines in lines_by(run, "system", failed=True).items():
        collisions = sum(metric_of(line, "collision") == 1.0 for line in lines)
        completion = mean_of(metric_of(line, "route_completion") for line in lines)
        route_text = "" if math.isnan(completion) else f" and completed {completion:.0%} of its routes"
        sentences.append(f"{system} collided in {collisions} of {len(lines)} drives{route_text}.")
    return sentences
