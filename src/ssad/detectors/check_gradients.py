"""Part of `ssad.detectors.check`: gradients that are those of the outputs, losses that fall for what is true."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from ssad.core.detections import Assignment, Dense, Truth
from ssad.detectors.check_cases import CheckCase, noise

# How far the pixel with the largest gradient moves. A kink in the way or rounding spoils one of these, not all.
STEPS = (1e-3, 1e-4, 1e-2)
# Sources detach parts of their losses (YOLOv5: the overlap that objectness is to tell), which on fresh weights makes
# the finite difference twice what the gradient says.
ROUGHLY = 4.0
ROUNDING = 1e-5  # share of a value below which its changes drown in float32
LEVELS = (0.21, 0.47, 0.78)  # grey values in the middle between the steps of coarse quantisation
SMALL, LARGE = 0.5 / 255, 0.1  # changes of a grey picture: below and above such a step


def check_slopes(trial: CheckCase) -> None:
    """Outputs and losses rise along their gradients by what these say, and all that changes them has a gradient."""
    images = trial.images(1).requires_grad_()
    dense = trial.dense(images)
    assignment = trial.detector.assign(dense, trial.truth((2,)))
    values = _values(trial, dense, assignment)

    def at(pictures: Tensor) -> dict[str, Tensor]:
        with torch.no_grad():
            return _values(trial, trial.dense(pictures.to(images.dtype)), assignment)

    clean = images.detach()
    shaken = []
    for channel in range(3):
        moved = clean.clone()
        moved[:, channel : channel + 1] += noise(moved[:, :1], 0.05)
        shaken.append(at(moved.clamp(0, 1)))
    for name, value in values.items():
        gradient = _gradient(value, images)
        if not bool(gradient.isfinite().all()):
            continue  # told elsewhere
        silent = [not bool(gradient[:, channel].any()) for channel in range(3)]
        lost = [off and _differs(other[name], value) for off, other in zip(silent, shaken, strict=True)]
        if all(silent):
            trial.need(not any(lost), f"the gradient of {name} reaches the image, which {name} depends on")
            continue
        trial.need(not any(lost), f"the gradient of {name} reaches all three colour channels")
        ratio = _mismatch(gradient, clean, lambda pictures, name=name: at(pictures)[name])  # type: ignore[misc]
        if ratio is not None:
            told = f"the gradient of {name} has the sign and roughly the size of its finite differences"
            trial.need(False, f"{told} (these are {ratio:.2g} times what it says)")


def _values(trial: CheckCase, dense: Dense, assignment: Assignment) -> dict[str, Tensor]:
    """A number for each output and each loss, for one image."""
    box = dense.box / max(trial.size)
    parts: dict[str, Tensor | None] = {"Dense.logit": dense.logit, "Dense.box": box, "Dense.quality": dense.quality}
    found = {name: part.double().square().mean() for name, part in parts.items() if part is not None}
    losses = trial.detector.losses(dense, assignment)
    return found | {f'losses["{name}"]': loss.double().sum() for name, loss in losses.items()}


def _gradient(value: Tensor, images: Tensor) -> Tensor:
    """The gradient to the images, zeros where there is none."""
    if not value.requires_grad:
        return torch.zeros_like(images)
    (gradient,) = torch.autograd.grad(value, images, retain_graph=True, materialize_grads=True)
    return gradient


def _differs(other: Tensor, value: Tensor) -> bool:
    """Whether a value has changed by more than rounding."""
    return bool((other - value).abs() > 10 * ROUNDING * value.abs())


def _mismatch(gradient: Tensor, images: Tensor, value: Callable[[Tensor], Tensor]) -> float | None:
    """Finite differences along the gradient as a share of what it says; None: they agree, or cannot be measured."""
    way = gradient.double() / gradient.abs().max()
    slope = float((gradient * way).sum())
    told = None
    for step in STEPS:
        ahead, behind = (float(value(images + sign * step * way)) for sign in (1, -1))
        if 2 * step * slope < ROUNDING * (abs(ahead) + abs(behind)) / 2:
            continue
        ratio = (ahead - behind) / (2 * step * slope)
        if 1 / ROUGHLY < ratio < ROUGHLY:
            return None
        told = ratio if told is None else told
    return told


def check_small_changes(trial: CheckCase) -> None:
    """What changes a picture by half a step of 8 bits changes the outputs: attacks live on such changes."""
    for level in LEVELS:
        grey = torch.full_like(trial.images(1), level)
        change = noise(grey, 1.0)
        with torch.no_grad():
            logit = trial.dense(torch.cat([grey, grey + SMALL * change, grey + LARGE * change])).logit.double()
        small, large = (logit[1] - logit[0]).norm(), (logit[2] - logit[0]).norm()
        if bool(large > ROUNDING * logit[0].norm()):  # else hardly anything changes it, as with some fresh weights
            kept = bool(small > 0.02 * SMALL / LARGE * large)
            trial.need(kept, "changes of half a step of 8 bits change Dense.logit: the image is not quantised inside")


def check_loss_signs(trial: CheckCase) -> None:
    """Losses are large for what is wrong."""
    detector = trial.detector
    with torch.no_grad():
        dense = trial.dense(trial.images())
        truth = trial.truth((2, 1, 1))
        owned = detector.assign(dense, truth)
        right, wrong = (_labelled(dense, owned, truth, largest=largest) for largest in (True, False))
        found = [
            {name: float(v.sum()) for name, v in detector.losses(dense, detector.assign(dense, one)).items()}
            for one in (right, wrong, truth, trial.truth((0, 0, 0)))
        ]
    for name in found[0]:
        seen = [one[name] for one in found]
        turned = min(seen) < 0 and max(seen) <= 0
        trial.need(not turned, f'losses["{name}"] rises above 0 when the truth is wrong (is its sign turned?)')
    low, high = (sum(one.values()) for one in found[:2])
    rises = high >= low - 0.005 * abs(low)  # some parts may depend on the class in another way, a little
    trial.need(rises, "the losses are lower for the classes that Dense.logit favours than for those it does not")


def _labelled(dense: Dense, owned: Assignment, truth: list[Truth], *, largest: bool) -> list[Truth]:
    """The truth with the classes whose logits are largest (or least) at the places that answer for each object."""
    changed = []
    for k, one in enumerate(truth):
        labels = []
        for row in range(len(one.label)):
            mine = owned.owner[k] == row
            mean = dense.logit[k][mine if bool(mine.any()) else slice(None)].double().mean(0)
            labels.append(int(mean.argmax() if largest else mean.argmin()))
        changed.append(replace(one, label=torch.tensor(labels, device=one.label.device, dtype=one.label.dtype)))
    return changed
