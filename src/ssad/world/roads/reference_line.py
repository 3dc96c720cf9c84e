"""Reference lines of OpenDRIVE roads, evaluated for many positions at once.

The geometry follows ASAM OpenDRIVE 1.8, chapter 9: line, arc, spiral (clothoid), poly3 and paramPoly3 with both
parameter ranges.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from ssad.core.types import F64

CLOTHOID, CURVE = 0, 1  # kinds of pieces: curvature linear in arc length; polynomials u(p) and v(p)
KEY_SPAN: Final = 1.0e6  # m, beyond every position: keeps the records of one owner apart from those of the next
PANELS: Final = 64  # intervals of a polynomial curve in the table of its arc length
TURN: Final = 1.5  # rad, most that a clothoid turns within a panel of the quadrature
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)
_FEW_NODES, _FEW_WEIGHTS = np.polynomial.legendre.leggauss(6)

Index = npt.NDArray[np.int64]


@dataclass(frozen=True)
class PlanPiece:
    """One <geometry> of a road.

    Attributes:
        s: Position of its start along the road, m.
        x: Start, m.
        y: Start, m.
        heading: Direction at the start, rad.
        length: m.
        kind: `CLOTHOID` (also lines and arcs) or `CURVE`.
        values: Clothoid: curvature at the start and at the end, 1/m. Curve: aU, bU, cU, dU, aV, bV, cV, dV, and the
            parameter at the end; 0 there: the parameter at which the arc length reaches `length` (poly3).
        written_as: Element of the file, such as "arc".
    """

    s: float
    x: float
    y: float
    heading: float
    length: float
    kind: int
    values: tuple[float, ...]
    written_as: str = ""


class Cubics:
    """Piecewise cubic polynomials of several owners, such as the widths of lanes."""

    def __init__(self, owners: Sequence[Sequence[tuple[float, ...]]]) -> None:
        """Store rows (start, a, b, c, d) of each owner, in order of their starts."""
        rows = [row for records in owners for row in records]
        counts = np.array([len(records) for records in owners], np.int64)
        self.first: Index = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        self.count: Index = counts
        self.table: F64 = np.array(rows, np.float64).reshape(-1, 5)
        self.key: F64 = self.table[:, 0] + KEY_SPAN * np.repeat(np.arange(len(owners)), counts)

    def __call__(self, owner: Index, s: F64) -> tuple[F64, F64]:
        """Return values and slopes at positions s [n] of owners [n]; 0 for an owner without records.

        Before its first record, an owner has the value there.
        """
        if not self.table[:, 1:].any():  # as the elevation of flat maps
            return np.zeros(len(s)), np.zeros(len(s))
        record = np.searchsorted(self.key, s + KEY_SPAN * owner, side="right") - 1
        record = np.clip(record, self.first[owner], np.maximum(self.first[owner + 1] - 1, self.first[owner]))
        start, a, b, c, d = self.table[np.minimum(record, len(self.table) - 1)].T
        distance = s - start
        before = distance < 0.0
        distance = np.where(before, 0.0, distance)
        value = a + distance * (b + distance * (c + distance * d))
        slope = np.where(before, 0.0, b + distance * (2.0 * c + distance * 3.0 * d))
        has_records = self.count[owner] > 0
        return np.where(has_records, value, 0.0), np.where(has_records, slope, 0.0)


class ReferenceLines:
    """Reference lines of the roads of a map."""

    def __init__(self, roads: Sequence[Sequence[PlanPiece]]) -> None:
        """Store the pieces of each road, in order of s, at least one a road."""
        pieces = [piece for road in roads for piece in road]
        counts = np.array([len(road) for road in roads], np.int64)
        self.first: Index = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        self.road: Index = np.repeat(np.arange(len(roads)), counts)
        self.start: F64 = np.array(
            [(piece.s, piece.x, piece.y, piece.heading, piece.length) for piece in pieces], np.float64
        ).reshape(-1, 5)
        self.key: F64 = self.start[:, 0] + KEY_SPAN * self.road
        self.kind = np.array([piece.kind for piece in pieces], np.int64)
        self.curvatures = np.array(
            [piece.values if piece.kind == CLOTHOID else (0.0, 0.0) for piece in pieces], np.float64
        ).reshape(-1, 2)
        self.curve_row = np.cumsum(self.kind == CURVE) - 1
        self.curves = _Curves([piece for piece in pieces if piece.kind == CURVE])

    def evaluate(self, road: Index, s: F64) -> tuple[F64, F64, F64, F64]:
        """Return the reference line at positions.

        Args:
            road: Row of the road [n].
            s: Positions along it [n], m; beyond the last piece, its end counts.

        Returns:
            x, y [n], m; heading [n], rad; curvature [n], 1/m.
        """
        piece = np.searchsorted(self.key, s + KEY_SPAN * road, side="right") - 1
        piece = np.clip(piece, self.first[road], self.first[road + 1] - 1)
        return self.evaluate_pieces(piece, s - self.start[piece, 0])

    def evaluate_pieces(self, piece: Index, distance: F64) -> tuple[F64, F64, F64, F64]:
        """Return x, y, heading and curvature [n] at distances from the starts of pieces [n]; see `evaluate`."""
        _, x0, y0, heading0, length = self.start[piece].T
        distance = np.clip(distance, 0.0, length)
        u, v, turn, curvature = (np.zeros(len(piece)) for _ in range(4))
        is_curve = self.kind[piece] == CURVE
        rows = np.flatnonzero(~is_curve)
        first, last = self.curvatures[piece[rows]].T
        rate = (last - first) / np.maximum(length[rows], 1e-12)
        u[rows], v[rows], turn[rows] = clothoid(first, rate, distance[rows])
        curvature[rows] = first + rate * distance[rows]
        rows = np.flatnonzero(is_curve)
        u[rows], v[rows], turn[rows], curvature[rows] = self.curves.evaluate(
            self.curve_row[piece[rows]], distance[rows]
        )
        cosine, sine = np.cos(heading0), np.sin(heading0)
        return x0 + cosine * u - sine * v, y0 + sine * u + cosine * v, heading0 + turn, curvature

    def gaps(self) -> list[tuple[int, float, float]]:
        """Return row of the road, s and size, m, of the gaps between the pieces of a road."""
        inner = np.flatnonzero(self.road[1:] == self.road[:-1])
        x, y, _, _ = self.evaluate_pieces(inner, self.start[inner, 4])
        size = np.hypot(self.start[inner + 1, 1] - x, self.start[inner + 1, 2] - y)
        return [
            (int(self.road[row]), float(self.start[row + 1, 0]), float(gap))
            for row, gap in zip(inner, size, strict=True)
        ]

    def length_errors(self) -> list[tuple[int, float, float, float]]:
        """Return row of the road, s, length in the file and arc length, m, of the polynomial curves."""
        pieces = np.flatnonzero(self.kind == CURVE)
        return [
            (int(self.road[piece]), float(self.start[piece, 0]), float(self.start[piece, 4]), float(arc_length))
            for piece, arc_length in zip(pieces, self.curves.arc_length, strict=True)
        ]


def clothoid(curvature: F64, rate: F64, distance: F64) -> tuple[F64, F64, F64]:
    """Return a curve of linear curvature that begins at the origin along u.

    Args:
        curvature: At the start [n], 1/m.
        rate: Change of the curvature with arc length [n], 1/m^2; 0: an arc, or a line.
        distance: Arc length from the start [n], m.

    Returns:
        u, v [n], m; turn [n], rad.
    """
    turn = distance * (curvature + 0.5 * rate * distance)
    # The chord of an arc: 2 sin(turn / 2) / curvature, written so that curvature 0 is a line.
    chord = distance * np.sinc(turn / (2.0 * np.pi))
    u, v = chord * np.cos(0.5 * turn), chord * np.sin(0.5 * turn)
    spiral_rows = np.flatnonzero(rate)
    most_turn = np.abs(distance) * (np.abs(curvature) + 0.5 * np.abs(rate * distance))
    panels = np.exp2(np.ceil(np.log2(np.maximum(most_turn / TURN, 1.0)))).astype(np.int64)
    for panel_count in np.unique(panels[spiral_rows]).tolist():
        rows = spiral_rows[panels[spiral_rows] == panel_count]
        width = distance[rows] / panel_count
        sums = np.zeros((2, len(rows)))
        for panel in range(panel_count):
            at = width[:, None] * (panel + 0.5 * (_NODES + 1.0))
            angle = at * (curvature[rows, None] + 0.5 * rate[rows, None] * at)
            sums += 0.5 * width * np.stack([np.cos(angle) @ _WEIGHTS, np.sin(angle) @ _WEIGHTS])
        u[rows], v[rows] = sums
    return u, v, turn


class _Curves:
    """Polynomial curves by arc length, which is scaled so that each ends at the length that the file states."""

    def __init__(self, pieces: Sequence[PlanPiece]) -> None:
        self.length: F64 = np.array([piece.length for piece in pieces], np.float64)
        values = np.array([piece.values for piece in pieces], np.float64).reshape(-1, 9)
        self.u, self.v = values[:, :4], values[:, 4:8]
        by_length = values[:, 8] <= 0.0
        # Arc length grows at least as fast as u, so poly3 ends at a parameter of at most its length.
        end = np.where(by_length, self.length, values[:, 8])
        self.node: F64 = end[:, None] * np.linspace(0.0, 1.0, PANELS + 1)
        curve = np.repeat(np.arange(len(pieces)), PANELS)
        steps = self._arc(curve, self.node[:, :-1].ravel(), self.node[:, 1:].ravel()).reshape(-1, PANELS)
        self.cumulative: F64 = np.concatenate([np.zeros((len(pieces), 1)), np.cumsum(steps, axis=1)], axis=1)
        self.arc_length: F64 = np.where(by_length, self.length, self.cumulative[:, -1])
        self.scale: F64 = self.arc_length / np.maximum(self.length, 1e-12)
        self.key: F64 = (self.cumulative + KEY_SPAN * np.arange(len(pieces))[:, None]).ravel()

    def evaluate(self, curve: Index, distance: F64) -> tuple[F64, F64, F64, F64]:
        if not len(curve):
            return (np.zeros(0),) * 4
        target = distance * self.scale[curve]
        panel = np.searchsorted(self.key, target + KEY_SPAN * curve, side="right") - 1 - curve * (PANELS + 1)
        panel = np.clip(panel, 0, PANELS - 1)
        low, high = self.node[curve, panel], self.node[curve, panel + 1]
        at_low, at_high = self.cumulative[curve, panel], self.cumulative[curve, panel + 1]
        share = (target - at_low) / np.maximum(at_high - at_low, 1e-12)
        parameter = low + np.clip(share, 0.0, 1.0) * (high - low)
        for _ in range(3):
            error = at_low + self._arc(curve, low, parameter) - target
            parameter = np.clip(parameter - error / np.maximum(self._speed(curve, parameter), 1e-9), low, high)
        u, du, ddu = _polynomial(self.u[curve], parameter)
        v, dv, ddv = _polynomial(self.v[curve], parameter)
        speed = np.maximum(np.hypot(du, dv), 1e-9)
        return u, v, np.arctan2(dv, du), (du * ddv - dv * ddu) / speed**3

    def _speed(self, curve: Index, parameter: F64) -> F64:
        return np.asarray(
            np.hypot(_polynomial(self.u[curve], parameter)[1], _polynomial(self.v[curve], parameter)[1]), np.float64
        )

    def _arc(self, curve: Index, low: F64, high: F64) -> F64:
        """Return the arc length between two parameters [n] of curves [n]."""
        half = 0.5 * (high - low)
        total = np.zeros(len(curve))
        for node, weight in zip(_FEW_NODES, _FEW_WEIGHTS, strict=True):
            total += weight * self._speed(curve, low + half * (node + 1.0))
        return half * total


def _polynomial(coefficients: F64, parameter: F64) -> tuple[F64, F64, F64]:
    """Return value, first and second derivative of cubics [n, 4] at parameters [n]."""
    a, b, c, d = coefficients.T
    return (
        a + parameter * (b + parameter * (c + parameter * d)),
        b + parameter * (2.0 * c + 3.0 * parameter * d),
        2.0 * c + 6.0 * parameter * d,
    )
