"""Perception with one repaired error: one object is seen by a perfect detector, all others are unchanged."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ssad.core.driving import Belief, Observation
from ssad.core.frames import Camera
from ssad.core.perception import Objects, no_objects
from ssad.core.rotations import upright_pose
from ssad.core.types import Bool
from ssad.core.visibility import is_visible
from ssad.drivers.perceiving.lift import Lifting, lift
from ssad.drivers.perceiving.perceivers import PerfectPerceiver, object_boxes, project_boxes

AROUND = 5.0  # m around the object within which what was found is taken for it


@dataclass(frozen=True, eq=False)
class RepairedAgents:
    """Selection of the agents whose detections are repaired, for `ssad.drivers.perceiving.driver.PerceivingDriver`.

    Where the object can be seen, it is found where it is, and what was found within 5 m of it and near nobody else is
    left out; where it cannot be seen, nothing changes.

    Attributes:
        agents: Scene -> number of the agent.
        reach: m to which a perfect detector sees.
    """

    agents: Mapping[int, int]
    reach: float = 60.0

    def __call__(
        self, view: Observation, row: int, objects: Objects, cameras: Mapping[str, Camera], lifting: Lifting
    ) -> Objects:
        """Return the detected objects of a row, with the error repaired.

        Args:
            view: What the egos see; the sensor `truth` among it.
            row: Which row.
            objects: What was found there.
            cameras: Through which was looked.
            lifting: How detections become places.
        """
        agent = self.agents.get(int(view.scene[row]))
        truth: Belief = view.readings["truth"].rows([row])
        if agent is None or not is_visible(view.pose[[row], :2], truth, self.reach)[0, agent]:
            return objects
        ego = upright_pose(*view.pose[row].astype(np.float64).tolist())
        parts = [no_objects()]
        agent_mask = np.arange(truth.kind.shape[1]) == agent
        for camera in cameras.values():
            pose = ego @ camera.to_ego
            projected_agent = project_boxes(
                object_boxes(truth, 0, agent_mask), np.asarray(np.linalg.inv(pose), np.float64), camera
            )
            scene = view.scene[[row]].astype(np.int64)
            parts.append(lift([projected_agent], camera, pose[None], scene, PerfectPerceiver.classes, settings=lifting))
        if not cameras:  # a perceiver of LiDAR or radar: its own boxes are in no image
            parts.append(_true_object(truth, agent_mask, view.scene[row], lifting))
        perfect = Objects.cat(parts).take(np.arange(min(1, sum(len(part) for part in parts))))
        if not len(perfect):
            return objects
        true_positions = truth.pose[0, :, :2].astype(np.float64)
        distances = np.linalg.norm(objects.place[:, None] - true_positions[None], axis=-1)
        distances[:, truth.kind[0] == 0] = np.inf
        replaced = (distances[:, agent] < AROUND) & (distances[:, agent] <= distances.min(1, initial=np.inf))
        return Objects.cat([objects.take(~replaced), perfect])


def _true_object(truth: Belief, mask: Bool, scene: int, lifting: Lifting) -> Objects:
    """Return the selected object of a belief of one row as it is, with the covariance of detections at 0 m."""
    centre, size, yaw, kind, velocity = object_boxes(truth, 0, mask)
    count = len(kind)
    spread = np.tile(np.diag([lifting.along[0] ** 2, lifting.across[0] ** 2]), (count, 1, 1))
    scenes, kinds = np.full(count, scene, np.int64), np.array(kind, np.int64)
    return Objects(scenes, centre[:, :2], spread, yaw, size[:, :2], velocity, kinds, np.ones(count))
