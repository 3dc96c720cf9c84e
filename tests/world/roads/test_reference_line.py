"""Reference lines against closed forms and independent integration."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import fresnel

from ssad.world.roads.reference_line import CLOTHOID, CURVE, Cubics, PlanPiece, ReferenceLines, clothoid


def evaluate(piece: PlanPiece, s: list[float]) -> np.ndarray:
    """x, y, heading and curvature [n, 4] of a road of one piece."""
    lines = ReferenceLines([[piece]])
    return np.stack(lines.evaluate(np.zeros(len(s), np.int64), np.array(s)), 1)


def test_a_line_and_arcs_of_no_curvature_are_straight() -> None:
    rows = evaluate(PlanPiece(0.0, 3.0, 4.0, np.pi / 6, 60.0, CLOTHOID, (0.0, 0.0)), [0.0, 30.0, 60.0])
    assert rows[:, 0] == pytest.approx([3.0, 3.0 + 30 * np.cos(np.pi / 6), 3.0 + 60 * np.cos(np.pi / 6)], abs=1e-12)
    assert rows[:, 1] == pytest.approx([4.0, 19.0, 34.0], abs=1e-12)
    assert rows[:, 2] == pytest.approx(np.pi / 6)


def test_an_arc_lies_on_its_circle() -> None:
    s = np.linspace(0.0, 150.0, 31)
    rows = evaluate(PlanPiece(0.0, 0.0, 0.0, 0.0, 150.0, CLOTHOID, (-0.04, -0.04)), s.tolist())
    assert np.hypot(rows[:, 0], rows[:, 1] + 25.0) == pytest.approx(25.0, abs=1e-10)
    assert rows[:, 2] == pytest.approx(-0.04 * s)
    assert rows[:, 0] == pytest.approx(25.0 * np.sin(0.04 * s), abs=1e-10)


def test_a_spiral_from_a_straight_line_is_that_of_fresnel() -> None:
    length, curvature = 80.0, 0.05
    scale = np.sqrt(np.pi * length / curvature)  # x(s) = scale * C(s / scale)
    s = np.linspace(0.0, length, 41)
    rows = evaluate(PlanPiece(0.0, 0.0, 0.0, 0.0, length, CLOTHOID, (0.0, curvature)), s.tolist())
    sine, cosine = fresnel(s / scale)
    assert rows[:, 0] == pytest.approx(scale * cosine, abs=1e-9)
    assert rows[:, 1] == pytest.approx(scale * sine, abs=1e-9)
    assert rows[-1, 2] == pytest.approx(0.5 * curvature * length)


@pytest.mark.parametrize(
    ("curvature", "rate", "length"), [(0.2, -0.01, 40.0), (-0.03, 1e-9, 100.0), (0.5, 0.5, 12.0), (0.01, 0.0, 5.0)]
)
def test_clothoids_of_any_kind_are_the_integral_of_their_heading(curvature: float, rate: float, length: float) -> None:
    """Also where the change of curvature is tiny, and after several full turns."""
    u, v, turn = (float(value[0]) for value in clothoid(*(np.array([x]) for x in (curvature, rate, length))))

    def heading(s: float) -> float:
        return curvature * s + 0.5 * rate * s * s

    assert u == pytest.approx(quad(lambda s: np.cos(heading(s)), 0.0, length, limit=500)[0], abs=1e-8)
    assert v == pytest.approx(quad(lambda s: np.sin(heading(s)), 0.0, length, limit=500)[0], abs=1e-8)
    assert turn == pytest.approx(heading(length))


def test_poly3_ends_where_its_arc_length_does() -> None:
    """A parabola v = u^2 / 40, whose arc length has a closed form."""
    u = np.array([0.0, 5.0, 12.0, 30.0])
    slope = u / 20.0
    s = 10.0 * (slope * np.hypot(1.0, slope) + np.arcsinh(slope))
    rows = evaluate(
        PlanPiece(0.0, 1.0, 2.0, 0.0, s[-1], CURVE, (0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1 / 40, 0.0, 0.0)), s.tolist()
    )
    assert rows[:, 0] == pytest.approx(1.0 + u, abs=1e-7)
    assert rows[:, 1] == pytest.approx(2.0 + u * u / 40, abs=1e-7)
    assert rows[:, 2] == pytest.approx(np.arctan(slope), abs=1e-8)
    assert rows[:, 3] == pytest.approx(0.05 / np.hypot(1.0, slope) ** 3, abs=1e-8)


@pytest.mark.parametrize("end", [1.0, 50.0])
def test_parampoly3_runs_at_the_speed_of_arc_length(end: float) -> None:
    """The same curve by both ranges of its parameter, which does not run evenly along it."""
    u = np.array([0.0, 20.0, 40.0, -10.0]) / end ** np.arange(4)
    v = np.array([0.0, 0.0, 30.0, -5.0]) / end ** np.arange(4)

    def speed(p: float) -> float:
        return float(np.hypot(u[1] + 2 * u[2] * p + 3 * u[3] * p * p, v[1] + 2 * v[2] * p + 3 * v[3] * p * p))

    parameters = [0.0, 0.1 * end, 0.55 * end, end]
    s = [quad(speed, 0.0, p, epsabs=1e-12)[0] for p in parameters]
    rows = evaluate(PlanPiece(0.0, 0.0, 0.0, np.pi / 2, s[-1], CURVE, (*u, *v, end)), s)
    expected_u, expected_v = (np.polynomial.polynomial.polyval(parameters, c) for c in (u, v))
    assert rows[:, 0] == pytest.approx(-expected_v, abs=1e-6)
    assert rows[:, 1] == pytest.approx(expected_u, abs=1e-6)


def test_a_curve_that_is_longer_than_the_file_says_still_meets_the_next_piece() -> None:
    piece = PlanPiece(0.0, 0.0, 0.0, 0.0, 90.0, CURVE, (0.0, 100.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))
    lines = ReferenceLines([[piece, PlanPiece(90.0, 100.0, 0.5, 0.0, 5.0, CLOTHOID, (0.0, 0.0))]])
    assert lines.gaps() == [(0, 90.0, pytest.approx(0.5))]
    assert lines.length_errors() == [(0, 0.0, 90.0, pytest.approx(100.0))]
    x, _, _, _ = lines.evaluate(np.zeros(3, np.int64), np.array([45.0, 92.0, 200.0]))
    assert x == pytest.approx([50.0, 102.0, 105.0])  # beyond the end, the end


def test_cubics_keep_their_owners_apart() -> None:
    cubics = Cubics([[(0.0, 1.0, 2.0, 0.0, 0.0), (10.0, 5.0, 0.0, 1.0, 1.0)], [], [(4.0, 7.0, 1.0, 0.0, 0.0)]])
    owner = np.array([0, 0, 0, 1, 2, 2])
    value, slope = cubics(owner, np.array([3.0, 10.0, 12.0, 3.0, 1.0, 6.0]))
    assert value.tolist() == [7.0, 5.0, 5.0 + 4.0 + 8.0, 0.0, 7.0, 9.0]
    assert slope.tolist() == [2.0, 0.0, 4.0 + 12.0, 0.0, 0.0, 1.0]
    assert Cubics([[]])(np.array([0]), np.array([1.0]))[0].tolist() == [0.0]
