"""Strength checks of an attack on a few images, against noise, a single step and a reference attack.

A weak attack makes a detector look robust. Usual faults: steps too small to cross the ball, a loss on boxes that
survived suppression, a gradient that is cut off or has the wrong sign, a loss that couples the images of a batch,
and a budget that is exceeded and then repaired by rounding.
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

LOSS_SLACK = 0.02  # share of the rise of the loss that an attack may lack beside another
PRECISION_SLACK = 0.1  # average precision that it may leave beyond what the reference leaves


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
    """Return the faults of an attack, one sentence each; the list is empty for a sound attack.

    Args:
        attack: Attack to check. One that takes more than one gradient is also compared with PGD on the loss
            `margin` with as many steps.
        detector: Detector under attack; it should detect most of the objects.
        images: [B, 3, H, W], two or more.
        truth: Ground truth of each image.
        budget: Budget of the check.
        objective: Loss to ascend, or its name.
        intrinsic: [B, 3, 3], for 3D.

    Raises:
        ConfigError: Fewer than two images.
    """
    if len(images) < 2:
        raise ConfigError("an attack is tried on two images or more")
    loss_function = make_objective(objective) if isinstance(objective, str) else objective
    faults: list[str] = []
    try:
        result = run_attack(attack, detector, images, truth, budget, objective=loss_function, intrinsic=intrinsic)
    except ConfigError as error:
        return [str(error)]
    with steady(detector):
        faults += _budget_faults(attack, Victim(detector, images, truth, loss_function, intrinsic=intrinsic), budget)
    faults += _batch_faults(attack, detector, images, truth, budget, loss_function, intrinsic)
    loss_increase = result.after - result.before
    baselines: list[Attack] = [RandomNoise()] + ([FGSM()] if result.cost.gradients > 1 else [])
    for baseline in baselines:
        baseline_result = run_attack(
            baseline, detector, images, truth, budget, objective=loss_function, intrinsic=intrinsic, check=False
        )
        baseline_increase = baseline_result.after - baseline_result.before
        if float(loss_increase.mean()) < float(baseline_increase.mean()) - LOSS_SLACK * abs(
            float(baseline_increase.mean())
        ):
            faults.append(
                f"it raises the loss by {float(loss_increase.mean()):.3g}, {baseline.name} of the same budget by "
                f"{float(baseline_increase.mean()):.3g}"
            )
    if result.cost.gradients > 1:
        # A strong loss with the same number of gradients bounds what a sound attack should reach.
        reference = run_attack(
            PGD(result.cost.gradients),
            detector,
            images,
            truth,
            budget,
            objective=Margin(),
            intrinsic=intrinsic,
            check=False,
        )
        attack_quality, reference_quality = (
            remaining_quality(detector, attack_result.images, truth, intrinsic) for attack_result in (result, reference)
        )
        if attack_quality > reference_quality + PRECISION_SLACK:
            faults.append(
                f"it leaves an average precision of {attack_quality:.0%}, PGD on the loss margin "
                "with as many steps leaves "
                f"{reference_quality:.0%}"
            )
    return faults


def _budget_faults(attack: Attack, victim: Victim, budget: Budget) -> list[str]:
    """Return violations of the budget and of the range [0, 1] before any rounding."""
    perturbed = attack.perturb(victim, budget)
    change = perturbed - victim.clean
    size = float(change.abs().max() if budget.norm == "linf" else lengths(change).max())
    faults = []
    if size > budget.radius * (1 + 1e-4) + 1e-6:
        faults.append(f"it moves images by {size * LEVELS:.4g} px, the budget is {budget.radius * LEVELS:.4g}")
    if bool(((perturbed < 0) | (perturbed > 1)).any()):
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
    """Return faults of an attack that treats an image differently alone and within a batch."""
    faults, losses = [], {}
    for count in (1, len(images)):
        batch_intrinsic = None if intrinsic is None else intrinsic[:count]
        with steady(detector):
            victim = Victim(detector, images[:count], truth[:count], objective, intrinsic=batch_intrinsic)
            clean_alone = float(victim.loss(victim.clean)[0])
            losses[count] = clean_alone, float(victim.loss(attack.perturb(victim, budget))[0])
    (clean_alone, attacked_alone), (clean_in_batch, attacked_in_batch) = losses.values()
    size = max(abs(clean_alone), abs(attacked_alone - clean_alone), 1e-6)
    if abs(clean_alone - clean_in_batch) > 1e-3 * size:
        faults.append("the loss of an image depends on the other images of its batch")
    elif abs(attacked_alone - attacked_in_batch) > 0.05 * size:
        faults.append("what becomes of an image depends on the other images of its batch")
    return faults


def remaining_quality(detector: Detector, images: Tensor, truth: Sequence[Truth], intrinsic: Tensor | None) -> float:
    """Return the mean `image_quality` of a detector over images, 0 to 1."""
    detections = detector.predict(images, intrinsic)
    matches = zip(detections, truth, strict=True)
    values = [image_quality(*match, task=detector.task, classes=len(detector.classes)).value for match in matches]
    return sum(values) / len(values)


def is_within_budget(images: Tensor, clean: Tensor, budget: Budget) -> bool:
    """Check that stored images keep to a budget around clean ones, in whole code values."""
    change = codes_of(images).double() - codes_of(clean).double()
    limit = budget.radius * LEVELS
    if budget.norm == "linf":
        # The tolerance covers radii such as 5 / 255 that floats do not hold exactly.
        return float(change.abs().max()) <= limit + 1e-9
    return bool(((change**2).flatten(1).sum(1) <= limit**2 * (1 + 1e-9)).all())
