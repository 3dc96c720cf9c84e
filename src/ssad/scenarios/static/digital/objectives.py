"""Losses that attacks ascend: functions of the dense outputs, one value per image, with a frozen assignment.

None of them uses boxes that survived suppression: a suppressed box has no gradient, and with no box left the attack
would stop. The loss decides the effect of an attack: the training losses fill an image with false boxes, `vanish` and
`margin` empty it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Protocol

import torch
from torch import Tensor
from torch.nn import functional

from ssad.core.detections import Assignment, Dense
from ssad.core.errors import ConfigError, unknown_name
from ssad.core.protocols import Detector
from ssad.core.registry import Reference, check_arguments, make, resolve
from ssad.core.tensor_boxes import iou

TERMS: Mapping[str, frozenset[str]] = {
    "classification": frozenset(
        {"cls", "obj", "centerness", "classification", "bbox_ctrness", "loss_classifier", "loss_objectness"}
    ),
    "localisation": frozenset(
        {
            "box",
            "offset",
            "depth",
            "size",
            "bbox2d",
            "consistency",
            "bbox_regression",
            "loss_box_reg",
            "loss_rpn_box_reg",
            "dfl",
        }
    ),
    "depth": frozenset({"depth"}),
    "orientation": frozenset({"rotsin", "dir", "axis", "side"}),
}
"""Names of the training losses of our detectors, and of those that adapters wrap, by what they are about."""


@dataclass(frozen=True, slots=True)
class Aim:
    """Objects under attack, and the classes that they should be mistaken for.

    Attributes:
        classes: Names of the attacked classes; None: all.
        objects: Indices of the attacked objects in the truth of each image; None: all.
        becomes: Map from a class to the class that it should be mistaken for; objects of other classes are not
            attacked. Used by `mislabel`; empty: the nearest wrong class.
    """

    classes: tuple[str, ...] | None = None
    objects: tuple[int, ...] | None = None
    becomes: Mapping[str, str] = field(default_factory=dict)

    def places(self, detector: Detector, assignment: Assignment) -> Tensor:
        """Return a mask [B, P] of the locations that are assigned to an object under attack.

        Raises:
            ConfigError: The detector does not know one of the classes.
        """
        is_attacked = assignment.label >= 0
        names = list(self.becomes) if self.becomes else self.classes
        if names is not None:
            class_indices = [_class_index(detector, name) for name in names]
            is_attacked &= torch.isin(assignment.label, torch.tensor(class_indices, device=is_attacked.device))
        if self.objects is not None:
            is_attacked &= torch.isin(assignment.owner, torch.tensor(self.objects, device=is_attacked.device))
        return is_attacked

    @property
    def attacks_all(self) -> bool:
        """True if all objects are under attack and no target class is given."""
        return self.classes is None and self.objects is None and not self.becomes


EVERYTHING = Aim()


@dataclass(frozen=True, slots=True)
class Situation:
    """Inputs of an objective besides the dense outputs: the detector, its frozen assignment and the aim."""

    detector: Detector
    assignment: Assignment
    aim: Aim = EVERYTHING


class Objective(Protocol):
    """Loss to ascend.

    Attributes:
        name: Name in records.
        needs_objects: True if an image without objects under attack has nothing to ascend.
    """

    @property
    def name(self) -> str:
        """Name in records."""

    @property
    def needs_objects(self) -> bool:
        """True if an image without objects under attack has nothing to ascend."""

    def __call__(self, dense: Dense, situation: Situation) -> Tensor:
        """Return one differentiable value per image [B], higher where the detector does worse."""


@dataclass(frozen=True, slots=True)
class TrainingLosses:
    """Training losses of the detector, or a group of them, over all objects, summed as in its source.

    Raises:
        ConfigError: The aim selects some objects only, or the detector has no such loss.
    """

    name: str
    terms: frozenset[str] | None = None
    needs_objects: bool = False

    def __call__(self, dense: Dense, situation: Situation) -> Tensor:
        """Return the sum of the selected training losses of each image."""
        if not situation.aim.attacks_all:
            raise ConfigError(f"loss '{self.name}' is of all objects; for some of them use vanish, margin or mislabel")
        losses = situation.detector.losses(dense, situation.assignment, reduction="image")
        selected_losses = [value for name, value in losses.items() if self.terms is None or name in self.terms]
        if not selected_losses:
            raise ConfigError(
                f"{situation.detector.name} has no loss of {self.name}; its losses are {', '.join(losses)}"
            )
        return torch.stack(selected_losses).sum(0)


@dataclass(frozen=True, slots=True)
class Vanish:
    """Suppression of every score at every location, or at the locations of the aim.

    The loss is the log-probability that nothing is present, summed over locations and classes.

    Source: Chow et al., TOG (2020), untargeted vanishing, here for any head.
    """

    name: str = "vanish"
    needs_objects: bool = False

    def __call__(self, dense: Dense, situation: Situation) -> Tensor:
        """Return the summed log-probability of absence of each image."""
        absent = torch.log1p(-log_scores(dense).exp())
        if not situation.aim.attacks_all:
            absent = absent * _weights(dense, situation)[..., None]
        return absent.sum((1, 2))


@dataclass(frozen=True, slots=True)
class Margin:
    """Carlini and Wagner's margin, for heads of independent sigmoids.

    At each location it is the distance of the best class above the log-odds of a score that no longer counts, down to
    `confidence` below it; summed over locations.

    Attributes:
        threshold: Score below which a detection does not count.
        confidence: Distance below the threshold, in log-odds, to which locations are pushed.
        name: Name in records.
        needs_objects: See `Objective`.

    Source: Carlini and Wagner, Towards Evaluating the Robustness of Neural Networks (2017), f6, with the threshold in
    place of the runner-up.
    """

    threshold: float = 0.01
    confidence: float = 1.0
    name: str = "margin"
    needs_objects: bool = False

    def __call__(self, dense: Dense, situation: Situation) -> Tensor:
        """Return the negative summed margin of each image."""
        best_log_odds = log_odds(log_scores(dense)).amax(-1)
        excess = (best_log_odds - (math.log(self.threshold / (1 - self.threshold)) - self.confidence)).clamp_min(0.0)
        if not situation.aim.attacks_all:
            excess = excess * _weights(dense, situation)
        return -excess.sum(1)


@dataclass(frozen=True, slots=True)
class Hide:
    """Suppression of all boxes on an object.

    log(1 - the largest score of its class times IoU over all locations), summed over the objects of the aim.
    `hide-any` sums over the 20 best locations, each with its largest score of any class, so that an object is not
    hidden by being mistaken for one or two others.

    Source: the detection loss of ACTIVE and RAUCA (Suryanto et al. 2023, Zhou et al. 2024), with the score of any
    head.

    Attributes:
        others: Number of best locations that count, each with its own value; 1 in the source.
        name: Name in records.
        needs_objects: Without an object there is nothing to hide.
        every: Count boxes of all classes instead of the object's class only, as in the source.
    """

    others: int = 1
    name: str = "hide"
    needs_objects: bool = True
    every: bool = False

    def __call__(self, dense: Dense, situation: Situation) -> Tensor:
        """Return the summed log-probability that the objects of each image are hidden."""
        score = log_scores(dense).exp()
        total = dense.logit.new_zeros(len(dense.logit))
        for image_index, truth in enumerate(situation.assignment.truth):
            for object_index in objects_of(situation, image_index):
                overlap = iou(dense.box[image_index], truth.box[object_index].to(dense.box))
                class_score = (
                    score[image_index].amax(-1) if self.every else score[image_index, :, int(truth.label[object_index])]
                )
                location_value = class_score * overlap
                best_values = location_value.topk(min(self.others, len(location_value))).values.clamp_max(1 - 1e-6)
                total[image_index] = total[image_index] + torch.log1p(-best_values).sum()
        return total


@dataclass(frozen=True, slots=True)
class Fabricate:
    """Higher scores everywhere: the mean log-score of the best class over locations (TOG's fabrication)."""

    name: str = "fabricate"
    needs_objects: bool = False

    def __call__(self, dense: Dense, situation: Situation) -> Tensor:
        """Return the mean best log-score of each image.

        Raises:
            ConfigError: The aim selects classes or objects.
        """
        if not situation.aim.attacks_all:
            raise ConfigError("fabricate makes objects where there are none; it takes no classes and no objects")
        return log_scores(dense).amax(-1).mean(1)


@dataclass(frozen=True, slots=True)
class Mislabel:
    """Wrong class above the true one at the locations of objects; the mean over these locations of an image.

    The wrong class is the one that the aim names, or else the nearest.

    Attributes:
        confidence: Lead of the wrong class, in log-odds, beyond which nothing more is gained.
        name: Name in records.
        needs_objects: See `Objective`.
    """

    confidence: float = 5.0
    name: str = "mislabel"
    needs_objects: bool = True

    def __call__(self, dense: Dense, situation: Situation) -> Tensor:
        """Return the mean lead of the wrong class of each image.

        Raises:
            ConfigError: The detector has one class only, or lacks a class of the aim.
        """
        detector, label = situation.detector, situation.assignment.label
        if dense.logit.shape[-1] < 2:
            raise ConfigError(f"{detector.name} knows one class; there is nothing to mislabel")
        is_attacked = situation.aim.places(detector, situation.assignment)
        true_label = label.clamp_min(0)[..., None]
        if situation.aim.becomes:
            wrong_class_of = torch.arange(len(detector.classes), device=label.device)
            for name, wrong_class in situation.aim.becomes.items():
                wrong_class_of[_class_index(detector, name)] = _class_index(detector, wrong_class)
            rival_logit = dense.logit.gather(-1, wrong_class_of[true_label])[..., 0]
        else:
            rival_logit = dense.logit.scatter(-1, true_label, -torch.inf).amax(-1)
        lead = (rival_logit - dense.logit.gather(-1, true_label)[..., 0]).clamp_max(self.confidence)
        lead = torch.where(is_attacked, lead, 0.0)
        return lead.sum(1) / is_attacked.sum(1).clamp_min(1)


OBJECTIVES: Mapping[str, Callable[[], Objective]] = {
    "full": partial(TrainingLosses, "full"),
    **{name: partial(TrainingLosses, name, terms) for name, terms in TERMS.items()},
    "vanish": Vanish,
    "margin": Margin,
    "hide": Hide,
    "hide-any": partial(Hide, others=20, name="hide-any", every=True),
    "fabricate": Fabricate,
    "mislabel": Mislabel,
}


LOSSES: Mapping[str, str] = dict.fromkeys(OBJECTIVES, __name__)
"""Built-in objectives and the module that defines them."""


UNDIVIDED = frozenset({"full", *TERMS, "fabricate"})
"""Objectives that are of all objects, and take no aim at some."""


def make_objective(name: str) -> Objective:
    """Create an objective by name.

    Args:
        name: Key of `OBJECTIVES`, entry point of the group `ssad.losses`, or "module:object"; arguments may follow.

    Raises:
        UnknownNameError: There is no such objective.
        ConfigError: An argument is unknown, or the object is no objective.
    """
    reference = Reference.parse(name)
    target = OBJECTIVES.get(reference.name) or resolve("loss", LOSSES, reference.name)
    check_arguments("loss", name, target)
    objective: Objective = make(
        "loss", reference.name, target, reference.options, ("name", "needs_objects", "__call__")
    )
    return objective


def log_scores(dense: Dense) -> Tensor:
    """Return the log-scores [B, P, C] (class times quality, each a sigmoid), kept slightly below 0."""
    score = functional.logsigmoid(dense.logit)
    if dense.quality is not None:
        score = score + functional.logsigmoid(dense.quality)[..., None]
    # A score of exactly 1 would have infinite log-odds.
    return score.clamp_max(-1e-6)


def log_odds(score: Tensor) -> Tensor:
    """Return log(p / (1 - p)) of log p."""
    return score - torch.log1p(-score.exp())


def _weights(dense: Dense, situation: Situation) -> Tensor:
    """Return 1 for locations [B, P] assigned to an attacked object or inside its box, else 0."""
    is_weighted = situation.aim.places(situation.detector, situation.assignment)
    for image_index, truth in enumerate(situation.assignment.truth):
        object_indices = torch.unique(situation.assignment.owner[image_index][is_weighted[image_index]])
        is_weighted[image_index] |= _lie_in_boxes(dense.place, truth.box.to(dense.place)[object_indices])
    return is_weighted.to(dense.logit.dtype)


def objects_of(situation: Situation, image: int) -> list[int]:
    """Return the indices of the objects of an image that the aim puts under attack."""
    aim, truth = situation.aim, situation.assignment.truth[image]
    names = list(aim.becomes) if aim.becomes else aim.classes
    class_indices = None if names is None else {_class_index(situation.detector, name) for name in names}
    candidates = range(len(truth.label)) if aim.objects is None else aim.objects
    labels = truth.label.tolist()
    return [
        object_index
        for object_index in candidates
        if object_index < len(labels) and (class_indices is None or labels[object_index] in class_indices)
    ]


def _lie_in_boxes(place: Tensor, box: Tensor) -> Tensor:
    """Return a mask of the places [P, 2] that lie in one of the boxes [N, 4]."""
    inside = (place[:, None] >= box[None, :, :2]) & (place[:, None] < box[None, :, 2:])
    return inside.all(-1).any(1)


def _class_index(detector: Detector, name: str) -> int:
    if name not in detector.classes:
        raise unknown_name("class", name, detector.classes)
    return detector.classes.index(name)
