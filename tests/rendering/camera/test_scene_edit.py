"""What an attack changes in a scene: cards that cast, lamps in lumen, textures on what shows them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ssad.core.errors import ConfigError
from ssad.core.frames import Camera
from ssad.core.rotations import upright_pose
from ssad.rendering.camera.effects import ALL_EFFECTS
from ssad.rendering.camera.lamps import SceneLamp
from ssad.rendering.camera.photometry import per_lux
from ssad.rendering.camera.render import RenderQuality, SceneWeather, View, render
from ssad.rendering.camera.scene import RenderScene, SceneObject, TextureDecal, TextureLayer
from ssad.rendering.camera.scene_edit import SceneEdit, ShadowCard, render_with
from ssad.rendering.camera.sensor import SensorModel
from ssad.rendering.meshes import mesh as meshes
from ssad.rendering.meshes.mesh import Material, build

GREY = Material("grey", (0.4, 0.4, 0.4), specular=0.0, gloss=0.0)
CAMERA = Camera(96, 96, np.array([[96.0, 0, 48.0], [0, 96.0, 48.0], [0, 0, 1]]))
DOWN = np.diag([1.0, -1.0, -1.0, 1.0])
NOON = SceneWeather(sun_height=0.8, sun_heading=0.6, clouds=0.0)
SQUARE = np.array([[0.5, 0.5, 0.0], [2.5, 0.5, 0.0], [2.5, 2.5, 0.0], [0.5, 2.5, 0.0]])
CARD = ShadowCard(SQUARE, 5.0)
TARGET = 7


def view(**other: object) -> View:
    """From 10 m above; the target is a small block that stands turned."""
    pose = DOWN.copy()
    pose[2, 3] = 10.0
    things = (SceneObject(0, np.eye(4)), SceneObject(1, upright_pose(-1.0, 0.0, 0.5), tag=TARGET))
    return replace(View(CAMERA, pose, things, NOON), **other)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def scene() -> RenderScene:
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float) * 60
    ground = build(corners, np.array([[0, 1, 2], [0, 2, 3]]), materials=GREY)
    block = meshes.box((0.4, 0.4, 0.4), material=replace(GREY, paint=True), centre=(0, 0, 0.2)).with_panel("all")
    return RenderScene(None, [ground, block, CARD.mesh()])


def pixel(x: float, y: float) -> tuple[int, int]:
    return int(48 - y * 9.6), int(48 + x * 9.6)


def test_a_flat_card_casts_the_shadow_of_its_outline(scene: RenderScene) -> None:
    """Even one that lies on the ground in the target's frame, and without being seen."""
    shaded = render(
        scene, [SceneEdit(cards=(CARD,)).on(view(), TARGET, cards=(2,))], quality=RenderQuality(contact=False)
    )
    free = render(scene, [view()], quality=RenderQuality(contact=False))
    ratio = (shaded.radiance.sum(-1) / free.radiance.sum(-1))[0]
    target = upright_pose(-1.0, 0.0, 0.5)
    for x, y, dark in ((1.5, 1.5, True), (0.7, 0.7, True), (2.3, 2.3, True), (0.2, 1.5, False), (1.5, 2.8, False)):
        at = target @ [x, y, 0.0, 1.0]
        assert (ratio[pixel(at[0], at[1])] < 0.6) == dark, (x, y)
    assert np.array_equal(shaded.tag, free.tag), "it is not seen"
    night = view(weather=SceneWeather(-0.3))
    assert SceneEdit(cards=(CARD,)).on(night, TARGET, cards=(2,)).objects == night.objects


def test_lamps_shine_in_lumen_in_the_targets_frame(scene: RenderScene) -> None:
    pose = DOWN.copy()
    pose[:3, 3] = 2.0, 0.0, 4.0
    edit = SceneEdit(lamps=(SceneLamp(pose, 500.0, (0.3, 0.3), soft=0.0, shadows=False),))
    for weather in (NOON, SceneWeather(-0.3)):
        seen = edit.on(view(weather=weather), TARGET)
        (lamp,) = seen.lamps
        assert lamp.power == pytest.approx(500.0 * per_lux(weather))
        assert lamp.pose[:3, 3] == pytest.approx((upright_pose(-1.0, 0.0, 0.5) @ [2.0, 0.0, 4.0, 1.0])[:3])
    lit, dark = (render(scene, [v], surface=True) for v in (seen, view(weather=SceneWeather(-0.3))))
    assert lit.surface is not None
    assert dark.surface is not None
    gained = (lit.surface.irradiance - dark.surface.irradiance)[0, ..., 1].astype(float)
    lux = gained / per_lux(SceneWeather(-0.3))
    assert lux.sum() / 9.6**2 == pytest.approx(500.0, rel=0.05), "all of its light arrives on the ground"


def test_textures_are_on_layers_decals_and_lamps(scene: RenderScene) -> None:
    """Pixels without a texture are the same to the bit, noise and all, unless the lens scatters light."""
    quality = RenderQuality(effects=ALL_EFFECTS - {"bloom", "flare"})
    white, red = torch.ones(3, 4, 4), torch.tensor([0.9, 0.0, 0.0])[:, None, None].repeat(1, 2, 2)
    ground = DOWN.copy()
    ground[:3, 3] = 2.0, 0.0, 0.0
    edit = SceneEdit(
        (TextureLayer(0),), decals=(TextureDecal(1, ground, (1.0, 1.0), tag=0),), textures={0: white, 1: red}
    )
    plain = view(sensor=SensorModel(noise=0.02), seed=3)
    before, worn = render(scene, [plain], quality=quality), edit.on(plain, TARGET)
    after = render_with(scene, [worn], edit.textures, quality=quality)
    own = before.tag[0] == TARGET
    assert after.image[0][own].mean() > before.image[0][own].mean() + 20
    at = upright_pose(-1.0, 0.0, 0.5) @ [2.0, 0.0, 0.0, 1.0]
    r, g, b = after.image[0][pixel(at[0], at[1])].astype(int)
    assert r > 60 + max(g, b)
    changed = (after.image != before.image).any(-1)[0]
    far = np.hypot(*np.indices(changed.shape) - np.array([[[48]], [[48]]])) > 40
    assert not (changed & far).any()
    alone = render_with(scene, [plain], edit.textures, quality=quality)
    assert np.array_equal(alone.image, before.image), "no target, no texture"
    together = render_with(scene, [plain, worn], edit.textures, quality=quality)
    assert np.array_equal(together.image, np.concatenate([before.image, after.image]))
    whole = [render_with(scene, [one], edit.textures).image for one in (plain, worn)]
    assert np.array_equal(render_with(scene, [plain, worn], edit.textures).image, np.concatenate(whole))


def test_what_does_not_fit_ends_in_one_line(scene: RenderScene) -> None:
    with pytest.raises(ConfigError, match="no texture 3"):
        SceneEdit((TextureLayer(3),))
    with pytest.raises(ConfigError, match="three or more points"):
        ShadowCard(np.zeros((2, 3)))
    with pytest.raises(ConfigError, match=r"0\.5 to 20 m"):
        ShadowCard(SQUARE, 100.0)
    with pytest.raises(ConfigError, match="0 of the 1 cards"):
        SceneEdit(cards=(CARD,)).on(view(), TARGET)
    edit = SceneEdit((TextureLayer(0),), textures={0: torch.full((3, 2, 2), 2.0)})
    with pytest.raises(ConfigError, match="lies in 0 to 1"):
        render_with(scene, [edit.on(view(), TARGET)], edit.textures)
    with pytest.raises(ConfigError, match="no texture 0"):
        render_with(scene, [edit.on(view(), TARGET)], {})
    plain = view()
    assert edit.on(plain, 99) is plain, "the target is not there"
