"""Films of attacked drives: who is attacked, and clean beside attacked."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from ssad.core.errors import FormatError, SSADError
from ssad.core.types import AgentKind, Controller, EpisodeLimits, EpisodeTrace
from ssad.experiments.driving.attacked_film import agent_ahead, attacked_frames
from ssad.rendering.agent_edit import AgentEdit
from ssad.rendering.camera.scene_edit import SceneEdit
from ssad.rendering.hours import at_hour
from ssad.rendering.meshes.mesh import Mesh
from ssad.rendering.onboard import DAY
from ssad.rendering.target import TargetCar
from ssad.scenarios.dynamic import build_episode, load_scenarios
from ssad.scenarios.static.physical import Camouflage
from ssad.scenarios.static.physical.lights import Projector, TargetSize, make_light
from ssad.scenarios.static.physical.lights.export import LightSetup, export_light, load_exported_attack
from ssad.world.roads import load_town
from ssad.world.rollout import rollout
from ssad.world.world import World


class Standing:
    """Stays where it is."""

    name, controller = "standing", Controller.EXTERNAL

    def reset(self, episodes) -> None:
        pass

    def act(self, view):
        return np.tile(np.array([0.0, 1.0, 0.0], np.float32), (len(view.scene), 1))


@pytest.fixture(scope="module")
def trace() -> EpisodeTrace:
    """Two steps; another car stands 12 m before the ego."""
    scenario = next(s for s in load_scenarios("precrash") if s.name == "RedlightRunning/00")
    town = load_town("ProvingGround")
    episode = replace(build_episode(scenario, town, seed=0), limits=EpisodeLimits(max_steps=2))
    (made,) = rollout(World([episode], {town.name: town}), Standing())
    x, y, yaw = made.x.copy(), made.y.copy(), made.yaw.copy()
    cos, sin = np.cos(yaw[:, 0]), np.sin(yaw[:, 0])
    x[:, 1], y[:, 1], yaw[:, 1] = x[:, 0] + 12 * cos, y[:, 0] + 12 * sin, yaw[:, 0]
    return replace(made, x=x, y=y, yaw=yaw)


def white(mesh: Mesh) -> SceneEdit:
    surface = Camouflage(texels=8).on(mesh)
    return SceneEdit((surface.layer,), textures={0: torch.full((3, 8, 8), 0.9)}, masks={0: surface.mask})


def test_the_car_before_the_ego_is_attacked(trace: EpisodeTrace) -> None:
    assert agent_ahead(trace) == 1
    behind = replace(trace, x=2 * trace.x[:, :1] - trace.x, y=2 * trace.y[:, :1] - trace.y)
    assert agent_ahead(behind) is None
    walker = trace.kind.copy()
    walker[1] = AgentKind.WALKER
    assert agent_ahead(replace(trace, kind=walker)) is None
    assert agent_ahead(replace(trace, kind=walker), AgentKind.WALKER) == 1


def test_a_film_shows_clean_beside_attacked(trace: EpisodeTrace) -> None:
    attack = AgentEdit(white, TargetCar(paint="black"), agent=1)
    frames = list(attacked_frames(trace, load_town("ProvingGround"), attack, width=160, frame_stride=2))
    assert len(frames) == 2
    for frame in frames:
        left, right = np.split(frame[:90].astype(int), 2, axis=1)
        changed = np.abs(left - right).max(-1) > 30
        assert 20 < changed.sum() < 0.2 * changed.size, "the car, and not the rest"


def test_a_light_is_exported_and_shines_in_a_drive(trace: EpisodeTrace, tmp_path: Path) -> None:
    """By night, on the car; a picture that was changed after its export is refused."""
    shape = Projector().surface(TargetSize(4.9, 2.06, 1.51)).size
    projector = LightSetup("projector", {"lumens": 800.0}, "night", "sedan:black:0", {}, torch.full((3, *shape), 1.0))
    export_light(tmp_path / "projector", projector)
    flashlight = make_light("flashlight", {})
    values = {
        name: low + 0.5 * (high - low) for name, (low, high) in flashlight.ranges(TargetSize(4.9, 2.06, 1.51)).items()
    }
    export_light(tmp_path / "flashlight", LightSetup("flashlight", {}, "night", "sedan:black:0", values))
    for name in ("projector", "flashlight"):
        made = load_exported_attack(tmp_path / name)
        night = at_hour(DAY, made.hour)
        frames = attacked_frames(
            trace, load_town("ProvingGround"), made.live(1), width=160, frame_stride=9, weather=night
        )
        left, right = np.split(next(frames)[:90].astype(int), 2, axis=1)
        brighter = (right - left).max(-1) > 30
        assert 20 < brighter.sum() < 0.3 * brighter.size, name
    (tmp_path / "projector" / "picture.npz").write_bytes(b"other")
    with pytest.raises(FormatError, match=r"not what light\.json describes"):
        load_exported_attack(tmp_path / "projector")
    with pytest.raises(SSADError):
        load_exported_attack(tmp_path)
