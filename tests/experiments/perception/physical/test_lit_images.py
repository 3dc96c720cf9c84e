"""Recorded pictures at another hour, lit and shaded: in full, and as functions of light."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.bodies import plain_bodies

from ssad.core.errors import UnknownNameError
from ssad.core.images import read_image
from ssad.experiments.perception.physical.lit_images import RelightableImage, at_hour, relightable_images
from ssad.recorders.target_images import record_target_images
from ssad.recorders.target_recording import TargetRecording
from ssad.rendering.camera.render import SceneWeather
from ssad.rendering.hours import HOURS
from ssad.scenarios.static.physical.lights import Flashlight, Projector, Shadow
from ssad.scenarios.static.physical.lights.light import value_tensors


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, dict[str, RelightableImage]]]:
    out = tmp_path_factory.mktemp("lit") / "clips"
    with plain_bodies():
        record_target_images(TargetRecording(out, (("Twinford", 1),), (), size=320, behind=8.0), workers=0)
        yield out, {hour: next(relightable_images(out, hour)) for hour in ("recorded", "low_sun", "night")}


def test_an_hour_is_clear_and_has_the_suns_direction() -> None:
    rain = SceneWeather(0.7, 2.2, 0.95, fog=0.01, wet=0.5, turn=3.0)
    assert at_hour(rain, "recorded") == rain
    for hour in HOURS[1:]:
        shown = at_hour(rain, hour)
        assert (shown.sun_heading, shown.turn, shown.fog, shown.wet) == (2.2, 3.0, 0.0, 0.0)
    assert at_hour(rain, "night").sun_height < -0.2
    behind = at_hour(rain, "sun_behind", 0.4).sun_heading
    assert np.cos(behind - 0.4) < -0.9, "on the rear of a target that heads there"
    with pytest.raises(UnknownNameError, match="noon"):
        at_hour(rain, "non")


@pytest.mark.slow
def test_without_light_it_is_the_recorded_picture(clips: tuple[Path, dict[str, RelightableImage]]) -> None:
    folder, lit = clips
    recorded = read_image(next((folder / "images").iterdir()))
    assert np.array_equal(lit["recorded"].render(), recorded)


@pytest.mark.slow
@pytest.mark.parametrize("hour", ["low_sun", "night"])
def test_light_on_a_recorded_target(clips: tuple[Path, dict[str, RelightableImage]], hour: str) -> None:
    """The quick model and the full picture change alike, around the target; a projector is linear in its picture."""
    clip = clips[1][hour]
    target = clip.target
    light: Shadow | Flashlight = Shadow() if hour == "low_sun" else Flashlight()
    middle = {name: 0.5 * (low + high) for name, (low, high) in light.ranges(target).items()}
    middle |= {"left_b": 1.2, "up_c": 2.0, "lumens": 300.0}
    values = {name: value for name, value in middle.items() if name in light.ranges(target)}
    before, after = clip.render().astype(int), clip.render(light.edit(values, target)).astype(int)
    picture = clip.lit()
    quick = picture.show(light.change(value_tensors(values), picture, target))[0].permute(1, 2, 0).numpy() * 255
    x, y, w, h = next(one["bbox"] for one in clip.view.objects if one["target"])
    own = (slice(int(y), int(y + h)), slice(int(x), int(x + w)))
    assert np.abs(quick[own] - after[own]).mean() < 6
    if hour == "night":
        assert after[own].mean() > before[own].mean() + 8
        edit = Projector(lumens=60.0).edit(torch.ones(3, 16, 16), target)
        shown = clip.projected(edit).prepare({0: 16}).show({0: edit.textures[0]})[0].permute(1, 2, 0).numpy() * 255
        assert np.abs(shown[own] - clip.render(edit)[own]).mean() < 6
