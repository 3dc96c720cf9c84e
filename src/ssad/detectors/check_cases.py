"""What a detector is tried on by `ssad.detectors.check`: pictures, truth, and a watch over its state."""

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
from ssad.detectors.mono3d.decode import corners, hull, project

BATCH = 3


@dataclass(slots=True)
class CheckCase:
    """A detector with pictures and truth to try it on, and what was found."""

    detector: Any
    size: tuple[int, int]
    intrinsic: Tensor | None
    faults: list[str] = field(default_factory=list)

    def need(self, ok: bool, promise: str) -> bool:
        """A fault if a promise is broken; whether it is kept."""
        if not ok and promise not in self.faults:
            self.faults.append(promise)
        return ok

    @contextmanager
    def guarded(self, what: str) -> Iterator[None]:
        """Errors become faults; the detector's state must be afterwards what it was."""
        before = State(self.detector)
        try:
            yield
        except Exception as error:  # whatever a stranger's detector raises
            self.faults.append(f"{what}: no error, but {describe(error)}")
        for changed in before.changed(self.detector):
            self.need(False, f"no call changes the detector or the program; {what} changes {changed}")

    @property
    def three(self) -> bool:
        """Whether the detector finds 3D boxes."""
        return bool(self.detector.task == "3d")

    def device(self) -> torch.device:
        """Where the detector's weights are."""
        for module in modules_of(self.detector):
            for value in (*module.parameters(), *module.buffers()):
                return value.device
        return torch.device("cpu")

    def images(self, count: int = BATCH, size: tuple[int, int] | None = None) -> Tensor:
        """Coarse and fine random patterns, so that detectors of any scale see something."""
        height, width = size or self.size
        draws = torch.Generator().manual_seed(seed32("check_detector", height, width))
        fine = torch.rand((count, 3, height, width), generator=draws)
        coarse = torch.rand((count, 3, 4, 5), generator=draws)
        smooth = nn.functional.interpolate(coarse, (height, width), mode="bilinear", align_corners=False)
        return (0.7 * smooth + 0.3 * fine).clamp(0, 1).to(self.device())

    def lens(self, count: int = BATCH) -> Tensor | None:
        """Intrinsics [count, 3, 3], None for 2D."""
        if not self.three:
            return None
        height, width = self.size
        focal = 0.8 * width
        own = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        one = own if self.intrinsic is None else self.intrinsic.to(torch.float32)
        return one.expand(count, 3, 3).clone().to(self.device())

    def dense(self, images: Tensor) -> Dense:
        """With the intrinsics."""
        result: Dense = self.detector.dense(images, self.lens(len(images)))
        return result

    def predict(self, images: Tensor, threshold: float | None = None) -> list[Detections]:
        """With the intrinsics."""
        found: list[Detections] = self.detector.predict(images, self.lens(len(images)), threshold=threshold)
        return found

    def truth(self, counts: tuple[int, ...] = (2, 0, 1)) -> list[Truth]:
        """Truth with so many large objects in each image."""
        return [self._truth(count) for count in counts]

    def _truth(self, count: int) -> Truth:
        height, width = self.size
        device, classes = self.device(), len(self.detector.classes)
        label = torch.tensor([0, classes - 1][:count], dtype=torch.int64, device=device)
        lens = self.lens(1)
        if lens is None:
            shares = torch.tensor([[0.1, 0.15, 0.45, 0.8], [0.5, 0.3, 0.95, 0.9]])[:count]
            box = shares * torch.tensor([width, height] * 2, dtype=torch.float32)
            return Truth(label, box.to(device))
        centre = torch.tensor([[-1.5, 0.3, 9.0], [2.0, 0.2, 12.0]], device=device)[:count]
        extent = torch.tensor([[4.2, 1.6, 1.9], [4.8, 1.9, 2.0]], device=device)[:count]
        yaw = torch.tensor([0.4, -2.0], device=device)[:count]
        velocity = torch.tensor([[1.0, -3.0], [torch.nan, torch.nan]], device=device)[:count]
        attribute = torch.tensor([5, NO_ATTRIBUTE], device=device)[:count]
        box = hull(project(corners(centre, extent, yaw), lens[0]))
        limit = torch.tensor([width, height] * 2, dtype=box.dtype, device=device)
        solid = Solids(centre, extent, yaw, velocity, attribute)
        return Truth(label, box.clamp_min(0).minimum(limit), solid, lens[0])


def usual_threshold(trial: CheckCase, images: Tensor) -> float:
    """A threshold at which some 20 objects are found in each image."""
    with torch.no_grad():
        dense = trial.dense(images[:1])
    score = dense.logit.sigmoid().amax(-1)
    if dense.quality is not None:
        score = score * dense.quality.sigmoid()
    least = float(score.flatten().sort(descending=True).values[:20][-1])
    for _ in range(20):  # the detector may count something else in
        (found,) = trial.predict(images[:1], threshold=least)
        if len(found.score) > 2:
            score = found.score.detach().sort(descending=True).values
            usable = score[(score >= least) & (score <= 1)][:20]  # wrong order and range are told elsewhere
            return float(usable[-1]) * (1 - 1e-4) if len(usable) else least
        least *= 0.7
    return 0.0


def noise(like: Tensor, amplitude: float) -> Tensor:
    """Random numbers within plus and minus `amplitude`, of the shape of `like`; the same in every run."""
    draws = torch.Generator().manual_seed(seed32("check_detector noise", *like.shape))
    return amplitude * (2 * torch.rand(like.shape, generator=draws) - 1).to(like)


def modules_of(detector: Any) -> list[nn.Module]:
    """The detector if it is a module, else the modules that it holds."""
    if isinstance(detector, nn.Module):
        return [detector]
    return [value for value in getattr(detector, "__dict__", {}).values() if isinstance(value, nn.Module)]


class State:
    """Everything of a detector, and of PyTorch's settings, that calls must leave alone."""

    def __init__(self, detector: Any) -> None:
        named = [(f"{k}.{n}", m) for k, root in enumerate(modules_of(detector)) for n, m in root.named_modules()]
        self.modes = {name: module.training for name, module in named}
        tensors = [
            (f"{name}.{own}", value)
            for name, module in named
            for own, value in (*module.named_parameters(recurse=False), *module.named_buffers(recurse=False))
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

    def changed(self, detector: Any) -> list[str]:
        """What is not as it was."""
        now = State(detector)
        found = []
        for what, before, after in (
            ("training mode", self.modes, now.modes),
            ("requires_grad or grad", self.grads, now.grads),
        ):
            names = sorted(n for n in before.keys() | after.keys() if before.get(n) != after.get(n))
            found += [f"{what} of {names[0][2:].lstrip('.') or 'itself'}"] if names else []
        for name, value in self.values.items():
            other = now.values.get(name)
            if other is None or other.shape != value.shape or not torch.equal(other.nan_to_num(), value.nan_to_num()):
                found.append(f"the values of {name[2:].lstrip('.')}")
                break
        if self.settings != now.settings:
            found.append("torch's gradient mode, default type or number of threads")
        if not torch.equal(self.draws, now.draws):
            found.append("torch's global random numbers")
        return found
