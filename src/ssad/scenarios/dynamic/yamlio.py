"""Scenario files: YAML with one scenario or a list of them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from ssad.core.errors import ConfigError
from ssad.core.safeio import dump_yaml, read_yaml_document, write_atomic
from ssad.core.types import Scenario
from ssad.scenarios.dynamic.schema import check, scenario_data, scenario_from


def read_scenarios(path: str | Path) -> tuple[Scenario, ...]:
    """Scenarios of one YAML file, in its order. ConfigError and FormatError name file, line and key."""
    document = read_yaml_document(path)
    if isinstance(document.data, dict):
        return (scenario_from(document.data, document),)
    if not isinstance(document.data, list):
        raise document.error((), "expected one scenario (a mapping) or a list of scenarios")
    if not document.data:
        raise document.error((), "the list of scenarios is empty")
    scenarios = tuple(scenario_from(item, document, (i,)) for i, item in enumerate(document.data))
    first: dict[str, int] = {}
    for i, scenario in enumerate(scenarios):
        if scenario.name in first:
            line = document.line((first[scenario.name],))
            raise document.error((i, "name"), f"'{scenario.name}' is the name of the scenario in line {line} too")
        first[scenario.name] = i
    return scenarios


def scenario_text(scenarios: Scenario | Iterable[Scenario]) -> str:
    """YAML text: one mapping for one scenario, a list for several. ConfigError if one is not valid."""
    if isinstance(scenarios, Scenario):
        check(scenarios)
        return dump_yaml(scenario_data(scenarios))
    several = tuple(scenarios)
    if not several:
        raise ConfigError("there is no scenario to save")
    for scenario in several:
        check(scenario)
    return dump_yaml([scenario_data(scenario) for scenario in several])


def save_scenarios(path: str | Path, scenarios: Scenario | Iterable[Scenario]) -> None:
    """Write scenarios as YAML, atomically; `read_scenarios` reads equal ones.

    Raises:
        ConfigError: A scenario is not valid.
        StoreError: The file cannot be written.
    """
    write_atomic(path, scenario_text(scenarios))
