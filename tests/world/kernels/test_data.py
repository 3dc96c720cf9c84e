"""Codes that kernels and host share: named by their enums, and complete."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import get_args, get_type_hints

import pytest

from ssad.core.types import ENDS, PhaseTrigger
from ssad.world import kernels
from ssad.world.kernels.data import End, PhaseCondition

CODED = ("kind", "controller", "active", "end", "contact", "who", "light")
SOURCES = sorted(Path(kernels.__file__).parent.glob("*.py"))


def test_every_condition_of_a_phase_has_a_code() -> None:
    kinds = get_args(get_type_hints(PhaseTrigger)["kind"])
    assert [when.name.lower() for when in PhaseCondition] == sorted(
        kinds, key=lambda kind: PhaseCondition[kind.upper()]
    )


def test_every_end_has_a_name() -> None:
    assert [ENDS[end] for end in End] == ["", "collision", "complete", "max_steps", "max_distance", "max_time"]


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.name)
def test_kernels_compare_codes_with_names_not_numbers(path: Path) -> None:
    """`state.active[b, i] == 2` says nothing, and goes on saying it when the enum changes."""
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Compare):
            sides = [node.left, *node.comparators]
            names = {_name(side) for side in sides} & set(CODED)
            if names and any(isinstance(side, ast.Constant) for side in sides):
                found.append(f"{path.name}:{node.lineno}: {ast.unparse(node)}")
    assert found == []


def _name(side: ast.expr) -> str:
    """What a side of a comparison is called: `who`, or `active` of `state.active[b, i]`."""
    if isinstance(side, ast.Subscript):
        side = side.value
    return side.id if isinstance(side, ast.Name) else side.attr if isinstance(side, ast.Attribute) else ""
