"""The page on scenarios says what the program does."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from ssad.scenarios.dynamic import SCENARIOS, build_episode, load_scenarios, scenario_type
from ssad.scenarios.dynamic.knowledge._kind import EGO_START, TARGET_SPEED_SPREAD
from ssad.world.models import MODELS
from ssad.world.roads import load_town

DOCS = Path(__file__).parents[2] / "docs"
GUIDE = (DOCS / "how-to" / "write-scenarios.md").read_text()
PAGE = (DOCS / "reference" / "scenarios.md").read_text()


@pytest.mark.parametrize("text", re.findall(r"```yaml\n(.*?)```", GUIDE, re.S))
def test_the_examples_become_episodes(text: str, tmp_path: Path) -> None:
    path = tmp_path / "example.yaml"
    path.write_text(text)
    (scenario,) = load_scenarios(path)
    episode = build_episode(scenario, load_town(scenario.town), seed=0)
    assert len(episode.agents) == 3


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
