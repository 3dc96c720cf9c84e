"""Street lighting by class, measured in rendered images of a town."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from ssad.core.colours import LUMINANCE
from ssad.core.errors import UnknownNameError
from ssad.core.frames import Camera
from ssad.rendering.camera.effects import NO_EFFECTS, select_effects
from ssad.rendering.camera.lamps import NIGHT_LUX
from ssad.rendering.camera.render import RenderQuality, SceneWeather, View, render, scene_light
from ssad.rendering.camera.scene import RenderScene
from ssad.rendering.camera.street_lighting import (
    LIGHTING_CLASSES,
    UNLIT,
    luminaire_power,
    road_illuminance,
    sample_road,
    unit_illuminance,
)
from ssad.rendering.street import STYLES, cached_street

NIGHT = SceneWeather(-0.3, clouds=0.4)
CAMERA = Camera(64, 64, np.array([[64.0, 0, 32.0], [0, 64.0, 32.0], [0, 0, 1]]))
DOWN = np.diag([1.0, -1.0, -1.0, 1.0])


@cache
def town() -> RenderScene:
    return RenderScene(cached_street("Twinford"), [])


def fields() -> list[View]:
    """Views from above of fields between two lamps of a row, at a few places of the town."""
    street = town().street
    assert street is not None
    lamps = street.lamps.astype(float)
    views = []
    for x, y, _, heading in lamps[:: len(lamps) // 8]:
        pose = DOWN.copy()
        # Half the spacing along the row, and a little across the road.
        pose[:3, 3] = (x + 2.0 * np.cos(heading), y + 2.0 * np.sin(heading), STYLES[street.style].lamp)
        views.append(View(CAMERA, pose, weather=NIGHT))
    return views


def illuminance(lighting: str, *, effects: frozenset[str] = NO_EFFECTS) -> tuple[float, float]:
    """Illuminance of the asphalt of the fields under street lighting, lux: its mean, and its least of a hundredth."""
    views = [replace(view, weather=replace(NIGHT, lighting=lighting)) for view in fields()]
    found = render(town(), views, quality=RenderQuality(effects=effects), surface=True, materials=True)
    assert found.surface is not None
    assert found.material is not None
    is_road = np.char.startswith(np.array(town().material_names)[found.material], "asphalt")
    (_, _, zenith, horizon, *_), _ = scene_light(views[0].weather)
    sky = 0.65 * np.array(zenith) + 0.35 * np.array(horizon)
    lux = (found.surface.irradiance[is_road] - sky) @ LUMINANCE / NIGHT_LUX
    return float(lux.mean()), float(np.quantile(lux, 0.01))


@pytest.mark.parametrize("lighting", ["M4", "P5"])
def test_a_road_has_the_illuminance_of_its_class(lighting: str) -> None:
    """Integrated over the carriageway between lamps, as EN 13201-3 has it; some fields stand for the whole town."""
    mean, least = illuminance(lighting)
    assert mean == pytest.approx(road_illuminance(lighting), rel=0.12)
    assert least > 0.2 * mean, "no dark gaps between lamps: class P allows for a fifth of the mean"


def test_without_a_class_streets_are_darker_and_uneven() -> None:
    mean, least = illuminance("")
    assert mean < 0.5 * road_illuminance("M4")
    assert least < 0.05 * mean
    assert illuminance("", effects=select_effects("street-lighting"))[0] == pytest.approx(
        illuminance("M4")[0], rel=1e-6
    )


@pytest.mark.parametrize("clouds", [0.0, 0.9])
def test_an_unlit_night_has_one_lux(clouds: float) -> None:
    """On level ground in the open; lamps of the street are off and dark."""
    views = [replace(view, weather=replace(NIGHT, clouds=clouds, lighting=UNLIT)) for view in fields()]
    found = render(town(), views, quality=RenderQuality(effects=NO_EFFECTS), surface=True, materials=True)
    assert found.surface is not None
    assert found.material is not None
    names = np.array(town().material_names)[found.material]
    lux = found.surface.irradiance @ LUMINANCE / NIGHT_LUX
    is_level_road = np.char.startswith(names, "asphalt") & (found.surface.normal[..., 2] > 0.9999)
    assert is_level_road.sum() > 1000
    assert lux[is_level_road] == pytest.approx(1.0, rel=1e-3)


def test_street_lamps_glow_unless_the_street_is_unlit() -> None:
    street = town().street
    assert street is not None
    x, y, z, _ = street.lamps[0].astype(float)
    up = np.diag([1.0, 1.0, 1.0, 1.0])
    up[:3, 3] = x, y, z - 3.0
    views = [View(CAMERA, up, weather=replace(NIGHT, lighting=lighting)) for lighting in ("M4", UNLIT)]
    lit, dark = render(town(), views).radiance[:, 32, 32].mean(-1)
    assert lit > 2.0
    assert dark < 0.1


def test_classes_have_the_light_of_the_standard() -> None:
    assert [round(road_illuminance(name), 1) for name in LIGHTING_CLASSES] == [
        *(28.6, 21.4, 14.3, 10.7, 7.1, 4.3),
        *(15.0, 10.0, 7.5, 5.0, 3.0, 2.0),
        1.0,
    ]
    with pytest.raises(UnknownNameError, match=r"street lighting.*M9"):
        SceneWeather(lighting="M9")


def test_the_power_of_luminaires_follows_from_their_light_on_the_road() -> None:
    street = cached_street("Twinford")
    mean = float(unit_illuminance(sample_road(street)).mean())
    assert luminaire_power(street, "P2", 1.0) * mean == pytest.approx(10.0)
    assert luminaire_power(street, UNLIT, 1.0) == 0.0
    no_lamps = replace(street, lamps=street.lamps[:0])
    assert luminaire_power(no_lamps, "M1", 1.0) == 0.0
