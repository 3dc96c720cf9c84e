"""The filter against closed forms: least squares without noise, the algebraic Riccati equation with it."""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_discrete_are

from ssad.drivers.perceiving.kalman import predict, squared_distances, update

SPREAD = np.array([[0.5, 0.2], [0.2, 0.3]])


def test_without_noise_it_is_weighted_least_squares() -> None:
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.uniform(0.1, 0.5, 12))
    places = np.stack([3.0 + 2.0 * times, -1.0 - 0.5 * times], 1) + rng.normal(size=(12, 2))
    first, mean = np.diag([4.0, 4.0, 9.0, 9.0]), np.array([1.0, 1.0, 0.0, 0.0])
    state, covariance, now = mean[None], first[None], 0.0
    for time, place in zip(times, places, strict=True):
        state, covariance = predict(state, covariance, np.array([time - now]), 1e-300)
        state, covariance = update(state, covariance, place[None], SPREAD[None])
        now = float(time)
    # all measurements at once, the prior as one more; the state is that of the last moment
    information, right = np.linalg.inv(first), np.linalg.inv(first) @ mean
    for time, place in zip(times, places, strict=True):
        look = np.concatenate([np.eye(2), time * np.eye(2)], 1)
        information = information + look.T @ np.linalg.inv(SPREAD) @ look
        right = right + look.T @ np.linalg.inv(SPREAD) @ place
    start = np.linalg.solve(information, right)
    move = np.eye(4) + now * np.eye(4, k=2)
    np.testing.assert_allclose(state[0], move @ start, rtol=1e-9)
    np.testing.assert_allclose(covariance[0], move @ np.linalg.inv(information) @ move.T, rtol=1e-8)


def test_it_settles_where_the_riccati_equation_says() -> None:
    step, density = 0.2, 3.0
    covariance, mean = np.diag([9.0, 9.0, 50.0, 50.0])[None], np.zeros((1, 4))
    for _ in range(400):
        mean, covariance = predict(mean, covariance, np.array([step]), density)
        before = covariance[0]
        mean, covariance = update(mean, covariance, np.zeros((1, 2)), SPREAD[None])
    move, look = np.eye(4) + step * np.eye(4, k=2), np.eye(4)[:, :2]
    one = density * np.array([[step**3 / 3, step**2 / 2], [step**2 / 2, step]])
    noise = np.kron(one, np.eye(2))
    np.testing.assert_allclose(before, solve_discrete_are(move.T, look, noise, SPREAD), rtol=1e-8)


def test_a_step_can_be_cut_in_two() -> None:
    mean, covariance = np.array([[1.0, 2.0, 3.0, -4.0]]), np.diag([1.0, 2.0, 3.0, 4.0])[None]
    whole = predict(mean, covariance, np.array([0.7]), 2.0)
    half = predict(*predict(mean, covariance, np.array([0.3]), 2.0), np.array([0.4]), 2.0)
    for a, b in zip(whole, half, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12)


def test_distances_are_mahalanobis() -> None:
    covariance = np.zeros((1, 4, 4))
    found = squared_distances(
        np.array([[1.0, 0.0, 9.0, 9.0]]), covariance, np.array([[3.0, 0.0]]), np.diag([4.0, 1.0])[None]
    )
    np.testing.assert_allclose(found, [1.0])
    draws = np.random.default_rng(3)
    mean, place = draws.normal(size=(20, 4)), draws.normal(size=(20, 2))
    wide = draws.normal(size=(20, 4, 4))
    covariance, spread = wide @ wide.transpose(0, 2, 1), np.tile(np.eye(2), (20, 1, 1))
    apart = place - mean[:, :2]
    expected = [d @ np.linalg.inv(c[:2, :2] + s) @ d for d, c, s in zip(apart, covariance, spread, strict=True)]
    np.testing.assert_allclose(squared_distances(mean, covariance, place, spread), expected, rtol=1e-9)
