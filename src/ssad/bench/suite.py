"""Suites: which systems drive which scenarios, how often; YAML files with a strict schema."""

from __future__ import annotations

import difflib
import re
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

import ssad
from ssad.bench.component.suite import DetectionSuite
from ssad.core.errors import ConfigError, UnknownNameError, unknown_name
from ssad.core.safeio import Document, dotted, parse_yaml, read_yaml_document
from ssad.core.types import Scenario

Names = Annotated[list[Annotated[str, Field(min_length=1)]], Field(min_length=1)]


class Suite(BaseModel):
    """One table: systems x scenarios x repetitions.

    systems: names, or module:object; scenarios: what `load_scenarios` understands (sets, types, names, YAML files);
    repetitions: episodes of each pair, with seeds of their own; timeout_s: seconds that one cell may take; chunk:
    cells that run as one batch of the world (results do not depend on it); reference: the published table that the
    report shows beside this one; witness: search each collision for a way out; pictures: what the report shows besides
    (shifts: contact sheets of the distribution shifts; camera: what the camera sees).
    """

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)

    kind: Literal["driving"] = "driving"
    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")
    title: str = ""
    description: str = ""
    systems: Names
    scenarios: Names
    repetitions: int = Field(default=1, ge=1, le=100_000)
    seed: int = Field(default=0, ge=0)
    timeout_s: float = Field(default=120.0, gt=0, allow_inf_nan=False)
    chunk: int = Field(default=16, ge=1, le=4096)
    reference: str | None = None
    witness: bool = True
    pictures: list[Literal["shifts", "camera"]] = []


KINDS: dict[str, type[Suite] | type[DetectionSuite]] = {"driving": Suite, "detection": DetectionSuite}
LISTS = ("systems", "scenarios", "pictures", "detectors", "shifts", "severities")  # one value alone is a list of one


def suite_folders() -> list[Path]:
    """Where suites lie: the repository of a source checkout, or inside the installed package."""
    package = Path(ssad.__file__).resolve().parent
    root = package.parent.parent
    folders = [package / "suites"]
    if (root / "pyproject.toml").is_file() and (root / "src" / "ssad") == package:
        folders.insert(0, root / "suites")
    return [folder for folder in folders if folder.is_dir()]


def suite_files() -> dict[str, Path]:
    """Suite name -> its file."""
    files: dict[str, Path] = {}
    for folder in suite_folders():
        for path in sorted(folder.glob("*.yaml")):
            files.setdefault(path.stem, path)
    return files


def load_suite(ref: str, settings: Sequence[str] = ()) -> Suite | DetectionSuite:
    """The suite of that name or YAML file, with `--set key=value` settings applied; its key `kind` says of which kind.

    ConfigError or FormatError say file, line and key; UnknownNameError shows the closest names.
    """
    files = suite_files()
    path = files.get(ref)
    if path is None:
        if not ref.endswith((".yaml", ".yml")) and not Path(ref).is_file():
            raise unknown_name("suite", ref, files)
        path = Path(ref)
    document = read_yaml_document(path)
    if not isinstance(document.data, dict):
        raise document.error((), "a suite is a mapping with the keys name, systems and scenarios")
    data = dict(document.data)
    kind = KINDS.get(str(data.get("kind", "driving")))
    if kind is None:
        raise document.error(("kind",), f"'{data['kind']}' is no kind of suite; choose from: {', '.join(KINDS)}")
    changed: dict[str, str] = {}
    for setting in settings:
        changed[_apply(data, setting, list(kind.model_fields))] = setting
    try:
        suite = kind.model_validate(data)
    except ValidationError as error:
        raise _explain(error, document, changed, list(kind.model_fields)) from None
    if isinstance(suite, DetectionSuite):
        return suite
    return suite.model_copy(update={"scenarios": [_beside(name, path) for name in suite.scenarios]})


def _beside(ref: str, suite_file: Path) -> str:
    """A scenario file is looked for in the working folder, then beside the suite."""
    near = suite_file.parent / ref
    if ref.endswith((".yaml", ".yml")) and not Path(ref).exists() and near.exists():
        return str(near)
    return ref


def _apply(data: dict[str, Any], setting: str, known: Sequence[str]) -> str:
    """Put one `key=value` into the data; returns the top-level key."""
    key, equals, text = setting.partition("=")
    parts = key.strip().split(".")
    if not equals or not all(parts):
        raise ConfigError(f"--set {setting}: expected key=value, such as --set repetitions=3")
    if parts[0] not in known:
        raise ConfigError(f"--set {setting}: {_unknown_key(parts[0], known)}")
    value = parse_yaml(text, f"--set {key}")
    if len(parts) == 1 and parts[0] in LISTS and isinstance(value, str | int):
        value = [value]
    place = data
    for part in parts[:-1]:
        place.setdefault(part, {})
        if not isinstance(place.get(part), dict):
            raise ConfigError(f"--set {setting}: '{part}' has no keys of its own")
        place[part] = dict(place[part])
        place = place[part]
    place[parts[-1]] = value
    return parts[0]


def _unknown_key(key: str, known: Sequence[str]) -> str:
    close = difflib.get_close_matches(key, known, n=3, cutoff=0.0)
    return f"unknown key '{key}'; closest: {', '.join(close)}"


UNION = re.compile(r"constrained-\w+|literal\[.*\]")  # how pydantic names the members of a union in a location


def _explain(error: ValidationError, document: Document, changed: dict[str, str], known: Sequence[str]) -> ConfigError:
    """The first problem as one line with file, line and key, or with the setting that caused it."""
    problem = error.errors(include_url=False)[0]
    location = tuple(part for part in problem["loc"] if not UNION.fullmatch(str(part)))
    if problem["type"] == "extra_forbidden":
        text = _unknown_key(str(location[-1]), known)
        location = (*location[:-1], str(location[-1]))
    elif problem["type"] == "missing":
        text = f"the key '{location[-1]}' is missing"
        location = location[:-1]
    else:
        shown = repr(problem["input"])
        text = f"{problem['msg']}, not {shown if len(shown) < 60 else shown[:57] + '...'}"
    if location and location[0] in changed:
        return ConfigError(f"--set {changed[str(location[0])]}: {dotted(location)}: {text}")
    return document.error(location, text)


def suite_scenarios(suite: Suite) -> tuple[Scenario, ...]:
    """All scenarios of a suite, in order, each once. ConfigError when two differ but share a name."""
    from ssad.scenarios.dynamic import load_scenarios

    found: dict[str, Scenario] = {}
    for ref in suite.scenarios:
        try:
            loaded = load_scenarios(ref)
        except UnknownNameError as error:
            raise UnknownNameError(f"suite {suite.name}: {error}") from None
        for scenario in loaded:
            if found.setdefault(scenario.name, scenario) != scenario:
                raise ConfigError(
                    f"suite {suite.name}: two different scenarios are named '{scenario.name}' (one from {ref}); "
                    "rename one"
                )
    return tuple(found.values())


def command_of(suite: dict[str, Any]) -> str:
    """The command that runs a suite again; only what differs from the suite of that name is spelt out."""
    suite = dict(suite)
    name = str(suite.pop("name", "quick"))
    try:
        stock = load_suite(name).model_dump(mode="json")
    except ConfigError:  # a suite of the user's own, by its file
        stock = suite
    words = ["ssad", "run", name]
    for key, value in suite.items():
        if value != stock.get(key):
            text = f"[{','.join(map(str, value))}]" if isinstance(value, list) else str(value)
            if isinstance(value, dict):
                text = "{" + ", ".join(f"{k}: {v}" for k, v in value.items()) + "}"
            words += ["--set", f"{key}={text}"]
    return shlex.join(words)
