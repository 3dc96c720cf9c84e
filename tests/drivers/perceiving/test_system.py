"""Systems of suites that are lane keepers."""

from __future__ import annotations

import pytest

from ssad.core.errors import ConfigError
from ssad.drivers import make_system
from ssad.drivers.lane_keeping.driver import CHANNEL, LaneKeeper
from ssad.drivers.perceiving.system import PerceivingSystem


def test_a_lane_keeper_is_chosen_by_one_key_that_others_do_not_show() -> None:
    plain = PerceivingSystem(name="s", detector="truth")
    keeper = PerceivingSystem(name="s", detector="truth", steers_by="markings", width=320)
    assert "steers_by" not in plain.model_dump()
    assert keeper.model_dump()["steers_by"] == "markings"
    # Perturbations of images reach a lane keeper, whoever tells it of others.
    assert plain.is_perfect
    assert not keeper.is_perfect
    driver = keeper.make()
    assert isinstance(driver, LaneKeeper)
    assert not isinstance(plain.make(), LaneKeeper)
    assert driver.cameras[CHANNEL].width == 320
    assert keeper.version == plain.version == ""


def test_a_lane_keeper_plans_itself() -> None:
    system = PerceivingSystem(name="s", detector="truth", steers_by="markings", planner="autopilot")
    with pytest.raises(ConfigError, match="steers_by: markings has no planner; remove"):
        system.check()


def test_a_lane_keeper_has_a_name_for_every_suite() -> None:
    driver = make_system("lane-keeper")
    assert driver.name == "lane-keeper"
    assert CHANNEL in driver.sensors
