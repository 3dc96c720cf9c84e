"""Building kinds with random details. Frame: x along the front about its middle, y inwards from 0, z up."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import pairwise

import numpy as np

from ssad.rendering.street.facades import (
    VISIBLE,
    Wall,
    balcony,
    block,
    door,
    evenly_spaced,
    flat_roof,
    gable,
    shop_window,
    walls,
    window_grid,
    windows,
)
from ssad.rendering.street.model import NEAR
from ssad.rendering.street.palette import TownMaterials
from ssad.rendering.street.triangles import TrianglePiece, box, flat, join

Size = tuple[float, float]  # m: width of the front, depth


def draw_size(kind: str, materials: TownMaterials) -> Size:
    """Front and depth of a building of a kind, m."""
    front, depth = np.round(materials.generator.uniform(*SIZES[kind]), 1).tolist()
    return front, depth


def draw_building(kind: str, size: Size, materials: TownMaterials) -> TrianglePiece:
    """A building of a kind and size (front, depth)."""
    return join(KINDS[kind](size, materials))


def _masonry(materials: TownMaterials) -> int:
    return materials.pick(str(materials.generator.choice(["plaster", "plaster", "brick"])))


def _chimney(x: float, y: float, top: float, materials: TownMaterials) -> TrianglePiece:
    brick = materials.walls["brick"][0]
    return join(
        [
            box((x - 0.35, y - 0.3, top - 1.6), (x + 0.35, y + 0.3, top + 0.7), brick, levels=VISIBLE),
            box(
                (x - 0.2, y - 0.15, top + 0.7),
                (x + 0.2, y + 0.15, top + 1.0),
                materials.walls["roof_tiles"][0],
                levels=NEAR,
            ),
        ]
    )


def _dormers(
    count: int, width: float, y: float, z: float, materials: TownMaterials, *, wall: int, roof: int
) -> list[TrianglePiece]:
    """Windows that stand out of the front of a roof."""
    parts: list[TrianglePiece] = []
    for x in evenly_spaced(width, count, 1.5).tolist():
        left_edge = x - width / 2
        extent = (left_edge, left_edge + 1.5), (y, y + 2.4), (z, z + 1.5)
        parts.append(block(*extent, wall))
        parts += gable(extent[0], extent[1], z + 1.5, 0.6, roof=roof, wall=wall, across=True, eaves=0.15)
        window_corner = np.array([0.3]), np.array([0.35])
        parts += windows(
            walls(*extent)[0], *window_corner, (0.9, 0.95), materials, frame=materials.frame[0], sill=False
        )
    return parts


def _terrace(size: Size, materials: TownMaterials, *, shop: bool = False) -> list[TrianglePiece]:
    """A house in a row: bare side walls, roof with its ridge along the street."""
    rng, (width, depth) = materials.generator, size
    storey, floors = rng.uniform(2.8, 3.3), int(rng.integers(2, 5 if materials.style.old else 4))
    ground_height = storey * 1.2 if shop else storey
    eaves_height = ground_height + storey * (floors - 1)
    x, y = (-width / 2, width / 2), (0.0, depth)
    material, roof, frame = _masonry(materials), materials.pick("roof_tiles"), int(rng.choice(materials.frame))
    rise = 0.5 * depth * rng.uniform(0.65, 1.05)
    gable_to_street = materials.style.old and rng.random() < 0.25
    parts = [block(x, y, (0.0, eaves_height), material)]
    if gable_to_street:
        rise = 0.5 * width * rng.uniform(1.0, 1.5)
        parts += gable(x, y, eaves_height, rise, roof=roof, wall=material, across=True, eaves=0.12)
    else:
        parts += gable(x, y, eaves_height, rise, roof=roof, wall=material, eaves=0.3)
    front, _, back, _ = walls(x, y, (0.0, eaves_height))
    window_size = (rng.uniform(0.85, 1.15), rng.uniform(1.3, 1.7))
    bay_width = rng.uniform(1.7, 2.3)
    door_centre = float(rng.uniform(1.0, min(2.0, width - 1.0)))
    if shop:
        parts += _shop_front(width, ground_height, front, materials)
        parts += window_grid(
            front, floors - 1, storey, materials, size=window_size, bay=bay_width, frame=frame, ground=ground_height
        )
    else:
        parts += door(front, door_centre, materials)
        parts += window_grid(
            front, floors, storey, materials, size=window_size, bay=bay_width, frame=frame, skip=np.array([door_centre])
        )
    parts += window_grid(back, floors, storey, materials, size=window_size, bay=2.4, frame=frame, sill=False)
    if rng.random() < 0.6:  # bands between the storeys
        band_heights = ground_height + storey * np.arange(floors - 1)
        parts.append(flat(front.quads(0.0, band_heights - 0.1, width, 0.2, 0.05), materials.stone[0], levels=VISIBLE))
    if rng.random() < 0.5 and not shop:
        plinth = materials.palette.shade(material, 0.6, "plinth")
        parts.append(flat(front.quads(0.0, 0.0, width, 0.5, 0.03), plinth, levels=VISIBLE))
    if not gable_to_street:
        parts.append(_chimney(x[0] + 0.5, depth / 2, eaves_height + rise, materials))
        if rng.random() < 0.4 and rise > 2.6:
            parts += _dormers(
                int(width // 3), width, 0.18 * depth, eaves_height + 0.1 * rise, materials, wall=material, roof=roof
            )
    elif rise > 2.5:
        parts += windows(
            front, np.array([width / 2 - 0.4]), np.array([eaves_height + 0.5]), (0.8, 1.0), materials, frame=frame
        )
    return parts


def _shop(size: Size, materials: TownMaterials) -> list[TrianglePiece]:
    return _terrace(size, materials, shop=True)


def _shop_front(w: float, ground: float, front: Wall, materials: TownMaterials) -> list[TrianglePiece]:
    """Large windows, a door, a sign board and an awning on the ground floor."""
    rng = materials.generator
    trim = materials.pick("door")
    door_centre = float(rng.choice([0.9, w - 0.9, w / 2]))
    parts = [flat(front.quads(0.15, 0.0, w - 0.3, ground - 0.35, 0.03), trim, levels=VISIBLE)]
    edges = sorted({0.4, door_centre - 0.65, door_centre + 0.65, w - 0.4})
    for start, end in pairwise(edges):
        if end - start > 0.6 and not (start < door_centre < end):
            glass = int(rng.choice(materials.shop))
            parts.append(
                flat(front.quads(start + 0.08, 0.55, end - start - 0.16, ground - 1.5, 0.05), glass, levels=VISIBLE)
            )
            parts += shop_window(front, start + 0.08, 0.55, (end - start - 0.16, ground - 1.5), materials)
    parts.append(flat(front.quads(door_centre - 0.5, 0.05, 1.0, 2.2, 0.05), materials.shop[0], levels=VISIBLE))
    colour = materials.pick("awning")
    board, board_back = (front.quads(0.2, ground - 0.85, w - 0.4, 0.55, distance) for distance in (0.12, 0.0))
    parts.append(flat(board, colour, levels=VISIBLE))
    parts.append(
        flat(np.stack([board[:, 3], board[:, 2], board_back[:, 2], board_back[:, 3]], axis=1), colour, levels=NEAR)
    )
    parts.append(flat(front.quads(w * 0.3, ground - 0.68, w * 0.4, 0.2, 0.14), materials.sign["white"], levels=NEAR))
    if rng.random() < 0.45:
        awning_top = front.quads(0.3, ground - 0.95, w - 0.6, 0.0, 0.02)
        awning_edge = front.quads(0.3, ground - 1.35, w - 0.6, 0.0, 1.1)
        awning_material = materials.pick("awning")
        awning_faces = np.stack([awning_edge[:, 0], awning_edge[:, 1], awning_top[:, 1], awning_top[:, 0]], axis=1)
        parts += [
            flat(awning_faces, awning_material, levels=VISIBLE),
            flat((awning_faces - [0, 0, 0.02])[:, ::-1], awning_material, levels=VISIBLE),
        ]
        parts.append(flat(front.quads(0.3, ground - 1.55, w - 0.6, 0.2, 1.1), awning_material, levels=NEAR))
    return parts


def _house(size: Size, materials: TownMaterials, *, floors: int = 2) -> list[TrianglePiece]:
    """A detached house: gable or hip roof, windows all round, often a lower wing with a garage."""
    rng, (width, depth) = materials.generator, size
    storey = rng.uniform(2.6, 2.9)
    wing = float(rng.uniform(3.2, 4.2)) if width > 11.0 and rng.random() < 0.75 else 0.0
    side = 1.0 if rng.random() < 0.5 else -1.0
    x = (-width / 2 + (wing if side < 0 else 0.0), width / 2 - (wing if side > 0 else 0.0))
    y, eaves_height = (0.0, depth), storey * floors
    material = materials.pick(str(rng.choice(["plaster", "brick", "boards", "boards"])))
    roof, frame = materials.pick("roof_tiles"), int(rng.choice(materials.frame))
    across = floors == 2 and rng.random() < 0.35
    half_span = 0.5 * ((x[1] - x[0]) if across else depth)
    rise = half_span * rng.uniform(0.55, 0.95)
    hip = half_span * rng.uniform(0.7, 1.0) if rng.random() < 0.35 and not across and x[1] - x[0] > depth else 0.0
    parts = [
        block(x, y, (0.0, eaves_height), material),
        *gable(x, y, eaves_height, rise, roof=roof, wall=material, across=across, eaves=0.5, hip=hip),
    ]
    sides = walls(x, y, (0.0, eaves_height))
    window_size = (rng.uniform(1.1, 1.6), rng.uniform(1.1, 1.35))
    front_length = sides[0].length
    door_centre = float(rng.choice([0.5 * front_length, 0.28 * front_length]))
    parts += door(sides[0], door_centre, materials, size=(1.0, 2.05))
    parts += window_grid(
        sides[0], floors, storey, materials, size=window_size, bay=2.7, frame=frame, skip=np.array([door_centre])
    )
    for wall, bay_width in ((sides[1], 3.6), (sides[2], 2.9), (sides[3], 3.6)):
        parts += window_grid(
            wall, floors, storey, materials, size=(window_size[0] * 0.85, window_size[1]), bay=bay_width, frame=frame
        )
    if across and rise > 2.0:
        parts += windows(
            sides[0],
            np.array([front_length / 2 - 0.4]),
            np.array([eaves_height + 0.35]),
            (0.8, 0.9),
            materials,
            frame=frame,
        )
    # porch over the door
    porch_x = x[0] + door_centre
    if rng.random() < 0.6:
        porch = (porch_x - 1.0, porch_x + 1.0), (-1.2, 0.1)
        parts += gable(*porch, 2.45, 0.6, roof=roof, wall=materials.wood[1], across=True, eaves=0.12)
        posts = np.array([[porch_x - 0.9, -1.1, 0.0], [porch_x + 0.8, -1.1, 0.0]])
        parts.append(box(posts, posts + np.array([0.1, 0.1, 2.4]), materials.wood[1], levels=VISIBLE))
    chimney_x = (x[0] + x[1]) / 2 if across else float(rng.uniform(x[0] + 1.0, x[1] - 1.0))
    parts.append(_chimney(chimney_x, depth / 2, eaves_height + rise, materials))
    if wing:
        wing_x = (width / 2 - wing, width / 2) if side > 0 else (-width / 2, -width / 2 + wing)
        wing_y = (1.2, min(depth, 7.5))
        parts.append(block(wing_x, wing_y, (0.0, 2.6), material))
        parts += gable(wing_x, wing_y, 2.6, 1.2, roof=roof, wall=material, across=True, eaves=0.25)
        parts += door(walls(wing_x, wing_y, (0.0, 2.6))[0], wing / 2, materials, size=(2.5, 2.1))
    return parts


def _bungalow(size: Size, materials: TownMaterials) -> list[TrianglePiece]:
    return _house(size, materials, floors=1)


def _apartment_block(size: Size, materials: TownMaterials) -> list[TrianglePiece]:
    """A block of flats with balconies."""
    rng, (width, depth) = materials.generator, size
    storey, floors = 2.9, int(rng.integers(3, 7))
    roof_height = storey * floors
    x, y = (-width / 2, width / 2), (0.0, depth)
    material = materials.pick(str(rng.choice(["plaster", "plaster", "brick", "cladding"])))
    frame = int(rng.choice(materials.frame))
    parts = [block(x, y, (0.0, roof_height), material)]
    sides = walls(x, y, (0.0, roof_height))
    window_size, bay_width = (rng.uniform(1.1, 1.7), rng.uniform(1.3, 1.6)), rng.uniform(2.6, 3.3)
    parts += door(sides[0], width / 2, materials, size=(1.6, 2.3))
    parts += window_grid(
        sides[0], floors, storey, materials, size=window_size, bay=bay_width, frame=frame, skip=np.array([width / 2])
    )
    parts += window_grid(sides[2], floors, storey, materials, size=window_size, bay=bay_width, frame=frame, sill=False)
    for side_index in (1, 3):
        parts += window_grid(
            sides[side_index], floors, storey, materials, size=(0.9, window_size[1]), bay=4.5, frame=frame, sill=False
        )
    bay_count = int(width // bay_width)
    if bay_count > 2 and rng.random() < 0.75:
        columns = evenly_spaced(width, bay_count, 2.4)[1 :: max(2, bay_count // 3)]
        columns = columns[(columns > 0.2) & (columns < width - 2.6)]
        xx, zz = (grid_values.reshape(-1) for grid_values in np.meshgrid(columns, storey * np.arange(1, floors)))
        parts += balcony(
            sides[0], xx, zz, 2.4, materials, depth=min(1.2, 0.5 * max(0.8, materials.style.setback[0] + 0.8))
        )
    if rng.random() < 0.55:
        parts += flat_roof(x, y, roof_height, materials, coping=materials.palette.shade(material, 0.8))
    else:
        parts += gable(
            x, y, roof_height, 0.25 * depth, roof=materials.pick("roof_tiles"), wall=material, hip=0.3 * depth
        )
    plinth = materials.palette.shade(material, 0.6, "plinth")
    parts.append(flat(sides[0].quads(0.0, 0.0, width, 0.6, 0.03), plinth, levels=VISIBLE))
    return parts


def _office(size: Size, materials: TownMaterials, *, floors: int | None = None) -> list[TrianglePiece]:
    """Offices: bands of glass, a grid of windows or a curtain wall; a glazed ground floor; flat roof."""
    rng, (width, depth) = materials.generator, size
    storey, floor_count = 3.6, floors or int(rng.integers(3, 8))
    roof_height = storey * floor_count + 0.6
    x, y = (-width / 2, width / 2), (0.0, depth)
    material = materials.pick(str(rng.choice(["cladding", "cladding", "plaster", "brick"])))
    parts = [block(x, y, (0.0, roof_height), material)]
    sides, facade_style = walls(x, y, (0.0, roof_height)), str(rng.choice(["bands", "grid", "curtain"]))
    glass, frame = int(rng.choice(materials.glass)), int(rng.choice(materials.frame[1:]))
    for side_index, wall in enumerate(sides):
        sills = storey * np.arange(1, floor_count) + 0.9
        if facade_style == "grid":
            parts += window_grid(
                wall, floor_count, storey, materials, size=(1.5, 1.9), bay=2.4, frame=frame, first=1, sill=False
            )
        else:
            glass_height = 1.9 if facade_style == "bands" else storey - 0.25
            glass_bottoms = sills if facade_style == "bands" else sills - 0.75
            parts.append(
                flat(wall.quads(0.4, glass_bottoms, wall.length - 0.8, glass_height, 0.03), glass, levels=VISIBLE)
            )
            bay_width = 1.5 if facade_style == "curtain" else 3.0
            mullions = np.arange(0.4 + bay_width, wall.length - 0.5, bay_width)
            xx, zz = (grid_values.reshape(-1) for grid_values in np.meshgrid(mullions, glass_bottoms))
            parts.append(flat(wall.quads(xx, zz, 0.08, glass_height, 0.06), frame, levels=NEAR))
        shop_material = int(rng.choice(materials.shop))
        if side_index in (0, 1, 3):
            window_edges = np.arange(0.6, wall.length - 3.0, 3.2)
            parts.append(flat(wall.quads(window_edges, 0.3, 2.7, 2.7, 0.04), shop_material, levels=VISIBLE))
            lit = window_edges[materials.details.random(len(window_edges)) < 0.6]
            room = materials.details.choice(materials.room, len(lit))
            parts.append(flat(wall.quads(lit + 0.25, 1.1, 2.2, 1.6, 0.045), room, levels=NEAR))
    parts.append(flat(sides[0].quads(width / 2 - 1.4, 0.0, 2.8, 2.7, 0.08), materials.glass[0], levels=VISIBLE))
    parts.append(box((-2.0, -1.4, 2.9), (2.0, 0.0, 3.15), materials.metal, levels=VISIBLE, base=True))
    if rng.random() < 0.7:
        sign_material = materials.pick("awning")
        parts.append(
            flat(
                sides[0].quads(width * 0.1, roof_height - 1.0, min(6.0, width * 0.3), 0.8, 0.1),
                sign_material,
                levels=VISIBLE,
            )
        )
    return parts + flat_roof(x, y, roof_height, materials, coping=materials.palette.shade(material, 0.8), plant=4)


def _tower(size: Size, materials: TownMaterials) -> list[TrianglePiece]:
    return _office(size, materials, floors=int(materials.generator.integers(9, 15)))


def _hall(size: Size, materials: TownMaterials) -> list[TrianglePiece]:
    """A warehouse: metal sheet, roller doors, a strip of windows, a low roof."""
    rng, (width, depth) = materials.generator, size
    eaves_height = rng.uniform(5.5, 8.5)
    x, y = (-width / 2, width / 2), (0.0, depth)
    material, frame = materials.pick("sheet"), materials.frame[2]
    parts = [block(x, y, (0.0, eaves_height), material)]
    parts += gable(
        x,
        y,
        eaves_height,
        0.07 * depth,
        roof=materials.palette.shade(materials.flat_roof, 1.8, "sheet"),
        wall=material,
        eaves=0.2,
    )
    sides = walls(x, y, (0.0, eaves_height))
    opening_count = int(rng.integers(1, 4))
    left_edges = evenly_spaced(width, opening_count, 4.0, margin=0.1 * width)
    parts.append(flat(sides[0].quads(left_edges, 0.0, 4.0, 4.2, 0.04), materials.pick("cladding"), levels=VISIBLE))
    grooves = sides[0].quads(
        np.repeat(left_edges, 9), np.tile(0.4 + 0.42 * np.arange(9), opening_count), 4.0, 0.03, 0.05
    )
    parts.append(flat(grooves, frame, levels=NEAR))
    parts += door(sides[0], width - 1.5, materials)
    for wall in sides:
        opening_count = max(1, int(wall.length // 6))
        left_edges = evenly_spaced(wall.length, opening_count, 2.6)
        parts += windows(
            wall, left_edges, np.full(opening_count, eaves_height - 1.3), (2.6, 0.7), materials, frame=frame, sill=False
        )
        parts.append(flat(wall.quads(0.0, 0.0, wall.length, 0.7, 0.02), materials.stone[1], levels=VISIBLE))
    sign_material = materials.pick("awning")
    parts.append(
        flat(sides[0].quads(0.35 * width, eaves_height - 2.6, 0.3 * width, 1.1, 0.08), sign_material, levels=VISIBLE)
    )
    return parts


def _shed(size: Size, materials: TownMaterials) -> list[TrianglePiece]:
    """A garden shed or garage."""
    (width, depth), eaves_height = size, materials.generator.uniform(2.1, 2.7)
    x, y = (-width / 2, width / 2), (0.0, depth)
    material = int(materials.generator.choice([*materials.wood, materials.pick("boards")]))
    roof = gable(x, y, eaves_height, 0.8, roof=materials.pick("roof_tiles"), wall=material, eaves=0.2)
    parts = [block(x, y, (0.0, eaves_height), material), *roof]
    return parts + door(walls(x, y, (0.0, eaves_height))[0], width / 2, materials, size=(min(1.6, width - 0.8), 1.9))


def _chapel(size: Size, materials: TownMaterials) -> list[TrianglePiece]:
    """A church: a nave with a steep roof and a tower with a spire at the front."""
    (width, depth), stone = size, int(materials.generator.choice(materials.stone))
    x, y, eaves_height, roof = (-width / 2, width / 2), (4.0, depth), 8.0, materials.pick("roof_tiles")
    parts = [
        block(x, y, (0.0, eaves_height), stone),
        *gable(x, y, eaves_height, 0.55 * width, roof=roof, wall=stone, across=True, eaves=0.3),
    ]
    tower, tower_height = ((-2.6, 2.6), (0.0, 5.2)), float(materials.generator.uniform(16.0, 20.0))
    parts.append(block(*tower, (0.0, tower_height), stone))
    eaves_corners = np.array([[-2.9, -0.3], [2.9, -0.3], [2.9, 5.5], [-2.9, 5.5]])
    for start, end in zip(eaves_corners, np.roll(eaves_corners, -1, axis=0), strict=True):
        parts.append(
            flat(np.array([[[*start, tower_height], [*end, tower_height], [0.0, 2.6, tower_height + 11.0]]]), roof)
        )
    for wall in walls(*tower, (0.0, tower_height)):
        window_corners = np.array([2.0, 2.0]), np.array([7.0, tower_height - 3.6])
        parts += windows(wall, *window_corners, (1.2, 2.4), materials, frame=materials.stone[0], blinds=0.0)
    for wall in walls(x, y, (0.0, eaves_height))[1::2]:
        count = int(wall.length // 3.5)
        window_corners = evenly_spaced(wall.length, count, 1.1), np.full(count, 2.2)
        parts += windows(wall, *window_corners, (1.1, 3.6), materials, frame=materials.stone[0], blinds=0.0)
    return parts + door(walls(*tower, (0.0, tower_height))[0], 2.6, materials, size=(1.8, 2.9))


KINDS: Mapping[str, Callable[[Size, TownMaterials], list[TrianglePiece]]] = {
    "terrace": _terrace,
    "shop": _shop,
    "house": _house,
    "bungalow": _bungalow,
    "flats": _apartment_block,
    "office": _office,
    "tower": _tower,
    "hall": _hall,
    "shed": _shed,
    "chapel": _chapel,
}
SIZES: Mapping[str, tuple[Size, Size]] = {  # smallest and largest (front, depth), m
    "terrace": ((5.2, 9.0), (8.5, 12.0)),
    "shop": ((6.0, 9.0), (10.0, 13.0)),
    "house": ((8.5, 7.5), (14.5, 10.0)),
    "bungalow": ((11.0, 8.0), (16.0, 10.0)),
    "flats": ((15.0, 10.0), (26.0, 13.0)),
    "office": ((16.0, 13.0), (32.0, 20.0)),
    "tower": ((18.0, 16.0), (24.0, 20.0)),
    "hall": ((20.0, 16.0), (38.0, 26.0)),
    "shed": ((2.6, 2.2), (4.2, 3.2)),
    "chapel": ((10.0, 24.0), (12.0, 28.0)),
}
