"""Collisions that each generator finds, in sentences."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ssad.report.load import Run
from ssad.report.records import Line, metric_of
from ssad.report.verdict import lines_by


def verdict(run: Run) -> list[str]:
    """Collisions that generators find, by system; of many generators the best three and random search.

    Proven collisions come first, where they were measured. Searches that failed are named; they are in no share.
    """
    sentences = []
    for system, lines in lines_by(run, "system", failed=True).items():
        counts: dict[str, tuple[int, int, int]] = {}
        for generator in dict.fromkeys(str(line.get("generator") or "") for line in lines):
            search_lines = [line for line in lines if line.get("generator") == generator]
            survivors = sum(metric_of(line, "survived") == 1.0 for line in search_lines)
            if survivors:
                failures = sum(line["status"] != "ok" for line in search_lines)
                collisions = sum(metric_of(line, "CR") == 1.0 for line in search_lines)
                counts[generator] = (collisions, survivors, failures)
        if not counts:
            if any(line["status"] == "ok" for line in lines):
                sentences.append(f"{system} survives none of its scenarios unchanged: there is nothing to find.")
            continue
        sentences += _proven(system, lines, list(counts))
        ranking = sorted(counts, key=lambda name: -counts[name][0] / counts[name][1])
        listed = list(counts) if len(ranking) <= 4 else [*ranking[:3], *(["random"] if "random" in ranking[3:] else [])]
        summaries = ", ".join(_found_in(name, *counts[name]) for name in listed)
        remark = (
            f" (the best three of {len(ranking)}{', and random search' * (len(listed) > 3)})"
            if len(ranking) > 4
            else ""
        )
        subject = f"{system} is made to collide" if counts[ranking[0]][0] else f"No generator makes {system} collide"
        sentences.append(f"{subject} in scenarios that it survives unchanged: {summaries}{remark}.")
    return sentences


def _proven(system: str, lines: Sequence[Line], generators: Sequence[str]) -> list[str]:
    """Return a sentence about proven collisions; none where no search has measured them."""
    shares: dict[str, tuple[int, int]] = {}
    for generator in generators:
        values = [metric_of(line, "proven") for line in lines if line.get("generator") == generator]
        measured = [value for value in values if not math.isnan(value)]
        if measured:
            shares[generator] = int(sum(measured)), len(measured)
    ranking = sorted(shares, key=lambda name: -shares[name][0] / shares[name][1])
    if not ranking:
        return []
    listed = ranking if len(ranking) <= 4 else [*ranking[:3], *(["random"] if "random" in ranking[3:] else [])]
    summaries = ", ".join(_found_in(name, *shares[name], 0) for name in listed)
    return [
        f"Collisions of {system} that a careful driver avoids and a lawful adversary causes are found by {summaries}."
    ]


def _found_in(generator: str, found_count: int, tried_count: int, failed_count: int) -> str:
    return f"{generator} in {found_count} of {tried_count}{f' ({failed_count} more failed)' if failed_count else ''}"
