"""How a detector is trained: everything that decides the result but the data."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Literal, get_args, get_origin, get_type_hints

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
        for name, kind in get_type_hints(type(self)).items():
            if not _is(getattr(self, name), kind):
                given = getattr(self, name)
                raise ConfigError(f"recipe {self.detector}: {name}={given}: expected {_words(kind)}")
        if min(self.epochs, self.batch, self.validate) < 1 or not 0 < self.lr < math.inf:
            raise ConfigError(f"recipe {self.detector}: epochs, batch and validate must be 1 or more, lr above 0")
        if not 0 < self.zoom[0] <= self.zoom[1]:
            raise ConfigError(f"recipe {self.detector}: zoom needs 0 < low <= high")
        for name in ("flip", "keep", "last", "rare", "jitter", "noise"):
            if not 0 <= getattr(self, name) <= 1:
                raise ConfigError(f"recipe {self.detector}: {name}={getattr(self, name)} is not in [0, 1]")
        for name in ("momentum", "average"):
            if not 0 <= getattr(self, name) < 1:
                raise ConfigError(f"recipe {self.detector}: {name}={getattr(self, name)} is not in [0, 1)")
        for name in ("weight_decay", "warmup", "clip", "seed"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ConfigError(f"recipe {self.detector}: {name}={getattr(self, name)} must be 0 or more")

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


def _is(value: Any, kind: Any) -> bool:
    """Whether a value is of an annotated type; a whole number is a number, but no truth value is."""
    if get_origin(kind) is Literal:
        return value in get_args(kind)
    if get_origin(kind) is tuple:
        kinds = get_args(kind)
        if not isinstance(value, tuple):
            return False
        kinds = (kinds[0],) * len(value) if kinds[-1] is ... else kinds
        return len(value) == len(kinds) and all(map(_is, value, kinds))
    if kind in (int, float):
        return isinstance(value, int | kind) and not isinstance(value, bool)
    return isinstance(value, kind)


def _words(kind: Any) -> str:
    """A type in words."""
    if get_origin(kind) is Literal:
        return " or ".join(map(str, get_args(kind)))
    if get_origin(kind) is tuple:
        kinds = get_args(kind)
        return f"a list of {'' if kinds[-1] is ... else f'{len(kinds)} '}{_words(kinds[0]).removeprefix('a ')}s"
    return {int: "a whole number", float: "a number", bool: "true or false", str: "a name"}[kind]


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
    known = sorted(f.name for f in fields(Recipe) if f.name != "detector")
    for key in changes:
        if key not in known:
            raise ConfigError(f"a recipe has no value '{key}'; it has {', '.join(known)}")
    return replace(RECIPES[name], **changes)


def recipe_data(recipe: Recipe) -> dict[str, Any]:
    """A recipe as plain data."""
    return asdict(recipe)
