"""Scores of a target by hand: AP of it alone and of its whole class, targets lost, intervals from drives."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ssad.core.detections import Detections, Truth
from ssad.metrics.intervals import replicate_limits
from ssad.metrics.target_attacks import TargetSighting, precision, precision_replicates, sighting, target_scores

TARGET, OTHER = [10.0, 10.0, 50.0, 40.0], [100.0, 10.0, 140.0, 40.0]


def seen(
    *found: tuple[list[float], float],
    drive: str = "a",
    real: tuple[list[float], ...] = (TARGET,),
    any_class: float = 0.0,
) -> TargetSighting:
    """A picture with true boxes, the target first, and found boxes with their scores."""
    boxes = np.array([box for box, _ in found], float).reshape(-1, 4)
    scores = np.array([score for _, score in found], float)
    return TargetSighting(drive, boxes, scores, np.array(real, float), np.zeros(len(real), bool), any_class)


def test_only_boxes_of_the_targets_class_count() -> None:
    truth = Truth(
        torch.tensor([1, 0, 1]), torch.tensor([TARGET, OTHER, OTHER]), crowd=torch.tensor([False, False, True])
    )
    found = Detections(torch.tensor([0.9, 0.8]), torch.tensor([0, 1]), torch.tensor([TARGET, OTHER]))
    one = sighting("a", found, truth)
    assert one.box.tolist() == [OTHER]
    assert one.score.tolist() == pytest.approx([0.8])
    assert one.real.tolist() == [TARGET, OTHER]
    assert one.crowd.tolist() == [False, True]
    assert one.confidences().tolist() == pytest.approx([0.0, 0.8]), "the box on the target has another class"


def test_a_target_is_found_where_a_box_covers_half() -> None:
    half = [10.0, 10.0, 30.0, 40.0]
    less = [10.0, 10.0, 29.0, 40.0]
    assert seen((half, 0.6)).confidences().tolist() == pytest.approx([0.6])
    assert seen((less, 0.6)).confidences().tolist() == [0.0]
    assert seen((half, 0.7), (TARGET, 0.3)).confidences().tolist() == pytest.approx([0.7])
    assert seen().confidences().tolist() == [0.0]


def test_a_box_finds_one_car_and_a_car_is_found_once() -> None:
    """Two cars that overlap: the better box takes the car that it covers most, the other one what is left."""
    near = [32.0, 10.0, 72.0, 40.0]
    between = [20.0, 10.0, 60.0, 40.0]
    both = seen((between, 0.9), (TARGET, 0.8), (near, 0.7), real=(TARGET, near))
    assert both.confidences().tolist() == pytest.approx([0.9, 0.7]), "the second box on the target finds nothing more"
    alone = seen((between, 0.9), real=(TARGET, near))
    assert alone.confidences().tolist() == pytest.approx([0.9, 0.0]), "one box is one car"


def test_a_target_that_is_taken_for_something_else_is_not_gone() -> None:
    """A quarter of it, of any class, says that something is there; a box that finds another object does not."""
    quarter, less, beside = [10.0, 10.0, 20.0, 40.0], [10.0, 10.0, 19.0, 40.0], [30.0, 10.0, 70.0, 40.0]
    truth = Truth(torch.tensor([1, 0, 2]), torch.tensor([TARGET, OTHER, beside]))
    for box, label, best in ((quarter, 2, 0.9), (quarter, 1, 0.9), (less, 2, 0.0), (TARGET, 2, 0.9), (beside, 0, 0.0)):
        found = Detections(torch.tensor([0.9, 0.8]), torch.tensor([label, 0]), torch.tensor([box, OTHER]))
        assert sighting("a", found, truth).any_class == pytest.approx(best), (box, label)
    clean = [seen((TARGET, 0.9)) for _ in range(4)] + [seen((TARGET, 0.1))]
    attacked = [seen((TARGET, 0.3)), seen(any_class=0.8), seen((TARGET, 0.2), any_class=0.2), seen(), seen()]
    metrics = target_scores(attacked, clean)["metrics"]
    assert metrics["ASR_25"] == pytest.approx(3 / 4)
    assert metrics["ASR_any_25"] == pytest.approx(2 / 4), "one of the three is taken for something else"


def test_precision_of_the_target_alone_leaves_other_cars_out() -> None:
    """The other car is found in both pictures and the target in one; a box on nothing costs precision."""
    both = (TARGET, OTHER)
    pictures = [seen((TARGET, 0.9), (OTHER, 0.8), real=both), seen((OTHER, 0.95), real=both)]
    found = target_scores(pictures)["metrics"]
    assert found["AP50"] == pytest.approx(51 / 101, abs=1e-6), "recall of one half at full precision"
    assert found["AP50_all"] == pytest.approx(76 / 101, abs=1e-6)
    weak = [seen((TARGET, 0.9), (OTHER, 0.2), real=both), seen((OTHER, 0.95), real=both)]
    found = target_scores(weak)["metrics"]
    assert found["AP50_all"] == pytest.approx(76 / 101, abs=1e-6)
    assert found["AP50_all_25"] == pytest.approx(51 / 101, abs=1e-6), "the weak box does not count"
    wrong = [seen(([200.0, 10.0, 240.0, 40.0], 0.99), (TARGET, 0.9), real=both)]
    assert target_scores(wrong)["metrics"]["AP50"] == pytest.approx(0.5, abs=1e-6)


def test_targets_lost_are_those_that_were_found_before() -> None:
    clean = [seen((TARGET, 0.9)), seen((TARGET, 0.4)), seen((TARGET, 0.6)), seen((TARGET, 0.1))]
    attacked = [seen((TARGET, 0.3)), seen(), seen((TARGET, 0.55)), seen((TARGET, 0.9))]
    found = target_scores(attacked, clean)["metrics"]
    assert found["ASR_25"] == pytest.approx(1 / 3, abs=1e-6), "of three that were found, one is lost"
    assert found["ASR_50"] == pytest.approx(1 / 2, abs=1e-6)
    assert found["found_25"] == pytest.approx(3 / 4)
    assert found["confidence"] == pytest.approx((0.3 + 0.55 + 0.9) / 4)
    others = [seen((TARGET, 0.9), (OTHER, 0.9), real=(TARGET, OTHER))]
    gone = [seen((OTHER, 0.9), real=(TARGET, OTHER))]
    assert target_scores(gone, others)["metrics"]["ASR_all_25"] == pytest.approx(1 / 2), "of two cars one is lost"
    nothing = target_scores([seen()], [seen()])["metrics"]
    assert nothing["ASR_25"] is None, "nothing could be lost"
    assert "ASR_25" not in target_scores(clean)["metrics"]


def test_a_detector_below_the_floor_at_the_score_of_a_rate_has_none_there() -> None:
    """All clean targets are found, nine of ten above 0.25 and six above 0.5: AP50 alone would pass the floor."""
    scores = [0.9] * 6 + [0.4] * 3 + [0.1]
    clean = [seen((TARGET, score)) for score in scores]
    gone = [seen() for _ in scores]
    rates = ("ASR_25", "ASR_any_25", "ASR_all_25", "ASR_50")
    metrics = target_scores(gone, clean, floor=0.9)["metrics"]
    assert [metrics[name] for name in rates] == [1.0, 1.0, 1.0, None]
    assert [metrics[name] for name in ("n0_25", "n0_50", "n0_all_25")] == [9, 6, 9]
    strict = target_scores(gone, clean, floor=0.91)
    assert [strict["metrics"][name] for name in rates] == [None] * 4
    assert strict["metrics"]["n0_25"] == 9, "n0 says why there is no rate"
    assert not any(name in strict["intervals"] for name in rates)


def test_the_floor_of_the_whole_class_is_that_of_the_target() -> None:
    """Other cars are far away and found less often."""
    far = [200.0, 10.0, 210.0, 18.0]
    clean = [seen((TARGET, 0.9), real=(TARGET, OTHER, far)) for _ in range(4)]
    attacked = [seen(real=(TARGET, OTHER, far)), *clean[1:]]
    metrics = target_scores(attacked, clean, floor=0.9)["metrics"]
    assert (metrics["ASR_all_25"], metrics["n0_all_25"]) == (pytest.approx(1 / 4), 4)


def test_intervals_come_from_drives_and_copies_do_not_narrow_them() -> None:
    draws = np.random.default_rng(0)

    def pictures(drives: int, each: int) -> list[TargetSighting]:
        levels = draws.random(drives)
        return [seen((TARGET, float(level)), drive=str(k)) for k, level in enumerate(levels) for _ in range(each)]

    some = pictures(8, 3)
    assert "found_50" not in target_scores([one for one in some if one.drive in "0123"])["intervals"], "too few drives"
    once, often = target_scores(some), target_scores([one for one in some for _ in range(4)])
    assert once["drives"] == often["drives"] == 8
    for name in ("found_25", "found_50"):
        assert once["intervals"][name] == pytest.approx(often["intervals"][name], abs=1e-9)
        low, high = once["intervals"][name]
        assert low < once["metrics"][name] < high
    low, high = once["intervals"]["AP50"]
    assert low <= once["metrics"]["AP50"] <= high
    assert target_scores(some)["intervals"] == once["intervals"], "the draws come from the seed"


def test_attacks_on_the_same_pictures_have_the_same_draws_of_drives() -> None:
    """One attack hides the targets of a drive, another those of a second too: less is left in each draw."""
    clean = [seen((TARGET, 0.9), drive=str(k)) for k in range(6) for _ in range(4)]
    assert target_scores(clean)["replicates"]["AP50"] == [1.0] * 100
    less = [seen((TARGET, 0.9), drive=one.drive) if one.drive != "0" else seen(drive=one.drive) for one in clean]
    more = [seen((TARGET, 0.8), drive=one.drive) if one.drive not in "01" else seen(drive=one.drive) for one in clean]
    one, two = (np.array(target_scores(pictures)["replicates"]["AP50"]) for pictures in (less, more))
    assert (one >= two).all(), "in each draw both have the same drives"
    assert not target_scores(clean[:8])["replicates"], "too few drives"


def test_precision_of_drawn_drives_is_that_of_their_pictures() -> None:
    """Matched once, and drawn as pictures that are matched anew: the same, also where scores are equal."""
    draws = np.random.default_rng(0)
    pictures = []
    for _drive in range(6):
        for _ in range(4):
            boxes = [(np.array(TARGET) + draws.normal(0.0, 6.0, 4)).tolist() for _ in range(5)]
            pictures.append(seen(*((b, round(draws.random(), 1)) for b in boxes), real=(TARGET, OTHER)))
    of = np.repeat(np.arange(6, dtype=np.int32), 4)
    drawn = [draws.integers(6, size=6) for _ in range(20)]
    for target_only, least in ((True, 0.0), (False, 0.25)):
        naive = []
        for drives in drawn:
            picked = [pictures[k] for drive in drives for k in np.flatnonzero(of == drive)]
            naive.append(precision(picked, target_only=target_only, min_score=least))
        assert precision_replicates(pictures, of, drawn, target_only=target_only, min_score=least) == naive
        assert len(set(naive)) > 10


def test_a_box_on_the_neighbour_does_not_find_the_target() -> None:
    """It covers half of the target, but all of the only other object."""
    neighbour = [30.0, 10.0, 70.0, 40.0]
    truth = Truth(torch.tensor([1, 0]), torch.tensor([TARGET, neighbour]))
    found = Detections(torch.tensor([0.9]), torch.tensor([2]), torch.tensor([neighbour]))
    assert sighting("a", found, truth).any_class == 0.0
    alone = Truth(torch.tensor([1]), torch.tensor([TARGET]))
    assert sighting("a", found, alone).any_class == pytest.approx(0.9)


def test_the_interval_of_ap_is_that_of_its_replicates() -> None:
    pictures = [
        seen(
            (TARGET, 0.5 + 0.05 * k),
            (OTHER, 0.3 + 0.07 * k),
            drive=str(k),
            real=(TARGET,) if k % 3 else (TARGET, OTHER),
        )
        for k in range(7)
    ]
    scores = target_scores(pictures)
    for name in ("AP50", "AP50_all"):
        variance = np.var(scores["replicates"][name], ddof=1)
        limits = replicate_limits(np.asarray(scores["metrics"][name]), np.asarray(variance), 7, bounded=True)
        assert scores["intervals"][name] == pytest.approx([float(limit) for limit in limits], abs=1e-4)


def test_a_target_found_at_the_threshold_could_not_be_lost() -> None:
    clean = [seen((TARGET, 0.25)), seen((TARGET, 0.26))]
    metrics = target_scores([seen(), seen((TARGET, 0.9))], clean)["metrics"]
    assert [metrics[name] for name in ("ASR_25", "ASR_any_25", "ASR_all_25")] == [0.0, 0.0, 0.0]


def test_drives_with_nothing_to_count_are_drawn_too() -> None:
    """The true boxes of the last drives are of crowds: they add false boxes to a draw, and nothing to find."""
    crowd = np.ones(1, np.bool_)
    pictures = [seen((TARGET, 0.9 - 0.1 * k), (OTHER, 0.95), drive=str(k)) for k in range(3)]
    pictures += [
        TargetSighting(str(k), np.array([OTHER]), np.array([0.99]), np.array([TARGET]), crowd) for k in range(3, 6)
    ]
    drive_draws = [np.array([5, 0, 1, 2, 3, 4]), np.array([0, 0, 5, 5, 4, 1])]
    drawn_scores = [precision([pictures[k] for k in draw], target_only=False, min_score=0.0) for draw in drive_draws]
    drives = np.arange(6, dtype=np.int32)
    assert precision_replicates(pictures, drives, drive_draws, target_only=False, min_score=0.0) == drawn_scores


@pytest.mark.parametrize(("score", "found"), [(0.25, 0.0), (0.2501, 1.0)])
def test_a_target_is_found_above_the_threshold(score: float, found: float) -> None:
    assert target_scores([seen((TARGET, score))])["metrics"]["found_25"] == found


def test_a_score_at_the_threshold_is_lost() -> None:
    clean, attacked = [seen((TARGET, 0.9), (OTHER, 0.9), real=(TARGET, OTHER))], [seen((TARGET, 0.25), (OTHER, 0.26))]
    attacked = [seen((TARGET, 0.25), (OTHER, 0.26), real=(TARGET, OTHER))]
    assert target_scores(attacked, clean)["metrics"]["ASR_all_25"] == 1 / 2


def test_boxes_that_share_no_area_do_not_overlap() -> None:
    """A true box of a thousandth of a pixel: a box elsewhere covers nothing of it."""
    dot = [10.0, 10.0, 10.03, 10.03]
    found = Detections(torch.tensor([0.9]), torch.tensor([2]), torch.tensor([OTHER]))
    assert sighting("a", found, Truth(torch.tensor([1]), torch.tensor([dot]))).any_class == 0.0


def test_five_drives_are_enough_for_an_interval() -> None:
    pictures = [seen((TARGET, 0.4 + 0.1 * k), drive=str(k)) for k in range(5)]
    assert set(target_scores(pictures)["intervals"]) >= {"AP50", "found_50"}
    assert target_scores(pictures)["intervals"]["AP50"]
    assert target_scores(pictures)["intervals"]["found_50"]
    few = target_scores(pictures[:4])["intervals"]
    assert few.get("AP50") is None
    assert few.get("found_50") is None
