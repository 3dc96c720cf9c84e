"""Recorded pictures as functions of the texture that their target wears: rendered once, kept on disk.

What pixels see of a texture does not depend on it. So a picture is rendered once with layers on its target; from then
on it is shown with any texture in a few milliseconds, with gradients, also by a later process.
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
from ssad.recorders.target_images import ClipView, clip_rows, clip_views, recording_of
from ssad.rendering.camera.render import Picture, render
from ssad.rendering.camera.scene import Decal, Layer
from ssad.rendering.camera.sensor import SENSOR, Sensor
from ssad.rendering.camera.texture import Taps, joined, retexture, taps_of
from ssad.rendering.camera.torch_sensor import Rectangle, Window, large_draws

KEPT = ".seen"  # folder of a recording for what has been rendered
MARGIN = 48  # px around what a texture touches: more than lens, mosaic and JPEG read
BLOCK = 16  # px: parts begin at blocks of JPEG


@dataclass(frozen=True, slots=True)
class TexturedClip:
    """A recorded picture whose target wears textures.

    Attributes:
        file: Its name in the folder `images`.
        row: What the annotation file says of it.
        objects: What is annotated in it (see `ClipView`).
        image: As recorded, uint8 RGB [H, W, 3].
        corner: Row and column at which `radiance` begins in it.
        radiance: Of the part around what wears the textures, linear, textured pixels without them [h, w, 3].
        exposure: What radiance is multiplied by.
        fragments: What pixels of the part see of the textures (see `Picture.fragments`).
    """

    file: str
    row: Mapping[str, Any]
    objects: tuple[Mapping[str, Any], ...]
    image: U8
    corner: tuple[int, int]
    radiance: F32
    exposure: float
    fragments: Any

    def prepare(
        self,
        sizes: Mapping[int, int | tuple[int, int]],
        *,
        masks: Mapping[int, Bool] | None = None,
        quality: int | None = 92,
        sensor: Sensor = SENSOR,
        device: str | torch.device = "cpu",
    ) -> Wearing:
        """The picture, ready to be shown with textures of certain sizes.

        Args:
            sizes: Number of each texture -> its height and width, or one side, texels. All that the target wears.
            masks: Number of a texture -> which texels are on the surface (see `paint_mask`).
            quality: Of JPEG, as it was recorded; None: not compressed.
            sensor: The camera's.
            device: Where pictures are made.

        Raises:
            ConfigError: A texture that the target wears has no size, or bad sizes and masks.
        """
        worn = set(np.unique(self.fragments["texture"]).tolist())
        if not worn <= set(sizes):
            raise ConfigError(f"{self.file}: no size for texture {min(worn - set(sizes))}, which its target wears")
        masks = masks or {}
        (top, left), (height, width) = self.corner, self.image.shape[:2]
        part = (top, top + self.radiance.shape[0]), (left, left + self.radiance.shape[1])
        taps = {k: _moved(taps_of(self, size, texture=k, mask=masks.get(k)), part, width) for k, size in sizes.items()}
        touched = torch.cat([one.pixel for one in taps.values()])
        window = Window.around(touched, (1, height, width), sensor, quality=quality)
        radiance = _cut(torch.tensor(self.radiance), part, window.read[0])
        before = torch.tensor(self.image).to(device).permute(2, 0, 1)
        own = {k: one.to(device) for k, one in taps.items()}
        return Wearing(window, radiance.to(device), self.exposure, own, before)


@dataclass(frozen=True, slots=True)
class Wearing:
    """A picture that waits for textures.

    Attributes:
        window: What is developed anew.
        part: Radiance of what the window reads, without the textures [h, w, 3].
        exposure: What radiance is multiplied by.
        taps: What pixels of the picture see of each texture, by its number.
        before: The whole picture as it was recorded, uint8 [3, H, W].
    """

    window: Window
    part: Tensor
    exposure: float
    taps: Mapping[int, Taps]
    before: Tensor

    def show(self, textures: Mapping[int, Tensor], noise: torch.Generator | None = None) -> Tensor:
        """The picture with textures on its target, [1, 3, H, W].

        Args:
            textures: Number -> linear albedo [3, h, w] in 0 to 1.
            noise: See `together`.

        Raises:
            ConfigError: See `together`.
        """
        given = {number: texture[None] for number, texture in textures.items()}
        return Wearing.together([self], given, None if noise is None else [noise])

    @classmethod
    def together(
        cls,
        pictures: Sequence[Wearing],
        textures: Mapping[int, Tensor],
        noise: Sequence[torch.Generator] | None = None,
    ) -> Tensor:
        """Pictures with textures on their targets, in few operations however many there are.

        Args:
            pictures: Of one size, sensor and JPEG quality.
            textures: Number -> linear albedo in 0 to 1, one for each picture [B, 3, h, w].
            noise: Of each picture, draws the sensor's noise where it changes; None for none there.

        Returns:
            [B, 3, H, W] in [0, 1], differentiable in the textures.

        Raises:
            ConfigError: A texture of another size or beyond 0 to 1; one is missing.
        """
        radiance, window = cls.lit(pictures, textures)
        return cls.developed(pictures, radiance, window, noise)

    @staticmethod
    def lit(pictures: Sequence[Wearing], textures: Mapping[int, Tensor]) -> tuple[Tensor, Window]:
        """The first half of `together`: the radiance [B, h, w, 3] that a window of all pictures reads."""
        first, number = pictures[0].window, len(pictures)
        missing = sorted(set(pictures[0].taps) - set(textures))
        if missing:
            raise ConfigError(f"no texture {missing[0]}")
        window = first
        if number > 1:
            window = Window.of(
                [one.window.changed[0] for one in pictures],
                (number, *first.shape[1:]),
                first.sensor,
                quality=first.quality,
                subsampling=first.subsampling,
            )
        (rows, columns), (_, _, wide) = window.read[0], first.shape
        size = rows[1] - rows[0], columns[1] - columns[0]
        radiance = pictures[0].part.new_zeros((number, *size, 3))
        for own, one, read in zip(radiance, pictures, window.read, strict=True):
            there, here = _overlap(one.window.read[0], read)
            own[there] = one.part[here]
        corners = [(read[0][0], read[1][0]) for read in window.read]
        for layer in pictures[0].taps:
            taps = joined([one.taps[layer] for one in pictures], corners, wide, size)
            radiance = retexture(taps, textures[layer], radiance)
        return radiance, window

    @staticmethod
    def developed(
        pictures: Sequence[Wearing], radiance: Tensor, window: Window, noise: Sequence[torch.Generator] | None
    ) -> Tensor:
        """The second half of `together`: what lens, sensor and JPEG make of it, in the whole pictures."""
        sample = None
        if noise is not None:
            mosaic = window.sensor.mosaic
            sample = radiance.new_zeros(radiance.shape[: 3 if mosaic else 4])
            large = large_draws(noise, radiance.device)
            for own, one, read, draws in zip(sample, pictures, window.read, large, strict=True):
                there, here = _overlap(one.window.read[0], read)
                shape = one.part.shape[:2] if mosaic else one.part.shape
                own[there] = torch.randn(shape, generator=draws, device=draws.device)[here]
        exposure = torch.tensor([one.exposure for one in pictures]).to(radiance)
        before = torch.stack([one.before for one in pictures])
        return window.paste(window.develop(radiance, exposure, sample), before)


def _overlap(own: Rectangle, wanted: Rectangle) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """Where the pixels that two rectangles share lie in the wanted one, and in one's own."""
    shared = [(max(a[0], b[0]), min(a[1], b[1])) for a, b in zip(own, wanted, strict=True)]
    there, here = (
        tuple(slice(low - one[0], max(low, high) - one[0]) for (low, high), one in zip(shared, sides, strict=True))
        for sides in (wanted, own)
    )
    return there, here


def _cut(values: Tensor, own: Rectangle, wanted: Rectangle) -> Tensor:
    """What values [h, w, ...] of a rectangle are in another one; 0 outside of their own."""
    if own == wanted:
        return values
    there, here = _overlap(own, wanted)
    found = values.new_zeros((*(high - low for low, high in wanted), *values.shape[2:]))
    found[there] = values[here]
    return found


def _moved(taps: Taps, own: Rectangle, width: int) -> Taps:
    """Taps into a rectangle as taps into the whole picture, which is so wide."""
    (rows, columns), wide = own, own[1][1] - own[1][0]
    return replace(taps, pixel=(taps.pixel // wide + rows[0]) * width + taps.pixel % wide + columns[0])


def textured_clips(
    folder: Path, layers: Sequence[Layer | Decal] = (Layer(0),), *, split: str = "all", device: str = "cpu"
) -> Iterator[TexturedClip]:
    """The pictures of a recording whose targets wear layers, in order; each is rendered once and then kept.

    Args:
        folder: What `record_clips` wrote; what is rendered is kept in its folder `.seen`.
        layers: What the targets wear.
        split: train, test or all.
        device: Where to render.

    Raises:
        FormatError: No recording of this version, or a kept file is broken.
        StoreError: Nothing can be written there.
    """
    kept = _kept_in(folder, layers, split)
    rows = clip_rows(folder, split)
    missing = {row["file_name"] for row, _ in rows if not (kept / f"{row['file_name']}.npz").is_file()}
    views = clip_views(folder, split=split, device=device, only=missing)
    for row, objects in rows:
        file = row["file_name"]
        if file in missing:
            safeio.make_folder(kept)
            safeio.save_npz(kept / f"{file}.npz", _kept(next(views), layers))
        arrays = safeio.load_npz(kept / f"{file}.npz")
        image = read_image(folder / "images" / file)
        corner = int(arrays["corner"][0]), int(arrays["corner"][1])
        exposure = float(arrays["exposure"])
        yield TexturedClip(file, row, objects, image, corner, arrays["radiance"], exposure, arrays["fragments"])


def unseen_parts(folder: Path, variants: Sequence[Sequence[Layer | Decal]]) -> list[int]:
    """The parts of a recording of which not all is kept that is seen of each of several sets of layers.

    Raises:
        FormatError: No recording of this version.
    """
    kept = [_kept_in(folder, layers, "all") for layers in variants]
    there = [{path.name for path in one.glob("*.npz")} for one in kept]
    missing = (row["part"] for row, _ in clip_rows(folder) if any(f"{row['file_name']}.npz" not in k for k in there))
    return list(dict.fromkeys(missing))


def see_clips(folder: Path, variants: Sequence[Sequence[Layer | Decal]], *, part: int, device: str = "cpu") -> None:
    """Render what a part of a recording shows of each of several sets of layers, for `textured_clips`.

    Args:
        folder: What `record_clips` wrote.
        variants: What the targets wear, one set after the other.
        part: Whose pictures.
        device: Where to render.

    Raises:
        FormatError: No recording of this version.
        StoreError: Nothing can be written there.
    """
    kept = [_kept_in(folder, layers, "all") for layers in variants]
    for one in kept:
        safeio.make_folder(one)
    wanted = {row["file_name"] for row, _ in clip_rows(folder) if row["part"] == part}
    for clip in clip_views(folder, device=device, only=wanted):
        for one, layers in zip(kept, variants, strict=True):
            if not (one / f"{clip.file}.npz").is_file():
                safeio.save_npz(one / f"{clip.file}.npz", _kept(clip, layers))


def _kept_in(folder: Path, layers: Sequence[Layer | Decal], split: str) -> Path:
    """Where what is seen of layers is kept."""
    keys = [_layer_key(layer) for layer in layers]
    return folder / KEPT / digest("textured clips", _drawing(), recording_of(folder, split), keys)[:16]


def seen_part(picture: Picture) -> dict[str, Any]:
    """What is kept of one rendered picture: the part around what shows textures."""
    height, width = picture.radiance.shape[1:3]
    rows, columns = np.divmod(picture.fragments["place"].astype(np.int64), width)
    (top, bottom), (left, right) = _span(rows, height), _span(columns, width)
    fragments = picture.fragments.copy()
    fragments["place"] = (rows - top) * (right - left) + columns - left
    return {
        "corner": np.array([top, left]),
        "radiance": picture.radiance[0, top:bottom, left:right],
        "exposure": picture.exposure[0],
        "fragments": fragments,
    }


def _kept(clip: ClipView, layers: Sequence[Layer | Decal]) -> dict[str, Any]:
    return seen_part(render(clip.scene, [clip.wearing(*layers)]))


def _span(places: Any, most: int) -> tuple[int, int]:
    """Where a part begins and ends that holds all places and their margin; a block if there are none."""
    if not len(places):
        return 0, min(BLOCK, most)
    low = max(int(places.min()) - MARGIN, 0) // BLOCK * BLOCK
    return low, min(int(places.max()) + MARGIN + 1, most)


def _layer_key(layer: Layer | Decal) -> tuple[object, ...]:
    """All that decides what of a layer or decal is seen."""
    mask = None if layer.mask is None else (layer.mask.shape, hashlib.sha256(layer.mask.tobytes()).hexdigest())
    if isinstance(layer, Decal):
        return layer.texture, layer.pose.tolist(), layer.size, layer.depth, layer.tag, layer.opacity, mask
    return layer.texture, layer.rectangle, layer.opacity, mask


@cache
def _drawing() -> str:
    """A hash of the source: what another version rendered is not used."""
    root = Path(ssad.__file__).parent
    whole = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        whole.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    return whole.hexdigest()
