"""Parts of buildings: walls, windows, doors, roofs. Frame: x along the front, y from it inwards, z up; metres."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from ssad.rendering.meshes.mesh import F64
from ssad.rendering.street.model import MID, NEAR
from ssad.rendering.street.palette import TownMaterials
from ssad.rendering.street.triangles import ALL, TrianglePiece, box, flat

VISIBLE = NEAR | MID
PARAPET = 0.7  # m, of flat roofs
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Wall:
    """Upright rectangle: lower left corner seen from outside, direction to the right, length, height."""

    foot: F64
    along: F64
    length: float
    height: float

    @property
    def out(self) -> F64:
        """Unit vector outwards."""
        return np.array([self.along[1], -self.along[0], 0.0])

    def quads(
        self, x: npt.ArrayLike, z: npt.ArrayLike, wide: npt.ArrayLike, high: npt.ArrayLike, distance: float
    ) -> F64:
        """Rectangles [n, 4, 3] on the wall: left edges x, lower edges z, `distance` m before it."""
        left_edges, lower_edges, widths, heights = np.broadcast_arrays(
            *(np.atleast_1d(np.asarray(value, np.float64)) for value in (x, z, wide, high))
        )
        corners = [
            (left_edges, lower_edges),
            (left_edges + widths, lower_edges),
            (left_edges + widths, lower_edges + heights),
            (left_edges, lower_edges + heights),
        ]
        base = self.foot + distance * self.out
        return np.stack(
            [
                base + left_edges[:, None] * self.along + lower_edges[:, None] * UP
                for left_edges, lower_edges in corners
            ],
            axis=1,
        )


def walls(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> list[Wall]:
    """Return the front, right, back and left wall of a block."""
    corners = [(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1])]
    directions = [(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)]
    lengths = (x[1] - x[0], y[1] - y[0])
    return [
        Wall(np.array([*corner, z[0]]), np.array([*direction, 0.0]), lengths[index % 2], z[1] - z[0])
        for index, (corner, direction) in enumerate(zip(corners, directions, strict=True))
    ]


def block(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float], material: int) -> TrianglePiece:
    """Return the four walls of a block, without top."""
    return flat(
        np.concatenate([wall.quads(0.0, 0.0, wall.length, wall.height, 0.0) for wall in walls(x, y, z)]), material
    )


def windows(
    wall: Wall,
    x: F64,
    z: F64,
    size: tuple[float, float],
    materials: TownMaterials,
    *,
    frame: int,
    sill: bool = True,
    blinds: float = 0.15,
) -> list[TrianglePiece]:
    """Windows of one size (width, height) with lower left corners x [n], z [n]; some have blinds drawn."""
    x, z = (np.atleast_1d(np.asarray(value, np.float64)) for value in (x, z))
    if not len(x):
        return []
    width, height = size
    rng = materials.generator
    frame_width = 0.07
    glass_materials = np.where(
        rng.random(len(x)) < blinds, rng.choice(materials.blind, len(x)), rng.choice(materials.glass, len(x))
    )
    parts = [
        flat(
            wall.quads(x - frame_width, z - frame_width, width + 2 * frame_width, height + 2 * frame_width, 0.025),
            frame,
            levels=NEAR,
        ),
        flat(wall.quads(x, z, width, height, 0.045), glass_materials, levels=VISIBLE),
    ]
    parts += _inside_windows(wall, x, z, size, materials)
    # wide windows have a mullion
    if width > 0.9:
        parts.append(flat(wall.quads(x + width / 2 - 0.03, z, 0.06, height, 0.06), frame, levels=NEAR))
    if sill:
        front = wall.quads(x - 0.12, z - 0.16, width + 0.24, 0.10, 0.14)
        back = wall.quads(x - 0.12, z - 0.06, width + 0.24, 0.0, 0.0)
        top = np.stack([front[:, 3], front[:, 2], back[:, 1], back[:, 0]], axis=1)
        parts.append(flat(np.concatenate([front, top]), materials.stone[0], levels=NEAR))
    return parts


def _inside_windows(
    wall: Wall, x: F64, z: F64, size: tuple[float, float], materials: TownMaterials
) -> list[TrianglePiece]:
    """View through windows: curtains at their sides, blinds half down, the lighter wall of a room, a sill."""
    rng, (width, height) = materials.details, size
    inside = 0.049  # m before the wall: just before the glass, whose gloss these materials have
    kind = rng.random(len(x))
    parts = []
    curtains = np.flatnonzero(kind < 0.34)
    if len(curtains):
        share = rng.uniform(0.12, 0.27, len(curtains)) * width
        cloth = rng.choice(materials.curtain, len(curtains))
        left, foot = x[curtains], z[curtains]
        parts.append(flat(wall.quads(left, foot, share, height, inside), cloth, levels=NEAR))
        parts.append(flat(wall.quads(left + width - share, foot, share, height, inside), cloth, levels=NEAR))
    blinds = np.flatnonzero((kind >= 0.34) & (kind < 0.5))
    if len(blinds):
        drop = rng.uniform(0.2, 0.7, len(blinds)) * height
        cloth = rng.choice([*materials.blind, materials.curtain[0]], len(blinds))
        parts.append(flat(wall.quads(x[blinds], z[blinds] + height - drop, width, drop, inside), cloth, levels=NEAR))
    rooms = np.flatnonzero((kind >= 0.5) & (kind < 0.85))
    if len(rooms):
        # The far wall of a room is lighter than its floor, and off the middle.
        share, edge = rng.uniform(0.35, 0.8, (2, len(rooms)))
        low = rng.uniform(0.25, 0.5, len(rooms)) * height
        left = x[rooms] + edge * (1.0 - share) * width
        room = rng.choice(materials.room, len(rooms))
        parts.append(
            flat(wall.quads(left, z[rooms] + low, share * width, 0.92 * height - low, inside), room, levels=NEAR)
        )
    return parts


def shop_window(
    wall: Wall, x: float, z: float, size: tuple[float, float], materials: TownMaterials
) -> list[TrianglePiece]:
    """View through a shop window: the back of the shop, its lit ceiling, shelves of goods and a poster."""
    rng, (width, height) = materials.details, size
    inside = wall.quads
    back_height = rng.uniform(0.55, 0.7) * height
    parts = [
        flat(
            inside(x + 0.08 * width, z + 0.3 * height, 0.84 * width, back_height, 0.052),
            int(rng.choice(materials.shop_back)),
            levels=VISIBLE,
        )
    ]
    lamps = max(1, int(width / 1.3))
    lefts = x + width * (np.arange(lamps) + 0.3) / lamps
    parts.append(
        flat(inside(lefts, z + 0.9 * height, 0.4 * width / lamps, 0.05, 0.056), materials.shop_light, levels=NEAR)
    )
    for shelf in (0.0, 0.3) if rng.random() < 0.6 else (0.0,):
        count = max(2, int(width / rng.uniform(0.25, 0.5)))
        lefts = x + 0.05 * width + 0.9 * width * (np.arange(count) + rng.uniform(0.0, 0.4, count)) / count
        heights = rng.uniform(0.08, 0.30, count) * height
        widths = rng.uniform(0.4, 0.85, count) * 0.9 * width / count
        colours = rng.choice(materials.goods, count)
        parts.append(flat(inside(lefts, z + shelf * height + 0.03, widths, heights, 0.058), colours, levels=NEAR))
        plank = int(materials.goods[-1])
        parts.append(flat(inside(x, z + shelf * height, width, 0.03, 0.06), plank, levels=NEAR))
    if rng.random() < 0.4 and width > 1.0:
        corner = x + float(rng.uniform(0.1, 0.6)) * width
        parts.append(
            flat(
                inside(corner, z + 0.45 * height, 0.22 * width, 0.4 * height, 0.06),
                materials.sign["white"],
                levels=NEAR,
            )
        )
    return parts


def evenly_spaced(length: float, count: int, width: float, *, margin: float = 0.0) -> F64:
    """Left edges of `count` things of one width spread evenly over a length."""
    bay_width = (length - 2 * margin) / max(count, 1)
    return np.asarray(margin + bay_width * (np.arange(count) + 0.5) - width / 2)


def window_grid(
    wall: Wall,
    floors: int,
    storey: float,
    materials: TownMaterials,
    *,
    size: tuple[float, float],
    bay: float,
    frame: int,
    first: int = 0,
    ground: float = 0.0,
    sill: bool = True,
    skip: F64 | None = None,
) -> list[TrianglePiece]:
    """Windows in rows of floors `first`... and columns about `bay` m apart; skip: x of columns that have none below."""
    count = int(wall.length // bay)
    if count < 1 or floors <= first:
        return []
    left_edges = evenly_spaced(wall.length, count, size[0])
    sills = ground + np.arange(first, floors) * storey + 0.32 * storey
    xx, zz = (grid_values.reshape(-1) for grid_values in np.meshgrid(left_edges, sills))
    if skip is not None and first == 0:
        on_first_floor = zz < ground + storey
        is_clear = ~(on_first_floor & (np.abs(xx[:, None] + size[0] / 2 - skip[None]).min(axis=1) < 0.9 + size[0] / 2))
        xx, zz = xx[is_clear], zz[is_clear]
    return windows(wall, xx, zz, size, materials, frame=frame, sill=sill)


def door(
    wall: Wall, x: float, materials: TownMaterials, *, size: tuple[float, float] = (1.0, 2.1)
) -> list[TrianglePiece]:
    """A door in a frame, its middle at x, with a step."""
    width, height = size
    left = x - width / 2
    return [
        flat(wall.quads(left - 0.12, 0.0, width + 0.24, height + 0.14, 0.03), materials.stone[0], levels=NEAR),
        flat(wall.quads(left, 0.04, width, height, 0.05), materials.pick("door"), levels=VISIBLE),
    ]


def gable(
    x: tuple[float, float],
    y: tuple[float, float],
    z: float,
    rise: float,
    *,
    roof: int,
    wall: int,
    across: bool = False,
    eaves: float = 0.4,
    hip: float = 0.0,
) -> list[TrianglePiece]:
    """Return a pitched roof over a block.

    Args:
        x: Extent of the block along x, m.
        y: Extent of the block along y, m.
        z: Height of the eaves, m.
        rise: Height of the ridge above the eaves, m.
        roof: Material of the roof.
        wall: Material of the gables.
        across: Whether the ridge runs along y; else along x.
        eaves: Distance that the roof reaches beyond the block, m.
        hip: Length by which the ridge is shorter at each end, m; 0: the ends are gable walls.
    """
    (ridge_start, ridge_end), (eave_start, eave_end) = (y, x) if across else (x, y)
    half_span = 0.5 * (eave_end - eave_start)
    slope = rise / half_span
    ridge_line, eave_height, thickness = 0.5 * (eave_start + eave_end), z - eaves * slope, 0.16
    end_overhang = eaves if hip else 0.25

    def points(*rows: tuple[float, float, float]) -> F64:
        array = np.array([rows], np.float64)
        return array[:, ::-1, [1, 0, 2]] if across else array

    outer_start, outer_end, outer_left, outer_right = (
        ridge_start - end_overhang,
        ridge_end + end_overhang,
        eave_start - eaves,
        eave_end + eaves,
    )
    top_start, top_end = (
        (outer_start + hip + end_overhang, outer_end - hip - end_overhang) if hip else (outer_start, outer_end)
    )
    ridge_height = z + rise
    sides = [
        points(
            (outer_start, outer_left, eave_height),
            (outer_end, outer_left, eave_height),
            (top_end, ridge_line, ridge_height),
            (top_start, ridge_line, ridge_height),
        ),
        points(
            (outer_end, outer_right, eave_height),
            (outer_start, outer_right, eave_height),
            (top_start, ridge_line, ridge_height),
            (top_end, ridge_line, ridge_height),
        ),
    ]
    parts = [flat(polygon, roof) for polygon in sides]
    if hip:
        parts.append(
            flat(
                points(
                    (outer_end, outer_left, eave_height),
                    (outer_end, outer_right, eave_height),
                    (top_end, ridge_line, ridge_height),
                ),
                roof,
            )
        )
        parts.append(
            flat(
                points(
                    (outer_start, outer_right, eave_height),
                    (outer_start, outer_left, eave_height),
                    (top_start, ridge_line, ridge_height),
                ),
                roof,
            )
        )
    else:
        parts.append(
            flat(
                points((ridge_end, eave_start, z), (ridge_end, eave_end, z), (ridge_end, ridge_line, ridge_height)),
                wall,
            )
        )
        parts.append(
            flat(
                points(
                    (ridge_start, eave_end, z), (ridge_start, eave_start, z), (ridge_start, ridge_line, ridge_height)
                ),
                wall,
            )
        )
    # undersides and edges of the overhang
    drop = thickness * UP
    parts += [flat((polygon - drop)[:, ::-1], roof, levels=NEAR) for polygon in sides]
    edge_polygons = [
        points(
            (outer_start, outer_left, eave_height - thickness),
            (outer_end, outer_left, eave_height - thickness),
            (outer_end, outer_left, eave_height),
            (outer_start, outer_left, eave_height),
        ),
        points(
            (outer_end, outer_right, eave_height - thickness),
            (outer_start, outer_right, eave_height - thickness),
            (outer_start, outer_right, eave_height),
            (outer_end, outer_right, eave_height),
        ),
    ]
    if hip:
        edge_polygons.append(
            points(
                (outer_end, outer_left, eave_height - thickness),
                (outer_end, outer_right, eave_height - thickness),
                (outer_end, outer_right, eave_height),
                (outer_end, outer_left, eave_height),
            )
        )
        edge_polygons.append(
            points(
                (outer_start, outer_right, eave_height - thickness),
                (outer_start, outer_left, eave_height - thickness),
                (outer_start, outer_left, eave_height),
                (outer_start, outer_right, eave_height),
            )
        )
    else:
        for end_position, sign in ((outer_end, 1), (outer_start, -1)):
            for side_position in (outer_left, outer_right):
                corners = [
                    (end_position, side_position, eave_height - thickness),
                    (end_position, ridge_line, ridge_height - thickness),
                    (end_position, ridge_line, ridge_height),
                    (end_position, side_position, eave_height),
                ]
                edge_polygons.append(
                    points(*(corners if (side_position == outer_left) == (sign > 0) else corners[::-1]))
                )
    parts += [flat(polygon, roof, levels=VISIBLE) for polygon in edge_polygons]
    return parts


def flat_roof(
    x: tuple[float, float],
    y: tuple[float, float],
    z: float,
    materials: TownMaterials,
    *,
    coping: int,
    plant: int = 2,
) -> list[TrianglePiece]:
    """A flat roof with a parapet above z and boxes of building services."""
    rng = materials.generator
    # m, thickness of the parapet
    thickness = 0.3
    lower_corners = np.array(
        [
            [x[0], y[0], z],
            [x[0], y[1] - thickness, z],
            [x[0], y[0] + thickness, z],
            [x[1] - thickness, y[0] + thickness, z],
        ]
    )
    upper_corners = np.array(
        [
            [x[1], y[0] + thickness, 0],
            [x[1], y[1], 0],
            [x[0] + thickness, y[1] - thickness, 0],
            [x[1], y[1] - thickness, 0],
        ]
    )
    upper_corners[:, 2] = z + PARAPET
    parts = [box(lower_corners, upper_corners, coping, levels=VISIBLE)]
    deck = [[x[0], y[0], z + 0.1], [x[1], y[0], z + 0.1], [x[1], y[1], z + 0.1], [x[0], y[1], z + 0.1]]
    parts.append(flat(np.array([deck]), materials.flat_roof, levels=ALL))
    for _ in range(plant):
        width, depth, height = rng.uniform(1.5, 4.0), rng.uniform(1.5, 3.5), rng.uniform(0.9, 2.4)
        if x[1] - x[0] < width + 3.0 or y[1] - y[0] < depth + 3.0:
            continue
        left, front = rng.uniform(x[0] + 1.0, x[1] - width - 1.0), rng.uniform(y[0] + 1.0, y[1] - depth - 1.0)
        parts.append(box((left, front, z), (left + width, front + depth, z + height), materials.metal, levels=VISIBLE))
    return parts


def balcony(
    wall: Wall, x: F64, z: F64, widths: float, materials: TownMaterials, *, depth: float = 1.2
) -> list[TrianglePiece]:
    """Balconies: slabs and railings before a wall, left edges x [n], floors at z [n]."""
    count = len(x)
    if not count:
        return []
    corners = wall.foot + x[:, None] * wall.along + z[:, None] * UP
    across, forward = widths * wall.along, depth * wall.out
    slab_corners = [corners, corners + forward, corners + forward + across, corners + across]
    slab_height, rail_height = 0.16 * UP, 1.05 * UP
    quads = [
        np.stack([start - slab_height, end - slab_height, end, start], axis=1) for start, end in pairwise(slab_corners)
    ]
    quads += [np.stack(slab_corners, axis=1), np.stack([start - slab_height for start in slab_corners[::-1]], axis=1)]
    parts = [flat(np.concatenate(quads), materials.stone[1], levels=VISIBLE)]
    railing_faces = [
        np.stack([start + 0.12 * UP, end + 0.12 * UP, end + rail_height, start + rail_height], axis=1)
        for start, end in pairwise(slab_corners)
    ]
    directions = (-wall.along, wall.out, wall.along)
    # Railings are seen from both sides; the reversed copy is offset to avoid coplanar faces.
    inner_faces = [
        (side - 0.04 * direction)[:, ::-1] for side, direction in zip(railing_faces, directions, strict=True)
    ]
    railing = materials.frame[1] if materials.generator.random() < 0.5 else materials.glass[3]
    parts.append(flat(np.concatenate(railing_faces + inner_faces), railing, levels=VISIBLE))
    return parts
