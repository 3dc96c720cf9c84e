"""Cut-ins: the grids, what counts as a crash, and the published order of the models."""

from __future__ import annotations

import numpy as np
import pytest

from ssad.drivers.careful.cut_in import CHUNK, CutIns, crashes, cut_in_grid, speed_pairs
from ssad.drivers.careful.models import FSM, MODELS, RSS, CarefulHuman, Reg157


def one(speed: float, lead: float, gap: float, approach: float) -> CutIns:
    return CutIns(*(np.array([v], np.float64) for v in (speed, lead, gap, approach)))


def test_the_low_grid_has_the_published_number_of_cases() -> None:
    assert len(cut_in_grid(speed_pairs(range(10, 61, 10)), range(2, 61))) == 15_930


def test_the_published_order_comes_out_at_low_and_at_high_speed() -> None:
    for speeds, gaps in ((range(10, 61, 10), range(2, 61, 4)), (range(70, 131, 20), range(2, 121, 9))):
        cases = cut_in_grid(speed_pairs(speeds), gaps)
        shares = [crashes(m, cases).mean() for m in (CarefulHuman(wait_for_overlap=True), Reg157(), FSM(), RSS())]
        assert shares == sorted(shares, reverse=True)
        assert min(-np.diff(shares)) > 0.001
        # to see a cut-in before it is in the way helps
        assert crashes(CarefulHuman(), cases).mean() < shares[0] - 0.01


@pytest.mark.parametrize("name", MODELS)
def test_nobody_avoids_a_car_that_swerves_in_at_the_bumper_and_all_avoid_a_far_one(name: str) -> None:
    assert crashes(MODELS[name], one(12.0, 5.0, 1.0, 1.7)).all()
    assert not crashes(MODELS[name], one(16.0, 10.0, 40.0, 1.0)).any()
    assert not crashes(MODELS[name], one(16.0, 5.0, 1.0, 0.0)).any()


def test_to_be_hit_from_the_side_counts_and_to_be_past_does_not() -> None:
    # 0.5 m/s across for 3.2 s; the driver is past after (gap + 8.6 m) / 10 m/s
    class Asleep(Reg157):
        def demand(self, e):
            return np.zeros_like(e.speed)

    assert crashes(Asleep(), one(20.0, 10.0, 25.0, 0.5)).all()
    assert not crashes(Asleep(), one(20.0, 10.0, 20.0, 0.5)).any()


def test_cases_do_not_depend_on_each_other() -> None:
    cases = cut_in_grid(speed_pairs(range(20, 61, 20)), range(2, 60, 3))
    order = np.random.default_rng(0).permutation(len(cases))
    mixed = CutIns(cases.speed[order], cases.lead[order], cases.gap[order], cases.approach[order])
    assert (crashes(FSM(), mixed) == crashes(FSM(), cases)[order]).all()
    many = CutIns(*(np.resize(a, CHUNK + 5) for a in (cases.speed, cases.lead, cases.gap, cases.approach)))
    assert (crashes(FSM(), many)[CHUNK:] == np.resize(crashes(FSM(), cases), CHUNK + 5)[CHUNK:]).all()
