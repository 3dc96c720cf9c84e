"""The command line: names, exit codes, one-line errors, a light start."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from subprocess import CompletedProcess

import pytest
from helpers.command import ssad, ssad_process
from helpers.plugin import install

from ssad.cli import main
from ssad.core.version import __version__
from ssad.recorders import nuscenes, target_images
from ssad.recorders.nuscenes import Recording
from ssad.recorders.target_recording import TargetRecording
from ssad.rendering.camera.effects import DEFAULT_EFFECTS, NO_EFFECTS

COMMANDS = ("run", "plan", "report", "compare", "replay", "shift", "score", "record", "list", "import", "doctor")


def fails(done: CompletedProcess[str], *parts: str) -> None:
    """Exit code 2, one line that begins with error:, and nothing else."""
    lines = done.stderr.strip().splitlines()
    assert done.returncode == 2, done
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("error: ")
    for part in parts:
        assert part in lines[0]
    assert done.stdout == ""


def test_help_names_every_command() -> None:
    done = ssad_process("--help")
    assert done.returncode == 0
    assert all(f"\n  {name} " in done.stdout for name in COMMANDS)


def test_module_and_version() -> None:
    done = subprocess.run([sys.executable, "-m", "ssad", "--version"], check=True, capture_output=True, text=True)
    assert done.stdout == f"ssad {__version__}\n"


def test_nothing_heavy_is_imported_for_help() -> None:
    code = "import sys, ssad.cli; print([m for m in ('numpy', 'warp', 'pydantic', 'rich', 'cv2') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (("run", "quik"), ("unknown suite 'quik'", "closest: quick")),
        (("run", "nowhere.yaml"), ("nowhere.yaml: no such file",)),
        (("run", "quick", "--set", "sistems=x"), ("unknown key 'sistems'", "systems")),
        (("run", "quick", "--set", "systems=[autopilo]"), ("unknown system 'autopilo'", "autopilot")),
        (("run", "quick", "--set", "systems=[not_here:X]"), ("not_here", "looked in")),
        (("run", "quick", "--set", "scenarios=[safebanch]"), ("unknown scenario 'safebanch'", "precrash")),
        (("run", "quick", "--set", "scenarios=[safebench]"), ("ssad import routes",)),
        (("run", "quick", "--device", "tpu"), ("auto, cpu or cuda",)),
        (("report", "nowhere"), ("nowhere: not a results folder", "ssad run")),
        (("compare", "nowhere", "elsewhere"), ("nowhere: no such file or folder",)),
        (("replay", "nowhere", "x"), ("nowhere: not a results folder",)),
        (("list", "towms"), ("unknown list 'towms'", "towns")),
        (("import", "map", "nowhere.xodr"), ("nowhere.xodr",)),
        (("import", "map", os.devnull, "--name", "Twinford"), ("built-in town",)),
        (("import", "routes", "nowhere"), ("nowhere: no such folder",)),
        (("import", "routes", ".", "--name", "../x"), ("cannot name a set",)),
        (("import", "routes", ".", "--name", "precrash"), ("built-in set",)),
    ],
)
def test_bad_input_is_one_line_and_writes_nothing(
    arguments: tuple[str, ...], parts: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    home = tmp_path / "home"
    work = tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)
    monkeypatch.setenv("SSAD_HOME", str(home))
    fails(ssad(*arguments), *parts)
    assert os.listdir(work) == []
    assert not home.exists()


def test_a_terminal_shows_an_error_in_lines_of_its_width(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same words as in a pipe, where they are one line."""
    message = ssad("run", "quick", "--set", "sistems=x").stderr
    assert len(message) > 80
    monkeypatch.setattr(sys, "argv", ["ssad", "run", "quick", "--set", "sistems=x"])
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with pytest.raises(SystemExit):
        main()
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) > 1
    assert max(map(len, lines)) <= 80
    assert " ".join(line.strip() for line in lines) == message.strip()


def test_a_process_ends_with_the_same_line_and_code(tmp_path: Path) -> None:
    """What the tests above run in their own process, as a user runs it."""
    done = ssad_process("run", "quick", "--set", "systems=[not_here:X]", cwd=tmp_path)
    fails(done, "not_here", "looked in", str(tmp_path))
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    "arguments", [("run",), ("run", "quick", "--nope"), ("nope",), ("run", "quick", "--workers", "0")]
)
def test_usage_errors_have_exit_code_2(arguments: tuple[str, ...]) -> None:
    fails(ssad(*arguments), "--help")


SCENARIO = """
name: Mine/00
type: StraightObstacle
town: ProvingGround
route: [{x: 0, y: 0}, {x: 50, y: 0}]
"""


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        (("town: ProvingGround", "town: ProvingGrund"), ("unknown town 'ProvingGrund'", "ProvingGround")),
        (("name: Mine/00", "nam: Mine/00"), ("mine.yaml:2", "nam")),
        (("x: 0,", "x: zero,"), ("mine.yaml:5", "route")),
        (("{x: 50, y: 0}", "{x: 50000, y: 0}"), ("Mine/00",)),
        (("type: StraightObstacle", "type: StrightObstacle"), ("StraightObstacle",)),
        (("town: ProvingGround", "town: [*a, *a]"), ("mine.yaml", "not valid YAML")),
    ],
)
def test_a_bad_scenario_file_is_one_line(
    change: tuple[str, str], parts: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mine.yaml").write_text(SCENARIO.replace(*change))
    monkeypatch.chdir(tmp_path)
    fails(ssad("run", "quick", "--set", "scenarios=mine.yaml"), *parts)
    assert os.listdir(tmp_path) == ["mine.yaml"]


def test_unwritable_folder_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    setting = "scenarios=[StraightObstacle/00]"
    fails(ssad("run", "quick", "--set", setting, "--out", str(tmp_path / "file" / "run")), "cannot write")


def test_doctor() -> None:
    done = ssad("doctor")
    assert done.returncode == 0, done.stdout
    assert {"python", "warp", "carla", "SSAD_HOME", "towns"} <= {line.split()[1] for line in done.stdout.splitlines()}


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        ("suites", "quick"),
        ("systems", "blind"),
        ("kinds", "detection"),
        ("agents", "autopilot"),
        ("towns", "ProvingGround"),
        ("scenarios", "StraightObstacle/00"),
        ("scenarios", "natural"),
    ],
)
def test_list(kind: str, name: str) -> None:
    done = ssad("list", kind)
    assert done.returncode == 0
    assert name in [line.split()[0] for line in done.stdout.splitlines()]


def test_run_report_and_replay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A first run as a process of its own, with a driving system of an installed package; the rest in this one."""
    settings = ("--set", "scenarios=[StraightObstacle/00,RightTurn/01]", "--set", "name=little")
    settings += ("--set", "systems=[acme-coast,blind]", "--set", "pictures=[]")
    site = tmp_path / "site-packages"
    site.mkdir()
    path = os.pathsep.join(filter(None, [str(install(site)), os.environ.get("PYTHONPATH")]))
    first = ssad_process("run", "quick", *settings, "--workers", "1", cwd=tmp_path, PYTHONPATH=path)
    assert first.returncode == 0, first.stderr
    assert "Straight Obstacle" in first.stdout
    assert "report: runs/little/report.html" in first.stdout
    folder = tmp_path / "runs" / "little"
    results = (folder / "results.jsonl").read_bytes()
    rows = [json.loads(line) for line in results.splitlines()]
    assert sorted((row["system"], row["status"]) for row in rows) == [("acme-coast", "ok")] * 2 + [("blind", "ok")] * 2
    assert {p.suffix for p in (folder / "tables").iterdir()} == {".csv", ".md", ".tex"}

    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(site)
    again = ssad("run", "quick", *settings)
    assert again.returncode == 0
    assert again.stdout == first.stdout
    assert (folder / "results.jsonl").read_bytes() == results
    fails(ssad("run", "quick", *settings, "--set", "seed=5"), "differs in seed", "--out")

    page = (folder / "report.html").read_bytes()
    (folder / "report.html").unlink()
    assert ssad("report", "runs/little").returncode == 0
    assert (folder / "report.html").read_bytes() == page

    replayed = ssad("replay", "runs/little", "blind/StraightObstacle/00")
    assert replayed.returncode == 0, replayed.stderr
    assert "identical" in replayed.stdout
    assert {p.suffix for p in (folder / "replays").iterdir()} == {".mp4", ".npz"}
    assert all(p.stat().st_size > 1000 for p in (folder / "replays").iterdir())
    fails(ssad("replay", "runs/little", "blind/StraightObstacle/01"), "closest: blind/Str")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--clips", "drive", "--scenes", "3"], "--scenes cannot be used with --clips"),
        (["--clips", "orbit", "--width", "640"], "--width cannot be used with --clips"),
        (["--images", "5"], "--images can only be used with --clips"),
        (["--effects", "haze,fog-lamp"], "unknown effect of the rendering 'fog-lamp'"),
    ],
)
def test_record_refuses_options_that_would_do_nothing(words: list[str], message: str, tmp_path: Path) -> None:
    fails(ssad("record", tmp_path / "x", *words), message)
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize(
    ("words", "effects"),
    [
        ([], DEFAULT_EFFECTS),
        (["--effects", "none"], NO_EFFECTS),
        (["--effects", "haze, flare"], {"haze", "flare"}),
        (["--effects", "lit-signals", "--clips", "drive"], {"lit-signals"}),
    ],
)
def test_record_takes_the_effects_of_the_rendering(
    words: list[str], effects: frozenset[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recordings: list[Recording | TargetRecording] = []
    for module, name in ((nuscenes, "record_nuscenes"), (target_images, "record_target_images")):
        monkeypatch.setattr(module, name, lambda recording, **_: recordings.append(recording))
    done = ssad("record", tmp_path / "x", *words)
    assert done.returncode == 0, done.stderr
    assert recordings[0].effects == effects
