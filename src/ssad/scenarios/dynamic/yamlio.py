"""Scenario files: YAML with one scenario or a list of them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from ssad.core.errors import ConfigError
from ssad.core.safeio import dump_yaml, read_yaml_document, write_atomic
from ssad.core.types import Scenario
from ssad.scenarios.dynamic.schema import check, scenario_data, scenario_from


def read_scenarios(path: str | Path) -> tuple[Scenario, ...]:
    """Read the scenarios of one YAML file, in file order. ConfigError and FormatError name file, line and key."""
    document = read_yaml_document(path)
    if isinstance(document.data, dict):
        return (scenario_from(document.data, document),)
    if not isinstance(document.data, list):
        raise document.error((), "expected one scenario (a mapping) or a list of scenarios")
    if not document.data:
        raise document.error((), "the list of scenarios is empty")
    scenarios = tuple(scenario_from(entry, document, (index,)) for index, entry in enumerate(document.data))
    first_index: dict[str, int] = {}
    for index, scenario in enumerate(scenarios):
        if scenario.name in first_index:
            line = document.line((first_index[scenario.name],))
            raise document.error((index, "name"), f"'{scenario.name}' is the name of the scenario in line {line} too")
        first_index[scenario.name] = index
    return scenarios


def scenario_text(scenarios: Scenario | Iterable[Scenario]) -> str:
    """Return YAML text: one mapping for one scenario, a list for several. ConfigError if one is not valid."""
    if isinstance(scenarios, Scenario):
        check(scenarios)
        return dump_yaml(scenario_data(scenarios))
    scenario_tuple = tuple(scenarios)
    if not scenario_tuple:
        raise ConfigError("there is no scenario to save")
    for scenario in scenario_tuple:
        check(scenario)
    return dump_yaml([scenario_data(scenario) for scenario in scenario_tuple])


def save_scenarios(path: str | Path, scenarios: Scenario | Iterable[Scenario]) -> None:
    """Write scenarios as YAML, atomically, such that `read_scenarios` reads them back unchanged.

    Raises:
        ConfigError: A scenario is not valid.
        StoreError: The file cannot be written.
    """
    write_atomic(path, scenario_text(scenarios))
