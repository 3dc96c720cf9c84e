"""Transfer attacks: images that fool one detector are shown to another, which is never queried."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ssad.core.detections import Solids, Truth
from ssad.core.errors import ConfigError
from ssad.core.protocols import Detector
from ssad.scenarios.static.digital.attack import Access, Attack
from ssad.scenarios.static.digital.budget import Budget
from ssad.scenarios.static.digital.gradient_check import check_gradient
from ssad.scenarios.static.digital.objectives import Aim, Objective, make_objective
from ssad.scenarios.static.digital.victim import Victim, steady


@dataclass(frozen=True, slots=True)
class Transfer:
    """Attack on a surrogate, with its own target assignment; the victim receives the resulting images.

    Labels of the truth are translated by class name; objects of classes that the surrogate lacks are omitted. The
    surrogate does not know a defence before the victim. The victim's costs stay 0, since it is not queried.

    Attributes:
        surrogate: Detector that is attacked in place of the victim; it is restored afterwards.
        inner: Attack that runs on it.
        objective: Loss of the surrogate to ascend, or its name.
        check: Compare the surrogate's gradient with finite differences first, if the inner attack queries gradients.

    Raises:
        ConfigError: There is no such loss.
    """

    surrogate: Detector
    inner: Attack
    objective: str | Objective = "full"
    check: bool = True
    access: Access = "none"

    def __post_init__(self) -> None:
        self._loss()

    @property
    def name(self) -> str:
        """Name shown in tables."""
        return f"transfer-{self.inner.name}-{self.surrogate.name}"

    def _loss(self) -> Objective:
        return make_objective(self.objective) if isinstance(self.objective, str) else self.objective

    def perturb(self, victim: Victim, budget: Budget) -> Tensor:
        """Attack the surrogate and return its images.

        Raises:
            ConfigError: The surrogate detects 3D boxes and the truth has none, or it knows none of the attacked
                classes.
        """
        class_names, aim = victim.detector.classes, victim.situation.aim
        translations = [
            translate(image_truth, class_names, self.surrogate.classes)
            for image_truth in victim.situation.assignment.truth
        ]
        if self.surrogate.task == "3d" and any(image_truth.solid is None for image_truth, _ in translations):
            raise ConfigError(f"{self.name}: {self.surrogate.name} finds 3D boxes, and the truth has none")
        aims = [_translate_aim(aim, kept_objects, self.surrogate) for _, kept_objects in translations]
        # object indices differ between images once some are omitted, so such images are attacked one by one
        perturbed = victim.clean.clone()
        groups = [[index] for index in range(len(victim))] if aim.objects is not None else [list(range(len(victim)))]
        loss, any_attacked = self._loss(), False
        needs_objects = loss.needs_objects or not aim.attacks_all
        with steady(self.surrogate):
            for group in groups:
                attackable = [
                    index
                    for index in group
                    if not needs_objects or _has_attacked_object(translations[index][0], aims[index], self.surrogate)
                ]
                if attackable:
                    perturbed[attackable] = self._attack_surrogate(
                        victim,
                        attackable,
                        [translations[index][0] for index in attackable],
                        aims[attackable[0]],
                        budget,
                    )
                    any_attacked = True
        if not any_attacked:
            raise ConfigError(f"{self.name}: {self.surrogate.name} knows the class of none of the attacked objects")
        return perturbed

    def _attack_surrogate(
        self, victim: Victim, rows: Sequence[int], truth: Sequence[Truth], aim: Aim, budget: Budget
    ) -> Tensor:
        """Return the images that the inner attack finds for some rows of the batch."""
        intrinsic = None if victim.intrinsic is None else victim.intrinsic[list(rows)]
        intrinsics = [image_truth.intrinsic for image_truth in truth if image_truth.intrinsic is not None]
        if intrinsic is None and len(intrinsics) == len(truth):
            intrinsic = torch.stack(intrinsics).to(victim.clean)
        if intrinsic is None and self.surrogate.task == "3d":
            raise ConfigError(f"{self.name}: {self.surrogate.name} finds 3D boxes, and the intrinsics are missing")
        surrogate_victim = Victim(
            self.surrogate,
            victim.clean[list(rows)],
            truth,
            self._loss(),
            intrinsic=intrinsic,
            aim=aim,
            keys=[victim.keys[index] for index in rows],
        )
        if self.check and self.inner.access == "white-box":
            check_gradient(surrogate_victim)
        images = self.inner.perturb(surrogate_victim, budget).detach()
        return torch.where(surrogate_victim.idle[:, None, None, None], surrogate_victim.clean, images)


def translate(
    truth: Truth, source_classes: Sequence[str], target_classes: Sequence[str]
) -> tuple[Truth, tuple[int, ...]]:
    """Return the truth of an image with the labels of another detector.

    Args:
        truth: Truth whose labels are indices into `source_classes`.
        source_classes: Names of the classes of the truth.
        target_classes: Names of the classes of the other detector.

    Returns:
        The truth of the objects of these classes, and their indices.
    """
    label_map = [target_classes.index(name) if name in target_classes else -1 for name in source_classes]
    label = torch.tensor([label_map[label_index] for label_index in truth.label.tolist()], dtype=truth.label.dtype)
    kept_objects = torch.nonzero(label >= 0).flatten()
    solid = truth.solid
    if solid is not None:
        solid = Solids(
            solid.centre[kept_objects],
            solid.size_lhw[kept_objects],
            solid.yaw[kept_objects],
            solid.velocity[kept_objects],
            solid.attribute[kept_objects],
        )
    crowd = None if truth.crowd is None else truth.crowd[kept_objects]
    label = label[kept_objects].to(truth.label.device)
    return Truth(label, truth.box[kept_objects], solid, truth.intrinsic, crowd), tuple(kept_objects.tolist())


def _translate_aim(aim: Aim, kept_objects: Sequence[int], surrogate: Detector) -> Aim:
    """Return the aim in an image of which some objects are kept, with the classes that the surrogate knows."""
    if aim.classes is not None:
        aim = replace(aim, classes=tuple(name for name in aim.classes if name in surrogate.classes))
    if aim.objects is not None:
        aim = replace(
            aim,
            objects=tuple(new_index for new_index, old_index in enumerate(kept_objects) if old_index in aim.objects),
        )
    becomes = {
        name: wrong_class
        for name, wrong_class in aim.becomes.items()
        if name in surrogate.classes and wrong_class in surrogate.classes
    }
    # An empty map would mean the nearest wrong class for all objects, so no class is attacked instead.
    if aim.becomes and not becomes:
        aim = replace(aim, classes=())
    return replace(aim, becomes=becomes)


def _has_attacked_object(truth: Truth, aim: Aim, surrogate: Detector) -> bool:
    """Check an image for an object under attack that is no crowd."""
    names = list(aim.becomes) if aim.becomes else aim.classes
    for index, label in enumerate(truth.label.tolist()):
        crowd = truth.crowd is not None and bool(truth.crowd[index])
        is_class_attacked = names is None or surrogate.classes[label] in names
        if is_class_attacked and not crowd and (aim.objects is None or index in aim.objects):
            return True
    return False
