"""Distributions of OpenSCENARIO parameters: sets of values, and the scenarios that they make."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.command import ssad
from helpers.openscenario import document, lane_position, start, write

from ssad.core.errors import FormatError
from ssad.interchange.openscenario_distributions import assigned_values, parameter_sets
from ssad.interchange.openscenario_document import read_document
from ssad.interchange.openscenario_reader import read_openscenario_set
from ssad.scenarios.dynamic import read_scenarios

SINGLE = '<DeterministicSingleParameterDistribution parameterName="{}">{}</DeterministicSingleParameterDistribution>'
RANGE = '<DistributionRange stepWidth="{}"><Range lowerLimit="{}" upperLimit="{}"/></DistributionRange>'
STOCHASTIC = '<Stochastic numberOfTestRuns="{}" randomSeed="{}">{}</Stochastic>'


def distribution(content: str) -> str:
    return (
        '<OpenSCENARIO><FileHeader revMajor="1" revMinor="3" date="" description="" author=""/>'
        f'<ParameterValueDistribution><ScenarioFile filepath="test.xosc"/>{content}</ParameterValueDistribution>'
        "</OpenSCENARIO>"
    )


def sets(folder: Path, content: str, count: int | None = None) -> list[dict[str, str]]:
    path = folder / "d.xosc"
    path.write_text(distribution(content))
    return parameter_sets(read_document(path), path, count=count)[0]


def test_ranges_sets_and_groups_of_values_are_crossed(tmp_path: Path) -> None:
    pairs = "".join(
        f'<ParameterValueSet><ParameterAssignment parameterRef="b" value="{b}"/>'
        f'<ParameterAssignment parameterRef="c" value="{c}"/></ParameterValueSet>'
        for b, c in ((1, "x"), (2, "y"))
    )
    content = (
        f"<Deterministic>{SINGLE.format('a', RANGE.format(0.1, 0, 0.3))}<DeterministicMultiParameterDistribution>"
        f"<ValueSetDistribution>{pairs}</ValueSetDistribution></DeterministicMultiParameterDistribution></Deterministic>"
    )
    found = sets(tmp_path, content)
    assert found[:3] == [
        {"a": "0", "b": "1", "c": "x"},
        {"a": "0", "b": "2", "c": "y"},
        {"a": "0.1", "b": "1", "c": "x"},
    ]
    assert found[-1] == {"a": "0.3", "b": "2", "c": "y"}
    assert len(found) == 8
    drawn = sets(tmp_path, content, count=3)
    assert len(drawn) == 3
    assert all(values in found for values in drawn)
    assert drawn == sets(tmp_path, content, count=3)


def test_stochastic_distributions_are_drawn_by_their_seed(tmp_path: Path) -> None:
    kinds = {
        "uniform": '<UniformDistribution><Range lowerLimit="2" upperLimit="4"/></UniformDistribution>',
        "normal": '<NormalDistribution expectedValue="10" variance="4"><Range lowerLimit="9" upperLimit="99"/>'
        "</NormalDistribution>",
        "count": '<PoissonDistribution expectedValue="3"/>',
        "choice": '<ProbabilityDistributionSet><Element value="car" weight="3"/><Element value="van" weight="1"/>'
        "</ProbabilityDistributionSet>",
        "bins": '<Histogram><Bin weight="0"><Range lowerLimit="0" upperLimit="1"/></Bin>'
        '<Bin weight="2"><Range lowerLimit="5" upperLimit="6"/></Bin></Histogram>',
    }
    content = "".join(
        f'<StochasticDistribution parameterName="{name}">{kind}</StochasticDistribution>'
        for name, kind in kinds.items()
    )
    found = sets(tmp_path, STOCHASTIC.format(400, 7, content))
    assert found == sets(tmp_path, STOCHASTIC.format(400, 7, content))
    assert found != sets(tmp_path, STOCHASTIC.format(400, 8, content))
    values = {name: [row[name] for row in found] for name in kinds}
    uniform, normal, bins = (np.array(values[name], float) for name in ("uniform", "normal", "bins"))
    assert 2.0 <= uniform.min() < 2.2
    assert 3.8 < uniform.max() <= 4.0
    assert normal.min() >= 9.0
    # Of a normal distribution with mean 10 and deviation 2, cut off at 9: mean 10 + 2 * 0.3521 / 0.6915.
    assert normal.mean() == pytest.approx(11.02, abs=0.25)
    assert np.array(values["count"], int).mean() == pytest.approx(3.0, abs=0.4)
    assert 250 < values["choice"].count("car") < 350
    assert bins.min() >= 5.0


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "neither Deterministic nor Stochastic"),
        (f"<Deterministic>{SINGLE.format('a', RANGE.format(0, 0, 1))}</Deterministic>", "in steps of 0"),
        (f"<Deterministic>{SINGLE.format('a', RANGE.format(1e-9, 0, 1))}</Deterministic>", "more than 100000"),
        (f"<Deterministic>{SINGLE.format('a', '<UserDefinedDistribution/>')}</Deterministic>", "is not read"),
        (f"<Deterministic>{SINGLE.format('a', RANGE.format(1, 1, 20000))}</Deterministic>", "draw some with --count"),
        (STOCHASTIC.format(0, 0, ""), "numberOfTestRuns is 0"),
        (STOCHASTIC.format(1, 0, '<StochasticDistribution parameterName="a"><X/></StochasticDistribution>'), "unknown"),
    ],
)
def test_broken_distributions_are_refused(content: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(FormatError) as refused:
        sets(tmp_path, content)
    assert message in str(refused.value)
    with pytest.raises(FormatError, match="NAME=VALUE"):
        assigned_values(["speed"])


def test_a_parameter_that_the_scenario_does_not_declare_is_named_with_its_line(tmp_path: Path) -> None:
    """With the file and the line of the distribution, not of the scenario."""
    declared = '<ParameterDeclaration name="gap" parameterType="double" value="5"/>'
    starts = start("Ego", lane_position(-1, 50), "$gap") + start("Target", lane_position(-1, 100), 5)
    write(tmp_path, document(starts, parameters=declared))
    content = SINGLE.format("gap", RANGE.format(5, 5, 10)) + "\n" + SINGLE.format("gop", RANGE.format(5, 5, 10))
    path = tmp_path / "d.xosc"
    path.write_text(distribution(f"<Deterministic>\n{content}</Deterministic>"))
    with pytest.raises(FormatError) as refused:
        read_openscenario_set(path)
    assert str(refused.value) == (
        f"{path}:3: DeterministicSingleParameterDistribution: its scenario declares no parameter 'gop' that could be "
        "set; declared: gap"
    )


@pytest.mark.parametrize(("minor", "is_noted"), [("2", False), ("3", False), ("4", True)])
def test_a_version_newer_than_known_is_noted(minor: str, is_noted: bool, tmp_path: Path) -> None:
    starts = start("Ego", lane_position(-1, 50), 10) + start("Target", lane_position(-1, 100), 5)
    text = document(starts).replace('revMinor="3"', f'revMinor="{minor}"')
    report = read_openscenario_set(write(tmp_path, text)).report
    notes = [note for note in report.notes if "newer than 1.3" in note]
    assert len(notes) == is_noted
    assert all(f"version 1.{minor}" in note for note in notes)


def test_a_distribution_becomes_a_set_of_scenarios(tmp_path: Path) -> None:
    """Sets of values that a constraint excludes are left out; a value can be set from outside."""
    limits = '<ConstraintGroup><ValueConstraint rule="lessThan" value="$ego"/></ConstraintGroup>'
    parameters = (
        '<ParameterDeclaration name="ego" parameterType="double" value="20"/>'
        f'<ParameterDeclaration name="target" parameterType="double" value="5">{limits}</ParameterDeclaration>'
    )
    starts = start("Ego", lane_position(-1, 50), "$ego") + start("Target", lane_position(-1, 100), "$target")
    path = write(tmp_path, document(starts, parameters=parameters))
    (tmp_path / "d.xosc").write_text(
        distribution(f"<Deterministic>{SINGLE.format('target', RANGE.format(5, 5, 25))}</Deterministic>")
    )
    done = ssad(
        "import", "openscenario", tmp_path / "d.xosc", tmp_path / "out.yaml", "--map", path.parent / "road.xodr"
    )
    assert done.returncode == 0, done.stderr
    found = read_scenarios(tmp_path / "out.yaml")
    assert [scenario.name for scenario in found] == ["test/0001", "test/0002", "test/0003"]
    assert [scenario.actors[0].speed for scenario in found] == [5.0, 10.0, 15.0]
    assert "2 of 5 sets of values are excluded by constraints" in done.stdout
    arguments = ("--map", path.parent / "road.xodr", "--set", "ego=6")
    done = ssad("import", "openscenario", path, tmp_path / "one.yaml", *arguments)
    assert done.returncode == 0, done.stderr
    (scenario,) = read_scenarios(tmp_path / "one.yaml")
    assert scenario.target_speed == 6.0
