"""2D average precision: equal to pycocotools on random sets, and by hand."""

import contextlib
import io
from typing import Any

import numpy as np
import pytest
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from ssad.core.seeding import generator
from ssad.metrics.detection2d import Boxes2D, average_precision, match_2d


def coco_ap(truth: Boxes2D, found: Boxes2D, labels: int, threshold: float, most: int) -> np.ndarray:
    """AP of each label by pycocotools, NaN without ground truth."""
    assert truth.ignore is not None
    assert found.score is not None
    images = range(int(max(truth.image.max(initial=0), found.image.max(initial=0))) + 1)

    def xywh(box: np.ndarray) -> list[float]:
        return [float(box[0]), float(box[1]), float(box[2] - box[0]), float(box[3] - box[1])]

    def entry(i: int, boxes: Boxes2D) -> dict[str, Any]:
        box = xywh(boxes.box[i])
        place = {"id": i + 1, "image_id": int(boxes.image[i]), "category_id": int(boxes.label[i]), "bbox": box}
        return place | {"area": box[2] * box[3], "iscrowd": 0}

    data = COCO()
    data.dataset = {
        "images": [{"id": i} for i in images],
        "categories": [{"id": c} for c in range(labels)],
        "annotations": [entry(i, truth) | {"iscrowd": int(truth.ignore[i])} for i in range(len(truth.image))],
    }
    detections = COCO()
    scores = found.score.tolist()
    detections.dataset = data.dataset | {
        "annotations": [entry(i, found) | {"score": scores[i]} for i in range(len(found.image))]
    }
    with contextlib.redirect_stdout(io.StringIO()):
        data.createIndex()
        detections.createIndex()
        judge = COCOeval(data, detections, "bbox")
        judge.params.iouThrs = np.array([threshold])
        judge.params.maxDets = [most]
        judge.params.areaRng, judge.params.areaRngLbl = [[0, 1e10]], ["all"]
        judge.evaluate()
        judge.accumulate()
    precision = judge.eval["precision"][0, :, :, 0, 0]
    return np.where((precision < 0).all(axis=0), np.nan, precision.mean(axis=0))


def random_set(key: int, *, grid: float, levels: int, labels: int) -> tuple[Boxes2D, Boxes2D]:
    """Crowded images: many overlaps, ties of score and of IoU."""
    random = generator("2d", key)
    images = 4

    def boxes(n: int) -> tuple[np.ndarray, ...]:
        corner = np.round(random.uniform(0, 30, (n, 2)) / grid) * grid
        size = np.round(random.uniform(4, 20, (n, 2)) / grid) * grid
        image, label = random.integers(0, images, n), random.integers(0, labels, n)
        return image.astype(np.int32), label.astype(np.int32), np.hstack([corner, corner + size])

    real = boxes(int(random.integers(0, 40)))
    truth = Boxes2D(*real, ignore=random.random(len(real[0])) < 0.2)
    n = int(random.integers(0, 150))
    image, label, box = boxes(n)
    near = (random.random(n) < 0.6) & (len(real[0]) > 0)
    if near.any():
        pick = random.integers(0, len(real[0]), int(near.sum()))
        image[near], label[near] = real[0][pick], real[1][pick]
        box[near] = real[2][pick] + np.round(random.normal(0, 2, (len(pick), 4)) / grid) * grid
        box[:, 2:] = np.maximum(box[:, 2:], box[:, :2] + grid)
    score = np.round(random.random(n) * levels) / levels
    return truth, Boxes2D(image, label, box, score)


@pytest.mark.parametrize("key", range(40))
def test_equals_pycocotools(key: int) -> None:
    truth, found = random_set(key, grid=(1.0, 0.25, 2.0)[key % 3], levels=(5, 1000, 2)[key // 3 % 3], labels=3)
    for threshold, most in ((0.5, 100), (0.75, 100), (0.5, 3)):
        ours = average_precision(truth, found, labels=3, threshold=threshold, max_detections=most)
        np.testing.assert_allclose(ours, coco_ap(truth, found, 3, threshold, most), rtol=0, atol=1e-12)


def one(image: list[int], box: list[list[float]], score: list[float] | None = None, **more: Any) -> Boxes2D:
    zeros = np.zeros(len(image), np.int32)
    scores = None if score is None else np.array(score)
    return Boxes2D(np.array(image, np.int32), zeros, np.array(box, float).reshape(-1, 4), scores, **more)


A, B, FAR = [0, 0, 10, 10], [20, 0, 30, 10], [50, 50, 60, 60]


def test_by_hand() -> None:
    truth = one([0, 0], [A, B])
    assert average_precision(truth, one([0, 0], [A, B], [0.9, 0.8]), labels=1)[0] == pytest.approx(1.0)
    # a false one between two right ones: precision 1 up to recall 0.5, then 2/3
    found = one([0, 0, 0], [A, FAR, B], [0.9, 0.8, 0.7])
    assert average_precision(truth, found, labels=1)[0] == pytest.approx((51 + 50 * 2 / 3) / 101)


def test_the_second_detection_of_a_box_is_wrong_and_one_in_a_crowd_is_not() -> None:
    found = one([0, 0], [A, A], [0.9, 0.8])
    assert match_2d(one([0], [A]), found, labels=1).hit.tolist() == [True, False]
    crowd = one([0, 0], [A, A], ignore=np.array([False, True]))
    matched = match_2d(crowd, found, labels=1)
    assert matched.hit.tolist() == [True, False]
    assert matched.ignored.tolist() == [False, True]
    assert matched.average_precision()[0] == pytest.approx(1.0)


def test_other_images_and_labels_do_not_match() -> None:
    found = one([1], [A], [0.9])
    assert average_precision(one([0], [A]), found, labels=2)[0] == 0.0
    assert np.isnan(average_precision(one([0], [A]), found, labels=2)[1])
    other = Boxes2D(np.array([0]), np.array([1]), np.array([A], float), np.array([0.5]))
    assert average_precision(one([0], [A]), other, labels=2)[0] == 0.0


def test_nothing_at_all() -> None:
    none = one([], [], [])
    assert average_precision(one([0], [A]), none, labels=1)[0] == 0.0
    assert np.isnan(average_precision(one([], []), none, labels=1)[0])
    assert np.isnan(average_precision(one([], []), one([0], [A], [0.5]), labels=1)[0])
    with pytest.raises(ValueError, match="scores"):
        match_2d(one([0], [A]), one([0], [A]), labels=1)


@pytest.mark.parametrize(("side", "threshold", "hit"), [(5.0, 0.5, True), (4.99, 0.5, False), (5.0, 0.51, False)])
def test_an_overlap_at_the_threshold_counts(side: float, threshold: float, hit: bool) -> None:
    found = one([0], [[0, 0, 10, side]], [0.5])
    assert match_2d(one([0], [A]), found, labels=1, threshold=threshold).hit.tolist() == [hit]


@pytest.mark.parametrize(("off", "hit"), [(0.0, True), (5e-10, True), (5e-9, False)])
def test_a_threshold_of_1_leaves_room_for_rounding(off: float, hit: bool) -> None:
    found = one([0], [[0, 0, 10, 10 + off]], [0.5])
    assert match_2d(one([0], [A]), found, labels=1, threshold=1.0).hit.tolist() == [hit]


def test_boxes_that_touch_do_not_overlap() -> None:
    for box in ([10, 0, 20, 10], [0, 10, 10, 20], [-5, -5, 0, 0], [20, 20, 30, 30]):
        assert not match_2d(one([0], [A]), one([0], [box], [0.5]), labels=1, threshold=0.0 + 1e-12).hit.any()
    assert match_2d(one([0], [A]), one([0], [[9, 9, 19, 19]], [0.5]), labels=1, threshold=1 / 199).hit.all()


def test_the_best_so_many_of_an_image_count() -> None:
    truth = one([0, 1], [A, A])
    found = one([0, 0, 0, 1], [FAR, FAR, A, A], [0.9, 0.8, 0.7, 0.6])
    for most, hits in ((1, [False, True]), (2, [False, False, True]), (3, [False, False, True, True])):
        assert match_2d(truth, found, labels=1, max_detections=most).hit.tolist() == hits


def test_boxes_without_an_area_overlap_nothing() -> None:
    point = [5.0, 5.0, 5.0, 5.0]
    matched = match_2d(one([0], [point]), one([0], [point], [0.5]), labels=1)
    assert matched.hit.tolist() == [False]
    assert average_precision(one([0], [point]), one([0], [point], [0.5]), labels=1)[0] == 0.0
