"""Recorded drives: the data set that `ssad record` writes."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest

from ssad.bench.record import CATEGORY, Recording, record_nuscenes
from ssad.bench.toolbox.scene import SceneShifter
from ssad.datasets.nuscenes.reader import NuScenes, read_image, read_points
from ssad.datasets.nuscenes.schema import CATEGORY_TO_CLASS, CLASSES
from ssad.errors import ConfigError, StoreError
from ssad.frames import rotation_matrix
from ssad.scenarios.static.shifts import ShiftSpec

SMALL = {"towns": ("Twinford", "Oldmarket"), "held_out": ("Oldmarket",), "scenes": 1, "seconds": 1.0, "width": 160}


def contents(root: Path) -> dict[str, str]:
    """Hash of every file of the data set."""
    return {
        str(p.relative_to(root)): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(root.rglob("*"))
        if p.is_file() and ".parts" not in p.parts
    }


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_nuscenes(Recording(tmp_path_factory.mktemp("record") / "a", sweeps=1, **SMALL), workers=1)


def test_the_reader_finds_what_was_recorded(root: Path) -> None:
    data = NuScenes(root)
    assert [s.name for s in data.scenes()] == ["scene-twinford-000", "scene-oldmarket-000"]
    for record in data.scenes():
        scene = data.scene(record.name)
        assert len(scene.samples) == 3
        assert {f.channel for f in scene.frames} >= {"CAM_FRONT", "CAM_BACK", "LIDAR_TOP"}
        assert sum(not f.key_frame for f in scene.frames) == 2 * 7
        for frame in scene.frames:
            if frame.modality == "camera":
                assert read_image(root / frame.filename).shape == (90, 160, 3)
            else:
                assert len(read_points(root / frame.filename)) > 3000
    assert {CATEGORY_TO_CLASS[c] for c in CATEGORY.values()} == set(CLASSES)


def test_points_lie_in_the_boxes_as_counted_and_on_the_ground(root: Path) -> None:
    data = NuScenes(root)
    boxes = 0
    for record in data.scenes():
        scene = data.scene(record.name)
        for frame in [f for f in scene.frames if f.channel == "LIDAR_TOP" and f.key_frame]:
            pose = frame.ego_to_world @ frame.sensor_to_ego
            world = read_points(root / frame.filename)[:, :3] @ pose[:3, :3].T + pose[:3, 3]
            assert (np.abs(world[:, 2]) < 0.2).mean() > 0.15, "the road"
            assert world[:, 2].min() > -1.0
            found = scene.annotations(frame.sample_token)
            boxes += len(found)
            for n in range(len(found)):
                local = (world - found.centre[n]) @ rotation_matrix(found.rotation[n]) / found.size[n][[1, 0, 2]]
                assert abs(int((np.abs(local) <= 0.5001).all(1).sum()) - found.lidar_points[n]) <= 2
    assert boxes > 5


def test_shifts_take_the_true_depth(root: Path) -> None:
    data = NuScenes(root)
    scene = data.scene(data.scenes()[0].name)
    shifter = SceneShifter(root, scene, ShiftSpec("fog", 4))
    frame = next(f for f in scene.frames if f.channel == "CAM_FRONT" and f.key_frame)
    _, done = shifter.image(frame)
    assert done.details["depth"] == "given"
    depth = shifter.camera_frame(frame).depth
    assert depth is not None
    assert np.isinf(depth).any(), "sky"
    assert 2 < depth[-1, 20] < 6, "the road before the car"


def test_same_bytes_for_any_number_of_workers_and_after_a_stop(root: Path, tmp_path: Path) -> None:
    again = tmp_path / "b"
    todo = Recording(again, sweeps=1, **SMALL)
    record_nuscenes(todo, workers=2)
    assert contents(again) == contents(root)
    # what a kill leaves: a scene half done, no tables
    for path in (again / todo.version).iterdir():
        path.unlink()
    part = again / ".parts" / "scene-oldmarket-000"
    (part / "part.json").unlink()
    next(part.glob("*.jpg")).write_bytes(b"torn")
    record_nuscenes(todo, workers=1)
    assert contents(again) == contents(root)
    with pytest.raises(StoreError, match="another recording"):
        record_nuscenes(Recording(again, **SMALL))


def test_wrong_use_is_refused_in_one_line(tmp_path: Path) -> None:
    for wrong in (
        {"towns": ("Nowhere",)},
        {"towns": ()},
        {"scenes": 0},
        {"width": 100},
        {"sweeps": 5},
        {"seconds": 0.1},
    ):
        with pytest.raises(ConfigError) as error:
            Recording(tmp_path, **wrong)  # type: ignore[arg-type]
        assert "\n" not in str(error.value)
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(StoreError):
        record_nuscenes(Recording(blocked / "out", **SMALL), workers=1)
