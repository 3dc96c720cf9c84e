"""Detectors on photographs: docs/results/reality.md, a log of every evaluation, and figures in cards and pages.

    python -m benchmarks.reality DATA [--human ARCHIVE] [--name NAME]   # measures, and appends to the log
    python -m benchmarks.reality --page                                 # writes the page from what was measured

DATA: a folder of annotated photographs (docs/how-to/test-on-photographs.md). ARCHIVE: the file that `npm pack
@vladmandic/human` writes; without it, the detector that learned from photographs is left out. The suite is `reality`,
as shipped: nothing in it was chosen on photographs. Each evaluation of a detector is a line of
benchmarks/results/reality-log.jsonl, which is never shortened.
"""

from __future__ import annotations

import argparse
import json
import subprocess
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch

import ssad
from benchmarks.insert import DOCS
from ssad.core.checkpoints import state_hash
from ssad.core.safeio import dump_json
from ssad.detectors import SHIPPED, make_detector

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "reality.json"
LOG = ROOT / "benchmarks" / "results" / "reality-log.jsonl"
PAGE = DOCS / "results" / "reality.md"
FLAT = ("yolov5n", "yolov3-tiny")
SOLID = ROOT / "benchmarks" / "reality-solid.yaml"
PHOTO = "centernet-photo"
PROBE = ("yolov5n", "adv-patch-yolov5n-twinford")
METRICS = ("recall", "precision", "AP50", "margin")


def commit() -> str:
    """Return the commit of this version and its date."""
    words = ["git", "-C", str(ROOT), "log", "-1", "--format=%h (%cs)", "--abbrev=7"]
    return subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip()


def measure(data: Path, archive: Path | None, name: str, out: Path) -> None:
    """Run the suite on a folder, keep its records, and log each detector."""
    flat = [*FLAT, *([f"centernet:{archive}@{PHOTO}"] if archive else [])]
    records: list[Mapping[str, Any]] = []
    identity: Mapping[str, Any] = {}
    weights: dict[str, str] = {}
    settings: dict[str, Any] = {}
    # Textures are made for 2D detectors; 3D ones are shown the clean photographs.
    for suite, changes in (("reality", {"detectors": flat}), (str(SOLID), {})):
        results = ssad.run(suite, set={"data": str(data), **changes}, out=out / Path(suite).stem, workers=1)
        records += [row for row in results.rows if row["status"] == "ok"]
        identity = results.header["data"]
        settings = settings or {key: results.header["suite"][key] for key in ("score", "draws", "wearer_height")}
        weights |= {key.rpartition("@")[2]: value for key, value in results.header["weights"].items()}
    stored = json.loads(RESULTS.read_text()) if RESULTS.is_file() else {}
    entry = {
        "data": dict(identity),
        "commit": commit(),
        "torch": torch.__version__.partition("+")[0],
        "weights": weights,
        **settings,
        "rows": [
            {
                key: row.get(key)
                for key in ("detector", "texture", "pasted", "n", "cars", "images", "metrics", "intervals", "parts")
            }
            for row in records
        ],
    }
    RESULTS.write_text(dump_json(stored | {name: entry}, indent=1) + "\n")
    log_evaluations(records, weights, name, identity)


def measure_candidates(data: Path, candidates: Sequence[tuple[str, str]], name: str, out: Path) -> None:
    """Log how weights that are not shipped do on a folder of photographs.

    Args:
        data: Folder of photographs.
        candidates: Detector of the suite, such as `yolov5n@NAME=FILE`, and what was changed in its training.
        name: Name of the photographs on the page.
        out: Folder of results.
    """
    detectors = [detector for detector, _ in candidates]
    results = ssad.run("reality", set={"data": str(data), "detectors": detectors, "textures": []}, out=out, workers=1)
    weights = {key.partition("=")[0]: value for key, value in results.header["weights"].items()}
    changes = {detector.partition("=")[0]: change for detector, change in candidates}
    # The log names the architecture beside the label.
    names = {detector.rpartition("@")[2]: detector for detector in changes}
    records = [dict(row) | {"detector": names[row["detector"]]} for row in results.rows if row["status"] == "ok"]
    log_evaluations(records, weights, name, results.header["data"], changes)


def log_evaluations(
    records: Sequence[Mapping[str, Any]],
    weights: Mapping[str, str],
    name: str,
    identity: Mapping[str, Any],
    changes: Mapping[str, str] | None = None,
) -> None:
    """Append each evaluation on photographs to the log."""
    with LOG.open("a") as log:
        for row in records:
            line = {
                "date": datetime.now(UTC).strftime("%Y-%m-%d"),
                "commit": commit(),
                "data": f"{name}, {identity['photographs']} photographs, {identity['hash']}",
                "detector": row["detector"],
                "weights": weights[row["detector"]].split()[0],
                "texture": " ".join(filter(None, (row["texture"], row["pasted"]))),
                "metrics": row["metrics"],
            }
            if changes:
                line["change"] = changes[row["detector"]]
            log.write(dump_json(line) + "\n")


def number(row: Mapping[str, Any], name: str, *, scale: float = 100.0, digits: int = 0) -> str:
    """Return a metric with its interval, as text."""
    value = row["metrics"].get(name)
    if value is None:
        return "n/a"
    text = f"{scale * value:.{digits}f}"
    limits = (row.get("intervals") or {}).get(name)
    return text if limits is None else f"{text} [{scale * limits[0]:.{digits}f}, {scale * limits[1]:.{digits}f}]"


def clean_rows(entry: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the rows of the clean photographs."""
    return [row for row in entry["rows"] if row["pasted"] == "clean"]


def detector_table(entry: Mapping[str, Any]) -> list[str]:
    """Return the scores of all detectors on the clean photographs."""
    lines = [
        "| Detector | Learned from | Objects | Recall, % | Precision, % | AP50, % | Score margin, points | "
        "Boxes per photograph | Wrong ones |",
        "|---|---|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for row in clean_rows(entry):
        source = "photographs (COCO)" if row["detector"] == PHOTO else "SSAD's images"
        figures = [number(row, name) for name in METRICS]
        counts = [number(row, name, scale=1.0, digits=1) for name in ("boxes", "wrong")]
        lines.append(f"| `{row['detector']}` | {source} | {row['n']} | " + " | ".join([*figures, *counts]) + " |")
    return lines


def part_table(entry: Mapping[str, Any], kind: str) -> list[str]:
    """Return recall and AP50 of all detectors by class or by height."""
    rows = clean_rows(entry)
    names = list(dict.fromkeys(part["name"] for row in rows for part in row["parts"] if part["by"] == kind))
    heads = [f"`{row['detector']}`" for row in rows]
    lines = [
        f"| {kind.capitalize()} | {' | '.join(f'{head} recall, % (objects) | AP50, %' for head in heads)} |",
        "|---|" + "---:|---:|" * len(rows),
    ]
    for name in names:
        cells = []
        for row in rows:
            part = next((part for part in row["parts"] if part["by"] == kind and part["name"] == name), None)
            cells += (
                ["", ""]
                if part is None
                else [f"{number(part, 'recall').split()[0]} ({part['n']})", number(part, "AP50").split()[0]]
            )
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return lines


def texture_table(entry: Mapping[str, Any]) -> list[str]:
    """Return the cars that wear textures, beside their controls and the same cars clean."""
    lines = [
        "| Detector | Texture | Pasted | Cars | Found, % | Mean score | Hidden, % |",
        "|---|---|---|---:|---:|---:|---:|",
    ]
    texture_rows = [row for row in entry["rows"] if row["pasted"] != "clean"]
    for detector in dict.fromkeys(row["detector"] for row in texture_rows):
        clean = next(row for row in clean_rows(entry) if row["detector"] == detector)
        for row in [clean, *(row for row in texture_rows if row["detector"] == detector)]:
            texture = f"`{row['texture']}`" if row["texture"] else ""
            cells = [number(row, "found"), number(row, "score", scale=1.0, digits=2), number(row, "hidden")]
            lines.append(
                f"| `{detector}` | {texture} | {row['pasted']} | {row.get('cars') or row['n']} | {' | '.join(cells)} |"
            )
    return lines


def probe(entry: Mapping[str, Any]) -> str:
    """Return the scores of real cars with a patch and its controls, in sentences."""
    detector, texture = PROBE
    clean = next(row for row in clean_rows(entry) if row["detector"] == detector)
    rows = {row["pasted"]: row for row in entry["rows"] if row["detector"] == detector and row["texture"] == texture}
    mean = {name: f"{row['metrics']['score']:.2f}" for name, row in {"clean": clean, **rows}.items()}
    hidden = {name: f"{100 * row['metrics']['hidden']:.0f} %" for name, row in rows.items()}
    return (
        f"On {clean['cars']} real cars in photographs `{detector}` has a mean score of {mean['clean']} without a "
        f"print, {mean['random']} with random patches, {mean['shuffled']} with shuffled ones and {mean['trained']} "
        f"with the shipped Adv. Patch. Of the cars that it finds, random patches hide {hidden['random']}, shuffled "
        f"ones {hidden['shuffled']} and the trained one {hidden['trained']} ([all figures](../results/reality.md))."
    )


def summary_of(entry: Mapping[str, Any], detector: str) -> str:
    """Return the objects that a detector finds in photographs, and its wrong boxes, in a clause."""
    row = next(row for row in clean_rows(entry) if row["detector"] == detector)
    found_count = round(row["metrics"]["recall"] * row["n"])
    wrong_boxes = f"{row['metrics']['wrong']:.1f} wrong boxes in a photograph"
    return f"{found_count} of the {row['n']} objects of its classes, with {wrong_boxes}"


def evaluations() -> list[str]:
    """Return the log of evaluations of clean photographs, and the number of those with textures."""
    rows = [json.loads(line) for line in LOG.read_text().splitlines()]
    clean = [row for row in rows if row["texture"] == "clean"]
    lines = [
        f"{len(rows)} evaluations so far, {len(clean)} of them on clean photographs; "
        "`benchmarks/results/reality-log.jsonl` has them all.",
        "",
        "| Date | Commit | Photographs | Detector | Weights | Change of the training | Recall, % | AP50, % | "
        "Wrong boxes |",
        "|---|---|---|---|---|---|---:|---:|---:|",
    ]
    for row in clean:
        figures = row["metrics"]
        lines.append(
            f"| {row['date']} | {row['commit'].split()[0]} | {row['data']} | `{row['detector']}` | {row['weights']} | "
            f"{row.get('change', 'as shipped')} | {100 * figures['recall']:.0f} | {100 * figures['AP50']:.0f} | "
            f"{figures['wrong']:.1f} |"
        )
    return lines


def write_page() -> None:
    """Write the page, the passages of other pages that quote it, and the figures in the cards of the weights."""
    stored: Mapping[str, Any] = json.loads(RESULTS.read_text())
    first = next(iter(stored.values()))
    weights = ", ".join(f"`{name}` {value.split()[0]}" for name, value in first["weights"].items())
    lines = [
        "# Detectors on photographs",
        "",
        f"> **Stored result.** Commit: {first['commit']}. Weights: {weights}. Torch: {first['torch']}. Make it anew: "
        "`python -m benchmarks.reality DATA --human ARCHIVE`, then `python -m benchmarks.reality --page`.",
        "",
        "The shipped detectors learned from images that SSAD renders. None of them has seen a photograph. This page "
        "has their scores in photographs, beside a detector that learned from photographs (COCO): the CenterNet of "
        "the npm package `@vladmandic/human` "
        "([how to use it](../how-to/use-detectors.md#a-detector-that-learned-from-photographs)).",
        "",
        "How to read it: [test detectors on photographs](../how-to/test-on-photographs.md). Nothing in the suite "
        "`reality` was chosen on photographs, and no detector of SSAD is trained on them. Brackets: 95 % interval by "
        "the bootstrap over photographs. It takes them as independent; where several are of one drive or one moment, "
        "it is too narrow.",
    ]
    for name, entry in stored.items():
        data = entry["data"]
        lines += [
            "",
            f"## {name}: {data['photographs']} photographs, {data['objects']} objects",
            "",
            *detector_table(entry),
            "",
            f"At a score of {entry['score']:g} and an IoU of one half; AP50 over all scores. The score margin is the "
            f"mean score with which an object is found (0: not at all), less {entry['score']:g}. Each detector is "
            "scored on the classes that it knows.",
            "",
            "### By class",
            "",
            *part_table(entry, "class"),
            "",
            "### By height of the object in the photograph",
            "",
            *part_table(entry, "height"),
            "",
            "### Textures and their controls on the cars",
            "",
            "Each texture is pasted onto the rear, or the front, of every car that shows it: at least "
            f"{entry['wearer_height']:g} px high, not cut, not behind another object. Random and shuffled squares are "
            f"means of {entry['draws']} draws. Where a control hides as much as the texture, the texture proves "
            "nothing. Fewer than five photographs with such cars have no interval.",
            "",
            *texture_table(entry),
        ]
    lines += ["", "## Log of the evaluations", "", *evaluations(), ""]
    PAGE.write_text("\n".join(lines))
    insert_sentence("reference/physical.md", "probe on real cars", probe(first))
    for page, folder in (("explanation/limits.md", "../results"), ("../README.md", "docs/results")):
        insert_sentence(page, "photographs", quotation(first, folder))
    for row in clean_rows(first):
        card = SHIPPED / f"{row['detector']}.json"
        measured = first["weights"][row["detector"]].split()[0]
        # Figures of other weights say nothing about these.
        if card.is_file() and state_hash(make_detector(row["detector"])) == measured:
            content = json.loads(card.read_text())
            figures = {name: row["metrics"][name] for name in (*METRICS, "wrong")} | {"objects": row["n"]}
            content["photographs"] = {name: value for name, value in figures.items() if value is not None}
            content.setdefault("learned_from", "images that SSAD rendered; no photographs")
            card.write_text(dump_json(dict(sorted(content.items())), indent=1) + "\n")


def quotation(entry: Mapping[str, Any], folder: str) -> str:
    """Return the scores of detectors in photographs, in a sentence for another page.

    Args:
        entry: Results on some photographs.
        folder: Folder of the page of results, as a link from the other page.
    """
    compared = (
        f"; a detector that learned from photographs finds {summary_of(entry, PHOTO)}" if _has(entry, PHOTO) else ""
    )
    return (
        f"In the {entry['data']['photographs']} photographs of [the results]({folder}/reality.md) `yolov5n` finds "
        f"{summary_of(entry, 'yolov5n')}{compared}."
    )


def insert_sentence(page: str, mark: str, sentence: str) -> None:
    """Put a sentence between `<!-- MARK: begin -->` and `<!-- MARK: end -->` of a page, in its line."""
    path, begin, end = DOCS / page, f"<!-- {mark}: begin -->", f"<!-- {mark}: end -->"
    before, _, after = path.read_text().partition(begin)
    path.write_text(before + begin + sentence + end + after.partition(end)[2])


def _has(entry: Mapping[str, Any], detector: str) -> bool:
    return any(row["detector"] == detector for row in entry["rows"])


def main(words: Sequence[str] | None = None) -> None:
    """Measure, or write the page."""
    parser = argparse.ArgumentParser(description="Detectors on photographs.")
    parser.add_argument("data", nargs="?", type=Path)
    parser.add_argument("--human", type=Path, help="archive of @vladmandic/human")
    parser.add_argument("--name", default="street", help="name of the photographs on the page")
    parser.add_argument("--out", type=Path, default=Path("runs/reality"))
    parser.add_argument(
        "--candidate",
        nargs=2,
        action="append",
        metavar=("DETECTOR", "CHANGE"),
        help="log weights that are not shipped, as yolov5n@NAME=FILE, and what was changed in their training",
    )
    parser.add_argument("--page", action="store_true", help="write the page")
    options = parser.parse_args(words)
    if options.candidate and not options.data:
        parser.error("name the folder of photographs for --candidate")
    if options.candidate:
        measure_candidates(options.data, options.candidate, options.name, options.out)
    elif options.data:
        measure(options.data, options.human, options.name, options.out)
    if options.page:
        write_page()
    elif not options.data:
        parser.error("name a folder of photographs, or --page")


if __name__ == "__main__":
    main()
