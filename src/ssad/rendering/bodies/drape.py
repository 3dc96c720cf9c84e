"""Flat pieces draped over a surface that is seen along an axis: lenses, plates, gaps, shapes behind a pane."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from ssad.core.geometry import cross
from ssad.rendering.meshes.mesh import F64, Material, Mesh, build

Outline = Sequence[tuple[float, float]]
"""Convex polygon, m: its points across (y ahead and behind, x at the sides) and up."""
Piece = tuple[Sequence[Outline], Material, float]
"""Outlines, their material, and their lift above the surface, m."""
FLAT = 0.002  # m: a cell whose fourth corner lies nearer to the plane of the others is one face
MIN_PIECE = 2e-6  # m^2: smaller pieces are left out
NEEDLE = 1e-4  # m: triangles with a shorter edge are left out
BEHIND = 0.02  # m behind the nearest face from which a face is hidden
STEEPEST = 0.05  # cosine between the axis and the normal of a face from which a face counts as seen
_VIEWS = {"front": (0, 1.0), "rear": (0, -1.0), "left": (1, 1.0), "right": (1, -1.0)}


@dataclass(frozen=True, slots=True)
class Surface:
    """Faces of a mesh that are seen along an axis: from the front, the rear, the left or the right.

    Two triangles of one flat cell count as one face.

    Attributes:
        mesh: The mesh.
        view: front, rear, left or right.
        corners: Corners of a triangle in the plane of each face [F, 3, 3], m.
        normals: Unit normals at these corners [F, 3, 3].
        cells: Corners of each face in the view [F, 4, 2], m; a triangle repeats its last.
    """

    mesh: Mesh
    view: str
    corners: F64 = field(init=False)
    normals: F64 = field(init=False)
    cells: F64 = field(init=False)

    def __post_init__(self) -> None:
        axis, sign = _VIEWS[self.view]
        corners = self.mesh.corners()
        directions = cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
        is_visible = sign * directions[:, axis] > STEEPEST
        corners, directions, faces = corners[is_visible], directions[is_visible], self.mesh.faces[is_visible]
        cells = corners[:, [0, 1, 2, 2]].copy()
        # Builders put both triangles of a cell, (a, b, c) and (a, c, d), one after the other.
        is_pair = np.zeros(len(faces), bool)
        if len(faces) > 1:
            fourth = corners[1:, 2]
            height = np.abs(np.einsum("fi,fi->f", fourth - corners[:-1, 0], directions[:-1]))
            is_pair[:-1] = (faces[1:, 0] == faces[:-1, 0]) & (faces[1:, 1] == faces[:-1, 2]) & (height < FLAT)
            is_pair[1:] &= ~is_pair[:-1]  # each triangle belongs to one cell
            cells[:-1, 3] = np.where(is_pair[:-1, None], fourth, cells[:-1, 3])
        is_kept = ~np.concatenate([[False], is_pair[:-1]])
        object.__setattr__(self, "corners", corners[is_kept])
        object.__setattr__(self, "normals", self.mesh.normals[is_visible][is_kept].astype(np.float64))
        object.__setattr__(self, "cells", cells[is_kept][..., [1 - axis, 2]])

    def drape(self, pieces: Sequence[Piece]) -> Mesh | None:
        """Drape convex polygons over the surface, each at its lift above it, with the normals of the surface.

        Each polygon is cut at the edges of the faces below it, so that no edge of the surface shows through. What
        lies beside the surface is left out.

        Args:
            pieces: Outlines with their material and their lift.

        Returns:
            The polygons as one mesh; None if nothing lies on the surface.
        """
        axis, sign = _VIEWS[self.view]
        plane = [1 - axis, 2]
        flat = self.corners[:, :, plane]
        outlines = [outline for outlines, _, _ in pieces for outline in outlines]
        if not outlines or not len(flat):
            return None
        owner = np.repeat(np.arange(len(pieces)), [len(outlines) for outlines, _, _ in pieces])
        polygons, counts = _padded(outlines)
        low, high = polygons.min(axis=1), polygons.max(axis=1)
        overlaps = (self.cells.min(axis=1) < high[:, None]) & (self.cells.max(axis=1) > low[:, None])
        polygon_index, face_index = np.nonzero(overlaps.all(axis=-1))
        if not len(face_index):
            return None
        points, counts = _clip(polygons[polygon_index], counts[polygon_index], self.cells[face_index])
        is_area = _areas(points, counts) > MIN_PIECE
        points, counts = points[is_area], counts[is_area]
        owner, face_index = owner[polygon_index][is_area], face_index[is_area]
        shares = _barycentric(points, flat[face_index])
        positions = np.einsum("nkc,ncd->nkd", shares, self.corners[face_index])
        # Of faces behind one another only the one that is nearest at the middle of the piece is covered.
        middle = points.mean(axis=1)
        middle_shares = _barycentric(np.broadcast_to(middle, (len(flat), len(middle), 2)), flat)
        depths = sign * np.einsum("fnc,fc->fn", middle_shares, self.corners[:, :, axis])
        edges = np.roll(self.cells, -1, axis=1) - self.cells
        beside = _cross_2d(edges[:, None], middle[None, :, None] - self.cells[:, None]) * self._turns()[:, None, None]
        nearest = np.where(beside.min(axis=-1) > -1e-9, depths, -np.inf).max(axis=0, initial=-np.inf)
        is_nearest = sign * positions[..., axis].mean(axis=1) > nearest - BEHIND
        if not is_nearest.any():
            return None
        positions, counts, shares = positions[is_nearest], counts[is_nearest], shares[is_nearest]
        owner, face_index = owner[is_nearest], face_index[is_nearest]
        normals = np.einsum("nkc,ncd->nkd", shares, self.normals[face_index])
        normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
        lifts = np.array([lift for _, _, lift in pieces])
        positions = positions + lifts[owner, None, None] * normals
        width = positions.shape[1]
        fans = np.array([(0, corner, corner + 1) for corner in range(1, width - 1)])
        faces = np.arange(len(positions))[:, None, None] * width + fans
        is_face = fans[:, 2] < counts[:, None]
        materials = list(dict.fromkeys(material for _, material, _ in pieces))
        numbers = np.array([materials.index(material) for _, material, _ in pieces])
        material = np.broadcast_to(numbers[owner][:, None], is_face.shape)[is_face]
        faces = faces[is_face]
        vertices, vertex_normals = positions.reshape(-1, 3), normals.reshape(-1, 3)
        # Cuts near a corner leave needles, which readers of mesh files weld away.
        edge_lengths = np.linalg.norm(vertices[faces] - vertices[np.roll(faces, -1, axis=1)], axis=-1)
        is_needle = edge_lengths.min(axis=1) < NEEDLE
        faces, material = faces[~is_needle], material[~is_needle]
        directions = cross(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])
        is_turned = sign * directions[:, axis] < 0.0
        faces[is_turned] = faces[is_turned][:, ::-1]
        mesh = build(vertices, faces, materials=materials, material=material, smooth=0.0)
        return replace(mesh, normals=vertex_normals[mesh.faces].astype(np.float32))

    def _turns(self) -> F64:
        """Return 1 for faces that are counter-clockwise in the view, else -1 [F]."""
        return _turns(self.cells)


def _turns(cells: F64) -> F64:
    return np.sign(_cross_2d(cells[:, 1] - cells[:, 0], cells[:, 2] - cells[:, 0]))


def _padded(outlines: Sequence[Outline]) -> tuple[F64, npt.NDArray[np.int64]]:
    """Polygons [N, K, 2] whose last point is repeated up to the largest count, and their counts [N]."""
    counts = np.array([len(outline) for outline in outlines])
    longest = int(counts.max())
    return np.array([[*outline, *[outline[-1]] * (longest - len(outline))] for outline in outlines], np.float64), counts


def _barycentric(points: F64, faces: F64) -> F64:
    """Barycentric coordinates [N, K, 3] of points [N, K, 2] in faces [N, 3, 2]."""
    first, second, third = (faces[:, None, corner] for corner in range(3))
    area = _cross_2d(second - first, third - first)
    second_share = _cross_2d(points - first, third - first) / area
    third_share = _cross_2d(second - first, points - first) / area
    return np.stack([1.0 - second_share - third_share, second_share, third_share], axis=-1)


def _clip(polygons: F64, counts: npt.NDArray[np.int64], cells: F64) -> tuple[F64, npt.NDArray[np.int64]]:
    """Cut polygons [N, K, 2] with convex cells [N, 4, 2] (Sutherland and Hodgman); the last point repeats as padding.

    Returns:
        The parts inside [N, K', 2] and their numbers of points [N].
    """
    turn = _turns(cells)
    points = polygons
    for corner in range(4):
        start, edge = cells[:, corner, None], (cells[:, (corner + 1) % 4] - cells[:, corner])[:, None]
        distance = turn[:, None] * _cross_2d(edge, points - start)
        slots = np.arange(points.shape[1])
        following = np.where(slots + 1 < counts[:, None], slots + 1, 0)
        next_points = np.take_along_axis(points, following[..., None], axis=1)
        next_distance = np.take_along_axis(distance, following, axis=1)
        is_real = slots < counts[:, None]
        is_inside = distance >= 0.0
        crosses = is_real & (is_inside != (next_distance >= 0.0))
        share = np.where(crosses, distance / np.where(crosses, distance - next_distance, 1.0), 0.0)
        cut = points + share[..., None] * (next_points - points)
        # Two slots for each point: itself if it is inside, then the crossing of the edge that begins there.
        candidates = np.stack([points, cut], axis=2).reshape(len(points), -1, 2)
        is_valid = np.stack([is_inside & is_real, crosses], axis=2).reshape(len(points), -1)
        order = np.argsort(~is_valid, axis=1, kind="stable")
        counts = is_valid.sum(axis=1)
        width = max(int(counts.max(initial=0)), 1)
        candidates = np.take_along_axis(candidates, order[..., None], axis=1)[:, :width]
        last = np.take_along_axis(candidates, np.maximum(counts - 1, 0)[:, None, None], axis=1)
        points = np.where((np.arange(width) < counts[:, None])[..., None], candidates, last)
    return points, counts


def _areas(points: F64, counts: npt.NDArray[np.int64]) -> F64:
    """Area of convex polygons [N, K, 2], m^2; 0 with fewer than three points."""
    following = np.roll(points, -1, axis=1)
    return np.where(counts > 2, 0.5 * np.abs(_cross_2d(points, following).sum(axis=1)), 0.0)


def _cross_2d(first: F64, second: F64) -> F64:
    return np.asarray(first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0])


def rectangle(low: tuple[float, float], high: tuple[float, float]) -> list[Outline]:
    """Return a rectangle between two corners (across, up)."""
    return trapezoid(low, high, (low[0], high[0]))


def trapezoid(low: tuple[float, float], high: tuple[float, float], top: tuple[float, float]) -> list[Outline]:
    """Return a trapezoid: `low` and `high` bound its base and its heights, `top` its upper edge."""
    return [[(low[0], low[1]), (high[0], low[1]), (top[1], high[1]), (top[0], high[1])]]


def ellipse(middle: tuple[float, float], half: tuple[float, float], corners: int) -> Outline:
    """Return an ellipse as a polygon about its middle (across, up)."""
    angles = (np.arange(corners) + 0.5) * (2.0 * np.pi / corners)
    return [
        (middle[0] + half[0] * float(np.cos(angle)), middle[1] + half[1] * float(np.sin(angle))) for angle in angles
    ]


def mirrored(outlines: Sequence[Outline]) -> list[Outline]:
    """Return the outlines and their mirror images on the other side of the vehicle (views ahead and behind)."""
    return [*outlines, *([(-across, up) for across, up in outline] for outline in outlines)]


def patches(surface: Surface, pieces: Sequence[Piece]) -> list[Mesh]:
    """Return the mesh of the pieces on a surface, or none where nothing lies on it."""
    mesh = surface.drape(pieces)
    return [] if mesh is None else [mesh]
