"""Lamps, shadows near things, and what a picture says of its surfaces."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ssad.core.colours import LUMINANCE
from ssad.core.errors import ConfigError
from ssad.core.frames import FORWARD, Camera
from ssad.core.seeding import generator
from ssad.rendering.bodies import make_body
from ssad.rendering.camera.effects import ALL_EFFECTS, NO_EFFECTS, select_effects
from ssad.rendering.camera.lamps import (
    BRAKE_RATIO,
    NIGHT_LUX,
    SceneLamp,
    lamp_strength,
    lit_circle,
    low_beam,
    nearby_lights,
    own_lamps,
)
from ssad.rendering.camera.render import PLAIN, RenderQuality, SceneWeather, View, render, scene_light
from ssad.rendering.camera.scene import LampSignal, RenderScene, SceneObject, collect_objects
from ssad.rendering.camera.texture import retexture, texture_taps
from ssad.rendering.meshes import mesh as meshes
from ssad.rendering.meshes.mesh import Material, build

GREY = Material("grey", (0.4, 0.4, 0.4), specular=0.0, gloss=0.0)
CAMERA = Camera(96, 96, np.array([[96.0, 0, 48.0], [0, 96.0, 48.0], [0, 0, 1]]))
NIGHT = SceneWeather(sun_height=-0.5, clouds=0.0)
DOWN = np.diag([1.0, -1.0, -1.0, 1.0])


def at(x: float, y: float, z: float, turn: Any = None) -> Any:
    pose = np.eye(4) if turn is None else np.array(turn, float)
    pose[:3, 3] = x, y, z
    return pose


def ground() -> Any:
    vertices = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float) * 60
    return build(vertices, np.array([[0, 1, 2], [0, 2, 3]]), materials=(GREY,))


@pytest.fixture(scope="module")
def scene() -> RenderScene:
    block = meshes.box((4.0, 2.0, 1.5), material=GREY, centre=(0.0, 0.0, 0.95))  # 0.2 m above the ground
    wall = build(
        np.array([[0, -20, -5], [0, 20, -5], [0, 20, 5], [0, -20, 5]], float),
        np.array([[0, 3, 2], [0, 2, 1]]),
        materials=(GREY,),
    )
    return RenderScene(None, [ground(), block, make_body("car", style="suv", generator=generator("lamps")), wall])


def above(height: float, *things: SceneObject, **other: Any) -> View:
    """A look straight down on the ground."""
    return View(CAMERA, at(0, 0, height, DOWN), (SceneObject(0, np.eye(4)), *things), NIGHT, **other)


def lamp_light(scene: RenderScene, view: View, **options: Any) -> Any:
    """Irradiance / pi [H, W, 3] of the lamps of a view alone."""
    lit, dark = (render(scene, [v], surface=True, **options).surface for v in (view, replace(view, lamps=())))
    assert lit is not None
    assert dark is not None
    return lit.irradiance[0].astype(float) - dark.irradiance[0]


@settings(max_examples=6, deadline=None)
@given(
    height=st.floats(6.0, 14.0),
    across=st.floats(0.2, 0.7),
    down=st.floats(0.2, 0.7),
    soft=st.floats(0.0, 1.0),
    square=st.booleans(),
    tilt=st.floats(-0.2, 0.2),
)
def test_the_power_of_a_lamp_is_what_arrives(
    scene: RenderScene, height: float, across: float, down: float, soft: float, square: bool, tilt: float
) -> None:
    """Over the ground that catches all of it, whatever its height, spread, edge and tilt."""
    cos, sin = np.cos(tilt), np.sin(tilt)
    turned = DOWN @ np.array([[1, 0, 0, 0], [0, cos, -sin, 0], [0, sin, cos, 0], [0, 0, 0, 1.0]])
    lamp = SceneLamp(
        at(1.0, 0.5, height, turned), 7.0, (across, down), (1.0, 0.5, 0.25), soft, square, 1e3, shadows=False
    )
    camera = Camera(480, 480, np.array([[480.0, 0, 240.0], [0, 480.0, 240.0], [0, 0, 1]]))
    light = lamp_light(scene, replace(above(40.0, lamps=(lamp,)), camera=camera), quality=PLAIN)
    pixel = (40.0 / 480.0) ** 2
    assert light.sum((0, 1)) * pixel == pytest.approx(7.0 * np.array([1.0, 0.5, 0.25]), rel=0.04)


def test_a_lamp_fades_with_its_reach_and_needs_sense() -> None:
    pose = at(0, 0, 5, DOWN)
    for wrong in (
        {"power": -1.0},
        {"power": np.nan},
        {"spread": (0.0, 1.0)},
        {"reach": 0.0},
        {"soft": 2.0},
        {"pose": np.eye(3)},
    ):
        with pytest.raises(ConfigError, match="a lamp"):
            SceneLamp(**({"pose": pose, "power": 1.0} | wrong))  # type: ignore[arg-type]


@given(st.integers(0, 10_000), st.booleans(), st.booleans())
@settings(max_examples=40, deadline=None)
def test_what_a_lamp_lights_lies_in_its_circle(seed: int, square: bool, level: bool) -> None:
    """And touches it where the lamp looks along the map and is widest there."""
    draw = np.random.default_rng(seed)
    down, across = np.sort(np.exp(draw.uniform(-2.5, 1.5, 2)))
    pose = np.eye(4)
    turn = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    pose[:3, :3] = turn if level else np.linalg.qr(draw.normal(size=(3, 3)))[0]
    pose[:3, 3] = draw.uniform(-50, 50, 3)
    lamp = SceneLamp(pose, 1.0, (across, down), square=square, reach=draw.uniform(1, 80))
    angle = np.linspace(0, 2 * np.pi, 721)
    rim = np.column_stack([np.cos(angle), np.sin(angle)])
    if square:
        rim = rim / np.abs(rim).max(1)[:, None]
    spot = np.concatenate([share * rim for share in (0.0, 0.3, 0.7, 1.0)]) * [across, down]
    ray = np.column_stack([spot, np.ones(len(spot))]) @ pose[:3, :3].T
    ray *= lamp.reach / np.linalg.norm(ray, axis=1)[:, None]
    lit = pose[:2, 3] + np.concatenate([[np.zeros(2)], ray[:, :2]])
    middle, radius = lit_circle(lamp)
    away = np.hypot(*(lit - middle).T)
    assert away.max() <= radius * (1 + 1e-9)
    assert radius <= lamp.reach
    if level and not square:
        assert away.max() == pytest.approx(radius)


def test_what_stands_in_its_way_keeps_light_off(scene: RenderScene) -> None:
    lamp = SceneLamp(at(0, 0, 8.0, DOWN), 40.0, (1.0, 1.0), reach=100.0)
    view = above(30.0, lamps=(lamp,))
    free = lamp_light(scene, view, quality=PLAIN)
    block = SceneObject(1, np.eye(4), tag=1)
    seen = replace(view, objects=(*view.objects, block))
    hidden = replace(view, objects=(*view.objects, replace(block, is_hidden=True)))
    ghost = lamp_light(scene, hidden, quality=PLAIN)
    assert ghost[47, 47].max() == 0.0, "a hidden thing casts, and the ground below it is seen"
    # the edge of the shadow: the lamp is 8 m up, the top of the block 1.7 m, its half length 2 m
    row = ghost[47, :, 0] / np.maximum(free[47, :, 0], 1e-9)
    edge = 47.5 + 2.0 * 8.0 / (8.0 - 1.7) * 96.0 / 30.0
    assert row[int(edge) - 2] < 0.1
    assert row[int(edge) + 3] > 0.9
    assert lamp_light(scene, seen, quality=PLAIN)[47, 47].min() > 0.5 * free[47, 47].min(), "its top is lit"
    through = replace(hidden, lamps=(replace(lamp, shadows=False),))
    assert lamp_light(scene, through, quality=PLAIN) == pytest.approx(free, abs=1e-6)


def test_a_projected_texture_is_that_of_a_lamp_where_it_is_white(scene: RenderScene) -> None:
    """The picture of a projector is that of a lamp where the texture is white; and the transpose is the gradient."""
    lamp = SceneLamp(at(0, 0, 8.0, DOWN), 40.0, (0.6, 0.6), square=True, reach=100.0)
    things = (SceneObject(0, np.eye(4)), SceneObject(1, at(1.0, 0.3, 0.0), tag=1))
    view = View(CAMERA, at(0, 0, 20.0, DOWN), things, NIGHT)
    white = render(scene, [replace(view, lamps=(lamp,))]).radiance.astype(float)
    picture = render(scene, [replace(view, lamps=(replace(lamp, texture=3),))])
    taps = texture_taps(picture, 32, texture=3, dtype=torch.float64)
    assert len(taps.pixel) > 1000
    radiance = torch.tensor(picture.radiance, dtype=torch.float64)
    lit = retexture(taps, torch.ones(3, 32, 32, dtype=torch.float64), radiance)
    assert lit.numpy() == pytest.approx(white, abs=2e-5)
    half = torch.zeros(3, 32, 32, dtype=torch.float64)
    half[:, :, :16] = 1.0  # u grows to the lamp's right, the picture's right
    gained = (retexture(taps, half, radiance) - radiance).numpy()
    assert gained[0, :, :40].sum() > 20 * gained[0, :, 56:].sum()


def test_bodies_keep_the_sky_from_the_ground(scene: RenderScene) -> None:
    """The share that a rectangle hides from a point below its middle, after the configuration factor."""
    weather = SceneWeather(sun_height=0.0, clouds=1.0)  # no sun
    base = replace(above(20.0), weather=weather)
    hidden = replace(base, objects=(*base.objects, SceneObject(1, np.eye(4), tag=1, is_hidden=True)))
    free, under = (render(scene, [v], surface=True).surface for v in (base, hidden))
    off = render(scene, [hidden], quality=RenderQuality(contact=False), surface=True).surface
    assert free is not None
    assert under is not None
    assert off is not None
    assert off.irradiance == pytest.approx(free.irradiance)
    ratio = under.irradiance[0].mean(-1) / free.irradiance[0].mean(-1)
    grid = np.stack(np.meshgrid(np.linspace(-2, 2, 801), np.linspace(-1, 1, 401)), -1)
    share = (0.2**2 / (np.pi * ((grid**2).sum(-1) + 0.2**2) ** 2)).sum() * (4 / 800) * (2 / 400)
    assert 1.0 - ratio[47, 47] == pytest.approx(share, abs=0.02)
    beside = ratio[47, 47 + int(2.3 * 96 / 20)]
    assert 0.3 < beside < 0.95
    assert ratio[4, 4] == pytest.approx(1.0, abs=1e-3), "far away nothing changes"


def test_the_surface_explains_the_picture(scene: RenderScene) -> None:
    """Radiance is gain times albedo where nothing mirrors or fades; positions lie on the ground; normals point up."""
    view = View(CAMERA, FORWARD, (SceneObject(0, np.eye(4)),), SceneWeather())
    picture = render(scene, [view], quality=RenderQuality(effects=ALL_EFFECTS - {"haze"}), surface=True)
    surface = picture.surface
    assert surface is not None
    solid = picture.tag[0] == 0
    assert solid.sum() > 1000
    rows = np.flatnonzero(solid.all(1))[2:]  # below the horizon
    explained = (surface.gain * surface.albedo)[0, rows, 20:70]
    assert explained == pytest.approx(picture.radiance[0, rows, 20:70], rel=1e-4)
    assert surface.position[0, rows, 20:70, 2] == pytest.approx(0.0, abs=1e-3)
    assert surface.normal[0, rows, 20:70, 2] == pytest.approx(1.0)
    assert surface.albedo[0, rows, 20:70] == pytest.approx(0.4)
    assert not surface.albedo[0, ~solid & (picture.tag[0] < 0)].any()
    assert render(scene, [view]).surface is None


def lit_lamps(scene: RenderScene, view: View) -> Any:
    """The lamps of a view as the kernels get them."""
    near = nearby_lights(scene, [view], collect_objects([view.objects]))
    return near.lamps.numpy()[: len(set(near.lamp_list.numpy()))] if near.lamp_start.numpy()[-1] else []


def test_by_night_lamps_are_on(scene: RenderScene) -> None:
    car = SceneObject(2, at(10.0, 0.0, 0.0), tag=1)
    view = View(CAMERA, FORWARD, (SceneObject(0, np.eye(4)), car), NIGHT)
    assert lamp_strength(1.0) == 0.0
    assert lamp_strength(-1.0) == 1.0
    assert not len(lit_lamps(scene, replace(view, weather=SceneWeather())))
    head, tail = lit_lamps(scene, view)
    assert head["ahead"][0] > 0.9, "forward"
    assert tail["ahead"][0] < -0.9
    assert head["place"][0] > 11.5
    assert tail["place"][0] < 8.5
    dusk = lit_lamps(scene, replace(view, weather=SceneWeather(sun_height=0.02)))
    assert dusk["light"] == pytest.approx(lit_lamps(scene, view)["light"] * lamp_strength(0.02), rel=1e-5)
    assert not len(lit_lamps(scene, replace(view, objects=(replace(car, is_lit=False),))))
    lit, off = (render(scene, [replace(view, objects=(view.objects[0], c))]) for c in (car, replace(car, is_lit=False)))
    assert lit.radiance[0, 50:].sum() > 1.05 * off.radiance[0, 50:].sum()
    assert not own_lamps(np.eye(4), SceneWeather())
    beam = own_lamps(np.eye(4), NIGHT)
    with_beam = render(scene, [replace(view, lamps=beam)]).radiance[0].sum(-1)
    without = render(scene, [view]).radiance[0].sum(-1)
    gained = with_beam - without
    assert gained[60:].sum() > 5.0 * gained[:36].sum(), "the road, not the sky"


def test_fine_shadows_are_finer(scene: RenderScene) -> None:
    """The edge of the shadow of a block, against the geometry: within a few centimetres."""
    weather = SceneWeather(sun_height=0.8, sun_heading=0.0, clouds=0.0)
    camera = Camera(256, 256, np.array([[512.0, 0, 128.0], [0, 512.0, 128.0], [0, 0, 1]]))
    things = (SceneObject(0, np.eye(4)), SceneObject(1, np.eye(4), tag=1, is_hidden=True))
    view = View(camera, at(-3.0, 0.0, 10.0, DOWN), things, weather, focus=(-2.0, 0.0))
    sun = np.array(scene_light(weather)[0][0])
    edge = -2.0 - 1.7 * sun[0] / sun[2]  # of the shadow of the upper edge, on the far side of the sun
    errors = []
    for fine in (True, False):
        picture = render(scene, [view], quality=RenderQuality(fine=fine, contact=False))
        row = picture.radiance[0][127].sum(-1)
        where = -3.0 + (np.arange(256) + 0.5 - 128.0) * 10.0 / 512.0
        half = 0.5 * (row.max() + row.min())
        errors.append(abs(float(where[np.flatnonzero(row < half)[0]]) - edge))
    assert errors[0] < 0.06
    assert errors[0] < errors[1] + 0.02


# UN Regulation No. 112, class B, right-hand traffic: degrees to the right and up, least and largest intensity, cd
BEAM_LIMITS = {
    "B50L": (-3.43, 0.57, 0.0, 350.0),
    "HV": (0.0, 0.0, 0.0, 625.0),
    "75R": (1.15, -0.57, 10100.0, 1e9),
    "75L": (-3.43, -0.57, 0.0, 10600.0),
    "50L": (-3.43, -0.86, 0.0, 13200.0),
    "50V": (0.0, -0.86, 5100.0, 1e9),
    "50R": (1.72, -0.86, 10100.0, 1e9),
    "25L": (-9.0, -1.72, 1700.0, 1e9),
    "25R": (9.0, -1.72, 1700.0, 1e9),
    "zone IV left": (-5.15, -1.72, 2500.0, 1e9),
    "zone I": (0.0, -4.0, 0.0, 17600.0),
}


def test_a_low_beam_meets_the_limits_of_its_regulation(scene: RenderScene) -> None:
    """Illuminance of a wall 25 m ahead of a vehicle, as the regulation measures it; both lamps give twice a lamp's."""
    lamp = low_beam(at(0.0, 0.0, 0.0), 1.0, 1e6)
    camera = Camera(256, 128, np.array([[384.0, 0, 128.0], [0, 384.0, 64.0], [0, 0, 1]]))
    view = View(camera, at(0.0, 0.0, 0.0, FORWARD), (SceneObject(3, at(25.0, 0.0, 0.0)),), NIGHT, lamps=(lamp,))
    lit, dark = (render(scene, [v], surface=True).surface for v in (view, replace(view, lamps=())))
    assert lit is not None
    assert dark is not None
    lux = (lit.irradiance[0].astype(float) - dark.irradiance[0]) @ LUMINANCE / NIGHT_LUX
    distance = np.linalg.norm(lit.position[0], axis=-1)
    candela = 0.5 * lux * distance**3 / 25.0
    for name, (right, up, least, most) in BEAM_LIMITS.items():
        column = 128.0 + 384.0 * np.tan(np.radians(right))
        row = 64.0 - 384.0 * np.tan(np.radians(up))
        found = candela[int(row), int(column)]
        assert least <= found <= most, f"{name}: {found:.0f} cd"
    above, below = candela[:60, 100:128].mean(), candela[70:76, 100:128].mean()
    assert below > 20.0 * above, "a cut-off"
    assert candela.max() == pytest.approx(12000.0, rel=0.12)


def test_the_effect_gives_head_lamps_their_pattern(scene: RenderScene) -> None:
    """Of the vehicle that carries the camera, and of others; without it both light as before."""
    car = SceneObject(2, at(20.0, 0.0, 0.0, np.diag([-1.0, -1, 1, 1])), tag=1)
    own = View(CAMERA, FORWARD, (SceneObject(0, np.eye(4)),), NIGHT)
    views = [
        *(replace(own, lamps=lamps) for lamps in (own_lamps(np.eye(4), NIGHT), ())),
        *(replace(own, objects=(*own.objects, replace(car, is_lit=is_lit))) for is_lit in (True, False)),
    ]
    even, pattern = (
        render(scene, views, quality=RenderQuality(effects=effects)).radiance.astype(float).sum(-1)
        for effects in (NO_EFFECTS, select_effects("low-beams"))
    )
    assert np.array_equal(even[1], pattern[1])
    assert np.array_equal(even[3], pattern[3])
    # The road from 50 m on, and that between the car and the camera.
    (own_even, own_pattern), (even_gain, pattern_gain) = (
        [(rendered[lit] - rendered[lit + 1])[rows].sum() for rendered in (even, pattern)]
        for lit, rows in ((0, slice(49, 51)), (2, slice(58, 96)))
    )
    assert own_pattern > 2.0 * own_even
    assert pattern_gain > 1.2 * even_gain
    with pytest.raises(ConfigError, match="pattern"):
        SceneLamp(np.eye(4), 1.0, pattern="high")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="low beam"):
        SceneLamp(np.eye(4), 1.0, pattern="low_beam")


@pytest.mark.parametrize("weather", [SceneWeather(), NIGHT], ids=["day", "night"])
def test_stop_lamps_and_indicators_shine(scene: RenderScene, weather: SceneWeather) -> None:
    """Seen from behind, with the effect alone: red for the brake, amber on the side of the turn."""
    camera = Camera(128, 64, np.array([[192.0, 0, 64.0], [0, 192.0, 32.0], [0, 0, 1]]))
    view = View(camera, at(0.0, 0.0, 1.0, FORWARD), (SceneObject(0, np.eye(4)),), weather)
    quality = RenderQuality(effects=select_effects("vehicle-signals"))

    def gained(signals: int, quality: RenderQuality = quality) -> Any:
        cars = [SceneObject(2, at(9.0, 0.0, 0.0), tag=1, signals=bits) for bits in (signals, 0)]
        views = [replace(view, objects=(*view.objects, car)) for car in cars]
        lit, dark = render(scene, views, quality=quality).radiance.astype(float)
        return np.where(np.abs(lit - dark) > 0.5, lit - dark, 0.0)

    brake = gained(LampSignal.BRAKE)
    assert (brake[..., 0] > 1.0).sum() > 20
    assert brake[..., 0].sum() > 10.0 * brake[..., 1].sum()
    assert brake[:, :64].sum() == pytest.approx(brake[:, 64:].sum(), rel=0.2)
    left, right = gained(LampSignal.LEFT), gained(LampSignal.RIGHT)
    assert left[:, :64].sum() > 5.0
    assert not left[:, 64:].any()
    assert right[:, 64:].sum() == pytest.approx(left[:, :64].sum(), rel=0.2)
    assert not right[:, :64].any()
    assert 0.15 < left[..., 1].sum() / left[..., 0].sum() < 0.5, "amber"
    assert not gained(LampSignal.BRAKE, RenderQuality(effects=NO_EFFECTS)).any(), "the effect is off"


def test_stop_lamps_light_the_road_behind(scene: RenderScene) -> None:
    cars = [SceneObject(2, at(10.0, 0.0, 0.0), tag=1, signals=signals) for signals in (LampSignal.BRAKE, 0)]
    stop, tail = (
        lit_lamps(scene, View(CAMERA, FORWARD, (SceneObject(0, np.eye(4)), car), NIGHT))[1]["light"] for car in cars
    )
    assert stop == pytest.approx(BRAKE_RATIO * tail)
