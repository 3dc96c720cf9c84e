"""Check before a white-box attack: the gradient that it follows must be the gradient of its loss."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

from torch import Tensor, nn

from ssad.core.detections import Assignment, Solids, Truth
from ssad.core.errors import ConfigError
from ssad.scenarios.static.digital.defences import Defended
from ssad.scenarios.static.digital.victim import Victim

WRONG = 0.5  # relative error beyond which an attack is refused
STEP = 1e-4  # Euclidean length of the step to either side, in float64
COARSE = 0.05  # the same for a detector that computes in float32 only


def check_gradient(victim: Victim) -> float:
    """Compare the slope along the gradient of each image's loss with central finite differences.

    A detector that is a module, or one behind a defence, is copied to float64, so that a step may be small enough not
    to cross the kinks of its activations; any other is queried as it is, with a larger step. A defence that rounds or
    draws is left out.

    Args:
        victim: Victim of the attack; the check does not count towards its costs.

    Returns:
        The largest relative error over the images; losses whose target is detached, as in the source of YOLOv5, are
        known to differ by up to a fifth.

    Raises:
        ConfigError: There is no gradient, or its error exceeds half its length: it has the wrong sign, is cut off
            from a part of the detector, or masked.
    """
    error = _gradient_error(victim)
    if error > WRONG:
        raise ConfigError(
            f"the gradient of loss '{victim.objective.name}' of {victim.detector.name} is wrong: it differs from "
            f"finite differences by {error:.0%} (see ssad.detectors.check.check_detector)"
        )
    return error


def _gradient_error(victim: Victim) -> float:
    victim = _without_rounding(victim)
    double_detector = _to_float64(victim.detector)
    checked_victim = victim if double_detector is None else _victim_in_float64(victim, double_detector)
    step = COARSE if double_detector is None else STEP
    _, gradient = checked_victim.gradient(checked_victim.clean)
    slope = gradient.flatten(1).norm(dim=1)
    is_checked = (slope > 0) & ~victim.idle
    if not bool(is_checked.any()):
        raise ConfigError(
            f"the gradient of loss '{victim.objective.name}' of {victim.detector.name} is 0 everywhere: it is cut off, "
            "or the loss is flat at the clean images"
        )
    direction = gradient / slope.clamp_min(1e-30)[:, None, None, None]
    loss_difference = checked_victim.loss(checked_victim.clean + step * direction) - checked_victim.loss(
        checked_victim.clean - step * direction
    )
    relative_error = (loss_difference / (2 * step) - slope).abs() / slope.clamp_min(1e-30)
    return float(relative_error[is_checked].max())


def _without_rounding(victim: Victim) -> Victim:
    """Remove a defence that is not smooth: finite differences do not measure its slope."""
    smooth_victim = copy.copy(victim)
    smooth_victim.cost, smooth_victim.precision = copy.copy(victim.cost), "float32"
    if not getattr(victim.through, "smooth", True):
        smooth_victim.through = None
    if not getattr(getattr(victim.detector, "defence", None), "smooth", True):
        defended: Any = victim.detector
        smooth_victim.detector = defended.detector
        smooth_victim.situation = replace(victim.situation, detector=defended.detector)
    return smooth_victim


def _to_float64(detector: Any) -> Any:
    """Copy a detector to float64, behind its defence if it has one; None if it is no module."""
    if isinstance(detector, Defended):
        inner = _to_float64(detector.detector)
        return None if inner is None else Defended(inner, detector.defence)
    return copy.deepcopy(detector).double() if isinstance(detector, nn.Module) else None


def _victim_in_float64(victim: Victim, detector: Any) -> Victim:
    """Return the victim with a float64 copy of the detector and float64 inputs."""
    double_victim = copy.copy(victim)
    double_victim.detector = detector
    double_victim.clean = victim.clean.double()
    double_victim.intrinsic = None if victim.intrinsic is None else victim.intrinsic.double()
    double_victim.cost = copy.copy(victim.cost)
    original = victim.situation.assignment
    assignment = Assignment(
        original.label,
        original.owner,
        tuple(_truth_to_float64(image_truth) for image_truth in original.truth),
        {name: _widen(value) for name, value in original.extra.items()},
    )
    double_victim.situation = type(victim.situation)(detector, assignment, victim.situation.aim)
    return double_victim


def _widen(value: Tensor) -> Tensor:
    return value.double() if value.is_floating_point() else value


def _truth_to_float64(truth: Truth) -> Truth:
    solid = truth.solid
    if solid is not None:
        solid = Solids(
            _widen(solid.centre), _widen(solid.size_lhw), _widen(solid.yaw), _widen(solid.velocity), solid.attribute
        )
    intrinsic = None if truth.intrinsic is None else _widen(truth.intrinsic)
    return Truth(truth.label, _widen(truth.box), solid, intrinsic, truth.crowd)
