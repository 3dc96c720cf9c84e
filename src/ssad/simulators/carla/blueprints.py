"""The models of the world, as CARLA and OpenSCENARIO name them, and the model that is most like a foreign body."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from ssad.core.types import AgentKind
from ssad.world.models import MODELS

BLUEPRINTS: Final[dict[str, str]] = {
    "car": "vehicle.lincoln.mkz_2017",
    "suv": "vehicle.nissan.patrol",
    "coupe": "vehicle.audi.tt",
    "compact": "vehicle.nissan.micra",
    "van": "vehicle.mercedes.sprinter",
    "truck": "vehicle.carlamotors.firetruck",
    "bus": "vehicle.mitsubishi.fusorosa",
    "motorcycle": "vehicle.kawasaki.ninja",
    "bicycle": "vehicle.diamondback.century",
    "walker": "walker.pedestrian.0001",
    "vending_machine": "static.prop.vendingmachine",
    "barrier": "static.prop.streetbarrier",
    "cone": "static.prop.trafficcone01",
}
"""Model -> blueprint of CARLA 0.9.16 (its catalogue of vehicles and props)."""
MODEL_OF: Final[dict[str, str]] = {name: model for model, name in BLUEPRINTS.items()}
_CATEGORIES: Final[dict[str, tuple[AgentKind, ...]]] = {
    "car": (AgentKind.CAR,),
    "van": (AgentKind.CAR,),
    "truck": (AgentKind.TRUCK,),
    "semitrailer": (AgentKind.TRUCK,),
    "trailer": (AgentKind.TRUCK,),
    "bus": (AgentKind.BUS,),
    "motorbike": (AgentKind.MOTORCYCLE,),
    "bicycle": (AgentKind.BICYCLE,),
    "pedestrian": (AgentKind.WALKER,),
    "prop": (AgentKind.PROP,),
}
CATEGORY: Final[dict[AgentKind, str]] = {
    AgentKind.CAR: "car",
    AgentKind.TRUCK: "truck",
    AgentKind.BUS: "bus",
    AgentKind.MOTORCYCLE: "motorbike",
    AgentKind.BICYCLE: "bicycle",
    AgentKind.WALKER: "pedestrian",
    AgentKind.PROP: "prop",
}
"""Kind -> category of OpenSCENARIO."""


def nearest_model(category: str, size: Sequence[float]) -> str | None:
    """The model that may play a body.

    Args:
        category: Of OpenSCENARIO (`car`, `truck`, ..., `pedestrian`), or `prop`.
        size: Length, width and, where it is known, height, m.

    Returns:
        Of the models of that category the one whose size differs least; None where nothing is like it.
    """
    kinds = _CATEGORIES.get(category, ())
    models = [m for m in MODELS.values() if m.kind in kinds]

    def differs(name: str) -> float:
        body = MODELS[name]
        own = (body.length, body.width, body.height)
        return sum(abs(a - b) for a, b in zip(own, size, strict=False))

    return min((m.name for m in models), key=differs, default=None)
