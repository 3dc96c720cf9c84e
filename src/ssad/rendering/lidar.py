"""Sweeps of a spinning LiDAR: rays against the triangles that the camera renders.

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
from ssad.core.colours import LUMINANCE
from ssad.core.errors import ConfigError
from ssad.core.rotations import quaternion_to_matrix
from ssad.core.seeding import generator
from ssad.core.types import F32, F64, I32
from ssad.rendering.camera.kernels import lidar as kernels
from ssad.rendering.camera.scene import RenderScene, SceneObject

GLASS = 0.3  # share of beams that a pane of glass returns
FALL = 50.0  # range at which the intensity is halved, m

ON_ROOF: F64 = np.array([[0.0, 1, 0, 0.94], [-1, 0, 0, 0], [0, 0, 1, 1.84], [0, 0, 0, 1]])


@dataclass(frozen=True, slots=True)
class Lidar:
    """Spinning LiDAR.

    Attributes:
        beams: Elevations, lowest first, rad.
        azimuths: Columns in a turn.
        to_ego: Sensor to ego [4, 4].
        reach: Maximum range, m.
        noise: Standard deviation of the range, m.
        period: Time of a turn, s.
        blind: Distance within which nothing returns, m.
        lost: Share of returns that are lost at random.
        faint: Share of light (albedo times cosine of incidence over squared metres) at which a return is lost
            with probability 1/e; 0: faint returns are kept.
        width: Horizontal field of view, centred ahead, rad.
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
        """Return unit directions [azimuths, beams, 3] in the sensor frame."""
        headings = (np.arange(self.azimuths) + 0.5) * (self.width / self.azimuths) - 0.5 * self.width
        elevations = np.asarray(self.beams, np.float64)
        level_directions = np.stack([np.sin(headings), np.cos(headings), np.zeros_like(headings)], -1)
        rays = np.cos(elevations)[None, :, None] * level_directions[:, None]
        rays[..., 2] = np.sin(elevations)
        return np.asarray(rays)


HDL32E = Lidar(np.deg2rad(np.linspace(-30.67, 10.67, 32)), 1084)
"""The LiDAR of nuScenes: Velodyne HDL-32E at 20 Hz, on the roof."""


class _RayScene:
    """Ray index of a scene: the street at full detail, once, and each mesh at its first use.

    The faces of all are numbered consecutively; `material` holds the material of each.
    """

    def __init__(self, scene: RenderScene) -> None:
        self.device = scene.device
        self.street: Any = None
        self.meshes: dict[int, tuple[Any, int, F64, float]] = {}
        self.material: list[I32] = []
        self.total = 0
        self._on_device: Any = None
        surfaces = scene.surfaces.numpy()
        colours = np.asarray(surfaces["colour"], np.float64)
        luminance = colours @ LUMINANCE
        echo = np.where(surfaces["paint"] == 1, -1.0, luminance).astype(np.float32)
        # Panes are dark and specular; lamps are bright or emit.
        is_glass = (
            (surfaces["specular"] > 0.075)
            & (surfaces["gloss"] > 0.85)
            & (luminance < 0.2)
            & (surfaces["emission"] == 0.0)
        )
        self.echo = wp.array(echo, dtype=float, device=scene.device)
        self.clear = wp.array((is_glass & (surfaces["paint"] == 0)).astype(np.int32), dtype=int, device=scene.device)
        if scene.street is not None:
            street = scene.street
            street_faces = np.asarray(street.order[street.offset[0, 0] : street.offset[0, -1]], np.int32)
            self.street = self._mesh(scene, street_faces)[0]

    def _mesh(self, scene: RenderScene, face_list: I32) -> tuple[Any, int, F64]:
        """A mesh of these faces, the number of its first face, and its vertices; None without faces."""
        faces = scene.faces.numpy()[face_list]
        vertex_indices, indices = np.unique(faces, return_inverse=True)
        points = scene.vertices.numpy()[vertex_indices]
        first_face = self.total
        self.total += len(face_list)
        self.material.append(scene.material.numpy()[face_list])
        self._on_device = None
        if not len(face_list):
            return None, first_face, points
        points = wp.array(points, dtype=wp.vec3, device=scene.device)
        indices = wp.array(indices.reshape(-1).astype(np.int32), dtype=int, device=scene.device)
        return wp.Mesh(points=points, indices=indices), first_face, points.numpy()

    def body(self, scene: RenderScene, mesh: int) -> tuple[Any, int, F64, float]:
        """Return mesh, number of its first face, middle [3] and radius of its bounding sphere in its own frame."""
        if mesh not in self.meshes:
            first_entry = scene.first[mesh]
            ray_mesh, first_face, points = self._mesh(
                scene, scene.listed.numpy()[first_entry : first_entry + scene.count[mesh]]
            )
            middle = (points.min(0) + points.max(0)).astype(np.float64) / 2
            # The margin covers the rounding to float32 in the kernel.
            radius = float(np.linalg.norm(points - middle, axis=1).max()) * 1.0001 + 1e-4
            self.meshes[mesh] = (ray_mesh, first_face, middle, radius)
        return self.meshes[mesh]

    def materials(self) -> Any:
        """Return the material of each face as a device array."""
        if self._on_device is None:
            rows = np.concatenate(self.material) if self.material else np.zeros(0, np.int32)
            self._on_device = wp.array(rows.astype(np.int32), dtype=int, device=self.device)
        return self._on_device


_scenes: WeakKeyDictionary[RenderScene, _RayScene] = WeakKeyDictionary()


def sweep(
    scene: RenderScene,
    lidar: Lidar,
    ego_to_world: F64,
    objects: Sequence[SceneObject],
    *,
    key: tuple[object, ...],
    motion: bool = False,
    previous: tuple[F64, Sequence[SceneObject]] | None = None,
) -> tuple[F32, I32]:
    """One turn of a LiDAR.

    With `motion`, the turn ends at the moment given and began one period earlier. Its points are given in the sensor
    frame at the end: the motion of the ego is compensated, that of others is not.

    Args:
        scene: The scene.
        lidar: The LiDAR.
        ego_to_world: [4, 4].
        objects: Objects in the scene.
        key: Key of the noise, e.g. (seed, scene, sample).
        motion: Whether the sensor and the things move during the turn.
        previous: Pose of the ego [4, 4], and things (identified by their tags; their rotation is ignored), one period
            earlier.

    Returns:
        Points [P, 5] (x, y, z in the sensor frame, m; intensity 0..255; ring) and tags [P] (0: street).

    Raises:
        ConfigError: The LiDAR, poses or things do not fit.
    """
    _check(scene, lidar, ego_to_world, objects)
    objects = [scene_object for scene_object in objects if scene.count[scene_object.mesh]]
    if motion and previous is None:
        raise ConfigError("sweep: motion needs `before`, the ego's pose and the things one period earlier")
    ray_scene = _scenes.get(scene)
    if ray_scene is None:
        ray_scene = _scenes[scene] = _RayScene(scene)
    rays = lidar.directions()
    column_count, beams = rays.shape[:2]
    to_world = np.asarray(ego_to_world, np.float64) @ lidar.to_ego
    sensor_position, to_world_rotation = to_world[:3, 3], to_world[:3, :3]
    fire_times, offsets = np.zeros(column_count), np.zeros((column_count, 3))
    rotations, velocities = to_world_rotation[None], np.zeros((len(objects), 3))
    if motion and previous is not None:
        _check(scene, lidar, previous[0], previous[1])
        fire_times = ((np.arange(column_count) + 0.5) / column_count - 1.0) * lidar.period
        rotations, offsets = _path(previous[0] @ lidar.to_ego, to_world, fire_times / lidar.period)
        velocities = _velocities(objects, previous[1], lidar.period)
    directions = np.matmul(rays, np.swapaxes(rotations, -1, -2)).astype(np.float32)
    target_rows, spheres = _targets(scene, ray_scene, objects, sensor_position, velocities)
    target_list, column_starts = _columns(directions, spheres, lidar, (offsets, fire_times, velocities))
    random_source = generator(*key, "lidar")
    # All numbers are drawn for every beam, so that objects do not change the noise of others.
    noise = random_source.standard_normal((column_count, beams), np.float32)
    loss_draws = random_source.random((column_count, beams), np.float32)
    pane_draws = random_source.random((column_count, beams, 3), np.float32)
    device, shape = scene.device, (column_count, beams)

    def to_device(values: Any, dtype: Any) -> Any:
        return wp.array(values, dtype=dtype, device=device)

    results = [wp.zeros(shape, dtype=element_type, device=device) for element_type in (float, float, float, int)]
    inputs = [
        ray_scene.street.id if ray_scene.street is not None else wp.uint64(0),
        wp.vec3(*sensor_position),
        to_device(target_rows, kernels.Target),
        to_device(target_list, int),
        to_device(column_starts, int),
        to_device(directions, wp.vec3),
        to_device(offsets.astype(np.float32), wp.vec3),
        to_device(fire_times.astype(np.float32), float),
        ray_scene.materials(),
        ray_scene.echo,
        ray_scene.clear,
        to_device(pane_draws, float),
        GLASS,
        float(lidar.reach),
    ]
    wp.launch(kernels.cast, dim=shape, inputs=inputs, outputs=results, device=device)
    distances, cosine, albedo, tags = (array.numpy() for array in results)
    is_returned = distances > lidar.blind
    if lidar.faint > 0.0:
        received = albedo * cosine / np.maximum(distances, 1e-3) ** 2
        is_returned &= loss_draws < (1.0 - lidar.lost) * -np.expm1(-received / lidar.faint)
    else:
        is_returned &= loss_draws >= lidar.lost
    columns, rings = np.nonzero(is_returned)
    ranges = distances[is_returned].astype(np.float64) + lidar.noise * noise[is_returned]
    positions = (
        (offsets[columns] + directions[is_returned] * ranges[:, None]) @ to_world_rotation
        if motion
        else rays[is_returned] * ranges[:, None]
    )
    intensities = 255.0 * albedo[is_returned] * cosine[is_returned] / (1.0 + (distances[is_returned] / FALL) ** 2)
    cloud = np.empty((len(positions), 5), np.float32)
    cloud[:, :3] = positions
    cloud[:, 3] = np.rint(np.clip(intensities, 0.0, 255.0))
    cloud[:, 4] = rings
    return cloud, tags[is_returned].astype(np.int32)


def _check(scene: RenderScene, lidar: Lidar, ego_to_world: F64, objects: Sequence[SceneObject]) -> None:
    """Raise ConfigError if the arguments allow no sweep."""
    beams = np.asarray(lidar.beams)
    if beams.ndim != 1 or not beams.size or not np.isfinite(beams).all() or lidar.azimuths < 1:
        raise ConfigError("lidar: needs at least one beam (finite elevations, rad) and one azimuth")
    if not (0 < lidar.reach < np.inf and 0 <= lidar.noise < np.inf and lidar.period > 0 and 0 <= lidar.lost <= 1):
        raise ConfigError("lidar: reach and period must be positive, noise not negative, lost in 0..1")
    if np.shape(ego_to_world) != (4, 4) or not np.isfinite(ego_to_world).all():
        raise ConfigError("sweep: the pose of the ego is not a finite 4 x 4 matrix")
    for scene_object in objects:
        if not 0 <= scene_object.mesh < len(scene.first):
            raise ConfigError(
                f"sweep: thing {scene_object.tag} has mesh {scene_object.mesh}, the stage has {len(scene.first)}"
            )
        if np.shape(scene_object.pose) != (4, 4) or not np.isfinite(scene_object.pose).all():
            raise ConfigError(f"sweep: the pose of thing {scene_object.tag} is not a finite 4 x 4 matrix")


def _path(first: F64, last: F64, share: F64) -> tuple[F64, F64]:
    """Interpolate between two poses.

    Args:
        first: Pose at share -1 [4, 4].
        last: Pose at share 0 [4, 4].
        share: Shares of the way [A], -1 to 0.

    Returns:
        Rotations [A, 3, 3] and offsets from the end [A, 3].
    """
    relative_rotation = first[:3, :3] @ last[:3, :3].T
    angle = float(np.arccos(np.clip((np.trace(relative_rotation) - 1) / 2, -1.0, 1.0)))
    axis = np.array(
        [
            relative_rotation[2, 1] - relative_rotation[1, 2],
            relative_rotation[0, 2] - relative_rotation[2, 0],
            relative_rotation[1, 0] - relative_rotation[0, 1],
        ]
    )
    axis_length = float(np.linalg.norm(axis))
    # Without rotation any axis will do.
    axis = axis / axis_length if axis_length > 1e-12 else np.array([0.0, 0.0, 1.0])
    half_angles = -share * angle / 2
    partial_rotations = quaternion_to_matrix(
        np.concatenate([np.cos(half_angles)[:, None], np.sin(half_angles)[:, None] * axis], 1)
    )
    return partial_rotations @ last[:3, :3], share[:, None] * (last[:3, 3] - first[:3, 3])


def _velocities(objects: Sequence[SceneObject], previous_objects: Sequence[SceneObject], period: float) -> F64:
    """Return the velocities of objects [T, 3], m/s, matched by tag; tags below 1 and new ones rest."""
    past_positions: dict[int, list[F64]] = {}
    for scene_object in previous_objects:
        past_positions.setdefault(scene_object.tag, []).append(scene_object.pose[:3, 3])
    displacements = np.zeros((len(objects), 3))
    for index, scene_object in enumerate(objects):
        if scene_object.tag > 0 and past_positions.get(scene_object.tag):
            displacements[index] = scene_object.pose[:3, 3] - past_positions[scene_object.tag].pop(0)
    return displacements / period


def _targets(
    rays: RenderScene, scene: _RayScene, objects: Sequence[SceneObject], eye: F64, velocities: F64
) -> tuple[Any, tuple[F64, F64]]:
    """Rows of `Target` for things, and their bounding spheres: middle relative to the eye [T, 3], radius [T]."""
    rows: Any = np.zeros(len(objects), kernels.Target.numpy_dtype())  # type: ignore[attr-defined]
    centres, radii = np.zeros((len(objects), 3)), np.zeros(len(objects))
    for index, scene_object in enumerate(objects):
        mesh, first_face, middle, radius = scene.body(rays, scene_object.mesh)
        pose = np.asarray(scene_object.pose, np.float64)
        inverse = np.linalg.inv(pose)
        centres[index] = pose[:3, :3] @ middle + pose[:3, 3] - eye
        radii[index] = radius
        rows[index]["mesh"] = mesh.id
        rows[index]["turn"] = inverse[:3, :3]
        rows[index]["place"] = inverse[:3, :3] @ eye + inverse[:3, 3]
        rows[index]["first"] = first_face
        rows[index]["paint"] = float(np.asarray(scene_object.paint) @ LUMINANCE)
        rows[index]["tag"] = max(scene_object.tag, 0)
    rows["velocity"], rows["centre"], rows["radius"] = velocities, centres, radii
    return rows, (centres, radii)


def _columns(directions: F32, spheres: tuple[F64, F64], lidar: Lidar, moves: tuple[F64, F64, F64]) -> tuple[I32, I32]:
    """For each column the things within reach that its rays may meet, near ones first: rows, and starts [A + 1]."""
    centres, radii = spheres
    offsets, times, velocities = moves
    column_count, beams = directions.shape[:2]
    if not len(radii):
        return np.zeros(0, np.int32), np.zeros(column_count + 1, np.int32)
    order = np.argsort(np.linalg.norm(centres, axis=1) - radii, kind="stable")
    centres, radii, velocities = centres[order], radii[order], velocities[order]
    distances = np.linalg.norm(centres, axis=1)
    displacement_bounds = (
        np.linalg.norm(offsets, axis=1).max() + np.linalg.norm(velocities, axis=1) * np.abs(times).max()
    )
    bounds = radii + displacement_bounds + 1e-3
    # A sphere fills a cone about its centre; so do the rays of a column, about the mean of the lowest and highest ray.
    column_axes = directions[:, 0] + directions[:, beams - 1]
    column_axes = column_axes / np.maximum(np.linalg.norm(column_axes, axis=1, keepdims=True), 1e-9)
    column_angles = np.arccos(np.clip((directions * column_axes[:, None]).sum(-1).min(1), -1.0, 1.0))
    sphere_angles = np.where(
        distances > bounds, np.arcsin(np.minimum(bounds / np.maximum(distances, 1e-9), 1.0)), np.pi
    )
    axis_angles = np.arccos(np.clip(column_axes @ (centres / np.maximum(distances, 1e-9)[:, None]).T, -1.0, 1.0))
    is_candidate = (axis_angles <= column_angles[:, None] + sphere_angles[None] + 1e-4) & (
        distances - bounds < lidar.reach
    )[None]
    # The plane of a column must cut the sphere.
    normals = np.cross(directions[:, 0], directions[:, beams - 1]).astype(np.float64)
    normal_lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    is_plane = np.abs(np.einsum("ai,abi->ab", normals, directions)).max(1) < 1e-4 * normal_lengths[:, 0]
    plane_distances = np.abs((normals / np.maximum(normal_lengths, 1e-9)) @ centres.T)
    is_candidate &= (plane_distances <= bounds[None] + 1e-3 * distances[None]) | ~is_plane[:, None]
    columns, object_indices = np.nonzero(is_candidate)
    column_starts = np.searchsorted(columns, np.arange(column_count + 1))
    return order[object_indices].astype(np.int32), column_starts.astype(np.int32)


def points_in_boxes(points_world: F64, boxes: WorldBoxes) -> I32:
    """Count the points [P, 3 or more] (world, m) in each of N boxes [N], including those on its surface."""
    points = np.asarray(points_world, np.float64)[:, :3]
    counts = np.zeros(len(boxes), np.int32)
    # Sorting by x limits the exact test to a slice of the points for each box.
    points = points[np.argsort(points[:, 0], kind="stable")]
    half_sizes = boxes.size_lwh / 2
    reach = np.linalg.norm(half_sizes, axis=1)
    box_axes = boxes.axes()
    starts = np.searchsorted(points[:, 0], boxes.centre[:, 0] - reach, "left")
    ends = np.searchsorted(points[:, 0], boxes.centre[:, 0] + reach, "right")
    for box_index in range(len(boxes)):
        local = (points[starts[box_index] : ends[box_index]] - boxes.centre[box_index]) @ box_axes[box_index]
        counts[box_index] = int((np.abs(local) <= half_sizes[box_index]).all(1).sum())
    return counts
