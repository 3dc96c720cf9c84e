"""Buses and trucks: people and seats behind their panes."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from ssad.core.seeding import generator
from ssad.rendering.bodies import BODIES, make_body
from ssad.rendering.bodies.cabin import SEAT, SKIN_TINTS
from ssad.rendering.meshes.mesh import Mesh

VEHICLES = [(kind, style) for kind in ("truck", "bus") for style in BODIES[kind].styles]
VIEWS = {"front": (0, 1.0), "left": (1, 1.0), "right": (1, -1.0)}


@cache
def vehicle(kind: str, style: str, *, has_driver: bool = True, detail: int = 1, seed: int = 0) -> Mesh:
    size, draws = BODIES[kind].styles[style].size, generator("heavy cabin", kind, style, seed)
    return make_body(kind, style=style, size=size, generator=draws, detail=detail, has_driver=has_driver)


def faces_of(mesh: Mesh, *colours: tuple[float, float, float]) -> np.ndarray:
    """Faces of these colours [F] bool."""
    return np.isin(
        mesh.material, [index for index, material in enumerate(mesh.materials) if material.colour in colours]
    )


def area(mesh: Mesh, faces: np.ndarray, view: str) -> float:
    """Area of faces in a view, m^2."""
    axis, sign = VIEWS[view]
    corners = mesh.corners()[faces]
    directions = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return float(0.5 * np.maximum(sign * directions[:, axis], 0.0).sum())


@pytest.mark.parametrize("detail", [1, 2])
@pytest.mark.parametrize(("kind", "style"), VEHICLES)
def test_a_driver_sits_at_the_left_and_is_seen_from_ahead_and_from_the_left(kind: str, style: str, detail: int) -> None:
    mesh = vehicle(kind, style, detail=detail)
    skin = faces_of(mesh, *SKIN_TINTS)
    middle = mesh.corners().mean(axis=1)
    is_front = middle[:, 0] > 0.5 * mesh.bounds()[1][0] - 0.2
    assert area(mesh, skin & is_front & (middle[:, 1] > 0.2), "front") > 0.015
    assert area(mesh, skin & (middle[:, 0] > 0.5 * mesh.bounds()[1][0] - 0.2), "left") > 0.015
    heads = middle[skin & (middle[:, 1] > 0.2), 2]
    assert heads.min() > 1.4, "higher than in a car"


@pytest.mark.parametrize(("kind", "style"), VEHICLES)
def test_a_parked_one_is_empty_and_otherwise_the_same(kind: str, style: str) -> None:
    driven, parked = vehicle(kind, style), vehicle(kind, style, has_driver=False)
    assert not faces_of(parked, *SKIN_TINTS).any()
    assert faces_of(parked, SEAT.colour).any()
    assert len(parked.faces) < len(driven.faces)
    assert driven.panels == parked.panels
    for bound, other in zip(driven.bounds(), parked.bounds(), strict=True):
        np.testing.assert_array_equal(bound, other)


@pytest.mark.parametrize("style", BODIES["bus"].styles)
def test_passengers_sit_along_both_sides_of_a_bus_and_each_bus_has_others(style: str) -> None:
    buses = [vehicle("bus", style, seed=seed) for seed in range(4)]
    for view in ("left", "right"):
        areas = [area(mesh, faces_of(mesh, *SKIN_TINTS), view) for mesh in buses]
        assert max(areas) > 0.1, "some heads of 0.03 m^2 each"
        assert len({round(value, 6) for value in areas}) > 1
    for mesh in buses:
        # Heads lie between the belt line and the roof.
        heights = mesh.corners()[faces_of(mesh, *SKIN_TINTS)][..., 2] / mesh.bounds()[1][2]
        assert heights.min() > 0.4
        assert heights.max() < 0.85


def test_the_door_side_of_a_city_bus_shows_nobody_on_its_doors() -> None:
    mesh = vehicle("bus", "city", seed=1)
    faces = faces_of(mesh, SEAT.colour, *SKIN_TINTS)
    middle = mesh.corners().mean(axis=1)
    length = mesh.bounds()[1][0] * 2.0
    in_door = (np.abs(middle[:, 0] / length - (0.5 - 0.018 - 0.509 * 0.974)) < 0.05) & (middle[:, 1] < 0.0)
    assert not (faces & in_door).any()
    assert (faces & ~in_door & (middle[:, 1] < 0.0)).any()
