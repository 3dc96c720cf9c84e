"""The four careful drivers: constants of their sources, when they see a danger, how they brake."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssad.core.errors import UnknownNameError
from ssad.drivers.careful import MODELS, Encounter, careful_model, react
from ssad.drivers.careful.models import FSM, RSS, CarefulHuman, CarefulModel, Reg157, initial_reaction


def meet(**given: float) -> Encounter:
    """A slower car 20 m ahead in the lane, but for what is given."""
    plain = {
        "speed": 20.0,
        "accel": 0.0,
        "gap": 20.0,
        "lead": 10.0,
        "lateral": -1.9,
        "approach": 0.0,
        "through": np.inf,
        "length": 8.6,
        "moved": 0.0,
    }
    return Encounter(**{name: np.array([value], np.float64) for name, value in (plain | given).items()})


def demand(model: CarefulModel, **given: float) -> float:
    return float(model.demand(meet(**given))[0])


def braking(model: CarefulModel, e: Encounter, steps: int, dt: float = 0.1) -> np.ndarray:
    memory, out = initial_reaction((1,)), []
    for _ in range(steps):
        brake, memory = react(model, e, memory, dt)
        out.append(float(brake[0]))
    return np.array(out)


def test_the_human_brakes_below_two_seconds_to_collision() -> None:
    assert demand(CarefulHuman(), gap=20.1) == 0.0
    assert demand(CarefulHuman(), gap=19.9) == pytest.approx(0.774 * 9.81)


def test_the_human_sees_a_cut_in_from_the_regulations_point_on_or_from_the_overlap_on() -> None:
    aside = {"gap": 15.0, "lateral": 0.4, "approach": 1.0}
    for moved, sees in ((1.09, False), (1.10, True)):
        assert (demand(CarefulHuman(), moved=moved, **aside) > 0) == sees
        assert demand(CarefulHuman(wait_for_overlap=True), moved=moved, **aside) == 0.0
    assert demand(CarefulHuman(wait_for_overlap=True), gap=15.0, lateral=0.0, approach=1.0) > 0


def test_the_human_coasts_then_reaches_its_braking_in_six_tenths_of_a_second() -> None:
    found = braking(CarefulHuman(), meet(gap=15.0), 20)
    assert found[:7] == pytest.approx(np.full(7, 0.4))
    # 0.05 s of the eighth step and 0.55 s more
    full = np.flatnonzero(found > 7.59 - 0.01)
    assert full[0] * 0.1 == pytest.approx(0.75 + 0.6, abs=0.1)
    assert np.diff(found).max() <= 12.66 * 0.1


def test_reg157_brakes_as_late_as_braking_with_six_allows() -> None:
    # 10 m/s closing: 10 / 12 + 0.35 + 0.1 s
    needs = 10.0 * (10.0 / 12.0 + 0.45)
    assert demand(Reg157(), gap=needs + 0.1) == 0.0
    assert demand(Reg157(), gap=needs - 0.1) == 6.0
    assert demand(Reg157(), gap=5.0, lateral=0.51, approach=1.0) == 0.0
    assert demand(Reg157(), gap=5.0, lateral=0.49, approach=1.0) == 6.0
    assert demand(Reg157(), speed=60.0, gap=46.1) == 0.0
    assert demand(Reg157(), speed=60.0, gap=45.9) == 6.0
    assert braking(Reg157(), meet(gap=5.0), 6) == pytest.approx([0, 0, 0, 3.0, 6.0, 6.0])


def test_rss_keeps_its_distance_along_and_across() -> None:
    own = 20 * 0.75 + 0.5 * 3 * 0.75**2 + (20 + 3 * 0.75) ** 2 / 12
    assert demand(RSS(), gap=own - 100 / 12 + 0.1) == 0.0
    assert demand(RSS(), gap=own - 100 / 12 - 0.1) == pytest.approx(0.774 * 9.81)
    rest = 0.5 * 0.75**2 + 0.75**2 / 2
    across = 0.3 + rest + 1.0 * 0.75 + 0.5 * 0.75**2 + 1.75**2 / 2
    assert demand(RSS(), lateral=across + 0.01, approach=1.0) == 0.0
    assert demand(RSS(), lateral=across - 0.01, approach=1.0) > 0.0
    # who comes towards it needs room too
    assert demand(RSS(), gap=60.0, lead=-10.0) > demand(RSS(), gap=60.0, lead=10.0) == 0.0


@pytest.mark.parametrize("name", ["rss", "fsm"])
def test_who_is_too_near_is_a_danger_also_at_the_same_speed(name: str) -> None:
    assert demand(careful_model(name), speed=10.0, lead=10.0, gap=3.0) > 0.0
    assert demand(careful_model(name), speed=10.0, lead=10.0, gap=40.0) == 0.0


def test_rss_reaches_its_braking_in_six_tenths_of_a_second() -> None:
    brake = braking(RSS(), meet(gap=5.0), 20)
    assert brake[:7] == pytest.approx(np.zeros(7))
    assert np.diff(brake).max() <= 12.66 * 0.1
    assert brake[-1] == pytest.approx(0.774 * 9.81)


def test_following_gaps_are_those_of_the_sources() -> None:
    speeds = np.array([0.0, 2.0, 25.0 / 3.6, 50.0 / 3.6, 100.0 / 3.6])
    assert CarefulHuman().following_gap(speeds) == pytest.approx(2.0 * speeds)
    # 1.25 s between the rows of 20 and 30 km/h
    expected = [2.0, 2.0, 1.25 * 25.0 / 3.6, 1.5 * 50.0 / 3.6, 1.6 * 100.0 / 3.6]
    assert Reg157().following_gap(speeds) == pytest.approx(expected)
    for speed in (6.0, 20.0):
        gap = float(RSS().following_gap(np.array(speed)))
        # the leader has braked with 6 m/s^2 for 0.75 s
        after = {"speed": speed, "lead": speed - 4.5}
        assert demand(RSS(), gap=gap - 0.5 * 6.0 * 0.75**2 + 0.01, **after) == 0.0
        assert demand(RSS(), gap=gap - 0.5 * 6.0 * 0.75**2 - 0.01, **after) > 0.0
        gap = float(FSM().following_gap(np.array(speed)))
        assert demand(FSM(), speed=speed, lead=speed, gap=gap + 0.01) == 0.0
        assert demand(FSM(), speed=speed, lead=speed, gap=gap - 0.01) > 0.0


def test_fsm_brakes_a_little_before_it_must() -> None:
    fsm = FSM()
    safe, unsafe = 20 * 0.75 + 400 / 8 - 100 / 14 + 2, 20 * 0.75 + 400 / 12 - 100 / 14
    for gap, share in ((safe + 2.1, 0.0), (unsafe + 2, 1.0), (0.5 * (safe + unsafe) + 2, 0.5)):
        assert float(fsm.proactive(meet(gap=gap))[0]) == pytest.approx(share)
    run = 10 * 0.75
    for gap, share in ((run + 100 / 8 + 0.1, 0.0), (run + 100 / 12, 1.0), (run + 100 * (1 / 8 + 1 / 12) / 2, 0.5)):
        assert float(fsm.critical(meet(gap=gap))[0]) == pytest.approx(share)
    assert demand(fsm, gap=run + 100 / 12) == 6.0
    assert 0.0 < demand(fsm, gap=50.0) < 4.0
    # braking already, it will be slower than the other within its reaction time
    slow = {"speed": 11.0, "accel": -4.0}
    assert float(fsm.critical(meet(gap=0.12, **slow))[0]) == 1.0
    assert float(fsm.critical(meet(gap=0.13, **slow))[0]) == 0.0


def test_fsm_lets_pass_who_comes_only_after_it_has_passed() -> None:
    # it is past in 2.86 s, 0.1 s of which are spare
    assert demand(FSM(), lateral=2.9, approach=1.0) > 0.0
    assert demand(FSM(), lateral=3.0, approach=1.0) == 0.0


@pytest.mark.parametrize("name", MODELS)
def test_nobody_brakes_for_who_is_past_moves_away_or_will_have_crossed(name: str) -> None:
    model = careful_model(name)
    near = {"gap": 4.0, "lead": 0.0, "speed": 10.0}
    assert demand(model, **near) > 0.0
    assert demand(model, **near | {"gap": -8.7}) == 0.0
    assert demand(model, **near, lateral=0.4, approach=-1.0) == 0.0
    assert demand(model, **near, approach=3.0, through=0.8) == 0.0
    assert demand(model, **near, approach=3.0, through=3.0) > 0.0


@pytest.mark.parametrize("name", MODELS)
def test_a_step_takes_others_one_by_one(name: str) -> None:
    model = careful_model(name)
    gaps = np.linspace(1.0, 60.0, 24)
    many = replace(meet(), gap=gaps)
    memory = initial_reaction(gaps.shape)
    for _ in range(12):
        together, memory = react(model, many, memory, 0.1)
    alone = [braking(model, meet(gap=gap), 12)[-1] for gap in gaps]
    assert (together == alone).all()
    assert together[0] > together[-1]


def test_an_unknown_model_is_named() -> None:
    with pytest.raises(UnknownNameError, match="reg157"):
        careful_model("reg156")
