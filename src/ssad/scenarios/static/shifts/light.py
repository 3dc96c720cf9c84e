"""From sRGB codes to linear light and back, as whole numbers in tables.

Light adds up in the air, the lens and the sensor, so what mixes light does it in linear light; a picture holds codes.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import warp as wp

from ssad.core.types import F64, U8
from ssad.scenarios.static.shifts.kernels.light import CODES, FULL


def to_linear(codes: Any) -> F64:
    """Linear light, 1 for white, of sRGB codes in 0..255."""
    share = np.asarray(codes, np.float64) / 255
    return np.where(share <= 0.04045, share / 12.92, ((np.maximum(share, 0.04045) + 0.055) / 1.055) ** 2.4)


def to_codes(light: Any) -> F64:
    """Linear light in 0..1 as sRGB codes in 0..255, not rounded."""
    given = np.asarray(light, np.float64)
    return 255 * np.where(given <= 0.0031308, given * 12.92, 1.055 * np.maximum(given, 0.0031308) ** (1 / 2.4) - 0.055)


def code_table() -> U8:
    """The codes of `CODES` equal parts of linear light, each of its middle."""
    return np.rint(to_codes((np.arange(CODES) + 0.5) / CODES)).astype(np.uint8)


@lru_cache(maxsize=16)
def tables(device: str) -> tuple[Any, Any]:
    """On a device: light (`FULL` is white) of each code, int32 [256], and the codes of `CODES` parts of it, uint8."""
    linear = np.rint(to_linear(np.arange(256)) * FULL).astype(np.int32)
    return wp.array(linear, dtype=wp.int32, device=device), wp.array(code_table(), dtype=wp.uint8, device=device)
