"""Where a scenario of a leaderboard takes place: places on the ego's route, and who is put there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

from ssad.core.errors import RouteError
from ssad.core.lane_graph import LaneGraph
from ssad.core.rotations import wrap_angle
from ssad.core.types import F64, Actor, Condition, LaneType, Limits, Phase, Pose, Route, Scenario, SignalPlan
from ssad.scenarios.dynamic.knowledge._meeting import time_to_cover
from ssad.scenarios.dynamic.knowledge._placing import (
    Place,
    ahead,
    behind,
    beside,
    junction_span,
    lane_path,
    pose_at,
    route_place,
    shifted,
    turn_of,
    width_at,
)
from ssad.world.models import MODELS
from ssad.world.roads import route_along
from ssad.world.roads.query import nearest_all

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

    from ssad.interchange.openscenario_places import Values

SPEED: Final = 8.0  # m/s that the ego is taken to drive where the leaderboard measures seconds to a place
PICK_UP: Final = 2.5  # m/s^2 at which it is taken to start
LIMITS: Final = Limits(max_steps=900, max_time=90.0)
FLOW: Final = 45.0  # s for which cars of a flow keep coming
LONGEST: Final = 600.0  # m of the way of a flow
CARS: Final = ("compact", "coupe", "suv", "car")
_ROAD = (LaneType.DRIVING, LaneType.PARKING, LaneType.BIKING, LaneType.SHOULDER)
_NEAR = 10.0  # m from a lane within which a place of the file belongs to it
_THIN = math.radians(0.5)  # turn, and
_LONG = 20.0  # m, after which a trajectory has another row


@dataclass
class Site:
    """A scenario of a route file on its town, while its actors are put together.

    Attributes:
        scenario: Name, town, route and trigger.
        graph: Lane graph of the town.
        route: The ego's way.
        start: Point of the route at which the leaderboard starts the scenario.
        item: The element of the file.
        values: Reads its numbers.
        hand: -1 where y of the file points right.
        random: Draws what the leaderboard draws.
        used: Tags of numbers that were read.
        actors: Who takes part so far.
        signals: What the traffic lights show.
        target_speed: Of the ego, m/s.
    """

    scenario: Scenario
    graph: LaneGraph
    route: Route
    start: int
    item: Element
    values: Values
    random: np.random.Generator
    used: set[str] = field(default_factory=set)
    actors: list[Actor] = field(default_factory=list)
    signals: SignalPlan = field(default_factory=SignalPlan)
    target_speed: float = SPEED

    # ------------------------------------------------------------ the numbers of the file

    def number(self, tag: str, default: float, low: float, high: float) -> float:
        """The number `value` of a child. FormatError where it is none, or outside its range."""
        return self._bounded(tag, "value", default, low, high)

    def interval(self, tag: str, default: tuple[float, float], low: float, high: float) -> tuple[float, float]:
        """The numbers `from` and `to` of a child, or twice its `value`; FormatError as `number`."""
        told = self.item.find(tag)
        if told is not None and told.get("from") is None:
            value = self.number(tag, default[0], low, high)
            return value, value
        a, b = (self._bounded(tag, key, d, low, high) for key, d in zip(("from", "to"), default, strict=True))
        return min(a, b), max(a, b)

    def _bounded(self, tag: str, key: str, default: float, low: float, high: float) -> float:
        told = self.item.find(tag)
        self.used.add(tag)
        if told is None:
            return default
        value = self.values.number(told, key)
        if not low <= value <= high:
            raise self.values.fail(told, f"{key} is {value:g}, outside {low:g} to {high:g}")
        return value

    def word(self, tag: str, default: str, allowed: Sequence[str] = ()) -> str:
        """The text `value` of a child. FormatError where it is not allowed."""
        told = self.item.find(tag)
        self.used.add(tag)
        value = default if told is None else self.values.text(told, "value")
        if allowed and value not in allowed:
            raise self.values.fail(tag, f"'{value[:40]}' is not one of {', '.join(allowed)}")
        return value

    def side(self) -> float:
        """1 where the scenario comes from the right of the road, -1 from the left."""
        return 1.0 if self.word("direction", "right", ("left", "right")) == "right" else -1.0

    def lane_at(self, tag: str) -> Place:
        """The lane under a place of the file. FormatError where it is missing, RouteError off the road."""
        told = self.item.find(tag)
        self.used.add(tag)
        if told is None:
            raise self.values.fail(self.item, f"'{self.item.get('type')}' has no {tag}")
        xy = self.values.number(told, "x"), 0.0 - self.values.number(told, "y")
        lane, s, gap = nearest_all(self.graph, xy, (LaneType.DRIVING, LaneType.BIKING))
        k = int(np.argmin(gap))
        if gap[k] > _NEAR:
            raise self.fail(f"{tag} is {gap[k]:.0f} m off the road")
        return Place(int(lane[k]), float(s[k]))

    def fail(self, message: str) -> RouteError:
        """A RouteError that names the scenario."""
        return RouteError(f"scenario {self.scenario.name}: {message}")

    # ------------------------------------------------------------ places

    def point(self, distance: float, *, in_junction: bool = False) -> int:
        """The route point `distance` m after the trigger, before the next junction unless it may lie in one."""
        index = self.start + round(distance / self.route.spacing)
        if not in_junction:
            lanes = self.route.lane[self.start : index + 1]
            inside = np.flatnonzero((lanes >= 0) & (self.graph.junction[lanes] >= 0))
            if len(inside) and inside[0] > 0:
                index = self.start + int(inside[0]) - 1
        if index >= len(self.route.xy):
            raise self.fail(f"the route ends {index - len(self.route.xy) + 1:.0f} m before its place")
        return index

    def pose(self, index: int, right: float = 0.0, turn: float = 0.0) -> Pose:
        """The pose of a route point, moved to the right, m, and turned to the left, rad."""
        x, y = self.route.xy[index].tolist()
        return shifted(Pose(x, y, float(self.route.yaw[index])), 0.0, -right, turn)

    def place(self, index: int) -> Place:
        """The lane under a route point."""
        return route_place(self.graph, self.scenario, self.route, index)

    def width(self, index: int) -> float:
        """Width of the lane there, m."""
        return width_at(self.graph, self.place(index))

    def edge(self, index: int, side: float, kinds: Sequence[LaneType] = _ROAD) -> float:
        """How far to that side the last lane of these kinds ends, m; to the left it counts the oncoming ones."""
        here, pose = self.place(index), self.pose(index)
        last, along = here, "right" if side > 0.0 else "left"
        while (after := beside(self.graph, last, along)) is not None and self.graph.kind[after.lane] in kinds:
            if not self.graph.same_direction(last.lane, after.lane):
                along = "right"
            last = after
        other = pose_at(self.graph, last)
        return math.dist((pose.x, pose.y), (other.x, other.y)) + 0.5 * width_at(self.graph, last)

    def oncoming(self, index: int) -> Place:
        """The lane to the left whose traffic comes towards the ego. RouteError where there is none."""
        after = beside(self.graph, self.place(index), "left")
        if (
            after is None
            or self.graph.kind[after.lane] != LaneType.DRIVING
            or self.graph.same_direction(self.place(index).lane, after.lane)
        ):
            raise self.fail(f"{self.item.get('type')} needs an oncoming lane to the left of the ego's")
        return after

    def junction(self) -> tuple[int, int]:
        """Route points where the first junction after the trigger begins and where it has ended."""
        return junction_span(self.graph, self.scenario, self.route)

    def approach(self, sides: Sequence[float]) -> tuple[Place, int]:
        """End of a lane into the ego's junction from these sides, rad, best first, and the lane straight on from it.

        Of several it is the one whose way comes nearest to the ego's.
        """
        enter, leave = self.junction()
        number = int(self.graph.junction[self.route.lane[enter]])
        heading = float(self.route.yaw[max(enter - 1, 0)])
        own = self.route.xy[enter : leave + 15].astype(np.float64)
        best: tuple[int, float, Place, int] | None = None
        for inside in np.flatnonzero((self.graph.junction == number) & (self.graph.kind == LaneType.DRIVING)).tolist():
            for before in self.graph.predecessors(inside).tolist():
                if self.graph.junction[before] == number or before == self.place(max(enter - 1, 0)).lane:
                    continue
                yaw = pose_at(self.graph, Place(before, float(self.graph.length[before]))).yaw
                turns = [abs(float(wrap_angle(yaw - heading - side))) for side in sides]
                rank = next((k for k, turn in enumerate(turns) if turn < math.radians(45)), None)
                if rank is None or abs(turn_of(self.graph, inside)) > math.radians(45):
                    continue
                way = lane_path(self.graph, Place(inside, 0.0), float(self.graph.length[inside]) + 15.0)
                gap = float(np.hypot(*(own[:, None] - way[None]).transpose(2, 0, 1)).min())
                if best is None or (rank, gap) < best[:2]:
                    best = rank, gap, Place(before, float(self.graph.length[before])), inside
        if best is None:
            raise self.fail(f"no lane comes into junction {number} from where {self.item.get('type')} wants it")
        return best[2], best[3]

    def before_junction(self, place: Place, distance: float) -> Place:
        """The place that far back along lanes, but not through a junction."""
        back = place
        for metres in np.arange(2.0, distance + 0.1, 2.0).tolist():
            here = behind(self.graph, place, metres)
            if self.graph.junction[here.lane] >= 0:
                break
            back = here
        return back

    # ------------------------------------------------------------ when

    def reaches(self, index: int, actor: Pose) -> Condition:
        """When the ego comes to a route point: as a distance from the next actor that is added, which waits there."""
        at = self.route.xy[min(max(index, 0), len(self.route.xy) - 1)].tolist()
        return Condition("ego_distance", math.dist(at, (actor.x, actor.y)), len(self.actors))

    def seconds_before(self, index: int, seconds: float, least: float, actor: Pose) -> Condition:
        """When the ego is so many seconds, or at least so many metres, before a route point; see `reaches`."""
        return self.reaches(index - round(max(seconds * SPEED, least) / self.route.spacing), actor)

    def arrival(self, index: int) -> float:
        """Seconds after which an ego that starts from rest and then keeps `SPEED` comes to a route point."""
        return time_to_cover(index * self.route.spacing, SPEED, PICK_UP)

    # ------------------------------------------------------------ who

    def add(self, name: str, model: str, pose: Pose, phases: Sequence[Phase] = (), path: F64 | None = None) -> None:
        """An actor that stands, or does what its phases say along a path [N, 2]."""
        way = () if path is None else tuple((round(x, 3), round(y, 3)) for x, y in path.tolist())
        self.actors.append(Actor(name, model, pose, tuple(phases), way))

    def car(self) -> str:
        """Some model of a car."""
        return str(self.random.choice(CARS))

    def driver(self, name: str, start: Place, distance: float, speed: float) -> None:
        """A car that the Autopilot drives straight on for a distance; it sees the ego."""
        way = lane_path(self.graph, start, distance)
        steps = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(way, axis=0).T))])
        at = np.linspace(0.0, steps[-1], max(2, math.ceil(steps[-1] / 40.0)))
        keys = tuple((float(np.interp(s, steps, way[:, 0])), float(np.interp(s, steps, way[:, 1]))) for s in at)
        pose = pose_at(self.graph, start)
        self.actors.append(Actor(name, self.car(), pose, path=keys, policy="autopilot", target_speed=speed))

    def oncoming_cars(self, index: int, gap: tuple[float, float], *, after: float = 5.0) -> None:
        """Cars towards the ego: the first passes a route point some seconds after an ego that then waits there."""
        lane = self.oncoming(index)
        speed = min(float(self.route.speed_limit[index]), 1.5 * SPEED)
        far = speed * (self.arrival(index) + after) - 0.5 * speed**2 / MODELS["compact"].max_accel
        last: Place | None = None
        for _ in range(6):
            start = behind(self.graph, lane, far)
            if last is not None and self.apart(start, last) < 8.0:
                return  # the road begins here
            if self.graph.junction[start.lane] < 0:
                self.driver(f"oncoming car {len(self.actors)}", start, far + 80.0, speed)
                last = start
            far += float(self.random.uniform(*gap))

    def flow(self, way: F64, gap: tuple[float, float], speed: float, *, models: Sequence[str] = CARS) -> None:
        """Vehicles that come one after another along a way [N, 2] at a steady speed, whatever is in their way.

        They appear where it begins and leave where it ends; at the start they are all along it.
        """
        length = float(np.hypot(*np.diff(way, axis=0).T).sum())
        if length > LONGEST:
            raise self.fail(f"the way of its flow has {length:.0f} m, more than {LONGEST:.0f} m")
        table = _timed(way, speed)
        passing = -float(table[-1, 0])
        while (passing := passing + float(self.random.uniform(*gap)) / speed) < FLOW:
            rows = table.copy()
            rows[:, 0] += passing
            rows = rows.round(3)
            body = str(self.random.choice(models))
            name = f"{'cyclist' if body == 'bicycle' else 'car'} {len(self.actors)}"
            pose = Pose(*rows[0, 1:].tolist())
            self.actors.append(Actor(name, body, pose, trajectory=tuple(map(tuple, rows.tolist()))))

    def way(self, start: Place, end: Place) -> F64:
        """The lanes' way [N, 2] from one place to another. RouteError where there is none."""
        a, b = pose_at(self.graph, start), pose_at(self.graph, end)
        try:
            return route_along(self.graph, [a, b]).xy.astype(np.float64)
        except RouteError as error:
            raise self.fail(str(error)) from None

    def offset(self, way: F64, right: float | F64) -> F64:
        """A way moved to the right, m: by one number or one for each point."""
        heading = np.gradient(way, axis=0)
        normal = np.stack([heading[:, 1], -heading[:, 0]], 1) / np.maximum(np.hypot(*heading.T), 1e-9)[:, None]
        moved: F64 = way + np.atleast_1d(right)[:, None] * normal
        return moved

    def along(self, index: int, distance: float, right: float, *, into: float = 0.0) -> F64:
        """The ego's way from a route point on, from beside it; after `into` m it is in its lane (0: never)."""
        way = self.route.xy[index : index + max(3, round(distance / self.route.spacing))].astype(np.float64)
        if len(way) < 3:
            raise self.fail("the route ends too soon")
        share = np.ones(len(way))
        if into > 0.0:
            part = np.clip(self.route.spacing * np.arange(len(way)) / into, 0.0, 1.0)
            share = 0.5 * (1.0 + np.cos(np.pi * part))
        return self.offset(way, right * share)

    def beyond(self, start: Place, distance: float) -> Place:
        """The place that far ahead along lanes, straight on."""
        return ahead(self.graph, start, distance)

    def apart(self, one: Place, other: Place) -> float:
        """Metres between two places."""
        a, b = pose_at(self.graph, one), pose_at(self.graph, other)
        return math.dist((a.x, a.y), (b.x, b.y))


def _timed(way: F64, speed: float) -> F64:
    """Rows [M, 4] of time, x, y and yaw of a drive along a way at a speed; few where it is straight."""
    step = np.diff(way, axis=0)
    way, step = way[np.concatenate([[True], np.hypot(*step.T) > 1e-6])], step[np.hypot(*step.T) > 1e-6]
    if len(step) < 1:
        raise RouteError("a flow needs a way of some metres")
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*step.T))])
    yaw = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    yaw = np.concatenate([yaw[:1], 0.5 * (yaw[1:] + yaw[:-1]), yaw[-1:]])
    kept = [0]
    for k in range(1, len(s)):
        last = kept[-1]
        if k == len(s) - 1 or abs(yaw[k] - yaw[last]) > _THIN or s[k] - s[last] > _LONG:
            kept.append(k)
    return np.column_stack([s / speed, way, yaw])[kept]
