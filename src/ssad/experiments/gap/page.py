"""Page of a gap run: component beside system, the damage to one against that to the other, causes, pictures."""

from __future__ import annotations

import base64
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Literal

from ssad.core import safeio
from ssad.core.folders import path_inside
from ssad.experiments.gap.lane_figure import course_plot
from ssad.metrics import CaseValue, estimate, paired_difference
from ssad.metrics.intervals import MIN_ROUTES
from ssad.metrics.rank import family_correlation
from ssad.report.figures import MetricChange, change_plot
from ssad.report.load import Run
from ssad.report.pages import render
from ssad.report.records import Line, case_of, field, metric_of, scenario_of
from ssad.report.tables import METHODS, Table, TableCell

TEMPLATE = Path(__file__).with_name("page.html")

SETTINGS = re.compile(r"\?.*$|(?<=^attack-)(.*)-[0-9]+$")  # pgd?steps=2 (once attack-pgd-2) is a kind of pgd

Condition = tuple[str, str, int]
MAIN = {
    "AP": "AP",
    "target_recall": "recall of the object that matters",
    "believed": "believed",
    "phantoms": "phantoms a look",
    "collision": "CR",
    "route_completion": "RC",
    "min_ttc": "least TTC, s",
    "hard_braking": "hard braking",
}
DROPS = {
    "AP": "AP",
    "target_recall": "recall of the object that matters",
    "phantoms": "phantoms a look",
    "collision": "CR",
    "route_completion": "RC",
}
SIGNS = {
    "sign_recall_5_20": "read from 5 to 20 m",
    "sign_recall_20_40": "read from 20 to 40 m",
    "sign_read_at": "first read at, m",
    "stop_signs": "signs run",
}
LANES = {
    "collision": "CR",
    "off_road": "OR, m",
    "distance_to_route": "DR, m",
    "route_completion": "RC",
    "lane_departure": "leaves the lane",
    "departure_time": "after, s",
    "lane_deviation": "from the middle, m",
    "lane_deviation_max": "at most, m",
    "lane_error": "error of the camera, m",
    "lane_detection_rate": "lane detected",
}
LIMITS = {
    "limit_known": "limit known",
    "limit_error": "error of the limit, km/h",
    "speeding": "above the limit, km/h",
    "speeding_max": "most above the limit, km/h",
}
ERRORS = {"recall": "missed", "missed_burst": "burst", "distance_share": "noise", "phantoms": "phantoms"}
"""Metric of a detector's errors -> setting of a perfect detector."""
BOUNDED = (
    *("AP", "recall", "target_recall", "believed", "route_completion", "sign_recall_5_20", "sign_recall_20_40"),
    *("lane_departure", "lane_detection_rate", "limit_known"),
)
CONDITION = {
    "System": field("system"),
    "Perturbation": field("perturbation"),
    "Severity": lambda line: str(line["severity"] or ""),
}
CAUSES = ("hidden", "missed", "misplaced", "late", "known")
COLOURS = {
    "fault": "var(--s1)",
    "shift": "var(--s0)",
    "digital": "var(--s2)",
    "texture": "var(--s3)",
    "light": "var(--s4)",
}


def conditions(run: Run) -> dict[Condition, list[Line]]:
    """Return system, perturbation and severity -> its lines, in the order of the suite."""
    lines_by_condition: dict[Condition, list[Line]] = {}
    for line in run.lines:
        lines_by_condition.setdefault((line["system"], line["perturbation"], int(line["severity"])), []).append(line)
    return lines_by_condition


def summary(run: Run) -> Table:
    """Return the table for the terminal."""
    return replace(main_table(run), note="")


def section(run: Run, verdict: Sequence[str] = ()) -> tuple[str, Sequence[Table]]:
    """Return the page and its tables."""
    main, drop, rank, cause = (build_table(run) for build_table in (main_table, drop_table, rank_table, cause_table))
    ceilings, errors, signs = (build_table(run) for build_table in (ceiling_table, error_table, sign_table))
    lanes, limits = lane_table(run), limit_table(run)
    tables = [main, drop, rank, cause, *(table for table in (ceilings, errors, signs, lanes, limits) if table.rows)]
    failures = [
        ([line["system"], line["perturbation"], str(line["severity"]), scenario_of(line)], line["reason"])
        for line in run.failures
    ]
    page = render(
        TEMPLATE,
        run,
        verdict=verdict,
        main=main,
        ceilings=ceilings,
        errors=errors,
        drop=drop,
        rank=rank,
        cause=cause,
        signs=signs,
        lanes=lanes,
        limits=limits,
        courses=lane_courses(run),
        plot=scatter(run),
        failures=failures,
        sheets=sheets(run),
        systems=list(dict.fromkeys(condition[0] for condition in conditions(run))),
    )
    return page, tables


def main_table(run: Run) -> Table:
    """Return component and system metrics, a row a condition."""
    return Table.pivot(
        "gap",
        "Component and system",
        run.lines,
        rows=CONDITION,
        columns=MAIN,
        metric=_cell,
        note="AP: all kinds of objects as one, the mean of those within 0.5, 1, 2 and 4 m, a drive at a time, on the "
        "pictures that the driver got in it. The object that matters is the one that the ego touches, else the one "
        "that it comes nearest to; its recall counts looks in which it is in view and found within 2 m; believed "
        "counts steps. CR: "
        "share of the drives with a collision. RC: share of the route completed. Hard braking: times above 4 m/s² a "
        f"drive. {METHODS}",
    )


def ceiling_table(run: Run) -> Table:
    """Return the difference of each system from those that receive the ground truth, without perturbations."""
    clean = clean_lines(run)
    ceilings = [ceiling for ceiling in run.suite.get("ceilings", ()) if ceiling in clean]
    metrics = ("collision", "route_completion")
    return Table.pivot(
        "ceilings",
        "Against systems that receive the ground truth",
        [line for system, lines in clean.items() if ceilings and system not in ceilings for line in lines],
        rows={"System": field("system")},
        columns={(ceiling, name): f"{MAIN[name]} less {ceiling}" for ceiling in ceilings for name in metrics},
        metric=lambda lines, column: _difference(lines, clean[column[0]], column[1]),
        note="Without perturbations, in the same drives: what perception costs. Without brackets: the range over the "
        "drives, where too few of them differ for an interval.",
    )


def error_table(run: Run) -> Table:
    """Return the errors of the detectors, in the settings that give a perfect detector the same errors."""
    lines = [line for lines in clean_lines(run).values() for line in lines]

    def metric(lines: Sequence[Line], name: str) -> TableCell:
        cell = _cell(lines, name)
        if name == "recall":
            return replace(cell, mean=1.0 - cell.mean, low=1.0 - cell.high, high=1.0 - cell.low)
        return cell

    return Table.pivot(
        "errors",
        "Errors of the detectors, as settings of a perfect one",
        lines,
        rows={"System": field("system")},
        columns={
            name: setting for name, setting in ERRORS.items() if not all(math.isnan(metric_of(x, name)) for x in lines)
        },
        metric=metric,
        condition=lambda lines: not all(math.isnan(metric_of(line, "recall")) for line in lines),
        note="Without perturbations. Missed: share of the objects in view that are not found within 2 m; burst: looks "
        "in a row that an object is missed; noise: error of the distance, as a share of it; phantoms: a look.",
    )


def drop_table(run: Run) -> Table:
    """Return the changes of metrics under a perturbation against the same drives without it."""
    clean = clean_lines(run)
    return Table.pivot(
        "changes",
        "What a perturbation changes",
        [line for line in run.lines if int(line["severity"])],
        rows=CONDITION,
        columns=DROPS,
        metric=lambda lines, name: _change(lines, clean, name),
        note="Perturbed less clean, in the same drives: below 0 it is lower under the perturbation. Without brackets: "
        "the range over the drives, where too few of them differ for an interval.",
    )


def rank_table(run: Run) -> Table:
    """Return the rank correlation of damage to the component with damage to the system."""
    perturbed: dict[str, list[Condition]] = {}
    for condition in conditions(run):
        if condition[2]:
            perturbed.setdefault(condition[0], []).append(condition)

    def families(system: str) -> list[str]:
        return [SETTINGS.sub(r"\1", perturbation) for _, perturbation, _ in perturbed[system]]

    def correlation(row: tuple[str, str], system_metric: str) -> TableCell:
        system, component_metric = row
        sign = 1.0 if system_metric == "collision" else -1.0
        component_losses = [-change(run, condition, component_metric).mean for condition in perturbed[system]]
        system_losses = [sign * change(run, condition, system_metric).mean for condition in perturbed[system]]
        return TableCell.of(family_correlation(component_losses, system_losses, families(system)))

    return Table.listing(
        "rank",
        "Does the component's damage tell the system's?",
        list(product(perturbed, ("AP", "target_recall"))),
        rows={
            "System": lambda row: row[0],
            "Lost by the component": lambda row: DROPS[row[1]],
            "Perturbations in families": lambda row: f"{len(perturbed[row[0]])} in {len(set(families(row[0])))}",
        },
        columns={"collision": "CR", "route_completion": "RC"},
        metric=correlation,
        note="Spearman's rank correlation over perturbations of what the component loses and what the system loses; "
        "95 % interval by a bootstrap over the families of perturbations (all severities of one are one family, and "
        "so are all step counts of an attack), from five families on. n/a: one of the two does not vary.",
    )


def cause_table(run: Run) -> Table:
    """Return how the driver perceived the object that it hit, before each collision."""

    def metric(lines: Sequence[Line], column: str) -> TableCell:
        causes = [line["cause"] for line in lines if line.get("cause")]
        repaired_drives = [line["repaired"] for line in lines if line.get("repaired")]
        if column == "collisions":
            return TableCell(len(causes), digits=0)
        if column == "unknown_s":
            return TableCell(sorted(float(record["unknown_s"]) for record in causes)[len(causes) // 2])
        if column == "repaired":
            avoided_count = sum(not record["same"] for record in repaired_drives)
            return TableCell.value(avoided_count if repaired_drives else None, digits=0 if repaired_drives else 2)
        return TableCell(sum(record["cause"] == column for record in causes), digits=0)

    return Table.pivot(
        "causes",
        "Before a collision",
        run.lines,
        rows=CONDITION,
        columns={
            "collisions": "collisions",
            **{cause: cause for cause in CAUSES},
            "unknown_s": "unknown, s",
            "repaired": "gone when repaired",
        },
        metric=metric,
        condition=lambda lines: any(line.get("cause") for line in lines),
        note="Collisions by what the object that was hit was in most of the steps from 3 s to 0.5 s before: out of "
        "view or hidden; in view and not found; found more than 2 m from where it was; found, but not believed yet; "
        "believed where it was (then planning or prediction failed). Unknown: for how long before the contact it was "
        "not believed where it was, at most 3 s, the median. Gone when repaired: of these collisions, those that "
        "do not happen when the same drive is driven again with the object that was hit found where it is whenever it "
        "is in view, all else as it was: then this error alone decides.",
    )


def sign_table(run: Run) -> Table:
    """Return how far stop signs were read, and how many were run."""
    clean = clean_lines(run)

    def metric(lines: Sequence[Line], column: str) -> TableCell:
        if column != "more":
            return _cell(lines, column)
        return _change(lines, clean, "stop_signs") if int(lines[0]["severity"]) else TableCell.value(None)

    return Table.pivot(
        "signs",
        "Stop signs that are read",
        run.lines,
        rows=CONDITION,
        columns={**SIGNS, "more": "more than clean"},
        metric=metric,
        condition=lambda lines: any((line.get("metrics") or {}).get("sign_recall") is not None for line in lines),
        note="Of the looks with a stop sign of the way ahead, those in which it was read; attacks on signs are made at "
        "5 to 20 m. Signs run: a drive. More than clean: the rise against the same drives without the perturbation.",
    )


def lane_table(run: Run) -> Table:
    """Return the metrics of lane keeping, a row for each condition."""
    return Table.pivot(
        "lanes",
        "Lane keeping",
        run.lines,
        rows=CONDITION,
        columns=LANES,
        metric=_cell,
        condition=lambda lines: not all(math.isnan(metric_of(line, "lane_deviation")) for line in lines),
        note="CR, OR, DR, RC: collision rate, distance driven off the road, mean distance to the route, share of it "
        "that is completed. A drive leaves the lane where the body crosses a line. After: time from when the cause "
        "comes into view, or from the start where there is none, over the drives that leave it. From the middle: mean "
        "distance to it. Error of the camera: of the middle of the lane beside the ego, as the lane keeper found it.",
    )


def limit_table(run: Run) -> Table:
    """Return the metrics of reading speed limits, a row for each condition."""
    return Table.pivot(
        "limits",
        "Speed limits that are read",
        run.lines,
        rows=CONDITION,
        columns=LIMITS,
        metric=_cell,
        condition=lambda lines: not all(math.isnan(metric_of(line, "limit_known")) for line in lines),
        note="Past the first speed-limit sign of the route. Known: share of the steps in which the limit of the last "
        "sign that was read is the posted one. Error: mean difference of the two; steps without a reading do not "
        "count. Above the limit: mean speed above the posted limit from 4 s after the sign on; slower speeds are 0.",
    )


def lane_courses(run: Run) -> str:
    """Return the SVG of the deviation along each scenario, a line for each condition; "" without lane keepers."""
    courses: dict[str, dict[str, Mapping[str, Sequence[float]]]] = {}
    for line in run.lines:
        if line.get("lane") and not line["spec"].get("repetition", 0):
            severity = f" {line['severity']}" if int(line["severity"]) > 1 else ""
            label = "clean" if not int(line["severity"]) else f"{line['perturbation']}{severity}"
            courses.setdefault(f"{line['system']}, {scenario_of(line)}", {})[label] = line["lane"]
    return course_plot(courses, label="Deviation from the middle of the lane along the route") if courses else ""


def family_of_line(line: Line) -> str:
    """Return the family of a line's perturbation; digital attacks were of the family "attack" in earlier runs."""
    family = str(line.get("family", ""))
    return "digital" if family == "attack" else family


def scatter(run: Run) -> str:
    """Fall of AP against rise of CR, a point a perturbation, with intervals; as SVG text, "" without perturbations."""
    families = {line["perturbation"]: family_of_line(line) for line in run.lines}
    points = []
    for system, name, severity in (condition for condition in conditions(run) if condition[2]):
        ap_change, collision_change = (change(run, (system, name, severity), metric) for metric in ("AP", "collision"))
        if not math.isnan(ap_change.mean) and not math.isnan(collision_change.mean):
            changes_text = f"AP {ap_change.text}, CR {collision_change.text}, {collision_change.count}"
            tooltip = f"{system}, {name} {severity}: {changes_text}"
            ap_loss = replace(ap_change, mean=-ap_change.mean, low=-ap_change.high, high=-ap_change.low)
            points.append(
                MetricChange(ap_loss, collision_change, f"{name} {severity}", families.get(name, ""), tooltip)
            )
    return change_plot(
        points,
        COLOURS,
        label="AP lost against collision rate gained, a point a perturbation",
        x_title="AP lost",
        y_title="CR gained",
    )


def sheets(run: Run) -> list[dict[str, str]]:
    """Return as many sheets of drives as the suite requests: collisions first, conditions in turn."""
    sheet_limit = int(run.suite.get("sheets", 0))
    sheets_by_condition: Counter[Condition] = Counter()
    candidates: list[tuple[int, int, Line, str]] = []
    for line in sorted(run.lines, key=lambda line: not (line.get("metrics") or {}).get("collision")):
        path = (line.get("artefacts") or {}).get("sheet")
        if path and path_inside(run.folder, path).is_file():
            condition = (line["system"], line["perturbation"], int(line["severity"]))
            sheets_by_condition[condition] += 1
            candidates.append((sheets_by_condition[condition], len(candidates), line, path))
    entries = []
    for _, _, line, path in sorted(candidates, key=lambda candidate: candidate[:2])[:sheet_limit]:
        encoded = base64.b64encode(safeio.read_bytes(path_inside(run.folder, path))).decode()
        cause = (line.get("cause") or {}).get("cause", "")
        condition_text = f"{line['perturbation']} {line['severity']}" if line["severity"] else "clean"
        outcome = str(line.get("end", "")).replace("_", " ")
        caption = f"{line['system']}, {scenario_of(line)}, {condition_text}: {outcome}{f' ({cause})' if cause else ''}"
        entries.append({"caption": caption, "data": f"data:image/jpeg;base64,{encoded}", "key": str(line["key"])})
    return entries


def values(lines: Sequence[Line], name: str) -> dict[str, CaseValue]:
    """Return a metric by drive: scenario and repetition."""
    return {
        f"{scenario_of(line)}#{line['spec'].get('repetition', 0)}": case_of(line, metric_of(line, name))
        for line in lines
    }


def _cell(lines: Sequence[Line], name: str) -> TableCell:
    cases = values(lines, name).values()
    if name == "collision":
        return TableCell.of(estimate(cases, "share", min_clusters=MIN_ROUTES))
    return TableCell.of(estimate(cases, "bounded" if name in BOUNDED else "mean", min_clusters=MIN_ROUTES))


def change(run: Run, condition: Condition, name: str) -> TableCell:
    """Return the change of a metric under a condition against the same drives without it.

    Drives that the condition does not have, such as those without a car that could wear a texture, do not count.
    """
    return _change(conditions(run)[condition], clean_lines(run), name)


def clean_lines(run: Run) -> dict[str, list[Line]]:
    """Return the lines without a perturbation by system."""
    return {condition[0]: lines for condition, lines in conditions(run).items() if condition[1:] == ("none", 0)}


def _change(lines: Sequence[Line], clean_by_system: Mapping[str, Sequence[Line]], name: str) -> TableCell:
    """Return the change of a metric in the lines of a condition against the same drives without it."""
    return _difference(lines, clean_by_system.get(lines[0]["system"], []), name)


def _difference(lines: Sequence[Line], other_lines: Sequence[Line], name: str) -> TableCell:
    """Return the difference of a metric from that of other lines of the same drives."""
    cases, other_cases = values(lines, name), values(other_lines, name)
    shared_cases = {drive: other_cases[drive] for drive in cases if drive in other_cases}
    kind: Literal["share", "mean"] = "share" if name == "collision" else "mean"
    return TableCell.of(paired_difference(cases, shared_cases, kind=kind, min_clusters=MIN_ROUTES))
