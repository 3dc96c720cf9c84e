"""A random walk with normal steps as a `Process`: it fails if it ever reaches a height. Its chance is known exactly."""

from __future__ import annotations

import numpy as np


class Walk:
    """Rows walk `steps` steps of standard normal size; `grain` rounds the score down, so that many are equal."""

    name, external = "walk", False

    def __init__(self, batch: int, height: float, *, steps: int = 1, grain: float = 0.0) -> None:
        self.batch, self.height, self.steps, self.grain, self.width = batch, height, steps, grain, steps
        self._work = 0.0
        self.reset(np.zeros(batch, np.uint64))

    def reset(self, keys: np.ndarray) -> None:
        self.keys = keys.copy()
        self.at, self.time = np.zeros(self.batch), np.zeros(self.batch, np.int64)
        self.over = np.zeros(self.batch, bool)
        self.sums, self.means = np.zeros((self.batch, self.width)), np.zeros((self.batch, self.width))

    def step(self) -> None:
        rows = np.flatnonzero(self.running())
        with np.errstate(over="ignore"):
            place = self.keys[rows] + (self.time[rows].astype(np.uint64) + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
        z = _normal(place) + self.means[rows, self.time[rows]]
        self.sums[rows, self.time[rows]] += z
        self.at[rows] += z
        self.time[rows] += 1
        self.over[rows] |= self.at[rows] >= self.height
        self._work += len(rows)

    def running(self) -> np.ndarray:
        return (self.time < self.steps) & ~self.over

    def score(self) -> np.ndarray:
        part = np.clip(self.at / self.height, 0.0, 0.999)
        part = np.floor(part / self.grain) * self.grain if self.grain else part
        return np.where(self.over, 1.0, part)

    def snapshot(self) -> dict[str, np.ndarray]:
        return {"at": self.at, "time": self.time, "over": self.over, "sums": self.sums}

    def put(self, rows: np.ndarray, states: dict[str, np.ndarray]) -> None:
        for name, value in states.items():
            getattr(self, name)[rows] = value

    def rekey(self, rows: np.ndarray, keys: np.ndarray) -> None:
        self.keys[rows] = keys

    def push(self, means: np.ndarray) -> None:
        self.means = np.asarray(means, float)

    def later(self, means: np.ndarray) -> np.ndarray:
        return np.zeros((0, len(means)))  # what comes later has less time to reach the height

    def totals(self) -> tuple[np.ndarray, np.ndarray]:
        return self.sums, (np.arange(self.width) < self.time[:, None]).astype(float)

    def work(self) -> float:
        return self._work


def _normal(word: np.ndarray) -> np.ndarray:
    from scipy.special import ndtri

    with np.errstate(over="ignore"):
        z = word ^ (word >> np.uint64(30))
        z = z * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        z ^= z >> np.uint64(31)
    return ndtri(((z >> np.uint64(11)).astype(float) + 0.5) / 2.0**53)


def chance_of(height: float, steps: int) -> float:
    """That a walk of normal steps reaches the height: by quadrature over the density of those that have not."""
    if steps == 1:
        from scipy.special import ndtr

        return float(ndtr(-height))
    nodes, weights = np.polynomial.legendre.leggauss(800)
    low = -9.0 * np.sqrt(steps)
    x = 0.5 * (height - low) * nodes + 0.5 * (height + low)
    w = 0.5 * (height - low) * weights
    kernel = np.exp(-0.5 * (x[:, None] - x) ** 2) / np.sqrt(2.0 * np.pi)
    density, reached = np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi), 0.0
    from scipy.special import ndtr

    reached = float(ndtr(-height))
    for _ in range(steps - 1):
        reached += float((w * density * ndtr(x - height)).sum())
        density = kernel @ (w * density)
    return reached
