"""The towns that ship with SSAD, as code: `python -m ssad.roads.generate FOLDER` writes their .xodr and .npz."""

from __future__ import annotations

import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

from ssad.errors import unknown_name
from ssad.roads.bake import bake
from ssad.roads.graph import save_graph
from ssad.roads.writer import Point, Street, Town, write_town
from ssad.safeio import write_atomic

__all__ = ["TOWNS", "generate_town"]


def _chain(stops: list[Point], make: Callable[[tuple[Point, ...]], Street]) -> list[Street]:
    """Streets from stop to stop."""
    return [make((a, b)) for a, b in pairwise(stops)]


def twinford() -> Town:
    """Two-lane streets and T-junctions, about 240 x 220 m, in the spirit of CARLA's Town02."""

    def street(points: tuple[Point, ...]) -> Street:
        return Street(points, lanes=1, width=3.75, shoulder=0.5, sidewalk=3.0, limit=25.0, radius=18.0)

    w, m, e = 0.0, 120.0, 240.0
    streets = [
        # outer loop, cut where an inner street meets it
        street(((m, 0.0), (w, 0.0), (w, 120.0))),
        street(((w, 120.0), (w, 220.0), (m, 220.0))),
        street(((m, 220.0), (e, 220.0), (e, 165.0))),
        street(((e, 165.0), (e, 60.0))),
        street(((e, 60.0), (e, 0.0), (m, 0.0))),
        *_chain([(m, 0.0), (m, 60.0), (m, 120.0), (m, 165.0), (m, 220.0)], street),
        street(((w, 120.0), (m, 120.0))),
        street(((m, 60.0), (e, 60.0))),
        street(((m, 165.0), (e, 165.0))),
    ]
    return Town("Twinford", tuple(streets), signalled=((m, 0.0), (m, 120.0), (m, 60.0), (e, 165.0)))


def crossgate() -> Town:
    """Streets of 2 + 2 lanes, four signalled crossroads inside an outer ring, 400 x 400 m; like CARLA's Town05."""

    def street(points: tuple[Point, ...]) -> Street:
        return Street(points, lanes=2, width=3.5, shoulder=0.5, sidewalk=3.0, limit=35.0, radius=30.0)

    def ring(points: tuple[Point, ...]) -> Street:
        return Street(points, lanes=2, width=3.5, shoulder=1.5, sidewalk=2.0, limit=45.0, radius=40.0)

    size, xs, ys = 400.0, (125.0, 270.0), (140.0, 275.0)
    streets = [
        ring(((xs[0], 0.0), (xs[1], 0.0))),
        ring(((xs[1], 0.0), (size, 0.0), (size, ys[0]))),
        ring(((size, ys[0]), (size, ys[1]))),
        ring(((size, ys[1]), (size, size), (xs[1], size))),
        ring(((xs[1], size), (xs[0], size))),
        ring(((xs[0], size), (0.0, size), (0.0, ys[1]))),
        ring(((0.0, ys[1]), (0.0, ys[0]))),
        ring(((0.0, ys[0]), (0.0, 0.0), (xs[0], 0.0))),
    ]
    for x in xs:
        streets += _chain([(x, 0.0), (x, ys[0]), (x, ys[1]), (x, size)], street)
    for y in ys:
        streets += _chain([(0.0, y), (xs[0], y), (xs[1], y), (size, y)], street)
    inner = tuple((x, y) for x in xs for y in ys)
    return Town("Crossgate", tuple(streets), signalled=(*inner, (xs[0], 0.0), (size, ys[1])))


def proving_ground() -> Town:
    """A grid of 2 + 2 lanes that cross every 200 m, and a country road of 1 + 1 lanes to the east.

    Opposing lanes lie side by side. The grid is 600 x 600 m; the country road leaves it at (600, 200), runs 200 m
    straight, bends north, and comes back at (600, 400).
    """

    def street(points: tuple[Point, ...]) -> Street:
        return Street(points, lanes=2, width=3.5, shoulder=0.5, sidewalk=3.0, limit=40.0, radius=40.0)

    step = (0.0, 200.0, 400.0, 600.0)
    low, a, b, high = step
    streets = [
        street(((a, low), (b, low))),
        street(((b, low), (high, low), (high, a))),
        street(((high, a), (high, b))),
        street(((high, b), (high, high), (b, high))),
        street(((b, high), (a, high))),
        street(((a, high), (low, high), (low, b))),
        street(((low, b), (low, a))),
        street(((low, a), (low, low), (a, low))),
    ]
    for at in (a, b):
        streets += _chain([(at, y) for y in step], street)
        streets += _chain([(x, at) for x in step], street)
    country = ((high, a), (high + 260.0, a), (high + 260.0, b), (high, b))
    streets.append(Street(country, lanes=1, width=3.5, shoulder=1.5, sidewalk=0.0, limit=40.0, radius=40.0))
    inner = tuple((x, y) for x in (a, b) for y in (a, b))
    return Town("ProvingGround", tuple(streets), signalled=(*inner, (a, low), (b, high), (high, a), (low, b)))


TOWNS: dict[str, Callable[[], Town]] = {
    "Twinford": twinford,
    "Crossgate": crossgate,
    "ProvingGround": proving_ground,
}


def generate_town(name: str) -> str:
    """OpenDRIVE 1.4 text of a built-in town. UnknownNameError."""
    if name not in TOWNS:
        raise unknown_name("town", name, TOWNS)
    return write_town(TOWNS[name]())


def main(folder: str) -> None:
    """Write every built-in town as NAME.xodr and NAME.npz."""
    for name in TOWNS:
        path = Path(folder) / f"{name}.xodr"
        write_atomic(path, generate_town(name))
        save_graph(bake(path, name), path.with_suffix(".npz"))


if __name__ == "__main__":
    main(sys.argv[1])
