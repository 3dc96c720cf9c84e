"""Write docs/results/shifts.md from the tables of `ssad run shifts` and `shifts-paper`: python -m benchmarks.shift_page

benchmarks/results/shifts and shifts-paper hold what those runs wrote: DIR/tables/*.csv, and run.json without its cells.
"""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.provenance import origin, warning
from ssad.core.checkpoints import state_hash
from ssad.experiments.perception.scene_boxes import detector_of
from ssad.experiments.perception.shifts.page import title_of
from ssad.report.paper import SHIFTS as PUBLISHED
from ssad.scenarios.static.shifts import VERSIONS

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
PAGE = ROOT / "docs" / "results" / "shifts.md"
RUNS = ("shifts", "shifts-paper")  # the physical calibration, and the paper's
NAMES = {"fcos3d-light": ("light FCOS3D", "FCOS3D"), "pgd-det-light": ("light PGD-Det", "PGD")}  # ours, the paper's
PLACE = {"mAP": 0, "NDS": 1}
SHIFTS = [shift for shift in PUBLISHED if shift]

Key = tuple[str, ...]


def header(run: str) -> dict[str, Any]:
    """What a run says of itself."""
    data: dict[str, Any] = json.loads((RESULTS / run / "run.json").read_text())
    return data


def read(run: str, table: str) -> dict[Key, tuple[float, ...]]:
    """Our numbers of a table: what leads a row, then the column -> value, and ends of the interval if there is one."""
    found = {}
    with (RESULTS / run / f"{table}.csv").open(newline="") as file:
        for row in csv.DictReader(file):
            if row.pop("source") == "ours":
                numbers = [row.pop(name) for name in ("mean", "low", "high")]
                key = tuple(value for name, value in row.items() if name not in ("n", "failed", "clusters", "method"))
                found[key] = tuple(float(number) for number in numbers if number)
    return found


def shown(value: tuple[float, ...]) -> str:
    """A number with its interval."""
    return f"{value[0]:.1f}" + (f" [{value[1]:.1f}, {value[2]:.1f}]" if len(value) > 1 else "")


def comparison(metric: str, *, left: bool) -> list[str]:
    """Shift x detector: ours in both calibrations and the paper's; left: as a share of the clean score."""
    tables = [
        {(key[-2], key[-1]): value for key, value in read(run, "left" if left else "shifts").items()} for run in RUNS
    ]
    heads = [
        f"{ours}, {how}" for ours, _ in NAMES.values() for how in ("physical", "paper's severities", "*published*")
    ]
    lines = ["| shift | " + " | ".join(heads) + " |", "|---|" + "---:|" * len(heads)]
    for shift in SHIFTS if left else ["", *SHIFTS]:
        cells = []
        for detector, (_, theirs) in NAMES.items():
            cells += [shown(table[title_of(shift), f"{detector} {metric}"]) for table in tables]
            published = PUBLISHED[shift][theirs][PLACE[metric]]
            clean = PUBLISHED[""][theirs][PLACE[metric]]
            cells.append(f"*{100 * published / clean if left else published:.1f}*")
        lines.append(f"| {title_of(shift)} | " + " | ".join(cells) + " |")
    return [*lines, ""]


def order() -> list[str]:
    """How alike the order of the shifts is here and in the paper."""
    lines = ["| rank correlation with the paper | " + " | ".join(ours for ours, _ in NAMES.values()) + " |"]
    lines.append("|---|" + "---:|" * len(NAMES))
    for run, how in zip(RUNS, ("physical", "paper's severities"), strict=True):
        table = read(run, "left")
        cells = []
        for detector, (_, theirs) in NAMES.items():
            own = {key[-2]: value[0] for key, value in table.items() if key[-1] == f"{detector} mAP"}
            here = [own[title_of(shift)] for shift in SHIFTS]
            there = [PUBLISHED[shift][theirs][0] for shift in SHIFTS]
            places = [np.argsort(np.argsort(values)) for values in (here, there)]
            cells.append(f"{np.corrcoef(*places)[0, 1]:.2f}")
        lines.append(f"| {how} | " + " | ".join(cells) + " |")
    return [*lines, ""]


def severities(run: str) -> list[str]:
    """mAP over severity."""
    table = read(run, "severities")
    lines = ["| shift | " + " | ".join(f"{ours} {s}" for ours, _ in NAMES.values() for s in range(1, 6)) + " |"]
    lines.append("|---|" + "---:|" * 10)
    for shift in SHIFTS:
        cells = [table["mAP", name, title_of(shift), f"severity {s}"][0] for name in NAMES for s in range(1, 6)]
        lines.append(f"| {title_of(shift)} | " + " | ".join(f"{cell:.1f}" for cell in cells) + " |")
    return [*lines, ""]


def robustness() -> list[str]:
    """mCE and mRR."""
    columns = ("mCE (NDS)", "mRR (NDS)", "mCE (mAP)", "mRR (mAP)")
    lines = ["| severities | detector | " + " | ".join(columns) + " |", "|---|---|" + "---:|" * len(columns)]
    for run, how in zip(RUNS, ("physical", "paper's"), strict=True):
        table = read(run, "robustness")
        for name, (ours, _) in NAMES.items():
            lines.append(f"| {how} | {ours} | " + " | ".join(shown(table[name, column]) for column in columns) + " |")
    return [*lines, ""]


def classes() -> list[str]:
    """AP by class and the errors of what was found, on clean data."""
    table = read(RUNS[0], "classes")
    columns = list(dict.fromkeys(key[1] for key in table))
    lines = ["| | " + " | ".join(NAMES[name][0] for name in NAMES) + " |", "|---|" + "---:|" * len(NAMES)]
    for column in columns:
        digits = 2 if column.startswith("m") and column.endswith(")") else 1
        values = [f"{table[name, column][0]:.{digits}f}" for name in NAMES]
        lines.append(f"| {column} | " + " | ".join(values) + " |")
    return [*lines, ""]


def outdated(run: str) -> list[str]:
    """How what a run measured differs from what is shipped now."""
    about = header(run)
    calibration = about["suite"]["calibration"]
    then, now = about["versions"]["shifts"], str(VERSIONS[calibration])
    found = [f"version {then} of the shifts in the {calibration} calibration (now {now})"] if then != now else []
    changed = [name for name, known in about["weights"].items() if state_hash(detector_of(name, "", "cpu")) != known]
    return found + ([f"earlier weights of {' and '.join(changed)}"] if changed else [])


def notice() -> list[str]:
    """A warning above tables that were measured before something changed."""
    reasons = {run: outdated(run) for run in RUNS}
    told = [f"`{run}` with {' and '.join(why)}" for run, why in reasons.items() if why]
    if not told:
        return []
    return [
        "> **Measured before the last changes:** " + "; ".join(told) + ". Images have changed since as well. Until",
        "> the commands have run again, compare these numbers with each other only, not with a new run.",
        "",
    ]


def page() -> str:
    """The page."""
    about = header(RUNS[0])
    data, weights = about["data"], about["weights"]
    with (RESULTS / RUNS[0] / "shifts.csv").open(newline="") as file:
        samples = next(iter(csv.DictReader(file)))["n"]
    towns = " and ".join(data["towns"])
    return "\n".join(
        [
            "# Results of the shipped 3D detectors, clean and under distribution shifts",
            "",
            *([f"> {outside}", ""] if (outside := warning(about)) else []),
            *notice(),
            "`python -m benchmarks.shift_page` makes this page from `benchmarks/results/shifts` and",
            "`benchmarks/results/shifts-paper`. These folders contain the tables that two commands wrote:",
            "```",
            *(
                one if " --device " in one else f"{one} --device cuda"
                for one in (header(run)["command"] for run in RUNS)
            ),
            "```",
            f"Data of the first: {data['scenes']} drives of {data['seconds']:g} s each in {towns}, not used for",
            f"training; {samples} samples of six cameras, {data['width']} pixels wide.",
            f"{origin(about)} Weights:",
            ", ".join(f"`{name}` {digest}" for name, digest in weights.items()) + ".",
            "",
            "* Brackets: 95 % intervals, from how the drives vary ([how](../explanation/intervals.md)).",
            "* *Published*: results of the paper on nuScenes val with full-size detectors. Images and detectors",
            "  differ, so do not compare absolute values. The share of its own clean score that a detector keeps can",
            "  be compared.",
            "* Physical: SSAD's default calibration, with severities in units such as metres of visibility. Each drive",
            "  has one severity from 1 to 5, and the five are distributed evenly over the drives.",
            "* Paper's severities: the published tables of 3D_Corruptions_AD, applied image by image. The severity is",
            "  drawn from 1 to 5 for each sample. See [distribution shifts](../reference/shifts.md).",
            "",
            "## mAP, percent",
            "",
            *comparison("mAP", left=False),
            "## Share of the clean mAP that is kept, percent",
            "",
            *comparison("mAP", left=True),
            "Spearman's rank correlation over the 11 shifts, of the share of the clean mAP that is kept:",
            "",
            *order(),
            "## NDS, percent",
            "",
            *comparison("NDS", left=False),
            "## Share of the clean NDS that is kept, percent",
            "",
            *comparison("NDS", left=True),
            "## mAP by severity, physical",
            "",
            *severities(RUNS[0]),
            "## mAP by severity, the paper's",
            "",
            *severities(RUNS[1]),
            "Published snow has longer streaks at severity 5 than at 4, but less structure of the size of objects.",
            "",
            "## Summary in one number",
            "",
            "In percent, over all shifts and severities. mCE: errors relative to light FCOS3D (lower is better).",
            "mRR: share of the clean score that is kept (higher is better).",
            "",
            *robustness(),
            "## Clean data",
            "",
            "AP in percent; mean true-positive errors as defined by nuScenes.",
            "",
            *classes(),
        ]
    )


if __name__ == "__main__":
    PAGE.write_text(page())
