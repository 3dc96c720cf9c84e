"""Page of a run on photographs: scores of each detector, by class and by height, and textures beside their controls."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ssad.experiments.perception.reality.worn_textures import CLEAN
from ssad.report.artefacts import pictures
from ssad.report.load import Run
from ssad.report.pages import render
from ssad.report.records import Line, field
from ssad.report.tables import Table, TableCell

TEMPLATE = Path(__file__).with_name("page.html")
PERCENT = {"recall": "recall, %", "precision": "precision, %", "AP50": "AP50, %", "margin": "score margin, points"}
COUNTS = {"boxes": "boxes per photograph", "wrong": "wrong boxes per photograph"}
WORN = {"found": "found, %", "score": "mean score", "change": "change", "hidden": "hidden, %"}
INTERVALS = (
    "95 % intervals by the bootstrap over photographs, where there are at least five; they take photographs as "
    "independent, and are too narrow where several are of one drive or one moment. Objects that a form ignores, and "
    "those below the least height, count neither as found nor as missed."
)


def section(run: Run, verdict: Sequence[str]) -> tuple[str, Sequence[Table]]:
    """Return the page of a run, with its leading sentences, and its tables."""
    tables = [main_table(run), part_table(run, "class"), part_table(run, "height")]
    textures = texture_table(run)
    tables += [textures] if textures.rows else []
    failures = [
        (
            [field(name)(record) for name in ("detector", "texture", "pasted")],
            record["status"],
            record.get("reason", ""),
        )
        for record in run.failures
    ]
    page = render(
        TEMPLATE,
        run,
        verdict=verdict,
        tables=tables,
        failures=[[*heads, f"{status}: {reason}" if reason else status] for heads, status, reason in failures],
        pictures=pictures(run.folder),
        data=run.header.get("data", {}),
    )
    return page, tables


def clean_lines(run: Run) -> list[Line]:
    """Return the records of clean photographs."""
    return [record for record in run.lines if record["pasted"] == CLEAN]


def main_table(run: Run) -> Table:
    """Return the scores of each detector on the clean photographs."""
    score = run.suite["score"]
    return Table.listing(
        "photographs",
        "Detectors on photographs",
        clean_lines(run),
        rows={"Detector": field("detector")},
        columns={"n": "objects", **PERCENT, **COUNTS},
        metric=lambda record, name: number_of(record, name, record.get("n", 0)),
        note=(
            f"Recall, precision and numbers of boxes at a score of {score:g}, AP50 over all scores, mean over the "
            f"classes that occur. Score margin: mean score with which an object is found (0: not at all), less "
            f"{score:g}. {INTERVALS}"
        ),
    )


def part_table(run: Run, part_kind: str) -> Table:
    """Return the scores by class or by height of the object."""
    return Table.listing(
        f"photographs-{part_kind}",
        f"By {'height of the object' if part_kind == 'height' else part_kind}",
        list(_parts(run, part_kind)),
        rows={
            "Detector": lambda part_record: part_record["detector"],
            part_kind.capitalize(): lambda part_record: part_record["name"],
        },
        columns={"n": "objects", **PERCENT},
        metric=lambda part_record, name: number_of(part_record, name, part_record["n"]),
        note="Of a height: boxes of another height that find nothing are left out, as COCO does with areas."
        if part_kind == "height"
        else "A detector is scored on the classes that it knows.",
    )


def _parts(run: Run, part_kind: str) -> Iterator[Mapping[str, Any]]:
    for record in clean_lines(run):
        for part_record in record.get("parts") or []:
            if part_record["by"] == part_kind:
                yield {"detector": record["detector"], "status": "ok", **part_record}


def texture_table(run: Run) -> Table:
    """Return the cars that wear a texture, beside those that wear its controls and the same cars clean."""
    worn = [record for record in run.lines if record["pasted"] != CLEAN]
    by_detector = {record["detector"]: record for record in clean_lines(run)}
    records = []
    for detector in dict.fromkeys(record["detector"] for record in worn):
        records += [by_detector[detector]] if detector in by_detector else []
        records += [record for record in worn if record["detector"] == detector]
    return Table.listing(
        "textures",
        "Textures on cars in photographs",
        records,
        rows={
            "Detector": field("detector"),
            "Texture": lambda record: record["texture"] or "none",
            "Pasted": field("pasted"),
        },
        columns={"n": "cars", **WORN},
        metric=lambda record, name: number_of(record, name, record.get("cars", record.get("n", 0))),
        note=(
            f"Found: share of the cars that a box of at least {run.suite['score']:g} finds; hidden: of those found "
            "clean, the share that is not found. A control is not trained: where it hides as much, the texture proves "
            "nothing. Controls are means over their draws. " + INTERVALS
        ),
    )


def number_of(record: Mapping[str, Any], name: str, object_count: int) -> TableCell:
    """Return a metric of a record or of one of its parts, with its interval; shares in percent."""
    if name == "n":
        return TableCell.value(float(object_count) if record["status"] == "ok" else None, digits=0)
    value = (record.get("metrics") or {}).get(name) if record["status"] == "ok" else None
    if value is None:
        return TableCell(math.nan)
    scale = 100.0 if name in PERCENT or name in ("found", "hidden") else 1.0
    low, high = (record.get("intervals") or {}).get(name) or (math.nan, math.nan)
    digits = 1 if scale == 100.0 or name in COUNTS else 2
    return TableCell(scale * value, scale * low, scale * high, object_count, digits=digits, method="given")
