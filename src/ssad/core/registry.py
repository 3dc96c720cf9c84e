"""Names to objects: a built-in table, entry points of other packages, or "module:object" typed by the user.

A package offers objects of a kind through the entry-point group `ssad.<kind>s`, such as `ssad.systems`. Built-in names
cannot be taken by a package. Where a system or a detector is named, arguments and a label may follow (`Reference`).
"""

from __future__ import annotations

import difflib
import importlib
import inspect
import sys
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from ssad.core.errors import EXTRA_OF, ConfigError, SSADError, install_extra, missing_extra, unknown_name


@dataclass(frozen=True)
class Reference:
    """What a suite or a command says of a system or a detector: NAME, NAME?KEY=VALUE&KEY=VALUE, NAME@LABEL, or both.

    Attributes:
        name: A name that `resolve` understands; for some systems with a file behind a colon.
        options: Arguments that it is called with.
        label: What tables call it; "" if nothing was said.
    """

    name: str
    options: Mapping[str, Any]
    label: str

    @staticmethod
    def of(text: str) -> Reference:
        """Read a reference.

        Args:
            text: Such as "mine:Mine?checkpoint=a.pt&reach=20@a": values are numbers, true, false or texts.

        Raises:
            ConfigError: An argument is not KEY=VALUE, or the label is empty.
        """
        whole, at, label = text.rpartition("@")
        if not at or "/" in label:
            whole, label = text, ""
        elif not label or not whole:
            raise ConfigError(f"'{text}': expected NAME@LABEL, such as mine:Mine@first")
        name, _, told = whole.partition("?")
        options: dict[str, Any] = {}
        for part in told.split("&") if told else []:
            key, equals, value = part.partition("=")
            if not equals or not key.isidentifier() or key in options:
                raise ConfigError(
                    f"'{text}': expected arguments as in mine:Mine?checkpoint=a.pt&reach=20, not '{part}'"
                )
            options[key] = _value(value)
        return Reference(name, options, label)


def _value(text: str) -> Any:
    """An argument's value: true, false, a number, or the text."""
    if text in ("true", "false"):
        return text == "true"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def label_of(text: str) -> str:
    """What tables call a system: its label, or all that was said.

    Args:
        text: As `Reference.of` reads it.

    Raises:
        ConfigError: See there.
    """
    return Reference.of(text).label or text


def split_weights(text: str) -> tuple[str, str]:
    """A detector as a suite writes it, without its weights, and these.

    Args:
        text: NAME or NAME=FILE; what follows a ? are arguments, and no weights.

    Returns:
        Name with arguments and label; file, "" for none.
    """
    name, equals, file = text.partition("=")
    return (name, file) if equals and "?" not in name else (text, "")


def check_arguments(
    kind: str, text: str, found: Any, *, made: bool = False, more: Mapping[str, Any] | None = None
) -> None:
    """Check that what a reference names takes its arguments, without calling it.

    Args:
        kind: Singular noun for messages.
        text: The reference.
        found: What `resolve` found for it.
        made: Whether a class is called with these arguments alone, so that it must need no others.
        more: Arguments beside those of the reference.

    Raises:
        ConfigError: It takes no such arguments, or needs more.
    """
    options = {**Reference.of(text).options, **(more or {})}
    if not options and not (made and isinstance(found, type)):
        return
    if not callable(found):
        raise ConfigError(f"{kind} '{text}': it is an object, which takes no arguments; name its class instead")
    try:
        inspect.signature(found).bind(**options)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{kind} '{text}': {error}") from None


def make(kind: str, name: str, found: Any, options: Mapping[str, Any], needs: Sequence[str]) -> Any:
    """Make what a user's module offers, and check that it has what it is needed for.

    Args:
        kind: Singular noun for messages.
        name: What the user calls it.
        found: What `resolve` found for it: a class or function that makes it, or the object itself.
        options: Arguments of the class or function.
        needs: Attributes and methods that it must have.

    Returns:
        The object.

    Raises:
        ConfigError: Its maker raises, or it lacks an attribute or a method.
    """
    try:
        made = found(**options) if callable(found) else found
    except SSADError:
        raise
    except Exception as error:
        raise ConfigError(f"{kind} '{name}': making it failed: {describe(error)}") from error
    missing = [one for one in needs if not hasattr(made, one)]
    if missing:
        lacks = f"of type {type(made).__name__}, lacks {', '.join(missing)}"
        raise ConfigError(f"{kind} '{name}', {lacks}; it needs {', '.join(needs)}")
    return made


def resolve(kind: str, table: Mapping[str, str], name: str) -> Any:
    """Import the object behind a name.

    A name with a colon is imported with the working folder on the path, as Python's own command does it.

    Args:
        kind: Singular noun for messages and for the group of entry points: "system" means `ssad.systems`.
        table: Built-in names and where they are, as "module:object".
        name: A name of the table, one that a package offers, or "module:object".

    Returns:
        The object, of whatever type it is.

    Raises:
        UnknownNameError: Nobody offers the name; the message has the three closest.
        MissingExtraError: It needs an extra that is not installed.
        ConfigError: The module of a package or of the user does not import, or does not have the object.
    """
    if name in table:
        module, _, attribute = table[name].partition(":")
        try:
            return getattr(importlib.import_module(module), attribute)
        except ModuleNotFoundError as error:
            raise missing_extra(error, f"{kind} '{name}'") or error from None
    plugins = {point.name: point for point in entry_points(group=f"ssad.{kind}s")}
    if name in plugins:
        return _import(kind, name, plugins[name].value)
    if ":" in name:
        return _import(kind, name, name)
    raise unknown_name(kind, name, [*table, *plugins])


def names(kind: str, table: Mapping[str, str]) -> dict[str, str]:
    """List all names of a kind.

    Args:
        kind: As for `resolve`.
        table: As for `resolve`.

    Returns:
        Name -> "module:object", built-in ones first.
    """
    plugins = {point.name: point.value for point in entry_points(group=f"ssad.{kind}s")}
    return dict(table) | {name: where for name, where in plugins.items() if name not in table}


def _import(kind: str, name: str, target: str) -> Any:
    module_name, _, attribute = target.partition(":")
    attribute = attribute.split("[")[0].strip()
    if not module_name or not all(part.isidentifier() for part in module_name.split(".")) or not attribute:
        raise ConfigError(f"{kind} '{name}': expected module:object, such as my_driver:MyDriver")
    here = str(Path.cwd())
    if here not in sys.path:
        sys.path.insert(0, here)
    try:
        value: Any = importlib.import_module(module_name)
    except (Exception, SystemExit) as error:  # a script that ends the process is no module
        why = describe(error) + _hint(error, module_name, here)
        raise ConfigError(f"{kind} '{name}': importing {module_name} failed: {why}") from error
    for part in attribute.split("."):
        try:
            value = getattr(value, part)
        except AttributeError:
            close = difflib.get_close_matches(part, [n for n in dir(value) if n[0] != "_"], n=3, cutoff=0.3)
            hint = f"; closest: {', '.join(close)}" if close else ""
            raise ConfigError(f"{kind} '{name}': {module_name} has no '{part}'{hint}") from None
    return value


def describe(error: BaseException) -> str:
    """Put an error into one line.

    Args:
        error: What was raised.

    Returns:
        Its type, its text, and the innermost file and line that is not of the import machinery.
    """
    if isinstance(error, SyntaxError):
        return f"{type(error).__name__}: {error.msg} ({error.filename}:{error.lineno})"
    frames = [f for f in traceback.extract_tb(error.__traceback__) if not f.filename.startswith("<frozen")]
    own = [f for f in frames if f.filename not in (__file__, importlib.__file__)]
    where = f" ({own[-1].filename}:{own[-1].lineno})" if own else ""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}{f': {text}' if text else ''}{where}"


def _hint(error: BaseException, module: str, here: str) -> str:
    if isinstance(error, ModuleNotFoundError) and error.name == module.split(".", maxsplit=1)[0]:
        return f"; looked in {here} and the installed packages"
    if isinstance(error, ModuleNotFoundError) and error.name in EXTRA_OF:
        return f"; {install_extra(EXTRA_OF[error.name])}"
    return ""
