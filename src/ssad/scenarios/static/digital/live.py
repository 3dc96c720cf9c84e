"""Digital attacks on the pictures that a driver gets, at every step of the loop (`ssad.core.driving.Perturbation`).

Nobody tells the attacker what is there: he takes what the detector finds in the clean picture for the truth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ssad.core.detections import Detections, Truth
from ssad.core.driving import Frames, Generators
from ssad.core.errors import ConfigError
from ssad.core.protocols import Detector
from ssad.scenarios.static.digital.attack import Attack, run_attack
from ssad.scenarios.static.digital.budget import LEVELS, Budget, codes_of, quantise
from ssad.scenarios.static.digital.noise import RandomNoise
from ssad.scenarios.static.digital.objectives import EVERYTHING, Aim, Objective, make_objective
from ssad.scenarios.static.digital.universal import Universal
from ssad.scenarios.static.digital.victim import NothingToAttackError, Pictures, steady

SURE = 0.3  # least score of what is taken for an object


@dataclass(slots=True)
class Spent:
    """What an attack took so far.

    Attributes:
        images: Pictures that were attacked.
        gradients: Forward and backward passes, over all pictures.
        queries: Forward passes alone, likewise.
        gradient_error: Of the gradient against finite differences, on the first pictures with an object in them; None:
            not looked at yet.
    """

    images: int = 0
    gradients: int = 0
    queries: int = 0
    gradient_error: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class LiveAttack:
    """A `Perturbation`: every picture is attacked by itself, and its 8-bit round trip is handed on.

    `Universal` and `RandomNoise` ask no detector anything, so they cost next to nothing. Every other attack costs what
    its constructor says, such as `make_attack("pgd", steps=2)`, for each picture, and three queries besides: for what
    is there, and for the loss before and after.

    Attributes:
        attack: The method.
        budget: How far a picture may be moved.
        objective: The loss to ascend, or its name.
        aim: Which objects are attacked; numbers of objects count what the detector finds, best first.
        detector: What is attacked; None: the victim, if it is a detector, or else its attribute `detector`. To attack
            another one than the driver's is a transfer attack.
        intrinsic: Camera matrix [3, 3] of the pictures, for 3D. A driver with several cameras needs an attack for each:
            `rollout` takes a mapping from names of sensors.
        batch: Pictures at once; it changes no result.
        spent: What was asked so far.

    Raises:
        UnknownNameError: There is no such loss.
    """

    attack: Attack
    budget: Budget
    objective: str | Objective = "margin"
    aim: Aim = EVERYTHING
    detector: Detector | None = None
    intrinsic: Any = None
    batch: int = 8
    spent: Spent = field(default_factory=Spent, init=False)

    def __post_init__(self) -> None:
        if isinstance(self.objective, str):
            make_objective(self.objective)

    def apply(self, frames: Frames, victim: Any, truth: Any, generators: Generators) -> Frames:
        """Attack pictures; black ones, of episodes that have ended, are left alone.

        Args:
            frames: uint8 [N, 3, H, W], RGB.
            victim: Whose pictures these are.
            truth: Not looked at, unless it is a list of N `Truth` with labels of the detector.
            generators: One for each picture.

        Returns:
            uint8 [N, 3, H, W].

        Raises:
            ConfigError: Frames of another kind; there is no detector; see `run_attack`.
        """
        if frames.dtype != np.uint8 or frames.ndim != 4 or frames.shape[1] != 3 or len(frames) != len(generators):
            raise ConfigError(
                f"attack {self.attack.name}: it takes pictures uint8 [N, 3, H, W] and as many generators, not "
                f"{frames.dtype} {list(frames.shape)} and {len(generators)}"
            )
        keys = [(int(one.integers(1 << 62)),) for one in generators]
        found = frames.copy()
        lit = np.flatnonzero(frames.any(axis=(1, 2, 3)))
        for k in range(0, len(lit), max(self.batch, 1)):
            rows = lit[k : k + max(self.batch, 1)]
            told = [truth[row] for row in rows] if _is_truth(truth, len(frames)) else None
            found[rows] = self._some(frames[rows], victim, told, [keys[row] for row in rows])
        self.spent.images += len(lit)
        return found

    def _some(
        self, frames: Frames, victim: Any, truth: Sequence[Truth] | None, keys: Sequence[tuple[object, ...]]
    ) -> Frames:
        """Some pictures at once."""
        if isinstance(self.attack, Universal | RandomNoise):
            images = torch.from_numpy(frames).float() / LEVELS
            asked = Pictures(images, keys)
            return quantise(self.attack.perturb(asked, self.budget), codes_of(images), self.budget).numpy()
        detector = attacked_detector(victim) if self.detector is None else self.detector
        device = _device_of(detector)
        images = torch.from_numpy(frames).to(device).float() / LEVELS
        lens = None
        if detector.task == "3d":
            if self.intrinsic is None:
                raise ConfigError(f"attack {self.attack.name}: {detector.name} finds 3D boxes; give the intrinsic")
            lens = torch.as_tensor(np.asarray(self.intrinsic), dtype=torch.float32, device=device)
            lens = lens.expand(len(images), 3, 3).contiguous()
        if truth is None:
            truth = own_truth(detector, images, lens)
            self.spent.queries += len(images)
        # once, and where there is something to attack: elsewhere a sound loss may be flat
        unknown = self.spent.gradient_error is None and any(len(one.label) for one in truth)
        try:
            done = run_attack(
                self.attack,
                detector,
                images,
                truth,
                self.budget,
                objective=self.objective,
                intrinsic=lens,
                aim=self.aim,
                keys=keys,
                check=unknown,
            )
        except NothingToAttackError:
            return frames
        if done.gradient_error is not None:
            self.spent.gradient_error = done.gradient_error
        self.spent.gradients += len(images) * done.cost.gradients
        self.spent.queries += len(images) * (done.cost.queries + 2)
        return (done.images * LEVELS).round().to(torch.uint8).cpu().numpy()


def own_truth(
    detector: Detector, images: Tensor, intrinsic: Tensor | None = None, *, least: float = SURE
) -> list[Truth]:
    """What a detector finds in clean images, taken for the truth: what an attacker knows whom nobody tells it.

    Args:
        detector: Who looks.
        images: [B, 3, H, W].
        intrinsic: [B, 3, 3], for 3D.
        least: Least score of what is taken for an object.
    """
    with steady(detector), torch.no_grad():
        found = detector.predict(images, intrinsic, threshold=least)
    lenses: list[Tensor | None] = [None] * len(found) if intrinsic is None else list(intrinsic.cpu())
    return [_as_truth(one, lens) for one, lens in zip(found, lenses, strict=True)]


def _as_truth(found: Detections, intrinsic: Tensor | None) -> Truth:
    solid = found.solid
    if solid is not None:
        solid = replace(
            solid,
            centre=solid.centre.cpu(),
            size_lhw=solid.size_lhw.cpu(),
            yaw=solid.yaw.cpu(),
            velocity=solid.velocity.cpu(),
            attribute=solid.attribute.cpu(),
        )
    return Truth(found.label.cpu(), found.box.cpu(), solid, None if solid is None else intrinsic)


def attacked_detector(victim: Any) -> Detector:
    """The victim itself if it is a detector, or else the detector that it has.

    Raises:
        ConfigError: There is none.
    """
    found: Any = victim if callable(getattr(victim, "dense", None)) else getattr(victim, "detector", None)
    if not callable(getattr(found, "dense", None)):
        name = getattr(victim, "name", type(victim).__name__)
        raise ConfigError(f"{name} has no detector to attack: it must have an attribute detector, or be given one")
    detector: Detector = found
    return detector


def _device_of(detector: Any) -> torch.device:
    if isinstance(detector, nn.Module):
        for tensor in (*detector.parameters(), *detector.buffers()):
            return tensor.device
    return torch.device("cpu")


def _is_truth(truth: Any, count: int) -> bool:
    return isinstance(truth, Sequence) and len(truth) == count and all(isinstance(one, Truth) for one in truth)
