"""Cut-ins: the grids of ec-jrc/JRC-FSM cell by cell, their rules one by one, and cases that need no grid."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.careful_cut_ins import (
    FILE_NAMES,
    GAPS,
    JRC_MODELS,
    JRC_SWEEP,
    PAIRS,
    cell_table,
    grid,
    reference_crashes,
    row,
    stored_crashes,
    sweep,
)
from ssad.core.errors import ConfigError
from ssad.core.types import Bool
from ssad.drivers.careful.cut_in import CHUNK, JRC_RULES, CutIns, SweepRules, crashes, cut_in_grid, speed_pairs
from ssad.drivers.careful.cut_in import react_in_whole_steps as react_whole
from ssad.drivers.careful.models import FSM, JERK, MODELS, RSS, CarefulHuman, Reg157, initial_reaction
from tests.drivers.careful.test_models import meet

PUBLISHED = {
    "low": {"CC": 23.4, "Reg157": 14.1, "FSM": 5.7, "RSS": 5.5},
    "high": {"CC": 25.3, "Reg157": 20.4, "FSM": 11.8, "RSS": 10.6},
}
"""Percent that crash in the published grids."""


def one(speed: float, lead: float, gap: float, approach: float) -> CutIns:
    return CutIns(*(np.array([v], np.float64) for v in (speed, lead, gap, approach)))


@pytest.fixture(scope="module")
def repeated() -> dict[str, dict[str, Bool]]:
    """The published grids by the rules of their script."""
    return {name: sweep(name, JRC_MODELS, JRC_SWEEP) for name in PAIRS}


@pytest.mark.parametrize(("name", "count"), [("low", 15_930), ("high", 14_040)])
def test_a_grid_has_the_published_number_of_cases(name: str, count: int) -> None:
    assert len(grid(name)) == count


@pytest.mark.parametrize("model", JRC_MODELS)
@pytest.mark.parametrize("name", PAIRS)
def test_a_published_grid_is_reproduced_cell_by_cell(
    name: str, model: str, repeated: dict[str, dict[str, Bool]]
) -> None:
    published, crash = stored_crashes(name)[model], repeated[name][model]
    assert 100.0 * published.mean() == pytest.approx(PUBLISHED[name][model], abs=0.06)
    assert 100.0 * crash.mean() == pytest.approx(PUBLISHED[name][model], abs=0.5)
    assert (crash == published).mean() > 0.99


def test_the_end_above_the_critical_ttc_explains_the_share_of_the_human_at_high_speed(
    repeated: dict[str, dict[str, Bool]],
) -> None:
    published, crash = stored_crashes("high")["CC"], repeated["high"]["CC"]
    endless = crashes(JRC_MODELS["CC"], grid("high"), rules=JRC_RULES)
    assert 100.0 * (endless.mean() - published.mean()) > 10.0
    # the end only ever spares a crash
    assert not (crash & ~endless).any()
    assert (crash == published).mean() > 0.99
    assert (endless == published).mean() < 0.9


def test_the_reach_explains_the_share_of_reg157_at_high_speed(repeated: dict[str, dict[str, Bool]]) -> None:
    near = crashes(Reg157(), grid("high"), rules=JRC_RULES)
    assert 100.0 * (near.mean() - repeated["high"]["Reg157"].mean()) > 3.0
    assert (crashes(Reg157(), grid("low"), rules=JRC_RULES) == repeated["low"]["Reg157"]).all()


def test_rss_without_its_jerk_and_without_the_lead_in_is_not_the_published_one(
    repeated: dict[str, dict[str, Bool]],
) -> None:
    sudden = crashes(replace(RSS(drifts=False), jerk=np.inf), grid("low"), rules=JRC_RULES)
    late = crashes(RSS(drifts=False), grid("low"), rules=replace(JRC_RULES, lead_in=np.inf))
    crash = repeated["low"]["RSS"]
    assert 100.0 * (crash.mean() - sudden.mean()) > 1.0
    assert 100.0 * (late.mean() - crash.mean()) > 1.0


def test_the_tables_show_shares_and_cells(repeated: dict[str, dict[str, Bool]]) -> None:
    published = {name: stored_crashes(name) for name in PAIRS}
    cells = row("published", published["low"]).split("|")
    assert [float(cell) for cell in cells[2:6]] == pytest.approx(list(PUBLISHED["low"].values()), abs=0.06)
    assert float(cells[6]) < min(map(float, cells[2:6]))
    assert row("CC alone", {"CC": published["low"]["CC"]}).count("|") == len(cells) - 1
    lines = [line.split("|") for line in cell_table(published, repeated) if line.startswith(("| low |", "| high |"))]
    assert [line[2].strip() for line in lines] == [*JRC_MODELS, *JRC_MODELS]
    for line in lines:
        difference = (int(line[4]) + int(line[5])) / len(grid(line[1].strip()))
        assert float(line[3]) == pytest.approx(100.0 * (1.0 - difference), abs=0.006)


SCRIPT = """
import csv, pathlib
def run_loop(speed_range):
    folder = pathlib.Path("results/cut_in_" + speed_range + "_speed")
    folder.mkdir()
    for file, values in {tables!r}.items():
        with open(folder / file, "w", newline="") as out:
            csv.writer(out).writerows([["lat_vel", "Crash"], *([0.0, value] for value in values)])
"""


def test_a_checkout_of_the_reference_is_run_once_and_read(tmp_path: Path) -> None:
    published = stored_crashes("high")
    size = len(GAPS["high"]) * 18
    contents = {
        f"{stem}_{ego}_{lead}.csv": published[model][size * k : size * (k + 1)].tolist()
        for model, stem in FILE_NAMES.items()
        for k, (ego, lead) in enumerate(PAIRS["high"])
    }
    with pytest.raises(ConfigError, match="no checkout"):
        reference_crashes(tmp_path, "high")
    (tmp_path / "utility").mkdir()
    script = tmp_path / "utility" / "comparison_cut_in.py"
    script.write_text("import a_package_that_is_missing", encoding="utf-8")
    with pytest.raises(ConfigError, match="a_package_that_is_missing"):
        reference_crashes(tmp_path, "high")
    script.write_text(SCRIPT.format(tables=contents), encoding="utf-8")
    first = reference_crashes(tmp_path, "high")
    script.write_text("raise RuntimeError", encoding="utf-8")
    second = reference_crashes(tmp_path, "high")
    for model, mask in published.items():
        assert (first[model] == mask).all()
        assert (second[model] == mask).all()


def test_to_see_a_cut_in_before_it_is_in_the_way_helps() -> None:
    cases = cut_in_grid(speed_pairs(range(10, 61, 10)), range(2, 61, 4))
    late = CarefulHuman(wait_for_overlap=True)
    assert crashes(CarefulHuman(), cases).mean() < crashes(late, cases).mean() - 0.01


class Asleep(Reg157):
    def demand(self, e):
        return np.zeros_like(e.speed)


def test_a_lead_in_ends_at_the_gap_and_the_distance_of_the_sweep() -> None:
    cases = cut_in_grid(speed_pairs(range(20, 61, 20)), range(1, 60, 4))
    for step_rule in (False, True):
        rules = SweepRules(whole_steps=step_rule)
        # who never brakes meets the same car a little later
        slow = crashes(Asleep(), cases, rules=replace(rules, lead_in=1.5))
        assert slow.any()
        assert (slow == crashes(Asleep(), cases, rules=rules)).all()


def test_in_whole_steps_a_delay_counts_steps_in_danger_and_is_not_begun_again() -> None:
    memory, braking = initial_reaction((1,)), []
    near, far = meet(gap=5.0), meet(gap=80.0)
    for encounter in (near, near, far, near, near, near, far, near):
        brake, memory = react_whole(Reg157(), encounter, memory, 0.1)
        braking.append(float(brake[0]))
    assert braking == [0.0, 0.0, 0.0, 0.0, 0.0, 6.0, 0.0, 6.0]
    memory, braking = initial_reaction((1,)), []
    for _ in range(11):
        brake, memory = react_whole(RSS(), near, memory, 0.1)
        braking.append(float(brake[0]))
    assert braking == pytest.approx([*[0.0] * 8, 0.1 * JERK, 0.2 * JERK, 0.3 * JERK])


@pytest.mark.parametrize("name", MODELS)
def test_nobody_avoids_a_car_that_swerves_in_at_the_bumper_and_all_avoid_a_far_one(name: str) -> None:
    assert crashes(MODELS[name], one(12.0, 5.0, 1.0, 1.7)).all()
    assert not crashes(MODELS[name], one(16.0, 10.0, 40.0, 1.0)).any()
    assert not crashes(MODELS[name], one(16.0, 5.0, 1.0, 0.0)).any()


def test_to_be_hit_from_the_side_counts_and_to_be_past_does_not() -> None:
    # 0.5 m/s across for 3.2 s; the driver is past after (gap + 8.6 m) / 10 m/s
    assert crashes(Asleep(), one(20.0, 10.0, 25.0, 0.5)).all()
    assert not crashes(Asleep(), one(20.0, 10.0, 20.0, 0.5)).any()


def test_cases_do_not_depend_on_each_other() -> None:
    cases = cut_in_grid(speed_pairs(range(20, 61, 20)), range(2, 60, 3))
    order = np.random.default_rng(0).permutation(len(cases))
    mixed = CutIns(cases.speed[order], cases.lead[order], cases.gap[order], cases.approach[order])
    assert (crashes(FSM(), mixed) == crashes(FSM(), cases)[order]).all()
    many = CutIns(*(np.resize(a, CHUNK + 5) for a in (cases.speed, cases.lead, cases.gap, cases.approach)))
    assert (crashes(FSM(), many)[CHUNK:] == np.resize(crashes(FSM(), cases), CHUNK + 5)[CHUNK:]).all()
