"""Options and fixtures that all tests share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--run-slow", action="store_true", help="run the tests marked slow as well")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.getoption("--run-slow"):
        return
    skip = pytest.mark.skip(reason="slow: run with --run-slow")
    for item in items:
        if item.get_closest_marker("slow"):
            item.add_marker(skip)


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
