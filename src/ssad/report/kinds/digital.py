"""The page of a digital run: 3D detectors under digital attacks, the paper's numbers beside ours, and the audit."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from ssad.metrics.attack_audit import RULES, Attempt, Verdict, audit
from ssad.report.artefacts import pictures
from ssad.report.curves import Panel, Point, panels
from ssad.report.kinds.detection import CLASSES, cell_of, interval_note, replicates_of, score_cell
from ssad.report.load import Run
from ssad.report.pages import render
from ssad.report.paper import DETECTORS, DIGITAL_STEPS
from ssad.report.paper import DIGITAL as PUBLISHED
from ssad.report.tables import Cell, Row, Table

SOURCE = "published by the paper: nuScenes val, L-infinity attacks, epsilon 5 and ten steps"
TITLES = {"fgsm": "FGSM", "pgd": "PGD", "cw": "C&W", "cw-min": "C&W, least change", "apgd": "APGD", "noise": "noise"}
PAPER = {("fgsm", "full"): "FGSM", ("pgd", "full"): "PGD", ("cw", "margin"): "C&W", ("", ""): ""}
EPSILON = 5.0
FURTHEST = 32.0  # radius up to which curves are drawn: what lies beyond is for the audit

Setting = tuple[str, str, str, float, int, str]  # attack ("": clean), loss, norm, radius, steps, options


@dataclass(frozen=True)
class DigitalRun:
    """A digital run: its folder, and its records by detector and setting of the attack."""

    run: Run
    records: Mapping[tuple[str, Setting], Mapping[str, Any]]

    @property
    def suite(self) -> Mapping[str, Any]:
        """The resolved suite."""
        return self.run.suite

    @property
    def scenes(self) -> int:
        """How many scenes were resampled for the intervals."""
        return max(int(record.get("scenes", 0)) for record in self.records.values())

    @property
    def detectors(self) -> list[str]:
        """In the order of the suite."""
        return [text.partition("=")[0] for text in self.suite["detectors"]]

    @property
    def settings(self) -> list[Setting]:
        """Of all attacks, in the order of the suite, the clean data first."""
        return list(dict.fromkeys(setting for _, setting in self.records))

    @property
    def rows(self) -> list[Setting]:
        """Those of the table, without those that only curves need."""
        return list(dict.fromkeys(setting for (_, setting), record in self.records.items() if record["row"]))

    def record(self, detector: str, setting: Setting) -> Mapping[str, Any] | None:
        """A record that is there and not failed."""
        found = self.records.get((detector, setting))
        return found if found is not None and found["status"] == "ok" else None

    def clean(self, detector: str) -> Mapping[str, Any] | None:
        """The record of the clean data."""
        return next((self.record(detector, s) for s in self.settings if not s[0]), None)


def load_digital_run(run: Run) -> DigitalRun:
    """The records of a run folder."""
    return DigitalRun(run, {(r["detector"], setting_of(r)): r for r in run.lines})


def setting_of(record: Mapping[str, Any]) -> Setting:
    """What tells the attack of a record from others."""
    return (
        record["attack"] or "", record["loss"] or "", record["norm"] or "", float(record["radius"]),
        int(record["steps"]), record["options"],
    )  # fmt: skip


def title_of(setting: Setting) -> str:
    """What people call an attack: its name and loss."""
    attack, loss = setting[:2]
    if not attack:
        return "clean"
    return f"{TITLES.get(attack, attack)}{f', {loss} loss' if loss else ''}"


def size_of(setting: Setting) -> str:
    """Budget, steps and options in a few words."""
    attack, _, norm, radius, steps, options = setting
    if not attack:
        return ""
    parts = [
        f"{radius:g} px{' L2' if norm == 'l2' else ''}",
        f"{steps} step{'s' if steps != 1 else ''}" if steps else "",
    ]
    return ", ".join(part for part in [*parts, options] if part)


def published_row(run: DigitalRun, setting: Setting) -> tuple[tuple[str, str], list[tuple[float, float]]] | None:
    """The paper's row beside one of ours: its name and budget, and mAP and NDS for each detector; None: it has none."""
    attack, loss, norm, radius, _, options = setting
    told = PAPER.get((attack, loss))
    if told is None or not run.suite.get("reference") or options or (attack and (norm, radius) != ("linf", EPSILON)):
        return None
    names = [next((v for k, v in DETECTORS.items() if d.startswith(k)), "") for d in run.detectors]
    if not any(names):
        return None
    head = (told, size_of(("told", "", "linf", EPSILON, DIGITAL_STEPS[told], ""))) if told else (title_of(setting), "")
    return head, [PUBLISHED[told].get(name, (math.nan, math.nan)) for name in names]


def main_table(run: DigitalRun) -> Table:
    """Attack x detector: mAP and NDS, the paper's rows between ours."""
    rows = []
    for setting in run.rows:
        head = (title_of(setting), size_of(setting))
        cells = [cell_of(run, run.record(d, setting), metric) for d in run.detectors for metric in ("mAP", "NDS")]
        rows.append(Row(head, tuple(cells)))
        told = published_row(run, setting)
        if told:
            rows.append(Row(told[0], tuple(Cell(v) for pair in told[1] for v in pair), published=True))
    columns = tuple(f"{d} {metric}" for d in run.detectors for metric in ("mAP", "NDS"))
    note = f"Percent; each camera image is attacked by itself, its stored 8-bit picture is scored; {interval_note(run)}"
    if any(row.published for row in rows):
        note += (
            f" Shaded rows: {SOURCE}; ours are other pictures and other detectors, so the share of the clean score "
            "that is lost can be compared, the level cannot."
        )
    return Table("digital", "Detection under digital attacks", ("Attack", "Budget"), columns, tuple(rows), note, SOURCE)


def lost_cell(run: DigitalRun, detector: str, setting: Setting, metric: str) -> Cell:
    """Share of the clean score that an attack took away, percent; the interval from paired replicates."""
    clean, own = run.clean(detector), run.record(detector, setting)
    if clean is None or own is None or not clean["metrics"].get(metric) or own["metrics"].get(metric) is None:
        return Cell(math.nan)
    pairs = zip(replicates_of(clean, metric), replicates_of(own, metric), strict=True)
    shares = [1.0 - after / before for before, after in pairs if before > 0]
    value = 1.0 - own["metrics"][metric] / clean["metrics"][metric]
    return score_cell(run, value, shares, own["n"], bounded=False)


def lost_table(run: DigitalRun) -> Table:
    """Attack x detector: the share of the clean score that is lost, the paper's shares between ours."""
    rows = []
    clean = published_row(run, ("", "", "", 0.0, 0, ""))
    for setting in (s for s in run.rows if s[0]):
        head = (title_of(setting), size_of(setting))
        cells = [lost_cell(run, d, setting, metric) for d in run.detectors for metric in ("mAP", "NDS")]
        rows.append(Row(head, tuple(cells)))
        told = published_row(run, setting)
        if told and clean:
            shares = [100 * (1 - a / b) for after, before in zip(told[1], clean[1], strict=True)
                      for a, b in zip(after, before, strict=True)]  # fmt: skip
            rows.append(Row(told[0], tuple(Cell(share) for share in shares), published=True))
    columns = tuple(f"{d} {metric}" for d in run.detectors for metric in ("mAP", "NDS"))
    note = "Percent of each detector's own clean score; more is a stronger attack."
    return Table("lost", "What an attack takes away", ("Attack", "Budget"), columns, tuple(rows), note, SOURCE)


def effort_table(run: DigitalRun) -> Table:
    """What each attack took, and what it did to the loss that it ascends."""
    names = ("gradients", "queries", "loss_before", "loss_after", "used", "change_px", "idle", "gradient_error")
    columns = (
        "gradients an image", "queries an image", "loss before", "loss after", "budget used (%)", "largest change (px)",
        "idle images", "error of the gradient (%)", "images at once",
    )  # fmt: skip
    rows = []
    for (detector, setting), record in run.records.items():
        if not setting[0] or record["status"] != "ok":
            continue
        values = [record.get(name) for name in (*names, "batch")]
        scaled = [
            Cell(math.nan if v is None else float(v) * (100 if n in ("used", "gradient_error") else 1))
            for n, v in zip((*names, "batch"), values, strict=True)
        ]
        rows.append(Row((detector, title_of(setting), size_of(setting), record["access"]), tuple(scaled)))
    note = (
        "Means over the images. Idle images have no object for a loss that needs one and are left as they are. The "
        "error of the gradient is against finite differences, on the image with most objects of each scene."
    )
    return Table("effort", "What it took", ("Detector", "Attack", "Budget", "Access"), columns, tuple(rows), note)


def every_table(run: DigitalRun) -> Table:
    """Every cell."""
    rows = []
    for (detector, setting), record in run.records.items():
        own = record if record["status"] == "ok" else None
        cells = [cell_of(run, own, metric) for metric in ("mAP", "NDS", "AP_car")]
        lost = lost_cell(run, detector, setting, "mAP") if setting[0] else Cell(math.nan)
        rows.append(Row((detector, title_of(setting), size_of(setting)), (*cells, lost)))
    columns = ("mAP", "NDS", "AP of cars", "mAP lost")
    return Table("cells", "Every attack", ("Detector", "Attack", "Budget"), columns, tuple(rows), "Percent.")


def class_table(run: DigitalRun) -> Table:
    """AP of each class under the attacks of the table."""
    rows = [
        Row((d, title_of(s), size_of(s)), tuple(cell_of(run, run.record(d, s), f"AP_{c}") for c in CLASSES))
        for d in run.detectors for s in run.rows
    ]  # fmt: skip
    note = "AP in percent; a class that is not in the data counts as 0 in mAP, as in the official evaluation."
    columns = tuple(c.replace("_", " ") for c in CLASSES)
    return Table("classes", "By class", ("Detector", "Attack", "Budget"), columns, tuple(rows), note)


def attempts_of(run: DigitalRun) -> list[Attempt]:
    """The cells of a run as the audit reads them."""
    found = []
    for (detector, setting), record in run.records.items():
        attack, loss, norm, radius, steps, options = setting
        clean = run.clean(detector)
        if not attack or record["status"] != "ok" or clean is None:
            continue
        found.append(
            Attempt(
                detector, attack, float(record["metrics"]["mAP"]), float(clean["metrics"]["mAP"]), loss, norm, radius,
                steps, record["access"], options, tuple(replicates_of(record, "mAP")), record["loss_before"],
                record["loss_after"], record["gradient_error"], record["coupling"], record["used"], record["change_px"],
            )
        )  # fmt: skip
    return found


def published_attempts() -> list[Attempt]:
    """The paper's own table as the audit reads it; which losses were ascended it does not say."""
    return [
        Attempt(
            f"{detector} (paper)", attack, scores[0] / 100, PUBLISHED[""][detector][0] / 100, radius=EPSILON,
            steps=DIGITAL_STEPS[attack],
        )
        for attack in DIGITAL_STEPS for detector, scores in PUBLISHED[attack].items()
    ]  # fmt: skip


def audit_table(verdict: Verdict) -> Table:
    """How often each rule was applied, and how often it was broken."""
    rows = [
        Row((text,), (Cell(verdict.compared[name]), Cell(sum(fault.rule == name for fault in verdict.faults))))
        for name, (text, _) in RULES.items()
    ]
    return Table("audit", "Audit of the attacks", ("Rule",), ("comparisons", "faults"), tuple(rows), verdict.text)


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
        if setting[0] not in ("", "noise") and (what == "steps" or value <= FURTHEST):
            groups.setdefault(_at(setting, what, 0), set()).add(value)
    found = []
    for group, values in groups.items():
        if len(values) < 2:
            continue
        axis = [0.0, *sorted(values)]
        lines = []
        for detector in run.detectors:
            records = [run.record(detector, _at(group, what, v)) if v else run.clean(detector) for v in axis]
            lines.append(
                [
                    Point(value / axis[-1], cell_of(run, record, metric), f"{detector}, {what} {value:g}")
                    for value, record in zip(axis, records, strict=True)
                ]
            )
        ticks = [(value / axis[-1], f"{value:g}") for value in _apart(axis)]
        found.append(Panel(f"{title_of(group)}; {_rest(group, what)}", ticks, lines))
    return panels(found, label=f"{metric} over {what}", columns=3) if found else ""


def _at(setting: Setting, what: str, value: float) -> Setting:
    """A setting with another radius, or other steps."""
    attack, loss, norm, radius, steps, options = setting
    if what == "radius":
        return attack, loss, norm, float(value), steps, options
    return attack, loss, norm, radius, int(value), options


def _rest(setting: Setting, what: str) -> str:
    """What a curve holds fixed: steps, or radius."""
    _, _, norm, radius, steps, options = setting
    fixed = f"{steps} step{'s' if steps != 1 else ''}" if what == "radius" else f"{radius:g} px"
    return ", ".join(part for part in [fixed, "L2" if norm == "l2" else "", options] if part)


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
            (r["metrics"]["mAP"], s) for s in run.rows if s[0] not in ("", "noise") and (r := run.record(detector, s))
        ]
        worst = min(ran)[1] if ran else None
        clean = run.clean(detector)
        found.append(
            {"name": detector, "mAP": cell_of(run, clean, "mAP"), "NDS": cell_of(run, clean, "NDS"),
             "worst": f"{title_of(worst)}; {size_of(worst)}" if worst else "no attack ran",
             "left": cell_of(run, run.record(detector, worst), "mAP") if worst else Cell(math.nan),
             "lost": lost_cell(run, detector, worst, "mAP") if worst else Cell(math.nan)}
        )  # fmt: skip
    return found


def summary(found: Run) -> Table:
    """The table that is shown on the terminal: percent, and the verdict of the audit."""
    run = load_digital_run(found)
    verdict = audit(attempts_of(run))
    lines = ["percent", verdict.text, *(f"{fault.detector}: {fault.text}" for fault in verdict.faults[:5])]
    return replace(main_table(run), note="\n".join(lines))


def section(found: Run) -> tuple[str, Sequence[Table]]:
    """The page of a digital run and its tables."""
    run = load_digital_run(found)
    verdict = audit(attempts_of(run))
    main, lost, effort = main_table(run), lost_table(run), effort_table(run)
    every, classes, checked = every_table(run), class_table(run), audit_table(verdict)
    page = render(
        "digital.html", found, main=main, lost=lost, effort=effort, every=every, classes=classes, audit=checked,
        verdict=verdict, paper=audit(published_attempts()) if run.suite.get("reference") else None, tiles=tiles(run),
        plot=curves(run, "radius"), plot_steps=curves(run, "steps"), pictures=pictures(found.folder),
        samples=max(int(r.get("n", 0)) for r in run.records.values()), scenes=run.scenes,
        failures=[
            (detector, title_of(setting), size_of(setting), record["reason"])
            for (detector, setting), record in run.records.items()
            if record["status"] != "ok"
        ],
    )  # fmt: skip
    return page, [main, lost, checked, effort, every, classes]
