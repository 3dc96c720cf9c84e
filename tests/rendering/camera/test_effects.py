"""Effects of the rendering: mirrors, wet roads, penumbras and haze against closed forms."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from ssad.core.errors import ConfigError
from ssad.core.frames import FORWARD, Camera
from ssad.core.seeding import generator
from ssad.rendering.bodies import make_body
from ssad.rendering.camera.effects import ALL_EFFECTS, DEFAULT_EFFECTS, EFFECTS, NO_EFFECTS, select_effects
from ssad.rendering.camera.kernels.sky import MOLECULES
from ssad.rendering.camera.lamps import own_lamps
from ssad.rendering.camera.render import PLAIN, VISUAL_RANGE, RenderQuality, SceneWeather, View, render, scene_light
from ssad.rendering.camera.scene import LampSignal, RenderScene, SceneObject, TextureLayer
from ssad.rendering.camera.sensor import SensorModel
from ssad.rendering.camera.texture import paint_mask, retexture, texture_taps
from ssad.rendering.meshes import mesh as meshes
from ssad.rendering.meshes.mesh import Material, build
from ssad.rendering.street import cached_street

GREY = Material("grey", (0.4, 0.4, 0.4), specular=0.0, gloss=0.0)
PAINT = Material("paint", (0.5, 0.5, 0.5), specular=0.0, gloss=0.85, paint=True)
MIRROR = Material("mirror", (0.0, 0.0, 0.0), specular=1.0, gloss=1.0)
RED = Material("red", (0.6, 0.1, 0.1), specular=0.0, gloss=0.0, emission=1.0)
BLUE = Material("blue", (0.1, 0.1, 0.6), specular=0.0, gloss=0.0, emission=1.0)
GROUND, CARD, GLASS_WALL, RED_WALL, BLUE_WALL, POST, CUBE = range(7)
CAMERA = Camera(64, 48, np.array([[50.0, 0, 32.0], [0, 50.0, 24.0], [0, 0, 1]]))
NOON = SceneWeather(sun_height=1.2, sun_heading=2.0, clouds=0.0)
NIGHT = SceneWeather(sun_height=-0.5, clouds=0.0)


def place(x: float, y: float, z: float = 0.0) -> Any:
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


def only(*names: str) -> RenderQuality:
    return RenderQuality(effects=select_effects(*names))


@pytest.fixture(scope="module")
def scene() -> RenderScene:
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
    ground = build(square * 60, np.array([[0, 1, 2], [0, 2, 3]]), materials=(GREY,))
    card = meshes.box((8.0, 8.0, 0.02), material=GREY, centre=(0.0, 4.0, 1.0))  # its edge lies along x
    wall = (0.2, 20.0, 20.0)
    walls = [meshes.box(wall, material=material, centre=(0.0, 0.0, 0.0)) for material in (MIRROR, RED, BLUE)]
    post = meshes.box((0.3, 3.0, 4.0), material=RED, centre=(0.0, 0.0, 2.0))
    cube = meshes.box((4.0, 2.0, 1.5), material=PAINT, centre=(0.0, 0.0, 0.75), panel="body")
    return RenderScene(None, [ground, card, *walls, post, cube])


def view(*things: SceneObject, weather: SceneWeather = NOON, **other: Any) -> View:
    return View(CAMERA, FORWARD, (SceneObject(GROUND, np.eye(4)), *things), weather, **other)


def test_effects_have_names(scene: RenderScene) -> None:
    assert select_effects() == NO_EFFECTS == PLAIN.effects
    assert select_effects("all") == ALL_EFFECTS >= DEFAULT_EFFECTS == RenderQuality().effects
    assert select_effects("haze", "default") == DEFAULT_EFFECTS | {"haze"}
    assert render(scene, [view()], quality=only("haze")).effects == {"haze"}
    for wrong in (lambda: select_effects("fog lamp"), lambda: RenderQuality(effects=frozenset({"fog lamp"}))):
        with pytest.raises(ConfigError, match=r"unknown effect of the rendering 'fog lamp'; there are .*haze"):
            wrong()
    assert all(effect.summary.endswith(".") and name == effect.name for name, effect in EFFECTS.items())


@pytest.mark.parametrize(
    ("effect", "weather"),
    [
        ("reflections", NOON),  # matt surfaces
        ("wet-reflections", NOON),  # a dry road
        ("soft-shadows", replace(NOON, sun_height=-0.3)),  # no sun
    ],
)
def test_an_effect_changes_nothing_where_it_has_no_cause(
    scene: RenderScene, effect: str, weather: SceneWeather
) -> None:
    seen = view(SceneObject(CARD, place(9.0, 0.0)), weather=weather)
    plain, changed = (render(scene, [seen], quality=only(*names)) for names in ((), (effect,)))
    for name in ("radiance", "image", "tag", "depth"):
        assert (getattr(plain, name) == getattr(changed, name)).all(), name


def test_a_mirror_shows_the_wall_behind_the_camera(scene: RenderScene) -> None:
    """A mirror 5 m ahead, a wall 5 m behind that is red to the left of 3 m and blue to the right of it."""
    eye = FORWARD[:3, 3]
    walls = (
        SceneObject(GLASS_WALL, place(eye[0] + 5.1, eye[1], eye[2])),
        SceneObject(RED_WALL, place(eye[0] - 5.1, eye[1] + 10.0 + 3.0, eye[2])),
        SceneObject(BLUE_WALL, place(eye[0] - 5.1, eye[1] - 10.0 + 3.0, eye[2])),
    )
    seen = view(*walls, weather=NIGHT)
    picture = render(scene, [seen], quality=only("reflections")).radiance[0]
    colours = picture[2:27]  # above the ground
    # The ray meets the mirror at a third of the edge's offset, as the path is three times as long.
    edge = 32.0 - 50.0 * (3.0 / 3.0) / 5.0
    left, right = colours[:, : int(edge) - 4].reshape(-1, 3), colours[:, int(edge) + 4 :].reshape(-1, 3)
    assert len(left) > 50
    assert left == pytest.approx(np.tile((0.6, 0.1, 0.1), (len(left), 1)), abs=0.03)
    assert right == pytest.approx(np.tile((0.1, 0.1, 0.6), (len(right), 1)), abs=0.03)
    middle = colours[20:].mean(0)
    crossing = np.flatnonzero(middle[:, 0] > middle[:, 2])[-1] + 1
    assert crossing == pytest.approx(edge, abs=2.0)
    assert picture.max() <= 0.62, "a mirror adds no light"


def test_a_wet_road_shows_what_stands_on_it(scene: RenderScene) -> None:
    seen = view(SceneObject(POST, place(10.0 + FORWARD[0, 3], 0.0)), weather=replace(NIGHT, wet=1.0))
    dull, wet = (render(scene, [seen], quality=only(*names)).radiance[0] for names in ((), ("wet-reflections",)))
    change = (wet - dull)[:, :, 0] - (wet - dull)[:, :, 2]
    foot = 24.0 + 50.0 * 1.5 / 9.85
    rows, columns = np.nonzero(change > 0.01)
    assert len(rows) > 30
    assert rows.min() >= foot - 1.0, "below its foot alone"
    half = 50.0 * 1.5 / 9.85
    assert columns.min() >= 32 - half - 1.5
    assert columns.max() <= 32 + half + 0.5
    # The mirror image begins at the foot, and water mirrors less than all light.
    assert change[int(foot) + 1, 30:34].min() > 0.01
    assert wet.max() <= max(dull.max(), 0.62)
    blurred = np.abs(np.diff(change[int(foot) + 2 :, 32])).max()
    assert blurred < 0.5 * change[:, 32].max(), "without steps"


def penumbra(scene: RenderScene, height: float) -> float:
    """Width (m, across the light) from 10 to 90 % of the sun, of the shadow of an edge at a height in m."""
    sun = SceneWeather(sun_height=np.pi / 4, sun_heading=0.0, clouds=0.0)  # the sun stands above the edge's line
    camera = Camera(8, 160, np.array([[320.0, 0, 4.0], [0, 320.0, 80.0], [0, 0, 1]]))
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = -height, 0.0, 1.0  # 1 m above the edge of the shadow; a pixel is 1 / 320 m
    objects = (SceneObject(GROUND, np.eye(4)), SceneObject(CARD, place(0.0, 0.0, height - 1.0)))
    seen = View(camera, pose, objects, sun, focus=(-height, 0.0))
    surface = render(scene, [seen], quality=replace(only("soft-shadows"), contact=False), surface=True).surface
    assert surface is not None
    light = surface.irradiance[0, :, 4, 0].astype(float)
    share = (light - light.min()) / np.ptp(light)
    inside = np.flatnonzero((share > 0.1) & (share < 0.9))
    assert np.ptp(light) > 0.5 * scene_light(sun)[0][1][0] * np.sin(np.pi / 4), "from full sun to none"
    return float(len(inside)) / 320.0


def test_the_penumbra_grows_with_the_distance_of_the_occluder(scene: RenderScene) -> None:
    near, far = penumbra(scene, 2.0), penumbra(scene, 11.0)
    assert far > 1.6 * near
    # The sun spans 0.0093 rad; 80 % of a disc's penumbra is about 0.7 of its width.
    distance = 11.0 / np.sin(np.pi / 4)
    assert 0.4 * 0.0093 * distance < far < 1.1 * 0.0093 * distance


def test_haze_fades_to_the_horizon_by_the_visual_range(scene: RenderScene) -> None:
    clear, hazy = (render(scene, [view()], quality=only(*names)) for names in ((), ("haze",)))
    is_ground = clear.tag[0] == 0
    rows, columns = np.mgrid[0:48, 0:64] + 0.5
    slant = np.sqrt(1.0 + ((rows - 24.0) / 50.0) ** 2 + ((columns - 32.0) / 50.0) ** 2)
    distance = (clear.depth[0] * slant)[is_ground, None].astype(float)
    assert distance.max() > 40.0
    transmission = np.exp(-(3.912 / VISUAL_RANGE + np.array([*MOLECULES])) * distance)
    horizon = np.array(scene_light(NOON)[0][3])
    pure = is_ground & (clear.radiance[0] == clear.radiance[0][47, 32]).all(-1)  # no mixture with the sky at an edge
    expected = clear.radiance[0][is_ground] * transmission + horizon * (1.0 - transmission)
    inside = np.isin(np.flatnonzero(is_ground), np.flatnonzero(pure))
    assert inside.sum() > 100
    assert hazy.radiance[0][is_ground][inside] == pytest.approx(expected[inside], rel=1e-4)
    assert (hazy.radiance[0][~is_ground] == clear.radiance[0][~is_ground]).all(), "the sky has its own haze"


def test_textures_stay_linear_under_all_effects(scene: RenderScene) -> None:
    """A texture of one colour is a paint, whatever the body mirrors."""
    colour = (0.7, 0.2, 0.4)

    def seen(paint: tuple[float, float, float], *layers: TextureLayer) -> View:
        return view(SceneObject(CUBE, place(7.0, 0.4), paint, 1, layers))

    painted = render(scene, [seen(colour)], quality=only("all"))
    textured = render(scene, [seen((0.5, 0.5, 0.5), TextureLayer(0))], quality=only("all"))
    taps = texture_taps(textured, 16, dtype=torch.float64)
    assert len(taps.pixel) > 50
    texture = torch.tensor(colour, dtype=torch.float64)[:, None, None].expand(3, 16, 16)
    out = retexture(taps, texture, torch.tensor(textured.radiance, dtype=torch.float64))
    body = painted.tag[0] == 1
    difference = np.abs(out.numpy() - painted.radiance)[0][body]
    # The probe shows the object itself, black or painted: its own mirror image is not part of the gradient.
    assert np.median(difference) < 1e-5


@pytest.mark.parametrize("weather", [replace(NOON, wet=0.8), NIGHT], ids=["wet day", "night"])
def test_a_texture_of_one_colour_is_a_paint_in_a_street(weather: SceneWeather) -> None:
    """Under all effects, also where head lamps shine on the lamps of the car that wears it."""
    pose = np.eye(4)
    pose[:2, 3] = cached_street("Twinford").lamps[0, :2] + [0.0, 3.0]
    body, colour = make_body("car", style="sedan", generator=generator("effects")), (0.7, 0.2, 0.4)
    scene = RenderScene(cached_street("Twinford"), [body])

    def seen(paint: tuple[float, float, float], *layers: TextureLayer) -> View:
        car = SceneObject(0, pose @ place(8.0, 0.3), paint, 1, layers, signals=LampSignal.BRAKE)
        return View(CAMERA, pose @ place(0.0, 0.0) @ FORWARD, (car,), weather, lamps=own_lamps(pose, weather))

    painted = render(scene, [seen(colour)], quality=only("all"))
    textured = render(scene, [seen((0.5, 0.5, 0.5), TextureLayer(0))], quality=only("all"))
    taps = texture_taps(textured, 16, mask=paint_mask(body, (16, 16)))
    texture = torch.tensor(colour)[:, None, None].expand(3, 16, 16)
    out = retexture(taps, texture, torch.tensor(textured.radiance)).numpy()
    is_body = painted.tag == 1
    assert is_body.sum() > 100
    assert out[is_body] == pytest.approx(painted.radiance[is_body], rel=1e-4, abs=1e-4)
    # Wet roads mirror a grey in place of the texture.
    assert np.abs(out - painted.radiance).max() < 0.02


def test_views_of_one_scene_do_not_share_what_they_mirror(scene: RenderScene) -> None:
    """In a scene without a street each place of a camera has a probe of its own, though the objects are the same."""
    near = view(SceneObject(CUBE, place(7.0, 0.4), (0.5, 0.5, 0.5), 1), SceneObject(RED_WALL, place(7.0, 20.0)))
    far = replace(near, pose=place(-3.0, 2.0) @ FORWARD)
    together = render(scene, [near, far], quality=only("all"))
    for index, alone in enumerate((near, far)):
        assert (render(scene, [alone], quality=only("all")).radiance[0] == together.radiance[index]).all()


def test_a_picture_of_a_street_depends_on_its_view_alone() -> None:
    """Views in one square share a probe, in whatever order they are rendered, by day, by night and on wet roads."""
    street = cached_street("Twinford")
    x, y = street.lamps[0, :2] + np.array([0.0, 3.0])
    day, night = SceneWeather(0.6, 0.7, 0.2), SceneWeather(-0.3, clouds=0.9, wet=0.8)
    views = []
    for shift, weather in ((0.0, day), (2.0, day), (30.0, replace(day, wet=0.9)), (2.0, night), (2.0, NIGHT)):
        pose = FORWARD.copy()
        pose[:3, 3] = x + shift, y, 1.5
        car = SceneObject(0, pose @ place(9.0, 0.5, -1.5), (0.6, 0.1, 0.2), 1, signals=LampSignal.BRAKE)
        own = own_lamps(pose @ place(2.0, 0.0, -1.5), weather)
        views.append(View(CAMERA, pose, (car,), weather, SensorModel(noise=0.012), len(views), own))
    body = make_body("car", style="sedan", generator=generator("effects"))
    together = render(RenderScene(street, [body]), views, quality=only("all"))
    other = RenderScene(street, [body])
    for index in (4, 2, 0, 3):
        alone = render(other, [views[index]], quality=only("all"))
        assert (alone.radiance[0] == together.radiance[index]).all()
        assert (alone.image[0] == together.image[index]).all()
    assert (render(other, views, quality=only()).radiance != together.radiance).any((1, 2, 3)).all()
