"""`ssad shift` under kill -9: whatever the moment, the next run goes on, and the end is the same to the byte."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
from helpers.killing import kill_9, started_by, wait_until_ended
from helpers.tiny import make_tiny

from ssad.core.errors import StoreError
from ssad.recorders.shifted import Options, check_manifest, verify, write_shifted_roots
from ssad.recorders.shifted.manifest import read_lines

VERSION = "v1.0-mini"
SHIFTS = ("snow", "scale")
DRIVER = """
import sys
from pathlib import Path
from ssad.recorders.shifted import Options, write_shifted_roots
if __name__ == "__main__":
    options = Options(Path(sys.argv[1]), Path(sys.argv[2]), "v1.0-mini", ("snow", "scale"), ("random",))
    write_shifted_roots(options, workers=int(sys.argv[3]), progress=lambda done, of: print(done, of, flush=True))
"""


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Large enough that a run takes a second or two."""
    return make_tiny(tmp_path_factory.mktemp("tiny") / "clean", size=(640, 360), scenes=2, samples=4, sweeps=1)


@pytest.fixture(scope="module")
def unbroken(clean: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str | bytes]:
    """The bytes of a run that nobody disturbed."""
    out = tmp_path_factory.mktemp("unbroken") / "o"
    write_shifted_roots(Options(clean, out, VERSION, SHIFTS, ("random",)), workers=0)
    return tree(out)


def tree(folder: Path) -> dict[str, str | bytes]:
    """Every file with its bytes and every link with its target; locks left out."""
    return {
        str(path.relative_to(folder)): os.readlink(path) if path.is_symlink() else path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.name != ".lock" and (path.is_symlink() or path.is_file())
    }


def start(clean: Path, out: Path, workers: int, folder: Path) -> subprocess.Popen[bytes]:
    """A run in a process of its own."""
    script = folder / "driver.py"
    script.write_text(DRIVER)
    command = [sys.executable, "-W", "ignore", str(script), str(clean), str(out), str(workers)]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def files(out: Path) -> int:
    """How many images and sweeps are there."""
    return sum(1 for path in out.glob("*/s[aw]*/*/*") if not path.is_dir())


def kill_at(run: subprocess.Popen[bytes], out: Path, *, at_least: int, delay: float) -> bool:
    """kill -9 once so many files are there and some time more; whether the run was still going."""
    while run.poll() is None and files(out) < at_least:
        time.sleep(0.002)
    time.sleep(delay)
    going = kill_9(run)
    run.communicate()
    return going


def whole(out: Path, unbroken: dict[str, str | bytes]) -> None:
    """What stands in the places of images and sweeps is never half a file, and never called complete too early."""
    for name, data in tree(out).items():
        if "/samples/" in name or "/sweeps/" in name:
            assert data == unbroken[name], name
    for root in out.glob("*-random"):
        if (root / "manifest.json").exists():
            check_manifest(root)
        elif (root / "manifest").exists():
            with pytest.raises(StoreError, match="not complete"):
                check_manifest(root)


def disturb(clean: Path, out: Path, folder: Path, *, kills: int, unbroken: dict[str, str | bytes]) -> int:
    """Runs until one gets through; the first ones are killed, each a little later than the one before."""
    killed, total = 0, sum("/samples/" in name or "/sweeps/" in name for name in unbroken)
    for number in range(kills):
        run = start(clean, out, 1 + number % 2, folder)
        killed += kill_at(run, out, at_least=total * number // kills, delay=0.007 * (number % 5))
        whole(out, unbroken)
    last = start(clean, out, 2, folder)
    _, problem = last.communicate(timeout=500)
    assert last.returncode == 0, problem.decode()
    return killed


@pytest.mark.slow
@pytest.mark.parametrize("kills", [2, 20])
def test_kills_leave_no_trace(clean: Path, tmp_path: Path, unbroken: dict[str, str | bytes], kills: int) -> None:
    out = tmp_path / "o"
    killed = disturb(clean, out, tmp_path, kills=kills, unbroken=unbroken)
    assert killed >= kills // 2  # the others came too late
    assert tree(out) == unbroken
    for root in out.glob("*-random"):
        assert verify(root) == (98, [])


def test_what_a_killed_run_made_is_not_made_again(
    clean: Path, tmp_path: Path, unbroken: dict[str, str | bytes]
) -> None:
    out = tmp_path / "o"
    for _ in range(10):
        if kill_at(start(clean, out, 1, tmp_path), out, at_least=30, delay=0.0):
            break
        shutil.rmtree(out)  # it got through while this process had to wait for a core
    else:
        pytest.fail("it was never killed at work")
    kept = {}
    for root in out.glob("*-random"):
        for lines in (root / "manifest").glob("*.jsonl"):
            kept |= {root / name: (root / name).stat().st_ino for name in read_lines(lines)}
    assert len(kept) >= 25
    write_shifted_roots(Options(clean, out, VERSION, SHIFTS, ("random",)), workers=0)
    assert {path: path.stat().st_ino for path in kept} == kept
    assert tree(out) == unbroken


@pytest.mark.slow
def test_workers_end_with_the_process_that_started_them(
    clean: Path, tmp_path: Path, unbroken: dict[str, str | bytes]
) -> None:
    """Only the parent is killed: they are gone soon after, and nobody writes behind the next run's back."""
    out = tmp_path / "o"
    run = start(clean, out, 2, tmp_path)
    while run.poll() is None and files(out) < 10:
        time.sleep(0.002)
    workers = started_by(run.pid)
    assert len(workers) == 2
    run.kill()
    run.communicate()
    wait_until_ended(workers)
    write_shifted_roots(Options(clean, out, VERSION, SHIFTS, ("random",)), workers=0)
    assert tree(out) == unbroken
