"""Triggers of phases: the groups of conditions that they stand for, and the defaults of each kind."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from itertools import accumulate
from typing import Final

from ssad.core.errors import ConfigError
from ssad.core.types import Actor, EpisodeAgent, LateralPhase, Phase, PhaseTrigger

EGO: Final = "ego"
MAX_GROUPS: Final = 64  # ways in which a phase can begin
_ABOVE: Final = (
    *("ego_speed", "travelled", "speed", "relative_speed", "acceleration", "standstill"),
    *("time", "after"),
)
QUANTITIES: Final = (
    *("ego_distance", "ego_speed", "travelled", "speed", "relative_speed", "acceleration"),
    *("distance", "time_to_collision", "time_headway", "position"),
)
"""Kinds that compare a quantity with a threshold."""
PAIRS: Final = ("relative_speed", "distance", "time_to_collision", "time_headway")
"""Kinds that have a `reference`."""
AT_POSITION: Final = ("distance", "time_to_collision", "time_headway", "position")
"""Kinds that may have a `position`."""
PHASE_KINDS: Final = ("phase_start", "phase_end")
"""Kinds that refer to a phase."""


def trigger_groups(trigger: PhaseTrigger) -> tuple[tuple[PhaseTrigger, ...], ...]:
    """Return the groups of simple conditions that stand for a trigger: it holds if all conditions of one group hold.

    Args:
        trigger: The trigger, with `all` and `any` to any depth.

    Returns:
        Groups of triggers without `all` and `any`; at least one.

    Raises:
        ConfigError: There are more than 64 groups.
    """
    groups: tuple[tuple[PhaseTrigger, ...], ...] = ((),)
    if trigger.kind != "always" or not (trigger.all or trigger.any):
        groups = ((dataclasses.replace(trigger, all=(), any=()),),)
    for member in trigger.all:
        groups = _product(groups, trigger_groups(member))
    if trigger.any:
        groups = _product(groups, tuple(group for member in trigger.any for group in trigger_groups(member)))
    return groups


def _product(
    first: tuple[tuple[PhaseTrigger, ...], ...], second: tuple[tuple[PhaseTrigger, ...], ...]
) -> tuple[tuple[PhaseTrigger, ...], ...]:
    if len(first) * len(second) > MAX_GROUPS:
        raise ConfigError(f"its conditions combine in more than {MAX_GROUPS} ways; write several phases instead")
    return tuple(group + other for group in first for other in second)


def default_rule(kind: str) -> str:
    """Return the side of the threshold on which a condition of this kind holds: `above` or `below`."""
    return "above" if kind in _ABOVE else "below"


def reference_of(trigger: PhaseTrigger, actor: str) -> str:
    """Return the name of the other agent of a condition of `actor`."""
    if trigger.reference:
        return trigger.reference
    return actor if trigger.agent == EGO else EGO


def all_phases(agent: Actor | EpisodeAgent) -> tuple[Phase | LateralPhase, ...]:
    """Return the phases of an agent and its lateral phases, in the order of their rows."""
    phases: tuple[Phase | LateralPhase, ...] = agent.phases
    return phases + agent.lateral


def lanes_before(phases: Sequence[LateralPhase]) -> list[int]:
    """Return the number of lanes left of its path to which each lateral phase leads."""
    return list(accumulate(phase.lanes for phase in phases))
