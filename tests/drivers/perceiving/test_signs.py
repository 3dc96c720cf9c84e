"""Stop signs that are read: where they stand, and for how long they are remembered."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ssad.core.detections import Detections
from ssad.core.errors import ConfigError
from ssad.core.rotations import upright_pose
from ssad.drivers.perceiving.signs import FACE, SignMemory, SignReading, read_signs
from ssad.experiments.gap.perceiving_loop import PerceivingSystem
from ssad.rendering.camera.rig import rig_camera

CLASSES = ("car", "stop_sign")
EGO = (120.0, -35.0, 2.1)


def box(x: float, y: float, z: float, camera) -> list[float]:
    """The face of a sign x ahead, y to the left and z above the road, as the camera on the ego sees it."""
    middle = np.linalg.inv(camera.to_ego) @ np.array([x, y, z, 1.0])
    u, v = (camera.intrinsic @ middle[:3])[:2] / middle[2]
    half = 0.5 * FACE * camera.intrinsic[1, 1] / middle[2]
    return [u - half, v - half, u + half, v + half]


def test_a_sign_stands_where_its_height_says() -> None:
    camera = rig_camera("CAM_FRONT", 640)
    boxes = torch.tensor([box(20.0, -4.0, 2.1, camera), box(10.0, 2.0, 2.1, camera), box(15.0, -4.0, 2.1, camera)])
    found = Detections(torch.tensor([0.9, 0.9, 0.2]), torch.tensor([1, 0, 1]), boxes)
    pose = upright_pose(*EGO)
    places = read_signs(found, camera, pose @ camera.to_ego, CLASSES, score=0.3)
    np.testing.assert_allclose(places, [(pose @ [20.0, -4.0, 0.0, 1.0])[:2]], atol=1e-3)  # no car, none that is unsure
    with pytest.raises(ConfigError, match="stop_sign"):
        read_signs(found, camera, pose, ("car", "person"), score=0.3)


@pytest.mark.parametrize(("memory", "later"), [(float("inf"), 1), (1.0, 0)])
def test_a_sign_is_believed_when_confirmed_and_as_long_as_it_is_remembered(memory: float, later: int) -> None:
    signs = SignMemory(SignReading(confirm=2, memory=memory))
    signs.reset(2)
    scenes, pose = np.arange(2, dtype=np.int32), np.zeros((2, 3), np.float32)

    def known(time: float) -> list[int]:
        return signs.is_sign_ahead(scenes, np.full(2, time), pose).tolist()

    signs.update(1, 0.0, np.zeros(2), np.array([[20.0, -4.0]]))
    assert known(0.0) == [0, 0]
    signs.update(1, 0.2, np.zeros(2), np.array([[18.5, -3.8]]))  # the same, measured again
    assert known(0.2) == [0, 1]
    saved = signs.snapshot()
    assert known(1.1) == [0, 1]
    assert known(3.0) == [0, later]
    pose[:, 0] = 25.0  # it is behind
    assert known(0.3) == [0, 0]
    pose[:, 0] = 0.0
    signs.update(1, 0.4, np.zeros(2), np.array([[60.0, 10.0], [18.4, -3.8]]))
    signs.restore(saved)
    assert known(0.3) == [0, 1]


def test_settings_that_cannot_be() -> None:
    for wrong in ({"confirm": 0}, {"memory": -1.0}, {"score": 2.0}, {"memory": float("nan")}):
        with pytest.raises(ConfigError, match="reading signs"):
            SignReading(**wrong)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"detector": "truth", "reads_signs": True}, "system a, detector truth: signs are read by a detector with"),
        ({"detector": "yolov5n", "sign_memory": 1.0}, "system a: sign_memory can only be used with reads_signs: true"),
        ({"detector": "pgd-det-light", "high": 0.1, "low": 0.2}, "system a: low 0.2 is above high 0.1"),
    ],
)
def test_a_suite_says_before_it_drives_what_does_not_fit(settings: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        PerceivingSystem(name="a", **settings).check()
