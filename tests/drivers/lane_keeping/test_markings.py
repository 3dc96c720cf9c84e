"""The road from above: places of the ground, brightness and markings."""

from __future__ import annotations

import numpy as np
import pytest

from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.drivers.lane_keeping.markings import FULL_CONTRAST, RoadGrid, RoadMap, marking_strength
from ssad.rendering.camera.rig import rig_camera

GRID = RoadGrid()


def test_the_grid_has_the_stated_extent() -> None:
    assert GRID.row_distance[0] == 7.0
    assert GRID.row_distance[-1] == pytest.approx(38.0)
    assert GRID.column_offset[0] == pytest.approx(8.0)
    assert GRID.column_offset[-1] == pytest.approx(-8.0)
    with pytest.raises(ConfigError, match="0 < near < far"):
        RoadGrid(near=40.0)


def test_a_place_on_the_road_is_the_pixel_where_the_camera_shows_it() -> None:
    camera = Camera.typical(640, 384)
    columns, rows = RoadMap(camera, GRID).pixels
    # By hand: 1.5 m below a camera that stands 1.7 m ahead, focal length 0.79 x 640.
    depth, focal = 20.0 - 1.7, 0.79 * 640
    row = int(np.argmin(np.abs(GRID.row_distance - 20.0)))
    column = int(np.argmin(np.abs(GRID.column_offset - 2.0)))
    assert columns[row, column] == pytest.approx(320.0 - focal * 2.0 / depth - 0.5, abs=1e-3)
    assert rows[row, column] == pytest.approx(192.0 + focal * 1.5 / depth - 0.5, abs=1e-3)


def test_brightness_is_that_of_the_ground_and_unknown_outside_the_image() -> None:
    road_map = RoadMap(rig_camera("CAM_FRONT", 640), GRID)
    image = np.zeros((3, 360, 640), np.uint8)
    image[0], image[1] = 60, 100
    brightness = road_map.brightness(image)
    assert np.isnan(brightness[0, 0])  # 8 m aside at 7 m ahead
    assert np.nanmin(brightness) == np.nanmax(brightness) == 80.0
    with pytest.raises(ConfigError, match="an image of shape"):
        road_map.brightness(image[:, :100])


def test_a_bright_ridge_is_a_marking_and_an_edge_is_none() -> None:
    brightness = np.full((len(GRID.row_distance), len(GRID.column_offset)), 80.0, np.float32)
    line, edge = 100, 200
    brightness[:, line : line + 3] = 80.0 * (1.0 + 2.0 * FULL_CONTRAST)
    brightness[:, edge:] = 140.0
    strength = marking_strength(brightness, GRID)
    assert strength[:, line : line + 3].min() == 1.0
    assert strength[:, edge - 20 :].max() == 0.0
    # Contrast is a share of the brightness, so that a darker image shows the same.
    np.testing.assert_allclose(marking_strength(0.5 * brightness, GRID), strength, atol=1e-5)


def test_dark_and_unknown_rows_show_nothing() -> None:
    brightness = np.full((4, len(GRID.column_offset)), np.nan, np.float32)
    brightness[1:] = 1.0
    brightness[1:, 150] = 3.0
    assert marking_strength(brightness, GRID).max() == 0.0
