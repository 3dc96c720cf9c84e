"""Transverse Mercator projection, against GeographicLib."""

from __future__ import annotations

import numpy as np
import pytest

from ssad.world.roads.projection import TransverseMercator, local, utm


def place(projection: TransverseMercator, latitude: float, longitude: float) -> list[float]:
    return projection.project(np.array([latitude]), np.array([longitude]))[0].tolist()


@pytest.mark.parametrize(
    ("latitude", "longitude", "zone", "x", "y"),
    [
        (49.0, 8.4, "UTM zone 32 north", 2236.0092466074857, 5541.339791917242),
        (35.6, 139.7, "UTM zone 54 north", 2789.252989078115, 5510.339698642492),
        (-33.9, 151.2, "UTM zone 56 south", 2678.6841710665612, 5593.018180122599),
        (60.4, 5.3, "UTM zone 32 north", 1961.6596480898443, 5470.40884558484),
        (78.2, 15.6, "UTM zone 33 north", 624.7580695114448, 5587.002195829526),
        (71.9, -179.9, "UTM zone 1 north", 1304.7277385278721, 5521.607343863696),
    ],
)
def test_utm_is_that_of_geographiclib(latitude: float, longitude: float, zone: str, x: float, y: float) -> None:
    """Offsets of a place 0.05 and 0.03 degrees away, from GeographicLib through lanelet2's UtmProjector."""
    projection = utm(latitude, longitude)
    step = np.subtract(place(projection, latitude + 0.05, longitude + 0.03), place(projection, latitude, longitude))
    assert projection.name == zone
    assert step == pytest.approx([x, y], abs=1e-6)


def test_utm_has_its_false_origin() -> None:
    assert place(utm(33.3, 44.4), 33.3, 44.4) == pytest.approx([444140.5449, 3684706.3555], abs=1e-3)
    assert place(utm(-1e-9, 3.0), 0.0, 3.0) == pytest.approx([500000.0, 10000000.0], abs=1e-3)


def test_a_local_projection_keeps_lengths_at_its_origin() -> None:
    projection = local(49.0, 8.4)
    assert place(projection, 49.0, 8.4) == pytest.approx([0.0, 0.0], abs=1e-9)
    # A degree of latitude at 49 degrees has 111,209.7 m, and one of longitude 73,171.8 m (WGS84).
    assert place(projection, 49.0001, 8.4)[1] == pytest.approx(11.12097, abs=2e-4)
    assert place(projection, 49.0, 8.4001)[0] == pytest.approx(7.31718, abs=2e-4)
