"""Shared parts of all bodies: materials, the texture atlas, wheels, and the fit of a mesh to its size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from ssad.core.geometry import cross
from ssad.rendering.meshes.mesh import (
    F64,
    SMOOTH,
    Material,
    Mesh,
    Point,
    Rectangle,
    box,
    build,
    grid_faces,
    lathe,
    merge,
    tube,
)

PAINT = Material("paint", (0.45, 0.45, 0.46), specular=0.06, gloss=0.85, paint=True)
CARGO = Material("cargo", (0.72, 0.72, 0.70), specular=0.04, gloss=0.4)
GLASS = Material("glass", (0.022, 0.027, 0.031), specular=0.09, gloss=0.96)
TRIM = Material("trim", (0.018, 0.018, 0.019), specular=0.04, gloss=0.35)
DARK = Material("underside", (0.008, 0.008, 0.008), specular=0.0, gloss=0.0)
SEAM = Material("seam", (0.012, 0.012, 0.012), specular=0.0, gloss=0.0)
RUBBER = Material("tyre", (0.016, 0.016, 0.016), specular=0.03, gloss=0.15)
RIM = Material("rim", (0.42, 0.43, 0.44), specular=0.35, gloss=0.7)
CHROME = Material("chrome", (0.55, 0.55, 0.56), specular=0.5, gloss=0.85)
STEEL = Material("steel", (0.30, 0.31, 0.32), specular=0.2, gloss=0.5)
FRAME = Material("frame", (0.05, 0.05, 0.055), specular=0.05, gloss=0.3)
HEAD = Material("head_lamp", (0.75, 0.77, 0.80), specular=0.12, gloss=0.95, emission=0.25)
HOUSING = Material("lamp_housing", (0.045, 0.046, 0.050), specular=0.12, gloss=0.95)
TAIL = Material("tail_lamp", (0.30, 0.010, 0.011), specular=0.09, gloss=0.9, emission=0.12)
BLINKER = Material("indicator", (0.75, 0.26, 0.02), specular=0.09, gloss=0.9)
PLATE = Material("plate", (0.80, 0.80, 0.78), specular=0.04, gloss=0.5)
SOIL = Material("soil", (0.10, 0.065, 0.04), specular=0.0, gloss=0.0)
WOOD = Material("wood", (0.28, 0.17, 0.09), specular=0.02, gloss=0.1)

_AXES: dict[str, tuple[Point, Point]] = {
    # direction of u (right) and of v (down) when the panel is seen from outside
    "left": ((-1.0, 0.0, 0.0), (0.0, 0.0, -1.0)),
    "right": ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0)),
    "front": ((0.0, 1.0, 0.0), (0.0, 0.0, -1.0)),
    "rear": ((0.0, -1.0, 0.0), (0.0, 0.0, -1.0)),
    "top": ((0.0, -1.0, 0.0), (-1.0, 0.0, 0.0)),
    "hood": ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0)),
}
MARGIN = 0.008  # of the atlas, on each side of a panel


@dataclass(frozen=True, slots=True)
class Chart:
    """Panel of the atlas: a parallel projection of the geometry between `low` and `high` (m, object frame).

    `view` is the direction of the projection: left, right, front, rear, top (read from behind) or hood (read
    from the front). A chart `left_side/front_door` is part of the chart `left_side` and shares its place.
    """

    name: str
    view: str
    low: Point
    high: Point

    def flat(self, points: npt.ArrayLike) -> F64:
        """Project points [..., 3] to metres [..., 2] right and down from the upper left corner."""
        right_axis, down_axis = (np.array(axis) for axis in _AXES[self.view])
        positions = np.asarray(points, np.float64)
        corners = np.array([self.low, self.high])
        origin = np.array([(corners @ right_axis).min(), (corners @ down_axis).min()])
        return np.asarray(np.stack([positions @ right_axis, positions @ down_axis], axis=-1) - origin)

    def extent(self) -> tuple[float, float]:
        """Return the width and height of the chart, m."""
        lower_right = self.flat(np.array([self.low, self.high])).max(axis=0)
        return float(lower_right[0]), float(lower_right[1])


def pack(charts: Sequence[Chart]) -> dict[str, tuple[float, float, float]]:
    """Place each whole chart in the atlas.

    Shelves of falling height, with one common scale found by bisection: the area of every panel in the atlas
    is proportional to its area in m^2.

    Returns:
        u, v of the upper left corner and uv units per metre, by name.
    """
    whole_charts = sorted(
        (entry for entry in charts if "/" not in entry.name), key=lambda entry: (-entry.extent()[1], entry.name)
    )
    sizes = [(chart.name, *chart.extent()) for chart in whole_charts]
    placement: dict[str, tuple[float, float, float]] = {}
    lower, upper = 0.0, 10.0
    # 30 halvings of [0, 10] resolve the scale to 1e-8.
    for _ in range(30):
        scale = 0.5 * (lower + upper)
        candidate = _shelves(sizes, scale)
        if candidate is None:
            upper = scale
        else:
            lower, placement = scale, candidate
    return placement


def _shelves(charts: Sequence[tuple[str, float, float]], scale: float) -> dict[str, tuple[float, float, float]] | None:
    """Place charts (name, width and height in m) on the first shelf with room; None where they do not fit."""
    shelves: list[list[float]] = []  # top, height, used width
    placement: dict[str, tuple[float, float, float]] = {}
    next_top = 0.0
    for name, *lengths in charts:
        width, height = (side * scale + 2.0 * MARGIN for side in lengths)
        shelf = next(
            (candidate for candidate in shelves if candidate[2] + width <= 1.0 and height <= candidate[1] + 1e-12), None
        )
        if shelf is None:
            if next_top + height > 1.0 or width > 1.0:
                return None
            shelf = [next_top, height, 0.0]
            shelves.append(shelf)
            next_top += height
        placement[name] = (shelf[2] + MARGIN, shelf[0] + MARGIN, scale)
        shelf[2] += width
    return placement


def unwrap(mesh: Mesh, charts: Sequence[Chart]) -> Mesh:
    """Return the mesh with texture coordinates by the charts.

    The panels of the result are the charts that are whole or parts of others.
    """
    places = pack(charts)
    by_name = {chart.name: chart for chart in charts}
    # A chart with parts is covered by them and needs no panel of its own.
    panel_names = tuple(
        entry.name for entry in charts if not any(other.name.startswith(f"{entry.name}/") for other in charts)
    )
    corners = mesh.corners()
    uv = mesh.uv.astype(np.float64).copy()
    panel = np.full(len(mesh.faces), -1, np.int32)
    rectangles: list[Rectangle] = []
    for index, name in enumerate(panel_names):
        whole_chart = by_name[name.split("/")[0]]
        left, top, scale = places[whole_chart.name]
        corner = np.array([left, top])
        part_chart = by_name[name]
        corners_uv = whole_chart.flat(np.array([part_chart.low, part_chart.high])) * scale + corner
        lower, upper = corners_uv.min(axis=0), corners_uv.max(axis=0)
        rectangles.append((float(lower[0]), float(lower[1]), float(upper[0]), float(upper[1])))
        if name in mesh.panels:
            faces = mesh.panel == mesh.panels.index(name)
            uv[faces] = (
                np.clip(whole_chart.flat(corners[faces]) * scale, 0.0, np.array(whole_chart.extent()) * scale) + corner
            )
            panel[faces] = index
    return replace(mesh, uv=uv.astype(np.float32), panel=panel, panels=panel_names, rectangles=tuple(rectangles))


def fit(mesh: Mesh, size: Point) -> Mesh:
    """Return the mesh scaled to fill length, width and height exactly, its base centred on the origin."""
    lower, upper = mesh.bounds()
    # Labels are 3D boxes: the mesh must touch all six sides.
    scale = np.asarray(size) / np.maximum(upper - lower, 1e-9)
    matrix = np.diag([*scale, 1.0])
    matrix[:3, 3] = -scale * np.array([0.5 * (lower[0] + upper[0]), 0.5 * (lower[1] + upper[1]), lower[2]])
    return mesh.transformed(matrix)


def as_point(value: npt.ArrayLike) -> Point:
    """Convert three numbers to a point."""
    x, y, z = np.asarray(value, np.float64).tolist()
    return x, y, z


def finish(parts: Sequence[Mesh], charts: Sequence[Chart], size: Point) -> Mesh:
    """Merge the parts of a body, fit the result to its size (m) and unwrap it."""
    return unwrap(fit(merge(parts), size), charts)


def mirror(mesh: Mesh) -> Mesh:
    """Mirror the mesh at the plane y = 0; panels `left…` and `right…` swap names."""
    opposite = {"left": "right", "right": "left"}
    panels = tuple(
        next((opposite[prefix] + panel[len(prefix) :] for prefix in opposite if panel.startswith(prefix)), panel)
        for panel in mesh.panels
    )
    return replace(mesh.transformed(np.diag([1.0, -1.0, 1.0, 1.0])), panels=panels)


def both_sides(mesh: Mesh) -> Mesh:
    """Merge the mesh with its mirror image."""
    return merge([mesh, mirror(mesh)])


def crate(low: Point, high: Point, material: Material, panels: Mapping[str, str] | None = None) -> Mesh:
    """Return a box between two corners; `panels` names the panel of some sides (front, rear, left, right, top)."""
    lower, upper = np.asarray(low, np.float64), np.asarray(high, np.float64)
    mesh = box(as_point(upper - lower), material=material, centre=as_point(0.5 * (lower + upper)))
    if not panels:
        return mesh
    panel_names = tuple(panels.values())
    sides = ("front", "rear", "left", "right", "top", "bottom")
    panel_indices = [panel_names.index(panels[side]) if side in panels else -1 for side in sides for _ in range(2)]
    material_index = [
        int(material.paint and panel_index < 0) for panel_index in panel_indices
    ]  # paint lies in panels only
    return replace(
        mesh,
        panel=np.array(panel_indices, np.int32),
        panels=panel_names,
        material=np.array(material_index, np.int32),
        materials=(material, DARK),
    )


def crates(low: Point, high: Point, material: Material) -> Mesh:
    """Return a box between two corners, and its mirror image on the other side of the vehicle."""
    return both_sides(crate(low, high, material))


def tubes(path: npt.ArrayLike, radius: npt.ArrayLike, material: Material, segments: int) -> Mesh:
    """Return a round bar along a path [S, 3], and its mirror image on the other side of the vehicle."""
    return both_sides(tube(path, radius, material=material, segments=segments))


SIDES = ("front", "rear", "left", "right", "top")


def assign_side_panels(mesh: Mesh, prefix: str) -> Mesh:
    """Assign faces to the panels `prefix_front`, `_rear`, `_left`, `_right` and `_top` by their direction."""
    corners = mesh.corners()
    normals = cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    panel = np.where(normals[:, 1] >= 0.0, 2, 3)
    panel = np.where(np.abs(normals[:, 1]) < 1e-3, np.where(corners[..., 1].mean(axis=1) >= 0.0, 2, 3), panel)
    panel = np.where(normals[:, 2] > 0.8, 4, panel)
    panel = np.where(np.abs(normals[:, 0]) > 0.75, np.where(normals[:, 0] > 0.0, 0, 1), panel)
    return replace(mesh, panel=panel.astype(np.int32), panels=tuple(f"{prefix}_{side}" for side in SIDES))


def side_charts(prefix: str, low: Point, high: Point) -> list[Chart]:
    """The charts that belong to the panels of `assign_side_panels` and `crate`: five sides of a box."""
    return [Chart(f"{prefix}_{side}", side, low, high) for side in SIDES]


def shift_chart(chart: Chart, x: float = 0.0, z: float = 0.0) -> Chart:
    """Return the chart of a part that was moved."""
    lower, upper = ((corner[0] + x, corner[1], corner[2] + z) for corner in (chart.low, chart.high))
    return replace(chart, low=lower, high=upper)


def wheel(
    radius: float,
    width: float,
    *,
    detail: int,
    rim: float = 0.64,
    spokes: int = 5,
    steel: Material = RIM,
    top: bool = True,
) -> Mesh:
    """Return a wheel about the y axis with its outer face at +y and the hub in the origin.

    It has a tyre and a rim with spokes. `top` False leaves out the upper tread at detail 0, where a body
    covers it.
    """
    half_width = 0.5 * width
    if detail == 0:
        angles = np.arange(6) * (np.pi / 3.0)
        rim_points = np.stack(
            [radius * np.cos(angles), np.zeros(6), radius * np.sin(angles) * 2.0 / np.sqrt(3.0)], axis=1
        )
        rim_points[:, 2] = np.clip(rim_points[:, 2], -radius, radius)
        points = np.concatenate(
            [rim_points - np.array([0.0, half_width, 0.0]), rim_points + np.array([0.0, half_width, 0.0])]
        )
        around = np.concatenate(
            [
                [(corner, corner + 6, (corner + 1) % 6 + 6), (corner, (corner + 1) % 6 + 6, (corner + 1) % 6)]
                for corner in range(0 if top else 3, 6)
            ]
        )
        fan = np.array([(6, 6 + corner + 1, 6 + corner) for corner in range(1, 5)])
        return build(points, np.concatenate([around, fan]), materials=RUBBER, smooth=0.0)
    segments = 20 if detail == 2 else 10
    shoulder = min(0.18 * radius, 0.3 * width)
    # The inner end is a plain disc, and so is what lies behind the spokes.
    tread = (
        (0.93, -half_width),
        (1.0, shoulder - half_width),
        (1.0, half_width - shoulder),
        (0.93, half_width),
        (rim, 0.72 * half_width),
    )
    outline = [(radius_share * radius, depth) for radius_share, depth in tread]
    tyre = lathe(outline, material=RUBBER, segments=segments, axis=1)
    disc_profile = [(rim, 0.88), (rim - 0.05, 0.80), (0.20, 0.88), (0.0, 0.92)]
    if detail == 1:
        disc_profile = [(rim, 0.88), (0.2, 0.90), (0.0, 0.90)]
    angles = np.arange(segments) * (2.0 * np.pi / segments)
    radius_shares, depth_shares = (np.array(column)[:, None] for column in zip(*disc_profile, strict=True))
    disc_points = np.stack(
        [
            radius_shares * radius * np.sin(angles),
            np.broadcast_to(depth_shares * half_width, (len(disc_profile), segments)),
            radius_shares * radius * np.cos(angles),
        ],
        -1,
    )
    faces = grid_faces(len(disc_profile), segments, wrap=True)
    cells = np.arange(len(faces)) // 2
    # Ten cells around show five spokes at most.
    is_between_spokes = (cells % segments) * spokes % segments >= 0.52 * segments if detail == 2 else cells % 2 == 1
    is_gap = is_between_spokes & (cells // segments == (1 if detail == 2 else 0))
    disc = build(
        disc_points.reshape(-1, 3), faces, materials=(steel, DARK), material=is_gap.astype(np.int32), smooth=SMOOTH
    )
    return merge([tyre, disc])


def wheels(
    positions: Sequence[tuple[float, float]], radius: float, width: float, *, detail: int, **options: object
) -> Mesh:
    """Pairs of wheels on the ground: for each (x, y of the outer face) one on the left and its mirror image."""
    wheel_mesh = wheel(radius, width, detail=detail, **options)  # type: ignore[arg-type]
    return both_sides(merge([wheel_mesh.moved(x, y - 0.5 * width, radius) for x, y in positions]))


def curve(keys: Sequence[tuple[float, float]], times: npt.ArrayLike) -> F64:
    """Interpolate keys (t, value) smoothly and without overshoot (monotone cubic, Fritsch and Carlson)."""
    key_positions, key_values = (np.array(key, np.float64) for key in zip(*keys, strict=True))
    steps, secants = np.diff(key_positions), np.diff(key_values) / np.diff(key_positions)
    tangents = np.concatenate(
        [secants[:1], np.where(secants[1:] * secants[:-1] > 0, 0.5 * (secants[1:] + secants[:-1]), 0.0), secants[-1:]]
    )
    for key, s in enumerate(secants):
        # Tangents of at most three times the secant keep the cubic monotone.
        limit = 3.0 * abs(s)
        tangents[key], tangents[key + 1] = (
            np.clip(tangents[key], -limit, limit),
            np.clip(tangents[key + 1], -limit, limit),
        )
    clamped = np.clip(np.asarray(times, np.float64), key_positions[0], key_positions[-1])
    interval = np.clip(np.searchsorted(key_positions, clamped, side="right") - 1, 0, len(steps) - 1)
    s = (clamped - key_positions[interval]) / steps[interval]
    length = steps[interval]
    return np.asarray(
        (1 + 2 * s) * (1 - s) ** 2 * key_values[interval]
        + s * (1 - s) ** 2 * length * tangents[interval]
        + s**2 * (3 - 2 * s) * key_values[interval + 1]
        + s**2 * (s - 1) * length * tangents[interval + 1]
    )
