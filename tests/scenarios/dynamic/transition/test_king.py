"""KING: the road as a raster, the controls that repeat a recording, and what the gradients lead to."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from ssad.core.errors import ConfigError
from ssad.core.generators import Base, Outcome
from ssad.drivers import make_system
from ssad.scenarios.dynamic import load_scenarios
from ssad.scenarios.dynamic.generate import Trials, search
from ssad.scenarios.dynamic.transition import king as king_module
from ssad.scenarios.dynamic.transition.king import King
from ssad.scenarios.dynamic.transition.road import raster_of
from ssad.world.roads import load_town
from ssad.world.twin import MotionState, RoadField, bodies_of, box_gap, unroll

(BASE,) = load_scenarios("natural-uniform/Twinford_03/00")
(OTHER,) = load_scenarios("natural-uniform/Crossgate_30/06")
TRIALS = Trials(lambda: make_system("blind"), make_system)


@pytest.fixture(scope="module")
def bases() -> list[Base]:
    found = []
    for scenario in (BASE, OTHER):
        found.append(TRIALS.base(scenario, load_town(scenario.town), seed=2))
    return found


def test_the_raster_says_how_far_the_edge_of_the_road_is(bases: list[Base]) -> None:
    graph, route = bases[0].graph, bases[0].trace.route.astype(np.float64)
    raster = raster_of([graph, graph], [route + 1000.0, route])
    draws = np.random.default_rng(0)
    points = torch.from_numpy(route[draws.integers(len(route), size=200)] + draws.uniform(-8, 8, (200, 2)))
    exact = RoadField(graph)(points)
    found = raster(points[:, None], torch.ones(200, dtype=torch.long))[:, 0]
    # on the road the raster knows no edges between lanes
    beside = (exact > 0.0) & (exact < 6.0)
    assert beside.sum() > 30
    assert (found - exact)[beside].abs().quantile(0.9) < 0.5
    assert ((found > 0.0) == (exact > 0.0))[exact.abs() > 0.5].all()


def test_the_gradient_of_the_raster_leads_back_to_the_road(bases: list[Base]) -> None:
    graph, route = bases[0].graph, bases[0].trace.route.astype(np.float64)
    raster = raster_of([graph], [route])
    points = torch.from_numpy(route[::5, None] + np.array([9.0, 0.0]))
    points = points[raster(points, torch.zeros(len(points), dtype=torch.long))[:, 0] > 0.6].requires_grad_()
    place = torch.zeros(len(points), dtype=torch.long)
    before = raster(points, place)
    before.sum().backward()
    assert len(points)
    after = raster((points - 0.25 * points.grad).detach(), place)
    assert (after < before).float().mean() > 0.9


def test_controls_repeat_what_was_recorded(bases: list[Base]) -> None:
    king = King(bases, seeds=[0, 0], budget=8)
    for k, base in enumerate(bases):
        for agent, (start, controls) in king._recorded[k].items():
            bodies = bodies_of([base.trace.models[agent]], dtype=torch.float64)
            first = MotionState(*(part[None] for part in start))
            pose = unroll(first, controls[:, None], bodies, dt=king_module.STEP, substeps=1).pose[:, 0].numpy()
            recorded = king._motion[k][agent]
            there = recorded[:, 5] > 0.5
            assert np.hypot(*(pose[there, :2] - recorded[there, :2]).T).max() < 1.5


def test_gaps_of_far_boxes_are_rough_and_of_near_ones_exact() -> None:
    draws = torch.Generator().manual_seed(0)
    one = torch.rand((500, 5), generator=draws, dtype=torch.float64) * torch.tensor([40.0, 40.0, 6.0, 3.0, 1.0]) + 1.5
    two = one.flip(0)
    exact, found = box_gap(one, two), king_module._gap(one, two)
    near = found < king_module.FAR - 1.0
    assert near.sum() > 20
    assert torch.equal(found[near], exact[near])
    assert (found - exact).abs().max() < 3.0


def test_king_finds_what_a_blind_driver_runs_into(bases: list[Base]) -> None:
    assert all(base.trace.end != "collision" for base in bases)
    rows = search(King(bases[1:], seeds=[2], budget=4), bases[1:], TRIALS, budget=4, batch=4)
    for row in rows:
        found = [outcome for outcome in row if outcome.is_valid]
        assert found
        assert found[0].trace is not None
        assert len(found[0].adversaries) == 1
        assert found[0].proposal.scenario.type == "Custom"
        (moved,) = found[0].adversaries
        assert found[0].proposal.adversaries == (found[0].trace.names[moved],)


def test_what_king_proposes_does_not_depend_on_the_batch(bases: list[Base], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(king_module, "ITERATIONS", 3)
    together = King(bases, seeds=[1, 2], budget=4).ask(2)
    alone = King(bases[1:], seeds=[2], budget=4).ask(2)
    assert together[1] == alone[0]
    assert King(bases, seeds=[5, 6], budget=4).ask(6)[1][:1] == alone[0][:1]  # the first turn starts as recorded


def test_a_base_without_vehicles_is_told_in_a_line(bases: list[Base]) -> None:
    trace = bases[1].trace
    empty = dataclasses.replace(bases[1], trace=dataclasses.replace(trace, kind=np.full_like(trace.kind, 6)))
    with pytest.raises(ConfigError, match=rf"scenario {OTHER.name}: there is no vehicle in it that could be"):
        King([empty], seeds=[0], budget=4)


def test_a_search_that_diverges_is_told_in_a_line(bases: list[Base], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(king_module, "ITERATIONS", 1)
    king = King(bases, seeds=[0, 0], budget=4)
    king.ask(1)
    king._chains[1][0].change[:] = np.nan
    with pytest.raises(ConfigError, match=rf"generator king: the optimisation diverged in {OTHER.name}"):
        king.ask(1)


def test_a_chain_that_leaves_the_road_is_led_back_harder(bases: list[Base], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(king_module, "ITERATIONS", 1)
    king = King(bases, seeds=[0, 0], budget=8)
    (first,), (second,) = king.ask(1)
    trace = bases[0].trace
    king.tell([[Outcome(first, trace=trace, off_road=True)], [Outcome(second, trace=bases[1].trace)]])
    assert king._chains[0][0].weight == 2.0
    assert king._chains[1][0].weight == 1.0
