"""Roadside objects: cones, barriers, signal heads, street lamps and signs. Faces look along +x."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from ssad.rendering.bodies.figures import number_strokes
from ssad.rendering.bodies.parts import (
    STEEL,
    TRIM,
    WOOD,
    Chart,
    as_point,
    assign_side_panels,
    crate,
    finish,
    side_charts,
)
from ssad.rendering.meshes.mesh import F64, Material, Mesh, Point, build, lathe, merge, prism, triangulate, tube

WORN_LIMITS = 0.2  # share of speed-limit signs whose sheeting has faded
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

# strokes of capitals of height 1: simple polygons (right, up) without overlap; stems are 0.2 wide
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
    """Return a traffic cone, a tall slim one or a drum that fills its size, m."""
    segments = (6, 10, 20)[detail]
    cone_material = replace(ORANGE, colour=(0.75, float(generator.uniform(0.09, 0.17)), 0.01))
    profiles: dict[str, list[tuple[float, float]]] = {
        "cone": [(0.36, 0.06), (0.31, 0.20), (0.275, 0.36), (0.22, 0.50), (0.185, 0.66), (0.14, 0.80), (0.09, 1.0)],
        "tall": [(0.22, 0.06), (0.19, 0.30), (0.175, 0.45), (0.16, 0.55), (0.145, 0.70), (0.13, 0.82), (0.10, 1.0)],
        "drum": [(0.48, 0.06), (0.48, 0.24), (0.45, 0.40), (0.45, 0.56), (0.42, 0.72), (0.42, 0.86), (0.38, 1.0)],
    }
    bands = enumerate(pairwise(profiles[style]))
    parts = [
        lathe(band, material=WHITE if band_index % 2 else cone_material, segments=segments)
        for band_index, band in bands
    ]
    base_material = TRIM if style == "drum" else cone_material
    if style == "drum":
        parts.append(lathe([(0.5, 0.0), (0.5, 0.06)], material=base_material, segments=segments))
    else:
        parts.append(crate((-0.5, -0.5, 0.0), (0.5, 0.5, 0.06), base_material))
    return finish(parts, [], size)


def barrier(style: str, size: Point, *, generator: np.random.Generator, detail: int) -> Mesh:
    """Return a barrier across x (its long side along y, as nuScenes labels it) that fills its size, m."""
    length, width, height = size
    half_width, half_length = 0.5 * width, 0.5 * length
    red_first = bool(generator.random() < 0.5)
    charts = side_charts("face", (-half_length, -half_width, 0.0), (half_length, half_width, height))
    parts: list[Mesh] = []
    if style in ("jersey", "water"):
        profile = [(1.0, 0.0), (1.0, 0.10), (0.58, 0.36), (0.36, 1.0)]
        outline = [(half_length * x, height * z) for x, z in profile] + [
            (-half_length * x, height * z) for x, z in profile[::-1]
        ]
        piece_count = 1 if style == "jersey" else 2
        cuts = np.linspace(-half_width, half_width, piece_count + 1)
        for index in range(piece_count):
            material = CONCRETE if style == "jersey" else RED if (index % 2 == 0) == red_first else WHITE
            parts.append(
                assign_side_panels(
                    prism(outline, (cuts[index], cuts[index + 1]), axis=1, material=material, smooth=0.2), "face"
                )
            )
    elif style == "fence":
        rail_paths = [
            [(0.0, -half_width + 0.03, z * height), (0.0, half_width - 0.03, z * height)] for z in (0.16, 0.97)
        ]
        post_paths = [
            [(0.0, side * (half_width - 0.03), 0.05), (0.0, side * (half_width - 0.03), 0.98 * height)]
            for side in (-1.0, 1.0)
        ]
        bar_count = (5, 9, 15)[detail]
        bar_paths = [
            [(0.0, y, 0.16 * height), (0.0, y, 0.97 * height)]
            for y in np.linspace(-half_width + 0.1, half_width - 0.1, bar_count)
        ]
        segments = 3 if detail == 0 else 6
        parts += [tube(path, 0.02, material=STEEL, segments=segments) for path in rail_paths + post_paths]
        parts += [tube(path, 0.009, material=STEEL, segments=3 if detail < 2 else 5) for path in bar_paths]
        for y in (0.06 - half_width, half_width - 0.06):
            parts.append(crate((-half_length, y - 0.03, 0.0), (half_length, y + 0.03, 0.03), STEEL))
    else:
        stripes = 8
        edges = np.linspace(-half_width, half_width, stripes + 1)
        stripe_slant = 0.18 * width / stripes
        for index, (y0, y1) in enumerate(pairwise(edges.tolist())):
            material = RED if (index % 2 == 0) == red_first else WHITE
            for bottom, top in ((0.68, 0.98), (0.28, 0.50)) if detail else ((0.68, 0.98),):
                upper_edge = (
                    min(y1 + stripe_slant, half_width),
                    min(y0 + stripe_slant, half_width) if index else -half_width,
                )
                stripe_outline = [
                    (y0, bottom * height),
                    (y1, bottom * height),
                    (upper_edge[0], top * height),
                    (upper_edge[1], top * height),
                ]
                parts.append(
                    assign_side_panels(
                        prism(stripe_outline, (-0.03, 0.03), axis=0, material=material, smooth=0.0), "face"
                    )
                )
        for side in (-1.0, 1.0):
            y = side * 0.82 * half_width
            for end in (-1.0, 1.0):
                leg_path = [(end * half_length * 0.9, y, 0.02), (end * 0.04, y, 0.98 * height)]
                parts.append(tube(leg_path, 0.025, material=TRIM, segments=4))
            parts.append(crate((-half_length, y - 0.05, 0.0), (half_length, y + 0.05, 0.05), TRIM))
        parts.append(lathe([(0.06, 0.98 * height), (0.06, height)], material=BEACON, segments=6))
    return finish(parts, charts, size)


def signal_head(*, lamps: tuple[Material, ...] = LAMPS, detail: int = 2) -> Mesh:
    """Return a signal head that faces +x with its base at the origin: 0.30 m wide, 0.32 m for each lamp.

    Its materials lamp_red, lamp_yellow and lamp_green have no emission.
    """
    segments = (6, 8, 14)[detail]
    lamp_height = 0.32 * len(lamps)
    parts = [crate((-0.12, -0.16, 0.0), (0.10, 0.16, lamp_height + 0.04), TRIM)]
    if detail:
        parts.append(crate((-0.02, -0.24, -0.08), (0.0, 0.24, lamp_height + 0.12), TRIM))
    for lamp_index, lamp in enumerate(lamps):
        z = lamp_height - 0.32 * (lamp_index + 0.5) + 0.02
        lens = lathe([(0.12, 0.0), (0.12, 0.015), (0.06, 0.035)], material=lamp, segments=segments, axis=0)
        parts.append(lens.moved(0.10, 0.0, z))
        if detail == 2:
            angles = np.linspace(0.15 * np.pi, 0.85 * np.pi, 7)
            arc = np.stack([0.14 * np.cos(angles), 0.14 * np.sin(angles)], 1)
            outline = np.concatenate([arc, 0.93 * arc[::-1]])
            parts.append(prism(outline, (0.10, 0.27), axis=0, material=TRIM).moved(z=z))
    return merge(parts)


def traffic_signal(style: str, size: Point, *, generator: np.random.Generator, detail: int) -> Mesh:
    """Return a signal on a post, on a mast with an arm over the road (to +y), or for walkers.

    It fills its size, m.
    """
    del generator
    _, width, height = size
    segments = (4, 6, 10)[detail]
    if style == "mast":
        arm_length = width
        pole = tube([(0.0, 0.0, 0.0), (0.0, 0.0, height)], [0.13, 0.09], material=POLE, segments=segments)
        arm = tube(
            [(0.0, 0.0, height - 0.3), (0.0, arm_length, height - 0.15)], [0.08, 0.05], material=POLE, segments=segments
        )
        heads = [
            signal_head(detail=detail).moved(0.15, y, z) for y, z in ((arm_length - 0.3, height - 1.25), (0.0, 2.4))
        ]
        return finish([pole, arm, *heads], [], size)
    lamps = LAMPS if style == "post" else (LAMPS[0], LAMPS[2])
    head = signal_head(lamps=lamps, detail=detail)
    head_base = height - float(head.bounds()[1][2])
    pole = tube([(-0.18, 0.0, 0.0), (-0.18, 0.0, height - 0.1)], 0.07, material=POLE, segments=segments)
    bracket = crate((-0.18, -0.03, head_base + 0.2), (0.0, 0.03, head_base + 0.26), POLE)
    return finish([pole, bracket, head.moved(z=head_base)], [], size)


def street_lamp(style: str, size: Point, *, generator: np.random.Generator, detail: int) -> Mesh:
    """Return a street lamp whose arm reaches along +x over the road; it fills its size, m.

    Its light has the material street_light.
    """
    del generator
    reach, _, height = size
    segments = (4, 6, 10)[detail]
    if style == "curved":
        angles = np.linspace(0.0, 0.5 * np.pi, (3, 4, 8)[detail])
        bow_points = [
            (0.7 * reach * (1.0 - np.cos(bow_angle)), 0.0, height - 1.2 + 1.15 * np.sin(bow_angle))
            for bow_angle in angles
        ]
        path: list[tuple[float, float, float]] = [(0.0, 0.0, 0.0), *[(float(x), y, float(z)) for x, y, z in bow_points]]
    else:
        path = [(0.0, 0.0, 0.0), (0.0, 0.0, height - 0.6), (0.7 * reach, 0.0, height - 0.08)]
    pole = tube(path, np.linspace(0.11, 0.05, len(path)), material=POLE, segments=segments)
    x = path[-1][0]
    head = crate((x - 0.05, -0.5 * size[1], height - 0.12), (x + 0.3 * reach, 0.5 * size[1], height), POLE)
    light = crate((x, -0.4 * size[1], height - 0.15), (x + 0.27 * reach, 0.4 * size[1], height - 0.11), STREET_LIGHT)
    return finish([pole, head, light], [], size)


def sign(style: str, size: Point, *, generator: np.random.Generator, detail: int) -> Mesh:
    """Return a traffic sign on a post that faces +x and fills its size, m; its face is the panel `face`."""
    stroke_variant = int(generator.integers(0, 3))
    _, width, height = size
    radius = 0.5 * width
    centre_z = height - radius
    centre = np.array([0.0, centre_z])
    pole = tube(
        [(-0.05, 0.0, 0.0), (-0.05, 0.0, height - 0.2 * radius)], 0.03, material=POLE, segments=(4, 5, 8)[detail]
    )
    corner_count = (8, 12, 24)[detail]
    layers: list[tuple[F64, Material]]
    if style == "warning":
        triangle = _polygon(3, np.pi / 2, 1.15 * radius)
        layers = [(triangle + centre, RED), (0.66 * triangle + centre, WHITE)]
        layers.append((_bar(0.0, centre_z + 0.05 * radius, 0.06 * radius, 0.22 * radius), SIGN_INK))
        layers.append((_bar(0.0, centre_z - 0.28 * radius, 0.06 * radius, 0.05 * radius), SIGN_INK))
    elif style == "limit":
        layers = [
            (_polygon(corner_count, 0.0, radius) + centre, RED),
            (_polygon(corner_count, 0.0, 0.80 * radius) + centre, WHITE),
        ]
        layers += [
            (_bar(y * radius, centre_z, (0.06 + 0.03 * stroke_variant) * radius, 0.38 * radius), SIGN_INK)
            for y in (-0.28, 0.24)
        ]
    else:
        layers = [
            (_bar(0.0, centre_z + 0.4 * radius, radius, 0.6 * radius), WHITE),
            (_bar(0.0, centre_z + 0.4 * radius, 0.95 * radius, 0.54 * radius), SIGN_BLUE),
        ]
        layers += [
            (_bar(-0.2 * radius, centre_z + (0.4 + line_offset) * radius, 0.55 * radius, 0.07 * radius), WHITE)
            for line_offset in (0.25, -0.15)
        ]
    parts = [pole, prism(layers[0][0], (-0.025, -0.004), axis=0, material=SIGN_BACK)]
    for layer_index, (outline, material) in enumerate(layers if detail else layers[:2]):
        depth = 0.004 * min(layer_index, 2)
        plate = prism(outline, (depth - 0.003, depth), axis=0, material=material, smooth=0.0)
        parts.append(plate.with_panel("face"))
    chart = Chart("face", "front", (-0.1, -radius, height - 2.0 * radius - 0.2), (0.1, radius, height))
    return finish(parts, [chart], size)


def stop_sign(style: str, size: Point, *, generator: np.random.Generator, detail: int) -> Mesh:
    """Return a stop sign (R1-1 of the US) on a post, facing +x.

    The octagon is as wide as the body and ends at its top. Its panels are `face` and `back`; the post and a
    plate below ("all_way") have none.

    Args:
        style: Name of the style; "all_way": with a plate below; "worn": with worn sheeting.
        size: Length, width and height of the body, m.
        generator: Source of randomness.
        detail: Level of detail.
    """
    _, width, height = size
    radius = 0.5 * width
    red_material, white_material = _draw_sheeting(generator, is_worn=style == "worn")
    octagon = _polygon(8, np.pi / 8, radius / np.cos(np.pi / 8))
    centre = np.array([0.0, height - radius])
    # 30 inches: a border of 0.75 and letters of 10 inches
    layers = [(octagon, white_material), (0.945 * octagon, red_material)]
    layers += [(radius * stroke, white_material) for stroke in _text("STOP", height=0.66, width=1.62)]
    parts = [_post(style, height - 0.1 * width, generator), *_plate(layers, centre, detail)]
    if style == "all_way":
        plate_centre = centre - [0.0, 1.36 * radius]
        plate_layers = [(_bar(0.0, 0.0, 0.6 * radius, 0.26 * radius), red_material)]
        plate_layers += [(radius * stroke, white_material) for stroke in _text("ALL WAY", height=0.24, width=1.0)]
        parts += _plate(plate_layers, plate_centre, detail, panels=False)
    return finish(parts, _square_charts(radius, height), size)


def yield_sign(style: str, size: Point, *, generator: np.random.Generator, detail: int) -> Mesh:
    """Return a yield sign (R1-2 of the US) on a post, with the panels of `stop_sign`."""
    _, width, height = size
    half_width = 0.5 * width
    red_material, white_material = _draw_sheeting(generator, is_worn=style == "worn")
    triangle_height = np.sqrt(3.0) * half_width
    triangle = np.array(
        [(-half_width, 0.5 * triangle_height), (0.0, -0.5 * triangle_height), (half_width, 0.5 * triangle_height)]
    )
    inner_triangle = 0.52 * triangle + [0.0, 0.08 * triangle_height]
    layers = [
        (triangle, white_material),
        (0.93 * triangle + [0.0, 0.011 * triangle_height], red_material),
        (inner_triangle, white_material),
    ]
    parts = [_post(style, height - 0.3 * width, generator)]
    parts += _plate(layers, np.array([0.0, height - 0.5 * triangle_height]), detail)
    return finish(parts, _square_charts(half_width, height), size)


def limit_sign(style: str, size: Point, *, generator: np.random.Generator, detail: int) -> Mesh:
    """Return a speed-limit sign (C 14 of the Vienna convention) on a post, with the panels of `stop_sign`.

    Args:
        style: Figures of the sign, km/h.
        size: Length, width and height of the body, m.
        generator: Source of randomness.
        detail: Level of detail; 0 has no figures.
    """
    _, width, height = size
    radius = 0.5 * width
    is_worn = bool(generator.random() < WORN_LIMITS)
    red_material, white_material = _draw_sheeting(generator, is_worn=is_worn)
    disc = _polygon((16, 32, 48)[detail], 0.0, radius)
    layers: list[tuple[F64, Material]] = [(disc, red_material), (0.76 * disc, white_material)]
    if detail:
        layers += [(radius * stroke, SIGN_INK) for stroke in number_strokes(style, segments=(3, 6, 10)[detail])]
    parts = [_post("standard", height - 0.1 * width, generator)]
    parts += _plate(layers, np.array([0.0, height - radius]), 2)
    return finish(parts, _square_charts(radius, height), size)


def _draw_sheeting(generator: np.random.Generator, *, is_worn: bool) -> tuple[Material, Material]:
    """Draw the red and white of a sign: new, or faded by the sun and dirty.

    The number of draws is always the same.
    """
    shade, age = float(generator.uniform(0.85, 1.15)), float(generator.uniform(0.35, 0.9)) * is_worn
    new_red, faded_red = np.array(RED.colour) * shade, np.array([0.46, 0.13, 0.10])
    clean_white, dirty_white = np.array(WHITE.colour), np.array([0.52, 0.49, 0.42])
    red_colour, white_colour = (
        fresh + age * (aged - fresh) for fresh, aged in ((new_red, faded_red), (clean_white, dirty_white))
    )
    gloss = 0.5 - 0.35 * age
    return (
        replace(RED, name="sign_red", colour=as_point(red_colour), gloss=gloss),
        replace(WHITE, name="sign_white", colour=as_point(white_colour), gloss=gloss),
    )


def _post(style: str, height: float, generator: np.random.Generator) -> Mesh:
    """Draw the post of a sign behind its plate: square steel, a green channel or wood."""
    post_kind = int(generator.choice(3, p=(0.5, 0.35, 0.15)))
    material = (POLE, POST_GREEN, WOOD)[post_kind]
    half_width = (0.025, 0.03, 0.045)[post_kind] * (1.3 if style == "large" else 1.0)
    return crate((-0.004 - 2.0 * half_width, -half_width, 0.0), (-0.004, half_width, height), material)


def _plate(layers: Sequence[tuple[F64, Material]], middle: F64, detail: int, *, panels: bool = True) -> list[Mesh]:
    """Flat polygons (y, z) about a middle, each a little before the one below, and the grey back of the first."""
    parts = []
    for layer_index, (outline, material) in enumerate(layers if detail else layers[:3]):
        # 4 mm between layers keeps the visibility pass from mixing them.
        layer_mesh = _flat(outline + middle, 0.004 * min(layer_index, 2), material, ahead=True)
        parts.append(layer_mesh.with_panel("face") if panels else layer_mesh)
    back = _flat(layers[0][0] + middle, -0.003, SIGN_BACK, ahead=False)
    parts.append(back.with_panel("back") if panels else back)
    return parts


def _flat(outline: F64, x: float, material: Material, *, ahead: bool) -> Mesh:
    """Return a polygon (y, z) at x that faces +x (ahead) or -x."""
    faces = triangulate(outline)
    return build(np.insert(outline, 0, x, axis=1), faces if ahead else faces[:, ::-1], materials=material, smooth=0.0)


def _square_charts(half_side: float, height: float) -> list[Chart]:
    """Charts of the square of half side r at the top of a sign, seen from before and from behind."""
    lower, upper = (-0.1, -half_side, height - 2.0 * half_side), (0.1, half_side, height)
    return [Chart("face", "front", lower, upper), Chart("back", "rear", lower, upper)]


def _polygon(count: int, start: float, radius: float) -> F64:
    """Return the corners [count, 2] of a regular polygon about 0, 0; `start` is the angle of the first."""
    angles = start + np.arange(count) * (2.0 * np.pi / count)
    return np.stack([radius * np.cos(angles), radius * np.sin(angles)], 1)


def _text(text: str, *, height: float, width: float) -> list[F64]:
    """Strokes of a line of capitals about 0, 0, read by who looks against +x: y runs to the reader's right."""
    advance = {letter: max(point[0] for stroke in strokes for point in stroke) for letter, strokes in LETTERS.items()}
    gap = 0.16
    length = sum(advance.get(letter, 0.35) + gap for letter in text) - gap
    cursor, outlines = 0.0, []
    for letter in text:
        for stroke in LETTERS.get(letter, ()):
            points = np.array(stroke, np.float64) - np.array([0.5 * length - cursor, 0.5])
            outlines.append(points * [width / length, height])
        cursor += advance.get(letter, 0.35) + gap
    return outlines


def _bar(y: float, z: float, half_width: float, half_height: float) -> F64:
    """Return a rectangle [4, 2] in (y, z)."""
    half_y, half_z = half_width, half_height
    return np.array(
        [(y - half_y, z - half_z), (y + half_y, z - half_z), (y + half_y, z + half_z), (y - half_y, z + half_z)]
    )
