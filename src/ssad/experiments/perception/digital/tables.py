"""Tables of a digital run beside the main one: transfer between detectors, defences, targets, distances."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

from ssad.experiments.perception.digital.run import (
    DigitalRun,
    Setting,
    defence_of,
    gained_cell,
    metric_cell,
    scenes_of,
    size_of,
    title_of,
)
from ssad.report.tables import Cell, Row, Table

FURTHEST = 32.0  # radius up to which curves are shown: what lies beyond is for the audit
BANDS = {"0-20": "0 to 20 m", "20-40": "20 to 40 m", "40+": "beyond 40 m"}


def transfer_table(run: DigitalRun) -> Table:
    """For each attack a matrix: mAP of the detector in the column under pictures made against that in the row."""
    rows = []
    for white_box in dict.fromkeys(entry._replace(source="") for entry in run.settings if entry.source):
        clean = tuple(metric_cell(run.clean(detector, white_box), "mAP") for detector in run.everyone)
        rows.append(Row((title_of(white_box), size_of(white_box), scenes_of(white_box), "nothing: clean"), clean))
        for source in run.everyone:
            records = [
                run.record(detector, white_box if detector == source else white_box._replace(source=source))
                for detector in run.everyone
            ]
            row_head = (title_of(white_box), size_of(white_box), scenes_of(white_box), source)
            rows.append(Row(row_head, tuple(metric_cell(record, "mAP") for record in records)))
    note = (
        "mAP in percent. Where row and column are of one detector the attack is white-box; elsewhere nothing was asked "
        f"of the detector that is shown the pictures.{run.about_flat}"
    )
    heads = ("Attack", "Budget", "Scenes", "Made against")
    return Table("transfer", "Transfer between detectors", heads, tuple(run.everyone), tuple(rows), note)


def defence_table(run: DigitalRun) -> Table:
    """Return detector x defence x attack: the cost of the defence on clean images, and its gain under attack."""
    rows = []
    for detector in run.detectors:
        settings_by_defence: dict[tuple[str, Setting], dict[bool, Setting]] = {}
        for setting in run.settings:
            if setting.defence and setting.attack:
                bare = setting._replace(defence="", aware=False, options=_without_draws(setting.options))
                settings_by_defence.setdefault((setting.defence, bare), {})[setting.aware] = setting
        for (_, bare), by_awareness in settings_by_defence.items():
            defended = next(iter(by_awareness.values()))
            records = [run.clean(detector, bare), run.clean(detector, defended)]
            records += [run.record(detector, bare)]
            records += [
                run.record(detector, by_awareness[aware]) if aware in by_awareness else None for aware in (False, True)
            ]
            row_head = (detector, defence_of(defended), title_of(bare), size_of(bare), scenes_of(bare))
            rows.append(Row(row_head, tuple(metric_cell(record, "mAP") for record in records)))
    note = (
        "mAP in percent. An attack that knows the defence follows gradients through it, of random resizing the mean "
        "over several draws; one that does not was made against the bare detector. What a defence is worth is what it "
        "leaves under an attack that knows it."
    )
    heads = ("Detector", "Defence", "Attack", "Budget", "Scenes")
    columns = ("clean", "clean, defended", "attacked", "attacked, defended; unaware", "attacked, defended; aware")
    return Table("defences", "Defences", heads, columns, tuple(rows), note)


def _without_draws(options: str) -> str:
    return " ".join(word for word in options.split() if not word.startswith("draws="))


def hardened_table(run: DigitalRun) -> Table:
    """Return adversarially trained weights beside ordinary ones, on the same images: their cost and their gain."""
    rows = []
    for name, ordinary in run.hardened:
        for setting in (entry for entry in run.settings if entry.radius <= FURTHEST and run.record(name, entry)):
            scores = [metric_cell(run.record(weights, setting), "mAP") for weights in (ordinary, name)]
            row_head = (name, title_of(setting), size_of(setting), scenes_of(setting))
            rows.append(Row(row_head, (*scores, gained_cell(run, (name, ordinary), setting, "mAP"))))
    note = (
        "mAP in percent, difference in points. Each is attacked by itself, white-box, on the same pictures. The clean "
        "rows say what adversarial training costs, the others what it buys."
    )
    heads = ("Detector", "Attack", "Budget", "Scenes")
    columns = ("ordinary weights", "adversarially trained", "difference")
    return Table("hardened", "Adversarial training", heads, columns, tuple(rows), note)


def black_box_table(run: DigitalRun) -> Table:
    """Return attacks that follow no gradient of the images that they change, beside noise of the same size."""
    rows = []
    for (detector, setting), record in run.records.items():
        if not setting.plain or setting.attack in ("", "noise") or record["status"] != "ok":
            continue
        if record["access"] == "white-box":
            continue
        noise = Setting("noise", norm=setting.norm, radius=setting.radius, subset=setting.subset)
        records = (run.clean(detector, setting), run.record(detector, noise), record)
        queries = Cell(float(record["queries"] or 0), digits=0)
        row_head = (detector, title_of(setting), size_of(setting), scenes_of(setting))
        rows.append(Row(row_head, (queries, *(metric_cell(entry, "mAP") for entry in records))))
    note = (
        "mAP in percent. Square and NES ask for losses; a universal change was fitted to other pictures (over=others) "
        "or to those of its own drive (over=drive), and asks nothing when it is added."
    )
    heads = ("Detector", "Attack", "Budget", "Scenes")
    columns = ("queries an image", "clean", "noise", "attacked")
    return Table("blackbox", "Without gradients", heads, columns, tuple(rows), note)


def target_table(run: DigitalRun) -> Table:
    """Return how often targeted attacks reach their target."""
    rows = []
    for (detector, setting), record in run.records.items():
        if setting.target and record["status"] == "ok":
            metrics = record["metrics"]
            count = metrics.get("targets")
            shares = (metrics.get(name) for name in ("success", "kept"))
            cells = [Cell(math.nan if share is None else 100 * share) for share in shares]
            cells.insert(1, Cell(math.nan if count is None else count, digits=0))
            row_head = (detector, title_of(setting), size_of(setting._replace(target="")), setting.target)
            rows.append(Row((*row_head, scenes_of(setting)), (*cells, metric_cell(record, "mAP"))))
    note = (
        "Success in percent of the objects that are found in the clean pictures, by the best box within 2 m with a "
        "score of at least 0.1: it is of the wanted class under the attack, or gone where no class is wanted. Others "
        "kept: percent of the found objects that were not attacked which are found under the attack too."
    )
    heads = ("Detector", "Attack", "Budget", "Target", "Scenes")
    return Table("targets", "Targeted attacks", heads, ("success", "objects", "others kept", "mAP"), tuple(rows), note)


def halving_table(run: DigitalRun) -> Table:
    """Return for each curve over the budget the radius that halves mAP, and the mAP at 1 px."""
    groups: dict[Setting, set[float]] = {}
    for setting in run.settings:
        if setting.plain and setting.attack not in ("", "noise", "ensemble"):
            groups.setdefault(setting._replace(radius=0.0), set()).add(setting.radius)
    rows = []
    for group, radii in groups.items():
        if len(radii) < 2:
            continue
        cells = []
        for detector in run.detectors:
            records = {0.0: run.clean(detector, group)}
            records |= {radius: run.record(detector, group._replace(radius=radius)) for radius in sorted(radii)}
            curve = [(radius, record["metrics"]["mAP"]) for radius, record in records.items() if record]
            if len(curve) < len(records):
                curve = []  # interpolation over a radius that has not run would mislead
            cells += [Cell(halving(curve)), metric_cell(records.get(1.0), "mAP")]
        settings_text = ", ".join(part for part in [f"{group.steps} steps", group.options] if part)
        rows.append(Row((title_of(group), settings_text, scenes_of(group)), tuple(cells)))
    columns = tuple(f"{d} {quantity}" for d in run.detectors for quantity in ("half of mAP at (px)", "mAP at 1 px (%)"))
    note = "The radius that leaves half of the clean mAP, on straight lines between the radii that ran."
    return Table("halving", "Smallest budgets that hurt", ("Attack", "Settings", "Scenes"), columns, tuple(rows), note)


def halving(curve: Sequence[tuple[float, float]]) -> float:
    """The radius at which a curve first falls to half of its first score.

    Args:
        curve: Radius and score, by radius; the first is the clean data.

    Returns:
        On straight lines between the points; NaN if it never falls so far, or the first score is 0.
    """
    half = curve[0][1] / 2 if curve else 0.0
    for (low, before), (high, after) in pairwise(curve):
        if after <= half < before:
            return low + (before - half) / (before - after) * (high - low)
    return math.nan


def distance_table(run: DigitalRun) -> Table:
    """Return scores of near and far objects under the attacks of the table."""
    names = [f"{metric}_{band}" for band in BANDS for metric in ("mAP", "recall")]
    rows = [
        Row(
            (detector, title_of(setting), size_of(setting)),
            tuple(metric_cell(run.record(detector, setting), name) for name in names),
        )
        for detector in run.detectors
        if not run.flat(detector)
        for setting in run.rows
    ]
    columns = tuple(f"{metric}, {band_title}" for band_title in BANDS.values() for metric in ("mAP", "recall"))
    note = (
        "Percent, by distance from the ego, boxes and truth each by their own. mAP is the mean over the classes that "
        "are there; recall is the share of objects with a box of their class within 2 m, whatever its score."
    )
    return Table("distances", "By distance", ("Detector", "Attack", "Budget"), columns, tuple(rows), note)
