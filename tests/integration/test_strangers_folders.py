"""Folders of strangers: their files change nothing outside, and wrong paths are found before heavy packages load."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from helpers.command import ssad
from helpers.run_folder import DRIVING_HEADER, driving_line, reseal, write_run

from ssad.core.errors import StoreError
from ssad.core.image_files import encode_jpeg
from ssad.engine.store import Store
from ssad.experiments.runs import write_report
from ssad.recorders.shifted.image_folder import shift_pictures
from ssad.report.load import load_run
from ssad.report.tables import Table, write_tables
from ssad.results import load_results


@pytest.fixture
def victim(tmp_path: Path) -> Iterator[Path]:
    """A folder of the user, which must stay as it is."""
    (tmp_path / "victim").mkdir()
    (tmp_path / "victim" / "f").write_text("mine\n")
    yield tmp_path / "victim"
    assert [(path.name, path.read_text()) for path in (tmp_path / "victim").iterdir()] == [("f", "mine\n")]


def make_run(folder: Path) -> Path:
    return write_run(folder, DRIVING_HEADER, [driving_line("a1", "RightTurn", "RightTurn/00")])


@pytest.mark.parametrize("name", ["episodes.jsonl", "results.jsonl", "seal.json", ".lock"])
def test_a_run_is_not_continued_through_links(tmp_path: Path, victim: Path, name: str) -> None:
    header = {"identity": "a", "suite": {"name": "s"}}
    Store.open(tmp_path / "run", header).close()
    (tmp_path / "run" / name).unlink()
    (tmp_path / "run" / name).symlink_to(victim / "f")
    with pytest.raises(StoreError, match=f"{name}: leads out of"):
        Store.open(tmp_path / "run", header)


@pytest.mark.parametrize("name", ["tables", "pictures", "report.html", "results.jsonl"])
def test_no_report_is_made_of_a_folder_that_leads_out(tmp_path: Path, victim: Path, name: str) -> None:
    run = make_run(tmp_path / "run")
    (run / name).unlink(missing_ok=True)
    (run / name).symlink_to(victim if "." not in name else victim / "f")
    with pytest.raises(StoreError, match=f"{name}: leads out of"):
        write_report(run)


def test_replays_are_not_written_through_a_link(tmp_path: Path, victim: Path) -> None:
    run = make_run(tmp_path / "run")
    (run / "replays").symlink_to(victim)
    header = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps(header | {"identity": "a"}))
    done = ssad("replay", str(run), "a1")
    assert done.returncode == 2
    assert "replays: leads out of" in done.stderr


@pytest.mark.parametrize("path", ["../victim/f", "/etc/hostname", "traces/../../victim/f"])
def test_a_trace_outside_of_the_folder_is_not_opened(tmp_path: Path, victim: Path, path: str) -> None:
    line = driving_line("a1", "RightTurn", "RightTurn/00") | {"artefacts": {"trace": path}}
    run = write_run(tmp_path / "run", DRIVING_HEADER, [line])
    with pytest.raises(StoreError, match="is no path below this folder"):
        load_results(run).trace("a1")


def test_out_takes_no_folder_of_something_else(victim: Path) -> None:
    for words in (
        ("run", "precrash", "--out"),
        ("train", "driver", "ppo", "--out"),
        ("train", "adversary", "--out"),
        ("record",),
        ("export", "RightTurn/00", "--format", "openscenario"),
    ):
        done = ssad(*words, str(victim))
        assert (done.returncode, done.stdout) == (2, ""), words
        assert "victim: holds something else; choose a new or empty folder" in done.stderr


def test_a_header_of_another_shape_is_one_line(tmp_path: Path) -> None:
    for key, value in (("cells", [{"name": "a"}]), ("cells", 3), ("suite", []), ("columns", [1]), ("factors", [{}])):
        run = make_run(tmp_path / f"{key}-{value}".replace("/", ""))
        (run / "run.json").write_text(json.dumps(json.loads((run / "run.json").read_text()) | {key: value}))
        with pytest.raises(StoreError, match=rf"run\.json: not written by ssad run: {key}"):
            load_run(run)


def test_records_that_are_not_those_of_the_kind_are_one_line(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    line = json.loads((run / "results.jsonl").read_text())
    del line["cluster"], line["spec"], line["seal"]
    (run / "results.jsonl").write_text(json.dumps(line | {"system": ["a"]}) + "\n")
    reseal(run)
    with pytest.raises(StoreError, match="its records are not those of kind driving: "):
        write_report(run)


NO_HEAVY_PACKAGE = """
import sys
from ssad.cli import main
for words in {commands!r}:
    sys.argv = ["ssad", *words.split()]
    try:
        main()
    except SystemExit as error:
        assert error.code == 2, words
    loaded = [name for name in ("torch", "warp", "cv2", "matplotlib") if name in sys.modules]
    assert not loaded, (words, loaded)
"""


def test_wrong_paths_are_found_before_heavy_packages_load(tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    commands = (
        "run precrash --out full",
        "run none.yaml",
        "run digital-quick --set scenarios=none.yaml",
        "run precrash --set systems=[ppo:none.safetensors]",
        "plan precrash --detect 0.1 --runs none",
        "report none",
        "compare none none",
        "replay none x",
        "shift none out",
        "show none out",
        "detect none.jpg out",
        "score none.json --dataroot none --version v1.0-mini --split val",
        "record full",
        "train detector fcos3d-light --data none",
        "train driver ppo --out full",
        "train adversary adv-ppo --out full",
        "export texture none x out",
        "export light none x out",
        "export RightTurn/00 full --format openscenario",
        "import map none.xodr",
        "import routes none",
        "import openscenario none.xosc out.yaml",
        "import leaderboard none.xml out.yaml",
        "import commonroad none.xml out.yaml",
        "import drive none out.yaml --scene a",
    )
    script = NO_HEAVY_PACKAGE.format(commands=commands)
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("\n") == len(commands), "one line each"


@pytest.mark.parametrize("place", ["fog-3", "fog-3/sub"])
def test_pictures_are_not_shifted_through_a_link(tmp_path: Path, victim: Path, place: str) -> None:
    (tmp_path / "data" / "sub").mkdir(parents=True)
    pixels = np.full((24, 32, 3), 120, np.uint8)
    (tmp_path / "data" / "sub" / "f").write_bytes(encode_jpeg(pixels))
    (tmp_path / "data" / "sub" / "a.jpg").write_bytes(encode_jpeg(pixels))
    settings = {"seed": 0, "calibration": "physical", "quality": 95, "subsampling": "auto", "lidar": True}
    options = {"shifts": ["fog"], "severities": [3], "settings": settings, "workers": 0}
    shift_pictures(tmp_path / "data", tmp_path / "out", **options)
    shutil.rmtree(tmp_path / "out" / place)
    (tmp_path / "out" / place).symlink_to(victim)
    with pytest.raises(StoreError, match=f"{place}: is a symbolic link"):
        shift_pictures(tmp_path / "data", tmp_path / "out", **options)


def test_parts_of_a_tour_and_tables_have_no_place_outside(tmp_path: Path) -> None:
    victim = make_run(tmp_path / "victim")
    before = sorted(path.name for path in victim.iterdir())
    line = {"key": "a1", "status": "ok", "reason": "", "metrics": {}, "part": "a", "n": 1}
    header = {"kind": "tour", "suite": {"name": "s", "kind": "tour", "parts": [{"name": "../victim"}]}}
    run = write_run(tmp_path / "run", header, [line])
    with pytest.raises(StoreError, match="is no path below this folder"):
        write_report(run)
    assert sorted(path.name for path in victim.iterdir()) == before
    table = Table("../../victim/run", "T", (), (), ())
    with pytest.raises(StoreError, match="is no path below this folder"):
        write_tables(tmp_path / "run", [table])
