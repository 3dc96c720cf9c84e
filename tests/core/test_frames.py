"""Frames of reference by hand: quaternions, poses, and where a typical camera looks."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssad.core.boxes import TrackedBoxes
from ssad.core.frames import Camera, Frame, camera_to_world
from ssad.core.rotations import pose_matrix, quaternion_to_matrix

HALF = np.sqrt(0.5)


@pytest.mark.parametrize(
    ("quaternion", "x", "y", "z"),
    [
        ((1, 0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)),
        ((HALF, HALF, 0, 0), (1, 0, 0), (0, 0, 1), (0, -1, 0)),  # a quarter about x: y goes to z
        ((HALF, 0, HALF, 0), (0, 0, -1), (0, 1, 0), (1, 0, 0)),  # about y: z goes to x
        ((HALF, 0, 0, HALF), (0, 1, 0), (-1, 0, 0), (0, 0, 1)),  # about z: x goes to y
        ((2, 0, 0, -2), (0, -1, 0), (1, 0, 0), (0, 0, 1)),  # normalised; the other way round
        ((0.5, 0.5, 0.5, 0.5), (0, 1, 0), (0, 0, 1), (1, 0, 0)),  # a third about the diagonal
    ],
)
def test_rotations_take_the_axes_where_they_belong(
    quaternion: tuple[float, ...], x: tuple[int, ...], y: tuple[int, ...], z: tuple[int, ...]
) -> None:
    assert quaternion_to_matrix(np.array(quaternion, float)) == pytest.approx(np.stack([x, y, z], 1), abs=1e-12)


part = st.floats(-1.0, 1.0)


@given(st.tuples(part, part, part, part).filter(lambda q: sum(v * v for v in q) > 0.01))
def test_rotations_are_rotations_and_batched(quaternion: tuple[float, ...]) -> None:
    q = np.array(quaternion)
    matrix = quaternion_to_matrix(q)
    assert matrix @ matrix.T == pytest.approx(np.eye(3), abs=1e-9)
    assert np.linalg.det(matrix) == pytest.approx(1.0)
    assert (quaternion_to_matrix(np.stack([[q, -q]])) == matrix).all(), "q and -q are one rotation"


def test_a_pose_turns_and_then_moves() -> None:
    pose = pose_matrix(np.array([10.0, 20.0, 30.0]), np.array([HALF, 0, 0, HALF]))
    assert pose @ [1.0, 0.0, 0.0, 1.0] == pytest.approx([10.0, 21.0, 30.0, 1.0])
    assert pose[3].tolist() == [0, 0, 0, 1]


def test_a_typical_camera_looks_forward_from_above_the_road() -> None:
    camera = Camera.typical(1600, 900, channel="CAM_FRONT")
    assert camera.channel == "CAM_FRONT"
    assert camera.intrinsic.tolist() == [[1264.0, 0, 800.0], [0, 1264.0, 450.0], [0, 0, 1]]
    # 10 m ahead of the lens, on its axis; 2 m to the right of that; 1 m up
    for point, pixel in (((0, 0, 10), (800.0, 450.0)), ((2, 0, 10), (1052.8, 450.0)), ((0, -1, 10), (800.0, 323.6))):
        u, v, w = camera.intrinsic @ point
        assert (u / w, v / w) == pytest.approx(pixel)
    assert camera.to_ego @ [0, 0, 10, 1] == pytest.approx([11.7, 0, 1.5, 1]), "z is forward, from the lens"
    assert camera.to_ego @ [2, 0, 10, 1] == pytest.approx([11.7, -2, 1.5, 1]), "x is right"
    assert camera.to_ego @ [0, -1, 10, 1] == pytest.approx([11.7, 0, 2.5, 1]), "y is down"


def test_cameras_do_not_share_their_pose() -> None:
    one, other = Camera.typical(16, 9), Camera.typical(16, 9)
    one.to_ego[0, 3] = 99
    assert other.to_ego[0, 3] == 1.7


def test_camera_to_world_goes_through_the_ego() -> None:
    ego = pose_matrix(np.array([100.0, 0, 0]), np.array([HALF, 0, 0, HALF]))  # drives north
    pose = camera_to_world(Frame(Camera.typical(16, 9), ego_to_world=ego))
    assert pose @ [0, 0, 10, 1] == pytest.approx([100.0, 11.7, 1.5, 1])


def test_no_boxes_have_the_shapes_of_boxes() -> None:
    none = TrackedBoxes.empty()
    assert len(none) == 0
    shapes = [getattr(none, name).shape for name in ("centre", "size_lwh", "rotation", "velocity", "visible")]
    assert shapes == [(0, 3), (0, 3), (0, 4), (0, 3), (0,)]
