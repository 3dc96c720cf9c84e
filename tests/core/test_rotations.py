"""Rotations against closed forms and invariants."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ssad.core.rotations import (
    matrix_to_quaternion,
    pose_matrix,
    quaternion_product,
    quaternion_to_matrix,
    quaternion_to_yaw,
    slerp,
    upright_pose,
    wrap_angle,
    yaw_to_quaternion,
)

angle = st.floats(-50.0, 50.0)
quaternion = arrays(np.float64, 4, elements=st.floats(-1.0, 1.0)).filter(lambda q: np.linalg.norm(q) > 1e-3)
third = np.sqrt(1 / 3)
# quaternions and what they do to x, y and z: a third of a turn about the diagonal, half turns, one about an edge
KNOWN = [
    ((1.0, 0.0, 0.0, 0.0), "x y z"),
    ((0.5, 0.5, 0.5, 0.5), "y z x"),
    ((0.5, -0.5, 0.5, -0.5), "-y -z x"),  # camera that looks along x: right, down, ahead
    ((0.0, 1.0, 0.0, 0.0), "x -y -z"),
    ((0.0, 0.0, 1.0, 0.0), "-x y -z"),
    ((0.0, 0.0, 0.0, 1.0), "-x -y z"),
    ((0.0, np.sqrt(0.5), -np.sqrt(0.5), 0.0), "-y -x -z"),
    ((np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)), "y -x z"),
]
AXES = {sign + name: (-1.0 if sign else 1.0) * np.eye(3)[k] for sign in ("", "-") for k, name in enumerate("xyz")}


@pytest.mark.parametrize(("turn", "axes"), KNOWN, ids=[axes for _, axes in KNOWN])
def test_known_rotations_both_ways(turn: tuple[float, ...], axes: str) -> None:
    expected = np.stack([AXES[name] for name in axes.split()], -1)
    assert quaternion_to_matrix(turn) == pytest.approx(expected, abs=1e-15)
    assert quaternion_to_matrix(7.0 * np.array(turn)) == pytest.approx(expected, abs=1e-15)
    back = matrix_to_quaternion(expected)
    assert abs(back @ turn) == pytest.approx(1.0)
    assert back[0] >= 0.0


@given(quaternion)
def test_matrices_are_rotations_and_lead_back(q: np.ndarray) -> None:
    matrix = quaternion_to_matrix(q)
    assert np.linalg.det(matrix) == pytest.approx(1.0)
    assert matrix @ matrix.T == pytest.approx(np.eye(3), abs=1e-12)
    back = matrix_to_quaternion(matrix)
    assert back[0] >= 0.0
    assert np.linalg.norm(back) == pytest.approx(1.0)
    assert quaternion_to_matrix(back) == pytest.approx(matrix, abs=1e-7)


@given(arrays(np.float64, 3, elements=st.floats(-1.0, 1.0)).filter(lambda v: np.linalg.norm(v) > 1e-3))
def test_half_turns_about_any_axis_lead_back(axis: np.ndarray) -> None:
    """There w is 0 and says nothing about the signs of the others."""
    axis = axis / np.linalg.norm(axis)
    matrix = 2 * np.outer(axis, axis) - np.eye(3)
    assert abs(matrix_to_quaternion(matrix)[1:] @ axis) == pytest.approx(1.0)


def test_no_rotation_has_a_length_of_zero() -> None:
    assert (quaternion_to_matrix(np.zeros((2, 4))) == np.eye(3)).all()


@given(quaternion, quaternion)
def test_products_turn_one_after_the_other(first: np.ndarray, second: np.ndarray) -> None:
    both = quaternion_to_matrix(first) @ quaternion_to_matrix(second)
    assert quaternion_to_matrix(quaternion_product(first, second)) == pytest.approx(both, abs=1e-9)


@given(angle, quaternion)
def test_yaw_leads_back_and_is_the_heading(yaw: float, q: np.ndarray) -> None:
    found = float(quaternion_to_yaw(3.0 * yaw_to_quaternion(yaw)))
    assert np.cos(found - yaw) == pytest.approx(1.0)
    x_axis = quaternion_to_matrix(q)[:, 0]
    flat = float(np.hypot(x_axis[0], x_axis[1]))
    turned = float(quaternion_to_yaw(q))
    assert flat * np.array([np.cos(turned), np.sin(turned)]) == pytest.approx(x_axis[:2], abs=1e-9)


def test_yaw_turns_x_towards_y() -> None:
    assert quaternion_to_matrix(yaw_to_quaternion(np.pi / 2))[:, 0] == pytest.approx([0.0, 1.0, 0.0])


@given(angle, angle, st.floats(0.0, 1.0))
def test_between_two_headings_slerp_takes_the_shorter_way(start: float, turn: float, share: float) -> None:
    turn = turn / 50.0 * 3.0  # less than half a turn
    found = slerp(yaw_to_quaternion([start]), -yaw_to_quaternion([start + turn]), share)
    assert np.cos(quaternion_to_yaw(found[0]) - start - share * turn) == pytest.approx(1.0, abs=1e-8)


def test_leading_axes_are_kept_row_by_row() -> None:
    q = np.random.default_rng(0).normal(size=(3, 5, 4))
    matrices = quaternion_to_matrix(q)
    assert matrices.shape == (3, 5, 3, 3)
    back = matrix_to_quaternion(matrices)
    for k in np.ndindex(3, 5):
        assert (matrices[k] == quaternion_to_matrix(q[k])).all()
        assert (back[k] == matrix_to_quaternion(matrices[k])).all()
        assert quaternion_to_yaw(q)[k] == quaternion_to_yaw(q[k])
        assert (quaternion_product(q, q[::-1])[k] == quaternion_product(q[k], q[::-1][k])).all()
    poses = pose_matrix(q[..., :3], q)
    assert poses[1, 2] @ [0.0, 0.0, 0.0, 1.0] == pytest.approx([*q[1, 2, :3], 1.0])
    assert (poses[..., :3, :3] == matrices).all()
    assert (poses[..., 3, :] == [0.0, 0.0, 0.0, 1.0]).all()


def test_an_upright_pose_is_that_of_its_yaw() -> None:
    assert upright_pose(1.0, 2.0, 0.7, 3.0) == pytest.approx(pose_matrix([1.0, 2.0, 3.0], yaw_to_quaternion(0.7)))


@given(angle, st.integers(-9, 9))
def test_wrap_is_in_range_and_the_same_direction(value: float, turns: int) -> None:
    wrapped = float(wrap_angle(value + 2 * np.pi * turns))
    assert -np.pi <= wrapped < np.pi
    assert np.isclose(np.cos(wrapped), np.cos(value), atol=1e-9)
    assert np.isclose(np.sin(wrapped), np.sin(value), atol=1e-9)


def test_wrap_takes_both_edges_to_minus_pi() -> None:
    just_below = np.nextafter(-np.pi, -9.0)  # rounding takes it to +pi unless that is looked for
    assert (wrap_angle(np.array([np.pi, -np.pi, just_below])) == -np.pi).all()
    assert wrap_angle(3 * np.pi) == pytest.approx(-np.pi)


def test_wrap_keeps_single_precision_in_range() -> None:
    edge = np.float32(np.pi)
    around = np.array([turns * edge * (1 + k * 1e-7) for turns in (-3, -1, 1, 3) for k in range(-9, 10)], np.float32)
    wrapped = wrap_angle(around)
    assert wrapped.dtype == np.float32
    assert ((wrapped >= -edge) & (wrapped < edge)).all()


def test_wrap_of_whole_numbers() -> None:
    assert wrap_angle(7) == pytest.approx(7 - 2 * np.pi)
