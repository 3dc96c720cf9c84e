"""Shirts, pictures on the road and shadows in the closed loop: as in the trace afterwards, and where they belong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.core.types import Controller, EpisodeLimits
from ssad.rendering import episode_scene
from ssad.rendering.agent_edit import AgentEdit
from ssad.rendering.camera.scene_edit import SceneEdit
from ssad.rendering.hours import at_hour
from ssad.rendering.onboard import DAY, Onboard
from ssad.rendering.target import parse_target
from ssad.scenarios.dynamic import build_episode, load_scenarios
from ssad.scenarios.static.physical import make_carrier
from ssad.scenarios.static.physical.lights.export import LightSetup
from ssad.scenarios.static.physical.textures.export import PrintedTexture
from ssad.world.roads import load_town
from ssad.world.rollout import rollout
from ssad.world.world import World

NEAR = Camera.typical(192, 128)
# the target is 65 m away
FAR = replace(NEAR, intrinsic=NEAR.intrinsic * [[12.0, 1.0, 1.0], [1.0, 12.0, 1.0], [1.0, 1.0, 1.0]])


class Watcher:
    """Stands and keeps what it is shown."""

    name, controller, sensors = "watcher", Controller.EXTERNAL, ("front",)

    def __init__(self) -> None:
        self.shown: list[np.ndarray] = []

    def reset(self, episodes) -> None:
        pass

    def act(self, view):
        self.shown.append(view.readings["front"][0].copy())
        return np.tile(np.array([0.0, 1.0, 0.0], np.float32), (len(view.scene), 1))


def worn(carrier: str, target: str, value: float) -> AgentEdit:
    """A texture of one grey."""
    size = make_carrier(carrier, {}).on(parse_target(target).mesh()).size
    return PrintedTexture(torch.full((3, *size), value), carrier, {}, target).live(1)


def shadow() -> AgentEdit:
    """On the rear of a white car."""
    corners = {"left_a": -1.5, "up_a": 0.2, "left_b": 1.5, "up_b": 0.2, "left_c": 0.0, "up_c": 1.6}
    return LightSetup("shadow", {}, "sun_behind", "sedan:white:0", corners).live(1)


@pytest.mark.parametrize(
    ("scenario", "attack", "brighter"),
    [
        ("StraightObstacle/00", worn("camouflage", "pedestrian", 0.0), False),
        ("LaneChanging/00", worn("road", "sedan:black:0", 1.0), True),
        ("LaneChanging/00", shadow(), False),
    ],
    ids=["shirt", "road", "shadow"],
)
def test_what_a_driver_sees_of_an_attack_is_what_the_trace_shows(
    scenario: str, attack: AgentEdit, brighter: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To the bit; beside the same target without it, it is seen, and changes little else."""
    monkeypatch.setattr(episode_scene, "PHASES", 1)  # bodies are made faster
    town = load_town("ProvingGround")
    chosen = next(one for one in load_scenarios("precrash") if one.name == scenario)
    episode = build_episode(chosen, town, seed=0)
    episode = replace(episode, agents=episode.agents[:2], limits=EpisodeLimits(max_steps=2))  # nothing hides the target
    weather = at_hour(DAY, "sun_behind", 0.0)
    bare = replace(attack, edit=lambda mesh: SceneEdit())
    seen = []
    for one in (bare, attack):
        watcher, onboard = Watcher(), Onboard(weather=weather, attack=one)
        (trace,) = rollout(World([episode], {town.name: town}), watcher, sensors={"front": onboard.camera(FAR)})
        again = Onboard(weather=weather, attack=one).camera(FAR).of_trace(trace, town, steps=range(len(watcher.shown)))
        assert np.array_equal(again, watcher.shown)
        seen.append(watcher.shown[0].astype(int))
    change = (seen[1] - seen[0]) * (1 if brighter else -1)
    assert (change.min(0) > 30).sum() > 20, "the attack is seen"
    assert (np.abs(change).max(0) > 8).mean() < 0.1, "and all else is as it was"


def test_a_shirt_is_for_walkers() -> None:
    with pytest.raises(ConfigError, match="agent 1 is a car; the attack is made for a walker"):
        worn("camouflage", "pedestrian", 0.0).body("car")
