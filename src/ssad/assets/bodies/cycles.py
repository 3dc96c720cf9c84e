"""Bicycles and motorcycles, ridden or parked."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ssad.assets.bodies.parts import (
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
    as_point,
    both_sides,
    crate,
    finish,
    side_charts,
    sided,
    tubes,
    wheel,
)
from ssad.assets.bodies.people import draw_look, figure, seated, torso_charts
from ssad.assets.mesh import Material, Mesh, Point, loft, merge, ring, sphere, tube

# painted parts of a motorcycle, through ovals (x, half width, lowest and highest point), m
TANK = ((-0.18, 0.09, 0.76, 0.84), (-0.05, 0.15, 0.72, 0.94), (0.14, 0.17, 0.70, 0.98), (0.30, 0.08, 0.76, 0.90))
TAIL_PIECE = ((-0.92, 0.05, 0.88, 0.95), (-0.70, 0.12, 0.74, 0.90), (-0.25, 0.13, 0.66, 0.80))
MUDGUARD = ((0.45, 0.05, 0.58, 0.62), (0.60, 0.07, 0.62, 0.69), (0.75, 0.07, 0.63, 0.695), (0.93, 0.05, 0.54, 0.60))
FAIRING = ((0.12, 0.24, 0.38, 0.80), (0.45, 0.22, 0.46, 1.00), (0.72, 0.13, 0.76, 1.02), (0.80, 0.05, 0.82, 0.96))


def bicycle(
    style: str, size: Point, *, generator: np.random.Generator, detail: int, phase: float | None = None
) -> Mesh:
    """A bicycle that fills its size (m), with its rider when ridden; `phase` is the angle of the left crank, rad."""
    look = draw_look(generator, helmet=bool(generator.random() < 0.5), rider=True)
    drawn, upright = generator.uniform(0.0, 2.0 * np.pi), float(generator.random())
    crank = float(drawn if phase is None else phase)
    radius, base = 0.34, 1.04
    front, rear = np.array([0.5 * base, 0.0, radius]), np.array([-0.5 * base, 0.0, radius])
    bracket, saddle = np.array([-0.08, 0.0, 0.28]), np.array([-0.24, 0.0, 0.93])
    seat, head, crown = np.array([-0.20, 0.0, 0.78]), np.array([0.33, 0.0, 0.86]), np.array([0.36, 0.0, 0.72])
    n = (4, 5, 8)[detail]
    parts = [
        ring(radius, 0.045, material=RUBBER, segments=(10, 16, 28)[detail], around=(3, 4, 6)[detail]).moved(*c)
        for c in (front, rear)
    ]
    if detail == 2:
        for c in (front, rear):
            angles = np.linspace(0.0, np.pi, 6, endpoint=False)
            ends = [0.93 * radius * np.array([np.cos(a), 0.0, np.sin(a)]) for a in angles]
            parts += [tube([c - e, c + e], 0.004, material=STEEL, segments=3) for e in ends]
    bars = [(bracket, seat), (bracket, crown), (0.9 * seat + 0.1 * bracket, head), (crown, head)]
    painted = [tube(bar, 0.019, material=PAINT, segments=n) for bar in bars]
    stays = [(bracket, rear), (seat, rear)] if detail else [(bracket, rear)]
    painted += [tube(bar, 0.013, material=PAINT, segments=n) for bar in stays]
    parts.append(sided(merge(painted), "frame"))
    parts.append(tube([crown, front], 0.018, material=FRAME, segments=n))
    parts.append(tube([seat, saddle], 0.014, material=STEEL, segments=n))
    parts.append(sphere((0.14, 0.07, 0.035), material=TRIM, centre=(-0.26, 0.0, 0.95), segments=max(6, n)))
    grip = np.array([0.27 + 0.12 * (1.0 - upright), 0.29, 1.02])
    stem = np.array([0.36, 0.0, 1.0])
    parts.append(tube([head, stem], 0.016, material=STEEL, segments=n))
    parts.append(tubes([stem, stem + np.array([0.0, 0.18, 0.02]), grip], 0.014, TRIM, n))
    feet: list[Point] = []
    for sign, angle in ((1.0, crank), (-1.0, crank + np.pi)):
        pedal = bracket + 0.17 * np.array([np.sin(angle), 0.0, np.cos(angle)]) + [0.0, sign * 0.11, 0.0]
        feet.append(as_point(np.add(pedal, [0.0, 0.0, 0.02])))
        if detail:
            parts.append(tube([bracket + np.array([0.0, sign * 0.06, 0.0]), pedal], 0.012, material=STEEL, segments=n))
            x, y, z = pedal
            parts.append(crate((x - 0.05, y - 0.04, z - 0.012), (x + 0.05, y + 0.04, z + 0.012), TRIM))
    if detail:
        parts.append(crate((0.40, -0.03, 0.84), (0.45, 0.03, 0.90), HEAD))
        parts.append(crate((-0.36, -0.02, 0.74), (-0.33, 0.02, 0.80), TAIL))
    charts = side_charts("frame", (-0.5 * size[0], -0.1, 0.1 * size[2]), (0.5 * size[0], 0.1, 0.75 * size[2]))
    if style == "ridden":
        hands = [as_point(grip * [1.0, s, 1.0] + [0.0, 0.0, 0.02]) for s in (1.0, -1.0)]
        lean = 0.35 + 0.35 * (1.0 - upright)
        pose = seated(1.75, pelvis=(-0.24, 0.0, 1.03), lean=lean, hands=(hands[0], hands[1]), feet=(feet[0], feet[1]))
        parts.append(figure(pose, look, height=1.75, detail=detail))
        charts += torso_charts((-0.3, -0.3, 0.55 * size[2]), (0.5, 0.3, 0.95 * size[2]))
    return finish(parts, charts, size)


def motorcycle(style: str, size: Point, *, generator: np.random.Generator, detail: int) -> Mesh:
    """A motorcycle that fills its size (m), with its rider when ridden."""
    look = draw_look(generator, helmet=True, rider=True, visor=True)
    fairing = bool(generator.random() < 0.5)
    radius = 0.32
    front, rear = np.array([0.72, 0.0, radius]), np.array([-0.70, 0.0, radius])
    n = (4, 6, 10)[detail]
    parts: list[Mesh] = []
    for c, width in ((front, 0.12), (rear, 0.17)):
        thick, steps = 0.5 * (width + 0.1), (10, 14, 24)[detail]
        parts.append(ring(radius, thick, material=RUBBER, segments=steps, around=(4, 5, 8)[detail]).moved(*c))
        if detail:
            disc = wheel(0.75 * radius, 0.07, detail=detail, rim=0.97, spokes=5)
            parts.append(both_sides(disc).moved(*c))
    painted = [_pod(rows, n) for rows in (TANK, TAIL_PIECE, MUDGUARD)]
    if fairing:
        painted.append(_pod(FAIRING, n))
        parts.append(_pod([(0.35, 0.13, 0.98, 1.16), (0.62, 0.11, 0.98, 1.08)], n, GLASS))
    parts.append(sided(merge(painted), "body"))
    parts.append(_pod([(-0.74, 0.13, 0.84, 0.94), (-0.35, 0.16, 0.78, 0.85), (-0.10, 0.12, 0.78, 0.86)], n, TRIM))
    parts.append(_pod([(-0.28, 0.17, 0.26, 0.62), (-0.05, 0.20, 0.22, 0.70), (0.28, 0.17, 0.28, 0.66)], n, DARK))
    parts.append(crate((-0.05, -0.25, 0.30), (0.12, 0.25, 0.42), STEEL))
    crown = np.array([0.40, 0.0, 0.95])
    aside = np.array([0.0, 0.09, 0.0])
    fork = tube([crown + aside, front + aside], 0.028, material=STEEL, segments=n)
    arm = tube(np.array([(-0.20, 0.11, 0.40), rear + np.array([0.0, 0.11, 0.0])]), 0.03, material=FRAME, segments=n)
    grip = np.array([0.26, 0.34, 1.04])
    bar = tube(np.array([crown, crown + np.array([-0.02, 0.16, 0.08]), grip]), 0.016, material=TRIM, segments=n)
    mirror = sphere((0.02, 0.06, 0.045), material=TRIM, centre=(0.36, 0.30, 1.18), segments=max(6, n))
    stalk = tube([(0.32, 0.24, 1.04), (0.36, 0.29, 1.17)], 0.008, material=TRIM, segments=4)
    parts.append(both_sides(merge([fork, arm, bar, mirror, stalk] if detail else [fork, bar])))
    if detail:
        exhaust = [(0.15, -0.16, 0.24), (-0.45, -0.20, 0.24), (-0.82, -0.22, 0.42)]
        parts.append(tube(exhaust, [0.03, 0.045, 0.06], material=CHROME, segments=n))
    place = (0.77 if fairing else 0.56, 0.0, 0.90)
    parts.append(sphere((0.05, 0.095, 0.085), material=HEAD, centre=place, segments=max(6, n)))
    parts.append(crate((-0.95, -0.06, 0.86), (-0.90, 0.06, 0.92), TAIL))
    parts.append(crate((-1.0, -0.09, 0.58), (-0.98, 0.09, 0.74), PLATE))
    parts.append(crate((-0.99, -0.03, 0.60), (-0.80, 0.03, 0.86), TRIM))
    charts = side_charts("body", (-0.5 * size[0], -0.3, 0.15 * size[2]), (0.5 * size[0], 0.3, 0.9 * size[2]))
    if style == "ridden":
        hands = [as_point(grip * [1.0, s, 1.0] + [-0.03, 0.0, 0.03]) for s in (1.0, -1.0)]
        feet = ((0.02, 0.22, 0.33), (0.02, -0.22, 0.33))
        lean = 0.55 if fairing else 0.25
        pose = seated(1.76, pelvis=(-0.30, 0.0, 0.92), lean=lean, hands=(hands[0], hands[1]), feet=feet, knees_out=0.25)
        parts.append(figure(pose, look, height=1.76, detail=detail))
        charts += torso_charts((-0.5, -0.3, 0.5 * size[2]), (0.5, 0.3, 0.95 * size[2]))
    return finish(parts, charts, size)


def _pod(rows: Sequence[tuple[float, float, float, float]], n: int, material: Material = PAINT) -> Mesh:
    """A rounded body along x through ovals (x, half width, lowest and highest point)."""
    angle = np.arange(2 * n) * (np.pi / n)
    c, s = np.cos(angle), np.sin(angle)
    c, s = np.sign(c) * np.abs(c) ** 0.8, np.sign(s) * np.abs(s) ** 0.8
    sections = [np.stack([np.full(2 * n, x), w * c, 0.5 * (a + b) + 0.5 * (b - a) * s], 1) for x, w, a, b in rows]
    return loft(np.array(sections), material=material, smooth=1.0)
