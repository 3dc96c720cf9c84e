"""Sensor noise: uniform, gaussian, impulse.

Noise is independent between files (by the sample's key) and between values. Gaussian and uniform noise look up the
inverse distribution function with 16 bits; the paper's calibration truncates sums as ImageNet-C does (0.5 grey levels
darker in the mean), the physical one rounds. Values are clipped to 0..255 after the sum.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from statistics import NormalDist

import numpy as np
import numpy.typing as npt
import warp as wp

from ssad.core.frames import Frame, ShiftReport
from ssad.scenarios.static.shifts.batch import Batch, file_keys, keys_on, to_device
from ssad.scenarios.static.shifts.kernels import noise as kernels
from ssad.scenarios.static.shifts.parameters import GAUSSIAN, IMPULSE, STUCK, UNIFORM
from ssad.scenarios.static.shifts.spec import ShiftSpec


@lru_cache(maxsize=1)
def unit_normal() -> npt.NDArray[np.float64]:
    """Inverse distribution function of the unit normal at 65,536 midpoints, symmetric, of unit deviation."""
    inverse_cdf = NormalDist().inv_cdf
    positive_half = np.array([inverse_cdf(0.5 + (index + 0.5) / 65536) for index in range(32768)])
    table = np.concatenate([-positive_half[::-1], positive_half])
    return np.asarray(table / table.std())


@lru_cache(maxsize=32)
def noise_table(name: str, severity: int, calibration: str) -> npt.NDArray[np.int16]:
    """Return int16 [65536]: the grey levels to add for a uniform 16-bit number."""
    level = 255.0 * (GAUSSIAN if name == "gaussian" else UNIFORM)[severity - 1]
    values = level * (unit_normal() if name == "gaussian" else (np.arange(65536) + 0.5) / 32768 - 1)
    rounded = np.floor(values) if calibration == "paper" else np.rint(values)
    return rounded.astype(np.int16)


def add_noise(batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec]) -> tuple[Batch, list[ShiftReport]]:
    """Add `uniform` or `gaussian` noise."""
    result = batch.empty_like()
    thread_shape, word_count, chunk_size = batch.chunks()
    keys = file_keys(batch, specs, frames, "noise")
    tables = np.stack([noise_table(spec.name, spec.severity, spec.calibration) for spec in specs])
    inputs = [batch.words(), keys, to_device(batch, tables, wp.int16), word_count, chunk_size]
    batch.launch(kernels.add_noise, thread_shape, inputs, result.words())
    levels = {"gaussian": GAUSSIAN, "uniform": UNIFORM}
    return result, [
        ShiftReport(True, {"level": levels[image_spec.name][image_spec.severity - 1]}) for image_spec in specs
    ]


def add_impulses(batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec]) -> tuple[Batch, list[ShiftReport]]:
    """Add impulse noise; in the physical calibration a fifth of it is stuck at fixed sites of a camera."""
    result = batch.empty_like()
    thread_shape, word_count, chunk_size = batch.chunks()
    total_shares = [IMPULSE[spec.severity - 1] for spec in specs]
    stuck_shares = [
        share_value * STUCK if spec.calibration == "physical" else 0.0
        for share_value, spec in zip(total_shares, specs, strict=True)
    ]
    # the two draws overlap: 1 - (1 - fresh) (1 - stuck) = share
    fresh_shares = [
        1 - (1 - share_value) / (1 - stuck_value)
        for share_value, stuck_value in zip(total_shares, stuck_shares, strict=True)
    ]
    keys = file_keys(batch, specs, frames, "noise")
    fixed_keys = keys_on(
        batch, [spec.key("stuck", frame.camera.channel) for spec, frame in zip(specs, frames, strict=True)]
    )
    rates = [
        to_device(batch, [round(share_value * 32768) * 2 for share_value in shares], wp.int32)
        for shares in (fresh_shares, stuck_shares)
    ]
    inputs = [batch.words(), keys, fixed_keys, *rates, word_count, chunk_size]
    batch.launch(kernels.add_impulses, thread_shape, inputs, result.words())
    return result, [
        ShiftReport(True, {"share": share_value, "stuck": stuck_value})
        for share_value, stuck_value in zip(total_shares, stuck_shares, strict=True)
    ]
