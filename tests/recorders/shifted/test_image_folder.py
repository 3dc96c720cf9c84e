"""`ssad shift` on folders of pictures that are no nuScenes root."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.command import ssad
from helpers.killing import STOPS, kill_9, wait_until_stopped

from ssad.core.images import read_image, save_picture
from ssad.recorders.shifted.image_folder import camera_of


@pytest.fixture
def kitti(tmp_path: Path) -> Path:
    """Two pictures with labels and calibration, and one picture that is broken."""
    root = tmp_path / "training"
    draws = np.random.default_rng(0)
    for name in ("000000", "000001"):
        save_picture(root / "image_2" / f"{name}.png", draws.integers(40, 200, (96, 320, 3), dtype=np.uint8))
        (root / "calib").mkdir(exist_ok=True)
        (root / "calib" / f"{name}.txt").write_text("P0: 1\nP2: 250 0 160 1 0 250 48 0 0 0 1 0\n")
    (root / "label_2").mkdir()
    (root / "label_2" / "000000.txt").write_text("Car 0 0 0 1 2 3 4 1 1 1 1 1 1 0\n")
    return root


def test_pictures_are_shifted_in_place_and_all_else_is_linked(kitti: Path, tmp_path: Path) -> None:
    words = ("shift", kitti, tmp_path / "out", "--shifts", "fog,gaussian", "--severity", "3")
    done = ssad(*words)
    assert done.returncode == 0, done.stderr
    for name in ("fog-3", "gaussian-3"):
        root = tmp_path / "out" / name
        assert (
            f"{root}: 2 pictures shifted, 3 other files linked unchanged, 100 % of the pictures changed" in done.stdout
        )
        assert (root / "label_2" / "000000.txt").read_text() == (kitti / "label_2" / "000000.txt").read_text()
        before, after = (read_image(place / "image_2" / "000000.png") for place in (kitti, root))
        assert before.shape == after.shape
        assert np.abs(before.astype(int) - after).mean() > 2
        lines = [json.loads(line) for line in (root / "manifest.jsonl").read_text().splitlines()]
        assert [line["key"] for line in lines] == ["image_2/000000.png", "image_2/000001.png"]
    whole = (tmp_path / "out" / "fog-3" / "image_2" / "000001.png").read_bytes()
    (tmp_path / "out" / "fog-3" / "image_2" / "000001.png").unlink()
    assert ssad(*words).returncode == 0, "it goes on"
    assert (tmp_path / "out" / "fog-3" / "image_2" / "000001.png").read_bytes() == whole
    other = ssad(*words, "--seed", "7")
    assert other.returncode == 2
    assert "holds another run (suite ssad shift; differs in seed)" in other.stderr


def test_a_broken_picture_fails_alone(kitti: Path, tmp_path: Path) -> None:
    (kitti / "image_2" / "000001.png").write_bytes(b"nothing")
    done = ssad("shift", kitti, tmp_path / "out", "--shifts", "uniform", "--severity", "1")
    assert done.returncode == 1
    assert "1 pictures shifted" in done.stdout
    assert "1 failed" in done.stdout
    assert "image_2/000001.png: " in done.stdout


def test_what_needs_boxes_is_refused_or_named(kitti: Path, tmp_path: Path) -> None:
    refused = ssad("shift", kitti, tmp_path / "out", "--shifts", "scale", "--severity", "1")
    assert (refused.returncode, refused.stdout) == (2, "")
    assert "scale needs boxes in space" in refused.stderr
    assert "lies in" in ssad("shift", kitti, kitti / "out", "--shifts", "fog").stderr
    assert "--split is for a nuScenes folder" in ssad("shift", kitti, tmp_path / "o", "--split", "val").stderr
    (tmp_path / "empty").mkdir()
    assert "no picture" in ssad("shift", tmp_path / "empty", tmp_path / "o").stderr
    assert not (tmp_path / "o").exists()


def test_the_camera_of_kitti_is_read(kitti: Path) -> None:
    image = read_image(kitti / "image_2" / "000000.png")
    assert camera_of(kitti / "image_2" / "000000.png", image).intrinsic[0].tolist() == [250, 0, 160]
    assert camera_of(kitti / "other" / "a.png", image).intrinsic[0, 0] == pytest.approx(0.79 * 320)


def test_a_killed_run_goes_on_and_workers_change_no_byte(tmp_path: Path) -> None:
    source, draws = tmp_path / "pictures", np.random.default_rng(1)
    for number in range(16):
        picture = draws.integers(0, 256, (360, 640, 3), dtype=np.uint8)
        save_picture(source / f"{number:02d}.{'png' if number % 2 else 'jpg'}", picture)
    words = ("shift", source, tmp_path / "out", "--shifts", "snow,gaussian", "--severity", "random", "--workers", "2")
    program = f"stop_at = 5\n{STOPS}\nfrom ssad.cli import main\nmain()"
    run = subprocess.Popen([sys.executable, "-c", program, *words], stdout=subprocess.DEVNULL)
    wait_until_stopped(run)
    assert kill_9(run)
    lines = tmp_path / "out" / "results.jsonl"
    kept = [json.loads(line)["key"] for line in lines.read_text().splitlines()]
    assert len(kept) == 5
    before = {key: (tmp_path / "out" / key).stat().st_ino for key in kept}
    (tmp_path / "out" / "snow-random" / ".06-1-6662ce8e.tmp.jpg").write_bytes(b"half a picture")  # as a kill leaves it
    assert ssad(*words).returncode == 0
    assert {key: (tmp_path / "out" / key).stat().st_ino for key in kept} == before
    assert ssad("shift", source, tmp_path / "one", *words[3:-1], "1").returncode == 0
    for root in ("snow-random", "gaussian-random"):
        found, alone = (
            {path.name: path.read_bytes() for path in (tmp_path / out / root).iterdir()} for out in ("out", "one")
        )
        assert found == alone
        assert len(found) == 18
