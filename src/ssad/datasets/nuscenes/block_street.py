"""A made-up street for the tiny data set: what stands and moves on it, as coloured blocks in the street's own frame.

Street frame: x along the street, y left, z up, metres, the ego's lane at y = -1.75. Everything repeats in blocks of
`BLOCK` metres along x, so that a drive may be as long as it likes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from ssad.core.types import F64, U8

BLOCK: Final = 48.0
PIXEL: Final = 0.05  # m of the ground texture
HALF: Final = 24.0  # m of the ground texture left and right of the centre line
EGO_LANE: Final = -1.75
EGO_SPEED: Final = 7.0

Colour = tuple[int, int, int]
Place = tuple[float, float, float]  # x, y, yaw


@dataclass(frozen=True, slots=True)
class Part:
    """A block of a thing: low and high corner in its frame (x forward, y left, z up from the ground).

    taper: size of the top as a share of the bottom; layer: parts of a higher layer stand on those of a lower one.
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    side: Colour
    top: Colour
    taper: float = 1.0
    layer: int = 0


@dataclass(frozen=True, slots=True)
class Decal:
    """Flat quads [K, 4, 3] on a face of a thing, drawn when the face with outward `normal` is seen."""

    quads: F64
    normal: tuple[float, float, float]
    colour: Colour


@dataclass(frozen=True, slots=True)
class BlockObject:
    """Something on the street: where it is at time 0, its speed m/s along its heading, how it looks.

    size (width, length, height) encloses all parts. Buildings have no category and are not annotated.
    """

    key: str
    category: str
    attribute: str
    size: tuple[float, float, float]
    start: Place
    speed: float
    parts: tuple[Part, ...]
    decals: tuple[Decal, ...] = ()

    def at(self, seconds: float) -> Place:
        """x, y, yaw at a time."""
        way = self.speed * seconds
        x, y, yaw = self.start
        return x + way * math.cos(yaw), y + way * math.sin(yaw), yaw


def ego_place(seconds: float) -> Place:
    """x, y, yaw of the ego: along its lane, a little left and right."""
    swing, rate = 0.2, 0.5
    y = EGO_LANE + swing * math.sin(rate * seconds)
    return EGO_SPEED * seconds, y, math.atan2(swing * rate * math.cos(rate * seconds), EGO_SPEED)


def make_street(
    random: np.random.Generator, *, seconds: float
) -> tuple[tuple[BlockObject, ...], tuple[BlockObject, ...]]:
    """Objects (8 to 12 about the start, more along a longer drive) and buildings."""
    things = list(_moving(random))
    blocks = range(1 + int((EGO_SPEED * seconds + 20.0) // BLOCK))
    for block in blocks:
        things += _standing(random, block, limit=12 - len(things) if block == 0 else 6)
    buildings = [_building(random, block, side, slot) for block in range(-2, blocks[-1] + 4)
                 for side in (-1, 1) for slot in range(4)]  # fmt: skip
    return tuple(things), tuple(buildings)


def _moving(random: np.random.Generator) -> list[BlockObject]:
    jitter = random.uniform(-1.5, 1.5, 5)
    things = [
        car("car-ahead", random, (15.0 + jitter[0], EGO_LANE, 0.0), 8.0),
        car("car-oncoming", random, (31.0 + jitter[1], 1.75, math.pi), 9.0),
        rider("bicycle", random, (8.5 + jitter[2], -4.1, 0.0), 4.0),
        person("walker", random, (11.0 + jitter[3], -8.6, 0.0), 1.4),
    ]
    if random.random() < 0.5:
        things.append(bus("bus", (-15.0 + jitter[4], 1.75, math.pi), 8.0))
    else:
        things.append(car("car-behind", random, (-13.0 + jitter[4], EGO_LANE, 0.0), 7.0))
    return things


def _standing(random: np.random.Generator, block: int, *, limit: int) -> list[BlockObject]:
    start, name = BLOCK * block, f"{block}"
    shift = random.uniform(-1.0, 1.0, 7)
    slots = [
        car(f"car-right-{name}", random, (start + 19.0 + shift[0], -5.9, 0.0)),
        car(f"car-left-{name}", random, (start - 5.5 + shift[1], 5.9, math.pi)),
        person(f"stander-{name}", random, (start + 5.0 + 2.0 * shift[2], 8.4, -math.pi / 2)),
        truck(f"truck-{name}", random, (start + 23.5 + 1.5 * shift[3], 5.6, math.pi)),
        cone(f"cone-{name}", (start + 9.5 + 0.5 * shift[4], 4.6, 0.0)),
        barrier(f"barrier-{name}", (start + 11.5, 5.3 + 0.3 * shift[5], math.pi / 2)),
        motorcycle(f"motorcycle-{name}", random, (start - 8.0 + shift[6], -6.2, 0.0)),
    ]
    chosen = sorted(random.permutation(len(slots))[: min(limit, 4 + int(random.integers(0, 4)))])
    return [slots[i] for i in chosen]


def _box(
    extent: tuple[float, float, float, float], side: Colour, *, top: Colour | None = None, at: float = 0.0,
    taper: float = 1.0, layer: int = 0,
) -> Part:  # fmt: skip
    """A part from length, width, low and high edge; `at` is the x of its middle."""
    length, width, low, high = extent
    lower = (at - length / 2, -width / 2, low)
    return Part(lower, (at + length / 2, width / 2, high), side, top or side, taper, layer)


def _wheels(width: float, places: tuple[float, ...], radius: float) -> tuple[Decal, ...]:
    """Octagons, as two quads each, on both sides."""
    turn = np.arange(8) * math.pi / 4 + math.pi / 8
    decals = []
    for side in (1.0, -1.0):
        ring = np.stack([radius * np.cos(turn), np.zeros(8), radius + radius * np.sin(turn)], axis=1)
        rims = [ring + np.array((x, side * (width / 2 + 0.01), 0.02)) for x in places]
        quads = np.array([rim[list(rows)] for rim in rims for rows in ((0, 1, 2, 3), (0, 3, 4, 7), (4, 5, 6, 7))])
        decals.append(Decal(quads, (0.0, side, 0.0), (25, 25, 28)))
    return tuple(decals)


def _patch(face: float, y: float, z: float, width: float, height: float) -> F64:
    """A quad on the front (face > 0) or the back, seen along x."""
    corners = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    return np.array([[face, y + a * width / 2, z + b * height / 2] for a, b in corners])


def _lights(length: float, width: float, height: float) -> tuple[Decal, ...]:
    ends = length / 2 + 0.01
    quads = [np.array([_patch(x, s * (width / 2 - 0.25), height, 0.36, 0.16) for s in (-1, 1)]) for x in (ends, -ends)]
    plate = np.array([_patch(-ends, 0.0, height - 0.25, 0.5, 0.12)])
    return (
        Decal(quads[0], (1.0, 0.0, 0.0), (245, 240, 205)),
        Decal(quads[1], (-1.0, 0.0, 0.0), (190, 25, 20)),
        Decal(plate, (-1.0, 0.0, 0.0), (225, 225, 220)),
    )


PAINTS: Final[tuple[Colour, ...]] = (
    (172, 32, 30), (38, 74, 142), (205, 206, 208), (52, 54, 60), (150, 152, 156), (34, 92, 66), (214, 170, 60),
)  # fmt: skip
GLASS: Final[Colour] = (44, 56, 68)


def _paint(random: np.random.Generator) -> Colour:
    return PAINTS[int(random.integers(len(PAINTS)))]


def car(key: str, random: np.random.Generator, place: Place, speed: float = 0.0) -> BlockObject:
    """A car: body, cabin with dark windows, wheels and lights."""
    paint, length, width = _paint(random), 4.5, 1.85
    parts = (
        _box((length - 0.1, width - 0.1, 0.22, 0.88), paint),
        _box((2.5, width - 0.2, 0.88, 1.46), GLASS, top=paint, at=-0.25, taper=0.74, layer=1),
    )
    decals = (*_wheels(width - 0.1, (1.38, -1.38), 0.32), *_lights(length - 0.1, width - 0.1, 0.68))
    state = "vehicle.moving" if speed else "vehicle.parked"
    return BlockObject(key, "vehicle.car", state, (width, length, 1.5), place, speed, parts, decals)


def bus(key: str, place: Place, speed: float) -> BlockObject:
    """A city bus with a band of windows."""
    length, width, height = 11.0, 2.6, 3.2
    parts = (
        _box((length - 0.1, width - 0.1, 0.3, 1.3), (196, 142, 32)),
        _box((length - 0.1, width - 0.1, 1.3, 2.5), GLASS, layer=1),
        _box((length - 0.1, width - 0.1, 2.5, height - 0.05), (196, 142, 32), top=(225, 225, 220), layer=2),
    )
    decals = (*_wheels(width - 0.1, (3.6, -3.3), 0.48), *_lights(length - 0.1, width - 0.1, 0.7))
    return BlockObject(key, "vehicle.bus.rigid", "vehicle.moving", (width, length, height), place, speed, parts, decals)


def truck(key: str, random: np.random.Generator, place: Place) -> BlockObject:
    """A parked truck: cab and box body."""
    paint, length, width, height = _paint(random), 7.2, 2.4, 3.1
    parts = (
        _box((1.8, width - 0.2, 0.4, 1.4), paint, at=length / 2 - 0.95),
        _box((1.8, width - 0.2, 1.4, 2.35), GLASS, top=paint, at=length / 2 - 0.95, taper=0.88, layer=1),
        _box((5.1, width - 0.06, 0.6, height - 0.04), (222, 222, 216), at=-1.0),
    )
    decals = (*_wheels(width - 0.06, (2.5, -2.2), 0.45), *_lights(length - 0.1, width - 0.2, 0.8)[:1])
    size = (width, length, height)
    return BlockObject(key, "vehicle.truck", "vehicle.parked", size, place, 0.0, parts, decals)


def person(key: str, random: np.random.Generator, place: Place, speed: float = 0.0) -> BlockObject:
    """A pedestrian: legs, body, head."""
    parts = (
        _box((0.30, 0.36, 0.02, 0.86), (40, 46, 66)),
        _box((0.30, 0.52, 0.86, 1.46), _paint(random), layer=1, taper=0.85),
        _box((0.22, 0.22, 1.46, 1.74), (196, 150, 120), top=(60, 44, 34), layer=2),
    )
    state = "pedestrian.moving" if speed else "pedestrian.standing"
    return BlockObject(key, "human.pedestrian.adult", state, (0.6, 0.6, 1.78), place, speed, parts)


def _two_wheels(length: float, radius: float, frame: Colour) -> tuple[Part, ...]:
    wheel, tyre = length / 2 - radius - 0.03, (24, 24, 26)
    return (
        _box((2 * radius, 0.1, 0.02, 2 * radius), tyre, at=wheel),
        _box((2 * radius, 0.1, 0.02, 2 * radius), tyre, at=-wheel),
        _box((length - 3 * radius, 0.16, radius, 0.85), frame, layer=1),
        _box((0.08, 0.56, 0.85, 0.98), tyre, at=wheel - 0.15, layer=2),
    )


def rider(key: str, random: np.random.Generator, place: Place, speed: float) -> BlockObject:
    """A bicycle with its rider."""
    parts = (
        *_two_wheels(1.75, 0.33, (120, 30, 34)),
        _box((0.34, 0.30, 0.86, 1.05), (36, 40, 60), at=-0.2, layer=3),
        _box((0.36, 0.44, 1.05, 1.55), _paint(random), at=-0.1, taper=0.85, layer=4),
        _box((0.2, 0.2, 1.55, 1.8), (230, 226, 90), at=0.02, layer=5),
    )
    return BlockObject(key, "vehicle.bicycle", "cycle.with_rider", (0.62, 1.8, 1.84), place, speed, parts)


def motorcycle(key: str, random: np.random.Generator, place: Place) -> BlockObject:
    """A parked motorcycle."""
    parts = _two_wheels(2.05, 0.34, _paint(random))
    return BlockObject(key, "vehicle.motorcycle", "cycle.without_rider", (0.7, 2.1, 1.1), place, 0.0, parts)


def cone(key: str, place: Place) -> BlockObject:
    """A traffic cone with a white band."""
    orange, white = (226, 92, 24), (236, 236, 232)
    parts = (
        _box((0.38, 0.38, 0.01, 0.05), orange),
        _box((0.26, 0.26, 0.05, 0.34), orange, taper=0.75, layer=1),
        _box((0.195, 0.195, 0.34, 0.5), white, taper=0.75, layer=2),
        _box((0.146, 0.146, 0.5, 0.7), orange, taper=0.4, layer=3),
    )
    return BlockObject(key, "movable_object.trafficcone", "", (0.4, 0.4, 0.74), place, 0.0, parts)


def barrier(key: str, place: Place) -> BlockObject:
    """A striped road barrier; its length lies across its heading, as in the original."""
    width, red = 2.4, (190, 40, 34)
    parts = (
        _box((0.1, 0.12, 0.02, 0.5), (90, 90, 94)),
        _box((0.12, width - 0.1, 0.5, 1.0), (236, 236, 232), layer=1),
    )
    edges = np.linspace(-width / 2 + 0.06, width / 2 - 0.06, 9)
    stripes = []
    for face in (0.07, -0.07):
        pairs = zip(edges[:-1:2], edges[1::2], strict=True)
        quads = np.array([[(face, a, 0.5), (face, b, 0.5), (face, b, 1.0), (face, a, 1.0)] for a, b in pairs])
        stripes.append(Decal(quads, (math.copysign(1.0, face), 0.0, 0.0), red))
    size = (width, 0.5, 1.05)
    return BlockObject(key, "movable_object.barrier", "", size, place, 0.0, parts, tuple(stripes))


def _building(random: np.random.Generator, block: int, side: int, slot: int) -> BlockObject:
    """A house at the pavement, windows on the faces that the street sees."""
    width, depth = random.uniform(9.0, 11.6), 9.0
    floors = int(random.integers(2, 6))
    height = 3.1 * floors + 0.8
    tone = random.uniform(105, 190)
    warm = random.uniform(-18, 26)
    wall: Colour = (int(min(tone + warm, 255)), int(tone), int(max(tone - warm, 0)))
    x = BLOCK * block + 12.0 * slot + random.uniform(-0.1, 0.1)
    y = side * (11.4 + depth / 2 + random.uniform(0.0, 0.8))
    parts = (Part((-width / 2, -depth / 2, 0.0), (width / 2, depth / 2, height), wall, (90, 84, 80)),)
    glass: Colour = (58, 70, 84) if random.random() < 0.7 else (120, 116, 84)
    decals: list[Decal] = []
    for normal, half, off in (((0, -side, 0), width / 2, depth / 2), ((1, 0, 0), depth / 2, width / 2),
                              ((-1, 0, 0), depth / 2, width / 2)):  # fmt: skip
        number = int((2 * half - 1.2) // 2.3)
        columns = 2.3 * (np.arange(number) - (number - 1) / 2) - 0.65
        quads = []
        for floor in range(floors):
            low = 0.15 if floor == 0 else 3.1 * floor + 1.0
            high = 2.5 if floor == 0 else low + 1.5
            for a in columns:
                corners = ((a, low), (a + 1.3, low), (a + 1.3, high), (a, high))
                quads.append([((u, normal[1] * (off + 0.02)) if normal[1] else (normal[0] * (off + 0.02), u)) + (v,)
                              for u, v in corners])  # fmt: skip
        decals.append(Decal(np.array(quads), normal, glass))
    size = (depth, width, height)
    return BlockObject(f"house-{block}-{side}-{slot}", "", "", size, (x, y, 0.0), 0.0, parts, tuple(decals))


def ground_texture(random: np.random.Generator) -> U8:
    """One block of ground, RGB: row 0 is y = -HALF, column 0 is x = 0, `PIXEL` metres a pixel; it repeats along x."""
    rows, columns = round(2 * HALF / PIXEL), round(BLOCK / PIXEL)
    y = (np.arange(rows) + 0.5) * PIXEL - HALF
    image = np.empty((rows, columns, 3), np.float32)
    reach = np.abs(y)
    image[reach < 7.2] = (84, 84, 88)
    image[(reach >= 7.2) & (reach < 7.5)] = (150, 148, 142)
    image[(reach >= 7.5) & (reach < 11.4)] = (132, 126, 120)
    image[reach >= 11.4] = (92, 102, 74)
    grain = random.normal(0.0, 5.0, (rows, columns)).astype(np.float32)
    blotch = random.normal(0.0, 9.0, (rows // 32, columns // 32)).astype(np.float32)
    blotch = np.kron(blotch, np.ones((32, 32), np.float32))
    blotch = np.mean([np.roll(blotch, (a, b), (0, 1)) for a in (-12, 0, 12) for b in (-12, 0, 12)], axis=0)
    image += (grain + blotch[:rows, :columns])[..., None]

    def paint(x0: float, x1: float, y0: float, y1: float, colour: Colour) -> None:
        area = image[round((y0 + HALF) / PIXEL) : round((y1 + HALF) / PIXEL), round(x0 / PIXEL) : round(x1 / PIXEL)]
        area[:] = 0.2 * area + 0.8 * np.array(colour, np.float32)

    for middle in (-0.16, 0.16):
        paint(0.0, BLOCK, middle - 0.06, middle + 0.06, (214, 170, 50))
    for start in np.arange(0.0, BLOCK, 12.0):
        for line in (-3.5, 3.5):
            paint(start, start + 4.5, line - 0.075, line + 0.075, (226, 226, 222))
    for edge in (-4.75, 4.75):
        paint(0.0, BLOCK, edge - 0.05, edge + 0.05, (200, 200, 196))
    for bar in np.arange(-6.6, 6.6, 1.2):
        paint(40.0, 43.5, bar, bar + 0.6, (226, 226, 222))
    for joint in np.arange(0.0, BLOCK, 2.0):
        for low in (-11.4, 7.5):
            paint(joint, joint + 0.05, low, low + 3.9, (96, 92, 88))
    return np.clip(image, 0, 255).astype(np.uint8)
