"""Textures that things wear, decals, and their gradients."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ssad.core.errors import ConfigError
from ssad.core.frames import FORWARD, Camera
from ssad.core.seeding import generator
from ssad.rendering.bodies import make_body
from ssad.rendering.camera.render import PLAIN, Rendering, SceneWeather, View, render
from ssad.rendering.camera.scene import RenderScene, SceneObject, TextureDecal, TextureLayer
from ssad.rendering.camera.texture import (
    PRINTABLE,
    levels_of,
    paint_mask,
    pyramid,
    retexture,
    texture_taps,
    to_printable,
)
from ssad.rendering.meshes import mesh as meshes
from ssad.rendering.meshes.mesh import Material, build

GREY = Material("grey", (0.4, 0.4, 0.4), specular=0.0, gloss=0.0)
PAINT = Material("paint", (0.5, 0.5, 0.5), specular=0.0, gloss=0.0, paint=True)
CAMERA = Camera(64, 48, np.array([[50.0, 0, 32.0], [0, 50.0, 24.0], [0, 0, 1]]))
NOON = SceneWeather(sun_height=1.2, sun_heading=2.0, clouds=0.0)
CAR = make_body("car", style="sedan", generator=generator("texture"))


@pytest.fixture(scope="module")
def scene() -> RenderScene:
    vertices = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float) * 60
    ground = build(vertices, np.array([[0, 1, 2], [0, 2, 3]]), materials=(GREY,))
    cube = meshes.box((4.0, 2.0, 1.5), material=PAINT, centre=(0.0, 0.0, 0.75), panel="body")
    return RenderScene(None, [ground, cube, CAR])


def place(x: float, y: float, z: float = 0.0) -> Any:
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


def view(*things: SceneObject, **other: Any) -> View:
    return View(CAMERA, FORWARD, (SceneObject(0, np.eye(4)), *things), NOON, **other)


def box(x: float = 7.0, *layers: TextureLayer, paint: tuple[float, float, float] = (0.5, 0.5, 0.5)) -> SceneObject:
    return SceneObject(1, place(x, 0.4), paint, 1, layers)


def flat(colour: tuple[float, float, float], size: tuple[int, int] = (32, 32)) -> torch.Tensor:
    return torch.tensor(colour, dtype=torch.float64)[:, None, None].expand(3, *size)


def base(picture: Rendering) -> torch.Tensor:
    return torch.tensor(picture.radiance, dtype=torch.float64)


def taps(picture: Rendering, size: int | tuple[int, int], **other: Any) -> Any:
    return texture_taps(picture, size, dtype=torch.float64, **other)


def test_a_texture_of_one_colour_is_a_paint(scene: RenderScene) -> None:
    colour = (0.7, 0.2, 0.4)
    painted = render(scene, [view(box(paint=colour))])
    textured = render(scene, [view(box(7.0, TextureLayer(0)))])
    for size in (32, (20, 50), 1):
        seen = taps(textured, size)
        assert len(seen.pixel) > 50
        assert seen.weight.sum(1).numpy() == pytest.approx(1.0)
        out = retexture(seen, flat(colour, seen.size), base(textured))
        assert out.numpy() == pytest.approx(painted.radiance, rel=1e-4, abs=1e-5)


def test_layers_lie_one_above_the_other(scene: RenderScene) -> None:
    """Two half transparent layers over paint: what is seen is their mixture, in their order."""
    below, above, paint = (0.8, 0.1, 0.1), (0.1, 0.1, 0.9), (0.2, 0.6, 0.2)
    mask = np.full((3, 5), 0.5, np.float32)
    worn = (TextureLayer(3, opacity=0.6), TextureLayer(7, mask=mask))
    mixed = tuple(0.5 * a + 0.5 * (0.6 * b + 0.4 * p) for a, b, p in zip(above, below, paint, strict=True))
    expected = render(scene, [view(box(paint=mixed))])
    picture = render(scene, [view(box(7.0, *worn, paint=paint))])
    out = retexture(taps(picture, 8, texture=3), flat(below, (8, 8)), base(picture))
    out = retexture(taps(picture, (4, 9), texture=7), flat(above, (4, 9)), out)
    assert out.numpy() == pytest.approx(expected.radiance, rel=1e-4, abs=1e-5)


def test_a_patch_stays_in_its_rectangle(scene: RenderScene) -> None:
    whole = render(scene, [view(box(7.0, TextureLayer(0)))])
    part = render(scene, [view(box(7.0, TextureLayer(0, (0.0, 0.0, 0.4, 0.4))))])
    assert 0 < len(part.fragments) < len(whole.fragments)
    assert part.fragments["u"].min() >= 0
    assert part.fragments["u"].max() <= 1


def test_a_decal_lies_on_what_faces_it(scene: RenderScene) -> None:
    """On the ground: the pixels that it changes are those that the camera's geometry says."""
    # x to the camera's right, y towards it, z down
    down = np.array([[0, -1.0, 0, 9.0], [-1.0, 0, 0, 0.5], [0, 0, -1.0, 0.0], [0, 0, 0, 1.0]])
    decal = TextureDecal(0, down, (2.0, 3.0))
    bare, marked = (render(scene, [v], quality=PLAIN) for v in (view(), view(decals=(decal,))))
    white = retexture(taps(marked, 16), flat((1.0, 1.0, 1.0), (16, 16)), base(marked))
    changed = (np.abs(white.numpy() - bare.radiance).max(-1) > 1e-3)[0]
    rows, columns = np.mgrid[0:48, 0:64] + 0.5
    with np.errstate(divide="ignore", invalid="ignore"):
        ahead = 1.5 * 50.0 / (rows - 24.0)
    x, y = ahead + FORWARD[0, 3], -(columns - 32.0) / 50.0 * ahead
    inside = (np.abs(x - 9.0) < 1.4) & (np.abs(y - 0.5) < 0.9) & (rows > 24)
    outside = (np.abs(x - 9.0) > 1.8) | (np.abs(y - 0.5) > 1.2) | (rows < 24)
    assert inside.sum() > 20
    assert changed[inside].all()
    assert not changed[outside].any()
    half = torch.zeros(3, 16, 16, dtype=torch.float64)
    half[:, :, :8] = 1.0  # the left half of the texture lies to the camera's left
    left = (retexture(taps(marked, 16), half, base(marked)) - base(marked)).numpy()[0].sum(-1)
    assert left[:, :28].sum() > 10 * left[:, 36:].sum()
    behind = replace(decal, pose=down @ np.diag([1.0, -1.0, -1.0, 1.0]))
    assert not len(render(scene, [view(decals=(behind,))]).fragments), "it looks the other way"
    assert not len(render(scene, [view(decals=(replace(decal, tag=5),))]).fragments), "somebody else wears it"


def test_the_gradient_equals_finite_differences(scene: RenderScene) -> None:
    rng = np.random.default_rng(0)
    picture = render(scene, [view(box(7.0, TextureLayer(0)))])
    for size in ((16, 16), (64, 48), (255, 256)):
        seen = taps(picture, size)
        texture, step = torch.tensor(rng.uniform(0.2, 0.8, (3, *size))), torch.tensor(rng.normal(size=(3, *size)))
        pull = torch.tensor(rng.normal(size=picture.radiance.shape))
        leaf = texture.clone().requires_grad_()
        (retexture(seen, leaf, base(picture)) * pull).sum().backward()
        assert leaf.grad is not None
        ahead, behind = ((retexture(seen, texture + h * step, base(picture)) * pull).sum() for h in (1e-2, -1e-2))
        assert float((leaf.grad * step).sum()) == pytest.approx(float(ahead - behind) / 2e-2, rel=1e-5)


def test_small_textures_and_far_things_still_get_gradient(scene: RenderScene) -> None:
    """Far away a pixel spans many texels: through the pyramid each of those that are seen gets its share."""
    shares = []
    for distance in (8.0, 40.0):
        picture = render(scene, [view(box(distance, TextureLayer(0)))])
        leaf = torch.zeros(3, 128, 128, dtype=torch.float64, requires_grad=True)
        retexture(taps(picture, 128), leaf, base(picture)).sum().backward()
        assert leaf.grad is not None
        shares.append(float((leaf.grad.abs().sum(0) > 0).double().mean()))
    assert shares[1] > 0.5 * shares[0]


@given(st.integers(1, 70), st.integers(1, 70), st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_the_pyramid_keeps_the_mean_over_the_mask(height: int, width: int, seed: int) -> None:
    """At every level, weighted with how much of the mask a row has; and outside of the mask nothing counts."""
    rng = np.random.default_rng(seed)
    texture, mask = torch.tensor(rng.uniform(0, 1, (3, height, width))), torch.tensor(rng.random((height, width)) < 0.4)
    mask[rng.integers(height), rng.integers(width)] = True
    rows = pyramid(texture, mask)
    assert torch.allclose(rows[-1], texture[:, mask].mean(1))
    assert len(rows) == sum(h * w for h, w in levels_of((height, width)))
    magenta = torch.where(mask, texture, torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64)[:, None, None])
    coarse = slice(height * width, None)
    assert torch.equal(pyramid(magenta, mask)[coarse], rows[coarse])


@pytest.mark.parametrize("size", [(64, 64), (256, 256), (100, 180)])
def test_the_colour_of_the_gutter_changes_no_pixel(scene: RenderScene, size: tuple[int, int]) -> None:
    """From near and far, a car in every direction: what is printed where the car is not is never seen."""
    mask = paint_mask(CAR, size)
    assert 0.1 < mask.mean() < 0.9
    views = []
    for k, distance in enumerate((5.0, 12.0, 25.0, 60.0)):
        pose = place(distance, 0.0)
        cos, sin = np.cos(1.3 * k + 0.4), np.sin(1.3 * k + 0.4)
        pose[:2, :2] = [[cos, -sin], [sin, cos]]
        views.append(view(SceneObject(2, pose, tag=1, layers=(TextureLayer(0),))))
    picture = render(scene, views)
    seen = taps(picture, size, mask=mask)
    colours = torch.tensor(np.random.default_rng(0).uniform(0, 1, (3, *size)))
    gutter = torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64)[:, None, None]
    one, other = (torch.where(torch.tensor(mask), colours, g) for g in (gutter, 0.0 * gutter))
    assert torch.equal(retexture(seen, one, base(picture)), retexture(seen, other, base(picture)))
    unmasked = taps(picture, size)
    leak = (retexture(unmasked, one, base(picture)) - retexture(unmasked, other, base(picture))).abs().max()
    assert leak > 0.01, "without the mask it is seen"


def test_wrong_textures_are_refused_in_one_line(scene: RenderScene) -> None:
    picture = render(scene, [view(box(7.0, TextureLayer(0)))])
    seen = taps(picture, 16)
    grey = torch.full((3, 16, 16), 0.5, dtype=torch.float64)
    nan = grey.clone()
    nan[0, 0, 0] = torch.nan
    for wrong in (torch.zeros(3, 32, 32), torch.zeros(16, 16, 3), torch.zeros(3, 16, 8), grey + 5.0, grey - 1.0, nan):
        with pytest.raises(ConfigError) as error:
            retexture(seen, wrong, base(picture))
        assert "\n" not in str(error.value)
    for size in (0, (4, 0), 1 << 15):
        with pytest.raises(ConfigError, match="texels"):
            texture_taps(picture, size)
    with pytest.raises(ConfigError, match="mask"):
        texture_taps(picture, 16, mask=np.ones((8, 8), bool))
    with pytest.raises(ConfigError, match="mask"):
        texture_taps(picture, 16, mask=np.zeros((16, 16), bool))
    for wrong_layer in (
        lambda: TextureLayer(-1),
        lambda: TextureLayer(0, (0.5, 0.0, 0.5, 1.0)),
        lambda: TextureLayer(0, opacity=1.5),
        lambda: TextureLayer(0, mask=np.full((2, 2), 2.0, np.float32)),
        lambda: TextureLayer(0, mask=np.zeros(4, np.float32)),
        lambda: TextureDecal(0, np.eye(3), (1.0, 1.0)),
        lambda: TextureDecal(0, np.eye(4), (0.0, 1.0)),
    ):
        with pytest.raises(ConfigError):
            wrong_layer()
    low, high = PRINTABLE
    assert to_printable(torch.tensor([-1.0, 0.0, 1.0, 7.0])).tolist() == pytest.approx([low, low, high, high])
