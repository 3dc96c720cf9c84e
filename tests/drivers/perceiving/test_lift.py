"""From boxes in pictures to places in the world: what a perfect detector sees comes back where it is."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from ssad.core.detections import Detections, Solids
from ssad.core.driving import Belief
from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.core.nuscenes_names import MMDET3D_CLASSES
from ssad.core.perception import Objects, no_objects
from ssad.core.rotations import upright_pose
from ssad.core.types import F64, AgentKind
from ssad.drivers.perceiving.lift import Lifting, lift, merge_duplicates
from ssad.drivers.perceiving.objects import KINDS, SIZES
from ssad.drivers.perceiving.perceivers import object_boxes, project_boxes
from ssad.rendering.camera.rig import RIG, rig_camera

EGO = (120.0, -35.0, 2.1)


def truth(*rows: tuple[float, float, float, AgentKind]) -> Belief:
    """Objects at x ahead, y to the left and a heading, as seen from the ego; 3 m/s."""
    place = np.array([row[:2] for row in rows]) @ upright_pose(*EGO)[:2, :2].T + EGO[:2]
    yaw = np.array([row[2] for row in rows]) + EGO[2]
    kind = np.array([row[3] for row in rows], np.int32)
    pose = np.column_stack([place, yaw])[None].astype(np.float32)
    return Belief(pose, np.full((1, len(rows)), 3.0, np.float32), SIZES[kind, :2][None].astype(np.float32), kind[None])


def lifted(found: Detections, camera: Camera, pose: F64, **settings: float) -> Objects:
    """What was found in one picture, of scene 0."""
    lifting = Lifting(**settings)  # type: ignore[arg-type]  # floats alone
    return lift([found], camera, pose[None], np.zeros(1, np.int64), MMDET3D_CLASSES, settings=lifting)


def seen(belief: Belief, channel: str = "CAM_FRONT") -> tuple[Detections, Objects]:
    camera = rig_camera(channel, 640)
    pose = upright_pose(*EGO) @ camera.to_ego
    found = project_boxes(object_boxes(belief, 0, np.ones(belief.kind.shape[1], bool)), np.linalg.inv(pose), camera)
    return found, lifted(found, camera, pose)


def test_what_is_projected_comes_back_with_its_heading_size_and_speed() -> None:
    belief = truth(
        (12.0, 1.0, 0.3, AgentKind.CAR), (25.0, -4.0, 3.0, AgentKind.BUS), (9.0, 2.0, -1.5, AgentKind.WALKER)
    )
    _, found = seen(belief)
    assert found.kind.tolist() == belief.kind[0].tolist()
    np.testing.assert_allclose(found.place, belief.pose[0, :, :2], atol=1e-4)
    np.testing.assert_allclose(np.cos(found.yaw - belief.pose[0, :, 2]), 1.0, atol=1e-6)
    np.testing.assert_allclose(found.size, belief.size[0], atol=1e-5)
    heading = np.stack([np.cos(belief.pose[0, :, 2]), np.sin(belief.pose[0, :, 2])], 1)
    np.testing.assert_allclose(found.velocity, 3.0 * heading, atol=1e-4)


@pytest.mark.parametrize("channel", RIG)
def test_every_camera_of_the_rig_agrees(channel: str) -> None:
    angle = np.radians(RIG[channel][1])
    belief = truth((15.0 * np.cos(angle), 15.0 * np.sin(angle), 0.7, AgentKind.CAR))
    _, found = seen(belief, channel)
    np.testing.assert_allclose(found.place, belief.pose[0, :, :2], atol=1e-4)
    np.testing.assert_allclose(np.cos(found.yaw - belief.pose[0, :, 2]), 1.0, atol=1e-6)


def test_only_what_is_before_the_camera_and_in_its_picture_is_seen() -> None:
    _, found = seen(
        truth((-10.0, 0.0, 0.0, AgentKind.CAR), (10.0, 30.0, 0.0, AgentKind.CAR), (10.0, 0.0, 0.0, AgentKind.CAR))
    )
    assert len(found) == 1


@pytest.mark.parametrize(("turn", "kind"), [(0.0, AgentKind.CAR), (np.pi / 2, AgentKind.CAR), (0.0, AgentKind.WALKER)])
@pytest.mark.parametrize("ahead", [9.5, 15.0, 30.0])
def test_a_flat_box_is_lifted_by_the_road_under_it(turn: float, kind: AgentKind, ahead: float) -> None:
    belief = truth((ahead, 0.0, turn, kind))
    found, _ = seen(belief)
    camera = rig_camera("CAM_FRONT", 640)
    pose = upright_pose(*EGO) @ camera.to_ego
    flat = lifted(replace(found, solid=None), camera, pose, overhang=0.0)
    np.testing.assert_allclose(flat.place, belief.pose[0, :, :2], atol=0.35)
    if kind == AgentKind.CAR:
        np.testing.assert_allclose(np.abs(np.cos(flat.yaw - belief.pose[0, :, 2])), 1.0, atol=0.02)


def test_what_hangs_in_the_sky_stands_on_no_road() -> None:
    found, _ = seen(truth((20.0, 0.0, 0.0, AgentKind.CAR)))
    camera = rig_camera("CAM_FRONT", 640)
    pose = upright_pose(*EGO) @ camera.to_ego
    sky = replace(found, solid=None, box=torch.tensor([[300.0, 20.0, 340.0, 60.0]]))
    assert len(lifted(sky, camera, pose)) == 0


def test_places_are_less_sure_along_the_line_of_sight() -> None:
    _, found = seen(truth((30.0, 0.0, 0.0, AgentKind.CAR)))
    line = np.array([np.cos(EGO[2]), np.sin(EGO[2])])
    side = np.array([-line[1], line[0]])
    away = 30.0 - 1.7
    assert line @ found.covariance[0] @ line == pytest.approx((0.4 + 0.05 * away) ** 2, rel=0.01)
    assert side @ found.covariance[0] @ side == pytest.approx((0.2 + 0.01 * away) ** 2, rel=0.05)


@pytest.mark.parametrize("field", ["score", "centre"])
def test_what_is_not_finite_is_an_error_and_not_a_miss(field: str) -> None:
    found, _ = seen(truth((12.0, 0.0, 0.0, AgentKind.CAR)))
    assert found.solid is not None
    if field == "score":
        found = replace(found, score=torch.full_like(found.score, torch.nan))
    else:
        found = replace(found, solid=replace(found.solid, centre=torch.full_like(found.solid.centre, torch.nan)))
    with pytest.raises(ConfigError, match="not finite"):
        lifted(found, rig_camera("CAM_FRONT", 640), np.eye(4))


def test_of_two_boxes_on_one_car_the_better_stays_and_people_beside_it_too() -> None:
    belief = truth(
        (12.0, 0.0, 0.0, AgentKind.CAR), (13.0, 0.4, 0.0, AgentKind.TRUCK), (12.0, 1.4, 0.0, AgentKind.WALKER)
    )
    _, found = seen(belief)
    kept = merge_duplicates(replace(found, score=np.array([0.4, 0.8, 0.3])), 0.5)
    assert sorted(kept.kind.tolist()) == [AgentKind.TRUCK, AgentKind.WALKER]
    assert len(merge_duplicates(no_objects(), 0.5)) == 0


def test_all_classes_that_matter_have_a_kind() -> None:
    assert all(name in KINDS for name in MMDET3D_CLASSES)


@pytest.mark.parametrize("flat", [False, True])
def test_many_pictures_at_once_give_to_the_bit_what_each_gives_alone(flat: bool) -> None:
    draws, camera = np.random.default_rng(5), rig_camera("CAM_FRONT_LEFT", 640)
    pictures, alone, poses = [], [], []
    scenes = np.array([7, 2, 4, 9])
    for count, scene in zip((5, 0, 1, 12), scenes.tolist(), strict=True):
        found = random_detections(draws, count)
        pictures.append(replace(found, solid=None) if flat else found)
        poses.append(upright_pose(*draws.normal(size=3).tolist()) @ camera.to_ego)
        one = lifted(pictures[-1], camera, poses[-1])
        assert (np.diff(one.score) <= 0.0).all()
        alone.append(replace(one, scene=np.full(len(one), scene)))
    together = lift(pictures, camera, np.array(poses), scenes, MMDET3D_CLASSES, settings=Lifting())
    assert len(together) > 5
    for name in (field.name for field in fields(Objects)):
        expected = getattr(Objects.cat(alone), name)
        np.testing.assert_array_equal(getattr(together, name), expected, err_msg=name)
    parts = [merge_duplicates(one, 0.5) for one in sorted(alone, key=lambda one: one.scene[:1].tolist())]
    fewer = merge_duplicates(together, 0.5)
    for name in (field.name for field in fields(Objects)):
        np.testing.assert_array_equal(getattr(fewer, name), getattr(Objects.cat(parts), name), err_msg=name)


def random_detections(draws: np.random.Generator, count: int) -> Detections:
    """Boxes of all classes, crowded, before a camera."""
    place = np.column_stack([draws.normal(0.0, 3.0, count), np.full(count, 1.0), draws.uniform(5.0, 25.0, count)])
    size = draws.uniform(1.0, 5.0, (count, 3))
    corner = draws.uniform(0.0, 300.0, (count, 2))
    box = np.column_stack([corner, corner + draws.uniform(5.0, 200.0, (count, 2))])
    tensor = torch.from_numpy
    solid = Solids(
        tensor(place),
        tensor(size),
        tensor(draws.uniform(-3.0, 3.0, count)),
        tensor(draws.normal(size=(count, 2))),
        torch.zeros(count, dtype=torch.int64),
    )
    return Detections(tensor(draws.uniform(0.1, 1.0, count)), tensor(draws.integers(0, 10, count)), tensor(box), solid)
