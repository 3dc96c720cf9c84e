"""A kind of experiment: cells, what a worker does for one, and the columns of its table; the rest is the engine's."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from ssad.core.seeding import generator
from ssad.engine.kind import Cell, Column, Job, Kind, Names, SuiteBase


class CoinSuite(SuiteBase):
    """Keys of the YAML file, besides kind, name, title, seed, timeout_s, ..."""

    systems: Names
    tosses: int = 10


class Coin(Kind):
    """Each system tosses a coin."""

    name, suite, factors = "coin", CoinSuite, ("system",)
    columns = (Column("heads", "share of heads", "", "higher", limits=(0.0, 1.0)),)

    def cells(self, suite: CoinSuite) -> Iterator[Cell]:
        """One a system."""
        for system in suite.systems:
            yield self.make_cell(system, system, suite.seed, {"system": system}, {"tosses": suite.tosses})

    def result(self, cell: Cell, job: Job) -> Mapping[str, Any]:
        """In a worker process."""
        tosses = generator("coin", cell.system, cell.seed).integers(0, 2, cell.spec["tosses"])
        return {"metrics": {"heads": float(tosses.mean())}, "case": cell.key, "cluster": cell.key}
