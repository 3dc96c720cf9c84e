"""OpenSCENARIO: what is written is valid, and comes back as the same drive; what others write; what is refused."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.command import ssad
from helpers.generated import generated

from ssad.core.errors import FormatError
from ssad.core.types import (
    Actor,
    Body,
    Episode,
    EpisodeLimits,
    EpisodeTrace,
    LateralPhase,
    Phase,
    PhaseTrigger,
    Pose,
    Scenario,
)
from ssad.drivers import make_system
from ssad.interchange.export import export_openscenario
from ssad.interchange.openscenario_reader import read_openscenario
from ssad.metrics import episode_metrics
from ssad.scenarios.dynamic import build_episode, load_scenarios, read_scenarios
from ssad.scenarios.dynamic.frozen import freeze_episode
from ssad.world.roads import load_town
from ssad.world.rollout import rollout
from ssad.world.world import World

FEW = ("StraightObstacle/00", "LaneChanging/01", "VehiclePassing/02", "UnprotectedLeftTurn/01")
CLOSE = 0.01  # m


def drive(episodes: Sequence[Episode], system: str = "autopilot") -> list[EpisodeTrace]:
    return rollout(World(episodes, {e.town: load_town(e.town) for e in episodes}), make_system(system))


def returned(scenarios: Sequence[Scenario], folder: Path) -> list[Scenario]:
    files, _ = export_openscenario(scenarios, folder)
    return [read_openscenario(path).scenario for path in files if path.suffix == ".xosc"]


def same_drives(before: Sequence[Episode], after: Sequence[Episode], system: str) -> None:
    for one, other in zip(drive(before, system), drive(after, system), strict=True):
        assert one.names == other.names
        assert one.models == other.models
        assert one.end == other.end
        assert np.array_equal(one.active, other.active)
        off = np.hypot(one.x - other.x, one.y - other.y)[one.active]
        assert off.max() < CLOSE
        measured, again = (episode_metrics(trace).as_dict() for trace in (one, other))
        for name, value in measured.items():
            near = pytest.approx(value, rel=1e-3, abs=1e-3, nan_ok=True) if isinstance(value, float) else value
            assert again[name] == near, (one.key, name)


def built(scenarios: Sequence[Scenario]) -> list[Episode]:
    return [build_episode(scenario, load_town(scenario.town), seed=0) for scenario in scenarios]


@pytest.mark.parametrize(
    ("names", "system"),
    [
        (FEW, "blind"),
        pytest.param(("precrash",), "blind", marks=pytest.mark.slow),
        pytest.param(("precrash",), "autopilot", marks=pytest.mark.slow),
    ],
)
def test_a_scenario_comes_back_as_the_same_drive(names: Sequence[str], system: str, tmp_path: Path) -> None:
    scenarios = [scenario for name in names for scenario in load_scenarios(name)]
    again = returned(scenarios, tmp_path)
    assert [s.name for s in again] == [s.name for s in scenarios]
    same_drives(built(scenarios), built(again), system)


def waiting(first: PhaseTrigger) -> Scenario:
    """Somebody who goes by the ego, 1.5 s later slower, and stands 2 s after that."""
    phases = (
        Phase(0.0, first),
        Phase(6.0, PhaseTrigger("after", 1.5)),
        Phase(1.0, PhaseTrigger("after", 2.0)),
        Phase(0.0, PhaseTrigger("after", 2.5)),
    )
    car = Actor("car", "suv", Pose(242.0, -1.75, 0.0), phases=phases)
    route = (Pose(217.0, -5.25), Pose(317.0, -5.25))
    return Scenario("waits/00", "Custom", "ProvingGround", route, actors=(car,), limits=EpisodeLimits(max_steps=160))


@pytest.mark.parametrize("first", [PhaseTrigger("ego_distance", 15.0), PhaseTrigger("after", 1.0)])
def test_waits_come_back(first: PhaseTrigger, tmp_path: Path) -> None:
    """Phases that begin so long after another, whenever that begins."""
    scenario = waiting(first)
    (again,) = returned([scenario], tmp_path)
    told = [phase.when for phase in again.actors[0].phases]
    assert told == [replace(first, kind="time") if first.kind == "after" else first] + [
        phase.when for phase in scenario.actors[0].phases[1:]
    ]
    for system in ("autopilot", "blind"):
        same_drives(built([scenario]), built([again]), system)


@pytest.mark.slow
def test_generated_scenarios_come_back(tmp_path: Path) -> None:
    """What four generators found, by parameters and by trajectories."""
    scenarios = generated()
    assert len(scenarios) == 20
    assert sum(any(actor.trajectory for actor in s.actors) for s in scenarios) >= 8
    same_drives(built(scenarios), built(returned(scenarios, tmp_path)), "autopilot")


@pytest.mark.parametrize("every", [75, pytest.param(7, marks=pytest.mark.slow)])
def test_trajectories_come_back(every: int, tmp_path: Path) -> None:
    """Natural traffic as it was recorded: also who appears later, and who leaves before the end."""
    natural = built(load_scenarios("natural")[::every])
    scenarios = [
        freeze_episode(e, t, name=f"seen/{k}") for k, (e, t) in enumerate(zip(natural, drive(natural), strict=True))
    ]
    late = Actor("late", "compact", Pose(0.0, 0.0), trajectory=((2.0, 0.0, 0.0, 0.0), (4.0, 10.0, 0.0, 0.0)))
    early = replace(
        late, name="early", trajectory=((-1.0, 0.0, 30.0, 0.0), (3.0, 8.0, 30.0, 0.0)), pose=Pose(0.0, 30.0)
    )
    scenarios[0] = replace(scenarios[0], actors=(*scenarios[0].actors, late, early))
    assert any(actor.trajectory for actor in scenarios[-1].actors)
    same_drives(built(scenarios), built(returned(scenarios, tmp_path)), "autopilot")


def test_what_is_not_carried_over_is_said(tmp_path: Path) -> None:
    _, lost = export_openscenario(load_scenarios("natural")[:3], tmp_path)
    assert any("waits until the ego is within" in line for line in lost)


def test_commands(tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = ssad("export", "RedlightRunning/00", "LaneChanging/00", out, "--format", "openscenario")
    assert done.returncode == 0, done.stderr
    assert sorted(p.name for p in out.iterdir()) == [
        "LaneChanging-00.xosc",
        "ProvingGround.xodr",
        "RedlightRunning-00.xosc",
    ]
    assert "not carried over: the programme of 25 other signals" in done.stdout
    done = ssad("import", "openscenario", out / "RedlightRunning-00.xosc", tmp_path / "a.yaml")
    assert done.returncode == 0, done.stderr
    (found,) = read_scenarios(tmp_path / "a.yaml")
    assert (found.name, found.signals.ego, found.signals.others) == ("RedlightRunning/00", "green", "red")
    assert ssad("export", "texture", "--help").returncode == 0
    for words in (("LaneChanging/00", "LaneChanging/00"), ("nothing",)):
        refused = ssad("export", *words, out, "--format", "openscenario")
        assert refused.returncode == 2
        assert len(refused.stderr.splitlines()) == 1


@pytest.mark.parametrize(
    ("tool", "bundle", "suffix"),
    [
        ("qc_openscenario", "xoscBundle", "xosc"),
        ("qc_opendrive", "xodrBundle", "xodr"),
    ],
)
@pytest.mark.parametrize("names", ["RedlightRunning/00", pytest.param("precrash", marks=pytest.mark.slow)])
def test_asam_checkers_find_nothing(tool: str, bundle: str, suffix: str, names: str, tmp_path: Path) -> None:
    """The pre-crash scenarios and 20 that generators found, with the maps of their towns."""
    program = shutil.which(tool)
    if program is None:
        pytest.skip(f"no {tool}: install asam-qc-openscenarioxml and asam-qc-opendrive in an environment of their own")
    more = generated() if names == "precrash" else [waiting(PhaseTrigger("ego_distance", 15.0))]
    files, _ = export_openscenario([*load_scenarios(names), *more], tmp_path)
    assert len([p for p in files if p.suffix == ".xosc"]) == (52 if names == "precrash" else 2)
    for path in (p for p in files if p.suffix == f".{suffix}"):
        (tmp_path / "config.xml").write_text(
            f'<Config><Param name="InputFile" value="{path}"/><CheckerBundle application="{bundle}">'
            f'<Param name="resultFile" value="{tmp_path}/result.xqar"/></CheckerBundle></Config>'
        )
        subprocess.run([program, "-c", tmp_path / "config.xml"], cwd=tmp_path, check=True, capture_output=True)
        found = (tmp_path / "result.xqar").read_text()
        assert 'status="completed"' in found
        assert re.findall('<Issue .*?description="(.*?)"', found) == []


@pytest.mark.parametrize("names", ["LaneChanging/00", pytest.param("generated", marks=pytest.mark.slow)])
def test_esmini_has_everybody_where_their_trajectories_do(names: str, tmp_path: Path) -> None:
    """esmini plays the files: who has a trajectory is where it says, to the centimetre; nobody stays out."""
    program = os.environ.get("ESMINI_BIN")
    if not program:
        pytest.skip("no ESMINI_BIN: the path of the program esmini")
    scenarios = generated() if names == "generated" else load_scenarios(names)
    for scenario in scenarios:
        folder = tmp_path / scenario.name.replace("/", "-")
        path = next(p for p in export_openscenario([scenario], folder)[0] if p.suffix == ".xosc")
        # esmini knows lamps that are on or off, not ScenarioRunner's "green": it plays the files without their signals
        forced = r"(?s)<GlobalAction>\s*<InfrastructureAction>.*?</GlobalAction>"
        path.write_text(re.sub(forced, "", path.read_text()))
        log = folder / "states.csv"
        words = ["--osc", path, "--headless", "--fixed_timestep", "0.05", "--csv_logger", log, "--disable_stdout"]
        subprocess.run([program, *words], cwd=folder, check=True, capture_output=True, timeout=120)
        rows = [[cell.strip() for cell in line.split(",")] for line in log.read_text().splitlines() if line]
        first = next(k for k, row in enumerate(rows) if row[0].startswith("Index"))
        head = rows[first]
        (episode,) = built([scenario])
        for agent in episode.agents[1:]:
            at = next(k for k, cell in enumerate(rows[first + 1]) if cell == agent.name)
            x, y = (next(k for k in range(at, len(head)) if f"World_Position_{axis}" in head[k]) for axis in "XY")
            here = np.array([[float(row[k]) for k in (1, x, y)] for row in rows[first + 1 :] if len(row) > y])
            if not agent.trajectory:
                assert np.hypot(*(here[0, 1:] - (agent.pose.x, agent.pose.y))) < CLOSE
                continue
            told = np.array(agent.trajectory)
            fast = np.hypot(*np.diff(told[:, 1:3], axis=0).T) / np.diff(told[:, 0]) > 2.0
            told, fast = told[1:-1], fast[1:] & fast[:-1]
            # where esmini has a sample, but for its first step
            seen = np.abs(told[:, 0] / 0.05 - np.round(told[:, 0] / 0.05)) < 1e-3
            seen &= (told[:, 0] > max(agent.trajectory[0][0], 0.0) + 0.1) & (told[:, 0] < here[-1, 0] - 0.1)
            assert (seen & fast).any()
            off = [np.abs(np.interp(told[:, 0], here[:, 0], here[:, k]) - told[:, k]) for k in (1, 2)]
            assert max(one[seen & fast].max() for one in off) < CLOSE
            assert max(one[seen].max() for one in off) < 0.1  # it smooths how somebody sets off and stops


# ---------------------------------------------------------------- other programs' files

FOREIGN = """<?xml version="1.0"?>
<OpenSCENARIO><FileHeader revMajor="1" revMinor="0" date="2020-03-20T12:00:00" description="CARLA:Cut in" author=""/>
<ParameterDeclarations><ParameterDeclaration name="fast" parameterType="double" value="9.0"/></ParameterDeclarations>
<RoadNetwork><LogicFile filepath="ProvingGround"/></RoadNetwork>
<Entities>
<ScenarioObject name="hero"><Vehicle name="vehicle.lincoln.mkz_2017" vehicleCategory="car">
 <BoundingBox><Center x="1.5" y="0" z="0.9"/><Dimensions width="2.06" length="4.9" height="1.51"/></BoundingBox>
 </Vehicle></ScenarioObject>
<ScenarioObject name="adversary"><Vehicle name="vehicle.some.body" vehicleCategory="car">
 <BoundingBox><Center x="1.5" y="0" z="0.9"/><Dimensions width="2.0" length="4.5" height="1.8"/></BoundingBox>
 </Vehicle></ScenarioObject>
</Entities>
<Storyboard><Init><Actions>
 <GlobalAction><EnvironmentAction/></GlobalAction>
 <Private entityRef="hero"><PrivateAction><TeleportAction><Position><WorldPosition x="217" y="5.25" h="0"/></Position>
  </TeleportAction></PrivateAction></Private>
 <Private entityRef="adversary"><PrivateAction><TeleportAction><Position>
  <RelativeLanePosition entityRef="hero" dLane="1" ds="20"/></Position></TeleportAction></PrivateAction></Private>
</Actions></Init>
<Story name="s"><Act name="a"><ManeuverGroup name="g" maximumExecutionCount="1">
 <Actors selectTriggeringEntities="false"><EntityRef entityRef="adversary"/></Actors><Maneuver name="m">
 <Event name="go" priority="overwrite"><Action name="go"><PrivateAction><LongitudinalAction><SpeedAction>
  <SpeedActionDynamics dynamicsShape="step" value="0" dynamicsDimension="time"/>
  <SpeedActionTarget><AbsoluteTargetSpeed value="$fast"/></SpeedActionTarget></SpeedAction></LongitudinalAction>
  </PrivateAction></Action><StartTrigger><ConditionGroup><Condition name="c" delay="0" conditionEdge="rising">
  <ByEntityCondition><TriggeringEntities triggeringEntitiesRule="any"><EntityRef entityRef="hero"/></TriggeringEntities>
  <EntityCondition><RelativeDistanceCondition entityRef="adversary" relativeDistanceType="cartesianDistance"
   value="15" freespace="false" rule="lessThan"/></EntityCondition></ByEntityCondition></Condition></ConditionGroup>
  </StartTrigger></Event>
 <Event name="cut in" priority="overwrite"><Action name="cut"><PrivateAction><LateralAction><LaneChangeAction>
  <LaneChangeActionDynamics dynamicsShape="linear" value="20" dynamicsDimension="distance"/>
  <LaneChangeTarget><RelativeTargetLane entityRef="adversary" value="-1"/></LaneChangeTarget></LaneChangeAction>
  </LateralAction></PrivateAction></Action><StartTrigger><ConditionGroup>
  <Condition name="c" delay="0" conditionEdge="rising"><ByEntityCondition>
  <TriggeringEntities triggeringEntitiesRule="any"><EntityRef entityRef="adversary"/></TriggeringEntities>
  <EntityCondition><TraveledDistanceCondition value="10"/></EntityCondition></ByEntityCondition></Condition>
  </ConditionGroup></StartTrigger></Event>
 </Maneuver></ManeuverGroup><StartTrigger/></Act></Story>
<StopTrigger><ConditionGroup><Condition name="end" delay="0" conditionEdge="none"><ByValueCondition>
 <SimulationTimeCondition value="20" rule="greaterThan"/></ByValueCondition></Condition></ConditionGroup></StopTrigger>
</Storyboard></OpenSCENARIO>
"""


def test_a_scenario_of_scenario_runner_is_driven(tmp_path: Path) -> None:
    """CARLA's frame, a place beside the ego, a trigger by distance, a parameter, a lane change after 10 m."""
    path = tmp_path / "cut_in.xosc"
    path.write_text(FOREIGN)
    found = read_openscenario(path)
    (actor,) = found.scenario.actors
    assert found.scenario.name == "Cut-in"
    assert (actor.pose.x, actor.pose.y) == pytest.approx((237.0, -1.75), abs=0.01)
    assert actor.phases == (Phase(9.0, PhaseTrigger("ego_distance", 15.0, edge="rising"), name="go", shape="step"),)
    after_10_m = PhaseTrigger("travelled", 10.0)
    assert actor.lateral == (LateralPhase(-1, when=after_10_m, name="cut in", shape="linear", distance=20.0),)
    assert (actor.model, actor.body.length, actor.body.width, actor.body.height) == ("suv", 4.5, 2.0, 1.8)
    assert found.scenario.limits.max_time == 20.0
    assert "EnvironmentAction at the start" in "\n".join(found.omissions)
    passed = replace(found.scenario, limits=replace(found.scenario.limits, contact="count"))
    (trace,) = drive(built([passed]), "blind")
    moving = np.flatnonzero(trace.speed[:, 1] > 0.0)
    gap = np.hypot(trace.x[:, 0] - trace.x[:, 1], trace.y[:, 0] - trace.y[:, 1])
    assert gap[moving[0] - 1] < 15.0 < gap[moving[0] - 2] + 1.5
    way = trace.x[:, 1] - trace.x[0, 1]
    assert np.abs(trace.y[way < 10.0, 1] + 1.75).max() < 0.2
    assert np.abs(trace.y[way > 35.0, 1] + 5.25).max() < 0.3


@pytest.mark.parametrize(
    ("name", "category", "size", "model"),
    [
        ("NCAP_GlobalVehicleTarget", "car", (4.023, 1.712, 1.427), "euroncap_vehicle"),
        ("GVT", "car", (4.1, 1.712, 1.427), "euroncap_vehicle"),
        ("NCAP_Bicycle", "bicycle", (1.89, 0.5, 1.2), "euroncap_bicycle"),
        ("EMT", "motorbike", (2.08, 0.79, 1.06), "euroncap_motorcycle"),
        ("NCAP_Adult", "pedestrian", (0.6, 0.5, 1.8), "euroncap_adult"),
        ("EPTc", "pedestrian", (0.711, 0.298, 1.154), "euroncap_child"),
    ],
)
def test_a_test_target_is_known_by_its_name(
    name: str, category: str, size: tuple[float, float, float], model: str, tmp_path: Path
) -> None:
    """Catalogue names of Vector's NCAP scenarios, and the abbreviations of the protocols."""
    length, width, height = size
    box = f'<Dimensions width="{width}" length="{length}" height="{height}"/>'
    vehicle = 'Vehicle name="vehicle.some.body" vehicleCategory="car"'
    text = FOREIGN.replace('<Dimensions width="2.0" length="4.5" height="1.8"/>', box)
    if category == "pedestrian":
        start = text.index(f"<{vehicle}>")
        end = text.index("</Vehicle>", start)
        body = text[start:end].replace(vehicle, f'Pedestrian name="{name}" pedestrianCategory="pedestrian" mass="0"')
        text = text[:start] + body + "</Pedestrian>" + text[end + len("</Vehicle>") :]
        lateral = text.index('<Event name="cut in"')
        text = text[:lateral] + text[text.index("</Event>", lateral) + len("</Event>") :]
    else:
        text = text.replace(vehicle, f'Vehicle name="{name}" vehicleCategory="{category}"')
    path = tmp_path / "target.xosc"
    path.write_text(text)
    (actor,) = read_openscenario(path).scenario.actors
    assert actor.model == model
    # The box of a two-wheeler in the catalogue ends below its rider.
    stated = replace(actor.body, max_speed=None)
    assert stated == (Body(length=4.1) if name == "GVT" else Body())


LATER = """<Event name="stop" priority="overwrite"><Action name="stop"><PrivateAction><LongitudinalAction><SpeedAction>
  <SpeedActionDynamics dynamicsShape="step" value="0" dynamicsDimension="time"/>
  <SpeedActionTarget><AbsoluteTargetSpeed value="0"/></SpeedActionTarget></SpeedAction></LongitudinalAction>
  </PrivateAction></Action><StartTrigger><ConditionGroup><Condition name="c" delay="3.5" conditionEdge="none">
  <ByValueCondition><StoryboardElementStateCondition storyboardElementType="event" storyboardElementRef="go"
   state="startTransition"/></ByValueCondition></Condition></ConditionGroup></StartTrigger></Event> </Maneuver>"""


def test_delays_of_triggers_are_kept(tmp_path: Path) -> None:
    """After a distance, after another event, after a time; a delay after somebody else's event is named."""
    path = tmp_path / "late.xosc"
    text = FOREIGN.replace('<Condition name="c" delay="0"', '<Condition name="c" delay="2"', 1)
    text = text.replace("</Maneuver>", LATER, 1)
    path.write_text(text)
    found = read_openscenario(path)
    (actor,) = found.scenario.actors
    near = PhaseTrigger("ego_distance", 15.0, edge="rising", delay=2.0)
    assert actor.phases == (
        Phase(9.0, near, name="go", shape="step"),
        Phase(0.0, PhaseTrigger("after", 3.5), name="stop", shape="step"),
    )
    assert not any("delay" in line for line in (*found.omissions, *found.doubts))
    (trace,) = drive(built([found.scenario]), "blind")
    gap = np.hypot(trace.x[:, 0] - trace.x[:, 1], trace.y[:, 0] - trace.y[:, 1])
    moving, speed = int(np.flatnonzero(trace.speed[:, 1] > 0.0)[0]), trace.speed[:, 1]
    assert moving - 1 - int(np.flatnonzero(gap < 15.0)[0]) == 20
    assert int(np.flatnonzero(np.diff(speed) < -0.1)[0]) == moving - 1 + 35  # from then on it brakes

    path.write_text(text.replace('Type="event" storyboardElementRef="go"', 'Type="act" storyboardElementRef="a"'))
    (actor,) = read_openscenario(path).scenario.actors
    assert actor.phases[1] == Phase(0.0, PhaseTrigger("time", 3.5), name="stop", shape="step", anytime=True)
    path.write_text(text.replace('state="startTransition"', 'state="completeState"'))
    (actor,) = read_openscenario(path).scenario.actors
    ended = PhaseTrigger("phase_end", agent="adversary", phase="go", delay=3.5)
    assert actor.phases[1] == Phase(0.0, ended, name="stop", shape="step")
    timed = re.sub(
        "(?s)<ByEntityCondition>.*?</ByEntityCondition>",
        '<ByValueCondition><SimulationTimeCondition value="1.5" rule="greaterThan"/></ByValueCondition>',
        text,
        count=1,
    )
    path.write_text(timed)
    assert read_openscenario(path).scenario.actors[0].phases[0].when == PhaseTrigger("time", 3.5)
    path.write_text(text.replace('delay="2"', 'delay="soon"'))
    with pytest.raises(FormatError, match="delay is 'soon', not a number"):
        read_openscenario(path)


@pytest.mark.parametrize(
    ("place", "x", "y"),
    [
        ('dLane="1" ds="-8"', 209.0, -1.75),
        ('dLane="2" ds="20"', 237.0, 1.75),
        ('dLane="3" ds="20"', 237.0, 5.25),
    ],
)
def test_places_behind_and_across_the_road(place: str, x: float, y: float, tmp_path: Path) -> None:
    path = tmp_path / "behind.xosc"
    path.write_text(FOREIGN.replace('dLane="1" ds="20"', place))
    (actor,) = read_openscenario(path).scenario.actors
    assert (actor.pose.x, actor.pose.y) == pytest.approx((x, y), abs=0.01)


def _cut(old: str, new: str = "") -> Callable[[str], str]:
    def change(text: str) -> str:
        assert old in text
        return text.replace(old, new)

    return change


ROOT = "<OpenSCENARIO>"
HOSTILE: dict[str, tuple[Callable[[str], str], str]] = {
    "empty": (lambda _: "", "not valid XML"),
    "no XML": (lambda _: "\x00\x01 hello", "not valid XML"),
    "cut short": (lambda text: text[: len(text) // 2], "not valid XML"),
    "entities": (_cut(ROOT, f'<!DOCTYPE a [<!ENTITY b "c">]>{ROOT}'), "refused"),
    "external": (_cut(ROOT, f'<!DOCTYPE a SYSTEM "/etc/passwd">{ROOT}'), "refused"),
    "another format": (lambda _: "<OpenDRIVE/>", "not OpenSCENARIO"),
    "no header": (lambda text: re.sub("<FileHeader.*?/>", "", text), "FileHeader is missing"),
    "another revision": (_cut('revMajor="1"', 'revMajor="0"'), "revision 0"),
    "no map": (_cut('<LogicFile filepath="ProvingGround"/>'), "names no LogicFile"),
    "unknown map": (_cut("ProvingGround", "../../etc/passwd"), "there is no town 'passwd'"),
    "no entities": (lambda text: re.sub("(?s)<Entities>.*</Entities>", "", text), "no ScenarioObject"),
    "twins": (_cut('name="adversary"', 'name="hero"'), "two entities 'hero'"),
    "nobody": (_cut('<EntityRef entityRef="adversary"/></A', '<EntityRef entityRef="x"/></A'), "no entity 'x'"),
    "no number": (_cut('ds="20"', 'ds="far"'), "'far', not a number"),
    "not finite": (_cut('x="217"', 'x="nan"'), "not a finite number"),
    "far along lanes": (_cut('ds="20"', 'ds="1e300"'), "beyond 10000 m"),
    "far beside": (_cut('dLane="1"', 'dLane="1e9"'), "no road has so many lanes"),
    "no lane there": (_cut('dLane="1"', 'dLane="12"'), "there is no lane 12 beside"),
    "a change beyond all lanes": (_cut('value="-1"', 'value="-1e300"'), "no road has so many lanes"),
    "beyond everything": (
        _cut('x="217"', 'x="1e300"'),
        "'hero' starts at (1e+300, -5.25), outside the map",
    ),
    "no parameter": (_cut('name="fast"', 'name="slow"'), "parameter $fast is not declared"),
    "unknown name": (
        _cut("$fast", "${2 * $slow}"),
        "value: expression '2 * $slow': parameter $slow is not declared; closest: $fast",
    ),
    "division by zero": (_cut("$fast", "${$fast / 0}"), "expression '$fast / 0': division by zero"),
    "circular": (
        _cut('value="9.0"', 'value="$fast"'),
        ":3: ParameterDeclaration: the parameter depends on itself: fast",
    ),
    "in a ring": (_cut('entityRef="hero" dLane', 'entityRef="adversary" dLane'), "depends on itself"),
    "off the road": (_cut('y="5.25"', 'y="70"'), "does not stand on a road"),
    "empty condition": (lambda text: re.sub("<RelativeDistanceCondition.*?/>", "", text, flags=re.DOTALL), "is empty"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_broken_and_hostile_files_are_refused_in_one_line(name: str, tmp_path: Path) -> None:
    change, message = HOSTILE[name]
    path = tmp_path / "bad.xosc"
    path.write_text(change(FOREIGN))
    done = ssad("import", "openscenario", path, tmp_path / "out.yaml")
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert message in done.stderr
    assert "bad.xosc" in done.stderr
    assert not (tmp_path / "out.yaml").exists()
