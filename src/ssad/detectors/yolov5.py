"""YOLOv5 6.0 n and s (published layer table and multiples): presets, builders, and the names of other people's weights.

Weights come as a state dict of tensors, e.g. from a converted safetensors file; `.pt` files of the source are pickles
of its own classes and are not read.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ssad.core.errors import FormatError
from ssad.detectors.yolo.classes import COCO
from ssad.detectors.yolo.detector import Yolo
from ssad.detectors.yolo.models import YoloSpec

YOLOV5N = YoloSpec(
    name="yolov5n",
    rule="v5",
    network="csp",
    anchors=(((10, 13), (16, 30), (33, 23)), ((30, 61), (62, 45), (59, 119)), ((116, 90), (156, 198), (373, 326))),
    width=0.25,
    depth=0.33,
)
YOLOV5S = replace(YOLOV5N, name="yolov5s", width=0.5)

# the layers of the published table that have weights
LAYERS = {
    0: "stem",
    1: "down2",
    2: "stage2",
    3: "down3",
    4: "stage3",
    5: "down4",
    6: "stage4",
    7: "down5",
    8: "stage5",
    9: "pool",
    10: "lateral5",
    13: "top4",
    14: "lateral4",
    17: "neck3",
    18: "up4",
    20: "neck4",
    21: "up5",
    23: "neck5",
}
HEADS = 24
_PARTS = {"cv1": "through", "cv2": "past", "cv3": "merge"}
_POOL_PARTS = {"cv1": "reduce", "cv2": "merge"}
_BLOCK_PARTS = {"cv1": "reduce", "cv2": "expand"}


def yolov5n(classes: Sequence[str] = COCO, *, input_width: int | None = None, seed: int = 0) -> Yolo:
    """Build YOLOv5n with fresh weights."""
    return Yolo(YOLOV5N, classes, input_width=input_width, seed=seed)


def yolov5s(classes: Sequence[str] = COCO, *, input_width: int | None = None, seed: int = 0) -> Yolo:
    """Build YOLOv5s with fresh weights."""
    return Yolo(YOLOV5S, classes, input_width=input_width, seed=seed)


def from_yolov5_keys(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Convert a state dict with YOLOv5's names to one of `Yolo`, in float32.

    The names are such as model.0.conv.weight, model.2.cv1.conv.weight and model.24.m.0.weight, also with `model.model.`
    before the number. The anchors are converted to pixels. Shapes and missing names are left to `load_state_dict` to
    check.

    Args:
        state: Tensors by name, of YOLOv5 6.0 n or s.

    Returns:
        Tensors by the names of `Yolo`.

    Raises:
        FormatError: A name does not belong to YOLOv5 6.0 n or s.
    """
    converted: dict[str, Tensor] = {}
    for key, value in state.items():
        match = re.fullmatch(r"(?:model\.){1,2}(\d+)\.(.+)", key)
        name = _rename(int(match[1]), match[2]) if match else None
        if name is None:
            raise FormatError(f"weights: '{key}' is no name of YOLOv5 6.0 n or s; convert a model of that version")
        tensor = value.float() if value.is_floating_point() else value
        if name == "anchors":
            if tensor.shape != (3, 3, 2):
                raise FormatError(f"weights: '{key}' has the shape {list(tensor.shape)}; it takes [3, 3, 2]")
            # The source stores anchors in strides of their level.
            tensor = tensor * torch.tensor(YOLOV5N.strides, dtype=tensor.dtype, device=tensor.device)[:, None, None]
        if name:
            converted[name] = tensor
    return converted


def _rename(layer: int, suffix: str) -> str | None:
    """Return the name of a tensor in `Yolo`; "" if it is not needed, None if it is unknown."""
    if layer == HEADS:
        if suffix == "anchors":
            return "anchors"
        if suffix in {"anchor_grid", "stride"}:
            return ""
        head = re.fullmatch(r"m\.([012])\.(weight|bias)", suffix)
        return f"network.heads.{head[1]}.{head[2]}" if head else None
    if layer not in LAYERS:
        return None
    layer_name = LAYERS[layer]
    match = re.fullmatch(r"(?:m\.(\d+)\.)?(?:(cv[123])\.)?(conv\.weight|bn\.\w+)", suffix)
    if match is None:
        return None
    block, part, tensor = match[1], match[2], match[3].replace("bn.", "norm.")
    # Plain convolutions have no parts; pooling and C3 blocks number theirs differently.
    part_names = (
        {}
        if layer_name.startswith(("stem", "down", "up", "lateral"))
        else _POOL_PARTS
        if layer_name == "pool"
        else _PARTS
    )
    if block is not None:
        if part_names is not _PARTS or part not in _BLOCK_PARTS:
            return None
        return f"network.{layer_name}.blocks.{block}.{_BLOCK_PARTS[part]}.{tensor}"
    if part is None:
        return None if part_names else f"network.{layer_name}.{tensor}"
    return f"network.{layer_name}.{part_names[part]}.{tensor}" if part in part_names else None
