"""Adaptive multilevel splitting: episodes that come nearest to failure are branched, again and again.

Of N particles those with the least greatest score are given up, ties included, and each is replaced by a copy of one of
the others from the first moment that this was beyond that level, with a future of its own. The product of the shares
that survive, times the share that fails in the end, has the failure probability as its mean for any N, score and number
of particles given up.

Source: Cerou and Guyader, "Adaptive multilevel splitting for rare event analysis" (2007); Brehier et al., "Unbiasedness
of some generalized adaptive multilevel splitting algorithms" (2016).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ssad.core.types import F64, Bool
from ssad.metrics.rare_events import RareEstimate, repeated_estimate
from ssad.world.noise import Keys
from ssad.world.rare.brute import draw_keys
from ssad.world.rare.process import Process


@dataclass(frozen=True)
class Splitting:
    """What splitting found.

    Attributes:
        estimates: [R] one for each independent repeat.
        levels: [R] how often particles were given up.
        failed: [B] which particles have failed in the end.
        keys: [T, B] the key of each particle's future at each step: by them it can be run again.
        work: [R] agent-steps of each repeat (exact if rows have the same number of agents, else shared out by steps).
        episodes: Particles that were run, copies included.
    """

    estimates: F64
    levels: npt.NDArray[np.int64]
    failed: Bool
    keys: Keys
    work: F64
    episodes: int

    def estimate(self) -> RareEstimate:
        """The mean of the repeats with its interval, which needs at least 8 of them."""
        events = int(self.failed.sum())
        return repeated_estimate(
            self.estimates.tolist(), "splitting", episodes=self.episodes, events=events, work=float(self.work.sum())
        )


class _History:
    """Every particle's path: states, greatest score so far and keys at each of its steps."""

    def __init__(self, process: Process, keys: Keys) -> None:
        self.process, self.rows = process, np.arange(process.batch)
        states = process.snapshot()
        self.states = {k: np.zeros((process.steps + 1, *v.shape), v.dtype) for k, v in states.items()}
        self.best = np.zeros((process.steps + 1, process.batch))
        self.keys = np.tile(keys, (process.steps + 1, 1))
        self.now = np.zeros(process.batch, np.int64)
        self.taken = np.zeros(process.batch)  # steps taken, of all lives
        self._keep(self.rows, np.full(process.batch, -np.inf))

    def _keep(self, rows: npt.NDArray[np.intp], before: F64) -> None:
        at = self.now[rows]
        for name, value in self.process.snapshot().items():
            self.states[name][at, rows] = value[rows]
        self.best[at, rows] = np.maximum(before, self.process.score()[rows])

    def finish(self) -> None:
        """Run all that have not ended."""
        while (going := self.process.running()).any():
            rows = np.flatnonzero(going)
            before = self.best[self.now[rows], rows]
            self.process.step()
            self.now[rows] += 1
            self.taken[rows] += 1
            self._keep(rows, before)

    def final(self) -> F64:
        """[B] greatest score of each."""
        return self.best[self.now, self.rows]

    def branch(self, rows: npt.NDArray[np.intp], parents: npt.NDArray[np.intp], level: F64, *, keys: Keys) -> None:
        """Replace rows by copies of others from the first step at which these were beyond `level`, with new keys."""
        times = np.arange(len(self.best))[:, None]
        beyond = (self.best[:, parents] > level) & (times <= self.now[parents])
        first = beyond.argmax(axis=0)
        until = int(first.max()) + 1
        for array in (self.best, self.keys, *self.states.values()):
            array[:until, rows] = array[:until, parents]
        later = times >= first
        self.keys[:, rows] = np.where(later, keys, self.keys[:, rows])
        self.now[rows] = first
        self.process.put(rows, {name: value[first, parents] for name, value in self.states.items()})
        self.process.rekey(rows, keys)


def splitting(
    process: Process, random: np.random.Generator, *, repeats: int, kill: float = 0.25, levels: int = 2000
) -> Splitting:
    """Estimate the probability of failure by splitting.

    Args:
        process: The process; each repeat has batch / repeats of its rows as particles.
        random: Where keys and the choice of parents come from.
        repeats: Independent runs, side by side.
        kill: Share of the particles that is given up at each level, at least one.
        levels: Levels after which it stops; what has not failed by then counts as not failing.

    Returns:
        The estimates.
    """
    count = process.batch // repeats
    if count * repeats != process.batch or count < 2:
        raise ValueError(f"{process.batch} rows do not make {repeats} repeats of two particles or more")
    worst = max(1, int(kill * count))
    before = process.work()
    keys = draw_keys(random, process.batch)
    process.reset(keys)
    history = _History(process, keys)
    history.finish()
    share, passed = np.ones(repeats), np.zeros(repeats, np.int64)
    born = process.batch
    for _ in range(levels):
        final = history.final().reshape(repeats, count)
        level = np.sort(final, axis=1)[:, worst - 1]
        dies = (final <= level[:, None]) & (level < 1.0)[:, None] & (share > 0.0)[:, None]
        share *= 1.0 - dies.mean(axis=1)
        dies &= (share > 0.0)[:, None]  # where all died at once the estimate is 0
        passed += dies.any(axis=1)
        rows = np.flatnonzero(dies)
        if not len(rows):
            break
        # a parent for each, uniformly among its repeat's survivors
        alive = ~dies
        order = np.argsort(~alive, axis=1, kind="stable")
        own = rows // count
        pick = (random.random(len(rows)) * alive.sum(axis=1)[own]).astype(np.int64)
        parents = own * count + order[own, pick]
        history.branch(rows, parents, level[own], keys=draw_keys(random, len(rows)))
        born += len(rows)
        history.finish()
    failed = history.final() >= 1.0
    estimates = share * failed.reshape(repeats, count).mean(axis=1)
    work = (process.work() - before) * history.taken.reshape(repeats, count).sum(axis=1) / history.taken.sum()
    return Splitting(estimates, passed, failed, history.keys, work, born)


def keys_of(found: Splitting, row: int) -> Mapping[int, int]:
    """From which step on a particle had which key: what it takes to run it again."""
    column: Any = found.keys[:, row]
    changes = [0, *(np.flatnonzero(column[1:] != column[:-1]) + 1).tolist()]
    return {int(step): int(column[step]) for step in changes}
