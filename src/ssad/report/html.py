"""The report: one self-contained HTML page, and the tables as files."""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ssad.core import safeio
from ssad.core.errors import SSADError, StoreError
from ssad.core.lane_graph import LaneGraph, load_graph
from ssad.core.traces import load_trace
from ssad.core.types import EpisodeTrace
from ssad.metrics import METRICS, aggregate
from ssad.report.embed import SCALE, SHARE, SPEED, episode_data, town_data
from ssad.report.figures import interval_plot
from ssad.report.load import Record, Run, load_header, load_run
from ssad.report.pages import template
from ssad.report.paper import SCENARIOS
from ssad.report.tables import Table, tables, write_tables

VERDICTS = {
    "harmless": "a blind driver at the system's speed stays clear",
    "avoidable": "avoidable by reacting once the danger has begun",
    "anticipation": "avoidable only by acting earlier",
    "autopilot": "avoided only by the privileged Autopilot",
    "unavoidable": "nobody tried stayed clear",
}


def write_report(run_dir: Path | str) -> Path:
    """Write DIR/report.html and DIR/tables/*.csv|md|tex from the records in DIR, and return the page's path.

    StoreError if DIR holds no run, has no results, or cannot be written. A trace that is missing or broken leaves its
    episode without a replay, and the page says so.
    """
    header = load_header(run_dir)
    if header.get("suite", {}).get("kind") == "detection":
        from ssad.report.detection import write_detection_report

        return write_detection_report(Path(run_dir), header)
    run = load_run(run_dir)
    found = tables(run)
    write_tables(run.folder, found)
    page = run.folder / "report.html"
    safeio.write_atomic(page, render(run, found))
    return page


def render(run: Run, found: list[Table]) -> str:
    """The page's text."""
    replay = replay_data(run)
    named = {table.name: table for table in found}
    suite = run.header.get("suite", {})
    return template("report.html").render(
        run=run,
        suite=suite,
        title=suite.get("title") or suite.get("name", "SSAD"),
        versions=run.header.get("versions", {}),
        command=run.header.get("command", f"ssad run {suite.get('name', 'quick')}"),
        tiles=[_tile(run, system) for system in run.systems],
        precrash=named.get("precrash"),
        natural=named.get("natural"),
        full=named["metrics"],
        normalised=named["normalised"],
        plot=interval_plot(run),
        matrix=_matrix(run),
        failures=[r for r in run.records if r.status != "ok"],
        witness=_witness(run),
        metrics=METRICS,
        # "</" would end the script element that holds the data
        replay=safeio.dump_json(replay).replace("</", "<\\/"),
        missing=replay["missing"],
        pictures=_pictures(run),
    )


GROUPS = {
    "shifts": (
        "Distribution shifts",
        "The same for a picture of yours:",
        "ssad shift PICTURE.jpg OUT.png --box X0,Y0,X1,Y1",
    ),
    "camera": ("Camera", "", ""),
}


def _pictures(run: Run) -> list[dict[str, Any]]:
    """The pictures of the run as data: URIs with captions, grouped by the start of their names; what is gone is left
    out."""
    folder = run.folder / "pictures"
    if not (folder / "pictures.json").is_file():
        return []
    captions = safeio.read_json(folder / "pictures.json")
    groups = []
    for name, (title, note, command) in GROUPS.items():
        found = []
        for file, caption in sorted(captions.items(), key=lambda item: (len(item[0]), item[0])):
            path = folder / Path(str(file)).name
            kind = {".jpg": "jpeg", ".png": "png"}.get(path.suffix)
            if kind and path.name.startswith(name) and path.is_file():
                data = base64.b64encode(safeio.read_bytes(path)).decode()
                found.append({"data": f"data:image/{kind};base64,{data}", "caption": str(caption)})
        if found:
            groups.append({"name": name, "title": title, "note": note, "command": command, "pictures": found})
    return groups


def _tile(run: Run, system: str) -> dict[str, Any]:
    """Headline numbers of one system."""
    mine = [r for r in run.records if r.system == system]
    parts = []
    for name, members in (
        ("pre-crash", [r for r in mine if r.group in SCENARIOS]),
        ("other routes", [r for r in mine if r.group not in SCENARIOS]),
    ):
        if members:
            values = aggregate([r.metrics for r in members])
            parts.append({"name": name, "n": len(members), "CR": values["CR"], "RC": values["RC"], "DS": values["DS"]})
    return {"system": system, "parts": parts, "failed": sum(r.status != "ok" for r in mine)}


def _outcome(record: Record) -> str:
    """Class of an episode in the matrix."""
    if record.status != "ok":
        return "failed"
    return record.end if record.end in ("collision", "complete") else "cut"


def _matrix(run: Run) -> list[dict[str, Any]]:
    """Groups of episodes, one row per system."""
    groups: dict[str, dict[str, list[dict[str, str]]]] = {}
    for r in run.records:
        name = r.heading
        groups.setdefault(name, {}).setdefault(r.system, []).append(
            {"key": r.key, "outcome": _outcome(r), "scenario": r.scenario, "why": r.reason or r.end.replace("_", " ")}
        )
    return [{"group": name, "systems": systems} for name, systems in groups.items()]


def _witness(run: Run) -> dict[str, Any] | None:
    """For each group: how the collisions divide by what could have avoided them."""
    rows: dict[str, Counter[str]] = {}
    for r in run.records:
        if r.witness:
            name = r.heading
            rows.setdefault(name, Counter())[str(r.witness["verdict"])] += 1
    if not rows:
        return None
    known = [v for v in VERDICTS if any(row[v] for row in rows.values())]
    return {"rows": rows, "verdicts": known, "words": VERDICTS}


def _graph(run: Run, town: str) -> LaneGraph:
    """The town as the run saw it. StoreError: the folder has lost it."""
    own = run.folder / "towns" / f"{town}.npz"
    if own.is_file():
        return load_graph(own)
    raise StoreError(f"towns/{town}.npz is missing: this run folder is not complete")


def replay_data(run: Run) -> dict[str, Any]:
    """All that the page's replay needs, keyed by cell and town, and which replays are missing and why."""
    traces: dict[str, EpisodeTrace] = {}
    missing: dict[str, str] = {}
    for r in run.records:
        if r.trace:
            try:
                traces[r.key] = load_trace(run.folder / r.trace)
            except SSADError as error:
                missing[r.key] = str(error)
    graphs: dict[str, LaneGraph] = {}
    for town in sorted({t.town for t in traces.values()}):
        try:
            graphs[town] = _graph(run, town)
        except SSADError as error:
            missing |= {key: str(error) for key, t in traces.items() if t.town == town}
    episodes = {}
    for r in run.records:
        trace = traces.get(r.key)
        if trace is None or trace.town not in graphs:
            continue
        episodes[r.key] = episode_data(trace, graphs[trace.town]) | {
            "town": trace.town,
            "system": r.system,
            "group": SCENARIOS.get(r.group, r.group),
            "scenario": r.scenario,
            "outcome": _outcome(r),
            "witness": _witness_words(r.witness),
        }
    towns = {name: town_data(graph, [t for t in traces.values() if t.town == name]) for name, graph in graphs.items()}
    return {
        "scale": SCALE,
        "speed": SPEED,
        "share": SHARE,
        "towns": towns,
        "episodes": episodes,
        "missing": missing,
    }


def _witness_words(witness: Mapping[str, Any] | None) -> str:
    """What the witness says, in a sentence."""
    if not witness:
        return ""
    words = VERDICTS.get(str(witness["verdict"]), str(witness["verdict"]))
    m = witness.get("manoeuvre")
    if m:
        side = "" if not m["offset"] else f", {abs(m['offset']):.1f} m to the {'left' if m['offset'] > 0 else 'right'}"
        words += f": from {m['start']:.1f} s on {m['speed']:.1f} m/s for {m['hold']:.0f} s{side}"
    return f"{words} ({witness['clear']} of {witness['tried']} drivers tried stay clear)"
