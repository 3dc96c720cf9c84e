"""Faults of cameras: what each shows, that they come and go, and that a drive's draws are its own."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ssad.core.errors import ConfigError, UnknownNameError
from ssad.core.seeding import generator
from ssad.scenarios.static.faults.camera import COVERED, DELAYS, FAULTS, CameraFault, dirt

SHAPE = (3, 18, 32)


def shown(fault: CameraFault, *, looks: int = 100, scenes: tuple[int, ...] = (0,), dt: float = 0.2) -> Any:
    """Pictures [looks, N, 3, H, W] of a camera whose k-th picture is k + 1 everywhere."""
    found = []
    for k in range(looks):
        frames = np.full((len(scenes), *SHAPE), min(k + 1, 255), np.uint8)
        draws = [generator("fault", scene, k) for scene in scenes]
        found.append(fault.apply(frames, None, SimpleNamespace(time=np.full(len(scenes), k * dt)), draws))
    return np.stack(found)


def values(pictures: Any) -> list[int]:
    return [int(picture.flat[0]) for picture in pictures[:, 0]]


def test_a_frozen_picture_stands_still_and_goes_on() -> None:
    seen = np.array(values(shown(CameraFault("frozen", 3))))
    late = np.arange(1, 101) - seen
    assert (np.diff(seen) >= 0).all()
    assert 20 < (late > 0).sum() < 80
    assert late[np.flatnonzero(np.diff(late) < 0) + 1].tolist() == [0] * int((np.diff(late) < 0).sum())


@pytest.mark.parametrize("name", ["dropped", "blackout"])
def test_a_lost_picture_is_zero_and_a_black_one_is_dark_and_noisy(name: str) -> None:
    pictures = shown(CameraFault(name, 3))[:, 0]
    kept = np.array([(picture == k + 1).all() for k, picture in enumerate(pictures)])
    assert 0.2 < kept.mean() < 0.8
    for picture in pictures[~kept]:
        assert picture.max() < 6
        assert picture.any() == (name == "blackout")


def test_severe_faults_last_longer() -> None:
    share = [np.mean([(p == 0).all() for p in shown(CameraFault("dropped", s), looks=400)[:, 0]]) for s in (1, 3, 5)]
    assert share[0] < share[1] < share[2]


@pytest.mark.parametrize("severity", [1, 3, 5])
def test_a_delayed_picture_is_as_old_as_it_should_be(severity: int) -> None:
    seen = np.array(values(shown(CameraFault("delayed", severity), looks=20)))
    late = round(DELAYS[severity - 1] / 0.2)
    assert seen.tolist() == [max(k + 1 - late, 1) for k in range(20)]


def test_dirt_stays_where_it_is_and_covers_its_share() -> None:
    pictures = np.stack([shown(CameraFault("dirt", 4), looks=3, scenes=(s,)) for s in range(2)])
    assert not np.array_equal(pictures[0], pictures[1])
    for covered in COVERED:
        mask = dirt(90, 160, covered, generator("dirt", 0))
        assert (mask > 0.475).mean() == pytest.approx(covered, abs=0.02)
        assert mask.max() <= 0.95
    fault, bright = CameraFault("dirt", 5), np.full((1, *SHAPE), 200, np.uint8)
    first = fault.apply(bright, None, SimpleNamespace(time=np.zeros(1)), [generator("a", 0)])
    again = fault.apply(bright, None, SimpleNamespace(time=np.ones(1)), [generator("a", 1)])
    np.testing.assert_array_equal(first, again)
    assert first.min() < 100
    assert first.max() > 190


@pytest.mark.parametrize("name", FAULTS)
def test_a_drive_does_not_depend_on_its_batch_and_starts_anew(name: str) -> None:
    fault = CameraFault(name, 3)
    together = shown(fault, looks=30, scenes=(4, 5))
    np.testing.assert_array_equal(shown(CameraFault(name, 3), looks=30, scenes=(5,))[:, 0], together[:, 1])
    np.testing.assert_array_equal(shown(fault, looks=30, scenes=(4, 5)), together)


def test_wrong_names_and_severities_are_one_line() -> None:
    with pytest.raises(UnknownNameError, match="frozen"):
        CameraFault("frosen")
    with pytest.raises(ConfigError, match="1 to 5"):
        CameraFault("frozen", 6)
    with pytest.raises(ConfigError, match="one of each"):
        CameraFault("frozen").apply(np.zeros((2, *SHAPE), np.uint8), None, SimpleNamespace(time=np.zeros(3)), [])
