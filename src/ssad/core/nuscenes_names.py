"""Names of the nuScenes detection task, in their orders.

Two orders of classes and attributes are in use: that of the official evaluation (nuscenes-devkit 1.2.0; labels of
tables, results and scores), and that of mmdetection3d 1.4 (labels of 3D detectors, since published weights use it).
Sources: nuscenes.org, schema of version 1.0; nuscenes-devkit, detection_cvpr_2019.json; mmdetection3d, nus-mono3d.py,
nuscenes_metric.py.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

# class -> m from the ego within which the evaluation counts it, in the official order
RANGES: Final[Mapping[str, float]] = MappingProxyType(
    {
        "car": 50.0,
        "truck": 50.0,
        "bus": 50.0,
        "trailer": 50.0,
        "construction_vehicle": 50.0,
        "pedestrian": 40.0,
        "motorcycle": 40.0,
        "bicycle": 40.0,
        "traffic_cone": 30.0,
        "barrier": 30.0,
    }
)
CLASSES: Final = tuple(RANGES)
MMDET3D_CLASSES: Final = (
    "car",
    "truck",
    "trailer",
    "bus",
    "construction_vehicle",
    "bicycle",
    "motorcycle",
    "pedestrian",
    "traffic_cone",
    "barrier",
)

ALIKE: Final = ("traffic_cone", "barrier")  # classes whose front and rear look alike

ATTRIBUTES: Final = (
    "pedestrian.moving",
    "pedestrian.sitting_lying_down",
    "pedestrian.standing",
    "cycle.with_rider",
    "cycle.without_rider",
    "vehicle.moving",
    "vehicle.parked",
    "vehicle.stopped",
)
MMDET3D_ATTRIBUTES: Final = (
    "cycle.with_rider",
    "cycle.without_rider",
    "pedestrian.moving",
    "pedestrian.standing",
    "pedestrian.sitting_lying_down",
    "vehicle.moving",
    "vehicle.parked",
    "vehicle.stopped",
    "none",
)
NO_ATTRIBUTE: Final = MMDET3D_ATTRIBUTES.index("none")
# mmdetection3d's export for an attribute that does not fit its class; "": a class without attributes
USUAL_ATTRIBUTE: Final[Mapping[str, str]] = MappingProxyType(
    {
        "car": "vehicle.parked",
        "truck": "vehicle.parked",
        "bus": "vehicle.moving",
        "trailer": "vehicle.parked",
        "construction_vehicle": "vehicle.parked",
        "pedestrian": "pedestrian.moving",
        "motorcycle": "cycle.without_rider",
        "bicycle": "cycle.without_rider",
        "traffic_cone": "",
        "barrier": "",
    }
)

CATEGORY_TO_CLASS: Final[Mapping[str, str]] = MappingProxyType(
    {
        "movable_object.barrier": "barrier",
        "vehicle.bicycle": "bicycle",
        "vehicle.bus.bendy": "bus",
        "vehicle.bus.rigid": "bus",
        "vehicle.car": "car",
        "vehicle.construction": "construction_vehicle",
        "vehicle.motorcycle": "motorcycle",
        "human.pedestrian.adult": "pedestrian",
        "human.pedestrian.child": "pedestrian",
        "human.pedestrian.construction_worker": "pedestrian",
        "human.pedestrian.police_officer": "pedestrian",
        "movable_object.trafficcone": "traffic_cone",
        "vehicle.trailer": "trailer",
        "vehicle.truck": "truck",
    }
)
BICYCLE_RACK: Final = "static_object.bicycle_rack"
CATEGORIES: Final = (
    *CATEGORY_TO_CLASS,
    "animal",
    "human.pedestrian.personal_mobility",
    "human.pedestrian.stroller",
    "human.pedestrian.wheelchair",
    "movable_object.debris",
    "movable_object.pushable_pullable",
    BICYCLE_RACK,
    "vehicle.emergency.ambulance",
    "vehicle.emergency.police",
)

CAMERAS: Final = ("CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_BACK_RIGHT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_FRONT_LEFT")
LIDAR: Final = "LIDAR_TOP"

# visibility token -> share of an object, seen over all cameras, above which it holds
VISIBILITY: Final[Mapping[str, float]] = MappingProxyType({"1": 0.0, "2": 0.4, "3": 0.6, "4": 0.8})


def visibility_token(share: float) -> str:
    """Return the visibility level of a share in 0..1: '1' up to 40 %, '2' up to 60, '3' up to 80, '4' above."""
    return max((token for token, lower_bound in VISIBILITY.items() if share > lower_bound), default="1")
