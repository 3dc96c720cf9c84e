"""Triangles under construction: pieces in a local frame, and their placement in the world."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ssad.core.geometry import cross
from ssad.rendering.meshes.mesh import F64, I32, Material
from ssad.rendering.street.model import FAR, LEVELS, MID, NEAR, TILE

ALL = NEAR | MID | FAR
HORIZON_OWNER = (np.nan, np.nan)  # of faces that belong to every view
ArrayLike = npt.ArrayLike


@dataclass(frozen=True)
class TrianglePiece:
    """Triangles in one frame.

    Attributes:
        vertices: [V, 3], m.
        faces: Indices of vertices [F, 3].
        normals: Of each corner [F, 3, 3].
        uv: Texture coordinates of each corner [F, 3, 2], m.
        material: [F].
        levels: Levels at which each face is drawn [F].
    """

    vertices: F64
    faces: I32
    normals: F64
    uv: F64
    material: I32
    levels: I32


class Palette:
    """Materials by name; each gets an index when it is first used."""

    def __init__(self) -> None:
        self.table: dict[Material, int] = {}

    def add(self, name: str, colour: ArrayLike, *, specular: float = 0.04, gloss: float = 0.1) -> int:
        """Index of a material (colour: linear RGB)."""
        red, green, blue = np.round(np.clip(np.asarray(colour, np.float64), 0.0, 1.0), 4).tolist()
        return self.table.setdefault(Material(name, (red, green, blue), specular, gloss), len(self.table))

    def shade(self, index: int, factor: float, name: str | None = None) -> int:
        """Return a darker or lighter version of a material."""
        original = list(self.table)[index]
        colour = factor * np.array(original.colour)
        return self.add(name or original.name, colour, specular=original.specular, gloss=original.gloss)


class TriangleBuilder:
    """Collector of triangles.

    The faces of one call are one object, unless each face has an owner of its own.
    """

    def __init__(self) -> None:
        self.pieces: list[TrianglePiece] = []
        self.owner: list[F64] = []  # [F, 2] middle of the object that a face belongs to; NaN for the horizon
        self.size = 0

    def add(self, piece: TrianglePiece, owner: ArrayLike | None = None) -> int:
        """Add a piece and return the index of its first face.

        Args:
            piece: The piece.
            owner: Middle of the object [2], or one for each face [F, 2]; None: each face is its own object.
        """
        first_face, count = self.size, len(piece.faces)
        if owner is None:
            owners = piece.vertices[piece.faces].mean(axis=1)[:, :2]
        else:
            owners = np.broadcast_to(np.asarray(owner, np.float64), (count, 2))
        self.pieces.append(piece)
        self.owner.append(owners)
        self.size += count
        return first_face

    def place(self, piece: TrianglePiece, poses: ArrayLike, *, scale: ArrayLike = 1.0) -> int:
        """Add copies of a piece, each an object of its own.

        Args:
            piece: The piece.
            poses: x, y, z, yaw of each copy [n, 4].
            scale: One number, [n] or [n, 3].

        Returns:
            Index of the first face.
        """
        pose_rows = np.asarray(poses, np.float64).reshape(-1, 4)
        count, vertex_count, face_count = len(pose_rows), len(piece.vertices), len(piece.faces)
        if not count or not face_count:
            return self.size
        scales = np.asarray(scale, np.float64)
        scales = np.broadcast_to(scales[:, None] if scales.ndim == 1 else scales, (count, 3))
        cosine, sine = np.cos(pose_rows[:, 3]), np.sin(pose_rows[:, 3])
        rotations = np.zeros((count, 3, 3))
        rotations[:, 0, 0], rotations[:, 0, 1], rotations[:, 1, 0], rotations[:, 1, 1], rotations[:, 2, 2] = (
            cosine,
            -sine,
            sine,
            cosine,
            1.0,
        )
        positions = (
            np.einsum("nij,nvj->nvi", rotations, piece.vertices[None] * scales[:, None]) + pose_rows[:, None, :3]
        )
        # Under a scale, normals transform with its inverse.
        normals = np.einsum("nij,nfkj->nfki", rotations, piece.normals[None] / scales[:, None, None])
        normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
        faces = piece.faces[None] + (vertex_count * np.arange(count, dtype=np.int32))[:, None, None]
        copies = TrianglePiece(
            positions.reshape(-1, 3),
            faces.reshape(-1, 3).astype(np.int32),
            normals.reshape(-1, 3, 3),
            np.tile(piece.uv, (count, 1, 1)),
            np.tile(piece.material, count),
            np.tile(piece.levels, count),
        )
        return self.add(copies, np.repeat(pose_rows[:, :2], face_count, axis=0))


def join(pieces: list[TrianglePiece]) -> TrianglePiece:
    """Merge pieces into one."""
    first_vertices = np.concatenate([[0], np.cumsum([len(piece.vertices) for piece in pieces])])
    return TrianglePiece(
        np.concatenate([piece.vertices for piece in pieces]),
        np.concatenate(
            [piece.faces + first_vertex for piece, first_vertex in zip(pieces, first_vertices, strict=False)]
        ).astype(np.int32),
        np.concatenate([piece.normals for piece in pieces]),
        np.concatenate([piece.uv for piece in pieces]),
        np.concatenate([piece.material for piece in pieces]),
        np.concatenate([piece.levels for piece in pieces]),
    )


def flat(corners: ArrayLike, material: ArrayLike, *, levels: int = ALL) -> TrianglePiece:
    """Flat convex polygons [n, k, 3], counter-clockwise seen from outside.

    Their uv are metres from the first corner along the first edge, upwards from there on walls.
    """
    points = np.asarray(corners, np.float64)
    count, corner_count = points.shape[:2]
    corner_triples = np.stack(
        [np.zeros(corner_count - 2, int), np.arange(1, corner_count - 1), np.arange(2, corner_count)], axis=1
    )
    faces = (corner_triples[None] + (corner_count * np.arange(count))[:, None, None]).reshape(-1, 3)
    first_edges = points[:, 1] - points[:, 0]
    normals = cross(first_edges, points[:, 2] - points[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    right_axes = first_edges / np.maximum(np.linalg.norm(first_edges, axis=1, keepdims=True), 1e-12)
    up_axes = cross(normals, right_axes)
    is_wall = np.abs(normals[:, 2]) < 0.5
    # On walls v counts from the ground, so that patterns such as brick courses line up.
    origins = np.where(is_wall[:, None], points[:, 0] * np.array([1.0, 1.0, 0.0]), points[:, 0])
    offsets = points - origins[:, None]
    surface_uv = np.stack(
        [np.einsum("nki,ni->nk", offsets, right_axes), np.einsum("nki,ni->nk", offsets, up_axes)], axis=-1
    )
    is_level = normals[:, 2] > 0.99
    surface_uv = np.where(is_level[:, None, None], points[..., :2], surface_uv)
    material_index = np.repeat(np.broadcast_to(np.asarray(material, np.int32), count), corner_count - 2)
    return TrianglePiece(
        points.reshape(-1, 3),
        faces.astype(np.int32),
        np.repeat(np.repeat(normals, corner_count - 2, axis=0)[:, None], 3, axis=1),
        surface_uv[:, corner_triples].reshape(-1, 3, 2),
        material_index.astype(np.int32),
        np.full(len(faces), levels, np.int32),
    )


_SIDES = np.array([[0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7], [4, 5, 6, 7], [3, 2, 1, 0]])


def box(
    low: ArrayLike, high: ArrayLike, material: ArrayLike, *, levels: int = ALL, base: bool = False
) -> TrianglePiece:
    """Return axis-aligned boxes from low [n, 3] to high [n, 3]; the underside is left out unless `base`."""
    lower, upper = (np.asarray(corner_values, np.float64).reshape(-1, 3) for corner_values in (low, high))
    corners = np.stack(
        [
            np.stack([(lower, upper)[x_side][:, 0], (lower, upper)[y_side][:, 1], (lower, upper)[z_side][:, 2]], axis=1)
            for z_side in (0, 1)
            for x_side, y_side in ((0, 0), (1, 0), (1, 1), (0, 1))
        ],
        axis=1,
    )
    sides = _SIDES if base else _SIDES[:5]
    material_index = np.repeat(np.broadcast_to(np.asarray(material, np.int32), len(lower)), len(sides))
    return flat(corners[:, sides].reshape(-1, 4, 3), material_index, levels=levels)


def smooth(
    vertices: ArrayLike, faces: ArrayLike, normals: ArrayLike, material: ArrayLike, *, levels: int = ALL
) -> TrianglePiece:
    """A piece with a normal for each vertex [V, 3]; uv: angle about z and height, m."""
    points, triangles, unit_normals = (
        np.asarray(vertices, np.float64),
        np.asarray(faces, np.int32),
        np.asarray(normals, np.float64),
    )
    unit_normals = unit_normals / np.maximum(np.linalg.norm(unit_normals, axis=1, keepdims=True), 1e-12)
    arc_length = np.arctan2(points[:, 1], points[:, 0]) * np.hypot(points[:, 0], points[:, 1])
    uv = np.stack([arc_length, points[:, 2]], axis=1)
    material_index = np.broadcast_to(np.asarray(material, np.int32), len(triangles)).astype(np.int32)
    return TrianglePiece(
        points,
        triangles,
        unit_normals[triangles],
        uv[triangles],
        material_index,
        np.full(len(triangles), levels, np.int32),
    )


def cylinder(
    radius: tuple[float, float], height: tuple[float, float], material: int, *, sides: int = 8, levels: int = ALL
) -> TrianglePiece:
    """Return a post about z from height[0] to height[1] with radius[0] and radius[1], closed at the top."""
    angles = np.arange(sides) * (2.0 * np.pi / sides)
    ring = np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)
    lower, upper = (ring_radius * ring + [0.0, 0.0, z] for ring_radius, z in zip(radius, height, strict=True))
    indices = np.arange(sides)
    next_indices = (indices + 1) % sides
    side_faces = np.concatenate(
        [
            np.stack([indices, next_indices, next_indices + sides], 1),
            np.stack([indices, next_indices + sides, indices + sides], 1),
        ]
    )
    wall = smooth(np.concatenate([lower, upper]), side_faces, np.concatenate([ring, ring]), material, levels=levels)
    return join([wall, flat(upper[None], material, levels=levels)]) if radius[1] > 1e-3 else wall


def tiles(owner: F64, levels: I32) -> tuple[tuple[float, float], int, int, I32, I32]:
    """Sort faces with owners [F, 2] and levels [F] into tiles: origin, nx, ny, order and offset (see `Street`)."""
    is_horizon = ~np.isfinite(owner[:, 0])
    lower_corner = np.floor(owner[~is_horizon].min(axis=0) / TILE) * TILE
    nx, ny = (np.floor((owner[~is_horizon].max(axis=0) - lower_corner) / TILE).astype(int) + 1).tolist()
    # A valid position for the horizon, whose tile is set below.
    positions = np.where(is_horizon[:, None], lower_corner, owner)
    cells = np.floor((positions - lower_corner) / TILE).astype(np.int64)
    tile_index = np.where(is_horizon, nx * ny, cells[:, 1] * nx + cells[:, 0])
    order, offset, first_position = [], [], 0
    for level in range(LEVELS):
        level_faces = np.flatnonzero((levels & (1 << level)) != 0)
        order.append(level_faces[np.argsort(tile_index[level_faces], kind="stable")])
        count = np.bincount(tile_index[level_faces], minlength=nx * ny + 1)
        offset.append(first_position + np.concatenate([[0], np.cumsum(count)]))
        first_position += len(level_faces)
    face_order, face_offsets = np.concatenate(order).astype(np.int32), np.stack(offset).astype(np.int32)
    return (float(lower_corner[0]), float(lower_corner[1])), nx, ny, face_order, face_offsets
