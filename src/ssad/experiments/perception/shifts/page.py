"""The page of a detection run: 3D detectors under shifts, the paper's numbers beside ours."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

from ssad.core.errors import ConfigError
from ssad.core.registry import split_weights
from ssad.metrics import replicate_estimate
from ssad.metrics.intervals import MIN_CLUSTERS
from ssad.metrics.robustness import corruption_error, mean_resilience_rate, resilience_rate
from ssad.report.artefacts import pictures
from ssad.report.curves import Panel, Point, panels
from ssad.report.load import Run
from ssad.report.pages import render
from ssad.report.paper import DETECTORS
from ssad.report.paper import SHIFTS as PUBLISHED
from ssad.report.tables import Cell, Row, Table

TEMPLATE = Path(__file__).with_name("page.html")

SOURCE = "published by the paper: nuScenes val, severities drawn from 1 to 5"
FAMILIES = {"environment": "Environment", "sensor": "Sensor", "object": "Object", "clean": "Clean"}
TITLES = {"uniform": "uniform noise", "gaussian": "gaussian noise", "impulse": "impulse noise", "": "clean"}
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
        """How many scenes were resampled for the intervals."""
        return max(int(r.get("scenes", 0)) for r in self.records.values())

    @property
    def detectors(self) -> list[str]:
        """In the order of the suite."""
        return [split_weights(text)[0] for text in self.suite["detectors"]]

    @property
    def shifts(self) -> list[str]:
        """In the order of the suite, without the clean data."""
        return list(self.suite["shifts"])

    @property
    def numbers(self) -> list[str]:
        """Severities that are numbers, in order."""
        return sorted(str(s) for s in self.suite["severities"] if s != "random")

    def record(self, detector: str, shift: str, severity: str) -> Mapping[str, Any] | None:
        """A record that is there and not failed; the clean one has no severity."""
        found = self.records.get((detector, shift, severity if shift else "0"))
        return found if found is not None and found["status"] == "ok" else None

    def family(self, shift: str) -> str:
        """Title of the family of a shift."""
        own = next((r for (_, s, _), r in self.records.items() if s == shift), None)
        return FAMILIES[own["family"]] if own else ""


class Resampled(Protocol):
    """A run whose scenes were resampled for the intervals.

    Attributes:
        scenes: how many.
    """

    @property
    def scenes(self) -> int:
        """Number of scenes."""


def load_detection_run(run: Run) -> DetectionRun:
    """The records of a run folder."""
    records = {(r["detector"], r["shift"] or "", str(r["severity"])): r for r in run.lines}
    return DetectionRun(run, records)


def score_cell(run: Resampled, value: float, replicates: Sequence[float], n: int, *, bounded: bool = True) -> Cell:
    """A score in percent with its interval: the one place where intervals of this page come from."""
    return Cell.of(replicate_estimate(value, replicates, n=n, clusters=run.scenes, bounded=bounded).scaled(100.0))


def cell_of(run: Resampled, record: Mapping[str, Any] | None, metric: str) -> Cell:
    """A metric in percent with its interval; n/a where there is none."""
    value = None if record is None else record["metrics"].get(metric)
    if record is None or value is None:
        return Cell(math.nan)
    replicates, given = replicates_of(record, metric), (record.get("intervals") or {}).get(metric)
    if not replicates and given:
        return Cell(100 * value, 100 * given[0], 100 * given[1], record["n"], method="given")
    return score_cell(run, value, replicates, record["n"])


def replicates_of(record: Mapping[str, Any], metric: str) -> list[float]:
    """A metric's bootstrap replicates; empty if the record has none."""
    return (record.get("replicates") or {}).get(metric) or []


def summary_cell(run: DetectionRun, detector: str, shift: str, metric: str) -> Cell:
    """A shift's number: at the random severity if that ran, else the mean over severities."""
    if not shift or run.record(detector, shift, "random") is not None:
        return cell_of(run, run.record(detector, shift, "random"), metric)
    found = [r for s in run.numbers if (r := run.record(detector, shift, s)) is not None]
    if not found or len(found) < len(run.numbers) or any(r["metrics"].get(metric) is None for r in found):
        return Cell(math.nan)
    mean = math.fsum(r["metrics"][metric] for r in found) / len(found)
    draws = [replicates_of(r, metric) for r in found]
    means = [math.fsum(row) / len(row) for row in zip(*draws, strict=True)] if all(draws) else []
    return score_cell(run, mean, means, found[0]["n"])


def left_cell(run: DetectionRun, detector: str, shift: str, metric: str) -> Cell:
    """Share of the clean score that is left under a shift, percent; the interval from paired replicates."""
    clean, own = run.record(detector, "", "0"), summary_cell(run, detector, shift, metric)
    if clean is None or math.isnan(own.mean) or not clean["metrics"].get(metric):
        return Cell(math.nan)
    drawn = run.record(detector, shift, "random")
    found = [drawn] if drawn else [r for s in run.numbers if (r := run.record(detector, shift, s)) is not None]
    rows = zip(*(replicates_of(r, metric) for r in (clean, *found)), strict=True)
    shares = [math.fsum(row[1:]) / len(found) / row[0] for row in rows if row[0] > 0]
    return score_cell(run, own.mean / 100.0 / clean["metrics"][metric], shares, own.n, bounded=False)


def interval_note(run: Resampled) -> str:
    """How the intervals of the page are made, in a sentence."""
    if run.scenes < MIN_CLUSTERS:
        few = "one scene is" if run.scenes == 1 else f"{run.scenes} scenes are"
        return f"no intervals, since {few} too few (five are the least)."
    limits = "beta limits; Student's t for ratios that may exceed 1"
    return f"95 % intervals by the bootstrap over {run.scenes} scenes ({limits})."


def title_of(shift: str) -> str:
    """What people call a shift."""
    return TITLES.get(shift, shift.replace("_", " "))


def published_names(run: DetectionRun) -> list[str]:
    """The paper's column for each detector; "": none, or the suite does not ask for them."""
    if not run.suite.get("reference"):
        return [""] * len(run.detectors)
    return [next((v for k, v in DETECTORS.items() if d.startswith(k)), "") for d in run.detectors]


def main_table(run: DetectionRun) -> Table:
    """Shift x detector: mAP and NDS, the paper's rows between ours."""
    rows = []
    columns = [f"{d} {metric}" for d in run.detectors for metric in ("mAP", "NDS")]
    names = published_names(run)
    for shift in ["", *run.shifts]:
        head = (run.family(shift), title_of(shift))
        cells = [summary_cell(run, d, shift, metric) for d in run.detectors for metric in ("mAP", "NDS")]
        rows.append(Row(head, tuple(cells)))
        if shift in PUBLISHED and any(names):
            told = [PUBLISHED[shift].get(name, (math.nan, math.nan)) for name in names]
            rows.append(Row(head, tuple(Cell(v) for pair in told for v in pair), published=True))
    if "random" not in run.suite["severities"]:
        strength = f"mean over severities {', '.join(run.numbers)}"
    elif run.suite["calibration"] == "paper":
        strength = "each sample at a severity drawn from 1 to 5"
    else:
        strength = "each scene at one severity from 1 to 5, all five as often, give or take one"
    return Table(
        "shifts",
        "Detection under distribution shifts",
        ("Family", "Shift"),
        tuple(columns),
        tuple(rows),
        f"Percent; {strength}; {interval_note(run)} Shaded rows: {SOURCE}; ours "
        "are other pictures and other detectors, so the fall under a shift can be compared, the level cannot.",
        SOURCE,
    )


def left_table(run: DetectionRun) -> Table:
    """Shift x detector: the share of the detector's clean score that is left, the paper's shares between ours."""
    rows = []
    columns = [f"{d} {metric}" for d in run.detectors for metric in ("mAP", "NDS")]
    names = published_names(run)
    for shift in run.shifts:
        head = (run.family(shift), title_of(shift))
        rows.append(Row(head, tuple(left_cell(run, d, shift, m) for d in run.detectors for m in ("mAP", "NDS"))))
        if shift in PUBLISHED and any(names):
            cells = [
                Cell(100 * PUBLISHED[shift][name][k] / PUBLISHED[""][name][k] if name else math.nan)
                for name in names
                for k in (0, 1)
            ]
            rows.append(Row(head, tuple(cells), published=True))
    return Table(
        "left",
        "What is left of the clean score",
        ("Family", "Shift"),
        tuple(columns),
        tuple(rows),
        "Percent of each detector's own clean score, which is what other pictures and detectors can be compared by."
        + (f" Shaded rows: from the numbers {SOURCE}." if any(row.published for row in rows) else ""),
        SOURCE,
    )


def severity_table(run: DetectionRun) -> Table:
    """Every number by severity."""
    names = [*run.numbers, *(["random"] if "random" in run.suite["severities"] else [])]
    rows = []
    for metric in ("mAP", "NDS", "AP_car"):
        for detector in run.detectors:
            for shift in run.shifts:
                cells = [cell_of(run, run.record(detector, shift, s), metric) for s in names]
                rows.append(Row((metric.replace("_", " "), detector, title_of(shift)), tuple(cells)))
    return Table(
        "severities", "By severity", ("Metric", "Detector", "Shift"), tuple(f"severity {s}" for s in names), tuple(rows)
    )


def car_table(run: DetectionRun) -> Table:
    """AP of cars."""
    rows = [
        Row((run.family(s), title_of(s)), tuple(summary_cell(run, d, s, "AP_car") for d in run.detectors))
        for s in ["", *run.shifts]
    ]
    return Table("car", "Cars alone: AP", ("Family", "Shift"), tuple(run.detectors), tuple(rows), "Percent.")


def class_table(run: DetectionRun) -> Table:
    """AP of each class and the errors of true positives on the clean data."""
    columns = [*(c.replace("_", " ") for c in CLASSES), *(f"{k} ({unit})" for k, unit in ERRORS.items())]
    rows = []
    for detector in run.detectors:
        record = run.record(detector, "", "0")
        cells = [cell_of(run, record, f"AP_{c}") for c in CLASSES]
        errors = [record["metrics"].get(error) if record else None for error in ERRORS]
        cells += [Cell(math.nan if error is None else error) for error in errors]
        rows.append(Row((detector,), tuple(cells)))
    note = "AP in percent; a class that is not in the data counts as 0 in mAP, as in the official evaluation."
    return Table("classes", "On the clean data", ("Detector",), tuple(columns), tuple(rows), note)


def robustness_table(run: DetectionRun) -> Table | None:
    """Table of mCE and mRR, each of NDS and mAP; the first detector is the baseline of mCE.

    Returns:
        The table, or None where a number is missing.
    """
    severities = run.numbers or ["random"]
    found: dict[tuple[str, str], dict[str, list[float]]] = {}
    draws: dict[tuple[str, str], dict[str, list[list[float]]]] = {}
    for detector in run.detectors:
        for metric in ("NDS", "mAP"):
            records = {s: [run.record(detector, s, n) for n in severities] for s in ["", *run.shifts]}
            if any(r is None for row in records.values() for r in row):
                return None
            whole = {s: [r for r in row if r is not None] for s, row in records.items()}
            found[detector, metric] = {s: [r["metrics"][metric] for r in row] for s, row in whole.items()}
            draws[detector, metric] = {s: [replicates_of(r, metric) for r in row] for s, row in whole.items()}
    rows = []
    for detector in run.detectors:
        cells = []
        for metric in ("NDS", "mAP"):
            own, base = found[detector, metric], found[run.detectors[0], metric]
            rate, error = _robustness(own, base)
            sets = [
                _robustness(_drawn(draws[detector, metric], k), _drawn(draws[run.detectors[0], metric], k))
                for k in range(len(draws[detector, metric][""][0]))
            ]
            for value, several in ((error, [s[1] for s in sets]), (rate, [s[0] for s in sets])):
                # the baseline's mCE is 1 by definition, so its replicates do not vary
                known = [] if value is error and own is base else several
                n = next(iter(run.records.values())).get("n", 0)
                cells.append(score_cell(run, value, known, n, bounded=False))
        rows.append(Row((detector,), tuple(cells)))
    return Table(
        "robustness",
        "Robustness in one number",
        ("Detector",),
        ("mCE (NDS)", "mRR (NDS)", "mCE (mAP)", "mRR (mAP)"),
        tuple(rows),
        f"Percent, over all shifts and severities {', '.join(severities)}. mCE: errors relative to those of "
        f"{run.detectors[0]} (lower is better); mRR: share of the clean score that is left (higher is better).",
    )


def _drawn(values: Mapping[str, Sequence[Sequence[float]]], k: int) -> dict[str, list[float]]:
    return {s: [row[k] for row in rows] for s, rows in values.items()}


def _robustness(own: Mapping[str, Sequence[float]], base: Mapping[str, Sequence[float]]) -> tuple[float, float]:
    """Return mRR and mCE of scores by shift, with the clean ones at ""; NaN where they are not defined."""
    shifted = {s: v for s, v in own.items() if s}
    reference = {s: v for s, v in base.items() if s}
    try:
        rate = mean_resilience_rate(shifted, own[""][0])
        errors = corruption_error(shifted, reference)
    except ConfigError:
        return math.nan, math.nan
    return rate, math.fsum(errors.values()) / len(errors)


def curves(run: DetectionRun, metric: str = "NDS") -> str:
    """A small plot for each shift: the metric over severity, a line a detector, its interval as a band; as SVG."""
    if len(run.numbers) < 2:
        return ""
    steps = ["0", *run.numbers]
    ticks = [(int(n) / 5, "clean" if n == "0" else n) for n in steps]
    found = []
    for shift in run.shifts:
        lines = [
            [
                Point(
                    int(n) / 5,
                    cell_of(run, run.record(d, shift if n != "0" else "", n), metric),
                    f"{d}, {title_of(shift)} {n}",
                )
                for n in steps
            ]
            for d in run.detectors
        ]
        found.append(Panel(title_of(shift), ticks, lines))
    return panels(found, label=f"{metric} over severity")


def tiles(run: DetectionRun, robust: Table | None) -> list[dict[str, Any]]:
    """Headline numbers of each detector."""
    found = []
    for number, detector in enumerate(run.detectors):
        clean = run.record(detector, "", "0")
        scores = {s: [summary_cell(run, detector, s, "NDS").mean / 100] for s in run.shifts}
        parts = {s: v for s, v in scores.items() if not math.isnan(v[0])}
        base = cell_of(run, clean, "NDS").mean / 100
        rates = resilience_rate(parts, base) if parts and base > 0 else {}
        worst = min(rates, key=lambda s: rates[s], default="")
        found.append(
            {
                "name": detector,
                "mAP": cell_of(run, clean, "mAP"),
                "NDS": cell_of(run, clean, "NDS"),
                "mRR": robust.rows[number].cells[1] if robust else Cell(math.nan),
                "worst": f"{title_of(worst)}: {100 * rates[worst]:.0f} % of NDS is left" if worst else "",
            }
        )
    return found


def summary(found: Run) -> Table:
    """The table that is shown on the terminal: percent."""
    drawn = "random" in found.suite["severities"]
    note = f"percent; {'severities from 1 to 5' if drawn else 'means over the severities that ran'}"
    return replace(main_table(load_detection_run(found)), note=note)


def section(found: Run, verdict: Sequence[str] = ()) -> tuple[str, Sequence[Table]]:
    """The page of a detection run and its tables."""
    run = load_detection_run(found)
    robust = robustness_table(run)
    main, left, severities = main_table(run), left_table(run), severity_table(run)
    cars, classes = car_table(run), class_table(run)
    page = render(
        TEMPLATE,
        found,
        verdict=verdict,
        main=main,
        left=left,
        severities=severities,
        cars=cars,
        classes=classes,
        robust=robust,
        tiles=tiles(run, robust),
        plot=curves(run),
        plot_map=curves(run, "mAP"),
        pictures=pictures(found.folder),
        samples=max(int(r.get("n", 0)) for r in run.records.values()),
        scenes=run.scenes,
        skipped=_skipped(run),
        failures=[
            (r["detector"], r["shift"] or "clean", r["severity"], r["reason"])
            for r in run.records.values()
            if r["status"] != "ok"
        ],
    )
    return page, [t for t in (main, left, robust, severities, cars, classes) if t is not None]


def _skipped(run: DetectionRun) -> list[str]:
    """Where a shift could not be applied as it should."""
    found = []
    for (detector, shift, severity), record in run.records.items():
        if detector != run.detectors[0] or record["status"] != "ok":
            continue
        parts = [f"{k} {v}" for k, v in record.get("applied", {}).items() if k != "applied"]
        if parts:
            found.append(f"{title_of(shift)}, severity {severity}: {'; '.join(parts)}")
    return found
