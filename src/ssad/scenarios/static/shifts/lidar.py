"""The LiDAR twin of each shift that has one: the same weather, sun and objects, in the points of a sweep.

Points [P, 5] float32 in the sensor frame: x, y, z (m), intensity (0 to 255), ring; more columns are kept. Lost points
are removed.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from ssad.core.errors import ConfigError
from ssad.core.frames import Applied, SceneContext, SweepFrame
from ssad.core.types import F32, F64, Bool
from ssad.scenarios.static.shifts import parameters as table
from ssad.scenarios.static.shifts.objects import affine, deformed
from ssad.scenarios.static.shifts.spec import CAMERA_ONLY, ShiftSpec
from ssad.scenarios.static.shifts.sun import AT_NIGHT, NIGHT, sun_direction
from ssad.scenarios.static.shifts.weather import extinction

FARTHEST = 70.0  # m at which a dark target (intensity 1) is just seen in clear air by the 32-beam sensor of nuScenes
_BETA_0 = 1e-6 / np.pi  # reflectivity constant of Hahner et al. 2021


def shift_points(
    points: npt.ArrayLike, frame: SweepFrame, spec: ShiftSpec, *, contexts: Mapping[str, SceneContext] | None = None
) -> tuple[F32, Applied]:
    """Applies a shift to the points of a sweep. ConfigError unless they are [P, 4 or more]."""
    cloud = np.array(points, np.float32)
    if cloud.ndim != 2 or cloud.shape[1] < 4:
        raise ConfigError(f"points must be [P, 5] (x, y, z, intensity, ring), not {list(cloud.shape)}")
    if spec.severity == 0:
        return cloud, Applied(True, {"severity": 0})
    if spec.name in CAMERA_ONLY:
        return cloud, Applied(False, {}, {"changes cameras alone": 1})
    if spec.places_objects:
        from ssad.scenarios.static.shifts.anomaly import hit_by_rays

        return hit_by_rays(cloud, frame, spec, contexts)
    draws = spec.generator("lidar", frame.scene, frame.sample)
    if spec.family == "sensor":
        return _noise(cloud, spec, draws)
    if spec.family == "object":
        return _objects(cloud, frame, spec, draws)
    if spec.name == "sunlight":
        context = (contexts or {}).get(frame.scene, SceneContext(frame.scene))
        if spec.calibration == "physical" and context.light < NIGHT:
            return cloud, Applied(False, {"light": round(context.light, 2)}, {AT_NIGHT: 1})
        return _sun(cloud, frame, spec, context, draws)
    if spec.name == "fog":
        return _fog(cloud, spec, draws)
    return _precipitation(cloud, spec, draws)


def _ranges(cloud: F32) -> F64:
    return np.asarray(np.maximum(np.linalg.norm(cloud[:, :3].astype(np.float64), axis=1), 1e-3))


def _noise(cloud: F32, spec: ShiftSpec, draws: np.random.Generator) -> tuple[F32, Applied]:
    """Gaussian or uniform noise of the range (paper: of each coordinate); impulse: some ranges are wrong."""
    count, step = len(cloud), spec.severity - 1
    paper = spec.calibration == "paper"
    if spec.name == "impulse":
        share = table.LIDAR_IMPULSE[step]
        struck = draws.permutation(count)[: int(count * share)]
        if paper:
            cloud[struck, :3] += draws.choice([-0.1, 0.1], size=(len(struck), 3)).astype(np.float32)
        else:
            ranges = _ranges(cloud[struck])
            cloud[struck, :3] *= (draws.uniform(1.0, np.maximum(ranges, 1.5)) / ranges).astype(np.float32)[:, None]
        return cloud, Applied(len(struck) > 0, {"points": len(struck)})
    level = table.LIDAR_NOISE[step]
    size = (count, 3) if paper else (count,)
    noise = draws.normal(0, level, size) if spec.name == "gaussian" else draws.uniform(-level, level, size)
    if paper:
        cloud[:, :3] += noise.astype(np.float32)
    else:
        cloud[:, :3] *= (1 + noise / _ranges(cloud)).astype(np.float32)[:, None]
    return cloud, Applied(count > 0, {"level_m": level})


def inside(cloud: F32 | F64, matrix: F64, centre: F64) -> Bool:
    """Which points [P] lie in the box that the matrix [3, 3] makes of the unit cube."""
    local = (cloud[:, :3] - centre) @ np.linalg.inv(matrix).T
    return np.asarray((np.abs(local) <= 0.5).all(1))


def _objects(cloud: F32, frame: SweepFrame, spec: ShiftSpec, draws: np.random.Generator) -> tuple[F32, Applied]:
    """The points in each box move with it. Each point belongs to one box, the first that holds it."""
    boxes = frame.boxes
    if not len(boxes) or not len(cloud):
        return cloud, Applied(False, {"objects": 0})
    pose = frame.ego_to_world @ frame.to_ego
    turn, place = pose[:3, :3].T, pose[:3, 3]
    old, old_centre = affine(boxes)
    new, new_centre = deformed(spec, boxes, scene=frame.scene, sample=frame.sample, lidar=True)
    old, new = turn @ old, turn @ new
    old_centre, new_centre = (old_centre - place) @ turn.T, (new_centre - place) @ turn.T
    free = np.ones(len(cloud), bool)
    result, moved, done, still = cloud.copy(), 0, 0, 0
    reach = np.linalg.norm(boxes.size_lwh, axis=1) / 2 + 0.5
    for n in range(len(boxes)):
        near = np.flatnonzero(free & (np.abs(cloud[:, :2] - old_centre[n, :2]).max(1) < reach[n]))
        mine = near[inside(cloud[near], old[n], old_centre[n])]
        if not len(mine):
            continue
        free[mine] = False
        local = (cloud[mine, :3] - old_centre[n]) @ np.linalg.inv(old[n]).T
        if spec.name == "motion_blur":
            shift = _streak(local, boxes.velocity[n] @ turn.T, spec, draws)
            if shift is None:
                still += 1
                continue
            result[mine, :3] = cloud[mine, :3] + shift
        else:
            result[mine, :3] = local @ new[n].T + new_centre[n]
        moved, done = moved + len(mine), done + 1
    skipped = {"it does not move or its velocity is unknown": still} if still else {}
    return result, Applied(done > 0, {"objects": done, "points": moved}, skipped)


def _streak(local: F64, velocity: F64, spec: ShiftSpec, draws: np.random.Generator) -> F32 | None:
    """Displacement of an object's points. Physical: by its velocity over the exposure; paper: thirds shifted apart."""
    speed = float(np.linalg.norm(velocity))
    if not np.isfinite(speed) or speed < 0.2:
        return None
    if spec.calibration == "paper":
        third = np.clip(np.floor((local[:, 0] + 0.5) * 3), 0, 2) - 1
        return np.asarray(third[:, None] * 0.2 * spec.severity * velocity / speed, np.float32)
    late = draws.uniform(-0.5, 0.5, len(local)) * table.BLUR_EXPOSURE[spec.severity - 1]
    return np.asarray(late[:, None] * velocity, np.float32)


def _sun(
    cloud: F32, frame: SweepFrame, spec: ShiftSpec, context: SceneContext, draws: np.random.Generator
) -> tuple[F32, Applied]:
    """Towards the sun the receiver is blind; background light makes some ranges noise of 2 m."""
    step = spec.severity - 1
    toward = (frame.ego_to_world @ frame.to_ego)[:3, :3].T @ sun_direction(spec, context)
    ranges = _ranges(cloud)
    angle = np.degrees(np.arccos(np.clip((cloud[:, :3] @ toward) / ranges, -1, 1)))
    seen = angle > table.LIDAR_SUN_CONE[step]
    struck = draws.random(len(cloud)) < table.LIDAR_SUN[step]
    noise = np.maximum(1 + draws.normal(0, 2.0, len(cloud)) / ranges, 0.2)
    cloud[struck, :3] *= noise[struck].astype(np.float32)[:, None]
    return cloud[seen], Applied(True, {"lost": int((~seen).sum()), "noisy": int((struck & seen).sum())})


def fog_response(beta: float) -> tuple[F64, F64, F64]:
    """Strongest echo of the fog itself, in front of a hard target.

    Args:
        beta: Extinction, 1/m.

    Returns:
        Three arrays [K]. Ranges R of the hard target, m; the strongest echo of the fog before it, s / m^2 (multiplied
        by R^2 and by backscatter over beta_0, it is relative to the hard target's echo in clear air); range from which
        it comes, m.

    Source: Hahner, Sakaridis, Dai and Van Gool, ICCV 2021, equation 10: the echo integrated over a pulse of 2 x 10 ns.
    """
    ranges = np.arange(0.5, 120.0, 0.1)
    half_pulse, light = 10e-9, 2.998e8
    t = np.linspace(0, 2 * half_pulse, 41)
    back = ranges[:, None] - light * t[None] / 2
    crossover = np.clip((back - 0.9) / 0.1, 0, 1)
    safe = np.maximum(back, 0.5)
    echo = np.sin(np.pi * t / (2 * half_pulse)) ** 2 * np.exp(-2 * beta * safe) / safe**2 * crossover
    strength = np.trapezoid(echo, t, axis=1)
    best = np.maximum.accumulate(strength)
    place = np.maximum.accumulate(np.where(strength >= best, np.arange(len(ranges)), 0))
    return ranges, best, ranges[place]


def _fog(cloud: F32, spec: ShiftSpec, draws: np.random.Generator) -> tuple[F32, Applied]:
    """Echoes get weaker by exp(-2 beta R); where the fog's own echo is stronger it is taken for the target."""
    beta = extinction(spec)
    ranges = _ranges(cloud)
    grid, best, place = fog_response(beta)
    backscatter = 0.046 * beta / 3.0  # 0.046 / MOR
    index = np.clip(((ranges - grid[0]) / 0.1).astype(int), 0, len(grid) - 1)
    before = cloud[:, 3].copy()
    hard = before * np.exp(-2 * beta * ranges)
    soft = cloud[:, 3] * ranges**2 * backscatter / _BETA_0 * best[index]
    fooled = soft > hard
    near = np.clip(place[index] + draws.normal(0, 0.3, len(cloud)), 0.8, None)
    cloud[fooled, :3] *= (np.minimum(near, ranges) / ranges)[fooled].astype(np.float32)[:, None]
    cloud[:, 3] = np.where(fooled, np.minimum(soft, 255), hard).astype(np.float32)
    seen = _detected(before, ranges, beta) | fooled
    return cloud[seen], Applied(True, {"lost": int((~seen).sum()), "moved": int(fooled.sum())})


def _detected(intensity: F32, ranges: F64, beta: float) -> Bool:
    """Echoes still above the sensor's threshold: that of intensity 1 at FARTHEST in clear air. What was there stays."""
    lit = np.maximum(intensity, 1) / ranges**2
    return np.asarray(lit * np.exp(-2 * beta * ranges) >= np.minimum(1.0 / FARTHEST**2, 0.5 * lit))


def _precipitation(cloud: F32, spec: ShiftSpec, draws: np.random.Generator) -> tuple[F32, Applied]:
    """Echoes get weaker; now and then a drop or flake near the sensor is hit first (Goodin et al. 2019)."""
    beta = extinction(spec)
    ranges = _ranges(cloud)
    before = cloud[:, 3].copy()
    hard = before * np.exp(-2 * beta * ranges)
    # a beam meets particles at the rate beta; one is seen if large and near enough
    rate = beta * (0.06 if spec.name == "rain" else 0.4)
    meets = draws.exponential(1 / rate, len(cloud)) + 1.0
    hit = meets < np.minimum(ranges, 25.0 if spec.name == "snow" else 12.0)
    cloud[hit, :3] *= (meets / ranges)[hit].astype(np.float32)[:, None]
    bright = draws.uniform(0, 12 if spec.name == "rain" else 40, len(cloud))
    cloud[:, 3] = np.where(hit, bright, hard).astype(np.float32)
    jitter = draws.normal(0, 0.02 * (1 - np.exp(-beta * ranges)), len(cloud))
    cloud[~hit, :3] *= (1 + jitter / ranges)[~hit].astype(np.float32)[:, None]
    seen = _detected(before, ranges, beta) | hit
    return cloud[seen], Applied(True, {"lost": int((~seen).sum()), "moved": int(hit.sum())})
