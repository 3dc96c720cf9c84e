"""Triggers of an OpenSCENARIO document as triggers of phases."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from enum import Enum
from typing import TYPE_CHECKING, Final

from ssad.core.expressions import number_or_text
from ssad.core.import_report import ImportReport
from ssad.core.types import PhaseTrigger
from ssad.interchange.openscenario_entities import Entity
from ssad.interchange.openscenario_places import PositionReader
from ssad.scenarios.dynamic.knowledge._placing import move_pose

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

TOUCH: Final = 0.01  # m between bodies that collide
EQUAL: Final = 0.05  # on either side of a value that a quantity is to be equal to
ALWAYS: Final = PhaseTrigger()
_ABOVE: Final = ("greaterThan", "greaterOrEqual")
_BELOW: Final = ("lessThan", "lessOrEqual")
_RULES: Final = (*_ABOVE, *_BELOW, "equalTo", "notEqualTo")
_OUTER: Final = ("Condition", "ByEntityCondition", "ByValueCondition", "EntityCondition")
_LASTING: Final = ("always", "time", "after", "travelled", "phase_start", "phase_end")
_RISING_KINDS: Final = ("time", "travelled", "speed", "relative_speed", "acceleration", "ego_speed")
_OLD_RULES: Final = {"GREATER_THAN": "greaterThan", "LESS_THAN": "lessThan", "EQUAL_TO": "equalTo"}


class Unfulfilled(Enum):
    """A trigger that has no counterpart, or that never holds."""

    UNKNOWN = "unknown"
    NEVER = "never"


Trigger = PhaseTrigger | Unfulfilled


def is_lasting(trigger: PhaseTrigger) -> bool:
    """Return whether a trigger, once it holds, goes on holding."""
    return (
        trigger.kind in _LASTING
        and trigger.rule != "below"
        and trigger.edge == "none"
        and all(is_lasting(trigger_part) for trigger_part in (*trigger.all, *trigger.any))
    )


def earliest_time(trigger: PhaseTrigger) -> float:
    """Return the time before which a trigger cannot hold, as far as its conditions on time say, s."""
    begin_time = trigger.value + trigger.delay if trigger.kind == "time" and trigger.rule != "below" else 0.0
    begin_time = max([begin_time, *(earliest_time(trigger_part) for trigger_part in trigger.all)])
    if trigger.any:
        begin_time = max(begin_time, min(earliest_time(trigger_part) for trigger_part in trigger.any))
    return begin_time


def both(first: Trigger, second: Trigger) -> Trigger:
    """Return the trigger that holds where two do; a part without a counterpart is left out."""
    return all_of([first, second])


def all_of(trigger_parts: Sequence[Trigger]) -> Trigger:
    """Return the trigger that holds where all do; parts without a counterpart are left out if others have one."""
    if Unfulfilled.NEVER in trigger_parts:
        return Unfulfilled.NEVER
    triggers = [trigger_part for trigger_part in trigger_parts if isinstance(trigger_part, PhaseTrigger)]
    if not triggers and trigger_parts:
        return Unfulfilled.UNKNOWN
    distinct = list(dict.fromkeys(trigger_part for trigger_part in triggers if trigger_part != ALWAYS))
    # What has ended has begun.
    ended = {(trigger_part.agent, trigger_part.phase) for trigger_part in distinct if trigger_part.kind == "phase_end"}
    distinct = [
        trigger_part
        for trigger_part in distinct
        if not (trigger_part.kind == "phase_start" and (trigger_part.agent, trigger_part.phase) in ended)
    ]
    if not distinct:
        return ALWAYS
    return distinct[0] if len(distinct) == 1 else PhaseTrigger(all=tuple(distinct))


def any_of(trigger_parts: Sequence[Trigger]) -> Trigger:
    """Return the trigger that holds where one does; parts without a counterpart are left out if others have one."""
    triggers = list(
        dict.fromkeys(trigger_part for trigger_part in trigger_parts if isinstance(trigger_part, PhaseTrigger))
    )
    if not triggers:
        return Unfulfilled.UNKNOWN if Unfulfilled.UNKNOWN in trigger_parts else Unfulfilled.NEVER
    if ALWAYS in triggers:
        return ALWAYS
    triggers = [
        trigger_part
        for trigger_part in triggers
        if not any(
            _implies(trigger_part, other_trigger) for other_trigger in triggers if other_trigger is not trigger_part
        )
    ]
    if len(triggers) == 1:
        return triggers[0]
    shared = [
        trigger_part
        for trigger_part in conjuncts(triggers[0])
        if all(trigger_part in conjuncts(other_trigger) for other_trigger in triggers)
    ]
    if not shared:
        return PhaseTrigger(any=tuple(triggers))
    rest = [
        all_of([trigger_part for trigger_part in conjuncts(trigger) if trigger_part not in shared] or [ALWAYS])
        for trigger in triggers
    ]
    return all_of([*shared, any_of(rest)])


def conjuncts(trigger: PhaseTrigger) -> tuple[PhaseTrigger, ...]:
    """Return the triggers that must all hold for a trigger to hold."""
    return trigger.all if trigger.all and trigger == PhaseTrigger(all=trigger.all) else (trigger,)


def _implies(trigger: PhaseTrigger, other_trigger: PhaseTrigger) -> bool:
    """Return whether one trigger holds only where another does, as far as their parts show."""
    trigger_parts = set(conjuncts(trigger))
    begun = {
        replace(trigger_part, kind="phase_start") for trigger_part in trigger_parts if trigger_part.kind == "phase_end"
    }
    required = set(conjuncts(other_trigger))
    return required <= trigger_parts | begun and not (trigger_parts <= required)


class TriggerReader:
    """The triggers of a document; triggers without a counterpart are counted in `doubts`."""

    def __init__(
        self,
        places: PositionReader,
        entities: Mapping[str, Entity],
        *,
        parameters: Mapping[str, str],
        doubts: Counter[str],
        report: ImportReport,
        element_state: Callable[[Element, str], Trigger],
    ) -> None:
        """Create the reader of one document.

        Args:
            places: Reads positions.
            entities: By name.
            parameters: Values of the document's parameters.
            doubts: Counter of what changes a motion and is not carried over.
            report: Filled with triggers that can never hold.
            element_state: Returns the trigger of a StoryboardElementStateCondition, whose delay and edge are left out.
        """
        self.values, self.places, self.entities, self.doubts = places.values, places, entities, doubts
        self.parameters, self.report, self._element_state = parameters, report, element_state
        self.ego = next(entity for entity in entities.values() if entity.ego)
        # As conditions of the kind `ego_distance` count.
        self._order = [name for name, entity in entities.items() if not entity.ego and entity.placed]

    def referenced_entity(self, element: Element) -> Entity:
        """Return the entity that an element refers to. FormatError if there is none of that name."""
        name = self.values.text(element, "entityRef")
        if name not in self.entities:
            raise self.values.error(element, f"there is no entity '{name}'")
        return self.entities[name]

    def agent_name(self, entity: Entity) -> str:
        """Return the name by which triggers call an entity."""
        return "ego" if entity.ego else entity.name

    def trigger(self, element: Element | None, entity: Entity | None, label: str) -> Trigger:
        """Return the trigger of an event, an act or a storyboard.

        Args:
            element: StartTrigger or StopTrigger; None, or without groups: it holds at once.
            entity: Entity that acts; conditions on itself do not name it.
            label: Name of the element that it starts, for messages.
        """
        groups = [] if element is None else element.findall("ConditionGroup")
        alternatives = []
        for group in groups:
            trigger_parts = [self._condition(condition, entity, label) for condition in group.iterfind("Condition")]
            alternatives.append(all_of(trigger_parts) if trigger_parts else ALWAYS)
        if not alternatives:
            return ALWAYS
        result = any_of(alternatives)
        if result is Unfulfilled.UNKNOWN:
            self.doubts[f"the trigger of '{label}' is not carried over"] += 1
        return result

    def _condition(self, condition: Element, entity: Entity | None, label: str) -> Trigger:
        content = next(
            (item for item in condition.iter() if item.tag.endswith("Condition") and item.tag not in _OUTER), None
        )
        if content is None:
            raise self.values.error(condition, f"the condition of '{label}' is empty")
        delay = max(self.values.number(condition, "delay", 0.0), 0.0)
        edge = self.values.text(condition, "conditionEdge", "none")
        if edge not in ("none", "rising", "falling", "risingOrFalling"):
            raise self.values.error(condition, f"conditionEdge is '{edge[:40]}'")
        if content.tag == "StoryboardElementStateCondition":
            result = self._element_state(content, label)
        elif condition.find("ByEntityCondition") is not None:
            result = self._by_entity(condition, content, entity, label)
        else:
            result = self._by_value(content, label)
        if result is Unfulfilled.UNKNOWN:
            self.doubts[f"{content.tag} of the trigger of '{label}' is not carried over"] += 1
        if not isinstance(result, PhaseTrigger):
            return result
        if edge == "falling" and is_lasting(result):
            return self.never(condition, label, "it waits for the end of a condition that never ends")
        if edge != "none" and not is_lasting(result):
            kind = {"risingOrFalling": "both"}.get(edge, edge)
            result = replace(result, edge=kind)  # type: ignore[arg-type]
        if not delay:
            return result
        if result == ALWAYS:
            return PhaseTrigger("time", delay)
        if result.kind == "time" and result.rule != "below" and result.edge == "none":
            return replace(result, value=result.value + delay)
        return replace(result, delay=delay)

    def never(self, element: Element, label: str, reason: str) -> Unfulfilled:
        """Report that a trigger can never hold, once for each place."""
        self.doubt(element, f"the trigger of '{label}' can never fire: {reason}")
        return Unfulfilled.NEVER

    def doubt(self, element: Element, message: str) -> None:
        """Report a doubt about an element with its place, once for each place."""
        place = f"{getattr(element, 'source', '')}:{getattr(element, 'line', 0)}"
        if place not in self.report.doubts.get(message, ()):
            self.report.doubt(message, place)

    # ------------------------------------------------------------ conditions on values

    def _by_value(self, content: Element, label: str) -> Trigger:
        rule = self._rule(content)
        if content.tag == "SimulationTimeCondition":
            value = self.values.number(content, "value")
            if rule in _BELOW:
                if value <= 0.0:
                    return self.never(content, label, f"the time is never below {value:g} s")
                return PhaseTrigger("time", value, rule="below")
            if rule == "notEqualTo":
                return Unfulfilled.UNKNOWN
            return PhaseTrigger("time", value) if value > 0.0 else ALWAYS
        if content.tag == "ParameterCondition":
            name = self.values.text(content, "parameterRef").removeprefix("$")
            if name not in self.parameters:
                return Unfulfilled.UNKNOWN
            return self._fixed(content, self.parameters[name], rule)
        return Unfulfilled.UNKNOWN

    def _fixed(self, content: Element, value_text: str, rule: str) -> Trigger:
        """Return the trigger of a condition on a value that never changes."""
        value, limit = number_or_text(value_text), number_or_text(self.values.text(content, "value"))
        if isinstance(value, str) or isinstance(limit, str):
            is_fulfilled = (str(value) == str(limit)) == (rule != "notEqualTo")
        else:
            compare = {
                "equalTo": value == limit,
                "notEqualTo": value != limit,
                "greaterThan": value > limit,
                "greaterOrEqual": value >= limit,
                "lessThan": value < limit,
                "lessOrEqual": value <= limit,
            }
            is_fulfilled = compare.get(rule, False)
        return ALWAYS if is_fulfilled else Unfulfilled.NEVER

    # ------------------------------------------------------------ conditions on entities

    def _by_entity(self, condition: Element, content: Element, entity: Entity | None, label: str) -> Trigger:
        triggering = [self.referenced_entity(item) for item in condition.iterfind(".//TriggeringEntities/EntityRef")]
        if not triggering:
            raise self.values.error(condition, "TriggeringEntities is missing or empty")
        trigger_parts = [self._of_entity(content, agent, entity, label) for agent in triggering]
        element = condition.find(".//TriggeringEntities")
        rule = "any" if element is None else self.values.text(element, "triggeringEntitiesRule", "any")
        if rule not in ("any", "all", "none"):
            raise self.values.error(condition, f"triggeringEntitiesRule is '{rule[:40]}'; known: any, all, none")
        if rule == "none":
            return Unfulfilled.UNKNOWN
        return all_of(trigger_parts) if rule == "all" else any_of(trigger_parts)

    def _of_entity(self, content: Element, agent: Entity, entity: Entity | None, label: str) -> Trigger:
        name = "" if agent is entity else self.agent_name(agent)
        if self.values.text(content, "direction", "longitudinal") != "longitudinal":
            return Unfulfilled.UNKNOWN
        simple = {"TraveledDistanceCondition": "travelled", "SpeedCondition": "speed"}
        simple["AccelerationCondition"] = "acceleration"
        if content.tag in simple:
            return self._compared(PhaseTrigger(simple[content.tag], agent=name), content, label)  # type: ignore[arg-type]
        if content.tag == "StandStillCondition":
            return PhaseTrigger("standstill", self.values.number(content, "duration"), agent=name)
        if content.tag == "RelativeSpeedCondition":
            reference = self._reference(content, agent, entity)
            return self._compared(PhaseTrigger("relative_speed", agent=name, reference=reference), content, label)
        if content.tag in ("RelativeDistanceCondition", "TimeHeadwayCondition"):
            kind = "distance" if content.tag == "RelativeDistanceCondition" else "time_headway"
            result = PhaseTrigger(kind, agent=name, reference=self._reference(content, agent, entity))  # type: ignore[arg-type]
            other_trigger = self.referenced_entity(content)
            return self._ego_distance(
                self._compared(self._measured(result, content), content, label), agent, other_trigger
            )
        if content.tag == "TimeToCollisionCondition":
            target = content.find("TimeToCollisionConditionTarget")
            entity_ref = None if target is None else target.find("EntityRef")
            result = PhaseTrigger("time_to_collision", agent=name)
            if entity_ref is not None:
                result = replace(result, reference=self._reference(entity_ref, agent, entity))
            else:
                position = None if target is None else target.find("Position")
                if not self.places.is_supported(position):
                    return Unfulfilled.UNKNOWN
                result = replace(result, position=self._point(position, content, agent))
            return self._compared(self._measured(result, content), content, label)
        if content.tag in ("ReachPositionCondition", "DistanceCondition"):
            position = content.find("Position")
            if not self.places.is_supported(position):
                return Unfulfilled.UNKNOWN
            point = self._point(position, content, agent)
            if content.tag == "ReachPositionCondition":
                tolerance = self.values.number(content, "tolerance")
                return PhaseTrigger("position", tolerance, agent=name, position=point)
            result = self._measured(PhaseTrigger("distance", agent=name, position=point), content)
            return self._compared(result, content, label)
        if content.tag == "CollisionCondition":
            entity_ref = content.find("EntityRef")
            if entity_ref is None:
                return Unfulfilled.UNKNOWN
            reference = self._reference(entity_ref, agent, entity)
            return PhaseTrigger("distance", TOUCH, agent=name, reference=reference, free_space=True)
        return Unfulfilled.UNKNOWN

    def _reference(self, element: Element, agent: Entity, entity: Entity | None) -> str:
        """Return the name of the entity that a condition compares with."""
        other_trigger = self.referenced_entity(element)
        if other_trigger is agent:
            raise self.values.error(element, f"'{other_trigger.name}' is compared with itself")
        return (
            other_trigger.name if other_trigger is entity and not other_trigger.ego else self.agent_name(other_trigger)
        )

    def _point(self, position: Element | None, within: Element, agent: Entity) -> tuple[float, float]:
        """Return the point at which the centre of a body is when its reference point is at a position."""
        pose = self.places.pose(position, within=within)
        moved = move_pose(pose, *agent.centre) if any(agent.centre) else pose
        return moved.x, moved.y

    def _rule(self, content: Element) -> str:
        rule = self.values.text(content, "rule", "")
        rule = _OLD_RULES.get(rule, rule)
        if rule and rule not in _RULES:
            raise self.values.error(content, f"rule is '{rule[:40]}'; known: {', '.join(_RULES)}")
        return rule

    def _measured(self, trigger: PhaseTrigger, content: Element) -> PhaseTrigger:
        """Return a trigger on a distance with the way in which a condition measures it."""
        free_space = self.values.truth(content, "freespace", default=False)
        distance_type = self.values.text(content, "relativeDistanceType", "")
        is_along_road = distance_type == "longitudinal" or self.values.truth(content, "alongRoute", default=False)
        is_along_road = is_along_road or self.values.text(content, "coordinateSystem", "entity") in (
            "lane",
            "road",
            "trajectory",
        )
        measure = "lateral" if distance_type == "lateral" else "road" if is_along_road else "straight"
        return replace(trigger, free_space=free_space, measure=measure)  # type: ignore[arg-type]

    def _compared(self, trigger: PhaseTrigger, content: Element, label: str) -> Trigger:
        """Return a trigger with the value and the rule of a condition."""
        value = self.values.number(content, "value")
        rule = self._rule(content) or ("greaterThan" if trigger.kind == "travelled" else "")
        is_rising_kind = trigger.kind in _RISING_KINDS
        if rule in _ABOVE or (rule == "equalTo" and trigger.kind == "travelled"):
            return replace(trigger, value=value, rule="" if is_rising_kind else "above")
        if rule in _BELOW:
            if value <= 0.0 and trigger.kind not in ("relative_speed", "acceleration"):
                return self.never(content, label, f"{content.tag} is never below {value:g}")
            return replace(trigger, value=value, rule="below" if is_rising_kind else "")
        if rule == "equalTo":
            above = replace(trigger, value=value - EQUAL, rule="above")
            return PhaseTrigger(all=(above, replace(trigger, value=value + EQUAL, rule="below")))
        return Unfulfilled.UNKNOWN

    def _ego_distance(self, trigger: Trigger, agent: Entity, other_trigger: Entity) -> Trigger:
        """Return the trigger in its shorter form if it is on the distance of the centres of the ego and an actor."""
        actors = [entity for entity in (agent, other_trigger) if not entity.ego]
        if (
            isinstance(trigger, PhaseTrigger)
            and trigger.kind == "distance"
            and not (trigger.rule or trigger.free_space or trigger.measure != "straight")
            and len(actors) == 1
            and actors[0].name in self._order
        ):
            return PhaseTrigger("ego_distance", trigger.value, self._order.index(actors[0].name))
        return trigger
