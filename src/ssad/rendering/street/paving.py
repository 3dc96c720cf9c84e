"""Ground of a street: road surface, sidewalks with kerbs, earth between them, far ground and hills."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from ssad.core.lane_graph import LaneGraph
from ssad.rendering.meshes.mesh import F32, F64
from ssad.rendering.street.palette import Look
from ssad.rendering.street.region import WALK, Ground, region_mesh
from ssad.rendering.street.triangles import ALL, HORIZON_OWNER, Piece, TriangleBuilder, flat

KERB = 0.13  # m, height of a sidewalk
STONE = 0.16  # m, width of a kerb stone
EARTH = 0.10  # m, height of the ground behind a sidewalk
BELOW = -0.03  # m, height of the ground beside a road without one
FAR_AWAY = 3000.0  # m
STRAIGHT = 16.0  # m, longest quad of a straight line


@dataclass(frozen=True)
class Edge:
    """One side of a lane as a line: xy [n, 2], heading [n] of the traffic, s [n] m along it; normal [n, 2]: left."""

    lane: int
    xy: F64
    yaw: F64
    s: F64

    @property
    def normal(self) -> F64:
        """Unit vectors to the left."""
        return np.stack([-np.sin(self.yaw), np.cos(self.yaw)], axis=1)


def lane_edge(graph: LaneGraph, lane: int, share: float) -> Edge:
    """The line at `share` of a lane's width from its right edge (0 right edge, 1 left edge)."""
    part = graph.points(lane)
    keep = _bends(graph.yaw[part], graph.s[part], graph.width[part])
    yaw = graph.yaw[part].astype(np.float64)[keep]
    left = np.stack([-np.sin(yaw), np.cos(yaw)], axis=1)
    width = graph.width[part].astype(np.float64)[keep]
    xy = graph.xy[part].astype(np.float64)[keep] + left * (share - 0.5) * width[:, None]
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xy, axis=0).T))])
    return Edge(lane, xy, yaw, s)


def _bends(yaw: F32, s: F32, width: F32) -> list[int]:
    """Points of a lane that its shape needs: on straight stretches one in `STRAIGHT` m."""
    keep, last = [0], len(s) - 1
    for i in range(1, last):
        k = keep[-1]
        turn = abs(float((yaw[i + 1] - yaw[k] + np.pi) % (2.0 * np.pi) - np.pi))
        if turn > 0.003 or s[i + 1] - s[k] > STRAIGHT or abs(width[i + 1] - width[k]) > 0.002:
            keep.append(i)
    return [*keep, last]


def ribbon(left: F64, right: F64, z: tuple[float, float], material: int, *, levels: int = ALL) -> Piece:
    """Quads between two lines [n, 2] at heights z (left, right)."""
    a = np.column_stack([right, np.full(len(right), z[1])])
    b = np.column_stack([left, np.full(len(left), z[0])])
    return flat(np.stack([a[:-1], a[1:], b[1:], b[:-1]], axis=1), material, levels=levels)


def pave(soup: TriangleBuilder, graph: LaneGraph, ground: Ground, look: Look) -> None:
    """Road surface, sidewalks and kerbs, earth, far ground."""
    low = np.array(ground.origin)
    vertices, faces = region_mesh(ground.road[::2, ::2] - 0.3)
    soup.add(level_ground(low + 2.0 * vertices, faces, np.zeros(len(vertices)), look.asphalt))
    for lane in np.flatnonzero(np.isin(graph.kind, [int(k) for k in WALK])).tolist():
        _sidewalk(soup, graph, lane, look)
    vertices, faces = region_mesh(-0.7 - ground.open()[::4, ::4], largest=8)
    xy = low + 4.0 * vertices
    road, walk = ground.at(ground.road, xy), ground.at(ground.walk, xy)
    bare = BELOW + (EARTH - BELOW) * np.clip((road - 0.5) / 4.0, 0.0, 1.0)
    middle = np.round(xy[faces].mean(axis=1) - low).astype(int)
    inner = ground.inner | (ground.paved < 2.5)
    soup.add(
        level_ground(
            xy,
            faces,
            np.where(walk <= road + 0.05, EARTH, bare),
            np.where(inner[middle[:, 1], middle[:, 0]], look.earth, look.earth_far),
        )
    )
    _far(soup, ground, look)


def level_ground(xy: F64, faces: np.ndarray, z: F64, material: npt.ArrayLike) -> Piece:
    """Nearly level triangles with upright normals and world coordinates as uv."""
    up = np.broadcast_to([0.0, 0.0, 1.0], (len(faces), 3, 3))
    return Piece(
        np.column_stack([xy, z]),
        faces,
        up,
        xy[faces],
        np.broadcast_to(np.asarray(material, np.int32), len(faces)),
        np.full(len(faces), ALL, np.int32),
    )


def _sidewalk(soup: TriangleBuilder, graph: LaneGraph, lane: int, look: Look) -> None:
    """A raised strip: kerb stones and their face along the road, slabs, and faces at the back and at free ends."""
    right, left = lane_edge(graph, lane, 0.0), lane_edge(graph, lane, 1.0)
    if float(graph.width[graph.points(lane)].max()) < 0.3:
        return
    inner, outer = (left.xy, right.xy), (right.xy, left.xy)
    stone = []
    for side, (edge, _), beside in ((1.0, inner, int(graph.left[lane])), (-1.0, outer, int(graph.right[lane]))):
        line = edge - side * STONE * left.normal
        if beside < 0:
            # the back: a face down to the earth
            z = (0.0, KERB) if side > 0 else (KERB, 0.0)
            soup.add(ribbon(edge, edge, z, look.slab))
            stone.append(edge)
            continue
        top = (edge, line) if side > 0 else (line, edge)
        soup.add(ribbon(*top, (KERB, KERB), look.kerb))
        foot = edge + side * 0.02 * left.normal
        face = (foot, edge) if side > 0 else (edge, foot)
        soup.add(ribbon(*face, (-0.02, KERB) if side > 0 else (KERB, -0.02), look.kerb))
        stone.append(line)
    soup.add(ribbon(stone[0], stone[1], (KERB, KERB), look.slab))
    for neighbours, at, order in ((graph.predecessors(lane), 0, (0, 1)), (graph.successors(lane), -1, (1, 0))):
        if not len(neighbours):
            p, q = (left.xy[at], right.xy[at])[order[0]], (left.xy[at], right.xy[at])[order[1]]
            corners = [[*p, -0.02], [*q, -0.02], [*q, KERB], [*p, KERB]]
            soup.add(flat(np.array([corners]), look.kerb))


def _far(soup: TriangleBuilder, ground: Ground, look: Look) -> None:
    """Ground to the horizon and two rows of hills, in every view."""
    x0, y0 = np.array(ground.origin) + 1.0
    x1, y1 = np.array(ground.origin) + np.array(ground.paved.shape[::-1]) - 2.0
    middle = np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1)])
    n = 8
    t = np.arange(n) / n
    inner = np.concatenate(
        [
            np.stack([x0 + t * (x1 - x0), y0 + 0 * t], 1),
            np.stack([x1 + 0 * t, y0 + t * (y1 - y0)], 1),
            np.stack([x1 - t * (x1 - x0), y1 + 0 * t], 1),
            np.stack([x0 + 0 * t, y1 - t * (y1 - y0)], 1),
        ]
    )
    away = inner - middle
    rings = [inner]
    for radius in (1.2 * float(np.hypot(*away.T).max()), FAR_AWAY):
        rings.append(middle + radius * away / np.hypot(*away.T)[:, None])
    for a, b in pairwise(rings):
        low, high = np.vstack([a, a[:1]]), np.vstack([b, b[:1]])
        soup.add(ribbon(low, high, (EARTH - 0.04, EARTH - 0.04), look.earth_far), HORIZON_OWNER)
    # a plane under everything, so that no pixel between two triangles shows the sky
    corners = [[x0, y0, -0.4], [x1, y0, -0.4], [x1, y1, -0.4], [x0, y1, -0.4]]
    soup.add(flat(np.array([corners]), look.earth_far), HORIZON_OWNER)
    span = float(np.hypot(*away.T).max())
    angle = np.linspace(0.0, 2.0 * np.pi, 97)
    for radius, tall, material in ((span + 350.0, 16.0, look.hill_near), (span + 1400.0, 90.0, look.hill_far)):
        phase = look.generator.uniform(0.0, 2.0 * np.pi, 5)
        wave = sum(np.sin(k * angle + p) / k**0.5 for k, p in zip((2, 3, 5, 9, 14), phase, strict=True))
        z = tall * (0.55 + 0.22 * wave)
        ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        foot, crest = middle + radius * ring, middle + (radius + 3.0 * tall) * ring
        a, b = np.column_stack([foot, 0.0 * z]), np.column_stack([crest, np.maximum(z, 0.2 * tall)])
        soup.add(flat(np.stack([a[1:], a[:-1], b[:-1], b[1:]], axis=1), material), HORIZON_OWNER)
