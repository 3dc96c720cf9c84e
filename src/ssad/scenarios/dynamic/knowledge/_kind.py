"""Definition of a scenario class: a name, a parameter box, and a function that places and scripts its actors."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from ssad.core.errors import ConfigError
from ssad.core.types import EpisodeAgent, Route, Scenario, SignalPlan, TrafficPlan

if TYPE_CHECKING:
    from ssad.core.lane_graph import LaneGraph


@dataclass(frozen=True)
class Parameter:
    """Numeric parameter of a scenario class.

    Attributes:
        name: Key in `Scenario.parameters`.
        low: Minimum of the search range, in `unit`.
        high: Maximum of the search range, in `unit`.
        default: Value of a scenario that omits the parameter, in `unit`.
        unit: Unit of the values, "" for a plain number.
        doc: Meaning of the number.
        spread: Maximum deviation of a random draw from the scenario's own value at spread 1, in `unit`; 0: never
            drawn.
        allowed: Minimum and maximum that a scenario may use, in `unit`; None: `low` and `high`.
    """

    name: str
    low: float
    high: float
    default: float
    unit: str
    doc: str
    spread: float = 0.0
    allowed: tuple[float, float] | None = None

    @property
    def limits(self) -> tuple[float, float]:
        """Minimum and maximum that a scenario may use, in `unit`."""
        return self.allowed or (self.low, self.high)

    def __post_init__(self) -> None:
        if not self.low <= self.default <= self.high:
            raise ValueError(f"{self.name}: default {self.default} outside [{self.low}, {self.high}]")
        if not 0.0 <= self.spread <= self.high - self.low:
            raise ValueError(f"{self.name}: spread {self.spread} outside [0, {self.high - self.low}]")

    def problem(self, value: float) -> str | None:
        """Return the problem of a value, if any.

        Args:
            value: The value, in `unit`.

        Returns:
            A message, or None if the value is allowed.
        """
        low, high = self.limits
        if math.isfinite(value) and low <= value <= high:
            return None
        unit = f" {self.unit}" if self.unit else ""
        return f"{value:g} is outside {low:g} to {high:g}{unit} ({self.doc})"


MAX_EGO_SPEED = 40.0  # m/s

EGO_START: tuple[Parameter, ...] = (
    Parameter("ego_speed", 0.0, 15.0, 0.0, "m/s", "speed of the ego at the start", 2.0, (0.0, MAX_EGO_SPEED)),
    Parameter("ego_longitudinal", 0.0, 10.0, 0.0, "m", "from the start of the route along it to the ego", spread=4.0),
    Parameter("ego_lateral", -1.0, 1.0, 0.0, "m", "ego to the left of its route", spread=0.375),
    Parameter("ego_heading", -0.2, 0.2, 0.0, "rad", "turn of the ego to the left of its route", spread=0.03),
)
"""How the ego starts: parameters that every scenario class has. Nominally it stands at the start of its route.

Draws are even within the spread, so their standard deviation is spread / sqrt(3).
Lateral: 0.375 m is the zone in which a car wanders within its lane (UN Regulation 157, annex 4, appendix 3); standard
deviation 0.22 m. Heading: that of a car which crosses those 0.375 m in 1.5 s at 8 m/s. Longitudinal: about a car's
length. Speed: from a standstill, as in SafeBench, to rolling.
"""

TARGET_SPEED_SPREAD = 0.125
"""How far a repetition may draw the ego's target speed at spread 1, as a share of it: standard deviation 7 %.

Drivers on a free road differ by 5 to 10 % (SUMO gives its cars 10 %).
"""

SPEED_SPREAD = 0.125
"""The same share for the speeds of scripted vehicles."""

Build: TypeAlias = "Callable[[Scenario, LaneGraph, Route, np.random.Generator], Sequence[EpisodeAgent]]"


@dataclass(frozen=True)
class ScenarioType:
    """A scenario class.

    Attributes:
        name: Name in `Scenario.type`.
        title: Name in the paper.
        nhtsa: Pre-crash situation of the NHTSA typology.
        build: (scenario, lane graph, the ego's route, random numbers) -> the agents after the ego, in the order that
            `Condition.actor` counts.
        parameters: Parameters of the class; those of the ego start (`EGO_START`) are added.
        signals: Default signal plan.
        traffic: Default traffic.
        max_distance: Maximum distance of the ego, m.
        whole_town: The signal plan covers every signal of the map, not only the junctions on the route.
        scenarios: Scenarios that the name of the class stands for in a suite; those of SSAD's classes are in its sets.
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
    scenarios: tuple[Scenario, ...] = ()

    def __post_init__(self) -> None:
        if len(self.box) != len(self.parameters) + len(EGO_START):
            raise ValueError(f"{self.name}: a parameter's name is there twice: {', '.join(self.box)}")

    @cached_property
    def box(self) -> Mapping[str, Parameter]:
        """Parameters by name: those of the class, then those of the ego start."""
        return {parameter.name: parameter for parameter in (*self.parameters, *EGO_START)}

    def values(self, overrides: Mapping[str, float]) -> dict[str, float]:
        """Return the value of every parameter.

        Args:
            overrides: Parameter name -> value, in the parameter's unit; the others have their defaults.

        Returns:
            Parameter name -> value for all of `box`.

        Raises:
            ConfigError: A name is unknown, or a value out of range.
        """
        parameters = self.box
        for name, value in overrides.items():
            problem = (
                parameters[name].problem(value)
                if name in parameters
                else f"no such parameter; known: {', '.join(parameters)}"
            )
            if problem:
                raise ConfigError(f"{self.name}: parameter {name}: {problem}")
        return {name: float(overrides.get(name, parameter.default)) for name, parameter in parameters.items()}
