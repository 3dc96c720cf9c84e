"""Cars: what shows behind their panes and on their ends, the same on both sides, within the box."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from ssad.core.seeding import generator
from ssad.rendering.bodies import BODIES, make_body
from ssad.rendering.bodies.cabin import BEYOND, BOARD, SEAT, SKIN_TINTS
from ssad.rendering.bodies.parts import GLASS
from ssad.rendering.meshes.mesh import Mesh

CARS = [style for style in BODIES["car"].styles if style != "global_vehicle_target"]
ENDS = {"front": 1.0, "rear": -1.0}


@cache
def car(style: str, detail: int = 1, *, has_driver: bool = True) -> Mesh:
    return make_body("car", style=style, generator=generator("cabin", style), detail=detail, has_driver=has_driver)


def faces_of(mesh: Mesh, *names: str) -> np.ndarray:
    """Faces whose material has one of the names [F] bool."""
    return np.isin(mesh.material, [index for index, material in enumerate(mesh.materials) if material.name in names])


def area_towards(mesh: Mesh, faces: np.ndarray, sign: float) -> float:
    """Area of faces in a view from ahead (1) or behind (-1), m^2."""
    corners = mesh.corners()[faces]
    directions = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return float(0.5 * np.maximum(sign * directions[:, 0], 0.0).sum())


@pytest.mark.parametrize("detail", [1, 2])
@pytest.mark.parametrize("style", CARS)
def test_seats_and_the_world_beyond_show_behind_every_pane(style: str, detail: int) -> None:
    mesh = car(style, detail)
    colours = [material.colour for material in mesh.materials]
    for material, ends in ((BEYOND, ENDS), (SEAT, {"rear": -1.0}), (BOARD, {"front": 1.0})):
        faces = mesh.material == colours.index(material.colour)
        for sign in ends.values():
            assert area_towards(mesh, faces, sign) > 0.04
    corners = mesh.corners()[mesh.material == colours.index(SEAT.colour)]
    directions = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    for side in (1.0, -1.0):
        assert np.maximum(side * directions[:, 1], 0.0).sum() > 0.02
    # Reflections run on over all of it.
    behind_glass = [material for material in mesh.materials if material.name == "glass"]
    assert len(behind_glass) > 4
    assert {(material.specular, material.gloss) for material in behind_glass} == {(GLASS.specular, GLASS.gloss)}


@pytest.mark.parametrize("style", CARS)
def test_a_parked_car_is_the_same_without_its_driver(style: str) -> None:
    driven, parked = car(style), car(style, has_driver=False)
    skins = set(SKIN_TINTS)
    assert skins & {material.colour for material in driven.materials}
    assert not skins & {material.colour for material in parked.materials}
    assert len(parked.faces) < len(driven.faces)
    for one, other in zip(driven.bounds(), parked.bounds(), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("style", CARS)
def test_a_car_without_a_driver_is_the_same_on_both_sides(style: str) -> None:
    """But for the letters of its plates, and the name of the model."""
    mesh = car(style, 2, has_driver=False)
    faces = ~faces_of(mesh, "plate_letters", "plate_band", "chrome", "glass", "tyre", "rim", "underside")
    for sign in ENDS.values():
        left, right = (faces & (side * mesh.corners()[..., 1].mean(axis=1) > 0.02) for side in (1.0, -1.0))
        assert area_towards(mesh, left, sign) == pytest.approx(area_towards(mesh, right, sign), rel=0.02)


@pytest.mark.parametrize("style", BODIES["car"].styles)
def test_a_car_from_behind_has_what_cars_have(style: str) -> None:
    mesh = car(style)
    for name, least in (
        ("tail_lamp", 0.02),
        ("dark_lens", 0.01),
        ("clear_lens", 0.002),
        ("indicator", 0.004),
        ("reflector", 0.002),
        ("plate", 0.04),
        ("plate_letters", 0.005),
        ("seam", 0.005),
    ):
        faces = faces_of(mesh, name)
        assert area_towards(mesh, faces, -1.0) > least, name
        if name.endswith(("lens", "lamp", "indicator", "reflector")):
            both = [faces & (side * mesh.corners()[..., 1].mean(axis=1) > 0.1) for side in (1.0, -1.0)]
            assert min(area_towards(mesh, faces, -1.0) for faces in both) > 0.4 * least, f"{name} on both sides"
    ahead = faces_of(mesh, "tail_lamp", "dark_lens", "clear_lens", "reflector")
    assert area_towards(mesh, ahead, 1.0) < 1e-3
    assert area_towards(mesh, faces_of(mesh, "head_lamp"), 1.0) > 0.01
    assert area_towards(mesh, faces_of(mesh, "plate_letters"), 1.0) > 0.005


def test_details_do_not_reach_far_bodies() -> None:
    far = make_body("car", style="sedan", generator=generator("cabin", "sedan"), detail=0)
    assert {material.name for material in far.materials} <= {
        "paint",
        "glass",
        "trim",
        "underside",
        "tyre",
        "head_lamp",
        "tail_lamp",
        "lamp_housing",
    }
