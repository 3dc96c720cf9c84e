"""Construction vehicles: excavator and wheel loader.

Their yellow is not a car's paint, but their panels can carry a texture.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ssad.rendering.bodies.parts import (
    DARK,
    FRAME,
    GLASS,
    HEAD,
    RUBBER,
    STEEL,
    TAIL,
    TRIM,
    assign_side_panels,
    both_sides,
    crate,
    crates,
    finish,
    side_charts,
    wheels,
)
from ssad.rendering.meshes.mesh import Material, Mesh, Point, lathe, merge, prism, tube

COLOURS = ((0.72, 0.40, 0.02), (0.75, 0.33, 0.03), (0.70, 0.48, 0.05), (0.60, 0.14, 0.03))

# outlines (x, z) of the excavator, m
HOUSE = ((-2.0, 1.0), (-2.0, 1.75), (-1.75, 2.05), (0.1, 2.05), (0.15, 1.55), (1.2, 1.45), (1.25, 0.95), (-1.7, 0.92))
CAB = ((-0.15, 1.05), (-0.15, 2.85), (0.85, 2.85), (1.3, 1.85), (1.3, 1.05))
CAB_SIDE = ((-0.02, 1.75), (-0.02, 2.72), (0.78, 2.72), (1.18, 1.85), (1.18, 1.45), (0.5, 1.45))
WINDSCREEN = ((1.0, 2.55), (0.87, 2.80), (0.90, 2.80), (1.32, 1.86), (1.32, 1.30), (1.28, 1.30), (1.28, 1.86))
BUCKET = (
    (-0.15, 1.05),
    (0.35, 1.0),
    (0.55, 0.55),
    (0.25, 0.08),
    (-0.30, 0.05),
    (-0.55, 0.25),
    (-0.15, 0.35),
    (0.1, 0.6),
)
# outlines of the wheel loader
REAR = ((-2.7, 0.75), (-2.7, 1.55), (-2.45, 1.85), (-0.75, 1.95), (-0.6, 1.2), (-0.3, 0.8), (-0.5, 0.55), (-2.3, 0.55))
FRONT = ((0.2, 0.6), (0.2, 1.35), (0.7, 1.75), (1.1, 1.7), (1.7, 0.9), (1.7, 0.6))
FENDERS = (
    ((-2.25, 1.45), (-2.1, 1.62), (-0.75, 1.62), (-0.55, 1.2), (-0.65, 1.2), (-0.85, 1.52), (-2.0, 1.52)),
    ((0.45, 1.2), (0.62, 1.56), (1.88, 1.56), (2.05, 1.3), (1.9, 1.46), (0.72, 1.46)),
)
SHOVEL = ((0.0, 0.85), (0.25, 0.98), (0.15, 0.25), (0.9, 0.06), (0.95, 0.0), (0.1, 0.0), (-0.08, 0.3))


def construction(style: str, size: Point, *, generator: np.random.Generator, detail: int) -> Mesh:
    """Return an excavator on tracks or a wheel loader that fills its size, m."""
    machine = Material("machine", COLOURS[int(generator.integers(len(COLOURS)))], specular=0.05, gloss=0.5)
    reach = float(generator.uniform(0.0, 1.0))
    parts = _excavator(machine, reach, detail) if style == "excavator" else _loader(machine, reach, detail)
    charts = side_charts(
        "body", (-0.5 * size[0], -0.5 * size[1], 0.05 * size[2]), (0.5 * size[0], 0.5 * size[1], size[2])
    )
    return finish(parts, charts, size)


def _slab(outline: npt.ArrayLike, half: float, material: Material, y: float = 0.0) -> Mesh:
    """Return a plate in the (x, z) plane, `half` m to both sides of y."""
    return prism(outline, (y - half, y + half), axis=1, material=material)


def _bar(path: list[tuple[float, float]], depths: list[float], half: float, material: Material) -> Mesh:
    """Return a box beam along a path in the (x, z) plane, with its depth at each point."""
    points = np.array(path)
    tangents = np.gradient(points, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    half_depths = np.stack([-tangents[:, 1], tangents[:, 0]], 1) * 0.5 * np.array(depths)[:, None]
    return _slab(np.concatenate([points + half_depths, (points - half_depths)[::-1]]), half, material)


def _excavator(machine: Material, reach: float, detail: int) -> list[Mesh]:
    parts: list[Mesh] = []
    step_count = (5, 7, 12)[detail]
    angles = np.linspace(-np.pi / 2, np.pi / 2, step_count)
    front_arc = [(1.55 + 0.42 * np.cos(angle), 0.42 + 0.42 * np.sin(angle)) for angle in angles]
    outline = [*front_arc, *[(-x, z) for x, z in front_arc[::-1]]]
    track_parts = [
        _slab(outline, 0.30, RUBBER, 1.10),
        _slab([(0.86 * x, 0.42 + 0.62 * (z - 0.42)) for x, z in outline], 0.31, FRAME, 1.10),
    ]
    if detail == 2:
        track_parts += [
            lathe([(0.17, 0.0), (0.17, 0.33)], material=STEEL, segments=10, axis=1).moved(x, 1.10, 0.30)
            for x in (-0.9, -0.3, 0.3, 0.9)
        ]
    parts.append(both_sides(merge(track_parts)))
    parts.append(crate((-0.9, -0.85, 0.45), (0.9, 0.85, 0.85), DARK))
    painted = [_slab(HOUSE, 1.18, machine)]
    painted.append(_slab(CAB, 0.46, machine, 0.70))
    parts.append(_slab(CAB_SIDE, 0.475, GLASS, 0.70))
    parts.append(_slab(WINDSCREEN, 0.38, GLASS, 0.70))
    bucket_x = 4.7 + 0.6 * reach
    boom_bend = (2.5 + 0.2 * reach, 3.35)
    elbow = (3.9 + 0.4 * reach, 3.05 - 0.3 * reach)
    painted.append(_bar([(0.9, 1.4), boom_bend, elbow], [0.38, 0.50, 0.30], 0.20, machine))
    dipper_path = [(elbow[0] - 0.35, elbow[1] + 0.25), elbow, (bucket_x - 0.45, 0.95)]
    painted.append(_bar(dipper_path, [0.25, 0.42, 0.20], 0.16, machine))
    parts.append(_slab(np.add(BUCKET, [bucket_x - 0.45, 0.0]), 0.55, STEEL))
    if detail:
        cylinders = (
            ([(1.25, 0.0, 1.25), (boom_bend[0] - 0.1, 0.0, boom_bend[1] - 0.35)], [0.09, 0.05]),
            ([(boom_bend[0], 0.0, boom_bend[1] + 0.25), (elbow[0] - 0.3, 0.0, elbow[1] + 0.22)], [0.08, 0.05]),
        )
        parts += [tube(path, radii, material=STEEL, segments=8) for path, radii in cylinders]
        parts.append(crates((-2.02, 0.85, 1.15), (-1.98, 1.05, 1.3), TAIL))
        parts.append(crate((-1.4, -0.6, 2.05), (-1.2, -0.45, 2.45), TRIM))
        parts.append(crate((-1.1, -1.19, 1.35), (0.0, -1.15, 1.85), TRIM))
        parts.append(crate((1.0, -0.9, 1.45), (1.1, -0.7, 1.6), HEAD))
    parts.append(assign_side_panels(merge(painted), "body"))
    return parts


def _loader(machine: Material, reach: float, detail: int) -> list[Mesh]:
    parts = [wheels([(1.25, 1.25), (-1.35, 1.25)], 0.72, 0.52, detail=detail, rim=0.5, spokes=1, steel=machine)]
    painted = [_slab(REAR, 0.72, machine), _slab(FRONT, 0.42, machine)]
    painted += [both_sides(_slab(fender, 0.25, machine, 0.99)) for fender in FENDERS]
    parts.append(crate((-0.6, -0.3, 0.6), (0.4, 0.3, 1.0), DARK))
    parts.append(_slab([(-0.82, 1.7), (-0.9, 2.85), (0.22, 2.85), (0.38, 1.7)], 0.66, GLASS))
    parts.append(_slab([(-0.84, 1.3), (-0.87, 1.7), (0.4, 1.7), (0.45, 1.3)], 0.67, FRAME))
    painted.append(crate((-1.0, -0.72, 2.85), (0.32, 0.72, 3.05), machine))
    cab_posts = [
        _slab([(x, 1.5), (x + slant, 2.9), (x + slant + 0.09, 2.9), (x + 0.09, 1.5)], 0.045, FRAME, 0.64)
        for x, slant in ((-0.86, -0.07), (0.32, -0.14), (-0.25, -0.02))
    ]
    parts.append(both_sides(merge(cab_posts)))
    lift = 0.25 * reach
    lift_arm = _bar([(0.7, 1.6), (1.9, 1.45 + lift), (2.9, 0.55 + 2.0 * lift)], [0.24, 0.34, 0.22], 0.07, machine)
    painted.append(both_sides(lift_arm.moved(y=0.5)))
    x, z = 2.9, 0.2 + 2.0 * lift
    parts.append(_slab(np.add(SHOVEL, [x, z]), 1.28, STEEL))
    shovel_side = _slab([(x + 0.25, z + 0.98), (x + 0.15, z + 0.25), (x + 0.1, z), (x + 0.95, z)], 0.03, machine, 1.25)
    painted.append(both_sides(shovel_side))
    if detail:
        parts.append(tube([(1.0, 0.0, 1.55), (2.7, 0.0, z + 0.75)], [0.09, 0.06], material=STEEL, segments=8))
        parts.append(crate((-2.0, -0.1, 1.85), (-1.85, 0.05, 2.35), TRIM))
        parts.append(crates((-2.72, 0.45, 1.2), (-2.68, 0.65, 1.35), TAIL))
        parts.append(crates((1.55, 0.5, 1.56), (1.65, 0.75, 1.78), HEAD))
        parts.append(crate((-2.73, -0.4, 0.8), (-2.69, 0.4, 1.4), TRIM))
    parts.append(assign_side_panels(merge(painted), "body"))
    return parts
