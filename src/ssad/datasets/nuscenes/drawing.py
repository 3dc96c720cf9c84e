"""Pictures and LiDAR sweeps of a street of blocks: painter's order, near-plane clipping, rays against boxes.

Cameras stand upright (no pitch or roll), so that the horizon is the row of the principal point. All geometry is in
the street frame of `ssad.datasets.nuscenes.block_street`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from ssad.core.rotations import wrap_angle
from ssad.core.types import F32, F64, U8
from ssad.datasets.nuscenes.block_street import BLOCK, HALF, PIXEL, BlockObject, Colour, Part, ground_texture

NEAR = 0.15  # m
FAR = 250.0
_HAZE_LENGTH = 140.0
_SHIFT = 4  # binary places of a pixel in OpenCV's polygons
_FACES = ((4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7))  # top, and the four sides
_LEVELS = 6


@dataclass(frozen=True)
class BlockView:
    """A camera in the street frame: place x, y, z, yaw of its optical axis, focal length and principal point (px)."""

    x: float
    y: float
    z: float
    yaw: float
    focal: float
    cx: float
    cy: float
    width: int
    height: int

    def to_camera(self, points: F64) -> F64:
        """Points [..., 3] in the camera's frame (x right, y down, z forward)."""
        dx, dy = points[..., 0] - self.x, points[..., 1] - self.y
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        return np.stack([sin * dx - cos * dy, self.z - points[..., 2], cos * dx + sin * dy], axis=-1)

    def project(self, points: F64) -> F64:
        """Pixels [..., 2] (centre of the first pixel at 0) of points [..., 3] of the camera's frame before it."""
        return self.focal * points[..., :2] / points[..., 2:] + (self.cx, self.cy)


@dataclass(frozen=True)
class Light:
    """Sun and sky of a scene."""

    direction: tuple[float, float, float]
    sky: Colour
    haze: Colour
    strength: float


class BlockStreet:
    """What is drawn: objects, buildings, ground and light. The textures are made once."""

    def __init__(
        self, things: Sequence[BlockObject], buildings: Sequence[BlockObject], light: Light, random: np.random.Generator
    ) -> None:
        self.things, self.buildings, self.light = tuple(things), tuple(buildings), light
        ground = ground_texture(random)
        self._ground = [ground]
        for _ in range(_LEVELS - 1):
            self._ground.append(cv2.resize(self._ground[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
        self._clouds = _clouds(random)
        self._grain = random.integers(0, 13, (512, 1024, 3), np.uint8)

    @cached_property
    def reflectance(self) -> F32:
        """Brightness of the ground texture, 0 to 1."""
        return np.asarray(self._ground[1].mean(axis=2) / 255.0, np.float32)

    def picture(self, view: BlockView, seconds: float) -> tuple[U8, list[tuple[int, int]]]:
        """The image uint8 [H, W, 3] RGB, and for each object the pixels seen and those of its whole outline in it."""
        image = np.empty((view.height, view.width, 3), np.uint8)
        self._draw_sky(image, view)
        self._draw_ground(image, view)
        order = np.zeros((view.height, view.width), np.uint8)
        outlines = [0] * len(self.things)
        self._draw_shadows(image, view, seconds)
        for thing in sorted(self.buildings, key=lambda one: -math.hypot(one.start[0] - view.x, one.start[1] - view.y)):
            self._draw(image, view, thing, thing.at(seconds))
        placed = [(thing.at(seconds), number) for number, thing in enumerate(self.things)]
        placed.sort(key=lambda one: (-math.hypot(one[0][0] - view.x, one[0][1] - view.y), one[1]))
        for place, number in placed:
            faces = self._draw(image, view, self.things[number], place)
            outlines[number] = _stamp(order, faces, number + 1)
        counts = np.bincount(order.ravel(), minlength=len(self.things) + 1)
        rows, columns = -(-view.height // 512), -(-view.width // 1024)
        grain = np.tile(self._grain, (rows, columns, 1))[: view.height, : view.width]
        image = cv2.subtract(cv2.add(image, grain), (6, 6, 6, 0))
        return image, [(int(counts[i + 1]), outlines[i]) for i in range(len(self.things))]

    def _draw_sky(self, image: U8, view: BlockView) -> None:
        rows = min(max(math.ceil(view.cy), 0), view.height)
        u, v = np.meshgrid(np.arange(view.width, dtype=np.float32), np.arange(rows, dtype=np.float32))
        right, up = (u - view.cx) / view.focal, (view.cy - v) / view.focal
        height, width = self._clouds.shape[0], self._clouds.shape[1] - 1
        across = ((view.yaw - np.arctan(right)) / (2 * math.pi) % 1.0) * width
        above = up / np.sqrt(1.0 + right * right)
        cloud = cv2.remap(
            self._clouds, across.astype(np.float32), (above * height).astype(np.float32), cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip
        blue = np.clip(above * 1.8, 0.0, 1.0)[..., None]
        base = np.array(self.light.haze, np.float32) * (1 - blue) + np.array(self.light.sky, np.float32) * blue
        base += (cloud * np.clip(above * 6.0, 0.0, 1.0))[..., None] * (244.0 - base)
        image[:rows] = base.astype(np.uint8)

    def _draw_ground(self, image: U8, view: BlockView) -> None:
        """Bands of rows, each from the texture whose pixels have about their size on the ground."""
        haze = np.array(self.light.haze, np.float32)
        first = min(max(math.ceil(view.cy), 0), view.height)
        rows = np.arange(first, view.height)
        distance = view.focal * view.z / np.maximum(rows - view.cy, 1e-3)
        far = int(np.searchsorted(-distance, -FAR))
        image[first : first + far] = haze.astype(np.uint8)
        rows, distance = rows[far:], distance[far:]
        if not len(rows):
            return
        size = distance / view.focal * np.sqrt(distance / view.z)
        level = np.clip(np.floor(np.log2(np.maximum(size / PIXEL, 1e-6)) + 0.3), 0, _LEVELS - 1).astype(int)
        cos, sin = math.cos(view.yaw), math.sin(view.yaw)
        # pixel (u, v, 1) -> street (x, y) of the ground, times (v - cy) / (focal z)
        unit = 1.0 / view.focal
        ray = np.array([[unit, 0, -view.cx * unit], [0, unit, -view.cy * unit], [0, 0, 1]])
        start = view.x % BLOCK
        street = np.array([[sin * view.z, start, cos * view.z], [-cos * view.z, view.y, sin * view.z], [0, 1, 0]])
        for k in np.unique(level):
            band = rows[level == k]
            pixel = PIXEL * 2.0**k
            texture = np.array([[1 / pixel, 0, -0.5], [0, 1 / pixel, HALF / pixel - 0.5], [0, 0, 1]])
            down = np.array([[1, 0, 0], [0, 1, float(band[0])], [0, 0, 1]])
            image[band[0] : band[-1] + 1] = cv2.warpPerspective(
                self._ground[k], texture @ street @ ray @ down, (view.width, len(band)),
                flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_WRAP,
            )  # fmt: skip
        clear = np.exp(-distance / _HAZE_LENGTH).astype(np.float32)[:, None, None] * np.float32(self.light.strength)
        tint = (1.0 - np.exp(-distance / _HAZE_LENGTH)).astype(np.float32)[:, None, None] * haze
        image[rows[0] :] = np.clip(image[rows[0] :] * clear + tint, 0, 255).astype(np.uint8)

    def _draw_shadows(self, image: U8, view: BlockView, seconds: float) -> None:
        for thing in self.things:
            x, y, yaw = thing.at(seconds)
            width, length, _ = thing.size
            ends = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)]) * (length / 2 + 0.12, width / 2 + 0.12)
            flat = np.concatenate([_turned(ends, x, y, yaw), np.zeros((4, 1))], axis=1)
            polygon = _clipped(view.to_camera(flat))
            if len(polygon) < 3:
                continue
            pixels = view.project(polygon)
            box = _bounds(pixels, view.width, view.height)
            if box is None:
                continue
            left, top, right, bottom = box
            area = image[top:bottom, left:right]
            mask = np.zeros(area.shape[:2], np.uint8)
            _fill(mask, pixels - (left, top), 1)
            area[mask > 0] = (area[mask > 0] * 0.5).astype(np.uint8)

    def _draw(self, image: U8, view: BlockView, thing: BlockObject, place: tuple[float, float, float]) -> list[F64]:
        """Draw a thing; the pixels of the faces that were drawn."""
        x, y, yaw = place
        reach = math.hypot(thing.size[0], thing.size[1]) / 2
        ahead = math.cos(view.yaw) * (x - view.x) + math.sin(view.yaw) * (y - view.y)
        distance = math.hypot(x - view.x, y - view.y)
        if ahead < -reach or distance > 180.0:
            return []
        haze = 1.0 - math.exp(-max(distance - 8.0, 0.0) / _HAZE_LENGTH)
        drawn = []
        cos, sin = math.cos(yaw), math.sin(yaw)
        here = np.array([cos * (view.x - x) + sin * (view.y - y), -sin * (view.x - x) + cos * (view.y - y), view.z])
        for part in sorted(thing.parts, key=lambda one: (one.layer, -_gap(one, here))):
            corners = part_corners(part)
            seen = view.to_camera(np.concatenate([_turned(corners[:, :2], x, y, yaw), corners[:, 2:]], axis=1))
            if seen[:, 2].max() < NEAR:
                continue
            for face in _FACES:
                quad = corners[list(face)]
                normal = np.cross(quad[1] - quad[0], quad[3] - quad[0])
                normal /= np.linalg.norm(normal)
                if normal @ (here - quad[0]) <= 0.0:
                    continue
                polygon = _clipped(seen[list(face)])
                if len(polygon) < 3:
                    continue
                pixels = view.project(polygon)
                if _bounds(pixels, view.width, view.height) is None:
                    continue
                colour = part.top if face == _FACES[0] else part.side
                _fill(image, pixels, self._shade(colour, _spun(normal, yaw), haze), smooth=True)
                drawn.append(pixels)
        for decal in thing.decals:
            normal = np.array(decal.normal, np.float64)
            if normal @ (here - decal.quads[0, 0]) <= 0.0:
                continue
            flat = decal.quads.reshape(-1, 3)
            flat = np.concatenate([_turned(flat[:, :2], x, y, yaw), flat[:, 2:]], axis=1)
            seen = view.to_camera(flat).reshape(-1, 4, 3)
            seen = seen[seen[..., 2].min(axis=1) > NEAR]
            pixels = np.clip(view.project(seen), -30000, 30000)
            large = np.ptp(pixels, axis=1).min(axis=1) > 0.7
            inside = (pixels[..., 0].max(axis=1) > 0) & (pixels[..., 0].min(axis=1) < view.width)
            quads = np.round(pixels[large & inside] * (1 << _SHIFT)).astype(np.int32)
            shade = self._shade(decal.colour, _spun(normal, yaw), haze)
            for quad in quads:
                cv2.fillConvexPoly(image, quad, shade, cv2.LINE_AA, _SHIFT)
        return drawn

    def _shade(self, colour: Colour, normal: F64, haze: float) -> tuple[float, float, float]:
        lit = 0.62 + 0.5 * max(float(normal @ np.array(self.light.direction)), 0.0)
        lit *= self.light.strength
        red, green, blue = (
            min(c * lit, 255.0) * (1 - haze) + h * haze for c, h in zip(colour, self.light.haze, strict=True)
        )
        return red, green, blue

    def sweep(self, origin: tuple[float, float, float], yaw: float, seconds: float, *, columns: int = 360) -> F32:
        """A turn of a 32-beam LiDAR, -30 to +10 degrees, float32 [N, 5] in a frame at `origin`, turned by `yaw`."""
        azimuth: F64 = np.linspace(0.0, 2 * math.pi, columns, endpoint=False)  # in the street frame
        elevation = np.radians(np.linspace(-30.0, 10.0, 32))[:, None]
        direction = np.stack(np.broadcast_arrays(
            np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
        ), axis=-1)  # fmt: skip
        with np.errstate(divide="ignore"):
            reach = np.where(direction[..., 2] < 0.0, -origin[2] / direction[..., 2], np.inf)
        brightness = np.full(reach.shape, -1.0)
        rays = _Rays(origin, azimuth, direction, reach, brightness)
        for thing in (*self.things, *self.buildings):
            place = thing.at(seconds)
            if math.hypot(place[0] - origin[0], place[1] - origin[1]) > 90.0:
                continue
            for part in thing.parts:
                _hit(part, place, rays)
        found = reach < 80.0
        ring = np.broadcast_to(np.arange(32)[:, None], reach.shape)[found]
        ray, length, bright = direction[found], reach[found], brightness[found]
        points = ray * length[:, None]
        spot = points[:, :2] + origin[:2]
        row = np.clip(((spot[:, 1] + HALF) / (2 * PIXEL)).astype(int), 0, self.reflectance.shape[0] - 1)
        column = np.clip((spot[:, 0] % BLOCK / (2 * PIXEL)).astype(int), 0, self.reflectance.shape[1] - 1)
        bright = np.where(bright < 0.0, 0.25 * self.reflectance[row, column] ** 2, bright)
        cos, sin = math.cos(yaw), math.sin(yaw)
        x, y = cos * points[:, 0] + sin * points[:, 1], -sin * points[:, 0] + cos * points[:, 1]
        return np.stack([x, y, points[:, 2], np.round(255.0 * bright), ring], axis=1).astype(np.float32)


def part_corners(part: Part) -> F64:
    """Corners [8, 3] in the thing's frame: bottom, then top, each counter-clockwise from above."""
    (x0, y0, z0), (x1, y1, z1) = part.low, part.high
    mx, my = (x0 + x1) / 2, (y0 + y1) / 2
    bottom = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])
    top = (bottom - (mx, my)) * part.taper + (mx, my)
    return np.concatenate([np.insert(bottom, 2, z0, axis=1), np.insert(top, 2, z1, axis=1)])


@dataclass(frozen=True)
class _Rays:
    """Rays of a sweep: origin, azimuth [C], direction [32, C, 3]; reach and brightness [32, C] of what they met."""

    origin: tuple[float, float, float]
    azimuth: F64
    direction: F64
    reach: F64
    brightness: F64


def _hit(part: Part, place: tuple[float, float, float], rays: _Rays) -> None:
    """Shorten the rays that meet the part (as an upright box); only the columns towards it are looked at."""
    x, y, yaw = place
    corners = part_corners(part)[:4, :2]
    offset = _turned(corners, x, y, yaw) - rays.origin[:2]
    middle = math.atan2(*offset.mean(axis=0)[::-1])
    spread = np.abs(wrap_angle(np.arctan2(offset[:, 1], offset[:, 0]) - middle)).max()
    columns = np.flatnonzero(np.abs(wrap_angle(rays.azimuth - middle)) <= spread)
    if not len(columns):
        return
    cos, sin = math.cos(yaw), math.sin(yaw)
    dx, dy = rays.origin[0] - x, rays.origin[1] - y
    start = np.array([cos * dx + sin * dy, -sin * dx + cos * dy, rays.origin[2]])
    ray = rays.direction[:, columns]
    turned = np.stack([cos * ray[..., 0] + sin * ray[..., 1], -sin * ray[..., 0] + cos * ray[..., 1], ray[..., 2]], -1)
    turned = np.where(np.abs(turned) < 1e-12, 1e-12, turned)
    one, two = (np.array(part.low) - start) / turned, (np.array(part.high) - start) / turned
    enter, leave = np.minimum(one, two).max(axis=-1), np.maximum(one, two).min(axis=-1)
    met = (enter <= leave) & (enter > 0.3) & (enter < rays.reach[:, columns])
    rays.reach[:, columns] = np.where(met, enter, rays.reach[:, columns])
    shine = 0.05 + 0.3 * sum(part.side) / 765.0
    rays.brightness[:, columns] = np.where(met, shine, rays.brightness[:, columns])


def _gap(part: Part, here: F64) -> float:
    """Distance in the plane from the eye to the middle of a part."""
    return math.hypot((part.low[0] + part.high[0]) / 2 - here[0], (part.low[1] + part.high[1]) / 2 - here[1])


def _turned(points: F64, x: float, y: float, yaw: float) -> F64:
    """Points [N, 2] of a thing's frame in the street's."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    return np.stack([x + cos * points[:, 0] - sin * points[:, 1], y + sin * points[:, 0] + cos * points[:, 1]], axis=1)


def _spun(normal: F64, yaw: float) -> F64:
    cos, sin = math.cos(yaw), math.sin(yaw)
    return np.array([cos * normal[0] - sin * normal[1], sin * normal[0] + cos * normal[1], normal[2]])


def _clipped(polygon: F64) -> F64:
    """The part of a convex polygon [N, 3] (camera frame) that lies beyond the near plane (Sutherland-Hodgman)."""
    if polygon[:, 2].min() >= NEAR:
        return polygon
    kept = []
    for one, two in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if one[2] >= NEAR:
            kept.append(one)
        if (one[2] >= NEAR) != (two[2] >= NEAR):
            kept.append(one + (two - one) * ((NEAR - one[2]) / (two[2] - one[2])))
    return np.array(kept).reshape(-1, 3)


def _bounds(pixels: F64, width: int, height: int) -> tuple[int, int, int, int] | None:
    """Rectangle of whole pixels (left, top, right, bottom) within the image; None outside."""
    left, top = np.floor(pixels.min(axis=0)).astype(int)
    right, bottom = np.ceil(pixels.max(axis=0)).astype(int) + 1
    left, top, right, bottom = max(left, 0), max(top, 0), min(right, width), min(bottom, height)
    return (int(left), int(top), int(right), int(bottom)) if left < right and top < bottom else None


def _fill(image: U8, pixels: F64, colour: float | tuple[float, float, float], *, smooth: bool = False) -> None:
    points = np.round(np.clip(pixels, -30000, 30000) * (1 << _SHIFT)).astype(np.int32)
    cv2.fillConvexPoly(image, points, colour, cv2.LINE_AA if smooth else cv2.LINE_8, _SHIFT)


def _stamp(order: U8, faces: Sequence[F64], number: int) -> int:
    """Mark the faces of an object in the picture of numbers; how many pixels they have together."""
    if not faces:
        return 0
    box = _bounds(np.concatenate(faces), order.shape[1], order.shape[0])
    if box is None:
        return 0
    left, top, right, bottom = box
    mask = np.zeros((bottom - top, right - left), np.uint8)
    for face in faces:
        _fill(mask, face - (left, top), 1)
    order[top:bottom, left:right][mask > 0] = number
    return int(np.count_nonzero(mask))


def _clouds(random: np.random.Generator) -> F32:
    """Cover 0 to 1 by direction: columns once around, rows from the horizon up."""
    rows, columns = 256, 1024
    cover = np.zeros((rows, columns), np.float32)
    for octave in range(2, 7):
        low = np.tile(random.normal(size=(2**octave, 2 ** (octave + 1))).astype(np.float32), (1, 3))
        grown = cv2.resize(low, (3 * columns, rows), interpolation=cv2.INTER_CUBIC)
        cover += grown[:, columns : 2 * columns] * np.float32(0.6**octave)
    cover /= cover.std()
    cover = np.clip(0.45 * (cover + 0.1), 0.0, 0.85)
    return np.concatenate([cover, cover[:, :1]], axis=1)  # a remap does not wrap
