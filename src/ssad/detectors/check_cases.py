"""Test cases of `ssad.detectors.check`: images, truth, and a watch over the detector's state."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

from ssad.core.detections import Dense, Detections, Solids, Truth
from ssad.core.nuscenes_names import NO_ATTRIBUTE
from ssad.core.registry import describe
from ssad.core.seeding import seed32
from ssad.core.tensor_boxes import solid_corners
from ssad.detectors.mono3d.decode import hull, project

BATCH = 3


@dataclass(slots=True)
class CheckCase:
    """A detector with images and truth to test it on, and the faults found so far."""

    detector: Any
    size: tuple[int, int]
    intrinsic: Tensor | None
    faults: list[str] = field(default_factory=list)

    def expect(self, is_kept: bool, promise: str) -> bool:
        """Record a fault if a promise is broken; return True if it is kept."""
        if not is_kept and promise not in self.faults:
            self.faults.append(promise)
        return is_kept

    @contextmanager
    def record_errors(self, action: str) -> Iterator[None]:
        """Turn errors into faults, and record a fault if the block changes the state of the detector."""
        state_before = DetectorState(self.detector)
        try:
            yield
        except Exception as error:  # a third-party detector may raise anything
            self.faults.append(f"{action}: no error, but {describe(error)}")
        for change in state_before.describe_changes(self.detector):
            self.expect(False, f"no call changes the detector or the program; {action} changes {change}")

    @property
    def is_3d(self) -> bool:
        """True if the detector returns 3D boxes."""
        return bool(self.detector.task == "3d")

    @property
    def has_losses(self) -> bool:
        """True unless the detector says that it has no training losses."""
        return bool(getattr(self.detector, "has_training_losses", True))

    def device(self) -> torch.device:
        """Return the device of the detector's weights."""
        for module in modules_of(self.detector):
            for value in (*module.parameters(), *module.buffers()):
                return value.device
        return torch.device("cpu")

    def images(self, count: int = BATCH, size: tuple[int, int] | None = None) -> Tensor:
        """Return random images with coarse and fine patterns, so that detectors of any scale respond."""
        height, width = size or self.size
        generator = torch.Generator().manual_seed(seed32("check_detector", height, width))
        fine = torch.rand((count, 3, height, width), generator=generator)
        coarse = torch.rand((count, 3, 4, 5), generator=generator)
        smooth = nn.functional.interpolate(coarse, (height, width), mode="bilinear", align_corners=False)
        return (0.7 * smooth + 0.3 * fine).clamp(0, 1).to(self.device())

    def intrinsics(self, count: int = BATCH) -> Tensor | None:
        """Return intrinsics [count, 3, 3]; None for 2D detectors."""
        if not self.is_3d:
            return None
        height, width = self.size
        focal = 0.8 * width
        default_intrinsic = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        intrinsic_matrix = default_intrinsic if self.intrinsic is None else self.intrinsic.to(torch.float32)
        return intrinsic_matrix.expand(count, 3, 3).clone().to(self.device())

    def dense(self, images: Tensor) -> Dense:
        """Return the dense outputs, with intrinsics for 3D detectors."""
        result: Dense = self.detector.dense(images, self.intrinsics(len(images)))
        return result

    def predict(self, images: Tensor, threshold: float | None = None) -> list[Detections]:
        """Return the detections, with intrinsics for 3D detectors."""
        detections: list[Detections] = self.detector.predict(images, self.intrinsics(len(images)), threshold=threshold)
        return detections

    def truth(self, counts: tuple[int, ...] = (2, 0, 1)) -> list[Truth]:
        """Return truth with the given number of large objects in each image."""
        return [self._truth(count) for count in counts]

    def _truth(self, count: int) -> Truth:
        height, width = self.size
        device, classes = self.device(), len(self.detector.classes)
        label = torch.tensor([0, classes - 1][:count], dtype=torch.int64, device=device)
        intrinsics = self.intrinsics(1)
        if intrinsics is None:
            shares = torch.tensor([[0.1, 0.15, 0.45, 0.8], [0.5, 0.3, 0.95, 0.9]])[:count]
            box = shares * torch.tensor([width, height] * 2, dtype=torch.float32)
            return Truth(label, box.to(device))
        centre = torch.tensor([[-1.5, 0.3, 9.0], [2.0, 0.2, 12.0]], device=device)[:count]
        extent = torch.tensor([[4.2, 1.6, 1.9], [4.8, 1.9, 2.0]], device=device)[:count]
        yaw = torch.tensor([0.4, -2.0], device=device)[:count]
        velocity = torch.tensor([[1.0, -3.0], [torch.nan, torch.nan]], device=device)[:count]
        attribute = torch.tensor([5, NO_ATTRIBUTE], device=device)[:count]
        box = hull(project(solid_corners(centre, extent, yaw), intrinsics[0]))
        limit = torch.tensor([width, height] * 2, dtype=box.dtype, device=device)
        solid = Solids(centre, extent, yaw, velocity, attribute)
        return Truth(label, box.clamp_min(0).minimum(limit), solid, intrinsics[0])


def typical_threshold(trial: CheckCase, images: Tensor) -> float:
    """Return a threshold that leaves some 20 detections in each image."""
    with torch.no_grad():
        dense = trial.dense(images[:1])
    score = dense.logit.sigmoid().amax(-1)
    if dense.quality is not None:
        score = score * dense.quality.sigmoid()
    threshold = float(score.flatten().sort(descending=True).values[:20][-1])
    for _ in range(20):  # the detector's score may have further factors
        (detections,) = trial.predict(images[:1], threshold=threshold)
        if len(detections.score) > 2:
            score = detections.score.detach().sort(descending=True).values
            usable = score[(score >= threshold) & (score <= 1)][:20]  # another check reports wrong order and range
            # Slightly lower: detectors differ in whether a score equal to the threshold passes.
            return float(usable[-1]) * (1 - 1e-4) if len(usable) else threshold
        threshold *= 0.7
    return 0.0


def noise(template: Tensor, amplitude: float, draw: int = 0) -> Tensor:
    """Return random numbers within plus and minus `amplitude`, shaped as `template`; the same in every run.

    Args:
        template: Shape, type and device of the numbers.
        amplitude: Largest absolute value.
        draw: Number of the draw.
    """
    key = (*template.shape, draw) if draw else tuple(template.shape)
    generator = torch.Generator().manual_seed(seed32("check_detector noise", *key))
    return amplitude * (2 * torch.rand(template.shape, generator=generator) - 1).to(template)


def modules_of(detector: Any) -> list[nn.Module]:
    """Return the detector if it is a module, else the modules among its attributes."""
    if isinstance(detector, nn.Module):
        return [detector]
    return [value for value in getattr(detector, "__dict__", {}).values() if isinstance(value, nn.Module)]


class DetectorState:
    """All state of a detector and of PyTorch's settings that calls must leave unchanged."""

    def __init__(self, detector: Any) -> None:
        named_modules = [
            (f"{index}.{module_name}", submodule)
            for index, root in enumerate(modules_of(detector))
            for module_name, submodule in root.named_modules()
        ]
        self.modes = {name: module.training for name, module in named_modules}
        tensors = [
            (f"{name}.{tensor_name}", value)
            for name, module in named_modules
            for tensor_name, value in (*module.named_parameters(recurse=False), *module.named_buffers(recurse=False))
        ]
        self.grads = {name: (value.requires_grad, value.grad is None) for name, value in tensors}
        self.values = {name: value.detach().clone() for name, value in tensors}
        self.settings = (
            torch.is_grad_enabled(),
            torch.is_inference_mode_enabled(),
            torch.get_default_dtype(),
            torch.get_num_threads(),
        )
        self.draws = torch.get_rng_state()

    def describe_changes(self, detector: Any) -> list[str]:
        """Return a description of each difference from the recorded state."""
        current = DetectorState(detector)
        changes = []
        for aspect, old_flags, new_flags in (
            ("training mode", self.modes, current.modes),
            ("requires_grad or grad", self.grads, current.grads),
        ):
            names = sorted(
                module_name
                for module_name in old_flags.keys() | new_flags.keys()
                if old_flags.get(module_name) != new_flags.get(module_name)
            )
            changes += [f"{aspect} of {names[0][2:].lstrip('.') or 'itself'}"] if names else []
        for name, value in self.values.items():
            current_value = current.values.get(name)
            # NaN is unequal to itself.
            if (
                current_value is None
                or current_value.shape != value.shape
                or not torch.equal(current_value.nan_to_num(), value.nan_to_num())
            ):
                changes.append(f"the values of {name[2:].lstrip('.')}")
                break
        if self.settings != current.settings:
            changes.append("torch's gradient mode, default type or number of threads")
        if not torch.equal(self.draws, current.draws):
            changes.append("torch's global random numbers")
        return changes
