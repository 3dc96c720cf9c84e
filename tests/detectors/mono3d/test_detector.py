"""The 3D detectors as detectors: names of weights, sizes, batches, what a call leaves behind, bad input, learning."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.mono3d import TINY, TINY_PGD, TINY_VECTORS, lens, lively, perfect, some_truth, truth_of
from helpers.quick import others_slow
from torch import Tensor
from torchvision.ops import box_iou

from ssad.core.detections import Detections, Truth
from ssad.core.errors import ConfigError
from ssad.core.nuscenes_names import MMDET3D_CLASSES
from ssad.core.protocols import Detector
from ssad.detectors import make_detector
from ssad.detectors.fcos3d import fcos3d
from ssad.detectors.mono3d.backbone import DeformConv
from ssad.detectors.mono3d.config import FCOS3D, Mono3DConfig
from ssad.detectors.mono3d.decode import flatten, places_of
from ssad.detectors.mono3d.detector import Mono3D
from ssad.detectors.mono3d.head import group_norm_relu
from ssad.detectors.pgd_det import pgd_det

BOTH = pytest.mark.parametrize("config", [TINY, TINY_PGD], ids=["fcos3d", "pgd"])
SIZE = (70, 110)
K = lens(90.0, SIZE).float()


def pictures(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def official_names(*, pgd: bool) -> set[str]:
    """The names of mmdetection3d's state dict, by its rules."""
    norm = ("weight", "bias", "running_mean", "running_var", "num_batches_tracked")
    names = {"backbone.conv1.weight"} | {f"backbone.bn1.{n}" for n in norm}
    for stage, blocks in enumerate((3, 4, 23, 3), 1):
        for block in range(blocks):
            at = f"backbone.layer{stage}.{block}"
            for k in (1, 2, 3):
                names |= {f"{at}.conv{k}.weight"} | {f"{at}.bn{k}.{n}" for n in norm}
            if stage > 2:
                names |= {f"{at}.conv2.conv_offset.weight", f"{at}.conv2.conv_offset.bias"}
            if not block:
                names |= {f"{at}.downsample.0.weight"} | {f"{at}.downsample.1.{n}" for n in norm}
    pair = ("weight", "bias")
    names |= {f"neck.lateral_convs.{k}.conv.{n}" for k in range(3) for n in pair}
    names |= {f"neck.fpn_convs.{k}.conv.{n}" for k in range(5) for n in pair}
    units = [f"{tower}_convs.{k}" for tower in ("cls", "reg") for k in range(2)]
    names |= {f"bbox_head.{tower}_convs.1.conv.conv_offset.{n}" for tower in ("cls", "reg") for n in pair}
    branches = ["cls", "dir_cls", "attr", "centerness"] + ["depth_cls"] * pgd
    units += [f"conv_{b}_prev.0" for b in branches] + [f"conv_reg_prevs.{k}.0" for k in (0, 1, 2, 3, 5)[: 4 + pgd]]
    names |= {f"bbox_head.{unit}.{part}.{n}" for unit in units for part in ("conv", "gn") for n in pair}
    last = [f"conv_{b}" for b in branches] + [f"conv_regs.{k}" for k in range(5 + pgd)]
    names |= {f"bbox_head.{b}.{n}" for b in last for n in pair}
    names |= {f"bbox_head.scales.{k}.{n}.scale" for k in range(5) for n in range(3 + pgd)}
    return names | ({"bbox_head.fuse_lambda"} if pgd else set())


@pytest.mark.parametrize("pgd", [False, True])
def test_weights_have_the_official_names_and_shapes(pgd: bool) -> None:
    with torch.device("meta"):
        state = Mono3D(replace(FCOS3D, pgd=pgd)).state_dict()
    assert set(state) == official_names(pgd=pgd)
    assert len(state) == (795 if pgd else 777)
    shapes = {
        "backbone.conv1.weight": (64, 3, 7, 7),
        "backbone.layer1.0.downsample.0.weight": (256, 64, 1, 1),
        "backbone.layer3.22.conv2.weight": (256, 256, 3, 3),
        "backbone.layer3.22.conv2.conv_offset.weight": (27, 256, 3, 3),
        "backbone.layer4.0.conv1.weight": (512, 1024, 1, 1),
        "neck.lateral_convs.2.conv.weight": (256, 2048, 1, 1),
        "neck.fpn_convs.4.conv.weight": (256, 256, 3, 3),
        "bbox_head.cls_convs.1.conv.bias": (256,),
        "bbox_head.conv_cls.weight": (10, 256, 1, 1),
        "bbox_head.conv_attr.bias": (9,),
        "bbox_head.conv_dir_cls.weight": (2, 256, 1, 1),
        "bbox_head.conv_regs.4.weight": (2, 256, 1, 1),
        "bbox_head.conv_centerness_prev.0.gn.weight": (64,),
        "bbox_head.conv_centerness.weight": (1, 64, 1, 1),
        "bbox_head.scales.0.0.scale": (),
    }
    if pgd:
        shapes |= {"bbox_head.conv_regs.5.weight": (4, 256, 1, 1), "bbox_head.conv_depth_cls.weight": (6, 256, 1, 1)}
    assert {name: tuple(state[name].shape) for name in shapes} == shapes


def test_strides_of_the_official_trunk() -> None:
    """Caffe style: the first 1 x 1 convolution of a stage strides, not the 3 x 3; deformable ones in stages 3 and 4."""
    with torch.device("meta"):
        trunk = Mono3D(FCOS3D).backbone
    for stage in range(1, 5):
        for n, block in enumerate(trunk.get_submodule(f"layer{stage}").children()):
            first, second = block.get_submodule("conv1"), block.get_submodule("conv2")
            assert first.stride == ((2, 2) if stage > 1 and not n else (1, 1))
            assert isinstance(second, DeformConv) == (stage > 2)
            assert second.stride in {1, (1, 1)}


@pytest.mark.parametrize("build", [fcos3d, pgd_det])
def test_light_ones_are_light(build: object) -> None:
    detector = build(light=True)  # type: ignore[operator]
    count = sum(p.numel() for p in detector.parameters())
    assert 4e6 < count < 7.5e6
    assert not any(p.requires_grad for p in detector.parameters())
    assert not any(part.training for part in detector.modules())


def test_fresh_weights_come_from_the_seed_alone() -> None:
    torch.manual_seed(5)
    before = torch.get_rng_state()
    one, two, other = (Mono3D(TINY, seed=s).state_dict() for s in (1, 1, 2))
    assert torch.equal(torch.get_rng_state(), before)
    assert all(torch.equal(one[name], two[name]) for name in one)
    assert not torch.equal(one["backbone.conv1.weight"], other["backbone.conv1.weight"])


def test_what_fresh_weights_say() -> None:
    """A place is rarely an object; depth and size start near their usual values where a start is given."""
    detector = Mono3D(replace(TINY, start=(20.0, 4.0, 1.7, 1.8)))
    dense = detector.dense(pictures(1, 3, *SIZE), K[None])
    assert float(dense.logit.sigmoid().mean()) == pytest.approx(0.01, abs=0.005)
    reg = dense.maps["bbox_preds"][0].mean((0, 2, 3))
    assert reg[2:6].tolist() == pytest.approx([20, 4, 1.7, 1.8], rel=0.2)
    with pytest.raises(ConfigError, match="leave start out"):
        replace(TINY_PGD, start=(20.0, 4.0, 1.7, 1.8))


@BOTH
def test_it_is_a_detector(config: Mono3DConfig) -> None:
    detector = Mono3D(config)
    assert isinstance(detector, Detector)
    assert (detector.name, detector.task, detector.classes) == (config.name, "3d", MMDET3D_CLASSES)


@BOTH
@pytest.mark.parametrize("size", [(1, 1), (33, 65), (100, 37), (64, 96)])
@pytest.mark.parametrize("width", [None, 64])
def test_any_size_works(config: Mono3DConfig, size: tuple[int, int], width: int | None) -> None:
    detector = lively(replace(config, input_width=width))
    images = pictures(2, 3, *size).requires_grad_()
    k = lens(60.0, size).float().expand(2, 3, 3)
    dense = detector.dense(images, k)
    height, wide = size if width is None else (max(1, round(size[0] * width / size[1])), width)
    places = sum((-(-height // 32) * 32 // s) * (-(-wide // 32) * 32 // s) for s in config.strides)
    assert dense.logit.shape == (2, places, 10)
    assert dense.box.shape == (2, places, 4)
    assert dense.place.shape == (places, 2)
    assert dense.size == size
    assert bool((dense.box >= 0).all())
    assert bool((dense.box <= torch.tensor([size[1], size[0]] * 2)).all())
    assert len(dense.features) == 3
    (slope,) = torch.autograd.grad(dense.logit.sum(), images)
    assert bool(slope.isfinite().all())
    for found in detector.predict(images.detach(), k, threshold=0.0001):
        assert bool((found.box <= torch.tensor([size[1], size[0]] * 2)).all())


@BOTH
def test_an_image_does_not_depend_on_the_batch(config: Mono3DConfig) -> None:
    detector = lively(config, double=True)
    images = pictures(3, 3, *SIZE).double()
    k = torch.stack([lens(f, SIZE) for f in (70.0, 90.0, 110.0)])
    dense, found = detector.dense(images, k), detector.predict(images, k, threshold=0.01)
    assert sum(len(one.score) for one in found) > 10
    for n in range(3):
        alone = detector.dense(images[n : n + 1], k[n : n + 1])
        torch.testing.assert_close(alone.logit[0], dense.logit[n])
        torch.testing.assert_close(alone.box[0], dense.box[n])
        (single,) = detector.predict(images[n : n + 1], k[n : n + 1], threshold=0.01)
        same(single, found[n])


def same(a: Detections, b: Detections) -> None:
    for name in ("score", "label", "box"):
        torch.testing.assert_close(getattr(a, name), getattr(b, name))
    for name in ("centre", "size_lhw", "yaw", "velocity", "attribute"):
        torch.testing.assert_close(getattr(a.solid, name), getattr(b.solid, name))


@BOTH
def test_calls_leave_no_trace(config: Mono3DConfig) -> None:
    detector = lively(config)
    detector.backbone.train()
    modes = [part.training for part in detector.modules()]
    state = {name: value.clone() for name, value in detector.state_dict().items()}
    images = pictures(1, 3, *SIZE)
    kept, k = images.clone(), K[None].clone()
    first = detector.predict(images, k, threshold=0.05)
    second = detector.predict(images, k, threshold=0.05)
    same(first[0], second[0])
    assert [part.training for part in detector.modules()] == modes
    assert all(torch.equal(value, state[name]) for name, value in detector.state_dict().items())
    assert torch.equal(images, kept)
    assert torch.equal(k, K[None])
    assert not first[0].score.requires_grad


@BOTH
def test_predictions_are_in_order_and_above_the_threshold(config: Mono3DConfig) -> None:
    detector = lively(replace(config, most=40))
    images = pictures(1, 3, *SIZE)
    (found,) = detector.predict(images, K[None], threshold=0.002)
    assert len(found.score) == 40
    assert bool((found.score.diff() <= 0).all())
    least = float(found.score[20])
    (fewer,) = detector.predict(images, K[None], threshold=least)
    assert bool((fewer.score > least).all())
    assert found.solid is not None
    assert bool((found.solid.size_lhw > 0).all())
    assert detector.predict(images, K[None], threshold=0.999)[0].score.shape == (0,)


def test_levels_keep_their_best_places() -> None:
    detector = lively(replace(TINY, before=5, nms=1.1))
    images = pictures(1, 3, *SIZE)
    (found,) = detector.predict(images, K[None], threshold=0.0)
    assert len(found.score) == 3 * 5 * 10  # levels, places, classes: none overlaps by 110 %
    dense = detector.dense(images, K[None])
    assert dense.quality is not None
    share = dense.logit.sigmoid() * dense.quality.sigmoid()[..., None]
    wanted = torch.cat([share[0, dense.level == n].amax(-1).topk(5)[0] for n in range(3)])
    assert float(found.score[0]) == pytest.approx(float(wanted.max()))
    assert float(wanted.min()) in [pytest.approx(float(s)) for s in found.score]


def test_pgd_weighs_with_the_confidence_of_depth() -> None:
    detector = lively(replace(TINY_PGD, nms=1.1, most=100000))
    images = pictures(1, 3, *SIZE)
    dense = detector.dense(images, K[None])
    assert dense.quality is not None
    (found,) = detector.predict(images, K[None], threshold=0.0)
    bins = torch.cat([m.flatten(2) for m in dense.maps["depth_cls_preds"]], 2)[0].softmax(0)
    share = bins.topk(2, 0)[0].mean(0)[:, None] * dense.logit[0].sigmoid() * dense.quality[0].sigmoid()[:, None]
    torch.testing.assert_close(found.score, share.flatten().sort(descending=True)[0])


def test_classes_choose_their_means_of_depth_and_size() -> None:
    """PGD: raw regression 0 gives the mean depth and size of the class with the highest logit at the place."""
    detector = Mono3D(TINY_PGD)
    detector.bbox_head.conv_cls.bias.data[:] = -5.0
    detector.bbox_head.conv_cls.bias.data[5] = 0.0
    for k in (1, 2):
        detector.bbox_head.conv_regs[k].get_parameter("weight").data.zero_()
    reg = detector.dense(pictures(1, 3, *SIZE), K[None]).maps["bbox_preds"][0]
    assert reg[0, 2:6, 2, 3].tolist() == pytest.approx([22.35, 6.68, 3.21, 2.85])  # bicycle, with its odd size


def test_other_lenses_share_one_scale() -> None:
    """Twice the focal length of the same picture is twice the depth, and the solid stands on the same ray."""
    detector = lively(replace(TINY, virtual_focal=90.0))
    images = pictures(1, 3, *SIZE)
    far = K.clone()
    far[:2, :2] *= 2
    near, distant = (detector.predict(images, k[None], threshold=0.0)[0] for k in (K, far))
    plain = lively(TINY).predict(images, K[None], threshold=0.0)[0]
    assert near.solid is not None
    assert distant.solid is not None
    assert plain.solid is not None
    torch.testing.assert_close(near.solid.centre[0], plain.solid.centre[0])
    assert float(distant.solid.centre[0, 2]) == pytest.approx(2 * float(near.solid.centre[0, 2]), rel=1e-5)
    torch.testing.assert_close(distant.solid.centre[0, :2], near.solid.centre[0, :2])


def test_resizing_moves_no_box() -> None:
    """A picture of even colour, larger by two, with an intrinsic to fit: the same solids, 2D boxes twice as large."""
    config = replace(TINY, input_width=96)
    detector = lively(config)
    k = lens(90.0, (64, 96)).float()
    wide = k.clone()
    wide[:2] *= 2
    small, large = torch.full((1, 3, 64, 96), 0.5), torch.full((1, 3, 128, 192), 0.5)
    one, two = detector.dense(small, k[None]), detector.dense(large, wide[None])
    torch.testing.assert_close(two.maps["intrinsic"][0], one.maps["intrinsic"][0])
    torch.testing.assert_close(two.logit, one.logit)
    torch.testing.assert_close(two.place, 2 * one.place)
    torch.testing.assert_close(two.box, 2 * one.box)


@BOTH
def test_the_horizon_lies_between_the_rows_as_in_training_whatever_the_width(config: Mono3DConfig) -> None:
    """Trained at a width of 128, used at 64: as if so many rows stood above the picture; boxes know nothing of it."""
    size, above = (64, 64), 26  # 0.4 * (128 - 64), rounded
    moved = lively(replace(config, input_width=64, trained_width=128, horizon=0.4), seed=3)
    plain = lively(replace(config, input_width=64), seed=3)
    picture, k = pictures(1, 3, *size), lens(60.0, size).float()[None]
    grey = plain.get_buffer("mean").flip(0)[None] / 255
    under = torch.cat([grey.expand(1, 3, above, 64), picture], 2)
    lower = k.clone()
    lower[:, 1, 2] += above
    one, two = moved.dense(picture, k), plain.dense(under, lower)
    torch.testing.assert_close(one.logit, two.logit, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(one.place, two.place - torch.tensor([0.0, above]))
    shown = (two.box - two.box.new_tensor([0, 26, 0, 26])).clamp_min(0).minimum(two.box.new_tensor([64, 64, 64, 64]))
    torch.testing.assert_close(one.box, shown, rtol=1e-3, atol=1e-2)
    assert float((one.box[..., 2:] - one.box[..., :2]).amax()) > 5.0
    truth = some_truth(3, size=size, focal=60.0)
    low = replace(truth, box=truth.box + torch.tensor([0.0, 26, 0, 26]), intrinsic=lower[0])
    for name, value in moved.assign(one, [truth]).extra.items():
        torch.testing.assert_close(value, plain.assign(two, [low]).extra[name], equal_nan=True, rtol=1e-4, atol=1e-4)
    at_home = lively(replace(config, input_width=64, trained_width=64), seed=3)
    torch.testing.assert_close(at_home.dense(picture, k).logit, plain.dense(picture, k).logit, rtol=0, atol=0)


@pytest.mark.parametrize("width", [None, 320])
def test_rays_are_tangents_to_the_right_and_down(width: int | None) -> None:
    """Four times the tangents, as the regression's first layer gets them; 45 degrees to the right is 4."""
    detector = Mono3D(replace(TINY, rays=True, input_width=width))
    seen: list[Tensor] = []
    first = detector.bbox_head.get_submodule("reg_convs.0.conv")
    first.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    k = torch.tensor([[40.0, 0, 100], [0, 80, 20], [0, 0, 1]])
    if width is not None:  # twice as wide: the same ray stands at the same part of the picture
        k[:2] /= 2
    detector.dense(torch.zeros(1, 3, 96, 160) if width is None else torch.zeros(1, 3, 80, 160), k[None])
    right, down = seen[0][0, -2:]  # of stride 8: places at 4, 12, 20, ... of the network's input
    assert right[5, 17].item() == pytest.approx(4.0)  # (140 - 100) / 40
    assert right[2, 7].item() == pytest.approx(-4.0)  # (60 - 100) / 40
    assert down[2, 7].item() == pytest.approx(0.0, abs=1e-6)  # (20 - 20) / 80
    assert down[7, 3].item() == pytest.approx(2.0)  # (60 - 20) / 80
    assert seen[1][0, -1, 0, 0].item() == pytest.approx(4 * (8 - 20) / 80)  # of stride 16


def test_a_resized_picture_has_a_scale_of_its_own_in_each_direction() -> None:
    """160 x 3 pixels become 64 x 1: by 0.4 to the right, but by a third down."""
    detector = Mono3D(replace(TINY, input_width=64))
    k = torch.tensor([[90.0, 0, 70], [0, 90, 2], [0, 0, 1]])
    dense = detector.dense(torch.zeros(1, 3, 3, 160), k[None])
    torch.testing.assert_close(
        dense.place[:9], torch.tensor([[(8 * c + 4) / 0.4, 4 * 3] for c in range(8)] + [[10.0, 36]])
    )
    torch.testing.assert_close(dense.stride[:8], torch.full((8,), 20.0))
    wanted = torch.tensor([[90 * 0.4, 0, 70 * 0.4], [0, 30, 2 / 3], [0, 0, 1]])
    torch.testing.assert_close(dense.maps["intrinsic"][0][0], wanted)


def test_mixed_precision_keeps_digits_where_they_count() -> None:
    detector = lively(TINY_PGD)
    images, truth = pictures(1, 3, *SIZE), some_truth(4, size=SIZE, focal=90.0)
    truth = replace(truth, box=truth.box.float())
    full = detector.dense(images, K[None])
    with torch.autocast("cpu", torch.bfloat16):
        mixed = detector.dense(images, K[None])
        inside = detector.losses(full, detector.assign(full, [truth]))
        (found,) = detector.select(full, 0.05)
    outside = detector.losses(full, detector.assign(full, [truth]))
    assert all(m.dtype == torch.float32 for maps in mixed.maps.values() for m in maps)
    assert mixed.box.dtype == torch.float32
    assert all(torch.equal(inside[name], outside[name]) for name in outside)
    same(found, detector.select(full, 0.05)[0])
    torch.testing.assert_close(mixed.logit, full.logit, atol=0.3, rtol=0.1)


BAD = {
    "uint8": (torch.zeros(1, 3, 64, 64, dtype=torch.uint8), K[None], "of floats"),
    "grey": (torch.zeros(1, 1, 64, 64), K[None], r"\[1, 1, 64, 64\] of float32"),
    "no batch": (torch.zeros(3, 64, 64), K[None], "B, 3, H, W"),
    "empty": (torch.zeros(1, 3, 0, 64), K[None], "B, 3, H, W"),
    "no intrinsic": (torch.zeros(1, 3, 64, 64), None, "needs the cameras' intrinsic.*got none"),
    "one for two": (torch.zeros(2, 3, 64, 64), K[None], r"got \[1, 3, 3\]"),
    "NaN": (torch.zeros(1, 3, 64, 64), K[None] * float("nan"), "holds NaN"),
    "no focal length": (torch.zeros(1, 3, 64, 64), torch.zeros(1, 3, 3), "no focal length"),
}


@pytest.mark.parametrize("case", BAD.values(), ids=BAD.keys())
def test_bad_input_is_named_in_one_line(case: tuple[Tensor, Tensor | None, str]) -> None:
    images, k, words = case
    with pytest.raises(ConfigError, match=words) as caught:
        Mono3D(TINY).predict(images, k)
    assert "\n" not in str(caught.value)


def test_bad_options() -> None:
    detector = Mono3D(TINY)
    with pytest.raises(ConfigError, match=r"threshold 1\.5"):
        detector.predict(torch.zeros(1, 3, 64, 64), K[None], threshold=1.5)
    with pytest.raises(ConfigError, match="trunk 34; choose 18"):
        fcos3d(trunk=34)
    with pytest.raises(ConfigError, match="input_width 3"):
        make_detector("fcos3d-light", weights="random", input_width=3)
    with pytest.raises(ConfigError, match="strides are"):
        replace(TINY, strides=(4, 8, 16))
    with pytest.raises(ConfigError, match="multiple of 32"):
        replace(TINY, channels=40)


def scene(seed: int) -> tuple[Tensor, Truth]:
    """A grey picture with a bright and a dark rectangle: two objects that look like their class and distance."""
    draws = torch.Generator().manual_seed(seed)
    image = 0.5 + 0.05 * torch.rand(3, 96, 160, generator=draws)
    depth = 8 + 8 * torch.rand(2, generator=draws).double()
    u = torch.tensor([40.0, 120.0]).double()
    k = lens(120.0, (96, 160))
    centre = torch.stack([(u - 80) / 120 * depth, torch.zeros(2).double(), depth], 1)
    size = torch.tensor([[2.0, 2.0, 2.0], [3.0, 3.0, 2.0]]).double()
    truth = truth_of(centre, size, torch.tensor([0.3, -1.2]).double(), label=torch.tensor([0, 7]), intrinsic=k)
    for n, (x0, y0, x1, y1) in enumerate(truth.box.round().int().clamp_min(0).tolist()):
        image[:, y0:y1, x0:x1] = torch.tensor([[0.9, 0.2, 0.1], [0.1, 0.1, 0.8]])[n][:, None, None]
    return image, truth


@pytest.mark.parametrize(
    ("config", "steps", "least"),
    others_slow([(TINY, 30, 4), (TINY_PGD, 30, 4), (TINY, 100, 8), (TINY_PGD, 100, 8)], [(TINY, 30, 4)]),
)
def test_it_learns_a_few_pictures(config: Mono3DConfig, steps: int, least: int) -> None:
    """Trained on four pictures, it finds their eight objects, of which it found none, where they are."""
    started = None if config.pgd else (10.0, 3.0, 2.0, 2.0)
    config = replace(config, width=16, deformable=False, std=(57.0, 57.0, 57.0), start=started)
    detector = Mono3D(config).train().requires_grad_()
    pairs = [scene(seed) for seed in range(4)]
    images, truths = torch.stack([p[0] for p in pairs]), [p[1] for p in pairs]
    k = torch.stack([t.intrinsic for t in truths if t.intrinsic is not None]).float()
    optimizer = torch.optim.AdamW(detector.parameters(), 3e-3)
    assignment, history = None, []

    def near() -> int:
        """Objects whose best detection of their class is less than 3 m away."""
        count = 0
        for found, truth in zip(detector.predict(images, k, threshold=0.1), truths, strict=True):
            assert found.solid is not None
            assert truth.solid is not None
            for n in range(2):
                away = (found.solid.centre[found.label == truth.label[n]][:1] - truth.solid.centre[n]).norm(dim=1)
                count += int((away < 3.0).sum())
        return count

    assert near() == 0
    for step in range(steps):
        for group in optimizer.param_groups:
            group["lr"] = 3e-3 * min(1.0, (step + 1) / 10) * (0.1 if step >= 0.8 * steps else 1.0)
        dense = detector.dense(images, k)
        assignment = detector.assign(dense, truths) if assignment is None else assignment
        loss = sum(detector.losses(dense, assignment).values(), torch.zeros(()))
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(detector.parameters(), 10.0)
        optimizer.step()
        history.append(float(loss.detach()))
    assert history[-1] < 0.5 * history[0]
    assert near() >= least


def test_fused_norm_equals_the_library() -> None:
    draws = torch.Generator().manual_seed(3)
    x = (2 * torch.randn((3, 64, 7, 5), generator=draws) + 0.5).requires_grad_()
    weight, bias = (torch.randn(64, generator=draws).requires_grad_() for _ in range(2))
    cotangent = torch.randn((3, 64, 7, 5), generator=draws)
    wanted = torch.group_norm(x, 32, weight, bias, 1e-5).relu()
    found = group_norm_relu(x.contiguous(memory_format=torch.channels_last), weight, bias, 32, 1e-5)
    torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-5)
    for a, b in zip(*(torch.autograd.grad(y, (x, weight, bias), cotangent) for y in (found, wanted)), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-4)


@BOTH
def test_boxes_of_one_object_in_the_image_are_suppressed(config: Mono3DConfig) -> None:
    """Of two of a class that overlap in the image the better stays, wherever they are on the ground; nothing else."""
    config = replace(config, nms=0.9, most=100000)
    free = lively(config)
    strict = lively(replace(config, image_nms=0.3))
    images, cameras = pictures(1, 3, *SIZE), K[None]
    least = 0.004 if config.pgd else 0.012  # some hundred candidates
    for before, after in zip(
        free.predict(images, cameras, threshold=least), strict.predict(images, cameras, threshold=least), strict=True
    ):
        keep: list[int] = []
        for k in before.score.argsort(descending=True, stable=True).tolist():
            rivals = [j for j in keep if before.label[j] == before.label[k]]
            overlap = box_iou(before.box[k : k + 1], before.box[rivals])
            if not (overlap > 0.3).any():
                keep.append(k)
        assert 1 < len(keep) < len(before.score)
        torch.testing.assert_close(after.box, before.box[keep])


@BOTH
def test_dropped_boxes_vote_on_where_the_one_that_stays_is(config: Mono3DConfig) -> None:
    free = lively(replace(config, nms=2.0))  # an overlap that there is not: nothing is dropped
    voted = lively(replace(config, nms=2.0, image_nms=0.3, vote=0.5))
    images, cameras = pictures(1, 3, 64, 96), lens(100.0, (64, 96))[None].float()
    for detector in (free, voted):
        detector.config = replace(detector.config, most=100_000)
    (every,), (found,) = (d.predict(images, cameras, threshold=0.0) for d in (free, voted))
    assert every.solid is not None
    assert found.solid is not None
    assert 1 < len(found.score) < len(every.score)
    for k in range(0, len(found.score), 7):
        same = every.label == found.label[k]
        same &= box_iou(found.box[k : k + 1], every.box)[0] >= 0.5
        if not same.any():
            continue  # without area
        weight = every.score[same] / every.score[same].sum()
        for name in ("centre", "size_lhw", "velocity"):
            expected = weight @ getattr(every.solid, name)[same]
            torch.testing.assert_close(getattr(found.solid, name)[k], expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("vote", [None, 0.5])
def test_dropped_boxes_vote_on_the_heading(vote: float | None) -> None:
    """The best place of an object takes it for turned round, but is not sure; its neighbours are."""
    detector = Mono3D(replace(TINY_VECTORS, image_nms=0.3, vote=vote)).double()
    truth = some_truth(1)
    dense, assignment = perfect(detector, truth, (225, 400))
    best, maps = int(dense.quality[0].argmax()), {name: [m.clone() for m in of] for name, of in dense.maps.items()}
    assert (assignment.label[0] >= 0).sum() > 2
    assert assignment.label[0, best] >= 0
    for way, box in zip(maps["dir_cls_preds"], maps["bbox_preds"], strict=True):
        count = way[0, 0].numel()
        if 0 <= best < count:
            row, column = divmod(best, way.shape[3])
            way[0, :2, row, column] *= -0.01
            box[0, 6, row, column] += math.pi
        best -= count
    (found,) = detector.select(replace(dense, maps=maps), 0.3)
    assert found.solid is not None
    assert truth.solid is not None
    error = float((found.solid.yaw[0] - truth.solid.yaw[0]).remainder(2 * math.pi))
    assert math.cos(error) == pytest.approx(-1.0 if vote is None else 1.0, abs=1e-6)


@BOTH
def test_scores_fade_with_depth_and_the_confidence_of_depth_has_a_power(config: Mono3DConfig) -> None:
    images, cameras = pictures(1, 3, 64, 96), lens(100.0, (64, 96))[None].float()
    config, scores = replace(config, nms=2.0, most=100_000), []
    for changed in (config, replace(config, fade=0.05), replace(config, sure=0.0)):
        (found,) = lively(changed).predict(images, cameras, threshold=0.0)
        assert found.solid is not None
        depth, label = found.solid.centre[:, 2], found.label
        rank = np.lexsort((label.numpy(), depth.numpy(), found.solid.centre[:, 0].numpy()))
        scores.append(found.score[rank])
        depths = depth[rank]
    usual, faded, unsure = scores
    torch.testing.assert_close(faded, usual * torch.exp(-0.05 * depths.clamp_min(0.0)))
    assert (unsure > usual).all() if config.pgd else torch.equal(unsure, usual)


@BOTH
def test_doubt_lowers_the_centreness_of_places_that_err_about_depth(config: Mono3DConfig) -> None:
    detector, truth = lively(config), some_truth(4)
    dense = detector.dense(pictures(1, 3, *SIZE), K[None])
    assignment = detector.assign(dense, [truth])
    doubted = detector.discount_centreness(dense, assignment, doubt=3.0)
    own = assignment.label[0] >= 0
    assert own.any()
    flat = flatten({name: maps for name, maps in dense.maps.items() if name != "intrinsic"})
    places = places_of(dense.maps["cls_scores"], config.strides)
    depth = detector._solids(flat, places.xy, dense.maps["intrinsic"][0][:, None])[0][0, own, 2]
    wrong = (depth - assignment.extra["reg"][0, own, 2]).abs()
    expected = assignment.extra["centreness"][0, own] * torch.exp(-wrong / 3.0)
    torch.testing.assert_close(doubted.extra["centreness"][0, own], expected, rtol=1e-4, atol=1e-6)
    assert torch.equal(doubted.extra["centreness"][0, ~own], assignment.extra["centreness"][0, ~own])
    assert doubted.extra["reg"] is assignment.extra["reg"]
