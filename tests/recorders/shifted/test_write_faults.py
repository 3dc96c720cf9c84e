"""`ssad.recorders.shifted`: broken data, output that cannot be written, what does not pass for a shifted dataset."""

from __future__ import annotations

import contextlib
import errno
import os
import resource
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.shifted_roots import SCENES, VERSION, edit, fails, first, lines, options, table, tree
from PIL import Image

from ssad.core.errors import FormatError, StoreError
from ssad.core.images import encode_jpeg
from ssad.recorders.shifted import check_manifest, read_manifest, verify, write_shifted_roots
from ssad.recorders.shifted import scene_writer as work
from ssad.recorders.shifted import write as run

# ---------------------------------------------------------------- nothing changed, broken data


def test_a_shift_that_changes_nothing_is_an_error(source: Path, tmp_path: Path) -> None:
    (source / VERSION / "sample_annotation.json").write_text("[]")
    edit(
        source,
        "instance",
        lambda row: row.update(first_annotation_token="", last_annotation_token="", nbr_annotations=0),
    )
    chosen = options(source, tmp_path / "o", "rotation", "gaussian")
    message = fails(StoreError, lambda: write_shifted_roots(chosen, workers=0), "rotation changed none of 36 images")
    assert message.rsplit(": ", 1)[1]  # a reason
    fails(StoreError, lambda: check_manifest(tmp_path / "o" / "rotation-3"), "not complete")
    assert verify(tmp_path / "o" / "gaussian-3") == (42, [])  # the other root is finished all the same


def _missing(path: Path) -> None:
    path.unlink()


def _truncated(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:2000])


def _empty(path: Path) -> None:
    path.write_bytes(b"")


def _wrong_size(path: Path) -> None:
    path.write_bytes(encode_jpeg(np.zeros((90, 160, 3), np.uint8)))


def _moving(path: Path) -> None:
    frame = Image.new("RGB", (320, 180), "grey")
    frame.save(path, "WEBP", save_all=True, append_images=[Image.new("RGB", (320, 180), "red")])


@pytest.mark.parametrize(
    ("shift", "damage"),
    [("fog", _missing), ("snow", _truncated), ("sunlight", _wrong_size), ("scale", _empty), ("gaussian", _moving)],
)
def test_a_broken_image_is_on_record_and_mending_it_completes(
    source: Path, tmp_path: Path, shift: str, damage: Callable[[Path], None]
) -> None:
    """The first key frame of a scene: the brightness of the sky is measured on it."""
    broken = min(source.glob("samples/CAM_FRONT/*.jpg"))
    name = str(broken.relative_to(source))
    data = broken.read_bytes()
    chosen = options(source, tmp_path / "o", shift)
    expected = tree(write_shifted_roots(replace(chosen, out=tmp_path / "whole"), workers=0)[0].root)
    damage(broken)
    written = write_shifted_roots(chosen, workers=0)[0]
    assert written.failed == 1
    assert written.shifted + written.linked == 41
    assert name in written.reasons[0]
    assert str(source) not in written.reasons[0]
    assert lines(written.root)[name]["state"] == "failed"
    assert not (written.root / name).exists()
    assert not (written.root / "manifest.json").exists()
    fails(StoreError, lambda: check_manifest(written.root), "not complete")
    assert write_shifted_roots(chosen, workers=0)[0] == written  # again, with the same end
    broken.write_bytes(data)
    assert write_shifted_roots(chosen, workers=0)[0].failed == 0
    assert tree(written.root) == expected


@pytest.mark.parametrize("lidar", [True, False])
def test_a_broken_sweep_is_on_record_and_mending_it_completes(source: Path, tmp_path: Path, lidar: bool) -> None:
    """Fog takes depth from it, and boxes are counted in it."""
    broken = min(source.glob("samples/LIDAR_TOP/*.bin"))
    data = broken.read_bytes()
    chosen = options(source, tmp_path / "o", "fog", "scale", lidar=lidar, scenes=SCENES[:1])
    write_shifted_roots(replace(chosen, out=tmp_path / "whole"), workers=0)
    broken.write_bytes(data[:-7])
    for written in write_shifted_roots(chosen, workers=0):
        assert written.failed == 1
        assert "cut short" in written.reasons[0]
    broken.write_bytes(data)
    assert [w.failed for w in write_shifted_roots(chosen, workers=0)] == [0, 0]
    assert tree(tmp_path / "o") == tree(tmp_path / "whole")


def test_a_failed_scene_does_not_hold_up_another(source: Path, tmp_path: Path) -> None:
    broken = min(source.glob("samples/CAM_FRONT/scene-0103*.jpg"))
    _truncated(broken)
    chosen = options(source, tmp_path / "o", scenes=SCENES[:1])
    assert write_shifted_roots(chosen, workers=0)[0].failed == 1
    root = write_shifted_roots(replace(chosen, scenes=SCENES[1:]), workers=0)[0].root
    assert check_manifest(root, SCENES[1:]) is not None
    fails(StoreError, lambda: check_manifest(root, SCENES), SCENES[0])


@pytest.mark.parametrize("name", ["sample_annotation", "sample_data", "scene", "log"])
def test_broken_tables_are_one_line_before_anything_is_written(source: Path, tmp_path: Path, name: str) -> None:
    path = source / VERSION / f"{name}.json"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    fails(FormatError, lambda: write_shifted_roots(options(source, tmp_path / "o"), workers=0), f"{name}.json")
    path.unlink()
    fails(
        FormatError,
        lambda: write_shifted_roots(options(source, tmp_path / "o"), workers=0),
        f"{name}.json",
        "no such file",
    )
    assert not (tmp_path / "o").exists()


def test_boxes_behind_around_and_without_size_do_no_harm(source: Path, tmp_path: Path) -> None:
    poses = {row["token"]: row["translation"] for row in table(source, "ego_pose")}
    samples = {row["sample_token"]: poses[row["ego_pose_token"]] for row in table(source, "sample_data")}

    places = iter(range(10_000))

    def move(row: dict[str, Any]) -> None:
        x, y, _ = samples[row["sample_token"]]
        number = next(places)
        at = [(x, y, 1.0), (x - 3.0, y, 1.0), (x, y, -500.0), (x + 1e6, y, 0.0), (x, y + 0.1, 1.5)][number % 5]
        row.update(translation=list(at), size=[[1e-9, 4.0, 1.5], [2.0, 4.5, 1.5], [30.0, 30.0, 30.0]][number % 3])

    edit(source, "sample_annotation", move)
    for shift in ("scale", "shear", "rotation", "motion_blur"):
        # none is seen: that is said, in one line
        with contextlib.suppress(StoreError):
            written = write_shifted_roots(options(source, tmp_path / "o", shift, scenes=SCENES[:1]), workers=0)[0]
            assert written.failed == 0
            assert verify(written.root) == (21, [])


def test_a_box_without_volume_stays_as_it_is(source: Path, clean: Path, tmp_path: Path) -> None:
    token = table(source, "sample_annotation")[0]["token"]
    edit(source, "sample_annotation", lambda row: row["token"] == token and row.update(size=[0.0, 4.0, 1.5]))
    written = write_shifted_roots(
        options(source, tmp_path / "o", "scale", "shear", "rotation", "motion_blur"), workers=0
    )
    for root in (w.root for w in written):
        assert verify(root) == (42, [])
        rows = {row["token"]: row for row in table(root, "sample_annotation.transformed")}
        assert rows[token] == table(source, "sample_annotation")[0]
    edit(source, "sample_annotation", lambda row: row.update(size=[0.0, 0.0, 0.0]))
    fails(
        StoreError,
        lambda: write_shifted_roots(options(source, tmp_path / "p", "scale"), workers=0),
        "none of 36 images",
    )


def test_a_camera_without_focal_length_is_on_record(source: Path, tmp_path: Path) -> None:
    edit(
        source,
        "calibrated_sensor",
        lambda row: row["camera_intrinsic"] and row.update(camera_intrinsic=[[0.0] * 3] * 3),
    )
    for written in write_shifted_roots(
        options(source, tmp_path / "o", "fog", "sunlight", "scale", "gaussian"), workers=0
    ):
        assert written.failed == 36
        assert "no focal length" in written.reasons[0]


# ---------------------------------------------------------------- the output cannot be written


def test_output_below_a_file(clean: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    fails(
        StoreError,
        lambda: write_shifted_roots(options(clean, tmp_path / "file" / "o"), workers=0),
        "cannot write there",
    )


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_read_only_output(clean: Path, tmp_path: Path) -> None:
    (tmp_path / "o").mkdir(mode=0o500)
    fails(StoreError, lambda: write_shifted_roots(options(clean, tmp_path / "o"), workers=0), "cannot write there")


@pytest.mark.parametrize(
    ("code", "after"),
    [(errno.EROFS, 0), (errno.ENOSPC, 1), (errno.EDQUOT, 20), (errno.ENOSPC, 45), (errno.ENOSPC, 60)],
)
def test_output_that_cannot_be_written_loses_nothing(
    clean: Path, fog: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int, after: int
) -> None:
    """The n-th file that is moved into place fails."""
    calls = 0

    def full(*names: Any, **other: Any) -> None:
        nonlocal calls
        calls += 1
        if calls > after:
            raise OSError(code, os.strerror(code))
        moved(*names, **other)

    moved = os.replace
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", full)
        fails(StoreError, lambda: write_shifted_roots(options(clean, tmp_path / "o"), workers=0), os.strerror(code))
    whole = tree(fog)
    for name, data in tree(tmp_path / "o" / "fog-3").items():
        assert name != "manifest.json"
        assert not Path(name).name.startswith(".")
        if name.startswith(("samples", "sweeps", VERSION)):
            assert data == whole[name]
    write_shifted_roots(options(clean, tmp_path / "o"), workers=0)
    assert tree(tmp_path / "o" / "fog-3") == whole


@contextlib.contextmanager
def largest_file(size: int) -> Iterator[None]:
    """The kernel cuts off what a file has beyond `size` bytes, in the middle of a write."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("size", [100, 3000, 9000, 20_000])
def test_writes_that_stop_half_way(clean: Path, fog: Path, tmp_path: Path, size: int) -> None:
    with largest_file(size):
        fails(StoreError, lambda: write_shifted_roots(options(clean, tmp_path / "o"), workers=0), "File too large")
    whole = tree(fog)
    for name, data in tree(tmp_path / "o").items():
        if "samples" in name or "sweeps" in name:
            assert data == whole[name.removeprefix("fog-3/")]
    write_shifted_roots(options(clean, tmp_path / "o"), workers=0)
    assert tree(tmp_path / "o" / "fog-3") == whole


def test_a_worker_that_dies_is_one_line(
    clean: Path, fog: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(run, "make_shard", _die)
        fails(StoreError, lambda: write_shifted_roots(options(clean, tmp_path / "o"), workers=2), "the process ended")
    write_shifted_roots(options(clean, tmp_path / "o"), workers=0)
    assert tree(tmp_path / "o" / "fog-3") == tree(fog)


def _die(shard: Any) -> dict[str, int]:
    os._exit(9)


# ---------------------------------------------------------------- the manifest is checked


def test_clean_data_have_no_manifest(clean: Path, tmp_path: Path) -> None:
    assert read_manifest(clean) is None
    assert check_manifest(clean, SCENES) is None
    fails(StoreError, lambda: verify(clean), "not written by ssad shift")


def _by_the_clean_one(clean: Path, root: Path) -> None:
    shutil.copyfile(clean / first(root), root / first(root))


def _by_a_link(clean: Path, root: Path) -> None:
    (root / first(root)).unlink()
    (root / first(root)).symlink_to(clean / first(root))


def _by_all_links(clean: Path, root: Path) -> None:
    shutil.rmtree(root / "samples")
    (root / "samples").symlink_to(clean / "samples")


def _gone(clean: Path, root: Path) -> None:
    (root / first(root, "lidar")).unlink()


def _edited_line(clean: Path, root: Path) -> None:
    path = root / "manifest" / f"{SCENES[1]}.jsonl"
    path.write_text(path.read_text().replace('"severity":3', '"severity":5', 1))


def _lost_line(clean: Path, root: Path) -> None:
    path = root / "manifest" / f"{SCENES[1]}.jsonl"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[1:]))


def _lost_lines(clean: Path, root: Path) -> None:
    (root / "manifest" / f"{SCENES[0]}.jsonl").unlink()


def _other_boxes(clean: Path, root: Path) -> None:
    path = root / VERSION / "sample_annotation.json"
    data = path.read_bytes()
    path.unlink()
    path.write_bytes(data)


@pytest.mark.parametrize(
    "change", [_by_the_clean_one, _by_a_link, _by_all_links, _gone, _edited_line, _lost_line, _lost_lines, _other_boxes]
)
def test_check_and_verify_catch_what_is_not_shifted(
    clean: Path, root: Path, change: Callable[[Path, Path], None]
) -> None:
    check_manifest(root, SCENES)
    change(clean, root)
    fails(StoreError, lambda: check_manifest(root, SCENES), str(root))
    _, problems = verify(root)
    assert problems
    assert all(str(root) in line and "\n" not in line for line in problems)


def test_same_size_other_bytes(root: Path) -> None:
    """check_manifest hashes a sample of the files, verify all of them."""
    for name, record in lines(root).items():
        if record["kind"] == "camera":
            data = bytearray((root / name).read_bytes())
            data[-10] ^= 1
            (root / name).write_bytes(bytes(data))
    fails(StoreError, lambda: check_manifest(root), "not the bytes in the manifest")
    assert len(verify(root)[1]) == 36


def test_a_link_to_another_file(clean: Path, tmp_path: Path) -> None:
    root = write_shifted_roots(options(clean, tmp_path / "o", sweeps=False), workers=0)[0].root
    name = first(root, state="linked")
    other = max(n for n, r in lines(root).items() if r["state"] == "linked" and r["kind"] == "camera")
    (root / name).unlink()
    (root / name).symlink_to(clean / other)
    fails(StoreError, lambda: check_manifest(root), name, "no link to the clean file")
    assert len(verify(root)[1]) == 1


def test_tables_and_boxes_are_verified(root: Path) -> None:
    path = root / VERSION / "sample_annotation.transformed.json"
    path.write_text(path.read_text().replace("0", "1", 1))
    (root / VERSION / "scene.json").unlink()
    (root / VERSION / "scene.json").write_text("[]")
    _, problems = verify(root)
    assert [Path(p.split(": ")[0]).name for p in problems] == ["sample_annotation.transformed.json", "scene.json"]


def test_only_the_scenes_that_are_scored_are_looked_at(root: Path) -> None:
    (root / min(lines(root, SCENES[0]))).unlink()
    assert check_manifest(root, SCENES[1:]) is not None
    fails(StoreError, lambda: check_manifest(root, SCENES[:1]), "missing")
    fails(StoreError, lambda: check_manifest(root, ["scene-0001", *SCENES]), "scene-0001", "not shifted")


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "{}", '{"identity":{},"source":{},"scenes":[],"images":1}', '{"identity":1}', "\x00"]
)
def test_a_broken_page(root: Path, text: str) -> None:
    (root / "manifest.json").write_text(text)
    for check in (read_manifest, check_manifest, verify):
        fails(FormatError, lambda c=check: c(root), "manifest.json")


def test_nothing_is_left_open_or_changed(clean: Path, tmp_path: Path) -> None:
    before, threads = tree(clean), cv2.getNumThreads()
    write_shifted_roots(options(clean, tmp_path / "o", "fog", "gaussian", "scale", scenes=SCENES[:1]), workers=0)
    assert tree(clean) == before
    assert cv2.getNumThreads() == threads
    assert len(work._DATA) == 1
