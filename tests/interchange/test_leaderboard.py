"""Routes of the CARLA leaderboards: out and in again, what is refused; the types: `test_leaderboard_types`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers.command import ssad
from helpers.generated import generated

from ssad.core.import_report import ImportReport
from ssad.core.types import Pose, Scenario
from ssad.drivers import make_system
from ssad.interchange.leaderboard import export_leaderboard, export_leaderboard1, read_leaderboard
from ssad.metrics import episode_metrics
from ssad.scenarios.dynamic import build_episode, import_routes, load_scenarios, read_scenarios
from ssad.scenarios.dynamic.frozen import freeze_episode
from ssad.world.roads import load_town
from ssad.world.rollout import rollout
from ssad.world.world import World

PLACE = 0.01  # m


def recorded() -> Scenario:
    """A scenario with trajectories."""
    (scenario,) = load_scenarios("CrossingNegotiation/00")
    episode = build_episode(scenario, load_town(scenario.town), seed=0)
    world = World([episode], {episode.town: load_town(episode.town)})
    return freeze_episode(episode, rollout(world, make_system("blind"))[0], name="recorded/00")


@pytest.mark.parametrize("every", [8, pytest.param(1, marks=pytest.mark.slow)])
def test_routes_come_back_as_the_same_drive(every: int, tmp_path: Path) -> None:
    """Leaderboard 2.0, the 32 and 20 generated ones: everybody within 1 cm at every step, the same metrics."""
    made = generated() if every == 1 else [recorded()]
    assert any(actor.trajectory for s in made for actor in s.actors)
    scenarios = [*load_scenarios("precrash")[::every], *made]
    (path,), lost = export_leaderboard(scenarios, tmp_path)
    report = ImportReport("routes")
    found = read_leaderboard(path, report=report)
    assert {reason: len(places) for reason, places in report.omissions.items()} == {
        "weather of a route": len(scenarios)
    }
    assert not report.doubts
    assert len(found) == len(scenarios) == (52 if every == 1 else 5)
    assert any(line.startswith("actors of a Custom: the leaderboard drives its ego alone") for line in lost)
    drives = []
    for group in (scenarios, found):
        episodes = [build_episode(s, load_town(s.town), seed=0) for s in group]
        world = World(episodes, {e.town: load_town(e.town) for e in episodes})
        drives.append(rollout(world, make_system("blind")))
    for one, other in zip(*drives, strict=True):
        assert len(one.x) == len(other.x)
        assert np.hypot(one.x - other.x, one.y - other.y)[one.active].max() < PLACE, one.key
        assert episode_metrics(one).as_dict() == pytest.approx(episode_metrics(other).as_dict(), nan_ok=True)


def test_what_is_moved_in_the_file_is_moved(tmp_path: Path) -> None:
    """Whoever edits the written file gets what it says."""
    (path,), _ = export_leaderboard(load_scenarios("StraightObstacle/00"), tmp_path)
    (before,) = read_leaderboard(path)
    assert before.trigger is not None
    text = path.read_text()
    old = f'<trigger_point x="{before.trigger.x:.3f}"'
    assert old in text
    path.write_text(text.replace(old, f'<trigger_point x="{before.trigger.x + 5.0:.3f}"'))
    (after,) = read_leaderboard(path)
    assert after.trigger is not None
    assert after.trigger.x == pytest.approx(before.trigger.x + 5.0)
    assert (after.route, after.parameters) == (before.route, before.parameters)


@pytest.mark.parametrize("every", [5, pytest.param(1, marks=pytest.mark.slow)])
def test_leaderboard_1_comes_back(every: int, tmp_path: Path) -> None:
    scenarios = load_scenarios("precrash")[::every]
    files, _ = export_leaderboard1(scenarios, tmp_path)
    assert [path.name for path in files] == ["routes.xml", "scenarios.json"]
    found = import_routes(tmp_path)
    assert {s.type for s in found} == {s.type for s in scenarios}
    triggers = {(s.type, round(s.trigger.x, 1), round(s.trigger.y, 1)) for s in found if s.trigger}
    assert {(s.type, round(s.trigger.x, 1), round(s.trigger.y, 1)) for s in scenarios if s.trigger} == triggers


ROUTES = """<routes><route id="7" town="ProvingGround">
<weathers><weather route_percentage="0" sun_altitude_angle="90"/></weathers>
<waypoints><position x="217" y="5.25" z="0"/><position x="317" y="5.25" z="0"/></waypoints>
<scenarios>
 <scenario name="a" type="DynamicObjectCrossing"><trigger_point x="227" y="5.25" z="0" yaw="360"/>
  <distance value="40"/><direction value="right"/><speed value="9"/></scenario>
 <scenario name="b" type="VanillaSignalizedTurnEncounterRedLight"><trigger_point x="1" y="5" z="0" yaw="0"/></scenario>
 <scenario name="c" type="ControlLoss"><trigger_point x="247" y="5.25" z="0" yaw="0"/></scenario>
</scenarios></route></routes>
"""


def test_what_is_not_played_is_named(tmp_path: Path) -> None:
    path = tmp_path / "b2d.xml"
    path.write_text(ROUTES)
    done = ssad("import", "leaderboard", path, tmp_path / "out.yaml")
    assert done.returncode == 0, done.stderr
    walker, red = read_scenarios(tmp_path / "out.yaml")
    assert walker.trigger is not None
    assert (walker.trigger.x, walker.trigger.y, walker.trigger.yaw) == (227.0, -5.25, 0.0)
    assert [actor.model for actor in walker.actors] == ["walker", "vending_machine"]
    assert red.actors == ()
    for line in (
        "type ControlLoss: it disturbs the ego's own controls",
        "weather of a route",
        "speed of DynamicObjectCrossing",
    ):
        assert f"not carried over: {line}" in " ".join(done.stdout.split())


ALONE = """<?xml version="1.0"?><routes>
<route id="0" town="ProvingGround">{first}</route>
<route id="1" town="ProvingGround"><waypoints><position x="217" y="5.25" z="0"/><position x="517" y="5.25" z="0"/>
</waypoints></route></routes>"""
WAYPOINTS = "".join(
    f'<waypoint x="{x}" y="5.25" z="0" yaw="0" pitch="0" roll="0"/>' for x in (217, 317)
)  # of leaderboard 1.0


def test_routes_without_scenarios_are_free_drives_in_traffic(tmp_path: Path) -> None:
    """Of leaderboard 2.0 and 1.0; the ego meets vehicles all along, and the signals follow their programmes."""
    (tmp_path / "r.xml").write_text(ALONE.format(first=WAYPOINTS))
    done = ssad("import", "leaderboard", tmp_path / "r.xml", tmp_path / "out.yaml")
    assert done.returncode == 0, done.stderr
    assert "2 scenarios on ProvingGround" in done.stdout
    assert "not carried over" not in done.stdout
    assert "import: 2/2 routes" in done.stderr
    short, long = read_scenarios(tmp_path / "out.yaml")
    assert short.route[0] == Pose(217.0, -5.25, 0.0)
    assert (short.type, short.limits.max_time, long.limits.max_time) == ("FreeDrive", 85.0, 245.0)
    town = load_town("ProvingGround")
    episodes = [build_episode(scenario, town, seed=0) for scenario in (short, long)]
    for episode in episodes:
        route = episode.agents[0].route
        assert route is not None
        starts = np.array([(agent.pose.x, agent.pose.y) for agent in episode.agents[1:]])
        assert 5 <= len(starts) <= 40
        assert np.hypot(*(starts - route.xy[0]).T).min() > 25.0
        assert all(np.hypot(*(route.xy - start).T).min() <= 52.5 for start in starts)
        assert not episode.signal_override
    assert len(episodes[1].agents) > len(episodes[0].agents)
    names = [tuple(agent.pose for agent in build_episode(short, town, seed=seed).agents) for seed in (0, 0, 1)]
    assert names[0] == names[1] != names[2]
    (trace,) = rollout(World(episodes[:1], {town.name: town}), make_system("autopilot"))
    assert trace.end == "complete"
    moved = np.hypot(np.ptp(trace.x, axis=0), np.ptp(trace.y, axis=0))
    assert (moved[1:] > 5.0).sum() >= 2, "traffic drives"
    (tmp_path / "routes").mkdir()
    (tmp_path / "routes" / "r.xml").write_text(
        f'<routes><route id="0" town="ProvingGround">{WAYPOINTS}</route></routes>'
    )
    done = ssad("import", "routes", tmp_path / "routes", "--name", "alone")
    assert done.returncode == 0, done.stderr
    assert "set alone: 1 scenario on ProvingGround" in done.stdout


def test_a_free_drive_on_an_unknown_town_is_named(tmp_path: Path) -> None:
    text = ALONE.format(first=WAYPOINTS).replace('id="0" town="ProvingGround"', 'id="0" town="Elsewhere"')
    (tmp_path / "r.xml").write_text(text)
    report = ImportReport("routes")
    scenarios = read_leaderboard(tmp_path / "r.xml", report=report)
    assert [scenario.name for scenario in scenarios] == ["leaderboard/1/FreeDrive"]
    assert report.omissions == {
        "town Elsewhere is not imported: its scenarios cannot be built (ssad import map)": ["route 0"]
    }
    assert report.doubts == {}


def test_a_route_that_does_not_fit_its_town_is_doubtful_and_refused_by_strict(tmp_path: Path) -> None:
    text = ALONE.format(first=WAYPOINTS.replace('y="5.25"', 'y="900"'))
    (tmp_path / "r.xml").write_text(text)
    done = ssad("import", "leaderboard", tmp_path / "r.xml", tmp_path / "out.yaml")
    assert done.returncode == 0, done.stderr
    assert "doubtful: left out: " in (tmp_path / "out.import.txt").read_text()
    done = ssad("import", "leaderboard", tmp_path / "r.xml", tmp_path / "strict.yaml", "--strict")
    assert done.returncode == 2
    assert "route 0; correct the file, or import it without --strict" in done.stderr
    assert not (tmp_path / "strict.yaml").exists()


def _cut(old: str, new: str = "") -> Callable[[str], str]:
    def change(text: str) -> str:
        assert old in text
        return text.replace(old, new)

    return change


HOSTILE: dict[str, tuple[Callable[[str], str], str]] = {
    "empty": (lambda _: "", "not valid XML"),
    "no XML": (lambda _: "{}", "not valid XML"),
    "cut short": (lambda text: text[:200], "not valid XML"),
    "entities": (lambda text: f'<!DOCTYPE a [<!ENTITY b "c">]>{text}', "refused"),
    "external": (lambda text: f'<!DOCTYPE a SYSTEM "/etc/passwd">{text}', "refused"),
    "another format": (lambda _: "<OpenDRIVE/>", "not a file of routes"),
    "no routes": (lambda _: "<routes/>", "it has no route"),
    "no town": (_cut('town="ProvingGround"'), "'town' is missing"),
    "no id": (_cut('id="7"'), "'id' is missing"),
    "a name that is none": (_cut('id="7"', 'id="../../x y"'), "is not a name"),
    "one place": (_cut('<position x="317" y="5.25" z="0"/>'), "needs two positions"),
    "no number": (_cut('x="217"', 'x="here"'), "not a number"),
    "not finite": (_cut('x="317"', 'x="inf"'), "not a finite number"),
    "beyond everything": (_cut('x="317"', 'x="1e12"'), "beyond 100000 m"),
    "no type": (_cut('type="ControlLoss"'), "'type' is missing"),
    "a distance beyond reason": (_cut('distance value="40"', 'distance value="1e9"'), "outside 0 to 500"),
    "a distance that is none": (_cut('distance value="40"', 'distance value="far"'), "not a number"),
    "a side that is none": (_cut('"right"', '"up"'), "not one of left, right"),
    "own data, broken": (_cut('<speed value="9"/>', '<ssad scenario="{"/>'), "is not JSON"),
    "own data, deep": (_cut('<speed value="9"/>', f'<ssad scenario="{"[" * 99999}"/>'), "is not JSON"),
    "own data, no mapping": (_cut('<speed value="9"/>', '<ssad scenario="[]"/>'), "not a mapping"),
    "own data, unknown key": (
        _cut('<speed value="9"/>', "<ssad scenario='{\"run\": 1}'/>"),
        "unknown key; known: name",
    ),
    "own data, not finite": (
        _cut('<speed value="9"/>', '<ssad scenario=\'{"name": "a", "type": "Custom", "seed": NaN}\'/>'),
        "bad.xml",
    ),
    "no trigger": (_cut('<trigger_point x="227" y="5.25" z="0" yaw="360"/>'), "has no trigger_point"),
    "nothing to play": (lambda text: text.replace("DynamicObjectCrossing", "A").replace("Vanilla", "B"), "no scenario"),
    "off the road": (lambda text: text.replace('y="5.25"', 'y="90"'), "no scenario in it can be played"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_broken_and_hostile_files_are_refused_in_one_line(name: str, tmp_path: Path) -> None:
    change, message = HOSTILE[name]
    path = tmp_path / "bad.xml"
    path.write_text(change(ROUTES))
    done = ssad("import", "leaderboard", path, tmp_path / "out.yaml")
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert message in done.stderr
    assert "bad.xml" in done.stderr
    assert not (tmp_path / "out.yaml").exists()
