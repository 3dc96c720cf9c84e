"""The writer: complete tables, right chains, the same bytes each time, and refusals of wrong use."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ssad.core.errors import FormatError, StoreError
from ssad.core.nuscenes_names import ATTRIBUTES, CATEGORIES, CATEGORY_TO_CLASS
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.schema import TABLES
from ssad.datasets.nuscenes.tables import stream, table_path
from ssad.datasets.nuscenes.writer import NuScenesWriter

VERSION = "v1.0-mini"
NOW = 1_500_000_000_000_000
HERE = (1.0, 2.0, 0.0)
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
CAMERA: dict[str, Any] = {
    "modality": "camera",
    "translation": (1.5, 0, 1.5),
    "rotation": (0.5, -0.5, 0.5, -0.5),
    "intrinsic": np.diag([500.0, 500.0, 1.0]),
}


def fill(root: Path, *, name: str | None = None, order: tuple[int, ...] = (0, 1, 2, 3)) -> None:
    """One scene: key frames at even steps of a quarter second, sweeps at odd ones, added in the order given."""
    with NuScenesWriter(root, VERSION) as writer:
        scene = writer.add_scene(name)
        writer.add_sensor(scene, "CAM_FRONT", **CAMERA)
        thing = writer.add_instance(scene, "one", category="vehicle.car")
        writer.add_instance(scene, "never seen", category="vehicle.bus.rigid")
        for step in order:
            time = NOW + 250_000 * step
            sample = writer.add_sample(scene, time) if step % 2 == 0 else None
            writer.add_sensor_frame(
                scene,
                "CAM_FRONT",
                timestamp_us=time,
                data=f"image {step}".encode(),
                ego_translation=HERE,
                sample=sample,
                size=(32, 18),
            )
            if sample is not None:
                writer.add_annotation(
                    sample,
                    thing,
                    translation=(5.0 + step, 0, 1),
                    size=(2, 4, 1.5),
                    rotation=UPRIGHT,
                    visibility="2",
                    attributes=["vehicle.moving"],
                    lidar_points=7,
                )


def table(root: Path, name: str) -> list[Any]:
    return [record for block in stream(table_path(root, VERSION, name), TABLES[name]) for record in block]


def test_tables_are_complete(tmp_path: Path) -> None:
    fill(tmp_path)
    assert sorted(path.name for path in (tmp_path / VERSION).iterdir()) == sorted(
        [*(f"{name}.json" for name in TABLES), "splits.json"]
    )
    assert [row.token for row in table(tmp_path, "visibility")] == ["1", "2", "3", "4"]
    assert [row.level for row in table(tmp_path, "visibility")] == ["v0-40", "v40-60", "v60-80", "v80-100"]
    assert {row.name for row in table(tmp_path, "attribute")} == set(ATTRIBUTES)
    categories = {row.name for row in table(tmp_path, "category")}
    assert categories == set(CATEGORIES)
    assert len(categories) == 23
    assert set(CATEGORY_TO_CLASS) < categories
    (plan,) = table(tmp_path, "map")
    assert set(plan.log_tokens) == {row.token for row in table(tmp_path, "log")}
    assert (tmp_path / plan.filename).read_bytes()[:4] == b"\x89PNG"
    for name in set(TABLES) - {"visibility"}:
        assert all(len(row.token) == 32 and int(row.token, 16) >= 0 for row in table(tmp_path, name))
    assert not list(tmp_path.rglob("*.tmp*"))


def test_chains(tmp_path: Path) -> None:
    fill(tmp_path, order=(2, 3, 0, 1))
    (scene,) = table(tmp_path, "scene")
    samples = {row.token: row for row in table(tmp_path, "sample")}
    first, last = samples[scene.first_sample_token], samples[scene.last_sample_token]
    assert (first.timestamp, last.timestamp, scene.nbr_samples) == (NOW, NOW + 500_000, 2)
    assert (first.prev, first.next, last.prev, last.next) == ("", last.token, first.token, "")
    frames = sorted(table(tmp_path, "sample_data"), key=lambda row: row.timestamp)
    assert [row.is_key_frame for row in frames] == [True, False, True, False]
    # a sweep belongs to the sample that follows it, the last ones to the last sample
    assert [row.sample_token for row in frames] == [first.token, last.token, last.token, last.token]
    assert [row.next for row in frames] == [*(row.token for row in frames[1:]), ""]
    assert [row.prev for row in frames] == ["", *(row.token for row in frames[:-1])]
    assert [row.filename.split("/")[0] for row in frames] == ["samples", "sweeps", "samples", "sweeps"]
    assert [(tmp_path / row.filename).read_bytes() for row in frames] == [f"image {i}".encode() for i in range(4)]
    assert {(row.fileformat, row.width, row.height) for row in frames} == {("jpg", 32, 18)}
    (instance,) = table(tmp_path, "instance")  # the one that was never seen is left out
    boxes = {row.token: row for row in table(tmp_path, "sample_annotation")}
    assert instance.nbr_annotations == 2
    assert boxes[instance.first_annotation_token].next == instance.last_annotation_token
    assert boxes[instance.last_annotation_token].prev == instance.first_annotation_token
    assert boxes[instance.first_annotation_token].translation == (5.0, 0.0, 1.0)


def test_reads_back(tmp_path: Path) -> None:
    fill(tmp_path)
    data = NuScenes(tmp_path)
    scene = data.scene("scene-0103")
    assert [frame.key_frame for frame in scene.frames] == [True, False, True, False]
    assert scene.frames[0].ego_to_world[:3, 3].tolist() == list(HERE)
    boxes = scene.annotations(scene.samples[1].token)
    assert (boxes.category, boxes.attributes, boxes.visibility) == (("vehicle.car",), (("vehicle.moving",),), ("2",))
    assert (boxes.lidar_points.tolist(), boxes.centre.tolist()) == ([7], [[7, 0, 1]])


def test_same_bytes_whatever_the_folder(tmp_path: Path) -> None:
    for name in ("a", "b"):
        fill(tmp_path / name)
    files = sorted(path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*") if path.is_file())
    assert len(files) == 14 + 4 + 1
    assert all((tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes() for file in files)


def test_scene_names_and_splits(tmp_path: Path) -> None:
    with NuScenesWriter(tmp_path, VERSION) as writer:
        for i in range(12):
            writer.add_sample(writer.add_scene("scene-9001" if i == 3 else None), NOW + i)
    names = [row.name for row in table(tmp_path, "scene")]
    assert names[:2] == ["scene-0103", "scene-0916"]
    assert names[3] == "scene-9001"
    assert names[-1] == "scene-9002"
    assert len(set(names)) == 12
    splits = json.loads((tmp_path / VERSION / "splits.json").read_text())
    assert splits["all"] == names
    assert splits["mini_val"] == ["scene-0103", "scene-0916"]
    assert len(splits["mini_train"]) == 8
    with NuScenesWriter(tmp_path, VERSION) as writer:
        writer.add_sample(writer.add_scene("drive-1"), NOW)
        writer.set_split("val", ["drive-1"])
    assert json.loads((tmp_path / VERSION / "splits.json").read_text()) == {"val": ["drive-1"]}


def test_files_may_be_linked(tmp_path: Path) -> None:
    source = tmp_path / "source.pcd.bin"
    source.write_bytes(b"12345")
    for _ in range(2):  # a second run replaces the link
        with NuScenesWriter(tmp_path / "set", VERSION) as writer:
            scene = writer.add_scene()
            writer.add_sensor(scene, "LIDAR_TOP", modality="lidar", translation=HERE, rotation=UPRIGHT)
            sample = writer.add_sample(scene, NOW)
            options: dict[str, Any] = {"ego_translation": HERE, "sample": sample}
            writer.add_sensor_frame(scene, "LIDAR_TOP", timestamp_us=NOW, data=source, **options)
            with pytest.raises(FormatError, match="no such file to link"):
                writer.add_sensor_frame(scene, "LIDAR_TOP", timestamp_us=NOW + 1, data=tmp_path / "gone", **options)
    (path,) = (tmp_path / "set" / "samples" / "LIDAR_TOP").iterdir()
    assert path.name.endswith(".pcd.bin")
    assert os.path.samefile(path, source)


def test_wrong_use_is_refused(tmp_path: Path) -> None:
    writer = NuScenesWriter(tmp_path, VERSION)
    scene, other = writer.add_scene(), writer.add_scene()
    sample = writer.add_sample(scene, NOW)
    thing, strange = writer.add_instance(scene, "a", category="animal"), writer.add_instance(other, "a", category="x")
    frame: dict[str, Any] = {"timestamp_us": NOW, "data": b"", "ego_translation": HERE, "sample": sample}
    box: dict[str, Any] = {"translation": HERE, "size": (1, 1, 1), "rotation": UPRIGHT}
    with pytest.raises(ValueError, match="added before"):
        writer.add_scene("scene-0103")
    with pytest.raises(ValueError, match="added before"):
        writer.add_sample(scene, NOW)
    with pytest.raises(ValueError, match="no sensor"):
        writer.add_sensor_frame(scene, "CAM_FRONT", **frame)
    with pytest.raises(ValueError, match="modality"):
        writer.add_sensor(scene, "SONAR", modality="sonar", translation=HERE, rotation=UPRIGHT)
    writer.add_sensor(scene, "CAM_FRONT", **CAMERA)
    writer.add_sensor(other, "CAM_FRONT", **CAMERA)
    with pytest.raises(ValueError, match="another scene"):
        writer.add_sensor_frame(other, "CAM_FRONT", **frame)
    writer.add_sensor_frame(scene, "CAM_FRONT", **frame)
    with pytest.raises(ValueError, match="two files"):
        writer.add_sensor_frame(scene, "CAM_FRONT", **frame)
    with pytest.raises(ValueError, match="different scenes"):
        writer.add_annotation(sample, strange, **box)
    with pytest.raises(ValueError, match="Visibility"):
        writer.add_annotation(sample, thing, visibility="5", **box)
    with pytest.raises(ValueError, match="not finite"):
        writer.add_annotation(sample, thing, **(box | {"size": (1, math.nan, 1)}))
    writer.add_annotation(sample, thing, **box)
    with pytest.raises(ValueError, match="added before"):
        writer.add_annotation(sample, thing, **box)
    with pytest.raises(ValueError, match="no sample"):
        writer.close()  # the other scene is empty
    with pytest.raises(ValueError, match="at least one scene"):
        NuScenesWriter(tmp_path, VERSION).close()


def test_no_tables_after_an_error(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no Scene"), NuScenesWriter(tmp_path, VERSION) as writer:
        writer.add_sample("gone", NOW)
    assert list((tmp_path / VERSION).iterdir()) == []
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match="cannot write"):
        NuScenesWriter(tmp_path / "file", VERSION)


@settings(max_examples=25, deadline=None)
@given(
    steps=st.lists(st.integers(0, 30), min_size=1, max_size=8, unique=True),
    seen=st.lists(st.sets(st.integers(0, 7)), min_size=1, max_size=4),
)
def test_any_set_reads_back(tmp_path: Path, steps: list[int], seen: list[set[int]]) -> None:
    """Whatever the order and the gaps, the reader finds every box at its time and its chains in order."""
    with NuScenesWriter(tmp_path, VERSION) as writer:
        scene = writer.add_scene()
        samples = [writer.add_sample(scene, NOW + 100_000 * step) for step in steps]
        for number, where in enumerate(seen):
            thing = writer.add_instance(scene, str(number), category="vehicle.car")
            for i in where & set(range(len(steps))):
                place = (float(number), float(steps[i]), 0.0)
                writer.add_annotation(samples[i], thing, translation=place, size=(1, 1, 1), rotation=UPRIGHT)
    found = NuScenes(tmp_path).scene("scene-0103")
    assert [sample.timestamp for sample in found.samples] == [NOW + 100_000 * step for step in sorted(steps)]
    for i, token in enumerate(samples):
        boxes = found.annotations(token)
        expected = {(float(number), float(steps[i]), 0.0) for number, where in enumerate(seen) if i in where}
        assert {tuple(row) for row in boxes.centre.tolist()} == expected
        known = boxes.velocity[~np.isnan(boxes.velocity[:, 1])]
        np.testing.assert_allclose(known, np.broadcast_to([0.0, 10.0, 0.0], known.shape), rtol=1e-5, atol=1e-9)
