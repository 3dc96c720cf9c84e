"""Replays of a driving page: every episode's data, and its outcome in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ssad.core.errors import SSADError, StoreError
from ssad.core.folders import path_inside
from ssad.core.lane_graph import LaneGraph, load_graph, town_file
from ssad.core.traces import load_trace
from ssad.core.types import EpisodeTrace
from ssad.experiments.driving.embed import SHARE, SPEED, episode_data, town_data
from ssad.experiments.driving.episodes import DrivingRun, EpisodeRecord
from ssad.report.paper import SCENARIOS

MODELS = {
    "cc": "UN R157's careful human driver",
    "reg157": "UN R157, 5.2.5.2",
    "rss": "RSS",
    "fsm": "FSM",
}
"""Careful drivers by their short names in a grade."""


def outcome_class(record: EpisodeRecord) -> str:
    """Return the class of an episode in the matrix."""
    if record.status != "ok":
        return "failed"
    return record.end if record.end in ("collision", "complete") else "cut"


def _graph(run: DrivingRun, town: str) -> LaneGraph:
    """Return the town as stored with the run.

    Raises:
        StoreError: The folder has lost it.
    """
    town_path = run.folder / "towns" / town_file(town)
    if town_path.is_file():
        return load_graph(town_path)
    raise StoreError(f"towns/{town_path.name} is missing: this run folder is not complete")


def replay_data(run: DrivingRun) -> dict[str, Any]:
    """Return all data of the page's replay, keyed by cell and town, and which replays are missing and why."""
    traces: dict[str, EpisodeTrace] = {}
    missing: dict[str, str] = {}
    for record in run.records:
        if record.trace:
            try:
                traces[record.key] = load_trace(path_inside(run.folder, record.trace))
            except SSADError as error:
                missing[record.key] = str(error)
    graphs: dict[str, LaneGraph] = {}
    for town in sorted({episode_trace.town for episode_trace in traces.values()}):
        try:
            graphs[town] = _graph(run, town)
        except SSADError as error:
            missing |= {key: str(error) for key, episode_trace in traces.items() if episode_trace.town == town}
    episodes = {}
    for record in run.records:
        trace = traces.get(record.key)
        if trace is None or trace.town not in graphs:
            continue
        episodes[record.key] = episode_data(trace, graphs[trace.town]) | {
            "town": trace.town,
            "system": record.system,
            "group": SCENARIOS.get(record.group, record.group),
            "scenario": record.scenario,
            "outcome": outcome_class(record),
            "witness": _witness_words(record.witness),
        }
    towns = {
        name: town_data(graph, [episode_trace for episode_trace in traces.values() if episode_trace.town == name])
        for name, graph in graphs.items()
    }
    return {
        "speed": SPEED,
        "share": SHARE,
        "towns": towns,
        "episodes": episodes,
        "missing": missing,
    }


def _witness_words(witness: Mapping[str, Any] | None) -> str:
    """Return the grade of a collision in a sentence."""
    if not witness or "avoids" not in witness:
        return ""
    avoiding_models = [name for key, name in MODELS.items() if witness["avoids"].get(key)]
    sentence = f"avoided by {', '.join(avoiding_models)}" if avoiding_models else "avoided by no careful driver"
    limit_result, manoeuvre = witness["limit"], witness["limit"]["manoeuvre"]
    if not manoeuvre:
        return f"{sentence}; none of {limit_result['tried']} manoeuvres stays clear"
    action = (
        "keep the speed"
        if not manoeuvre["accel"]
        else f"{'brake' if manoeuvre['accel'] < 0 else 'speed up'} {abs(manoeuvre['accel']):.1f} m/s²"
    )
    side_text = (
        ""
        if not manoeuvre["aside"]
        else f", {abs(manoeuvre['aside']):.1f} m to the {'left' if manoeuvre['aside'] > 0 else 'right'}"
    )
    timing = (
        f"the last of {limit_result['clear']} manoeuvres that stay clear begins {limit_result['latest']:.1f} s "
        "before the contact"
    )
    return f"{sentence}; {timing}, the gentlest: from {manoeuvre['start']:.1f} s on {action}{side_text}"
