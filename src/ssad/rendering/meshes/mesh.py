"""Triangle meshes: the data that the visibility pass reads, and builders for simple solids.

Shape letters: V vertices, F faces, P points of an outline, S cross sections. Lengths in metres. The object frame
has x forward, y left, z up; its origin is the centre of the base on the ground. Texture coordinates follow image
rows: u runs right and v runs DOWN, so texel (row, column) of a [H, W] texture lies at v = row / H, u = column / W.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from ssad.core.errors import ConfigError, FormatError
from ssad.core.geometry import cross

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
I32 = npt.NDArray[np.int32]
Rectangle = tuple[float, float, float, float]
"""u0, v0, u1, v1 in the texture atlas."""
Point = tuple[float, float, float]

SMOOTH = 0.7  # rad: neighbouring faces that meet at less are shaded as one surface
AT_ONCE = 12  # faces at a vertex; most vertices have fewer
MIN_AREA = 1e-9  # m^2: builders leave out smaller triangles


@dataclass(frozen=True, slots=True)
class Material:
    """How a surface reflects: linear RGB albedo, specular share, gloss in [0, 1], emission (1 = white paper in sun).

    `paint` says that the surface takes the paint of the vehicle, or a user's texture.
    """

    name: str
    colour: tuple[float, float, float]
    specular: float = 0.04
    gloss: float = 0.3
    emission: float = 0.0
    paint: bool = False


@dataclass(frozen=True, slots=True)
class Mesh:
    """Triangles with normals, texture coordinates, materials and named panels.

    vertices [V, 3] m; faces [F, 3] counter-clockwise seen from outside; normals [F, 3, 3] unit, for each corner;
    uv [F, 3, 2] in [0, 1]; material [F] index into `materials`; panel [F] index into `panels`, -1 for none.
    A name `left_side/front_door` is a part of the panel `left_side`: both can be asked for. `rectangles` holds the
    rectangle of each panel in the atlas, the same at all levels of detail; where it is empty, the rectangle is the
    extent of the panel's texture coordinates.
    """

    vertices: F32
    faces: I32
    normals: F32
    uv: F32
    material: I32
    panel: I32
    materials: tuple[Material, ...]
    panels: tuple[str, ...] = ()
    rectangles: tuple[Rectangle, ...] = ()

    def bounds(self) -> tuple[F64, F64]:
        """Smallest and largest corner, [3] each, m. Only vertices that a face uses count."""
        used = self.vertices[np.unique(self.faces)].astype(np.float64)
        if not len(used):
            return np.zeros(3), np.zeros(3)
        return used.min(axis=0), used.max(axis=0)

    def corners(self) -> F64:
        """Positions of the corners of all faces [F, 3, 3], m."""
        return self.vertices[self.faces].astype(np.float64)

    def areas(self) -> F64:
        """Area of each face [F], m^2."""
        p = self.corners()
        return np.asarray(0.5 * np.linalg.norm(cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=-1))

    def painted(self) -> npt.NDArray[np.bool_]:
        """Faces that take the paint [F]."""
        return np.array([m.paint for m in self.materials], dtype=bool)[self.material]

    def panel_rectangle(self, name: str) -> Rectangle:
        """Rectangle (u0, v0, u1, v1) of a panel in the atlas. ConfigError for an unknown name."""
        indices = self.panel_indices(name)
        if self.rectangles:
            r = np.array([self.rectangles[i] for i in indices])
            return float(r[:, 0].min()), float(r[:, 1].min()), float(r[:, 2].max()), float(r[:, 3].max())
        uv = self.uv[np.isin(self.panel, indices)].reshape(-1, 2).astype(np.float64)
        if not len(uv):
            raise ConfigError(f"panel '{name}' has no faces; choose another panel")
        low, high = uv.min(axis=0), uv.max(axis=0)
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])

    def panel_indices(self, name: str) -> list[int]:
        """Numbers of a panel and of its parts in `panels`. ConfigError for an unknown name."""
        indices = [i for i, panel in enumerate(self.panels) if panel == name or panel.startswith(f"{name}/")]
        if not indices:
            raise ConfigError(f"no panel '{name}'; this mesh has: {', '.join(self.panels) or 'no panels'}")
        return indices

    def transformed(self, matrix: npt.ArrayLike) -> Mesh:
        """The mesh moved by a [4, 4] or [3, 3] matrix (column vectors). A mirroring matrix keeps outsides outside."""
        m = np.asarray(matrix, dtype=np.float64)
        linear = m[:3, :3]
        move = m[:3, 3] if m.shape == (4, 4) else np.zeros(3)
        determinant = np.linalg.det(linear)
        if abs(determinant) < 1e-12:
            raise ConfigError("a mesh cannot be moved by a singular matrix")
        vertices = self.vertices.astype(np.float64) @ linear.T + move
        normals = self.normals.astype(np.float64) @ np.linalg.inv(linear)
        normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
        order = [0, 2, 1] if determinant < 0 else [0, 1, 2]
        return replace(
            self,
            vertices=vertices.astype(np.float32),
            normals=normals[:, order].astype(np.float32),
            faces=np.ascontiguousarray(self.faces[:, order]),
            uv=np.ascontiguousarray(self.uv[:, order]),
        )

    def moved(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Mesh:
        """The mesh shifted by metres."""
        matrix = np.eye(4)
        matrix[:3, 3] = x, y, z
        return self.transformed(matrix)

    def with_panel(self, name: str) -> Mesh:
        """The mesh with all faces in one panel of this name."""
        return replace(self, panel=np.zeros(len(self.faces), np.int32), panels=(name,), rectangles=())

    def check(self, name: str = "mesh") -> None:
        """FormatError (one line) for wrong shapes, values not finite, indices out of range, too many empty faces."""
        v, f = len(self.vertices), len(self.faces)
        shapes = {
            "vertices": (self.vertices, (v, 3)),
            "faces": (self.faces, (f, 3)),
            "normals": (self.normals, (f, 3, 3)),
            "texture coordinates": (self.uv, (f, 3, 2)),
            "materials of faces": (self.material, (f,)),
            "panels of faces": (self.panel, (f,)),
        }
        for what, (array, shape) in shapes.items():
            if array.shape != shape:
                raise FormatError(f"{name}: {what} have shape {array.shape}, expected {shape}")
            if not np.isfinite(array).all():
                raise FormatError(f"{name}: {what} hold NaN or infinity; mend the mesh")
        if not f:
            raise FormatError(f"{name}: the mesh has no faces")
        for what, index, size, low in (
            ("vertex", self.faces, v, 0),
            ("material", self.material, len(self.materials), 0),
            ("panel", self.panel, len(self.panels), -1),
        ):
            if index.min() < low or index.max() >= size:
                raise FormatError(f"{name}: a {what} index is out of range (there are {size})")
        if self.uv.min() < 0.0 or self.uv.max() > 1.0:
            raise FormatError(f"{name}: texture coordinates leave [0, 1]; unwrap the mesh into one atlas")
        if self.rectangles and len(self.rectangles) != len(self.panels):
            raise FormatError(f"{name}: {len(self.rectangles)} rectangles for {len(self.panels)} panels")
        empty = int((self.areas() < 1e-12).sum())
        if empty > max(4, f // 50):
            raise FormatError(f"{name}: {empty} of {f} faces have no area; remove them")
        long = np.abs(np.linalg.norm(self.normals.astype(np.float64), axis=-1) - 1.0) > 1e-3
        if long.any():
            raise FormatError(f"{name}: {int(long.sum())} normals are not of unit length")


def merge(meshes: Sequence[Mesh]) -> Mesh:
    """One mesh of many. Equal materials and panels of one name become one; texture coordinates stay as they are."""
    materials: dict[Material, int] = {}
    panels: dict[str, int] = {}
    rectangles: dict[str, Rectangle] = {}
    parts: list[tuple[npt.NDArray[Any], ...]] = []
    offset = 0
    for mesh in meshes:
        to_material = np.array([materials.setdefault(m, len(materials)) for m in mesh.materials], np.int32)
        to_panel = np.array([*(panels.setdefault(p, len(panels)) for p in mesh.panels), -1], np.int32)
        rectangles.update(zip(mesh.panels, mesh.rectangles, strict=False))
        faces = (mesh.faces + offset).astype(np.int32)
        parts.append((mesh.vertices, faces, mesh.normals, mesh.uv, to_material[mesh.material], to_panel[mesh.panel]))
        offset += len(mesh.vertices)
    if not parts:
        raise ConfigError("no meshes to merge")
    columns: list[npt.NDArray[Any]] = [np.concatenate(column) for column in zip(*parts, strict=True)]
    vertices, triangles, normals, uv, material, panel = columns
    kept = tuple(rectangles[p] for p in panels) if len(rectangles) == len(panels) else ()
    return Mesh(vertices, triangles, normals, uv, material, panel, tuple(materials), tuple(panels), kept)


def part_of(mesh: Mesh, faces: npt.NDArray[np.bool_]) -> Mesh:
    """The mesh with some of its faces [F] alone, in the place and with the atlas of the whole."""
    return replace(
        mesh,
        faces=mesh.faces[faces],
        normals=mesh.normals[faces],
        uv=mesh.uv[faces],
        material=mesh.material[faces],
        panel=mesh.panel[faces],
    )


def corner_normals(vertices: npt.ArrayLike, faces: npt.ArrayLike, *, smooth: float = SMOOTH) -> F64:
    """Unit normals for each corner [F, 3, 3]: area-weighted over faces at the vertex within `smooth` rad."""
    v, f = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    area = cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]])
    unit = area / np.maximum(np.linalg.norm(area, axis=1, keepdims=True), 1e-30)
    if smooth <= 0.0:
        return np.repeat(unit[:, None], 3, axis=1)
    flat = f.ravel()
    order = np.argsort(flat, kind="stable")
    counts = np.bincount(flat, minlength=len(v))
    starts = np.cumsum(counts) - counts
    own = np.repeat(unit, 3, axis=0)
    total = np.zeros_like(own)
    most = int(counts.max(initial=0))
    # some faces at the vertex of each corner at once [K, corners], summed in turn: the order of a sum decides its bits
    for first in range(0, most, AT_ONCE):
        corner = np.flatnonzero(counts[flat] > first)
        vertex = flat[corner]
        turn = np.arange(first, min(first + AT_ONCE, most))[:, None]
        there = turn < counts[vertex]
        other = order[np.where(there, starts[vertex] + turn, 0)] // 3
        near = there & (np.einsum("ci,kci->kc", own[corner], unit[other]) >= np.cos(smooth))
        parts = np.where(near[..., None], area[other], 0.0)
        total[corner] = np.add.reduce(np.concatenate([total[corner][None], parts]), axis=0)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    result = np.where(length > 1e-20, total / np.maximum(length, 1e-30), own)
    result[np.linalg.norm(result, axis=1) < 0.5] = 0.0, 0.0, 1.0
    return result.reshape(-1, 3, 3)


def build(
    vertices: npt.ArrayLike,
    faces: npt.ArrayLike,
    *,
    materials: Material | Sequence[Material],
    material: npt.ArrayLike = 0,
    uv: npt.ArrayLike | None = None,
    panel: str | npt.ArrayLike | None = None,
    panels: Sequence[str] = (),
    smooth: float = SMOOTH,
    outward: bool = False,
) -> Mesh:
    """A mesh of vertices [V, 3] and faces [F, 3] with normals made here; triangles without area are left out.

    uv [F, 3, 2] (default: the half square of each face); material [F] or one index; panel one name, or indices [F] into
    `panels`; `outward` turns all faces when the signed volume is negative, for closed solids.
    """
    v, f = np.asarray(vertices, np.float64).reshape(-1, 3), np.asarray(faces, np.int32).reshape(-1, 3)
    table = (materials,) if isinstance(materials, Material) else tuple(materials)
    keep = np.linalg.norm(cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]]), axis=1) > 2.0 * MIN_AREA
    index = np.broadcast_to(np.asarray(material, np.int32), len(f))[keep]
    names = (panel,) if isinstance(panel, str) else tuple(panels)
    place = np.asarray(0 if isinstance(panel, str) else -1 if panel is None else panel, np.int32)
    place = np.array(np.broadcast_to(place, len(f))[keep])
    half = np.broadcast_to(np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0]]), (len(f), 3, 2))
    coordinates = (half if uv is None else np.asarray(uv, np.float64).reshape(-1, 3, 2))[keep]
    f = f[keep]
    if outward and np.einsum("fi,fi->", v[f[:, 0]], cross(v[f[:, 1]], v[f[:, 2]])) < 0.0:
        f, coordinates = f[:, ::-1], coordinates[:, ::-1]
    return Mesh(
        v.astype(np.float32),
        np.ascontiguousarray(f, dtype=np.int32),
        corner_normals(v, f, smooth=smooth).astype(np.float32),
        np.ascontiguousarray(coordinates, dtype=np.float32),
        np.array(index, np.int32),
        place,
        table,
        names,
    )


def weld(vertices: npt.ArrayLike, faces: npt.ArrayLike, *, tolerance: float = 1e-5) -> tuple[F64, I32]:
    """Vertices with those nearer than about `tolerance` made one, and faces that point at them."""
    v = np.asarray(vertices, np.float64)
    _, first, inverse = np.unique(
        np.round(v / tolerance).astype(np.int64), axis=0, return_index=True, return_inverse=True
    )
    return v[first], np.asarray(inverse).reshape(-1)[np.asarray(faces)].astype(np.int32)


def grid_faces(rows: int, columns: int, *, wrap: bool = False) -> I32:
    """Faces of a [rows, columns] grid of points, two for each cell, row by row; `wrap` joins last and first column."""
    across = columns if wrap else columns - 1
    r, c = np.meshgrid(np.arange(rows - 1), np.arange(across), indexing="ij")
    right = (c + 1) % columns
    a, b, d, e = r * columns + c, r * columns + right, (r + 1) * columns + right, (r + 1) * columns + c
    return np.stack([np.stack([a, b, d], -1), np.stack([a, d, e], -1)], axis=2).reshape(-1, 3).astype(np.int32)


def triangulate(outline: npt.ArrayLike) -> I32:
    """Counter-clockwise faces [P - 2, 3] of a simple polygon [P, 2], by ear clipping.

    ConfigError when it crosses itself.
    """
    p = np.asarray(outline, np.float64)
    q = np.roll(p, -1, axis=0)
    area = 0.5 * float(np.sum(p[:, 0] * q[:, 1] - q[:, 0] * p[:, 1]))
    left = list(range(len(p))) if area > 0 else list(range(len(p)))[::-1]
    faces: list[tuple[int, int, int]] = []

    def turn(a: int, b: int, c: int) -> float:
        return float((p[b, 0] - p[a, 0]) * (p[c, 1] - p[a, 1]) - (p[b, 1] - p[a, 1]) * (p[c, 0] - p[a, 0]))

    slack = 1e-12 * max(1.0, abs(area))
    while len(left) > 3:
        rest = p[left]
        for i in range(len(left)):
            a, b, c = left[i - 1], left[i], left[(i + 1) % len(left)]
            if turn(a, b, c) < -slack:
                continue
            corners = p[[a, b, c]]
            along = np.roll(corners, -1, axis=0) - corners
            away = rest[:, None] - corners
            inside = (along[:, 0] * away[..., 1] - along[:, 1] * away[..., 0] >= -slack).all(axis=1)
            if (inside & (away != 0.0).any(axis=2).all(axis=1)).any():
                continue
            faces.append((a, b, c))
            del left[i]
            break
        else:
            raise ConfigError("a polygon crosses itself; split it")
    faces.append((left[0], left[1], left[2]))
    return np.array(faces, np.int32)


# ---------------------------------------------------------------- solids


def box(size: Point, *, material: Material, centre: Point = (0.0, 0.0, 0.0), panel: str | None = None) -> Mesh:
    """A box of this size (x, y, z) about its centre; each side has the whole texture, upright seen from outside."""
    sides = [(0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0), (2, 1.0), (2, -1.0)]
    points: list[F64] = []
    for axis, sign in sides:
        normal = np.zeros(3)
        normal[axis] = sign
        up = np.array([0.0, 0.0, 1.0]) if axis < 2 else np.array([1.0, 0.0, 0.0])
        right = cross(up, normal)
        points += [normal - right - up, normal + right - up, normal + right + up, normal - right + up]
    vertices = 0.5 * np.array(points) * np.asarray(size) + np.asarray(centre)
    faces = np.concatenate([np.array([[0, 1, 2], [0, 2, 3]]) + 4 * k for k in range(6)])
    square = np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]])
    return build(
        vertices, faces, materials=material, uv=np.tile(square[[[0, 1, 2], [0, 2, 3]]], (6, 1, 1)), panel=panel
    )


def prism(
    outline: npt.ArrayLike, depth: tuple[float, float], *, material: Material, axis: int = 2, smooth: float = SMOOTH
) -> Mesh:
    """A simple polygon [P, 2] drawn out along an axis from depth[0] to depth[1], closed.

    The outline lies in (x, y) for axis 2, (y, z) for axis 0 and (x, z) for axis 1.
    """
    p = np.asarray(outline, np.float64)
    caps = triangulate(p)
    n = len(p)
    low, high = (np.insert(p, axis, d, axis=1) for d in depth)
    ring = np.arange(n)
    after = (ring + 1) % n
    side = np.concatenate([np.stack([ring, after, after + n], 1), np.stack([ring, after + n, ring + n], 1)])
    extent = np.maximum(np.ptp(p, axis=0), 1e-9)
    flat = (p - p.min(axis=0)) / extent
    flat[:, 1] = 1.0 - flat[:, 1]
    edge = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.roll(p, -1, axis=0) - p, axis=1))])
    edge /= edge[-1]
    a, b, c, d = (
        np.stack([u, np.full(n, w)], 1) for u, w in ((edge[:-1], 1), (edge[1:], 1), (edge[1:], 0), (edge[:-1], 0))
    )
    uv_side = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    clockwise = np.sum(p[:, 0] * np.roll(p[:, 1], -1) - np.roll(p[:, 0], -1) * p[:, 1]) < 0
    if clockwise:
        side, uv_side = side[:, ::-1], uv_side[:, ::-1]
    faces = np.concatenate([side, caps[:, ::-1], caps + n])
    uv = np.concatenate([uv_side, flat[caps[:, ::-1]], flat[caps]])
    return build(np.concatenate([low, high]), faces, materials=material, uv=uv, smooth=smooth, outward=True)


def loft(sections: npt.ArrayLike, *, material: Material, closed: bool = True, smooth: float = SMOOTH) -> Mesh:
    """A surface through cross sections [S, P, 3].

    `closed` joins last and first point of a section and fills both ends (convex sections).
    """
    s = np.asarray(sections, np.float64)
    faces, uv = _loft_faces(*s.shape[:2], closed)
    return build(s.reshape(-1, 3), faces, materials=material, uv=uv, smooth=smooth, outward=closed)


@lru_cache(256)
def _loft_faces(rows: int, columns: int, closed: bool) -> tuple[I32, F64]:
    """Faces [F, 3] and texture coordinates [F, 3, 2] of `loft`, not to be written to: bodies are full of equal ones."""
    faces = grid_faces(rows, columns, wrap=closed)
    across = np.linspace(0.0, 1.0, columns + int(closed))
    along = np.linspace(0.0, 1.0, rows)
    cells = across.size - 1
    r, c = (k.reshape(-1) for k in np.meshgrid(np.arange(rows - 1), np.arange(cells), indexing="ij"))

    def at(i: npt.NDArray[Any], j: npt.NDArray[Any]) -> F64:
        return np.stack([across[j], along[i]], -1)

    quads = [at(r, c), at(r, c + 1), at(r + 1, c + 1), at(r + 1, c)]
    uv = np.stack([np.stack([quads[k] for k in t], 1) for t in ((0, 1, 2), (0, 2, 3))], 1).reshape(-1, 3, 2)
    if closed:
        fan = np.stack([np.zeros(columns - 2), np.arange(1, columns - 1), np.arange(2, columns)], 1).astype(np.int32)
        last = fan + (rows - 1) * columns
        circle = 0.5 + 0.5 * np.stack([np.cos(2 * np.pi * across[:-1]), np.sin(2 * np.pi * across[:-1])], -1)
        faces = np.concatenate([faces, fan[:, ::-1], last])
        uv = np.concatenate([uv, circle[fan[:, ::-1]], circle[fan]])
    faces.flags.writeable = uv.flags.writeable = False
    return faces, uv


def lathe(
    profile: npt.ArrayLike, *, material: Material, segments: int = 16, axis: int = 2, smooth: float = SMOOTH
) -> Mesh:
    """A profile [P, 2] of (radius, place along the axis) turned about an axis through the origin; ends are closed."""
    p = np.asarray(profile, np.float64)
    angle = np.arange(segments) * (2.0 * np.pi / segments)
    a, b = [(1, 2), (2, 0), (0, 1)][axis]
    sections = np.zeros((len(p), segments, 3))
    sections[..., a] = p[:, :1] * np.cos(angle)
    sections[..., b] = p[:, :1] * np.sin(angle)
    sections[..., axis] = p[:, 1:]
    return loft(sections, material=material, smooth=smooth)


def sphere(radius: float | Point, *, material: Material, centre: Point = (0.0, 0.0, 0.0), segments: int = 12) -> Mesh:
    """An ellipsoid with half axes `radius` about its centre, `segments` around and half as many up."""
    rings = max(3, segments // 2)
    angle = np.linspace(-np.pi / 2, np.pi / 2, rings + 1)
    ball = lathe(np.stack([np.cos(angle), np.sin(angle)], 1), material=material, segments=segments, smooth=1.5)
    matrix = np.diag([*np.broadcast_to(np.asarray(radius, np.float64), 3), 1.0])
    matrix[:3, 3] = centre
    return ball.transformed(matrix)


def ring(radius: float, thickness: float, *, material: Material, segments: int = 20, around: int = 6) -> Mesh:
    """A torus about the y axis: `radius` to its outer edge, `thickness` across."""
    turn = np.linspace(0.0, 2.0 * np.pi, segments + 1)
    roll = np.arange(around) * (2.0 * np.pi / around)
    r = radius - 0.5 * thickness + 0.5 * thickness * np.cos(roll)
    y = 0.5 * thickness * np.sin(roll)
    grid = np.stack([r * np.sin(turn)[:, None], np.broadcast_to(y, (len(turn), around)), r * np.cos(turn)[:, None]], -1)
    faces = grid_faces(len(turn), around, wrap=True)
    return build(*weld(grid.reshape(-1, 3), faces), materials=material, smooth=1.2, outward=True)


def tube(path: npt.ArrayLike, radius: npt.ArrayLike, *, material: Material, segments: int = 8) -> Mesh:
    """A round bar along a path [S, 3] with one radius or one for each point."""
    p = np.asarray(path, np.float64)
    r = np.broadcast_to(np.asarray(radius, np.float64), len(p))
    along = np.gradient(p, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    helper = np.eye(3)[int(np.argmin(np.abs(along).sum(axis=0)))]
    side = cross(along, helper)
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-12)
    up = cross(along, side)
    angle = np.arange(segments) * (2.0 * np.pi / segments)
    ring = np.cos(angle)[None, :, None] * side[:, None] + np.sin(angle)[None, :, None] * up[:, None]
    return loft(p[:, None] + r[:, None, None] * ring, material=material)
