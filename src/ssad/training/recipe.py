"""Training recipes of detectors: all settings that decide the result except the data."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, field, replace
from functools import partial
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from ssad.core.errors import unknown_name
from ssad.core.schema import VALUES, Above, Least, Part, Whole, build_validated

FromNone = Annotated[int, Field(ge=0)]
Decay = Annotated[float, Field(ge=0.0, lt=1.0)]


@dataclass(frozen=True, slots=True, config=VALUES)
class Recipe:
    """A training run. Learning rates are for one step on `batch` images over all devices.

    Attributes:
        detector: Name of the detector.
        epochs: Number of epochs, at most.
        within: The rate falls to its end within this time of training, s, judged by the quickest epoch so far,
            however few epochs that makes, so that another machine trains otherwise; 0: it falls over `epochs`.
        batch: Images in a step, over all devices.
        lr: Learning rate.
        optimizer: "sgd" or "adamw".
        momentum: Of SGD, or beta 1 of AdamW.
        weight_decay: Does not apply to norms and biases.
        schedule: "cosine" or "linear" from lr to lr * last, or "step": a tenth after each of `steps`.
        last: See `schedule`.
        steps: Epochs; see `schedule`.
        warmup: Iterations over which the rate rises from a third of lr.
        clip: Norm to which the gradient is clipped; 0: it is not.
        average: Decay of the moving average of the weights; 0: none is kept.
        amp: bfloat16 on a GPU.
        compile: Whether layers that can be fused are compiled on a GPU (needs Triton and a C compiler).
        freeze: Prefixes of the names of parameters that stay as they are.
        norm_eval: Whether BatchNorm keeps its statistics.
        flip: Probability of a mirror image.
        zoom: Range of the scale of a random crop.
        rise: Most rows by which a picture is moved up or down, 3D only, its lens with it: cameras that look level show
            the horizon at one height, and without this nothing is learned about any other.
        doubt: Error of the predicted depth (m) at which the centreness to be learned falls to 1/e, 3D only, so that
            boxes are ranked by how well they lie; 0: it does not fall.
        weigh: Factors of losses by name; 1 where there is none.
        jitter: Of brightness, contrast, saturation and gamma.
        noise: Largest standard deviation of added noise.
        blur: Largest standard deviation of a Gaussian blur, px. Half of the images stay sharp.
        grey: Probability of an image without colour.
        clutter: Largest contrast of random texture that is laid over parts of an image. Its amplitude falls with the
            inverse of the spatial frequency, as that of photographs does (Field 1987). Rendered surfaces are smoother
            than real ones; a detector that has seen smooth ones alone can take texture for objects.
        keep: Least visible share of a box after a crop, 2D only (a 3D box stays while its middle is in sight).
        rare: Images with a class that fewer than this share of them show are repeated (`repetition_counts`); 0:
            none.
        validate: Epochs from one validation to the next.
        radius: Adversarial training: every picture is attacked by PGD on the training losses within this L-infinity
            radius (code values of 0..255); 0: none.
        attack_steps: Gradient steps of these attacks.
        options: Of the detector's builder, such as heading: vectors; `make_detector` needs them again to load the
            weights.
        seed: Of all random draws.
        photo_size: Height and width to which photographs of COCO, KITTI, BDD100K and nuScenes are fitted, 2D only:
            resized, and padded with grey at the right and the bottom.
    """

    detector: str
    epochs: Whole
    batch: Whole
    lr: Above
    optimizer: Literal["sgd", "adamw"] = "adamw"
    momentum: Decay = 0.9
    weight_decay: Least = 0.01
    schedule: Literal["cosine", "linear", "step"] = "cosine"
    last: Part = 0.02
    steps: tuple[int, ...] = ()
    warmup: FromNone = 200
    clip: Least = 10.0
    average: Decay = 0.998
    amp: bool = True
    compile: bool = False
    freeze: tuple[str, ...] = ()
    norm_eval: bool = False
    flip: Part = 0.5
    zoom: tuple[Above, Above] = (1.0, 1.0)
    rise: Least = 0.0
    doubt: Least = 0.0
    weigh: dict[str, Least] = field(default_factory=dict)
    jitter: Part = 0.3
    noise: Part = 0.02
    blur: Least = 0.0
    grey: Part = 0.0
    clutter: Part = 0.0
    keep: Part = 0.0
    rare: Part = 0.0
    validate: Whole = 5
    within: Least = 0.0
    radius: Least = 0.0
    attack_steps: Whole = 1
    options: dict[str, Any] = field(default_factory=dict)
    seed: FromNone = 0
    photo_size: tuple[Whole, Whole] = (384, 640)

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.zoom[0] > self.zoom[1]:
            raise ValueError("zoom: needs low <= high")
        if self.keep and self.is_3d:
            raise ValueError("keep: is for 2D detectors; a 3D box stays while its middle is in sight")
        for name in ("rise", "doubt"):
            if getattr(self, name) and not self.is_3d:
                raise ValueError(f"{name}: is for 3D detectors")
        return self

    @property
    def is_3d(self) -> bool:
        """True for 3D detectors."""
        return self.detector.startswith(("fcos3d", "pgd"))

    def last_epoch(self, completed: int, elapsed_seconds: float, fastest_epoch: float) -> int:
        """The epoch after which the training ends, as far as can be told.

        Args:
            completed: Epochs that are done.
            elapsed_seconds: Time that they took, s.
            fastest_epoch: Time that the quickest took, s; inf before the first.
        """
        if not self.within or not completed:
            return self.epochs
        return min(self.epochs, completed + max(0, int((self.within - elapsed_seconds) / max(fastest_epoch, 1e-9))))

    def rate(self, step: int, total: int, per_epoch: int) -> float:
        """Return the learning rate of a step out of `total`."""
        if self.schedule == "step":
            factor = 0.1 ** sum(step // max(per_epoch, 1) >= milestone for milestone in self.steps)
        else:
            progress = min(step / max(total - 1, 1), 1.0)
            decay = progress if self.schedule == "linear" else 0.5 - 0.5 * math.cos(math.pi * progress)
            factor = 1.0 - (1.0 - self.last) * decay
        if step < self.warmup:
            factor *= 1 / 3 + 2 / 3 * step / self.warmup
        return self.lr * factor


def _official(detector: str, lr: float, **changes: Any) -> Recipe:
    """Return a recipe of mmdetection3d 1.4 for nuScenes, 1x: SGD, 12 epochs, a tenth after 8 and 11."""
    official = Recipe(
        detector,
        12,
        16,
        lr,
        optimizer="sgd",
        weight_decay=1e-4,
        schedule="step",
        steps=(8, 11),
        warmup=500,
        clip=35.0,
        average=0.0,
        amp=False,
        freeze=("backbone.conv1", "backbone.bn1", "backbone.layer1"),
        norm_eval=True,
        jitter=0.0,
        noise=0.0,
    )
    return replace(official, **changes)


# The paper: SGD, momentum 0.99, weight decay 4e-4, from 0.01 to 0.001, from COCO weights
_PAPER_YOLO = Recipe(
    "yolov3",
    100,
    16,
    0.01,
    optimizer="sgd",
    momentum=0.99,
    weight_decay=4e-4,
    schedule="linear",
    last=0.1,
    clip=10.0,
    zoom=(0.6, 1.4),
    keep=0.3,
)
_LIGHT_3D = Recipe("fcos3d-light", 24, 32, 1e-3, zoom=(0.8, 1.3), weight_decay=0.02, validate=8, rare=0.1)
_LIGHT_2D = Recipe("yolov5n", 60, 32, 2e-3, zoom=(0.4, 1.6), weight_decay=0.02, validate=20, keep=0.3)

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
    """Return a recipe by name, with changed values.

    Raises:
        UnknownNameError: No recipe has that name.
        ConfigError: A value is not valid.
    """
    if name not in RECIPES:
        raise unknown_name("recipe", name, RECIPES)
    return build_validated(
        partial(replace, RECIPES[name]), changes, subject=f"recipe {name}", kind=Recipe, name_field="detector"
    )


def command_line_changes(changes: Iterable[tuple[str, Any]]) -> list[str]:
    """Return changed values as command line arguments."""
    return [word for key, value in changes for word in ("--set", f"{key}={_compact_yaml(value)}")]


def _compact_yaml(value: Any) -> str:
    """Return a value as compact YAML."""
    if isinstance(value, tuple):
        return "[" + ",".join(map(str, value)) + "]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {entry}" for key, entry in value.items()) + "}"
    return str(value)


def recipe_data(recipe: Recipe) -> dict[str, Any]:
    """Return a recipe as plain data."""
    return asdict(recipe)
