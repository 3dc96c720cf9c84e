"""Yards: paved ground behind the pavement with cells for cars, or places along the street for long vehicles."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ssad.core.rotations import wrap_scalar
from ssad.rendering.meshes.mesh import F64
from ssad.rendering.street.bays import SPACING
from ssad.rendering.street.free_ground import FreeGround, Side, footprint, place
from ssad.rendering.street.model import MID, NEAR
from ssad.rendering.street.palette import TownMaterials
from ssad.rendering.street.paving import EARTH, RAMP, Entrance
from ssad.rendering.street.triangles import ALL, TriangleBuilder, flat

Pose = tuple[float, float, float]

GAP = (3.0, 12.0)  # m between the yards of a side
END = 8.0  # m from the ends of a street without a yard
FRONT, BACK = 0.4, 0.8  # m between the pavement and a yard, and from there to walls with their awnings and bins
MARGIN = 0.6  # m beyond the first and the last place
CELL_WIDTH, CELL_DEPTH = 2.7, 5.6  # m, a car across the street
ROW_PLACES, ROW_DEPTH = (10.0, 12.6, 17.6, 17.6, 17.6), 3.3  # m, places along the street: for a truck, a bus, a trailer
CELLS, PLACES = (3, 7), (1, 3)  # numbers of cells and of places of a yard, the ends excluded
ROWS = 0.6  # of the yards, as far as there is room
MAX_TURN = 0.25  # rad along a yard: yards are straight
STEP = 3.0  # m to the next attempt where there is no room
LINE = 0.1  # m, width of the lines
ROW_ENTRANCE = 8.0  # m, width of the entrance of places along the street; cells are entered everywhere
MIN_ENTRANCE = 3.0  # m, width of an entrance
ENTRANCE_STEP = 0.5  # m between the stations at which the pavement is tested
TOP = EARTH + 0.024  # m, height of a yard: above the drives and paths of houses
DEPTHS = (ROW_DEPTH + BACK, CELL_DEPTH + BACK)  # m that yards take


@dataclass
class Yards:
    """Places in yards: those of `Street.parking`, and those of `Street.yards`.

    `frontages` are the sides of streets with the stations between which a yard lies, and the greatest width of its
    entrance, m.
    """

    cells: list[Pose] = field(default_factory=list)
    rows: list[tuple[float, float, float, float, float]] = field(default_factory=list)
    frontages: list[tuple[Side, float, float, float]] = field(default_factory=list)


def lay_yards(triangles: TriangleBuilder, ground: FreeGround, materials: TownMaterials, sides: list[Side]) -> Yards:
    """Lay yards behind the pavements of streets, where the ground is free; return their places."""
    rng, yards = materials.details, Yards()
    for side in sides:
        if not side.frontage or not side.kerb:
            continue
        station = END + float(rng.uniform(0.0, GAP[0]))
        while station < side.length - END:
            is_row = rng.random() < ROWS
            place_count = int(rng.integers(*(PLACES if is_row else CELLS)))
            width, depth = (float(rng.choice(ROW_PLACES)), ROW_DEPTH) if is_row else (CELL_WIDTH, CELL_DEPTH)
            length = place_count * width
            if station + length > side.length - END:
                station += STEP
                continue
            start_yaw, end_yaw = (side.pose(station + share * length)[2] for share in (0.0, 1.0))
            yaw_change = abs(wrap_scalar(end_yaw - start_yaw))
            # Where the street curves, the ends of a yard keep off the pavement: by the height of the arc.
            street_distance = FRONT + 0.125 * length * yaw_change
            x, y, yaw = side.pose(station + 0.5 * length, street_distance)
            yard_pose = (x, y, yaw + np.pi)  # y points away from the street
            half_length = 0.5 * length + MARGIN
            yard_footprint = footprint(yard_pose, (-half_length, half_length), (0.0, depth + BACK))
            if yaw_change > MAX_TURN or not ground.is_free(yard_footprint, distance=0.25):
                station += STEP
                continue
            _lay_yard(
                triangles,
                materials,
                yard_pose,
                (-street_distance, half_length, depth),
                _lines(place_count, width, depth, is_row=is_row),
            )
            ground.occupy(yard_footprint)
            yards.frontages.append((side, station, station + length, ROW_ENTRANCE if is_row else length))
            middles = length * ((np.arange(place_count) + 0.5) / place_count - 0.5)
            if is_row:
                place_points = place(yard_pose, np.column_stack([middles, np.zeros(place_count)])).tolist()
                yards.rows += [(*point, yaw, depth, 0.5 * width) for point in place_points]
            else:
                place_points = place(yard_pose, np.column_stack([middles, np.full(place_count, 0.5 * depth)])).tolist()
                yards.cells += [(*point, yaw + 0.5 * np.pi) for point in place_points]
            station += length + float(rng.uniform(*GAP))
    return yards


def entrances(ground: FreeGround, frontages: list[tuple[Side, float, float, float]], bays: F64) -> list[Entrance]:
    """Return the entrances of yards: the longest stretch of each with neither a bay nor an object at its kerb.

    Args:
        ground: The ground, on which all objects of the street are marked.
        frontages: See `Yards`.
        bays: See `Street.bays`, [., 5].

    Returns:
        The entrances; a yard behind bays has none.
    """
    yard_entrances: list[Entrance] = []
    for side, start, end, max_width in frontages:
        stations = np.arange(start, end, ENTRANCE_STEP)
        is_free = np.zeros(len(stations) + 1, bool)
        for index, station in enumerate(stations.tolist()):
            pose = side.pose(station)
            strip = footprint(pose, (0.0, ENTRANCE_STEP), (0.0, side.kerb))
            is_free[index] = not ground.is_occupied(strip) and not _in_bay(strip, bays)
        edges = np.flatnonzero(np.diff(is_free.astype(int), prepend=0)).reshape(-1, 2) * ENTRANCE_STEP + start
        if not len(edges):
            continue
        first, last = edges[np.argmax(edges[:, 1] - edges[:, 0])].tolist()
        # The kerb rises to its full height before the next obstacle.
        middle, width = 0.5 * (first + last), min(last - first - 2.0 * RAMP, max_width)
        if width >= MIN_ENTRANCE:
            yard_entrances.append((side.edge.lane, middle - 0.5 * width, middle + 0.5 * width))
    return yard_entrances


def _in_bay(points: F64, bays: F64) -> bool:
    """Return whether one of the points [n, 2] lies in a bay."""
    offsets = points[:, None] - bays[:, :2]
    cosine, sine = np.cos(bays[:, 2]), np.sin(bays[:, 2])
    along = offsets[..., 0] * cosine + offsets[..., 1] * sine
    outwards = offsets[..., 0] * sine - offsets[..., 1] * cosine
    is_inside = (np.abs(along) < 0.5 * SPACING + 1.0) & (outwards > -0.5) & (outwards < bays[:, 3] + 0.1)
    return bool(is_inside.any())


def _lines(place_count: int, width: float, depth: float, *, is_row: bool) -> F64:
    """Return the white lines between places, [n, 4]: low x, low y, high x, high y in the frame of the yard."""
    line_stations = width * (np.arange(place_count + 1) - 0.5 * place_count)
    start = depth - 1.2 if is_row else 0.3
    return np.array(
        [(line_station - 0.5 * LINE, start, line_station + 0.5 * LINE, depth - 0.1) for line_station in line_stations]
    )


def _lay_yard(
    triangles: TriangleBuilder, materials: TownMaterials, yard_pose: Pose, size: tuple[float, float, float], lines: F64
) -> None:
    """Pave a yard of a size (y of its front, half length, depth) and paint its lines."""
    front_edge, half_length, depth = size
    for rectangles, top, material, levels in (
        (np.array([(-half_length, front_edge, half_length, depth)]), TOP, materials.bay, ALL),
        (lines, TOP + 0.008, materials.white, NEAR | MID),
    ):
        outline = rectangles[:, [[0, 1], [2, 1], [2, 3], [0, 3]]]
        corners = np.concatenate([place(yard_pose, outline), np.full((*outline.shape[:2], 1), top)], axis=2)
        triangles.add(flat(corners, material, levels=levels), np.array(yard_pose[:2]))
