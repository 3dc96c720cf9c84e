"""The towns that ship with SSAD, as code, and their OpenDRIVE; `benchmarks/make_towns.py` bakes them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

from ssad.core.errors import unknown_name
from ssad.world.roads.writer import write_town
from ssad.world.roads.writer_parts import Interchange, Point, RoadSpec, Roundabout, Town


def _chain(stops: list[Point], make: Callable[[tuple[Point, ...]], RoadSpec]) -> list[RoadSpec]:
    """Streets from stop to stop."""
    return [make((a, b)) for a, b in pairwise(stops)]


def twinford() -> Town:
    """Two-lane streets and T-junctions, about 240 x 220 m, in the spirit of CARLA's Town02."""

    def street(points: tuple[Point, ...]) -> RoadSpec:
        return RoadSpec(points, lanes=1, width=3.75, shoulder=0.5, sidewalk=3.0, limit=25.0, radius=18.0)

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

    def street(points: tuple[Point, ...]) -> RoadSpec:
        return RoadSpec(points, lanes=2, width=3.5, shoulder=0.5, sidewalk=3.0, limit=35.0, radius=30.0)

    def ring(points: tuple[Point, ...]) -> RoadSpec:
        return RoadSpec(points, lanes=2, width=3.5, shoulder=1.5, sidewalk=2.0, limit=45.0, radius=40.0)

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

    def street(points: tuple[Point, ...]) -> RoadSpec:
        return RoadSpec(points, lanes=2, width=3.5, shoulder=0.5, sidewalk=3.0, limit=40.0, radius=40.0)

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
    streets.append(RoadSpec(country, lanes=1, width=3.5, shoulder=1.5, sidewalk=0.0, limit=40.0, radius=40.0))
    inner = tuple((x, y) for x in (a, b) for y in (a, b))
    return Town("ProvingGround", tuple(streets), signalled=(*inner, (a, low), (b, high), (high, a), (low, b)))


def shifted(a: Point, b: Point, *, lead: float, aside: float = 0.0) -> tuple[Point, ...]:
    """Points of a street from a to b that leaves and arrives along one axis and crosses over between.

    Args:
        a: Where it begins, m.
        b: Where it ends, m.
        lead: From each end to where it turns, m. The axis is that of the longer side.
        aside: How far to the left of the straight way from a to b it is in the middle, m; 0: no point is added there.
    """
    along = (1.0, 0.0) if abs(b[0] - a[0]) > abs(b[1] - a[1]) else (0.0, 1.0)
    step = along[0] * (b[0] - a[0]) + along[1] * (b[1] - a[1])
    if not aside and (abs(b[0] - a[0]) < 1e-9 or abs(b[1] - a[1]) < 1e-9):
        return a, b
    sign = lead if step > 0.0 else -lead
    one = (a[0] + sign * along[0], a[1] + sign * along[1])
    two = (b[0] - sign * along[0], b[1] - sign * along[1])
    if not aside:
        return a, one, two, b
    u, v = ((end - start) / math.dist(a, b) for start, end in zip(a, b, strict=True))
    return a, one, (0.5 * (a[0] + b[0]) - aside * v, 0.5 * (a[1] + b[1]) + aside * u), two, b


def oldmarket() -> Town:
    """Narrow two-lane streets of an old town: short crooked blocks inside a crescent, about 280 x 260 m.

    Junctions lie off the grid by some metres, so that no street is straight for long. The market is the large block.
    """

    def street(points: tuple[Point, ...]) -> RoadSpec:
        return RoadSpec(points, lanes=1, width=3.25, shoulder=0.5, sidewalk=2.2, limit=20.0, radius=22.0)

    def crescent(points: tuple[Point, ...]) -> RoadSpec:
        return RoadSpec(points, lanes=1, width=3.25, shoulder=0.5, sidewalk=2.2, limit=20.0, radius=48.0)

    # rows from south to north, junctions from west to east
    south: list[Point] = [(80.0, 0.0), (146.0, -6.0), (212.0, 2.0)]
    lower: list[Point] = [(0.0, 66.0), (74.0, 76.0), (144.0, 68.0), (206.0, 78.0), (280.0, 70.0)]
    middle: list[Point] = [(8.0, 128.0), (84.0, 136.0)]
    upper: list[Point] = [(0.0, 192.0), (78.0, 198.0), (196.0, 190.0), (294.0, 198.0)]
    north: list[Point] = [(86.0, 256.0), (214.0, 260.0)]
    pairs = [
        *pairwise(south),
        *pairwise(lower),
        *pairwise(middle),
        *pairwise(upper),
        *pairwise(north),
        *pairwise([south[0], lower[1], middle[1], upper[1], north[0]]),
        *pairwise([south[2], lower[3], upper[2], north[1]]),
        *pairwise([lower[0], middle[0], upper[0]]),
        (south[1], lower[2]),
        (lower[4], upper[3]),
    ]
    streets = [street(shifted(a, b, lead=19.0)) for a, b in pairs]
    streets += [
        crescent((south[0], (lower[0][0], south[0][1]), lower[0])),
        crescent((south[2], (lower[4][0], south[2][1]), lower[4])),
        crescent((north[0], (upper[0][0], north[0][1]), upper[0])),
        crescent((north[1], (upper[3][0], north[1][1]), upper[3])),
    ]
    return Town("Oldmarket", tuple(streets), signalled=(lower[1], lower[3], upper[1], upper[2]))


def larkhill() -> Town:
    """A suburb of two-lane roads that wind, with T-junctions and cul-de-sacs that end in a loop; 470 x 450 m."""

    def road(*points: Point) -> RoadSpec:
        return RoadSpec(points, lanes=1, width=3.5, shoulder=0.5, sidewalk=1.8, limit=25.0, radius=34.0)

    def close(*points: Point) -> RoadSpec:
        return RoadSpec(points, lanes=1, width=3.5, shoulder=0.5, sidewalk=1.8, limit=20.0, radius=13.0)

    def loop(head: Point, ahead: Point, aside: float) -> RoadSpec:
        """A street that leaves `head` sideways, runs round and comes back; ahead: m east and north to its far side."""
        (x, y), (u, v) = head, ahead
        a, b = (0.0, aside) if u else (aside, 0.0)
        return close(head, (x + a, y + b), (x + a + u, y + b + v), (x - a + u, y - b + v), (x - a, y - b), head)

    south, lane, east = (120.0, 20.0), (245.0, 0.0), (335.0, 12.0)
    west, centre, fork, gate = (20.0, 180.0), (200.0, 160.0), (335.0, 176.0), (450.0, 190.0)
    north, birch, elm = (225.0, 335.0), (110.0, 322.0), (440.0, 290.0)
    heads = ((120.0, -48.0), (245.0, 62.0), (110.0, 262.0), (372.0, 290.0))
    streets = [
        road(south, (60.0, 20.0), (20.0, 80.0), west),
        road(south, (155.0, 20.0), (190.0, 0.0), lane),
        road(lane, (275.0, 0.0), (300.0, 12.0), east),
        road(east, (400.0, 12.0), (450.0, 70.0), (438.0, 115.0), (450.0, 150.0), gate),
        road(gate, (450.0, 225.0), (440.0, 255.0), elm),
        road(elm, (440.0, 372.0), (330.0, 372.0), (280.0, 335.0), north),
        road(north, (190.0, 335.0), (150.0, 322.0), birch),
        road(birch, (50.0, 322.0), (20.0, 260.0), west),
        road(west, (70.0, 180.0), (105.0, 200.0), (135.0, 190.0), (158.0, 160.0), centre),
        road(centre, (240.0, 160.0), (290.0, 176.0), fork),
        road(fork, (385.0, 176.0), (405.0, 190.0), gate),
        road(south, (120.0, 58.0), (150.0, 92.0), (200.0, 112.0), centre),
        road(centre, (200.0, 205.0), (240.0, 250.0), (225.0, 295.0), north),
        road(east, (335.0, 55.0), (310.0, 95.0), (335.0, 135.0), fork),
        close(south, heads[0]),
        close(lane, heads[1]),
        close(birch, heads[2]),
        close(elm, heads[3]),
        loop(heads[0], (0.0, -44.0), 30.0),
        loop(heads[1], (0.0, 40.0), 29.0),
        loop(heads[2], (0.0, -42.0), 30.0),
        loop(heads[3], (-46.0, 0.0), 30.0),
    ]
    return Town("Larkhill", tuple(streets), signalled=(south, centre, fork))


def ringmere() -> Town:
    """Two-lane streets of a small town with two roundabouts, one of four arms and one of three; 450 x 330 m."""

    def street(*points: Point) -> RoadSpec:
        return RoadSpec(points, lanes=1, width=3.5, shoulder=0.5, sidewalk=2.5, limit=30.0, radius=32.0)

    ring, east, west = (220.0, 170.0), (450.0, 170.0), (0.0, 150.0)
    north, south, cross = (220.0, 330.0), (220.0, 0.0), (340.0, 170.0)
    upper, lower = (340.0, 330.0), (340.0, 0.0)
    streets = [
        street(ring, (150.0, 170.0), (80.0, 150.0), west),
        street(ring, north),
        street(ring, south),
        street(ring, cross),
        street(cross, east),
        street(cross, upper),
        street(cross, lower),
        street(west, (0.0, 330.0), north),
        street(west, (0.0, 0.0), south),
        street(north, upper),
        street(south, lower),
        street(upper, (450.0, 330.0), east),
        street(lower, (450.0, 0.0), east),
    ]
    rings = (Roundabout(ring, 22.0), Roundabout(east, 20.0))
    return Town("Ringmere", tuple(streets), signalled=(cross, north, south), roundabouts=rings)


def longreach() -> Town:
    """A motorway of 2 + 2 lanes, 3 + 3 between its two interchanges, and two-lane streets on both sides; 1,500 x 500 m.

    The motorway begins and ends at a signalled T-junction. An interchange has a ramp on and a ramp off, which meet the
    streets at signalled crossroads. The town looks the same when it is turned by half a turn.
    """

    def street(*points: Point) -> RoadSpec:
        return RoadSpec(points, lanes=1, width=3.5, shoulder=0.5, sidewalk=2.0, limit=35.0, radius=30.0)

    def ramp(*points: Point) -> RoadSpec:
        return RoadSpec(points, lanes=1, width=3.75, shoulder=2.0, sidewalk=0.0, limit=40.0, radius=60.0, one_way=True)

    def motorway(*points: Point, lanes: int, limit: float) -> RoadSpec:
        return RoadSpec(points, lanes, 3.75, 2.0, 0.0, limit, radius=500.0, median=4.0)

    def turned(point: Point) -> Point:
        return 1500.0 - point[0], 60.0 - point[1]

    end, interchange = (0.0, 0.0), (350.0, 0.0)
    on, off = (348.0, -9.5), (348.0, 9.5)  # beside the outermost lane of the narrower part
    south, north = (150.0, -110.0), (150.0, 110.0)
    mill, mill_end, park, hill = (420.0, -110.0), (420.0, -220.0), (700.0, -110.0), (1000.0, -50.0)
    far = turned(north)
    half = [
        motorway(end, interchange, lanes=2, limit=50.0),
        ramp(south, (150.0, -50.0), (285.0, -9.5), on),
        ramp(off, (285.0, 9.5), (150.0, 50.0), north),
        street(end, (0.0, -110.0), south),
        street(end, (0.0, 110.0), north),
        street(south, mill),
        street(mill, park),
        street(park, (780.0, -110.0), (920.0, -50.0), hill),
        street(hill, far),
        street(south, (150.0, -220.0), mill_end),
        street(mill, mill_end),
        street(mill_end, (700.0, -220.0), park),
        street(hill, (1000.0, -150.0), (1350.0, -150.0), far),
    ]
    middle = motorway(interchange, (620.0, 0.0), (880.0, 60.0), turned(interchange), lanes=3, limit=60.0)
    other = [replace(road, points=tuple(turned(point) for point in road.points)) for road in half]
    lights = (end, south, north)
    return Town(
        "Longreach",
        (*half, middle, *other),
        signalled=(*lights, *(turned(place) for place in lights)),
        interchanges=(
            Interchange(interchange, on, off),
            Interchange(turned(interchange), turned(on), turned(off)),
        ),
    )


DESIGNS: dict[str, Callable[[], Town]] = {
    "Twinford": twinford,
    "Crossgate": crossgate,
    "ProvingGround": proving_ground,
    "Oldmarket": oldmarket,
    "Larkhill": larkhill,
    "Ringmere": ringmere,
    "Longreach": longreach,
}


def generate_town(name: str) -> str:
    """OpenDRIVE 1.4 text of a built-in town. UnknownNameError."""
    if name not in DESIGNS:
        raise unknown_name("town", name, DESIGNS)
    return write_town(DESIGNS[name]())
