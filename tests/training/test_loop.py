"""Training: going on after a stop, what is refused, several processes, and truth that follows the changed pictures."""

import json
import math
import socket
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.mono3d import TINY, TINY_PGD, lens, lively, some_truth
from helpers.training import COLOURS, RECIPE, SIZE, bank, fresh, learn
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.multiprocessing.spawn import spawn

from ssad.core.detections import Truth
from ssad.core.errors import ConfigError, FormatError, StoreError, UnknownNameError
from ssad.core.tensor_boxes import solid_corners
from ssad.core.types import U8
from ssad.detectors.mono3d.config import Mono3DConfig
from ssad.detectors.mono3d.decode import hull, project
from ssad.training import loop
from ssad.training.batches import (
    Augmentation,
    ImagesOnDisk,
    TrainingImage,
    augment_colours,
    augment_images,
    augment_truths,
    draw_augmentation,
    load_images,
    make_batch,
    order,
    repetition_counts,
)
from ssad.training.detector import parse_changes
from ssad.training.loop import LAST_CHECKPOINT, LOG, train, weighted_sum
from ssad.training.recipe import RECIPES, Recipe, command_line_changes, find_recipe


def change_truth(truth: Truth, change: Augmentation, size: tuple[int, int], *, keep: float) -> Truth:
    """Truth of one changed picture."""
    return augment_truths([truth], [change], size, min_visible_share=keep)[0]


def same(a: Any, b: Any) -> bool:
    one, two = a.state_dict(), b.state_dict()
    return one.keys() == two.keys() and all(torch.equal(one[name], two[name]) for name in one)


# ---------------------------------------------------------------- the loop


def test_a_rate_that_falls_within_a_time_falls_to_its_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first epoch takes 4 s as something compiles, the others 1 s; a stop in between changes nothing."""
    clock, recipe = [0.0], replace(RECIPE, epochs=30, within=10.5, warmup=0)
    follower = loop._follower

    def ticking(average: Any, detector: Any) -> Callable[[float], None]:
        follow = follower(average, detector)

        def tick(decay: float) -> None:
            clock[0] += (4.0 if clock[0] < 4.0 else 1.0) / 2
            follow(decay)

        return tick

    monkeypatch.setattr(loop, "_follower", ticking)
    monkeypatch.setattr("time.monotonic", lambda: clock[0])
    whole = train(fresh(), bank(), recipe, out=tmp_path / "whole")
    rows = loop.read_rows(tmp_path / "whole")
    assert rows[0]["of"] == 2, "told by the first epoch alone"
    assert [row["epoch"] for row in rows] == list(range(1, 8))
    assert {row["of"] for row in rows[1:]} == {7}, "4 s and six of 1 s are within 10.5 s"
    assert rows[-1]["lr"] == pytest.approx(recipe.lr * recipe.last)
    clock[0] = 0.0
    train(fresh(), bank(), recipe, out=tmp_path / "parts", seconds=5.5)
    assert len(loop.read_rows(tmp_path / "parts")) < 7
    assert same(whole, train(fresh(), bank(), recipe, out=tmp_path / "parts"))


@pytest.mark.parametrize(
    "recipe",
    [RECIPE, replace(RECIPE, epochs=2, average=0.0, optimizer="sgd", schedule="linear")],
    ids=["average", "sgd"],
)
def test_going_on_after_a_stop_gives_the_same_bits(recipe: Recipe, tmp_path: Path) -> None:
    data = bank()
    whole = train(fresh(), data, recipe, out=tmp_path / "whole")
    stopped = train(fresh(), data, recipe, out=tmp_path / "parts", seconds=0.0)
    assert len((tmp_path / "parts" / LOG).read_text().splitlines()) == 1
    gone_on = train(fresh(), data, recipe, out=tmp_path / "parts")
    assert same(whole, gone_on)
    assert not same(whole, stopped)
    assert not any(value.requires_grad for value in gone_on.parameters())
    assert not gone_on.training


def test_a_finished_training_gives_its_weights_again(tmp_path: Path) -> None:
    first = train(fresh(), bank(), RECIPE, out=tmp_path)
    log = (tmp_path / LOG).read_text()
    assert same(first, train(fresh(), bank(), RECIPE, out=tmp_path))
    assert (tmp_path / LOG).read_text() == log


def test_the_seed_decides(tmp_path: Path) -> None:
    one, two, other = (
        train(fresh(), bank(), replace(RECIPE, epochs=1, seed=seed), out=tmp_path / name)
        for name, seed in (("a", 0), ("b", 0), ("c", 1))
    )
    assert same(one, two)
    assert not same(one, other)


def test_the_log_has_a_line_an_epoch(tmp_path: Path) -> None:
    said: list[str] = []
    seen: list[int] = []

    def validate(detector: Any) -> dict[str, float]:
        assert not detector.training
        seen.append(1)
        return {"AP50": 0.25}

    recipe = replace(RECIPE, epochs=3, validate=2)
    train(fresh(), bank(), recipe, out=tmp_path, validate=validate, report=said.append)
    rows = [json.loads(line) for line in (tmp_path / LOG).read_text().splitlines()]
    assert [row["epoch"] for row in rows] == [1, 2, 3]
    assert all({"lr", "images_s", "loss_box", "loss_obj", "loss_cls"} <= row.keys() for row in rows)
    assert [row.get("AP50") for row in rows] == [None, 0.25, None], "after the last epoch the caller measures all"
    assert len(seen) == 1
    assert len(said) == 3
    assert all("\n" not in line for line in said)


def test_a_lost_epoch_is_logged_once(tmp_path: Path) -> None:
    train(fresh(), bank(), RECIPE, out=tmp_path, seconds=0.0)
    line = (tmp_path / LOG).read_text()
    (tmp_path / LOG).write_text(line + line.replace('"epoch":1', '"epoch":2').replace('"epoch": 1', '"epoch": 2'))
    train(fresh(), bank(), RECIPE, out=tmp_path)
    rows = [json.loads(line) for line in (tmp_path / LOG).read_text().splitlines()]
    assert [row["epoch"] for row in rows] == [1, 2, 3]


def test_another_recipe_in_the_same_folder_is_one_line(tmp_path: Path) -> None:
    train(fresh(), bank(), RECIPE, out=tmp_path, seconds=0.0)
    with pytest.raises(FormatError, match=f"{LAST_CHECKPOINT}: of another recipe; choose another folder") as caught:
        train(fresh(), bank(), replace(RECIPE, lr=1e-3), out=tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", ["text", "empty", "cut", "list", "pickle", "other"])
def test_a_broken_checkpoint_is_one_line(kind: str, tmp_path: Path) -> None:
    train(fresh(), bank(4), replace(RECIPE, epochs=2), out=tmp_path, seconds=0.0)
    last = tmp_path / LAST_CHECKPOINT
    if kind == "cut":
        last.write_bytes(last.read_bytes()[: last.stat().st_size // 2])
    elif kind == "list":
        torch.save([1, 2], last)
    elif kind == "pickle":
        torch.save({"recipe": Path("x")}, last)
    elif kind == "other":  # the same recipe, another detector
        state = torch.load(last, weights_only=True)
        torch.save(state | {"model": {"a": torch.zeros(1)}}, last)
    else:
        last.write_bytes(b"hello" if kind == "text" else b"")
    with pytest.raises(FormatError, match=LAST_CHECKPOINT) as caught:
        train(fresh(), bank(4), replace(RECIPE, epochs=2), out=tmp_path)
    assert "\n" not in str(caught.value)


def test_a_loss_that_is_not_finite_is_one_line(tmp_path: Path) -> None:
    detector = fresh()
    detector.network.outputs()[0].bias.data.fill_(math.nan)
    with pytest.raises(ConfigError, match="the loss is not finite in epoch 1; use a smaller lr"):
        train(detector, bank(4), RECIPE, out=tmp_path)
    assert not (tmp_path / LAST_CHECKPOINT).exists()


def test_a_folder_that_is_a_file_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError) as caught:
        train(fresh(), bank(4), replace(RECIPE, epochs=1), out=tmp_path / "file")
    assert "\n" not in str(caught.value)


def test_frozen_parts_and_norms_stay(tmp_path: Path) -> None:
    detector = fresh()
    first = next(name for name, _ in detector.named_parameters()).rsplit(".", 2)[0]
    before = {name: value.clone() for name, value in detector.state_dict().items()}
    recipe = replace(RECIPE, epochs=1, freeze=(first,), norm_eval=True, average=0.0)
    after = train(detector, bank(), recipe, out=tmp_path).state_dict()
    held = [name for name in before if name.startswith(first) or "running" in name]
    assert held
    assert all(torch.equal(before[name], after[name]) for name in held)
    assert any(not torch.equal(before[name], after[name]) for name in before)


@pytest.mark.slow
def test_it_learns(tmp_path: Path) -> None:
    recipe = replace(RECIPE, epochs=40, average=0.0, zoom=(1.0, 1.0))
    train(fresh(), bank(16), recipe, out=tmp_path)
    rows = [json.loads(line) for line in (tmp_path / LOG).read_text().splitlines()]
    total = [sum(value for name, value in row.items() if name.startswith("loss_")) for row in rows]
    assert total[-1] < 0.5 * total[0]


# ---------------------------------------------------------------- several processes


@pytest.mark.slow
def test_two_processes_learn_the_same_weights(tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = int(free.getsockname()[1])
    spawn(learn, (2, port, str(tmp_path)), nprocs=2)  # type: ignore[no-untyped-call]
    one, two = (torch.load(tmp_path / f"{rank}.pt", weights_only=True) for rank in (0, 1))
    assert one.keys() == two.keys()
    for name, value in one.items():
        assert value.isfinite().all()
        assert torch.equal(value, two[name]), name
    start = dict(fresh().named_parameters())
    assert any(not torch.equal(value, start[name]) for name, value in one.items())
    assert len((tmp_path / LOG).read_text().splitlines()) == 2


# ---------------------------------------------------------------- batches


def test_every_picture_is_seen_once_an_epoch() -> None:
    seen = order(10, 3, seed=1, epoch=2)
    assert [len(one) for one in seen] == [3, 3, 3]
    assert len({k for one in seen for k in one}) == 9
    assert seen == order(10, 3, seed=1, epoch=2)
    assert seen != order(10, 3, seed=1, epoch=3)
    assert order(2, 5, seed=0, epoch=0) in ([[0, 1]], [[1, 0]])


def with_classes(*labels: int, crowd: bool = False) -> Truth:
    """Truth of a picture with objects of some classes."""
    marks = torch.tensor([crowd] * len(labels)) if crowd else None
    return Truth(torch.tensor(labels, dtype=torch.int64), torch.zeros(len(labels), 4), crowd=marks)


def test_pictures_of_rare_classes_are_repeated() -> None:
    truths = [with_classes(0)] * 98 + [with_classes(0, 1)] + [with_classes(2, crowd=True)]
    often = repetition_counts(truths, 0.04)
    assert often is not None
    np.testing.assert_allclose(often[:98], 1.0)
    np.testing.assert_allclose(often[98], 2.0)  # sqrt(0.04 / 0.01)
    assert often[99] == 1.0, "what is not learned from does not count"
    assert repetition_counts(truths, 0.0) is None


@given(st.integers(0, 10**6), st.integers(1, 7), st.lists(st.floats(1.0, 3.0), min_size=8, max_size=40))
def test_an_epoch_shows_each_picture_as_often_as_asked(seed: int, batch: int, wanted: list[float]) -> None:
    often = np.array(wanted)
    epochs = [order(len(often), batch, seed=seed, epoch=e, weights=often) for e in range(2)]
    shown = math.ceil(often.sum() - 1e-9)
    assert len(epochs[0]) == len(epochs[1]) == max(shown // batch, 1)
    single = [k for one in order(len(often), 1, seed=seed, epoch=0, weights=often) for k in one]
    counts = np.bincount(single, minlength=len(often))
    assert counts.sum() == shown
    assert (counts >= np.floor(often)).all()
    assert (counts <= np.ceil(often * shown / often.sum() - 1e-9)).all()
    whole = np.full(len(often), 2.0)
    twice = np.bincount([k for one in order(len(often), 1, seed=seed, epoch=1, weights=whole) for k in one])
    assert (twice == 2).all()


def test_a_zoom_is_about_the_principal_point() -> None:
    lens = torch.tensor([[500.0, 0.0, 30.0], [0.0, 500.0, 15.0], [0.0, 0.0, 1.0]])
    recipe = replace(find_recipe("fcos3d-light"), zoom=(0.5, 2.0))
    rng = np.random.default_rng(3)
    for _ in range(20):
        change = draw_augmentation(recipe, (40, 80), rng, lens=lens)
        truth = change_truth(
            Truth(torch.zeros(0, dtype=torch.int64), torch.zeros(0, 4), intrinsic=lens), change, (40, 80), keep=0
        )
        assert truth.intrinsic is not None
        across = 80.0 - 30.0 if change.mirror else 30.0
        np.testing.assert_allclose(truth.intrinsic[:2, 2].numpy(), [across, 15.0], atol=1e-4)
        np.testing.assert_allclose(truth.intrinsic[0, 0], 500.0 * change.zoom, rtol=1e-6)


def test_a_picture_that_rises_takes_its_lens_along() -> None:
    truth = some_truth(3, size=(40, 80), focal=60.0)
    recipe = replace(find_recipe("fcos3d-light"), zoom=(1.0, 1.0), flip=0.0, rise=6.0)
    rng = np.random.default_rng(5)
    moved = [draw_augmentation(recipe, (40, 80), rng, lens=truth.intrinsic).shift for _ in range(50)]
    assert {across for across, _ in moved} == {0.0}
    assert -6 <= min(down for _, down in moved) < -3 < 3 < max(down for _, down in moved) <= 6
    after = change_truth(truth, Augmentation(False, 1.0, moved[0]), (40, 80), keep=0)
    assert after.solid is not None
    assert after.intrinsic is not None
    assert truth.solid is not None
    before = project(truth.solid.centre, lens(60.0, (40, 80)))
    now = project(after.solid.centre, after.intrinsic)
    np.testing.assert_allclose(now[:, 0], before[: len(now), 0], atol=1e-4)
    np.testing.assert_allclose(now[:, 1], before[: len(now), 1] + moved[0][1], atol=1e-4)


@pytest.mark.parametrize("config", [TINY, TINY_PGD], ids=["fcos3d", "pgd"])
def test_a_step_with_doubt_lowers_the_centreness_to_be_learned(config: Mono3DConfig) -> None:
    detector = lively(config)
    images = torch.rand(1, 3, 70, 110, generator=torch.Generator().manual_seed(0))
    truth = some_truth(4, size=(70, 110), focal=90.0)
    losses = [loop.TrainingStep(detector, amp=False, doubt=doubt)(images, [truth]) for doubt in (0.0, 2.0)]
    changed = {key for key in losses[0] if not torch.equal(losses[0][key], losses[1][key])}
    assert "centerness" in changed
    assert "cls" not in changed


def test_losses_are_weighed_by_name() -> None:
    losses = {"one": torch.tensor(2.0), "two": torch.tensor(3.0)}
    assert float(weighted_sum(losses, {})) == 5.0
    assert float(weighted_sum(losses, {"two": 0.5})) == 3.5
    with pytest.raises(ConfigError, match="there is no loss 'three'; there are one, two"):
        weighted_sum(losses, {"three": 1.0})


def test_a_batch_is_decided_by_its_key() -> None:
    data, device = bank(), torch.device("cpu")
    recipe = replace(RECIPE, noise=0.05)
    torch.manual_seed(0)
    images, truth = make_batch(data, [3, 1], recipe, key=(0, 1, 2, 0), device=device)
    torch.manual_seed(1)
    again, other = (make_batch(data, [3, 1], recipe, key=(0, 1, k, 0), device=device) for k in (2, 3))
    assert torch.equal(images, again[0])
    assert not torch.equal(images, other[0])
    assert all(torch.equal(a.box, b.box) for a, b in zip(truth, again[1], strict=True))
    assert images.shape == (2, 3, *SIZE)
    assert 0 <= float(images.min()) <= float(images.max()) <= 1


def test_pictures_that_do_not_fit_are_read_when_they_are_wanted(monkeypatch: pytest.MonkeyPatch) -> None:
    items = [
        TrainingImage(
            lambda k=k: np.full((6, 8, 3), k, np.uint8), Truth(torch.zeros(0, dtype=torch.int64), torch.zeros(0, 4))
        )  # type: ignore[misc]
        for k in range(9)
    ]
    held = load_images(items)
    monkeypatch.setattr("ssad.training.batches.free_memory", lambda device: 100.0)
    bank = load_images(items)
    assert isinstance(bank.pictures, ImagesOnDisk)
    rows = torch.tensor([8, 0, 3])
    assert torch.equal(bank.pictures[rows], held.pictures[rows])
    assert torch.equal(bank.pictures[2:5], held.pictures[2:5])
    where = torch.device("cpu")
    one, two = (make_batch(b, [4, 1], RECIPE, key=(1, 2), device=where)[0] for b in (bank, held))
    assert torch.equal(one, two)
    broken = load_images([*items[:-1], TrainingImage(lambda: np.zeros((5, 8, 3), np.uint8), items[0].truth)])
    with pytest.raises(ConfigError, match="picture 8 has the size"):
        _ = broken.pictures[torch.tensor([8])]


def test_a_prefix_that_freezes_nothing_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="freeze: no parameter's name starts with 'bla'"):
        train(fresh(), bank(), replace(RECIPE, freeze=("bla",)), out=tmp_path)


def test_other_data_or_first_weights_in_the_same_folder_are_one_line(tmp_path: Path) -> None:
    train(fresh(), bank(), RECIPE, out=tmp_path, metadata="a")
    with pytest.raises(FormatError, match="of other data, other first weights"):
        train(fresh(), bank(), RECIPE, out=tmp_path, metadata="b")


def test_pictures_are_read_in_order_and_must_be_of_one_size() -> None:
    data = bank(40)

    def reader(k: int) -> U8:
        return data.pictures[k].numpy()

    items = [TrainingImage(lambda k=k: reader(k), truth) for k, truth in enumerate(data.truth)]  # type: ignore[misc]
    assert torch.equal(load_images(items).pictures, data.pictures)
    items.append(TrainingImage(lambda: np.zeros((5, 7, 3), np.uint8), data.truth[0]))
    with pytest.raises(ConfigError, match=r"picture 40 has the size \(5, 7\)"):
        load_images(items)
    with pytest.raises(ConfigError, match="no picture to train on"):
        load_images([])


def coloured(picture: Tensor, label: int) -> Tensor:
    """Which pixels [H, W] of a picture [3, H, W] have the colour of a class."""
    colour = torch.tensor(COLOURS[label])[:, None, None] / 255
    return (picture - colour).abs().amax(0) < 0.15


@pytest.mark.parametrize("zoom", [(1.0, 1.0), (0.5, 0.9), (1.1, 2.0)], ids=["as it is", "smaller", "larger"])
def test_boxes_stay_on_their_squares(zoom: tuple[float, float]) -> None:
    data, recipe = bank(12), replace(RECIPE, zoom=zoom, keep=0.0)
    rng = np.random.default_rng(4)
    pictures = data.pictures.permute(0, 3, 1, 2).float() / 255
    changes = [draw_augmentation(recipe, SIZE, rng) for _ in data.truth]
    assert len({one.mirror for one in changes}) == 2
    changed = augment_images(pictures, changes)
    count = 0
    for picture, change, truth in zip(changed, changes, data.truth, strict=True):
        after = change_truth(truth, change, SIZE, keep=recipe.keep)
        inside = torch.zeros(2, *SIZE, dtype=torch.bool)
        for label, box in zip(after.label.tolist(), after.box, strict=True):
            x1, y1, x2, y2 = box.tolist()
            full = coloured(picture, label)
            core = full[math.ceil(y1 + 1) : math.floor(y2 - 1), math.ceil(x1 + 1) : math.floor(x2 - 1)]
            assert core.all()
            inside[
                label,
                max(math.floor(y1 - 0.5), 0) : math.ceil(y2 + 0.5),
                max(math.floor(x1 - 0.5), 0) : math.ceil(x2 + 0.5),
            ] = True
            count += core.numel() > 0
        for label in (0, 1):  # no colour outside the boxes, but at squares that are nearly out of the picture
            rest = coloured(picture, label) & ~inside[label]
            assert int(rest.sum()) <= (0 if len(after.label) == len(truth.label) else 60)
    assert count > 8


def test_objects_that_are_cut_become_crowd() -> None:
    truth = Truth(torch.tensor([0, 1, 0]), torch.tensor([[0.0, 0, 20, 20], [40, 20, 60, 40], [80, 50, 96, 64]]))
    after = change_truth(truth, Augmentation(False, 2.0, (-30.0, -10.0)), SIZE, keep=0.3)
    assert after.label.tolist() == [0, 1]
    assert after.crowd is not None
    assert after.crowd.tolist() == [True, False]  # a sixth of the first is in sight, all of the second
    torch.testing.assert_close(after.box, torch.tensor([[0.0, 0, 10, 30], [50, 30, 90, 64]]))


def test_a_change_that_does_nothing_leaves_the_picture() -> None:
    pictures = torch.rand(2, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    nothing = Augmentation(False, 1.0, (0.0, 0.0))
    assert torch.equal(augment_images(pictures, [nothing, nothing]), pictures)
    mirrored = augment_images(pictures, [Augmentation(True, 1.0, (0.0, 0.0)), nothing])
    torch.testing.assert_close(mirrored[0], pictures[0].flip(2))
    torch.testing.assert_close(mirrored[1], pictures[1])


def test_what_is_shrunk_is_averaged() -> None:
    stripes = (torch.arange(96) % 2).float().expand(1, 3, 65, 96)
    (shrunk,) = augment_images(stripes, [Augmentation(False, 0.4, (0.0, 0.0))])
    assert shrunk[:, 2:24, 2:36].std() < 0.05  # 0.25 if taken from the pixels as they are
    assert shrunk[:, 2:24, 2:36].mean() == pytest.approx(0.5, abs=0.02)


def test_colours_stay_colours() -> None:
    pictures = torch.rand(3, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    draws = torch.Generator().manual_seed(1)
    plain = replace(RECIPE, jitter=0.0, noise=0.0)
    assert torch.equal(augment_colours(pictures, plain, draws), pictures)
    changed = augment_colours(pictures, replace(RECIPE, jitter=0.9, noise=0.3), draws)
    assert 0 <= float(changed.min()) <= float(changed.max()) <= 1
    assert not torch.equal(changed, pictures)


# ---------------------------------------------------------------- 3D truth

SOLID_SIZE = (225, 400)


def moved(points: Tensor, change: Augmentation, width: int) -> Tensor:
    """Where places in a picture lie after a change."""
    x, y = points[..., 0], points[..., 1]
    x = width - x if change.mirror else x
    return torch.stack([change.zoom * v + s for v, s in zip((x, y), change.shift, strict=True)], -1)


@pytest.mark.parametrize(
    "change",
    [
        Augmentation(True, 1.0, (0.0, 0.0)),
        Augmentation(False, 0.8, (30.0, 12.0)),
        Augmentation(True, 0.7, (50.0, 40.0)),
        Augmentation(True, 1.1, (-12.0, -9.0)),
    ],
    ids=["mirror", "zoom", "both", "larger"],
)
def test_solids_project_to_the_changed_places(change: Augmentation) -> None:
    truth = some_truth(5, seed=2)
    assert truth.solid is not None
    assert truth.intrinsic is not None
    k = truth.intrinsic.clone()
    k[0, 2] += 7.0  # an axis beside the middle
    truth = replace(truth, intrinsic=k)
    after = change_truth(truth, change, SOLID_SIZE, keep=0.0)
    assert after.solid is not None
    assert after.intrinsic is not None
    assert len(after.label) == 5

    def middles(solid: Any, intrinsic: Tensor) -> Tensor:
        flat = solid.centre @ intrinsic.T
        return flat[:, :2] / flat[:, 2:]

    expected = moved(middles(truth.solid, k), change, SOLID_SIZE[1])
    torch.testing.assert_close(middles(after.solid, after.intrinsic), expected)
    before = project(solid_corners(truth.solid.centre, truth.solid.size_lhw, truth.solid.yaw), k)[..., :2]
    now = project(solid_corners(after.solid.centre, after.solid.size_lhw, after.solid.yaw), after.intrinsic)[..., :2]
    apart = (moved(before, change, SOLID_SIZE[1])[:, :, None] - now[:, None]).norm(dim=-1)
    assert float(apart.amin(1).max()) < 1e-9  # every corner has become a corner
    assert float(apart.amin(2).max()) < 1e-9
    # the way it looks and the way it goes stay together
    for old, new in ((truth.solid, after.solid),):
        ahead, later = (torch.stack([s.yaw.cos(), -s.yaw.sin()], 1) for s in (old, new))
        torch.testing.assert_close((ahead * old.velocity).sum(1), (later * new.velocity).sum(1))


def test_boxes_of_solids_follow_their_corners() -> None:
    truth = some_truth(5, seed=3)
    after = change_truth(truth, Augmentation(True, 0.6, (90.0, 40.0)), SOLID_SIZE, keep=0.0)
    assert after.solid is not None
    assert after.intrinsic is not None
    box = hull(project(solid_corners(after.solid.centre, after.solid.size_lhw, after.solid.yaw), after.intrinsic))
    torch.testing.assert_close(box, after.box)


def test_solids_whose_middle_leaves_the_picture_go() -> None:
    truth = some_truth(5, seed=2)
    after = change_truth(truth, Augmentation(False, 2.0, (0.0, 0.0)), SOLID_SIZE, keep=0.0)
    assert 0 < len(after.label) < 5
    assert after.solid is not None
    assert len(after.solid.centre) == len(after.box) == len(after.label)


def test_twice_mirrored_is_as_before() -> None:
    truth = some_truth(4)
    mirror = Augmentation(True, 1.0, (0.0, 0.0))
    twice = change_truth(change_truth(truth, mirror, SOLID_SIZE, keep=0.0), mirror, SOLID_SIZE, keep=0.0)
    assert twice.solid is not None
    assert truth.solid is not None
    torch.testing.assert_close(twice.solid.centre, truth.solid.centre)
    torch.testing.assert_close(twice.solid.yaw.cos(), truth.solid.yaw.cos())
    torch.testing.assert_close(twice.solid.velocity, truth.solid.velocity)
    torch.testing.assert_close(twice.intrinsic, lens())


# ---------------------------------------------------------------- recipes


@pytest.mark.parametrize("name", RECIPES)
def test_the_learning_rate_rises_and_falls(name: str) -> None:
    recipe = find_recipe(name)
    total = 100 * recipe.epochs
    rates = [recipe.rate(step, total, 100) for step in range(total)]
    assert rates[0] == pytest.approx(recipe.lr / 3)
    assert max(rates) <= recipe.lr
    assert rates[-1] < 0.2 * recipe.lr
    assert all(a >= b for a, b in zip(rates[recipe.warmup :], rates[recipe.warmup + 1 :], strict=False))


def test_a_recipe_that_is_unknown_or_wrong_is_one_line() -> None:
    with pytest.raises(UnknownNameError, match="yolov5n"):
        find_recipe("yolov5")
    with pytest.raises(ConfigError, match=r"no setting 'epoch'; it has .*epochs"):
        find_recipe("yolov5n", epoch=3)
    with pytest.raises(ConfigError, match="no setting 'detector'"):
        find_recipe("yolov5n", detector="yolov3")
    numbers = (
        {"epochs": 0},
        {"lr": 0.0},
        {"zoom": (0.0, 1.0)},
        {"average": 1.0},
        {"validate": 0},
        {"clip": -1.0},
        {"jitter": 5},
        {"momentum": 2},
        {"seed": -1},
        {"lr": math.nan},
        {"warmup": -5},
    )
    kinds = (
        {"lr": "abc"},
        {"epochs": 1.5},
        {"epochs": True},
        {"zoom": 1},
        {"zoom": (1.0,)},
        {"zoom": ("a", "b")},
        {"rare": "abc"},
        {"optimizer": "adam"},
        {"schedule": "foo"},
        {"amp": "maybe"},
        {"steps": 8},
        {"epochs": None},
        {"freeze": "backbone"},
    )
    for wrong in (*numbers, *kinds):
        with pytest.raises(ConfigError, match="recipe yolov5n") as error:
            find_recipe("yolov5n", **wrong)  # type: ignore[arg-type]
        assert "\n" not in str(error.value)
    assert find_recipe("yolov5n", lr=1, zoom=(1, 2), freeze=("backbone",)).zoom == (1, 2)


def test_changed_values_are_read_as_they_are_written() -> None:
    changes = (("weigh", {"depth": 4.0, "dir": 1.5}), ("zoom", (0.8, 1.3)), ("lr", 1e-4), ("compile", True))
    assert parse_changes(command_line_changes(changes)[1::2]) == changes
