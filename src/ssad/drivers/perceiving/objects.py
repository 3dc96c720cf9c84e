"""Detected objects of all scenes at one time, as columns in the world frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Any, Final, Self

import numpy as np
import numpy.typing as npt

from ssad.core.columns import concatenate
from ssad.core.types import F64, AgentKind

I64 = npt.NDArray[np.int64]
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


@dataclass(frozen=True, slots=True)
class Objects:
    """Table of M detected objects of several scenes, in the world frame.

    Attributes:
        scene: [M] index of the scene.
        place: [M, 2] x, y of the centre, m.
        spread: [M, 2, 2] covariance of the position, m^2.
        yaw: [M] heading, rad; NaN where unknown.
        size: [M, 2] length and width, m.
        velocity: [M, 2] m/s; NaN where unknown.
        kind: [M] `ssad.core.types.AgentKind`.
        score: [M] confidence in 0..1.
    """

    scene: I64
    place: F64
    spread: F64
    yaw: F64
    size: F64
    velocity: F64
    kind: I64
    score: F64

    def __len__(self) -> int:
        return len(self.scene)

    def take(self, index: npt.NDArray[Any] | slice) -> Self:
        """Return the rows selected by indices, a mask or a slice."""
        return type(self)(**{column.name: getattr(self, column.name)[index] for column in fields(self)})

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Concatenate tables in order; at least one is required."""
        return concatenate(parts)


def no_objects() -> Objects:
    """Return a table without rows."""
    floats, integers = np.zeros(0), np.zeros(0, np.int64)
    return Objects(
        integers, np.zeros((0, 2)), np.zeros((0, 2, 2)), floats, np.zeros((0, 2)), np.zeros((0, 2)), integers, floats
    )
