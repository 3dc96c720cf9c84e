"""From a stage, cameras and light to pictures: visibility once, then shading, then the camera's response."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import warp as wp

from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.core.types import F32, F64, I32, U8
from ssad.rendering.camera.kernels import layers as layer_kernels
from ssad.rendering.camera.kernels import raster, shade, sky
from ssad.rendering.camera.kernels import sensor as sensing
from ssad.rendering.camera.lamps import LAMP_NEAR, LAMP_SHADOWS, Lamp, lamp_lens, lamp_strength, near_of, struct_array
from ssad.rendering.camera.scene import Bodies, Decal, Draws, Layer, Scene, Thing, collect
from ssad.rendering.camera.sensor import BRIGHTEST, DEFAULT_SENSOR, KNEE, SHOULDER, Sensor, noise_levels, point_spread

NEAR = 0.15  # m
FAR = 500.0
LARGE, ROW_LANES = 4096, 32  # large triangles that a view may list, threads for each
FACE_LANES = 512  # threads for each draw on a GPU
SHADOW_SIZE, SHADOW_REACH = 768, 60.0  # texels, m from the middle to the border
FINE_SIZE, FINE_REACH, FINE_AHEAD = 1024, 12.0, 9.0  # of the fine map; m before the camera, unless a view has a focus


@dataclass(frozen=True, slots=True)
class Weather:
    """Time of day and weather.

    Attributes:
        sun_height: Elevation of the sun, rad.
        sun_heading: Azimuth of the sun, rad, counter-clockwise from east.
        clouds: 0 to 1.
        fog: Extinction, 1/m.
        wet: Wetness of the ground, 0 to 1.
        exposure: Stops relative to the exposure that suits the light.
        turn: Offset of the clouds.
    """

    sun_height: float = 0.7
    sun_heading: float = 0.8
    clouds: float = 0.35
    fog: float = 0.0
    wet: float = 0.0
    exposure: float = 0.0
    turn: float = 0.0


@dataclass(frozen=True, slots=True)
class View:
    """A camera at a place, and what it sees.

    Attributes:
        camera: Size and intrinsics.
        pose: Camera to world [4, 4].
        things: What stands there.
        weather: Time of day and weather.
        sensor: Lens, mosaic, noise and full photosites.
        seed: Seed of the noise; equal seeds give equal noise.
        lamps: Lamps besides those of the street and of things.
        focus: x, y (m) of the place around which shadows are finest; None: just in front of the camera.
        decals: Textures above what things wear, the lowest first.
    """

    camera: Camera
    pose: F64
    things: tuple[Thing, ...] = ()
    weather: Weather = Weather()
    sensor: Sensor = DEFAULT_SENSOR
    seed: int = 0
    lamps: tuple[Lamp, ...] = ()
    focus: tuple[float, float] | None = None
    decals: tuple[Decal, ...] = ()


@dataclass(frozen=True, slots=True)
class Quality:
    """Which effects of light are rendered.

    Attributes:
        shadows: Shadows of the sun.
        fine: A fine shadow map around the focus.
        contact: Bodies keep the light of the sky from the ground.
        lamps: Lamps of the street and of things, and their shadows.
    """

    shadows: bool = True
    fine: bool = True
    contact: bool = True
    lamps: bool = True


PLAIN = Quality(shadows=False, fine=False, contact=False, lamps=False)


@dataclass(frozen=True, slots=True)
class Surface:
    """What covers most of each pixel, [B, H, W, 3] each; zero for sky.

    Attributes:
        albedo: Linear.
        normal: Unit vectors, world.
        position: World, m.
        irradiance: Irradiance of all light, over pi.
        gain: What the pixel's radiance gains per unit of albedo (light, share of the pixel, mirror, wet, fog).
    """

    albedo: F32
    normal: F32
    position: F32
    irradiance: F32
    gain: F32


@dataclass(frozen=True, slots=True)
class Picture:
    """B rendered pictures.

    Attributes:
        image: uint8 sRGB [B, H, W, 3].
        radiance: Linear [B, H, W, 3].
        tag: Tag of the thing that a pixel shows [B, H, W]; -1: sky, 0: street.
        depth: Depth along the optical axis [B, H, W], m; inf for sky.
        exposure: [B]; `image` is the camera's curve of radiance times exposure.
        fragments: Pieces of textured surfaces, which are black in the picture, by pixel and triangle (see
            `ssad.rendering.camera.texture`).
        surface: What the pixels show, where it was asked for.
    """

    image: U8
    radiance: F32
    tag: I32
    depth: F32
    exposure: F64
    fragments: Any
    surface: Surface | None = None


@lru_cache(maxsize=256)
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
    zenith = (np.array([0.24, 0.46, 0.98]) * (1 - veil) + grey * veil) * (0.010 + 0.9 * day)
    glow = np.array([1.0, 0.55, 0.30]) * (1 - warm) * 0.5 * day
    horizon = (np.array([0.95, 1.12, 1.30]) * (1 - veil) + 1.15 * grey * veil) * (0.016 + 0.9 * day)
    horizon = horizon + glow * (1 - weather.clouds)
    ground = 0.16 * (horizon + 0.5 * sun_colour * max(sun[2], 0))
    lamps = lamp_strength(height)
    bright = float(
        0.30 * (0.9 * sun_colour.mean() * max(sun[2], 0.1) + zenith.mean() + 0.6 * horizon.mean()) + 0.05 * lamps
    )
    light = (
        sun,
        tuple(sun_colour),
        tuple(zenith),
        tuple(horizon),
        tuple(ground),
        weather.fog,
        weather.clouds,
        weather.wet,
        lamps,
        weather.turn,
    )
    return light, 0.40 / max(bright, 0.004) * 2.0**weather.exposure


def kernel_lens(intrinsic: F64) -> tuple[float, float, float, float]:
    """Focal lengths and principal point as the kernels take them, pixels.

    The kernels count from the centre of the first pixel, which is at (0.5, 0.5) in an intrinsic matrix.

    Args:
        intrinsic: Camera matrix [3, 3].

    Returns:
        fx, fy, cx, cy.
    """
    k = intrinsic
    return float(k[0, 0]), float(k[1, 1]), float(k[0, 2] - 0.5), float(k[1, 2] - 0.5)


@lru_cache(maxsize=1)
def response() -> U8:
    """The camera's curve [4096] over sqrt(light / 4): linear to 0.8, a soft shoulder above, then sRGB."""
    light = BRIGHTEST * ((np.arange(4096) + 0.5) / 4096) ** 2
    soft = np.where(light > KNEE, KNEE + (1 - KNEE) * (1 - np.exp(-(light - KNEE) / SHOULDER)), light)
    srgb = np.where(soft <= 0.0031308, soft * 12.92, 1.055 * soft ** (1 / 2.4) - 0.055)
    return np.asarray(np.rint(srgb * 255), np.uint8)


class _Pass:
    """One visibility pass over all views: draws, slots, samples."""

    def __init__(
        self,
        stage: Scene,
        draws: Draws,
        lens: F32,
        *,
        ortho: bool,
        size: tuple[int, int],
        scale: int,
        near: float = NEAR,
    ) -> None:
        device = stage.device
        total = int(draws.counts.sum())
        drawn = shade.Drawn()
        starts = wp.array(np.concatenate([[0], np.cumsum(draws.counts)]).astype(np.int32), dtype=int, device=device)
        firsts = wp.array(draws.firsts, dtype=int, device=device)
        drawn.matrices = wp.array(draws.matrices, dtype=wp.mat44, device=device)
        drawn.paints = wp.array(draws.paints, dtype=wp.vec3, device=device)
        drawn.tags = wp.array(draws.tags, dtype=int, device=device)
        drawn.lit = wp.array(draws.lit, dtype=int, device=device)
        self.lens = wp.array(lens, dtype=wp.vec4, device=device)
        views = wp.array(draws.views, dtype=int, device=device)
        height, width = size[0] * scale, size[1] * scale
        self.samples = drawn.samples = wp.zeros((len(lens), height, width), dtype=wp.uint64, device=device)
        self.drawn = drawn
        drawn.owners = wp.empty(max(total, 1), dtype=wp.vec2i, device=device)
        if not total:
            return
        gpu = device != "cpu"
        # on a GPU the faces of a draw are shared out over threads, and so are the rows of large triangles
        room = LARGE * len(lens) if gpu else 1
        large = wp.empty(room, dtype=raster.Triangle, device=device)
        many = wp.zeros(1, dtype=int, device=device)
        lanes = FACE_LANES if gpu else 1
        inputs = [
            stage.vertices,
            stage.faces,
            stage.listed,
            starts,
            firsts,
            views,
            drawn.matrices,
            self.lens,
            near,
            float(scale),
            int(ortho),
            lanes,
            256.0 if gpu else 1e30,
        ]
        outputs = [drawn.owners, self.samples, large, many]
        wp.launch(raster.fill, dim=(len(draws.counts), lanes), inputs=inputs, outputs=outputs, device=device)
        if gpu:
            inputs = [large, many, ROW_LANES]
            wp.launch(raster.fill_large, dim=(room, ROW_LANES), inputs=inputs, outputs=[self.samples], device=device)


def render(
    stage: Scene,
    views: Sequence[View],
    *,
    scale: int = 2,
    quality: Quality = Quality(),
    download: bool = True,
    linear: bool = True,
    surface: bool = False,
) -> Picture:
    """Render views of one size.

    Args:
        stage: The scene.
        views: The views.
        scale: Samples along each side of a pixel.
        quality: Which effects of light are rendered.
        download: Whether to return numpy arrays; else image, radiance, tag and depth stay on the stage's device as Warp
            arrays.
        linear: Whether to download the radiance too.
        surface: Whether to say what each pixel shows.

    Raises:
        ConfigError: The views do not fit.
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
        lens.append(kernel_lens(k))
        light, exposure = light_of(view.weather)
        lights.append(light)
        exposures.append(exposure)
    poses = np.array([v.pose for v in views], np.float64)
    bodies = collect([v.things for v in views])
    far = np.array([min(FAR, 6.0 / v.weather.fog) if v.weather.fog > 0 else FAR for v in views])
    draws = stage.gather(
        np.asarray(np.linalg.inv(poses), np.float64),
        bodies,
        eyes=poses[:, :3, 3],
        axes=poses[:, :3, 2],
        reach=(70.0, 180.0),
        far=far,
    )
    seen = _Pass(stage, draws, np.array(lens, np.float32), ortho=False, size=size, scale=scale)
    shadows = _sun_shadows(stage, views, bodies, [light[0] for light in lights], quality)
    near = _near(stage, views, bodies, quality)
    device, shape = stage.device, (len(views), *size)
    layers = _layers(draws, views, stage.device)
    projecting = any(lamp.texture >= 0 for v in views for lamp in v.lamps)
    out = shade.Output()
    out.radiance = wp.empty(shape, dtype=wp.vec3, device=device)
    out.tag = wp.empty(shape, dtype=int, device=device)
    out.depth = wp.empty(shape, dtype=float, device=device)
    room = out.radiance.size * 2 if layers.any or projecting else 1
    out.fragments = wp.empty(room, dtype=layer_kernels.Fragment, device=device)
    out.found = wp.zeros(1, dtype=int, device=device)
    out.surface = int(surface)
    for name in SURFACE:
        setattr(out, name, wp.zeros(shape if surface else (1, 1, 1), dtype=wp.vec3, device=device))
    lanes = 1 if device == "cpu" else shape[2]
    inputs = [
        stage.geometry,
        seen.drawn,
        layers,
        seen.lens,
        wp.array(poses.astype(np.float32), dtype=wp.mat44, device=device),
        wp.array(struct_array(sky.Light, lights), dtype=sky.Light, device=device),
        shadows,
        near,
        int(projecting),
        scale,
        lanes,
        out,
    ]
    wp.launch(shade.shade, dim=(*shape[:2], lanes), inputs=inputs, device=device)
    fragments: Any = np.zeros(0, layer_kernels.Fragment.numpy_dtype())  # type: ignore[attr-defined]
    if layers.any or projecting:
        count = int(out.found.numpy()[0])
        if count > room:
            raise ConfigError(f"{count} pieces of textured surfaces, more than {room}; render fewer views at once")
        fragments = out.fragments[:count].numpy() if count else fragments
        fragments = fragments[np.lexsort((fragments["texture"], fragments["slot"], fragments["place"]))]
    image = develop_radiance(out.radiance, views, exposures)
    arrays = (image, out.radiance, out.tag, out.depth)
    if download:
        arrays = tuple(a.numpy() if linear or a is not out.radiance else a for a in arrays)
    exported = _surface(out, np.array(lens), poses) if surface else None
    return Picture(*arrays, np.array(exposures), fragments, exported)


SURFACE = ("albedo", "normal", "irradiance", "gain")


def _surface(out: Any, lens: F64, poses: F64) -> Surface:
    """The exported surfaces, with positions from depth."""
    found = {name: getattr(out, name).numpy() for name in SURFACE}
    depth = out.depth.numpy()
    y, x = np.mgrid[0 : depth.shape[1], 0 : depth.shape[2]]
    ray = np.stack(
        [
            (x - lens[:, 2, None, None]) / lens[:, 0, None, None],
            (y - lens[:, 3, None, None]) / lens[:, 1, None, None],
            np.ones(depth.shape),
        ],
        -1,
    )
    solid = np.isfinite(depth)
    local = ray * np.where(solid, depth, 0.0)[..., None]
    position = np.einsum("bij,bhwj->bhwi", poses[:, :3, :3], local) + poses[:, None, None, :3, 3]
    return Surface(position=(position * solid[..., None]).astype(np.float32), **found)


def _sun_shadows(
    stage: Scene, views: Sequence[View], bodies: Bodies, suns: Sequence[tuple[float, ...]], quality: Quality
) -> Any:
    """The shadow maps of the sun: a wide one, and a fine one around each view's focus."""
    poses = np.array([v.pose for v in views], np.float64)
    flat = poses[:, :3, 2] * [1.0, 1.0, 0.0]
    wide = poses[:, :3, 3] + flat * 0.7 * SHADOW_REACH
    fine = poses[:, :3, 3] + flat * FINE_AHEAD
    for number, view in enumerate(views):
        if view.focus is not None:
            fine[number, :2] = view.focus
    high = any(sun[2] > 0.02 for sun in suns)
    shadows = shade.SunShadows()
    shadows.wide, shadows.to_wide, shadows.wide_texel = _sun_map(
        stage, bodies, suns, wide, SHADOW_REACH, SHADOW_SIZE if quality.shadows and high else 0
    )
    shadows.fine, shadows.to_fine, shadows.fine_texel = _sun_map(
        stage, bodies, suns, fine, FINE_REACH, FINE_SIZE if quality.shadows and quality.fine and high else 0
    )
    return shadows


def _sun_map(  # noqa: PLR0917
    stage: Scene, bodies: Bodies, suns: Sequence[tuple[float, ...]], middles: F64, reach: float, size: int
) -> tuple[Any, Any, float]:
    """A shadow map [B, size, size] around each middle, the matrices from the world to its texels, m a texel."""
    middles = middles * [1.0, 1.0, 0.0]
    texel = 2 * reach / max(size, 1)
    to_light = _light_cameras(np.array(suns), middles)
    texels = np.diag([1 / texel, 1 / texel, 1.0, 1.0])
    texels[:2, 3] = size / 2
    matrices = wp.array((texels @ to_light).astype(np.float32), dtype=wp.mat44, device=stage.device)
    if not size:
        return wp.zeros((len(middles), 1, 1), dtype=wp.uint64, device=stage.device), matrices, texel
    half = size / 2 - 0.5
    around = np.tile(np.array([1 / texel, 1 / texel, half, half], np.float32), (len(middles), 1))
    # as far as what casts a shadow into the map can be away; small things of the street near its middle alone
    far = 1.4 * reach + 11.0
    casting = stage.gather(
        to_light,
        bodies,
        eyes=middles,
        axes=None,
        reach=(0.4 * reach, far),
        far=np.full(len(middles), far),
        horizon=False,
        casting=True,
    )
    return _Pass(stage, casting, around, ortho=True, size=(size, size), scale=1).samples, matrices, texel


def _layers(draws: Draws, views: Sequence[View], device: str) -> Any:
    """Layers of draws and decals of views as the kernels read them."""
    masks: list[F32] = []

    def mask_of(wanted: Layer | Decal) -> tuple[int, int, int]:
        if wanted.mask is None:
            return -1, 0, 0
        start = sum(m.size for m in masks)
        masks.append(np.asarray(wanted.mask, np.float32))
        return start, masks[-1].shape[1], masks[-1].shape[0]

    layers = [(layer.texture, layer.rectangle, layer.opacity, *mask_of(layer)) for row in draws.layers for layer in row]
    decals = []
    for decal in (d for view in views for d in view.decals):
        (width, height), turn = decal.size, decal.pose[:3, :3]
        decals.append(
            (
                decal.texture,
                tuple(decal.pose[:3, 3]),
                tuple(turn[:, 0] * 2 / width),
                tuple(turn[:, 1] * 2 / height),
                tuple(turn[:, 2]),
                decal.depth,
                width * height,
                decal.tag,
                decal.opacity,
                *mask_of(decal),
            )
        )
    table = layer_kernels.Layers()
    tables: Any = (("layers", layer_kernels.Layer, layers), ("decals", layer_kernels.Decal, decals))
    for name, struct, rows in tables:
        setattr(table, name, wp.array(struct_array(struct, rows), dtype=struct, device=device))
    for name, counts in (("start", [len(r) for r in draws.layers]), ("decal_start", [len(v.decals) for v in views])):
        setattr(table, name, wp.array(np.cumsum([0, *counts]).astype(np.int32), dtype=int, device=device))
    flat = np.concatenate([m.ravel() for m in masks]) if masks else np.zeros(1, np.float32)
    table.masks = wp.array(flat, dtype=float, device=device)
    table.any = int(bool(layers or decals))
    return table


def _near(stage: Scene, views: Sequence[View], bodies: Bodies, quality: Quality) -> Any:
    """Lamps with their shadow maps, and bodies that keep light from the ground."""
    near = near_of(stage, views, bodies, lamps=quality.lamps, contact=quality.contact)
    casting = [(view, lamp) for view in views for lamp in view.lamps if lamp.shadows]
    if not casting:
        near.shadows = wp.zeros((1, 2, 2), dtype=wp.uint64, device=stage.device)
        return near
    poses = np.array([lamp.pose for _, lamp in casting], np.float64)
    around = collect([view.things for view, _ in casting])
    draws = stage.gather(
        np.asarray(np.linalg.inv(poses), np.float64),
        around,
        eyes=poses[:, :3, 3],
        axes=poses[:, :3, 2],
        reach=(70.0, 180.0),
        far=np.array([lamp.reach for _, lamp in casting]),
        horizon=False,
        casting=True,
    )
    lens = np.array([lamp_lens(lamp) for _, lamp in casting], np.float32)
    size = (LAMP_SHADOWS, LAMP_SHADOWS)
    near.shadows = _Pass(stage, draws, lens, ortho=False, size=size, scale=1, near=LAMP_NEAR).samples
    return near


def develop_radiance(radiance: Any, views: Sequence[View], exposures: Sequence[float]) -> Any:
    """What the sensors of views make of radiance.

    Args:
        radiance: Linear [B, H, W], a Warp array of vec3.
        views: The views; their sensors and seeds count.
        exposures: Of each view.

    Returns:
        Pictures uint8 [B, H, W, 3], a Warp array on the device of the radiance.
    """
    device, (count, height, width) = radiance.device, radiance.shape
    rows: Any = []
    for view, exposure in zip(views, exposures, strict=True):
        sensor = view.sensor
        sensor.check_size(height, width)
        photons, dark = noise_levels(sensor.noise, exposure)
        centre, side = point_spread(sensor.blur)
        rows.append((exposure, centre, side, sensor.full, photons, dark, view.seed, int(sensor.mosaic)))
    table: Any = np.array(rows, dtype=sensing.Response.numpy_dtype())  # type: ignore[attr-defined]
    responses = wp.array(table, dtype=sensing.Response, device=device)
    curve = wp.array(response(), dtype=wp.uint8, device=device)
    image = wp.empty((count, height, width, 3), dtype=wp.uint8, device=device)
    if any(view.sensor.mosaic for view in views):
        raw = wp.empty(radiance.shape, dtype=float, device=device)
        squares = (count, (height + 1) // 2, (width + 1) // 2)
        wp.launch(sensing.expose, dim=squares, inputs=[radiance, responses], outputs=[raw], device=device)
        wp.launch(sensing.develop, dim=squares, inputs=[raw, responses, curve], outputs=[image], device=device)
    if not all(view.sensor.mosaic for view in views):
        inputs = [radiance, responses, curve]
        wp.launch(sensing.develop_plain, dim=radiance.shape, inputs=inputs, outputs=[image], device=device)
    return image


def _light_cameras(suns: F64, middles: F64) -> F64:
    """World to light [B, 4, 4], for directions to the sun and middles [B, 3].

    z runs with the light, x and y across it; the origin is the middle, rounded to half a metre.
    """
    z = -suns / np.linalg.norm(suns, axis=1, keepdims=True)
    flat = np.hypot(z[:, 0], z[:, 1])
    level = np.maximum(flat, 1e-6)
    x = np.stack([-z[:, 1] / level, z[:, 0] / level, np.zeros(len(z))], 1)
    x[flat <= 1e-6] = 1.0, 0.0, 0.0
    turn = np.stack([x, np.cross(z, x), z], 1)
    matrices = np.zeros((len(z), 4, 4))
    matrices[:, :3, :3] = turn
    matrices[:, :3, 3] = -np.round((turn @ middles[..., None])[..., 0] * 2) / 2
    matrices[:, 3, 3] = 1.0
    return matrices
