"""Names of the world's models in CARLA and OpenSCENARIO, and the model nearest to a foreign body."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from ssad.core.types import AgentKind
from ssad.world.models import MODELS, SURROGATES

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
    "euroncap_adult": "walker.pedestrian.0001",
    "euroncap_child": "walker.pedestrian.0009",
    "euroncap_bicycle": "vehicle.diamondback.century",
    "euroncap_motorcycle": "vehicle.kawasaki.ninja",
    "euroncap_vehicle": "vehicle.nissan.micra",
}
"""Model -> blueprint of CARLA 0.9.16 (its catalogue of vehicles and props)."""
MODEL_OF: Final[dict[str, str]] = {name: model for model, name in BLUEPRINTS.items() if model not in SURROGATES}
TARGET_OF: Final[dict[str, str]] = {
    "ncap_adult": "euroncap_adult",
    "epta": "euroncap_adult",
    "ncap_child": "euroncap_child",
    "eptc": "euroncap_child",
    "ncap_bicycle": "euroncap_bicycle",
    "ebta": "euroncap_bicycle",
    "ncap_motorcycle": "euroncap_motorcycle",
    "emt": "euroncap_motorcycle",
    "ncap_globalvehicletarget": "euroncap_vehicle",
    "gvt": "euroncap_vehicle",
}
"""Name of a test target in lower case -> model: the catalogue of vectorgrp/OSC-NCAP-scenarios, and the abbreviations of
Euro NCAP's protocols."""
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
    """Return the model that represents a body best.

    Args:
        category: OpenSCENARIO category (`car`, `truck`, ..., `pedestrian`), or `prop`.
        size: Length, width and, if it is known, height, m.

    Returns:
        The model of that category whose size differs least; None if the category has none.
    """
    kinds = _CATEGORIES.get(category, ())
    candidates = [
        candidate for candidate in MODELS.values() if candidate.kind in kinds and candidate.name not in SURROGATES
    ]

    def size_difference(name: str) -> float:
        body = MODELS[name]
        model_size = (body.length, body.width, body.height)
        return sum(abs(model_extent - extent) for model_extent, extent in zip(model_size, size, strict=False))

    return min((candidate.name for candidate in candidates), key=size_difference, default=None)
