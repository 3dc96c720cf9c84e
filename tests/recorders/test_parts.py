"""The folder of parts: finished parts stand, interrupted ones are made again, another request is refused."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from helpers.killing import kill_9, wait_until_stopped

from ssad.core.errors import FormatError, StoreError
from ssad.recorders.nuscenes import Recording
from ssad.recorders.parts import FOLDER, PAGE, REQUEST, PartsFolder
from ssad.recorders.target_recording import TargetRecording
from ssad.rendering.target import TargetCar

REQUESTED = {"towns": ["Twinford"], "seed": 0}
PROGRAM = """
import os, signal, sys
from pathlib import Path
from ssad.core import safeio
from ssad.recorders.parts import PartsFolder
stop_at, writes = int(sys.argv[2]), 0

def write(path, data):
    global writes
    writes += 1
    if writes == stop_at:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data[:2])
        os.kill(os.getpid(), signal.SIGSTOP)
    safeio.write_atomic(path, data)

parts = PartsFolder(Path(sys.argv[1]), {"towns": ["Twinford"], "seed": 0})
with parts.lock("ssad record"):
    for name in ("a", "b", "c"):
        if parts.is_finished(name):
            continue
        folder = parts.begin(name)
        for number in range(3):
            write(folder / f"{number}-{stop_at}.bin", name.encode() * 100)
        parts.finish(name, {"name": name})
"""


def run(out: Path, stop_at: int) -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-c", PROGRAM, str(out), str(stop_at)])


@pytest.mark.parametrize(("stop_at", "whole"), [(2, []), (4, ["a"]), (9, ["a", "b"])])
def test_finished_parts_stand_after_kill_9_and_the_interrupted_one_is_made_again(
    tmp_path: Path, stop_at: int, whole: list[str]
) -> None:
    process = run(tmp_path, stop_at)
    wait_until_stopped(process)
    parts = PartsFolder(tmp_path, REQUESTED)
    with pytest.raises(StoreError, match="another ssad record"), parts.lock("ssad record"):
        pass
    assert kill_9(process)
    process.communicate()
    assert [name for name in ("a", "b", "c") if parts.is_finished(name)] == whole
    before = {path: path.stat().st_ino for name in whole for path in parts.part(name).iterdir()}
    assert run(tmp_path, 0).wait() == 0
    for name in ("a", "b", "c"):
        assert parts.page(name) == {"name": name}
        files = {path.name for path in parts.part(name).iterdir()} - {PAGE}
        # The number of the run that made them: nothing of an interrupted part is left.
        assert files == {f"{number}-{stop_at if name in whole else 0}.bin" for number in range(3)}
        assert all((parts.part(name) / file).read_bytes() == name.encode() * 100 for file in files)
    assert {path: path.stat().st_ino for path in before} == before


def test_another_request_or_a_damaged_one_is_refused(tmp_path: Path) -> None:
    parts = PartsFolder(tmp_path, REQUESTED)
    assert not parts.is_claimed
    parts.claim()
    assert parts.is_claimed
    text = (tmp_path / FOLDER / REQUEST).read_text()
    with pytest.raises(StoreError, match="another recording"):
        PartsFolder(tmp_path, REQUESTED | {"seed": 1}).claim()
    assert (tmp_path / FOLDER / REQUEST).read_text() == text
    (tmp_path / FOLDER / REQUEST).write_text(text[:9])
    with pytest.raises(StoreError, match="another recording"):
        parts.claim()


def test_a_part_without_a_page_is_not_read(tmp_path: Path) -> None:
    parts = PartsFolder(tmp_path, REQUESTED)
    with pytest.raises(FormatError, match=r"part\.json"):
        parts.page("a")
    parts.part("a").mkdir(parents=True)
    (parts.part("a") / PAGE).write_text("[]")
    with pytest.raises(FormatError, match="not the page of a part"):
        parts.page("a")


def test_the_same_settings_are_the_same_request(tmp_path: Path) -> None:
    """A file holds lists where settings hold tuples, as that of a target's size."""
    recordings = [
        Recording(tmp_path / "a", ("Twinford",)),
        TargetRecording(tmp_path / "b", (("Twinford", 1),), target=TargetCar("van", size=(5.0, 2.0, 2.0))),
    ]
    for recording in recordings:
        recording.parts.claim()
        recording.parts.claim()
    other = TargetRecording(tmp_path / "b", (("Twinford", 1),), target=TargetCar("van", size=(5.0, 2.0, 2.1)))
    with pytest.raises(StoreError, match="another recording"):
        other.parts.claim()
