"""Recorded drives: the data set that `ssad record` writes."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.bodies import plain_bodies

from ssad.core.errors import ConfigError, MapError, StoreError
from ssad.core.geometry import obb_distance
from ssad.core.images import read_image
from ssad.core.lane_graph import LaneGraph
from ssad.core.nuscenes_names import CATEGORY_TO_CLASS, CLASSES
from ssad.core.rotations import quaternion_to_matrix
from ssad.core.types import LaneType
from ssad.datasets.nuscenes.files import read_points
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.recorders import nuscenes
from ssad.recorders.drives import MIX, drive_street, make_drive, thin_shares
from ssad.recorders.nuscenes import AHEAD, Recording, drive_with_autopilot, record_nuscenes
from ssad.recorders.target_images import record_target_images
from ssad.recorders.target_recording import TargetRecording
from ssad.rendering.bodies import make_body
from ssad.rendering.bodies.actor_bodies import BODY_CATEGORIES, towing_vehicle
from ssad.rendering.camera.effects import DEFAULT_EFFECTS, NO_EFFECTS, select_effects
from ssad.rendering.camera.render import RenderQuality
from ssad.rendering.meshes.mesh import Mesh
from ssad.rendering.scene_objects import CARS, RACK, SceneObjects, place_objects
from ssad.rendering.street import cached_street
from ssad.rendering.street.model import Street
from ssad.scenarios.static.shifts import ShiftSpec
from ssad.scenarios.static.shifts.scene_shifter import SceneShifter
from ssad.world.roads import load_town, save_graph

# as the fixture `recorded` was made, but for its sweeps
SMALL = {"towns": ("Twinford", "Oldmarket"), "held_out": ("Oldmarket",), "scenes": 1, "seconds": 1.0, "width": 160}


def contents(root: Path) -> dict[str, str]:
    """Hash of every file of the data set."""
    return {
        str(p.relative_to(root)): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(root.rglob("*"))
        if p.is_file() and ".parts" not in p.parts
    }


def test_the_reader_finds_what_was_recorded(recorded: Path) -> None:
    data = NuScenes(recorded)
    assert [s.name for s in data.scenes()] == ["scene-twinford-000", "scene-oldmarket-000"]
    for record in data.scenes():
        scene = data.scene(record.name)
        assert len(scene.samples) == 3
        assert {f.channel for f in scene.frames} >= {"CAM_FRONT", "CAM_BACK", "LIDAR_TOP"}
        assert sum(not f.key_frame for f in scene.frames) == 2 * 7
        for frame in scene.frames:
            if frame.modality == "camera":
                assert read_image(recorded / frame.filename).shape == (90, 160, 3)
            else:
                assert len(read_points(recorded / frame.filename)) > 3000
    assert {CATEGORY_TO_CLASS[c] for c in BODY_CATEGORIES.values()} == set(CLASSES)


def test_a_scene_tells_its_town_and_weather_in_words(recorded: Path) -> None:
    told = [row["description"] for row in json.loads((recorded / "v1.0-ssad" / "scene.json").read_text())]
    words = r"\w+, sun \d+ degrees (above|below) the horizon, clouds \d+ %(, fog of 0\.\d+/m|, wet road \d+ %)?"
    assert [text for text in told if not re.fullmatch(words, text)] == []


def test_points_lie_in_the_boxes_as_counted_and_on_the_ground(recorded: Path) -> None:
    data = NuScenes(recorded)
    boxes = 0
    for record in data.scenes():
        scene = data.scene(record.name)
        for frame in [f for f in scene.frames if f.channel == "LIDAR_TOP" and f.key_frame]:
            pose = frame.ego_to_world @ frame.sensor_to_ego
            world = read_points(recorded / frame.filename)[:, :3] @ pose[:3, :3].T + pose[:3, 3]
            assert (np.abs(world[:, 2]) < 0.2).mean() > 0.15, "the road"
            assert world[:, 2].min() > -1.0
            found = scene.annotations(frame.sample_token)
            boxes += len(found)
            for n in range(len(found)):
                local = np.abs((world - found.centre[n]) @ quaternion_to_matrix(found.rotation[n]))
                half = found.size_lwh[n] / 2
                least, most = ((local <= half + margin).all(1).sum() for margin in (-0.01, 0.01))
                assert least <= found.lidar_points[n] <= most, "those on a face may fall either way"
    assert boxes > 5


def test_shifts_take_the_true_depth(recorded: Path) -> None:
    data = NuScenes(recorded)
    scene = data.scene(data.scenes()[0].name)
    shifter = SceneShifter(recorded, scene, ShiftSpec("fog", 4))
    frame = next(f for f in scene.frames if f.channel == "CAM_FRONT" and f.key_frame)
    _, done = shifter.image(frame)
    assert done.details["depth"] == "given"
    depth = shifter.camera_frame(frame).depth
    assert depth is not None
    assert np.isinf(depth).any(), "sky"
    assert 2 < depth[-1, 20] < 6, "the road before the car"


def test_same_bytes_for_any_number_of_workers_and_after_a_stop(recorded: Path, tmp_path: Path) -> None:
    """Two processes have recorded both scenes; here one records Oldmarket again."""
    again = Path(shutil.copytree(recorded, tmp_path / "b"))
    todo = Recording(again, sweeps=1, **SMALL)
    # what a kill leaves: a scene half done, no tables
    for path in (again / todo.version).iterdir():
        path.unlink()
    part = again / ".parts" / "scene-oldmarket-000"
    (part / "part.json").unlink()
    for path in part.glob("*.jpg"):
        path.write_bytes(b"torn")
    shutil.rmtree(again / "samples")
    record_nuscenes(todo, workers=0)
    assert contents(again) == contents(recorded)
    with pytest.raises(StoreError, match="another recording"):
        record_nuscenes(Recording(again, **SMALL))
    with pytest.raises(StoreError, match="another recording"):
        record_nuscenes(replace(todo, effects=NO_EFFECTS))


def test_images_have_the_effects_of_their_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And nights have a class of street lighting only with its effect."""
    qualities = []

    def render(*_: object, quality: RenderQuality, linear: bool) -> None:
        qualities.append(quality)
        raise StopIteration

    monkeypatch.setattr(nuscenes, "render", render)
    moment: Any = SimpleNamespace(views=[None])
    for effects in (NO_EFFECTS, select_effects("haze", "flare"), DEFAULT_EFFECTS):
        recording = Recording(tmp_path, effects=effects)
        with pytest.raises(RuntimeError, match="StopIteration"):
            next(nuscenes._render_moments(None, [moment], None, 0, recording))  # type: ignore[arg-type]
        assert qualities[-1].effects == effects
        nights = [nuscenes.draw_weather((number,), "night", effects=effects).lighting for number in range(9)]
        assert any(nights) == ("street-lighting" in effects)
    with pytest.raises(ConfigError, match="unknown effect"):
        Recording(tmp_path, effects=frozenset({"fog lamp"}))


@pytest.mark.slow
def test_same_bytes_after_kill_9_at_any_moment(recorded: Path, tmp_path: Path) -> None:
    out = tmp_path / "c"
    command = [sys.executable, "-m", "ssad", "record", str(out), "--towns", "Twinford,Oldmarket", "--held-out"]
    command += ["Oldmarket", "--scenes", "1", "--seconds", "1", "--width", "160", "--sweeps", "1", "--workers", "2"]
    for pause in (4.0, 6.0, 7.0, 8.0):
        with subprocess.Popen(command, start_new_session=True, stdout=subprocess.DEVNULL) as process:
            time.sleep(pause)
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    assert contents(out) == contents(recorded)
    one = record_nuscenes(Recording(tmp_path / "d", sweeps=1, **SMALL), workers=0)
    assert contents(one) == contents(recorded)


def test_a_cast_has_every_class_and_nobody_stands_in_another() -> None:
    kinds: Counter[str] = Counter()
    for town in ("Larkhill", "Twinford"):
        graph, street = load_town(town), cached_street(town)
        trace = drive_with_autopilot(make_drive(graph, key=(3, town), seconds=6.0), graph)
        with plain_bodies():
            cast = place_objects(trace, graph, street, key=(5, town))
        kinds.update(body.kind for body in cast.bodies)
        now = cast.at(3.0, np.array([trace.x[30, 0], trace.y[30, 0]]), 80.0)
        assert len(now) > 8
        # A trailer lies on the vehicle that draws it.
        still = [s for s in now if s.body.is_parked and s.body.kind not in ("bicycle", "trailer")]
        boxes = [(*s.pose[:2, 3], np.arctan2(s.pose[1, 0], s.pose[0, 0]), *s.body.size[:2]) for s in still]
        for i in range(1, len(boxes)):
            assert (obb_distance(boxes[i : i + 1] * i, boxes[:i]) > 0).all(), "parked vehicles keep apart"
        walkers = [b for b in cast.bodies if b.kind == "pedestrian" and len(b.track) > 1]
        assert any(np.hypot(*np.diff(b.track[:30, :2], axis=0).T).sum() > 1.0 for b in walkers), "they walk"
        pushing = [b for b in walkers if b.style == "stroller"]
        strollers = [b for b in cast.bodies if b.kind == "stroller"]
        assert len(pushing) == len(strollers) > 0
        for who, what in zip(pushing, strollers, strict=True):
            ahead = what.track[:, :2] - who.track[:, :2]
            along = ahead[:, 0] * np.cos(who.track[:, 2]) + ahead[:, 1] * np.sin(who.track[:, 2])
            np.testing.assert_allclose(along, 0.457 * who.size[0] + 0.5 * what.size[0], atol=0.05)
        assert any(b.style == "elderly" for b in walkers)
        assert any(b.style == "worker" for b in cast.bodies)
    assert set(kinds) >= set(BODY_CATEGORIES) - {"bus", "trailer"}
    assert "stroller" not in BODY_CATEGORIES, "void in the detection task of nuScenes"
    assert kinds["bus"] + kinds["trailer"] > 0


def test_each_camera_fires_at_its_own_time_where_the_ego_is_then(recorded: Path) -> None:
    scene = NuScenes(recorded).scene("scene-twinford-000")
    sweep = next(f for f in scene.frames if f.channel == "LIDAR_TOP" and f.key_frame)
    for frame in [f for f in scene.frames if f.sample_token == sweep.sample_token and f.modality == "camera"]:
        gap = (sweep.timestamp_us - frame.timestamp_us) * 1e-6
        assert gap == pytest.approx(AHEAD[frame.channel], abs=1e-6)
        moved = np.linalg.norm(sweep.ego_to_world[:3, 3] - frame.ego_to_world[:3, 3])
        assert moved <= 15.0 * gap + 1e-6


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
        record_nuscenes(Recording(blocked / "out", **SMALL), workers=0)


def test_only_what_is_drawn_is_built(monkeypatch: pytest.MonkeyPatch) -> None:
    built: list[str] = []

    def counting(kind: str, **options: Any) -> Mesh:
        built.append(kind)
        return make_body(kind, **options)

    monkeypatch.setattr("ssad.rendering.scene_objects.make_body", counting)
    objects = SceneObjects(0.1, ("lazy",))
    car = objects.make("car", "sedan", (4.5, 1.8, 1.5))
    objects.make("pedestrian", "adult", (0.6, 0.6, 1.8), phases=3)
    assert not built
    assert len(objects.meshes) == 4
    some = objects.meshes.select({0})
    assert built == ["car"]
    assert some[0] is objects.meshes[0]
    assert [len(mesh.faces) for mesh in some[1:]] == [0, 0, 0]
    assert car[3] == (0,)
    assert [len(mesh.faces) > 0 for mesh in objects.meshes[1:3]] == [True, True]
    assert built == ["car", "pedestrian", "pedestrian"], "none is built twice"


def test_each_person_is_another_and_built_once_for_all_renderings() -> None:
    def meshes(drive: str) -> list[Mesh]:
        objects = SceneObjects(0.1, (drive,))
        for _ in range(2):
            objects.make("pedestrian", "adult", (0.6, 0.6, 1.8), phases=2)
        return objects.meshes[:]

    drive, again, other = meshes("one"), meshes("one"), meshes("other")
    assert [mesh is same for mesh, same in zip(drive, again, strict=True)] == [True] * 4
    assert drive[0].materials == drive[1].materials, "one person in two phases"
    assert (drive[0].vertices != drive[1].vertices).any()
    assert len({mesh.materials for mesh in (drive[0], drive[2], other[0], other[2])}) == 4


def test_four_drives_share_a_street_that_is_built_for_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[object, ...]] = []

    def street(graph: LaneGraph, streets: str, *, key: tuple[object, ...]) -> Street:
        asked.append(key)
        raise ConfigError("seen enough")

    def tried(pool: Any, record: Any, tasks: list[Any], **options: Any) -> None:
        for task in tasks:
            numbers = list(task[2])
            for number in numbers:
                with pytest.raises(ConfigError, match="seen enough"):
                    record((*task[:2], [number]))
            asked.append(("together", *numbers))

    monkeypatch.setattr("ssad.recorders.nuscenes.drive_street", street)
    monkeypatch.setattr("ssad.recorders.nuscenes.run_all", tried)
    monkeypatch.setattr("ssad.recorders.nuscenes._merge", lambda *what: None)
    small = {"scenes": 5, "seconds": 0.5, "width": 64, "streets": "any", "seed": 7}
    record_nuscenes(Recording(tmp_path, ("Twinford",), (), **small), workers=0)  # type: ignore[arg-type]
    first, second = (7, "Twinford", 0), (7, "Twinford", 1)
    assert asked == [*[first] * 4, ("together", 0, 1, 2, 3), second, ("together", 4)]


@pytest.mark.slow
def test_streets_are_the_towns_own_or_built_anew_for_each_key() -> None:
    graph = load_town("Twinford")
    own = cached_street(graph)
    assert drive_street(graph, "town", key=(0, "Twinford", 3)).vertices.tobytes() == own.vertices.tobytes()
    some = [drive_street(graph, "any", key=(0, "Twinford", k)) for k in (3, 3, 4)]
    assert some[0].vertices.tobytes() == some[1].vertices.tobytes(), "the key decides"
    assert some[0].vertices.shape != some[2].vertices.shape != own.vertices.shape
    with pytest.raises(ConfigError, match="streets 'none'; choose from: town, any"):
        drive_street(graph, "none", key=())


def test_long_vehicles_stand_at_the_kerb() -> None:
    """A street full of parked cars would leave trucks, buses and trailers no room."""
    found: Counter[str] = Counter()
    for number in range(4):
        graph = load_town("Twinford")
        trace = drive_with_autopilot(make_drive(graph, key=("long", number), seconds=1.0), graph)
        with plain_bodies():
            cast = place_objects(trace, graph, cached_street(graph), key=("long", number))
        parked = [body for body in cast.bodies if body.is_parked]
        found.update(body.kind for body in parked)
        wide = [body for body in parked if body.kind not in RACK]
        for body in wide:
            others = [b for b in wide if b is not body]
            gap = [float(np.hypot(*(b.track[0, :2] - body.track[0, :2]))) for b in others]
            assert min(gap, default=9.0) > 1.5
        for trailer in (body for body in parked if body.kind == "trailer"):
            x, y, yaw, _ = trailer.track[0]
            vehicle = towing_vehicle(trailer.style, trailer.size)
            place = x + vehicle.ahead * np.cos(yaw), y + vehicle.ahead * np.sin(yaw)
            before = [b for b in parked if np.hypot(*(b.track[0, :2] - place)) < 1e-6]
            assert [(b.kind, b.style) for b in before] == [(vehicle.kind, vehicle.style)], "no trailer stands alone"
    assert {"car", "truck", "bus", "trailer"} <= set(found)
    assert found["car"] > found["truck"] > 0.05 * found["car"]


def test_a_town_without_a_road_to_drive_on_is_refused_in_one_line(
    tmp_path: Path, ssad_home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ssad.recorders.drives.cached_street", lambda town: None)  # takes long to build, is not needed
    town = ssad_home / "towns" / "Paths.npz"
    graph = load_town("ProvingGround")
    # every lane to drive on lies within a junction: no place to start from
    inside = np.where(graph.kind == LaneType.DRIVING, 0, graph.junction).astype(graph.junction.dtype)
    save_graph(replace(graph, name="Paths", junction=inside), town)
    with pytest.raises(MapError, match="'Paths' has no driving lane of 25 m") as error:
        record_nuscenes(Recording(tmp_path / "a", ("Paths",), scenes=1, seconds=1.0, width=160), workers=0)
    assert "\n" not in str(error.value)
    with pytest.raises(MapError, match="'Paths' has no driving lane of 25 m") as error:
        record_target_images(TargetRecording(tmp_path / "b", (("Paths", 1),), size=160), workers=0)
    assert "\n" not in str(error.value)
    with np.load(town) as stored:
        arrays = dict(stored)
    arrays["kind"] = np.full_like(arrays["kind"], LaneType.SIDEWALK)
    np.savez(town, **arrays)
    with pytest.raises(MapError, match="no drivable lane") as error:
        record_nuscenes(Recording(tmp_path / "c", ("Paths",), scenes=1, seconds=1.0, width=160), workers=0)
    assert "\n" not in str(error.value)


def test_a_stop_while_tables_are_written_and_a_folder_without_its_page(recorded: Path, tmp_path: Path) -> None:
    again = tmp_path / "d"
    shutil.copytree(recorded, again)
    todo = Recording(again, sweeps=1, **SMALL)
    (again / todo.version / "splits.json").unlink()  # the last that is written
    record_nuscenes(todo, workers=0)
    assert contents(again) == contents(recorded)
    shutil.rmtree(again / ".parts")
    with pytest.raises(StoreError, match="not how it was recorded") as error:
        record_nuscenes(replace(todo, seed=7), workers=0)
    assert "\n" not in str(error.value)
    assert contents(again) == contents(recorded)


def test_the_official_toolkit_scores_true_boxes_as_perfect(recorded: Path, tmp_path: Path) -> None:
    """All that has a LiDAR point, told as it is: every class that is there has AP 1 and no error."""
    python = os.environ.get("SSAD_DEVKIT_PYTHON")
    if not python:
        pytest.skip("SSAD_DEVKIT_PYTHON names no interpreter with nuscenes-devkit")
    copy = tmp_path / "set"
    shutil.copytree(recorded, copy)
    data = NuScenes(copy)
    rows: dict[str, list[dict[str, object]]] = {}
    there: Counter[str] = Counter()
    for record in data.scenes():
        scene = data.scene(record.name)
        for sample in scene.samples:
            found = scene.annotations(sample.token)
            own = rows.setdefault(sample.token, [])
            for n in np.flatnonzero(found.lidar_points > 0):
                name = CATEGORY_TO_CLASS.get(found.category[n])
                if name is None:
                    continue
                there[name] += 1
                own.append(
                    {
                        "sample_token": sample.token,
                        "translation": found.centre[n].tolist(),
                        "size": found.size_wlh[n].tolist(),
                        "rotation": found.rotation[n].tolist(),
                        "velocity": np.nan_to_num(found.velocity[n, :2]).tolist(),
                        "detection_name": name,
                        "detection_score": 1.0,
                        "attribute_name": (*found.attributes[n], "")[0],
                    }
                )
    meta = {"use_camera": True, "use_lidar": False, "use_radar": False, "use_map": False, "use_external": False}
    (copy / "results.json").write_text(json.dumps({"meta": meta, "results": rows}))
    script = Path(__file__).parents[1] / "helpers" / "devkit_eval.py"
    words = [python, str(script), str(tmp_path / "out.json"), data.version, "all", str(copy)]
    subprocess.run(words, check=True, capture_output=True)
    told = json.loads((tmp_path / "out.json").read_text())["set"]
    assert "error" not in told, told["error"]
    assert sum(count > 0 for count in there.values()) >= 3
    near = [name for name, aps in told["label_aps"].items() if min(aps.values()) > 0.999]
    assert set(near) <= set(there)
    assert len(near) >= 3, told["mean_dist_aps"]
    for name in near:
        errors = told["label_tp_errors"][name]
        assert errors["trans_err"] < 1e-6
        assert errors["scale_err"] < 1e-6


def test_streets_of_any_kind_have_fewer_cars_and_the_same_mix_of_all_else() -> None:
    town, other = thin_shares(MIX, "town"), thin_shares(MIX, "any")
    assert sum(town.values()) == pytest.approx(1.0)
    assert sum(other.values()) == pytest.approx(1.0)
    assert town == pytest.approx(MIX)
    assert sum(other[body] for body in CARS) < 0.75 * sum(town[body] for body in CARS)
    rest = [body for body in MIX if body not in CARS]
    assert [other[b] / other["bus"] for b in rest] == pytest.approx([town[b] / town["bus"] for b in rest])
