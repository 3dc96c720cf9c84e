"""Cost of attacks on the images of a scene, and its sums over scenes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from ssad.scenarios.static.digital import AttackResult, Budget
from ssad.scenarios.static.digital.budget import LEVELS


@dataclass(slots=True)
class AttackTally:
    """Accumulated cost of attacks on the images of a scene.

    Attributes:
        images, idle: number of images, and of those without an object to attack.
        gradients, queries: forward and backward passes, and forward passes alone, over all images.
        before, after: sums of the losses.
        used: sum over the attacked images of the used share of the budget: mean change over the radius
            (L-infinity), or length over the radius (L2).
        change: the largest change of an image, in the norm, 8-bit code values.
        batch: the smallest number of images attacked at once for lack of memory, 0: none yet.
        gradient_error: of the gradient against finite differences; None: not checked.
        halved: how often a batch was halved for lack of memory.
        coupling: relative change of an image's loss when another one is in its batch; None: not checked.
        references: comparisons with the reference ensemble, one for each image that was chosen for it (see
            `ssad.scenarios.static.digital.reference_ensemble`).
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
    references: list[dict[str, Any]] = field(default_factory=list)

    def add(self, result: AttackResult, clean: Tensor, budget: Budget) -> None:
        """Count a batch of attacked images."""
        count = len(result.images)
        self.images += count
        self.idle += int(result.idle.sum())
        self.gradients += count * result.cost.gradients
        self.queries += count * result.cost.queries
        self.before += float(result.before.double().sum())
        self.after += float(result.after.double().sum())
        # Rounded to code values, as the written images are.
        change = ((result.images - clean).double() * LEVELS).round().abs().flatten(1)
        radius = max(budget.radius * LEVELS, 1e-9)
        change_sizes, mean_change = change.amax(1), change.mean(1)
        if budget.norm == "l2":
            change_sizes = mean_change = change.norm(dim=1)
        self.change = max(self.change, float(change_sizes.max()))
        self.used += float((mean_change / radius)[~result.idle].sum())
        self.batch = min(self.batch or count, count)

    def absorb(self, notes: Mapping[str, Any]) -> None:
        """Count the images of another tally; the checks of gradient and batch stay its own."""
        for name in ("images", "idle", "gradients", "queries", "before", "after", "used", "halved"):
            setattr(self, name, getattr(self, name) + notes[name])
        self.references += notes.get("references", ())  # absent from images of an older version
        self.change = max(self.change, notes["change"])
        self.batch = min(self.batch or notes["batch"], notes["batch"])

    def notes(self) -> dict[str, Any]:
        """Return the tally as plain data."""
        return {name: getattr(self, name) for name in self.__slots__}


def sum_notes(notes: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Sum the notes of the scenes of a cell (see `AttackTally`) into columns of its record.

    Args:
        notes: of each scene.

    Returns:
        access; images and idle; gradients, queries and mean losses before and after, per image; used, the mean
        share of the budget; change_px, the largest change; batch; halved; gradient_error and coupling, the
        largest, None if not checked; references, the comparisons with the reference ensemble.
    """
    active_notes = [note for note in notes if note["images"]]
    images = sum(note["images"] for note in active_notes)
    active_images = images - sum(note["idle"] for note in active_notes)

    def mean(name: str, count: int) -> float | None:
        # fsum is exact, so the order of the scenes cannot change the result.
        average = math.fsum(active_note[name] for active_note in active_notes) / count if count else math.nan
        return float(f"{average:.6g}") if math.isfinite(average) else None

    def largest(name: str) -> float | None:
        values = [active_note[name] for active_note in active_notes if active_note[name] is not None]
        return float(f"{max(values):.6g}") if values else None

    return {
        "access": notes[0]["access"] if notes else "",
        "images": images,
        "idle": images - active_images,
        "gradients": mean("gradients", images),
        "queries": mean("queries", images),
        "loss_before": mean("before", images),
        "loss_after": mean("after", images),
        "used": mean("used", active_images),
        "change_px": largest("change"),
        "batch": max((note["batch"] for note in active_notes), default=0),
        "halved": sum(note["halved"] for note in active_notes),
        "gradient_error": largest("gradient_error"),
        "coupling": largest("coupling"),
        # In the order of tokens: that of the scenes may differ between runs.
        "references": sorted(
            (comparison for note in notes for comparison in note.get("references", ())),
            key=lambda comparison: (comparison["attack"], comparison["token"]),
        ),
    }


def sum_members(notes_by_member: Sequence[Sequence[Mapping[str, Any]]]) -> dict[str, Any]:
    """Sum the notes of an attack over its scenes; those of an ensemble over its members too.

    Args:
        notes_by_member: notes of the scenes of each member.

    Returns:
        The columns of `sum_notes`.
    """
    member_sums = [sum_notes(member_notes) for member_notes in notes_by_member]
    total = dict(member_sums[0])
    if len(member_sums) > 1:
        for name in ("gradients", "queries"):
            total[name] = sum(member_sum[name] or 0.0 for member_sum in member_sums)
        for name in ("change_px", "gradient_error", "coupling"):
            total[name] = max(
                (member_sum[name] for member_sum in member_sums if member_sum[name] is not None), default=None
            )
        total["references"] = [comparison for member_sum in member_sums for comparison in member_sum["references"]]
        total |= dict.fromkeys(("loss_before", "loss_after", "used"))
        total["idle"] = min(member_sum["idle"] for member_sum in member_sums)
    return total
