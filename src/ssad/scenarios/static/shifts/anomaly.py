"""Anomaly: objects of no class stand on the road of a scene, drawn into its pictures.

They stand still in the world beside the way that the ego drives and on its continuation, clear of every annotated box,
so that all cameras show the same objects over the whole scene. Each is rendered by `ssad.rendering.camera`, exposed
by the brightness of the ground around it, and mixed into the picture in linear light behind what is nearer. Rays of the
LiDAR that meet one return from it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from ssad.core.boxes import UNIT_CORNERS, TrackedBoxes
from ssad.core.frames import Applied, Camera, Frame, SceneContext, StandingObject, SweepFrame, camera_to_world
from ssad.core.rotations import quaternion_to_yaw, upright_pose
from ssad.core.seeding import generator
from ssad.core.types import F32, F64, U8, Bool
from ssad.rendering.bodies import draw_paint, draw_size, draw_style, make_body
from ssad.rendering.camera.render import PLAIN, View, Weather, render
from ssad.rendering.camera.scene import Scene, Thing
from ssad.rendering.camera.sensor import Sensor
from ssad.rendering.meshes.mesh import Material, Mesh, build
from ssad.scenarios.static.shifts import parameters as table
from ssad.scenarios.static.shifts.batch import Batch, to_batch
from ssad.scenarios.static.shifts.light import to_codes, to_linear
from ssad.scenarios.static.shifts.spec import ShiftSpec

NEAREST = 0.3  # m before the camera
TRIES = 60  # places that are looked at for an object
EGO = (5.0, 2.2, 1.4)  # m: length and width that the ego needs, its middle ahead of its origin
CLEAR = 0.5  # m between an object and what else there is
MOVES = 0.5  # s between samples: moving boxes sweep what they pass in this time
OVERCAST = Weather(0.9, 0.8, 0.8)  # soft light: the sun of the picture is not known
PLAIN_SENSOR = Sensor(blur=0.0, mosaic=False)  # the radiance is wanted, not the picture
ALBEDO = 0.16  # of a road
DARKEST = 0.75  # share of the light that a shadow of contact takes
CELL, AROUND = 0.05, 0.8  # m: of the map of such a shadow, and how far it reaches around the object
TINT = (0.85, 1.18)  # how far the light may differ from grey
LIGHT: F32 = to_linear(np.arange(256)).astype(np.float32)


# ---------------------------------------------------------------- places


def place_objects(spec: ShiftSpec, scene: str, poses: F64, boxes: Sequence[TrackedBoxes]) -> tuple[StandingObject, ...]:
    """What stands on the road of a scene, for all severities; where there is no clear place, an object is left out.

    Args:
        spec: The shift; its severity does not matter.
        scene: Key of the scene.
        poses: Of the ego over the scene [N, 4, 4], in time order.
        boxes: What is annotated at each sample.
    """
    way, along = _way(poses)
    driven = along[-2]
    pieces = max(1, round((driven + table.ANOMALY_AHEAD) / table.ANOMALY_EVERY))
    piece = (driven + table.ANOMALY_AHEAD) / pieces
    taken = [_swept(own) for own in boxes if len(own)]
    ahead = poses[:, :2, 3] + EGO[2] * poses[:, :2, 0]
    heading = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
    size = np.broadcast_to(EGO[:2], (len(poses), 2))
    taken.append(_rectangles(ahead, heading, size))
    found: list[StandingObject] = []
    for part in range(pieces):
        for number, (kind, level) in enumerate(table.ANOMALIES):
            draws = spec.generator("place", scene, part, number)
            style = draw_style(kind, generator=draws)
            length, width, height = draw_size(kind, style, generator=draws)
            seed = int(draws.integers(2**31))
            tries = draws.uniform(0.0, 1.0, (TRIES, 3))
            occupied = np.concatenate(taken)
            for forward, aside, turn in tries:
                station = table.ANOMALY_FIRST + (part + forward) * piece
                place, course = _at(way, along, station)
                left = (2.0 * aside - 1.0) * (table.ANOMALY_ASIDE + 0.5 * min(length, width))
                place = place + left * np.array([-np.sin(course), np.cos(course), 0.0])
                yaw = float(course + 2.0 * np.pi * turn)
                needs = np.array([[length, width]]) + CLEAR
                own = _rectangles(place[None, :2], np.array([yaw]), needs)
                if not _overlap(own[0], occupied).any():
                    x, y, z = place.tolist()
                    found.append(StandingObject(kind, style, seed, (length, width, height), (x, y, z), yaw, level))
                    taken.append(own)
                    break
    return tuple(found)


def _way(poses: F64) -> tuple[F64, F64]:
    """The way of the ego [M, 3] and how far along it each point lies, m; the last goes on straight."""
    kept = [poses[0, :3, 3]]
    for place in poses[1:, :3, 3]:
        if np.hypot(*(place - kept[-1])[:2]) > 0.5:
            kept.append(place)
    course = poses[-1, :3, 0] * [1.0, 1.0, 0.0]
    kept.append(kept[-1] + (table.ANOMALY_FIRST + table.ANOMALY_AHEAD) * course / np.linalg.norm(course))
    way = np.array(kept)
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(way[:, :2], axis=0).T))])
    return way, along


def _at(way: F64, along: F64, station: float) -> tuple[F64, float]:
    """Place [3] and course (rad) at a distance along the way."""
    place = np.array([np.interp(station, along, way[:, axis]) for axis in range(3)])
    step = int(np.clip(np.searchsorted(along, station, side="right") - 1, 0, len(way) - 2))
    forward = way[step + 1] - way[step]
    return place, float(np.arctan2(forward[1], forward[0]))


def _rectangles(middle: F64, yaw: F64, size: F64) -> F64:
    """Corners [N, 4, 2] of rectangles: middles [N, 2], yaw [N], length and width [N, 2]; around in order."""
    forward = np.stack([np.cos(yaw), np.sin(yaw)], -1)[:, None]
    left = np.stack([-np.sin(yaw), np.cos(yaw)], -1)[:, None]
    share = np.array([(0.5, 0.5), (-0.5, 0.5), (-0.5, -0.5), (0.5, -0.5)])
    corners = middle[:, None] + forward * (share[:, 0] * size[:, :1])[..., None]
    return np.asarray(corners + left * (share[:, 1] * size[:, 1:])[..., None])


def _swept(boxes: TrackedBoxes) -> F64:
    """The ground [N, 4, 2] that boxes stand on, longer by the way that they move between samples."""
    speed = np.nan_to_num(np.linalg.norm(boxes.velocity[:, :2], axis=1))
    size = boxes.size_lwh[:, :2] + np.stack([MOVES * speed, np.zeros(len(boxes))], 1)
    return _rectangles(boxes.centre[:, :2], np.asarray(quaternion_to_yaw(boxes.rotation)), size)


def _overlap(own: F64, others: F64) -> Bool:
    """Whether a rectangle [4, 2] overlaps each of others [N, 4, 2]: no line lies between the two."""
    apart = np.zeros(len(others), bool)
    for k in range(2):
        for edge in (np.broadcast_to(own[k + 1] - own[k], (len(others), 2)), others[:, k + 1] - others[:, k]):
            mine, theirs = np.einsum("nk,ck->nc", edge, own), np.einsum("nk,nck->nc", edge, others)
            apart |= (mine.max(1) < theirs.min(1)) | (theirs.max(1) < mine.min(1))
    return ~apart


# ---------------------------------------------------------------- bodies


@dataclass(frozen=True, slots=True)
class _Model:
    """An object ready to be drawn.

    Attributes:
        stage: Its mesh.
        paint: Linear RGB.
        shadow: Contact shadow [h, w]: share of the light that is blocked, by cells in the object's own frame.
        corner: x, y of the corner of `shadow` in that frame, m.
    """

    stage: Scene
    paint: tuple[float, float, float]
    shadow: F32
    corner: F64


@lru_cache(maxsize=64)
def _model(kind: str, style: str, seed: int, size: tuple[float, float, float]) -> _Model:
    draws = generator("anomaly", kind, style, seed)
    mesh = make_body(kind, style=style, size=size, generator=draws)
    return _Model(Scene(None, [mesh]), draw_paint(draws), *_contact(mesh))


def _contact(mesh: Mesh) -> tuple[F32, F64]:
    """The map [h, w] of the shadow of contact: what is low over the ground keeps the light of the sky from it."""
    low, high = mesh.bounds()
    corner = low[:2] - AROUND
    width, height = np.ceil((high[:2] + AROUND - corner) / CELL).astype(int).tolist()
    cover = np.zeros((height, width), np.float32)
    corners = mesh.corners()
    above = corners[..., 2].mean(1)
    flat = np.rint((corners[..., :2] - corner) / CELL * 16).astype(np.int32)
    for face in np.argsort(-above, kind="stable"):
        cv2.fillConvexPoly(cover, flat[face], float(np.exp(-above[face])), shift=4)
    soft = cv2.GaussianBlur(cover, (0, 0), 0.15 / CELL)
    edge = 0.25 / CELL  # nothing is left of it at the border of the map
    x, y = (np.minimum(np.arange(n), np.arange(n)[::-1]) / edge for n in (width, height))
    return (DARKEST * soft * np.minimum(1.0, np.minimum(x[None], y[:, None]))).astype(np.float32), corner


@lru_cache(maxsize=1)
def _road_light() -> F64:
    """Radiance [3] of a road under the light of the renderings."""
    ground = Material("road", (ALBEDO, ALBEDO, ALBEDO), specular=0.0, gloss=0.0)
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 30.0
    floor = build(square, np.array([[0, 1, 2], [0, 2, 3]]), materials=ground)
    down = np.array([[0.0, -1, 0, 0], [-1, 0, 0, 0], [0, 0, -1, 2.0], [0, 0, 0, 1]])
    view = View(Camera.typical(8, 8), down, (Thing(0, np.eye(4), tag=1),), OVERCAST, PLAIN_SENSOR)
    return np.asarray(render(Scene(None, [floor]), [view], quality=PLAIN).radiance[0].mean((0, 1)), np.float64)


# ---------------------------------------------------------------- pictures


def add_anomalies(
    batch: Batch,
    frames: Sequence[Frame],
    specs: Sequence[ShiftSpec],
    contexts: Mapping[str, SceneContext] | None,
) -> tuple[Batch, list[Applied]]:
    """anomaly, in both calibrations."""
    pixels, done = batch.numpy().copy(), []
    for b, (frame, spec) in enumerate(zip(frames, specs, strict=True)):
        done.append(_draw(pixels[b], frame, _standing(spec, frame, contexts)))
    return to_batch(pixels, batch.device), done


def _standing(
    spec: ShiftSpec, frame: Frame | SweepFrame, contexts: Mapping[str, SceneContext] | None
) -> list[StandingObject]:
    """The objects of a severity: those of the scene, else drawn along the straight way ahead of this frame alone."""
    context = (contexts or {}).get(frame.scene)
    objects = None if context is None else context.objects
    if objects is None:
        objects = place_objects(spec, frame.scene, frame.ego_to_world[None], [frame.boxes])
    return [thing for thing in objects if thing.level <= spec.severity]


def _draw(picture: U8, frame: Frame, objects: Sequence[StandingObject]) -> Applied:
    """Draws objects into a picture [H, W, 3], the farthest first, and says what is seen of each."""
    eye = camera_to_world(frame)
    canvas = _Canvas(picture, frame)
    gaps = [np.array(thing.place) - eye[:3, 3] for thing in objects]
    away = [float(gap @ eye[:3, 2]) for gap in gaps]
    told = []
    for n in sorted(range(len(objects)), key=lambda n: (-away[n], n)):
        thing = objects[n]
        box = canvas.add(thing) if np.linalg.norm(gaps[n]) < table.ANOMALY_FARTHEST else None
        if box is not None:
            told.append({"kind": thing.kind, "style": thing.style, "depth_m": round(away[n], 2), "box": box})
    covered = canvas.finish(picture)
    details = {"objects": told, "covered": covered, "depth": "boxes" if frame.depth is None else "given"}
    return Applied(bool(told), details)


class _Canvas:
    """The linear light of a picture under work, and how far away what is drawn into it is."""

    def __init__(self, picture: U8, frame: Frame) -> None:
        self.frame, self.eye = frame, camera_to_world(frame)
        self.inverse = np.linalg.inv(self.eye)
        self.intrinsic = frame.camera.intrinsic
        self.height, self.width = picture.shape[:2]
        self.clean = LIGHT[picture]
        self.light = self.clean.copy()
        self.drawn = np.zeros(picture.shape[:2], np.float32)  # share of a pixel that objects cover
        self.dark = np.zeros(picture.shape[:2], bool)
        self.corners = (frame.boxes.corners() - self.eye[:3, 3]) @ self.eye[:3, :3]  # of the boxes, in the camera

    def project(self, local: F64) -> F64:
        """Pixels [..., 2] of points [..., 3] in the camera's frame."""
        k = self.intrinsic
        z = np.maximum(local[..., 2], NEAREST)
        return np.stack([k[0, 0] * local[..., 0] / z + k[0, 2], k[1, 1] * local[..., 1] / z + k[1, 2]], -1)

    def window(self, local: F64) -> tuple[int, int, int, int] | None:
        """The pixels x0, y0, x1, y1 around points [N, 3] in the camera's frame; None where they are not in view."""
        if local[:, 2].max() <= NEAREST:
            return None
        pixels = self.project(local)
        limit = [self.width, self.height]
        low = np.clip(np.floor(pixels.min(0)), 0, limit).astype(int)
        high = np.clip(np.ceil(pixels.max(0)), 0, limit).astype(int)
        if (high <= low).any():
            return None
        return int(low[0]), int(low[1]), int(high[0]), int(high[1])

    def add(self, thing: StandingObject) -> list[float] | None:
        """Draws an object and its shadow; the box x0, y0, x1, y1 around what is seen of it, None for nothing."""
        model = _model(thing.kind, thing.style, thing.seed, thing.size)
        pose = upright_pose(thing.place[0], thing.place[1], thing.yaw, thing.place[2])
        to_camera = self.inverse @ pose
        lift = np.array([0.0, 0.0, 0.5])
        corners = ((UNIT_CORNERS + lift) * thing.size) @ to_camera[:3, :3].T + to_camera[:3, 3]
        window = self.window(corners)
        if window is None:
            return None
        gain = self._gain(thing, to_camera)
        self._shade(model, pose, to_camera)
        x0, y0, x1, y1 = window
        wide, tall = x1 - x0, y1 - y0
        fine = 3 if wide * tall <= 120_000 else 2
        k = self.intrinsic.astype(np.float64).copy()
        k[0, 2] -= x0
        k[1, 2] -= y0
        k[:2] *= fine
        # the object is the origin, so that its texture does not depend on where in the world it stands
        turned = upright_pose(0.0, 0.0, thing.yaw)
        eye = self.eye.copy()
        eye[:3, 3] -= thing.place
        view = View(
            Camera(wide * fine, tall * fine, k), eye, (Thing(0, turned, model.paint, 1),), OVERCAST, PLAIN_SENSOR
        )
        made = render(model.stage, [view], scale=1, quality=PLAIN)
        seen = (made.tag[0] == 1) & self._free(window, fine, made.depth[0], float(corners[:, 2].mean()))
        if not seen.any():
            return None
        share = seen.reshape(tall, fine, wide, fine).mean((1, 3)).astype(np.float32)
        light = (made.radiance[0] * seen[..., None]).reshape(tall, fine, wide, fine, 3).mean((1, 3))
        part = np.s_[y0:y1, x0:x1]
        self.light[part] = self.light[part] * (1.0 - share[..., None]) + np.minimum(light * gain, share[..., None])
        self.drawn[part] = np.maximum(self.drawn[part], share)
        rows, columns = np.flatnonzero(share.any(1)), np.flatnonzero(share.any(0))
        return [float(x0 + columns[0]), float(y0 + rows[0]), float(x0 + columns[-1] + 1), float(y0 + rows[-1] + 1)]

    def _known(self, x: F64, y: F64) -> F32:
        """Depth of the picture at places x [n] and y [m] in pixels, [m, n]; 0 where it is not known."""
        depth = self.frame.depth
        if depth is None:
            return np.zeros((len(y), len(x)), np.float32)
        rows = np.minimum((y / self.height * depth.shape[0]).astype(int), depth.shape[0] - 1)
        columns = np.minimum((x / self.width * depth.shape[1]).astype(int), depth.shape[1] - 1)
        known: F32 = np.nan_to_num(np.asarray(depth, np.float32)[rows][:, columns], nan=0.0, posinf=np.inf)
        return known

    def _free(self, window: tuple[int, int, int, int], fine: int, depth: F32, away: float) -> Bool:
        """Whether nothing of the picture is before an object at a depth [h, w], in `fine` samples a pixel."""
        x0, y0, x1, y1 = window
        x, y = (low + (np.arange((high - low) * fine) + 0.5) / fine for low, high in ((x0, x1), (y0, y1)))
        known = self._known(x, y)
        hidden = np.zeros(depth.shape, np.uint8)
        for corners in self.corners:
            if corners[:, 2].max() <= NEAREST or corners[:, 2].mean() >= away:
                continue
            pixels = (self.project(corners) - [x0, y0]) * fine
            hull = np.clip(cv2.convexHull(pixels.astype(np.float32)), -30_000, 30_000)
            cv2.fillConvexPoly(hidden, np.floor(hull).astype(np.int32), 1)
        return np.asarray(np.where(known > 0, depth < 1.02 * known + 0.3, hidden == 0))

    def _shade(self, model: _Model, pose: F64, to_camera: F64) -> None:
        """Takes light from the ground that the object touches."""
        size = np.array(model.shadow.shape[::-1]) * CELL
        rim = np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) * size + model.corner
        local = np.column_stack([rim, np.zeros(4)]) @ to_camera[:3, :3].T + to_camera[:3, 3]
        window = self.window(local)
        if window is None:
            return
        x0, y0, x1, y1 = window
        k = self.intrinsic
        x, y = (np.arange(low, high, dtype=np.float64) + 0.5 for low, high in ((x0, x1), (y0, y1)))
        u, v = np.meshgrid((x - k[0, 2]) / k[0, 0], (y - k[1, 2]) / k[1, 1])
        ray = np.stack([u, v, np.ones_like(u)], -1) @ self.eye[:3, :3].T
        down = ray[..., 2] < -1e-4
        depth = np.where(down, (pose[2, 3] - self.eye[2, 3]) / np.where(down, ray[..., 2], -1.0), -1.0)
        ground = (self.eye[:3, 3] + ray * depth[..., None] - pose[:3, 3]) @ pose[:3, :3]
        cells = ((ground[..., :2] - model.corner) / CELL - 0.5).astype(np.float32)
        dark = cv2.remap(model.shadow, cells[..., 0], cells[..., 1], cv2.INTER_LINEAR, borderValue=0.0)
        window_depth = np.where(depth > 0, depth, np.inf).astype(np.float32)
        lit = self._free(window, 1, window_depth, float(local[:, 2].mean()))
        known = self._known(x, y)
        lit &= (known <= 0) | (window_depth > 0.95 * known - 0.3)  # what is farther is not the ground below
        part = np.s_[y0:y1, x0:x1]
        dark = dark * (lit & (depth > NEAREST)) * (1.0 - self.drawn[part])
        self.light[part] *= (1.0 - dark)[..., None]
        self.dark[part] |= dark > 0

    def _gain(self, thing: StandingObject, to_camera: F64) -> F64:
        """What a radiance of the renderings is in the picture [3]: the ground around the object is a road."""
        length, width, _ = thing.size
        angle = np.linspace(0.0, 2.0 * np.pi, 72, endpoint=False)
        rings = [(0.5 * length + far, 0.5 * width + far) for far in (0.6, 1.0, 1.5, 2.0)]
        ground = np.concatenate([np.stack([a * np.cos(angle), b * np.sin(angle), 0.0 * angle], 1) for a, b in rings])
        local = ground @ to_camera[:3, :3].T + to_camera[:3, 3]
        pixels = np.floor(self.project(local)).astype(int)
        shown = (local[:, 2] > NEAREST) & (pixels >= 0).all(1) & (pixels < [self.width, self.height]).all(1)
        if shown.sum() >= 20:
            light = self.clean[pixels[shown, 1], pixels[shown, 0]]
        else:
            light = self.clean[2 * self.height // 3 :: 4, ::4].reshape(-1, 3)
        wanted = np.maximum(np.median(light, axis=0).astype(np.float64), 1e-4)
        gain = wanted / _road_light()
        grey = float(wanted.mean() / _road_light().mean())
        return np.asarray(np.clip(gain, TINT[0] * grey, TINT[1] * grey))

    def finish(self, picture: U8) -> float:
        """Writes what changed into the picture; the share of it that objects cover."""
        changed = (self.drawn > 0) | self.dark
        picture[changed] = np.rint(to_codes(np.clip(self.light[changed], 0.0, 1.0))).astype(np.uint8)
        return round(float(self.drawn.mean()), 6)


# ---------------------------------------------------------------- LiDAR


def hit_by_rays(
    cloud: F32, frame: SweepFrame, spec: ShiftSpec, contexts: Mapping[str, SceneContext] | None
) -> tuple[F32, Applied]:
    """The points [P, 5] with those behind an object moved to where their ray meets it.

    A ray without a return is in no cloud, so an object before the sky gets no points.
    """
    pose = frame.ego_to_world @ frame.to_ego
    rays = cloud[:, :3].astype(np.float64) @ pose[:3, :3].T
    share, bright = np.ones(len(cloud)), cloud[:, 3].copy()
    for thing in _standing(spec, frame, contexts):
        if np.linalg.norm(np.array(thing.place) - pose[:3, 3]) > table.ANOMALY_FARTHEST:
            continue
        turn = upright_pose(0.0, 0.0, thing.yaw)[:3, :3]
        start = (pose[:3, 3] - thing.place) @ turn
        toward = rays @ turn
        rows = np.flatnonzero(_enters(start, toward, thing.size))
        corners, light = _faces(thing.kind, thing.style, thing.seed, thing.size)
        for part in np.array_split(rows, len(rows) // 256 + 1):
            met, face = _first_hit(start, toward[part], corners)
            nearer = met < share[part]
            share[part[nearer]] = met[nearer]
            bright[part[nearer]] = light[face[nearer]]
    moved = share < 1.0
    cloud[moved, :3] *= share[moved, None].astype(np.float32)
    cloud[moved, 3] = bright[moved]
    return cloud, Applied(bool(moved.any()), {"moved": int(moved.sum())})


@lru_cache(maxsize=64)
def _faces(kind: str, style: str, seed: int, size: tuple[float, float, float]) -> tuple[F64, F32]:
    """Corners [F, 3, 3] of a coarse body in its own frame, and the intensity [F] of its echoes, 0 to 255."""
    mesh = make_body(kind, style=style, size=size, generator=generator("anomaly", kind, style, seed), detail=0)
    grey = np.array([np.mean(material.colour) for material in mesh.materials], np.float32)
    return mesh.corners(), np.asarray(np.clip(120.0 * grey, 2.0, 255.0)[mesh.material], np.float32)


def _enters(start: F64, toward: F64, size: tuple[float, float, float]) -> Bool:
    """Which rays [P, 3] from a place [3] reach a box on the ground before they end."""
    half = 0.5 * np.array(size)
    safe = np.where(np.abs(toward) < 1e-9, 1e-9, toward)
    one, other = ((sign * half + [0.0, 0.0, half[2]] - start) / safe for sign in (-1.0, 1.0))
    first, last = np.minimum(one, other).max(1), np.maximum(one, other).min(1)
    return np.asarray((first < last) & (last > 0.0) & (first < 1.0))


def _first_hit(start: F64, toward: F64, corners: F64) -> tuple[F64, npt.NDArray[np.intp]]:
    """How far along each ray [P, 3] it first meets a triangle [F, 3, 3] (2 for never), and which.

    Source: Moeller and Trumbore 1997.
    """
    if not len(toward):
        return np.zeros(0), np.zeros(0, np.intp)
    a, b, c = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    cross = np.cross(toward[:, None], c[None])
    volume = np.einsum("pfk,fk->pf", cross, b)
    inverse = 1.0 / np.where(np.abs(volume) < 1e-12, np.inf, volume)
    away = start - a
    u = np.einsum("pfk,fk->pf", cross, away) * inverse
    aside = np.cross(away, b)
    v = (toward @ aside.T) * inverse
    t = np.einsum("fk,fk->f", c, aside) * inverse
    t = np.where((inverse != 0.0) & (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (t > 0.0), t, 2.0)
    face = t.argmin(1)
    return t[np.arange(len(t)), face], face
