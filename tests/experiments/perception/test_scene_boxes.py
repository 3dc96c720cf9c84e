"""Scores of scenes: copies of a drive never narrow an interval."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from helpers.oracle3d import Oracle

from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.truth import GroundTruth, read_truth
from ssad.detectors.on_scenes import SampleBoxes, detect_scene
from ssad.experiments.perception import scene_boxes
from ssad.experiments.perception.scene_boxes import Examination, SceneCondition, distinct_scenes, score_scenes
from ssad.metrics.detection_boxes import BoxTable


def twice(truth: GroundTruth) -> GroundTruth:
    """The same drives once more, under other names."""
    count, scenes = len(truth.samples), len(truth.scenes)
    columns = {name: np.concatenate([getattr(truth.boxes, name)] * 2) for name in (f.name for f in fields(BoxTable))}
    columns["sample"][len(truth.boxes) :] += count
    return replace(
        truth,
        samples=(*truth.samples, *(f"{token} again" for token in truth.samples)),
        scene=np.concatenate([truth.scene, truth.scene + scenes]),
        scenes=(*truth.scenes, *(f"{name} again" for name in truth.scenes)),
        ego=np.concatenate([truth.ego] * 2),
        boxes=BoxTable(**columns),
        points=np.concatenate([truth.points] * 2),
        visibility=np.concatenate([truth.visibility] * 2),
    )


def test_copies_of_a_drive_are_found(recorded: Path) -> None:
    truth = read_truth(recorded, "v1.0-ssad")
    assert distinct_scenes(truth).tolist() == [0, 1]
    assert distinct_scenes(twice(truth)).tolist() == [0, 1, 0, 1]
    moved = twice(truth)
    moved.boxes.centre[-1, 0] += 1e-3
    assert distinct_scenes(moved).tolist() == [0, 1, 0, 2]


def test_copies_never_narrow_an_interval(recorded: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    truth = read_truth(recorded, "v1.0-ssad")
    with NuScenes(recorded) as data:
        found = {name: detect_scene(Oracle(recorded), recorded, data.scene(name)) for name in truth.scenes}  # type: ignore[arg-type]

    def boxes(path: Path) -> tuple[list[SampleBoxes], dict[str, int]]:
        name = path.stem.removesuffix(" again")
        return [replace(one, token=one.token + path.stem.removeprefix(name)) for one in found[name]], {}

    monkeypatch.setattr(scene_boxes, "read_boxes", boxes)
    examination = Examination(Path(), recorded, "v1.0-ssad", (("oracle", ""),), 0, "cpu", 1)
    results = []
    for told in (truth, twice(truth)):
        monkeypatch.setattr(scene_boxes, "_truth", lambda *parts, told=told: told)
        scenes = [SceneCondition(name) for name in told.scenes]
        results.append(score_scenes(examination, "oracle", scenes, replicates=40))
    once, doubled = results
    assert once["metrics"] == doubled["metrics"]
    assert len(set(once["replicates"]["NDS"])) > 1
    assert doubled["replicates"] == once["replicates"]
    assert doubled["intervals"] == once["intervals"] == {}, "two drives are too few, and so are four copies of them"
    assert (doubled["n"], doubled["scenes"]) == (once["n"], once["scenes"]) == (len(truth.samples), 2)
