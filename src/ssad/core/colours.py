"""Linear sRGB: its luminance and its transfer function (IEC 61966-2-1), which other modules share."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

LUMINANCE: Final = (0.2126, 0.7152, 0.0722)
"""Weights of linear red, green and blue in the luminance (ITU-R BT.709)."""

LINEAR_TOE: Final = 0.0031308
"""Linear value up to which the transfer function is a straight line."""

ENCODED_TOE: Final = 0.04045
"""Encoded value up to which it is a straight line."""


def srgb_to_linear(encoded: Any) -> Any:
    """Return linear values of sRGB values, both 1 for white; an array of the same floating type."""
    # Clamped, since `where` evaluates both branches.
    power = ((np.maximum(encoded, ENCODED_TOE) + 0.055) / 1.055) ** 2.4
    return np.where(encoded <= ENCODED_TOE, encoded / 12.92, power)


def linear_to_srgb(linear: Any) -> Any:
    """Return sRGB values of linear values: the inverse of `srgb_to_linear`."""
    power = 1.055 * np.maximum(linear, LINEAR_TOE) ** (1 / 2.4) - 0.055
    return np.where(linear <= LINEAR_TOE, linear * 12.92, power)
