"""The shifts of objects on images: where they are then, what hides them, how they blur."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.boxes import CAMERA, GREY, cars, drawn, outline
from hypothesis import given, settings
from hypothesis import strategies as st

from ssad.core.frames import FORWARD, Frame, SceneContext
from ssad.core.rotations import quaternion_to_matrix
from ssad.core.types import U8
from ssad.scenarios.static.shifts import (
    ShiftSpec,
    shift_images,
    transformed_boxes,
)
from ssad.scenarios.static.shifts import parameters as table
from ssad.scenarios.static.shifts.objects import deformations

BOTH = ("physical", "paper")


def one(image: U8, frame: Frame, spec: ShiftSpec) -> U8:
    return np.asarray(shift_images(image, frame, spec, contexts={frame.scene: SceneContext(frame.scene, 0.8)})[0])


def coloured(image: U8, colour: tuple[int, int, int]) -> Any:
    """Extent (x0, y0, x1, y1) of the pixels near a colour."""
    mask = (np.abs(image.astype(int) - colour) < 40).all(axis=2)
    y, x = np.nonzero(mask)
    return np.array([x.min(), y.min(), x.max(), y.max()])


@pytest.mark.parametrize("severity", [1, 3, 5])
@pytest.mark.parametrize("name", ["scale", "rotation", "shear"])
def test_an_object_fills_its_new_box(name: str, severity: int) -> None:
    boxes = cars((12.0, 0.5, 0.8))
    image = drawn(boxes, [(220, 30, 30)])
    for seed in range(3):
        spec = ShiftSpec(name, severity, seed)
        out = one(image, Frame(CAMERA, "s", boxes=boxes), spec)
        new = transformed_boxes(spec, boxes, scene="s", sample="")
        corners = outline(new)
        if name == "shear":  # its label is the least box that holds it: project the sheared one
            d = deformations(spec, boxes, scene="s", sample="")[0]
            cube = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0, 1)]) * [4.0, 1.8, 1.6]
            local = (cube @ d.T + [12.0, 0.5, 0.0] - FORWARD[:3, 3]) @ FORWARD[:3, :3]
            k = CAMERA.intrinsic
            corners = local[:, :2] / local[:, 2:] * [k[0, 0], k[1, 1]] + [k[0, 2], k[1, 2]]
        expected = np.array([*corners.min(0), *corners.max(0)])
        assert np.abs(coloured(out, (220, 30, 30)) - expected).max() < 4.0


@given(st.integers(1, 5), st.integers(0, 50), st.floats(-3, 3), st.sampled_from(["scale", "shear", "rotation"]))
@settings(max_examples=60, deadline=None)
def test_labels_follow_the_objects(severity: int, seed: int, yaw: float, name: str) -> None:
    half = yaw / 2
    boxes = replace(cars((9.0, 2.0, 0.8)), rotation=np.array([[np.cos(half), 0, 0, np.sin(half)]]))
    spec = ShiftSpec(name, severity, seed)
    new = transformed_boxes(spec, boxes, scene="s", sample="t")
    bottom = new.centre[0, 2] - new.size_lwh[0, 2] / 2
    assert abs(bottom) < 1e-9, "objects stay on the ground"
    d = deformations(spec, boxes, scene="s", sample="t")[0]
    if name == "scale":
        assert new.size_lwh[0] == pytest.approx(boxes.size_lwh[0] * d[0, 0])
        assert abs(d[0, 0] - 1) == pytest.approx(table.SCALE[severity - 1])
    if name == "rotation":
        turned = quaternion_to_matrix(new.rotation[0]) @ quaternion_to_matrix(boxes.rotation[0]).T
        angle = np.degrees(np.arccos((np.trace(turned) - 1) / 2))
        assert abs(angle - table.ROTATION[severity - 1]) <= table.ROTATION_SPREAD + 1e-6
        assert new.size_lwh[0] == pytest.approx(boxes.size_lwh[0])
    if name == "shear":
        cube = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0, 1)]) * [4.0, 1.8, 1.6]
        world = cube @ d.T @ quaternion_to_matrix(boxes.rotation[0]).T + [9.0, 2.0, 0.0]
        local = (world - new.centre[0]) @ quaternion_to_matrix(new.rotation[0]) / new.size_lwh[0]
        assert np.abs(local).max() == pytest.approx(0.5, abs=1e-9)


def test_what_hides_an_object_goes_on_hiding_it() -> None:
    boxes = cars((16.0, 0.0, 0.8), (9.0, 1.0, 0.8))  # the second stands in front of the first
    image = drawn(boxes, [(220, 30, 30), (30, 30, 220)])
    front = cv2.erode((image == (30, 30, 220)).all(axis=2).astype(np.uint8), np.ones((3, 3))) > 0
    # only the far car moves: the near one is parked and does not turn
    far = replace(boxes, visible=np.array([1.0, 0.0]))
    for seed in range(6):
        out, done = shift_images(image, Frame(CAMERA, "s", boxes=far), ShiftSpec("scale", 5, seed))
        assert done[0].details["objects"] == 1
        assert done[0].skipped == {"hidden by others": 1}
        assert (out[front] == (30, 30, 220)).all()


def test_an_instance_keeps_its_draw_and_the_paper_draws_one_a_sample() -> None:
    boxes = cars((12.0, 0.0, 0.8), (14.0, 3.0, 0.8), (20.0, -3.0, 0.8))
    spec = ShiftSpec("rotation", 3)
    found = deformations(spec, boxes, scene="s", sample="a")
    assert (found == deformations(spec, boxes, scene="s", sample="b")).all()
    assert not np.allclose(found[0], found[1])
    paper = ShiftSpec("rotation", 3, calibration="paper")
    found = deformations(paper, boxes, scene="s", sample="a")
    assert np.allclose(found, found[0])
    assert not np.allclose(found, deformations(paper, boxes, scene="s", sample="b"))


def test_boxes_behind_and_across_the_camera_do_no_harm() -> None:
    boxes = cars((-8.0, 0.0, 0.8), (0.5, 0.0, 0.8), (12.0, 60.0, 0.8))
    for name in ("scale", "shear", "rotation", "motion_blur"):
        for calibration in BOTH:
            out, done = shift_images(GREY, Frame(CAMERA, "s", boxes=boxes), ShiftSpec(name, 5, 0, calibration))
            assert (out == GREY).all()
            assert not done[0].applied
            assert done[0].skipped.get("too near the camera", 0) <= 1


@pytest.mark.parametrize("velocity", [(0.0, 6.0, 0.0), (0.0, -9.0, 0.0)])
def test_blur_is_a_box_filter_along_the_motion(velocity: tuple[float, float, float]) -> None:
    boxes = cars((12.0, 0.0, 0.8), velocity=velocity)
    image = drawn(replace(boxes, size_lwh=boxes.size_lwh * 0.95), [(250, 250, 250)])  # well inside its box
    spec = ShiftSpec("motion_blur", 5)
    out = one(image, Frame(CAMERA, "s", boxes=boxes), spec).astype(float)
    k = CAMERA.intrinsic
    length = abs(velocity[1]) * table.BLUR_EXPOSURE[4] * k[0, 0] / (12.0 - FORWARD[0, 3])
    y = int(outline(boxes)[:, 1].mean())
    row = out[y, :, 0]
    ramp = np.flatnonzero((row > 140) & (row < 240))
    left = ramp[ramp < outline(boxes)[:, 0].mean()]
    assert len(left) == pytest.approx(length * (100 / 122), abs=3.0)
    assert np.diff(row[left[0] : left[-1]]).min() >= -1, "a ramp"
    still = replace(boxes, velocity=np.full((1, 3), np.nan))
    out, done = shift_images(image, Frame(CAMERA, "s", boxes=still), spec)
    assert done[0].skipped == {"its velocity is unknown": 1}
    assert (out == image).all()
