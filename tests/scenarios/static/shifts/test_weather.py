"""Rain and snow of the physical calibration: flakes near the camera, drops on the lens, outlines in puddles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from ssad.core.frames import Camera, Frame
from ssad.scenarios.static.shifts import ShiftSpec, shift_images
from ssad.scenarios.static.shifts import parameters as table
from ssad.scenarios.static.shifts.batch import to_batch
from ssad.scenarios.static.shifts.depth import depth_grid
from ssad.scenarios.static.shifts.kernels import particles
from ssad.scenarios.static.shifts.light import to_codes, to_linear
from ssad.scenarios.static.shifts.wet import wet_ground

wp.set_module_options({"enable_backward": False})


@wp.kernel
def cover(length: float, angle: float, radius: float, soft: float, out: wp.array2d(dtype=float)):
    """Cover of the cells of a square by a soft disc that moves from its middle."""
    y, x = wp.tid()
    dx = float(x) - 0.3 * float(out.shape[1])
    dy = float(y) - 0.3 * float(out.shape[0])
    out[y, x] = particles.streak_cover(
        dx * wp.cos(angle) + dy * wp.sin(angle), dy * wp.cos(angle) - dx * wp.sin(angle), length, radius, soft
    )


def covered(length: float, angle: float, radius: float, soft: float) -> np.ndarray:
    out = wp.zeros((80, 80), dtype=float, device="cpu")
    wp.launch(cover, dim=out.shape, inputs=[length, angle, radius, soft], outputs=[out], device="cpu")
    return np.asarray(out.numpy())


@pytest.mark.parametrize("angle", [0.0, 0.4, 1.2])
@pytest.mark.parametrize("length", [0.0, 6.0, 30.0])
def test_a_streak_keeps_the_light_of_its_disc_and_has_soft_edges(length: float, angle: float) -> None:
    radius, soft = 7.0, 5.0
    found = covered(length, angle, radius, soft)
    # A disc with an edge that fades linearly over `soft` has the area of radius^2 + soft^2 / 12.
    assert found.sum() == pytest.approx(np.pi * (radius**2 + soft**2 / 12), rel=0.03)
    steps = [np.abs(np.diff(found, axis=axis)).max() for axis in (0, 1)]
    assert max(steps) < 1.5 / soft * max(found.max(), 0.2)
    assert found.max() == pytest.approx(min(1.0, 2 * radius / max(length, 1e-9)), rel=0.1)


def test_drops_on_the_lens_show_a_blurred_scene_without_dots(monkeypatch: pytest.MonkeyPatch) -> None:
    """A fine chequered scene becomes an even grey of the same mean light in a drop."""
    monkeypatch.setattr(table, "RAIN_RATE", (1e-6,) * 5)
    width, height = 1600, 400
    rows, columns = np.mgrid[:height, :width]
    chequered = np.where((rows + columns) % 2, 255, 0).astype(np.uint8)[..., None].repeat(3, -1)
    frame = Frame(Camera.typical(width, height), "drops", depth=np.full((100, 400), np.inf, np.float32))
    image = shift_images(chequered, frame, ShiftSpec("rain", 5))[0]
    drops = np.abs(image.astype(int) - chequered) > 60
    middles = drops[..., 0].copy()
    for axis in (0, 1):
        middles &= np.roll(middles, 1, axis) & np.roll(middles, -1, axis)
    assert middles.sum() > 200
    light = to_linear(image[..., 1])
    # Dark at the rim, else half of white; 15 % of the scene behind the drop shines through.
    drop_light = (light - 0.15 * to_linear(chequered[..., 1]))[middles] / 0.85
    assert 0.5 * 0.5 < np.median(drop_light) < 0.55
    smooth = np.abs(light - np.roll(light, 2, 1))[middles & np.roll(middles, 2, 1)]
    assert np.median(smooth) < 0.05


def test_more_rain_adds_drops_and_moves_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table, "RAIN_RATE", (1e-6,) * 5)
    grey = np.full((96, 160, 3), 128, np.uint8)
    grey[:48] = 220
    frame = Frame(Camera.typical(160, 96), "drops", depth=np.full((24, 40), np.inf, np.float32))
    few, many = (shift_images(grey, frame, ShiftSpec("rain", severity))[0] for severity in (2, 5))
    assert ((few != grey) & (many == grey)).sum() == 0
    assert (many != grey).sum() > 1.5 * (few != grey).sum() > 0


def test_outlines_in_puddles_have_no_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """The mirrored slope of a bright gable ends evenly: from pixel to pixel the light changes little."""
    monkeypatch.setattr(table, "WET_FILM", (5.0,) * 5)
    monkeypatch.setattr(table, "WET_ROUGH", (0.0,) * 5)
    width, height, up, wall = 320, 180, 1.5, 25.0
    camera = Camera.typical(width, height)
    focal = float(camera.intrinsic[0, 0])
    v, u = np.mgrid[:height, :width] + 0.5
    road = np.minimum(up * focal / np.maximum(v - height / 2, 1e-3), wall)
    above = up - (v - height / 2) / focal * wall
    aside = (u - width / 2) / focal * wall
    depth = np.where((above > 0) & (above > 6.0 - np.abs(aside)), np.inf, road)
    image = np.where(np.isinf(depth), 250, 20).astype(np.uint8)[..., None].repeat(3, -1)
    batch = to_batch(image)
    frames = [Frame(camera, "s", depth=depth[2::4, 2::4].astype(np.float32))]
    wet = wet_ground(batch, frames, [ShiftSpec("rain", 5)], depth_grid(batch, frames)).numpy()[0]
    ground = road < wall - 1.0
    light = to_linear(wet[..., 1])
    span = np.ptp(light[ground & (v < 140)])
    steps = np.abs(np.diff(light, axis=1))[(ground & (v < 140))[:, 1:]]
    assert span > 0.05
    assert steps.max() < 0.2 * span


def test_the_papers_weather_has_no_part_in_this() -> None:
    """Drops, flakes and puddles belong to the physical calibration: the other draws by another key."""
    physical, paper = (ShiftSpec("rain", 3, calibration=calibration) for calibration in ("physical", "paper"))
    assert physical.key("lens") != paper.key("lens")
    image = np.full((64, 96, 3), 90, np.uint8)
    frame = Frame(Camera.typical(96, 64), "s", "1")
    shifted = shift_images(image, frame, paper)[0]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(table, "LENS_DROPS", (40,) * 5)
        assert (shift_images(image, frame, paper)[0] == shifted).all()
        assert (to_codes(to_linear(shifted)).round() == shifted).all()
    assert (shift_images(image, frame, replace(paper, severity=5))[0] != shifted).any()
