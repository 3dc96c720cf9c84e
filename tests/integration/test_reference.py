"""Pages of commands, keys and names are those that the code makes; the kind of a plug-in gets the same section."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import pytest
from pydantic import Field

from benchmarks import reference
from ssad.core.schema import Schema
from ssad.engine.kind import Kind, SuiteBase
from ssad.experiments.suites import KINDS, kind_of

PAGES = Path(__file__).resolve().parents[2] / "docs" / "reference"


@pytest.mark.parametrize(("name", "make"), [("cli", "command_page"), ("suites", "suite_page"), ("names", "name_page")])
def test_a_page_is_what_the_code_makes(name: str, make: str) -> None:
    page = getattr(reference, make)()
    assert page == (PAGES / f"{name}.md").read_text(), "run python -m benchmarks.reference"


@pytest.mark.parametrize("name", KINDS)
def test_every_key_of_a_kind_has_a_description(name: str) -> None:
    suite = kind_of(name).suite
    for model in (suite, *reference._models(suite, list(suite.model_fields))):
        missing = [key for key, about in reference.descriptions(model).items() if not about]
        assert missing == [], model.__name__


class Wheel(Schema):
    """A wheel.

    Attributes:
        radius, width: Its size, m.
    """

    radius: float = Field(default=0.3, gt=0)
    width: float = 0.2


class WheelSuite(SuiteBase):
    """Wheels of some carts.

    Attributes:
        carts: Names of carts, which
            may go on in another line (docs/how-to/install.md).
        wheels: Wheels of each cart.
    """

    kind: Literal["wheels"]
    chunk: int = 8
    carts: list[Annotated[int, Field(ge=1, le=5)] | Literal["random"]] = Field(min_length=1)
    wheels: list[Wheel] = Field(default=[Wheel(radius=0.5)])


class Wheels(Kind):
    name, suite, factors, columns = "wheels", WheelSuite, (), ()


def test_the_kind_of_a_plug_in_gets_the_same_section() -> None:
    lines = reference.kind_section(Wheels()).splitlines()
    assert lines[0] == "## Kind `wheels`"
    assert "Wheels of some carts." in lines
    assert (
        "| `carts` | list of integer (at least 1, at most 5) or `random` | required | not empty "
        "| Names of carts, which may go on in another line ([install](../how-to/install.md)). |"
    ) in lines
    assert "| `wheels` | list of mapping: Wheel | `[{radius: 0.5}]` |  | Wheels of each cart. |" in lines
    assert "| `radius` | number | `0.3` | more than 0 | Its size, m. |" in lines
    assert "| `width` | number | `0.2` |  | Its size, m. |" in lines
    assert any(line.startswith("| `chunk` | integer | `8` |") for line in lines), "its default differs"
    assert not any(line.startswith("| `seed` |") for line in lines)
