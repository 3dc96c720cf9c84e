"""Foreign simulators refuse, in one line, motion that pedals cannot keep to."""

from __future__ import annotations

from typing import Any

import pytest
from world.worlds import GRAPHS, ego, episode

from ssad.core.errors import ConfigError
from ssad.core.types import Arrival, Controller, EpisodeAgent, LateralPhase, Phase, PhaseTrigger, Pose
from ssad.simulators.carla.server import Server
from ssad.simulators.carla.simulator import Carla
from ssad.simulators.highway_env import HighwayEnv
from ssad.simulators.mirrored import check_phases

SIMPLE = (Phase(3.0), Phase(0.5, PhaseTrigger("time_headway", 2.0), reference="ego", factor=True, anytime=True))


def scene(**changes: Any) -> list:
    return [
        episode(ego(), EpisodeAgent("van", "van", Controller.SCRIPT, Pose(60.0, 0.0), **{"phases": SIMPLE} | changes))
    ]


REFUSED = {
    "acceleration in phase 3": {"phases": (*SIMPLE, Phase(2.0, acceleration=-4.0))},
    "jerk in phase 1": {"phases": (Phase(2.0, jerk=1.0),)},
    "shape in phase 1": {"phases": (Phase(2.0, shape="step"),)},
    "duration in phase 1": {"phases": (Phase(2.0, duration=1.0),)},
    "distance in phase 1": {"phases": (Phase(2.0, distance=9.0),)},
    "arrival in phase 1": {"phases": (Phase(arrival=Arrival((70.0, 0.0), (50.0, 0.0))),)},
    "lateral phases": {"lateral": (LateralPhase(1),)},
}


@pytest.mark.parametrize("stated", REFUSED)
def test_motion_that_pedals_cannot_keep_to_is_refused(stated: str) -> None:
    message = f"scenario test: CARLA cannot carry out the motion of actor van \\({stated}\\); leave it out"
    with pytest.raises(ConfigError, match=message):
        check_phases(scene(**REFUSED[stated]), "CARLA")


def test_both_simulators_refuse_before_they_start() -> None:
    check_phases(scene(), "CARLA")
    stated = scene(phases=(Phase(2.0, acceleration=1.0),))
    with pytest.raises(ConfigError, match="CARLA cannot carry out the motion of actor van"):
        Carla(stated, GRAPHS, server=Server("nowhere"))
    with pytest.raises(ConfigError, match="highway-env cannot carry out the motion of actor van"):
        HighwayEnv(stated, GRAPHS)
