"""Write docs/reference/cli.md, suites.md and names.md from the code: python -m benchmarks.reference

The pages show the commands of `ssad`, the keys of every kind of suite, and the names that suites accept.
`kind_section` works for the kind of a package, too: print(kind_section(kind_of("module:Class"))).
"""

from __future__ import annotations

import inspect
import re
import types
import typing
from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from typing import Annotated, Any, Literal

import typer.main
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from ssad.cli import app
from ssad.cli.listing import LISTS
from ssad.engine.kind import Kind, SuiteBase
from ssad.experiments.suites import KINDS, kind_of

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "reference"
STABLE = (
    "suites",
    "kinds",
    "generators",
    "systems",
    "simulators",
    "detectors",
    "recipes",
    "shifts",
    "attacks",
    "losses",
    "defences",
    "dimensions",
)
"""Lists of `ssad list` that depend on the installed package alone, not on what has been imported."""
KINDS_OF_VALUE = {"str": "text", "int": "integer", "float": "number"}
BOUNDS = {"ge": "at least {}", "gt": "more than {}", "le": "at most {}", "lt": "less than {}"}


def pages() -> dict[str, str]:
    """Return the pages by file name."""
    return {"cli.md": command_page(), "suites.md": suite_page(), "names.md": name_page()}


def command_page() -> str:
    """Return the page of the command line."""
    lines = [
        "# Command line",
        "",
        "All commands of `ssad`, as `--help` shows them. `python -m benchmarks.reference` makes this page.",
        "",
        "Exit codes: 0, everything ran; 1, some cells failed; 2, invalid input, which one line explains.",
        "",
    ]
    for name, command in _commands("ssad", typer.main.get_command(app)):
        lines += _command_section(name, command)
    return "\n".join(lines).rstrip() + "\n"


def suite_page() -> str:
    """Return the page of the keys of suites."""
    common = {key: field for key, field in SuiteBase.model_fields.items() if key != "kind"}
    lines = [
        "# Keys of suites",
        "",
        "A suite is a YAML file. Its key `kind` selects the schema below; unknown keys are refused.",
        "`ssad run SUITE --set KEY=VALUE` overrides a key, with a dot for a key inside another (`recorded.scenes=4`),",
        "and `ssad run SUITE --print-config` prints a suite with all its values.",
        "`python -m benchmarks.reference` makes this page.",
        "",
        "## Keys of every kind",
        "",
        *_key_table(SuiteBase, ["kind", *common]),
    ]
    for name in KINDS:
        lines += [kind_section(kind_of(name)).rstrip(), ""]
    return "\n".join(lines).rstrip() + "\n"


def name_page() -> str:
    """Return the page of registered names."""
    lines = [
        "# Registered names",
        "",
        "The names that commands and suites accept, as `ssad list` prints them. In place of each, a suite takes",
        "an entry point of an installed package or `module:object`. `ssad list scenarios` and `ssad list towns` also",
        "show what has been imported on a machine. `python -m benchmarks.reference` makes this page.",
        "",
    ]
    for what in STABLE:
        lines += [f"## {what.capitalize()}", "", "| Name | Description |", "|---|---|"]
        lines += [f"| `{_cell(name)}` | {_cell(_linked(about))} |" for name, about in LISTS[what]().items()]
        lines.append("")
    return "\n".join(lines).rstrip() + "\n"


def kind_section(kind: Kind) -> str:
    """Return the keys of a kind's suites as Markdown: type, default, bounds and description of each.

    Keys of `SuiteBase` are left out unless the kind changes their default. Sections inside the suite (other models)
    follow as tables of their own.

    Args:
        kind: Any kind, of SSAD or of a package.
    """
    own = [
        key
        for key, field in kind.suite.model_fields.items()
        if key not in SuiteBase.model_fields or (key != "kind" and _changed(key, field))
    ]
    lines = [f"## Kind `{kind.name}`", "", _summary(kind.suite), "", *_key_table(kind.suite, own)]
    for model in _models(kind.suite, own):
        lines += [f"### {_model_title(model)} (`{kind.name}`)", "", _summary(model), ""]
        lines += _key_table(model, list(model.model_fields))
    return "\n".join(lines)


def descriptions(model: type[BaseModel]) -> dict[str, str]:
    """Return the descriptions of a model's fields, from `Attributes:` of its docstring and those of its bases."""
    found: dict[str, str] = {}
    for base in reversed(model.__mro__):
        text = inspect.cleandoc(base.__dict__.get("__doc__") or "")
        _, mark, rest = text.partition("Attributes:\n")
        if not mark or not issubclass(base, BaseModel):
            continue
        block = re.split(r"\n(?=\S)", rest)[0]
        for entry in re.split(r"\n(?=    \w)", "\n" + block):
            names, colon, about = entry.strip().partition(":")
            if colon:
                words = " ".join(about.split())
                found |= dict.fromkeys(names.split(", "), words[:1].upper() + words[1:])
    return {key: field.description or found.get(key, "") for key, field in model.model_fields.items()}


def _changed(key: str, field: FieldInfo) -> bool:
    return field.get_default(call_default_factory=True) != SuiteBase.model_fields[key].get_default()


def _commands(name: str, command: Any) -> Iterator[tuple[str, Any]]:
    """Yield all commands that can be run, with their full names."""
    if not hasattr(command, "commands"):
        yield name, command
        return
    for part, inner in command.commands.items():
        yield from _commands(f"{name} {part}", inner)


def _command_section(name: str, command: Any) -> list[str]:
    arguments = [parameter for parameter in command.params if parameter.param_type_name == "argument"]
    options = [
        parameter for parameter in command.params if parameter.param_type_name == "option" and not parameter.hidden
    ]
    usage = " ".join([name, *(["[OPTIONS]"] if options else []), *map(_argument_name, arguments)])
    lines = [f"## `{name}`", "", *_help(command.help or ""), "", "```text", usage, "```", ""]
    if arguments:
        lines += ["| Argument | Description |", "|---|---|"]
        lines += [
            f"| `{_cell(_argument_name(argument))}` | {_cell(_linked(argument.help or ''))} |" for argument in arguments
        ]
        lines.append("")
    if options:
        lines += ["| Option | Default | Description |", "|---|---|---|"]
        for option in options:
            names = ", ".join(f"`{flag}`" for flag in (*option.opts, *option.secondary_opts))
            kind = option.metavar or option.display_type(command.context_class(command))
            kind = str(kind).strip("<>").removesuffix(" range")
            value = "" if option.is_flag else f" `{_cell(KINDS_OF_VALUE.get(kind, kind).upper())}`"
            lines.append(f"| {names}{value} | {_option_default(option)} | {_option_help(option)} |")
        lines.append("")
    return lines


def _argument_name(argument: Any) -> str:
    name = str(argument.metavar or argument.name.upper())
    if not argument.required and not name.startswith("["):
        name = f"[{name}]"
    return name if argument.nargs == 1 or "..." in name else f"{name}..."


def _option_help(option: Any) -> str:
    bounds = [
        f"{words} {limit:g}"
        for words, limit in (("at least", option.min), ("at most", option.max))
        if limit is not None
    ]
    return _cell(_linked((option.help or "") + (f" ({', '.join(bounds)})" if bounds else "")))


def _help(text: str) -> list[str]:
    """Return the help of a command as Markdown: \\b marks a block that keeps its lines."""
    blocks = [block.strip("\n") for block in inspect.cleandoc(text).split("\n\n")]
    lines: list[str] = []
    for block in blocks:
        if block.startswith("\b"):
            lines += ["```text", *block.removeprefix("\b").strip("\n").splitlines(), "```", ""]
        else:
            lines += [_linked(" ".join(block.split())), ""]
    return lines[:-1]


def _option_default(option: Any) -> str:
    if option.required:
        return "required"
    value = option.default.value if isinstance(option.default, Enum) else option.default
    if option.is_flag:
        return "on" if value is True else ""
    return f"`{_cell(str(value))}`" if isinstance(value, str | int | float | Path) and value != "" else ""


def _key_table(model: type[BaseModel], keys: list[str]) -> list[str]:
    about = descriptions(model)
    lines = ["| Key | Type | Default | Bounds | Description |", "|---|---|---|---|---|"]
    for key in keys:
        field = model.model_fields[key]
        kind, bounds = _type(field.annotation), _bounds(field.metadata)
        cells = [f"`{key}`", _cell(kind), _default(field), _cell(", ".join(bounds)), _cell(_linked(about[key]))]
        lines.append(f"| {' | '.join(cells)} |")
    return [*lines, ""]


def _type(annotation: Any) -> str:
    """Return a type in words, with bounds of its parts in brackets."""
    origin, parts = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is Annotated:
        bounds = _bounds(parts[1:])
        return _type(parts[0]) + (f" ({', '.join(bounds)})" if bounds else "")
    if origin is Literal:
        return " or ".join(f"`{part}`" for part in parts)
    if origin in (typing.Union, types.UnionType):
        return " or ".join("null" if part is type(None) else _type(part) for part in parts)
    if origin in (list, tuple):
        inner = dict.fromkeys(_type(part).removesuffix(" (not empty)") for part in parts if part is not ...)
        return f"list of {' and '.join(inner)}"
    if origin is dict:
        return f"mapping of {_type(parts[0])} to {_type(parts[1])}"
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return f"mapping: {_model_title(annotation)}"
    names = {str: "text", int: "integer", float: "number", bool: "true or false", Any: "any"}
    return names.get(annotation, getattr(annotation, "__name__", str(annotation)))


def _bounds(metadata: typing.Sequence[Any]) -> list[str]:
    """Return the bounds that constraints of pydantic state."""
    bounds: list[str] = []
    for constraint in metadata:
        if isinstance(constraint, FieldInfo):
            bounds += _bounds(constraint.metadata)
            continue
        bounds += [
            words.format(f"{getattr(constraint, name):,}".removesuffix(".0"))
            for name, words in BOUNDS.items()
            if hasattr(constraint, name)
        ]
        for name, words in (("min_length", "at least"), ("max_length", "at most")):
            if (length := getattr(constraint, name, None)) is not None:
                bounds.append("not empty" if name == "min_length" and length == 1 else f"length {words} {length}")
        if pattern := getattr(constraint, "pattern", None):
            bounds.append(f"matches `{pattern}`")
    return list(dict.fromkeys(bounds))


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    value = field.get_default(call_default_factory=True)
    return "" if value is PydanticUndefined else f"`{_cell(_yaml(value))}`"


def _yaml(value: Any) -> str:
    """Return a value as it stands in a suite, without what it leaves open."""
    if isinstance(value, BaseModel):
        return _yaml(value.model_dump(exclude_defaults=True))
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {_yaml(entry)}" for key, entry in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_yaml, value)) + "]"
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return f"{value:g}" if isinstance(value, float) else str(value) or '""'


def _models(model: type[BaseModel], keys: list[str]) -> list[type[BaseModel]]:
    """Return the models inside these fields, and inside those, each once."""
    found: dict[type[BaseModel], None] = {}

    def visit(annotation: Any) -> None:
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            if annotation not in found:
                found[annotation] = None
                for field in annotation.model_fields.values():
                    visit(field.annotation)
            return
        for part in typing.get_args(annotation):
            visit(part)

    for key in keys:
        visit(model.model_fields[key].annotation)
    return list(found)


def _model_title(model: type[BaseModel]) -> str:
    words = re.findall(r"[A-Z][a-z]*", model.__name__.removesuffix("Suite")) or [model.__name__]
    return " ".join(words).lower().capitalize() if len(words) > 1 else words[0]


def _summary(model: type[BaseModel]) -> str:
    text = inspect.cleandoc(model.__doc__ or "").partition("\n\nAttributes:")[0]
    return _linked(" ".join(text.split()))


def _linked(text: str) -> str:
    """Return text in which paths of pages are links."""
    return re.sub(
        r"\bdocs/((?:[\w-]+/)+([\w-]+)\.md)", lambda found: f"[{found[2].replace('-', ' ')}](../{found[1]})", text
    )


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


def main() -> None:
    """Write the pages."""
    for name, text in pages().items():
        (FOLDER / name).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
