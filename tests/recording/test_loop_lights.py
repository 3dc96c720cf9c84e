"""Lights on a car in the drives of suites of kind `gap`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ssad import World, build_episode, load_scenarios, load_town
from ssad.core.errors import FormatError
from ssad.core.frames import Camera
from ssad.experiments.gap.loop_perturbations import family_of, has_severities, is_worn, texture_version, worn
from ssad.rendering.hours import at_hour
from ssad.rendering.onboard import DAY, Onboard
from ssad.scenarios.static.physical.lights.export import export_light
from ssad.scenarios.static.physical.lights.loop import LIT, hour_of, light_version, shining


@pytest.fixture(scope="module")
def behind() -> World:
    scenario = load_scenarios("LaneChanging")[0]
    town = load_town(scenario.town)
    world = World([build_episode(scenario, town, seed=0)], {town.name: town})
    world.reset()
    return world


def seen(world: World, name: str, severity: int = 3) -> np.ndarray:
    attack = worn(name, 1, severity=severity) if is_worn(name) else None
    onboard = Onboard(weather=at_hour(DAY, hour_of(name)), attack=attack)
    camera = Camera.typical(192, 108)
    return onboard.camera(camera)(world, np.array([[0, 0]], np.int32))[0].astype(float)


@pytest.mark.parametrize("name", ["shine-laser", "shine-projector", "shine-flashlight"])
def test_lamps_light_the_car_by_night_and_more_with_their_severity(behind: World, name: str) -> None:
    dark = seen(behind, "night")
    weak, strong = (np.clip(seen(behind, name, level) - dark, 0, None).sum() for level in (1, 5))
    assert strong > weak > 0.0
    assert dark.mean() < 0.6 * Onboard().camera(Camera.typical(192, 108))(behind, np.array([[0, 0]], np.int32)).mean()


def test_every_light_is_a_perturbation_and_a_shadow_takes_light_away(behind: World) -> None:
    assert {family_of(name) for name in LIT} == {"light"}
    assert [name for name in LIT if has_severities(name)] == ["shine-laser", "shine-projector", "shine-flashlight"]
    assert [name for name in LIT if not is_worn(name)] == ["night"]
    assert hour_of("shine-shadow") == "recorded"
    (card,) = worn("shine-shadow", 1).body(behind.episodes[0].agents[1].model)[1].cards
    assert card.outline.shape == (3, 3)
    assert {texture_version(name) for name in LIT} == {""}


def test_a_light_that_was_found_shines_as_it_was_found(behind: World, tmp_path: Path) -> None:
    found = shining("shine-flashlight", 5)
    export_light(tmp_path / "light", found)
    name = f"shine:{tmp_path / 'light'}"
    np.testing.assert_array_equal(seen(behind, name), seen(behind, "shine-flashlight", 5))
    assert not has_severities(name)
    assert len(light_version(name)) == 64
    with pytest.raises(FormatError):
        family_of(f"shine:{tmp_path}")
