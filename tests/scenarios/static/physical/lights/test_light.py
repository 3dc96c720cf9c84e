"""Light attacks: what the quick model says is what is rendered; power is bounded; searches find and repeat."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from ssad.core.errors import ConfigError, UnknownNameError
from ssad.core.frames import FORWARD, Camera
from ssad.core.rotations import upright_pose
from ssad.rendering.camera.effects import ALL_EFFECTS
from ssad.rendering.camera.photometry import per_lux
from ssad.rendering.camera.render import RenderQuality, SceneWeather, View, render
from ssad.rendering.camera.scene import RenderScene, SceneObject
from ssad.rendering.camera.scene_edit import SceneEdit
from ssad.rendering.camera.sensor import SensorModel
from ssad.rendering.meshes import mesh as meshes
from ssad.rendering.meshes.mesh import Material, build
from ssad.scenarios.static.physical.lights import (
    LIGHTS,
    Flashlight,
    Laser,
    Projector,
    SearchBudget,
    Shadow,
    TargetSize,
    make_light,
    random_settings,
    search,
)
from ssad.scenarios.static.physical.lights.folder import LightFolder, LightSpec, budget_of
from ssad.scenarios.static.physical.lights.laser import TO_SRGB, colour_matching, spectral_colour
from ssad.scenarios.static.physical.lights.light import LightAttack, Ranges, value_tensors
from ssad.scenarios.static.physical.lights.lit_image import BLIND, LitImage, render_lit_image

TAG = 5
TARGET = TargetSize(4.0, 2.0, 1.5)
GREY = Material("grey", (0.4, 0.4, 0.4), specular=0.0, gloss=0.0)
CAMERA = Camera(128, 96, np.array([[220.0, 0, 64.0], [0, 220.0, 48.0], [0, 0, 1]]))
PLAIN = SensorModel(blur=0.0, mosaic=False)
SHARP = RenderQuality(effects=ALL_EFFECTS - {"soft-shadows"})
SEARCHED: tuple[LightAttack, ...] = (Shadow(), Laser(), Flashlight())
SETTINGS: dict[str, dict[str, float]] = {
    "shadow": {"left_a": -0.8, "up_a": 0.1, "left_b": 0.8, "up_b": 0.2, "left_c": 0.1, "up_c": 1.3},
    "laser": {"watts": 0.05, "wavelength": 550.0, "width": 0.3, "angle": 0.3, "aim_left": 0.0, "aim_up": 0.8},
    "flashlight": {
        "lumens": 20.0,
        "distance": 6.0,
        "height": 1.5,
        "aside": 0.1,
        "aim_left": 0.2,
        "aim_up": 0.8,
        "beam": 0.12,
        "red": 1.0,
        "green": 0.5,
        "blue": 0.2,
    },
}


@pytest.fixture(scope="module")
def scene() -> RenderScene:
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float) * 60
    ground = build(corners, np.array([[0, 1, 2], [0, 2, 3]]), materials=GREY)
    block = meshes.box((4.0, 2.0, 1.5), material=GREY, centre=(0.0, 0.0, 0.75))
    cards = [mesh for name in ("shadow",) for mesh in edit_of(name).meshes()]
    return RenderScene(None, [ground, block, BLIND.mesh(), *cards])


def edit_of(name: str) -> SceneEdit:
    attack: Any = next(one for one in SEARCHED if one.name == name)
    return attack.edit(SETTINGS[name], TARGET)  # type: ignore[no-any-return]


def view(weather: SceneWeather) -> View:
    """From 10 m behind a block that stands turned in the world."""
    turn = upright_pose(3.0, -2.0, 0.7)
    ahead = FORWARD.copy()
    ahead[:3, 3] = -12.0, 0.0, 1.6
    eye = turn @ ahead
    return View(CAMERA, eye, (SceneObject(0, np.eye(4)), SceneObject(1, turn, tag=TAG)), weather, PLAIN)


HOURS = {
    "shadow": SceneWeather(0.5, 0.7 + np.pi + 0.4, 0.0),
    "laser": SceneWeather(-0.3),
    "flashlight": SceneWeather(-0.3),
}


def lit(scene: RenderScene, name: str) -> LitImage:
    return render_lit_image(scene, view(HOURS[name]), TAG, slice(0, 96), slice(0, 128), blind=2, quality=SHARP)


@pytest.mark.parametrize("attack", SEARCHED, ids=lambda one: str(one.name))
def test_the_quick_model_is_what_is_rendered(scene: RenderScene, attack: LightAttack) -> None:
    """But for shadow maps and edges, the light on the target is the same within a few percent, without penumbras."""
    picture, given = lit(scene, attack.name), edit_of(attack.name)
    seen = given.on(view(HOURS[attack.name]), TAG, cards=range(3, 3 + len(given.cards)))
    full = render(scene, [seen], quality=SHARP)
    change = attack.change(value_tensors(SETTINGS[attack.name]), picture, TARGET)[0]
    wanted = full.radiance[0] - picture.radiance.numpy()
    own = full.tag[0] == TAG
    assert (np.abs(wanted[own]).max(-1) > 0.02).mean() > 0.04, "it changes the target"
    error = np.abs(change.numpy() - wanted)[own].max(-1)
    assert (error < 0.02 + 0.03 * np.abs(wanted[own]).max(-1)).mean() > 0.93
    image = picture.show(change[None])[0].permute(1, 2, 0).numpy() * 255
    assert (np.abs(image - full.image[0]).max(-1) < 4).mean() > 0.93


def test_a_shadow_takes_what_the_sun_gives_and_no_more(scene: RenderScene) -> None:
    picture = lit(scene, "shadow")
    change = Shadow().change(value_tensors(SETTINGS["shadow"]), picture, TARGET)[0]
    assert float(change.max()) <= 0.0
    assert float((picture.radiance + change).min()) >= -1e-6
    assert picture.sun_direction is not None
    night = replace(picture, sun_direction=None)
    assert not Shadow().change(value_tensors(SETTINGS["shadow"]), night, TARGET).any()


@pytest.mark.parametrize("attack", [Laser(), Flashlight()], ids=lambda one: str(one.name))
def test_a_lamp_gives_no_more_light_than_its_power(scene: RenderScene, attack: LightAttack) -> None:
    """What reaches a plane across the beam, in lumen; and no settings exceed the device."""
    values = SETTINGS[attack.name]
    (lamp,) = attack.edit(values, TARGET).lamps
    away = 5.0
    half = np.array(lamp.spread) * away
    x, y = (np.linspace(-s, s, 301)[:-1] + s / 300 for s in 1.05 * half)
    grid = np.stack([*np.meshgrid(x, y), np.full((300, 300), away)], -1)
    points = torch.from_numpy(grid @ lamp.pose[:3, :3].T + lamp.pose[:3, 3])
    normal = torch.from_numpy(np.broadcast_to(-lamp.pose[:3, 2], grid.shape).copy())
    plane = replace(
        lit(scene, attack.name),
        position=points,
        normal=normal,
        answer=torch.ones_like(points),
        fog=0.0,
        radiance=torch.zeros_like(points),
    )
    light = attack.change(value_tensors(values), plane, TARGET)[0].numpy()
    lumens = (light @ [0.2126, 0.7152, 0.0722]).sum() * (x[1] - x[0]) * (y[1] - y[0]) / per_lux(SceneWeather(-0.3))
    power = attack.power(values)
    assert power is not None
    assert lumens == pytest.approx(power, rel=0.05)
    most = max(attack.power(random_settings(attack, TARGET, key=(k,))) or 0.0 for k in range(50))
    assert most <= {"laser": 0.5 * 683.0, "flashlight": 3000.0}[attack.name]


def test_a_projector_leaves_no_part_of_its_picture_beyond_its_power() -> None:
    projector = Projector(lumens=400.0)
    surface = projector.surface(TARGET)
    assert surface.size == (22, 32)
    for colour, lumens in ((1.0, 400.0), (0.0, 0.4), (0.5, 400.0 * 0.2147)):
        assert projector.power(torch.full((3, *surface.size), colour)) == pytest.approx(lumens, rel=0.01)
    lamp = projector.lamp(TARGET)
    middle = np.linalg.inv(lamp.pose) @ [TARGET.rear, 0.0, 0.75, 1.0]
    assert middle[:2] == pytest.approx(0.0, abs=1e-9), "it looks at the middle of the rear"
    corner = np.linalg.inv(lamp.pose) @ [TARGET.rear, 1.0, 0.75, 1.0]
    assert abs(corner[0] / corner[2]) == pytest.approx(lamp.spread[0], rel=0.1)


def test_the_eye_sees_green_and_not_infrared() -> None:
    """Known values of the CIE 1931 functions at 450, 555 and 650 nm."""
    found = colour_matching(torch.tensor([450.0, 555.0, 650.0])).numpy()
    assert found == pytest.approx(
        np.array([[0.336, 0.038, 1.772], [0.512, 1.0, 0.0057], [0.2835, 0.107, 0.0]]), abs=0.03
    )


def test_a_laser_is_as_bright_as_the_eye_sees_its_wavelength() -> None:
    """Luminance of the displayed colour against the luminosity function; the hue is that of the wavelength."""
    wavelength = torch.linspace(400.0, 690.0, 59, dtype=torch.float64, requires_grad=True)
    xyz = colour_matching(wavelength)
    colour = spectral_colour(wavelength)
    to_xyz = torch.linalg.inv(torch.tensor(TO_SRGB, dtype=torch.float64))
    assert (colour @ to_xyz[1]).detach().numpy() == pytest.approx(xyz[:, 1].detach().numpy(), rel=2e-3, abs=1e-9)
    smallest = colour.detach().amin(-1).numpy()
    assert smallest.min() >= 0.0
    assert smallest.max() < 1e-12, "as pure as the display can show"
    # On the line from white to the wavelength: its distance from grey is a share of that of the pure colour.
    grey = xyz[:, 1:2]
    share = (colour - grey) / (xyz @ xyz.new_tensor(TO_SRGB).T - grey)
    assert share.amax(-1).detach().numpy() == pytest.approx(share.amin(-1).detach().numpy(), abs=1e-6)
    colour.sum().backward()
    assert wavelength.grad is not None
    assert bool(torch.isfinite(wavelength.grad).all())


@dataclass(frozen=True)
class Toy:
    """Best at 0.2, 0.7 of its ranges; smooth."""

    name: str = "toy"
    search: Any = "swarm"

    def ranges(self, target: TargetSize) -> Ranges:
        return {"a": (0.0, 10.0), "b": (-1.0, 1.0)}

    def change(self, values: Mapping[str, Tensor], picture: Any, target: TargetSize) -> Tensor:
        return torch.stack([values["a"] - 2.0, 5.0 * (values["b"] - 0.4)], -1)


class Bowl:
    """A picture that is the distance from the best settings."""

    def show(self, change: Tensor) -> Tensor:
        return -change.square().sum(-1)[:, None]


@pytest.mark.parametrize("how", ["swarm", "greedy", "gradient"])
def test_searches_find_repeat_and_count(how: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(search, "_loss", lambda detector, images, truth: images[:, 0])
    views = [search.SearchView(Bowl(), None)] * 2  # type: ignore[arg-type]
    given = {"detector": None, "target": TARGET, "views": views, "search": how}
    found = [search.search_light(Toy(), budget=SearchBudget(80, 8, 0.08, None), key=(k,), **given) for k in (0, 0, 1)]  # type: ignore[arg-type]
    assert found[0] == found[1]
    assert found[0].values != found[2].values
    for one in found:
        assert one.values["a"] == pytest.approx(2.0, abs=0.7)
        assert one.values["b"] == pytest.approx(0.4, abs=0.15)
        assert one.loss >= one.before
        assert (np.diff(one.best) >= 0.0).all()
        assert one.queries <= 160
        assert one.queries >= 40
    assert search.random_settings(Toy(), TARGET, key=(0,)) == search.random_settings(Toy(), TARGET, key=(0,))  # type: ignore[arg-type]


class Egg(Bowl):
    """A picture with many dents, one of them the deepest."""

    def show(self, change: Tensor) -> Tensor:
        return (-0.1 * change.square().sum(-1) + torch.cos(6.0 * change).sum(-1))[:, None]


@pytest.mark.parametrize("how", ["swarm", "greedy", "gradient"])
def test_the_best_of_several_searches_counts(how: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first is the one that is made alone, all are counted, and many come deeper than one."""
    monkeypatch.setattr(search, "_loss", lambda detector, images, truth: images[:, 0])
    given = {"detector": None, "target": TARGET, "views": [search.SearchView(Egg(), None)], "search": how}
    one, many = (
        search.search_light(Toy(), budget=SearchBudget(20, 4, 0.08, None, searches=n), **given)  # type: ignore[arg-type]
        for n in (1, 12)
    )
    assert many.best[: len(one.best)] == one.best
    assert many.before == one.before
    assert many.loss == many.best[-1] == max(many.best)
    assert 6 * one.queries < many.queries <= 12 * 20
    change = Toy().change({name: torch.tensor([value]) for name, value in many.values.items()}, None, TARGET)
    assert float(Egg().show(change)[0, 0]) == pytest.approx(many.loss, abs=1e-5), "the settings are those of that loss"
    assert many.loss > one.loss + 0.01


def test_what_is_found_is_kept(tmp_path: Path) -> None:
    """Random settings with their power, an edit that repeats, and nothing searched again."""
    spec = LightSpec("random", {"watts": 0.2}, {}, "laser", "night", "", 1, {})
    folder = LightFolder(tmp_path)

    def never(*given: object) -> Any:
        raise AssertionError

    asked: dict[str, Any] = {"views": never, "projected_views": never, "detector": never}
    edit = folder.edit(spec, TARGET, **asked)
    again = folder.edit(spec, TARGET, **asked)
    assert np.array_equal(edit.lamps[0].pose, again.lamps[0].pose)
    history = folder.history(spec)
    assert history["queries"] == 0
    assert 0.0 < history["lumens"] <= 0.2 * 683.0
    other = folder.edit(replace(spec, number=2), TARGET, **asked)
    assert not np.array_equal(other.lamps[0].pose, edit.lamps[0].pose)
    assert other.lamps[0].power == edit.lamps[0].power, "random lights shine at full power"
    projected = folder.edit(replace(spec, of="projector", options={}), TARGET, **asked)
    assert projected.textures[0].shape == (3, 22, 32)
    assert folder.image_path(replace(spec, of="projector", options={})).is_file()


@pytest.mark.parametrize(
    ("name", "options", "error", "message"),
    [
        ("lazer", {}, UnknownNameError, "laser"),
        ("laser", {"colour": 1}, ConfigError, "colour"),
        ("laser", {"watts": -1.0}, ConfigError, "watts"),
        ("laser", {"watts": float("nan")}, ConfigError, "watts"),
        ("laser", {"search": "luck"}, ConfigError, "search"),
        ("laser", {"name": "x"}, ConfigError, "no setting 'name'"),
        ("laser", {"width": [0.3, 0.1]}, ConfigError, "width"),
        ("shadow", {"away": 90.0}, ConfigError, "away=90.0"),
        ("projector", {"texels": 0}, ConfigError, "texels"),
        ("flashlight", {"beam": [0.0, 0.1]}, ConfigError, "beam"),
    ],
)
def test_a_wrong_light_ends_in_one_line(name: str, options: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message) as found:
        make_light(name, options)
    assert "\n" not in str(found.value)
    assert set(LIGHTS) == {"shadow", "laser", "projector", "flashlight"}


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("members", 0),
        ("members", 200),
        ("search", "luck"),
        ("patience", 3),
        ("searches", 0),
        ("settings", 2.5),
        ("window", 100),
    ],
)
def test_a_wrong_search_ends_in_one_line(key: str, value: object) -> None:
    with pytest.raises(ConfigError, match=f"attack laser: .*{key}") as found:
        budget_of({key: value}, "laser")
    assert "\n" not in str(found.value)
