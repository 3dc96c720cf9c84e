"""What is painted on a road, and what wears it: lines, stop lines, crosswalks, arrows, patches, manholes."""

from __future__ import annotations

import numpy as np

from ssad.core.lane_graph import LaneGraph, Marking, SignKind
from ssad.core.types import LaneType
from ssad.rendering.meshes.mesh import F64
from ssad.rendering.street.free_ground import place, polygon_distance
from ssad.rendering.street.model import MID, NEAR
from ssad.rendering.street.palette import Look
from ssad.rendering.street.paving import Edge, lane_edge, ribbon
from ssad.rendering.street.triangles import TriangleBuilder, flat

PAINT = 0.008  # m above the road
WEAR = 0.004  # m above the road: patches lie under paint
LINE = 0.12  # m
DASH, SPACE = 3.0, 6.0  # m
STOP = 0.4  # m
BAR = 0.5  # m, bars of a crosswalk and the gaps between them
VISIBLE = NEAR | MID
_ARROW = {  # polygons of arrows along x from the tail; y to the left
    "ahead": [[(0.0, -0.08), (2.6, -0.08), (2.6, 0.08), (0.0, 0.08)], [(2.6, -0.35), (4.0, 0.0), (2.6, 0.35)]],
    "left": [
        [(0.0, -0.08), (1.9, -0.08), (1.9, 0.08), (0.0, 0.08)],
        [(1.9, -0.08), (2.45, 0.28), (2.3, 0.4), (1.9, 0.08)],
        [(1.95, 0.62), (2.75, 0.05), (2.9, 0.85)],
    ],
}


def paint(soup: TriangleBuilder, graph: LaneGraph, look: Look) -> None:
    """All markings of the town, and wear."""
    driving = np.flatnonzero((graph.kind == LaneType.DRIVING) & (graph.junction < 0)).tolist()
    for lane in driving:
        _lines(soup, graph, lane, look)
        _worn(soup, graph, lane, look)
    stopped = set(graph.rule_lane[graph.sign_kind[graph.rule_sign] == SignKind.STOP].tolist())
    ruled = set(graph.rule_lane.tolist())
    for signal, lane, s in zip(
        graph.stop_signal.tolist(), graph.stop_lane.tolist(), graph.stop_s.tolist(), strict=True
    ):
        if graph.signal_virtual[signal] and lane not in ruled and graph.divided(lane):
            continue  # the ring of a roundabout, a motorway
        if graph.kind[lane] == LaneType.DRIVING:
            give_way = bool(graph.signal_virtual[signal]) and lane not in stopped
            _stop(soup, graph, lane, s, give_way=give_way, look=look)
    for k in range(len(graph.crosswalk_offset) - 1):
        _crosswalk(soup, graph.crosswalk(k).astype(np.float64), look)


def _lines(soup: TriangleBuilder, graph: LaneGraph, lane: int, look: Look) -> None:
    """Lines at both sides of a lane; a line between two lanes is painted by the lower of them."""
    for share, marking, beside in (
        (1.0, int(graph.left_marking[lane]), int(graph.left[lane])),
        (0.0, int(graph.right_marking[lane]), int(graph.right[lane])),
    ):
        other = beside >= 0 and graph.kind[beside] == LaneType.DRIVING
        if marking in (Marking.NONE, Marking.CURB) or (other and beside < lane):
            continue
        oncoming = other and not graph.same_direction(lane, beside)
        material = look.centre if oncoming else look.white
        edge = _between_crosswalks(graph, lane_edge(graph, lane, share))
        if edge is None:
            continue
        # lines between a lane and the shoulder lie within the lane
        inset = 0.0 if other else (0.06 + LINE / 2) * (1.0 if share == 0.0 else -1.0)
        if marking == Marking.BROKEN:
            _dashes(soup, edge, inset, material)
        elif marking == Marking.DOUBLE:
            for aside in (-LINE, LINE):
                _strip(soup, edge, aside, material)
        else:
            _strip(soup, edge, inset, material)


def _between_crosswalks(graph: LaneGraph, edge: Edge) -> Edge | None:
    """The part of a line between the crosswalks at its ends, None if nothing is left."""
    step = np.arange(0.0, float(edge.s[-1]), 0.25)
    at = np.stack([np.interp(step, edge.s, edge.xy[:, k]) for k in range(2)], axis=1)
    low, high, end = 0.0, float(edge.s[-1]), float(edge.s[-1])
    for k in range(len(graph.crosswalk_offset) - 1):
        area = graph.crosswalk(k).astype(np.float64)
        middle = area.mean(axis=0)
        if min(np.hypot(*(middle - edge.xy[0])), np.hypot(*(middle - edge.xy[-1]))) > 12.0:
            continue
        hit = step[polygon_distance(at, area) < 0.3]
        if len(hit) and hit[0] < 0.5 * end:
            low = max(low, float(hit[-1]) + 0.1)
        elif len(hit):
            high = min(high, float(hit[0]) - 1.2)
    if high - low < 1.0:
        return None
    inner = edge.s[(edge.s > low + 0.05) & (edge.s < high - 0.05)]
    s = np.concatenate([[low], inner, [high]])
    yaw = np.interp(s, edge.s, np.unwrap(edge.yaw))
    xy = np.stack([np.interp(s, edge.s, edge.xy[:, k]) for k in range(2)], axis=1)
    return Edge(edge.lane, xy, yaw, s - low)


def _strip(
    soup: TriangleBuilder, edge: Edge, aside: float, material: int, *, width: float = LINE, z: float = PAINT
) -> None:
    """A line along an edge, `aside` m to its left."""
    middle = edge.xy + aside * edge.normal
    half = 0.5 * width * edge.normal
    soup.add(ribbon(middle + half, middle - half, (z, z), material, levels=VISIBLE))


def _dashes(soup: TriangleBuilder, edge: Edge, aside: float, material: int) -> None:
    """Dashes that begin and end with half a space."""
    period = DASH + SPACE
    count = max(1, round(float(edge.s[-1]) / period))
    start = (np.arange(count) + 0.5) * float(edge.s[-1]) / count - DASH / 2
    cut = np.stack([start, start + DASH / 2, start + DASH], axis=1).clip(0.0, edge.s[-1])
    xy = np.stack([np.interp(cut, edge.s, edge.xy[:, k] + aside * edge.normal[:, k]) for k in range(2)], axis=-1)
    normal = np.stack([np.interp(cut, edge.s, edge.normal[:, k]) for k in range(2)], axis=-1) * 0.5 * LINE
    left, right = xy + normal, xy - normal
    quads = [np.stack([right[:, k], right[:, k + 1], left[:, k + 1], left[:, k]], axis=1) for k in range(2)]
    _paint(soup, np.concatenate(quads), material)


def _paint(soup: TriangleBuilder, corners: F64, material: int, *, z: float = PAINT, levels: int = VISIBLE) -> None:
    """Flat polygons [n, k, 2] on the road."""
    soup.add(flat(np.concatenate([corners, np.full((*corners.shape[:2], 1), z)], axis=2), material, levels=levels))


def _stop(soup: TriangleBuilder, graph: LaneGraph, lane: int, s: float, *, give_way: bool, look: Look) -> None:
    """A stop line across a lane, or the teeth of a give-way line; and arrows on multi-lane arms.

    give_way: no signal or stop sign stands here.
    """
    x, y, yaw, width = graph.at(lane, s)
    half = 0.5 * width - 0.12
    if give_way:
        at = np.arange(-half, half - 0.3, 0.75)[:, None, None]
        tooth = np.array([[0.5, 0.0], [0.5, 0.44], [0.0, 0.22]])
        _paint(soup, place((x, y, yaw), tooth + at * [0.0, 1.0]), look.white)
    else:
        box = np.array([[[0.0, -half], [STOP, -half], [STOP, half], [0.0, half]]])
        _paint(soup, place((x, y, yaw), box), look.white)
    beside = [int(n) for n in (graph.left[lane], graph.right[lane]) if n >= 0]
    if any(graph.kind[n] == LaneType.DRIVING and graph.same_direction(lane, n) for n in beside) and s > 30.0:
        _arrows(soup, graph, lane, s, look)


def _arrows(soup: TriangleBuilder, graph: LaneGraph, lane: int, s: float, look: Look) -> None:
    """Arrows for the turns that a lane leads to, twice before the stop line."""
    ways = set()
    for after in graph.successors(lane).tolist():
        part = graph.points(after)
        turn = float((graph.yaw[part.stop - 1] - graph.yaw[part.start] + np.pi) % (2 * np.pi) - np.pi)
        ways.add("ahead" if abs(turn) < 0.5 else "left" if turn > 0 else "right")
    for back in (9.0, 24.0):
        x, y, yaw, _ = graph.at(lane, s - back)
        for way in sorted(ways):
            for polygon in _ARROW["ahead" if way == "ahead" else "left"]:
                points = np.array([polygon])
                if way == "right":
                    points = points[:, ::-1] * [1.0, -1.0]
                _paint(soup, place((x, y, yaw), points), look.white)


def _crosswalk(soup: TriangleBuilder, corners: F64, look: Look) -> None:
    """Bars along the traffic, over a rectangle [4, 2]: along its shorter sides."""
    if len(corners) != 4:
        return
    a, b = corners[1] - corners[0], corners[3] - corners[0]
    along, across = (a, b) if np.hypot(*a) < np.hypot(*b) else (b, a)
    wide = float(np.hypot(*across))
    unit = across / wide
    count = int((wide - 0.5) // (2 * BAR))
    start = 0.5 * (wide - (2 * count - 1) * BAR) + 2 * BAR * np.arange(count)
    foot = corners[0] + start[:, None] * unit
    quads = np.stack([foot, foot + along, foot + along + BAR * unit, foot + BAR * unit], axis=1)
    if along[0] * unit[1] - along[1] * unit[0] < 0.0:
        quads = quads[:, ::-1]
    _paint(soup, quads, look.white)


def _worn(soup: TriangleBuilder, graph: LaneGraph, lane: int, look: Look) -> None:
    """Lighter wheel tracks, repaired patches and manholes on a lane."""
    rng = look.generator
    for share in (0.27, 0.73):
        _strip(soup, lane_edge(graph, lane, share), 0.0, look.worn, width=0.5, z=0.5 * WEAR)
    length = float(graph.length[lane])
    for _ in range(rng.poisson(length / 45.0)):
        x, y, yaw, width = graph.at(lane, float(rng.uniform(2.0, max(2.1, length - 6.0))))
        long, wide = rng.uniform(1.0, 4.0), rng.uniform(0.6, 0.8 * width)
        aside = rng.uniform(-0.5, 0.5) * (width - wide)
        low, high = aside - wide / 2, aside + wide / 2
        box = np.array([[[0.0, low], [long, low], [long, high], [0.0, high]]])
        _paint(soup, place((x, y, yaw), box), look.patch, z=WEAR, levels=NEAR)
    angle = np.arange(8) * np.pi / 4
    disc = 0.32 * np.stack([np.cos(angle), np.sin(angle)], axis=1)[None]
    for _ in range(rng.poisson(length / 40.0)):
        x, y, yaw, width = graph.at(lane, float(rng.uniform(1.0, max(1.1, length - 1.0))))
        cover = place((x, y, yaw), disc + np.array([0.0, rng.uniform(-0.3, 0.3) * width]))
        _paint(soup, cover, look.iron, z=1.4 * WEAR, levels=NEAR)
