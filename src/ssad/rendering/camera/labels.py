"""Labels of an image from its tags: tight boxes, visible pixels, and the visible share of each object.

Pixel (x, y) spans x..x+1, y..y+1, as in an intrinsic, so that boxes consist of pixel edges. The unoccluded area of
an object is rasterised in a crop of its own, on the samples of the image where it is small and on a coarser grid
where it is large.
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
from ssad.rendering.camera.render import Rendering, View
from ssad.rendering.camera.scene import RenderScene, SceneObject
from ssad.rendering.camera.visibility import FACE_LANES, NEAR

CROP = 64  # pixels a side of a crop
BEYOND = 2.0  # parts further outside than this many widths or heights of the image do not count
BATCH = 256  # crops at a time

_EDGES = np.array([(a, b) for a in range(8) for b in range(a + 1, 8) if (a ^ b) in (1, 2, 4)])
_bounds: WeakKeyDictionary[RenderScene, dict[int, tuple[F64, F64]]] = WeakKeyDictionary()


@dataclass(frozen=True, slots=True)
class Labels:
    """Labels of the visible objects of one view: N rows ordered by tag.

    Attributes:
        tag: [N].
        box: x0, y0, x1, y1 of the visible pixels, at pixel edges [N, 4].
        pixels: Number of visible pixels [N].
        share: Visible pixels as a share of those that it would cover without occlusion, 0 to 1 [N].
        image_share: Share of its projection that lies in the image, 0 to 1 [N].
    """

    tag: I32
    box: F64
    pixels: I32
    share: F64
    image_share: F64

    def __len__(self) -> int:
        return len(self.tag)


def label_image(scene: RenderScene, view: View, rendering: Rendering, index: int = 0, *, scale: int = 2) -> Labels:
    """Labels of a picture. Things with tags below 1 get none; things that share a tag count as one.

    Args:
        scene: The scene.
        view: The view that was rendered.
        rendering: The rendered pictures.
        index: Which of them.
        scale: Samples along each side of a pixel that it was rendered with.

    Raises:
        ConfigError: The picture shows another view.
    """
    tags, boxes, pixels = extents(_tags(view, rendering, index))
    unoccluded, image_shares = _unoccluded_areas(scene, view, tags, scale=scale)
    shares = np.clip(pixels / np.maximum(unoccluded, 1e-9), 0.0, 1.0)
    return Labels(tags, boxes, pixels, shares, image_shares)


def visible_share(
    scene: RenderScene, view: View, rendering: Rendering, index: int = 0, *, scale: int = 2
) -> dict[int, float]:
    """Visible share (0 to 1) of each thing of a view, by its tag (1 and above); 0 for what is not seen.

    Args:
        scene: See `label_image`.
        view: See `label_image`.
        rendering: See `label_image`.
        index: See `label_image`.
        scale: See `label_image`.

    Raises:
        ConfigError: The picture shows another view.
    """
    labels = label_image(scene, view, rendering, index, scale=scale)
    shares = dict.fromkeys(sorted({entry.tag for entry in view.objects if entry.tag > 0}), 0.0)
    return shares | dict(zip(labels.tag.tolist(), labels.share.tolist(), strict=True))


def extents(tags: I32) -> tuple[I32, F64, I32]:
    """Return the tags above 0 in an image [H, W] in order [N], their tight boxes [N, 4] and pixel counts [N].

    Boxes lie at pixel edges.
    """
    width = tags.shape[1]
    flat_tags = np.ascontiguousarray(tags, np.int32).reshape(-1)
    run_starts = np.empty(flat_tags.size, bool)
    np.not_equal(flat_tags[1:], flat_tags[:-1], out=run_starts[1:])
    # A run must not continue across the border into the next row.
    run_starts[::width] = True
    first_pixels = np.flatnonzero(run_starts)
    run_lengths = np.diff(first_pixels, append=flat_tags.size)
    is_object = flat_tags[first_pixels] > 0
    first_pixels, run_lengths = first_pixels[is_object], run_lengths[is_object]
    unique_tags, box_index = np.unique(flat_tags[first_pixels], return_inverse=True)
    y, x0 = np.divmod(first_pixels, width)
    boxes = np.tile(np.array([np.inf, np.inf, -np.inf, -np.inf]), (len(unique_tags), 1))
    np.minimum.at(boxes[:, 0], box_index, x0)
    np.minimum.at(boxes[:, 1], box_index, y)
    np.maximum.at(boxes[:, 2], box_index, x0 + run_lengths)
    np.maximum.at(boxes[:, 3], box_index, y + 1)
    return unique_tags.astype(np.int32), boxes, np.bincount(box_index, run_lengths, len(unique_tags)).astype(np.int32)


def _tags(view: View, rendering: Rendering, index: int) -> I32:
    count, height, width = rendering.tag.shape
    if not 0 <= index < count:
        raise ConfigError(f"label_picture: no picture {index}, there are {count}")
    if (height, width) != (view.camera.height, view.camera.width):
        size = f"{view.camera.width} x {view.camera.height}"
        raise ConfigError(f"label_picture: picture {index} is {width} x {height}, its view {size}; give its own view")
    return np.asarray(rendering.tag[index], np.int32)


def bounds(scene: RenderScene, mesh: int) -> tuple[F64, F64]:
    """Return the smallest and largest corner of a mesh of a scene in its own frame, [3] each, m."""
    cached_bounds = _bounds.setdefault(scene, {})
    if mesh not in cached_bounds:
        face_indices = scene.listed.numpy()[scene.first[mesh] : scene.first[mesh] + scene.count[mesh]]
        corners = scene.vertices.numpy()[np.unique(scene.faces.numpy()[face_indices])].astype(np.float64)
        cached_bounds[mesh] = (corners.min(0), corners.max(0)) if len(corners) else (np.zeros(3), np.zeros(3))
    return cached_bounds[mesh]


def _projected(scene: RenderScene, view: View, objects: Sequence[SceneObject], inverse: F64) -> F64:
    """x0, y0, x1, y1 at pixel edges [T, 4] of the boxes around things, cut at the near plane; NaN behind it."""
    box_bounds = np.array([bounds(scene, entry.mesh) for entry in objects])
    corner_bits = (np.arange(8)[:, None] >> np.arange(3)) & 1
    points = np.where(corner_bits[None] == 1, box_bounds[:, 1, None], box_bounds[:, 0, None])
    to_camera = inverse @ np.array([entry.pose for entry in objects])
    points = np.einsum("tij,tpj->tpi", to_camera[:, :3, :3], points) + to_camera[:, None, :3, 3]
    starts, ends = points[:, _EDGES[:, 0]], points[:, _EDGES[:, 1]]
    # Boxes may reach behind the camera: add the points where their edges cut the near plane.
    crosses_plane = (starts[..., 2] < NEAR) != (ends[..., 2] < NEAR)
    cut_share = (NEAR - starts[..., 2]) / np.where(crosses_plane, ends[..., 2] - starts[..., 2], 1.0)
    cut_points = np.where(crosses_plane[..., None], starts + (ends - starts) * cut_share[..., None], np.nan)
    points = np.where(points[..., 2:] >= NEAR, points, np.nan)
    points = np.concatenate([points, cut_points], 1)
    intrinsic = view.camera.intrinsic
    xy = points[..., :2] / points[..., 2:] * [intrinsic[0, 0], intrinsic[1, 1]] + [intrinsic[0, 2], intrinsic[1, 2]]
    lower = np.where(np.isnan(xy), np.inf, xy).min(1)
    upper = np.where(np.isnan(xy), -np.inf, xy).max(1)
    return np.concatenate([lower, upper], 1)


def _unoccluded_areas(scene: RenderScene, view: View, tags: I32, *, scale: int) -> tuple[F64, F64]:
    """Return the unoccluded pixels of each tag in the image [N], and the share of its area inside the image [N]."""
    if not len(tags):
        return np.zeros(0), np.zeros(0)
    row_of_tag = {int(tag): tag_index for tag_index, tag in enumerate(tags)}
    objects = [entry for entry in view.objects if entry.tag in row_of_tag]
    owners = np.array([row_of_tag[entry.tag] for entry in objects], np.int64)
    if len(np.unique(owners)) < len(tags):
        missing = int(np.setdiff1d(tags, [entry.tag for entry in objects])[0])
        raise ConfigError(f"label_picture: the picture shows tag {missing}, which its view lacks; give its own view")
    width, height = float(view.camera.width), float(view.camera.height)
    inverse = np.asarray(np.linalg.inv(view.pose), np.float64)
    object_boxes = _projected(scene, view, objects, inverse)
    tag_boxes = np.tile(np.array([np.inf, np.inf, -np.inf, -np.inf]), (len(tags), 1))
    np.minimum.at(tag_boxes[:, :2], owners, object_boxes[:, :2])
    np.maximum.at(tag_boxes[:, 2:], owners, object_boxes[:, 2:])
    tag_boxes = np.clip(
        tag_boxes, [-BEYOND * width, -BEYOND * height] * 2, [(BEYOND + 1) * width, (BEYOND + 1) * height] * 2
    )
    tag_boxes = np.concatenate([np.floor(tag_boxes[:, :2]), np.ceil(tag_boxes[:, 2:])], 1)
    clipped_boxes = np.clip(tag_boxes, 0.0, [width, height, width, height])
    # Truncated objects are rasterised twice: their part in the image, and the whole.
    truncated = np.flatnonzero((tag_boxes != clipped_boxes).any(1))
    crops = np.concatenate([clipped_boxes, tag_boxes[truncated]])
    crop_tags = np.concatenate([np.arange(len(tags)), truncated])
    crop_pixels, crop_areas = np.zeros(len(crops)), np.zeros(len(crops))
    objects_of_tag = [np.flatnonzero(owners == tag_index) for tag_index in range(len(tags))]
    for batch_start in range(0, len(crops), BATCH):
        batch = slice(batch_start, batch_start + BATCH)
        batch_objects = [objects_of_tag[tag_index] for tag_index in crop_tags[batch]]
        crop_pixels[batch], crop_areas[batch] = _standalone_pixels(
            scene, view, (objects, batch_objects), crops[batch], scale=scale
        )
    inside = np.ones(len(tags))
    inside[truncated] = crop_areas[truncated] / np.maximum(
        np.maximum(crop_areas[len(tags) :], crop_areas[truncated]), 1e-9
    )
    return crop_pixels[: len(tags)], inside


def _standalone_pixels(
    scene: RenderScene, view: View, group: tuple[Sequence[SceneObject], Sequence[I32]], crops: F64, *, scale: int
) -> tuple[F64, F64]:
    """Return the pixels that objects cover alone in crops [M, 4], by the image's rule and by area [M each]."""
    objects, members = group
    size = np.maximum(crops[:, 2:] - crops[:, :2], 1.0)
    pixel_scale = np.maximum(size / CROP, 1.0)  # image pixels per crop pixel
    intrinsic = view.camera.intrinsic
    focal = np.array([intrinsic[0, 0], intrinsic[1, 1]]) / pixel_scale
    centre = (
        np.array([intrinsic[0, 2], intrinsic[1, 2]]) - crops[:, :2]
    ) / pixel_scale - 0.5  # as `kernel_lens` has it
    lens = np.concatenate([focal, centre], 1).astype(np.float32)
    object_order = np.concatenate(list(members))
    firsts = np.array([scene.first[objects[object_index].mesh] for object_index in object_order], np.int32)
    counts = np.array([scene.count[objects[object_index].mesh] for object_index in object_order], np.int32)
    matrices = np.linalg.inv(view.pose) @ np.array([objects[object_index].pose for object_index in object_order])
    device, face_count = scene.device, int(counts.sum())
    views = np.repeat(np.arange(len(crops)), [len(group_members) for group_members in members]).astype(np.int32)
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
    crop_samples = CROP * scale
    samples = wp.zeros((len(crops), crop_samples, crop_samples), dtype=wp.uint64, device=device)
    lanes = FACE_LANES if device != "cpu" else 1
    inputs = [
        scene.vertices,
        scene.faces,
        scene.twigs,
        scene.listed,
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
    owners = wp.empty(face_count, dtype=wp.vec2i, device=device)
    large = wp.empty(1, dtype=raster.Triangle, device=device)
    large_count = wp.zeros(1, dtype=int, device=device)
    outputs = [owners, samples, large, large_count]
    wp.launch(raster.fill, dim=(len(firsts), lanes), inputs=inputs, outputs=outputs, device=device)
    crop_shapes = np.ceil(np.minimum(size, CROP)).astype(np.int32)[:, ::-1]
    pixels = wp.zeros(len(crops), dtype=int, device=device)
    covered_samples = wp.zeros(len(crops), dtype=int, device=device)
    inputs = [samples, wp.array(np.ascontiguousarray(crop_shapes), dtype=int, device=device), scale]
    wp.launch(cover, dim=(len(crops), CROP, CROP), inputs=inputs, outputs=[pixels, covered_samples], device=device)
    areas = covered_samples.numpy() / scale**2 * pixel_scale.prod(1)
    return np.where(pixel_scale.max(1) > 1.0, areas, pixels.numpy()), areas
