"""Bounds of depth in shadow maps: NumPy and the kernels agree."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from ssad.core.seeding import generator
from ssad.rendering.camera.kernels import shadow
from ssad.rendering.camera.visibility import block_depths


@pytest.mark.parametrize(("count", "block"), [(5, 4), (33, 8)])
def test_bounds_of_a_shadow_map_equal_those_of_the_kernels(count: int, block: int) -> None:
    draws = generator("bounds of shadow maps", block)
    size = count * block
    depths = draws.uniform(0.5, 1.5, (2, size, size)).astype(np.float32)
    keys = depths.view(np.uint32).astype(np.uint64) << np.uint64(32) | draws.integers(0, 2**32, depths.shape, np.uint64)
    keys[:, : size // 2, : size // 2] = 0
    bounds = block_depths(keys, block)
    blocks, expected = (wp.empty((2, count, count), dtype=wp.vec2, device="cpu") for _ in range(2))
    texels = wp.array(keys, dtype=wp.uint64, device="cpu")
    dim = (2, count, 1)
    wp.launch(shadow.gather_blocks, dim=dim, inputs=[texels, block, 1], outputs=[blocks], device="cpu")
    wp.launch(shadow.join_blocks, dim=dim, inputs=[blocks, 1], outputs=[expected], device="cpu")
    assert (bounds == expected.numpy()).all()
    assert bounds[0, 0, 0].tolist() == [0.0, 0.0]
    assert 0.5 <= bounds[1, -1, -1, 1] < bounds[1, -1, -1, 0] < 1.5
