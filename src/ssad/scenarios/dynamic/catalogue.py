"""Scenario classes by name."""

from __future__ import annotations

from ssad.core.errors import ConfigError
from ssad.core.registry import resolve
from ssad.scenarios.dynamic.knowledge._kind import Parameter, ScenarioType

_HERE = "ssad.scenarios.dynamic.knowledge"
SCENARIOS: dict[str, str] = {
    "StraightObstacle": f"{_HERE}.straight_obstacle:SCENARIO",
    "TurningObstacle": f"{_HERE}.turning_obstacle:SCENARIO",
    "LaneChanging": f"{_HERE}.lane_changing:SCENARIO",
    "VehiclePassing": f"{_HERE}.vehicle_passing:SCENARIO",
    "RedlightRunning": f"{_HERE}.redlight_running:SCENARIO",
    "UnprotectedLeftTurn": f"{_HERE}.unprotected_left_turn:SCENARIO",
    "RightTurn": f"{_HERE}.right_turn:SCENARIO",
    "CrossingNegotiation": f"{_HERE}.crossing_negotiation:SCENARIO",
    "NaturalJunction": f"{_HERE}.natural_junction:SCENARIO",
    "FreeDrive": f"{_HERE}.free_drive:SCENARIO",
}
"""Scenario class name -> "module:object", a `ScenarioType`."""

PRECRASH: tuple[str, ...] = tuple(SCENARIOS)[:8]
"""The eight pre-crash classes, in the order of the paper's table."""

FREE_DRIVE = "FreeDrive"
"""The type of routes without a scenario of their own: natural traffic alone."""

CUSTOM = "Custom"
"""The type whose scenarios list their actors themselves."""

TYPES: dict[str, str] = {**SCENARIOS, CUSTOM: f"{_HERE}.custom:SCENARIO"}
"""All built-in types of scenarios."""


def scenario_type(name: str) -> ScenarioType:
    """Return the scenario class with a name.

    Args:
        name: A key of `SCENARIOS`, "Custom", the name of an entry point, or "module:object".

    Returns:
        The class.

    Raises:
        UnknownNameError: No class has that name; the message lists the closest ones.
        ConfigError: A user module fails to import, or the name refers to another object.
    """
    resolved = resolve("scenario", TYPES, name)
    if not isinstance(resolved, ScenarioType):
        raise ConfigError(f"scenario type '{name}': expected a ScenarioType, found {type(resolved).__name__}")
    return resolved


def parameter_box(type_name: str) -> dict[str, Parameter]:
    """Return the parameters of a scenario class, including those of the ego start.

    Args:
        type_name: Name of the class, as for `scenario_type`.

    Returns:
        Parameter name -> range, default, unit and spread.

    Raises:
        UnknownNameError: No class has that name.
        ConfigError: As for `scenario_type`.
    """
    return dict(scenario_type(type_name).box)
