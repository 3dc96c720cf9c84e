"""What a parametrised test does in the default run, and what waits for `--run-slow`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def others_slow(cases: Iterable[Any], quick: Iterable[Any]) -> list[Any]:
    """Cases for `parametrize`: all but those in `quick` are marked slow; tuples are the values of several names.

    Raises:
        ValueError: Something quick is none of the cases, as after a change of names.
    """
    every, kept = list(cases), list(quick)
    unknown = [case for case in kept if case not in every]
    if unknown or not kept:
        raise ValueError(f"quick cases {unknown} are none of {every}, or there are none")
    return [
        case if case in kept else pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.slow)
        for case in every
    ]
