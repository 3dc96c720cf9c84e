"""Glare of the lens: its light is conserved, falls off as published, and is the same in torch."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import warp as wp

from ssad.core.errors import ConfigError
from ssad.core.frames import FORWARD, Camera
from ssad.rendering.camera import glare
from ssad.rendering.camera.effects import NO_EFFECTS
from ssad.rendering.camera.render import RenderQuality, SceneWeather, View, develop_radiance, render, scene_light
from ssad.rendering.camera.scene import RenderScene, SceneObject
from ssad.rendering.camera.sensor import DEFAULT_SENSOR, PINHOLE, SensorModel
from ssad.rendering.camera.torch_sensor import ChangedWindow, develop, photosites, scatter, scatter_parts
from ssad.rendering.meshes.mesh import Material, build

HAZY = SensorModel(glare=1.0)
CLEAR = RenderQuality(effects=NO_EFFECTS)
HAZY_PINHOLE = replace(PINHOLE, glare=0.5)
FLARING = SensorModel(glare=0.5, flare=40.0)
SIZES = ((40, 56), (45, 37), (5, 4))


def images(height: int, width: int, count: int = 1) -> np.ndarray:
    """Return dark images with bright points, [B, H, W, 3] float32."""
    return 50 * np.random.default_rng(height).random((count, height, width, 3), np.float32) ** 6


def scattered(radiance: np.ndarray, sensors: list[SensorModel]) -> np.ndarray:
    held = wp.array(radiance, dtype=wp.vec3, device="cpu")
    return np.asarray(glare.scatter(held, sensors).numpy())


@pytest.mark.parametrize("size", SIZES)
def test_scattering_conserves_light_and_even_fields(size: tuple[int, int]) -> None:
    radiance = images(*size)
    assert scattered(radiance, [HAZY]).sum(dtype=float) == pytest.approx(radiance.sum(dtype=float), rel=1e-6)
    assert scattered(np.ones_like(radiance), [HAZY]) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("size", SIZES)
def test_torch_scatters_as_the_renderer_does(size: tuple[int, int]) -> None:
    radiance = images(*size, 2)
    shown = scattered(radiance, [FLARING, HAZY])
    for index, sensor in enumerate((FLARING, HAZY)):
        expected = scatter(torch.tensor(radiance[index : index + 1], dtype=torch.float64), sensor)
        assert shown[index] == pytest.approx(expected[0].numpy(), abs=2e-5)


def test_a_lens_without_glare_changes_no_bit() -> None:
    radiance = images(20, 24, 2)
    held = wp.array(radiance, dtype=wp.vec3, device="cpu")
    assert glare.scatter(held, [DEFAULT_SENSOR, PINHOLE]) is held
    assert (scattered(radiance, [DEFAULT_SENSOR, HAZY])[0] == radiance[0]).all()
    views = [View(Camera.typical(24, 20), FORWARD, sensor=sensor) for sensor in (DEFAULT_SENSOR, HAZY)]
    alone = develop_radiance(wp.array(radiance[:1], dtype=wp.vec3, device="cpu"), views[:1], [0.5]).numpy()
    both = develop_radiance(held, views, [0.5, 0.5]).numpy()
    assert (both[0] == alone[0]).all()
    assert (both[1] != develop_radiance(held, [views[0]] * 2, [0.5, 0.5]).numpy()[1]).any()


def test_a_point_has_the_veil_of_the_cie() -> None:
    """The light in rings around it, over the disability glare equation for a young eye."""
    side = 256
    point = np.zeros((1, side, side, 3))
    point[0, 100, 120] = 1.0
    veil = scatter(torch.tensor(point), replace(HAZY, focal=2.2))[0, :, :, 0].numpy()
    rows, columns = np.mgrid[:side, :side]
    distance = np.hypot(rows - 100, columns - 120)
    focal = 2.2 * side
    for inner, outer in ((1.5, 3), (3, 6), (6, 12), (12, 24), (24, 48)):
        ring = (distance >= inner) & (distance < outer)
        degrees = np.degrees(distance[ring] / focal)
        expected = (10 / degrees**3 * (degrees**2 / (degrees**2 + 0.01)) ** 1.5 + 5 / (degrees**2 + 0.01)) / focal**2
        assert 0.85 < veil[ring].sum() / expected.sum() < 1.1


def test_halving_is_the_transpose_of_enlarging() -> None:
    for size in (4, 7, 10):
        (weights,) = glare.pyramid_weights(size, 1)
        enlarged = torch.nn.functional.interpolate(
            torch.eye(len(weights), dtype=torch.float64)[:, None], scale_factor=2, mode="linear"
        )[:, 0, :size].numpy()
        taps = 2 * np.arange(len(weights))[:, None] + np.arange(-1, 3)
        for row, (tap, weight) in enumerate(zip(taps, weights, strict=True)):
            expected = np.zeros(size + 3)
            expected[1 : size + 1] = enlarged[row] / enlarged[row].sum()
            assert weight == pytest.approx(expected[tap + 1])


def test_a_ghost_is_mirrored_about_the_middle_and_takes_its_light_from_the_image(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(glare, "GHOSTS", ((-1.0, (0.5, 1.0, 1.0)),))
    point = np.zeros((1, 64, 64, 3))
    point[0, 16, 44] = 1e6
    behind = scatter(torch.tensor(point), SensorModel(flare=1.0))[0].numpy()
    assert behind[:32].sum((0, 1)) == pytest.approx([1e6 * (1 - 0.005**2)] * 3, abs=1.0)
    ghost = behind[32:]
    assert ghost.sum((0, 1)) == pytest.approx([12.5, 25.0, 25.0], rel=0.02)
    rows, columns = np.mgrid[32:64, :64]
    assert (ghost[..., 1] * rows).sum() / ghost[..., 1].sum() == pytest.approx(63 - 16, abs=0.5)
    assert (ghost[..., 1] * columns).sum() / ghost[..., 1].sum() == pytest.approx(63 - 44, abs=0.5)


def test_parts_scatter_as_the_whole_images_do() -> None:
    """Two parts, one of them at the corner of its image; all else is dark."""
    size, corners, part = (180, 256), [(32, 48), (132, 160)], (48, 96)
    corners[1] = (size[0] - part[0]) // 16 * 16, size[1] - part[1]
    part = size[0] - corners[1][0], part[1]
    light = np.zeros((2, *size, 3))
    generator = np.random.default_rng(5)
    light[0, 50:58, 70:120] = generator.uniform(0, 900, (8, 50, 3))
    light[1, 150:180, 200:256] = generator.uniform(0, 900, (30, 56, 3))
    crops = [(slice(row, row + part[0]), slice(column, column + part[1])) for row, column in corners]
    whole = scatter(torch.tensor(light), FLARING)
    parts = torch.stack([torch.tensor(light)[index][crop] for index, crop in enumerate(crops)])
    shown = scatter_parts(parts, FLARING, corners, size)
    # Near the border of a part that is none of the image, what lies beyond is missing.
    inner_parts = (slice(16, -16), slice(16, -16)), (slice(16, None), slice(16, None))
    for index, (crop, inner) in enumerate(zip(crops, inner_parts, strict=True)):
        torch.testing.assert_close(shown[index][inner], whole[index][crop][inner], rtol=0, atol=1e-6 * 900)
    assert scatter_parts(parts, PINHOLE, corners, size) is parts


def test_gradients_of_scattered_light_equal_finite_differences() -> None:
    start = torch.tensor(images(9, 13), dtype=torch.float64)
    step = torch.randn(start.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    weight = torch.randn((1, 3, 9, 13), dtype=torch.float64, generator=torch.Generator().manual_seed(2))

    def loss(radiance: torch.Tensor) -> torch.Tensor:
        return (develop(radiance, 0.02, FLARING) * weight).sum()

    leaf = start.clone().requires_grad_()
    loss(leaf).backward()
    assert leaf.grad is not None
    difference = (loss(start + 1e-6 * step) - loss(start - 1e-6 * step)) / 2e-6
    assert float((leaf.grad * step).sum()) == pytest.approx(float(difference), rel=1e-5)


def test_the_window_of_a_changed_pixel_is_the_whole_image() -> None:
    radiance = torch.tensor(images(24, 40, 2))
    changed = radiance.clone()
    changed[0, 3, 4] += 100.0
    window = ChangedWindow.around(torch.tensor([3 * 40 + 4]), (2, 24, 40), FLARING)
    before = develop(radiance, 0.5, FLARING)
    pasted = window.paste(window.develop(window.crop(changed), 0.5), before)
    assert torch.allclose(pasted, develop(changed, 0.5, FLARING), atol=1e-6)
    assert (pasted[0, :, 20, 36] > before[0, :, 20, 36]).all()


def test_the_disc_of_the_sun_sends_all_its_light_unless_something_hides_it() -> None:
    vertices = np.array([[9, -9, -9], [9, 9, -9], [9, 9, 9], [9, -9, 9]], float)
    wall = build(vertices, np.array([[0, 2, 1], [0, 3, 2]]), materials=(Material("wall", (0.2, 0.2, 0.2)),))
    stage = RenderScene(None, [wall])
    weather = SceneWeather(0.05, 0.03, 0.0)
    camera = Camera.typical(96, 64)
    views = [View(camera, FORWARD, (), weather, sensor) for sensor in (PINHOLE, replace(PINHOLE, glare=0.1))]
    views.append(replace(views[1], objects=(SceneObject(0, np.eye(4), tag=1),)))
    plain, glaring, hidden = render(stage, views, quality=CLEAR).radiance.astype(float)
    irradiance = np.pi * np.array(scene_light(weather)[0][1])
    focal = camera.intrinsic[0, 0] * camera.intrinsic[1, 1]
    assert (glaring - plain).sum((0, 1)) / focal == pytest.approx(irradiance, rel=0.25)
    assert hidden.max() < 0.01 * glaring.max()


def test_settings_out_of_range_are_refused() -> None:
    for settings in ({"glare": -0.1}, {"glare": 4.0}, {"flare": 101.0}, {"focal": 0.0}, {"glare": float("nan")}):
        with pytest.raises(ConfigError, match="must be"):
            SensorModel(**settings)
    with pytest.raises(ConfigError, match="need 4 pixels"):
        photosites(torch.zeros(1, 3, 9, 3), replace(PINHOLE, glare=0.1))


def test_lit_lamps_glow_at_night_with_the_light_of_their_luminance() -> None:
    """A lens of a signal and an unlit panel of the same size, by night and by day."""
    corners = np.array([[0, 0.3, -0.3], [0, -0.3, -0.3], [0, -0.3, 0.3], [0, 0.3, 0.3]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    lens = build(corners, faces, materials=(Material("signal_light", (1.0, 0.004, 0.002), emission=4.0),))
    panel = build(corners, faces, materials=(Material("door", (1.0, 0.004, 0.002), emission=4.0),))
    stage = RenderScene(None, [lens, panel])
    pose = np.eye(4)
    pose[0, 3] = 20.0
    camera = Camera.typical(96, 64)
    for height, glows in ((-0.3, True), (0.8, False)):
        weather = SceneWeather(height, 2.0, 0.0)
        views = [
            View(camera, FORWARD, (SceneObject(mesh, pose),), weather, sensor)
            for mesh in (0, 1)
            for sensor in (PINHOLE, HAZY_PINHOLE)
        ]
        plain, hazy, unlit, hazy_unlit = render(stage, views, quality=CLEAR).radiance.astype(float)
        assert (hazy_unlit == unlit).all()
        if not glows:
            assert (hazy == plain).all()
            continue
        glow = hazy - plain
        # The lens scatters its shares of the light of 10,500 cd/m^2, less that of the image; reflections do not count.
        colour = np.array([1.0, 0.004, 0.002])
        shown = plain[..., 0][plain[..., 0] > 1.0].sum() * colour
        nominal = 4.0 * colour @ [0.2126, 0.7152, 0.0722]
        gain = 10_500 * np.pi / 60 / nominal - 1.0
        expected = shown * gain * glare.glare_weights(HAZY_PINHOLE, 64, 96).sum()
        assert glow.sum((0, 1)) == pytest.approx(expected, rel=0.15)
        assert glow[32, 60, 0] > 2 * plain[32, 60, 0]
