"""Who takes part in an OpenSCENARIO document, and the models that play them."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from ssad.core.types import Phase, Pose
from ssad.interchange.openscenario_places import Values
from ssad.simulators.carla.blueprints import MODEL_OF, nearest_model
from ssad.world.episode_arrays import MAX_AGENTS
from ssad.world.models import MODELS

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

EGO_NAMES: Final = ("ego", "hero", "ego_vehicle", "egovehicle")


@dataclass
class Entity:
    """An entity of the document, and what the storyboard has it do."""

    name: str
    model: str
    centre: tuple[float, float]  # of the body, seen from the reference point
    ego: bool
    placed: bool = True
    speed: float = 0.0
    policy: str = ""
    target_speed: float = 0.0
    route: tuple[Pose, ...] = ()
    path: tuple[Pose, ...] = ()
    phases: tuple[Phase, ...] = ()
    event: str = ""  # that made the last of them
    rows: tuple[tuple[float, float, float, float], ...] = ()
    leaves: float = math.inf
    change: tuple[float, int, float] | None = None  # m from the start, lanes to the left, m that it takes


def read_entities(root: Element, values: Values, lost: Counter[str], *, centred: bool) -> dict[str, Entity]:
    """The entities of a document, by name, in its order; one of them is the ego.

    Args:
        root: The document.
        values: Its values.
        lost: Takes what is not carried over.
        centred: Positions are those of the bodies' centres, whatever their bounding boxes say.

    Raises:
        FormatError: It has none that could be the ego, or one is broken.
    """
    found: dict[str, Entity] = {}
    egos: list[str] = []
    for item in root.iterfind("Entities/ScenarioObject"):
        name = values.text(item, "name")
        if name in found:
            raise values.fail(item, f"there are two entities '{name}'")
        body = next((one for one in item if one.tag in ("Vehicle", "Pedestrian", "MiscObject")), None)
        if body is None:
            what = item[0].tag if len(item) else "nothing"
            lost[f"entity '{name}': a {what} instead of its body: it is taken for a car"] += 1
            found[name] = Entity(name, "car", (0.0, 0.0), False)
        else:
            found[name] = Entity(name, *_body(name, body, values, lost, centred), False)
        kinds = {p.get("value", "") for p in item.iter("Property") if p.get("name") == "type"}
        if "ego_vehicle" in kinds or name.lower() in EGO_NAMES:
            egos.append(name)
    if not found:
        raise values.fail("Entities", "there is no ScenarioObject")
    if len(egos) > 1:
        lost[f"of {len(egos)} egos only '{egos[0]}' is driven by the system under test"] += 1
    vehicles = [n for n, e in found.items() if e.model not in ("walker", "vending_machine", "barrier", "cone")]
    if not egos and not vehicles:
        raise values.fail("Entities", "no vehicle could be the ego")
    if not egos:
        lost[f"no entity is called ego or hero: '{vehicles[0]}' is taken for it"] += 1
    found[(egos or vehicles)[0]].ego = True
    if len(found) > MAX_AGENTS:
        raise values.fail("Entities", f"{len(found)} entities; a scene has room for {MAX_AGENTS}")
    return found


def _body(
    name: str, body: Element, values: Values, lost: Counter[str], centred: bool
) -> tuple[str, tuple[float, float]]:
    """The model that plays a body, and where the body's centre is."""
    told = [p.get("value", "") for p in body.iter("Property") if p.get("name") == "ssad.model"]
    box = body.find("BoundingBox/Dimensions")
    centre = body.find("BoundingBox/Center")
    if box is None or centre is None:
        raise values.fail(body, f"entity '{name}' has no BoundingBox")
    size = [values.number(box, key) for key in ("length", "width", "height")]
    middle = (0.0, 0.0) if centred else (values.number(centre, "x"), values.number(centre, "y"))
    if told and told[0] in MODELS:
        return told[0], middle
    category = {"Pedestrian": "pedestrian", "MiscObject": "prop"}.get(body.tag)
    if category is None:
        category = values.text(body, "vehicleCategory")
    model = MODEL_OF.get(values.text(body, "name", "")) or nearest_model(category, size)
    if model is None:
        raise values.fail(body, f"entity '{name}': nobody here is like a {category[:40]}")
    own = (MODELS[model].length, MODELS[model].width, MODELS[model].height)
    if max(abs(a - b) for a, b in zip(own, size, strict=True)) > 0.05:
        lost[f"the body of '{name}' ({size[0]:g} x {size[1]:g} m) becomes '{model}' ({own[0]:g} x {own[1]:g} m)"] += 1
    return model, middle
