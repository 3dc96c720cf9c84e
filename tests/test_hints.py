"""A hint in a message leads somewhere: lists that exist, extras that exist, nothing from a package index."""

from __future__ import annotations

import ast
import re
import tomllib
from pathlib import Path

import pytest

from ssad.core.errors import LISTED, install_extra, unknown_name
from ssad.listing import LISTS

ROOT = Path(__file__).resolve().parent.parent
SOURCE = sorted((ROOT / "src" / "ssad").rglob("*.py"))
PAGES = [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")]


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
    assert {f"{noun}s" for noun in LISTED} == set(LISTS)


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
