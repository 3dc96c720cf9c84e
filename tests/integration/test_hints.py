"""A hint in a message leads somewhere: lists that exist, extras that exist, nothing from a package index."""

from __future__ import annotations

import ast
import pickle
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import typer

from ssad.cli import app
from ssad.cli.listing import LISTS
from ssad.core.errors import LISTED, MissingExtraError, install_extra, plural, unknown_name
from ssad.core.safeio import parse_yaml
from ssad.core.version import __version__

ROOT = Path(__file__).resolve().parents[2]
SOURCE = sorted((ROOT / "src" / "ssad").rglob("*.py"))
PAGES = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]


def arguments(*functions: str) -> set[str]:
    """The first arguments that the source calls these functions with, where they are plain text."""
    return {
        str(node.args[0].value)
        for path in SOURCE
        if any(f"{name}(" in path.read_text() for name in functions)
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in functions
        if node.args and isinstance(node.args[0], ast.Constant)
    }


NOUNS = arguments("unknown_name", "resolve")  # what the source calls things whose names a user can get wrong


def test_every_noun_of_the_source_is_found() -> None:
    assert {*LISTED, "model", "calibration", "body"} <= NOUNS


@pytest.mark.parametrize("noun", sorted(NOUNS))
def test_the_hint_for_an_unknown_name_shows_all_names_or_a_list_that_exists(noun: str) -> None:
    message = str(unknown_name(noun, "alpa", ["gamma", "beta", "alpha", "delta"]))
    assert message.startswith(f"unknown {noun} 'alpa'; closest: alpha, ")
    hint = re.search(r"\(see: ssad list (.+)\)$", message)
    if hint is None:
        assert message.endswith("(known: alpha, beta, delta, gamma)")
    else:
        assert hint[1] in LISTS


def test_what_can_be_listed_is_what_hints_name() -> None:
    assert set(map(plural, LISTED)) == set(LISTS)


def test_every_list_that_source_and_pages_name_exists() -> None:
    named = {
        word for path in [*SOURCE, *PAGES] for word in re.findall(r"(?:`|see: |\()ssad list (\w+)", path.read_text())
    }
    assert {"suites", "towns", "shifts"} <= named
    assert named <= set(LISTS)


def test_extras_that_messages_name_exist() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert {"carla", "ray", "ultralytics"} <= arguments("install_extra") <= set(extras)
    assert "'.[ray]'" in install_extra("ray")


def test_a_missing_extra_is_told_by_a_worker_too() -> None:
    """An error with more arguments than its text has: a process that cannot read it would lose all its work."""
    error = pickle.loads(pickle.dumps(MissingExtraError("generator 'x'", "scenic")))
    assert isinstance(error, MissingExtraError)
    assert (error.extra, "generator 'x' needs the extra scenic" in str(error)) == ("scenic", True)


def test_nobody_is_sent_to_a_package_index_for_ssad() -> None:
    """The distribution is not published: its name there could be anybody's."""
    wrong = re.compile(r"(pip|uv|uvx|pipx)\b[^\n`]*\bssad\b|ssad-testbed\[|install ssad-testbed", re.IGNORECASE)
    allowed = re.compile(r"uv run [^\n`]*ssad|checkout of SSAD")
    found = [
        f"{path.relative_to(ROOT)}: {line.strip()}"
        for path in [*SOURCE, *PAGES]
        for line in path.read_text().splitlines()
        if wrong.search(line) and not allowed.search(line)
    ]
    assert found == []


def texts() -> dict[str, list[str]]:
    """The pieces of text of the source, by file: messages, help and documentation."""
    found = {}
    for path in SOURCE:
        nodes = ast.walk(ast.parse(path.read_text()))
        found[str(path.relative_to(ROOT))] = [
            str(node.value) for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)
        ]
    return found


def command_trees() -> dict[str, Any]:
    """Name of each verb -> its command."""
    command: Any = typer.main.get_command(app)
    return dict(command.commands)


def test_every_command_and_option_that_the_source_names_exists() -> None:
    """In quotes of code, after a colon, or in "run ... again": `ssad VERB ... --option`."""
    verbs, wrong, seen = command_trees(), [], 0
    for file, pieces in texts().items():
        for piece in pieces:
            for told in re.findall(r"(?:`|: |run )ssad ([a-z][^`;\n)]*)", piece):
                words = told.split()
                names = words[0].rstrip(",.:").split("|")
                seen += 1
                wrong += [f"{file}: ssad {name}" for name in names if name not in verbs]
                command = verbs.get(names[0])
                if command is not None and hasattr(command, "commands") and len(words) > 1:
                    command = command.commands.get(words[1].rstrip(",.:"), command)
                known = {name for one in getattr(command, "params", []) for name in (*one.opts, *one.secondary_opts)}
                for option in re.findall(r"--[a-z][a-z-]*", told):
                    if known and not hasattr(command, "commands") and option not in {*known, "--help"}:
                        wrong.append(f"{file}: ssad {told}: {option}")
    assert seen > 40
    assert wrong == []


def test_every_page_and_file_that_the_source_names_exists() -> None:
    named = {
        (file, page)
        for file, pieces in texts().items()
        for piece in pieces
        for page in re.findall(
            r"\b((?:docs|suites|benchmarks)/[\w/.-]+\.(?:md|yaml|py)|README\.md|ARCHITECTURE\.md)", piece
        )
    }
    assert len(named) > 10
    assert [f"{file}: {page}" for file, page in sorted(named) if not (ROOT / page).is_file()] == []


def test_every_extra_that_a_text_names_exists() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    pages = {str(path.relative_to(ROOT)): [path.read_text()] for path in PAGES}
    named = {
        (file, name)
        for file, pieces in {**texts(), **pages}.items()
        for piece in pieces
        for told in re.findall(r"extra `(\w+)`|extra '(\w+)'|--extra (\w+)|'\.\[(\w+)\]'", piece)
        for name in told
        if name
    }
    assert len(named) > 8
    assert [one for one in sorted(named) if one[1] not in extras] == []


def test_the_version_is_the_same_everywhere() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert re.search(rf"^version: {re.escape(version)}$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    assert version == __version__


def test_hosted_checks_are_the_local_ones() -> None:
    steps = read_yaml(ROOT / ".github" / "workflows" / "ci.yml")["jobs"]["check"]["steps"]
    assert steps[-1]["run"] == ".ci/run"
    for path in (ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"):
        assert read_yaml(path)


def read_yaml(path: Path) -> Any:
    return parse_yaml(path.read_text(), str(path))
