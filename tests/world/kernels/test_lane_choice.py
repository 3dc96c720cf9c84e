"""Lane changes of drivers of the population: by advantage, politeness and their own gaps, indicated in time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssad.core.types import DriverStyle, EpisodeAgent, Phase, PhaseTrigger
from ssad.world.world import World
from tests.world.kernels.test_overtake import LONG, autopilot, drive, steady, two_lanes
from tests.world.worlds import ego, episode

CALM = DriverStyle(time_gap=1.5, standstill_gap=2.0, acceleration=1.5, deceleration=1.8, jerk=2.5, change_duration=5.0)
ROAD = {"Straight": two_lanes()}


def driver(style: DriverStyle = CALM, *, speed: float = 12.0) -> EpisodeAgent:
    return replace(autopilot(20.0, to=390.0), driver=style, target_speed=speed)


def pass_slow(style: DriverStyle = CALM, *others: EpisodeAgent, seconds: float = 30.0) -> dict[str, np.ndarray]:
    """A driver that comes up to somebody at 7 m/s, on a road with a free lane on the left."""
    return drive(episode(driver(style), steady("slow", 60.0, 0.0, 7.0), *others, limits=LONG), ROAD, seconds)


def begin_of_signal(drive_result: dict[str, np.ndarray]) -> int:
    """Step at which the driver first indicates left."""
    return int(np.argmax(drive_result["signal"][:, 0] == 1))


def moving_aside(drive_result: dict[str, np.ndarray], share: float = 0.1) -> list[np.ndarray]:
    """Steps of each change in which the driver is between both lanes: more than a share of the 3.5 m from either."""
    y = drive_result["pose"][:, 0, 1]
    steps = np.flatnonzero((y > 3.5 * share) & (y < 3.5 * (1.0 - share)))
    return np.split(steps, np.flatnonzero(np.diff(steps) > 1) + 1)


@pytest.fixture(scope="module")
def passing() -> dict[str, np.ndarray]:
    return pass_slow()


def test_a_slower_vehicle_is_passed_and_the_driver_returns(passing: dict[str, np.ndarray]) -> None:
    x, y = passing["pose"][:, 0, 0], passing["pose"][:, 0, 1]
    assert y.max() > 3.3
    assert abs(y[-1]) < 0.2
    assert x[-1] > passing["pose"][-1, 1, 0] + 10.0


def test_a_driver_indicates_for_three_seconds_before_it_moves_and_until_it_has_moved(
    passing: dict[str, np.ndarray],
) -> None:
    signal = passing["signal"][:, 0]
    changes = moving_aside(passing)
    assert len(changes) == 2
    for change, side in zip(changes, (1, -1), strict=True):
        assert (signal[change[0] - 30 : change[-1] + 1] == side).all()
        assert not signal[change[-1] + 25]


@pytest.mark.parametrize("duration", [3.5, 7.0])
def test_a_change_takes_the_time_that_its_driver_takes(duration: float) -> None:
    result = pass_slow(replace(CALM, change_duration=duration), seconds=18.0)
    share = np.linspace(0.0, 1.0, 1001)
    aside = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    between = float(np.ptp(share[(aside > 0.1) & (aside < 0.9)]))  # of the time of a quintic
    assert 0.1 * len(moving_aside(result)[0]) == pytest.approx(between * duration, rel=0.15)


def test_hardly_slower_is_no_reason_to_pass() -> None:
    result = drive(episode(driver(speed=12.0), steady("other", 50.0, 0.0, 11.5), limits=LONG), ROAD, 20.0)
    assert np.abs(result["pose"][:, 0, 1]).max() < 0.2
    assert not result["signal"].any()


def test_the_polite_let_those_behind_go_first() -> None:
    """A car on the left would have to brake a little for who changes: only the selfish do it."""
    other = steady("other", -1.0, 3.5, 11.0)
    near = replace(CALM, time_gap=0.9)
    selfish = pass_slow(replace(near, politeness=0.0), other, seconds=17.0)
    polite = pass_slow(replace(near, politeness=3.0), other, seconds=17.0)
    ahead = [float(np.subtract(*result["pose"][begin_of_signal(result), [0, 2], 0])) for result in (selfish, polite)]
    assert begin_of_signal(selfish) < begin_of_signal(polite)
    assert ahead[0] > 0.0 > ahead[1]


def test_who_keeps_small_gaps_accepts_small_gaps() -> None:
    other = steady("other", 1.0, 3.5, 10.5)
    begins = [
        begin_of_signal(pass_slow(replace(CALM, politeness=0.0, time_gap=gap), other, seconds=17.0))
        for gap in (0.9, 2.4)
    ]
    assert 0 < begins[0] < begins[1] - 10


def test_a_change_is_given_up_if_the_gap_closes_while_the_driver_indicates() -> None:
    start = begin_of_signal(pass_slow(seconds=8.0))
    fast = steady("fast", -20.0, 3.5, 8.0)
    late = PhaseTrigger("time", value=0.1 * start + 0.5)
    fast = replace(fast, phases=(*fast.phases, replace(Phase(30.0, late), shape="step")))
    result = pass_slow(CALM, fast, seconds=16.0)
    signal, y = result["signal"][:, 0], result["pose"][:, 0, 1]
    assert signal[start] == 1
    given_up = start + int(np.argmax(signal[start:] == 0))
    assert 0 < given_up - start < 30
    assert np.abs(y[: given_up + 5]).max() < 0.1
    assert y.max() > 3.3  # after the fast one


def test_lane_choice_is_the_same_in_any_batch() -> None:
    scenes = [
        episode(
            driver(replace(CALM, key=number)),
            steady("slow", 60.0 - 4.0 * number, 0.0, 7.0),
            limits=LONG,
            key=str(number),
        )
        for number in range(3)
    ]
    batch, alone = World(scenes, ROAD), World(scenes[1:2], ROAD)
    for _ in range(150):
        batch.step()
        alone.step()
    assert batch.hashes()[1] == alone.hashes()[0]
    assert batch.array("shift")[1].any()


def test_autopilots_without_a_driver_change_lanes_as_before() -> None:
    """They move as they decide: their signal leads nothing."""
    uniform = replace(ego(x=20.0, speed=8.0), controller=autopilot().controller, route=autopilot(20.0, to=390.0).route)
    result = drive(episode(uniform, steady("slow", 60.0, 0.0, 3.0), limits=LONG), ROAD, 20.0)
    first = begin_of_signal(result)
    assert result["pose"][first + 8, 0, 1] > 0.02
