"""Paper's calibration of weather, sun and motion blur: layers over an image, with the published parameters.

Each image is independent: nothing agrees between cameras, and depth has no effect. Written from the computations of
the originals (ImageNet-C: Hendrycks and Dietterich 2019; imgaug's rain and a sun, as 3D_Corruptions_AD calls them:
Dong et al. 2023). Snow, rain and fog have the originals' statistics, which a test checks; the sun follows its
formula; motion blur its lengths. Lengths in pixels hold at a width of 1600 and scale with the width.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import cv2
import numpy as np
import warp as wp

from ssad.core.frames import Frame, ShiftReport
from ssad.scenarios.static.shifts import parameters as table
from ssad.scenarios.static.shifts.batch import Batch, file_keys, to_device
from ssad.scenarios.static.shifts.kernels import falling, layers
from ssad.scenarios.static.shifts.noise import unit_normal
from ssad.scenarios.static.shifts.objects import owners
from ssad.scenarios.static.shifts.spec import ShiftSpec

Result = tuple[Batch, list[ShiftReport]]
WIDTH: Final = 1600  # pixels: image width of the published lengths
CLOUDS: Final = 2048  # side of the published clouds at that width, pixels
GATE: Final = 32  # rows of the map that varies the density of rain over the image


def paper_shift(batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec]) -> Result:
    """Apply snow, rain, fog, sunlight or motion_blur as published."""
    implementations = {"snow": _snow, "rain": _rain, "fog": _fog, "sunlight": _sun, "motion_blur": _blur}
    return implementations[specs[0].name](batch, frames, specs)


def _frame_generator(spec: ShiftSpec, frame: Frame) -> np.random.Generator:
    return spec.generator("paper", frame.scene, frame.sample, frame.camera.channel)


def _samples_per_side(scale: float) -> int:
    """Return the samples along a side of each pixel for the mean of a layer; a smaller image averages more."""
    return max(1, round(1 / scale))


def _snow(batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec]) -> Result:
    """Apply ImageNet-C's snow, then 30 % grey and a darker image at any severity."""
    scale = batch.width / WIDTH
    parameters = [table.PAPER_SNOW[spec.severity - 1] for spec in specs]
    mean, deviation, zoom, threshold, radius, sigma, kept_share = zip(*parameters, strict=True)
    angles_deg = np.array(
        [
            _frame_generator(image_spec, image_frame).uniform(-135, -45)
            for image_spec, image_frame in zip(specs, frames, strict=True)
        ]
    )
    cell_steps, shapes = [], []
    for zoom_factor in zoom:  # as in scipy.ndimage.zoom: first and last cells align with first and last pixels
        cell_counts = [int(np.ceil(round(side / scale) / zoom_factor)) for side in (batch.height, batch.width)]
        cell_steps.append(
            [max(cell_count - 1, 0) / max(round(cell_count * zoom_factor) - 1, 1) for cell_count in cell_counts]
        )
        shapes.append([cell_count + 1 for cell_count in cell_counts])
    noise_shape = (batch.count, *np.max(shapes, axis=0).tolist())
    noise = wp.empty(noise_shape, dtype=float, device=batch.device)
    keys = file_keys(batch, specs, frames, "paper")
    inputs = [keys, to_device(batch, mean), to_device(batch, deviation), to_device(batch, unit_normal())]
    batch.launch(falling.specks, noise_shape[:2], inputs, noise)
    # flakes fall steeply, so half the rows are enough
    half_shape = (batch.count, -(-batch.height // 2))
    flake_layer, streak_layer = (
        wp.empty((*half_shape, batch.width), dtype=float, device=batch.device) for _ in range(2)
    )
    inputs = [
        noise,
        to_device(batch, cell_steps, wp.vec2),
        to_device(batch, threshold),
        scale,
        _samples_per_side(scale),
        batch.height,
    ]
    batch.launch(falling.flakes, half_shape, inputs, flake_layer)
    # half a gaussian over 2 radius + 1 published pixels, as far as it is not negligible
    offsets, weights = [], []
    for angle_value, radius_value, sigma_value in zip(np.radians(angles_deg), radius, sigma, strict=True):
        distances = np.arange(0, min(2 * radius_value + 1, 3.5 * sigma_value) * scale, 2.0)
        offsets.append(np.rint(np.outer(distances, [np.cos(angle_value), -np.sin(angle_value) / 2])))
        weights.append(np.exp(-(distances**2) / (2 * (sigma_value * scale) ** 2)))
    tap_count = -(-max(len(image_weights) for image_weights in weights) // 4) * 4
    offset_table, weight_table = (
        np.zeros((batch.count, tap_count, 2), np.int32),
        np.zeros((batch.count, tap_count), np.float32),
    )
    for index, (image_offsets, image_weights) in enumerate(zip(offsets, weights, strict=True)):
        offset_table[index, : len(image_offsets)], weight_table[index, : len(image_weights)] = (
            image_offsets,
            image_weights / image_weights.sum(),
        )
    inputs = [
        flake_layer.flatten(),
        to_device(batch, offset_table, wp.vec2i),
        to_device(batch, weight_table),
        half_shape[1],
        batch.width,
    ]
    batch.launch(falling.streaks, half_shape, inputs, streak_layer.flatten())
    thread_shape = (batch.count, batch.height)
    result, highest = batch.empty_like(), wp.empty(thread_shape, dtype=int, device=batch.device)
    inputs = [
        batch.words(),
        streak_layer.flatten(),
        to_device(batch, kept_share),
        table.PAPER_GREY,
        batch.height,
        batch.width,
        batch.stride // 4,
        highest,
    ]
    batch.launch(falling.blend_snow, thread_shape, inputs, result.words())
    _darken(result, highest)
    return result, [ShiftReport(True, {"angle_deg": round(float(angle_value), 1)}) for angle_value in angles_deg]


def _rain(batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec]) -> Result:
    """Apply one layer of imgaug's rain, then 30 % grey and a darker image at any severity.

    Streaks of 64 to 320 pixels, so faint that they form a veil: the published parameters give this at 1600.
    """
    scale = batch.width / WIDTH
    gate_maps = np.empty((batch.count, GATE, 2 * GATE), np.float32)
    density, streak_lengths, streak_rows, gate_coordinates, layer_coordinates, first_rows = [], [], [], [], [], []
    for index, (spec, frame) in enumerate(zip(specs, frames, strict=True)):
        draws = _frame_generator(spec, frame)
        density.append(draws.uniform(*table.PAPER_RAIN[spec.severity - 1]))
        cells_per_pixel = 1.0 - draws.uniform(0.4, 0.6)  # cells a published pixel
        angle = draws.uniform(-15, 15)
        speed = draws.uniform(0.04, 0.20)
        gate_shape = 1.0 - draws.uniform(0.8, 1.0)
        coarse_gate = draws.beta(1.0, max(gate_shape, 1e-6), (8, 8)).astype(np.float32)
        gate_maps[index] = cv2.resize(coarse_gate, (2 * GATE, GATE), interpolation=cv2.INTER_CUBIC).clip(0, 1)
        slope = np.tan(np.radians(angle))
        streak_lengths.append(speed * max(batch.height, batch.width))
        row_count = max(2, round(streak_lengths[-1] / scale * np.cos(np.radians(angle)) * cells_per_pixel))
        height = int(batch.height / scale * cells_per_pixel) + 3 + row_count
        left_columns = max(0.0, slope) * height + 1  # columns to the left of the image, at its first row
        streak_rows.append(row_count)
        gate_columns, gate_rows = (
            (2 * GATE) * scale / (cells_per_pixel * batch.width),
            GATE * scale / (cells_per_pixel * batch.height),
        )
        gate_coordinates.append([gate_columns, slope * gate_columns, -left_columns * gate_columns, gate_rows])
        layer_coordinates.append([cells_per_pixel / scale, -slope, left_columns])
        first_rows.append(row_count)
    inputs = [file_keys(batch, specs, frames, "paper"), to_device(batch, density)]
    max_cells = 0.6 / scale
    row_count, column_count = int(batch.height * max_cells) + 3 + max(streak_rows), int(batch.width * max_cells) + 4
    layer_shape = (batch.count, row_count, column_count + int(np.ceil(row_count * np.tan(np.radians(15)))))
    drop_layer, rain_layer = (wp.empty(layer_shape, dtype=float, device=batch.device) for _ in range(2))
    inputs += [to_device(batch, gate_coordinates, wp.vec4), to_device(batch, first_rows), to_device(batch, gate_maps)]
    batch.launch(falling.drops, layer_shape[:2], inputs, drop_layer)
    running_sums = [wp.zeros((batch.count, layer_shape[2]), dtype=float, device=batch.device) for _ in range(2)]
    # the source enlarges with cubic splines and cuts off negative values, which adds light (measured)
    gains = [1.28 - 0.95 * density_value + 0.9 * density_value**2 for density_value in density]
    # columns per thread: neighbours in memory on the CPU, as many threads as possible on a GPU
    block_width = 64 if batch.device == "cpu" else 1
    inputs = [drop_layer, to_device(batch, streak_rows, wp.int32), to_device(batch, gains), block_width, *running_sums]
    thread_shape = (batch.count, -(-layer_shape[2] // block_width))
    batch.launch(falling.fall, thread_shape, inputs, rain_layer)
    thread_shape = (batch.count, batch.height)
    opacity = wp.empty((*thread_shape, batch.width), dtype=wp.uint8, device=batch.device)
    inputs = [
        rain_layer,
        to_device(batch, layer_coordinates, wp.vec3),
        to_device(batch, first_rows),
        _samples_per_side(scale),
    ]
    batch.launch(falling.curtain, thread_shape, inputs, opacity)
    result, highest = batch.empty_like(), wp.empty(thread_shape, dtype=int, device=batch.device)
    size = batch.count * batch.stride // 12
    opacity_words = wp.array(ptr=opacity.ptr, dtype=wp.uint32, shape=size, device=batch.device)
    opacity_words._keep = opacity  # the memory belongs to the bytes
    inputs = [batch.words(), opacity_words, table.PAPER_GREY, batch.width, batch.stride // 4, highest]
    batch.launch(falling.blend_rain, thread_shape, inputs, result.words())
    _darken(result, highest)
    details = zip(density, streak_lengths, strict=True)
    return result, [
        ShiftReport(True, {"density": round(float(density_value), 3), "streak_px": round(float(streak_length))})
        for density_value, streak_length in details
    ]


def _darken(batch: Batch, highest: Any) -> None:
    """Scale the values in place so that the brightest becomes 0.7 of 256."""
    brightest = np.maximum(highest.numpy().max(1), 1)
    gains = np.rint(table.PAPER_DARK * 256 / brightest * 256).astype(np.int32)
    thread_shape, word_count, chunk_size = batch.chunks()
    batch.launch(
        falling.darken, thread_shape, [to_device(batch, gains, wp.int32), word_count, chunk_size], batch.words()
    )


def _fog(batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec]) -> Result:
    """Apply ImageNet-C's clouds without depth, then grey; clouds lack detail below 4 published pixels."""
    amounts, decays, grey_shares = zip(*[table.PAPER_FOG[spec.severity - 1] for spec in specs], strict=True)
    keys = file_keys(batch, specs, frames, "paper")
    cloud_side = CLOUDS // 4
    level_count = cloud_side.bit_length() - 1
    # the source squares its amplitude: an octave is 1 / decay ** 2 of the one before
    amplitudes = to_device(
        batch, [[float(decay_value) ** (-2 * level) for level in range(level_count)] for decay_value in decays]
    )
    clouds = wp.zeros((batch.count, cloud_side, cloud_side), dtype=float, device=batch.device)
    for level in range(level_count):
        for kernel in (layers.squares, layers.diamonds):
            grid_shape = (batch.count, 1 << level, 1 << level)
            batch.launch(kernel, grid_shape, [keys, amplitudes, level], clouds)
    row_extremes = [wp.empty((batch.count, cloud_side), dtype=float, device=batch.device) for _ in range(2)]
    batch.launch(layers.extremes, (batch.count, cloud_side), [clouds], *row_extremes)
    lowest, highest_cloud = row_extremes[0].numpy().min(1), row_extremes[1].numpy().max(1)
    span = np.maximum(highest_cloud - lowest, 1e-6)
    highest = wp.empty((batch.count, batch.height), dtype=int, device=batch.device)
    thread_shape = (batch.count, batch.height)
    inputs = [batch.words(), batch.width * 3 // 4, batch.stride // 4]
    batch.launch(layers.brightest, thread_shape, inputs, highest)
    brightest = highest.numpy().max(1) / 255
    result = batch.empty_like()
    cloud_parameters = [to_device(batch, values) for values in (lowest, span, amounts, brightest, grey_shares)]
    inputs = [batch.data, clouds, *cloud_parameters, WIDTH / batch.width / 4, batch.width, batch.stride]
    batch.launch(layers.blend_clouds, thread_shape, inputs, result.data)
    return result, [
        ShiftReport(True, {"amount": float(amount_value), "decay": float(decay_value)})
        for amount_value, decay_value in zip(amounts, decays, strict=True)
    ]


def _sun(batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec]) -> Result:
    """Apply a white disc at a random place, and a faint disc on the line through it and the centre."""
    scale = batch.width / WIDTH
    suns, flares, colours, strengths, records = [], [], [], [], []
    for spec, frame in zip(specs, frames, strict=True):
        draws = _frame_generator(spec, frame)
        x, y = draws.uniform(0.25, 0.75) * batch.width, draws.uniform(0.30, 0.45) * batch.height
        x_offset = batch.width / 2 - x
        slope = (batch.height / 2 - y) / (x_offset if abs(x_offset) > 1e-6 else 1e-6)
        line_x = np.arange(0, batch.width, 10 * scale)
        line_x = line_x[(slope * (line_x - x) + y > 0) & (slope * (line_x - x) + y < batch.height)]
        flare_share, flare_strength, flare_size = (
            draws.uniform(),
            draws.uniform(0.2, 0.5),
            draws.uniform(1, max(batch.height / 15, 2)),
        )
        colours.append(draws.integers(205, 255, 3))
        strengths.append(flare_strength)
        flare_x = line_x[int(flare_share * max(len(line_x) - 1, 1))] if len(line_x) else 0.0
        flares.append([flare_x, slope * (flare_x - x) + y, flare_size if len(line_x) else 0.0])
        suns.append([x, y, table.PAPER_SUN[spec.severity - 1] * scale])
        records.append(ShiftReport(True, {"x": round(float(x)), "y": round(float(y)), "radius_px": float(suns[-1][2])}))
    result = batch.copy()
    disc_parameters = [to_device(batch, values, wp.vec3) for values in (suns, flares, colours)]
    inputs = [batch.data, *disc_parameters, to_device(batch, strengths), batch.width, batch.stride]
    thread_shape = (batch.count, batch.height)
    batch.launch(layers.blend_sun, thread_shape, inputs, result.data)
    return result, records


def _blur(batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec]) -> Result:
    """Apply zoom blur to front and back cameras and horizontal blur to others, inside boxes."""
    owner, records = owners(batch, frames, specs)
    lengths, zooms = np.zeros(batch.count, np.int32), np.zeros(batch.count, np.float32)
    for index, (spec, frame) in enumerate(zip(specs, frames, strict=True)):
        viewing_axis = frame.camera.to_ego[:3, 2]
        if abs(viewing_axis[0]) > 0.9:
            zooms[index] = table.PAPER_ZOOM[spec.severity - 1]
        else:
            lengths[index] = round(table.PAPER_KERNEL[spec.severity - 1] * batch.width)
    result = batch.copy()
    thread_shape = (batch.count, batch.height)
    for kernel, values, dtype in ((layers.smear_rows, lengths, wp.int32), (layers.zoom_blur, zooms, wp.float32)):
        inputs = [batch.data, owner, to_device(batch, values, dtype), batch.stride]
        batch.launch(kernel, thread_shape, inputs, result.data)
    return result, records
