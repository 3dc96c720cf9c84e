"""A perceiver without images: clusters of LiDAR points are objects."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from ssad.core.driving import Observation
from ssad.core.types import Episode
from ssad.drivers.perceiving.ego_boxes import EgoBoxes
from ssad.rendering.lidar import HDL32E

CELL = 0.5  # m
LOWEST, HIGHEST = 0.3, 2.5  # m above the road, so that neither the road nor a bridge is an object
LONGEST = 6.0  # m; what is longer is a wall


class Clusters:
    """Perceiver that takes connected cells with LiDAR points for objects: long ones are cars, short ones pedestrians.

    Args:
        reach: Range, m; in a suite `perceiver: {example-clusters: {reach: 30}}`.
    """

    sensors = ("LIDAR_TOP",)  # that of nuScenes; another LiDAR needs a model in `lidars`
    classes = ("car", "pedestrian")

    def __init__(self, reach: float = 40.0) -> None:
        self.reach = reach

    def reset(self, episodes: Sequence[Episode]) -> None:
        """Do nothing: each look stands alone."""

    def perceive(self, view: Observation, rows: npt.NDArray[np.int64]) -> list[EgoBoxes]:
        """Return the boxes of each row in the frame of its ego."""
        return [self.boxes(points[points[:, 4] >= 0]) for points in view.readings["LIDAR_TOP"][rows]]

    def boxes(self, points: npt.NDArray[np.float32]) -> EgoBoxes:
        """Return the boxes around clusters of points [P, 5] of the sensor."""
        place = points[:, :3] @ HDL32E.to_ego[:3, :3].T + HDL32E.to_ego[:3, 3]
        near = (np.abs(place[:, :2]) < self.reach).all(1) & (place[:, 2] > LOWEST) & (place[:, 2] < HIGHEST)
        place = place[near]
        cell = ((place[:, :2] + self.reach) / CELL).astype(np.int64)
        side = int(2 * self.reach / CELL) + 1
        grid = np.zeros((side, side), bool)
        grid[cell[:, 0], cell[:, 1]] = True
        clusters, _ = ndimage.label(grid, np.ones((3, 3)))
        number = clusters[cell[:, 0], cell[:, 1]]
        found = []
        for cluster in np.unique(number):
            low, high = place[number == cluster].min(0), place[number == cluster].max(0)
            length = float((high - low)[:2].max())
            if length < LONGEST:
                found.append([*(0.5 * (low + high)), length > 1.0])
        table = np.array(found).reshape(-1, 4)
        is_car = table[:, 3:] > 0
        return EgoBoxes(
            centre=table[:, :3],
            size_lwh=np.where(is_car, (4.6, 1.95, 1.7), (0.7, 0.7, 1.8)),
            yaw=np.full(len(table), np.nan),
            velocity=np.full((len(table), 2), np.nan),
            label=np.where(is_car[:, 0], 0, 1),
            score=np.full(len(table), 0.8),
        )
