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
from PIL import Image

from ssad.core.errors import StoreError
from ssad.core.images import read_annotated_image, read_image, save_picture
from ssad.datasets.coco import read_coco
from ssad.datasets.point_files import read_point_file
from ssad.recorders.shifted.image_folder import ShiftedFolder, camera_of, shift_pictures
from ssad.recorders.shifted.options import Strength


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
    assert "1 picture shifted" in done.stdout
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


def shift(source: Path, out: Path, *shifts: str, severity: Strength = 3, lidar: bool = True) -> list[ShiftedFolder]:
    """Shift in this process, which is quicker."""
    settings = {"seed": 0, "calibration": "physical", "quality": 95, "subsampling": "auto", "lidar": lidar}
    return shift_pictures(source, out, shifts=shifts, severities=[severity], settings=settings, workers=0)


def stored(image: Image.Image, path: Path, **options: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    image.save(path, **options)


def street(mode: str = "RGB") -> Image.Image:
    across, down = np.meshgrid(np.arange(200), np.arange(120))
    return Image.fromarray(np.stack([across, down * 2, 200 - down], -1).astype(np.uint8)).convert(mode)


def orientation(number: int) -> Image.Exif:
    exif = Image.Exif()
    exif[0x0112] = number
    return exif


def difference(clean: Path, shifted: Path) -> float:
    before, after = read_image(clean).astype(int), read_image(shifted)
    assert before.shape == after.shape
    return float(np.abs(before - after).mean())


def test_every_format_is_shifted_and_what_cannot_be_is_named_and_left_out(tmp_path: Path) -> None:
    """Three of the names are those of the cases shift-exif, shift-grey and shift-other-formats."""
    source, root = tmp_path / "pictures", tmp_path / "out" / "fog-3"
    stored(street(), source / "rot6.jpg", exif=orientation(6))
    stored(street("L"), source / "g.jpg")
    stored(street(), source / "prog.jpg", progressive=True)
    for name in ("a.bmp", "a.tif", "a.webp", "a.ppm"):
        stored(street(), source / name)
    stored(street("CMYK"), source / "inks.jpg")
    stored(street("RGBA"), source / "clear.png")
    (source / "no-suffix").write_bytes((source / "prog.jpg").read_bytes())
    good = sorted(path.name for path in source.iterdir())
    stored(street(), source / "moving.gif")
    stored(street(), source / "pages.tiff", save_all=True, append_images=[street()])
    (source / "half.webp").write_bytes((source / "a.webp").read_bytes()[:200])
    (source / "film.mp4").write_bytes(b"\0\0\0\x18ftypmp42" + bytes(200))
    (source / "boxes.json").write_text("{}")
    words = ("shift", source, tmp_path / "out", "--shifts", "fog", "--severity", "3", "--workers", "1")
    for _ in range(2):
        done = ssad(*words)
        assert done.returncode == 1
        assert f"{root}: 10 pictures shifted, 1 other file linked unchanged, 100 % of the pictures" in done.stdout
        for name, reason in {
            "moving.gif": "not a JPEG, PNG, TIFF, BMP, WebP or PNM image",
            "pages.tiff": "it has 2 frames or pages",
            "half.webp": "",
            "film.mp4": "not a JPEG",
        }.items():
            assert f"  {name}: {reason}" in done.stdout
            assert not (root / name).exists()
    assert sorted(path.name for path in root.iterdir()) == sorted(
        [*good, "boxes.json", "manifest.json", "manifest.jsonl"]
    )
    for name in good:
        assert not (root / name).is_symlink()
        assert difference(source / name, root / name) > 4, name
        with Image.open(source / name) as clean, Image.open(root / name) as shifted:
            assert (shifted.format, shifted.mode, shifted.size) == (clean.format, clean.mode, clean.size)
            assert shifted.getexif().get(0x0112) == clean.getexif().get(0x0112)
    lines = {line["key"]: line for line in map(json.loads, (root / "manifest.jsonl").read_text().splitlines())}
    assert lines["rot6.jpg"]["notes"] == ["shifted upright, stored with EXIF orientation 6"]
    assert lines["film.mp4"]["status"] == "failed"


def test_fog_stands_over_an_upright_road_whatever_the_orientation(tmp_path: Path) -> None:
    source = tmp_path / "pictures"
    upright = Image.new("RGB", (120, 200), (200, 200, 200))
    upright.paste((40, 40, 40), (0, 100, 120, 200))
    stored(upright, source / "1.png")
    stored(upright.transpose(Image.Transpose.ROTATE_90), source / "6.png", exif=orientation(6))
    assert shift(source, tmp_path / "out", "fog")[0].reasons == ()
    for name in ("1.png", "6.png"):
        image = read_image(tmp_path / "out" / "fog-3" / name)
        assert image.shape == (200, 120, 3)
        assert image[105:125].mean() > image[-20:].mean() + 10, f"{name}: the far road above, the near below"


def test_links_to_allowed_folders_are_shifted_as_if_they_were_here(
    kitti: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    outside = tmp_path / "elsewhere"
    stored(street(), outside / "a" / "x.png")
    (outside / "a" / "up").symlink_to("..")
    (kitti / "image_3").symlink_to(outside / "a")
    (kitti / "image_2" / "x.png").symlink_to(outside / "a" / "x.png")
    monkeypatch.setenv("SSAD_DATA_LINKS", str(outside))
    (folder,) = shift(kitti, tmp_path / "out", "uniform")
    assert folder.reasons == ("image_3/up/a/up: a symbolic link to a folder that is listed already",)
    for name in ("image_3/x.png", "image_2/x.png"):
        path = tmp_path / "out" / "uniform-3" / name
        assert not path.is_symlink()
        assert difference(kitti / name, path) > 4


def test_links_inside_are_repeated_and_links_outside_are_refused(kitti: Path, tmp_path: Path) -> None:
    (kitti / "image_2" / "alias.png").symlink_to("000000.png")
    (kitti / "left").symlink_to("image_2")
    (kitti / "image_2" / "again").symlink_to("..")
    (kitti / "labels.txt").symlink_to(kitti / "label_2" / "000000.txt")
    (kitti / "nowhere.png").symlink_to("nothing.png")
    outside = tmp_path / "elsewhere"
    stored(street(), outside / "x.png")
    (kitti / "image_3").symlink_to(outside)
    (kitti / "image_2" / "x.png").symlink_to(outside / "x.png")
    (folder,) = shift(kitti, tmp_path / "out", "uniform")
    root = tmp_path / "out" / "uniform-3"
    assert (folder.shifted, folder.linked) == (2, 3)
    remedy = (
        f"a symbolic link that leads out of {kitti}; copy that here, or allow such links with SSAD_DATA_LINKS={outside}"
    )
    assert folder.reasons == (
        f"image_2/x.png: {remedy}",
        f"image_3: {remedy}",
        "nowhere.png: a symbolic link that leads nowhere; remove it",
    )
    for name in ("image_3", "image_2/x.png", "nowhere.png"):
        assert not (root / name).is_symlink()
    for name in ("image_2/alias.png", "left/000000.png"):
        assert difference(kitti / name, root / name) > 4, name
        assert (root / name).resolve() == root / "image_2" / "000000.png"
    assert (root / "labels.txt").read_text() == (kitti / "labels.txt").read_text()
    assert (root / "image_2" / "again").resolve() == root
    for path in root.rglob("*.png"):
        assert path.resolve().is_relative_to(root), "no picture of the shifted folder is one of the clean folder"


def test_a_link_to_a_picture_that_fails_fails_too(kitti: Path, tmp_path: Path) -> None:
    (kitti / "image_2" / "000001.png").write_bytes(b"nothing")
    (kitti / "alias.png").symlink_to("image_2/000001.png")
    (folder,) = shift(kitti, tmp_path / "out", "uniform", severity=1)
    assert len(folder.reasons) == 2
    assert folder.reasons[1] == "alias.png: a symbolic link to image_2/000001.png, which was not shifted"
    assert not (tmp_path / "out" / "uniform-1" / "alias.png").is_symlink()


def test_nothing_of_an_earlier_run_passes_for_a_shifted_picture(kitti: Path, tmp_path: Path) -> None:
    root = tmp_path / "out" / "uniform-1"
    assert shift(kitti, tmp_path / "out", "uniform", severity=1)[0].reasons == ()
    for name in ("000000.png", "000001.png"):
        (root / "image_2" / name).unlink()
        (root / "image_2" / name).symlink_to(kitti / "image_2" / name)
    (kitti / "image_2" / "000001.png").write_bytes(b"nothing")
    (folder,) = shift(kitti, tmp_path / "out", "uniform", severity=1)
    assert [reason.split(":")[0] for reason in folder.reasons] == ["image_2/000001.png"]
    assert not (root / "image_2" / "000000.png").is_symlink()
    assert not (root / "image_2" / "000001.png").is_symlink()
    assert not (root / "image_2" / "000001.png").exists()
    (root / "label_2" / "000000.txt").unlink()
    (root / "label_2").rmdir()
    (root / "label_2").symlink_to(kitti / "label_2")
    with pytest.raises(StoreError, match="leads into the dataset"):
        shift(kitti, tmp_path / "out", "uniform", severity=1)


def test_images_in_folders_of_labels_stay_labels(kitti: Path, tmp_path: Path) -> None:
    depth = np.arange(96 * 320, dtype=np.uint16).reshape(96, 320)
    for folder in ("disp_occ_0", "semantic", "annotations/panoptic_val2017"):
        stored(Image.fromarray(depth), kitti / folder / "000000.png")
    stored(Image.fromarray(depth % 4096), kitti / "image_0" / "000000.png")
    (folder,) = shift(kitti, tmp_path / "out", "uniform", severity=1)
    assert (folder.shifted, folder.linked, folder.labels) == (2, 6, 3)
    assert len(folder.reasons) == 1
    assert folder.reasons[0].startswith("image_0/000000.png: 16 bits a channel, but no value above 4095")
    label = tmp_path / "out" / "uniform-1" / "semantic" / "000000.png"
    assert label.read_bytes() == (kitti / "semantic" / "000000.png").read_bytes()


def test_boxes_of_coco_still_fit_the_stored_pixels(tmp_path: Path) -> None:
    """A white square lies where its box says, in the pixels that the JSON and COCO's tools mean."""
    source = tmp_path / "coco"
    image = np.full((120, 200, 3), 30, np.uint8)
    image[20:40, 150:190] = 250
    stored(Image.fromarray(image), source / "val2017" / "1.png", exif=orientation(6))
    annotation = {"id": 1, "image_id": 1, "category_id": 1, "bbox": [150, 20, 40, 20], "area": 800, "iscrowd": 0}
    rows = {"images": [{"id": 1, "file_name": "1.png", "width": 200, "height": 120}], "annotations": [annotation]}
    (source / "annotations").mkdir()
    (source / "annotations" / "val.json").write_text(json.dumps(rows | {"categories": [{"id": 1, "name": "car"}]}))
    shift(source, tmp_path / "out", "gaussian", severity=1)
    root = tmp_path / "out" / "gaussian-1"
    (row,) = read_coco(root / "annotations" / "val.json", images=root / "val2017").images
    pixels = read_annotated_image(row.file, width=row.width, height=row.height)
    x1, y1, x2, y2 = row.box[0].astype(int)
    inside = pixels[y1:y2, x1:x2].mean()
    assert inside > 200
    assert (pixels.sum() - pixels[y1:y2, x1:x2].sum()) / (pixels.size - 3 * 800) < 60


def test_point_clouds_are_shifted_too_in_their_own_format(kitti: Path, tmp_path: Path) -> None:
    draws = np.random.default_rng(2)
    points = np.column_stack([draws.uniform(-60, 60, (400, 2)), draws.uniform(-2, 2, 400), draws.uniform(0, 1, 400)])
    (kitti / "velodyne").mkdir()
    (kitti / "velodyne" / "000000.bin").write_bytes(points.astype("<f4").tobytes())
    properties = "".join(f"property float {name}\n" for name in ("x", "y", "z", "intensity"))
    text = "".join(" ".join(f"{number:.3f}" for number in row) + "\n" for row in points)
    (kitti / "scan.ply").write_text(f"ply\nformat ascii 1.0\nelement vertex 400\n{properties}end_header\n{text}")
    (kitti / "velodyne" / "half.bin").write_bytes(bytes(19))
    for folder in shift(kitti, tmp_path / "out", "fog", "overexposure"):
        assert (folder.shifted, folder.clouds, folder.linked) == (2, 2, 3)
        assert folder.reasons == ("velodyne/half.bin: 19 bytes are no whole number of 16-byte points (cut short?)",)
    root = tmp_path / "out" / "fog-3"
    for name in ("velodyne/000000.bin", "scan.ply"):
        clean, foggy = (read_point_file(place / name, columns=4) for place in (kitti, root))
        assert not (root / name).is_symlink()
        assert foggy.columns == clean.columns
        assert len(foggy.points) < len(clean.points), "some beams do not return"
        assert 0 < foggy.points[:, 3].mean() < 0.8 * clean.points[:, 3].mean(), "and the others are faint"
    same = tmp_path / "out" / "overexposure-3" / "velodyne" / "000000.bin"
    assert same.resolve() == kitti / "velodyne" / "000000.bin", "a camera's exposure changes no LiDAR"
    (cameras,) = shift(kitti, tmp_path / "cameras", "fog", lidar=False)
    assert (cameras.reasons, cameras.clouds, cameras.linked) == ((), 0, 6)
    assert (tmp_path / "cameras" / "fog-3" / "scan.ply").resolve() == kitti / "scan.ply"


def test_a_random_severity_is_that_of_the_moment(kitti: Path, tmp_path: Path) -> None:
    """Both cameras and the LiDAR of KITTI are in the same weather."""
    for path in (*kitti.glob("image_2/*.png"), *kitti.glob("calib/*")):
        path.unlink()
    for number in range(6):
        for folder in ("image_2", "image_3"):
            stored(street(), kitti / folder / f"{number:06d}.jpg")
        (kitti / "velodyne").mkdir(exist_ok=True)
        (kitti / "velodyne" / f"{number:06d}.bin").write_bytes(np.ones((4, 4), "<f4").tobytes())
    assert shift(kitti, tmp_path / "out", "rain", severity="random")[0].reasons == ()
    by_moment: dict[str, set[int]] = {}
    for line in (tmp_path / "out" / "rain-random" / "manifest.jsonl").read_text().splitlines():
        record = json.loads(line)
        by_moment.setdefault(record["key"].split("/")[1].split(".")[0], set()).add(record["severity"])
    assert len(by_moment) == 6
    assert all(len(severities) == 1 for severities in by_moment.values())
    assert len(set.union(*by_moment.values())) > 1


def test_a_killed_run_goes_on_and_workers_change_no_byte(tmp_path: Path) -> None:
    source, draws = tmp_path / "pictures", np.random.default_rng(1)
    for number in range(16):
        picture = draws.integers(0, 256, (180, 320, 3), dtype=np.uint8)
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
