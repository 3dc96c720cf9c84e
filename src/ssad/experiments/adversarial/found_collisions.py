"""Collisions found by a search: saved as scenarios, graded, and driven with other systems."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ssad.core.errors import ConfigError
from ssad.core.generators import Base, Outcome
from ssad.core.types import MOVING, Episode, Scenario
from ssad.experiments.adversarial.search_scores import distinct_collisions

if TYPE_CHECKING:
    from ssad.scenarios.dynamic.generate import Trials

AVOIDERS = {
    "cc": "CC",
    "reg157": "Reg157",
    "rss": "RSS",
    "fsm": "FSM",
    "limit": "a manoeuvre",
}
"""Short name in a grade -> who avoids a collision: the careful drivers, and the kinematic limit."""


def has_collision(base: Base) -> bool:
    """Return True if a drive ends in a collision."""
    return bool(base.trace.end == "collision")


def saved_collisions(
    path: Path, base: Base, row: Sequence[Outcome], *, limit: int, stem: str
) -> tuple[list[Outcome], list[Scenario]]:
    """Write the most distinct collisions of a search as scenarios, if there are any.

    Collisions that would be proven if a careful driver avoids them come first.

    Args:
        path: The YAML file.
        base: What was searched.
        row: What came of each rollout.
        limit: How many are written.
        stem: Of their names.

    Returns:
        The collisions, and the scenarios.
    """
    from ssad.scenarios.dynamic import save_scenarios
    from ssad.scenarios.dynamic.generate import scenario_of

    collisions = ranked_collisions(row, base)[:limit]
    scenarios = [scenario_of(outcome, base, name=f"{stem}-{index}") for index, outcome in enumerate(collisions)]
    if scenarios:
        save_scenarios(path, scenarios)
    return collisions, scenarios


def ranked_collisions(row: Sequence[Outcome], base: Base) -> list[Outcome]:
    """Return the distinct valid collisions of a search, first those that a careful driver alone keeps from proof."""
    from ssad.scenarios.dynamic.outcome import is_candidate

    valid = [outcome for outcome in row if outcome.is_valid]
    return distinct_collisions(sorted(valid, key=lambda outcome: not is_candidate(outcome, base.graph)))


def has_proof(
    replays: Sequence[Base], adversaries: Sequence[Sequence[str]], rows: Sequence[Mapping[str, float]] | None
) -> bool | None:
    """Return whether one of some saved collisions is proven, as it was driven again.

    Args:
        replays: The saved scenarios, driven again.
        adversaries: Names of the adversaries of each.
        rows: Who avoids each of the replays that collide; see `ssad.drivers.careful.grade.Grade.metrics`. None: they
            were not graded.

    Returns:
        None where only a grade that was not made decides.
    """
    from ssad.scenarios.dynamic.outcome import proof_of

    collisions = [(base, names) for base, names in zip(replays, adversaries, strict=True) if has_collision(base)]
    avoidable = [None] * len(collisions) if rows is None else [is_avoidable(row) for row in rows]
    proofs = [
        proof_of(base.scenario, base.trace, base.graph, names, avoidable=value).is_proven
        for (base, names), value in zip(collisions, avoidable, strict=True)
    ]
    return True if any(proofs) else None if None in proofs else False


def is_avoidable(row: Mapping[str, float]) -> bool:
    """Return True if a careful driver avoids a graded collision; the kinematic limit does not count."""
    return any(row[f"avoided_by_{name}"] for name in AVOIDERS if name != "limit")


def proven_bases(bases: Sequence[Base], rows: Sequence[Sequence[Outcome]], trials: Trials, *, limit: int) -> list[bool]:
    """Return for each base whether its search has found a proven collision.

    Args:
        bases: The bases.
        rows: Outcomes of the search in each.
        trials: Test bench with the driving system of the search.
        limit: Collisions of each search that are driven again and graded.
    """
    from ssad.simulators.proofs import prove_collisions

    ranked = [
        (index, outcome)
        for index, (base, row) in enumerate(zip(bases, rows, strict=True))
        for outcome in ranked_collisions(row, base)[:limit]
    ]
    proven = [False] * len(bases)
    proofs = prove_collisions([(bases[index], outcome) for index, outcome in ranked], trials)
    for (index, _), is_proven in zip(ranked, proofs, strict=True):
        proven[index] |= is_proven
    return proven


def grades(rows: Sequence[Mapping[str, float]], collisions: Sequence[Base]) -> dict[str, float]:
    """Shares of collisions that each careful driver, any of them, and the kinematic limit avoid; {} without any.

    Args:
        rows: Who avoids each; see `ssad.drivers.careful.grade.Grade.metrics`.
        collisions: The collisions.
    """
    if not rows:
        return {}
    avoidable = [is_avoidable(row) for row in rows]
    avoidable_moving = [value for value, base in zip(avoidable, collisions, strict=True) if _ego_moves(base)]
    shares_by_model = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    shares_by_model["attributable"] = float(np.mean(avoidable))
    return shares_by_model | ({"attributable_moving": float(np.mean(avoidable_moving))} if avoidable_moving else {})


def _ego_moves(base: Base) -> bool:
    """Return True if the ego moves when it is hit."""
    return abs(float(base.trace.speed[int(np.flatnonzero(base.trace.contact)[0]), 0])) > MOVING


def transfer(
    systems: Sequence[str],
    bases: Sequence[Base],
    scenarios_by_base: Sequence[Sequence[Scenario]],
    device: str,
    *,
    seeds: Sequence[int],
) -> list[dict[str, dict[str, float]]]:
    """Drive other systems through the scenarios that were found against one.

    Args:
        systems: The others.
        bases: What was searched.
        scenarios_by_base: What was found in each, at least one scenario.
        device: Where the world computes.
        seeds: Of the episodes of each base.

    Returns:
        For each base: name of a system -> `base`, whether it collides in the base, and `found`, the share
        of `scenarios_by_base` in which it does.
    """
    from ssad.drivers import make_system
    from ssad.scenarios.dynamic.generate import Trials

    rows: list[dict[str, dict[str, float]]] = [{} for _ in bases]
    episode_groups = [
        [(episode_spec, base.graph, seed) for episode_spec in (base.scenario, *scenarios)]
        for base, scenarios, seed in zip(bases, scenarios_by_base, seeds, strict=True)
    ]
    for name in systems:
        trials = Trials(partial(make_system, name), make_system, device=device)
        # All episodes of a system run as one batch; the iterator hands them back group by group.
        driven_bases = iter(trials.bases([episode_spec for episodes in episode_groups for episode_spec in episodes]))
        for system_rates, episodes in zip(rows, episode_groups, strict=True):
            collision_flags = [float(has_collision(next(driven_bases))) for _ in episodes]
            system_rates[name] = {"base": collision_flags[0], "found": float(np.mean(collision_flags[1:]))}
    return rows


def refusal_reason(factory: Any, episode: Episode) -> str:
    """Return the reason why a generator cannot change an episode; "" if it can."""
    check = getattr(factory, "check", None)
    try:
        if check is not None:
            check(episode)
    except ConfigError as error:
        return str(error)
    return ""
