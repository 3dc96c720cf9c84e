"""Suites of kind `gap` whose systems name parts of another author: results, keys, versions and errors."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from ssad.core.errors import ConfigError, SSADError
from ssad.drivers.perceiving.system import PerceivingSystem
from ssad.engine.kind import Resources
from ssad.engine.run import run as run_plan
from ssad.experiments.gap.kind import Gap, GapSuite
from ssad.experiments.suites import load_suite

PARTS = "helpers.gap_parts"
SHORT = """
name: short
type: StraightObstacle
town: ProvingGround
route: [{x: 217.0, y: -5.25}, {x: 317.0, y: -5.25}]
limits: {max_steps: 12}
"""
AHEAD = {"name": "ahead", "perceiver": {f"{PARTS}:Ahead": {"distance": 15.5}}}
FLAT = (
    *("name", "detector", "weights", "cameras", "width", "input_width", "rate", "latency", "confirm", "reserve"),
    *("high", "low", "reads_signs", "sign_memory", "missed", "burst", "noise", "phantoms"),
)


def suite_of(folder: Path, *systems: dict[str, Any], **changes: Any) -> GapSuite:
    (folder / "short.yaml").write_text(SHORT)
    base = {"kind": "gap", "name": "t", "systems": list(systems), "scenarios": [str(folder / "short.yaml")]}
    return GapSuite.model_validate(base | {"ceilings": []} | changes)


def run(suite: GapSuite, folder: Path) -> list[dict[str, Any]]:
    return run_plan(Gap().plan(suite), folder, Resources(0, console=Console(file=io.StringIO())))


def test_parts_of_another_author_run_under_perturbations_and_replay(tmp_path: Path) -> None:
    mixed = {
        "name": "mixed",
        "perceiver": f"{PARTS}:Ahead",
        "tracker": {f"{PARTS}:Last": {"least": 0.2}},
        "planner": f"{PARTS}:Brake",
    }
    suite = suite_of(tmp_path, AHEAD, mixed, perturbations=["blackout"], severities=[5])
    rows = run(suite, tmp_path / "out")
    assert [(row["system"], row["perturbation"], row["status"]) for row in rows] == [
        ("ahead", "none", "ok"),
        ("ahead", "blackout", "ok"),
        ("mixed", "none", "ok"),
        ("mixed", "blackout", "ok"),
    ]
    ahead, dark, braking, _ = (row["metrics"] for row in rows)
    assert ahead["phantoms"] == pytest.approx(1.0)  # a car that is not there, at every look
    assert dark["phantoms"] < 1.0
    assert braking["driven"] < ahead["driven"]  # its planner stands before the phantom
    plan = Gap().plan(GapSuite.model_validate(suite.model_dump(mode="json")))
    assert [cell.key for cell in plan.cells] == [row["key"] for row in rows]
    again = plan.kind.replay(plan, plan.cells[3], rows[3], tmp_path / "out")
    assert again.difference is None
    assert again.film is not None


def test_a_named_built_in_part_drives_as_the_flat_keys_do(tmp_path: Path) -> None:
    flat = {"name": "flat", "detector": "truth", "missed": 0.2, "confirm": 3}
    named = {
        "name": "named",
        "perceiver": {"truth": {"missed": 0.2}},
        "tracker": {"kalman": {"confirm": 3}},
        "planner": "autopilot",
    }
    one, other = run(suite_of(tmp_path, flat, named), tmp_path / "out")
    assert one["metrics"] == other["metrics"]
    assert one["case"] == other["case"]  # the hash of the motion
    camera = {"camera": {"detector": "pgd-det-light", "width": 64}}
    system = PerceivingSystem.model_validate({"name": "a", "perceiver": camera})
    assert (system.tracking.high, system.tracking.low) == (0.13, 0.05)
    assert system.make().perceiver.threshold == 0.05  # type: ignore[attr-defined]
    assert system.version == PerceivingSystem(name="a", detector="pgd-det-light").version != ""


def test_suites_without_named_parts_keep_their_keys() -> None:
    """The dump of a system enters the keys of its cells: parts that are not named must not stand in it."""
    dumped = PerceivingSystem(name="a").model_dump(mode="json")
    assert tuple(dumped) == FLAT
    assert "perceiver" not in str(load_suite("gap-quick").model_dump(mode="json"))
    system = PerceivingSystem.model_validate(AHEAD)
    assert system.model_dump(mode="json") == dumped | AHEAD
    assert PerceivingSystem.model_validate(system.model_dump(mode="json")) == system


def test_the_source_of_a_part_enters_the_keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    source = tmp_path / "own_tracks.py"
    text = "from helpers.gap_parts import Last\n\n\nclass Mine(Last):\n    pass\n"
    source.write_text(text)
    suite = suite_of(tmp_path, {"name": "a", "detector": "truth", "tracker": "own_tracks:Mine"})
    before = Gap().plan(suite).cells[0].key
    assert Gap().plan(suite).cells[0].key == before
    other = suite_of(tmp_path, {"name": "a", "detector": "truth", "tracker": {"own_tracks:Mine": {"least": 0.2}}})
    assert Gap().plan(other).cells[0].key != before
    source.write_text(text + "# changed\n")
    assert Gap().plan(suite).cells[0].key != before


@pytest.mark.parametrize(
    ("system", "words"),
    [
        ({"perceiver": "camra"}, "system a: unknown perceiver 'camra'; closest: camera"),
        ({"tracker": f"{PARTS}:Brake"}, "system a: tracker '.*Brake', of type Brake, lacks update, confirmed"),
        ({"planner": {f"{PARTS}:Brake": {"speed": 3}}}, "'speed'; it takes distance"),
        ({"perceiver": f"{PARTS}:Ahead", "width": 320}, "width would describe the built-in perceiver.*as an argument"),
        ({"tracker": f"{PARTS}:Last", "reserve": 3}, "reserve would describe the built-in tracker"),
        ({"perceiver": {f"{PARTS}:Ahead": {}, "camera": {}}}, "one name with its arguments"),
        ({"perceiver": "truth", "reads_signs": True}, "signs are read by a detector with the class stop_sign"),
    ],
)
def test_parts_that_are_wrong_are_one_line(tmp_path: Path, system: dict[str, Any], words: str) -> None:
    with pytest.raises((SSADError, ValueError), match=words):
        Gap().plan(suite_of(tmp_path, {"name": "a"} | system))


def test_an_attack_without_a_victim_fails_its_drives_with_a_line(tmp_path: Path) -> None:
    rows = run(suite_of(tmp_path, AHEAD, perturbations=["fgsm"]), tmp_path / "out")
    assert [row["status"] for row in rows] == ["ok", "failed"]
    assert "fgsm needs a victim" in rows[1]["reason"]


def test_signs_are_read_by_a_perceiver_of_another_author() -> None:
    system = PerceivingSystem.model_validate(AHEAD | {"reads_signs": True})
    system.check()
    assert system.make().perceiver.classes == ("car", "stop_sign")
    with pytest.raises(ConfigError, match="sign_memory can only be used with reads_signs"):
        PerceivingSystem.model_validate(AHEAD | {"sign_memory": 1.0}).check()
