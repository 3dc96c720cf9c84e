"""Suites: YAML files with a strict schema, one a table; the schema is that of their kind."""

from __future__ import annotations

import difflib
import re
import typing
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

import ssad
from ssad.core.errors import ConfigError, UnknownNameError, unknown_name
from ssad.core.registry import resolve
from ssad.core.safeio import Document, format_location, parse_yaml, read_yaml_document
from ssad.engine.kind import Kind, SuiteBase

KINDS: dict[str, str] = {
    "driving": "ssad.experiments.driving.kind:Driving",
    "perception": "ssad.experiments.perception.kind:Perception",
    "detection": "ssad.experiments.perception.shifts.kind:Detection",
    "digital": "ssad.experiments.perception.digital.kind:Digital",
    "physical": "ssad.experiments.perception.physical.kind:Physical",
    "reality": "ssad.experiments.perception.reality.kind:Reality",
    "adversarial": "ssad.experiments.adversarial.kind:Adversarial",
    "gap": "ssad.experiments.gap.kind:Gap",
    "how-often": "ssad.experiments.how_often.kind:HowOften",
    "tour": "ssad.experiments.tour.kind:Tour",
}
"""Kind of experiment -> "module:class"; packages add theirs by the entry-point group `ssad.kinds`."""


def kind_of(name: str) -> Kind:
    """Return the kind of that name, entry point or "module:class".

    Raises:
        UnknownNameError: There is none.
        ConfigError: It cannot be imported, or is no kind.
    """
    resolved = resolve("kind", KINDS, name)
    if not isinstance(resolved, type) or not issubclass(resolved, Kind):
        raise ConfigError(f"kind '{name}': expected a class derived from ssad.engine.kind.Kind")
    return resolved()


def suite_folders() -> list[Path]:
    """Return the folders of suites: the repository of a source checkout, or inside the installed package."""
    package = Path(ssad.__file__).resolve().parent
    root = package.parent.parent
    folders = [package / "suites"]
    if (root / "pyproject.toml").is_file() and (root / "src" / "ssad") == package:
        folders.insert(0, root / "suites")
    return [folder for folder in folders if folder.is_dir()]


def suite_files() -> dict[str, Path]:
    """Return suite name -> its file."""
    files: dict[str, Path] = {}
    for folder in suite_folders():
        for path in sorted(folder.glob("*.yaml")):
            files.setdefault(path.stem, path)
    return files


def load_suite(reference: str, settings: Sequence[str] = ()) -> Any:
    """Return the suite of that name or YAML file, with `--set key=value` settings applied.

    Its key `kind` selects the schema. ConfigError and FormatError name file, line and key; UnknownNameError lists the
    closest names.
    """
    files = suite_files()
    path = files.get(reference)
    if path is None:
        if not reference.endswith((".yaml", ".yml")) and not Path(reference).is_file():
            raise unknown_name("suite", reference, files)
        path = Path(reference)
    document = read_yaml_document(path)
    if not isinstance(document.data, dict):
        raise document.error((), "a suite is a mapping with the keys kind, name and those of its kind")
    data = dict(document.data)
    try:
        schema = kind_of(str(data.setdefault("kind", "driving"))).suite
    except UnknownNameError:
        raise document.error(
            ("kind",), f"'{data['kind']}' is no kind of suite; choose from: {', '.join(KINDS)}"
        ) from None
    setting_of_key: dict[str, str] = {}
    for setting in settings:
        setting_of_key[_apply_setting(data, setting, schema)] = setting
    try:
        suite = schema.model_validate(data).beside(path)
    except ValidationError as error:
        raise _explain_error(error, document, setting_of_key, list(schema.model_fields)) from None
    suite._origin = reference
    try:
        suite._stock = schema.model_validate(document.data).beside(path).model_dump(mode="json")
    except ValidationError:  # the file is incomplete without the settings
        suite._stock = suite.model_dump(mode="json")
    return suite


def _apply_setting(data: dict[str, Any], setting: str, schema: type[SuiteBase]) -> str:
    """Put one `key=value` into the data; return the top-level key."""
    key, separator, text = setting.partition("=")
    parts = key.strip().split(".")
    if not separator or not all(parts):
        raise ConfigError(f"--set {setting}: expected key=value, such as --set repetitions=3")
    if parts[0] not in schema.model_fields:
        raise ConfigError(f"--set {setting}: {_unknown_key(parts[0], list(schema.model_fields))}")
    value = parse_yaml(text, f"--set {key}")
    if len(parts) == 1 and _takes_list(schema, parts[0]) and isinstance(value, str | int):
        value = [value]
    mapping = data
    for part in parts[:-1]:
        mapping.setdefault(part, {})
        if not isinstance(mapping.get(part), dict):
            raise ConfigError(f"--set {setting}: '{part}' has no keys of its own")
        # Copy each level: the document that `_stock` is made of must not change.
        mapping[part] = dict(mapping[part])
        mapping = mapping[part]
    mapping[parts[-1]] = value
    return parts[0]


def _takes_list(schema: type[SuiteBase], key: str) -> bool:
    """Return whether a key takes a list; one value alone then is a list of one."""
    return typing.get_origin(schema.model_fields[key].annotation) is list


def _unknown_key(key: str, known_keys: Sequence[str]) -> str:
    suggestions = difflib.get_close_matches(key, known_keys, n=3, cutoff=0.0)
    return f"unknown key '{key}'; closest: {', '.join(suggestions)}"


UNION = re.compile(r"constrained-\w+|literal\[.*\]")  # how pydantic names the members of a union in a location


def _explain_error(
    error: ValidationError, document: Document, changed_keys: dict[str, str], known_keys: Sequence[str]
) -> ConfigError:
    """Return the first problem as one line with file, line and key, or with the setting that caused it."""
    first_error = error.errors(include_url=False)[0]
    location = tuple(part for part in first_error["loc"] if not UNION.fullmatch(str(part)))
    if first_error["type"] == "extra_forbidden":
        text = _unknown_key(str(location[-1]), known_keys)
        location = (*location[:-1], str(location[-1]))
    elif first_error["type"] == "missing":
        text = f"the key '{location[-1]}' is missing"
        location = location[:-1]
    elif first_error["type"] == "value_error":  # a validator of SSAD, whose message is complete
        text = first_error["msg"].removeprefix("Value error, ")
    else:
        input_text = repr(first_error["input"])
        text = f"{first_error['msg']}, not {input_text if len(input_text) < 60 else input_text[:57] + '...'}"
    if location and location[0] in changed_keys:
        return ConfigError(f"--set {changed_keys[str(location[0])]}: {format_location(location)}: {text}")
    return document.error(location, text)
