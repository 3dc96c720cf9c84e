"""Errors that a user can cause and fix. Each ends in one line (what, where, what to do) and exit code 2."""

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
    """An invalid suite, scenario or option."""


class UnknownNameError(ConfigError):
    """A name that is neither built in nor offered by an installed package."""


class MapError(SSADError):
    """A road map that cannot be read or used."""


class RouteError(SSADError):
    """A route that the lane graph cannot follow."""


class StoreError(SSADError):
    """A results folder that cannot be read or written."""


class FormatError(SSADError):
    """A data file that is broken, malicious or in another format."""


LISTED = ("suite", "kind", "scenario", "system", "detector", "recipe", "shift", "town")
"""What `ssad list` can list, in the singular: `ssad list suites` and so on."""


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
    everything = f"see: ssad list {kind}s" if kind in LISTED else f"known: {', '.join(names) or 'none'}"
    return UnknownNameError(f"unknown {kind} '{name}'{hint} ({everything})")


def install_extra(extra: str) -> str:
    """How to install an optional dependency ("extra") of pyproject.toml, for the end of a message."""
    return f"in the checkout of SSAD run: pip install '.[{extra}]' (with uv: uv sync --inexact --extra {extra})"
