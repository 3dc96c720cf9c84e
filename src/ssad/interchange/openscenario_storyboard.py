"""Storyboard of an OpenSCENARIO document as phases, lateral phases, paths and trajectories of its entities.

An event's action becomes a phase whose trigger is that of the event and of its act. Phases begin in any order, as
events do; one that waits for the one before it stays behind it.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from ssad.core.import_report import ImportReport
from ssad.core.types import Arrival, FollowingGap, LateralPhase, Phase, PhaseTrigger, Pose
from ssad.interchange.openscenario_entities import Entity
from ssad.interchange.openscenario_places import PositionReader
from ssad.interchange.openscenario_trajectories import SampledTrajectory
from ssad.interchange.openscenario_triggers import (
    ALWAYS,
    Trigger,
    TriggerReader,
    Unfulfilled,
    all_of,
    any_of,
    both,
    conjuncts,
    is_lasting,
)
from ssad.scenarios.dynamic.knowledge._placing import LanePosition, move_pose, place_ahead, place_behind, pose_at

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

LATERAL_TIME: Final = 3.0  # s of a lateral motion whose dynamics the file does not limit
MAX_WAITING: Final = 50  # events that wait for each other, in a chain
MAX_RATE: Final = 100.0  # m/s^2 and m/s that a limit can have; beyond, it is none
MAX_PROFILE: Final = 12  # phases of a speed profile
_KINDS: Final = ("Story", "Act", "ManeuverGroup", "Maneuver", "Event", "Action")
_SHAPES: Final = ("linear", "sinusoidal", "cubic", "step")
# Actions that are over as soon as they begin.
_INSTANT: Final = (
    "TeleportAction",
    "ControllerAction",
    "ActivateControllerAction",
    "VisibilityAction",
    "AppearanceAction",
    "GlobalAction",
    "UserDefinedAction",
    "AssignRouteAction",
)
# Actions that change neither the motion of an actor nor when it starts.
_MOTIONLESS: Final = (
    "EnvironmentAction",
    "VisibilityAction",
    "AppearanceAction",
    "ParameterAction",
    "VariableAction",
    "UserDefinedAction",
)
# Actions of the ego that the system under test takes the place of.
_OF_DRIVER: Final = ("LongitudinalAction", "LateralAction", "SynchronizeAction", "RoutingAction", "ControllerAction")
_OF_CONTROLLER: Final = ("ActivateControllerAction", "OverrideControllerValueAction")


@dataclass
class StoryElement:
    """Element of the storyboard, and what is made of it.

    Attributes:
        element: The element.
        path: Names from the story to it.
        parent: Element around it.
        children: Elements in it.
        phases: Entity and name of each phase that it becomes.
        duration: Time that it takes, s, if it becomes no phase; None: unknown.
    """

    element: Element
    path: tuple[str, ...]
    parent: StoryElement | None
    children: list[StoryElement] = field(default_factory=list)
    phases: list[tuple[str, str]] = field(default_factory=list)
    duration: float | None = None

    def every(self) -> Iterator[StoryElement]:
        """Yield the element and all elements in it."""
        yield self
        for child in self.children:
            yield from child.every()


@dataclass
class Motion:
    """Phases of one action of one entity, without their trigger."""

    entity: Entity
    phases: list[Phase] = field(default_factory=list)
    lateral: list[LateralPhase] = field(default_factory=list)


class StoryboardReader:
    """Storyboard of a document.

    What has no counterpart is counted: in `doubts` if it changes how an actor moves or when it starts, else in
    `omissions`.
    """

    def __init__(
        self,
        root: Element,
        places: PositionReader,
        entities: Mapping[str, Entity],
        *,
        parameters: Mapping[str, str],
        omissions: Counter[str],
        doubts: Counter[str],
        report: ImportReport,
    ) -> None:
        """Create the reader of one document; see `TriggerReader`."""
        self.root, self.places, self.entities = root, places, entities
        self.values, self.omissions, self.doubts, self.report = places.values, omissions, doubts, report
        self.triggers = TriggerReader(
            places,
            entities,
            parameters=parameters,
            doubts=doubts,
            report=report,
            element_state=self._element_state,
        )
        self.ego = self.triggers.ego
        self._names: set[str] = set()
        self._lanes: dict[str, int] = {}  # lanes to the left of the start, after the lateral phases so far
        self._offsets: dict[str, float] = {}  # m from the centre of that lane
        self._starts: dict[int, Trigger] = {}
        self._open: set[int] = set()
        self.stories = [self._element(story, None) for story in root.iterfind("Storyboard/Story")]
        self._by_name: dict[str, list[StoryElement]] = {}
        for story in self.stories:
            for story_element in story.every():
                self._by_name.setdefault(story_element.path[-1], []).append(story_element)

    def _element(self, element: Element, parent: StoryElement | None) -> StoryElement:
        name = self.values.text(element, "name", element.tag)
        story_element = StoryElement(element, (*(parent.path if parent else ()), name), parent)
        deeper = _KINDS[_KINDS.index(element.tag) + 1] if element.tag in _KINDS[:-1] else None
        if deeper is not None:
            story_element.children = [self._element(child, story_element) for child in element.iterfind(deeper)]
        return story_element

    # ------------------------------------------------------------ what happens

    def read(self) -> None:
        """Give the entities their phases, paths and trajectories."""
        for private in self.root.iterfind("Storyboard/Init/Actions/Private"):
            self._initial(private)
        events = [
            story_element
            for story in self.stories
            for story_element in story.every()
            if story_element.element.tag == "Event"
        ]
        planned = []
        for event in events:
            actors = self._actors(event)
            for action in event.children:
                content = next(iter(action.element), action.element)
                motions = [self._plan(entity, content, action) for entity in actors]
                planned.append((event, action, content, motions, actors))
        for event in events:
            self._note_repetition(event)
        for event, action, content, motions, actors in planned:
            if content.tag == "GlobalAction":
                self._global(content, event)
                continue
            for entity, motion in zip(actors, motions, strict=True):
                self._happen(entity, motion, content, event, action)
        for entity in self.entities.values():
            entity.phases = _in_sequence(entity.phases, entity.name)
            entity.lateral = _in_sequence(entity.lateral, entity.name)

    def _actors(self, event: StoryElement) -> list[Entity]:
        group = event.parent.parent if event.parent else None
        element = None if group is None else group.element.find("Actors")
        if element is None:
            return []
        actors = [self.triggers.referenced_entity(reference) for reference in element.iterfind("EntityRef")]
        if self.values.truth(element, "selectTriggeringEntities", default=False):
            actors += [
                self.triggers.referenced_entity(reference)
                for reference in event.element.iterfind(".//TriggeringEntities/EntityRef")
            ]
        return list({entity.name: entity for entity in actors}.values())

    def _note_repetition(self, event: StoryElement) -> None:
        group = event.parent.parent if event.parent else None
        has_phases = any(part.phases for part in event.every())
        for story_element in (event, *([group] if group else [])):
            execution_count = self.values.number(story_element.element, "maximumExecutionCount", 1.0)
            if execution_count > 1 and has_phases:
                self.doubts[f"'{story_element.path[-1]}' takes place once, not up to {execution_count:g} times"] += 1
        if self.values.text(event.element, "priority", "override") == "skip" and has_phases:
            self.doubts[f"'{event.path[-1]}' takes place beside other events, not only where none runs (skip)"] += 1

    def _initial(self, private: Element) -> None:
        """Carry out the actions of an entity at the start."""
        entity = self.triggers.referenced_entity(private)
        for action in private:
            content = next(iter(action), action)
            if content.tag == "ControllerAction":
                self._driver(entity, content)
                continue
            if content.tag == "TeleportAction":
                continue
            speed_action = content.find("SpeedAction")
            if speed_action is not None:
                phase = self._speed_phase(entity, speed_action)
                if phase is None:
                    continue
                if phase.shape == "step" and not phase.continuous:
                    entity.speed = self._start_speed(entity, phase)
                    continue
            story_element = StoryElement(action, ("start",), None)
            motion = self._plan(entity, action, story_element)
            self._carry_out(motion, action, story_element, trigger=ALWAYS, label=f"the start of '{entity.name}'")

    def _start_speed(self, entity: Entity, phase: Phase) -> float:
        """Return the speed at the start that a phase states, also relative to that of another entity."""
        speed = phase.speed or 0.0
        if not phase.reference:
            return speed
        other = self.ego if phase.reference == "ego" else self.entities[phase.reference]
        absolute = other.speed * speed if phase.factor else other.speed + speed
        return self._limited_speed(entity, absolute)

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
                    self.doubts[f"controller '{name}' of '{entity.name}' is not carried over"] += 1
        if action.find(".//CatalogReference") is not None and not entity.ego:
            self.doubts[f"controller of '{entity.name}' in a catalogue is not carried over"] += 1

    def record_action(self, context: str, action: Element, *, is_of_ego: bool = False) -> None:
        """Name an action that has no counterpart: the innermost element whose name says what it does."""
        action_tags = [element.tag for element in action.iter() if element.tag.endswith("Action")]
        reason = f"{(action_tags or [action.tag])[-1]} {context}"
        if _is_motionless(action) or (is_of_ego and {*action_tags, action.tag} & {*_OF_DRIVER, *_OF_CONTROLLER}):
            self.omissions[reason] += 1
        else:
            self.doubts[f"{reason} is not carried over"] += 1

    def _global(self, action: Element, event: StoryElement) -> None:
        entity_action = action.find("EntityAction")
        label = event.path[-1]
        if entity_action is None:
            self.record_action(f"in event '{label}'", action)
            return
        entity = self.triggers.referenced_entity(entity_action)
        time = self._time(self._begin(event, entity))
        is_arrival = entity_action.find("AddEntityAction") is not None
        if time is None or math.isinf(time):
            if time is None:
                stays = "it is there from the start" if is_arrival else "it stays"
                self.doubts[f"{'Add' if is_arrival else 'Delete'}EntityAction of '{entity.name}': {stays}"] += 1
        elif is_arrival:
            entity.appears = time
        else:
            entity.leaves = min(entity.leaves, time)

    def _time(self, trigger: Trigger) -> float | None:
        """Return the time at which a trigger holds; inf: never; None: it depends on what happens."""
        if trigger is Unfulfilled.NEVER:
            return math.inf
        if not isinstance(trigger, PhaseTrigger) or trigger.any or trigger.edge != "none":
            return None
        own_time = {"always": 0.0, "time": trigger.value + trigger.delay}.get(trigger.kind)
        times = [own_time, *(self._time(part) for part in trigger.all)]
        stated_times = [time for time in times if time is not None]
        return max(stated_times) if len(stated_times) == len(times) and trigger.rule != "below" else None

    # ------------------------------------------------------------ triggers of elements

    def _begin(self, event: StoryElement, entity: Entity) -> Trigger:
        """Return the trigger of an event that is carried out; it must not wait for itself."""
        self._open.add(id(event))
        try:
            return self.start(event, entity)
        finally:
            self._open.discard(id(event))

    def start(self, event: StoryElement, entity: Entity | None) -> Trigger:
        """Return the trigger of an event: its own and that of its act."""
        label = event.path[-1]
        own_trigger = self.triggers.trigger(event.element.find("StartTrigger"), entity, label)
        act = self._around(event, "Act")
        if act is None:
            return own_trigger
        act_trigger = self.triggers.trigger(act.element.find("StartTrigger"), entity, act.path[-1])
        if ALWAYS in (own_trigger, act_trigger) or not isinstance(own_trigger, PhaseTrigger):
            return both(own_trigger, act_trigger)
        if isinstance(act_trigger, PhaseTrigger) and not is_lasting(act_trigger):
            self.doubts[f"that act '{act.path[-1]}' goes on after its trigger: '{label}' needs it still to hold"] += 1
        return both(act_trigger, own_trigger)

    def _around(self, story_element: StoryElement, tag: str) -> StoryElement | None:
        while story_element.element.tag != tag:
            if story_element.parent is None:
                return None
            story_element = story_element.parent
        return story_element

    def _element_state(self, content: Element, label: str) -> Trigger:
        """Return the trigger that a StoryboardElementStateCondition means."""
        name = self.values.text(content, "storyboardElementRef")
        kind = self.values.text(content, "storyboardElementType", "")
        state = self.values.text(content, "state")
        parts = tuple(part.strip() for part in name.split("::"))
        candidates = [
            story_element
            for story_element in self._by_name.get(parts[-1], [])
            if story_element.path[-len(parts) :] == parts and kind.lower() in ("", story_element.element.tag.lower())
        ]
        if not candidates:
            return self.triggers.never(content, label, f"there is no {kind or 'element'} '{name[:60]}'")
        story_element = candidates[0]
        events = [part for part in story_element.every() if part.element.tag == "Event"]
        if story_element.element.tag == "Action" and story_element.parent is not None:
            events = [story_element.parent]
        is_start = state in ("startTransition", "runningState")
        if is_start and story_element.element.tag in ("Story", "Act"):
            return self._begun(story_element, content, label)  # acts start whether or not their events do
        # The event that waits is left out: whether it takes place is what is asked.
        begins = [self._takes_place(event, content, label) for event in events if id(event) not in self._open]
        if begins and not any(isinstance(trigger, PhaseTrigger) for trigger in begins):
            return begins[0]
        if is_start:
            return self._begun(story_element, content, label)
        if state in ("endTransition", "completeState", "stopTransition", "skipTransition"):
            return self._ended(story_element, content, label)
        return ALWAYS if state == "standbyState" else Unfulfilled.UNKNOWN

    def _begun(self, story_element: StoryElement, content: Element, label: str) -> Trigger:
        phases = [phase for part in story_element.every() for phase in part.phases]
        if phases and story_element.element.tag in ("Event", "Action"):
            return PhaseTrigger("phase_start", agent=phases[0][0], phase=phases[0][1])
        if story_element.element.tag in ("Story", "Act"):
            act = story_element if story_element.element.tag == "Act" else next(iter(story_element.children), None)
            if act is None:
                return ALWAYS
            return self._guarded(act, content, label, partial(self._act_start, act))
        events = [part for part in story_element.every() if part.element.tag == "Event"]
        if story_element.element.tag == "Action" and story_element.parent is not None:
            events = [story_element.parent]
        return any_of([self._guarded(event, content, label, partial(self._event_start, event)) for event in events])

    def _takes_place(self, event: StoryElement, content: Element, label: str) -> Trigger:
        """Return the start of an event, for whether it has one; nothing is counted as a doubt."""
        counted = dict(self.doubts)
        try:
            return self._guarded(event, content, label, partial(self.start, event, None))
        finally:
            self.doubts.clear()
            self.doubts.update(counted)

    def _act_start(self, act: StoryElement) -> Trigger:
        return self.triggers.trigger(act.element.find("StartTrigger"), None, act.path[-1])

    def _event_start(self, event: StoryElement) -> Trigger:
        trigger = self.start(event, None)
        if isinstance(trigger, PhaseTrigger) and not is_lasting(trigger):
            self.doubts[f"that event '{event.path[-1]}' has begun is taken as its trigger"] += 1
        return trigger

    def _guarded(
        self, story_element: StoryElement, content: Element, label: str, make: Callable[[], Trigger]
    ) -> Trigger:
        """Return the start of an element; events that wait for each other never begin."""
        key = id(story_element)
        if key in self._starts:
            return self._starts[key]
        if key in self._open:
            return self.triggers.never(content, label, "events wait for each other")
        if len(self._open) >= MAX_WAITING:
            raise self.values.error(content, f"'{label}' ends a chain of more than {MAX_WAITING} events that wait")
        self._open.add(key)
        try:
            result = make()
        finally:
            self._open.discard(key)
        self._starts[key] = result
        return result

    def _ended(self, story_element: StoryElement, content: Element, label: str) -> Trigger:
        if not story_element.phases and story_element.element.tag == "Action":
            return self._after_start(story_element, content, label)
        if story_element.element.tag == "Action":
            # The last phase of an action ends it, for each of its entities.
            last = dict(story_element.phases)
            return all_of([PhaseTrigger("phase_end", agent=name, phase=phase) for name, phase in last.items()])
        if any(id(child) in self._open for child in story_element.every()):
            return self.triggers.never(content, label, "events wait for each other")
        children = [
            child
            for child in story_element.children
            if child.element.tag != "Event" or isinstance(self._takes_place(child, content, label), PhaseTrigger)
        ]
        parts = [self._ended(child, content, label) for child in children]
        return all_of(parts) if parts else self._begun(story_element, content, label)

    def _after_start(self, action: StoryElement, content: Element, label: str) -> Trigger:
        """Return the end of an action that becomes no phase: its start, so much later as it takes."""
        event = action.parent
        if event is None:
            return Unfulfilled.UNKNOWN
        trigger = self._begun(event, content, label)
        if not isinstance(trigger, PhaseTrigger):
            return trigger
        tags = {element.tag for element in action.element.iter()}
        if action.duration is None and not tags & set(_INSTANT):
            self.doubts[f"the end of '{action.path[-1]}', which '{label}' waits for, is taken as its start"] += 1
        if not action.duration:
            return trigger
        if trigger == ALWAYS:
            return PhaseTrigger("time", action.duration)
        if trigger.kind == "time" and trigger.edge == "none" and not trigger.all:
            return replace(trigger, value=trigger.value + action.duration)
        return replace(trigger, delay=trigger.delay + action.duration)

    # ------------------------------------------------------------ actions as phases

    def _name(self, action: StoryElement, entity: Entity) -> str:
        """Return a name for the phase of an action that no other phase has."""
        event = action.parent.path[-1] if action.parent else f"{action.path[-1]} of {entity.name}"
        candidate_names = [event, f"{event} {action.path[-1]}"]
        candidate_names += [f"{event} {action.path[-1]} {number}" for number in range(2, 1000)]
        name = next((name for name in candidate_names if name not in self._names), candidate_names[-1])
        self._names.add(name)
        return name

    def _plan(self, entity: Entity, content: Element, action: StoryElement) -> Motion:
        """Return the phases of an action, without their trigger, and note which they are."""
        motion = Motion(entity)
        if entity.ego:
            return motion
        inner_action = next(iter(content), content)
        if content.tag == "SynchronizeAction" or inner_action.tag == "SynchronizeAction":
            motion.phases = self._arrival(entity, content if content.tag == "SynchronizeAction" else inner_action)
        elif (speed_action := content.find(".//SpeedAction")) is not None:
            speed_phase = self._speed_phase(entity, speed_action)
            motion.phases = [speed_phase] if speed_phase else []
        elif (profile := content.find(".//SpeedProfileAction")) is not None:
            motion.phases = self._profile(entity, profile)
        elif (keep := content.find(".//LongitudinalDistanceAction")) is not None:
            motion.phases = self._keep_distance(entity, keep)
        elif (change := content.find(".//LaneChangeAction")) is not None:
            lateral = self._lane_change(entity, change)
            motion.lateral = [lateral] if lateral else []
        elif (offset := content.find(".//LaneOffsetAction")) is not None:
            motion.lateral = [self._lane_offset(entity, offset)]
        previous = ""
        for index, planned in enumerate(motion.phases):
            name = self._name(action, entity)
            when = PhaseTrigger("phase_end", agent=entity.name, phase=previous) if previous else ALWAYS
            motion.phases[index] = replace(planned, name=name, when=when)
            action.phases.append((entity.name, name))
            previous = name
        for index, lateral_phase in enumerate(motion.lateral):
            motion.lateral[index] = replace(lateral_phase, name=self._name(action, entity))
            action.phases.append((entity.name, motion.lateral[index].name))
        return motion

    def _happen(
        self, entity: Entity, motion: Motion, content: Element, event: StoryElement, action: StoryElement
    ) -> None:
        """Give an entity the phases of an action with the trigger of its event."""
        label = event.path[-1]
        if entity.ego:
            tags = {element.tag for element in (content, *content)}
            routing = content if content.tag == "RoutingAction" else content.find("RoutingAction")
            trigger = Unfulfilled.UNKNOWN if routing is None else self._begin(event, entity)
            if routing is not None and isinstance(trigger, PhaseTrigger) and not (entity.route or entity.path):
                self._routing(entity, routing, action, trigger, f"event '{label}'")
            elif tags & set(_OF_DRIVER) - {"ControllerAction"}:
                self.omissions[f"event '{label}' of the ego: the system under test drives it"] += 1
            elif "ControllerAction" not in tags:
                self.record_action(f"in event '{label}'", content, is_of_ego=True)
            return
        if _is_motionless(content):
            self.record_action(f"in event '{label}'", content)
            return
        trigger = self._begin(event, entity)
        if trigger is Unfulfilled.NEVER:
            return
        if trigger is Unfulfilled.UNKNOWN:
            self.doubts[f"event '{label}': when it begins is not known"] += 1
            return
        self._carry_out(motion, content, action, trigger=trigger, label=f"event '{label}'")

    def _carry_out(
        self, motion: Motion, content: Element, action: StoryElement, *, trigger: PhaseTrigger, label: str
    ) -> None:
        """Give an entity the phases of an action, or its path."""
        entity = motion.entity
        inner_action = next(iter(content), content)
        routing = (
            content if content.tag == "RoutingAction" else inner_action if inner_action.tag == "RoutingAction" else None
        )
        keep = content.find(".//LongitudinalDistanceAction")
        if keep is not None and not entity.ego and keep.find("DynamicConstraints") is None:
            # Without limits the distance is there at once.
            other = self.triggers.referenced_entity(keep)
            if trigger == ALWAYS and entity.placed and other.placed:
                self._place_at_distance(entity, other, keep)
            else:
                self.doubts[
                    f"LongitudinalDistanceAction in {label}: '{entity.name}' drives there, it does not jump"
                ] += 1
        if motion.phases or motion.lateral:
            entity.phases += _with_trigger(motion.phases, trigger)
            entity.lateral += _with_trigger(motion.lateral, trigger)
        elif routing is not None:
            self._routing(entity, routing, action, trigger, label)
        elif content.find(".//SpeedAction") is None and content.find(".//LaneChangeAction") is None:
            if entity.ego and inner_action.tag in _OF_DRIVER:
                self.omissions[f"{inner_action.tag} at {label}: the system under test drives the ego"] += 1
            else:
                context = f"at {label}" if label.startswith("the start") else f"in {label}"
                self.record_action(context, content, is_of_ego=entity.ego)

    def _limited_speed(self, entity: Entity, speed: float) -> float:
        """Return a speed that the entity can have; a file without limits of its own sets them by its speeds."""
        limit = entity.max_speed
        if speed > limit > 0.0 and entity.element.find("*/Performance") is None and speed <= 100.0:
            entity.body = replace(entity.body, max_speed=speed)
            limit = speed
        if not 0.0 <= speed <= limit and not entity.ego:
            self.doubts[f"a speed of '{entity.name}' of {speed:g} m/s: it has 0 to {limit:g} m/s"] += 1
        return min(max(speed, 0.0), limit) if not entity.ego else max(speed, 0.0)

    def _speed_phase(self, entity: Entity, action: Element) -> Phase | None:
        """Return the phase of a SpeedAction; None if its rate of 0 leaves the speed as it is."""
        target = action.find("SpeedActionTarget/AbsoluteTargetSpeed")
        relative = action.find("SpeedActionTarget/RelativeTargetSpeed")
        if target is not None:
            phase = Phase(self._limited_speed(entity, self.values.number(target, "value")))
        elif relative is not None:
            other = self.triggers.referenced_entity(relative)
            is_factor = self.values.text(relative, "speedTargetValueType", "delta") == "factor"
            phase = Phase(
                self.values.number(relative, "value"),
                reference=self.triggers.agent_name(other),
                factor=is_factor,
                continuous=self.values.truth(relative, "continuous", default=False),
            )
        else:
            raise self.values.error(action, "SpeedActionTarget is missing")
        return self._with_dynamics(entity, phase, action.find("SpeedActionDynamics"))

    def _with_dynamics(self, entity: Entity, phase: Phase, dynamics: Element | None) -> Phase | None:
        """Return a phase with the dynamics of a transition; None if a rate of 0 never ends it."""
        if dynamics is None:
            return phase if phase.continuous else replace(phase, shape="step")
        shape, dimension, value = self._dynamics(dynamics)
        if dimension == "rate" and value == 0.0 and shape != "step":
            self.triggers.doubt(
                dynamics,
                f"a SpeedAction of '{entity.name}' has the rate 0, with which its target is never reached: "
                "the speed stays as it is, and the action has no end",
            )
            return None
        is_full = dimension == "rate" and shape == "linear" and value in entity.limits
        if phase.continuous or is_full:
            # Full power and full brakes are what a phase without an acceleration has.
            return phase if is_full or dimension != "rate" or shape == "step" else replace(phase, acceleration=value)
        if shape == "step" or value == 0.0:
            return replace(phase, shape="step")
        keyword = {"rate": "acceleration", "time": "duration", "distance": "distance"}[dimension]
        return replace(phase, shape=shape, **{keyword: value})  # type: ignore[arg-type]

    def _dynamics(self, element: Element) -> tuple[str, str, float]:
        """Return shape, dimension and value of the dynamics of a transition."""
        shape = self.values.text(element, "dynamicsShape")
        dimension = self.values.text(element, "dynamicsDimension", "time")
        if shape not in _SHAPES:
            raise self.values.error(element, f"dynamicsShape is '{shape[:40]}'; known: {', '.join(_SHAPES)}")
        if dimension not in ("rate", "time", "distance"):
            raise self.values.error(element, f"dynamicsDimension is '{dimension[:40]}'; known: rate, time, distance")
        value = self.values.number(element, "value", 0.0)
        if shape != "step" and element.get("dynamicsDimension") is None:
            self.triggers.doubt(element, "dynamicsDimension is missing: taken as time")
        if dimension != "rate" and value < 0.0:  # a negative rate is a usual way to write a deceleration
            raise self.values.error(element, f"value is {value:g}; a {dimension} is not negative")
        return shape, dimension, abs(value)

    def _profile(self, entity: Entity, action: Element) -> list[Phase]:
        """Return the phases of a SpeedProfileAction: one to each entry."""
        entries = action.findall("SpeedProfileEntry")
        if not entries:
            raise self.values.error(action, "SpeedProfileEntry is missing")
        reference = ""
        if action.get("entityRef"):
            reference = self.triggers.agent_name(self.triggers.referenced_entity(action))
        limits = action.find("DynamicConstraints")
        phases = []
        speed_before = entity.speed
        for index, entry in enumerate(entries):
            speed = self.values.number(entry, "speed")
            if not reference:
                speed = self._limited_speed(entity, speed)
            time = self.values.number(entry, "time", 0.0)
            if index == 0 and time == 0.0 and len(entries) > 1:
                speed_before = speed
                continue  # the speed at which the profile begins
            phase = Phase(speed, reference=reference)
            if time > 0.0:
                phase = replace(phase, duration=time)
            elif limits is not None:
                way = "Acceleration" if speed >= speed_before else "Deceleration"
                rate = self.values.number(limits, f"max{way}", 0.0)
                jerk = self.values.number(limits, f"max{way}Rate", 0.0)
                phase = replace(phase, acceleration=rate or None, jerk=jerk or None)
            phases.append(phase)
            speed_before = speed
        return phases

    def _arrival(self, entity: Entity, action: Element) -> list[Phase]:
        """Return the phase of a SynchronizeAction."""
        name = "masterEntityRef" if action.get("masterEntityRef") else "entityRef"
        master_name = self.values.text(action, name)
        if master_name not in self.entities:
            raise self.values.error(action, f"there is no entity '{master_name}'")
        master = self.entities[master_name]
        poses = []
        for tag, body in (("TargetPosition", entity), ("TargetPositionMaster", master)):
            position = action.find(tag)
            if not self.places.is_supported(position):
                self.doubts[f"SynchronizeAction of '{entity.name}': a position that is not read"] += 1
                return []
            poses.append(self._centre(body, self.places.pose(position, within=action)))
        absolute = action.find("FinalSpeed/AbsoluteSpeed")
        speed: float | None = None
        if absolute is not None:
            speed = self._limited_speed(entity, self.values.number(absolute, "value"))
            poses = self._before_steady_state(action, poses, speed=speed, master=master)
        elif action.find("FinalSpeed/RelativeSpeedToMaster") is not None:
            self.doubts[f"the final speed of '{entity.name}', which depends on that of '{master.name}'"] += 1
        own_place, other_place = ((pose.x, pose.y) for pose in poses)
        return [Phase(speed, arrival=Arrival(own_place, other_place, self.triggers.agent_name(master)))]

    def _before_steady_state(self, action: Element, poses: list[Pose], *, speed: float, master: Entity) -> list[Pose]:
        """Return the places of a meeting, or those at which the steady state before it begins.

        From there on the entity keeps its final speed; the other one is taken to keep its speed at the start.
        """
        by_distance = action.find("FinalSpeed/AbsoluteSpeed/TargetDistanceSteadyState")
        by_time = action.find("FinalSpeed/AbsoluteSpeed/TargetTimeSteadyState")
        if by_distance is not None:
            distance = self.values.number(by_distance, "distance")
        elif by_time is not None:
            distance = self.values.number(by_time, "time") * speed
        else:
            return poses
        if speed <= 0.0 or distance <= 0.0:
            return poses
        own_place, other_place = poses
        back = master.speed * distance / speed
        start = self._centre(master, self.places.start(master.name, within=action))
        if back <= 0.0 or back >= math.dist((start.x, start.y), (other_place.x, other_place.y)):
            self.doubts[f"the steady state before the meeting with '{master.name}'"] += 1
            return poses
        return [
            self._earlier(action.find("TargetPosition"), own_place, distance),
            self._earlier(action.find("TargetPositionMaster"), other_place, back),
        ]

    def _earlier(self, position: Element | None, pose: Pose, distance: float) -> Pose:
        """Return the pose that lies a distance before one: on the trajectory or route of its position, or its lane."""
        content = None if position is None else next(iter(position), None)
        trajectory = None if content is None else content.find("TrajectoryRef/Trajectory")
        route = None if content is None else content.find("RouteRef/Route")
        if trajectory is not None or route is not None:
            way = self.places.route(route) if trajectory is None and route is not None else None
            way = way or self.places.trajectory(trajectory)  # type: ignore[arg-type]
            return way.before(pose, distance)
        place = self.places.lane_under(pose)
        if place is None:
            return move_pose(pose, -distance, 0.0)
        graph = self.places.graph
        centre = pose_at(graph, place)
        aside = -math.sin(centre.yaw) * (pose.x - centre.x) + math.cos(centre.yaw) * (pose.y - centre.y)
        return move_pose(pose_at(graph, place_behind(graph, place, distance)), 0.0, aside)

    # ------------------------------------------------------------ lateral actions

    def _lane_change(self, entity: Entity, action: Element) -> LateralPhase | None:
        relative = action.find("LaneChangeTarget/RelativeTargetLane")
        absolute = action.find("LaneChangeTarget/AbsoluteTargetLane")
        before = self._lanes.get(entity.name, 0)
        if relative is not None:
            other = self.triggers.referenced_entity(relative)
            lanes = self.values.lanes(relative, "value")
            total = before + lanes if other is entity else self._lanes_to(entity, other, lanes)
        elif absolute is not None:
            total = self._lanes_to_id(entity, int(self.values.number(absolute, "value")))
        else:
            raise self.values.error(action, "LaneChangeTarget is missing")
        if total is None:
            self.doubts[f"LaneChangeAction of '{entity.name}': its target lane is not beside its own"] += 1
            return None
        self._lanes[entity.name] = total
        phase = LateralPhase(total - before, offset=self.values.number(action, "targetLaneOffset", 0.0))
        self._offsets[entity.name] = phase.offset
        dynamics = action.find("LaneChangeActionDynamics")
        if dynamics is None:
            raise self.values.error(action, "LaneChangeActionDynamics is missing")
        shape, dimension, value = self._dynamics(dynamics)
        if shape == "step" or value == 0.0:
            return replace(phase, shape="step")
        keyword = {"rate": "rate", "time": "duration", "distance": "distance"}[dimension]
        return replace(phase, shape=shape, **{keyword: value})  # type: ignore[arg-type]

    def _lane(self, entity: Entity) -> LanePosition | None:
        if not entity.placed:
            return None
        pose = self._centre(entity, self.places.start(entity.name, within=entity.element))
        return self.places.lane_under(pose) or self.places.lane_under(pose, aligned=False)

    def _lanes_to(self, entity: Entity, other: Entity, lanes: int) -> int | None:
        """Return the number of lanes from the start lane of an entity to that `lanes` left of another's lane."""
        own_lane, other_lane = self._lane(entity), self._lane(other)
        if own_lane is None or other_lane is None:
            return None
        return self._number(other_lane) + self._lanes.get(other.name, 0) + lanes - self._number(own_lane)

    def _number(self, place: LanePosition) -> int:
        """Return the number of lanes of the same direction on the right of a lane."""
        graph, lane, lane_count = self.places.graph, place.lane, 0
        while (beside := int(graph.right[lane])) >= 0 and lane_count < 20:
            if graph.kind[beside] != graph.kind[lane] or not graph.is_same_direction(lane, beside):
                break
            lane, lane_count = beside, lane_count + 1
        return lane_count

    def _lanes_to_id(self, entity: Entity, lane_id: int) -> int | None:
        """Return the number of lanes from the start lane of an entity to that with an id."""
        place = self._lane(entity)
        if place is None:
            return None
        graph = self.places.graph
        for side, step in ((graph.left, 1), (graph.right, -1)):
            lane, lane_count, neighbours = place.lane, 0, side
            while lane >= 0 and abs(lane_count) <= 20:
                if int(graph.lane_id[lane]) == lane_id:
                    return lane_count
                beside = int(neighbours[lane])
                if beside >= 0 and not graph.is_same_direction(lane, beside):
                    # Further left of the oncoming lanes is on their right.
                    neighbours = graph.right if neighbours is graph.left else graph.left
                lane, lane_count = beside, lane_count + step
        return None

    def _lane_offset(self, entity: Entity, action: Element) -> LateralPhase:
        absolute = action.find("LaneOffsetTarget/AbsoluteTargetLaneOffset")
        relative = action.find("LaneOffsetTarget/RelativeTargetLaneOffset")
        target = absolute if absolute is not None else relative
        if target is None:
            raise self.values.error(action, "LaneOffsetTarget is missing")
        value = self.values.number(target, "value")
        if relative is not None and absolute is None and self.triggers.referenced_entity(relative) is not entity:
            self.doubts[f"the lane offset of '{entity.name}' relative to another is taken from the lane's centre"] += 1
        phase = LateralPhase(0, offset=value)
        before, self._offsets[entity.name] = self._offsets.get(entity.name, 0.0), value
        dynamics = action.find("LaneOffsetActionDynamics")
        shape = "sinusoidal" if dynamics is None else self.values.text(dynamics, "dynamicsShape", "sinusoidal")
        if shape not in _SHAPES:
            raise self.values.error(action, f"dynamicsShape is '{shape[:40]}'; known: {', '.join(_SHAPES)}")
        if shape == "step":
            return replace(phase, shape="step")
        limit = 0.0 if dynamics is None else self.values.number(dynamics, "maxLateralAcc", 0.0)
        if limit <= 0.0:
            return replace(phase, shape=shape, duration=LATERAL_TIME)  # type: ignore[arg-type]
        # Half a cosine over d metres in T seconds has an acceleration of at most pi^2 d / (2 T^2).
        moved = max(abs(value - before), 0.1)
        return replace(phase, shape=shape, duration=math.pi * math.sqrt(0.5 * moved / limit))  # type: ignore[arg-type]

    # ------------------------------------------------------------ distances

    def _keep_distance(self, entity: Entity, action: Element) -> list[Phase]:
        """Return the phase of a LongitudinalDistanceAction."""
        other = self.triggers.referenced_entity(action)
        limits = action.find("DynamicConstraints")
        stated: dict[str, float | None] = {"max_acceleration": None, "max_deceleration": None, "max_speed": None}
        for key, attribute_name in zip(stated, ("maxAcceleration", "maxDeceleration", "maxSpeed"), strict=True):
            value = 0.0 if limits is None else self.values.number(limits, attribute_name, 0.0)
            # Full power and full brakes are what a gap without limits has; some files state 1e10 for none.
            if value in entity.limits or not 0.0 < value <= MAX_RATE:
                continue
            if key != "max_speed" or value < entity.max_speed:
                stated[key] = value
        if limits is not None and any(name.endswith("Rate") for name, _ in limits.items()):
            self.doubts[f"the limits of the jerk of '{entity.name}' while it takes its distance are left out"] += 1
        distance, time = self.values.number(action, "distance", 0.0), self.values.number(action, "timeGap", 0.0)
        is_free = self.values.truth(action, "freespace", default=False)
        displacement = self.values.text(action, "displacement", "any")
        side = {"leadingReferencedEntity": "ahead", "trailingReferencedEntity": "behind"}.get(displacement, "any")
        if not is_free and side != "any":
            # Distances are those of reference points; a gap is that of centres.
            back = other.centre[0] - entity.centre[0]
            distance = max(distance + (back if side == "behind" else -back), 0.0)
        if distance <= 0.0 and time <= 0.0:
            distance = 0.01  # a distance of 0 between reference points
        gap = FollowingGap(
            max(distance, 0.0),
            max(time, 0.0),
            self.triggers.agent_name(other),
            free_space=is_free,
            side=side,  # type: ignore[arg-type]
            **stated,
        )
        return [Phase(gap=gap, continuous=self.values.truth(action, "continuous", default=False))]

    def _place_at_distance(self, entity: Entity, other: Entity, action: Element) -> None:
        """Place an entity along the lane of another, at a distance to it."""
        own_pose = self._centre(entity, self.places.start(entity.name, within=action))
        reference = self._centre(other, self.places.start(other.name, within=action))
        distance = self.values.number(action, "distance", math.nan if action.get("timeGap") is None else 0.0)
        if action.get("timeGap") is not None:
            distance = self.values.number(action, "timeGap") * entity.speed
        displacement = self.values.text(action, "displacement", "any")
        ahead = math.cos(reference.yaw) * (own_pose.x - reference.x) + math.sin(reference.yaw) * (
            own_pose.y - reference.y
        )
        side = {"leadingReferencedEntity": 1.0, "trailingReferencedEntity": -1.0}.get(
            displacement, math.copysign(1, ahead)
        )
        if self.values.truth(action, "freespace", default=False):
            distance += 0.5 * (entity.length + other.length)
        else:
            distance += side * (entity.centre[0] - other.centre[0])
        shift = side * distance - ahead
        place = self.places.lane_under(own_pose)
        if place is None:
            moved = move_pose(own_pose, shift, 0.0)
        else:
            graph = self.places.graph
            centre = pose_at(graph, place)
            aside = -math.sin(centre.yaw) * (own_pose.x - centre.x) + math.cos(centre.yaw) * (own_pose.y - centre.y)
            there = place_ahead(graph, place, shift) if shift >= 0.0 else place_behind(graph, place, -shift)
            moved = move_pose(pose_at(graph, there), 0.0, aside)
        self.places.moved[entity.name] = move_pose(moved, -entity.centre[0], -entity.centre[1])

    # ------------------------------------------------------------ routes and trajectories

    def _centre(self, entity: Entity, pose: Pose) -> Pose:
        return move_pose(pose, *entity.centre) if any(entity.centre) else pose

    def _routing(
        self, entity: Entity, routing: Element, action: StoryElement, trigger: PhaseTrigger, label: str
    ) -> None:
        inner_action = next(iter(routing), routing)
        if inner_action.tag == "AcquirePositionAction":
            position = inner_action.find("Position")
            if self.places.is_supported(position):
                entity.route = (self.places.pose(position, within=inner_action),)
                self._note_late(trigger, label, "heads for that position from the start", entity)
                return
        elif inner_action.tag == "AssignRouteAction" and inner_action.find("Route") is not None:
            route = inner_action.find("Route")
            assert route is not None
            if all(self.places.is_supported(waypoint.find("Position")) for waypoint in route.iterfind("Waypoint")):
                entity.route = self.places.waypoints(route)
                self._note_late(trigger, label, "has that route from the start", entity)
                return
        elif inner_action.tag == "FollowTrajectoryAction":
            self._trajectory(entity, inner_action, action, trigger, label)
            return
        self.record_action(f"of '{entity.name}'", routing)

    def _note_late(self, trigger: PhaseTrigger, label: str, does: str, entity: Entity) -> None:
        if trigger != ALWAYS and not is_lasting(trigger):
            self.doubts[f"the trigger of {label}: '{entity.name}' {does}"] += 1

    def _trajectory(
        self, entity: Entity, follow: Element, action: StoryElement, trigger: PhaseTrigger, label: str
    ) -> None:
        way = self.find_trajectory(follow, entity)
        if way is None:
            self.doubts[f"a trajectory of '{entity.name}' that is not read"] += 1
            return
        poses = [self._centre(entity, Pose(*row)) for row in np.column_stack([way.xy, way.yaw]).tolist()]
        if entity.ego:
            entity.path = tuple(poses)
            return
        timing = follow.find("TimeReference/Timing")
        if timing is None or way.times is None:
            if timing is not None:
                self.doubts[f"the times of the trajectory of '{entity.name}': its points have none"] += 1
            entity.path = tuple(poses)
            self._note_late(trigger, label, "keeps that path from the start", entity)
            return
        scale, offset = (
            self.values.number(timing, name, default) for name, default in (("scale", 1.0), ("offset", 0.0))
        )
        times = (way.times * scale + offset).tolist()
        is_relative = self.values.text(timing, "domainAbsoluteRelative") == "relative"
        begins = self._time(trigger)
        if begins is not None and scale > 0.0:
            start = begins if is_relative else 0.0
            action.duration = times[-1] - (0.0 if is_relative else begins)
            entity.rows = tuple(
                (time + start, pose.x, pose.y, pose.yaw) for time, pose in zip(times, poses, strict=True)
            )
            return
        self._timed_path(entity, poses, times, action=action, trigger=trigger)

    def _timed_path(
        self,
        entity: Entity,
        poses: Sequence[Pose],
        times: Sequence[float],
        *,
        action: StoryElement,
        trigger: PhaseTrigger,
    ) -> None:
        """Make a trajectory that begins at an event a path, and its times speeds."""
        action.duration = times[-1] - times[0]
        entity.path = tuple(poses)
        steps = np.hypot(*np.diff([(pose.x, pose.y) for pose in poses], axis=0).T)
        speeds = steps / np.maximum(np.diff(times), 1e-3)
        edges = np.unique(np.linspace(0, len(speeds), min(len(speeds), MAX_PROFILE) + 1).astype(int))
        if len(edges) - 1 < len(speeds):
            self.doubts[f"the speeds of the trajectory of '{entity.name}' are means of its parts"] += 1
        previous, previous_first = "", 0
        for first, last in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
            speed = self._limited_speed(entity, float(steps[first:last].sum() / max(times[last] - times[first], 1e-3)))
            when = trigger
            if previous:
                begun_trigger = PhaseTrigger("phase_start", agent=entity.name, phase=previous)
                when = replace(begun_trigger, delay=times[first] - times[previous_first])
            previous, previous_first = self._name(action, entity), first
            entity.phases.append(Phase(speed, when, name=previous, shape="step", anytime=True))
            action.phases.append((entity.name, previous))

    def find_trajectory(self, follow: Element, entity: Entity) -> SampledTrajectory | None:
        """Return the trajectory of an action, from where it begins; None if it is not read."""
        element = next(follow.iter("Trajectory"), None)
        if element is None or not all(
            self.places.is_supported(position_element) for position_element in element.iter("Position")
        ):
            return None
        way = self.places.trajectory(element, entity.name if entity.placed else "")
        skipped = self.values.number(follow, "initialDistanceOffset", 0.0)
        if skipped <= 0.0 or skipped >= float(way.s[-1]):
            return way
        rest_index = int(np.searchsorted(way.s, skipped, side="right"))
        start = way.at(skipped)
        times = None
        if way.times is not None:
            times = np.concatenate([[float(np.interp(skipped, way.s, way.times))], way.times[rest_index:]])
        return SampledTrajectory(
            np.concatenate([[(start.x, start.y)], way.xy[rest_index:]]),
            np.concatenate([[start.yaw], way.yaw[rest_index:]]),
            np.concatenate([[0.0], way.s[rest_index:] - skipped]),
            times,
        )


def _is_motionless(action: Element) -> bool:
    """Return whether an action leaves all motions as they are, such as one of the weather."""
    if any(element.tag in _MOTIONLESS for element in action.iter()):
        return True
    activations = list(action.iter("ActivateControllerAction"))
    return bool(activations) and not any(
        activation.get(domain, "false").strip() in ("true", "1")
        for activation in activations
        for domain in ("lateral", "longitudinal")
    )


def _with_trigger(phases: Sequence, trigger: PhaseTrigger) -> list:  # type: ignore[type-arg]
    """Return phases of which the first waits for a trigger, and each other one for the one before it."""
    return [replace(phase, when=trigger if phase.when == ALWAYS else phase.when, anytime=True) for phase in phases]


def _in_sequence(phases: Sequence, entity: str) -> list:  # type: ignore[type-arg]
    """Return phases without conditions that their order gives: one waits for the one before it."""
    result: list = []  # type: ignore[type-arg]
    for index, phase in enumerate(phases):
        parts = conjuncts(phase.when)
        # A phase behind one that may begin at any time waits for those before that, too.
        required = list[str]()
        for other in reversed(result):
            required.append(other.name)
            if not other.anytime:
                break
        begun_trigger = {name: PhaseTrigger("phase_start", agent=entity, phase=name) for name in required}
        delayed = [
            part for part in parts if required and replace(part, delay=0.0) == begun_trigger[required[0]] and part.delay
        ]
        ended = {part.phase for part in parts if part.kind == "phase_end" and part.agent == entity}
        if index == 0:
            result.append(replace(phase, anytime=False))
        elif delayed and len(parts) == len(required) == 1:
            result.append(replace(phase, when=PhaseTrigger("after", delayed[0].delay), anytime=False))
        elif all(begun_trigger[name] in parts or name in ended for name in required):
            remaining = [part for part in parts if part not in begun_trigger.values()]
            result.append(replace(phase, when=all_of(remaining) if remaining else ALWAYS, anytime=False))
        else:
            result.append(phase)
    return result
