"""Kinds of buildings, drawn by a generator. Frame: x along the front about its middle, y inwards from 0, z up."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import pairwise

import numpy as np

from ssad.rendering.street.facades import (
    VISIBLE,
    Wall,
    balcony,
    block,
    door,
    flat_roof,
    gable,
    grid,
    panes,
    rows,
    walls,
)
from ssad.rendering.street.model import NEAR
from ssad.rendering.street.palette import Look
from ssad.rendering.street.triangles import Piece, box, flat, join

Size = tuple[float, float]  # m: width of the front, depth


def draw_size(kind: str, look: Look) -> Size:
    """Front and depth of a building of a kind, m."""
    front, depth = np.round(look.generator.uniform(*SIZES[kind]), 1).tolist()
    return front, depth


def draw_building(kind: str, size: Size, look: Look) -> Piece:
    """A building of a kind and size (front, depth)."""
    return join(KINDS[kind](size, look))


def _masonry(look: Look) -> int:
    return look.pick(str(look.generator.choice(["plaster", "plaster", "brick"])))


def _chimney(x: float, y: float, top: float, look: Look) -> Piece:
    brick = look.walls["brick"][0]
    return join(
        [
            box((x - 0.35, y - 0.3, top - 1.6), (x + 0.35, y + 0.3, top + 0.7), brick, levels=VISIBLE),
            box(
                (x - 0.2, y - 0.15, top + 0.7), (x + 0.2, y + 0.15, top + 1.0), look.walls["roof_tiles"][0], levels=NEAR
            ),
        ]
    )


def _dormers(count: int, width: float, y: float, z: float, look: Look, *, wall: int, roof: int) -> list[Piece]:
    """Windows that stand out of the front of a roof."""
    parts: list[Piece] = []
    for x in rows(width, count, 1.5).tolist():
        left = x - width / 2
        spans = (left, left + 1.5), (y, y + 2.4), (z, z + 1.5)
        parts.append(block(*spans, wall))
        parts += gable(spans[0], spans[1], z + 1.5, 0.6, roof=roof, wall=wall, across=True, eaves=0.15)
        at = np.array([0.3]), np.array([0.35])
        parts += panes(walls(*spans)[0], *at, (0.9, 0.95), look, frame=look.frame[0], sill=False)
    return parts


def _terrace(size: Size, look: Look, *, shop: bool = False) -> list[Piece]:
    """A house in a row: bare side walls, roof with its ridge along the street."""
    rng, (w, d) = look.generator, size
    storey, floors = rng.uniform(2.8, 3.3), int(rng.integers(2, 5 if look.style.old else 4))
    ground = storey * 1.2 if shop else storey
    h = ground + storey * (floors - 1)
    x, y = (-w / 2, w / 2), (0.0, d)
    material, roof, frame = _masonry(look), look.pick("roof_tiles"), int(rng.choice(look.frame))
    rise = 0.5 * d * rng.uniform(0.65, 1.05)
    turned = look.style.old and rng.random() < 0.25
    parts = [block(x, y, (0.0, h), material)]
    if turned:
        rise = 0.5 * w * rng.uniform(1.0, 1.5)
        parts += gable(x, y, h, rise, roof=roof, wall=material, across=True, eaves=0.12)
    else:
        parts += gable(x, y, h, rise, roof=roof, wall=material, eaves=0.3)
    front, _, back, _ = walls(x, y, (0.0, h))
    window = (rng.uniform(0.85, 1.15), rng.uniform(1.3, 1.7))
    bay = rng.uniform(1.7, 2.3)
    at = float(rng.uniform(1.0, min(2.0, w - 1.0)))
    if shop:
        parts += _shop_front(w, ground, front, look)
        parts += grid(front, floors - 1, storey, look, size=window, bay=bay, frame=frame, ground=ground)
    else:
        parts += door(front, at, look)
        parts += grid(front, floors, storey, look, size=window, bay=bay, frame=frame, skip=np.array([at]))
    parts += grid(back, floors, storey, look, size=window, bay=2.4, frame=frame, sill=False)
    if rng.random() < 0.6:  # bands between the storeys
        level = ground + storey * np.arange(floors - 1)
        parts.append(flat(front.quads(0.0, level - 0.1, w, 0.2, 0.05), look.stone[0], levels=VISIBLE))
    if rng.random() < 0.5 and not shop:
        plinth = look.palette.shade(material, 0.6, "plinth")
        parts.append(flat(front.quads(0.0, 0.0, w, 0.5, 0.03), plinth, levels=VISIBLE))
    if not turned:
        parts.append(_chimney(x[0] + 0.5, d / 2, h + rise, look))
        if rng.random() < 0.4 and rise > 2.6:
            parts += _dormers(int(w // 3), w, 0.18 * d, h + 0.1 * rise, look, wall=material, roof=roof)
    elif rise > 2.5:
        parts += panes(front, np.array([w / 2 - 0.4]), np.array([h + 0.5]), (0.8, 1.0), look, frame=frame)
    return parts


def _shop(size: Size, look: Look) -> list[Piece]:
    return _terrace(size, look, shop=True)


def _shop_front(w: float, ground: float, front: Wall, look: Look) -> list[Piece]:
    """Large windows, a door, a sign board and an awning on the ground floor."""
    rng = look.generator
    trim = look.pick("door")
    at = float(rng.choice([0.9, w - 0.9, w / 2]))
    parts = [flat(front.quads(0.15, 0.0, w - 0.3, ground - 0.35, 0.03), trim, levels=VISIBLE)]
    edges = sorted({0.4, at - 0.65, at + 0.65, w - 0.4})
    for a, b in pairwise(edges):
        if b - a > 0.6 and not (a < at < b):
            glass = int(rng.choice(look.shop))
            parts.append(flat(front.quads(a + 0.08, 0.55, b - a - 0.16, ground - 1.5, 0.05), glass, levels=VISIBLE))
    parts.append(flat(front.quads(at - 0.5, 0.05, 1.0, 2.2, 0.05), look.shop[0], levels=VISIBLE))
    colour = look.pick("awning")
    low, high = (front.quads(0.2, ground - 0.85, w - 0.4, 0.55, away) for away in (0.12, 0.0))
    parts.append(flat(low, colour, levels=VISIBLE))
    parts.append(flat(np.stack([low[:, 3], low[:, 2], high[:, 2], high[:, 3]], axis=1), colour, levels=NEAR))
    parts.append(flat(front.quads(w * 0.3, ground - 0.68, w * 0.4, 0.2, 0.14), look.sign["white"], levels=NEAR))
    if rng.random() < 0.45:
        wall = front.quads(0.3, ground - 0.95, w - 0.6, 0.0, 0.02)
        edge = front.quads(0.3, ground - 1.35, w - 0.6, 0.0, 1.1)
        stripe = look.pick("awning")
        top = np.stack([edge[:, 0], edge[:, 1], wall[:, 1], wall[:, 0]], axis=1)
        parts += [flat(top, stripe, levels=VISIBLE), flat((top - [0, 0, 0.02])[:, ::-1], stripe, levels=VISIBLE)]
        parts.append(flat(front.quads(0.3, ground - 1.55, w - 0.6, 0.2, 1.1), stripe, levels=NEAR))
    return parts


def _house(size: Size, look: Look, *, floors: int = 2) -> list[Piece]:
    """A detached house: gable or hip roof, windows all round, often a lower wing with a garage."""
    rng, (w, d) = look.generator, size
    storey = rng.uniform(2.6, 2.9)
    wing = float(rng.uniform(3.2, 4.2)) if w > 11.0 and rng.random() < 0.75 else 0.0
    side = 1.0 if rng.random() < 0.5 else -1.0
    x = (-w / 2 + (wing if side < 0 else 0.0), w / 2 - (wing if side > 0 else 0.0))
    y, h = (0.0, d), storey * floors
    material = look.pick(str(rng.choice(["plaster", "brick", "boards", "boards"])))
    roof, frame = look.pick("roof_tiles"), int(rng.choice(look.frame))
    across = floors == 2 and rng.random() < 0.35
    half = 0.5 * ((x[1] - x[0]) if across else d)
    rise = half * rng.uniform(0.55, 0.95)
    hip = half * rng.uniform(0.7, 1.0) if rng.random() < 0.35 and not across and x[1] - x[0] > d else 0.0
    parts = [
        block(x, y, (0.0, h), material),
        *gable(x, y, h, rise, roof=roof, wall=material, across=across, eaves=0.5, hip=hip),
    ]
    sides = walls(x, y, (0.0, h))
    window = (rng.uniform(1.1, 1.6), rng.uniform(1.1, 1.35))
    length = sides[0].length
    at = float(rng.choice([0.5 * length, 0.28 * length]))
    parts += door(sides[0], at, look, size=(1.0, 2.05))
    parts += grid(sides[0], floors, storey, look, size=window, bay=2.7, frame=frame, skip=np.array([at]))
    for wall, bay in ((sides[1], 3.6), (sides[2], 2.9), (sides[3], 3.6)):
        parts += grid(wall, floors, storey, look, size=(window[0] * 0.85, window[1]), bay=bay, frame=frame)
    if across and rise > 2.0:
        parts += panes(sides[0], np.array([length / 2 - 0.4]), np.array([h + 0.35]), (0.8, 0.9), look, frame=frame)
    # porch over the door
    px = x[0] + at
    if rng.random() < 0.6:
        porch = (px - 1.0, px + 1.0), (-1.2, 0.1)
        parts += gable(*porch, 2.45, 0.6, roof=roof, wall=look.wood[1], across=True, eaves=0.12)
        posts = np.array([[px - 0.9, -1.1, 0.0], [px + 0.8, -1.1, 0.0]])
        parts.append(box(posts, posts + np.array([0.1, 0.1, 2.4]), look.wood[1], levels=VISIBLE))
    stack = (x[0] + x[1]) / 2 if across else float(rng.uniform(x[0] + 1.0, x[1] - 1.0))
    parts.append(_chimney(stack, d / 2, h + rise, look))
    if wing:
        wx = (w / 2 - wing, w / 2) if side > 0 else (-w / 2, -w / 2 + wing)
        wy = (1.2, min(d, 7.5))
        parts.append(block(wx, wy, (0.0, 2.6), material))
        parts += gable(wx, wy, 2.6, 1.2, roof=roof, wall=material, across=True, eaves=0.25)
        parts += door(walls(wx, wy, (0.0, 2.6))[0], wing / 2, look, size=(2.5, 2.1))
    return parts


def _bungalow(size: Size, look: Look) -> list[Piece]:
    return _house(size, look, floors=1)


def _flats(size: Size, look: Look) -> list[Piece]:
    """A block of flats with balconies."""
    rng, (w, d) = look.generator, size
    storey, floors = 2.9, int(rng.integers(3, 7))
    h = storey * floors
    x, y = (-w / 2, w / 2), (0.0, d)
    material = look.pick(str(rng.choice(["plaster", "plaster", "brick", "cladding"])))
    frame = int(rng.choice(look.frame))
    parts = [block(x, y, (0.0, h), material)]
    sides = walls(x, y, (0.0, h))
    window, bay = (rng.uniform(1.1, 1.7), rng.uniform(1.3, 1.6)), rng.uniform(2.6, 3.3)
    parts += door(sides[0], w / 2, look, size=(1.6, 2.3))
    parts += grid(sides[0], floors, storey, look, size=window, bay=bay, frame=frame, skip=np.array([w / 2]))
    parts += grid(sides[2], floors, storey, look, size=window, bay=bay, frame=frame, sill=False)
    for k in (1, 3):
        parts += grid(sides[k], floors, storey, look, size=(0.9, window[1]), bay=4.5, frame=frame, sill=False)
    count = int(w // bay)
    if count > 2 and rng.random() < 0.75:
        columns = rows(w, count, 2.4)[1 :: max(2, count // 3)]
        columns = columns[(columns > 0.2) & (columns < w - 2.6)]
        xx, zz = (v.reshape(-1) for v in np.meshgrid(columns, storey * np.arange(1, floors)))
        parts += balcony(sides[0], xx, zz, 2.4, look, deep=min(1.2, 0.5 * max(0.8, look.style.setback[0] + 0.8)))
    if rng.random() < 0.55:
        parts += flat_roof(x, y, h, look, coping=look.palette.shade(material, 0.8))
    else:
        parts += gable(x, y, h, 0.25 * d, roof=look.pick("roof_tiles"), wall=material, hip=0.3 * d)
    plinth = look.palette.shade(material, 0.6, "plinth")
    parts.append(flat(sides[0].quads(0.0, 0.0, w, 0.6, 0.03), plinth, levels=VISIBLE))
    return parts


def _office(size: Size, look: Look, *, floors: int | None = None) -> list[Piece]:
    """Offices: bands of glass, a grid of windows or a curtain wall; a glazed ground floor; flat roof."""
    rng, (w, d) = look.generator, size
    storey, n = 3.6, floors or int(rng.integers(3, 8))
    h = storey * n + 0.6
    x, y = (-w / 2, w / 2), (0.0, d)
    material = look.pick(str(rng.choice(["cladding", "cladding", "plaster", "brick"])))
    parts = [block(x, y, (0.0, h), material)]
    sides, manner = walls(x, y, (0.0, h)), str(rng.choice(["bands", "grid", "curtain"]))
    glass, frame = int(rng.choice(look.glass)), int(rng.choice(look.frame[1:]))
    for k, wall in enumerate(sides):
        level = storey * np.arange(1, n) + 0.9
        if manner == "grid":
            parts += grid(wall, n, storey, look, size=(1.5, 1.9), bay=2.4, frame=frame, first=1, sill=False)
        else:
            high = 1.9 if manner == "bands" else storey - 0.25
            low = level if manner == "bands" else level - 0.75
            parts.append(flat(wall.quads(0.4, low, wall.length - 0.8, high, 0.03), glass, levels=VISIBLE))
            bay = 1.5 if manner == "curtain" else 3.0
            bars = np.arange(0.4 + bay, wall.length - 0.5, bay)
            xx, zz = (v.reshape(-1) for v in np.meshgrid(bars, low))
            parts.append(flat(wall.quads(xx, zz, 0.08, high, 0.06), frame, levels=NEAR))
        shop = int(rng.choice(look.shop))
        if k in (0, 1, 3):
            bays = np.arange(0.6, wall.length - 3.0, 3.2)
            parts.append(flat(wall.quads(bays, 0.3, 2.7, 2.7, 0.04), shop, levels=VISIBLE))
    parts.append(flat(sides[0].quads(w / 2 - 1.4, 0.0, 2.8, 2.7, 0.08), look.glass[0], levels=VISIBLE))
    parts.append(box((-2.0, -1.4, 2.9), (2.0, 0.0, 3.15), look.metal, levels=VISIBLE, base=True))
    if rng.random() < 0.7:
        sign = look.pick("awning")
        parts.append(flat(sides[0].quads(w * 0.1, h - 1.0, min(6.0, w * 0.3), 0.8, 0.1), sign, levels=VISIBLE))
    return parts + flat_roof(x, y, h, look, coping=look.palette.shade(material, 0.8), plant=4)


def _tower(size: Size, look: Look) -> list[Piece]:
    return _office(size, look, floors=int(look.generator.integers(9, 15)))


def _hall(size: Size, look: Look) -> list[Piece]:
    """A warehouse: metal sheet, roller doors, a strip of windows, a low roof."""
    rng, (w, d) = look.generator, size
    h = rng.uniform(5.5, 8.5)
    x, y = (-w / 2, w / 2), (0.0, d)
    material, frame = look.pick("sheet"), look.frame[2]
    parts = [block(x, y, (0.0, h), material)]
    parts += gable(x, y, h, 0.07 * d, roof=look.palette.shade(look.flat_roof, 1.8, "sheet"), wall=material, eaves=0.2)
    sides = walls(x, y, (0.0, h))
    count = int(rng.integers(1, 4))
    at = rows(w, count, 4.0, margin=0.1 * w)
    parts.append(flat(sides[0].quads(at, 0.0, 4.0, 4.2, 0.04), look.pick("cladding"), levels=VISIBLE))
    grooves = sides[0].quads(np.repeat(at, 9), np.tile(0.4 + 0.42 * np.arange(9), count), 4.0, 0.03, 0.05)
    parts.append(flat(grooves, frame, levels=NEAR))
    parts += door(sides[0], w - 1.5, look)
    for wall in sides:
        count = max(1, int(wall.length // 6))
        at = rows(wall.length, count, 2.6)
        parts += panes(wall, at, np.full(count, h - 1.3), (2.6, 0.7), look, frame=frame, sill=False)
        parts.append(flat(wall.quads(0.0, 0.0, wall.length, 0.7, 0.02), look.stone[1], levels=VISIBLE))
    sign = look.pick("awning")
    parts.append(flat(sides[0].quads(0.35 * w, h - 2.6, 0.3 * w, 1.1, 0.08), sign, levels=VISIBLE))
    return parts


def _shed(size: Size, look: Look) -> list[Piece]:
    """A garden shed or garage."""
    (w, d), h = size, look.generator.uniform(2.1, 2.7)
    x, y = (-w / 2, w / 2), (0.0, d)
    material = int(look.generator.choice([*look.wood, look.pick("boards")]))
    roof = gable(x, y, h, 0.8, roof=look.pick("roof_tiles"), wall=material, eaves=0.2)
    parts = [block(x, y, (0.0, h), material), *roof]
    return parts + door(walls(x, y, (0.0, h))[0], w / 2, look, size=(min(1.6, w - 0.8), 1.9))


def _chapel(size: Size, look: Look) -> list[Piece]:
    """A church: a nave with a steep roof and a tower with a spire at the front."""
    (w, d), stone = size, int(look.generator.choice(look.stone))
    x, y, h, roof = (-w / 2, w / 2), (4.0, d), 8.0, look.pick("roof_tiles")
    parts = [block(x, y, (0.0, h), stone), *gable(x, y, h, 0.55 * w, roof=roof, wall=stone, across=True, eaves=0.3)]
    tower, top = ((-2.6, 2.6), (0.0, 5.2)), float(look.generator.uniform(16.0, 20.0))
    parts.append(block(*tower, (0.0, top), stone))
    ring = np.array([[-2.9, -0.3], [2.9, -0.3], [2.9, 5.5], [-2.9, 5.5]])
    for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        parts.append(flat(np.array([[[*a, top], [*b, top], [0.0, 2.6, top + 11.0]]]), roof))
    for wall in walls(*tower, (0.0, top)):
        at = np.array([2.0, 2.0]), np.array([7.0, top - 3.6])
        parts += panes(wall, *at, (1.2, 2.4), look, frame=look.stone[0], blinds=0.0)
    for wall in walls(x, y, (0.0, h))[1::2]:
        count = int(wall.length // 3.5)
        at = rows(wall.length, count, 1.1), np.full(count, 2.2)
        parts += panes(wall, *at, (1.1, 3.6), look, frame=look.stone[0], blinds=0.0)
    return parts + door(walls(*tower, (0.0, top))[0], 2.6, look, size=(1.8, 2.9))


KINDS: Mapping[str, Callable[[Size, Look], list[Piece]]] = {
    "terrace": _terrace,
    "shop": _shop,
    "house": _house,
    "bungalow": _bungalow,
    "flats": _flats,
    "office": _office,
    "tower": _tower,
    "hall": _hall,
    "shed": _shed,
    "chapel": _chapel,
}
SIZES: Mapping[str, tuple[Size, Size]] = {  # least and most (front, depth), m
    "terrace": ((5.2, 9.0), (8.5, 12.0)),
    "shop": ((6.0, 9.0), (10.0, 13.0)),
    "house": ((8.5, 7.5), (14.5, 10.0)),
    "bungalow": ((11.0, 8.0), (16.0, 10.0)),
    "flats": ((15.0, 10.0), (26.0, 13.0)),
    "office": ((16.0, 13.0), (32.0, 20.0)),
    "tower": ((18.0, 16.0), (24.0, 20.0)),
    "hall": ((20.0, 16.0), (38.0, 26.0)),
    "shed": ((2.6, 2.2), (4.2, 3.2)),
    "chapel": ((10.0, 24.0), (12.0, 28.0)),
}
