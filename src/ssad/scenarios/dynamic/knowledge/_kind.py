"""What a scenario class is: a name, a parameter box, and a function that places and scripts its actors."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from ssad.core.errors import ConfigError
from ssad.core.types import EpisodeAgent, Route, Scenario, SignalPlan, TrafficPlan

if TYPE_CHECKING:
    from ssad.core.lane_graph import LaneGraph


@dataclass(frozen=True)
class Parameter:
    """One number that varies a scenario: its range and default, both in `unit`."""

    name: str
    low: float
    high: float
    default: float
    unit: str
    doc: str

    def __post_init__(self) -> None:
        if not self.low <= self.default <= self.high:
            raise ValueError(f"{self.name}: default {self.default} outside [{self.low}, {self.high}]")

    def problem(self, value: float) -> str | None:
        """What is wrong with `value`, None if nothing."""
        if math.isfinite(value) and self.low <= value <= self.high:
            return None
        unit = f" {self.unit}" if self.unit else ""
        return f"{value:g} is outside {self.low:g} to {self.high:g}{unit} ({self.doc})"


Build: TypeAlias = "Callable[[Scenario, LaneGraph, Route, np.random.Generator], Sequence[EpisodeAgent]]"


@dataclass(frozen=True)
class ScenarioType:
    """A scenario class.

    title: its name in the paper; nhtsa: the pre-crash situation it comes from; build: (scenario, lane
    graph, the ego's route, random numbers) -> the agents after the ego, in the order that `Condition.actor`
    counts; signals, traffic: what a scenario gets that leaves them at their defaults; max_distance: m that
    the ego may drive; whole_town: the signal plan covers every signal of the map, not only the junctions on
    the route.
    """

    name: str
    title: str
    nhtsa: str
    build: Build
    parameters: tuple[Parameter, ...] = ()
    signals: SignalPlan = field(default_factory=SignalPlan)
    traffic: TrafficPlan | None = None
    max_distance: float = 1.0e9
    whole_town: bool = False

    @property
    def box(self) -> dict[str, Parameter]:
        """Parameters by name."""
        return {p.name: p for p in self.parameters}

    def values(self, given: Mapping[str, float]) -> dict[str, float]:
        """All parameters, `given` over the defaults. ConfigError for an unknown name or a bad value."""
        box = self.box
        for name, value in given.items():
            problem = (
                box[name].problem(value) if name in box else f"no such parameter; known: {', '.join(box) or 'none'}"
            )
            if problem:
                raise ConfigError(f"{self.name}: parameter {name}: {problem}")
        return {name: float(given.get(name, p.default)) for name, p in box.items()}
