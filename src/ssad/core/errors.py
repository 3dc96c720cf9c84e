"""Errors a user can cause. Each ends in one line (what, where, what to do) and exit code 2."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class SSADError(Exception):
    """Something the user can mend; the base of all errors below.

    The command line prints the message alone and ends with exit code 2.

    Args:
        message: What is wrong, where (file, line, key), and what to do. It becomes one line.
    """

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.split()))


class ConfigError(SSADError):
    """A suite, scenario or option that is not valid."""


class UnknownNameError(ConfigError):
    """A name that no table holds."""


class MapError(SSADError):
    """A road map that cannot be read or used."""


class RouteError(SSADError):
    """A route that the lane graph cannot follow."""


class StoreError(SSADError):
    """A results folder that cannot be read or written."""


class FormatError(SSADError):
    """A data file that is broken, hostile or of another kind."""


def unknown_name(kind: str, name: str, known: Iterable[str]) -> UnknownNameError:
    """Make the error for a name that is not known.

    Args:
        kind: Singular noun, such as "town"; `ssad list` must know its plural.
        name: What was asked for.
        known: What there is.

    Returns:
        An error that shows the three known names closest to it, to be raised by the caller.
    """
    names = sorted(known)
    close = difflib.get_close_matches(name, names, n=3, cutoff=0.0)
    hint = f"; closest: {', '.join(close)}" if close else ""
    return UnknownNameError(f"unknown {kind} '{name}'{hint} (see: ssad list {kind}s)")
