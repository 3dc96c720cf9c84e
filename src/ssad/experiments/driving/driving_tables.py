"""Tables of a driving run, with the paper's numbers beside them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import product

from ssad.core.wording import counted
from ssad.experiments.driving.episodes import DrivingRun
from ssad.metrics import FAMILIES, METRICS, Estimate
from ssad.metrics.driving import DIVISORS, normalise_metric
from ssad.report.paper import NATURAL, PRECRASH, SCENARIOS, SOURCE
from ssad.report.tables import METHODS, Table, TableCell, TableRow

SHOWN = ("CR", "OR", "DR", "RC")
AVERAGE = FAMILIES["pre-crash"]


def precrash_table(run: DrivingRun) -> Table | None:
    """Metric x system rows, the eight scenarios and their average: the form of the paper's table, its rows below."""
    systems = [name for name in run.systems if (name, AVERAGE) in run.numbers]
    if not systems:
        return None

    def published(row: tuple[str, str]) -> list[TableRow]:
        symbol, system = row
        rows_of_paper = PRECRASH[symbol].items() if system == systems[-1] else ()
        return [TableRow.of_published((symbol, name), values) for name, values in rows_of_paper]

    return Table.listing(
        "precrash",
        "Pre-crash scenarios",
        list(product(SHOWN, systems)),
        rows={"Metric": lambda row: row[0], "System": lambda row: row[1]},
        columns={**SCENARIOS, AVERAGE: "Avg."},
        metric=lambda row, group: _cell(run, (row[1], group), row[0]),
        published=published,
        note=f"Shaded rows: {SOURCE}. {average_note(run)} {METHODS} {_counts(run, systems)}",
        source=SOURCE,
    )


def average_note(run: DrivingRun) -> str:
    """Return in sentences which groups each average is the mean of, and which are in none; empty: no averages."""
    groups = {group for _, group in run.numbers}
    families = {record.group: record.outcome.family for record in run.records}
    sentences = []
    for family, average in FAMILIES.items():
        members = [run.headings[group] for group in run.headings if group in groups and families.get(group) == family]
        if average in groups and members:
            is_complete = family == "pre-crash" and len(members) == len(SCENARIOS)
            text = "the eight pre-crash scenarios" if is_complete else _listing(members)
            sentences.append(f"{average} is the mean of {text}, each weighed the same.")
    left_out = [
        run.headings[group]
        for group in run.headings
        if group in groups and group in families and FAMILIES[families[group]] not in groups
    ]
    if sentences and left_out:
        sentences.append(f"{_listing(left_out)} {'is' if len(left_out) == 1 else 'are'} in no average.")
    return " ".join(sentences)


def _listing(names: Sequence[str]) -> str:
    """Return names as text: "A, B and C"; of more than five the first four and the number of the others."""
    if len(names) > 5:
        names = [*names[:4], f"{len(names) - 4} more"]
    return " and ".join(filter(None, (", ".join(names[:-1]), *names[-1:])))


def _cell(run: DrivingRun, key: tuple[str, str], symbol: str) -> TableCell:
    """Return a metric of a system in a group; n/a where the system has no episodes in it."""
    return TableCell.of(run.numbers[key][symbol]) if key in run.numbers else TableCell.value(None)


def _counts(run: DrivingRun, systems: list[str]) -> str:
    """Return in a sentence how many episodes and scenarios are behind the numbers."""
    count_texts = []
    for system in systems:
        cells = [estimates["CR"] for group in SCENARIOS if (estimates := run.numbers.get((system, group)))]
        ranges = [
            str(min_count) if min_count == largest else f"{min_count} to {largest}"
            for min_count, largest in (
                (min(counts), max(counts)) for counts in ([cell.n for cell in cells], [cell.clusters for cell in cells])
            )
        ]
        noun = "cluster" if ranges[1] == "1" else "clusters"
        count_texts.append(f"{system} {ranges[0]} in {ranges[1]} {noun}")
    return f"Episodes in a cell: {', '.join(count_texts)}."


def natural_table(run: DrivingRun) -> Table | None:
    """Return system x town: CR, OR, DR, RC among random traffic, the paper's rows below."""
    towns = {record.group: record.town for record in run.records if record.outcome.family == "natural"}
    if not towns:
        return None
    return Table.listing(
        "natural",
        "Natural junction routes",
        [key for key in product(run.systems, (*towns, FAMILIES["natural"])) if key in run.numbers],
        rows={
            "System": lambda key: key[0],
            "Traffic": lambda key: f"Autopilot, {_cell(run, key, 'CR').count.split(',')[0]}",
            "Town": lambda key: towns.get(key[1], "mean of the towns"),
        },
        columns={symbol: symbol for symbol in SHOWN},
        metric=partial(_cell, run),
        footer_rows=[
            TableRow.of_published((system, traffic, town), (*numbers, None))
            for (system, traffic), by_town in NATURAL.items()
            for town, numbers in by_town.items()
        ],
        note=f"{_town_weights(run, towns)}Shaded rows: {SOURCE}. "
        "Their DR fits SafeBench's normalised scale (DR / 5 m); ours here is in metres, "
        "and includes up to half a metre of spacing between route points. See also the normalised table. "
        f"{METHODS}",
        source=SOURCE,
    )


def _town_weights(run: DrivingRun, towns: Mapping[str, str]) -> str:
    """Return in a sentence how towns are weighed where they are averaged; empty for one town."""
    route_counts = {}
    for group, town in towns.items():
        counts = [values["CR"].clusters for (_, name), values in run.numbers.items() if name == group]
        route_counts[town] = max(counts, default=0)
    if len(route_counts) < 2:
        return ""
    listing = ", ".join(f"{town} {counted(count, 'route')}" for town, count in route_counts.items())
    return f"The mean of the towns weighs each town the same ({listing}). "


def full_table(run: DrivingRun) -> Table:
    """Return every metric for every system and group."""
    note = f"{average_note(run)} {METHODS}"
    if not run.is_measured("SS"):
        note += " SS is not measured, since no town of this run has stop signs; the driving score is without them."
    return Table.listing(
        "metrics",
        "All metrics",
        run.numbers,
        rows={"System": lambda key: key[0], "Group": lambda key: run.headings[key[1]]},
        columns={symbol: symbol for symbol in METRICS if symbol != "LC" or run.is_measured(symbol)},
        metric=partial(_cell, run),
        note=note,
    )


def normalised_table(run: DrivingRun) -> Table:
    """Return the terms of SafeBench's overall score, each 0 (best) to 1 (worst), and the two scores made of them."""

    def metric(key: tuple[str, str], column: str) -> TableCell:
        estimate = run.numbers[key]["OS" if column == "FREA" else column]
        if column in ("OR", "DR", "TS"):
            return TableCell.of(_normalise(column, estimate))
        return TableCell.of(estimate.scaled(-1.0, 1.0) if column in ("RC", "FREA") else estimate)

    return Table.listing(
        "normalised",
        "Normalised metrics and overall scores",
        run.numbers,
        rows={"System": lambda key: key[0], "Group": lambda key: run.headings[key[1]]},
        columns={
            "CR": "CR",
            "OR": f"OR / {DIVISORS['OR']:g} m",
            "DR": f"DR / {DIVISORS['DR']:g} m",
            "RC": "1 - RC",
            "TS": f"TS / {DIVISORS['TS']:g} s",
            "OS": "SafeBench score (lower is better)",
            "FREA": "FREA score (higher is better)",
        },
        metric=metric,
        note=f"SafeBench's score weighs CR 0.4, OR 0.1, DR 0.1, 1 - RC 0.3, TS 0.1; FREA's is one minus it. {METHODS}",
    )


def _normalise(name: str, estimate: Estimate) -> Estimate:
    """Return a raw metric over its divisor, cut at 1."""
    scaled_values = (
        value if math.isnan(value) else normalise_metric(name, value)
        for value in (estimate.mean, estimate.low, estimate.high)
    )
    mean, lower, upper = scaled_values
    return replace(estimate, mean=mean, low=lower, high=upper)


def summary_table(run: DrivingRun) -> Table:
    """Return scenario x system with the main metrics, the averages last, for the terminal."""
    return Table.listing(
        "summary",
        run.run.title,
        [(system, group) for group in run.headings for system in run.systems if (system, group) in run.numbers],
        rows={"Scenario": lambda key: run.headings[key[1]], "System": lambda key: key[0]},
        columns={symbol: symbol for symbol in SHOWN},
        metric=partial(_cell, run),
        note="CR: collisions per episode; [a, b]: its 95 % interval, a–b: range\n"
        "OR: m driven off the road, DR: m from the route, RC: share of the route\n"
        f"{average_note(run)}".rstrip(),
    )


def driving_tables(run: DrivingRun) -> list[Table]:
    """Return all tables of a run."""
    candidates = (precrash_table(run), natural_table(run), normalised_table(run), full_table(run))
    return [table for table in candidates if table is not None]
