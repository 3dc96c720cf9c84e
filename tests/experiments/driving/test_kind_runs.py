"""Whole runs in the real world: same bits however they are run, replay, failures as data, kill -9."""

from __future__ import annotations

import io
import os
import random
import signal
import subprocess
import sys
import time
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.command import ssad
from rich.console import Console

from ssad.core.errors import ConfigError, RouteError, SSADError, StoreError
from ssad.core.jsonl import read_lines
from ssad.core.safeio import read_json
from ssad.core.traces import load_trace, save_trace
from ssad.engine.kind import Plan, Resources
from ssad.engine.run import run
from ssad.experiments.driving.attacked_film import attacked_frames
from ssad.experiments.driving.kind import Driving, DrivingSuite
from ssad.experiments.runs import replay, summary
from ssad.scenarios.static.physical.textures.export import PrintedTexture, export_texture

SCENARIOS = ["StraightObstacle/00", "LaneChanging/01", "natural/Crossgate_00/00"]

WICKED = """
import os, time
import numpy as np

class Wicked:
    def __init__(self):
        self.deeds = []
    def reset(self, episodes):
        self.deeds = [e.scenario.name.split("/")[0] for e in episodes]
    def act(self, view):
        if "StraightObstacle" in self.deeds:
            raise ValueError("cannot see")
        if "LaneChanging" in self.deeds:
            os._exit(7)
        if "VehiclePassing" in self.deeds:
            return np.full((len(view.speed), 3), np.nan)
        if "RightTurn" in self.deeds:
            time.sleep(1e6)
        return np.tile(np.float32([0.3, 0, 0]), (len(view.speed), 1))
"""


def plan(chosen: DrivingSuite) -> Plan:
    return Driving().plan(chosen)


def suite(**changes: Any) -> DrivingSuite:
    values: dict[str, Any] = {"name": "small", "systems": ["autopilot", "blind"], "scenarios": SCENARIOS}
    return DrivingSuite(**(values | changes))


def go(folder: Path, chosen: DrivingSuite, workers: int = 2) -> list[dict[str, Any]]:
    return run(plan(chosen), folder, Resources(workers, console=Console(file=io.StringIO())))


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    go(folder, suite())
    return folder


def facts(folder: Path) -> dict[str, Any]:
    """What a run found, without the time it took."""
    episodes = {e["key"]: e for e in read_lines(folder / "episodes.jsonl")}
    results = {r["key"]: r for r in read_lines(folder / "results.jsonl")}
    for record in results.values():
        record.pop("wall_s")
        record.pop("suite")
    for record in episodes.values():
        record.pop("suite")
    return {"episodes": episodes, "results": results}


def test_records(done: Path) -> None:
    records = read_lines(done / "results.jsonl")
    assert len(records) == 6
    for record in records:
        assert record["status"] == "ok"
        names = "key suite status seed spec metrics n versions wall_s artefacts group system reason"
        assert set(names.split()) <= set(record)
        assert load_trace(done / record["artefacts"]["trace"]).key == record["key"]
    crashed = {(r["system"], r["group"]): "witness" in r for r in records}
    assert crashed["blind", "StraightObstacle"]
    assert not crashed["autopilot", "StraightObstacle"]
    run_json = read_json(done / "run.json")
    assert run_json["suite"]["name"] == "small"
    assert sorted(p.name for p in (done / "towns").iterdir()) == ["Crossgate.npz", "ProvingGround.npz"]
    assert [c["key"] for c in run_json["cells"]] == [c.key for c in plan(suite()).cells]


def test_same_bits_for_any_workers_chunk_order_and_repetitions(done: Path, tmp_path: Path) -> None:
    go(tmp_path / "a", suite(chunk=1), workers=0)
    go(tmp_path / "b", suite(scenarios=SCENARIOS[::-1], systems=["blind", "autopilot"], chunk=3), workers=0)
    go(tmp_path / "c", suite(repetitions=2, scenarios=SCENARIOS[:2]), workers=0)
    expected = facts(done)
    for name in "ab":
        assert facts(tmp_path / name) == expected
    more = facts(tmp_path / "c")
    assert len(more["results"]) == 8
    nominal = more["results"].keys() & expected["results"].keys()
    assert len(nominal) == 4
    assert {k: more["results"][k] for k in nominal} == {k: expected["results"][k] for k in nominal}
    for path in (done / "traces").iterdir():
        assert path.read_bytes() == (tmp_path / "a" / "traces" / path.name).read_bytes()


def test_replay_is_identical_and_sees_a_changed_bit(done: Path) -> None:
    found = replay(done, "blind/StraightObstacle/00")
    assert found.difference is None
    path = done / "traces" / f"{found.cell.key}.npz"
    kept = path.read_bytes()
    try:
        trace = load_trace(path)
        x = trace.x.copy()
        x[7, 0] += 1e-4
        save_trace(path, type(trace)(**{**vars(trace), "x": x}))
        changed = replay(done, found.cell.key[:6]).difference
        assert changed is not None
        assert changed.startswith("step 7: x")
    finally:
        path.write_bytes(kept)


def test_replay_films_a_drive_with_a_texture(done: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A shirt on the walker before the ego; what is no attack is refused before anything is driven."""
    agents = []

    def short(trace: Any, graph: Any, attack: Any, **options: Any) -> Any:
        agents.append(attack.agent)
        return islice(attacked_frames(trace, graph, attack, **(options | {"width": 96})), 2)

    monkeypatch.setattr("ssad.experiments.driving.attacked_film.attacked_frames", short)
    monkeypatch.setattr("ssad.rendering.episode_scene.PHASES", 1)  # bodies are made faster
    export_texture(
        tmp_path / "shirt", PrintedTexture(torch.zeros((3, 128, 128)), "camouflage", {}, "pedestrian"), dots=20
    )
    words = "replay", done, "blind/StraightObstacle/00", "--detector", "none", "--out", tmp_path / "out", "--wear"
    shown = ssad(*words, tmp_path / "shirt")
    assert shown.returncode == 0, shown.stderr
    assert agents == [1]
    (film,) = (tmp_path / "out").glob("*.worn.mp4")
    assert f"film: {film}" in shown.stdout.replace("\n", "")
    assert film.stat().st_size > 500
    (tmp_path / "shirt" / "texture.npz").write_bytes(b"other")
    refused = ssad(*words, tmp_path / "shirt")
    assert refused.returncode != 0
    assert "not the texture that texture.json describes" in refused.stderr.replace("\n", " ")
    assert "identical" not in refused.stdout


def test_replay_says_what_it_cannot_find(done: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="closest: blind/StraightObstacle/00"):
        replay(done, "blind/StraightObstacle/01")
    with pytest.raises(StoreError, match="not a results folder"):
        replay(tmp_path, "x")


def test_what_a_system_does_wrong_is_a_record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "wicked_system.py").write_text(WICKED)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    names = ["StraightObstacle", "LaneChanging", "VehiclePassing", "TurningObstacle", "RightTurn"]
    records, system = {}, ["wicked_system:Wicked"]
    for folder, some, limit in (("run", names[:4], 120), ("hanging", names[4:], 2)):  # the good one must have enough
        chosen = suite(systems=system, scenarios=[f"{n}/00" for n in some], timeout_s=limit)
        records |= {r["group"]: r for r in go(tmp_path / folder, chosen, workers=1)}
    assert [records[n]["status"] for n in names] == ["failed", "crashed", "failed", "ok", "timeout"]
    assert "ValueError: cannot see" in records["StraightObstacle"]["reason"]
    assert "wicked_system.py:12" in records["StraightObstacle"]["reason"]
    assert "exit code 7" in records["LaneChanging"]["reason"]
    assert "not finite" in records["VehiclePassing"]["reason"]
    console = Console(file=io.StringIO(), width=100)
    console.print(summary(tmp_path / "run"))
    shown = console.file.getvalue()  # type: ignore[attr-defined]
    assert "3 of 4 cells failed; they widen the intervals" in shown
    with pytest.raises(StoreError, match="left no trace: failed"):
        replay(tmp_path / "run", "wicked_system:Wicked/StraightObstacle/00")


def test_a_changed_system_is_another_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    source = WICKED.replace("class Wicked", "class Changing")
    (tmp_path / "changing_system.py").write_text(source)
    chosen = suite(systems=["changing_system:Changing"], scenarios=["TurningObstacle/00"])
    before = plan(chosen).cells[0].key
    (tmp_path / "changing_system.py").write_text(source.replace("0.3", "0.4"))
    assert plan(chosen).cells[0].key != before


@pytest.mark.parametrize(
    ("route", "error", "message"),
    [
        ("[{x: 217, y: -5.25}, {x: 90000, y: 0}]", RouteError, "scenario Bad: "),
        ("[{x: 217, y: -5.25}]", ConfigError, "route"),
    ],
)
def test_an_unroutable_scenario_ends_before_anything_is_written(
    tmp_path: Path, route: str, error: type[SSADError], message: str
) -> None:
    text = f"name: Bad\ntype: StraightObstacle\ntown: ProvingGround\nroute: {route}\n"
    (tmp_path / "bad.yaml").write_text(text)
    with pytest.raises(error, match=message) as caught:
        plan(suite(scenarios=[str(tmp_path / "bad.yaml")]))
    assert "\n" not in str(caught.value)
    assert str(caught.value).count("scenario Bad") <= 1


def start(folder: Path, name: str) -> subprocess.Popen[bytes]:
    code = (
        "import sys\nfrom ssad.engine.kind import Resources\nfrom ssad.experiments.driving.kind import Driving\n"
        "from ssad.engine.run import run\nfrom ssad.experiments.suites import load_suite\n"
        "run(Driving().plan(load_suite(sys.argv[1])), sys.argv[2], Resources(2))\n"
    )
    command = [sys.executable, "-c", code, name, str(folder)]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


@pytest.mark.slow
def test_quick_killed_at_20_moments_equals_an_unbroken_run(tmp_path: Path) -> None:
    began = time.monotonic()
    assert start(tmp_path / "whole", "quick").wait(timeout=300) == 0
    duration = time.monotonic() - began
    moments = random.Random(7)
    for _ in range(20):
        process = start(tmp_path / "killed", "quick")
        time.sleep(moments.uniform(0.1, 1.0) * duration)
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert start(tmp_path / "killed", "quick").wait(timeout=300) == 0
    whole, killed = facts(tmp_path / "whole"), facts(tmp_path / "killed")
    assert killed == whole
    lines = (tmp_path / "killed" / "results.jsonl").read_text().splitlines()
    assert len(lines) == len(killed["results"]) == len(killed["episodes"])
    for name in os.listdir(tmp_path / "whole" / "traces"):
        kept = (tmp_path / "killed" / "traces" / name).read_bytes()
        assert kept == (tmp_path / "whole" / "traces" / name).read_bytes()
