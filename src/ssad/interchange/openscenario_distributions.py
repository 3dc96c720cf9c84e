"""Distributions of OpenSCENARIO parameters, expanded to sets of values.

Single parameters are crossed with each other and with the sets of several parameters; a stochastic distribution gives
as many draws as it has test runs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import NormalDist
from typing import TYPE_CHECKING, Final

from ssad.core.errors import FormatError
from ssad.core.expressions import text_of
from ssad.core.seeding import generator
from ssad.interchange.openscenario_document import AttributeReader, declarations, undeclared

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

    import numpy as np

MAX_SETS: Final = 10_000
MAX_VALUES: Final = 100_000  # of one parameter
DRAWS: Final = 1_000  # of a value beyond its range
Draw = Callable[["np.random.Generator"], str]


def scenario_file(root: Element, path: Path) -> Path | None:
    """Return the scenario file of a document of distributions; None if it is a scenario itself.

    Raises:
        FormatError: It names none.
    """
    distribution = root.find("ParameterValueDistribution")
    if distribution is None or root.find("Storyboard") is not None:
        return None
    values = AttributeReader(str(path))
    element = distribution.find("ScenarioFile")
    if element is None:
        raise values.error(distribution, "ScenarioFile is missing")
    scenario = path.parent / values.text(element, "filepath").replace("\\", "/")
    if scenario.suffix != ".xosc" or Path(element.get("filepath", "")).is_absolute() or not scenario.is_file():
        raise values.error(
            element, f"there is no scenario '{element.get('filepath', '')[:120]}'; put it beside the file"
        )
    return scenario


def parameter_sets(root: Element, path: Path, *, count: int | None = None) -> tuple[list[dict[str, str]], int]:
    """Return the values of the parameters of each scenario of a distribution.

    Args:
        root: The document.
        path: Its file.
        count: Draw so many of the sets; None: all.

    Returns:
        The sets, and the number of all sets.

    Raises:
        FormatError: A distribution is broken or of an unknown kind, or has more than `MAX_SETS` sets.
    """
    values = AttributeReader(str(path))
    distribution = root.find("ParameterValueDistribution")
    if distribution is None:
        return [{}], 1
    stochastic = distribution.find("Stochastic")
    if stochastic is not None:
        return _stochastic(stochastic, values, path.stem, count)
    deterministic = distribution.find("Deterministic")
    if deterministic is None:
        raise values.error(distribution, "neither Deterministic nor Stochastic")
    value_axes = [_axis(element, values) for element in deterministic]
    set_count = math.prod(len(value_axis) for value_axis in value_axes)
    if set_count > MAX_SETS and count is None:
        raise values.error(
            deterministic, f"{set_count} sets of values; at most {MAX_SETS} scenarios are made: draw some with --count"
        )
    if count is None or count >= set_count:
        numbers = range(set_count)
    else:
        random = generator("openscenario", path.stem, "sets")
        drawn: set[int] = set()
        while len(drawn) < count:
            drawn.add(int(random.integers(set_count)))
        numbers = sorted(drawn)  # type: ignore[assignment]
    return [_combination(value_axes, number) for number in numbers], set_count


def check_names(root: Element, path: Path, document: Element) -> None:
    """Raise FormatError, with its line, for the first parameter of a distribution that its scenario does not declare.

    Args:
        root: The document of the distribution.
        path: Its file.
        document: The document of the scenario.
    """
    distribution = root.find("ParameterValueDistribution")
    if distribution is None:
        return
    values = AttributeReader(str(path))
    declared = list(declarations(document))
    for element in distribution.iter():
        for attribute in ("parameterName", "parameterRef"):
            name = element.get(attribute, "").removeprefix("$")
            if name and name not in declared:
                raise values.error(element, undeclared(name, declared, "its scenario"))


def _combination(value_axes: Sequence[Sequence[Mapping[str, str]]], number: int) -> dict[str, str]:
    """Return the combination with a number; the last axis changes fastest."""
    chosen: list[Mapping[str, str]] = []
    for value_axis in reversed(value_axes):
        number, index = divmod(number, len(value_axis))
        chosen.append(value_axis[index])
    return {name: value for part in reversed(chosen) for name, value in part.items()}


def _axis(element: Element, values: AttributeReader) -> list[dict[str, str]]:
    """Return the values of one or several parameters that vary together."""
    if element.tag == "DeterministicMultiParameterDistribution":
        value_axis = [
            {
                values.text(value_element, "parameterRef").removeprefix("$"): values.text(value_element, "value")
                for value_element in parameter_set.iterfind("ParameterAssignment")
            }
            for parameter_set in element.iterfind("ValueSetDistribution/ParameterValueSet")
        ]
    elif element.tag == "DeterministicSingleParameterDistribution":
        name = values.text(element, "parameterName").removeprefix("$")
        value_axis = [{name: value} for value in _single(element, values)]
    else:
        raise values.error(element, "a distribution of an unknown kind")
    if not value_axis:
        raise values.error(element, "it has no values")
    return value_axis


def _single(element: Element, values: AttributeReader) -> list[str]:
    content = next((child for child in element if child.tag != "UserDefinedDistribution"), None)
    if content is None:
        raise values.error(element, "a UserDefinedDistribution is not read; state a set or a range")
    if content.tag == "DistributionSet":
        return [values.text(value_element, "value") for value_element in content.iterfind("Element")]
    if content.tag == "DistributionRange":
        step = values.number(content, "stepWidth")
        lower_limit, upper_limit = _range(content, values)
        if not step > 0.0 or upper_limit < lower_limit:
            raise values.error(content, f"no values from {lower_limit:g} to {upper_limit:g} in steps of {step:g}")
        steps = math.floor((upper_limit - lower_limit) / step + 1e-9)
        if steps >= MAX_VALUES:
            raise values.error(content, f"more than {MAX_VALUES} values")
        # 12 digits: 0.1 + 0.2 is meant to be 0.3.
        return [text_of(float(f"{lower_limit + index * step:.12g}")) for index in range(steps + 1)]
    raise values.error(content, "a distribution of an unknown kind; known: DistributionSet, DistributionRange")


def _range(element: Element, values: AttributeReader) -> tuple[float, float]:
    limits = element.find("Range")
    if limits is None:
        return -math.inf, math.inf
    lower_limit, upper_limit = values.number(limits, "lowerLimit"), values.number(limits, "upperLimit")
    if upper_limit < lower_limit:
        raise values.error(limits, f"upperLimit {upper_limit:g} is below lowerLimit {lower_limit:g}")
    return lower_limit, upper_limit


def _stochastic(
    element: Element, values: AttributeReader, stem: str, count: int | None
) -> tuple[list[dict[str, str]], int]:
    set_count = values.number(element, "numberOfTestRuns")
    if not 1 <= set_count <= MAX_SETS:
        raise values.error(element, f"numberOfTestRuns is {set_count:g}; 1 to {MAX_SETS} are made")
    seed = values.number(element, "randomSeed", 0.0)
    draw_functions: list[tuple[str, Draw]] = []
    for distribution in element.iterfind("StochasticDistribution"):
        content = next(iter(distribution), None)
        if content is None or content.tag not in _DRAWS:
            raise values.error(distribution, f"a distribution of an unknown kind; known: {', '.join(_DRAWS)}")
        name = values.text(distribution, "parameterName").removeprefix("$")
        draw_functions.append((name, _DRAWS[content.tag](content, values)))
    if not draw_functions:
        raise values.error(element, "StochasticDistribution is missing")
    random = generator("openscenario", stem, text_of(seed))
    sets = [
        {name: draw_value(random) for name, draw_value in draw_functions}
        for _ in range(int(min(set_count, count or set_count)))
    ]
    return sets, int(set_count)


def _choice(element: Element, values: AttributeReader) -> Draw:
    items = element.findall("Element")
    weights = [values.number(value_element, "weight") for value_element in items]
    value_texts = [values.text(value_element, "value") for value_element in items]
    _check_weights(element, weights, values)
    return lambda random: value_texts[
        int(random.choice(len(value_texts), p=[weight / sum(weights) for weight in weights]))
    ]


def _histogram(element: Element, values: AttributeReader) -> Draw:
    bins = element.findall("Bin")
    weights = [values.number(value_element, "weight") for value_element in bins]
    ranges = [_range(value_element, values) for value_element in bins]
    _check_weights(element, weights, values)
    if any(math.isinf(lower_limit) for lower_limit, _ in ranges):
        raise values.error(element, "a Bin without Range")

    def draw_value(random: np.random.Generator) -> str:
        lower_limit, upper_limit = ranges[
            int(random.choice(len(ranges), p=[weight / sum(weights) for weight in weights]))
        ]
        return text_of(float(random.uniform(lower_limit, upper_limit)))

    return draw_value


def _check_weights(element: Element, weights: Sequence[float], values: AttributeReader) -> None:
    if not weights or min(weights) < 0.0 or not 0.0 < sum(weights) < math.inf:
        raise values.error(element, "weights must not be negative, and not all 0")


def _uniform(element: Element, values: AttributeReader) -> Draw:
    lower_limit, upper_limit = _range(element, values)
    if math.isinf(lower_limit):
        raise values.error(element, "Range is missing")
    return lambda random: text_of(float(random.uniform(lower_limit, upper_limit)))


def _normal(element: Element, values: AttributeReader) -> Draw:
    expected_value, variance = values.number(element, "expectedValue"), values.number(element, "variance")
    lower_limit, upper_limit = _range(element, values)
    if not variance > 0.0:
        raise values.error(element, f"variance is {variance:g}, not above 0")
    is_log = element.tag == "LogNormalDistribution"
    if is_log:
        lower_limit, upper_limit = (
            math.log(limit) if limit > 0.0 else -math.inf for limit in (lower_limit, upper_limit)
        )
    normal = NormalDist(expected_value, math.sqrt(variance))
    start, end = (
        normal.cdf(limit) if math.isfinite(limit) else float(limit > 0.0) for limit in (lower_limit, upper_limit)
    )
    if not end - start > 1e-9:
        raise values.error(element, "its Range has almost no probability")

    def draw_value(random: np.random.Generator) -> str:
        share = min(max(start + (end - start) * float(random.uniform()), 1e-12), 1.0 - 1e-12)
        value = min(max(normal.inv_cdf(share), lower_limit), upper_limit)
        return text_of(math.exp(value) if is_log else value)

    return draw_value


def _poisson(element: Element, values: AttributeReader) -> Draw:
    expected_value = values.number(element, "expectedValue")
    lower_limit, upper_limit = _range(element, values)
    if not 0.0 < expected_value < 1e6:
        raise values.error(element, f"expectedValue is {expected_value:g}, outside 0 to 1e6")

    def draw_value(random: np.random.Generator) -> str:
        drawn = random.poisson(expected_value, DRAWS)
        inside = drawn[(drawn >= lower_limit) & (drawn <= upper_limit)]
        if not len(inside):
            raise values.error(element, "its Range has almost no probability")
        return str(int(inside[0]))

    return draw_value


_DRAWS: Final[Mapping[str, Callable[[Element, AttributeReader], Draw]]] = {
    "ProbabilityDistributionSet": _choice,
    "Histogram": _histogram,
    "UniformDistribution": _uniform,
    "NormalDistribution": _normal,
    "LogNormalDistribution": _normal,
    "PoissonDistribution": _poisson,
}


def assigned_values(value_texts: Sequence[str]) -> dict[str, str]:
    """Return the values of NAME=VALUE texts. FormatError if one has another form."""
    pairs = [text.partition("=") for text in value_texts]
    for text, (name, sign, _) in zip(value_texts, pairs, strict=True):
        if not name or not sign:
            raise FormatError(f"--set {text[:60]}: state NAME=VALUE, such as --set speed=10")
    return {name.strip().removeprefix("$"): value.strip() for name, _, value in pairs}
