"""Random draws of a scenario: its parameters, ego start and target speed, within a box around the nominal values."""

from __future__ import annotations

import math

import numpy as np

from ssad.core.errors import ConfigError
from ssad.core.types import Scenario
from ssad.scenarios.dynamic.catalogue import scenario_type
from ssad.scenarios.dynamic.knowledge._kind import TARGET_SPEED_SPREAD
from ssad.scenarios.dynamic.parameters import (
    TARGET_SPEED,
    is_derived,
    parameter_values,
    scenario_parameters,
    violated_constraint,
    with_parameters,
)
from ssad.scenarios.dynamic.schema import MAX_SPEED

_DRAWS = 1000  # of which one must meet the constraints
_LEAST_SPEED = 0.1  # of the target speed: no spread makes an ego crawl


def sampling_ranges(scenario: Scenario, *, spread: float = 1.0) -> dict[str, tuple[float, float]]:
    """Return the box that draws of a scenario come from.

    The box is centred on the scenario: its explicit parameters, the defaults of the others, its target speed. What
    follows from other parameters by an expression has no range of its own, unless its declaration has a spread.

    Args:
        scenario: The nominal scenario.
        spread: Size of the box: 1 is the natural spread that `Parameter.spread` declares, 2 twice that, 0 a point.

    Returns:
        Name -> (minimum, maximum) of every sampled value, in the unit of the parameter, and of `target_speed` in
        m/s; clipped to the range of the parameter, extended to the scenario's own value if that lies outside.

    Raises:
        ConfigError: The spread is negative or not finite, or a parameter of the scenario is not valid.
    """
    if not (math.isfinite(spread) and spread >= 0.0):
        raise ConfigError(f"spread {spread:g} is not valid; give 0 (the nominal case) or more (1: the natural spread)")
    scenario_type(scenario.type).values(scenario.parameters)  # refuses wrong values
    nominal_values = parameter_values(scenario)
    ranges = {
        name: (
            # A nominal value outside the search range stays reachable: spread 0 must reproduce it.
            max(min(parameter.low, nominal_values[name]), nominal_values[name] - reach),
            min(max(parameter.high, nominal_values[name]), nominal_values[name] + reach),
        )
        for name, parameter in scenario_parameters(scenario).items()
        if (reach := spread * parameter.spread) > 0.0 and not _follows_others(scenario, name)
    }
    target_speed, speed_share = scenario.target_speed, spread * TARGET_SPEED_SPREAD
    if speed_share > 0.0 and not is_derived(scenario, TARGET_SPEED):
        ranges[TARGET_SPEED] = (
            target_speed * max(1.0 - speed_share, _LEAST_SPEED),
            min(target_speed * (1.0 + speed_share), MAX_SPEED),
        )
    return ranges


def _follows_others(scenario: Scenario, name: str) -> bool:
    """Return whether a parameter follows from others and is not drawn itself."""
    has_spread = name in scenario.declared and scenario.declared[name].spread is not None
    return is_derived(scenario, name) and not has_spread


def sample_parameters(scenario: Scenario, generator: np.random.Generator, *, spread: float = 1.0) -> Scenario:
    """Draw a scenario uniformly from the box of `sampling_ranges`.

    The draw is an ordinary scenario: it can be saved, and `build_episode` without spread makes the episode of just
    these values. It consumes one random number per range, in order, and draws again if a constraint of the scenario
    does not hold. `build_episode` checks on the lane graph that the
    actors have room at the start. Traffic is not drawn here; it depends on the seeds.

    Args:
        scenario: The nominal scenario.
        generator: Random numbers, as `ssad.core.seeding.generator` gives them.
        spread: Size of the box, as in `sampling_ranges`.

    Returns:
        The scenario with the drawn parameters and target speed, under the same name.

    Raises:
        ConfigError: As in `sampling_ranges`, or no draw meets the constraints.
    """
    ranges = sampling_ranges(scenario, spread=spread)
    violation: tuple[int, str] | None = None
    for _ in range(_DRAWS):
        shares = generator.random(len(ranges)).tolist()
        values = {
            name: min(max(low + shares[index] * (high - low), low), high)
            for index, (name, (low, high)) in enumerate(ranges.items())
        }
        drawn_scenario = with_parameters(scenario, values)
        violation = violated_constraint(drawn_scenario)
        if violation is None:
            return drawn_scenario
    assert violation is not None
    raise ConfigError(
        f"scenario {scenario.name}: constraints[{violation[0]}]: none of {_DRAWS} draws meets it; the last: "
        f"{violation[1]}; a smaller spread may do"
    )
