"""Part of `ssad.detectors.check`: gradients that are those of the outputs, losses that fall for what is true."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from ssad.core.detections import Assignment, Dense, Truth
from ssad.detectors.check_cases import BATCH, CheckCase, noise

# How far the pixel with the largest gradient moves. A kink in the way or rounding spoils one of these, not all.
STEPS = (1e-3, 1e-4, 1e-2)
ROUGHLY = 4.0  # factor between a gradient and finite differences that is no fault
ROUNDING = 1e-5  # share of a value below which its changes drown in float32
LEVELS = (0.21, 0.47, 0.78)  # grey values in the middle between the steps of coarse quantisation
SMALL, LARGE = 0.5 / 255, 0.1  # changes of a grey picture: below and above such a step


def check_slopes(trial: CheckCase) -> None:
    """Outputs and losses rise along their gradients by what these say, and all that changes them has a gradient.

    Sources leave parts of a loss without gradient (YOLOv5: the overlap that objectness is to tell), which sets finite
    differences off; but not those of a picture without objects. What is wrong is wrong for every picture.
    """
    first = _Probe(trial, 0)
    shaken = []
    for channel in range(3):
        moved = first.images.clone()
        moved[:, channel : channel + 1] += noise(moved[:, :1], 0.05)
        shaken.append(first.at(moved.clamp(0, 1)))
    probes = [first]
    for name, value in first.values.items():
        gradient = first.gradient(name)
        silent = [not bool(gradient[:, channel].any()) for channel in range(3)]
        lost = [off and _differs(other[name], value) for off, other in zip(silent, shaken, strict=True)]
        if all(silent):
            trial.need(not any(lost), f"the gradient of {name} reaches the image, which {name} depends on")
            continue
        trial.need(not any(lost), f"the gradient of {name} reaches all three colour channels")
        ratios: list[float] = []
        for number in range(BATCH):
            if number == len(probes):
                probes.append(_Probe(trial, number))
            ratio = probes[number].ratio(name)
            if math.isfinite(ratio):
                ratios.append(ratio)
            if 1 / ROUGHLY < ratio < ROUGHLY:
                break
        agrees = not ratios or 1 / ROUGHLY < ratios[-1] < ROUGHLY
        told = f"the gradient of {name} has the sign and roughly the size of its finite differences"
        trial.need(agrees, f"{told} (these are {ratios[-1] if ratios else 1:.2g} times what it says)")


class _Probe:
    """A picture with all that can be differentiated: a number for each output and each loss."""

    def __init__(self, trial: CheckCase, number: int) -> None:
        self.trial = trial
        self.images = trial.images()[number : number + 1]
        self.leaf = self.images.clone().requires_grad_()
        dense = trial.dense(self.leaf)
        self.assignment = trial.detector.assign(dense, trial.truth(((2, 0, 1)[number],)))
        self.values = self._values(dense)

    def _values(self, dense: Dense) -> dict[str, Tensor]:
        box = dense.box / max(self.trial.size)
        parts: dict[str, Tensor | None] = {"Dense.logit": dense.logit, "Dense.box": box, "Dense.quality": dense.quality}
        found = {name: part.double().square().mean() for name, part in parts.items() if part is not None}
        losses = self.trial.detector.losses(dense, self.assignment)
        return found | {f'losses["{name}"]': loss.double().sum() for name, loss in losses.items()}

    def at(self, pictures: Tensor) -> dict[str, Tensor]:
        """The numbers for another picture and the same assignment."""
        with torch.no_grad():
            return self._values(self.trial.dense(pictures.to(self.images.dtype)))

    def gradient(self, name: str) -> Tensor:
        """The gradient to the picture, zeros where there is none."""
        if not self.values[name].requires_grad:
            return torch.zeros_like(self.images)
        (gradient,) = torch.autograd.grad(self.values[name], self.leaf, retain_graph=True, materialize_grads=True)
        return gradient

    def ratio(self, name: str) -> float:
        """Finite differences along the gradient as a share of what it says; NaN: they cannot be measured."""
        gradient = self.gradient(name).double()
        if not bool(gradient.isfinite().all() & gradient.any()):
            return math.nan  # told elsewhere
        way = gradient / gradient.abs().max()
        slope = float((gradient * way).sum())
        found = math.nan
        for step in STEPS:
            ahead, behind = (float(self.at(self.images + sign * step * way)[name]) for sign in (1, -1))
            if 2 * step * slope < ROUNDING * (abs(ahead) + abs(behind)) / 2:
                continue
            found = (ahead - behind) / (2 * step * slope)
            if 1 / ROUGHLY < found < ROUGHLY:
                break
        return found


def _differs(other: Tensor, value: Tensor) -> bool:
    """Whether a value has changed by more than rounding."""
    return bool((other - value).abs() > 10 * ROUNDING * value.abs())


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
