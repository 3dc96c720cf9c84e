"""Towns that ship with SSAD, defined in code, and their OpenDRIVE; `benchmarks/make_towns.py` bakes them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

from ssad.core.errors import unknown_name
from ssad.world.roads.writer import write_town
from ssad.world.roads.writer_parts import Interchange, Point, RoadSpec, Roundabout, Town


def _chain(stops: list[Point], make: Callable[[tuple[Point, ...]], RoadSpec]) -> list[RoadSpec]:
    """Return streets between consecutive stops."""
    return [make((start, end)) for start, end in pairwise(stops)]


def twinford() -> Town:
    """Return a town of two-lane streets and T-junctions, about 240 x 220 m, in the spirit of CARLA's Town02."""

    def street(points: tuple[Point, ...]) -> RoadSpec:
        return RoadSpec(points, lanes=1, width=3.75, shoulder=0.5, sidewalk=3.0, limit=25.0, radius=18.0)

    west, middle, east = 0.0, 120.0, 240.0
    streets = [
        # outer loop, cut where an inner street meets it
        street(((middle, 0.0), (west, 0.0), (west, 120.0))),
        street(((west, 120.0), (west, 220.0), (middle, 220.0))),
        street(((middle, 220.0), (east, 220.0), (east, 165.0))),
        street(((east, 165.0), (east, 60.0))),
        street(((east, 60.0), (east, 0.0), (middle, 0.0))),
        *_chain([(middle, 0.0), (middle, 60.0), (middle, 120.0), (middle, 165.0), (middle, 220.0)], street),
        street(((west, 120.0), (middle, 120.0))),
        street(((middle, 60.0), (east, 60.0))),
        street(((middle, 165.0), (east, 165.0))),
    ]
    return Town("Twinford", tuple(streets), signalled=((middle, 0.0), (middle, 120.0), (middle, 60.0), (east, 165.0)))


def crossgate() -> Town:
    """Return streets of 2 + 2 lanes: four signalled crossroads in an outer ring, 400 x 400 m; like CARLA's Town05."""

    def street(points: tuple[Point, ...]) -> RoadSpec:
        return RoadSpec(points, lanes=2, width=3.5, shoulder=0.5, sidewalk=3.0, limit=35.0, radius=30.0)

    def ring(points: tuple[Point, ...]) -> RoadSpec:
        return RoadSpec(points, lanes=2, width=3.5, shoulder=1.5, sidewalk=2.0, limit=45.0, radius=40.0)

    size, x_positions, y_positions = 400.0, (125.0, 270.0), (140.0, 275.0)
    streets = [
        ring(((x_positions[0], 0.0), (x_positions[1], 0.0))),
        ring(((x_positions[1], 0.0), (size, 0.0), (size, y_positions[0]))),
        ring(((size, y_positions[0]), (size, y_positions[1]))),
        ring(((size, y_positions[1]), (size, size), (x_positions[1], size))),
        ring(((x_positions[1], size), (x_positions[0], size))),
        ring(((x_positions[0], size), (0.0, size), (0.0, y_positions[1]))),
        ring(((0.0, y_positions[1]), (0.0, y_positions[0]))),
        ring(((0.0, y_positions[0]), (0.0, 0.0), (x_positions[0], 0.0))),
    ]
    for x in x_positions:
        streets += _chain([(x, 0.0), (x, y_positions[0]), (x, y_positions[1]), (x, size)], street)
    for y in y_positions:
        streets += _chain([(0.0, y), (x_positions[0], y), (x_positions[1], y), (size, y)], street)
    inner = tuple((x, y) for x in x_positions for y in y_positions)
    return Town("Crossgate", tuple(streets), signalled=(*inner, (x_positions[0], 0.0), (size, y_positions[1])))


def proving_ground() -> Town:
    """Return a grid of 2 + 2 lanes that cross every 200 m, and a country road of 1 + 1 lanes to the east.

    Opposing lanes lie side by side. The grid is 600 x 600 m; the country road leaves it at (600, 200), runs 200 m
    straight, bends north, and comes back at (600, 400).
    """

    def street(points: tuple[Point, ...]) -> RoadSpec:
        return RoadSpec(points, lanes=2, width=3.5, shoulder=0.5, sidewalk=3.0, limit=40.0, radius=40.0)

    grid = (0.0, 200.0, 400.0, 600.0)
    low, inner_low, inner_high, high = grid
    streets = [
        street(((inner_low, low), (inner_high, low))),
        street(((inner_high, low), (high, low), (high, inner_low))),
        street(((high, inner_low), (high, inner_high))),
        street(((high, inner_high), (high, high), (inner_high, high))),
        street(((inner_high, high), (inner_low, high))),
        street(((inner_low, high), (low, high), (low, inner_high))),
        street(((low, inner_high), (low, inner_low))),
        street(((low, inner_low), (low, low), (inner_low, low))),
    ]
    for position in (inner_low, inner_high):
        streets += _chain([(position, y) for y in grid], street)
        streets += _chain([(x, position) for x in grid], street)
    country = ((high, inner_low), (high + 260.0, inner_low), (high + 260.0, inner_high), (high, inner_high))
    streets.append(RoadSpec(country, lanes=1, width=3.5, shoulder=1.5, sidewalk=0.0, limit=40.0, radius=40.0))
    inner = tuple((x, y) for x in (inner_low, inner_high) for y in (inner_low, inner_high))
    return Town(
        "ProvingGround",
        tuple(streets),
        signalled=(*inner, (inner_low, low), (inner_high, high), (high, inner_low), (low, inner_high)),
    )


def crossover_points(a: Point, b: Point, *, lead: float, lateral: float = 0.0) -> tuple[Point, ...]:
    """Points of a street from a to b that leaves and arrives along one axis and crosses over between.

    Args:
        a: Where it begins, m.
        b: Where it ends, m.
        lead: From each end to where it turns, m. The axis is that of the longer side.
        lateral: How far to the left of the straight way from a to b it is in the middle, m; 0: no point is added there.
    """
    axis = (1.0, 0.0) if abs(b[0] - a[0]) > abs(b[1] - a[1]) else (0.0, 1.0)
    step = axis[0] * (b[0] - a[0]) + axis[1] * (b[1] - a[1])
    if not lateral and (abs(b[0] - a[0]) < 1e-9 or abs(b[1] - a[1]) < 1e-9):
        return a, b
    signed_lead = lead if step > 0.0 else -lead
    first_corner = (a[0] + signed_lead * axis[0], a[1] + signed_lead * axis[1])
    second_corner = (b[0] - signed_lead * axis[0], b[1] - signed_lead * axis[1])
    if not lateral:
        return a, first_corner, second_corner, b
    u, v = (
        (coordinate_end - coordinate_start) / math.dist(a, b)
        for coordinate_start, coordinate_end in zip(a, b, strict=True)
    )
    return a, first_corner, (0.5 * (a[0] + b[0]) - lateral * v, 0.5 * (a[1] + b[1]) + lateral * u), second_corner, b


def oldmarket() -> Town:
    """Return an old town of narrow two-lane streets: short crooked blocks inside a crescent, about 280 x 260 m.

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
    stop_pairs = [
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
    streets = [street(crossover_points(start, end, lead=19.0)) for start, end in stop_pairs]
    streets += [
        crescent((south[0], (lower[0][0], south[0][1]), lower[0])),
        crescent((south[2], (lower[4][0], south[2][1]), lower[4])),
        crescent((north[0], (upper[0][0], north[0][1]), upper[0])),
        crescent((north[1], (upper[3][0], north[1][1]), upper[3])),
    ]
    return Town("Oldmarket", tuple(streets), signalled=(lower[1], lower[3], upper[1], upper[2]))


def larkhill() -> Town:
    """Return a suburb of winding two-lane roads, with T-junctions and cul-de-sacs that end in a loop; 470 x 450 m."""

    def road(*points: Point) -> RoadSpec:
        return RoadSpec(points, lanes=1, width=3.5, shoulder=0.5, sidewalk=1.8, limit=25.0, radius=34.0)

    def close(*points: Point) -> RoadSpec:
        return RoadSpec(points, lanes=1, width=3.5, shoulder=0.5, sidewalk=1.8, limit=20.0, radius=13.0)

    def loop(head: Point, ahead: Point, aside: float) -> RoadSpec:
        """A street that leaves `head` sideways, runs round and comes back; ahead: m east and north to its far side."""
        (x, y), (u, v) = head, ahead
        side_x, side_y = (0.0, aside) if u else (aside, 0.0)
        return close(
            head,
            (x + side_x, y + side_y),
            (x + side_x + u, y + side_y + v),
            (x - side_x + u, y - side_y + v),
            (x - side_x, y - side_y),
            head,
        )

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
    """Return a motorway with two interchanges, and two-lane streets on both sides; 1,500 x 500 m.

    The motorway has 2 + 2 lanes, 3 + 3 between the interchanges, and begins and ends at a signalled T-junction. An
    interchange has an entry and an exit ramp, which meet the streets at signalled crossroads. The town is symmetric
    under a half turn.
    """

    def street(*points: Point) -> RoadSpec:
        return RoadSpec(points, lanes=1, width=3.5, shoulder=0.5, sidewalk=2.0, limit=35.0, radius=30.0)

    def ramp(*points: Point) -> RoadSpec:
        return RoadSpec(points, lanes=1, width=3.75, shoulder=2.0, sidewalk=0.0, limit=40.0, radius=60.0, one_way=True)

    def motorway(*points: Point, lanes: int, limit: float) -> RoadSpec:
        return RoadSpec(points, lanes, 3.75, 2.0, 0.0, limit, radius=500.0, median=4.0)

    def turned(point: Point) -> Point:
        return 1500.0 - point[0], 60.0 - point[1]

    motorway_end, interchange = (0.0, 0.0), (350.0, 0.0)
    entry_ramp, exit_ramp = (348.0, -9.5), (348.0, 9.5)  # beside the outermost lane of the narrower part
    south, north = (150.0, -110.0), (150.0, 110.0)
    mill, mill_end, park, hill = (420.0, -110.0), (420.0, -220.0), (700.0, -110.0), (1000.0, -50.0)
    far_street = turned(north)
    half_town = [
        motorway(motorway_end, interchange, lanes=2, limit=50.0),
        ramp(south, (150.0, -50.0), (285.0, -9.5), entry_ramp),
        ramp(exit_ramp, (285.0, 9.5), (150.0, 50.0), north),
        street(motorway_end, (0.0, -110.0), south),
        street(motorway_end, (0.0, 110.0), north),
        street(south, mill),
        street(mill, park),
        street(park, (780.0, -110.0), (920.0, -50.0), hill),
        street(hill, far_street),
        street(south, (150.0, -220.0), mill_end),
        street(mill, mill_end),
        street(mill_end, (700.0, -220.0), park),
        street(hill, (1000.0, -150.0), (1350.0, -150.0), far_street),
    ]
    middle = motorway(interchange, (620.0, 0.0), (880.0, 60.0), turned(interchange), lanes=3, limit=60.0)
    # The other half is the same turned by half a turn about the middle.
    mirrored_half = [replace(road, points=tuple(turned(point) for point in road.points)) for road in half_town]
    signalled_places = (motorway_end, south, north)
    return Town(
        "Longreach",
        (*half_town, middle, *mirrored_half),
        signalled=(*signalled_places, *(turned(place) for place in signalled_places)),
        interchanges=(
            Interchange(interchange, entry_ramp, exit_ramp),
            Interchange(turned(interchange), turned(entry_ramp), turned(exit_ramp)),
        ),
    )


def high_speed_track() -> Town:
    """Return an oval of 2 + 2 lanes without signals, for test protocols up to 40 m/s; 2,400 x 300 m.

    Its southern straight runs along y = 0 for 2,120 m; opposing lanes lie side by side.
    """

    def track(*points: Point) -> RoadSpec:
        return RoadSpec(points, lanes=2, width=3.5, shoulder=1.5, sidewalk=0.0, limit=90.0, radius=140.0)

    west, east, depth = -200.0, 2200.0, 300.0
    first, second = (500.0, depth), (1500.0, depth)
    oval = track(second, (east, depth), (east, 0.0), (west, 0.0), (west, depth), first)
    return Town("HighSpeedTrack", (oval, track(first, second)))


DESIGNS: dict[str, Callable[[], Town]] = {
    "Twinford": twinford,
    "Crossgate": crossgate,
    "ProvingGround": proving_ground,
    "Oldmarket": oldmarket,
    "Larkhill": larkhill,
    "Ringmere": ringmere,
    "Longreach": longreach,
    "HighSpeedTrack": high_speed_track,
}


def generate_town(name: str) -> str:
    """Return the OpenDRIVE 1.4 text of a built-in town. UnknownNameError."""
    if name not in DESIGNS:
        raise unknown_name("town", name, DESIGNS)
    return write_town(DESIGNS[name]())
