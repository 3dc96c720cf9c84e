"""Several attacks on the same pictures, of which each picture keeps the worst for the detector."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ssad.core.detections import Detections, Truth
from ssad.core.errors import ConfigError
from ssad.core.protocols import Detector
from ssad.scenarios.static.digital.attack import Access, Attack, Attacked, run_attack
from ssad.scenarios.static.digital.budget import LEVELS, Budget
from ssad.scenarios.static.digital.image_quality import Quality, image_quality, of_aim
from ssad.scenarios.static.digital.objectives import EVERYTHING, Aim, Objective
from ssad.scenarios.static.digital.victim import Cost, Through, steady

Judge = Callable[[Detections, Truth], Quality]


@dataclass(frozen=True, slots=True)
class Ensemble:
    """Attacks, each with the loss that it ascends: losses cannot be compared, so what is detected decides.

    Attributes:
        members: An attack and its loss (or the name of one), for each.

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
        """What the member asks for that asks for most."""
        asked = {attack.access for attack, _ in self.members}
        return "white-box" if "white-box" in asked else "black-box" if "black-box" in asked else "none"


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
) -> Attacked:
    """Attack a batch with every member and keep for each image the one that leaves least, after the 8-bit round trip.

    What is left of an image is judged by what is detected in it (`image_quality`). Of members that leave the same, the
    one whose false detections have the higher scores wins; of those that are equal in this too, the first.

    Args:
        ensemble: The attacks and their losses.
        detector: What is attacked.
        images: [B, 3, H, W] float in [0, 1], multiples of 1/255.
        truth: What is in each image.
        budget: How far each may be moved.
        intrinsic: [B, 3, 3], for 3D.
        aim: Which objects are attacked; all others count as crowd where images are judged.
        keys: What the random draws of each image come from.
        through: A defence that every picture passes, which the attacks know.
        check: Compare gradients with finite differences first.
        threshold: Least score of a detection; None: the detector's own.
        judge: What scores the detections of an image; default: `image_quality`.

    Returns:
        The worst images. `before` and `after` are 1 less the quality of the clean and the attacked image; `idle`:
        where no member had anything to attack; costs are the sums of all members', and one query
        more for each, to judge it. `about` has the names of the
        members and their losses ("members"), for each image the number of the one that won ("won") and the quality
        that each member leaves ("quality" [B][M], the clean one's in "clean_quality").

    Raises:
        ConfigError: See `run_attack`.
    """

    def judged(pictures: Tensor) -> list[Quality]:
        with steady(detector), torch.no_grad():
            shown = pictures if through is None else through(pictures)
            found = detector.predict(shown, intrinsic, threshold=threshold)
        pairs = zip(found, (of_aim(one, aim, detector.classes) for one in truth), strict=True)
        if judge is not None:
            return [judge(*pair) for pair in pairs]
        many = len(detector.classes)
        return [image_quality(*pair, task=detector.task, classes=many) for pair in pairs]

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
    left = [judged(run.images) for run in runs]
    clean = judged(images)
    won = [min(range(len(runs)), key=lambda m: left[m][k].order) for k in range(len(images))]
    cost = Cost(sum(run.cost.gradients for run in runs), sum(run.cost.queries + 1 for run in runs))
    errors = [run.gradient_error for run in runs if run.gradient_error is not None]
    about: dict[str, Any] = {
        "attack": ensemble.name,
        "access": ensemble.access,
        "loss": "quality",
        "norm": budget.norm,
        "radius_px": round(budget.radius * LEVELS, 6),
        "gradients": cost.gradients,
        "queries": cost.queries,
        "members": [f"{run.about['attack']}/{run.about['loss']}" for run in runs],
        "won": won,
        "quality": [[member[k].value for member in left] for k in range(len(images))],
        "clean_quality": [one.value for one in clean],
    }
    return Attacked(
        torch.stack([runs[m].images[k] for k, m in enumerate(won)]),
        images.new_tensor([1 - one.value for one in clean]),
        images.new_tensor([1 - left[m][k].value for k, m in enumerate(won)]),
        torch.stack([run.idle for run in runs]).all(0),
        cost,
        max(errors, default=None),
        about,
    )
