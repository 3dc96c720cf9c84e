"""nuScenes detection scores: against a slow transcription of the rules, by hand, and under weights of the samples."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ssad.core.errors import FormatError
from ssad.core.nuscenes_names import CLASSES
from ssad.core.seeding import generator
from ssad.metrics.detection import (
    CVPR_2019,
    BikeRacks,
    BoxTable,
    DetectionConfig,
    DetectionScores,
    check_counts,
    filter_boxes,
    keep_boxes,
    match,
    scene_intervals,
)
from ssad.metrics.detection_match import pairs_of

CAR, PEDESTRIAN, BICYCLE, CONE, BARRIER = (
    CLASSES.index(name) for name in ("car", "pedestrian", "bicycle", "traffic_cone", "barrier")
)


def boxes(rows: list[tuple[Any, ...]], **columns: Any) -> BoxTable:
    """A table of (sample, label, x, y[, score]) rows; the rest is alike unless given."""
    n = len(rows)
    x, y = ([float(row[i]) for row in rows] for i in (2, 3))
    table = replace(
        BoxTable.empty(n),
        sample=np.array([row[0] for row in rows], np.int32),
        label=np.array([row[1] for row in rows], np.int8),
        centre=np.stack([x, y, np.zeros(n)], axis=-1) if n else np.zeros((0, 3)),
        size_lwh=np.tile([4.0, 2.0, 1.5], (n, 1)),
        rotation=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        velocity=np.zeros((n, 2)),
        score=np.array([row[4] if len(row) > 4 else -1.0 for row in rows], np.float64),
        ego_distance=np.hypot(x, y) if n else np.zeros(0),
    )
    return replace(table, **columns)


def score_detections(truth: BoxTable, found: BoxTable, samples: int) -> DetectionScores:
    return match(truth, found, samples=samples).scores()


def random_tables(key: int, *, samples: int = 6, grid: float = 0.0, levels: int = 0) -> tuple[BoxTable, BoxTable]:
    """Truth and predictions near each other; a grid and few levels of scores make ties."""
    random = generator("detection test", key)
    truth, found = [], []
    for sample in range(samples):
        for _ in range(int(random.integers(0, 12))):
            label = int(random.choice([CAR, PEDESTRIAN, BARRIER]))
            place = random.uniform(-8.0, 8.0, 2)
            place = np.round(place / grid) * grid if grid else place
            truth.append((sample, label, *place))
            for _ in range(int(random.integers(0, 3))):
                near = place + random.normal(0.0, 1.0, 2)
                near = np.round(near / grid) * grid if grid else near
                score = int(random.integers(1, levels + 1)) / 10 if levels else random.random()
                found.append((sample, label, *near, score))
    real, predicted = boxes(truth), boxes(found)
    n = len(predicted)
    attribute = random.integers(-1, 2, len(real)).astype(np.int8)
    real = replace(real, velocity=np.where(random.random((len(real), 2)) < 0.2, np.nan, 1.0), attribute=attribute)
    yaw = random.uniform(-4.0, 4.0, n) / 2
    zero = np.zeros(n)
    return real, replace(
        predicted,
        rotation=np.stack([np.cos(yaw), zero, zero, np.sin(yaw)], axis=-1),
        size_lwh=predicted.size_lwh * random.uniform(0.5, 2.0, (n, 3)),
        velocity=random.normal(0.0, 1.0, (n, 2)),
        attribute=random.integers(-1, 2, n).astype(np.int8),
    )


def greedy(truth: BoxTable, found: BoxTable, label: int, threshold: float) -> list[tuple[int, int]]:
    """(prediction, box) pairs by the rule itself, one box after the other."""
    own = [i for i in range(len(found)) if found.label[i] == label]
    own = [i for _, i in sorted((float(found.score[i]), i) for i in own)][::-1]
    taken: set[int] = set()
    pairs = []
    for i in own:
        best, pick = math.inf, None
        for g in range(len(truth)):
            if truth.label[g] == label and truth.sample[g] == found.sample[i] and g not in taken:
                distance = float(np.linalg.norm(found.centre[i, :2] - truth.centre[g, :2]))
                if distance < best:
                    best, pick = distance, g
        if best < threshold and pick is not None:
            taken.add(pick)
            pairs.append((i, pick))
    return pairs


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([0.0, 0.5, 1.0]), st.sampled_from([0, 1, 3]))
def test_matches_are_those_of_the_greedy_rule(key: int, grid: float, levels: int) -> None:
    truth, found = random_tables(key, grid=grid, levels=levels)
    matches = match(truth, found, samples=6)
    for label in (CAR, PEDESTRIAN, BARRIER):
        own = np.flatnonzero(found.label == label)
        rank = own[np.argsort(found.score[own], kind="stable")[::-1]]
        for threshold, hits in zip(CVPR_2019.dist_ths, matches.classes[label].hits, strict=True):
            pairs = greedy(truth, found, label, threshold)
            assert rank[hits].tolist() == [i for i, _ in pairs]
        pairs = greedy(truth, found, label, CVPR_2019.dist_th_tp)
        expected = [float(np.linalg.norm(found.centre[i, :2] - truth.centre[g, :2])) for i, g in pairs]
        np.testing.assert_allclose(matches.classes[label].errors[0], expected, rtol=1e-14, atol=0)


def repeated(table: BoxTable, weights: np.ndarray) -> BoxTable:
    """Each sample as often as its weight says, its copies one after the other."""
    first = np.cumsum(weights) - weights
    rows, sample = [], []
    for s, weight in enumerate(weights.tolist()):
        own = np.flatnonzero(table.sample == s)
        for copy in range(weight):
            rows.append(own)
            sample.append(np.full(len(own), first[s] + copy))
    index = np.concatenate([*rows, np.zeros(0, np.int64)]).astype(np.int64)
    return replace(table.take(index), sample=np.concatenate([*sample, np.zeros(0)]).astype(np.int32))


@settings(max_examples=40, deadline=None)
@given(
    st.integers(0, 10**6),
    st.lists(st.integers(0, 3), min_size=6, max_size=6),
    st.sampled_from([(0.0, 0), (0.5, 2), (0.5, 1)]),
)
def test_weights_are_repeated_samples(key: int, times: list[int], ties: tuple[float, int]) -> None:
    truth, found = random_tables(key, grid=ties[0], levels=ties[1])
    weights = np.array(times)
    ours = match(truth, found, samples=6).scores(weights)
    other = score_detections(repeated(truth, weights), repeated(found, weights), samples=max(int(weights.sum()), 1))
    np.testing.assert_allclose(ours.ap, other.ap, rtol=0, atol=1e-12)
    np.testing.assert_allclose(ours.errors, other.errors, rtol=0, atol=1e-12)
    assert ours.truth.tolist() == other.truth.tolist()
    assert ours.predictions.tolist() == other.predictions.tolist()


@given(st.integers(0, 10**6))
@settings(max_examples=20, deadline=None)
def test_invariants(key: int) -> None:
    truth, found = random_tables(key)
    scores = score_detections(truth, found, samples=6)
    ones = match(truth, found, samples=6).scores(np.ones(6, np.int64))
    assert np.array_equal(scores.ap, ones.ap)
    assert np.array_equal(scores.errors, ones.errors, equal_nan=True)
    squeezed = score_detections(truth, replace(found, score=found.score**2), samples=6)
    np.testing.assert_allclose(scores.ap, squeezed.ap, atol=1e-12)  # only the order of scores counts
    order = np.array([3, 1, 5, 0, 2, 4], np.int32)
    moved = score_detections(
        replace(truth, sample=order[truth.sample]), replace(found, sample=order[found.sample]), samples=6
    )
    np.testing.assert_allclose(scores.ap, moved.ap, atol=1e-12)
    assert 0.0 <= scores.mean_ap <= 1.0
    assert 0.0 <= scores.nd_score <= 1.0


def test_perfect_predictions() -> None:
    rows = [(s, label, 3.0 * label, 2.0) for s in range(3) for label in range(10)]
    truth = boxes(rows, attribute=np.zeros(30, np.int8))
    found = replace(truth, score=np.full(30, 0.5))
    scores = score_detections(truth, found, samples=3)
    assert scores.mean_ap == pytest.approx(1.0)
    assert scores.nd_score == pytest.approx(1.0)
    assert all(error == 0.0 for error in scores.tp_errors.values())
    assert math.isnan(scores.label_tp_errors["traffic_cone"]["orient_err"])
    assert scores.truth.tolist() == [3] * 10


def test_nothing_found_and_nothing_there() -> None:
    truth = boxes([(0, CAR, 1.0, 1.0)])
    for real, found in ((truth, BoxTable.empty()), (BoxTable.empty(), truth), (BoxTable.empty(), BoxTable.empty())):
        scores = score_detections(real, found, samples=1)
        assert scores.mean_ap == 0.0
        assert scores.nd_score == 0.0
        assert set(scores.tp_errors.values()) == {1.0}


def test_a_distance_at_the_threshold_is_no_match() -> None:
    truth = boxes([(0, CAR, 0.0, 0.0)])
    scores = score_detections(truth, boxes([(0, CAR, 1.0, 0.0, 0.9)]), samples=1)
    assert scores.label_aps["car"] == {"0.5": 0.0, "1.0": 0.0, "2.0": pytest.approx(1.0), "4.0": pytest.approx(1.0)}


def test_a_barrier_has_no_front() -> None:
    turned = np.tile([0.0, 0.0, 0.0, 1.0], (2, 1))
    truth = boxes([(0, CAR, 0.0, 0.0), (0, BARRIER, 5.0, 0.0)])
    found = boxes([(0, CAR, 0.0, 0.0, 0.9), (0, BARRIER, 5.0, 0.0, 0.9)], rotation=turned)
    errors = score_detections(truth, found, samples=1).label_tp_errors
    assert errors["car"]["orient_err"] == pytest.approx(math.pi)
    assert errors["barrier"]["orient_err"] == pytest.approx(0.0)


def test_range_is_strict_and_by_class() -> None:
    table = boxes([(0, CAR, 50.0, 0.0), (0, CAR, 49.9, 0.0), (0, PEDESTRIAN, 45.0, 0.0), (0, CONE, 29.0, 0.0)])
    assert keep_boxes(table).tolist() == [False, True, False, True]


def test_empty_boxes_are_left_out() -> None:
    table = boxes([(0, CAR, 1.0, 0.0)] * 3)
    assert keep_boxes(table, points=np.array([0, 1, -1])).tolist() == [False, True, True]


def test_racks_take_the_cycles_of_their_sample() -> None:
    turn = math.radians(90.0) / 2
    racks = BikeRacks(
        sample=np.array([1, 0], np.int32),
        centre=np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]]),
        size_lwh=np.array([[6.0, 2.0, 2.0], [6.0, 2.0, 2.0]]),
        velocity=np.zeros((2, 2)),
        rotation=np.array([[1.0, 0.0, 0.0, 0.0], [math.cos(turn), 0.0, 0.0, math.sin(turn)]]),
    )
    rows = [
        (0, BICYCLE, 0.0, 0.0),  # the rack there is of sample 1
        (0, BICYCLE, 10.0, 2.9),  # turned: long in y
        (0, BICYCLE, 12.9, 0.0),
        (0, CAR, 10.0, 0.0),
        (1, BICYCLE, 3.0, 1.0),  # a corner, which counts as inside
        (1, BICYCLE, 3.01, 0.0),
    ]
    assert keep_boxes(boxes(rows), racks=racks).tolist() == [True, False, True, True, False, True]
    assert len(filter_boxes(boxes(rows), racks=racks)) == 4


def test_too_many_boxes_name_the_sample() -> None:
    table = boxes([(1, CAR, 0.0, 0.0, 0.5)] * 501)
    with pytest.raises(FormatError, match="sample b: 501 boxes"):
        check_counts(table, names=["a", "b"])
    with pytest.raises(FormatError, match="sample 1: 501 boxes"):
        match(BoxTable.empty(), table, samples=2)
    check_counts(table.take(np.arange(500)))


def test_a_flat_box_is_refused_where_it_matches() -> None:
    truth = boxes([(0, CAR, 0.0, 0.0)])
    flat = boxes([(0, CAR, 0.0, 0.0, 0.5)], size_lwh=np.array([[0.0, 1.0, 1.0]]))
    with pytest.raises(FormatError, match="sample s: a prediction box"):
        match(truth, flat, samples=1, names=["s"])
    away = replace(flat, centre=flat.centre + 30.0)
    assert match(truth, away, samples=1).scores().mean_ap == 0.0


def test_negative_scores_are_refused() -> None:
    truth = boxes([(0, CAR, 0.0, 0.0), (0, CAR, 9.0, 0.0)])
    with pytest.raises(FormatError, match="class car: scores below 0"):
        score_detections(truth, boxes([(0, CAR, 0.0, 0.0, -2.0)]), samples=1)


def test_weights_must_fit() -> None:
    matches = match(*random_tables(1), samples=6)
    for wrong in (np.ones(5, np.int64), np.array([1, 1, 1, 1, 1, -1])):
        with pytest.raises(ValueError, match="weights"):
            matches.scores(wrong)


def test_intervals_over_scenes() -> None:
    truth, found = random_tables(5, samples=40)
    matches = match(truth, found, samples=40)
    scene = np.repeat(np.arange(10), 4)
    limits = scene_intervals(matches, scene, generator=generator("s"), replicates=60)
    assert limits == scene_intervals(matches, scene, generator=generator("s"), replicates=60)
    scores = matches.scores()
    assert limits["mean_ap"][0] < scores.mean_ap < limits["mean_ap"][1]
    assert limits["nd_score"][0] < limits["nd_score"][1]
    few = scene_intervals(matches, scene % 4, generator=generator("s"))
    assert all(math.isnan(v) for pair in few.values() for v in pair)


def test_the_settings_are_the_official_ones() -> None:
    assert CVPR_2019.classes == CLASSES
    assert CVPR_2019.serialize()["class_range"]["pedestrian"] == 40
    assert DetectionConfig() == CVPR_2019
    summary = score_detections(*random_tables(2), samples=6).summary()
    keys = ["label_aps", "mean_dist_aps", "mean_ap", "label_tp_errors", "tp_errors", "tp_scores", "nd_score", "cfg"]
    assert list(summary) == keys
    full = score_detections(*random_tables(2), samples=6).summary(eval_time=1.0, meta={"use_lidar": True})
    assert set(full) - set(keys) == {"eval_time", "meta"}


def test_scores_below_0_are_fine_where_the_recall_is_complete() -> None:
    truth = boxes([(0, CAR, 0.0, 0.0), (0, CAR, 9.0, 0.0)])
    found = boxes([(0, CAR, 0.0, 0.0, -0.5), (0, CAR, 9.0, 0.0, -2.0)])
    assert score_detections(truth, found, samples=1).label_aps["car"]["0.5"] == pytest.approx(1.0)
    # one of them is found at 4 m alone: that curve ends before the others do
    away = boxes([(0, CAR, 0.0, 0.0, -0.5), (0, CAR, 12.0, 0.0, -2.0)])
    with pytest.raises(FormatError, match=r"class car: scores below 0 cannot be evaluated; scale them to 0 \.\. 1"):
        score_detections(truth, away, samples=1)
    mixed = boxes([(0, CAR, 0.0, 0.0, 0.5), (0, CAR, 12.0, 0.0, 0.0)])
    assert score_detections(truth, mixed, samples=1).label_aps["car"]["4.0"] == pytest.approx(1.0)


def curve(hits: list[int], truth: int, config: DetectionConfig = CVPR_2019) -> float:
    """AP of predictions from best to worst, of which the i-th is a hit or not."""
    right = np.cumsum(hits)
    precision = np.interp(np.linspace(0, 1, 101), right / truth, right / np.arange(1, len(hits) + 1), right=0)
    least = int(100 * config.min_recall) + 1
    above = np.maximum(precision[least:] - config.min_precision, 0.0)
    return float(above.mean() / (1.0 - config.min_precision))


@pytest.mark.parametrize(
    "hits", [[1, 0, 1], [0, 1, 1], [0, 0, 0, 1], [1, 1, 0, 0, 0], [1, 0, 0, 0, 1, 0, 1, 1, 0], [0, 1, 0]]
)
@pytest.mark.parametrize("settings_", [{}, {"min_recall": 0.3, "min_precision": 0.4}])
def test_average_precision_of_a_curve(hits: list[int], settings_: dict[str, float]) -> None:
    config = DetectionConfig(dist_ths=(1.0, 2.0), **settings_)  # type: ignore[arg-type]
    truth = boxes([(0, CAR, 10.0 * k, 0.0) for k in range(5)])
    places = iter(range(5))
    rows = [(0, CAR, 10.0 * next(places) if hit else 500.0, 0.0, 1.0 - 0.1 * i) for i, hit in enumerate(hits)]
    scores = match(truth, boxes(rows), samples=1, config=config).scores()
    for threshold in ("1.0", "2.0"):
        assert scores.label_aps["car"][threshold] == pytest.approx(curve(hits, 5, config))
    assert scores.mean_dist_aps["car"] == pytest.approx(curve(hits, 5, config))
    assert scores.mean_ap == pytest.approx(curve(hits, 5, config) / 10)
    assert (scores.truth[CAR], scores.predictions[CAR]) == (5, len(hits))
    assert list(scores.label_aps["car"]) == ["1.0", "2.0"]


def test_errors_of_matched_boxes_by_hand() -> None:
    truth = boxes([(0, CAR, 0.0, 0.0)], velocity=np.array([[3.0, 0.0]]), attribute=np.array([1], np.int8))
    turn = math.radians(30.0) / 2
    found = boxes(
        [(0, CAR, 0.6, 0.8, 0.5)],
        size_lwh=np.array([[2.0, 4.0, 1.5]]),
        rotation=np.array([[math.cos(turn), 0.0, 0.0, math.sin(turn)]]),
        velocity=np.array([[0.0, 4.0]]),
        attribute=np.array([2], np.int8),
    )
    scores = score_detections(truth, found, samples=1)
    # 2 x 2 x 1.5 of the sizes are shared
    expected = {"trans_err": 1.0, "scale_err": 1 - 6 / 18, "orient_err": math.pi / 6, "vel_err": 5.0, "attr_err": 1.0}
    assert scores.label_tp_errors["car"] == pytest.approx(expected)
    other = {name: (error + 9.0) / 10 for name, error in expected.items()}
    # classes without ground truth count as 1, those for which an error means nothing do not count
    other |= {"orient_err": (math.pi / 6 + 8) / 9, "vel_err": (5.0 + 7) / 8, "attr_err": 1.0}
    assert scores.tp_errors == pytest.approx(other)
    assert scores.tp_scores["vel_err"] == 0.0
    assert scores.nd_score == pytest.approx((5 * scores.mean_ap + sum(scores.tp_scores.values())) / 10)


def test_an_error_is_averaged_up_to_the_recall_that_was_reached() -> None:
    truth = boxes([(0, CAR, 10.0 * k, 0.0) for k in range(4)], attribute=np.zeros(4, np.int8))
    # three found, off by 0, 1 and 0.5 m in the order of their scores
    found = boxes([(0, CAR, 0.0, 0.0, 0.9), (0, CAR, 11.0, 0.0, 0.8), (0, CAR, 20.5, 0.0, 0.7)])
    error = score_detections(truth, found, samples=1).label_tp_errors["car"]["trans_err"]
    recall = np.arange(11, 76) / 100
    confidence = np.interp(recall, [0.25, 0.5, 0.75], [0.9, 0.8, 0.7])
    means = np.interp(-confidence, [-0.9, -0.8, -0.7], [0.0, 0.5, 0.5])
    assert error == pytest.approx(means.mean())
    # where too little is found, every error is 1
    few = boxes([(0, CAR, 10.0 * k, 0.0) for k in range(20)])
    assert score_detections(few, found.take(np.arange(1)), samples=1).label_tp_errors["car"]["trans_err"] == 1.0


@pytest.mark.parametrize("most", [1, 3, 7, 1000])
def test_pairs_come_in_parts(most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ssad.metrics.detection_match.PAIRS", most)
    count, start = np.array([2, 0, 3, 1, 0, 4]), np.array([5, 0, 1, 9, 3, 2])
    parts = [(pred.tolist(), box.tolist()) for pred, box in pairs_of(count, start)]
    whole = [(i, int(start[i]) + k) for i in range(6) for k in range(count[i])]
    assert [pair for pred, box in parts for pair in zip(pred, box, strict=True)] == whole
    assert all(len(pred) <= max(most, 4) for pred, _ in parts)
    assert len(parts) <= {1: 6, 3: 4, 7: 2, 1000: 1}[most]


def test_the_settings_as_the_devkit_writes_them() -> None:
    assert CVPR_2019.serialize() == {
        "class_range": {
            "car": 50,
            "truck": 50,
            "bus": 50,
            "trailer": 50,
            "construction_vehicle": 50,
            "pedestrian": 40,
            "motorcycle": 40,
            "bicycle": 40,
            "traffic_cone": 30,
            "barrier": 30,
        },
        "dist_fcn": "center_distance",
        "dist_ths": [0.5, 1.0, 2.0, 4.0],
        "dist_th_tp": 2.0,
        "min_recall": 0.1,
        "min_precision": 0.1,
        "max_boxes_per_sample": 500,
        "mean_ap_weight": 5,
    }
    found = DetectionConfig(class_range={"car": 12.5, "bus": 8.0}).serialize()["class_range"]
    assert found == {"car": 12.5, "bus": 8}
    assert [type(v) for v in found.values()] == [float, int]


def test_an_empty_table_knows_nothing() -> None:
    table = BoxTable.empty(2)
    assert (table.attribute.tolist(), table.score.tolist()) == ([-1, -1], [-1.0, -1.0])
    assert np.isnan(table.velocity).all()
    assert np.isnan(table.ego_distance).all()
    assert len(BoxTable.empty()) == 0
    assert not table.centre.any()


@pytest.mark.parametrize("side", [0, 1, 2])
@pytest.mark.parametrize("what", ["prediction", "ground truth"])
def test_a_box_without_one_of_its_sides_is_named(side: int, what: str) -> None:
    size = np.tile([4.0, 2.0, 1.5], (2, 1))
    size[1, side] = 0.0
    rows = [(0, CAR, 0.0, 0.0, 0.5), (1, CAR, 9.0, 0.0, 0.5)]
    good, flat = boxes(rows), boxes(rows, size_lwh=size)
    pair = (good, flat) if what == "prediction" else (flat, good)
    with pytest.raises(
        FormatError, match=rf"sample 1: a {what} box has the size \[.*0\.0.*\]; all sides must be positive"
    ):
        match(*pair, samples=2)
    # not only where errors are taken: 3 m apart
    with pytest.raises(FormatError, match="sample b"):
        match(pair[0], replace(pair[1], centre=pair[1].centre + np.array([3.0, 0.0, 0.0])), samples=2, names=["a", "b"])
