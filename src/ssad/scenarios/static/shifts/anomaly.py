"""Anomaly: objects of no class on the road of a scene, drawn into its images.

They stand still in the world beside the path of the ego and its continuation, clear of every annotated box, so that
all cameras show the same objects over the whole scene. Each is rendered by `ssad.rendering.camera`, exposed by the
brightness of the ground around it, and blended into the image in linear light behind nearer surfaces. LiDAR rays
that hit one return from it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from ssad.core.boxes import UNIT_CORNERS, TrackedBoxes
from ssad.core.frames import Camera, Frame, SceneContext, ShiftReport, StandingObject, SweepFrame, camera_to_world
from ssad.core.rotations import quaternion_to_yaw, upright_pose
from ssad.core.seeding import generator
from ssad.core.types import F32, F64, U8, Bool
from ssad.rendering.bodies import draw_paint, draw_size, draw_style, make_body
from ssad.rendering.camera.render import PLAIN, SceneWeather, View, render
from ssad.rendering.camera.scene import RenderScene, SceneObject
from ssad.rendering.camera.sensor import SensorModel
from ssad.rendering.meshes.mesh import Material, Mesh, build
from ssad.scenarios.static.shifts import parameters as table
from ssad.scenarios.static.shifts.batch import Batch, to_batch
from ssad.scenarios.static.shifts.light import to_codes, to_linear
from ssad.scenarios.static.shifts.spec import ShiftSpec

NEAREST = 0.3  # m before the camera
TRIES = 60  # positions to try for an object
EGO = (5.0, 2.2, 1.4)  # m: length and width of the ego, and distance of its centre ahead of its origin
CLEAR = 0.5  # m: gap between an object and everything else
MOVES = 0.5  # s: interval of samples, over which moving boxes sweep the ground
OVERCAST = SceneWeather(0.9, 0.8, 0.8)  # soft light, since the sun of the image is unknown
PLAIN_SENSOR = SensorModel(blur=0.0, mosaic=False)  # only its radiance is used
ALBEDO = 0.16  # of a road
DARKEST = 0.75  # maximum share of the light that a contact shadow takes
CELL, AROUND = 0.05, 0.8  # m: cell of a contact shadow, and its extent around the object
TINT = (0.85, 1.18)  # bounds of the light's ratio to grey
LIGHT: F32 = to_linear(np.arange(256)).astype(np.float32)


# ---------------------------------------------------------------- places


def place_objects(spec: ShiftSpec, scene: str, poses: F64, boxes: Sequence[TrackedBoxes]) -> tuple[StandingObject, ...]:
    """Place objects on the road of a scene for all severities; an object without a clear place is omitted.

    Args:
        spec: The shift; its severity does not matter.
        scene: Key of the scene.
        poses: Ego poses over the scene [N, 4, 4], in time order.
        boxes: Annotated boxes of each sample.
    """
    path, stations = _ego_path(poses)
    driven_length = stations[-2]
    piece_count = max(1, round((driven_length + table.ANOMALY_AHEAD) / table.ANOMALY_EVERY))
    piece_length = (driven_length + table.ANOMALY_AHEAD) / piece_count
    occupied_parts = [_swept_rectangles(candidate) for candidate in boxes if len(candidate)]
    ego_centres = poses[:, :2, 3] + EGO[2] * poses[:, :2, 0]
    heading = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
    ego_size = np.broadcast_to(EGO[:2], (len(poses), 2))
    occupied_parts.append(_rectangles(ego_centres, heading, ego_size))
    objects: list[StandingObject] = []
    for piece_index in range(piece_count):
        for anomaly_index, (kind, min_severity) in enumerate(table.ANOMALIES):
            draws = spec.generator("place", scene, piece_index, anomaly_index)
            style = draw_style(kind, generator=draws)
            length, width, height = draw_size(kind, style, generator=draws)
            seed = int(draws.integers(2**31))
            # All attempts are drawn at once, so that a failed one shifts no later draw.
            attempts = draws.uniform(0.0, 1.0, (TRIES, 3))
            occupied = np.concatenate(occupied_parts)
            for forward_share, lateral_share, yaw_share in attempts:
                station = table.ANOMALY_FIRST + (piece_index + forward_share) * piece_length
                position, path_heading = _position_at(path, stations, station)
                lateral_offset = (2.0 * lateral_share - 1.0) * (table.ANOMALY_ASIDE + 0.5 * min(length, width))
                position = position + lateral_offset * np.array([-np.sin(path_heading), np.cos(path_heading), 0.0])
                yaw = float(path_heading + 2.0 * np.pi * yaw_share)
                clear_size = np.array([[length, width]]) + CLEAR
                candidate = _rectangles(position[None, :2], np.array([yaw]), clear_size)
                if not _overlap(candidate[0], occupied).any():
                    x, y, z = position.tolist()
                    objects.append(
                        StandingObject(kind, style, seed, (length, width, height), (x, y, z), yaw, min_severity)
                    )
                    occupied_parts.append(candidate)
                    break
    return tuple(objects)


def _ego_path(poses: F64) -> tuple[F64, F64]:
    """Return the path of the ego [M, 3] and the arc length of each point, m; the last segment is straight."""
    points = [poses[0, :3, 3]]
    for position in poses[1:, :3, 3]:
        # Segments of a standing ego would have no direction.
        if np.hypot(*(position - points[-1])[:2]) > 0.5:
            points.append(position)
    direction = poses[-1, :3, 0] * [1.0, 1.0, 0.0]
    points.append(points[-1] + (table.ANOMALY_FIRST + table.ANOMALY_AHEAD) * direction / np.linalg.norm(direction))
    path = np.array(points)
    stations = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path[:, :2], axis=0).T))])
    return path, stations


def _position_at(path: F64, stations: F64, station: float) -> tuple[F64, float]:
    """Return position [3] and course (rad) at a distance along the path."""
    position = np.array([np.interp(station, stations, path[:, axis]) for axis in range(3)])
    segment = int(np.clip(np.searchsorted(stations, station, side="right") - 1, 0, len(path) - 2))
    direction = path[segment + 1] - path[segment]
    return position, float(np.arctan2(direction[1], direction[0]))


def _rectangles(centre: F64, yaw: F64, size: F64) -> F64:
    """Return the corners [N, 4, 2] of rectangles: centres [N, 2], yaw [N], length and width [N, 2]; around in order."""
    forward = np.stack([np.cos(yaw), np.sin(yaw)], -1)[:, None]
    left = np.stack([-np.sin(yaw), np.cos(yaw)], -1)[:, None]
    corner_signs = np.array([(0.5, 0.5), (-0.5, 0.5), (-0.5, -0.5), (0.5, -0.5)])
    corners = centre[:, None] + forward * (corner_signs[:, 0] * size[:, :1])[..., None]
    return np.asarray(corners + left * (corner_signs[:, 1] * size[:, 1:])[..., None])


def _swept_rectangles(boxes: TrackedBoxes) -> F64:
    """Return the ground [N, 4, 2] under boxes, extended by their motion between samples."""
    speed = np.nan_to_num(np.linalg.norm(boxes.velocity[:, :2], axis=1))
    size = boxes.size_lwh[:, :2] + np.stack([MOVES * speed, np.zeros(len(boxes))], 1)
    return _rectangles(boxes.centre[:, :2], np.asarray(quaternion_to_yaw(boxes.rotation)), size)


def _overlap(rectangle: F64, rectangles: F64) -> Bool:
    """Return a mask of the rectangles [N, 4, 2] that overlap another one [4, 2]: no line separates the two."""
    is_separated = np.zeros(len(rectangles), bool)
    for edge_index in range(2):
        for edge in (
            np.broadcast_to(rectangle[edge_index + 1] - rectangle[edge_index], (len(rectangles), 2)),
            rectangles[:, edge_index + 1] - rectangles[:, edge_index],
        ):
            projection, other_projections = (
                np.einsum("nk,ck->nc", edge, rectangle),
                np.einsum("nk,nck->nc", edge, rectangles),
            )
            is_separated |= (projection.max(1) < other_projections.min(1)) | (
                other_projections.max(1) < projection.min(1)
            )
    return ~is_separated


# ---------------------------------------------------------------- bodies


@dataclass(frozen=True, slots=True)
class _Model:
    """Object ready to be drawn.

    Attributes:
        stage: Scene with its mesh.
        paint: Linear RGB.
        shadow: Contact shadow [h, w]: share of the light that is blocked, by cells in the object's own frame.
        corner: x, y of the corner of `shadow` in that frame, m.
    """

    stage: RenderScene
    paint: tuple[float, float, float]
    shadow: F32
    corner: F64


@lru_cache(maxsize=64)
def _model(kind: str, style: str, seed: int, size: tuple[float, float, float]) -> _Model:
    draws = generator("anomaly", kind, style, seed)
    mesh = make_body(kind, style=style, size=size, generator=draws)
    return _Model(RenderScene(None, [mesh]), draw_paint(draws), *_contact_shadow(mesh))


def _contact_shadow(mesh: Mesh) -> tuple[F32, F64]:
    """Return the contact shadow [h, w], the skylight that low parts of a body block, and its corner [2]."""
    lowest, highest = mesh.bounds()
    corner = lowest[:2] - AROUND
    width, height = np.ceil((highest[:2] + AROUND - corner) / CELL).astype(int).tolist()
    occlusion = np.zeros((height, width), np.float32)
    corners = mesh.corners()
    heights = corners[..., 2].mean(1)
    cell_corners = np.rint((corners[..., :2] - corner) / CELL * 16).astype(np.int32)
    # High faces first: lower ones, which block more, overwrite them.
    for face in np.argsort(-heights, kind="stable"):
        cv2.fillConvexPoly(occlusion, cell_corners[face], float(np.exp(-heights[face])), shift=4)
    blurred = cv2.GaussianBlur(occlusion, (0, 0), 0.15 / CELL)
    margin_cells = 0.25 / CELL  # fades to zero at the border of the map
    x_margin, y_margin = (
        np.minimum(np.arange(cell_count), np.arange(cell_count)[::-1]) / margin_cells for cell_count in (width, height)
    )
    return (DARKEST * blurred * np.minimum(1.0, np.minimum(x_margin[None], y_margin[:, None]))).astype(
        np.float32
    ), corner


@lru_cache(maxsize=1)
def _road_light() -> F64:
    """Return the radiance [3] of a road under the light of the renderings."""
    ground = Material("road", (ALBEDO, ALBEDO, ALBEDO), specular=0.0, gloss=0.0)
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 30.0
    road_mesh = build(corners, np.array([[0, 1, 2], [0, 2, 3]]), materials=ground)
    camera_pose = np.array([[0.0, -1, 0, 0], [-1, 0, 0, 0], [0, 0, -1, 2.0], [0, 0, 0, 1]])
    view = View(Camera.typical(8, 8), camera_pose, (SceneObject(0, np.eye(4), tag=1),), OVERCAST, PLAIN_SENSOR)
    return np.asarray(
        render(RenderScene(None, [road_mesh]), [view], quality=PLAIN).radiance[0].mean((0, 1)), np.float64
    )


# ---------------------------------------------------------------- pictures


def add_anomalies(
    batch: Batch,
    frames: Sequence[Frame],
    specs: Sequence[ShiftSpec],
    contexts: Mapping[str, SceneContext] | None,
) -> tuple[Batch, list[ShiftReport]]:
    """Apply anomalies, in both calibrations."""
    pixels, records = batch.numpy().copy(), []
    for index, (frame, spec) in enumerate(zip(frames, specs, strict=True)):
        records.append(_draw(pixels[index], frame, _objects_in_frame(spec, frame, contexts)))
    return to_batch(pixels, batch.device), records


def _objects_in_frame(
    spec: ShiftSpec, frame: Frame | SweepFrame, contexts: Mapping[str, SceneContext] | None
) -> list[StandingObject]:
    """Return the objects of a severity: those of the scene, else placed along the straight path of this frame."""
    context = (contexts or {}).get(frame.scene)
    objects = None if context is None else context.objects
    if objects is None:
        objects = place_objects(spec, frame.scene, frame.ego_to_world[None], [frame.boxes])
    return [standing_object for standing_object in objects if standing_object.level <= spec.severity]


def _draw(image: U8, frame: Frame, objects: Sequence[StandingObject]) -> ShiftReport:
    """Draw objects into an image [H, W, 3], the farthest first, and record the visible ones."""
    camera_pose = camera_to_world(frame)
    canvas = _Canvas(image, frame)
    offsets = [np.array(standing_object.place) - camera_pose[:3, 3] for standing_object in objects]
    depths = [float(offset @ camera_pose[:3, 2]) for offset in offsets]
    records = []
    for index in sorted(range(len(objects)), key=lambda index: (-depths[index], index)):
        standing_object = objects[index]
        box = canvas.add(standing_object) if np.linalg.norm(offsets[index]) < table.ANOMALY_FARTHEST else None
        if box is not None:
            records.append(
                {
                    "kind": standing_object.kind,
                    "style": standing_object.style,
                    "depth_m": round(depths[index], 2),
                    "box": box,
                }
            )
    coverage = canvas.finish(image)
    details = {"objects": records, "covered": coverage, "depth": "boxes" if frame.depth is None else "given"}
    return ShiftReport(bool(records), details)


class _Canvas:
    """Image under work in linear light, with the coverage of the drawn objects."""

    def __init__(self, image: U8, frame: Frame) -> None:
        self.frame, self.eye = frame, camera_to_world(frame)
        self.inverse = np.linalg.inv(self.eye)
        self.intrinsic = frame.camera.intrinsic
        self.height, self.width = image.shape[:2]
        self.clean = LIGHT[image]
        self.light = self.clean.copy()
        self.coverage = np.zeros(image.shape[:2], np.float32)  # share of each pixel that objects cover
        self.is_shaded = np.zeros(image.shape[:2], bool)
        self.corners = (frame.boxes.corners() - self.eye[:3, 3]) @ self.eye[:3, :3]  # of the boxes, in the camera

    def project(self, local: F64) -> F64:
        """Project points [..., 3] in the camera's frame to pixels [..., 2]."""
        intrinsic = self.intrinsic
        depth = np.maximum(local[..., 2], NEAREST)
        return np.stack(
            [
                intrinsic[0, 0] * local[..., 0] / depth + intrinsic[0, 2],
                intrinsic[1, 1] * local[..., 1] / depth + intrinsic[1, 2],
            ],
            -1,
        )

    def window(self, local: F64) -> tuple[int, int, int, int] | None:
        """Return the pixels x0, y0, x1, y1 around points [N, 3] in the camera's frame; None if not in view."""
        if local[:, 2].max() <= NEAREST:
            return None
        pixels = self.project(local)
        limit = [self.width, self.height]
        lower = np.clip(np.floor(pixels.min(0)), 0, limit).astype(int)
        upper = np.clip(np.ceil(pixels.max(0)), 0, limit).astype(int)
        if (upper <= lower).any():
            return None
        return int(lower[0]), int(lower[1]), int(upper[0]), int(upper[1])

    def add(self, standing_object: StandingObject) -> list[float] | None:
        """Draw an object and its shadow; return the box x0, y0, x1, y1 around its visible part, None without one."""
        model = _model(standing_object.kind, standing_object.style, standing_object.seed, standing_object.size)
        pose = upright_pose(
            standing_object.place[0], standing_object.place[1], standing_object.yaw, standing_object.place[2]
        )
        to_camera = self.inverse @ pose
        base_offset = np.array([0.0, 0.0, 0.5])
        corners = ((UNIT_CORNERS + base_offset) * standing_object.size) @ to_camera[:3, :3].T + to_camera[:3, 3]
        window = self.window(corners)
        if window is None:
            return None
        gain = self._gain(standing_object, to_camera)
        self._shade(model, pose, to_camera)
        x0, y0, x1, y1 = window
        window_width, window_height = x1 - x0, y1 - y0
        supersampling = 3 if window_width * window_height <= 120_000 else 2
        intrinsic = self.intrinsic.astype(np.float64).copy()
        intrinsic[0, 2] -= x0
        intrinsic[1, 2] -= y0
        intrinsic[:2] *= supersampling
        # the object is the origin, so that its texture does not depend on where in the world it stands
        local_pose = upright_pose(0.0, 0.0, standing_object.yaw)
        camera_pose = self.eye.copy()
        camera_pose[:3, 3] -= standing_object.place
        view = View(
            Camera(window_width * supersampling, window_height * supersampling, intrinsic),
            camera_pose,
            (SceneObject(0, local_pose, model.paint, 1),),
            OVERCAST,
            PLAIN_SENSOR,
        )
        rendering = render(model.stage, [view], scale=1, quality=PLAIN)
        is_visible = (rendering.tag[0] == 1) & self._visible_mask(
            window, supersampling, rendering.depth[0], float(corners[:, 2].mean())
        )
        if not is_visible.any():
            return None
        coverage = (
            is_visible.reshape(window_height, supersampling, window_width, supersampling)
            .mean((1, 3))
            .astype(np.float32)
        )
        light = (
            (rendering.radiance[0] * is_visible[..., None])
            .reshape(window_height, supersampling, window_width, supersampling, 3)
            .mean((1, 3))
        )
        window_slice = np.s_[y0:y1, x0:x1]
        self.light[window_slice] = self.light[window_slice] * (1.0 - coverage[..., None]) + np.minimum(
            light * gain, coverage[..., None]
        )
        self.coverage[window_slice] = np.maximum(self.coverage[window_slice], coverage)
        rows, columns = np.flatnonzero(coverage.any(1)), np.flatnonzero(coverage.any(0))
        return [float(x0 + columns[0]), float(y0 + rows[0]), float(x0 + columns[-1] + 1), float(y0 + rows[-1] + 1)]

    def _depth_at(self, x: F64, y: F64) -> F32:
        """Return the depth of the image at pixels x [n] and y [m], as [m, n]; 0 where unknown."""
        depth = self.frame.depth
        if depth is None:
            return np.zeros((len(y), len(x)), np.float32)
        rows = np.minimum((y / self.height * depth.shape[0]).astype(int), depth.shape[0] - 1)
        columns = np.minimum((x / self.width * depth.shape[1]).astype(int), depth.shape[1] - 1)
        values: F32 = np.nan_to_num(np.asarray(depth, np.float32)[rows][:, columns], nan=0.0, posinf=np.inf)
        return values

    def _visible_mask(
        self, window: tuple[int, int, int, int], supersampling: int, depth: F32, object_depth: float
    ) -> Bool:
        """Return a mask of the samples at which nothing in the image hides an object at a depth [h, w]."""
        x0, y0, x1, y1 = window
        x, y = (
            start + (np.arange((end - start) * supersampling) + 0.5) / supersampling
            for start, end in ((x0, x1), (y0, y1))
        )
        image_depth = self._depth_at(x, y)
        hidden = np.zeros(depth.shape, np.uint8)
        for corners in self.corners:
            if corners[:, 2].max() <= NEAREST or corners[:, 2].mean() >= object_depth:
                continue
            pixels = (self.project(corners) - [x0, y0]) * supersampling
            outline = np.clip(cv2.convexHull(pixels.astype(np.float32)), -30_000, 30_000)
            cv2.fillConvexPoly(hidden, np.floor(outline).astype(np.int32), 1)
        return np.asarray(np.where(image_depth > 0, depth < 1.02 * image_depth + 0.3, hidden == 0))

    def _shade(self, model: _Model, pose: F64, to_camera: F64) -> None:
        """Darken the ground that the object touches."""
        size = np.array(model.shadow.shape[::-1]) * CELL
        corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) * size + model.corner
        local = np.column_stack([corners, np.zeros(4)]) @ to_camera[:3, :3].T + to_camera[:3, 3]
        window = self.window(local)
        if window is None:
            return
        x0, y0, x1, y1 = window
        intrinsic = self.intrinsic
        x, y = (np.arange(start, end, dtype=np.float64) + 0.5 for start, end in ((x0, x1), (y0, y1)))
        u, v = np.meshgrid((x - intrinsic[0, 2]) / intrinsic[0, 0], (y - intrinsic[1, 2]) / intrinsic[1, 1])
        rays = np.stack([u, v, np.ones_like(u)], -1) @ self.eye[:3, :3].T
        is_downward = rays[..., 2] < -1e-4
        depth = np.where(is_downward, (pose[2, 3] - self.eye[2, 3]) / np.where(is_downward, rays[..., 2], -1.0), -1.0)
        ground = (self.eye[:3, 3] + rays * depth[..., None] - pose[:3, 3]) @ pose[:3, :3]
        shadow_cells = ((ground[..., :2] - model.corner) / CELL - 0.5).astype(np.float32)
        shade = cv2.remap(model.shadow, shadow_cells[..., 0], shadow_cells[..., 1], cv2.INTER_LINEAR, borderValue=0.0)
        window_depth = np.where(depth > 0, depth, np.inf).astype(np.float32)
        is_ground = self._visible_mask(window, 1, window_depth, float(local[:, 2].mean()))
        image_depth = self._depth_at(x, y)
        is_ground &= (image_depth <= 0) | (
            window_depth > 0.95 * image_depth - 0.3
        )  # what is farther is not the ground below
        window_slice = np.s_[y0:y1, x0:x1]
        shade = shade * (is_ground & (depth > NEAREST)) * (1.0 - self.coverage[window_slice])
        self.light[window_slice] *= (1.0 - shade)[..., None]
        self.is_shaded[window_slice] |= shade > 0

    def _gain(self, standing_object: StandingObject, to_camera: F64) -> F64:
        """Return the gain [3] from rendered radiance to the image, with the ground around the object as a road."""
        length, width, _ = standing_object.size
        angle = np.linspace(0.0, 2.0 * np.pi, 72, endpoint=False)
        ring_axes = [(0.5 * length + margin, 0.5 * width + margin) for margin in (0.6, 1.0, 1.5, 2.0)]
        ground = np.concatenate(
            [
                np.stack([half_length * np.cos(angle), half_width * np.sin(angle), 0.0 * angle], 1)
                for half_length, half_width in ring_axes
            ]
        )
        local = ground @ to_camera[:3, :3].T + to_camera[:3, 3]
        pixels = np.floor(self.project(local)).astype(int)
        is_in_view = (local[:, 2] > NEAREST) & (pixels >= 0).all(1) & (pixels < [self.width, self.height]).all(1)
        if is_in_view.sum() >= 20:
            light = self.clean[pixels[is_in_view, 1], pixels[is_in_view, 0]]
        else:
            light = self.clean[2 * self.height // 3 :: 4, ::4].reshape(-1, 3)
        ground_light = np.maximum(np.median(light, axis=0).astype(np.float64), 1e-4)
        gain = ground_light / _road_light()
        mean_gain = float(ground_light.mean() / _road_light().mean())
        return np.asarray(np.clip(gain, TINT[0] * mean_gain, TINT[1] * mean_gain))

    def finish(self, image: U8) -> float:
        """Write the changed pixels into the image; returns the share that objects cover."""
        is_changed = (self.coverage > 0) | self.is_shaded
        image[is_changed] = np.rint(to_codes(np.clip(self.light[is_changed], 0.0, 1.0))).astype(np.uint8)
        return round(float(self.coverage.mean()), 6)


# ---------------------------------------------------------------- LiDAR


def hit_by_rays(
    cloud: F32, frame: SweepFrame, spec: ShiftSpec, contexts: Mapping[str, SceneContext] | None
) -> tuple[F32, ShiftReport]:
    """Move the points [P, 5] behind an object to the hits of their rays.

    A ray without a return is not in the cloud, so an object before the sky gets no points.
    """
    pose = frame.ego_to_world @ frame.to_ego
    rays = cloud[:, :3].astype(np.float64) @ pose[:3, :3].T
    hit_shares, intensities = np.ones(len(cloud)), cloud[:, 3].copy()
    for standing_object in _objects_in_frame(spec, frame, contexts):
        if np.linalg.norm(np.array(standing_object.place) - pose[:3, 3]) > table.ANOMALY_FARTHEST:
            continue
        rotation = upright_pose(0.0, 0.0, standing_object.yaw)[:3, :3]
        origin = (pose[:3, 3] - standing_object.place) @ rotation
        directions = rays @ rotation
        candidates = np.flatnonzero(_reaches_box(origin, directions, standing_object.size))
        corners, echo_intensities = _faces(
            standing_object.kind, standing_object.style, standing_object.seed, standing_object.size
        )
        # Blocks of rays bound the memory of the ray-triangle tables.
        for ray_indices in np.array_split(candidates, len(candidates) // 256 + 1):
            hit_distance, face_indices = _first_hit(origin, directions[ray_indices], corners)
            is_nearer = hit_distance < hit_shares[ray_indices]
            hit_shares[ray_indices[is_nearer]] = hit_distance[is_nearer]
            intensities[ray_indices[is_nearer]] = echo_intensities[face_indices[is_nearer]]
    is_hit = hit_shares < 1.0
    cloud[is_hit, :3] *= hit_shares[is_hit, None].astype(np.float32)
    cloud[is_hit, 3] = intensities[is_hit]
    return cloud, ShiftReport(bool(is_hit.any()), {"moved": int(is_hit.sum())})


@lru_cache(maxsize=64)
def _faces(kind: str, style: str, seed: int, size: tuple[float, float, float]) -> tuple[F64, F32]:
    """Return the corners [F, 3, 3] of a coarse body in its own frame, and the intensity [F] of its echoes, 0 to 255."""
    mesh = make_body(kind, style=style, size=size, generator=generator("anomaly", kind, style, seed), detail=0)
    reflectance = np.array([np.mean(material.colour) for material in mesh.materials], np.float32)
    return mesh.corners(), np.asarray(np.clip(120.0 * reflectance, 2.0, 255.0)[mesh.material], np.float32)


def _reaches_box(origin: F64, directions: F64, size: tuple[float, float, float]) -> Bool:
    """Return a mask of the rays [P, 3] from a point [3] that reach a box on the ground before they end."""
    half_size = 0.5 * np.array(size)
    safe_direction = np.where(np.abs(directions) < 1e-9, 1e-9, directions)
    lower_hits, upper_hits = (
        (side * half_size + [0.0, 0.0, half_size[2]] - origin) / safe_direction for side in (-1.0, 1.0)
    )
    entry, leave = np.minimum(lower_hits, upper_hits).max(1), np.maximum(lower_hits, upper_hits).min(1)
    return np.asarray((entry < leave) & (leave > 0.0) & (entry < 1.0))


def _first_hit(origin: F64, directions: F64, corners: F64) -> tuple[F64, npt.NDArray[np.intp]]:
    """Return the share of each ray [P, 3] up to the first triangle [F, 3, 3] that it hits (2: none), and its index.

    Source: Moeller and Trumbore 1997.
    """
    if not len(directions):
        return np.zeros(0), np.zeros(0, np.intp)
    vertex, edge_1, edge_2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normals = np.cross(directions[:, None], edge_2[None])
    determinant = np.einsum("pfk,fk->pf", normals, edge_1)
    inverse = 1.0 / np.where(np.abs(determinant) < 1e-12, np.inf, determinant)
    origin_offset = origin - vertex
    u = np.einsum("pfk,fk->pf", normals, origin_offset) * inverse
    offset_cross = np.cross(origin_offset, edge_1)
    v = (directions @ offset_cross.T) * inverse
    t = np.einsum("fk,fk->f", edge_2, offset_cross) * inverse
    t = np.where((inverse != 0.0) & (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (t > 0.0), t, 2.0)
    face_index = t.argmin(1)
    return t[np.arange(len(t)), face_index], face_index
