"""Textures on cars in photographs: where they lie, what they leave, and how they are lit."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ssad.core.errors import ConfigError
from ssad.rendering.camera.texture import PRINTABLE
from ssad.scenarios.static.physical.textures.photographs import face_print, face_quad, light_on, paste

INTRINSIC = np.array([[100.0, 0.0, 80.0], [0.0, 100.0, 48.0], [0.0, 0.0, 1.0]])
BEHIND = np.array([0.0, 0.0, 12.0, 4.0, 1.6, 2.0, -np.pi / 2])
"""A car straight ahead that drives away."""
BOX = np.array([70.0, 40.0, 90.0, 56.0])
FACE = (0.0, 0.0, 1.0, 1.0)


def test_the_rear_of_a_car_ahead_is_where_it_projects() -> None:
    quad = face_quad(FACE, BOX, BEHIND, INTRINSIC)
    # the rear is 10 m ahead, 2 m wide and 1.6 m high
    assert quad == pytest.approx(np.array([[70, 40], [90, 40], [90, 56], [70, 56]]))
    part = face_quad((0.25, 0.5, 0.75, 1.0), BOX, BEHIND, INTRINSIC)
    assert part == pytest.approx(np.array([[75, 48], [85, 48], [85, 56], [75, 56]]))


def test_an_oncoming_car_shows_its_front_and_a_crossing_one_nothing() -> None:
    oncoming, crossing = BEHIND.copy(), BEHIND.copy()
    oncoming[6], crossing[6] = np.pi / 2, 0.0
    assert face_quad(FACE, BOX, oncoming, INTRINSIC) == pytest.approx(face_quad(FACE, BOX, BEHIND, INTRINSIC))
    assert face_quad(FACE, BOX, crossing, INTRINSIC) is None


def test_a_turned_car_shows_a_face_in_perspective() -> None:
    turned = BEHIND.copy()
    turned[6] += 0.5
    quad = face_quad(FACE, BOX, turned, INTRINSIC)
    assert quad is not None
    left, right = quad[3, 1] - quad[0, 1], quad[2, 1] - quad[1, 1]
    assert abs(left - right) > 0.5


def test_a_print_is_foreshortened_like_the_face_that_it_lies_on() -> None:
    """The middle of a print is where the middle of the face projects, nearer to its far side than to its near one."""
    near = np.array([0.0, 0.0, 5.0, 4.0, 1.6, 2.0, BEHIND[6] + 0.6])
    intrinsic = np.array([[400.0, 0.0, 320.0], [0.0, 400.0, 240.0], [0.0, 0.0, 1.0]])
    quad, half = (face_quad((0.0, 0.0, right, 1.0), BOX, near, intrinsic) for right in (1.0, 0.5))
    assert quad is not None
    assert half is not None
    black_and_white = torch.zeros(3, 64, 64)
    black_and_white[:, :, 32:] = 1.0
    image = np.full((480, 640, 3), 118, np.uint8)
    pasted = paste(image, black_and_white, np.ones((64, 64), np.bool_), quad, light=np.ones(3, np.float32))
    is_white = pasted[240, :, 0] > 200
    edge, expected = int(is_white.argmax()), float(half[1:3, 0].mean())
    assert edge == pytest.approx(expected, abs=4.0)
    assert abs(expected - float(quad[:, 0].mean())) > 10.0, "an affine print would have its middle elsewhere"


def test_without_a_3d_box_the_2d_box_is_the_face() -> None:
    unknown = np.full(7, np.nan)
    assert face_quad((0.5, 0.5, 1.0, 1.0), BOX, unknown, None)[0] == pytest.approx([80, 48])  # type: ignore[index]
    wide = np.array([0.0, 0.0, 60.0, 20.0])
    assert face_quad(FACE, wide, unknown, None) is None


def test_a_print_changes_what_it_covers_alone() -> None:
    image = np.full((96, 160, 3), 118, np.uint8)  # 0.18 linear: a grey world under a light of one
    mask = np.ones((4, 8), np.bool_)
    mask[:, 4:] = False
    quad = np.array([[20.0, 10.0], [60.0, 10.0], [60.0, 30.0], [20.0, 30.0]])
    pasted = paste(image, torch.ones(3, 4, 8), mask, quad, light=light_on(image, np.array([20.0, 10.0, 60.0, 30.0])))
    changed = np.argwhere((pasted != image).any(2))
    assert changed.min(0).tolist() == [10, 20]
    assert changed.max(0).tolist()[0] == 29
    assert 38 <= changed.max(0)[1] <= 42  # half a texel of blending at the edge of the mask
    white = PRINTABLE[1]
    expected = 255 * (1.055 * white ** (1 / 2.4) - 0.055)
    assert pasted[20, 25].tolist() == pytest.approx([expected] * 3, abs=2)
    dark = paste(image // 2, torch.ones(3, 4, 8), mask, quad, light=light_on(image // 2, np.array([20.0, 10, 60, 30])))
    assert dark[20, 25, 0] < pasted[20, 25, 0] - 50


def test_a_print_at_the_border_is_cut() -> None:
    image = np.full((40, 40, 3), 100, np.uint8)
    quad = np.array([[-30.0, 10.0], [10.0, 10.0], [10.0, 30.0], [-30.0, 30.0]])
    pasted = paste(image, torch.zeros(3, 4, 4), np.ones((4, 4), np.bool_), quad, light=np.ones(3, np.float32))
    assert (pasted[15, :9] < 50).all()
    assert (pasted[15, 11:] == 100).all()
    beyond = paste(image, torch.zeros(3, 4, 4), np.ones((4, 4), np.bool_), quad + 100, light=np.ones(3, np.float32))
    assert np.array_equal(beyond, image)


def test_shipped_textures_lie_on_the_rear_of_their_car() -> None:
    patch, paint = face_print("adv-patch-yolov5n-twinford"), face_print("das-yolov5n-twinford")
    for worn in (patch, paint):
        left, top, right, bottom = worn.rectangle
        assert -0.05 < left < 0.1
        assert 0.9 < right < 1.05
        assert 0 < top < bottom < 1
        assert worn.mask.shape == tuple(worn.colour.shape[1:])
        assert 0.3 < worn.mask.mean() < 1
    with pytest.raises(ConfigError, match="made for a car"):
        face_print("adv-patch-yolov5n-stop-sign-twinford")
