"""Answers that are kept: what depends on the map and the ego's route alone is worked out once, not once a draw."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, wraps
from typing import Any, ParamSpec, TypeVar

from ssad.core.lane_graph import LaneGraph
from ssad.core.types import Route

_P = ParamSpec("_P")
_T = TypeVar("_T")


class _Same:
    """Stands for an object that cannot be hashed: equal to itself alone, and alive as long as the answer is kept."""

    __slots__ = ("value",)

    def __init__(self, value: object) -> None:
        self.value = value

    def __hash__(self) -> int:
        return id(self.value)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and self.value is other.value


def remembered(most: int = 1024) -> Callable[[Callable[_P, _T]], Callable[_P, _T]]:
    """Makes a function keep its answers, also for lane graphs and routes, which count as equal if they are one object.

    Args:
        most: How many answers are kept; the one not asked for longest goes first.

    Returns:
        A decorator. The function's other arguments must be hashable, and nobody may change an answer. What it raises
        is not kept.
    """

    def decorate(function: Callable[_P, _T]) -> Callable[_P, _T]:
        work: Callable[..., _T] = function

        @lru_cache(maxsize=most)
        def answer(*arguments: Any) -> _T:
            plain = (a.value if isinstance(a, _Same) else a for a in arguments)
            return work(*plain)

        @wraps(function)
        def ask(*arguments: _P.args, **options: _P.kwargs) -> _T:
            if options:
                raise TypeError(f"{function.__name__}: give its arguments by position")
            return answer(*(_Same(a) if isinstance(a, LaneGraph | Route) else a for a in arguments))

        return ask

    return decorate
