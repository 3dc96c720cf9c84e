"""Cached results: values that depend only on the map and the ego's route are computed once, not once per draw."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, wraps
from typing import Any, ParamSpec, TypeVar

from ssad.core.lane_graph import LaneGraph
from ssad.core.types import Route

_P = ParamSpec("_P")
_T = TypeVar("_T")


class _IdentityKey:
    """Cache key of an unhashable object: equal to itself only, and kept alive by the cache."""

    __slots__ = ("value",)

    def __init__(self, value: object) -> None:
        self.value = value

    def __hash__(self) -> int:
        return id(self.value)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _IdentityKey) and self.value is other.value


def cached_by_identity(max_size: int = 1024) -> Callable[[Callable[_P, _T]], Callable[_P, _T]]:
    """Cache the results of a function; lane graphs and routes count as equal if they are one object.

    Args:
        max_size: Maximum number of cached results; the least recently used goes first.

    Returns:
        A decorator. The function's other arguments must be hashable, and its results must not be changed.
        Exceptions are not cached.
    """

    def decorate(function: Callable[_P, _T]) -> Callable[_P, _T]:
        wrapped: Callable[..., _T] = function

        # LaneGraph and Route hold arrays and are unhashable; lru_cache needs hashable arguments.
        @lru_cache(maxsize=max_size)
        def cached(*arguments: Any) -> _T:
            unwrapped = (argument.value if isinstance(argument, _IdentityKey) else argument for argument in arguments)
            return wrapped(*unwrapped)

        @wraps(function)
        def wrapper(*arguments: _P.args, **options: _P.kwargs) -> _T:
            if options:
                raise TypeError(f"{function.__name__}: give its arguments by position")
            return cached(
                *(
                    _IdentityKey(argument) if isinstance(argument, LaneGraph | Route) else argument
                    for argument in arguments
                )
            )

        return wrapper

    return decorate
