"""What stands at the roadside: cones, barriers, signal heads, street lamps and signs. Faces look along +x."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from ssad.rendering.bodies.parts import STEEL, TRIM, WOOD, Chart, as_point, crate, finish, side_charts, sided
from ssad.rendering.meshes.mesh import F64, Material, Mesh, Point, build, lathe, merge, prism, triangulate, tube

ORANGE = Material("orange", (0.75, 0.12, 0.01), specular=0.04, gloss=0.3)
WHITE = Material("reflective", (0.78, 0.78, 0.78), specular=0.1, gloss=0.6)
RED = Material("red", (0.52, 0.015, 0.02), specular=0.06, gloss=0.5)
CONCRETE = Material("concrete", (0.36, 0.35, 0.33), specular=0.02, gloss=0.05)
POLE = Material("pole", (0.22, 0.23, 0.23), specular=0.15, gloss=0.4)
LAMPS = (
    Material("lamp_red", (0.28, 0.015, 0.012), gloss=0.7),
    Material("lamp_yellow", (0.30, 0.19, 0.012), gloss=0.7),
    Material("lamp_green", (0.015, 0.22, 0.11), gloss=0.7),
)
BEACON = Material("beacon", (0.6, 0.3, 0.02), emission=0.2)
STREET_LIGHT = Material("street_light", (0.80, 0.78, 0.70), emission=0.0)
SIGN_INK = Material("sign_ink", (0.02, 0.02, 0.022), specular=0.08, gloss=0.5)
SIGN_BLUE = Material("sign_blue", (0.02, 0.09, 0.38), specular=0.08, gloss=0.5)
SIGN_BACK = Material("sign_back", (0.30, 0.31, 0.31), specular=0.1, gloss=0.3)
POST_GREEN = Material("post_green", (0.03, 0.075, 0.04), specular=0.06, gloss=0.3)

# strokes of capitals of height 1: simple polygons (right, up) that do not overlap; the stem is 0.2 wide
LETTERS: dict[str, tuple[tuple[tuple[float, float], ...], ...]] = {
    "S": (
        (
            (0.0, 0.28),
            (0.02, 0.13),
            (0.09, 0.04),
            (0.2, 0.0),
            (0.42, 0.0),
            (0.53, 0.04),
            (0.6, 0.13),
            (0.62, 0.25),
            (0.62, 0.34),
            (0.59, 0.47),
            (0.52, 0.55),
            (0.41, 0.59),
            (0.24, 0.63),
            (0.2, 0.67),
            (0.19, 0.74),
            (0.21, 0.81),
            (0.26, 0.84),
            (0.36, 0.84),
            (0.41, 0.81),
            (0.43, 0.72),
            (0.62, 0.72),
            (0.6, 0.87),
            (0.53, 0.96),
            (0.42, 1.0),
            (0.2, 1.0),
            (0.09, 0.96),
            (0.02, 0.87),
            (0.0, 0.75),
            (0.0, 0.66),
            (0.03, 0.54),
            (0.1, 0.46),
            (0.21, 0.42),
            (0.38, 0.38),
            (0.42, 0.34),
            (0.43, 0.27),
            (0.41, 0.19),
            (0.36, 0.16),
            (0.26, 0.16),
            (0.21, 0.19),
            (0.19, 0.28),
        ),
    ),
    "T": (
        ((0.0, 0.83), (0.62, 0.83), (0.62, 1.0), (0.0, 1.0)),
        ((0.21, 0.0), (0.41, 0.0), (0.41, 0.83), (0.21, 0.83)),
    ),
    "O": (
        (
            (0.31, 0.0),
            (0.45, 0.0),
            (0.55, 0.06),
            (0.62, 0.2),
            (0.62, 0.8),
            (0.55, 0.94),
            (0.45, 1.0),
            (0.31, 1.0),
            (0.31, 0.84),
            (0.38, 0.82),
            (0.42, 0.75),
            (0.42, 0.25),
            (0.38, 0.18),
            (0.31, 0.16),
        ),
        (
            (0.31, 0.0),
            (0.31, 0.16),
            (0.24, 0.18),
            (0.2, 0.25),
            (0.2, 0.75),
            (0.24, 0.82),
            (0.31, 0.84),
            (0.31, 1.0),
            (0.17, 1.0),
            (0.07, 0.94),
            (0.0, 0.8),
            (0.0, 0.2),
            (0.07, 0.06),
            (0.17, 0.0),
        ),
    ),
    "P": (
        ((0.0, 0.0), (0.2, 0.0), (0.2, 1.0), (0.0, 1.0)),
        (
            (0.2, 0.36),
            (0.42, 0.36),
            (0.55, 0.43),
            (0.62, 0.57),
            (0.62, 0.79),
            (0.55, 0.93),
            (0.42, 1.0),
            (0.2, 1.0),
            (0.2, 0.85),
            (0.37, 0.85),
            (0.42, 0.79),
            (0.42, 0.57),
            (0.37, 0.51),
            (0.2, 0.51),
        ),
    ),
    "A": (
        ((0.0, 0.0), (0.19, 0.0), (0.33, 0.72), (0.33, 1.0), (0.22, 1.0)),
        ((0.47, 0.0), (0.66, 0.0), (0.44, 1.0), (0.33, 1.0), (0.33, 0.72)),
        ((0.229, 0.2), (0.431, 0.2), (0.402, 0.35), (0.258, 0.35)),
    ),
    "L": (((0.0, 0.0), (0.56, 0.0), (0.56, 0.17), (0.2, 0.17), (0.2, 1.0), (0.0, 1.0)),),
    "W": (
        (
            (0.14, 0.0),
            (0.32, 0.0),
            (0.42, 0.55),
            (0.52, 0.0),
            (0.7, 0.0),
            (0.84, 1.0),
            (0.65, 1.0),
            (0.59, 0.42),
            (0.49, 1.0),
            (0.35, 1.0),
            (0.25, 0.42),
            (0.19, 1.0),
            (0.0, 1.0),
        ),
    ),
    "Y": (
        ((0.23, 0.0), (0.43, 0.0), (0.43, 0.42), (0.33, 0.6), (0.23, 0.42)),
        ((0.23, 0.42), (0.33, 0.6), (0.2, 1.0), (0.0, 1.0)),
        ((0.43, 0.42), (0.66, 1.0), (0.46, 1.0), (0.33, 0.6)),
    ),
}


def traffic_cone(style: str, size: Point, *, generator: np.random.Generator, detail: int) -> Mesh:
    """A traffic cone, a tall slim one or a drum that fills its size, m."""
    n = (6, 10, 20)[detail]
    shade = replace(ORANGE, colour=(0.75, float(generator.uniform(0.09, 0.17)), 0.01))
    rows: dict[str, list[tuple[float, float]]] = {
        "cone": [(0.36, 0.06), (0.31, 0.20), (0.275, 0.36), (0.22, 0.50), (0.185, 0.66), (0.14, 0.80), (0.09, 1.0)],
        "tall": [(0.22, 0.06), (0.19, 0.30), (0.175, 0.45), (0.16, 0.55), (0.145, 0.70), (0.13, 0.82), (0.10, 1.0)],
        "drum": [(0.48, 0.06), (0.48, 0.24), (0.45, 0.40), (0.45, 0.56), (0.42, 0.72), (0.42, 0.86), (0.38, 1.0)],
    }
    bands = enumerate(pairwise(rows[style]))
    parts = [lathe(band, material=WHITE if k % 2 else shade, segments=n) for k, band in bands]
    base = TRIM if style == "drum" else shade
    if style == "drum":
        parts.append(lathe([(0.5, 0.0), (0.5, 0.06)], material=base, segments=n))
    else:
        parts.append(crate((-0.5, -0.5, 0.0), (0.5, 0.5, 0.06), base))
    return finish(parts, [], size)


def barrier(style: str, size: Point, *, generator: np.random.Generator, detail: int) -> Mesh:
    """A barrier across x (its long side along y, as nuScenes labels it) that fills its size, m."""
    length, width, height = size
    half, deep = 0.5 * width, 0.5 * length
    first = bool(generator.random() < 0.5)
    charts = side_charts("face", (-deep, -half, 0.0), (deep, half, height))
    parts: list[Mesh] = []
    if style in ("jersey", "water"):
        side = [(1.0, 0.0), (1.0, 0.10), (0.58, 0.36), (0.36, 1.0)]
        outline = [(deep * x, height * z) for x, z in side] + [(-deep * x, height * z) for x, z in side[::-1]]
        pieces = 1 if style == "jersey" else 2
        cuts = np.linspace(-half, half, pieces + 1)
        for k in range(pieces):
            look = CONCRETE if style == "jersey" else RED if (k % 2 == 0) == first else WHITE
            parts.append(sided(prism(outline, (cuts[k], cuts[k + 1]), axis=1, material=look, smooth=0.2), "face"))
    elif style == "fence":
        rail = [[(0.0, -half + 0.03, z * height), (0.0, half - 0.03, z * height)] for z in (0.16, 0.97)]
        ends = [[(0.0, s * (half - 0.03), 0.05), (0.0, s * (half - 0.03), 0.98 * height)] for s in (-1.0, 1.0)]
        bars = (5, 9, 15)[detail]
        thin = [[(0.0, y, 0.16 * height), (0.0, y, 0.97 * height)] for y in np.linspace(-half + 0.1, half - 0.1, bars)]
        n = 3 if detail == 0 else 6
        parts += [tube(p, 0.02, material=STEEL, segments=n) for p in rail + ends]
        parts += [tube(p, 0.009, material=STEEL, segments=3 if detail < 2 else 5) for p in thin]
        for y in (0.06 - half, half - 0.06):
            parts.append(crate((-deep, y - 0.03, 0.0), (deep, y + 0.03, 0.03), STEEL))
    else:
        stripes = 8
        edges = np.linspace(-half, half, stripes + 1)
        slant = 0.18 * width / stripes
        for k, (y0, y1) in enumerate(pairwise(edges.tolist())):
            look = RED if (k % 2 == 0) == first else WHITE
            for low, high in ((0.68, 0.98), (0.28, 0.50)) if detail else ((0.68, 0.98),):
                upper = min(y1 + slant, half), min(y0 + slant, half) if k else -half
                quad = [(y0, low * height), (y1, low * height), (upper[0], high * height), (upper[1], high * height)]
                parts.append(sided(prism(quad, (-0.03, 0.03), axis=0, material=look, smooth=0.0), "face"))
        for s in (-1.0, 1.0):
            y = s * 0.82 * half
            for e in (-1.0, 1.0):
                leg = [(e * deep * 0.9, y, 0.02), (e * 0.04, y, 0.98 * height)]
                parts.append(tube(leg, 0.025, material=TRIM, segments=4))
            parts.append(crate((-deep, y - 0.05, 0.0), (deep, y + 0.05, 0.05), TRIM))
        parts.append(lathe([(0.06, 0.98 * height), (0.06, height)], material=BEACON, segments=6))
    return finish(parts, charts, size)


def signal_head(*, lamps: tuple[Material, ...] = LAMPS, detail: int = 2) -> Mesh:
    """A signal head that looks along +x, its base at the origin: 0.30 m wide, 0.32 m for each lamp.

    Its materials lamp_red, lamp_yellow and lamp_green have no emission.
    """
    n = (6, 8, 14)[detail]
    high = 0.32 * len(lamps)
    parts = [crate((-0.12, -0.16, 0.0), (0.10, 0.16, high + 0.04), TRIM)]
    if detail:
        parts.append(crate((-0.02, -0.24, -0.08), (0.0, 0.24, high + 0.12), TRIM))
    for k, lamp in enumerate(lamps):
        z = high - 0.32 * (k + 0.5) + 0.02
        disc = lathe([(0.12, 0.0), (0.12, 0.015), (0.06, 0.035)], material=lamp, segments=n, axis=0)
        parts.append(disc.moved(0.10, 0.0, z))
        if detail == 2:
            angle = np.linspace(0.15 * np.pi, 0.85 * np.pi, 7)
            arc = np.stack([0.14 * np.cos(angle), 0.14 * np.sin(angle)], 1)
            outline = np.concatenate([arc, 0.93 * arc[::-1]])
            parts.append(prism(outline, (0.10, 0.27), axis=0, material=TRIM).moved(z=z))
    return merge(parts)


def traffic_signal(style: str, size: Point, *, generator: np.random.Generator, detail: int) -> Mesh:
    """A signal on a post, on a mast with an arm over the road (to +y), or for walkers; it fills its size, m."""
    del generator
    _, width, height = size
    n = (4, 6, 10)[detail]
    if style == "mast":
        reach = width
        pole = tube([(0.0, 0.0, 0.0), (0.0, 0.0, height)], [0.13, 0.09], material=POLE, segments=n)
        arm = tube([(0.0, 0.0, height - 0.3), (0.0, reach, height - 0.15)], [0.08, 0.05], material=POLE, segments=n)
        heads = [signal_head(detail=detail).moved(0.15, y, z) for y, z in ((reach - 0.3, height - 1.25), (0.0, 2.4))]
        return finish([pole, arm, *heads], [], size)
    lamps = LAMPS if style == "post" else (LAMPS[0], LAMPS[2])
    head = signal_head(lamps=lamps, detail=detail)
    top = height - float(head.bounds()[1][2])
    pole = tube([(-0.18, 0.0, 0.0), (-0.18, 0.0, height - 0.1)], 0.07, material=POLE, segments=n)
    bracket = crate((-0.18, -0.03, top + 0.2), (0.0, 0.03, top + 0.26), POLE)
    return finish([pole, bracket, head.moved(z=top)], [], size)


def street_lamp(style: str, size: Point, *, generator: np.random.Generator, detail: int) -> Mesh:
    """A street lamp whose arm reaches along +x over the road; it fills its size, m. Material street_light lights."""
    del generator
    reach, _, height = size
    n = (4, 6, 10)[detail]
    if style == "curved":
        turn = np.linspace(0.0, 0.5 * np.pi, (3, 4, 8)[detail])
        bow = [(0.7 * reach * (1.0 - np.cos(a)), 0.0, height - 1.2 + 1.15 * np.sin(a)) for a in turn]
        path: list[tuple[float, float, float]] = [(0.0, 0.0, 0.0), *[(float(x), y, float(z)) for x, y, z in bow]]
    else:
        path = [(0.0, 0.0, 0.0), (0.0, 0.0, height - 0.6), (0.7 * reach, 0.0, height - 0.08)]
    pole = tube(path, np.linspace(0.11, 0.05, len(path)), material=POLE, segments=n)
    x = path[-1][0]
    head = crate((x - 0.05, -0.5 * size[1], height - 0.12), (x + 0.3 * reach, 0.5 * size[1], height), POLE)
    glow = crate((x, -0.4 * size[1], height - 0.15), (x + 0.27 * reach, 0.4 * size[1], height - 0.11), STREET_LIGHT)
    return finish([pole, head, glow], [], size)


def sign(style: str, size: Point, *, generator: np.random.Generator, detail: int) -> Mesh:
    """A traffic sign on a post that looks along +x and fills its size, m; its face is the panel `face`."""
    digits = int(generator.integers(0, 3))
    _, width, height = size
    r = 0.5 * width
    z = height - r
    middle = np.array([0.0, z])
    pole = tube([(-0.05, 0.0, 0.0), (-0.05, 0.0, height - 0.2 * r)], 0.03, material=POLE, segments=(4, 5, 8)[detail])
    n = (8, 12, 24)[detail]
    layers: list[tuple[F64, Material]]
    if style == "warning":
        triangle = _polygon(3, np.pi / 2, 1.15 * r)
        layers = [(triangle + middle, RED), (0.66 * triangle + middle, WHITE)]
        layers.append((_bar(0.0, z + 0.05 * r, 0.06 * r, 0.22 * r), SIGN_INK))
        layers.append((_bar(0.0, z - 0.28 * r, 0.06 * r, 0.05 * r), SIGN_INK))
    elif style == "limit":
        layers = [(_polygon(n, 0.0, r) + middle, RED), (_polygon(n, 0.0, 0.80 * r) + middle, WHITE)]
        layers += [(_bar(y * r, z, (0.06 + 0.03 * digits) * r, 0.38 * r), SIGN_INK) for y in (-0.28, 0.24)]
    else:
        layers = [(_bar(0.0, z + 0.4 * r, r, 0.6 * r), WHITE), (_bar(0.0, z + 0.4 * r, 0.95 * r, 0.54 * r), SIGN_BLUE)]
        layers += [(_bar(-0.2 * r, z + (0.4 + s) * r, 0.55 * r, 0.07 * r), WHITE) for s in (0.25, -0.15)]
    parts = [pole, prism(layers[0][0], (-0.025, -0.004), axis=0, material=SIGN_BACK)]
    for k, (outline, look) in enumerate(layers if detail else layers[:2]):
        depth = 0.004 * min(k, 2)
        plate = prism(outline, (depth - 0.003, depth), axis=0, material=look, smooth=0.0)
        parts.append(plate.with_panel("face"))
    chart = Chart("face", "front", (-0.1, -r, height - 2.0 * r - 0.2), (0.1, r, height))
    return finish(parts, [chart], size)


def stop_sign(style: str, size: Point, *, generator: np.random.Generator, detail: int) -> Mesh:
    """A stop sign (R1-1 of the US) on a post, facing +x.

    The octagon is as wide as the body and ends at its top. Its panels are `face` and `back`; a plate below ("all_way")
    and the post have none.

    Args:
        style: Name of the style; "all_way": with a plate below; "worn": with worn sheeting.
        size: Length, width and height of the body, m.
        generator: Source of randomness.
        detail: Level of detail.
    """
    _, width, height = size
    r = 0.5 * width
    red, white = _sheeting(generator, worn=style == "worn")
    octagon = _polygon(8, np.pi / 8, r / np.cos(np.pi / 8))
    middle = np.array([0.0, height - r])
    # 30 inches: a border of 0.75 and letters of 10 inches
    layers = [(octagon, white), (0.945 * octagon, red)]
    layers += [(r * stroke, white) for stroke in _text("STOP", tall=0.66, wide=1.62)]
    parts = [_post(style, height - 0.1 * width, generator), *_plate(layers, middle, detail)]
    if style == "all_way":
        below = middle - [0.0, 1.36 * r]
        plate = [(_bar(0.0, 0.0, 0.6 * r, 0.26 * r), red)]
        plate += [(r * stroke, white) for stroke in _text("ALL WAY", tall=0.24, wide=1.0)]
        parts += _plate(plate, below, detail, panels=False)
    return finish(parts, _square_charts(r, height), size)


def yield_sign(style: str, size: Point, *, generator: np.random.Generator, detail: int) -> Mesh:
    """A yield sign (R1-2 of the US) on a post, with the panels of `stop_sign`."""
    _, width, height = size
    r = 0.5 * width
    red, white = _sheeting(generator, worn=style == "worn")
    deep = np.sqrt(3.0) * r
    triangle = np.array([(-r, 0.5 * deep), (0.0, -0.5 * deep), (r, 0.5 * deep)])
    inner = 0.52 * triangle + [0.0, 0.08 * deep]
    layers = [(triangle, white), (0.93 * triangle + [0.0, 0.011 * deep], red), (inner, white)]
    parts = [_post(style, height - 0.3 * width, generator)]
    parts += _plate(layers, np.array([0.0, height - 0.5 * deep]), detail)
    return finish(parts, _square_charts(r, height), size)


def _sheeting(generator: np.random.Generator, *, worn: bool) -> tuple[Material, Material]:
    """Red and white of a sign: new, or faded by the sun and dirty. Always the same number of draws."""
    shade, age = float(generator.uniform(0.85, 1.15)), float(generator.uniform(0.35, 0.9)) * worn
    new, old = np.array(RED.colour) * shade, np.array([0.46, 0.13, 0.10])
    clean, dirty = np.array(WHITE.colour), np.array([0.52, 0.49, 0.42])
    red, white = (a + age * (b - a) for a, b in ((new, old), (clean, dirty)))
    gloss = 0.5 - 0.35 * age
    return (
        replace(RED, name="sign_red", colour=as_point(red), gloss=gloss),
        replace(WHITE, name="sign_white", colour=as_point(white), gloss=gloss),
    )


def _post(style: str, height: float, generator: np.random.Generator) -> Mesh:
    """The post of a sign behind its plate: square steel, a green channel or wood."""
    kind = int(generator.choice(3, p=(0.5, 0.35, 0.15)))
    look = (POLE, POST_GREEN, WOOD)[kind]
    half = (0.025, 0.03, 0.045)[kind] * (1.3 if style == "large" else 1.0)
    return crate((-0.004 - 2.0 * half, -half, 0.0), (-0.004, half, height), look)


def _plate(layers: Sequence[tuple[F64, Material]], middle: F64, detail: int, *, panels: bool = True) -> list[Mesh]:
    """Flat polygons (y, z) about a middle, each a little before the one below, and the grey back of the first."""
    parts = []
    for k, (outline, look) in enumerate(layers if detail else layers[:3]):
        flat = _flat(outline + middle, 0.004 * min(k, 2), look, ahead=True)
        parts.append(flat.with_panel("face") if panels else flat)
    back = _flat(layers[0][0] + middle, -0.003, SIGN_BACK, ahead=False)
    parts.append(back.with_panel("back") if panels else back)
    return parts


def _flat(outline: F64, x: float, material: Material, *, ahead: bool) -> Mesh:
    """A polygon (y, z) at x that is seen from +x (ahead) or from -x."""
    faces = triangulate(outline)
    return build(np.insert(outline, 0, x, axis=1), faces if ahead else faces[:, ::-1], materials=material, smooth=0.0)


def _square_charts(r: float, height: float) -> list[Chart]:
    """Charts of the square of half side r at the top of a sign, seen from before and from behind."""
    low, high = (-0.1, -r, height - 2.0 * r), (0.1, r, height)
    return [Chart("face", "front", low, high), Chart("back", "rear", low, high)]


def _polygon(count: int, start: float, radius: float) -> F64:
    """Corners [count, 2] of a regular polygon about 0, 0; start: angle of the first."""
    angle = start + np.arange(count) * (2.0 * np.pi / count)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)


def _text(text: str, *, tall: float, wide: float) -> list[F64]:
    """Strokes of a line of capitals about 0, 0, read by who looks against +x: y runs to the reader's right."""
    advance = {letter: max(p[0] for stroke in strokes for p in stroke) for letter, strokes in LETTERS.items()}
    gap = 0.16
    length = sum(advance.get(letter, 0.35) + gap for letter in text) - gap
    at, found = 0.0, []
    for letter in text:
        for stroke in LETTERS.get(letter, ()):
            points = np.array(stroke, np.float64) - np.array([0.5 * length - at, 0.5])
            found.append(points * [wide / length, tall])
        at += advance.get(letter, 0.35) + gap
    return found


def _bar(y: float, z: float, half_width: float, half_height: float) -> F64:
    """A rectangle [4, 2] in (y, z)."""
    w, h = half_width, half_height
    return np.array([(y - w, z - h), (y + w, z - h), (y + w, z + h), (y - w, z + h)])
