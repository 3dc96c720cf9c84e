"""Renderer: visibility, then shading, then the response of the camera, for a batch of views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import count
from typing import Any

import numpy as np
import warp as wp

from ssad.core.colours import LUMINANCE, linear_to_srgb
from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.core.types import F32, F64, I32, U8
from ssad.rendering.camera.effects import DEFAULT_EFFECTS, NO_EFFECTS, check_effects
from ssad.rendering.camera.glare import add_glow, add_suns, has_glow, scatter, with_lens_effects
from ssad.rendering.camera.kernels import finish as finish_kernels
from ssad.rendering.camera.kernels import layers as layer_kernels
from ssad.rendering.camera.kernels import materials as material_kernels
from ssad.rendering.camera.kernels import puddle, shade, sky
from ssad.rendering.camera.kernels import sensor as sensing
from ssad.rendering.camera.lamps import (
    LAMP_NEAR,
    LAMP_SHADOWS,
    NIGHT_LUX,
    SceneLamp,
    lamp_lens,
    lamp_strength,
    nearby_lights,
    struct_array,
    with_low_beams,
)
from ssad.rendering.camera.probes import gather_probes, no_probes
from ssad.rendering.camera.scene import (
    DrawCalls,
    Finish,
    ObjectTable,
    RenderScene,
    SceneObject,
    TextureDecal,
    TextureLayer,
    collect_objects,
)
from ssad.rendering.camera.sensor import (
    BRIGHTEST,
    DEFAULT_SENSOR,
    KNEE,
    SHOULDER,
    SensorModel,
    noise_levels,
    point_spread,
)
from ssad.rendering.camera.street_lighting import DEFAULT_CLASS, UNLIT, UNLIT_LUX, check_lighting
from ssad.rendering.camera.visibility import VisibilityPass, sun_map

FAR = 500.0
SHADOW_SIZE, SHADOW_REACH = 768, 60.0  # texels, m from the middle to the border
SOFT_WIDE, SOFT_FINE = (1.5, 2), (1.0, 4)  # texels: smallest filter of soft shadows, and search for occluders
VISUAL_RANGE = 12_000.0  # m: distance at which haze leaves 2 % of the contrast, as on a clear summer day
FINE_SIZE, FINE_REACH, FINE_AHEAD = 1024, 12.0, 9.0  # of the fine map; m before the camera, unless a view has a focus


@dataclass(frozen=True, slots=True)
class SceneWeather:
    """Time of day and weather.

    Attributes:
        sun_height: Elevation of the sun, rad.
        sun_heading: Azimuth of the sun, rad, counter-clockwise from east.
        clouds: Cloud cover, 0 to 1.
        fog: Extinction, 1/m.
        wet: Wetness of the ground, 0 to 1.
        exposure: Stops relative to the exposure that suits the light.
        turn: Offset of the clouds.
        lighting: Class of the street lighting at night (see `ssad.rendering.camera.street_lighting`); "": with the
            effect `street-lighting` the usual class, without it lamps that meet none.

    Raises:
        UnknownNameError: There is no such class.
    """

    sun_height: float = 0.7
    sun_heading: float = 0.8
    clouds: float = 0.35
    fog: float = 0.0
    wet: float = 0.0
    exposure: float = 0.0
    turn: float = 0.0
    lighting: str = ""

    def __post_init__(self) -> None:
        check_lighting(self.lighting)


@dataclass(frozen=True, slots=True)
class View:
    """Camera at a pose, and the objects and light in front of it.

    Attributes:
        camera: Size and intrinsics.
        pose: Camera to world [4, 4].
        objects: Objects in the scene besides the street.
        weather: Time of day and weather.
        sensor: Lens, mosaic, noise and full photosites.
        seed: Seed of the noise; equal seeds give equal noise.
        lamps: Lamps besides those of the street and of objects.
        focus: x, y (m) of the place around which shadows are finest; None: just in front of the camera.
        decals: Textures above the layers of objects, the lowest first.
    """

    camera: Camera
    pose: F64
    objects: tuple[SceneObject, ...] = ()
    weather: SceneWeather = SceneWeather()
    sensor: SensorModel = DEFAULT_SENSOR
    seed: int = 0
    lamps: tuple[SceneLamp, ...] = ()
    focus: tuple[float, float] | None = None
    decals: tuple[TextureDecal, ...] = ()


@dataclass(frozen=True, slots=True)
class RenderQuality:
    """Effects of light that are rendered.

    Attributes:
        shadows: Shadows of the sun.
        fine: A fine shadow map around the focus.
        contact: Bodies occlude the light of the sky on the ground.
        lamps: Lamps of the street and of objects, and their shadows.
        effects: Names of further effects that are on, see `ssad.rendering.camera.effects`.
    """

    shadows: bool = True
    fine: bool = True
    contact: bool = True
    lamps: bool = True
    effects: frozenset[str] = DEFAULT_EFFECTS

    def __post_init__(self) -> None:
        check_effects(self.effects)


PLAIN = RenderQuality(shadows=False, fine=False, contact=False, lamps=False, effects=NO_EFFECTS)


@dataclass(frozen=True, slots=True)
class SurfaceMap:
    """Surface that covers most of each pixel, [B, H, W, 3] each; zero for sky.

    Attributes:
        albedo: Linear.
        normal: Unit vectors, world.
        position: World, m.
        irradiance: Irradiance of all light, over pi.
        gain: Gain of the pixel's radiance per unit of albedo (light, share of the pixel, mirror, wet, fog).
    """

    albedo: F32
    normal: F32
    position: F32
    irradiance: F32
    gain: F32


@dataclass(frozen=True, slots=True)
class Rendering:
    """Result of rendering B views.

    Attributes:
        image: uint8 sRGB [B, H, W, 3].
        radiance: Linear [B, H, W, 3].
        tag: Tag of the object that a pixel shows [B, H, W]; -1: sky, 0: street.
        depth: Depth along the optical axis [B, H, W], m; inf for sky.
        exposure: [B]; `image` is the camera's curve of radiance times exposure.
        fragments: Pieces of textured surfaces, which are black in `image`, by pixel and triangle (see
            `ssad.rendering.camera.texture`).
        surface: Surfaces that the pixels show; None unless requested.
        material: Row of each pixel's material in `RenderScene.material_names` [B, H, W]; -1: sky. None unless
            requested.
        effects: Effects that were on.
    """

    image: U8
    radiance: F32
    tag: I32
    depth: F32
    exposure: F64
    fragments: Any
    surface: SurfaceMap | None = None
    material: I32 | None = None
    effects: frozenset[str] = NO_EFFECTS


@lru_cache(maxsize=256)
def scene_light(weather: SceneWeather) -> tuple[tuple[Any, ...], float]:
    """Return the light of a view for the kernels, and the exposure that suits it.

    Day, dusk and night follow from the elevation of the sun.
    """
    height = weather.sun_height
    sun = (
        float(np.cos(height) * np.cos(weather.sun_heading)),
        float(np.cos(height) * np.sin(weather.sun_heading)),
        float(np.sin(height)),
    )
    # Daylight rises from 0.1 rad below the horizon (dusk) to 0.2 rad above it.
    daylight = float(np.clip((height + 0.1) / 0.3, 0, 1))
    warmth = float(np.clip(height / 0.5, 0, 1))
    sun_share = (1 - 0.95 * weather.clouds**2) * float(np.clip(height / 0.12, 0, 1)) * (0.35 + 0.65 * warmth)
    if weather.fog > 0:
        sun_share *= float(np.exp(-weather.fog * 60))
    sun_colour = np.array([1.0, 0.72 + 0.25 * warmth, 0.42 + 0.48 * warmth]) * 2.6 * sun_share
    cloud_colour = np.array([0.88, 0.92, 0.98])
    cloud_share = weather.clouds**2
    zenith_colour = np.array([0.24, 0.46, 0.98]) * (1 - cloud_share) + cloud_colour * cloud_share
    horizon_colour = np.array([0.95, 1.12, 1.30]) * (1 - cloud_share) + 1.15 * cloud_colour * cloud_share
    night_zenith, night_horizon = 0.010, 0.016
    if weather.lighting == UNLIT:
        # The same weights of zenith and horizon as in the shading of level ground.
        level_colour = 0.65 * night_zenith * zenith_colour + 0.35 * night_horizon * horizon_colour
        level = float(level_colour @ LUMINANCE)
        night_zenith, night_horizon = (night * UNLIT_LUX * NIGHT_LUX / level for night in (night_zenith, night_horizon))
    zenith = zenith_colour * (night_zenith + 0.9 * daylight)
    horizon_glow = np.array([1.0, 0.55, 0.30]) * (1 - warmth) * 0.5 * daylight
    horizon = horizon_colour * (night_horizon + 0.9 * daylight)
    horizon = horizon + horizon_glow * (1 - weather.clouds)
    # Light that the ground reflects upwards.
    ground = 0.16 * (horizon + 0.5 * sun_colour * max(sun[2], 0))
    lamps = lamp_strength(height)
    brightness = float(
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
    return light, 0.40 / max(brightness, 0.004) * 2.0**weather.exposure


def kernel_lens(intrinsic: F64) -> tuple[float, float, float, float]:
    """Return focal lengths and principal point for the kernels, pixels.

    The kernels count from the centre of the first pixel, which is at (0.5, 0.5) in an intrinsic matrix.

    Args:
        intrinsic: Camera matrix [3, 3].

    Returns:
        fx, fy, cx, cy.
    """
    matrix = intrinsic
    return float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2] - 0.5), float(matrix[1, 2] - 0.5)


@lru_cache(maxsize=256)
def response(gamma: float = 1.0, contrast: float = 0.0) -> U8:
    """Return the camera's curve [4096] over sqrt(light / 4): linear to 0.8, a soft shoulder above, then sRGB.

    Args:
        gamma: See `ssad.rendering.camera.sensor.SensorModel`.
        contrast: See there.
    """
    light = BRIGHTEST * ((np.arange(4096) + 0.5) / 4096) ** 2
    compressed = np.where(light > KNEE, KNEE + (1 - KNEE) * (1 - np.exp(-(light - KNEE) / SHOULDER)), light)
    encoded = linear_to_srgb(compressed)
    if (gamma, contrast) != (1.0, 0.0):
        encoded = np.clip(encoded, 0.0, 1.0) ** gamma
        encoded = encoded + contrast * encoded * (1 - encoded) * (2 * encoded - 1)
    return np.asarray(np.rint(encoded * 255), np.uint8)


def render(
    scene: RenderScene,
    views: Sequence[View],
    *,
    scale: int = 2,
    quality: RenderQuality = RenderQuality(),
    download: bool = True,
    linear: bool = True,
    surface: bool = False,
    materials: bool = False,
) -> Rendering:
    """Render views of one size.

    Args:
        scene: The scene.
        views: The views.
        scale: Samples along each side of a pixel.
        quality: Which effects of light are rendered.
        download: Whether to return numpy arrays; else image, radiance, tag and depth stay on the stage's device as Warp
            arrays.
        linear: Whether to download the radiance too.
        surface: Whether to say what each pixel shows.
        materials: Whether to name the material that each pixel shows.

    Raises:
        ConfigError: The views do not fit.
    """
    if not views:
        raise ConfigError("no view to render")
    views = [replace(view, sensor=with_lens_effects(view.sensor, quality.effects)) for view in views]
    size = (views[0].camera.height, views[0].camera.width)
    if any((entry.camera.height, entry.camera.width) != size for entry in views):
        raise ConfigError("views of one call must have one size")
    # Koschmieder: contrast falls to 2 % over the visual range.
    haze = 3.912 / VISUAL_RANGE if "haze" in quality.effects else 0.0
    lens, lights, exposures = [], [], []
    for view_index, view in enumerate(views):
        intrinsic = view.camera.intrinsic
        if (
            not np.isfinite(view.pose).all()
            or not np.isfinite(intrinsic).all()
            or min(intrinsic[0, 0], intrinsic[1, 1]) <= 0
        ):
            raise ConfigError(f"view {view_index}: a camera needs a finite pose and a positive focal length")
        lens.append(kernel_lens(intrinsic))
        view_light, exposure = scene_light(view.weather)
        lights.append((*view_light, haze))
        exposures.append(exposure)
    views = [_with_effects(entry, quality.effects) for entry in views]
    poses = np.array([entry.pose for entry in views], np.float64)
    bodies = collect_objects([entry.objects for entry in views])
    if "vehicle-signals" not in quality.effects:
        bodies = replace(bodies, signals=np.zeros_like(bodies.signals))
    # Beyond six extinction lengths fog hides everything.
    far_limits = np.array([min(FAR, 6.0 / entry.weather.fog) if entry.weather.fog > 0 else FAR for entry in views])
    draws = scene.gather_draw_calls(
        np.asarray(np.linalg.inv(poses), np.float64),
        bodies,
        eyes=poses[:, :3, 3],
        axes=poses[:, :3, 2],
        reach=(70.0, 180.0),
        far=far_limits,
        street_lit=np.array([entry.weather.lighting != UNLIT for entry in views]),
    )
    visible = VisibilityPass(scene, draws, np.array(lens, np.float32), ortho=False, size=size, scale=scale)
    shadows = _sun_shadows(scene, views, bodies, [view_light[0] for view_light in lights], quality)
    nearby_light = _near(scene, views, bodies, quality)
    if "reflections" in quality.effects:
        probes = gather_probes(scene, views, lights, shadows=quality.shadows, lamps=quality.lamps)
    else:
        probes = no_probes(scene)
    device, shape = scene.device, (len(views), *size)
    layer_tables = _layers(draws, views, scene.device)
    projecting = any(lamp.texture >= 0 for entry in views for lamp in entry.lamps)
    output = shade.Output()
    output.radiance = wp.empty(shape, dtype=wp.vec3, device=device)
    output.tag = wp.empty(shape, dtype=int, device=device)
    output.depth = wp.empty(shape, dtype=float, device=device)
    # Room for two fragments a pixel; more are an error below.
    fragment_capacity = output.radiance.size * 2 if layer_tables.any or projecting else 1
    output.fragments = wp.empty(fragment_capacity, dtype=layer_kernels.Fragment, device=device)
    output.found = wp.zeros(1, dtype=int, device=device)
    finishes = _finishes(scene, views)
    exports_surface = surface or finishes is not None
    output.surface = int(exports_surface)
    for name in SURFACE:
        setattr(output, name, wp.zeros(shape if exports_surface else (1, 1, 1), dtype=wp.vec3, device=device))
    is_wet = "wet-reflections" in quality.effects and any(view.weather.wet > 0.0 for view in views)
    output.wet = int(is_wet)
    for name, dtype in (("mirror", wp.vec4), ("spread", wp.float32), ("source", wp.vec3)):
        setattr(output, name, wp.empty(shape if is_wet else (1, 1, 1), dtype=dtype, device=device))
    # On the CPU every thread copies the arguments anew, so few threads are faster.
    lanes = 1 if device == "cpu" else shape[2]
    to_world = wp.array(poses.astype(np.float32), dtype=wp.mat44, device=device)
    inputs = [
        scene.geometry,
        visible.draw_ranges,
        layer_tables,
        visible.lens,
        to_world,
        wp.array(struct_array(sky.Light, lights), dtype=sky.Light, device=device),
        shadows,
        nearby_light,
        probes,
        int(projecting),
        scale,
        lanes,
        output,
    ]
    wp.launch(shade.shade, dim=(*shape[:2], lanes), inputs=inputs, device=device)
    if is_wet:
        _add_wet_reflections(output, visible.lens, to_world, lanes)
    fragments: Any = np.zeros(0, layer_kernels.Fragment.numpy_dtype())  # type: ignore[attr-defined]
    if layer_tables.any or projecting:
        count = int(output.found.numpy()[0])
        if count > fragment_capacity:
            raise ConfigError(
                f"{count} pieces of textured surfaces, more than {fragment_capacity}; render fewer views at once"
            )
        fragments = output.fragments[:count].numpy() if count else fragments
        # Threads list fragments in any order; sorting makes the result deterministic.
        fragments = fragments[np.lexsort((fragments["texture"], fragments["slot"], fragments["place"]))]
    material = None
    if materials or finishes is not None:
        found_materials = wp.empty(shape, dtype=int, device=device)
        inputs = [scene.geometry, visible.draw_ranges, scale, output.tag]
        wp.launch(material_kernels.find_materials, dim=shape, inputs=inputs, outputs=[found_materials], device=device)
        material = found_materials.numpy() if materials else None
    if finishes is not None:
        surface_arrays = [output.tag, output.depth, output.albedo, output.normal, output.gain]
        inputs = [*finishes, visible.lens, to_world, scene.surfaces, found_materials, *surface_arrays]
        wp.launch(finish_kernels.apply_finish, dim=shape[:2], inputs=inputs, outputs=[output.radiance], device=device)
    if has_glow(views, lights):
        add_glow(output.radiance, visible, scene, views, lights)
    add_suns(output.radiance, output.tag, views, np.array(lens), lights)
    image = develop_radiance(output.radiance, views, exposures)
    arrays = (image, output.radiance, output.tag, output.depth)
    if download:
        arrays = tuple(array.numpy() if linear or array is not output.radiance else array for array in arrays)
    exported = _surface(output, np.array(lens), poses) if surface else None
    return Rendering(*arrays, np.array(exposures), fragments, exported, material, quality.effects)


def _add_wet_reflections(output: Any, lens: Any, to_world: Any, lanes: int) -> None:
    """Add what water on the ground mirrors of the picture itself."""
    device, (count, height, width) = output.depth.device, output.depth.shape
    rows = (height + int(puddle.ROWS) - 1) // int(puddle.ROWS)
    keys = wp.zeros((count, rows, width), dtype=wp.uint64, device=device)
    inputs = [output.depth, lens, to_world, lanes]
    wp.launch(puddle.mirror_pixels, dim=(count, rows, lanes), inputs=inputs, outputs=[keys], device=device)
    sums = wp.zeros((count, rows + 1, width), dtype=wp.vec4, device=device)
    counts = wp.zeros((count, rows + 1, width), dtype=float, device=device)
    inputs = [keys, output.source, lanes]
    wp.launch(puddle.sum_columns, dim=(count, lanes), inputs=inputs, outputs=[sums, counts], device=device)
    inputs = [output.depth, lens, sums, counts, output.mirror, output.spread, lanes, output.radiance]
    wp.launch(puddle.add_mirror_image, dim=(count, height, lanes), inputs=inputs, device=device)


def _with_effects(view: View, effects: frozenset[str]) -> View:
    """Return the view without the objects of effects that are off, and with the lamps of those that are on."""
    if "street-lighting" in effects and not view.weather.lighting:
        view = replace(view, weather=replace(view.weather, lighting=DEFAULT_CLASS))
    if "low-beams" in effects and view.lamps:
        view = replace(view, lamps=with_low_beams(view.lamps))
    if all(not entry.effect or entry.effect in effects for entry in view.objects):
        return view
    return replace(view, objects=tuple(entry for entry in view.objects if not entry.effect or entry.effect in effects))


SURFACE = ("albedo", "normal", "irradiance", "gain")


def _surface(out: Any, lens: F64, poses: F64) -> SurfaceMap:
    """The exported surfaces, with positions from depth."""
    exported = {name: getattr(out, name).numpy() for name in SURFACE}
    depth = out.depth.numpy()
    y, x = np.mgrid[0 : depth.shape[1], 0 : depth.shape[2]]
    rays = np.stack(
        [
            (x - lens[:, 2, None, None]) / lens[:, 0, None, None],
            (y - lens[:, 3, None, None]) / lens[:, 1, None, None],
            np.ones(depth.shape),
        ],
        -1,
    )
    is_solid = np.isfinite(depth)
    camera_points = rays * np.where(is_solid, depth, 0.0)[..., None]
    position = np.einsum("bij,bhwj->bhwi", poses[:, :3, :3], camera_points) + poses[:, None, None, :3, 3]
    return SurfaceMap(position=(position * is_solid[..., None]).astype(np.float32), **exported)


def _finishes(scene: RenderScene, views: Sequence[View]) -> tuple[Any, Any] | None:
    """Return the finishes of objects, and the row of each tag in each view; None if all are clean."""
    rows: Any = []
    places = []
    for view_index, view in enumerate(views):
        for scene_object in view.objects:
            finish = scene_object.finish
            if finish is None or finish == Finish() or scene_object.layers or scene_object.tag <= 0:
                continue
            from_world = np.linalg.inv(scene_object.pose)
            lower, upper = scene.extent(scene_object.mesh)
            places.append((view_index, scene_object.tag, len(rows)))
            rows.append(
                (
                    from_world @ view.pose,
                    tuple((from_world @ view.pose)[:3, 3]),
                    max(float(upper[2] - lower[2]), 0.1),
                    finish.metallic,
                    finish.dirt,
                    finish.wear,
                    finish.seed % 4096,
                    scene_object.tag,
                )
            )
    if not rows:
        return None
    # Tags can be large numbers: their remainders, none of which two tags share, make a small table.
    tags = {tag for _, tag, _ in places}
    size = next(size for size in count(len(tags)) if len({tag % size for tag in tags}) == len(tags))
    table = np.full((len(views), size), -1, np.int32)
    for view_index, tag, row in places:
        table[view_index, tag % size] = row
    finish_rows: Any = np.array(rows, finish_kernels.Finish.numpy_dtype())  # type: ignore[attr-defined]
    return (
        wp.array(finish_rows, dtype=finish_kernels.Finish, device=scene.device),
        wp.array(table, dtype=int, device=scene.device),
    )


def _sun_shadows(
    scene: RenderScene,
    views: Sequence[View],
    bodies: ObjectTable,
    suns: Sequence[tuple[float, ...]],
    quality: RenderQuality,
) -> Any:
    """Render the shadow maps of the sun: a wide one, and a fine one around each view's focus."""
    poses = np.array([entry.pose for entry in views], np.float64)
    level_axes = poses[:, :3, 2] * [1.0, 1.0, 0.0]
    # The maps lie ahead of the camera, where their texels are visible.
    wide_middles = poses[:, :3, 3] + level_axes * 0.7 * SHADOW_REACH
    fine_middles = poses[:, :3, 3] + level_axes * FINE_AHEAD
    for view_index, view in enumerate(views):
        if view.focus is not None:
            fine_middles[view_index, :2] = view.focus
    is_up = any(sun[2] > 0.02 for sun in suns)
    is_soft = "soft-shadows" in quality.effects
    wide_size = SHADOW_SIZE if quality.shadows and is_up else 0
    fine_size = FINE_SIZE if quality.shadows and quality.fine and is_up else 0
    wide_filter, fine_filter = (SOFT_WIDE, SOFT_FINE) if is_soft else ((0.0, 0), (0.0, 0))
    shadows = shade.SunShadows()
    shadows.soft = int(is_soft)
    shadows.wide = sun_map(scene, bodies, suns, wide_middles, SHADOW_REACH, wide_size, soft=wide_filter)
    shadows.fine = sun_map(scene, bodies, suns, fine_middles, FINE_REACH, fine_size, soft=fine_filter)
    return shadows


def _layers(draws: DrawCalls, views: Sequence[View], device: str) -> Any:
    """Build the layer and decal tables of the kernels."""
    masks: list[F32] = []

    def mask_of(layer: TextureLayer | TextureDecal) -> tuple[int, int, int]:
        if layer.mask is None:
            return -1, 0, 0
        start = sum(mask.size for mask in masks)
        masks.append(np.asarray(layer.mask, np.float32))
        return start, masks[-1].shape[1], masks[-1].shape[0]

    layers = [
        (layer.texture, layer.rectangle, layer.opacity, *mask_of(layer))
        for draw_layers in draws.layers
        for layer in draw_layers
    ]
    decals = []
    for decal in (view_decal for view in views for view_decal in view.decals):
        (width, height), rotation = decal.size, decal.pose[:3, :3]
        decals.append(
            (
                decal.texture,
                tuple(decal.pose[:3, 3]),
                tuple(rotation[:, 0] * 2 / width),
                tuple(rotation[:, 1] * 2 / height),
                tuple(rotation[:, 2]),
                decal.depth,
                width * height,
                decal.tag,
                decal.opacity,
                *mask_of(decal),
            )
        )
    table = layer_kernels.Layers()
    tables: Any = (("layers", layer_kernels.Layer, layers), ("decals", layer_kernels.Decal, decals))
    for name, kernel_struct, rows in tables:
        setattr(table, name, wp.array(struct_array(kernel_struct, rows), dtype=kernel_struct, device=device))
    for name, counts in (
        ("start", [len(layer_row) for layer_row in draws.layers]),
        ("decal_start", [len(view_entry.decals) for view_entry in views]),
    ):
        setattr(table, name, wp.array(np.cumsum([0, *counts]).astype(np.int32), dtype=int, device=device))
    mask_values = np.concatenate([mask.ravel() for mask in masks]) if masks else np.zeros(1, np.float32)
    table.masks = wp.array(mask_values, dtype=float, device=device)
    table.any = int(bool(layers or decals))
    return table


def _near(scene: RenderScene, views: Sequence[View], bodies: ObjectTable, quality: RenderQuality) -> Any:
    """Build lamps with their shadow maps, and the bodies that occlude the sky from the ground."""
    near_light = nearby_lights(
        scene,
        views,
        bodies,
        lamps=quality.lamps,
        contact=quality.contact,
        low_beams="low-beams" in quality.effects,
    )
    shadow_lamps = [(view, lamp) for view in views for lamp in view.lamps if lamp.shadows]
    if not shadow_lamps:
        near_light.shadows = wp.zeros((1, 2, 2), dtype=wp.uint64, device=scene.device)
        return near_light
    poses = np.array([lamp.pose for _, lamp in shadow_lamps], np.float64)
    bodies_of_lamps = collect_objects([view.objects for view, _ in shadow_lamps])
    draws = scene.gather_draw_calls(
        np.asarray(np.linalg.inv(poses), np.float64),
        bodies_of_lamps,
        eyes=poses[:, :3, 3],
        axes=poses[:, :3, 2],
        reach=(70.0, 180.0),
        far=np.array([lamp.reach for _, lamp in shadow_lamps]),
        horizon=False,
        casts_shadows=True,
    )
    lens = np.array([lamp_lens(lamp) for _, lamp in shadow_lamps], np.float32)
    size = (LAMP_SHADOWS, LAMP_SHADOWS)
    near_light.shadows = VisibilityPass(scene, draws, lens, ortho=False, size=size, scale=1, near=LAMP_NEAR).samples
    return near_light


def view_noise(view: View, device: str = "cpu") -> F32 | None:
    """Return the noise [H, W] of a view's photosites in standard deviations; None if its sensor has none.

    With it, `ssad.rendering.camera.torch_sensor.develop` gives the image that `render` does, noise and all.

    Args:
        view: The view, whose sensor has a mosaic.
        device: Device that draws.

    Raises:
        ConfigError: The sensor has noise and no mosaic.
    """
    if view.sensor.noise == 0.0:
        return None
    if not view.sensor.mosaic:
        raise ConfigError("view_noise: the sensor has noise and no mosaic; give the view a sensor with mosaic=True")
    device_noise = wp.empty((view.camera.height, view.camera.width), dtype=float, device=device)
    wp.launch(sensing.draw_noise, dim=device_noise.shape, inputs=[view.seed], outputs=[device_noise], device=device)
    host_noise: F32 = device_noise.numpy()
    return host_noise


def develop_radiance(radiance: Any, views: Sequence[View], exposures: Sequence[float]) -> Any:
    """Develop radiance with the sensors of the views.

    Args:
        radiance: Linear [B, H, W], a Warp array of vec3.
        views: The views; their sensors and seeds count.
        exposures: Of each view.

    Returns:
        Images uint8 [B, H, W, 3], a Warp array on the device of the radiance.
    """
    device, (count, height, width) = radiance.device, radiance.shape
    rows: Any = []
    for view in views:
        view.sensor.check_size(height, width)
    radiance = scatter(radiance, [view.sensor for view in views])
    tones = list(dict.fromkeys(view.sensor.tone for view in views))
    for view, exposure in zip(views, exposures, strict=True):
        sensor = view.sensor
        photons, dark_noise = noise_levels(sensor.noise, exposure)
        centre_weight, side_weight = point_spread(sensor.blur)
        rows.append(
            (
                tuple(exposure * factor for factor in sensor.balance),
                centre_weight,
                side_weight,
                sensor.full,
                photons,
                dark_noise,
                view.seed,
                int(sensor.mosaic),
                tones.index(sensor.tone),
                sensor.saturation,
            )
        )
    response_rows: Any = np.array(rows, dtype=sensing.Response.numpy_dtype())  # type: ignore[attr-defined]
    responses = wp.array(response_rows, dtype=sensing.Response, device=device)
    curves = wp.array(np.stack([response(*tone) for tone in tones]), dtype=wp.uint8, device=device)
    image = wp.empty((count, height, width, 3), dtype=wp.uint8, device=device)
    if any(view.sensor.mosaic for view in views):
        mosaic = wp.empty(radiance.shape, dtype=float, device=device)
        # A thread develops a 2 x 2 square of the mosaic.
        launch_shape = (count, (height + 1) // 2, (width + 1) // 2)
        wp.launch(sensing.expose, dim=launch_shape, inputs=[radiance, responses], outputs=[mosaic], device=device)
        wp.launch(sensing.develop, dim=launch_shape, inputs=[mosaic, responses, curves], outputs=[image], device=device)
    if not all(view.sensor.mosaic for view in views):
        inputs = [radiance, responses, curves]
        wp.launch(sensing.develop_plain, dim=radiance.shape, inputs=inputs, outputs=[image], device=device)
    return image
