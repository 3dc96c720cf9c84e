"""Visibility, shading and textures of the camera."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from ssad.core.errors import ConfigError
from ssad.core.frames import FORWARD, Camera
from ssad.rendering.camera.kernels import raster
from ssad.rendering.camera.render import PLAIN, SceneWeather, View, render, response, scene_light
from ssad.rendering.camera.scene import RenderScene, SceneObject
from ssad.rendering.meshes import mesh as meshes
from ssad.rendering.meshes.mesh import Material, build

GREY = Material("grey", (0.4, 0.4, 0.4), specular=0.0, gloss=0.0)
PAINT = Material("paint", (0.5, 0.5, 0.5), specular=0.0, gloss=0.0, paint=True)
CAMERA = Camera(64, 48, np.array([[50.0, 0, 32.0], [0, 50.0, 24.0], [0, 0, 1]]))
NOON = SceneWeather(sun_height=1.2, sun_heading=2.0, clouds=0.0)


def visible(
    vertices: Any, faces: Any, *, width: int = 128, height: int = 96, scale: int = 2, lanes: int = 1, twig: int = 0
) -> tuple[Any, Any]:
    """Face [height, width] (-1 none) and inverse depth of the visibility pass for a camera at the origin."""
    count = len(faces)
    samples = wp.zeros((1, height, width), dtype=wp.uint64, device="cpu")

    def on(values: Any, dtype: Any) -> Any:
        return wp.array(values, dtype=dtype, device="cpu")

    inputs = [
        on(vertices, wp.vec3),
        on(faces, wp.int32),
        on(np.full(count, twig), wp.int32),
        on(np.arange(count), wp.int32),
        on([0, count], wp.int32),
        on([0], wp.int32),
        on([0], wp.int32),
        on(np.eye(4)[None], wp.mat44),
        on([[60, 60, 31.5, 23.5]], wp.vec4),
        0.2,
        float(scale),
        0,
        lanes,
        1e30,
    ]
    owners = wp.empty(count, dtype=wp.vec2i, device="cpu")
    large, many = wp.empty(1, dtype=raster.Triangle, device="cpu"), wp.zeros(1, dtype=int, device="cpu")
    outputs = [owners, samples, large, many]
    wp.launch(raster.fill, dim=(1, lanes), inputs=inputs, outputs=outputs, device="cpu")
    keys = samples.numpy()[0]
    slot = 0xFFFFFFFF - (keys & np.uint64(0xFFFFFFFF)).astype(np.int64)
    near = (keys >> np.uint64(32)).astype(np.uint32).view(np.float32)
    return np.where(keys > 0, slot // 2, -1), np.where(keys > 0, near, 0)


def test_a_scene_has_leaves_of_one_size_on_cards_of_twigs_and_no_others() -> None:
    card = np.array([[-0.65, 0.0, 0.0], [0.0, 0.0, 2.6], [0.65, 0.0, 0.0]])
    bodies = [
        build(size * card, [[0, 1, 2]], materials=[replace(GREY, name=name)], material=[0])
        for size, name in ((1.0, "twigs"), (0.5, "twigs"), (1.0, "grey"))
    ]
    large, small, solid = RenderScene(None, bodies).twigs.numpy().tolist()
    assert (large % 64, large // 64 % 64) == (20, 10)
    assert (small % 64, small // 64 % 64) == (10, 5)
    assert large // 4096 != small // 4096
    assert solid == 0


def test_leaves_are_cut_out_of_a_card_and_keep_its_depth_and_form_in_perspective() -> None:
    face = np.array([[0, 1, 2]])
    card = np.array([[-0.4, 0.5, 1.0], [0.0, -0.5, 1.4], [0.4, 0.5, 1.0]], np.float32)[::-1].copy()
    twig = 10 + 64 * 8 + 4096 * 5
    solid, solid_depth = visible(card, face)
    leaves, depth = visible(card, face, twig=twig)
    assert not ((leaves == 0) & (solid < 0)).any()
    assert 0.3 < (leaves == 0).sum() / (solid == 0).sum() < 0.8
    np.testing.assert_array_equal(depth[leaves == 0], solid_depth[leaves == 0])
    other, _ = visible(card, face, twig=twig + 4096)
    assert (other != leaves).any()
    # The same card at half the distance and half the size has the same image.
    np.testing.assert_array_equal(visible(0.5 * card, face, twig=twig)[0], leaves)
    # A tip three times as far away on the same ray: the outline stays, leaves move, as parts of a plane in perspective.
    tilted = card.copy()
    tilted[1] *= 3.0
    np.testing.assert_array_equal(visible(tilted, face)[0], solid)
    assert ((visible(tilted, face, twig=twig)[0] == 0) != (leaves == 0)).mean() > 0.02


def cast(vertices: Any, faces: Any, *, width: int = 128, height: int = 96, scale: int = 2) -> tuple[Any, Any]:
    """The same by casting a ray through each sample, in double precision."""
    y, x = np.mgrid[0:height, 0:width]
    ray = np.stack([((x + 0.5) / scale - 0.5 - 31.5) / 60, ((y + 0.5) / scale - 0.5 - 23.5) / 60, np.ones_like(x)], -1)
    best, owner = np.zeros((height, width)), np.full((height, width), -1)
    for f, face in enumerate(faces):
        a, b, c = vertices[face].astype(float)
        normal = np.cross(b - a, c - a)
        slope = ray @ normal
        with np.errstate(all="ignore"):
            z = (a @ normal) / slope
            p = z[..., None] * ray - a
            sb = np.cross(p, c - a) @ normal / (normal @ normal)
            sc = np.cross(b - a, p) @ normal / (normal @ normal)
            hit = (slope < 0) & (z > 0.2) & (sb >= 0) & (sc >= 0) & (sb + sc <= 1) & (1 / z > best)
        owner[hit], best[hit] = f, 1 / z[hit]
    return owner, best


@given(st.integers(0, 10_000))
@settings(max_examples=25, deadline=None)
def test_visibility_equals_ray_casting(seed: int) -> None:
    rng = np.random.default_rng(seed)
    vertices = rng.uniform(-4, 4, (90, 3)).astype(np.float32)
    vertices[:, 2] += 3  # some lie behind the camera, some across the near plane
    faces = np.arange(90).reshape(30, 3).astype(np.int32)
    owner, near = visible(vertices, faces, lanes=1 + seed % 3)
    expected, depth = cast(vertices, faces)
    same = owner == expected
    assert same.mean() > 0.998, "but for samples on an edge"
    both = same & (owner >= 0)
    assert np.abs(near - depth)[both].max(initial=0) < 1e-3, "slivers seen edge-on lose digits"


def test_neighbouring_triangles_leave_no_gap_and_do_not_overlap() -> None:
    rng = np.random.default_rng(3)
    grid = np.stack(np.meshgrid(np.linspace(-6, 6, 9), np.linspace(-5, 5, 9)), -1).astype(np.float32)
    grid[1:-1, 1:-1] += rng.uniform(-0.4, 0.4, (7, 7, 2)).astype(np.float32)
    vertices = np.concatenate([grid.reshape(-1, 2), 4 + rng.uniform(-0.2, 0.2, (81, 1))], 1).astype(np.float32)
    faces = meshes.grid_faces(9, 9)
    owner, _ = visible(vertices, faces)
    turned, _ = visible(vertices, faces[:, [0, 2, 1]])
    full = owner if (owner >= 0).mean() > 0.5 else turned
    assert (full >= 0).all()
    assert np.minimum((owner >= 0).mean(), (turned >= 0).mean()) == 0, "the other side is turned away"


def ground(size: float = 60.0) -> Any:
    """A square on the ground."""
    vertices = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float) * size
    return build(vertices, np.array([[0, 1, 2], [0, 2, 3]]), materials=(GREY,))


def cube(size: tuple[float, float, float] = (4.0, 2.0, 1.5)) -> Any:
    """A painted box on the ground with one panel."""
    return meshes.box(size, material=PAINT, centre=(0.0, 0.0, size[2] / 2), panel="body")


def place(x: float, y: float, z: float = 0.0) -> Any:
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


@pytest.fixture(scope="module")
def stage() -> RenderScene:
    return RenderScene(None, [ground(), cube()])


def scene(*things: SceneObject, weather: SceneWeather = NOON) -> View:
    return View(CAMERA, FORWARD, (SceneObject(0, np.eye(4)), *things), weather)


def test_depth_tags_and_the_nuscenes_camera_model(stage: RenderScene) -> None:
    picture = render(stage, [scene(SceneObject(1, place(12.0, 0.5), tag=7))], quality=PLAIN)
    tag, depth = picture.tag[0], picture.depth[0]
    assert (tag[:10] == -1).all()
    assert np.isinf(depth[:10]).all()
    rows = np.arange(36, 48)
    expected = 1.5 * 50.0 / (rows + 0.5 - 24.0)  # the ground under a level camera 1.5 m up
    assert depth[rows, 2] == pytest.approx(expected, rel=1e-4)
    assert (tag[rows, 2] == 0).all()
    # the near face of the box: depth and extent by the pinhole model of nuScenes (u = fx X / Z + cx)
    z = 10.0 - FORWARD[0, 3]
    left, right = 32.0 - 50 * 1.5 / z, 32.0 + 50 * 0.5 / z
    columns = np.flatnonzero((tag == 7).any(0))
    assert columns[0] == pytest.approx(left, abs=1.0)
    assert columns[-1] + 1 == pytest.approx(right, abs=1.0)
    assert np.median(depth[tag == 7]) == pytest.approx(z, rel=1e-4)


def test_a_view_does_not_depend_on_its_batch(stage: RenderScene) -> None:
    views = [
        scene(
            SceneObject(1, place(9.0 + k, k - 1.0), (0.1 * k, 0.3, 0.2), tag=k + 1),
            weather=replace(NOON, sun_heading=float(k)),
        )
        for k in range(3)
    ]
    together = render(stage, views)
    for k in range(3):
        alone = render(stage, [views[k]])
        assert (alone.image[0] == together.image[k]).all()
        assert (alone.tag[0] == together.tag[k]).all()


def test_things_throw_shadows_and_the_sun_lights_what_faces_it(stage: RenderScene) -> None:
    weather = SceneWeather(
        sun_height=0.6, sun_heading=np.pi / 2, clouds=0.0
    )  # from the left: the shadow falls to the right
    with_box = render(stage, [scene(SceneObject(1, place(12.0, 0.0), tag=1), weather=weather)])
    without = render(stage, [scene(weather=weather)])
    same = with_box.tag[0] == without.tag[0]
    ratio = with_box.radiance[0].mean(-1) / np.maximum(without.radiance[0].mean(-1), 1e-6)
    dark = same & (without.tag[0] == 0) & (ratio < 0.7)
    assert dark.sum() > 10
    _, columns = np.nonzero(dark)
    assert columns.mean() > 33, "to the right of the box"
    light, _ = scene_light(weather)
    assert ratio[dark].min() > 0.1, "the sky still lights it"
    assert light[0][1] > 0.8


def test_coverage_is_averaged_over_samples(stage: RenderScene) -> None:
    """The mean radiance hardly changes with the number of samples; edges get between values."""
    view = scene(SceneObject(1, place(9.0, 0.3), (0.9, 0.1, 0.1), tag=1))
    one, two, four = (render(stage, [view], scale=s, quality=PLAIN).radiance[0] for s in (1, 2, 4))
    assert two.mean() == pytest.approx(four.mean(), rel=0.01)
    assert np.abs(two - four).mean() < np.abs(one - four).mean()


def test_weather_and_hour_change_the_picture_as_they_should(stage: RenderScene) -> None:
    view = scene(SceneObject(1, place(12.0, 0.0), (0.6, 0.1, 0.1), tag=1))
    clear = render(stage, [view])
    foggy = render(stage, [replace(view, weather=replace(NOON, fog=0.05))])
    night = render(stage, [replace(view, weather=replace(NOON, sun_height=-0.3))])
    red = clear.tag[0] == 1
    contrast = lambda p: float(np.ptp(p.image[0][red].astype(float).mean(0)))  # noqa: E731
    assert contrast(foggy) < 0.7 * contrast(clear)
    assert night.radiance.mean() < 0.2 * clear.radiance.mean()
    assert (np.diff(response().astype(int)) >= 0).all()


# ---------------------------------------------------------------- bad input


def test_wrong_use_is_refused_in_one_line(stage: RenderScene) -> None:
    view = scene()
    nan = FORWARD.copy()
    nan[0, 3] = np.nan
    flat = replace(CAMERA, intrinsic=np.diag([0.0, 50.0, 1.0]))
    for views in (
        [],
        [view, replace(view, camera=Camera.typical(32, 24))],
        [replace(view, pose=nan)],
        [replace(view, camera=flat)],
    ):
        with pytest.raises(ConfigError) as error:
            render(stage, views)
        assert "\n" not in str(error.value)
    with pytest.raises(ConfigError):
        RenderScene(None, [])


def test_an_empty_scene_is_sky(stage: RenderScene) -> None:
    picture = render(stage, [View(CAMERA, FORWARD)])
    assert (picture.tag == -1).all()
    assert np.isinf(picture.depth).all()
    assert picture.image.std() > 0
