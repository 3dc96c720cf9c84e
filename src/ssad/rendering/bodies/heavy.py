"""Trucks (box, flatbed, tractor, tipper), buses (city, coach, bendy) and trailers (box, flatbed, tank, utility)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ssad.rendering.bodies.parts import (
    BLINKER,
    CARGO,
    CHROME,
    DARK,
    FRAME,
    GLASS,
    HEAD,
    PAINT,
    PLATE,
    SOIL,
    STEEL,
    TAIL,
    TRIM,
    WOOD,
    Chart,
    both_sides,
    crate,
    crates,
    finish,
    shifted,
    side_charts,
    sided,
    tubes,
    wheels,
)
from ssad.rendering.bodies.shell import S1, S2, S3, S4, Shell, axle_x, charts, skin
from ssad.rendering.meshes.mesh import Material, Mesh, Point, box, loft, merge, prism

_BLUNT = ((0.0, 0.93), (0.03, 0.985), (0.08, 1.0), (0.95, 1.0), (1.0, 0.98))
CAB = Shell(
    top=((0.0, 0.93), (0.06, 0.985), (0.25, 1.0), (1.0, 1.0)),
    belt=((0.0, 0.44), (0.3, 0.46), (1.0, 0.50)),
    plan=_BLUNT,
    cowl=0.0,
    screen=0.0,
    roof=1.0,
    deck=1.0,
    windows=((0.06, 0.62),),
    doors=(("front_door", 0.05, 0.72),),
    axles=(0.55, 0.55),
    radius=0.178,
    sill=0.19,
    tumble=0.06,
    body=1.0,
    nose=0.05,
    tail=0.01,
    lamps=(S1, S2),
    lamp_from=0.62,
    grille=(S3, S4),
    tail_lamps=(S4, S4),
    glass_gap=0.04,
    rear_window=False,
    wheel_width=0.3,
)
BUS = Shell(
    top=((0.0, 0.955), (0.012, 0.985), (0.04, 1.0), (0.97, 1.0), (1.0, 0.98)),
    belt=((0.0, 0.33), (0.04, 0.36), (0.09, 0.40), (1.0, 0.40)),
    plan=((0.0, 0.93), (0.01, 0.98), (0.03, 1.0), (0.97, 1.0), (1.0, 0.97)),
    cowl=0.0,
    screen=0.0,
    roof=1.0,
    deck=1.0,
    windows=(
        (0.012, 0.085),
        (0.095, 0.205),
        (0.213, 0.325),
        (0.333, 0.445),
        (0.453, 0.565),
        (0.573, 0.685),
        (0.693, 0.805),
        (0.813, 0.94),
    ),
    doors=(("front_door", 0.012, 0.090), ("rear_door", 0.452, 0.566)),
    axles=(0.225, 0.735),
    radius=0.146,
    sill=0.095,
    tumble=0.035,
    body=0.90,
    nose=0.018,
    tail=0.008,
    lamps=(S1, S3),
    lamp_from=0.62,
    tail_lamps=(S1, S4),
    tail_from=0.82,
    grille=(S4, S4),
    glass_gap=0.03,
    wheel_width=0.3,
)


def truck(style: str, size: Point, *, generator: np.random.Generator, detail: int) -> Mesh:
    """A truck of a style that fills its size, m: cab over the front axle, frame, and what it carries."""
    length, width, height = size
    share, load = generator.random(2)
    cab_height = height * {"box": 0.78, "flatbed": 0.97, "tractor": 0.97, "tipper": 0.90}[style] - 0.08 * share
    cab_length = min(2.35, 0.32 * length) * (1.0 + 0.1 * (share - 0.5))
    body = 0.92 * width
    cab_size = (cab_length, body, cab_height)
    shell = replace(CAB, radius=min(0.50, 0.19 * cab_height) / cab_height)
    radius = shell.radius * cab_height
    shift = 0.5 * (length - cab_length)
    parts = [skin(shell, cab_size, detail=detail).moved(shift)]
    panels = [shifted(c, shift) for c in charts(shell, cab_size)]
    rear, back, deck = -0.5 * length, 0.5 * length - cab_length - 0.08, 2.05 * radius
    parts.append(crate((rear + 0.05, -0.42, 0.75 * radius), (back + 0.4, 0.42, deck), FRAME))
    front_axle = axle_x(shell, cab_size, 0.55) + shift
    behind = [rear + 0.20 * length] if length < 8.0 and style != "tractor" else [rear + 1.0, rear + 1.0 + 2.3 * radius]
    parts.append(wheels([(front_axle, 0.5 * body - 0.01)], radius, 0.30, detail=detail, spokes=10, steel=STEEL))
    parts.append(wheels([(x, 0.5 * body - 0.03) for x in behind], radius, 0.55, detail=detail, spokes=10, steel=STEEL))
    parts += _cab_fittings(0.5 * length, size, cab_size, detail)
    half = 0.5 * width
    if style == "box":
        parts.append(_cargo((rear, -half, deck), (back, half, height)))
        panels += side_charts("cargo", (rear, -half, deck), (back, half, height))
        if detail > 0:
            parts.append(_doors(rear, half, deck, height))
        if detail == 2:
            parts.append(_ribs((rear, -half, deck), (back, half, height)))
    elif style == "flatbed":
        parts.append(crate((rear, -half, deck - 0.02), (back, half, deck + 0.14), WOOD))
        parts.append(crate((back - 0.08, -half, deck), (back, half, deck + 0.9), STEEL))
        if detail > 0:
            stakes = [
                crate((x, half - 0.05, deck), (x + 0.07, half, deck + 0.55), STEEL)
                for x in np.linspace(rear, back - 1.0, 5)
            ]
            parts.append(both_sides(merge(stakes)))
        if load > 0.4:
            high = (back - 0.5, 0.8 * half, min(height, deck + 1.4))
            parts += _load((rear + 0.4, -0.8 * half, deck + 0.14), high, generator=generator)
    elif style == "tractor":
        plate = prism([(-0.55, -0.5), (0.55, -0.5), (0.55, 0.5), (-0.55, 0.5)], (deck, deck + 0.12), material=FRAME)
        parts.append(plate.moved(behind[0] + 0.5))
        tanks = [(back - 0.9, half - 0.35, 0.62), (back - 2.1, half - 0.35, 0.62)]
        parts.append(tubes(tanks, 0.3, CHROME, 12))
        guard = (rear, half - 0.62, 2.0 * radius + 0.03), (behind[-1] + radius, half - 0.06, 2.0 * radius + 0.07)
        parts.append(crates(*guard, TRIM))
        shield = [(back + 0.2, cab_height - 0.05), (0.5 * length - 0.35, cab_height - 0.05), (back + 0.2, height)]
        parts.append(prism(shield, (-0.42 * body, 0.42 * body), axis=1, material=PAINT).with_panel("roof"))
    else:
        top = min(height, deck + 1.35)
        lower = [(rear, deck + 0.35), (rear + 0.5, deck + 0.05), (back, deck + 0.05)]
        outline = [*lower, (back, height), (back - 0.12, top), (rear, top)]
        tub = prism(outline, (-half, half), axis=1, material=PAINT)
        parts.append(sided(tub, "cargo"))
        panels += side_charts("cargo", (rear, -half, deck), (back, half, height))
        parts.append(crate((rear + 0.1, 0.1 - half, top - 0.1), (back - 0.25, half - 0.1, top + 0.02), SOIL))
        parts.append(crate((back, -0.9 * half, height - 0.06), (back + 0.75, 0.9 * half, height), STEEL))
        ribs = [
            crate((x, half - 0.02, deck + 0.3), (x + 0.1, half + 0.03, top - 0.02), STEEL)
            for x in np.linspace(rear + 0.5, back - 0.5, 5)
        ]
        parts.append(both_sides(merge(ribs)))
    parts += _rear_fittings(rear, half, 0.95 * radius, detail)
    return finish(parts, panels, size)


def _cab_fittings(front: float, size: Point, cab: Point, detail: int) -> list[Mesh]:
    """Mirrors, plate and indicators of a cab-over front."""
    half, inner = 0.5 * size[1], 0.5 * cab[1]
    mirror = crate((front - 0.30, inner - 0.02, 0.56 * cab[2]), (front - 0.16, half, 0.80 * cab[2]), TRIM)
    parts = [both_sides(mirror)]
    if detail > 0:
        parts.append(_plate(front - 0.005, 0.29 * cab[2]))
        blinker = (front - 0.1, 0.43 * cab[1], 0.40 * cab[2]), (front - 0.05, 0.47 * cab[1], 0.44 * cab[2])
        parts.append(crates(*blinker, BLINKER))
        grille = (front - 0.1, -0.26 * cab[1], 0.25 * cab[2]), (front - 0.008, 0.26 * cab[1], 0.27 * cab[2])
        parts.append(crate(*grille, TRIM))
        surround = (front - 0.12, 0.29 * cab[1], 0.205 * cab[2]), (front - 0.012, 0.465 * cab[1], 0.305 * cab[2])
        parts.append(crates(*surround, TRIM))
    lamp = (front - 0.1, 0.31 * cab[1], 0.22 * cab[2]), (front - 0.005, 0.45 * cab[1], 0.29 * cab[2])
    parts.append(crates(*lamp, HEAD))
    return parts


def _rear_fittings(rear: float, half: float, z: float, detail: int) -> list[Mesh]:
    """Tail lamps, under-run bar, plate and mud flaps (which hide the lamps from the front)."""
    parts = [crates((rear, 0.62 * half, z), (rear + 0.06, 0.95 * half, z + 0.14), TAIL)]
    if detail > 0:
        parts.append(crate((rear + 0.03, -0.95 * half, z - 0.25), (rear + 0.12, 0.95 * half, z - 0.12), STEEL))
        parts.append(_plate(rear + 0.01, z + 0.07))
        flap = (rear + 0.06, 0.60 * half, z - 0.35), (rear + 0.08, 0.97 * half, z + 0.15)
        parts.append(crates(*flap, TRIM))
    return parts


def _doors(rear: float, half: float, low: float, high: float) -> Mesh:
    """Rear doors of a cargo box: the gap between them, their bars and hinges, marker lamps over them."""
    gap = crate((rear - 0.002, -0.012, low + 0.06), (rear + 0.01, 0.012, high - 0.06), TRIM)
    rods = [
        crate((rear - 0.004, y * half, low + 0.05), (rear + 0.01, y * half + 0.03, high - 0.05), STEEL)
        for y in (0.16, 0.52)
    ]
    hinges = [
        crate((rear - 0.004, 0.86 * half, z), (rear + 0.01, 0.97 * half, z + 0.05), STEEL)
        for z in np.linspace(low + 0.2, high - 0.3, 3)
    ]
    marker = crate((rear - 0.004, 0.84 * half, high - 0.10), (rear + 0.01, 0.96 * half, high - 0.04), TAIL)
    return merge([gap, both_sides(merge([*rods, *hinges, marker]))])


def _plate(x: float, z: float) -> Mesh:
    """A number plate."""
    return box((0.02, 0.52, 0.12), material=PLATE, centre=(x, 0.0, z))


def _cargo(low: Point, high: Point, material: Material = CARGO) -> Mesh:
    """A closed cargo box with panels on five sides."""
    return crate(low, high, material, {side: f"cargo_{side}" for side in ("front", "rear", "left", "right", "top")})


def _ribs(low: Point, high: Point) -> Mesh:
    """Metal edges of a cargo box, flush with its sides."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    edge = 0.07
    posts = [(x0, y1 - edge, z0, x0 + edge, y1, z1), (x1 - edge, y1 - edge, z0, x1, y1, z1)]
    rails = [(x0, y1 - edge, z, x1, y1, z + edge) for z in (z0, z1 - edge)]
    grow = 0.004
    bars = [crate((a, b, c), (d, e + grow, f), STEEL) for a, b, c, d, e, f in posts + rails]
    across = [crate((x0 - grow, y0, z), (x0 + edge, y1, z + edge), STEEL) for z in (z0, z1 - edge)]
    return merge([both_sides(merge(bars)), *across])


def _load(low: Point, high: Point, *, generator: np.random.Generator) -> list[Mesh]:
    """Three loads on an open deck."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    shades = generator.uniform(0.06, 0.4, (3, 1)) * np.array([1.0, 0.85, 0.68]) ** generator.uniform(-0.6, 1.6, (3, 1))
    cuts = np.linspace(x0, x1, 4)
    heights = z0 + (z1 - z0) * generator.uniform(0.5, 1.0, 3)
    return [
        crate((a, y0, z0), (b - 0.15, y1, float(h)), Material(f"load_{k}", (float(c[0]), float(c[1]), float(c[2]))))
        for k, (a, b, h, c) in enumerate(zip(cuts[:-1], cuts[1:], heights, shades, strict=True))
    ]


def bus(style: str, size: Point, *, generator: np.random.Generator, detail: int) -> Mesh:
    """A bus of a style (city, coach, bendy) that fills its size, m. Passenger doors are on the right."""
    length, width, height = size
    stripe = generator.random()
    if style == "bendy":
        return _bendy(size, detail)
    shell = (
        BUS
        if style == "city"
        else replace(
            BUS,
            belt=((0.0, 0.36), (0.05, 0.40), (0.10, 0.50), (1.0, 0.50)),
            sill=0.105,
            tail_from=0.8,
            top=((0.0, 0.93), (0.02, 0.985), (0.06, 1.0), (0.97, 1.0), (1.0, 0.97)),
        )
    )
    roof = 0.955 if style == "city" else 1.0
    lower = (length, width, height * roof)
    parts = [skin(shell, lower, detail=detail)]
    parts += _bus_fittings(shell, lower, detail, rear=True)
    if style == "city":
        parts.append(crate((-0.12 * length, -0.3 * width, 0.94 * height), (0.16 * length, 0.3 * width, height), CARGO))
    if stripe > 0.5 and detail > 0:
        skirt = 0.5 * width * shell.body + 0.003
        band = (-0.44 * length, skirt - 0.02, 0.30 * height), (0.43 * length, skirt, 0.325 * height)
        parts.append(crates(*band, TRIM))
    return finish(parts, charts(shell, lower), size)


def _bus_fittings(shell: Shell, size: Point, detail: int, *, rear: bool, front: bool = True) -> list[Mesh]:
    """Wheels, doors, mirrors, destination sign, plate."""
    length, width, height = size
    radius, side = shell.radius * height, 0.5 * width * shell.body
    axles = dict.fromkeys(shell.axles)
    places = [(axle_x(shell, size, a), side - 0.02) for a in axles]
    parts = [wheels(places, radius, 0.30, detail=detail, spokes=10, steel=STEEL)]
    if detail > 0:
        for _, a, b in shell.doors:
            x1, x0 = axle_x(shell, size, a), axle_x(shell, size, b)
            cut = 0.5 * (x0 + x1)
            for s, e in ((x0 + 0.03, cut - 0.02), (cut + 0.02, x1 - 0.03)):
                parts.append(crate((s, -side - 0.006, 0.11 * height), (e, -side + 0.15, 0.78 * height), GLASS))
    if front:
        x = 0.5 * length
        parts.append(crates((x - 0.15, side - 0.05, 0.56 * height), (x - 0.02, 0.5 * width, 0.72 * height), TRIM))
        if detail > 0:
            sign = crate((x - 0.10, -0.62 * side, 0.875 * height), (x - 0.012, 0.62 * side, 0.945 * height), TRIM)
            amber = Material("sign_lamp", (0.55, 0.30, 0.03), emission=0.6)
            text = crate((x - 0.05, -0.45 * side, 0.895 * height), (x - 0.006, 0.35 * side, 0.925 * height), amber)
            parts += [sign, text, _plate(x - 0.004, 0.16 * height)]
    if rear:
        x = -0.5 * length
        if detail > 0:
            parts.append(crate((x, -0.6 * side, 0.15 * height), (x + 0.08, 0.6 * side, 0.30 * height), TRIM))
        else:
            parts.append(crates((x, 0.75 * side, 0.2 * height), (x + 0.05, 0.97 * side, 0.3 * height), TAIL))
    if front and detail == 0:
        x = 0.5 * length
        parts.append(crates((x - 0.06, 0.62 * side, 0.15 * height), (x, 0.93 * side, 0.22 * height), HEAD))
    return parts


def _bendy(size: Point, detail: int) -> Mesh:
    """Two sections of an articulated bus with bellows between them."""
    length, width, height = size
    ahead, behind, gap = 0.55 * length, 0.40 * length, 0.05 * length
    first = replace(BUS, axles=(0.25, 0.80), rear_window=False, tail_lamps=(S4, S4))
    second = replace(
        BUS,
        windows=BUS.windows[1:],
        axles=(0.60, 0.60),
        lamps=(S4, S4),
        screen=0.03,
        cowl=0.0,
        plan=((0.0, 1.0), (0.97, 1.0), (1.0, 0.97)),
        top=((0.0, 1.0), (0.97, 1.0), (1.0, 0.98)),
        nose=0.002,
        belt=((0.0, 0.40), (1.0, 0.40)),
        doors=(("rear_door", 0.20, 0.37),),
    )
    parts: list[Mesh] = []
    panels: list[Chart] = []
    sections = ((first, ahead, 0.5 * (length - ahead), True), (second, behind, -0.5 * (length - behind), False))
    for shell, own, x, is_first in sections:
        sub = (own, width, height)
        fittings = _bus_fittings(shell, sub, detail, rear=not is_first, front=is_first)
        parts += [part.moved(x) for part in (skin(shell, sub, detail=detail), *fittings)]
        for chart in charts(shell, sub):
            head, *tail = chart.name.split("/")
            if not is_first and head == "front":
                continue
            name = "/".join([head if is_first or head == "rear" else f"rear_{head}", *tail])
            panels.append(replace(shifted(chart, x), name=name))
    panels = [p for p in panels if p.name != "rear" or p.low[0] < -0.4 * length]
    cab = parts[0]
    parts[0] = replace(cab, panels=tuple("front" if p == "rear" else p for p in cab.panels))
    index = next(i for i, m in enumerate(parts) if i > 0 and "roof" in m.panels)
    trailing = parts[index]
    names = tuple("rear" if p in ("front", "rear") else f"rear_{p}" for p in trailing.panels)
    parts[index] = replace(trailing, panels=names)
    x0, half = 0.5 * length - ahead - gap - 0.05, 0.5 * width * 0.86
    folds = 7 if detail == 2 else 3
    for k in range(folds):
        a = x0 + (gap + 0.1) * k / folds
        parts.append(crate((a, -half, 0.12 * height), (a + 0.7 * (gap + 0.1) / folds, half, 0.965 * height), TRIM))
    parts.append(crate((x0, -0.97 * half, 0.14 * height), (x0 + gap + 0.1, 0.97 * half, 0.95 * height), DARK))
    return finish(parts, panels, size)


def trailer(style: str, size: Point, *, generator: np.random.Generator, detail: int) -> Mesh:
    """A trailer of a style that fills its size, m. Its front is the end that is coupled to the tractor."""
    length, width, height = size
    half, front, rear = 0.5 * width, 0.5 * length, -0.5 * length
    load, shade = generator.random(2)
    small = style == "utility"
    radius = 0.32 if small else 0.5
    deck = 0.55 if small else min(1.2, 0.36 * height)
    parts: list[Mesh] = []
    panels: list[Chart] = []
    if small:
        top = 0.72 * height if shade < 0.5 else height
        box_front = front - 0.22 * length
        low, high = (rear, -half + 0.18, deck), (box_front, half - 0.18, top)
        parts.append(_cargo(low, high, PAINT))
        panels += side_charts("cargo", low, high)
        if shade < 0.5:
            inside = (rear + 0.05, -half + 0.23, top - 0.02), (box_front - 0.05, half - 0.23, top + 0.005)
            parts.append(crate(*inside, DARK))
            parts.append(crate((box_front - 0.05, -half + 0.2, top), (box_front, half - 0.2, height), STEEL))
        drawbar = [(box_front - 0.2, 0.5 * half, deck - 0.05), (front - 0.05, 0.03, deck - 0.08)]
        parts.append(tubes(drawbar, 0.04, STEEL, 6))
        parts.append(crate((front - 0.12, -0.05, deck - 0.14), (front, 0.05, deck), STEEL))
        parts.append(crate((front - 0.35, -0.04, 0.0), (front - 0.28, 0.04, deck), STEEL))
        axle = rear + 0.42 * (box_front - rear)
        parts.append(wheels([(axle, half - 0.02)], radius, 0.16, detail=detail, steel=STEEL))
        guard = (axle - 0.40, half - 0.2, 2 * radius + 0.02), (axle + 0.40, half, 2 * radius + 0.06)
        parts.append(crates(*guard, TRIM))
        parts.append(crates((rear - 0.006, 0.62 * half, deck + 0.02), (rear + 0.01, 0.80 * half, deck + 0.12), TAIL))
        if detail > 0:
            parts.append(_plate(rear + 0.004, deck + 0.09))
        return finish(parts, panels, size)
    axles = [rear + 0.12 * length + k * 1.31 for k in range(3 if length > 10.0 else 2)]
    parts.append(crate((rear + 0.1, -0.5, deck - 0.32), (front - 0.3, 0.5, deck), FRAME))
    places = [(x, half - 0.06) for x in axles]
    parts.append(wheels(places, radius, 0.40, detail=detail, spokes=10, rim=0.55, steel=STEEL))
    legs = (front - 0.27 * length, 0.5, 0.0), (front - 0.27 * length + 0.14, 0.65, deck - 0.05)
    parts.append(crates(*legs, STEEL))
    if detail > 0:
        guard_low, guard_high = (
            (axles[-1] + 0.9, half - 0.10, 0.45),
            (front - 0.30 * length, half - 0.06, 0.62 * deck + 0.3),
        )
        parts.append(crates(guard_low, guard_high, STEEL))
    if style == "box":
        low, high = (rear, -half, deck), (front, half, height)
        parts.append(_cargo(low, high))
        panels += side_charts("cargo", low, high)
        if detail > 0:
            parts.append(_doors(rear, half, deck, height))
        if detail == 2:
            parts.append(_ribs(low, high))
    elif style == "flatbed":
        parts.append(crate((rear, -half, deck), (front, half, deck + 0.16), WOOD))
        parts.append(crate((front - 0.08, -half, deck), (front, half, height), STEEL))
        high = (front - 0.8, 0.85 * half, height - 0.2 * load)
        parts += _load((rear + 0.5, -0.85 * half, deck + 0.16), high, generator=generator)
    else:
        z = 0.5 * (deck - 0.1 + height)
        angle = np.linspace(0.0, 2.0 * np.pi, 24 if detail == 2 else 10, endpoint=False) - np.pi / 2
        ring = np.stack([np.zeros_like(angle), half * np.cos(angle), (height - z) * np.sin(angle)], 1)
        ends = [(rear, 0.78), (rear + 0.12, 0.95), (rear + 0.4, 1.0)]
        ends += [(front - 0.4, 1.0), (front - 0.12, 0.95), (front, 0.78)]
        tank = loft(np.stack([ring * s + [x, 0.0, z] for x, s in ends]), material=PAINT)
        parts.append(sided(tank, "cargo"))
        panels += side_charts("cargo", (rear, -half, deck - 0.1), (front, half, height))
        parts.append(crate((rear + 1.0, -0.28, height - 0.12), (front - 1.0, 0.28, height), STEEL))
    parts += _rear_fittings(rear, half, deck - 0.25, detail)
    return finish(parts, panels, size)
