"""Anomalies outside the classes of nuScenes: debris, animals, overturned vehicles, fallen trees."""

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
    """Return debris that lies on the road and fills its size, m."""
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
    """Return a tyre without a rim, lying on its side."""
    length, _, height = size
    tube_segments = (4, 6, 10)[detail]
    tyre = ring(0.5 * length, 0.55 * height, material=RUBBER, segments=(8, 14, 28)[detail], around=tube_segments)
    # from an upright ring to a lying one; the tread is wider than the side wall is thick
    lay_down = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.8, 0.0]])
    return finish([tyre.transformed(lay_down)], [], size)


def _pallet(size: Point, generator: np.random.Generator, detail: int) -> Mesh:
    """Return a pallet: boards across x above and below, three beams or rows of blocks along x between."""
    length, width, height = size
    weathering = float(generator.uniform(0.0, 1.0))
    half_width, board_height = 0.5 * width, 0.16 * height
    new_wood, grey_wood = np.array([0.42, 0.29, 0.16]), np.array([0.24, 0.22, 0.20])
    materials = [
        replace(WOOD, name=f"board_{index}", colour=_colour(shade * (new_wood + weathering * (grey_wood - new_wood))))
        for index, shade in enumerate(generator.uniform(0.8, 1.15, 3))
    ]
    parts = []
    board_length = 0.105 * length
    for index, x in enumerate(np.linspace(-0.5 * length, 0.5 * length - board_length, 7)):
        lower, upper = (float(x), -half_width, height - board_height), (float(x) + board_length, half_width, height)
        parts.append(crate(lower, upper, materials[index % 3]))
        if index % 3 == 0:
            parts.append(
                crate(
                    (float(x), -half_width, 0.0),
                    (float(x) + board_length, half_width, board_height),
                    materials[(index + 1) % 3],
                )
            )
    for y in (-half_width, -0.05 * width, 0.4 * width):
        if detail == 0:
            lower, upper = (-0.5 * length, y, board_height), (0.5 * length, y + 0.1 * width, height - board_height)
            parts.append(crate(lower, upper, materials[0]))
            continue
        for x in (-0.5 * length, -0.06 * length, 0.38 * length):
            lower, upper = (x, y, board_height), (x + 0.12 * length, y + 0.1 * width, height - board_height)
            parts.append(crate(lower, upper, materials[0]))
    return finish(parts, [], size)


def _boxes(size: Point, generator: np.random.Generator, detail: int) -> Mesh:
    """Return three cardboard boxes: two on the ground, turned, and one on top."""
    length, width, height = size
    yaws = generator.uniform(-0.35, 0.35, 3)
    shades = generator.uniform(0.8, 1.15, 3)
    # middle and size of each as shares
    layout = (
        ((-0.22, 0.05, 0.0), (0.52, 0.72, 0.55)),
        ((0.27, -0.08, 0.0), (0.40, 0.60, 0.42)),
        ((-0.20, 0.00, 0.55), (0.42, 0.55, 0.45)),
    )
    parts: list[Mesh] = []
    for yaw, shade, (position, size_share) in zip(yaws, shades, layout, strict=True):
        box_size = np.array(size) * size_share
        carton = replace(CARDBOARD, name=f"cardboard_{len(parts)}", colour=_colour(shade * np.array(CARDBOARD.colour)))
        x, y, z = (0.5 * box_size).tolist()
        pieces = [crate((-x, -y, 0.0), (x, y, 2.0 * z), carton)]
        if detail:
            pieces.append(crate((-x - 0.002, -0.05 * y, 1.3 * z), (x + 0.002, 0.05 * y, 2.0 * z + 0.002), TAPE))
        if detail == 2:  # the flaps of the lid are slightly open
            pieces += [
                box((1.9 * x, 0.9 * y, 0.006), material=carton)
                .transformed(_axis_rotation("x", side * 0.25))
                .moved(0.0, side * 0.5 * y, 2.0 * z - 0.01)
                for side in (-1.0, 1.0)
            ]
        box_mesh = merge(pieces).transformed(_axis_rotation("z", yaw))
        parts.append(box_mesh.moved(position[0] * length, position[1] * width, position[2] * height))
    return finish(parts, [], size)


def _mattress(size: Point, generator: np.random.Generator, detail: int) -> Mesh:
    """Return a flat mattress: rounded corners, a bulging top, a darker seam around."""
    length, width, height = size
    brightness = float(generator.uniform(0.6, 1.0))
    cloth_material = replace(TICKING, colour=_colour(brightness * np.array(TICKING.colour)))
    angles = np.linspace(0.0, 2.0 * np.pi, (8, 16, 32)[detail], endpoint=False)
    # An exponent of -1 would give sharp corners.
    corner_radius = np.maximum(np.abs(np.cos(angles)), np.abs(np.sin(angles))) ** -0.85
    outline = np.stack([np.cos(angles) * corner_radius, np.sin(angles) * corner_radius], 1)
    outline /= np.abs(outline).max(axis=0)

    def slab(levels: Sequence[tuple[float, float]], material: Material) -> Mesh:
        half_height = 0.5 * height
        sections = [
            np.column_stack(
                [
                    outline * [0.5 * length - half_height * inset_share, 0.5 * width - half_height * inset_share],
                    np.full(len(outline), z),
                ]
            )
            for inset_share, z in levels
        ]
        return loft(np.array(sections), material=material)

    parts = [
        slab(
            [(0.3, 0.0), (0.04, 0.12 * height), (0.04, 0.88 * height), (0.4, 0.97 * height), (1.6, height)],
            cloth_material,
        )
    ]
    for z in (0.12, 0.88):
        parts.append(slab([(0.0, (z - 0.05) * height), (0.0, (z + 0.05) * height)], PIPING))
    return finish(parts, [], size)


def _ladder(size: Point, detail: int) -> Mesh:
    """Return an aluminium ladder that lies along x."""
    length, width, height = size
    rail_width = 0.03
    parts = [
        both_sides(
            crate((-0.5 * length, 0.5 * width - rail_width, 0.0), (0.5 * length, 0.5 * width, height), ALUMINIUM)
        )
    ]
    rung_count = max(3, round(length / 0.29))
    middle_height = 0.5 * height
    for x in np.linspace(-0.46, 0.46, rung_count) * length:
        rung_ends = [
            (float(x), -0.5 * width + rail_width, middle_height),
            (float(x), 0.5 * width - rail_width, middle_height),
        ]
        parts.append(tube(rung_ends, 0.22 * height, material=ALUMINIUM, segments=(3, 4, 6)[detail]))
    return finish(parts, [], size)


def _branch(size: Point, generator: np.random.Generator, detail: int) -> Mesh:
    """Return a limb with twigs and some leaves."""
    length, width, height = size
    leaf_materials = _draw_greens(generator)
    bend_offsets = generator.uniform(-1.0, 1.0, (6, 2))
    positions = np.linspace(-0.5, 0.5, 6)
    radius = 0.04 + 0.01 * length
    spine = np.stack(
        [positions * length, 0.10 * width * bend_offsets[:, 0], radius + 0.12 * height * np.abs(bend_offsets[:, 1])], 1
    )
    radii = np.linspace(radius, 0.3 * radius, 6)
    segment_count = (3, 5, 7)[detail]
    parts = [tube(spine, radii, material=BARK, segments=segment_count)]
    twigs = generator.uniform(0.0, 1.0, (7, 3))
    for twig_index, (forward_share, rise, side_share) in enumerate(twigs):
        start = spine[1 + twig_index % 4]
        side = 1.0 if twig_index % 2 else -1.0
        offset = (
            0.22 * length * (0.4 + forward_share),
            side * width * (0.2 + 0.25 * side_share),
            height * (0.15 + 0.7 * rise),
        )
        end = np.clip(
            start + np.array(offset), [-0.5 * length, -0.5 * width, 0.05], [0.5 * length, 0.5 * width, 0.95 * height]
        )
        path = np.stack([start, 0.5 * (start + end) + [0.0, 0.0, 0.05 * height], end])
        parts.append(
            tube(path, [0.4 * radius, 0.25 * radius, 0.1 * radius], material=BARK, segments=max(segment_count - 1, 3))
        )
        tuft_radii = np.array([0.12 * length, 0.16 * width, 0.2 * height])
        parts.append(
            foliage(end - 0.3 * (end - start), tuft_radii, leaf_materials, generator, detail=detail, leaf=0.11)
        )
    return finish(parts, [], size)


# ---------------------------------------------------------------- foliage


def fallen_tree(style: str, size: Point, *, generator: np.random.Generator, detail: int) -> Mesh:
    """Return a fallen tree that fills its size, m: it lies along x, its root plate behind, its crown ahead."""
    length, width, height = size
    leaf_materials = _draw_greens(generator)
    radius = 0.025 * length + 0.04
    is_bare = style == "bare"
    segment_count = (5, 7, 10)[detail]
    sway_offsets = generator.uniform(-1.0, 1.0, (5, 2))
    positions = np.linspace(-0.47, 0.36, 5) * length
    spine = np.stack(
        [positions, 0.04 * width * sway_offsets[:, 0], radius * np.linspace(1.4, 2.2, 5) + 0.02 * sway_offsets[:, 1]], 1
    )
    parts = [tube(spine, np.linspace(1.0, 0.4, 5) * radius, material=BARK, segments=segment_count)]
    # the root plate stands on its edge
    root_lengths = generator.uniform(0.45, 1.0, 9)
    angles = (np.arange(9) + generator.uniform(-0.4, 0.4, 9)) * (2.0 * np.pi / 9)
    plate_radius = 0.34 * height
    for length_share, bough_angle in zip(root_lengths, angles, strict=True):
        root_tip = spine[0] + [
            -0.03 * length,
            plate_radius * 1.3 * length_share * np.cos(bough_angle),
            plate_radius * 1.3 * length_share * np.sin(bough_angle) + 0.4 * plate_radius,
        ]
        root_tip[2] = max(root_tip[2], 0.03)
        path = np.stack([spine[0] + [0.05 * length, 0.0, 0.0], 0.5 * (spine[0] + root_tip), root_tip])
        parts.append(
            tube(path, [0.6 * radius, 0.35 * radius, 0.08 * radius], material=BARK, segments=max(segment_count - 3, 3))
        )
    soil = Material("soil", (0.10, 0.065, 0.04), specular=0.0, gloss=0.0)
    clod = sphere((0.02 * length, plate_radius, 0.9 * plate_radius), material=soil, segments=(6, 8, 12)[detail])
    parts.append(clod.moved(float(spine[0, 0]), 0.0, 0.9 * plate_radius))
    boughs = generator.uniform(0.0, 1.0, (12, 4))
    for bough_index, (trunk_share, turn_share, length_share, swell_share) in enumerate(boughs):
        start = spine[2] + (0.15 + 0.8 * trunk_share) * (spine[4] - spine[2])
        bough_angle = np.pi * (bough_index % 6 + turn_share) / 6.0  # from one side over the top to the other
        span_share = 0.55 + 0.45 * length_share
        rise, lateral = (
            0.85 * height * span_share * np.sin(bough_angle),
            0.46 * width * span_share * np.cos(bough_angle),
        )
        end = start + np.array([0.18 * length * (0.4 + length_share), lateral, rise])
        end[2] = min(end[2], 0.9 * height)
        path = np.stack([start, 0.5 * (start + end) + [0.0, 0.0, 0.04 * height], end])
        parts.append(
            tube(path, [0.45 * radius, 0.28 * radius, 0.06 * radius], material=BARK, segments=max(segment_count - 3, 3))
        )
        if is_bare:
            for side in (-1.0, 1.0):
                twig_start = path[1]
                twig_end = twig_start + np.array(
                    [0.12 * length, side * 0.12 * width, 0.12 * height * (swell_share - 0.2)]
                )
                twig_end[2] = np.clip(twig_end[2], 0.05, 0.95 * height)
                twig = np.stack([twig_start, twig_end])
                parts.append(tube(twig, [0.2 * radius, 0.05 * radius], material=BARK, segments=3))
        else:
            tuft_radii = np.array([0.11 * length, 0.2 * width, 0.24 * height]) * (0.8 + 0.3 * swell_share)
            tuft_centre = start + 0.75 * (end - start)
            parts.append(foliage(tuft_centre, tuft_radii, leaf_materials, generator, detail=detail, leaf=0.23))
    return finish(parts, [], size)


def _draw_greens(generator: np.random.Generator) -> tuple[Material, Material, Material]:
    """Draw two greens of leaves and the dark material inside a crown."""
    hue_share, brightness = generator.uniform(0.0, 1.0), generator.uniform(0.8, 1.2)
    base = brightness * (np.array([0.055, 0.105, 0.025]) + hue_share * np.array([0.055, 0.02, 0.0]))
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
    """Return a tuft of leaves: a dark, uneven blob, and triangles around it.

    Args:
        middle: Middle of the blob [3], m.
        radius: Half axes [3], m.
        green: Two materials of the leaves, and that of the blob.
        generator: Source of randomness; the draws do not depend on the detail.
        detail: Level of detail, 0 (coarse) to 2.
        leaf: Approximate size of the triangles, m.
    """
    count = 48
    tilt_vectors, spin_vectors = generator.normal(size=(count, 3)), generator.normal(size=(count, 3))
    leaf_sizes = leaf * generator.uniform(0.6, 1.2, count)
    indices = np.arange(count) + 0.5
    heights = 1.0 - 2.0 * indices / count
    azimuths = np.pi * (1.0 + 5.0**0.5) * indices
    circle_radii = np.sqrt(1.0 - heights * heights)
    directions = np.stack([circle_radii * np.cos(azimuths), circle_radii * np.sin(azimuths), heights], 1)
    stride, scale = ((8, 2.4), (3, 1.5), (1, 1.0))[detail]
    # Drawn in full first: the generator must advance equally at every level of detail.
    directions, tilt_vectors, spin_vectors, leaf_sizes = (
        values[::stride] for values in (directions, tilt_vectors, spin_vectors, leaf_sizes)
    )
    normals = directions + 0.45 * tilt_vectors / np.linalg.norm(tilt_vectors, axis=1, keepdims=True)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    side_axes = np.cross(normals, spin_vectors)
    side_axes /= np.maximum(np.linalg.norm(side_axes, axis=1, keepdims=True), 1e-9)
    up_axes = np.cross(normals, side_axes)
    corner_angles = np.array([0.0, 2.1, 4.2])[None, :, None]
    corner_offsets = np.cos(corner_angles) * side_axes[:, None] + np.sin(corner_angles) * up_axes[:, None]
    corners = (middle + directions * radius)[:, None] + scale * leaf_sizes[:, None, None] * corner_offsets
    corners[..., 2] = np.maximum(corners[..., 2], 0.01)
    faces = np.arange(3 * len(directions)).reshape(-1, 3)
    leaf_mesh = build(
        corners.reshape(-1, 3), faces, materials=green[:2], material=np.arange(len(directions)) % 2, smooth=0.0
    )
    core_radii = 0.85 * radius
    core_mesh = sphere(_point(core_radii), material=green[2], segments=(4, 6, 8)[detail])
    centre = np.maximum(middle, [-np.inf, -np.inf, core_radii[2]])
    return merge([core_mesh.moved(*centre.tolist()), leaf_mesh])


# ---------------------------------------------------------------- animals


@dataclass(frozen=True, slots=True)
class _AnimalShape:
    """Shape and coats of an animal.

    Attributes:
        trunk: Path of x, z, radius (m) in the plane of symmetry.
        neck: Path as for the trunk.
        head: Path as for the trunk.
        foreleg: Path as for the trunk.
        hindleg: Path as for the trunk.
        tail: Path as for the trunk.
        ear: x, z, length, width, m.
        narrow: Ratio of width to height of trunk and head.
        leg_spacing: Distance of the legs from the plane of symmetry, m.
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
    leg_spacing: float
    coats: tuple[Point, ...]


BEASTS: Mapping[str, _AnimalShape] = {
    "dog": _AnimalShape(
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
        leg_spacing=0.085,
        coats=((0.22, 0.12, 0.05), (0.03, 0.026, 0.022), (0.42, 0.29, 0.14), (0.10, 0.06, 0.035)),
    ),
    "deer": _AnimalShape(
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
        leg_spacing=0.095,
        coats=((0.23, 0.125, 0.06), (0.28, 0.16, 0.08), (0.16, 0.10, 0.06)),
    ),
    "cow": _AnimalShape(
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
        leg_spacing=0.20,
        coats=((0.60, 0.58, 0.54), (0.60, 0.58, 0.54), (0.20, 0.085, 0.035), (0.32, 0.20, 0.10)),
    ),
    "horse": _AnimalShape(
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
        leg_spacing=0.15,
        coats=((0.12, 0.045, 0.02), (0.025, 0.02, 0.018), (0.22, 0.10, 0.04), (0.45, 0.43, 0.40)),
    ),
}


def animal(style: str, size: Point, *, generator: np.random.Generator, detail: int) -> Mesh:
    """Return a standing animal that fills its size, m."""
    shape = BEASTS[style]
    coat_colour = shape.coats[int(generator.integers(len(shape.coats)))]
    shade = float(generator.uniform(0.85, 1.15))
    patch_centres = generator.uniform(-1.0, 1.0, (14, 3))
    has_antlers = bool(generator.random() < 0.6)
    leg_swings = generator.uniform(-0.5, 0.5, 2)
    coat_material = Material("coat", _colour(shade * np.array(coat_colour)), specular=0.02, gloss=0.15)
    belly_material = Material("belly", _colour(0.8 * shade * np.array(coat_colour) + 0.04), specular=0.02, gloss=0.1)
    mane_material = Material("mane", _colour(0.35 * shade * np.array(coat_colour)), specular=0.02, gloss=0.1)
    ring_segments = (6, 8, 14)[detail]
    limb_segments = (3, 5, 8)[detail]
    subdivision = (1, 1, 3)[detail]
    trunk = _tapered_body(_smooth_path(shape.trunk, subdivision), coat_material, ring_segments, shape.narrow)
    # Only white cows have dark patches.
    if style == "cow" and coat_colour[1] > 0.5:
        trunk = _paint_spots(trunk, patch_centres, Material("patches", (0.02, 0.018, 0.017), specular=0.02, gloss=0.15))
    elif style != "cow":
        trunk = _paint_spots(trunk, np.array([[0.0, 0.0, -1.0]]), belly_material, upright=True)
    neck, head = (_smooth_path(path, subdivision) for path in (shape.neck, shape.head))
    parts = [
        trunk,
        _tapered_body(neck, coat_material, ring_segments, shape.narrow),
        _tapered_body(head, coat_material, ring_segments, 0.8),
    ]
    x, z, radius = shape.head[-1]
    parts.append(
        sphere((0.8 * radius, 0.8 * radius, 0.7 * radius), material=HOOF, segments=limb_segments + 1).moved(x, 0.0, z)
    )
    parts.append(
        _tapered_body(shape.tail, mane_material if style in ("horse", "cow") else coat_material, limb_segments, 1.0)
    )
    for leg, swing_share in ((shape.foreleg, leg_swings[0]), (shape.hindleg, leg_swings[1])):
        leg_top = leg[0][1]
        for side in (-1.0, 1.0):
            path = [(x + side * swing_share * 0.35 * (leg_top - z), z, ring_radius) for x, z, ring_radius in leg]
            shoulder = (path[0][0], leg_top + 0.9 * path[0][2], 0.35 * path[0][2])
            path = _smooth_path([shoulder, *path], subdivision)
            parts.append(
                _tapered_body(path, coat_material, max(limb_segments, 4), 0.9).moved(y=side * shape.leg_spacing)
            )
            if style != "dog":
                x, _, ring_radius = path[-1]
                hoof = tube(
                    [(x, 0.0, 0.0), (x - 0.2 * ring_radius, 0.0, 1.4 * ring_radius)],
                    [1.05 * ring_radius, 0.9 * ring_radius],
                    material=HOOF,
                    segments=limb_segments,
                )
                parts.append(hoof.moved(y=side * shape.leg_spacing))
    x, z, ear_length, ear_width = shape.ear
    ring_radius = shape.head[1][2]
    ear_spread = 0.75 if style in ("cow", "deer") else 0.35
    tip = (
        x - 0.2 * ear_length,
        (0.6 * ring_radius + ear_spread * ear_length),
        z + ear_length * (0.1 if style == "cow" else 0.6),
    )
    ear = tube(
        [(x, 0.5 * ring_radius, z - 0.25 * ring_radius), tip],
        [0.5 * ear_width, 0.15 * ear_width],
        material=coat_material,
        segments=max(limb_segments - 1, 3),
    )
    parts.append(both_sides(ear))
    parts += _headgear(style, shape, limb_segments, antlers=has_antlers, dark=mane_material)
    return finish(parts, [], size)


def _headgear(style: str, beast: _AnimalShape, sides: int, *, antlers: bool, dark: Material) -> list[Mesh]:
    """Horns and udder of a cow, antlers of a stag, mane of a horse."""
    x, z, _ = beast.head[0]
    if style == "cow":
        horn = [(x + 0.04, 0.08, z + 0.06), (x + 0.06, 0.20, z + 0.10), (x + 0.12, 0.24, z + 0.20)]
        udder = sphere((0.18, 0.15, 0.13), material=UDDER, segments=sides + 1).moved(-0.48, 0.0, 0.66)
        return [both_sides(tube(horn, [0.035, 0.028, 0.008], material=HORN, segments=sides)), udder]
    if style == "deer" and antlers:
        antler_beam = [
            (x + 0.03, 0.05, z + 0.08),
            (x - 0.08, 0.16, z + 0.24),
            (x - 0.02, 0.24, z + 0.42),
            (x + 0.08, 0.2, z + 0.52),
        ]
        antler_tines = [
            [(x + 0.02, 0.06, z + 0.10), (x + 0.16, 0.08, z + 0.20)],
            [(x - 0.08, 0.16, z + 0.24), (x + 0.06, 0.18, z + 0.36)],
            [(x - 0.02, 0.24, z + 0.42), (x - 0.10, 0.22, z + 0.54)],
        ]
        parts = [tube(antler_beam, [0.022, 0.02, 0.016, 0.006], material=HORN, segments=max(sides - 1, 3))]
        parts += [tube(tine, [0.014, 0.005], material=HORN, segments=3) for tine in antler_tines]
        return [both_sides(part) for part in parts]
    if style == "horse":
        crest = [
            (neck_x - 0.45 * neck_radius, neck_z + 0.75 * neck_radius, 0.05)
            for neck_x, neck_z, neck_radius in beast.neck
        ]
        forelock = [(x + 0.06, z + 0.09, 0.04), (x + 0.17, z - 0.03, 0.02)]
        return [_tapered_body(crest, dark, sides, 0.7), _tapered_body(forelock, dark, sides, 0.9)]
    return []


def _smooth_path(path: Path, finer: int) -> list[tuple[float, float, float]]:
    """The path with `finer` pieces for each of its pieces, on smooth lines."""
    if finer == 1:
        return list(path)
    positions = np.linspace(0.0, len(path) - 1.0, finer * (len(path) - 1) + 1)
    columns = [
        curve([(float(index), point[axis]) for index, point in enumerate(path)], positions).tolist()
        for axis in range(3)
    ]
    return [(x, z, radius) for x, z, radius in zip(*columns, strict=True)]


def _tapered_body(path: Path, material: Material, sides: int, width_share: float) -> Mesh:
    """A round body along a path of (x, z, radius) in the plane y = 0, `width_share` times as wide as it is high."""
    columns = np.array(path)
    points = np.stack([columns[:, 0], np.zeros(len(columns)), columns[:, 1]], 1)
    body = tube(points, columns[:, 2], material=material, segments=sides)
    return body.transformed(np.diag([1.0, width_share, 1.0]))


def _paint_spots(mesh: Mesh, spots: F64, material: Material, *, upright: bool = False) -> Mesh:
    """The mesh with another material on the faces near some of the spots [n, 3] (from -1 to 1 over its bounding box).

    upright: the faces that look down get it instead.
    """
    lower, upper = mesh.bounds()
    centres = (mesh.corners().mean(1) - lower) / (upper - lower) * 2.0 - 1.0
    if upright:
        is_spotted = mesh.normals[..., 2].mean(1) < -0.75
    else:
        distances = np.linalg.norm((centres[:, None] - spots[None]) * [1.0, 0.8, 0.8], axis=-1)
        is_spotted = distances.min(1) < 0.42
    return replace(
        mesh,
        material=np.where(is_spotted, len(mesh.materials), mesh.material).astype(np.int32),
        materials=(*mesh.materials, material),
    )


# ---------------------------------------------------------------- vehicles

OVERTURNED_CARS = {"car_side": "sedan", "suv_side": "suv", "car_roof": "hatchback"}


def overturned_vehicle(style: str, size: Point, *, generator: np.random.Generator, detail: int) -> Mesh:
    """Return a car or truck on its side or roof that fills its size, m; its panels are those of the vehicle."""
    length, width, height = size
    side = 1.0 if generator.random() < 0.5 else -1.0
    is_on_roof = style == "car_roof"
    # Lying on its side, a vehicle is as wide as it was tall.
    upright_size = (length, width, height) if is_on_roof else (length, height, width)
    if style == "truck_side":
        vehicle = truck("box", upright_size, generator=generator, detail=detail)
        underside = _underside(upright_size, 0.28 * upright_size[2], truck=True)
    else:
        vehicle = car(OVERTURNED_CARS[style], upright_size, generator=generator, detail=detail)
        underside = _underside(upright_size, 0.17 * upright_size[2], truck=False)
    lying_mesh = merge([vehicle, underside]).transformed(
        _axis_rotation("x", np.pi if is_on_roof else side * np.pi / 2.0)
    )
    return fit(_flatten_base(lying_mesh, 0.05 * height if is_on_roof else None), size)


def _flatten_base(mesh: Mesh, dent: float | None) -> Mesh:
    """Flatten the mesh at the ground: press in its mirrors, or `dent` m of its roof."""
    corners = mesh.corners()
    lowest = float(corners[..., 2].min())
    ground_height = float(corners[mesh.panel >= 0, :, 2].min()) if dent is None else lowest + dent
    vertices = mesh.vertices.copy()
    vertices[:, 2] = np.maximum(vertices[:, 2], ground_height)
    pressed_mesh = replace(mesh, vertices=vertices)
    # Pressed faces may have lost their area.
    return part_of(pressed_mesh, pressed_mesh.areas() > 1e-7)


def _underside(size: Point, top: float, *, truck: bool) -> Mesh:
    """Return the underside of a vehicle: floor, axles, exhaust or frame and tank, drive shaft."""
    length, width, _ = size
    half_width = 0.5 * width
    if truck:
        parts = [
            crate((-0.48 * length, y - 0.06, top - 0.3), (0.45 * length, y + 0.06, top), FRAME) for y in (-0.4, 0.4)
        ]
        parts.append(
            crate((-0.48 * length, -0.85 * half_width, top), (0.48 * length, 0.85 * half_width, top + 0.05), DARK)
        )
        axles, axle_height = (-0.28 * length, 0.34 * length), 0.45
    else:
        parts = [crate((-0.46 * length, -0.78 * half_width, top), (0.46 * length, 0.78 * half_width, top + 0.06), DARK)]
        exhaust = [
            (0.25 * length, -0.25, top - 0.02),
            (-0.2 * length, -0.3, top - 0.02),
            (-0.46 * length, -0.45, top - 0.02),
        ]
        parts.append(tube(exhaust, 0.04, material=STEEL, segments=5))
        silencer_box = (-0.43 * length, -0.35, top - 0.09), (-0.36 * length, 0.35, top + 0.02)
        parts += [crate(*silencer_box, STEEL), crate((0.2 * length, -0.3, top - 0.06), (0.4 * length, 0.3, top), FRAME)]
        parts.append(crate((-0.3 * length, -0.4, top - 0.04), (-0.15 * length, 0.4, top), FRAME))
        axles, axle_height = (-0.285 * length, 0.335 * length), 0.3
    parts += [
        tube(
            [(x, -0.8 * half_width, axle_height), (x, 0.8 * half_width, axle_height)], 0.05, material=FRAME, segments=5
        )
        for x in axles
    ]
    parts.append(
        tube([(axles[0], 0.0, axle_height), (0.2 * length, 0.0, axle_height + 0.02)], 0.04, material=STEEL, segments=5)
    )
    return merge(parts)


def _axis_rotation(axis: str, angle: float) -> F64:
    """Return a rotation [3, 3] about x or z."""
    cosine, sine = np.cos(angle), np.sin(angle)
    if axis == "x":
        return np.array([[1.0, 0.0, 0.0], [0.0, cosine, -sine], [0.0, sine, cosine]])
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def _colour(values: npt.ArrayLike) -> tuple[float, float, float]:
    """Clip linear RGB to [0, 0.9] and round it, so that equal colours share a material."""
    red, green, blue = np.round(np.clip(np.asarray(values, np.float64), 0.0, 0.9), 4).tolist()
    return red, green, blue


def _point(values: F64) -> Point:
    x, y, z = values.tolist()
    return x, y, z
