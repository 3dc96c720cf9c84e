"""Learned policies: their controls, their files, and that a row's bits do not depend on the others."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
import torch

from ssad.core.checkpoints import WeightsCard, save_weights
from ssad.core.errors import FormatError
from ssad.world.actions import WIDTHS, to_controls
from ssad.world.policy import load_policy, policy_of, tensors_of
from ssad.world.sensors import SENSORS
from ssad.world.world import World
from tests.world.test_world import bank
from tests.world.worlds import GRAPHS


def net(*widths: int, seed: int = 0) -> torch.nn.Sequential:
    torch.manual_seed(seed)
    layers = [torch.nn.Linear(a, b) for a, b in itertools.pairwise(widths)]
    return torch.nn.Sequential(*[part for layer in layers for part in (layer, torch.nn.ReLU())][:-1])


def card(**config: str) -> WeightsCard:
    return WeightsCard("", "", 0, (), config={"observation": "frea", "action": "pedals", "squash": "tanh"} | config)


def tensors(body: torch.nn.Sequential) -> dict[str, torch.Tensor]:
    return tensors_of([part for part in body if isinstance(part, torch.nn.Linear)])


@pytest.mark.parametrize(
    ("kind", "given", "expected"),
    [
        ("safebench", [[1.0, 1.0], [-1.0, -1.0], [0.5, 0.0]], [[1, 0, 0.3, 0], [0, 0.375, -0.3, 0], [0.5, 0, 0, 0]]),
        ("pedals", [[1.0, 2.0], [-3.0, -1.0], [-0.5, 0.0]], [[1, 0, 0.3, 0], [0, 1, -0.3, 0], [0, 0.5, 0, 0]]),
        ("adversary", [[1.0, 1.0], [-0.5, 0.0]], [[1, 0, 0.3, 0], [0.5, 0, 0, 1]]),
        ("frea", [[1.0, 1.0, -1.0], [0.0, 0.0, 0.5], [-1.0, 0.0, -0.95]], [[1, 0, 0.3, 0], [0.5, 0.75, 0, 0], [0] * 4]),
    ],
)
def test_actions_become_controls(kind: str, given: list, expected: list) -> None:
    np.testing.assert_allclose(to_controls(kind, np.array(given, np.float32)), expected, atol=1e-6)


@pytest.mark.parametrize("squash", ["tanh", "clip"])
def test_a_policy_is_its_network(squash: str) -> None:
    body = net(24, 16, 8, 2)
    rows = np.random.default_rng(0).normal(0, 5, (32, 24)).astype(np.float32)
    with torch.no_grad():
        raw = body(torch.from_numpy(rows))
    expected = raw.tanh() if squash == "tanh" else raw.clamp(-1, 1)
    policy = policy_of(card(squash=squash), tensors(body), "here")
    np.testing.assert_allclose(policy.actions(rows), expected.numpy(), atol=1e-5)
    assert np.abs(policy.actions(rows)).max() <= 1.0


def test_the_bits_of_a_row_do_not_depend_on_the_others() -> None:
    policy = policy_of(card(), tensors(net(24, 64, 64, 2)), "here")
    rows = np.random.default_rng(1).normal(0, 5, (65, 24)).astype(np.float32)
    whole = policy.actions(rows)
    for size in (1, 3, 16, 64):
        parts = [policy.actions(rows[k : k + size]) for k in range(0, 65, size)]
        assert np.concatenate(parts).tobytes() == whole.tobytes()
    assert policy.actions(rows[::-1])[::-1].tobytes() == whole.tobytes()


def test_a_file_comes_back(tmp_path: Path) -> None:
    body = net(4, 8, 3)
    about = card(observation="safebench", action="frea", squash="clip")
    save_weights(tmp_path / "own.safetensors", tensors(body), card=about)
    policy = load_policy(tmp_path / "own.safetensors")
    assert (policy.observation, policy.action, policy.squash) == ("safebench", "frea", "clip")
    rows = np.ones((2, 4), np.float32)
    assert policy.actions(rows).tobytes() == policy_of(about, tensors(body), "").actions(rows).tobytes()


@pytest.mark.parametrize(
    ("widths", "config", "message"),
    [
        ((5, 8, 2), {}, r"own: layer 0 has the shape \[8, 5\], but the observation 'frea' has 24 numbers"),
        ((24, 8, 3), {}, "own: the last layer gives 3 numbers, the action 'pedals' has 2"),
        ((24, 8, 2), {"observation": "sonar"}, r"names its observation \(safebench, frea, traffic, .*\), not 'sonar'"),
        ((24, 8, 2), {"squash": ""}, "names its squash"),
    ],
)
def test_a_policy_that_does_not_fit_is_named_in_one_line(widths: tuple, config: dict, message: str) -> None:
    with pytest.raises(FormatError, match=message) as found:
        policy_of(card(**config), tensors(net(*widths)), "own")
    assert "\n" not in str(found.value)


def test_weights_of_something_else_are_refused() -> None:
    with pytest.raises(FormatError, match="not the weights of a policy"):
        policy_of(card(), {"backbone.weight": torch.zeros(2, 24), "0.bias": torch.zeros(2)}, "own")


def test_widths_are_those_of_the_sensors() -> None:
    world = World(bank(), GRAPHS)
    who = np.array([[0, 0], [1, 0]], np.int32)
    assert {name: SENSORS[name](world, who).shape[1] for name in WIDTHS} == dict(WIDTHS)
