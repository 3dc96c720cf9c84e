"""Textures on the road of recorded images: where they appear, and what they do to the light."""

from __future__ import annotations

import numpy as np
import pytest

from ssad.core.frames import Camera
from ssad.core.images import decode_srgb, encode_srgb
from ssad.core.rotations import upright_pose
from ssad.rendering.camera.scene_edit import SceneEdit
from ssad.scenarios.static.physical.street.dirty_road import road_decal
from ssad.scenarios.static.physical.street.placing import ROAD_ALBEDO, behind_target, paint_road

CAMERA = Camera.typical(320, 192)
IMAGE = np.full((192, 320, 3), 90, np.uint8)
OPAQUE = np.ones((8, 8), np.float32)


def test_codes_and_linear_values_are_inverse() -> None:
    codes = np.arange(256, dtype=np.uint8).reshape(1, -1)
    np.testing.assert_array_equal(encode_srgb(decode_srgb(codes)), codes)
    assert encode_srgb(np.array([[2.0]], np.float32))[0, 0] == 255


def test_paint_appears_where_the_road_is_and_keeps_the_light() -> None:
    texture = np.full((8, 8, 3), 2.0 * ROAD_ALBEDO, np.float32)
    place = upright_pose(15.0, 0.0, 0.0)
    painted = paint_road(IMAGE, CAMERA, np.eye(4), place, (10.0, 2.0), texture, light=None, opacity=OPAQUE)
    # By hand: 1.5 m below a camera that stands 1.7 m ahead of the ego's middle.
    row = round(96 + 0.79 * 320 * 1.5 / (15.0 - 1.7))
    ratio = decode_srgb(painted)[row, 160] / decode_srgb(IMAGE)[row, 160]
    np.testing.assert_allclose(ratio, 2.0, rtol=0.05)
    assert (painted[:100] == IMAGE[:100]).all()
    assert (painted[row, :100] == IMAGE[row, :100]).all()
    same = paint_road(IMAGE, CAMERA, np.eye(4), place, (10.0, 2.0), 0.5 * texture, light=None, opacity=OPAQUE)
    assert np.abs(same.astype(int) - IMAGE).max() <= 1  # asphalt on asphalt


def test_projected_light_adds_to_that_of_the_road_and_boxes_hide_it() -> None:
    texture, place = np.ones((8, 8, 3), np.float32), upright_pose(15.0, 0.0, 0.0)
    settings = {"light": 0.5, "opacity": OPAQUE}
    lit = paint_road(IMAGE, CAMERA, np.eye(4), place, (10.0, 2.0), texture, **settings)  # type: ignore[arg-type]
    row = round(96 + 0.79 * 320 * 1.5 / (15.0 - 1.7))
    np.testing.assert_allclose(decode_srgb(lit)[row, 160] / decode_srgb(IMAGE)[row, 160], 1.5, rtol=0.05)
    everything = np.array([(0, 0), (320, 0), (320, 192), (0, 192)], np.float32)
    hidden = paint_road(
        IMAGE,
        CAMERA,
        np.eye(4),
        place,
        (10.0, 2.0),
        texture,
        hidden=[everything],
        **settings,  # type: ignore[arg-type]
    )
    np.testing.assert_array_equal(hidden, IMAGE)


def test_nothing_is_painted_behind_the_camera() -> None:
    place = upright_pose(-15.0, 0.0, 0.0)
    texture = np.ones((8, 8, 3), np.float32)
    assert paint_road(IMAGE, CAMERA, np.eye(4), place, (10.0, 2.0), texture, light=None, opacity=OPAQUE) is IMAGE


def test_an_edit_lies_behind_a_target() -> None:
    edit = SceneEdit(decals=(road_decal((4.0, 2.0)),), textures={0: None})  # type: ignore[dict-item]
    moved = behind_target(edit, 5.0).decals[0].pose
    assert moved[0, 3] == pytest.approx(-5.0 - 0.5 * 4.7, abs=0.4)  # a sedan is about 4.7 m long
