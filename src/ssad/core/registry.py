"""Names to objects: a built-in table, entry points of other packages, or "module:object" typed by the user.

A package offers objects of a kind through the entry-point group `ssad.<kind>s`, such as `ssad.systems`. Built-in names
cannot be taken by a package. Where a system or a detector is named, arguments and a label may follow (`Reference`).
"""

from __future__ import annotations

import contextlib
import difflib
import importlib
import inspect
import json
import os
import sys
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from ssad.core.errors import EXTRA_OF, ConfigError, SSADError, install_extra, missing_extra, unknown_name
from ssad.core.wording import plural


@dataclass(frozen=True)
class Reference:
    """Reference to a system or a detector: NAME, NAME?KEY=VALUE&KEY=VALUE, NAME@LABEL, or both.

    Attributes:
        name: A name that `resolve` understands; for some systems with a file behind a colon.
        options: Arguments that it is called with.
        label: What tables call it; "" if nothing was said.
    """

    name: str
    options: Mapping[str, Any]
    label: str

    @staticmethod
    def parse(text: str) -> Reference:
        """Parse a reference.

        Args:
            text: Such as "mine:Mine?checkpoint=a.pt&reach=20@a": values are numbers, true, false, lists and objects
                of JSON such as [1,2], or texts.

        Raises:
            ConfigError: An argument is not KEY=VALUE, or the label is empty.
        """
        target, separator, label = text.rpartition("@")
        if not separator or "/" in label:
            target, label = text, ""
        elif not label or not target:
            raise ConfigError(f"'{text}': expected NAME@LABEL, such as mine:Mine@first")
        name, _, query = target.partition("?")
        options: dict[str, Any] = {}
        for argument in query.split("&") if query else []:
            key, equals, value = argument.partition("=")
            if not equals or not key.isidentifier() or key in options:
                raise ConfigError(
                    f"'{text}': expected arguments as in mine:Mine?checkpoint=a.pt&reach=20, not '{argument}'"
                )
            options[key] = _value(value)
        return Reference(name, options, label)


def _value(text: str) -> Any:
    """Return an argument's value: true, false, a number, a list or object of JSON, or the text."""
    if text in ("true", "false"):
        return text == "true"
    if text.startswith(("[", "{")):
        with contextlib.suppress(ValueError):
            return json.loads(text)
    for number_type in (int, float):
        try:
            return number_type(text)
        except ValueError:
            continue
    return text


def label_of(text: str) -> str:
    """Return the name of a system in tables: its label, or the whole reference.

    Args:
        text: As for `Reference.parse`.

    Raises:
        ConfigError: As for `Reference.parse`.
    """
    return Reference.parse(text).label or text


def split_weights(text: str) -> tuple[str, str]:
    """Split the weights from a detector in a suite.

    Args:
        text: NAME or NAME=FILE; text behind a ? are arguments, not weights.

    Returns:
        Name with arguments and label; file, "" for none.
    """
    name, equals, file = text.partition("=")
    return (name, file) if equals and "?" not in name else (text, "")


def check_arguments(
    kind: str,
    reference: str,
    target: Any,
    *,
    is_instantiated: bool = False,
    extra_arguments: Mapping[str, Any] | None = None,
) -> None:
    """Check that what a reference names takes its arguments, without calling it.

    Args:
        kind: Singular noun for messages.
        reference: The reference.
        target: What `resolve` found for it.
        is_instantiated: Whether a class is called with these arguments alone, so that it must need no others.
        extra_arguments: Arguments beside those of the reference.

    Raises:
        ConfigError: It takes no such arguments, or needs more.
    """
    options = {**Reference.parse(reference).options, **(extra_arguments or {})}
    if not options and not (is_instantiated and isinstance(target, type)):
        return
    if not callable(target):
        raise ConfigError(f"{kind} '{reference}': it is an object, which takes no arguments; name its class instead")
    try:
        inspect.signature(target).bind(**options)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{kind} '{reference}': {error}") from None


def make(kind: str, name: str, target: Any, options: Mapping[str, Any], required_members: Sequence[str]) -> Any:
    """Make what a user's module offers, and check that it has what it is needed for.

    Args:
        kind: Singular noun for messages.
        name: What the user calls it.
        target: What `resolve` found for it: a class or function that makes it, or the object itself.
        options: Arguments of the class or function.
        required_members: Attributes and methods that it must have.

    Returns:
        The object.

    Raises:
        ConfigError: Its maker raises, it lacks an attribute or a method, or an object gets arguments.
    """
    # A loss or a defence is called itself: what has all members already is the object, and makes none.
    is_object = not isinstance(target, type) and all(hasattr(target, member) for member in required_members)
    is_maker = callable(target) and not (required_members and is_object)
    if options and not is_maker:
        raise ConfigError(f"{kind} '{name}': it is an object, which takes no arguments; name its class instead")
    try:
        instance = target(**options) if is_maker else target
    except SSADError:
        raise
    except Exception as error:
        raise ConfigError(f"{kind} '{name}': making it failed: {describe(error)}") from error
    missing = [member for member in required_members if not hasattr(instance, member)]
    if missing:
        problem = f"of type {type(instance).__name__}, lacks {', '.join(missing)}"
        raise ConfigError(f"{kind} '{name}', {problem}; it needs {', '.join(required_members)}")
    return instance


def resolve(kind: str, table: Mapping[str, str], name: str) -> Any:
    """Import the object behind a name.

    A name with a colon is imported with the working folder on the path, as Python's own command does.

    Args:
        kind: Singular noun for messages and for the group of entry points: "system" means `ssad.systems`.
        table: Built-in names and their objects, as "module:object".
        name: A name of the table, one offered by a package, or "module:object".

    Returns:
        The object, of any type.

    Raises:
        UnknownNameError: The name is not offered; the message has the three closest.
        MissingExtraError: It needs an extra that is not installed.
        ConfigError: The module of a package or of the user does not import, or does not have the object.
    """
    if name in table:
        module, _, attribute = table[name].partition(":")
        try:
            return getattr(importlib.import_module(module), attribute)
        except ModuleNotFoundError as error:
            # Torch and others are optional; name the extra instead of the module.
            raise missing_extra(error, f"{kind} '{name}'") or error from None
    plugins = offered_names(group_of(kind))
    if name in plugins:
        return _import(kind, name, plugins[name])
    if ":" in name:
        return _import(kind, name, name)
    raise unknown_name(kind, name, [*table, *plugins])


def group_of(kind: str) -> str:
    """Return the group of entry points of a kind of object: "system" -> "ssad.systems", "loss" -> "ssad.losses"."""
    return f"ssad.{plural(kind)}"


def names(kind: str, table: Mapping[str, str]) -> dict[str, str]:
    """Return all names of a kind.

    Args:
        kind: As for `resolve`.
        table: As for `resolve`.

    Returns:
        Name -> "module:object", built-in ones first.
    """
    plugins = offered_names(group_of(kind))
    return dict(table) | {name: origin for name, origin in plugins.items() if name not in table}


def offered_names(group: str) -> Mapping[str, str]:
    """Return the entry points that installed packages offer in a group, name -> "module:object"."""
    return _offered_names(group, tuple((entry, _modification_time(entry)) for entry in sys.path))


@lru_cache(maxsize=256)
def _offered_names(group: str, _search_path: tuple[tuple[str, int], ...]) -> dict[str, str]:
    # Each call reads the metadata of all installed packages. What is installed or removed changes its folder.
    return {point.name: point.value for point in entry_points(group=group)}


def _modification_time(entry: str) -> int:
    """Return when a folder of the import path changed, ns; 0 where there is none."""
    try:
        return os.stat(entry or os.curdir).st_mtime_ns
    except OSError:
        return 0


def _import(kind: str, name: str, target: str) -> Any:
    module_name, _, attribute = target.partition(":")
    attribute = attribute.split("[")[0].strip()
    if not module_name or not all(part.isidentifier() for part in module_name.split(".")) or not attribute:
        raise ConfigError(f"{kind} '{name}': expected module:object, such as my_driver:MyDriver")
    working_folder = str(Path.cwd())
    # The installed command `ssad`, unlike `python -m`, does not add the working folder.
    if working_folder not in sys.path:
        sys.path.insert(0, working_folder)
    try:
        value: Any = importlib.import_module(module_name)
    except (Exception, SystemExit) as error:  # a script that ends the process is no module
        reason = describe(error) + _import_hint(error, module_name, working_folder)
        raise ConfigError(f"{kind} '{name}': importing {module_name} failed: {reason}") from error
    for part in attribute.split("."):
        try:
            value = getattr(value, part)
        except AttributeError:
            close_matches = difflib.get_close_matches(
                part, [member for member in dir(value) if member[0] != "_"], n=3, cutoff=0.3
            )
            hint = f"; closest: {', '.join(close_matches)}" if close_matches else ""
            raise ConfigError(f"{kind} '{name}': {module_name} has no '{part}'{hint}") from None
    return value


def describe(error: BaseException) -> str:
    """Describe an error in one line.

    Args:
        error: The exception.

    Returns:
        Its type, its text, and the innermost file and line outside the import machinery.
    """
    if isinstance(error, SyntaxError):
        return f"{type(error).__name__}: {error.msg} ({error.filename}:{error.lineno})"
    frames = [
        frame_summary
        for frame_summary in traceback.extract_tb(error.__traceback__)
        if not frame_summary.filename.startswith("<frozen")
    ]
    user_frames = [
        frame_summary for frame_summary in frames if frame_summary.filename not in (__file__, importlib.__file__)
    ]
    position = f" ({user_frames[-1].filename}:{user_frames[-1].lineno})" if user_frames else ""
    message = " ".join(str(error).split())
    return f"{type(error).__name__}{f': {message}' if message else ''}{position}"


def _import_hint(error: BaseException, module: str, folder: str) -> str:
    if isinstance(error, ModuleNotFoundError) and error.name == module.split(".", maxsplit=1)[0]:
        return f"; looked in {folder} and the installed packages"
    if isinstance(error, ModuleNotFoundError) and error.name in EXTRA_OF:
        return f"; {install_extra(EXTRA_OF[error.name])}"
    return ""
