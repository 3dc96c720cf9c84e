"""What a semantic camera says lies where the map and the agents are."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from ssad.core.errors import ConfigError
from ssad.core.frames import Camera, DepthCamera, SemanticCamera
from ssad.core.types import Actor, AgentKind, EpisodeLimits, LaneType, Pose, Scenario
from ssad.rendering.semantic import CLASS_OF_KIND, CLASS_OF_MATERIAL, SemanticClass
from ssad.scenarios.dynamic import build_episode
from ssad.simulators.carla.sensors import sensor_blueprints
from ssad.simulators.closed_loop import onboard_sensors
from ssad.world.roads import LaneQuery, load_town
from ssad.world.world import World

CAMERA = Camera(
    96,
    72,
    np.array([[48.0, 0, 48.0], [0, 48.0, 36.0], [0, 0, 1]]),
    np.array([[0.0, 0, 1, 1.5], [-1, 0, 0, 0], [0, -1, 0, 2.5], [0, 0, 0, 1]]),
)


@pytest.mark.slow
def test_roads_walks_agents_and_sky() -> None:
    """Points of roads lie on driving lanes, those of sidewalks beside them, those of agents where they stand."""
    town = load_town("ProvingGround")
    actors = (
        Actor("van", "van", Pose(245.0, -5.25, 0.0)),
        Actor("walker", "walker", Pose(236.0, -1.75, 1.57)),
    )
    route = (Pose(229.0, -5.25), Pose(300.0, -5.25))
    scenario = Scenario("seen", "Custom", town.name, route, actors=actors, limits=EpisodeLimits(max_steps=1))
    world = World([build_episode(scenario, town, seed=0)], {town.name: town})
    driver = SimpleNamespace(
        name="camera", sensors=("labels", "depth"), semantic_cameras={"labels": CAMERA}, depth_cameras={"depth": CAMERA}
    )
    sensors = onboard_sensors([driver], "cpu")  # type: ignore[list-item]
    egos = np.array([[0, 0]], np.int32)
    labels, depth = sensors["labels"](world, egos)[0], sensors["depth"](world, egos)[0]
    assert labels.dtype == np.uint8
    assert (labels == SemanticClass.SKY).any()
    np.testing.assert_array_equal(labels == SemanticClass.SKY, np.isinf(depth))
    pose = world.state().pose[0, 0].astype(np.float64)
    rows, columns = np.nonzero(np.isfinite(depth) & (depth < 25.0))
    ahead = depth[rows, columns] + 1.5
    left = -(columns + 0.5 - 48.0) / 48.0 * depth[rows, columns]
    up = 2.5 - (rows + 0.5 - 36.0) / 48.0 * depth[rows, columns]
    x = pose[0] + ahead * np.cos(pose[2]) - left * np.sin(pose[2])
    y = pose[1] + ahead * np.sin(pose[2]) + left * np.cos(pose[2])
    found = labels[rows, columns]
    query = LaneQuery(town)
    is_road = np.isin(found, (SemanticClass.ROAD, SemanticClass.ROAD_LINE))
    assert is_road.sum() > 500
    assert (found == SemanticClass.ROAD_LINE).sum() > 10
    assert (~query.off_road(np.stack([x, y], 1)[is_road])).mean() > 0.9  # asphalt ends beside the lanes
    assert np.abs(up[is_road]).max() < 0.3
    is_walk = found == SemanticClass.SIDEWALK
    assert is_walk.sum() > 20
    nearest = query.nearest(np.stack([x, y], 1)[is_walk], (LaneType.SIDEWALK,))
    assert (np.abs(nearest.lateral) < 2.5).mean() > 0.9
    kinds = [AgentKind(int(kind)) for kind in world.state().kind[0]]
    for agent, reach in ((1, 3.2), (2, 1.0)):
        is_agent = found == CLASS_OF_KIND[kinds[agent]]
        assert is_agent.sum() > 10
        place = world.state().pose[0, agent]
        distance = np.hypot(x[is_agent] - place[0], y[is_agent] - place[1])
        assert (distance < reach).mean() > 0.9, kinds[agent]


@pytest.mark.slow
def test_every_material_of_the_street_has_a_class() -> None:
    """What is no house, plant, ground, sign or pole is a static object; nothing is left out by a misspelt name."""
    from ssad.rendering.episode_scene import EpisodeScene

    street = EpisodeScene(load_town("Oldmarket"), device="cpu").scene.street
    assert street is not None
    names = {material.name for material in street.materials}
    assert names - set(CLASS_OF_MATERIAL) <= {"bin", "orange", "planter"}
    assert {"asphalt", "paving", "brick", "cobbles", "marking_white", "lawn"} <= names


def test_carla_reads_no_such_cameras() -> None:
    for camera in (DepthCamera(CAMERA), SemanticCamera(CAMERA)):
        with pytest.raises(ConfigError, match="depth and semantic cameras are not read from CARLA"):
            sensor_blueprints({"eye": camera}, 0.1)
