"""Training textures: on a toy whose optimum is known, continued to the bit after a stop, refused where it cannot be."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import torch
from torch import Tensor

from ssad.core.detections import Dense, Truth
from ssad.core.errors import ConfigError, FormatError
from ssad.rendering.camera.scene import TextureLayer
from ssad.scenarios.static.digital import Aim, make_objective
from ssad.scenarios.static.digital.objectives import Hide, Situation
from ssad.scenarios.static.physical import make_physical
from ssad.scenarios.static.physical.lights.projector import AIMED, Projector
from ssad.scenarios.static.physical.textures.attention import (
    Distraction,
    Redistribution,
    _mean_part_attention,
    attention,
)
from ssad.scenarios.static.physical.textures.carrier import TextureSurface, albedo_of
from ssad.scenarios.static.physical.textures.controls import control
from ssad.scenarios.static.physical.textures.inks import project_onto_gamut, share_outside
from ssad.scenarios.static.physical.textures.optimise import (
    TARGET,
    TextureAttack,
    TextureView,
    _order,
    train_texture,
)
from ssad.scenarios.static.physical.textures.printing import NOMINAL, Expectation, conspicuousness
from tests.scenarios.static.digital.toy_detector import CELL, ToyDetector, pattern, toy_scene

SURFACE = TextureSurface(TextureLayer(0), (CELL, CELL), np.ones((CELL, CELL), bool), (1.0, 1.0))
GAIN = 0.2
PLAIN = TextureAttack(
    "plain", "hide", epochs=12, inks=False, rate=0.1, batch=2, smooth=0.0, printed=0.0, expectation=NOMINAL
)


@dataclass(frozen=True)
class Painted:
    """A picture whose target, one cell, is lit as its texture is."""

    image: Tensor
    corner: tuple[int, int]

    def show(self, textures: dict[int, Tensor], noise: torch.Generator | None = None) -> Tensor:
        whole = self.image.clone()[None]
        left, top = self.corner
        cell = (0, slice(None), slice(top, top + CELL), slice(left, left + CELL))
        whole[cell] = (whole[cell] + GAIN * (textures[0] - 0.46)).clamp(0.0, 1.0)
        return whole

    @classmethod
    def together(
        cls,
        pictures: Sequence[Painted],
        textures: Mapping[int, Tensor],
        noise: Sequence[torch.Generator] | None = None,
    ) -> Tensor:
        return torch.cat([one.show({0: texture}) for one, texture in zip(pictures, textures[0], strict=True)])


def views(count: int = 4, *, seed: int = 0) -> list[TextureView]:
    """Pictures of one class; the first object is the target."""
    images, truth = toy_scene(count, objects=3, classes=("car",), seed=seed)
    return [
        TextureView(Painted(image, tuple(one.box[0, :2].long().tolist())), one)
        for image, one in zip(images, truth, strict=True)
    ]


def detector() -> ToyDetector:
    return ToyDetector(("car",), spread=0.0)


def score(colour: Tensor, seen: list[TextureView]) -> float:
    """Mean score of the target's cell."""
    found = []
    for view in seen:
        dense = detector().dense(view.picture.show({0: albedo_of(colour)}))
        own = ((dense.place - view.truth.box[0, :2] - CELL / 2).abs() < 1).all(1)
        found.append(float(dense.logit[0, own, 0].sigmoid()))
    return float(np.mean(found))


def test_a_trained_texture_beats_all_that_learn_nothing() -> None:
    """Also on pictures that it was not trained on; it is the class's pattern turned round."""
    trained = train_texture(PLAIN, detector(), SURFACE, views(), start=control("grey", SURFACE.size))
    assert trained.losses[-1] > trained.losses[0]
    fresh = views(seed=9)
    own = score(trained.colour, fresh)
    size = SURFACE.size
    others = [control("grey", size), *(control(name, size, seed=k) for name in ("random", "noise") for k in range(3))]
    others.append(trained.colour.flatten(1).flip(1).reshape(trained.colour.shape))
    assert own < 0.5 * min(score(other, fresh) for other in others)
    assert bool((torch.sign(0.5 - trained.colour) == pattern("car")).float().mean() > 0.95)


def test_a_texture_of_inks_can_be_printed_and_still_beats_controls() -> None:
    """The same training over any colours leaves the gamut, so the share outside is 0 for a reason."""
    start, size = control("grey", SURFACE.size), SURFACE.size
    any_colour = train_texture(PLAIN, detector(), SURFACE, views(), start=start)
    printed = train_texture(replace(PLAIN, inks=True), detector(), SURFACE, views(), start=start)
    assert share_outside(any_colour.colour) > 0.5
    assert share_outside(printed.colour) == 0.0
    assert torch.equal(project_onto_gamut(printed.colour), printed.colour)
    fresh = views(seed=9)
    controls = [project_onto_gamut(control(name, size, seed=k)) for name in ("random", "noise") for k in range(3)]
    assert score(any_colour.colour, fresh) < score(printed.colour, fresh)
    assert score(printed.colour, fresh) < 0.7 * min(score(other, fresh) for other in [start, *controls])


def test_an_epoch_has_each_picture_once_unless_a_share_goes_to_the_worst() -> None:
    draws, losses = np.random.default_rng(0), np.array([-1.0, 1.0] * 500)
    assert sorted(_order(PLAIN, losses, draws)) == list(range(1000))
    assert sorted(_order(replace(PLAIN, worst=1.0), np.zeros(1000), draws)) == list(range(1000)), "none is worse"
    order = _order(replace(PLAIN, worst=0.25), losses, draws)
    assert len(order) == 1000
    assert len(set(order[250:])) == 750, "the others come once each"
    # the loss is ascended: the lower it is, the more of the target is still detected
    for worst in (0.25, 1.0):
        chosen = losses[_order(replace(PLAIN, worst=worst), losses, draws)[: int(1000 * worst)]]
        assert np.mean(chosen < 0.0) == pytest.approx(np.exp(1) / (np.exp(1) + np.exp(-1)), abs=0.06)


def test_pictures_on_which_the_attack_fails_are_shown_more_often() -> None:
    """One target in four is detected; a tiny rate leaves it so."""
    shown: list[int] = []

    @dataclass(frozen=True)
    class Counted(Painted):
        number: int = 0

        @classmethod
        def together(
            cls,
            pictures: Sequence[Counted],  # type: ignore[override]
            textures: Mapping[int, Tensor],
            noise: Sequence[torch.Generator] | None = None,
        ) -> Tensor:
            shown.extend(one.number for one in pictures)
            return super().together(pictures, textures, noise)

    seen = []
    for number, view in enumerate(views(4)):
        image, (left, top) = view.picture.image.clone(), view.picture.corner
        if number != 2:
            image[:, top : top + CELL, left : left + CELL] = 0.5  # nothing of the pattern that the detector looks for
        seen.append(replace(view, picture=Counted(image, (left, top), number)))
    attack = replace(PLAIN, epochs=13, rate=1e-6, worst=1.0)
    train_texture(attack, detector(), SURFACE, seen, start=control("grey", SURFACE.size))
    assert sorted(shown[:4]) == [0, 1, 2, 3], "nothing is known in the first epoch"
    assert shown[4:].count(2) > 0.5 * len(shown[4:])


def test_stealth_keeps_a_texture_near_what_it_covers() -> None:
    paint = torch.tensor([0.46, 0.47, 0.48])
    attacks = [replace(PLAIN, stealth=weight, epochs=40) for weight in (0.0, 3.0, 100.0)]
    start = control("grey", SURFACE.size)
    made = [train_texture(one, detector(), SURFACE, views(), start=start, paint=paint).colour for one in attacks]
    away = [float(conspicuousness(albedo_of(one), paint)) for one in made]
    assert away[0] > 2.0 * away[1] > 4.0 * away[2], "83, 20 and 3 when this was written"
    found = [score(one, views(seed=9)) for one in made]
    assert found[0] < found[1] < 0.2 < found[2]
    with pytest.raises(ConfigError, match="whose colour is known"):
        train_texture(replace(PLAIN, stealth=0.1), detector(), SURFACE, views(), start=control("grey", SURFACE.size))


@pytest.mark.parametrize("optimiser", ["adam", "sgd"])
def test_a_training_that_was_stopped_goes_on_to_the_bit(tmp_path: Path, optimiser: str) -> None:
    attack = TextureAttack("stopped", "hide", epochs=5, batch=2, worst=0.5, optimiser=optimiser, decay=1e-4)  # type: ignore[arg-type]
    start, inks = control("random", SURFACE.size), torch.rand(4, 3, generator=torch.Generator().manual_seed(1))

    class Stop(Exception):
        pass

    def stop(done: int, of: int) -> None:
        if done == 3:
            raise Stop

    given = (attack, detector(), SURFACE, views())
    whole = train_texture(*given, start=start, printable=inks)
    path = tmp_path / "new" / "texture.npz"
    with pytest.raises(Stop):
        train_texture(*given, start=start, printable=inks, checkpoint=path, progress=stop)
    done: list[int] = []
    after = train_texture(
        *given, start=start, printable=inks, checkpoint=path, progress=lambda number, of: done.append(number)
    )
    assert done == [4, 5]
    assert torch.equal(after.colour, whole.colour)
    assert after.losses == whole.losses
    again = train_texture(*given, start=start, printable=inks, checkpoint=path)
    assert torch.equal(again.colour, whole.colour)
    more = train_texture(replace(attack, epochs=6), *given[1:], start=start, printable=inks, checkpoint=path)
    assert more.losses[:5] == whole.losses
    assert len(more.losses) == 6
    with pytest.raises(FormatError, match="of another training"):
        train_texture(replace(attack, rate=0.01), *given[1:], start=start, checkpoint=path)


class Solid(ToyDetector):
    """Keeps what it is shown, and with which cameras."""

    seen: ClassVar[list[tuple[tuple[int, ...], list[float]]]] = []

    def dense(self, images: Tensor, intrinsic: Tensor | None = None) -> Dense:
        assert intrinsic is not None
        self.seen.append((tuple(images.shape[2:]), intrinsic[:, 0, 0].tolist()))
        return super().dense(images, intrinsic)


def test_a_3d_detector_is_shown_whole_pictures_with_their_cameras() -> None:
    pictures = [
        replace(view, truth=replace(view.truth, intrinsic=torch.eye(3) * (k + 1.0))) for k, view in enumerate(views(4))
    ]
    attack = replace(PLAIN, epochs=1, window=128)
    train_texture(
        attack, Solid(("car",), spread=0.0, task="3d"), SURFACE, pictures, start=control("grey", SURFACE.size)
    )
    size = tuple(pictures[0].picture.show({0: control("grey", SURFACE.size)}).shape[2:])  # type: ignore[attr-defined]
    assert {shape for shape, _ in Solid.seen} == {size}, "a window would move the camera's middle"
    assert sorted(focal for _, focals in Solid.seen for focal in focals) == [1.0, 2.0, 3.0, 4.0]


def test_draws_come_from_the_key_alone() -> None:
    attack = replace(PLAIN, epochs=1, expectation=Expectation())
    start = control("grey", SURFACE.size)
    found = [train_texture(attack, detector(), SURFACE, views(), start=start, key=(k,)).colour for k in (1, 1, 2)]
    assert torch.equal(found[0], found[1])
    assert not torch.equal(found[0], found[2])


def test_what_the_detector_was_stays() -> None:
    victim = detector().train()
    train_texture(replace(PLAIN, epochs=1), victim, SURFACE, views(), start=control("grey", SURFACE.size))
    assert victim.training


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"views": []}, ConfigError, "no pictures"),
        ({"start": torch.zeros(3, 4, 4)}, ConfigError, "the surface takes"),
        ({"start": torch.full((3, CELL, CELL), 1.5)}, ConfigError, "lie in 0 to 1"),
    ],
)
def test_what_cannot_be_trained_is_refused(change: dict[str, object], error: type[Exception], message: str) -> None:
    given = {"attack": PLAIN, "views": views(), "start": control("grey", SURFACE.size)} | change
    with pytest.raises(error, match=message):
        train_texture(given["attack"], detector(), SURFACE, given["views"], start=given["start"])  # type: ignore[arg-type]


def test_a_target_that_is_never_in_view_is_said() -> None:
    @dataclass(frozen=True)
    class Away:
        image: Tensor

        @classmethod
        def together(cls, pictures: Sequence[Away], textures: Mapping[int, Tensor], noise: object = None) -> Tensor:
            return torch.stack([one.image for one in pictures]) + 0.0 * textures[0].sum()

    images, truth = toy_scene(2, classes=("car",))
    seen = [TextureView(Away(image), one) for image, one in zip(images, truth, strict=True)]
    with pytest.raises(ConfigError, match="never in view"):
        train_texture(PLAIN, detector(), SURFACE, seen, start=control("grey", SURFACE.size))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("epochs", 0),
        ("epochs", 2.5),
        ("batch", 0),
        ("batch", 2.5),
        ("batch", True),
        ("rate", 0.0),
        ("rate", "fast"),
        ("rate", float("nan")),
        ("optimiser", "lbfgs"),
        ("worst", 1.5),
        ("stealth", -1.0),
        ("smooth", "x"),
        ("smooth", -1.0),
        ("printed", -1.0),
        ("decay", -1.0),
        ("window", 200),
        ("window", 96),
        ("window", "256"),
        ("objective", "hid"),
        ("objective", 3),
        ("expectation", 3),
        ("expectation", {"noise": "x"}),
        ("expectation", {"nois": 0.2}),
        ("expectation", {"contrast": [1.2, 0.8]}),
        ("name", "x"),
        ("speed", 3),
    ],
)
def test_settings_that_cannot_be_are_refused_in_one_line(key: str, value: object) -> None:
    with pytest.raises(ConfigError, match=f"attack vanishing: .*{key}") as found:
        make_physical("vanishing", **{key: value})
    assert "\n" not in str(found.value)


def test_an_expectation_is_said_as_a_mapping_of_what_differs() -> None:
    made = make_physical("das", expectation={"noise": 0.2, "contrast": [0.5, 1]})
    assert made.expectation == Expectation((0.5, 1.0), noise=0.2)
    assert Projector().training(expectation={"noise": 0.2}).expectation == replace(AIMED, noise=0.2)
    with pytest.raises(ConfigError, match="attack projector: stealth"):
        Projector().training(stealth=1.0)


def test_an_attack_of_a_package_may_be_an_object_and_takes_settings_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ssad.scenarios.static.physical.textures.attacks.resolve", lambda *_: PLAIN)
    assert make_physical("mine", epochs=3) == replace(PLAIN, epochs=3)


def test_hide_is_the_best_box_on_the_object() -> None:
    """log(1 - largest score x IoU), of the aim's object alone."""
    victim = ToyDetector(("car",), spread=0.0)
    images, truth = toy_scene(1, objects=2, classes=("car",))
    dense = replace(victim.dense(images), box=victim.dense(images).box.detach())
    situation = Situation(victim, victim.assign(dense, truth), Aim(objects=(1,)))
    best = 0.0
    real = truth[0].box[1]
    for score_, found in zip(dense.logit[0, :, 0].sigmoid().tolist(), dense.box[0], strict=True):
        side = (torch.minimum(found[2:], real[2:]) - torch.maximum(found[:2], real[:2])).clamp_min(0)
        both = float(side.prod())
        union = float((found[2:] - found[:2]).prod()) + CELL * CELL - both
        best = max(best, score_ * both / union)
    assert best > 0.5
    assert Hide()(dense, situation).item() == pytest.approx(float(np.log1p(-best)), rel=1e-4)
    all_of_them = Hide()(dense, Situation(victim, victim.assign(dense, truth)))
    assert all_of_them.item() < Hide()(dense, situation).item(), "of both objects"
    assert make_objective("hide").needs_objects


def test_hide_any_does_not_hide_a_thing_by_making_it_another() -> None:
    """With the scores of the two classes swapped, `hide` finds nothing left, `hide-any` as much as before."""
    victim = ToyDetector(("car", "truck"), spread=0.0)
    images, truth = toy_scene(1, objects=1, classes=("car",))
    dense = victim.dense(images)
    logit = torch.stack([dense.logit[..., 0], torch.full_like(dense.logit[..., 0], -20.0)], -1)
    clear, taken = replace(dense, logit=logit), replace(dense, logit=logit.flip(-1))
    situation = Situation(victim, victim.assign(clear, truth))
    own, anything = make_objective("hide"), make_objective("hide-any")
    assert own(clear, situation).item() < -0.5
    assert own(taken, situation).item() == pytest.approx(0.0, abs=1e-3)
    assert anything(clear, situation).item() == pytest.approx(Hide(others=20)(clear, situation).item())
    assert anything(taken, situation).item() == pytest.approx(anything(clear, situation).item())


class Attentive(ToyDetector):
    """Shows one feature map a level: the picture's cells, which its logits are computed from."""

    def dense(self, images: Tensor, intrinsic: Tensor | None = None):  # type: ignore[no-untyped-def]
        feature = torch.nn.functional.avg_pool2d(images, CELL)
        logit = feature.mean(1).flatten(1)[..., None] * 8.0 - 4.0
        plain = super().dense(images, intrinsic)
        return replace(plain, logit=logit, features=(feature,))


def bright(target: float, elsewhere: float) -> tuple[Attentive, Tensor, list[Truth]]:
    """A picture [1, 3, 48, 64] with one bright cell, the target's, and its truth."""
    images = torch.full((1, 3, 48, 64), elsewhere)
    images[:, :, 16:24, 24:32] = target
    return Attentive(("car",)), images, [Truth(torch.tensor([0]), torch.tensor([[24.0, 16.0, 32.0, 24.0]]))]


def test_attention_is_where_the_score_comes_from() -> None:
    victim, images, truth = bright(0.9, 0.1)
    dense = victim.dense(images.requires_grad_())
    found = attention(dense, Situation(victim, victim.assign(dense, truth), TARGET), dense.features)[0]
    assert found.shape == (1, 6, 8)
    assert found.argmax() == 2 * 8 + 3
    assert float(found.detach().max()) == pytest.approx(1.0)
    with pytest.raises(ConfigError, match="shows no feature maps"):
        attention(dense, Situation(victim, victim.assign(dense, truth), TARGET), ())


@pytest.mark.parametrize("objective", [Redistribution(), Distraction()])
def test_attention_losses_rise_when_the_target_fades(objective: Redistribution | Distraction) -> None:
    """Their slope in the target's cell is down: a step along it takes attention from the target."""
    victim, images, truth = bright(0.9, 0.1)
    images = images.requires_grad_()
    dense = victim.dense(images)
    value = objective(dense, Situation(victim, victim.assign(dense, truth), TARGET))
    assert value.shape == (1,)
    (slope,) = torch.autograd.grad(value.sum(), images)
    assert float(slope[0, :, 16:24, 24:32].mean()) < 0.0
    if isinstance(objective, Redistribution):
        assert float(slope[0, :, :16].mean()) > 0.0, "and the surroundings gain"


def test_parts_of_an_attention_map_by_hand() -> None:
    """Two parts above the mean: of 3 cells with 2.4 in all, and of 1 cell with 0.6."""
    local = torch.zeros(7, 7)
    local[1, 1], local[1, 2], local[2, 2] = 1.0, 0.8, 0.6
    local[5, 5] = 0.6
    assert float(_mean_part_attention(local[None])) == pytest.approx(0.5 * (2.4 / 47 + 0.6 / 49))
    snake = torch.zeros(7, 7)
    snake[0, :], snake[1, 6], snake[2, :], snake[3, 0], snake[4, :] = 1.0, 1.0, 1.0, 1.0, 1.0
    assert float(_mean_part_attention(torch.stack([local, snake]))[1]) == pytest.approx(23 / 27), (
        "one part, however it winds"
    )
    assert float(_mean_part_attention(torch.zeros(1, 7, 7))) == 0.0, "nothing above the mean"
