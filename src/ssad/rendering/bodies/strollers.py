"""Strollers: what people push along a sidewalk. Their handle is the rear upper edge of the box."""

from __future__ import annotations

import numpy as np

from ssad.rendering.bodies.parts import RUBBER, STEEL, TRIM, both_sides, crate, finish, tubes
from ssad.rendering.bodies.people import CLOTHS
from ssad.rendering.meshes.mesh import Material, Mesh, Point, merge, prism, ring, sphere, tube


def stroller(style: str, size: Point, *, generator: np.random.Generator, detail: int) -> Mesh:
    """A stroller (buggy: a seat that looks ahead under a hood; pram: a deep tub) that fills its size, m.

    The child faces ahead, the handle is behind.
    """
    cloth, lining = (CLOTHS[int(k)] for k in generator.integers(len(CLOTHS), size=2))
    fabric = Material("fabric", cloth, specular=0.02, gloss=0.1)
    inside = Material("lining", lining, specular=0.02, gloss=0.1)
    n = (4, 5, 8)[detail]
    steps = (8, 12, 20)[detail]
    big = style == "pram"
    front, rear = (0.14, 0.14) if big else (0.10, 0.13)
    wheels = [
        ring(radius, 0.05, material=RUBBER, segments=steps, around=(3, 4, 6)[detail]).moved(x, y, radius)
        for radius, x, y in ((front, 0.34, 0.20), (rear, -0.22, 0.24))
    ]
    parts = [both_sides(merge(wheels))]
    handle = (-0.50, 0.20, 1.02)
    parts.append(tubes([handle, (0.0, 0.21, 0.52), (0.34, 0.20, front)], 0.014, STEEL, n))
    parts.append(tubes([(0.05, 0.21, 0.55), (-0.22, 0.24, rear)], 0.014, STEEL, n))
    parts.append(tube([(-0.50, -0.21, 1.02), (-0.50, 0.21, 1.02)], 0.018, material=TRIM, segments=n))
    if detail > 0:  # what was bought lies between the wheels
        parts.append(crate((-0.22, -0.17, 0.18), (0.18, 0.17, 0.32), TRIM))
    if big:
        tub = [(-0.28, 0.78), (-0.20, 0.45), (0.30, 0.45), (0.42, 0.78)]
        parts.append(prism(tub, (-0.20, 0.20), axis=1, material=fabric))
        parts.append(crate((0.0, -0.18, 0.77), (0.40, 0.18, 0.80), inside))
        hood = (0.20, 0.205, 0.24)
    else:
        seat = [(-0.20, 0.85), (-0.12, 0.42), (0.34, 0.36), (0.36, 0.44), (0.02, 0.52), (-0.10, 0.86)]
        parts.append(prism(seat, (-0.18, 0.18), axis=1, material=fabric))
        parts.append(crate((-0.04, -0.13, 0.50), (0.16, 0.13, 0.66), inside))
        hood = (0.20, 0.195, 0.20)
    parts.append(sphere(hood, material=fabric, centre=(-0.10, 0.0, 0.80), segments=max(6, n)))
    if detail > 0:
        skin = Material("skin", (0.50, 0.31, 0.21), specular=0.02, gloss=0.1)
        parts.append(sphere(0.075, material=skin, centre=(0.07, 0.0, 0.74), segments=6))
    return finish(parts, [], size)
