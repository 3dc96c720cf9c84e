"""Sweeps of a spinning LiDAR over a stage: the triangles that the camera sees, met by rays.

Sensor frame as in nuScenes: x right, y forward, z up. A turn begins behind the sensor and goes clockwise seen from
above (left, front, right); points come in the order in which they are fired, ring 0 is the lowest beam.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import warp as wp

from ssad.core.boxes import WorldBoxes
from ssad.core.errors import ConfigError
from ssad.core.rotations import quaternion_to_matrix
from ssad.core.seeding import generator
from ssad.core.types import F32, F64, I32
from ssad.rendering.camera.kernels import lidar as kernels
from ssad.rendering.camera.scene import Scene, Thing

GLASS = 0.3  # share of beams that a pane returns
FALL = 50.0  # m at which the intensity has halved
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])

ON_ROOF: F64 = np.array([[0.0, 1, 0, 0.94], [-1, 0, 0, 0], [0, 0, 1, 1.84], [0, 0, 0, 1]])


@dataclass(frozen=True, slots=True)
class Lidar:
    """A spinning LiDAR.

    Attributes:
        beams: Elevations, lowest first, rad.
        azimuths: Columns in a turn.
        to_ego: Sensor to ego [4, 4].
        reach: m.
        noise: Standard deviation of the range, m.
        period: Time of a turn, s.
        blind: Distance within which nothing returns, m.
        lost: Share of returns that are lost whatever they hit.
        faint: Share of light (albedo times cosine of incidence over squared metres) at which a return is lost with
            probability 1/e; 0: none is lost for being faint.
        width: Horizontal field, about the direction ahead, rad.
    """

    beams: F64
    azimuths: int
    to_ego: F64 = field(default_factory=ON_ROOF.copy)
    reach: float = 100.0
    noise: float = 0.02
    period: float = 0.05
    blind: float = 0.9
    lost: float = 0.003
    faint: float = 1e-6
    width: float = 2.0 * np.pi

    def directions(self) -> F64:
        """Unit directions [azimuths, beams, 3] in the sensor frame."""
        heading = (np.arange(self.azimuths) + 0.5) * (self.width / self.azimuths) - 0.5 * self.width
        up = np.asarray(self.beams, np.float64)
        flat = np.stack([np.sin(heading), np.cos(heading), np.zeros_like(heading)], -1)
        rays = np.cos(up)[None, :, None] * flat[:, None]
        rays[..., 2] = np.sin(up)
        return np.asarray(rays)


HDL32E = Lidar(np.deg2rad(np.linspace(-30.67, 10.67, 32)), 1084)
"""The LiDAR of nuScenes: Velodyne HDL-32E at 20 Hz, on the roof."""


class _Scene:
    """Index of a stage for rays: the street at full detail, once, and each mesh at its first use.

    The faces of all are numbered consecutively; `material` holds the material of each.
    """

    def __init__(self, stage: Scene) -> None:
        self.device = stage.device
        self.street: Any = None
        self.meshes: dict[int, tuple[Any, int, F64, float]] = {}
        self.material: list[I32] = []
        self.total = 0
        self._on_device: Any = None
        table = stage.surfaces.numpy()
        colour = np.asarray(table["colour"], np.float64)
        light = colour @ LUMINANCE
        echo = np.where(table["paint"] == 1, -1.0, light).astype(np.float32)
        # panes are dark and mirror; lamps are bright or lit
        clear = (table["specular"] > 0.075) & (table["gloss"] > 0.85) & (light < 0.2) & (table["emission"] == 0.0)
        self.echo = wp.array(echo, dtype=float, device=stage.device)
        self.clear = wp.array((clear & (table["paint"] == 0)).astype(np.int32), dtype=int, device=stage.device)
        if stage.street is not None:
            street = stage.street
            full = np.asarray(street.order[street.offset[0, 0] : street.offset[0, -1]], np.int32)
            self.street = self._mesh(stage, full)[0]

    def _mesh(self, stage: Scene, listed: I32) -> tuple[Any, int, F64]:
        """A mesh of these faces, the number of its first face, and its vertices; None without faces."""
        faces = stage.faces.numpy()[listed]
        used, index = np.unique(faces, return_inverse=True)
        points = stage.vertices.numpy()[used]
        first = self.total
        self.total += len(listed)
        self.material.append(stage.material.numpy()[listed])
        self._on_device = None
        if not len(listed):
            return None, first, points
        points = wp.array(points, dtype=wp.vec3, device=stage.device)
        index = wp.array(index.reshape(-1).astype(np.int32), dtype=int, device=stage.device)
        return wp.Mesh(points=points, indices=index), first, points.numpy()

    def body(self, stage: Scene, mesh: int) -> tuple[Any, int, F64, float]:
        """Mesh, number of its first face, middle [3] and radius of its bounding sphere in its own frame."""
        if mesh not in self.meshes:
            at = stage.first[mesh]
            made, first, points = self._mesh(stage, stage.listed.numpy()[at : at + stage.count[mesh]])
            middle = (points.min(0) + points.max(0)).astype(np.float64) / 2
            radius = float(np.linalg.norm(points - middle, axis=1).max()) * 1.0001 + 1e-4
            self.meshes[mesh] = (made, first, middle, radius)
        return self.meshes[mesh]

    def materials(self) -> Any:
        """Material of each face."""
        if self._on_device is None:
            rows = np.concatenate(self.material) if self.material else np.zeros(0, np.int32)
            self._on_device = wp.array(rows.astype(np.int32), dtype=int, device=self.device)
        return self._on_device


_scenes: WeakKeyDictionary[Scene, _Scene] = WeakKeyDictionary()


def sweep(
    stage: Scene,
    lidar: Lidar,
    ego_to_world: F64,
    things: Sequence[Thing],
    *,
    key: tuple[object, ...],
    motion: bool = False,
    before: tuple[F64, Sequence[Thing]] | None = None,
) -> tuple[F32, I32]:
    """One turn of a LiDAR.

    With `motion`, the turn ends at the moment given and began one period earlier. Its points are given in the sensor
    frame at the end: the motion of the ego is compensated, that of others is not.

    Args:
        stage: The scene.
        lidar: The LiDAR.
        ego_to_world: [4, 4].
        things: What stands there.
        key: Key of the noise, e.g. (seed, scene, sample).
        motion: Whether the sensor and the things move during the turn.
        before: Pose of the ego [4, 4], and things (identified by their tags; their rotation is ignored), one period
            earlier.

    Returns:
        Points [P, 5] (x, y, z in the sensor frame, m; intensity 0..255; ring) and tags [P] (0: street).

    Raises:
        ConfigError: The LiDAR, poses or things do not fit.
    """
    _check(stage, lidar, ego_to_world, things)
    things = [t for t in things if stage.count[t.mesh]]
    if motion and before is None:
        raise ConfigError("sweep: motion needs `before`, the ego's pose and the things one period earlier")
    scene = _scenes.get(stage)
    if scene is None:
        scene = _scenes[stage] = _Scene(stage)
    rays = lidar.directions()
    count, beams = rays.shape[:2]
    to_world = np.asarray(ego_to_world, np.float64) @ lidar.to_ego
    eye, turn = to_world[:3, 3], to_world[:3, :3]
    times, offsets = np.zeros(count), np.zeros((count, 3))
    turns, velocities = turn[None], np.zeros((len(things), 3))
    if motion and before is not None:
        _check(stage, lidar, before[0], before[1])
        times = ((np.arange(count) + 0.5) / count - 1.0) * lidar.period
        turns, offsets = _path(before[0] @ lidar.to_ego, to_world, times / lidar.period)
        velocities = _velocities(things, before[1], lidar.period)
    directions = np.matmul(rays, np.swapaxes(turns, -1, -2)).astype(np.float32)
    rows, spheres = _targets(stage, scene, things, eye, velocities)
    listed, starts = _columns(directions, spheres, lidar, (offsets, times, velocities))
    random = generator(*key, "lidar")
    noise = random.standard_normal((count, beams), np.float32)
    luck = random.random((count, beams), np.float32)
    chance = random.random((count, beams, 3), np.float32)
    device, shape = stage.device, (count, beams)

    def on(values: Any, dtype: Any) -> Any:
        return wp.array(values, dtype=dtype, device=device)

    results = [wp.zeros(shape, dtype=d, device=device) for d in (float, float, float, int)]
    inputs = [
        scene.street.id if scene.street is not None else wp.uint64(0),
        wp.vec3(*eye),
        on(rows, kernels.Target),
        on(listed, int),
        on(starts, int),
        on(directions, wp.vec3),
        on(offsets.astype(np.float32), wp.vec3),
        on(times.astype(np.float32), float),
        scene.materials(),
        scene.echo,
        scene.clear,
        on(chance, float),
        GLASS,
        float(lidar.reach),
    ]
    wp.launch(kernels.cast, dim=shape, inputs=inputs, outputs=results, device=device)
    distance, cosine, albedo, tag = (r.numpy() for r in results)
    keep = distance > lidar.blind
    if lidar.faint > 0.0:
        light = albedo * cosine / np.maximum(distance, 1e-3) ** 2
        keep &= luck < (1.0 - lidar.lost) * -np.expm1(-light / lidar.faint)
    else:
        keep &= luck >= lidar.lost
    column, ring = np.nonzero(keep)
    away = distance[keep].astype(np.float64) + lidar.noise * noise[keep]
    points = (offsets[column] + directions[keep] * away[:, None]) @ turn if motion else rays[keep] * away[:, None]
    bright = 255.0 * albedo[keep] * cosine[keep] / (1.0 + (distance[keep] / FALL) ** 2)
    out = np.empty((len(points), 5), np.float32)
    out[:, :3] = points
    out[:, 3] = np.rint(np.clip(bright, 0.0, 255.0))
    out[:, 4] = ring
    return out, tag[keep].astype(np.int32)


def _check(stage: Scene, lidar: Lidar, ego_to_world: F64, things: Sequence[Thing]) -> None:
    """ConfigError for what no sweep can be made of."""
    beams = np.asarray(lidar.beams)
    if beams.ndim != 1 or not beams.size or not np.isfinite(beams).all() or lidar.azimuths < 1:
        raise ConfigError("lidar: needs at least one beam (finite elevations, rad) and one azimuth")
    if not (0 < lidar.reach < np.inf and 0 <= lidar.noise < np.inf and lidar.period > 0 and 0 <= lidar.lost <= 1):
        raise ConfigError("lidar: reach and period must be positive, noise not negative, lost in 0..1")
    if np.shape(ego_to_world) != (4, 4) or not np.isfinite(ego_to_world).all():
        raise ConfigError("sweep: the pose of the ego is not a finite 4 x 4 matrix")
    for thing in things:
        if not 0 <= thing.mesh < len(stage.first):
            raise ConfigError(f"sweep: thing {thing.tag} has mesh {thing.mesh}, the stage has {len(stage.first)}")
        if np.shape(thing.pose) != (4, 4) or not np.isfinite(thing.pose).all():
            raise ConfigError(f"sweep: the pose of thing {thing.tag} is not a finite 4 x 4 matrix")


def _path(first: F64, last: F64, share: F64) -> tuple[F64, F64]:
    """Rotations [A, 3, 3] and offsets from the end [A, 3] on the way from one pose to another; share [A] in -1..0."""
    back = first[:3, :3] @ last[:3, :3].T
    angle = float(np.arccos(np.clip((np.trace(back) - 1) / 2, -1.0, 1.0)))
    axis = np.array([back[2, 1] - back[1, 2], back[0, 2] - back[2, 0], back[1, 0] - back[0, 1]])
    long = float(np.linalg.norm(axis))
    axis = axis / long if long > 1e-12 else np.array([0.0, 0.0, 1.0])
    half = -share * angle / 2
    partly = quaternion_to_matrix(np.concatenate([np.cos(half)[:, None], np.sin(half)[:, None] * axis], 1))
    return partly @ last[:3, :3], share[:, None] * (last[:3, 3] - first[:3, 3])


def _velocities(things: Sequence[Thing], before: Sequence[Thing], period: float) -> F64:
    """Velocities of things [T, 3], m/s; of a tag the first was the first before. Tags below 1 and new ones rest."""
    past: dict[int, list[F64]] = {}
    for thing in before:
        past.setdefault(thing.tag, []).append(thing.pose[:3, 3])
    moved = np.zeros((len(things), 3))
    for n, thing in enumerate(things):
        if thing.tag > 0 and past.get(thing.tag):
            moved[n] = thing.pose[:3, 3] - past[thing.tag].pop(0)
    return moved / period


def _targets(
    stage: Scene, scene: _Scene, things: Sequence[Thing], eye: F64, velocities: F64
) -> tuple[Any, tuple[F64, F64]]:
    """Rows of `Target` for things, and their bounding spheres: middle relative to the eye [T, 3], radius [T]."""
    rows: Any = np.zeros(len(things), kernels.Target.numpy_dtype())  # type: ignore[attr-defined]
    middles, radii = np.zeros((len(things), 3)), np.zeros(len(things))
    for n, thing in enumerate(things):
        mesh, first, middle, radius = scene.body(stage, thing.mesh)
        pose = np.asarray(thing.pose, np.float64)
        inverse = np.linalg.inv(pose)
        middles[n] = pose[:3, :3] @ middle + pose[:3, 3] - eye
        radii[n] = radius
        rows[n]["mesh"] = mesh.id
        rows[n]["turn"] = inverse[:3, :3]
        rows[n]["place"] = inverse[:3, :3] @ eye + inverse[:3, 3]
        rows[n]["first"] = first
        rows[n]["paint"] = float(np.asarray(thing.paint) @ LUMINANCE)
        rows[n]["tag"] = max(thing.tag, 0)
    rows["velocity"], rows["centre"], rows["radius"] = velocities, middles, radii
    return rows, (middles, radii)


def _columns(directions: F32, spheres: tuple[F64, F64], lidar: Lidar, moves: tuple[F64, F64, F64]) -> tuple[I32, I32]:
    """For each column the things within reach that its rays may meet, near ones first: rows, and starts [A + 1]."""
    middles, radii = spheres
    offsets, times, velocities = moves
    count, beams = directions.shape[:2]
    if not len(radii):
        return np.zeros(0, np.int32), np.zeros(count + 1, np.int32)
    order = np.argsort(np.linalg.norm(middles, axis=1) - radii, kind="stable")
    middles, radii, velocities = middles[order], radii[order], velocities[order]
    away = np.linalg.norm(middles, axis=1)
    slack = np.linalg.norm(offsets, axis=1).max() + np.linalg.norm(velocities, axis=1) * np.abs(times).max()
    wide = radii + slack + 1e-3
    # a sphere fills a cone about its middle; so do the rays of a column, about the middle of the lowest and highest
    lean = directions[:, 0] + directions[:, beams - 1]
    lean = lean / np.maximum(np.linalg.norm(lean, axis=1, keepdims=True), 1e-9)
    spread = np.arccos(np.clip((directions * lean[:, None]).sum(-1).min(1), -1.0, 1.0))
    cone = np.where(away > wide, np.arcsin(np.minimum(wide / np.maximum(away, 1e-9), 1.0)), np.pi)
    between = np.arccos(np.clip(lean @ (middles / np.maximum(away, 1e-9)[:, None]).T, -1.0, 1.0))
    near = (between <= spread[:, None] + cone[None] + 1e-4) & (away - wide < lidar.reach)[None]
    # across the plane of a column a sphere must come nearer than its radius
    normal = np.cross(directions[:, 0], directions[:, beams - 1]).astype(np.float64)
    long = np.linalg.norm(normal, axis=1, keepdims=True)
    flat = np.abs(np.einsum("ai,abi->ab", normal, directions)).max(1) < 1e-4 * long[:, 0]
    across = np.abs((normal / np.maximum(long, 1e-9)) @ middles.T)
    near &= (across <= wide[None] + 1e-3 * away[None]) | ~flat[:, None]
    column, thing = np.nonzero(near)
    starts = np.searchsorted(column, np.arange(count + 1))
    return order[thing].astype(np.int32), starts.astype(np.int32)


def points_in_boxes(points_world: F64, boxes: WorldBoxes) -> I32:
    """Points [P, 3 or more] (world, m) in each of N boxes [N], those on its surface among them."""
    points = np.asarray(points_world, np.float64)[:, :3]
    counts = np.zeros(len(boxes), np.int32)
    points = points[np.argsort(points[:, 0], kind="stable")]
    half = boxes.size_lwh / 2
    reach = np.linalg.norm(half, axis=1)
    turn = boxes.axes()
    low = np.searchsorted(points[:, 0], boxes.centre[:, 0] - reach, "left")
    high = np.searchsorted(points[:, 0], boxes.centre[:, 0] + reach, "right")
    for n in range(len(boxes)):
        local = (points[low[n] : high[n]] - boxes.centre[n]) @ turn[n]
        counts[n] = int((np.abs(local) <= half[n]).all(1).sum())
    return counts
