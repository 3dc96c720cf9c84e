"""The Kalman filter of a point that moves steadily on the ground, for many points at once.

The state is x, y, vx, vy; what is measured is x, y. Its speed changes by white noise of acceleration with a spectral
density q (m^2/s^3): Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation (2001),
section 6.2.2.
"""

from __future__ import annotations

import numpy as np

from ssad.core.types import F64


def predict(mean: F64, covariance: F64, seconds: F64, density: float) -> tuple[F64, F64]:
    """Where points will be.

    Args:
        mean: [N, 4].
        covariance: [N, 4, 4].
        seconds: [N] from now; 0 changes nothing.
        density: Spectral density of the acceleration, m^2/s^3.

    Returns:
        Mean [N, 4] and covariance [N, 4, 4].
    """
    move = np.tile(np.eye(4), (len(mean), 1, 1))
    move[:, 0, 2] = move[:, 1, 3] = seconds
    noise = np.zeros_like(covariance)
    for place, speed in ((0, 2), (1, 3)):
        noise[:, place, place] = seconds**3 / 3.0
        noise[:, place, speed] = noise[:, speed, place] = seconds**2 / 2.0
        noise[:, speed, speed] = seconds
    return (move @ mean[..., None])[..., 0], move @ covariance @ move.transpose(0, 2, 1) + density * noise


def update(mean: F64, covariance: F64, place: F64, spread: F64) -> tuple[F64, F64]:
    """Take in a measurement of each point, in Joseph's form, which keeps the covariance positive.

    Args:
        mean: [N, 4].
        covariance: [N, 4, 4].
        place: [N, 2] measured.
        spread: [N, 2, 2] covariance of the measurement.

    Returns:
        Mean [N, 4] and covariance [N, 4, 4].
    """
    expected = covariance[:, :2, :2] + spread
    gain = np.linalg.solve(expected, covariance[:, :2, :]).transpose(0, 2, 1)
    left = np.tile(np.eye(4), (len(mean), 1, 1))
    left[:, :, :2] -= gain
    better = left @ covariance @ left.transpose(0, 2, 1) + gain @ spread @ gain.transpose(0, 2, 1)
    return mean + (gain @ (place - mean[:, :2])[..., None])[..., 0], better


def distance(mean: F64, covariance: F64, place: F64, spread: F64) -> F64:
    """Squared Mahalanobis distances of points and measurements, pair by pair.

    Args:
        mean: [N, 4].
        covariance: [N, 4, 4].
        place: [N, 2].
        spread: [N, 2, 2].

    Returns:
        [N].
    """
    x, y = (place - mean[:, :2]).T
    expected = covariance[:, :2, :2] + spread
    a, b, c = expected[:, 0, 0], 0.5 * (expected[:, 0, 1] + expected[:, 1, 0]), expected[:, 1, 1]
    return np.asarray((c * x * x - 2.0 * b * x * y + a * y * y) / (a * c - b * b))
