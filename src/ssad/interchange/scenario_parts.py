"""Parts of a scenario that all readers of foreign formats build in the same way."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Final, Literal

from ssad.core.lane_graph import LaneGraph
from ssad.core.types import Route, SignalPlan, SignalState
from ssad.scenarios.dynamic.episode import forced_signals

_OTHER = re.compile(r"[^A-Za-z0-9_.:@+\-]+")
_CHOICES: Final[tuple[Literal["program", "off", "red", "green"], ...]] = ("program", "off", "red", "green")


def scenario_name(text: str) -> str:
    """Convert a text to a scenario name: invalid characters become -; "" if nothing remains."""
    parts = [_OTHER.sub("-", part).strip("-._:@+") for part in text.strip().split("/")]
    return "/".join(part for part in parts if part)[:120]


def plan_of(graph: LaneGraph, route: Route, states: Mapping[int, SignalState], until: float) -> SignalPlan | None:
    """The plan that forces just these states.

    Args:
        graph: Lane graph of the town.
        route: The ego's route.
        states: Signal of the town -> its state.
        until: When they end, s.

    Returns:
        The plan; None: no plan does that.
    """
    for ego_choice in _CHOICES:
        for other_choice in _CHOICES:
            for elsewhere in _CHOICES if ego_choice == "red" else _CHOICES[:1]:
                plan = SignalPlan(ego_choice, other_choice, until, elsewhere)
                if forced_signals(graph, route, plan) == states:
                    return plan
    return None
