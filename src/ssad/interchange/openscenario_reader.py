"""OpenSCENARIO XML 1.0 to 1.3 as a scenario: files of SSAD are restored completely, others as far as they map.

An event that changes a speed becomes a phase, its trigger the phase's condition; a trajectory with times becomes an
actor's own; one without times, a route, or a lane change becomes its path. The ego is left to the system under test.
Features without a counterpart are listed in `ImportedScenario.omissions`.

CARLA's ScenarioRunner writes world positions in CARLA's left-handed frame, which a description that begins with
"CARLA:" indicates, and gives positions of bodies' centres (srunner/tools/openscenario_parser.py of ScenarioRunner).
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
from ssad.core.types import Actor, EpisodeLimits, Phase, PhaseTrigger, Pose, Route, Scenario, SignalPlan, SignalState
from ssad.interchange.ego_start import start_parameters
from ssad.interchange.openscenario_entities import Entity, read_entities
from ssad.interchange.openscenario_places import AttributeReader, PositionReader
from ssad.interchange.openscenario_triggers import TriggerReader
from ssad.interchange.scenario_parts import plan_of, scenario_name
from ssad.scenarios.dynamic import build_episode
from ssad.scenarios.dynamic.knowledge._placing import lane_path, move_pose
from ssad.scenarios.dynamic.schema import MAX_SPEED
from ssad.world.models import MODELS
from ssad.world.roads import is_town, load_town, route_along, town_signals

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

STEP: Final = 0.1  # s of the world
MAX_BYTES: Final = 64 * MIB
WAY: Final = 200.0  # m, length of the path along its lane of an agent without a route
_CHANGE = 25.0  # m, length of a lane change if the file gives no distance


@dataclass(frozen=True)
class ImportedScenario:
    """A scenario from another format.

    Attributes:
        scenario: The scenario.
        omissions: Features of the file that are not carried over, one line each.
    """

    scenario: Scenario
    omissions: tuple[str, ...]


def read_openscenario(path: Path, *, map_name: str | None = None) -> ImportedScenario:
    """Read the scenario of a file.

    Args:
        path: The file.
        map_name: Its town, or a file of that town; None: the town with the name of the file's LogicFile.

    Raises:
        FormatError: The file is broken, or is not OpenSCENARIO XML.
        MapError, UnknownNameError: The town does not exist.
        RouteError: The ego's route does not lie on the town's roads.
    """
    root = read_xml(path, limit=MAX_BYTES)
    if root.tag != "OpenSCENARIO":
        raise FormatError(f"{path}: not OpenSCENARIO XML: its root is <{root.tag[:40]}>")
    town = map_name
    if town is None:
        logic = root.find("RoadNetwork/LogicFile")
        if logic is None or not logic.get("filepath"):
            raise FormatError(f"{path}: RoadNetwork: names no LogicFile; say which town it is with --map")
        map_path = AttributeReader(str(path), root).text(logic, "filepath")
        town = Path(map_path.replace("\\", "/")).stem
        if not is_town(town):
            raise FormatError(
                f"{path}: its map is '{map_path[:80]}', and there is no town '{town[:80]}'; import the map first "
                "(ssad import map FILE.xodr), or say which town it is with --map"
            )
    return _Reader(str(path), root, load_town(town), town).read(Path(path).stem)


class _Reader:
    def __init__(self, location: str, root: Element, graph: LaneGraph, town: str) -> None:
        self.root, self.graph, self.town = root, graph, town
        self.values = AttributeReader(location, root)
        self.omissions: Counter[str] = Counter()
        header = root.find("FileHeader")
        if header is None:
            raise self.values.error("OpenSCENARIO", "FileHeader is missing")
        if self.values.text(header, "revMajor") != "1":
            raise self.values.error(header, f"revision {header.get('revMajor')} is not read, only 1")
        self.description = self.values.text(header, "description", "")
        self.own_properties = {
            property_element.get("name", "")[5:]: property_element.get("value", "")
            for property_element in header.iter("Property")
        }
        is_carla = self.description.startswith("CARLA:")
        starts: dict[str, Element] = {}
        for private in root.iterfind("Storyboard/Init/Actions/Private"):
            position = private.find("PrivateAction/TeleportAction/Position")
            if position is not None:
                starts[private.get("entityRef", "")] = position
        for action in root.iter("EntityAction"):
            position = action.find("AddEntityAction/Position")
            if position is not None:
                starts.setdefault(action.get("entityRef", ""), position)
        self.places = PositionReader(self.values, graph, mirrored=is_carla, omissions=self.omissions, starts=starts)
        self.entities = read_entities(root, self.values, self.omissions, centred=is_carla)
        for entity in self.entities.values():
            entity.placed = entity.name in starts
            if not entity.placed and not entity.ego:
                self.omissions[f"'{entity.name}': it has no position at the start"] += 1
        self.triggers = TriggerReader(self.places, self.entities, self.omissions)
        self.ego = self.triggers.ego

    # ------------------------------------------------------------ the document

    def read(self, stem: str) -> ImportedScenario:
        """Return the scenario, checked, and the features that are not carried over."""
        forced_signals = self._start()
        for maneuvers in self.root.iterfind("Storyboard/Story/Act/ManeuverGroup"):
            self._group(maneuvers)
        # After the events: the phase of an act's trigger goes before all others.
        for act in self.root.iterfind("Storyboard/Story/Act"):
            self._act_trigger(act)
        limits = self._limits()
        if self.own_properties.get("contact") in ("end", "count", "remove"):
            limits = replace(limits, contact=self.own_properties["contact"])  # type: ignore[arg-type]
        key_points = self._ego_route()
        ego_route = route_along(self.graph, key_points)
        start_pose = self._centre(self.ego, self.places.start(self.ego.name, within=self.root))
        name = scenario_name(self.description.removeprefix("CARLA:")) or scenario_name(stem) or "imported"
        speed = self.ego.target_speed or self.ego.speed or Scenario.target_speed
        scenario = Scenario(
            name=name,
            type="Custom",
            town=self.town,
            route=key_points,
            parameters=start_parameters(ego_route, start_pose, self.ego.speed, digits=6),
            limits=limits,
            target_speed=min(speed, MAX_SPEED),
            group=self.own_properties.get("group", ""),
            source=f"OpenSCENARIO {Path(self.values.location).name}",
        )
        scenario = replace(scenario, actors=tuple(self._actors(limits)), signals=self._plan(ego_route, forced_signals))
        build_episode(scenario, self.graph, seed=0)  # reports any remaining error of the scenario
        return ImportedScenario(
            scenario,
            tuple(f"{message}{f' ({count} times)' if count > 1 else ''}" for message, count in self.omissions.items()),
        )

    def _centre(self, entity: Entity, pose: Pose) -> Pose:
        return move_pose(pose, *entity.centre) if any(entity.centre) else pose

    # ------------------------------------------------------------ the start

    def _start(self) -> dict[str, str]:
        """Read Init; return the states of signals by id, and by number for those that are not in the map."""
        assignments = (element.partition("=") for element in self.own_properties.get("signals", "").split())
        forced_signals = {f"ssad:{signal}": state for signal, _, state in assignments}
        for action in self.root.iterfind("Storyboard/Init/Actions/GlobalAction"):
            element = action.find("InfrastructureAction/TrafficSignalAction/TrafficSignalStateAction")
            if element is not None:
                forced_signals[self.values.text(element, "name")] = self.values.text(element, "state")
            else:
                self._record_omission("at the start", action)
        for agent_actions in self.root.iterfind("Storyboard/Init/Actions/Private"):
            entity = self.triggers.referenced_entity(agent_actions)
            for action in agent_actions:
                element = action[0] if len(action) else action
                if element.tag == "ControllerAction":
                    self._driver(entity, element)
                elif element.tag == "RoutingAction":
                    self._routing(entity, element, 0.0)
                elif element.find("SpeedAction") is not None:
                    entity.speed = self._speed(entity, element)
                elif element.tag != "TeleportAction":
                    self._record_omission(f"at the start of '{entity.name}'", action)
        return forced_signals

    def _driver(self, entity: Entity, action: Element) -> None:
        for controller in action.iter("Controller"):
            properties = {
                property_element.get("name", ""): property_element for property_element in controller.iter("Property")
            }
            if "target_speed" in properties:
                entity.target_speed = self.values.number(properties["target_speed"], "value")
            name = self.values.text(controller, "name", "")
            if not entity.ego:
                if name in ("autopilot", "blind") and "target_speed" in properties:
                    entity.policy = name
                else:
                    self.omissions[f"controller '{name}' of '{entity.name}'"] += 1
        if action.find(".//CatalogReference") is not None:
            self.omissions[f"controller of '{entity.name}' in a catalogue"] += 1

    def _record_omission(self, context: str, action: Element) -> None:
        """Name an action that has no counterpart: the innermost element whose name says what it does."""
        action_tags = [element.tag for element in action.iter() if element.tag.endswith("Action")]
        self.omissions[f"{(action_tags or [action.tag])[-1]} {context}"] += 1

    def _speed(self, entity: Entity, action: Element) -> float:
        target = action.find("SpeedAction/SpeedActionTarget/AbsoluteTargetSpeed")
        if target is not None:
            speed = self.values.number(target, "value")
        else:
            relative = action.find("SpeedAction/SpeedActionTarget/RelativeTargetSpeed")
            if relative is None:
                raise self.values.error("SpeedAction", "SpeedActionTarget is missing")
            other, value = self.triggers.referenced_entity(relative), self.values.number(relative, "value")
            is_delta = self.values.text(relative, "speedTargetValueType") == "delta"
            speed = other.speed + value if is_delta else other.speed * value
            self.omissions[f"a speed of '{entity.name}' that depends on '{other.name}' is fixed at {speed:g} m/s"] += 1
        max_speed = MODELS[entity.model].max_speed
        if not 0.0 <= speed <= max_speed and not entity.ego:
            self.omissions[
                f"a speed of '{entity.name}' of {speed:g} m/s: a {entity.model} has 0 to {max_speed:g} m/s"
            ] += 1
            speed = min(max(speed, 0.0), max_speed)
        dynamics = action.find("SpeedAction/SpeedActionDynamics")
        if dynamics is not None and self.values.text(dynamics, "dynamicsShape") != "step":
            model = MODELS[entity.model]
            rate = self.values.number(dynamics, "value")
            is_rate = self.values.text(dynamics, "dynamicsDimension") == "rate"
            if not is_rate or min(abs(rate - model.max_accel), abs(rate - model.max_brake)) > 1e-6:
                self.omissions["how fast speeds change: vehicles use full throttle or full brake"] += 1
        return speed

    def _routing(self, entity: Entity, action: Element, begins: float | None) -> None:
        inner = action[0] if len(action) else action
        if inner.tag == "AcquirePositionAction":
            position = inner.find("Position")
            if self.places.is_supported(position):
                entity.route = (self.places.pose(position, within=inner),)
                return
        elif inner.tag == "AssignRouteAction" and inner.find("Route") is not None:
            points = [waypoint.find("Position") for waypoint in inner.iterfind("Route/Waypoint")]
            if all(self.places.is_supported(point) for point in points):
                entity.route = _with_headings(points, tuple(self.places.pose(point, within=inner) for point in points))
                return
        elif inner.tag == "FollowTrajectoryAction" and not entity.ego:
            self._trajectory(entity, inner, begins)
            return
        self._record_omission(f"of '{entity.name}'", action)

    def _trajectory(self, entity: Entity, action: Element, begins: float | None) -> None:
        vertices = action.findall(".//Shape/Polyline/Vertex")
        points = [vertex.find("Position") for vertex in vertices]
        if len(vertices) < 2 or not all(self.places.is_supported(point) for point in points):
            self.omissions[f"a trajectory of '{entity.name}' that is no polyline of places that are read"] += 1
            return
        read_poses = tuple(self.places.pose(point, within=action) for point in points)
        poses = tuple(self._centre(entity, pose) for pose in _with_headings(points, read_poses))
        timing = action.find("TimeReference/Timing")
        if timing is None:
            entity.path = poses
            return
        scale, offset = (
            self.values.number(timing, attribute, default) for attribute, default in (("scale", 1.0), ("offset", 0.0))
        )
        if self.values.text(timing, "domainAbsoluteRelative") == "relative":
            if begins is None:
                self.omissions[f"the trigger of the trajectory of '{entity.name}': it begins with the episode"] += 1
            offset += begins or 0.0
        times = [self.values.number(vertex, "time") * scale + offset for vertex in vertices]
        entity.rows = tuple((time, point.x, point.y, point.yaw) for time, point in zip(times, poses, strict=True))

    # ------------------------------------------------------------ events

    def _group(self, group: Element) -> None:
        references = group.findall("Actors/EntityRef")
        actors = [self.triggers.referenced_entity(reference) for reference in references]
        events = group.findall("Maneuver/Event")
        if group.find("CatalogReference") is not None:
            self.omissions["a maneuver in a catalogue"] += 1
        for event in events:
            label = self.values.text(event, "name", "")
            for action in event.iterfind("Action"):
                inner = action[0] if len(action) else action
                if inner.tag == "GlobalAction":
                    self._global(inner, event, label)
                    continue
                for entity in actors:
                    self._act(entity, inner, event, label)

    def _global(self, action: Element, event: Element, label: str) -> None:
        entity_action = action.find("EntityAction")
        if entity_action is None:
            self._record_omission(f"in event '{label}'", action)
            return
        entity = self.triggers.referenced_entity(entity_action)
        condition = self._start_condition(event, entity, label)
        if entity_action.find("AddEntityAction") is not None:
            if not entity.rows and (condition is None or condition.kind != "always"):
                self.omissions[f"'{entity.name}' is there from the start, not from event '{label}' on"] += 1
        elif condition is not None and condition.kind == "time":
            entity.leaves = condition.value
        else:
            self.omissions[f"DeleteEntityAction of '{entity.name}': it stays"] += 1

    def _act(self, entity: Entity, action: Element, event: Element, label: str) -> None:
        inner = action[0] if len(action) else action
        if entity.ego:
            self.omissions[f"event '{label}' of the ego: the system under test drives it"] += 1
            return
        if inner.find("SpeedAction") is not None:
            conditions = self.triggers.conditions(event, entity, label)
            if conditions is None and entity.phases:
                self.omissions[f"event '{label}': when it begins is not known"] += 1
                return
            *waiting_conditions, final_condition = conditions or (PhaseTrigger("always"),)
            previous_speed = (
                entity.phases[-1].speed if entity.phases else min(entity.speed, MODELS[entity.model].max_speed)
            )
            # A phase has one condition; a sequence of them needs phases that keep the speed.
            waiting_phases = (Phase(previous_speed, wait) for wait in waiting_conditions)
            entity.phases = (*entity.phases, *waiting_phases, Phase(self._speed(entity, inner), final_condition))
            entity.event = label
        elif inner.tag == "RoutingAction":
            condition = self._start_condition(event, entity, label)
            start_times = {"always": 0.0, "time": condition.value if condition else 0.0}
            start_time = start_times.get(condition.kind) if condition else None
            if start_time is None and inner.find("FollowTrajectoryAction//Timing") is None:
                self.omissions[f"the trigger of event '{label}': '{entity.name}' keeps that path from the start"] += 1
            self._routing(entity, inner, start_time)
        elif inner.find("LaneChangeAction") is not None:
            self._lane_change(entity, inner, self._start_condition(event, entity, label), label)
        else:
            self._record_omission(f"in event '{label}'", action)

    def _start_condition(self, event: Element, entity: Entity, label: str) -> PhaseTrigger | None:
        """Return the single condition of a trigger; None also if it is a sequence."""
        conditions = self.triggers.conditions(event, entity, label)
        return conditions[0] if conditions is not None and len(conditions) == 1 else None

    def _lane_change(self, entity: Entity, action: Element, start_condition: PhaseTrigger | None, label: str) -> None:
        """A lane change whose place is known becomes part of the path; else it is lost."""
        target = action.find("LaneChangeAction/LaneChangeTarget/RelativeTargetLane")
        speed = (entity.phases[-1].speed or 0.0) if entity.phases else entity.speed
        start_distance = (
            {"always": 0.0, "travelled": start_condition.value, "time": start_condition.value * speed}.get(
                start_condition.kind
            )
            if start_condition
            else None
        )
        if target is None or start_distance is None or entity.change is not None:
            self.omissions[f"LaneChangeAction in event '{label}': it is not known where it begins"] += 1
            return
        dynamics = action.find("LaneChangeAction/LaneChangeActionDynamics")
        length = _CHANGE
        if dynamics is not None and self.values.text(dynamics, "dynamicsDimension") in ("distance", "time"):
            value = self.values.number(dynamics, "value")
            length = value if self.values.text(dynamics, "dynamicsDimension") == "distance" else value * speed
        entity.change = start_distance, self.values.lanes(target, "value"), max(length, 5.0)

    def _act_trigger(self, act: Element) -> None:
        """Convert the trigger of an act: its actors wait for it in a phase before all others."""
        for group in act.iterfind("ManeuverGroup"):
            for reference in group.iterfind("Actors/EntityRef"):
                entity = self.triggers.referenced_entity(reference)
                conditions = self.triggers.conditions(act, entity, self.values.text(act, "name", "act")) or ()
                waiting_phases = (
                    Phase(min(entity.speed, 60.0), condition)
                    for condition in conditions
                    if condition != PhaseTrigger("always")
                )
                entity.phases = (*waiting_phases, *entity.phases)

    # ------------------------------------------------------------ parts of the scenario

    def _limits(self) -> EpisodeLimits:
        limits = EpisodeLimits()
        trigger = self.root.find("Storyboard/StopTrigger")
        conditions = [] if trigger is None else trigger.findall("ConditionGroup/Condition")
        times: list[float] = []
        for condition in conditions:
            name = condition.get("name", "")
            time_condition = condition.find("ByValueCondition/SimulationTimeCondition")
            distance_condition = condition.find("ByEntityCondition/EntityCondition/TraveledDistanceCondition")
            if time_condition is not None:
                value = self.values.number(time_condition, "value")
                if name == "max_steps":
                    limits = replace(limits, max_steps=round(value / STEP))
                elif name == "max_time":
                    limits = replace(limits, max_time=value)
                else:
                    times.append(value)
            elif distance_condition is not None:
                limits = replace(limits, max_distance=self.values.number(distance_condition, "value"))
            elif name != "end of the route" and condition.find(".//CollisionCondition") is None:
                condition_tags = [element.tag for element in condition.iter() if element.tag.endswith("Condition")]
                self.omissions[f"{condition_tags[-1]} of the stop trigger"] += 1
        if times:
            limits = replace(limits, max_time=min(times), max_steps=math.ceil(min(times) / STEP))
        return limits

    def _ego_route(self) -> tuple[Pose, ...]:
        start = self.places.start(self.ego.name, within=self.root)
        points = self.ego.route
        if len(points) > 1:
            return points
        start_lane = self.places.lane_under(start)
        if start_lane is None:
            raise RouteError(
                f"{self.values.location}: the ego '{self.ego.name}' does not stand on a road of '{self.town}'"
            )
        if points:
            return (start, *points)
        self.omissions[f"the ego has no route: {WAY:g} m along its lane"] += 1
        path = lane_path(self.graph, start_lane, WAY)
        if len(path) < 3:
            raise RouteError(f"{self.values.location}: the road ends before the ego '{self.ego.name}'")
        key_points = path[np.unique(np.linspace(0, len(path) - 2, 9).astype(int))]
        next_points = path[np.unique(np.linspace(0, len(path) - 2, 9).astype(int)) + 1]
        headings = np.arctan2(*(next_points - key_points).T[::-1])
        return tuple(
            Pose(x, y, heading) for (x, y), heading in zip(key_points.tolist(), headings.tolist(), strict=True)
        )

    def _actors(self, limits: EpisodeLimits) -> list[Actor]:
        end_time = min(limits.max_steps * STEP, limits.max_time)
        return [self._actor(entity, end_time) for entity in self.entities.values() if entity.placed and not entity.ego]

    def _actor(self, entity: Entity, until: float) -> Actor:
        if entity.rows:
            rows = list(entity.rows)
            if rows[-1][0] < min(until, entity.leaves):
                rows.append((until + 1.0, *rows[-1][1:]))  # it stays at the end of its trajectory
            if entity.phases:
                self.omissions[f"speeds of '{entity.name}': its trajectory has times"] += 1
            return Actor(entity.name, entity.model, Pose(*rows[0][1:]), trajectory=tuple(rows))
        if math.isfinite(entity.leaves):
            self.omissions[f"DeleteEntityAction of '{entity.name}': it stays"] += 1
        pose = self._centre(entity, self.places.start(entity.name, within=self.root))
        model = MODELS[entity.model]
        if model.max_speed == 0.0:
            if entity.phases or entity.path:
                self.omissions[f"what '{entity.name}' does: a {entity.model} stands still"] += 1
            return Actor(entity.name, entity.model, pose)
        if entity.policy:
            path = tuple((point.x, point.y) for point in entity.route) if len(entity.route) > 1 else ()
            speed = min(max(entity.target_speed, 0.1), model.max_speed)
            return Actor(entity.name, entity.model, pose, path=path, policy=entity.policy, target_speed=speed)
        phases = entity.phases
        if entity.speed > 0.0:
            phases = (Phase(min(entity.speed, model.max_speed)), *phases)
            self.omissions[f"'{entity.name}' starts from rest, and then goes for {entity.speed:g} m/s"] += 1
        return Actor(entity.name, entity.model, pose, phases=phases, path=self._path(entity, pose) if phases else ())

    def _path(self, entity: Entity, pose: Pose) -> tuple[tuple[float, float], ...]:
        """Return the path of an actor: from the file, else its lane; () is straight on."""
        if entity.path:
            return () if _is_straight(entity.path) else tuple((point.x, point.y) for point in entity.path)
        if entity.model == "walker":
            points = (pose, *entity.route) if len(entity.route) == 1 else entity.route
            return tuple((point.x, point.y) for point in points)
        if entity.route:
            points = (pose, *entity.route) if len(entity.route) == 1 else entity.route
            try:
                return tuple((x, y) for x, y in route_along(self.graph, points).xy.tolist())
            except RouteError:
                self.omissions[f"the route of '{entity.name}', which the town's lanes do not allow"] += 1
        place = self.places.lane_under(pose)
        if place is None:
            return ()
        lane_points = lane_path(self.graph, place, WAY)
        start_offset = -math.sin(pose.yaw) * (pose.x - lane_points[0, 0]) + math.cos(pose.yaw) * (
            pose.y - lane_points[0, 1]
        )
        arc_lengths = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(lane_points, axis=0).T))])
        distances = np.arange(0.0, arc_lengths[-1], 1.0)
        if len(distances) < 2:
            return ()
        resampled = np.stack([np.interp(distances, arc_lengths, lane_points[:, axis]) for axis in range(2)], 1)
        offsets = np.full(len(distances), start_offset)
        if entity.change is not None:
            change_start, lanes, length = entity.change
            width = self.graph.at(place.lane, place.s)[3]
            change_share = np.clip((distances - change_start) / length, 0.0, 1.0)
            # A half cosine has no kink at either end of the lane change.
            offsets = offsets + lanes * width * 0.5 * (1.0 - np.cos(np.pi * change_share))
        tangents = np.gradient(resampled, axis=0)
        normals = np.stack([-tangents[:, 1], tangents[:, 0]], 1) / np.hypot(*tangents.T)[:, None]
        return tuple((x, y) for x, y in (resampled + offsets[:, None] * normals).tolist())

    def _plan(self, line: Route, forced: dict[str, str]) -> SignalPlan:
        """The plan that forces just these signals; what no plan does is lost."""
        if not forced:
            return SignalPlan()
        signal_numbers = {name: signal for signal, name in town_signals(self.town).items()}
        signal_numbers |= {f"ssad:{signal}": signal for signal in np.flatnonzero(self.graph.signal_virtual).tolist()}
        forced_states: dict[int, SignalState] = {}
        for name, state_name in forced.items():
            state = next(
                (candidate for candidate in SignalState if candidate.name.lower() == state_name.strip().lower()), None
            )
            if state is None or name not in signal_numbers:
                self.omissions[f"state '{state_name[:40]}' of signal '{name[:40]}'"] += 1
            else:
                forced_states[signal_numbers[name]] = state
        end_time = 60.0
        if "signals_until" in self.own_properties:
            try:
                end_time = float(self.own_properties["signals_until"])
            except ValueError:
                raise self.values.error("Property", "ssad.signals_until is not a number") from None
        plan = plan_of(self.graph, line, forced_states, end_time)
        if plan is None:
            self.omissions[f"the states of {len(forced_states)} signals, which no signal plan here gives"] += 1
        return plan or SignalPlan()


def _with_headings(positions: list[Element | None], poses: tuple[Pose, ...]) -> tuple[Pose, ...]:
    """Return the poses; world positions without a heading face the next position."""
    result = list(poses)
    for index, position in enumerate(positions):
        world_position = None if position is None else position.find("WorldPosition")
        if world_position is None or world_position.get("h") is not None or len(poses) < 2:
            continue
        start, end = (poses[index], poses[index + 1]) if index + 1 < len(poses) else (poses[index - 1], poses[index])
        result[index] = replace(poses[index], yaw=math.atan2(end.y - start.y, end.x - start.x))
    return tuple(result)


def _is_straight(points: tuple[Pose, ...]) -> bool:
    """Return whether a path is two points, the second straight ahead of the first, which needs no path."""
    if len(points) != 2:
        return False
    start, end = points
    length = math.dist((start.x, start.y), (end.x, end.y))
    forward_distance = math.cos(start.yaw) * (end.x - start.x) + math.sin(start.yaw) * (end.y - start.y)
    return length > 0.0 and length - forward_distance < 1e-6
