"""Recorded images as functions of the texture on their target: rendered once, stored on disk.

The contribution of a texture to the pixels does not depend on its values. An image is therefore rendered once with
layers on its target; from then on it can be shown with any texture in a few milliseconds, with gradients, also by a
later process.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import ssad
from ssad.core import safeio
from ssad.core.errors import ConfigError
from ssad.core.images import read_image
from ssad.core.seeding import digest
from ssad.core.types import F32, U8, Bool
from ssad.recorders.target_images import RecordedView, image_rows, recorded_views, recording_of
from ssad.rendering.camera.glare import with_lens_effects
from ssad.rendering.camera.render import Rendering, View, render, view_noise
from ssad.rendering.camera.scene import TextureDecal, TextureLayer
from ssad.rendering.camera.sensor import SENSOR, SensorModel
from ssad.rendering.camera.texture import Taps, combine_taps, retexture, texture_taps
from ssad.rendering.camera.torch_sensor import (
    PART_LEVELS,
    ChangedWindow,
    Rectangle,
    curve,
    generators_on_device,
    scatter,
    scatter_parts,
)

VISIBLE = 1.0 / 255.0  # change of a value from which on the glow of a texture counts
KEPT = ".seen"  # folder of a recording for what has been rendered
MARGIN = 80  # px around what a texture touches: more than lens, mosaic and JPEG read
BLOCK = 16  # px: parts begin at blocks of JPEG
STEP = 2**PART_LEVELS  # px at whose multiples windows begin, so that glare does not depend on them


@dataclass(frozen=True, slots=True)
class TexturableImage:
    """A recorded picture whose target wears textures.

    Attributes:
        file: Its name in the folder `images`.
        row: What the annotation file says of it.
        objects: What is annotated in it (see `RecordedView`).
        image: As recorded, uint8 RGB [H, W, 3].
        corner: Row and column at which `radiance` begins in it.
        radiance: Behind the lens, of the part around what wears the textures, linear, textured pixels without them
            [h, w, 3].
        exposure: What radiance is multiplied by.
        fragments: What pixels of the part see of the textures (see `Rendering.fragments`).
        sensor: Sensor of the camera, with the effects of its lens.
        noise: Noise of the photosites of the part in standard deviations [h, w]; None if there is none.
        glow: Rows and columns of the picture in which light from the textures, scattered by the lens, can change a code
            by more than one.
    """

    file: str
    row: Mapping[str, Any]
    objects: tuple[Mapping[str, Any], ...]
    image: U8
    corner: tuple[int, int]
    radiance: F32
    exposure: float
    fragments: Any
    sensor: SensorModel
    glow: Rectangle
    noise: F32 | None = None

    def prepare(
        self,
        sizes: Mapping[int, int | tuple[int, int]],
        *,
        masks: Mapping[int, Bool] | None = None,
        quality: int | None = 92,
        glow: bool = True,
        device: str | torch.device = "cpu",
    ) -> PreparedImage:
        """Prepare the image for textures of certain sizes.

        Args:
            sizes: Number of each texture -> its height and width, or one side, texels. It must cover all textures.
            masks: Number of a texture -> which texels are on the surface (see `paint_mask`).
            quality: JPEG quality, as recorded; None: no compression.
            glow: Whether the light that the lens scatters of the textures reaches as far as it can be seen, at night
                over the whole picture; False: no farther than a few pixels, which takes less time and memory.
            device: Device of the images.

        Raises:
            ConfigError: A texture of the target has no size, or bad sizes and masks.
        """
        texture_numbers = set(np.unique(self.fragments["texture"]).tolist())
        if not texture_numbers <= set(sizes):
            raise ConfigError(
                f"{self.file}: no size for texture {min(texture_numbers - set(sizes))}, which its target wears"
            )
        masks = masks or {}
        (top, left), (height, width) = self.corner, self.image.shape[:2]
        rectangle = (top, top + self.radiance.shape[0]), (left, left + self.radiance.shape[1])
        taps = {
            number: _move_taps(
                texture_taps(self, texture_size, texture=number, mask=masks.get(number)), rectangle, width
            )
            for number, texture_size in sizes.items()
        }
        touched_pixels = torch.cat([lookups.pixel for lookups in taps.values()])
        if glow and len(touched_pixels):
            (first_row, last_row), (first_column, last_column) = self.glow
            corners = [first_row * width + first_column, (last_row - 1) * width + last_column - 1]
            touched_pixels = torch.cat([touched_pixels, torch.tensor(corners)])
        behind_lens = replace(self.sensor, glare=0.0, flare=0.0)
        window = ChangedWindow.around(touched_pixels, (1, height, width), behind_lens, quality=quality, step=STEP)
        radiance = _cut(torch.tensor(self.radiance), rectangle, window.read[0])
        recorded_image = torch.tensor(self.image).to(device).permute(2, 0, 1)
        device_taps = {number: lookups.to(device) for number, lookups in taps.items()}
        noise = None
        if self.noise is not None:
            noise = _cut(torch.tensor(self.noise), rectangle, window.read[0]).to(device)
        part = radiance.to(device)
        return PreparedImage(window, part, self.exposure, device_taps, recorded_image, self.sensor, noise)


@dataclass(frozen=True, slots=True)
class PreparedImage:
    """Image that is ready for textures.

    Attributes:
        window: Part of the image that is developed anew.
        part: Radiance behind the lens that the window reads, without the textures [h, w, 3].
        exposure: Factor on the radiance.
        taps: Contribution of each texture to the pixels of the image, by its number.
        before: The whole image as recorded, uint8 [3, H, W].
        lens: Sensor of the camera, with the effects of its lens.
        noise: Noise of the photosites of the part, as recorded [h, w]; None if there is none.
    """

    window: ChangedWindow
    part: Tensor
    exposure: float
    taps: Mapping[int, Taps]
    before: Tensor
    lens: SensorModel
    noise: Tensor | None = None

    def show(self, textures: Mapping[int, Tensor], noise: torch.Generator | None = None) -> Tensor:
        """Return the image with textures on its target, [1, 3, H, W].

        Args:
            textures: Number -> linear albedo [3, h, w] in 0 to 1.
            noise: See `together`.

        Raises:
            ConfigError: See `together`.
        """
        batched_textures = {number: texture[None] for number, texture in textures.items()}
        return PreparedImage.together([self], batched_textures, None if noise is None else [noise])

    @classmethod
    def together(
        cls,
        pictures: Sequence[PreparedImage],
        textures: Mapping[int, Tensor],
        noise: Sequence[torch.Generator] | None = None,
    ) -> Tensor:
        """Pictures with textures on their targets, in few operations however many there are.

        Args:
            pictures: Of one size, sensor and JPEG quality.
            textures: Number -> linear albedo in 0 to 1, one for each picture [B, 3, h, w].
            noise: Of each picture, draws new noise of the sensor where it changes; None for that of the recording.

        Returns:
            [B, 3, H, W] in [0, 1], differentiable in the textures.

        Raises:
            ConfigError: A texture of another size or beyond 0 to 1; one is missing.
        """
        radiance, window = cls.lit(pictures, textures)
        return cls.developed(pictures, radiance, window, noise)

    @staticmethod
    def lit(pictures: Sequence[PreparedImage], textures: Mapping[int, Tensor]) -> tuple[Tensor, ChangedWindow]:
        """The first half of `together`: radiance [B, h, w, 3] behind the lens that a window of all pictures reads."""
        first_window, batch_size = pictures[0].window, len(pictures)
        missing = sorted(set(pictures[0].taps) - set(textures))
        if missing:
            raise ConfigError(f"no texture {missing[0]}")
        window = first_window
        if batch_size > 1:
            window = ChangedWindow.of(
                [prepared.window.changed[0] for prepared in pictures],
                (batch_size, *first_window.shape[1:]),
                first_window.sensor,
                quality=first_window.quality,
                subsampling=first_window.subsampling,
                step=STEP,
            )
        (rows, columns), (_, image_height, image_width) = window.read[0], first_window.shape
        window_size = rows[1] - rows[0], columns[1] - columns[0]
        radiance = pictures[0].part.new_zeros((batch_size, *window_size, 3))
        texture_light = torch.zeros_like(radiance)
        for window_radiance, prepared, read_rectangle in zip(radiance, pictures, window.read, strict=True):
            target_slices, source_slices = _overlap(prepared.window.read[0], read_rectangle)
            window_radiance[target_slices] = prepared.part[source_slices]
        corners = [(read_rectangle[0][0], read_rectangle[1][0]) for read_rectangle in window.read]
        for layer in pictures[0].taps:
            taps = combine_taps([prepared.taps[layer] for prepared in pictures], corners, image_width, window_size)
            texture_light = retexture(taps, textures[layer], texture_light)
        return radiance + scatter_parts(texture_light, pictures[0].lens, corners, (image_height, image_width)), window

    @staticmethod
    def developed(
        pictures: Sequence[PreparedImage],
        radiance: Tensor,
        window: ChangedWindow,
        noise: Sequence[torch.Generator] | None,
    ) -> Tensor:
        """The second half of `together`: what lens, sensor and JPEG make of it, in the whole pictures."""
        samples = [prepared.noise for prepared in pictures]
        if noise is not None:
            # Noise is drawn for the image's own window, so that it does not depend on the batch.
            mosaic = window.sensor.mosaic
            shapes = [prepared.part.shape[: 2 if mosaic else 3] for prepared in pictures]
            generators = generators_on_device(noise, radiance.device)
            samples = [
                torch.randn(shape, generator=rng, device=rng.device)
                for shape, rng in zip(shapes, generators, strict=True)
            ]
        noise_sample = None
        if (first_sample := samples[0]) is not None:
            noise_sample = radiance.new_zeros((*radiance.shape[:3], *first_sample.shape[2:]))
            for image_noise, prepared, read_rectangle, sample in zip(
                noise_sample, pictures, window.read, samples, strict=True
            ):
                target_slices, source_slices = _overlap(prepared.window.read[0], read_rectangle)
                if sample is not None:
                    image_noise[target_slices] = sample[source_slices]
        exposure = torch.tensor([prepared.exposure for prepared in pictures]).to(radiance)
        recorded_images = torch.stack([prepared.before for prepared in pictures])
        return window.paste(window.develop(radiance, exposure, noise_sample), recorded_images)


def _overlap(source: Rectangle, target: Rectangle) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """Where the pixels that two rectangles share lie in the wanted one, and in one's own."""
    intersection = [
        (max(own_span[0], wanted_span[0]), min(own_span[1], wanted_span[1]))
        for own_span, wanted_span in zip(source, target, strict=True)
    ]
    wanted_slices, own_slices = (
        tuple(
            slice(start - span[0], max(start, stop) - span[0])
            for (start, stop), span in zip(intersection, sides, strict=True)
        )
        for sides in (target, source)
    )
    return wanted_slices, own_slices


def _cut(values: Tensor, source: Rectangle, target: Rectangle) -> Tensor:
    """What values [h, w, ...] of a rectangle are in another one; 0 outside of their own."""
    if source == target:
        return values
    wanted_slices, own_slices = _overlap(source, target)
    window_values = values.new_zeros((*(stop - start for start, stop in target), *values.shape[2:]))
    window_values[wanted_slices] = values[own_slices]
    return window_values


def _move_taps(taps: Taps, rectangle: Rectangle, width: int) -> Taps:
    """Taps into a rectangle as taps into the whole picture, which is so wide."""
    (rows, columns), rectangle_width = rectangle, rectangle[1][1] - rectangle[1][0]
    return replace(
        taps, pixel=(taps.pixel // rectangle_width + rows[0]) * width + taps.pixel % rectangle_width + columns[0]
    )


def texturable_images(
    folder: Path,
    layers: Sequence[TextureLayer | TextureDecal] = (TextureLayer(0),),
    *,
    split: str = "all",
    device: str = "cpu",
) -> Iterator[TexturableImage]:
    """Yield the images of a recording whose targets have layers, in order; each is rendered once and then stored.

    Args:
        folder: Folder that `record_target_images` wrote; results are stored in its folder `.seen`.
        layers: Layers and decals of the targets.
        split: train, test or all.
        device: Device that renders.

    Raises:
        FormatError: The folder holds no recording of this version, or a stored file is broken.
        StoreError: The folder cannot be written to.
    """
    cache_folder = _cache_folder(folder, layers, split)
    rows, sensor = image_rows(folder, split), recorded_sensor(folder, split)
    missing_files = {row["file_name"] for row, _ in rows if not (cache_folder / f"{row['file_name']}.npz").is_file()}
    missing_views = recorded_views(folder, split=split, device=device, selected_keys=missing_files)
    for row, objects in rows:
        file = row["file_name"]
        if file in missing_files:
            safeio.make_folder(cache_folder)
            # The views come in the order of the rows, so the next one belongs to this row.
            safeio.save_npz(cache_folder / f"{file}.npz", _render_visible_part(next(missing_views), layers, device))
        cached = safeio.load_npz(cache_folder / f"{file}.npz")
        image = read_image(folder / "images" / file)
        yield TexturableImage(file, row, objects, image, sensor=sensor, **parse_part(cached))


def recorded_sensor(folder: Path, split: str = "all") -> SensorModel:
    """Return the sensor of a recording, with the effects of its lens.

    Raises:
        FormatError: The folder holds no recording of this version.
    """
    return with_lens_effects(SENSOR, recording_of(folder, split)["effects"])


def uncached_parts(folder: Path, variants: Sequence[Sequence[TextureLayer | TextureDecal]]) -> list[int]:
    """Return the parts of a recording that are not fully cached for each of several sets of layers.

    Raises:
        FormatError: The folder holds no recording of this version.
    """
    cache_folders = [_cache_folder(folder, layers, "all") for layers in variants]
    cached_names = [{path.name for path in cache_folder.glob("*.npz")} for cache_folder in cache_folders]
    missing_parts = (
        row["part"]
        for row, _ in image_rows(folder)
        if any(f"{row['file_name']}.npz" not in names for names in cached_names)
    )
    return list(dict.fromkeys(missing_parts))


def cache_texture_images(
    folder: Path, variants: Sequence[Sequence[TextureLayer | TextureDecal]], *, part: int, device: str = "cpu"
) -> None:
    """Render what a part of a recording shows of each of several sets of layers, for `texturable_images`.

    Args:
        folder: What `record_target_images` wrote.
        variants: What the targets wear, one set after the other.
        part: Whose pictures.
        device: Where to render.

    Raises:
        FormatError: No recording of this version.
        StoreError: Nothing can be written there.
    """
    cache_folders = [_cache_folder(folder, layers, "all") for layers in variants]
    for cache_folder in cache_folders:
        safeio.make_folder(cache_folder)
    file_names = {row["file_name"] for row, _ in image_rows(folder) if row["part"] == part}
    for recorded in recorded_views(folder, device=device, selected_keys=file_names):
        # All sets of layers in one pass: building the scene of a view costs more than rendering it.
        for cache_folder, layers in zip(cache_folders, variants, strict=True):
            if not (cache_folder / f"{recorded.file}.npz").is_file():
                safeio.save_npz(cache_folder / f"{recorded.file}.npz", _render_visible_part(recorded, layers, device))


def _cache_folder(folder: Path, layers: Sequence[TextureLayer | TextureDecal], split: str) -> Path:
    """Return the cache folder of a set of layers."""
    keys = [_layer_key(layer) for layer in layers]
    # The source is part of the key: another version may render other bits.
    return folder / KEPT / digest("textured clips", _drawing(), recording_of(folder, split), keys)[:16]


def visible_part(picture: Rendering, view: View, device: str = "cpu") -> dict[str, Any]:
    """Return arrays of the part of a rendered view around what shows textures, see `parse_part`.

    It is behind the lens, which scatters the light of the whole picture.
    """
    height, width = picture.radiance.shape[1:3]
    photosite_noise = view_noise(view)
    if photosite_noise is None:  # a sensor without noise
        photosite_noise = np.zeros((height, width), np.float32)
    part_fragments = picture.fragments.copy()
    scene_light = torch.from_numpy(picture.radiance[:1]).to(device)
    lens_sensor = with_lens_effects(view.sensor, picture.effects)
    background_light = scatter(scene_light, lens_sensor)
    fragment_places = torch.from_numpy(part_fragments["place"].astype(np.int64)).to(device)
    white_light = torch.from_numpy(np.ascontiguousarray(part_fragments["light"], np.float32)).to(device)
    texture_light = (
        torch.zeros_like(scene_light)
        .reshape(-1, 3)
        .index_add(0, fragment_places, white_light)
        .reshape(scene_light.shape)
    )
    exposure_factor = float(picture.exposure[0])
    # A white texture gives most light, and a dark background shows it best.
    visible_change = curve((background_light + scatter(texture_light, lens_sensor)) * exposure_factor) - curve(
        background_light * exposure_factor
    )
    is_changed = (visible_change[0].amax(-1) > VISIBLE).reshape(-1).index_fill(0, fragment_places, True)
    rows, columns = np.divmod(torch.nonzero(is_changed)[:, 0].cpu().numpy(), width)
    glow = tuple((int(axis.min()), int(axis.max()) + 1) if len(axis) else (0, 0) for axis in (rows, columns))
    (top, bottom), (left, right) = (_span(*pair) for pair in zip(glow, (height, width), strict=True))
    rows, columns = np.divmod(part_fragments["place"].astype(np.int64), width)
    part_fragments["place"] = (rows - top) * (right - left) + columns - left
    return {
        "corner": np.array([top, left]),
        "radiance": background_light[0, top:bottom, left:right].cpu().numpy(),
        "exposure": picture.exposure[0],
        "fragments": part_fragments,
        "glow": np.array(glow),
        "noise": photosite_noise[top:bottom, left:right],
    }


def parse_part(arrays: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a `TexturableImage` from the arrays of `visible_part`."""
    rows, columns = arrays["glow"].tolist()
    return {
        "corner": (int(arrays["corner"][0]), int(arrays["corner"][1])),
        "radiance": arrays["radiance"],
        "exposure": float(arrays["exposure"]),
        "fragments": arrays["fragments"],
        "glow": (tuple(rows), tuple(columns)),
        "noise": arrays["noise"],
    }


def _render_visible_part(
    view: RecordedView, layers: Sequence[TextureLayer | TextureDecal], device: str
) -> dict[str, Any]:
    dressed_view = view.with_layers(*layers)
    return visible_part(render(view.scene, [dressed_view], quality=view.quality), dressed_view, device)


def _span(span: tuple[int, int], limit: int) -> tuple[int, int]:
    """Where a part begins and ends that holds a span and its margin; a block if it is empty."""
    if span[0] == span[1]:
        return 0, min(BLOCK, limit)
    start = max(span[0] - MARGIN, 0) // BLOCK * BLOCK
    return start, min(span[1] + MARGIN, limit)


def _layer_key(layer: TextureLayer | TextureDecal) -> tuple[object, ...]:
    """Return all properties of a layer or decal that decide its contribution."""
    mask = None if layer.mask is None else (layer.mask.shape, hashlib.sha256(layer.mask.tobytes()).hexdigest())
    if isinstance(layer, TextureDecal):
        return layer.texture, layer.pose.tolist(), layer.size, layer.depth, layer.tag, layer.opacity, mask
    return layer.texture, layer.rectangle, layer.opacity, mask


@cache
def _drawing() -> str:
    """Return a hash of the source, which invalidates the caches of other versions."""
    source_root = Path(ssad.__file__).parent
    hasher = hashlib.sha256()
    for path in sorted(source_root.rglob("*.py")):
        hasher.update(path.relative_to(source_root).as_posix().encode() + path.read_bytes())
    return hasher.hexdigest()
