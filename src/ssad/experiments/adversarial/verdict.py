"""Collisions that each generator finds, in sentences."""

from __future__ import annotations

from ssad.report.load import Run
from ssad.report.verdict import lines_by, metric_of


def verdict(run: Run) -> list[str]:
    """Collisions that generators find, a sentence a system; of many generators the best three and random search.

    Searches that failed count, as in the tables.
    """
    found = []
    for system, lines in lines_by(run, "system", failed=True).items():
        counts: dict[str, tuple[int, int, int]] = {}
        for generator in dict.fromkeys(str(line.get("generator") or "") for line in lines):
            own = [line for line in lines if line.get("generator") == generator]
            alive = sum(metric_of(line, "survived") == 1.0 for line in own)
            if alive:
                failed = sum(line["status"] != "ok" for line in own)
                counts[generator] = sum(metric_of(line, "CR") == 1.0 for line in own), alive + failed, failed
        if not counts:
            if any(line["status"] == "ok" for line in lines):
                found.append(f"{system} survives none of its scenarios unchanged: there is nothing to find.")
            continue
        best = sorted(counts, key=lambda name: -counts[name][0] / counts[name][1])
        shown = list(counts) if len(best) <= 4 else [*best[:3], *(["random"] if "random" in best[3:] else [])]
        said = ", ".join(_found_in(name, *counts[name]) for name in shown)
        more = f" (the best three of {len(best)}{', and random search' * (len(shown) > 3)})" if len(best) > 4 else ""
        what = f"{system} is made to collide" if counts[best[0]][0] else f"No generator makes {system} collide"
        found.append(f"{what} in scenarios that it survives unchanged: {said}{more}.")
    return found


def _found_in(generator: str, hits: int, tried: int, failed: int) -> str:
    return f"{generator} in {hits} of {tried}{f' ({failed} failed)' if failed else ''}"
