"""Versions of systems, types and towns that cells of driving kinds depend on."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ssad.core.errors import ConfigError, UnknownNameError
from ssad.core.source import source_version
from ssad.simulators import closed_loop
from ssad.simulators.closed_loop import system_version, town_version, type_version


class Thing:
    """No system: it cannot act."""

    def reset(self, episodes: Any) -> None:
        """Nothing."""


class Mute:
    """No system: it cannot be reset."""

    reset = 3

    def act(self, view: Any) -> None:
        """Nothing."""


class Whole(Thing, Mute):
    """A system; there are others of its class."""


WHOLE = Whole()


def test_a_system_must_have_its_methods(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(closed_loop, "source_version", lambda module: f"version of {module}")
    for name in ("Thing", "Mute"):
        with pytest.raises(
            ConfigError, match=rf"system '{__name__}:{name}' needs the methods reset\(episodes\) and act"
        ):
            system_version(f"{__name__}:{name}")
    for name in ("Whole", "WHOLE"):
        assert system_version(f"{__name__}:{name}") == f"version of {__name__}"
    with pytest.raises(UnknownNameError):
        system_version("nobody")


def test_a_scenario_type_of_ones_own_has_a_version(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "own_scenarios.py").write_text(
        "from ssad.scenarios.dynamic.knowledge.right_turn import SCENARIO as MINE\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    assert type_version("own_scenarios:MINE") == source_version("own_scenarios")
    assert type_version("StraightObstacle") == ""


def test_the_version_of_a_town_depends_on_every_array() -> None:
    def version(**changes: Any) -> str:
        arrays = {"xy": np.zeros((2, 3)), "ids": np.arange(3)}
        return town_version(SimpleNamespace(name="any", **(arrays | changes)))  # type: ignore[arg-type]

    first = version()
    assert len(first) == 12
    assert version(index=[3]) == first, "what is no array does not count"
    others = [
        version(xy=np.ones((2, 3))),
        version(xy=np.zeros((3, 2))),
        version(xy=np.zeros((2, 3), np.int64)),
        version(more=np.zeros(1)),
    ]
    assert len({first, *others}) == 5
