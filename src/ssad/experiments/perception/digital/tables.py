"""Tables of a digital run beside the main one: transfer between detectors, defences, targets, distances."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import pairwise, product
from typing import Any

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
from ssad.report.tables import Table, TableCell

FURTHEST = 32.0  # radius up to which curves are shown: what lies beyond is for the audit
BANDS = {"0-20": "0 to 20 m", "20-40": "20 to 40 m", "40+": "beyond 40 m"}


ATTACK: dict[str, Callable[[Setting], str]] = {"Attack": title_of, "Budget": size_of}
"""Row factors of a setting."""
SCENES: dict[str, Callable[[Setting], str]] = {"Scenes": scenes_of}

DetectorSetting = tuple[str, Setting]


def with_detector(factors: Mapping[str, Callable[[Setting], str]]) -> dict[str, Callable[[DetectorSetting], str]]:
    """Return the row factors of a detector in a setting: the detector, and those of the setting."""
    return {"Detector": lambda row: row[0], **{head: partial(_of_setting, factor) for head, factor in factors.items()}}


def _of_setting(factor: Callable[[Setting], str], row: tuple[object, Setting]) -> str:
    return factor(row[1])


def transfer_table(run: DigitalRun) -> Table:
    """For each attack a matrix: mAP of the detector in the column under pictures made against that in the row."""
    white_boxes = dict.fromkeys(setting._replace(source="") for setting in run.settings if setting.source)

    def metric(row: tuple[str, Setting], detector: str) -> TableCell:
        source, white_box = row
        if not source:
            return metric_cell(run.clean(detector, white_box), "mAP")
        setting = white_box if detector == source else white_box._replace(source=source)
        return metric_cell(run.record(detector, setting), "mAP")

    return Table.listing(
        "transfer",
        "Transfer between detectors",
        [(source, white_box) for white_box in white_boxes for source in ("", *run.all_detectors)],
        rows={
            **{head: partial(_of_setting, factor) for head, factor in (ATTACK | SCENES).items()},
            "Made against": lambda row: row[0] or "nothing: clean",
        },
        columns={detector: detector for detector in run.all_detectors},
        metric=metric,
        note="mAP in percent. Where row and column are of one detector the attack is white-box; elsewhere nothing was "
        f"asked of the detector that is shown the pictures.{run.note_on_2d}",
    )


def defence_table(run: DigitalRun) -> Table:
    """Return detector x defence x attack: the cost of the defence on clean images, and its gain under attack."""
    defended_settings: dict[tuple[str, Setting], dict[bool, Setting]] = {}
    for setting in run.settings:
        if setting.defence and setting.attack:
            bare_setting = setting._replace(defence="", aware=False, options=_without_draws(setting.options))
            defended_settings.setdefault((setting.defence, bare_setting), {})[setting.aware] = setting

    def metric(row: tuple[str, tuple[str, Setting]], column: str) -> TableCell:
        detector, defence = row
        bare_setting, by_awareness = defence[1], defended_settings[defence]
        if column in ("clean", "defended"):
            sample_setting = bare_setting if column == "clean" else next(iter(by_awareness.values()))
            return metric_cell(run.clean(detector, sample_setting), "mAP")
        attacked = bare_setting if column == "attacked" else by_awareness.get(column == "aware")
        return metric_cell(run.record(detector, attacked) if attacked else None, "mAP")

    return Table.listing(
        "defences",
        "Defences",
        list(product(run.detectors, defended_settings)),
        rows={
            "Detector": lambda row: row[0],
            "Defence": lambda row: defence_of(next(iter(defended_settings[row[1]].values()))),
            **{head: partial(_of_bare, factor) for head, factor in (ATTACK | SCENES).items()},
        },
        columns={
            "clean": "clean",
            "defended": "clean, defended",
            "attacked": "attacked",
            "unaware": "attacked, defended; unaware",
            "aware": "attacked, defended; aware",
        },
        metric=metric,
        note="mAP in percent. An attack that knows the defence follows gradients through it, of random resizing the "
        "mean over several draws; one that does not was made against the bare detector. What a defence is worth is "
        "what it leaves under an attack that knows it.",
    )


def _of_bare(factor: Callable[[Setting], str], row: tuple[str, tuple[str, Setting]]) -> str:
    return factor(row[1][1])


def _without_draws(options: str) -> str:
    return " ".join(word for word in options.split() if not word.startswith("draws="))


def hardened_table(run: DigitalRun) -> Table:
    """Return adversarially trained weights beside ordinary ones, on the same images: their cost and their gain."""
    ordinary = dict(run.hardened)

    def metric(row: DetectorSetting, column: str) -> TableCell:
        name, setting = row
        if column == "difference":
            return gained_cell(run, (name, ordinary[name]), setting, "mAP")
        return metric_cell(run.record(ordinary[name] if column == "ordinary" else name, setting), "mAP")

    return Table.listing(
        "hardened",
        "Adversarial training",
        [
            (name, setting)
            for name in ordinary
            for setting in run.settings
            if setting.radius <= FURTHEST and run.record(name, setting)
        ],
        rows=with_detector(ATTACK | SCENES),
        columns={"ordinary": "ordinary weights", "hardened": "adversarially trained", "difference": "difference"},
        metric=metric,
        note="mAP in percent, difference in points. Each is attacked by itself, white-box, on the same pictures. The "
        "clean rows say what adversarial training costs, the others what it buys.",
    )


def black_box_table(run: DigitalRun) -> Table:
    """Return attacks that follow no gradient of the images that they change, beside noise of the same size."""

    def is_black_box(setting: Setting, record: Mapping[str, Any]) -> bool:
        attacked = setting.is_plain and setting.attack not in ("", "noise")
        return attacked and record["status"] == "ok" and record["access"] != "white-box"

    def metric(row: DetectorSetting, column: str) -> TableCell:
        detector, setting = row
        if column == "queries":
            return TableCell(float(run.records[row]["queries"] or 0), digits=0)
        if column == "clean":
            return metric_cell(run.clean(detector, setting), "mAP")
        noise = Setting("noise", norm=setting.norm, radius=setting.radius, subset=setting.subset)
        return metric_cell(run.record(detector, noise if column == "noise" else setting), "mAP")

    return Table.listing(
        "blackbox",
        "Without gradients",
        [row for row, record in run.records.items() if is_black_box(row[1], record)],
        rows=with_detector(ATTACK | SCENES),
        columns={"queries": "queries an image", "clean": "clean", "noise": "noise", "attacked": "attacked"},
        metric=metric,
        note="mAP in percent. Square and NES ask for losses; a universal change was fitted to other pictures "
        "(over=others) or to those of its own drive (over=drive), and asks nothing when it is added.",
    )


def target_table(run: DigitalRun) -> Table:
    """Return how often targeted attacks reach their target."""

    def metric(row: DetectorSetting, name: str) -> TableCell:
        if name == "mAP":
            return metric_cell(run.records[row], name)
        value = run.records[row]["metrics"].get(name)
        if name == "targets":
            return TableCell.value(value, digits=0)
        return TableCell.value(None if value is None else 100 * value)

    return Table.listing(
        "targets",
        "Targeted attacks",
        [row for row, record in run.records.items() if row[1].target and record["status"] == "ok"],
        rows=with_detector(
            {
                "Attack": title_of,
                "Budget": lambda setting: size_of(setting._replace(target="")),
                "Target": lambda setting: setting.target,
                **SCENES,
            }
        ),
        columns={"success": "success", "targets": "objects", "kept": "others kept", "mAP": "mAP"},
        metric=metric,
        note="Success in percent of the objects that are found in the clean pictures, by the best box within 2 m with "
        "a score of at least 0.1: it is of the wanted class under the attack, or gone where no class is wanted. Others "
        "kept: percent of the found objects that were not attacked which are found under the attack too.",
    )


def halving_table(run: DigitalRun) -> Table:
    """Return for each curve over the budget the radius that halves mAP, and the mAP at 1 px."""
    radii: dict[Setting, set[float]] = {}
    for setting in run.settings:
        if setting.is_plain and setting.attack not in ("", "noise", "ensemble"):
            radii.setdefault(setting._replace(radius=0.0), set()).add(setting.radius)

    def metric(group: Setting, column: tuple[str, str]) -> TableCell:
        detector, quantity = column
        records = {0.0: run.clean(detector, group)}
        records |= {radius: run.record(detector, group._replace(radius=radius)) for radius in sorted(radii[group])}
        if quantity.startswith("mAP"):
            return metric_cell(records.get(1.0), "mAP")
        curve = [(radius, record["metrics"]["mAP"]) for radius, record in records.items() if record]
        # interpolation over a radius that has not run would mislead
        return TableCell(halving(curve if len(curve) == len(records) else []))

    return Table.listing(
        "halving",
        "Smallest budgets that hurt",
        [group for group in radii if len(radii[group]) >= 2],
        rows={
            "Attack": title_of,
            "Settings": lambda group: ", ".join(filter(None, [f"{group.steps} steps", group.options])),
            **SCENES,
        },
        columns={
            (detector, quantity): f"{detector} {quantity}"
            for detector in run.detectors
            for quantity in ("half of mAP at (px)", "mAP at 1 px (%)")
        },
        metric=metric,
        note="The radius that leaves half of the clean mAP, on straight lines between the radii that ran.",
    )


def halving(curve: Sequence[tuple[float, float]]) -> float:
    """The radius at which a curve first falls to half of its first score.

    Args:
        curve: Radius and score, by radius; the first is the clean data.

    Returns:
        On straight lines between the points; NaN if it never falls so far, or the first score is 0.
    """
    half_score = curve[0][1] / 2 if curve else 0.0
    for (lower, score_before), (upper, score_after) in pairwise(curve):
        if score_after <= half_score < score_before:
            return lower + (score_before - half_score) / (score_before - score_after) * (upper - lower)
    return math.nan


def distance_table(run: DigitalRun) -> Table:
    """Return scores of near and far objects under the attacks of the table."""
    return Table.listing(
        "distances",
        "By distance",
        [row for row in product(run.detectors, run.rows) if not run.is_2d(row[0])],
        rows=with_detector(ATTACK),
        columns={
            f"{metric}_{band}": f"{metric}, {band_title}"
            for band, band_title in BANDS.items()
            for metric in ("mAP", "recall")
        },
        metric=lambda row, name: metric_cell(run.record(*row), name),
        note="Percent, by distance from the ego, boxes and truth each by their own. mAP is the mean over the classes "
        "that are there; recall is the share of objects with a box of their class within 2 m, whatever its score.",
    )
