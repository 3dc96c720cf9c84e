"""Objects beside a road: lamps, signals, signs, street trees, benches and bins; and the green of open ground."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import product

import numpy as np

from ssad.core.lane_graph import LaneGraph
from ssad.core.types import LaneType
from ssad.rendering.street.free_ground import CELL, FreeGround, Side
from ssad.rendering.street.furniture import bench, bollard, lamp, litter_bin, planter, shelter, sign, signal_mast
from ssad.rendering.street.model import NEAR
from ssad.rendering.street.palette import TownMaterials
from ssad.rendering.street.paving import BELOW, EARTH, KERB
from ssad.rendering.street.plants import bush, tree, tuft
from ssad.rendering.street.triangles import TriangleBuilder, flat

BIN_ROOM = 0.45  # m between a kerb and the middle of a thing beside it
TUFT_SPACING = 0.8  # m between tufts of grass along a verge
MAX_TUFTS = 4000  # of a town
LIMITS = (10, 140)  # km/h, speed limits that signs show
LIMIT_STATIONS = (12.0, 40.0, 2.0)  # m from the start of a road to its speed-limit sign: first, end, step
LIMIT_END = 18.0  # m before the end of a road that stay without speed-limit sign
REPEAT = 120.0  # m from one speed-limit sign of a road to the next
SIGHT = 6.0  # m before a speed-limit sign on which nothing stands


@dataclass
class Masts:
    """Lamps (x, y, z, heading), and signal heads: pose, signal, first face and end of the faces of each lens."""

    lamps: list[tuple[float, float, float, float]] = field(default_factory=list)
    heads: list[tuple[float, float, float, float]] = field(default_factory=list)
    signal: list[int] = field(default_factory=list)
    lens: list[list[tuple[int, int]]] = field(default_factory=list)


def place_street_lamps(
    triangles: TriangleBuilder, ground: FreeGround, materials: TownMaterials, sides: list[Side], masts: Masts
) -> None:
    """Lamps along one side of each street, by turns, at the kerb."""
    lamp_piece, (reach, height) = lamp(materials)
    poses = []
    for side_index, side in enumerate(sides):
        count = max(1, round(side.length / materials.style.lamp))
        shift = 0.25 if side_index % 2 else 0.75
        for lamp_index in range(count):
            x, y, yaw = side.pose((lamp_index + shift) * side.length / count, _kerb_offset(side))
            if not ground.is_clear((x, y), crossing=0.8):
                continue
            z = KERB if side.kerb else 0.0
            poses.append((x, y, z, yaw + np.pi / 2))
            masts.lamps.append((x - reach * np.sin(yaw), y + reach * np.cos(yaw), height + z, yaw + np.pi / 2))
            ground.occupy([(x, y)])
    triangles.place(lamp_piece, poses)


def _kerb_offset(side: Side) -> float:
    """Return the offset (m, outwards) of objects beside the kerb; without a sidewalk, on the verge."""
    return BIN_ROOM - side.kerb if side.kerb else 0.9


def place_signal_masts(
    triangles: TriangleBuilder, graph: LaneGraph, ground: FreeGround, materials: TownMaterials, masts: Masts
) -> None:
    """Masts at the signals of the map, turned to their approach; give-way signs where a junction has none.

    The stop and yield signs of the map are bodies of their own: only their ground is taken here.
    """
    for x, y in graph.sign_xy.astype(float).tolist():
        ground.occupy([(x + dx, y + dy) for dx in (-CELL, 0.0, CELL) for dy in (-CELL, 0.0, CELL)])
    has_sign = np.isin(graph.stop_lane, graph.rule_lane)
    signed_junctions = set(graph.signal_junction[graph.stop_signal[has_sign]].tolist())
    masts_by_reach = {reach: signal_mast(materials, reach) for reach in (0.0, 4.2)}
    lane_counts = np.bincount(graph.stop_signal, minlength=len(graph.signal_xy))
    give_way = sign("give_way", materials)
    for signal_index, (x, y) in enumerate(graph.signal_xy.astype(float).tolist()):
        yaw = float(graph.signal_yaw[signal_index]) + np.pi
        # Some signals of the map stand too close to the road: move them a little.
        position = _clear_position(ground, (x, y), float(graph.signal_yaw[signal_index]))
        if position is None:
            continue
        if graph.signal_virtual[signal_index]:
            # The lower phases belong to the main road, which has no give-way sign.
            if graph.signal_phase[signal_index] > 0 and graph.signal_junction[signal_index] not in signed_junctions:
                triangles.place(give_way, [(*position, KERB, yaw)])
                ground.occupy([position])
            continue
        mast = masts_by_reach[4.2 if lane_counts[signal_index] > 1 else 0.0]
        first_face = triangles.place(mast.piece, [(*position, KERB, yaw)])
        ground.occupy([position])
        for (head_offset, head_height), first_faces in zip(mast.heads, mast.lens, strict=True):
            cosine, sine = np.cos(yaw), np.sin(yaw)
            masts.heads.append(
                (
                    position[0] + 0.25 * cosine - head_offset * sine,
                    position[1] + 0.25 * sine + head_offset * cosine,
                    KERB + head_height,
                    yaw,
                )
            )
            masts.signal.append(signal_index)
            masts.lens.append(
                [(first_face + lens_face, first_face + lens_face + mast.sides) for lens_face in first_faces]
            )


def _clear_position(ground: FreeGround, xy: tuple[float, float], yaw: float) -> tuple[float, float] | None:
    """Return the position, or the first one up to 2 m to the right of the traffic that is clear; None if none is."""
    for outward in (0.0, 0.25, 0.5, 1.0, 1.5, 2.0):
        for forward in (0.0, 0.4, 0.8):
            x = xy[0] + outward * np.sin(yaw) + forward * np.cos(yaw)
            y = xy[1] - outward * np.cos(yaw) + forward * np.sin(yaw)
            if ground.is_clear((x, y), size=0.4, crossing=0.6):
                return float(x), float(y)
    return None


def place_limit_signs(
    graph: LaneGraph, ground: FreeGround, street_sides: list[Side]
) -> list[tuple[float, float, float, float, float]]:
    """Place speed-limit signs after junctions, where a limit changes, and again every `REPEAT` m; take their ground.

    The signs are bodies of their own. They stand at the right-hand edge, with a clear view over `SIGHT` m.

    Returns:
        x, y, yaw of the traffic, z of the foot, and the limit rounded to 10 km/h of each sign.
    """
    signs: list[tuple[float, float, float, float, float]] = []
    for side in [] if graph.left_hand[0] else street_sides:
        lane = side.edge.lane
        while lane >= 0 and graph.kind[lane] != LaneType.DRIVING:
            left_lane = int(graph.left[lane])
            lane = left_lane if left_lane >= 0 and graph.is_same_direction(lane, left_lane) else -1
        if lane < 0:
            continue
        limit = _sign_limit(graph, lane)
        before = graph.predecessors(lane).tolist()
        if not LIMITS[0] <= limit <= LIMITS[1]:
            continue
        is_announced = any(graph.junction[other] >= 0 or _sign_limit(graph, other) != limit for other in before)
        starts = [*([0.0] if is_announced else []), *np.arange(REPEAT, side.length, REPEAT).tolist()]
        for start in starts:
            for station, outward in product(np.arange(*LIMIT_STATIONS).tolist(), (0.1, 0.3, 0.5, 0.7)):
                if start + station > side.length - LIMIT_END:
                    continue
                x, y, yaw = side.pose(start + station, _kerb_offset(side) + outward)
                view = [(x - along * np.cos(yaw), y - along * np.sin(yaw)) for along in np.arange(0.0, SIGHT, CELL)]
                if ground.is_clear((x, y), size=0.1) and not ground.is_occupied(view):
                    signs.append((x, y, yaw, KERB if side.kerb else 0.0, float(limit)))
                    ground.occupy(view)
                    break
    return signs


def _sign_limit(graph: LaneGraph, lane: int) -> int:
    """Return the speed limit of a lane as on a sign: rounded to 10 km/h."""
    return 10 * round(0.36 * float(graph.speed_limit[lane]))


def place_furniture(
    triangles: TriangleBuilder, ground: FreeGround, materials: TownMaterials, sides: list[Side]
) -> None:
    """Signs, street trees, benches, bins, bollards and shelters on the sidewalks."""
    rng, style = materials.generator, materials.style
    stock = {
        "bench": bench(materials),
        "bin": litter_bin(materials),
        "bollard": bollard(materials),
        "shelter": shelter(materials),
    }
    stock |= {name: sign(name, materials) for name in ("crossing", "parking")}
    planter_piece, planter_bush = planter(materials), bush(materials)
    trees = [tree(tree_piece, materials) for tree_piece in ("round", "birch", "round")]
    for side in sides:
        z = KERB if side.kerb else 0.02
        if style.rows:
            tree_piece = trees[int(rng.integers(len(trees)))]
            for tree_index in range(int(side.length / style.rows)):
                x, y, yaw = side.pose((tree_index + 0.5) * style.rows + float(rng.normal(0, 0.8)), 1.1)
                if ground.is_free((x, y), distance=0.6) and rng.random() < 0.85:
                    scale = rng.uniform(0.7, 1.0) * np.ones(3)
                    triangles.place(tree_piece, [(x, y, EARTH, rng.uniform(0, 6.28))], scale=scale[None])
                    ground.occupy(
                        [
                            (x + offset, y + side_offset)
                            for offset in (-0.8, 0.0, 0.8)
                            for side_offset in (-0.8, 0.0, 0.8)
                        ]
                    )
        signs: list[tuple[str, float]] = []
        if side.frontage:
            signs += [("crossing", side.length - 7.0)] if rng.random() < 0.5 else []
            signs += [("parking", 0.5 * side.length)] if rng.random() < 0.12 else []
        for name, station in signs:
            x, y, yaw = side.pose(station, _kerb_offset(side))
            if ground.is_clear((x, y), size=0.5, crossing=0.6):
                triangles.place(stock[name], [(x, y, z, yaw + np.pi)])
                ground.occupy([(x, y)])
        if not side.kerb:
            continue
        # 28 m is the mean distance between pieces of furniture at density 1.
        object_count = rng.poisson(style.furniture * side.length / 28.0)
        for name in rng.choice(["bench", "bin", "bin", "bollard", "planter"], object_count):
            at_back = name in ("bench", "planter")
            x, y, yaw = side.pose(
                float(rng.uniform(3.0, max(3.1, side.length - 3.0))), -0.45 if at_back else _kerb_offset(side)
            )
            if side.kerb < 1.7 or not ground.is_clear((x, y), size=0.9 if at_back else 0.25):
                continue
            if name == "planter":
                triangles.place(planter_piece, [(x, y, z, yaw)])
                triangles.place(planter_bush, [(x, y, z + 0.5, yaw)], scale=np.array([0.55]))
            else:
                triangles.place(stock[str(name)], [(x, y, z, yaw + np.pi / 2)])
            ground.occupy([(x + 0.8 * offset * np.cos(yaw), y + 0.8 * offset * np.sin(yaw)) for offset in (-1, 0, 1)])
        if side.kerb > 1.9 and side.length > 40.0 and rng.random() < 0.16 * style.furniture:
            x, y, yaw = side.pose(float(rng.uniform(14.0, side.length - 14.0)), -0.62)
            if ground.is_clear(
                [(x + offset * np.cos(yaw), y + offset * np.sin(yaw)) for offset in (-2, 0, 2)], size=0.7
            ):
                triangles.place(stock["shelter"], [(x, y, z, yaw + np.pi / 2)])
                ground.occupy(
                    [(x + offset * np.cos(yaw), y + offset * np.sin(yaw)) for offset in np.arange(-2, 2.1, 0.5)]
                )


def plant_trees(
    triangles: TriangleBuilder,
    ground: FreeGround,
    materials: TownMaterials,
    parks: list[tuple[tuple[float, float, float], float, float]],
) -> None:
    """Trees and bushes on open ground, denser in parks and around the town; patches of dry grass and soil."""
    rng, style = materials.generator, materials.style
    tree_pieces = [tree(kind, materials) for kind in style.tree_kinds for _ in range(3)]
    shrubs = [bush(materials) for _ in range(5)]
    open_ground = float((ground.ground.paved > 1.0).sum())
    tree_count = int(open_ground / 1000.0 * style.trees)
    lower, upper = ground.graph.xy.min(axis=0) - 8.0, ground.graph.xy.max(axis=0) + 8.0
    tree_poses: dict[int, list[tuple[float, ...]]] = {}
    tree_scales: dict[int, list[float]] = {}
    park_centres = [pose for pose, _, _ in parks]
    # Rejection sampling: six attempts per tree bound the time in dense towns.
    for attempt in range(6 * tree_count):
        if sum(len(poses_of_tree) for poses_of_tree in tree_poses.values()) >= tree_count:
            break
        if park_centres and attempt < 5 * len(park_centres):
            point = np.array(park_centres[attempt % len(park_centres)][:2]) + rng.normal(0.0, 5.0, 2)
        else:
            point = rng.uniform(ground.low + 4.0, ground.high - 4.0)
            is_inside = bool(((point > lower) & (point < upper)).all())
            if is_inside and rng.random() < 0.25:
                continue
        outline = point + 1.6 * np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)])
        if not ground.is_free(outline, distance=1.4):
            continue
        ground.occupy(outline)
        tree_index = int(rng.integers(len(tree_pieces)))
        tree_poses.setdefault(tree_index, []).append((*point, EARTH - 0.03, rng.uniform(0.0, 2.0 * np.pi)))
        tree_scales.setdefault(tree_index, []).append(float(rng.uniform(0.75, 1.25)))
    for tree_index, poses in sorted(tree_poses.items()):
        triangles.place(tree_pieces[tree_index], poses, scale=np.array(tree_scales[tree_index]))
    for _ in range(int(1.2 * tree_count)):
        point = rng.uniform(ground.low + 4.0, ground.high - 4.0)
        if ground.is_free(point + 0.7 * np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)]), distance=1.0):
            triangles.place(
                shrubs[int(rng.integers(len(shrubs)))],
                [(*point, EARTH - 0.03, rng.uniform(0.0, 6.28))],
                scale=np.array([rng.uniform(0.7, 1.4)]),
            )
            ground.occupy([point])
    angles = np.arange(9) * 2.0 * np.pi / 9
    for _ in range(int(0.8 * tree_count) + 40):
        point = rng.uniform(ground.low + 8.0, ground.high - 8.0)
        size = rng.uniform(0.8, 4.0)
        outline = point + size * rng.uniform(0.6, 1.3, (9, 1)) * np.stack([np.cos(angles), np.sin(angles)], axis=1) * [
            1.4,
            1.0,
        ]
        if ground.is_free(outline, distance=4.5):
            material = materials.lawn if style.old else materials.dry if rng.random() < 0.6 else materials.soil
            corners = np.column_stack([outline, np.full(9, EARTH + 0.006)])[None]
            triangles.add(flat(corners, material, levels=NEAR), point)


def plant_grass(triangles: TriangleBuilder, ground: FreeGround, materials: TownMaterials, sides: list[Side]) -> None:
    """Tufts of grass along the edges of lawns: behind sidewalks, and beside roads without one."""
    if materials.style.old:
        return
    rng = materials.details
    total = sum(side.length for side in sides)
    spacing = max(TUFT_SPACING, total / MAX_TUFTS)
    poses = []
    for side in sides:
        for station in np.arange(0.5 * spacing, side.length, spacing).tolist():
            offset = float(rng.uniform(0.06, 0.5)) if side.kerb else float(rng.uniform(0.5, 1.6))
            x, y, _ = side.pose(station + float(rng.normal(0.0, 0.3)), offset)
            turn, z = float(rng.uniform(0.0, 2.0 * np.pi)), EARTH - 0.02 if side.kerb else BELOW
            if ground.is_free((x, y), distance=0.02):
                poses.append((x, y, z, turn))
    tufts = [tuft(materials) for _ in range(6)]
    kinds = rng.integers(0, len(tufts), len(poses))
    sizes = rng.uniform(0.6, 1.3, len(poses))
    for index, piece in enumerate(tufts):
        chosen = np.flatnonzero(kinds == index)
        triangles.place(piece, np.array(poses).reshape(-1, 4)[chosen], scale=sizes[chosen])
