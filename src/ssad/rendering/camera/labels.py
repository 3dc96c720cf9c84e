"""Labels of a picture from its tags: tight boxes, visible pixels, and which share of each thing is visible.

Pixel (x, y) spans x..x+1, y..y+1, as in an intrinsic, so that boxes are made of pixel edges. What a thing would cover
alone is rasterised in a crop of its own, on the samples of the picture where it is small and on a coarser grid where it
is large.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
import warp as wp

from ssad.core.errors import ConfigError
from ssad.core.types import F64, I32
from ssad.rendering.camera.kernels import raster
from ssad.rendering.camera.kernels.labels import cover
from ssad.rendering.camera.render import FACE_LANES, NEAR, Picture, View
from ssad.rendering.camera.scene import Scene, Thing

CROP = 64  # pixels a side of a crop
BEYOND = 2.0  # what lies further outside than this many widths or heights of the picture does not count
BATCH = 256  # crops at a time

_EDGES = np.array([(a, b) for a in range(8) for b in range(a + 1, 8) if (a ^ b) in (1, 2, 4)])
_bounds: WeakKeyDictionary[Scene, dict[int, tuple[F64, F64]]] = WeakKeyDictionary()


@dataclass(frozen=True, slots=True)
class Labels:
    """What is seen of the things of one view: N rows in the order of their tags, one for each with a visible pixel.

    Attributes:
        tag: [N].
        box: x0, y0, x1, y1 of the visible pixels, at pixel edges [N, 4].
        pixels: Number of visible pixels [N].
        share: Visible pixels as a share of those that it would cover if nothing else were there, 0 to 1 [N].
        inside: Share of its projection that lies in the picture, 0 to 1 [N].
    """

    tag: I32
    box: F64
    pixels: I32
    share: F64
    inside: F64

    def __len__(self) -> int:
        return len(self.tag)


def label_picture(stage: Scene, view: View, picture: Picture, index: int = 0, *, scale: int = 2) -> Labels:
    """Labels of a picture. Things with tags below 1 get none; things that share a tag count as one.

    Args:
        stage: The scene.
        view: The view that was rendered.
        picture: The rendered pictures.
        index: Which of them.
        scale: Samples along each side of a pixel that it was rendered with.

    Raises:
        ConfigError: The picture shows another view.
    """
    tag, box, pixels = extents(_tags(view, picture, index))
    alone, inside = _amodal(stage, view, tag, scale=scale)
    share = np.clip(pixels / np.maximum(alone, 1e-9), 0.0, 1.0)
    return Labels(tag, box, pixels, share, inside)


def visible_share(stage: Scene, view: View, picture: Picture, index: int = 0, *, scale: int = 2) -> dict[int, float]:
    """Visible share (0 to 1) of each thing of a view, by its tag (1 and above); 0 for what is not seen.

    Args:
        stage: See `label_picture`.
        view: See `label_picture`.
        picture: See `label_picture`.
        index: See `label_picture`.
        scale: See `label_picture`.

    Raises:
        ConfigError: The picture shows another view.
    """
    labels = label_picture(stage, view, picture, index, scale=scale)
    shares = dict.fromkeys(sorted({t.tag for t in view.things if t.tag > 0}), 0.0)
    return shares | dict(zip(labels.tag.tolist(), labels.share.tolist(), strict=True))


def extents(tags: I32) -> tuple[I32, F64, I32]:
    """Tags above 0 in a picture [H, W] in order [N], their tight boxes [N, 4] at pixel edges, their pixels [N]."""
    width = tags.shape[1]
    flat = np.ascontiguousarray(tags, np.int32).reshape(-1)
    fresh = np.empty(flat.size, bool)
    np.not_equal(flat[1:], flat[:-1], out=fresh[1:])
    fresh[::width] = True
    first = np.flatnonzero(fresh)
    length = np.diff(first, append=flat.size)
    thing = flat[first] > 0
    first, length = first[thing], length[thing]
    tag, row = np.unique(flat[first], return_inverse=True)
    y, x0 = np.divmod(first, width)
    box = np.tile(np.array([np.inf, np.inf, -np.inf, -np.inf]), (len(tag), 1))
    np.minimum.at(box[:, 0], row, x0)
    np.minimum.at(box[:, 1], row, y)
    np.maximum.at(box[:, 2], row, x0 + length)
    np.maximum.at(box[:, 3], row, y + 1)
    return tag.astype(np.int32), box, np.bincount(row, length, len(tag)).astype(np.int32)


def _tags(view: View, picture: Picture, index: int) -> I32:
    count, height, width = picture.tag.shape
    if not 0 <= index < count:
        raise ConfigError(f"label_picture: no picture {index}, there are {count}")
    if (height, width) != (view.camera.height, view.camera.width):
        size = f"{view.camera.width} x {view.camera.height}"
        raise ConfigError(f"label_picture: picture {index} is {width} x {height}, its view {size}; give its own view")
    return np.asarray(picture.tag[index], np.int32)


def bounds(stage: Scene, mesh: int) -> tuple[F64, F64]:
    """Smallest and largest corner of a mesh of a stage in its own frame, [3] each, m."""
    known = _bounds.setdefault(stage, {})
    if mesh not in known:
        listed = stage.listed.numpy()[stage.first[mesh] : stage.first[mesh] + stage.count[mesh]]
        corners = stage.vertices.numpy()[np.unique(stage.faces.numpy()[listed])].astype(np.float64)
        known[mesh] = (corners.min(0), corners.max(0)) if len(corners) else (np.zeros(3), np.zeros(3))
    return known[mesh]


def _projected(stage: Scene, view: View, things: Sequence[Thing], inverse: F64) -> F64:
    """x0, y0, x1, y1 at pixel edges [T, 4] of the boxes around things, cut at the near plane; NaN behind it."""
    span = np.array([bounds(stage, t.mesh) for t in things])
    corner = (np.arange(8)[:, None] >> np.arange(3)) & 1
    points = np.where(corner[None] == 1, span[:, 1, None], span[:, 0, None])
    matrix = inverse @ np.array([t.pose for t in things])
    points = np.einsum("tij,tpj->tpi", matrix[:, :3, :3], points) + matrix[:, None, :3, 3]
    a, b = points[:, _EDGES[:, 0]], points[:, _EDGES[:, 1]]
    crosses = (a[..., 2] < NEAR) != (b[..., 2] < NEAR)
    along = (NEAR - a[..., 2]) / np.where(crosses, b[..., 2] - a[..., 2], 1.0)
    cuts = np.where(crosses[..., None], a + (b - a) * along[..., None], np.nan)
    points = np.where(points[..., 2:] >= NEAR, points, np.nan)
    points = np.concatenate([points, cuts], 1)
    k = view.camera.intrinsic
    xy = points[..., :2] / points[..., 2:] * [k[0, 0], k[1, 1]] + [k[0, 2], k[1, 2]]
    low = np.where(np.isnan(xy), np.inf, xy).min(1)
    high = np.where(np.isnan(xy), -np.inf, xy).max(1)
    return np.concatenate([low, high], 1)


def _amodal(stage: Scene, view: View, tags: I32, *, scale: int) -> tuple[F64, F64]:
    """Pixels that the things of each tag would cover alone in the picture [N], and their share inside it [N]."""
    if not len(tags):
        return np.zeros(0), np.zeros(0)
    row = {int(tag): n for n, tag in enumerate(tags)}
    things = [t for t in view.things if t.tag in row]
    owner = np.array([row[t.tag] for t in things], np.int64)
    if len(np.unique(owner)) < len(tags):
        missing = int(np.setdiff1d(tags, [t.tag for t in things])[0])
        raise ConfigError(f"label_picture: the picture shows tag {missing}, which its view lacks; give its own view")
    width, height = float(view.camera.width), float(view.camera.height)
    inverse = np.asarray(np.linalg.inv(view.pose), np.float64)
    each = _projected(stage, view, things, inverse)
    whole = np.tile(np.array([np.inf, np.inf, -np.inf, -np.inf]), (len(tags), 1))
    np.minimum.at(whole[:, :2], owner, each[:, :2])
    np.maximum.at(whole[:, 2:], owner, each[:, 2:])
    whole = np.clip(whole, [-BEYOND * width, -BEYOND * height] * 2, [(BEYOND + 1) * width, (BEYOND + 1) * height] * 2)
    whole = np.concatenate([np.floor(whole[:, :2]), np.ceil(whole[:, 2:])], 1)
    shown = np.clip(whole, 0.0, [width, height, width, height])
    partly = np.flatnonzero((whole != shown).any(1))
    crops = np.concatenate([shown, whole[partly]])
    places = np.concatenate([np.arange(len(tags)), partly])
    pixels, areas = np.zeros(len(crops)), np.zeros(len(crops))
    of_owner = [np.flatnonzero(owner == n) for n in range(len(tags))]
    for at in range(0, len(crops), BATCH):
        part = slice(at, at + BATCH)
        members = [of_owner[n] for n in places[part]]
        pixels[part], areas[part] = _alone(stage, view, (things, members), crops[part], scale=scale)
    inside = np.ones(len(tags))
    inside[partly] = areas[partly] / np.maximum(np.maximum(areas[len(tags) :], areas[partly]), 1e-9)
    return pixels[: len(tags)], inside


def _alone(
    stage: Scene, view: View, group: tuple[Sequence[Thing], Sequence[I32]], crops: F64, *, scale: int
) -> tuple[F64, F64]:
    """Pixels that things cover in crops [M, 4] without others, by the picture's rule and by area [M each]."""
    things, members = group
    size = np.maximum(crops[:, 2:] - crops[:, :2], 1.0)
    step = np.maximum(size / CROP, 1.0)  # pixels of the picture for one of the crop
    k = view.camera.intrinsic
    focal = np.array([k[0, 0], k[1, 1]]) / step
    centre = (np.array([k[0, 2], k[1, 2]]) - crops[:, :2]) / step - 0.5  # as `kernel_lens` has it
    lens = np.concatenate([focal, centre], 1).astype(np.float32)
    order = np.concatenate(list(members))
    firsts = np.array([stage.first[things[n].mesh] for n in order], np.int32)
    counts = np.array([stage.count[things[n].mesh] for n in order], np.int32)
    matrices = np.linalg.inv(view.pose) @ np.array([things[n].pose for n in order])
    device, total = stage.device, int(counts.sum())
    views = np.repeat(np.arange(len(crops)), [len(m) for m in members]).astype(np.int32)
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
    side = CROP * scale
    samples = wp.zeros((len(crops), side, side), dtype=wp.uint64, device=device)
    lanes = FACE_LANES if device != "cpu" else 1
    inputs = [
        stage.vertices,
        stage.faces,
        stage.listed,
        wp.array(starts, dtype=int, device=device),
        wp.array(firsts, dtype=int, device=device),
        wp.array(views, dtype=int, device=device),
        wp.array(matrices.astype(np.float32), dtype=wp.mat44, device=device),
        wp.array(lens, dtype=wp.vec4, device=device),
        NEAR,
        float(scale),
        0,
        lanes,
        1e30,
    ]
    owners = wp.empty(total, dtype=wp.vec2i, device=device)
    large = wp.empty(1, dtype=raster.Triangle, device=device)
    many = wp.zeros(1, dtype=int, device=device)
    outputs = [owners, samples, large, many]
    wp.launch(raster.fill, dim=(len(firsts), lanes), inputs=inputs, outputs=outputs, device=device)
    shape = np.ceil(np.minimum(size, CROP)).astype(np.int32)[:, ::-1]
    pixels = wp.zeros(len(crops), dtype=int, device=device)
    hits = wp.zeros(len(crops), dtype=int, device=device)
    inputs = [samples, wp.array(np.ascontiguousarray(shape), dtype=int, device=device), scale]
    wp.launch(cover, dim=(len(crops), CROP, CROP), inputs=inputs, outputs=[pixels, hits], device=device)
    area = hits.numpy() / scale**2 * step.prod(1)
    return np.where(step.max(1) > 1.0, area, pixels.numpy()), area
