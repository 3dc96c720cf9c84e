"""Results files, ground truth from tables, splits, and their scores put together."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.devkit_sets import SPLIT, VERSION, make_set, write_set

from ssad.core.errors import ConfigError, FormatError
from ssad.core.nuscenes_names import ATTRIBUTES, CATEGORY_TO_CLASS, CLASSES
from ssad.datasets.nuscenes import results as module
from ssad.datasets.nuscenes.results import add_ego_distance, read_results
from ssad.datasets.nuscenes.score import score_results
from ssad.datasets.nuscenes.splits import official_splits, scenes_of_split
from ssad.datasets.nuscenes.truth import read_truth
from ssad.metrics.detection import BoxTable


def box(**changes: Any) -> dict[str, Any]:
    return {
        "sample_token": "s",
        "translation": [1.0, 2.0, 3.0],
        "size": [2.0, 4.0, 1.5],
        "rotation": [1.0, 0.0, 0.0, 0.0],
        "velocity": [0.5, -0.5],
        "detection_name": "car",
        "detection_score": 0.5,
        "attribute_name": "vehicle.parked",
    } | changes


def write(path: Path, results: Any, **more: Any) -> Path:
    path = path / "results.json"
    path.write_text(json.dumps({"meta": {"use_camera": True}, "results": results} | more))
    return path


def test_columns_are_those_of_the_file(tmp_path: Path) -> None:
    _, data = make_set("nan_velocity")
    path = write(tmp_path, data["results"])
    found = read_results(path)
    assert found.samples == tuple(data["results"])
    rows = [(token, b) for token, boxes in data["results"].items() for b in boxes]
    table = found.boxes
    assert [found.samples[i] for i in table.sample] == [token for token, _ in rows]
    columns = {
        "translation": table.centre,
        "size": table.size_lwh[:, [1, 0, 2]],
        "rotation": table.rotation,
        "velocity": table.velocity,
    }
    for name, values in columns.items():
        assert np.array_equal(values, np.array([b[name] for _, b in rows]), equal_nan=True), name
    assert [CLASSES[i] for i in table.label] == [b["detection_name"] for _, b in rows]
    names = ["" if i < 0 else ATTRIBUTES[i] for i in table.attribute]
    assert names == [b["attribute_name"] for _, b in rows]
    assert table.score.tolist() == [b["detection_score"] for _, b in rows]
    assert set(found.points.tolist()) == {-1}
    assert found.meta == {"use_camera": True}
    assert np.isnan(table.velocity).any()


def test_whole_numbers_missing_scores_and_points(tmp_path: Path) -> None:
    short = box(translation=[1, 2, 3], num_pts=7)
    del short["detection_score"]
    found = read_results(write(tmp_path, {"s": [box(velocity=[1, 0]), short]}))
    assert found.boxes.centre.tolist() == [[1.0, 2.0, 3.0]] * 2
    assert found.boxes.velocity.tolist() == [[1.0, 0.0], [0.5, -0.5]]
    assert found.boxes.score.tolist() == [0.5, -1.0]
    assert found.points.tolist() == [-1, 7]


@pytest.mark.parametrize("block", [7, 64, 1 << 20])
def test_nan_is_replaced_outside_of_strings_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block: int) -> None:
    monkeypatch.setattr(module, "BLOCK", block)
    token = 'a, NaN, \\" ["NaN'
    boxes = [box(sample_token=token, velocity=[math.nan, 1.0]), box(sample_token=token, velocity=[math.nan, math.nan])]
    found = read_results(write(tmp_path, {token: boxes, "NaN": [box(sample_token="NaN")]}, meta={"by": 'x\\\\"NaN"'}))
    assert found.samples == (token, "NaN")
    assert found.meta == {"by": 'x\\\\"NaN"'}
    expected = [[math.nan, 1.0], [math.nan, math.nan], [0.5, -0.5]]
    assert np.array_equal(found.boxes.velocity, expected, equal_nan=True)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"sample_token": "t"}, "box 1: its sample_token is 't'"),
        ({"detection_name": "tram"}, "box 1: unknown detection_name 'tram'"),
        ({"attribute_name": "fast"}, "box 1: unknown attribute_name 'fast'"),
        ({"translation": [math.nan, 0.0, 0.0]}, "box 1: its translation is NaN"),
        ({"size": [1.0, 1.0, math.nan]}, "box 1: its size is NaN"),
        ({"rotation": [None, 0.0, 0.0, 0.0]}, "box 1: its rotation is NaN"),
        ({"detection_score": math.nan}, "box 1: its score is NaN"),
        ({"size": [1.0, 1.0]}, "box 1: size: Expected `array` of length 3"),
        ({"velocity": [1.0, 1.0, 1.0]}, "box 1: velocity: Expected `array` of length 2"),
        ({"detection_score": "high"}, "box 1: detection_score: Expected `float"),
    ],
)
def test_a_bad_box_is_named(tmp_path: Path, change: dict[str, Any], says: str) -> None:
    path = write(tmp_path, {"r": [box(sample_token="r")], "s": [box(), box(**change)]})
    with pytest.raises(FormatError) as caught:
        read_results(path)
    assert str(caught.value).startswith(f"{path}: sample s: {says}")


def test_a_missing_field_is_named(tmp_path: Path) -> None:
    short = box()
    del short["rotation"]
    with pytest.raises(FormatError, match=r"sample s: box 0: Object missing required field `rotation`"):
        read_results(write(tmp_path, {"s": [short]}))


def test_samples_must_be_those_of_the_split(tmp_path: Path) -> None:
    path = write(tmp_path, {"t": [], "s": [box()]})
    with pytest.raises(FormatError, match="sample u is missing"):
        read_results(path, ["s", "t", "u"])
    with pytest.raises(FormatError, match="sample t is not in the split"):
        read_results(path, ["s"])
    assert read_results(path, ["s", "t"]).boxes.sample.tolist() == [0]
    assert read_results(path, ["t", "s"]).boxes.sample.tolist() == [1]


def test_a_custom_split_takes_its_samples_in_its_order(tmp_path: Path) -> None:
    boxes = {t: [box(sample_token=t, detection_score=0.1 * i)] for i, t in enumerate("abc")}
    found = read_results(write(tmp_path, boxes), ["c", "a"], subset=True)
    assert found.boxes.sample.tolist() == [0, 1]
    assert found.boxes.score.tolist() == [0.2, 0.0]


def test_500_boxes_and_no_more(tmp_path: Path) -> None:
    assert len(read_results(write(tmp_path, {"s": [box()] * 500})).boxes) == 500
    with pytest.raises(FormatError, match="sample s: 501 boxes"):
        read_results(write(tmp_path, {"s": [box()] * 501}))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "not valid JSON"),
        ('{"meta": {}, "results": {"s": [', "not valid JSON"),
        ('{"results": {}}', "missing required field `meta`"),
        ('{"meta": {}, "results": []}', "not a results file"),
        ('{"meta": {}, "results": {"s": [{"a": Infinity}]}}', "Infinity is not a number"),
        ('{"meta": {}, "results": {"s": {}}}', "sample s"),
    ],
)
def test_another_file_is_refused(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "results.json"
    path.write_text(text)
    with pytest.raises(FormatError, match=says):
        read_results(path)


def test_no_file(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="no such file"):
        read_results(tmp_path / "none.json")
    with pytest.raises(FormatError, match="cannot be read"):
        read_results(tmp_path)


def test_truth_is_that_of_the_tables(tmp_path: Path) -> None:
    root = write_set(tmp_path, "racks")
    tables, _ = make_set("racks")
    found = read_truth(root, VERSION, scenes=scenes_of_split(root, VERSION, SPLIT))
    assert found.scenes == ("scene-0103", "scene-0916")
    assert found.samples == tuple(s["token"] for s in tables["sample"] if s["scene_token"] != "scene-1")
    assert found.scene.tolist() == [0] * 5 + [1] * 5
    poses = {p["token"]: p["translation"] for p in tables["ego_pose"]}
    assert found.ego.tolist() == [poses[f"pose-key-{token}"] for token in found.samples]
    category = {i["token"]: i["category_token"] for i in tables["instance"]}
    names = {c["token"]: c["name"] for c in tables["category"]}
    own = [a for a in tables["sample_annotation"] if a["sample_token"] in found.samples]
    kinds = [names[category[a["instance_token"]]] for a in own]
    assert len(found.racks.sample) == kinds.count("static_object.bicycle_rack") == 80
    assert len(found.boxes) == sum(k.startswith("vehicle.") for k in kinds) - kinds.count("vehicle.emergency.police")
    first = [
        a for a, k in zip(own, kinds, strict=True) if a["sample_token"] == found.samples[0] and k.startswith("veh")
    ]
    assert found.boxes.centre[found.boxes.sample == 0].tolist() == [a["translation"] for a in first]
    assert found.visibility[found.boxes.sample == 0].tolist() == [int(a["visibility_token"]) for a in first]
    assert (np.diff(found.boxes.sample) >= 0).all()
    offset = found.boxes.centre[:, :2] - found.ego[found.boxes.sample, :2]
    assert np.array_equal(found.boxes.ego_distance, np.sqrt((offset**2).sum(axis=1)))


def test_velocity_is_that_of_the_devkit(tmp_path: Path) -> None:
    root = write_set(tmp_path, "single_frames")
    tables, _ = make_set("single_frames")
    rows = {a["token"]: a for a in tables["sample_annotation"]}
    time = {s["token"]: 1e-6 * s["timestamp"] for s in tables["sample"]}
    found = read_truth(root, VERSION)
    counted = {c["token"] for c in tables["category"] if c["name"] in CATEGORY_TO_CLASS}
    instances = {i["token"] for i in tables["instance"] if i["category_token"] in counted}
    kept = [a for token in found.samples for a in rows.values() if a["sample_token"] == token]
    kept = [a for a in kept if a["instance_token"] in instances]
    expected = []
    for a in kept:
        first, last = rows.get(a["prev"], a), rows.get(a["next"], a)
        elapsed = time[last["sample_token"]] - time[first["sample_token"]]
        limit = 3.0 if a["prev"] and a["next"] else 1.5
        known = (a["prev"] or a["next"]) and elapsed <= limit
        step = np.subtract(last["translation"], first["translation"])[:2]
        expected.append(step / elapsed if known else [math.nan, math.nan])
    assert np.array_equal(found.boxes.velocity, np.array(expected), equal_nan=True)
    assert 0.1 < np.isnan(expected).mean() < 0.95


def test_truth_of_chosen_samples_keeps_velocities(tmp_path: Path) -> None:
    root = write_set(tmp_path, "plain")
    whole = read_truth(root, VERSION, scenes=["scene-0916"])
    part = read_truth(root, VERSION, samples=whole.samples[2:4])
    assert part.samples == whole.samples[2:4]
    rows = np.isin(whole.boxes.sample, [2, 3])
    assert np.array_equal(part.boxes.velocity, whole.boxes.velocity[rows], equal_nan=True)
    with pytest.raises(ConfigError, match="none of the chosen scenes"):
        read_truth(root, VERSION, scenes=["scene-9999"])
    with pytest.raises(ConfigError, match="lacks 1"):
        read_truth(root, VERSION, samples=[whole.samples[0], "nowhere"])


@pytest.mark.parametrize(
    ("table", "change", "says"),
    [
        ("sample_annotation", {"prev": "nowhere"}, "its prev is not in its scene"),
        ("sample_annotation", {"instance_token": "nowhere"}, "instance.json has no record 'nowhere'"),
        ("sample_annotation", {"attribute_tokens": ["attribute-1", "attribute-2"]}, "more than one attribute"),
        ("sample_annotation", {"attribute_tokens": ["nowhere"]}, "unknown attribute 'nowhere'"),
        ("sample_data", {"is_key_frame": False}, "no key frame of LIDAR_TOP"),
        ("sample_data", {"ego_pose_token": "nowhere"}, "ego_pose.json: it has no record 'nowhere'"),
        ("instance", {"category_token": "nowhere"}, "category.json: it has no record 'nowhere'"),
        ("sample", {"scene_token": "nowhere"}, "scene.json: it has no record 'nowhere'"),
    ],
)
def test_a_broken_link_is_named(tmp_path: Path, table: str, change: dict[str, Any], says: str) -> None:
    root = write_set(tmp_path, "plain")
    path = root / VERSION / f"{table}.json"
    rows = json.loads(path.read_text())
    place = next(
        i for i, r in enumerate(rows) if table != "sample_data" or r["token"] == f"data-key-{rows[0]['sample_token']}"
    )
    rows[place] |= change
    path.write_text(json.dumps(rows))
    with pytest.raises(FormatError, match=says):
        read_truth(root, VERSION)


def test_splits(tmp_path: Path) -> None:
    official = official_splits()
    assert {name: len(scenes) for name, scenes in official.items()} == {
        "train": 700,
        "val": 150,
        "test": 150,
        "mini_train": 8,
        "mini_val": 2,
        "train_detect": 350,
        "train_track": 350,
    }
    assert len({s for name in ("train", "val", "test") for s in official[name]}) == 1000
    assert set(official["train_detect"]) | set(official["train_track"]) == set(official["train"])
    assert official["mini_val"] == ("scene-0103", "scene-0916")
    root = write_set(tmp_path, "plain")
    assert scenes_of_split(root, VERSION, "all") == ("scene-0103", "scene-0061", "scene-0916")
    with pytest.raises(ConfigError, match="unknown split 'night'"):
        scenes_of_split(root, VERSION, "night")
    (root / VERSION / "splits.json").write_text('{"night": ["scene-0916"]}')
    assert scenes_of_split(root, VERSION, "night") == ("scene-0916",)
    (root / VERSION / "splits.json").write_text('{"night": "scene-0916"}')
    with pytest.raises(FormatError, match="split 'night'"):
        scenes_of_split(root, VERSION, "night")


def test_score_results(tmp_path: Path) -> None:
    root = write_set(tmp_path, "plain")
    seen: list[Any] = []
    found = score_results(
        root / "results.json",
        dataroot=root,
        version=VERSION,
        split=SPLIT,
        replicates=20,
        check=lambda meta, truth: seen.append((meta, truth.scenes)) or {"data": "clean"},  # type: ignore[func-returns-value]
    )
    assert seen[0][1] == ("scene-0103", "scene-0916")
    own = found["ssad"]
    assert np.mean(list(own["dist_aps"].values())) == pytest.approx(found["mean_ap"])
    assert (own["samples"], own["scenes"]) == (16, 2)
    assert np.isnan(own["intervals"]["nd_score"]).all()  # two scenes are too few
    assert own["truth"]["car"] > 0
    (root / VERSION / "splits.json").write_text('{"first": ["scene-0103"]}')
    part = score_results(root / "results.json", dataroot=root, version=VERSION, split="first")
    assert part["ssad"]["samples"] == 8
    assert part["mean_ap"] != found["mean_ap"]


def test_score_results_names_the_file(tmp_path: Path) -> None:
    root = write_set(tmp_path, "plain")
    data = json.loads((root / "results.json").read_text())
    for boxes in data["results"].values():
        for one in boxes:
            one["size"] = [0.0, 1.0, 1.0]
    (root / "results.json").write_text(json.dumps(data))
    with pytest.raises(FormatError, match=r"results\.json: sample sample-.*all sides must be positive"):
        score_results(root / "results.json", dataroot=root, version=VERSION, split=SPLIT)


def test_with_ego() -> None:
    assert add_ego_distance(BoxTable.empty(1), np.array([[3.0, 4.0, 100.0]])).ego_distance.tolist() == [5.0]
