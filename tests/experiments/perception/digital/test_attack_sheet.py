"""Tiles of the sheet of digital attacks."""

from __future__ import annotations

import numpy as np

from ssad.experiments.perception.digital.attack_sheet import _shrunk
from ssad.experiments.perception.sheets import WIDTH


def test_a_tile_keeps_the_shape_of_its_image_and_noise_stays_noise() -> None:
    image = (255 * np.random.default_rng(0).integers(0, 2, (2 * WIDTH, 4 * WIDTH))).astype(np.uint8)
    tile = _shrunk(np.repeat(image[..., None], 3, 2), "clean")
    assert tile.shape == (WIDTH // 2, WIDTH, 3)
    below = tile[WIDTH // 4 :]
    assert set(np.unique(below)) == {0, 255}, "an average would be grey"
    assert 0.45 < (below == 255).mean() < 0.55
