"""The sensor: lens, mosaic, noise, full photosites, curve and JPEG; the renderer's and torch's, and its gradients."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import warp as wp
from PIL import Image
from torch import Tensor

from ssad.core.errors import ConfigError
from ssad.core.frames import FORWARD, Camera
from ssad.core.images import decode_image, encode_jpeg
from ssad.core.seeding import generator
from ssad.rendering.bodies import make_body
from ssad.rendering.camera import torch_jpeg
from ssad.rendering.camera.effects import NO_EFFECTS
from ssad.rendering.camera.glare import with_lens_effects
from ssad.rendering.camera.render import RenderQuality, SceneWeather, View, develop_radiance, render, response
from ssad.rendering.camera.scene import RenderScene, SceneObject, TextureLayer
from ssad.rendering.camera.sensor import DAY_EXPOSURE, PINHOLE, SensorModel, noise_levels
from ssad.rendering.camera.texture import Taps, retexture, texture_taps
from ssad.rendering.camera.torch_jpeg import jpeg, quantisation, to_8_bits
from ssad.rendering.camera.torch_sensor import (
    ChangedWindow,
    curve,
    demosaic,
    develop,
    develop_at,
    draw_noise,
    fill,
    photosites,
)
from ssad.rendering.meshes.mesh import Material, build

SENSORS = {
    "default": SensorModel(),
    "pinhole": PINHOLE,
    "mosaic alone": SensorModel(blur=0.0),
    "lens alone": SensorModel(mosaic=False),
    "soon full": SensorModel(blur=0.7, full=0.4),
    "three colours, soon full": SensorModel(blur=0.3, mosaic=False, full=0.4),
    "warm and pale": SensorModel(balance=(1.2, 1.0, 0.8), saturation=0.6),
    "hazy and hard": SensorModel(glare=0.6, flare=30.0, gamma=0.8, contrast=0.5),
    "three colours, vivid and soft": SensorModel(mosaic=False, saturation=1.3, gamma=1.2, contrast=-0.3),
}


def draws(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def uniform(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(shape, dtype=torch.float64, generator=draws(seed))


def developed(radiance: Any, sensors: list[SensorModel], exposure: float = DAY_EXPOSURE, *, first_seed: int = 0) -> Any:
    """What the renderer makes of radiance [B, H, W, 3]; the seeds of noise count up from the first."""
    views = [View(Camera.typical(96, 64), FORWARD, sensor=s, seed=first_seed + k) for k, s in enumerate(sensors)]
    held = wp.array(np.asarray(radiance, np.float32), dtype=wp.vec3, device="cpu")
    return develop_radiance(held, views, [exposure] * len(sensors)).numpy()


@pytest.fixture(scope="module")
def stage() -> RenderScene:
    vertices = np.array([[-9, -9, 0], [40, -9, 0], [40, 9, 0], [-9, 9, 0]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    floor = build(
        vertices, faces, materials=(Material("ground", (0.2, 0.2, 0.2), gloss=0.1),), uv=vertices[faces][..., :2]
    )
    return RenderScene(None, [floor, make_body("car", style="sedan", generator=generator("sensor"))])


def look(*, worn: bool = False, away: float = 9.0) -> View:
    pose = np.eye(4)
    pose[:2, :2] = [[0.8, -0.6], [0.6, 0.8]]
    pose[0, 3] = away
    things = (
        SceneObject(0, np.eye(4), tag=1),
        SceneObject(1, pose, (0.6, 0.1, 0.2), 2, (TextureLayer(0),) if worn else ()),
    )
    return View(Camera.typical(97, 63), FORWARD, things, SceneWeather(0.8, 2.0, 0.2))


# ---------------------------------------------------------------- the renderer's chain and torch's


def test_torch_develops_what_the_renderer_does(stage: RenderScene) -> None:
    """Also of views that differ in their sensor, at an odd size."""
    views = [replace(look(), sensor=sensor) for sensor in SENSORS.values()]
    picture = render(stage, views)
    for k, (name, sensor) in enumerate(SENSORS.items()):
        lens = with_lens_effects(sensor, picture.effects)
        shown = develop(torch.tensor(picture.radiance[k : k + 1]), float(picture.exposure[k]), lens)
        apart = (shown[0].permute(1, 2, 0) * 255).round().numpy() - picture.image[k]
        assert np.abs(apart).max() <= 1, name
        assert np.abs(apart).mean() < 0.1, name


def test_both_agree_on_hard_pictures_too() -> None:
    """Every pixel on its own, deep black and far over white: each tap of each site counts."""
    radiance = (6 * uniform(len(SENSORS), 11, 14, 3) ** 4).float()
    image = developed(radiance, list(SENSORS.values()))
    for k, (name, sensor) in enumerate(SENSORS.items()):
        shown = develop(radiance[k : k + 1], DAY_EXPOSURE, sensor)[0].permute(1, 2, 0) * 255
        assert np.abs(shown.numpy() - image[k]).max() < 1.0, name


def test_a_pinhole_is_the_curve_of_the_light() -> None:
    radiance = (3 * uniform(1, 9, 10, 3) ** 3).float().numpy()
    light = np.clip(radiance * np.float32(DAY_EXPOSURE), 0, np.float32(3.999))
    place = (np.sqrt(light) * np.float32(0.5) * 4096).astype(int)
    assert (developed(radiance, [PINHOLE]) == response()[place]).all()


def test_colours_and_tones_are_the_stated_ones() -> None:
    grey = np.full((1, 8, 8, 3), 0.2, np.float32) * np.float32([1.0, 0.5, 2.0])
    balanced = replace(PINHOLE, balance=(1.0, 2.0, 0.5))
    assert (developed(grey, [balanced], 1.0) == round(255 * float(curve(torch.tensor(0.2))))).all()
    pale = developed(grey, [replace(PINHOLE, saturation=0.0)], 1.0)[0, 0, 0]
    assert len(set(pale.tolist())) == 1
    for gamma, contrast in ((0.7, 0.0), (1.0, 0.6), (1.4, -0.4)):
        table = response(gamma, contrast) / 255
        code = np.clip(response() / 255, 0, 1) ** gamma
        assert table == pytest.approx(code + contrast * code * (1 - code) * (2 * code - 1), abs=0.02)
        assert (np.diff(table) >= 0).all()


@pytest.mark.parametrize("sensor", [SensorModel(), SensorModel(mosaic=False, blur=0.7)])
def test_a_flat_field_stays_flat(sensor: SensorModel) -> None:
    for level in (0.02, 0.3, 1.2):
        grey = torch.full((1, 8, 9, 3), level, dtype=torch.float64)
        shown = develop(grey, 1.0, sensor)
        assert shown.max() - shown.min() < 1e-12
        assert float(shown.mean()) == pytest.approx(float(curve(torch.tensor(level, dtype=torch.float64))), abs=1e-12)
        assert np.ptp(developed(grey, [sensor])) == 0


def test_the_lens_spreads_as_far_as_stated_and_loses_nothing() -> None:
    for blur in (0.3, 0.5, 0.7):
        point = torch.zeros(1, 9, 9, 3, dtype=torch.float64)
        point[0, 4, 4] = 1.0
        spread = photosites(point, SensorModel(blur=blur, mosaic=False))[0, :, :, 1]
        away = torch.arange(9) - 4.0
        assert float(spread.sum()) == pytest.approx(1.0)
        assert float((spread.sum(0) * away**2).sum()) == pytest.approx(blur**2)
        assert float((spread.sum(1) * away**2).sum()) == pytest.approx(blur**2)


def test_each_photosite_has_its_colour() -> None:
    colours = torch.tensor([0.1, 0.2, 0.3]).expand(1, 5, 6, 3)
    raw = photosites(colours, SensorModel(blur=0.0))[0]
    assert torch.equal(raw[::2, ::2], torch.full((3, 3), 0.1))
    assert torch.equal(raw[1::2, 1::2], torch.full((2, 3), 0.3))
    assert torch.equal(raw[::2, 1::2], torch.full((3, 3), 0.2))
    assert torch.equal(raw[1::2, ::2], torch.full((2, 3), 0.2))


def test_the_mosaic_keeps_slopes_and_blurs_what_is_finer() -> None:
    y, x = torch.meshgrid(torch.arange(12.0), torch.arange(14.0), indexing="ij")
    slope = (0.2 + 0.01 * x + 0.02 * y).double()
    colours = demosaic(slope[None])[0, 2:-2, 2:-2]
    assert torch.allclose(colours, slope[2:-2, 2:-2, None].expand_as(colours), atol=1e-12)
    fine = (x % 2).double()[..., None].expand(1, 12, 14, 3)
    seen = demosaic(photosites(fine, SensorModel(blur=0.0)))
    assert float((seen - fine).abs().max()) > 0.3, "a mosaic cannot hold stripes of one pixel"


def test_a_full_photosite_holds_no_more_and_has_no_slope() -> None:
    sensor = SensorModel(full=0.5, noise=0.05)
    light = torch.full((1, 8, 8, 3), 5.0, dtype=torch.float64, requires_grad=True)
    sample = draw_noise((1, 8, 8), sensor, draws(0))
    shown = develop(light, 1.0, sensor, sample)
    white = float(curve(torch.tensor(0.5, dtype=torch.float64)))
    assert torch.allclose(shown, torch.full_like(shown, white), atol=1e-12)
    shown.sum().backward()
    assert light.grad is not None
    assert (light.grad == 0).all()
    both = developed(light.detach(), [sensor, replace(sensor, mosaic=False)][:1])
    assert np.ptp(both) == 0
    assert abs(int(both.flat[0]) - 255 * white) < 1.0
    assert np.ptp(developed(light.detach(), [replace(sensor, mosaic=False)])) == 0


# ---------------------------------------------------------------- noise


@pytest.mark.parametrize("mosaic", [True, False])
@pytest.mark.parametrize("exposure", [DAY_EXPOSURE, 16 * DAY_EXPOSURE])
def test_noise_has_the_stated_deviation_and_no_bias(mosaic: bool, exposure: float) -> None:
    """Of red at its own sites, where no neighbour is mixed in. The exposure of a night has more of it."""
    sensor, light = SensorModel(noise=0.02, mosaic=mosaic), 0.25
    photons, dark = noise_levels(sensor.noise, exposure)
    assert (photons, dark) == pytest.approx((0.0004, 0.004) if exposure == DAY_EXPOSURE else (0.0016, 0.016))
    expected = np.sqrt(photons * light + dark**2)
    flat = torch.full((1, 160, 200, 3), light / exposure)
    step = 1e-4
    bent = float(curve(torch.tensor(light + step)) - curve(torch.tensor(light - step))) / (2 * step) * 255
    middle = float(curve(torch.tensor(light))) * 255
    sample = draw_noise((1, 160, 200), sensor, draws(3))
    for codes in (
        developed(flat, [sensor], exposure)[0],
        develop(flat, exposure, sensor, sample)[0].permute(1, 2, 0) * 255,
    ):
        red = np.asarray(codes)[::2, ::2, 0].astype(float)
        # 8000 numbers: three deviations of their mean and of their deviation, and rounding
        assert red.std() == pytest.approx(bent * expected, rel=0.05, abs=0.05)
        assert abs(red.mean() - middle) < 0.05 + 4 * bent * expected / np.sqrt(red.size)


def test_equal_seeds_give_equal_noise_and_others_do_not() -> None:
    flat = torch.full((2, 20, 30, 3), 0.5)
    for sensor in (SensorModel(noise=0.02), SensorModel(noise=0.02, mosaic=False)):
        once, again = (developed(flat, [sensor] * 2, first_seed=s) for s in (5, 6))
        assert (once[1] == again[0]).all()
        assert (once[0] != once[1]).mean() > 0.5
        shape = (2, 20, 30)
        assert torch.equal(develop(flat, 1.0, sensor, draws(1)), develop(flat, 1.0, sensor, draws(1)))
        assert torch.equal(
            develop(flat, 1.0, sensor, draws(1)), develop(flat, 1.0, sensor, draw_noise(shape, sensor, draws(1)))
        )
        assert not torch.equal(develop(flat, 1.0, sensor, draws(1)), develop(flat, 1.0, sensor, draws(2)))


# ---------------------------------------------------------------- gradients


def unrounded(image: np.ndarray, quality: int, subsampling: str) -> np.ndarray:
    """JPEG of [1, 3, H, W] with all its parts and no rounding."""
    (height, width), block = image.shape[2:], 16 if subsampling == "420" else 8
    room = [(0, -side % block) for side in (height, width)]
    padded = np.pad(image * 255, [(0, 0), (0, 0), *room], mode="edge")
    planes = np.einsum("ij,bjhw->bihw", np.array(torch_jpeg.TO_YCBCR) / 65536, padded)[0]
    k = np.arange(8)
    cosines = np.cos(np.pi * (2 * k + 1) * k[:, None] / 16) / 2
    cosines[0] /= np.sqrt(2)

    def coded(plane: np.ndarray, table: np.ndarray) -> np.ndarray:
        blocks = plane.reshape(plane.shape[0] // 8, 8, -1, 8).transpose(0, 2, 1, 3)
        kept = cosines @ blocks @ cosines.T / table * table
        return np.asarray((cosines.T @ kept @ cosines).transpose(0, 2, 1, 3).reshape(plane.shape))

    tables, found = quantisation(quality), []
    for number, plane in enumerate(planes):
        if not number or subsampling == "444":
            found.append(coded(plane, tables[min(number, 1)]))
            continue
        small = plane.reshape(plane.shape[0] // 2, 2, -1, 2).mean((1, 3))
        high, wide = -(-height // 2), -(-width // 2)
        small[high:] = small[high - 1]
        small = coded(small, tables[1])
        small = np.pad(
            np.pad(small[:high, :wide], [(0, n - m) for n, m in zip(small.shape, (high, wide), strict=True)], "edge"),
            1,
            "edge",
        )
        for axis in (0, 1):
            middle = 3 * small.take(range(1, small.shape[axis] - 1), axis)
            before, after = (middle + small.take(range(first, first + middle.shape[axis]), axis) for first in (0, 2))
            small = (
                np.stack([before, after], axis + 1).reshape(
                    [2 * n if m == axis else n for m, n in enumerate(middle.shape)]
                )
                / 4
            )
        found.append(small)
    return np.asarray(
        np.einsum("ij,jhw->ihw", np.array(torch_jpeg.FROM_YCBCR), np.stack(found))[None, :, :height, :width] / 255
    )


def check(part: Callable[[Tensor], Tensor], given: Tensor) -> None:
    """The gradient of a random sum of what comes out, against differences along random steps."""
    leaf = given.clone().requires_grad_()
    out = part(leaf)
    pull = torch.randn(out.shape, dtype=torch.float64, generator=draws(10))
    (out * pull).sum().backward()
    assert leaf.grad is not None
    for seed in (11, 12, 13):
        step = torch.randn(given.shape, dtype=torch.float64, generator=draws(seed))
        ahead, behind = (float((part(given + h * step) * pull).sum()) for h in (1e-6, -1e-6))
        assert float((leaf.grad * step).sum()) == pytest.approx((ahead - behind) / 2e-6, rel=1e-6, abs=1e-7)


def test_every_part_has_the_gradient_of_finite_differences() -> None:
    light, raw = 0.2 + 0.1 * uniform(2, 7, 8, 3, seed=1), 0.2 + uniform(2, 7, 8, seed=2)  # nothing full, nothing black
    sensor = SensorModel(noise=0.1)
    sample = 0.1 * draw_noise((2, 7, 8), sensor, draws(4)).double()
    exposure = torch.tensor([0.3, 2.0], dtype=torch.float64)
    check(lambda v: photosites(v, sensor), light)
    check(lambda v: photosites(v, SensorModel(mosaic=False)), light)
    check(lambda v: fill(v, exposure, sensor, sample), raw)
    check(demosaic, raw)
    check(lambda v: curve(v * 3.0), raw)
    check(lambda v: curve(v * 0.002), raw)
    check(lambda v: develop(v, exposure, sensor, sample), light)
    check(lambda v: develop(v, exposure, SensorModel(mosaic=False)), light)
    toned = SensorModel(balance=(1.2, 1.0, 0.7), saturation=0.6, gamma=0.8, contrast=0.5)
    check(lambda v: develop(v, exposure, toned), light)


@pytest.mark.parametrize("subsampling", ["420", "444"])
def test_jpeg_has_the_slope_that_it_would_have_without_rounding(subsampling: str) -> None:
    image = 0.4 + 0.2 * uniform(1, 3, 11, 18, seed=1)  # no colour near black or white
    pull = torch.randn(image.shape, dtype=torch.float64, generator=draws(2))
    leaf = image.clone().requires_grad_()
    (jpeg(leaf, 75, subsampling) * pull).sum().backward()
    assert leaf.grad is not None
    assert float((to_8_bits(image) * 255 - (image * 255).round()).abs().max()) < 1e-9
    middle = unrounded(image.numpy(), 75, subsampling)
    for place in [(0, 0, 0), (1, 5, 9), (2, 10, 17), (0, 10, 3), (1, 2, 17), (2, 7, 12)]:
        one = np.zeros((1, 3, 11, 18))
        one[0][place] = 1.0
        slope = ((unrounded(image.numpy() + one, 75, subsampling) - middle) * pull.numpy()).sum()
        assert float(leaf.grad[0][place]) == pytest.approx(float(slope), abs=1e-9), place


def test_what_is_cut_off_has_no_slope() -> None:
    image = torch.full((1, 3, 16, 16), 0.5, dtype=torch.float64)
    image[..., 8:] = torch.tensor([1.2, 0.5, -0.1], dtype=torch.float64)[:, None, None]
    leaf = image.requires_grad_()
    jpeg(leaf, 92, "444").sum().backward()
    assert leaf.grad is not None
    assert (leaf.grad[0, [0, 2], :, 8:] == 0).all()
    assert (leaf.grad[..., :8] - 1.0).abs().max() < 1e-4, "the sum of a grey is that of its colours"


# ---------------------------------------------------------------- JPEG


def pictures() -> dict[str, Any]:
    """uint8 pictures [H, W, 3]: soft forms with noise, at a size of whole blocks, an odd one and one of half a block;
    noise alone; wedges with hard edges."""
    rng = np.random.default_rng(0)

    def forms(height: int, width: int) -> Any:
        soft = cv2.GaussianBlur(rng.uniform(0, 255, (height, width, 3)), (0, 0), 4) * 6 - 640
        return np.clip(soft + rng.normal(0, 4, soft.shape), 0, 255).astype(np.uint8)

    wedge = np.stack(np.broadcast_arrays(np.arange(48)[:, None] * 5, np.arange(64)[None] * 4, 90), -1)
    wedge[10:20, 15:40] = 250, 10, 20
    return {
        "forms": forms(64, 96),
        "odd": forms(61, 45),
        "half": forms(56, 72),
        "wedge": wedge.astype(np.uint8),
        "noise": rng.integers(0, 256, (34, 46, 3)).astype(np.uint8),
    }


@pytest.mark.parametrize("quality", [30, 75, 92, 96])
@pytest.mark.parametrize("subsampling", ["420", "444"])
def test_jpeg_is_libjpegs(quality: int, subsampling: str) -> None:
    """The recorder's encoder, whose DCT is the fast one below 96, and OpenCV's with the accurate one."""
    factor = {"420": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420, "444": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444}[subsampling]
    settings = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, factor]
    for name, image in pictures().items():
        given = torch.tensor(image).permute(2, 0, 1)[None].float() / 255
        files = {
            None: encode_jpeg(image, quality, subsampling),
            False: cv2.imencode(".jpg", image[..., ::-1], settings)[1].tobytes(),
        }
        for fast, file in files.items():
            ours = jpeg(given, quality, subsampling, fast=fast)[0].permute(1, 2, 0).numpy() * 255
            apart = np.abs(ours.round() - decode_image(file))
            assert (apart <= 2).mean() >= 0.995, (name, fast)
            assert (apart == 0).mean() > 0.9, (name, fast)
            # where blocks stand out of the picture
            assert (apart[-1] == 0).mean() > 0.85, (name, fast)
            assert (apart[:, -1] == 0).mean() > 0.85, (name, fast)


def test_the_tables_are_those_of_the_file() -> None:
    image = np.zeros((16, 16, 3), np.uint8)
    for quality in (1, 30, 50, 92, 100):
        tables = Image.open(io.BytesIO(encode_jpeg(image, quality, "420"))).quantization
        for ours, theirs in zip(quantisation(quality), (tables[0], tables[1]), strict=True):
            assert ours.reshape(-1).tolist() == list(theirs)


def test_jpeg_does_not_hang_on_floating_point_and_batch() -> None:
    images = torch.stack([torch.tensor(pictures()["odd"][:40, :40]), torch.tensor(pictures()["forms"][:40, :40])])
    given = images.permute(0, 3, 1, 2) / 255
    single, double = jpeg(given.float(), 75), jpeg(given.double(), 75)
    assert float((single - double).abs().max()) < 1e-6
    assert torch.equal(jpeg(given[1:].float(), 75), single[1:])


# ---------------------------------------------------------------- only what is touched


SHAPE = (2, 53, 72)


def flat(*places: tuple[int, int, int]) -> Tensor:
    return torch.tensor([(b * SHAPE[1] + y) * SHAPE[2] + x for b, y, x in places])


TOUCHED = {
    "inside and in both": flat((0, 20, 30), (0, 26, 37), (1, 33, 50)),
    "at opposite corners": flat((0, 0, 0), (1, 52, 71)),
    "at borders, one picture": flat((1, 0, 40), (1, 9, 71)),
    "the whole of one": flat((0, 0, 0), (0, 52, 71)),
}


@pytest.mark.parametrize("quality", [None, 75])
@pytest.mark.parametrize("subsampling", ["420", "444"])
@pytest.mark.parametrize(
    "sensor", [SensorModel(noise=0.02), SensorModel(mosaic=False), PINHOLE], ids=["all", "lens", "pinhole"]
)
def test_touched_pixels_are_those_of_the_whole_picture(
    sensor: SensorModel, quality: int | None, subsampling: str
) -> None:
    before = 1.2 * uniform(*SHAPE, 3, seed=1)
    exposure = torch.tensor([0.5, 1.5], dtype=torch.float64)
    noise = draw_noise(SHAPE, sensor, draws(2)).double()

    def whole(radiance: Tensor) -> Tensor:
        shown = develop(radiance, exposure, sensor, noise)
        return shown if quality is None else jpeg(shown, quality, subsampling)

    base = whole(before)
    for name, pixels in TOUCHED.items():
        one, all_ = before.clone().requires_grad_(), before.clone().requires_grad_()
        alone = develop_at(one, exposure, sensor, pixels, noise, quality=quality, subsampling=subsampling)
        among = whole(all_).permute(0, 2, 3, 1).reshape(-1, 3)[pixels]
        assert float((alone - among).detach().abs().max()) < 3e-8, name
        weight = uniform(len(pixels), 3, seed=3)
        (alone * weight).sum().backward()
        (among * weight).sum().backward()
        assert one.grad is not None
        assert all_.grad is not None
        assert torch.allclose(one.grad, all_.grad, atol=3e-8), name
        # pixels change: the window holds all that this changes
        after = before.reshape(-1, 3).clone()
        after[pixels] = 0.2 + after[pixels].flip(0)
        after = after.reshape(before.shape)
        window = ChangedWindow.around(pixels, SHAPE, sensor, quality=quality, subsampling=subsampling)
        renewed = window.paste(window.develop(window.crop(after), exposure, window.crop(noise)), base)
        assert float((renewed - whole(after)).abs().max()) < 3e-8, name


def test_a_window_reads_little() -> None:
    window = ChangedWindow.around(flat((0, 20, 30), (0, 24, 33)), SHAPE, SensorModel())
    assert window.changed[0] == ((17, 28), (27, 37))
    # three more all around, from an even corner to one that leaves an even rest of the picture
    assert window.crop(torch.zeros(*SHAPE, 3)).shape[1:3] == (19, 16)
    blocks = ChangedWindow.around(flat((0, 20, 30)), SHAPE, SensorModel(), quality=75)
    assert blocks.changed[0] == ((15, 33), (15, 49)), "whole blocks, and what their colours bleed into"


def test_a_texture_is_put_into_the_window_alone(stage: RenderScene) -> None:
    picture = render(stage, [look(worn=True, away=16.0)])
    taps = texture_taps(picture, 32, dtype=torch.float64)
    radiance, exposure = torch.tensor(picture.radiance).double(), float(picture.exposure[0])
    window = ChangedWindow.around(taps.pixel, radiance.shape[:3], SensorModel(), quality=92)
    base = jpeg(develop(radiance, exposure))
    colours = uniform(3, 32, 32)
    grads = []
    for small in (True, False):
        leaf = colours.clone().requires_grad_()
        if small:
            part = retexture(window.relative_taps(taps), leaf, window.crop(radiance))
            shown = window.paste(window.develop(part, exposure), base)
        else:
            shown = jpeg(develop(retexture(taps, leaf, radiance), exposure))
        (shown * uniform(*shown.shape, seed=5)).sum().backward()
        grads.append((shown.detach(), leaf.grad))
    (ours, ours_grad), (whole, whole_grad) = grads
    assert float((ours - whole).abs().max()) < 3e-8
    assert ours_grad is not None
    assert whole_grad is not None
    assert torch.allclose(ours_grad, whole_grad, atol=1e-9)
    assert float(ours_grad.abs().max()) > 0
    part = window.crop(radiance)
    assert part.shape[1] * part.shape[2] < 0.8 * radiance.shape[1] * radiance.shape[2]


# ---------------------------------------------------------------- bad input


def test_wrong_use_is_refused_in_one_line(stage: RenderScene) -> None:
    radiance = torch.zeros(*SHAPE, 3)
    window = ChangedWindow.around(flat((0, 20, 30)), SHAPE, SensorModel())
    none = torch.zeros(1, 8)
    far = Taps((4, 4), None, flat((1, 50, 60)), torch.zeros(1, 3), none.long(), none)
    small = View(Camera.typical(3, 3), FORWARD)
    for call in (
        lambda: SensorModel(blur=0.8),
        lambda: SensorModel(blur=float("nan")),
        lambda: SensorModel(noise=-0.1),
        lambda: SensorModel(noise=float("inf")),
        lambda: SensorModel(full=0.0),
        lambda: SensorModel(full=5.0),
        lambda: render(stage, [small]),
        lambda: develop(torch.zeros(1, 3, 8, 3), 1.0),
        lambda: develop(radiance, 1.0, SensorModel(noise=0.1), torch.zeros(2, 53, 72, 3)),
        lambda: jpeg(torch.zeros(1, 3, 8, 8), 0),
        lambda: jpeg(torch.zeros(1, 3, 8, 8), 101),
        lambda: jpeg(torch.zeros(1, 3, 8, 8), 92, "422"),
        lambda: ChangedWindow.around(torch.tensor([-1]), SHAPE, SensorModel()),
        lambda: ChangedWindow.around(torch.tensor([2 * 53 * 72]), SHAPE, SensorModel()),
        lambda: ChangedWindow.around(flat((0, 20, 30)), SHAPE, SensorModel(), quality=101),
        lambda: window.crop(radiance[:1]),
        lambda: window.relative_taps(far),
    ):
        with pytest.raises(ConfigError) as error:
            call()
        assert "\n" not in str(error.value)
    pinhole = render(stage, [replace(small, sensor=PINHOLE)], quality=RenderQuality(effects=NO_EFFECTS))
    assert pinhole.image.shape == (1, 3, 3, 3)
