"""Collisions and completed routes, in sentences."""

from __future__ import annotations

import math

from ssad.report.load import Run
from ssad.report.verdict import lines_by, mean_of, metric_of


def verdict(run: Run) -> list[str]:
    """Collisions and routes of each system; drives that failed count, as in the tables."""
    found = []
    for system, lines in lines_by(run, "system", failed=True).items():
        hits = sum(metric_of(line, "collision") == 1.0 for line in lines)
        done = mean_of(metric_of(line, "route_completion") for line in lines)
        routes = "" if math.isnan(done) else f" and completed {done:.0%} of its routes"
        found.append(f"{system} collided in {hits} of {len(lines)} drives{routes}.")
    return found
