"""Bicycles (plain, city, racing, delivery) and motorcycles (naked, sports, scooter), ridden or parked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ssad.rendering.bodies.parts import (
    BLINKER,
    CHROME,
    DARK,
    FRAME,
    GLASS,
    HEAD,
    PAINT,
    PLATE,
    RUBBER,
    STEEL,
    TAIL,
    TRIM,
    WOOD,
    as_point,
    assign_side_panels,
    both_sides,
    crate,
    crates,
    finish,
    side_charts,
    tubes,
    wheel,
)
from ssad.rendering.bodies.people import (
    CLOTHS,
    TARGET_APPEARANCE,
    draw_appearance,
    figure,
    seated_pose,
    torso_charts,
)
from ssad.rendering.meshes.mesh import Material, Mesh, Point, loft, merge, ring, sphere, tube

BICYCLES = {"plain": 0.3, "city": 0.3, "racing": 0.2, "delivery": 0.2}  # variants and their shares
MOTORCYCLES = {"naked": 0.3, "sports": 0.3, "scooter": 0.4}
BOXED = 0.35  # share of naked motorcycles and scooters with a delivery box behind the rider
TARGET_HELMET = (0.03, 0.03, 0.032)
WICKER = Material("wicker", (0.24, 0.14, 0.06), specular=0.02, gloss=0.1)
# painted parts of a motorcycle, through ovals (x, half width, lowest and highest point), m
TANK = ((-0.18, 0.09, 0.76, 0.84), (-0.05, 0.15, 0.72, 0.94), (0.14, 0.17, 0.70, 0.98), (0.30, 0.08, 0.76, 0.90))
TAIL_PIECE = ((-0.92, 0.05, 0.88, 0.95), (-0.70, 0.12, 0.74, 0.90), (-0.25, 0.13, 0.66, 0.80))
MUDGUARD = ((0.45, 0.05, 0.58, 0.62), (0.60, 0.07, 0.62, 0.69), (0.75, 0.07, 0.63, 0.695), (0.93, 0.05, 0.54, 0.60))
SHIELD = ((0.36, 0.20, 0.30, 0.80), (0.46, 0.23, 0.30, 0.98), (0.56, 0.15, 0.40, 0.98))
UNDER_SEAT = (
    (-0.94, 0.06, 0.62, 0.76),
    (-0.72, 0.16, 0.46, 0.80),
    (-0.30, 0.18, 0.28, 0.78),
    (-0.12, 0.14, 0.28, 0.74),
)
SMALL_MUDGUARD = (
    (0.42, 0.06, 0.40, 0.46),
    (0.56, 0.09, 0.46, 0.53),
    (0.74, 0.09, 0.46, 0.52),
    (0.90, 0.06, 0.32, 0.40),
)
ENGINE = ((-0.26, 0.13, 0.26, 0.50), (-0.05, 0.17, 0.22, 0.56), (0.12, 0.16, 0.24, 0.66), (0.30, 0.11, 0.30, 0.56))
FRAME_COVER = (
    (-0.56, 0.06, 0.64, 0.78),
    (-0.30, 0.12, 0.46, 0.80),
    (-0.05, 0.13, 0.48, 0.82),
    (0.32, 0.07, 0.62, 0.86),
)
DARK_RIM = Material("rim", (0.09, 0.09, 0.095), specular=0.2, gloss=0.6)
ENGINE_BLOCK = Material("engine", (0.045, 0.045, 0.048), specular=0.12, gloss=0.5)
FAIRING = ((0.12, 0.24, 0.38, 0.80), (0.45, 0.22, 0.46, 1.00), (0.72, 0.13, 0.76, 1.02), (0.80, 0.05, 0.82, 0.96))


def _variant(table: Mapping[str, float], share: float) -> str:
    """Return the variant whose part of [0, 1) contains a share."""
    return list(table)[
        int(np.searchsorted(np.cumsum(list(table.values())), share, side="right").clip(0, len(table) - 1))
    ]


def bicycle(
    style: str, size: Point, *, generator: np.random.Generator, detail: int, phase: float | None = None
) -> Mesh:
    """Return a bicycle that fills its size (m), with its rider when ridden.

    Its variant (see `BICYCLES`) is drawn. `phase` is the angle of the left crank, rad; None draws it.
    """
    appearance = draw_appearance(generator, helmet=bool(generator.random() < 0.5), rider=True)
    random_phase, uprightness = generator.uniform(0.0, 2.0 * np.pi), float(generator.random())
    variant = _variant(BICYCLES, float(generator.random()))
    if style == "bicyclist_target":
        appearance, variant, uprightness = TARGET_APPEARANCE, "plain", 0.5
    # Drawn before the variant is known, so that the number of draws is fixed.
    uprightness = {"city": 1.0, "racing": 0.0}.get(variant, uprightness)
    crank = float(random_phase if phase is None else phase)
    wheel_radius, wheelbase = 0.34, 1.04
    front, rear = np.array([0.5 * wheelbase, 0.0, wheel_radius]), np.array([-0.5 * wheelbase, 0.0, wheel_radius])
    bottom_bracket, saddle = np.array([-0.08, 0.0, 0.28]), np.array([-0.24, 0.0, 0.93])
    seat_top, head_tube, fork_crown = (
        np.array([-0.20, 0.0, 0.78]),
        np.array([0.33, 0.0, 0.86]),
        np.array([0.36, 0.0, 0.72]),
    )
    segments = (4, 5, 8)[detail]
    parts = [
        ring(wheel_radius, 0.045, material=RUBBER, segments=(10, 16, 28)[detail], around=(3, 4, 6)[detail]).moved(*hub)
        for hub in (front, rear)
    ]
    if detail == 2:
        for hub in (front, rear):
            angles = np.linspace(0.0, np.pi, 6, endpoint=False)
            spokes = [
                0.93 * wheel_radius * np.array([np.cos(spoke_angle), 0.0, np.sin(spoke_angle)])
                for spoke_angle in angles
            ]
            parts += [tube([hub - spoke, hub + spoke], 0.004, material=STEEL, segments=3) for spoke in spokes]
    frame_tubes = [
        (bottom_bracket, seat_top),
        (bottom_bracket, fork_crown),
        (0.9 * seat_top + 0.1 * bottom_bracket, head_tube),
        (fork_crown, head_tube),
    ]
    painted = [tube(bar, 0.019, material=PAINT, segments=segments) for bar in frame_tubes]
    frame_stays = [(bottom_bracket, rear), (seat_top, rear)] if detail else [(bottom_bracket, rear)]
    painted += [tube(bar, 0.013, material=PAINT, segments=segments) for bar in frame_stays]
    parts.append(assign_side_panels(merge(painted), "frame"))
    parts.append(tube([fork_crown, front], 0.018, material=FRAME, segments=segments))
    parts.append(tube([seat_top, saddle], 0.014, material=STEEL, segments=segments))
    parts.append(sphere((0.14, 0.07, 0.035), material=TRIM, centre=(-0.26, 0.0, 0.95), segments=max(6, segments)))
    stem = np.array([0.36, 0.0, 1.0])
    parts.append(tube([head_tube, stem], 0.016, material=STEEL, segments=segments))
    if variant == "racing":  # the hands rest on the hoods of a drop bar
        grip = np.array([0.50, 0.21, 0.95])
        drop_bend = [grip, (0.52, 0.21, 0.90), (0.46, 0.21, 0.83), (0.36, 0.21, 0.83)]
        parts.append(tubes([stem, stem + np.array([0.0, 0.20, 0.0]), *drop_bend], 0.014, TRIM, segments))
    else:
        grip = np.array([0.27 + 0.12 * (1.0 - uprightness), 0.29, 1.02])
        if variant == "city":
            grip = np.array([0.18, 0.28, 1.05])
        parts.append(tubes([stem, stem + np.array([0.0, 0.18, 0.02]), grip], 0.014, TRIM, segments))
    parts += _carriers(variant, wheel_radius, wheelbase, detail)
    foot_points: list[Point] = []
    for sign, angle in ((1.0, crank), (-1.0, crank + np.pi)):
        pedal = bottom_bracket + 0.17 * np.array([np.sin(angle), 0.0, np.cos(angle)]) + [0.0, sign * 0.11, 0.0]
        foot_points.append(as_point(np.add(pedal, [0.0, 0.0, 0.02])))
        if detail:
            parts.append(
                tube(
                    [bottom_bracket + np.array([0.0, sign * 0.06, 0.0]), pedal],
                    0.012,
                    material=STEEL,
                    segments=segments,
                )
            )
            x, y, z = pedal
            parts.append(crate((x - 0.05, y - 0.04, z - 0.012), (x + 0.05, y + 0.04, z + 0.012), TRIM))
    if detail:
        has_load = variant in ("city", "delivery")  # the load hides the usual places
        x, z = (0.70, 0.655) if has_load else (0.44, 0.87)
        parts.append(crate((x, -0.035, z - 0.035), (x + 0.03, 0.035, z + 0.035), HEAD))
        parts.append(crate((x - 0.03, -0.045, z - 0.045), (x, 0.045, z + 0.045), TRIM))
        x, z = (-0.84, 0.70) if variant == "city" else (-0.36, 0.77)
        parts.append(crate((x, -0.035, z - 0.04), (x + 0.03, 0.035, z + 0.04), TAIL))
        parts.append(crate((x + 0.03, -0.04, z - 0.045), (x + 0.04, 0.04, z + 0.045), TRIM))
    charts = side_charts("frame", (-0.5 * size[0], -0.1, 0.1 * size[2]), (0.5 * size[0], 0.1, 0.75 * size[2]))
    if style != "parked":
        hand_points = [as_point(grip * [1.0, side, 1.0] + [0.0, 0.0, 0.02]) for side in (1.0, -1.0)]
        trunk_lean = {"city": 0.12, "racing": 0.85}.get(variant, 0.35 + 0.35 * (1.0 - uprightness))
        pose = seated_pose(
            1.75,
            pelvis=(-0.24, 0.0, 1.03),
            lean=trunk_lean,
            hands=(hand_points[0], hand_points[1]),
            feet=(foot_points[0], foot_points[1]),
        )
        parts.append(figure(pose, appearance, height=1.75, detail=detail))
        charts += torso_charts((-0.3, -0.3, 0.55 * size[2]), (0.5, 0.3, 0.95 * size[2]))
    return finish(parts, charts, size)


def _carriers(variant: str, radius: float, base: float, detail: int) -> list[Mesh]:
    """Return the racks and boxes of a city or delivery bicycle, and its mudguards."""
    if variant == "city":
        parts = [
            crate((0.44, -0.17, 0.76), (0.72, 0.17, 0.98), WICKER),
            crate((-0.84, -0.07, 0.735), (-0.34, 0.07, 0.755), FRAME),
        ]
        if detail:
            parts.append(tubes([(-0.5 * base, 0.07, radius), (-0.72, 0.07, 0.74)], 0.008, FRAME, 4))
            for x, first_angle, last_angle in ((0.5 * base, -0.5, 1.0), (-0.5 * base, -1.5, 0.5)):
                angles = np.linspace(first_angle, last_angle, 5 if detail == 1 else 9)
                arc = [(x + 0.375 * np.sin(arc_angle), 0.0, radius + 0.375 * np.cos(arc_angle)) for arc_angle in angles]
                parts.append(tube(arc, 0.024, material=TRIM, segments=4))
        return parts
    if variant == "delivery":
        parts = [crate((0.32, -0.26, 0.74), (0.82, 0.26, 1.06), WOOD)]
        if detail:
            parts.append(tubes([(0.5 * base, 0.07, radius), (0.72, 0.14, 0.74)], 0.012, FRAME, 4))
            parts.append(crate((0.36, -0.22, 1.055), (0.78, 0.22, 1.065), DARK))
        return parts
    return []


def motorcycle(style: str, size: Point, *, generator: np.random.Generator, detail: int) -> Mesh:
    """Return a motorcycle that fills its size (m), with its rider when ridden.

    Its variant (see `MOTORCYCLES`) is drawn.
    """
    appearance = draw_appearance(generator, helmet=True, rider=True, visor=True)
    variant = _variant(MOTORCYCLES, float(generator.random()))
    has_box = bool(generator.random() < BOXED) and variant != "sports"
    if style == "motorcyclist_target":
        helmet = replace(appearance.helmet or TARGET_APPEARANCE.shirt, colour=TARGET_HELMET)
        appearance = replace(TARGET_APPEARANCE, helmet=helmet, visor=True)
        variant, has_box = "naked", False
    # All random numbers are drawn for every variant, so that their number never depends on it.
    colour = CLOTHS[int(generator.integers(1, len(CLOTHS)))]
    segments = (4, 6, 10)[detail]
    is_scooter = variant == "scooter"
    painted, parts = (
        _scooter(segments, detail) if is_scooter else _motorbike(segments, detail, fairing=variant == "sports")
    )
    parts.append(assign_side_panels(merge(painted), "body"))
    grip = np.array([0.32, 0.33, 1.05]) if is_scooter else np.array([0.26, 0.34, 1.04])
    if has_box:
        material = Material("delivery_box", colour, specular=0.03, gloss=0.3)
        parts.append(crate((-1.02, -0.24, 0.90), (-0.60, 0.24, 1.34), material))
        parts.append(crate((-1.02, -0.245, 1.22), (-0.60, 0.245, 1.25), TRIM))
    parts.append(crate((-0.95, -0.08, 0.83), (-0.90, 0.08, 0.90), TAIL))
    parts.append(crate((-1.0, -0.09, 0.58), (-0.98, 0.09, 0.74), PLATE))
    parts.append(crate((-0.99, -0.03, 0.60), (-0.80, 0.03, 0.86), TRIM))
    if detail:
        parts.append(crates((-0.94, 0.12, 0.80), (-0.90, 0.17, 0.84), BLINKER))
    charts = side_charts("body", (-0.5 * size[0], -0.3, 0.15 * size[2]), (0.5 * size[0], 0.3, 0.9 * size[2]))
    if style != "parked":
        hand_points = [as_point(grip * [1.0, side, 1.0] + [-0.03, 0.0, 0.03]) for side in (1.0, -1.0)]
        foot_points = (
            ((0.24, 0.13, 0.33), (0.24, -0.13, 0.33)) if is_scooter else ((0.02, 0.22, 0.33), (0.02, -0.22, 0.33))
        )
        trunk_lean = {"sports": 0.55, "naked": 0.25, "scooter": 0.10}[variant]
        knee_spread = 0.05 if is_scooter else 0.25
        pose = seated_pose(
            1.76,
            pelvis=(-0.30, 0.0, 0.92),
            lean=trunk_lean,
            hands=(hand_points[0], hand_points[1]),
            feet=foot_points,
            knees_out=knee_spread,
        )
        parts.append(figure(pose, appearance, height=1.76, detail=detail))
        charts += torso_charts((-0.5, -0.3, 0.5 * size[2]), (0.5, 0.3, 0.95 * size[2]))
    return finish(parts, charts, size)


def _tyres(axles: Sequence[tuple[float, float]], radius: float, detail: int) -> list[Mesh]:
    """Return the wheels of a motorcycle at each (x, width), m."""
    parts = []
    for x, width in axles:
        half_width, segments = 0.5 * (width + 0.1), (10, 14, 24)[detail]
        tyre = ring(radius, half_width, material=RUBBER, segments=segments, around=(4, 5, 8)[detail])
        parts.append(tyre.moved(x, 0.0, radius))
        if detail:
            # Each half keeps to its side: the inner end of one would hide the spokes of the other.
            rim_disc = wheel(0.80 * radius, 0.04, detail=detail, rim=0.94, spokes=5, steel=DARK_RIM)
            parts.append(both_sides(rim_disc.moved(y=0.022)).moved(x, 0.0, radius))
    return parts


def _mirrors(detail: int) -> list[Mesh]:
    """Return mirrors over the handlebar, with their stalks."""
    if detail == 0:
        return []
    segments = (4, 6, 10)[detail]
    mirror = sphere((0.02, 0.06, 0.045), material=TRIM, centre=(0.36, 0.30, 1.18), segments=segments)
    return [both_sides(mirror), tubes([(0.32, 0.24, 1.04), (0.36, 0.29, 1.17)], 0.008, TRIM, 4)]


def _motorbike(segments: int, detail: int, *, fairing: bool) -> tuple[list[Mesh], list[Mesh]]:
    """Painted and other parts of a motorcycle with its engine below the tank, with or without a fairing."""
    wheel_radius = 0.32
    front_hub, rear_hub = np.array([0.72, 0.0, wheel_radius]), np.array([-0.70, 0.0, wheel_radius])
    parts = _tyres(((0.72, 0.12), (-0.70, 0.17)), wheel_radius, detail)
    painted = [_pod(ovals, segments) for ovals in (TANK, TAIL_PIECE, MUDGUARD)]
    if fairing:
        painted.append(_pod(FAIRING, segments))
        parts.append(_pod([(0.35, 0.13, 0.98, 1.16), (0.62, 0.11, 0.98, 1.08)], segments, GLASS))
    parts.append(
        _pod([(-0.74, 0.13, 0.84, 0.94), (-0.35, 0.16, 0.78, 0.85), (-0.10, 0.12, 0.78, 0.86)], segments, TRIM)
    )
    parts.append(_pod(ENGINE, segments, ENGINE_BLOCK))
    parts.append(_pod(FRAME_COVER, segments, TRIM))
    parts.append(crate((-0.06, -0.21, 0.28), (0.10, 0.21, 0.40), STEEL))
    fork_crown = np.array([0.40, 0.0, 0.95])
    side_offset = np.array([0.0, 0.09, 0.0])
    parts.append(tubes([fork_crown + side_offset, front_hub + side_offset], 0.028, STEEL, segments))
    parts.append(
        tube(np.array([fork_crown - [0.04, 0.0, 0.06], (0.24, 0.0, 0.44)]), 0.04, material=FRAME, segments=segments)
    )
    if detail:
        parts.append(
            tubes(np.array([(-0.20, 0.11, 0.40), rear_hub + np.array([0.0, 0.11, 0.0])]), 0.03, FRAME, segments)
        )
        parts.append(tubes([(-0.48, 0.10, 0.70), rear_hub + np.array([0.04, 0.10, 0.06])], 0.022, STEEL, segments))
        for z in (0.46, 0.52, 0.58):  # cooling fins
            parts.append(crate((0.02, -0.15, z), (0.22, 0.15, z + 0.02), STEEL))
        exhaust = [(0.15, -0.16, 0.24), (-0.45, -0.20, 0.24), (-0.82, -0.22, 0.42)]
        parts.append(tube(exhaust, [0.03, 0.045, 0.06], material=CHROME, segments=segments))
        blinker = sphere((0.03, 0.03, 0.03), material=BLINKER, centre=(0.46, 0.20, 0.90), segments=6)
        parts.append(both_sides(blinker))
    parts.append(
        tubes(
            np.array([fork_crown, fork_crown + np.array([-0.02, 0.16, 0.08]), (0.26, 0.34, 1.04)]),
            0.016,
            TRIM,
            segments,
        )
    )
    lamp_position = (0.77 if fairing else 0.56, 0.0, 0.90)
    parts.append(sphere((0.05, 0.095, 0.085), material=HEAD, centre=lamp_position, segments=max(6, segments)))
    return painted, parts + _mirrors(detail)


def _scooter(segments: int, detail: int) -> tuple[list[Mesh], list[Mesh]]:
    """Painted and other parts of a scooter: small wheels, a shield before the legs, a floor to step through."""
    painted = [_pod(ovals, segments) for ovals in (SHIELD, UNDER_SEAT, SMALL_MUDGUARD)]
    painted.append(_pod([(0.36, 0.12, 0.98, 1.08), (0.46, 0.14, 0.94, 1.12), (0.53, 0.06, 0.97, 1.06)], segments))
    parts = _tyres(((0.66, 0.12), (-0.62, 0.14)), 0.24, detail)
    parts.append(crate((-0.14, -0.18, 0.26), (0.42, 0.18, 0.32), TRIM))
    parts.append(
        _pod([(-0.84, 0.13, 0.78, 0.88), (-0.40, 0.16, 0.76, 0.85), (-0.12, 0.12, 0.74, 0.82)], segments, TRIM)
    )
    parts.append(tube([(0.50, 0.0, 0.90), (0.66, 0.0, 0.24)], 0.035, material=STEEL, segments=segments))
    parts.append(tubes([(0.44, 0.10, 1.02), (0.32, 0.33, 1.05)], 0.018, TRIM, segments))
    parts.append(sphere((0.03, 0.085, 0.07), material=HEAD, centre=(0.53, 0.0, 1.02), segments=max(6, segments)))
    if detail:
        parts.append(crates((0.535, 0.10, 0.74), (0.565, 0.17, 0.79), BLINKER))
        parts.append(
            tube([(-0.25, -0.17, 0.26), (-0.80, -0.20, 0.34)], [0.03, 0.05], material=FRAME, segments=segments)
        )
    return painted, parts + _mirrors(detail)


def _pod(rows: Sequence[tuple[float, float, float, float]], segments: int, material: Material = PAINT) -> Mesh:
    """A rounded body along x through ovals (x, half width, lowest and highest point)."""
    angles = np.arange(2 * segments) * (np.pi / segments)
    cosine, sine = np.cos(angles), np.sin(angles)
    # A superellipse: a little fuller than an ellipse.
    cosine, sine = np.sign(cosine) * np.abs(cosine) ** 0.8, np.sign(sine) * np.abs(sine) ** 0.8
    sections = [
        np.stack(
            [np.full(2 * segments, x), half_width * cosine, 0.5 * (lowest + highest) + 0.5 * (highest - lowest) * sine],
            1,
        )
        for x, half_width, lowest, highest in rows
    ]
    return loft(np.array(sections), material=material, smooth=1.0)
