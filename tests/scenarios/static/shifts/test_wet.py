"""The wet road under rain: what darkens, what it mirrors, what stays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.boxes import cars

from ssad.core.frames import Camera, Frame
from ssad.core.types import F32, U8, Bool
from ssad.scenarios.static.shifts import ShiftSpec
from ssad.scenarios.static.shifts import parameters as table
from ssad.scenarios.static.shifts.batch import to_batch
from ssad.scenarios.static.shifts.depth import depth_grid
from ssad.scenarios.static.shifts.light import to_codes, to_linear
from ssad.scenarios.static.shifts.wet import wet_ground

WIDTH, HEIGHT, UP, WALL = 320, 180, 1.5, 25.0
CAMERA = Camera.typical(WIDTH, HEIGHT)
FOCAL = float(CAMERA.intrinsic[0, 0])
v_grid, u_grid = np.mgrid[:HEIGHT, :WIDTH] + 0.5


def ground_depth(rows: np.ndarray) -> np.ndarray:
    """Depth of a flat road at rows of the picture, up to a wall across it."""
    return np.minimum(UP * FOCAL / np.maximum(rows - HEIGHT / 2, 1e-3), WALL)


ROAD: Bool = ground_depth(v_grid) < WALL - 1.0
DEPTH: F32 = ground_depth(v_grid)[2::4, 2::4].astype(np.float32)


def rained(image: U8, severity: int = 5, *, frame: Frame | None = None) -> U8:
    """The picture with wet ground alone, without drops and veil."""
    batch = to_batch(image)
    frames = [frame or Frame(CAMERA, "s", depth=DEPTH)]
    known = depth_grid(batch, frames)
    return wet_ground(batch, frames, [ShiftSpec("rain", severity)], known).numpy()[0]


def water(monkeypatch: pytest.MonkeyPatch, share: float) -> None:
    """As much of it everywhere, without waves."""
    monkeypatch.setattr(table, "WET_FILM", (10.0 * share - 5.0,) * 5)
    monkeypatch.setattr(table, "WET_ROUGH", (0.0,) * 5)


@pytest.mark.parametrize("severity", [1, 3, 5])
def test_wet_asphalt_darkens_and_paint_less(severity: int, monkeypatch: pytest.MonkeyPatch) -> None:
    water(monkeypatch, 0.0)
    image = np.full((HEIGHT, WIDTH, 3), 100, np.uint8)
    image[150:170, 100:110] = 230
    out = rained(image, severity)
    lost = table.WET_DARK[severity - 1]
    asphalt = ROAD & (u_grid > 200)
    assert np.abs(out[asphalt] - to_codes(to_linear(100) * (1 - lost))).max() <= 1
    assert np.abs(out[152:168, 102:108] - to_codes(to_linear(230) * (1 - 0.3 * lost))).max() <= 1
    assert (out[~ROAD & (v_grid < HEIGHT / 2)] == 100).all(), "a wall does not darken"


def test_a_wet_road_mirrors_what_stands_on_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """A band on a wall shows as far below the road as it is above it, by Fresnel's share."""
    water(monkeypatch, 1.0)
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    low, high = 1.0, 3.0
    height = UP - (v_grid - HEIGHT / 2) / FOCAL * WALL
    image[(height > low) & (height < high) & (u_grid > 80) & (u_grid < 240)] = (255, 0, 0)
    red = to_linear(rained(image))[..., 0] * ROAD
    rows = np.flatnonzero(red[:, 160] > 0.5 * red[:, 160].max()) + 0.5
    expected = [HEIGHT / 2 + FOCAL * (UP + z) / WALL for z in (low, high)]
    assert rows.min() == pytest.approx(expected[0], abs=5.0)
    assert rows.max() == pytest.approx(expected[1], abs=5.0)
    columns = np.flatnonzero(red[int(np.mean(expected))] > 0.02)
    assert [columns.min(), columns.max()] == pytest.approx([80, 240], abs=6.0)
    row = int(np.mean(expected))
    down = (row + 0.5 - HEIGHT / 2) / FOCAL
    cosine = down / np.sqrt(1 + down**2)
    assert red[row, 160] == pytest.approx(0.02 + 0.98 * (1 - cosine) ** 5, rel=0.08)


def test_objects_stay_as_they_are() -> None:
    boxes = cars((12.0, 0.0, 0.8))
    depth, image = ground_depth(v_grid), np.full((HEIGHT, WIDTH, 3), 100, np.uint8)
    local = (boxes.corners()[0] - CAMERA.to_ego[:3, 3]) @ CAMERA.to_ego[:3, :3]
    near = float(local[:, 2].min())
    face = local[local[:, 2] < near + 0.1]
    pixels = face[:, :2] / near * FOCAL + [WIDTH / 2, HEIGHT / 2]
    (x0, y0), (x1, y1) = pixels.min(0), pixels.max(0)
    car = (u_grid > x0) & (u_grid < x1) & (v_grid > y0) & (v_grid < y1)
    depth[car] = near
    image[car] = (30, 60, 200)
    out = rained(image, frame=Frame(CAMERA, "s", boxes=boxes, depth=depth[2::4, 2::4].astype(np.float32)))
    inner = (u_grid > x0 + 3) & (u_grid < x1 - 3) & (v_grid > y0 + 3) & (v_grid < y1 - 5)
    assert inner.sum() > 500
    assert (out[inner] == image[inner]).all()
    beside = ROAD & (u_grid < x0 - 8)
    assert (out[beside] != image[beside]).any(-1).mean() > 0.95, "the road beside it is wet"


def test_the_road_is_found_without_depth() -> None:
    """By its plane: next to everything of it, and nothing above the horizon."""
    image = np.full((HEIGHT, WIDTH, 3), 100, np.uint8)
    image[: HEIGHT // 2] = 235
    out = rained(image, frame=Frame(CAMERA, "s"))
    changed = (out != image).any(-1)
    assert changed[v_grid > HEIGHT / 2 + UP * FOCAL / 25.0].mean() > 0.9
    assert not changed[v_grid < HEIGHT / 2].any()


def test_hollows_stay_where_they_are_in_the_world() -> None:
    """A place on the road is as wet from one metre nearer: the same water, whatever the pose of the camera."""
    image = np.full((HEIGHT, WIDTH, 3), 60, np.uint8)
    image[: HEIGHT // 2] = 200
    sky = np.where(v_grid[2::4, 2::4] < HEIGHT / 2, np.inf, UP * FOCAL / (v_grid[2::4, 2::4] - HEIGHT / 2))
    frame = Frame(CAMERA, "s", depth=sky.astype(np.float32))
    moved = np.eye(4)
    moved[0, 3] = 1.0
    both = [rained(image, 2, frame=f)[..., 0] for f in (frame, replace(frame, ego_to_world=moved))]
    # along a line 6 m ahead of the first: 5 m ahead of the second
    profiles = []
    for picture, ahead in zip(both, (6.0, 5.0), strict=True):
        row = int(HEIGHT / 2 + UP * FOCAL / ahead)
        columns = WIDTH / 2 + np.linspace(-1.5, 1.5, 40) / ahead * FOCAL
        profiles.append(picture[row, columns.astype(int)].astype(float))
    assert np.ptp(profiles[0]) > 5, "there are hollows"
    assert np.corrcoef(*profiles)[0, 1] > 0.9
