"""Flat pieces over a curved surface: they cover what they should, nothing shows through, and nothing hangs beside."""

from __future__ import annotations

import numpy as np
import pytest

from ssad.rendering.bodies.drape import Surface, ellipse, mirrored, patches, rectangle, trapezoid
from ssad.rendering.meshes.mesh import Material, Mesh, box, merge, sphere

GREY = Material("grey", (0.5, 0.5, 0.5))
RED = Material("red", (0.5, 0.0, 0.0))
LIFT = 0.005
# axis of a view and the direction to who looks
VIEWS = {"front": (0, 1.0), "rear": (0, -1.0), "left": (1, 1.0), "right": (1, -1.0)}


def area_in_view(mesh: Mesh, axis: int) -> float:
    """Area of a mesh projected along an axis, m^2."""
    flat = mesh.corners()[:, :, [1 - axis, 2]]
    first, second = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    return float(0.5 * np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]).sum())


@pytest.mark.parametrize("view", VIEWS)
def test_a_piece_follows_a_ball_at_its_lift_and_faces_the_viewer(view: str) -> None:
    axis, sign = VIEWS[view]
    ball = sphere(1.0, material=GREY, segments=24)
    (piece,) = patches(Surface(ball, view), [(rectangle((-0.3, -0.2), (0.4, 0.3)), RED, LIFT)])
    piece.check()
    assert area_in_view(piece, axis) == pytest.approx(0.35, rel=0.02)
    radii = np.linalg.norm(piece.vertices, axis=1)
    assert radii.min() > np.cos(np.pi / 24) ** 2 + 0.5 * LIFT
    assert radii.max() < 1.0 + 1.5 * LIFT
    corners = piece.corners()
    directions = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (sign * directions[:, axis] > 0.0).all()
    assert (sign * piece.normals[..., axis] > 0.5).all()


def test_no_edge_of_the_surface_shows_through() -> None:
    """Between a piece and the ball below it there is the lift everywhere, not at its corners alone."""
    ball = sphere(1.0, material=GREY, segments=16)
    (piece,) = patches(Surface(ball, "front"), [(rectangle((-0.5, -0.5), (0.5, 0.5)), RED, LIFT)])
    middles = piece.corners().mean(axis=1)
    faces = ball.corners()
    planes = np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])
    planes /= np.maximum(np.linalg.norm(planes, axis=1, keepdims=True), 1e-12)
    # The ball is convex: a point lies outside if it lies beyond one of its planes.
    beyond = np.einsum("mfi,fi->mf", middles[:, None] - faces[None, :, 0], planes).max(axis=1)
    assert beyond.min() > 0.4 * LIFT


def test_what_lies_beside_or_behind_the_surface_is_left_out() -> None:
    near = box((0.1, 1.0, 1.0), material=GREY, centre=(1.0, 0.0, 0.5))
    far = box((0.1, 3.0, 1.0), material=GREY)
    surface = Surface(merge([near, far]), "front")
    (piece,) = patches(
        surface, [([*rectangle((-0.4, 0.2), (0.4, 0.4)), *rectangle((0.6, 0.2), (5.0, 0.4))], RED, LIFT)]
    )
    # The far box ends at y = 1.5; before its middle stands the near one.
    assert area_in_view(piece, 0) == pytest.approx((0.8 + 0.9) * 0.2, rel=1e-6)
    middles = piece.corners().mean(axis=1)
    in_front = np.abs(middles[:, 1]) < 0.5
    np.testing.assert_allclose(middles[in_front, 0], 1.05 + LIFT, atol=1e-6)
    np.testing.assert_allclose(middles[~in_front, 0], 0.05 + LIFT, atol=1e-6)
    assert patches(surface, [(rectangle((4.0, 0.2), (5.0, 0.4)), RED, LIFT)]) == []
    assert patches(surface, []) == []


def test_a_flat_cell_is_one_face() -> None:
    (piece,) = patches(
        Surface(box((1.0, 1.0, 1.0), material=GREY), "left"), [([ellipse((0.0, 0.0), (0.3, 0.2), 8)], RED, LIFT)]
    )
    assert len(piece.faces) == 6, "an octagon, not cut along the diagonal of the side"


def test_outlines() -> None:
    assert trapezoid((0.0, 0.0), (4.0, 1.0), (1.0, 3.0)) == [[(0.0, 0.0), (4.0, 0.0), (3.0, 1.0), (1.0, 1.0)]]
    right, left = mirrored(rectangle((1.0, 0.0), (2.0, 1.0)))
    assert sorted((-y, z) for y, z in left) == sorted(right)
