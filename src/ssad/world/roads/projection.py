"""Transverse Mercator projection of the WGS84 ellipsoid: UTM, and around an origin.

Source:
    Karney, Transverse Mercator with an accuracy of a few nanometers, Journal of Geodesy 85 (2011), equations 7 to 12
    and 35: Krüger's series to the sixth order of the third flattening.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ssad.core.types import F64

SEMI_MAJOR_AXIS = 6378137.0  # m
FLATTENING = 1.0 / 298.257223563
UTM_SCALE = 0.9996
FALSE_EASTING = 5.0e5  # m
FALSE_NORTHING = 1.0e7  # m, of the southern hemisphere
UTM_LATITUDES = (-80.0, 84.0)  # degrees

_N = FLATTENING / (2.0 - FLATTENING)  # third flattening
_ECCENTRICITY = math.sqrt(FLATTENING * (2.0 - FLATTENING))
_RADIUS = SEMI_MAJOR_AXIS / (1.0 + _N) * (1.0 + _N**2 / 4.0 + _N**4 / 64.0 + _N**6 / 256.0)
_ALPHA = (
    _N / 2 - 2 * _N**2 / 3 + 5 * _N**3 / 16 + 41 * _N**4 / 180 - 127 * _N**5 / 288 + 7891 * _N**6 / 37800,
    13 * _N**2 / 48 - 3 * _N**3 / 5 + 557 * _N**4 / 1440 + 281 * _N**5 / 630 - 1983433 * _N**6 / 1935360,
    61 * _N**3 / 240 - 103 * _N**4 / 140 + 15061 * _N**5 / 26880 + 167603 * _N**6 / 181440,
    49561 * _N**4 / 161280 - 179 * _N**5 / 168 + 6601661 * _N**6 / 7257600,
    34729 * _N**5 / 80640 - 3418889 * _N**6 / 1995840,
    212378941 * _N**6 / 319334400,
)


@dataclass(frozen=True)
class TransverseMercator:
    """Transverse Mercator projection.

    Attributes:
        meridian: Central meridian, degrees.
        scale: Scale on it.
        offset: Added to x and y, m.
        name: Name for a report.
    """

    meridian: float
    scale: float
    offset: tuple[float, float]
    name: str

    def project(self, latitude: F64, longitude: F64) -> F64:
        """Return x and y [N, 2], m, of latitudes and longitudes [N], degrees."""
        x, y = _project(latitude, longitude, self.meridian)
        return np.stack([self.scale * x + self.offset[0], self.scale * y + self.offset[1]], axis=-1)


def utm(latitude: float, longitude: float) -> TransverseMercator:
    """Return the UTM projection of the zone at a place, with the exceptions of Norway and Svalbard."""
    longitude = (longitude + 180.0) % 360.0 - 180.0
    zone = min(int((longitude + 180.0) // 6.0) + 1, 60)
    if 56.0 <= latitude < 64.0 and 3.0 <= longitude < 12.0:
        zone = 32
    elif latitude >= 72.0 and 0.0 <= longitude < 42.0:
        zone = 31 + 2 * int((longitude + 3.0) // 12.0)
    is_north = latitude >= 0.0
    offset = (FALSE_EASTING, 0.0 if is_north else FALSE_NORTHING)
    return TransverseMercator(
        6.0 * zone - 183.0, UTM_SCALE, offset, f"UTM zone {zone} {'north' if is_north else 'south'}"
    )


def local(latitude: float, longitude: float) -> TransverseMercator:
    """Return the projection around a place, which is its origin, and where its scale is 1."""
    _, y = _project(np.array([latitude]), np.array([longitude]), longitude)
    name = f"transverse Mercator around {latitude:.7f}, {longitude:.7f}"
    return TransverseMercator(longitude, 1.0, (0.0, -float(y[0])), name)


def _project(latitude: F64, longitude: F64, meridian: float) -> tuple[F64, F64]:
    """Return x and y, m, at scale 1."""
    phi = np.radians(latitude)
    difference = np.radians((np.asarray(longitude) - meridian + 180.0) % 360.0 - 180.0)
    tau = np.tan(phi)
    sigma = np.sinh(_ECCENTRICITY * np.arctanh(_ECCENTRICITY * np.sin(phi)))
    conformal_tau = tau * np.hypot(1.0, sigma) - sigma * np.hypot(1.0, tau)
    xi = np.arctan2(conformal_tau, np.cos(difference))
    eta = np.arcsinh(np.sin(difference) / np.hypot(conformal_tau, np.cos(difference)))
    x, y = eta.copy(), xi.copy()
    for order, alpha in enumerate(_ALPHA, 1):
        x += alpha * np.cos(2 * order * xi) * np.sinh(2 * order * eta)
        y += alpha * np.sin(2 * order * xi) * np.cosh(2 * order * eta)
    return _RADIUS * x, _RADIUS * y
