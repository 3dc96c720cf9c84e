"""Triangles under construction: pieces in a frame of their own, put into the world many at once."""

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
class Piece:
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
    """Materials by name; each has an index from the first time it is asked for."""

    def __init__(self) -> None:
        self.table: dict[Material, int] = {}

    def add(self, name: str, colour: ArrayLike, *, specular: float = 0.04, gloss: float = 0.1) -> int:
        """Index of a material (colour: linear RGB)."""
        r, g, b = np.round(np.clip(np.asarray(colour, np.float64), 0.0, 1.0), 4).tolist()
        return self.table.setdefault(Material(name, (r, g, b), specular, gloss), len(self.table))

    def shade(self, index: int, factor: float, name: str | None = None) -> int:
        """A darker or lighter material like another one."""
        like = list(self.table)[index]
        colour = factor * np.array(like.colour)
        return self.add(name or like.name, colour, specular=like.specular, gloss=like.gloss)


class TriangleBuilder:
    """Collects triangles. What is added in one call is one thing, unless each face has an owner of its own."""

    def __init__(self) -> None:
        self.pieces: list[Piece] = []
        self.owner: list[F64] = []  # [F, 2] middle of the thing that a face belongs to; NaN for the horizon
        self.size = 0

    def add(self, piece: Piece, owner: ArrayLike | None = None) -> int:
        """Add a piece; owner [2] or [F, 2] (default: each face its own middle). Gives the index of its first face."""
        first, count = self.size, len(piece.faces)
        if owner is None:
            place = piece.vertices[piece.faces].mean(axis=1)[:, :2]
        else:
            place = np.broadcast_to(np.asarray(owner, np.float64), (count, 2))
        self.pieces.append(piece)
        self.owner.append(place)
        self.size += count
        return first

    def place(self, piece: Piece, poses: ArrayLike, *, scale: ArrayLike = 1.0) -> int:
        """Add copies of a piece, each a thing of its own.

        Args:
            piece: The piece.
            poses: x, y, z, yaw of each copy [n, 4].
            scale: [n] or [n, 3].
        """
        pose = np.asarray(poses, np.float64).reshape(-1, 4)
        n, v, f = len(pose), len(piece.vertices), len(piece.faces)
        if not n or not f:
            return self.size
        size = np.asarray(scale, np.float64)
        size = np.broadcast_to(size[:, None] if size.ndim == 1 else size, (n, 3))
        c, s = np.cos(pose[:, 3]), np.sin(pose[:, 3])
        turn = np.zeros((n, 3, 3))
        turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1], turn[:, 2, 2] = c, -s, s, c, 1.0
        moved = np.einsum("nij,nvj->nvi", turn, piece.vertices[None] * size[:, None]) + pose[:, None, :3]
        normals = np.einsum("nij,nfkj->nfki", turn, piece.normals[None] / size[:, None, None])
        normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
        faces = piece.faces[None] + (v * np.arange(n, dtype=np.int32))[:, None, None]
        copies = Piece(
            moved.reshape(-1, 3),
            faces.reshape(-1, 3).astype(np.int32),
            normals.reshape(-1, 3, 3),
            np.tile(piece.uv, (n, 1, 1)),
            np.tile(piece.material, n),
            np.tile(piece.levels, n),
        )
        return self.add(copies, np.repeat(pose[:, :2], f, axis=0))


def join(pieces: list[Piece]) -> Piece:
    """One piece of many."""
    start = np.concatenate([[0], np.cumsum([len(p.vertices) for p in pieces])])
    return Piece(
        np.concatenate([p.vertices for p in pieces]),
        np.concatenate([p.faces + k for p, k in zip(pieces, start, strict=False)]).astype(np.int32),
        np.concatenate([p.normals for p in pieces]),
        np.concatenate([p.uv for p in pieces]),
        np.concatenate([p.material for p in pieces]),
        np.concatenate([p.levels for p in pieces]),
    )


def flat(corners: ArrayLike, material: ArrayLike, *, levels: int = ALL) -> Piece:
    """Flat convex polygons [n, k, 3], counter-clockwise seen from outside.

    Their uv are metres from the first corner along the first edge, upwards from there on walls.
    """
    p = np.asarray(corners, np.float64)
    n, k = p.shape[:2]
    fan = np.stack([np.zeros(k - 2, int), np.arange(1, k - 1), np.arange(2, k)], axis=1)
    faces = (fan[None] + (k * np.arange(n))[:, None, None]).reshape(-1, 3)
    edge = p[:, 1] - p[:, 0]
    normal = cross(edge, p[:, 2] - p[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    u = edge / np.maximum(np.linalg.norm(edge, axis=1, keepdims=True), 1e-12)
    v = cross(normal, u)
    wall = np.abs(normal[:, 2]) < 0.5
    start = np.where(wall[:, None], p[:, 0] * np.array([1.0, 1.0, 0.0]), p[:, 0])
    away = p - start[:, None]
    place = np.stack([np.einsum("nki,ni->nk", away, u), np.einsum("nki,ni->nk", away, v)], axis=-1)
    ground = normal[:, 2] > 0.99
    place = np.where(ground[:, None, None], p[..., :2], place)
    index = np.repeat(np.broadcast_to(np.asarray(material, np.int32), n), k - 2)
    return Piece(
        p.reshape(-1, 3),
        faces.astype(np.int32),
        np.repeat(np.repeat(normal, k - 2, axis=0)[:, None], 3, axis=1),
        place[:, fan].reshape(-1, 3, 2),
        index.astype(np.int32),
        np.full(len(faces), levels, np.int32),
    )


_SIDES = np.array([[0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7], [4, 5, 6, 7], [3, 2, 1, 0]])


def box(low: ArrayLike, high: ArrayLike, material: ArrayLike, *, levels: int = ALL, base: bool = False) -> Piece:
    """Boxes along the axes from low [n, 3] to high [n, 3]; the underside is left out unless `base`."""
    a, b = (np.asarray(v, np.float64).reshape(-1, 3) for v in (low, high))
    corner = np.stack(
        [
            np.stack([(a, b)[i][:, 0], (a, b)[j][:, 1], (a, b)[k][:, 2]], axis=1)
            for k in (0, 1)
            for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))
        ],
        axis=1,
    )
    sides = _SIDES if base else _SIDES[:5]
    index = np.repeat(np.broadcast_to(np.asarray(material, np.int32), len(a)), len(sides))
    return flat(corner[:, sides].reshape(-1, 4, 3), index, levels=levels)


def smooth(
    vertices: ArrayLike, faces: ArrayLike, normals: ArrayLike, material: ArrayLike, *, levels: int = ALL
) -> Piece:
    """A piece with a normal for each vertex [V, 3]; uv: angle about z and height, m."""
    v, f, n = np.asarray(vertices, np.float64), np.asarray(faces, np.int32), np.asarray(normals, np.float64)
    n = n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-12)
    around = np.arctan2(v[:, 1], v[:, 0]) * np.hypot(v[:, 0], v[:, 1])
    uv = np.stack([around, v[:, 2]], axis=1)
    index = np.broadcast_to(np.asarray(material, np.int32), len(f)).astype(np.int32)
    return Piece(v, f, n[f], uv[f], index, np.full(len(f), levels, np.int32))


def cylinder(
    radius: tuple[float, float], height: tuple[float, float], material: int, *, sides: int = 8, levels: int = ALL
) -> Piece:
    """A post about z from height[0] to height[1] with radius[0] and radius[1], closed at the top."""
    angle = np.arange(sides) * (2.0 * np.pi / sides)
    ring = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    low, high = (r * ring + [0.0, 0.0, z] for r, z in zip(radius, height, strict=True))
    i = np.arange(sides)
    j = (i + 1) % sides
    side = np.concatenate([np.stack([i, j, j + sides], 1), np.stack([i, j + sides, i + sides], 1)])
    wall = smooth(np.concatenate([low, high]), side, np.concatenate([ring, ring]), material, levels=levels)
    return join([wall, flat(high[None], material, levels=levels)]) if radius[1] > 1e-3 else wall


def tiles(owner: F64, levels: I32) -> tuple[tuple[float, float], int, int, I32, I32]:
    """origin, nx, ny, order and offset (see `Street`) for faces with owners [F, 2] and levels [F]."""
    far = ~np.isfinite(owner[:, 0])
    low = np.floor(owner[~far].min(axis=0) / TILE) * TILE
    nx, ny = (np.floor((owner[~far].max(axis=0) - low) / TILE).astype(int) + 1).tolist()
    place = np.where(far[:, None], low, owner)
    cell = np.floor((place - low) / TILE).astype(np.int64)
    index = np.where(far, nx * ny, cell[:, 1] * nx + cell[:, 0])
    order, offset, start = [], [], 0
    for k in range(LEVELS):
        mine = np.flatnonzero((levels & (1 << k)) != 0)
        order.append(mine[np.argsort(index[mine], kind="stable")])
        count = np.bincount(index[mine], minlength=nx * ny + 1)
        offset.append(start + np.concatenate([[0], np.cumsum(count)]))
        start += len(mine)
    listed, starts = np.concatenate(order).astype(np.int32), np.stack(offset).astype(np.int32)
    return (float(low[0]), float(low[1])), nx, ny, listed, starts
