"""Reference of `realism` and library of `cat`: made from drives, and readable by what uses them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.traffic_reference import make
from ssad.core.errors import ConfigError
from ssad.core.types import TrafficPlan
from ssad.metrics.realism import REFERENCE, traffic_reference
from ssad.scenarios.dynamic import load_scenarios, save_scenarios
from ssad.scenarios.dynamic.transition.cat import MOTIONS, traffic_motions


def test_both_files_are_made_from_the_motor_vehicles_of_a_set(tmp_path: Path) -> None:
    scenarios = load_scenarios("natural-unselected")[40:42]
    save_scenarios(tmp_path / "some.yaml", scenarios)
    lines = make(str(tmp_path / "some.yaml"), tmp_path)
    reference, (motions, speeds) = (
        traffic_reference(tmp_path / REFERENCE.name),
        traffic_motions(tmp_path / MOTIONS.name),
    )
    assert f"{len(reference['collision'])} motions in 2 episodes" in lines[0]
    assert 4 <= len(reference["collision"]) <= 40
    assert len(motions) == len(speeds) > 10
    assert np.abs(motions[:, 0]).max() == 0.0
    assert 2.0 < speeds.max() < 15.0
    walkers = TrafficPlan(intensity=0.0, minimum=0, maximum=0, walkers=4)
    save_scenarios(tmp_path / "walkers.yaml", [replace(scenarios[0], traffic=walkers)])
    with pytest.raises(ConfigError, match="no vehicle moves in these scenarios"):
        make(str(tmp_path / "walkers.yaml"), tmp_path)
