"""The loop that runs a generator, what it measures, and what is saved of what it finds."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import pytest
from helpers.metric_traces import make_trace

from ssad.core.driving import Observation, WorldState
from ssad.core.errors import ConfigError, MissingExtraError, UnknownNameError
from ssad.core.generators import Base, Generator, Outcome, Proposal
from ssad.core.types import Bool, Controller, Pose
from ssad.drivers import make_system
from ssad.scenarios.dynamic import build_episode, load_scenarios, read_scenarios, save_scenarios
from ssad.scenarios.dynamic.frozen import freeze_episode
from ssad.scenarios.dynamic.generate import Trials, generator_factory, generator_list, scenario_of, search
from ssad.scenarios.dynamic.outcome import measure
from ssad.world.roads import load_town


def trials(system: str = "blind") -> Trials:
    return Trials(lambda: make_system(system), make_system)


@pytest.fixture(scope="module")
def bases() -> list[Base]:
    found = []
    for name in ("UnprotectedLeftTurn/00", "StraightObstacle/00"):
        (scenario,) = load_scenarios(name)
        found.append(trials().base(scenario, load_town(scenario.town), seed=3))
    return found


@pytest.fixture(scope="module")
def natural() -> Base:
    scenario = load_scenarios("natural")[0]
    return trials("autopilot").base(scenario, load_town(scenario.town), seed=3)


def test_a_town_may_be_named_by_the_path_of_its_map(bases: list[Base]) -> None:
    first = bases[0]
    scenario = dataclasses.replace(first.scenario, town="maps/own.xodr")
    base = trials().base(scenario, first.graph, seed=3)
    assert np.array_equal(base.trace.x, first.trace.x)
    told = [trials().run([(one, Proposal(one.scenario))])[0] for one in (base, first)]
    assert told[0].danger == told[1].danger


class Counting(Trials):
    """Trials that say how many rollouts they have driven."""

    driven: ClassVar[list[int]] = []

    def run(self, proposals: Sequence[tuple[Base, Proposal]]) -> list[Outcome]:
        self.driven.append(len(proposals))
        return super().run(proposals)


def test_a_search_spends_its_budget_and_gives_the_same_again(bases: list[Base]) -> None:
    def once(some: list[Base], seeds: list[int]) -> list[list[Outcome]]:
        generator = generator_factory("random")(some, seeds=seeds, budget=6)
        assert isinstance(generator, Generator)
        return search(generator, some, trials(), budget=6, batch=4)

    first, again = once(bases, [5, 6]), once(bases, [5, 6])
    assert [len(row) for row in first] == [6, 6]
    assert [[o.proposal for o in row] for row in first] == [[o.proposal for o in row] for row in again]
    assert [[o.danger for o in row] for row in first] == [[o.danger for o in row] for row in again]
    alone = once(bases[1:], [6])
    assert [o.danger for o in alone[0]] == [o.danger for o in first[1]]
    other = once(bases, [7, 6])
    assert [o.proposal for o in other[0]] != [o.proposal for o in first[0]]
    assert len({o.danger for o in first[0]}) > 1


def test_a_search_goes_on_from_what_is_known(bases: list[Base]) -> None:
    def run(known: Sequence[Sequence[Outcome]], budget: int = 8) -> tuple[list[list[Outcome]], int]:
        generator = generator_factory("random")(bases, seeds=[1, 2], budget=8)
        counting = Counting(lambda: make_system("blind"), make_system)
        Counting.driven = []
        return search(generator, bases, counting, budget=budget, batch=4, known_outcomes=known), sum(Counting.driven)

    whole, driven = run(())
    assert driven == 16
    resumed, driven = run([whole[0][:6], whole[1][:3]])
    assert driven == 16 - 6 - 3
    assert [[o.danger for o in row] for row in resumed] == [[o.danger for o in row] for row in whole]
    with pytest.raises(ConfigError, match="of another search"):
        run([whole[0][1:], whole[1]])


class Greedy:
    """Proposes more than it may."""

    name = "greedy"

    def __init__(self, bases: Sequence[Base], **_: Any) -> None:
        self.bases = bases

    def ask(self, count: int) -> list[list[Proposal]]:
        return [[Proposal(base.scenario)] * (count + 1) for base in self.bases]

    def tell(self, outcomes: Sequence[Sequence[Outcome]]) -> None:
        raise AssertionError


def test_a_generator_cannot_overdraw_its_budget(bases: list[Base]) -> None:
    with pytest.raises(ConfigError, match=r"generator greedy: expected up to 2 proposals for each of 2 bases"):
        search(Greedy(bases), bases, trials(), budget=2)


def test_what_cannot_be_built_is_a_failed_outcome(bases: list[Base]) -> None:
    base = bases[0]
    inside = dataclasses.replace(base.scenario, placements=(Pose(*base.trace.route[0].tolist(), 0.0),))
    failed, ran = trials().run([(base, Proposal(inside)), (base, Proposal(base.scenario))])
    assert "stands in the" in failed.failure
    assert not failed.is_valid
    assert failed.gap is None
    assert failed.danger == -100.0
    assert ran.failure == ""
    with pytest.raises(ConfigError, match="a proposal that failed is no scenario"):
        scenario_of(failed, base, name="x")


class Rammer:
    """Takes over whom it is told, and drives at the ego."""

    name = "rammer"
    controller = Controller.EXTERNAL

    def reset(self, episodes: Any) -> None: ...

    def act(self, view: Observation) -> np.ndarray:
        throttle = np.ones(len(view.speed))
        return np.stack([throttle, 0 * throttle, 0 * throttle], 1).astype(np.float32)


def test_who_is_taken_over_is_the_adversary_and_is_saved_as_it_moved(natural: Base, tmp_path: Any) -> None:
    def nearest(state: WorldState) -> Bool:
        chosen = np.zeros(state.active.shape, bool)
        chosen[:, 2] = state.active[:, 2]
        return chosen

    drivers = {nearest: Rammer()}
    (outcome,) = trials("autopilot").run([(natural, Proposal(natural.scenario, drivers=drivers))])
    assert outcome.adversaries == (2,)
    assert outcome.trace is not None
    assert outcome.trace.speed[-1, 2] > 15.0
    assert outcome.off_road or outcome.hit_others  # full throttle straight on leads somewhere
    saved = scenario_of(outcome, natural, name="found/1")
    assert saved.type == "Custom"
    save_scenarios(tmp_path / "found.yaml", saved)
    assert read_scenarios(tmp_path / "found.yaml") == (saved,)
    again = trials("autopilot").base(saved, natural.graph, seed=99)
    rows = min(len(again.trace.x), len(outcome.trace.x))
    agent = again.trace.names.index(outcome.trace.names[2])
    assert np.abs(again.trace.x[:rows, agent] - outcome.trace.x[:rows, 2]).max() < 0.02
    assert np.abs(again.trace.y[:rows, agent] - outcome.trace.y[:rows, 2]).max() < 0.02


def test_who_still_moves_at_the_end_of_a_recording_brakes_to_a_stop(natural: Base) -> None:
    trace = natural.trace
    cut = dataclasses.replace(
        trace, **{n: getattr(trace, n)[:60] for n in ("x", "y", "yaw", "speed", "active", "contact")}
    )
    moving = [a for a in range(1, len(trace.names)) if cut.active[-1, a] and cut.speed[-1, a] > 3.5]
    scenario = freeze_episode(natural.episode, cut)
    assert moving
    for agent in moving:
        actor = next(a for a in scenario.actors if a.name == trace.names[agent])
        rows = np.array(actor.trajectory)
        after = rows[rows[:, 0] >= 5.9]
        speed = float(cut.speed[-1, agent])
        assert math.dist(after[0, 1:3], after[-1, 1:3]) == pytest.approx(speed**2 / 8.0, abs=0.3)
        assert rows[-1, 0] > natural.episode.limits.max_steps * 0.1


def test_a_scenario_of_parameters_stays_one(bases: list[Base]) -> None:
    generator = generator_factory("halton")(bases, seeds=[1, 2], budget=1)
    (outcome,), _ = search(generator, bases, trials(), budget=1)
    saved = scenario_of(outcome, bases[0], name="found/2")
    assert saved.type == bases[0].scenario.type
    episode = build_episode(saved, bases[0].graph, seed=77)
    again = trials().base(saved, bases[0].graph, seed=77)
    assert episode.agents[1].pose == again.episode.agents[1].pose
    assert outcome.trace is not None
    assert np.array_equal(again.trace.x, outcome.trace.x)


def test_an_unknown_generator_shows_the_closest() -> None:
    with pytest.raises(UnknownNameError, match=r"unknown generator 'halten'; closest: halton.*ssad list generators"):
        generator_factory("halten")
    assert "random points" in generator_list()["random"].lower() or generator_list()["random"]


def ahead(speed: float, x: float, y: float = 0.0, yaw: float = 0.0) -> tuple[Any, ...]:
    step = 0.1 * np.arange(31)
    return (x + speed * step * math.cos(yaw), y + speed * step * math.sin(yaw), yaw, speed)


@pytest.fixture(scope="module")
def graph() -> Any:
    return load_town("Twinford")


def test_a_contact_with_an_adversary_is_measured(graph: Any) -> None:
    contact = np.zeros(31, np.uint8)
    contact[20] = 1
    who = np.where(contact, 1, -1).astype(np.int32)
    y = 9000.0  # far from any lane, so that nobody drives against traffic
    bodies = [ahead(8, 0, y), ahead(6, 30, y, math.pi), ahead(0, 500, y)]
    trace = make_trace(31, bodies, contact=contact, contact_agent=who)
    hit = measure(Proposal(load_scenarios("precrash")[0]), trace, graph, [1, 2])
    assert hit.collision
    assert (hit.time, hit.impact_speed, hit.ego_speed) == pytest.approx((2.0, 14.0, 8.0))
    assert hit.gap == 0.0
    assert hit.danger == pytest.approx(1.4)
    assert hit.proof_value == pytest.approx(2.4)
    assert dataclasses.replace(hit, ego_speed=0.2).proof_value == -0.5
    assert dataclasses.replace(hit, off_road=True).proof_value == -1.0
    other = measure(Proposal(load_scenarios("precrash")[0]), trace, graph, [2])
    assert not other.collision
    assert other.impact_speed is None
    assert other.gap == pytest.approx(500 - 24 - 4, abs=0.1)
    nobody = measure(Proposal(load_scenarios("precrash")[0]), trace, graph, [])
    assert nobody.gap is None
    assert nobody.within_limits is None


def test_an_adversary_that_touches_another_is_seen(graph: Any) -> None:
    proposal = Proposal(load_scenarios("precrash")[0])
    trace = make_trace(31, [ahead(0, 0), ahead(10, 50), ahead(0, 70)])
    assert measure(proposal, trace, graph, [1]).hit_others
    assert not measure(proposal, make_trace(31, [ahead(0, 0), ahead(10, 50), ahead(0, 90)]), graph, [1]).hit_others
    beside_at_start = make_trace(31, [ahead(0, 0), ahead(0, 50), ahead(0, 53)])
    assert not measure(proposal, beside_at_start, graph, [1]).hit_others


def test_an_adversary_that_leaves_the_road_is_seen_and_one_that_joins_it_is_not(graph: Any) -> None:
    lane = int(np.flatnonzero((graph.kind == 1) & (graph.junction < 0) & (graph.length > 40))[0])
    span = graph.points(lane)
    (x0, y0), (x1, y1) = graph.xy[span][len(graph.xy[span]) // 2 :][:2].tolist()
    middle, yaw = (x0, y0), math.atan2(y1 - y0, x1 - x0)
    away = yaw + math.pi / 2
    proposal = Proposal(load_scenarios("precrash")[0])
    leaves = make_trace(31, [ahead(0, 500), ahead(9, *middle, away)])
    assert measure(proposal, leaves, graph, [1]).off_road
    start = (middle[0] + 27 * math.cos(away), middle[1] + 27 * math.sin(away))
    joins = make_trace(31, [ahead(0, 500), ahead(9, *start, away + math.pi)])
    assert not measure(proposal, joins, graph, [1]).off_road
    for kind in (5, 6):  # cyclists and walkers may
        walker = dataclasses.replace(leaves, kind=np.array([1, kind], np.uint8))
        assert not measure(proposal, walker, graph, [1]).off_road


def test_an_adversary_that_comes_to_drive_against_traffic_leaves_its_road(graph: Any) -> None:
    lane = int(np.flatnonzero((graph.kind == 1) & (graph.junction < 0) & (graph.length > 60) & (graph.left >= 0))[0])
    opposite = int(graph.left[lane])
    assert graph.road[lane] == graph.road[opposite]
    assert graph.forward[lane] != graph.forward[opposite]
    at = 10.0 + np.arange(31.0)  # m along the lane: 10 m/s
    x, y, yaw, _ = graph.along(lane, at).T
    width = 0.5 * (graph.width[graph.points(lane)][0] + graph.width[graph.points(opposite)][0])

    def leaves(lateral: Any, heading: float = 0.0, kind: int = 1) -> bool:
        body = (x - lateral * np.sin(yaw), y + lateral * np.cos(yaw), yaw + heading, 10.0)
        trace = dataclasses.replace(make_trace(31, [ahead(0, 500, 9000.0), body]), kind=np.array([1, kind], np.uint8))
        return measure(Proposal(load_scenarios("precrash")[0]), trace, graph, [1]).off_road

    side = width * np.clip((np.arange(31) - 5) / 10, 0, 1)
    assert not leaves(0.0)
    assert not leaves(side, math.pi)  # it faces the other way: from the wrong side to its own
    assert leaves(side)
    assert leaves(side, kind=5)  # a cyclist may leave the road, but not ride against traffic
    assert not leaves(side, kind=6)
    assert not leaves(width)  # it has left nothing


def test_efforts_beyond_a_body_are_seen(graph: Any) -> None:
    proposal = Proposal(load_scenarios("precrash")[0])

    def effort(speed: np.ndarray) -> Outcome:
        x = 20 + np.concatenate([[0.0], np.cumsum(0.1 * speed[:-1])])
        return measure(proposal, make_trace(31, [ahead(0, 500), (x, 0.0, 0.0, speed)]), graph, [1])

    gentle = effort(5 + 0.2 * np.arange(31))
    assert gentle.acceleration == pytest.approx(2.0, abs=0.01)
    assert gentle.within_limits
    strong = effort(5 + 0.6 * np.arange(31))
    assert strong.acceleration == pytest.approx(6.0, abs=0.01)
    assert not strong.within_limits
    jerky = effort(np.where(np.arange(31) < 15, 5 + 0.34 * np.arange(31), 5 + 0.34 * 15 - 0.7 * (np.arange(31) - 15)))
    assert jerky.jerk is not None
    assert jerky.jerk > 12.65 * 1.1
    assert not jerky.within_limits


def test_an_entry_point_makes_generators_from_files(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    package, info = tmp_path / "acme_programs.py", tmp_path / "acme_programs-1.0.dist-info"
    package.write_text("def program(file):\n    return lambda bases, *, seeds, budget: (file, budget)\n")
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: acme-programs\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[ssad.generator_files]\nprogram = acme_programs:program\n")
    monkeypatch.syspath_prepend(tmp_path)
    factory: Any = generator_factory("program:C:/drives/brake.prg")
    assert factory([], seeds=[], budget=3) == ("C:/drives/brake.prg", 3)
    with pytest.raises(ConfigError, match="importing programme failed"):
        generator_factory("programme:brake.prg")


def test_scenic_is_offered_to_those_who_have_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ssad.interchange.scenic_programs.find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=r"scenic:a\.scenic.*extra scenic"):
        generator_factory("scenic:a.scenic")
