"""The reader: joins, boxes between key frames, both kinds of index, other processes, and what broken data says."""

from __future__ import annotations

import json
import math
import os
import pickle
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.tiny import make_tiny
from hypothesis import given, settings
from hypothesis import strategies as st

from ssad.core.errors import ConfigError, FormatError, StoreError
from ssad.core.nuscenes_names import CAMERAS
from ssad.core.rotations import quaternion_to_matrix, slerp
from ssad.datasets.nuscenes import index
from ssad.datasets.nuscenes.files import points_bytes, read_frame_image, read_frame_points, read_points
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.scene import Annotations, SceneData
from ssad.datasets.nuscenes.schema import TABLES
from ssad.datasets.nuscenes.writer import NuScenesWriter

VERSION = "v1.0-mini"
START = 1_000_000_000_000


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_tiny(tmp_path_factory.mktemp("tiny"), samples=3, sweeps=2, size=(160, 90))


@pytest.fixture
def copy(tiny: Path, tmp_path: Path) -> Path:
    """The tables of the tiny set in a folder of this test's own."""
    shutil.copytree(tiny / VERSION, tmp_path / "set" / VERSION)
    return tmp_path / "set"


def edit(root: Path, table: str, change: Callable[[list[dict[str, Any]]], object]) -> None:
    path = root / VERSION / f"{table}.json"
    rows = json.loads(path.read_text())
    change(rows)
    path.write_text(json.dumps(rows))


def write_moving(root: Path, places: list[tuple[float, float, float] | None], *, step: float = 0.5) -> SceneData:
    """A scene with one object, which turns by 30 degrees a key frame; None: no box in that key frame."""
    with NuScenesWriter(root, VERSION) as writer:
        scene = writer.add_scene()
        writer.add_sensor(scene, "LIDAR_TOP", modality="lidar", translation=(0, 0, 2), rotation=(1, 0, 0, 0))
        thing = writer.add_instance(scene, "one", category="vehicle.car")
        for number, place in enumerate(places):
            time = START + int(1e6 * step * number)
            sample = writer.add_sample(scene, time)
            writer.add_sensor_frame(
                scene, "LIDAR_TOP", timestamp_us=time, data=b"", ego_translation=(0, 0, 0), sample=sample
            )
            if place is not None:
                half = math.radians(15.0 * number)
                turn = (math.cos(half), 0.0, 0.0, math.sin(half))
                writer.add_annotation(sample, thing, translation=place, size=(2, 4, 1.5), rotation=turn)
    return NuScenes(root).scene("scene-0103")


def same(one: Annotations, two: Annotations) -> bool:
    names = ("token", "instance", "category", "attributes", "visibility")
    arrays = ("centre", "size_lwh", "rotation", "velocity", "lidar_points", "radar_points")
    return all(getattr(one, name) == getattr(two, name) for name in names) and all(
        np.array_equal(getattr(one, name), getattr(two, name), equal_nan=True) for name in arrays
    )


# ---------------------------------------------------------------- what a scene holds


def test_scene_is_complete_and_in_order(tiny: Path) -> None:
    data = NuScenes(tiny)
    assert data.version == VERSION
    assert [scene.name for scene in data.scenes()] == ["scene-0103", "scene-0916"]
    scene = data.scene("scene-0916")
    assert scene.record == data.scene(scene.record.token).record == data.scenes()[1]
    assert scene.log is not None
    assert scene.log.token == scene.record.log_token
    assert [sample.timestamp for sample in scene.samples] == sorted(sample.timestamp for sample in scene.samples)
    assert [sample.token for sample in scene.samples][:: len(scene.samples) - 1] == [
        scene.record.first_sample_token,
        scene.record.last_sample_token,
    ]
    order = [(frame.timestamp_us, frame.channel) for frame in scene.frames]
    assert order == sorted(order)
    assert len(order) == len(set(order)) == 7 * 7  # seven sensors; three key frames and two sweeps in each gap
    assert sum(frame.key_frame for frame in scene.frames) == 7 * 3
    assert {frame.channel for frame in scene.frames} == {*CAMERAS, "LIDAR_TOP"}
    assert {frame.scene_token for frame in scene.frames} == {scene.record.token}


def test_frames_are_joined_with_calibration_and_pose(tiny: Path) -> None:
    data = NuScenes(tiny)
    tables = {
        name: {row["token"]: row for row in json.loads((tiny / VERSION / f"{name}.json").read_text())}
        for name in ("sample_data", "calibrated_sensor", "ego_pose", "sensor")
    }
    for frame in data.scene("scene-0103").frames:
        row = tables["sample_data"][frame.token]
        calibration = tables["calibrated_sensor"][row["calibrated_sensor_token"]]
        pose = tables["ego_pose"][row["ego_pose_token"]]
        assert (frame.filename, frame.timestamp_us) == (row["filename"], row["timestamp"])
        assert (data.root / frame.filename).is_file()
        assert frame.channel == tables["sensor"][calibration["sensor_token"]]["channel"]
        for matrix, source in ((frame.sensor_to_ego, calibration), (frame.ego_to_world, pose)):
            assert matrix[:3, 3].tolist() == source["translation"]
            w, x, y, z = source["rotation"]
            vector, spin = np.array([0.3, -2.0, 0.7]), np.array([x, y, z])
            turned = vector + 2 * np.cross(spin, np.cross(spin, vector) + w * vector)
            np.testing.assert_allclose(matrix[:3, :3] @ vector, turned, atol=1e-12)
            assert matrix[3].tolist() == [0, 0, 0, 1]
            assert not matrix.flags.writeable
        if frame.modality == "camera":
            assert frame.intrinsic is not None
            assert frame.intrinsic.tolist() == calibration["camera_intrinsic"]
            assert (frame.width, frame.height) == (160, 90)
            forward = (frame.sensor_to_ego @ [0, 0, 1, 0])[:3]
            yaw = {
                "CAM_FRONT": 0,
                "CAM_FRONT_LEFT": 55,
                "CAM_FRONT_RIGHT": -55.5,
                "CAM_BACK_LEFT": 110,
                "CAM_BACK_RIGHT": -110,
                "CAM_BACK": 180,
            }[frame.channel]
            expected = [math.cos(math.radians(yaw)), math.sin(math.radians(yaw)), 0]
            np.testing.assert_allclose(forward, expected, atol=1e-12)
            np.testing.assert_allclose(frame.sensor_to_ego[:3, 1], [0, 0, -1], atol=1e-12)  # image down is ego down
        else:
            assert (frame.intrinsic, frame.width, frame.height) == (None, 0, 0)


def test_null_width_and_absent_log(copy: Path) -> None:
    edit(copy, "sample_data", lambda rows: [row.update(width=None, height=None) for row in rows])
    edit(copy, "log", lambda rows: rows.clear())
    scene = NuScenes(copy).scene("scene-0103")
    assert scene.log is None
    assert {(frame.width, frame.height) for frame in scene.frames} == {(0, 0)}


# ---------------------------------------------------------------- boxes in time


def test_boxes_between_key_frames(tmp_path: Path) -> None:
    scene = write_moving(tmp_path, [(0, 0, 1), (4, -2, 1), (10, -2, 1)])
    for share in (0.0, 0.25, 0.5, 0.9, 1.0):
        boxes = scene.annotations_at(START + 500_000 + int(500_000 * share))
        np.testing.assert_allclose(boxes.centre[0], [4 + 6 * share, -2, 1], atol=1e-9)
        half = math.radians(15.0 * (1 + share))
        np.testing.assert_allclose(boxes.rotation[0], [math.cos(half), 0, 0, math.sin(half)], atol=1e-12)
        assert boxes.size_wlh.tolist() == [[2, 4, 1.5]]
    tokens = [scene.annotations(sample.token).token for sample in scene.samples]
    assert scene.annotations_at(START + 500_001).token == tokens[2]
    assert scene.annotations_at(START + 500_000).token == tokens[1]


def test_key_frame_times_give_exactly_its_boxes(tiny: Path) -> None:
    scene = NuScenes(tiny).scene("scene-0103")
    for sample in scene.samples:
        assert scene.annotations_at(sample.timestamp) is scene.annotations(sample.token)
    first, last = scene.samples[0], scene.samples[-1]
    assert scene.annotations_at(first.timestamp - 10**6) is scene.annotations(first.token)
    assert scene.annotations_at(last.timestamp + 10**6) is scene.annotations(last.token)
    with pytest.raises(ConfigError, match="no sample 'elsewhere'"):
        scene.annotations("elsewhere")


def test_an_object_that_appears_or_leaves(tmp_path: Path) -> None:
    scene = write_moving(tmp_path, [None, (4, 0, 1), None, (9, 0, 1)])
    assert len(scene.annotations_at(START)) == 0
    assert scene.annotations_at(START + 250_000).centre.tolist() == [[4, 0, 1]]  # not in the key frame before
    assert len(scene.annotations_at(START + 750_000)) == 0  # not in the following one
    assert scene.annotations(scene.samples[0].token).centre.shape == (0, 3)


def test_velocity(tmp_path: Path) -> None:
    scene = write_moving(tmp_path / "a", [(0, 0, 1), (2, 0, 1), (8, 2, 1), None])
    found = [scene.annotations(sample.token).velocity.tolist() for sample in scene.samples]
    np.testing.assert_allclose(found[:3], [[[4, 0, 0]], [[8, 2, 0]], [[12, 4, 0]]], rtol=1e-9)
    alone = write_moving(tmp_path / "b", [(0, 0, 1)])
    assert np.isnan(alone.annotations(alone.samples[0].token).velocity).all()
    # one-sided differences reach 1.5 s, central ones 3 s
    near = write_moving(tmp_path / "c", [(0, 0, 1), (2, 0, 1), (8, 2, 1)], step=1.5)
    assert all(np.isfinite(near.annotations(sample.token).velocity).all() for sample in near.samples)
    far = write_moving(tmp_path / "d", [(0, 0, 1), (2, 0, 1), (8, 2, 1)], step=1.6)
    assert all(np.isnan(far.annotations(sample.token).velocity).all() for sample in far.samples)


def test_annotations_of_a_frame(tiny: Path) -> None:
    scene = NuScenes(tiny).scene("scene-0103")
    for frame in scene.frames:
        boxes = scene.annotations_of(frame)
        at = scene.annotations(frame.sample_token) if frame.key_frame else scene.annotations_at(frame.timestamp_us)
        assert same(boxes, at)


angles = st.floats(-6.0, 6.0)


@settings(max_examples=100, deadline=None)
@given(angles, angles, st.floats(0.0, 1.0), st.booleans())
def test_slerp_turns_evenly_on_the_shorter_arc(start: float, turn: float, share: float, flipped: bool) -> None:
    def about_z(angle: float) -> Any:
        return np.array([[math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2)]])

    way = (turn + math.pi) % (2 * math.pi) - math.pi  # the shorter arc
    if abs(abs(way) - math.pi) < 1e-3:
        return
    end = about_z(start + turn) * (-1.0 if flipped else 1.0)
    between = slerp(about_z(start), end, share)
    expected = quaternion_to_matrix(about_z(start + share * way))
    # below 3.6 degrees it is linear, as in pyquaternion, which is off by up to 5e-6
    np.testing.assert_allclose(quaternion_to_matrix(between), expected, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(between), 1.0, atol=1e-12)


# ---------------------------------------------------------------- the index


def load_all(root: Path) -> list[SceneData]:
    with NuScenes(root) as data:
        return [data.scene(scene.token) for scene in data.scenes()]


def equal_scenes(one: list[SceneData], two: list[SceneData]) -> bool:
    for a, b in zip(one, two, strict=True):
        if (a.record, a.log, a.samples) != (b.record, b.log, b.samples):
            return False
        if not all(same(a.boxes[token], b.boxes[token]) for token in a.boxes):
            return False
        for f, g in zip(a.frames, b.frames, strict=True):
            for name in f.__dataclass_fields__:
                if not np.array_equal(getattr(f, name), getattr(g, name)):
                    return False
    return True


@pytest.fixture
def on_disk(monkeypatch: pytest.MonkeyPatch, ssad_home: Path) -> Path:
    """Every index goes to a file; the folder of these."""
    monkeypatch.setattr(index, "MEMORY_LIMIT_BYTES", 0)
    return ssad_home / "cache" / "nuscenes"


def test_file_index_equals_memory_index(tiny: Path, on_disk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from_file = load_all(tiny)
    assert len(list(on_disk.iterdir())) == 1
    monkeypatch.setattr(index, "MEMORY_LIMIT_BYTES", 1 << 30)
    assert equal_scenes(from_file, load_all(tiny))


def test_index_is_reused_and_renewed(copy: Path, on_disk: Path) -> None:
    load_all(copy)
    (first,) = on_disk.iterdir()
    stamp = first.stat().st_mtime_ns
    load_all(copy)
    assert [path.stat().st_mtime_ns for path in on_disk.iterdir()] == [stamp]
    edit(copy, "scene", lambda rows: rows[0].update(name="renamed"))
    assert NuScenes(copy).scenes()[0].name == "renamed"
    (second,) = on_disk.iterdir()  # the old one is gone
    assert second != first


def test_odd_tokens_survive_the_index(copy: Path, on_disk: Path) -> None:
    """Tokens need not be 32 hexadecimal digits; upper case is another token than lower case."""
    odd = {"0": "plain", "1": "Ä" * 32, "2": "A" * 32, "3": "a" * 32}

    def rename(rows: list[dict[str, Any]]) -> None:
        for i, row in enumerate(rows):
            row["token"] = odd.get(str(i), row["token"])

    edit(copy, "ego_pose", rename)
    edit(copy, "sample_data", lambda rows: [row.update(ego_pose_token=odd[str(i)]) for i, row in enumerate(rows[:4])])
    poses = json.loads((copy / VERSION / "ego_pose.json").read_text())
    frames = {frame.timestamp_us: frame for scene in load_all(copy) for frame in scene.frames}
    for pose in poses[:4]:
        assert frames[pose["timestamp"]].ego_to_world[:3, 3].tolist() == pose["translation"]


def test_other_processes(tiny: Path, on_disk: Path) -> None:
    """An opened set goes through a fork and through pickle."""
    data = NuScenes(tiny)
    assert equal_scenes([pickle.loads(pickle.dumps(data)).scene("scene-0103")], [data.scene("scene-0103")])
    data.close()
    assert len(data.scene("scene-0916").frames) == 49
    script = (
        "import sys, multiprocessing\nfrom pathlib import Path\nfrom ssad.datasets.nuscenes import index\n"
        "from ssad.datasets.nuscenes.reader import NuScenes\nindex.MEMORY_LIMIT_BYTES = 0\n"
        "data = NuScenes(Path(sys.argv[1]))\ndata.scenes()\n"
        "def count(name): return len(data.scene(name).frames)\n"
        "with multiprocessing.get_context('fork').Pool(2) as pool:\n"
        "    print(pool.map(count, ['scene-0103', 'scene-0916'] * 4))\n"
        "print(count('scene-0103'))\n"
    )
    done = subprocess.run([sys.executable, "-c", script, str(tiny)], capture_output=True, text=True, check=False)
    assert done.stdout.split("\n")[:2] == [str([49] * 8), "49"], done.stderr
    assert len(list(on_disk.iterdir())) == 1


def test_two_builds_at_once(tiny: Path, on_disk: Path) -> None:
    script = (
        "import sys\nfrom pathlib import Path\nfrom ssad.datasets.nuscenes import index\n"
        "from ssad.datasets.nuscenes.reader import NuScenes\nindex.MEMORY_LIMIT_BYTES = 0\n"
        "print(len(NuScenes(Path(sys.argv[1])).scene('scene-0103').frames))\n"
    )
    command = [sys.executable, "-c", script, str(tiny)]
    both = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    assert [process.communicate()[0] for process in both] == ["49\n"] * 2
    assert len(list(on_disk.iterdir())) == 1


def test_cache_folder_that_cannot_be_written(tiny: Path, on_disk: Path) -> None:
    on_disk.parent.write_text("a file where the folder should be")
    with pytest.raises(StoreError, match="SSAD_HOME"):
        NuScenes(tiny)


def test_damaged_index_file(tiny: Path, on_disk: Path) -> None:
    NuScenes(tiny)
    (path,) = on_disk.iterdir()
    path.write_bytes(b"no database" * 100)
    with pytest.raises(StoreError, match="delete the file"):
        NuScenes(tiny).scenes()


def test_broken_table_leaves_no_index(copy: Path, on_disk: Path) -> None:
    path = copy / VERSION / "sample_data.json"
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(FormatError, match=r"sample_data\.json:\d+: .*too early"):
        NuScenes(copy)
    assert list(on_disk.iterdir()) == []


# ---------------------------------------------------------------- what broken data says


@pytest.fixture
def small(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, ssad_home: Path) -> int:
    """Tables of fewer bytes are indexed in memory."""
    monkeypatch.setattr(index, "MEMORY_LIMIT_BYTES", request.param)
    return int(request.param)


@pytest.mark.parametrize("small", [0, 1 << 30], indirect=True)
@pytest.mark.parametrize(
    ("table", "change", "says"),
    [
        (
            "sample_data",
            lambda rows: rows[3].update(ego_pose_token="gone"),
            r"sample_data\.json.*'gone'.*ego_pose\.json",
        ),
        ("sample_data", lambda rows: rows[3].update(calibrated_sensor_token="gone"), "'gone'.*calibrated_sensor"),
        ("sample_data", lambda rows: rows[3].update(filename="../../etc/passwd"), "no path below the root"),
        ("sample_data", lambda rows: rows[3].update(filename="/etc/passwd"), "no path below the root"),
        ("ego_pose", lambda rows: rows.pop(3), r"sample_data\.json.*ego_pose\.json does not have"),
        ("ego_pose", lambda rows: rows[3].update(rotation=[0, 0, 0, 0]), r"ego_pose\.json.*length zero"),
        ("ego_pose", lambda rows: rows.append(rows[0]), r"ego_pose\.json: two records have the token"),
        ("sensor", lambda rows: rows.clear(), r"calibrated_sensor\.json.*sensor\.json"),
        ("calibrated_sensor", lambda rows: rows[0].update(camera_intrinsic=[[1, 2], [3, 4]]), "not 3 x 3"),
        ("sample", lambda rows: rows[2].update(next=rows[0]["token"]), r"sample\.json.*comes back"),
        ("sample", lambda rows: rows[1].update(next=rows[1]["token"]), r"sample\.json.*comes back"),
        ("sample", lambda rows: rows[1].update(next="gone"), r"sample\.json.*'gone' is not among"),
        ("sample", lambda rows: rows[1].update(next=""), "not in the chain"),
        ("sample", lambda rows: rows[1].update(timestamp=rows[0]["timestamp"]), "not later"),
        ("scene", lambda rows: rows[0].update(first_sample_token="gone"), r"scene\.json.*'gone'"),
        ("instance", lambda rows: rows.pop(0), r"sample_annotation\.json.*instance\.json"),
        ("category", lambda rows: rows.clear(), r"instance\.json.*category\.json"),
        ("attribute", lambda rows: rows.clear(), r"sample_annotation\.json.*attribute\.json"),
        ("sample_annotation", lambda rows: rows[0].update(next=rows[0]["token"]), "chain loops"),
        ("sample_annotation", lambda rows: rows[0].update(next="gone"), r"sample_annotation\.json.*'gone'"),
        ("sample_annotation", lambda rows: rows[0].update(rotation=[0, 0, 0, 0]), "length zero"),
    ],
)
def test_broken_rows(copy: Path, small: int, table: str, change: Any, says: str) -> None:
    edit(copy, table, change)
    with pytest.raises(FormatError, match=says):
        load_all(copy)


@pytest.mark.parametrize("table", sorted(TABLES))
def test_missing_table(copy: Path, table: str) -> None:
    (copy / VERSION / f"{table}.json").unlink()
    with pytest.raises(FormatError, match=rf"{table}\.json: no such file"):
        NuScenes(copy)


def test_choice_of_version_and_scene(copy: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such folder"):
        NuScenes(tmp_path / "nowhere")
    with pytest.raises(ConfigError, match=r"no version 'v1\.0-test' \(found: v1\.0-mini\)"):
        NuScenes(copy, "v1.0-test")
    with pytest.raises(ConfigError, match=r"no scene 'scene-0104'; closest: scene-0103"):
        NuScenes(copy, VERSION).scene("scene-0104")
    (copy / "v1.0-trainval").mkdir()
    with pytest.raises(ConfigError, match=r"v1\.0-mini, v1\.0-trainval"):
        NuScenes(copy)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match=r"found: none"):
        NuScenes(tmp_path / "empty")


def test_tables_behind_links(tiny: Path, tmp_path: Path, on_disk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    os.symlink(tiny / VERSION, tmp_path / VERSION)
    with pytest.raises(StoreError, match=rf"leads out of .*; copy that here, or allow .* SSAD_DATA_LINKS={tiny}"):
        load_all(tmp_path)
    monkeypatch.setenv("SSAD_DATA_LINKS", f"/nowhere:{tiny.parent}")
    assert equal_scenes(load_all(tmp_path), load_all(tiny))
    assert len(list(on_disk.iterdir())) == 1  # one and the same folder


@pytest.mark.parametrize("name", ["samples", "samples/CAM_FRONT", "sweeps/LIDAR_TOP", f"{VERSION}/scene.json"])
def test_links_inside_are_followed_and_links_out_are_refused(copy: Path, tmp_path: Path, name: str) -> None:
    scenes = load_all(copy)
    for folder in ("samples/CAM_FRONT", "sweeps/LIDAR_TOP", "store"):
        (copy / folder).mkdir(parents=True)
    (copy / name).rename(copy / "store" / "x")
    (copy / name).symlink_to(copy / "store" / "x")
    assert equal_scenes(load_all(copy), scenes)
    (copy / "store" / "x").rename(tmp_path / "outside")
    (copy / name).unlink()
    (copy / name).symlink_to(tmp_path / "outside")
    with pytest.raises(StoreError, match=f"{name}: leads out of"):
        load_all(copy)


def test_files_that_lead_out_are_not_read(tiny: Path, copy: Path) -> None:
    scene = load_all(copy)[0]
    for modality, read in (("camera", read_frame_image), ("lidar", read_frame_points)):
        frame = next(frame for frame in scene.frames if frame.modality == modality)
        path = copy / frame.filename
        path.parent.mkdir(parents=True)
        path.symlink_to(tiny / frame.filename)
        with pytest.raises(StoreError, match="leads out of"):
            read(copy, frame)


# ---------------------------------------------------------------- files of sensors


def test_missing_files(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="no such file"):
        read_points(tmp_path / "gone.bin")


@settings(max_examples=30, deadline=None)
@given(st.lists(st.tuples(*[st.floats(-100, 100, width=32)] * 5), max_size=8))
def test_points_round_trip(tmp_path_factory: pytest.TempPathFactory, rows: list[Any]) -> None:
    points = np.array(rows, np.float32).reshape(-1, 5)
    path = tmp_path_factory.getbasetemp() / "points.bin"
    path.write_bytes(points_bytes(points))
    assert np.array_equal(read_points(path), points)


def test_broken_points(tmp_path: Path) -> None:
    path = tmp_path / "a.pcd.bin"
    path.write_bytes(points_bytes(np.zeros((3, 5)))[:-4])
    with pytest.raises(FormatError, match="56 bytes"):
        read_points(path)
    bad = np.zeros((3, 5))
    bad[1, 3] = np.nan
    path.write_bytes(points_bytes(bad))
    with pytest.raises(FormatError, match="point 1 is not finite"):
        read_points(path)
    with pytest.raises(ValueError, match="shape"):
        points_bytes(np.zeros((3, 4)))
