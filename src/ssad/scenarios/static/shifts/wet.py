"""Wet road under rain: darker asphalt, and a film of water that mirrors its surroundings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from ssad.core.frames import Frame, camera_to_world
from ssad.scenarios.static.shifts import parameters as table
from ssad.scenarios.static.shifts.batch import Batch, keys_on, structs, to_device
from ssad.scenarios.static.shifts.depth import grid_size, lens
from ssad.scenarios.static.shifts.kernels import wet as kernels
from ssad.scenarios.static.shifts.light import tables
from ssad.scenarios.static.shifts.spec import ShiftSpec

_AROUND = 0.15  # m: margin around a box, since labels are not pixel-accurate


def wet_ground(
    batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec], depth_and_sources: tuple[Any, Sequence[str]]
) -> Batch:
    """Return the images with wet ground.

    Args:
        batch: The images.
        frames: Frame of each image.
        specs: Shift of each image.
        depth_and_sources: Depth and sources of `depth_grid`; filled-in depth of the road becomes that of its plane.
    """
    depth, sources = depth_and_sources
    rows, columns = grid_size(batch)
    shape, thread_shape = (batch.count, rows, columns), (batch.count, rows)
    lenses = lens(batch, frames)
    to_ego = to_device(batch, np.stack([frame.camera.to_ego for frame in frames]), wp.mat44)
    to_world = to_device(batch, np.stack([camera_to_world(frame) for frame in frames]), wp.mat44)
    linear, codes = tables(batch.device)
    ground = wp.empty(shape, dtype=float, device=batch.device)
    is_depth_given = to_device(batch, [int(source == "given") for source in sources], wp.int32)
    batch.launch(
        kernels.find_ground, thread_shape, [lenses, to_ego, is_depth_given, *_footprints(batch, frames)], depth, ground
    )
    cell_light = wp.empty(shape, dtype=wp.vec3, device=batch.device)
    batch.launch(kernels.shrink, thread_shape, [batch.data, linear, batch.width, batch.height], cell_light)
    mean_light = wp.empty((batch.count, -(-rows // 8), -(-columns // 8)), dtype=float, device=batch.device)
    batch.launch(kernels.typical_light, mean_light.shape, [ground, cell_light], mean_light)
    keys = keys_on(batch, [spec.key("hollows", frame.scene) for spec, frame in zip(specs, frames, strict=True)])
    film = to_device(batch, [table.WET_FILM[spec.severity - 1] for spec in specs])
    roughness = to_device(batch, [table.WET_ROUGH[spec.severity - 1] for spec in specs])
    shine = wp.empty(shape, dtype=wp.vec4, device=batch.device)
    batch.launch(
        kernels.mirror,
        thread_shape,
        [depth, ground, cell_light, lenses, to_ego, to_world, keys, film, roughness],
        shine,
    )
    soft_shine = wp.empty_like(shine)
    batch.launch(kernels.soften, thread_shape, [shine, ground], soft_shine)
    darkening = to_device(batch, [table.WET_DARK[spec.severity - 1] for spec in specs])
    result = batch.empty_like()
    inputs = [batch.words(), ground, soft_shine, mean_light, darkening, linear, codes, batch.width, batch.stride // 4]
    batch.launch(kernels.blend_wet, (batch.count, batch.height), inputs, result.words())
    return result


def _footprints(batch: Batch, frames: Sequence[Frame]) -> tuple[Any, Any]:
    """Return the footprints of boxes in each ego frame, image by image, and the offset of each image."""
    rows: list[tuple[float, ...]] = []
    offsets = [0]
    for frame in frames:
        boxes, rotation = frame.boxes, frame.ego_to_world[:3, :3]
        centre = (boxes.centre - frame.ego_to_world[:3, 3]) @ rotation
        forward = boxes.axes()[:, :, 0] @ rotation
        forward = forward[:, :2] / np.maximum(np.linalg.norm(forward[:, :2], axis=1, keepdims=True), 1e-9)
        half_size = boxes.size_lwh[:, :2] / 2 + _AROUND
        base_height = centre[:, 2:] - boxes.size_lwh[:, 2:] / 2
        rows += [
            tuple(footprint)
            for footprint in np.concatenate([centre[:, :2], forward, half_size, base_height], 1).tolist()
        ]
        offsets.append(len(rows))
    # Warp arrays must not be empty, hence one dummy row.
    return structs(batch, rows or [(0.0,) * 7], kernels.Footprint), to_device(batch, offsets, wp.int32)
