"""The way to the target on the page of a physical run: scores against distance, and where a vehicle can stop."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

from ssad.experiments.perception.physical.physical_run import PhysicalRun, is_control, learns_nothing, lower, title_of
from ssad.metrics import replicate_difference
from ssad.metrics.target_approach import (
    AXIS_FLOOR,
    BUILD_UP,
    DECELERATION,
    FOUND_SHARE,
    REACTION,
    SPEEDS,
    stopping_distance,
)
from ssad.report.figures import Curve, CurvePlot, CurvePoint, curve_plots, series_colour
from ssad.report.records import Line
from ssad.report.tables import Table, TableCell

SCORES = {"AP50": "AP50", "confidence": "Mean score"}
NO_PROOF = "proves nothing"
DASHES = (None, "7 3", "2 3")  # of the first five attacks, of the next five, ...


@dataclass(frozen=True)
class ApproachGroup:
    """Approach to a target with one carrier, as one detector sees it.

    Attributes:
        test: Town of the test.
        detector: The detector.
        carrier: Carrier of the attacks.
        clean: Record without an attack.
        controls: Records of the controls of the carrier, every draw.
        attacks: Record of each attack, by its name.
    """

    test: str
    detector: str
    carrier: str
    clean: Line
    controls: tuple[Line, ...]
    attacks: tuple[Line, ...]

    @property
    def axis(self) -> list[float]:
        """Distances at which attacks are scored, m."""
        return list(self.clean["axis"])

    def control_at(self, distance: float, metric: str, attack: str | None = None) -> Line | None:
        """Return the strongest control that was scored at a distance, of all draws; None without one.

        Args:
            distance: The distance, m.
            metric: AP50 or confidence.
            attack: Attack whose controls count; None for all controls.
        """
        controls = [line for line in self.controls if attack is None or learns_nothing(line["attack"], attack)]
        scored = [line for line in controls if _cell(line, distance)[metric] is not None]
        return min(scored, key=lambda line: float(_cell(line, distance)[metric]), default=None)

    def proves_nothing(self, attack: Line, distance: float, metric: str = "AP50") -> bool:
        """Return whether some control hides as much as an attack at a distance.

        With intervals: the lower end of the paired difference, control less attack, is not above 0.
        """
        return any(
            lower(_difference(_cell(line, distance), _cell(attack, distance), metric)) <= 0.0
            for line in self.controls
            if learns_nothing(line["attack"], attack["attack"])
        )


def approach_groups(run: PhysicalRun) -> list[ApproachGroup]:
    """Return the approaches of a run that have an attack.

    Attacks are those that were trained against the detector itself; if there are none, those against others.
    """
    groups = []
    carriers = list(dict.fromkeys(carrier for name, carrier in run.attacks if name != "clean"))
    for (_, test), detector, carrier in product(run.pairs, run.judges, carriers):
        clean_lines = run.clean_lines(test, "approach", detector, carrier)
        carrier_lines = run.all_lines(test, "approach", detector, carrier)
        control_lines = tuple(
            line for line in carrier_lines if is_control(line["attack"]) and line["source"] in ("", detector)
        )
        trained_lines = [line for line in carrier_lines if not is_control(line["attack"]) and line["attack"] != "clean"]
        attack_lines = [line for line in trained_lines if line["source"] in ("", detector)] or trained_lines
        if attack_lines is trained_lines:
            control_lines = tuple(line for line in carrier_lines if is_control(line["attack"]))
        if clean_lines and clean_lines[0]["axis"] and attack_lines:
            groups.append(ApproachGroup(test, detector, carrier, clean_lines[0], control_lines, tuple(attack_lines)))
    return groups


def _title(line: Line) -> str:
    """Return the title of a record, with the detector that its texture was trained against if that is another."""
    title = title_of((line["attack"], line["carrier"]))
    return f"{title}, against {line['source']}" if line["source"] not in ("", line["detector"]) else title


def _cell(line: Line, distance: float) -> dict[str, Any]:
    """Return the scores of a record at a distance."""
    cell: dict[str, Any] = next(cell for cell in line["approach"] if cell["distance"] == distance)
    return cell


def _percent(line: Line, distance: float, metric: str) -> TableCell:
    """Return a score at a distance in percent, with its interval over drives."""
    cell = _cell(line, distance)
    low, high = (cell.get("intervals") or {}).get(metric, (math.nan, math.nan))
    value = math.nan if cell[metric] is None else 100.0 * cell[metric]
    return TableCell(value, 100.0 * low, 100.0 * high, cell["n"], clusters=cell["drives"], method="given")


def _difference(larger: dict[str, Any], smaller: dict[str, Any], metric: str) -> TableCell:
    """Return the difference of two scores at a distance; its interval from paired replicates of the same drives."""
    difference = float(larger[metric] or 0.0) - float(smaller[metric] or 0.0)
    replicates = [(cell.get("replicates") or {}).get(metric) for cell in (larger, smaller)]
    if not all(replicates):
        return TableCell(difference)
    pairs = [first - second for first, second in zip(*replicates, strict=False)]
    return TableCell.of(replicate_difference(difference, pairs, n=larger["n"], clusters=larger["drives"]))


def approach_figures(run: PhysicalRun) -> list[tuple[str, str]]:
    """Return for each approach its title, and AP50 and mean score against distance as SVG text."""
    return [(_group_title(group), _figure(group)) for group in approach_groups(run)]


def _group_title(group: ApproachGroup) -> str:
    return f"{group.detector}, {group.test}, {group.carrier}"


def _figure(group: ApproachGroup) -> str:
    axis = group.axis
    first, last = math.log(axis[0]), math.log(axis[-1])

    def place(distance: float) -> float:
        return (math.log(distance) - first) / (last - first) if last > first else 0.5

    def curve(line: Line, metric: str, colour: str, dashes: str | None) -> Curve:
        is_attack = not is_control(line["attack"]) and line["attack"] != "clean"
        points = [
            CurvePoint(
                place(distance),
                _percent(line, distance, metric),
                f"{distance:g} m",
                is_attack and group.proves_nothing(line, distance, metric),
            )
            for distance in axis
        ]
        return Curve(_title(line), points, colour, dashes)

    plots = []
    for metric, title in SCORES.items():
        curves = [curve(group.clean, metric, "var(--ink)", None)]
        if group.controls:
            points = []
            for distance in axis:
                control = group.control_at(distance, metric)
                assert control is not None
                points.append(
                    CurvePoint(
                        place(distance), _percent(control, distance, metric), f"{distance:g} m, {_title(control)}"
                    )
                )
            curves.append(Curve("strongest control", points, "var(--soft)", "5 4"))
        curves += [
            curve(line, metric, series_colour(number), DASHES[number // 5 % len(DASHES)])
            for number, line in enumerate(group.attacks)
        ]
        ticks = [(place(distance), f"{distance:g}") for distance in axis]
        stops = [(stopping_distance(speed / 3.6), f"{speed:g} km/h") for speed in SPEEDS]
        marks = [(place(distance), name) for distance, name in stops if axis[0] <= distance <= axis[-1]]
        plots.append(CurvePlot(f"{title}, %", ticks, curves, marks))
    return curve_plots(plots, label=f"Scores against distance, {_group_title(group)}", axis="distance, m")


def _rows(run: PhysicalRun) -> list[tuple[ApproachGroup, Line | None, Line]]:
    """Return the groups with the attack of a row (None: a clean row or that of controls) and its record."""
    rows: list[tuple[ApproachGroup, Line | None, Line]] = []
    listed_lines: list[Line] = []
    for group in approach_groups(run):
        if group.clean not in listed_lines:
            listed_lines.append(group.clean)
            rows.append((group, None, group.clean))
        rows += [(group, None, line) for line in group.controls]
        rows += [(group, line, line) for line in group.attacks]
    return rows


def approach_table(run: PhysicalRun, metric: str) -> Table:
    """Return a score against distance, AP50 or confidence: clean, the strongest control at each distance, attacks."""
    Row = tuple[ApproachGroup, str, Line | None]
    rows: list[Row] = []
    listed_lines: list[Line] = []
    for group in approach_groups(run):
        if group.clean not in listed_lines:
            listed_lines.append(group.clean)
            rows.append((group, _title(group.clean), group.clean))
        rows += [(group, f"strongest control, {group.carrier}", None)] if group.controls else []
        rows += [(group, _title(line), line) for line in group.attacks]
    distances = sorted({distance for group, *_ in rows for distance in group.axis})

    def value(row: Row, distance: float) -> TableCell:
        group, _, line = row
        if distance not in group.axis:
            return TableCell(math.nan)
        if line is None:
            line = group.control_at(distance, metric)
        return TableCell(math.nan) if line is None else _percent(line, distance, metric)

    def unproven(row: Row) -> str:
        group, _, line = row
        if line is None or line is group.clean:
            return ""
        return ", ".join(f"{distance:g} m" for distance in group.axis if group.proves_nothing(line, distance, metric))

    return Table.listing(
        f"approach-{'score' if metric == 'confidence' else metric.lower()}",
        f"{SCORES[metric]} against distance",
        rows,
        rows={
            "Town": lambda row: row[0].test,
            "Detector": lambda row: row[0].detector,
            "Attack": lambda row: row[1],
            "Proves nothing at": unproven,
        },
        columns={distance: f"{distance:g} m" for distance in distances},
        metric=value,
        note="Percent, of the target alone, on the way to it. The axis ends where the clean AP50 falls below "
        f"{AXIS_FLOOR:g} (n/a). The strongest control is the draw of any control that leaves least at that distance. "
        "An attack proves nothing where the interval of what a control leaves more (paired, over drives) reaches 0; "
        "with too few drives for intervals, where a control leaves no more.",
    )


def detection_table(run: PhysicalRun) -> Table:
    """Return the distance at which the target is first detected, and the rest of it after a stop."""
    rows = _rows(run)
    columns = {0.0: "first detected, m"} | {speed: f"left after a stop from {speed:g} km/h, m" for speed in SPEEDS}

    def value(row: tuple[ApproachGroup, Line | None, Line], speed: float) -> TableCell:
        first = row[2]["first_detected"]
        low, high = first.get("interval", (math.nan, math.nan))
        count, drives = int(row[2]["n"]), int(row[2]["drives"])
        offset = stopping_distance(speed / 3.6)
        return TableCell(
            first["distance"] - offset, low - offset, high - offset, count, clusters=drives, method="given", digits=1
        )

    def end(row: tuple[ApproachGroup, Line | None, Line]) -> str:
        first = row[2]["first_detected"]
        return "yes" if first["is_end"] else "never detected" if not first["distance"] else ""

    stops = ", ".join(f"{stopping_distance(speed / 3.6):.1f} m from {speed:g} km/h" for speed in SPEEDS)
    return Table.listing(
        "first-detection",
        "First detection against stopping distance",
        rows,
        rows={
            "Town": lambda row: row[0].test,
            "Detector": lambda row: row[0].detector,
            "Attack": lambda row: _title(row[2]) + _draw(row[2]),
            "At the end of the axis": end,
        },
        columns=columns,
        metric=value,
        note=f"First detected: coming from far, the distance at which the target is found above 0.25 in "
        f"{FOUND_SHARE:.0%} of the images, interpolated; at the end of the axis it may be found from farther. Left: "
        f"this less the stopping distance ({stops}: {REACTION:g} s of reaction, {DECELERATION:.2f} m/s^2 reached "
        f"after {BUILD_UP:g} s, UN Regulation 157, Annex 4, Appendix 3, careful and competent human driver); below 0 "
        "the vehicle does not stop before the target.",
    )


def _draw(line: Line) -> str:
    """Return the number of a draw of a control, after the first."""
    return f", draw {line['number'] + 1}" if line.get("number") else ""


def approach_tables(run: PhysicalRun) -> Sequence[Table]:
    """Return the tables of the approaches of a run; none without any."""
    if not approach_groups(run):
        return []
    return [approach_table(run, "AP50"), approach_table(run, "confidence"), detection_table(run)]
