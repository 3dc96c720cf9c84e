"""The page on scenarios says what the program does."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from ssad.roads import load_town
from ssad.scenarios.dynamic import SCENARIOS, build_episode, load_scenarios, parameter_box
from ssad.world.models import MODELS

PAGE = (Path(__file__).parents[2] / "docs" / "scenarios.md").read_text()


@pytest.mark.parametrize("text", re.findall(r"```yaml\n(.*?)```", PAGE, re.S))
def test_the_examples_become_episodes(text: str, tmp_path: Path) -> None:
    path = tmp_path / "example.yaml"
    path.write_text(text)
    (scenario,) = load_scenarios(path)
    episode = build_episode(scenario, load_town(scenario.town), seed=0)
    assert len(episode.agents) == 3


@pytest.mark.parametrize("kind", SCENARIOS)
def test_the_table_has_the_parameters(kind: str) -> None:
    row = next(line for line in PAGE.splitlines() if line.startswith(f"| {kind} |"))
    for p in parameter_box(kind).values():
        unit = f" {p.unit}" if p.unit else ""
        assert f"`{p.name}` {p.default:g} ({p.low:.4g} to {p.high:.4g}{unit})" in row


def test_the_models_are_listed() -> None:
    assert f"Models: {', '.join(MODELS)}." in PAGE
