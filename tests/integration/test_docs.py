"""The pages name what exists: files, links, Python names, commands and their options; their examples run."""

from __future__ import annotations

import ast
import importlib
import io
import re
import runpy
import shlex
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import typer
from rich.console import Console

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
TEXTS = {path.relative_to(ROOT).as_posix(): path.read_text() for path in PAGES}
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)

page = pytest.mark.parametrize("page", TEXTS)


def blocks(text: str, language: str) -> list[str]:
    return [body for name, body in FENCE.findall(text) if name == language]


def exists(dotted: str) -> bool:
    """Whether a dotted name can be imported or is an attribute, of an object if need be."""
    parts = dotted.split(".")
    for size in range(len(parts), 0, -1):
        try:
            value: Any = importlib.import_module(".".join(parts[:size]))
        except ModuleNotFoundError as error:
            if not str(error.name).startswith("ssad"):
                raise
            continue
        for part in parts[size:]:
            fields = getattr(value, "__dataclass_fields__", {}) | getattr(value, "__annotations__", {})
            if not hasattr(value, part):
                return part in fields
            value = getattr(value, part)
        return True
    return False


GROUPS = {
    "ssad.systems",
    "ssad.detectors",
    "ssad.scenarios",
    "ssad.kinds",
    "ssad.attacks",
    "ssad.generators",
    "ssad.generator_files",
    "ssad.shifts",
    "ssad.lights",
    "ssad.faults",
    "ssad.perturbations",
    "ssad.losses",
    "ssad.defences",
    "ssad.simulators",
    "ssad.physical",  # -attacks
    "ssad.perceivers",
    "ssad.trackers",
    "ssad.planners",
}  # of entry points


@page
def test_python_names_exist(page: str) -> None:
    prose = FENCE.sub("", TEXTS[page])
    named = set(re.findall(r"`(ssad(?:\.\w+)+)", prose)) - GROUPS
    assert [name for name in sorted(named) if not exists(name)] == []


@page
def test_imports_of_the_examples_work(page: str) -> None:
    wrong = []
    for block in blocks(TEXTS[page], "python"):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and str(node.module).startswith("ssad"):
                wrong += [f"{node.module}.{a.name}" for a in node.names if not exists(f"{node.module}.{a.name}")]
    assert wrong == []


@page
def test_paths_and_links_exist(page: str) -> None:
    text, here = TEXTS[page], (ROOT / page).parent
    paths = re.findall(r"`((?:src|suites|docs|tests|benchmarks|\.ci)/[\w/.-]+)(?:\s[^`]*)?`", text)
    paths += re.findall(r"python (benchmarks/\w+\.py)", text)
    assert [path for path in paths if not (ROOT / path).exists()] == []
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        file, _, anchor = target.partition("#")
        if file.startswith("http"):
            continue
        aim = here / file if file else ROOT / page
        assert aim.exists(), target
        if anchor:
            headings = re.findall(r"^#+ (.+)$", FENCE.sub("", aim.read_text()), re.MULTILINE)
            assert anchor in [re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings], target


def commands(text: str) -> list[str]:
    """Command lines of the blocks without a language, comments taken off, and those in the prose."""
    lines = [line.split("  #")[0] for body in blocks(text, "") for line in body.splitlines()]
    lines += re.findall(r"`(ssad \w[^`]*)`", FENCE.sub("", text))
    return [re.split(r"\s{3,}", line)[0].strip() for line in lines if line.startswith("ssad ")]


@cache
def whole_command() -> Any:
    from ssad.cli import app

    return typer.main.get_command(app)


@page
def test_commands_and_their_options_exist(page: str) -> None:
    for line in commands(TEXTS[page]):
        command = whole_command()
        words = shlex.split(line)[1:]
        while hasattr(command, "commands") and words:
            names = words.pop(0).split("|")
            assert set(names) <= set(command.commands), line
            command = command.commands[names[0]]
        known = {option for parameter in getattr(command, "params", []) for option in parameter.opts}
        known |= {option for parameter in getattr(command, "params", []) for option in parameter.secondary_opts}
        for word in words:
            if word.startswith("--"):
                assert word.split("=")[0] in known, line


def table_share(text: str) -> float:
    """Share of a page's lines that belong to tables."""
    lines = [line for line in text.splitlines() if line.strip()]
    return sum(line.lstrip().startswith("|") for line in lines) / len(lines)


GUIDES = [page for page in TEXTS if page.startswith("docs/") and page.split("/")[1] not in ("results", "reference")]


@pytest.mark.parametrize("page", GUIDES)
def test_a_page_that_teaches_is_short_and_no_table(page: str) -> None:
    assert len(TEXTS[page].encode()) <= 15_000
    assert table_share(TEXTS[page]) <= 0.4


def test_every_part_of_the_documentation_has_pages() -> None:
    parts = {page.split("/")[1] for page in TEXTS if page.count("/") == 2}
    assert parts == {"tutorials", "how-to", "reference", "explanation", "results"}
    assert [page for page in TEXTS if page.startswith("docs/") and page.count("/") == 1] == ["docs/index.md"]


BANNED = {
    "a line of contents": r"^\*?\*?Contents:",
    "he, him or his": r"\b(?:he|him|his)\b|(?:^|[.!?] )(?:He|His)\b",
}


@page
def test_a_page_has_nothing_that_is_banned(page: str) -> None:
    if page == "CHANGELOG.md":
        return
    prose = re.sub(r"`[^`\n]*`", "", FENCE.sub("", TEXTS[page]))
    for what, pattern in BANNED.items():
        found = re.search(pattern, prose, re.MULTILINE)
        assert not found, f"{what}: {found[0] if found else ''}"
    cells = [cell for line in prose.splitlines() if line.startswith("|") for cell in line.split("|")]
    assert [cell for cell in cells if cell.count("](") > 3] == []


def test_a_result_says_where_it_comes_from() -> None:
    """Every page of results names a command or a script, and torch versions that are refused stand in a warning."""
    for page, text in TEXTS.items():
        if page.startswith("docs/results/") and page != "docs/results/index.md":
            assert re.search(r"`(?:ssad|python|benchmarks/)", text), page
            if "torch 2.11" in text:
                assert "no longer allows" in text, page


def test_the_command_lines_are_found() -> None:
    found = {page: len(commands(text)) for page, text in TEXTS.items()}
    assert found["README.md"] >= 15
    assert found["docs/how-to/shift-data.md"] >= 8


def test_the_readme_stays_short() -> None:
    assert len(TEXTS["README.md"].splitlines()) < 150


def packages() -> set[str]:
    folder = ROOT / "src" / "ssad"
    found = {path.parent.name for path in folder.glob("*/__init__.py")}
    return found | {path.stem for path in folder.glob("*.py")} - {"__init__", "__main__"}


def test_the_architecture_names_every_package_once_and_no_other() -> None:
    table = re.search(r"^\| Package .*?\n\n", TEXTS["ARCHITECTURE.md"], re.MULTILINE | re.DOTALL)
    assert table
    named = [name for row in table[0].strip().splitlines()[2:] for name in re.findall(r"`(\w+)`", row.split("|")[1])]
    assert sorted(named) == sorted(packages())


def test_the_picture_of_the_architecture_shows_the_import_contract() -> None:
    script = runpy.run_path(str(ROOT / "benchmarks" / "architecture_picture.py"))
    command = "run python benchmarks/architecture_picture.py"
    assert script["picture"]() == (ROOT / "docs" / "images" / "architecture.svg").read_text(), command
    assert {name for row in script["layers"]() for name in row} == packages()


def test_the_kind_of_the_architecture_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from ssad.engine.kind import Resources
    from ssad.engine.run import run
    from ssad.experiments.suites import kind_of, load_suite

    (block,) = blocks(TEXTS["ARCHITECTURE.md"], "python")
    (tmp_path / "coin.py").write_text(block)
    (tmp_path / "coins.yaml").write_text("kind: coin:Coin\nname: coins\nsystems: [one, two]\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    suite = load_suite("coins.yaml", ["tosses=1000"])
    plan = kind_of(suite.kind).plan(suite)
    records = run(plan, tmp_path / "run", Resources(0, console=Console(file=io.StringIO())))
    assert [r["system"] for r in records] == ["one", "two"]
    assert all(r["status"] == "ok" and 0.4 < r["metrics"]["heads"] < 0.6 for r in records)


def test_the_examples_of_the_camera_run() -> None:
    names: dict[str, Any] = {}
    for block in blocks(TEXTS["docs/how-to/render-images.md"], "python"):
        exec(block, names)
    assert names["picture"].image.shape == (1, 360, 640, 3)
    assert (names["picture"].tag == 1).mean() > 0.01, "the car is in sight"
    assert names["texture"].grad.abs().max() > 0
