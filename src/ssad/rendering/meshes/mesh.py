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
    """Reflectance of a surface: linear RGB albedo, specular share, gloss and emission.

    Gloss lies in [0, 1]; an emission of 1 is as bright as white paper in the sun. `paint` marks surfaces that
    take the paint of the vehicle or a user's texture.
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
        used_vertices = self.vertices[np.unique(self.faces)].astype(np.float64)
        if not len(used_vertices):
            return np.zeros(3), np.zeros(3)
        return used_vertices.min(axis=0), used_vertices.max(axis=0)

    def corners(self) -> F64:
        """Positions of the corners of all faces [F, 3, 3], m."""
        return self.vertices[self.faces].astype(np.float64)

    def areas(self) -> F64:
        """Area of each face [F], m^2."""
        corners = self.corners()
        return np.asarray(
            0.5 * np.linalg.norm(cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
        )

    def painted(self) -> npt.NDArray[np.bool_]:
        """Faces that take the paint [F]."""
        return np.array([material.paint for material in self.materials], dtype=bool)[self.material]

    def panel_rectangle(self, name: str) -> Rectangle:
        """Return the rectangle (u0, v0, u1, v1) of a panel in the atlas.

        Raises:
            ConfigError: The mesh has no such panel, or the panel has no faces.
        """
        indices = self.panel_indices(name)
        if self.rectangles:
            rectangles = np.array([self.rectangles[index] for index in indices])
            return (
                float(rectangles[:, 0].min()),
                float(rectangles[:, 1].min()),
                float(rectangles[:, 2].max()),
                float(rectangles[:, 3].max()),
            )
        # Meshes of users have no rectangles: use the extent of the texture coordinates.
        panel_uv = self.uv[np.isin(self.panel, indices)].reshape(-1, 2).astype(np.float64)
        if not len(panel_uv):
            raise ConfigError(f"panel '{name}' has no faces; choose another panel")
        lower, upper = panel_uv.min(axis=0), panel_uv.max(axis=0)
        return float(lower[0]), float(lower[1]), float(upper[0]), float(upper[1])

    def panel_indices(self, name: str) -> list[int]:
        """Return the indices of a panel and of its parts in `panels`.

        Raises:
            ConfigError: The mesh has no such panel.
        """
        indices = [index for index, panel in enumerate(self.panels) if panel == name or panel.startswith(f"{name}/")]
        if not indices:
            raise ConfigError(f"no panel '{name}'; this mesh has: {', '.join(self.panels) or 'no panels'}")
        return indices

    def transformed(self, matrix: npt.ArrayLike) -> Mesh:
        """Return the mesh transformed by a [4, 4] or [3, 3] matrix (column vectors).

        A mirroring matrix also reverses the faces, so that their outsides stay outside.

        Raises:
            ConfigError: The matrix is singular.
        """
        transform = np.asarray(matrix, dtype=np.float64)
        linear = transform[:3, :3]
        translation = transform[:3, 3] if transform.shape == (4, 4) else np.zeros(3)
        determinant = np.linalg.det(linear)
        if abs(determinant) < 1e-12:
            raise ConfigError("a mesh cannot be moved by a singular matrix")
        vertices = self.vertices.astype(np.float64) @ linear.T + translation
        # Normals transform with the inverse transpose; these are row vectors.
        normals = self.normals.astype(np.float64) @ np.linalg.inv(linear)
        normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
        corner_order = [0, 2, 1] if determinant < 0 else [0, 1, 2]
        return replace(
            self,
            vertices=vertices.astype(np.float32),
            normals=normals[:, corner_order].astype(np.float32),
            faces=np.ascontiguousarray(self.faces[:, corner_order]),
            uv=np.ascontiguousarray(self.uv[:, corner_order]),
        )

    def moved(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Mesh:
        """Return the mesh shifted by x, y and z metres."""
        matrix = np.eye(4)
        matrix[:3, 3] = x, y, z
        return self.transformed(matrix)

    def with_panel(self, name: str) -> Mesh:
        """Return the mesh with all faces in one panel of this name."""
        return replace(self, panel=np.zeros(len(self.faces), np.int32), panels=(name,), rectangles=())

    def check(self, name: str = "mesh") -> None:
        """Check shapes, finite values, index ranges and degenerate faces.

        Raises:
            FormatError: The mesh is invalid; the message is one line.
        """
        vertex_count, face_count = len(self.vertices), len(self.faces)
        shapes = {
            "vertices": (self.vertices, (vertex_count, 3)),
            "faces": (self.faces, (face_count, 3)),
            "normals": (self.normals, (face_count, 3, 3)),
            "texture coordinates": (self.uv, (face_count, 3, 2)),
            "materials of faces": (self.material, (face_count,)),
            "panels of faces": (self.panel, (face_count,)),
        }
        for label, (array, shape) in shapes.items():
            if array.shape != shape:
                raise FormatError(f"{name}: {label} have shape {array.shape}, expected {shape}")
            if not np.isfinite(array).all():
                raise FormatError(f"{name}: {label} hold NaN or infinity; mend the mesh")
        if not face_count:
            raise FormatError(f"{name}: the mesh has no faces")
        for label, indices, limit, lowest in (
            ("vertex", self.faces, vertex_count, 0),
            ("material", self.material, len(self.materials), 0),
            ("panel", self.panel, len(self.panels), -1),
        ):
            if indices.min() < lowest or indices.max() >= limit:
                raise FormatError(f"{name}: a {label} index is out of range (there are {limit})")
        if self.uv.min() < 0.0 or self.uv.max() > 1.0:
            raise FormatError(f"{name}: texture coordinates leave [0, 1]; unwrap the mesh into one atlas")
        if self.rectangles and len(self.rectangles) != len(self.panels):
            raise FormatError(f"{name}: {len(self.rectangles)} rectangles for {len(self.panels)} panels")
        empty_count = int((self.areas() < 1e-12).sum())
        # A few slivers are harmless; more than 2 % suggest a broken export.
        if empty_count > max(4, face_count // 50):
            raise FormatError(f"{name}: {empty_count} of {face_count} faces have no area; remove them")
        not_unit = np.abs(np.linalg.norm(self.normals.astype(np.float64), axis=-1) - 1.0) > 1e-3
        if not_unit.any():
            raise FormatError(f"{name}: {int(not_unit.sum())} normals are not of unit length")


def merge(meshes: Sequence[Mesh]) -> Mesh:
    """Merge meshes into one.

    Equal materials and panels of one name are shared; texture coordinates stay as they are.

    Raises:
        ConfigError: There is no mesh.
    """
    materials: dict[Material, int] = {}
    panels: dict[str, int] = {}
    rectangles: dict[str, Rectangle] = {}
    arrays: list[tuple[npt.NDArray[Any], ...]] = []
    vertex_offset = 0
    for mesh in meshes:
        to_material = np.array([materials.setdefault(entry, len(materials)) for entry in mesh.materials], np.int32)
        # The last entry is reached by panel index -1, so that "no panel" stays -1.
        to_panel = np.array([*(panels.setdefault(panel_name, len(panels)) for panel_name in mesh.panels), -1], np.int32)
        rectangles.update(zip(mesh.panels, mesh.rectangles, strict=False))
        faces = (mesh.faces + vertex_offset).astype(np.int32)
        arrays.append((mesh.vertices, faces, mesh.normals, mesh.uv, to_material[mesh.material], to_panel[mesh.panel]))
        vertex_offset += len(mesh.vertices)
    if not arrays:
        raise ConfigError("no meshes to merge")
    columns: list[npt.NDArray[Any]] = [np.concatenate(column) for column in zip(*arrays, strict=True)]
    vertices, triangles, normals, uv, material, panel = columns
    panel_rectangles = tuple(rectangles[panel_name] for panel_name in panels) if len(rectangles) == len(panels) else ()
    return Mesh(vertices, triangles, normals, uv, material, panel, tuple(materials), tuple(panels), panel_rectangles)


def part_of(mesh: Mesh, faces: npt.NDArray[np.bool_]) -> Mesh:
    """Return the mesh with only the chosen faces [F], in the same place and atlas."""
    return replace(
        mesh,
        faces=mesh.faces[faces],
        normals=mesh.normals[faces],
        uv=mesh.uv[faces],
        material=mesh.material[faces],
        panel=mesh.panel[faces],
    )


def corner_normals(vertices: npt.ArrayLike, faces: npt.ArrayLike, *, smooth: float = SMOOTH) -> F64:
    """Return unit normals for each corner [F, 3, 3].

    The normal is the area-weighted mean over the faces at the vertex that meet the corner's face at less than
    `smooth` rad; 0 gives flat shading.
    """
    points, triangles = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    area_vectors = cross(
        points[triangles[:, 1]] - points[triangles[:, 0]], points[triangles[:, 2]] - points[triangles[:, 0]]
    )
    face_normals = area_vectors / np.maximum(np.linalg.norm(area_vectors, axis=1, keepdims=True), 1e-30)
    if smooth <= 0.0:
        return np.repeat(face_normals[:, None], 3, axis=1)
    corner_vertices = triangles.ravel()
    corners_by_vertex = np.argsort(corner_vertices, kind="stable")
    counts = np.bincount(corner_vertices, minlength=len(points))
    starts = np.cumsum(counts) - counts
    corner_face_normals = np.repeat(face_normals, 3, axis=0)
    normal_sums = np.zeros_like(corner_face_normals)
    max_count = int(counts.max(initial=0))
    # Add the neighbouring faces of each corner in chunks [K, corners]; the order of a sum decides its bits.
    for first_slot in range(0, max_count, AT_ONCE):
        corner_indices = np.flatnonzero(counts[corner_vertices] > first_slot)
        vertex_indices = corner_vertices[corner_indices]
        slots = np.arange(first_slot, min(first_slot + AT_ONCE, max_count))[:, None]
        is_valid = slots < counts[vertex_indices]
        neighbour_faces = corners_by_vertex[np.where(is_valid, starts[vertex_indices] + slots, 0)] // 3
        is_smooth = is_valid & (
            np.einsum("ci,kci->kc", corner_face_normals[corner_indices], face_normals[neighbour_faces])
            >= np.cos(smooth)
        )
        terms = np.where(is_smooth[..., None], area_vectors[neighbour_faces], 0.0)
        normal_sums[corner_indices] = np.add.reduce(np.concatenate([normal_sums[corner_indices][None], terms]), axis=0)
    lengths = np.linalg.norm(normal_sums, axis=1, keepdims=True)
    corner_normal = np.where(lengths > 1e-20, normal_sums / np.maximum(lengths, 1e-30), corner_face_normals)
    # Faces without area have no direction: give them a unit normal all the same.
    corner_normal[np.linalg.norm(corner_normal, axis=1) < 0.5] = 0.0, 0.0, 1.0
    return corner_normal.reshape(-1, 3, 3)


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
    points, triangles = np.asarray(vertices, np.float64).reshape(-1, 3), np.asarray(faces, np.int32).reshape(-1, 3)
    material_table = (materials,) if isinstance(materials, Material) else tuple(materials)
    has_area = (
        np.linalg.norm(
            cross(points[triangles[:, 1]] - points[triangles[:, 0]], points[triangles[:, 2]] - points[triangles[:, 0]]),
            axis=1,
        )
        > 2.0 * MIN_AREA
    )
    material_index = np.broadcast_to(np.asarray(material, np.int32), len(triangles))[has_area]
    panel_names = (panel,) if isinstance(panel, str) else tuple(panels)
    panel_index = np.asarray(0 if isinstance(panel, str) else -1 if panel is None else panel, np.int32)
    panel_index = np.array(np.broadcast_to(panel_index, len(triangles))[has_area])
    half_square = np.broadcast_to(np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0]]), (len(triangles), 3, 2))
    texture_coordinates = (half_square if uv is None else np.asarray(uv, np.float64).reshape(-1, 3, 2))[has_area]
    triangles = triangles[has_area]
    # The sum of scalar triple products is six times the signed volume.
    if (
        outward
        and np.einsum("fi,fi->", points[triangles[:, 0]], cross(points[triangles[:, 1]], points[triangles[:, 2]])) < 0.0
    ):
        triangles, texture_coordinates = triangles[:, ::-1], texture_coordinates[:, ::-1]
    return Mesh(
        points.astype(np.float32),
        np.ascontiguousarray(triangles, dtype=np.int32),
        corner_normals(points, triangles, smooth=smooth).astype(np.float32),
        np.ascontiguousarray(texture_coordinates, dtype=np.float32),
        np.array(material_index, np.int32),
        panel_index,
        material_table,
        panel_names,
    )


def weld(vertices: npt.ArrayLike, faces: npt.ArrayLike, *, tolerance: float = 1e-5) -> tuple[F64, I32]:
    """Vertices with those nearer than about `tolerance` made one, and faces that point at them."""
    points = np.asarray(vertices, np.float64)
    _, first_index, inverse = np.unique(
        # Rounding to a grid is fast, but close points on two sides of a cell border stay apart.
        np.round(points / tolerance).astype(np.int64),
        axis=0,
        return_index=True,
        return_inverse=True,
    )
    return points[first_index], np.asarray(inverse).reshape(-1)[np.asarray(faces)].astype(np.int32)


def grid_faces(rows: int, columns: int, *, wrap: bool = False) -> I32:
    """Return the faces of a [rows, columns] grid of points, two for each cell, row by row.

    `wrap` joins the last column to the first.
    """
    cell_columns = columns if wrap else columns - 1
    row, column = np.meshgrid(np.arange(rows - 1), np.arange(cell_columns), indexing="ij")
    next_column = (column + 1) % columns
    upper_left, upper_right, lower_right, lower_left = (
        row * columns + column,
        row * columns + next_column,
        (row + 1) * columns + next_column,
        (row + 1) * columns + column,
    )
    return (
        np.stack(
            [np.stack([upper_left, upper_right, lower_right], -1), np.stack([upper_left, lower_right, lower_left], -1)],
            axis=2,
        )
        .reshape(-1, 3)
        .astype(np.int32)
    )


def triangulate(outline: npt.ArrayLike) -> I32:
    """Triangulate a simple polygon [P, 2] by ear clipping.

    Returns:
        Counter-clockwise faces [P - 2, 3].

    Raises:
        ConfigError: The polygon crosses itself.
    """
    points = np.asarray(outline, np.float64)
    next_points = np.roll(points, -1, axis=0)
    area = 0.5 * float(np.sum(points[:, 0] * next_points[:, 1] - next_points[:, 0] * points[:, 1]))
    remaining = list(range(len(points))) if area > 0 else list(range(len(points)))[::-1]
    faces: list[tuple[int, int, int]] = []

    def signed_area(a: int, b: int, c: int) -> float:
        return float(
            (points[b, 0] - points[a, 0]) * (points[c, 1] - points[a, 1])
            - (points[b, 1] - points[a, 1]) * (points[c, 0] - points[a, 0])
        )

    tolerance = 1e-12 * max(1.0, abs(area))
    while len(remaining) > 3:
        remaining_points = points[remaining]
        for index in range(len(remaining)):
            before, tip, after = remaining[index - 1], remaining[index], remaining[(index + 1) % len(remaining)]
            if signed_area(before, tip, after) < -tolerance:
                continue
            ear = points[[before, tip, after]]
            edges = np.roll(ear, -1, axis=0) - ear
            offsets = remaining_points[:, None] - ear
            is_inside = (edges[:, 0] * offsets[..., 1] - edges[:, 1] * offsets[..., 0] >= -tolerance).all(axis=1)
            # A point that coincides with a corner of the ear does not block it.
            if (is_inside & (offsets != 0.0).any(axis=2).all(axis=1)).any():
                continue
            faces.append((before, tip, after))
            del remaining[index]
            break
        else:
            raise ConfigError("a polygon crosses itself; split it")
    faces.append((remaining[0], remaining[1], remaining[2]))
    return np.array(faces, np.int32)


# ---------------------------------------------------------------- solids


def box(size: Point, *, material: Material, centre: Point = (0.0, 0.0, 0.0), panel: str | None = None) -> Mesh:
    """Return a box of a size (x, y, z) about its centre.

    Each side shows the whole texture, upright seen from outside.
    """
    sides = [(0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0), (2, 1.0), (2, -1.0)]
    points: list[F64] = []
    for axis, sign in sides:
        normal = np.zeros(3)
        normal[axis] = sign
        up = np.array([0.0, 0.0, 1.0]) if axis < 2 else np.array([1.0, 0.0, 0.0])
        right = cross(up, normal)
        points += [normal - right - up, normal + right - up, normal + right + up, normal - right + up]
    vertices = 0.5 * np.array(points) * np.asarray(size) + np.asarray(centre)
    faces = np.concatenate([np.array([[0, 1, 2], [0, 2, 3]]) + 4 * side for side in range(6)])
    square = np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]])
    return build(
        vertices, faces, materials=material, uv=np.tile(square[[[0, 1, 2], [0, 2, 3]]], (6, 1, 1)), panel=panel
    )


def prism(
    outline: npt.ArrayLike, depth: tuple[float, float], *, material: Material, axis: int = 2, smooth: float = SMOOTH
) -> Mesh:
    """Extrude a simple polygon [P, 2] along an axis from depth[0] to depth[1] into a closed solid.

    The outline lies in (x, y) for axis 2, (y, z) for axis 0 and (x, z) for axis 1.
    """
    points = np.asarray(outline, np.float64)
    caps = triangulate(points)
    count = len(points)
    lower, upper = (np.insert(points, axis, d, axis=1) for d in depth)
    ring = np.arange(count)
    next_point = (ring + 1) % count
    side_faces = np.concatenate(
        [np.stack([ring, next_point, next_point + count], 1), np.stack([ring, next_point + count, ring + count], 1)]
    )
    extent = np.maximum(np.ptp(points, axis=0), 1e-9)
    cap_uv = (points - points.min(axis=0)) / extent
    cap_uv[:, 1] = 1.0 - cap_uv[:, 1]
    arc_length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1))])
    arc_length /= arc_length[-1]
    a, b, c, d = (
        np.stack([u, np.full(count, w)], 1)
        for u, w in ((arc_length[:-1], 1), (arc_length[1:], 1), (arc_length[1:], 0), (arc_length[:-1], 0))
    )
    uv_side = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    clockwise = np.sum(points[:, 0] * np.roll(points[:, 1], -1) - np.roll(points[:, 0], -1) * points[:, 1]) < 0
    if clockwise:
        side_faces, uv_side = side_faces[:, ::-1], uv_side[:, ::-1]
    faces = np.concatenate([side_faces, caps[:, ::-1], caps + count])
    uv = np.concatenate([uv_side, cap_uv[caps[:, ::-1]], cap_uv[caps]])
    return build(np.concatenate([lower, upper]), faces, materials=material, uv=uv, smooth=smooth, outward=True)


def loft(sections: npt.ArrayLike, *, material: Material, closed: bool = True, smooth: float = SMOOTH) -> Mesh:
    """Build a surface through cross sections [S, P, 3].

    `closed` joins the last point of a section to its first and fills both ends (convex sections).
    """
    points = np.asarray(sections, np.float64)
    faces, uv = _loft_faces(*points.shape[:2], closed)
    return build(points.reshape(-1, 3), faces, materials=material, uv=uv, smooth=smooth, outward=closed)


@lru_cache(256)
def _loft_faces(rows: int, columns: int, closed: bool) -> tuple[I32, F64]:
    """Return read-only faces [F, 3] and texture coordinates [F, 3, 2] of `loft`."""
    faces = grid_faces(rows, columns, wrap=closed)
    section_share = np.linspace(0.0, 1.0, columns + int(closed))
    path_share = np.linspace(0.0, 1.0, rows)
    cell_columns = section_share.size - 1
    row, column = (
        indices.reshape(-1) for indices in np.meshgrid(np.arange(rows - 1), np.arange(cell_columns), indexing="ij")
    )

    def grid_uv(i: npt.NDArray[Any], j: npt.NDArray[Any]) -> F64:
        return np.stack([section_share[j], path_share[i]], -1)

    cell_corners = [
        grid_uv(row, column),
        grid_uv(row, column + 1),
        grid_uv(row + 1, column + 1),
        grid_uv(row + 1, column),
    ]
    uv = np.stack(
        [np.stack([cell_corners[indices] for indices in corner_triple], 1) for corner_triple in ((0, 1, 2), (0, 2, 3))],
        1,
    ).reshape(-1, 3, 2)
    if closed:
        cap_faces = np.stack([np.zeros(columns - 2), np.arange(1, columns - 1), np.arange(2, columns)], 1).astype(
            np.int32
        )
        end_cap = cap_faces + (rows - 1) * columns
        cap_uv = 0.5 + 0.5 * np.stack(
            [np.cos(2 * np.pi * section_share[:-1]), np.sin(2 * np.pi * section_share[:-1])], -1
        )
        faces = np.concatenate([faces, cap_faces[:, ::-1], end_cap])
        uv = np.concatenate([uv, cap_uv[cap_faces[:, ::-1]], cap_uv[cap_faces]])
    # Cached arrays are shared by many bodies.
    faces.flags.writeable = uv.flags.writeable = False
    return faces, uv


def lathe(
    profile: npt.ArrayLike, *, material: Material, segments: int = 16, axis: int = 2, smooth: float = SMOOTH
) -> Mesh:
    """Rotate a profile [P, 2] of (radius, position along the axis) about an axis through the origin.

    The ends are closed.
    """
    points = np.asarray(profile, np.float64)
    angles = np.arange(segments) * (2.0 * np.pi / segments)
    first_axis, second_axis = [(1, 2), (2, 0), (0, 1)][axis]
    sections = np.zeros((len(points), segments, 3))
    sections[..., first_axis] = points[:, :1] * np.cos(angles)
    sections[..., second_axis] = points[:, :1] * np.sin(angles)
    sections[..., axis] = points[:, 1:]
    return loft(sections, material=material, smooth=smooth)


def sphere(radius: float | Point, *, material: Material, centre: Point = (0.0, 0.0, 0.0), segments: int = 12) -> Mesh:
    """Return an ellipsoid with half axes `radius` about its centre.

    `segments` counts faces around; half as many lie between the poles.
    """
    rings = max(3, segments // 2)
    latitudes = np.linspace(-np.pi / 2, np.pi / 2, rings + 1)
    unit_sphere = lathe(
        np.stack([np.cos(latitudes), np.sin(latitudes)], 1), material=material, segments=segments, smooth=1.5
    )
    matrix = np.diag([*np.broadcast_to(np.asarray(radius, np.float64), 3), 1.0])
    matrix[:3, 3] = centre
    return unit_sphere.transformed(matrix)


def ring(radius: float, thickness: float, *, material: Material, segments: int = 20, around: int = 6) -> Mesh:
    """A torus about the y axis: `radius` to its outer edge, `thickness` across."""
    angles = np.linspace(0.0, 2.0 * np.pi, segments + 1)
    tube_angles = np.arange(around) * (2.0 * np.pi / around)
    radii = radius - 0.5 * thickness + 0.5 * thickness * np.cos(tube_angles)
    y = 0.5 * thickness * np.sin(tube_angles)
    points = np.stack(
        [radii * np.sin(angles)[:, None], np.broadcast_to(y, (len(angles), around)), radii * np.cos(angles)[:, None]],
        -1,
    )
    faces = grid_faces(len(angles), around, wrap=True)
    return build(*weld(points.reshape(-1, 3), faces), materials=material, smooth=1.2, outward=True)


def tube(path: npt.ArrayLike, radius: npt.ArrayLike, *, material: Material, segments: int = 8) -> Mesh:
    """Return a round bar along a path [S, 3], with one radius or one for each point."""
    points = np.asarray(path, np.float64)
    radii = np.broadcast_to(np.asarray(radius, np.float64), len(points))
    tangents = np.gradient(points, axis=0)
    tangents /= np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-12)
    # The axis that the path follows least is never parallel to it on the whole.
    reference_axis = np.eye(3)[int(np.argmin(np.abs(tangents).sum(axis=0)))]
    side_axes = cross(tangents, reference_axis)
    side_axes /= np.maximum(np.linalg.norm(side_axes, axis=1, keepdims=True), 1e-12)
    up_axes = cross(tangents, side_axes)
    angles = np.arange(segments) * (2.0 * np.pi / segments)
    circles = np.cos(angles)[None, :, None] * side_axes[:, None] + np.sin(angles)[None, :, None] * up_axes[:, None]
    return loft(points[:, None] + radii[:, None, None] * circles, material=material)
