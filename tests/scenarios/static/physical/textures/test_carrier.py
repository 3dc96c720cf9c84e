"""Carriers: a texture of a true size on a named panel, or on all paint and nothing else; the same on any target."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ssad.core.errors import ConfigError
from ssad.recorders.viewpoints import look_at
from ssad.rendering.camera.render import View, render
from ssad.rendering.camera.rig import RIG, rig_camera
from ssad.rendering.camera.scene import RenderScene, SceneObject
from ssad.rendering.camera.texture import PRINTABLE
from ssad.rendering.meshes.mesh import Material, Mesh, box
from ssad.rendering.target import TargetCar, TargetSign, TargetWalker
from ssad.scenarios.static.physical import make_carrier
from ssad.scenarios.static.physical.textures.carrier import (
    Camouflage,
    Patch,
    RoadPatch,
    albedo_of,
    covered_colour,
    metres_of,
)

PAINT = Material("paint", (0.5, 0.5, 0.5))
CHANNEL = next(iter(RIG))
SIDES = ("left", "right")


def panel(width: float, height: float, rectangle: tuple[float, float, float, float]) -> Mesh:
    """A body whose only panel `rear` has a size (m) and a rectangle of the atlas."""
    u0, v0, u1, v1 = rectangle
    corners = np.array([[0, 0, height], [0, -width, height], [0, -width, 0], [0, 0, 0]], np.float32)
    uv = np.array([[u0, v0], [u1, v0], [u1, v1], [u0, v1]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    normals = np.tile(np.array([-1, 0, 0], np.float32), (2, 3, 1))
    return Mesh(corners, faces, normals, uv[faces], np.zeros(2, np.int32), np.zeros(2, np.int32), (PAINT,), ("rear",))


def test_what_a_texture_covers_is_paint_or_material() -> None:
    car, sign = TargetCar(paint="red"), TargetSign()
    mesh = car.mesh()
    for carrier in (Camouflage(), Patch("rear"), Patch("rear", width=0.02, height=0.02)):
        assert covered_colour(carrier.on(mesh), mesh, car.colour).tolist() == pytest.approx(car.colour, abs=1e-6)
    assert max(covered_colour(RoadPatch().on(mesh), mesh, car.colour).tolist()) < 0.1, "asphalt is dark"
    face = covered_colour(Patch("face", width=0.4, height=0.4).on(sign.mesh()), sign.mesh(), sign.colour)
    assert face[0] > 1.3 * face[1:].max(), "red with white letters"


def test_a_patch_has_its_size_in_metres() -> None:
    mesh = panel(2.0, 0.8, (0.1, 0.2, 0.6, 0.4))
    assert metres_of(mesh, "rear") == pytest.approx((4.0, 4.0))
    surface = Patch("rear", width=1.0, height=0.4, texels=50).on(mesh)
    assert surface.layer.rectangle == pytest.approx((0.225, 0.25, 0.475, 0.35))
    assert surface.size == (20, 50)
    assert surface.texels_per_metre == pytest.approx(50.0)
    assert surface.mask.all()
    moved = Patch("rear", width=1.0, height=0.4, centre=(0.25, 0.25)).on(mesh)
    assert moved.layer.rectangle == pytest.approx((0.1, 0.2, 0.35, 0.3))


@pytest.mark.parametrize(
    ("patch", "message"),
    [
        ({"width": 2.5, "height": 0.4}, "does not fit on the panel 'rear', which is 2.00 x 0.80 m"),
        ({"width": 1.0, "height": 0.4, "centre": (0.1, 0.5)}, "does not fit"),
        ({"panel": "wing"}, "no panel 'wing'; this mesh has: rear"),
        ({"width": 0.0}, "patch: width=0.0"),
        ({"width": float("inf")}, "patch: width=inf"),
        ({"centre": [0.5]}, "patch: centre"),
        ({"centre": "mid"}, "patch: centre='mid'"),
        ({"centre": [0.5, 1.5]}, "patch: centre"),
        ({"texels": 0}, "patch: texels=0"),
        ({"texels": 64.5}, "patch: texels=64.5"),
        ({"name": "x"}, "patch: there is no setting 'name'; it has panel, width, height, centre, texels"),
    ],
)
def test_a_patch_that_cannot_be_is_refused_in_one_line(patch: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as error:
        make_carrier("patch", patch).on(panel(2.0, 0.8, (0.1, 0.2, 0.6, 0.4)))
    assert "\n" not in str(error.value)


def test_a_body_without_panels_takes_no_camouflage() -> None:
    with pytest.raises(ConfigError, match="no panels"):
        Camouflage().on(box((1.0, 1.0, 1.0), material=PAINT))


@pytest.mark.parametrize("style", ["sedan", "suv", "van"])
def test_a_patch_lies_on_the_rear_of_every_car_in_its_size(style: str) -> None:
    """What is seen from behind has the patch's size, in pixels of a camera straight behind it."""
    mesh = TargetCar(style).mesh()
    surface = Patch("rear", width=0.9, height=0.3, centre=(0.5, 0.6)).on(mesh)
    camera = rig_camera(CHANNEL, 640)
    away = 12.0
    low, _ = mesh.bounds()
    height = 0.8
    behind = np.eye(4)
    behind[:3, :3] = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # x right, y down, z ahead
    behind[:3, 3] = low[0] - away, 0.0, height
    view = View(camera, behind, (SceneObject(0, np.eye(4), tag=1, layers=(surface.layer,)),))
    picture = render(RenderScene(None, [mesh]), [view])
    assert set(np.unique(picture.fragments["texture"])) == {0}
    rows, columns = np.divmod(picture.fragments["place"].astype(int), camera.width)
    pixel = camera.intrinsic[0, 0] / away
    assert np.ptp(columns) + 1 == pytest.approx(0.9 * pixel, abs=0.12 * 0.9 * pixel + 2)
    assert np.ptp(rows) + 1 <= 0.3 * pixel + 3
    assert (columns.min() + columns.max()) / 2 == pytest.approx(camera.intrinsic[0, 2], abs=2.5)


def faces_of(mesh: Mesh, chosen: np.ndarray) -> Mesh:
    """The chosen faces of a mesh."""
    own = {name: getattr(mesh, name)[chosen] for name in ("faces", "normals", "uv", "material", "panel")}
    return replace(mesh, **own)


FROM = {"ahead": (1, 0, 0), "behind": (-1, 0, 0), "left": (0, 1, 0), "right": (0, -1, 0), "above": (-0.2, 0, 1)}


@pytest.mark.parametrize(
    ("target", "panel", "size", "side"),
    [
        (TargetCar(), "rear", (0.8, 0.3), "behind"),
        (TargetCar(), "hood", (0.8, 0.5), "above"),
        (TargetCar(), "roof", (0.7, 0.7), "above"),
        *((TargetCar(), f"{side}_side/{door}_door", (0.4, 0.3), side) for side in SIDES for door in ("front", "rear")),
        (TargetWalker(), "torso_front", (0.25, 0.3), "ahead"),
        (TargetWalker(), "torso_back", (0.25, 0.3), "behind"),
    ],
    ids=lambda one: one if isinstance(one, str) else None,
)
def test_a_patch_lies_on_its_panel_and_nowhere_else(
    target: TargetCar | TargetWalker, panel: str, size: tuple[float, float], side: str
) -> None:
    """Seen from all sides; from its own it can be read from left to right, on the left as on the right of a car."""
    mesh = target.mesh()
    surface = Patch(panel, width=size[0], height=size[1]).on(mesh)
    own = np.isin(mesh.panel, mesh.panel_indices(panel))
    scene = RenderScene(None, [faces_of(mesh, own), faces_of(mesh, ~own)])
    camera, middle = rig_camera(CHANNEL, 320), np.array([0.0, 0.0, target.full_size[2] / 2])
    eyes = [look_at(middle + 2.0 * max(target.full_size) * np.array(one), middle) for one in FROM.values()]
    found = []
    for wearer in (0, 1):
        things = tuple(SceneObject(k, np.eye(4), tag=k + 1, layers=(surface.layer,) * (k == wearer)) for k in (0, 1))
        found.append(render(scene, [View(camera, eye, things) for eye in eyes]).fragments)
    on_panel, elsewhere = found
    assert not len(elsewhere), "on no other face"
    view, place = np.divmod(on_panel["place"].astype(int), camera.width * camera.height)
    seen = {name: int((view == k).sum()) for k, name in enumerate(FROM)}
    assert seen[side] == max(seen.values()) > 40
    opposite = {"ahead": "behind", "behind": "ahead", "left": "right", "right": "left"}.get(side)
    if opposite is not None:
        assert seen[opposite] == 0
        piece = view == list(FROM).index(side)
        turn = np.corrcoef(on_panel["u"][piece], place[piece] % camera.width)[0, 1]
        assert turn > 0.9, "not mirrored"


def test_a_camouflage_covers_every_panel_and_nothing_between() -> None:
    surface = Camouflage(64).on(TargetCar().mesh())
    assert surface.layer.rectangle == (0.0, 0.0, 1.0, 1.0)
    assert 0.3 < surface.mask.mean() < 0.9
    mesh = TargetCar().mesh()
    for name in mesh.panels:
        u0, v0, u1, v1 = mesh.panel_rectangle(name)
        assert surface.mask[int(32 * (v0 + v1)), int(32 * (u0 + u1))], name


def test_a_sign_takes_a_patch_on_its_face() -> None:
    size = TargetSign().full_size[1]
    surface = Patch("face", width=0.5 * size, height=0.5 * size).on(TargetSign().mesh())
    u0, v0, u1, v1 = surface.layer.rectangle
    assert (u1 - u0, v1 - v0) == pytest.approx((0.242, 0.242), abs=0.005)


def test_albedo_is_what_ink_and_paper_can_have() -> None:
    found = albedo_of(torch.tensor([0.0, 0.5, 1.0]).reshape(3, 1, 1))
    low, high = PRINTABLE
    assert found.flatten().tolist() == pytest.approx([low, low + (high - low) * 0.21404, high], abs=1e-4)
