"""Adaptive multilevel splitting: episodes that come nearest to failure are branched repeatedly.

Of N particles, those with the smallest maximum score are discarded, ties included. Each is replaced by a copy of a
survivor from the first moment at which that one exceeded the level, with an independent future. The product of the
surviving shares, times the share that fails in the end, is an unbiased estimate of the failure probability for any N,
score and number of discarded particles.

That holds if a copy is one: nothing that decides the future may be missing from snapshots. A process with external
code is tested twice. Before the first level, every episode is continued from one of its moments in the row of another,
and must go the same way. After the last one, every particle is run from its start by its keys alone, and must end the
same.

Source: Cerou and Guyader, "Adaptive multilevel splitting for rare event analysis" (2007); Brehier et al.,
"Unbiasedness of some generalized adaptive multilevel splitting algorithms" (2016).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ssad.core.errors import ConfigError
from ssad.core.seeding import generator
from ssad.core.types import F64, Bool
from ssad.metrics.rare_events import RareEstimate, repeated_estimate
from ssad.world.noise import Keys
from ssad.world.rare.brute import draw_keys
from ssad.world.rare.process import Process


@dataclass(frozen=True)
class Splitting:
    """Result of splitting.

    Attributes:
        estimates: [R] one for each independent repeat.
        levels: [R] number of levels at which particles were discarded.
        failed: [B] mask of the particles that have failed in the end.
        keys: [T, B] key of each particle's future at each step; they suffice to replay it.
        work: [R] agent-steps of each repeat (exact if rows have the same number of agents, else shared out by steps).
        episodes: Number of particles run, copies included.
    """

    estimates: F64
    levels: npt.NDArray[np.int64]
    failed: Bool
    keys: Keys
    work: F64
    episodes: int

    def estimate(self) -> RareEstimate:
        """Return the mean of the repeats with its interval, which needs at least 8 of them."""
        events = int(self.failed.sum())
        return repeated_estimate(
            self.estimates.tolist(), "splitting", episodes=self.episodes, events=events, work=float(self.work.sum())
        )


class _History:
    """Path of every particle: states, maximum score so far and keys at each of its steps."""

    def __init__(self, process: Process, keys: Keys) -> None:
        self.process, self.rows = process, np.arange(process.batch)
        states = process.snapshot()
        self.states = {
            name: np.zeros((process.steps + 1, *values.shape), values.dtype) for name, values in states.items()
        }
        self.best = np.zeros((process.steps + 1, process.batch))
        # A particle can be replayed from its keys alone, so they are kept for every step.
        self.keys = np.tile(keys, (process.steps + 1, 1))
        self.now = np.zeros(process.batch, np.int64)
        self.step_counts = np.zeros(process.batch)  # steps taken, of all lives
        self._keep(self.rows, np.full(process.batch, -np.inf))

    def _keep(self, rows: npt.NDArray[np.intp], before: F64) -> None:
        steps = self.now[rows]
        for name, value in self.process.snapshot().items():
            self.states[name][steps, rows] = value[rows]
        self.best[steps, rows] = np.maximum(before, self.process.score()[rows])

    def finish(self) -> None:
        """Run all particles that have not ended."""
        while (running := self.process.running()).any():
            rows = np.flatnonzero(running)
            previous_best = self.best[self.now[rows], rows]
            self.process.step()
            self.now[rows] += 1
            self.step_counts[rows] += 1
            self._keep(rows, previous_best)

    def final(self) -> F64:
        """Return the maximum score of each particle, [B]."""
        return self.best[self.now, self.rows]

    def branch(self, rows: npt.NDArray[np.intp], parents: npt.NDArray[np.intp], level: F64, *, keys: Keys) -> None:
        """Replace rows by copies of others from the first step at which these exceeded `level`, with new keys."""
        times = np.arange(len(self.best))[:, None]
        beyond = (self.best[:, parents] > level) & (times <= self.now[parents])
        branch_steps = beyond.argmax(axis=0)
        copied_steps = int(branch_steps.max()) + 1
        for array in (self.best, self.keys, *self.states.values()):
            array[:copied_steps, rows] = array[:copied_steps, parents]
        later = times >= branch_steps
        self.keys[:, rows] = np.where(later, keys, self.keys[:, rows])
        self.now[rows] = branch_steps
        self.process.put(rows, {name: value[branch_steps, parents] for name, value in self.states.items()})
        self.process.rekey(rows, keys)

    def check_branches(self) -> None:
        """Continue each episode, which has ended, from a moment of its own in another row, and compare each step.

        Raises:
            ConfigError: An episode went another way.
        """
        process, parents = self.process, np.roll(self.rows, 1)
        last_steps = self.now[parents]
        now = (generator("branch test").random(process.batch) * last_steps).astype(np.int64)
        process.put(self.rows, {name: values[now, parents] for name, values in self.states.items()})
        process.rekey(self.rows, self.keys[0, parents])
        differs, first_steps = np.zeros(process.batch, bool), []
        while (running := process.running()).any():
            rows = np.flatnonzero(running)
            process.step()
            now[rows] += 1
            self.step_counts[rows] += 1
            is_new = _different(process.snapshot(), self.states, rows, (now[rows], parents[rows])) & ~differs[rows]
            first_steps += now[rows[is_new]].tolist()
            differs[rows[is_new]] = True
        if differs.any():
            raise ConfigError(
                f"{process.name}: {differs.sum()} of {process.batch} episodes went another way from a restored "
                f"snapshot, the first in step {min(first_steps)}: snapshot() and restore(states) must cover all that "
                "its actions depend on, separately for each episode (ssad.core.driving.Branching); or set "
                "methods=[monte-carlo]"
            )
        process.put(self.rows, {name: values[self.now, self.rows] for name, values in self.states.items()})
        process.rekey(self.rows, self.keys[0])

    def check_lives(self) -> None:
        """Run every particle again from its start by its keys, and compare the ends.

        Raises:
            ConfigError: A particle ended otherwise.
        """
        process, step, differs = self.process, 0, np.zeros(self.process.batch, bool)
        process.reset(self.keys[0])
        while (running := process.running()).any():
            changed = np.flatnonzero(self.keys[step] != self.keys[max(step - 1, 0)])
            process.rekey(changed, self.keys[step, changed])
            process.step()
            self.step_counts[running] += 1
            step += 1
            # A driver is called for ended rows too, and may go on to change what it remembers of them.
            rows = np.flatnonzero(running & ~process.running())
            differs[rows] = _different(process.snapshot(), self.states, rows, (self.now[rows], rows))
        if differs.any():
            raise ConfigError(
                f"{process.name}: {differs.sum()} of {process.batch} branched episodes end otherwise where they are "
                "driven from the start: snapshot() and restore(states) must cover all that its actions depend on, "
                "separately for each episode (ssad.core.driving.Branching); or set methods=[monte-carlo]"
            )


def _different(
    states: Mapping[str, npt.NDArray[Any]],
    history: Mapping[str, npt.NDArray[Any]],
    rows: npt.NDArray[np.intp],
    places: tuple[npt.NDArray[np.int64], npt.NDArray[np.intp]],
) -> Bool:
    """Return the rows whose states differ in any bit from those at places (step, row) of a history."""
    differs = np.zeros(len(rows), bool)
    for name, values in states.items() if len(rows) else ():
        current, recorded = (np.ascontiguousarray(array) for array in (values[rows], history[name][places]))
        equal = current.view(np.uint8).reshape(len(rows), -1) == recorded.view(np.uint8).reshape(len(rows), -1)
        differs |= ~equal.all(axis=1)
    return differs


def splitting(
    process: Process, random: np.random.Generator, *, repeats: int, kill: float = 0.25, levels: int = 2000
) -> Splitting:
    """Estimate the probability of failure by splitting.

    Args:
        process: The process; each repeat has batch / repeats of its rows as particles.
        random: Source of the keys and of the choice of parents.
        repeats: Independent runs, side by side.
        kill: Share of the particles that is discarded at each level, at least one.
        levels: Maximum number of levels; particles that have not failed by then count as not failing.

    Returns:
        The estimates.

    Raises:
        ConfigError: Rows cannot branch, or a branch is no copy.
    """
    particles = process.batch // repeats
    if particles * repeats != process.batch or particles < 2:
        raise ValueError(f"{process.batch} rows do not make {repeats} repeats of two particles or more")
    discarded = max(1, int(kill * particles))
    initial_work = process.work()
    keys = draw_keys(random, process.batch)
    process.reset(keys)
    history = _History(process, keys)
    history.finish()
    if process.external:
        history.check_branches()
    survival, passed_levels = np.ones(repeats), np.zeros(repeats, np.int64)
    particle_count = process.batch
    for _ in range(levels):
        best_scores = history.final().reshape(repeats, particles)
        thresholds = np.sort(best_scores, axis=1)[:, discarded - 1]
        dying = (best_scores <= thresholds[:, None]) & (thresholds < 1.0)[:, None] & (survival > 0.0)[:, None]
        survival *= 1.0 - dying.mean(axis=1)
        dying &= (survival > 0.0)[:, None]  # where all died at once the estimate is 0
        passed_levels += dying.any(axis=1)
        replaced = np.flatnonzero(dying)
        if not len(replaced):
            break
        # a parent for each, uniformly among its repeat's survivors
        alive = ~dying
        survivors_first = np.argsort(~alive, axis=1, kind="stable")
        repeat_index = replaced // particles
        choice = (random.random(len(replaced)) * alive.sum(axis=1)[repeat_index]).astype(np.int64)
        parents = repeat_index * particles + survivors_first[repeat_index, choice]
        history.branch(replaced, parents, thresholds[repeat_index], keys=draw_keys(random, len(replaced)))
        particle_count += len(replaced)
        history.finish()
    if process.external:
        history.check_lives()
    failed = history.final() >= 1.0
    estimates = survival * failed.reshape(repeats, particles).mean(axis=1)
    work = (
        (process.work() - initial_work)
        * history.step_counts.reshape(repeats, particles).sum(axis=1)
        / history.step_counts.sum()
    )
    return Splitting(estimates, passed_levels, failed, history.keys, work, particle_count)


def keys_of(result: Splitting, row: int) -> Mapping[int, int]:
    """Return the keys of a particle by their first steps: all that a rerun needs."""
    row_keys: Any = result.keys[:, row]
    changes = [0, *(np.flatnonzero(row_keys[1:] != row_keys[:-1]) + 1).tolist()]
    return {int(step): int(row_keys[step]) for step in changes}
