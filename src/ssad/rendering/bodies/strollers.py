"""Strollers. The handle is the rear upper edge of the box."""

from __future__ import annotations

import numpy as np

from ssad.rendering.bodies.parts import RUBBER, STEEL, TRIM, both_sides, crate, finish, tubes
from ssad.rendering.bodies.people import CLOTHS
from ssad.rendering.meshes.mesh import Material, Mesh, Point, merge, prism, ring, sphere, tube


def stroller(style: str, size: Point, *, generator: np.random.Generator, detail: int) -> Mesh:
    """Return a stroller that fills its size, m.

    A buggy has a seat that faces ahead under a hood, a pram a deep tub. The child faces ahead.
    """
    cloth, lining = (CLOTHS[int(index)] for index in generator.integers(len(CLOTHS), size=2))
    fabric = Material("fabric", cloth, specular=0.02, gloss=0.1)
    lining_material = Material("lining", lining, specular=0.02, gloss=0.1)
    segment_count = (4, 5, 8)[detail]
    ring_segments = (8, 12, 20)[detail]
    is_pram = style == "pram"
    front_radius, rear_radius = (0.14, 0.14) if is_pram else (0.10, 0.13)
    wheels = [
        ring(radius, 0.05, material=RUBBER, segments=ring_segments, around=(3, 4, 6)[detail]).moved(x, y, radius)
        for radius, x, y in ((front_radius, 0.34, 0.20), (rear_radius, -0.22, 0.24))
    ]
    parts = [both_sides(merge(wheels))]
    handle = (-0.50, 0.20, 1.02)
    parts.append(tubes([handle, (0.0, 0.21, 0.52), (0.34, 0.20, front_radius)], 0.014, STEEL, segment_count))
    parts.append(tubes([(0.05, 0.21, 0.55), (-0.22, 0.24, rear_radius)], 0.014, STEEL, segment_count))
    parts.append(tube([(-0.50, -0.21, 1.02), (-0.50, 0.21, 1.02)], 0.018, material=TRIM, segments=segment_count))
    if detail > 0:  # a shopping basket between the wheels
        parts.append(crate((-0.22, -0.17, 0.18), (0.18, 0.17, 0.32), TRIM))
    if is_pram:
        tub_outline = [(-0.28, 0.78), (-0.20, 0.45), (0.30, 0.45), (0.42, 0.78)]
        parts.append(prism(tub_outline, (-0.20, 0.20), axis=1, material=fabric))
        parts.append(crate((0.0, -0.18, 0.77), (0.40, 0.18, 0.80), lining_material))
        hood_radii = (0.20, 0.205, 0.24)
    else:
        seat_outline = [(-0.20, 0.85), (-0.12, 0.42), (0.34, 0.36), (0.36, 0.44), (0.02, 0.52), (-0.10, 0.86)]
        parts.append(prism(seat_outline, (-0.18, 0.18), axis=1, material=fabric))
        parts.append(crate((-0.04, -0.13, 0.50), (0.16, 0.13, 0.66), lining_material))
        hood_radii = (0.20, 0.195, 0.20)
    parts.append(sphere(hood_radii, material=fabric, centre=(-0.10, 0.0, 0.80), segments=max(6, segment_count)))
    if detail > 0:
        skin = Material("skin", (0.50, 0.31, 0.21), specular=0.02, gloss=0.1)
        parts.append(sphere(0.075, material=skin, centre=(0.07, 0.0, 0.74), segments=6))
    return finish(parts, [], size)
