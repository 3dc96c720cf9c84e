"""Pictures of one car for 2D detection: what `ssad record --clips` writes."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from helpers.bodies import plain_bodies, two_phases
from helpers.sharing import Shared

from ssad.core.detections import Truth
from ssad.core.errors import ConfigError, FormatError, StoreError
from ssad.core.images import encode_jpeg
from ssad.core.seeding import generator
from ssad.core.types import F64, EpisodeTrace
from ssad.experiments.perception.physical.target_views import solid_target, target_truth
from ssad.recorders import target_images
from ssad.recorders.drives import make_drive
from ssad.recorders.nuscenes import drive_with_autopilot
from ssad.recorders.target_images import (
    CLASSES,
    HIDDEN,
    MIN_VISIBLE_SHARE,
    SECONDS,
    TARGET,
    _add_target_body,
    record_target_images,
    recorded_views,
)
from ssad.recorders.target_recording import FOCAL, SMALL, TargetRecording, pair_images
from ssad.recorders.viewpoints import (
    AIM,
    CAR_EYE,
    MIN_CAMERA_HEIGHT,
    following_viewpoints,
    look_at,
    polar,
    shuffled_cells,
    weather_name,
)
from ssad.rendering.camera.effects import DEFAULT_EFFECTS, NO_EFFECTS
from ssad.rendering.camera.labels import label_image
from ssad.rendering.camera.render import SceneWeather, render
from ssad.rendering.camera.scene import TextureLayer
from ssad.rendering.scene_objects import SceneObjects
from ssad.rendering.target import Target, TargetCar, TargetSign, TargetWalker, parse_target
from ssad.world.roads import load_town

PAIRS = (("Twinford", 4), ("Oldmarket", 3))
BOTH = pytest.mark.parametrize("mode", ["drives", pytest.param("orbits", marks=pytest.mark.slow)])
DISTANCES, AZIMUTHS, ELEVATIONS = (5.0, 10.0, 20.0), (0.0, 90.0, 180.0, 270.0), (0.0, 15.0, 30.0)


def todo(out: Path, mode: str, **changes: Any) -> TargetRecording:
    """A small recording."""
    given: dict[str, Any] = {"images": PAIRS, "mode": mode, "size": 160, "held_out": ("Oldmarket",)}
    if mode == "orbit":
        given |= {"distances": DISTANCES, "azimuths": AZIMUTHS, "elevations": ELEVATIONS}
    return TargetRecording(out, **(given | changes))


def contents(root: Path) -> dict[str, str]:
    """Hash of every picture and page."""
    return {
        str(p.relative_to(root)): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(root.rglob("*"))
        if p.is_file() and ".parts" not in p.parts
    }


def read(root: Path, split: str = "all") -> dict[str, Any]:
    found: dict[str, Any] = json.loads((root / "annotations" / f"{split}.json").read_text())
    return found


class Stopped(Exception):
    """Somebody ended the recording."""


@pytest.fixture(scope="session")
def drives(shared: Shared) -> Path:
    """A recording that was stopped after its first part and then gone on with. All but the target are plain boxes."""

    def make(out: Path) -> None:
        with plain_bodies():
            _stopped_recording(out)

    return shared("clips-drive", make)


def _stopped_recording(out: Path) -> None:
    def stop(done: int, of: int) -> None:
        assert (done, of) == (1, 2)
        raise Stopped

    with pytest.raises(Stopped):
        record_target_images(todo(out, "drive"), workers=0, progress=stop)
    assert not (out / "annotations").exists()
    page = out / ".parts" / "drive-twinford-000" / "part.json"
    assert list((out / ".parts").glob("*/part.json")) == [page]
    # what a kill leaves of the next part
    (out / "images" / "drive-oldmarket-000-001.jpg").write_bytes(b"torn")
    steps: list[tuple[int, int]] = []
    before = page.stat().st_mtime_ns
    record_target_images(todo(out, "drive"), workers=0, progress=lambda done, of: steps.append((done, of)))
    assert steps == [(1, 2), (2, 2)]
    assert page.stat().st_mtime_ns == before, "what was there is left alone"


@pytest.fixture(scope="module")
def market() -> EpisodeTrace:
    """The drive of the pictures in Oldmarket, driven again."""
    graph = load_town("Oldmarket")
    return drive_with_autopilot(make_drive(graph, key=("clips", 0, "drive", "Oldmarket", 0, 0), seconds=SECONDS), graph)


@pytest.fixture(scope="session")
def orbits(shared: Shared) -> Path:
    return shared("clips-orbit", lambda out: record_target_images(todo(out, "orbit"), workers=0))


def target_of(data: dict[str, Any], row: dict[str, Any]) -> dict[str, Any]:
    """The one annotation of a picture's target."""
    own = [a for a in data["annotations"] if a["image_id"] == row["id"] and a["target"]]
    assert len(own) == 1
    return dict(own[0])


def place_of(row: dict[str, Any]) -> tuple[float, float, float]:
    """Distance, azimuth and elevation of a row's camera, from its poses."""
    pose, target = np.array(row["pose"]), np.array(row["target_pose"])
    ahead, left, up = np.linalg.inv(target)[:3] @ [*pose[:3, 3], 1.0] - [0.0, 0.0, AIM]
    away = float(np.sqrt(ahead**2 + left**2 + up**2))
    return away, float(np.degrees(np.arctan2(left, ahead))) % 360.0, float(np.degrees(np.arcsin(up / away)))


def turned(a: float, b: float) -> float:
    """Degrees between two angles."""
    return abs((a - b + 180.0) % 360.0 - 180.0)


def test_a_drive_is_seen_from_20_m_of_way_behind(drives: Path, market: EpisodeTrace) -> None:
    rows = read(drives)["images"]
    for row in rows:
        away, azimuth, elevation = place_of(row)
        assert row["distance"] == pytest.approx(away, abs=0.01)
        assert 10.0 < away < 20.1
        assert turned(row["azimuth"], azimuth) < 0.1
        assert row["elevation"] == pytest.approx(elevation, abs=0.1)
        assert np.array(row["pose"])[2, 3] == pytest.approx(2.0)
    # one that takes the place of another comes out of turn
    for before, after in pairwise(sorted(rows, key=lambda row: (row["drive"], row["time"]))):
        if before["drive"] == after["drive"]:
            assert after["way"] - before["way"] >= 1.0 - 0.011
            moved = np.array(after["target_pose"])[:2, 3] - np.array(before["target_pose"])[:2, 3]
            assert np.hypot(*moved) >= 0.9, "on a bend the chord is shorter than the way"
    assert len({row["drive"] for row in rows}) == 2
    trace = market
    xy = np.stack([trace.x[:, 0], trace.y[:, 0]], -1).astype(float)
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xy, axis=0).T))])
    for row in [r for r in rows if r["town"] == "Oldmarket"]:
        step = round(row["time"] / trace.dt)
        assert np.allclose(np.array(row["target_pose"])[:2, 3], xy[step], atol=1e-3)
        assert row["way"] == pytest.approx(way[step], abs=0.1)
        behind = [np.interp(way[step] - 20.0, way, xy[:, k]) for k in (0, 1)]
        assert np.hypot(*(np.array(row["pose"])[:2, 3] - behind)) < 0.15


def test_an_approach_sees_each_distance_in_turn_and_no_bends(
    market: EpisodeTrace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every image that is missing is proposed from the distance that falls to it, again and again."""
    monkeypatch.setattr(target_images, "has_free_sight", lambda *given, **options: np.ones(1, bool))
    recording = todo(tmp_path, "drive", approach=(5.0, 15.0, 30.0), size=640)
    drive: Any = SimpleNamespace(recording=recording, trace=market, key=(0,), scene=None)
    slots, taken = range(25, 34), {0, 4}
    rounds = target_images._approaching_rounds(
        drive, "Oldmarket", slots, lambda: [k for k in range(9) if k not in taken], np.random.default_rng(0)
    )
    first, second = next(rounds), next(rounds)
    assert [slot for slot, _ in first] == [k for k in range(9) if k not in taken]
    distances = {slot: viewpoint.description["distance"] for slot, viewpoint in first}
    assert set(distances.values()) <= {5.0, 15.0, 30.0}
    assert len(set(distances.values())) == 3
    for slot, viewpoint in [*first, *second]:
        distance = distances[slot]
        assert viewpoint.description["distance"] == distance
        apart = np.linalg.norm(viewpoint.camera[:2, 3] - viewpoint.target[:2, 3])
        assert 0.94 * distance < apart < 1.01 * distance
    assert [shot.time for _, shot in first] != [shot.time for _, shot in second], "other moments"


@pytest.mark.slow
def test_an_orbit_is_seen_from_where_its_row_says(orbits: Path) -> None:
    """By default an orbit round a sign shows it, below."""
    rows = read(orbits)["images"]
    assert len({row["target_style"] for row in rows}) > 1
    cells = set()
    for row in rows:
        away, azimuth, elevation = place_of(row)
        assert away == pytest.approx(row["distance"], abs=0.01)
        assert turned(azimuth, row["azimuth"]) < 0.05
        lowest = float(np.degrees(np.arcsin((MIN_CAMERA_HEIGHT - AIM) / row["distance"])))
        assert elevation == pytest.approx(max(row["elevation"], lowest), abs=0.05)
        assert (row["distance"], row["azimuth"], row["elevation"]) not in cells or row["town"] != "Twinford"
        cells.add((row["distance"], row["azimuth"], row["elevation"]))
    assert {c[0] for c in cells} <= set(DISTANCES)
    assert {c[1] for c in cells} <= set(AZIMUTHS)
    assert {c[2] for c in cells} <= set(ELEVATIONS)


@BOTH
def test_towns_of_train_and_test_are_apart(mode: str, request: pytest.FixtureRequest) -> None:
    root = request.getfixturevalue(mode)
    parts = {split: read(root, split) for split in ("train", "test", "all")}
    assert {row["town"] for row in parts["train"]["images"]} == {"Twinford"}
    assert {row["town"] for row in parts["test"]["images"]} == {"Oldmarket"}
    for split, data in parts.items():
        files = [row["file_name"] for row in data["images"]]
        assert len(set(files)) == len(files) == data["info"]["images"]
        assert data["info"]["split"] == split
        assert sum(data["info"]["weathers"].values()) == len(files)
        names = {c["id"]: c["name"] for c in data["categories"]}
        counts = Counter(names[a["category_id"]] for a in data["annotations"] if not a["iscrowd"])
        assert data["info"]["objects"] == counts
    whole = [row["file_name"] for split in ("train", "test") for row in parts[split]["images"]]
    assert [row["file_name"] for row in parts["all"]["images"]] == whole
    assert sorted(p.name for p in (root / "images").iterdir()) == sorted(whole)


@BOTH
def test_boxes_are_in_the_picture_and_the_target_lies_in_its_3d_box(mode: str, request: pytest.FixtureRequest) -> None:
    root = request.getfixturevalue(mode)
    data = read(root)
    sizes = {row["id"]: (row["width"], row["height"]) for row in data["images"]}
    for thing in data["annotations"]:
        x, y, w, h = thing["bbox"]
        width, height = sizes[thing["image_id"]]
        assert w > 0
        assert h > 0
        assert 0 <= x < x + w <= width
        assert 0 <= y < y + h <= height
        assert 0 < thing["area"] <= w * h
        # the share is rounded to three decimals
        if abs(thing["visible"] - HIDDEN) > 1e-3:
            assert thing["iscrowd"] == (min(w, h) < SMALL or thing["visible"] < HIDDEN)
    for row in data["images"]:
        image = cv2.imread(str(root / "images" / row["file_name"]))
        assert image is not None
        assert image.shape == (row["height"], row["width"], 3)
        assert row["weather"] == weather_name(SceneWeather(**row["light"]))
        thing = target_of(data, row)
        assert not thing["iscrowd"]
        assert thing["visible"] >= MIN_VISIBLE_SHARE
        assert data["categories"][thing["category_id"] - 1]["name"] == "car"
        x0, y0, x1, y1 = projected(row)
        x, y, w, h = thing["bbox"]
        assert x0 - 1 <= x
        assert y0 - 1 <= y
        assert x + w <= x1 + 1
        assert y + h <= y1 + 1
        seen, whole = (target_truth(row, [thing], CLASSES, whole=chosen).box[0].tolist() for chosen in (False, True))
        assert seen == pytest.approx([x, y, x + w, y + h], abs=1e-3)
        assert whole == pytest.approx([x0, y0, x1, y1], abs=0.02), "all of it, as a 3D detector says it"
        solid = solid_target(row, target_truth(row, [thing], CLASSES, whole=True)).solid
        assert solid is not None
        length, width, height = row["target_size"]
        assert solid.size_lhw.tolist() == [pytest.approx([length, height, width])]
        middle = np.array(row["target_pose"])[:3, 3] + [0.0, 0.0, 0.5 * height]
        assert solid.centre[0].tolist() == pytest.approx(
            (np.linalg.inv(np.array(row["pose"])) @ [*middle, 1.0])[:3].tolist(), abs=1e-3
        )
        if thing["visible"] == 1.0:
            assert w * h > 0.5 * (x1 - x0) * (y1 - y0)


def test_a_target_before_a_level_camera_has_its_3d_box() -> None:
    """A car 20 m ahead, turned left by 30 degrees, from a camera 1.5 m above the road."""
    turn = np.radians(30.0)
    row = {
        "pose": [[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]],  # z of the camera is x of the world
        "target_pose": [
            [np.cos(turn), -np.sin(turn), 0, 20],
            [np.sin(turn), np.cos(turn), 0, 0],
            [0, 0, 1, 0],
            [0, 0, 0, 1],
        ],
        "target_size": [4.0, 1.8, 1.4],
    }
    given = Truth(torch.tensor([3, 3]), torch.tensor([[1.0, 2.0, 3.0, 4.0]] * 2), intrinsic=torch.eye(3))
    truth = solid_target(row, given)
    assert truth.label.tolist() == [3], "the target alone"
    assert truth.solid is not None
    assert truth.solid.centre.tolist() == [pytest.approx([0.0, 0.8, 20.0], abs=1e-5)]
    assert truth.solid.yaw.tolist() == pytest.approx([-np.pi / 2 - turn], abs=1e-6)
    assert torch.equal(truth.box, given.box[:1])


def projected(row: dict[str, Any]) -> F64:
    """x0, y0, x1, y1 of the target's 3D box in its picture, cut at the borders."""
    half = np.array(row["target_size"]) / 2
    corners = np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]) * half + [0, 0, half[2]]
    target, pose = np.array(row["target_pose"]), np.linalg.inv(np.array(row["pose"]))
    seen = (corners @ target[:3, :3].T + target[:3, 3]) @ pose[:3, :3].T + pose[:3, 3]
    pixels = seen @ np.array(row["intrinsic"]).T
    xy = (pixels[:, :2] / pixels[:, 2:]).clip(0, [row["width"], row["height"]])
    return np.concatenate([xy.min(0), xy.max(0)])


@BOTH
def test_a_recording_is_drawn_again(mode: str, request: pytest.FixtureRequest) -> None:
    """Each row gives scene, view, target and labels; what is rendered is what was stored."""
    folder = request.getfixturevalue(mode)
    rows = read(folder, "test")["images"]
    assert set(read(folder)["info"]["recording"]["effects"]) == DEFAULT_EFFECTS
    with plain_bodies() if mode == "drives" else contextlib.nullcontext():
        again = list(recorded_views(folder, split="test"))
    assert [v.file for v in again] == [row["file_name"] for row in rows]
    scenes = {(v.row["town"], v.row["part"], v.row["attempt"], id(v.scene)) for v in again}
    assert len(scenes) == len({key[:3] for key in scenes}), "pictures of a drive share a scene"
    for seen in again:
        picture = render(seen.scene, [seen.view], quality=seen.quality)
        assert encode_jpeg(picture.image[0], 92, "420") == (folder / "images" / seen.file).read_bytes()
        labels = label_image(seen.scene, seen.view, picture)
        target = next(o for o in seen.objects if o["target"])
        x, y, w, h = target["bbox"]
        assert labels.box[labels.tag == TARGET][0].tolist() == [x, y, x + w, y + h]
        assert seen.view.objects[0].tag == TARGET
        worn = seen.with_layers(TextureLayer(4)).objects
        assert worn[0].layers == (TextureLayer(4),)
        assert worn[1:] == seen.view.objects[1:]


def test_an_orbit_of_a_stop_sign_shows_its_face(tmp_path: Path) -> None:
    target = TargetSign("large", seed=2)
    given: dict[str, Any] = {"distances": (5.0, 9.0), "azimuths": (), "elevations": ()}
    with two_phases():
        record_target_images(
            todo(tmp_path, "orbit", images=(("Oldmarket", 2),), target=target, size=320, **given), workers=0
        )
        views = list(recorded_views(tmp_path))
    data = read(tmp_path)
    assert data["info"]["recording"]["target"]["kind"] == "stop_sign"
    assert len(views) == 2
    for seen in views:
        row, thing = seen.row, target_of(data, dict(seen.row))
        assert data["categories"][thing["category_id"] - 1]["name"] == "stop_sign"
        eye, foot = np.array(row["pose"])[:3, 3], np.array(row["target_pose"])
        middle = foot[:3, 3] + [0.0, 0.0, target.full_size[2] - target.full_size[1] / 2]
        ahead, left, up = foot[:3, :3].T @ (eye - middle)
        assert np.linalg.norm(eye - middle) == pytest.approx(row["distance"], abs=0.01) == thing["distance"]
        assert CAR_EYE[0] <= eye[2] <= CAR_EYE[1]
        assert turned(float(np.degrees(np.arctan2(left, ahead))), row["azimuth"]) < 0.1
        assert turned(row["azimuth"], 0.0) <= 60.0
        assert row["elevation"] == pytest.approx(np.degrees(np.arctan2(up, np.hypot(ahead, left))), abs=0.1)
        picture = render(seen.scene, [seen.view])
        assert encode_jpeg(picture.image[0], 92, "420") == (tmp_path / "images" / seen.file).read_bytes()
        # the box is that of the plate: its width is foreshortened, its height is not
        width, height = thing["bbox"][2:]
        tall = FOCAL * 320 * target.full_size[1] / row["distance"]
        assert height == pytest.approx(tall, rel=0.15)
        assert width == pytest.approx(tall * np.cos(np.radians(row["azimuth"])), rel=0.2)
        assert picture.tag[0][picture.tag[0] == TARGET].size > 0.5 * width * height


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"mode": "drive"}, "stands still"),
        ({"azimuths": (180.0,)}, "75 degrees to either side"),
        ({"elevations": (15.0,)}, "give no elevations"),
        ({"size": 160}, "a sign 20 m away needs"),
    ],
)
def test_what_cannot_be_seen_of_a_sign_is_refused(tmp_path: Path, wrong: dict[str, Any], said: str) -> None:
    given: dict[str, Any] = {"size": 640, "azimuths": (0.0,), "elevations": (0.0,), "target": TargetSign()}
    with pytest.raises(ConfigError, match=said):
        todo(tmp_path, **({"mode": "orbit"} | given | wrong))


def test_the_named_target_is_the_same_metal_everywhere() -> None:
    target = TargetCar("suv", "red", seed=2)
    found = []
    for key in ("one", "another"):
        objects = SceneObjects(0.1, (key,))
        body = _add_target_body(objects, target)
        found.append(objects.meshes[body.meshes[0]])
        assert body.paint == target.colour
        assert body.size == target.full_size
    assert np.array_equal(found[0].vertices, found[1].vertices)
    assert np.array_equal(found[0].uv, found[1].uv)
    assert found[0].rectangles == found[1].rectangles


def test_clip_views_refuses_what_it_does_not_know(drives: Path, tmp_path: Path) -> None:
    data = read(drives, "all")
    del data["images"][0]["attempt"]
    (tmp_path / "annotations").mkdir()
    (tmp_path / "annotations" / "all.json").write_text(json.dumps(data))
    with pytest.raises(FormatError, match="record them again"):
        next(recorded_views(tmp_path))


@BOTH
def test_pycocotools_reads_it_and_the_truth_scores_1(mode: str, request: pytest.FixtureRequest) -> None:
    coco = pytest.importorskip("pycocotools.coco")
    evaluation = pytest.importorskip("pycocotools.cocoeval")
    root = request.getfixturevalue(mode)
    with contextlib.redirect_stdout(io.StringIO()):
        truth = coco.COCO(str(root / "annotations" / "all.json"))
        assert [c["name"] for c in truth.loadCats(truth.getCatIds())] == list(CLASSES)
        said = [
            {"image_id": a["image_id"], "category_id": a["category_id"], "bbox": a["bbox"], "score": 0.9}
            for a in truth.dataset["annotations"]
            if not a["iscrowd"]
        ]
        found = evaluation.COCOeval(truth, truth.loadRes(said), "bbox")
        found.params.maxDets = [1, 10, 1000]
        found.evaluate()
        found.accumulate()
    precision = found.eval["precision"][..., 0, -1]
    assert (precision > -1).any()
    assert (precision[precision > -1] > 1 - 1e-9).all()


@pytest.mark.slow
def test_same_bytes_for_two_workers_and_after_a_stop(tmp_path: Path) -> None:
    """That processes do not matter is shown of drives in the nuScenes schema by default: they share the code."""
    record_target_images(todo(tmp_path / "two", "drive"), workers=2)
    _stopped_recording(tmp_path / "stopped")
    assert contents(tmp_path / "two") == contents(tmp_path / "stopped")


def test_recording_again_changes_nothing(drives: Path) -> None:
    before = contents(drives)
    steps: list[tuple[int, int]] = []
    record_target_images(todo(drives, "drive"), workers=0, progress=lambda done, of: steps.append((done, of)))
    assert contents(drives) == before
    assert steps == [(1, 2), (2, 2)]


@pytest.mark.slow
def test_same_bytes_of_an_orbit_for_two_workers_and_after_kill_9(orbits: Path, tmp_path: Path) -> None:
    record_target_images(todo(tmp_path / "d", "orbit"), workers=2)
    assert contents(tmp_path / "d") == contents(orbits)
    command = [sys.executable, "-m", "ssad", "record", str(tmp_path / "e"), "--clips", "orbit", "--images", "2,1"]
    command += ["--towns", "Twinford,Oldmarket", "--held-out", "Oldmarket", "--target", "van:white:3", "--workers", "2"]
    for pause in (5.0, 7.0):
        with subprocess.Popen(command, start_new_session=True, stdout=subprocess.DEVNULL) as process:
            time.sleep(pause)
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    command[4] = str(tmp_path / "f")
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    assert contents(tmp_path / "e") == contents(tmp_path / "f")
    assert {row["target_style"] for row in read(tmp_path / "f")["images"]} == {"van"}


@pytest.mark.slow
def test_a_town_of_many_parts_shows_each_cell_once_before_any_comes_again(tmp_path: Path) -> None:
    out = record_target_images(todo(tmp_path, "orbit", images=(("Crossgate", 36),), held_out=()), workers=2)
    data = read(out)
    assert len({row["drive"] for row in data["images"]}) >= 2
    assert len({(row["distance"], row["azimuth"], row["elevation"]) for row in data["images"]}) == 36
    assert read(out, "test")["images"] == []


def test_another_recording_in_the_folder_is_refused(drives: Path, tmp_path: Path) -> None:
    for changes in (
        {"seed": 1},
        {"size": 168},
        {"target": TargetCar("van")},
        {"images": PAIRS[:1]},
        {"effects": NO_EFFECTS},
    ):
        with pytest.raises(StoreError, match="another recording") as error:
            record_target_images(todo(drives, "drive", **changes), workers=0)
        assert "\n" not in str(error.value)
    with pytest.raises(StoreError, match="another recording"):
        record_target_images(todo(drives, "orbit"), workers=0)
    (tmp_path / "annotations").mkdir()
    for text in ("{}", "[]", '{"info": 5}', '{"info": {"recording": {}}}', '{"images": [], "annotations": []}'):
        (tmp_path / "annotations" / "all.json").write_text(text)
        with pytest.raises(StoreError, match="another recording"):
            record_target_images(todo(tmp_path, "drive"), workers=0)
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(StoreError) as error:
        record_target_images(todo(blocked / "out", "drive"), workers=0)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"images": (("Nowhere", 3),)}, "unknown town 'Nowhere'"),
        ({"held_out": ("Nowhere",)}, "unknown town 'Nowhere'"),
        ({"images": ()}, "name a town"),
        ({"images": (("Twinford", 0),)}, "0 pictures"),
        ({"images": (("Twinford", 1), ("Twinford", 2))}, "named twice"),
        ({"mode": "walk"}, "drive or orbit"),
        ({"size": 60}, "a car 20 m away needs"),
        ({"size": 8192}, "4096"),
        ({"behind": 2.0}, "behind: 3 to 60 m"),
        ({"behind": float("nan")}, "behind: 3 to 60 m"),
        ({"height": 0.0}, "height"),
        ({"quality": 0}, "quality"),
        ({"distances": ()}, "distances"),
        ({"distances": (1.0,)}, "3 to 80 m"),
        ({"elevations": (90.0,)}, "0 to 75 degrees"),
        ({"azimuths": (float("inf"),)}, "azimuths"),
    ],
)
def test_what_cannot_be_recorded_is_refused_in_one_line(tmp_path: Path, wrong: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said) as error:
        TargetRecording(tmp_path, **wrong)
    assert "\n" not in str(error.value)


def test_numbers_of_pictures_are_paired_with_towns() -> None:
    assert pair_images(["A", "B"], ["3"]) == (("A", 3), ("B", 3))
    assert pair_images(["A", "B"], ["3", "4"]) == (("A", 3), ("B", 4))
    for images, said in ((["3", "x"], "whole numbers"), (["1", "2", "3"], "3 numbers for 2 towns"), ([], "0 numbers")):
        with pytest.raises(ConfigError, match=said) as error:
            pair_images(["A", "B"], images)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["walk"], "drive or orbit"),
        (["drive", "--images", "1,2"], "2 numbers for 4 towns"),
        (["drive", "--towns", "Nowhere", "--images", "2"], "unknown town 'Nowhere'"),
        (["orbit", "--target", "stopsign"], "closest: stop_sign"),
        (["orbit", "--target", "spaceship"], "sedan, stop_sign, suv"),
    ],
)
def test_the_command_says_what_is_wrong_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], more: list[str], said: str
) -> None:
    from ssad.cli import main

    monkeypatch.setattr(sys, "argv", ["ssad", "record", str(tmp_path / "out"), "--clips", *more])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    found = capsys.readouterr()
    assert found.err.startswith("error: ")
    assert said in found.err
    assert (found.out, found.err.count("\n")) == ("", 1)
    assert not (tmp_path / "out").exists()


def test_every_cell_comes_once_in_a_turn() -> None:
    whole = shuffled_cells(range(120), 40, key=(0, "town"))
    for k in range(3):
        assert sorted(whole[40 * k : 40 * k + 40]) == list(range(40))
    assert whole[:40] != whole[40:80], "each turn has its own order"
    assert shuffled_cells(range(25, 50), 40, key=(0, "town")) == whole[25:50], "parts fit together"
    assert shuffled_cells(range(40), 40, key=(1, "town")) != whole[:40]


def test_a_camera_looks_at_its_point_upright() -> None:
    eye, point = np.array([3.0, -2.0, 4.0]), np.array([-5.0, 7.0, 1.0])
    pose = look_at(eye, point)
    assert np.allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3))
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
    assert np.allclose(np.linalg.inv(pose)[:3] @ [*point, 1.0], [0, 0, float(np.linalg.norm(point - eye))])
    assert pose[2, 0] == pytest.approx(0.0)
    assert pose[2, 1] < 0
    target = np.eye(4)
    for offset, azimuth in (([9, 0], 0.0), ([0, 9], 90.0), ([-9, 0], 180.0), ([0, -9], 270.0)):
        found = polar(np.array([*offset, AIM], float), target)
        assert found == {"distance": 9.0, "azimuth": azimuth, "elevation": 0.0}


def test_a_drive_that_stands_or_is_too_short_gives_no_shot(market: EpisodeTrace) -> None:
    def shots(behind: float) -> list[Any]:
        return following_viewpoints(market, SceneWeather(), behind=behind, height=2.0, count=4, rng=generator(1))

    found = shots(20.0)
    assert len(found) > 20
    times = [s.time for s in found]
    assert times[:4] == sorted(times[:4])
    assert len(set(times)) == len(times)
    way = sorted(s.description["way"] for s in found)
    assert min(np.diff(way)) >= 1.0 - 0.011
    assert shots(float(market.driven[-1])) == []


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("van", TargetCar("van")),
        ("suv:red", TargetCar("suv", "red")),
        ("sedan:white:7", TargetCar("sedan", "white", seed=7)),
        ("stop_sign", TargetSign("standard")),
        ("stop_sign:worn:3", TargetSign("worn", seed=3)),
        ("pedestrian", TargetWalker("standing")),
        ("pedestrian:child:2", TargetWalker("child", seed=2)),
    ],
)
def test_targets_are_named_by_style_paint_and_seed(text: str, expected: Target) -> None:
    assert parse_target(text) == expected
    assert expected.mesh().bounds()[1][2] == pytest.approx(expected.full_size[2], abs=1e-3)


@pytest.mark.parametrize(
    "text",
    ["spaceship", "sedan:mauve", "sedan:red:x", "sedan:red:1:2", "stop_sign:bent", "stop_sign:worn:x", "stop_signs"],
)
def test_unknown_targets_are_refused(text: str) -> None:
    with pytest.raises(ConfigError):
        parse_target(text)
