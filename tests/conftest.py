"""Options and fixtures that all tests share."""

from __future__ import annotations

import atexit
import fcntl
import gc
import os
import random
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from helpers.sharing import Shared
from hypothesis import HealthCheck, settings
from hypothesis.internal.conjecture import providers

# One thread a process: as many as there are cores in each of several test workers only wait for each other. The
# libraries read this when they are first imported, and child processes inherit it.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
    os.environ.setdefault(_name, "1")

# The same cases in every run and on every machine, however slow it is: what is drawn anew cannot hold a release up.
settings.register_profile(
    "same",
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
settings.load_profile("same")
# Hypothesis also tries the numbers and words that it finds in our modules: in those that happen to be imported, which
# is another set in each test worker.
setattr(providers, "_get_local_constants", lambda: providers._local_constants)  # noqa: B010

ROOT = Path(__file__).resolve().parent.parent


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--run-slow", action="store_true", help="run the tests marked slow as well")


def pytest_configure(config: pytest.Config) -> None:
    """An $SSAD_HOME for this run: what the developer has imported must not decide a test. Workers inherit it."""
    if not hasattr(config, "workerinput"):
        home = tempfile.mkdtemp(prefix="ssad-tests-")
        os.environ["SSAD_HOME"] = home
        if sys.dont_write_bytecode:  # what one of the run's many processes has compiled serves the others, nobody else
            os.environ["PYTHONPYCACHEPREFIX"] = sys.pycache_prefix = f"{home}/bytecode"
            os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
            sys.dont_write_bytecode = False
        config.add_cleanup(lambda: shutil.rmtree(home, ignore_errors=True))


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.getoption("--run-slow"):
        return
    skip = pytest.mark.skip(reason="slow: run with --run-slow")
    for item in items:
        if item.get_closest_marker("slow"):
            item.add_marker(skip)


def pytest_runtest_setup() -> None:
    """What a test draws, and the weights that it begins with, do not depend on the tests before it in this process."""
    random.seed(0)
    if "torch" in sys.modules:
        sys.modules["torch"].manual_seed(0)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """No search for garbage while 5,000 tests are collected, nor among them and all that they import afterwards."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        atexit.register(gc.unfreeze)  # what was set apart is let go with the rest, or libraries complain of leaks
        gc.set_threshold(20_000, 20, 20)
        gc.enable()


def find_data() -> Path | None:
    """The folder of CARLA maps and routes: $SSAD_DATA, else ../shared/data beside the checkout."""
    folder = ROOT / os.environ.get("SSAD_DATA", "../shared/data")
    return folder.resolve() if (folder / "maps").is_dir() else None


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder with maps/ and routes/. Absent: skip, or fail under SSAD_CI=1 so that nothing skips unseen."""
    folder = find_data()
    if folder is None:
        reason = "CARLA maps and routes not found: set SSAD_DATA to the folder that has maps/ and routes/"
        if os.environ.get("SSAD_CI") == "1":
            pytest.fail(reason)
        pytest.skip(reason)
    return folder


@pytest.fixture
def ssad_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty $SSAD_HOME of this test's own."""
    folder = tmp_path / "ssad-home"
    folder.mkdir()
    monkeypatch.setenv("SSAD_HOME", str(folder))
    return folder


@pytest.fixture(scope="session")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Shared:
    """`shared(name, make)`: the folder `name`, filled by `make(folder)` once a run, whatever the number of workers.

    What is in it must be left as it is: other tests read it too.
    """
    base = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        base = base.parent

    def get(name: str, make: Callable[[Path], object]) -> Path:
        folder, done = base / name, base / f"{name}.done"
        with (base / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not done.exists():
                shutil.rmtree(folder, ignore_errors=True)
                make(folder)
                done.touch()
        return folder

    return get


@pytest.fixture(scope="session")
def recorded(shared: Shared) -> Path:
    """A data set of `ssad record`: a second in Twinford (train) and one in Oldmarket (val)."""
    from ssad.recorders.nuscenes import Recording, record_nuscenes

    def make(out: Path) -> None:
        towns = ("Twinford", "Oldmarket")
        record_nuscenes(Recording(out, towns, towns[1:], scenes=1, seconds=1.0, width=160, sweeps=1), workers=0)

    return shared("recorded", make)


@pytest.fixture(scope="session")
def tiny_set(shared: Shared) -> Path:
    """A data set in the nuScenes schema: two scenes of two samples, pictures of 320 x 180, one sweep between them."""
    from helpers.tiny import make_tiny

    return shared("tiny", lambda out: make_tiny(out, size=(320, 180), scenes=2, samples=2, sweeps=1))


@pytest.fixture(scope="session")
def carla_home(shared: Shared, data_dir: Path) -> Path:
    """An $SSAD_HOME into which CARLA's maps and SafeBench's and FREA's routes were imported by `ssad import`."""
    from helpers.command import ssad

    def make(home: Path) -> None:
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("SSAD_HOME", str(home))
            for town in ("Town_Safebench_Light", "Town02", "Town05"):
                done = ssad("import", "map", data_dir / "maps" / f"{town}.xodr")
                assert f"town {town}: " in done.stdout, done.stderr
            for name, count in (("safebench", 32), ("frea", 150)):
                done = ssad("import", "routes", data_dir / "routes" / name)
                assert f"set {name}: {count} scenarios" in done.stdout, done.stderr

    return shared("carla", make)
