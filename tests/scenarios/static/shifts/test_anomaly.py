"""The shift `anomaly`: where objects stand, how they are drawn into pictures, and what a LiDAR sees of them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from helpers.boxes import cars

from ssad.core.boxes import UNIT_CORNERS, TrackedBoxes
from ssad.core.frames import Camera, Frame, SceneContext, ShiftReport, StandingObject, SweepFrame, camera_to_world
from ssad.core.rotations import upright_pose
from ssad.core.types import F64, U8
from ssad.scenarios.static.shifts import ShiftSpec, shift_images, shift_points
from ssad.scenarios.static.shifts import parameters as table
from ssad.scenarios.static.shifts.anomaly import AROUND, place_objects
from ssad.scenarios.static.shifts.light import to_linear

CAMERA = Camera.typical(320, 180)
GREY = np.full((180, 320, 3), 110, np.uint8)
CAR = StandingObject("overturned", "car_side", 5, (4.7, 1.5, 1.9), (16.0, 0.5, 0.0), 0.6)
SLOPE = 0.05


def drive(length: float = 60.0) -> F64:
    """Poses [N, 4, 4] of an ego that drives north up a slope."""
    return np.array([upright_pose(3.0, float(y), np.pi / 2, SLOPE * y) for y in np.arange(0.0, length + 0.1, 2.0)])


def shown(frame: Frame, *objects: StandingObject, picture: U8 = GREY) -> tuple[U8, ShiftReport]:
    """A picture with objects on its road."""
    contexts = {frame.scene: SceneContext(frame.scene, objects=objects)}
    out, done = shift_images(picture, replace(frame, scene=frame.scene), ShiftSpec("anomaly", 5), contexts=contexts)
    return np.asarray(out), done[0]


def corners_of(thing: StandingObject, frame: Frame, wider: float = 0.0, tall: float = 1.0) -> F64:
    """Corners [8, 2] in pixels of an object's box, `wider` m to each side and `tall` times as high."""
    size = np.array(thing.size) * [1.0, 1.0, tall] + [2.0 * wider, 2.0 * wider, 0.0]
    pose = upright_pose(thing.place[0], thing.place[1], thing.yaw, thing.place[2])
    world = ((UNIT_CORNERS + np.array([0.0, 0.0, 0.5])) * size) @ pose[:3, :3].T + pose[:3, 3]
    eye = camera_to_world(frame)
    local = (world - eye[:3, 3]) @ eye[:3, :3]
    k = frame.camera.intrinsic
    return np.asarray(local[:, :2] / local[:, 2:] * [k[0, 0], k[1, 1]] + [k[0, 2], k[1, 2]])


def hull(*points: F64) -> Any:
    """Pixels [H, W] that the convex hulls of points [N, 2] touch."""
    mask = np.zeros(GREY.shape[:2], np.uint8)
    for outline in points:
        cv2.fillConvexPoly(mask, np.rint(cv2.convexHull(outline.astype(np.float32))).astype(np.int32), 1)
    return cv2.dilate(mask, np.ones((3, 3), np.uint8)) > 0


# ---------------------------------------------------------------- places


def test_objects_of_a_scene_are_drawn_once_for_all_severities() -> None:
    boxes = [TrackedBoxes.empty()]
    found = place_objects(ShiftSpec("anomaly", 1), "a", drive(), boxes)
    assert found == place_objects(ShiftSpec("anomaly", 5), "a", drive(), boxes)
    assert found != place_objects(ShiftSpec("anomaly", 5), "b", drive(), boxes)
    assert found != place_objects(ShiftSpec("anomaly", 5, 1), "a", drive(), boxes)
    pieces = round((60.0 + table.ANOMALY_AHEAD) / table.ANOMALY_EVERY)
    counts = [sum(o.level <= severity for o in found) for severity in range(1, 6)]
    assert counts == [pieces * n for n in (1, 2, 3, 4, 6)]


def test_objects_stand_on_the_road_clear_of_boxes_and_of_the_ego() -> None:
    poses = drive()
    crowd = cars(
        *[(3.0 + 2.5 * side, y, 0.8) for side in (-1, 1) for y in np.arange(0.0, 60.0, 9.0)], velocity=(0, 0, 0)
    )
    crossing = cars(*[(3.0, y, 0.8) for y in (66.0, 75.0, 84.0, 93.0)], velocity=(8.0, 0.0, 0.0))
    seen = []
    for seed in range(12):
        for thing in place_objects(ShiftSpec("anomaly", 3, seed), "a", poses, [crowd, crossing]):
            x, y, z = thing.place
            assert table.ANOMALY_FIRST <= y <= 60.0 + table.ANOMALY_FIRST + table.ANOMALY_AHEAD
            assert abs(x - 3.0) <= table.ANOMALY_ASIDE + 0.5 * min(thing.size[:2]) + 1e-9
            assert z == pytest.approx(SLOPE * min(y, 60.0), abs=0.11)
            grid = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 25), np.linspace(-0.5, 0.5, 25)), -1).reshape(-1, 2)
            pose = upright_pose(x, y, thing.yaw)
            ground = (grid * thing.size[:2]) @ pose[:2, :2].T + pose[:2, 3]
            for boxes, moved in ((crowd, 0.0), (crossing, 0.0), (crossing, -1.9), (crossing, 1.9)):
                apart = np.abs(ground[:, None] - boxes.centre[None, :, :2] - [moved, 0.0]) > 0.5 * boxes.size_lwh[:, :2]
                assert apart.any(-1).all(), "in a box, or where one is between two samples"
            driven = (ground[:, 1] > 0.0) & (ground[:, 1] < 60.0)
            assert (np.abs(ground[driven, 0] - 3.0) > 1.0).all(), "the ego drives through it"
            seen.append(thing)
    assert len(seen) > 30


def test_there_may_be_no_place() -> None:
    full = cars((30.0, 0.0, 0.8))
    full = replace(full, size_lwh=np.array([[300.0, 300.0, 2.0]]))
    assert place_objects(ShiftSpec("anomaly", 5), "a", drive(), [full]) == ()


# ---------------------------------------------------------------- pictures


def test_more_of_the_picture_is_covered_with_severity() -> None:
    frame = Frame(CAMERA, "s", "f")
    for seed in range(2):
        done = [shift_images(GREY, frame, ShiftSpec("anomaly", severity, seed))[1][0] for severity in range(1, 6)]
        covered = [d.details["covered"] for d in done]
        assert (np.diff(covered) > 0).all(), covered
        assert len(done[4].details["objects"]) == 6


def test_what_is_not_object_or_shadow_keeps_its_bytes() -> None:
    noise = np.random.default_rng(0).integers(60, 160, GREY.shape).astype(np.uint8)
    frame = Frame(CAMERA, "s")
    near = replace(CAR, place=(9.0, 0.3, 0.0))
    for thing in (near, replace(near, kind="animal", style="horse", size=(2.3, 0.6, 2.0))):
        out, done = shown(frame, thing, picture=noise)
        touched = hull(corners_of(thing, frame), corners_of(thing, frame, AROUND, 0.0))
        changed = (out != noise).any(-1)
        assert not (changed & ~touched).any()
        assert changed.sum() / touched.sum() > 0.1
        assert 0.0 < done.details["covered"] < changed.mean()
        below = changed & ~hull(corners_of(thing, frame))
        assert below.any(), "no shadow"
        assert (out[below].astype(int) <= noise[below]).all(), "a shadow takes light"


def test_what_is_nearer_hides() -> None:
    depth = np.full((45, 80), np.inf, np.float32)
    free, _ = shown(Frame(CAMERA, "s", depth=depth), CAR)
    assert (free != GREY).any()
    depth[:, :38] = 6.0
    half, done = shown(Frame(CAMERA, "s", depth=depth), CAR)
    assert (half[:, : 38 * 4] == GREY[:, : 38 * 4]).all()
    solid = hull(corners_of(CAR, Frame(CAMERA)))
    right = np.zeros_like(solid)
    right[:, 38 * 4 :] = True
    assert (half[right & solid] == free[right & solid]).mean() > 0.9
    assert done.details["depth"] == "given"
    depth[:] = 6.0
    none, done = shown(Frame(CAMERA, "s", depth=depth), CAR)
    assert (none == GREY).all()
    assert not done.applied


def test_without_depth_nearer_boxes_hide() -> None:
    near, far = cars((9.0, 0.3, 0.8)), cars((30.0, 0.3, 0.8))
    bare, done = shown(Frame(CAMERA, "s"), CAR)
    assert done.details["depth"] == "boxes"
    behind, _ = shown(Frame(CAMERA, "s", boxes=far), CAR)
    assert (behind == bare).all()
    frame = Frame(CAMERA, "s", boxes=near)
    hidden, _ = shown(frame, CAR)
    eye = camera_to_world(frame)
    local = (near.corners()[0] - eye[:3, 3]) @ eye[:3, :3]
    k = CAMERA.intrinsic
    box = hull(local[:, :2] / local[:, 2:] * k[0, 0] + k[:2, 2])
    inner = cv2.erode(box.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    assert (bare[inner] != GREY[inner]).any()
    assert (hidden[inner] == GREY[inner]).all()
    assert (hidden[~box] == bare[~box]).all()
    unknown = np.zeros((45, 80), np.float32)
    assert (shown(replace(frame, depth=unknown), CAR)[0] == hidden).all(), "a depth of 0 is not known"


def test_an_object_stands_still_in_the_world() -> None:
    """Its outline in the picture is that of its box, from wherever the ego looks."""
    pallet = StandingObject("debris", "pallet", 1, (2.6, 2.0, 1.0), (16.0, 0.5, 0.0), 0.6)  # reaches every corner
    for x, y, yaw in ((0.0, 0.0, 0.0), (6.0, -1.0, 0.1), (26.0, 6.0, -2.6)):
        frame = Frame(CAMERA, "s", ego_to_world=upright_pose(x, y, yaw))
        (told,) = shown(frame, pallet)[1].details["objects"]
        corners = corners_of(pallet, frame)
        expected = np.concatenate([np.floor(corners.min(0)), np.ceil(corners.max(0))])
        assert np.abs(np.array(told["box"]) - expected).max() <= 1.0
    away = Frame(CAMERA, "s", ego_to_world=upright_pose(0.0, 0.0, np.pi))
    out, done = shown(away, CAR)
    assert not done.applied
    assert (out == GREY).all()


def test_objects_are_as_bright_as_the_ground_around_them() -> None:
    frame = Frame(CAMERA, "s")
    inside = cv2.erode(hull(corners_of(CAR, frame)).astype(np.uint8), np.ones((15, 15), np.uint8)) > 0
    light = []
    for code in (40, 110):
        out, _ = shown(frame, CAR, picture=np.full_like(GREY, code))
        light.append(float(to_linear(out[inside]).mean()))
    assert light[1] / light[0] == pytest.approx(float(to_linear(110) / to_linear(40)), rel=0.1)


# ---------------------------------------------------------------- LiDAR


def test_rays_that_meet_an_object_return_from_it() -> None:
    """A wall 40 m away, seen by rays of all heights; a block 2 m high stands before it, and hides a lower one."""
    y, z = np.meshgrid(np.linspace(-10.0, 10.0, 81), np.linspace(-1.7, 4.0, 41))
    wall = np.stack([np.full(y.size, 40.0), y.ravel(), z.ravel(), np.full(y.size, 9.0), np.zeros(y.size)], 1)
    block = StandingObject("debris", "mattress", 2, (2.0, 4.0, 2.0), (21.0, 3.0, 0.0), 0.0)
    behind = replace(block, size=(1.0, 1.0, 1.6), place=(25.0, 3.0, 0.0))
    frame = SweepFrame("s", to_ego=upright_pose(1.0, 0.0, 0.0, 1.8))
    contexts = {"s": SceneContext("s", objects=(block, behind))}
    before = wall.astype(np.float32)
    out, done = shift_points(before, frame, ShiftSpec("anomaly", 5), contexts=contexts)
    moved = (out != before).any(1)
    assert done.details["moved"] == moved.sum() > 20
    np.testing.assert_allclose(np.cross(out[moved, :3], before[moved, :3]), 0.0, atol=1e-3)  # along their rays
    world = out[:, :3] + [1.0, 0.0, 1.8]
    assert (np.abs(world[moved] - [21.0, 3.0, 1.0]) <= [1.01, 2.01, 1.01]).all()
    assert world[moved, 0].max() < 21.5, "the side that looks at the sensor"
    way = (20.0 - 1.0) / 39.0  # where the rays pass the middle of the face that looks at the sensor
    middle = (np.abs(before[:, 1] * way - 3.0) < 1.2) & (np.abs(before[:, 2] * way + 0.8) < 0.6)
    assert moved[middle].all()
    far, none = shift_points(0.3 * before, frame, ShiftSpec("anomaly", 5), contexts=contexts)
    assert not none.applied, "what is nearer than the object stays"
    assert (far == np.float32(0.3) * before).all()
