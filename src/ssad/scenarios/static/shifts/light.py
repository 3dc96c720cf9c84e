"""Conversion from sRGB codes to linear light and back, with integer tables.

Light adds up in the air, the lens and the sensor, so mixing is done in linear light; images hold codes.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import warp as wp

from ssad.core.colours import linear_to_srgb, srgb_to_linear
from ssad.core.types import F64, U8
from ssad.scenarios.static.shifts.kernels.light import CODES, FULL


def to_linear(codes: Any) -> F64:
    """Return the linear light, 1 for white, of sRGB codes in 0..255."""
    light: F64 = srgb_to_linear(np.asarray(codes, np.float64) / 255)
    return light


def to_codes(light: Any) -> F64:
    """Return linear light in 0..1 as sRGB codes in 0..255, not rounded."""
    codes: F64 = 255 * linear_to_srgb(np.asarray(light, np.float64))
    return codes


def code_table() -> U8:
    """Return the codes of `CODES` equal intervals of linear light, each at its centre."""
    return np.rint(to_codes((np.arange(CODES) + 0.5) / CODES)).astype(np.uint8)


@lru_cache(maxsize=16)
def tables(device: str) -> tuple[Any, Any]:
    """Return two tables on a device: light (`FULL` is white) of each code, and codes of `CODES` parts of light."""
    linear = np.rint(to_linear(np.arange(256)) * FULL).astype(np.int32)
    return wp.array(linear, dtype=wp.int32, device=device), wp.array(code_table(), dtype=wp.uint8, device=device)
