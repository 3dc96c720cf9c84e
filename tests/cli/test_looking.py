"""`ssad detect`, `ssad show`, `--print-config`, `--dry-run`, arguments and labels, and output that ends early."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.command import ssad
from helpers.run_folder import driving_lines, write_run
from PIL import Image

from ssad.core.detections import Detections, Solids
from ssad.core.errors import ConfigError
from ssad.core.images import read_image, save_picture
from ssad.core.nuscenes_names import MMDET3D_CLASSES
from ssad.core.registry import Reference, label_of, split_weights

MINE = """
import numpy as np

class Mine:
    def __init__(self, *, checkpoint="", gain=1.0): self.gain = gain
    def reset(self, episodes): ...
    def act(self, view): return np.zeros((len(view.speed), 3), np.float32)

class Finder:
    name, task, classes = "finder", "2d", ("car",)
    def __init__(self, *, side=20.0): self.side = side
    def predict(self, images, intrinsic=None, *, threshold=None):
        import torch
        from ssad.core.detections import Detections
        box = torch.tensor([[10.0, 10.0, 10.0 + self.side, 10.0 + self.side]])
        return [Detections(torch.tensor([0.5]), torch.tensor([0]), box)] * len(images)
"""


@pytest.fixture
def mine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with systems and a detector of the user's, in a module of its own name."""
    name = f"mine_{abs(hash(str(tmp_path)))}"
    (tmp_path / f"{name}.py").write_text(MINE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path / name


def test_a_reference_has_a_name_arguments_and_a_label() -> None:
    found = Reference.parse("mine:Mine?checkpoint=runs/a.pt&reach=20&gain=1e-3&loud=true@first")
    assert found.name == "mine:Mine"
    assert found.options == {"checkpoint": "runs/a.pt", "reach": 20, "gain": 1e-3, "loud": True}
    assert found.label == "first"
    assert Reference.parse("ppo:/home/a@b/x.safetensors").name == "ppo:/home/a@b/x.safetensors"
    assert label_of("blind") == "blind"
    assert split_weights("fcos3d@a=file=1.pth") == ("fcos3d@a", "file=1.pth")
    assert split_weights("mine:make?checkpoint=a.pt") == ("mine:make?checkpoint=a.pt", "")
    for wrong in ("mine:Mine?checkpoint", "mine:Mine?a=1&a=2", "mine:Mine@", "mine:Mine?1=2"):
        with pytest.raises(ConfigError, match="expected"):
            Reference.parse(wrong)


def test_arguments_make_another_system_and_the_content_of_their_files_counts(mine: Path) -> None:
    from ssad.drivers import make_system
    from ssad.simulators.closed_loop import system_version

    assert make_system(f"{mine.name}:Mine?gain=3@third").name == "third"
    with pytest.raises(ConfigError, match="unexpected keyword argument 'gian'"):
        make_system(f"{mine.name}:Mine?gian=3")
    (mine.parent / "a.pt").write_text("one")
    name = f"{mine.name}:Mine?checkpoint=a.pt"
    before = system_version(name)
    (mine.parent / "a.pt").write_text("two")
    assert system_version(name) != before


def test_print_config_is_a_suite_that_says_the_same(tmp_path: Path) -> None:
    first = ssad("run", "precrash", "--set", "repetitions=2", "--print-config")
    (tmp_path / "again.yaml").write_text(first.stdout)
    assert "repetitions: 2" in first.stdout
    assert ssad("run", tmp_path / "again.yaml", "--print-config").stdout == first.stdout


def test_a_dry_run_counts_cells_by_label_and_takes_rates_from_runs_beside_it(mine: Path) -> None:
    systems = f"systems=[{mine.name}:Mine?gain=1@one,{mine.name}:Mine?gain=2@two]"
    words = ("run", "precrash", "--set", systems, "--set", "scenarios=[RightTurn]", "--dry-run")
    done = ssad(*words)
    assert "cells: 8, of which 0 are there already and 8 would run" in done.stdout
    assert "  one: 4\n  two: 4\n" in done.stdout
    assert "time: unknown" in done.stdout
    assert "disk: unknown" in done.stdout
    assert "cells: 4, of which 0" in ssad(*words, "--only", "system=two").stdout
    lines = [line | {"wall_s": 30.0} for line in driving_lines()]
    header = {"suite": {"name": "s"}, "kind": "driving", "versions": {"device": "cpu"}}
    write_run(mine.parent / "runs" / "old", header, lines)
    told = ssad(*words, "--device", "cpu", "--workers", "2").stdout
    assert "time: about 2 min with 2 workers (4 min of work), from earlier runs (old)" in told
    assert "no such cell was measured for one, two: as the mean of the others" in told
    assert sorted(os.listdir("runs")) == ["old"], "a dry run writes nothing"


def test_two_systems_of_one_name_need_labels(mine: Path) -> None:
    twice = ssad("run", "precrash", "--set", f"systems=[{mine.name}:Mine@a,{mine.name}:Mine?gain=2@a]", "--dry-run")
    assert twice.returncode == 2
    assert "tell two of a name apart by a label" in twice.stderr


def test_detect_draws_boxes_and_lists_them(mine: Path) -> None:
    street = np.full((120, 200, 3), 90, np.uint8)
    save_picture(Path("street.png"), street)
    done = ssad("detect", "street.png", "out", "--detector", f"{mine.name}:Finder?side=40", "--device", "cpu")
    assert done.stdout == "out/street.jpg: 1 box\nboxes: out/detections.json\n"
    assert json.loads(Path("out/detections.json").read_text()) == {
        "street.png": [{"box": [10.0, 10.0, 50.0, 50.0], "class": "car", "score": 0.5}]
    }
    changed = np.abs(read_image("out/street.jpg").astype(int) - 90).max(-1) > 60
    assert changed[48:53, 20:45].any(0).all(), "the lower edge of the box"
    assert not changed[60:, 60:].any()
    wrong = ssad("detect", "street.png", "out", "--split", "val")
    assert (wrong.returncode, wrong.stderr) == (2, "error: --split cannot be used with pictures\n")
    assert "no such file" in ssad("detect", "nowhere.png", "out").stderr


@pytest.fixture
def photographs(tmp_path: Path) -> Path:
    """Pictures of several formats, one turned by its EXIF and one broken, and a point cloud."""
    root, street = tmp_path / "photographs", np.full((120, 200, 3), 90, np.uint8)
    street[:60, :100] = (250, 60, 60)
    (root / "more").mkdir(parents=True)
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(street).save(root / "turned.jpg", exif=exif)
    Image.fromarray(street).convert("L").save(root / "grey.png")
    Image.fromarray(street).save(root / "more" / "same.bmp")
    Image.fromarray(street).save(root / "more" / "same.tif")
    (root / "broken.png").write_bytes(b"nothing")
    (root / "outside.png").symlink_to("/etc/hostname")
    (root / "scan.pcd").write_text(
        "# .PCD\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 2\nHEIGHT 1\nDATA ascii\n9 9 0\n-9 -9 0\n"
    )
    (root / "notes.txt").write_text("nothing to see")
    return root


def test_detect_takes_a_folder_of_photographs_upright_and_whole(mine: Path, photographs: Path) -> None:
    done = ssad("detect", photographs, "out", "--detector", f"{mine.name}:Finder?side=40", "--device", "cpu")
    assert done.returncode == 1
    assert "out/turned.jpg: 1 box; turned upright (EXIF orientation 6)\n" in done.stdout
    assert "out/grey.jpg: 1 box; greyscale repeated to three channels\n" in done.stdout
    assert "not read: broken.png: not a JPEG, PNG" in done.stdout
    assert "not read: outside.png: a symbolic link that leads out of" in done.stdout
    rows = json.loads(Path("out/detections.json").read_text())
    assert sorted(rows) == ["grey.png", "more/same.bmp", "more/same.tif", "turned.jpg"]
    assert sorted(path.relative_to("out").as_posix() for path in Path("out").rglob("*.jpg")) == [
        "grey.jpg",
        "more/same.bmp.jpg",
        "more/same.tif.jpg",
        "turned.jpg",
    ]
    upright = read_image("out/turned.jpg")
    assert upright.shape == (200, 120, 3)
    assert upright[:80, 70:, 0].mean() > 200, "the red corner is at the top right"
    (photographs / "broken.png").unlink()
    (photographs / "outside.png").unlink()
    assert ssad("detect", photographs, "two", "--detector", f"{mine.name}:Finder", "--device", "cpu").returncode == 0


def test_show_takes_photographs_upright_and_whole(photographs: Path, tmp_path: Path) -> None:
    done = ssad("show", photographs, tmp_path / "page")
    assert done.returncode == 1
    first_line = f"page: {tmp_path / 'page' / 'index.html'} (5 of 7 pictures and point clouds)"
    assert " ".join(done.stdout.split()).startswith(first_line)
    assert "not read: broken.png: not a JPEG, PNG" in done.stdout
    report = " ".join((tmp_path / "page" / "index.import.txt").read_text().split())
    assert "not carried over: files that are neither pictures nor point clouds: .txt: notes.txt" in report
    assert "doubtful: not read: a symbolic link that leads out of" in report
    page = (tmp_path / "page" / "index.html").read_text()
    for text in (
        "turned.jpg: 120 x 200; turned upright (EXIF orientation 6)",
        "scan.pcd: 2 points",
        "broken.png: not a",
    ):
        assert text in page
    assert "notes.txt" not in page
    images = [read_image(tmp_path / "page" / name) for name in re.findall(r'src="(pictures/[^"]+)"', page)]
    assert len(images) == 5
    (upright,) = [image for image in images if image.shape[0] > image.shape[1]]
    assert upright[:400, 400:, 0].mean() > 200
    (above,) = [image for image in images if image.shape[0] == image.shape[1]]
    assert above[:300, :300].max() > 80, "a point ahead and to the left"
    assert above[350:, 350:].max() > 80, "a point behind and to the right"
    assert above[:300, 350:].max() < 60
    alone = ssad("show", photographs / "turned.jpg", tmp_path / "alone")
    assert (alone.returncode, "1 of 1 pictures" in alone.stdout) == (0, True)
    assert "--scenes is for a nuScenes folder" in ssad("show", photographs, tmp_path / "x", "--scenes", "a").stderr


@pytest.mark.data
def test_real_photographs_pass_through_every_command_upright_and_whole(mine: Path, data_dir: Path) -> None:
    source = data_dir / "real"
    if not source.is_dir():
        pytest.skip("SSAD_DATA has no photographs (real/)")
    originals = {path.stem: read_image(path) for path in sorted(source.iterdir()) if path.suffix in (".jpg", ".png")}
    assert len(originals) == 8
    detected = ssad("detect", source, "found", "--detector", f"{mine.name}:Finder", "--device", "cpu")
    assert detected.stdout.count(": 1 box\n") == 8
    shifted = ssad("shift", source, "shifted", "--shifts", "overexposure", "--severity", "1", "--workers", "1")
    assert "8 pictures shifted, 3 other files linked unchanged" in shifted.stdout
    assert "(8 of 8 pictures" in ssad("show", source, "page").stdout
    page = re.findall(r'src="([^"]+)".*?<figcaption>(\w+)\.', Path("page/index.html").read_text())
    shown = {stem: Path("page") / name for name, stem in page}
    for stem, original in originals.items():
        expected = _thumbnail(original)
        for path in (Path(f"found/{stem}.jpg"), next(Path("shifted/overexposure-1").glob(f"{stem}.*")), shown[stem]):
            image = read_image(path)
            if path != shown[stem]:  # a page has smaller copies
                assert image.shape == original.shape, path
            thumbnail = _thumbnail(image)
            assert np.corrcoef(expected, thumbnail)[0, 1] > 0.97, path
            assert np.corrcoef(expected, thumbnail[::-1])[0, 1] < 0.9, f"{path} would pass upside down"


def _thumbnail(image: np.ndarray) -> np.ndarray:
    return np.asarray(Image.fromarray(image).convert("L").resize((32, 18), Image.Resampling.BOX), float).ravel()


class Ahead:
    """Finds a parked car 10 m in front of each camera."""

    name, task, classes = "ahead", "3d", MMDET3D_CLASSES

    def predict(
        self, images: torch.Tensor, intrinsic: torch.Tensor | None = None, *, threshold: float | None = None
    ) -> list[Detections]:
        place, size = torch.tensor([[0.0, 1.0, 10.0]]), torch.tensor([[4.0, 1.5, 1.8]])
        solid = Solids(place, size, torch.zeros(1), torch.zeros(1, 2), torch.tensor([0]))
        label = torch.tensor([self.classes.index("car")])
        return [Detections(torch.tensor([0.5]), label, torch.zeros(1, 4), solid)] * len(images)


def test_the_results_of_a_data_set_hold_what_was_found_at_its_place(tiny_set: Path, tmp_path: Path) -> None:
    from ssad.datasets.nuscenes.reader import NuScenes
    from ssad.datasets.nuscenes.results import read_results
    from ssad.detectors.detect import detect_dataset

    with NuScenes(tiny_set) as data:
        path, _, boxes = detect_dataset(Ahead(), data, tmp_path)  # type: ignore[arg-type]
        scene = data.scene(data.scenes()[0].name)
    found = read_results(path).boxes
    front = next(f for f in scene.frames if f.channel == "CAM_FRONT" and f.key_frame)
    there = front.ego_to_world @ front.sensor_to_ego @ np.array([0.0, 1.0, 10.0, 1.0])
    assert boxes == len(found.label) > 0
    assert np.abs(found.centre - there[:3]).sum(1).min() < 0.1


@pytest.mark.slow
def test_detect_on_a_data_set_writes_what_score_reads(tiny_set: Path, tmp_path: Path) -> None:
    from ssad.datasets.nuscenes.reader import NuScenes
    from ssad.datasets.nuscenes.results import read_results
    from ssad.detectors import make_detector
    from ssad.detectors.detect import detect_dataset

    with NuScenes(tiny_set) as data:
        path, samples, boxes = detect_dataset(make_detector("fcos3d-light"), data, tmp_path)
        tokens = [sample.token for scene in data.scenes() for sample in data.scene(scene.name).samples]
    found = read_results(path, tokens)
    assert (samples, boxes) == (len(tokens), len(found.boxes.label))
    assert found.meta["ssad_manifest"] == "clean"
    flat = ssad("detect", tiny_set, tmp_path / "flat", "--detector", "yolov5n")
    assert flat.returncode == 2
    assert "take a 3D detector such as fcos3d-light" in flat.stderr


def test_show_has_every_camera_and_the_lidar_of_each_moment(tiny_set: Path, tmp_path: Path) -> None:
    done = ssad("show", tiny_set, tmp_path / "page", "--samples", "1")
    assert done.returncode == 0, done.stderr
    assert "nuScenes schema" in (tmp_path / "page" / "index.import.txt").read_text()
    page = (tmp_path / "page" / "index.html").read_text()
    named = re.findall(r'src="(pictures/[^"]+)"', page)
    assert len(named) == len(set(named)) == 2 * (page.count("<figcaption>CAM_") // 2 + 1)
    assert all((tmp_path / "page" / name).is_file() for name in named)
    above = read_image(next((tmp_path / "page").glob("pictures/*above.jpg")))
    assert above.std() > 5, "points and boxes are drawn"
    assert "no scene 'x'" in ssad("show", tiny_set, tmp_path / "other", "--scenes", "x").stderr
    assert not (tmp_path / "other").exists()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_a_full_disk_and_a_reader_who_leaves_cost_no_traceback() -> None:
    listing = [sys.executable, "-m", "ssad", "list", "shifts"]
    with open("/dev/full", "w") as full:
        done = subprocess.run(listing, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stderr) == (2, "error: standard output: No space left on device\n")
    read, write = os.pipe()
    os.close(read)
    with open(write, "w") as gone:
        done = subprocess.run(listing, stdout=gone, stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stderr) == (141, "")
