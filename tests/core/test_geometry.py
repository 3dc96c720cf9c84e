"""Plane geometry against closed forms and invariants."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssad.core.geometry import corners, cross, obb_distance, rotate, to_local, to_world

angle = st.floats(-50.0, 50.0)
place = st.floats(-100.0, 100.0)
size = st.floats(0.2, 12.0)
box = st.tuples(place, place, angle, size, size).map(np.array)


def test_rotate_and_frames_closed_form() -> None:
    assert rotate([1.0, 0.0], np.pi / 2) == pytest.approx([0.0, 1.0])
    assert to_local([10.0, 5.0, np.pi / 2], [10.0, 8.0]) == pytest.approx([3.0, 0.0])
    assert to_local([10.0, 5.0, np.pi / 2], [9.0, 5.0]) == pytest.approx([0.0, 1.0])


@given(place, place, angle, place, place)
def test_to_world_undoes_to_local(x: float, y: float, yaw: float, px: float, py: float) -> None:
    pose, point = np.array([x, y, yaw]), np.array([px, py])
    assert to_world(pose, to_local(pose, point)) == pytest.approx(point, abs=1e-9)


def test_corners_closed_form() -> None:
    expected = [[2.0, 1.0], [-2.0, 1.0], [-2.0, -1.0], [2.0, -1.0]]
    assert corners(0.0, 0.0, 0.0, 4.0, 2.0) == pytest.approx(np.array(expected))
    turned = corners(1.0, 1.0, np.pi / 2, 4.0, 2.0)
    assert turned == pytest.approx(np.array([[0.0, 3.0], [0.0, -1.0], [2.0, -1.0], [2.0, 3.0]]))


@given(box)
def test_corners_keep_area_and_centre(b: np.ndarray) -> None:
    points = corners(*b)
    assert points.mean(axis=0) == pytest.approx(b[:2], abs=1e-9)
    (x, y), (u, v) = points.T, np.roll(points, -1, axis=0).T
    assert 0.5 * (x * v - y * u).sum() == pytest.approx(b[3] * b[4], rel=1e-6, abs=1e-6)


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        ((7.0, 0.0, 0.0, 4.0, 2.0), 3.0),  # bumper to bumper
        ((0.0, 5.0, 0.0, 4.0, 2.0), 3.0),  # side by side
        ((7.0, 5.0, 0.0, 4.0, 2.0), np.hypot(3.0, 3.0)),  # corner to corner
        ((5.0, 0.0, np.pi / 4, np.sqrt(8.0), np.sqrt(8.0)), 1.0),  # a corner against a side
        ((0.0, 3.0, np.pi / 4, np.sqrt(8.0), np.sqrt(8.0)), 0.0),  # a corner touches a side
        ((1.0, 2.5, np.pi / 4, np.sqrt(2.0), np.sqrt(2.0)), 0.5),  # only the long side's own axis separates them
        ((1.0, 0.5, 0.3, 4.0, 2.0), 0.0),  # overlap
        ((0.0, 0.0, np.pi / 2, 40.0, 0.1), 0.0),  # a cross: no corner inside the other
        ((4.0, 0.0, 0.0, 4.0, 2.0), 0.0),  # touching
    ],
)
def test_obb_distance_closed_form(other: tuple[float, ...], expected: float) -> None:
    assert float(obb_distance((0.0, 0.0, 0.0, 4.0, 2.0), other)) == pytest.approx(expected, abs=1e-9)


@given(box, box)
def test_obb_distance_is_symmetric_and_bounded(a: np.ndarray, b: np.ndarray) -> None:
    near, back = float(obb_distance(a, b)), float(obb_distance(b, a))
    assert near == pytest.approx(back, abs=1e-9)
    centres = np.hypot(*(a[:2] - b[:2]))
    reach = 0.5 * (np.hypot(a[3], a[4]) + np.hypot(b[3], b[4]))
    assert max(0.0, centres - reach) - 1e-9 <= near <= centres + 1e-9


@given(box, box)
def test_obb_distance_against_sampled_edges(a: np.ndarray, b: np.ndarray) -> None:
    t = np.linspace(0.0, 1.0, 41)[:, None, None]

    def edge(c: np.ndarray) -> np.ndarray:
        return (c[None] * (1 - t) + np.roll(c, -1, axis=0)[None] * t).reshape(-1, 2)

    p, q = edge(corners(*a)), edge(corners(*b))
    sampled = np.hypot(*(p[:, None] - q[None]).transpose(2, 0, 1)).min()
    near = float(obb_distance(a, b))
    assert near <= sampled + 1e-9
    if near > 0.0:
        # the two nearest places are at most half a sample step from a sample on each box
        assert sampled <= near + max(*a[3:], *b[3:]) / 40.0 + 1e-9


def test_obb_distance_is_batched() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.uniform(1.0, 9.0, (3, 1, 5)), rng.uniform(1.0, 9.0, (4, 5))
    whole = obb_distance(a, b)
    assert whole.shape == (3, 4)
    assert whole[2, 3] == obb_distance(a[2, 0], b[3])


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_cross_products_are_numpys_to_the_bit(kind: Any) -> None:
    draws = np.random.default_rng(1)
    a, b = draws.normal(size=(40, 1, 3)).astype(kind), draws.normal(size=(7, 3)).astype(kind)
    for u, v in ((a, b), (b, a), (a[0, 0], b), (a[0, 0], b[0])):
        found, wanted = cross(u, v), np.cross(u, v)
        assert found.dtype == wanted.dtype
        assert found.shape == wanted.shape
        assert found.tobytes() == np.ascontiguousarray(wanted).tobytes()
    assert cross([1, 0, 0], [0.0, 1.0, 0.0]).tolist() == [0.0, 0.0, 1.0]
