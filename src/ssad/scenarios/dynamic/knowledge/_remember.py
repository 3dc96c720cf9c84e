"""Cached results: values that depend only on the map and the ego's route are computed once, not once per draw."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, wraps
from typing import Any, ParamSpec, TypeVar

from ssad.core.lane_graph import LaneGraph
from ssad.core.types import Route

_P = ParamSpec("_P")
_T = TypeVar("_T")


class _Same:
    """Cache key of an unhashable object: equal to itself only, and kept alive by the cache."""

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
        wrapped: Callable[..., _T] = function

        # LaneGraph and Route hold arrays and are unhashable; lru_cache needs hashable arguments.
        @lru_cache(maxsize=most)
        def cached(*arguments: Any) -> _T:
            unwrapped = (argument.value if isinstance(argument, _Same) else argument for argument in arguments)
            return wrapped(*unwrapped)

        @wraps(function)
        def wrapper(*arguments: _P.args, **options: _P.kwargs) -> _T:
            if options:
                raise TypeError(f"{function.__name__}: give its arguments by position")
            return cached(
                *(_Same(argument) if isinstance(argument, LaneGraph | Route) else argument for argument in arguments)
            )

        return wrapper

    return decorate
