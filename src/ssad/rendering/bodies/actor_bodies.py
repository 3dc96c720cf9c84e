"""Bodies of actors: from a model of the world to kind and styles, and from a kind to its nuScenes category."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from ssad.core.nuscenes_names import CATEGORY_TO_CLASS
from ssad.rendering.meshes.mesh import Material, Mesh, Point, box

# model of the world -> kind of body and its styles, the usual one first (listed twice: drawn twice as often);
# other models get a plain box
ACTOR_BODIES: Final[Mapping[str, tuple[str, tuple[str, ...]]]] = {
    "car": ("car", ("sedan", "estate", "sedan", "suv")),
    "suv": ("car", ("suv",)),
    "coupe": ("car", ("sedan", "hatchback")),
    "compact": ("car", ("hatchback",)),
    "van": ("car", ("van", "pickup")),
    "truck": ("truck", ("box", "flatbed", "tipper", "box")),
    "bus": ("bus", ("city", "coach")),
    "motorcycle": ("motorcycle", ("ridden",)),
    "bicycle": ("bicycle", ("ridden",)),
    "walker": ("pedestrian", ("adult",)),
    "cone": ("traffic_cone", ("cone",)),
    "euroncap_adult": ("pedestrian", ("adult",)),
    "euroncap_child": ("pedestrian", ("child",)),
    "euroncap_bicycle": ("bicycle", ("ridden",)),
    "euroncap_motorcycle": ("motorcycle", ("ridden",)),
    "euroncap_vehicle": ("car", ("hatchback",)),
}
# kind of body -> its category in nuScenes; other kinds are no objects of the detection task
BODY_CATEGORIES: Final[Mapping[str, str]] = {
    "car": "vehicle.car",
    "truck": "vehicle.truck",
    "bus": "vehicle.bus.rigid",
    "trailer": "vehicle.trailer",
    "construction": "vehicle.construction",
    "motorcycle": "vehicle.motorcycle",
    "bicycle": "vehicle.bicycle",
    "pedestrian": "human.pedestrian.adult",
    "traffic_cone": "movable_object.trafficcone",
    "barrier": "movable_object.barrier",
}


# kinds that 2D detectors learn beside the classes of nuScenes; the others are background to them
PLAIN_CLASSES: Final = ("stop_sign",)


def class_of(kind: str) -> str:
    """Return the nuScenes class of a kind of body.

    Raises:
        KeyError: The kind has no class.
    """
    return CATEGORY_TO_CLASS[BODY_CATEGORIES[kind]]


def plain_body(size: Point) -> Mesh:
    """Return a box of sheet metal for models without a body of their own.

    Args:
        size: Length, width, height, m.
    """
    return box(size, material=Material("sheet", (0.5, 0.08, 0.06), gloss=0.4), centre=(0, 0, size[2] / 2))
