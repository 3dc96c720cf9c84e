"""Published statistics of human driving, each with its source and how sure it is.

The values stand in `human_driving.toml`, the one place that the reference statistics of traffic and the population of
drivers read.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from typing import Any, Literal

import numpy as np

from ssad.core.errors import ConfigError
from ssad.core.types import F64

Certainty = Literal["read", "cited", "memory"]
"""Origin of a value: read in its source, cited by a text that was read, or recalled without a check."""


@dataclass(frozen=True)
class Statistic:
    """A published value.

    Attributes:
        quantity: The measured quantity, such as `time gap`.
        population: The drivers or walkers, and the place.
        unit: Unit of all its numbers; "" for a ratio.
        source: Authors, year, title.
        address: Address of the source.
        place: Table, section or abstract.
        certainty: See `Certainty`.
        mean: Mean; None: not given.
        sd: Standard deviation; None: not given.
        low: Lower bound of a stated range; None: not given.
        high: Upper bound of a stated range; None: not given.
        percentiles: Percentile -> value.
    """

    quantity: str
    population: str
    unit: str
    source: str
    address: str
    place: str
    certainty: Certainty
    mean: float | None = None
    sd: float | None = None
    low: float | None = None
    high: float | None = None
    percentiles: Mapping[int, float] = field(default_factory=dict)

    @property
    def values(self) -> tuple[float, ...]:
        """Every number that bounds the spread between studies: mean, range and percentiles."""
        numbers = (self.mean, self.low, self.high, *self.percentiles.values())
        return tuple(number for number in numbers if number is not None)


@dataclass(frozen=True)
class Correlation:
    """Correlations between the parameters of drivers.

    Attributes:
        quantities: Names of the n parameters.
        matrix: [n, n].
        population: The drivers.
        source: Authors, year, title.
    """

    quantities: tuple[str, ...]
    matrix: F64
    population: str
    source: str

    def between(self, first: str, second: str) -> float:
        """Return the correlation of two parameters. ValueError if one of them is not in it."""
        return float(self.matrix[self.quantities.index(first), self.quantities.index(second)])


@cache
def _tables() -> dict[str, Any]:
    return tomllib.loads(files("ssad.metrics").joinpath("human_driving.toml").read_text(encoding="utf-8"))


@cache
def statistics() -> tuple[Statistic, ...]:
    """Return all published values, in the order of the file."""
    sources = _tables()["sources"]
    return tuple(
        Statistic(
            **{key: value for key, value in entry.items() if key not in {"source", "percentiles"}},
            source=sources[entry["source"]]["text"],
            address=sources[entry["source"]]["address"],
            percentiles={int(key): value for key, value in entry.get("percentiles", {}).items()},
        )
        for entry in _tables()["statistic"]
    )


@cache
def correlations() -> tuple[Correlation, ...]:
    """Return the published correlations between the parameters of drivers."""
    sources = _tables()["sources"]
    return tuple(
        Correlation(
            tuple(entry["quantities"]),
            np.array(entry["matrix"], np.float64),
            entry["population"],
            sources[entry["source"]]["text"],
        )
        for entry in _tables()["correlation"]
    )


def published(quantity: str) -> tuple[Statistic, ...]:
    """Return the published values of a quantity.

    Raises:
        ConfigError: No source gives it.
    """
    values = tuple(statistic for statistic in statistics() if statistic.quantity == quantity)
    if not values:
        quantities = ", ".join(sorted({statistic.quantity for statistic in statistics()}))
        raise ConfigError(f"no published value of {quantity!r}; there are: {quantities}")
    return values


def spread(quantity: str) -> tuple[float, float]:
    """Return the least and the greatest published value of a quantity: the spread between its sources."""
    numbers = [number for statistic in published(quantity) for number in statistic.values]
    return min(numbers), max(numbers)


def certainty_of(quantity: str) -> Certainty:
    """Return the weakest certainty among the published values of a quantity."""
    order: tuple[Certainty, ...] = ("read", "cited", "memory")
    return max((statistic.certainty for statistic in published(quantity)), key=order.index)
