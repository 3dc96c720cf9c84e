"""Bodies of actors: from a model of the world to kind and styles, and from a kind to its nuScenes category."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
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
    "euroncap_adult": ("pedestrian", ("adult_target",)),
    "euroncap_child": ("pedestrian", ("child_target",)),
    "euroncap_bicycle": ("bicycle", ("bicyclist_target",)),
    "euroncap_motorcycle": ("motorcycle", ("motorcyclist_target",)),
    "euroncap_vehicle": ("car", ("global_vehicle_target",)),
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


TRACTOR_SIZE: Final = (5.6, 2.5, 3.5)  # m, of a tractor before a trailer

# kinds that 2D detectors learn beside the classes of nuScenes; the others are background to them
PLAIN_CLASSES: Final = ("stop_sign",)


# styles with a category of their own
STYLE_CATEGORIES: Final[Mapping[tuple[str, str], str]] = {
    ("bus", "bendy"): "vehicle.bus.bendy",
    ("pedestrian", "child"): "human.pedestrian.child",
    ("pedestrian", "child_target"): "human.pedestrian.child",
    ("pedestrian", "worker"): "human.pedestrian.construction_worker",
}


def category_of(kind: str, style: str) -> str:
    """Return the nuScenes category of a style of a kind of body.

    Raises:
        KeyError: The kind has no category.
    """
    return STYLE_CATEGORIES.get((kind, style), BODY_CATEGORIES[kind])


@dataclass(frozen=True, slots=True)
class TowingVehicle:
    """Vehicle before a trailer.

    Attributes:
        kind: Kind of its body.
        style: Style of its body.
        size: Length, width, height, m.
        ahead: Distance from the middle of the trailer to the middle of the vehicle, m.
        length: Length of both together, m.
    """

    kind: str
    style: str
    size: Point
    ahead: float
    length: float


def towing_vehicle(style: str, size: Point) -> TowingVehicle:
    """Return the vehicle that draws a trailer: a car before a utility trailer, a tractor before others.

    Args:
        style: Style of the trailer.
        size: Its length, width, height, m.
    """
    if style == "utility":
        car_size = (4.70, 1.94, 1.52)
        ahead = 0.5 * (size[0] + car_size[0]) - 0.05  # the coupling lies on the ball
        return TowingVehicle("car", "estate", car_size, ahead, size[0] + car_size[0] - 0.05)
    # The trailer rests on the tractor's rear axle.
    return TowingVehicle("truck", "tractor", TRACTOR_SIZE, 0.5 * size[0] + 1.0, size[0] + 1.0 + 0.5 * TRACTOR_SIZE[0])


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
