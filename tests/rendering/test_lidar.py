"""Sweeps of a LiDAR: ranges on known shapes, what is hit, noise, motion; points in boxes."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ssad.core.boxes import TrackedBoxes, WorldBoxes
from ssad.core.errors import ConfigError
from ssad.core.rotations import quaternion_to_matrix
from ssad.core.seeding import generator
from ssad.rendering.bodies import make_body
from ssad.rendering.camera.scene import RenderScene, SceneObject
from ssad.rendering.lidar import HDL32E, Lidar, points_in_boxes, sweep
from ssad.rendering.meshes.mesh import Material, Mesh, box, build, sphere
from ssad.rendering.street.model import Street

GREY = Material("grey", (0.5, 0.5, 0.5))
PAINT = Material("paint", (0.4, 0.4, 0.4), paint=True)
GLASS = Material("glass", (0.022, 0.027, 0.031), specular=0.09, gloss=0.96)
EXACT = replace(HDL32E, noise=0.0, lost=0.0, faint=0.0)
COARSE = replace(EXACT, azimuths=240)
PLANE, BALL, BLOCK, CAR, PAINTED, PANE, WALL = range(7)
RADIUS, SIZE = 0.5, (4.0, 2.0, 1.6)


def plane() -> Mesh:
    corners = np.array([[-400.0, -400, 0], [400, -400, 0], [400, 400, 0], [-400, 400, 0]])
    return build(corners, [[0, 1, 2], [0, 2, 3]], materials=GREY)


@functools.cache
def stage() -> RenderScene:
    meshes = [plane(), sphere(RADIUS, material=GREY, segments=256), box(SIZE, material=GREY)]
    meshes += [make_body("car", generator=generator("lidar"), detail=1), box(SIZE, material=PAINT)]
    meshes += [box((0.01, 60.0, 60.0), material=GLASS), box((1.0, 60.0, 60.0), material=GREY)]
    return RenderScene(None, meshes)


def at(x: float, y: float = 0.0, z: float = 0.0, *, mesh: int, tag: int = 1, yaw: float = 0.0) -> SceneObject:
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    pose[:3, 3] = x, y, z
    return SceneObject(mesh, pose, tag=tag)


def ego(x: float = 0.0, y: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    return at(x, y, mesh=0, yaw=yaw).pose


def shot(
    things: list[SceneObject], lidar: Lidar = COARSE, pose: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    return sweep(stage(), lidar, ego() if pose is None else pose, things, key=("test",))


def in_world(points: np.ndarray, pose: np.ndarray | None = None) -> np.ndarray:
    to_world = (ego() if pose is None else pose) @ HDL32E.to_ego
    return points[:, :3].astype(np.float64) @ to_world[:3, :3].T + to_world[:3, 3]


def slab_distance(origin: np.ndarray, rays: np.ndarray, size: tuple[float, ...]) -> np.ndarray:
    """Where rays [..., 3] enter a box about the origin; inf for those that miss."""
    with np.errstate(divide="ignore"):
        a, b = ((s * np.array(size) / 2 - origin) / rays for s in (-1, 1))
    enter, leave = np.minimum(a, b).max(-1), np.maximum(a, b).min(-1)
    return np.where((enter <= leave) & (enter > 0), enter, np.inf)


def test_the_sensor_is_that_of_nuscenes() -> None:
    assert (len(HDL32E.beams), HDL32E.azimuths) == (32, 1084)
    rays = HDL32E.directions()
    assert rays.shape == (1084, 32, 3)
    assert np.allclose(np.linalg.norm(rays, axis=-1), 1.0)
    assert np.rad2deg(np.arcsin(rays[0, [0, -1], 2])) == pytest.approx([-30.67, 10.67])
    heading = np.unwrap(np.arctan2(rays[:, 0, 0], rays[:, 0, 1]))
    assert np.allclose(np.diff(heading), 2 * np.pi / 1084)  # clockwise
    assert rays[0, 0, 1] < 0
    # y of the sensor is forward of the ego, x its right
    assert np.allclose(HDL32E.to_ego @ [1.0, 2.0, 0.5, 1.0], [0.94 + 2.0, -1.0, 1.84 + 0.5, 1.0])


def test_ranges_on_the_ground_are_height_over_sine() -> None:
    points, tags = shot([at(0, mesh=PLANE)], EXACT, ego(12.0, -7.0, 0.3))
    ring = points[:, 4].astype(int)
    distance = np.linalg.norm(points[:, :3].astype(np.float64), axis=1)
    expected = 1.84 / -np.sin(HDL32E.beams[ring])
    assert np.abs(distance - expected).max() < 1e-4
    reached = (HDL32E.beams < 0) & (1.84 / np.maximum(-np.sin(HDL32E.beams), 1e-9) < HDL32E.reach)
    assert np.array_equal(np.bincount(ring, minlength=32), reached * 1084)
    assert set(tags.tolist()) == {1}


def test_ranges_on_a_sphere() -> None:
    points, _ = shot([at(4.0, 1.0, 1.5, mesh=BALL)], EXACT)
    centre = np.linalg.inv(HDL32E.to_ego) @ [4.0, 1.0, 1.5, 1.0]
    distance = np.linalg.norm(points[:, :3].astype(np.float64), axis=1)
    rays = points[:, :3] / distance[:, None]
    along = rays @ centre[:3]
    under = RADIUS**2 - (centre[:3] @ centre[:3] - along**2)
    square_on = under > 0.8**2 * RADIUS**2  # elsewhere the facets of the mesh tell
    assert square_on.sum() > 100
    assert np.abs(distance - (along - np.sqrt(np.maximum(under, 0))))[square_on].max() < 1e-4


@pytest.mark.parametrize("pose", [ego(), ego(30.0, 20.0, 2.0)])
def test_ranges_on_boxes(pose: np.ndarray) -> None:
    things = [at(8.0, 3.0, 0.8, mesh=BLOCK, yaw=0.4, tag=4), at(-5.0, 15.0, 0.8, mesh=BLOCK, yaw=1.3, tag=5)]
    points, tags = shot(things, EXACT, pose)
    to_world = pose @ HDL32E.to_ego
    expected = []
    for thing in things:
        to_thing = np.linalg.inv(thing.pose) @ to_world
        expected.append(slab_distance(to_thing[:3, 3], EXACT.directions() @ to_thing[:3, :3].T, SIZE))
    nearest = np.min(expected, axis=0)
    assert np.isfinite(nearest).sum() == len(points)
    column, ring = np.nonzero(np.isfinite(nearest))
    assert np.array_equal(points[:, 4], ring)
    assert np.abs(np.linalg.norm(points[:, :3].astype(np.float64), axis=1) - nearest[column, ring]).max() < 1e-4
    assert np.array_equal(tags, np.array([4, 5])[np.argmin(expected, axis=0)[column, ring]])


def test_each_point_of_a_car_lies_on_its_triangles() -> None:
    mesh = make_body("car", generator=generator("lidar"), detail=1)
    car = at(9.0, -2.0, mesh=CAR, yaw=2.5)
    points, _ = shot([car])
    p = (in_world(points) - car.pose[:3, 3]) @ car.pose[:3, :3]
    a, b, c = np.moveaxis(mesh.corners(), 1, 0)
    normal = np.cross(b - a, c - a)
    high = np.linalg.norm(normal, axis=1)
    ok = high > 1e-7
    a, b, c, normal = a[ok], b[ok], c[ok], normal[ok] / high[ok, None]
    away = np.einsum("pfi,fi->pf", p[:, None] - a, normal)
    within = np.ones(away.shape, bool)
    for s, e in ((a, b), (b, c), (c, a)):
        side = np.einsum("pfi,fi->pf", np.cross(e - s, p[:, None] - s), normal)
        within &= side > -1e-3 * np.linalg.norm(e - s, axis=1)
    assert len(points) > 50
    assert np.where(within, np.abs(away), np.inf).min(1).max() < 2e-4


def test_far_from_the_origin() -> None:
    pose = ego(1800.0, -2400.0, 0.5)
    there = at(1806.0, -2395.0, 0.8, mesh=BLOCK, yaw=0.5)
    points, _ = shot([there], EXACT, pose)
    here, _ = shot([replace(there, pose=np.linalg.inv(pose) @ there.pose)], EXACT)
    assert abs(len(points) - len(here)) < 8
    local = (in_world(points, pose) - there.pose[:3, 3]) @ there.pose[:3, :3]
    assert np.abs(np.abs(local) - np.array(SIZE) / 2).min(1).max() < 5e-4


def loose_street(count: int) -> Street:
    """Triangles at random around the origin, two tiles; those at level 0 are every second one."""
    rng = np.random.default_rng(5)
    corners = rng.uniform(-30, 30, (count, 1, 3)) + rng.normal(0, 3, (count, 3, 3))
    faces = np.arange(3 * count, dtype=np.int32).reshape(-1, 3)
    near, rest = np.arange(0, count, 2), np.arange(1, count, 2)
    ends, none = len(near), np.zeros(0, np.float32)
    offset = np.array([[0, ends // 3, ends // 2, ends], [ends, count, count, count], [count] * 4])
    return Street(
        "loose",
        "town",
        corners.reshape(-1, 3).astype(np.float32),
        faces,
        np.full((count, 3, 3), 3**-0.5, np.float32),
        np.zeros((count, 3, 2), np.float32),
        np.zeros(count, np.int32),
        (GREY,),
        32.0,
        (-32.0, -32.0),
        2,
        1,
        np.concatenate([near, rest]).astype(np.int32),
        offset.astype(np.int32),
        none.reshape(0, 4),
        none.reshape(0, 4),
        none.astype(np.int32),
        none.astype(np.int32).reshape(0, 3, 2),
        none.reshape(0, 3),
    )


def test_a_street_equals_a_plain_search_over_its_triangles() -> None:
    street = loose_street(300)
    block = at(5.0, 0.0, 1.8, mesh=0)
    town = RenderScene(street, [box(SIZE, material=GREY)])
    lidar = replace(COARSE, blind=0.0)
    points, tags = sweep(town, lidar, ego(), [block], key=(1,))
    a, b, c = np.moveaxis(street.vertices[street.faces[::2]].astype(np.float64), 1, 0)
    origin = HDL32E.to_ego[:3, 3]
    rays = lidar.directions() @ HDL32E.to_ego[:3, :3].T
    p = np.cross(rays[:, :, None], c - a)
    det = np.einsum("fi,abfi->abf", b - a, p)
    u = np.einsum("fi,abfi->abf", origin - a, p) / det
    q = np.cross(origin - a, b - a)
    v = np.einsum("fi,abi->abf", q, rays) / det
    t = np.einsum("fi,fi->f", c - a, q) / det
    found = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0), t, np.inf).min(-1)
    of_block = slab_distance(origin - block.pose[:3, 3], rays, SIZE)
    nearest = np.minimum(found, of_block)
    column, ring = np.nonzero(nearest < lidar.reach)
    assert len(points) == len(column) > 1000
    assert np.array_equal(points[:, 4], ring)
    distance = np.linalg.norm(points[:, :3].astype(np.float64), axis=1)
    # float32 at a grazing angle
    error = np.abs(distance - nearest[column, ring])
    assert np.quantile(error, 0.99) < 1e-4
    assert error.max() < 5e-3
    assert np.array_equal(tags, (of_block < found)[column, ring])
    assert 0 < tags.sum() < len(tags)


def test_what_is_behind_is_not_hit() -> None:
    car = at(20.0, mesh=CAR, tag=7)
    assert 7 in shot([car])[1]
    _, tags = shot([car, at(8.0, mesh=WALL, tag=2)])
    assert set(tags.tolist()) == {2}


def test_a_negative_tag_counts_as_street() -> None:
    assert set(shot([at(0, mesh=PLANE, tag=-1)])[1].tolist()) == {0}


def test_glass_returns_three_beams_in_ten() -> None:
    things = [at(6.0, mesh=PANE, tag=1), at(12.0, mesh=WALL, tag=2)]
    points, tags = shot(things, EXACT)
    ahead = np.abs(points[:, 0]) < points[:, 1]
    share = (tags[ahead] == 1).mean()
    assert set(tags.tolist()) == {1, 2}
    # two faces of the pane: 0.3 + 0.7 * 0.3
    assert share == pytest.approx(0.51, abs=0.02)


def test_intensity_follows_albedo_incidence_and_range() -> None:
    bright, dark = ((0.8, 0.8, 0.8), (0.02, 0.02, 0.02))
    block = at(10.0, 0.0, 1.8, mesh=PAINTED)
    mean = [shot([replace(block, paint=p)])[0][:, 3].mean() for p in (bright, dark)]
    assert mean[0] > 20 * mean[1]
    near, far = (shot([at(x, mesh=WALL)], EXACT)[0][:, 3].max() for x in (5.0, 60.0))
    assert near > 2 * far
    points, _ = shot([at(0, mesh=PLANE)], EXACT)
    steep, flat = (points[points[:, 4] == ring, 3].mean() for ring in (0, 18))
    assert steep > 4 * flat
    assert points[:, 3].min() >= 0
    assert points[:, 3].max() <= 255


def test_reach_and_blind_zone() -> None:
    things = [at(0, mesh=PLANE)]
    distance = np.linalg.norm(shot(things, replace(EXACT, reach=20.0))[0][:, :3], axis=1)
    assert distance.max() < 20.0
    assert distance.max() > 15.0
    distance = np.linalg.norm(shot(things, replace(EXACT, blind=10.0))[0][:, :3], axis=1)
    assert distance.min() > 10.0


def test_noise_and_losses() -> None:
    things = [at(0, mesh=PLANE)]
    lidar = replace(EXACT, noise=0.05)
    exact, noisy = (np.linalg.norm(shot(things, x)[0][:, :3], axis=1) for x in (EXACT, lidar))
    assert (noisy - exact).std() == pytest.approx(0.05, rel=0.05)
    assert abs((noisy - exact).mean()) < 0.002
    kept = len(shot(things, replace(EXACT, lost=0.3))[0]) / len(exact)
    assert kept == pytest.approx(0.7, abs=0.02)
    far, near = (len(shot([at(x, mesh=WALL)], replace(EXACT, faint=1e-4))[0]) for x in (60.0, 10.0))
    full = [len(shot([at(x, mesh=WALL)], EXACT)[0]) for x in (60.0, 10.0)]
    assert near > 0.95 * full[1]
    assert far < 0.85 * full[0]


def test_the_same_key_gives_the_same_bytes() -> None:
    things = [at(0, mesh=PLANE, tag=9)] + [at(6 + 3 * n, n - 2, 0.8, mesh=CAR, tag=n + 1, yaw=n) for n in range(5)]
    lidar = replace(HDL32E, azimuths=300)
    first = sweep(stage(), lidar, ego(), things, key=(3, "a"))
    again = sweep(stage(), lidar, ego(), things[::-1], key=(3, "a"))
    other = sweep(stage(), lidar, ego(), things, key=(3, "b"))
    fresh = RenderScene(None, [plane(), *[make_body("car", generator=generator("lidar"), detail=1)] * 3])
    anew = sweep(fresh, lidar, ego(), [replace(t, mesh=min(t.mesh, 1)) for t in things], key=(3, "a"))
    for a, b, c in zip(first, again, anew, strict=True):
        assert a.tobytes() == b.tobytes() == c.tobytes()
    assert first[0].tobytes() != other[0].tobytes()
    assert (first[0].dtype, first[1].dtype) == (np.float32, np.int32)


def test_the_noise_of_a_beam_does_not_depend_on_the_rest() -> None:
    lidar = replace(HDL32E, azimuths=300)
    ground = at(0, mesh=PLANE, tag=9)
    alone, _ = sweep(stage(), lidar, ego(), [ground], key=(1,))
    points, tags = sweep(stage(), lidar, ego(), [ground, at(9.0, mesh=BLOCK)], key=(1,))
    rows = {p.tobytes() for p in alone}
    assert all(p.tobytes() in rows for p in points[tags == 9])


def test_motion_of_the_ego_is_taken_out() -> None:
    things = [at(20.0, mesh=WALL, tag=3), at(0, mesh=PLANE, tag=9)]
    pose, past = ego(1.0, 0.3, 0.05), ego(0.0, 0.0, 0.0)
    points, tags = sweep(stage(), EXACT, pose, things, key=(1,), motion=True, previous=(past, things))
    world = in_world(points, pose)
    face = (tags == 3) & (np.abs(world[:, 1]) < 29.9)
    assert np.abs(world[face, 0] - 19.5).max() < 2e-4
    assert np.abs(world[tags == 9, 2]).max() < 2e-4
    still, _ = sweep(stage(), EXACT, pose, things, key=(1,))
    same, _ = sweep(stage(), EXACT, pose, things, key=(1,), motion=True, previous=(pose, things))
    assert np.allclose(still, same, atol=1e-4)


def test_moving_things_are_smeared() -> None:
    speed = 30.0
    now = at(20.0, mesh=WALL, tag=3)
    before = replace(now, pose=at(20.0 - speed * EXACT.period, mesh=WALL).pose)
    points, _ = sweep(stage(), EXACT, ego(), [now], key=(1,), motion=True, previous=(ego(), [before]))
    share = (np.arctan2(points[:, 0], points[:, 1]) + np.pi) / (2 * np.pi)  # of the turn, when the beam was fired
    world = in_world(points)
    face = np.abs(world[:, 1]) < 29.9
    assert np.abs(world[:, 0] - (19.5 - speed * EXACT.period * (1 - share)))[face].max() < 1e-3
    # what has no tag, or was not there before, rests
    for old in ([replace(before, tag=0)], []):
        untagged = replace(now, tag=0 if old else 3)
        points, _ = sweep(stage(), EXACT, ego(), [untagged], key=(1,), motion=True, previous=(ego(), old))
        world = in_world(points)
        assert np.abs(world[np.abs(world[:, 1]) < 29.9, 0] - 19.5).max() < 1e-4


def test_an_empty_scene_returns_nothing() -> None:
    for things in ([], [at(500.0, mesh=CAR)]):
        points, tags = shot(things, HDL32E)
        assert points.shape == (0, 5)
        assert tags.shape == (0,)


def test_bad_input_is_one_line() -> None:
    nowhere = np.full((4, 4), np.nan)
    for lidar, pose, things, words in (
        (replace(EXACT, beams=np.zeros(0)), ego(), [], "at least one beam"),
        (replace(EXACT, azimuths=0), ego(), [], "one azimuth"),
        (replace(EXACT, reach=-1.0), ego(), [], "reach"),
        (EXACT, nowhere, [], "pose of the ego"),
        (EXACT, ego(), [SceneObject(99, ego(), tag=4)], "mesh 99"),
        (EXACT, ego(), [SceneObject(0, nowhere, tag=4)], "thing 4"),
    ):
        with pytest.raises(ConfigError, match=words) as caught:
            sweep(stage(), lidar, pose, things, key=(1,))
        assert "\n" not in str(caught.value)
    with pytest.raises(ConfigError, match="before"):
        sweep(stage(), EXACT, ego(), [], key=(1,), motion=True)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31), st.integers(0, 12), st.integers(0, 400))
def test_points_in_boxes_equal_a_plain_count(seed: int, n: int, p: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-5, 5, (p, 5))
    rotation = rng.normal(size=(n, 4))
    size = rng.uniform(0.2, 6, (n, 3))
    boxes = WorldBoxes(rng.uniform(-6, 6, (n, 3)), size, rotation, np.zeros((n, 3)))
    counts = points_in_boxes(points, boxes)
    assert counts.dtype == np.int32
    for row in range(n):
        local = (points[:, :3] - boxes.centre[row]) @ quaternion_to_matrix(rotation[row])
        assert counts[row] == (np.abs(local) <= size[row] / 2).all(1).sum()


def test_points_in_boxes_at_the_surface() -> None:
    boxes = WorldBoxes(np.array([[1.0, 2, 3]]), np.array([[4.0, 2, 6]]), np.array([[1.0, 0, 0, 0]]), np.zeros((1, 3)))
    points = np.array([[3.0, 3, 6], [3.001, 3, 6], [-1, 1, 0], [1, 3.001, 3], [np.nan, 2, 3]])
    assert points_in_boxes(points, boxes).tolist() == [2]
    assert points_in_boxes(np.zeros((0, 3)), boxes).tolist() == [0]
    assert points_in_boxes(points, TrackedBoxes.empty()).shape == (0,)
