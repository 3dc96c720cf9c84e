"""The page on scenarios says what the program does."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import get_args

import pytest

from ssad.core.triggers import all_phases
from ssad.core.types import (
    Actor,
    Arrival,
    Controller,
    DeclaredParameter,
    Episode,
    Impact,
    LateralPhase,
    Phase,
    PhaseTrigger,
    TriggerKind,
)
from ssad.experiments.suites import kind_of, load_suite
from ssad.scenarios.dynamic import SCENARIOS, build_episode, load_scenarios, scenario_type
from ssad.scenarios.dynamic.knowledge._kind import EGO_START, TARGET_SPEED_SPREAD
from ssad.world.models import MODELS
from ssad.world.roads import load_town
from ssad.world.world import World

DOCS = Path(__file__).parents[2] / "docs"
GUIDE = (DOCS / "how-to" / "write-scenarios.md").read_text()
PAGE = (DOCS / "reference" / "scenarios.md").read_text()


EXAMPLES = re.findall(r"```yaml\n(.*?)```", GUIDE, re.S)
SCENARIO_EXAMPLES = [text for text in EXAMPLES if text.startswith("name:")]
ACTOR_EXAMPLES = [text for text in EXAMPLES if text.startswith("- name:")]


def built(text: str, folder: Path) -> Episode:
    path = folder / "example.yaml"
    path.write_text(text)
    (scenario,) = load_scenarios(path)
    return build_episode(scenario, load_town(scenario.town), seed=0)


@pytest.mark.parametrize("text", SCENARIO_EXAMPLES)
def test_the_examples_become_episodes(text: str, tmp_path: Path) -> None:
    assert len(built(text, tmp_path).agents) == 3


def test_everything_in_the_examples_of_actors_happens(tmp_path: Path) -> None:
    """Every phase begins while an ego at 8 m/s passes."""
    head = next(text for text in SCENARIO_EXAMPLES if "actors:" in text).split("actors:")[0]
    episodes = [built(f"{head}limits: {{contact: count}}\nactors:\n{text}", tmp_path) for text in ACTOR_EXAMPLES]
    assert len(ACTOR_EXAMPLES) + len(SCENARIO_EXAMPLES) == len(EXAMPLES) >= 6
    world = World(episodes, {"ProvingGround": load_town("ProvingGround")}, ego=Controller.FOLLOW)
    for _ in range(140):
        world.step()
    begun = world.array("script.begun") > 0
    for scene, episode in enumerate(episodes):
        count = sum(len(all_phases(agent)) for agent in episode.agents)
        assert begun[scene, :count].all(), ACTOR_EXAMPLES[scene]


@pytest.mark.parametrize("table", [Actor, Phase, LateralPhase, PhaseTrigger, Arrival, Impact, DeclaredParameter])
def test_the_reference_has_every_key(table: type) -> None:
    for field in dataclasses.fields(table):
        assert f"`{field.name}`" in PAGE, field.name


def test_the_reference_has_every_kind_of_condition() -> None:
    table = PAGE[PAGE.index("| Kind | Holds if |") : PAGE.index("A condition that can never hold")]
    kinds = [row.split("|")[1] for row in table.splitlines() if row.startswith("| `")]
    assert set(get_args(TriggerKind)) == set(re.findall(r"`(\w+)`", " ".join(kinds)))


@pytest.mark.parametrize("kind", SCENARIOS)
def test_the_table_has_the_parameters(kind: str) -> None:
    row = next(line for line in PAGE.splitlines() if line.startswith(f"| {kind} |"))
    for p in scenario_type(kind).parameters:
        unit = f" {p.unit}" if p.unit else ""
        spread = f" ± {p.spread:g}" if p.spread else ""
        assert f"`{p.name}` {p.default:g}{spread} ({p.low:.4g} to {p.high:.4g}{unit})" in row


def test_the_table_has_the_egos_start() -> None:
    for p in EGO_START:
        assert f"| `{p.name}` | {p.default:g} ± {p.spread:g} ({p.low:g} to {p.high:g} {p.unit}) |" in PAGE
    assert f"its own value ± {100 * TARGET_SPEED_SPREAD:g} %" in PAGE


def test_the_models_are_listed() -> None:
    assert f"Models: {', '.join(MODELS)}." in GUIDE


SWEEP_GUIDE = (DOCS / "how-to" / "sweep-parameters.md").read_text()


def test_the_examples_of_sweeps_run(tmp_path: Path) -> None:
    examples = re.findall(r"```yaml\n# (\S+)\n(.*?)```", SWEEP_GUIDE, re.S)
    assert [name for name, _ in examples] == ["crossing.yaml", "grid.yaml", "overlap.yaml"]
    for name, text in examples:
        (tmp_path / name).write_text(text)
    suite = load_suite(str(tmp_path / "grid.yaml"))
    kind = kind_of("driving")
    plan = kind.plan(suite)
    (line,) = kind.plan_lines(plan)
    assert f"\n{line}\n" in SWEEP_GUIDE
    cells = {cell.name for cell in plan.cells}
    assert set(re.findall(r"`(blind/my/\S+)`", SWEEP_GUIDE)) <= cells
    (scenario,) = load_scenarios(tmp_path / "overlap.yaml")
    car, walker = build_episode(scenario, load_town(scenario.town), seed=0).agents[1:]
    assert car.pose.y + 5.25 == pytest.approx(1.03)
    assert (walker.speed, walker.pose.y) == (1.4, pytest.approx(-5.25 - 0.25 * 2.06 - 1.4 * 6.0))
