"""Sensor model from light to codes: lens, colour mosaic, noise, full photosites, colours and tones.

Constants shared by both engines: `ssad.rendering.camera.kernels.sensor` (Warp, for `render`) and
`ssad.rendering.camera.torch_sensor` (torch, with gradients). The chain is

1. light = radiance * exposure * white balance, scattered by the lens (`ssad.rendering.camera.glare`) and spread by it
   over 3 x 3 pixels;
2. one colour for each photosite (Bayer's RGGB, red at row 0 and column 0), or all three without a mosaic;
3. photon noise and read noise; then a full photosite holds no more;
4. the missing colours from the neighbours (Malvar, He and Cutler, ICASSP 2004);
5. saturation: colours nearer to their grey or farther from it;
6. linear light to codes: linear to 0.8, a soft shoulder above, then sRGB; then gamma and contrast.

Light is white-balanced from the start, so that the three colours are full together unless the balance is off.
Borders are mirrored at the outermost pixel, which keeps the order of the mosaic.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from ssad.core.errors import ConfigError

KNEE: Final = 0.8  # where the soft shoulder of the curve begins
SHOULDER: Final = 0.4  # how fast it bends
BRIGHTEST: Final = 4.0  # light at which the curve ends
DAY_EXPOSURE: Final = 0.5  # exposure on a clear day
READ_NOISE: Final = 0.2  # deviation without light, in parts of that at full light
WIDEST_BLUR: Final = 0.7  # px; three taps hold no wider spread without a ringing response
SMALLEST: Final = 4  # px along a side, so that borders can be mirrored
MOST_GLARE: Final = 3.0  # times the glare of the eye; beyond it, hardly any light would reach its pixel
MOST_FLARE: Final = 100.0  # reflections of 5 % in place of 0.5 %, as of uncoated glass
EVERYWHERE: Final = 1 << 20  # px, more than any image has


@dataclass(frozen=True, slots=True)
class SensorModel:
    """Conversion of light into codes by a camera.

    Attributes:
        blur: Standard deviation of the lens's point spread along an axis in px, 0 to 0.7.
        mosaic: Whether each photosite has one colour (RGGB), so that the others come from its neighbours.
        noise: Deviation at full light (1.0) by day; 0.01 is typical of a good camera. Its variance grows with
            the light (photons); a fifth of the deviation remains without light (reading). It grows where the
            exposure must, at night.
        full: Exposed light at which a photosite is full, above 0 and at most 4; 1.0 without the soft shoulder
            would be white.

    Raises:
        ConfigError: A value is outside its range.
    """

    blur: float = 0.5
    mosaic: bool = True
    noise: float = 0.0
    full: float = BRIGHTEST
    glare: float = 0.0
    flare: float = 0.0
    focal: float = 1.1
    balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    saturation: float = 1.0
    gamma: float = 1.0
    contrast: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.blur <= WIDEST_BLUR:
            raise ConfigError(f"a blur of {self.blur} px: it must be in 0..{WIDEST_BLUR}")
        if not (math.isfinite(self.noise) and self.noise >= 0):
            raise ConfigError(f"a noise of {self.noise}: it must be a finite number of at least 0")
        if not 0 < self.full <= BRIGHTEST:
            raise ConfigError(f"photosites full at {self.full}: it must be above 0 and at most {BRIGHTEST:g}")
        if not 0 <= self.glare <= MOST_GLARE or not 0 <= self.flare <= MOST_FLARE:
            raise ConfigError(
                f"a glare of {self.glare} and a flare of {self.flare}: "
                f"they must be in 0..{MOST_GLARE:g} and 0..{MOST_FLARE:g}"
            )
        if not (math.isfinite(self.focal) and self.focal > 0):
            raise ConfigError(f"a focal length of {self.focal} widths: it must be a finite number above 0")
        if not all(0 < factor < math.inf for factor in self.balance):
            raise ConfigError(f"a white balance of {self.balance}: it must be three finite factors above 0")
        if not 0 <= self.saturation <= 2 or not 0.2 <= self.gamma <= 5 or not -0.5 <= self.contrast <= 0.9:
            raise ConfigError(
                f"a saturation of {self.saturation}, a gamma of {self.gamma} and a contrast of {self.contrast}: "
                "they must be in 0..2, 0.2..5 and -0.5..0.9"
            )

    @property
    def tone(self) -> tuple[float, float]:
        """Gamma and contrast."""
        return self.gamma, self.contrast

    @property
    def scatters(self) -> bool:
        """True if light reaches pixels far from its own."""
        return self.glare > 0 or self.flare > 0

    @property
    def reach(self) -> int:
        """Distance in px at which the light of a pixel can change a code."""
        if self.scatters:
            return EVERYWHERE
        return (1 if self.blur > 0 else 0) + (2 if self.mosaic else 0)

    def check_size(self, height: int, width: int) -> None:
        """Reject images in which a photosite lacks the neighbours of its missing colours.

        Args:
            height: Pixels.
            width: Pixels.

        Raises:
            ConfigError: The image is too small.
        """
        if self.reach and min(height, width) < SMALLEST:
            raise ConfigError(
                f"a picture of {width} x {height}: lens and mosaic need {SMALLEST} pixels along each side"
            )


DEFAULT_SENSOR: Final = SensorModel()
PINHOLE: Final = SensorModel(blur=0.0, mosaic=False)  # its image is the curve of the light


def point_spread(blur: float) -> tuple[float, float]:
    """Return the weights of the lens along an axis. Their variance is exactly that of the point spread.

    Args:
        blur: Standard deviation, px.

    Returns:
        Weight of the pixel itself, and of each of its two neighbours.
    """
    return 1.0 - blur**2, 0.5 * blur**2


def noise_levels(noise: float, exposure: float) -> tuple[float, float]:
    """Return the parameters of the noise: variance = photons * light + dark**2.

    Beyond the exposure of a clear day, half of the additional exposure (in stops) is a longer shutter, which
    adds no noise, and half is gain.

    Args:
        noise: Deviation at full light by day.
        exposure: Factor of the radiance.

    Returns:
        Variance for a unit of exposed light, and the deviation without light.
    """
    gain = max(exposure / DAY_EXPOSURE, 1.0) ** 0.5
    return noise**2 * gain, READ_NOISE * noise * gain


Taps = tuple[tuple[float, ...], ...]

# Malvar, He and Cutler: a missing colour is the mean of its neighbours, corrected by how the colour of the site
# differs from its own neighbours; eighths, rows from above
GREEN: Final[Taps] = (
    (0, 0, -1, 0, 0),
    (0, 0, 2, 0, 0),
    (-1, 2, 4, 2, -1),
    (0, 0, 2, 0, 0),
    (0, 0, -1, 0, 0),
)
ALONG: Final[Taps] = (  # red or blue at green, neighbours of that colour left and right
    (0, 0, 0.5, 0, 0),
    (0, -1, 0, -1, 0),
    (-1, 4, 5, 4, -1),
    (0, -1, 0, -1, 0),
    (0, 0, 0.5, 0, 0),
)
ACROSS: Final[Taps] = tuple(zip(*ALONG, strict=True))  # neighbours of that colour above and below
OPPOSITE: Final[Taps] = (  # red at blue, blue at red
    (0, 0, -1.5, 0, 0),
    (0, 2, 0, 2, 0),
    (-1.5, 0, 6, 0, -1.5),
    (0, 2, 0, 2, 0),
    (0, 0, -1.5, 0, 0),
)


SENSOR: Final = SensorModel(noise=0.012)
"""The sensor of recorded datasets and of cameras in the loop."""
