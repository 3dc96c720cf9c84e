"""Randomly generated towns, so that detectors do not learn single towns by heart."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import pairwise

import numpy as np

from ssad.core.seeding import generator
from ssad.world.roads.designs import crossover_points
from ssad.world.roads.writer import write_town
from ssad.world.roads.writer_parts import CLEARANCE, Point, RoadSpec, Town, plan_pieces

RANDOM = re.compile(r"Random(0|[1-9]\d{0,8})")
Place = tuple[int, int]  # column and row
Edge = tuple[Place, Place]


def write_random_town(name: str) -> str:
    """OpenDRIVE text of the town with a name that `RANDOM` matches."""
    return write_town(random_town(int(name.removeprefix("Random"))))


def random_town(number: int) -> Town:
    """Return a town of a crooked grid from which streets are missing; deterministic in its number.

    Everything except roundabouts and motorways is random: blocks of 66 to 124 m (up to 154 with 2 + 2 lanes), the
    offset of junctions from the grid, lanes, widths of lanes, shoulders and sidewalks, bends, speed limits, lights.

    Args:
        number: Seed of the town.

    Returns:
        The specification, from which `write_town` makes OpenDRIVE.
    """
    rng = generator("random town", number)
    lanes = 2 if rng.random() < 0.25 else 1
    max_offset, min_block = rng.uniform(0.0, 12.0), 66.0 + 30.0 * (lanes - 1)
    columns, rows = rng.integers(4, 6), rng.integers(3, 5)
    x_positions, y_positions = (
        np.cumsum(rng.uniform(min_block, min_block + 58.0, block_count)) for block_count in (columns, rows)
    )
    positions = {
        (column, row): (
            round(float(x_positions[column] + rng.uniform(-max_offset, max_offset)), 2),
            round(float(y_positions[row] + rng.uniform(-max_offset, max_offset)), 2),
        )
        for column in range(columns)
        for row in range(rows)
    }
    edges = {
        (place, neighbour)
        for place in positions
        for neighbour in ((place[0] + 1, place[1]), (place[0], place[1] + 1))
        if neighbour in positions
    }
    all_edges = sorted(edges)
    min_edges = (1.0 - rng.uniform(0.0, 0.22)) * len(all_edges)
    for index in rng.permutation(len(all_edges)):
        # Only streets whose loss creates no dead end and splits no part off may go.
        if len(edges) - 1 >= min_edges and _is_connected(positions, edges - {all_edges[index]}):
            edges = edges - {all_edges[index]}
    width, sidewalk = round(rng.uniform(3.1, 3.75), 2), round(rng.uniform(1.6, 3.5), 1)
    shoulder, limit = float(rng.choice([0.5, 0.5, 1.5, 2.0])), float(rng.choice([20.0, 25.0, 30.0, 35.0]))
    radius, lead = rng.uniform(14.0, 30.0), rng.uniform(16.0, 18.0) + 6.0 * (lanes - 1)
    max_bend = rng.uniform(0.0, 12.0)
    setback = lanes * width + CLEARANCE
    streets = tuple(
        _fit_corners(RoadSpec(points, lanes, width, shoulder, sidewalk, limit, radius), setback)
        for points in _polylines(positions, edges, lead, lambda: float(rng.uniform(-max_bend, max_bend)))
    )
    # Three or more streets make a junction; two only meet in a bend.
    end_points = [position for street in streets for position in (street.points[0], street.points[-1])]
    junctions = sorted({position for position in end_points if end_points.count(position) > 2})
    is_signalled = rng.random(len(junctions)) < rng.uniform(0.2, 0.7)
    return Town(
        f"Random{number}",
        streets,
        tuple(position for position, signalled in zip(junctions, is_signalled, strict=True) if signalled),
    )


def _fit_corners(street: RoadSpec, setback: float) -> RoadSpec:
    """Reduce the radius of a street's corners until they leave room for each other."""
    candidates = (replace(street, radius=0.9**step * street.radius) for step in range(20))
    return next(candidate for candidate in candidates if min(_straights(candidate, setback)) > 0.5)


def _straights(street: RoadSpec, setback: float) -> list[float]:
    """Return the lengths of its straight pieces, m; negative where corners overlap."""
    return [piece.length for piece in plan_pieces(street, setback, setback) if not piece.curvature]


def _is_connected(places: Iterable[Place], edges: set[Edge]) -> bool:
    """Return whether every place has two streets or more, and all places are connected."""
    neighbours: dict[Place, set[Place]] = {place: set() for place in places}
    for start, end in edges:
        neighbours[start].add(end)
        neighbours[end].add(start)
    visited: set[Place] = set()
    pending = [next(iter(neighbours))]
    while pending:
        place = pending.pop()
        if place not in visited:
            visited.add(place)
            pending += neighbours[place]
    return len(visited) == len(neighbours) and min(map(len, neighbours.values())) >= 2


def _polylines(
    positions: dict[Place, Point], edges: set[Edge], lead: float, lateral: Callable[[], float]
) -> list[tuple[Point, ...]]:
    """Streets from junction to junction: places with two streets are bends, not junctions.

    Args:
        positions: Where the places are, m.
        edges: Pairs of places with a street between them.
        lead: How far a street follows the axis from each place, m.
        lateral: How far off its way a street is in the middle of a block, m; drawn for each.
    """
    neighbours: dict[Place, list[Place]] = {place: [] for place in positions}
    for start_place, end_place in sorted(edges):
        neighbours[start_place].append(end_place)
        neighbours[end_place].append(start_place)
    unused = set(edges)
    polylines = []
    for start in sorted(positions):
        for following in neighbours[start] if len(neighbours[start]) > 2 else ():
            if (min(start, following), max(start, following)) not in unused:
                continue
            chain = [start, following]
            unused.discard((min(start, following), max(start, following)))
            while len(neighbours[chain[-1]]) == 2:
                (next_place,) = (place for place in neighbours[chain[-1]] if place != chain[-2])
                unused.discard((min(chain[-1], next_place), max(chain[-1], next_place)))
                chain.append(next_place)
            points = [positions[start]]
            for start_place, end_place in pairwise(chain):
                points += crossover_points(positions[start_place], positions[end_place], lead=lead, lateral=lateral())[
                    1:
                ]
            polylines.append(tuple(points))
    return polylines
