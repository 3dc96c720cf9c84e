"""Images and truth for training: kept decoded in memory, augmented at random on the device."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, affine_grid, conv2d, grid_sample, pad

from ssad.core.detections import Solids, Truth
from ssad.core.errors import ConfigError
from ssad.core.types import F64, U8
from ssad.training.recipe import Recipe

GREY = 0.447
HALVING_ZOOM = 0.7  # zoom below which images are halved first
MEMORY_SHARE = 0.6  # share of the free memory for images


@dataclass(frozen=True, slots=True)
class TrainingImage:
    """One image: a function that reads it (uint8 RGB [H, W, 3]), and its truth."""

    read: Callable[[], U8]
    truth: Truth


@dataclass(frozen=True, slots=True)
class ImagesOnDisk:
    """Images that are read on access: uint8 [n, H, W, 3] for indices [n] or a slice."""

    items: Sequence[TrainingImage]
    shape: tuple[int, ...]

    @property
    def device(self) -> torch.device:
        """Device of the images: the CPU."""
        return torch.device("cpu")

    def __getitem__(self, rows: Tensor | slice) -> Tensor:
        indices = range(len(self.items))[rows] if isinstance(rows, slice) else rows.tolist()
        with ThreadPoolExecutor(8) as pool:
            return torch.stack(list(pool.map(lambda index: _read(self.items, index, self.shape), indices)))


@dataclass(frozen=True, slots=True)
class ImageSet:
    """All images of a set, uint8 [N, H, W, 3], and their truth (on the CPU)."""

    pictures: Tensor | ImagesOnDisk
    truth: tuple[Truth, ...]

    def __len__(self) -> int:
        return len(self.truth)


def load_images(items: Sequence[TrainingImage], *, device: str = "cpu", threads: int | None = None) -> ImageSet:
    """Read all images, in parallel, into the fastest memory that has room for them.

    That is the device, else the host; if neither has room, images stay on disk and are read on access.

    Args:
        items: The images; at least one.
        device: Preferred device.
        threads: Reading threads; None: a quarter of the cores, at least 8.

    Returns:
        The images and their truth.

    Raises:
        ConfigError: There is no image, or the images differ in size.
    """
    if not items:
        raise ConfigError("no picture to train on")
    shape = items[0].read().shape
    truth = tuple(item.truth for item in items)
    required_bytes = len(items) * math.prod(shape)
    device = next(
        (candidate for candidate in (device, "cpu") if required_bytes < MEMORY_SHARE * free_memory(candidate)), ""
    )
    if not device:
        return ImageSet(ImagesOnDisk(items, shape), truth)
    images = torch.empty((len(items), *shape), dtype=torch.uint8, device=device)

    def load(first_index: int) -> None:
        block = [_read(items, index, shape) for index in range(first_index, min(first_index + 32, len(items)))]
        images[first_index : first_index + len(block)] = torch.stack(block).to(device)

    with ThreadPoolExecutor(threads or max(8, (os.cpu_count() or 8) // 4)) as pool:
        list(pool.map(load, range(0, len(items), 32)))
    return ImageSet(images, truth)


def _read(items: Sequence[TrainingImage], image_count: int, shape: tuple[int, ...]) -> Tensor:
    image = items[image_count].read()
    if image.shape != shape:
        raise ConfigError(f"picture {image_count} has the size {image.shape[:2]}, the first {shape[:2]}")
    return torch.from_numpy(np.ascontiguousarray(image))


def free_memory(device: str) -> float:
    """Return the free bytes of a device; infinite if unknown."""
    if torch.device(device).type == "cuda":
        return float(torch.cuda.mem_get_info(torch.device(device))[0])
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        return 1024.0 * float(next(line for line in lines if line.startswith("MemAvailable")).split()[1])
    except (OSError, StopIteration, ValueError):
        return math.inf


def repetition_counts(truths: Sequence[Truth], min_share: float) -> F64 | None:
    """Return the number of repetitions of each image in an epoch, so that rare classes are seen.

    An image is shown at least once; it is shown sqrt(min_share / share) times if it shows a class whose share of the
    images is below `min_share`.

    Args:
        truths: The truth of each picture [n]; crowd objects do not count.
        min_share: Share of the pictures below which a class counts as rare; 0 or less: each picture is shown once.

    Returns:
        Times, not rounded [n]; None: all once.

    Source: Gupta, Dollár and Girshick, LVIS: A Dataset for Large Vocabulary Instance Segmentation (CVPR 2019).
    """
    if min_share <= 0:
        return None
    labels_by_image = [
        torch.unique(image_truth.label if image_truth.crowd is None else image_truth.label[~image_truth.crowd]).tolist()
        for image_truth in truths
    ]
    image_counts = Counter(label for labels in labels_by_image for label in labels)
    factors = {label: max(1.0, math.sqrt(min_share * len(truths) / count)) for label, count in image_counts.items()}
    return np.array([max((factors[label] for label in labels), default=1.0) for labels in labels_by_image])


def order(count: int, batch: int, *, seed: int, epoch: int, weights: F64 | None = None) -> list[list[int]]:
    """Random batches of an epoch.

    Args:
        count: Number of pictures.
        batch: Pictures in a batch; a short last batch is dropped unless it is the only one.
        seed: Seed of the training.
        epoch: Number of the epoch.
        weights: How often each picture is shown [count] (see `repeats`). Fractions are drawn at random such that every
            epoch has the same number of batches.

    Returns:
        Indices of each batch.
    """
    random = np.random.default_rng([seed, epoch])
    shuffled = random.permutation(count)
    if weights is not None:
        cumulative = np.cumsum(weights[shuffled])
        image_count = math.ceil(cumulative[-1] - 1e-9)
        # Systematic sampling: frequencies are met within one, and the total is exact.
        positions = (np.arange(image_count) + random.random()) * (cumulative[-1] / image_count)
        shuffled = random.permutation(
            shuffled[np.searchsorted(cumulative, positions, side="right").clip(max=count - 1)]
        )
    batch_count = max(len(shuffled) // batch, 1)
    return [shuffled[batch_index * batch : (batch_index + 1) * batch].tolist() for batch_index in range(batch_count)]


def _send(value: Tensor, device: torch.device | str) -> Tensor:
    """Copy a small tensor to a device without waiting for earlier GPU work."""
    return value.to(device, non_blocking=True)


def move(truths: Iterable[Truth], device: torch.device | str) -> list[Truth]:
    """Move truth to a device, in one transfer per kind of value."""
    truths = list(truths)
    counts = [len(image_truth.label) for image_truth in truths]

    def transferred(values: list[Tensor | None]) -> list[Tensor | None]:
        if any(value is None for value in values):
            return [None if value is None else _send(value, device) for value in values]
        present_values = [value for value in values if value is not None]
        return list(torch.split(_send(torch.cat(present_values), device), counts))

    columns = {
        name: transferred([getattr(image_truth, name) for image_truth in truths]) for name in ("label", "box", "crowd")
    }
    intrinsics = [image_truth.intrinsic for image_truth in truths]
    if intrinsics and all(index is not None for index in intrinsics):
        stacked = _send(torch.stack([index for index in intrinsics if index is not None]), device)
        columns["intrinsic"] = list(stacked.unbind())
    else:
        columns["intrinsic"] = [None] * len(truths)
    solids: list[Solids | None] = [None] * len(truths)
    if truths and all(image_truth.solid is not None for image_truth in truths):
        solid_columns = {
            column.name: transferred([getattr(image_truth.solid, column.name) for image_truth in truths])
            for column in fields(Solids)
        }
        solids = [
            Solids(**{name: values[index] for name, values in solid_columns.items()})  # type: ignore[arg-type]
            for index in range(len(truths))
        ]
    return [
        Truth(solid=solids[index], **{name: values[index] for name, values in columns.items()})  # type: ignore[arg-type]
        for index in range(len(truths))
    ]


@dataclass(frozen=True, slots=True)
class Augmentation:
    """Geometric augmentation of one image: mirrored, then scaled by `zoom` and moved by `shift` (x, y) pixels."""

    mirror: bool
    zoom: float
    shift: tuple[float, float]


def draw_augmentation(
    recipe: Recipe, size: tuple[int, int], rng: np.random.Generator, *, lens: Tensor | None = None
) -> Augmentation:
    """A random change of a picture of `size` (height, width).

    With an intrinsic `lens` [3, 3] the zoom is about the principal point, as a lens zooms: where the ground meets an
    object keeps telling its distance; then all moves up or down by at most `recipe.rise` rows, as on a shifted sensor.
    Without one the crop lies anywhere.
    """
    zoom = float(np.exp(rng.uniform(np.log(recipe.zoom[0]), np.log(recipe.zoom[1]))))
    free_range = [length * (1.0 - zoom) for length in (size[1], size[0])]
    mirror = bool(rng.random() < recipe.flip)
    crop_position = [rng.random(), rng.random()]
    row_shift = float(rng.uniform(-recipe.rise, recipe.rise)) if recipe.rise else 0.0
    if lens is not None:
        crop_position = [float(lens[0, 2]) / size[1], float(lens[1, 2]) / size[0]]
        crop_position[0] = 1.0 - crop_position[0] if mirror else crop_position[0]
    return Augmentation(mirror, zoom, (crop_position[0] * free_range[0], crop_position[1] * free_range[1] + row_shift))


def augment_truths(
    truths: Sequence[Truth], changes: Sequence[Augmentation], size: tuple[int, int], *, min_visible_share: float
) -> list[Truth]:
    """Return the truth of augmented images.

    In 2D, an object whose visible share falls below `min_visible_share` becomes crowd, and is removed once it is
    invisible. In 3D, an object is removed when its centre leaves the image.

    Args:
        truths: Truth before the augmentation, all with or all without 3D boxes.
        changes: Augmentation of each image.
        size: Height and width, the same for all images.
        min_visible_share: Minimum visible share of an object that counts, in 2D.

    Returns:
        Truth after the augmentation.
    """
    height, width = size
    object_counts = torch.tensor([len(image_truth.label) for image_truth in truths])
    image_index = torch.repeat_interleave(torch.arange(len(truths)), object_counts)
    mirror = torch.tensor([change.mirror for change in changes])
    zoom = torch.tensor([change.zoom for change in changes], dtype=torch.float64)
    shift = torch.tensor([change.shift for change in changes], dtype=torch.float64)
    box = torch.cat([image_truth.box for image_truth in truths])
    mirrored_box = torch.stack([width - box[:, 2], box[:, 1], width - box[:, 0], box[:, 3]], -1)
    box = torch.where(mirror[image_index][:, None], mirrored_box, box) * zoom.to(box)[image_index][:, None]
    box = box + shift.to(box).repeat(1, 2)[image_index]
    image_limit = box.new_tensor([width, height, width, height])
    clipped = box.clamp_min(0.0).minimum(image_limit)
    area = (box[:, 2:] - box[:, :2]).prod(-1).clamp_min(1e-6)
    # A zoom changes both areas alike, so the share measures clipping only.
    visible_share = (clipped[:, 2:] - clipped[:, :2]).prod(-1) / area
    intrinsics = _augment_intrinsics([image_truth.intrinsic for image_truth in truths], mirror, zoom, shift, width)
    solid = (
        None
        if truths[0].solid is None or intrinsics is None
        else _mirror_solids([image_truth.solid for image_truth in truths], mirror[image_index])
    )
    is_crowd = torch.cat(
        [
            torch.zeros(len(image_truth.box), dtype=torch.bool) if image_truth.crowd is None else image_truth.crowd
            for image_truth in truths
        ]
    )
    if solid is not None and intrinsics is not None:
        projected = (intrinsics[image_index] @ solid.centre[..., None])[..., 0]
        centre = projected[:, :2] / projected[:, 2:].clamp_min(1e-3)
        is_kept = (centre >= 0).all(-1) & (centre[:, 0] < width) & (centre[:, 1] < height)
        is_kept &= (solid.centre[:, 2] > 0) & (visible_share > 0)
    else:
        is_crowd |= visible_share < min_visible_share
        is_kept = visible_share > 0.02
    kept_counts = torch.bincount(image_index[is_kept], minlength=len(truths)).tolist()

    def split_kept(values: Tensor) -> tuple[Tensor, ...]:
        return torch.split(values[is_kept], kept_counts)

    labels, boxes, crowds = (
        split_kept(torch.cat([image_truth.label for image_truth in truths])),
        split_kept(clipped),
        split_kept(is_crowd),
    )
    solids: list[Solids | None] = [None] * len(truths)
    if solid is not None:
        solid_columns = {column.name: split_kept(getattr(solid, column.name)) for column in fields(Solids)}
        solids = [
            Solids(**{name: values[index] for name, values in solid_columns.items()}) for index in range(len(truths))
        ]
    return [
        Truth(
            labels[index],
            boxes[index],
            solids[index],
            None if intrinsics is None else intrinsics[index],
            crowd=None if solid is not None and truths[index].crowd is None else crowds[index],
        )
        for index in range(len(truths))
    ]


def _augment_intrinsics(
    lenses: Sequence[Tensor | None], mirror: Tensor, zoom: Tensor, shift: Tensor, width: int
) -> Tensor | None:
    """Intrinsics [B, 3, 3] of the changed pictures; None where there are none."""
    present_lenses = [matrix for matrix in lenses if matrix is not None]
    if len(present_lenses) < len(lenses):
        return None
    intrinsics = torch.stack(present_lenses)
    intrinsics[:, 0, 2] = torch.where(mirror, width - intrinsics[:, 0, 2], intrinsics[:, 0, 2])
    intrinsics[:, :2, :2] *= zoom.to(intrinsics)[:, None, None]
    intrinsics[:, :2, 2] = zoom.to(intrinsics)[:, None] * intrinsics[:, :2, 2] + shift.to(intrinsics)
    return intrinsics


def _mirror_solids(solids: Sequence[Solids | None], mirror: Tensor) -> Solids:
    """Return all solids in one table, those of mirrored images mirrored."""
    present_solids = [solid for solid in solids if solid is not None]
    table = Solids.cat(present_solids)
    sign = torch.where(mirror, -1.0, 1.0).to(table.centre)[:, None]
    ones = torch.ones_like(sign)
    return replace(
        table,
        centre=table.centre * torch.cat([sign, ones, ones], 1),
        velocity=table.velocity * torch.cat([sign, ones], 1),
        yaw=torch.where(mirror, torch.pi - table.yaw, table.yaw),
    )


def augment_images(images: Tensor, changes: Sequence[Augmentation]) -> Tensor:
    """Return images, float [B, 3, H, W], after their augmentation; grey where there is nothing.

    Below a zoom of `HALVING_ZOOM` samples are taken from the image averaged to half its size: at full size they would
    skip pixels, which no camera does.
    """
    if all(not change.mirror and change.zoom == 1.0 for change in changes):
        return images
    height, width = images.shape[2:]
    matrices = []
    for change in changes:
        sign = -1.0 if change.mirror else 1.0
        x = sign * (1 / change.zoom - 2 * change.shift[0] / (change.zoom * width) - 1)
        y = 1 / change.zoom - 2 * change.shift[1] / (change.zoom * height) - 1
        matrices.append([[sign / change.zoom, 0.0, x], [0.0, 1 / change.zoom, y]])
    transforms = _send(torch.tensor(matrices, dtype=images.dtype), images.device)
    grid = affine_grid(transforms, list(images.shape), align_corners=False)
    # grid_sample pads with zeros, so grey must be zero.
    offsets = images - GREY
    augmented = torch.empty_like(offsets)
    half_size = (max(height // 2, 1), max(width // 2, 1))
    for is_small in (False, True):
        member_indices = [index for index, change in enumerate(changes) if (change.zoom < HALVING_ZOOM) == is_small]
        if member_indices:
            selected = _send(torch.tensor(member_indices), images.device)
            source = adaptive_avg_pool2d(offsets[selected], half_size) if is_small else offsets[selected]
            augmented[selected] = grid_sample(source, grid[selected], align_corners=False)
    return augmented + GREY


def augment_colours(images: Tensor, recipe: Recipe, rng: torch.Generator) -> Tensor:
    """Brightness, contrast, saturation and gamma of each picture moved at random; noise added; in [0, 1]."""
    if recipe.jitter <= 0 and recipe.noise <= 0:
        return images
    device = images.device

    def random_factor(spread: float) -> Tensor:
        value = torch.rand((len(images), 1, 1, 1), generator=rng)
        return _send(1.0 + spread * (2 * value - 1), device)

    luminance = images.mean(1, keepdim=True)
    images = luminance + (images - luminance) * random_factor(1.5 * recipe.jitter)
    mean_value = images.mean((1, 2, 3), keepdim=True)
    images = (mean_value + (images - mean_value) * random_factor(recipe.jitter)) * random_factor(recipe.jitter)
    tint = 1.0 + recipe.jitter * 0.15 * (torch.rand((len(images), 3, 1, 1), generator=rng) * 2 - 1)
    images = images * _send(tint, device)
    images = images.clamp(1e-4, 1.0) ** random_factor(recipe.jitter)
    if recipe.noise > 0:
        noise_level = _send(torch.rand((len(images), 1, 1, 1), generator=rng), device) ** 2 * recipe.noise
        # Noise is drawn on the device; its seed comes from the key of the batch.
        noise_generator = torch.Generator(device).manual_seed(int(torch.randint(2**62, (), generator=rng)))
        images = images + torch.randn(images.shape, generator=noise_generator, device=device) * noise_level
    return images.clamp(0.0, 1.0)


def blur_images(images: Tensor, max_deviation: float, rng: torch.Generator) -> Tensor:
    """Return images, float [B, 3, H, W], of which half are blurred by a Gaussian of a random width.

    Args:
        images: In [0, 1].
        max_deviation: Largest standard deviation, px.
        rng: Random numbers, on the CPU.
    """
    is_blurred = torch.rand(len(images), generator=rng) < 0.5
    deviation = (torch.rand(len(images), generator=rng) * max_deviation).clamp_min(1e-3)
    radius = max(math.ceil(2.5 * max_deviation), 1)
    offsets = torch.arange(-radius, radius + 1, dtype=images.dtype)
    weights = torch.exp(-0.5 * (offsets / deviation[:, None]) ** 2)
    weights = torch.where(is_blurred[:, None], weights, (offsets == 0).to(images.dtype))
    weights = _send((weights / weights.sum(1, keepdim=True)).repeat_interleave(3, 0), images.device)
    batch_size, _, height, width = images.shape
    # A group for each channel of each image, as every image has a filter of its own.
    channels = pad(images, (radius,) * 4, mode="replicate").reshape(
        1, 3 * batch_size, *(2 * radius + length for length in (height, width))
    )
    blurred = conv2d(channels, weights[:, None, :, None], groups=3 * batch_size)
    blurred = conv2d(blurred, weights[:, None, None, :], groups=3 * batch_size)
    return blurred.reshape(images.shape)


def natural_texture(shape: tuple[int, ...], generator: torch.Generator, device: torch.device) -> Tensor:
    """Return random texture [..., H, W] with mean 0 and standard deviation 1 whose amplitude falls with 1 / frequency.

    Source: Field, Relations between the statistics of natural images and the response properties of cortical cells
    (JOSA A 4, 1987).
    """
    height, width = shape[-2:]
    rows = torch.fft.fftfreq(height, device=device)[:, None]
    columns = torch.fft.rfftfreq(width, device=device)[None, :]
    frequency = (rows**2 + columns**2).sqrt()
    frequency[0, 0] = math.inf
    spectrum = torch.fft.rfft2(torch.randn(shape, generator=generator, device=device)) / frequency
    texture: Tensor = torch.fft.irfft2(spectrum, s=(height, width))
    return texture / texture.std((-2, -1), keepdim=True).clamp_min(1e-9)


def add_clutter(images: Tensor, max_contrast: float, rng: torch.Generator) -> Tensor:
    """Return images, float [B, 3, H, W], with random texture of a random contrast over parts of them, in [0, 1].

    Args:
        images: In [0, 1].
        max_contrast: Largest standard deviation of the texture.
        rng: Random numbers, on the CPU.
    """
    device = images.device
    batch_size, _, height, width = images.shape
    contrast = _send(torch.rand((batch_size, 1, 1, 1), generator=rng) ** 2 * max_contrast, device)
    generator = torch.Generator(device).manual_seed(int(torch.randint(2**62, (), generator=rng)))
    textures = natural_texture((batch_size, 5, height, width), generator, device)
    brightness, colour, region = textures[:, :1], textures[:, 1:4], textures[:, 4:]
    share = torch.sigmoid(4.0 * region)
    return (images + contrast * share * (brightness + 0.3 * colour)).clamp(0.0, 1.0)


def make_batch(
    image_set: ImageSet, indices: Sequence[int], recipe: Recipe, *, key: tuple[int, ...], device: torch.device
) -> tuple[Tensor, list[Truth]]:
    """Return images float [B, 3, H, W] and their truth on the device, augmented at random by the key."""
    random = np.random.default_rng(key)
    torch_random = torch.Generator().manual_seed(int(random.integers(2**62)))
    selected = _send(torch.tensor(indices), image_set.pictures.device)
    images = image_set.pictures[selected].to(device, non_blocking=True).permute(0, 3, 1, 2).float() / 255
    size = (images.shape[2], images.shape[3])
    changes = [draw_augmentation(recipe, size, random, lens=image_set.truth[index].intrinsic) for index in indices]
    truths = augment_truths([image_set.truth[index] for index in indices], changes, size, min_visible_share=recipe.keep)
    images = augment_images(images, changes)
    if recipe.clutter > 0:
        images = add_clutter(images, recipe.clutter, torch_random)
    if recipe.blur > 0:
        images = blur_images(images, recipe.blur, torch_random)
    if recipe.grey > 0:
        has_colour = torch.rand((len(images), 1, 1, 1), generator=torch_random) >= recipe.grey
        images = torch.where(_send(has_colour, device), images, images.mean(1, keepdim=True))
    return augment_colours(images, recipe, torch_random), move(truths, device)
