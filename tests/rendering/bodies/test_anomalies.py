"""Bodies that belong to no class of nuScenes."""

from __future__ import annotations

import numpy as np
import pytest

from ssad.core.seeding import generator
from ssad.rendering.bodies import BODIES, make_body
from ssad.rendering.bodies.actor_bodies import BODY_CATEGORIES
from ssad.rendering.meshes.mesh import Mesh

ANOMALIES = ("debris", "animal", "overturned", "fallen_tree")


def middle_of(mesh: Mesh, material: str) -> np.ndarray:
    """Middle of what a material covers, as shares of the box: 0 to 1 along length, width and height."""
    low, high = mesh.bounds()
    chosen = np.isin(mesh.material, [k for k, m in enumerate(mesh.materials) if m.name == material])
    assert chosen.any(), material
    return np.asarray((mesh.corners()[chosen].mean((0, 1)) - low) / (high - low))


def test_anomalies_are_of_no_class_and_cheap() -> None:
    for kind in ANOMALIES:
        assert kind not in BODY_CATEGORIES
        for style in BODIES[kind].styles:
            counts = [len(make_body(kind, style=style, generator=generator(4), detail=d).faces) for d in (0, 1, 2)]
            assert counts[0] <= counts[1] <= counts[2] < 5500
            assert counts[0] < 650


def test_overturned_vehicles_lie_on_a_side_or_the_roof() -> None:
    for style in BODIES["overturned"].styles:
        sides = set()
        for seed in range(8):
            mesh = make_body("overturned", style=style, generator=generator("lies", seed), detail=1)
            tyres = middle_of(mesh, "tyre")
            if style == "car_roof":
                assert tyres[2] > 0.7
            else:
                assert tyres[2] == pytest.approx(0.5, abs=0.15)
                assert abs(tyres[1] - 0.5) > 0.2, "its wheels are to one side"
                sides.add(tyres[1] > 0.5)
        assert style == "car_roof" or sides == {True, False}


def test_what_lies_on_the_ground_touches_it() -> None:
    """An overturned car rests on its bodywork, not on the tip of a mirror."""
    for style in ("car_side", "suv_side", "car_roof"):
        mesh = make_body("overturned", style=style, generator=generator("rests"))
        assert mesh.corners()[mesh.panel >= 0, :, 2].min() < 0.01


def test_animals_stand_on_four_legs() -> None:
    for style in BODIES["animal"].styles:
        mesh = make_body("animal", style=style, generator=generator("legs"))
        size = mesh.bounds()[1] * [2.0, 2.0, 1.0]
        feet = mesh.corners().reshape(-1, 3)
        feet = feet[feet[:, 2] < 0.1 * size[2]]
        quarters = {(bool(x > 0), bool(y > 0)) for x, y, _ in feet}
        assert len(quarters) == 4
