"""Page of a run on photographs: scores of each detector, by class and by height, and textures beside their controls."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ssad.report.artefacts import pictures
from ssad.report.load import Run
from ssad.report.pages import render
from ssad.report.records import Line, field
from ssad.report.tables import Table, TableCell

TEMPLATE = Path(__file__).with_name("page.html")
CLEAN = "clean"
PERCENT = {"recall": "recall, %", "precision": "precision, %", "AP50": "AP50, %", "margin": "score margin, points"}
COUNTS = {"boxes": "boxes per photograph", "wrong": "wrong boxes per photograph"}
WORN = {"found": "found, %", "score": "mean score", "change": "change", "hidden": "hidden, %"}
INTERVALS = (
    "95 % intervals by the bootstrap over photographs, where there are at least five. Objects that a form ignores, and "
    "those below the least height, count neither as found nor as missed."
)


def section(run: Run, verdict: Sequence[str]) -> tuple[str, Sequence[Table]]:
    """Return the page of a run, with its leading sentences, and its tables."""
    tables = [main_table(run), part_table(run, "class"), part_table(run, "height")]
    textures = texture_table(run)
    tables += [textures] if textures.rows else []
    failures = [
        ([field(name)(line) for name in ("detector", "texture", "pasted")], line["status"], line.get("reason", ""))
        for line in run.failures
    ]
    page = render(
        TEMPLATE,
        run,
        verdict=verdict,
        tables=tables,
        failures=[[*heads, f"{status}: {reason}" if reason else status] for heads, status, reason in failures],
        pictures=pictures(run.folder),
        data=run.header.get("inputs", {}).get("data", {}),
    )
    return page, tables


def clean_lines(run: Run) -> list[Line]:
    """Return the records of clean photographs."""
    return [line for line in run.lines if line["pasted"] == CLEAN]


def main_table(run: Run) -> Table:
    """Return the scores of each detector on the clean photographs."""
    score = run.suite["score"]
    return Table.listing(
        "photographs",
        "Detectors on photographs",
        clean_lines(run),
        rows={"Detector": field("detector")},
        columns={"n": "objects", **PERCENT, **COUNTS},
        metric=lambda line, name: number_of(line, name, line.get("n", 0)),
        note=(
            f"Recall, precision and numbers of boxes at a score of {score:g}, AP50 over all scores, mean over the "
            f"classes that occur. Score margin: mean score with which an object is found (0: not at all), less "
            f"{score:g}. {INTERVALS}"
        ),
    )


def part_table(run: Run, kind: str) -> Table:
    """Return the scores by class or by height of the object."""
    return Table.listing(
        f"photographs-{kind}",
        f"By {'height of the object' if kind == 'height' else kind}",
        list(_parts(run, kind)),
        rows={"Detector": lambda part: part["detector"], kind.capitalize(): lambda part: part["name"]},
        columns={"n": "objects", **PERCENT},
        metric=lambda part, name: number_of(part, name, part["n"]),
        note="Of a height: boxes of another height that find nothing are left out, as COCO does with areas."
        if kind == "height"
        else "A detector is scored on the classes that it knows.",
    )


def _parts(run: Run, kind: str) -> Iterator[Mapping[str, Any]]:
    for line in clean_lines(run):
        for part in line.get("parts") or []:
            if part["by"] == kind:
                yield {"detector": line["detector"], "status": "ok", **part}


def texture_table(run: Run) -> Table:
    """Return the cars that wear a texture, beside those that wear its controls and the same cars clean."""
    worn = [line for line in run.lines if line["pasted"] != CLEAN]
    by_detector = {line["detector"]: line for line in clean_lines(run)}
    lines = []
    for detector in dict.fromkeys(line["detector"] for line in worn):
        lines += [by_detector[detector]] if detector in by_detector else []
        lines += [line for line in worn if line["detector"] == detector]
    return Table.listing(
        "textures",
        "Textures on cars in photographs",
        lines,
        rows={
            "Detector": field("detector"),
            "Texture": lambda line: line["texture"] or "none",
            "Pasted": field("pasted"),
        },
        columns={"n": "cars", **WORN},
        metric=lambda line, name: number_of(line, name, line.get("cars", line.get("n", 0))),
        note=(
            f"Found: share of the cars that a box of at least {run.suite['score']:g} finds; hidden: of those found "
            "clean, the share that is not found. A control is not trained: where it hides as much, the texture proves "
            "nothing. Controls are means over their draws. " + INTERVALS
        ),
    )


def number_of(line: Mapping[str, Any], name: str, n: int) -> TableCell:
    """Return a metric of a record or of one of its parts, with its interval; shares in percent."""
    if name == "n":
        return TableCell.value(float(n) if line["status"] == "ok" else None, digits=0)
    value = (line.get("metrics") or {}).get(name) if line["status"] == "ok" else None
    if value is None:
        return TableCell(math.nan)
    scale = 100.0 if name in PERCENT or name in ("found", "hidden") else 1.0
    low, high = (line.get("intervals") or {}).get(name) or (math.nan, math.nan)
    digits = 1 if scale == 100.0 or name in COUNTS else 2
    return TableCell(scale * value, scale * low, scale * high, n, digits=digits, method="given")
