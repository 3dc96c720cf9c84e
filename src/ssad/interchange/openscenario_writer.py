"""Scenarios as OpenSCENARIO XML 1.2: the episode that a scenario means, with everybody's place, path and triggers.

A vehicle's reference point is the centre of its body, which its bounding box and axles say too. The ego is left to
whoever drives it: it has a start, a route and a target speed. What only this program understands stands in properties
whose names begin with `ssad.`; what no program could understand is told to the caller.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np

from ssad.core.lane_graph import LaneGraph
from ssad.core.types import (
    AgentKind,
    Condition,
    Controller,
    Episode,
    EpisodeAgent,
    Limits,
    Model,
    Pose,
    SignalState,
)
from ssad.simulators.carla.blueprints import BLUEPRINTS, CATEGORY
from ssad.world.models import model

DATE: Final = "2026-01-01T00:00:00"  # required by the format; fixed, so that a scenario always gives the same text
FAR: Final = 500.0  # m that who goes straight on is told to go
EVERY: Final = 20  # points of a route between the waypoints that are written
_POLICIES = {Controller.AUTOPILOT: "autopilot", Controller.FOLLOW: "blind"}
_MASS = {AgentKind.WALKER: 75.0, AgentKind.PROP: 50.0}  # kg; required by the format, used by nothing here


def openscenario_text(
    episode: Episode, graph: LaneGraph, *, network: str, signals: Mapping[int, str], dt: float = 0.1
) -> tuple[str, tuple[str, ...]]:
    """An episode as OpenSCENARIO XML 1.2.

    Args:
        episode: The episode.
        graph: Its town.
        network: Path of the town's OpenDRIVE file, as the text refers to it.
        signals: Id in that file of the town's signals, by number.
        dt: Step of the world, s.

    Returns:
        The text, the same for the same episode, and what it does not carry over, a line each.
    """
    return _Writer(episode, graph, signals, dt).write(network)


def _node(parent: Element, tag: str, **attributes: Any) -> Element:
    return SubElement(parent, tag, {name.rstrip("_"): _text(value) for name, value in attributes.items()})


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return repr(float(value)) if isinstance(value, (float, np.floating)) else str(value)


class _Writer:
    """The parts of one document."""

    def __init__(self, episode: Episode, graph: LaneGraph, signals: Mapping[int, str], dt: float) -> None:
        self.episode, self.graph, self.signals = episode, graph, signals
        limits = episode.limits
        self.dt, self.until = dt, min(limits.max_steps * dt, limits.max_time)
        self.lost: list[str] = []
        self.names = _unique([agent.name for agent in episode.agents])

    def write(self, network: str) -> tuple[str, tuple[str, ...]]:
        scenario = self.episode.scenario
        root = Element("OpenSCENARIO")
        header = _node(
            root, "FileHeader", revMajor=1, revMinor=2, date=DATE, author="SSAD", description=f"{scenario.name}"
        )
        own = {
            "type": scenario.type,
            "group": scenario.group or scenario.type,
            "source": scenario.source,
            "signals_until": self.episode.override_until,
            "contact": self.episode.limits.contact,
            "signals": " ".join(
                f"{signal}={SignalState(state).name.lower()}"
                for signal, state in sorted(self.episode.signal_override.items())
                if signal not in self.signals
            ),
        }
        properties = _node(header, "Properties")
        for name, value in own.items():
            _node(properties, "Property", name=f"ssad.{name}", value=_text(value))
        _node(root, "ParameterDeclarations")
        _node(root, "CatalogLocations")
        _node(_node(root, "RoadNetwork"), "LogicFile", filepath=network)
        entities = _node(root, "Entities")
        for name, agent in zip(self.names, self.episode.agents, strict=True):
            self._entity(entities, name, agent)
        board = _node(root, "Storyboard")
        self._init(_node(_node(board, "Init"), "Actions"))
        self._story(board)
        self._stop(_node(board, "StopTrigger"))
        indent(root, " ")
        text = '<?xml version="1.0" encoding="UTF-8"?>\n' + tostring(root, encoding="unicode") + "\n"
        return text, tuple(self.lost)

    # ------------------------------------------------------------ who

    def _entity(self, entities: Element, name: str, agent: EpisodeAgent) -> None:
        body = model(agent.model)
        item = _node(entities, "ScenarioObject", name=name)
        blueprint = BLUEPRINTS.get(agent.model, agent.model)
        mass = _MASS.get(body.kind, 1500.0)
        if body.kind == AgentKind.WALKER:
            one = _node(item, "Pedestrian", name=blueprint, mass=mass, pedestrianCategory="pedestrian", model=blueprint)
        elif body.kind == AgentKind.PROP:
            one = _node(item, "MiscObject", name=blueprint, mass=mass, miscObjectCategory="obstacle")
        else:
            one = _node(item, "Vehicle", name=blueprint, mass=mass, vehicleCategory=CATEGORY[body.kind])
        _node(one, "ParameterDeclarations")
        box = _node(one, "BoundingBox")
        _node(box, "Center", x=0.0, y=0.0, z=0.5 * body.height)
        _node(box, "Dimensions", width=body.width, length=body.length, height=body.height)
        if body.kind not in _MASS:
            _vehicle(one, body)
        properties = _node(one, "Properties")
        _node(properties, "Property", name="type", value="simulation" if agent is not self._ego else "ego_vehicle")
        _node(properties, "Property", name="ssad.model", value=agent.model)

    @property
    def _ego(self) -> EpisodeAgent:
        return self.episode.agents[0]

    # ------------------------------------------------------------ the start

    def _init(self, actions: Element) -> None:
        named = {k: state for k, state in sorted(self.episode.signal_override.items()) if k in self.signals}
        unnamed = len(self.episode.signal_override) - len(named)
        for signal, state in named.items():
            place = _node(_node(actions, "GlobalAction"), "InfrastructureAction")
            told = _node(place, "TrafficSignalAction")
            _node(told, "TrafficSignalStateAction", name=self.signals[signal], state=SignalState(state).name.lower())
        if unnamed:
            self.lost.append(f"{unnamed} signals that are forced are not in the map: other programs do not know them")
        if self.episode.signal_override and self.episode.override_until < self.until:
            self.lost.append(f"signals are forced only until {self.episode.override_until:g} s: others keep them")
        free = int((~self.graph.signal_virtual).sum()) - len(set(self.episode.signal_override) & set(self.signals))
        if free:
            self.lost.append(f"the programme of {free} other signals of the town is not written")
        for name, agent in zip(self.names, self.episode.agents, strict=True):
            if agent.trajectory and agent.trajectory[0][0] > 0.0:
                continue  # it is added later
            private = _node(actions, "Private", entityRef=name)
            action = _node(private, "PrivateAction")
            _position(_node(action, "TeleportAction"), agent.pose)
            if model(agent.model).kind == AgentKind.PROP:
                continue
            _speed(_node(private, "PrivateAction"), agent.speed, "step", "time", 0.0)
            policy = agent.policy or _POLICIES.get(agent.controller, "")
            if agent is self._ego or policy:
                self._driver(private, agent, policy or "system under test")
            if agent.wake_distance > 0.0:
                self.lost.append(f"{name} waits until the ego is within {agent.wake_distance:g} m: it starts at once")

    def _driver(self, private: Element, agent: EpisodeAgent, driver: str) -> None:
        assign = _node(_node(_node(private, "PrivateAction"), "ControllerAction"), "AssignControllerAction")
        properties = _node(_node(assign, "Controller", name=driver), "Properties")
        module = "external_control" if agent is self._ego else "npc_vehicle_control"
        for key, value in {"module": module, "target_speed": float(agent.target_speed)}.items():
            _node(properties, "Property", name=key, value=_text(value))
        points = self._key_points(agent)
        if not points:
            return
        follow = _node(_node(_node(private, "PrivateAction"), "RoutingAction"), "AssignRouteAction")
        route = _node(follow, "Route", name=f"route of {driver}", closed=False)
        for pose in points:
            _position(_node(route, "Waypoint", routeStrategy="shortest"), pose)

    def _key_points(self, agent: EpisodeAgent) -> tuple[Pose, ...]:
        scenario = self.episode.scenario
        if agent is self._ego:
            return scenario.route
        number = self.episode.agents.index(agent) - 1
        if scenario.actors and scenario.actors[number].path:
            return tuple(Pose(x, y) for x, y in scenario.actors[number].path)
        if agent.route is None:
            return ()
        rows = np.column_stack([agent.route.xy, agent.route.yaw]).astype(np.float64)
        kept = [*range(0, len(rows) - 1, EVERY), len(rows) - 1]
        return tuple(Pose(*row) for row in rows[kept].tolist())

    # ------------------------------------------------------------ what happens

    def _story(self, board: Element) -> None:
        act = None
        for name, agent in zip(self.names[1:], self.episode.agents[1:], strict=True):
            if not (agent.trajectory or (agent.controller == Controller.SCRIPT and agent.phases)):
                continue
            if act is None:
                story = _node(board, "Story", name=self.episode.scenario.name)
                act = _node(story, "Act", name="act")
            group = _node(act, "ManeuverGroup", name=f"group {name}", maximumExecutionCount=1)
            _node(_node(group, "Actors", selectTriggeringEntities=False), "EntityRef", entityRef=name)
            maneuver = _node(group, "Maneuver", name=f"maneuver {name}")
            if agent.trajectory:
                self._recorded(maneuver, name, agent)
            else:
                self._scripted(maneuver, name, agent)
        if act is None:  # the format asks for one
            return
        trigger = _node(act, "StartTrigger")
        _by_time(_node(trigger, "ConditionGroup"), "start of the act", 0.0)

    def _recorded(self, maneuver: Element, name: str, agent: EpisodeAgent) -> None:
        rows = np.array(agent.trajectory)
        if rows[0, 0] < 0.0 < rows[-1, 0]:  # what was before the start plays no part
            after = int(np.searchsorted(rows[:, 0], 0.0, side="right"))
            now = np.array([0.0, agent.pose.x, agent.pose.y, agent.pose.yaw])
            rows = np.concatenate([now[None], rows[after:]])
        begin, end = float(rows[0, 0]), float(rows[-1, 0])
        if begin > 0.0:
            event = self._event(maneuver, f"{name} appears", "parallel")
            action = _node(_node(event, "Action", name=f"add {name}"), "GlobalAction")
            entity = _node(_node(action, "EntityAction", entityRef=name), "AddEntityAction")
            _position(entity, Pose(*rows[0, 1:].tolist()))
            _by_time(_node(_node(event, "StartTrigger"), "ConditionGroup"), f"{name} is due", begin)
        event = self._event(maneuver, f"{name} drives", "override")
        follow = self._follow(event, name, [(row[0], Pose(*row[1:])) for row in rows.tolist()])
        timing = _node(follow, "TimeReference")
        _node(timing, "Timing", domainAbsoluteRelative="absolute", scale=1.0, offset=0.0)
        _node(follow, "TrajectoryFollowingMode", followingMode="position")
        _by_time(_node(_node(event, "StartTrigger"), "ConditionGroup"), f"start of {name}", max(begin, 0.0))
        if end < self.until:
            event = self._event(maneuver, f"{name} is gone", "parallel")
            action = _node(_node(event, "Action", name=f"delete {name}"), "GlobalAction")
            _node(_node(action, "EntityAction", entityRef=name), "DeleteEntityAction")
            _by_time(_node(_node(event, "StartTrigger"), "ConditionGroup"), f"end of {name}", end)

    def _scripted(self, maneuver: Element, name: str, agent: EpisodeAgent) -> None:
        event = self._event(maneuver, f"{name} keeps its path", "parallel")
        if agent.route is not None:
            rows = np.column_stack([agent.route.xy, agent.route.yaw]).astype(np.float64)
            points = [Pose(*row) for row in rows.tolist()]
        else:
            here = agent.pose
            there = Pose(here.x + FAR * math.cos(here.yaw), here.y + FAR * math.sin(here.yaw), here.yaw)
            points = [here, there]
        follow = self._follow(event, name, [(None, pose) for pose in points])
        _node(_node(follow, "TimeReference"), "None")
        _node(follow, "TrajectoryFollowingMode", followingMode="position")
        _by_time(_node(_node(event, "StartTrigger"), "ConditionGroup"), f"path of {name}", 0.0)
        body = model(agent.model)
        speed, before = agent.speed, ""
        for k, phase in enumerate(agent.phases):
            event = self._event(maneuver, f"{name} phase {k}", "override")
            action = _node(_node(event, "Action", name=f"{name} speed {k}"), "PrivateAction")
            if body.kind == AgentKind.WALKER:
                _speed(action, phase.speed, "step", "time", 0.0)
            else:
                rate = body.max_accel if phase.speed >= speed else body.max_brake
                _speed(action, phase.speed, "linear", "rate", rate)
            trigger = _node(event, "StartTrigger")
            # phases are latched, one after the other: an event waits for the one before it to run, or to be over
            for state in ("runningState", "completeState") if before else ("",):
                group = _node(trigger, "ConditionGroup")
                if phase.when.kind != "after":
                    self._condition(group, f"{name} condition {k}", name, phase.when)
                elif not before:
                    _by_time(group, f"{name} condition {k}", phase.when.value)
                if state:
                    delay = phase.when.value if phase.when.kind == "after" else 0.0
                    by = _node(_condition(group, f"{name} {k} after {k - 1}", delay), "ByValueCondition")
                    _node(
                        by,
                        "StoryboardElementStateCondition",
                        storyboardElementType="event",
                        storyboardElementRef=before,
                        state=state,
                    )
            speed, before = phase.speed, f"{name} phase {k}"

    def _event(self, maneuver: Element, name: str, priority: str) -> Element:
        return _node(maneuver, "Event", name=name, priority=priority, maximumExecutionCount=1)

    def _follow(self, event: Element, name: str, vertices: list[tuple[float | None, Pose]]) -> Element:
        action = _node(_node(event, "Action", name=f"path of {name}"), "PrivateAction")
        follow = _node(_node(action, "RoutingAction"), "FollowTrajectoryAction")
        told = _node(_node(follow, "TrajectoryRef"), "Trajectory", name=f"trajectory of {name}", closed=False)
        line = _node(_node(told, "Shape"), "Polyline")
        for time, pose in vertices:
            vertex = _node(line, "Vertex", **({} if time is None else {"time": time}))
            _position(vertex, pose)
        return follow

    def _condition(self, group: Element, label: str, name: str, when: Condition) -> None:
        if when.kind in ("always", "time"):
            _by_time(group, label, when.value if when.kind == "time" else 0.0)
            return
        ego = self.names[0]
        who = name if when.kind == "travelled" else ego
        entity = _by_entity(group, label, who)
        if when.kind == "travelled":
            _node(entity, "TraveledDistanceCondition", value=float(when.value))
        elif when.kind == "ego_speed":
            _node(entity, "SpeedCondition", value=float(when.value), rule="greaterThan")
        else:
            _node(
                entity,
                "RelativeDistanceCondition",
                entityRef=self.names[1 + when.actor],
                value=float(when.value),
                relativeDistanceType="euclidianDistance",
                freespace=False,
                rule="lessThan",
                coordinateSystem="entity",
            )

    def _stop(self, trigger: Element) -> None:
        limits: Limits = self.episode.limits
        _by_time(_node(trigger, "ConditionGroup"), "max_steps", limits.max_steps * self.dt)
        if math.isfinite(limits.max_time):
            _by_time(_node(trigger, "ConditionGroup"), "max_time", limits.max_time)
        ego = self.names[0]
        if limits.max_distance < Limits().max_distance:
            entity = _by_entity(_node(trigger, "ConditionGroup"), "max_distance", ego)
            _node(entity, "TraveledDistanceCondition", value=float(limits.max_distance))
        if limits.contact == "end":
            for name in self.names[1:]:
                entity = _by_entity(_node(trigger, "ConditionGroup"), f"collision with {name}", ego)
                _node(_node(entity, "CollisionCondition"), "EntityRef", entityRef=name)
        elif limits.contact == "remove":
            self.lost.append("who touches the ego is taken away: there is no such action, contacts are only counted")
        entity = _by_entity(_node(trigger, "ConditionGroup"), "end of the route", ego)
        _position(_node(entity, "ReachPositionCondition", tolerance=10.0), self.episode.scenario.route[-1])


def _unique(names: list[str]) -> list[str]:
    """The names, with a number behind those that are there twice."""
    found: list[str] = []
    for name in names:
        plain, number = name or "actor", 2
        while (told := plain if number == 2 and plain not in found else f"{plain} {number}") in found:
            number += 1
        found.append(told)
    return found


def _vehicle(item: Element, body: Model) -> None:
    _node(
        item,
        "Performance",
        maxSpeed=float(body.max_speed),
        maxAcceleration=float(body.max_accel),
        maxDeceleration=float(body.max_brake),
    )
    axles = _node(item, "Axles")
    for tag, steer, x in (("FrontAxle", body.max_steer, 0.5), ("RearAxle", 0.0, -0.5)):
        _node(
            axles,
            tag,
            maxSteering=float(steer),
            wheelDiameter=0.7,
            trackWidth=0.85 * body.width,
            positionX=x * body.wheelbase,
            positionZ=0.35,
        )


def _position(parent: Element, pose: Pose) -> None:
    _node(_node(parent, "Position"), "WorldPosition", x=float(pose.x), y=float(pose.y), z=0.0, h=float(pose.yaw))


def _speed(action: Element, speed: float, shape: str, dimension: str, value: float) -> None:
    told = _node(_node(action, "LongitudinalAction"), "SpeedAction")
    _node(told, "SpeedActionDynamics", dynamicsShape=shape, dynamicsDimension=dimension, value=float(value))
    _node(_node(told, "SpeedActionTarget"), "AbsoluteTargetSpeed", value=float(speed))


def _condition(group: Element, name: str, delay: float = 0.0) -> Element:
    return _node(group, "Condition", name=name, delay=float(delay), conditionEdge="none")


def _by_time(group: Element, name: str, time: float) -> None:
    by = _node(_condition(group, name), "ByValueCondition")
    _node(by, "SimulationTimeCondition", value=float(time), rule="greaterOrEqual")


def _by_entity(group: Element, name: str, who: str) -> Element:
    by = _node(_condition(group, name), "ByEntityCondition")
    _node(_node(by, "TriggeringEntities", triggeringEntitiesRule="any"), "EntityRef", entityRef=who)
    return _node(by, "EntityCondition")
