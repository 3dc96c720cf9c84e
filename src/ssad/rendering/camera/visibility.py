"""Visibility passes over the samples of views and the texels of shadow maps of the sun."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from ssad.core.types import F32, F64
from ssad.rendering.camera.kernels import raster, shade, shadow
from ssad.rendering.camera.scene import DrawCalls, ObjectTable, RenderScene

NEAR = 0.15  # m
LARGE, ROW_LANES = 4096, 32  # large triangles that a view may list, threads for each
FACE_LANES = 512  # threads for each draw on a GPU


class VisibilityPass:
    """Visibility pass over all views: draws, slots and samples."""

    def __init__(
        self,
        scene: RenderScene,
        draws: DrawCalls,
        lens: F32,
        *,
        ortho: bool,
        size: tuple[int, int],
        scale: int,
        near: float = NEAR,
    ) -> None:
        device = scene.device
        face_count = int(draws.counts.sum())
        draw_table = shade.DrawRanges()
        starts = wp.array(np.concatenate([[0], np.cumsum(draws.counts)]).astype(np.int32), dtype=int, device=device)
        firsts = wp.array(draws.firsts, dtype=int, device=device)
        draw_table.matrices = wp.array(draws.matrices, dtype=wp.mat44, device=device)
        draw_table.paints = wp.array(draws.paints, dtype=wp.vec3, device=device)
        draw_table.tags = wp.array(draws.tags, dtype=int, device=device)
        draw_table.lit = wp.array(draws.lit, dtype=int, device=device)
        draw_table.split = wp.array(draws.splits, dtype=wp.vec2, device=device)
        self.lens = wp.array(lens, dtype=wp.vec4, device=device)
        views = wp.array(draws.views, dtype=int, device=device)
        height, width = size[0] * scale, size[1] * scale
        self.samples = draw_table.samples = wp.zeros((len(lens), height, width), dtype=wp.uint64, device=device)
        self.draw_ranges = draw_table
        draw_table.owners = wp.empty(max(face_count, 1), dtype=wp.vec2i, device=device)
        if not face_count:
            return
        on_gpu = device != "cpu"
        # On a GPU, threads share the faces of a draw, and the rows of large triangles.
        large_capacity = LARGE * len(lens) if on_gpu else 1
        # If the list is full, the kernel fills large triangles itself: only speed is lost.
        large_triangles = wp.empty(large_capacity, dtype=raster.Triangle, device=device)
        large_count = wp.zeros(1, dtype=int, device=device)
        lanes = FACE_LANES if on_gpu else 1
        inputs = [
            scene.vertices,
            scene.faces,
            scene.twigs,
            scene.listed,
            starts,
            firsts,
            views,
            draw_table.matrices,
            self.lens,
            near,
            float(scale),
            int(ortho),
            lanes,
            256.0 if on_gpu else 1e30,
        ]
        outputs = [draw_table.owners, self.samples, large_triangles, large_count]
        wp.launch(raster.fill, dim=(len(draws.counts), lanes), inputs=inputs, outputs=outputs, device=device)
        if on_gpu:
            inputs = [large_triangles, large_count, ROW_LANES]
            wp.launch(
                raster.fill_large, dim=(large_capacity, ROW_LANES), inputs=inputs, outputs=[self.samples], device=device
            )


def sun_map(  # noqa: PLR0917
    scene: RenderScene,
    bodies: ObjectTable,
    suns: Sequence[tuple[float, ...]],
    middles: F64,
    reach: float,
    size: int,
    *,
    soft: tuple[float, int] = (0.0, 0),
) -> Any:
    """Render a shadow map [B, size, size] around each middle.

    Args:
        scene: The scene.
        bodies: The objects of all views.
        suns: Direction to the sun of each view.
        middles: On the map, m.
        reach: From a middle to the border, m.
        size: Texels a side; 0 for an empty map.
        soft: Of soft shadows: smallest radius of the filter, and how far to each side occluders are sought, texels.

    Returns:
        A `SunMap` of the kernels.
    """
    middles = middles * [1.0, 1.0, 0.0]
    texel = 2 * reach / max(size, 1)
    to_light = _light_cameras(np.array(suns), middles)
    to_texels = np.diag([1 / texel, 1 / texel, 1.0, 1.0])
    to_texels[:2, 3] = size / 2
    result = empty_sun_map(scene)
    result.to_texels = wp.array((to_texels @ to_light).astype(np.float32), dtype=wp.mat44, device=scene.device)
    result.texel = texel
    if not size:
        return result
    image_centre = size / 2 - 0.5
    intrinsics = np.tile(np.array([1 / texel, 1 / texel, image_centre, image_centre], np.float32), (len(middles), 1))
    # Far enough for everything that can cast a shadow into the map; small street objects only near its middle.
    far_limit = 1.4 * reach + 11.0
    draws = scene.gather_draw_calls(
        to_light,
        bodies,
        eyes=middles,
        axes=None,
        reach=(0.4 * reach, far_limit),
        far=np.full(len(middles), far_limit),
        horizon=False,
        casts_shadows=True,
    )
    result.keys = VisibilityPass(scene, draws, intrinsics, ortho=True, size=(size, size), scale=1).samples
    if soft[1] > 0:
        result.hardest, result.search = soft
        result.blocks = _square_blocks(result.keys, 2 * result.search)
    return result


def _square_blocks(keys: Any, block: int) -> Any:
    """Return the depths nearest to and farthest from the sun in squares of four blocks of a shadow map.

    Args:
        keys: Shadow map [B, size, size], a Warp array.
        block: Texels along each side of a block; a divisor of the size.

    Returns:
        [B, n, n], a Warp array of vec2 on the device of the map; n blocks lie along a side.
    """
    device, count = keys.device, keys.shape[1] // block
    if device.is_cpu:
        # Reductions of NumPy take a fifth of the time of the kernels, and give the same bits.
        return wp.array(block_depths(keys.numpy(), block), dtype=wp.vec2, device=device)
    blocks, square_blocks = (wp.empty((len(keys), count, count), dtype=wp.vec2, device=device) for _ in range(2))
    dim = (len(keys), count, count)
    wp.launch(shadow.gather_blocks, dim=dim, inputs=[keys, block, count], outputs=[blocks], device=device)
    wp.launch(shadow.join_blocks, dim=dim, inputs=[blocks, count], outputs=[square_blocks], device=device)
    return square_blocks


def block_depths(keys: Any, block: int) -> F32:
    """Return the depths nearest to and farthest from the sun in squares of four blocks of a shadow map.

    Args:
        keys: Shadow map uint64 [B, size, size], see `ssad.rendering.camera.kernels.raster`.
        block: Texels along each side of a block; a divisor of the size.

    Returns:
        Thousands of metres towards the sun [B, n, n, 2], for the square that begins at each of n by n blocks.
    """
    count = keys.shape[1] // block
    depths = np.empty((len(keys), count, count, 2), np.float32)
    for index, extreme in enumerate((np.maximum, np.minimum)):
        rows = extreme.reduce(keys.reshape(len(keys), count, block, count * block), axis=2)
        extremes = rows[..., ::block].copy()
        for column in range(1, block):
            extreme(extremes, rows[..., column::block], out=extremes)
        extremes[:, :-1] = extreme(extremes[:, :-1], extremes[:, 1:])
        extremes[..., :-1] = extreme(extremes[..., :-1], extremes[..., 1:])
        depths[..., index] = (extremes >> np.uint64(32)).astype(np.uint32).view(np.float32)
    return depths


def empty_sun_map(scene: RenderScene) -> Any:
    """Return a shadow map without texels."""
    result = shadow.SunMap()
    result.keys = wp.zeros((1, 1, 1), dtype=wp.uint64, device=scene.device)
    result.blocks = wp.zeros((1, 1, 1), dtype=wp.vec2, device=scene.device)
    result.to_texels = wp.zeros(1, dtype=wp.mat44, device=scene.device)
    result.texel, result.hardest, result.search = 1.0, 0.0, 0
    return result


def _light_cameras(suns: F64, middles: F64) -> F64:
    """Return the matrices world to light [B, 4, 4], for directions to the sun and middles [B, 3].

    z runs with the light, x and y across it; the origin is the middle, rounded to half a metre.
    """
    z_axes = -suns / np.linalg.norm(suns, axis=1, keepdims=True)
    level_length = np.hypot(z_axes[:, 0], z_axes[:, 1])
    safe_length = np.maximum(level_length, 1e-6)
    x_axes = np.stack([-z_axes[:, 1] / safe_length, z_axes[:, 0] / safe_length, np.zeros(len(z_axes))], 1)
    # A sun straight overhead has no azimuth.
    x_axes[level_length <= 1e-6] = 1.0, 0.0, 0.0
    rotations = np.stack([x_axes, np.cross(z_axes, x_axes), z_axes], 1)
    matrices = np.zeros((len(z_axes), 4, 4))
    matrices[:, :3, :3] = rotations
    matrices[:, :3, 3] = -np.round((rotations @ middles[..., None])[..., 0] * 2) / 2
    matrices[:, 3, 3] = 1.0
    return matrices
