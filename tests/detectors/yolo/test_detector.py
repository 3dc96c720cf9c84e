"""YOLO as a detector: predictions, gradients to the image, batches, odd sizes, training from nothing."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from torchvision.ops import nms

from ssad.core.detections import Dense, Detections, Truth
from ssad.core.errors import ConfigError
from ssad.core.protocols import Detector
from ssad.detectors.yolo.decode import select
from ssad.detectors.yolo.detector import Yolo
from ssad.detectors.yolo.loss import BALANCE
from ssad.detectors.yolov3 import YOLOV3, YOLOV3_TINY
from ssad.detectors.yolov5 import YOLOV5N
from ssad.metrics.detection2d import Boxes2D, average_precision

CLASSES = ("car", "person")
V5 = replace(YOLOV5N, width=0.125)
V3 = replace(YOLOV3, width=0.125, depth=0.125)
TINY = replace(YOLOV3_TINY, width=0.125)
EVERY = pytest.mark.parametrize(
    "spec", [V5, V3, TINY, replace(TINY, box_loss="squares")], ids=["v5", "v3", "tiny", "squares"]
)


def lively(spec, **options) -> Yolo:  # type: ignore[no-untyped-def]
    """A detector whose heads answer differently from place to place."""
    detector = Yolo(spec, CLASSES, **options)
    for head in detector.network.outputs():
        head.weight.data *= 10
    return detector


def pictures(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def one_truth() -> Truth:
    box = torch.tensor([[4.0, 6, 30, 33], [20, 10, 47, 39]])
    return Truth(torch.tensor([0, 1]), box)


@EVERY
def test_it_is_a_detector(spec) -> None:  # type: ignore[no-untyped-def]
    detector = Yolo(spec, CLASSES)
    assert isinstance(detector, Detector)
    assert (detector.name, detector.task, detector.classes) == (spec.name, "2d", CLASSES)


@EVERY
@pytest.mark.parametrize("size", [(1, 1), (33, 65), (100, 37), (64, 96)])
def test_any_size_works(spec, size: tuple[int, int]) -> None:  # type: ignore[no-untyped-def]
    detector = lively(spec)
    images = pictures(2, 3, *size).requires_grad_()
    dense = detector.dense(images)
    places = sum(3 * (-(-size[0] // 32) * 32 // stride) * (-(-size[1] // 32) * 32 // stride) for stride in spec.strides)
    assert dense.logit.shape == (2, places, 2)
    assert dense.box.shape == (2, places, 4)
    assert dense.place.shape == (places, 2)
    assert dense.size == size
    assert len(dense.features) == len(dense.maps["raw"]) == len(spec.strides)
    assert torch.equal(dense.place % dense.stride[:, None], (dense.stride / 2)[:, None].expand(-1, 2))
    assert dense.quality is not None
    (dense.box.sum() + dense.quality.sum() + dense.logit.sum()).backward()
    assert images.grad is not None
    assert images.grad.isfinite().all()
    assert images.grad.any()
    for found in detector.predict(images, threshold=0.0001):
        assert len(found.score) <= 300
        assert (found.box >= 0).all()
        assert (found.box <= torch.tensor([size[1], size[0]] * 2)).all()


@EVERY
def test_results_do_not_depend_on_the_batch(spec) -> None:  # type: ignore[no-untyped-def]
    detector = lively(spec)
    images = pictures(3, 3, 50, 70)
    together, dense = detector.predict(images, threshold=0.0001), detector.dense(images)
    for index in range(3):
        one = detector.dense(images[index : index + 1])
        torch.testing.assert_close(one.logit[0], dense.logit[index], rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(one.box[0], dense.box[index], rtol=1e-4, atol=1e-3)
        alone = detector.predict(images[index : index + 1], threshold=0.0001)[0]
        torch.testing.assert_close(alone.score, together[index].score, rtol=1e-4, atol=1e-6)


@EVERY
def test_a_resized_picture_gives_boxes_of_its_own_pixels(spec) -> None:  # type: ignore[no-untyped-def]
    detector, narrow = lively(spec), lively(spec, input_width=70)
    images = pictures(1, 3, 50, 70)
    large = images.repeat_interleave(2, 2).repeat_interleave(2, 3)
    expected, dense = detector.dense(images), narrow.dense(large)
    torch.testing.assert_close(dense.logit, expected.logit, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(dense.box, 2 * expected.box, rtol=1e-4, atol=1e-3)
    torch.testing.assert_close(dense.place, 2 * expected.place)
    torch.testing.assert_close(dense.stride, 2 * expected.stride)
    real = one_truth()
    ours = narrow.assign(dense, [replace(real, box=2 * real.box)])
    theirs = detector.assign(expected, [real])
    assert torch.equal(ours.label, theirs.label)
    torch.testing.assert_close(ours.extra["box"], 2 * theirs.extra["box"])
    for name, value in narrow.losses(dense, ours).items():
        torch.testing.assert_close(value, detector.losses(expected, theirs)[name], rtol=1e-4, atol=1e-5)


@EVERY
def test_a_resized_picture_has_a_scale_of_its_own_in_each_direction(spec) -> None:  # type: ignore[no-untyped-def]
    """160 x 3 pixels become 64 x 1: by 0.4 to the right, but by a third down. Raw zeros are the anchors themselves."""
    detector = Yolo(spec, CLASSES, input_width=64)
    for head in detector.network.outputs():
        head.weight.data.zero_()
        head.bias.data.zero_()  # type: ignore[union-attr]
    dense = detector.dense(torch.zeros(1, 3, 3, 160))
    stride = spec.strides[0]
    torch.testing.assert_close(dense.place[0], torch.tensor([stride / 2 / 0.4, stride / 2 * 3]))
    width, height = spec.anchors[0][0]
    middle, half = torch.tensor([stride / 2 / 0.4, stride / 2 * 3]), torch.tensor([width / 0.4, height * 3]) / 2
    torch.testing.assert_close(dense.box[0, 0], torch.cat([middle - half, middle + half]))


def frozen_loss(detector: Yolo, base: Dense, dense: Dense, assignment) -> Tensor:  # type: ignore[no-untyped-def]
    """The loss with what the detector detaches (targets of objectness, weight of the aspect) held at `base`."""
    values = detector.losses(dense, assignment)
    owned = assignment.label >= 0
    scale = detector._scale(dense.size, dense.box)
    target = assignment.extra["box"][owned] * scale

    def parts(box: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        low, high = torch.maximum(box[:, :2], target[:, :2]), torch.minimum(box[:, 2:], target[:, 2:])
        both = (high - low).clamp(min=0).prod(-1)
        size, real = box[:, 2:] - box[:, :2], target[:, 2:] - target[:, :2]
        overlap = both / (size.prod(-1) + real.prod(-1) - both)
        hull = torch.maximum(box[:, 2:], target[:, 2:]) - torch.minimum(box[:, :2], target[:, :2])
        apart = ((box[:, :2] + box[:, 2:] - target[:, :2] - target[:, 2:]) ** 2).sum(-1) / 4 / (hull**2).sum(-1)
        aspect = 4 / np.pi**2 * (torch.atan(real[:, 0] / real[:, 1]) - torch.atan(size[:, 0] / size[:, 1])) ** 2
        return overlap, apart, aspect

    fixed_overlap, fixed_apart, fixed_aspect = parts(base.box[owned] * scale)
    weight = fixed_aspect / (1 - fixed_overlap + fixed_aspect)
    overlap, apart, aspect = parts(dense.box[owned] * scale)
    loss = 1 - overlap + apart + weight * aspect
    if detector.spec.rule == "v3":
        share = (target[:, 2:] - target[:, :2]).prod(-1) / (64 * 64)
        if detector.spec.box_loss == "ciou":
            values["box"] = (loss * (2 - share)).sum()
        return sum(values.values())  # type: ignore[return-value]
    level = dense.level[owned.nonzero()[:, 1]]
    values["box"] = 0.05 * sum(loss[level == i].mean() for i in range(3) if (level == i).any())  # type: ignore[assignment]
    wanted = torch.zeros_like(base.box[..., 0])
    wanted[owned] = (fixed_overlap - fixed_apart - weight * fixed_aspect).clamp(min=0)
    every = torch.nn.functional.binary_cross_entropy_with_logits(dense.quality, wanted, reduction="none")
    values["obj"] = sum(  # type: ignore[assignment]
        BALANCE[i] * every[:, dense.level == i].mean() for i in range(3)
    ) * (64 * 64 / 640**2)
    return sum(values.values())  # type: ignore[return-value]


@EVERY
@pytest.mark.parametrize("input_width", [None, 61])
def test_the_gradient_to_the_image_equals_finite_differences(spec, input_width: int | None) -> None:  # type: ignore[no-untyped-def]
    detector = lively(spec, input_width=input_width).double()
    images = pictures(1, 3, 41, 53).double().requires_grad_()
    base = detector.dense(images)
    assignment = detector.assign(base, [one_truth()])
    assert (assignment.label >= 0).any()
    loss = sum(detector.losses(base, assignment).values())
    (gradient,) = torch.autograd.grad(loss, images)  # type: ignore[arg-type]
    at = frozen_loss(detector, base, base, assignment)
    assert float(at.detach()) == pytest.approx(float(loss.detach()), rel=1e-6)  # type: ignore[union-attr]
    source = torch.Generator().manual_seed(1)
    largest = torch.zeros_like(images).flatten()
    largest[gradient.abs().argmax()] = 1
    for direction in (
        largest.view(images.shape),
        torch.randn(images.shape, generator=source, dtype=torch.float64),
    ):
        step = 1e-7 * direction
        with torch.no_grad():
            ahead, behind = (
                frozen_loss(detector, base, detector.dense(images + sign * step), assignment) for sign in (1, -1)
            )
        assert float((gradient * direction).sum()) == pytest.approx(float(ahead - behind) / 2e-7, rel=1e-5, abs=1e-8)


def test_selection_equals_suppression_class_by_class() -> None:
    source = torch.Generator().manual_seed(0)
    score = torch.rand(400, 3, generator=source)
    corner = 80 * torch.rand(400, 2, generator=source)
    box = torch.cat((corner, corner + 5 + 30 * torch.rand(400, 2, generator=source)), 1)
    box[7] = torch.nan
    (found,) = select(score[None], box[None], threshold=0.4, iou=0.45, limit=10_000, size=(90, 100))
    expected = []
    for label in range(3):
        rows = ((score[:, label] > 0.4) & box.isfinite().all(1)).nonzero().flatten()
        keep = rows[nms(box[rows], score[rows, label], 0.45)]
        expected += [(float(score[row, label]), label) for row in keep]
    assert list(zip(found.score.tolist(), found.label.tolist(), strict=True)) == sorted(expected, reverse=True)
    assert (found.box[:, [0, 2]] <= 100).all()
    assert (found.box[:, [1, 3]] <= 90).all()
    (few,) = select(score[None], box[None], threshold=0.4, iou=0.45, limit=5, size=(90, 100))
    assert torch.equal(few.score, found.score[:5])
    (none,) = select(score[None], box[None], threshold=1.0, iou=0.45, limit=5, size=(90, 100))
    assert none.box.shape == (0, 4)
    scores, boxes = torch.stack([0 * score, score, score.flip(0)]), torch.stack([box, box, box.flip(0)])
    empty, same, other = select(scores, boxes, threshold=0.4, iou=0.45, limit=5, size=(90, 100))
    assert empty.box.shape == (0, 4)
    for one in (same, other):  # images of a batch do not know each other
        assert torch.equal(one.score, few.score)
        assert torch.equal(one.box, few.box)


def test_the_best_30_000_candidates_are_compared_and_no_more() -> None:
    """Of 40,000, all in one place but for two: the last that counts and the first that does not."""
    rank = torch.randperm(40_000, generator=torch.Generator().manual_seed(0))
    score = 1 - (rank.double() + 1) / 50_000
    box = torch.tensor([[0.0, 0, 10, 10]]).repeat(40_000, 1)
    box[rank == 29_999] = torch.tensor([40.0, 0, 50, 10])
    box[rank == 30_000] = torch.tensor([80.0, 0, 90, 10])
    (found,) = select(score[None, :, None], box[None], threshold=0.1, iou=0.5, limit=300, size=(100, 100))
    assert found.box[:, 0].tolist() == [0, 40]
    assert found.score.tolist() == pytest.approx([1 - 1 / 50_000, 1 - 30_000 / 50_000])


def test_scores_are_objectness_times_class() -> None:
    detector = lively(TINY)
    images = pictures(1, 3, 64, 64)
    dense, (found,) = detector.dense(images), detector.predict(images, threshold=0.0)
    assert dense.quality is not None
    score = dense.logit.sigmoid() * dense.quality.sigmoid()[..., None]
    assert float(found.score[0]) == float(score.max())
    assert int(found.label[0]) == int(score.flatten().argmax()) % 2
    assert (found.score.diff() <= 0).all()


@EVERY
def test_predicting_changes_nothing(spec) -> None:  # type: ignore[no-untyped-def]
    detector = lively(spec).train()
    detector.network.get_submodule("trunk" if spec is not V5 else "stem").eval()
    modes = [part.training for part in detector.modules()]
    before = {name: value.clone() for name, value in detector.state_dict().items()}
    images = pictures(2, 3, 64, 64)
    first = detector.predict(images, threshold=0.001)
    assert [part.training for part in detector.modules()] == modes
    assert all(torch.equal(before[name], value) for name, value in detector.state_dict().items())
    second = detector.eval().predict(images, threshold=0.001)
    assert all(torch.equal(a.score, b.score) for a, b in zip(first, second, strict=True))
    assert not first[0].score.requires_grad


@EVERY
def test_losses_are_float32_under_mixed_precision(spec) -> None:  # type: ignore[no-untyped-def]
    detector = lively(spec).requires_grad_(True).train()
    images = pictures(2, 3, 64, 64)
    with torch.autocast("cpu", torch.bfloat16):
        dense = detector.dense(images)
        assignment = detector.assign(dense, [one_truth(), one_truth()])
        values = detector.losses(dense, assignment)
    assert dense.maps["raw"][0].dtype is torch.bfloat16
    assert dense.box.dtype is torch.float32
    assert all(value.dtype is torch.float32 for value in values.values())
    sum(values.values()).backward()  # type: ignore[union-attr]
    assert all(part.grad is not None and part.grad.isfinite().all() for part in detector.parameters())


def drawn(seed: int = 0) -> tuple[Tensor, list[Truth]]:
    """Four pictures with two or three rectangles each: dark ones are cars, bright ones persons."""
    source = np.random.default_rng(seed)
    images, objects = [], []
    for _ in range(4):
        picture = np.full((3, 96, 128), 0.5) + source.normal(0, 0.02, (3, 96, 128))
        labels, boxes = [], []
        for column in range(int(source.integers(2, 4))):
            width, height = int(source.integers(18, 36)), int(source.integers(20, 50))
            x, y = 2 + 42 * column + int(source.integers(0, 40 - width)), int(source.integers(2, 94 - height))
            label = int(source.integers(0, 2))
            picture[:, y : y + height, x : x + width] = label
            labels.append(label)
            boxes.append([x, y, x + width, y + height])
        images.append(torch.from_numpy(picture).float().clamp(0, 1))
        objects.append(Truth(torch.tensor(labels), torch.tensor(boxes, dtype=torch.float32)))
    return torch.stack(images), objects


def precision(found: list[Detections], objects: list[Truth]) -> float:
    def stack(boxes: list[Tensor], labels: list[Tensor], scores: list[Tensor] | None) -> Boxes2D:
        image = np.repeat(np.arange(len(boxes)), [len(one) for one in boxes]).astype(np.int32)
        score = None if scores is None else torch.cat(scores).double().numpy()
        return Boxes2D(image, torch.cat(labels).int().numpy(), torch.cat(boxes).double().numpy(), score)

    real = stack([one.box for one in objects], [one.label for one in objects], None)
    ours = stack([one.box for one in found], [one.label for one in found], [one.score for one in found])
    return float(np.nanmean(average_precision(real, ours, labels=2)))


def train(detector: Yolo, steps: int) -> list[float]:
    """The loss at each step of a training on `drawn`."""
    images, objects = drawn()
    detector.requires_grad_(True).train()
    optimiser = torch.optim.Adam(detector.parameters(), lr=0.01)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    history = []
    for _ in range(steps):
        dense = detector.dense(images)
        loss = torch.stack(list(detector.losses(dense, detector.assign(dense, objects)).values())).sum()
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        schedule.step()
        history.append(float(loss.detach()))
    detector.eval()
    return history


@EVERY
def test_a_short_training_lowers_the_loss(spec) -> None:  # type: ignore[no-untyped-def]
    history = train(Yolo(spec, CLASSES), 30)
    assert history[-1] < 0.6 * history[0]  # 0.04 to 0.35 of it


@pytest.mark.parametrize(
    ("spec", "steps"),
    [
        pytest.param(TINY, 40, id="tiny"),
        pytest.param(replace(TINY, box_loss="squares"), 40, id="squares"),
        pytest.param(V5, 140, id="v5", marks=pytest.mark.slow),
        pytest.param(V3, 100, id="v3", marks=pytest.mark.slow),
    ],
)
def test_training_from_nothing_finds_the_objects(spec, steps: int) -> None:  # type: ignore[no-untyped-def]
    images, objects = drawn()
    detector = Yolo(spec, CLASSES)
    assert precision(detector.predict(images, threshold=0.001), objects) < 0.1
    train(detector, steps)
    assert precision(detector.predict(images, threshold=0.001), objects) > 0.4  # 0.7 and more, by processor


@pytest.mark.parametrize(
    "images",
    [
        torch.zeros(3, 64, 64),
        torch.zeros(1, 1, 64, 64),
        torch.zeros(1, 3, 64, 64, dtype=torch.uint8),
        torch.zeros(1, 3, 0, 64),
        torch.zeros(1, 3, 64, 64, dtype=torch.int16),
    ],
    ids=["no batch", "greyscale", "8 bit", "empty", "16 bit"],
)
def test_images_that_are_none_are_one_line(images: Tensor) -> None:
    with pytest.raises(ConfigError, match=r"\[B, 3, H, W\]") as caught:
        Yolo(TINY, CLASSES).predict(images)
    assert "\n" not in str(caught.value)


def test_a_threshold_must_be_a_score() -> None:
    with pytest.raises(ConfigError, match="threshold"):
        Yolo(TINY, CLASSES).predict(pictures(1, 3, 32, 32), threshold=1.5)
