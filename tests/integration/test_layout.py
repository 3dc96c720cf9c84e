"""Tests stand where their module does: `tests/<package>/test_<module>.py`, across packages `tests/integration`."""

from __future__ import annotations

from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def names_beside(package: Path) -> set[str]:
    """Names of the modules and packages in a folder of the source, without leading underscores."""
    return {path.stem.strip("_") for path in package.iterdir() if path.suffix == ".py" or path.is_dir()}


def is_mirrored(test: Path, tests: Path, source: Path) -> bool:
    """Whether a test file is named after a module or package beside it in the source, or an aspect of such.

    test_kind.py and test_kind_rows.py belong to kind.py; test_commonroad.py to commonroad_reader.py and its like.
    """
    package = source / test.parent.relative_to(tests)
    name = test.stem.removeprefix("test_")
    return package.is_dir() and any(
        name == module or name.startswith(f"{module}_") or module.startswith(f"{name}_")
        for module in names_beside(package)
        if module not in {"init", "pycache"}
    )


def test_every_test_file_stands_where_its_module_does() -> None:
    tests, source = ROOT / "tests", ROOT / "src" / "ssad"
    files = [file for file in sorted(tests.rglob("test_*.py")) if file.parent != tests / "integration"]
    assert len(files) > 150
    assert [file.relative_to(ROOT).as_posix() for file in files if not is_mirrored(file, tests, source)] == []


@pytest.mark.parametrize(
    ("name", "mirrored"),
    [
        ("engine/test_run.py", True),
        ("engine/test_run_own_kind.py", True),
        ("test_engine.py", True),
        ("engine/test_placing.py", True),
        ("engine/test_run/test_run.py", False),
        ("engine/test_runs.py", False),
        ("jobs/test_run.py", False),
        ("test_run.py", False),
        ("engine/test_init.py", False),
    ],
)
def test_a_place_is_told_from_others(name: str, mirrored: bool, tmp_path: Path) -> None:
    for module in ("__init__", "run", "_placing"):
        file = tmp_path / "src" / "engine" / f"{module}.py"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch()
    assert is_mirrored(tmp_path / "tests" / name, tmp_path / "tests", tmp_path / "src") is mirrored
