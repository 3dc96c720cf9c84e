"""Proofs of collisions that a search has found: they are driven again, and careful drivers take the ego's place.

`ssad.metrics.proven_collisions` states the conditions.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from ssad.core.generators import Base, Outcome
from ssad.simulators.closed_loop import avoiders_of

if TYPE_CHECKING:
    from ssad.scenarios.dynamic.generate import Trials


def prove_collisions(collisions: Sequence[tuple[Base, Outcome]], trials: Trials) -> list[bool]:
    """Return for each collision whether it is proven: it happens again, and a careful driver avoids it.

    Args:
        collisions: Bases, and collisions that were found in them; any that cannot be proven are not driven again.
        trials: Test bench with the driving system that collided.
    """
    from ssad.scenarios.dynamic.generate import scenario_of
    from ssad.scenarios.dynamic.outcome import adversary_names, is_candidate, proof_of

    proven = [False] * len(collisions)
    candidates = [index for index, (base, outcome) in enumerate(collisions) if is_candidate(outcome, base.graph)]
    # another seed: a saved collision must not depend on the seed of its search
    replays = trials.bases(
        [
            (scenario_of(outcome, base, name="candidate"), base.graph, base.episode.seed + 1)
            for base, outcome in (collisions[index] for index in candidates)
        ]
    )
    # The conditions are cheap to check, so only what a careful driver alone decides is graded.
    graded = [
        (index, replay)
        for index, replay in zip(candidates, replays, strict=True)
        if replay.trace.end == "collision"
        and proof_of(replay.scenario, replay.trace, replay.graph, adversary_names(collisions[index][1])).is_candidate
    ]
    avoiders = avoiders_of([(replay.episode, replay.trace) for _, replay in graded], trials.device)
    for (index, _), avoids in zip(graded, avoiders, strict=True):
        proven[index] = any(avoids.values())
    return proven
