"""Run folders made by hand: lines of records without the engine."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from helpers.metric_traces import make_trace

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


def write_run(folder: Path, header: Mapping[str, Any], lines: Sequence[Mapping[str, Any]]) -> Path:
    """run.json and results.jsonl in a new folder."""
    folder.mkdir(parents=True, exist_ok=True)
    cells = [{"key": line["key"]} for line in lines]
    (folder / "run.json").write_text(json.dumps({"versions": {"ssad": "0"}, "cells": cells} | dict(header)))
    (folder / "results.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return folder


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
