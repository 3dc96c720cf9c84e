"""Gradient part of `ssad.detectors.check`: gradients that match the outputs, losses that fall for the truth."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product

import torch
from torch import Tensor

from ssad.core.detections import Assignment, Dense, Truth
from ssad.detectors.check_cases import BATCH, CheckCase, noise

# Step of the pixel with the largest gradient. A kink on the path or rounding spoils one of these, not all.
STEPS = (1e-3, 1e-4, 1e-2)
ROUGHLY = 4.0  # tolerated factor between a gradient and finite differences
ROUNDING = 1e-5  # share of a value below which its changes drown in float32
LEVELS = (0.21, 0.47, 0.78)  # grey values in the middle between the steps of coarse quantisation
SMALL, LARGE = 0.5 / 255, 0.1  # changes of a grey picture: below and above such a step
RIPPLE_STEPS = (0.5 / 255, 1 / 255, 2 / 255)  # steps of attacks
RIPPLE_SHARE = 0.25  # change along the gradient, as a share of what its slope foretells, below which it is looked at
RIPPLE_DRAWS = 64  # images nearby whose gradients are averaged then
MAX_RIPPLE_RATIO = 0.5  # rise along the gradient, divided by that along the mean gradient, that counts as a ripple


def check_slopes(trial: CheckCase) -> None:
    """Check outputs and losses against finite differences along their gradients, in every colour channel.

    Sources leave parts of a loss without gradient (YOLOv5: the overlap as target of objectness), which disturbs
    finite differences, but not those of an image without objects. A wrong gradient is wrong for every image.
    """
    probe = _Probe(trial, 0)
    perturbed_values = []
    for channel in range(3):
        perturbed = probe.images.clone()
        perturbed[:, channel : channel + 1] += noise(perturbed[:, :1], 0.05)
        perturbed_values.append(probe.at(perturbed.clamp(0, 1)))
    probes = [probe]
    for name, value in probe.values.items():
        gradient = probe.gradient(name)
        silent_channels = [not bool(gradient[:, channel].any()) for channel in range(3)]
        lost_channels = [
            is_silent and _differs(channel_values[name], value)
            for is_silent, channel_values in zip(silent_channels, perturbed_values, strict=True)
        ]
        if all(silent_channels):
            trial.expect(
                not any(lost_channels),
                f"the gradient of {name} reaches the image, which {name} depends on (gradient masking: rounding or a "
                "detached tensor cuts it off)",
            )
            continue
        trial.expect(not any(lost_channels), f"the gradient of {name} reaches all three colour channels")
        ratios: list[float] = []
        for image_index in range(BATCH):
            if image_index == len(probes):
                probes.append(_Probe(trial, image_index))
            ratio = probes[image_index].ratio(name)
            if math.isfinite(ratio):
                ratios.append(ratio)
            if 1 / ROUGHLY < ratio < ROUGHLY:
                break
        agrees = not ratios or 1 / ROUGHLY < ratios[-1] < ROUGHLY
        promise = f"the gradient of {name} has the sign and roughly the size of its finite differences"
        trial.expect(agrees, f"{promise} (these are {ratios[-1] if ratios else 1:.2g} times what it says)")


class _Probe:
    """An image with all differentiable quantities: one number for each output and each loss."""

    def __init__(self, trial: CheckCase, number: int, change: Tensor | None = None) -> None:
        self.trial = trial
        self.images = trial.images()[number : number + 1]
        if change is not None:
            self.images = self.images + change
        self.differentiable_images = self.images.clone().requires_grad_()
        dense = trial.dense(self.differentiable_images)
        self.assignment = trial.detector.assign(dense, trial.truth(((2, 0, 1)[number],)))
        self.values = self._values(dense)

    def _values(self, dense: Dense) -> dict[str, Tensor]:
        box = dense.box / max(self.trial.size)
        named_outputs: dict[str, Tensor | None] = {
            "Dense.logit": dense.logit,
            "Dense.box": box,
            "Dense.quality": dense.quality,
        }
        outputs = {
            name: output.double().square().mean() for name, output in named_outputs.items() if output is not None
        }
        losses = self.trial.detector.losses(dense, self.assignment) if self.trial.has_losses else {}
        return outputs | {f'losses["{name}"]': loss.double().sum() for name, loss in losses.items()}

    def at(self, images: Tensor) -> dict[str, Tensor]:
        """Return the numbers for another image and the same assignment."""
        with torch.no_grad():
            return self._values(self.trial.dense(images.to(self.images.dtype)))

    def gradient(self, name: str) -> Tensor:
        """Return the gradient to the image; zeros where a number has none."""
        if not self.values[name].requires_grad:
            return torch.zeros_like(self.images)
        (gradient,) = torch.autograd.grad(
            self.values[name], self.differentiable_images, retain_graph=True, materialize_grads=True
        )
        return gradient

    def ratio(self, name: str) -> float:
        """Return the ratio of finite differences to the slope along the gradient; NaN if it cannot be measured."""
        gradient = self.gradient(name).double()
        if not bool(gradient.isfinite().all() & gradient.any()):
            return math.nan  # another check reports it
        direction = gradient / gradient.abs().max()
        slope = float((gradient * direction).sum())
        measured_ratio = math.nan
        for step in STEPS:
            value_ahead, value_behind = (
                float(self.at(self.images + sign * step * direction)[name]) for sign in (1, -1)
            )
            # The expected difference would drown in float32 rounding.
            if 2 * step * slope < ROUNDING * (abs(value_ahead) + abs(value_behind)) / 2:
                continue
            measured_ratio = (value_ahead - value_behind) / (2 * step * slope)
            if 1 / ROUGHLY < measured_ratio < ROUGHLY:
                break
        return measured_ratio


def _differs(changed: Tensor, value: Tensor) -> bool:
    """Return True if a value has changed by more than rounding."""
    return bool((changed - value).abs() > 10 * ROUNDING * value.abs())


def check_small_changes(trial: CheckCase) -> None:
    """Check that a change of half an 8-bit step changes the outputs; attacks live on such changes."""
    for grey_level in LEVELS:
        grey = torch.full_like(trial.images(1), grey_level)
        change = noise(grey, 1.0)
        with torch.no_grad():
            logit = trial.dense(torch.cat([grey, grey + SMALL * change, grey + LARGE * change])).logit.double()
        small_response, large_response = (logit[1] - logit[0]).norm(), (logit[2] - logit[0]).norm()
        if bool(
            large_response > ROUNDING * logit[0].norm()
        ):  # else hardly anything changes it, as with some fresh weights
            is_sensitive = bool(small_response > 0.02 * SMALL / LARGE * large_response)
            trial.expect(
                is_sensitive,
                "changes of half a step of 8 bits change Dense.logit: the image is not quantised inside (gradient "
                "masking by rounding)",
            )


def check_ripples(trial: CheckCase) -> None:
    """Check that the gradient of Dense.logit is of use to an attack whose steps are half a code value to two.

    A ripple finer than these steps turns the gradient from place to place, though finite differences agree with it
    everywhere. Two signs together tell it from a detector that is merely steep: a step along the gradient changes the
    output much less than its slope foretells, and a step along the mean gradient of many images nearby, in which the
    ripple cancels out, does at least twice as much. The fault must show in all images.
    """
    name, ratios = "Dense.logit", []
    for image_index in range(BATCH):
        probe = _Probe(trial, image_index)
        gradient = probe.gradient(name)
        slope = float(gradient.abs().sum())
        # A rise that would drown in float32 rounding says nothing.
        if 2 * RIPPLE_STEPS[0] * slope < 10 * ROUNDING * abs(float(probe.values[name].detach())):
            return
        shares = {step: _rise(probe, gradient, step, name) / (2 * step * slope) for step in RIPPLE_STEPS}
        weakest_step = min(RIPPLE_STEPS, key=lambda step: shares[step])
        if shares[weakest_step] >= RIPPLE_SHARE:
            return
        mean_gradient = torch.zeros_like(gradient)
        for draw in range(RIPPLE_DRAWS):
            change = RIPPLE_STEPS[-1] * noise(probe.images, 1.0, draw)
            mean_gradient += _Probe(trial, image_index, change).gradient(name) / RIPPLE_DRAWS
        mean_rise = _rise(probe, mean_gradient, weakest_step, name)
        ratios.append(2 * weakest_step * slope * shares[weakest_step] / max(mean_rise, 1e-30))
        if ratios[-1] > MAX_RIPPLE_RATIO:
            return
    trial.expect(
        False,
        f"steps of up to 2/255 along the gradient of {name} raise it at least half as much as those along the mean "
        f"gradient of nearby images (gradient masking by rippling: {max(ratios):.2g} times as much)",
    )


def _rise(probe: _Probe, gradient: Tensor, step: float, name: str) -> float:
    """Return the rise of a number from a step against the signs of a gradient to one along them."""
    ahead, behind = (float(probe.at(probe.images + sign * step * gradient.sign())[name]) for sign in (1, -1))
    return ahead - behind


def check_loss_signs(trial: CheckCase) -> None:
    """Check that losses are larger for wrong truth than for right truth."""
    if not trial.has_losses:
        return
    detector = trial.detector
    with torch.no_grad():
        dense = trial.dense(trial.images())
        truth = trial.truth((2, 1, 1))
        assignment = detector.assign(dense, truth)

        def losses(case: list[Truth]) -> dict[str, float]:
            values = detector.losses(dense, detector.assign(dense, case))
            return {name: float(loss.sum()) for name, loss in values.items()}

        ranks = range(max(1, min(4, len(detector.classes) // 2)))
        favoured = [losses(_relabelled_truth(dense, assignment, truth, rank=rank)) for rank in ranks]
        disfavoured = [losses(_relabelled_truth(dense, assignment, truth, rank=-1 - rank)) for rank in ranks]
        case_losses = [favoured[0], disfavoured[0], losses(truth), losses(trial.truth((0, 0, 0)))]
    for name in case_losses[0]:
        values = [case[name] for case in case_losses]
        is_reversed = min(values) < 0 and max(values) <= 0
        trial.expect(not is_reversed, f'losses["{name}"] rises above 0 when the truth is wrong (is its sign turned?)')
    # Other parts may depend on the class too: a cone has no side. Classes that only one part tells apart come first.
    pairs = sorted(product(favoured, disfavoured), key=lambda pair: _differing_parts(*pair) > 1)
    favoured_total, disfavoured_total = (sum(case.values()) for case in pairs[0])
    rises = disfavoured_total >= favoured_total - 0.005 * abs(favoured_total)
    trial.expect(rises, "the losses are lower for the classes that Dense.logit favours than for those it does not")


def _differing_parts(losses: dict[str, float], other_losses: dict[str, float]) -> int:
    """Count the parts of a loss that differ between two cases."""
    return sum(
        abs(value - other_losses[name]) > 10 * ROUNDING * max(abs(value), abs(other_losses[name]))
        for name, value in losses.items()
    )


def _relabelled_truth(dense: Dense, assignment: Assignment, truth: list[Truth], *, rank: int) -> list[Truth]:
    """Return the truth with the classes of the largest logits at the places of each object.

    Args:
        dense: Outputs for the images.
        assignment: Assignment of the truth.
        truth: Ground truth of the images.
        rank: 0 for the largest mean logit, 1 for the second; -1 for the smallest, -2 for the one above it.
    """
    relabelled = []
    for image_index, image_truth in enumerate(truth):
        labels = []
        for object_index in range(len(image_truth.label)):
            is_owned = assignment.owner[image_index] == object_index
            mean_logit = dense.logit[image_index][is_owned if bool(is_owned.any()) else slice(None)].double().mean(0)
            labels.append(int(mean_logit.argsort(descending=True)[rank]))
        relabelled.append(
            replace(
                image_truth, label=torch.tensor(labels, device=image_truth.label.device, dtype=image_truth.label.dtype)
            )
        )
    return relabelled
