"""Losses of the 3D detectors: their zeros, their sums, and their gradients to the image."""

import math
from dataclasses import replace

import pytest
import torch
from helpers.mono3d import TINY, TINY_PGD, TINY_PGD_VECTORS, TINY_VECTORS, lens, lively, perfect, some_truth
from torch import Tensor

from ssad.core.detections import Assignment, Dense, Solids, Truth
from ssad.core.errors import ConfigError
from ssad.detectors.mono3d.config import Mono3DConfig
from ssad.detectors.mono3d.detector import Mono3D

FCOS = {"cls", "offset", "depth", "size", "rotsin", "velo", "dir", "attr", "centerness"}
PGD = FCOS | {"bbox2d", "consistency"}
BOTH = pytest.mark.parametrize("config", [TINY, TINY_PGD], ids=["fcos3d", "pgd"])
ALL = [TINY, TINY_PGD, TINY_VECTORS, TINY_PGD_VECTORS]
NAMES = ["fcos3d", "pgd", "vectors", "pgd, vectors"]


VIRTUAL = 400 / 1.2  # the lens of `some_truth` has 1.2 times this focal length


@pytest.mark.parametrize(
    "config",
    [*ALL, replace(TINY, virtual_focal=VIRTUAL), replace(TINY_PGD, virtual_focal=VIRTUAL)],
    ids=[*NAMES, "fcos3d, other lens", "pgd, other lens"],
)
def test_the_truth_costs_nothing(config: Mono3DConfig) -> None:
    detector = Mono3D(config).double()
    dense, assignment = perfect(detector, some_truth(), (225, 400))
    found = detector.losses(dense, assignment)
    names = PGD if config.pgd else FCOS
    assert set(found) == (names if config.heading == "bins" else names - {"rotsin", "dir"} | {"axis", "side"})
    for name in set(found) - {"centerness"}:
        assert float(found[name]) == pytest.approx(0.0, abs=1e-9), name
    near = assignment.extra["centreness"][assignment.label >= 0].clamp(1e-9, 1 - 1e-9)
    entropy = -(near * near.log() + (1 - near) * (1 - near).log()).mean()  # the least that there is
    assert float(found["centerness"]) == pytest.approx(float(entropy))


def nudge(dense: Dense, channel: int, by: float) -> Dense:
    maps = [m.clone() for m in dense.maps["bbox_preds"]]
    for m in maps:
        m[:, channel] += by
    return replace(dense, maps={**dense.maps, "bbox_preds": maps})


@pytest.fixture(scope="module")
def told() -> tuple[Mono3D, Dense, Assignment]:
    """A detector, outputs that say the truth, and their assignment."""
    detector = Mono3D(TINY).double()
    return detector, *perfect(detector, some_truth(), (225, 400))


@pytest.mark.parametrize(
    ("channel", "name", "weight"),
    [(2, "depth", 0.2), (3, "size", 1.0), (5, "size", 1.0), (7, "velo", 0.05), (8, "velo", 0.05)],
)
@pytest.mark.parametrize("by", [0.05, -0.8])
def test_each_part_is_smooth_l1_with_its_weight(
    told: tuple[Mono3D, Dense, Assignment], channel: int, name: str, weight: float, by: float
) -> None:
    detector, dense, assignment = told
    found = detector.losses(nudge(dense, channel, by), assignment)
    beta = 1 / 9
    wanted = weight * (by**2 / (2 * beta) if abs(by) < beta else abs(by) - beta / 2)
    assert float(found[name]) == pytest.approx(wanted)
    for other in set(found) - {name, "centerness"}:
        assert float(found[other]) == pytest.approx(0.0, abs=1e-9)


@BOTH
def test_depth_is_compared_as_a_camera_of_the_virtual_focal_length_sees_it(config: Mono3DConfig) -> None:
    """1.2 m too far before a lens of 1.2 times the virtual focal length is 1 m too far."""
    detector = Mono3D(replace(config, virtual_focal=VIRTUAL)).double()
    dense, assignment = perfect(detector, some_truth(), (225, 400))
    share = float(detector.bbox_head.fuse_lambda.double().sigmoid()) if config.pgd else 1.0
    found = detector.losses(nudge(dense, 2, 1.2 / share), assignment)
    assert float(found["depth"]) == pytest.approx(0.2 * (1.0 - 1 / 18))


def test_yaw_is_compared_by_the_sine_of_the_difference(told: tuple[Mono3D, Dense, Assignment]) -> None:
    detector, dense, assignment = told
    for by in (0.4, math.pi, 2.0):
        value = abs(math.sin(by))
        wanted = value**2 * 4.5 if value < 1 / 9 else value - 1 / 18
        assert float(detector.losses(nudge(dense, 6, by), assignment)["rotsin"]) == pytest.approx(wanted, abs=1e-9)


@pytest.mark.parametrize("name", ["car", "barrier"])
def test_vectors_of_the_yaw_are_an_axis_and_a_logit(name: str) -> None:
    """Smooth L1 of twice the yaw; -log sigmoid of twice the part of the first vector along the true one."""
    detector = Mono3D(replace(TINY_VECTORS, code_weights=(1, 1, 0.2, 1, 1, 1, 0.5, 0.05, 0.05))).double()
    truth = some_truth()
    label = torch.full_like(truth.label, detector.classes.index(name))
    dense, assignment = perfect(detector, replace(truth, label=label), (225, 400))
    vectors = [m.clone() for m in dense.maps["dir_cls_preds"]]
    for m in vectors:
        ahead, across = m[:, :2] / 30.0, torch.stack([-m[:, 1], m[:, 0]], 1)
        m[:, :2] = -0.7 * ahead + 3.0 * across  # what lies across the true axis says nothing
        m[:, 3] -= 0.8
    found = detector.losses(replace(dense, maps={**dense.maps, "dir_cls_preds": vectors}), assignment)
    assert float(found["axis"]) == pytest.approx(0.5 * (0.8 - 1 / 18))
    wanted = math.log1p(math.exp(1.4)) if name == "car" else 0.0  # a barrier looks alike from both ends
    assert float(found["side"]) == pytest.approx(wanted, abs=1e-6)


def test_pgd_compares_the_fused_depth() -> None:
    detector = Mono3D(TINY_PGD).double()
    dense, assignment = perfect(detector, some_truth(), (225, 400))
    share = float(detector.bbox_head.fuse_lambda.double().sigmoid())
    found = detector.losses(nudge(dense, 2, 1.0), assignment)
    assert float(found["depth"]) == pytest.approx(0.2 * (share - 1 / 18))
    assert found["consistency"] > 0  # the ray is longer, so the box stands elsewhere
    wider = detector.losses(nudge(dense, 11, 8.0), assignment)
    assert wider["consistency"] > 0
    assert wider["bbox2d"] > 0


@pytest.mark.parametrize("config", ALL, ids=NAMES)
@pytest.mark.parametrize("resized", [False, True])
def test_sums_over_a_batch(config: Mono3DConfig, resized: bool) -> None:
    """Batch: over all positives; image: as if alone; and no image's losses depend on the others."""
    if resized:
        config = replace(config, input_width=160, virtual_focal=130.0)
    detector = lively(config, double=True)
    truths = [some_truth(5, size=(120, 200)), some_truth(0, size=(120, 200)), some_truth(3, seed=2, size=(120, 200))]
    images = torch.rand(3, 3, 120, 200, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    k = torch.stack([t.intrinsic for t in truths if t.intrinsic is not None])
    dense = detector.dense(images, k)
    assignment = detector.assign(dense, truths)
    whole, each = detector.losses(dense, assignment), detector.losses(dense, assignment, reduction="image")
    positives = (assignment.label >= 0).sum(1).double()
    assert positives[0] > 0
    assert positives[1] == 0
    for name, values in each.items():
        assert values.shape == (3,)
        weight = positives + 1 if name == "cls" else positives
        if name == "attr":
            weight = assignment.extra["centreness"].sum(1)
        assert float((values * weight).sum() / weight.sum()) == pytest.approx(float(whole[name])), name
    for n in range(3):
        alone = detector.dense(images[n : n + 1], k[n : n + 1])
        found = detector.losses(alone, detector.assign(alone, truths[n : n + 1]))
        for name, value in found.items():
            assert float(value) == pytest.approx(float(each[name][n]), rel=1e-9, abs=1e-12), name
        if n == 1:
            assert all(float(v) == 0.0 for name, v in found.items() if name != "cls")
            assert found["cls"] > 0


def test_unknown_velocity_costs_and_moves_nothing() -> None:
    detector = lively(TINY, double=True)
    truth = some_truth(4, size=(96, 160))
    assert truth.solid is not None
    unknown = replace(truth, solid=replace(truth.solid, velocity=torch.full((4, 2), math.nan, dtype=torch.float64)))
    images = torch.rand(1, 3, 96, 160, dtype=torch.float64).requires_grad_()
    dense = detector.dense(images, lens(size=(96, 160))[None])
    found = detector.losses(dense, detector.assign(dense, [unknown]))
    assert found["velo"] == 0
    known = detector.losses(dense, detector.assign(dense, [truth]))
    assert known["velo"] > 0
    assert all(found[name] == known[name] for name in FCOS - {"velo"})
    (grad,) = torch.autograd.grad(sum(found.values(), torch.zeros(())), images)
    assert bool(grad.isfinite().all())


def test_a_box_that_reaches_behind_the_camera_has_a_loss() -> None:
    detector = lively(TINY_PGD, double=True)
    solid = Solids(
        torch.tensor([[0.2, 0.1, 1.0]], dtype=torch.float64),
        torch.tensor([[12.0, 3.0, 2.5]], dtype=torch.float64),
        torch.tensor([1.5], dtype=torch.float64),
        torch.zeros(1, 2),
        torch.tensor([5]),
    )
    truth = Truth(torch.tensor([1]), torch.tensor([[0.0, 0, 160, 96]]), solid)
    images = torch.rand(1, 3, 96, 160, dtype=torch.float64).requires_grad_()
    dense = detector.dense(images, lens(100.0, (96, 160))[None])
    assignment = detector.assign(dense, [truth])
    assert bool((assignment.label >= 0).any())
    found = detector.losses(dense, assignment)
    (grad,) = torch.autograd.grad(sum(found.values(), torch.zeros(())), images)
    assert bool(grad.isfinite().all())
    assert all(bool(v.isfinite()) for v in found.values())


def test_an_assignment_of_other_pictures() -> None:
    detector = lively(TINY)
    dense = detector.dense(torch.zeros(1, 3, 64, 64), lens()[None])
    other = detector.assign(detector.dense(torch.zeros(1, 3, 96, 64), lens()[None]), [some_truth()])
    with pytest.raises(ConfigError, match="pictures of another number or size"):
        detector.losses(dense, other)
    with pytest.raises(ConfigError, match="truth of 2 images for a batch of 1"):
        detector.assign(dense, [some_truth(), some_truth()])


DEEP = replace(TINY, trunk=50, width=8, strides=(8, 16, 32, 64, 128), ranges=(24.0, 48.0, 96.0, 192.0, 1e8))
GRADIENTS = {
    "fcos3d, deformable": DEEP,
    "pgd, deformable": replace(DEEP, pgd=True, code_weights=TINY_PGD.code_weights),
    "fcos3d, light, resized": replace(TINY, deformable=False, input_width=64, virtual_focal=50.0),
    "pgd, light, resized": replace(TINY_PGD, deformable=False, input_width=80, virtual_focal=50.0),
}


@pytest.mark.parametrize("config", GRADIENTS.values(), ids=GRADIENTS.keys())
def test_gradients_to_the_image_equal_finite_differences(config: Mono3DConfig) -> None:
    """Each loss, in float64, along directions that change all pixels and along single pixels."""
    size = (49, 75)
    detector = lively(config, seed=5, double=True)
    truth = some_truth(4, seed=1, size=size, focal=60.0)
    draws = torch.Generator().manual_seed(7)
    images = 0.1 + 0.8 * torch.rand(1, 3, *size, generator=draws, dtype=torch.float64)
    k = lens(60.0, size)[None]

    def losses(x: Tensor, fixed: Assignment | None = None) -> tuple[dict[str, Tensor], Assignment]:
        dense = detector.dense(x, k)
        chosen = detector.assign(dense, [truth]) if fixed is None else fixed
        return detector.losses(dense, chosen), chosen

    leaf = images.clone().requires_grad_()
    found, assignment = losses(leaf)
    assert int((assignment.label >= 0).sum()) > 3
    names = sorted(found)
    slopes = {name: torch.autograd.grad(found[name], leaf, retain_graph=True)[0] for name in names}
    step = 1e-7
    ways = [torch.randn(images.shape, generator=draws, dtype=torch.float64) for _ in range(2)]
    ways[1] = torch.zeros_like(images)
    ways[1][0, 1, 20, 30] = 10.0
    for way in ways:
        with torch.no_grad():
            up, down = losses(images + step * way, assignment)[0], losses(images - step * way, assignment)[0]
        for name in names:
            wanted = float(up[name] - down[name]) / (2 * step)
            assert float((slopes[name] * way).sum()) == pytest.approx(wanted, rel=2e-5, abs=1e-8), name
    assert all(float(slope.abs().max()) > 0 for slope in slopes.values())


@BOTH
def test_gradients_of_dense_boxes_equal_finite_differences(config: Mono3DConfig) -> None:
    detector = lively(replace(config, input_width=64), seed=2, double=True)
    draws = torch.Generator().manual_seed(3)
    images = torch.rand(1, 3, 50, 70, generator=draws, dtype=torch.float64)
    k = lens(60.0, (50, 70))[None]
    weight = torch.randn(4, generator=draws, dtype=torch.float64)

    def value(x: Tensor) -> Tensor:
        dense = detector.dense(x, k)
        assert dense.quality is not None
        return (dense.box * weight).mean() + dense.logit.mean() + dense.quality.mean()

    leaf = images.clone().requires_grad_()
    (slope,) = torch.autograd.grad(value(leaf), leaf)
    way = torch.randn(images.shape, generator=draws, dtype=torch.float64)
    with torch.no_grad():
        wanted = float(value(images + 1e-7 * way) - value(images - 1e-7 * way)) / 2e-7
    assert float((slope * way).sum()) == pytest.approx(wanted, rel=1e-5)
