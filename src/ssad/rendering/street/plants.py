"""Trees, bushes and hedges: a trunk, dark blobs for the inside of the crown, and leaves as triangles around them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ssad.core.geometry import cross
from ssad.rendering.meshes.mesh import F64
from ssad.rendering.street.model import FAR, MID, NEAR
from ssad.rendering.street.palette import Look
from ssad.rendering.street.triangles import Piece, box, cylinder, join, smooth

VISIBLE = NEAR | MID


def _ball() -> tuple[F64, np.ndarray]:
    """Vertices [12, 3] and faces [20, 3] of an icosahedron."""
    g = (1.0 + 5.0**0.5) / 2.0
    v = np.array(
        [
            (-1, g, 0),
            (1, g, 0),
            (-1, -g, 0),
            (1, -g, 0),
            (0, -1, g),
            (0, 1, g),
            (0, -1, -g),
            (0, 1, -g),
            (g, 0, -1),
            (g, 0, 1),
            (-g, 0, -1),
            (-g, 0, 1),
        ],
        np.float64,
    )
    f = np.array(
        [
            (0, 11, 5),
            (0, 5, 1),
            (0, 1, 7),
            (0, 7, 10),
            (0, 10, 11),
            (1, 5, 9),
            (5, 11, 4),
            (11, 10, 2),
            (10, 7, 6),
            (7, 1, 8),
            (3, 9, 4),
            (3, 4, 2),
            (3, 2, 6),
            (3, 6, 8),
            (3, 8, 9),
            (4, 9, 5),
            (2, 4, 11),
            (6, 2, 10),
            (8, 6, 7),
            (9, 8, 1),
        ]
    )
    return v / np.linalg.norm(v[0]), f


BALL, BALL_FACES = _ball()


def blob(centre: F64, radius: F64, material: int, look: Look, *, levels: int, rough: float = 0.14) -> Piece:
    """An uneven ellipsoid of 20 triangles, shaded smooth."""
    rng = look.generator
    angle = rng.uniform(0.0, 2.0 * np.pi)
    c, s = np.cos(angle), np.sin(angle)
    unit = BALL @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    v = unit * radius * rng.uniform(1 - rough, 1 + rough, (12, 1)) + centre
    return smooth(v, BALL_FACES, unit / radius, material, levels=levels)


def leaves(centre: F64, radius: F64, look: Look, *, count: int, size: float, materials: list[int]) -> Piece:
    """Triangles about `size` m on an ellipsoid, tilted at random, with their outsides away from its centre."""
    rng = look.generator
    k = np.arange(count) + 0.5
    z = 1.0 - 1.85 * k / count  # few leaves at the underside
    angle = np.pi * (1.0 + 5.0**0.5) * k + rng.uniform(0.0, 6.0)
    ring = np.sqrt(np.maximum(1.0 - z * z, 0.0))
    unit = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)
    place = unit * radius * rng.uniform(0.86, 1.08, (count, 1)) + centre
    tilt = unit + 0.75 * rng.normal(size=(count, 3))
    tilt /= np.linalg.norm(tilt, axis=1, keepdims=True)
    tilt *= np.sign((tilt * unit).sum(axis=1, keepdims=True) + 1e-9)
    side = cross(tilt, rng.normal(size=(count, 3)))
    half = size * rng.uniform(0.6, 1.1, (count, 1, 1))
    normal = np.repeat(unit / radius + [0.0, 0.0, 0.15], 3, axis=0)
    # the upper leaves catch more light: lighter greens come first in the table
    index = np.clip((0.5 * (1.0 - z) * len(materials) + rng.normal(0.0, 0.9, count)).astype(int), 0, len(materials) - 1)
    return _scraps(place, tilt, side, half, (0.0, 2.0, 4.2), normal, np.array(materials)[index])


def _scraps(  # noqa: PLR0917
    place: F64, out: F64, side: F64, half: F64 | float, turns: tuple[float, ...], normal: F64, material: npt.ArrayLike
) -> Piece:
    """A triangle about each place [n, 3]: across `out` (unit), its corners turned from `side`, `half` m away."""
    side = side / np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-9)
    cos, sin = np.cos(turns)[None, :, None], np.sin(turns)[None, :, None]
    corners = place[:, None] + half * (cos * side[:, None] + sin * cross(out, side)[:, None])
    faces = np.arange(3 * len(place), dtype=np.int32).reshape(-1, 3)
    return smooth(corners.reshape(-1, 3), faces, normal, material, levels=NEAR)


def _greens(kind: str, look: Look) -> list[int]:
    """Three greens of a kind, light to dark."""
    table = list(look.palette.table)
    chosen = look.generator.choice(look.leaves[kind], 3, replace=False).tolist()
    return sorted(chosen, key=lambda i: -sum(table[i].colour))


def tree(kind: str, look: Look) -> Piece:
    """A tree of a kind (round, tall, birch, conifer), its trunk at the origin; 5 to 14 m tall."""
    rng = look.generator
    if kind == "conifer":
        return _conifer(look)
    greens = _greens(kind, look)
    dark = look.palette.shade(greens[-1], 0.6)
    tall = {"round": rng.uniform(6.0, 9.5), "tall": rng.uniform(9.0, 13.5), "birch": rng.uniform(7.5, 11.0)}[kind]
    share = {"round": (0.34, 0.36), "tall": (0.15, 0.42), "birch": (0.20, 0.36)}[kind]
    radius = np.array([share[0], share[0], share[1]]) * tall * rng.uniform(0.9, 1.12, 3)
    middle = np.array([0.0, 0.0, tall - radius[2]])
    thick = 0.020 * tall if kind != "birch" else 0.013 * tall
    bark = look.bark[1] if kind == "birch" else look.bark[0]
    parts = [
        cylinder((thick, 0.55 * thick), (-0.1, 0.75 * tall), bark, sides=6, levels=VISIBLE),
        cylinder((thick, 0.6 * thick), (-0.1, 0.6 * tall), bark, sides=3, levels=FAR),
        blob(middle, 0.98 * radius, greens[1], look, levels=FAR, rough=0.1),
    ]
    lobes = {"round": 3, "tall": 2, "birch": 3}[kind]
    count = {"round": 32, "tall": 38, "birch": 26}[kind]
    for k in range(lobes):
        angle = 2.0 * np.pi * k / lobes + rng.uniform(-0.5, 0.5)
        up = (k / max(lobes - 1, 1) - 0.5) * 0.7
        shift = np.array([0.42 * np.cos(angle), 0.42 * np.sin(angle), up]) * radius
        size = radius * rng.uniform(0.6, 0.75, 3) * ([1.0, 1.0, 1.0] if kind == "round" else [1.15, 1.15, 0.95])
        parts.append(blob(middle + shift, 0.9 * size, dark, look, levels=VISIBLE))
        parts.append(leaves(middle + shift, size, look, count=count, size=0.33 * float(size.mean()), materials=greens))
    return join(parts)


def _conifer(look: Look) -> Piece:
    """Whorls of branches as cones with ragged rims."""
    rng, greens = look.generator, _greens("conifer", look)
    tall = rng.uniform(7.5, 13.0)
    wide = tall * rng.uniform(0.17, 0.24)
    parts = [
        cylinder((0.018 * tall, 0.012 * tall), (-0.1, 0.3 * tall), look.bark[0], sides=5, levels=NEAR | MID | FAR),
        cylinder((wide, 0.0), (0.14 * tall, tall), greens[1], sides=6, levels=FAR),
    ]
    whorls, sides = 6, 9
    for k in range(whorls):
        low, high = (0.12 + 0.84 * k / whorls) * tall, (0.12 + 0.84 * (k + 1.75) / whorls) * tall
        radius = wide * (1.0 - 0.86 * k / whorls)
        angle = (np.arange(sides) + rng.uniform()) * 2.0 * np.pi / sides
        reach = radius * rng.uniform(0.7, 1.1, sides)
        rim = np.column_stack(
            [reach * np.cos(angle), reach * np.sin(angle), low + 0.05 * tall * rng.uniform(-0.5, 0.5, sides)]
        )
        v = np.vstack([rim, [[0.0, 0.0, min(high, tall)]]])
        i = np.arange(sides)
        up = np.column_stack([np.cos(angle), np.sin(angle), np.full(sides, 0.6)])
        parts.append(
            smooth(
                v,
                np.stack([i, (i + 1) % sides, np.full(sides, sides)], 1),
                np.vstack([up, [[0, 0, 1]]]),
                greens[k % 2],
                levels=VISIBLE,
            )
        )
        under = np.vstack([rim, [[0.0, 0.0, low + 0.3 * radius]]])
        inwards = np.stack([(i + 1) % sides, i, np.full(sides, sides)], 1)
        down = np.broadcast_to([0.0, 0.0, -1.0], under.shape)
        parts.append(smooth(under, inwards, down, look.palette.shade(greens[2], 0.6), levels=NEAR))
    return join(parts)


def bush(look: Look) -> Piece:
    """A bush about 1.2 m tall."""
    rng = look.generator
    greens = _greens(str(rng.choice(["round", "tall", "birch"])), look)
    radius = np.array([0.7, 0.7, 0.6]) * rng.uniform(0.8, 1.2, 3)
    centre = np.array([0.0, 0.0, 0.85 * radius[2]])
    return join(
        [
            blob(centre, 0.92 * radius, look.palette.shade(greens[-1], 0.7), look, levels=VISIBLE),
            leaves(centre, radius, look, count=36, size=0.22, materials=greens),
        ]
    )


def hedge(look: Look, material: int) -> Piece:
    """A metre of hedge along x, 0.7 m thick and 1 m tall; scale it."""
    rng = look.generator
    light = look.palette.shade(material, 1.5)
    parts = [box((-0.52, -0.33, -0.1), (0.52, 0.33, 0.97), material, levels=VISIBLE)]
    count = 15
    place = np.column_stack(
        [rng.uniform(-0.5, 0.5, count), rng.choice([-0.34, 0.34], count), rng.uniform(0.05, 1.0, count)]
    )
    place[::3, 1], place[::3, 2] = rng.uniform(-0.33, 0.33, len(place[::3])), 0.98
    out = np.column_stack([np.zeros(count), np.sign(place[:, 1]), np.zeros(count)])
    out[::3] = 0.0, 0.0, 1.0
    tilt = out + 0.5 * rng.normal(size=(count, 3))
    tilt /= np.linalg.norm(tilt, axis=1, keepdims=True)
    side = cross(tilt, [0.3, 0.2, 0.9])
    index = np.where(rng.random(count) < 0.5, light, material)
    parts.append(_scraps(place, tilt, side, 0.12, (0.0, 2.1, 4.2), np.repeat(out, 3, axis=0), index))
    return join(parts)
