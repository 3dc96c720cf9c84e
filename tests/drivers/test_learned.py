"""Learned driving systems: the shipped weights drive, other weights can be named, and what is wrong is said."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from ssad.core.checkpoints import WeightsCard, load_card, save_weights
from ssad.core.errors import FormatError
from ssad.core.traces import trace_hash
from ssad.drivers import LEARNED, SYSTEMS, make_system
from ssad.drivers.learned.policies import SHIPPED
from ssad.metrics import episode_metrics
from ssad.scenarios.dynamic import build_episode, load_scenarios
from ssad.simulators.closed_loop import system_version
from ssad.world.check import check_driver
from ssad.world.roads import load_town
from ssad.world.rollout import rollout
from ssad.world.world import World

TOWNS = cache(load_town)
NAMES = [name for name in LEARNED if name in SYSTEMS]


def world_of(*names: str) -> World:
    scenarios = [s for name in names for s in load_scenarios(name)]
    graphs = {s.town: TOWNS(s.town) for s in scenarios}
    return World([build_episode(s, graphs[s.town], seed=0) for s in scenarios], graphs)


FEW = [s.name for s in load_scenarios("natural")[::19]]


def test_all_are_shipped_and_small() -> None:
    assert {path.stem for path in SHIPPED.iterdir()} == set(NAMES)
    assert sum(path.stat().st_size for path in SHIPPED.iterdir()) < 1 << 20


@pytest.mark.parametrize("name", NAMES)
def test_shipped_weights_drive(name: str) -> None:
    card, _ = load_card(SHIPPED / f"{name}.safetensors")
    assert card.command.startswith(f"ssad train driver {name}")
    traces = rollout(world_of(*FEW), make_system(name))
    found = [episode_metrics(trace) for trace in traces]
    assert np.mean([row.route_completion for row in found]) > 0.6
    assert np.median([row.driven / row.time for row in found]) > 2.0  # nobody stands still
    # td3 leaves the road where that is shorter (docs/results/drivers.md)
    assert np.mean([row.off_road_fraction for row in found]) < (0.6 if name == "td3" else 0.1)


@pytest.mark.slow
def test_ppo_completes_natural_routes_and_all_beat_the_blind_follower() -> None:
    natural = [episode_metrics(trace) for trace in rollout(world_of("natural"), make_system("ppo"))]
    assert np.mean([row.route_completion for row in natural]) >= 0.8
    rates = {}
    for name in (*NAMES, "blind"):
        traces = rollout(world_of("precrash"), make_system(name))
        rates[name] = np.mean([episode_metrics(trace).collision for trace in traces])
    assert all(rates[name] < rates["blind"] - 0.2 for name in NAMES), rates


def test_they_keep_the_promises_of_a_driver() -> None:
    check_driver(lambda: make_system("ppo"), lambda order: world_of(*(FEW[k] for k in order)), episodes=4)


def test_the_batch_changes_no_bit() -> None:
    whole = [trace_hash(trace) for trace in rollout(world_of(*FEW[:3]), make_system("ppo"))]
    alone = [trace_hash(rollout(world_of(name), make_system("ppo"))[0]) for name in FEW[:3]]
    assert whole == alone


def test_other_weights_are_named_with_the_system(tmp_path: Path) -> None:
    card, state = load_card(SHIPPED / "ppo.safetensors")
    path = tmp_path / "own.safetensors"
    save_weights(path, {name: 0.5 * value for name, value in state.items()}, card=card)
    own, shipped = f"ppo:{path}", "ppo"
    assert make_system(own).name == own
    rows = np.ones((1, 69), np.float32)
    assert make_system(own).act.__self__.policy.actions(rows) != pytest.approx(
        make_system(shipped).act.__self__.policy.actions(rows)
    )
    # a cell's key depends on the weights
    assert system_version(own) != system_version(shipped)
    assert system_version(own).split()[0] == system_version(shipped).split()[0]
    save_weights(path, state, card=card)
    assert system_version(own) == system_version(shipped)


def test_weights_that_cannot_be_used_are_named_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="no such file"):
        make_system(f"sac:{tmp_path / 'none.safetensors'}")
    about = WeightsCard("", "", 0, (), config={"observation": "frea", "action": "pedals", "squash": "clip"})
    save_weights(tmp_path / "five.safetensors", {"0.weight": torch.ones(2, 5), "0.bias": torch.ones(2)}, card=about)
    with pytest.raises(FormatError, match=r"\[2, 5\], but the observation 'frea' has 24 numbers") as found:
        make_system(f"td3:{tmp_path / 'five.safetensors'}")
    assert "\n" not in str(found.value)
