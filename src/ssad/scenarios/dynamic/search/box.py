"""Parameter boxes of bases as unit cubes, and the base class of gradient-free searches."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from ssad.core.errors import ConfigError, unknown_name
from ssad.core.generators import Base, Outcome, Proposal
from ssad.core.types import F64, Episode, Scenario
from ssad.scenarios.dynamic.catalogue import scenario_type
from ssad.scenarios.dynamic.parameters import (
    TARGET_SPEED,
    is_derived,
    parameter_values,
    scenario_parameters,
    violated_constraint,
    with_parameters,
)


@dataclasses.dataclass(frozen=True)
class ParameterBox:
    """Search space of a scenario: the parameters of its class, and those that it declares, over their full ranges.

    The ego's start and target speed are fixed, unless the scenario declares a parameter for them: a generator chooses
    what other agents do. What follows from other parameters by an expression is not searched.

    Attributes:
        scenario: The nominal scenario.
        ranges: Parameter name -> minimum and maximum.
    """

    scenario: Scenario
    ranges: dict[str, tuple[float, float]]

    @classmethod
    def of(cls, scenario: Scenario) -> ParameterBox:
        """Return the box of a scenario.

        Raises:
            ConfigError: It has no parameters with a range.
        """
        class_names = {
            parameter.name for parameter in scenario_type(scenario.type).parameters if parameter.name != TARGET_SPEED
        }
        declared_names = {name for name, declaration in scenario.declared.items() if declaration.range is not None}
        ranges = {
            name: (parameter.low, parameter.high)
            for name, parameter in scenario_parameters(scenario).items()
            if parameter.high > parameter.low
            and (name in declared_names or (name in class_names and not is_derived(scenario, name)))
        }
        if not ranges:
            raise ConfigError(
                f"scenario {scenario.name}: its type {scenario.type} has no parameters of other agents to search; "
                "declare some with a range (docs/how-to/sweep-parameters.md), take a scenario of another type, or the "
                "generators king and cat"
            )
        return cls(scenario, ranges)

    @property
    def dimension(self) -> int:
        """Number of parameters."""
        return len(self.ranges)

    def nominal(self) -> F64:
        """Return the scenario's own values as a point of the unit cube, clipped to the box."""
        nominal_values = parameter_values(self.scenario)
        shares: F64 = np.array(
            [(nominal_values[name] - low) / (high - low) for name, (low, high) in self.ranges.items()]
        )
        return shares.clip(0.0, 1.0)

    def scenario_at(self, point: npt.ArrayLike) -> Scenario:
        """Return the scenario at a point of the unit cube; coordinates outside are clipped."""
        shares = np.clip(np.asarray(point, np.float64), 0.0, 1.0).tolist()
        values = {
            # Rounding keeps saved scenarios short; the clip keeps a rounded bound valid.
            name: min(max(round(low + share * (high - low), 6), low), high)
            for share, (name, (low, high)) in zip(shares, self.ranges.items(), strict=True)
        }
        return with_parameters(self.scenario, values)

    def is_feasible(self, point: npt.ArrayLike) -> bool:
        """Return whether the scenario at a point of the unit cube meets its constraints."""
        return violated_constraint(self.scenario_at(point)) is None


OBJECTIVES: dict[str, Callable[[Outcome], float]] = {
    "proof": lambda outcome: outcome.proof_value,
    "danger": lambda outcome: outcome.danger,
}
"""Objectives that a search can maximise: see `Outcome`. `danger` also counts collisions with a standing ego."""


class BoxSearch(ABC):
    """Search over the parameter boxes of several bases, each independent of the others.

    Args:
        bases: The bases.
        seeds: Root of the random numbers of each.
        budget: Rollouts of each.
        objective: Name in `OBJECTIVES`; searches that do not learn have none.
    """

    name: ClassVar[str]

    def __init__(self, bases: Sequence[Base], *, seeds: Sequence[int], budget: int, objective: str = "proof") -> None:
        if objective not in OBJECTIVES:
            raise unknown_name("objective of a search", objective, OBJECTIVES)
        self._objective = OBJECTIVES[objective]
        self.boxes = [ParameterBox.of(base.scenario) for base in bases]
        self.budget = budget
        self.seeds = list(seeds)
        self._last_points: list[F64] = []

    @staticmethod
    def check(episode: Episode) -> None:
        """Check that an episode has parameters to search.

        Raises:
            ConfigError: It has none.
        """
        ParameterBox.of(episode.scenario)

    @abstractmethod
    def points(self, index: int, count: int) -> F64:
        """Return the next points [0 to count, D] of the unit cube to try in a base."""

    def learn(self, index: int, points: F64, danger: F64) -> None:  # noqa: B027  nothing to learn by default
        """Learn from the values [n] of points [n, D]; larger is better for the search."""

    def ask(self, count: int) -> list[list[Proposal]]:
        """Return the scenarios at the next points of each base."""
        self._last_points = [self.points(base_index, count) for base_index in range(len(self.boxes))]
        return [
            [Proposal(box.scenario_at(point)) for point in points]
            for box, points in zip(self.boxes, self._last_points, strict=True)
        ]

    def tell(self, outcomes: Sequence[Sequence[Outcome]]) -> None:
        """Pass the values of the proposed points to `learn`."""
        for base_index, (points, base_outcomes) in enumerate(zip(self._last_points, outcomes, strict=True)):
            self.learn(base_index, points, np.array([self._objective(outcome) for outcome in base_outcomes]))
