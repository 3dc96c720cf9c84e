"""torchvision's detection models by name, with fresh weights or those of a file; nothing is downloaded."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from inspect import signature
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torchvision import models
from torchvision.models import detection
from torchvision.models.detection.transform import GeneralizedRCNNTransform

from ssad.core.checkpoints import COUNTER, copy_state, load_weights
from ssad.core.errors import ConfigError, unknown_name
from ssad.detectors.adapters.torchvision import OneStage
from ssad.detectors.adapters.two_stage import TwoStage

MODELS = (
    "fasterrcnn_mobilenet_v3_large_320_fpn",
    "fasterrcnn_mobilenet_v3_large_fpn",
    "fasterrcnn_resnet50_fpn",
    "fasterrcnn_resnet50_fpn_v2",
    "fcos_resnet50_fpn",
    "retinanet_resnet50_fpn",
    "retinanet_resnet50_fpn_v2",
    "ssd300_vgg16",
    "ssdlite320_mobilenet_v3_large",
)
# Their published weights were trained with batch norms whose epsilon is 0.
NO_EPS = ("fasterrcnn_resnet50_fpn", "retinanet_resnet50_fpn")


def torchvision_detector(
    model: str,
    *,
    classes: Sequence[str] | None = None,
    weights: str | Path | None = None,
    threshold: float | None = None,
    seed: int = 0,
    **options: Any,
) -> OneStage | TwoStage:
    """Build a detection model of torchvision (`MODELS`), frozen and in eval mode.

    Args:
        model: Name of the model.
        classes: Classes of the weights, without background; None for the 80 of COCO in torchvision's 91 columns.
        weights: A file as for `load_weights`, such as torchvision's own .pth files; None for fresh weights.
        threshold: Default of `predict`; None for the model's.
        seed: Seed of fresh weights.
        **options: Options of torchvision's builder, such as min_size and max_size, the size inside.

    Raises:
        UnknownNameError: There is no such model.
        ConfigError: The builder refuses an option.
        FormatError: The weights cannot be read, or do not fit.
    """
    if model not in MODELS:
        raise unknown_name("torchvision detector", model, MODELS)
    if classes is None:
        category_names = list(models.get_model_weights(model).DEFAULT.meta["categories"])
        columns = [index for index, name in enumerate(category_names) if name not in ("__background__", "N/A")]
        count = len(category_names)
        classes = [category_names[index] for index in columns]
    else:
        if not classes or len(set(classes)) != len(classes) or isinstance(classes, str):
            raise ConfigError(f"{model}: classes must be distinct names, at least one")
        columns, count = list(range(1, len(classes) + 1)), len(classes) + 1
    _check_options(model, options)
    # Fresh weights depend on the seed alone, and the global generator stays unchanged.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        try:
            network = getattr(detection, model)(weights=None, weights_backbone=None, num_classes=count, **options)
        except (TypeError, ValueError) as error:
            raise ConfigError(f"torchvision:{model}: {' '.join(str(error).split())}") from None
    detector = wrap(network, classes, columns, name=f"torchvision:{model}", threshold=threshold)
    if weights is not None:
        fit_torchvision(detector, load_weights(weights), weights)
    return detector


def _check_options(model: str, options: Iterable[str]) -> None:
    """Raise ConfigError for an option that torchvision's builder would silently ignore."""
    model_classes = {"fasterrcnn": detection.FasterRCNN, "fcos": detection.FCOS, "retinanet": detection.RetinaNet}
    model_class = model_classes.get(model.split("_", maxsplit=1)[0], detection.ssd.SSD)
    option_names = {
        parameter_name
        for builder in (getattr(detection, model), model_class, GeneralizedRCNNTransform)
        for parameter_name in signature(builder).parameters
    }
    for key in options:
        if key not in option_names:
            close = difflib.get_close_matches(key, sorted(option_names), n=3, cutoff=0.3)
            hint = f"; closest: {', '.join(close)}" if close else ""
            raise ConfigError(f"torchvision:{model}: no option '{key}'{hint}")


def fit_torchvision(detector: OneStage | TwoStage, state: dict[str, Any], origin: str | Path) -> None:
    """Copy weights with torchvision's own names into the detector.

    Args:
        detector: The detector.
        state: Tensors by name.
        origin: Origin of the weights, for messages.

    Raises:
        FormatError: The weights do not fit.
    """
    has_frozen_norms = not any(key.endswith(COUNTER) for key in state)
    if has_frozen_norms and detector.name.removeprefix("torchvision:") in NO_EPS:
        for submodule in detector.model.modules():
            if isinstance(submodule, nn.BatchNorm2d):
                submodule.eps = 0.0
    if not any(key.startswith("model.") for key in state):
        state = {f"model.{key}": value for key, value in state.items()}
    copy_state(detector, state, origin)


def wrap(
    model: nn.Module,
    classes: Sequence[str],
    columns: Sequence[int] | None = None,
    *,
    name: str = "torchvision",
    threshold: float | None = None,
) -> OneStage | TwoStage:
    """Wrap a user-built FCOS, RetinaNet, SSD or FasterRCNN of torchvision as a detector.

    Args:
        model: The model.
        classes: Names of the classes, without background.
        columns: Columns of the head that belong to the classes; None for 1, 2, ...
        name: Name in tables.
        threshold: Default of `predict`; None for the model's.

    Raises:
        ConfigError: The model is of another class.
    """
    columns = list(range(1, len(classes) + 1)) if columns is None else list(columns)
    if isinstance(model, detection.FasterRCNN):
        return TwoStage(model, classes, columns, name=name, threshold=threshold)
    return OneStage(model, classes, columns, name=name, threshold=threshold)
