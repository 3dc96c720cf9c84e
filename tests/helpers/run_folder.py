"""Run folders made by hand: lines of records without the engine."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from helpers.metric_traces import make_trace

from ssad.core import safeio
from ssad.core.jsonl import scan_lines
from ssad.core.run_records import COUNTS, EPISODES, RESULTS, counts_text
from ssad.core.seals import sealed, unsealed
from ssad.metrics import episode_metrics

GROUPS = (
    "StraightObstacle",
    "TurningObstacle",
    "LaneChanging",
    "VehiclePassing",
    "RedlightRunning",
    "UnprotectedLeftTurn",
    "RightTurn",
    "CrossingNegotiation",
)


def write_run(
    folder: Path,
    header: Mapping[str, Any],
    lines: Sequence[Mapping[str, Any]],
    episodes: Sequence[Mapping[str, Any]] = (),
) -> Path:
    """run.json and sealed lines in a new folder."""
    folder.mkdir(parents=True, exist_ok=True)
    cells = [{"key": line["key"]} for line in lines]
    (folder / "run.json").write_text(json.dumps({"versions": {"ssad": "0"}, "cells": cells} | dict(header)))
    write_lines(folder, lines, episodes)
    return folder


def write_lines(
    folder: Path, lines: Sequence[Mapping[str, Any]], episodes: Sequence[Mapping[str, Any]] | None = None
) -> None:
    """Lines in the place of those of a run, sealed; episodes stay without others."""
    for name, records in ((RESULTS, lines), (EPISODES, episodes)):
        if records is not None:
            (folder / name).write_text("".join(safeio.dump_json(dict(record)) + "\n" for record in records))
    reseal(folder)


def reseal(folder: Path) -> None:
    """Seal and count the lines of a run as they are now: a test that edits them is about something else."""
    header = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps(header | {"sealed": True}))
    files = {name: scan_lines(folder / name) for name in (RESULTS, EPISODES)}
    episodes = {record["key"]: unsealed(record) for record in files[EPISODES].records}
    for name, lines in files.items():
        torn = (folder / name).read_bytes().rpartition(b"\n")[2] if lines.tail == "open" else b""
        text = "".join(
            safeio.dump_json(sealed(record, number, episode=episodes.get(record["key"]) if name == RESULTS else None))
            + "\n"
            for number, record in enumerate(lines.records, 1)
        )
        (folder / name).write_bytes(text.encode() + torn)
    (folder / COUNTS).write_text(counts_text({name: len(lines.records) for name, lines in files.items()}))


def driving_line(
    key: str, group: str, cluster: str, *, system: str = "a", case: str = "", status: str = "ok", **metrics: Any
) -> dict[str, Any]:
    """A line of a driving run: a complete episode with these metrics instead of its own."""
    kind = "NaturalJunction" if group.startswith("Town") else group
    scenario = {"name": cluster, "type": kind, "town": group}
    values = episode_metrics(make_trace(5, driven=[0, 1, 2, 3, 4])).as_dict()
    plain = {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in values.items()} | metrics
    return {
        "key": key,
        "suite": "s",
        "system": system,
        "group": group,
        "seed": 0,
        "status": status,
        "reason": "",
        "spec": {"scenario": scenario, "system": system, "repetition": 0},
        "metrics": plain if status == "ok" else {},
        "n": 1,
        "versions": {},
        "wall_s": 0.0,
        "artefacts": {},
        "cluster": cluster,
        "case": case or key,
    }


def driving_lines() -> list[dict[str, Any]]:
    """Two systems in the eight scenarios, four routes each with two motions, and in two towns; one cell failed."""
    lines = []
    for system, bias in (("a", 0), ("b", 3)):
        for g, group in enumerate(GROUPS):
            for route in range(4):
                for motion in range(2):
                    hit = (g + route * bias + motion) % 5 == 0
                    number = 8 * g + 2 * route + motion
                    own = {"collision": hit, "route_completion": 0.4 if hit else 1.0, "time": 9.0 + 0.13 * number}
                    own |= {"driving_score": 24.0 if hit else 100.0, "distance_to_route": 0.2 + 0.01 * number}
                    key = f"{system}{g}{route}{motion}"
                    lines.append(driving_line(key, group, f"{group}/0{route}", system=system, **own))
        for town in ("Town02", "Town05"):
            for route in range(6):
                own = {"collision": route == bias, "time": 8.0 + route}
                lines.append(driving_line(f"{system}{town}{route}", town, f"{town}/{route}", system=system, **own))
    lines.append(driving_line("lost", "RightTurn", "RightTurn/03", status="timeout"))
    return lines


DRIVING_HEADER = {"kind": "driving", "command": "ssad run s", "suite": {"name": "s", "title": "T", "seed": 0}}
