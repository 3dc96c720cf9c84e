"""Triggers of an OpenSCENARIO document as conditions of phases."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from typing import TYPE_CHECKING, Final

from ssad.core.types import Condition
from ssad.interchange.openscenario_entities import Entity
from ssad.interchange.openscenario_places import Places
from ssad.world.models import MODELS

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

_GREATER, _LESS = ("greaterThan", "greaterOrEqual"), ("lessThan", "lessOrEqual")
_OUTER: Final = ("Condition", "ByEntityCondition", "ByValueCondition", "EntityCondition")


class Triggers:
    """The triggers of a document; what has no counterpart is counted in `lost`."""

    def __init__(self, places: Places, entities: Mapping[str, Entity], lost: Counter[str]) -> None:
        self.values, self.places, self.entities, self.lost = places.values, places, entities, lost
        self.ego = next(entity for entity in entities.values() if entity.ego)
        self._order = [name for name, one in entities.items() if not one.ego and one.placed]  # as conditions count

    def who(self, element: Element) -> Entity:
        """The entity that an element refers to. FormatError if there is none of that name."""
        name = self.values.text(element, "entityRef")
        if name not in self.entities:
            raise self.values.fail(element, f"there is no entity '{name}'")
        return self.entities[name]

    def conditions(self, event: Element, entity: Entity, label: str) -> tuple[Condition, ...] | None:
        """What the trigger of an event or act waits for, one after the other; None: for nothing with a counterpart."""
        found: list[tuple[Condition, ...]] = []
        after: list[Condition] = []  # delays since the event before
        left, ends = list[str](), 0
        for told in event.iterfind("StartTrigger/ConditionGroup/Condition"):
            inner = next((one for one in told.iter() if one.tag.endswith("Condition") and one.tag not in _OUTER), None)
            if inner is None:
                raise self.values.fail(told, f"the condition of '{label}' is empty")
            delay = max(self.values.number(told, "delay", 0.0), 0.0)
            if inner.tag == "StoryboardElementStateCondition":
                state = self.values.text(inner, "state")
                if state not in ("runningState", "completeState", "startTransition"):
                    left.append(f"{inner.tag} {state}")
                elif delay and self.values.text(inner, "storyboardElementRef") != entity.event:
                    self.lost[f"the delay of the trigger of '{label}' after another event than the one before"] += 1
                elif delay:
                    after.append(Condition("after", delay))
                    ends += state == "completeState"
                continue  # phases come one after the other
            when = self._one(told, inner, entity)
            if when is None:
                left.append(inner.tag)
                continue
            if when.kind in ("always", "time") and delay:
                when, delay = Condition("time", when.value + delay), 0.0
            one = (when, Condition("after", delay)) if delay else (when,)
            if one not in found:
                found.append(one)
        if after and ends == len(after):
            self.lost[f"the delay of the trigger of '{label}' is counted from where the event before begins"] += 1
        real = [one for one in found if one != (Condition("always"),)] or ([] if after else found)
        for tag in left:
            self.lost[f"{tag} of the trigger of '{label}'"] += 1
        if len(real) > 1:
            self.lost[f"all but the first of the {len(real)} conditions of the trigger of '{label}'"] += 1
        if real or after:
            return (*after[:1], *(real[0] if real else ()))
        return None if left else (Condition("always"),)

    def _one(self, told: Element, inner: Element, entity: Entity) -> Condition | None:
        rule = self.values.text(inner, "rule", "")
        refs = [self.who(ref) for ref in told.iterfind(".//TriggeringEntities/EntityRef")]
        value = self.values.number(inner, "value", 0.0)
        if inner.tag == "SimulationTimeCondition" and rule in _GREATER:
            return Condition("time", value) if value > 0.0 else Condition("always")
        if inner.tag == "TraveledDistanceCondition" and refs == [entity]:
            return Condition("travelled", value)
        if inner.tag == "SpeedCondition" and refs == [self.ego] and rule in _GREATER:
            return Condition("ego_speed", value)
        if inner.tag == "RelativeDistanceCondition" and rule in _LESS and len(refs) == 1:
            pair = [refs[0], self.who(inner)]
            others = [one for one in pair if one is not self.ego]
            kind = self.values.text(inner, "relativeDistanceType", "")
            if len(others) != 1 or kind == "lateral":
                return None
            if self.values.text(inner, "freespace", "false") == "true":
                value += 0.5 * (MODELS[self.ego.model].length + MODELS[others[0].model].length)
                self.lost[
                    "distances between bodies are taken as those between their centres, half the lengths added"
                ] += 1
            if kind == "longitudinal":
                self.lost["distances along the road are taken as straight ones"] += 1
            if others[0].name not in self._order:
                return None
            return Condition("ego_distance", value, self._order.index(others[0].name))
        reaches = inner.tag == "ReachPositionCondition" or (inner.tag == "DistanceCondition" and rule in _LESS)
        position = inner.find("Position")
        if reaches and refs == [self.ego] and entity.placed and not entity.ego and self.places.reads(position):
            # who waits stands: the ego is then so far from it
            place, here = self.places.pose(position, within=inner), self.places.start(entity.name, within=inner)
            more = self.values.number(inner, "tolerance", value)
            self.lost[f"a place that the ego reaches is taken as its distance from '{entity.name}'"] += 1
            gap = math.dist((place.x, place.y), (here.x, here.y))
            return Condition("ego_distance", gap + more, self._order.index(entity.name))
        return None
