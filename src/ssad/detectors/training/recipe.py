"""How a detector is trained: everything that decides the result but the data."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Literal

from ssad.errors import ConfigError, unknown_name


@dataclass(frozen=True, slots=True)
class Recipe:
    """A training run. Learning rates are for one step on `batch` images over all devices.

    optimizer, lr, momentum (of SGD, or beta 1 of AdamW), weight_decay (not on norms and biases), clip: norm of the
    gradient, 0 none; schedule: "cosine" or "linear" from lr to lr * last, or "step": a tenth after each of `steps`
    (epochs); warmup: iterations from a third of lr; average: decay of the weights' moving average, 0 none; amp:
    bfloat16 on a GPU; freeze: prefixes of parameters that stay; norm_eval: BatchNorm keeps its statistics.
    flip: chance of a mirror image; zoom: range of the scale of a random crop; jitter: of brightness, contrast,
    saturation and gamma; noise: largest deviation of added noise. keep: least visible share of a box after a crop.
    rare: pictures with a class that fewer than this share of them show are repeated (see `batches.repeats`), 0 none.
    validate: epochs from one validation to the next.
    """

    detector: str
    epochs: int
    batch: int
    lr: float
    optimizer: Literal["sgd", "adamw"] = "adamw"
    momentum: float = 0.9
    weight_decay: float = 0.01
    schedule: Literal["cosine", "linear", "step"] = "cosine"
    last: float = 0.02
    steps: tuple[int, ...] = ()
    warmup: int = 200
    clip: float = 10.0
    average: float = 0.998
    amp: bool = True
    freeze: tuple[str, ...] = ()
    norm_eval: bool = False
    flip: float = 0.5
    zoom: tuple[float, float] = (1.0, 1.0)
    jitter: float = 0.3
    noise: float = 0.02
    keep: float = 0.3
    rare: float = 0.0
    validate: int = 5
    seed: int = 0

    def __post_init__(self) -> None:
        if self.epochs < 1 or self.batch < 1 or not self.lr > 0:
            raise ConfigError(f"recipe {self.detector}: epochs and batch must be 1 or more, lr above 0")
        if not 0 < self.zoom[0] <= self.zoom[1] or not 0 <= self.flip <= 1 or not 0 <= self.average < 1:
            raise ConfigError(f"recipe {self.detector}: zoom needs 0 < low <= high, flip and average a share")

    def rate(self, step: int, total: int, per_epoch: int) -> float:
        """Learning rate of a step out of `total`."""
        if self.schedule == "step":
            factor = 0.1 ** sum(step // max(per_epoch, 1) >= s for s in self.steps)
        else:
            done = min(step / max(total - 1, 1), 1.0)
            falls = done if self.schedule == "linear" else 0.5 - 0.5 * math.cos(math.pi * done)
            factor = 1.0 - (1.0 - self.last) * falls
        if step < self.warmup:
            factor *= 1 / 3 + 2 / 3 * step / self.warmup
        return self.lr * factor


def _official(detector: str, lr: float, **changes: Any) -> Recipe:
    """As mmdetection3d 1.4 trains its nuScenes models, 1x: SGD, 12 epochs, a tenth after 8 and 11."""
    base = Recipe(
        detector, 12, 16, lr, optimizer="sgd", weight_decay=1e-4, schedule="step", steps=(8, 11), warmup=500, clip=35.0,
        average=0.0, amp=False, freeze=("backbone.conv1", "backbone.bn1", "backbone.layer1"), norm_eval=True,
        jitter=0.0, noise=0.0, keep=0.0,
    )  # fmt: skip
    return replace(base, **changes)


# The paper: SGD, momentum 0.99, weight decay 4e-4, from 0.01 to 0.001, from COCO weights
_PAPER_YOLO = Recipe(
    "yolov3", 100, 16, 0.01, optimizer="sgd", momentum=0.99, weight_decay=4e-4, schedule="linear", last=0.1, clip=10.0,
    zoom=(0.6, 1.4),
)  # fmt: skip
_LIGHT_3D = Recipe("fcos3d-light", 24, 32, 1e-3, zoom=(0.8, 1.3), weight_decay=0.02, validate=8, keep=0.25, rare=0.1)
_LIGHT_2D = Recipe("yolov5n", 60, 32, 2e-3, zoom=(0.4, 1.6), weight_decay=0.02, validate=20)

RECIPES: dict[str, Recipe] = {
    "fcos3d-light": _LIGHT_3D,
    "pgd-det-light": replace(_LIGHT_3D, detector="pgd-det-light"),
    "yolov3-tiny": replace(_LIGHT_2D, detector="yolov3-tiny"),
    "yolov5n": _LIGHT_2D,
    "yolov5s": replace(_LIGHT_2D, detector="yolov5s"),
    "yolov3": _PAPER_YOLO,
    "yolov5s-paper": replace(_PAPER_YOLO, detector="yolov5s"),
    "fcos3d": _official("fcos3d", 0.002),
    "pgd-det": _official("pgd-det", 0.004),
}


def find_recipe(name: str, **changes: Any) -> Recipe:
    """A recipe by name with some of its values changed. UnknownNameError, ConfigError."""
    if name not in RECIPES:
        raise unknown_name("recipe", name, RECIPES)
    known = {f.name for f in fields(Recipe)}
    for key in changes:
        if key not in known:
            raise unknown_name("value of a recipe", key, sorted(known))
    return replace(RECIPES[name], **changes)


def recipe_data(recipe: Recipe) -> dict[str, Any]:
    """A recipe as plain data."""
    return asdict(recipe)
