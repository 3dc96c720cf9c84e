"""Metallic paint, dirt and wear of bodies: what they add to the light of a clean body."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssad.core.errors import ConfigError
from ssad.core.frames import FORWARD, Camera
from ssad.rendering.camera.kernels.finish import DUST
from ssad.rendering.camera.render import Rendering, SceneWeather, View, render
from ssad.rendering.camera.scene import Finish, RenderScene, SceneObject, TextureLayer
from ssad.rendering.meshes.mesh import Material, Mesh, build

TAG = 1_000_003  # of a target: far beyond the number of objects


def wall(*, paint: bool) -> Mesh:
    """Return an upright wall 2 m wide and high, that faces -x."""
    corners = np.array([[0, 1, 0], [0, -1, 0], [0, -1, 2], [0, 1, 2]], float)
    material = Material("door", (0.3, 0.3, 0.3), gloss=0.1, paint=paint)
    return build(corners, np.array([[0, 1, 2], [0, 2, 3]]), materials=(material,))


@pytest.fixture(scope="module")
def stage() -> RenderScene:
    return RenderScene(None, [wall(paint=True), wall(paint=False)])


def look(stage: RenderScene, finish: Finish | None, **changes: object) -> Rendering:
    pose = np.eye(4)
    pose[:3, 3] = 6.0, 0.0, -1.0
    wall_object = replace(SceneObject(0, pose, (0.05, 0.1, 0.3), TAG, finish=finish), **changes)
    view = View(Camera.typical(48, 32), FORWARD, (wall_object,), SceneWeather(0.8, 3.0, 0.0))
    return render(stage, [view], surface=True)


def share_of_dust(stage: RenderScene, finish: Finish, **changes: object) -> np.ndarray:
    """Return the share that dust covers in the pixels that the wall fills, by red light."""
    clean, dirty = look(stage, None, **changes), look(stage, finish, **changes)
    surface = clean.surface
    assert surface is not None
    inner = clean.tag[0] == TAG
    inner[1:-1, 1:-1] &= inner[:-2, 1:-1] & inner[2:, 1:-1] & inner[1:-1, :-2] & inner[1:-1, 2:]
    change = (dirty.radiance - clean.radiance)[0][inner][:, 0]
    return np.asarray(change / (surface.gain[0][inner][:, 0] * (DUST[0] - surface.albedo[0][inner][:, 0])))


def test_a_clean_finish_changes_no_bit(stage: RenderScene) -> None:
    clean = look(stage, None)
    assert (look(stage, Finish(seed=5)).radiance == clean.radiance).all()
    layered = (TextureLayer(0),)
    assert (look(stage, Finish(dirt=1.0), layers=layered).radiance == look(stage, None, layers=layered).radiance).all()


def test_metallic_paint_is_lighter_where_it_faces_the_camera(stage: RenderScene) -> None:
    clean, metallic = look(stage, None), look(stage, Finish(metallic=0.8))
    surface = clean.surface
    assert surface is not None
    middle = (0, 16, 24)
    expected = surface.gain[middle] * surface.albedo[middle] * 0.8 * (0.9 - 0.45)
    assert (metallic.radiance - clean.radiance)[middle] == pytest.approx(expected, rel=0.01)
    # The mean of the factor over the hemisphere, weighted by its cosine, is 1.
    cosine = (np.arange(1000) + 0.5) / 1000
    assert (2 * cosine * (1 + 0.8 * (0.9 * cosine**2 - 0.45))).mean() == pytest.approx(1.0, abs=1e-6)


def test_dirt_covers_more_below_and_less_where_there_is_no_paint(stage: RenderScene) -> None:
    light, heavy = (share_of_dust(stage, Finish(dirt=amount, seed=2)) for amount in (0.2, 0.4))
    assert (light > 0.0).all()
    assert (heavy <= 0.92 + 1e-4).all()
    assert heavy[heavy < 0.9] == pytest.approx(2.0 * light[heavy < 0.9], rel=0.01)
    third = len(heavy) // 3
    assert heavy[-third:].mean() > 1.2 * heavy[:third].mean()
    paint = light.mean()
    assert share_of_dust(stage, Finish(dirt=0.2, seed=2), mesh=1).mean() == pytest.approx(0.35 * paint, rel=0.05)
    assert share_of_dust(stage, Finish(dirt=0.2, seed=3)) != pytest.approx(light, rel=0.05)


def test_wear_makes_paint_paler(stage: RenderScene) -> None:
    clean, worn = look(stage, None), look(stage, Finish(wear=1.0, seed=1))
    inside = clean.tag[0] == TAG
    spread = [np.ptp(picture.radiance[0][inside].mean(0)) for picture in (clean, worn)]
    assert spread[1] < 0.8 * spread[0]
    assert (look(stage, Finish(wear=1.0), mesh=1).radiance == look(stage, None, mesh=1).radiance).all()


def test_amounts_out_of_range_are_refused() -> None:
    with pytest.raises(ConfigError, match="give 0 to 1"):
        Finish(dirt=1.2)
