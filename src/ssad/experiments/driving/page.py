"""Page of a driving run: cards, the paper's tables beside ours, replays, and which drivers avoid the collisions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ssad.core import safeio
from ssad.experiments.driving.driving_tables import driving_tables, summary_table
from ssad.experiments.driving.episodes import FAMILY_TITLES, DrivingRun, load_episodes
from ssad.experiments.driving.player import MODELS, outcome_class, replay_data
from ssad.metrics import METRICS
from ssad.report.artefacts import pictures
from ssad.report.figures import Interval, interval_plot
from ssad.report.load import Run
from ssad.report.pages import render
from ssad.report.tables import Table, TableCell

TEMPLATE = Path(__file__).with_name("page.html")

PICTURES = {
    "shifts": (
        "Distribution shifts",
        "The same for a picture of yours:",
        "ssad shift PICTURE.jpg OUT.png --box X0,Y0,X1,Y1",
    ),
    "camera": ("Camera", "", ""),
}
"""How names of pictures begin -> title of their section, and how to make more of them."""


def summary(run: Run) -> Table:
    """Return the table for the terminal."""
    return summary_table(load_episodes(run))


def section(stored_run: Run, verdict: Sequence[str] = ()) -> tuple[str, Sequence[Table]]:
    """Return the page of a driving run and its tables."""
    run = load_episodes(stored_run)
    tables = driving_tables(run)
    tables_by_name = {table.name: table for table in tables}
    replay = replay_data(run)
    gallery = _pictures(stored_run)
    if gallery:
        safeio.write_atomic(
            stored_run.folder / "gallery.html", render(TEMPLATE.with_name("gallery.html"), stored_run, pictures=gallery)
        )
    page = render(
        TEMPLATE,
        stored_run,
        verdict=verdict,
        tiles=[_system_tile(run, system) for system in run.systems],
        precrash=tables_by_name.get("precrash"),
        natural=tables_by_name.get("natural"),
        full=tables_by_name["metrics"],
        normalised=tables_by_name["normalised"],
        plot=interval_plot(_collision_rates(run), label="collision rate with 95 % intervals"),
        matrix=_outcome_matrix(run),
        failures=[record for record in run.records if record.status != "ok"],
        witness=_avoidability(run),
        metrics={name: metric for name, metric in METRICS.items() if name in tables_by_name["metrics"].columns},
        stop_signs=run.is_measured("SS"),
        # "</" would end the script element that holds the data
        replay=safeio.dump_json(replay).replace("</", "<\\/"),
        missing=replay["missing"],
        pictures=gallery,
    )
    return page, tables


def _pictures(run: Run) -> list[dict[str, Any]]:
    """Return the pictures of the run, grouped by the start of their names."""
    all_pictures = pictures(run.folder)
    groups = []
    for name, (title, note, command) in PICTURES.items():
        group_pictures = [picture for picture in all_pictures if picture["file"].startswith(name)]
        if group_pictures:
            groups.append({"name": name, "title": title, "note": note, "command": command, "pictures": group_pictures})
    return groups


def _system_tile(run: DrivingRun, system: str) -> dict[str, Any]:
    """Return the headline numbers of one system: those of the tables' averages."""
    parts = []
    for family, title in FAMILY_TITLES.items():
        values = run.average(system, family)
        if values:
            cells = {symbol: TableCell.of(values[symbol]) for symbol in ("CR", "RC", "DS")}
            has_several = (
                len(
                    {
                        record.group
                        for record in run.records
                        if record.system == system and record.outcome.family == family
                    }
                )
                > 1
            )
            name = f"{title}, mean of the groups" if has_several else title
            parts.append({"name": name, "count": cells["CR"].count} | cells)
    return {
        "system": system,
        "parts": parts,
        "failed": sum(record.system == system and record.status != "ok" for record in run.records),
    }


def _collision_rates(run: DrivingRun) -> list[tuple[str, list[Interval]]]:
    """Return the collision rate of every system in every group and average."""

    def interval(number: int, system: str, group: str) -> Interval:
        cell = TableCell.of(run.numbers[system, group]["CR"])
        return Interval(number, cell, f"{system}: {cell.text}, {cell.tip}")

    return [
        (
            heading,
            [
                interval(number, system, group)
                for number, system in enumerate(run.systems)
                if (system, group) in run.numbers
            ],
        )
        for group, heading in run.headings.items()
    ]


def _outcome_matrix(run: DrivingRun) -> list[dict[str, Any]]:
    """Return groups of episodes, one row per system."""
    groups: dict[str, dict[str, list[dict[str, str]]]] = {}
    for record in run.records:
        reason = record.reason or record.end.replace("_", " ")
        cell_mark = {"key": record.key, "outcome": outcome_class(record), "scenario": record.scenario, "why": reason}
        groups.setdefault(record.heading, {}).setdefault(record.system, []).append(cell_mark)
    return [{"group": name, "systems": systems} for name, systems in groups.items()]


def _avoidability(run: DrivingRun) -> dict[str, Any] | None:
    """For each system and group: of how many collisions, how many each careful driver avoids, and anybody."""
    rows: dict[tuple[str, str], Counter[str]] = {}
    for record in run.records:
        if record.witness and "avoids" in record.witness:
            row = rows.setdefault((record.system, record.heading), Counter())
            row["n"] += 1
            row.update({name: int(avoids) for name, avoids in record.witness["avoids"].items()})
            row["limit"] += record.witness["verdict"] != "unavoidable"
    if not rows:
        return None
    for system in run.systems:
        system_rows = [row for (name, _), row in rows.items() if name == system]
        if len(system_rows) > 1:
            rows[system, "all"] = sum(system_rows, Counter())
    ordered_keys = sorted(rows, key=lambda key: run.systems.index(key[0]))
    return {"rows": {key: rows[key] for key in ordered_keys}, "columns": {**MODELS, "limit": "any manoeuvre tried"}}
