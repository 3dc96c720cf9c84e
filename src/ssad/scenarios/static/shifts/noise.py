"""Sensor noise: uniform, gaussian, impulse.

Noise is independent from file to file (key: the sample's) and from value to value. Gaussian and uniform noise look up
the inverse distribution function with 16 bits; the paper's calibration truncates sums as ImageNet-C does (0.5 grey
levels darker in the mean), the physical one rounds. Values are clipped to 0..255 after the sum.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from statistics import NormalDist

import numpy as np
import numpy.typing as npt
import warp as wp

from ssad.core.frames import Applied, Frame
from ssad.scenarios.static.shifts.batch import Batch, file_keys, keys_on, on
from ssad.scenarios.static.shifts.kernels import noise as kernels
from ssad.scenarios.static.shifts.parameters import GAUSSIAN, IMPULSE, STUCK, UNIFORM
from ssad.scenarios.static.shifts.spec import ShiftSpec


@lru_cache(maxsize=1)
def unit_normal() -> npt.NDArray[np.float64]:
    """Inverse distribution function of the unit normal at 65,536 midpoints, symmetric, of unit deviation."""
    inverse = NormalDist().inv_cdf
    upper = np.array([inverse(0.5 + (i + 0.5) / 65536) for i in range(32768)])
    table = np.concatenate([-upper[::-1], upper])
    return np.asarray(table / table.std())


@lru_cache(maxsize=32)
def noise_table(name: str, severity: int, calibration: str) -> npt.NDArray[np.int16]:
    """int16 [65536]: grey levels to add for a uniform 16-bit number."""
    level = 255.0 * (GAUSSIAN if name == "gaussian" else UNIFORM)[severity - 1]
    values = level * (unit_normal() if name == "gaussian" else (np.arange(65536) + 0.5) / 32768 - 1)
    rounded = np.floor(values) if calibration == "paper" else np.rint(values)
    return rounded.astype(np.int16)


def add_noise(batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec]) -> tuple[Batch, list[Applied]]:
    """Noise `uniform` or `gaussian`."""
    out = batch.like()
    dim, words, chunk = batch.chunks()
    keys = file_keys(batch, specs, frames, "noise")
    tables = np.stack([noise_table(spec.name, spec.severity, spec.calibration) for spec in specs])
    inputs = [batch.words(), keys, on(batch, tables, wp.int16), words, chunk]
    batch.launch(kernels.add_noise, dim, inputs, out.words())
    scale = {"gaussian": GAUSSIAN, "uniform": UNIFORM}
    return out, [Applied(True, {"level": scale[s.name][s.severity - 1]}) for s in specs]


def add_impulses(batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec]) -> tuple[Batch, list[Applied]]:
    """impulse: of the share p of all values, a fifth is stuck at the same sites of a camera (physical)."""
    out = batch.like()
    dim, words, chunk = batch.chunks()
    share = [IMPULSE[s.severity - 1] for s in specs]
    stuck = [p * STUCK if s.calibration == "physical" else 0.0 for p, s in zip(share, specs, strict=True)]
    # the two draws overlap: 1 - (1 - fresh)(1 - fixed) = share
    fresh = [1 - (1 - p) / (1 - q) for p, q in zip(share, stuck, strict=True)]
    keys = file_keys(batch, specs, frames, "noise")
    fixed_keys = keys_on(batch, [s.key("stuck", f.camera.channel) for s, f in zip(specs, frames, strict=True)])
    rates = [on(batch, [round(p * 32768) * 2 for p in shares], wp.int32) for shares in (fresh, stuck)]
    inputs = [batch.words(), keys, fixed_keys, *rates, words, chunk]
    batch.launch(kernels.add_impulses, dim, inputs, out.words())
    return out, [Applied(True, {"share": p, "stuck": q}) for p, q in zip(share, stuck, strict=True)]
