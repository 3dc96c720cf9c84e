"""Errors that a user can cause and fix. Each is one line (problem, place, remedy) and ends with exit code 2."""

from __future__ import annotations

import difflib
import importlib.util
import re
import sys
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

from ssad.core.wording import plural

MAX_MESSAGE = 2000  # characters


class SSADError(Exception):
    """An error that the user can fix; the base of all errors below.

    The command line prints the message alone and ends with exit code 2.

    Args:
        message: The problem, its place (file, line, key), and the remedy. It becomes one line that can be printed; of
            one longer than `MAX_MESSAGE`, as values of broken files can make it, the middle is left out.
    """

    def __init__(self, message: str) -> None:
        line = " ".join(message.split()).encode(errors="backslashreplace").decode()
        if len(line) > MAX_MESSAGE:
            line = f"{line[: MAX_MESSAGE // 2]} ... {line[5 - MAX_MESSAGE // 2 :]}"
        super().__init__(line)


class ConfigError(SSADError):
    """An invalid suite, scenario or option."""


class UnknownNameError(ConfigError):
    """A name that is neither built in nor offered by an installed package."""


class MissingExtraError(ConfigError):
    """A request needs packages of an extra that is not installed.

    Args:
        feature: The requested object, such as "system 'ppo'".
        package: A package of `EXTRA_OF` that is missing.
    """

    def __init__(self, feature: str, package: str) -> None:
        self.extra, self._arguments = EXTRA_OF[package], (feature, package)
        super().__init__(
            f"{feature} needs the extra {self.extra} ({package} is not installed); {install_extra(self.extra)}"
        )

    def __reduce__(self) -> tuple[type[MissingExtraError], tuple[str, str]]:
        """Make the error picklable, so that worker processes can raise it in the parent."""
        return MissingExtraError, self._arguments


class MapError(SSADError):
    """A road map that cannot be read or used."""


class RouteError(SSADError):
    """A route that the lane graph cannot follow."""


class StoreError(SSADError):
    """A results folder that cannot be read or written."""


class FormatError(SSADError):
    """A data file that is broken, malicious or in another format."""


LISTED = (
    "suite",
    "kind",
    "scenario",
    "generator",
    "system",
    "perceiver",
    "tracker",
    "planner",
    "detector",
    "recipe",
    "perturbation",
    "shift",
    "attack",
    "loss",
    "defence",
    "simulator",
    "town",
    "dimension",
)
"""What `ssad list` can list, in the singular: `ssad list suites` and so on."""


def unknown_name(kind: str, name: str, known_names: Iterable[str]) -> UnknownNameError:
    """Make the error for a name that does not exist: the three closest names, and all names or where to find them.

    Args:
        kind: What the name stands for, in the singular, such as "system".
        name: What the user typed.
        known_names: All names that exist.

    Returns:
        The error, to be raised.
    """
    names = sorted(known_names)
    close_matches = difflib.get_close_matches(name, names, n=3, cutoff=0.0)
    hint = f"; closest: {', '.join(close_matches)}" if close_matches else ""
    all_names = f"see: ssad list {plural(kind)}" if kind in LISTED else f"known: {', '.join(names) or 'none'}"
    return UnknownNameError(f"unknown {kind} '{name}'{hint} ({all_names})")


def install_extra(extra: str) -> str:
    """Return instructions for installing an optional dependency, for the end of a message.

    Args:
        extra: Name in `[project.optional-dependencies]` of pyproject.toml.

    Returns:
        The hint, without a final stop: for a checkout its extra, else the packages themselves.
    """
    if (Path(__file__).resolve().parents[3] / "pyproject.toml").is_file():
        return f"in the checkout of SSAD run: pip install '.[{extra}]' (with uv: uv sync --inexact --extra {extra})"
    has_pip = importlib.util.find_spec("pip") is not None
    installer = f"{sys.executable} -m pip install" if has_pip else f"uv pip install --python {sys.executable}"
    return f"run: {installer} {' '.join(repr(package) for package in packages_of(extra)) or extra}"


def packages_of(extra: str) -> list[str]:
    """Return the requirements of an extra as stated by the installed package, such as "torch>=2.15.0"."""
    try:
        requirements = [requirement.partition(";") for requirement in requires("ssad-testbed") or ()]
    except PackageNotFoundError:
        return []
    extra_marker = re.compile(rf"""extra\s*==\s*['"]{re.escape(extra)}['"]""")
    return [package_name.strip() for package_name, _, marker in requirements if extra_marker.search(marker)]


EXTRA_OF = {
    "torch": "perception",
    "torchvision": "perception",
    "scenic": "scenic",
    "commonroad": "commonroad",
    "onnx": "onnx",
    "onnx2torch": "onnx",
}
"""Package that is imported where it is needed -> the extra that brings it."""


def missing_extra(error: ModuleNotFoundError, feature: str) -> MissingExtraError | None:
    """Make the error for something that cannot be imported because an extra is missing.

    Args:
        error: What the import raised.
        feature: What was asked for, such as "system 'ppo'".

    Returns:
        The error, to be raised; None: no extra brings what is missing.
    """
    package = (error.name or "").partition(".")[0]
    return MissingExtraError(feature, package) if package in EXTRA_OF else None
