"""Observations and actions of a policy: their widths, and the conversion of actions to controls."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ssad.core.types import F32

WIDTHS: Mapping[str, int] = {"safebench": 4, "frea": 24, "traffic": 69, "adversary": 24, "adversary-on-road": 45}
"""Sensors that a policy can look at, and how many numbers they have."""
ACTIONS: Mapping[str, int] = {"safebench": 2, "frea": 3, "pedals": 2, "adversary": 2}
"""Actions that a policy can take, and how many numbers they have; see `to_controls`."""

CHOICES: F32 = np.array(np.meshgrid([-1, 0, 1], [-1, -0.5, 0, 0.5, 1], indexing="ij"), np.float32).reshape(2, -1).T
"""Actions of two numbers that a policy which values each of them chooses from [15, 2]."""


def to_controls(kind: str, action: F32) -> F32:
    """Convert policy actions [N, n] to throttle, brake, steer and reverse [N, 4].

    `safebench`: acceleration / 3 m/s^2 and steer / 0.3, with at most 3 of 8 m/s^2 of brake. `frea`: throttle,
    steer / 0.3 and brake. `pedals`: throttle, or below 0 the whole brake, and steer / 0.3. `adversary`: throttle,
    below 0 in reverse, and steer / 0.3; no brake. All are clipped to [-1, 1].

    Source: SafeBench (Xu et al. 2022) and FREA (Chen et al. 2024), their environments.
    """
    clipped = np.minimum(np.maximum(np.asarray(action, np.float32), -1.0), 1.0)
    controls = np.zeros((len(clipped), 4), np.float32)
    first = clipped[:, 0]
    if kind == "frea":
        throttle, brake = first * 0.5 + 0.5, clipped[:, 2] * 0.5 + 0.5
        controls[:, 0] = throttle
        controls[:, 1] = np.where((brake < 0.05) | (throttle > brake), 0.0, brake)
    else:
        controls[:, 0] = np.abs(first) if kind == "adversary" else np.maximum(first, 0.0)
        if kind != "adversary":
            controls[:, 1] = np.maximum(-first, 0.0) * (3.0 / 8.0 if kind == "safebench" else 1.0)
        else:
            controls[:, 3] = first <= 0.0
    controls[:, 2] = clipped[:, 1] * 0.3
    return controls
