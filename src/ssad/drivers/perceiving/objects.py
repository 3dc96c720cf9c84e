"""Kinds of objects that matter to a driver, and their default sizes."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

import numpy as np

from ssad.core.types import F64, AgentKind

# names of nuScenes and COCO; all other classes are irrelevant to a driver
KINDS: Final[Mapping[str, AgentKind]] = MappingProxyType(
    {
        "car": AgentKind.CAR,
        "truck": AgentKind.TRUCK,
        "bus": AgentKind.BUS,
        "trailer": AgentKind.TRUCK,
        "construction_vehicle": AgentKind.TRUCK,
        "motorcycle": AgentKind.MOTORCYCLE,
        "bicycle": AgentKind.BICYCLE,
        "pedestrian": AgentKind.WALKER,
        "person": AgentKind.WALKER,
        "traffic_cone": AgentKind.PROP,
        "barrier": AgentKind.PROP,
    }
)
# default length, width and height of each kind, m; rounded means of nuScenes' training split
SIZES: Final[F64] = np.array(
    [
        (1.0, 1.0, 1.0),
        (4.6, 1.95, 1.73),
        (6.9, 2.5, 2.84),
        (11.1, 2.95, 3.49),
        (2.1, 0.77, 1.48),
        (1.7, 0.61, 1.3),
        (0.73, 0.67, 1.77),
        (0.6, 0.9, 1.0),
    ]
)
LARGE: Final = (AgentKind.CAR, AgentKind.TRUCK, AgentKind.BUS)
