"""The collisions that a search has found: saved as scenarios, graded, and driven with other systems."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ssad.core.errors import ConfigError
from ssad.core.generators import Base, Outcome
from ssad.core.types import Episode, Scenario
from ssad.experiments.adversarial.search_scores import MOVING, distinct

AVOIDERS = {
    "cc": "CC",
    "reg157": "Reg157",
    "rss": "RSS",
    "fsm": "FSM",
    "limit": "a manoeuvre",
}
"""Short name in a grade -> who avoids a collision: the careful drivers, and the kinematic limit."""


def collides(base: Base) -> bool:
    """Whether a drive ends in a collision."""
    return bool(base.trace.end == "collision")


def saved_collisions(
    path: Path, base: Base, row: Sequence[Outcome], *, keep: int, stem: str
) -> tuple[list[Outcome], list[Scenario]]:
    """Write the most distinct collisions of a search as scenarios, if there are any.

    Args:
        path: The YAML file.
        base: What was searched.
        row: What came of each rollout.
        keep: How many are written.
        stem: Of their names.

    Returns:
        The collisions, and the scenarios.
    """
    from ssad.scenarios.dynamic import save_scenarios
    from ssad.scenarios.dynamic.generate import scenario_of

    found = distinct([outcome for outcome in row if outcome.valid])[:keep]
    made = [scenario_of(outcome, base, name=f"{stem}-{n}") for n, outcome in enumerate(found)]
    if made:
        save_scenarios(path, made)
    return found, made


def grades(rows: Sequence[Mapping[str, float]], collisions: Sequence[Base]) -> dict[str, float]:
    """Shares of collisions that each careful driver, any of them, and the kinematic limit avoid; {} without any.

    Args:
        rows: Who avoids each; see `ssad.drivers.careful.grade.Grade.metrics`.
        collisions: The collisions.
    """
    if not rows:
        return {}
    careful = [any(row[f"avoided_by_{name}"] for name in AVOIDERS if name != "limit") for row in rows]
    moving = [fine for fine, base in zip(careful, collisions, strict=True) if _moves(base)]
    shares = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    shares["attributable"] = float(np.mean(careful))
    return shares | ({"attributable_moving": float(np.mean(moving))} if moving else {})


def _moves(base: Base) -> bool:
    """Whether the ego moves when it is hit."""
    return abs(float(base.trace.speed[int(np.flatnonzero(base.trace.contact)[0]), 0])) > MOVING


def transfer(
    systems: Sequence[str],
    bases: Sequence[Base],
    made: Sequence[Sequence[Scenario]],
    device: str,
    *,
    seeds: Sequence[int],
) -> list[dict[str, dict[str, float]]]:
    """How other systems fare in what was found against one.

    Args:
        systems: The others.
        bases: What was searched.
        made: What was found in each, at least one scenario.
        device: Where the world computes.
        seeds: Of the episodes of each base.

    Returns:
        For each base: name of a system -> `base`, whether it collides in the base, and `found`, the share of `made` in
        which it does.
    """
    from ssad.drivers import make_system
    from ssad.scenarios.dynamic.generate import Trials

    rows: list[dict[str, dict[str, float]]] = [{} for _ in bases]
    groups = [
        [(one, base.graph, seed) for one in (base.scenario, *found)]
        for base, found, seed in zip(bases, made, seeds, strict=True)
    ]
    for name in systems:
        trials = Trials(partial(make_system, name), make_system, device=device)
        driven = iter(trials.bases([one for group in groups for one in group]))
        for row, group in zip(rows, groups, strict=True):
            hits = [float(collides(next(driven))) for _ in group]
            row[name] = {"base": hits[0], "found": float(np.mean(hits[1:]))}
    return rows


def refusal(factory: Any, episode: Episode) -> str:
    """Why a generator has nothing to change in an episode; "": it has."""
    check = getattr(factory, "check", None)
    try:
        if check is not None:
            check(episode)
    except ConfigError as error:
        return str(error)
    return ""
