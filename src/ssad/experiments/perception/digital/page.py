"""Page of a digital run: 3D detectors under digital attacks, the paper's numbers beside ours, and the audit."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, Literal

from ssad.experiments.perception.digital.run import (
    DigitalRun,
    Setting,
    circumstances,
    defence_of,
    load_digital_run,
    lost_cell,
    metric_cell,
    scenes_of,
    size_of,
    title_of,
)
from ssad.experiments.perception.digital.tables import (
    ATTACK,
    FURTHEST,
    SCENES,
    DetectorSetting,
    black_box_table,
    defence_table,
    distance_table,
    halving_table,
    hardened_table,
    target_table,
    transfer_table,
    with_detector,
)
from ssad.experiments.perception.shifts.page import CLASSES, interval_note, replicates_of
from ssad.metrics.attack_audit import RULES, Attempt, ReferenceComparison, Verdict, audit
from ssad.report.artefacts import pictures
from ssad.report.figures import CurvePoint, Panel, panels
from ssad.report.load import Run
from ssad.report.pages import render
from ssad.report.paper import DETECTORS, DIGITAL_STEPS
from ssad.report.paper import DIGITAL as PUBLISHED
from ssad.report.tables import Table, TableCell, TableRow

TEMPLATE = Path(__file__).with_name("page.html")

SOURCE = "published by the paper: nuScenes val, L-infinity attacks, epsilon 5 and ten steps"
PAPER = {("fgsm", "full"): "FGSM", ("pgd", "full"): "PGD", ("cw", "margin"): "C&W", ("", ""): ""}
EPSILON = 5.0
EFFORT = {
    "gradients": "gradients an image",
    "queries": "queries an image",
    "loss_before": "loss before",
    "loss_after": "loss after",
    "used": "budget used (%)",
    "change_px": "largest change (px)",
    "idle": "idle images",
    "gradient_error": "error of the gradient (%)",
    "batch": "images at once",
}


def published_scores(run: DigitalRun, setting: Setting) -> tuple[tuple[str, str], list[float]] | None:
    """Return the paper's row beside one of ours: attack and budget, and its scores by column; None: it has none."""
    attack, loss, norm, radius, _, options = setting[:6]
    published_attack = PAPER.get((attack, loss))
    options = " ".join(option for option in options.split() if not option.startswith("precision="))
    if (
        published_attack is None
        or not run.suite.get("reference")
        or options
        or (attack and (norm, radius) != ("linf", EPSILON))
    ):
        return None
    names = [
        next((title for prefix, title in DETECTORS.items() if detector.startswith(prefix)), "")
        for detector in run.detectors
    ]
    if not any(names):
        return None
    budget = size_of(Setting("told", "", "linf", EPSILON, DIGITAL_STEPS[published_attack])) if published_attack else ""
    scores = {
        detector: dict(zip(("mAP", "NDS"), PUBLISHED[published_attack].get(name, (math.nan, math.nan)), strict=True))
        for detector, name in zip(run.detectors, names, strict=True)
    }
    return (published_attack or title_of(setting), budget), [
        scores[detector][metric] for detector, metric in score_columns(run)
    ]


def score_columns(run: DigitalRun) -> dict[tuple[str, str], str]:
    """Return the columns of detector x score."""
    return {
        (detector, metric): f"{detector} {metric}" for detector in run.detectors for metric in run.metrics(detector)
    }


def main_table(run: DigitalRun) -> Table:
    """Return attack x detector: mAP and NDS, the paper's rows between ours."""

    def published(setting: Setting) -> list[TableRow]:
        published_row = published_scores(run, setting)
        return [TableRow.of_published(*published_row)] if published_row else []

    note = f"Percent; each camera image is attacked by itself, its stored 8-bit picture is scored; {interval_note(run)}"
    note += run.note_on_2d
    if any(published_scores(run, setting) for setting in run.rows):
        note += (
            f" Shaded rows: {SOURCE}; ours are other pictures and other detectors, so the share of the clean score "
            "that is lost can be compared, the level cannot."
        )
    return Table.listing(
        "digital",
        "Detection under digital attacks",
        run.rows,
        rows=ATTACK,
        columns=score_columns(run),
        metric=lambda setting, column: metric_cell(run.record(column[0], setting), column[1]),
        published=published,
        note=note,
        source=SOURCE,
    )


def lost_table(run: DigitalRun) -> Table:
    """Return attack x detector: the share of the clean score that is lost, the paper's shares between ours."""
    clean = published_scores(run, Setting())

    def published(setting: Setting) -> list[TableRow]:
        attacked = published_scores(run, setting)
        if attacked is None or clean is None:
            return []
        pairs = zip(attacked[1], clean[1], strict=True)
        return [TableRow.of_published(attacked[0], [100 * (1 - score / clean_score) for score, clean_score in pairs])]

    return Table.listing(
        "lost",
        "What an attack takes away",
        [setting for setting in run.rows if setting.attack],
        rows=ATTACK,
        columns=score_columns(run),
        metric=lambda setting, column: lost_cell(run, column[0], setting, column[1]),
        published=published,
        note="Percent of each detector's own clean score; more is a stronger attack.",
        source=SOURCE,
    )


def effort_table(run: DigitalRun) -> Table:
    """Return the cost of each attack, and its effect on the loss that it ascends."""

    def metric(row: DetectorSetting, name: str) -> TableCell:
        value = run.records[row].get(name)
        scale = 100 if name in ("used", "gradient_error") else 1
        return TableCell.value(
            None if value is None else float(value) * scale, digits=0 if name in ("idle", "batch") else 2
        )

    def is_direct(row: DetectorSetting) -> bool:
        setting = row[1]
        return bool(setting.attack) and not setting.source and (setting.aware or not setting.defence)

    return Table.listing(
        "effort",
        "What it took",
        [row for row, record in run.records.items() if is_direct(row) and record["status"] == "ok"],
        rows={
            **with_detector(ATTACK | SCENES),
            "Detector": lambda row: ", ".join(filter(None, [row[0], defence_of(row[1])])),
            "Access": lambda row: run.records[row]["access"],
        },
        columns=EFFORT,
        metric=metric,
        note="Means over the images. Idle images have no object for a loss that needs one and are left as they are. "
        "The error of the gradient is against finite differences, on the image with most objects of each scene."
        f"{short_of(run)}",
    )


def short_of(run: DigitalRun) -> str:
    """Return a remark if memory was too small for a batch; else ""."""
    halvings = sum(int(record.get("halved") or 0) for record in run.records.values())
    if not halvings:
        return ""
    count_text = "once" if halvings == 1 else f"{halvings} times"
    return f" Memory was short: batches were halved {count_text}; set a smaller batch to save this time."


def every_table(run: DigitalRun) -> Table:
    """Return every cell."""

    def metric(row: DetectorSetting, name: str) -> TableCell:
        if name == "lost":
            return lost_cell(run, *row, "mAP") if row[1].attack else TableCell.value(None)
        return metric_cell(run.record(*row), name)

    return Table.listing(
        "cells",
        "Every attack",
        run.records,
        rows=with_detector(ATTACK | {"Circumstances": circumstances} | SCENES),
        columns={"mAP": "mAP", "NDS": "NDS", "AP_car": "AP of cars", "lost": "mAP lost"},
        metric=metric,
        note="Percent.",
    )


def class_table(run: DigitalRun) -> Table:
    """Return the AP of each class under the attacks of the table."""
    return Table.listing(
        "classes",
        "By class",
        list(product(run.detectors, run.rows)),
        rows=with_detector(ATTACK),
        columns={f"AP_{class_name}": class_name.replace("_", " ") for class_name in CLASSES},
        metric=lambda row, name: metric_cell(run.record(*row), name),
        note="AP in percent; a class that is not in the data counts as 0 in mAP, as in the official evaluation.",
    )


def attempts_of(run: DigitalRun) -> list[Attempt]:
    """Return the cells of a run in the form of the audit."""
    attempts = []
    for (detector, setting), record in run.records.items():
        attack, loss, norm, radius, steps, options = setting[:6]
        clean_record = run.clean(detector, setting)
        if not attack or record["status"] != "ok" or clean_record is None:
            continue
        is_unaware = bool(setting.defence) and not setting.aware
        group = [defence_of(setting), setting.target, scenes_of(setting) if setting.subset else ""]
        attempts.append(
            Attempt(
                detector,
                attack,
                float(record["metrics"]["mAP"]),
                float(clean_record["metrics"]["mAP"]),
                loss,
                norm,
                radius,
                steps,
                record["access"],
                options,
                tuple(replicates_of(record, "mAP")),
                record["loss_before"],
                record["loss_after"],
                record["gradient_error"],
                record["coupling"],
                record["used"],
                record["change_px"],
                setting.source or ("the bare detector" if is_unaware else ""),
                ", ".join(filter(None, group)),
                tuple(_comparison(entry) for entry in record.get("references") or ()),
            )
        )
    return attempts


def _comparison(entry: Mapping[str, Any]) -> ReferenceComparison:
    """Return a comparison with the reference ensemble as a record holds it."""
    references = {name: (float(loss), float(quality)) for name, (loss, quality) in entry["references"].items()}
    return ReferenceComparison(
        entry["attack"], float(entry["loss_before"]), float(entry["loss"]), float(entry["quality"]), references
    )


def published_attempts() -> list[Attempt]:
    """Return the paper's own table in the form of the audit; it does not state the losses."""
    return [
        Attempt(
            f"{detector} (paper)",
            attack,
            scores[0] / 100,
            PUBLISHED[""][detector][0] / 100,
            radius=EPSILON,
            steps=DIGITAL_STEPS[attack],
        )
        for attack in DIGITAL_STEPS
        for detector, scores in PUBLISHED[attack].items()
    ]


def audit_sentence(found: Run) -> list[str]:
    """Return a sentence on the faults that the audit of the attacks found; empty if there are none."""
    faults = audit(attempts_of(load_digital_run(found))).faults
    if not faults:
        return []
    others = f" {len(faults) - 1} more: see the audit." if len(faults) > 1 else ""
    return [f"Audit of the attacks: {faults[0].detector}: {faults[0].text}.{others}"]


def audit_table(verdict: Verdict) -> Table:
    """Return how often each rule was applied, and how often it was broken."""
    faults = Counter(fault.rule for fault in verdict.faults)
    return Table.listing(
        "audit",
        "Audit of the attacks",
        RULES,
        rows={"Rule": lambda rule: RULES[rule][0]},
        columns={"comparisons": "comparisons", "faults": "faults"},
        metric=lambda rule, column: TableCell(faults[rule] if column == "faults" else verdict.compared[rule], digits=0),
        note=" ".join([verdict.text, *(f"{fault.detector}: {fault.text}." for fault in verdict.faults)]),
    )


def curves(run: DigitalRun, axis: Literal["radius", "steps"], metric: str = "mAP") -> str:
    """Plot a metric for each attack that ran over several radii or step counts, a line a detector; as SVG.

    Args:
        run: The run.
        axis: Swept parameter.
        metric: Name.

    Returns:
        SVG text; empty where nothing was swept.
    """
    groups: dict[Setting, set[float]] = {}
    for setting in run.settings:
        value = setting[3] if axis == "radius" else setting[4]
        if (
            setting.is_plain
            and setting.attack not in ("", "noise", "ensemble")
            and (axis == "steps" or value <= FURTHEST)
        ):
            groups.setdefault(_setting_at(setting, axis, 0), set()).add(value)
    plots = []
    for group, values in groups.items():
        if len(values) < 2:
            continue
        axis_values = [0.0, *sorted(values)]
        lines = []
        for detector in run.detectors:
            records = [
                run.record(detector, _setting_at(group, axis, axis_value)) if axis_value else run.clean(detector, group)
                for axis_value in axis_values
            ]
            lines.append(
                [
                    CurvePoint(value / axis_values[-1], metric_cell(record, metric), f"{detector}, {axis} {value:g}")
                    for value, record in zip(axis_values, records, strict=True)
                ]
            )
        ticks = [(value / axis_values[-1], f"{value:g}") for value in _spread_values(axis_values)]
        plots.append(Panel(f"{title_of(group)}; {_curve_title(group, axis)}", ticks, lines))
    return panels(plots, label=f"{metric} over {axis}", columns=3) if plots else ""


def _setting_at(setting: Setting, axis: Literal["radius", "steps"], value: float) -> Setting:
    """Return a setting with another radius, or other steps."""
    return setting._replace(radius=float(value)) if axis == "radius" else setting._replace(steps=int(value))


def _curve_title(setting: Setting, axis: str) -> str:
    """Return the fixed parameters of a curve: steps, or radius; and its scenes."""
    steps = setting.steps
    fixed_text = f"{steps} step{'s' if steps != 1 else ''}" if axis == "radius" else f"{setting.radius:g} px"
    scene_text = f"scenes: {scenes_of(setting)}" if setting.subset else ""
    return ", ".join(
        part for part in [fixed_text, "L2" if setting.norm == "l2" else "", setting.options, scene_text] if part
    )


def _spread_values(values: Sequence[float]) -> list[float]:
    """Return those of increasing values that can be written side by side along an axis, including the last."""
    spaced: list[float] = []
    for value in values[:-1]:
        if all(abs(value - neighbour) >= 0.08 * values[-1] for neighbour in [*spaced, values[-1]]):
            spaced.append(value)
    return [*spaced, values[-1]]


def tiles(run: DigitalRun) -> list[dict[str, Any]]:
    """Return the headline numbers of each detector: clean, and under the strongest attack of the table."""
    entries = []
    for detector in run.detectors:
        attack_scores = [
            (record["metrics"]["mAP"], setting)
            for setting in run.rows
            if setting.attack not in ("", "noise") and not setting.target and (record := run.record(detector, setting))
        ]
        strongest_attack = min(attack_scores)[1] if attack_scores else None
        clean_record = run.clean(detector)
        entries.append(
            {
                "name": detector,
                "mAP": metric_cell(clean_record, "mAP"),
                "NDS": metric_cell(clean_record, "NDS"),
                "worst": f"{title_of(strongest_attack)}; {size_of(strongest_attack)}"
                if strongest_attack
                else "no attack ran",
                "left": metric_cell(run.record(detector, strongest_attack), "mAP")
                if strongest_attack
                else TableCell(math.nan),
                "lost": lost_cell(run, detector, strongest_attack, "mAP") if strongest_attack else TableCell(math.nan),
            }
        )
    return entries


def summary(stored_run: Run) -> Table:
    """Return the table for the terminal: percent, and the verdict of the audit."""
    run = load_digital_run(stored_run)
    verdict = audit(attempts_of(run))
    lines = ["percent", verdict.text, *(f"{fault.detector}: {fault.text}" for fault in verdict.faults[:5])]
    lines += filter(None, [short_of(run).strip()])
    return replace(main_table(run), note="\n".join(lines))


def section(stored_run: Run, sentences: Sequence[str] = ()) -> tuple[str, Sequence[Table]]:
    """Return the page of a digital run and its tables."""
    run = load_digital_run(stored_run)
    verdict = audit(attempts_of(run))
    main_rows, losses, effort = main_table(run), lost_table(run), effort_table(run)
    all_cells, class_scores, audit_rows = every_table(run), class_table(run), audit_table(verdict)
    table_builders = (transfer_table, defence_table, hardened_table, black_box_table, target_table, halving_table)
    other_tables = [table for build_table in table_builders if (table := build_table(run)).rows]
    distances = distance_table(run)
    page = render(
        TEMPLATE,
        stored_run,
        verdict=sentences,
        others=other_tables,
        distances=distances,
        main=main_rows,
        lost=losses,
        effort=effort,
        every=all_cells,
        classes=class_scores,
        audit=audit_rows,
        audited=verdict,
        paper=audit(published_attempts()) if run.suite.get("reference") else None,
        tiles=tiles(run),
        plot=curves(run, "radius"),
        plot_steps=curves(run, "steps"),
        pictures=pictures(stored_run.folder),
        samples=max(int(r.get("n", 0)) for r in run.records.values()),
        scenes=run.scenes,
        failures=[
            (detector, title_of(setting), size_of(setting), circumstances(setting), record["reason"])
            for (detector, setting), record in run.records.items()
            if record["status"] != "ok"
        ],
    )
    return page, [main_rows, losses, *other_tables, audit_rows, effort, all_cells, class_scores, distances]
