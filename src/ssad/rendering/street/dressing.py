"""What stands beside a road: lamps, signals, signs, street trees, benches and bins; and the green of open ground."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ssad.core.lane_graph import LaneGraph
from ssad.rendering.street.free_ground import CELL, FreeGround, Side
from ssad.rendering.street.furniture import bench, bollard, lamp, litter_bin, planter, shelter, sign, signal_mast
from ssad.rendering.street.model import NEAR
from ssad.rendering.street.palette import Look
from ssad.rendering.street.paving import EARTH, KERB
from ssad.rendering.street.plants import bush, tree
from ssad.rendering.street.triangles import TriangleBuilder, flat

BIN_ROOM = 0.45  # m between a kerb and the middle of a thing beside it


@dataclass
class Masts:
    """Lamps (x, y, z, heading) and signal heads (the same; signal; first face and number of faces of each lens)."""

    lamps: list[tuple[float, float, float, float]] = field(default_factory=list)
    heads: list[tuple[float, float, float, float]] = field(default_factory=list)
    signal: list[int] = field(default_factory=list)
    lens: list[list[tuple[int, int]]] = field(default_factory=list)


def light_streets(soup: TriangleBuilder, site: FreeGround, look: Look, sides: list[Side], masts: Masts) -> None:
    """Lamps along one side of each street, by turns, at the kerb."""
    piece, (reach, height) = lamp(look)
    poses = []
    for number, side in enumerate(sides):
        count = max(1, round(side.length / look.style.lamp))
        shift = 0.25 if number % 2 else 0.75
        for k in range(count):
            x, y, yaw = side.pose((k + shift) * side.length / count, _kerb(side))
            if not site.clear((x, y), crossing=0.8):
                continue
            z = KERB if side.kerb else 0.0
            poses.append((x, y, z, yaw + np.pi / 2))
            masts.lamps.append((x - reach * np.sin(yaw), y + reach * np.cos(yaw), height + z, yaw + np.pi / 2))
            site.take([(x, y)])
    soup.place(piece, poses)


def _kerb(side: Side) -> float:
    """Offset (m, outwards) of things beside the kerb; without a sidewalk, on the verge."""
    return BIN_ROOM - side.kerb if side.kerb else 0.9


def signals(soup: TriangleBuilder, graph: LaneGraph, site: FreeGround, look: Look, masts: Masts) -> None:
    """Masts at the signals of the map, turned to their approach; give-way signs where a junction has none.

    The stop and yield signs of the map are bodies of their own: only their ground is taken here.
    """
    for x, y in graph.sign_xy.astype(float).tolist():
        site.take([(x + u, y + v) for u in (-CELL, 0.0, CELL) for v in (-CELL, 0.0, CELL)])
    ruled = np.isin(graph.stop_lane, graph.rule_lane)
    signed = set(graph.signal_junction[graph.stop_signal[ruled]].tolist())
    posts = {reach: signal_mast(look, reach) for reach in (0.0, 4.2)}
    lanes = np.bincount(graph.stop_signal, minlength=len(graph.signal_xy))
    give_way = sign("give_way", look)
    for k, (x, y) in enumerate(graph.signal_xy.astype(float).tolist()):
        yaw = float(graph.signal_yaw[k]) + np.pi
        # a little further from the road where the map is too close to it
        spot = _moved(site, (x, y), float(graph.signal_yaw[k]))
        if spot is None:
            continue
        if graph.signal_virtual[k]:
            # lower phases are the main road
            if graph.signal_phase[k] > 0 and graph.signal_junction[k] not in signed:
                soup.place(give_way, [(*spot, KERB, yaw)])
                site.take([spot])
            continue
        post = posts[4.2 if lanes[k] > 1 else 0.0]
        first = soup.place(post.piece, [(*spot, KERB, yaw)])
        site.take([spot])
        for (side, up), lens in zip(post.heads, post.lens, strict=True):
            c, s = np.cos(yaw), np.sin(yaw)
            masts.heads.append((spot[0] + 0.25 * c - side * s, spot[1] + 0.25 * s + side * c, KERB + up, yaw))
            masts.signal.append(k)
            masts.lens.append([(first + at, first + at + post.sides) for at in lens])


def _moved(site: FreeGround, xy: tuple[float, float], yaw: float) -> tuple[float, float] | None:
    """The place, or the first one up to 2 m to the right of the traffic that is clear of lanes and crosswalks."""
    for away in (0.0, 0.25, 0.5, 1.0, 1.5, 2.0):
        for back in (0.0, 0.4, 0.8):
            x = xy[0] + away * np.sin(yaw) + back * np.cos(yaw)
            y = xy[1] - away * np.cos(yaw) + back * np.sin(yaw)
            if site.clear((x, y), size=0.4, crossing=0.6):
                return float(x), float(y)
    return None


def furnish(soup: TriangleBuilder, site: FreeGround, look: Look, sides: list[Side]) -> None:
    """Signs, street trees, benches, bins, bollards and shelters on the sidewalks."""
    rng, style = look.generator, look.style
    stock = {"bench": bench(look), "bin": litter_bin(look), "bollard": bollard(look), "shelter": shelter(look)}
    stock |= {name: sign(name, look) for name in ("limit", "crossing", "parking")}
    trough, plant = planter(look), bush(look)
    trees = [tree(kind, look) for kind in ("round", "birch", "round")]
    for side in sides:
        z = KERB if side.kerb else 0.02
        if style.rows:
            kind = trees[int(rng.integers(len(trees)))]
            for k in range(int(side.length / style.rows)):
                x, y, yaw = side.pose((k + 0.5) * style.rows + float(rng.normal(0, 0.8)), 1.1)
                if site.free((x, y), away=0.6) and rng.random() < 0.85:
                    size = rng.uniform(0.7, 1.0) * np.ones(3)
                    soup.place(kind, [(x, y, EARTH, rng.uniform(0, 6.28))], scale=size[None])
                    site.take([(x + u, y + v) for u in (-0.8, 0.0, 0.8) for v in (-0.8, 0.0, 0.8)])
        signs: list[tuple[str, float]] = [("limit", 8.0)] if side.length > 60.0 and rng.random() < 0.4 else []
        if side.frontage:
            signs += [("crossing", side.length - 7.0)] if rng.random() < 0.5 else []
            signs += [("parking", 0.5 * side.length)] if rng.random() < 0.12 else []
        for name, s in signs:
            x, y, yaw = side.pose(s, _kerb(side))
            if site.clear((x, y), size=0.5, crossing=0.6):
                soup.place(stock[name], [(x, y, z, yaw + np.pi)])
                site.take([(x, y)])
        if not side.kerb:
            continue
        things = rng.poisson(style.furniture * side.length / 28.0)
        for name in rng.choice(["bench", "bin", "bin", "bollard", "planter"], things):
            at_back = name in ("bench", "planter")
            x, y, yaw = side.pose(
                float(rng.uniform(3.0, max(3.1, side.length - 3.0))), -0.45 if at_back else _kerb(side)
            )
            if side.kerb < 1.7 or not site.clear((x, y), size=0.9 if at_back else 0.25):
                continue
            if name == "planter":
                soup.place(trough, [(x, y, z, yaw)])
                soup.place(plant, [(x, y, z + 0.5, yaw)], scale=np.array([0.55]))
            else:
                soup.place(stock[str(name)], [(x, y, z, yaw + np.pi / 2)])
            site.take([(x + 0.8 * u * np.cos(yaw), y + 0.8 * u * np.sin(yaw)) for u in (-1, 0, 1)])
        if side.kerb > 1.9 and side.length > 40.0 and rng.random() < 0.16 * style.furniture:
            x, y, yaw = side.pose(float(rng.uniform(14.0, side.length - 14.0)), -0.62)
            if site.clear([(x + u * np.cos(yaw), y + u * np.sin(yaw)) for u in (-2, 0, 2)], size=0.7):
                soup.place(stock["shelter"], [(x, y, z, yaw + np.pi / 2)])
                site.take([(x + u * np.cos(yaw), y + u * np.sin(yaw)) for u in np.arange(-2, 2.1, 0.5)])


def plant(
    soup: TriangleBuilder, site: FreeGround, look: Look, parks: list[tuple[tuple[float, float, float], float, float]]
) -> None:
    """Trees and bushes on open ground, denser in parks and around the town; patches of dry grass and soil."""
    rng, style = look.generator, look.style
    stock = [tree(kind, look) for kind in style.tree_kinds for _ in range(3)]
    shrubs = [bush(look) for _ in range(5)]
    open_ground = float((site.ground.paved > 1.0).sum())
    wanted = int(open_ground / 1000.0 * style.trees)
    low, high = site.graph.xy.min(axis=0) - 8.0, site.graph.xy.max(axis=0) + 8.0
    rows: dict[int, list[tuple[float, ...]]] = {}
    scale: dict[int, list[float]] = {}
    middle = [pose for pose, _, _ in parks]
    for k in range(6 * wanted):
        if sum(len(v) for v in rows.values()) >= wanted:
            break
        if middle and k < 5 * len(middle):
            p = np.array(middle[k % len(middle)][:2]) + rng.normal(0.0, 5.0, 2)
        else:
            p = rng.uniform(site.low + 4.0, site.high - 4.0)
            inside = bool(((p > low) & (p < high)).all())
            if inside and rng.random() < 0.25:
                continue
        ring = p + 1.6 * np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)])
        if not site.free(ring, away=1.4):
            continue
        site.take(ring)
        which = int(rng.integers(len(stock)))
        rows.setdefault(which, []).append((*p, EARTH - 0.03, rng.uniform(0.0, 2.0 * np.pi)))
        scale.setdefault(which, []).append(float(rng.uniform(0.75, 1.25)))
    for which, poses in sorted(rows.items()):
        soup.place(stock[which], poses, scale=np.array(scale[which]))
    for _ in range(int(1.2 * wanted)):
        p = rng.uniform(site.low + 4.0, site.high - 4.0)
        if site.free(p + 0.7 * np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)]), away=1.0):
            soup.place(
                shrubs[int(rng.integers(len(shrubs)))],
                [(*p, EARTH - 0.03, rng.uniform(0.0, 6.28))],
                scale=np.array([rng.uniform(0.7, 1.4)]),
            )
            site.take([p])
    angle = np.arange(9) * 2.0 * np.pi / 9
    for _ in range(int(0.8 * wanted) + 40):
        p = rng.uniform(site.low + 8.0, site.high - 8.0)
        size = rng.uniform(0.8, 4.0)
        ring = p + size * rng.uniform(0.6, 1.3, (9, 1)) * np.stack([np.cos(angle), np.sin(angle)], axis=1) * [1.4, 1.0]
        if site.free(ring, away=4.5):
            material = look.lawn if style.old else look.dry if rng.random() < 0.6 else look.soil
            corners = np.column_stack([ring, np.full(9, EARTH + 0.006)])[None]
            soup.add(flat(corners, material, levels=NEAR), p)
