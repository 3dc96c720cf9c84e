"""The transfer function of sRGB, and the weights of its luminance."""

from __future__ import annotations

import numpy as np
import pytest

from ssad.core.colours import ENCODED_TOE, LINEAR_TOE, LUMINANCE, linear_to_srgb, srgb_to_linear


def test_the_transfer_function_has_its_published_values() -> None:
    """A code of 188 is half of the light; the two branches meet."""
    assert linear_to_srgb(np.array([0.0, 0.002, 0.5, 1.0])) == pytest.approx([0.0, 0.02584, 0.73536, 1.0], abs=1e-5)
    for toe, function in ((LINEAR_TOE, linear_to_srgb), (ENCODED_TOE, srgb_to_linear)):
        below, above = function(np.array([toe, np.nextafter(toe, 1.0)]))
        assert above == pytest.approx(below, rel=1e-4)
    assert sum(LUMINANCE) == pytest.approx(1.0)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_one_function_is_the_inverse_of_the_other(dtype: type) -> None:
    codes = np.linspace(0.0, 1.0, 1001, dtype=dtype)
    linear = srgb_to_linear(codes)
    assert linear.dtype == dtype
    assert (np.diff(linear) > 0.0).all()
    np.testing.assert_allclose(linear_to_srgb(linear), codes, atol=1e-6)
