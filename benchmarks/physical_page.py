"""Write docs/physical_results.md from stored runs: python benchmarks/physical_page.py [RUN]

With RUN (what `ssad run physical` or `ssad run physical-quick` wrote) its tables and run.json without its cells are
stored first, in benchmarks/results/NAME of the suite.
"""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

from ssad.core.checkpoints import state_hash
from ssad.detectors import make_detector

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
PAGE = ROOT / "docs" / "physical_results.md"
SUITES = {
    "physical": "ssad run physical --device cuda", "physical-gpu": "ssad run physical-gpu --device cuda",
    "physical-quick": "ssad run physical-quick", "physical-lights": "ssad run physical-lights",
    **{f"physical-{what}": f"ssad run physical-{what}" for what in ("sign", "walker", "road")},
}  # fmt: skip
FIRST = "physical-"  # how the names of the tables of a pair of towns begin
OTHERS = ("margins", "transfer", "grid", "others", "effort")


def store(run: Path) -> None:
    """Keep what the page needs of a run."""
    about = json.loads((run / "run.json").read_text())
    folder = RESULTS / about["suite"]["name"]
    folder.mkdir(parents=True, exist_ok=True)
    rows = [json.loads(line) for line in (run / "results.jsonl").read_text().splitlines()]
    counts = {"cells": len(about.pop("cells")), "cells_done": sum(row["status"] == "ok" for row in rows)}
    (folder / "run.json").write_text(json.dumps(about | counts, indent=1) + "\n")
    for table in sorted((run / "tables").glob("*.md")):
        shutil.copy(table, folder / table.name)


def outdated(about: dict[str, Any]) -> list[str]:
    """Detectors whose shipped weights are others than those that were attacked."""
    return [name for name, known in about["weights"].items() if state_hash(make_detector(name)) != known]


def part(name: str) -> list[str]:
    """What the page says of a suite."""
    folder = RESULTS / name
    if not (folder / "run.json").is_file():
        return [f"## `{name}`", "", f"`{SUITES[name]}` has not run yet.", ""]
    about = json.loads((folder / "run.json").read_text())
    suite, old = about["suite"], outdated(about)
    lines = [f"## `{name}`", "", suite["description"], ""]
    if old:
        lines += [f"> **Measured with earlier weights of {' and '.join(old)}.**", ""]
    lines += [
        f"Command: `{about.get('command') or SUITES[name]}`. Software: torch {about['versions']['torch']}. Weights: "
        + ", ".join(f"`{key}` {digest}" for key, digest in about["weights"].items())
        + ".",
        "",
    ]
    done, cells = about.get("cells_done"), about.get("cells")
    if done != cells:
        lines += [f"> **The run was stopped: {done} of {cells} cells are there.** What is missing is n/a.", ""]
    tables = [*sorted(folder.glob(f"{FIRST}*.md")), *(folder / f"{other}.md" for other in OTHERS)]
    for table in tables:
        if table.is_file():
            lines += [table.read_text().replace("## ", "### ", 1).strip(), ""]
    return lines


def page() -> str:
    """The page."""
    lines = [
        "# The shipped detectors under physical attacks", "",
        "`benchmarks/physical_page.py` makes this page from the tables that the commands below wrote, which are kept",
        "in `benchmarks/results`. What the attacks, carriers and scores are: [physical.md](physical.md).", "",
    ]  # fmt: skip
    for name in SUITES:
        lines += part(name)
    return "\n".join(lines)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        store(Path(sys.argv[1]))
    PAGE.write_text(page())
