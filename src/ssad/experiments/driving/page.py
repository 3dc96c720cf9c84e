"""The page of a driving run: cards, the paper's tables beside ours, replays, what could have avoided the collisions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ssad.core import safeio
from ssad.experiments.driving.driving_tables import driving_tables, summary_table
from ssad.experiments.driving.episodes import FAMILY_TITLES, DrivingRun, load_episodes
from ssad.experiments.driving.figures import interval_plot
from ssad.experiments.driving.player import MODELS, outcome_class, replay_data
from ssad.metrics import METRICS
from ssad.report.artefacts import pictures
from ssad.report.load import Run
from ssad.report.pages import render
from ssad.report.tables import Cell, Table

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


def summary(found: Run) -> Table:
    """The table that is shown on the terminal."""
    return summary_table(load_episodes(found))


def section(found: Run, verdict: Sequence[str] = ()) -> tuple[str, Sequence[Table]]:
    """The page of a driving run and its tables."""
    run = load_episodes(found)
    tables = driving_tables(run)
    named = {table.name: table for table in tables}
    replay = replay_data(run)
    gallery = _pictures(found)
    if gallery:
        safeio.write_atomic(
            found.folder / "gallery.html", render(TEMPLATE.with_name("gallery.html"), found, pictures=gallery)
        )
    page = render(
        TEMPLATE,
        found,
        verdict=verdict,
        tiles=[_tile(run, system) for system in run.systems],
        precrash=named.get("precrash"),
        natural=named.get("natural"),
        full=named["metrics"],
        normalised=named["normalised"],
        plot=interval_plot(run),
        matrix=_matrix(run),
        failures=[r for r in run.records if r.status != "ok"],
        witness=_witness(run),
        metrics={name: metric for name, metric in METRICS.items() if name in named["metrics"].columns},
        stop_signs=run.measures("SS"),
        # "</" would end the script element that holds the data
        replay=safeio.dump_json(replay).replace("</", "<\\/"),
        missing=replay["missing"],
        pictures=gallery,
    )
    return page, tables


def _pictures(run: Run) -> list[dict[str, Any]]:
    """The pictures of the run, grouped by the start of their names."""
    every = pictures(run.folder)
    groups = []
    for name, (title, note, command) in PICTURES.items():
        own = [p for p in every if p["file"].startswith(name)]
        if own:
            groups.append({"name": name, "title": title, "note": note, "command": command, "pictures": own})
    return groups


def _tile(run: DrivingRun, system: str) -> dict[str, Any]:
    """Headline numbers of one system: those of the tables' averages."""
    parts = []
    for family, title in FAMILY_TITLES.items():
        values = run.average(system, family)
        if values:
            shown = {symbol: Cell.of(values[symbol]) for symbol in ("CR", "RC", "DS")}
            several = len({r.group for r in run.records if r.system == system and r.outcome.family == family}) > 1
            name = f"{title}, mean of the groups" if several else title
            parts.append({"name": name, "count": shown["CR"].count} | shown)
    return {
        "system": system,
        "parts": parts,
        "failed": sum(r.system == system and r.status != "ok" for r in run.records),
    }


def _matrix(run: DrivingRun) -> list[dict[str, Any]]:
    """Groups of episodes, one row per system."""
    groups: dict[str, dict[str, list[dict[str, str]]]] = {}
    for r in run.records:
        why = r.reason or r.end.replace("_", " ")
        mark = {"key": r.key, "outcome": outcome_class(r), "scenario": r.scenario, "why": why}
        groups.setdefault(r.heading, {}).setdefault(r.system, []).append(mark)
    return [{"group": name, "systems": systems} for name, systems in groups.items()]


def _witness(run: DrivingRun) -> dict[str, Any] | None:
    """For each system and group: of how many collisions, how many each careful driver avoids, and anybody."""
    rows: dict[tuple[str, str], Counter[str]] = {}
    for r in run.records:
        if r.witness and "avoids" in r.witness:
            row = rows.setdefault((r.system, r.heading), Counter())
            row["n"] += 1
            row.update({name: int(fine) for name, fine in r.witness["avoids"].items()})
            row["limit"] += r.witness["verdict"] != "unavoidable"
    if not rows:
        return None
    for system in run.systems:
        own = [row for (name, _), row in rows.items() if name == system]
        if len(own) > 1:
            rows[system, "all"] = sum(own, Counter())
    order = sorted(rows, key=lambda key: run.systems.index(key[0]))
    return {"rows": {key: rows[key] for key in order}, "columns": {**MODELS, "limit": "any manoeuvre tried"}}
