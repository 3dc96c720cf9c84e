"""OpenSCENARIO XML 1.0 to 1.3 as a scenario: what this program writes comes back whole, of others what maps.

An event that changes a speed becomes a phase, its trigger the phase's condition; a trajectory with times becomes an
actor's own; one without times, a route, or a lane change becomes its path. The ego is left to the system under test.
Whatever has no counterpart is named in `Imported.lost`.

CARLA's ScenarioRunner writes world positions in CARLA's left-handed frame, which a description that begins with
"CARLA:" says, and gives places of bodies' centres (srunner/tools/openscenario_parser.py of ScenarioRunner).
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from ssad.core.errors import FormatError, RouteError
from ssad.core.lane_graph import LaneGraph
from ssad.core.safeio import MIB, read_xml
from ssad.core.types import Actor, Condition, Limits, Phase, Pose, Route, Scenario, SignalPlan, SignalState
from ssad.interchange.ego_start import start_parameters
from ssad.interchange.openscenario_entities import Entity, read_entities
from ssad.interchange.openscenario_places import Places, Values
from ssad.interchange.openscenario_triggers import Triggers
from ssad.interchange.scenario_parts import plan_of, scenario_name
from ssad.scenarios.dynamic import build_episode
from ssad.scenarios.dynamic.knowledge._placing import lane_path, shifted
from ssad.scenarios.dynamic.schema import MAX_SPEED
from ssad.world.models import MODELS
from ssad.world.roads import is_town, load_town, route_along, town_signals

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

STEP: Final = 0.1  # s of the world
MAX_BYTES: Final = 64 * MIB
WAY: Final = 200.0  # m along its lane that somebody without a route gets
_CHANGE = 25.0  # m that a lane change takes where the file gives no distance


@dataclass(frozen=True)
class Imported:
    """A scenario from another format.

    Attributes:
        scenario: The scenario.
        lost: What of the file it does not carry, a line each.
    """

    scenario: Scenario
    lost: tuple[str, ...]


def read_openscenario(path: Path, *, map_name: str | None = None) -> Imported:
    """The scenario of a file.

    Args:
        path: The file.
        map_name: Town that it takes place in, or a file of it; without one, the town whose name its LogicFile has.

    Raises:
        FormatError: The file is broken, or is no OpenSCENARIO XML.
        MapError, UnknownNameError: There is no such town.
        RouteError: The ego's way does not lie on the town's roads.
    """
    root = read_xml(path, limit=MAX_BYTES)
    if root.tag != "OpenSCENARIO":
        raise FormatError(f"{path}: not OpenSCENARIO XML: its root is <{root.tag[:40]}>")
    town = map_name
    if town is None:
        logic = root.find("RoadNetwork/LogicFile")
        if logic is None or not logic.get("filepath"):
            raise FormatError(f"{path}: RoadNetwork: names no LogicFile; say which town it is with --map")
        told = Values(str(path), root).text(logic, "filepath")
        town = Path(told.replace("\\", "/")).stem
        if not is_town(town):
            raise FormatError(
                f"{path}: its map is '{told[:80]}', and there is no town '{town[:80]}'; import the map first "
                "(ssad import map FILE.xodr), or say which town it is with --map"
            )
    return _Reader(str(path), root, load_town(town), town).read(Path(path).stem)


class _Reader:
    def __init__(self, where: str, root: Element, graph: LaneGraph, town: str) -> None:
        self.root, self.graph, self.town = root, graph, town
        self.values = Values(where, root)
        self.lost: Counter[str] = Counter()
        header = root.find("FileHeader")
        if header is None:
            raise self.values.fail("OpenSCENARIO", "FileHeader is missing")
        if self.values.text(header, "revMajor") != "1":
            raise self.values.fail(header, f"revision {header.get('revMajor')} is not read, only 1")
        self.about = self.values.text(header, "description", "")
        self.own = {p.get("name", "")[5:]: p.get("value", "") for p in header.iter("Property")}
        carla = self.about.startswith("CARLA:")
        starts: dict[str, Element] = {}
        for private in root.iterfind("Storyboard/Init/Actions/Private"):
            position = private.find("PrivateAction/TeleportAction/Position")
            if position is not None:
                starts[private.get("entityRef", "")] = position
        for action in root.iter("EntityAction"):
            position = action.find("AddEntityAction/Position")
            if position is not None:
                starts.setdefault(action.get("entityRef", ""), position)
        self.places = Places(self.values, graph, mirrored=carla, lost=self.lost, starts=starts)
        self.entities = read_entities(root, self.values, self.lost, centred=carla)
        for entity in self.entities.values():
            entity.placed = entity.name in starts
            if not entity.placed and not entity.ego:
                self.lost[f"'{entity.name}': it has no position at the start"] += 1
        self.triggers = Triggers(self.places, self.entities, self.lost)
        self.ego = self.triggers.ego

    # ------------------------------------------------------------ the whole

    def read(self, stem: str) -> Imported:
        """The scenario, checked, and what was lost."""
        forced = self._start()
        for maneuvers in self.root.iterfind("Storyboard/Story/Act/ManeuverGroup"):
            self._group(maneuvers)
        for act in self.root.iterfind("Storyboard/Story/Act"):
            self._act_trigger(act)
        limits = self._limits()
        if self.own.get("contact") in ("end", "count", "remove"):
            limits = replace(limits, contact=self.own["contact"])  # type: ignore[arg-type]
        route = self._ego_route()
        line = route_along(self.graph, route)
        start = self._centre(self.ego, self.places.start(self.ego.name, within=self.root))
        name = scenario_name(self.about.removeprefix("CARLA:")) or scenario_name(stem) or "imported"
        speed = self.ego.target_speed or self.ego.speed or Scenario.target_speed
        scenario = Scenario(
            name=name,
            type="Custom",
            town=self.town,
            route=route,
            parameters=start_parameters(line, start, self.ego.speed, digits=6),
            limits=limits,
            target_speed=min(speed, MAX_SPEED),
            group=self.own.get("group", ""),
            source=f"OpenSCENARIO {Path(self.values.where).name}",
        )
        scenario = replace(scenario, actors=tuple(self._actors(limits)), signals=self._plan(line, forced))
        build_episode(scenario, self.graph, seed=0)  # whatever is still wrong with it is said now
        return Imported(scenario, tuple(f"{text}{f' ({n} times)' if n > 1 else ''}" for text, n in self.lost.items()))

    def _centre(self, entity: Entity, pose: Pose) -> Pose:
        return shifted(pose, *entity.centre) if any(entity.centre) else pose

    # ------------------------------------------------------------ the start

    def _start(self) -> dict[str, str]:
        """Reads Init; gives the states of signals by their id, and of those that the map does not have by number."""
        pairs = (told.partition("=") for told in self.own.get("signals", "").split())
        forced = {f"ssad:{signal}": state for signal, _, state in pairs}
        for action in self.root.iterfind("Storyboard/Init/Actions/GlobalAction"):
            told = action.find("InfrastructureAction/TrafficSignalAction/TrafficSignalStateAction")
            if told is not None:
                forced[self.values.text(told, "name")] = self.values.text(told, "state")
            else:
                self._lose("at the start", action)
        for private in self.root.iterfind("Storyboard/Init/Actions/Private"):
            entity = self.triggers.who(private)
            for action in private:
                told = action[0] if len(action) else action
                if told.tag == "ControllerAction":
                    self._driver(entity, told)
                elif told.tag == "RoutingAction":
                    self._routing(entity, told, 0.0)
                elif told.find("SpeedAction") is not None:
                    entity.speed = self._speed(entity, told)
                elif told.tag != "TeleportAction":
                    self._lose(f"at the start of '{entity.name}'", action)
        return forced

    def _driver(self, entity: Entity, action: Element) -> None:
        for controller in action.iter("Controller"):
            told = {p.get("name", ""): p for p in controller.iter("Property")}
            if "target_speed" in told:
                entity.target_speed = self.values.number(told["target_speed"], "value")
            name = self.values.text(controller, "name", "")
            if not entity.ego:
                if name in ("autopilot", "blind") and "target_speed" in told:
                    entity.policy = name
                else:
                    self.lost[f"controller '{name}' of '{entity.name}'"] += 1
        if action.find(".//CatalogReference") is not None:
            self.lost[f"controller of '{entity.name}' in a catalogue"] += 1

    def _lose(self, when: str, action: Element) -> None:
        """Name an action that has no counterpart: the innermost element whose name says what it does."""
        inner = [one.tag for one in action.iter() if one.tag.endswith("Action")]
        self.lost[f"{(inner or [action.tag])[-1]} {when}"] += 1

    def _speed(self, entity: Entity, action: Element) -> float:
        target = action.find("SpeedAction/SpeedActionTarget/AbsoluteTargetSpeed")
        if target is not None:
            speed = self.values.number(target, "value")
        else:
            relative = action.find("SpeedAction/SpeedActionTarget/RelativeTargetSpeed")
            if relative is None:
                raise self.values.fail("SpeedAction", "SpeedActionTarget is missing")
            other, value = self.triggers.who(relative), self.values.number(relative, "value")
            delta = self.values.text(relative, "speedTargetValueType") == "delta"
            speed = other.speed + value if delta else other.speed * value
            self.lost[f"a speed of '{entity.name}' that depends on '{other.name}' is fixed at {speed:g} m/s"] += 1
        top = MODELS[entity.model].max_speed
        if not 0.0 <= speed <= top and not entity.ego:
            self.lost[f"a speed of '{entity.name}' of {speed:g} m/s: a {entity.model} has 0 to {top:g} m/s"] += 1
            speed = min(max(speed, 0.0), top)
        shape = action.find("SpeedAction/SpeedActionDynamics")
        if shape is not None and self.values.text(shape, "dynamicsShape") != "step":
            body = MODELS[entity.model]
            rate = self.values.number(shape, "value")
            by_rate = self.values.text(shape, "dynamicsDimension") == "rate"
            if not by_rate or min(abs(rate - body.max_accel), abs(rate - body.max_brake)) > 1e-6:
                self.lost["how fast speeds change: vehicles use full throttle or full brake"] += 1
        return speed

    def _routing(self, entity: Entity, action: Element, begins: float | None) -> None:
        told = action[0] if len(action) else action
        if told.tag == "AcquirePositionAction":
            position = told.find("Position")
            if self.places.reads(position):
                entity.route = (self.places.pose(position, within=told),)
                return
        elif told.tag == "AssignRouteAction" and told.find("Route") is not None:
            points = [w.find("Position") for w in told.iterfind("Route/Waypoint")]
            if all(self.places.reads(p) for p in points):
                entity.route = _headed(points, tuple(self.places.pose(p, within=told) for p in points))
                return
        elif told.tag == "FollowTrajectoryAction" and not entity.ego:
            self._trajectory(entity, told, begins)
            return
        self._lose(f"of '{entity.name}'", action)

    def _trajectory(self, entity: Entity, action: Element, begins: float | None) -> None:
        vertices = action.findall(".//Shape/Polyline/Vertex")
        points = [v.find("Position") for v in vertices]
        if len(vertices) < 2 or not all(self.places.reads(p) for p in points):
            self.lost[f"a trajectory of '{entity.name}' that is no polyline of places that are read"] += 1
            return
        given = tuple(self.places.pose(p, within=action) for p in points)
        poses = tuple(self._centre(entity, pose) for pose in _headed(points, given))
        timing = action.find("TimeReference/Timing")
        if timing is None:
            entity.path = poses
            return
        scale, offset = (self.values.number(timing, k, d) for k, d in (("scale", 1.0), ("offset", 0.0)))
        if self.values.text(timing, "domainAbsoluteRelative") == "relative":
            if begins is None:
                self.lost[f"the trigger of the trajectory of '{entity.name}': it begins with the episode"] += 1
            offset += begins or 0.0
        times = [self.values.number(v, "time") * scale + offset for v in vertices]
        entity.rows = tuple((t, p.x, p.y, p.yaw) for t, p in zip(times, poses, strict=True))

    # ------------------------------------------------------------ events

    def _group(self, group: Element) -> None:
        refs = group.findall("Actors/EntityRef")
        actors = [self.triggers.who(ref) for ref in refs]
        events = group.findall("Maneuver/Event")
        if group.find("CatalogReference") is not None:
            self.lost["a maneuver in a catalogue"] += 1
        for event in events:
            label = self.values.text(event, "name", "")
            for action in event.iterfind("Action"):
                kind = action[0] if len(action) else action
                if kind.tag == "GlobalAction":
                    self._global(kind, event, label)
                    continue
                for entity in actors:
                    self._act(entity, kind, event, label)

    def _global(self, action: Element, event: Element, label: str) -> None:
        told = action.find("EntityAction")
        if told is None:
            self._lose(f"in event '{label}'", action)
            return
        entity = self.triggers.who(told)
        when = self._when(event, entity, label)
        if told.find("AddEntityAction") is not None:
            if not entity.rows and (when is None or when.kind != "always"):
                self.lost[f"'{entity.name}' is there from the start, not from event '{label}' on"] += 1
        elif when is not None and when.kind == "time":
            entity.leaves = when.value
        else:
            self.lost[f"DeleteEntityAction of '{entity.name}': it stays"] += 1

    def _act(self, entity: Entity, action: Element, event: Element, label: str) -> None:
        told = action[0] if len(action) else action
        if entity.ego:
            self.lost[f"event '{label}' of the ego: the system under test drives it"] += 1
            return
        if told.find("SpeedAction") is not None:
            found = self.triggers.conditions(event, entity, label)
            if found is None and entity.phases:
                self.lost[f"event '{label}': when it begins is not known"] += 1
                return
            *waits, last = found or (Condition("always"),)
            before = entity.phases[-1].speed if entity.phases else min(entity.speed, MODELS[entity.model].max_speed)
            waiting = (Phase(before, one) for one in waits)
            entity.phases = (*entity.phases, *waiting, Phase(self._speed(entity, told), last))
            entity.event = label
        elif told.tag == "RoutingAction":
            when = self._when(event, entity, label)
            times = {"always": 0.0, "time": when.value if when else 0.0}
            begins = times.get(when.kind) if when else None
            if begins is None and told.find("FollowTrajectoryAction//Timing") is None:
                self.lost[f"the trigger of event '{label}': '{entity.name}' keeps that path from the start"] += 1
            self._routing(entity, told, begins)
        elif told.find("LaneChangeAction") is not None:
            self._lane_change(entity, told, self._when(event, entity, label), label)
        else:
            self._lose(f"in event '{label}'", action)

    def _when(self, event: Element, entity: Entity, label: str) -> Condition | None:
        """What a trigger waits for; None also where this is one thing after another."""
        found = self.triggers.conditions(event, entity, label)
        return found[0] if found is not None and len(found) == 1 else None

    def _lane_change(self, entity: Entity, action: Element, when: Condition | None, label: str) -> None:
        """A lane change whose place is known becomes part of the path; else it is lost."""
        target = action.find("LaneChangeAction/LaneChangeTarget/RelativeTargetLane")
        speed = entity.phases[-1].speed if entity.phases else entity.speed
        place = {"always": 0.0, "travelled": when.value, "time": when.value * speed}.get(when.kind) if when else None
        if target is None or place is None or entity.change is not None:
            self.lost[f"LaneChangeAction in event '{label}': it is not known where it begins"] += 1
            return
        shape = action.find("LaneChangeAction/LaneChangeActionDynamics")
        length = _CHANGE
        if shape is not None and self.values.text(shape, "dynamicsDimension") in ("distance", "time"):
            value = self.values.number(shape, "value")
            length = value if self.values.text(shape, "dynamicsDimension") == "distance" else value * speed
        entity.change = place, self.values.lanes(target, "value"), max(length, 5.0)

    def _act_trigger(self, act: Element) -> None:
        """An act that waits for something has its actors wait for it: a phase of its own before all others."""
        for group in act.iterfind("ManeuverGroup"):
            for ref in group.iterfind("Actors/EntityRef"):
                entity = self.triggers.who(ref)
                found = self.triggers.conditions(act, entity, self.values.text(act, "name", "act")) or ()
                waits = (Phase(min(entity.speed, 60.0), when) for when in found if when != Condition("always"))
                entity.phases = (*waits, *entity.phases)

    # ------------------------------------------------------------ what it makes

    def _limits(self) -> Limits:
        limits = Limits()
        trigger = self.root.find("Storyboard/StopTrigger")
        conditions = [] if trigger is None else trigger.findall("ConditionGroup/Condition")
        times: list[float] = []
        for condition in conditions:
            name = condition.get("name", "")
            time = condition.find("ByValueCondition/SimulationTimeCondition")
            way = condition.find("ByEntityCondition/EntityCondition/TraveledDistanceCondition")
            if time is not None:
                value = self.values.number(time, "value")
                if name == "max_steps":
                    limits = replace(limits, max_steps=round(value / STEP))
                elif name == "max_time":
                    limits = replace(limits, max_time=value)
                else:
                    times.append(value)
            elif way is not None:
                limits = replace(limits, max_distance=self.values.number(way, "value"))
            elif name != "end of the route" and condition.find(".//CollisionCondition") is None:
                inner = [one.tag for one in condition.iter() if one.tag.endswith("Condition")]
                self.lost[f"{inner[-1]} of the stop trigger"] += 1
        if times:
            limits = replace(limits, max_time=min(times), max_steps=math.ceil(min(times) / STEP))
        return limits

    def _ego_route(self) -> tuple[Pose, ...]:
        start = self.places.start(self.ego.name, within=self.root)
        points = self.ego.route
        if len(points) > 1:
            return points
        place = self.places.lane_under(start)
        if place is None:
            raise RouteError(
                f"{self.values.where}: the ego '{self.ego.name}' does not stand on a road of '{self.town}'"
            )
        if points:
            return (start, *points)
        self.lost[f"the ego has no route: {WAY:g} m along its lane"] += 1
        path = lane_path(self.graph, place, WAY)
        if len(path) < 3:
            raise RouteError(f"{self.values.where}: the road ends before the ego '{self.ego.name}'")
        kept = path[np.unique(np.linspace(0, len(path) - 2, 9).astype(int))]
        after = path[np.unique(np.linspace(0, len(path) - 2, 9).astype(int)) + 1]
        yaw = np.arctan2(*(after - kept).T[::-1])
        return tuple(Pose(x, y, h) for (x, y), h in zip(kept.tolist(), yaw.tolist(), strict=True))

    def _actors(self, limits: Limits) -> list[Actor]:
        until = min(limits.max_steps * STEP, limits.max_time)
        return [self._actor(entity, until) for entity in self.entities.values() if entity.placed and not entity.ego]

    def _actor(self, entity: Entity, until: float) -> Actor:
        if entity.rows:
            rows = list(entity.rows)
            if rows[-1][0] < min(until, entity.leaves):
                rows.append((until + 1.0, *rows[-1][1:]))  # it stays where it came to
            if entity.phases:
                self.lost[f"speeds of '{entity.name}': its trajectory has times"] += 1
            return Actor(entity.name, entity.model, Pose(*rows[0][1:]), trajectory=tuple(rows))
        if math.isfinite(entity.leaves):
            self.lost[f"DeleteEntityAction of '{entity.name}': it stays"] += 1
        pose = self._centre(entity, self.places.start(entity.name, within=self.root))
        body = MODELS[entity.model]
        if body.max_speed == 0.0:
            if entity.phases or entity.path:
                self.lost[f"what '{entity.name}' does: a {entity.model} stands still"] += 1
            return Actor(entity.name, entity.model, pose)
        if entity.policy:
            path = tuple((p.x, p.y) for p in entity.route) if len(entity.route) > 1 else ()
            speed = min(max(entity.target_speed, 0.1), body.max_speed)
            return Actor(entity.name, entity.model, pose, path=path, policy=entity.policy, target_speed=speed)
        phases = entity.phases
        if entity.speed > 0.0:
            phases = (Phase(min(entity.speed, body.max_speed)), *phases)
            self.lost[f"'{entity.name}' starts from rest, and then goes for {entity.speed:g} m/s"] += 1
        return Actor(entity.name, entity.model, pose, phases=phases, path=self._path(entity, pose) if phases else ())

    def _path(self, entity: Entity, pose: Pose) -> tuple[tuple[float, float], ...]:
        """What it drives along: what the file says, else its lane; () straight on."""
        if entity.path:
            return () if _straight(entity.path) else tuple((p.x, p.y) for p in entity.path)
        if entity.model == "walker":
            points = (pose, *entity.route) if len(entity.route) == 1 else entity.route
            return tuple((p.x, p.y) for p in points)
        if entity.route:
            points = (pose, *entity.route) if len(entity.route) == 1 else entity.route
            try:
                return tuple((x, y) for x, y in route_along(self.graph, points).xy.tolist())
            except RouteError:
                self.lost[f"the route of '{entity.name}', which the town's lanes do not allow"] += 1
        place = self.places.lane_under(pose)
        if place is None:
            return ()
        xy = lane_path(self.graph, place, WAY)
        aside = -math.sin(pose.yaw) * (pose.x - xy[0, 0]) + math.cos(pose.yaw) * (pose.y - xy[0, 1])
        s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xy, axis=0).T))])
        at = np.arange(0.0, s[-1], 1.0)
        if len(at) < 2:
            return ()
        line = np.stack([np.interp(at, s, xy[:, k]) for k in range(2)], 1)
        left = np.full(len(at), aside)
        if entity.change is not None:
            where, lanes, length = entity.change
            width = self.graph.at(place.lane, place.s)[3]
            share = np.clip((at - where) / length, 0.0, 1.0)
            left = left + lanes * width * 0.5 * (1.0 - np.cos(np.pi * share))
        heading = np.gradient(line, axis=0)
        normal = np.stack([-heading[:, 1], heading[:, 0]], 1) / np.hypot(*heading.T)[:, None]
        return tuple((x, y) for x, y in (line + left[:, None] * normal).tolist())

    def _plan(self, line: Route, forced: dict[str, str]) -> SignalPlan:
        """The plan that forces just these signals; what no plan does is lost."""
        if not forced:
            return SignalPlan()
        number = {name: k for k, name in town_signals(self.town).items()}
        number |= {f"ssad:{k}": k for k in np.flatnonzero(self.graph.signal_virtual).tolist()}
        wanted: dict[int, SignalState] = {}
        for name, told in forced.items():
            state = next((s for s in SignalState if s.name.lower() == told.strip().lower()), None)
            if state is None or name not in number:
                self.lost[f"state '{told[:40]}' of signal '{name[:40]}'"] += 1
            else:
                wanted[number[name]] = state
        until = 60.0
        if "signals_until" in self.own:
            try:
                until = float(self.own["signals_until"])
            except ValueError:
                raise self.values.fail("Property", "ssad.signals_until is not a number") from None
        plan = plan_of(self.graph, line, wanted, until)
        if plan is None:
            self.lost[f"the states of {len(wanted)} signals, which no signal plan here gives"] += 1
        return plan or SignalPlan()


def _headed(positions: list[Element | None], poses: tuple[Pose, ...]) -> tuple[Pose, ...]:
    """The poses; those of world positions without a heading look to the next one."""
    found = list(poses)
    for k, position in enumerate(positions):
        world = None if position is None else position.find("WorldPosition")
        if world is None or world.get("h") is not None or len(poses) < 2:
            continue
        a, b = (poses[k], poses[k + 1]) if k + 1 < len(poses) else (poses[k - 1], poses[k])
        found[k] = replace(poses[k], yaw=math.atan2(b.y - a.y, b.x - a.x))
    return tuple(found)


def _straight(points: tuple[Pose, ...]) -> bool:
    """Whether a path is two points, the second straight ahead of the first: it is driven without one."""
    if len(points) != 2:
        return False
    here, there = points
    length = math.dist((here.x, here.y), (there.x, there.y))
    ahead = math.cos(here.yaw) * (there.x - here.x) + math.sin(here.yaw) * (there.y - here.y)
    return length > 0.0 and length - ahead < 1e-6
