"""Camera rig of nuScenes."""

from __future__ import annotations

import numpy as np

from ssad.core.frames import FORWARD, Camera
from ssad.core.rotations import upright_pose

# rig of nuScenes: channel -> place on the ego (m), heading (degrees), focal length at a width of 1600
RIG = {
    "CAM_FRONT_LEFT": ((1.52, 0.49, 1.51), 55.0, 1272.6),
    "CAM_FRONT": ((1.70, 0.02, 1.51), 0.0, 1266.4),
    "CAM_FRONT_RIGHT": ((1.55, -0.49, 1.50), -55.5, 1260.8),
    "CAM_BACK_LEFT": ((1.04, 0.48, 1.56), 110.0, 1256.7),
    "CAM_BACK": ((0.03, 0.00, 1.57), 180.0, 809.2),
    "CAM_BACK_RIGHT": ((1.01, -0.48, 1.56), -110.0, 1259.5),
}


def rig_camera(channel: str, width: int) -> Camera:
    """Return a camera of the nuScenes rig with its image scaled to `width` pixels (16:9)."""
    position, heading, focal = RIG[channel]
    to_ego = upright_pose(position[0], position[1], np.radians(heading), position[2])
    to_ego[:3, :3] = to_ego[:3, :3] @ FORWARD[:3, :3]
    focal_length = focal * width / 1600
    height = width * 9 // 16
    matrix = np.array([[focal_length, 0, 816.8 * width / 1600], [0, focal_length, 492.0 * width / 1600], [0, 0, 1]])
    return Camera(width, height, matrix, to_ego, channel)
