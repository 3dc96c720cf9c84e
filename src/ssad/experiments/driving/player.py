"""The replays of a driving page: every episode's data, and what became of it in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ssad.core.errors import SSADError, StoreError
from ssad.core.lane_graph import LaneGraph, load_graph, town_file
from ssad.core.traces import load_trace
from ssad.core.types import EpisodeTrace
from ssad.experiments.driving.embed import SCALE, SHARE, SPEED, episode_data, town_data
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
    """Class of an episode in the matrix."""
    if record.status != "ok":
        return "failed"
    return record.end if record.end in ("collision", "complete") else "cut"


def _graph(run: DrivingRun, town: str) -> LaneGraph:
    """The town as the run saw it. StoreError: the folder has lost it."""
    own = run.folder / "towns" / town_file(town)
    if own.is_file():
        return load_graph(own)
    raise StoreError(f"towns/{own.name} is missing: this run folder is not complete")


def replay_data(run: DrivingRun) -> dict[str, Any]:
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
            "outcome": outcome_class(r),
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
    """What the grade of a collision says, in a sentence."""
    if not witness or "avoids" not in witness:
        return ""
    good = [name for key, name in MODELS.items() if witness["avoids"].get(key)]
    words = f"avoided by {', '.join(good)}" if good else "avoided by no careful driver"
    limit, m = witness["limit"], witness["limit"]["manoeuvre"]
    if not m:
        return f"{words}; none of {limit['tried']} manoeuvres stays clear"
    does = (
        "keep the speed"
        if not m["accel"]
        else f"{'brake' if m['accel'] < 0 else 'speed up'} {abs(m['accel']):.1f} m/s²"
    )
    side = "" if not m["aside"] else f", {abs(m['aside']):.1f} m to the {'left' if m['aside'] > 0 else 'right'}"
    until = f"the last of {limit['clear']} manoeuvres that stay clear begins {limit['latest']:.1f} s before the contact"
    return f"{words}; {until}, the gentlest: from {m['start']:.1f} s on {does}{side}"
