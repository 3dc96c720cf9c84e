"""Boxes against worked examples in the conventions of nuScenes, mmdetection3d and KITTI, and stored answers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import mono3d_case

from ssad.core.boxes import TrackedBoxes, WorldBoxes, bottom_centre, camera_axes, camera_yaw, size_columns
from ssad.core.detections import Solids
from ssad.core.rotations import matrix_to_quaternion, quaternion_to_yaw, yaw_to_quaternion
from ssad.core.tensor_boxes import solid_corners

STORED = Path(__file__).parent.parent / "data" / "mmdet3d" / "export.npz"
# a car 4 m long, 2 m wide and 1.5 m high that looks along y; its middle is 0.75 m over (10, 20, 0)
CAR = WorldBoxes(
    np.array([[10.0, 20.0, 0.75]]), np.array([[4.0, 2.0, 1.5]]), yaw_to_quaternion([np.pi / 2]), np.zeros((1, 3))
)
# a camera 1 m over the origin that looks along y: right is x, down is -z
CAMERA = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 1], [0, 0, 0, 1]])


def test_nuscenes_says_width_first() -> None:
    assert CAR.size_wlh.tolist() == [[2.0, 4.0, 1.5]]
    assert CAR.size_wlh[:, size_columns("wlh", "lwh")].tolist() == CAR.size_lwh.tolist()


def test_corners_and_axes_of_a_turned_box() -> None:
    forward, left, up = CAR.axes()[0].T
    assert forward == pytest.approx([0, 1, 0])
    assert left == pytest.approx([-1, 0, 0])
    assert up == pytest.approx([0, 0, 1])
    points = CAR.corners()[0]
    assert points.min(0) == pytest.approx([9, 18, 0])
    assert points.max(0) == pytest.approx([11, 22, 1.5])
    assert points[-1] == pytest.approx([9, 22, 1.5])  # front left top


def in_camera(boxes: WorldBoxes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centre, size (l, h, w) and yaw in the camera's frame."""
    centre = (boxes.centre - CAMERA[:3, 3]) @ CAMERA[:3, :3]
    yaw = camera_yaw(boxes.axes()[:, :, 0] @ CAMERA[:3, :3])
    return centre, boxes.size_lwh[:, size_columns("lwh", "lhw")], yaw


def test_a_car_ahead_as_mmdetection3d_and_kitti_write_it() -> None:
    """KITTI: rotation_y is -pi / 2 for a car that drives away from the camera, its location lies on the road."""
    centre, size_lhw, yaw = in_camera(CAR)
    assert centre[0] == pytest.approx([10.0, 0.25, 20.0])
    assert size_lhw.tolist() == [[4.0, 1.5, 2.0]]
    assert yaw == pytest.approx([-np.pi / 2])
    assert bottom_centre(centre, size_lhw)[0] == pytest.approx([10.0, 1.0, 20.0])
    assert size_lhw[:, size_columns("lhw", "hwl")].tolist() == [[1.5, 2.0, 4.0]]


@pytest.mark.parametrize(("heading", "yaw"), [(0.0, 0.0), (90.0, -90.0), (-90.0, 90.0), (45.0, -45.0), (170.0, -170.0)])
def test_yaw_in_the_camera_turns_from_x_away_from_the_way_it_looks(heading: float, yaw: float) -> None:
    """CAMERA looks along y: headings in the world are its yaw with the sign turned."""
    car = WorldBoxes(CAR.centre, CAR.size_lwh, yaw_to_quaternion([np.radians(heading)]), CAR.velocity)
    assert np.degrees(in_camera(car)[2]) == pytest.approx([yaw])


def test_the_way_into_the_camera_and_back() -> None:
    draws = np.random.default_rng(1)
    yaw = draws.uniform(-np.pi, np.pi, 50)
    centre, size_lwh = draws.normal(size=(50, 3)), draws.uniform(1, 5, (50, 3))
    boxes = WorldBoxes(centre, size_lwh, yaw_to_quaternion(yaw), np.zeros((50, 2)))
    centre, size_lhw, turned = in_camera(boxes)
    axes = CAMERA[:3, :3] @ camera_axes(turned)
    assert axes == pytest.approx(boxes.axes(), abs=1e-12)
    assert np.cos(quaternion_to_yaw(matrix_to_quaternion(axes)) - yaw) == pytest.approx(np.ones(50))
    # the same corners as those that detectors are trained and drawn with
    solid = Solids(*map(torch.from_numpy, (centre, size_lhw, turned, np.zeros((50, 2)), np.zeros(50, int))))
    seen = solid_corners(solid.centre, solid.size_lhw, solid.yaw).numpy() @ CAMERA[:3, :3].T + CAMERA[:3, 3]
    for mine, theirs in zip(boxes.corners(), seen, strict=True):
        assert sorted(map(tuple, mine.round(6) + 0.0)) == sorted(map(tuple, theirs.round(6) + 0.0))


def test_bottom_centre_of_tensors_is_that_of_arrays() -> None:
    centre, size_lhw, _ = in_camera(CAR)
    found = bottom_centre(torch.from_numpy(centre), torch.from_numpy(size_lhw))
    assert found.tolist() == bottom_centre(centre, size_lhw).tolist()
    assert centre[0, 1] == pytest.approx(0.25)  # the input stays


def test_sizes_and_turns_are_those_that_mmdetection3d_exported() -> None:
    """Its export keeps scores: a row's detection is found by its score."""
    with np.load(STORED) as stored:
        exported = {name: stored[name] for name in ("score", "size", "rotation", "translation")}
    to_ego, to_world = mono3d_case.rig(seed=3)
    checked = 0
    for camera, pose in zip(mono3d_case.sightings(seed=3), to_world @ to_ego, strict=True):
        for n, score in enumerate(camera["score"]):
            rows = np.flatnonzero(np.abs(exported["score"] - score) < 1e-9)
            if len(rows) != 1:
                continue
            row, checked = int(rows[0]), checked + 1
            assert exported["size"][row] == pytest.approx(camera["size"][n, size_columns("lhw", "wlh")], rel=1e-6)
            centre = pose[:3, :3] @ camera["centre"][n] + pose[:3, 3]
            assert exported["translation"][row] == pytest.approx(centre, abs=1e-4)
            upright = matrix_to_quaternion(pose[:3, :3] @ camera_axes(camera["yaw"][n : n + 1]))[0]
            assert abs(upright @ exported["rotation"][row]) > 0.999  # it stands upright in the camera that looks ahead
    assert checked > 40


def test_rows_are_taken_by_mask_and_by_position() -> None:
    boxes = TrackedBoxes(np.eye(3), np.eye(3) + 1, np.ones((3, 4)), np.zeros((3, 3)), ("a", "b", "c"), np.arange(3.0))
    assert boxes.take(np.array([False, True, True])).instance == ("b", "c")
    last = boxes.take(np.array([2, 0]))
    assert last.instance == ("c", "a")
    assert last.visible.tolist() == [2.0, 0.0]
    assert last.centre.tolist() == [[0, 0, 1], [1, 0, 0]]
    assert len(last) == 2
    assert len(TrackedBoxes.empty()) == 0
    assert TrackedBoxes.empty().corners().shape == (0, 8, 3)
