"""Speed-limit signs that are read: in rendered images, and from image to image."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from ssad.core.errors import ConfigError
from ssad.core.rotations import upright_pose
from ssad.core.seeding import generator
from ssad.core.types import F64, U8
from ssad.drivers.lane_keeping.limit_signs import LIMITS, LimitMemory, LimitReading, Plate, find_plates
from ssad.rendering.bodies import make_body
from ssad.rendering.camera.render import SceneWeather, View, render
from ssad.rendering.camera.rig import rig_camera
from ssad.rendering.camera.scene import RenderScene, SceneObject
from ssad.scenarios.static.physical.street.signs import SignChange

CAMERA = rig_camera("CAM_FRONT", 640)
SIZE = (0.08, 0.66, 2.8)
FIGURES = ("30", "60", "80", "100", "120")
CHANGES = ("sticker-8", "cover", "yield", "sticker-blocks")
SIGN = upright_pose(13.0, -3.0, np.pi - 0.05)  # 13 m ahead, to the right of the lane


@cache
def image(style: str, sun_height: float = 0.7) -> U8:
    """Return the image of a sign, or of a sign of 30 km/h that has been changed."""
    names = (*FIGURES, *CHANGES)
    view = View(CAMERA, CAMERA.to_ego, (SceneObject(names.index(style), SIGN),), SceneWeather(sun_height, 2.5, 0.3))
    return np.moveaxis(np.asarray(render(scene(), [view]).image[0]), -1, 0)


@cache
def scene() -> RenderScene:
    signs = [make_body("limit_sign", style=name, size=SIZE, generator=generator("read", name)) for name in FIGURES]
    changed = [SignChange("limit-30", into).bodies()["limit_sign:30"] for into in CHANGES]
    return RenderScene(None, [*signs, *(body for body in changed if body is not None)])


@pytest.mark.parametrize("style", FIGURES)
def test_the_figures_of_a_sign_are_read(style: str) -> None:
    (plate,) = find_plates(image(style), CAMERA)
    expected = CAMERA.intrinsic @ (np.linalg.inv(CAMERA.to_ego) @ SIGN @ [0.0, 0.0, SIZE[2] - 0.33, 1.0])[:3]
    assert np.hypot(*(expected[:2] / expected[2] - plate.centre)) < 3.0
    assert plate.diameter == pytest.approx(CAMERA.intrinsic[0, 0] * SIZE[1] / expected[2], rel=0.12)
    assert plate.limit == int(style)
    assert plate.score > LimitReading().score


def test_a_low_sun_changes_no_figure() -> None:
    (plate,) = find_plates(image("60", 0.15), CAMERA)
    assert plate.limit == 60


def test_a_sticker_makes_another_limit_and_other_signs_are_none() -> None:
    (plate,) = find_plates(image("sticker-8"), CAMERA)
    assert plate.limit == 80
    for style in ("cover", "yield", "sticker-blocks"):
        assert all(plate.score < LimitReading().score for plate in find_plates(image(style), CAMERA)), style


def test_an_image_without_light_has_no_plates() -> None:
    assert find_plates(np.zeros((3, CAMERA.height, CAMERA.width), np.uint8), CAMERA) == []


def plate_of(limit: int, score: float = 0.95, *, diameter: float = 25.0, column: float = 420.0) -> Plate:
    correlations: F64 = np.full(len(LIMITS), 0.5)
    correlations[LIMITS.index(limit)] = score
    return Plate((column, 150.0), diameter, correlations)


def test_a_limit_holds_once_it_is_confirmed_and_until_the_next() -> None:
    memory = LimitMemory(LimitReading(confirm=2))
    pose = CAMERA.to_ego
    memory.update([plate_of(60)], CAMERA, pose)
    assert memory.limit is None
    memory.update([plate_of(60)], CAMERA, pose)
    assert memory.limit == 60
    for _ in range(3):
        memory.update([], CAMERA, upright_pose(40.0, 0.0, 0.0) @ pose)
    assert memory.limit == 60
    for _ in range(2):
        memory.update([plate_of(30)], CAMERA, upright_pose(80.0, 0.0, 0.0) @ pose)
    assert memory.limit == 30


def test_readings_of_two_signs_confirm_neither() -> None:
    memory = LimitMemory(LimitReading(confirm=2))
    memory.update([plate_of(60)], CAMERA, CAMERA.to_ego)
    memory.update([plate_of(60)], CAMERA, upright_pose(60.0, 0.0, 0.0) @ CAMERA.to_ego)
    assert memory.limit is None


def test_doubtful_readings_do_not_count() -> None:
    memory = LimitMemory(LimitReading(confirm=1))
    memory.update([plate_of(60, score=0.7)], CAMERA, CAMERA.to_ego)
    assert memory.limit is None
    memory.update([plate_of(60, score=0.9), plate_of(80, score=0.7, diameter=60.0)], CAMERA, CAMERA.to_ego)
    assert memory.limit == 60


def test_what_is_refused() -> None:
    with pytest.raises(ConfigError, match="confirm >= 1"):
        LimitReading(confirm=0)
    with pytest.raises(ConfigError, match="a score between 0 and 1"):
        LimitReading(score=1.0)
