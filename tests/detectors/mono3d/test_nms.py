"""Overlap of turned rectangles against closed forms and a slow reference; greedy suppression by it."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from ssad.detectors.mono3d.nms import intersection_area, rotated_iou, rotated_nms

Point = tuple[float, float]


def outline(box: list[float]) -> list[Point]:
    x, y, dx, dy, angle = box
    c, s = math.cos(angle), math.sin(angle)
    local = [(-dx / 2, -dy / 2), (dx / 2, -dy / 2), (dx / 2, dy / 2), (-dx / 2, dy / 2)]
    return [(x + c * u - s * v, y + s * u + c * v) for u, v in local]


def clipped_area(a: list[float], b: list[float]) -> float:
    """Sutherland and Hodgman: a cut by each side of b."""
    polygon, frame = outline(a), outline(b)
    for (x0, y0), (x1, y1) in zip(frame, frame[1:] + frame[:1], strict=True):
        heights = [(x1 - x0) * (y - y0) - (y1 - y0) * (x - x0) for x, y in polygon]
        kept: list[Point] = []
        for k, (p, h) in enumerate(zip(polygon, heights, strict=True)):
            q, g = polygon[k - 1], heights[k - 1]
            if (h >= 0) != (g >= 0):
                t = g / (g - h)
                kept.append((q[0] + t * (p[0] - q[0]), q[1] + t * (p[1] - q[1])))
            if h >= 0:
                kept.append(p)
        polygon = kept
    return 0.5 * sum(p[0] * q[1] - q[0] * p[1] for q, p in zip(polygon, polygon[-1:] + polygon[:-1], strict=True))


def area(a: list[float], b: list[float]) -> float:
    return float(intersection_area(torch.tensor([a], dtype=torch.float64), torch.tensor([b], dtype=torch.float64)))


QUARTER = math.pi / 2
CLOSED = {
    "itself": ([0, 0, 2, 1, 0.3], [0, 0, 2, 1, 0.3], 2.0),
    "itself, the other way round": ([0, 0, 2, 1, 0.3], [0, 0, 2, 1, 0.3 + math.pi], 2.0),
    "square on its tip": ([0, 0, 1, 1, 0], [0, 0, 1, 1, math.pi / 4], 2 * (math.sqrt(2) - 1)),
    "cross": ([0, 0, 4, 1, 0], [0, 0, 4, 1, QUARTER], 1.0),
    "slanted cross": ([0, 0, 40, 1, 0], [0, 0, 40, 1, 0.5], 1 / math.sin(0.5)),
    "inside": ([0, 0, 9, 9, 0.2], [0.5, 0.2, 1, 2, 1.0], 2.0),
    "shifted along": ([0, 0, 2, 1, 0], [1, 0, 2, 1, 0], 1.0),
    "corner": ([0, 0, 2, 2, 0], [1, 1, 2, 2, 0], 1.0),
    "shares a side from inside": ([0, 0, 2, 2, 0], [0.5, 0, 1, 1, 0], 1.0),
    "shares a side from outside": ([0, 0, 2, 2, 0], [2, 0, 2, 2, 0], 0.0),
    "touches at a corner": ([0, 0, 2, 2, 0], [2, 2, 2, 2, 0], 0.0),
    "apart": ([0, 0, 2, 2, 0], [9, 0, 2, 2, 0.4], 0.0),
    "frames cross, rectangles do not": ([0, 0, 10, 0.1, math.pi / 4], [3, -3, 10, 0.1, math.pi / 4], 0.0),
    "without area": ([0, 0, 0, 0, 0], [0, 0, 2, 2, 0.4], 0.0),
}


@pytest.mark.parametrize("case", CLOSED.values(), ids=CLOSED.keys())
def test_areas_in_closed_form(case: tuple[list[float], list[float], float]) -> None:
    a, b, wanted = case
    for turn in (0.0, 0.7, QUARTER, 3.0):  # as a whole
        c, s = math.cos(turn), math.sin(turn)
        p, q = ([c * x - s * y + 40, s * x + c * y - 70, dx, dy, t + turn] for x, y, dx, dy, t in (a, b))
        assert area(p, q) == pytest.approx(wanted, abs=1e-7)
        assert area(q, p) == pytest.approx(wanted, abs=1e-7)


sizes = st.floats(0.1, 6)
places = st.floats(-3, 3)
turns = st.floats(-7, 7)
boxes = st.tuples(places, places, sizes, sizes, turns).map(list)


@given(boxes, boxes)
def test_areas_equal_those_of_a_slow_reference(a: list[float], b: list[float]) -> None:
    assert area(a, b) == pytest.approx(clipped_area(a, b), abs=1e-6)
    assert area(a, b) <= min(a[2] * a[3], b[2] * b[3]) + 1e-6


@given(boxes, st.floats(-1, 1), st.floats(-1, 1), st.sampled_from([0.0, QUARTER, math.pi, 1e-9, 1e-7]))
def test_areas_with_parallel_sides(a: list[float], x: float, y: float, turn: float) -> None:
    b = [a[0] + x, a[1] + y, a[2], a[3], a[4] + turn]
    assert area(a, b) == pytest.approx(clipped_area(a, b), abs=1e-6)


def test_overlap_of_areas() -> None:
    a = torch.tensor([[0.0, 0, 2, 1, 0], [0, 0, 0, 0, 0]])
    b = torch.tensor([[1.0, 0, 2, 1, 0], [0, 0, 0, 0, 0]])
    assert rotated_iou(a, b).tolist() == pytest.approx([1 / 3, 0.0])


def slow_nms(rows: Tensor, score: Tensor, group: Tensor, threshold: float) -> list[int]:
    kept: list[int] = []
    for k in sorted(range(len(rows)), key=lambda n: (int(group[n]), -float(score[n]), n)):
        p = rows[k].tolist()
        for n in kept:
            q = rows[n].tolist()
            common = clipped_area(p, q)
            if group[n] == group[k] and common / (p[2] * p[3] + q[2] * q[3] - common) >= threshold:
                break
        else:
            kept.append(k)
    return kept


def heap(count: int, *, seed: int = 0, spread: float = 6.0) -> tuple[Tensor, Tensor, Tensor]:
    draws = torch.Generator().manual_seed(seed)
    rows = torch.rand(count, 5, generator=draws) * torch.tensor([spread, spread, 2.0, 2.0, 6.0])
    rows[:, 2:4] += 0.5
    return rows, torch.rand(count, generator=draws), torch.randint(0, 3, (count,), generator=draws)


@pytest.mark.parametrize("count", [120, pytest.param(260, marks=pytest.mark.slow)])
@pytest.mark.parametrize("threshold", [0.05, 0.3, 0.8])
@pytest.mark.parametrize("spread", [1.0, 6.0, 60.0])
def test_suppression_equals_a_slow_reference(threshold: float, spread: float, count: int) -> None:
    rows, score, group = heap(count, spread=spread)
    found = rotated_nms(rows, score, group, threshold=threshold)
    assert found.tolist() == slow_nms(rows, score, group, threshold)


def test_suppression_does_not_depend_on_the_order_and_settles() -> None:
    rows, score, group = heap(200)
    kept = rotated_nms(rows, score, group, threshold=0.2)
    order = torch.randperm(200, generator=torch.Generator().manual_seed(4))
    again = rotated_nms(rows[order], score[order], group[order], threshold=0.2)
    assert order[again].tolist() == kept.tolist()
    assert len(rotated_nms(rows[kept], score[kept], group[kept], threshold=0.2)) == len(kept)
    more = rotated_nms(rows, score, group, threshold=0.6)
    assert len(kept) < len(more) < 200


def test_groups_do_not_see_each_other() -> None:
    rows, score, group = heap(150)
    together = rotated_nms(rows, score, group, threshold=0.1)
    alone = []
    for k in range(3):
        some = (group == k).nonzero()[:, 0]
        alone += some[rotated_nms(rows[some], score[some], group[some], threshold=0.1)].tolist()
    assert together.tolist() == alone


def test_overlap_at_the_threshold_goes() -> None:
    rows = torch.tensor([[0.0, 0, 2, 1, 0], [1, 0, 2, 1, 0]])
    score, group = torch.tensor([0.5, 0.9]), torch.zeros(2)
    assert rotated_nms(rows, score, group, threshold=1 / 3).tolist() == [1]
    assert rotated_nms(rows, score, group, threshold=1 / 3 + 1e-9).tolist() == [1, 0]


def test_what_is_suppressed_suppresses_nothing() -> None:
    rows = torch.tensor([[0.0, 0, 2, 1, 0], [0.9, 0, 2, 1, 0], [1.8, 0, 2, 1, 0]])
    assert rotated_nms(rows, torch.tensor([0.9, 0.8, 0.7]), torch.zeros(3), threshold=0.3).tolist() == [0, 2]


def test_equal_ones_leave_the_first_and_none_leaves_none() -> None:
    rows = torch.tensor([[3.0, 1, 2, 1, 0.4]]).expand(70, 5)
    assert rotated_nms(rows, torch.ones(70), torch.zeros(70), threshold=0.8).tolist() == [0]
    assert rotated_nms(rows[:0], torch.ones(0), torch.zeros(0), threshold=0.8).tolist() == []
