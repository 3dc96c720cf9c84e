"""Towns drawn at random: detectors that learn in many towns learn no town by heart."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import pairwise

import numpy as np

from ssad.core.seeding import generator
from ssad.world.roads.designs import shifted
from ssad.world.roads.writer import write_town
from ssad.world.roads.writer_parts import CLEARANCE, Point, RoadSpec, Town, plan_pieces

RANDOM = re.compile(r"Random(0|[1-9]\d{0,8})")
Place = tuple[int, int]  # column and row
Edge = tuple[Place, Place]


def write_random_town(name: str) -> str:
    """OpenDRIVE text of the town with a name that `RANDOM` matches."""
    return write_town(random_town(int(name.removeprefix("Random"))))


def random_town(number: int) -> Town:
    """A town of a crooked grid from which streets are missing; the same for the same number.

    Everything that a town has but roundabouts and motorways is drawn: blocks of 66 to 124 m (up to 154 with 2 + 2
    lanes), how far junctions lie off the grid, lanes, widths of lanes, shoulders and sidewalks, bends, speed limits,
    lights.

    Args:
        number: Which one.

    Returns:
        The specification, from which `write_town` makes OpenDRIVE.
    """
    draws = generator("random town", number)
    lanes = 2 if draws.random() < 0.25 else 1
    off, least = draws.uniform(0.0, 12.0), 66.0 + 30.0 * (lanes - 1)
    columns, rows = draws.integers(4, 6), draws.integers(3, 5)
    xs, ys = (np.cumsum(draws.uniform(least, least + 58.0, n)) for n in (columns, rows))
    at = {
        (i, j): (round(float(xs[i] + draws.uniform(-off, off)), 2), round(float(ys[j] + draws.uniform(-off, off)), 2))
        for i in range(columns)
        for j in range(rows)
    }
    edges = {(a, b) for a in at for b in ((a[0] + 1, a[1]), (a[0], a[1] + 1)) if b in at}
    whole = sorted(edges)
    fewest = (1.0 - draws.uniform(0.0, 0.22)) * len(whole)
    for k in draws.permutation(len(whole)):
        if len(edges) - 1 >= fewest and _holds(at, edges - {whole[k]}):
            edges = edges - {whole[k]}
    width, sidewalk = round(draws.uniform(3.1, 3.75), 2), round(draws.uniform(1.6, 3.5), 1)
    shoulder, limit = float(draws.choice([0.5, 0.5, 1.5, 2.0])), float(draws.choice([20.0, 25.0, 30.0, 35.0]))
    radius, lead = draws.uniform(14.0, 30.0), draws.uniform(16.0, 18.0) + 6.0 * (lanes - 1)
    wind = draws.uniform(0.0, 12.0)
    setback = lanes * width + CLEARANCE
    streets = tuple(
        _fitting(RoadSpec(points, lanes, width, shoulder, sidewalk, limit, radius), setback)
        for points in _polylines(at, edges, lead, lambda: float(draws.uniform(-wind, wind)))
    )
    ends = [p for street in streets for p in (street.points[0], street.points[-1])]
    junctions = sorted({p for p in ends if ends.count(p) > 2})
    lit = draws.random(len(junctions)) < draws.uniform(0.2, 0.7)
    return Town(f"Random{number}", streets, tuple(p for p, one in zip(junctions, lit, strict=True) if one))


def _fitting(street: RoadSpec, setback: float) -> RoadSpec:
    """The street with corners of the largest radius, up to the one it has, that leave room for each other."""
    tries = (replace(street, radius=0.9**k * street.radius) for k in range(20))
    return next(one for one in tries if min(_straights(one, setback)) > 0.5)


def _straights(street: RoadSpec, setback: float) -> list[float]:
    """Lengths of its straight pieces, m; below 0 where corners overlap."""
    return [piece.length for piece in plan_pieces(street, setback, setback) if not piece.curvature]


def _holds(places: Iterable[Place], edges: set[Edge]) -> bool:
    """Whether every place has two streets or more, and each can be reached from each."""
    near: dict[Place, set[Place]] = {place: set() for place in places}
    for a, b in edges:
        near[a].add(b)
        near[b].add(a)
    seen: set[Place] = set()
    todo = [next(iter(near))]
    while todo:
        place = todo.pop()
        if place not in seen:
            seen.add(place)
            todo += near[place]
    return len(seen) == len(near) and min(map(len, near.values())) >= 2


def _polylines(
    at: dict[Place, Point], edges: set[Edge], lead: float, aside: Callable[[], float]
) -> list[tuple[Point, ...]]:
    """Streets from junction to junction: places with two streets are bends, not junctions.

    Args:
        at: Where the places are, m.
        edges: Pairs of places with a street between them.
        lead: How far a street follows the axis from each place, m.
        aside: How far off its way a street is in the middle of a block, m; drawn for each.
    """
    near: dict[Place, list[Place]] = {place: [] for place in at}
    for a, b in sorted(edges):
        near[a].append(b)
        near[b].append(a)
    left = set(edges)
    found = []
    for start in sorted(at):
        for following in near[start] if len(near[start]) > 2 else ():
            if (min(start, following), max(start, following)) not in left:
                continue
            way = [start, following]
            left.discard((min(start, following), max(start, following)))
            while len(near[way[-1]]) == 2:
                (ahead,) = (place for place in near[way[-1]] if place != way[-2])
                left.discard((min(way[-1], ahead), max(way[-1], ahead)))
                way.append(ahead)
            points = [at[start]]
            for a, b in pairwise(way):
                points += shifted(at[a], at[b], lead=lead, aside=aside())[1:]
            found.append(tuple(points))
    return found
