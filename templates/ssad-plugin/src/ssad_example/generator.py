"""A search for collisions: the corners of the box of parameters, then points drawn evenly from it."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

from ssad.core.generators import Base, Outcome, Proposal
from ssad.core.seeding import generator
from ssad.scenarios.dynamic.search.box import ParameterBox


class Corners:
    """Corners of the box first, then points drawn evenly; it learns nothing.

    Args:
        bases: Scenarios to start from.
        seeds: Seed of the search in each.
        budget: Proposals for each.
        margin: Distance of the corners from the limits, as a share of the ranges; in a suite
            `example-corners?margin=0.1`.
    """

    name = "example-corners"

    def __init__(self, bases: Sequence[Base], *, seeds: Sequence[int], budget: int, margin: float = 0.0) -> None:
        self._points = []
        for base, seed in zip(bases, seeds, strict=True):
            box = ParameterBox.of(base.scenario)
            draw = generator("example corners", seed)
            searched = min(box.dimension, 6)  # a seventh parameter would double the number of corners again
            rest = [0.5] * (box.dimension - searched)
            corners = [[*corner, *rest] for corner in product((margin, 1.0 - margin), repeat=searched)]
            order = draw.permutation(len(corners))
            points = [corners[k] for k in order] + draw.random((budget, box.dimension)).tolist()
            self._points.append([box.scenario_at(point) for point in points[:budget]])
        self._next = 0

    def ask(self, count: int) -> list[list[Proposal]]:
        """The next points of each base."""
        return [[Proposal(one) for one in row[self._next : self._next + count]] for row in self._points]

    def tell(self, outcomes: Sequence[Sequence[Outcome]]) -> None:
        """Counts; a search that learns looks at `Outcome.proof_value`."""
        self._next += max((len(row) for row in outcomes), default=0)
