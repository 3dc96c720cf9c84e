"""Makes the shipped scenario sets: `python -m benchmarks.make_scenario_sets`.

Routes are searched on the towns' lane graphs: every stretch of road that a class needs (a clear lane, a lane with a
neighbour, a turn with crossing traffic), then those that lie farthest apart, so that arms, bends and junctions vary.
Of natural traffic, those draws are taken in which the schedules of vehicles cross that of the ego. No world is needed:
the choice depends on no driver's outcome and on no rule of the traffic.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Callable, Hashable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from benchmarks.crossing_traffic import scheduled_crossings
from ssad.core.errors import RouteError
from ssad.core.lane_graph import LaneGraph, SignKind
from ssad.core.safeio import write_atomic
from ssad.core.types import F64, LaneType, Pose, Scenario, TrafficPlan
from ssad.scenarios.dynamic.catalogue import PRECRASH
from ssad.scenarios.dynamic.episode import build_episode
from ssad.scenarios.dynamic.knowledge._caching import cached_by_identity
from ssad.scenarios.dynamic.knowledge._placing import turn_of, wrap_scalar
from ssad.scenarios.dynamic.knowledge.natural_junction import spawn_candidates
from ssad.scenarios.dynamic.sets import DATA
from ssad.scenarios.dynamic.yamlio import scenario_text
from ssad.world.roads import load_town

PRECRASH_TOWN = "ProvingGround"
NATURAL_TOWNS: Mapping[str, int] = {"Twinford": 34, "Crossgate": 160}
"""Town -> number of junction routes: all that there are."""
NATURAL = 150  # scenarios of each natural set, as many as FREA has
CROSSING = 2  # vehicles and cyclists that cross in each scenario of `natural`: one may be held up by others
MAX_DRAWS = 40  # draws of traffic that are tried on a route for each scenario
TRAFFIC = TrafficPlan(intensity=0.6, drivers="population", walkers=16, cyclists=2)
"""Traffic of the natural sets.

Twice FREA's share of the spawn places: in Crossgate a vehicle on about 70 m of a lane at 8 m/s, which is 400 an hour,
half of what a lane at a signal can carry. Twinford's blocks have room for half as many. There are about 900 m of
sidewalk near a route: 16 walkers are about 85 an hour past each point. Two cyclists, so that most scenarios have one.
"""
SIGN_TOWNS: Mapping[str, int] = {"Oldmarket": 12, "Larkhill": 12}
"""Town -> number of ways past a stop sign; no detector of ours has learned from pictures of these towns."""
TRAINING_TOWNS = ("Oldmarket", "Larkhill", "Ringmere", "Longreach")
"""Learned drivers are trained here, on none of the towns that the other sets are in."""
LANE_TOWNS = ("Random4", "Random11", "Random13", "Random14", "Random15", "Random20")
"""The first random towns with two lanes a direction: adversaries learn here too, on lanes beside the ego's."""
Turn = Literal["left", "straight", "right"]
# Trigger distances, m, at which an ego that does not react is hit at any speed from 8 to 10 m/s on these roads. The
# others keep SafeBench's value, which is the default of their class.
_TRIGGERS: Mapping[tuple[str, Turn | None], float] = {
    ("StraightObstacle", None): 16.0,
    ("TurningObstacle", "left"): 22.0,
    ("TurningObstacle", "right"): 17.0,
    ("RedlightRunning", "straight"): 36.0,
    ("CrossingNegotiation", "straight"): 36.0,
}
_HEADING = 20.0  # m that half a turn counts when routes are compared
_MARGIN = 2.0  # m kept free at the ends of a road


@dataclass(frozen=True)
class Stretch:
    """A way along lanes: key points, where its trigger is, and what it passes."""

    points: tuple[Pose, ...]
    trigger: Pose
    turn: Turn | None
    junction: int
    lanes: tuple[int, ...]

    def place(self) -> F64:
        """Numbers [6] whose distance says how different two stretches are, about in metres."""
        a, b = self.points[0], self.points[-1]
        return np.array([a.x, a.y, b.x, b.y, _HEADING * math.cos(a.yaw), _HEADING * math.sin(a.yaw)], dtype=np.float64)


def _pose(graph: LaneGraph, lane: int, s: float) -> Pose:
    """A pose on a lane, rounded so that the files stay readable (1 cm, 0.01 degrees)."""
    x, y, yaw, _ = graph.at(lane, s)
    return Pose(round(x, 2) + 0.0, round(y, 2) + 0.0, round(wrap_scalar(yaw), 4) + 0.0)


def _clear(graph: LaneGraph, lane: int) -> bool:
    return bool(graph.kind[lane] == LaneType.DRIVING and graph.junction[lane] < 0)


def _extend(graph: LaneGraph, lane: int, length: float, *, forward: bool) -> tuple[list[int], float]:
    """The lane and those that go on from it outside junctions while there is no choice, and their length, m."""
    lanes, total = [lane], float(graph.length[lane])
    while total < length:
        options = graph.successors(lanes[-1]) if forward else graph.predecessors(lanes[0])
        clear = [int(n) for n in options if _clear(graph, int(n))]
        if len(clear) != 1 or clear[0] in lanes:
            break
        lanes = [*lanes, clear[0]] if forward else [clear[0], *lanes]
        total += float(graph.length[clear[0]])
    return lanes, total


def _along(graph: LaneGraph, lanes: list[int], s: float) -> Pose:
    """The pose at arc length s of lanes that follow each other."""
    for lane in lanes[:-1]:
        if s <= float(graph.length[lane]):
            return _pose(graph, lane, s)
        s -= float(graph.length[lane])
    return _pose(graph, lanes[-1], s)


def stretches(graph: LaneGraph, length: float, trigger: float) -> Iterator[Stretch]:
    """Ways of `length` m on driving lanes outside junctions, one every 20 m along each lane."""
    for lane in range(graph.lane_count):
        if not _clear(graph, lane):
            continue
        for start in np.arange(_MARGIN, float(graph.length[lane]), 20.0).tolist():
            lanes, total = _extend(graph, lane, start + length + _MARGIN, forward=True)
            if total < start + length + _MARGIN:
                continue
            first, mark, last = (_along(graph, lanes, start + at) for at in (0.0, trigger, length))
            yield Stretch((first, last), mark, None, -1, tuple(lanes))


def passages(graph: LaneGraph, before: float, after: float) -> Iterator[Stretch]:
    """Ways through one junction: `before` m on the approach, a turn, `after` m on the exit."""
    for inside in np.flatnonzero((graph.junction >= 0) & (graph.kind == LaneType.DRIVING)).tolist():
        for approach, leave in itertools.product(graph.predecessors(inside), graph.successors(inside)):
            if not (_clear(graph, int(approach)) and _clear(graph, int(leave))):
                continue
            to, end = _extend(graph, int(approach), before + _MARGIN, forward=False)
            on, free = _extend(graph, int(leave), after + _MARGIN, forward=True)
            if end < before + _MARGIN or free < after + _MARGIN:
                continue
            angle = math.degrees(turn_of(graph, inside))
            turn: Turn = "straight" if abs(angle) < 30.0 else "left" if angle > 0.0 else "right"
            points = (
                _along(graph, to, end - before),
                _along(graph, to, end - 2.0),
                _along(graph, on, 2.0),
                _along(graph, on, after),
            )
            trigger = _along(graph, to, end - min(before - 20.0, 20.0))
            yield Stretch(points, trigger, turn, int(graph.junction[inside]), (*to, inside, *on))


def _left_of(graph: LaneGraph, stretch: Stretch, *, same: bool) -> bool:
    """Whether each lane of a stretch has a driving lane to its left that runs the same (the other) way."""
    for lane in stretch.lanes:
        left = int(graph.left[lane])
        if left < 0 or graph.kind[left] != LaneType.DRIVING or graph.is_same_direction(lane, left) != same:
            return False
    return True


def _outermost(graph: LaneGraph, stretch: Stretch) -> bool:
    right = [int(graph.right[lane]) for lane in stretch.lanes]
    return all(n < 0 or graph.kind[n] != LaneType.DRIVING for n in right)


def _pool(graph: LaneGraph, kind: str) -> list[Stretch]:
    """Every stretch that a class can be played on, by road alone. Lengths as SafeBench's routes have them."""
    ways: dict[str, Callable[[], Iterator[Stretch]]] = {
        "StraightObstacle": lambda: (p for p in stretches(graph, 100.0, 30.0) if _outermost(graph, p)),
        "LaneChanging": lambda: (p for p in stretches(graph, 130.0, 30.0) if _left_of(graph, p, same=True)),
        "VehiclePassing": lambda: (p for p in stretches(graph, 148.0, 50.0) if _left_of(graph, p, same=False)),
        "TurningObstacle": lambda: (p for p in passages(graph, 40.0, 35.0) if p.turn != "straight"),
        "RedlightRunning": lambda: (p for p in passages(graph, 50.0, 40.0) if p.turn == "straight"),
        "UnprotectedLeftTurn": lambda: (p for p in passages(graph, 50.0, 45.0) if p.turn == "left"),
        "RightTurn": lambda: (p for p in passages(graph, 50.0, 45.0) if p.turn == "right"),
        "CrossingNegotiation": lambda: (p for p in passages(graph, 60.0, 40.0) if p.turn == "straight"),
    }
    return list(ways[kind]())


def _look(graph: LaneGraph, stretch: Stretch) -> tuple[bool, bool, str]:
    """What kind of road a stretch is: bent, more than one lane a direction, which turn."""
    a, b = stretch.points[0], stretch.points[-1]
    bent = stretch.turn is None and abs(wrap_scalar(b.yaw - a.yaw)) > math.radians(20.0)
    lane = stretch.lanes[0]
    beside = [int(n) for n in (graph.left[lane], graph.right[lane]) if n >= 0]
    wide = any(graph.kind[n] == LaneType.DRIVING and graph.is_same_direction(lane, n) for n in beside)
    return bent, not wide, stretch.turn or ""


def _farthest(pool: list[Stretch], chosen: list[Stretch], works: Callable[[Stretch], bool]) -> Stretch | None:
    """The stretch that works and lies farthest from those chosen; of equals the first."""
    near = [min((float(np.linalg.norm(p.place() - c.place())) for c in chosen), default=0.0) for p in pool]
    order = sorted(range(len(pool)), key=lambda i: -near[i])
    return next((pool[i] for i in order if pool[i] not in chosen and works(pool[i])), None)


def _spread(
    pool: list[Stretch], kind_of: Callable[[Stretch], Hashable], count: int, works: Callable[[Stretch], bool]
) -> list[Stretch]:
    """`count` stretches that work: kinds in rotation, of each the farthest from those before it; fewer if there are
    no more."""
    kinds: dict[Hashable, list[Stretch]] = {}
    for p in pool:
        kinds.setdefault(kind_of(p), []).append(p)
    rotation = deque(kinds[k] for k in sorted(kinds, key=str))
    chosen: list[Stretch] = []
    while rotation and len(chosen) < count:
        like = rotation.popleft()
        found = _farthest(like, chosen, works)
        if found is not None:
            chosen.append(found)
            rotation.append(like)
    return chosen


def precrash(graph: LaneGraph, routes: int = 4, *, prefix: str = "", least: int | None = None) -> list[Scenario]:
    """The eight classes, `routes` scenarios each; where the town has no more, at least `least` (default: `routes`)."""
    result = []
    for kind in PRECRASH:

        def scenario(stretch: Stretch, number: int, kind: str = kind) -> Scenario:
            tuned = _TRIGGERS.get((kind, stretch.turn))
            return Scenario(
                name=f"{prefix}{kind}/{number:02d}",
                type=kind,
                town=graph.name,
                route=stretch.points,
                trigger=stretch.trigger,
                parameters={} if tuned is None else {"trigger_distance": tuned},
                group=kind,
            )

        def works(stretch: Stretch, kind: str = kind) -> bool:
            try:
                build_episode(scenario(stretch, 0, kind), graph, seed=0)
            except RouteError:
                return False
            return True

        chosen = _spread(_pool(graph, kind), lambda p: _look(graph, p), routes, works)
        if len(chosen) < (routes if least is None else least):
            raise RouteError(f"town {graph.name}: only {len(chosen)} of {routes} roads for {kind}")
        result += [scenario(stretch, i, kind) for i, stretch in enumerate(chosen)]
    return result


@cached_by_identity(16)
def junction_routes(graph: LaneGraph, routes: int) -> tuple[Stretch, ...]:
    """Routes through junctions, turns in rotation, on which traffic has room."""
    from ssad.world.roads import route_along

    def works(stretch: Stretch) -> bool:
        try:
            found = spawn_candidates(graph, route_along(graph, stretch.points))
        except RouteError:
            return False
        return len(found) >= 4

    chosen = _spread(list(passages(graph, 30.0, 30.0)), lambda p: p.turn, routes, works)
    if len(chosen) < routes:
        raise RouteError(f"town {graph.name}: only {len(chosen)} of {routes} junction routes")
    return tuple(chosen)


def past_stop_signs(towns: Mapping[str, int]) -> list[Scenario]:
    """Ways through junctions that begin before a stop sign, turns in rotation, with traffic as it comes."""
    found = []
    for town, routes in towns.items():
        graph = load_town(town)
        signed = graph.rule_lane[graph.sign_kind[graph.rule_sign] == SignKind.STOP]
        pool = [p for p in passages(graph, 32.0, 30.0) if np.isin(_approach(graph, p), signed)]
        for i, stretch in enumerate(_spread(pool, lambda p: p.turn, routes, lambda _: True)):
            name, points = f"stop-signs/{town}_{i:02d}", stretch.points
            found.append(Scenario(name, "NaturalJunction", town, points, seed=i, group=town))
    return found


STRAIGHTS = {"Longreach": (22.0, 15.0, 175.0), "ProvingGround": (16.0, 15.0, 165.0), "Ringmere": (12.0, 10.0, 160.0)}
"""Town -> target speed, m/s, and the part of its longest lanes that is straight, m."""
BENDS = {
    "Longreach": (22.0, 180.0, 420.0),
    "ProvingGround": (15.0, 150.0, 330.0),
    "Ringmere": (11.0, 120.0, 290.0),
    "Larkhill": (10.0, 15.0, 255.0),
}
"""The same, of parts with a bend."""


def marked_roads() -> list[Scenario]:
    """Return drives without other road users along marked roads without junctions: straight ones first, then bends."""
    found = []
    for name, parts, lanes in (("straight", STRAIGHTS, 2), ("bend", BENDS, 1)):
        for town, (speed, start, end) in parts.items():
            graph = load_town(town)
            is_road = (graph.kind == LaneType.DRIVING) & (graph.junction < 0)
            longest = sorted(np.flatnonzero(is_road).tolist(), key=lambda lane: (-float(graph.length[lane]), lane))
            for number, lane in enumerate(longest[:lanes]):
                places = np.linspace(start, end, max(int((end - start) / 50.0), 1) + 1)
                route = tuple(_pose(graph, lane, float(place)) for place in places)
                title = f"lane-keeping/{town}_{name}_{number:02d}"
                found.append(Scenario(title, "Custom", town, route, target_speed=speed, group=name))
    return found


def _approach(graph: LaneGraph, passage: Stretch) -> int:
    """The last lane before a junction."""
    inside = next(k for k, lane in enumerate(passage.lanes) if graph.junction[lane] >= 0)
    return passage.lanes[inside - 1]


def natural(graph: LaneGraph, routes: int, number: int = 0) -> list[Scenario]:
    """Return the junction routes of a town with draw `number` of traffic, another one in every episode."""
    return [
        Scenario(
            name=f"natural/{graph.name}_{i:02d}/{number:02d}",
            type="NaturalJunction",
            town=graph.name,
            route=stretch.points,
            seed=number,
            traffic=TRAFFIC,
            group=graph.name,
        )
        for i, stretch in enumerate(junction_routes(graph, routes))
    ]


def fixed(scenario: Scenario, number: int) -> Scenario:
    """Return a scenario of `natural` with draw `number` of traffic in every episode."""
    plan = replace(TRAFFIC, draw=number)
    return replace(scenario, name=f"{scenario.name[:-2]}{number:02d}", seed=0, traffic=plan)


def crosses(scenario: Scenario, graph: LaneGraph) -> bool:
    """Return whether vehicles or cyclists cross the ego's way by their schedules."""
    assert scenario.traffic is not None
    # walkers do not count, and the others are drawn the same without them
    riders = replace(scenario, traffic=replace(scenario.traffic, walkers=0))
    return scheduled_crossings(build_episode(riders, graph, seed=0)) >= CROSSING


def crossing_draws(scenario: Scenario, graph: LaneGraph) -> Iterator[Scenario]:
    """Yield the draws of traffic on a route in which vehicles cross the ego's way, up to draw 40."""
    for number in range(MAX_DRAWS):
        draw = fixed(scenario, number)
        if crosses(draw, graph):
            yield draw


def with_crossing_traffic(towns: Mapping[str, int], count: int) -> list[Scenario]:
    """Return `count` draws of traffic in which vehicles cross the ego's way.

    Of every route the first such draw is taken, then the second of each, and so on; town by town.

    Args:
        towns: Town -> number of junction routes.
        count: Number of scenarios.

    Raises:
        RouteError: The routes do not have so many.
    """
    graphs = {town: load_town(town) for town in towns}
    routes = [s for town, number in towns.items() for s in natural(graphs[town], number)]
    searches = [crossing_draws(scenario, graphs[scenario.town]) for scenario in routes]
    chosen: list[Scenario] = []
    while len(chosen) < count:
        draws = [draw for search in searches if (draw := next(search, None)) is not None]
        if not draws:
            raise RouteError(f"only {len(chosen)} of {count} draws in which traffic crosses the way; take more routes")
        chosen += draws[: count - len(chosen)]
    return chosen


def unselected(towns: Mapping[str, int], count: int) -> list[Scenario]:
    """Return draws of traffic on the same routes as they come, other ones in every episode."""
    rounds = itertools.count()
    draws = (s for number in rounds for town, routes in towns.items() for s in natural(load_town(town), routes, number))
    return [
        replace(s, name=s.name.replace("natural/", "natural-unselected/"), seed=1000 + s.seed)
        for s in itertools.islice(draws, count)
    ]


def training() -> dict[str, str]:
    """What drivers learn from, as `make`: the eight classes as far as the towns have roads for them, and junctions.

    And what FREA learns in: junctions of towns with parallel lanes, which those towns hardly have.
    """
    found = []
    lanes = [s for town in LANE_TOWNS for s in natural(load_town(town), 12)]
    for town in TRAINING_TOWNS:
        graph = load_town(town)
        drives = [replace(s, name=f"training/{s.name}") for s in natural(graph, 12)]
        found += [*precrash(graph, 6, prefix=f"training/{town}/", least=0), *drives]
    beside = [replace(s, name=f"training-lanes/{s.name}") for s in lanes]
    return {"training.yaml": scenario_text(found), "training-lanes.yaml": scenario_text(beside)}


def make() -> dict[str, str]:
    """File name -> text of the shipped sets that systems are tested on."""
    return {
        "precrash.yaml": scenario_text(precrash(load_town(PRECRASH_TOWN))),
        "natural.yaml": scenario_text(with_crossing_traffic(NATURAL_TOWNS, NATURAL)),
        "natural-unselected.yaml": scenario_text(unselected(NATURAL_TOWNS, NATURAL)),
        "stop-signs.yaml": scenario_text(past_stop_signs(SIGN_TOWNS)),
        "lane-keeping.yaml": scenario_text(marked_roads()),
    }


def main(folder: Path = DATA) -> None:
    """Write the shipped sets."""
    for name, text in (make() | training()).items():
        write_atomic(folder / name, text)


if __name__ == "__main__":
    main()
