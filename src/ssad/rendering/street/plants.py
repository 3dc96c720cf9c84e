"""Trees, bushes and hedges: a trunk, dark blobs inside the crown, and leaves as triangles around them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ssad.core.geometry import cross
from ssad.rendering.meshes.mesh import F64
from ssad.rendering.street.model import FAR, MID, NEAR
from ssad.rendering.street.palette import TownMaterials
from ssad.rendering.street.triangles import TrianglePiece, box, cylinder, join, smooth

VISIBLE = NEAR | MID


def _icosahedron() -> tuple[F64, np.ndarray]:
    """Return the unit vertices [12, 3] and faces [20, 3] of an icosahedron."""
    golden_ratio = (1.0 + 5.0**0.5) / 2.0
    vertices = np.array(
        [
            (-1, golden_ratio, 0),
            (1, golden_ratio, 0),
            (-1, -golden_ratio, 0),
            (1, -golden_ratio, 0),
            (0, -1, golden_ratio),
            (0, 1, golden_ratio),
            (0, -1, -golden_ratio),
            (0, 1, -golden_ratio),
            (golden_ratio, 0, -1),
            (golden_ratio, 0, 1),
            (-golden_ratio, 0, -1),
            (-golden_ratio, 0, 1),
        ],
        np.float64,
    )
    faces = np.array(
        [
            (0, 11, 5),
            (0, 5, 1),
            (0, 1, 7),
            (0, 7, 10),
            (0, 10, 11),
            (1, 5, 9),
            (5, 11, 4),
            (11, 10, 2),
            (10, 7, 6),
            (7, 1, 8),
            (3, 9, 4),
            (3, 4, 2),
            (3, 2, 6),
            (3, 6, 8),
            (3, 8, 9),
            (4, 9, 5),
            (2, 4, 11),
            (6, 2, 10),
            (8, 6, 7),
            (9, 8, 1),
        ]
    )
    return vertices / np.linalg.norm(vertices[0]), faces


BALL, BALL_FACES = _icosahedron()


def blob(
    centre: F64, radius: F64, material: int, materials: TownMaterials, *, levels: int, rough: float = 0.14
) -> TrianglePiece:
    """An uneven ellipsoid of 20 triangles, shaded smooth."""
    rng = materials.generator
    angle = rng.uniform(0.0, 2.0 * np.pi)
    cosine, sine = np.cos(angle), np.sin(angle)
    directions = BALL @ np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    vertices = directions * radius * rng.uniform(1 - rough, 1 + rough, (12, 1)) + centre
    return smooth(vertices, BALL_FACES, directions / radius, material, levels=levels)


def leaves(
    centre: F64, radius: F64, style_materials: TownMaterials, *, count: int, size: float, materials: list[int]
) -> TrianglePiece:
    """Triangles about `size` m on an ellipsoid, tilted at random, with their outsides away from its centre."""
    rng = style_materials.generator
    positions = np.arange(count) + 0.5
    z = 1.0 - 1.85 * positions / count  # few leaves at the underside
    # Golden-angle spiral: an even distribution for any number of leaves.
    azimuths = np.pi * (1.0 + 5.0**0.5) * positions + rng.uniform(0.0, 6.0)
    circle_radii = np.sqrt(np.maximum(1.0 - z * z, 0.0))
    directions = np.stack([circle_radii * np.cos(azimuths), circle_radii * np.sin(azimuths), z], axis=1)
    centres = directions * radius * rng.uniform(0.86, 1.08, (count, 1)) + centre
    leaf_normals = directions + 0.75 * rng.normal(size=(count, 3))
    leaf_normals /= np.linalg.norm(leaf_normals, axis=1, keepdims=True)
    leaf_normals *= np.sign((leaf_normals * directions).sum(axis=1, keepdims=True) + 1e-9)
    side_axes = cross(leaf_normals, rng.normal(size=(count, 3)))
    half_sizes = size * rng.uniform(0.6, 1.1, (count, 1, 1))
    vertex_normals = np.repeat(directions / radius + [0.0, 0.0, 0.15], 3, axis=0)
    # The upper leaves catch more light: lighter greens come first in the table.
    material_index = np.clip(
        (0.5 * (1.0 - z) * len(materials) + rng.normal(0.0, 0.9, count)).astype(int), 0, len(materials) - 1
    )
    return _leaf_triangles(
        centres,
        leaf_normals,
        side_axes,
        half_sizes,
        (0.0, 2.0, 4.2),
        vertex_normals,
        np.array(materials)[material_index],
    )


def _leaf_triangles(  # noqa: PLR0917
    place: F64,
    outward: F64,
    side: F64,
    half: F64 | float,
    turns: tuple[float, ...],
    normal: F64,
    material: npt.ArrayLike,
) -> TrianglePiece:
    """A triangle about each place [n, 3]: across `outward` (unit), its corners turned from `side`, `half` m away."""
    side = side / np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-9)
    cosines, sines = np.cos(turns)[None, :, None], np.sin(turns)[None, :, None]
    corners = place[:, None] + half * (cosines * side[:, None] + sines * cross(outward, side)[:, None])
    faces = np.arange(3 * len(place), dtype=np.int32).reshape(-1, 3)
    return smooth(corners.reshape(-1, 3), faces, normal, material, levels=NEAR)


def _greens(kind: str, materials: TownMaterials) -> list[int]:
    """Three greens of a kind, light to dark."""
    entries = list(materials.palette.table)
    indices = materials.generator.choice(materials.leaves[kind], 3, replace=False).tolist()
    return sorted(indices, key=lambda index: -sum(entries[index].colour))


def tree(kind: str, materials: TownMaterials) -> TrianglePiece:
    """A tree of a kind (round, tall, birch, conifer), its trunk at the origin; 5 to 14 m tall."""
    rng = materials.generator
    if kind == "conifer":
        return _conifer(materials)
    greens = _greens(kind, materials)
    dark_green = materials.palette.shade(greens[-1], 0.6)
    height = {"round": rng.uniform(6.0, 9.5), "tall": rng.uniform(9.0, 13.5), "birch": rng.uniform(7.5, 11.0)}[kind]
    radius_shares = {"round": (0.34, 0.36), "tall": (0.15, 0.42), "birch": (0.20, 0.36)}[kind]
    radius = np.array([radius_shares[0], radius_shares[0], radius_shares[1]]) * height * rng.uniform(0.9, 1.12, 3)
    centre = np.array([0.0, 0.0, height - radius[2]])
    trunk_radius = 0.020 * height if kind != "birch" else 0.013 * height
    bark = materials.bark[1] if kind == "birch" else materials.bark[0]
    parts = [
        cylinder((trunk_radius, 0.55 * trunk_radius), (-0.1, 0.75 * height), bark, sides=6, levels=VISIBLE),
        cylinder((trunk_radius, 0.6 * trunk_radius), (-0.1, 0.6 * height), bark, sides=3, levels=FAR),
        blob(centre, 0.98 * radius, greens[1], materials, levels=FAR, rough=0.1),
    ]
    lobe_count = {"round": 3, "tall": 2, "birch": 3}[kind]
    leaf_count = {"round": 32, "tall": 38, "birch": 26}[kind]
    for lobe_index in range(lobe_count):
        angle = 2.0 * np.pi * lobe_index / lobe_count + rng.uniform(-0.5, 0.5)
        height_offset = (lobe_index / max(lobe_count - 1, 1) - 0.5) * 0.7
        lobe_offset = np.array([0.42 * np.cos(angle), 0.42 * np.sin(angle), height_offset]) * radius
        lobe_radius = radius * rng.uniform(0.6, 0.75, 3) * ([1.0, 1.0, 1.0] if kind == "round" else [1.15, 1.15, 0.95])
        parts.append(blob(centre + lobe_offset, 0.9 * lobe_radius, dark_green, materials, levels=VISIBLE))
        parts.append(
            leaves(
                centre + lobe_offset,
                lobe_radius,
                materials,
                count=leaf_count,
                size=0.33 * float(lobe_radius.mean()),
                materials=greens,
            )
        )
    return join(parts)


def _conifer(materials: TownMaterials) -> TrianglePiece:
    """Whorls of branches as cones with ragged rims."""
    rng, greens = materials.generator, _greens("conifer", materials)
    height = rng.uniform(7.5, 13.0)
    base_radius = height * rng.uniform(0.17, 0.24)
    parts = [
        cylinder(
            (0.018 * height, 0.012 * height), (-0.1, 0.3 * height), materials.bark[0], sides=5, levels=NEAR | MID | FAR
        ),
        cylinder((base_radius, 0.0), (0.14 * height, height), greens[1], sides=6, levels=FAR),
    ]
    whorl_count, side_count = 6, 9
    for whorl_index in range(whorl_count):
        lower, upper = (
            (0.12 + 0.84 * whorl_index / whorl_count) * height,
            (0.12 + 0.84 * (whorl_index + 1.75) / whorl_count) * height,
        )
        radius = base_radius * (1.0 - 0.86 * whorl_index / whorl_count)
        angles = (np.arange(side_count) + rng.uniform()) * 2.0 * np.pi / side_count
        rim_radii = radius * rng.uniform(0.7, 1.1, side_count)
        rim = np.column_stack(
            [
                rim_radii * np.cos(angles),
                rim_radii * np.sin(angles),
                lower + 0.05 * height * rng.uniform(-0.5, 0.5, side_count),
            ]
        )
        vertices = np.vstack([rim, [[0.0, 0.0, min(upper, height)]]])
        indices = np.arange(side_count)
        outer_normals = np.column_stack([np.cos(angles), np.sin(angles), np.full(side_count, 0.6)])
        parts.append(
            smooth(
                vertices,
                np.stack([indices, (indices + 1) % side_count, np.full(side_count, side_count)], 1),
                np.vstack([outer_normals, [[0, 0, 1]]]),
                greens[whorl_index % 2],
                levels=VISIBLE,
            )
        )
        lower_vertices = np.vstack([rim, [[0.0, 0.0, lower + 0.3 * radius]]])
        lower_faces = np.stack([(indices + 1) % side_count, indices, np.full(side_count, side_count)], 1)
        lower_normals = np.broadcast_to([0.0, 0.0, -1.0], lower_vertices.shape)
        parts.append(
            smooth(lower_vertices, lower_faces, lower_normals, materials.palette.shade(greens[2], 0.6), levels=NEAR)
        )
    return join(parts)


def bush(materials: TownMaterials) -> TrianglePiece:
    """A bush about 1.2 m tall."""
    rng = materials.generator
    greens = _greens(str(rng.choice(["round", "tall", "birch"])), materials)
    radius = np.array([0.7, 0.7, 0.6]) * rng.uniform(0.8, 1.2, 3)
    centre = np.array([0.0, 0.0, 0.85 * radius[2]])
    return join(
        [
            blob(centre, 0.92 * radius, materials.palette.shade(greens[-1], 0.7), materials, levels=VISIBLE),
            leaves(centre, radius, materials, count=36, size=0.22, materials=greens),
        ]
    )


def hedge(materials: TownMaterials, material: int) -> TrianglePiece:
    """A metre of hedge along x, 0.7 m thick and 1 m tall; scale it."""
    rng = materials.generator
    light_green = materials.palette.shade(material, 1.5)
    parts = [box((-0.52, -0.33, -0.1), (0.52, 0.33, 0.97), material, levels=VISIBLE)]
    leaf_count = 15
    centres = np.column_stack(
        [rng.uniform(-0.5, 0.5, leaf_count), rng.choice([-0.34, 0.34], leaf_count), rng.uniform(0.05, 1.0, leaf_count)]
    )
    centres[::3, 1], centres[::3, 2] = rng.uniform(-0.33, 0.33, len(centres[::3])), 0.98
    outwards = np.column_stack([np.zeros(leaf_count), np.sign(centres[:, 1]), np.zeros(leaf_count)])
    outwards[::3] = 0.0, 0.0, 1.0
    leaf_normals = outwards + 0.5 * rng.normal(size=(leaf_count, 3))
    leaf_normals /= np.linalg.norm(leaf_normals, axis=1, keepdims=True)
    side_axes = cross(leaf_normals, [0.3, 0.2, 0.9])
    leaf_materials = np.where(rng.random(leaf_count) < 0.5, light_green, material)
    parts.append(
        _leaf_triangles(
            centres, leaf_normals, side_axes, 0.12, (0.0, 2.1, 4.2), np.repeat(outwards, 3, axis=0), leaf_materials
        )
    )
    return join(parts)
