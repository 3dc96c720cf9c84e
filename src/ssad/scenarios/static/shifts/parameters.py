"""Severity tables (index 0 is severity 1), each with the source of its figures.

[3DC] 3D_Corruptions_AD (Dong et al. 2023), [IC] imagecorruptions (Hendrycks and Dietterich 2019), [imgaug] imgaug's
RainLayer as 3DC calls it.
"""

from __future__ import annotations

from typing import Final

Five = tuple[float, float, float, float, float]

# ---- sensor noise, in both calibrations: standard deviation, half width, share of the values; full scale is 1. [IC]
GAUSSIAN: Final[Five] = (0.08, 0.12, 0.18, 0.26, 0.38)
UNIFORM: Final[Five] = (0.08, 0.12, 0.18, 0.26, 0.38)
IMPULSE: Final[Five] = (0.03, 0.06, 0.09, 0.17, 0.27)
# share of the impulses that are stuck pixels of the camera (physical)
STUCK: Final = 0.2

# ---- overexposure, in both calibrations: EV; 3.3 stops are ten times the light
OVEREXPOSURE: Final[Five] = (0.7, 1.3, 2.0, 2.7, 3.3)

# ---- anomaly, in both calibrations: what stands on each 40 m of the way, and from which severity on: 1, 2, 3, 4 and 6
# objects. m: length of such a piece of the way, where the first begins ahead of the first pose, how far the way goes on
# straight behind the last, how far objects stand beside it (a lane), where they are too far to be seen
ANOMALIES: Final = (
    ("debris", 1),
    ("animal", 2),
    ("overturned", 3),
    ("fallen_tree", 4),
    ("debris", 5),
    ("animal", 5),
)
ANOMALY_EVERY: Final = 40.0
ANOMALY_FIRST: Final = 8.0
ANOMALY_AHEAD: Final = 40.0
ANOMALY_ASIDE: Final = 3.5
ANOMALY_FARTHEST: Final = 80.0

# ---- weather, physical
# fog: meteorological optical range, m (5 % contrast, beta = 3 / range): extinctions .005 to .06 1/m of Hahner et al.
# 2021, which 3DC uses for LiDAR fog; so the twins agree
FOG_RANGE: Final[Five] = (600.0, 300.0, 150.0, 100.0, 50.0)
# rain: mm/h, from the border of light and moderate rain to a cloudburst (WMO: heavy above 10, violent above 50)
RAIN_RATE: Final[Five] = (2.5, 10.0, 25.0, 50.0, 100.0)
# snow: mm/h of water; visual range about 1 km / rate
SNOW_RATE: Final[Five] = (0.5, 1.5, 3.5, 7.0, 14.0)
# wet ground: share of its light that asphalt loses (albedo .75 to .5 of the dry one), and share under a film of water
WET_DARK: Final[Five] = (0.25, 0.32, 0.38, 0.44, 0.5)
WET_FILM: Final[Five] = (0.25, 0.4, 0.55, 0.7, 0.85)
# waves of the falling drops: tangent of the angle over which they blur what the water mirrors
WET_ROUGH: Final[Five] = (0.03, 0.045, 0.06, 0.075, 0.09)
# drops on the lens, from as many as a wiped lens has between two wipes
LENS_DROPS: Final = (4, 9, 16, 26, 40)
# sun: glare one degree from the sun, grey levels at full scale 255. In the eye a sun of 40,000 lx adds 400,000 cd/m2
# there (CIE: 10 E / theta^2), 40 times what is white by day: 10,000 grey levels. A clean lens scatters a sixtieth of
# that, a dirty windscreen as much
SUN_STRENGTH: Final[Five] = (150.0, 400.0, 1200.0, 3500.0, 10_000.0)
EXPOSURE: Final = 0.004  # s, by day
APERTURE: Final = 0.0025  # m

# ---- objects, physical: change of size, shear, turn (degrees), each of a random sign an instance; the figures of 3DC
SCALE: Final[Five] = (0.1, 0.2, 0.3, 0.4, 0.5)
SHEAR: Final[Five] = (0.05, 0.1, 0.15, 0.2, 0.25)
SHEAR_SPREAD: Final = 0.05
ROTATION: Final[Five] = (4.0, 8.0, 12.0, 16.0, 20.0)
ROTATION_SPREAD: Final = 2.0
# motion blur: exposure, s
BLUR_EXPOSURE: Final[Five] = (0.01, 0.02, 0.03, 0.045, 0.06)

# ---- paper
# snow [IC]: mean, deviation, zoom, threshold, blur radius, blur sigma, share of the image kept
PAPER_SNOW: Final = (
    (0.1, 0.3, 3.0, 0.5, 10.0, 4.0, 0.8),
    (0.2, 0.3, 2.0, 0.5, 12.0, 4.0, 0.7),
    (0.55, 0.3, 4.0, 0.9, 12.0, 8.0, 0.7),
    (0.55, 0.3, 4.5, 0.85, 12.0, 8.0, 0.65),
    (0.55, 0.3, 2.5, 0.85, 12.0, 12.0, 0.55),
)
# rain [imgaug]: least and largest density
PAPER_RAIN: Final = ((0.01, 0.06), (0.06, 0.10), (0.10, 0.15), (0.15, 0.20), (0.20, 0.25))
# fog [IC]: amplitude, decay of the octaves; then share of grey [3DC]
PAPER_FOG: Final = ((1.5, 2.0, 0.1), (2.0, 2.0, 0.2), (2.5, 1.7, 0.3), (2.5, 1.5, 0.4), (3.0, 1.4, 0.5))
# sunlight [3DC]: radius of the disc, pixels at a width of 1600
PAPER_SUN: Final[Five] = (30.0, 40.0, 50.0, 60.0, 70.0)
# motion blur [3DC]: zoom of front and back cameras; kernel over the image width of side cameras
PAPER_ZOOM: Final[Five] = (0.02, 0.04, 0.06, 0.08, 0.10)
PAPER_KERNEL: Final[Five] = (0.01, 0.02, 0.03, 0.04, 0.05)
# snow and rain end with grey and a darker image, whatever the severity [3DC]
PAPER_GREY: Final = 0.3
PAPER_DARK: Final = 0.7

# ---- LiDAR
# range noise, m, and share of points struck [3DC]
LIDAR_NOISE: Final[Five] = (0.02, 0.04, 0.06, 0.08, 0.10)
LIDAR_IMPULSE: Final[Five] = (1 / 30, 1 / 25, 1 / 20, 1 / 15, 1 / 10)
# sun: share of points whose range is noise of 2 m [3DC], half angle around the sun without returns, degrees
LIDAR_SUN: Final[Five] = (0.01, 0.02, 0.03, 0.04, 0.05)
LIDAR_SUN_CONE: Final[Five] = (2.0, 3.0, 4.0, 5.0, 6.0)
# rain and snow in the paper's LiDAR, mm/h [3DC, after LISA: Kilic et al. 2021]
PAPER_LIDAR_RATE: Final[Five] = (0.20, 0.73, 1.5625, 3.125, 7.29)
# objects in the paper's LiDAR: share along one axis, degrees +-1 [3DC]
PAPER_LIDAR_SCALE: Final[Five] = (0.04, 0.08, 0.12, 0.16, 0.20)
PAPER_LIDAR_ROTATION: Final[Five] = (1.0, 3.0, 5.0, 7.0, 9.0)


def rain_extinction(rate: float) -> float:
    """Return the extinction of light in rain of `rate` mm/h, 1/m (Carbonneau and Wisely 1998)."""
    # 1.07 rate^(2/3) dB/km; 0.2303 = ln(10) / 10 converts dB to nepers.
    return float(1.07 * rate ** (2 / 3) / 1000 * 0.2303)


def snow_extinction(rate: float) -> float:
    """Return the extinction in snow of `rate` mm/h of water, 1/m: a visual range of 1 km / rate."""
    return 3.0 * rate / 1000


def rain_slope(rate: float) -> float:
    """Return the exponent of the drop sizes, 1/mm; 8000 drops per m^3 and mm at diameter 0.

    Source: Marshall and Palmer 1948.
    """
    return float(4.1 * rate**-0.21)


def snow_slope(rate: float) -> float:
    """Return the exponent of the melted flake sizes, 1/mm (Sekhon and Srivastava 1970)."""
    return float(2.29 * rate**-0.45)
