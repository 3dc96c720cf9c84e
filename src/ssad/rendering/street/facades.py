"""Parts of buildings: walls, windows, doors, roofs. Frame: x along the front, y from it inwards, z up; metres."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from ssad.rendering.meshes.mesh import F64
from ssad.rendering.street.model import MID, NEAR
from ssad.rendering.street.palette import Look
from ssad.rendering.street.triangles import ALL, Piece, box, flat

VISIBLE = NEAR | MID
PARAPET = 0.7  # m, of flat roofs
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Wall:
    """An upright rectangle: its lower left corner seen from outside, the direction to its right, length, height."""

    foot: F64
    along: F64
    length: float
    height: float

    @property
    def out(self) -> F64:
        """Unit vector outwards."""
        return np.array([self.along[1], -self.along[0], 0.0])

    def quads(self, x: npt.ArrayLike, z: npt.ArrayLike, wide: npt.ArrayLike, high: npt.ArrayLike, away: float) -> F64:
        """Rectangles [n, 4, 3] on the wall: left edges x, lower edges z, `away` m before it."""
        u, v, w, h = np.broadcast_arrays(*(np.atleast_1d(np.asarray(k, np.float64)) for k in (x, z, wide, high)))
        corner = [(u, v), (u + w, v), (u + w, v + h), (u, v + h)]
        base = self.foot + away * self.out
        return np.stack([base + u[:, None] * self.along + v[:, None] * UP for u, v in corner], axis=1)


def walls(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> list[Wall]:
    """Front, right, back and left wall of a block."""
    foot = [(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1])]
    along = [(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)]
    size = (x[1] - x[0], y[1] - y[0])
    return [
        Wall(np.array([*f, z[0]]), np.array([*a, 0.0]), size[k % 2], z[1] - z[0])
        for k, (f, a) in enumerate(zip(foot, along, strict=True))
    ]


def block(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float], material: int) -> Piece:
    """The four walls of a block, without top."""
    return flat(np.concatenate([w.quads(0.0, 0.0, w.length, w.height, 0.0) for w in walls(x, y, z)]), material)


def panes(
    wall: Wall,
    x: F64,
    z: F64,
    size: tuple[float, float],
    look: Look,
    *,
    frame: int,
    sill: bool = True,
    blinds: float = 0.15,
) -> list[Piece]:
    """Windows of one size (width, height) with lower left corners x [n], z [n]; some have blinds drawn."""
    x, z = (np.atleast_1d(np.asarray(v, np.float64)) for v in (x, z))
    if not len(x):
        return []
    wide, high = size
    rng = look.generator
    rim = 0.07
    glass = np.where(rng.random(len(x)) < blinds, rng.choice(look.blind, len(x)), rng.choice(look.glass, len(x)))
    parts = [
        flat(wall.quads(x - rim, z - rim, wide + 2 * rim, high + 2 * rim, 0.025), frame, levels=NEAR),
        flat(wall.quads(x, z, wide, high, 0.045), glass, levels=VISIBLE),
    ]
    if wide > 0.9:
        parts.append(flat(wall.quads(x + wide / 2 - 0.03, z, 0.06, high, 0.06), frame, levels=NEAR))
    if sill:
        front = wall.quads(x - 0.12, z - 0.16, wide + 0.24, 0.10, 0.14)
        back = wall.quads(x - 0.12, z - 0.06, wide + 0.24, 0.0, 0.0)
        top = np.stack([front[:, 3], front[:, 2], back[:, 1], back[:, 0]], axis=1)
        parts.append(flat(np.concatenate([front, top]), look.stone[0], levels=NEAR))
    return parts


def rows(length: float, count: int, wide: float, *, margin: float = 0.0) -> F64:
    """Left edges of `count` things of one width spread evenly over a length."""
    bay = (length - 2 * margin) / max(count, 1)
    return np.asarray(margin + bay * (np.arange(count) + 0.5) - wide / 2)


def grid(
    wall: Wall,
    floors: int,
    storey: float,
    look: Look,
    *,
    size: tuple[float, float],
    bay: float,
    frame: int,
    first: int = 0,
    ground: float = 0.0,
    sill: bool = True,
    skip: F64 | None = None,
) -> list[Piece]:
    """Windows in rows of floors `first`... and columns about `bay` m apart; skip: x of columns that have none below."""
    count = int(wall.length // bay)
    if count < 1 or floors <= first:
        return []
    x = rows(wall.length, count, size[0])
    level = ground + np.arange(first, floors) * storey + 0.32 * storey
    xx, zz = (v.reshape(-1) for v in np.meshgrid(x, level))
    if skip is not None and first == 0:
        low = zz < ground + storey
        keep = ~(low & (np.abs(xx[:, None] + size[0] / 2 - skip[None]).min(axis=1) < 0.9 + size[0] / 2))
        xx, zz = xx[keep], zz[keep]
    return panes(wall, xx, zz, size, look, frame=frame, sill=sill)


def door(wall: Wall, x: float, look: Look, *, size: tuple[float, float] = (1.0, 2.1)) -> list[Piece]:
    """A door in a frame, its middle at x, with a step."""
    wide, high = size
    left = x - wide / 2
    return [
        flat(wall.quads(left - 0.12, 0.0, wide + 0.24, high + 0.14, 0.03), look.stone[0], levels=NEAR),
        flat(wall.quads(left, 0.04, wide, high, 0.05), look.pick("door"), levels=VISIBLE),
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
) -> list[Piece]:
    """A pitched roof over a block.

    Args:
        x: Extent of the block along x, m.
        y: Extent of the block along y, m.
        z: Height of the eaves, m.
        rise: Height of the ridge above the eaves, m.
        roof: Material of the roof.
        wall: Material of the gables.
        across: Whether the ridge runs along y; else along x.
        eaves: How far the roof reaches beyond the block, m.
        hip: Length by which the ridge is shorter at each end, m; 0: gables, which are walls.
    """
    (a0, a1), (b0, b1) = (y, x) if across else (x, y)
    half = 0.5 * (b1 - b0)
    slope = rise / half
    middle, low, thick = 0.5 * (b0 + b1), z - eaves * slope, 0.16
    end = eaves if hip else 0.25

    def points(*rows: tuple[float, float, float]) -> F64:
        p = np.array([rows], np.float64)
        return p[:, ::-1, [1, 0, 2]] if across else p

    o0, o1, c0, c1 = a0 - end, a1 + end, b0 - eaves, b1 + eaves
    r0, r1 = (o0 + hip + end, o1 - hip - end) if hip else (o0, o1)
    top = z + rise
    sides = [
        points((o0, c0, low), (o1, c0, low), (r1, middle, top), (r0, middle, top)),
        points((o1, c1, low), (o0, c1, low), (r0, middle, top), (r1, middle, top)),
    ]
    parts = [flat(p, roof) for p in sides]
    if hip:
        parts.append(flat(points((o1, c0, low), (o1, c1, low), (r1, middle, top)), roof))
        parts.append(flat(points((o0, c1, low), (o0, c0, low), (r0, middle, top)), roof))
    else:
        parts.append(flat(points((a1, b0, z), (a1, b1, z), (a1, middle, top)), wall))
        parts.append(flat(points((a0, b1, z), (a0, b0, z), (a0, middle, top)), wall))
    # undersides and edges of the overhang
    down = thick * UP
    parts += [flat((p - down)[:, ::-1], roof, levels=NEAR) for p in sides]
    rim = [
        points((o0, c0, low - thick), (o1, c0, low - thick), (o1, c0, low), (o0, c0, low)),
        points((o1, c1, low - thick), (o0, c1, low - thick), (o0, c1, low), (o1, c1, low)),
    ]
    if hip:
        rim.append(points((o1, c0, low - thick), (o1, c1, low - thick), (o1, c1, low), (o1, c0, low)))
        rim.append(points((o0, c1, low - thick), (o0, c0, low - thick), (o0, c0, low), (o0, c1, low)))
    else:
        for o, sign in ((o1, 1), (o0, -1)):
            for c in (c0, c1):
                ring = [(o, c, low - thick), (o, middle, top - thick), (o, middle, top), (o, c, low)]
                rim.append(points(*(ring if (c == c0) == (sign > 0) else ring[::-1])))
    parts += [flat(p, roof, levels=VISIBLE) for p in rim]
    return parts


def flat_roof(
    x: tuple[float, float],
    y: tuple[float, float],
    z: float,
    look: Look,
    *,
    coping: int,
    plant: int = 2,
) -> list[Piece]:
    """A flat roof with a parapet above z and boxes of building services."""
    rng = look.generator
    t = 0.3
    low = np.array([[x[0], y[0], z], [x[0], y[1] - t, z], [x[0], y[0] + t, z], [x[1] - t, y[0] + t, z]])
    high = np.array([[x[1], y[0] + t, 0], [x[1], y[1], 0], [x[0] + t, y[1] - t, 0], [x[1], y[1] - t, 0]])
    high[:, 2] = z + PARAPET
    parts = [box(low, high, coping, levels=VISIBLE)]
    deck = [[x[0], y[0], z + 0.1], [x[1], y[0], z + 0.1], [x[1], y[1], z + 0.1], [x[0], y[1], z + 0.1]]
    parts.append(flat(np.array([deck]), look.flat_roof, levels=ALL))
    for _ in range(plant):
        wide, deep, high_ = rng.uniform(1.5, 4.0), rng.uniform(1.5, 3.5), rng.uniform(0.9, 2.4)
        if x[1] - x[0] < wide + 3.0 or y[1] - y[0] < deep + 3.0:
            continue
        u, v = rng.uniform(x[0] + 1.0, x[1] - wide - 1.0), rng.uniform(y[0] + 1.0, y[1] - deep - 1.0)
        parts.append(box((u, v, z), (u + wide, v + deep, z + high_), look.metal, levels=VISIBLE))
    return parts


def balcony(wall: Wall, x: F64, z: F64, wide: float, look: Look, *, deep: float = 1.2) -> list[Piece]:
    """Balconies: slabs and railings before a wall, left edges x [n], floors at z [n]."""
    n = len(x)
    if not n:
        return []
    base = wall.foot + x[:, None] * wall.along + z[:, None] * UP
    right, out = wide * wall.along, deep * wall.out
    ring = [base, base + out, base + out + right, base + right]
    slab, rail = 0.16 * UP, 1.05 * UP
    quads = [np.stack([p - slab, q - slab, q, p], axis=1) for p, q in pairwise(ring)]
    quads += [np.stack(ring, axis=1), np.stack([p - slab for p in ring[::-1]], axis=1)]
    parts = [flat(np.concatenate(quads), look.stone[1], levels=VISIBLE)]
    sides = [np.stack([p + 0.12 * UP, q + 0.12 * UP, q + rail, p + rail], axis=1) for p, q in pairwise(ring)]
    outwards = (-wall.along, wall.out, wall.along)
    inner = [(side - 0.04 * away)[:, ::-1] for side, away in zip(sides, outwards, strict=True)]
    railing = look.frame[1] if look.generator.random() < 0.5 else look.glass[3]
    parts.append(flat(np.concatenate(sides + inner), railing, levels=VISIBLE))
    return parts
