"""Pictures of the camera that a run shows."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from ssad.core.images import read_image
from ssad.core.nuscenes_names import CLASSES as NUSCENES
from ssad.experiments.driving.run_images import write_pictures
from ssad.rendering.bodies import BODIES
from ssad.rendering.bodies.actor_bodies import ACTOR_BODIES, BODY_CATEGORIES, class_of
from ssad.rendering.camera.rig import RIG, rig_camera
from ssad.rendering.camera_sheets import SHOWN, class_sheet
from ssad.rendering.episode_scene import EpisodeScene, agent_poses, body_of
from ssad.rendering.trace_sheet import make_overhead_camera, moments, onboard_sheet, pick_trace
from ssad.world.models import MODELS
from ssad.world.roads import load_town
from ssad.world.rollout import rollout
from ssad.world.world import World

pytest.importorskip("cv2")


def test_every_class_and_every_model_has_a_body() -> None:
    assert {class_of(kind) for kind in BODY_CATEGORIES} == set(NUSCENES)
    for kind, styles in (*SHOWN.items(), *ACTOR_BODIES.values()):
        assert set(styles) <= set(BODIES[kind].styles)
    for name, model in MODELS.items():
        low, high = body_of(name, 0).bounds()
        size = np.array([model.length, model.width, model.height])
        if ACTOR_BODIES.get(name, ("",))[0] == "pedestrian":  # whose box is that of a whole step
            assert (high - low < 1.1 * size).all()
            size = np.array([*(high - low)[:2], model.height])
        assert high - low == pytest.approx(size, rel=0.1)
    assert set(ACTOR_BODIES) == set(MODELS) - {"vending_machine", "barrier"}  # which are plain boxes
    sheet = class_sheet(60)
    assert sheet.std() > 20


def test_the_rig_is_that_of_nuscenes() -> None:
    for channel, (at, heading, focal) in RIG.items():
        camera = rig_camera(channel, 1600)
        assert camera.intrinsic[0, 0] == pytest.approx(focal)
        assert camera.intrinsic[:2, 2] == pytest.approx([816.8, 492.0])
        axis = camera.to_ego[:3, 2]
        turned = np.degrees(np.arctan2(axis[1], axis[0])) - heading
        assert (turned + 180) % 360 - 180 == pytest.approx(0, abs=1e-6)
        assert camera.to_ego[:3, 3] == pytest.approx(at)
        assert np.linalg.det(camera.to_ego[:3, :3]) == pytest.approx(1)


def test_an_episode_is_shown_from_the_ego_and_from_above() -> None:
    from ssad.drivers import make_system
    from ssad.scenarios.dynamic import build_episode, load_scenarios

    scenario = next(s for s in load_scenarios("precrash") if s.name == "StraightObstacle/00")
    graph = load_town(scenario.town)
    episode = build_episode(scenario, graph, seed=0)
    trace = rollout(World([episode], {graph.name: graph}), make_system("blind"))[0]
    assert len(moments(trace)) == 3
    town = EpisodeScene(graph)
    looks = town.appearance_of_trace(trace)
    town.add_bodies(looks.bodies())
    people = [thing for thing in town.objects(looks, agent_poses(trace)[0], without=0) if thing.tag]
    assert {t.tag for t in people} == {a + 1 for a in range(1, len(trace.models)) if trace.active[0, a]}
    camera, pose = make_overhead_camera(np.eye(4), 40.0, 64, 36)
    assert pose[:3, 2] == pytest.approx([0, 0, -1])
    assert camera.width == 64
    sheet = onboard_sheet(trace, graph, width=160)
    assert sheet.shape[1] == pytest.approx(2 * 164, abs=2)
    assert sheet.std() > 20


def test_a_run_without_recordings_has_no_such_picture(tmp_path: Path) -> None:
    (tmp_path / "results.jsonl").write_text("")
    assert pick_trace(tmp_path) is None
    write_pictures([], tmp_path)
    assert not (tmp_path / "pictures").exists()


@pytest.mark.slow
def test_the_shifts_are_shown_on_a_recorded_street(tmp_path: Path) -> None:
    write_pictures(["shifts"], tmp_path)
    sheet = read_image(tmp_path / "pictures" / "shifts.jpg")
    tall, wide = sheet.shape[0] // 4, sheet.shape[1] // 3
    clean, *shifted = (
        sheet[r * tall : (r + 1) * tall - 40, c * wide : (c + 1) * wide].astype(int) for r in range(4) for c in range(3)
    )
    assert clean.std() > 20
    assert min(np.abs(one - clean).mean() for one in shifted) > 1.0
    captions = json.loads((tmp_path / "pictures" / "pictures.json").read_text())
    assert captions.keys() == {"shifts.jpg", "shifts-severities.jpg"}
    assert all((tmp_path / "pictures" / name).is_file() for name in captions)
