"""Entities of an OpenSCENARIO document, and the models that represent them."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from ssad.core.types import Phase, Pose
from ssad.interchange.openscenario_places import AttributeReader
from ssad.simulators.carla.blueprints import MODEL_OF, nearest_model
from ssad.world.episode_arrays import MAX_AGENTS
from ssad.world.models import MODELS

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

EGO_NAMES: Final = ("ego", "hero", "ego_vehicle", "egovehicle")


@dataclass
class Entity:
    """An entity of the document, and its behaviour in the storyboard."""

    name: str
    model: str
    centre: tuple[float, float]  # of the body, relative to the reference point
    ego: bool
    placed: bool = True
    speed: float = 0.0
    policy: str = ""
    target_speed: float = 0.0
    route: tuple[Pose, ...] = ()
    path: tuple[Pose, ...] = ()
    phases: tuple[Phase, ...] = ()
    event: str = ""  # name of the event that added the last phase
    rows: tuple[tuple[float, float, float, float], ...] = ()
    leaves: float = math.inf
    change: tuple[float, int, float] | None = None  # m from the start, lanes to the left, m that it takes


def read_entities(
    root: Element, values: AttributeReader, omissions: Counter[str], *, centred: bool
) -> dict[str, Entity]:
    """Return the entities of a document, by name, in its order; one of them is the ego.

    Args:
        root: The document.
        values: Reads the attributes of elements.
        omissions: Counter of the features that are not carried over.
        centred: Positions are those of the bodies' centres, whatever their bounding boxes say.

    Raises:
        FormatError: No entity could be the ego, or an entity is broken.
    """
    entities: dict[str, Entity] = {}
    egos: list[str] = []
    for scenario_object in root.iterfind("Entities/ScenarioObject"):
        name = values.text(scenario_object, "name")
        if name in entities:
            raise values.error(scenario_object, f"there are two entities '{name}'")
        body = next((child for child in scenario_object if child.tag in ("Vehicle", "Pedestrian", "MiscObject")), None)
        if body is None:
            content = scenario_object[0].tag if len(scenario_object) else "nothing"
            omissions[f"entity '{name}': a {content} instead of its body: it is taken for a car"] += 1
            entities[name] = Entity(name, "car", (0.0, 0.0), False)
        else:
            entities[name] = Entity(name, *_body(name, body, values, omissions, centred), False)
        type_properties = {
            property_element.get("value", "")
            for property_element in scenario_object.iter("Property")
            if property_element.get("name") == "type"
        }
        if "ego_vehicle" in type_properties or name.lower() in EGO_NAMES:
            egos.append(name)
    if not entities:
        raise values.error("Entities", "there is no ScenarioObject")
    if len(egos) > 1:
        omissions[f"of {len(egos)} egos only '{egos[0]}' is driven by the system under test"] += 1
    vehicles = [
        entity_name
        for entity_name, entity in entities.items()
        if entity.model not in ("walker", "vending_machine", "barrier", "cone")
    ]
    if not egos and not vehicles:
        raise values.error("Entities", "no vehicle could be the ego")
    if not egos:
        omissions[f"no entity is called ego or hero: '{vehicles[0]}' is taken for it"] += 1
    entities[(egos or vehicles)[0]].ego = True
    if len(entities) > MAX_AGENTS:
        raise values.error("Entities", f"{len(entities)} entities; a scene has room for {MAX_AGENTS}")
    return entities


def _body(
    name: str, body: Element, values: AttributeReader, omissions: Counter[str], centred: bool
) -> tuple[str, tuple[float, float]]:
    """Return the model that represents a body, and the position of the body's centre."""
    model_names = [
        property_element.get("value", "")
        for property_element in body.iter("Property")
        if property_element.get("name") == "ssad.model"
    ]
    dimensions = body.find("BoundingBox/Dimensions")
    centre = body.find("BoundingBox/Center")
    if dimensions is None or centre is None:
        raise values.error(body, f"entity '{name}' has no BoundingBox")
    size = [values.number(dimensions, key) for key in ("length", "width", "height")]
    offset = (0.0, 0.0) if centred else (values.number(centre, "x"), values.number(centre, "y"))
    if model_names and model_names[0] in MODELS:
        return model_names[0], offset
    category = {"Pedestrian": "pedestrian", "MiscObject": "prop"}.get(body.tag)
    if category is None:
        category = values.text(body, "vehicleCategory")
    model = MODEL_OF.get(values.text(body, "name", "")) or nearest_model(category, size)
    if model is None:
        raise values.error(body, f"entity '{name}': nobody here is like a {category[:40]}")
    model_size = (MODELS[model].length, MODELS[model].width, MODELS[model].height)
    if max(abs(model_extent - extent) for model_extent, extent in zip(model_size, size, strict=True)) > 0.05:
        omissions[
            f"the body of '{name}' ({size[0]:g} x {size[1]:g} m) becomes '{model}' "
            f"({model_size[0]:g} x {model_size[1]:g} m)"
        ] += 1
    return model, offset
