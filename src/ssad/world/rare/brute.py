"""Plain Monte Carlo: many episodes, and how many of them fail."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ssad.core.types import Bool
from ssad.metrics.rare_events import RareEstimate, weighted_limits
from ssad.world.noise import Keys
from ssad.world.rare.process import Process

_KEPT = 100


def draw_keys(random: np.random.Generator, count: int) -> Keys:
    """As many keys of episodes."""
    return random.integers(0, 2**64, count, dtype=np.uint64)


def run(process: Process) -> Bool:
    """Run all rows of a process, which have just been reset, to their ends; [B] which have failed."""
    whole = getattr(process, "run", None)
    if whole is not None:
        return np.asarray(whole())
    while process.running().any():
        process.step()
    return np.asarray(process.score() >= 1.0)


def monte_carlo(
    process: Process, random: np.random.Generator, *, episodes: int, events: int | None = None
) -> Iterator[tuple[RareEstimate, Keys]]:
    """Run episodes until there have been `episodes` of them, or `events` failures; whole batches only.

    Args:
        process: The process.
        random: Where the episodes' keys come from.
        episodes: How many at least, unless there are enough failures before.
        events: Failures that are enough.

    Yields:
        After each batch the estimate so far, and the keys of the first failures, up to 100. Stopping at a number of
        failures makes the estimate too large by about one part in that number.
    """
    count = failures = 0
    found = draw_keys(random, 0)
    before = process.work()
    while count < episodes and (events is None or failures < events):
        keys = draw_keys(random, process.batch)
        process.reset(keys)
        failed = run(process)
        count += process.batch
        failures += int(failed.sum())
        found = np.concatenate([found, keys[failed]])[:_KEPT]
        low, high = weighted_limits(failures, failures, 1.0, count)
        yield (
            RareEstimate(
                failures / count,
                float(low),
                float(high),
                "Monte Carlo",
                count,
                failures,
                float(failures),
                process.work() - before,
            ),
            found,
        )
