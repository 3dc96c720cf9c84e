"""Before a white-box attack: is the gradient that it will follow the gradient of its loss?"""

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

    A detector that is a module, or one behind a defence, is copied and asked in float64, so that a step may be small
    enough not to cross the kinks of its activations; any other is asked as it is, with a larger step. A defence that
    rounds or draws is left out.

    Args:
        victim: What will be attacked; its costs do not count.

    Returns:
        The largest relative error over the images; losses whose target is detached, as in the source of YOLOv5, are
        known to differ by up to a fifth.

    Raises:
        ConfigError: There is no gradient, or it is further from the truth than half its length: of the wrong sign, cut
            off from a part of the detector, or masked.
    """
    error = _error(victim)
    if error > WRONG:
        raise ConfigError(
            f"the gradient of loss '{victim.objective.name}' of {victim.detector.name} is wrong: it differs from "
            f"finite differences by {error:.0%} (see ssad.detectors.check.check_detector)"
        )
    return error


def _error(victim: Victim) -> float:
    victim = _without_stairs(victim)
    exact = _doubled(victim.detector)
    asked = victim if exact is None else _in_double(victim, exact)
    step = COARSE if exact is None else STEP
    _, gradient = asked.gradient(asked.clean)
    size = gradient.flatten(1).norm(dim=1)
    some = (size > 0) & ~victim.idle
    if not bool(some.any()):
        raise ConfigError(
            f"the gradient of loss '{victim.objective.name}' of {victim.detector.name} is 0 everywhere: it is cut off, "
            "or the loss is flat at the clean images"
        )
    direction = gradient / size.clamp_min(1e-30)[:, None, None, None]
    rise = asked.loss(asked.clean + step * direction) - asked.loss(asked.clean - step * direction)
    wrong = (rise / (2 * step) - size).abs() / size.clamp_min(1e-30)
    return float(wrong[some].max())


def _without_stairs(victim: Victim) -> Victim:
    """Without a defence that is not smooth: finite differences say nothing about the slope across its stairs."""
    found = copy.copy(victim)
    found.cost, found.precision = copy.copy(victim.cost), "float32"
    if not getattr(victim.through, "smooth", True):
        found.through = None
    if not getattr(getattr(victim.detector, "defence", None), "smooth", True):
        bare: Any = victim.detector
        found.detector = bare.detector
        found.situation = replace(victim.situation, detector=bare.detector)
    return found


def _doubled(detector: Any) -> Any:
    """A copy of a detector in float64, behind its defence if it has one; None if it is no module."""
    if isinstance(detector, Defended):
        inner = _doubled(detector.detector)
        return None if inner is None else Defended(inner, detector.defence)
    return copy.deepcopy(detector).double() if isinstance(detector, nn.Module) else None


def _in_double(victim: Victim, detector: Any) -> Victim:
    """The same questions to a copy of the detector in float64."""
    found = copy.copy(victim)
    found.detector = detector
    found.clean = victim.clean.double()
    found.intrinsic = None if victim.intrinsic is None else victim.intrinsic.double()
    found.cost = copy.copy(victim.cost)
    frozen = victim.situation.assignment
    assignment = Assignment(
        frozen.label,
        frozen.owner,
        tuple(_double(one) for one in frozen.truth),
        {name: _wide(value) for name, value in frozen.extra.items()},
    )
    found.situation = type(victim.situation)(detector, assignment, victim.situation.aim)
    return found


def _wide(value: Tensor) -> Tensor:
    return value.double() if value.is_floating_point() else value


def _double(truth: Truth) -> Truth:
    solid = truth.solid
    if solid is not None:
        solid = Solids(
            _wide(solid.centre), _wide(solid.size_lhw), _wide(solid.yaw), _wide(solid.velocity), solid.attribute
        )
    lens = None if truth.intrinsic is None else _wide(truth.intrinsic)
    return Truth(truth.label, _wide(truth.box), solid, lens, truth.crowd)
