"""From a scenario to an episode: where actors may not stand."""

from __future__ import annotations

from dataclasses import replace

import pytest

from ssad.core.errors import RouteError
from ssad.core.types import Actor, Pose, Scenario
from ssad.roads import load_town
from ssad.scenarios.dynamic import build_episode
from ssad.world.models import model

START = Pose(217.0, -5.25)
PLAIN = Scenario("Mine", "Custom", "ProvingGround", (START, Pose(317.0, -5.25)))


def with_car(ahead: float, left: float = 0.0) -> Scenario:
    """A car of the ego's size beside it, metres between the centres."""
    return replace(PLAIN, actors=(Actor("van", "car", Pose(START.x + ahead, START.y + left)),))


def test_nobody_stands_in_the_ego_at_the_start() -> None:
    town, body = load_town("ProvingGround"), model("car")
    ego = build_episode(PLAIN, town, seed=0).agents[0].pose
    nearest = ego.x - START.x + body.length
    for scenario in (with_car(nearest + 0.1), with_car(0.0, body.width + 0.1), with_car(0.0, -body.width - 0.1)):
        assert len(build_episode(scenario, town, seed=0).agents) == 2
    for scenario in (with_car(nearest - 0.1), with_car(0.0), with_car(0.0, body.width - 0.1)):
        with pytest.raises(RouteError, match="scenario Mine: van stands in the ego at the start; move one of them"):
            build_episode(scenario, town, seed=0)


def test_the_one_that_stands_there_is_named() -> None:
    far, near = with_car(30.0).actors[0], replace(with_car(1.0).actors[0], name="kiosk")
    with pytest.raises(RouteError, match="kiosk stands in the ego"):
        build_episode(replace(PLAIN, actors=(far, near)), load_town("ProvingGround"), seed=0)
