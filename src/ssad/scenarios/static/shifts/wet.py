"""The wet road under rain: darker asphalt, and a film of water that mirrors what stands above it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from ssad.core.frames import Frame, camera_to_world
from ssad.scenarios.static.shifts import parameters as table
from ssad.scenarios.static.shifts.batch import Batch, keys_on, on, structs
from ssad.scenarios.static.shifts.depth import grid_size, lens
from ssad.scenarios.static.shifts.kernels import wet as kernels
from ssad.scenarios.static.shifts.light import tables
from ssad.scenarios.static.shifts.spec import ShiftSpec

_AROUND = 0.15  # m around a box: labels do not fit to the pixel


def wet_ground(
    batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec], known: tuple[Any, Sequence[str]]
) -> Batch:
    """The pictures with wet ground.

    Args:
        batch: The pictures.
        frames: Their frames.
        specs: Their shifts.
        known: Depth and sources of `depth_grid`; filled-in depth of the road is replaced by that of its plane.
    """
    depth, sources = known
    rows, columns = grid_size(batch)
    shape, dim = (batch.count, rows, columns), (batch.count, rows)
    view = lens(batch, frames)
    to_ego = on(batch, np.stack([f.camera.to_ego for f in frames]), wp.mat44)
    to_world = on(batch, np.stack([camera_to_world(f) for f in frames]), wp.mat44)
    linear, codes = tables(batch.device)
    ground = wp.empty(shape, dtype=float, device=batch.device)
    given = on(batch, [int(source == "given") for source in sources], wp.int32)
    batch.launch(kernels.find_ground, dim, [view, to_ego, given, *_footprints(batch, frames)], depth, ground)
    light = wp.empty(shape, dtype=wp.vec3, device=batch.device)
    batch.launch(kernels.shrink, dim, [batch.data, linear, batch.width, batch.height], light)
    usual = wp.empty((batch.count, -(-rows // 8), -(-columns // 8)), dtype=float, device=batch.device)
    batch.launch(kernels.usual_light, usual.shape, [ground, light], usual)
    keys = keys_on(batch, [s.key("hollows", f.scene) for s, f in zip(specs, frames, strict=True)])
    film = on(batch, [table.WET_FILM[s.severity - 1] for s in specs])
    rough = on(batch, [table.WET_ROUGH[s.severity - 1] for s in specs])
    shine = wp.empty(shape, dtype=wp.vec4, device=batch.device)
    batch.launch(kernels.mirror, dim, [depth, ground, light, view, to_ego, to_world, keys, film, rough], shine)
    dark = on(batch, [table.WET_DARK[s.severity - 1] for s in specs])
    out = batch.like()
    inputs = [batch.words(), ground, shine, usual, dark, linear, codes, batch.width, batch.stride // 4]
    batch.launch(kernels.blend_wet, (batch.count, batch.height), inputs, out.words())
    return out


def _footprints(batch: Batch, frames: Sequence[Frame]) -> tuple[Any, Any]:
    """Where boxes stand on the ground of each ego, one image after the other, and where each image's begin."""
    rows: list[tuple[float, ...]] = []
    first = [0]
    for frame in frames:
        boxes, turn = frame.boxes, frame.ego_to_world[:3, :3]
        centre = (boxes.centre - frame.ego_to_world[:3, 3]) @ turn
        ahead = boxes.axes()[:, :, 0] @ turn
        ahead = ahead[:, :2] / np.maximum(np.linalg.norm(ahead[:, :2], axis=1, keepdims=True), 1e-9)
        half = boxes.size_lwh[:, :2] / 2 + _AROUND
        base = centre[:, 2:] - boxes.size_lwh[:, 2:] / 2
        rows += [tuple(row) for row in np.concatenate([centre[:, :2], ahead, half, base], 1).tolist()]
        first.append(len(rows))
    return structs(batch, rows or [(0.0,) * 7], kernels.Footprint), on(batch, first, wp.int32)
