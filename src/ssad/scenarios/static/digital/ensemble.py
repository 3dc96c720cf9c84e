"""Ensembles of attacks on the same images: each image keeps the result that is worst for the detector."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ssad.core.detections import Detections, Truth
from ssad.core.errors import ConfigError
from ssad.core.protocols import Detector
from ssad.scenarios.static.digital.attack import Access, Attack, AttackResult, run_attack
from ssad.scenarios.static.digital.budget import LEVELS, Budget
from ssad.scenarios.static.digital.image_quality import ImageQuality, image_quality, truth_of_aim
from ssad.scenarios.static.digital.objectives import EVERYTHING, Aim, Objective
from ssad.scenarios.static.digital.victim import Cost, Through, steady

Judge = Callable[[Detections, Truth], ImageQuality]


@dataclass(frozen=True, slots=True)
class Ensemble:
    """Attacks, each with the loss that it ascends.

    Losses are not comparable, so the detections decide between the members.

    Attributes:
        members: Attack and loss (or its name) of each member.

    Raises:
        ConfigError: There is no member.
    """

    members: Sequence[tuple[Attack, str | Objective]]
    name: str = "ensemble"

    def __post_init__(self) -> None:
        if not self.members:
            raise ConfigError("ensemble: it needs one attack at least")

    @property
    def access(self) -> Access:
        """Highest access level of the members."""
        access_levels = {attack.access for attack, _ in self.members}
        return "white-box" if "white-box" in access_levels else "black-box" if "black-box" in access_levels else "none"


def run_ensemble(
    ensemble: Ensemble,
    detector: Detector,
    images: Tensor,
    truth: Sequence[Truth],
    budget: Budget,
    *,
    intrinsic: Tensor | None = None,
    aim: Aim = EVERYTHING,
    keys: Sequence[tuple[object, ...]] | None = None,
    through: Through | None = None,
    check: bool = True,
    threshold: float | None = None,
    judge: Judge | None = None,
) -> AttackResult:
    """Attack a batch with every member and keep the worst result of each image after the 8-bit round trip.

    The detections in an image determine its quality (`image_quality`). Of members with equal quality, the one whose
    false detections have the higher scores wins; of those that tie again, the first.

    Args:
        ensemble: Attacks and their losses.
        detector: Detector under attack.
        images: [B, 3, H, W] float in [0, 1], multiples of 1/255.
        truth: Ground truth of each image.
        budget: Maximum change of each image.
        intrinsic: [B, 3, 3], for 3D.
        aim: Objects under attack; all others count as crowd when images are judged.
        keys: Random keys of the images.
        through: Defence that every image passes and that the attacks know.
        check: Compare gradients with finite differences first.
        threshold: Minimum score of a detection; None: the detector's own.
        judge: Function that scores the detections of an image; default: `image_quality`.

    Returns:
        The worst images. `before` and `after` are 1 minus the quality of the clean and of the attacked image; `idle`
        marks images in which no member had an object to attack. Costs are the sums over all members, plus one query
        each to judge its result. The metadata has the names of the members and their losses ("members"), the index of
        the winner of each image ("won") and the quality that each member leaves ("quality" [B][M]; the clean one's in
        "clean_quality").

    Raises:
        ConfigError: See `run_attack`.
    """

    def judge_images(judged_images: Tensor) -> list[ImageQuality]:
        with steady(detector), torch.no_grad():
            defended = judged_images if through is None else through(judged_images)
            detections = detector.predict(defended, intrinsic, threshold=threshold)
        judged_pairs = zip(
            detections, (truth_of_aim(image_truth, aim, detector.classes) for image_truth in truth), strict=True
        )
        if judge is not None:
            return [judge(*judged_pair) for judged_pair in judged_pairs]
        class_count = len(detector.classes)
        return [image_quality(*judged_pair, task=detector.task, classes=class_count) for judged_pair in judged_pairs]

    runs = [
        run_attack(
            attack,
            detector,
            images,
            truth,
            budget,
            objective=objective,
            intrinsic=intrinsic,
            aim=aim,
            keys=keys,
            through=through,
            check=check,
        )
        for attack, objective in ensemble.members
    ]
    qualities_by_member = [judge_images(run.images) for run in runs]
    clean_qualities = judge_images(images)
    winners = [
        min(range(len(runs)), key=lambda member_index: qualities_by_member[member_index][image_index].order)
        for image_index in range(len(images))
    ]
    # Judging the result of a member takes one more query.
    cost = Cost(sum(run.cost.gradients for run in runs), sum(run.cost.queries + 1 for run in runs))
    errors = [run.gradient_error for run in runs if run.gradient_error is not None]
    metadata: dict[str, Any] = {
        "attack": ensemble.name,
        "access": ensemble.access,
        "loss": "quality",
        "norm": budget.norm,
        "radius_px": round(budget.radius * LEVELS, 6),
        "gradients": cost.gradients,
        "queries": cost.queries,
        "members": [f"{run.about['attack']}/{run.about['loss']}" for run in runs],
        "won": winners,
        "quality": [
            [member_qualities[image_index].value for member_qualities in qualities_by_member]
            for image_index in range(len(images))
        ],
        "clean_quality": [clean_quality.value for clean_quality in clean_qualities],
    }
    return AttackResult(
        torch.stack([runs[member_index].images[image_index] for image_index, member_index in enumerate(winners)]),
        images.new_tensor([1 - clean_quality.value for clean_quality in clean_qualities]),
        images.new_tensor(
            [
                1 - qualities_by_member[member_index][image_index].value
                for image_index, member_index in enumerate(winners)
            ]
        ),
        torch.stack([run.idle for run in runs]).all(0),
        cost,
        max(errors, default=None),
        metadata,
    )
