"""Write docs/gap_results.md from runs of benchmarks/gap-benign.yaml and gap-damage.yaml.

    python benchmarks/gap_page.py --pick runs/gap-damage        # keys of drives worth a replay

`--pick` names, for the perturbation with AP halved whose collision rate moved least and for the one that brought most
collisions for its fall of AP, drives that show it: the drive that lost most AP without a collision, and one whose
collision is not there in the clean drive and goes with the repaired error.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ssad.report.kinds.gap import Condition, change, conditions
from ssad.report.load import Run, load_run

HALVED, SMALL = 0.5, 0.1  # falls of AP, as shares of the clean one


def lost_share(run: Run, condition: Condition) -> float:
    """Which share of the clean AP is lost, over drives where both were measured."""
    clean = _by_drive(run, (condition[0], "none", 0))
    pairs = [
        (clean[drive]["metrics"]["AP"], line["metrics"]["AP"])
        for drive, line in _by_drive(run, condition).items()
        if drive in clean and None not in (clean[drive]["metrics"].get("AP"), line["metrics"].get("AP"))
    ]
    before, after = (sum(pair[k] for pair in pairs) for k in (0, 1))
    return 1.0 - after / before if before else math.nan


def harmless(run: Run) -> Condition | None:
    """Of the conditions that halve AP, the one whose collision rate surely moved least; None: there is none."""
    halving = [c for c in conditions(run) if c[2] and lost_share(run, c) >= HALVED]
    return min(halving, key=lambda c: _most(change(run, c, "collision")), default=None)


def harmful(run: Run) -> Condition | None:
    """Of the conditions with a small fall of AP, the one with the largest rise of the collision rate."""
    mild = [c for c in conditions(run) if c[2] and lost_share(run, c) <= SMALL]
    return max(mild, key=lambda c: change(run, c, "collision").mean, default=None)


def _most(cell: Any) -> float:
    ends = [abs(one) for one in (cell.low, cell.high) if not math.isnan(one)]
    return max(ends, default=math.inf)


def _by_drive(run: Run, condition: Condition) -> dict[str, Mapping[str, Any]]:
    lines = conditions(run).get(condition, [])
    return {str(line["cluster"]): line for line in lines if line["status"] == "ok"}


def picked(run: Run, most: int = 2) -> list[str]:
    """Lines that name the two conditions, each after #, and under each the keys of drives that show it."""
    found = []
    for condition, crash in ((harmless(run), False), (harmful(run), True)):
        if condition is None:
            continue
        clean = _by_drive(run, (condition[0], "none", 0))
        what = f"AP lost {lost_share(run, condition):.2f}, CR {change(run, condition, 'collision').text}"
        found.append(f"# {condition[1]} {condition[2]}: {what}")
        fit: list[tuple[bool, float, str]] = []
        for drive, line in _by_drive(run, condition).items():
            before = clean[drive]["metrics"] if drive in clean else {}
            now = line["metrics"]
            if before.get("AP") is None or now.get("AP") is None or before["collision"]:
                continue
            if bool(now["collision"]) == crash:
                gone = crash and not (line.get("repaired") or {"same": True})["same"]
                fit.append((gone, 0.0 if crash else before["AP"] - now["AP"], str(line["key"])))
        found += [key for *_, key in sorted(fit, key=lambda one: one[:2], reverse=True)[:most]]
    return found


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pick", type=Path, metavar="DIR", required=True)
    args = parser.parse_args()
    print("\n".join(picked(load_run(args.pick))))


if __name__ == "__main__":
    main()
