"""What all bodies share: materials, the texture atlas, wheels, and the last step that fits a mesh to its size."""

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
TAIL = Material("tail_lamp", (0.36, 0.012, 0.012), specular=0.09, gloss=0.9, emission=0.12)
BLINKER = Material("indicator", (0.75, 0.26, 0.02), specular=0.09, gloss=0.9)
PLATE = Material("plate", (0.80, 0.80, 0.78), specular=0.04, gloss=0.5)
SOIL = Material("soil", (0.10, 0.065, 0.04), specular=0.0, gloss=0.0)
WOOD = Material("wood", (0.28, 0.17, 0.09), specular=0.02, gloss=0.1)

_AXES: dict[str, tuple[Point, Point]] = {
    # direction of u (right) and of v (down) for someone who looks at the panel from outside
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
    """A panel of the atlas: a parallel projection of what lies between `low` and `high` (m, object frame).

    `view` says from where: left, right, front, rear, top (read from behind) or hood (read from the front).
    A name `left_side/front_door` is cut out of the chart `left_side` and has no place of its own.
    """

    name: str
    view: str
    low: Point
    high: Point

    def flat(self, points: npt.ArrayLike) -> F64:
        """Points [..., 3] as metres [..., 2] right and down from the upper left corner."""
        u, v = (np.array(a) for a in _AXES[self.view])
        p = np.asarray(points, np.float64)
        corners = np.array([self.low, self.high])
        start = np.array([(corners @ u).min(), (corners @ v).min()])
        return np.asarray(np.stack([p @ u, p @ v], axis=-1) - start)

    def extent(self) -> tuple[float, float]:
        """Width and height of the chart, m."""
        far = self.flat(np.array([self.low, self.high])).max(axis=0)
        return float(far[0]), float(far[1])


def pack(charts: Sequence[Chart]) -> dict[str, tuple[float, float, float]]:
    """Place of each whole chart in the atlas: u, v of the upper left corner and uv units for a metre (one for all).

    Shelves of falling height, the scale by bisection: every panel has an area in proportion to its area in m^2.
    """
    whole = sorted((c for c in charts if "/" not in c.name), key=lambda c: (-c.extent()[1], c.name))
    sizes = [(chart.name, *chart.extent()) for chart in whole]
    best: dict[str, tuple[float, float, float]] = {}
    low, high = 0.0, 10.0
    for _ in range(30):
        scale = 0.5 * (low + high)
        placed = _shelves(sizes, scale)
        if placed is None:
            high = scale
        else:
            low, best = scale, placed
    return best


def _shelves(charts: Sequence[tuple[str, float, float]], scale: float) -> dict[str, tuple[float, float, float]] | None:
    """The charts (name, width and height in m) on shelves, each on the first with room; None where they do not fit."""
    shelves: list[list[float]] = []  # top, height, used width
    placed: dict[str, tuple[float, float, float]] = {}
    bottom = 0.0
    for name, *sides in charts:
        width, height = (side * scale + 2.0 * MARGIN for side in sides)
        shelf = next((s for s in shelves if s[2] + width <= 1.0 and height <= s[1] + 1e-12), None)
        if shelf is None:
            if bottom + height > 1.0 or width > 1.0:
                return None
            shelf = [bottom, height, 0.0]
            shelves.append(shelf)
            bottom += height
        placed[name] = (shelf[2] + MARGIN, shelf[0] + MARGIN, scale)
        shelf[2] += width
    return placed


def unwrap(mesh: Mesh, charts: Sequence[Chart]) -> Mesh:
    """The mesh with texture coordinates by the charts; its panels become exactly the charts that are whole or parts."""
    places = pack(charts)
    by_name = {chart.name: chart for chart in charts}
    names = tuple(c.name for c in charts if not any(o.name.startswith(f"{c.name}/") for o in charts))
    corners = mesh.corners()
    uv = mesh.uv.astype(np.float64).copy()
    panel = np.full(len(mesh.faces), -1, np.int32)
    rectangles: list[Rectangle] = []
    for index, name in enumerate(names):
        whole = by_name[name.split("/")[0]]
        u, v, scale = places[whole.name]
        corner = np.array([u, v])
        part = by_name[name]
        box = whole.flat(np.array([part.low, part.high])) * scale + corner
        low, high = box.min(axis=0), box.max(axis=0)
        rectangles.append((float(low[0]), float(low[1]), float(high[0]), float(high[1])))
        if name in mesh.panels:
            faces = mesh.panel == mesh.panels.index(name)
            uv[faces] = np.clip(whole.flat(corners[faces]) * scale, 0.0, np.array(whole.extent()) * scale) + corner
            panel[faces] = index
    return replace(mesh, uv=uv.astype(np.float32), panel=panel, panels=names, rectangles=tuple(rectangles))


def fit(mesh: Mesh, size: Point) -> Mesh:
    """The mesh scaled so that it fills length, width and height exactly, its base centred on the origin."""
    low, high = mesh.bounds()
    scale = np.asarray(size) / np.maximum(high - low, 1e-9)
    matrix = np.diag([*scale, 1.0])
    matrix[:3, 3] = -scale * np.array([0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1]), low[2]])
    return mesh.transformed(matrix)


def as_point(value: npt.ArrayLike) -> Point:
    """Three numbers as a point."""
    x, y, z = np.asarray(value, np.float64).tolist()
    return x, y, z


def finish(parts: Sequence[Mesh], charts: Sequence[Chart], size: Point) -> Mesh:
    """One mesh of a body's parts: fitted to its size (m), then unwrapped."""
    return unwrap(fit(merge(parts), size), charts)


def mirrored(mesh: Mesh) -> Mesh:
    """The mesh on the other side of the plane y = 0; panels `left…` and `right…` change names."""
    swap = {"left": "right", "right": "left"}
    panels = tuple(next((swap[s] + p[len(s) :] for s in swap if p.startswith(s)), p) for p in mesh.panels)
    return replace(mesh.transformed(np.diag([1.0, -1.0, 1.0, 1.0])), panels=panels)


def both_sides(mesh: Mesh) -> Mesh:
    """The mesh and its mirror image."""
    return merge([mesh, mirrored(mesh)])


def crate(low: Point, high: Point, material: Material, panels: Mapping[str, str] | None = None) -> Mesh:
    """A box between two corners; `panels` names the panel of some of its sides (front, rear, left, right, top)."""
    a, b = np.asarray(low, np.float64), np.asarray(high, np.float64)
    mesh = box(as_point(b - a), material=material, centre=as_point(0.5 * (a + b)))
    if not panels:
        return mesh
    names = tuple(panels.values())
    sides = ("front", "rear", "left", "right", "top", "bottom")
    index = [names.index(panels[side]) if side in panels else -1 for side in sides for _ in range(2)]
    look = [int(material.paint and i < 0) for i in index]  # paint lies in panels only
    return replace(
        mesh,
        panel=np.array(index, np.int32),
        panels=names,
        material=np.array(look, np.int32),
        materials=(material, DARK),
    )


def crates(low: Point, high: Point, material: Material) -> Mesh:
    """A box between two corners, and its mirror image on the other side of the vehicle."""
    return both_sides(crate(low, high, material))


def tubes(path: npt.ArrayLike, radius: npt.ArrayLike, material: Material, segments: int) -> Mesh:
    """A round bar along a path [S, 3], and its mirror image on the other side of the vehicle."""
    return both_sides(tube(path, radius, material=material, segments=segments))


SIDES = ("front", "rear", "left", "right", "top")


def sided(mesh: Mesh, prefix: str) -> Mesh:
    """The mesh with its faces in the panels `prefix_front`, `_rear`, `_left`, `_right`, `_top`, by where they look."""
    p = mesh.corners()
    normal = cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    panel = np.where(normal[:, 1] >= 0.0, 2, 3)
    panel = np.where(np.abs(normal[:, 1]) < 1e-3, np.where(p[..., 1].mean(axis=1) >= 0.0, 2, 3), panel)
    panel = np.where(normal[:, 2] > 0.8, 4, panel)
    panel = np.where(np.abs(normal[:, 0]) > 0.75, np.where(normal[:, 0] > 0.0, 0, 1), panel)
    return replace(mesh, panel=panel.astype(np.int32), panels=tuple(f"{prefix}_{side}" for side in SIDES))


def side_charts(prefix: str, low: Point, high: Point) -> list[Chart]:
    """The charts that belong to the panels of `sided` and `crate`: five sides of a box."""
    return [Chart(f"{prefix}_{side}", side, low, high) for side in SIDES]


def shifted(chart: Chart, x: float = 0.0, z: float = 0.0) -> Chart:
    """The chart of a part that was moved."""
    low, high = ((p[0] + x, p[1], p[2] + z) for p in (chart.low, chart.high))
    return replace(chart, low=low, high=high)


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
    """A wheel about the y axis with its outer face at +y, hub in the origin: tyre, and a rim with spokes.

    `top` False leaves out the upper tread at detail 0, where a body covers it.
    """
    half = 0.5 * width
    if detail == 0:
        angle = np.arange(6) * (np.pi / 3.0)
        ring = np.stack([radius * np.cos(angle), np.zeros(6), radius * np.sin(angle) * 2.0 / np.sqrt(3.0)], axis=1)
        ring[:, 2] = np.clip(ring[:, 2], -radius, radius)
        points = np.concatenate([ring - np.array([0.0, half, 0.0]), ring + np.array([0.0, half, 0.0])])
        around = np.concatenate(
            [[(k, k + 6, (k + 1) % 6 + 6), (k, (k + 1) % 6 + 6, (k + 1) % 6)] for k in range(0 if top else 3, 6)]
        )
        fan = np.array([(6, 6 + k + 1, 6 + k) for k in range(1, 5)])
        return build(points, np.concatenate([around, fan]), materials=RUBBER, smooth=0.0)
    segments = 20 if detail == 2 else 10
    soft = min(0.18 * radius, 0.3 * width)
    rubber = ((rim, -half), (0.93, -half), (1.0, soft - half), (1.0, half - soft), (0.93, half), (rim, 0.86 * half))
    outline = [(r * radius, y) for r, y in (*rubber, (rim, 0.3 * half))]
    tyre = lathe(outline, material=RUBBER, segments=segments, axis=1)
    depth = [(rim, 0.88), (rim - 0.05, 0.80), (0.20, 0.88), (0.0, 0.92)]
    if detail == 1:
        depth = [(rim, 0.88), (0.2, 0.90), (0.0, 0.90)]
    angle = np.arange(segments) * (2.0 * np.pi / segments)
    r, y = (np.array(d)[:, None] for d in zip(*depth, strict=True))
    grid = np.stack(
        [r * radius * np.sin(angle), np.broadcast_to(y * half, (len(depth), segments)), r * radius * np.cos(angle)], -1
    )
    faces = grid_faces(len(depth), segments, wrap=True)
    cell = np.arange(len(faces)) // 2
    between = (cell % segments) * spokes % segments >= 0.52 * segments
    gap = between & (cell // segments == (1 if detail == 2 else 0))
    disc = build(grid.reshape(-1, 3), faces, materials=(steel, DARK), material=gap.astype(np.int32), smooth=SMOOTH)
    return merge([tyre, disc])


def wheels(places: Sequence[tuple[float, float]], radius: float, width: float, *, detail: int, **look: object) -> Mesh:
    """Pairs of wheels on the ground: for each (x, y of the outer face) one on the left and its mirror image."""
    one = wheel(radius, width, detail=detail, **look)  # type: ignore[arg-type]
    return both_sides(merge([one.moved(x, y - 0.5 * width, radius) for x, y in places]))


def curve(keys: Sequence[tuple[float, float]], at: npt.ArrayLike) -> F64:
    """A smooth line through keys (t, value) without overshoot (monotone cubic, Fritsch and Carlson)."""
    t, v = (np.array(k, np.float64) for k in zip(*keys, strict=True))
    step, slope = np.diff(t), np.diff(v) / np.diff(t)
    m = np.concatenate(
        [slope[:1], np.where(slope[1:] * slope[:-1] > 0, 0.5 * (slope[1:] + slope[:-1]), 0.0), slope[-1:]]
    )
    for k, s in enumerate(slope):
        limit = 3.0 * abs(s)
        m[k], m[k + 1] = np.clip(m[k], -limit, limit), np.clip(m[k + 1], -limit, limit)
    x = np.clip(np.asarray(at, np.float64), t[0], t[-1])
    i = np.clip(np.searchsorted(t, x, side="right") - 1, 0, len(step) - 1)
    s = (x - t[i]) / step[i]
    h = step[i]
    return np.asarray(
        (1 + 2 * s) * (1 - s) ** 2 * v[i]
        + s * (1 - s) ** 2 * h * m[i]
        + s**2 * (3 - 2 * s) * v[i + 1]
        + s**2 * (s - 1) * h * m[i + 1]
    )
