"""Scenarios as OpenSCENARIO XML 1.2: the episode of a scenario, with places, paths and triggers of all agents.

A vehicle's reference point is the centre of its body, as its bounding box and axles state. The ego is left to the
system under test: it has a start, a route and a target speed. Facts that only SSAD understands are properties whose
names begin with `ssad.`; facts that the format cannot express are reported to the caller.
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
    Controller,
    Episode,
    EpisodeAgent,
    EpisodeLimits,
    Model,
    PhaseTrigger,
    Pose,
    SignalState,
)
from ssad.simulators.carla.blueprints import BLUEPRINTS, CATEGORY
from ssad.world.models import model

DATE: Final = "2026-01-01T00:00:00"  # required by the format; fixed, so that a scenario always gives the same text
FAR: Final = 500.0  # m, length of the path of an agent that drives straight on
EVERY: Final = 20  # every 20th point of a route becomes a waypoint
_POLICIES = {Controller.AUTOPILOT: "autopilot", Controller.FOLLOW: "blind"}
_MASS = {AgentKind.WALKER: 75.0, AgentKind.PROP: 50.0}  # kg; required by the format, used by nothing here


def openscenario_text(
    episode: Episode, graph: LaneGraph, *, network: str, signals: Mapping[int, str], dt: float = 0.1
) -> tuple[str, tuple[str, ...]]:
    """Write an episode as OpenSCENARIO XML 1.2.

    Args:
        episode: The episode.
        graph: Its town.
        network: Path of the town's OpenDRIVE file, as the text refers to it.
        signals: Id in that file of the town's signals, by number.
        dt: Step of the world, s.

    Returns:
        The text, the same for the same episode, and the features that it does not carry over, one line each.
    """
    return _Writer(episode, graph, signals, dt).write(network)


def _node(parent: Element, tag: str, **attributes: Any) -> Element:
    return SubElement(parent, tag, {name.rstrip("_"): _text(value) for name, value in attributes.items()})


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return repr(float(value)) if isinstance(value, (float, np.floating)) else str(value)


class _Writer:
    """Builder of one document."""

    def __init__(self, episode: Episode, graph: LaneGraph, signals: Mapping[int, str], dt: float) -> None:
        self.episode, self.graph, self.signals = episode, graph, signals
        limits = episode.limits
        self.dt, self.until = dt, min(limits.max_steps * dt, limits.max_time)
        self.omissions: list[str] = []
        self.names = _unique_names([agent.name for agent in episode.agents])

    def write(self, network: str) -> tuple[str, tuple[str, ...]]:
        scenario = self.episode.scenario
        root = Element("OpenSCENARIO")
        header = _node(
            root, "FileHeader", revMajor=1, revMinor=2, date=DATE, author="SSAD", description=f"{scenario.name}"
        )
        metadata = {
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
        for name, value in metadata.items():
            _node(properties, "Property", name=f"ssad.{name}", value=_text(value))
        _node(root, "ParameterDeclarations")
        _node(root, "CatalogLocations")
        _node(_node(root, "RoadNetwork"), "LogicFile", filepath=network)
        entities = _node(root, "Entities")
        for name, agent in zip(self.names, self.episode.agents, strict=True):
            self._write_entity(entities, name, agent)
        storyboard = _node(root, "Storyboard")
        self._write_init(_node(_node(storyboard, "Init"), "Actions"))
        self._write_story(storyboard)
        self._write_stop_condition(_node(storyboard, "StopTrigger"))
        indent(root, " ")
        text = '<?xml version="1.0" encoding="UTF-8"?>\n' + tostring(root, encoding="unicode") + "\n"
        return text, tuple(self.omissions)

    # ------------------------------------------------------------ entities

    def _write_entity(self, entities: Element, name: str, agent: EpisodeAgent) -> None:
        agent_model = model(agent.model)
        scenario_object = _node(entities, "ScenarioObject", name=name)
        blueprint = BLUEPRINTS.get(agent.model, agent.model)
        mass = _MASS.get(agent_model.kind, 1500.0)
        if agent_model.kind == AgentKind.WALKER:
            body_element = _node(
                scenario_object,
                "Pedestrian",
                name=blueprint,
                mass=mass,
                pedestrianCategory="pedestrian",
                model=blueprint,
            )
        elif agent_model.kind == AgentKind.PROP:
            body_element = _node(
                scenario_object, "MiscObject", name=blueprint, mass=mass, miscObjectCategory="obstacle"
            )
        else:
            body_element = _node(
                scenario_object, "Vehicle", name=blueprint, mass=mass, vehicleCategory=CATEGORY[agent_model.kind]
            )
        _node(body_element, "ParameterDeclarations")
        bounding_box = _node(body_element, "BoundingBox")
        _node(bounding_box, "Center", x=0.0, y=0.0, z=0.5 * agent_model.height)
        _node(bounding_box, "Dimensions", width=agent_model.width, length=agent_model.length, height=agent_model.height)
        if agent_model.kind not in _MASS:
            _write_vehicle(body_element, agent_model)
        properties = _node(body_element, "Properties")
        _node(properties, "Property", name="type", value="simulation" if agent is not self._ego else "ego_vehicle")
        _node(properties, "Property", name="ssad.model", value=agent.model)

    @property
    def _ego(self) -> EpisodeAgent:
        return self.episode.agents[0]

    # ------------------------------------------------------------ the start

    def _write_init(self, actions: Element) -> None:
        mapped_signals = {
            signal_index: state
            for signal_index, state in sorted(self.episode.signal_override.items())
            if signal_index in self.signals
        }
        unmapped_count = len(self.episode.signal_override) - len(mapped_signals)
        for signal, state in mapped_signals.items():
            infrastructure = _node(_node(actions, "GlobalAction"), "InfrastructureAction")
            signal_action = _node(infrastructure, "TrafficSignalAction")
            _node(
                signal_action,
                "TrafficSignalStateAction",
                name=self.signals[signal],
                state=SignalState(state).name.lower(),
            )
        if unmapped_count:
            self.omissions.append(
                f"{unmapped_count} signals that are forced are not in the map: other programs do not know them"
            )
        if self.episode.signal_override and self.episode.override_until < self.until:
            self.omissions.append(f"signals are forced only until {self.episode.override_until:g} s: others keep them")
        uncontrolled_count = int((~self.graph.signal_virtual).sum()) - len(
            set(self.episode.signal_override) & set(self.signals)
        )
        if uncontrolled_count:
            self.omissions.append(f"the programme of {uncontrolled_count} other signals of the town is not written")
        for name, agent in zip(self.names, self.episode.agents, strict=True):
            if agent.trajectory and agent.trajectory[0][0] > 0.0:
                continue  # an event adds it later
            agent_actions = _node(actions, "Private", entityRef=name)
            action = _node(agent_actions, "PrivateAction")
            _write_position(_node(action, "TeleportAction"), agent.pose)
            if model(agent.model).kind == AgentKind.PROP:
                continue
            _write_speed(_node(agent_actions, "PrivateAction"), agent.speed, "step", "time", 0.0)
            policy = agent.policy or _POLICIES.get(agent.controller, "")
            if agent is self._ego or policy:
                self._write_controller(agent_actions, agent, policy or "system under test")
            if agent.wake_distance > 0.0:
                self.omissions.append(
                    f"{name} waits until the ego is within {agent.wake_distance:g} m: it starts at once"
                )

    def _write_controller(self, private: Element, agent: EpisodeAgent, driver: str) -> None:
        controller_action = _node(_node(_node(private, "PrivateAction"), "ControllerAction"), "AssignControllerAction")
        properties = _node(_node(controller_action, "Controller", name=driver), "Properties")
        module = "external_control" if agent is self._ego else "npc_vehicle_control"
        for key, value in {"module": module, "target_speed": float(agent.target_speed)}.items():
            _node(properties, "Property", name=key, value=_text(value))
        points = self._key_points(agent)
        if not points:
            return
        route_action = _node(_node(_node(private, "PrivateAction"), "RoutingAction"), "AssignRouteAction")
        route = _node(route_action, "Route", name=f"route of {driver}", closed=False)
        for pose in points:
            _write_position(_node(route, "Waypoint", routeStrategy="shortest"), pose)

    def _key_points(self, agent: EpisodeAgent) -> tuple[Pose, ...]:
        scenario = self.episode.scenario
        if agent is self._ego:
            return scenario.route
        actor_index = self.episode.agents.index(agent) - 1
        if scenario.actors and scenario.actors[actor_index].path:
            return tuple(Pose(x, y) for x, y in scenario.actors[actor_index].path)
        if agent.route is None:
            return ()
        rows = np.column_stack([agent.route.xy, agent.route.yaw]).astype(np.float64)
        row_indices = [*range(0, len(rows) - 1, EVERY), len(rows) - 1]
        return tuple(Pose(*row) for row in rows[row_indices].tolist())

    # ------------------------------------------------------------ the storyboard

    def _write_story(self, board: Element) -> None:
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
                self._trajectory_event(maneuver, name, agent)
            else:
                self._phase_events(maneuver, name, agent)
        if act is None:  # the format requires an act in a story
            return
        trigger = _node(act, "StartTrigger")
        _by_time(_node(trigger, "ConditionGroup"), "start of the act", 0.0)

    def _trajectory_event(self, maneuver: Element, name: str, agent: EpisodeAgent) -> None:
        rows = np.array(agent.trajectory)
        if rows[0, 0] < 0.0 < rows[-1, 0]:  # rows before the start have no effect
            first_future = int(np.searchsorted(rows[:, 0], 0.0, side="right"))
            current_row = np.array([0.0, agent.pose.x, agent.pose.y, agent.pose.yaw])
            rows = np.concatenate([current_row[None], rows[first_future:]])
        begin_time, end_time = float(rows[0, 0]), float(rows[-1, 0])
        if begin_time > 0.0:
            event = self._event(maneuver, f"{name} appears", "parallel")
            action = _node(_node(event, "Action", name=f"add {name}"), "GlobalAction")
            entity = _node(_node(action, "EntityAction", entityRef=name), "AddEntityAction")
            _write_position(entity, Pose(*rows[0, 1:].tolist()))
            _by_time(_node(_node(event, "StartTrigger"), "ConditionGroup"), f"{name} is due", begin_time)
        event = self._event(maneuver, f"{name} drives", "override")
        follow_action = self._follow_trajectory(event, name, [(row[0], Pose(*row[1:])) for row in rows.tolist()])
        timing = _node(follow_action, "TimeReference")
        _node(timing, "Timing", domainAbsoluteRelative="absolute", scale=1.0, offset=0.0)
        _node(follow_action, "TrajectoryFollowingMode", followingMode="position")
        _by_time(_node(_node(event, "StartTrigger"), "ConditionGroup"), f"start of {name}", max(begin_time, 0.0))
        if end_time < self.until:
            event = self._event(maneuver, f"{name} is gone", "parallel")
            action = _node(_node(event, "Action", name=f"delete {name}"), "GlobalAction")
            _node(_node(action, "EntityAction", entityRef=name), "DeleteEntityAction")
            _by_time(_node(_node(event, "StartTrigger"), "ConditionGroup"), f"end of {name}", end_time)

    def _phase_events(self, maneuver: Element, name: str, agent: EpisodeAgent) -> None:
        event = self._event(maneuver, f"{name} keeps its path", "parallel")
        if agent.route is not None:
            rows = np.column_stack([agent.route.xy, agent.route.yaw]).astype(np.float64)
            points = [Pose(*row) for row in rows.tolist()]
        else:
            start = agent.pose
            end = Pose(start.x + FAR * math.cos(start.yaw), start.y + FAR * math.sin(start.yaw), start.yaw)
            points = [start, end]
        follow_action = self._follow_trajectory(event, name, [(None, pose) for pose in points])
        _node(_node(follow_action, "TimeReference"), "None")
        _node(follow_action, "TrajectoryFollowingMode", followingMode="position")
        _by_time(_node(_node(event, "StartTrigger"), "ConditionGroup"), f"path of {name}", 0.0)
        agent_model = model(agent.model)
        speed, previous_event = agent.speed, ""
        for phase_index, phase in enumerate(agent.phases):
            target_speed = phase.speed or 0.0
            event = self._event(maneuver, f"{name} phase {phase_index}", "override")
            action = _node(_node(event, "Action", name=f"{name} speed {phase_index}"), "PrivateAction")
            if agent_model.kind == AgentKind.WALKER:
                _write_speed(action, target_speed, "step", "time", 0.0)
            else:
                acceleration = agent_model.max_accel if target_speed >= speed else agent_model.max_brake
                _write_speed(action, target_speed, "linear", "rate", acceleration)
            trigger = _node(event, "StartTrigger")
            # phases are latched, one after another: an event waits until the previous one runs or is complete
            for state in ("runningState", "completeState") if previous_event else ("",):
                condition_group = _node(trigger, "ConditionGroup")
                if phase.when.kind != "after":
                    self._condition(condition_group, f"{name} condition {phase_index}", name, phase.when)
                elif not previous_event:
                    _by_time(condition_group, f"{name} condition {phase_index}", phase.when.value)
                if state:
                    delay = phase.when.value if phase.when.kind == "after" else 0.0
                    value_condition = _node(
                        _condition(condition_group, f"{name} {phase_index} after {phase_index - 1}", delay),
                        "ByValueCondition",
                    )
                    _node(
                        value_condition,
                        "StoryboardElementStateCondition",
                        storyboardElementType="event",
                        storyboardElementRef=previous_event,
                        state=state,
                    )
            speed, previous_event = target_speed, f"{name} phase {phase_index}"

    def _event(self, maneuver: Element, name: str, priority: str) -> Element:
        return _node(maneuver, "Event", name=name, priority=priority, maximumExecutionCount=1)

    def _follow_trajectory(self, event: Element, name: str, vertices: list[tuple[float | None, Pose]]) -> Element:
        action = _node(_node(event, "Action", name=f"path of {name}"), "PrivateAction")
        follow_action = _node(_node(action, "RoutingAction"), "FollowTrajectoryAction")
        trajectory = _node(
            _node(follow_action, "TrajectoryRef"), "Trajectory", name=f"trajectory of {name}", closed=False
        )
        polyline = _node(_node(trajectory, "Shape"), "Polyline")
        for time, pose in vertices:
            vertex = _node(polyline, "Vertex", **({} if time is None else {"time": time}))
            _write_position(vertex, pose)
        return follow_action

    def _condition(self, group: Element, label: str, name: str, condition: PhaseTrigger) -> None:
        if condition.kind in ("always", "time"):
            _by_time(group, label, condition.value if condition.kind == "time" else 0.0)
            return
        ego = self.names[0]
        subject = name if condition.kind == "travelled" else ego
        entity_condition = _by_entity(group, label, subject)
        if condition.kind == "travelled":
            _node(entity_condition, "TraveledDistanceCondition", value=float(condition.value))
        elif condition.kind == "ego_speed":
            _node(entity_condition, "SpeedCondition", value=float(condition.value), rule="greaterThan")
        else:
            _node(
                entity_condition,
                "RelativeDistanceCondition",
                entityRef=self.names[1 + condition.actor],
                value=float(condition.value),
                relativeDistanceType="euclidianDistance",
                freespace=False,
                rule="lessThan",
                coordinateSystem="entity",
            )

    def _write_stop_condition(self, trigger: Element) -> None:
        limits: EpisodeLimits = self.episode.limits
        _by_time(_node(trigger, "ConditionGroup"), "max_steps", limits.max_steps * self.dt)
        if math.isfinite(limits.max_time):
            _by_time(_node(trigger, "ConditionGroup"), "max_time", limits.max_time)
        ego = self.names[0]
        if limits.max_distance < EpisodeLimits().max_distance:
            entity_condition = _by_entity(_node(trigger, "ConditionGroup"), "max_distance", ego)
            _node(entity_condition, "TraveledDistanceCondition", value=float(limits.max_distance))
        if limits.contact == "end":
            for name in self.names[1:]:
                entity_condition = _by_entity(_node(trigger, "ConditionGroup"), f"collision with {name}", ego)
                _node(_node(entity_condition, "CollisionCondition"), "EntityRef", entityRef=name)
        elif limits.contact == "remove":
            self.omissions.append(
                "who touches the ego is taken away: there is no such action, contacts are only counted"
            )
        entity_condition = _by_entity(_node(trigger, "ConditionGroup"), "end of the route", ego)
        _write_position(
            _node(entity_condition, "ReachPositionCondition", tolerance=10.0), self.episode.scenario.route[-1]
        )


def _unique_names(names: list[str]) -> list[str]:
    """Return the names, with a number behind repeated ones."""
    unique: list[str] = []
    for name in names:
        base_name, suffix = name or "actor", 2
        while (
            candidate := base_name if suffix == 2 and base_name not in unique else f"{base_name} {suffix}"
        ) in unique:
            suffix += 1
        unique.append(candidate)
    return unique


def _write_vehicle(item: Element, body: Model) -> None:
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


def _write_position(parent: Element, pose: Pose) -> None:
    _node(_node(parent, "Position"), "WorldPosition", x=float(pose.x), y=float(pose.y), z=0.0, h=float(pose.yaw))


def _write_speed(action: Element, speed: float, shape: str, dimension: str, value: float) -> None:
    speed_action = _node(_node(action, "LongitudinalAction"), "SpeedAction")
    _node(speed_action, "SpeedActionDynamics", dynamicsShape=shape, dynamicsDimension=dimension, value=float(value))
    _node(_node(speed_action, "SpeedActionTarget"), "AbsoluteTargetSpeed", value=float(speed))


def _condition(group: Element, name: str, delay: float = 0.0) -> Element:
    return _node(group, "Condition", name=name, delay=float(delay), conditionEdge="none")


def _by_time(group: Element, name: str, time: float) -> None:
    value_condition = _node(_condition(group, name), "ByValueCondition")
    _node(value_condition, "SimulationTimeCondition", value=float(time), rule="greaterOrEqual")


def _by_entity(group: Element, name: str, entity_name: str) -> Element:
    entity_condition = _node(_condition(group, name), "ByEntityCondition")
    _node(
        _node(entity_condition, "TriggeringEntities", triggeringEntitiesRule="any"), "EntityRef", entityRef=entity_name
    )
    return _node(entity_condition, "EntityCondition")
