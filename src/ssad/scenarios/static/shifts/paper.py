"""The paper's calibration of weather, sun and motion blur: layers over a picture, with the published parameters.

Each picture by itself: nothing agrees between cameras, and depth plays no part. Written from what the originals compute
(ImageNet-C: Hendrycks and Dietterich 2019; imgaug's rain and a sun, as 3D_Corruptions_AD calls them: Dong et al. 2023).
Snow, rain and fog have the originals' statistics, which a test holds them against; the sun follows its formula; motion
blur its lengths. Lengths in pixels hold at a width of 1600 and scale with the width.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import cv2
import numpy as np
import warp as wp

from ssad.core.frames import Applied, Frame
from ssad.scenarios.static.shifts import parameters as table
from ssad.scenarios.static.shifts.batch import Batch, file_keys, on
from ssad.scenarios.static.shifts.kernels import falling, layers
from ssad.scenarios.static.shifts.noise import unit_normal
from ssad.scenarios.static.shifts.objects import owners
from ssad.scenarios.static.shifts.spec import ShiftSpec

Result = tuple[Batch, list[Applied]]
WIDTH: Final = 1600  # pixels: what the published lengths hold at
CLOUDS: Final = 2048  # side of the published clouds at that width, pixels
GATE: Final = 32  # rows of the map that lets more rain through here than there


def paper_shift(batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec]) -> Result:
    """snow, rain, fog, sunlight or motion_blur as published."""
    shown = {"snow": _snow, "rain": _rain, "fog": _fog, "sunlight": _sun, "motion_blur": _blur}
    return shown[specs[0].name](batch, frames, specs)


def _draws(spec: ShiftSpec, frame: Frame) -> np.random.Generator:
    return spec.generator("paper", frame.scene, frame.sample, frame.camera.channel)


def _places(scale: float) -> int:
    """Places along a side of each pixel whose mean a layer takes: a smaller picture averages what it shows."""
    return max(1, round(1 / scale))


def _snow(batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec]) -> Result:
    """ImageNet-C's snow, then 30 % grey and a darker image at any severity."""
    scale = batch.width / WIDTH
    rows = [table.PAPER_SNOW[spec.severity - 1] for spec in specs]
    mean, deviation, zoom, threshold, radius, sigma, keep = zip(*rows, strict=True)
    angle = np.array([_draws(s, f).uniform(-135, -45) for s, f in zip(specs, frames, strict=True)])
    steps, shapes = [], []
    for z in zoom:  # as scipy.ndimage.zoom aligns first and last cells with first and last pixels
        count = [int(np.ceil(round(side / scale) / z)) for side in (batch.height, batch.width)]
        steps.append([max(n - 1, 0) / max(round(n * z) - 1, 1) for n in count])
        shapes.append([n + 1 for n in count])
    small = (batch.count, *np.max(shapes, axis=0).tolist())
    noise = wp.empty(small, dtype=float, device=batch.device)
    keys = file_keys(batch, specs, frames, "paper")
    inputs = [keys, on(batch, mean), on(batch, deviation), on(batch, unit_normal())]
    batch.launch(falling.specks, small[:2], inputs, noise)
    # flakes fall steeply: half the rows lose nothing
    half = (batch.count, -(-batch.height // 2))
    field, layer = (wp.empty((*half, batch.width), dtype=float, device=batch.device) for _ in range(2))
    inputs = [noise, on(batch, steps, wp.vec2), on(batch, threshold), scale, _places(scale), batch.height]
    batch.launch(falling.flakes, half, inputs, field)
    # half a gaussian over 2 radius + 1 published pixels, where it is more than nothing
    offsets, weights = [], []
    for a, r, deviate in zip(np.radians(angle), radius, sigma, strict=True):
        reach = np.arange(0, min(2 * r + 1, 3.5 * deviate) * scale, 2.0)
        offsets.append(np.rint(np.outer(reach, [np.cos(a), -np.sin(a) / 2])))
        weights.append(np.exp(-(reach**2) / (2 * (deviate * scale) ** 2)))
    taps = -(-max(len(w) for w in weights) // 4) * 4
    offset, weight = np.zeros((batch.count, taps, 2), np.int32), np.zeros((batch.count, taps), np.float32)
    for b, (o, w) in enumerate(zip(offsets, weights, strict=True)):
        offset[b, : len(o)], weight[b, : len(w)] = o, w / w.sum()
    inputs = [field.flatten(), on(batch, offset, wp.vec2i), on(batch, weight), half[1], batch.width]
    batch.launch(falling.streaks, half, inputs, layer.flatten())
    dim = (batch.count, batch.height)
    out, highest = batch.like(), wp.empty(dim, dtype=int, device=batch.device)
    inputs = [
        batch.words(),
        layer.flatten(),
        on(batch, keep),
        table.PAPER_GREY,
        batch.height,
        batch.width,
        batch.stride // 4,
        highest,
    ]
    batch.launch(falling.blend_snow, dim, inputs, out.words())
    _darken(out, highest)
    return out, [Applied(True, {"angle_deg": round(float(a), 1)}) for a in angle]


def _rain(batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec]) -> Result:
    """One layer of imgaug's rain, then 30 % grey and a darker image at any severity.

    Streaks of 64 to 320 pixels, so faint that they make a veil: this is what the published parameters give at 1600.
    """
    scale = batch.width / WIDTH
    gates = np.empty((batch.count, GATE, 2 * GATE), np.float32)
    density, streaks, length, drawn, seen, first = [], [], [], [], [], []
    for b, (spec, frame) in enumerate(zip(specs, frames, strict=True)):
        draws = _draws(spec, frame)
        density.append(draws.uniform(*table.PAPER_RAIN[spec.severity - 1]))
        cells = 1.0 - draws.uniform(0.4, 0.6)  # cells a published pixel
        angle = draws.uniform(-15, 15)
        speed = draws.uniform(0.04, 0.20)
        uneven = 1.0 - draws.uniform(0.8, 1.0)
        rough = draws.beta(1.0, max(uneven, 1e-6), (8, 8)).astype(np.float32)
        gates[b] = cv2.resize(rough, (2 * GATE, GATE), interpolation=cv2.INTER_CUBIC).clip(0, 1)
        lean = np.tan(np.radians(angle))
        streaks.append(speed * max(batch.height, batch.width))
        rows = max(2, round(streaks[-1] / scale * np.cos(np.radians(angle)) * cells))
        height = int(batch.height / scale * cells) + 3 + rows
        left = max(0.0, lean) * height + 1  # columns to the left of the picture, at its first row
        length.append(rows)
        across, along = (2 * GATE) * scale / (cells * batch.width), GATE * scale / (cells * batch.height)
        drawn.append([across, lean * across, -left * across, along])
        seen.append([cells / scale, -lean, left])
        first.append(rows)
    inputs = [file_keys(batch, specs, frames, "paper"), on(batch, density)]
    most = 0.6 / scale
    rows, columns = int(batch.height * most) + 3 + max(length), int(batch.width * most) + 4
    shape = (batch.count, rows, columns + int(np.ceil(rows * np.tan(np.radians(15)))))
    salt, layer = (wp.empty(shape, dtype=float, device=batch.device) for _ in range(2))
    inputs += [on(batch, drawn, wp.vec4), on(batch, first), on(batch, gates)]
    batch.launch(falling.drops, shape[:2], inputs, salt)
    sums = [wp.zeros((batch.count, shape[2]), dtype=float, device=batch.device) for _ in range(2)]
    # the source enlarges with cubic splines and cuts off what is negative: so much more light in the mean (measured)
    gain = [1.28 - 0.95 * d + 0.9 * d**2 for d in density]
    # columns a thread: neighbours in memory, or as many threads as there can be
    block = 64 if batch.device == "cpu" else 1
    inputs = [salt, on(batch, length, wp.int32), on(batch, gain), block, *sums]
    dim = (batch.count, -(-shape[2] // block))
    batch.launch(falling.fall, dim, inputs, layer)
    dim = (batch.count, batch.height)
    hidden = wp.empty((*dim, batch.width), dtype=wp.uint8, device=batch.device)
    inputs = [layer, on(batch, seen, wp.vec3), on(batch, first), _places(scale)]
    batch.launch(falling.curtain, dim, inputs, hidden)
    out, highest = batch.like(), wp.empty(dim, dtype=int, device=batch.device)
    size = batch.count * batch.stride // 12
    parts = wp.array(ptr=hidden.ptr, dtype=wp.uint32, shape=size, device=batch.device)
    parts._keep = hidden  # the memory belongs to the bytes
    inputs = [batch.words(), parts, table.PAPER_GREY, batch.width, batch.stride // 4, highest]
    batch.launch(falling.blend_rain, dim, inputs, out.words())
    _darken(out, highest)
    told = zip(density, streaks, strict=True)
    return out, [Applied(True, {"density": round(float(d), 3), "streak_px": round(float(n))}) for d, n in told]


def _darken(out: Batch, highest: Any) -> None:
    """The brightest value becomes 0.7 of 256, the others in proportion, in place."""
    brightest = np.maximum(highest.numpy().max(1), 1)
    gain = np.rint(table.PAPER_DARK * 256 / brightest * 256).astype(np.int32)
    dim, words, chunk = out.chunks()
    out.launch(falling.darken, dim, [on(out, gain, wp.int32), words, chunk], out.words())


def _fog(batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec]) -> Result:
    """ImageNet-C's clouds without depth, then a share of grey. The clouds lack what is under 4 published pixels."""
    amount, decay, grey = zip(*[table.PAPER_FOG[s.severity - 1] for s in specs], strict=True)
    keys = file_keys(batch, specs, frames, "paper")
    size = CLOUDS // 4
    levels = size.bit_length() - 1
    # the source multiplies its wibble with itself: an octave is 1 / decay ** 2 of the one before
    wibble = on(batch, [[float(d) ** (-2 * level) for level in range(levels)] for d in decay])
    clouds = wp.zeros((batch.count, size, size), dtype=float, device=batch.device)
    for level in range(levels):
        for kernel in (layers.squares, layers.diamonds):
            wide = (batch.count, 1 << level, 1 << level)
            batch.launch(kernel, wide, [keys, wibble, level], clouds)
    ends = [wp.empty((batch.count, size), dtype=float, device=batch.device) for _ in range(2)]
    batch.launch(layers.extremes, (batch.count, size), [clouds], *ends)
    low, high = ends[0].numpy().min(1), ends[1].numpy().max(1)
    span = np.maximum(high - low, 1e-6)
    highest = wp.empty((batch.count, batch.height), dtype=int, device=batch.device)
    dim = (batch.count, batch.height)
    inputs = [batch.words(), batch.width * 3 // 4, batch.stride // 4]
    batch.launch(layers.brightest, dim, inputs, highest)
    most = highest.numpy().max(1) / 255
    out = batch.like()
    numbers = [on(batch, v) for v in (low, span, amount, most, grey)]
    inputs = [batch.data, clouds, *numbers, WIDTH / batch.width / 4, batch.width, batch.stride]
    batch.launch(layers.blend_clouds, dim, inputs, out.data)
    return out, [Applied(True, {"amount": float(a), "decay": float(d)}) for a, d in zip(amount, decay, strict=True)]


def _sun(batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec]) -> Result:
    """A white disc at a random place in every picture, and one faint disc on the line through it and the middle."""
    scale = batch.width / WIDTH
    suns, flares, colours, strengths, done = [], [], [], [], []
    for spec, frame in zip(specs, frames, strict=True):
        draws = _draws(spec, frame)
        x, y = draws.uniform(0.25, 0.75) * batch.width, draws.uniform(0.30, 0.45) * batch.height
        away = batch.width / 2 - x
        slope = (batch.height / 2 - y) / (away if abs(away) > 1e-6 else 1e-6)
        line = np.arange(0, batch.width, 10 * scale)
        line = line[(slope * (line - x) + y > 0) & (slope * (line - x) + y < batch.height)]
        share, strength, size = draws.uniform(), draws.uniform(0.2, 0.5), draws.uniform(1, max(batch.height / 15, 2))
        colours.append(draws.integers(205, 255, 3))
        strengths.append(strength)
        flare = line[int(share * max(len(line) - 1, 1))] if len(line) else 0.0
        flares.append([flare, slope * (flare - x) + y, size if len(line) else 0.0])
        suns.append([x, y, table.PAPER_SUN[spec.severity - 1] * scale])
        done.append(Applied(True, {"x": round(float(x)), "y": round(float(y)), "radius_px": float(suns[-1][2])}))
    out = batch.copy()
    numbers = [on(batch, values, wp.vec3) for values in (suns, flares, colours)]
    inputs = [batch.data, *numbers, on(batch, strengths), batch.width, batch.stride]
    dim = (batch.count, batch.height)
    batch.launch(layers.blend_sun, dim, inputs, out.data)
    return out, done


def _blur(batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec]) -> Result:
    """Front and back cameras: zoom blur; others: horizontal blur; put in where boxes are."""
    owner, done = owners(batch, frames, specs)
    lengths, zooms = np.zeros(batch.count, np.int32), np.zeros(batch.count, np.float32)
    for b, (spec, frame) in enumerate(zip(specs, frames, strict=True)):
        axis = frame.camera.to_ego[:3, 2]
        if abs(axis[0]) > 0.9:
            zooms[b] = table.PAPER_ZOOM[spec.severity - 1]
        else:
            lengths[b] = round(table.PAPER_KERNEL[spec.severity - 1] * batch.width)
    out = batch.copy()
    dim = (batch.count, batch.height)
    for kernel, values, kind in ((layers.smear_rows, lengths, wp.int32), (layers.zoom_blur, zooms, wp.float32)):
        inputs = [batch.data, owner, on(batch, values, kind), batch.stride]
        batch.launch(kernel, dim, inputs, out.data)
    return out, done
