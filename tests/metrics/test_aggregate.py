"""Tables: denominators, failed episodes, groups, the document."""

import math
from pathlib import Path

import numpy as np
import pytest
from helpers.metric_traces import make_trace
from hypothesis import given, settings
from hypothesis import strategies as st

from ssad.metrics import METRICS, aggregate, aggregate_groups, episode_metrics, overall_score
from ssad.metrics.uncertainty import wilson

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "metrics.md"


def episode(hit: bool = False, complete: float = 100.0, distance: float = 0.0, steps: int = 11):
    """Metrics of a small episode."""
    contact = np.zeros(steps)
    contact[-1] = hit
    return episode_metrics(
        make_trace(steps, contact=contact, route_complete=complete, route_distance=distance, driven=np.arange(steps))
    )


def test_failed_episodes_stay_in_the_denominator():
    result = aggregate([episode(hit=True, complete=50, distance=2), episode(distance=1), None, None])
    assert result["CR"].mean == 1 / 4
    assert result["CR"].low == wilson(1, 4).low
    assert result["CR"].high == wilson(3, 4).high
    assert (result["CR"].n, result["CR"].failed) == (4, 2)
    assert result["RC"].mean == pytest.approx(1.5 / 4)
    assert (result["DR"].mean, result["DR"].n, result["DR"].failed) == (pytest.approx(1.5), 2, 2)
    assert result["DS"].n == 4


def test_empty_and_all_failed():
    empty = aggregate([])
    assert set(empty) == set(METRICS)
    assert all(math.isnan(e.mean) and e.n == 0 for e in empty.values())
    failed = aggregate([None, None])
    assert (failed["CR"].mean, failed["CR"].high, failed["RC"].mean) == (0.0, 1.0, 0.0)
    assert failed["DR"].n == 0
    assert math.isnan(failed["DR"].mean)
    assert math.isnan(failed["OS"].mean)


def test_overall_score_of_means():
    episodes = [episode(hit=True, complete=50, distance=2), episode(distance=1), episode(complete=80, steps=31)]
    result = aggregate(episodes)
    means = {name: result[name].mean for name in ("CR", "OR", "DR", "RC", "TS")}
    assert result["OS"].mean == overall_score(means)
    assert result["OS"].low < result["OS"].mean < result["OS"].high


@settings(max_examples=20, deadline=None)
@given(st.permutations(range(6)))
def test_order_of_episodes_does_not_matter(order):
    episodes = [episode(), episode(True, 10), episode(True, 60, 1.5), None, episode(False, 90, 0.1), episode(steps=30)]
    # compared as text, since NaN differs from itself
    assert repr(aggregate([episodes[i] for i in order])) == repr(aggregate(episodes))


def test_groups_and_their_average():
    rows = aggregate_groups(
        [
            ("a", "one", episode(hit=True)),
            ("a", "two", episode()),
            ("b", "one", None),
            ("a", "two", episode()),
            ("a", "two", episode()),
        ]
    )
    assert [(r.system, r.group) for r in rows] == [
        ("a", "one"),
        ("a", "two"),
        ("a", "Avg."),
        ("b", "one"),
        ("b", "Avg."),
    ]
    average = rows[2].values["CR"]
    assert average.mean == 0.5  # the mean of the groups, not 1 of 4
    assert average.n == 4
    assert rows[4].values["RC"].mean == 0.0


def test_fields_and_document_know_every_metric():
    fields = episode().as_dict()
    text = DOCUMENT.read_text(encoding="utf-8")
    for metric in METRICS.values():
        assert metric.field in fields or metric.symbol == "OS"
        assert f"| {metric.symbol} |" in text
