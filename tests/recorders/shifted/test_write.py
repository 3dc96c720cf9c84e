"""`ssad.recorders.shifted`: what it writes, that it says what it did, that it goes on where it was."""

from __future__ import annotations

import fcntl
import json
import os
import pickle
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.shifted_roots import SCENES, VERSION, edit, fails, first, lines, options, table, tree
from PIL import Image

from ssad.core.boxes import TrackedBoxes
from ssad.core.errors import ConfigError, StoreError
from ssad.core.images import decode_image, encode_jpeg, read_image
from ssad.datasets.nuscenes.files import read_frame_image, read_points
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.point_files import PointFile, encode_points_like
from ssad.recorders.shifted import SceneShifter, check_manifest, verify, write_shifted_roots
from ssad.recorders.shifted import scene_writer as work
from ssad.scenarios.static.shifts import SHIFTS, ShiftSpec, random_severity, shift_images, transformed_boxes

PCD_COLUMNS = ("x", "y", "z", "intensity", "ring")
HELPER = Path(__file__).resolve().parents[2] / "helpers" / "devkit_load.py"


# ---------------------------------------------------------------- what is written


def test_a_root_has_links_and_shifted_files_and_a_page(clean: Path, fog: Path) -> None:
    manifest = check_manifest(fog, SCENES)
    assert manifest is not None
    assert verify(fog) == (42, [])
    assert manifest["files"] == {"camera shifted": 36, "lidar shifted": 6}
    assert manifest["applied"] == 1.0
    assert sorted(manifest["scenes"]) == list(SCENES)
    identity = manifest["identity"]
    assert (identity["shift"], identity["severity"], identity["seed"]) == ("fog", 3, 0)
    assert sorted(p.name for p in fog.iterdir()) == ["manifest", "manifest.json", "maps", "samples", "sweeps", VERSION]
    assert (fog / "maps").resolve() == (clean / "maps").resolve()
    for name in ("scene", "sample_data", "ego_pose"):
        assert (fog / VERSION / f"{name}.json").resolve() == (clean / VERSION / f"{name}.json").resolve()
    record = lines(fog)[first(fog)]
    assert record["severity"] == 3
    assert record["details"]["depth"] == "lidar"
    assert record["sweep"].startswith("samples/LIDAR_TOP/")
    data = (fog / record["file"]).read_bytes()
    assert len(data) == record["bytes"]
    assert not np.array_equal(decode_image(data), read_image(clean / record["file"]))


@pytest.mark.parametrize("calibration", ["physical", "paper"])
def test_every_shift_is_written_as_it_is_on_the_fly(clean: Path, tmp_path: Path, calibration: Any) -> None:
    chosen = options(
        clean, tmp_path / "out", *SHIFTS, calibration=calibration, severities=("random",), scenes=SCENES[:1], seed=4
    )
    scene = NuScenes(clean, VERSION).scene(SCENES[0])
    for written in write_shifted_roots(chosen, workers=0):
        name = written.root.name.removesuffix("-random")
        assert written.failed == 0
        assert 0 < written.applied <= 1
        assert written.shifted + written.linked == 21
        assert verify(written.root) == (21, [])
        assert check_manifest(written.root, SCENES[:1]) is not None
        shifter = SceneShifter(clean, scene, ShiftSpec(name, 1, 4, calibration), random=True)
        found = lines(written.root, SCENES[0])
        for frame in (scene.frames[0], scene.frames[-1]):
            record = found[frame.filename]
            if frame.modality == "lidar":
                points, applied = shifter.points(frame)
                assert np.array_equal(read_points(written.root / frame.filename), points)
            else:
                image, applied = shifter.image(frame)
                subsampling = "444" if SHIFTS[name][0] == "sensor" else "420"
                expected = encode_jpeg(image, 95, subsampling)
                if record["state"] == "linked":
                    expected = (clean / frame.filename).read_bytes()
                assert (written.root / frame.filename).read_bytes() == expected
            assert record["applied"] == applied.applied
            assert record["severity"] == shifter.spec(frame).severity


def test_severity_0_is_the_dataset_itself(clean: Path, tmp_path: Path) -> None:
    """A file in which nothing changes is linked, never encoded anew: pixel for pixel the clean one."""
    for written in write_shifted_roots(
        options(clean, tmp_path / "o", "fog", "scale", "gaussian", severities=(0,)), workers=0
    ):
        assert (written.shifted, written.linked, written.failed, written.applied) == (0, 42, 0, 0.0)
        check_manifest(written.root)
        assert verify(written.root) == (42, [])
        for name in lines(written.root):
            assert (written.root / name).resolve() == (clean / name).resolve()
        assert table(written.root, "sample_annotation.transformed") == table(clean, "sample_annotation")


def test_what_is_not_asked_for_is_linked(clean: Path, tmp_path: Path) -> None:
    written = write_shifted_roots(options(clean, tmp_path / "o", sweeps=False, lidar=False), workers=0)[0]
    assert (written.shifted, written.linked) == (24, 18)
    for name, record in lines(written.root).items():
        assert record["state"] == ("shifted" if name.startswith("samples/CAM") else "linked")
    manifest = check_manifest(written.root)
    assert manifest is not None
    assert manifest["skipped"] == {"not asked for": 18}


def test_a_file_neither_asked_for_nor_in_the_dataset_is_absent(source: Path, tmp_path: Path) -> None:
    """Key frames alone are a common download."""
    shutil.rmtree(source / "sweeps")
    written = write_shifted_roots(options(source, tmp_path / "o", "gaussian", sweeps=False), workers=0)[0]
    assert (written.shifted, written.failed) == (28, 0)
    assert check_manifest(written.root) is not None
    assert verify(written.root) == (42, [])
    (written.root / "sweeps").mkdir(exist_ok=True)
    name = first(written.root, state="absent")
    (written.root / name).parent.mkdir(parents=True, exist_ok=True)
    (written.root / name).write_bytes(b"something")
    fails(StoreError, lambda: check_manifest(written.root), name, "the dataset has none")


def test_tables_without_image_sizes(source: Path, clean: Path, tmp_path: Path) -> None:
    edit(source, "sample_data", lambda row: row.update(width=None, height=None))
    one = write_shifted_roots(options(source, tmp_path / "a", "scale"), workers=0)[0].root
    two = write_shifted_roots(options(clean, tmp_path / "b", "scale"), workers=0)[0].root
    assert {n: (one / n).read_bytes() for n in lines(one)} == {n: (two / n).read_bytes() for n in lines(two)}


@pytest.mark.parametrize(("calibration", "scope"), [("physical", "scene_token"), ("paper", "sample_token")])
def test_random_severity_is_shared(clean: Path, tmp_path: Path, calibration: Any, scope: str) -> None:
    chosen = options(clean, tmp_path / "o", "gaussian", severities=("random",), calibration=calibration, seed=1)
    root = write_shifted_roots(chosen, workers=0)[0].root
    drawn: dict[str, set[int]] = {}
    spec = ShiftSpec("gaussian", 1, 1, calibration)
    data = NuScenes(clean, VERSION)
    for scene in SCENES:
        found = lines(root, scene)
        for frame in data.scene(scene).frames:
            severity = found[frame.filename]["severity"]
            assert severity == random_severity(spec, frame.scene_token, frame.sample_token)
            drawn.setdefault(getattr(frame, scope), set()).add(severity)
    assert all(len(found) == 1 for found in drawn.values())
    assert len(drawn) == (2 if scope == "scene_token" else 4)


def test_jpeg_subsampling_does_not_weaken_noise(source: Path, tmp_path: Path) -> None:
    grey = np.full((180, 320, 3), 128, np.uint8)
    for path in source.glob("samples/CAM_*/*.jpg"):
        path.write_bytes(encode_jpeg(grey, 95))
    chosen = options(source, tmp_path / "a", "gaussian", sweeps=False, lidar=False, scenes=SCENES[:1])
    drawn, _ = shift_images(grey, None, ShiftSpec("gaussian", 3))
    kept = write_shifted_roots(chosen, workers=0)[0].root
    weak = write_shifted_roots(replace(chosen, out=tmp_path / "b", subsampling="420"), workers=0)[0].root
    share = {}
    for root in (kept, weak):
        levels = [read_image(root / n).astype(float).std() for n in lines(root, SCENES[0]) if "samples/CAM" in n]
        share[root] = np.mean(levels) / drawn.astype(float).std()
    assert share[kept] == pytest.approx(1.0, abs=0.02)
    assert share[weak] < 0.85


# ---------------------------------------------------------------- labels


def test_original_labels_are_those_of_the_dataset(clean: Path, tmp_path: Path) -> None:
    root = write_shifted_roots(options(clean, tmp_path / "o", "scale"), workers=0)[0].root
    source = (clean / VERSION / "sample_annotation.json").read_bytes()
    assert (root / VERSION / "sample_annotation.json").read_bytes() == source
    assert (root / VERSION / "sample_annotation.original.json").read_bytes() == source


def test_transformed_labels_are_the_moved_boxes_with_their_points(clean: Path, tmp_path: Path) -> None:
    chosen = options(clean, tmp_path / "o", "scale", labels="transformed", seed=3)
    root = write_shifted_roots(chosen, workers=0)[0].root
    assert (root / VERSION / "sample_annotation.json").readlink() == Path("sample_annotation.transformed.json")
    assert table(root, "sample_annotation") == table(root, "sample_annotation.transformed")
    old, new = NuScenes(clean, VERSION), NuScenes(root, VERSION)
    ratios = []
    for name in SCENES:
        before, after = old.scene(name), new.scene(name)
        for sample in before.samples:
            one, two = before.annotations(sample.token), after.annotations(sample.token)
            visible = np.ones(len(one))
            boxes = TrackedBoxes(one.centre, one.size_lwh, one.rotation, one.velocity, one.instance, visible)
            drawn = transformed_boxes(
                chosen.shards((name,))[0].spec(), boxes, scene=sample.scene_token, sample=sample.token
            )
            np.testing.assert_allclose(two.size_lwh, drawn.size_lwh, rtol=1e-12)
            np.testing.assert_allclose(two.centre, drawn.centre, rtol=1e-12)
            ratio = two.size_lwh / one.size_lwh
            np.testing.assert_allclose(ratio, np.broadcast_to(ratio[:, :1], ratio.shape), rtol=1e-9)
            ratios += list(ratio[:, 0])
            assert one.token == two.token
            frame = next(
                f for f in after.frames if f.key_frame and f.modality == "lidar" and f.sample_token == sample.token
            )
            points = read_points(root / frame.filename)[:, :3].astype(float)
            pose = frame.ego_to_world @ frame.sensor_to_ego
            counted = [
                _count(points @ pose[:3, :3].T + pose[:3, 3], *row)
                for row in zip(two.centre, two.size_wlh, two.rotation, strict=True)
            ]
            assert two.lidar_points.tolist() == counted
    assert min(np.abs(np.array(ratios) - 1)) > 0.01


def _count(points: Any, centre: Any, size: Any, rotation: Any) -> int:
    """Points in an upright box, computed in another way than by the toolbox."""
    w, _, _, z = rotation
    yaw = 2 * np.arctan2(z, w)
    x, y, height = (points - centre).T
    along, across = np.cos(yaw) * x + np.sin(yaw) * y, np.cos(yaw) * y - np.sin(yaw) * x
    near = [np.abs(along) <= size[1] / 2, np.abs(across) <= size[0] / 2, np.abs(height) <= size[2] / 2]
    return int(np.logical_and.reduce(near).sum())


def test_counts_are_of_the_sweep_that_is_written(clean: Path, tmp_path: Path) -> None:
    """Snow takes points away; without the LiDAR twin the clean sweep is linked and keeps all of them."""
    counts = {}
    for lidar in (True, False):
        chosen = options(clean, tmp_path / str(lidar), "snow", severities=(5,), lidar=lidar)
        root = write_shifted_roots(chosen, workers=0)[0].root
        rows = table(root, "sample_annotation.transformed")
        counts[lidar] = {row["token"]: row["num_lidar_pts"] for row in rows}
        kept = [{k: v for k, v in row.items() if k != "num_lidar_pts"} for row in rows]
        assert kept == [{k: v for k, v in r.items() if k != "num_lidar_pts"} for r in table(clean, "sample_annotation")]
    assert sum(counts[True].values()) < 0.95 * sum(counts[False].values())
    scene = NuScenes(clean, VERSION).scene(SCENES[0])
    shifter = SceneShifter(clean, scene, ShiftSpec("snow", 5))
    for sample in scene.samples:
        kept = shifter.labels(sample.token, lidar=None).lidar_points
        assert kept.tolist() == scene.annotations(sample.token).lidar_points.tolist()
        for shifted in (True, False):
            found = shifter.labels(sample.token, lidar=shifted)
            assert found.lidar_points.tolist() == [counts[shifted][token] for token in found.token]


def test_the_official_toolkit_reads_a_root(clean: Path, tmp_path: Path) -> None:
    python = os.environ.get("SSAD_DEVKIT_PYTHON")
    if not python:
        pytest.skip("SSAD_DEVKIT_PYTHON names no interpreter with nuscenes-devkit")
    root = write_shifted_roots(options(clean, tmp_path / "o", "rotation", labels="transformed"), workers=0)[0].root
    shown = subprocess.run([python, str(HELPER), str(root), VERSION], capture_output=True, text=True, check=False)
    assert shown.returncode == 0, shown.stderr
    found = json.loads(shown.stdout)
    rows = {row["token"]: row for row in table(root, "sample_annotation.transformed")}
    boxes = [box for frame in found["frames"].values() if frame["key"] for box in frame["boxes"]]
    assert boxes
    for box in boxes:
        np.testing.assert_allclose(box["size"], rows[box["token"]]["size"])
        np.testing.assert_allclose(box["centre"], rows[box["token"]]["translation"])


# ---------------------------------------------------------------- the same bytes


def test_workers_order_and_runs_do_not_matter(clean: Path, tmp_path: Path) -> None:
    chosen = options(clean, tmp_path / "a", "snow", "scale", severities=("random",))
    seen: list[tuple[int, int]] = []
    write_shifted_roots(chosen, workers=0, progress=lambda done, of: seen.append((done, of)))
    assert seen == [(1, 4), (2, 4), (3, 4), (4, 4)]
    expected = tree(tmp_path / "a")
    write_shifted_roots(replace(chosen, out=tmp_path / "b", scenes=SCENES[::-1]), workers=2)
    assert tree(tmp_path / "b") == expected
    write_shifted_roots(replace(chosen, out=tmp_path / "c", scenes=SCENES[1:]), workers=0)
    for shift in chosen.shifts:
        fails(StoreError, lambda s=shift: check_manifest(tmp_path / "c" / f"{s}-random", SCENES), SCENES[0])
    write_shifted_roots(replace(chosen, out=tmp_path / "c", scenes=SCENES[:1]), workers=0)
    assert tree(tmp_path / "c") == expected


def test_asked_for_twice_is_written_once(clean: Path, tmp_path: Path) -> None:
    chosen = options(clean, tmp_path / "a", "fog", "fog", severities=(3, 3), scenes=(SCENES[0], SCENES[0]))
    assert len(write_shifted_roots(chosen, workers=0)) == 1


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_ray_gives_the_same_bytes(clean: Path, fog: Path, tmp_path: Path) -> None:
    pytest.importorskip("ray")
    write_shifted_roots(options(clean, tmp_path / "o"), ray="local")
    assert tree(tmp_path / "o" / "fog-3") == tree(fog)


def test_options_and_shards_travel(clean: Path, tmp_path: Path) -> None:
    shard = options(clean, tmp_path).shards(SCENES)[1]
    assert pickle.loads(pickle.dumps(shard)) == shard


# ---------------------------------------------------------------- going on


def test_resume_keeps_what_stands_and_redoes_what_does_not(clean: Path, fog: Path, tmp_path: Path) -> None:
    chosen = options(clean, tmp_path / "o")
    root = write_shifted_roots(chosen, workers=0)[0].root
    files = sorted(n for n, r in lines(root).items() if r["kind"] == "camera")
    gone, cut, replaced, linked = files[:4]
    (root / gone).unlink()
    (root / cut).write_bytes((root / cut).read_bytes()[:-100])
    data = bytearray((root / replaced).read_bytes())
    data[-20] ^= 1
    (root / replaced).write_bytes(bytes(data))
    (root / linked).unlink()
    (root / linked).symlink_to(clean / linked)
    before = {name: (root / name).stat().st_mtime_ns for name in lines(root) if name not in files[:4]}
    written = write_shifted_roots(chosen, workers=0)[0]
    assert (written.shifted, written.failed) == (42, 0)
    assert {name: (root / name).stat().st_mtime_ns for name in before} == before
    assert tree(root) == tree(fog)


@pytest.mark.parametrize("rest", [b"", b"\n", b'{"file":"x","state":"shifted"}\n', b"\x00\xff\n"])
def test_a_torn_manifest_line_costs_one_file(clean: Path, fog: Path, tmp_path: Path, rest: bytes) -> None:
    shutil.copytree(fog, tmp_path / "o" / "fog-3", symlinks=True)
    root = tmp_path / "o" / "fog-3"
    path = root / "manifest" / f"{SCENES[0]}.jsonl"
    path.write_bytes(path.read_bytes()[:-50] + rest)
    last = max(lines(fog, SCENES[0]))
    before = {n: (root / n).stat().st_ino for n in lines(fog)}
    write_shifted_roots(options(clean, tmp_path / "o"), workers=0)
    assert [n for n, inode in before.items() if (root / n).stat().st_ino != inode] == [last]
    assert tree(root) == tree(fog)


def test_damaged_labels_are_made_again(clean: Path, fog: Path, tmp_path: Path) -> None:
    shutil.copytree(fog, tmp_path / "o" / "fog-3", symlinks=True)
    root = tmp_path / "o" / "fog-3"
    (root / "manifest" / f"{SCENES[0]}.labels.json").write_text('{"lines"')
    (root / "manifest" / f"{SCENES[1]}.labels.json").unlink()
    write_shifted_roots(options(clean, tmp_path / "o"), workers=0)
    assert tree(root) == tree(fog)


def test_leftovers_of_a_killed_run_are_removed(clean: Path, fog: Path, tmp_path: Path) -> None:
    shutil.copytree(fog, tmp_path / "o" / "fog-3", symlinks=True)
    root = tmp_path / "o" / "fog-3"
    (root / ".unfinished").mkdir()
    (root / ".unfinished" / "123-abc").write_bytes(b"half")
    (root / VERSION / ".sample_annotation.transformed-12-0123abcd.tmp.json").write_bytes(b"half")
    (root / "manifest" / ".probe-77-0123abcd.tmp").write_bytes(b"")
    write_shifted_roots(options(clean, tmp_path / "o"), workers=0)
    assert tree(root) == tree(fog)


def test_a_root_of_another_identity_is_refused(clean: Path, fog: Path, tmp_path: Path) -> None:
    shutil.copytree(fog, tmp_path / "o" / "fog-3", symlinks=True)
    before = tree(tmp_path / "o")
    for other in ({"seed": 1}, {"quality": 90}, {"calibration": "paper"}, {"sweeps": False}, {"subsampling": "444"}):
        fails(
            StoreError,
            lambda o=other: write_shifted_roots(options(clean, tmp_path / "o", **o), workers=0),
            "other data or",
        )
    assert tree(tmp_path / "o") == before


def test_a_root_of_other_tables_is_refused(source: Path, tmp_path: Path) -> None:
    write_shifted_roots(options(source, tmp_path / "o"), workers=0)
    edit(source, "ego_pose", lambda row: row["translation"].__setitem__(0, row["translation"][0] + 1))
    fails(StoreError, lambda: write_shifted_roots(options(source, tmp_path / "o"), workers=0), "other data or options")
    # and the same process reads the changed tables, not those it knows
    one = write_shifted_roots(options(source, tmp_path / "p", "snow"), workers=0)[0].root
    work._DATA.clear()
    two = write_shifted_roots(options(source, tmp_path / "q", "snow"), workers=0)[0].root
    assert tree(one) == tree(two)


def test_labels_may_be_asked_for_anew(clean: Path, tmp_path: Path) -> None:
    root = write_shifted_roots(options(clean, tmp_path / "o", "scale"), workers=0)[0].root
    before = {n: (root / n).stat().st_ino for n in lines(root)}
    write_shifted_roots(options(clean, tmp_path / "o", "scale", labels="transformed"), workers=0)
    manifest = check_manifest(root)
    assert manifest is not None
    assert manifest["labels"] == "transformed"
    assert {n: (root / n).stat().st_ino for n in lines(root)} == before
    link = root / VERSION / "sample_annotation.json"
    link.unlink()
    link.symlink_to("sample_annotation.original.json")
    fails(StoreError, lambda: check_manifest(root), "transformed boxes")


def test_one_shift_at_a_time(clean: Path, tmp_path: Path) -> None:
    out = tmp_path / "o"
    out.mkdir()
    with open(out / ".lock", "w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        fails(StoreError, lambda: write_shifted_roots(options(clean, out), workers=0), "another ssad shift")
    write_shifted_roots(options(clean, out, scenes=SCENES[:1]), workers=0)


# ---------------------------------------------------------------- options


def test_options_that_make_no_sense(clean: Path, fog: Path, tmp_path: Path) -> None:
    for out in (clean, clean / "x", clean.parent, clean / "samples" / ".." / "y"):
        fails(ConfigError, lambda o=out: options(clean, o), "outside of the dataset")
    for wrong in ({"quality": 0}, {"subsampling": "411"}, {"labels": "new"}, {"calibration": "x"}, {"severities": ()}):
        fails(ConfigError, lambda w=wrong: options(clean, tmp_path, **w))
    for severity in (6, -1, "hard", True):
        fails(ConfigError, lambda s=severity: options(clean, tmp_path, severities=(s,)))
    fails(ConfigError, lambda: options(clean, tmp_path, "smog"), "unknown shift")
    out = tmp_path / "o"
    fails(ConfigError, lambda: write_shifted_roots(options(clean, out, scenes=("scene-9",)), workers=0), "scene-9")
    fails(ConfigError, lambda: write_shifted_roots(options(clean, out), workers=-1), "-1 workers")
    fails(ConfigError, lambda: write_shifted_roots(options(tmp_path / "none", out), workers=0), "no such folder")
    fails(ConfigError, lambda: write_shifted_roots(options(fog, out), workers=0), "shifted already")
    assert not out.exists()


def test_links_of_a_shifted_root_lead_to_the_same_file_of_its_source_alone(
    clean: Path, fog: Path, tmp_path: Path
) -> None:
    root = Path(shutil.copytree(fog, tmp_path / "fog-3", symlinks=True))
    link = root / VERSION / "log.json"
    assert link.resolve() == (clean / VERSION / "log.json").resolve()
    NuScenes(root).scene(SCENES[0])
    link.unlink()
    link.symlink_to(clean / VERSION / "map.json")
    fails(StoreError, lambda: NuScenes(root), "log.json", "leads out of", "map.json")


def test_nothing_is_written_through_a_link_into_the_dataset(clean: Path, tmp_path: Path) -> None:
    before = tree(clean)
    for name in ("samples", "sweeps/CAM_FRONT", VERSION):
        out = tmp_path / name.replace("/", "-")
        place = out / "fog-3" / name
        place.parent.mkdir(parents=True)
        place.symlink_to(clean / name)
        fails(
            StoreError, lambda o=out: write_shifted_roots(options(clean, o), workers=0), name, "leads into the dataset"
        )
    assert tree(clean) == before


# ---------------------------------------------------------------- other formats


def _rename(root: Path, old: str, new: str) -> None:
    """Change a file name in the tables."""
    table = root / VERSION / "sample_data.json"
    table.write_text(table.read_text().replace(old, new))


def test_images_and_sweeps_of_other_formats_are_shifted_in_their_own(source: Path, tmp_path: Path) -> None:
    """A turned and a grey JPEG, a WebP and a PCD in a nuScenes folder."""
    turned, grey, webp = sorted(source.glob("samples/CAM_FRONT/*.jpg"))[:3]
    exif = Image.Exif()
    exif[0x0112] = 3
    Image.open(turned).save(turned, exif=exif)
    Image.open(grey).convert("L").save(grey)
    Image.open(webp).save(webp.with_suffix(".webp"))
    webp.unlink()
    _rename(source, webp.name, f"{webp.stem}.webp")
    for sweep in sorted(source.glob("s*/LIDAR_TOP/*.pcd.bin")):
        points = read_points(sweep)
        as_pcd = PointFile(points, "pcd", False, tuple((name, np.dtype("<f4")) for name in PCD_COLUMNS))
        sweep.with_name(sweep.name.removesuffix(".bin")).write_bytes(encode_points_like(as_pcd, points))
        sweep.unlink()
    _rename(source, ".pcd.bin", ".pcd")
    (written,) = write_shifted_roots(options(source, tmp_path / "o", "fog", sweeps=False), workers=0)
    assert (written.reasons, written.failed) == ((), 0)
    root = written.root
    with Image.open(root / turned.relative_to(source)) as image:
        assert image.getexif()[0x0112] == 3
    clean_scene = NuScenes(source, VERSION).scene(SCENES[0])
    frame = next(frame for frame in clean_scene.frames if frame.filename.endswith(turned.name))
    stored, fogged = (read_frame_image(place, frame) for place in (source, root))
    with Image.open(turned) as image:
        assert np.array_equal(stored, np.asarray(image)), "the camera matrix is that of the stored pixels"
    differences = [np.abs(stored.astype(int) - image).mean() for image in (fogged, fogged[::-1, ::-1])]
    assert differences[0] < differences[1], "it is not turned against the clean one"
    with Image.open(root / grey.relative_to(source)) as image:
        assert image.mode == "L"
    with Image.open((root / webp.relative_to(source)).with_suffix(".webp")) as image:
        assert image.format == "WEBP"
    for sweep in source.glob("samples/LIDAR_TOP/*.pcd"):
        shifted = root / sweep.relative_to(source)
        assert shifted.read_bytes().startswith(b"# .PCD")
        assert read_points(shifted)[:, 3].mean() < 0.9 * read_points(sweep)[:, 3].mean()
    assert verify(root)[1] == []


def test_a_nuscenes_folder_with_links_inside_has_no_clean_files_beside_the_shifted(
    source: Path, tmp_path: Path
) -> None:
    expected = tree(write_shifted_roots(options(source, tmp_path / "plain", "uniform"), workers=0)[0].root / "samples")
    (source / "store").mkdir()
    shutil.move(source / "samples", source / "store" / "samples")
    (source / "samples").symlink_to("store/samples")
    shutil.move(source / "sweeps" / "CAM_BACK", source / "back")
    (source / "sweeps" / "CAM_BACK").symlink_to("../back")
    (written,) = write_shifted_roots(options(source, tmp_path / "linked", "uniform"), workers=0)
    assert written.reasons == ()
    assert not (written.root / "store").exists()
    assert not (written.root / "back").exists()
    assert (written.root / "maps").exists()
    assert tree(written.root / "samples") == expected
    assert not any((written.root / folder).is_symlink() for folder in ("samples", "sweeps", "sweeps/CAM_BACK"))
