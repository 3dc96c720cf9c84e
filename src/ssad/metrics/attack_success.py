"""Attack success rate: the share of the objects found clean that an attack hides, if enough are found clean."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssad.core.types import F64, I32, Bool
from ssad.metrics.intervals import MIN_CLUSTERS, Clusters, bounded_limits

N0 = {"ASR_25": "n0_25", "ASR_any_25": "n0_25", "ASR_50": "n0_50", "ASR_all_25": "n0_all_25"}
"""Metric with the number of objects that each attack success rate is a share of."""


@dataclass(frozen=True, slots=True)
class SuccessRate:
    """Attack success rate (ASR).

    Attributes:
        value: Share of the objects found clean that are not found attacked, 0 to 1; None: the clean detector finds
            too few.
        interval: 95 % interval over drives; None: no value, or too few drives.
        n0: Number of objects that the clean detector finds, of which the rate is the share.
    """

    value: float | None
    interval: list[float] | None
    n0: int


def attack_success_rate(
    is_found_clean: Bool,
    is_found_attacked: Bool,
    drive: I32,
    *,
    floor: float = 0.0,
    clean_share: float | None = None,
) -> SuccessRate:
    """Return the share of the objects that a detector finds clean and does not find attacked.

    What is rarely found clean says little when it is lost: below the floor there is no value.

    Args:
        is_found_clean: Objects that are found without the attack, above the threshold of the rate [N].
        is_found_attacked: Objects that are found with it, above the same threshold [N].
        drive: Drive of each object [N], for the interval.
        floor: Minimum share of objects found clean.
        clean_share: Share that is compared with the floor; None: that of these objects.
    """
    n0 = int(is_found_clean.sum())
    share = n0 / max(len(is_found_clean), 1) if clean_share is None else clean_share
    if share < floor:
        return SuccessRate(None, None, n0)
    return SuccessRate(*event_share(~is_found_attacked, is_found_clean, drive), n0)


def event_share(event: Bool, is_counted: Bool, drive: I32) -> tuple[float | None, list[float] | None]:
    """Return the share of the counted images with an event, and its interval over drives; None where none is counted.

    Args:
        event: Event of each image [N].
        is_counted: Mask of the images that count [N].
        drive: Drive of each image [N].
    """
    if not is_counted.any():
        return None, None
    drives, drive_of_counted = np.unique(drive[is_counted], return_inverse=True)
    drive_sizes = np.bincount(drive_of_counted).astype(np.float64)
    event_sums: F64 = np.bincount(drive_of_counted, weights=event[is_counted].astype(np.float64)).astype(np.float64)
    share = float(event_sums.sum() / drive_sizes.sum())
    if len(drives) < MIN_CLUSTERS:
        return share, None
    limits = bounded_limits(
        event_sums, Clusters(drive_sizes, np.zeros(len(drive_sizes), np.intp)), cap=2.0 * float(drive_sizes.sum())
    )
    return share, [float(limits.low), float(limits.high)]


def rate_note(floor: float) -> str:
    """Return what tables say about attack success rates: the meaning of n0, and the floor."""
    return (
        "n0: targets found clean above the score of the attack success rate (ASR), of which it is the share; n/a where "
        f"the target is found so in less than {floor:.0%} of the clean images."
    )
