"""Digital attacks on the camera images of a driver in the loop (`ssad.core.driving.Perturbation`).

The attacker has no ground truth: it uses the detections in the clean image instead.
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
from ssad.scenarios.static.digital.victim import CleanImages, NothingToAttackError, steady

MIN_SCORE = 0.3  # least score of what is taken for an object


@dataclass(slots=True)
class TotalCost:
    """Cumulative cost of an attack.

    Attributes:
        images: Attacked images.
        gradients: Forward and backward passes over all images.
        queries: Forward passes without a gradient over all images.
        gradient_error: Error of the gradient against finite differences, on the first images with an object; None:
            not checked yet.
    """

    images: int = 0
    gradients: int = 0
    queries: int = 0
    gradient_error: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class LiveAttack:
    """Perturbation that attacks every image by itself and returns it after an 8-bit round trip.

    `Universal` and `RandomNoise` do not query a detector, so they cost next to nothing. Every other attack costs what
    its constructor says, such as `make_attack("pgd", steps=2)`, for each image, and three more queries: one for the
    pseudo ground truth and two for the loss before and after.

    Attributes:
        attack: Attack method.
        budget: Maximum change of an image.
        objective: Loss to ascend, or its name.
        aim: Objects under attack; object indices count the detections, best first.
        detector: Detector under attack; None: the victim, if it is a detector, else its attribute `detector`. Another
            detector than the driver's makes it a transfer attack.
        intrinsic: Camera matrix [3, 3] of the images, for 3D. A driver with several cameras needs one attack for
            each: `rollout` takes a mapping from sensor names.
        batch: Images per batch; it does not affect the result.
        spent: Cumulative cost.

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
    spent: TotalCost = field(default_factory=TotalCost, init=False)

    def __post_init__(self) -> None:
        if isinstance(self.objective, str):
            make_objective(self.objective)

    def apply(self, frames: Frames, victim: Any, truth: Any, generators: Generators) -> Frames:
        """Attack images; black images of episodes that have ended are left unchanged.

        Args:
            frames: uint8 [N, 3, H, W], RGB.
            victim: Driver or detector that receives the images.
            truth: Ignored, unless it is a list of N `Truth` with labels of the detector.
            generators: One for each image.

        Returns:
            uint8 [N, 3, H, W].

        Raises:
            ConfigError: The frames have another shape or type, or there is no detector; see `run_attack`.
        """
        if frames.dtype != np.uint8 or frames.ndim != 4 or frames.shape[1] != 3 or len(frames) != len(generators):
            raise ConfigError(
                f"attack {self.attack.name}: it takes pictures uint8 [N, 3, H, W] and as many generators, not "
                f"{frames.dtype} {list(frames.shape)} and {len(generators)}"
            )
        # Keys are drawn before batching, so that the batch size does not affect the result.
        keys = [(int(random_generator.integers(1 << 62)),) for random_generator in generators]
        attacked = frames.copy()
        active_rows = np.flatnonzero(frames.any(axis=(1, 2, 3)))
        for start in range(0, len(active_rows), max(self.batch, 1)):
            rows = active_rows[start : start + max(self.batch, 1)]
            rows_truth = [truth[row_index] for row_index in rows] if _is_truth(truth, len(frames)) else None
            attacked[rows] = self._attack_batch(
                frames[rows], victim, rows_truth, [keys[row_index] for row_index in rows]
            )
        self.spent.images += len(active_rows)
        return attacked

    def _attack_batch(
        self, frames: Frames, victim: Any, truth: Sequence[Truth] | None, keys: Sequence[tuple[object, ...]]
    ) -> Frames:
        """Attack one batch of images."""
        if isinstance(self.attack, Universal | RandomNoise):
            images = torch.from_numpy(frames).float() / LEVELS
            clean_images = CleanImages(images, keys)
            return quantise(self.attack.perturb(clean_images, self.budget), codes_of(images), self.budget).numpy()
        detector = attacked_detector(victim) if self.detector is None else self.detector
        device = _device_of(detector)
        images = torch.from_numpy(frames).to(device).float() / LEVELS
        intrinsics = None
        if detector.task == "3d":
            if self.intrinsic is None:
                raise ConfigError(f"attack {self.attack.name}: {detector.name} finds 3D boxes; give the intrinsic")
            intrinsics = torch.as_tensor(np.asarray(self.intrinsic), dtype=torch.float32, device=device)
            intrinsics = intrinsics.expand(len(images), 3, 3).contiguous()
        if truth is None:
            truth = own_truth(detector, images, intrinsics)
            self.spent.queries += len(images)
        # check once, on images with an object: without one a correct loss may be flat
        check_needed = self.spent.gradient_error is None and any(len(image_truth.label) for image_truth in truth)
        try:
            result = run_attack(
                self.attack,
                detector,
                images,
                truth,
                self.budget,
                objective=self.objective,
                intrinsic=intrinsics,
                aim=self.aim,
                keys=keys,
                check=check_needed,
            )
        except NothingToAttackError:
            return frames
        if result.gradient_error is not None:
            self.spent.gradient_error = result.gradient_error
        self.spent.gradients += len(images) * result.cost.gradients
        self.spent.queries += len(images) * (result.cost.queries + 2)
        return (result.images * LEVELS).round().to(torch.uint8).cpu().numpy()


def own_truth(
    detector: Detector, images: Tensor, intrinsic: Tensor | None = None, *, min_score: float = MIN_SCORE
) -> list[Truth]:
    """Return the detections in clean images as pseudo ground truth, for an attacker without the truth.

    Args:
        detector: Detector of the objects.
        images: [B, 3, H, W].
        intrinsic: [B, 3, 3], for 3D.
        min_score: Minimum score of an object.
    """
    with steady(detector), torch.no_grad():
        detections = detector.predict(images, intrinsic, threshold=min_score)
    intrinsics: list[Tensor | None] = [None] * len(detections) if intrinsic is None else list(intrinsic.cpu())
    return [
        _as_truth(image_detections, image_intrinsic)
        for image_detections, image_intrinsic in zip(detections, intrinsics, strict=True)
    ]


def _as_truth(detections: Detections, intrinsic: Tensor | None) -> Truth:
    solid = detections.solid
    if solid is not None:
        solid = replace(
            solid,
            centre=solid.centre.cpu(),
            size_lhw=solid.size_lhw.cpu(),
            yaw=solid.yaw.cpu(),
            velocity=solid.velocity.cpu(),
            attribute=solid.attribute.cpu(),
        )
    return Truth(detections.label.cpu(), detections.box.cpu(), solid, None if solid is None else intrinsic)


def attacked_detector(victim: Any) -> Detector:
    """Return the victim itself if it is a detector, else its attribute `detector`.

    Raises:
        ConfigError: There is none.
    """
    candidate: Any = victim if callable(getattr(victim, "dense", None)) else getattr(victim, "detector", None)
    if not callable(getattr(candidate, "dense", None)):
        name = getattr(victim, "name", type(victim).__name__)
        raise ConfigError(f"{name} has no detector to attack: it must have an attribute detector, or be given one")
    detector: Detector = candidate
    return detector


def _device_of(detector: Any) -> torch.device:
    if isinstance(detector, nn.Module):
        for tensor in (*detector.parameters(), *detector.buffers()):
            return tensor.device
    return torch.device("cpu")


def _is_truth(truth: Any, count: int) -> bool:
    return (
        isinstance(truth, Sequence)
        and len(truth) == count
        and all(isinstance(image_truth, Truth) for image_truth in truth)
    )
