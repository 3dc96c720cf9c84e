"""Scenic programs in the embedded world: what they have bodies do, what becomes of samples, what is refused.

They need an environment of their own: `python -m benchmarks.extras scenic`. Where SCENIC_EXAMPLES names a folder of
Scenic's own examples, such as examples/driving of its repository, all of them are run.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from helpers.command import ssad

from ssad.core.import_report import ImportReport
from ssad.core.types import Controller, Episode, EpisodeAgent, EpisodeLimits, Pose, Scenario
from ssad.drivers import make_system
from ssad.interchange.scenic_programs import ScenicProgram, load_program, map_of, sample
from ssad.scenarios.dynamic import build_episode, read_scenarios
from ssad.scenarios.dynamic.generate import Trials, generator_factory, search
from ssad.world.roads import load_town
from ssad.world.rollout import rollout
from ssad.world.world import World

pytest.importorskip("scenic", reason="the extra 'scenic' is not installed", exc_type=ImportError)
pytestmark = pytest.mark.filterwarnings("ignore")  # Scenic's
TOWN = "Twinford"

BRAKING = """
param map = localPath('nowhere/Town99.xodr')
model scenic.domains.driving.model

behavior LeadBehavior():
    do FollowLaneBehavior(8) for 4 seconds
    while True:
        take SetThrottleAction(0), SetBrakeAction(1)

behavior EgoBehavior():
    try:
        do FollowLaneBehavior(8)
    interrupt when withinDistanceToAnyCars(self, 12):
        take SetThrottleAction(0), SetBrakeAction(1)

lane = Uniform(*filter(lambda l: l.centerline.length > 90, network.lanes))
spot = new OrientedPoint on lane.centerline
require (distance from spot to lane.centerline[-1]) > 50
require (distance from spot to lane.centerline[0]) > 35
lead = new Car at spot, with behavior LeadBehavior()
ego = new Car following roadDirection from spot for -30, with behavior EgoBehavior()
walker = new Pedestrian right of spot by 6, with regionContainedIn None
terminate after 9 seconds
"""

CONTROLS = """
model ssad.interchange.scenic_model

behavior Full():
    take SetThrottleAction(1), SetSteerAction(-0.05)
    while True:
        wait

behavior Across():
    take SetWalkingDirectionAction(90 deg), SetWalkingSpeedAction(1.5)
    for k in range(20):
        wait
    take SetWalkingSpeedAction(0)

lane = network.lanes[0]
ego = new Car at lane.centerline[0], with behavior Full(), with regionContainedIn None, with width 2.06, with length 4.9
walker = new Pedestrian at ego offset by (60 @ 60), facing 0 deg, with regionContainedIn None, with behavior Across()
terminate after 3 seconds
"""


def written(folder: Path, text: str, name: str = "program.scenic") -> Path:
    path = folder / name
    path.write_text(text)
    return path


@pytest.fixture(scope="module")
def braking(tmp_path_factory: pytest.TempPathFactory) -> ScenicProgram:
    return load_program(written(tmp_path_factory.mktemp("scenic"), BRAKING, "braking.scenic"), TOWN)


def test_a_program_of_the_driving_library_runs_unchanged(braking: ScenicProgram) -> None:
    """The leader drives for 4 s and brakes; the ego, whose behaviour sees it, stops behind."""
    report = ImportReport("program")
    drawn = sample(braking, 3, report=report)
    lead, walker = drawn.scenario.actors
    assert (drawn.scenario.town, drawn.scenario.name, walker.trajectory) == (TOWN, "braking/03", ())
    assert (lead.name, lead.model, walker.model) == ("Car-1", "suv", "walker")
    assert "9 seconds" in drawn.end_reason or "time" in drawn.end_reason
    assert any("4.5 x 2 m object becomes 'suv'" in reason for reason in report.omissions)
    rows = np.array(lead.trajectory)
    driven = np.r_[0.0, np.cumsum(np.hypot(*np.diff(rows[:, 1:3], axis=0).T))]
    at = np.interp((4.0, 6.5, 9.0), rows[:, 0], driven)
    assert 12.0 < at[0] < 35.0
    assert at[2] - at[1] < 0.3
    assert sample(braking, 3).scenario == drawn.scenario
    assert sample(braking, 4).scenario != drawn.scenario


def test_a_sample_is_driven_by_any_system(braking: ScenicProgram) -> None:
    episode = build_episode(sample(braking, 3).scenario, load_town(TOWN), seed=0)
    world = World([episode, episode], {TOWN: load_town(TOWN)})
    careful, _ = rollout(world, make_system("autopilot"))
    blind = rollout(World([episode], {TOWN: load_town(TOWN)}), make_system("blind"))[0]
    assert blind.end == "collision"
    assert careful.end != "collision"


def test_bodies_move_as_the_world_moves_them(tmp_path: Path) -> None:
    """Full throttle and a turned wheel as a driver of the world gives them; a walker goes where it is told."""
    from ssad.interchange.scenic_programs import SCENES

    program = load_program(written(tmp_path, CONTROLS), TOWN)
    scene, _ = program.compiled.generate(maxIterations=SCENES)
    drive = program.compiled.getSimulator().simulate(scene, maxSteps=40)
    rows = np.stack(drive.rows)
    assert len(rows) == 31
    start = Pose(*rows[0, 0, :3].tolist())
    line = (
        build_episode(
            Scenario("x", "Custom", TOWN, (start, Pose(*load_town(TOWN).at(0, 40.0)[:3]))), load_town(TOWN), seed=0
        )
        .agents[0]
        .route
    )
    ego = EpisodeAgent("ego", "car", Controller.EXTERNAL, start, route=line)
    scenario = Scenario("x", "Custom", TOWN, (start, start))
    limits = EpisodeLimits(max_steps=400, contact="count")
    world = World([Episode("x", scenario, TOWN, (ego,), limits=limits)], {TOWN: load_town(TOWN)})
    for row in rows[1:]:
        world.step(np.array([[[1.0, 0.0, 0.05, 0.0]]], np.float32))
        assert np.abs(world.state().pose[0, 0] - row[0, :3]).max() < 1e-4
    walked = rows[:, 1, :2] - rows[0, 1, :2]
    assert walked[-1] == pytest.approx((-3.0, 0.0), abs=0.32)  # 90 degrees left of north, 1.5 m/s for 2 s
    assert np.hypot(*(walked[-1] - walked[-5])) < 1e-6


def test_a_program_is_a_generator(braking: ScenicProgram) -> None:
    scenario = sample(braking, 3, name="base").scenario
    trials = Trials(ego=lambda: make_system("blind"))
    base = trials.base(scenario, load_town(TOWN), seed=0)
    factory = generator_factory(f"scenic:{braking.path}")
    (found,) = search(factory([base], seeds=[5], budget=3), [base], trials, budget=3)
    assert len(found) == 3
    assert any(outcome.collision for outcome in found)
    (again,) = search(factory([base], seeds=[5], budget=3), [base], trials, budget=3)
    assert [o.proposal.scenario for o in again] == [o.proposal.scenario for o in found]


def test_command(braking: ScenicProgram, tmp_path: Path) -> None:
    done = ssad("import", "scenic", braking.path, tmp_path / "a.yaml", "--map", TOWN, "--count", "2", "--steps", "40")
    assert done.returncode == 0, done.stderr
    assert [s.name for s in read_scenarios(tmp_path / "a.yaml")] == ["braking/00", "braking/01"]
    assert "2 scenarios in Twinford" in done.stdout
    assert "not carried over: the body of a 4.5 x 2 m object becomes 'suv' (2 times)" in done.stdout


HEAD = "model scenic.domains.driving.model\n"
LINE = "lane = Uniform(*filter(lambda l: l.centerline.length > 90, network.lanes))\n"
HOSTILE: dict[str, tuple[str, str]] = {
    "no Scenic": ("ego = = new Car\n", "bad.scenic:1"),
    "binary": ("\x00\x01\x02", "bad.scenic"),
    "empty": ("", "no ego"),
    "no ego": (HEAD + "new Car\n", "no ego"),
    "unknown name": (HEAD + "ego = new Spaceship\n", "NameError: name 'Spaceship' is not defined"),
    "unknown module": ("import nothing_of_that_name\n", "bad.scenic:1: ModuleNotFoundError"),
    "an exception": (HEAD + "raise ValueError('so it is')\n", "bad.scenic:2: ValueError: so it is"),
    "the end": (HEAD + "import sys\nsys.exit(0)\n", "bad.scenic:3: SystemExit"),
    "impossible": (HEAD + "ego = new Car\nrequire ego.position.x > 1e9\n", "none of 40 scenes"),
    "broken on the way": (
        HEAD + "behavior B():\n    take SetThrottleAction(7)\nego = new Car with behavior B()\n",
        "range [0.0, 1.0]",
    ),
    "an impossible drive": (HEAD + "ego = new Car\nrequire eventually ego.speed > 500\n", "none of 10 simulations"),
    "no such action": (
        HEAD + "behavior B():\n    take SetSteerAction(0)\nego = new Car\nnew Pedestrian with behavior B()\n",
        "action",
    ),
    "another step": (HEAD + "param timestep = 0.5\nego = new Car\n", "a step has 0.1 s"),
    "too many": (
        HEAD + LINE + "ego = new Car\nfor k in range(80):\n    new Pedestrian with regionContainedIn None, "
        "at (5000 + 5*k) @ 5000\n",
        "81 objects, at most",
    ),
    "off the road": (HEAD + "ego = new Car at 5000 @ 5000, with regionContainedIn None\n", "road"),
    "later": (
        HEAD + "scenario Sub():\n    setup:\n        new Pedestrian with regionContainedIn None, at 5000 @ 5000\n"
        "scenario Main():\n    setup:\n        ego = new Car\n    compose:\n        wait\n        do Sub()\n",
        "cannot appear while",
    ),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_broken_and_hostile_programs_are_refused_in_one_line(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text, message = HOSTILE[name]
    monkeypatch.setattr("ssad.interchange.scenic_programs.SCENES", 40)
    path = written(tmp_path, text, "bad.scenic")
    done = ssad("import", "scenic", path, tmp_path / "out.yaml", "--map", TOWN, "--steps", "5")
    assert done.returncode == 2, done.stdout
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert message in done.stderr
    assert "bad.scenic" in done.stderr
    assert not (tmp_path / "out.yaml").exists()


def test_maps_and_files_that_there_are_not(tmp_path: Path) -> None:
    path = written(tmp_path, f"param map = r'{map_of(TOWN)}'\n" + HEAD + "ego = new Car\n")
    assert load_program(path).town == TOWN
    for words, message in (
        ((path, tmp_path / "a.yaml", "--map", "Atlantis"), "unknown town 'Atlantis'"),
        ((tmp_path / "none.scenic", tmp_path / "a.yaml"), "no such Scenic program"),
        ((path, tmp_path / "a.txt"), "ends in .yaml"),
    ):
        done = ssad("import", "scenic", *words)
        assert done.returncode == 2
        assert len(done.stderr.splitlines()) == 1
        assert message in done.stderr


EXAMPLES = os.environ.get("SCENIC_EXAMPLES", "")
FOUND = sorted(Path(EXAMPLES).rglob("*.scenic")) if EXAMPLES else []


@pytest.mark.slow
@pytest.mark.skipif(not FOUND, reason="SCENIC_EXAMPLES names no folder of Scenic programs")
@pytest.mark.parametrize("path", FOUND, ids=lambda path: path.relative_to(EXAMPLES).as_posix())
def test_examples_of_scenic_run_unchanged(path: Path) -> None:
    town = os.environ.get("SCENIC_TOWN", "ProvingGround")
    drawn = sample(load_program(path, town), 0)
    episode = build_episode(drawn.scenario, load_town(town), seed=0)
    (trace,) = rollout(World([episode], {town: load_town(town)}), make_system("autopilot"))
    assert trace.end
