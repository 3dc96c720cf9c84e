"""The paper's calibration of weather, sun and motion blur: layers over a picture, with the published parameters.

Each picture by itself: nothing agrees between cameras, and depth plays no part. Written from the published
descriptions (Hendrycks and Dietterich 2019; Dong et al. 2023): equal in distribution, not in bits. Where the sources
scale nothing, lengths in pixels hold at a width of 1600 and scale with the width.
"""

from __future__ import annotations

from collections.abc import Sequence
from statistics import NormalDist
from typing import Any

import numpy as np
import warp as wp

from ssad.frames import Applied, Frame
from ssad.scenarios.static.shifts import parameters as table
from ssad.scenarios.static.shifts.batch import Batch, keys_on, on
from ssad.scenarios.static.shifts.depth import grid_size
from ssad.scenarios.static.shifts.kernels import layers, veil
from ssad.scenarios.static.shifts.noise import unit_normal
from ssad.scenarios.static.shifts.objects import owners
from ssad.scenarios.static.shifts.spec import ShiftSpec

Result = tuple[Batch, list[Applied]]


def paper_shift(batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec]) -> Result:
    """snow, rain, fog, sunlight or motion_blur as published."""
    name = specs[0].name
    if name == "motion_blur":
        return _blur(batch, frames, specs)
    if name == "fog":
        return _fog(batch, frames, specs)
    if name == "sunlight":
        return _sun(batch, frames, specs)
    return _falling(batch, frames, specs)


def _draws(spec: ShiftSpec, frame: Frame) -> np.random.Generator:
    return spec.generator("paper", frame.scene, frame.sample, frame.camera.channel)


def _key(spec: ShiftSpec, frame: Frame) -> int:
    return spec.key("paper", frame.scene, frame.sample, frame.camera.channel)


def _falling(batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec]) -> Result:
    """Snow: ImageNet-C's; rain: drops as imgaug's RainLayer; then 30 % grey and a darker image at any severity."""
    rows: list[dict[str, float]] = []
    done = []
    for spec, frame in zip(specs, frames, strict=True):
        draws = _draws(spec, frame)
        if spec.name == "snow":
            mean, deviation, zoom, threshold, radius, sigma, keep = table.PAPER_SNOW[spec.severity - 1]
            angle = np.radians(draws.uniform(-135, -45))
            taps = radius + 1
        else:
            low, high = table.PAPER_RAIN[spec.severity - 1]
            density = draws.uniform(low, high)
            size = draws.uniform(0.4, 0.6)
            speed = draws.uniform(0.04, 0.20)
            # a share `density` of the cells is wet; a drop is as large as size says, its streak as long as speed says
            mean, deviation, keep = 0.4, 0.2, 1.0
            threshold = NormalDist(mean, deviation).inv_cdf(1 - density)
            zoom, angle = 2.0 + 4.0 * (1.0 - size), np.radians(-90 + draws.uniform(-15, 15))
            taps = max(4.0, speed * batch.height / 4)
            sigma = taps / 2
        scale = batch.width / 1600
        rows.append(
            {
                "mean": mean, "deviation": deviation, "zoom": zoom, "threshold": threshold, "keep": keep,
                "taps": max(2, round(taps * scale / 2) + 1), "sigma": max(sigma * scale / 2, 0.5),
                "dx": np.cos(angle), "dy": -np.sin(angle),
            }
        )  # fmt: skip
        done.append(Applied(True, {"angle_deg": round(float(np.degrees(angle)), 1)}))

    def column(name: str) -> Any:
        return on(batch, np.array([row[name] for row in rows], np.float32), wp.float32)

    half = (batch.count, -(-batch.height // 2), -(-batch.width // 2))
    least = min(row["zoom"] for row in rows)
    small = (batch.count, int(batch.height / least) + 2, int(batch.width / least) + 2)
    device = batch.device
    noise, field, layer = (wp.empty(shape, dtype=float, device=device) for shape in (small, half, half))
    numbers = [_key(s, f) for s, f in zip(specs, frames, strict=True)]
    normal = on(batch, unit_normal().astype(np.float32), wp.float32)
    inputs = [keys_on(batch, numbers), column("mean"), column("deviation"), normal]
    wp.launch(layers.specks, dim=small[:2], inputs=inputs, outputs=[noise], device=device)
    inputs = [noise, column("zoom"), column("threshold")]
    wp.launch(layers.enlarge, dim=half[:2], inputs=inputs, outputs=[field], device=device)
    # at most 12 cells a streak: it is smooth along itself
    every = np.arange(max(int(row["taps"]) for row in rows)).astype(float)
    cells = every[:: -(-len(every) // 12)]
    steps = np.array([[row["dx"], row["dy"]] for row in rows])
    offsets = np.rint(steps[:, None] * cells[None, :, None]).astype(np.int32)
    weights = np.stack(
        [np.where(cells < row["taps"], np.exp(-(cells**2) / (2 * row["sigma"] ** 2)), 0) for row in rows]
    )
    weights /= weights.sum(1, keepdims=True)
    inputs = [field, on(batch, offsets, wp.vec2i), on(batch, weights.astype(np.float32), wp.float32)]
    wp.launch(layers.streaks, dim=half[:2], inputs=inputs, outputs=[layer], device=device)
    out = batch.like()
    highest = wp.empty((batch.count, batch.height), dtype=int, device=batch.device)
    wp.launch(
        layers.blend_layer,
        dim=(batch.count, batch.height),
        inputs=[batch.data, layer, column("keep"), table.PAPER_GREY, batch.height, batch.width, batch.stride, highest],
        outputs=[out.data],
        device=batch.device,
    )
    brightest = np.maximum(highest.numpy().max(1), 1)
    gain = np.rint(table.PAPER_DARK * 255 / brightest * 256).astype(np.int32)
    words = batch.stride // 4
    chunk = max(256, batch.width * 3 // 4)
    wp.launch(
        layers.darken,
        dim=(batch.count, -(-words // chunk)),
        inputs=[on(batch, gain, wp.int32), words, chunk],
        outputs=[out.words()],
        device=batch.device,
    )
    return out, done


def _fog(batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec]) -> Result:
    """ImageNet-C's clouds without depth, then a share of grey."""
    rows, columns = grid_size(batch)
    clouds = wp.empty((batch.count, rows, columns), dtype=float, device=batch.device)
    amount, decay, grey = (
        np.array(v, np.float32) for v in zip(*[table.PAPER_FOG[s.severity - 1] for s in specs], strict=True)
    )
    keys = keys_on(batch, [_key(s, f) for s, f in zip(specs, frames, strict=True)])
    wp.launch(
        layers.plasma,
        dim=(batch.count, rows),
        inputs=[keys, on(batch, decay, wp.float32)],
        outputs=[clouds],
        device=batch.device,
    )
    values = clouds.numpy().reshape(batch.count, -1)
    low, span = values.min(1), np.maximum(np.ptp(values, axis=1), 1e-6)
    highest = wp.empty((batch.count, batch.height), dtype=int, device=batch.device)
    dim = (batch.count, batch.height)
    inputs = [batch.data, batch.width, batch.stride]
    wp.launch(layers.brightest, dim=dim, inputs=inputs, outputs=[highest], device=batch.device)
    most = highest.numpy().max(1) / 255
    out = batch.like()
    numbers = [on(batch, np.asarray(v, np.float32), wp.float32) for v in (low, span, amount, most, grey)]
    wp.launch(
        layers.blend_clouds,
        dim=(batch.count, batch.height),
        inputs=[batch.data, clouds, *numbers, batch.height, batch.width, batch.stride],
        outputs=[out.data],
        device=batch.device,
    )
    return out, [Applied(True, {"amount": float(a), "decay": float(d)}) for a, d in zip(amount, decay, strict=True)]


def _sun(batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec]) -> Result:
    """A white disc at a random place in every picture, and one circle of flare."""
    rows, columns = grid_size(batch)
    centre, radius = np.zeros((batch.count, 4), np.float32), np.zeros(batch.count, np.float32)
    done = []
    for b, (spec, frame) in enumerate(zip(specs, frames, strict=True)):
        draws = _draws(spec, frame)
        x, y = draws.uniform(0.25, 0.75) * batch.width, draws.uniform(0.30, 0.45) * batch.height
        far = draws.uniform(0.3, 0.9)
        centre[b] = x, y, batch.width / 2 - (x - batch.width / 2) * far, batch.height / 2 - (y - batch.height / 2) * far
        radius[b] = table.PAPER_SUN[spec.severity - 1] * batch.width / 1600
        done.append(Applied(True, {"x": round(float(x)), "y": round(float(y)), "radius_px": float(radius[b])}))
    light = wp.empty((batch.count, rows, columns), dtype=float, device=batch.device)
    wp.launch(
        layers.disc,
        dim=light.shape,
        inputs=[on(batch, centre, wp.vec4), on(batch, radius, wp.float32)],
        outputs=[light],
        device=batch.device,
    )
    out = batch.like()
    wp.launch(
        veil.blend_glare,
        dim=(batch.count, batch.height),
        inputs=[
            batch.words(),
            light,
            on(batch, np.ones((batch.count, 3), np.float32), wp.vec3),
            on(batch, np.ones(batch.count, np.float32), wp.float32),
            batch.width,
            batch.stride // 4,
        ],
        outputs=[out.words()],
        device=batch.device,
    )
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
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=[out.data], device=batch.device)
    return out, done
