"""Recorded pictures as functions of a texture: as if rendered anew, once rendered, differentiable."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.bodies import plain_bodies
from torch.utils._python_dispatch import TorchDispatchMode

import ssad.experiments.perception.physical.textured_images as module
from ssad.core.errors import ConfigError, FormatError
from ssad.core.images import read_image
from ssad.experiments.perception.physical.textured_images import (
    KEPT,
    PreparedImage,
    parse_part,
    texturable_images,
    visible_part,
)
from ssad.recorders.nuscenes import SENSOR
from ssad.recorders.target_images import TARGET, record_target_images, recorded_views
from ssad.recorders.target_recording import TargetRecording
from ssad.recorders.viewpoints import look_at
from ssad.rendering.camera.effects import ALL_EFFECTS
from ssad.rendering.camera.glare import with_lens_effects
from ssad.rendering.camera.render import Rendering, render, view_noise
from ssad.rendering.camera.scene import TextureLayer
from ssad.rendering.camera.scene_edit import render_with
from ssad.rendering.camera.texture import paint_mask, retexture, texture_taps
from ssad.rendering.camera.torch_jpeg import jpeg
from ssad.rendering.camera.torch_sensor import develop
from ssad.rendering.hours import at_hour
from ssad.rendering.target import TargetCar
from ssad.scenarios.static.physical.textures.carrier import RoadPatch

LAYERS = (TextureLayer(0), TextureLayer(1, (0.2, 0.2, 0.6, 0.6), 0.5))
CAR = TargetCar("suv", "red", seed=2)
SIZES: dict[int, int | tuple[int, int]] = {0: 32, 1: (16, 24)}


@pytest.fixture(scope="module", autouse=True)
def others_are_boxes() -> Iterator[None]:
    """A texture is worn by the target alone."""
    with plain_bodies():
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Without the effects of the lens, so that a texture changes a part of the image alone."""
    out = tmp_path_factory.mktemp("textured") / "clips"
    effects = ALL_EFFECTS - {"bloom", "flare"}
    record_target_images(TargetRecording(out, (("Twinford", 1),), (), size=320, behind=8.0, effects=effects), workers=0)
    return out


@pytest.fixture(scope="module")
def glowing(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With all effects."""
    out = tmp_path_factory.mktemp("glowing") / "clips"
    record_target_images(TargetRecording(out, (("Twinford", 1),), (), size=160, behind=8.0), workers=0)
    return out


def colours() -> dict[int, torch.Tensor]:
    draws = torch.Generator().manual_seed(4)
    return {0: torch.rand((3, 32, 32), generator=draws), 1: torch.rand((3, 16, 24), generator=draws)}


@pytest.mark.parametrize("scatters", [False, True], ids=["lens", "glowing lens"])
def test_a_texture_looks_as_if_rendered_anew(scatters: bool, request: pytest.FixtureRequest) -> None:
    """In the whole part that changes, with the noise of the recording; elsewhere the recorded picture stands."""
    folder, textures = request.getfixturevalue("glowing" if scatters else "folder"), colours()
    for clip, seen in zip(texturable_images(folder, LAYERS), recorded_views(folder), strict=True):
        worn = seen.with_layers(*LAYERS)
        picture = render(seen.scene, [worn], quality=seen.quality)
        assert ("bloom" in picture.effects) == scatters
        radiance = torch.tensor(picture.radiance)
        for number, size in SIZES.items():
            radiance = retexture(texture_taps(picture, size, texture=number), textures[number], radiance)
        noise, sensor = view_noise(worn), with_lens_effects(SENSOR, picture.effects)
        assert noise is not None
        developed = develop(radiance, float(picture.exposure[0]), sensor, torch.tensor(noise)[None])
        rendered = render_with(seen.scene, [worn], textures, quality=seen.quality).image[0].astype(float)
        assert np.abs(developed[0].permute(1, 2, 0).numpy() * 255 - rendered).max() < 1.5, "the renderer's own image"
        before = torch.tensor(read_image(folder / "images" / clip.file)).permute(2, 0, 1)[None].float() / 255
        _, y, w, h = next(o["bbox"] for o in seen.objects if o["target"])
        for quality, whole in ((None, developed), (92, jpeg(developed, 92))):
            shown = clip.prepare(SIZES, quality=quality).show(textures)
            changed = (shown != before).any(1)[0]
            assert changed.sum() > 0.3 * w * h
            assert scatters or not changed[: max(int(y) - 40, 0)].any(), "far from the car nothing changes"
            torch.testing.assert_close(shown[..., changed], whole[..., changed], rtol=0, atol=1e-5)
            assert torch.equal(shown[..., ~changed], before[..., ~changed])


@pytest.fixture(scope="module")
def same_metal(tmp_path_factory: pytest.TempPathFactory) -> list[Rendering]:
    """A named car in each of two towns, from the same places: behind its right, and before its left from above."""
    out = tmp_path_factory.mktemp("towns") / "clips"
    record_target_images(
        TargetRecording(out, (("Twinford", 1), ("Oldmarket", 1)), (), size=160, behind=8.0, target=CAR), workers=0
    )
    eyes = (np.array([-6.0, -2.5, 1.8]), np.array([5.0, 3.5, 3.0]))
    found = []
    for seen in recorded_views(out):
        worn = seen.with_layers(TextureLayer(0))
        at = worn.objects[0].pose
        own = [replace(worn, pose=at @ look_at(eye, np.array([0.0, 0.0, 0.7])), focus=None) for eye in eyes]
        found.append(render(seen.scene, own))
    return found


def numbered(picture: Rendering, size: tuple[int, int]) -> np.ndarray:
    """Where in its texture each pixel [B * H * W, 2] shows a car, u and v as its texels say; NaN where none is seen."""
    height, width = size
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    texels = torch.stack([(columns + 0.5) / width, (rows + 0.5) / height, torch.ones(size)]).double()
    taps = texture_taps(picture, size, mask=paint_mask(CAR.mesh(), size), dtype=torch.float64)
    nothing = torch.zeros((*picture.tag.shape, 3), dtype=torch.float64)
    shown, full = (retexture(taps, one, nothing).reshape(-1, 3) for one in (texels, torch.ones_like(texels)))
    return (shown / full)[:, :2].numpy()


def faces_at(places: np.ndarray) -> np.ndarray:
    """The face of the car [N] that lies at each place [N, 2] of its atlas; -1: between its panels."""
    mesh = CAR.mesh()
    own = np.flatnonzero(mesh.panel >= 0)
    start, right, up = mesh.uv[own].astype(np.float64).transpose(1, 0, 2)
    sides = np.stack([right - start, up - start], -1)
    flat = np.abs(np.linalg.det(sides)) < 1e-12
    sides[flat] = np.eye(2) * 1e9
    part = np.einsum("fij,nfj->nfi", np.linalg.inv(sides), places[:, None] - start)
    inside = (part.min(-1) > -1e-6) & (part.sum(-1) < 1 + 1e-6) & ~flat
    return np.where(inside.any(1), own[inside.argmax(1)], -1)


@pytest.mark.parametrize("size", [(64, 64), (192, 192), (96, 160)])
def test_a_texture_lies_on_the_same_faces_in_every_town(same_metal: list[Rendering], size: tuple[int, int]) -> None:
    """Whatever its size: its texels are numbered, and each pixel of the car shows the same ones."""
    here, there = (numbered(picture, size) for picture in same_metal)
    free = np.logical_and(*((picture.tag == TARGET).ravel() for picture in same_metal))
    worn = [free & np.isfinite(places).all(1) for places in (here, there)]
    both = worn[0] & worn[1]
    assert both.sum() > 2000, "the car is seen"
    assert (worn[0] != worn[1]).sum() < 0.01 * both.sum(), "on the same pixels"
    assert (np.abs(here - there)[both].max(1) < 0.5 / max(size)).mean() > 0.95, "the same texels"
    finest = numbered(same_metal[1], (512, 512))[both]
    assert (np.abs(here[both] - finest).max(1) < 1.0 / min(size)).mean() > 0.95, "other sizes lie in the same place"
    some = np.flatnonzero(both)[::7]
    one, other = faces_at(here[some]), faces_at(there[some])
    assert len(np.unique(one)) > 50
    assert (one == other).mean() > 0.97, "the same faces"


def test_a_picture_is_rendered_once(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.rmtree(folder / KEPT, ignore_errors=True)  # what other tests had rendered
    first = list(texturable_images(folder, LAYERS))
    kept = sorted((folder / KEPT).rglob("*.npz"))
    assert len(kept) == 1

    def rendered(*given: object, selected_keys: set[str], **other: object) -> Iterator[None]:
        assert not selected_keys, "rendered again"
        yield from ()

    monkeypatch.setattr(module, "recorded_views", rendered)
    for a, b in zip(first, texturable_images(folder, LAYERS), strict=True):
        assert a.file == b.file
        assert np.array_equal(a.radiance, b.radiance)
        assert np.array_equal(a.fragments, b.fragments)
    with pytest.raises(AssertionError, match="rendered again"):
        next(texturable_images(folder, (TextureLayer(0, opacity=0.9),)))
    with monkeypatch.context() as other:
        other.setattr(module, "recording_of", lambda *given: {"seed": 1, "effects": []})
        with pytest.raises(AssertionError, match="rendered again"):
            next(texturable_images(folder, LAYERS))
    monkeypatch.setattr(module, "_drawing", lambda: "another version")
    with pytest.raises(AssertionError, match="rendered again"):
        next(texturable_images(folder, LAYERS))


def test_pictures_are_the_same_alone_and_together(glowing: Path) -> None:
    """With windows of unlike sizes, one at the border of the picture, each with a texture and noise of its own."""
    clip = next(texturable_images(glowing, LAYERS))
    fragments, width = clip.fragments, clip.radiance.shape[1]
    least = int(fragments["place"].min()) // width
    few = replace(clip, fragments=fragments[fragments["place"] < (least + 20) * width])
    down = clip.image.shape[0] - clip.corner[0] - clip.radiance.shape[0]
    low = replace(clip, corner=(clip.corner[0] + down, clip.corner[1]), image=np.roll(clip.image, down, 0))
    ready = [image.prepare(SIZES, glow=False) for image in (clip, few, low)]
    assert len({tuple(image.part.shape) for image in ready}) > 1
    textures = [{k: (v * share).requires_grad_() for k, v in colours().items()} for share in (1.0, 0.5, 0.8)]

    def draws(k: int) -> torch.Generator:
        return torch.Generator().manual_seed(k)

    alone = torch.cat([one.show(textures[k], draws(k)) for k, one in enumerate(ready)])
    both = {k: torch.stack([own[k] for own in textures]) for k in SIZES}
    together = PreparedImage.together(ready, both, [draws(k) for k in range(3)])
    torch.testing.assert_close(together, alone, rtol=0, atol=1e-5)
    weight = torch.rand(alone.shape, generator=torch.Generator().manual_seed(9))
    leaves = [v for own in textures for v in own.values()]
    slopes = [torch.autograd.grad((shown * weight).sum(), leaves) for shown in (alone, together)]
    for one, other in zip(*slopes, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-3 * float(one.abs().max()))


class Counted(TorchDispatchMode):
    """How many operations ran that are more than a view."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        found = func(*args, **(kwargs or {}))
        shared = isinstance(found, torch.Tensor) and any(
            isinstance(one, torch.Tensor) and one.untyped_storage().data_ptr() == found.untyped_storage().data_ptr()
            for one in args
        )
        self.count += not shared
        return found


def test_a_further_picture_costs_few_operations(glowing: Path) -> None:
    """What bounds a step on a GPU is how many operations are started, not how large they are."""
    ready = next(texturable_images(glowing, LAYERS)).prepare(SIZES)
    counts = []
    for number in (1, 2, 6):
        textures = {k: v.expand(number, *v.shape).clone().requires_grad_() for k, v in colours().items()}
        draws = [torch.Generator().manual_seed(k) for k in range(number)]
        PreparedImage.together([ready] * number, textures, draws)  # constants are made once
        with Counted() as counted:
            PreparedImage.together([ready] * number, textures, draws).sum().backward()
        counts.append(counted.count)
    assert counts[0] < 400, counts
    assert counts[2] - counts[1] <= 4 * 8, counts


def test_a_picture_on_the_road_lies_behind_the_target_and_not_on_it(folder: Path) -> None:
    surface = RoadPatch(width=1.5, length=3.0).on(TargetCar().mesh())
    (clip,) = texturable_images(folder, (surface.layer,))
    ready = clip.prepare({0: surface.size})
    black, white = (ready.show({0: torch.full((3, *surface.size), value)}) for value in (0.05, 0.9))
    brighter = ((white - black).amax(1)[0] > 0.1).numpy()
    (seen,) = recorded_views(folder)
    picture = render(seen.scene, [seen.view], quality=seen.quality)
    assert (picture.tag[0][brighter] == 0).mean() > 0.9, "on the street"
    x, y, w, h = next(o["bbox"] for o in seen.objects if o["target"])
    rows, columns = np.nonzero(brighter)
    assert brighter.sum() > 0.1 * w * h
    assert rows.mean() > y + h - 2, "nearer than the car"
    assert x < columns.mean() < x + w
    noise, anew = view_noise(seen.view), render(seen.scene, [seen.with_layers(surface.layer)], quality=seen.quality)
    assert noise is not None
    radiance = retexture(
        texture_taps(anew, surface.size), torch.full((3, *surface.size), 0.9), torch.tensor(anew.radiance)
    )
    whole = jpeg(develop(radiance, float(anew.exposure[0]), SENSOR, torch.tensor(noise)[None]), 92)
    changed = torch.as_tensor(brighter)
    torch.testing.assert_close(white[..., changed], whole[..., changed], rtol=0, atol=1e-5)


def test_at_night_the_glow_of_a_texture_is_part_of_the_picture(glowing: Path) -> None:
    """Head lamps light the car; what the lens scatters of it shows far around it."""
    (seen,) = recorded_views(glowing, hour=lambda weather, heading: at_hour(weather, "night", heading))
    worn = seen.with_layers(LAYERS[0])
    picture = render(seen.scene, [worn], quality=seen.quality)
    noiseless = replace(worn, sensor=replace(worn.sensor, noise=0.0))
    assert visible_part(picture, worn)["noise"].any()
    assert not visible_part(picture, noiseless)["noise"].any()
    (top, bottom), (left, right) = parse_part(visible_part(picture, worn))["glow"]
    touched = np.divmod(picture.fragments["place"].astype(np.int64), 160)
    assert bottom - top > np.ptp(touched[0]) + 10
    assert right - left > np.ptp(touched[1]) + 10
    radiance, taps = torch.tensor(picture.radiance), texture_taps(picture, 32)
    lens, exposure = with_lens_effects(SENSOR, picture.effects), float(picture.exposure[0])
    black, white = (
        develop(retexture(taps, torch.full((3, 32, 32), value), radiance), exposure, lens) for value in (0.0, 1.0)
    )
    change = (white - black)[0].amax(0)
    change[top:bottom, left:right] = 0.0
    # One in the light; the mosaic amplifies differences between neighbours.
    assert 0.0 < float(change.max()) < 6.0 / 255.0


def test_gradients_noise_and_what_cannot_be(folder: Path) -> None:
    clip = next(texturable_images(folder, LAYERS))
    textures = {k: v.requires_grad_() for k, v in colours().items()}
    ready = clip.prepare(SIZES)
    noisy = [ready.show(textures, torch.Generator().manual_seed(seed)) for seed in (1, 1, 2)]
    assert torch.equal(noisy[0], noisy[1])
    assert not torch.equal(noisy[0], noisy[2])
    ready.show(textures).sum().backward()  # type: ignore[no-untyped-call]
    assert all(v.grad is not None and float(v.grad.abs().sum()) > 1.0 for v in textures.values())
    with pytest.raises(ConfigError, match="no size for texture 1"):
        clip.prepare({0: 32})
    with pytest.raises(ConfigError, match="no texture 1"):
        ready.show({0: textures[0]})
    (folder / "annotations" / "train.json").write_text('{"images": [{}]}')
    with pytest.raises(FormatError, match="not the clips of this version"):
        next(texturable_images(folder, split="train"))
