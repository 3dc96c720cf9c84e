"""Page of a detection run: 3D detectors under shifts, the paper's numbers beside ours."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, product
from pathlib import Path
from typing import Any, Protocol

from ssad.core.errors import ConfigError
from ssad.core.registry import label_of, split_weights
from ssad.metrics import replicate_estimate
from ssad.metrics.intervals import MIN_CLUSTERS
from ssad.metrics.rank import family_correlation
from ssad.metrics.robustness import corruption_error, mean_resilience_rate, resilience_rate
from ssad.report.artefacts import pictures
from ssad.report.figures import CurvePoint, Panel, panels
from ssad.report.load import Run
from ssad.report.pages import render
from ssad.report.paper import DETECTORS
from ssad.report.paper import SHIFTS as PUBLISHED
from ssad.report.tables import Table, TableCell, TableRow

TEMPLATE = Path(__file__).with_name("page.html")

SOURCE = "published by the paper: nuScenes val, severities drawn from 1 to 5"
FAMILIES = {"environment": "Environment", "sensor": "Sensor", "object": "Object", "own": "Own", "clean": "Clean"}
TITLES = {"uniform": "uniform noise", "gaussian": "gaussian noise", "impulse": "impulse noise", "": "clean"}
SCORES = ("mAP", "NDS")
"""Scores of a table, in the order of the published ones."""
CLASSES = (
    "car",
    "truck",
    "bus",
    "trailer",
    "construction_vehicle",
    "pedestrian",
    "motorcycle",
    "bicycle",
    "traffic_cone",
    "barrier",
)
ERRORS = {"mATE": "m", "mASE": "1 - IoU", "mAOE": "rad", "mAVE": "m/s", "mAAE": "1 - accuracy"}


@dataclass(frozen=True)
class DetectionRun:
    """A detection run: its folder, and its records by detector, shift ("": clean) and severity."""

    run: Run
    records: Mapping[tuple[str, str, str], Mapping[str, Any]]

    @property
    def suite(self) -> Mapping[str, Any]:
        """The resolved suite."""
        return self.run.suite

    @property
    def scenes(self) -> int:
        """Number of scenes that were resampled for the intervals."""
        return max(int(record.get("scenes", 0)) for record in self.records.values())

    @property
    def detectors(self) -> list[str]:
        """Detectors in the order of the suite."""
        return [split_weights(text)[0] for text in self.suite["detectors"]]

    @property
    def shifts(self) -> list[str]:
        """Shifts in the order of the suite, without the clean data."""
        return [label_of(shift) for shift in self.suite["shifts"]]

    @property
    def numbers(self) -> list[str]:
        """Severities that are numbers, in order."""
        return sorted(str(severity) for severity in self.suite["severities"] if severity != "random")

    def record(self, detector: str, shift: str, severity: str) -> Mapping[str, Any] | None:
        """Return a record, None if it is absent or failed; the clean one has no severity."""
        candidate = self.records.get((detector, shift, severity if shift else "0"))
        return candidate if candidate is not None and candidate["status"] == "ok" else None

    def family(self, shift: str) -> str:
        """Return the title of the family of a shift."""
        first_record = next((record for (_, name, _), record in self.records.items() if name == shift), None)
        return FAMILIES[first_record["family"]] if first_record else ""


class Resampled(Protocol):
    """A run whose scenes were resampled for the intervals.

    Attributes:
        scenes: Number of scenes.
    """

    @property
    def scenes(self) -> int:
        """Number of scenes."""


def load_detection_run(run: Run) -> DetectionRun:
    """Return the records of a run folder."""
    records = {(record["detector"], record["shift"] or "", str(record["severity"])): record for record in run.lines}
    return DetectionRun(run, records)


def score_cell(run: Resampled, value: float, replicates: Sequence[float], n: int, *, bounded: bool = True) -> TableCell:
    """Return a score in percent with its interval; all intervals of this page are made here."""
    return TableCell.of(replicate_estimate(value, replicates, n=n, clusters=run.scenes, bounded=bounded).scaled(100.0))


def cell_of(run: Resampled, record: Mapping[str, Any] | None, metric: str) -> TableCell:
    """Return a metric in percent with its interval; n/a where there is none."""
    value = None if record is None else record["metrics"].get(metric)
    if record is None or value is None:
        return TableCell(math.nan)
    replicates, interval = replicates_of(record, metric), (record.get("intervals") or {}).get(metric)
    if not replicates and interval:
        return TableCell(100 * value, 100 * interval[0], 100 * interval[1], record["n"], method="given")
    return score_cell(run, value, replicates, record["n"])


def replicates_of(record: Mapping[str, Any], metric: str) -> list[float]:
    """Return a metric's bootstrap replicates; empty if the record has none."""
    return (record.get("replicates") or {}).get(metric) or []


def summary_cell(run: DetectionRun, detector: str, shift: str, metric: str) -> TableCell:
    """Return a shift's number: at the random severity if that ran, else the mean over severities."""
    if not shift or run.record(detector, shift, "random") is not None:
        return cell_of(run, run.record(detector, shift, "random"), metric)
    records = [record for severity in run.numbers if (record := run.record(detector, shift, severity)) is not None]
    if (
        not records
        or len(records) < len(run.numbers)
        or any(record["metrics"].get(metric) is None for record in records)
    ):
        return TableCell(math.nan)
    mean = math.fsum(record["metrics"][metric] for record in records) / len(records)
    replicates = [replicates_of(record, metric) for record in records]
    means = [math.fsum(draw) / len(draw) for draw in zip(*replicates, strict=True)] if all(replicates) else []
    return score_cell(run, mean, means, records[0]["n"])


def remaining_cell(run: DetectionRun, detector: str, shift: str, metric: str) -> TableCell:
    """Share of the clean score that is left under a shift, percent; the interval from paired replicates."""
    clean_record, shifted_cell = run.record(detector, "", "0"), summary_cell(run, detector, shift, metric)
    if clean_record is None or math.isnan(shifted_cell.mean) or not clean_record["metrics"].get(metric):
        return TableCell(math.nan)
    random_record = run.record(detector, shift, "random")
    records = (
        [random_record]
        if random_record
        else [record for severity in run.numbers if (record := run.record(detector, shift, severity)) is not None]
    )
    draws = zip(*(replicates_of(record, metric) for record in (clean_record, *records)), strict=True)
    kept_shares = [math.fsum(draw[1:]) / len(records) / draw[0] for draw in draws if draw[0] > 0]
    return score_cell(
        run, shifted_cell.mean / 100.0 / clean_record["metrics"][metric], kept_shares, shifted_cell.n, bounded=False
    )


def interval_note(run: Resampled) -> str:
    """Return in a sentence how the intervals of the page are made."""
    if run.scenes < MIN_CLUSTERS:
        subject = "one scene is" if run.scenes == 1 else f"{run.scenes} scenes are"
        return f"no intervals, since {subject} too few (five are the least)."
    limits = "beta limits; Student's t for ratios that may exceed 1"
    return f"95 % intervals by the bootstrap over {run.scenes} scenes ({limits})."


def title_of(shift: str) -> str:
    """Return the title of a shift."""
    return TITLES.get(shift, shift.replace("_", " "))


def published_names(run: DetectionRun) -> list[str]:
    """Return the paper's column for each detector; "": none, or the suite does not show the paper."""
    if not run.suite.get("reference"):
        return [""] * len(run.detectors)
    return [
        next((column for prefix, column in DETECTORS.items() if detector.startswith(prefix)), "")
        for detector in run.detectors
    ]


def main_table(run: DetectionRun) -> Table:
    """Return shift x detector: mAP and NDS, the paper's rows between ours."""
    names = published_names(run)

    def published(shift: str) -> list[TableRow]:
        if shift not in PUBLISHED or not any(names):
            return []
        scores = [PUBLISHED[shift].get(name, (None, None)) for name in names]
        return [TableRow.of_published((run.family(shift), title_of(shift)), chain.from_iterable(scores))]

    if "random" not in run.suite["severities"]:
        strength = f"mean over severities {', '.join(run.numbers)}"
    elif run.suite["calibration"] == "paper":
        strength = "each sample at a severity drawn from 1 to 5"
    else:
        strength = "each scene at one severity from 1 to 5, all five as often, give or take one"
    return Table.listing(
        "shifts",
        "Detection under distribution shifts",
        ["", *run.shifts],
        rows=factors(run),
        columns=score_columns(run),
        metric=lambda shift, column: summary_cell(run, column[0], shift, column[1]),
        published=published,
        note=f"Percent; {strength}; {interval_note(run)} Shaded rows: {SOURCE}; ours "
        "are other pictures and other detectors, so the fall under a shift can be compared, the level cannot.",
        source=SOURCE,
    )


def factors(run: DetectionRun) -> dict[str, Callable[[str], str]]:
    """Return the row factors of a shift: its family and title."""
    return {"Family": run.family, "Shift": title_of}


def score_columns(run: DetectionRun) -> dict[tuple[str, str], str]:
    """Return the columns of detector x score."""
    return {(detector, metric): f"{detector} {metric}" for detector in run.detectors for metric in SCORES}


def remaining_table(run: DetectionRun) -> Table:
    """Return shift x detector: the share of the clean score that is left, the paper's shares between ours."""
    names = published_names(run)
    has_published = any(names) and any(shift in PUBLISHED for shift in run.shifts)

    def published(shift: str) -> list[TableRow]:
        if shift not in PUBLISHED or not any(names):
            return []
        kept_shares = [
            100 * PUBLISHED[shift][name][number] / PUBLISHED[""][name][number] if name else None
            for name in names
            for number in (0, 1)
        ]
        return [TableRow.of_published((run.family(shift), title_of(shift)), kept_shares)]

    return Table.listing(
        "left",
        "What is left of the clean score",
        run.shifts,
        rows=factors(run),
        columns=score_columns(run),
        metric=lambda shift, column: remaining_cell(run, column[0], shift, column[1]),
        published=published,
        note="Percent of each detector's own clean score, which is what other pictures and detectors can be compared "
        "by." + (f" Shaded rows: from the numbers {SOURCE}." if has_published else ""),
        source=SOURCE,
    )


def order_table(run: DetectionRun) -> Table | None:
    """Return the rank correlation of the shifts with the paper's; None without three published shifts.

    The levels of other images and detectors cannot be compared, but the order of the shifts can.
    """
    names = zip(run.detectors, published_names(run), strict=True)
    published_by_detector = {detector: name for detector, name in names if name}
    shifts = [shift for shift in run.shifts if shift in PUBLISHED]
    if len(shifts) < 3 or not published_by_detector:
        return None

    def metric(detector: str, score: str) -> TableCell:
        scores = [summary_cell(run, detector, shift, score).mean for shift in shifts]
        published = [PUBLISHED[shift][published_by_detector[detector]][SCORES.index(score)] for shift in shifts]
        return TableCell.of(family_correlation(scores, published, shifts))

    return Table.listing(
        "order",
        "Order of the shifts, against the paper's",
        list(published_by_detector),
        rows={"Detector": str},
        columns={score: score for score in SCORES},
        metric=metric,
        note=f"Spearman's rank correlation over {len(shifts)} shifts of the score under a shift with the published "
        "one (1: the same order); 95 % interval by a bootstrap over the shifts, from five on.",
        source=SOURCE,
    )


def severity_table(run: DetectionRun) -> Table:
    """Return every number by severity."""
    severities = [*run.numbers, *(["random"] if "random" in run.suite["severities"] else [])]
    return Table.listing(
        "severities",
        "By severity",
        list(product(("mAP", "NDS", "AP_car"), run.detectors, run.shifts)),
        rows={
            "Metric": lambda row: row[0].replace("_", " "),
            "Detector": lambda row: row[1],
            "Shift": lambda row: title_of(row[2]),
        },
        columns={severity: f"severity {severity}" for severity in severities},
        metric=lambda row, severity: cell_of(run, run.record(row[1], row[2], severity), row[0]),
    )


def car_table(run: DetectionRun) -> Table:
    """Return the AP of cars."""
    return Table.listing(
        "car",
        "Cars alone: AP",
        ["", *run.shifts],
        rows=factors(run),
        columns={detector: detector for detector in run.detectors},
        metric=lambda shift, detector: summary_cell(run, detector, shift, "AP_car"),
        note="Percent.",
    )


def class_table(run: DetectionRun) -> Table:
    """Return the AP of each class and the errors of true positives on the clean data."""

    def metric(detector: str, column: str) -> TableCell:
        record = run.record(detector, "", "0")
        if column in ERRORS:
            return TableCell.value(record["metrics"].get(column) if record else None)
        return cell_of(run, record, column)

    return Table.listing(
        "classes",
        "On the clean data",
        run.detectors,
        rows={"Detector": str},
        columns={
            **{f"AP_{class_name}": class_name.replace("_", " ") for class_name in CLASSES},
            **{error_name: f"{error_name} ({unit})" for error_name, unit in ERRORS.items()},
        },
        metric=metric,
        note="AP in percent; a class that is not in the data counts as 0 in mAP, as in the official evaluation.",
    )


def robustness_table(run: DetectionRun) -> Table | None:
    """Return mCE and mRR, each of NDS and mAP; the first detector is the baseline of mCE.

    Returns:
        The table, or None where a number is missing.
    """
    severities = run.numbers or ["random"]
    records: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for detector, shift in product(run.detectors, ["", *run.shifts]):
        shift_records = [run.record(detector, shift, severity) for severity in severities]
        records[detector, shift] = [record for record in shift_records if record is not None]
        # Means over shifts and severities are comparable only if none is missing.
        if len(records[detector, shift]) < len(severities):
            return None
    baseline = run.detectors[0]

    def scores(detector: str, number: Callable[[Mapping[str, Any]], float]) -> dict[str, list[float]]:
        return {shift: [number(record) for record in records[detector, shift]] for shift in ["", *run.shifts]}

    def metric(detector: str, column: tuple[str, str]) -> TableCell:
        name, score = column

        def value(number: Callable[[Mapping[str, Any]], float]) -> float:
            rate, error = _robustness(scores(detector, number), scores(baseline, number))
            return error if name == "mCE" else rate

        # the baseline's mCE is 1 by definition, so its replicates do not vary
        draws = 0 if name == "mCE" and detector == baseline else len(replicates_of(records[detector, ""][0], score))
        resampled = [value(partial(_replicate_score, score=score, draw=draw)) for draw in range(draws)]
        count = next(iter(run.records.values())).get("n", 0)
        return score_cell(run, value(lambda record: record["metrics"][score]), resampled, count, bounded=False)

    return Table.listing(
        "robustness",
        "Robustness in one number",
        run.detectors,
        rows={"Detector": str},
        columns={(name, score): f"{name} ({score})" for score in ("NDS", "mAP") for name in ("mCE", "mRR")},
        metric=metric,
        note=f"Percent, over all shifts and severities {', '.join(severities)}. mCE: errors relative to those of "
        f"{baseline} (lower is better); mRR: share of the clean score that is left (higher is better).",
    )


def _replicate_score(record: Mapping[str, Any], score: str, draw: int) -> float:
    """Return a replicate of a score."""
    return replicates_of(record, score)[draw]


def _robustness(
    scores: Mapping[str, Sequence[float]], baseline_scores: Mapping[str, Sequence[float]]
) -> tuple[float, float]:
    """Return mRR and mCE of scores by shift, with the clean ones at ""; NaN where they are not defined."""
    shifted_scores = {shift: values for shift, values in scores.items() if shift}
    reference = {shift: values for shift, values in baseline_scores.items() if shift}
    try:
        rate = mean_resilience_rate(shifted_scores, scores[""][0])
        errors = corruption_error(shifted_scores, reference)
    except ConfigError:
        return math.nan, math.nan
    return rate, math.fsum(errors.values()) / len(errors)


def curves(run: DetectionRun, metric: str = "NDS") -> str:
    """Plot a metric over severity for each shift, a line a detector, its interval as a band; as SVG."""
    if len(run.numbers) < 2:
        return ""
    severities = ["0", *run.numbers]
    ticks = [(int(severity) / 5, "clean" if severity == "0" else severity) for severity in severities]
    plots = []
    for shift in run.shifts:
        lines = [
            [
                CurvePoint(
                    int(severity) / 5,
                    cell_of(run, run.record(detector, shift if severity != "0" else "", severity), metric),
                    f"{detector}, {title_of(shift)} {severity}",
                )
                for severity in severities
            ]
            for detector in run.detectors
        ]
        plots.append(Panel(title_of(shift), ticks, lines))
    return panels(plots, label=f"{metric} over severity")


def tiles(run: DetectionRun, robustness: Table | None) -> list[dict[str, Any]]:
    """Return the headline numbers of each detector."""
    entries = []
    for number, detector in enumerate(run.detectors):
        clean_record = run.record(detector, "", "0")
        scores = {shift: [summary_cell(run, detector, shift, "NDS").mean / 100] for shift in run.shifts}
        measured_scores = {shift: score for shift, score in scores.items() if not math.isnan(score[0])}
        clean_score = cell_of(run, clean_record, "NDS").mean / 100
        rates = resilience_rate(measured_scores, clean_score) if measured_scores and clean_score > 0 else {}
        worst_shift = min(rates, key=lambda shift: rates[shift], default="")
        entries.append(
            {
                "name": detector,
                "mAP": cell_of(run, clean_record, "mAP"),
                "NDS": cell_of(run, clean_record, "NDS"),
                "mRR": robustness.rows[number].cells[1] if robustness else TableCell(math.nan),
                "worst": f"{title_of(worst_shift)}: {100 * rates[worst_shift]:.0f} % of NDS is left"
                if worst_shift
                else "",
            }
        )
    return entries


def summary(run: Run) -> Table:
    """Return the table for the terminal: percent."""
    is_random = "random" in run.suite["severities"]
    note = f"percent; {'severities from 1 to 5' if is_random else 'means over the severities that ran'}"
    return replace(main_table(load_detection_run(run)), note=note)


def section(stored_run: Run, verdict: Sequence[str] = ()) -> tuple[str, Sequence[Table]]:
    """Return the page of a detection run and its tables."""
    run = load_detection_run(stored_run)
    robustness, order = robustness_table(run), order_table(run)
    main_rows, remaining_rows, severities = main_table(run), remaining_table(run), severity_table(run)
    car_rows, class_rows = car_table(run), class_table(run)
    page = render(
        TEMPLATE,
        stored_run,
        verdict=verdict,
        main=main_rows,
        left=remaining_rows,
        order=order,
        severities=severities,
        cars=car_rows,
        classes=class_rows,
        robust=robustness,
        tiles=tiles(run, robustness),
        plot=curves(run),
        plot_map=curves(run, "mAP"),
        pictures=pictures(stored_run.folder),
        samples=max(int(record.get("n", 0)) for record in run.records.values()),
        scenes=run.scenes,
        skipped=_skipped(run),
        failures=[
            (record["detector"], record["shift"] or "clean", record["severity"], record["reason"])
            for record in run.records.values()
            if record["status"] != "ok"
        ],
    )
    tables = main_rows, remaining_rows, order, robustness, severities, car_rows, class_rows
    return page, [table for table in tables if table is not None]


def _skipped(run: DetectionRun) -> list[str]:
    """Return remarks on shifts that could not be applied to all images."""
    remarks = []
    for (detector, shift, severity), record in run.records.items():
        if detector != run.detectors[0] or record["status"] != "ok":
            continue
        reason_texts = [
            f"{reason} {count}" for reason, count in record.get("applied", {}).items() if reason != "applied"
        ]
        if reason_texts:
            remarks.append(f"{title_of(shift)}, severity {severity}: {'; '.join(reason_texts)}")
    return remarks
