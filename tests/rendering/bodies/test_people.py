"""People: faces, clothes that close, and the test targets."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from ssad.core.seeding import generator
from ssad.rendering.bodies import BODIES, make_body
from ssad.rendering.meshes.mesh import Mesh
from ssad.world.models import MODELS

TARGETS = {"adult_target": "euroncap_adult", "child_target": "euroncap_child"}
PHASES = np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False)


def person(style: str, phase: float = 1.0, *, key: int = 0, detail: int = 1) -> Mesh:
    return make_body("pedestrian", style=style, generator=generator("people", style, key), detail=detail, phase=phase)


def names_at(mesh: Mesh, height: float) -> set[str]:
    """Materials of the faces that a plane at a share of the height cuts."""
    z = mesh.corners()[..., 2]
    level = height * z.max()
    cut = (z.min(axis=1) <= level) & (z.max(axis=1) >= level)
    return {mesh.materials[index].name for index in np.unique(mesh.material[cut])}


def silhouette(mesh: Mesh, axis: int) -> np.ndarray:
    """View along an axis as filled pixels, 1 cm each."""
    corners = mesh.corners()[..., [1 - axis, 2]]
    pixels = np.round((corners - corners.min(axis=(0, 1))) * 100.0).astype(np.int32)
    image = np.zeros(pixels.max(axis=(0, 1))[::-1] + 1, np.uint8)
    for triangle in pixels:
        cv2.fillConvexPoly(image, triangle, 1)
    return image.astype(bool)


@pytest.mark.parametrize("style", BODIES["pedestrian"].styles)
def test_clothes_close_at_shoulders_and_hips(style: str) -> None:
    """Seen from the side and the front, the trunk has no hole from the hips to the neck, at any moment of a step."""
    for phase in PHASES[::2]:
        mesh = person(style, float(phase))
        for axis in (0, 1):
            filled = silhouette(mesh, axis)
            height = filled.shape[0]
            trunk = filled[int(0.46 * height) : int(0.84 * height)]
            middle = int(np.median(np.flatnonzero(filled[int(0.62 * height)])))
            reach = range(middle - 2, middle + 3) if style != "elderly" else ()
            assert all(trunk[:, column].all() for column in reach), (style, phase, axis)


@pytest.mark.parametrize("key", range(6))
def test_no_skin_shows_between_shirt_and_trousers(key: int) -> None:
    mesh = person("standing", key=key)
    hips = names_at(mesh, 0.60)
    assert hips & {"shirt", "trousers"}
    corners = mesh.corners()
    skin = corners[mesh.material == [m.name for m in mesh.materials].index("skin")].reshape(-1, 3)
    near_hips = (skin[:, 2] > 0.53 * corners[..., 2].max()) & (skin[:, 2] < 0.80 * corners[..., 2].max())
    # Hands hang beside the hips; legs are covered there.
    assert (np.abs(skin[near_hips, 1]) > 0.10 * corners[..., 2].max()).all()


@pytest.mark.parametrize("detail", [1, 2])
def test_a_face_is_the_same_on_both_sides(detail: int) -> None:
    mesh = person("standing", detail=detail)
    for name in ("eyes", "brows", "lips"):
        points = mesh.corners()[mesh.material == [m.name for m in mesh.materials].index(name)].reshape(-1, 3)
        assert len(points) >= 6
        mirrored = points * [1.0, -1.0, 1.0]
        gaps = np.linalg.norm(points[:, None] - mirrored[None], axis=-1).min(axis=1)
        assert gaps.max() < 2e-3, name
    heights = [
        mesh.corners()[mesh.material == [m.name for m in mesh.materials].index(name)][..., 2].mean()
        for name in ("lips", "eyes", "brows")
    ]
    assert heights == sorted(heights)


@pytest.mark.parametrize("style", TARGETS)
def test_a_pedestrian_target_has_its_published_size_and_one_look(style: str) -> None:
    model = MODELS[TARGETS[style]]
    size = np.array([model.length, model.width, model.height])
    assert BODIES["pedestrian"].styles[style].size == tuple(size)
    steps = [person(style, float(phase), key=step) for step, phase in enumerate(PHASES)]
    low = np.min([mesh.bounds()[0] for mesh in steps], axis=0)
    high = np.max([mesh.bounds()[1] for mesh in steps], axis=0)
    np.testing.assert_allclose(high - low, size, rtol=0.06)
    assert (high - low <= size + 1e-5).all()
    assert len({mesh.materials for mesh in steps}) == 1


def test_only_the_legs_of_a_target_move() -> None:
    """Relative to its shoulders, its hands stay where they are; its feet do not."""

    def span(style: str, name: str) -> float:
        places = []
        for phase in PHASES:
            mesh = person(style, float(phase))
            corners, names = mesh.corners(), [m.name for m in mesh.materials]
            is_low = corners[..., 2].max(axis=1) < 0.8 * corners[..., 2].max()
            part = corners[(mesh.material == names.index(name)) & is_low & (corners[..., 1].mean(axis=1) > 0.02)]
            places.append(part[..., 0].mean())
        return float(np.ptp(places))

    assert span("adult_target", "skin") < 0.04
    assert span("adult_target", "shoes") > 0.2
    assert span("adult", "skin") > 0.1


def test_targets_are_never_drawn_at_random() -> None:
    for kind in ("car", "pedestrian", "bicycle", "motorcycle"):
        weights = {style: body.weight for style, body in BODIES[kind].styles.items()}
        targets = [style for style in weights if style.endswith("_target")]
        assert targets
        assert all(weights[style] == 0.0 for style in targets)
        assert all(weight > 0.0 for style, weight in weights.items() if style not in targets)
