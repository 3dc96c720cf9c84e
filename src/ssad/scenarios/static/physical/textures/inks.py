"""Printable colours: measured patches of offset printing on coated paper, for the non-printability score."""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np
import torch
from torch import Tensor

from ssad.rendering.camera.texture import PRINTABLE

TONES: Final = (0, 40, 70, 100)  # tone values of the patches, percent
# CIE XYZ (D50, 2 degrees, white backing; 100 is a perfect diffuser) of patches of cyan, magenta and yellow without
# black: a row of yellow from 0 to 100 % for each tone of magenta, and these for each tone of cyan.
# Source: Fogra, characterization data FOGRA39L (December 2006), offset printing after ISO 12647-2:2004/Amd 1 on coated
# paper, as distributed under the zlib licence in Debian's icc-profiles-free 2.0.1; 64 of its 1617 patches.
FOGRA39: Final = (
    (84.48, 87.62, 74.57),
    (76.49, 81.13, 38.69),
    (72.03, 77.05, 18.17),
    (69.17, 74.16, 7.04),
    (58.85, 50.57, 47.38),
    (53.79, 46.98, 24.87),
    (50.81, 44.59, 11.96),
    (48.7, 42.54, 4.77),
    (42.93, 29.06, 27.82),
    (40.24, 27.59, 15.11),
    (38.52, 26.49, 7.66),
    (37.2, 25.52, 3.25),
    (33.03, 16.79, 15.01),
    (31.94, 16.59, 8.47),
    (30.93, 16.27, 4.57),
    (30.2, 16.02, 2.3),
    (49.39, 56.18, 67.19),
    (42.88, 51.47, 34.29),
    (39.22, 48.18, 16.37),
    (37.09, 46.18, 6.79),
    (34.16, 32.42, 43.15),
    (30.21, 29.86, 22.62),
    (27.74, 27.97, 11.18),
    (26.11, 26.56, 4.83),
    (24.53, 18.22, 26.34),
    (22.27, 17.13, 14.45),
    (20.83, 16.3, 7.51),
    (19.63, 15.5, 3.46),
    (18.46, 10.09, 15.3),
    (17.34, 9.87, 8.64),
    (16.57, 9.67, 4.85),
    (15.91, 9.46, 2.57),
    (28.34, 36.45, 60.1),
    (23.04, 32.88, 30.85),
    (20.19, 30.55, 15.15),
    (18.75, 29.25, 6.73),
    (19.58, 20.99, 39.44),
    (16.41, 19.23, 21.01),
    (14.44, 17.84, 10.74),
    (13.39, 17.02, 5.01),
    (14.04, 11.79, 25.17),
    (12.06, 10.96, 13.97),
    (10.88, 10.39, 7.55),
    (10.16, 9.99, 3.82),
    (10.47, 6.38, 15.62),
    (9.25, 6.12, 9.01),
    (8.59, 5.99, 5.19),
    (8.05, 5.84, 2.88),
    (15.02, 22.93, 52.85),
    (10.96, 20.44, 27.08),
    (9, 19, 13.79),
    (8.16, 18.42, 6.74),
    (10.49, 13.38, 35.45),
    (7.86, 12.01, 18.89),
    (6.58, 11.32, 10.09),
    (5.92, 10.92, 5.13),
    (7.6, 7.58, 23.63),
    (5.92, 7, 13.21),
    (5.06, 6.67, 7.42),
    (4.58, 6.48, 4),
    (5.67, 4.1, 15.67),
    (4.52, 3.86, 9),
    (3.97, 3.79, 5.34),
    (3.66, 3.8, 3.13),
)
# from XYZ under D50 to linear sRGB, which is defined under D65: Bradford's adaptation, then IEC 61966-2-1 (Lindbloom)
D50_TO_SRGB: Final = (
    (3.1338561, -1.6168667, -0.4906146),
    (-0.9787684, 1.9161415, 0.0334540),
    (0.0719453, -0.2289914, 1.4052427),
)


@lru_cache(maxsize=1)
def printable_colours() -> Tensor:
    """Return the 64 colours [64, 3] in sRGB, 0 to 1, which `albedo_of` maps to the measured albedos.

    Colours outside the gamut of sRGB are moved to its border.
    """
    albedo = np.array(FOGRA39) / 100.0 @ np.array(D50_TO_SRGB).T
    darkest, brightest = PRINTABLE
    # Inverse of `printable`, which maps textures into the range of ink and paper.
    linear = ((albedo - darkest) / (brightest - darkest)).clip(0.0, 1.0)
    colour = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear.clip(1e-9) ** (1 / 2.4) - 0.055)
    return torch.from_numpy(colour.astype(np.float32))
