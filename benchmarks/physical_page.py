"""Write docs/physical_results.md from stored runs: python benchmarks/physical_page.py [RUN...]

With runs (folders that `ssad run physical` or another of `SUITES` wrote) the tables and run.json without its cells are
stored first, in benchmarks/results/NAME of the suite. Several runs of one suite, such as of one pair of towns each, are
joined: of a cell that two have, the later counts.
"""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ssad.core.checkpoints import state_hash
from ssad.detectors import make_detector
from ssad.report.kinds.physical import section
from ssad.report.load import load_run
from ssad.report.tables import to_markdown

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


def store(folders: Sequence[Path]) -> None:
    """Keep what the page needs of runs of one suite."""
    runs = [load_run(folder) for folder in folders]
    name = runs[0].suite["name"]
    folder = RESULTS / name
    lines: dict[tuple[Any, ...], Mapping[str, Any]] = {}
    cells: set[tuple[Any, ...]] = set()
    for run in runs:
        if run.suite["name"] != name:
            raise SystemExit(f"{run.folder} is of the suite {run.suite['name']}, not of {name}")
        lines |= {_place(line): line for line in run.lines}
        cells |= {_place(cell) for cell in run.header["cells"]}
    about = {key: value for key, value in runs[0].header.items() if key != "cells"}
    about["weights"] = {key: value for run in runs for key, value in run.header["weights"].items()}
    about["command"] = list(dict.fromkeys(run.command for run in runs))
    done = sum(line["status"] == "ok" for line in lines.values())
    joined = replace(runs[0], header=about, lines=tuple(lines.values()), planned=len(cells))
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    (folder / "run.json").write_text(json.dumps(about | {"cells": len(cells), "cells_done": done}, indent=1) + "\n")
    for table in section(joined)[1]:
        (folder / f"{table.name}.md").write_text(to_markdown(table))


def _place(row: Mapping[str, Any]) -> tuple[Any, ...]:
    """What tells a cell from others, whatever run it is of."""
    number = row["spec"].get("light", row["spec"])["number"] if "spec" in row else row["number"]
    names = ("train", "test", "view", "detector", "attack", "carrier", "source")
    return (*(row[name] for name in names), number)


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
    commands = [about["command"]] if isinstance(about["command"], str) else about["command"]
    lines += [
        f"Command: {', then '.join(f'`{one}`' for one in commands)}. Software: torch {about['versions']['torch']}. "
        "Weights: " + ", ".join(f"`{key}` {digest}" for key, digest in about["weights"].items()) + ".",
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


def speed() -> list[str]:
    """What an attack step costs, where it was measured."""
    lines = [
        "## What a step costs", "",
        "`python benchmarks/physical_speed.py [--device cuda] --out FILE`: showing a car at 20 m with a camouflage "
        "(print, light, lens, sensor, JPEG; forward and backward) and asking YOLOv5n, for a picture; and what the "
        "paper's budget of 600 pictures x 200 epochs takes then.", "",
        "| On | Shown | Pictures a step | Rendering, ms | Detector, ms | Share of rendering | Paper's budget, min |",
        "|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for path in sorted(RESULTS.glob("physical_speed*.json")):
        found = json.loads(path.read_text())
        for name, row in found["rows"].items():
            shown = "whole picture, 640 px" if name == "whole" else f"window, {found['window']} px"
            lines.append(
                f"| {found['device']} | {shown} | {found['batch']} | {row['render_ms']:.1f} | {row['detector_ms']:.1f} "
                f"| {100 * row['share']:.0f} % | {row['paper_minutes']:.0f} |"
            )
    return [*lines, ""]


def page() -> str:
    """The page."""
    lines = [
        "# The shipped detectors under physical attacks", "",
        "`benchmarks/physical_page.py` makes this page from the tables that the commands below wrote, which are kept",
        "in `benchmarks/results`. What the attacks, carriers and scores are: [physical.md](physical.md).", "",
    ]  # fmt: skip
    for name in SUITES:
        lines += part(name)
    return "\n".join(lines + speed())


if __name__ == "__main__":
    if len(sys.argv) > 1:
        store([Path(one) for one in sys.argv[1:]])
    PAGE.write_text(page())
