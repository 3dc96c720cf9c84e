"""Routes of the CARLA leaderboards: out and in again, Bench2Drive's types, what is refused."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.command import ssad

from ssad.core.types import SignalPlan
from ssad.interchange.leaderboard import CLASSES, TYPES_2, export_leaderboard, export_leaderboard1, read_leaderboard
from ssad.roads import load_town
from ssad.scenarios.dynamic import build_episode, import_routes, load_scenarios, read_scenarios

PLACE = 0.01  # m


@pytest.mark.parametrize("every", [5, pytest.param(1, marks=pytest.mark.slow)])
def test_routes_come_back(every: int, tmp_path: Path) -> None:
    """Leaderboard 2.0: towns, classes, key points and triggers; the class without a counterpart is named."""
    scenarios = load_scenarios("precrash")[::every]
    (path,), lost = export_leaderboard(scenarios, tmp_path)
    found, _ = read_leaderboard(path)
    kept = [s for s in scenarios if s.type in TYPES_2]
    assert len(found) == len(kept) == (28 if every == 1 else 6)
    assert "scenarios of type LaneChanging: the leaderboard has none such" in lost
    for one, other in zip(kept, found, strict=True):
        assert (one.type, one.town) == (other.type, other.town)
        assert one.trigger is not None
        assert other.trigger is not None
        ends = [(one.route[0], other.route[0]), (one.route[-1], other.route[-1]), (one.trigger, other.trigger)]
        assert all(abs(a.x - b.x) < PLACE and abs(a.y - b.y) < PLACE for a, b in ends)
        assert math.cos(one.trigger.yaw - other.trigger.yaw) > 0.9999
        build_episode(other, load_town(other.town), seed=0)


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
 <scenario name="a" type="DynamicObjectCrossing"><trigger_point x="247" y="5.25" z="0" yaw="360"/>
  <distance value="40"/></scenario>
 <scenario name="b" type="VanillaSignalizedTurnEncounterRedLight"><trigger_point x="1" y="5" z="0" yaw="0"/></scenario>
 <scenario name="c" type="Accident"><trigger_point x="247" y="5.25" z="0" yaw="0"/></scenario>
</scenarios></route></routes>
"""


def test_types_that_nobody_plays_are_named(tmp_path: Path) -> None:
    path = tmp_path / "b2d.xml"
    path.write_text(ROUTES)
    done = ssad("import", "leaderboard", path, tmp_path / "out.yaml")
    assert done.returncode == 0, done.stderr
    walker, red = read_scenarios(tmp_path / "out.yaml")
    assert walker.type == "StraightObstacle"
    assert walker.trigger is not None
    assert (walker.trigger.x, walker.trigger.y, walker.trigger.yaw) == (247.0, -5.25, 0.0)
    assert red.signals == SignalPlan("red", "green", until=15.0)
    for line in ("type Accident: no class here plays it", "weather of a route", "distance of DynamicObjectCrossing"):
        assert f"not carried over: {line}" in done.stdout
    assert len(CLASSES) == 15


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
    "no type": (_cut('type="Accident"'), "'type' is missing"),
    "no trigger": (_cut('<trigger_point x="247" y="5.25" z="0" yaw="360"/>'), "has no trigger_point"),
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
