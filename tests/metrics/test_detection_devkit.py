"""Equality with the official devkit: its stored answers, and itself where SSAD_DEVKIT_PYTHON names an interpreter."""

import json
import math
import os
import subprocess
from pathlib import Path
from typing import Any

import pytest
from helpers.devkit_sets import SETS, SPLIT, VERSION, write_set

from ssad.datasets.nuscenes.score import score_results

TESTS = Path(__file__).resolve().parents[1]
DEVKIT = os.environ.get("SSAD_DEVKIT_PYTHON")
TOLERANCE = 1e-9


def ours(root: Path) -> dict[str, Any]:
    return score_results(root / "results.json", dataroot=root, version=VERSION, split=SPLIT)


def assert_equal(found: Any, expected: Any, place: str) -> None:
    """Same keys and lists, same numbers within the tolerance, NaN where NaN stands."""
    if isinstance(expected, dict):
        assert found.keys() == expected.keys(), place
        for key, value in expected.items():
            assert_equal(found[key], value, f"{place}/{key}")
    elif isinstance(expected, float) and not math.isnan(expected):
        assert abs(found - expected) <= TOLERANCE, (place, found, expected)
    elif isinstance(expected, float):
        assert math.isnan(found), (place, found)
    else:
        assert found == expected, place


@pytest.mark.parametrize("name", SETS)
def test_equals_the_stored_answer(name: str, tmp_path: Path) -> None:
    expected = json.loads((TESTS / "data" / "devkit" / f"{name}.json").read_text())
    found = ours(write_set(tmp_path, name))
    del found["ssad"], found["eval_time"]
    assert_equal(found, expected, name)


def test_every_stored_answer_has_a_set() -> None:
    assert {path.stem for path in (TESTS / "data" / "devkit").glob("*.json")} == set(SETS)


def test_the_sets_have_what_they_are_for() -> None:
    stored = {name: json.loads((TESTS / "data" / "devkit" / f"{name}.json").read_text()) for name in SETS}
    assert stored["no_predictions"]["mean_ap"] == 0.0
    assert stored["all_nan_velocity"]["tp_errors"]["vel_err"] == 1.0
    assert stored["no_attributes"]["tp_errors"]["attr_err"] == 1.0
    assert stored["empty_classes"]["mean_dist_aps"]["truck"] == 0.0
    assert 0.2 < stored["plain"]["mean_ap"] < 0.8
    assert stored["low_recall"]["mean_ap"] < 0.05


@pytest.mark.skipif(DEVKIT is None, reason="set SSAD_DEVKIT_PYTHON to an interpreter with nuscenes-devkit 1.2.0")
def test_equals_the_devkit_itself(tmp_path: Path) -> None:
    roots = [write_set(tmp_path, name) for name in SETS]
    crowded = write_set(tmp_path / "crowded", "single_sample")
    results = json.loads((crowded / "results.json").read_text())
    for boxes in results["results"].values():
        boxes.extend(boxes * (500 // len(boxes)))
    (crowded / "results.json").write_text(json.dumps(results))
    out = tmp_path / "out.json"
    script = TESTS / "helpers" / "devkit_eval.py"
    subprocess.run(
        [str(DEVKIT), str(script), str(out), VERSION, SPLIT, *map(str, roots)], check=True, capture_output=True
    )
    for name, expected in json.loads(out.read_text()).items():
        found = ours(tmp_path / name)
        del found["ssad"], found["eval_time"], expected["eval_time"]
        assert_equal(found, expected, name)
    subprocess.run([str(DEVKIT), str(script), str(out), VERSION, SPLIT, str(crowded)], check=True, capture_output=True)
    assert "boxes per sample" in json.loads(out.read_text())["single_sample"]["error"]
