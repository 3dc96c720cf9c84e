"""YOLO's decoding, assignment and losses against their inverse, against loops over every place, and by hand."""

from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn
from torchvision.ops import complete_box_iou_loss

from ssad.core.detections import Assignment, Dense, Truth
from ssad.core.errors import ConfigError
from ssad.detectors.yolo.decode import CellGrid, decode, make_grid
from ssad.detectors.yolo.detector import Yolo
from ssad.detectors.yolo.loss import BALANCE, ciou
from ssad.detectors.yolov3 import YOLOV3, YOLOV3_TINY
from ssad.detectors.yolov5 import YOLOV5N

CLASSES = ("car", "person", "bus")
V5 = Yolo(replace(YOLOV5N, width=0.125), CLASSES)
V3 = Yolo(replace(YOLOV3, width=0.125, depth=0.125), CLASSES)
TINY = Yolo(replace(YOLOV3_TINY, width=0.125), CLASSES)
SQUARES = Yolo(replace(YOLOV3_TINY, width=0.125, box_loss="squares"), CLASSES)
EVERY = pytest.mark.parametrize("detector", [V5, V3, TINY, SQUARES], ids=["v5", "v3", "tiny", "squares"])


class Fixed(nn.Module):
    """A network that answers with the maps it was given."""

    def __init__(self, maps: Sequence[Tensor]) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.ones(()))
        self.maps = tuple(maps)

    def forward(self, x: Tensor) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
        return self.maps, ()


def truth(label: Sequence[int], box: Sequence[Sequence[float]], crowd: Sequence[bool] | None = None) -> Truth:
    return Truth(
        torch.tensor(label, dtype=torch.int64),
        torch.tensor(box, dtype=torch.float32).reshape(-1, 4),
        crowd=None if crowd is None else torch.tensor(crowd),
    )


def grid_of(detector: Yolo, height: int, width: int) -> CellGrid:
    shapes = [(height // stride, width // stride) for stride in detector.spec.strides]
    return make_grid(shapes, detector.spec.strides, detector.anchors)


def answering(detector: Yolo, values: Tensor, grid: CellGrid) -> Yolo:
    """The detector with a network whose flattened output is `values` [B, P, 5 + C]."""
    count, batch = grid.anchors.shape[1], len(values)
    ends = [*grid.start[1:], values.shape[1]]
    maps = [
        values[:, first:end]
        .view(batch, count, rows, columns, -1)
        .permute(0, 1, 4, 2, 3)
        .reshape(batch, -1, rows, columns)
        for first, end, (rows, columns) in zip(grid.start, ends, grid.shapes, strict=True)
    ]
    copy = Yolo(detector.spec, detector.classes)
    copy.network = Fixed(maps)  # type: ignore[assignment]
    return copy


def encode(rule: str, box: Tensor, grid: CellGrid) -> Tensor:
    """The raw numbers [..., P, 4] that `decode` turns into the boxes [..., P, 4]; infinite or NaN where none do."""
    cell = (box[..., :2] + box[..., 2:]) / 2 / grid.stride[:, None] - grid.cell
    ratio = (box[..., 2:] - box[..., :2]) / grid.anchor
    if rule == "v3":
        return torch.cat((cell.logit(), ratio.log()), -1)
    return torch.cat((((cell + 0.5) / 2).logit(), (ratio.sqrt() / 2).logit()), -1)


def random_truth(source: torch.Generator, count: int, height: int, width: int) -> Truth:
    middle = torch.rand(count, 2, generator=source) * torch.tensor([width, height])
    size = 4 + torch.rand(count, 2, generator=source) ** 2 * 200
    box = torch.cat((middle - size / 2, middle + size / 2), 1)
    return Truth(torch.randint(0, 3, (count,), generator=source), box, crowd=torch.rand(count, generator=source) < 0.3)


@EVERY
def test_encode_is_the_inverse_of_decode(detector: Yolo) -> None:
    grid = grid_of(detector, 96, 160)
    raw = torch.randn(2, len(grid.stride), 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    box = decode(detector.spec.rule, raw, grid)
    torch.testing.assert_close(encode(detector.spec.rule, box, grid), raw, rtol=1e-5, atol=1e-5)


def test_decoding_by_hand() -> None:
    # level 1 (stride 16), anchor 2 (59 x 119), row 2, column 3 of a picture of 64 x 96
    grid = grid_of(V3, 64, 96)
    place = 3 * 8 * 12 + 2 * 4 * 6 + 2 * 6 + 3
    assert grid.cell[place].tolist() == [3, 2]
    assert (float(grid.stride[place]), int(grid.level[place]), grid.anchor[place].tolist()) == (16, 1, [59, 119])
    raw = torch.zeros(1, len(grid.stride), 4)
    assert decode("v3", raw, grid)[0, place].tolist() == [56 - 29.5, 40 - 59.5, 56 + 29.5, 40 + 59.5]
    assert decode("v5", raw, grid)[0, place].tolist() == [56 - 29.5, 40 - 59.5, 56 + 29.5, 40 + 59.5]
    raw[0, place] = torch.tensor([20.0, -20.0, 500.0, 0.0])
    wide = decode("v3", raw, grid)[0, place]
    torch.testing.assert_close(wide, torch.tensor([64 - 29500.0, 32 - 59.5, 64 + 29500, 32 + 59.5]))
    most = decode("v5", raw, grid)[0, place]
    torch.testing.assert_close(most, torch.tensor([72 - 118.0, 24 - 59.5, 72 + 118, 24 + 59.5]))


@EVERY
def test_a_perfect_map_decodes_to_the_truth_and_has_no_loss(detector: Yolo) -> None:
    grid = grid_of(detector, 128, 192)
    images = torch.zeros(2, 3, 120, 190)
    objects = [
        truth([0, 2, 1], [[10.5, 12, 40, 52], [70, 20, 180, 118], [100.25, 60, 112, 81]]),
        truth([1], [[30, 40, 65, 90.5]]),
    ]
    places = len(grid.stride)
    blank = answering(detector, torch.zeros(2, places, 8), grid)
    assignment = blank.assign(blank.dense(images), objects)
    values = torch.full((2, places, 8), -14.0)
    # tiny boxes where nothing is, so that none of them happens to overlap an object
    values[..., :4] = 0 if detector.spec.rule == "v5" else -3.0
    for image, place in (assignment.label >= 0).nonzero().tolist():
        wanted = assignment.extra["box"][image]
        values[image, place, :4] = encode(detector.spec.rule, wanted, grid)[place]
        values[image, place, 4] = 14.0
        values[image, place, 5 + int(assignment.label[image, place])] = 14.0
    perfect = answering(detector, values, grid)
    dense = perfect.dense(images)
    for found, real in zip(perfect.predict(images), objects, strict=True):
        assert sorted(found.label.tolist()) == sorted(real.label.tolist())
        order = [found.label.tolist().index(label) for label in real.label.tolist()]
        torch.testing.assert_close(found.box[order], real.box, rtol=1e-4, atol=1e-3)
    again = perfect.assign(dense, objects)
    assert torch.equal(again.owner, assignment.owner)
    for reduction in ("batch", "image"):
        for name, value in perfect.losses(dense, again, reduction=reduction).items():  # type: ignore[arg-type]
            assert value.min() >= 0, name
            assert value.max() < 2e-3, name
    assert all(value > 0.01 for value in blank.losses(blank.dense(images), assignment).values())


def slow_owner(detector: Yolo, grid: CellGrid, one: Truth) -> list[int]:
    """The rules of the two papers as loops over objects, anchors and cells."""
    crowd = one.crowd if one.crowd is not None else torch.zeros(len(one.label), dtype=torch.bool)
    best: dict[int, tuple[float, int]] = {}
    for index, (box, hidden) in enumerate(zip(one.box.tolist(), crowd.tolist(), strict=True)):
        w, h, x, y = box[2] - box[0], box[3] - box[1], (box[0] + box[2]) / 2, (box[1] + box[3]) / 2
        options = []
        for level, sizes in enumerate(detector.spec.anchors):
            for anchor, (aw, ah) in enumerate(sizes):
                both = min(w, aw) * min(h, ah)
                options.append((both / (w * h + aw * ah - both), level, anchor, aw, ah))
        if detector.spec.rule == "v3":
            options = [max(options, key=lambda option: option[0])]
        else:
            options = [o for o in options if max(w / o[3], o[3] / w, h / o[4], o[4] / h) < 4]
        for quality, level, anchor, _, _ in options:
            stride = detector.spec.strides[level]
            rows, columns = grid.shapes[level]
            column = min(max(int(x // stride), 0), columns - 1)
            row = min(max(int(y // stride), 0), rows - 1)
            cells = [(row, column)]
            if detector.spec.rule == "v5":
                for dr, dc, near in (
                    (0, -1, x / stride - column < 0.5),
                    (0, 1, x / stride - column > 0.5),
                    (-1, 0, y / stride - row < 0.5),
                    (1, 0, y / stride - row > 0.5),
                ):
                    if near and 0 <= row + dr < rows and 0 <= column + dc < columns:
                        cells.append((row + dr, column + dc))
            for r, c in cells:
                place = grid.start[level] + (anchor * rows + r) * columns + c
                rank = quality - 2 * hidden
                if place not in best or rank > best[place][0] + 1e-7:
                    best[place] = (rank, index)
    return [best[place][1] if place in best else -1 for place in range(len(grid.stride))]


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(0, 9))
@EVERY
def test_assignment_equals_loops_over_everything(detector: Yolo, seed: int, count: int) -> None:
    source = torch.Generator().manual_seed(seed)
    grid = grid_of(detector, 96, 128)
    objects = [random_truth(source, count, 90, 120), random_truth(source, 3, 90, 120)]
    values = 0.7 * torch.randn(2, len(grid.stride), 8, generator=source)
    detector = answering(detector, values, grid)
    dense = detector.dense(torch.zeros(2, 3, 90, 120))
    assignment = detector.assign(dense, objects)
    for image, one in enumerate(objects):
        assert one.crowd is not None
        owner, crowd, kind = slow_owner(detector, grid, one), one.crowd.tolist(), one.label.tolist()
        labels, owners = assignment.label[image].tolist(), assignment.owner[image].tolist()
        wanted = torch.cat([one.box, torch.zeros(1, 4)])[[-1 if k >= 0 and crowd[k] else k for k in owner]]
        torch.testing.assert_close(assignment.extra["box"][image], wanted)
        rivals = one.box if detector.spec.rule == "v3" else one.box[one.crowd]
        overlaps = iou(dense.box[image], rivals).tolist()
        for place, mine in enumerate(owner):
            label = labels[place]
            if mine >= 0 and not crowd[mine]:
                assert (label, owners[place]) == (kind[mine], mine)
                continue
            assert owners[place] == -1
            if mine >= 0:
                assert label == -2
                continue
            overlap = max(overlaps[place], default=0.0)
            if abs(overlap - 0.5) > 1e-4:
                assert label == (-2 if overlap > 0.5 else -1)


def iou(boxes: Tensor, others: Tensor) -> Tensor:
    """[P, Q] of boxes [P, 4] and [Q, 4]."""
    a = boxes[:, None]
    both = (torch.minimum(a[..., 2:], others[:, 2:]) - torch.maximum(a[..., :2], others[:, :2])).clamp(min=0).prod(-1)
    return both / ((a[..., 2:] - a[..., :2]).prod(-1) + (others[:, 2:] - others[:, :2]).prod(-1) - both)


def test_yolov3_takes_one_place_by_hand() -> None:
    dense = V3.dense(torch.zeros(1, 3, 64, 96))
    assignment = V3.assign(dense, [truth([1], [[56 - 30, 40 - 60, 56 + 30, 40 + 60]])])
    assert (assignment.label >= 0).nonzero().tolist() == [[0, 3 * 8 * 12 + 2 * 4 * 6 + 2 * 6 + 3]]


def test_yolov5_takes_the_nearest_cells_by_hand() -> None:
    # 120 x 120 fits 62 x 45 (2.7), 59 x 119, 116 x 90, 156 x 198, 373 x 326 (3.1) and no others (61 / 30: 4.0)
    dense = V5.dense(torch.zeros(1, 3, 128, 160))
    assignment = V5.assign(dense, [truth([2], [[52 - 60, 76 - 60, 52 + 60, 76 + 60]])])
    fine = 3 * 16 * 20
    middle = {(4, 3), (4, 2), (5, 3)}  # row 4.75, column 3.25 at stride 16
    coarse = {(2, 1), (2, 2), (1, 1)}  # row 2.375, column 1.625 at stride 32
    expected = {fine + anchor * 80 + row * 10 + column for anchor in (1, 2) for row, column in middle}
    expected |= {fine + 240 + anchor * 20 + row * 5 + column for anchor in (0, 1, 2) for row, column in coarse}
    assert set((assignment.label[0] == 2).nonzero().flatten().tolist()) == expected


@EVERY
def test_a_crowd_object_is_neither_right_nor_wrong(detector: Yolo) -> None:
    images = torch.rand(1, 3, 96, 128, generator=torch.Generator().manual_seed(3))
    boxes = [[10.0, 10, 50, 60], [70, 20, 120, 80]]
    dense = detector.dense(images)
    alone = detector.assign(dense, [truth([0], boxes[:1])])
    both = detector.assign(dense, [truth([0, 1], boxes, [False, True])])
    assert torch.equal(alone.owner, both.owner)
    hidden = (both.label == -2) & (alone.label == -1)
    assert hidden.any()
    assert torch.equal(both.label[~hidden], alone.label[~hidden])
    assert dense.quality is not None
    quality = dense.quality.detach().clone().requires_grad_()
    losses = detector.losses(replace(dense, quality=quality), both)
    losses["obj"].backward()
    assert quality.grad is not None
    assert not quality.grad[both.label == -2].any()
    assert quality.grad[both.label != -2].all()
    only = detector.assign(dense, [truth([1], boxes[1:], [True])])
    assert not (only.label >= 0).any()
    values = detector.losses(dense, only)
    assert values["box"] == 0
    assert values["cls"] == 0


@EVERY
def test_without_objects_only_objectness_is_lost(detector: Yolo) -> None:
    dense = detector.dense(torch.rand(2, 3, 64, 64, generator=torch.Generator().manual_seed(3)))
    assignment = detector.assign(dense, [truth([], []), truth([], [])])
    assert (assignment.label == -1).all()
    values = detector.losses(dense, assignment, reduction="image")
    assert values["obj"].shape == (2,)
    assert (values["obj"] > 0).all()
    assert not values["box"].any()
    assert not values["cls"].any()


@EVERY
def test_losses_of_an_image_are_those_of_the_image_alone(detector: Yolo) -> None:
    source = torch.Generator().manual_seed(5)
    images = torch.rand(3, 3, 96, 128, generator=source)
    objects = [random_truth(source, count, 96, 128) for count in (4, 0, 7)]
    dense = detector.dense(images)
    assignment = detector.assign(dense, objects)
    values = detector.losses(dense, assignment, reduction="image")
    for index in range(3):
        one = detector.dense(images[index : index + 1])
        alone = detector.assign(one, objects[index : index + 1])
        assert torch.equal(alone.label[0], assignment.label[index])
        assert torch.equal(alone.owner[0], assignment.owner[index])
        for name, value in detector.losses(one, alone).items():
            torch.testing.assert_close(values[name][index], value, rtol=1e-4, atol=1e-5)
    if detector.spec.rule == "v3":
        for name, value in detector.losses(dense, assignment).items():
            torch.testing.assert_close(value, values[name].mean())


def slow_v5(dense: Dense, assignment: Assignment) -> dict[str, float]:
    """YOLOv5's losses for a batch of padded pictures of 96 x 128, place by place."""
    assert dense.quality is not None
    sums = {"box": 0.0, "obj": 0.0, "cls": 0.0}
    softplus = torch.nn.functional.softplus
    for level in range(3):
        own = dense.level == level
        box, kind, every = [], [], []
        for image in range(len(dense.box)):
            for place in own.nonzero().flatten().tolist():
                label, logit = int(assignment.label[image, place]), dense.quality[image, place]
                if label == -2:
                    every.append(0.0)
                    continue
                wanted = 0.0
                if label >= 0:
                    overlap = ciou(dense.box[image, place][None], assignment.extra["box"][image, place][None])[0]
                    box.append(1 - overlap.item())
                    wanted = max(0.0, overlap.item())
                    for index, value in enumerate(dense.logit[image, place]):
                        kind.append(softplus(-value if index == label else value).item())
                every.append((softplus(logit) - wanted * logit).item())
        sums["box"] += 0.05 * sum(box) / max(1, len(box))
        sums["cls"] += 0.5 * 3 / 80 * sum(kind) / max(1, len(kind))
        sums["obj"] += BALANCE[level] * sum(every) / len(every) * 96 * 128 / 640**2
    return sums


def test_yolov5_losses_equal_a_loop() -> None:
    source = torch.Generator().manual_seed(2)
    grid = grid_of(V5, 96, 128)
    detector = answering(V5, torch.randn(2, len(grid.stride), 8, generator=source), grid)
    dense = detector.dense(torch.zeros(2, 3, 90, 120))
    assignment = detector.assign(dense, [random_truth(source, 5, 90, 120), random_truth(source, 2, 90, 120)])
    expected = slow_v5(dense, assignment)
    for name, value in detector.losses(dense, assignment).items():
        assert float(value) == pytest.approx(expected[name], rel=1e-4), name


def test_yolov3_losses_by_hand() -> None:
    # one object of 40 x 30 at the middle of cell (1, 1), stride 16, anchor 37 x 58; the raw map is zero
    grid = grid_of(SQUARES, 64, 64)
    detector = answering(SQUARES, torch.zeros(1, len(grid.stride), 8), grid)
    dense = detector.dense(torch.zeros(1, 3, 64, 64))
    assignment = detector.assign(dense, [truth([1], [[2.0, 5, 42, 50]])])
    assert (assignment.label >= 0).sum() == 1
    values = detector.losses(dense, assignment)
    w, h, ln2 = torch.log(torch.tensor(40 / 37)), torch.log(torch.tensor(45 / 58)), 0.6931472
    x, y = 22 / 16 - 1 - 0.5, 27.5 / 16 - 1 - 0.5
    expected = (2 - 40 * 45 / 64**2) * 0.5 * (x**2 + y**2 + float(w) ** 2 + float(h) ** 2)
    assert float(values["box"]) == pytest.approx(expected, rel=1e-5)
    assert float(values["cls"]) == pytest.approx(3 * ln2, rel=1e-5)
    assert float(values["obj"]) == pytest.approx(int((assignment.label != -2).sum()) * ln2, rel=1e-5)


def test_ciou_equals_torchvision() -> None:
    source = torch.Generator().manual_seed(0)
    corner = 100 * torch.rand(2, 500, 2, generator=source, dtype=torch.float64)
    boxes = torch.cat((corner, corner + 1 + 60 * torch.rand(2, 500, 2, generator=source, dtype=torch.float64)), -1)
    torch.testing.assert_close(1 - ciou(*boxes), complete_box_iou_loss(*boxes), rtol=1e-5, atol=1e-6)
    assert ciou(boxes[0], boxes[0]).min() > 1 - 1e-6
    degenerate = torch.tensor([[5.0, 5, 5, 5]], requires_grad=True)
    ciou(degenerate, torch.tensor([[0.0, 0, 9, 9]])).sum().backward()
    assert degenerate.grad is not None
    assert degenerate.grad.isfinite().all()


@pytest.mark.parametrize(
    ("label", "box"),
    [
        ([3], [[0, 0, 9, 9]]),
        ([-1], [[0, 0, 9, 9]]),
        ([0], [[9, 0, 9, 9]]),
        ([0], [[0, 0, float("nan"), 9]]),
        ([0], [[0, 0, float("inf"), 9]]),
        ([0, 1], [[0, 0, 9, 9]]),
    ],
)
def test_truth_that_cannot_be_is_one_line(label: list[int], box: list[list[float]]) -> None:
    dense = TINY.dense(torch.zeros(2, 3, 32, 32))
    with pytest.raises(ConfigError, match="truth of image 1") as caught:
        TINY.assign(dense, [truth([], []), truth(label, box)])
    assert "\n" not in str(caught.value)


def test_truth_and_assignment_must_belong_to_the_images() -> None:
    dense = TINY.dense(torch.zeros(1, 3, 32, 32))
    with pytest.raises(ConfigError, match="batch of 1"):
        TINY.assign(dense, [])
    assignment = TINY.assign(dense, [truth([], [])])
    with pytest.raises(ConfigError, match="another number or size"):
        TINY.losses(TINY.dense(torch.zeros(1, 3, 64, 32)), assignment)
