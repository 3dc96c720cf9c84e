"""CommonRoad: what is written comes back as the same drive; what others write; what is refused."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.command import ssad
from helpers.generated import generated

from ssad.core.import_report import ImportReport
from ssad.core.types import Actor, Episode, EpisodeLimits, EpisodeTrace, Pose, Scenario, SignalPlan
from ssad.drivers import make_system
from ssad.interchange.commonroad_reader import read_commonroad
from ssad.interchange.commonroad_writer import STILL
from ssad.interchange.export import export_commonroad
from ssad.metrics import episode_metrics
from ssad.scenarios.dynamic import build_episode, load_scenarios, read_scenarios
from ssad.scenarios.dynamic.frozen import freeze_episode
from ssad.world.roads import load_town
from ssad.world.rollout import rollout
from ssad.world.world import World

FEW = ("StraightObstacle/00", "RedlightRunning/02")
CLOSE = 0.01  # m


def drive(episodes: Sequence[Episode], system: str) -> list[EpisodeTrace]:
    return rollout(World(episodes, {e.town: load_town(e.town) for e in episodes}), make_system(system))


def built(scenarios: Sequence[Scenario]) -> list[Episode]:
    return [build_episode(scenario, load_town(scenario.town), seed=0) for scenario in scenarios]


def returned(scenarios: Sequence[Scenario], folder: Path, system: str) -> list[Scenario]:
    files, _ = export_commonroad(scenarios, folder, system=system)
    reports = [ImportReport(str(path)) for path in files]
    found = [read_commonroad(path, report=report) for path, report in zip(files, reports, strict=True)]
    assert all(one.is_known_town for one in found)
    assert not any(report.omissions or report.doubts or report.notes for report in reports)
    return [one.scenario for one in found]


def recorded(scenarios: Sequence[Scenario], system: str) -> list[Episode]:
    """What the format can hold of them: everybody but the ego repeats what was recorded."""
    episodes = built(scenarios)
    fixed = [all(agent.controller in STILL for agent in e.agents[1:]) for e in episodes]
    traces = drive(episodes, system)
    return [
        episode if still else built([freeze_episode(episode, trace)])[0]
        for episode, trace, still in zip(episodes, traces, fixed, strict=True)
    ]


def same_drives(before: Sequence[Episode], after: Sequence[Episode], system: str) -> None:
    for one, other in zip(drive(before, system), drive(after, system), strict=True):
        assert one.models == other.models
        assert one.end == other.end
        assert np.array_equal(one.active, other.active)
        assert np.hypot(one.x - other.x, one.y - other.y)[one.active].max() < CLOSE
        measured, again = (episode_metrics(trace).as_dict() for trace in (one, other))
        for name, value in measured.items():
            near = pytest.approx(value, rel=1e-3, abs=1e-3, nan_ok=True) if isinstance(value, float) else value
            assert again[name] == near, (one.key, name)


@pytest.mark.parametrize(
    ("names", "system"),
    [
        (FEW, "autopilot"),
        pytest.param(("precrash",), "blind", marks=pytest.mark.slow),
        pytest.param(("precrash",), "autopilot", marks=pytest.mark.slow),
        pytest.param((), "blind", marks=pytest.mark.slow),
        pytest.param((), "autopilot", marks=pytest.mark.slow),
    ],
)
def test_a_scenario_comes_back_as_the_same_drive(names: Sequence[str], system: str, tmp_path: Path) -> None:
    """Without names: 20 that generators have found."""
    scenarios = [scenario for name in names for scenario in load_scenarios(name)] if names else generated()
    again = returned(scenarios, tmp_path, system)
    assert [s.name for s in again] == [s.name for s in scenarios]
    same_drives(recorded(scenarios, system), built(again), system)


@pytest.mark.slow
def test_a_driver_that_sees_nobody_drives_as_in_the_scenario_itself(tmp_path: Path) -> None:
    """All are within 1 cm of the scenario before anybody's motion became a trajectory."""
    scenarios = load_scenarios("precrash")
    before, after = (drive(built(s), "blind") for s in (scenarios, returned(scenarios, tmp_path, "blind")))
    for one, other in zip(before, after, strict=True):
        assert (one.end, one.models) == (other.end, other.models)
        assert np.hypot(one.x - other.x, one.y - other.y)[one.active].max() < CLOSE


def test_who_comes_later_leaves_or_stands_comes_back(tmp_path: Path) -> None:
    base = load_scenarios("RedlightRunning/02")[0]
    late = Actor("late", "compact", Pose(0.0, 0.0), trajectory=((2.0, 0.0, 0.0, 0.0), (4.0, 10.0, 0.0, 0.0)))
    early = replace(
        late, name="early", trajectory=((-1.0, 0.0, 30.0, 0.0), (3.0, 8.0, 30.0, 0.0)), pose=Pose(0.0, 30.0)
    )
    things = tuple(
        Actor(name, name, Pose(20.0 * k, -60.0, 0.1 * k))
        for k, name in enumerate(("bus", "cone", "walker", "barrier", "bicycle", "vending_machine", "truck", "van"))
    )
    scenario = replace(
        base,
        name="stood",
        type="Custom",
        trigger=None,
        placements=(),
        parameters={"ego_speed": 3.0},
        actors=(things[0], late, *things[1:], early),
        signals=SignalPlan("red", "green"),
        limits=EpisodeLimits(max_steps=60, contact="count"),
        target_speed=6.5,
    )
    (again,) = returned([scenario], tmp_path, "autopilot")
    assert (again.limits.contact, again.target_speed, again.signals) == ("count", 6.5, scenario.signals)
    same_drives(built([scenario]), built([again]), "autopilot")


@pytest.mark.parametrize("town", ["Larkhill", "Ringmere", "Longreach"])
def test_lanelets_give_back_the_lanes(town: str, tmp_path: Path) -> None:
    """Also those of a town that is not known here: with bridges, roundabouts, signs."""
    name = {"Larkhill": "natural-larkhill", "Ringmere": "natural-ringmere", "Longreach": "natural-longreach"}[town]
    from ssad.scenarios.dynamic import set_names

    graph = load_town(town)
    scenario = _on(town) if name not in set_names() else load_scenarios(name)[0]
    (path,), _ = export_commonroad([scenario], tmp_path, system="blind")
    text = path.read_text()
    path.write_text(text.replace(f"town={town};", "town=Elsewhere;").replace(f"ZAM_{town}-", "ZAM_Elsewhere-"))
    found = read_commonroad(path, town="elsewhere")
    assert not found.is_known_town
    other = found.graph
    for field, close in (("xy", 1e-3), ("width", 1e-3), ("s", 0.01), ("speed_limit", 1e-3)):
        assert np.abs(getattr(graph, field) - getattr(other, field)).max() < close, field
    assert np.abs(np.angle(np.exp(1j * (graph.yaw - other.yaw)))).max() < 0.01
    for field in ("kind", "left", "right", "offset", "left_marking", "right_marking", "sign_kind", "rule_lane"):
        assert np.array_equal(getattr(graph, field), getattr(other, field)), field
    for lane in range(graph.lane_count):
        assert set(graph.successors(lane).tolist()) == set(other.successors(lane).tolist())
    driving = graph.kind == 1
    assert np.array_equal((graph.junction >= 0)[driving], (other.junction >= 0)[driving])
    real = ~graph.signal_virtual
    assert np.abs(graph.signal_xy[real] - other.signal_xy).max(initial=0.0) < 1e-3
    assert np.abs(graph.rule_s - other.rule_s).max(initial=0.0) < 0.05


def _on(town: str) -> Scenario:
    """An ego alone on the first long lane of a town."""
    graph = load_town(town)
    lane = int(np.flatnonzero((graph.kind == 1) & (graph.length > 60.0))[0])
    route = tuple(Pose(*graph.at(lane, s)[:2]) for s in (5.0, 50.0))
    return Scenario("alone", "Custom", town, route)


def test_commands(tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = ssad("export", "RedlightRunning/00", out, "--format", "commonroad", "--system", "blind")
    assert done.returncode == 0, done.stderr
    assert "not carried over: what others do by themselves: they repeat what they did beside 'blind'" in done.stdout
    done = ssad("import", "commonroad", out / "RedlightRunning-00.xml", tmp_path / "a.yaml")
    assert done.returncode == 0, done.stderr
    (found,) = read_scenarios(tmp_path / "a.yaml")
    assert (found.name, found.town, found.signals.ego) == ("RedlightRunning/00", "ProvingGround", "green")


# ---------------------------------------------------------------- other programs' files


def _lanelet(number: int, y: float, links: str) -> str:
    bounds = "".join(
        f"<{side}Bound>"
        + "".join(f"<point><x>{x}</x><y>{y + o}</y></point>" for x in (0, 60, 120, 200))
        + f"<lineMarking>dashed</lineMarking></{side}Bound>"
        for side, o in (("left", 1.75), ("right", -1.75))
    )
    return (
        f'<lanelet id="{number}">{bounds}{links}<laneletType>highway</laneletType><trafficSignRef ref="9"/></lanelet>'
    )


def _states(*rows: tuple[int, float, float]) -> str:
    return "".join(
        f"<state><position><point><x>{x}</x><y>{y}</y></point></position><orientation><exact>0</exact></orientation>"
        f"<time><exact>{t}</exact></time><velocity><exact>8</exact></velocity></state>"
        for t, x, y in rows
    )


FOREIGN = f"""<?xml version="1.0"?>
<commonRoad timeStepSize="0.2" commonRoadVersion="2020a" author="A. Author" affiliation="" source="NGSIM"
 benchmarkID="USA_Test-1_1_T-1" date="2020-01-01">
<location><geoNameId>-999</geoNameId><gpsLatitude>999</gpsLatitude><gpsLongitude>999</gpsLongitude></location>
<scenarioTags><highway/></scenarioTags>
{_lanelet(1, 0.0, '<adjacentLeft ref="2" drivingDir="same"/>')}
{_lanelet(2, 3.5, '<adjacentRight ref="1" drivingDir="same"/>')}
<trafficSign id="9"><trafficSignElement><trafficSignID>274</trafficSignID><additionalValue>25</additionalValue>
 </trafficSignElement></trafficSign>
<staticObstacle id="20"><type>parkedVehicle</type><shape><rectangle><length>8.5</length><width>2.5</width></rectangle>
 </shape><initialState><position><point><x>150</x><y>3.5</y></point></position><orientation><exact>0</exact>
 </orientation><time><exact>0</exact></time></initialState></staticObstacle>
<dynamicObstacle id="21"><type>car</type><shape><rectangle><length>4.5</length><width>1.9</width></rectangle></shape>
 {_states((0, 40, 3.5)).replace("state>", "initialState>")}
 <trajectory>{_states((1, 41.6, 3.5), (2, 43.2, 3.0), (3, 44.8, 2.0), (4, 46.4, 0.0))}</trajectory></dynamicObstacle>
<dynamicObstacle id="22"><type>pedestrian</type><shape><circle><radius>0.3</radius></circle></shape>
 {_states((0, 100, -6)).replace("state>", "initialState>")}<occupancySet><occupancy><shape><circle><radius>1</radius>
 <center><x>101</x><y>-6</y></center></circle></shape><time><exact>10</exact></time></occupancy></occupancySet>
</dynamicObstacle>
<planningProblem id="30"><initialState><position><point><x>10</x><y>0</y></point></position>
 <velocity><exact>12</exact></velocity><orientation><exact>0</exact></orientation><yawRate><exact>0</exact></yawRate>
 <slipAngle><exact>0</exact></slipAngle><time><exact>0</exact></time></initialState>
 <goalState><time><intervalStart>20</intervalStart><intervalEnd>60</intervalEnd></time>
 <position><lanelet ref="2"/></position></goalState></planningProblem>
</commonRoad>
"""


def test_a_scenario_of_others_is_driven(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Lanelets become a town, steps of 0.2 s steps of 0.1 s; what is not read is named."""
    monkeypatch.setenv("SSAD_HOME", str(tmp_path / "home"))
    (tmp_path / "us.xml").write_text(FOREIGN)
    done = ssad("import", "commonroad", tmp_path / "us.xml", tmp_path / "us.yaml")
    assert done.returncode == 0, done.stderr
    (found,) = read_scenarios(tmp_path / "us.yaml")
    graph = load_town("us")
    assert (found.name, found.town, graph.lane_count, float(graph.speed_limit[0])) == (
        "USA_Test-1_1_T-1",
        "us",
        2,
        25.0,
    )
    truck, car, walker = found.actors
    assert (truck.model, truck.trajectory) == ("truck", ())
    assert (car.model, car.trajectory[-1][:3]) == ("suv", (0.8, 46.4, 0.0))
    assert (walker.model, walker.trajectory[-1][:3]) == ("walker", (2.0, 101.0, -6.0))
    assert (found.limits.max_steps, found.parameters["ego_speed"], found.target_speed) == (120, 12.0, 12.0)
    for line in ("the earliest time of the goal", "occupancy sets: their middles", "car (4.5 x 1.9 m) becomes 'suv'"):
        assert line in " ".join(done.stdout.split())
    assert "2 lanelets" in done.stdout
    assert max(map(len, done.stdout.replace(str(tmp_path), "").splitlines())) <= 80
    report = (tmp_path / "us.import.txt").read_text()
    assert set(done.stdout.splitlines()[2:-1]) <= set(report.splitlines())
    (episode,) = built([found])
    assert episode.agents[0].route.xy[-1, 1] == pytest.approx(3.5)
    (trace,) = drive([episode], "autopilot")
    assert trace.x[4, 2] == pytest.approx(43.2, abs=0.01)
    assert not trace.active[9:, 2].any()


def test_strict_refuses_what_is_doubtful_and_stores_nothing(tmp_path: Path, ssad_home: Path) -> None:
    """A stop sign of no lanelet, and a light of none."""
    (tmp_path / "good.xml").write_text(FOREIGN)
    assert ssad("import", "commonroad", tmp_path / "good.xml", tmp_path / "good.yaml", "--strict").returncode == 0
    sign = (
        '<trafficSign id="90"><trafficSignElement><trafficSignID>206</trafficSignID></trafficSignElement></trafficSign>'
    )
    light = '<trafficLight id="91"><cycle><cycleElement><duration>3</duration><color>red</color></cycleElement></cycle>'
    text = FOREIGN.replace("<staticObstacle", f"{sign}{light}</trafficLight><staticObstacle", 1)
    (tmp_path / "bad.xml").write_text(text)
    done = ssad("import", "commonroad", tmp_path / "bad.xml", tmp_path / "bad.yaml", "--strict")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "signs that no lanelet refers to are left out: trafficSign 90, and 1 other doubts" in done.stderr
    assert not (tmp_path / "bad.yaml").exists()
    assert not (ssad_home / "towns" / "bad.npz").exists()


def _cut(old: str, new: str = "") -> Callable[[str], str]:
    def change(text: str) -> str:
        assert old in text
        return text.replace(old, new, 1)

    return change


ROOT = "<commonRoad "
HOSTILE: dict[str, tuple[Callable[[str], str], str]] = {
    "empty": (lambda _: "", "not valid XML"),
    "no XML": (lambda _: "\x00\x01 hello", "not valid XML"),
    "cut short": (lambda text: text[: len(text) // 2], "not valid XML"),
    "entities": (_cut(ROOT, f'<!DOCTYPE a [<!ENTITY b "c">]>{ROOT}'), "refused"),
    "external": (_cut(ROOT, f'<!DOCTYPE a SYSTEM "/etc/passwd">{ROOT}'), "refused"),
    "another format": (lambda _: "<OpenSCENARIO/>", "not CommonRoad XML"),
    "another version": (_cut("2020a", "2017a"), "commonRoadVersion is '2017a'; 2020a and 2018b are read"),
    "no step": (_cut('timeStepSize="0.2"', 'timeStepSize="0"'), "timeStepSize is 0 s"),
    "no lanelets": (lambda text: re.sub("(?s)<lanelet id.*</lanelet>", "", text), "it has no lanelet"),
    "one point": (lambda text: re.sub("<leftBound>.*?<line", "<leftBound><line", text), "fewer than two points"),
    "in one place": (lambda text: re.sub("<x>[0-9]+</x><y>(-?1.75)", r"<x>0</x><y>\1", text), "all lie in one place"),
    "twins": (_cut('<lanelet id="2"', '<lanelet id="1"'), "lanelet 1: there are two of this id"),
    "nowhere beside": (_cut('<adjacentLeft ref="2"', '<adjacentLeft ref="7"'), "adjacentLeft 7: there is no such"),
    "no number": (_cut("<x>150</x>", "<x>far</x>"), "'far', not a number"),
    "not finite": (_cut("<x>150</x>", "<x>nan</x>"), "'nan', not a number that can be used"),
    "beyond everything": (_cut("<x>150</x>", "<x>1e300</x>"), "not a number that can be used"),
    "no size": (_cut("<length>4.5</length>", "<length>-4.5</length>"), "its body is -4.5 x 1.9 m"),
    "no type": (_cut("<type>car</type>", "<type>dragon</type>"), "'dragon' is no type of obstacle"),
    "back in time": (_cut("<time><exact>3</exact>", "<time><exact>1</exact>"), "time 1 does not come after"),
    "no problem": (lambda text: re.sub("(?s)<planningP.*</planningProblem>", "", text), "no planningProblem"),
    "no goal": (lambda text: re.sub("(?s)<goalState>.*</goalState>", "", text), "goalState is missing"),
    "goal nowhere": (_cut('<lanelet ref="2"/>', '<lanelet ref="5"/>'), "its goal is lanelet 5, which is not there"),
    "goal behind": (_cut("<x>10</x><y>0</y>", "<x>199.9</x><y>0</y>"), "the road ends before the ego"),
    "off the road": (_cut("<x>10</x><y>0</y>", "<x>10</x><y>90</y>"), "the way of the ego"),
    "no time": (_cut("<intervalEnd>60", "<intervalEnd>0"), "interval from 20 to 0"),
    "in the ego": (_cut("<x>150</x><y>3.5</y>", "<x>10</x><y>0</y>"), "stands in the ego at the start"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_broken_and_hostile_files_are_refused_in_one_line(name: str, tmp_path: Path) -> None:
    change, message = HOSTILE[name]
    path = tmp_path / "bad.xml"
    path.write_text(change(FOREIGN))
    done = ssad("import", "commonroad", path, tmp_path / "out.yaml")
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert message in done.stderr
    assert "bad.xml" in done.stderr
    assert not list(tmp_path.glob("out.*"))
