"""Scenarios as OpenSCENARIO XML 1.2: the episode of a scenario, with places, paths and triggers of all agents.

A vehicle's reference point is the centre of its body, as its bounding box and axles state. The ego is left to the
system under test: it has a start, a route and a target speed. Facts that only SSAD understands are properties whose
names begin with `ssad.`; facts that the format cannot express are reported to the caller.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any, Final
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np

from ssad.core.lane_graph import LaneGraph
from ssad.core.triggers import EGO, default_rule, reference_of, trigger_groups
from ssad.core.types import (
    DEFAULT_FRICTION,
    AgentKind,
    Controller,
    Episode,
    EpisodeAgent,
    EpisodeLimits,
    FollowingGap,
    LateralPhase,
    Model,
    Phase,
    PhaseTrigger,
    Pose,
    SignalState,
)
from ssad.core.wording import counted
from ssad.simulators.carla.blueprints import BLUEPRINTS, CATEGORY
from ssad.world.models import agent_model

DATE: Final = "2026-01-01T00:00:00"  # required by the format; fixed, so that a scenario always gives the same text
FAR: Final = 500.0  # m, length of the path of an agent that drives straight on
EVERY: Final = 20  # every 20th point of a route becomes a waypoint
LATERAL_TIME: Final = 3.0  # s of a lane change that states no pace
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
        self.events = self._event_names()

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

    def _event_names(self) -> dict[tuple[str, str, int], str]:
        """Return the name of the event of each phase: by agent, phase or lane change, and number."""
        phases = [
            (name, title, index, phase.name)
            for name, agent in zip(self.names, self.episode.agents, strict=True)
            for title, phases in _phase_lists(agent)
            for index, phase in enumerate(phases)
        ]
        stated = [phase_name for *_, phase_name in phases]
        return {
            (name, title, index): phase_name
            if stated.count(phase_name) == 1 and phase_name
            else f"{name} {title} {index}"
            for name, title, index, phase_name in phases
        }

    # ------------------------------------------------------------ entities

    def _write_entity(self, entities: Element, name: str, agent: EpisodeAgent) -> None:
        body = agent_model(agent)
        scenario_object = _node(entities, "ScenarioObject", name=name)
        blueprint = BLUEPRINTS.get(agent.model, agent.model)
        mass = _MASS.get(body.kind, 1500.0)
        if body.kind == AgentKind.WALKER:
            body_element = _node(
                scenario_object,
                "Pedestrian",
                name=blueprint,
                mass=mass,
                pedestrianCategory="pedestrian",
                model=blueprint,
            )
        elif body.kind == AgentKind.PROP:
            body_element = _node(
                scenario_object, "MiscObject", name=blueprint, mass=mass, miscObjectCategory="obstacle"
            )
        else:
            body_element = _node(
                scenario_object, "Vehicle", name=blueprint, mass=mass, vehicleCategory=CATEGORY[body.kind]
            )
        _node(body_element, "ParameterDeclarations")
        bounding_box = _node(body_element, "BoundingBox")
        _node(bounding_box, "Center", x=0.0, y=0.0, z=0.5 * body.height)
        _node(bounding_box, "Dimensions", width=body.width, length=body.length, height=body.height)
        if body.kind not in _MASS:
            _write_vehicle(body_element, body)
        properties = _node(body_element, "Properties")
        _node(properties, "Property", name="type", value="simulation" if agent is not self._ego else "ego_vehicle")
        _node(properties, "Property", name="ssad.model", value=agent.model)
        if agent.body.brake_build_up is not None:
            _node(properties, "Property", name="ssad.brake_build_up", value=_text(agent.body.brake_build_up))

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
        friction = self.episode.scenario.friction
        if friction != DEFAULT_FRICTION:
            environment = _node(
                _node(_node(actions, "GlobalAction"), "EnvironmentAction"), "Environment", name="surface"
            )
            _node(environment, "RoadCondition", frictionScaleFactor=friction / DEFAULT_FRICTION)
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
                f"{counted(unmapped_count, 'forced signal')} outside the map, unknown to other programs"
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
            if agent_model(agent).kind == AgentKind.PROP:
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
            is_scripted = agent.controller == Controller.SCRIPT and (agent.phases or agent.lateral or agent.speed)
            if not (agent.trajectory or is_scripted):
                continue
            if act is None:
                story = _node(board, "Story", name=self.episode.scenario.name)
                act = _node(story, "Act", name="act")
            group = _node(act, "ManeuverGroup", name=f"group {name}", maximumExecutionCount=1)
            _node(_node(group, "Actors", selectTriggeringEntities=False), "EntityRef", entityRef=name)
            if agent.trajectory:
                self._trajectory_event(_node(group, "Maneuver", name=f"maneuver {name}"), name, agent)
            else:
                self._write_script(group, name, agent)
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

    def _write_script(self, group: Element, name: str, agent: EpisodeAgent) -> None:
        """Write path, speeds and lanes, each as a maneuver of its own: an event ends others of its maneuver only."""
        maneuver = _node(group, "Maneuver", name=f"path of {name}")
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
        for title, phases in _phase_lists(agent):
            if not phases:
                continue
            maneuver = _node(group, "Maneuver", name=f"every {title} of {name}")
            before: list[str] = []  # events that a phase waits for
            speed = agent.speed
            for index, phase in enumerate(phases):
                label = self.events[name, title, index]
                event = self._event(maneuver, label, "override")
                action = _node(_node(event, "Action", name=f"{label} action"), "PrivateAction")
                if isinstance(phase, LateralPhase):
                    self._write_lane_change(action, name, phase)
                else:
                    self._write_speed_phase(action, agent, phase, speed)
                    speed = phase.speed or 0.0
                self._write_trigger(event, name, phase, before)
                before = [label, *before] if phase.anytime else [label]
        if agent.lateral:
            self.omissions.append(f"{name} changes lanes on its path: other programs leave the path then")

    def _write_speed_phase(self, action: Element, agent: EpisodeAgent, phase: Phase, speed: float) -> None:
        """Write the action of a phase; `speed` is the one before it."""
        if phase.arrival is not None:
            self._write_arrival(action, phase)
            return
        limits = agent_model(agent)
        longitudinal = _node(action, "LongitudinalAction")
        if phase.gap is not None:
            self._write_gap(longitudinal, phase, phase.gap, limits)
            return
        if phase.jerk is not None:
            acceleration = abs(phase.acceleration or limits.max_accel)
            profile = _node(longitudinal, "SpeedProfileAction", followingMode="follow")
            if phase.reference:
                profile.set("entityRef", self._agent(phase.reference))
            _node(
                profile,
                "DynamicConstraints",
                maxAcceleration=acceleration,
                maxAccelerationRate=float(phase.jerk),
                maxDeceleration=acceleration,
                maxDecelerationRate=float(phase.jerk),
            )
            _node(profile, "SpeedProfileEntry", speed=float(phase.speed or 0.0))
            return
        speed_action = _node(longitudinal, "SpeedAction")
        shape, dimension, value = _pace(phase.shape, phase.duration, phase.distance, phase.acceleration)
        if value is None:
            # Without a pace: full power or full brakes.
            rising = (phase.speed or 0.0) >= (0.0 if phase.reference else speed)
            shape, dimension, value = "linear", "rate", limits.max_accel if rising else limits.max_brake
        _node(speed_action, "SpeedActionDynamics", dynamicsShape=shape, dynamicsDimension=dimension, value=float(value))
        target = _node(speed_action, "SpeedActionTarget")
        if not phase.reference:
            _node(target, "AbsoluteTargetSpeed", value=float(phase.speed or 0.0))
            return
        _node(
            target,
            "RelativeTargetSpeed",
            entityRef=self._agent(phase.reference),
            value=float(phase.speed or 0.0),
            speedTargetValueType="factor" if phase.factor else "delta",
            continuous=phase.continuous,
        )

    def _write_gap(self, parent: Element, phase: Phase, gap: FollowingGap, limits: Model) -> None:
        displacement = {"behind": "trailingReferencedEntity", "ahead": "leadingReferencedEntity"}
        action = _node(
            parent,
            "LongitudinalDistanceAction",
            entityRef=self._agent(gap.reference),
            continuous=phase.continuous,
            freespace=gap.free_space,
            coordinateSystem="road",
            displacement=displacement.get(gap.side, "any"),
            **{"timeGap": float(gap.time)} if gap.time else {"distance": float(gap.distance)},
        )
        if gap.time and gap.distance:
            self.omissions.append("the distance of a gap that also has a time: the format has one of them")
        stated = (gap.max_acceleration or limits.max_accel, gap.max_deceleration or limits.max_brake)
        names = ("maxAcceleration", "maxDeceleration", "maxSpeed")
        values = (*stated, gap.max_speed or limits.max_speed)
        _node(action, "DynamicConstraints", **dict(zip(names, map(float, values), strict=True)))

    def _write_arrival(self, action: Element, phase: Phase) -> None:
        arrival = phase.arrival
        assert arrival is not None
        synchronize = _node(action, "SynchronizeAction", masterEntityRef=self._agent(arrival.reference))
        for tag, point in (("TargetPositionMaster", arrival.reference_point), ("TargetPosition", arrival.point)):
            _node(_node(synchronize, tag), "WorldPosition", x=float(point[0]), y=float(point[1]), z=0.0)
        if phase.speed is not None:
            _node(_node(synchronize, "FinalSpeed"), "AbsoluteSpeed", value=float(phase.speed))
        if phase.acceleration is not None:
            self.omissions.append("the acceleration on the way to a meeting point")

    def _write_lane_change(self, action: Element, name: str, phase: LateralPhase) -> None:
        change = _node(_node(action, "LateralAction"), "LaneChangeAction")
        if phase.offset:
            change.set("targetLaneOffset", _text(float(phase.offset)))
        shape, dimension, value = _pace(phase.shape, phase.duration, phase.distance, phase.rate)
        _node(
            change,
            "LaneChangeActionDynamics",
            dynamicsShape=shape,
            dynamicsDimension=dimension,
            value=LATERAL_TIME if value is None else float(value),
        )
        _node(_node(change, "LaneChangeTarget"), "RelativeTargetLane", entityRef=name, value=phase.lanes)

    def _agent(self, name: str) -> str:
        """Return the name of an agent in the file."""
        return self.names[0] if name == EGO else name

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

    def _write_trigger(self, event: Element, name: str, phase: Phase | LateralPhase, before: Sequence[str]) -> None:
        """Write the trigger of a phase, which also waits for the events before it unless it may begin at any time."""
        trigger = _node(event, "StartTrigger")
        label = event.get("name", "")
        for conditions in trigger_groups(phase.when):
            states = [state for condition in conditions if (state := self._state(condition, name, before))]
            if not phase.anytime:
                stated = [state[0] for state in states]
                states += [(other, 0.0, True) for other in before if other not in stated]
            others = [condition for condition in conditions if self._state(condition, name, before) is None]
            others = [condition for condition in others if condition.kind != "always"] or others[: not states]
            # The format has no state "has begun": an event that has begun runs, or is complete.
            ways = [("runningState", "completeState") if has_begun else ("completeState",) for *_, has_begun in states]
            for way in product(*ways):
                group = _node(trigger, "ConditionGroup")
                for number, condition in enumerate(others):
                    self._write_condition(group, f"{label} condition {number}", name, condition)
                for (other, delay, _), other_state in zip(states, way, strict=True):
                    self._write_state(group, f"{label} after {other}", other, other_state, delay)

    def _state(self, condition: PhaseTrigger, name: str, before: Sequence[str]) -> tuple[str, float, bool] | None:
        """Return event, delay, and whether it has begun, not ended, for a condition on an event; None: on others."""
        if condition.kind == "after" and before:
            return before[0], condition.value + condition.delay, True
        if condition.kind in ("phase_start", "phase_end"):
            event = self._event_of(condition.agent or name, condition.phase)
            return event, condition.delay, condition.kind == "phase_start"
        return None

    def _write_state(self, group: Element, label: str, event: str, state: str, delay: float) -> None:
        _node(
            _node(_condition(group, label, delay), "ByValueCondition"),
            "StoryboardElementStateCondition",
            storyboardElementType="event",
            storyboardElementRef=event,
            state=state,
        )

    def _write_condition(self, group: Element, label: str, name: str, condition: PhaseTrigger) -> None:
        """Write one condition of a trigger, on the time or on agents."""
        kind = condition.kind
        edge = {"both": "risingOrFalling"}.get(condition.edge, condition.edge)
        rule = condition.rule or default_rule(kind)
        if kind in ("always", "time", "after"):
            value_condition = _node(_condition(group, label, condition.delay, edge), "ByValueCondition")
            _node(
                value_condition,
                "SimulationTimeCondition",
                value=float(condition.value),
                rule="greaterOrEqual" if rule == "above" or kind == "always" else "lessThan",
            )
            return
        agent = self._agent(condition.agent or (EGO if kind.startswith("ego_") else name))
        entity_condition = _by_entity(group, label, agent, condition.delay, edge)
        if kind == "ego_distance":
            condition = replace(condition, kind="distance", reference=self.names[1 + condition.actor])
        self._write_entity_condition(entity_condition, name, condition, rule)

    def _write_entity_condition(self, parent: Element, name: str, condition: PhaseTrigger, rule: str) -> None:
        kind, value = condition.kind, float(condition.value)
        stated_rule = "greaterThan" if rule == "above" else "lessThan"
        simple = {"ego_speed": "SpeedCondition", "speed": "SpeedCondition", "acceleration": "AccelerationCondition"}
        reference = self._agent(reference_of(condition, name))
        if kind == "travelled":
            _node(parent, "TraveledDistanceCondition", value=value)
            if rule == "below":
                self.omissions.append(f"{name} waits for a short way travelled: the format has only long ones")
        elif kind in simple:
            _node(parent, simple[kind], value=value, rule=stated_rule)
        elif kind == "relative_speed":
            _node(parent, "RelativeSpeedCondition", entityRef=reference, value=value, rule=stated_rule)
        elif kind == "standstill":
            _node(parent, "StandStillCondition", duration=value)
        elif kind == "position" and rule == "below":
            reach = _node(parent, "ReachPositionCondition", tolerance=value)
            _write_position(reach, self._point(condition))
        else:
            self._write_distance(parent, condition, reference, stated_rule)

    def _write_distance(self, parent: Element, condition: PhaseTrigger, reference: str, rule: str) -> None:
        along = condition.measure != "straight"
        lateral, straight = condition.measure == "lateral", "euclidianDistance"
        attributes = {
            "value": float(condition.value),
            "freespace": condition.free_space,
            "rule": rule,
            "relativeDistanceType": "lateral" if lateral else "longitudinal" if along else straight,
            "coordinateSystem": "road" if along else "entity",
        }
        if condition.kind == "time_headway":
            _node(parent, "TimeHeadwayCondition", entityRef=reference, **attributes)
            if condition.position is not None:
                self.omissions.append("a time headway to a position: the format has only those to entities")
        elif condition.kind == "time_to_collision":
            collision = _node(parent, "TimeToCollisionCondition", **attributes)
            target = _node(collision, "TimeToCollisionConditionTarget")
            if condition.position is None:
                _node(target, "EntityRef", entityRef=reference)
            else:
                _write_position(target, self._point(condition))
        elif condition.position is not None:
            _write_position(_node(parent, "DistanceCondition", **attributes), self._point(condition))
        else:
            _node(parent, "RelativeDistanceCondition", entityRef=reference, **attributes)

    def _point(self, condition: PhaseTrigger) -> Pose:
        assert condition.position is not None
        return Pose(*condition.position)

    def _event_of(self, agent: str, phase: str) -> str:
        """Return the name of the event of a phase of an agent."""
        scripted = self.episode.agents[self.names.index(agent)]
        for title, phases in _phase_lists(scripted):
            for index, other in enumerate(phases):
                if other.name == phase:
                    return self.events[agent, title, index]
        raise AssertionError(phase)

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


def _phase_lists(agent: EpisodeAgent) -> tuple[tuple[str, Sequence[Phase | LateralPhase]], ...]:
    """Return the phases and the lateral phases of an agent, with the word for them."""
    return ("phase", agent.phases), ("lane change", agent.lateral)


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


def _pace(
    shape: str, duration: float | None, distance: float | None, rate: float | None
) -> tuple[str, str, float | None]:
    """Return shape, dimension and value of the dynamics of a phase; no value: it states none."""
    if shape == "step":
        return shape, "time", 0.0
    stated = (("time", duration), ("distance", distance), ("rate", None if rate is None else abs(rate)))
    for dimension, value in stated:
        if value is not None:
            return shape, dimension, value
    return shape, "time", None


def _condition(group: Element, name: str, delay: float = 0.0, edge: str = "none") -> Element:
    return _node(group, "Condition", name=name, delay=float(delay), conditionEdge=edge)


def _by_time(group: Element, name: str, time: float) -> None:
    value_condition = _node(_condition(group, name), "ByValueCondition")
    _node(value_condition, "SimulationTimeCondition", value=float(time), rule="greaterOrEqual")


def _by_entity(group: Element, name: str, entity_name: str, delay: float = 0.0, edge: str = "none") -> Element:
    entity_condition = _node(_condition(group, name, delay, edge), "ByEntityCondition")
    _node(
        _node(entity_condition, "TriggeringEntities", triggeringEntitiesRule="any"), "EntityRef", entityRef=entity_name
    )
    return _node(entity_condition, "EntityCondition")
