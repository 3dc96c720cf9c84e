"""`benchmarks.robust_training`: both arms differ in the attacks alone, and what differs otherwise is refused."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from benchmarks.robust_training import CONTROL, ROBUST, arms, check_fairness, main, page_text
from ssad.core.checkpoints import WeightsCard, read_card
from ssad.core.errors import ConfigError
from ssad.detectors import SHIPPED
from ssad.experiments.perception.digital.run import DigitalRun, Setting
from ssad.report.load import Run

CONFIG = {"epochs_done": 3, "batch": 8, "lr": 6e-4, "first_weights": {"file": "w.safetensors", "hash": "ab" * 32}}


def card(**changes: Any) -> WeightsCard:
    """Card of an arm; changes of its configuration."""
    return WeightsCard("ssad record drives", "ssad train detector", 0, ("car",), config=CONFIG | changes)


def test_the_arms_are_one_training_with_attacks_and_without(tmp_path: Path) -> None:
    given = ["epochs=3", "radius=2", "attack_steps=1"]
    where = "fcos3d-light", Path("drives"), Path("w.safetensors"), tmp_path
    control, robust = arms(*where, settings=given, device="cpu")
    assert dict(control.changes) == {"epochs": 3}
    assert dict(robust.changes) == {"epochs": 3, "radius": 2, "attack_steps": 1}
    assert replace(robust, changes=control.changes, out=control.out) == control
    assert {plan.out.name for plan in (control, robust)} == {CONTROL, ROBUST}
    with pytest.raises(ConfigError, match="--set radius=2"):
        arms(*where, settings=["epochs=3"], device="cpu")


def test_what_the_arms_have_in_common_is_said() -> None:
    shared = check_fairness(card(radius=0.0, attack_steps=1), card(radius=2.0, attack_steps=1))
    assert shared == {**CONFIG, "radius": 2.0}


@pytest.mark.parametrize(
    ("control", "robust", "message"),
    [
        (card(), card(radius=2.0, epochs_done=4), "differ in epochs_done;"),
        (card(), card(radius=2.0, first_weights={"file": "older.safetensors"}), "differ in first_weights;"),
        (card(), replace(card(radius=2.0), data="other drives"), "differ in data;"),
        (card(), replace(card(radius=2.0), seed=1), "differ in seed;"),
        (card(radius=1.0), card(radius=2.0), "without attacks"),
        (card(), card(), "without attacks"),
    ],
)
def test_an_unfair_comparison_is_refused(control: WeightsCard, robust: WeightsCard, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        check_fairness(control, robust)


def test_robust_weights_stand_beside_the_control_rather_than_the_shipped_ones(tmp_path: Path) -> None:
    names = ["fcos3d-light", "fcos3d-light@control=c.safetensors", "pgd-det-light"]
    suite = {"name": "t", "detectors": names, "hardened": ["fcos3d-light@robust=r.safetensors", "yolov5n"]}
    run = DigitalRun(Run(tmp_path, {"suite": suite}, (), {}, 0), {})
    assert run.hardened == [("robust", "control"), ("yolov5n", "")]


def test_the_page_says_the_start_and_sets_robust_weights_beside_the_control() -> None:
    suite = {"name": "t", "detectors": ["fcos3d-light@control=c.safetensors"], "hardened": ["fcos3d-light@robust=r"]}
    settings = Setting(), Setting("pgd", "margin", "linf", 5.0, 10)
    scores = {("control", 0): 0.40, ("control", 1): 0.02, ("robust", 0): 0.37, ("robust", 1): 0.15}
    records = {
        (name, settings[number]): {"status": "ok", "metrics": {"mAP": score}, "n": 8, "scenes": 2, "steps": 10}
        for (name, number), score in scores.items()
    }
    run = DigitalRun(Run(Path(), {"suite": suite, "command": "ssad run digital"}, (), {}, 0), records)
    text = page_text(card(), card(radius=2.0), run)
    assert "`w.safetensors` (abababababab) for 3 epochs" in text
    rows = [line for line in text.splitlines() if line.startswith("| robust")]
    assert [line.split("|")[-4:-1] for line in rows] == [
        [" 40.00 ", " 37.00 ", " -3.00 "],
        [" 2.00 ", " 15.00 ", " 13.00 "],
    ]


def test_a_suite_that_cannot_run_fails_before_the_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options = ["--data", str(tmp_path), "--weights", "w.safetensors", "--set", "radius=2", "--suite", "recorded=null"]
    monkeypatch.setattr(sys, "argv", ["robust_training", "--out", str(tmp_path), *options])
    with pytest.raises(ConfigError, match="recorded"):
        main()
    assert not list(tmp_path.iterdir())


@pytest.mark.slow  # two trainings and attacks on both
def test_both_arms_are_trained_attacked_and_compared(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    small = ["epochs=1", "batch=2", "validate=1", "radius=2"]
    suite = [f"data={recorded}", "attacks=[fgsm]", "sweeps=[]", "steps=1", "replicates=0"]
    options = ["--data", str(recorded), "--weights", str(SHIPPED / "fcos3d-light.safetensors"), "--device", "cpu"]
    options += [part for value in small for part in ("--set", value)]
    options += [part for value in suite for part in ("--suite", value)]
    monkeypatch.setattr(sys, "argv", ["robust_training", "--out", str(tmp_path), *options])
    main()
    printed = capsys.readouterr().out
    cards = [read_card(tmp_path / arm / "fcos3d-light.safetensors") for arm in (CONTROL, ROBUST)]
    assert check_fairness(*cards)["radius"] == 2
    assert cards[0].hash != cards[1].hash
    assert "| robust | clean |" in printed
