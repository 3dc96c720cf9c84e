"""Ground of a street: road surface, sidewalks with kerbs, earth between them, far ground and hills."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from ssad.core.lane_graph import LaneGraph
from ssad.core.rotations import wrap_angle
from ssad.rendering.meshes.mesh import F32, F64
from ssad.rendering.street.palette import TownMaterials
from ssad.rendering.street.region import WALK, Ground, region_mesh
from ssad.rendering.street.triangles import ALL, HORIZON_OWNER, TriangleBuilder, TrianglePiece, flat

KERB = 0.13  # m, height of a sidewalk
STONE = 0.16  # m, width of a kerb stone
LOWERED = 0.03  # m, height of a kerb at the entrance of a yard
RAMP = 0.7  # m along the kerb, from the lowered height to the full one
SLOPE = 0.24  # m across the pavement, from the kerb stone to the full height
EARTH = 0.10  # m, height of the ground behind a sidewalk
BELOW = -0.03  # m, height of the ground beside a road without one
FAR_AWAY = 3000.0  # m
FIELD_SHARES = (0.4, 0.2, 0.2, 0.1, 0.1)  # of `TownMaterials.fields`
STRAIGHT = 16.0  # m, longest quad of a straight line


Entrance = tuple[int, float, float]
"""Lane of a sidewalk, and the stations on its right edge between which its kerb is lowered, m."""


@dataclass(frozen=True)
class Edge:
    """One side of a lane as a line.

    xy [n, 2] m; yaw [n] heading of the traffic, rad; s [n] arc length, m; normal [n, 2] points to the left.
    """

    lane: int
    xy: F64
    yaw: F64
    s: F64

    @property
    def normal(self) -> F64:
        """Unit vectors to the left."""
        return np.stack([-np.sin(self.yaw), np.cos(self.yaw)], axis=1)


def lane_edge(graph: LaneGraph, lane: int, share: float) -> Edge:
    """Return the line at `share` of a lane's width from its right edge (0 right edge, 1 left edge)."""
    point_range = graph.points(lane)
    indices = _bends(graph.yaw[point_range], graph.s[point_range], graph.width[point_range])
    yaw = graph.yaw[point_range].astype(np.float64)[indices]
    left_normals = np.stack([-np.sin(yaw), np.cos(yaw)], axis=1)
    width = graph.width[point_range].astype(np.float64)[indices]
    xy = graph.xy[point_range].astype(np.float64)[indices] + left_normals * (share - 0.5) * width[:, None]
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xy, axis=0).T))])
    return Edge(lane, xy, yaw, s)


def _bends(yaw: F32, arc_lengths: F32, width: F32) -> list[int]:
    """Return the indices of the lane points that its shape needs; straight stretches keep one in `STRAIGHT` m."""
    indices, last = [0], len(arc_lengths) - 1
    for index in range(1, last):
        previous = indices[-1]
        heading_change = abs(float(wrap_angle(yaw[index + 1] - yaw[previous])))
        # Long quads would make tiles draw too much, so straight lines are cut as well.
        if (
            heading_change > 0.003
            or arc_lengths[index + 1] - arc_lengths[previous] > STRAIGHT
            or abs(width[index + 1] - width[previous]) > 0.002
        ):
            indices.append(index)
    return [*indices, last]


def ribbon(
    left: F64, right: F64, z: tuple[float | F64, float | F64], material: int, *, levels: int = ALL
) -> TrianglePiece:
    """Return quads between two lines [n, 2] at heights z (left, right), each one height or one for each point [n]."""
    right_line = np.column_stack([right, np.broadcast_to(z[1], len(right))])
    left_line = np.column_stack([left, np.broadcast_to(z[0], len(left))])
    return flat(
        np.stack([right_line[:-1], right_line[1:], left_line[1:], left_line[:-1]], axis=1), material, levels=levels
    )


def pave_ground(triangles: TriangleBuilder, graph: LaneGraph, ground: Ground, materials: TownMaterials) -> None:
    """Road surface, earth, far ground; `pave_sidewalks` adds the sidewalks."""
    origin = np.array(ground.origin)
    vertices, faces = region_mesh(ground.road[::2, ::2] - 0.3)
    triangles.add(level_ground(origin + 2.0 * vertices, faces, np.zeros(len(vertices)), materials.asphalt))
    vertices, faces = region_mesh(-0.7 - ground.open()[::4, ::4], largest=8)
    xy = origin + 4.0 * vertices
    road, walk = ground.at(ground.road, xy), ground.at(ground.walk, xy)
    bare_height = BELOW + (EARTH - BELOW) * np.clip((road - 0.5) / 4.0, 0.0, 1.0)
    face_cells = np.round(xy[faces].mean(axis=1) - origin).astype(int)
    is_town_ground = ground.inner | (ground.paved < 2.5)
    triangles.add(
        level_ground(
            xy,
            faces,
            np.where(walk <= road + 0.05, EARTH, bare_height),
            np.where(is_town_ground[face_cells[:, 1], face_cells[:, 0]], materials.earth, materials.earth_far),
        )
    )
    _add_far_ground(triangles, ground, materials)


def level_ground(xy: F64, faces: np.ndarray, z: F64, material: npt.ArrayLike) -> TrianglePiece:
    """Return nearly level triangles with vertical normals and world coordinates as uv."""
    normals = np.broadcast_to([0.0, 0.0, 1.0], (len(faces), 3, 3))
    return TrianglePiece(
        np.column_stack([xy, z]),
        faces,
        normals,
        xy[faces],
        np.broadcast_to(np.asarray(material, np.int32), len(faces)),
        np.full(len(faces), ALL, np.int32),
    )


def pave_sidewalks(
    triangles: TriangleBuilder, graph: LaneGraph, materials: TownMaterials, entrances: Sequence[Entrance]
) -> None:
    """Sidewalks with kerbs, which are lowered at entrances."""
    for lane in np.flatnonzero(np.isin(graph.kind, [int(lane_kind) for lane_kind in WALK])).tolist():
        lane_entrances = [(start, end) for entrance_lane, start, end in entrances if entrance_lane == lane]
        _pave_sidewalk(triangles, graph, lane, materials, lane_entrances)


def _with_stations(right: Edge, left: Edge, stations: F64) -> tuple[Edge, Edge]:
    """Return both edges of a lane with more points, at arc lengths of the right one."""
    indices = np.arange(len(right.s), dtype=np.float64)
    positions = np.unique(np.concatenate([indices, np.interp(stations, right.s, indices)]))

    def resample(edge: Edge) -> Edge:
        x, y, yaw, arc_length = (
            np.interp(positions, indices, values)
            for values in (edge.xy[:, 0], edge.xy[:, 1], np.unwrap(edge.yaw), edge.s)
        )
        return Edge(edge.lane, np.column_stack([x, y]), yaw, arc_length)

    return resample(right), resample(left)


def _kerb_heights(stations: F64, entrances: Sequence[tuple[float, float]]) -> F64:
    """Return the height of the kerb at stations [n], m."""
    heights = np.full(len(stations), KERB)
    for start, end in entrances:
        distances = np.maximum(np.maximum(start - stations, stations - end), 0.0)
        heights = np.minimum(heights, LOWERED + (KERB - LOWERED) * np.clip(distances / RAMP, 0.0, 1.0))
    return heights


def _pave_sidewalk(
    triangles: TriangleBuilder,
    graph: LaneGraph,
    lane: int,
    materials: TownMaterials,
    entrances: Sequence[tuple[float, float]],
) -> None:
    """A raised strip: kerb stones and their face along the road, slabs, and faces at the back and at free ends."""
    right, left = lane_edge(graph, lane, 0.0), lane_edge(graph, lane, 1.0)
    if entrances:
        limits = [limit for start, end in entrances for limit in (start - RAMP, start, end, end + RAMP)]
        right, left = _with_stations(right, left, np.clip(limits, 0.0, right.s[-1]))
    heights = _kerb_heights(right.s, entrances)
    if float(graph.width[graph.points(lane)].max()) < 0.3:
        return
    inner, outer = (left.xy, right.xy), (right.xy, left.xy)
    slab_edges = []
    for side, (edge, _), neighbour in ((1.0, inner, int(graph.left[lane])), (-1.0, outer, int(graph.right[lane]))):
        inner_line = edge - side * STONE * left.normal
        if neighbour < 0:
            # The back: a face down to the earth.
            back_heights = (0.0, KERB) if side > 0 else (KERB, 0.0)
            triangles.add(ribbon(edge, edge, back_heights, materials.slab))
            slab_edges.append(edge)
            continue
        # Only the side of the road is lowered.
        edge_heights = heights if side > 0 else np.full(len(heights), KERB)
        inner_heights = edge_heights + (KERB - edge_heights) * STONE / (STONE + SLOPE)
        triangles.add(_strip(side, (edge, inner_line), (edge_heights, inner_heights), materials.kerb))
        base_line = edge + side * 0.02 * left.normal
        triangles.add(_strip(side, (base_line, edge), (np.full(len(heights), -0.02), edge_heights), materials.kerb))
        if side > 0 and entrances:
            slope_line = inner_line - side * SLOPE * left.normal
            triangles.add(
                _strip(side, (inner_line, slope_line), (inner_heights, np.full(len(heights), KERB)), materials.slab)
            )
            inner_line = slope_line
        slab_edges.append(inner_line)
    triangles.add(ribbon(slab_edges[0], slab_edges[1], (KERB, KERB), materials.slab))
    for neighbours, end_index, corner_order in (
        (graph.predecessors(lane), 0, (0, 1)),
        (graph.successors(lane), -1, (1, 0)),
    ):
        if not len(neighbours):
            first_corner, second_corner = (
                (left.xy[end_index], right.xy[end_index])[corner_order[0]],
                (left.xy[end_index], right.xy[end_index])[corner_order[1]],
            )
            corners = [[*first_corner, -0.02], [*second_corner, -0.02], [*second_corner, KERB], [*first_corner, KERB]]
            triangles.add(flat(np.array([corners]), materials.kerb))


def _strip(side: float, lines: tuple[F64, F64], heights: tuple[F64, F64], material: int) -> TrianglePiece:
    """Return the ribbon between an outer and an inner line [n, 2] of a side, left (1) or right (-1)."""
    (outer, inner), (outer_heights, inner_heights) = lines, heights
    if side > 0:
        return ribbon(outer, inner, (outer_heights, inner_heights), material)
    return ribbon(inner, outer, (inner_heights, outer_heights), material)


def _add_far_ground(triangles: TriangleBuilder, ground: Ground, materials: TownMaterials) -> None:
    """Ground to the horizon and two rows of hills, in every view."""
    x0, y0 = np.array(ground.origin) + 1.0
    x1, y1 = np.array(ground.origin) + np.array(ground.paved.shape[::-1]) - 2.0
    centre = np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1)])
    points_per_side = 8
    shares = np.arange(points_per_side) / points_per_side
    border = np.concatenate(
        [
            np.stack([x0 + shares * (x1 - x0), y0 + 0 * shares], 1),
            np.stack([x1 + 0 * shares, y0 + shares * (y1 - y0)], 1),
            np.stack([x1 - shares * (x1 - x0), y1 + 0 * shares], 1),
            np.stack([x0 + 0 * shares, y1 - shares * (y1 - y0)], 1),
        ]
    )
    offsets = border - centre
    town_radius = float(np.hypot(*offsets.T).max())
    directions = offsets / np.hypot(*offsets.T)[:, None]
    # Fields: each sector of a ring has a colour of its own, so that no single green reaches the horizon.
    radii = [radius for radius in town_radius * np.array([1.2, 1.4, 1.7, 2.1, 2.7]) if radius < FAR_AWAY]
    rings = [border, *(centre + radius * directions for radius in [*radii, FAR_AWAY])]
    for index, (inner_ring, outer_ring) in enumerate(pairwise(rings)):
        inner, outer = np.vstack([inner_ring, inner_ring[:1]]), np.vstack([outer_ring, outer_ring[:1]])
        colours = materials.details.choice(materials.fields, len(border), p=FIELD_SHARES)
        if index == 0:
            colours[:] = materials.earth_far  # meadow around the town
        outline = np.stack([outer[:-1], outer[1:], inner[1:], inner[:-1]], axis=1)
        heights = np.full((*outline.shape[:2], 1), EARTH - 0.04)
        triangles.add(flat(np.concatenate([outline, heights], axis=2), colours), HORIZON_OWNER)
    # A plane under everything keeps the sky from showing through between two triangles.
    corners = [[x0, y0, -0.4], [x1, y0, -0.4], [x1, y1, -0.4], [x0, y1, -0.4]]
    triangles.add(flat(np.array([corners]), materials.earth_far), HORIZON_OWNER)
    _add_tree_lines(triangles, centre, town_radius, materials)
    angles = np.linspace(0.0, 2.0 * np.pi, 97)
    for radius, height, material in (
        (town_radius + 350.0, 16.0, materials.hill_near),
        (town_radius + 1400.0, 90.0, materials.hill_far),
    ):
        phases = materials.generator.uniform(0.0, 2.0 * np.pi, 5)
        skyline = sum(
            np.sin(frequency * angles + phase_shift) / frequency**0.5
            for frequency, phase_shift in zip((2, 3, 5, 9, 14), phases, strict=True)
        )
        crest_heights = height * (0.55 + 0.22 * skyline)
        directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        base_line, crest_line = centre + radius * directions, centre + (radius + 3.0 * height) * directions
        lower_ring, upper_ring = (
            np.column_stack([base_line, 0.0 * crest_heights]),
            np.column_stack([crest_line, np.maximum(crest_heights, 0.2 * height)]),
        )
        triangles.add(
            flat(np.stack([lower_ring[1:], lower_ring[:-1], upper_ring[:-1], upper_ring[1:]], axis=1), material),
            HORIZON_OWNER,
        )


def _add_tree_lines(triangles: TriangleBuilder, centre: F64, town_radius: float, materials: TownMaterials) -> None:
    """Rows of distant trees between the town and the hills: ragged bands that hide where the ground ends."""
    rng = materials.details
    for distance, height, count in ((60.0, 7.0, 26), (160.0, 10.0, 30), (300.0, 14.0, 30)):
        for start in np.linspace(0.0, 2.0 * np.pi, count, endpoint=False) + rng.uniform(0.0, 0.2, count):
            radius = town_radius + distance * rng.uniform(0.8, 1.3)
            step = rng.uniform(3.0, 5.0) / radius
            angles = start + step * np.arange(int(rng.integers(6, 22)) + 1)
            radii = radius + 0.3 * distance * rng.uniform(-1.0, 1.0) * np.linspace(0.0, 1.0, len(angles))
            feet = centre + radii[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
            tops = height * rng.uniform(0.45, 1.0, len(angles))
            tops[[0, -1]] *= 0.3
            lower, upper = (np.column_stack([feet, z]) for z in (np.full(len(angles), EARTH - 0.1), tops))
            band = np.stack([lower[1:], lower[:-1], upper[:-1], upper[1:]], axis=1)
            triangles.add(flat(band, int(rng.choice(materials.tree_line))), HORIZON_OWNER)
