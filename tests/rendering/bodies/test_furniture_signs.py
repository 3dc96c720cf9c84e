"""Stop, yield and speed-limit signs: plates on posts, with a face that takes textures."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from ssad.core.seeding import generator
from ssad.rendering.bodies import BODIES, draw_size, make_body
from ssad.rendering.bodies.figures import number_strokes
from ssad.rendering.meshes.mesh import Mesh

KINDS = ("stop_sign", "yield_sign")
STYLES = [(kind, style) for kind in KINDS for style in BODIES[kind].styles] + [
    ("limit_sign", "30"),
    ("limit_sign", "120"),
]


def area_of(mesh: Mesh, material: str, panel: str = "face") -> float:
    """Square metres of a panel in one material."""
    faces = (mesh.panel == mesh.panels.index(panel)) & (
        mesh.material == [m.name for m in mesh.materials].index(material)
    )
    return float(mesh.areas()[faces].sum())


@pytest.mark.parametrize(("kind", "style"), STYLES)
def test_the_plate_is_at_the_top_and_looks_ahead(kind: str, style: str) -> None:
    for seed in range(12):
        size = draw_size(kind, style, generator=generator("sign size", seed))
        mesh = make_body(kind, style=style, size=size, generator=generator("sign", seed))
        for panel, way in (("face", 1.0), ("back", -1.0)):
            corners = mesh.corners()[mesh.panel == mesh.panels.index(panel)]
            low, high = corners.reshape(-1, 3).min(0), corners.reshape(-1, 3).max(0)
            assert 0.55 < high[1] - low[1] < 1.0
            assert high[1] - low[1] == pytest.approx(size[1], abs=1e-4)
            assert high[2] == pytest.approx(size[2], abs=1e-4)
            assert 1.8 < low[2] < 2.4
            turned = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            assert (way * turned[:, 0] > 0).all()


@pytest.mark.parametrize("style", BODIES["stop_sign"].styles)
def test_a_stop_sign_is_a_red_octagon_with_letters(style: str) -> None:
    mesh = make_body("stop_sign", style=style, generator=generator("octagon", style))
    low, high = mesh.bounds()
    octagon = 2.0 * (np.sqrt(2.0) - 1.0) * (high[1] - low[1]) ** 2
    assert area_of(mesh, "sign_back", "back") == pytest.approx(octagon, rel=1e-3)
    assert area_of(mesh, "sign_red") == pytest.approx(0.945**2 * octagon, rel=1e-3)
    letters = area_of(mesh, "sign_white") - octagon
    assert 0.12 * octagon < letters < 0.3 * octagon
    red, white = (next(m.colour for m in mesh.materials if m.name == name) for name in ("sign_red", "sign_white"))
    assert red[0] > 3.0 * red[1]
    assert min(white) > 3.0 * max(red[1:])


@pytest.mark.parametrize("style", BODIES["stop_sign"].styles)
def test_stop_reads_from_left_to_right(style: str) -> None:
    """Where the texture runs right, the letters do: S ends below to its right, P has no lower right."""
    mesh = make_body("stop_sign", style=style, generator=generator("letters", style))
    face = mesh.panel == mesh.panels.index("face")
    x = mesh.corners()[..., 0].mean(1)
    letters = face & (x > x[face].max() - 1e-4) & (mesh.material != mesh.material[face & (mesh.areas() > 0.05)][-1])
    u0, v0, u1, v1 = mesh.panel_rectangle("face")
    uv = (mesh.uv[letters].mean(1) - [u0, v0]) / [u1 - u0, v1 - v0]
    area = mesh.areas()[letters]
    right = uv[:, 0] > 0.72  # the P
    assert right.any()
    assert area[right & (uv[:, 1] < 0.5)].sum() > 1.5 * area[right & (uv[:, 1] > 0.5)].sum()
    left = uv[:, 0] < 0.28  # the S, as heavy above as below
    assert area[left & (uv[:, 1] < 0.5)].sum() == pytest.approx(area[left & (uv[:, 1] > 0.5)].sum(), rel=0.4)


@pytest.mark.parametrize(("kind", "style"), STYLES)
def test_the_face_takes_a_texture_upright(kind: str, style: str) -> None:
    """u runs to the right of who looks at the sign (to +y of the body), v down, over the square of the plate."""
    mesh = make_body(kind, style=style, generator=generator("face", kind, style))
    u0, v0, u1, v1 = mesh.panel_rectangle("face")
    face = mesh.panel == mesh.panels.index("face")
    uv, places = mesh.uv[face].reshape(-1, 2), mesh.corners()[face].reshape(-1, 3)
    low, high = mesh.bounds()
    side = high[1] - low[1]
    assert uv[:, 0] == pytest.approx(u0 + (u1 - u0) * (places[:, 1] - low[1]) / side, abs=1e-4)
    assert uv[:, 1] == pytest.approx(v0 + (v1 - v0) * (high[2] - places[:, 2]) / side, abs=1e-4)
    assert (u1 - u0) == pytest.approx(v1 - v0, rel=1e-3)


def test_signs_of_a_seed_are_the_same_and_others_differ() -> None:
    first, again, other = (make_body("stop_sign", style="worn", generator=generator("worn", k)) for k in (1, 1, 2))
    assert np.array_equal(first.vertices, again.vertices)
    assert first.materials == again.materials
    assert other.materials != first.materials


@pytest.mark.parametrize("style", ["30", "80", "120"])
def test_a_limit_sign_is_a_white_disc_in_a_red_ring_with_its_figures(style: str) -> None:
    mesh = make_body("limit_sign", style=style, generator=generator("limit", style))
    low, high = mesh.bounds()
    disc = np.pi * (0.5 * (high[1] - low[1])) ** 2
    assert area_of(mesh, "sign_red") == pytest.approx(disc, rel=0.01)
    assert area_of(mesh, "sign_white") == pytest.approx(0.76**2 * disc, rel=0.01)
    assert 0.08 * disc < area_of(mesh, "sign_ink") < 0.25 * disc
    face = mesh.panel == mesh.panels.index("face")
    ink = mesh.corners()[face & (mesh.material == [m.name for m in mesh.materials].index("sign_ink"))]
    reach = np.hypot(ink[..., 1], ink[..., 2] - (high[2] - 0.5 * (high[1] - low[1])))
    assert reach.max() < 0.76 * 0.5 * (high[1] - low[1]), "the figures stay on the white disc"


def test_numbers_read_from_left_to_right() -> None:
    """A one is narrow and stands to the left of the reader in 10, to the right in 01."""
    first, last = (np.concatenate(number_strokes(text, segments=6)) for text in ("10", "01"))
    assert np.median(first[:, 0]) > 0.1
    assert np.median(last[:, 0]) < -0.1
    assert first[:, 1].max() == pytest.approx(-first[:, 1].min(), abs=0.1)


def test_every_number_has_its_shape() -> None:
    """Drawn as masks, no two figures cover each other by more than 95 %."""
    masks = {}
    for figure in "0123456789":
        mask = np.zeros((100, 100), np.uint8)
        for stroke in number_strokes(figure, segments=8):
            cv2.fillPoly(mask, [np.round(50 + 45 * stroke * [1, -1]).astype(np.int32)], 1)
        masks[figure] = mask > 0
    for figure, mask in masks.items():
        for other in masks.keys() - {figure}:
            assert (mask & masks[other]).sum() < 0.95 * (mask | masks[other]).sum(), f"{figure} and {other}"
