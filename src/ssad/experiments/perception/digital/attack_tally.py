"""What attacks on the images of a scene took, and the sums of it over scenes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from ssad.scenarios.static.digital import Attacked, Budget
from ssad.scenarios.static.digital.budget import LEVELS


@dataclass(slots=True)
class Tally:
    """What attacks on the images of a scene took, put together.

    Attributes:
        images, idle: how many, and how many of them held nothing to attack.
        gradients, queries: forward and backward passes, and forward passes alone, over all images.
        before, after: sums of the losses.
        used: sum over the images that were attacked of the share of the budget that was used: mean change over the
            radius (L-infinity), or length over the radius (L2).
        change: the largest change of an image, in the norm, 8-bit code values.
        batch: the least number of images that had to be attacked at once for lack of memory, 0: none yet.
        gradient_error: of the gradient against finite differences; None: not looked at.
        halved: how often a batch was halved for lack of memory.
        coupling: relative change of an image's loss when another one is in its batch; None: not looked at.
        access: of the attack.
    """

    access: str
    images: int = 0
    idle: int = 0
    gradients: int = 0
    queries: int = 0
    before: float = 0.0
    after: float = 0.0
    used: float = 0.0
    change: float = 0.0
    batch: int = 0
    halved: int = 0
    gradient_error: float | None = None
    coupling: float | None = None

    def add(self, found: Attacked, clean: Tensor, budget: Budget) -> None:
        """Counts a batch of attacked images."""
        count = len(found.images)
        self.images += count
        self.idle += int(found.idle.sum())
        self.gradients += count * found.cost.gradients
        self.queries += count * found.cost.queries
        self.before += float(found.before.double().sum())
        self.after += float(found.after.double().sum())
        change = ((found.images - clean).double() * LEVELS).round().abs().flatten(1)
        radius = max(budget.radius * LEVELS, 1e-9)
        sizes, mean = change.amax(1), change.mean(1)
        if budget.norm == "l2":
            sizes = mean = change.norm(dim=1)
        self.change = max(self.change, float(sizes.max()))
        self.used += float((mean / radius)[~found.idle].sum())
        self.batch = min(self.batch or count, count)

    def absorb(self, notes: Mapping[str, Any]) -> None:
        """Counts the images that another tally noted; the checks of gradient and batch stay its own."""
        for name in ("images", "idle", "gradients", "queries", "before", "after", "used", "halved"):
            setattr(self, name, getattr(self, name) + notes[name])
        self.change = max(self.change, notes["change"])
        self.batch = min(self.batch or notes["batch"], notes["batch"])

    def notes(self) -> dict[str, Any]:
        """Plain data."""
        return {name: getattr(self, name) for name in self.__slots__}


def sum_notes(notes: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """What the scenes of a cell noted (see `Tally`) as columns of its record.

    Args:
        notes: of each scene.

    Returns:
        access; images and idle; gradients, queries and mean losses before and after, an image; used, the mean share of
        the budget; change_px, the largest change; batch; halved; gradient_error and coupling, the largest, None where
        they were not looked at.
    """
    some = [one for one in notes if one["images"]]
    images = sum(one["images"] for one in some)
    active = images - sum(one["idle"] for one in some)

    def mean(name: str, count: int) -> float | None:
        value = math.fsum(one[name] for one in some) / count if count else math.nan
        return float(f"{value:.6g}") if math.isfinite(value) else None

    def largest(name: str) -> float | None:
        known = [one[name] for one in some if one[name] is not None]
        return float(f"{max(known):.6g}") if known else None

    return {
        "access": notes[0]["access"] if notes else "",
        "images": images,
        "idle": images - active,
        "gradients": mean("gradients", images),
        "queries": mean("queries", images),
        "loss_before": mean("before", images),
        "loss_after": mean("after", images),
        "used": mean("used", active),
        "change_px": largest("change"),
        "batch": max((one["batch"] for one in some), default=0),
        "halved": sum(one["halved"] for one in some),
        "gradient_error": largest("gradient_error"),
        "coupling": largest("coupling"),
    }


def sum_members(noted: Sequence[Sequence[Mapping[str, Any]]]) -> dict[str, Any]:
    """What an attack noted in its scenes, summed; of an ensemble what its members noted together.

    Args:
        noted: of each member, what its scenes noted.

    Returns:
        The columns of `sum_notes`.
    """
    parts = [sum_notes(one) for one in noted]
    found = dict(parts[0])
    if len(parts) > 1:
        for name in ("gradients", "queries"):
            found[name] = sum(part[name] or 0.0 for part in parts)
        for name in ("change_px", "gradient_error", "coupling"):
            found[name] = max((part[name] for part in parts if part[name] is not None), default=None)
        found |= dict.fromkeys(("loss_before", "loss_after", "used"))
        found["idle"] = min(part["idle"] for part in parts)
    return found
