"""The front of a body is told from its rear by what it shows, as in life."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from ssad.core.seeding import generator
from ssad.rendering.bodies import BODIES, make_body
from ssad.rendering.meshes.mesh import Mesh

RIDDEN_AND_HEAVY = [(kind, style) for kind in ("bicycle", "motorcycle", "truck") for style in BODIES[kind].styles]


def seen(mesh: Mesh, *, front: bool) -> np.ndarray:
    """Names of the materials [90, 60] that are seen from the front or the rear, "" beside the body.

    The view from the rear is mirrored: left is left in both.
    """
    low, high = mesh.bounds()
    corners = mesh.corners()
    flat = (corners[..., [1, 2]] - low[[1, 2]]) / (high - low)[[1, 2]] * [59.0, 89.0]
    depth = corners[..., 0].mean(axis=1) * (1.0 if front else -1.0)
    image = np.full((90, 60), -1, np.int32)
    for face in np.argsort(depth, kind="stable"):  # the nearest is painted last
        cv2.fillConvexPoly(image, np.round(flat[face]).astype(np.int32), int(mesh.material[face]))
    names = np.array([*(m.name for m in mesh.materials), ""])
    return np.asarray(names[image[::-1]])


@pytest.mark.parametrize("detail", [1, 2])
@pytest.mark.parametrize("style", BODIES["pedestrian"].styles)
def test_a_face_looks_ahead_and_hair_or_a_helmet_behind(style: str, detail: int) -> None:
    for key in range(3):
        random = generator("front", style, key)
        mesh = make_body("pedestrian", style=style, generator=random, detail=detail, phase=1.0)
        ahead, behind = (seen(mesh, front=front)[:15] for front in (True, False))
        assert (ahead == "skin").sum() > 1.7 * (behind == "skin").sum()
        assert "eyes" in ahead
        assert "eyes" not in behind
        covered = np.isin(behind, ["hair", "cap", "helmet"]).sum()
        assert covered > 1.1 * np.isin(ahead, ["hair", "cap", "helmet"]).sum()


def test_an_open_jacket_shows_another_colour_in_front_alone() -> None:
    opened = 0
    for key in range(12):
        mesh = make_body("pedestrian", style="adult", generator=generator("jacket", key), detail=1, phase=1.0)
        inner = next((m for m in mesh.materials if m.name == "inner"), None)
        if inner is None:
            continue
        opened += 1
        shirt = next(m for m in mesh.materials if m.name == "shirt")
        assert abs(sum(inner.colour) - sum(shirt.colour)) > 0.2
        assert (seen(mesh, front=True) == "inner").sum() > 40
        assert "inner" not in seen(mesh, front=False)
    assert 3 < opened < 12


@pytest.mark.parametrize(("kind", "style"), RIDDEN_AND_HEAVY)
def test_lamps_are_white_ahead_and_red_behind(kind: str, style: str) -> None:
    for key in range(4):
        mesh = make_body(kind, style=style, generator=generator("lamps", kind, key), detail=1)
        ahead, behind = (seen(mesh, front=front) for front in (True, False))
        assert (ahead == "head_lamp").sum() >= 3
        assert "tail_lamp" not in ahead
        assert (behind == "tail_lamp").sum() >= 3
        assert "head_lamp" not in behind


@pytest.mark.parametrize("style", BODIES["trailer"].styles)
def test_a_trailer_has_lamps_and_a_plate_behind_and_none_ahead(style: str) -> None:
    mesh = make_body("trailer", style=style, generator=generator("lamps", "trailer", style), detail=1)
    ahead, behind = (seen(mesh, front=front) for front in (True, False))
    assert (behind == "tail_lamp").sum() >= 3
    assert "plate" in behind
    assert not np.isin(ahead, ["head_lamp", "tail_lamp", "plate"]).any()


@pytest.mark.parametrize(("kind", "least"), [("bicycle", 4), ("motorcycle", 5)])
def test_two_wheelers_are_of_several_makes_in_one_style(kind: str, least: int) -> None:
    """Told apart by their triangles; a motorcycle or a scooter may have a box behind the rider."""
    made = [make_body(kind, style="parked", generator=generator("makes", k), detail=0) for k in range(40)]
    assert len({len(mesh.faces) for mesh in made}) >= least
    names = {material.name for mesh in made for material in mesh.materials}
    assert ("delivery_box" if kind == "motorcycle" else "wicker") in names
