"""The LiDAR twins of the shifts."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.boxes import cars

from ssad.core.errors import ConfigError
from ssad.core.frames import SceneContext, SweepFrame
from ssad.core.rotations import quaternion_to_matrix
from ssad.scenarios.static.shifts import SHIFTS, ShiftSpec, shift_points, transformed_boxes
from ssad.scenarios.static.shifts import parameters as table
from ssad.scenarios.static.shifts.lidar import fog_response, is_inside_box
from ssad.scenarios.static.shifts.objects import box_maps, deformed_box_maps
from ssad.scenarios.static.shifts.sun import sun_direction
from ssad.scenarios.static.shifts.weather import extinction


def turn(count: int = 4000) -> Any:
    """A ring of points at 3 to 60 m."""
    rng = np.random.default_rng(0)
    angle, far = rng.uniform(-np.pi, np.pi, count), rng.uniform(3, 60, count)
    z = rng.uniform(-0.02, 0.02, count) * far
    return np.stack(
        [far * np.cos(angle), far * np.sin(angle), z, rng.uniform(5, 200, count), np.arange(count) % 32], 1
    ).astype(np.float32)


def ranges(points: Any) -> Any:
    return np.linalg.norm(points[:, :3].astype(float), axis=1)


@pytest.mark.parametrize("calibration", ["physical", "paper"])
@pytest.mark.parametrize("name", SHIFTS)
def test_every_shift_has_a_twin(name: str, calibration: Any) -> None:
    boxes = cars((10.0, 1.5, 0.0), (14.0, -12.0, 0.0))
    rng = np.random.default_rng(1)
    points = turn()
    points[:600, :3] = boxes.centre[0] + rng.uniform(-0.5, 0.5, (600, 3)) * boxes.size_lwh[0]
    frame = SweepFrame("s", "a", boxes=boxes)
    before = points.copy()
    spec = ShiftSpec(name, 5, 1, calibration)
    out, done = shift_points(points, frame, spec)
    assert done.applied
    assert out.dtype == np.float32
    assert out.shape[1] == 5
    assert np.isfinite(out).all()
    assert out.shape != points.shape or (out != points).any()
    assert (points == before).all()
    assert (shift_points(points, frame, spec)[0] == out).all()
    assert (shift_points(points, frame, spec.at(0))[0] == points).all()


def test_range_noise_is_along_the_beam() -> None:
    points = turn(20000)
    for name, deviation in (("gaussian", 1.0), ("uniform", 1 / np.sqrt(3))):
        out, _ = shift_points(points, SweepFrame("s", "a"), ShiftSpec(name, 4))
        noise = ranges(out) - ranges(points)
        assert noise.std() == pytest.approx(table.LIDAR_NOISE[3] * deviation, rel=0.03)
        across = np.cross(out[:, :3], points[:, :3]) / ranges(points)[:, None] ** 2
        assert np.abs(across).max() < 1e-5
        assert (out[:, 3:] == points[:, 3:]).all()
    out, done = shift_points(points, SweepFrame("s", "a"), ShiftSpec("impulse", 5))
    assert (out != points).any(axis=1).mean() == pytest.approx(0.1, abs=0.01)
    assert done.details["points"] == 2000


def test_points_move_with_their_object() -> None:
    boxes = replace(cars((10.0, 1.5, 0.8)), rotation=np.array([[np.cos(0.4), 0, 0, np.sin(0.4)]]))
    rng = np.random.default_rng(2)
    matrix, centre = box_maps(boxes)
    local = rng.uniform(-0.5, 0.5, (500, 3)) * 0.98
    cloud = np.zeros((900, 5), np.float32)
    cloud[:500, :3] = local @ matrix[0].T + centre[0]
    cloud[500:, :3] = rng.uniform(20, 40, (400, 3))
    frame = SweepFrame("s", "a", boxes=boxes)
    for name in ("scale", "rotation", "shear"):
        spec = ShiftSpec(name, 4, 5)
        out, done = shift_points(cloud, frame, spec)
        new, new_centre = deformed_box_maps(spec, boxes, scene="s", sample="a")
        assert out[:500, :3] == pytest.approx(local @ new[0].T + new_centre[0], abs=1e-4)
        assert (out[500:] == cloud[500:]).all()
        assert done.details == {"objects": 1, "points": 500}
        label = transformed_boxes(spec, boxes, scene="s", sample="a")
        assert is_inside_box(out[:500], box_maps(label)[0][0] * 1.0001, label.centre[0]).all()
    moving = replace(boxes, velocity=np.array([[3.0, 4.0, 0.0]]))
    out, _ = shift_points(cloud, replace(frame, boxes=moving), ShiftSpec("motion_blur", 5))
    smear = (out - cloud)[:500, :3]
    assert np.abs(np.cross(smear, [3.0, 4.0, 0.0])).max() < 1e-3
    assert np.linalg.norm(smear, axis=1).max() <= 5 * table.BLUR_EXPOSURE[4] / 2 + 1e-4


def test_the_paper_scales_one_axis_and_keeps_the_object_on_the_ground() -> None:
    boxes = cars((10.0, 1.5, 0.8))
    for seed in range(8):
        spec = ShiftSpec("scale", 5, seed, "paper")
        new, centre = deformed_box_maps(spec, boxes, scene="s", sample="a", lidar=True)
        ratio = np.linalg.norm(new[0], axis=0) / boxes.size_lwh[0]
        assert sorted(np.abs(np.round(ratio - 1, 9))) == pytest.approx([0, 0, 0.2])
        assert centre[0, 2] - np.linalg.norm(new[0], axis=0)[2] / 2 == pytest.approx(0, abs=1e-9)


def test_fog_weakens_echoes_and_loses_far_points() -> None:
    points = turn(20000)
    lost = []
    for severity in range(1, 6):
        spec = ShiftSpec("fog", severity)
        out, done = shift_points(points, SweepFrame("s", "a"), spec)
        lost.append(done.details["lost"] + done.details["moved"])
        if severity == 2:  # nothing moved or lost at this range: the law itself
            near = ranges(points) < 20
            kept = out[: near.size][near[: len(out)]] if len(out) == len(points) else out[ranges(out) < 20]
            if len(out) == len(points):
                expected = points[near, 3] * np.exp(-2 * extinction(spec) * ranges(points)[near])
                assert kept[:, 3] == pytest.approx(expected, rel=1e-4)
    assert (np.diff(lost) >= 0).all()
    assert lost[-1] > lost[0] + 1000
    grid, best, place = fog_response(0.06)
    assert (np.diff(best) >= 0).all(), "a farther target leaves more fog before it"
    assert (place <= grid + 1e-9).all()
    assert place[-1] < 10, "the strongest echo of fog comes from near by"


@pytest.mark.parametrize("name", ["rain", "snow"])
def test_rain_and_snow_reflect_near_by(name: str) -> None:
    points = turn(20000)
    moved = []
    for severity in (1, 3, 5):
        out, done = shift_points(points, SweepFrame("s", "a"), ShiftSpec(name, severity))
        moved.append(done.details["moved"])
        assert len(out) == len(points) - done.details["lost"]
        assert ranges(out).max() <= ranges(points).max() + 0.2
    assert moved[0] < moved[1] < moved[2]


def test_the_lidar_is_blind_towards_the_same_sun() -> None:
    points = turn(40000)
    context = SceneContext("s", heading=0.3)
    spec = ShiftSpec("sunlight", 5)
    sun = sun_direction(spec, context)
    # lift the points so that some lie in front of the sun
    points[:, 2] = (np.linalg.norm(points[:, :2], axis=1) * np.tan(np.arcsin(sun[2]))).astype(np.float32)
    half = 0.25
    pose = np.eye(4)
    pose[:3, :3] = quaternion_to_matrix(np.array([np.cos(half), 0, 0, np.sin(half)]))
    frame = SweepFrame("s", "a", ego_to_world=pose)
    out, done = shift_points(points, frame, spec, contexts={"s": context})
    assert done.details["lost"] > 100
    toward = pose[:3, :3].T @ sun
    angle = np.degrees(np.arccos(np.clip(out[:, :3] @ toward / ranges(out), -1, 1)))
    assert angle.min() >= table.LIDAR_SUN_CONE[4] - 0.01
    dark, done = shift_points(points, frame, spec, contexts={"s": SceneContext("s", 0.1, 0.3)})
    assert (dark == points).all()
    assert done.skipped == {"it is night": 1}


@pytest.mark.parametrize(("calibration", "rates"), [("physical", None), ("paper", (0.20, 0.73, 1.5625, 3.125, 7.29))])
@pytest.mark.parametrize("name", ["rain", "snow"])
def test_rain_and_snow_have_the_rates_of_their_calibration(name: str, calibration: Any, rates: Any) -> None:
    """Echoes of targets are attenuated by exp(-2 beta R); the published rates are those of 3D_Corruptions_AD."""
    points = turn(2000)
    points[:, 4] = np.arange(len(points))  # tells points apart
    rates = rates or (table.RAIN_RATE if name == "rain" else table.SNOW_RATE)
    law = table.rain_extinction if name == "rain" else table.snow_extinction
    for severity, rate in enumerate(rates, 1):
        out, _ = shift_points(points, SweepFrame("s", "a"), ShiftSpec(name, severity, 0, calibration))
        before = points[out[:, 4].astype(int)]
        is_far = ranges(out) > 30.0  # echoes of drops and flakes are nearer
        beta = np.log(before[is_far, 3] / out[is_far, 3]) / (2 * ranges(before[is_far]))
        assert np.median(beta) == pytest.approx(law(rate), rel=1e-3)


@pytest.mark.parametrize("severity", [1, 5])
def test_the_published_sun_strikes_a_share_of_the_points_and_blinds_nothing(severity: int) -> None:
    points, context = turn(20000), SceneContext("s", 0.1, 0.3)
    spec = ShiftSpec("sunlight", severity, 0, "paper")
    out, done = shift_points(points, SweepFrame("s", "a"), spec, contexts={"s": context})
    struck = (out != points).any(1)
    assert (len(out), done.details["lost"]) == (len(points), 0)
    assert done.details["noisy"] == struck.sum() == 200 * severity, "1 to 5 % of the points, at night too"
    noise = (out - points)[struck, :3]
    # five standard errors of the deviation of 3 x 200 draws and more
    assert noise.std() == pytest.approx(2.0, rel=0.15)
    assert (out[:, 3:] == points[:, 3:]).all()


def test_fog_is_the_same_in_both_calibrations() -> None:
    """Both have the published extinctions, .005 to .06 1/m."""
    published = (0.005, 0.01, 0.02, 0.03, 0.06)
    for calibration in ("physical", "paper"):
        betas = [extinction(ShiftSpec("fog", severity, 0, calibration)) for severity in range(1, 6)]
        assert betas == pytest.approx(published)


def test_wrong_points_are_refused() -> None:
    for points in (np.zeros((5, 3)), np.zeros(5), np.zeros((2, 3, 4))):
        with pytest.raises(ConfigError, match="points must be"):
            shift_points(points, SweepFrame(), ShiftSpec("fog", 3))
    for name in SHIFTS:
        out, _ = shift_points(np.zeros((0, 5)), SweepFrame(), ShiftSpec(name, 3))
        assert out.shape == (0, 5)
