"""The parameter box of a base as the unit cube, and the outline of searches that need no gradient."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from ssad.core.errors import ConfigError
from ssad.core.generators import Base, Outcome, Proposal
from ssad.core.types import F64, Episode, Scenario
from ssad.scenarios.dynamic.catalog import scenario_type
from ssad.scenarios.dynamic.sampling import TARGET_SPEED


@dataclasses.dataclass(frozen=True)
class Box:
    """What may be varied in a scenario: the parameters of its class, all over the ranges that they allow.

    The ego's own start and target speed stay as they are: a generator chooses what others do.

    Attributes:
        scenario: The nominal scenario.
        ranges: Parameter -> least and greatest value.
    """

    scenario: Scenario
    ranges: dict[str, tuple[float, float]]

    @classmethod
    def of(cls, scenario: Scenario) -> Box:
        """The box of a scenario.

        Raises:
            ConfigError: Its class has no parameters.
        """
        kind = scenario_type(scenario.type)
        ranges = {p.name: (p.low, p.high) for p in kind.parameters if p.high > p.low and p.name != TARGET_SPEED}
        if not ranges:
            raise ConfigError(
                f"scenario {scenario.name}: its type {scenario.type} has no parameters of other agents to search; "
                "take one of another type, or the generators king and cat"
            )
        return cls(scenario, ranges)

    @property
    def dimension(self) -> int:
        """Number of parameters."""
        return len(self.ranges)

    def nominal(self) -> F64:
        """The scenario's own values as a point of the unit cube; the nearest one where they lie beyond."""
        value = scenario_type(self.scenario.type).values(self.scenario.parameters)
        shares: F64 = np.array([(value[name] - low) / (high - low) for name, (low, high) in self.ranges.items()])
        return shares.clip(0.0, 1.0)

    def at(self, point: npt.ArrayLike) -> Scenario:
        """The scenario at a point of the unit cube; what lies outside is cut."""
        shares = np.clip(np.asarray(point, np.float64), 0.0, 1.0).tolist()
        values = {
            name: min(max(round(low + share * (high - low), 6), low), high)
            for share, (name, (low, high)) in zip(shares, self.ranges.items(), strict=True)
        }
        return dataclasses.replace(self.scenario, parameters={**self.scenario.parameters, **values})


class BoxSearch(ABC):
    """A search over the parameter boxes of bases, one by one: they do not know of each other."""

    name: ClassVar[str]

    def __init__(self, bases: Sequence[Base], *, seeds: Sequence[int], budget: int) -> None:
        self.boxes = [Box.of(base.scenario) for base in bases]
        self.budget = budget
        self.seeds = list(seeds)
        self._asked: list[F64] = []

    @staticmethod
    def check(episode: Episode) -> None:
        """Whether there is anything to search in an episode.

        Raises:
            ConfigError: There is not.
        """
        Box.of(episode.scenario)

    @abstractmethod
    def points(self, index: int, count: int) -> F64:
        """The next points [0 to count, D] of the unit cube to try in a base."""

    def learn(self, index: int, points: F64, danger: F64) -> None:  # noqa: B027  nothing to learn by default
        """Take in how dangerous [n] the points [n, D] were, more is worse for the ego."""

    def ask(self, count: int) -> list[list[Proposal]]:
        """The scenarios at the next points."""
        self._asked = [self.points(k, count) for k in range(len(self.boxes))]
        return [
            [Proposal(box.at(point)) for point in points] for box, points in zip(self.boxes, self._asked, strict=True)
        ]

    def tell(self, outcomes: Sequence[Sequence[Outcome]]) -> None:
        """Learn from how dangerous they were."""
        for k, (points, row) in enumerate(zip(self._asked, outcomes, strict=True)):
            self.learn(k, points, np.array([outcome.danger for outcome in row]))
