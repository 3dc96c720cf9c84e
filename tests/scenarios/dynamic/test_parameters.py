"""Parameters that scenarios declare, the expressions that use them, constraints, and grids."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssad.core.errors import ConfigError
from ssad.core.safeio import dump_json, parse_yaml_document
from ssad.core.seeding import digest
from ssad.core.types import Scenario
from ssad.scenarios.dynamic import (
    build_episode,
    load_scenarios,
    read_scenarios,
    sample_parameters,
    sampling_ranges,
    save_scenarios,
    scenario_data,
    scenario_from,
    scenario_parameters,
    with_parameters,
)
from ssad.scenarios.dynamic.parameters import grid_values
from ssad.scenarios.dynamic.search.box import ParameterBox
from ssad.scenarios.dynamic.search.sampling import GridSearch, HaltonSearch, RandomSearch
from ssad.simulators.closed_loop import scenario_json
from ssad.world.roads import load_town

CUT = """\
name: my/cut
type: Custom
town: ProvingGround
route:
- {x: 217.0, y: -5.25}
- {x: 317.0, y: -5.25}
target_speed: ego
parameters:
  ego: {value: 10, range: [5, 15], unit: m/s}
  ego_speed: ego
  gap: {value: 20.0, range: [8, 40], spread: 4, unit: m, grid: {from: 10, to: 30, step: 10}, doc: to the van}
  slow: {value: ego / 2}
constraints: [gap > 5 + slow]
limits: {max_steps: round(gap) * 10}
actors:
- name: van
  model: van
  pose: {x: 217 + gap, y: -5.25}
  phases:
  - speed: "${slow + 1}"
    when: {kind: time, value: "max(0, (gap - 10) / ego)"}
"""


def scenario(text: str = CUT) -> Scenario:
    document = parse_yaml_document(text, "cut.yaml")
    return scenario_from(document.data, document)


def test_expressions_have_their_values() -> None:
    cut = scenario()
    van = cut.actors[0]
    assert (van.pose.x, van.phases[0].speed, van.phases[0].when.value) == (237.0, 6.0, 1.0)
    assert (cut.target_speed, cut.parameters, cut.limits.max_steps) == (10.0, {"ego_speed": 10.0}, 200)
    assert isinstance(cut.limits.max_steps, int)
    other = with_parameters(cut, {"ego": 12.0, "gap": 34.0})
    van = other.actors[0]
    assert (van.pose.x, van.phases[0].speed, van.phases[0].when.value) == (251.0, 7.0, 2.0)
    assert (other.target_speed, other.parameters, other.limits.max_steps) == (12.0, {"ego_speed": 12.0}, 340)
    assert with_parameters(other, {"ego": 10.0, "gap": 20.0, "slow": 5.0}) != cut  # slow no longer follows ego
    assert with_parameters(other, {"slow": 3.0}).actors[0].phases[0].speed == 4.0


def test_a_parameter_that_is_set_follows_nothing() -> None:
    cut = with_parameters(scenario(), {"ego_speed": 3.0, "target_speed": 7.0})
    changed = with_parameters(cut, {"ego": 14.0})
    assert (changed.parameters["ego_speed"], changed.target_speed) == (3.0, 7.0)
    with pytest.raises(ConfigError, match="no such parameter 'gpa'; it has: ego, gap, slow, ego_speed"):
        with_parameters(cut, {"gpa": 1.0})


def test_files_keep_expressions(tmp_path: Path) -> None:
    cut = scenario()
    save_scenarios(tmp_path / "cut.yaml", cut)
    assert read_scenarios(tmp_path / "cut.yaml") == (cut,)
    text = (tmp_path / "cut.yaml").read_text()
    for part in ("217 + gap", "${slow + 1}", "ego / 2", "round(gap) * 10", "range: [8.0, 40.0]", "gap > 5 + slow"):
        assert part in text
    drawn = with_parameters(cut, {"gap": 31.5})
    assert scenario_from(scenario_data(drawn)) == drawn
    assert scenario_from(scenario_json(drawn)) == drawn


def test_the_scenario_of_an_episode_is_the_drawn_one() -> None:
    cut, town = scenario(), load_town("ProvingGround")
    episodes = [build_episode(cut, town, seed=seed, spread=1.0) for seed in range(6)]
    gaps = {episode.agents[1].pose.x - 217.0 for episode in episodes}
    assert len(gaps) == 6
    assert all(16.0 <= gap <= 24.0 for gap in gaps)
    for episode in episodes:
        assert episode.scenario.actors[0].pose == episode.agents[1].pose
        restored = scenario_from(scenario_json(episode.scenario))
        assert build_episode(restored, town, seed=episode.seed) == episode


def test_ranges_of_repetitions() -> None:
    ranges = sampling_ranges(scenario())
    # slow, ego_speed and the target speed follow ego, which has no spread
    assert ranges == {"gap": (16.0, 24.0), "ego_longitudinal": (0.0, 4.0)} | {
        name: ranges[name] for name in ("ego_lateral", "ego_heading")
    }


def test_draws_meet_the_constraints() -> None:
    near = with_parameters(scenario(CUT.replace("spread: 4", "spread: 12")), {"gap": 11.0})
    drawn = [sample_parameters(near, np.random.default_rng(seed)) for seed in range(40)]
    gaps = [draw.actors[0].pose.x - 217.0 for draw in drawn]
    assert min(gaps) > 10.0
    assert max(gaps) > 15.0
    impossible = scenario(CUT.replace("[gap > 5 + slow]", "[gap == 20]"))
    with pytest.raises(ConfigError, match=r"constraints\[0\]: none of 1000 draws .* does not hold where gap = "):
        sample_parameters(impossible, np.random.default_rng(0))


def test_searches_cover_declared_ranges_within_the_constraints() -> None:
    cut, town = scenario(), load_town("ProvingGround")
    assert ParameterBox.of(cut).ranges == {"ego": (5.0, 15.0), "gap": (8.0, 40.0)}

    class Base:
        scenario = build_episode(cut, town, seed=0).scenario

    for search_type in (RandomSearch, HaltonSearch, GridSearch):
        search: Any = search_type([Base], seeds=[0], budget=36)  # type: ignore[list-item]
        (proposals,) = search.ask(36)
        points = [(p.scenario.target_speed, p.scenario.actors[0].pose.x - 217.0) for p in proposals]
        assert all(gap > 5 + ego / 2 for ego, gap in points)
        assert len(points) == (36 if search_type is not GridSearch else 34)
        assert max(ego for ego, _ in points) > 13
        assert min(ego for ego, _ in points) < 7


def test_a_parameter_of_a_class_can_be_narrowed_and_used() -> None:
    text = CUT.replace("Custom", "StraightObstacle")[: CUT.index("actors:") + 10].replace("  ego_speed: ego\n", "")
    text = text[: text.index("parameters:")] + (
        "parameters:\n"
        "  walker_speed: {value: 1.5, range: [1, 2], spread: 0.1}\n"
        "  ego: {value: 8}\n"
        "  trigger_distance: 10 * walker_speed\n"
    )
    walker = scenario(text)
    assert walker.parameters == {"walker_speed": 1.5, "trigger_distance": 15.0}
    ranges = ParameterBox.of(walker).ranges
    assert ranges["walker_speed"] == (1.0, 2.0)
    assert "trigger_distance" not in ranges
    assert "start_distance" in ranges
    assert sampling_ranges(walker)["walker_speed"] == (1.4, 1.6)
    assert scenario_parameters(walker)["walker_speed"].unit == "m/s"
    faster = with_parameters(walker, {"walker_speed": 2.0})
    assert build_episode(faster, load_town("ProvingGround"), seed=0).agents[1].phases[0].speed == 2.0
    assert faster.parameters["trigger_distance"] == 20.0


BAD = [
    ("gap - 10", "gpa - 10", r"actors\[0\].phases\[0\].when.value: expression .*no parameter 'gpa'; closest: gap"),
    ("/ ego)", "/ (ego - 10))", "when.value: .*division by zero, where gap = 20, ego = 10"),
    ("value: ego / 2", "value: gap * slow", "parameters.slow.value: .*in a circle: slow -> slow"),
    ("value: ego / 2", "value: ego / 0", "parameters.slow.value: .*division by zero"),
    ("range: [5, 15]", "range: [15, 5]", "parameters.ego.range: the range from 15 to 5 is empty"),
    ("value: 10,", "value: 20,", "parameters.ego.value: 20 is outside its range, 5 to 15 m/s"),
    ("value: 10,", "", "parameters.ego: key 'value' is missing"),
    ("value: 10,", "value: [1],", "parameters.ego.value: a number or an expression"),
    ("range: [5, 15]", "rnge: [5, 15]", "parameters.ego.rnge: unknown key; known: value, range, spread"),
    ("range: [5, 15]", "range: [5]", "parameters.ego.range"),
    ("step: 10}", "step: 0}", "parameters.gap.grid: step of a grid is more than 0"),
    ("to: 30", "to: 50", r"parameters.gap.grid\[4\]: 50 is outside its range, 8 to 40"),
    ("spread: 4", "spread: -4", "parameters.gap.spread: -4 is not valid"),
    ("gap > 5 + slow", "gap > 5 * slow", r"constraints\[0\]: 'gap > 5 \* slow' does not hold where gap = 20, slow"),
    ("gap > 5 + slow", "gap > spede", r"constraints\[0\]: .*no parameter 'spede'"),
    ("round(gap) * 10", "gap / 3", "limits.max_steps: .*6.66667 is not a whole number; use round"),
    ("${slow + 1}", "${slow + 90}", r"phases\[0\].speed: 95 is outside .* \(the value of '\$\{slow \+ 90\}'\)"),
    ("  slow:", "  target_speed:", "parameters.target_speed: 'target_speed' has a meaning of its own"),
    ("  slow:", "  a-b:", "the name of a parameter has letters"),
    ("ego_speed: ego", "ego_speed: 5 * ego", "parameters.ego_speed: .* is outside"),
    ("  ego_speed: ego", "  speed: 3", r"no such parameter; Custom has: ego_speed.*write speed: \{value: 3\}"),
]


@pytest.mark.parametrize(("old", "new", "message"), BAD, ids=[bad[1] or "nothing" for bad in BAD])
def test_errors_name_line_and_key(old: str, new: str, message: str) -> None:
    line = CUT[: CUT.index(old)].count("\n") + 1
    with pytest.raises(ConfigError, match=message) as refused:
        scenario(CUT.replace(old, new))
    assert str(refused.value).startswith(f"cut.yaml:{line}: ")


@pytest.mark.parametrize(
    ("entry", "values"),
    [
        ([3, 1, 2.5], (3.0, 1.0, 2.5)),
        ({"from": 0, "to": 1, "step": 0.25}, (0.0, 0.25, 0.5, 0.75, 1.0)),
        ({"from": 0, "to": 0.3, "step": 0.1}, (0.0, 0.1, 0.2, 0.3)),
        ({"from": 0, "to": 1, "step": 0.4}, (0.0, 0.4, 0.8)),
        ({"from": -1, "to": 1, "count": 3}, (-1.0, 0.0, 1.0)),
    ],
)
def test_grids(entry: Any, values: tuple[float, ...]) -> None:
    assert grid_values(entry) == values


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ([], "the grid is empty"),
        ([1, 1.0], "has 1 twice"),
        ([1, "a"], "numbers alone"),
        ([True], "numbers alone"),
        (3, "a grid is a list of numbers"),
        ({"from": 2, "to": 1, "step": 1}, "from 2 to 1 is empty"),
        ({"from": 0, "to": 1, "step": 1e-9}, "more than 100000 values"),
        ({"from": 0, "to": 1}, "has the keys from, to, and step or count"),
        ({"from": 0, "to": 1, "count": 1}, "count of a grid is a whole number from 2"),
        ({"from": "a", "to": 1, "count": 2}, "from of a grid is a number"),
    ],
)
def test_broken_grids_are_refused(entry: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        grid_values(entry)


def test_fields_that_came_later_change_no_seed() -> None:
    """The hash is that of SSAD before scenarios had parameters of their own: seeds of cells follow from it."""
    (old,) = load_scenarios("StraightObstacle/00")
    assert digest(dump_json(scenario_json(old)))[:12] == "9e58a6134e6e"
    assert "friction" in scenario_json(dataclasses.replace(old, friction=0.5))
