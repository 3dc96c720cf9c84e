"""Reference ensemble: fixed attacks with the loss, budget and number of gradients of an attack that is judged by them.

An attack that leaves a lower loss or a higher score than these does not show what its budget allows, so a detector
looks robust that is not (Carlini et al., On Evaluating Adversarial Robustness, 2019, section 4.3). Attacks without
gradients (noise, universal changes, black-box and transfer attacks) and the attack `cw-min`, which seeks the smallest
change, are not judged.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from torch import Tensor

from ssad.core.detections import Truth
from ssad.core.errors import ConfigError
from ssad.core.protocols import Detector
from ssad.scenarios.static.digital.apgd import APGD
from ssad.scenarios.static.digital.attack import Attack, AttackResult, run_attack
from ssad.scenarios.static.digital.budget import Budget
from ssad.scenarios.static.digital.cw import MinimalCW
from ssad.scenarios.static.digital.image_quality import image_quality
from ssad.scenarios.static.digital.objectives import EVERYTHING, Aim
from ssad.scenarios.static.digital.pgd import PGD
from ssad.scenarios.static.digital.square import Square
from ssad.scenarios.static.digital.victim import Precision

REFERENCE_IMAGES = 20  # images of a run that the ensemble attacks as well
QUERIES_PER_GRADIENT = 10  # queries of Square for each gradient of the judged attack
_CACHE_SIZE = 100_000  # images whose reference results a process keeps
_CACHE: dict[tuple[Any, ...], Mapping[str, list[float]]] = {}  # of this process


def is_judged(attack: Attack) -> bool:
    """Return True if an attack is compared with the reference ensemble: it follows gradients within a budget."""
    return attack.access == "white-box" and not isinstance(attack, MinimalCW)


def reference_attacks(gradients: int) -> tuple[Attack, ...]:
    """Return the members of the ensemble: PGD, APGD and Square.

    Args:
        gradients: Gradients per image of the judged attack. PGD and APGD take as many; APGD needs two at least.
            Square takes `QUERIES_PER_GRADIENT` times as many queries.
    """
    members: list[Attack] = [PGD(gradients), Square(queries=QUERIES_PER_GRADIENT * gradients)]
    if gradients > 1:
        members.insert(1, APGD(gradients))  # few steps weaken this member alone: the strongest one is the reference
    return tuple(members)


def compare_with_references(
    result: AttackResult,
    detector: Detector,
    images: Tensor,
    truth: Sequence[Truth],
    budget: Budget,
    *,
    objective: str,
    keys: Sequence[tuple[object, ...]],
    intrinsic: Tensor | None = None,
    aim: Aim = EVERYTHING,
    precision: Precision = "float32",
    gradients: int | None = None,
    with_draws: Callable[[Attack], Attack] = lambda attack: attack,
    cache_key: tuple[Any, ...] | None = None,
) -> list[dict[str, Any]]:
    """Attack images with the reference ensemble, and return the effect of both attacks on each.

    Args:
        result: Result of the judged attack on these images.
        detector: Detector under attack.
        images: [B, 3, H, W], clean.
        truth: Ground truth of each image.
        budget: Budget of the judged attack.
        objective: Name of its loss.
        keys: Random keys of the images; the ensemble draws other numbers than the judged attack.
        intrinsic: [B, 3, 3], for 3D.
        aim: Objects under attack.
        precision: Precision of its gradients.
        gradients: Gradients per image and draw; None: those of `result`.
        with_draws: Makes a member know a random defence, as the judged attack does.
        cache_key: Detector, data and aim as a key, under which the results are kept for further attacks with the same
            loss, budget and number of gradients; None: they are not kept.

    Returns:
        For each image: loss_before, loss and quality under the judged attack, and `references`: loss and quality
        [2] under each member, by its name. The quality is the mean average precision of the image (see
        `image_quality`).
    """
    count = result.cost.gradients if gradients is None else gradients
    if count < 1:
        raise ConfigError(f"the attack took no gradients ({result.about}), so there is nothing to compare it with")
    setting = (objective, budget.norm, budget.radius, count, precision)
    members: list[dict[str, list[float]]] = [{} for _ in keys]
    cache_keys = [(*(cache_key or ()), *setting, key) for key in keys]
    if cache_key is not None and all(key in _CACHE for key in cache_keys):
        members = [dict(_CACHE[key]) for key in cache_keys]
    else:
        for member in reference_attacks(count):
            reference = run_attack(
                with_draws(member),
                detector,
                images,
                truth,
                budget,
                objective=objective,
                intrinsic=intrinsic,
                aim=aim,
                keys=[(*key, "reference") for key in keys],
                precision=precision,
                check=False,
            )
            qualities = _qualities(detector, reference.images, truth, intrinsic)
            for image_members, loss, quality in zip(members, reference.after.tolist(), qualities, strict=True):
                image_members[member.name] = [_rounded(loss), _rounded(quality)]
        if cache_key is not None:
            if len(_CACHE) > _CACHE_SIZE:
                _CACHE.clear()
            _CACHE.update(zip(cache_keys, members, strict=True))
    attacked_qualities = _qualities(detector, result.images, truth, intrinsic)
    columns = zip(result.before.tolist(), result.after.tolist(), attacked_qualities, members, strict=True)
    return [
        {
            "loss_before": _rounded(before),
            "loss": _rounded(after),
            "quality": _rounded(quality),
            "references": image_members,
        }
        for before, after, quality, image_members in columns
    ]


def _qualities(detector: Detector, images: Tensor, truth: Sequence[Truth], intrinsic: Tensor | None) -> list[float]:
    detections = detector.predict(images, intrinsic)
    return [
        image_quality(image_detections, image_truth, task=detector.task, classes=len(detector.classes)).value
        for image_detections, image_truth in zip(detections, truth, strict=True)
    ]


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")
