"""Write docs/results/physical*.md from stored runs: python -m benchmarks.physical_page [--as NAME] [RUN...]

With runs (folders that `ssad run physical` or another of `SUITES` wrote) the tables and run.json without its cells are
stored first, in benchmarks/results/NAME (of the suite, if none is said). Several runs of one suite, such as of one pair
of towns each, are joined.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.joined_runs import joined, summary_of
from benchmarks.provenance import origin, warning
from ssad.core.checkpoints import state_hash
from ssad.detectors import make_detector
from ssad.experiments.perception.physical.page import section
from ssad.report.tables import to_markdown

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
PAGES = ROOT / "docs" / "results"
LIMITS = "physical-limits"
"""Name of the page on what limits patches and lights, and on what a step costs."""
SUITES = {
    "physical": "ssad run physical --device cuda",
    "physical-quick": "ssad run physical-quick",
    "physical-lights": "ssad run physical-lights",
    **{f"physical-{what}": f"ssad run physical-{what}" for what in ("sign", "walker", "road", "3d")},
    **{
        f"physical-{what}": f"ssad run benchmarks/physical-{what}.yaml"
        for what in ("around", "around-drives", "judges", "stealth")
    },
}
NOTES = {
    "physical-around-drives": "Each pair of towns is a run of its own, with the textures that were trained in it.",
}
"""What a section says of its run beside the suite's description."""
FIRST = "physical-"  # how the names of the tables of a pair of towns begin
STAGES = ("print", "light", "sensor", "detector", "sensor_back", "texture_back")  # of benchmarks/physical_speed.py
OTHERS = ("margins", "comparison", "transfer", "grid", "others", "effort")


def store(folders: Sequence[Path], name: str | None = None) -> None:
    """Keep what the page needs of runs of one suite."""
    run = joined(folders)
    folder = RESULTS / (name or run.suite["name"])
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    (folder / "run.json").write_text(json.dumps(summary_of(run), indent=1) + "\n")
    for table in section(run)[1]:
        (folder / f"{table.name}.md").write_text(to_markdown(table))


def outdated(about: dict[str, Any]) -> list[str]:
    """Detectors whose shipped weights are others than those that were attacked."""
    return [name for name, known in about["weights"].items() if state_hash(make_detector(name)) != known]


def part(name: str) -> list[str]:
    """What the page says of a suite."""
    folder = RESULTS / name
    if not (folder / "run.json").is_file():
        return [f"`{SUITES[name]}` has not run yet.", ""]
    about = json.loads((folder / "run.json").read_text())
    suite, old = about["suite"], outdated(about)
    lines = [f"> {outside}", ""] if (outside := warning(about)) else []
    if old:
        lines += [f"> **Measured with earlier weights of {' and '.join(old)}.**", ""]
    lines += [suite["description"], "", *([NOTES[name], ""] if name in NOTES else [])]
    commands = ", then ".join(f"`{one}`" for one in about["command"])
    lines += [
        f"Command: {commands}. {origin(about)} "
        "Weights: " + ", ".join(f"`{key}` {digest}" for key, digest in about["weights"].items()) + ".",
        "",
    ]
    for reason, count in Counter(about["failed"].values()).items():
        lines += [f"> **{count} of {about['planned']} cells were refused:** {reason}.", ""]
    if about["missing"]:
        done = about["planned"] - len(about["missing"])
        lines += [
            f"> **The run was stopped: {done} of {about['planned']} cells are there.** What is missing is n/a.",
            "",
        ]
    tables = [*sorted(folder.glob(f"{FIRST}*.md")), *(folder / f"{other}.md" for other in OTHERS)]
    for table in tables:
        if table.is_file() and table.read_text().count("\n| ") > 1:  # one is its head
            lines += [table.read_text().strip(), ""]
    return lines


def speed() -> list[str]:
    """What an attack step costs, where it was measured."""
    lines = [
        "## What a step costs",
        "",
        "`python benchmarks/physical_speed.py [--device cuda] --out FILE`: showing a car at 20 m with a camouflage "
        "(print, light, lens, sensor, JPEG; forward and backward) and asking YOLOv5n, for a picture; and what the "
        "paper's budget of 600 pictures x 200 epochs takes then.",
        "",
        "| On | Shown | Pictures a step | Rendering, ms | Detector, ms | Share of rendering | Paper's budget, min |",
        "|---|---|---|---|---|---|---|",
    ]
    stages = []
    for path in sorted(RESULTS.glob("physical_speed*.json")):
        found = json.loads(path.read_text())
        for name, row in found["rows"].items():
            shown = "whole picture, 640 px" if name == "whole" else f"window, {found['window']} px"
            lines.append(
                f"| {found['device']} | {shown} | {found['batch']} | {row['render_ms']:.1f} | {row['detector_ms']:.1f} "
                f"| {100 * row['share']:.0f} % | {row['paper_minutes']:.0f} |"
            )
            if "stages_ms" in row:
                times = " | ".join(f"{row['stages_ms'][stage]:.2f}" for stage in STAGES)
                stages.append(f"| {found['device']} | {shown} | {times} |")
    if stages:
        lines += [
            "",
            "Where it goes, ms a picture:",
            "",
            "| On | Shown | Print | Light | Lens, sensor, JPEG | Detector, both ways | Back through these | "
            "Back to the texture |",
            "|---|---|---|---|---|---|---|---|",
            *stages,
        ]
    return [*lines, ""]


def patch() -> list[str]:
    """What limits an adversarial patch."""
    rows = json.loads((RESULTS / "physical_patch.json").read_text())
    rows = [row for row in rows if "name" in row]
    if not rows:
        return []
    lines = [
        "## What limits a patch",
        "",
        "`python benchmarks/physical_patch.py`: Adv. Patch on the rear against YOLOv5n, trained on "
        f"{rows[0]['pictures']} pictures of Twinford for {rows[0]['epochs']} epochs, with one thing after the other "
        "made easier for it. Own: in the pictures of its training, the most that it can reach; test: in as many of "
        "Oldmarket, both printed exactly. AP50 and mean score of the target, and the share of its box that "
        "the patch covers, in percent.",
        "",
        "| Adv. Patch | Covers | Own AP50 | Own score | Test AP50 | Test score | Random patch, score |",
        "|---|---|---|---|---|---|---|",
    ]
    columns = [
        ("own", "AP50"),
        ("own", "confidence"),
        ("test", "AP50"),
        ("test", "confidence"),
        ("random", "confidence"),
    ]
    for row in rows:
        values = [row["covers"], *(row.get(group, {}).get(metric) for group, metric in columns)]
        lines.append(f"| {' | '.join([row['about'], *map(percent, values)])} |")
    return [*lines, ""]


def light() -> list[str]:
    """What light attacks have to work with."""
    found = json.loads((RESULTS / "physical_lights.json").read_text())
    rows = found["rows"]
    lines = [
        "## What lights have to work with",
        "",
        f"`python benchmarks/physical_lights.py`: {rows[0]['pictures']} pictures of {rows[0]['drives']} drives in "
        "Oldmarket. Sunlit: pictures in which the sun gives a fifth of the light on the target's rear or more, in the "
        "others a shadow there cannot be seen; no sun: all of it kept off the whole target, which no card can do; "
        "flooded: a white lamp of 3000 lm, 4 m behind, on the whole rear. AP50 and mean score of YOLOv5n in percent.",
        "",
        "| Hour | Sunlit | Light on the rear, lux | Clean AP50 | Clean score | No sun, AP50 | No sun, score "
        "| Flooded, AP50 | Flooded, score |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        values = [
            row.get(group, {}).get(metric)
            for group in ("clean", "no_sun", "flooded")
            for metric in ("AP50", "confidence")
        ]
        lines.append(
            f"| {row['hour']} | {percent(row['sunlit'])} | {row['lux']:.0f} | {' | '.join(map(percent, values))} |"
        )
    spans = " and ".join(f"a {name} {low:.0f} to {high:.0f}" for name, (low, high) in found["lux"].items())
    return [*lines, "", f"At full power {spans} lux on what it lights, by how far it is spread.", ""]


def percent(value: float | None) -> str:
    """A share in percent, or n/a."""
    return "n/a" if value is None else f"{100 * value:.1f}"


def pages() -> dict[str, str]:
    """Return the pages, by name: one for each suite, and one on limits and costs."""
    made = {name: "\n".join([*_head(name), *part(name)]) for name in SUITES}
    lines = [*_head("what limits them, and what a step costs"), *patch(), *light(), *speed()]
    return made | {LIMITS: "\n".join(lines)}


def _head(what: str) -> list[str]:
    name = f"`{what}`" if what in SUITES else what
    return [
        f"# Physical attacks: {name}",
        "",
        "`python -m benchmarks.physical_page` makes this page from tables that are kept in `benchmarks/results`. The",
        "reference explains [attacks, carriers and scores](../reference/physical.md), and",
        "[what the runs say](physical-findings.md) sums up all suites.",
        "",
    ]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("runs", nargs="*", type=Path, metavar="RUN")
    parser.add_argument("--as", dest="name", choices=list(SUITES))
    given = parser.parse_args()
    if given.runs:
        store(given.runs, given.name)
    for name, text in pages().items():
        (PAGES / f"{name}.md").write_text(text)
