"""Triggers of an OpenSCENARIO document, converted to conditions of phases."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from typing import TYPE_CHECKING, Final

from ssad.core.types import PhaseTrigger
from ssad.interchange.openscenario_entities import Entity
from ssad.interchange.openscenario_places import PositionReader
from ssad.world.models import MODELS

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

_GREATER, _LESS = ("greaterThan", "greaterOrEqual"), ("lessThan", "lessOrEqual")
_OUTER: Final = ("Condition", "ByEntityCondition", "ByValueCondition", "EntityCondition")


class TriggerReader:
    """The triggers of a document; triggers without a counterpart are counted in `omissions`."""

    def __init__(self, places: PositionReader, entities: Mapping[str, Entity], omissions: Counter[str]) -> None:
        self.values, self.places, self.entities, self.omissions = places.values, places, entities, omissions
        self.ego = next(entity for entity in entities.values() if entity.ego)
        self._order = [
            name for name, candidate in entities.items() if not candidate.ego and candidate.placed
        ]  # as conditions count

    def referenced_entity(self, element: Element) -> Entity:
        """Return the entity that an element refers to. FormatError if there is none of that name."""
        name = self.values.text(element, "entityRef")
        if name not in self.entities:
            raise self.values.error(element, f"there is no entity '{name}'")
        return self.entities[name]

    def conditions(self, event: Element, entity: Entity, label: str) -> tuple[PhaseTrigger, ...] | None:
        """Return the sequence of conditions that the trigger of an event or act waits for.

        Returns:
            The conditions, in their order; None if no part of the trigger has a counterpart.
        """
        alternatives: list[tuple[PhaseTrigger, ...]] = []
        delays: list[PhaseTrigger] = []  # delays since the previous event
        unread, completed = list[str](), 0
        for condition in event.iterfind("StartTrigger/ConditionGroup/Condition"):
            condition_type = next(
                (
                    sequence
                    for sequence in condition.iter()
                    if sequence.tag.endswith("Condition") and sequence.tag not in _OUTER
                ),
                None,
            )
            if condition_type is None:
                raise self.values.error(condition, f"the condition of '{label}' is empty")
            delay = max(self.values.number(condition, "delay", 0.0), 0.0)
            if condition_type.tag == "StoryboardElementStateCondition":
                state = self.values.text(condition_type, "state")
                if state not in ("runningState", "completeState", "startTransition"):
                    unread.append(f"{condition_type.tag} {state}")
                elif delay and self.values.text(condition_type, "storyboardElementRef") != entity.event:
                    self.omissions[
                        f"the delay of the trigger of '{label}' after another event than the one before"
                    ] += 1
                elif delay:
                    delays.append(PhaseTrigger("after", delay))
                    completed += state == "completeState"
                continue  # phases follow each other in any case
            converted = self._convert_condition(condition, condition_type, entity)
            if converted is None:
                unread.append(condition_type.tag)
                continue
            if converted.kind in ("always", "time") and delay:
                converted, delay = PhaseTrigger("time", converted.value + delay), 0.0
            sequence = (converted, PhaseTrigger("after", delay)) if delay else (converted,)
            if sequence not in alternatives:
                alternatives.append(sequence)
        # Our writer gives each delay for a running and for a completed event; other files may have only the latter.
        if delays and completed == len(delays):
            self.omissions[f"the delay of the trigger of '{label}' is counted from where the event before begins"] += 1
        required = [sequence for sequence in alternatives if sequence != (PhaseTrigger("always"),)] or (
            [] if delays else alternatives
        )
        for unread_tag in unread:
            self.omissions[f"{unread_tag} of the trigger of '{label}'"] += 1
        if len(required) > 1:
            self.omissions[f"all but the first of the {len(required)} conditions of the trigger of '{label}'"] += 1
        if required or delays:
            return (*delays[:1], *(required[0] if required else ()))
        return None if unread else (PhaseTrigger("always"),)

    def _convert_condition(self, condition: Element, condition_type: Element, entity: Entity) -> PhaseTrigger | None:
        rule = self.values.text(condition_type, "rule", "")
        triggering = [
            self.referenced_entity(reference) for reference in condition.iterfind(".//TriggeringEntities/EntityRef")
        ]
        value = self.values.number(condition_type, "value", 0.0)
        if condition_type.tag == "SimulationTimeCondition" and rule in _GREATER:
            return PhaseTrigger("time", value) if value > 0.0 else PhaseTrigger("always")
        if condition_type.tag == "TraveledDistanceCondition" and triggering == [entity]:
            return PhaseTrigger("travelled", value)
        if condition_type.tag == "SpeedCondition" and triggering == [self.ego] and rule in _GREATER:
            return PhaseTrigger("ego_speed", value)
        if condition_type.tag == "RelativeDistanceCondition" and rule in _LESS and len(triggering) == 1:
            entities = [triggering[0], self.referenced_entity(condition_type)]
            other_entities = [entity_of_pair for entity_of_pair in entities if entity_of_pair is not self.ego]
            distance_type = self.values.text(condition_type, "relativeDistanceType", "")
            if len(other_entities) != 1 or distance_type == "lateral":
                return None
            if self.values.text(condition_type, "freespace", "false") == "true":
                value += 0.5 * (MODELS[self.ego.model].length + MODELS[other_entities[0].model].length)
                self.omissions[
                    "distances between bodies are taken as those between their centres, half the lengths added"
                ] += 1
            if distance_type == "longitudinal":
                self.omissions["distances along the road are taken as straight ones"] += 1
            if other_entities[0].name not in self._order:
                return None
            return PhaseTrigger("ego_distance", value, self._order.index(other_entities[0].name))
        is_reach = condition_type.tag == "ReachPositionCondition" or (
            condition_type.tag == "DistanceCondition" and rule in _LESS
        )
        position = condition_type.find("Position")
        if (
            is_reach
            and triggering == [self.ego]
            and entity.placed
            and not entity.ego
            and self.places.is_supported(position)
        ):
            # a waiting actor stands still, so the place is a distance from it
            target, start = (
                self.places.pose(position, within=condition_type),
                self.places.start(entity.name, within=condition_type),
            )
            tolerance = self.values.number(condition_type, "tolerance", value)
            self.omissions[f"a place that the ego reaches is taken as its distance from '{entity.name}'"] += 1
            gap = math.dist((target.x, target.y), (start.x, start.y))
            return PhaseTrigger("ego_distance", gap + tolerance, self._order.index(entity.name))
        return None
