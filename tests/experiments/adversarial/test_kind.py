"""The kind adversarial: equal terms for all generators, what a search's record says, and what is saved of it."""

from __future__ import annotations

import dataclasses
import io
import itertools
import math
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.command import ssad
from helpers.metric_traces import make_trace
from rich.console import Console

from ssad.core import safeio
from ssad.core.errors import ConfigError
from ssad.core.generators import Outcome, Proposal
from ssad.core.jsonl import read_lines
from ssad.core.traces import load_trace
from ssad.drivers import make_system
from ssad.engine.kind import Job, Resources
from ssad.engine.run import run
from ssad.experiments.adversarial.found_collisions import has_proof, proven_bases, ranked_collisions
from ssad.experiments.adversarial.kind import Adversarial
from ssad.experiments.adversarial.search_scores import distinct_collisions, summary
from ssad.experiments.runs import write_report
from ssad.experiments.suites import load_suite
from ssad.report.compare import compare_runs
from ssad.scenarios.dynamic import load_scenarios, read_scenarios
from ssad.scenarios.dynamic.generate import Trials
from ssad.world.roads import load_town

(SCENARIO,) = load_scenarios("UnprotectedLeftTurn/00")
STEP = 0.1 * np.arange(31)


def hit(offset: float = 0.0, *, speed: float = 8.0, **changes: Any) -> Outcome:
    """The ego meets who comes from the other side, `offset` m beside it."""
    contact = (np.arange(31) == 30).astype(np.uint8)
    trace = make_trace(
        31,
        [(speed * STEP, 0.0, 0.0, speed), (50 - 8 * STEP, offset, np.pi, 8.0)],
        contact=contact,
        contact_agent=np.where(contact, 1, -1).astype(np.int32),
    )
    outcome = Outcome(Proposal(SCENARIO), trace=trace, adversaries=(1,), collision=True, time=3.0, gap=0.0)
    return dataclasses.replace(outcome, ego_speed=speed, impact_speed=16.0, **changes)


def test_copies_of_a_collision_count_once() -> None:
    one, copy, other = hit(), hit(0.3), hit(2.0)
    assert distinct_collisions([one, copy, other]) == [one, other]
    assert distinct_collisions([]) == []


def test_a_record_says_what_was_found_and_how_often_not() -> None:
    miss = Outcome(Proposal(SCENARIO), trace=hit().trace, gap=3.0)
    failed = Outcome(Proposal(SCENARIO), failure="no room")
    found = summary([miss, hit(off_road=True), hit(within_limits=True, jerk=4.0), hit(3.0, speed=0.0), failed])
    assert found["CR"]
    assert found["CR_any"]
    assert found["rollouts"] == 3
    assert found["share"] == pytest.approx(2 / 5)
    assert found["off_road"] == pytest.approx(1 / 4)
    assert found["distinct"] == 2
    assert found["moving"] == pytest.approx(0.5)
    assert found["within_limits"] == 1.0
    assert found["jerk"] == 4.0
    nothing = summary([miss, hit(hit_others=True)])
    assert not nothing["CR"]
    assert nothing["CR_any"]
    assert nothing["rollouts"] is None
    assert nothing["impact_speed"] is None


AVOIDED = {"avoided_by_cc": 0.0, "avoided_by_reg157": 1.0, "avoided_by_rss": 0.0, "avoided_by_fsm": 0.0}


def replay(*, end: str = "collision", yaw: float = 0.0, ego_speed: float = 8.0) -> Any:
    """A saved collision, driven again: the ego reaches a car that goes 3 m/s, on the road's own lane by default."""
    graph = load_town("ProvingGround")
    lane = int(np.flatnonzero((graph.kind == 1) & (graph.junction < 0) & (graph.length > 80))[0])
    x, y, heading, _ = graph.at(lane, 10.0)
    cos, sin = np.cos(heading), np.sin(heading)
    along, ahead = ego_speed * STEP, 20.0 + 3.0 * STEP * np.cos(yaw)
    contact = (np.arange(31) == 30).astype(np.uint8)
    trace = make_trace(
        31,
        [
            (x + along * cos, y + along * sin, heading, ego_speed),
            (x + ahead * cos, y + ahead * sin, heading + yaw, 3.0),
        ],
        contact=contact,
        contact_agent=np.where(contact, 1, -1).astype(np.int32),
        end=end,
    )
    return SimpleNamespace(scenario=SCENARIO, graph=graph, trace=trace, episode=None)


def test_a_base_has_a_proof_if_a_saved_collision_meets_every_condition_again() -> None:
    unavoided = dict.fromkeys(AVOIDED, 0.0) | {"avoided_by_limit": 1.0}
    name = [("agent1",)]
    assert has_proof([replay()], name, [AVOIDED]) is True
    assert has_proof([replay()], name, [unavoided]) is False  # a manoeuvre with knowledge of the future is no driver
    assert has_proof([replay()], name, None) is None
    assert has_proof([replay()], [("agent2",)], [AVOIDED]) is False
    assert has_proof([replay(yaw=math.pi)], name, [AVOIDED]) is False
    assert has_proof([replay(yaw=math.pi, ego_speed=0.0)], name, None) is False  # no grade can prove it
    assert has_proof([replay(ego_speed=0.0)], name, [AVOIDED]) is False
    assert has_proof([replay(end="complete"), replay()], name * 2, [AVOIDED]) is True  # grades are of collisions alone
    assert has_proof([replay(end="complete")], name, []) is False
    assert has_proof([replay(), replay()], name * 2, [unavoided, AVOIDED]) is True


def test_collisions_that_may_be_proven_are_saved_first() -> None:
    base: Any = SimpleNamespace(graph=load_town("ProvingGround"))

    def outcome(drive: Any) -> Outcome:
        proposal = Proposal(SCENARIO)
        return Outcome(proposal, trace=drive.trace, adversaries=(1,), collision=True, time=3.0, gap=0.0)

    standing, moving = outcome(replay(ego_speed=0.0)), outcome(replay())
    assert ranked_collisions([standing, moving], base) == [moving, standing]
    assert ranked_collisions([dataclasses.replace(moving, off_road=True), standing], base) == [standing]


def test_candidates_alone_are_driven_again_and_graded(monkeypatch: pytest.MonkeyPatch) -> None:
    drives = [replay(), replay(ego_speed=0.0), replay(), replay()]
    bases: Any = [SimpleNamespace(graph=drive.graph, episode=SimpleNamespace(seed=7)) for drive in drives]
    rows = [
        [Outcome(Proposal(SCENARIO), trace=drive.trace, adversaries=(1,), collision=True, time=3.0)] for drive in drives
    ]
    driven: list[Any] = []

    def drive_again(episodes: Any) -> list[Any]:
        driven.extend(episodes)
        return [replay(), replay(), replay(end="complete")]

    avoiders = [{"cc": True, "rss": False}, {"cc": False, "rss": False}]
    monkeypatch.setattr("ssad.scenarios.dynamic.generate.scenario_of", lambda outcome, base, name: outcome)
    monkeypatch.setattr("ssad.simulators.proofs.avoiders_of", lambda drives, device: avoiders[: len(drives)])
    trials: Any = SimpleNamespace(bases=drive_again, device="cpu")
    assert proven_bases(bases, rows, trials, limit=1) == [True, False, False, False]
    assert [(outcome, seed) for outcome, _, seed in driven] == [(rows[k][0], 8) for k in (0, 2, 3)]


def test_generators_and_systems_meet_the_same_bases_with_the_same_seeds() -> None:
    suite = load_suite("adversarial-quick", ["systems=[autopilot,blind]", "repetitions=2"])
    plan = Adversarial().plan(suite)
    seeds: dict[tuple[str, int], set[int]] = {}
    for cell in plan.cells:
        seeds.setdefault((cell.fields["cluster"], cell.spec["repetition"]), set()).add(cell.seed)
    assert all(len(found) == 1 for found in seeds.values())
    assert len({min(found) for found in seeds.values()}) == len(seeds) == 16
    assert len({cell.key for cell in plan.cells}) == len(plan.cells) == len(suite.generators) * 2 * 16


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["generators=[rendom]"], "unknown generator 'rendom'; closest: random"),
        (["generators=[random,random]"], "generators: a name appears twice"),
        (["budget=0"], "budget"),
    ],
)
def test_wrong_suites_are_told_in_a_line(settings: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Adversarial().plan(load_suite("adversarial-quick", settings))


def test_a_generator_without_anything_to_search_is_told_before_anything_runs(tmp_path: Path) -> None:
    scenario = {"name": "mine", "type": "Custom", "town": SCENARIO.town}
    scenario["route"] = [{"x": p.x, "y": p.y, "yaw": p.yaw} for p in SCENARIO.route]
    (tmp_path / "mine.yaml").write_text(safeio.dump_json(scenario))
    out = ssad("run", "adversarial-quick", "--set", f"scenarios={tmp_path / 'mine.yaml'}", "--out", tmp_path / "out")
    assert out.returncode == 2
    assert "scenario mine: its type Custom has no parameters of other agents to search" in out.stderr


RANGES = """\
name: my/crossing
type: Custom
town: ProvingGround
route: [{x: 217.0, y: -5.25}, {x: 317.0, y: -5.25}]
target_speed: 10.0
parameters:
  ego_speed: 10
  walk: {value: 1.5, range: [0.5, 3.0]}
  distance: {value: 20.0, range: [10, 40]}
limits: {max_steps: 40}
actors:
- name: walker
  model: walker
  pose: {x: 247.0, y: -9.0, yaw: pi / 2}
  phases: [{speed: walk, when: {kind: ego_distance, value: distance}}]
"""


@pytest.mark.parametrize("generator", ["random", "halton", "cma-es", "bayesian", "l2c"])
def test_the_ranges_of_a_scenario_with_actors_of_its_own_are_searched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, generator: str
) -> None:
    outcomes: list[Outcome] = []
    run_trials = Trials.run

    def recording_run(trials: Trials, proposals: Any) -> list[Outcome]:
        outcomes.extend(batch := run_trials(trials, proposals))
        return batch

    monkeypatch.setattr(Trials, "run", recording_run)
    (tmp_path / "mine.yaml").write_text(RANGES)
    settings = [f"generators={generator}", "budget=12", "keep=0", "grade=false", "systems=autopilot"]
    plan = Adversarial().plan(load_suite("adversarial-quick", [*settings, f"scenarios={tmp_path / 'mine.yaml'}"]))
    (line,) = Adversarial().execute([plan.cells[0]], Job(tmp_path, "cpu", {})).values()
    assert (line["metrics"]["applies"], line["n"]) == (True, 12)
    # Nothing is saved, so a collision can be neither proven nor not.
    assert line["metrics"]["proven"] == (None if line["metrics"]["CR"] else False)
    points = {
        (actor.phases[0].speed or 0.0, actor.phases[0].when.value)
        for outcome in outcomes
        for actor in outcome.proposal.scenario.actors
    }
    assert len(points) >= 11
    assert all(0.5 <= walk <= 3.0 and 10.0 <= distance <= 40.0 for walk, distance in points)
    assert not any(outcome.failure for outcome in outcomes)


def test_a_base_that_a_generator_cannot_change_is_recorded_and_the_others_are_searched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kind = Adversarial()
    settings = ["generators=king", "budget=1", "scenarios=[StraightObstacle/00]"]
    with pytest.raises(ConfigError, match=r"generator king: scenario StraightObstacle/00: there is no vehicle in it"):
        kind.plan(load_suite("adversarial-quick", settings))
    plan = kind.plan(load_suite("adversarial-quick", [*settings[:2], "scenarios=[StraightObstacle/00,RightTurn/00]"]))
    refused = plan.cells[0]
    (line,) = kind.execute([refused], Job(tmp_path, "cpu", {})).values()
    assert line["metrics"] == {"applies": False, "survived": True}
    assert "there is no vehicle in it" in line["refused"]


def test_a_search_is_recorded_and_what_it_finds_is_saved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kind = Adversarial()
    settings = [
        "generators=halton",
        "budget=20",
        "keep=1",
        "scenarios=UnprotectedLeftTurn/00",
        "systems=[autopilot,blind]",
        "transfer=[blind]",
    ]
    plan = kind.plan(load_suite("adversarial-quick", settings))
    job = Job(tmp_path, "cpu", kind.prepare(plan, tmp_path, Resources()))
    survivor, victim = plan.cells
    (line,) = kind.execute([survivor], job).values()
    metrics = line["metrics"]
    assert metrics["survived"]
    assert metrics["CR"]
    assert metrics["replayed"] == 1.0
    assert 0.0 < metrics["seconds_first"] <= metrics["seconds"]
    assert 0.0 < metrics["realism"] < 1.0
    assert 0.0 < metrics["within_published"] <= 1.0
    # the grade of the one that is saved: any careful driver, or at least a manoeuvre
    careful = [metrics[f"avoided_by_{name}"] for name in ("cc", "reg157", "rss", "fsm")]
    assert metrics["attributable"] == max(careful)
    assert metrics["avoided_by_limit"] >= metrics["attributable"]
    assert ("attributable_moving" in metrics) == (metrics["moving"] > 0.0)
    assert metrics["proven"] in (True, False)
    assert metrics["proven"] <= metrics.get("attributable_moving", 0.0)
    assert set(line["transfer"]) == {"blind"}
    assert line["transfer"]["blind"]["base"] == 1.0  # the blind follower does not survive the base either
    (saved,) = read_scenarios(tmp_path / line["artefacts"]["scenarios"])
    assert saved.name == "UnprotectedLeftTurn/00/halton-0"
    trace = load_trace(tmp_path / line["artefacts"]["trace"])
    again = Trials(lambda: make_system("autopilot")).base(saved, load_town(saved.town), seed=1)
    assert np.array_equal(trace.x, again.trace.x)
    assert again.trace.end == "collision"
    # what collides already in plain replay is not searched
    (line,) = kind.execute([victim], job).values()
    assert line["metrics"] == {"applies": True, "survived": False}


def test_equal_runs_have_the_same_hash_and_are_equal_however_long_they_take(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = ["generators=halton", "budget=8", "grade=false", "scenarios=UnprotectedLeftTurn/00", "systems=autopilot"]
    plan = Adversarial().plan(load_suite("adversarial-quick", settings), check=False)
    folders, hashes, tables = [tmp_path / "fast", tmp_path / "slow"], [], []
    for folder, tick in zip(folders, (1.0, 7.0), strict=True):
        ticks = itertools.count(0.0, tick)
        clock = SimpleNamespace(process_time=lambda ticks=ticks: next(ticks))
        monkeypatch.setattr("ssad.experiments.adversarial.kind.time", clock)
        run(plan, folder, Resources(0, console=Console(file=io.StringIO())))
        page = write_report(folder).read_text()
        hashes += re.findall(r'equal hashes">([0-9a-f]{12})<', page)
        tables.append((folder / "tables" / "adversarial.csv").read_text().splitlines())
    assert len(hashes) == 2
    assert hashes[0] == hashes[1]
    different_lines = [line for line, other in zip(*tables, strict=True) if line != other]
    assert different_lines
    assert all("CPU time a scenario" in line for line in different_lines)
    (comparison,) = compare_runs(folders)
    assert (comparison.both, comparison.equal) == (1, 1)


@pytest.mark.slow
def test_what_a_run_finds_replays_as_a_plain_scenario(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    settings = ("--set", "generators=halton", "--set", "systems=autopilot", "--set", "budget=16", "--set", "keep=2")
    scenarios = ("--set", "scenarios=[UnprotectedLeftTurn/02,UnprotectedLeftTurn/00]")
    done = ssad("run", "adversarial-quick", *settings, *scenarios, "--out", folder, "--workers", "1")
    assert done.returncode == 0, done.stderr
    lines = [line for line in read_lines(folder / "results.jsonl") if line["metrics"]["survived"]]
    found = [line for line in lines if line["metrics"]["CR"]]
    assert found
    assert all(line["metrics"]["replayed"] == 1.0 for line in found)
    file = folder / found[0]["artefacts"]["scenarios"]
    saved = read_scenarios(file)
    assert 1 <= len(saved) <= 2
    assert saved[0].name.startswith(f"{found[0]['cluster']}/halton")
    plain = tmp_path / "plain"
    again = ssad(
        "run",
        "quick",
        "--set",
        f"scenarios={file}",
        "--set",
        "systems=autopilot",
        "--set",
        "pictures=[]",
        "--out",
        plain,
        "--workers",
        "1",
    )
    assert again.returncode == 0, again.stderr
    replayed = list(read_lines(plain / "results.jsonl"))
    assert len(replayed) == len(saved)
    assert all(line["metrics"]["collision"] for line in replayed)
    first = load_trace(folder / found[0]["artefacts"]["trace"])
    same = load_trace(plain / replayed[0]["artefacts"]["trace"])
    assert np.array_equal(first.x, same.x)
    report = (folder / "report.html").read_text()
    assert "halton" in report
