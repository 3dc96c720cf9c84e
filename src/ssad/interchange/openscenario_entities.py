"""Entities of an OpenSCENARIO document, and the bodies that represent them."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from ssad.core.types import Body, LateralPhase, Phase, Pose
from ssad.interchange.openscenario_document import BODIES, AttributeReader
from ssad.simulators.carla.blueprints import MODEL_OF, TARGET_OF, nearest_model
from ssad.world.episode_arrays import MAX_AGENTS
from ssad.world.models import MODELS, model_with_body

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

EGO_NAMES: Final = ("ego", "hero", "ego_vehicle", "egovehicle")
RIDDEN_TARGETS: Final = ("euroncap_bicycle", "euroncap_motorcycle")
CLOSE: Final = 1e-6  # within which a body has the size and the limits of its model


@dataclass
class Entity:
    """An entity of the document, and its behaviour in the storyboard.

    Attributes:
        name: Its name.
        model: Model that represents it.
        body: Its dimensions and limits, where they differ from those of the model.
        centre: Centre of the body relative to the reference point, m forward and to the left.
        ego: The system under test drives it.
        element: Its element.
        placed: It has a position at the start.
        speed: Speed at the start, m/s.
        policy: Driver that controls it.
        target_speed: Speed of that driver on a free road, m/s.
        route: Waypoints.
        path: Points that it follows.
        phases: Changes of its speed.
        lateral: Changes of its lane.
        rows: Trajectory: time, x, y, yaw.
        appears: Time at which it appears, s.
        leaves: Time at which it disappears, s.
        native: SSAD wrote the file: rates that are the limits of the body mean full power or full brakes.
    """

    name: str
    model: str
    body: Body
    centre: tuple[float, float]
    ego: bool
    element: Element
    placed: bool = True
    speed: float = 0.0
    policy: str = ""
    target_speed: float = 0.0
    route: tuple[Pose, ...] = ()
    path: tuple[Pose, ...] = ()
    phases: list[Phase] = field(default_factory=list)
    lateral: list[LateralPhase] = field(default_factory=list)
    rows: tuple[tuple[float, float, float, float], ...] = ()
    appears: float = 0.0
    leaves: float = math.inf
    native: bool = False

    @property
    def length(self) -> float:
        """Length of the body, m."""
        return MODELS[self.model].length if self.body.length is None else self.body.length

    @property
    def limits(self) -> tuple[float, ...]:
        """Maximum acceleration and deceleration of an entity that SSAD wrote, m/s^2."""
        if not self.native:
            return ()
        model = model_with_body(MODELS[self.model], self.body)
        return model.max_accel, model.max_brake

    @property
    def max_speed(self) -> float:
        """Maximum speed, m/s."""
        return MODELS[self.model].max_speed if self.body.max_speed is None else self.body.max_speed


def read_entities(root: Element, values: AttributeReader, doubts: Counter[str], *, centred: bool) -> dict[str, Entity]:
    """Return the entities of a document, by name, in its order; one of them is the ego.

    Args:
        root: The document.
        values: Reads the attributes of elements.
        doubts: Counter of what changes a motion and is not carried over.
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
        body = next((child for child in scenario_object if child.tag in BODIES), None)
        if body is None:
            reference = scenario_object.find("CatalogReference")
            if reference is not None:
                raise values.error(
                    reference,
                    f"the body of '{name}' is entry '{reference.get('entryName')}' of catalogue "
                    f"'{reference.get('catalogName')}', which is not there; put it where CatalogLocations says",
                )
            content = scenario_object[0].tag if len(scenario_object) else "nothing"
            doubts[f"entity '{name}': a {content} instead of its body: it is taken for a car"] += 1
            entities[name] = Entity(name, "car", Body(), (0.0, 0.0), False, scenario_object)
        else:
            entities[name] = _entity(scenario_object, body, values, doubts, centred=centred)
        type_properties = {
            property_element.get("value", "")
            for property_element in scenario_object.iter("Property")
            if property_element.get("name") == "type"
        }
        if "ego_vehicle" in type_properties or name.lower() in EGO_NAMES:
            egos.append(name)
    if not entities:
        raise values.error("Entities", "there is no ScenarioObject")
    vehicles = [name for name, entity in entities.items() if _is_driven(entity)]
    egos = [name for name in egos if _is_driven(entities[name])]
    if len(egos) > 1:
        doubts[f"of {len(egos)} egos only '{egos[0]}' is driven by the system under test"] += 1
    if not egos and not vehicles:
        raise values.error("Entities", "no vehicle could be the ego")
    if not egos:
        doubts[f"no entity is called ego or hero: '{vehicles[0]}' is taken for it"] += 1
    entities[(egos or vehicles)[0]].ego = True
    if len(entities) > MAX_AGENTS:
        raise values.error("Entities", f"{len(entities)} entities; a scene has room for {MAX_AGENTS}")
    return entities


def _is_driven(entity: Entity) -> bool:
    """Return whether a driver can drive the entity: a vehicle with wheels."""
    return MODELS[entity.model].wheelbase > 0.0


def _entity(
    scenario_object: Element, body: Element, values: AttributeReader, doubts: Counter[str], *, centred: bool
) -> Entity:
    """Return the entity with a body."""
    name = values.text(scenario_object, "name")
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
        model = model_names[0]
    else:
        category = {"Pedestrian": "pedestrian", "MiscObject": "prop"}.get(body.tag)
        if category is None:
            category = values.text(body, "vehicleCategory")
        body_name = values.text(body, "name", "")
        nearest = MODEL_OF.get(body_name) or TARGET_OF.get(body_name.lower()) or nearest_model(category, size)
        if nearest is None:
            raise values.error(body, f"entity '{name}': nobody here is like a {category[:40]}")
        model = nearest
    stated = {"length": size[0], "width": size[1], "height": size[2]}
    for key, limit in stated.items():
        if not 0.05 <= limit <= 30.0:
            doubts[f"the {key} of '{name}' of {limit:g} m: that of a {model} is taken"] += 1
            stated[key] = getattr(MODELS[model], key)
    if model in RIDDEN_TARGETS:  # the box of the catalogue ends at the handlebar
        stated["height"] = max(stated["height"], MODELS[model].height)
    performance = body.find("Performance")
    if performance is not None and MODELS[model].max_speed > 0.0:
        for key, attribute, highest in (
            ("max_speed", "maxSpeed", 100.0),
            ("max_accel", "maxAcceleration", 20.0),
            ("max_brake", "maxDeceleration", 20.0),
        ):
            # Some files state 200 or 1e10 m/s^2 where they mean no limit.
            value = values.number(performance, attribute, getattr(MODELS[model], key))
            stated[key] = min(max(value, 0.1), highest)
        front, rear = body.find("Axles/FrontAxle"), body.find("Axles/RearAxle")
        if front is not None and rear is not None and MODELS[model].wheelbase > 0.0:
            wheelbase = values.number(front, "positionX", 0.0) - values.number(rear, "positionX", 0.0)
            if 0.2 * stated["length"] <= wheelbase <= stated["length"]:
                stated["wheelbase"] = wheelbase
    build_up = next((item for item in body.iter("Property") if item.get("name") == "ssad.brake_build_up"), None)
    if build_up is not None:
        stated["brake_build_up"] = values.number(build_up, "value")
    differing = {key: value for key, value in stated.items() if abs(value - getattr(MODELS[model], key)) > CLOSE}
    native = bool(model_names) and model_names[0] in MODELS
    return Entity(name, model, Body(**differing), offset, False, scenario_object, native=native)
