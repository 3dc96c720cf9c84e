"""The camera's response in torch, after a texture."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ssad.core.frames import FORWARD, Camera
from ssad.core.seeding import generator
from ssad.rendering.bodies import make_body
from ssad.rendering.camera.glare import with_lens_effects
from ssad.rendering.camera.render import Rendering, SceneWeather, View, render
from ssad.rendering.camera.scene import RenderScene, SceneObject, TextureLayer
from ssad.rendering.camera.sensor import DEFAULT_SENSOR
from ssad.rendering.camera.texture import retexture, texture_taps, to_linear
from ssad.rendering.camera.torch_sensor import develop
from ssad.rendering.meshes.mesh import Material, build


@pytest.fixture(scope="module")
def stage() -> RenderScene:
    vertices = np.array([[-9, -9, 0], [40, -9, 0], [40, 9, 0], [-9, 9, 0]], float)
    ground = Material("ground", (0.2, 0.2, 0.2), gloss=0.1)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    floor = build(vertices, faces, materials=(ground,), uv=vertices[faces][..., :2])
    return RenderScene(None, [floor, make_body("car", style="sedan", generator=generator("torch texture"))])


DAY = SceneWeather(0.8, 2.0, 0.2)


def view(*, worn: bool = False, weather: SceneWeather = DAY) -> View:
    pose = np.eye(4)
    pose[:2, :2] = [[0.8, -0.6], [0.6, 0.8]]
    pose[0, 3] = 9.0
    things = (
        SceneObject(0, np.eye(4), tag=1),
        SceneObject(1, pose, (0.6, 0.1, 0.2), 2, (TextureLayer(0),) if worn else ()),
    )
    return View(Camera.typical(96, 64), FORWARD, things, weather)


@pytest.fixture(scope="module")
def picture(stage: RenderScene) -> Rendering:
    return render(stage, [view(worn=True)])


def test_the_developed_picture_is_that_of_the_renderer(stage: RenderScene, picture: Rendering) -> None:
    painted = render(stage, [view()])
    lens = with_lens_effects(DEFAULT_SENSOR, painted.effects)
    shown = develop(torch.tensor(painted.radiance), torch.tensor(painted.exposure), lens) * 255
    assert (shown[0].permute(1, 2, 0).numpy() - painted.image[0]).__abs__().max() < 1.2
    colour = torch.tensor([0.6, 0.1, 0.2])[:, None, None].expand(3, 32, 32)
    worn = retexture(texture_taps(picture, 32), colour, torch.tensor(picture.radiance))
    again = develop(worn, torch.tensor(picture.exposure), lens) * 255
    assert (again[0].permute(1, 2, 0).numpy() - painted.image[0]).__abs__().max() < 1.5


def test_gradient_through_the_camera_equals_finite_differences(picture: Rendering) -> None:
    held = texture_taps(picture, 16, dtype=torch.float64)
    radiance = torch.tensor(picture.radiance, dtype=torch.float64)
    weight = torch.randn(1, 3, 64, 96, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    start = torch.rand(3, 16, 16, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    step = torch.randn(3, 16, 16, dtype=torch.float64, generator=torch.Generator().manual_seed(2))

    def loss(texture: torch.Tensor) -> torch.Tensor:
        return (develop(retexture(held, to_linear(texture), radiance), float(picture.exposure[0])) * weight).sum()

    leaf = start.clone().requires_grad_()
    loss(leaf).backward()
    assert leaf.grad is not None
    h = 1e-5
    expected = (loss(start + h * step) - loss(start - h * step)) / (2 * h)
    assert float((leaf.grad * step).sum()) == pytest.approx(float(expected), rel=1e-5)
