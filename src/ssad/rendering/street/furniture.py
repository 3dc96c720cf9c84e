"""Street furniture: lamps, signals, signs, benches, bins, fences. Frame: x towards the road."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssad.rendering.street.model import MID, NEAR
from ssad.rendering.street.palette import TownMaterials
from ssad.rendering.street.triangles import ALL, TrianglePiece, box, cylinder, flat, join

VISIBLE = NEAR | MID
LENS = 0.11  # m, radius of a signal's lens


def disc(
    centre: tuple[float, float, float],
    radius: float,
    material: int,
    *,
    sides: int = 10,
    turn: float = 0.0,
    levels: int = NEAR,
) -> TrianglePiece:
    """Return a flat disc that faces along x."""
    angles = turn + np.arange(sides) * 2.0 * np.pi / sides
    ring = np.column_stack([0 * angles, np.cos(angles), np.sin(angles)]) * radius + centre
    return flat(ring[None], material, levels=levels)


def lamp(materials: TownMaterials) -> tuple[TrianglePiece, tuple[float, float]]:
    """A street lamp, and the reach and height of its light, m."""
    if materials.style.old:
        parts = [
            cylinder((0.10, 0.07), (0.0, 0.6), materials.pole, sides=6, levels=VISIBLE),
            cylinder((0.055, 0.04), (0.6, 3.5), materials.pole, sides=6, levels=VISIBLE),
            box((-0.16, -0.16, 3.5), (0.16, 0.16, 3.95), materials.glow, levels=VISIBLE, base=True),
            box((-0.2, -0.2, 3.95), (0.2, 0.2, 4.0), materials.pole, levels=VISIBLE, base=True),
            cylinder((0.26, 0.0), (4.0, 4.25), materials.pole, sides=4, levels=VISIBLE),
        ]
        return join(parts), (0.0, 3.7)
    light_outline = ((-0.3, -0.1), (-0.3, 0.1), (0.3, 0.1), (0.3, -0.1))
    height, reach = (8.5, 1.9) if materials.style.lamp >= 30.0 else (6.5, 1.2)
    parts = [
        cylinder((0.09, 0.05), (0.0, height), materials.pole, sides=6, levels=VISIBLE),
        box((0.0, -0.03, height - 0.08), (reach, 0.03, height - 0.02), materials.pole, levels=VISIBLE, base=True),
        box(
            (reach - 0.35, -0.13, height - 0.12),
            (reach + 0.35, 0.13, height),
            materials.pole,
            levels=VISIBLE,
            base=True,
        ),
        flat(
            np.array([[[reach + dx, dy, height - 0.125] for dx, dy in light_outline]]), materials.glow, levels=VISIBLE
        ),
    ]
    return join(parts), (reach, height - 0.15)


@dataclass(frozen=True)
class SignalMast:
    """Signal post in its own frame: x towards the traffic that it faces, the road towards -y.

    Attributes:
        piece: Its triangles.
        heads: y, z of the middle of each head, m.
        lens: First face of the red, amber and green lens of each head.
        sides: Number of faces of a lens.
    """

    piece: TrianglePiece
    heads: tuple[tuple[float, float], ...]
    lens: tuple[tuple[int, int, int], ...]
    sides: int


def signal_mast(materials: TownMaterials, reach: float) -> SignalMast:
    """A post with a head; with `reach` > 0 also an arm that holds a second head `reach` m over the road."""
    post = materials.black if materials.style.old else materials.metal
    height = 6.2 if reach > 0.0 else 3.5
    parts = [cylinder((0.10, 0.07), (0.0, height), post, sides=8, levels=VISIBLE)]
    heads = [(0.0, 2.95)]
    if reach > 0.0:
        parts.append(box((-0.05, -reach - 0.3, 5.85), (0.05, 0.0, 5.97), post, levels=VISIBLE, base=True))
        heads.append((-reach, 5.6))
    lens_of_heads = []
    face_count, sides = sum(len(part.faces) for part in parts), 10
    for y, z in heads:
        front_x = 0.06 if y == 0.0 else -0.1
        housing = box((front_x, y - 0.17, z - 0.5), (0.24, y + 0.17, z + 0.5), materials.black, levels=ALL, base=True)
        plate = box((0.10, y - 0.30, z - 0.62), (0.12, y + 0.30, z + 0.62), materials.black, levels=VISIBLE, base=True)
        parts += [housing, plate]
        face_count += len(housing.faces) + len(plate.faces)
        lens_faces = []
        for lens_index, material in enumerate((materials.red, materials.amber, materials.green)):
            up = z + 0.31 - 0.31 * lens_index
            hood_corners = (0.24, y - 0.13, up + LENS), (0.42, y + 0.13, up + LENS + 0.02)
            hood = box(*hood_corners, materials.black, levels=VISIBLE, base=True)
            light = disc((0.25, y, up), LENS, material, sides=sides, levels=ALL)
            # The renderer lights a lens by its faces, so their numbers must survive `join`.
            lens_faces.append(face_count)
            parts += [light, hood]
            face_count += len(light.faces) + len(hood.faces)
        lens_of_heads.append((lens_faces[0], lens_faces[1], lens_faces[2]))
    return SignalMast(join(parts), tuple(heads), tuple(lens_of_heads), sides - 2)


def sign(kind: str, materials: TownMaterials) -> TrianglePiece:
    """A traffic sign on a post, facing along x: give_way, crossing, parking."""
    sign_materials = materials.sign
    parts = [cylinder((0.035, 0.035), (0.0, 2.75), materials.metal, sides=5, levels=VISIBLE)]
    z, turn = 2.35, np.pi / 2
    shapes: dict[str, list[tuple[float, int, float, int]]] = {  # radius, sides, turn, material
        "give_way": [(0.48, 3, -turn, sign_materials["red"]), (0.30, 3, -turn, sign_materials["white"])],
        "crossing": [(0.46, 4, np.pi / 4, sign_materials["blue"]), (0.34, 3, turn, sign_materials["white"])],
        "parking": [(0.44, 4, np.pi / 4, sign_materials["blue"])],
    }
    for layer, (radius, sides, angle, material) in enumerate(shapes[kind]):
        parts.append(disc((0.05 + 0.006 * layer, 0.0, z), radius, material, sides=sides, turn=angle, levels=VISIBLE))
    radius, sides, angle, _ = shapes[kind][0]
    back = disc((0.0, 0.0, z), radius, sign_materials["back"], sides=sides, turn=angle, levels=VISIBLE)
    back_vertices = back.vertices + np.array([0.045, 0, 0])
    # `disc` faces along x: reverse it to get the back.
    faces, uv = back.faces[:, ::-1].copy(), back.uv[:, ::-1]
    parts.append(TrianglePiece(back_vertices, faces, -back.normals, uv, back.material, back.levels))
    bars: dict[str, list[tuple[float, float, float, float]]] = {  # y0, z0, y1, z1 of letters, roughly
        "parking": [(-0.1, -0.18, -0.03, 0.18), (-0.03, 0.0, 0.12, 0.18)],
    }
    for y0, z0, y1, z1 in bars.get(kind, []):
        quad = [[0.065, y0, z + z0], [0.065, y1, z + z0], [0.065, y1, z + z1], [0.065, y0, z + z1]]
        parts.append(flat(np.array([quad]), sign_materials["white"], levels=NEAR))
    return join(parts)


def bench(materials: TownMaterials) -> TrianglePiece:
    """A bench that faces along x."""
    wood = materials.wood[0]
    slats = np.array([[0.02 + 0.14 * slat, -0.9, 0.42] for slat in range(3)])
    backrests = np.array([[-0.08, -0.9, 0.56], [-0.08, -0.9, 0.74]])
    legs = np.array([[0.0, -0.75, 0.0], [0.0, 0.70, 0.0]])
    return join(
        [
            box(slats, slats + np.array([0.12, 1.8, 0.04]), wood, levels=NEAR, base=True),
            box(backrests, backrests + np.array([0.04, 1.8, 0.13]), wood, levels=NEAR, base=True),
            box(legs, legs + np.array([0.40, 0.05, 0.42]), materials.iron, levels=NEAR),
            box(legs + np.array([-0.08, 0, 0.42]), legs + np.array([-0.03, 0.05, 0.88]), materials.iron, levels=NEAR),
            box((-0.05, -0.9, 0.40), (0.42, 0.9, 0.46), wood, levels=MID),
        ]
    )


def litter_bin(materials: TownMaterials) -> TrianglePiece:
    """A litter bin."""
    return join(
        [
            cylinder(
                (0.22, 0.25),
                (0.05, 0.85),
                materials.pole if materials.style.old else materials.metal,
                sides=8,
                levels=VISIBLE,
            ),
            cylinder((0.27, 0.20), (0.85, 0.98), materials.black, sides=8, levels=NEAR),
        ]
    )


def wheelie_bin(materials: TownMaterials) -> TrianglePiece:
    """A household bin on wheels."""
    colour = materials.walls["awning"][int(materials.generator.integers(2, 6))]
    return join(
        [
            box((-0.28, -0.25, 0.06), (0.28, 0.25, 0.95), materials.palette.shade(colour, 0.5, "bin"), levels=NEAR),
            box((-0.30, -0.28, 0.95), (0.33, 0.28, 1.02), materials.black, levels=NEAR, base=True),
        ]
    )


def bollard(materials: TownMaterials) -> TrianglePiece:
    """A bollard."""
    post = cylinder((0.07, 0.06), (0.0, 0.9), materials.iron, sides=6, levels=NEAR)
    return join([post, disc((0.071, 0.0, 0.78), 0.03, materials.white)])


def shelter(materials: TownMaterials) -> TrianglePiece:
    """A bus shelter, open along x, 4 m wide."""
    posts = np.array([[x, y, 0.0] for x in (-0.55, 0.55) for y in (-2.0, 1.94)])
    pane = box((-0.57, -1.95, 0.25), (-0.54, 1.95, 2.2), materials.glass[3], levels=VISIBLE, base=True)
    return join(
        [
            box(posts, posts + np.array([0.06, 0.06, 2.35]), materials.metal, levels=VISIBLE),
            box((-0.7, -2.15, 2.35), (0.8, 2.15, 2.47), materials.metal, levels=VISIBLE, base=True),
            pane,
            box((-0.45, -1.4, 0.45), (-0.10, 1.4, 0.5), materials.wood[0], levels=NEAR, base=True),
            box((-0.5, 1.9, 0.4), (0.4, 1.96, 2.1), materials.pick("awning"), levels=VISIBLE, base=True),
        ]
    )


def planter(materials: TownMaterials) -> TrianglePiece:
    """A stone trough; a bush goes into it."""
    return box((-0.45, -0.45, 0.0), (0.45, 0.45, 0.55), materials.stone[1], levels=VISIBLE)


def fence(kind: str, materials: TownMaterials) -> TrianglePiece:
    """A metre of fence along x: pickets, planks, wall, rail, chain."""
    if kind == "pickets":
        wood = materials.wood[1]
        pickets = np.array([[-0.5 + 0.2 * picket, -0.012, 0.08] for picket in range(5)])
        rail = np.array([[-0.5, 0.012, 0.25], [-0.5, 0.012, 0.7]])
        return join(
            [
                box(pickets, pickets + np.array([0.1, 0.024, 0.87]), wood, levels=NEAR),
                box(rail, rail + np.array([1.0, 0.03, 0.07]), wood, levels=NEAR),
                box((-0.5, -0.01, 0.2), (0.5, 0.01, 0.9), materials.palette.shade(wood, 0.7), levels=MID),
            ]
        )
    if kind == "planks":
        return join(
            [
                box((-0.5, -0.02, 0.05), (0.5, 0.02, 1.65), materials.wood[2], levels=VISIBLE),
                box((-0.5, -0.05, 0.0), (-0.42, 0.05, 1.72), materials.wood[0], levels=NEAR),
            ]
        )
    if kind == "wall":
        return join(
            [
                box((-0.5, -0.12, -0.1), (0.5, 0.12, 0.85), materials.walls["brick"][2], levels=VISIBLE),
                box((-0.5, -0.16, 0.85), (0.5, 0.16, 0.93), materials.stone[1], levels=VISIBLE),
            ]
        )
    post = box((-0.5, -0.03, 0.0), (-0.44, 0.03, 1.1), materials.metal, levels=NEAR)
    rails = np.array([[-0.5, -0.015, z] for z in (0.45, 0.98)])
    return join([post, box(rails, rails + np.array([1.0, 0.03, 0.05]), materials.metal, levels=VISIBLE)])
