"""The shifts on images: formulas, invariants, agreement between cameras and over time, damage by severity."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.boxes import CAMERA, GREY, HEIGHT, WIDTH, cars, drawn
from helpers.quick import others_slow
from helpers.tiny import make_tiny
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import page_trend_test

from ssad.core.boxes import TrackedBoxes
from ssad.core.errors import ConfigError, UnknownNameError
from ssad.core.frames import Camera, Frame, SceneContext, SweepFrame, camera_to_world
from ssad.core.types import U8
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.rendering.camera.sensor import KNEE
from ssad.scenarios.static.shifts import (
    KNOWN,
    SHIFTS,
    ShiftSpec,
    deal_severities,
    random_severity,
    shift_images,
    shift_points,
    sky_light,
)
from ssad.scenarios.static.shifts import parameters as table
from ssad.scenarios.static.shifts.exposure import exposure_table
from ssad.scenarios.static.shifts.light import tables, to_codes, to_linear
from ssad.scenarios.static.shifts.scene_shifter import SceneShifter
from ssad.scenarios.static.shifts.sun import choose_sun, sun_direction
from ssad.scenarios.static.shifts.weather import extinction, scene_weather

BOTH = ("physical", "paper")


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> NuScenes:
    return NuScenes(make_tiny(tmp_path_factory.mktemp("data") / "tiny", scenes=2, samples=3, size=(480, 270)))


def one(image: U8, frame: Frame, spec: ShiftSpec) -> U8:
    return np.asarray(shift_images(image, frame, spec, contexts={frame.scene: SceneContext(frame.scene, 0.8)})[0])


@pytest.fixture(scope="module")
def scenery() -> tuple[U8, Frame]:
    """A picture with two cars, texture and known depth."""
    boxes = cars((10.0, 1.5, 0.8), (14.0, -2.0, 0.8))
    image = drawn(boxes, [(200, 40, 40), (40, 60, 200)])
    noise = np.random.default_rng(0).normal(0, 6, image.shape)
    v = np.arange(45)[:, None] * 4 + 2.0 - CAMERA.intrinsic[1, 2]
    depth = np.where(v > 1, 1.5 * CAMERA.intrinsic[1, 1] / np.maximum(v, 1), 1000.0) + np.zeros((1, 80))
    frame = Frame(CAMERA, "scene", "file", 3.0, ego_velocity=np.array([6.0, 0, 0]), boxes=boxes)
    return np.clip(image + noise, 0, 255).astype(np.uint8), replace(frame, depth=depth.astype(np.float32))


# ---------------------------------------------------------------- what holds for all


@pytest.mark.parametrize("calibration", BOTH)
@pytest.mark.parametrize("name", KNOWN)
def test_a_shift_changes_the_picture_the_same_way_each_time(name: str, calibration: Any, scenery: Any) -> None:
    image, frame = scenery
    before = image.copy()
    spec = ShiftSpec(name, 5, 3, calibration)
    out, done = shift_images(image, frame, spec)
    assert out.dtype == np.uint8
    assert out.shape == image.shape
    assert done[0].applied
    assert (out != image).any()
    assert (image == before).all(), "the input was written to"
    assert (shift_images(image, frame, spec)[0] == out).all()
    elsewhere = replace(frame, scene="b", sample="b")
    others = [shift_images(image, elsewhere, replace(spec, seed=seed))[0] for seed in range(4, 8)]
    if name not in ("motion_blur", "overexposure"):  # nothing is drawn for them
        assert any((other != out).any() for other in others)
    assert (shift_images(image, frame, spec.at(0))[0] == image).all()


@pytest.mark.parametrize("calibration", BOTH)
@pytest.mark.parametrize("name", KNOWN)
def test_a_picture_does_not_depend_on_its_batch(name: str, calibration: Any, scenery: Any) -> None:
    image, frame = scenery
    image, frame = (image[:-1], replace(frame, camera=replace(frame.camera, height=len(image) - 1)))  # an odd height
    images = np.stack([image, image[:, ::-1], 255 - image, image])
    frames = [replace(frame, sample=str(k), scene=f"scene {k % 2}", time=3.0 + k) for k in range(4)]
    specs = [ShiftSpec(name, severity, 1, calibration) for severity in (2, 5, 0, 4)]
    together, _ = shift_images(images, frames, specs)
    for k in range(4):
        alone, _ = shift_images(images[k], frames[k], specs[k])
        assert (together[k] == alone).all()
    assert (together[2] == images[2]).all()


@pytest.mark.parametrize("size", [(9, 8), (37, 51), (61, 123)])
def test_any_size_works(size: tuple[int, int]) -> None:
    image = np.random.default_rng(1).integers(0, 256, (*size, 3)).astype(np.uint8)
    for name, (family, _) in KNOWN.items():
        for calibration in BOTH:
            out, done = shift_images(image, None, ShiftSpec(name, 3, 0, calibration))
            assert out.shape == image.shape
            assert done[0].applied == (family != "object")


def test_torch_images_come_back_as_they_went(scenery: Any) -> None:
    torch = pytest.importorskip("torch")
    image, frame = scenery
    floats = torch.from_numpy(image).permute(2, 0, 1)[None].float() / 255
    out, _ = shift_images(floats, frame, ShiftSpec("gaussian", 2))
    assert out.shape == floats.shape
    expected, _ = shift_images(image, frame, ShiftSpec("gaussian", 2))
    assert (np.rint(out[0].permute(1, 2, 0).numpy() * 255) == expected).all()


def test_wrong_input_is_refused_in_one_line() -> None:
    frame = Frame(CAMERA)
    for images, frames, spec in (
        (GREY.astype(np.float32), frame, ShiftSpec("fog")),
        (GREY[..., 0], frame, ShiftSpec("fog")),
        (GREY[..., :1], frame, ShiftSpec("fog")),
        (GREY[:4], frame, ShiftSpec("fog")),
        (GREY[:90], frame, ShiftSpec("fog")),
        (np.stack([GREY, GREY]), frame, ShiftSpec("fog")),
        (GREY, frame, [ShiftSpec("fog"), ShiftSpec("fog")]),
        (np.stack([GREY, GREY]), [frame, frame], [ShiftSpec("fog"), ShiftSpec("rain")]),
    ):
        with pytest.raises(ConfigError) as error:
            shift_images(images, frames, spec)
        assert "\n" not in str(error.value)
    for arguments in (("fogg",), ("fog", 6), ("fog", True), ("fog", 2, 0, "real")):
        with pytest.raises(ConfigError):
            ShiftSpec(*arguments)
    with pytest.raises(UnknownNameError, match="closest: fog"):
        ShiftSpec("fogg")


# ---------------------------------------------------------------- sensor noise


@pytest.mark.parametrize("severity", [1, 3, 5])
def test_noise_has_the_stated_statistics(severity: int) -> None:
    image = np.full((400, 600, 3), 128, np.uint8)
    count = image.size
    level = 255 * table.GAUSSIAN[severity - 1]
    out = shift_images(image, None, ShiftSpec("gaussian", severity))[0].astype(float)
    # clipped normal: its moments by numerical integration
    x = np.arange(256) - 128.0
    edges = np.concatenate([[-np.inf], x[:-1] + 0.5, [np.inf]])
    from statistics import NormalDist

    mass = np.diff([NormalDist(0, level).cdf(e) for e in edges])
    mean = float((mass * x).sum())
    deviation = float(np.sqrt((mass * (x - mean) ** 2).sum()))
    assert abs(out.mean() - 128 - mean) < 5 * deviation / np.sqrt(count) + 0.05
    assert out.std() == pytest.approx(deviation, rel=0.01)
    width = 255 * table.UNIFORM[severity - 1]
    out = shift_images(image, None, ShiftSpec("uniform", severity))[0].astype(float)
    assert abs(out - 128).max() <= np.ceil(width)
    assert out.std() == pytest.approx(width / np.sqrt(3), rel=0.01)
    assert abs(out.mean() - 128) < 5 * width / np.sqrt(3 * count) + 0.05
    out = shift_images(image, None, ShiftSpec("impulse", severity))[0]
    share = table.IMPULSE[severity - 1]
    assert (out != 128).mean() == pytest.approx(share, abs=5 * np.sqrt(share / count) + 1e-4)
    assert (out == 255).mean() == pytest.approx(share / 2, rel=0.05)
    assert set(np.unique(out)) <= {0, 128, 255}


def test_noise_is_white_over_pixels_and_colours() -> None:
    image = np.full((256, 256, 3), 128, np.uint8)
    noise = shift_images(image, None, ShiftSpec("gaussian", 1))[0].astype(float) - 128
    spectrum = np.abs(np.fft.fft2(noise[..., 0] - noise[..., 0].mean())) ** 2
    bands = [spectrum[a : a + 32, b : b + 32].mean() for a in range(0, 256, 32) for b in range(0, 256, 32)]
    assert max(bands) / min(bands) < 1.35
    assert abs(np.corrcoef(noise.reshape(-1, 3).T)[0, 1:]).max() < 0.02


def test_noise_of_the_paper_truncates() -> None:
    image = np.full((300, 400, 3), 128, np.uint8)
    ours = shift_images(image, None, ShiftSpec("gaussian", 1))[0].astype(float)
    paper = shift_images(image, None, ShiftSpec("gaussian", 1, 0, "paper"))[0].astype(float)
    assert ours.mean() - paper.mean() == pytest.approx(0.5, abs=0.2)


def test_stuck_pixels_stay_where_they_are() -> None:
    frames = [Frame(CAMERA, "s", str(k)) for k in range(6)]
    out, _ = shift_images(np.stack([GREY] * 6), frames, ShiftSpec("impulse", 3))
    always = (out != 128).all(axis=0)
    assert always.mean() == pytest.approx(table.IMPULSE[2] * table.STUCK, rel=0.1)
    other, _ = shift_images(GREY, Frame(replace(CAMERA, channel="CAM_BACK"), "s", "0"), ShiftSpec("impulse", 3))
    assert (other[always] != 128).mean() < 0.2


def test_noise_keeps_its_bits() -> None:
    """Whole-number kernels: the same on every machine. A change of these needs new VERSIONS."""
    image = (np.arange(64 * 96 * 3) * 7 % 256).astype(np.uint8).reshape(64, 96, 3)
    found = {
        name: hashlib.sha256(shift_images(image, None, ShiftSpec(name, 3, 7))[0].tobytes()).hexdigest()[:16]
        for name in ("uniform", "gaussian", "impulse")
    }
    assert found == GOLDEN


GOLDEN = {"uniform": "62935a96fecfa47a", "gaussian": "f613a0ca016aa1f3", "impulse": "718ea7008206c6db"}


def test_overexposure_is_more_light_through_the_cameras_curve() -> None:
    ramp, frame = np.tile(np.arange(256, dtype=np.uint8)[:, None, None], (1, 8, 3)), Frame(Camera.typical(8, 256))
    assert exposure_table(0.0).tolist() == list(range(256)), "no more light, no change"
    before, white = np.arange(256), 256
    for severity, stops in enumerate(table.OVEREXPOSURE, 1):
        picture = one(ramp, frame, ShiftSpec("overexposure", severity))[:, 0, 0].astype(int)
        light = to_linear(np.arange(256)) * 2.0**stops
        low = light < KNEE
        assert np.abs(picture[low] - to_codes(light[low])).max() <= 0.5, "linear in light up to the shoulder"
        assert (np.diff(picture) >= 0).all(), "nothing dark becomes brighter than what was bright"
        assert (picture >= before).all()
        assert (picture[light < 1.0] < 255).all(), "a soft shoulder: what is just full is not yet white"
        assert int(np.searchsorted(picture, 254)) < white, "more becomes white"
        before, white = picture, int(np.searchsorted(picture, 254))
    paper = one(ramp, frame, ShiftSpec("overexposure", 5, 3, "paper"))[:, 0, 0]
    assert (paper == before).all()


def test_shifts_beside_the_papers_are_extra() -> None:
    assert len(SHIFTS) == 11
    assert list(KNOWN)[:11] == list(SHIFTS)
    points = np.ones((5, 5), np.float32)
    out, done = shift_points(points, SweepFrame(), ShiftSpec("overexposure", 5))
    assert not done.applied
    assert (out == points).all()


# ---------------------------------------------------------------- weather


def test_fog_is_koschmieders_law() -> None:
    depth = np.tile(np.geomspace(3, 800, 80, dtype=np.float32), (45, 1))
    frame = Frame(CAMERA, "s", depth=depth)
    shown = [one(np.full_like(GREY, v), frame, ShiftSpec("fog", 3)) for v in (0, 255, 128)]
    black, white = (to_linear(picture) for picture in shown[:2])
    clear = white - black
    expected = to_codes(black + float(to_linear(128)) * clear)
    assert np.abs(shown[2] - expected).max() <= 1.5, "not linear in the picture's light"
    beta = extinction(ShiftSpec("fog", 3))
    far = cv2.resize(depth, (WIDTH, HEIGHT), interpolation=cv2.INTER_LINEAR)
    k = CAMERA.intrinsic
    u, v = (np.arange(WIDTH) + 0.5 - k[0, 2]) / k[0, 0], (np.arange(HEIGHT) + 0.5 - k[1, 2]) / k[1, 1]
    away = far * np.sqrt(1 + u[None] ** 2 + v[:, None] ** 2)
    inside = (away > 20) & (away < 150)
    density = -np.log(clear[..., 1][inside]) / (beta * away[inside])
    assert density.mean() == pytest.approx(1, abs=0.25)  # patchy, but one in the mean
    assert density.min() > 0.4
    assert density.max() < 1.6
    air = black[:, -8:] / np.maximum(1 - clear[:, -8:], 1e-6)
    assert np.ptp(air.reshape(-1, 3), axis=0).max() < 0.02, "one colour of the air"


@pytest.mark.parametrize("severity", [2, 4, 5])
def test_fog_keeps_as_much_contrast_as_koschmieder_says(severity: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the light of a dark and a bright thing at 10, 20 and 60 m, within what codes of 8 bits can say."""
    even = replace(scene_weather(ShiftSpec("fog"), "s"), patches=0.0)
    monkeypatch.setattr("ssad.scenarios.static.shifts.weather.scene_weather", lambda *_: even)
    dark, bright = np.full_like(GREY, 30), np.full_like(GREY, 180)
    y, x = HEIGHT // 2, WIDTH // 2
    for distance in (10.0, 20.0, 60.0):
        frame = Frame(CAMERA, "s", depth=np.full((45, 80), distance, np.float32))
        codes = [one(picture, frame, ShiftSpec("fog", severity))[y, x].astype(float) for picture in (dark, bright)]
        least, most = (to_linear(np.clip(codes[1] + e, 0, 255)) - to_linear(codes[0] - e) for e in (-0.8, 0.8))
        there = to_linear(180) - to_linear(30)
        kept = np.exp(-3.0 * distance / table.FOG_RANGE[severity - 1])
        assert (least / there <= kept).all(), distance
        assert (most / there >= kept).all(), distance
        assert (most - least).max() < 0.04, "sharp enough to tell"


def test_light_through_clear_air_keeps_its_code() -> None:
    linear, codes = (array.numpy() for array in tables("cpu"))
    assert codes[linear * 1024 >> 14].tolist() == list(range(256))
    assert np.abs(to_codes(to_linear(np.arange(256))) - np.arange(256)).max() < 1e-9


def test_weather_agrees_between_cameras_and_changes_with_the_scene(street: NuScenes) -> None:
    scene = street.scene(street.scenes()[0].name)
    for name in ("fog", "rain", "snow"):
        shifter = SceneShifter(street.root, scene, ShiftSpec(name, 5))
        first = [f for f in scene.frames if f.key_frame and f.modality == "camera"][:6]
        assert len({f.channel for f in first}) == 6
        black, sky = [], np.full((270, 480, 3), 0, np.uint8)
        for frame in first:
            view = replace(
                shifter.camera_frame(frame), depth=np.full((68, 120), np.inf, np.float32), boxes=TrackedBoxes.empty()
            )
            out, _ = shift_images(sky, view, ShiftSpec(name, 5), contexts={shifter.context.scene: shifter.context})
            black.append(np.median(out.reshape(-1, 3), axis=0))
        assert np.ptp(black, axis=0).max() <= 2, f"{name}: the air has one colour for all six cameras"
    specs = [ShiftSpec("fog", 3), ShiftSpec("fog", 3, seed=1)]
    assert (one(GREY, Frame(CAMERA, "a"), specs[0]) != one(GREY, Frame(CAMERA, "b"), specs[0])).any()
    assert (one(GREY, Frame(CAMERA, "a"), specs[0]) != one(GREY, Frame(CAMERA, "a"), specs[1])).any()


def test_one_sun_for_six_cameras(street: NuScenes) -> None:
    scene = street.scene(street.scenes()[0].name)
    shifter = SceneShifter(street.root, scene, ShiftSpec("sunlight", 5))
    world = sun_direction(ShiftSpec("sunlight", 5), shifter.context)
    facing, away = 0, 0
    for frame in [f for f in scene.frames if f.key_frame and f.modality == "camera"][:6]:
        view = shifter.camera_frame(frame)
        out, done = shifter.image(frame)
        local = camera_to_world(view)[:3, :3].T @ world
        k = view.camera.intrinsic
        if local[2] < 0.2:
            assert not done.applied
            assert (out == shifter.read(frame)).all()
            assert "the sun is not in front of this camera" in done.skipped
            away += 1
            continue
        x, y = local[0] / local[2] * k[0, 0] + k[0, 2], local[1] / local[2] * k[1, 1] + k[1, 2]
        if 0 <= x < 480 and 0 <= y < 270:
            assert out[int(y), int(x)].min() > 200, "the picture is bright where the sun stands"
            facing += 1
    assert facing >= 1
    assert away >= 2


def test_the_sun_is_low_over_the_road_ahead() -> None:
    for seed in range(50):
        x, y, z = sun_direction(ShiftSpec("sunlight", 1, seed=seed), SceneContext("s", heading=2.0))
        assert abs(np.arctan2(y, x) - 2.0) <= np.radians(15) + 1e-9
        assert np.radians(2) <= np.arcsin(z) <= np.radians(12)


def sunlit(depth: float, severity: int) -> tuple[U8, Any]:
    """A grey picture of something at one depth (m), the sun in view; and what was done."""
    frame = Frame(CAMERA, "s", depth=np.full((HEIGHT, WIDTH), depth, np.float32))
    heading = float(np.arctan2(*camera_to_world(frame)[[1, 0], 2]))
    contexts = {"s": SceneContext("s", heading=heading)}
    images, done = shift_images(GREY, frame, ShiftSpec("sunlight", severity), contexts=contexts)
    assert done[0].details["in_view"], "the sun stands in the picture"
    return images, done[0]


def test_glare_is_the_eyes_at_most_and_none_behind_a_wall() -> None:
    hidden, done = sunlit(30.0, 5)
    assert not done.applied
    assert done.skipped == {"the sun is behind something": 1}
    assert (hidden == GREY).all(), "no light comes through a wall"
    before = 0.0
    for severity in (1, 2, 3, 4, 5):
        seen, done = sunlit(np.inf, severity)
        assert done.applied
        toward = camera_to_world(Frame(CAMERA, "s"))[:3, :3].T @ np.array(done.details["direction"])
        v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
        k = CAMERA.intrinsic
        rays = np.stack([(u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1], np.ones_like(u)], -1)
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        angle = np.degrees(np.arccos(np.clip(rays @ toward, -1, 1)))
        ring = np.abs(angle - 20.0) < 0.5  # beyond the star; the median passes by the ghosts
        added = float(np.median(seen[ring][:, 0])) - 128 * (1 - 0.06 * severity)
        glare = table.SUN_STRENGTH[severity - 1] * (1 / 20**2 + 0.06 / 21)
        assert added == pytest.approx(glare, rel=0.05, abs=1.5), severity
        assert seen[angle < 1.0].min() >= min(table.SUN_STRENGTH[severity - 1], 200)
        assert added > before
        before = added


def test_cameras_of_a_moment_agree_whether_the_sun_is_hidden(street: NuScenes, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = street.scene(street.scenes()[0].name)
    frames = [f for f in scene.frames if f.key_frame and f.modality == "camera"][:6]
    for share in (0.0, 0.4, 1.0):
        monkeypatch.setattr(
            "ssad.scenarios.static.shifts.scene_shifter.visible_sun_share", lambda *_, share=share: share
        )
        shifter = SceneShifter(street.root, scene, ShiftSpec("sunlight", 5))
        found = [shifter.image(frame)[1] for frame in frames]
        front = [one for one in found if "the sun is not in front of this camera" not in one.skipped]
        assert len(front) >= 2
        assert {one.details["free"] for one in front} == {share}
        assert all(one.applied == (share > 0) for one in front)
        assert sum(one.details["in_view"] for one in front) < len(front), "not all of them have it in the picture"


def test_the_sun_rises_until_it_is_seen() -> None:
    frame = Frame(CAMERA, "s")
    elevation = np.degrees(np.arctan((CAMERA.intrinsic[1, 2] - np.arange(HEIGHT) - 0.5) / CAMERA.intrinsic[1, 1]))
    depth = np.where(elevation > 12, np.inf, 30.0)[:, None] * np.ones((1, WIDTH))
    context = SceneContext("s", heading=float(np.arctan2(*camera_to_world(frame)[[1, 0], 2])))
    walled, spec = replace(frame, depth=depth.astype(np.float32)), ShiftSpec("sunlight", 3)
    chosen = choose_sun(spec, context, [(walled, GREY)])
    assert np.degrees(np.arcsin(chosen[2])) > 12
    open_sky = replace(frame, depth=np.full((HEIGHT, WIDTH), np.inf, np.float32))
    first = sun_direction(spec, context)
    assert choose_sun(spec, context, [(open_sky, GREY)]) == pytest.approx(tuple(first))
    shut = replace(frame, depth=np.full((HEIGHT, WIDTH), 30.0, np.float32))
    assert choose_sun(spec, context, [(shut, GREY)]) == pytest.approx(tuple(first)), "hidden in all"
    assert sun_direction(spec, replace(context, sun=chosen)) == pytest.approx(chosen)


def test_there_is_no_sun_by_night() -> None:
    frame, spec = Frame(CAMERA, "s"), ShiftSpec("sunlight", 5)
    night = {"s": SceneContext("s", 0.1, float(np.arctan2(*camera_to_world(frame)[[1, 0], 2])))}
    out, done = shift_images(GREY, frame, spec, contexts=night)
    assert (out == GREY).all()
    assert done[0].skipped == {"it is night": 1}


def test_the_sky_is_what_is_infinitely_far() -> None:
    image = np.full((60, 160, 3), 10, np.uint8)
    image[:30, :60] = 250  # a wall in lamp light
    depth = np.full((15, 40), np.inf, np.float32)
    depth[8:] = 20
    depth[:8, :15] = 5
    assert sky_light([image]) == pytest.approx(250 / 255, abs=0.01)
    assert sky_light([image], [depth]) == pytest.approx(0.06), "the least there is"
    assert sky_light([image], [np.full_like(depth, 20)]) == pytest.approx(250 / 255, abs=0.01), "no sky to be seen"
    assert sky_light([image, image], [None, depth]) == pytest.approx(0.06), "what is known counts"
    assert sky_light([image], night=True) == pytest.approx(0.06), "the median, where nothing is known"
    lit, dark = Frame(CAMERA, "s", depth=np.full((HEIGHT, WIDTH), np.inf, np.float32)), np.zeros_like(GREY)
    dark[: HEIGHT // 3, : WIDTH // 3] = 250
    assert lit.depth is not None
    lit.depth[: HEIGHT // 3, : WIDTH // 3] = 5
    assert shift_images(dark, lit, ShiftSpec("sunlight", 3))[1][0].skipped == {"it is night": 1}


@pytest.mark.parametrize("name", ["rain", "snow"])
def test_particles_are_fixed_in_the_world_and_move_with_time(name: str) -> None:
    dark = np.zeros_like(GREY)
    near = np.full((45, 80), 3.0, np.float32)  # a wall close by: no veil
    start = {"s": SceneContext("s", 1.0)}

    def layer(time: float, shift: float = 0.0) -> Any:
        pose = np.eye(4)
        pose[0, 3] = shift
        frame = Frame(CAMERA, "s", time=time, ego_to_world=pose, depth=near)
        out, _ = shift_images(dark, frame, ShiftSpec(name, 5), contexts=start)
        return out.astype(float)

    still = layer(1.0)
    assert still.max() > still.min() + 8
    assert (layer(1.0) == still).all()
    tile = 6.0 if name == "rain" else 8.0
    assert np.abs(layer(1.0, tile) - still).mean() < 0.05 * still.std(), "the field repeats after a tile"
    soon, late = np.abs(layer(1.0005) - still).mean(), np.abs(layer(1.4) - still).mean()
    assert soon < 0.4 * late


def test_severity_is_drawn_by_scene_or_by_sample() -> None:
    physical, paper = ShiftSpec("fog"), ShiftSpec("fog", calibration="paper")
    assert len({random_severity(physical, "a", str(k)) for k in range(50)}) == 1
    assert {random_severity(paper, "a", str(k)) for k in range(100)} == {1, 2, 3, 4, 5}
    assert {random_severity(physical, str(k), "a") for k in range(100)} == {1, 2, 3, 4, 5}


@given(scenes=st.sets(st.text("abc0123", min_size=1, max_size=6), max_size=40), seed=st.integers(0, 99))
def test_severities_are_dealt_evenly(scenes: set[str], seed: int) -> None:
    spec = ShiftSpec("fog", seed=seed)
    dealt = deal_severities(spec, scenes)
    assert set(dealt) == scenes
    counts = [sum(value == severity for value in dealt.values()) for severity in (1, 2, 3, 4, 5)]
    assert sum(counts) == len(scenes)
    assert max(counts) - min(counts) <= 1
    assert deal_severities(spec.at(5), sorted(scenes, reverse=True)) == dealt, "the order they come in decides"


def test_dealt_severities_differ_by_shift_and_seed() -> None:
    scenes = [f"scene-{k}" for k in range(24)]
    specs = [ShiftSpec(name, seed=seed) for name in ("fog", "snow", "scale") for seed in range(3)]
    assert len({tuple(sorted(deal_severities(spec, scenes).items())) for spec in specs}) == 9
    first = {deal_severities(ShiftSpec("fog", seed=seed), scenes)["scene-0"] for seed in range(60)}
    assert first == {1, 2, 3, 4, 5}


def test_a_deal_begins_anywhere() -> None:
    """Else a single scene would always have severity 1, and of six scenes two."""
    alone = [deal_severities(ShiftSpec("fog", seed=seed), ["scene"])["scene"] for seed in range(200)]
    assert {alone.count(severity) > 20 for severity in (1, 2, 3, 4, 5)} == {True}
    six = [list(deal_severities(ShiftSpec("fog", seed=seed), "abcdef").values()) for seed in range(60)]
    assert {severity for dealt in six for severity in dealt if dealt.count(severity) == 2} == {1, 2, 3, 4, 5}


# ---------------------------------------------------------------- damage by severity


@pytest.mark.parametrize("name", others_slow(KNOWN, ["fog", "gaussian", "scale", "overexposure"]))
def test_damage_grows_with_severity(name: str, street: NuScenes) -> None:
    """Page's trend test over pictures of two scenes, keys fixed; nothing drawn is tuned to pass it."""
    damage = []
    for record in street.scenes():
        scene = street.scene(record.name)
        shifters = [SceneShifter(street.root, scene, ShiftSpec(name, severity)) for severity in range(1, 6)]
        for frame in [f for f in scene.frames if f.modality == "camera" and f.key_frame][:9]:
            clean = shifters[0].read(frame).astype(int)
            rows = [s.image(frame) for s in shifters]
            if all(done.applied for _, done in rows):
                damage.append([float(np.abs(out.astype(int) - clean).mean()) for out, _ in rows])
    means = np.mean(damage, axis=0)
    assert (np.diff(means) > 0).all(), means
    if len(damage) > 2:
        assert page_trend_test(damage).pvalue < 0.01


def test_a_picture_of_ones_own_needs_no_data() -> None:
    out, done = shift_images(GREY, None, ShiftSpec("fog", 5))
    assert done[0].details["depth"] == "assumed"
    assert (out != GREY).any()


def test_a_missing_lidar_is_said(street: NuScenes, tmp_path: Path) -> None:
    scene = street.scene(street.scenes()[0].name)
    blind = replace(scene, frames=tuple(f for f in scene.frames if f.channel != "LIDAR_TOP"))
    shifter = SceneShifter(street.root, blind, ShiftSpec("fog", 3))
    frame = next(f for f in blind.frames if f.modality == "camera")
    assert shifter.image(frame)[1].details["depth"] == "assumed"
    assert SceneShifter(street.root, scene, ShiftSpec("fog", 3)).image(frame)[1].details["depth"] == "lidar"
