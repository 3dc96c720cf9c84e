"""Cut-in sweeps of the four careful drivers beside the shares that the Joint Research Centre's grids give.

`python benchmarks/careful_cut_ins.py` drives every model through both grids and prints which share of the encounters
ends in a crash. `--write` puts the tables into docs/results/careful-drivers.md; `--lateral M` is the room between the
two cars at the start.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from ssad.core.types import Bool
from ssad.drivers.careful.cut_in import CutIns, crashes, cut_in_grid, speed_pairs
from ssad.drivers.careful.models import FSM, RSS, CarefulHuman, Reg157

PAGE = Path(__file__).parents[1] / "docs" / "results" / "careful-drivers.md"
BEGIN, END = "<!-- cut-ins: begin -->", "<!-- cut-ins: end -->"
PUBLISHED = {
    "low": {"CC": 23.40, "Reg157": 14.14, "FSM": 5.66, "RSS": 5.52, "all four": 4.11, "cases": 15930},
    "high": {"CC": 25.30, "Reg157": 20.43, "FSM": 11.75, "RSS": 10.62, "all four": 8.53, "cases": 14040},
}
"""Percent that crash in the grids of ec-jrc/JRC-FSM, commit 01b05c2, run as they are."""
MODELS = {"CC": CarefulHuman(wait_for_overlap=True), "Reg157": Reg157(), "FSM": FSM(), "RSS": RSS()}
SPEEDS = {"low": (range(10, 61, 10), range(2, 61)), "high": (range(70, 131, 10), range(2, 121))}


def cases(name: str, lateral: float) -> CutIns:
    """A grid: the driver's speeds with all lower ones, and gaps, both in steps of 1 (10 km/h; 1 m)."""
    speeds, gaps = SPEEDS[name]
    return cut_in_grid(speed_pairs(speeds), gaps, lateral=lateral)


def shares(found: dict[str, Bool]) -> dict[str, float]:
    """Percent that crash, by model, and with all of them."""
    out = {name: 100.0 * float(hit.mean()) for name, hit in found.items()}
    return out | {"all four": 100.0 * float(np.all(list(found.values()), axis=0).mean())}


def tables(laterals: list[float]) -> str:
    """Both grids as Markdown."""
    lines = ["", f"| Grid | Cases | {' | '.join([*MODELS, 'all four'])} | FSM avoids, CC not | the reverse |"]
    lines.append("|---|---:|" + "---:|" * (len(MODELS) + 3))
    for name in SPEEDS:
        told = PUBLISHED[name]
        row = [f"{told[model]:.2f}" for model in (*MODELS, "all four")]
        other = {"low": "18.0 | 0.5", "high": "14.0 | 0.3"}[name]
        lines.append(f"| {name}, published | {told['cases']:,.0f} | {' | '.join(row)} | {other} |")
        for lateral in laterals:
            made = cases(name, lateral)
            found = {model: crashes(driver, made) for model, driver in MODELS.items()}
            row = [f"{value:.2f}" for value in shares(found).values()]
            cc, fsm = found["CC"], found["FSM"]
            row += [f"{100 * (cc & ~fsm).mean():.1f}", f"{100 * (fsm & ~cc).mean():.1f}"]
            lines.append(f"| {name}, {lateral:g} m apart | {len(made):,} | {' | '.join(row)} |")
            own = 100.0 * float(crashes(CarefulHuman(), made).mean())
            lines.append(
                f"| {name}, {lateral:g} m apart, CC as the regulation has it | {len(made):,} | {own:.2f} | | | | | | |"
            )
    return "\n".join([*lines, ""])


def main() -> None:
    """Print the tables, or write them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lateral", type=float, nargs="+", default=[1.6, 1.85], help="m between the cars at the start")
    parser.add_argument("--write", action="store_true", help="put the tables into docs/results/careful-drivers.md")
    given = parser.parse_args()
    began = time.process_time()
    text = tables(given.lateral)
    print(text)
    print(f"{time.process_time() - began:.0f} s of CPU time")
    if given.write:
        before, _, rest = PAGE.read_text().partition(BEGIN)
        PAGE.write_text(f"{before}{BEGIN}\n{text}\n{END}{rest.partition(END)[2]}")


if __name__ == "__main__":
    main()
