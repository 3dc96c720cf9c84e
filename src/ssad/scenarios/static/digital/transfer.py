"""Transfer: a picture that fools one detector is shown to another, which is asked nothing."""

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
    """Runs an attack on a surrogate, with the surrogate's own target assignment, and hands the images to the victim.

    The truth's labels are translated by the names of the classes; objects of classes that the surrogate does not know
    are left out. A defence before the victim is not known to the surrogate.

    Attributes:
        surrogate: the detector that is attacked in the victim's place; afterwards it is as it was.
        inner: the attack that runs on it.
        objective: the loss of the surrogate that is ascended, or its name.
        check: compare the surrogate's gradient with finite differences first, if the inner attack asks for gradients.

    The victim's costs stay 0: nothing is asked of it.

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
        """What tables call it."""
        return f"transfer-{self.inner.name}-{self.surrogate.name}"

    def _loss(self) -> Objective:
        return make_objective(self.objective) if isinstance(self.objective, str) else self.objective

    def perturb(self, victim: Victim, budget: Budget) -> Tensor:
        """See `Attack`.

        Raises:
            ConfigError: The surrogate finds 3D boxes, and the truth has none; it knows none of the classes that are
                attacked.
        """
        known, aim = victim.detector.classes, victim.situation.aim
        whole = [translate(one, known, self.surrogate.classes) for one in victim.situation.assignment.truth]
        if self.surrogate.task == "3d" and any(one.solid is None for one, _ in whole):
            raise ConfigError(f"{self.name}: {self.surrogate.name} finds 3D boxes, and the truth has none")
        aims = [_translated(aim, kept, self.surrogate) for _, kept in whole]
        # numbers of objects differ from image to image once some are left out: such images go one by one
        found = victim.clean.clone()
        groups = [[k] for k in range(len(victim))] if aim.objects is not None else [list(range(len(victim)))]
        loss, some = self._loss(), False
        needed = loss.needs_objects or not aim.everything
        with steady(self.surrogate):
            for group in groups:
                own = [k for k in group if not needed or _attacked(whole[k][0], aims[k], self.surrogate)]
                if own:
                    found[own] = self._on_surrogate(victim, own, [whole[k][0] for k in own], aims[own[0]], budget)
                    some = True
        if not some:
            raise ConfigError(f"{self.name}: {self.surrogate.name} knows the class of none of the attacked objects")
        return found

    def _on_surrogate(
        self, victim: Victim, own: Sequence[int], truth: Sequence[Truth], aim: Aim, budget: Budget
    ) -> Tensor:
        """What the inner attack finds for some images of the batch."""
        intrinsic = None if victim.intrinsic is None else victim.intrinsic[list(own)]
        lenses = [one.intrinsic for one in truth if one.intrinsic is not None]
        if intrinsic is None and len(lenses) == len(truth):
            intrinsic = torch.stack(lenses).to(victim.clean)
        if intrinsic is None and self.surrogate.task == "3d":
            raise ConfigError(f"{self.name}: {self.surrogate.name} finds 3D boxes, and the intrinsics are missing")
        asked = Victim(
            self.surrogate,
            victim.clean[list(own)],
            truth,
            self._loss(),
            intrinsic=intrinsic,
            aim=aim,
            keys=[victim.keys[k] for k in own],
        )
        if self.check and self.inner.access == "white-box":
            check_gradient(asked)
        images = self.inner.perturb(asked, budget).detach()
        return torch.where(asked.idle[:, None, None, None], asked.clean, images)


def translate(truth: Truth, known: Sequence[str], wanted: Sequence[str]) -> tuple[Truth, tuple[int, ...]]:
    """The truth of an image with the labels of another detector.

    Args:
        truth: With labels that are indices into `known`.
        known: Names of classes.
        wanted: Names of the classes of the other detector.

    Returns:
        The truth of the objects whose class is among the wanted ones, and which objects these are.
    """
    table = [wanted.index(name) if name in wanted else -1 for name in known]
    label = torch.tensor([table[one] for one in truth.label.tolist()], dtype=truth.label.dtype)
    kept = torch.nonzero(label >= 0).flatten()
    solid = truth.solid
    if solid is not None:
        solid = Solids(
            solid.centre[kept], solid.size_lhw[kept], solid.yaw[kept], solid.velocity[kept], solid.attribute[kept]
        )
    crowd = None if truth.crowd is None else truth.crowd[kept]
    label = label[kept].to(truth.label.device)
    return Truth(label, truth.box[kept], solid, truth.intrinsic, crowd), tuple(kept.tolist())


def _translated(aim: Aim, kept: Sequence[int], surrogate: Detector) -> Aim:
    """The aim in an image of which some objects are kept, with the classes that the surrogate knows."""
    if aim.classes is not None:
        aim = replace(aim, classes=tuple(name for name in aim.classes if name in surrogate.classes))
    if aim.objects is not None:
        aim = replace(aim, objects=tuple(place for place, one in enumerate(kept) if one in aim.objects))
    becomes = {
        name: other for name, other in aim.becomes.items() if name in surrogate.classes and other in surrogate.classes
    }
    if aim.becomes and not becomes:
        aim = replace(aim, classes=())
    return replace(aim, becomes=becomes)


def _attacked(truth: Truth, aim: Aim, surrogate: Detector) -> bool:
    """Whether some object of an image that is no crowd is under attack."""
    names = list(aim.becomes) if aim.becomes else aim.classes
    for place, label in enumerate(truth.label.tolist()):
        crowd = truth.crowd is not None and bool(truth.crowd[place])
        wanted = names is None or surrogate.classes[label] in names
        if wanted and not crowd and (aim.objects is None or place in aim.objects):
            return True
    return False
