"""Is an attack as strong as it claims? Tried out on a few images, beside noise, a single step and a reference attack.

A weak attack makes a detector look robust. The usual faults: steps too small to cross the ball, a loss of boxes that
survived suppression, a gradient that is cut off or of the wrong sign, a loss in which the images of a batch share, a
budget that is broken and mended by rounding.
"""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from ssad.core.detections import Truth
from ssad.core.errors import ConfigError
from ssad.core.protocols import Detector
from ssad.scenarios.static.digital.attack import Attack, run_attack
from ssad.scenarios.static.digital.budget import LEVELS, Budget, codes_of, lengths
from ssad.scenarios.static.digital.fgsm import FGSM
from ssad.scenarios.static.digital.image_quality import image_quality
from ssad.scenarios.static.digital.noise import RandomNoise
from ssad.scenarios.static.digital.objectives import Margin, Objective, make_objective
from ssad.scenarios.static.digital.pgd import PGD
from ssad.scenarios.static.digital.victim import Victim, steady

SLACK = 0.02  # share of the rise of the loss that an attack may lack beside another
BESIDE = 0.1  # average precision that it may leave beyond what the reference leaves


def find_weaknesses(
    attack: Attack,
    detector: Detector,
    images: Tensor,
    truth: Sequence[Truth],
    budget: Budget,
    *,
    objective: str | Objective = "full",
    intrinsic: Tensor | None = None,
) -> list[str]:
    """Faults of an attack, a sentence each; none for a sound one.

    Args:
        attack: What is tried; one that asks for gradients more than once is also held to PGD on the loss `margin` with
            as many steps.
        detector: What it is tried on; it should find most of the objects.
        images: [B, 3, H, W], two or more.
        truth: What is in each image.
        budget: At which it is tried.
        objective: The loss that it ascends, or its name.
        intrinsic: [B, 3, 3], for 3D.

    Raises:
        ConfigError: Fewer than two images.
    """
    if len(images) < 2:
        raise ConfigError("an attack is tried on two images or more")
    ascended = make_objective(objective) if isinstance(objective, str) else objective
    faults: list[str] = []
    try:
        own = run_attack(attack, detector, images, truth, budget, objective=ascended, intrinsic=intrinsic)
    except ConfigError as error:
        return [str(error)]
    with steady(detector):
        faults += _budget_faults(attack, Victim(detector, images, truth, ascended, intrinsic=intrinsic), budget)
    faults += _batch_faults(attack, detector, images, truth, budget, ascended, intrinsic)
    rise = own.after - own.before
    others: list[Attack] = [RandomNoise()] + ([FGSM()] if own.cost.gradients > 1 else [])
    for other in others:
        beside = run_attack(
            other, detector, images, truth, budget, objective=ascended, intrinsic=intrinsic, check=False
        )
        theirs = beside.after - beside.before
        if float(rise.mean()) < float(theirs.mean()) - SLACK * abs(float(theirs.mean())):
            faults.append(
                f"it raises the loss by {float(rise.mean()):.3g}, {other.name} of the same budget by "
                f"{float(theirs.mean()):.3g}"
            )
    if own.cost.gradients > 1:
        reference = run_attack(
            PGD(own.cost.gradients),
            detector,
            images,
            truth,
            budget,
            objective=Margin(),
            intrinsic=intrinsic,
            check=False,
        )
        left, least = (quality_left(detector, one.images, truth, intrinsic) for one in (own, reference))
        if left > least + BESIDE:
            faults.append(
                f"it leaves an average precision of {left:.0%}, PGD on the loss margin with as many steps leaves "
                f"{least:.0%}"
            )
    return faults


def _budget_faults(attack: Attack, victim: Victim, budget: Budget) -> list[str]:
    """Whether what the attack finds, before anything is rounded, keeps to the budget and the range."""
    found = attack.perturb(victim, budget)
    change = found - victim.clean
    size = float(change.abs().max() if budget.norm == "linf" else lengths(change).max())
    faults = []
    if size > budget.radius * (1 + 1e-4) + 1e-6:
        faults.append(f"it moves images by {size * LEVELS:.4g} px, the budget is {budget.radius * LEVELS:.4g}")
    if bool(((found < 0) | (found > 1)).any()):
        faults.append("it leaves the range of images, [0, 1]")
    return faults


def _batch_faults(  # noqa: PLR0917
    attack: Attack,
    detector: Detector,
    images: Tensor,
    truth: Sequence[Truth],
    budget: Budget,
    objective: Objective,
    intrinsic: Tensor | None,
) -> list[str]:
    """Whether an image fares the same alone as beside others."""
    faults, losses = [], {}
    for count in (1, len(images)):
        lens = None if intrinsic is None else intrinsic[:count]
        with steady(detector):
            victim = Victim(detector, images[:count], truth[:count], objective, intrinsic=lens)
            clean = float(victim.loss(victim.clean)[0])
            losses[count] = clean, float(victim.loss(attack.perturb(victim, budget))[0])
    (clean, alone), (clean_beside, beside) = losses.values()
    size = max(abs(clean), abs(alone - clean), 1e-6)
    if abs(clean - clean_beside) > 1e-3 * size:
        faults.append("the loss of an image depends on the other images of its batch")
    elif abs(alone - beside) > 0.05 * size:
        faults.append("what becomes of an image depends on the other images of its batch")
    return faults


def quality_left(detector: Detector, images: Tensor, truth: Sequence[Truth], intrinsic: Tensor | None) -> float:
    """Mean over images of what a detector still gets right of each (see `image_quality`), 0 to 1."""
    found = detector.predict(images, intrinsic)
    pairs = zip(found, truth, strict=True)
    values = [image_quality(*pair, task=detector.task, classes=len(detector.classes)).value for pair in pairs]
    return sum(values) / len(values)


def within(images: Tensor, clean: Tensor, budget: Budget) -> bool:
    """Whether stored images keep to a budget around clean ones, in whole code values."""
    change = codes_of(images).double() - codes_of(clean).double()
    limit = budget.radius * LEVELS
    if budget.norm == "linf":
        return float(change.abs().max()) <= limit + 1e-9
    return bool(((change**2).flatten(1).sum(1) <= limit**2 * (1 + 1e-9)).all())
