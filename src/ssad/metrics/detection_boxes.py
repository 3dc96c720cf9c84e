"""3D boxes as columns, the official settings of the nuScenes detection task, and its filter of boxes.

Source: nuscenes-devkit 1.2.0, eval/common/loaders.py (`filter_eval_boxes`) and configs/detection_cvpr_2019.json.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from ssad.core.boxes import WorldBoxes
from ssad.core.errors import FormatError
from ssad.core.nuscenes_names import RANGES
from ssad.core.types import F64, I32, Bool

I8 = npt.NDArray[np.int8]
I64 = npt.NDArray[np.int64]

TP_METRICS: Final = ("trans_err", "scale_err", "orient_err", "vel_err", "attr_err")
RACKED: Final = ("bicycle", "motorcycle")


@dataclass(frozen=True)
class BoxTable(WorldBoxes):
    """Boxes of a set, one in each row; the rows of a sample are together, in the order of the devkit's lists.

    Attributes:
        velocity: [N, 2], m/s.
        sample: Index of the sample [N].
        label: Index of the class [N].
        attribute: Index [N]; -1 for none.
        score: [N]; -1 for ground truth.
        ego_distance: Distance from the ego in the plane [N], m.
    """

    sample: I32
    label: I8
    attribute: I8
    score: F64
    ego_distance: F64

    @staticmethod
    def empty(n: int = 0) -> BoxTable:
        """A table of n rows of zeros: attribute and score -1, velocity and ego_distance NaN."""
        return BoxTable(
            sample=np.zeros(n, np.int32),
            label=np.zeros(n, np.int8),
            centre=np.zeros((n, 3)),
            size_lwh=np.zeros((n, 3)),
            rotation=np.zeros((n, 4)),
            velocity=np.full((n, 2), np.nan),
            attribute=np.full(n, -1, np.int8),
            score=np.full(n, -1.0),
            ego_distance=np.full(n, np.nan),
        )


@dataclass(frozen=True)
class BikeRacks(WorldBoxes):
    """Bicycle racks.

    Attributes:
        sample: Index of the sample [N].
    """

    sample: I32


@dataclass(frozen=True)
class DetectionConfig:
    """Settings of the task; the defaults are the official detection_cvpr_2019.

    Attributes:
        class_range: Class -> range, m, in the order of the labels.
        dist_ths: Thresholds of a match, m.
        dist_th_tp: The threshold whose matches the TP errors are of, m.
        min_recall: Recall up to which AP and TP errors do not count.
        min_precision: Precision that is subtracted before AP is averaged.
        max_boxes_per_sample: Maximum number of predictions in a sample.
        mean_ap_weight: Weight of mAP in NDS; each TP score has the weight 1.
    """

    class_range: Mapping[str, float] = field(default_factory=lambda: RANGES)
    dist_ths: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0)
    dist_th_tp: float = 2.0
    min_recall: float = 0.1
    min_precision: float = 0.1
    max_boxes_per_sample: int = 500
    mean_ap_weight: int = 5

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes in the order of the labels."""
        return tuple(self.class_range)

    def serialize(self) -> dict[str, Any]:
        """Return the devkit's `cfg` entry."""
        return {
            "class_range": {
                name: int(distance) if distance == int(distance) else distance
                for name, distance in self.class_range.items()
            },
            "dist_fcn": "center_distance",
            "dist_ths": list(self.dist_ths),
            "dist_th_tp": self.dist_th_tp,
            "min_recall": self.min_recall,
            "min_precision": self.min_precision,
            "max_boxes_per_sample": self.max_boxes_per_sample,
            "mean_ap_weight": self.mean_ap_weight,
        }


CVPR_2019: Final = DetectionConfig()


def check_counts(boxes: BoxTable, *, config: DetectionConfig = CVPR_2019, names: Sequence[str] | None = None) -> None:
    """Raise FormatError if a sample has more predictions than the task allows; names it by token, else index."""
    counts = np.bincount(boxes.sample)
    if counts.size and counts.max() > config.max_boxes_per_sample:
        largest_sample = int(counts.argmax())
        raise FormatError(
            f"sample {largest_sample if names is None else names[largest_sample]}: "
            f"{counts[largest_sample]} boxes, but at most "
            f"{config.max_boxes_per_sample} are allowed; keep the best of them"
        )


def keep_boxes(
    boxes: BoxTable,
    *,
    config: DetectionConfig = CVPR_2019,
    points: npt.NDArray[Any] | None = None,
    racks: BikeRacks | None = None,
) -> Bool:
    """Return which boxes the task counts: within the range of their class, not empty, not parked in a rack.

    Args:
        boxes: The boxes.
        config: Settings of the task.
        points: LiDAR and radar points in each box [N]; boxes with 0 are left out (negative: unknown).
        racks: Bicycles and motorcycles whose centre lies in a rack of the same sample are left out.

    Returns:
        Mask [N].
    """
    ranges = np.array(list(config.class_range.values()), np.float64)
    is_counted: Bool = boxes.ego_distance < ranges[boxes.label]
    if points is not None:
        is_counted &= points != 0
    if racks is not None and len(racks.sample):
        is_rack_class = np.array([name in RACKED for name in config.classes])
        rows = np.flatnonzero(is_counted & is_rack_class[boxes.label])
        is_counted[rows[_in_racks(boxes.sample[rows], boxes.centre[rows], racks)]] = False
    return is_counted


def filter_boxes(
    boxes: BoxTable,
    *,
    config: DetectionConfig = CVPR_2019,
    points: npt.NDArray[Any] | None = None,
    racks: BikeRacks | None = None,
) -> BoxTable:
    """Return the boxes that the task counts, in their order (see `keep_boxes`)."""
    return boxes.take(np.flatnonzero(keep_boxes(boxes, config=config, points=points, racks=racks)))


def _in_racks(sample: I32, centre: F64, racks: BikeRacks) -> Bool:
    """Return which points [N] lie in a rack of their sample, bounds included, in the devkit's arithmetic."""
    rack_order = np.argsort(racks.sample, kind="stable")
    first_rack = np.searchsorted(racks.sample[rack_order], sample, side="left")
    count = np.searchsorted(racks.sample[rack_order], sample, side="right") - first_rack
    centre_indices = np.repeat(np.arange(len(sample)), count)
    rack_indices = rack_order[np.arange(len(centre_indices)) - np.repeat(np.cumsum(count) - count - first_rack, count)]

    candidate_racks = racks.take(rack_indices)
    half_size, rack_axes = 0.5 * candidate_racks.size_lwh, candidate_racks.axes()
    corner = np.empty((4, len(rack_indices), 3))
    for corner_index, (x_sign, y_sign, z_sign) in enumerate(((1, 1, 1), (-1, 1, 1), (1, -1, 1), (1, 1, -1))):
        local_corners = [x_sign, y_sign, z_sign] * half_size
        corner[corner_index] = np.einsum("nij,nj->ni", rack_axes, local_corners) + candidate_racks.centre
    offset = centre[centre_indices] - corner[0]
    is_inside = np.ones(len(rack_indices), np.bool_)
    for edge in corner[1:] - corner[0]:
        projection = (edge * offset).sum(axis=1)
        is_inside &= (projection >= 0.0) & (projection <= (edge * edge).sum(axis=1))
    return np.bincount(centre_indices[is_inside], minlength=len(sample)) > 0
