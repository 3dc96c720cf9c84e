"""Kalman filter of points with nearly constant velocity on the ground, batched.

The state is x, y, vx, vy; what is measured is x, y. Its speed changes by white noise of acceleration with a spectral
density q (m^2/s^3): Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation (2001),
section 6.2.2.
"""

from __future__ import annotations

import numpy as np

from ssad.core.types import F64


def predict(mean: F64, covariance: F64, seconds: F64, density: float) -> tuple[F64, F64]:
    """Predict points to a later time.

    Args:
        mean: [N, 4].
        covariance: [N, 4, 4].
        seconds: [N] time step, s; 0 changes nothing.
        density: Spectral density of the acceleration, m^2/s^3.

    Returns:
        Mean [N, 4] and covariance [N, 4, 4].
    """
    transition = np.tile(np.eye(4), (len(mean), 1, 1))
    transition[:, 0, 2] = transition[:, 1, 3] = seconds
    noise = np.zeros_like(covariance)
    for position_axis, velocity_axis in ((0, 2), (1, 3)):
        noise[:, position_axis, position_axis] = seconds**3 / 3.0
        noise[:, position_axis, velocity_axis] = noise[:, velocity_axis, position_axis] = seconds**2 / 2.0
        noise[:, velocity_axis, velocity_axis] = seconds
    return (transition @ mean[..., None])[..., 0], transition @ covariance @ transition.transpose(
        0, 2, 1
    ) + density * noise


def update(mean: F64, covariance: F64, place: F64, measurement_covariance: F64) -> tuple[F64, F64]:
    """Update each point with a measurement, in Joseph form, which keeps the covariance positive.

    Args:
        mean: [N, 4].
        covariance: [N, 4, 4].
        place: [N, 2] measured.
        measurement_covariance: [N, 2, 2] covariance of the measurement.

    Returns:
        Mean [N, 4] and covariance [N, 4, 4].
    """
    innovation = covariance[:, :2, :2] + measurement_covariance
    gain = np.linalg.solve(innovation, covariance[:, :2, :]).transpose(0, 2, 1)
    complement = np.tile(np.eye(4), (len(mean), 1, 1))
    complement[:, :, :2] -= gain
    posterior = complement @ covariance @ complement.transpose(
        0, 2, 1
    ) + gain @ measurement_covariance @ gain.transpose(0, 2, 1)
    return mean + (gain @ (place - mean[:, :2])[..., None])[..., 0], posterior


def squared_distances(mean: F64, covariance: F64, place: F64, measurement_covariance: F64) -> F64:
    """Return squared Mahalanobis distances of points and measurements, pair by pair.

    Args:
        mean: [N, 4].
        covariance: [N, 4, 4].
        place: [N, 2].
        measurement_covariance: [N, 2, 2].

    Returns:
        [N].
    """
    x, y = (place - mean[:, :2]).T
    innovation = covariance[:, :2, :2] + measurement_covariance
    # Closed-form inverse of the symmetric 2x2 matrix [[a, b], [b, c]].
    variance_x, covariance_xy, variance_y = (
        innovation[:, 0, 0],
        0.5 * (innovation[:, 0, 1] + innovation[:, 1, 0]),
        innovation[:, 1, 1],
    )
    return np.asarray(
        (variance_y * x * x - 2.0 * covariance_xy * x * y + variance_x * y * y)
        / (variance_x * variance_y - covariance_xy * covariance_xy)
    )
