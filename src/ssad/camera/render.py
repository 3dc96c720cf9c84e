"""From a stage, cameras and light to pictures: visibility once, then shading, then the camera's response."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import warp as wp

from ssad.camera.kernels import raster, shade
from ssad.camera.scene import Draws, Scene, Thing
from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.core.types import F32, F64, I32, U8

NEAR = 0.15  # m
FAR = 500.0
LARGE, LANES = 4096, 32  # large triangles that a view may list, threads for each
DAY = 0.5  # exposure on a clear day
SHADOW_SIZE, SHADOW_REACH = 1024, 60.0  # texels, m from the middle to the border


@dataclass(frozen=True, slots=True)
class Weather:
    """Hour and air. sun_height, sun_heading: radians (heading counter-clockwise from east); clouds 0..1; fog:
    extinction 1/m; wet 0..1; exposure in stops relative to what the light suggests; turn: moves the clouds."""

    sun_height: float = 0.7
    sun_heading: float = 0.8
    clouds: float = 0.35
    fog: float = 0.0
    wet: float = 0.0
    exposure: float = 0.0
    turn: float = 0.0


@dataclass(frozen=True, slots=True)
class View:
    """A camera at a place: `pose` (camera to world) [4, 4], what stands there, the weather.

    noise: of the sensor by day, as the deviation at full light (0.01 is a good camera's); it grows where the exposure
    must, by night. seed: of the noise; equal seeds give equal noise.
    """

    camera: Camera
    pose: F64
    things: tuple[Thing, ...] = ()
    weather: Weather = Weather()
    noise: float = 0.0
    seed: int = 0


@dataclass(frozen=True, slots=True)
class Picture:
    """B pictures: image uint8 sRGB [B, H, W, 3]; radiance linear [B, H, W, 3]; tag [B, H, W] (-1 sky, 0 street, else
    that of the thing); depth [B, H, W] m along the optical axis, inf for sky; exposure [B]: image is the camera's
    curve of radiance times it; fragments: pieces of textured surfaces, black in the picture, by pixel and triangle
    (see `ssad.camera.texture`)."""

    image: U8
    radiance: F32
    tag: I32
    depth: F32
    exposure: F64
    fragments: Any


def light_of(weather: Weather) -> tuple[tuple[Any, ...], float]:
    """The kernels' light, and the exposure that suits it. Day, dusk and night follow from the height of the sun."""
    height = weather.sun_height
    sun = (
        float(np.cos(height) * np.cos(weather.sun_heading)),
        float(np.cos(height) * np.sin(weather.sun_heading)),
        float(np.sin(height)),
    )
    day = float(np.clip((height + 0.1) / 0.3, 0, 1))
    warm = float(np.clip(height / 0.5, 0, 1))
    direct = (1 - 0.95 * weather.clouds**2) * float(np.clip(height / 0.12, 0, 1)) * (0.35 + 0.65 * warm)
    if weather.fog > 0:
        direct *= float(np.exp(-weather.fog * 60))
    sun_colour = np.array([1.0, 0.72 + 0.25 * warm, 0.42 + 0.48 * warm]) * 2.6 * direct
    grey = np.array([0.88, 0.92, 0.98])
    veil = weather.clouds**2
    zenith = (np.array([0.24, 0.46, 0.98]) * (1 - veil) + grey * veil) * (0.004 + 0.9 * day)
    glow = np.array([1.0, 0.55, 0.30]) * (1 - warm) * 0.5 * day
    horizon = (np.array([0.95, 1.12, 1.30]) * (1 - veil) + 1.15 * grey * veil) * (0.006 + 0.9 * day)
    horizon = horizon + glow * (1 - weather.clouds)
    ground = 0.16 * (horizon + 0.5 * sun_colour * max(sun[2], 0))
    lamps = float(np.clip((0.08 - height) / 0.15, 0, 1))
    bright = float(
        0.30 * (0.9 * sun_colour.mean() * max(sun[2], 0.1) + zenith.mean() + 0.6 * horizon.mean()) + 0.05 * lamps
    )
    light = (
        sun, tuple(sun_colour), tuple(zenith), tuple(horizon), tuple(ground), weather.fog, weather.clouds, weather.wet,
        lamps, weather.turn,
    )  # fmt: skip
    return light, 0.40 / max(bright, 0.004) * 2.0**weather.exposure


@lru_cache(maxsize=1)
def response() -> U8:
    """The camera's curve [4096] over sqrt(light / 4): linear to 0.8, a soft shoulder above, then sRGB."""
    light = 4 * ((np.arange(4096) + 0.5) / 4096) ** 2
    soft = np.where(light > 0.8, 0.8 + 0.2 * (1 - np.exp(-(light - 0.8) / 0.4)), light)
    srgb = np.where(soft <= 0.0031308, soft * 12.92, 1.055 * soft ** (1 / 2.4) - 0.055)
    return np.asarray(np.rint(srgb * 255), np.uint8)


class _Pass:
    """One visibility pass over all views: draws, slots, samples."""

    def __init__(
        self, stage: Scene, draws: Draws, lens: F32, *, ortho: bool, size: tuple[int, int], scale: int
    ) -> None:
        device = stage.device
        total = int(draws.counts.sum())
        self.starts = wp.array(
            np.concatenate([[0], np.cumsum(draws.counts)]).astype(np.int32), dtype=int, device=device
        )
        self.firsts = wp.array(draws.firsts, dtype=int, device=device)
        self.matrices = wp.array(draws.matrices, dtype=wp.mat44, device=device)
        self.paints = wp.array(draws.paints, dtype=wp.vec3, device=device)
        self.tags = wp.array(draws.tags, dtype=int, device=device)
        self.textures = wp.array(draws.textures, dtype=int, device=device)
        self.rectangles = wp.array(draws.rectangles, dtype=wp.vec4, device=device)
        self.lens = wp.array(lens, dtype=wp.vec4, device=device)
        views = wp.array(draws.views, dtype=int, device=device)
        height, width = size[0] * scale, size[1] * scale
        self.samples = wp.zeros((len(lens), height, width), dtype=wp.uint64, device=device)
        if not total:
            return
        triangles = wp.empty(2 * total, dtype=raster.Triangle, device=device)
        inputs = [
            stage.vertices, stage.faces, stage.listed, self.starts, self.firsts, views, self.matrices, self.lens,
            NEAR, float(scale), int(ortho), float(width), float(height),
        ]  # fmt: skip
        wp.launch(raster.setup, dim=total, inputs=inputs, outputs=[triangles], device=device)
        gpu = device != "cpu"
        # on a GPU large triangles are shared out over threads
        room = LARGE * len(lens) if gpu else 1
        large = wp.empty(room, dtype=int, device=device)
        many = wp.zeros(1, dtype=int, device=device)
        inputs = [triangles, 256.0 if gpu else 1e30]
        wp.launch(raster.fill, dim=2 * total, inputs=inputs, outputs=[self.samples, large, many], device=device)
        if gpu:
            inputs = [triangles, large, many, LANES]
            wp.launch(raster.fill_large, dim=(room, LANES), inputs=inputs, outputs=[self.samples], device=device)


def render(
    stage: Scene,
    views: Sequence[View],
    *,
    scale: int = 2,
    shadows: bool = True,
    download: bool = True,
    linear: bool = True,
) -> Picture:
    """Pictures of views of one size. ConfigError for views that do not fit.

    scale: samples a pixel along each side; download: numpy arrays; else the picture's image, radiance, tag and depth
    stay on the stage's device as Warp arrays; linear: download the radiance too.
    """
    if not views:
        raise ConfigError("no view to render")
    size = (views[0].camera.height, views[0].camera.width)
    if any((v.camera.height, v.camera.width) != size for v in views):
        raise ConfigError("views of one call must have one size")
    lens, lights, exposures = [], [], []
    for number, view in enumerate(views):
        k = view.camera.intrinsic
        if not np.isfinite(view.pose).all() or not np.isfinite(k).all() or min(k[0, 0], k[1, 1]) <= 0:
            raise ConfigError(f"view {number}: a camera needs a finite pose and a positive focal length")
        lens.append([k[0, 0], k[1, 1], k[0, 2], k[1, 2]])
        light, exposure = light_of(view.weather)
        lights.append(light)
        exposures.append(exposure)
    poses = np.array([v.pose for v in views], np.float64)
    inverses = np.asarray(np.linalg.inv(poses), np.float64)
    things = [v.things for v in views]
    eyes, axes = poses[:, :3, 3], poses[:, :3, 2]
    far = np.array([min(FAR, 6.0 / v.weather.fog) if v.weather.fog > 0 else FAR for v in views])
    draws = stage.gather(inverses, things, eyes=eyes, axes=axes, reach=(70.0, 180.0), far=far)
    seen = _Pass(stage, draws, np.array(lens, np.float32), ortho=False, size=size, scale=scale)
    middles = eyes + axes * [0.7 * SHADOW_REACH, 0.7 * SHADOW_REACH, 0.0]
    middles[:, 2] = 0.0
    to_shadow = np.array([_light_camera(np.array(light[0]), m) for light, m in zip(lights, middles, strict=True)])
    texel = 2 * SHADOW_REACH / SHADOW_SIZE
    if shadows and any(light[0][2] > 0.02 for light in lights):
        half = SHADOW_SIZE / 2 - 0.5
        around = np.tile(np.array([1 / texel, 1 / texel, half, half], np.float32), (len(views), 1))
        reach = np.full(len(views), 95.0)
        casting = stage.gather(to_shadow, things, eyes=middles, axes=None, reach=(45.0, 95.0), far=reach, horizon=False)
        dark = _Pass(stage, casting, around, ortho=True, size=(SHADOW_SIZE, SHADOW_SIZE), scale=1).samples
    else:
        dark = wp.zeros((len(views), 1, 1), dtype=wp.uint64, device=stage.device)
    texels = np.diag([1 / texel, 1 / texel, 1.0, 1.0])
    texels[:2, 3] = SHADOW_SIZE / 2
    device, shape = stage.device, (len(views), *size)
    radiance = wp.empty(shape, dtype=wp.vec3, device=device)
    tag, depth = wp.empty(shape, dtype=int, device=device), wp.empty(shape, dtype=float, device=device)
    rows: Any = np.array(lights, dtype=shade.Light.numpy_dtype())  # type: ignore[attr-defined]
    inputs = [
        seen.samples, stage.vertices, stage.faces, stage.normals, stage.uvs, stage.material, stage.surfaces,
        stage.listed, seen.starts, seen.firsts, seen.matrices, seen.paints, seen.tags, seen.textures, seen.rectangles,
        stage.wearable, seen.lens,
        wp.array(poses.astype(np.float32), dtype=wp.mat44, device=device),
        wp.array(rows, dtype=shade.Light, device=device),
        dark,
        wp.array((texels @ to_shadow).astype(np.float32), dtype=wp.mat44, device=device),
        texel, scale,
    ]  # fmt: skip
    textured = any(t.texture >= 0 for v in views for t in v.things)
    room = radiance.size * 2 if textured else 1
    pieces = wp.empty(room, dtype=shade.Fragment, device=device)
    found = wp.zeros(1, dtype=int, device=device)
    wp.launch(shade.shade, dim=shape, inputs=inputs, outputs=[radiance, tag, depth, pieces, found], device=device)
    fragments: Any = np.zeros(0, shade.Fragment.numpy_dtype())  # type: ignore[attr-defined]
    if textured:
        count = int(found.numpy()[0])
        if count > room:
            raise ConfigError(f"{count} pieces of textured surfaces, more than {room}; render fewer views at once")
        fragments = pieces[:count].numpy() if count else fragments
        fragments = fragments[np.lexsort((fragments["slot"], fragments["place"]))]
    image = wp.empty((*shape, 3), dtype=wp.uint8, device=device)
    bright = wp.array(np.array(exposures, np.float32), dtype=float, device=device)
    curve = wp.array(response(), dtype=wp.uint8, device=device)
    amount = wp.array(_noise(views, exposures), dtype=wp.vec2, device=device)
    seeds = wp.array(np.array([v.seed for v in views], np.int32), dtype=int, device=device)
    inputs = [radiance, bright, amount, seeds, curve]
    wp.launch(shade.develop, dim=shape, inputs=inputs, outputs=[image], device=device)
    arrays = (image, radiance, tag, depth)
    if download:
        arrays = tuple(a.numpy() if linear or a is not radiance else a for a in arrays)
    return Picture(*arrays, np.array(exposures), fragments)


def _noise(views: Sequence[View], exposures: Sequence[float]) -> F32:
    """Variance for each unit of light and deviation in the dark, [B, 2]. Beyond the exposure of a clear day half of
    the rest (in stops) is a longer shutter, which costs no noise, half is gain."""
    rows = []
    for view, exposure in zip(views, exposures, strict=True):
        gain = max(exposure / DAY, 1.0) ** 0.5
        rows.append([view.noise**2 * gain, 0.2 * view.noise * gain])
    return np.array(rows, np.float32)


def _light_camera(sun: F64, middle: F64) -> F64:
    """World to light [4, 4]: z runs with the light, x and y across it; `middle` is the origin, to half a metre."""
    z = -sun / np.linalg.norm(sun)
    x = np.cross([0.0, 0.0, 1.0], z)
    x = x / np.linalg.norm(x) if np.linalg.norm(x) > 1e-6 else np.array([1.0, 0, 0])
    turn = np.stack([x, np.cross(z, x), z])
    matrix = np.eye(4)
    matrix[:3, :3] = turn
    matrix[:3, 3] = -np.round(turn @ middle * 2) / 2
    return matrix
