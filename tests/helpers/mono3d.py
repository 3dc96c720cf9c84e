"""Solids in front of a camera, and dense maps that say the truth, for tests of the 3D detectors."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import torch
from torch import Tensor, nn

from ssad.core.detections import Assignment, Dense, Solids, Truth
from ssad.core.tensor_boxes import solid_corners
from ssad.detectors.mono3d.backbone import DeformConv
from ssad.detectors.mono3d.config import FCOS3D, PGD_DET, Mono3DConfig
from ssad.detectors.mono3d.decode import hull, project, vectors_of_yaw
from ssad.detectors.mono3d.detector import Mono3D

TINY = replace(FCOS3D, name="tiny", trunk=18, width=8, channels=32, strides=(8, 16, 32), ranges=(48.0, 96.0, 1e8))
TINY_PGD = replace(TINY, name="tiny-pgd", pgd=True, threshold=0.01, code_weights=PGD_DET.code_weights)
TINY_VECTORS, TINY_PGD_VECTORS = (replace(c, heading="vectors") for c in (TINY, TINY_PGD))


def lens(focal: float = 400.0, size: tuple[int, int] = (225, 400)) -> Tensor:
    """An intrinsic [3, 3] whose axis goes through the middle of a picture (height, width)."""
    return torch.tensor([[focal, 0.0, size[1] / 2], [0.0, focal, size[0] / 2], [0.0, 0.0, 1.0]], dtype=torch.float64)


def truth_of(centre: Tensor, size: Tensor, yaw: Tensor, *, label: Tensor, intrinsic: Tensor) -> Truth:
    """Truth whose 2D boxes are the hulls of the corners, not cut at the border."""
    velocity = torch.stack([0.5 + yaw, 2.0 - yaw], 1)
    attribute = torch.arange(len(yaw)) % 9
    box = hull(project(solid_corners(centre, size, yaw), intrinsic))
    return Truth(label, box, Solids(centre, size, yaw, velocity, attribute), intrinsic)


def some_truth(count: int = 5, *, seed: int = 0, size: tuple[int, int] = (225, 400), focal: float = 400.0) -> Truth:
    """Solids side by side at several depths, facing every way."""
    draws = torch.Generator().manual_seed(seed)
    k = lens(focal, size)
    across = (torch.arange(count, dtype=torch.float64) + 0.5) / count
    depth = 8 + 25 * torch.rand(count, generator=draws, dtype=torch.float64)
    u = size[1] * across
    v = size[0] * (0.4 + 0.2 * torch.rand(count, generator=draws, dtype=torch.float64))
    centre = torch.stack([(u - k[0, 2]) / k[0, 0] * depth, (v - k[1, 2]) / k[1, 1] * depth, depth], 1)
    yaw = (torch.arange(count) * 2.4 + torch.rand(count, generator=draws)).double()
    yaw = (yaw + math.pi) % (2 * math.pi) - math.pi
    shape = torch.tensor([2.0, 1.5, 1.0]) * (0.5 + torch.rand(count, 3, generator=draws))
    label = torch.randint(0, 10, (count,), generator=draws)
    return truth_of(centre, shape.double(), yaw, label=label, intrinsic=k)


def lively(config: Mono3DConfig, *, seed: int = 0, double: bool = False) -> Mono3D:
    """A detector whose every layer does something: shifts of deformable convolutions, norms, spread answers."""
    detector = Mono3D(config, seed=seed)
    draws = torch.Generator().manual_seed(seed + 1)

    def fill(x: Tensor, std: float, mean: float = 0.0) -> None:
        x.data.copy_(mean + std * torch.randn(x.shape, generator=draws))

    for part in detector.modules():
        if isinstance(part, DeformConv):
            fill(part.conv_offset.weight, 0.05)
        if isinstance(part, nn.BatchNorm2d | nn.GroupNorm):
            fill(part.weight, 0.1, 1.0)
            fill(part.bias, 0.1)
        if isinstance(part, nn.BatchNorm2d) and part.running_mean is not None and part.running_var is not None:
            fill(part.running_mean, 0.1)
            part.running_var.data.copy_(0.5 + torch.rand(part.running_var.shape, generator=draws))
    head = detector.bbox_head
    turns = (head.conv_dir_cls,) if config.heading == "bins" else ()
    for last in (head.conv_cls, *turns, head.conv_attr, head.conv_centerness, *head.conv_regs):
        fill(last.weight, 0.2)
    if config.pgd:
        fill(head.conv_depth_cls.weight, 0.2)
    return detector.double() if double else detector


def perfect(detector: Mono3D, truth: Truth, size: tuple[int, int]) -> tuple[Dense, Assignment]:
    """Dense maps that say the truth of one picture, and the assignment they were made from."""
    assert truth.intrinsic is not None
    config = detector.config
    blank = Mono3D(config).dense(torch.zeros(1, 3, *size), truth.intrinsic[None].float())  # for the shapes
    k = truth.intrinsic[None]
    blank = replace(blank, maps={name: [m.double() for m in maps] for name, maps in blank.maps.items()})
    blank.maps["intrinsic"][0] = detector._scale_intrinsic(k, size, detector._scale(size, k))
    found = detector.assign(blank, [truth])
    label, reg = found.label[0], found.extra["reg"][0].clone()
    owned = label >= 0
    stride = torch.cat(
        [torch.full((m[0, 0].numel(),), s) for m, s in zip(blank.maps["cls_scores"], config.strides, strict=True)]
    )
    reg[:, :2] *= stride[:, None]
    reg[:, 9:] *= stride[:, None]
    turned = (reg[:, 6] - config.dir_offset) % (2 * math.pi)
    direction = 60.0 * nn.functional.one_hot((turned >= math.pi).long(), 2) - 30.0
    if config.heading == "vectors":
        direction = vectors_of_yaw(reg[:, 6]) * torch.tensor([30.0, 30.0, 1.0, 1.0])
    logit = torch.full((len(label), 10), -30.0, dtype=torch.float64)
    logit[owned, label[owned]] = 30.0
    attribute = 60.0 * nn.functional.one_hot(found.extra["attribute"][0], 9) - 30.0
    centreness = torch.logit(found.extra["centreness"][0].clamp(1e-9, 1 - 1e-9))
    rows = {
        "cls_scores": logit,
        "bbox_preds": reg[:, : 13 if config.pgd else 9],
        "dir_cls_preds": direction,
        "attr_preds": attribute,
        "centernesses": centreness[:, None],
    }
    if config.pgd:
        bins = torch.full((len(label), 6), -30.0, dtype=torch.float64)
        bins[:, 2] = 30.0
        share = detector.bbox_head.fuse_lambda.double().sigmoid()
        factor = 1.0 if config.virtual_focal is None else blank.maps["intrinsic"][0][0, 0, 0] / config.virtual_focal
        rows["bbox_preds"] = rows["bbox_preds"].clone()
        rows["bbox_preds"][:, 2] = (reg[:, 2] - (1 - share) * 20.0 * factor) / share
        rows["depth_cls_preds"] = bins
    maps = dict(blank.maps)
    for name, value in rows.items():
        start, levels = 0, []
        for m in blank.maps["cls_scores"]:
            count = m[0, 0].numel()
            part = value[start : start + count].double()
            levels.append(part.T.reshape(1, -1, *m.shape[2:]))
            start += count
        maps[name] = levels
    return replace(blank, maps=maps, logit=logit[None], quality=centreness[None]), found


@contextmanager
def one_thread() -> Iterator[None]:
    """Small operations on one core: threads that wait for each other cost more than they give."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
