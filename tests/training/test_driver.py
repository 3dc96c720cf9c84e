"""`ssad train driver` and `ssad train adversary`: weights with a card, going on after a stop, and divergence."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers.command import ssad

from ssad.core.checkpoints import load_card
from ssad.core.errors import ConfigError, FormatError, UnknownNameError
from ssad.drivers.learned.policies import PPO
from ssad.training.adversary import AdversaryPlan, run_adversary_training
from ssad.training.driver import DriverPlan, draw_episodes, find_scenarios, run_driver_training
from ssad.training.reinforcement import POLICY_RECIPES, find_policy_recipe, make_model, read_log, train_policy
from ssad.world.actions import CHOICES
from ssad.world.policy import load_policy

pytest.importorskip("stable_baselines3", reason="needs the extra train")
SMALL = (("steps", 512), ("scenes", 4), ("rollout", 32), ("batch", 64), ("epochs", 2), ("validate", 128), ("draws", 2))
SMALL = (*SMALL, ("hidden", (16,)))
ONE = ("training/Larkhill/StraightObstacle/00",)


def plan(out: Path, algorithm: str = "ppo", *, seconds: float | None = None, **changes: object) -> DriverPlan:
    settings = dict(SMALL) | changes
    return DriverPlan(algorithm, out, ONE, ("StraightObstacle/00",), tuple(settings.items()), seconds=seconds)


def test_a_training_writes_weights_that_drive(tmp_path: Path) -> None:
    said: list[str] = []
    (line,) = run_driver_training(plan(tmp_path), report=said.append)
    assert line.startswith(f"{tmp_path / 'ppo.safetensors'}: best at step")
    card, _ = load_card(tmp_path / "ppo.safetensors")
    assert (card.seed, card.config["algorithm"], card.config["observation"]) == (0, "ppo", "traffic")
    assert card.command.startswith("ssad train driver ppo --scenarios training/Larkhill/StraightObstacle/00 --test ")
    assert "Larkhill" in card.data
    assert set(card.metrics) == {"00_CR", "00_RC", "00_OF"}
    rows = read_log(tmp_path)
    assert [row["step"] for row in rows] == [128, 256, 384, 512]
    assert all(0.0 <= row["CR"] <= 1.0 and math.isfinite(row["score"]) for row in rows)
    assert (tmp_path / "curves.png").stat().st_size > 5000
    driver = PPO(tmp_path / "ppo.safetensors")
    assert (driver.sensors, driver.version) == (("traffic",), card.hash)
    assert driver.policy.actions(np.zeros((3, 69), np.float32)).shape == (3, 2)
    # all of it is done: nothing is trained again
    again = list(run_driver_training(plan(tmp_path), report=said.append))
    assert again == [line]
    assert read_log(tmp_path) == rows


def test_a_stopped_training_goes_on(tmp_path: Path) -> None:
    said: list[str] = []
    list(run_driver_training(plan(tmp_path, seconds=0.0), report=said.append))
    assert any("run it again to go on" in line for line in said)
    done = read_log(tmp_path)[-1]["step"]
    assert 0 < done < 512
    kept = torch.load(tmp_path / "last.pt", weights_only=True)["policy"]
    list(run_driver_training(plan(tmp_path), report=said.append))
    assert 512 <= read_log(tmp_path)[-1]["step"] < 768  # whole rollouts
    assert read_log(tmp_path)[0]["step"] == done
    changed = torch.load(tmp_path / "last.pt", weights_only=True)["policy"]
    assert any(not torch.equal(kept[name], changed[name]) for name in kept)
    with pytest.raises(FormatError, match="another recipe"):
        list(run_driver_training(plan(tmp_path, lr=1e-5), report=said.append))


def test_a_training_begins_with_the_networks_of_another(tmp_path: Path) -> None:
    list(run_driver_training(plan(tmp_path / "first"), report=lambda line: None))
    still = {"steps": 128, "lr": 1e-12, "seed": 1}
    further = replace(plan(tmp_path / "further", **still), start=tmp_path / "first")
    list(run_driver_training(further, report=lambda line: None))
    old, new = (torch.load(tmp_path / name / "last.pt", weights_only=True)["policy"] for name in ("first", "further"))
    assert all(torch.allclose(old[name], new[name], atol=1e-6) for name in old)
    assert "--start" in load_card(tmp_path / "further" / "ppo.safetensors")[0].command
    with pytest.raises(FormatError, match="another recipe or other scenarios"):
        list(run_driver_training(replace(further, start=None), report=lambda line: None))
    with pytest.raises(FormatError, match="not those of this training"):
        list(run_driver_training(replace(further, out=tmp_path / "b", changes=(*further.changes, ("hidden", (8,))))))
    with pytest.raises(ConfigError, match="start from the folder of a training"):
        list(run_driver_training(replace(further, out=tmp_path / "c", start=tmp_path / "nothing")))


def test_what_is_learned_is_what_is_exported(tmp_path: Path) -> None:
    """The exported policy acts as the model of stable-baselines3 does without its noise."""
    more = {
        "ddpg": replace(POLICY_RECIPES["td3"], algorithm="ddpg"),
        "dqn": replace(POLICY_RECIPES["sac"], algorithm="dqn"),
    }
    for algorithm in ("ppo", "sac", "td3", "ddpg", "dqn"):
        learning = find_policy_recipe(POLICY_RECIPES | more, algorithm, dict(SMALL))
        from ssad.training.reinforcement import current_policy

        model = make_model(learning, environment(learning))
        rows = np.random.default_rng(0).normal(0, 1, (8, 69)).astype(np.float32)
        expected, _ = model.predict(rows, deterministic=True)
        expected = CHOICES[expected] if algorithm == "dqn" else expected
        np.testing.assert_allclose(current_policy(model, learning).actions(rows), expected, atol=1e-5)


def test_a_training_that_chooses_needs_an_action_of_two_numbers() -> None:
    learning = replace(find_policy_recipe(POLICY_RECIPES, "sac", dict(SMALL)), algorithm="dqn", action="frea")
    with pytest.raises(ConfigError, match="between actions of two numbers"):
        make_model(learning, environment(learning))


def environment(learning):
    from ssad.world.env import VectorEnv
    from ssad.world.sb3 import SB3VecEnv

    scenarios, graphs = find_scenarios(ONE)
    episodes = draw_episodes(scenarios, graphs, draws=1, seed=0)
    return SB3VecEnv(VectorEnv(episodes, graphs, learning.scenes, observation="traffic", action="pedals"))


def test_a_diverging_training_keeps_the_last_good_checkpoint(tmp_path: Path) -> None:
    learning = replace(find_policy_recipe(POLICY_RECIPES, "ppo", dict(SMALL)), validate=128)
    model = make_model(learning, environment(learning))

    def poison(policy) -> dict[str, float]:
        if model.num_timesteps >= 256:
            with torch.no_grad():
                model.policy.action_net.bias.fill_(float("nan"))
        return {"score": 0.0}

    with pytest.raises(ConfigError, match="diverged before step") as found:
        train_policy(model, learning, tmp_path, validate=poison, report=lambda line: None)
    assert "\n" not in str(found.value)
    assert f"{tmp_path / 'last.pt'} is of step" in str(found.value)
    kept = torch.load(tmp_path / "last.pt", weights_only=True)
    assert kept["steps"] in (128, 256)
    assert all(bool(value.isfinite().all()) for value in kept["best"].values())


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["sac", "td3"])
def test_off_policy_trainings_go_on_with_what_they_remember(
    tmp_path: Path, algorithm: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    changes = {"first": 64, "buffer": 1000, "updates": 1}
    with monkeypatch.context() as patch:  # a clock that goes on by a second at each look: the limit comes in mid-way
        patch.setattr("ssad.training.reinforcement.time", SimpleNamespace(monotonic=itertools.count().__next__))
        list(run_driver_training(plan(tmp_path, algorithm, seconds=60.0, **changes), report=lambda line: None))
    before = torch.load(tmp_path / "last.pt", weights_only=True)
    list(run_driver_training(plan(tmp_path, algorithm, **changes), report=lambda line: None))
    after = torch.load(tmp_path / "last.pt", weights_only=True)
    rows = len(before["memory"]["rewards"])
    assert rows > 10
    assert before["steps"] < 512
    assert torch.equal(after["memory"]["rewards"][:rows], before["memory"]["rewards"])
    assert 512 <= after["steps"] < 768
    assert load_policy(tmp_path / f"{algorithm}.safetensors").squash == "tanh"


def test_an_adversary_is_trained_against_an_ego(tmp_path: Path) -> None:
    changes = (("steps", 256), *[one for one in SMALL if one[0] != "steps"])
    one = ("training/natural/Larkhill_00/00",)
    (line,) = run_adversary_training(
        AdversaryPlan("adv-ppo", tmp_path, "autopilot", one, one, changes=changes), report=lambda text: None
    )
    assert "adv-ppo.safetensors: best at step" in line
    card, _ = load_card(tmp_path / "adv-ppo.safetensors")
    assert (card.config["ego"], card.config["observation"], card.config["action"]) == (
        "autopilot",
        "adversary-on-road",
        "pedals",
    )
    assert set(card.metrics) == {"00_proven", "00_CR", "00_valid", "00_off", "00_others"}


def test_an_adversary_needs_traffic(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no scenario has background traffic"):
        list(run_adversary_training(AdversaryPlan("adv-ppo", tmp_path, scenarios=("RightTurn",))))


def test_wrong_settings_are_named(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="ppo"):
        list(run_driver_training(replace(plan(tmp_path), algorithm="pp0")))
    with pytest.raises(ConfigError, match="no setting 'speed'"):
        list(run_driver_training(plan(tmp_path, speed=3)))
    with pytest.raises(ConfigError, match="steps=0"):
        list(run_driver_training(plan(tmp_path, steps=0)))
    with pytest.raises(ConfigError, match="unknown reward 'fun'"):
        list(run_driver_training(plan(tmp_path, reward="fun")))
    (tmp_path / "last.pt").write_bytes(b"nonsense")
    with pytest.raises(FormatError, match="not a checkpoint of a training"):
        list(run_driver_training(plan(tmp_path)))


def test_the_command_says_what_is_wrong(tmp_path: Path) -> None:
    done = ssad("train", "driver", "ppo", "--out", str(tmp_path), "--set", "scenes=0")
    assert done.returncode == 2
    assert "scenes=0" in done.stderr
