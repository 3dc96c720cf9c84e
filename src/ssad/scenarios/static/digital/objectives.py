"""What an attack ascends: losses on the dense outputs, one value an image, with the target assignment frozen.

None of them looks at boxes that survived suppression: a suppressed box has no gradient, and with no box left the attack
would stop. Which loss is ascended decides what an attack does: the training losses fill a picture with false boxes,
`vanish` and `margin` empty it.
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
    """Which objects an attack is about, and what they should be taken for.

    Attributes:
        classes: Names of the classes that are attacked; None: all.
        objects: Indices of the objects that are attacked, in the truth of each image; None: all.
        becomes: Name of a class -> name of the class that it should be taken for; objects of other classes are left
            alone. Used by `mislabel`; empty: whichever wrong class is nearest.
    """

    classes: tuple[str, ...] | None = None
    objects: tuple[int, ...] | None = None
    becomes: Mapping[str, str] = field(default_factory=dict)

    def places(self, detector: Detector, assignment: Assignment) -> Tensor:
        """Locations [B, P] that are assigned to an object under attack.

        Raises:
            ConfigError: A class that the detector does not know.
        """
        chosen = assignment.label >= 0
        names = list(self.becomes) if self.becomes else self.classes
        if names is not None:
            wanted = [_index(detector, name) for name in names]
            chosen &= torch.isin(assignment.label, torch.tensor(wanted, device=chosen.device))
        if self.objects is not None:
            chosen &= torch.isin(assignment.owner, torch.tensor(self.objects, device=chosen.device))
        return chosen

    @property
    def everything(self) -> bool:
        """Whether all objects are under attack, whatever they become."""
        return self.classes is None and self.objects is None and not self.becomes


EVERYTHING = Aim()


@dataclass(frozen=True, slots=True)
class Situation:
    """What an objective is told besides the dense outputs: the detector, its frozen assignment, the aim."""

    detector: Detector
    assignment: Assignment
    aim: Aim = EVERYTHING


class Objective(Protocol):
    """A loss to ascend.

    Attributes:
        name: What records call it.
        needs_objects: Whether an image without objects under attack has nothing to ascend.
    """

    @property
    def name(self) -> str:
        """What records call it."""

    @property
    def needs_objects(self) -> bool:
        """Whether an image without objects under attack has nothing to ascend."""

    def __call__(self, dense: Dense, situation: Situation) -> Tensor:
        """[B] one value an image, differentiable, higher where the detector does worse."""


@dataclass(frozen=True, slots=True)
class TrainingLosses:
    """The detector's own training losses, or those about one thing; of all objects, as the source sums them.

    Raises:
        ConfigError: The aim is at some objects only; or the detector has no such loss.
    """

    name: str
    terms: frozenset[str] | None = None
    needs_objects: bool = False

    def __call__(self, dense: Dense, situation: Situation) -> Tensor:
        """See `Objective`."""
        if not situation.aim.everything:
            raise ConfigError(f"loss '{self.name}' is of all objects; for some of them use vanish, margin or mislabel")
        found = situation.detector.losses(dense, situation.assignment, reduction="image")
        chosen = [value for name, value in found.items() if self.terms is None or name in self.terms]
        if not chosen:
            raise ConfigError(
                f"{situation.detector.name} has no loss of {self.name}; its losses are {', '.join(found)}"
            )
        return torch.stack(chosen).sum(0)


@dataclass(frozen=True, slots=True)
class Vanish:
    """Lower every score at every location, or at those of the aim.

    The loss is the log-probability that nothing is there, summed over locations and classes.

    Source: Chow et al., TOG (2020), untargeted vanishing, here for any head.
    """

    name: str = "vanish"
    needs_objects: bool = False

    def __call__(self, dense: Dense, situation: Situation) -> Tensor:
        """See `Objective`."""
        absent = torch.log1p(-log_scores(dense).exp())
        if not situation.aim.everything:
            absent = absent * _weights(dense, situation)[..., None]
        return absent.sum((1, 2))


@dataclass(frozen=True, slots=True)
class Margin:
    """Carlini and Wagner's margin, for heads of independent sigmoids.

    For each location, it is how far the best class lies above the log-odds of a score that no longer counts, down to
    `confidence` below it; summed over locations.

    Attributes:
        threshold: Score below which a detection does not count.
        confidence: How far below the threshold, in log-odds, locations are pushed.
        name: What records call it.
        needs_objects: See `Objective`.

    Source: Carlini and Wagner, Towards Evaluating the Robustness of Neural Networks (2017), f6, with the threshold in
    place of the runner-up.
    """

    threshold: float = 0.01
    confidence: float = 1.0
    name: str = "margin"
    needs_objects: bool = False

    def __call__(self, dense: Dense, situation: Situation) -> Tensor:
        """See `Objective`."""
        best = log_odds(log_scores(dense)).amax(-1)
        above = (best - (math.log(self.threshold / (1 - self.threshold)) - self.confidence)).clamp_min(0.0)
        if not situation.aim.everything:
            above = above * _weights(dense, situation)
        return -above.sum(1)


@dataclass(frozen=True, slots=True)
class Hide:
    """No box on an object with any score.

    log(1 - the largest score of its class times IoU over all locations), summed over the objects of the aim. `hide-any`
    sums over the 20 best locations, each with its largest score of any class, so that an object is not hidden by
    being taken for another, or for two.

    Source: the detection loss of ACTIVE and RAUCA (Suryanto et al. 2023, Zhou et al. 2024), with the score of any head.

    Attributes:
        others: How many locations next to the best one count too, by their own value; 1 is the source's.
        name: What records call it.
        needs_objects: Without an object there is nothing to hide.
        every: Whether boxes of all classes count, and not of the object's alone as in the source.
    """

    others: int = 1
    name: str = "hide"
    needs_objects: bool = True
    every: bool = False

    def __call__(self, dense: Dense, situation: Situation) -> Tensor:
        """See `Objective`."""
        score = log_scores(dense).exp()
        total = dense.logit.new_zeros(len(dense.logit))
        for k, truth in enumerate(situation.assignment.truth):
            for number in objects_of(situation, k):
                overlap = _overlap(dense.box[k], truth.box[number].to(dense.box))
                own = score[k].amax(-1) if self.every else score[k, :, int(truth.label[number])]
                value = own * overlap
                best = value.topk(min(self.others, len(value))).values.clamp_max(1 - 1e-6)
                total[k] = total[k] + torch.log1p(-best).sum()
        return total


@dataclass(frozen=True, slots=True)
class Fabricate:
    """Scores up everywhere: the mean over locations of the log-score of the best class (TOG's fabrication)."""

    name: str = "fabricate"
    needs_objects: bool = False

    def __call__(self, dense: Dense, situation: Situation) -> Tensor:
        """See `Objective`. Raises ConfigError for an aim at some classes or objects."""
        if not situation.aim.everything:
            raise ConfigError("fabricate makes objects where there are none; it takes no classes and no objects")
        return log_scores(dense).amax(-1).mean(1)


@dataclass(frozen=True, slots=True)
class Mislabel:
    """At the locations of objects, raise a wrong class above the true one; mean over these locations of an image.

    The wrong class is the one that the aim names, or else the nearest.

    Attributes:
        confidence: Lead of the wrong class, in log-odds, beyond which nothing more is gained.
        name: What records call it.
        needs_objects: See `Objective`.
    """

    confidence: float = 5.0
    name: str = "mislabel"
    needs_objects: bool = True

    def __call__(self, dense: Dense, situation: Situation) -> Tensor:
        """See `Objective`. Raises ConfigError if the detector knows only one class, or not a class of the aim."""
        detector, label = situation.detector, situation.assignment.label
        if dense.logit.shape[-1] < 2:
            raise ConfigError(f"{detector.name} knows one class; there is nothing to mislabel")
        chosen = situation.aim.places(detector, situation.assignment)
        true = label.clamp_min(0)[..., None]
        if situation.aim.becomes:
            table = torch.arange(len(detector.classes), device=label.device)
            for name, other in situation.aim.becomes.items():
                table[_index(detector, name)] = _index(detector, other)
            rival = dense.logit.gather(-1, table[true])[..., 0]
        else:
            rival = dense.logit.scatter(-1, true, -torch.inf).amax(-1)
        ahead = (rival - dense.logit.gather(-1, true)[..., 0]).clamp_max(self.confidence)
        ahead = torch.where(chosen, ahead, 0.0)
        return ahead.sum(1) / chosen.sum(1).clamp_min(1)


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


UNDIVIDED = frozenset({"full", *TERMS, "fabricate"})
"""Objectives that are of all objects, and take no aim at some."""


def make_objective(name: str) -> Objective:
    """An objective by name.

    Raises:
        UnknownNameError: There is none.
    """
    if name not in OBJECTIVES:
        raise unknown_name("loss", name, OBJECTIVES)
    return OBJECTIVES[name]()


def log_scores(dense: Dense) -> Tensor:
    """Logarithms [B, P, C] of the scores: class times quality, each a sigmoid; below 0 by a little at least."""
    score = functional.logsigmoid(dense.logit)
    if dense.quality is not None:
        score = score + functional.logsigmoid(dense.quality)[..., None]
    return score.clamp_max(-1e-6)


def log_odds(score: Tensor) -> Tensor:
    """log(p / (1 - p)) of log p."""
    return score - torch.log1p(-score.exp())


def _weights(dense: Dense, situation: Situation) -> Tensor:
    """Which locations [B, P] count: those assigned to the objects of the aim, and those whose box lies on them."""
    chosen = situation.aim.places(situation.detector, situation.assignment)
    for k, truth in enumerate(situation.assignment.truth):
        aimed = torch.unique(situation.assignment.owner[k][chosen[k]])
        chosen[k] |= _on(dense.place, truth.box.to(dense.place)[aimed])
    return chosen.to(dense.logit.dtype)


def objects_of(situation: Situation, image: int) -> list[int]:
    """Indices of the objects of an image that are under attack: those of the aim's numbers and classes."""
    aim, truth = situation.aim, situation.assignment.truth[image]
    names = list(aim.becomes) if aim.becomes else aim.classes
    wanted = None if names is None else {_index(situation.detector, name) for name in names}
    numbers = range(len(truth.label)) if aim.objects is None else aim.objects
    labels = truth.label.tolist()
    return [k for k in numbers if k < len(labels) and (wanted is None or labels[k] in wanted)]


def _overlap(box: Tensor, real: Tensor) -> Tensor:
    """IoU [P] of boxes [P, 4] with one box [4]."""
    side = (torch.minimum(box[:, 2:], real[2:]) - torch.maximum(box[:, :2], real[:2])).clamp_min(0.0)
    both = side.prod(1)
    area = (box[:, 2:] - box[:, :2]).clamp_min(0.0).prod(1) + (real[2:] - real[:2]).prod() - both
    return both / area.clamp_min(1e-9)


def _on(place: Tensor, box: Tensor) -> Tensor:
    """Which places [P, 2] lie in one of the boxes [N, 4]."""
    inside = (place[:, None] >= box[None, :, :2]) & (place[:, None] < box[None, :, 2:])
    return inside.all(-1).any(1)


def _index(detector: Detector, name: str) -> int:
    if name not in detector.classes:
        raise unknown_name("class", name, detector.classes)
    return detector.classes.index(name)
