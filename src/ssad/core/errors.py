"""Errors that a user can cause and fix. Each ends in one line (what, where, what to do) and exit code 2."""

from __future__ import annotations

import difflib
import importlib.util
import re
import sys
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path


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


class MissingExtraError(ConfigError):
    """What was asked for needs packages of an extra that are not installed.

    Args:
        what: What was asked for, such as "system 'ppo'".
        package: A package of `EXTRA_OF` that is missing.
    """

    def __init__(self, what: str, package: str) -> None:
        self.extra, self._given = EXTRA_OF[package], (what, package)
        super().__init__(
            f"{what} needs the extra {self.extra} ({package} is not installed); {install_extra(self.extra)}"
        )

    def __reduce__(self) -> tuple[type[MissingExtraError], tuple[str, str]]:
        """So that a worker can send it home."""
        return MissingExtraError, self._given


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
    """Say how to install an optional dependency here, for the end of a message.

    Args:
        extra: Name in `[project.optional-dependencies]` of pyproject.toml.

    Returns:
        The hint, without a final stop: for a checkout its extra, else the packages themselves.
    """
    if (Path(__file__).resolve().parents[3] / "pyproject.toml").is_file():
        return f"in the checkout of SSAD run: pip install '.[{extra}]' (with uv: uv sync --inexact --extra {extra})"
    pip = importlib.util.find_spec("pip") is not None
    tool = f"{sys.executable} -m pip install" if pip else f"uv pip install --python {sys.executable}"
    return f"run: {tool} {' '.join(repr(package) for package in packages_of(extra)) or extra}"


def packages_of(extra: str) -> list[str]:
    """The requirements of an extra, as the installed package states them, such as "torch>=2.15.0"."""
    try:
        stated = [text.partition(";") for text in requires("ssad-testbed") or ()]
    except PackageNotFoundError:
        return []
    wanted = re.compile(rf"""extra\s*==\s*['"]{re.escape(extra)}['"]""")
    return [name.strip() for name, _, marker in stated if wanted.search(marker)]


EXTRA_OF = {"torch": "perception", "torchvision": "perception", "scenic": "scenic"}
"""Package that is imported where it is needed -> the extra that brings it."""


def missing_extra(error: ModuleNotFoundError, what: str) -> MissingExtraError | None:
    """Make the error for something that cannot be imported because an extra is missing.

    Args:
        error: What the import raised.
        what: What was asked for, such as "system 'ppo'".

    Returns:
        The error, to be raised; None: no extra brings what is missing.
    """
    package = (error.name or "").partition(".")[0]
    return MissingExtraError(what, package) if package in EXTRA_OF else None
