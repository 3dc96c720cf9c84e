"""LiDAR twins of the shifts: the same weather, sun and objects in the points of a sweep.

Points [P, 5] float32 in the sensor frame: x, y, z (m), intensity (0 to 255), ring; more columns are kept. Lost points
are removed.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from ssad.core.errors import ConfigError
from ssad.core.frames import SceneContext, ShiftReport, SweepFrame
from ssad.core.types import F32, F64, Bool
from ssad.scenarios.static.shifts import parameters as table
from ssad.scenarios.static.shifts.objects import box_maps, deformed_box_maps
from ssad.scenarios.static.shifts.spec import CAMERA_ONLY, ShiftSpec
from ssad.scenarios.static.shifts.sun import AT_NIGHT, NIGHT, sun_direction
from ssad.scenarios.static.shifts.weather import extinction

FARTHEST = 70.0  # m: range at which the 32-beam sensor of nuScenes just detects intensity 1 in clear air
_BETA_0 = 1e-6 / np.pi  # reflectivity constant of Hahner et al. 2021


def shift_points(
    points: npt.ArrayLike, frame: SweepFrame, spec: ShiftSpec, *, contexts: Mapping[str, SceneContext] | None = None
) -> tuple[F32, ShiftReport]:
    """Apply a shift to the points of a sweep.

    Args:
        points: [P, 4 or more].
        frame: Frame of the sweep.
        spec: The shift.
        contexts: Constants of each scene, by its key.

    Returns:
        The points, and a record of the shift.

    Raises:
        ConfigError: The points have another shape.
    """
    cloud = np.array(points, np.float32)
    if cloud.ndim != 2 or cloud.shape[1] < 4:
        raise ConfigError(f"points must be [P, 5] (x, y, z, intensity, ring), not {list(cloud.shape)}")
    if spec.severity == 0:
        return cloud, ShiftReport(True, {"severity": 0})
    if spec.name in CAMERA_ONLY:
        return cloud, ShiftReport(False, {}, {"changes cameras alone": 1})
    if spec.places_objects:
        from ssad.scenarios.static.shifts.anomaly import hit_by_rays

        return hit_by_rays(cloud, frame, spec, contexts)
    draws = spec.generator("lidar", frame.scene, frame.sample)
    if spec.family == "sensor":
        return _add_noise(cloud, spec, draws)
    if spec.family == "object":
        return _move_objects(cloud, frame, spec, draws)
    if spec.name == "sunlight" and spec.calibration == "paper":
        return _add_paper_sun_noise(cloud, spec, draws)
    if spec.name == "sunlight":
        context = (contexts or {}).get(frame.scene, SceneContext(frame.scene))
        if context.light < NIGHT:
            return cloud, ShiftReport(False, {"light": round(context.light, 2)}, {AT_NIGHT: 1})
        return _add_sun_noise(cloud, frame, spec, context, draws)
    if spec.name == "fog":
        return _add_fog(cloud, spec, draws)
    return _add_precipitation(cloud, spec, draws)


def _ranges(cloud: F32) -> F64:
    return np.asarray(np.maximum(np.linalg.norm(cloud[:, :3].astype(np.float64), axis=1), 1e-3))


def _add_noise(cloud: F32, spec: ShiftSpec, draws: np.random.Generator) -> tuple[F32, ShiftReport]:
    """Add range noise (paper: noise of each coordinate); for impulse noise, replace some ranges."""
    count, level_index = len(cloud), spec.severity - 1
    is_paper = spec.calibration == "paper"
    if spec.name == "impulse":
        share = table.LIDAR_IMPULSE[level_index]
        struck_indices = draws.permutation(count)[: int(count * share)]
        if is_paper:
            cloud[struck_indices, :3] += draws.choice([-0.1, 0.1], size=(len(struck_indices), 3)).astype(np.float32)
        else:
            ranges = _ranges(cloud[struck_indices])
            cloud[struck_indices, :3] *= (draws.uniform(1.0, np.maximum(ranges, 1.5)) / ranges).astype(np.float32)[
                :, None
            ]
        return cloud, ShiftReport(len(struck_indices) > 0, {"points": len(struck_indices)})
    level = table.LIDAR_NOISE[level_index]
    size = (count, 3) if is_paper else (count,)
    noise = draws.normal(0, level, size) if spec.name == "gaussian" else draws.uniform(-level, level, size)
    if is_paper:
        cloud[:, :3] += noise.astype(np.float32)
    else:
        cloud[:, :3] *= (1 + noise / _ranges(cloud)).astype(np.float32)[:, None]
    return cloud, ShiftReport(count > 0, {"level_m": level})


def is_inside_box(cloud: F32 | F64, matrix: F64, centre: F64) -> Bool:
    """Return a mask of the points [P] in the box that the matrix [3, 3] makes of the unit cube."""
    local = (cloud[:, :3] - centre) @ np.linalg.inv(matrix).T
    return np.asarray((np.abs(local) <= 0.5).all(1))


def _move_objects(
    cloud: F32, frame: SweepFrame, spec: ShiftSpec, draws: np.random.Generator
) -> tuple[F32, ShiftReport]:
    """Move the points in each box with it. Each point belongs to the first box that contains it."""
    boxes = frame.boxes
    if not len(boxes) or not len(cloud):
        return cloud, ShiftReport(False, {"objects": 0})
    pose = frame.ego_to_world @ frame.to_ego
    world_to_sensor, sensor_position = pose[:3, :3].T, pose[:3, 3]
    old_maps, old_centres = box_maps(boxes)
    new_maps, new_centres = deformed_box_maps(spec, boxes, scene=frame.scene, sample=frame.sample, lidar=True)
    old_maps, new_maps = world_to_sensor @ old_maps, world_to_sensor @ new_maps
    old_centres, new_centres = (
        (old_centres - sensor_position) @ world_to_sensor.T,
        (new_centres - sensor_position) @ world_to_sensor.T,
    )
    is_unassigned = np.ones(len(cloud), bool)
    result, moved_count, object_count, still_count = cloud.copy(), 0, 0, 0
    reach = np.linalg.norm(boxes.size_lwh, axis=1) / 2 + 0.5
    for box_index in range(len(boxes)):
        nearby = np.flatnonzero(
            is_unassigned & (np.abs(cloud[:, :2] - old_centres[box_index, :2]).max(1) < reach[box_index])
        )
        object_points = nearby[is_inside_box(cloud[nearby], old_maps[box_index], old_centres[box_index])]
        if not len(object_points):
            continue
        is_unassigned[object_points] = False
        local = (cloud[object_points, :3] - old_centres[box_index]) @ np.linalg.inv(old_maps[box_index]).T
        if spec.name == "motion_blur":
            displacement = _streak(local, boxes.velocity[box_index] @ world_to_sensor.T, spec, draws)
            if displacement is None:
                still_count += 1
                continue
            result[object_points, :3] = cloud[object_points, :3] + displacement
        else:
            result[object_points, :3] = local @ new_maps[box_index].T + new_centres[box_index]
        moved_count, object_count = moved_count + len(object_points), object_count + 1
    skipped = {"it does not move or its velocity is unknown": still_count} if still_count else {}
    return result, ShiftReport(object_count > 0, {"objects": object_count, "points": moved_count}, skipped)


def _streak(local: F64, velocity: F64, spec: ShiftSpec, draws: np.random.Generator) -> F32 | None:
    """Return the displacement of an object's points: by its velocity over the exposure; paper: by shifted thirds."""
    speed = float(np.linalg.norm(velocity))
    if not np.isfinite(speed) or speed < 0.2:
        return None
    if spec.calibration == "paper":
        part_index = np.clip(np.floor((local[:, 0] + 0.5) * 3), 0, 2) - 1
        return np.asarray(part_index[:, None] * 0.2 * spec.severity * velocity / speed, np.float32)
    time_offset = draws.uniform(-0.5, 0.5, len(local)) * table.BLUR_EXPOSURE[spec.severity - 1]
    return np.asarray(time_offset[:, None] * velocity, np.float32)


def _add_sun_noise(
    cloud: F32, frame: SweepFrame, spec: ShiftSpec, context: SceneContext, draws: np.random.Generator
) -> tuple[F32, ShiftReport]:
    """Remove the points around the sun, where the receiver is blind, and replace some ranges by noise of 2 m."""
    level_index = spec.severity - 1
    sun_in_sensor = (frame.ego_to_world @ frame.to_ego)[:3, :3].T @ sun_direction(spec, context)
    ranges = _ranges(cloud)
    angle = np.degrees(np.arccos(np.clip((cloud[:, :3] @ sun_in_sensor) / ranges, -1, 1)))
    is_returned = angle > table.LIDAR_SUN_CONE[level_index]
    is_noisy = draws.random(len(cloud)) < table.LIDAR_SUN[level_index]
    noise = np.maximum(1 + draws.normal(0, 2.0, len(cloud)) / ranges, 0.2)
    cloud[is_noisy, :3] *= noise[is_noisy].astype(np.float32)[:, None]
    return cloud[is_returned], ShiftReport(
        True, {"lost": int((~is_returned).sum()), "noisy": int((is_noisy & is_returned).sum())}
    )


def _add_paper_sun_noise(cloud: F32, spec: ShiftSpec, draws: np.random.Generator) -> tuple[F32, ShiftReport]:
    """Add the published noise of 2 m to each coordinate of the published share of points; no sun is in the world."""
    struck_indices = draws.permutation(len(cloud))[: int(len(cloud) * table.LIDAR_SUN[spec.severity - 1])]
    cloud[struck_indices, :3] += draws.normal(0, 2.0, (len(struck_indices), 3)).astype(np.float32)
    return cloud, ShiftReport(len(struck_indices) > 0, {"lost": 0, "noisy": len(struck_indices)})


def fog_response(beta: float) -> tuple[F64, F64, F64]:
    """Return the strongest echo of the fog itself in front of a hard target.

    Args:
        beta: Extinction, 1/m.

    Returns:
        Three arrays [K]. Ranges R of the hard target, m; the strongest echo of the fog before it, s / m^2 (multiplied
        by R^2 and by backscatter over beta_0, it is relative to the hard target's echo in clear air); range from
        which it comes, m.

    Source: Hahner, Sakaridis, Dai and Van Gool, ICCV 2021, equation 10: the echo integrated over a pulse of 2 x 10
    ns.
    """
    ranges = np.arange(0.5, 120.0, 0.1)
    half_pulse, light_speed = 10e-9, 2.998e8
    pulse_time = np.linspace(0, 2 * half_pulse, 41)
    echo_range = ranges[:, None] - light_speed * pulse_time[None] / 2
    crossover = np.clip((echo_range - 0.9) / 0.1, 0, 1)
    safe_range = np.maximum(echo_range, 0.5)
    echo = (
        np.sin(np.pi * pulse_time / (2 * half_pulse)) ** 2 * np.exp(-2 * beta * safe_range) / safe_range**2 * crossover
    )
    strength = np.trapezoid(echo, pulse_time, axis=1)
    # A running maximum serves all target ranges with one integral.
    strongest = np.maximum.accumulate(strength)
    strongest_index = np.maximum.accumulate(np.where(strength >= strongest, np.arange(len(ranges)), 0))
    return ranges, strongest, ranges[strongest_index]


def _add_fog(cloud: F32, spec: ShiftSpec, draws: np.random.Generator) -> tuple[F32, ShiftReport]:
    """Attenuate echoes by exp(-2 beta R); a stronger echo of the fog replaces that of the target."""
    beta = extinction(spec)
    ranges = _ranges(cloud)
    range_grid, strongest, echo_ranges = fog_response(beta)
    backscatter = 0.046 * beta / 3.0  # 0.046 / MOR
    range_index = np.clip(((ranges - range_grid[0]) / 0.1).astype(int), 0, len(range_grid) - 1)
    intensity = cloud[:, 3].copy()
    target_echo = intensity * np.exp(-2 * beta * ranges)
    fog_echo = cloud[:, 3] * ranges**2 * backscatter / _BETA_0 * strongest[range_index]
    is_fog_echo = fog_echo > target_echo
    echo_range = np.clip(echo_ranges[range_index] + draws.normal(0, 0.3, len(cloud)), 0.8, None)
    cloud[is_fog_echo, :3] *= (np.minimum(echo_range, ranges) / ranges)[is_fog_echo].astype(np.float32)[:, None]
    cloud[:, 3] = np.where(is_fog_echo, np.minimum(fog_echo, 255), target_echo).astype(np.float32)
    is_returned = _detected(intensity, ranges, beta) | is_fog_echo
    return cloud[is_returned], ShiftReport(True, {"lost": int((~is_returned).sum()), "moved": int(is_fog_echo.sum())})


def _detected(intensity: F32, ranges: F64, beta: float) -> Bool:
    """Return a mask of the echoes above the threshold, that of intensity 1 at the maximum range in clear air."""
    clear_echo = np.maximum(intensity, 1) / ranges**2
    # Half the clear echo is also enough: returns that were already faint are not all lost.
    return np.asarray(clear_echo * np.exp(-2 * beta * ranges) >= np.minimum(1.0 / FARTHEST**2, 0.5 * clear_echo))


def _add_precipitation(cloud: F32, spec: ShiftSpec, draws: np.random.Generator) -> tuple[F32, ShiftReport]:
    """Attenuate echoes and replace some by nearby drops or flakes (Goodin et al. 2019)."""
    beta = extinction(spec)
    ranges = _ranges(cloud)
    intensity = cloud[:, 3].copy()
    target_echo = intensity * np.exp(-2 * beta * ranges)
    # a beam meets particles at the rate beta; it detects one that is large and near enough
    rate = beta * (0.06 if spec.name == "rain" else 0.4)
    particle_range = draws.exponential(1 / rate, len(cloud)) + 1.0
    is_particle = particle_range < np.minimum(ranges, 25.0 if spec.name == "snow" else 12.0)
    cloud[is_particle, :3] *= (particle_range / ranges)[is_particle].astype(np.float32)[:, None]
    particle_echo = draws.uniform(0, 12 if spec.name == "rain" else 40, len(cloud))
    cloud[:, 3] = np.where(is_particle, particle_echo, target_echo).astype(np.float32)
    jitter = draws.normal(0, 0.02 * (1 - np.exp(-beta * ranges)), len(cloud))
    cloud[~is_particle, :3] *= (1 + jitter / ranges)[~is_particle].astype(np.float32)[:, None]
    is_returned = _detected(intensity, ranges, beta) | is_particle
    return cloud[is_returned], ShiftReport(True, {"lost": int((~is_returned).sum()), "moved": int(is_particle.sum())})
