"""Pictures and truth for training: held decoded in memory, changed at random on the device."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, affine_grid, grid_sample

from ssad.core.detections import Solids, Truth
from ssad.core.errors import ConfigError
from ssad.core.types import F64, U8
from ssad.training.recipe import Recipe

GREY = 0.447
SHRUNK = 0.7  # zoom below which pictures are halved first
ROOM = 0.6  # share of the free memory that pictures may take


@dataclass(frozen=True, slots=True)
class Item:
    """One picture: how to read it (uint8 RGB [H, W, 3]), and what is in it."""

    read: Callable[[], U8]
    truth: Truth


@dataclass(frozen=True, slots=True)
class OnDisk:
    """Pictures that are read when they are asked for: uint8 [n, H, W, 3] for indices [n] or a slice."""

    items: Sequence[Item]
    shape: tuple[int, ...]

    @property
    def device(self) -> torch.device:
        """Where they come out."""
        return torch.device("cpu")

    def __getitem__(self, rows: Tensor | slice) -> Tensor:
        numbers = range(len(self.items))[rows] if isinstance(rows, slice) else rows.tolist()
        with ThreadPoolExecutor(8) as pool:
            return torch.stack(list(pool.map(lambda k: _read(self.items, k, self.shape), numbers)))


@dataclass(frozen=True, slots=True)
class PictureSet:
    """All pictures of a set, uint8 [N, H, W, 3], and their truth (on the CPU)."""

    pictures: Tensor | OnDisk
    truth: tuple[Truth, ...]

    def __len__(self) -> int:
        return len(self.truth)


def fill(items: Sequence[Item], *, device: str = "cpu", threads: int | None = None) -> PictureSet:
    """Read all pictures, in parallel, into the fastest memory that has room for them.

    That is the device, else the host; if neither has room, they stay on disk and are read when they are needed.

    Args:
        items: The pictures; at least one.
        device: Where they should be.
        threads: Threads that read; None: a quarter of the cores, at least 8.

    Returns:
        The pictures and their truth.

    Raises:
        ConfigError: There is no picture, or the pictures differ in size.
    """
    if not items:
        raise ConfigError("no picture to train on")
    shape = items[0].read().shape
    truth = tuple(item.truth for item in items)
    needed = len(items) * math.prod(shape)
    device = next((d for d in (device, "cpu") if needed < ROOM * free_memory(d)), "")
    if not device:
        return PictureSet(OnDisk(items, shape), truth)
    pictures = torch.empty((len(items), *shape), dtype=torch.uint8, device=device)

    def load(start: int) -> None:
        block = [_read(items, k, shape) for k in range(start, min(start + 32, len(items)))]
        pictures[start : start + len(block)] = torch.stack(block).to(device)

    with ThreadPoolExecutor(threads or max(8, (os.cpu_count() or 8) // 4)) as pool:
        list(pool.map(load, range(0, len(items), 32)))
    return PictureSet(pictures, truth)


def _read(items: Sequence[Item], number: int, shape: tuple[int, ...]) -> Tensor:
    picture = items[number].read()
    if picture.shape != shape:
        raise ConfigError(f"picture {number} has the size {picture.shape[:2]}, the first {shape[:2]}")
    return torch.from_numpy(np.ascontiguousarray(picture))


def free_memory(device: str) -> float:
    """Bytes that are free on a device; infinite where that cannot be told."""
    if torch.device(device).type == "cuda":
        return float(torch.cuda.mem_get_info(torch.device(device))[0])
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        return 1024.0 * float(next(line for line in lines if line.startswith("MemAvailable")).split()[1])
    except (OSError, StopIteration, ValueError):
        return math.inf


def repeats(truths: Sequence[Truth], least: float) -> F64 | None:
    """How often to show each picture in an epoch, so that rare classes are seen.

    A picture is shown at least once; it is shown sqrt(least / share) times if it shows a class whose share of the
    pictures is below `least`.

    Args:
        truths: The truth of each picture [n]; crowd objects do not count.
        least: Share of the pictures below which a class counts as rare; 0 or less: each picture is shown once.

    Returns:
        Times, not rounded [n]; None: all once.

    Source: Gupta, Dollár and Girshick, LVIS: A Dataset for Large Vocabulary Instance Segmentation (CVPR 2019).
    """
    if least <= 0:
        return None
    kinds = [torch.unique(t.label if t.crowd is None else t.label[~t.crowd]).tolist() for t in truths]
    share = Counter(kind for one in kinds for kind in one)
    factor = {kind: max(1.0, math.sqrt(least * len(truths) / count)) for kind, count in share.items()}
    return np.array([max((factor[kind] for kind in one), default=1.0) for one in kinds])


def order(count: int, batch: int, *, seed: int, epoch: int, often: F64 | None = None) -> list[list[int]]:
    """Random batches of an epoch.

    Args:
        count: Number of pictures.
        batch: Pictures in a batch; a short last batch is dropped unless it is the only one.
        seed: Seed of the training.
        epoch: Number of the epoch.
        often: How often each picture is shown [count] (see `repeats`). Fractions are drawn at random such that every
            epoch has the same number of batches.

    Returns:
        Indices of each batch.
    """
    rng = np.random.default_rng([seed, epoch])
    shuffled = rng.permutation(count)
    if often is not None:
        ends = np.cumsum(often[shuffled])
        shown = math.ceil(ends[-1] - 1e-9)
        places = (np.arange(shown) + rng.random()) * (ends[-1] / shown)
        shuffled = rng.permutation(shuffled[np.searchsorted(ends, places, side="right").clip(max=count - 1)])
    full = max(len(shuffled) // batch, 1)
    return [shuffled[k * batch : (k + 1) * batch].tolist() for k in range(full)]


def _send(value: Tensor, device: torch.device | str) -> Tensor:
    """Copy a small tensor to a device without waiting for what a GPU was given before."""
    return value.to(device, non_blocking=True)


def move(truths: Iterable[Truth], device: torch.device | str) -> list[Truth]:
    """Truth on a device, in one transfer for each kind of value."""
    truths = list(truths)
    counts = [len(t.label) for t in truths]

    def together(values: list[Tensor | None]) -> list[Tensor | None]:
        if any(v is None for v in values):
            return [None if v is None else _send(v, device) for v in values]
        given = [v for v in values if v is not None]
        return list(torch.split(_send(torch.cat(given), device), counts))

    columns = {name: together([getattr(t, name) for t in truths]) for name in ("label", "box", "crowd")}
    lens = [t.intrinsic for t in truths]
    if lens and all(k is not None for k in lens):
        stacked = _send(torch.stack([k for k in lens if k is not None]), device)
        columns["intrinsic"] = list(stacked.unbind())
    else:
        columns["intrinsic"] = [None] * len(truths)
    solids: list[Solids | None] = [None] * len(truths)
    if truths and all(t.solid is not None for t in truths):
        parts = {f.name: together([getattr(t.solid, f.name) for t in truths]) for f in fields(Solids)}
        solids = [Solids(**{name: values[k] for name, values in parts.items()}) for k in range(len(truths))]  # type: ignore[arg-type]
    return [
        Truth(solid=solids[k], **{name: values[k] for name, values in columns.items()})  # type: ignore[arg-type]
        for k in range(len(truths))
    ]


@dataclass(frozen=True, slots=True)
class Change:
    """What happens to one picture: mirrored, then scaled by `zoom` and moved by `shift` (x, y) pixels."""

    mirror: bool
    zoom: float
    shift: tuple[float, float]


def draw_change(
    recipe: Recipe, size: tuple[int, int], rng: np.random.Generator, *, lens: Tensor | None = None
) -> Change:
    """A random change of a picture of `size` (height, width).

    With an intrinsic `lens` [3, 3] the zoom is about the principal point, as a lens zooms: where the ground meets an
    object keeps telling its distance; then all moves up or down by at most `recipe.rise` rows, as on a shifted sensor.
    Without one the crop lies anywhere.
    """
    zoom = float(np.exp(rng.uniform(np.log(recipe.zoom[0]), np.log(recipe.zoom[1]))))
    free = [length * (1.0 - zoom) for length in (size[1], size[0])]
    mirror = bool(rng.random() < recipe.flip)
    share = [rng.random(), rng.random()]
    rise = float(rng.uniform(-recipe.rise, recipe.rise)) if recipe.rise else 0.0
    if lens is not None:
        share = [float(lens[0, 2]) / size[1], float(lens[1, 2]) / size[0]]
        share[0] = 1.0 - share[0] if mirror else share[0]
    return Change(mirror, zoom, (share[0] * free[0], share[1] * free[1] + rise))


def change_truths(
    truths: Sequence[Truth], changes: Sequence[Change], size: tuple[int, int], *, keep: float
) -> list[Truth]:
    """Truth of changed pictures.

    In 2D, an object whose visible share falls below `keep` becomes crowd, and is removed once it is out of sight. In
    3D, an object is removed when its middle leaves the picture.

    Args:
        truths: Truth before the change, all with or all without 3D boxes.
        changes: What happened to each picture.
        size: Height and width, the same for all pictures.
        keep: Least visible share of an object that counts, in 2D.

    Returns:
        Truth after the change.
    """
    height, width = size
    counts = torch.tensor([len(t.label) for t in truths])
    image = torch.repeat_interleave(torch.arange(len(truths)), counts)
    mirror = torch.tensor([c.mirror for c in changes])
    zoom = torch.tensor([c.zoom for c in changes], dtype=torch.float64)
    shift = torch.tensor([c.shift for c in changes], dtype=torch.float64)
    box = torch.cat([t.box for t in truths])
    turned = torch.stack([width - box[:, 2], box[:, 1], width - box[:, 0], box[:, 3]], -1)
    box = torch.where(mirror[image][:, None], turned, box) * zoom.to(box)[image][:, None]
    box = box + shift.to(box).repeat(1, 2)[image]
    limit = box.new_tensor([width, height, width, height])
    cut = box.clamp_min(0.0).minimum(limit)
    area = (box[:, 2:] - box[:, :2]).prod(-1).clamp_min(1e-6)
    share = (cut[:, 2:] - cut[:, :2]).prod(-1) / area
    lens = _changed_lens([t.intrinsic for t in truths], mirror, zoom, shift, width)
    solid = None if truths[0].solid is None or lens is None else _mirrored([t.solid for t in truths], mirror[image])
    crowd = torch.cat([torch.zeros(len(t.box), dtype=torch.bool) if t.crowd is None else t.crowd for t in truths])
    if solid is not None and lens is not None:
        flat = (lens[image] @ solid.centre[..., None])[..., 0]
        middle = flat[:, :2] / flat[:, 2:].clamp_min(1e-3)
        stays = (middle >= 0).all(-1) & (middle[:, 0] < width) & (middle[:, 1] < height)
        stays &= (solid.centre[:, 2] > 0) & (share > 0)
    else:
        crowd |= share < keep
        stays = share > 0.02
    ends = torch.bincount(image[stays], minlength=len(truths)).tolist()

    def parts(values: Tensor) -> tuple[Tensor, ...]:
        return torch.split(values[stays], ends)

    labels, boxes, crowds = parts(torch.cat([t.label for t in truths])), parts(cut), parts(crowd)
    solids: list[Solids | None] = [None] * len(truths)
    if solid is not None:
        columns = {f.name: parts(getattr(solid, f.name)) for f in fields(Solids)}
        solids = [Solids(**{name: values[k] for name, values in columns.items()}) for k in range(len(truths))]
    return [
        Truth(
            labels[k],
            boxes[k],
            solids[k],
            None if lens is None else lens[k],
            crowd=None if solid is not None and truths[k].crowd is None else crowds[k],
        )
        for k in range(len(truths))
    ]


def _changed_lens(
    lenses: Sequence[Tensor | None], mirror: Tensor, zoom: Tensor, shift: Tensor, width: int
) -> Tensor | None:
    """Intrinsics [B, 3, 3] of the changed pictures; None where there are none."""
    given = [k for k in lenses if k is not None]
    if len(given) < len(lenses):
        return None
    lens = torch.stack(given)
    lens[:, 0, 2] = torch.where(mirror, width - lens[:, 0, 2], lens[:, 0, 2])
    lens[:, :2, :2] *= zoom.to(lens)[:, None, None]
    lens[:, :2, 2] = zoom.to(lens)[:, None] * lens[:, :2, 2] + shift.to(lens)
    return lens


def _mirrored(solids: Sequence[Solids | None], mirror: Tensor) -> Solids:
    """All solids in one, those of mirrored pictures mirrored."""
    given = [s for s in solids if s is not None]
    columns = {f.name: torch.cat([getattr(s, f.name) for s in given]) for f in fields(Solids)}
    side = torch.where(mirror, -1.0, 1.0).to(columns["centre"])[:, None]
    one = torch.ones_like(side)
    columns["centre"] = columns["centre"] * torch.cat([side, one, one], 1)
    columns["velocity"] = columns["velocity"] * torch.cat([side, one], 1)
    columns["yaw"] = torch.where(mirror, torch.pi - columns["yaw"], columns["yaw"])
    return Solids(**columns)


def change_pictures(pictures: Tensor, changes: Sequence[Change]) -> Tensor:
    """Pictures float [B, 3, H, W] after their changes; grey where there is nothing.

    Below a zoom of `SHRUNK` samples are taken from the picture averaged to half its size: at full size they would skip
    pixels, which no camera does.
    """
    if all(not c.mirror and c.zoom == 1.0 for c in changes):
        return pictures
    height, width = pictures.shape[2:]
    rows = []
    for c in changes:
        side = -1.0 if c.mirror else 1.0
        x = side * (1 / c.zoom - 2 * c.shift[0] / (c.zoom * width) - 1)
        y = 1 / c.zoom - 2 * c.shift[1] / (c.zoom * height) - 1
        rows.append([[side / c.zoom, 0.0, x], [0.0, 1 / c.zoom, y]])
    theta = _send(torch.tensor(rows, dtype=pictures.dtype), pictures.device)
    grid = affine_grid(theta, list(pictures.shape), align_corners=False)
    centred = pictures - GREY
    moved = torch.empty_like(centred)
    half = (max(height // 2, 1), max(width // 2, 1))
    for small in (False, True):
        members = [k for k, c in enumerate(changes) if (c.zoom < SHRUNK) == small]
        if members:
            chosen = _send(torch.tensor(members), pictures.device)
            source = adaptive_avg_pool2d(centred[chosen], half) if small else centred[chosen]
            moved[chosen] = grid_sample(source, grid[chosen], align_corners=False)
    return moved + GREY


def change_colours(pictures: Tensor, recipe: Recipe, draws: torch.Generator) -> Tensor:
    """Brightness, contrast, saturation and gamma of each picture moved at random; noise added; in [0, 1]."""
    if recipe.jitter <= 0 and recipe.noise <= 0:
        return pictures
    device = pictures.device

    def about(spread: float) -> Tensor:
        value = torch.rand((len(pictures), 1, 1, 1), generator=draws)
        return _send(1.0 + spread * (2 * value - 1), device)

    grey = pictures.mean(1, keepdim=True)
    pictures = grey + (pictures - grey) * about(1.5 * recipe.jitter)
    middle = pictures.mean((1, 2, 3), keepdim=True)
    pictures = (middle + (pictures - middle) * about(recipe.jitter)) * about(recipe.jitter)
    tint = 1.0 + recipe.jitter * 0.15 * (torch.rand((len(pictures), 3, 1, 1), generator=draws) * 2 - 1)
    pictures = pictures * _send(tint, device)
    pictures = pictures.clamp(1e-4, 1.0) ** about(recipe.jitter)
    if recipe.noise > 0:
        level = _send(torch.rand((len(pictures), 1, 1, 1), generator=draws), device) ** 2 * recipe.noise
        grain = torch.Generator(device).manual_seed(int(torch.randint(2**62, (), generator=draws)))
        pictures = pictures + torch.randn(pictures.shape, generator=grain, device=device) * level
    return pictures.clamp(0.0, 1.0)


def make_batch(
    bank: PictureSet, indices: Sequence[int], recipe: Recipe, *, key: tuple[int, ...], device: torch.device
) -> tuple[Tensor, list[Truth]]:
    """Pictures float [B, 3, H, W] and their truth on the device, changed at random as the key says."""
    rng = np.random.default_rng(key)
    draws = torch.Generator().manual_seed(int(rng.integers(2**62)))
    chosen = _send(torch.tensor(indices), bank.pictures.device)
    pictures = bank.pictures[chosen].to(device, non_blocking=True).permute(0, 3, 1, 2).float() / 255
    size = (pictures.shape[2], pictures.shape[3])
    changes = [draw_change(recipe, size, rng, lens=bank.truth[i].intrinsic) for i in indices]
    truths = change_truths([bank.truth[i] for i in indices], changes, size, keep=recipe.keep)
    return change_colours(change_pictures(pictures, changes), recipe, draws), move(truths, device)
