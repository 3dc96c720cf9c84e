"""Lamps in torch: the light that the renderer gives, and its gradient."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from ssad.core.errors import ConfigError
from ssad.core.frames import FORWARD, Camera
from ssad.rendering.camera.lamps import SceneLamp
from ssad.rendering.camera.render import PLAIN, Rendering, SceneWeather, View, render
from ssad.rendering.camera.scene import RenderScene, SceneObject
from ssad.rendering.camera.torch_lamp import lamp_light, shine
from ssad.rendering.meshes import mesh as meshes
from ssad.rendering.meshes.mesh import Material, build

GREY = Material("grey", (0.4, 0.3, 0.2), specular=0.0, gloss=0.0)
CAMERA = Camera(96, 64, np.array([[90.0, 0, 48.0], [0, 90.0, 32.0], [0, 0, 1]]))
FOG = 0.01


@pytest.fixture(scope="module")
def view() -> tuple[RenderScene, View]:
    """A block on the ground by dusk, from 1.7 m."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float) * 60
    ground = build(corners, np.array([[0, 1, 2], [0, 2, 3]]), materials=(GREY,))
    block = meshes.box((2.0, 3.0, 2.0), material=GREY, centre=(0.0, 0.0, 1.0))
    eye = FORWARD.copy()
    eye[:3, 3] = -9.0, 0.0, 1.7
    things = SceneObject(0, np.eye(4)), SceneObject(1, np.eye(4))
    return RenderScene(None, [ground, block]), View(CAMERA, eye, things, SceneWeather(sun_height=0.0, fog=FOG))


def lamp(**other: object) -> SceneLamp:
    """Above the camera and to its left, turned towards the block."""
    pose = FORWARD.copy()
    cos, sin = np.cos(0.3), np.sin(0.3)
    pose[:3, :3] = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]]) @ pose[:3, :3]
    pose[:3, 3] = -8.0, 2.0, 2.5
    return SceneLamp(**({"pose": pose, "power": 40.0, "spread": (0.5, 0.3), "shadows": False, "reach": 40.0} | other))  # type: ignore[arg-type]


def seen(made: tuple[RenderScene, View], *lamps: SceneLamp) -> Rendering:
    scene, view = made
    return render(scene, [replace(view, lamps=lamps)], surface=True, quality=PLAIN)


def added(picture: Rendering, one: SceneLamp, **given: Tensor) -> Tensor:
    """What the lamp adds to the radiance of a picture, float64."""
    assert picture.surface is not None
    place, normal = (torch.tensor(v, dtype=torch.float64) for v in (picture.surface.position, picture.surface.normal))
    return shine(picture, lamp_light(one, place, normal, fog=FOG, **given))


@pytest.mark.parametrize("other", [{}, {"square": True}, {"soft": 0.0}, {"colour": (0.2, 1.0, 0.5), "reach": 12.0}])
def test_the_light_is_the_renderers(view: tuple[RenderScene, View], other: dict[str, object]) -> None:
    """But at the edges of things, where a pixel shows two, and at the rim of the light."""
    one = lamp(**other)
    dark, lit = seen(view), seen(view, one)
    wanted = lit.radiance.astype(float) - dark.radiance
    found = added(dark, one).numpy()
    assert (wanted > 0.02).mean() > 0.1
    assert wanted.max() > 0.2
    assert (np.abs(found - wanted) < 0.002 + 0.01 * wanted).mean() > 0.95


def test_gradients_are_those_of_finite_differences(view: tuple[RenderScene, View]) -> None:
    one, dark = lamp(soft=0.8), seen(view)
    assert dark.surface is not None
    some = np.flatnonzero(dark.tag.ravel() >= 0)[::97]
    place, normal = (
        torch.tensor(v.reshape(-1, 3)[some], dtype=torch.float64) for v in (dark.surface.position, dark.surface.normal)
    )
    start = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (one.pose, one.power, one.spread)]

    def light(pose: Tensor, power: Tensor, spread: Tensor) -> Tensor:
        return lamp_light(one, place, normal, pose=pose, power=power, spread=spread, fog=FOG)

    assert float(light(*start).detach().sum()) > 1.0
    assert torch.autograd.gradcheck(light, start, eps=1e-6, atol=1e-6, rtol=1e-4)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_gradient_is_how_rendered_pictures_change(view: tuple[RenderScene, View], axis: int) -> None:
    """The light that a patch of the block gets while the lamp moves, rendered and by the gradient."""
    one, step = lamp(soft=1.0, spread=(0.6, 0.5)), 0.05
    patch = (slice(0, 1), slice(24, 34), slice(42, 56))
    pose = torch.tensor(one.pose, requires_grad=True)
    added(seen(view), one, pose=pose)[patch].sum().backward()  # type: ignore[no-untyped-call]
    sides = []
    for sign in (1.0, -1.0):
        moved = one.pose.copy()
        moved[axis, 3] += sign * step
        sides.append(float(seen(view, replace(one, pose=moved)).radiance[patch].astype(float).sum()))
    assert pose.grad is not None
    slope = (sides[0] - sides[1]) / (2 * step)
    assert float(pose.grad[axis, 3]) == pytest.approx(slope, rel=0.05, abs=0.05)


def test_what_cannot_be_is_refused(view: tuple[RenderScene, View]) -> None:
    scene, plain = view
    with pytest.raises(ConfigError, match="projects a texture"):
        lamp_light(lamp(texture=0), torch.zeros(3), torch.zeros(3))
    with pytest.raises(ConfigError, match="surface=True"):
        shine(render(scene, [plain]), torch.zeros(1, 64, 96, 3))
