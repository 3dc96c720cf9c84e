"""Trees, bushes, hedges and grass: a trunk, dark blobs inside the crown, and leaf cards around them.

A leaf card is a small triangle, longer than wide. Its material is called "twigs": the camera cuts leaves out of it.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ssad.core.geometry import cross
from ssad.core.seeding import generator
from ssad.rendering.meshes.mesh import F64
from ssad.rendering.street.model import FAR, MID, NEAR
from ssad.rendering.street.palette import TownMaterials
from ssad.rendering.street.triangles import TrianglePiece, box, cylinder, join, smooth

VISIBLE = NEAR | MID
LEAF_WIDTH = 0.62  # half of the base of a leaf card, in half of its length


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
    centre: F64,
    radius: F64,
    material: int,
    materials: TownMaterials,
    *,
    levels: int,
    rough: float = 0.14,
    key: str = "",
) -> TrianglePiece:
    """An uneven ellipsoid of 20 triangles, shaded smooth; with a `key`, its form takes none of the town's draws."""
    rng = generator(key, *centre.tolist(), *radius.tolist()) if key else materials.generator
    angle = rng.uniform(0.0, 2.0 * np.pi)
    cosine, sine = np.cos(angle), np.sin(angle)
    directions = BALL @ np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    vertices = directions * radius * rng.uniform(1 - rough, 1 + rough, (12, 1)) + centre
    return smooth(vertices, BALL_FACES, directions / radius, material, levels=levels)


def leaves(
    centre: F64,
    radius: F64,
    style_materials: TownMaterials,
    *,
    count: int,
    size: float,
    materials: list[int],
    levels: int = NEAR,
    sparse: bool = False,
) -> TrianglePiece:
    """Leaf cards about `size` m long in the outer half of an ellipsoid, tilted at random, outsides away from it.

    `sparse` leaves out every third card, but not its draws: they decide about parking bays, too.
    """
    rng = style_materials.details
    positions = np.arange(count) + 0.5
    z = 1.0 - 1.9 * positions / count  # few leaves at the underside
    # Golden-angle spiral: an even distribution for any number of leaves.
    azimuths = np.pi * (1.0 + 5.0**0.5) * positions + rng.uniform(0.0, 6.0)
    circle_radii = np.sqrt(np.maximum(1.0 - z * z, 0.0))
    directions = np.stack([circle_radii * np.cos(azimuths), circle_radii * np.sin(azimuths), z], axis=1)
    # Leaves of one branch stand out together: the outline is uneven at the scale of branches, too.
    branch = np.sin(directions @ rng.normal(0.0, 3.4, 3) + rng.uniform(0.0, 6.0))
    depth = 0.93 + 0.05 * branch + rng.uniform(-0.10, 0.07, count)
    centres = directions * radius * depth[:, None] + centre
    leaf_normals = directions + 0.8 * rng.normal(size=(count, 3))
    leaf_normals /= np.linalg.norm(leaf_normals, axis=1, keepdims=True)
    leaf_normals *= np.sign((leaf_normals * directions).sum(axis=1, keepdims=True) + 1e-9)
    side_axes = cross(leaf_normals, rng.normal(size=(count, 3)))
    half_sizes = 0.5 * size * rng.uniform(0.7, 1.25, (count, 1, 1))
    vertex_normals = directions / radius * float(np.mean(radius)) + 0.6 * leaf_normals + [0.0, 0.0, 0.2]
    # The upper and outer leaves catch more light: lighter greens come first in the table.
    shade = 0.35 * (1.0 - z) + 1.5 * (0.97 - depth)
    material_index = np.clip((shade * len(materials) + rng.normal(0.0, 0.9, count)).astype(int), 0, len(materials) - 1)
    twigs = _twigs(materials, style_materials)[material_index]
    drawn = np.flatnonzero(positions % 3 < 2) if sparse else np.arange(count)
    card_arrays = (values[drawn] for values in (centres, leaf_normals, side_axes, half_sizes, vertex_normals, twigs))
    return _leaf_cards(*card_arrays, levels=levels)


def _twigs(greens: list[int], materials: TownMaterials) -> npt.NDArray[np.int64]:
    """Return the materials of leaf cards with the colours of greens."""
    return np.array([materials.palette.shade(green, 1.0, "twigs") for green in greens])


def _leaf_cards(  # noqa: PLR0917
    place: F64,
    outward: F64,
    side: F64,
    half: F64 | float,
    normal: F64,
    material: npt.ArrayLike,
    *,
    levels: int = NEAR,
) -> TrianglePiece:
    """A card about each place [n, 3]: across `outward` (unit), its tip along `side`, `half` m to its ends."""
    side = side / np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-9)
    along, across = half * side[:, None], LEAF_WIDTH * half * cross(outward, side)[:, None]
    corners = place[:, None] + np.concatenate([-0.8 * along - across, along, -0.8 * along + across], axis=1)
    faces = np.arange(3 * len(place), dtype=np.int32).reshape(-1, 3)
    return smooth(corners.reshape(-1, 3), faces, np.repeat(normal, 3, axis=0), material, levels=levels)


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
    dark_green = materials.palette.shade(greens[-1], 0.42)
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
    leaf_count = {"round": 88, "tall": 94, "birch": 76}[kind]
    for lobe_index in range(lobe_count):
        angle = 2.0 * np.pi * lobe_index / lobe_count + rng.uniform(-0.5, 0.5)
        height_offset = (lobe_index / max(lobe_count - 1, 1) - 0.5) * 0.7
        lobe_offset = np.array([0.42 * np.cos(angle), 0.42 * np.sin(angle), height_offset]) * radius
        lobe_radius = radius * rng.uniform(0.6, 0.75, 3) * ([1.0, 1.0, 1.0] if kind == "round" else [1.15, 1.15, 0.95])
        parts += [
            blob(centre + lobe_offset, 0.76 * lobe_radius, dark_green, materials, levels=NEAR),
            blob(centre + lobe_offset, 0.8 * lobe_radius, dark_green, materials, levels=MID, rough=0.2),
            *_shells(centre + lobe_offset, lobe_radius, greens, materials),
            leaves(
                centre + lobe_offset,
                lobe_radius,
                materials,
                count=leaf_count,
                size=0.66 * float(lobe_radius.mean()),
                materials=[materials.palette.shade(greens[0], 1.35), *greens],
                sparse=True,
            ),
            leaves(
                centre + lobe_offset,
                lobe_radius,
                materials,
                count=8,
                size=0.62 * float(lobe_radius.mean()),
                materials=greens,
                levels=MID,
                sparse=True,
            ),
        ]
    return join(parts)


def _shells(centre: F64, radius: F64, greens: list[int], materials: TownMaterials) -> list[TrianglePiece]:
    """Two shells of leaves around the dark inside of a crown, the outer one lighter."""
    dark, light = _twigs([greens[-1], greens[1]], materials).tolist()
    return [
        blob(centre, 0.97 * radius, dark, materials, levels=VISIBLE, rough=0.16, key="inner leaves"),
        blob(centre, 1.05 * radius, light, materials, levels=NEAR, rough=0.2, key="outer leaves"),
    ]


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
        inside = [0.84, 0.84, 1.0]
        indices = np.arange(side_count)
        outer_normals = np.column_stack([np.cos(angles), np.sin(angles), np.full(side_count, 0.6)])
        parts.append(
            smooth(
                vertices * inside,
                np.stack([indices, (indices + 1) % side_count, np.full(side_count, side_count)], 1),
                np.vstack([outer_normals, [[0, 0, 1]]]),
                materials.palette.shade(greens[whorl_index % 2], 0.7),
                levels=VISIBLE,
            )
        )
        # Base and tip as of a card: rows of leaves from the rim to the top.
        shell_faces = np.stack([(indices + 1) % side_count, np.full(side_count, side_count), indices], 1)
        shell_normals = np.vstack([outer_normals, [[0, 0, 1]]])
        for shell_size, green, levels in ((0.97, whorl_index % 2, NEAR), (1.08, (whorl_index + 1) % 2, VISIBLE)):
            shell = vertices * [shell_size, shell_size, 1.0]
            parts.append(smooth(shell, shell_faces, shell_normals, _twigs(greens, materials)[green], levels=levels))
        parts.append(_sprays(materials, (lower, min(upper, height)), radius, greens))
        lower_vertices = np.vstack([rim * inside, [[0.0, 0.0, lower + 0.3 * radius]]])
        lower_faces = np.stack([(indices + 1) % side_count, indices, np.full(side_count, side_count)], 1)
        lower_normals = np.broadcast_to([0.0, 0.0, -1.0], lower_vertices.shape)
        parts.append(
            smooth(lower_vertices, lower_faces, lower_normals, materials.palette.shade(greens[2], 0.6), levels=NEAR)
        )
    return join(parts)


def _sprays(materials: TownMaterials, z: tuple[float, float], radius: float, greens: list[int]) -> TrianglePiece:
    """Twigs of a whorl between two heights that hang outwards over its cone of a radius."""
    rng = materials.details
    count = max(8, int(14.0 * radius))
    angles = rng.uniform(0.0, 2.0 * np.pi, count)
    shares = rng.uniform(0.0, 0.75, count)
    outwards = np.column_stack([np.cos(angles), np.sin(angles), np.full(count, 0.0)])
    centres = (
        outwards * (radius * (1.02 - shares))[:, None] + [0.0, 0.0, 1.0] * (z[0] + shares * (z[1] - z[0]))[:, None]
    )
    tilt = rng.uniform(-0.7, -0.1, count)
    along = outwards + [0.0, 0.0, 1.0] * tilt[:, None]
    normals = np.column_stack([np.cos(angles) * -tilt, np.sin(angles) * -tilt, np.ones(count)])
    normals += 0.25 * rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    half = radius * rng.uniform(0.18, 0.30, (count, 1, 1))
    shading = outwards + [0.0, 0.0, 0.6] + 0.3 * normals
    return _leaf_cards(centres, normals, along, half, shading, _twigs(greens, materials)[rng.integers(0, 2, count)])


def bush(materials: TownMaterials) -> TrianglePiece:
    """A bush about 1.2 m tall."""
    rng = materials.generator
    greens = _greens(str(rng.choice(["round", "tall", "birch"])), materials)
    radius = np.array([0.7, 0.7, 0.6]) * rng.uniform(0.8, 1.2, 3)
    centre = np.array([0.0, 0.0, 0.85 * radius[2]])
    return join(
        [
            blob(centre, 0.74 * radius, materials.palette.shade(greens[-1], 0.6), materials, levels=NEAR),
            blob(centre, 0.94 * radius, greens[-1], materials, levels=MID, rough=0.2),
            *_shells(centre, radius, greens, materials)[:1],
            leaves(centre, radius, materials, count=50, size=0.44, materials=greens),
        ]
    )


def hedge(materials: TownMaterials, material: int) -> TrianglePiece:
    """A metre of hedge along x, 0.7 m thick and 1 m tall; scale it."""
    greens = [materials.palette.shade(material, factor) for factor in (1.6, 1.0, 0.75)]
    return join(
        [
            box((-0.50, -0.27, -0.1), (0.50, 0.27, 0.91), materials.palette.shade(material, 0.5), levels=NEAR),
            box((-0.52, -0.33, -0.1), (0.52, 0.33, 0.97), material, levels=MID),
            box((-0.52, -0.33, -0.1), (0.52, 0.33, 0.97), _twigs(greens, materials)[2], levels=NEAR),
            box((-0.54, -0.36, -0.1), (0.54, 0.36, 1.0), _twigs(greens, materials)[1], levels=NEAR),
            _hedge_leaves(materials.generator, 15, (0.16, 0.18), _twigs(greens, materials)),
            _hedge_leaves(materials.details, 18, (0.12, 0.22), _twigs(greens, materials)),
        ]
    )


def _hedge_leaves(
    rng: np.random.Generator, count: int, half_size: tuple[float, float], twigs: npt.NDArray[np.int64]
) -> TrianglePiece:
    """Leaf cards on both sides and, each third of them, on the top of a metre of hedge."""
    centres = np.column_stack(
        [rng.uniform(-0.54, 0.54, count), rng.choice([-0.33, 0.33], count), rng.uniform(0.02, 1.0, count)]
    )
    outwards = np.column_stack([np.zeros(count), np.sign(centres[:, 1]), np.zeros(count)])
    centres[::3, 1], centres[::3, 2] = rng.uniform(-0.33, 0.33, len(centres[::3])), 0.97
    outwards[::3] = 0.0, 0.0, 1.0
    leaf_normals = outwards + 0.55 * rng.normal(size=(count, 3))
    leaf_normals /= np.linalg.norm(leaf_normals, axis=1, keepdims=True)
    leaf_normals *= np.sign((leaf_normals * outwards).sum(axis=1, keepdims=True) + 1e-9)
    # Leaves near the top catch more light.
    shade = 2.2 * (1.0 - centres[:, 2]) + 1.6 * (rng.random(count) - 0.5)
    turns = np.arange(count)[:, None]
    side_axes = cross(leaf_normals, np.hstack([np.sin(turns), np.cos(turns), 0.9 + 0.0 * turns]))
    half_sizes = np.linspace(*half_size, count)[:, None, None]
    shading = outwards + 0.4 * leaf_normals
    colours = twigs[np.clip(shade.astype(int), 0, len(twigs) - 1)]
    return _leaf_cards(centres, leaf_normals, side_axes, half_sizes, shading, colours)


def tuft(materials: TownMaterials) -> TrianglePiece:
    """Blades of grass about 0.2 m tall that lean outwards."""
    rng = materials.details
    count = 4
    angles = 2.0 * np.pi * (np.arange(count) + rng.uniform(0.0, 0.8, count)) / count
    directions = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(count)])
    across = np.column_stack([-np.sin(angles), np.cos(angles), np.zeros(count)])
    feet = rng.uniform(0.0, 0.12, (count, 1)) * directions
    width, height = rng.uniform(0.03, 0.06, (count, 1)), rng.uniform(0.10, 0.24, (count, 1))
    tips = feet + rng.uniform(0.3, 0.8, (count, 1)) * height * directions + [0.0, 0.0, 1.0] * height
    corners = np.stack([feet - width * across, tips, feet + width * across], axis=1)
    # Level normals: grass has the brightness of the ground around it.
    normals = np.broadcast_to([0.0, 0.0, 1.0], (3 * count, 3))
    faces = np.arange(3 * count, dtype=np.int32).reshape(-1, 3)
    return smooth(corners.reshape(-1, 3), faces, normals, rng.choice(materials.blades, count), levels=NEAR)
