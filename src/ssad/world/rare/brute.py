"""Plain Monte Carlo estimate of a failure probability."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ssad.core.types import Bool
from ssad.metrics.rare_events import RareEstimate, weighted_limits
from ssad.world.noise import Keys
from ssad.world.rare.process import Process

_KEPT = 100


def draw_keys(random: np.random.Generator, count: int) -> Keys:
    """Draw episode keys."""
    return random.integers(0, 2**64, count, dtype=np.uint64)


def run(process: Process) -> Bool:
    """Run all rows of a process that has just been reset to their ends; return [B] the failures."""
    run_all = getattr(process, "run", None)
    if run_all is not None:
        return np.asarray(run_all())
    while process.running().any():
        process.step()
    return np.asarray(process.score() >= 1.0)


def monte_carlo(
    process: Process, random: np.random.Generator, *, episodes: int, events: int | None = None
) -> Iterator[tuple[RareEstimate, Keys]]:
    """Run whole batches of episodes until `episodes` of them are complete, or `events` have failed.

    Args:
        process: The process.
        random: Source of the episodes' keys.
        episodes: Minimum number, unless there are enough failures before.
        events: Number of failures after which to stop; None: no limit.

    Yields:
        After each batch the estimate so far, and the keys of the first failures, up to 100. Stopping at a number of
        failures biases the estimate upwards by about one part in that number.
    """
    count = failures = 0
    failure_keys = draw_keys(random, 0)
    initial_work = process.work()
    while count < episodes and (events is None or failures < events):
        keys = draw_keys(random, process.batch)
        process.reset(keys)
        failed = run(process)
        count += process.batch
        failures += int(failed.sum())
        failure_keys = np.concatenate([failure_keys, keys[failed]])[:_KEPT]
        lower, upper = weighted_limits(failures, failures, 1.0, count)
        yield (
            RareEstimate(
                failures / count,
                float(lower),
                float(upper),
                "Monte Carlo",
                count,
                failures,
                float(failures),
                process.work() - initial_work,
            ),
            failure_keys,
        )
