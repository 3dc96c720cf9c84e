"""mmdetection3d's FCOS3D and PGD-Det from official weights, with mmdetection3d's outputs, for conformance tests.

    detector = load("fcos3d", state_dict)
    maps, boxes = infer(detector, image, cam2img)

Names, shapes, order and numbers are those of mmdetection3d 1.4 (nuScenes configurations).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ssad.core.boxes import bottom_centre
from ssad.core.checkpoints import copy_state, load_weights
from ssad.core.errors import ConfigError
from ssad.core.types import U8
from ssad.detectors.fcos3d import fcos3d
from ssad.detectors.mono3d.detector import Mono3D
from ssad.detectors.pgd_det import pgd_det

_BUILDERS = {"fcos3d": fcos3d, "pgd": pgd_det, "pgd-det": pgd_det}
_NAMES = ("cls_scores", "bbox_preds", "dir_cls_preds", "depth_cls_preds", "attr_preds", "centernesses")


def load(name: str, state_dict: Mapping[str, Any] | str | Path) -> Mono3D:
    """Return the full-size detector "fcos3d" or "pgd" with official weights, frozen, on the CPU.

    Args:
        name: "fcos3d" or "pgd".
        state_dict: Tensors (or arrays) by mmdetection3d's names (backbone., neck., bbox_head.), also inside
            {"state_dict": ...}; or a file that `ssad.core.checkpoints.load_weights` reads. Names and shapes must
            match one to one.

    Raises:
        ConfigError: There is no such detector.
        FormatError: The weights cannot be read, or do not fit.
    """
    if name not in _BUILDERS:
        raise ConfigError(f"load: '{name}' is no detector with official weights; choose fcos3d or pgd")
    detector = _BUILDERS[name]()
    if isinstance(state_dict, str | Path):
        copy_state(detector, load_weights(state_dict), state_dict)
        return detector
    tensors = state_dict.get("state_dict", state_dict)
    copy_state(detector, {key: torch.as_tensor(value) for key, value in tensors.items()}, "state_dict")
    return detector


@torch.no_grad()
def infer(
    detector: Mono3D, image: U8, cam2img: npt.ArrayLike | Tensor
) -> tuple[dict[str, list[Tensor]], dict[str, Tensor]]:
    """Head maps and boxes of one image as mmdetection3d gives them in eval mode; on the detector's device.

    Args:
        detector: A detector from `load`.
        image: [H, W, 3] uint8, BGR, any H and W (padded to multiples of 32 here).
        cam2img: [4, 4] or [3, 3].

    Returns:
        Maps: cls_scores, bbox_preds, dir_cls_preds, (depth_cls_preds,) attr_preds, centernesses, each one tensor
        [1, C, h, w] for each level. Boxes: bboxes_3d [N, 9] as CameraInstance3DBoxes stores them (x, y, z of the middle
        of the bottom, length, height, width, yaw, velocity x, z), scores_3d, labels_3d, attr_labels [N], in its order,
        after its thresholds and suppression.

    Raises:
        ConfigError: Another shape or type.
    """
    image = np.asarray(image)
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        raise ConfigError(f"infer: image must be [H, W, 3] of uint8 (BGR); got {list(image.shape)} of {image.dtype}")
    intrinsic = torch.as_tensor(cam2img).double().cpu()
    if intrinsic.shape not in {(3, 3), (4, 4)}:
        raise ConfigError(f"infer: cam2img must be [4, 4] or [3, 3]; got {list(intrinsic.shape)}")
    parameter = next(detector.parameters())
    rgb = torch.from_numpy(np.ascontiguousarray(image[..., ::-1])).to(parameter.device)
    images = rgb.permute(2, 0, 1)[None].to(parameter.dtype) / 255  # times 255 gives back the same numbers
    dense = detector.dense(images, intrinsic[None, :3, :3].to(parameter))
    detections = detector.select(dense, detector.config.threshold)[0]
    solid = detections.solid
    assert solid is not None
    centre = solid.centre
    if intrinsic.shape == (4, 4):  # a shift in the last column moves all boxes by the same amount
        centre = centre - torch.linalg.solve(intrinsic[:3, :3], intrinsic[:3, 3]).to(centre)
    bottom = bottom_centre(centre, solid.size_lhw)
    boxes = {
        "bboxes_3d": torch.cat([bottom, solid.size_lhw, solid.yaw[:, None], solid.velocity], 1),
        "scores_3d": detections.score,
        "labels_3d": detections.label,
        "attr_labels": solid.attribute,
    }
    return {name: dense.maps[name] for name in _NAMES if name in dense.maps}, boxes
