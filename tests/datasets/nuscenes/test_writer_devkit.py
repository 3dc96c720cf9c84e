"""What is written in the nuScenes schema, read by the official toolkit and by our own reader."""

from __future__ import annotations

import json
import math
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
from helpers.tiny import make_tiny

from ssad.core.seeding import generator
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.writer import NuScenesWriter

LOADER = Path(__file__).parents[2] / "helpers" / "devkit_load.py"


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
        [interpreter, str(LOADER), str(root), "v1.0-mini"], capture_output=True, text=True, check=False, timeout=550
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
