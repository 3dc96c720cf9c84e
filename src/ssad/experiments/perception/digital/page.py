"""The page of a digital run: 3D detectors under digital attacks, the paper's numbers beside ours, and the audit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
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
    FURTHEST,
    black_box_table,
    defence_table,
    distance_table,
    halving_table,
    hardened_table,
    target_table,
    transfer_table,
)
from ssad.experiments.perception.shifts.page import CLASSES, interval_note, replicates_of
from ssad.metrics.attack_audit import RULES, Attempt, Verdict, audit
from ssad.report.artefacts import pictures
from ssad.report.curves import Panel, Point, panels
from ssad.report.load import Run
from ssad.report.pages import render
from ssad.report.paper import DETECTORS, DIGITAL_STEPS
from ssad.report.paper import DIGITAL as PUBLISHED
from ssad.report.tables import Cell, Row, Table

TEMPLATE = Path(__file__).with_name("page.html")

SOURCE = "published by the paper: nuScenes val, L-infinity attacks, epsilon 5 and ten steps"
PAPER = {("fgsm", "full"): "FGSM", ("pgd", "full"): "PGD", ("cw", "margin"): "C&W", ("", ""): ""}
EPSILON = 5.0


def published_row(run: DigitalRun, setting: Setting) -> tuple[tuple[str, str], list[tuple[float, ...]]] | None:
    """The paper's row beside one of ours: its name and budget, and the metrics of each detector; None: it has none."""
    attack, loss, norm, radius, _, options = setting[:6]
    told = PAPER.get((attack, loss))
    options = " ".join(word for word in options.split() if not word.startswith("precision="))
    if told is None or not run.suite.get("reference") or options or (attack and (norm, radius) != ("linf", EPSILON)):
        return None
    names = [next((v for k, v in DETECTORS.items() if d.startswith(k)), "") for d in run.detectors]
    if not any(names):
        return None
    size = size_of(Setting("told", "", "linf", EPSILON, DIGITAL_STEPS[told])) if told else ""
    head = (told or title_of(setting), size)
    pairs = zip(run.detectors, names, strict=True)
    return head, [PUBLISHED[told].get(name, (math.nan, math.nan))[: len(run.metrics(d))] for d, name in pairs]


def main_table(run: DigitalRun) -> Table:
    """Attack x detector: mAP and NDS, the paper's rows between ours."""
    rows = []
    for setting in run.rows:
        head = (title_of(setting), size_of(setting))
        cells = [metric_cell(run.record(d, setting), metric) for d in run.detectors for metric in run.metrics(d)]
        rows.append(Row(head, tuple(cells)))
        told = published_row(run, setting)
        if told:
            rows.append(Row(told[0], tuple(Cell(v) for pair in told[1] for v in pair), published=True))
    columns = tuple(f"{d} {metric}" for d in run.detectors for metric in run.metrics(d))
    note = f"Percent; each camera image is attacked by itself, its stored 8-bit picture is scored; {interval_note(run)}"
    note += run.about_flat
    if any(row.published for row in rows):
        note += (
            f" Shaded rows: {SOURCE}; ours are other pictures and other detectors, so the share of the clean score "
            "that is lost can be compared, the level cannot."
        )
    return Table("digital", "Detection under digital attacks", ("Attack", "Budget"), columns, tuple(rows), note, SOURCE)


def lost_table(run: DigitalRun) -> Table:
    """Attack x detector: the share of the clean score that is lost, the paper's shares between ours."""
    rows = []
    clean = published_row(run, Setting())
    for setting in (s for s in run.rows if s[0]):
        head = (title_of(setting), size_of(setting))
        cells = [lost_cell(run, d, setting, metric) for d in run.detectors for metric in run.metrics(d)]
        rows.append(Row(head, tuple(cells)))
        told = published_row(run, setting)
        if told and clean:
            shares = [
                100 * (1 - a / b)
                for after, before in zip(told[1], clean[1], strict=True)
                for a, b in zip(after, before, strict=True)
            ]
            rows.append(Row(told[0], tuple(Cell(share) for share in shares), published=True))
    columns = tuple(f"{d} {metric}" for d in run.detectors for metric in run.metrics(d))
    note = "Percent of each detector's own clean score; more is a stronger attack."
    return Table("lost", "What an attack takes away", ("Attack", "Budget"), columns, tuple(rows), note, SOURCE)


def effort_table(run: DigitalRun) -> Table:
    """What each attack took, and what it did to the loss that it ascends."""
    names = ("gradients", "queries", "loss_before", "loss_after", "used", "change_px", "idle", "gradient_error")
    columns = (
        "gradients an image",
        "queries an image",
        "loss before",
        "loss after",
        "budget used (%)",
        "largest change (px)",
        "idle images",
        "error of the gradient (%)",
        "images at once",
    )
    rows = []
    for (detector, setting), record in run.records.items():
        if not setting.attack or setting.source or record["status"] != "ok" or (setting.defence and not setting.aware):
            continue
        values = [record.get(name) for name in (*names, "batch")]
        scaled = [
            Cell(
                math.nan if v is None else float(v) * (100 if n in ("used", "gradient_error") else 1),
                digits=0 if n in ("idle", "batch") else 2,
            )
            for n, v in zip((*names, "batch"), values, strict=True)
        ]
        system = ", ".join(part for part in [detector, defence_of(setting)] if part)
        head = (system, title_of(setting), size_of(setting), scenes_of(setting), record["access"])
        rows.append(Row(head, tuple(scaled)))
    note = (
        "Means over the images. Idle images have no object for a loss that needs one and are left as they are. The "
        "error of the gradient is against finite differences, on the image with most objects of each scene."
        f"{short_of(run)}"
    )
    return Table(
        "effort", "What it took", ("Detector", "Attack", "Budget", "Scenes", "Access"), columns, tuple(rows), note
    )


def short_of(run: DigitalRun) -> str:
    """Where memory did not suffice, that it did not; else ""."""
    halved = sum(int(record.get("halved") or 0) for record in run.records.values())
    if not halved:
        return ""
    times = "once" if halved == 1 else f"{halved} times"
    return f" Memory was short: batches were halved {times}; set a smaller batch to save this time."


def every_table(run: DigitalRun) -> Table:
    """Every cell."""
    rows = []
    for (detector, setting), record in run.records.items():
        own = record if record["status"] == "ok" else None
        cells = [metric_cell(own, metric) for metric in ("mAP", "NDS", "AP_car")]
        lost = lost_cell(run, detector, setting, "mAP") if setting[0] else Cell(math.nan)
        head = (detector, title_of(setting), size_of(setting), circumstances(setting), scenes_of(setting))
        rows.append(Row(head, (*cells, lost)))
    columns = ("mAP", "NDS", "AP of cars", "mAP lost")
    heads = ("Detector", "Attack", "Budget", "Circumstances", "Scenes")
    return Table("cells", "Every attack", heads, columns, tuple(rows), "Percent.")


def class_table(run: DigitalRun) -> Table:
    """AP of each class under the attacks of the table."""
    rows = [
        Row((d, title_of(s), size_of(s)), tuple(metric_cell(run.record(d, s), f"AP_{c}") for c in CLASSES))
        for d in run.detectors
        for s in run.rows
    ]
    note = "AP in percent; a class that is not in the data counts as 0 in mAP, as in the official evaluation."
    columns = tuple(c.replace("_", " ") for c in CLASSES)
    return Table("classes", "By class", ("Detector", "Attack", "Budget"), columns, tuple(rows), note)


def attempts_of(run: DigitalRun) -> list[Attempt]:
    """The cells of a run as the audit reads them."""
    found = []
    for (detector, setting), record in run.records.items():
        attack, loss, norm, radius, steps, options = setting[:6]
        clean = run.clean(detector, setting)
        if not attack or record["status"] != "ok" or clean is None:
            continue
        unaware = bool(setting.defence) and not setting.aware
        group = [defence_of(setting), setting.target, scenes_of(setting) if setting.subset else ""]
        found.append(
            Attempt(
                detector,
                attack,
                float(record["metrics"]["mAP"]),
                float(clean["metrics"]["mAP"]),
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
                setting.source or ("the bare detector" if unaware else ""),
                ", ".join(filter(None, group)),
            )
        )
    return found


def published_attempts() -> list[Attempt]:
    """The paper's own table as the audit reads it; which losses were ascended it does not say."""
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


def audit_table(verdict: Verdict) -> Table:
    """How often each rule was applied, and how often it was broken."""
    rows = [
        Row(
            (text,),
            tuple(
                Cell(count, digits=0)
                for count in (verdict.compared[name], sum(fault.rule == name for fault in verdict.faults))
            ),
        )
        for name, (text, _) in RULES.items()
    ]
    note = " ".join([verdict.text, *(f"{fault.detector}: {fault.text}." for fault in verdict.faults)])
    return Table("audit", "Audit of the attacks", ("Rule",), ("comparisons", "faults"), tuple(rows), note)


def curves(run: DigitalRun, what: Literal["radius", "steps"], metric: str = "mAP") -> str:
    """A small plot for each attack that ran over several radii or step counts: the metric, a line a detector; as SVG.

    Args:
        run: The run.
        what: What is swept.
        metric: Name.

    Returns:
        SVG text; empty where nothing was swept.
    """
    groups: dict[Setting, set[float]] = {}
    for setting in run.settings:
        value = setting[3] if what == "radius" else setting[4]
        if setting.plain and setting.attack not in ("", "noise", "ensemble") and (what == "steps" or value <= FURTHEST):
            groups.setdefault(_at(setting, what, 0), set()).add(value)
    found = []
    for group, values in groups.items():
        if len(values) < 2:
            continue
        axis = [0.0, *sorted(values)]
        lines = []
        for detector in run.detectors:
            records = [run.record(detector, _at(group, what, v)) if v else run.clean(detector, group) for v in axis]
            lines.append(
                [
                    Point(value / axis[-1], metric_cell(record, metric), f"{detector}, {what} {value:g}")
                    for value, record in zip(axis, records, strict=True)
                ]
            )
        ticks = [(value / axis[-1], f"{value:g}") for value in _apart(axis)]
        found.append(Panel(f"{title_of(group)}; {_rest(group, what)}", ticks, lines))
    return panels(found, label=f"{metric} over {what}", columns=3) if found else ""


def _at(setting: Setting, what: Literal["radius", "steps"], value: float) -> Setting:
    """A setting with another radius, or other steps."""
    return setting._replace(radius=float(value)) if what == "radius" else setting._replace(steps=int(value))


def _rest(setting: Setting, what: str) -> str:
    """What a curve holds fixed: steps, or radius; and on which scenes it ran."""
    steps = setting.steps
    fixed = f"{steps} step{'s' if steps != 1 else ''}" if what == "radius" else f"{setting.radius:g} px"
    few = f"scenes: {scenes_of(setting)}" if setting.subset else ""
    return ", ".join(part for part in [fixed, "L2" if setting.norm == "l2" else "", setting.options, few] if part)


def _apart(values: Sequence[float]) -> list[float]:
    """Those of increasing values that can be written side by side along an axis, the last among them."""
    kept: list[float] = []
    for value in values[:-1]:
        if all(abs(value - other) >= 0.08 * values[-1] for other in [*kept, values[-1]]):
            kept.append(value)
    return [*kept, values[-1]]


def tiles(run: DigitalRun) -> list[dict[str, Any]]:
    """Headline numbers of each detector: clean, and under the attack of the table that leaves least."""
    found = []
    for detector in run.detectors:
        ran = [
            (r["metrics"]["mAP"], s)
            for s in run.rows
            if s.attack not in ("", "noise") and not s.target and (r := run.record(detector, s))
        ]
        worst = min(ran)[1] if ran else None
        clean = run.clean(detector)
        found.append(
            {
                "name": detector,
                "mAP": metric_cell(clean, "mAP"),
                "NDS": metric_cell(clean, "NDS"),
                "worst": f"{title_of(worst)}; {size_of(worst)}" if worst else "no attack ran",
                "left": metric_cell(run.record(detector, worst), "mAP") if worst else Cell(math.nan),
                "lost": lost_cell(run, detector, worst, "mAP") if worst else Cell(math.nan),
            }
        )
    return found


def summary(found: Run) -> Table:
    """The table that is shown on the terminal: percent, and the verdict of the audit."""
    run = load_digital_run(found)
    verdict = audit(attempts_of(run))
    lines = ["percent", verdict.text, *(f"{fault.detector}: {fault.text}" for fault in verdict.faults[:5])]
    lines += filter(None, [short_of(run).strip()])
    return replace(main_table(run), note="\n".join(lines))


def section(found: Run, sentences: Sequence[str] = ()) -> tuple[str, Sequence[Table]]:
    """The page of a digital run and its tables."""
    run = load_digital_run(found)
    verdict = audit(attempts_of(run))
    main, lost, effort = main_table(run), lost_table(run), effort_table(run)
    every, classes, checked = every_table(run), class_table(run), audit_table(verdict)
    makers = (transfer_table, defence_table, hardened_table, black_box_table, target_table, halving_table)
    others = [table for make in makers if (table := make(run)).rows]
    distances = distance_table(run)
    page = render(
        TEMPLATE,
        found,
        verdict=sentences,
        others=others,
        distances=distances,
        main=main,
        lost=lost,
        effort=effort,
        every=every,
        classes=classes,
        audit=checked,
        audited=verdict,
        paper=audit(published_attempts()) if run.suite.get("reference") else None,
        tiles=tiles(run),
        plot=curves(run, "radius"),
        plot_steps=curves(run, "steps"),
        pictures=pictures(found.folder),
        samples=max(int(r.get("n", 0)) for r in run.records.values()),
        scenes=run.scenes,
        failures=[
            (detector, title_of(setting), size_of(setting), circumstances(setting), record["reason"])
            for (detector, setting), record in run.records.items()
            if record["status"] != "ok"
        ],
    )
    return page, [main, lost, *others, checked, effort, every, classes, distances]
