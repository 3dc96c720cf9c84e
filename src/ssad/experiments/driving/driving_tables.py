"""Tables of a driving run, with the paper's numbers beside them."""

from __future__ import annotations

import math
from dataclasses import replace

from ssad.experiments.driving.episodes import DrivingRun
from ssad.metrics import FAMILIES, METRICS, Estimate
from ssad.metrics.driving import DIVISORS, normalised
from ssad.report.paper import NATURAL, PRECRASH, SCENARIOS, SOURCE
from ssad.report.tables import METHODS, Cell, Row, Table

SHOWN = ("CR", "OR", "DR", "RC")
AVERAGE = FAMILIES["pre-crash"]


def precrash_table(run: DrivingRun) -> Table | None:
    """Metric x system rows, the eight scenarios and their average: the form of the paper's table, its rows below."""
    systems = [name for name in run.systems if (name, AVERAGE) in run.numbers]
    if not systems:
        return None
    rows = []
    for symbol in SHOWN:
        for system in systems:
            estimates_by_group = [run.numbers.get((system, group)) for group in (*SCENARIOS, AVERAGE)]
            rows.append(
                Row(
                    (symbol, system),
                    tuple(Cell.of(value[symbol]) if value else Cell(math.nan) for value in estimates_by_group),
                )
            )
        for system, values in PRECRASH[symbol].items():
            rows.append(Row((symbol, system), tuple(Cell(value) for value in values), published=True))
    note = (
        f"Shaded rows: {SOURCE}. Avg. is the mean of the scenarios' values. {METHODS} A failed episode counts in the "
        f"denominator. {_counts(run, systems)}"
    )
    return Table(
        "precrash",
        "Pre-crash scenarios",
        ("Metric", "System"),
        (*SCENARIOS.values(), "Avg."),
        tuple(rows),
        note,
        SOURCE,
    )


def _counts(run: DrivingRun, systems: list[str]) -> str:
    """Return in a sentence how many episodes and scenarios are behind the numbers."""
    parts = []
    for system in systems:
        cells = [estimates["CR"] for group in SCENARIOS if (estimates := run.numbers.get((system, group)))]
        ranges = [
            str(low) if low == high else f"{low} to {high}"
            for low, high in (
                (min(counts), max(counts)) for counts in ([cell.n for cell in cells], [cell.clusters for cell in cells])
            )
        ]
        parts.append(f"{system} {ranges[0]} in {ranges[1]} clusters")
    return f"Episodes in a cell: {', '.join(parts)}."


def natural_table(run: DrivingRun) -> Table | None:
    """Return system x town: CR, OR, DR, RC among random traffic, the paper's rows below."""
    towns = {record.group: record.town for record in run.records if record.outcome.family == "natural"}
    if not towns:
        return None
    rows = []
    for system in run.systems:
        for group in (*towns, FAMILIES["natural"]):
            values = run.numbers.get((system, group))
            if values:
                traffic = f"Autopilot, {Cell.of(values['CR']).count.split(',')[0]}"
                head = (system, traffic, towns.get(group, "mean of the towns"))
                rows.append(Row(head, tuple(Cell.of(values[symbol]) for symbol in SHOWN)))
    for (system, traffic), by_town in NATURAL.items():
        for town, numbers in by_town.items():
            rows.append(
                Row((system, traffic, town), (*(Cell(number) for number in numbers), Cell(math.nan)), published=True)
            )
    note = (
        f"Shaded rows: {SOURCE}. Their DR fits SafeBench's normalised scale (DR / 5 m); ours here is in metres, and "
        f"includes up to half a metre of spacing between route points. See also the normalised table. {METHODS}"
    )
    heads = ("System", "Traffic", "Town")
    return Table("natural", "Natural junction routes", heads, SHOWN, tuple(rows), note, SOURCE)


def full_table(run: DrivingRun) -> Table:
    """Return every metric for every system and group."""
    symbols = tuple(symbol for symbol in METRICS if symbol != "LC" or run.measures(symbol))
    rows = [
        Row((system, run.headings[group]), tuple(Cell.of(values[symbol]) for symbol in symbols))
        for (system, group), values in run.numbers.items()
    ]
    note = f"Avg. is the mean of the eight pre-crash scenarios' values. {METHODS}"
    if not run.measures("SS"):
        note += " SS is not measured, since no town of this run has stop signs; the driving score is without them."
    return Table("metrics", "All metrics", ("System", "Group"), symbols, tuple(rows), note)


def normalised_table(run: DrivingRun) -> Table:
    """Return the terms of SafeBench's overall score, each 0 (best) to 1 (worst), and the two scores made of them."""
    columns = (
        "CR",
        f"OR / {DIVISORS['OR']:g} m",
        f"DR / {DIVISORS['DR']:g} m",
        "1 - RC",
        f"TS / {DIVISORS['TS']:g} s",
        "SafeBench score (lower is better)",
        "FREA score (higher is better)",
    )
    rows = []
    for (system, group), values in run.numbers.items():
        score = values["OS"]
        estimates = (
            values["CR"],
            _scaled("OR", values["OR"]),
            _scaled("DR", values["DR"]),
            values["RC"].scaled(-1.0, 1.0),
            _scaled("TS", values["TS"]),
            score,
            score.scaled(-1.0, 1.0),
        )
        rows.append(Row((system, run.headings[group]), tuple(Cell.of(estimate) for estimate in estimates)))
    note = f"SafeBench's score weighs CR 0.4, OR 0.1, DR 0.1, 1 - RC 0.3, TS 0.1; FREA's is one minus it. {METHODS}"
    title = "Normalised metrics and overall scores"
    return Table("normalised", title, ("System", "Group"), columns, tuple(rows), note)


def _scaled(name: str, estimate: Estimate) -> Estimate:
    """Return a raw metric over its divisor, cut at 1."""
    scaled_values = (
        value if math.isnan(value) else normalised(name, value)
        for value in (estimate.mean, estimate.low, estimate.high)
    )
    mean, low, high = scaled_values
    return replace(estimate, mean=mean, low=low, high=high)


def summary_table(run: DrivingRun) -> Table:
    """Return scenario x system with the main metrics, the averages last, for the terminal."""
    rows = [
        Row((heading, system), tuple(Cell.of(values[symbol]) for symbol in SHOWN))
        for group, heading in run.headings.items()
        for system in run.systems
        if (values := run.numbers.get((system, group)))
    ]
    note = (
        "CR: collisions per episode; [a, b]: its 95 % interval, a–b: range\n"
        "OR: m driven off the road, DR: m from the route, RC: share of the route"
    )
    return Table("summary", run.run.title, ("Scenario", "System"), SHOWN, tuple(rows), note)


def driving_tables(run: DrivingRun) -> list[Table]:
    """Return all tables of a run."""
    candidates = (precrash_table(run), natural_table(run), normalised_table(run), full_table(run))
    return [table for table in candidates if table is not None]
