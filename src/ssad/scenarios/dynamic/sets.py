"""Resolution of scenario references: shipped sets, imported sets, single scenarios, types, files and folders."""

from __future__ import annotations

import os
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from ssad.core.errors import ConfigError, unknown_name
from ssad.core.registry import names
from ssad.core.safeio import home_folder
from ssad.core.types import Scenario
from ssad.scenarios.dynamic.catalogue import SCENARIOS, scenario_type
from ssad.scenarios.dynamic.yamlio import read_scenarios

DATA = Path(__file__).parent / "data"
SHIPPED = ("precrash", "natural")
UNSELECTED = ("natural-unselected", "lane-traffic", "stop-signs", "lane-keeping", "speed-signs")
"""Unselected traffic, for rates and past stop signs; marked roads without traffic, for lanes and past limit signs.

The name of a scenario class does not load these scenarios.
"""
UNIFORM = ("natural-uniform",)
"""Former set `natural`, to which earlier results refer: uniform drivers, no walkers and no cyclists."""
TRAINING = ("training", "training-lanes")
"""Training sets of drivers and adversaries. The name of a scenario class does not load these scenarios."""
IMPORTED = ("safebench", "frea")
"""Sets that a user imports from SafeBench's and FREA's folders."""
_TOWN_SETS = {"natural-twinford": ("natural", "Twinford"), "natural-crossgate": ("natural", "Crossgate")}
BUILT_IN_SETS = (*SHIPPED, *UNSELECTED, *UNIFORM, *TRAINING, *_TOWN_SETS)
_SUFFIXES = (".yaml", ".yml")


def load_scenarios(ref: str | Path) -> tuple[Scenario, ...]:
    """The scenarios that `ref` names, in their order.

    A set (precrash, natural, natural-twinford, natural-crossgate, natural-unselected, natural-uniform, training,
    training-lanes, or one that was imported, such as safebench, frea), a scenario ("StraightObstacle/00"), a scenario
    class (its scenarios in precrash and natural, or those that a class of your own brings), a YAML file, or a folder of
    YAML files.
    UnknownNameError shows the three closest names.
    """
    if isinstance(ref, Path) or ref.endswith(_SUFFIXES):
        return _from_path(Path(ref))
    if ref in _TOWN_SETS:
        name, town = _TOWN_SETS[ref]
        return tuple(scenario for scenario in _cached(DATA / f"{name}.yaml") if scenario.town == town)
    files = set_files()
    if ref in files:
        return _cached(files[ref])
    shipped = [scenario for name in SHIPPED for scenario in _cached(files[name])]
    if ref in SCENARIOS:
        return tuple(scenario for scenario in shipped if scenario.type == ref)
    scenarios_by_name = {scenario.name: scenario for scenario in shipped}
    if ref not in scenarios_by_name:
        for file in files.values():
            scenarios_by_name.update((scenario.name, scenario) for scenario in _cached(file))
    if ref in scenarios_by_name:
        return (scenarios_by_name[ref],)
    if Path(ref).is_dir():  # last: a results folder called like a set must not hide it
        return _from_path(Path(ref))
    if ":" in ref or ref in names("scenario", SCENARIOS):
        return _of_class(ref)
    if ref.partition("/")[0] in IMPORTED:
        raise ConfigError(
            f"scenario '{ref}' is not in {home_folder() / 'scenarios'}; import it: ssad import routes FOLDER"
        )
    raise unknown_name("scenario", ref, [*set_names(), *SCENARIOS, *scenarios_by_name])


def _of_class(name: str) -> tuple[Scenario, ...]:
    """Return the scenarios that a class of a package or of the user brings, each of the type by which it was named.

    Raises:
        ConfigError: It brings none.
    """
    scenarios = scenario_type(name).scenarios
    if not scenarios:
        raise ConfigError(
            f"scenario class '{name}' brings no scenarios: name a YAML file whose scenarios have `type: {name}`, or "
            "give the class scenarios"
        )
    return tuple(replace(scenario, type=name) for scenario in scenarios)


def set_files() -> dict[str, Path]:
    """Return set name -> YAML file: the imported sets, then the shipped ones."""
    imported_files = {path.stem: path for path in sorted((home_folder() / "scenarios").glob("*.yaml"))}
    return imported_files | {name: DATA / f"{name}.yaml" for name in (*SHIPPED, *UNSELECTED, *UNIFORM, *TRAINING)}


def set_names() -> tuple[str, ...]:
    """Return the names of all sets that can be loaded."""
    return tuple(sorted({*set_files(), *_TOWN_SETS}))


def _from_path(path: Path) -> tuple[Scenario, ...]:
    if not path.is_dir():
        return read_scenarios(path)
    files = sorted(file for file in path.iterdir() if file.suffix in _SUFFIXES)
    if not files:
        raise ConfigError(f"{path}: no scenario files (*.yaml) in this folder")
    scenarios: list[Scenario] = []
    file_of_name: dict[str, Path] = {}
    for file in files:
        for scenario in read_scenarios(file):
            if scenario.name in file_of_name:
                raise ConfigError(
                    f"{file}: scenario name '{scenario.name}' is in {file_of_name[scenario.name].name} too"
                )
            file_of_name[scenario.name] = file
            scenarios.append(scenario)
    return tuple(scenarios)


def _cached(path: Path) -> tuple[Scenario, ...]:
    """Load the scenarios of a file, parsed again only when the file has changed."""
    try:
        file_status = os.stat(path)
    except OSError:
        return read_scenarios(path)
    return _parsed(str(path), file_status.st_mtime_ns, file_status.st_size)


@lru_cache(maxsize=16)
def _parsed(path: str, modified: int, size: int) -> tuple[Scenario, ...]:
    return read_scenarios(path)
