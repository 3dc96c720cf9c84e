"""CAT: a prior learned from recorded motions, the product of its terms, and what it proposes."""

from __future__ import annotations

from collections import deque
from copy import copy
from pathlib import Path

import numpy as np
import pytest

from ssad.core.errors import FormatError
from ssad.core.generators import Base
from ssad.core.safeio import save_npz
from ssad.drivers import make_system
from ssad.scenarios.dynamic import load_scenarios
from ssad.scenarios.dynamic.generate import Trials
from ssad.scenarios.dynamic.transition import cat as cat_module
from ssad.scenarios.dynamic.transition.cat import Cat, library_data, traffic_motions
from ssad.world.roads import load_town
from ssad.world.roads.query import LaneQuery


@pytest.fixture(scope="module")
def base() -> Base:
    scenario = load_scenarios("natural")[0]
    return Trials(lambda: make_system("blind")).base(scenario, load_town(scenario.town), seed=2)


@pytest.fixture(scope="module")
def untouched(base: Base) -> Cat:
    return Cat([base], seeds=[1], budget=8)


@pytest.fixture
def cat(untouched: Cat) -> Cat:
    """One that a test may ask: nothing is taken from those of the other tests."""
    made = copy(untouched)
    made._untried, made._egos = [[*left] for left in untouched._untried], [copy(egos) for egos in untouched._egos]
    return made


def test_recorded_motions_start_at_the_origin_and_can_be_driven(cat: Cat) -> None:
    motions, speeds = traffic_motions()
    assert len(motions) == len(speeds) > 1000
    assert np.abs(motions[:, 0]).max() < 1e-9
    assert motions[:, 4, 0].min() > -0.5  # nobody drives backwards
    assert np.hypot(*np.diff(motions[..., :2], axis=1).T).max() / 0.25 < 20.0
    assert np.hypot(*motions[:, 1, :2].T) / 0.25 == pytest.approx(speeds, abs=0.06)


def test_the_library_keeps_motions_to_a_centimetre(tmp_path: Path) -> None:
    poses = np.random.default_rng(0).uniform(-1.0, 1.0, (20, cat_module.LENGTH + 1, 3)) * [200.0, 50.0, 3.1]
    path = tmp_path / "motions.npz"
    save_npz(path, library_data(poses, np.arange(20.0)))
    motions, speeds = traffic_motions(path)
    assert np.abs(motions - poses).max(axis=(0, 1)) == pytest.approx([0.005, 0.005, 0.00005], rel=0.1)
    assert speeds.tolist() == list(range(20))
    save_npz(tmp_path / "other.npz", {"pose": np.zeros((3, 2, 3)), "speed": np.zeros(3)})
    with pytest.raises(FormatError, match=r"other.npz: no library of motions; make it with"):
        traffic_motions(tmp_path / "other.npz")


def test_candidates_stay_on_the_road_and_their_priors_add_up(cat: Cat, base: Base) -> None:
    (found,) = cat._untried
    assert len(found) > 50
    query = LaneQuery(base.graph)
    assert all(not query.off_road(c.pose[::2, :2]).any() for c in found[::10])
    total: dict[tuple[int, int], float] = {}
    for c in found:
        total[c.agent, c.start] = total.get((c.agent, c.start), 0.0) + c.prior
    assert all(value == pytest.approx(1.0) for value in total.values())


def test_the_score_sums_over_the_egos_rollouts_and_falls_with_the_time(cat: Cat) -> None:
    candidate = cat._untried[0][0]
    motion = cat._motion[0]

    def ego(meets: int | None) -> np.ndarray:
        """An ego far away that is where the candidate is from one step on."""
        rows = motion[0].copy()
        rows[:, :2] += 1.0e4
        rows[:, 5] = 1.0
        if meets is not None:
            steps = np.arange(meets, cat_module.LENGTH + 1)
            rows[candidate.start + steps, :3] = candidate.pose[steps]
        return rows

    def score(*egos: np.ndarray) -> float:
        cat._egos[0] = deque(egos, maxlen=5)
        return cat._score(0, candidate)[0]

    kept = cat._egos[0]
    assert score(ego(None)) == 0.0
    assert score(ego(0)) == pytest.approx(candidate.prior)
    assert score(ego(10)) == pytest.approx(candidate.prior * 0.99**5)  # the sixth look, at steps of 0.5 s
    assert score(ego(0), ego(None), ego(10)) == pytest.approx(candidate.prior * (1.0 + 0.99**5))
    cat._egos[0] = kept


def test_the_best_are_proposed_first_and_none_twice(cat: Cat) -> None:
    scores = [cat._score(0, c) for c in cat._untried[0]]
    count = len(cat._untried[0])
    (first,) = cat.ask(4)
    (second,) = cat.ask(4)
    assert len(first) == len(second) == 4
    assert len(cat._untried[0]) == count - 8
    left = [cat._score(0, c) for c in cat._untried[0]]
    assert sorted(scores)[:-8] == sorted(left)
    assert len({p.scenario.actors for p in [*first, *second]}) == 8
    assert all(p.scenario.type == "Custom" for p in first)
