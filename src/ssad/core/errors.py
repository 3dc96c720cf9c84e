"""Errors that a user can cause and fix. Each ends in one line (what, where, what to do) and exit code 2."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class SSADError(Exception):
    """An error that the user can fix; the base of all errors below.

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


LISTED = ("suite", "kind", "scenario", "generator", "system", "detector", "recipe", "shift", "attack", "town")
"""What `ssad list` can list, in the singular: `ssad list suites` and so on."""


def unknown_name(kind: str, name: str, known: Iterable[str]) -> UnknownNameError:
    """Make the error for a name that does not exist: the three closest names, and all names or where to find them.

    Args:
        kind: What the name stands for, in the singular, such as "system".
        name: What the user typed.
        known: All names that exist.

    Returns:
        The error, to be raised.
    """
    names = sorted(known)
    close = difflib.get_close_matches(name, names, n=3, cutoff=0.0)
    hint = f"; closest: {', '.join(close)}" if close else ""
    everything = f"see: ssad list {kind}s" if kind in LISTED else f"known: {', '.join(names) or 'none'}"
    return UnknownNameError(f"unknown {kind} '{name}'{hint} ({everything})")


def install_extra(extra: str) -> str:
    """Say how to install an optional dependency, for the end of a message.

    Args:
        extra: Name in `[project.optional-dependencies]` of pyproject.toml.

    Returns:
        The hint, without a final stop.
    """
    return f"in the checkout of SSAD run: pip install '.[{extra}]' (with uv: uv sync --inexact --extra {extra})"
