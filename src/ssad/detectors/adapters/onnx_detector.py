"""Exported 2D detectors, `onnx:FILE`: YOLOv5, YOLOv8, YOLO11 and YOLOX here, RetinaNet and SSD as torchvision's.

The layout of the outputs says what a file is (`LAYOUTS`); the size of the input says where its places lie. Layouts are
facts of the exporters of Ultralytics (YOLOv5 7.0, ultralytics 8.4), YOLOX 0.3 and of torchvision's heads.

Exports of the YOLO family end in a sigmoid. Logits are recovered from the scores: exact to rounding for scores between
1e-37 and 1 - 6e-8, which are logits from -85 to 16. A score beyond that is saturated in float32; its gradient is 0,
which masks it from an attack.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import torch
import torchvision.models.detection as zoo
from torch import Tensor, nn
from torch.nn import functional
from torchvision import models
from torchvision.models.detection._utils import BoxCoder
from torchvision.models.detection.anchor_utils import AnchorGenerator, DefaultBoxGenerator
from torchvision.models.detection.transform import GeneralizedRCNNTransform

from ssad.core.detections import Assignment, Dense, Detections, Truth
from ssad.core.errors import ConfigError, FormatError
from ssad.core.safeio import read_text
from ssad.detectors.adapters.common import Adapter, check_images, check_truth, resized_size
from ssad.detectors.adapters.onnx_network import OnnxNetwork, class_names, read_network
from ssad.detectors.adapters.task_aligned import assign_by_alignment
from ssad.detectors.adapters.torchvision import OneStage
from ssad.detectors.yolo.classes import COCO
from ssad.detectors.yolo.decode import select, to_corners

GREY = 114 / 255
PROBE_SIZE = (128, 192)  # of a network that takes any size: multiples of 64, and no two layouts agree on it
STRIDES = ((8, 16, 32), (8, 16, 32, 64), (4, 8, 16, 32), (16, 32))
SMALLEST_SCORE, LARGEST_SCORE = 1e-37, 1 - 2.0**-24
MIN_SLOPE = 0.1  # of centres over places; boxes in shares of the image have one below 0.01
MAX_DETECTIONS, THRESHOLD = 300, 0.25
ARITHMETIC = frozenset({"Exp", "Mul", "Div"})
IMAGENET = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
GROUP_NORMS = frozenset({"InstanceNormalization", "GroupNormalization"})  # of RetinaNet's second version


@dataclass(frozen=True, slots=True)
class Layout:
    """Layout of the output of an export, and the input that its source feeds.

    Attributes:
        anchors: Places in each cell.
        columns: Numbers of a place before the classes: box, and objectness if there are five.
        transposed: Whether the output is [B, columns, P] instead of [B, P, columns].
        channels: Order of the channels.
        scale: Value of a white pixel.
        centred: Whether an image of another shape lies in the middle of the padding, not at its top left.
        iou: IoU above which the source suppresses the worse of two boxes of a class.
    """

    anchors: int
    columns: int
    transposed: bool
    channels: Literal["rgb", "bgr"]
    scale: float
    centred: bool
    iou: float


LAYOUTS = {
    "yolov8": Layout(1, 4, True, "rgb", 1.0, True, 0.7),
    "yolov5": Layout(3, 5, False, "rgb", 1.0, True, 0.45),
    "yolox": Layout(1, 5, False, "bgr", 255.0, False, 0.65),
}
"""By name. Ultralytics' other anchor-free models (YOLO11, YOLOv5u, ...) are laid out as YOLOv8, YOLOv7 as YOLOv5."""
TORCHVISION = ("retinanet", "ssd")


def onnx_detector(
    file: str | Path,
    *,
    classes: str | Sequence[str] | None = None,
    layout: str | None = None,
    input_width: int | None = None,
    threshold: float | None = None,
    iou: float | None = None,
    channels: Literal["rgb", "bgr"] | None = None,
    scale: float | None = None,
    mean: Sequence[float] | None = None,
    std: Sequence[float] | None = None,
) -> Adapter:
    """Load an exported detector, frozen and in eval mode.

    The network's input is (image * scale - mean) / std.

    Args:
        file: The ONNX file, exported without NMS.
        classes: File with a name a line, or the names; None: the names in the file's metadata, else those of COCO if
            the numbers agree.
        layout: A key of `LAYOUTS`, "retinanet" or "ssd"; None: recognised by the shape of the outputs.
        input_width: Width to which images are resized inside, for a network that takes any size; None: their own.
        threshold: Default of `predict`; None: the source's.
        iou: IoU above which the worse of two boxes of a class is dropped; None: the source's.
        channels: Order of the channels; None: the source's.
        scale: Value of a white pixel; None: the source's.
        mean: Mean of each channel, on the scale of `scale`; None: the source's.
        std: Standard deviation of each channel; None: the source's.

    Raises:
        ConfigError: An option is none that the file takes.
        MissingExtraError: The extra `onnx` is not installed.
        FormatError: The file cannot be read, or holds no detector of these layouts; see `read_network`.
    """
    network = read_network(file)
    if network.metadata.get("task", "detect") != "detect":
        raise FormatError(
            f"{file}: a network of Ultralytics for the task '{network.metadata['task']}', not for detection"
        )
    if layout not in (None, *LAYOUTS, *TORCHVISION):
        raise ConfigError(f"onnx:{file}: no layout '{layout}'; layouts are {', '.join([*LAYOUTS, *TORCHVISION])}")
    if channels not in (None, "rgb", "bgr"):
        raise ConfigError(f"onnx:{file}: channels are rgb or bgr, not '{channels}'")
    for name, value in (("mean", mean), ("std", std)):
        if value is not None and (not isinstance(value, list | tuple) or len(value) != 3):
            raise ConfigError(f"onnx:{file}: {name} is a list of three numbers, such as [0.5,0.5,0.5], not {value}")
    if input_width is not None and None not in network.size:
        raise ConfigError(
            f"onnx:{file}: it takes images of {network.size[1]} x {network.size[0]} pixels alone, no input_width; "
            "images are resized to that inside"
        )
    shown = network.size[0] or PROBE_SIZE[0], network.size[1] or PROBE_SIZE[1]
    outputs = _probe(network, shown)
    names = _read_classes(classes) or class_names(network)
    if layout in TORCHVISION or (layout is None and _is_torchvision(outputs)):
        preprocessing = {"channels": channels, "scale": scale, "mean": mean, "std": std}
        options = {"input_width": input_width, "threshold": threshold, "iou": iou, **preprocessing}
        return _one_stage(network, outputs, names, size=shown, layout=layout, options=options)
    name, strides, output_index = _recognise(network, outputs, shown, layout)
    source = LAYOUTS[name]
    column_count = outputs[output_index].shape[1 if source.transposed else 2] - source.columns
    detector = OnnxYolo(
        network,
        _check_classes(network, names, column_count),
        layout=replace(
            source,
            channels=channels or source.channels,
            scale=source.scale if scale is None else float(scale),
            iou=source.iou if iou is None else float(iou),
        ),
        strides=strides,
        output_index=output_index,
        decoded=bool(network.tails[output_index] & ARITHMETIC),
        name=f"onnx:{Path(file).stem}",
        input_width=input_width,
        threshold=THRESHOLD if threshold is None else threshold,
        mean=mean,
        std=std,
    )
    _check_centres(detector, shown)
    return detector


class OnnxYolo(Adapter):
    """An exported detector of the YOLO family. Starts frozen and in eval mode.

    Dense: quality is the objectness of YOLOv5 and YOLOX, None for the others. maps: output, as the file gives it. An
    export has no training losses.

    Args:
        network: The network.
        classes: Names of the classes.
        layout: Layout of the output.
        strides: Strides of the levels.
        output_index: Index of the output that holds boxes and scores.
        decoded: Whether boxes are in pixels; else, as YOLOX gives them, relative to cells and strides.
        name: Name in tables.
        input_width: Width to which images are resized inside.
        threshold: Default of `predict`.
        mean: Mean of each channel.
        std: Standard deviation of each channel.
    """

    has_training_losses = False

    def __init__(
        self,
        network: OnnxNetwork,
        classes: Sequence[str],
        *,
        layout: Layout,
        strides: Sequence[int],
        output_index: int,
        decoded: bool,
        name: str,
        input_width: int | None = None,
        threshold: float = THRESHOLD,
        mean: Sequence[float] | None = None,
        std: Sequence[float] | None = None,
    ) -> None:
        super().__init__(name, classes, threshold)
        self.network, self.layout, self.strides = network, layout, tuple(strides)
        self.output_index, self.decoded, self.input_width = output_index, decoded, input_width
        normalisation = torch.tensor([list(mean or (0.0,) * 3), list(std or (1.0,) * 3)])[..., None, None]
        self.register_buffer("normalisation", normalisation, persistent=False)
        self.register_buffer("template", torch.zeros(()), persistent=False)
        self.requires_grad_(False).eval()

    normalisation: Tensor
    template: Tensor

    def dense(self, images: Tensor, intrinsic: Tensor | None = None) -> Dense:
        """Raw outputs, differentiable with respect to the images [B, 3, H, W] in [0, 1].

        Raises:
            ConfigError: The images have another shape or type.
        """
        size = check_images(self.name, images, min_count=1)
        network_input, scale, offset = self._fit(images.to(self.template.dtype), size)
        output = self.network(network_input)[self.output_index]
        rows = output.transpose(1, 2) if self.layout.transposed else output
        place, stride, level = self._places((network_input.shape[2], network_input.shape[3]))
        middle, extent = rows[..., :2], rows[..., 2:4]
        if not self.decoded:
            middle = (middle + place / stride[:, None] - 0.5) * stride[:, None]
            extent = extent.exp() * stride[:, None]
        logit = to_logit(rows[..., 4:])
        has_quality = self.layout.columns == 5
        return Dense(
            logit=logit[..., 1:] if has_quality else logit,
            quality=logit[..., 0] if has_quality else None,
            box=(to_corners(middle, extent) - offset.repeat(2)) / scale.repeat(2),
            place=(place - offset) / scale,
            stride=stride / scale[0],
            level=level,
            maps={"output": [output]},
            size=size,
        )

    def choose(self, dense: Dense, min_score: float) -> list[Detections]:
        """Return the detections by score, class times objectness, suppressed within a class."""
        score = dense.logit.sigmoid()
        if dense.quality is not None:
            score = score * dense.quality.sigmoid()[..., None]
        return select(score, dense.box, threshold=min_score, iou=self.layout.iou, limit=MAX_DETECTIONS, size=dense.size)

    @torch.no_grad()
    def assign(self, dense: Dense, truth: Sequence[Truth]) -> Assignment:
        """Assign objects to places by task alignment (TOOD), whatever the source does: an export does not say.

        Of the places inside an object, the ten with the largest score^0.5 * CIoU^6 are assigned to it.
        """
        targets = check_truth(
            self.name, truth, len(dense.box), scale=torch.ones_like(dense.box[0, 0]), classes=len(self.classes)
        )
        score = dense.logit.sigmoid()
        if dense.quality is not None:
            score = score * dense.quality.sigmoid()[..., None]
        label, owner, _, _ = assign_by_alignment(score, dense.box, dense.place, targets, inside_first=True)
        return Assignment(label, owner, tuple(truth))

    def losses(
        self, dense: Dense, assignment: Assignment, *, reduction: Literal["batch", "image"] = "batch"
    ) -> dict[str, Tensor]:
        """Raise ConfigError: an export of the YOLO family lacks what its training losses are made of."""
        raise ConfigError(
            f"{self.name}: an ONNX export of the YOLO family has no training loss; attack it with the loss margin, "
            "vanish, hide, hide-any, fabricate or mislabel"
        )

    def _fit(self, images: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
        """Return the network's input, and scale [2] and offset [2] (x, y) of the image in it."""
        height, width = self.network.size
        if height is None or width is None:
            inner = resized_size(size, self.input_width)
            multiple = max(32, *self.strides)
            height = height or inner[0] + -inner[0] % multiple
            width = width or inner[1] + -inner[1] % multiple
            inner = min(inner[0], height), min(inner[1], width)
            top, left = 0, 0
        else:
            ratio = min(height / size[0], width / size[1])
            inner = max(1, round(size[0] * ratio)), max(1, round(size[1] * ratio))
            top, left = ((height - inner[0]) // 2, (width - inner[1]) // 2) if self.layout.centred else (0, 0)
        if inner != size:
            images = functional.interpolate(images, inner, mode="bilinear", align_corners=False)
        padding = (left, width - inner[1] - left, top, height - inner[0] - top)
        images = functional.pad(images, padding, value=GREY)
        if self.layout.channels == "bgr":
            images = images.flip(1)
        mean, std = self.normalisation
        scale = self.template.new_tensor([inner[1] / size[1], inner[0] / size[0]])
        return (images * self.layout.scale - mean) / std, scale, self.template.new_tensor([left, top])

    def _places(self, size: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
        """Return centre [P, 2], stride [P] and level [P] of the places, in the network's input of height and width."""
        places, strides = [], []
        for stride in self.strides:
            rows, columns = size[0] // stride, size[1] // stride
            y, x = (
                (torch.arange(count, device=self.template.device, dtype=self.template.dtype) + 0.5) * stride
                for count in (rows, columns)
            )
            centre = torch.stack((x.expand(rows, columns), y[:, None].expand(rows, columns)), -1).reshape(-1, 2)
            places.append(centre.repeat(self.layout.anchors, 1))
            strides.append(centre.new_full((len(places[-1]),), stride))
        counts = torch.tensor([len(centre) for centre in places], device=self.template.device)
        level = torch.arange(len(places), device=counts.device).repeat_interleave(counts)
        return torch.cat(places), torch.cat(strides), level


def to_logit(score: Tensor) -> Tensor:
    """Return the logits of scores; those that float32 rounds to 0 or 1 become finite, without gradient."""
    inner_score = score.clamp(SMALLEST_SCORE, LARGEST_SCORE)
    return inner_score.log() - torch.log1p(-inner_score)


# ---------------------------------------------------------------- what a file is


def _probe(network: OnnxNetwork, size: tuple[int, int]) -> list[Tensor]:
    """Return the outputs for a grey image.

    Raises:
        FormatError: The network does not run on an image of this size.
    """
    with torch.no_grad():
        try:
            outputs: list[Tensor] = network(torch.full((1, 3, *size), 0.5))
        except Exception as error:  # what operators raise for shapes that do not fit
            reason = " ".join(str(error).split())[:150] or type(error).__name__
            raise FormatError(
                f"{network.path}: it does not run on images of {size[1]} x {size[0]} pixels: {reason}"
            ) from None
    return outputs


def _recognise(
    network: OnnxNetwork, outputs: list[Tensor], size: tuple[int, int], layout: str | None
) -> tuple[str, tuple[int, ...], int]:
    """Return the layout, the strides, and the index of the output that holds boxes and scores.

    Raises:
        FormatError: No output has such a layout.
    """
    for (index, output), name, strides in product(enumerate(outputs), LAYOUTS, STRIDES):
        expected = LAYOUTS[name]
        if output.ndim != 3 or layout not in (None, name) or any(length % strides[-1] for length in size):
            continue
        places, columns = output.shape[1:] if not expected.transposed else output.shape[:0:-1]
        cells = sum((size[0] // stride) * (size[1] // stride) for stride in strides)
        if places == expected.anchors * cells and columns > expected.columns:
            if "Sigmoid" not in network.tails[index]:
                raise FormatError(
                    f"{network.path}: its scores do not come from a sigmoid; export the network in eval mode, with its "
                    "detection head"
                )
            return name, strides, index
    shapes = ", ".join(str(list(output.shape)) for output in outputs)
    raise FormatError(
        f"{network.path}: outputs {shapes} for images of {size[1]} x {size[0]} pixels are those of none of "
        f"{', '.join([layout] if layout else [*LAYOUTS, *TORCHVISION])}; wrap the network in a class "
        "(docs/how-to/use-detectors.md)"
    )


def _check_centres(detector: OnnxYolo, size: tuple[int, int]) -> None:
    """Check on a random image that boxes follow the places.

    Raises:
        FormatError: They do not: they are in shares of the image, or places are in another order.
    """
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        dense = detector.dense(torch.rand((1, 3, *size), generator=generator))
    finest = dense.level == 0
    centre, place = (dense.box[0, finest, :2] + dense.box[0, finest, 2:]) / 2, dense.place[finest]
    deviation = place - place.mean(0)
    slope = (((centre - centre.mean(0)) * deviation).mean(0) / deviation.square().mean(0)).min()
    if not bool(slope > MIN_SLOPE):  # NaN too
        raise FormatError(
            f"{detector.network.path}: its boxes are not centres and sizes in pixels of its input, cell by cell; "
            "another layout? (layout=)"
        )


def _read_classes(classes: str | Sequence[str] | None) -> tuple[str, ...] | None:
    if classes is None or not isinstance(classes, str | Path):
        return None if classes is None else tuple(classes)
    path = Path(classes).expanduser()
    names = tuple(line.strip() for line in read_text(path, limit=1 << 20).splitlines() if line.strip())
    if not names:
        raise FormatError(f"{path}: no names of classes; write one a line")
    return names


def _check_classes(network: OnnxNetwork, names: Sequence[str] | None, count: int) -> tuple[str, ...]:
    """Return the names of `count` classes.

    Raises:
        ConfigError: There are none, or of another number, or two alike.
    """
    if names is None:
        names = COCO if count == len(COCO) else None
    if names is None or len(names) != count:
        stated = "no names" if names is None else f"{len(names)} names"
        raise ConfigError(
            f"{network.path}: {count} classes and {stated}; name them in order, one a line: ?classes=names.txt"
        )
    if len(set(names)) != count or not all(isinstance(name, str) for name in names):
        raise ConfigError(f"{network.path}: the names of classes must be distinct texts")
    return tuple(names)


# ---------------------------------------------------------------- torchvision's heads


class OnnxOneStage(OneStage):
    """RetinaNet or SSD of torchvision whose backbone and head are an exported network.

    Anchors, decoding, selection and losses are torchvision's, of its published settings. An export gives no maps, so
    `Dense.features` is empty.

    Args:
        network: The network, with the outputs cls_logits [B, P, K] and bbox_regression [B, P, 4].
        model: RetinaNet or SSD of torchvision around it.
        classes: Names of the classes.
        columns: Columns of the head that belong to the classes.
        regression_index: Index of the output bbox_regression.
        name: Name in tables.
        channels: Order of the channels.
        threshold: Default of `predict`; None: torchvision's.
    """

    def __init__(
        self,
        network: OnnxNetwork,
        model: nn.Module,
        classes: Sequence[str],
        columns: Sequence[int],
        *,
        regression_index: int,
        name: str,
        channels: Literal["rgb", "bgr"],
        threshold: float | None,
    ) -> None:
        super().__init__(model, classes, columns, name=name, threshold=threshold)
        self.network, self.regression_index, self.channels = network, regression_index, channels
        self.register_buffer("template", torch.zeros(()), persistent=False)

    template: Tensor

    def dense(self, images: Tensor, intrinsic: Tensor | None = None) -> Dense:
        """Raw outputs for images [B, 3, H, W] in [0, 1], differentiable with respect to them."""
        return replace(super().dense(images, intrinsic), features=())

    def _dtype(self) -> torch.dtype:
        return self.template.dtype

    def _outputs(self, tensors: Tensor) -> tuple[list[Tensor], dict[str, Tensor]]:
        outputs = self.network(tensors.flip(1) if self.channels == "bgr" else tensors)
        grids = _grids(self.kind, (tensors.shape[2], tensors.shape[3]))
        heads = {"cls_logits": outputs[1 - self.regression_index], "bbox_regression": outputs[self.regression_index]}
        # torchvision's anchors need nothing of a map but its size.
        return [tensors.new_empty((len(tensors), 0, *grid)) for grid in grids], heads


SSD_GRIDS = {300: (38, 19, 10, 5, 3, 1), 320: (20, 10, 5, 3, 2, 1)}
"""Maps of ssd300_vgg16 and ssdlite320_mobilenet_v3_large, by the side of the input."""


def _grids(kind: str, size: tuple[int, int]) -> list[tuple[int, int]]:
    """Return rows and columns of the maps: RetinaNet's have strides 8 to 128, rounded up."""
    if kind == "ssd":
        return [(side, side) for side in SSD_GRIDS.get(size[0], ())]
    return [(-(-size[0] // stride), -(-size[1] // stride)) for stride in (8, 16, 32, 64, 128)]


def _is_torchvision(outputs: list[Tensor]) -> bool:
    """Return whether there are two outputs [B, P, K] and [B, P, 4]."""
    shapes = [output.shape for output in outputs]
    return (
        len(shapes) == 2
        and all(len(shape) == 3 for shape in shapes)
        and shapes[0][:2] == shapes[1][:2]
        and 4 in (shapes[0][2], shapes[1][2])
    )


def _one_stage(
    network: OnnxNetwork,
    outputs: list[Tensor],
    names: Sequence[str] | None,
    *,
    size: tuple[int, int],
    layout: str | None,
    options: dict[str, Any],
) -> OnnxOneStage:
    """Build torchvision's detector around exported heads.

    Raises:
        FormatError: The heads are of another model, or already decoded.
        ConfigError: The classes do not fit.
    """
    shapes = ", ".join(str(list(output.shape)) for output in outputs)
    if not _is_torchvision(outputs):
        raise FormatError(f"{network.path}: outputs {shapes}; a {layout} has cls_logits [B, P, K] and bbox_regression")
    regression_index = _regression_index(network, outputs)
    if any("Sigmoid" in tail or "Softmax" in tail for tail in network.tails):
        raise FormatError(
            f"{network.path}: its scores are not those of torchvision's head, a sigmoid or softmax follows; export "
            "cls_logits and bbox_regression (docs/how-to/use-detectors.md)"
        )
    places, columns = outputs[1 - regression_index].shape[1:]
    anchors_per_cell = {
        "ssd": (4, 6, 6, 6, 4, 4) if size[0] == 300 else (6,) * 6,
        "retinanet": (9,) * 5,
    }
    counts = {
        kind: sum(
            rows * columns * anchors for (rows, columns), anchors in zip(_grids(kind, size), per_cell, strict=False)
        )
        for kind, per_cell in anchors_per_cell.items()
        if kind == "retinanet" or size in ((300, 300), (320, 320))
    }
    kind = next((kind for kind, count in counts.items() if count == places and layout in (None, kind)), None)
    if kind is None:
        raise FormatError(
            f"{network.path}: {places} places for images of {size[1]} x {size[0]} pixels; torchvision's SSD (300 or "
            f"320 pixels) and RetinaNet have {' or '.join(str(count) for count in counts.values())}"
        )
    classes, class_columns = _columns(network, kind, names, columns)
    is_ssd = kind == "ssd"
    model = _ssd(columns, size[0]) if is_ssd else _retinanet(network, columns, options["input_width"])
    transform: Any = model.transform
    scale = 1.0 if options["scale"] is None else float(options["scale"])
    if network.normalises:
        transform.image_mean, transform.image_std = [0.0] * 3, [1.0] * 3
    mean = transform.image_mean if options["mean"] is None else [value / scale for value in options["mean"]]
    std = [value / scale for value in (transform.image_std if options["std"] is None else options["std"])]
    transform.image_mean, transform.image_std = mean, std
    if options["iou"] is not None:
        model.nms_thresh = float(options["iou"])
    return OnnxOneStage(
        network,
        model,
        classes,
        class_columns,
        regression_index=regression_index,
        name=f"onnx:{network.path.stem}",
        channels=options["channels"] or "rgb",
        threshold=options["threshold"],
    )


def _regression_index(network: OnnxNetwork, outputs: list[Tensor]) -> int:
    """Return the index of the boxes: the output of four columns, of two such the one that its name says."""
    candidates = [index for index, output in enumerate(outputs) if output.shape[2] == 4]
    if len(candidates) == 1:
        return candidates[0]
    named = [index for index, name in enumerate(network.output_names) if "box" in name or "reg" in name]
    return named[0] if len(named) == 1 else 1


def _columns(
    network: OnnxNetwork, kind: str, names: Sequence[str] | None, count: int
) -> tuple[tuple[str, ...], list[int]]:
    """Return the classes and their columns: behind the background, or all of a RetinaNet's."""
    if names is None and count == 91:
        weights = models.get_model_weights("retinanet_resnet50_fpn").DEFAULT
        categories = list(weights.meta["categories"])
        columns = [index for index, name in enumerate(categories) if name not in ("__background__", "N/A")]
        return tuple(categories[index] for index in columns), columns
    has_background = kind == "ssd" or names is None or len(names) != count
    classes = _check_classes(network, names, count - has_background)
    return classes, list(range(int(has_background), count))


class _Heads(nn.Module):
    """Settings of RetinaNet's head that decoding and losses read."""

    def __init__(self, loss_type: str) -> None:
        super().__init__()
        self.regression_head = SimpleNamespace(box_coder=BoxCoder((1.0, 1.0, 1.0, 1.0)), _loss_type=loss_type)


class _Trunk(nn.Module):
    """Stand-in of a backbone, which torchvision's constructors ask for."""

    out_channels = 0


def _retinanet(network: OnnxNetwork, columns: int, input_width: int | None) -> Any:
    """Return torchvision's RetinaNet without network; anchors of 32 to 512 pixels, three sizes and three shapes."""
    sizes = tuple((side, int(side * 2 ** (1 / 3)), int(side * 2 ** (2 / 3))) for side in (32, 64, 128, 256, 512))
    model = zoo.RetinaNet(
        _Trunk(),
        columns,
        anchor_generator=AnchorGenerator(sizes, ((0.5, 1.0, 2.0),) * 5),
        head=_Heads("giou" if network.operators & GROUP_NORMS else "l1"),
    )
    height, width = network.size
    if height is not None and width is not None:
        model.transform = GeneralizedRCNNTransform(800, 1333, *map(list, IMAGENET), fixed_size=(width, height))
        model.transform.size_divisible = 1
    elif input_width is not None:
        # The shorter side decides in torchvision; here the width, as for all detectors.
        model.transform = GeneralizedRCNNTransform(1 << 16, input_width, *map(list, IMAGENET))
    return model


def _ssd(columns: int, side: int) -> Any:
    """Return torchvision's SSD300 or SSDlite320 without network."""
    if side == 300:
        ratios = [[2], [2, 3], [2, 3], [2, 3], [2], [2]]
        scales = [0.07, 0.15, 0.33, 0.51, 0.69, 0.87, 1.05]
        generator = DefaultBoxGenerator(ratios, scales=scales, steps=[8, 16, 32, 64, 100, 300])
        settings: dict[str, Any] = {"image_mean": [0.48235, 0.45882, 0.40784], "image_std": [1 / 255] * 3}
    else:
        generator = DefaultBoxGenerator([[2, 3]] * 6, min_ratio=0.2, max_ratio=0.95)
        settings = {"image_mean": [0.5] * 3, "image_std": [0.5] * 3, "score_thresh": 0.001, "nms_thresh": 0.55}
        settings |= {"detections_per_img": 300, "topk_candidates": 300}
    return zoo.ssd.SSD(_Trunk(), generator, (side, side), columns, head=_Heads("l1"), **settings)
