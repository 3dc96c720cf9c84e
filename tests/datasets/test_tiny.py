"""The drawn data set: the same bytes, boxes that fit points and pictures, and the official toolkit's own reading."""

from __future__ import annotations

import json
import math
import os
import subprocess
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssad.core.errors import StoreError
from ssad.core.images import read_image
from ssad.core.nuscenes_names import ATTRIBUTES, CATEGORY_TO_CLASS
from ssad.core.rotations import quaternion_to_matrix
from ssad.core.seeding import generator
from ssad.datasets.nuscenes.reader import NuScenes, SceneData, SensorFrame, read_points
from ssad.datasets.nuscenes.tiny import RIG, make_tiny
from ssad.datasets.nuscenes.writer import NuScenesWriter

LOADER = Path(__file__).parent.parent / "helpers" / "devkit_load.py"


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_tiny(tmp_path_factory.mktemp("tiny"))


@pytest.fixture(scope="module")
def scenes(root: Path) -> list[SceneData]:
    data = NuScenes(root)
    return [data.scene(scene.token) for scene in data.scenes()]


def to_sensor(frame: SensorFrame, points: Any) -> Any:
    """World points [N, 3] in the frame of a sensor."""
    matrix = np.linalg.inv(frame.ego_to_world @ frame.sensor_to_ego)
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def key_frames(scene: SceneData, sample: str) -> dict[str, SensorFrame]:
    return {frame.channel: frame for frame in scene.frames if frame.key_frame and frame.sample_token == sample}


def test_contents(scenes: list[SceneData], root: Path) -> None:
    assert len(scenes) == 2
    for scene in scenes:
        assert len(scene.samples) == 3
        assert len(scene.frames) == 7 * 5
        tables = [scene.annotations(sample.token) for sample in scene.samples]
        assert all(8 <= len(boxes) <= 12 for boxes in tables)
        classes = {CATEGORY_TO_CLASS[category] for boxes in tables for category in boxes.category}
        assert {"car", "pedestrian", "bicycle"} <= classes
        assert {name for boxes in tables for names in boxes.attributes for name in names} <= set(ATTRIBUTES)
        assert {"vehicle.moving", "vehicle.parked", "pedestrian.moving"} <= {
            name for boxes in tables for names in boxes.attributes for name in names
        }
        assert all(set(boxes.visibility) <= {"1", "2", "3", "4"} for boxes in tables)
        way = [frame.ego_to_world[:3, 3] for frame in scene.frames if frame.channel == "LIDAR_TOP"]
        assert 6.0 < math.dist(way[0], way[-1]) < 8.0
    assert {category for scene in scenes for sample in scene.samples
            for category in scene.annotations(sample.token).category} >= {"vehicle.truck"}  # fmt: skip
    assert not list(root.rglob("*.tmp*"))


def test_pictures_have_structure_and_move(scenes: list[SceneData], root: Path) -> None:
    for scene in scenes:
        for channel in RIG:
            images = [read_image(root / frame.filename).astype(float) for frame in scene.frames
                      if frame.channel == channel]  # fmt: skip
            assert {image.shape for image in images} == {(450, 800, 3)}
            assert min(image.std() for image in images) > 20
            assert min(np.abs(a - b).mean() for a, b in pairwise(images)) > 0.5


def test_a_cone_is_orange_where_its_box_is(scenes: list[SceneData], root: Path) -> None:
    checked = 0
    for scene in scenes:
        for sample in scene.samples:
            boxes, frames = scene.annotations(sample.token), key_frames(scene, sample.token)
            for i in (i for i, name in enumerate(boxes.category) if name == "movable_object.trafficcone"):
                for channel in RIG:
                    frame = frames[channel]
                    x, y, z = to_sensor(frame, boxes.centre[i] - [0, 0, 0.15])
                    if not 1.0 < z < 20.0:
                        continue
                    assert frame.intrinsic is not None
                    u, v, _ = frame.intrinsic @ (x / z, y / z, 1.0)
                    if 2 <= u < 798 and 2 <= v < 448:
                        red, green, blue = read_image(root / frame.filename)[round(v), round(u)].astype(int)
                        assert red > green + 40 > blue + 40
                        checked += 1
    assert checked > 0


def test_point_counts_are_those_of_the_sweeps(scenes: list[SceneData], root: Path) -> None:
    total = 0
    for scene in scenes:
        for sample in scene.samples:
            frame = key_frames(scene, sample.token)["LIDAR_TOP"]
            points = read_points(root / frame.filename)
            matrix = frame.ego_to_world @ frame.sensor_to_ego
            world = points[:, :3].astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
            boxes = scene.annotations(sample.token)
            turns = quaternion_to_matrix(boxes.rotation)
            for i in range(len(boxes)):
                local = (world - boxes.centre[i]) @ turns[i]
                half = boxes.size[i][[1, 0, 2]] / 2
                least = np.count_nonzero((np.abs(local) < half - 1e-4).all(axis=1))
                most = np.count_nonzero((np.abs(local) < half + 1e-4).all(axis=1))
                assert least <= boxes.lidar_points[i] <= most
                total += int(boxes.lidar_points[i])
    assert total > 500


def test_sweeps_look_like_a_lidar(scenes: list[SceneData], root: Path) -> None:
    for scene in scenes:
        for frame in scene.frames:
            if frame.channel != "LIDAR_TOP":
                continue
            points = read_points(root / frame.filename).astype(np.float64)
            ring = points[:, 4]
            assert set(ring) <= set(range(32))
            elevation = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
            np.testing.assert_allclose(elevation, -30 + 40 * ring / 31, atol=1e-3)
            assert points[:, 2].min() > -1.85
            assert 0 <= points[:, 3].min() < points[:, 3].max() <= 255
            assert len(points) > 5000


def test_velocities_are_those_of_the_objects(scenes: list[SceneData]) -> None:
    for scene in scenes:
        for sample in scene.samples:
            boxes = scene.annotations(sample.token)
            speed = np.linalg.norm(boxes.velocity, axis=1)
            heading = quaternion_to_matrix(boxes.rotation)[:, :, 0]
            for i, names in enumerate(boxes.attributes):
                if any(name.endswith((".moving", "with_rider")) for name in names):
                    assert speed[i] > 1.0
                    np.testing.assert_allclose(boxes.velocity[i], speed[i] * heading[i], atol=1e-5)
                else:
                    assert speed[i] == 0.0


def test_same_arguments_same_bytes(tmp_path: Path) -> None:
    sets = [make_tiny(tmp_path / name, scenes=1, samples=2, size=(80, 45), seed=seed) for name, seed in
            (("a", 5), ("b", 5), ("c", 6))]  # fmt: skip
    files = [{path.relative_to(root): path.read_bytes() for path in root.rglob("*") if path.is_file()} for root in sets]
    assert files[0] == files[1]
    assert files[0].keys() == files[2].keys()
    assert sum(files[0][name] != files[2][name] for name in files[0]) > 20


def test_sizes_and_bad_arguments(tmp_path: Path) -> None:
    root = make_tiny(tmp_path / "one", scenes=1, samples=1, sweeps=3, size=(64, 64), version="v1.0-test")
    scene = NuScenes(root, "v1.0-test").scene("scene-0103")
    assert [frame.key_frame for frame in scene.frames] == [True] * 7
    assert read_image(root / scene.frames[0].filename).shape == (64, 64, 3)
    with pytest.raises(ValueError, match="at least"):
        make_tiny(tmp_path, samples=0)
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError):
        make_tiny(tmp_path / "file")


def test_a_long_drive_keeps_objects_near(tmp_path: Path) -> None:
    root = make_tiny(tmp_path, scenes=1, samples=20, sweeps=0, size=(32, 18))
    scene = NuScenes(root).scene("scene-0103")
    counts = [len(scene.annotations(sample.token)) for sample in scene.samples]
    assert min(counts) >= 3
    assert max(counts) > min(counts)  # objects come and go


def make_wild(root: Path) -> Path:
    """Key frames up to 4 s apart, objects that come and go, rotations of any kind and length, sweeps out of range."""
    random = generator("wild")
    with NuScenesWriter(root) as writer:
        for _ in range(3):
            scene = writer.add_scene()
            writer.add_sensor(scene, "LIDAR_TOP", modality="lidar", translation=(0, 0, 2), rotation=(1, 0, 0, 0))
            things = [writer.add_instance(scene, str(i), category="animal") for i in range(12)]
            turns = random.normal(size=(12, 4))
            times = np.cumsum(random.choice([400_000, 1_000_000, 1_600_000, 4_000_000], 12)).tolist()
            for time in times:
                sample = writer.add_sample(scene, time)
                turns += random.normal(size=(12, 4)) * random.choice([0.001, 0.05, 2.0], (12, 1))
                turns *= random.choice([-1.0, 1.0, 1.5], (12, 1), p=[0.3, 0.5, 0.2])
                for i in np.flatnonzero(random.random(12) < 0.7):
                    place = random.uniform(-500, 2000, 3).tolist()
                    writer.add_annotation(sample, things[i], translation=place, size=(1, 2, 3), rotation=turns[i])
                for offset in (0, -100_000, -300_001, 50_000):
                    writer.add_sensor_frame(
                        scene,
                        "LIDAR_TOP",
                        timestamp_us=time + offset,
                        data=b"",
                        ego_translation=(time * 1e-6, 0, 0),
                        sample=None if offset else sample,
                    )
    return root


@pytest.mark.parametrize("kind", ["tiny", "wild"])
def test_official_toolkit_reads_the_same(tmp_path: Path, kind: str) -> None:
    """Frames, boxes at key frames and sweeps, and velocities, against nuscenes-devkit's own."""
    interpreter = os.environ.get("SSAD_DEVKIT_PYTHON")
    if not interpreter:
        pytest.skip("set SSAD_DEVKIT_PYTHON to a Python that has nuscenes-devkit 1.2.0")
    root = make_tiny(tmp_path, samples=6, sweeps=2, size=(64, 36)) if kind == "tiny" else make_wild(tmp_path)
    done = subprocess.run(
        [interpreter, str(LOADER), str(root), "v1.0-mini"], capture_output=True, text=True, check=False, timeout=300
    )
    assert done.returncode == 0, done.stderr
    theirs = json.loads(done.stdout)
    data = NuScenes(root)
    frames, boxes_seen = 0, 0
    for record in data.scenes():
        scene = data.scene(record.token)
        known = theirs["scenes"][record.name]
        assert [sample.token for sample in scene.samples] == known["samples"]
        assert scene.log is not None
        assert scene.log.location == known["location"]
        for frame in scene.frames:
            other = theirs["frames"][frame.token]
            assert (frame.channel, frame.modality) == (other["channel"], other["modality"])
            assert (frame.timestamp_us, frame.key_frame) == (other["timestamp"], other["key"])
            assert frame.ego_to_world[:3, 3].tolist() == other["ego"]
            found = scene.annotations_of(frame)
            assert list(found.token) == [box["token"] for box in other["boxes"]]
            assert list(found.category) == [box["name"] for box in other["boxes"]]
            for name in ("centre", "size", "rotation"):
                column = np.array([box[name] for box in other["boxes"]])
                np.testing.assert_allclose(getattr(found, name), column, rtol=0, atol=1e-9)
            frames, boxes_seen = frames + 1, boxes_seen + len(found)
        for sample in scene.samples:
            found = scene.annotations(sample.token)
            velocity = [[math.nan if v is None else v for v in theirs["velocity"][token]] for token in found.token]
            np.testing.assert_allclose(found.velocity, velocity, rtol=0, atol=1e-9)
            counts = zip(found.lidar_points.tolist(), found.radar_points.tolist(), found.category, strict=True)
            assert [list(row) for row in counts] == [theirs["counts"][token] for token in found.token]
    assert frames == len(theirs["frames"]) > 100
    assert boxes_seen > 1000
