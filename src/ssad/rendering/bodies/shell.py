"""Shell of a vehicle with a closed body: a loft through cross sections from nose to tail.

A half section runs from the middle of the floor over wheel well, sill, side, belt line, side window and rail to the
middle of the roof. Heights come from curves over t (0 at the nose, 1 at the tail); a wheel arch lifts the sill.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt

from ssad.rendering.bodies.parts import DARK, GLASS, HEAD, HOUSING, PAINT, SEAM, TAIL, TRIM, Chart, curve
from ssad.rendering.meshes.mesh import F64, Material, Mesh, Point, build, merge

Keys = tuple[tuple[float, float], ...]
Span = tuple[float, float]

# points of a half section
B0, B1, B2, B3, S1, S2, S3, S4, S5, U0, U1, U2, U3, T1, T2, T3 = range(16)
SIDE = (0.12, 0.34, 0.56, 0.76, 0.90)  # S1 to S5: share of the way from the sill to the belt line
POINTS = {2: tuple(range(1, 16)), 1: (B0, B3, S2, S3, S4, U0, U2, T1, T3), 0: (B3, U0, U3)}
END = 0.55  # share of the bulge of the ends that is left at their upper edge


@dataclass(frozen=True, slots=True)
class Shell:
    """Shape of a vehicle's shell. Along: t from nose (0) to tail (1). Heights as shares of the height."""

    top: Keys  # middle of hood, windscreen, roof, tail
    belt: Keys  # edge of the hood, lower edge of the side windows
    plan: Keys  # half width, as a share of the largest
    cowl: float  # lower edge of the windscreen
    screen: float  # upper edge of the windscreen
    roof: float  # end of the roof
    deck: float  # lower edge of the rear window, start of the trunk (1: it lies in the tail)
    windows: tuple[Span, ...]
    doors: tuple[tuple[str, float, float], ...]
    axles: tuple[float, float]
    radius: float  # of the wheels, m at a height of 1 m
    sill: float = 0.13
    tumble: float = 0.20  # how far the sides lean in at roof height
    body: float = 0.925  # width without mirrors
    nose: float = 0.045  # depth of the bulge of the front, share of the length
    tail: float = 0.03
    lean: float = 0.0  # how far the tail leans forward above the belt line, share of the length
    bed: Span | None = None  # open loading bed
    clad: bool = False  # black sills and arches
    lamps: tuple[int, int] = (S3, S5)  # rows of the head lamps
    tail_lamps: tuple[int, int] = (S3, S5)
    lamp_from: float = 0.5  # head lamps reach from the corner to this share of the half width
    tail_from: float = 0.5
    grille: tuple[int, int] = (S3, S4)
    glass_gap: float = 0.05  # share of the window height below the glass
    wheel_width: float = 0.22
    arch: float = 1.13  # radius of the arch, in wheel radii
    trunk: str = "trunk"
    rear_window: bool = True


def stations(shell: Shell, size: Point, *, detail: int) -> F64:
    """Return the positions t of the cross sections, from nose to tail."""
    length, _, height = size
    ends = [0.0, 1.0, shell.cowl, shell.screen, shell.roof, shell.deck]
    if detail == 0:
        middle = [0.5 * (shell.screen + shell.roof)] if shell.deck > 0.97 else []
        bed_start = [shell.bed[0]] if shell.bed else []
        return np.unique(np.clip([*ends, *middle, 0.4 * shell.cowl, *bed_start], 0.0, 1.0))
    places = [
        *ends,
        *(edge for span in shell.windows for edge in span),
        *(edge for _, start, end in shell.doors for edge in (start, end)),
    ]
    radius = shell.radius * height
    arch_angles = np.linspace(0.0, np.pi, 9 if detail == 2 else 5)
    for axle in shell.axles:
        reach = shell.arch * radius / (length * (1.0 - shell.nose - shell.tail))
        places += list(axle - reach * np.cos(arch_angles))
    if shell.bed:
        places += [shell.bed[0], shell.bed[0] + 0.004, shell.bed[1], shell.bed[1] - 0.004]
    if detail == 2:
        places += [0.012, 0.035, 0.06, shell.cowl - 0.012, 0.5 * (shell.screen + shell.roof), 0.955, 0.985]
        places += list(np.linspace(shell.cowl, shell.screen, 4)) + list(np.linspace(shell.roof, shell.deck, 3))
        places += [edge + 0.0022 for _, start, end in shell.doors for edge in (start, end)]
    else:
        places += [0.03, 0.97]
    t = np.unique(np.round(np.clip(places, 0.0, 1.0), 6))
    # Nearly equal stations would give slivers.
    return np.asarray(t[np.concatenate([[True], np.diff(t) > 0.0015])])


def sections(shell: Shell, size: Point, t: F64, *, detail: int) -> F64:
    """Return the left halves of the cross sections [S, 16, 3] in the object frame, m."""
    length, width, height = size
    half_width = 0.5 * width * shell.body * curve(shell.plan, t)
    roof, belt = height * curve(shell.top, t), height * curve(shell.belt, t)
    # Bands of zero height would give faces without area.
    belt = np.minimum(belt, roof - 0.012 * height)
    sill = np.full_like(t, shell.sill * height)
    radius = shell.radius * height
    x = length * (0.5 - shell.nose - t * (1.0 - shell.nose - shell.tail))
    if detail > 0:
        for axle in shell.axles:
            distances = np.abs(x - axle_x(shell, size, axle))
            arch_radius = shell.arch * radius
            arch_rise = radius + arch_radius - shell.sill * height
            offset = shell.sill * height + arch_rise * np.sqrt(np.maximum(1.0 - (distances / arch_radius) ** 2, 0.0))
            sill = np.maximum(sill, offset)
    window_height = roof - belt
    tumble_offset = shell.tumble * np.clip(window_height / (height * 0.34), 0.0, 1.2)
    sill_height = shell.sill * height
    y, z = np.zeros((len(t), 16)), np.zeros((len(t), 16))
    floor_width = 0.5 * width * shell.body - shell.wheel_width - 0.06
    y[:, B1] = y[:, B2] = np.minimum(floor_width, 0.85 * half_width)
    z[:, B0] = z[:, B1] = sill_height
    z[:, B2] = z[:, B3] = sill
    side_profile = np.array([0.955, 0.975, 0.995, 1.0, 0.993, 0.98, 0.962])  # B3, S1 to S5, U0
    y[:, [B3, S1, S2, S3, S4, S5, U0]] = half_width[:, None] * side_profile
    for index, share in enumerate(SIDE):
        z[:, S1 + index] = np.maximum(sill_height + share * (belt - sill_height), sill + 0.018 * (index + 1))
    z[:, U0] = np.maximum(belt, z[:, S5] + 0.005)
    shares = [shell.glass_gap, 0.86, 0.945, 0.982, 0.996, 1.0]
    for index, share in enumerate(shares):
        z[:, U1 + index] = z[:, U0] + share * (roof - z[:, U0])
    z[:, T3] = np.maximum(z[:, T3], z[:, U0] + 0.004)
    for index, point in enumerate((U1, U2, U3)):
        y[:, point] = half_width * (
            0.955 - (0.0, 0.012, 0.035)[index] - tumble_offset * (shell.glass_gap, 0.86, 1.0)[index]
        )
    y[:, T1] = y[:, U3] - 0.11 * half_width
    y[:, T2] = 0.45 * y[:, T1]
    if shell.bed:
        is_bed = (t > shell.bed[0] + 0.003) & (t < shell.bed[1] - 0.003)
        z[is_bed, T2] = z[is_bed, T3] = 0.44 * height
        y[is_bed, T2] = 0.985 * y[is_bed, T1]
    points = np.stack([np.repeat(x[:, None], 16, axis=1), y, z], axis=-1)
    for end_share, depth in ((1.0 - t / 0.08, shell.nose), ((t - 0.96) / 0.04, -shell.tail)):
        offset = np.clip(end_share, 0.0, 1.0)[:, None] * END * depth * length
        points[:, [T1, T2, T3], 0] += offset * (1.0 - (y[:, [T1, T2, T3]] / y[:, [U3]]) ** 2)
    tail_share = np.clip((t - 0.8) / 0.2, 0.0, 1.0)[:, None]
    # The tail leans forward only above the belt line, and only in the last fifth of the length.
    points[..., 0] += shell.lean * length * tail_share * np.clip((z - belt[:, None]) / (0.3 * height), 0.0, 1.2)
    return points


def axle_x(shell: Shell, size: Point, axle: float) -> float:
    """Return the x of an axle, m from the middle of the vehicle."""
    return float(size[0] * (0.5 - shell.nose - axle * (1.0 - shell.nose - shell.tail)))


def side_parts(shell: Shell) -> list[tuple[str, float, float]]:
    """Return the parts of a side from nose to tail with their ends: wings, doors, and pieces between doors."""
    parts = [("front_wing", 0.0, shell.doors[0][1])]
    for door in shell.doors:
        if door[1] > parts[-1][2] + 0.005:
            parts.append(("middle", parts[-1][2], door[1]))
        parts.append(door)
    return [*parts, ("rear_wing", parts[-1][2], 1.0)]


def charts(shell: Shell, size: Point) -> list[Chart]:
    """Return the panels of the shell, the same at every level of detail."""
    length, width, height = size
    side, front_x, rear_x = 0.5 * width, 0.5 * length, -0.5 * length

    x = partial(axle_x, shell, size)
    lowest = 0.8 * shell.sill * height
    panel_charts: list[Chart] = []
    parts = side_parts(shell)
    for name, y0, y1 in (("left", 0.0, side), ("right", -side, 0.0)):
        panel_charts.append(Chart(f"{name}_side", name, (rear_x, y0, lowest), (front_x, y1, height)))
        for part, start, end in parts:
            ends = rear_x if part == "rear_wing" else x(end), front_x if part == "front_wing" else x(start)
            panel_charts.append(Chart(f"{name}_side/{part}", name, (ends[0], y0, lowest), (ends[1], y1, height)))
    front_height = height * min(1.0, float(curve(shell.top, 0.02)) + 0.02)
    rear_height = height * min(1.0, float(curve(shell.top, 0.99)) + 0.02)
    panel_charts.append(Chart("front", "front", (0.0, -side, lowest), (front_x, side, front_height)))
    panel_charts.append(Chart("rear", "rear", (rear_x, -side, lowest), (0.0, side, rear_height)))
    if shell.cowl > 0.03:
        panel_charts.append(Chart("hood", "hood", (x(shell.cowl), -side, 0.0), (x(0.0), side, height)))
    panel_charts.append(Chart("roof", "top", (x(shell.roof), -side, 0.0), (x(shell.screen), side, height)))
    if shell.deck < 0.97:
        panel_charts.append(Chart(shell.trunk, "top", (x(1.0), -side, 0.0), (x(shell.deck), side, height)))
    return panel_charts


def shell_mesh(shell: Shell, size: Point, *, detail: int) -> Mesh:
    """Return the shell as one closed mesh with materials and panels; wheel arches are open at detail 1 and 2."""
    t = stations(shell, size, detail=detail)
    point_indices = POINTS[detail]
    half_sections = sections(shell, size, t, detail=detail)[:, point_indices]
    mirror_start, mirror_end = int(point_indices[0] == B0), len(point_indices) - int(point_indices[-1] == T3)
    outlines = np.concatenate(
        [half_sections, half_sections[:, mirror_start:mirror_end][:, ::-1] * [1.0, -1.0, 1.0]], axis=1
    )
    point_names = [*point_indices, *point_indices[mirror_start:mirror_end][::-1]]
    count = len(point_names)
    faces: list[tuple[int, int, int]] = []
    surfaces: list[tuple[Material, str | None]] = []
    # Bands are classified at their middle: stations lie exactly on the limits of parts.
    for band, middle_t in enumerate(0.5 * (t[:-1] + t[1:])):
        for column in range(count):
            next_column = (column + 1) % count
            side = "left" if column < len(point_indices) - 1 or next_column == 0 else "right"
            first_vertex, next_vertex = band * count + column, band * count + next_column
            faces += [
                (first_vertex, first_vertex + count, next_vertex + count),
                (first_vertex, next_vertex + count, next_vertex),
            ]
            surfaces += [
                _band_panel(
                    shell,
                    middle_t,
                    min(point_names[column], point_names[next_column]),
                    max(point_names[column], point_names[next_column]),
                    side,
                )
            ] * 2
    body_mesh = mesh_with_panels(outlines.reshape(-1, 3), faces, surfaces)
    return merge(
        [body_mesh, *(_end(shell, size, half_sections, point_indices, front=front) for front in (True, False))]
    )


def mesh_with_panels(
    vertices: npt.ArrayLike, faces: Sequence[tuple[int, int, int]], appearances: Sequence[tuple[Material, str | None]]
) -> Mesh:
    """A mesh of faces with a material and a panel (or None) for each."""
    materials = list(dict.fromkeys(surface_material for surface_material, _ in appearances))
    panels = list(dict.fromkeys(panel_name for _, panel_name in appearances if panel_name is not None))
    material = [materials.index(surface_material) for surface_material, _ in appearances]
    panel = [-1 if panel_name is None else panels.index(panel_name) for _, panel_name in appearances]
    return build(vertices, faces, materials=materials, material=material, panel=panel, panels=panels)


def _band_panel(shell: Shell, position: float, low: int, high: int, side: str) -> tuple[Material, str | None]:
    """Return material and panel of the band between points `low` and `high` of the section, at t along."""
    if high <= B3:
        return DARK, None
    part = next(name for name, _, end in side_parts(shell) if position < end)
    side_surface: tuple[Material, str | None] = (PAINT, f"{side}_side/{part}")
    is_cabin = shell.cowl < position < shell.deck
    top_surface: tuple[Material, str | None] = (PAINT, "hood" if position <= shell.cowl else shell.trunk)
    if low < U0:
        return _flank(shell, position, low, high, side_surface)
    if low >= T1 or low == high:
        if shell.bed and shell.bed[0] < position < shell.bed[1]:
            return DARK, None
        if shell.cowl - 0.012 < position < shell.screen and is_cabin:
            return GLASS, None
        if shell.roof < position < shell.deck and shell.deck < 0.97:
            return GLASS, None
        return (PAINT, "roof") if is_cabin else top_surface
    if not is_cabin:
        return top_surface
    is_window = any(start <= position < end for start, end in shell.windows)
    has_windows = shell.windows[0][0] <= position < shell.windows[-1][1]
    if low == U0 and high == U1:
        return (TRIM, None) if has_windows else side_surface
    if low == U1 or (low == U0 and high in (U2, U3)):
        return (GLASS, None) if is_window else (TRIM, None) if has_windows else side_surface
    return (PAINT, "roof") if low == U3 and shell.screen < position < shell.roof else side_surface


def _flank(
    shell: Shell, t: float, low: int, high: int, door: tuple[Material, str | None]
) -> tuple[Material, str | None]:
    """Material and panel of the side below the belt line."""
    if t < 0.035 and low >= shell.lamps[0] and high <= shell.lamps[1]:
        return HOUSING, None
    if t > 0.968 and low >= shell.tail_lamps[0] and high <= shell.tail_lamps[1]:
        return TAIL, None
    if any(edge <= t < edge + 0.0023 for _, start, end in shell.doors for edge in (start, end)) and low >= S1:
        return SEAM, None
    if low == B3 and high == S1:
        return TRIM, None
    if shell.clad and high <= S2 and low >= B3:
        return TRIM, None
    return door


def _end(shell: Shell, size: Point, half: F64, kept_rows: Sequence[int], *, front: bool) -> Mesh:
    """The front or the rear: a grid of points over the first or last section, bulging outwards."""
    section = half[0 if front else -1]
    rows = [row for row, point in enumerate(kept_rows) if B3 <= point <= U3]
    rim_rows = [row for row, point in enumerate(kept_rows) if point > kept_rows[rows[-1]]]
    top_edge = section[[rows[-1], *rim_rows]]
    if top_edge[-1, 1] > 1e-9:
        top_edge = np.concatenate([top_edge, [[top_edge[-1, 0], 0.0, top_edge[-1, 2]]]])
    full_width = top_edge[0, 1]
    lamp_share = shell.lamp_from if front else shell.tail_from
    shares = np.unique([0.0, 1.0, *(top_edge[1:, 1] / full_width), *([0.2, lamp_share] if len(kept_rows) > 3 else [])])[
        ::-1
    ]
    depth = (shell.nose if front else -shell.tail) * size[0]
    point_rows: list[F64] = []
    point_names = [kept_rows[row] for row in rows]
    # At detail 0 the end is one flat band.
    if len(kept_rows) == 3:
        shares = np.array([1.0])
    for row in rows:
        row_points = np.repeat(section[row][None], len(shares), axis=0)
        row_points[:, 1] *= shares
        row_points[:, 0] += depth * _bulge(shell, section[row][2], section, front=front) * (1.0 - shares**2)
        point_rows.append(row_points)
    if rim_rows and len(shares) > 1:
        widths = shares * full_width
        point_rows.append(
            np.stack(
                [
                    np.interp(widths, top_edge[::-1, 1], top_edge[::-1, 0]),
                    widths,
                    np.interp(widths, top_edge[::-1, 1], top_edge[::-1, 2]),
                ],
                1,
            )
        )
        point_names.append(T3)
    left_half = np.stack(point_rows)
    right_half = left_half[:, ::-1] * [1.0, -1.0, 1.0]
    points = np.concatenate([left_half, right_half[:, 1:] if shares[-1] < 1e-9 else right_half], axis=1)
    width_shares = points[0, :, 1] / max(points[0, 0, 1], 1e-9)
    faces: list[tuple[int, int, int]] = []
    surfaces: list[tuple[Material, str | None]] = []
    columns = points.shape[1]
    for row in range(len(points) - 1):
        for column in range(columns - 1):
            corner, next_corner = row * columns + column, (row + 1) * columns + column
            quad_faces = [(corner, next_corner, next_corner + 1), (corner, next_corner + 1, corner + 1)]
            faces += quad_faces if front else [(first, point, second) for first, second, point in quad_faces]
            surfaces += [
                _face(
                    shell,
                    point_names[row],
                    point_names[row + 1],
                    0.5 * abs(width_shares[column] + width_shares[column + 1]),
                    front=front,
                )
            ] * 2
    return mesh_with_panels(points.reshape(-1, 3), faces, surfaces)


def _bulge(shell: Shell, z: float, section: F64, *, front: bool) -> float:
    """Return how far the front or rear bulges in the middle at height z, as a share of its depth."""
    lowest, highest = section[:, 2].min(), section[:, 2].max()
    profile = ((0.0, 0.80), (0.3, 1.0), (0.65, 0.92), (1.0, END))
    return float(curve(profile, (z - lowest) / max(highest - lowest, 1e-9)))


def end_x(shell: Shell, size: Point, z: float, *, front: bool) -> float:
    """Return the x of the surface of the front or rear in the middle of the vehicle at height z, m."""
    section = sections(shell, size, np.array([0.0 if front else 1.0]), detail=2)[0]
    depth = (shell.nose if front else -shell.tail) * size[0]
    order = np.argsort(section[B3 : U3 + 1, 2])
    x = np.interp(z, section[B3 : U3 + 1, 2][order], section[B3 : U3 + 1, 0][order])
    return float(x + depth * _bulge(shell, z, section, front=front))


def _face(shell: Shell, low: int, high: int, share: float, *, front: bool) -> tuple[Material, str | None]:
    """Return material and panel of a cell of the front or rear.

    The cell lies between rows `low` and `high`, at a share of the half width.
    """
    lamp_rows, lamp_start = (shell.lamps, shell.lamp_from) if front else (shell.tail_lamps, shell.tail_from)
    painted: tuple[Material, str | None] = (PAINT, "front" if front else "rear")
    if low >= lamp_rows[0] and high <= lamp_rows[1] and share > lamp_start:
        return (HEAD if front else TAIL), None
    if low == B3 and high <= S1:
        return TRIM, None
    if front and share < shell.lamp_from and low >= shell.grille[0] and high <= shell.grille[1]:
        return TRIM, None
    if front and low == S1 and high == S2 and share < 0.7:
        return TRIM, None
    if shell.clad and high <= S2:
        return TRIM, None
    has_window = shell.screen < 0.02 if front else shell.deck >= 0.97 and shell.rear_window
    if has_window and low in (U0, U1) and high in (U2, U3) and share < (0.95 if front else 0.88):
        return GLASS, None
    return painted
