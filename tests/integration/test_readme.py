"""What the README shows works as it stands there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text()


def block(language: str) -> str:
    found = re.search(rf"```{language}\n(.*?)```", README, re.DOTALL)
    assert found, language
    return found[1]


def test_a_driving_system_of_your_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from ssad.drivers import make_system
    from ssad.scenarios.dynamic import build_episode, load_scenarios
    from ssad.world.roads import load_town
    from ssad.world.rollout import rollout
    from ssad.world.world import World

    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "mine.py").write_text(block("python"))
    town = load_town("ProvingGround")
    found = [load_scenarios(name)[0] for name in ("StraightObstacle/00", "LaneChanging/00")]
    episodes = [build_episode(s, town, seed=1) for s in found]
    traces = rollout(World(episodes, {"ProvingGround": town}), make_system("mine:Mine"))
    assert all(trace.driven[-1] > 20 for trace in traces)
    assert not any(trace.off_road.any() for trace in traces)


def test_a_scenario_of_your_own(tmp_path: Path) -> None:
    from ssad.scenarios.dynamic import build_episode, load_scenarios
    from ssad.world.roads import load_town

    (tmp_path / "mine.yaml").write_text(block("yaml"))
    scenarios = load_scenarios(tmp_path / "mine.yaml")
    assert [s.type for s in scenarios] == ["StraightObstacle", "Custom"]
    for scenario in scenarios:
        episode = build_episode(scenario, load_town("ProvingGround"), seed=0)
        assert len(episode.agents) >= 2


def test_the_two_commands_are_marked_for_scripts() -> None:
    for name in ("quick", "tests"):
        found = re.search(rf"<!-- {name} -->\n```\n(.*?)\n```\n<!-- end -->", README, re.DOTALL)
        assert found
        assert found[1].startswith("python -m pip install -q uv && python -m uv run")
        assert "\n" not in found[1]


def test_every_file_and_command_it_names_exists() -> None:
    from ssad.cli import app

    commands = {c.name or c.callback.__name__ for c in app.registered_commands if c.callback}
    commands |= {group.name for group in app.registered_groups}
    for verb in re.findall(r"^ssad (\w+)|`ssad (\w+)", README, re.MULTILINE):
        assert (verb[0] or verb[1]) in commands
    for path in re.findall(r"`((?:src|suites|docs)/[\w/.]+)`", README):
        assert (ROOT / path).exists(), path
