"""The template of a package for SSAD works as it lies there: under its names, as pip would install it."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
from helpers.command import ssad
from helpers.template import FOLDER, PROJECT, installed_template


@pytest.fixture(autouse=True)
def installed(tmp_path: Path) -> Iterator[None]:
    """The template, installed."""
    with installed_template(tmp_path / "site"):
        yield


def its_tests() -> ModuleType:
    spec = importlib.util.spec_from_file_location("ssad_example_tests", FOLDER / "tests" / "test_example.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


LISTS = {"physical-attacks": "attacks", "lights": "attacks", "faults": "perturbations"}
GROUPS = [group.removeprefix("ssad.") for group in PROJECT["entry-points"]]


@pytest.mark.parametrize("group", GROUPS)
def test_its_names_are_listed(group: str) -> None:
    done = ssad("list", LISTS.get(group, group))
    assert done.returncode == 0, done.stderr
    listed = [line.split()[0] for line in done.stdout.splitlines()]
    assert set(PROJECT["entry-points"][f"ssad.{group}"]) <= set(listed)


@pytest.mark.parametrize("name", [name for name in vars(its_tests()) if name.startswith("test_")])
def test_its_own_tests_pass(name: str, tmp_path: Path) -> None:
    test = getattr(its_tests(), name)
    (tmp_path / "work").mkdir()
    test(tmp_path / "work") if "tmp_path" in test.__code__.co_varnames[: test.__code__.co_argcount] else test()


def test_its_page_names_only_what_is_there() -> None:
    page = (FOLDER / "README.md").read_text()
    for file in (FOLDER / "src" / "ssad_example").glob("[a-z]*.py"):
        assert f"`{file.name}`" in page
    for name in (name for names in PROJECT["entry-points"].values() for name in names if name.startswith("example-")):
        assert name in page or name == "example-coin"


def test_its_perceiver_and_tracker_drive_in_a_gap_suite(tmp_path: Path) -> None:
    """LiDAR alone: perturbations of cameras do not apply, and objects are in view without a camera."""
    import ssad

    (tmp_path / "short.yaml").write_text(
        "name: short\ntype: StraightObstacle\ntown: ProvingGround\nlimits: {max_steps: 12}\n"
        "route: [{x: 217.0, y: -5.25}, {x: 317.0, y: -5.25}]\n"
    )
    suite = tmp_path / "gap.yaml"
    suite.write_text(
        f"kind: gap\nname: lidar\nceilings: []\nscenarios: [{tmp_path / 'short.yaml'}]\nperturbations: [fog]\n"
        "systems:\n- {name: lidar, perceiver: {example-clusters: {reach: 30}}, tracker: example-nearest, rate: 2.5}\n"
    )
    results = ssad.run(suite, out=tmp_path / "run", workers=0, quiet=True)
    (row,) = results.rows
    assert (row["status"], row["perturbation"]) == ("ok", "none")
    assert row["metrics"]["phantoms"] is not None
    assert results.report.is_file()
