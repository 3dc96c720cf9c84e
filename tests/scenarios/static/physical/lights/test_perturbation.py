"""Lights on a car in the drives of suites of kind `gap`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ssad import World, build_episode, load_scenarios, load_town
from ssad.core.errors import FormatError
from ssad.core.frames import Camera
from ssad.rendering.onboard import Onboard
from ssad.rendering.sensor_suite import SensorSuite
from ssad.scenarios.static.catalogue import parse_perturbation, registered_names
from ssad.scenarios.static.physical.lights.export import export_light
from ssad.scenarios.static.physical.lights.perturbation import LightPerturbation


@pytest.fixture(scope="module")
def behind() -> World:
    scenario = load_scenarios("LaneChanging")[0]
    town = load_town(scenario.town)
    world = World([build_episode(scenario, town, seed=0)], {town.name: town})
    world.reset()
    return world


def seen(world: World, name: str, severity: int = 3) -> np.ndarray:
    suite = SensorSuite(cameras={"front": Camera.typical(192, 108)})
    light = parse_perturbation(name).make(severity)
    sensors = light.in_loop(suite, target=1, victim=None, seed=0).build()
    return sensors["front"](world, np.array([[0, 0]], np.int32))[0].astype(float)


@pytest.mark.parametrize("name", ["laser", "projector", "flashlight"])
def test_lamps_light_the_car_by_night_and_more_with_their_severity(behind: World, name: str) -> None:
    dark = seen(behind, "night")
    weak, strong = (np.clip(seen(behind, name, level) - dark, 0, None).sum() for level in (1, 5))
    assert strong > weak > 0.0
    assert dark.mean() < 0.75 * Onboard().camera(Camera.typical(192, 108))(behind, np.array([[0, 0]], np.int32)).mean()


def test_every_light_is_a_perturbation_and_a_shadow_takes_light_away(behind: World) -> None:
    names = sorted(name for name, family in registered_names().items() if family == "light")
    assert names == ["flashlight", "laser", "night", "projector", "shadow"]
    entries = [parse_perturbation(name) for name in names]
    assert [entry.name for entry in entries if entry.has_severities] == ["flashlight", "laser", "projector"]
    assert [entry.name for entry in entries if not entry.make(1).needs_target] == ["night"]
    assert LightPerturbation("shadow").hour == "recorded"
    edit = LightPerturbation("shadow").in_loop(SensorSuite(), target=1, victim=None, seed=0).agent_edit
    assert edit is not None
    (card,) = edit.body(behind.episodes[0].agents[1].model)[1].cards
    assert card.outline.shape == (3, 3)
    assert {entry.make(1).version() for entry in entries} == {""}


def test_a_light_that_was_found_shines_as_it_was_found(behind: World, tmp_path: Path) -> None:
    found = LightPerturbation("flashlight", 5).setup(0)
    export_light(tmp_path / "light", found)
    name = str(tmp_path / "light")
    np.testing.assert_array_equal(seen(behind, name), seen(behind, "flashlight", 5))
    assert not parse_perturbation(name).has_severities
    assert len(parse_perturbation({"light": name}).make(1).version()) == 64
    with pytest.warns(FutureWarning, match="old spelling"):
        assert parse_perturbation(f"shine:{name}").name == name
    (tmp_path / "light" / "light.json").write_text("{}")
    with pytest.raises(FormatError):
        parse_perturbation(name).make(1)
