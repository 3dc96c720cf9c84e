"""Tables: denominators, failed episodes, copies, groups and their average, the document."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.metric_traces import make_trace
from hypothesis import given, settings
from hypothesis import strategies as st

from ssad.metrics import METRICS, EpisodeOutcome, aggregate, aggregate_groups, episode_metrics, overall_score
from ssad.metrics.intervals import share_limits

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "reference" / "metrics.md"


def episode(hit: bool = False, complete: float = 100.0, distance: float = 0.0, steps: int = 11):
    """Metrics of a small episode."""
    contact = np.zeros(steps)
    contact[-1] = hit
    return episode_metrics(
        make_trace(steps, contact=contact, route_complete=complete, route_distance=distance, driven=np.arange(steps))
    )


def outcomes(episodes, group="g", family="other"):
    """Each episode a case and cluster of its own."""
    return [EpisodeOutcome(e, group, f"{group}{k}", f"{group}{k}", family) for k, e in enumerate(episodes)]


def test_failed_episodes_are_in_the_limits_and_in_no_mean():
    ran = [episode(hit=True, complete=50, distance=2), *[episode(distance=1)] * 9]
    result = aggregate(outcomes([*ran, None, None]))
    assert result["CR"].mean == pytest.approx(1 / 10)
    assert result["CR"].low == share_limits(1 / 12, 12)[0]
    assert result["CR"].high == share_limits(3 / 12, 12)[1]
    assert (result["CR"].n, result["CR"].failed, result["CR"].clusters) == (10, 2, 10)
    assert result["RC"].mean == pytest.approx(9.5 / 10)
    assert result["RC"].low < 9.5 / 12 < 11.5 / 12 < result["RC"].high
    assert (result["DR"].mean, result["DR"].n, result["DR"].failed) == (pytest.approx(11 / 10), 10, 2)
    assert (result["DS"].n, result["DS"].failed) == (10, 2)


@pytest.mark.parametrize(("routes", "method"), [(9, "range"), (10, "beta")])
def test_a_town_of_fewer_than_ten_routes_has_a_range_and_no_interval(routes, method):
    two_drives_each = [
        EpisodeOutcome(episode(hit=k < 3), "Town02", f"Town02 {k // 2}", f"{k}", "natural") for k in range(2 * routes)
    ]
    cr = aggregate(two_drives_each)["CR"]
    assert (cr.method, cr.clusters, cr.n) == (method, routes, 2 * routes)
    assert ((cr.low, cr.high) == (0.0, 1.0)) == (method == "range")


def test_empty_and_all_failed():
    empty = aggregate([])
    assert set(empty) == set(METRICS)
    assert all(math.isnan(e.mean) and e.n == 0 for e in empty.values())
    failed = aggregate(outcomes([None, None]))
    for estimate in failed.values():
        assert (estimate.n, estimate.failed) == (0, 2)
        assert all(math.isnan(number) for number in (estimate.mean, estimate.low, estimate.high))


def test_overall_score_of_means():
    several = [episode(hit=k % 3 == 0, complete=50 + 5 * k, distance=0.3 * k, steps=20 + k) for k in range(10)]
    result = aggregate(outcomes(several))
    means = {name: result[name].mean for name in ("CR", "OR", "DR", "RC", "TS")}
    assert result["OS"].mean == overall_score(means)
    assert result["OS"].low < result["OS"].mean < result["OS"].high
    # a failed episode: its collision is unknown, so the upper end has room for one
    more = aggregate(outcomes([*several, None]))
    means = {name: more[name].mean for name in means}
    assert more["OS"].mean == overall_score(means)
    assert more["OS"].high - more["OS"].mean > result["OS"].high - result["OS"].mean


EPISODES = [episode(), episode(True, 10), episode(True, 60, 1.5), None, episode(False, 90, 0.1), episode(steps=30)]


@settings(max_examples=20, deadline=None)
@given(st.lists(st.integers(0, 11), max_size=30), st.randoms(use_true_random=False))
def test_copies_and_order_change_nothing(copies, random):
    found = [EpisodeOutcome(e, g, f"{g}{k // 2}", f"{g}{k}", "other") for g in "ab" for k, e in enumerate(EPISODES)]
    mixed = found + [found[i] for i in copies]
    random.shuffle(mixed)
    # compared as text, since NaN differs from itself
    assert repr(aggregate(mixed)) == repr(aggregate(found))


def test_fifty_copies_of_two_motions_are_two_cases():
    hit, free = episode(hit=True), episode()
    runs = [EpisodeOutcome(e, "LaneChanging", "LaneChanging/00", case) for e, case in ((hit, "x"), (free, "y"))] * 25
    result = aggregate(runs)
    assert (result["CR"].n, result["CR"].clusters, result["CR"].mean, result["CR"].method) == (2, 1, 0.5, "none")


def test_groups_and_their_average():
    found = [
        *(("a", o) for o in outcomes([episode(hit=True)], "StraightObstacle", "pre-crash")),
        *(("a", o) for o in outcomes([episode()] * 3, "RightTurn", "pre-crash")),
        *(("a", o) for o in outcomes([episode()] * 2, "Town02", "natural")),
        *(("b", o) for o in outcomes([None], "RightTurn", "pre-crash")),
        *(("b", o) for o in outcomes([episode(hit=True)], "Town02", "natural")),
        *(("b", o) for o in outcomes([episode()], "Town05", "natural")),
    ]
    rows = aggregate_groups(found)
    assert [(r.system, r.group) for r in rows] == [
        ("a", "StraightObstacle"),
        ("a", "RightTurn"),
        ("a", "Town02"),
        ("a", "Avg."),
        ("b", "RightTurn"),
        ("b", "Town02"),
        ("b", "Town05"),
        ("b", "Avg."),
        ("b", "Avg. natural"),
    ]
    average = rows[3].values["CR"]
    assert average.mean == 0.5  # the mean of the eight scenarios' values, not 1 of 4 and not over the towns
    assert (average.n, average.clusters) == (4, 4)
    assert math.isnan(rows[7].values["RC"].mean), "none of its episodes ran"
    assert rows[8].values["CR"].mean == 0.5


def line(**more):
    """A line of results.jsonl."""
    scenario = {"name": "RightTurn/01", "type": "RightTurn", "town": "T"}
    metrics = episode().as_dict() | {"stop_signs": 0}
    return {"key": "k", "status": "ok", "group": "RightTurn", "spec": {"scenario": scenario}, "metrics": metrics} | more


def test_outcome_of_a_record():
    old = EpisodeOutcome.from_record(line())
    assert (old.cluster, old.case, old.family) == ("RightTurn/01", "k", "pre-crash")
    assert EpisodeOutcome.from_record(line(), "hash").case == "hash"
    assert old.metrics.stop_signs is None  # written as 0 by a world without stop signs
    new = EpisodeOutcome.from_record(line(cluster="route", case="motion"), "hash")
    assert (new.cluster, new.case, new.metrics.stop_signs) == ("route", "motion", 0)
    assert EpisodeOutcome.from_record(line(status="timeout", metrics={})).metrics is None
    assert EpisodeOutcome.from_record(
        line(group="Town02", spec={"scenario": {"name": "n", "type": "NaturalJunction"}})
    ).family == ("natural")
    assert EpisodeOutcome.from_record(line(group="mine")).family == "other"


def test_a_metric_that_some_episodes_lack_is_over_those_that_have_it():
    signs = [replace(episode(), stop_signs=value) for value in (2, None, 0, None)]
    result = aggregate(outcomes(signs))
    assert (result["SS"].mean, result["SS"].n) == (1.0, 2)
    assert aggregate(outcomes([episode()] * 6))["SS"].n == 0


def test_fields_and_document_know_every_metric():
    fields = episode().as_dict()
    text = DOCUMENT.read_text(encoding="utf-8")
    for metric in METRICS.values():
        assert metric.field in fields or metric.symbol == "OS"
        assert f"| {metric.symbol} |" in text


# field, unit, better, kind, upper bound: docs/reference/metrics.md
PUBLISHED = {
    "CR": ("collision", "", "lower", "share", 1.0),
    "OR": ("off_road", "m", "lower", "mean", 1.0),
    "DR": ("distance_to_route", "m", "lower", "mean", 1.0),
    "RC": ("route_completion", "", "higher", "bounded", 1.0),
    "TS": ("time", "s", "lower", "mean", 1.0),
    "RR": ("red_lights", "", "lower", "mean", 1.0),
    "SS": ("stop_signs", "", "lower", "mean", 1.0),
    "RF": ("route_following", "", "higher", "bounded", 1.0),
    "ACC": ("acceleration", "m/s^2", "lower", "mean", 1.0),
    "YV": ("yaw_velocity", "rad/s", "lower", "mean", 1.0),
    "LI": ("lane_invasions", "", "lower", "mean", 1.0),
    "LC": ("lane_crossings", "", "lower", "mean", 1.0),
    "CE": ("collision_events", "", "lower", "mean", 1.0),
    "IS": ("impact_speed", "m/s", "lower", "mean", 1.0),
    "AV_cc": ("avoided_by_cc", "", "", "bounded", 1.0),
    "AV_157": ("avoided_by_reg157", "", "", "bounded", 1.0),
    "AV_rss": ("avoided_by_rss", "", "", "bounded", 1.0),
    "AV_fsm": ("avoided_by_fsm", "", "", "bounded", 1.0),
    "AV_max": ("avoided_by_limit", "", "", "bounded", 1.0),
    "CR_vehicle": ("collisions_vehicle", "", "lower", "share", 1.0),
    "CR_walker": ("collisions_walker", "", "lower", "share", 1.0),
    "CR_cyclist": ("collisions_cyclist", "", "lower", "share", 1.0),
    "CR_static": ("collisions_static", "", "lower", "share", 1.0),
    "IF": ("in_route_failure", "", "lower", "share", 1.0),
    "DS": ("driving_score", "", "higher", "bounded", 100.0),
    "TTC": ("min_ttc", "s", "higher", "bounded", 10.0),
    "PET": ("pet", "s", "higher", "bounded", 10.0),
    "MD": ("min_distance", "m", "higher", "mean", 1.0),
    "OS": ("", "", "lower", "mean", 1.0),
}


def test_the_metrics_are_the_published_ones():
    found = {symbol: (m.field, m.unit, m.better, m.kind, m.scale) for symbol, m in METRICS.items()}
    assert found == PUBLISHED
    assert all(symbol == m.symbol for symbol, m in METRICS.items())


def test_counts_are_shares_of_the_episodes_that_have_any():
    several = [replace(episode(), collisions_vehicle=k, collision_events=k) for k in (0, 1, 3, 0, 2)]
    result = aggregate(outcomes(several))
    assert result["CR_vehicle"].mean == pytest.approx(3 / 5)
    assert result["CE"].mean == pytest.approx(6 / 5)


def test_the_score_of_a_failed_episode_is_between_the_best_and_the_worst():
    several = [episode(hit=k % 3 == 0, complete=50 + 5 * k, distance=0.3 * k, steps=20 + k) for k in range(10)]
    found = aggregate(outcomes([*several, None]))["OS"]
    # as if it had completed its route, or collided at once, and everything else were the mean of the others
    means = {f: np.mean([getattr(e, f) for e in several]) for f in ("off_road", "distance_to_route", "time")}
    ends = {}
    for hit in (False, True):
        lost = replace(
            episode(hit=hit, complete=0.0 if hit else 100.0), **{f: float(value) for f, value in means.items()}
        )
        ends[hit] = aggregate(outcomes([*several, lost]))["OS"]
    assert (found.low, found.high) == (pytest.approx(ends[False].low), pytest.approx(ends[True].high))
    assert (found.failed, found.n, found.clusters) == (1, 10, 11)


def test_the_score_of_several_groups_is_the_mean_of_theirs():
    one = [episode(hit=True, complete=40.0, steps=31)] * 5
    two = [episode(distance=2.0)] * 5
    each = [aggregate(outcomes(group))["OS"].mean for group in (one, two)]
    both = aggregate([*outcomes(one, "a"), *outcomes(two, "b")])["OS"]
    assert both.mean == pytest.approx(sum(each) / 2)
    # a group of which nothing is known is left out
    more = aggregate([*outcomes(one, "a"), *outcomes([None, None], "c")])["OS"]
    assert more.mean == pytest.approx(each[0])
    assert aggregate(outcomes([None, None]))["OS"].failed == 2


def test_the_score_is_not_below_zero():
    perfect = [replace(episode(), time=float(k % 2) * 0.2 + 1e-3 * k, off_road=0.0) for k in range(10)]
    assert 0.0 <= aggregate(outcomes(perfect))["OS"].low <= aggregate(outcomes(perfect))["OS"].mean


def test_a_family_of_the_papers_has_an_average_of_one_group():
    rows = aggregate_groups([("a", o) for o in outcomes([episode()], "RightTurn", "pre-crash")])
    assert [row.group for row in rows] == ["RightTurn", "Avg."]
    rows = aggregate_groups([("a", o) for g in ("x", "y") for o in outcomes([episode()], g)])
    assert [row.group for row in rows] == ["x", "y", "Avg. other"]
    assert [row.group for row in aggregate_groups([("a", o) for o in outcomes([episode()], "x")])] == ["x"]
