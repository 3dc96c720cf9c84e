"""What does not belong on a road and to no class of nuScenes: debris, animals, overturned vehicles, fallen trees."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from ssad.rendering.bodies.car import car
from ssad.rendering.bodies.heavy import truck
from ssad.rendering.bodies.parts import DARK, FRAME, RUBBER, STEEL, WOOD, both_sides, crate, curve, finish, fit
from ssad.rendering.meshes.mesh import F64, Material, Mesh, Point, box, build, loft, merge, part_of, ring, sphere, tube

CARDBOARD = Material("cardboard", (0.36, 0.23, 0.12), specular=0.02, gloss=0.1)
TAPE = Material("tape", (0.48, 0.36, 0.21), specular=0.08, gloss=0.6)
TICKING = Material("ticking", (0.62, 0.60, 0.55), specular=0.02, gloss=0.05)
PIPING = Material("piping", (0.20, 0.26, 0.36), specular=0.02, gloss=0.1)
ALUMINIUM = Material("aluminium", (0.50, 0.51, 0.52), specular=0.3, gloss=0.6)
BARK = Material("bark", (0.11, 0.075, 0.05), specular=0.0, gloss=0.0)
HOOF = Material("hoof", (0.03, 0.025, 0.02), specular=0.03, gloss=0.2)
HORN = Material("horn", (0.40, 0.33, 0.22), specular=0.05, gloss=0.4)
UDDER = Material("udder", (0.50, 0.30, 0.25), specular=0.02, gloss=0.2)

Path = Sequence[tuple[float, float, float]]  # along x: x, z, radius; m


# ---------------------------------------------------------------- debris


def debris(style: str, size: Point, *, generator: np.random.Generator, detail: int) -> Mesh:
    """What fell off a vehicle or a tree, lying on the road; it fills its size, m."""
    if style == "tyre":
        return _tyre(size, detail)
    if style == "pallet":
        return _pallet(size, generator, detail)
    if style == "boxes":
        return _boxes(size, generator, detail)
    if style == "mattress":
        return _mattress(size, generator, detail)
    if style == "ladder":
        return _ladder(size, detail)
    return _branch(size, generator, detail)


def _tyre(size: Point, detail: int) -> Mesh:
    """A tyre without a rim, lying on its side."""
    length, _, height = size
    around = (4, 6, 10)[detail]
    tyre = ring(0.5 * length, 0.55 * height, material=RUBBER, segments=(8, 14, 28)[detail], around=around)
    # from an upright ring to a flat one; the tread is wider than the wall is thick
    flat = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.8, 0.0]])
    return finish([tyre.transformed(flat)], [], size)


def _pallet(size: Point, generator: np.random.Generator, detail: int) -> Mesh:
    """A pallet: boards across x above and below, three beams or rows of blocks along x between."""
    length, width, height = size
    grey = float(generator.uniform(0.0, 1.0))
    half, board = 0.5 * width, 0.16 * height
    fresh, old = np.array([0.42, 0.29, 0.16]), np.array([0.24, 0.22, 0.20])
    shades = [
        replace(WOOD, name=f"board_{k}", colour=_colour(shade * (fresh + grey * (old - fresh))))
        for k, shade in enumerate(generator.uniform(0.8, 1.15, 3))
    ]
    parts = []
    across = 0.105 * length
    for k, x in enumerate(np.linspace(-0.5 * length, 0.5 * length - across, 7)):
        low, high = (float(x), -half, height - board), (float(x) + across, half, height)
        parts.append(crate(low, high, shades[k % 3]))
        if k % 3 == 0:
            parts.append(crate((float(x), -half, 0.0), (float(x) + across, half, board), shades[(k + 1) % 3]))
    for y in (-half, -0.05 * width, 0.4 * width):
        if detail == 0:
            low, high = (-0.5 * length, y, board), (0.5 * length, y + 0.1 * width, height - board)
            parts.append(crate(low, high, shades[0]))
            continue
        for x in (-0.5 * length, -0.06 * length, 0.38 * length):
            low, high = (x, y, board), (x + 0.12 * length, y + 0.1 * width, height - board)
            parts.append(crate(low, high, shades[0]))
    return finish(parts, [], size)


def _boxes(size: Point, generator: np.random.Generator, detail: int) -> Mesh:
    """Three cardboard boxes: two on the ground, turned, and one on top."""
    length, width, height = size
    turns = generator.uniform(-0.35, 0.35, 3)
    shades = generator.uniform(0.8, 1.15, 3)
    # middle and size of each as shares
    places = (
        ((-0.22, 0.05, 0.0), (0.52, 0.72, 0.55)),
        ((0.27, -0.08, 0.0), (0.40, 0.60, 0.42)),
        ((-0.20, 0.00, 0.55), (0.42, 0.55, 0.45)),
    )
    parts: list[Mesh] = []
    for turn, shade, (place, share) in zip(turns, shades, places, strict=True):
        own = np.array(size) * share
        carton = replace(CARDBOARD, name=f"cardboard_{len(parts)}", colour=_colour(shade * np.array(CARDBOARD.colour)))
        x, y, z = (0.5 * own).tolist()
        pieces = [crate((-x, -y, 0.0), (x, y, 2.0 * z), carton)]
        if detail:
            pieces.append(crate((-x - 0.002, -0.05 * y, 1.3 * z), (x + 0.002, 0.05 * y, 2.0 * z + 0.002), TAPE))
        if detail == 2:  # the flaps of the lid stand open a little
            pieces += [
                box((1.9 * x, 0.9 * y, 0.006), material=carton)
                .transformed(_turned("x", side * 0.25))
                .moved(0.0, side * 0.5 * y, 2.0 * z - 0.01)
                for side in (-1.0, 1.0)
            ]
        made = merge(pieces).transformed(_turned("z", turn))
        parts.append(made.moved(place[0] * length, place[1] * width, place[2] * height))
    return finish(parts, [], size)


def _mattress(size: Point, generator: np.random.Generator, detail: int) -> Mesh:
    """A mattress that lies flat: rounded corners, a bulging top, a darker seam around."""
    length, width, height = size
    age = float(generator.uniform(0.6, 1.0))
    cloth = replace(TICKING, colour=_colour(age * np.array(TICKING.colour)))
    angle = np.linspace(0.0, 2.0 * np.pi, (8, 16, 32)[detail], endpoint=False)
    square = np.maximum(np.abs(np.cos(angle)), np.abs(np.sin(angle))) ** -0.85
    outline = np.stack([np.cos(angle) * square, np.sin(angle) * square], 1)
    outline /= np.abs(outline).max(axis=0)

    def slab(levels: Sequence[tuple[float, float]], look: Material) -> Mesh:
        inset = 0.5 * height
        rows = [
            np.column_stack([outline * [0.5 * length - inset * i, 0.5 * width - inset * i], np.full(len(outline), z)])
            for i, z in levels
        ]
        return loft(np.array(rows), material=look)

    parts = [
        slab([(0.3, 0.0), (0.04, 0.12 * height), (0.04, 0.88 * height), (0.4, 0.97 * height), (1.6, height)], cloth)
    ]
    for z in (0.12, 0.88):
        parts.append(slab([(0.0, (z - 0.05) * height), (0.0, (z + 0.05) * height)], PIPING))
    return finish(parts, [], size)


def _ladder(size: Point, detail: int) -> Mesh:
    """A ladder of aluminium that lies along x."""
    length, width, height = size
    rail = 0.03
    parts = [
        both_sides(crate((-0.5 * length, 0.5 * width - rail, 0.0), (0.5 * length, 0.5 * width, height), ALUMINIUM))
    ]
    rungs = max(3, round(length / 0.29))
    middle = 0.5 * height
    for x in np.linspace(-0.46, 0.46, rungs) * length:
        ends = [(float(x), -0.5 * width + rail, middle), (float(x), 0.5 * width - rail, middle)]
        parts.append(tube(ends, 0.22 * height, material=ALUMINIUM, segments=(3, 4, 6)[detail]))
    return finish(parts, [], size)


def _branch(size: Point, generator: np.random.Generator, detail: int) -> Mesh:
    """A limb with twigs and some leaves."""
    length, width, height = size
    green = _greens(generator)
    bends = generator.uniform(-1.0, 1.0, (6, 2))
    x = np.linspace(-0.5, 0.5, 6)
    thick = 0.04 + 0.01 * length
    spine = np.stack([x * length, 0.10 * width * bends[:, 0], thick + 0.12 * height * np.abs(bends[:, 1])], 1)
    radii = np.linspace(thick, 0.3 * thick, 6)
    sides = (3, 5, 7)[detail]
    parts = [tube(spine, radii, material=BARK, segments=sides)]
    twigs = generator.uniform(0.0, 1.0, (7, 3))
    for k, (along, up, far) in enumerate(twigs):
        start = spine[1 + k % 4]
        side = 1.0 if k % 2 else -1.0
        reach = (0.22 * length * (0.4 + along), side * width * (0.2 + 0.25 * far), height * (0.15 + 0.7 * up))
        end = np.clip(
            start + np.array(reach), [-0.5 * length, -0.5 * width, 0.05], [0.5 * length, 0.5 * width, 0.95 * height]
        )
        path = np.stack([start, 0.5 * (start + end) + [0.0, 0.0, 0.05 * height], end])
        parts.append(tube(path, [0.4 * thick, 0.25 * thick, 0.1 * thick], material=BARK, segments=max(sides - 1, 3)))
        tuft = np.array([0.12 * length, 0.16 * width, 0.2 * height])
        parts.append(foliage(end - 0.3 * (end - start), tuft, green, generator, detail=detail, leaf=0.11))
    return finish(parts, [], size)


# ---------------------------------------------------------------- foliage


def fallen_tree(style: str, size: Point, *, generator: np.random.Generator, detail: int) -> Mesh:
    """A tree that lies along x, its root plate behind and its crown ahead; it fills its size, m."""
    length, width, height = size
    green = _greens(generator)
    thick = 0.025 * length + 0.04
    bare = style == "bare"
    sides = (5, 7, 10)[detail]
    sway = generator.uniform(-1.0, 1.0, (5, 2))
    x = np.linspace(-0.47, 0.36, 5) * length
    spine = np.stack([x, 0.04 * width * sway[:, 0], thick * np.linspace(1.4, 2.2, 5) + 0.02 * sway[:, 1]], 1)
    parts = [tube(spine, np.linspace(1.0, 0.4, 5) * thick, material=BARK, segments=sides)]
    # the root plate stands on its edge
    roots = generator.uniform(0.45, 1.0, 9)
    angle = (np.arange(9) + generator.uniform(-0.4, 0.4, 9)) * (2.0 * np.pi / 9)
    plate = 0.34 * height
    for reach, a in zip(roots, angle, strict=True):
        tip = spine[0] + [
            -0.03 * length,
            plate * 1.3 * reach * np.cos(a),
            plate * 1.3 * reach * np.sin(a) + 0.4 * plate,
        ]
        tip[2] = max(tip[2], 0.03)
        path = np.stack([spine[0] + [0.05 * length, 0.0, 0.0], 0.5 * (spine[0] + tip), tip])
        parts.append(tube(path, [0.6 * thick, 0.35 * thick, 0.08 * thick], material=BARK, segments=max(sides - 3, 3)))
    soil = Material("soil", (0.10, 0.065, 0.04), specular=0.0, gloss=0.0)
    clod = sphere((0.02 * length, plate, 0.9 * plate), material=soil, segments=(6, 8, 12)[detail])
    parts.append(clod.moved(float(spine[0, 0]), 0.0, 0.9 * plate))
    boughs = generator.uniform(0.0, 1.0, (12, 4))
    for k, (along, turn, reach, swell) in enumerate(boughs):
        start = spine[2] + (0.15 + 0.8 * along) * (spine[4] - spine[2])
        a = np.pi * (k % 6 + turn) / 6.0  # from one side over the top to the other
        far = 0.55 + 0.45 * reach
        up, aside = 0.85 * height * far * np.sin(a), 0.46 * width * far * np.cos(a)
        end = start + np.array([0.18 * length * (0.4 + reach), aside, up])
        end[2] = min(end[2], 0.9 * height)
        path = np.stack([start, 0.5 * (start + end) + [0.0, 0.0, 0.04 * height], end])
        parts.append(tube(path, [0.45 * thick, 0.28 * thick, 0.06 * thick], material=BARK, segments=max(sides - 3, 3)))
        if bare:
            for side in (-1.0, 1.0):
                middle = path[1]
                fork = middle + np.array([0.12 * length, side * 0.12 * width, 0.12 * height * (swell - 0.2)])
                fork[2] = np.clip(fork[2], 0.05, 0.95 * height)
                twig = np.stack([middle, fork])
                parts.append(tube(twig, [0.2 * thick, 0.05 * thick], material=BARK, segments=3))
        else:
            tuft = np.array([0.11 * length, 0.2 * width, 0.24 * height]) * (0.8 + 0.3 * swell)
            where = start + 0.75 * (end - start)
            parts.append(foliage(where, tuft, green, generator, detail=detail, leaf=0.23))
    return finish(parts, [], size)


def _greens(generator: np.random.Generator) -> tuple[Material, Material, Material]:
    """Two greens of leaves and the dark inside of a crown."""
    hue, light = generator.uniform(0.0, 1.0), generator.uniform(0.8, 1.2)
    base = light * (np.array([0.055, 0.105, 0.025]) + hue * np.array([0.055, 0.02, 0.0]))
    return (
        Material("leaves_round", _colour(1.25 * base), specular=0.02, gloss=0.2),
        Material("leaves_round", _colour(0.85 * base), specular=0.02, gloss=0.2),
        Material("leaves_round", _colour(0.4 * base), specular=0.0, gloss=0.0),
    )


def foliage(
    middle: F64,
    radius: F64,
    green: tuple[Material, Material, Material],
    generator: np.random.Generator,
    *,
    detail: int,
    leaf: float,
) -> Mesh:
    """A tuft of leaves: a dark, uneven blob, and triangles around it.

    Args:
        middle: Middle of the blob [3], m.
        radius: Half axes [3], m.
        green: Two materials of the leaves, and that of the blob.
        generator: Source of randomness; the draws do not depend on the detail.
        detail: Level of detail, 0 (coarse) to 2.
        leaf: Size of the triangles, m, roughly.
    """
    count = 48
    tilt, spin = generator.normal(size=(count, 3)), generator.normal(size=(count, 3))
    size = leaf * generator.uniform(0.6, 1.2, count)
    k = np.arange(count) + 0.5
    z = 1.0 - 2.0 * k / count
    angle = np.pi * (1.0 + 5.0**0.5) * k
    flat = np.sqrt(1.0 - z * z)
    unit = np.stack([flat * np.cos(angle), flat * np.sin(angle), z], 1)
    step, grow = ((8, 2.4), (3, 1.5), (1, 1.0))[detail]
    unit, tilt, spin, size = (values[::step] for values in (unit, tilt, spin, size))
    out = unit + 0.45 * tilt / np.linalg.norm(tilt, axis=1, keepdims=True)
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    side = np.cross(out, spin)
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-9)
    up = np.cross(out, side)
    turn = np.array([0.0, 2.1, 4.2])[None, :, None]
    spread = np.cos(turn) * side[:, None] + np.sin(turn) * up[:, None]
    corners = (middle + unit * radius)[:, None] + grow * size[:, None, None] * spread
    corners[..., 2] = np.maximum(corners[..., 2], 0.01)
    faces = np.arange(3 * len(unit)).reshape(-1, 3)
    ragged = build(corners.reshape(-1, 3), faces, materials=green[:2], material=np.arange(len(unit)) % 2, smooth=0.0)
    core = 0.85 * radius
    inside = sphere(_point(core), material=green[2], segments=(4, 6, 8)[detail])
    centre = np.maximum(middle, [-np.inf, -np.inf, core[2]])
    return merge([inside.moved(*centre.tolist()), ragged])


# ---------------------------------------------------------------- animals


@dataclass(frozen=True, slots=True)
class _Beast:
    """Shape and coats of an animal.

    Attributes:
        trunk: Path of x, z, radius (m) in the plane of symmetry.
        neck: The same.
        head: The same.
        foreleg: The same.
        hindleg: The same.
        tail: The same.
        ear: x, z, length, width, m.
        narrow: Ratio of width to height of trunk and head.
        apart: Distance of the legs from the plane of symmetry, m.
        coats: Linear RGB of each.
    """

    trunk: Path
    neck: Path
    head: Path
    foreleg: Path
    hindleg: Path
    tail: Path
    ear: tuple[float, float, float, float]  # x, z, length, width
    narrow: float
    apart: float
    coats: tuple[Point, ...]


BEASTS: Mapping[str, _Beast] = {
    "dog": _Beast(
        trunk=(
            (-0.36, 0.50, 0.05),
            (-0.33, 0.50, 0.105),
            (-0.15, 0.50, 0.115),
            (0.08, 0.47, 0.145),
            (0.22, 0.49, 0.135),
            (0.30, 0.53, 0.06),
        ),
        neck=((0.18, 0.52, 0.11), (0.29, 0.63, 0.085), (0.35, 0.70, 0.075)),
        head=((0.29, 0.72, 0.05), (0.36, 0.73, 0.085), (0.44, 0.70, 0.065), (0.47, 0.68, 0.042), (0.57, 0.66, 0.034)),
        foreleg=((0.17, 0.45, 0.065), (0.16, 0.28, 0.034), (0.17, 0.05, 0.028), (0.19, 0.02, 0.036)),
        hindleg=(
            (-0.28, 0.48, 0.09),
            (-0.24, 0.30, 0.055),
            (-0.33, 0.17, 0.028),
            (-0.30, 0.04, 0.027),
            (-0.28, 0.02, 0.036),
        ),
        tail=((-0.34, 0.54, 0.03), (-0.47, 0.60, 0.026), (-0.55, 0.70, 0.014)),
        ear=(0.35, 0.80, 0.10, 0.05),
        narrow=0.85,
        apart=0.085,
        coats=((0.22, 0.12, 0.05), (0.03, 0.026, 0.022), (0.42, 0.29, 0.14), (0.10, 0.06, 0.035)),
    ),
    "deer": _Beast(
        trunk=(
            (-0.62, 0.90, 0.07),
            (-0.55, 0.90, 0.16),
            (-0.25, 0.86, 0.19),
            (0.10, 0.84, 0.21),
            (0.35, 0.88, 0.18),
            (0.46, 0.93, 0.08),
        ),
        neck=((0.30, 0.93, 0.15), (0.48, 1.12, 0.10), (0.56, 1.28, 0.085)),
        head=((0.50, 1.32, 0.06), (0.58, 1.33, 0.09), (0.70, 1.27, 0.068), (0.80, 1.22, 0.042), (0.83, 1.21, 0.03)),
        foreleg=((0.30, 0.80, 0.085), (0.29, 0.50, 0.04), (0.29, 0.42, 0.036), (0.29, 0.06, 0.024), (0.31, 0.0, 0.03)),
        hindleg=(
            (-0.48, 0.85, 0.13),
            (-0.42, 0.58, 0.075),
            (-0.55, 0.42, 0.036),
            (-0.50, 0.06, 0.025),
            (-0.48, 0.0, 0.03),
        ),
        tail=((-0.60, 0.95, 0.03), (-0.67, 0.88, 0.028), (-0.68, 0.80, 0.01)),
        ear=(0.52, 1.41, 0.15, 0.06),
        narrow=0.75,
        apart=0.095,
        coats=((0.23, 0.125, 0.06), (0.28, 0.16, 0.08), (0.16, 0.10, 0.06)),
    ),
    "cow": _Beast(
        trunk=(
            (-0.92, 1.10, 0.10),
            (-0.86, 1.08, 0.25),
            (-0.45, 1.02, 0.34),
            (0.0, 0.98, 0.38),
            (0.42, 1.01, 0.36),
            (0.70, 1.04, 0.26),
            (0.80, 1.06, 0.12),
        ),
        neck=((0.58, 1.10, 0.27), (0.85, 1.20, 0.19), (1.02, 1.27, 0.15)),
        head=((0.95, 1.33, 0.10), (1.06, 1.31, 0.15), (1.20, 1.17, 0.12), (1.35, 1.02, 0.095), (1.40, 0.97, 0.07)),
        foreleg=((0.52, 0.88, 0.16), (0.52, 0.50, 0.075), (0.52, 0.42, 0.07), (0.52, 0.10, 0.05), (0.54, 0.0, 0.07)),
        hindleg=((-0.70, 1.0, 0.22), (-0.66, 0.62, 0.11), (-0.80, 0.44, 0.06), (-0.76, 0.10, 0.05), (-0.74, 0.0, 0.07)),
        tail=((-0.92, 1.28, 0.03), (-1.0, 1.0, 0.022), (-0.99, 0.62, 0.025), (-0.98, 0.45, 0.045)),
        ear=(0.98, 1.35, 0.18, 0.09),
        narrow=0.9,
        apart=0.20,
        coats=((0.60, 0.58, 0.54), (0.60, 0.58, 0.54), (0.20, 0.085, 0.035), (0.32, 0.20, 0.10)),
    ),
    "horse": _Beast(
        trunk=(
            (-0.85, 1.22, 0.10),
            (-0.78, 1.22, 0.25),
            (-0.45, 1.18, 0.29),
            (0.0, 1.13, 0.30),
            (0.38, 1.17, 0.29),
            (0.60, 1.20, 0.20),
            (0.68, 1.22, 0.10),
        ),
        neck=((0.45, 1.28, 0.25), (0.75, 1.55, 0.17), (0.93, 1.78, 0.13)),
        head=((0.86, 1.86, 0.08), (0.96, 1.84, 0.135), (1.10, 1.68, 0.105), (1.24, 1.52, 0.07), (1.29, 1.46, 0.06)),
        foreleg=((0.42, 1.05, 0.14), (0.42, 0.62, 0.065), (0.42, 0.52, 0.06), (0.42, 0.12, 0.04), (0.45, 0.0, 0.065)),
        hindleg=(
            (-0.62, 1.15, 0.21),
            (-0.56, 0.78, 0.12),
            (-0.74, 0.56, 0.06),
            (-0.68, 0.12, 0.042),
            (-0.65, 0.0, 0.065),
        ),
        tail=((-0.84, 1.40, 0.05), (-0.98, 1.22, 0.08), (-1.0, 0.85, 0.085), (-0.98, 0.55, 0.04)),
        ear=(0.92, 1.97, 0.14, 0.05),
        narrow=0.8,
        apart=0.15,
        coats=((0.12, 0.045, 0.02), (0.025, 0.02, 0.018), (0.22, 0.10, 0.04), (0.45, 0.43, 0.40)),
    ),
}


def animal(style: str, size: Point, *, generator: np.random.Generator, detail: int) -> Mesh:
    """An animal that stands; it fills its size, m."""
    beast = BEASTS[style]
    coat = beast.coats[int(generator.integers(len(beast.coats)))]
    shade = float(generator.uniform(0.85, 1.15))
    spots = generator.uniform(-1.0, 1.0, (14, 3))
    antlers = bool(generator.random() < 0.6)
    stride = generator.uniform(-0.5, 0.5, 2)
    look = Material("coat", _colour(shade * np.array(coat)), specular=0.02, gloss=0.15)
    below = Material("belly", _colour(0.8 * shade * np.array(coat) + 0.04), specular=0.02, gloss=0.1)
    dark = Material("mane", _colour(0.35 * shade * np.array(coat)), specular=0.02, gloss=0.1)
    rings = (6, 8, 14)[detail]
    thin = (3, 5, 8)[detail]
    finer = (1, 1, 3)[detail]
    trunk = _along(_rounded(beast.trunk, finer), look, rings, beast.narrow)
    if style == "cow" and coat[1] > 0.5:
        trunk = _spotted(trunk, spots, Material("patches", (0.02, 0.018, 0.017), specular=0.02, gloss=0.15))
    elif style != "cow":
        trunk = _spotted(trunk, np.array([[0.0, 0.0, -1.0]]), below, upright=True)
    neck, head = (_rounded(path, finer) for path in (beast.neck, beast.head))
    parts = [trunk, _along(neck, look, rings, beast.narrow), _along(head, look, rings, 0.8)]
    x, z, radius = beast.head[-1]
    parts.append(sphere((0.8 * radius, 0.8 * radius, 0.7 * radius), material=HOOF, segments=thin + 1).moved(x, 0.0, z))
    parts.append(_along(beast.tail, dark if style in ("horse", "cow") else look, thin, 1.0))
    for leg, swing in ((beast.foreleg, stride[0]), (beast.hindleg, stride[1])):
        top = leg[0][1]
        for side in (-1.0, 1.0):
            path = [(x + side * swing * 0.35 * (top - z), z, r) for x, z, r in leg]
            shoulder = (path[0][0], top + 0.9 * path[0][2], 0.35 * path[0][2])
            path = _rounded([shoulder, *path], finer)
            parts.append(_along(path, look, max(thin, 4), 0.9).moved(y=side * beast.apart))
            if style != "dog":
                x, _, r = path[-1]
                hoof = tube(
                    [(x, 0.0, 0.0), (x - 0.2 * r, 0.0, 1.4 * r)], [1.05 * r, 0.9 * r], material=HOOF, segments=thin
                )
                parts.append(hoof.moved(y=side * beast.apart))
    x, z, long, wide = beast.ear
    r = beast.head[1][2]
    spread = 0.75 if style in ("cow", "deer") else 0.35
    tip = (x - 0.2 * long, (0.6 * r + spread * long), z + long * (0.1 if style == "cow" else 0.6))
    ear = tube([(x, 0.5 * r, z - 0.25 * r), tip], [0.5 * wide, 0.15 * wide], material=look, segments=max(thin - 1, 3))
    parts.append(both_sides(ear))
    parts += _headgear(style, beast, thin, antlers=antlers, dark=dark)
    return finish(parts, [], size)


def _headgear(style: str, beast: _Beast, sides: int, *, antlers: bool, dark: Material) -> list[Mesh]:
    """Horns and udder of a cow, antlers of a stag, mane of a horse."""
    x, z, _ = beast.head[0]
    if style == "cow":
        horn = [(x + 0.04, 0.08, z + 0.06), (x + 0.06, 0.20, z + 0.10), (x + 0.12, 0.24, z + 0.20)]
        udder = sphere((0.18, 0.15, 0.13), material=UDDER, segments=sides + 1).moved(-0.48, 0.0, 0.66)
        return [both_sides(tube(horn, [0.035, 0.028, 0.008], material=HORN, segments=sides)), udder]
    if style == "deer" and antlers:
        beam = [
            (x + 0.03, 0.05, z + 0.08),
            (x - 0.08, 0.16, z + 0.24),
            (x - 0.02, 0.24, z + 0.42),
            (x + 0.08, 0.2, z + 0.52),
        ]
        tines = [
            [(x + 0.02, 0.06, z + 0.10), (x + 0.16, 0.08, z + 0.20)],
            [(x - 0.08, 0.16, z + 0.24), (x + 0.06, 0.18, z + 0.36)],
            [(x - 0.02, 0.24, z + 0.42), (x - 0.10, 0.22, z + 0.54)],
        ]
        parts = [tube(beam, [0.022, 0.02, 0.016, 0.006], material=HORN, segments=max(sides - 1, 3))]
        parts += [tube(tine, [0.014, 0.005], material=HORN, segments=3) for tine in tines]
        return [both_sides(part) for part in parts]
    if style == "horse":
        crest = [(px - 0.45 * r, pz + 0.75 * r, 0.05) for px, pz, r in beast.neck]
        forelock = [(x + 0.06, z + 0.09, 0.04), (x + 0.17, z - 0.03, 0.02)]
        return [_along(crest, dark, sides, 0.7), _along(forelock, dark, sides, 0.9)]
    return []


def _rounded(path: Path, finer: int) -> list[tuple[float, float, float]]:
    """The path with `finer` pieces for each of its pieces, on smooth lines."""
    if finer == 1:
        return list(path)
    at = np.linspace(0.0, len(path) - 1.0, finer * (len(path) - 1) + 1)
    columns = [curve([(float(k), point[axis]) for k, point in enumerate(path)], at).tolist() for axis in range(3)]
    return [(x, z, radius) for x, z, radius in zip(*columns, strict=True)]


def _along(path: Path, look: Material, sides: int, narrow: float) -> Mesh:
    """A round body along a path of (x, z, radius) in the plane y = 0, `narrow` times as wide as it is high."""
    p = np.array(path)
    points = np.stack([p[:, 0], np.zeros(len(p)), p[:, 1]], 1)
    made = tube(points, p[:, 2], material=look, segments=sides)
    return made.transformed(np.diag([1.0, narrow, 1.0]))


def _spotted(mesh: Mesh, spots: F64, look: Material, *, upright: bool = False) -> Mesh:
    """The mesh with another material on the faces near some of the spots [n, 3] (from -1 to 1 over its bounding box).

    upright: the faces that look down get it instead.
    """
    low, high = mesh.bounds()
    middle = (mesh.corners().mean(1) - low) / (high - low) * 2.0 - 1.0
    if upright:
        chosen = mesh.normals[..., 2].mean(1) < -0.75
    else:
        gap = np.linalg.norm((middle[:, None] - spots[None]) * [1.0, 0.8, 0.8], axis=-1)
        chosen = gap.min(1) < 0.42
    return replace(
        mesh,
        material=np.where(chosen, len(mesh.materials), mesh.material).astype(np.int32),
        materials=(*mesh.materials, look),
    )


# ---------------------------------------------------------------- vehicles

OVERTURNED_CARS = {"car_side": "sedan", "suv_side": "suv", "car_roof": "hatchback"}


def overturned(style: str, size: Point, *, generator: np.random.Generator, detail: int) -> Mesh:
    """A car or truck that lies on its side or roof and fills its size, m; its panels are those of the vehicle."""
    length, width, height = size
    side = 1.0 if generator.random() < 0.5 else -1.0
    upside = style == "car_roof"
    own = (length, width, height) if upside else (length, height, width)
    if style == "truck_side":
        vehicle = truck("box", own, generator=generator, detail=detail)
        under = _underside(own, 0.28 * own[2], truck=True)
    else:
        vehicle = car(OVERTURNED_CARS[style], own, generator=generator, detail=detail)
        under = _underside(own, 0.17 * own[2], truck=False)
    lying = merge([vehicle, under]).transformed(_turned("x", np.pi if upside else side * np.pi / 2.0))
    return fit(_settled(lying, 0.05 * height if upside else None), size)


def _settled(mesh: Mesh, dent: float | None) -> Mesh:
    """The mesh flat where it lies: what its mirrors hold off the ground, or `dent` m of its roof, is pressed in."""
    corners = mesh.corners()
    low = float(corners[..., 2].min())
    ground = float(corners[mesh.panel >= 0, :, 2].min()) if dent is None else low + dent
    vertices = mesh.vertices.copy()
    vertices[:, 2] = np.maximum(vertices[:, 2], ground)
    pressed = replace(mesh, vertices=vertices)
    return part_of(pressed, pressed.areas() > 1e-7)


def _underside(size: Point, top: float, *, truck: bool) -> Mesh:
    """What is seen of a vehicle from below: floor, axles, exhaust or frame and tank, drive shaft."""
    length, width, _ = size
    half = 0.5 * width
    if truck:
        parts = [
            crate((-0.48 * length, y - 0.06, top - 0.3), (0.45 * length, y + 0.06, top), FRAME) for y in (-0.4, 0.4)
        ]
        parts.append(crate((-0.48 * length, -0.85 * half, top), (0.48 * length, 0.85 * half, top + 0.05), DARK))
        axles, low = (-0.28 * length, 0.34 * length), 0.45
    else:
        parts = [crate((-0.46 * length, -0.78 * half, top), (0.46 * length, 0.78 * half, top + 0.06), DARK)]
        exhaust = [
            (0.25 * length, -0.25, top - 0.02),
            (-0.2 * length, -0.3, top - 0.02),
            (-0.46 * length, -0.45, top - 0.02),
        ]
        parts.append(tube(exhaust, 0.04, material=STEEL, segments=5))
        silencer = (-0.43 * length, -0.35, top - 0.09), (-0.36 * length, 0.35, top + 0.02)
        parts += [crate(*silencer, STEEL), crate((0.2 * length, -0.3, top - 0.06), (0.4 * length, 0.3, top), FRAME)]
        parts.append(crate((-0.3 * length, -0.4, top - 0.04), (-0.15 * length, 0.4, top), FRAME))
        axles, low = (-0.285 * length, 0.335 * length), 0.3
    parts += [tube([(x, -0.8 * half, low), (x, 0.8 * half, low)], 0.05, material=FRAME, segments=5) for x in axles]
    parts.append(tube([(axles[0], 0.0, low), (0.2 * length, 0.0, low + 0.02)], 0.04, material=STEEL, segments=5))
    return merge(parts)


def _turned(axis: str, angle: float) -> F64:
    """A rotation [3, 3] about x or z."""
    c, s = np.cos(angle), np.sin(angle)
    if axis == "x":
        return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _colour(values: npt.ArrayLike) -> tuple[float, float, float]:
    """Linear RGB within [0, 0.9], rounded so that equal looks are one material."""
    r, g, b = np.round(np.clip(np.asarray(values, np.float64), 0.0, 0.9), 4).tolist()
    return r, g, b


def _point(values: F64) -> Point:
    x, y, z = values.tolist()
    return x, y, z
