"""Import of SafeBench, FREA and leaderboard folders: the real ones, and broken ones."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.command import ssad

from ssad.core.errors import FormatError
from ssad.core.import_report import ImportReport
from ssad.core.types import Pose, SignalPlan
from ssad.scenarios.dynamic import PRECRASH, build_episode, import_routes, load_scenarios, save_scenarios, scenario_type
from ssad.scenarios.dynamic.importer import _PARAMETERS
from ssad.world.roads import load_graph

ROUTE = (
    '<routes><route id="0" town="T"><waypoint x="0" y="10" yaw="0" z="0"/>'
    '<waypoint x="50" y="10" yaw="0"/><waypoint x="60" y="20" yaw="90"/></route></routes>'
)
TRANSFORM = {"x": "20.5", "y": 10.5, "yaw": "365.0", "z": "0"}


def event(**changes: Any) -> dict[str, Any]:
    other = {"left": [{"x": "60", "y": "0", "yaw": "90"}], "front": [{"x": 80, "y": 12, "yaw": 180}]}
    return {"transform": TRANSFORM, "other_actors": other, **changes}


def make(
    folder: Path,
    *,
    entries: Any = None,
    events: Any = None,
    route: str = ROUTE,
    name: str = "OppositeVehicleRunningRedLight",
) -> Path:
    """A SafeBench folder with one scenario of kind 5."""
    if entries is None:
        entries = [{"data_id": 0, "scenario_id": 5, "route_id": 3, "risk_level": None, "parameters": None}]
    configurations = {"available_event_configurations": [event()] if events is None else events}
    table = {"available_scenarios": [{"T": [{**configurations, "scenario_name": name}]}]}
    for path, text in {
        "scenario_type/standard.json": json.dumps(entries),
        "route/scenarios/scenario_05.json": json.dumps(table),
        "route/scenario_05_routes/scenario_05_route_03.xml": route,
    }.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(text)
    return folder


def test_frames_are_converted(tmp_path: Path) -> None:
    (s,) = import_routes(make(tmp_path))
    assert (s.name, s.type, s.town) == ("safebench/RedlightRunning/03", "RedlightRunning", "T")
    assert s.route == (Pose(0, -10), Pose(50, -10), Pose(60, -20, -math.pi / 2))
    assert s.trigger is not None
    assert (s.trigger.x, s.trigger.y) == (20.5, -10.5)
    assert s.trigger.yaw == pytest.approx(-math.radians(5.0))
    # front comes before left, as the leaderboard reads them
    assert s.placements[0].yaw == pytest.approx(-math.pi)
    assert s.placements[1] == Pose(60.0, 0.0, -math.pi / 2)


def test_the_first_trigger_along_the_route_wins(tmp_path: Path) -> None:
    def there(x: float, y: float = 10.0, yaw: float = 0.0) -> dict[str, Any]:
        return event(transform={"x": x, "y": y, "yaw": yaw})

    events = [there(40), there(30), there(10, y=12.5), there(12, yaw=20), there(5, yaw=180)]
    (s,) = import_routes(make(tmp_path, events=events))
    assert s.trigger == Pose(30.0, -10.0, 0.0)


def test_repetitions_get_seeds_in_the_order_of_data_id(tmp_path: Path) -> None:
    entries = [{"data_id": i, "scenario_id": 5, "route_id": 3, "parameters": None} for i in (2, 0, 1)]
    found = import_routes(make(tmp_path, entries=entries))
    assert [(s.name[-5:], s.seed) for s in found] == [("03/00", 0), ("03/01", 1), ("03/02", 2)]


def _write(path: str, text: str) -> Callable[[Path], None]:
    return lambda folder: (folder / path).write_text(text) and None


def _remove(path: str) -> Callable[[Path], None]:
    return lambda folder: (folder / path).unlink()


LIST, TABLE = "scenario_type/standard.json", "route/scenarios/scenario_05.json"
XML = "route/scenario_05_routes/scenario_05_route_03.xml"
BROKEN: list[tuple[dict[str, Any], Callable[[Path], None] | None, str]] = [
    ({"entries": []}, None, "the list of episodes is empty"),
    ({"entries": {}}, None, "expected a list of episodes"),
    ({"entries": [1]}, None, "entry 0: expected an object"),
    ({"entries": [{"data_id": 0, "scenario_id": 77, "route_id": 3}]}, None, "unknown scenario_id 77; known: 1 to 9"),
    ({"entries": [{"data_id": 0, "scenario_id": "5", "route_id": 3}]}, None, "scenario_id should be a whole number"),
    ({"entries": [{"data_id": 0, "scenario_id": 5}]}, None, "route_id should be a whole number, not None"),
    (
        {"entries": [{"data_id": 0, "scenario_id": 5, "route_id": 3, "parameters": [1.0]}]},
        None,
        "parameters are read in lists human and random only",
    ),
    (
        {"entries": [{"data_id": 0, "scenario_id": 5, "route_id": 4}]},
        None,
        "scenario_05_route_04.xml: no such route file",
    ),
    ({}, _remove(XML), "scenario_05_route_03.xml: no such route file; standard.json asks for it"),
    ({}, _remove(TABLE), "scenario_05.json: no such file"),
    ({}, _write(LIST, "[{"), "standard.json:1: not valid JSON"),
    ({}, _write(TABLE, "{}"), "available_scenarios"),
    ({}, _write(TABLE, '{"available_scenarios": [[]]}'), "should hold objects"),
    ({}, _write(TABLE, '{"available_scenarios": [{"T": 5}]}'), "T: expected a list"),
    ({}, _write(XML, "<routes><route"), "scenario_05_route_03.xml:1: not valid XML"),
    ({}, _write(XML, '<!DOCTYPE a [<!ENTITY b "c">]><routes>&b;</routes>'), "refused"),
    ({}, _write(XML, "<routes/>"), "no <route> in it"),
    ({}, _write(XML, ROUTE.replace('town="T"', "")), "names no town"),
    ({}, _write(XML, ROUTE.replace('x="50"', 'x="nan"')), "waypoint 1: x is 'nan', not a finite number"),
    ({}, _write(XML, ROUTE.replace('x="50"', 'x="5o"')), "waypoint 1: x is '5o', not a number"),
    ({}, _write(XML, ROUTE.replace('x="50"', "")), "waypoint 1: 'x' is missing"),
    ({}, _write(XML, ROUTE.replace('x="50"', 'x="5e7"')), "route[1]: beyond 100000 m"),
    ({}, _write(XML, '<routes><route town="T"><waypoint x="0" y="0" yaw="0"/></route></routes>'), "at least two"),
    ({"name": "Unheard"}, None, "unknown scenario 'Unheard'"),
    ({"events": []}, None, "no trigger of RedlightRunning in T lies on the route"),
    ({"events": [event(transform={"x": 1e400, "y": 0, "yaw": 0})]}, None, "not valid JSON"),
    ({"events": [event(transform={"x": 1, "y": 0})]}, None, "'yaw' is missing"),
    ({"events": [event(transform=None)]}, None, "expected x, y and yaw"),
    ({"events": [event(other_actors={})]}, None, "names no other actor, which RedlightRunning needs"),
    ({"events": [event(other_actors={"left": [{"x": "inf", "y": 1, "yaw": 1}]})]}, None, "left 0: x is 'inf'"),
]


@pytest.mark.parametrize(("parts", "damage", "message"), BROKEN, ids=[b[2][:50] for b in BROKEN])
def test_broken_folders_say_what_is_wrong(
    tmp_path: Path, parts: dict[str, Any], damage: Callable[[Path], None] | None, message: str
) -> None:
    make(tmp_path, **parts)
    if damage:
        damage(tmp_path)
    with pytest.raises(FormatError) as raised:
        import_routes(tmp_path)
    assert message in str(raised.value)
    assert str(tmp_path) in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_leaderboard_folder_gives_a_scenario_for_each_trigger(tmp_path: Path) -> None:
    (tmp_path / "routes.xml").write_text(ROUTE)
    kinds = {"Scenario1": [event()], "Scenario3": [event(), event(transform={"x": 40, "y": 10, "yaw": 0})]}
    table = {
        "available_scenarios": [
            {
                "T": [{"available_event_configurations": e, "scenario_type": k} for k, e in kinds.items()],
                "Other": [{"available_event_configurations": [event()], "scenario_type": "Scenario5"}],
            }
        ]
    }
    (tmp_path / "all_towns.json").write_text(json.dumps(table))
    found = import_routes(tmp_path)
    assert [s.name for s in found] == [
        "leaderboard/routes_0/StraightObstacle_00",
        "leaderboard/routes_0/StraightObstacle_01",
    ]
    assert [s.trigger.x for s in found if s.trigger] == [20.5, 40.0]
    (tmp_path / "all_towns.json").unlink()
    (free,) = import_routes(tmp_path)
    assert (free.name, free.type, free.trigger) == ("leaderboard/routes_0/FreeDrive", "FreeDrive", None)
    assert free.route == found[0].route
    (tmp_path / "routes.xml").unlink()
    with pytest.raises(FormatError, match="no route files"):
        import_routes(tmp_path)
    with pytest.raises(FormatError, match="no such folder"):
        import_routes(tmp_path / "absent")


def at(x: float, y: float = 10.0, yaw: float = 0.0, **more: Any) -> dict[str, Any]:
    return event(transform={"x": x, "y": y, "yaw": yaw}, **more)


@pytest.mark.parametrize(
    ("on", "off"),
    [
        (at(20, y=11.9), at(20, y=12.1)),  # 2 m beside the route
        (at(20, y=8.1), at(20, y=7.9)),
        (at(-1.9), at(-2.1)),  # before its first point
        (at(20, yaw=9.9), at(20, yaw=10.1)),
        (at(20, yaw=-9.9), at(20, yaw=-10.1)),
        (at(20, yaw=360.0), at(20, yaw=180.0)),
        (at(55, y=15, yaw=45), at(55, y=15, yaw=34)),  # the last stretch goes from (50, 10) to (60, 20)
        (at(61.3, y=21.3, yaw=45), at(61.5, y=21.5, yaw=45)),  # beyond its last point
    ],
)
def test_what_counts_as_on_the_route(on: dict[str, Any], off: dict[str, Any], tmp_path: Path) -> None:
    assert import_routes(make(tmp_path, events=[on]))
    with pytest.raises(FormatError, match="no trigger of RedlightRunning in T lies on the route"):
        import_routes(make(tmp_path, events=[off]))


@pytest.mark.parametrize("first", [(3.0, 10.0, 0.0), (49.0, 10.0, 0.0), (52.0, 12.0, 45.0)])
def test_the_first_trigger_is_the_one_that_comes_first(first: tuple[float, ...], tmp_path: Path) -> None:
    doubled = ROUTE.replace('<waypoint x="50"', '<waypoint x="0" y="10" yaw="0"/><waypoint x="50"')
    for route in (ROUTE, doubled):  # the same point twice has no direction
        (s,) = import_routes(
            make(tmp_path, events=[at(58, y=18, yaw=45), at(*first), at(55, y=15, yaw=45)], route=route)
        )
        assert s.trigger is not None
        assert (s.trigger.x, s.trigger.y) == (first[0], -first[1])


def test_triggers_of_other_towns_and_later_routes_do_not_count(tmp_path: Path) -> None:
    make(tmp_path)
    table = {"available_scenarios": [{"Elsewhere": [{"scenario_name": "SignalizedJunctionTurn"}]}]}
    table["available_scenarios"][0]["Elsewhere"][0]["available_event_configurations"] = [at(20)]  # type: ignore[assignment]
    (tmp_path / TABLE).write_text(json.dumps(table))
    with pytest.raises(FormatError, match="no trigger of RedlightRunning in T"):
        import_routes(tmp_path)
    (tmp_path / XML).write_text(ROUTE.replace("</routes>", ROUTE[len("<routes>") :]))
    with pytest.raises(FormatError, match="expected one route, found 2"):
        import_routes(tmp_path)


def listed(folder: Path, number: int, rows: list[tuple[int, int]], name: str) -> Path:
    """A folder with one list of (data id, route id) of one kind of scenario."""
    entries = [{"data_id": data, "scenario_id": number, "route_id": route} for data, route in rows]
    configurations = {"available_event_configurations": [event()]}
    table = {"available_scenarios": [{"T": [{**configurations, "scenario_name": name}]}]}
    files = {
        "scenario_type/list.json": json.dumps(entries),
        f"route/scenarios/scenario_{number:02d}.json": json.dumps(table),
    }
    for _, route in rows:
        files[f"route/scenario_{number:02d}_routes/scenario_{number:02d}_route_{route:02d}.xml"] = ROUTE
    for path, text in files.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(text)
    return folder


def test_names_groups_and_sources(tmp_path: Path) -> None:
    found = import_routes(listed(tmp_path / "a", 9, [(0, 1), (2, 4), (1, 1)], "SignalizedJunctionTurn"))
    assert [(s.name, s.group, s.seed, s.source) for s in found] == [
        ("frea/T_01/00", "T", 0, "FREA scenario 9 route 01"),
        ("frea/T_01/01", "T", 1, "FREA scenario 9 route 01"),
        ("frea/T_04", "T", 0, "FREA scenario 9 route 04"),
    ]
    assert all(s.placements == () and s.trigger is not None for s in found)
    (one,) = import_routes(listed(tmp_path / "b", 1, [(0, 0)], "DynamicObjectCrossing"))
    assert (one.name, one.group, one.source) == (
        "safebench/StraightObstacle/00",
        "StraightObstacle",
        "SafeBench scenario 1 route 00",
    )
    assert one.placements == ()  # it puts its own actors


def test_a_natural_junction_needs_no_trigger(tmp_path: Path) -> None:
    listed(tmp_path, 9, [(0, 1)], "SignalizedJunctionTurn")
    (tmp_path / "route/scenarios/scenario_09.json").write_text('{"available_scenarios": []}')
    (found,) = import_routes(tmp_path)
    assert found.trigger is None


def test_the_longest_list_is_taken_or_the_one_named(tmp_path: Path) -> None:
    make(tmp_path)
    entry = {"scenario_id": 5, "route_id": 3}
    (tmp_path / "scenario_type/all.json").write_text(json.dumps([entry | {"data_id": k} for k in range(3)]))
    assert len(import_routes(tmp_path)) == 3
    assert len(import_routes(tmp_path / "scenario_type/standard.json")) == 1
    with pytest.raises(FormatError, match="no such folder"):
        import_routes(tmp_path / TABLE)


def test_more_broken_lists_and_tables(tmp_path: Path) -> None:
    entry = {"data_id": 0, "scenario_id": 5, "route_id": 3}
    for entries, says in (
        ([entry, entry | {"data_id": -1}], "entry 1: data_id should be a whole number, not -1"),
        ([entry | {"route_id": True}], "entry 0: route_id should be a whole number, not True"),
        ([entry | {"scenario_id": 0}], "entry 0: unknown scenario_id 0"),
        ([entry | {"scenario_id": 10}], "entry 0: unknown scenario_id 10"),
    ):
        with pytest.raises(FormatError, match=says):
            import_routes(make(tmp_path, entries=entries))
    make(tmp_path)
    for table, says in (
        ({"available_scenarios": {}}, "expected an object with the list available_scenarios"),
        ([], "expected an object with the list available_scenarios"),
        ({"available_scenarios": [{"T": [3]}]}, "T: expected objects with available_event_configurations"),
        ({"available_scenarios": [{"T": [{"scenario_name": "Scenario7"}]}]}, "T: Scenario7: expected a list"),
        (
            {"available_scenarios": [{"T": [{"scenario_name": "Scenario7", "available_event_configurations": [1]}]}]},
            "T: Scenario7: event 0: expected an object with a transform",
        ),
    ):
        (tmp_path / TABLE).write_text(json.dumps(table))
        with pytest.raises(FormatError, match=says):
            import_routes(tmp_path)
    for others, says in (
        ([1], "should map front, left, right to lists"),
        ({"left": 3}, "other_actors: left: expected a list"),
    ):
        with pytest.raises(FormatError, match=says):
            import_routes(make(tmp_path, events=[event(other_actors=others)]))
    with pytest.raises(FormatError, match="other_actors: front 1: yaw is 'x', not a number"):
        import_routes(make(tmp_path, events=[event(other_actors={"front": [TRANSFORM, {**TRANSFORM, "yaw": "x"}]})]))


def test_angles_and_numbers_of_carla(tmp_path: Path) -> None:
    others = {
        "right": [{"x": 1, "y": 0, "yaw": 0}],
        "front": [{"x": 2, "y": -3.5, "yaw": "-270"}, {"x": 3, "y": 1, "yaw": 725}],
    }
    (s,) = import_routes(make(tmp_path, events=[event(other_actors=others)]))
    assert s.placements == (Pose(2.0, 3.5, -math.pi / 2), Pose(3.0, -1.0, -math.radians(5.0)), Pose(1.0, 0.0, 0.0))
    assert math.copysign(1.0, s.placements[2].y) == math.copysign(1.0, s.placements[2].yaw) == 1.0  # no minus zero


def test_leaderboard_scenarios_that_need_an_actor_and_routes_without_a_number(tmp_path: Path) -> None:
    second = ROUTE.replace('id="0" ', "")
    (tmp_path / "a.xml").write_text(ROUTE.replace("</routes>", second[len("<routes>") :]))
    events = [at(30), at(10, other_actors={}), at(55, y=15, yaw=45)]
    table = {
        "available_scenarios": [
            {
                "T": [
                    {"available_event_configurations": events, "scenario_type": kind}
                    for kind in ("Scenario7", "Scenario3")
                ]
            }
        ]
    }
    (tmp_path / "t.json").write_text(json.dumps(table))
    (tmp_path / "other.json").write_text("[1, 2]")  # a file of another kind
    found = import_routes(tmp_path)
    assert [s.name for s in found] == [
        f"leaderboard/a_{route}/{kind}"
        for route in (0, 1)
        for kind in (
            "StraightObstacle_00",
            "RedlightRunning_00",
            "StraightObstacle_01",
            "RedlightRunning_01",
            "StraightObstacle_02",
        )
    ]
    assert [len(s.placements) for s in found[:5]] == [0, 2, 0, 2, 0]
    assert (found[0].group, found[0].source) == ("StraightObstacle", "leaderboard route 0 of a.xml")
    (tmp_path / "t.json").write_text(json.dumps(table).replace('"T"', '"Elsewhere"'))
    report = ImportReport("folder")
    assert [s.name for s in import_routes(tmp_path, report=report)] == [
        "leaderboard/a_0/FreeDrive",
        "leaderboard/a_1/FreeDrive",
    ]
    assert report.notes == {
        "routes on which no trigger lies (2 m, 10 degrees) become free drives": ["a.xml, route 0", "a.xml, route 1"]
    }
    assert report.omissions["JSON files that hold no triggers"] == ["other.json"]
    assert len(report.omissions["triggers that lie on no route"]) > 0
    assert report.contents == ["leaderboard 1.0: 2 scenarios of 2 routes"]
    (tmp_path / "t.json").write_text(json.dumps(table))
    (tmp_path / "a.xml").write_text(ROUTE.replace('x="0"', 'x="-5e7"'))
    with pytest.raises(FormatError, match=r"a\.xml: route\[0\]: beyond 100000 m"):
        import_routes(tmp_path)


def test_routes_of_leaderboard_2_without_scenarios_are_free_drives(tmp_path: Path) -> None:
    text = (
        '<routes><route id="7" town="T"><weathers/><waypoints><position x="0" y="10" z="0"/>'
        '<position x="50" y="10" z="0"/><position x="50" y="40" z="0"/></waypoints><scenarios>{}</scenarios></route>'
        "</routes>"
    )
    (tmp_path / "b.xml").write_text(text.format(""))
    (drive,) = import_routes(tmp_path)
    assert (drive.name, drive.type, drive.town) == ("leaderboard/b_7/FreeDrive", "FreeDrive", "T")
    quarter = pytest.approx(-math.pi / 2)
    assert [(pose.x, pose.y, pose.yaw) for pose in drive.route] == [(0, -10, 0), (50, -10, quarter), (50, -40, quarter)]
    (tmp_path / "b.xml").rename(tmp_path / "meine Straße (2).xml")
    assert [member.name for member in import_routes(tmp_path)] == ["leaderboard/meine_Stra_e__2__7/FreeDrive"]
    (tmp_path / "meine Straße (2).xml").unlink()
    (tmp_path / "b.xml").write_text(text.format('<scenario name="a" type="Accident"/>'))
    with pytest.raises(FormatError, match=r"b\.xml: route 7: has scenarios of leaderboard 2\.0; .* import leaderboard"):
        import_routes(tmp_path)


@pytest.mark.data
def test_safebench_has_32_episodes(data_dir: Path, tmp_path: Path) -> None:
    found = import_routes(data_dir / "routes" / "safebench")
    assert [s.type for s in found] == [name for name in PRECRASH for _ in range(4)]
    assert {s.town for s in found} == {"Town_Safebench_Light"}
    assert all(s.trigger is not None for s in found)
    assert [len(s.placements) for s in found] == [0] * 16 + [1] * 16
    assert found[0].route == (Pose(62.5, -5.25), Pose(162.5, -5.25))
    assert found[16].placements == (Pose(-18.5, -1.75),)
    signals = {s.type: s.signals for s in found}
    assert signals["VehiclePassing"] == signals["StraightObstacle"] == SignalPlan("green", "red")
    assert signals["RightTurn"] == SignalPlan("red", "green", elsewhere="green")
    assert signals["RedlightRunning"] == SignalPlan()  # its class's own
    save_scenarios(tmp_path / "safebench.yaml", found)
    assert load_scenarios(tmp_path / "safebench.yaml") == found


@pytest.mark.data
def test_frea_has_150_scenarios(data_dir: Path, tmp_path: Path) -> None:
    found = import_routes(data_dir / "routes" / "frea")
    assert len(found) == 150
    assert Counter(s.town for s in found) == {"Town05": 80, "Town02": 70}
    assert len({s.name for s in found}) == 150
    assert all([s.seed for s in found[i : i + 10]] == list(range(10)) for i in range(0, 150, 10))
    assert {s.type for s in found} == {"NaturalJunction"}
    five = data_dir / "routes" / "frea" / "scenario_type" / "Scenario9_Town05_Town02_5x.json"
    assert len(import_routes(five)) == 75
    save_scenarios(tmp_path / "frea.yaml", found)
    assert load_scenarios(tmp_path / "frea.yaml") == found


@pytest.mark.data
def test_routes_that_no_list_of_frea_names_come_in_too(data_dir: Path, tmp_path: Path) -> None:
    """Its lists name 15 of the 28 routes of scenario 9."""
    (tmp_path / "route").symlink_to(data_dir / "routes" / "frea" / "route")
    (tmp_path / "scenario_type").mkdir()
    entries = [{"data_id": k, "scenario_id": 9, "route_id": k, "parameters": None} for k in range(28)]
    (tmp_path / "scenario_type" / "all.json").write_text(json.dumps(entries))
    report = ImportReport("folder")
    assert len({s.route for s in import_routes(tmp_path, report=report)}) == 28
    assert (report.doubts, report.omissions) == ({}, {})


@pytest.mark.data
@pytest.mark.parametrize("name", ["safebench", "frea"])
def test_every_imported_route_becomes_an_episode(data_dir: Path, carla_home: Path, name: str) -> None:
    # the ten repetitions of FREA's routes differ in the draw of traffic alone
    found = [s for s in import_routes(data_dir / "routes" / name) if s.seed < 3]
    graphs = {town: load_graph(carla_home / "towns" / f"{town}.npz") for town in sorted({s.town for s in found})}
    for scenario in found:
        graph = graphs[scenario.town]
        ego, *others = build_episode(scenario, graph, seed=0).agents
        assert ego.route is not None
        first, last = scenario.route[0], scenario.route[-1]
        assert math.hypot(ego.pose.x - first.x, ego.pose.y - first.y) < 1.0
        assert abs(math.remainder(ego.pose.yaw - first.yaw, 2 * math.pi)) < 0.3
        assert (
            math.hypot(ego.route.xy[-1, 0] - last.x, ego.route.xy[-1, 1] - last.y) < 3.0
        )  # some key points lie beside the lane
        if name == "frea":
            assert 50.0 <= ego.route.length <= 115.0
            assert 3 <= len(others) <= 18
            continue
        when = others[0].phases[0].when if others[0].phases else others[1].phases[0].when
        gap = np.hypot(ego.route.xy[:, 0] - others[0].pose.x, ego.route.xy[:, 1] - others[0].pose.y)
        assert gap.min() < when.value < gap[0]


@pytest.mark.data
def test_safebench_actors_stand_where_its_classes_put_them(data_dir: Path, carla_home: Path) -> None:
    graph = load_graph(carla_home / "towns" / "Town_Safebench_Light.npz")
    found = {s.name.removeprefix("safebench/"): s for s in import_routes(data_dir / "routes" / "safebench")}

    def poses(name: str) -> list[tuple[float, float, float]]:
        agents = build_episode(found[name], graph, seed=0).agents[1:]
        return [(round(a.pose.x, 1), round(a.pose.y, 1), round(abs(a.pose.yaw), 2)) for a in agents]

    # trigger (92.5, -5.25) heading east: 45 m on, one lane of 3.5 m right (the shoulder is narrow), facing north
    assert poses("StraightObstacle/00") == [(137.5, -8.8, 1.57), (133.0, -8.4, 1.57)]
    # trigger (72.5, -5.25) in the outer lane; trigger (72.5, -1.75) in the inner lane
    assert poses("LaneChanging/00") == [(107.5, -5.2, 0.0), (108.5, -1.8, 0.0)]
    assert poses("VehiclePassing/00") == [(122.5, -1.8, 0.0), (152.5, 1.8, 3.14)]
    assert poses("RightTurn/00") == [(-14.5, -5.2, 0.0)]


def test_a_whole_checkout_comes_in_and_what_cannot_is_named(tmp_path: Path, ssad_home: Path) -> None:
    flat = make(tmp_path / "flat")
    inside = tmp_path / "SafeBench" / "safebench" / "scenario"
    (inside / "config").mkdir(parents=True)
    (inside / "scenario_data").mkdir()
    (flat / "scenario_type").rename(inside / "config" / "scenario_type")
    (flat / "route").rename(inside / "scenario_data" / "route")
    rows = [(0, 0, None), (5, 3, None), (5, 3, [0.5, 35]), (5, 3, None), (5, 4, None)]
    entries = [
        {"data_id": k, "scenario_id": number, "route_id": route, "parameters": told}
        for k, (number, route, told) in enumerate(rows)
    ]
    (inside / "config" / "scenario_type" / "standard.json").write_text(json.dumps(entries))
    report = ImportReport("folder")
    found = import_routes(tmp_path / "SafeBench", report=report)
    assert [s.name for s in found] == ["safebench/RedlightRunning/03/00", "safebench/RedlightRunning/03/01"]
    assert report.lines()[0] == "SafeBench: 2 of 3 entries of standard.json"
    done = ssad("import", "routes", tmp_path / "SafeBench", "--name", "doubtful", "--strict")
    assert done.returncode == 2
    assert "an entry is left out: unknown scenario_id 0; known: 1 to 9: standard.json, entry 0, and 2" in done.stderr
    assert not list(ssad_home.rglob("doubtful*"))
    assert [line.replace(str(inside), "") for line in report.lines()[1:]] == [
        "doubtful: an entry is left out: unknown scenario_id 0; known: 1 to 9: standard.json, entry 0",
        "doubtful: an entry is left out: parameters are read in lists human and random only; set them to null:"
        " standard.json, entry 2",
        "doubtful: a route is left out: /scenario_data/route/scenario_05_routes/scenario_05_route_04.xml: no such route"
        " file; standard.json asks for it",
    ]
    with pytest.raises(FormatError, match="unknown scenario_id 0"):
        import_routes(tmp_path / "SafeBench")
    (inside / "scenario_data" / "route" / "scenario_05_routes" / "scenario_05_route_03.xml").write_text("<routes/>")
    with pytest.raises(FormatError, match="none of its routes can be read; the first: "):
        import_routes(tmp_path / "SafeBench", report=ImportReport("folder"))


def test_lists_with_parameters_are_read_and_the_one_without_is_what_a_folder_stands_for(tmp_path: Path) -> None:
    folder = make(tmp_path)
    lists = folder / "scenario_type"
    given = [[8, 31], [12.5, 39], [10, 99], [10], ["10", 35], [True, 35]]
    rows = [
        {"data_id": k, "scenario_folder": "human", "scenario_id": 5, "route_id": 3, "parameters": one}
        for k, one in enumerate(given)
    ]
    (lists / "human.json").write_text(json.dumps(rows))
    (lists / "advsim.json").write_text(json.dumps([row | {"parameters": "5.npy"} for row in rows]))
    report = ImportReport("folder")
    (plain,) = import_routes(folder, report=report)
    assert plain.parameters == {}
    assert {name for names in report.omissions.values() for name in names} == {"advsim.json", "human.json"}
    report = ImportReport("list")
    found = import_routes(lists / "human.json", report=report)
    assert [s.parameters for s in found] == [
        {"speed": 8.0, "trigger_distance": 31.0},
        {"speed": 12.5, "trigger_distance": 39.0},
    ]
    assert [s.name for s in found] == ["safebench/RedlightRunning/03/00", "safebench/RedlightRunning/03/01"]
    reasons = list(report.doubts)
    assert "RedlightRunning: parameter trigger_distance: 99 is outside" in reasons[0]
    assert report.doubts[reasons[0]] == ["human.json, entry 2"]
    assert ["parameters should be the numbers speed, trigger_distance" in line for line in reasons[1:]] == [True] * 3


@pytest.mark.parametrize("number", range(1, 9))
def test_every_parameter_of_a_list_is_one_of_its_scenario(number: int) -> None:
    box = scenario_type(PRECRASH[number - 1]).box
    assert set(_PARAMETERS[number]) <= set(box)


def test_a_trigger_on_a_curve_is_found_on_the_route_through_its_town(tmp_path: Path) -> None:
    """The straight line between the ends of a turn passes more than 2 m beside its lane."""
    from ssad.world.roads import load_town
    from ssad.world.roads.router import route_along

    turn = load_scenarios("RightTurn")[0]
    ends = (turn.route[0], turn.route[-1])
    route = route_along(load_town(turn.town), ends)
    middle = len(route.xy) // 2
    text = "".join(f'<waypoint x="{p.x}" y="{-p.y}" yaw="{-math.degrees(p.yaw)}"/>' for p in ends)
    x, y, yaw = float(route.xy[middle, 0]), float(route.xy[middle, 1]), float(route.yaw[middle])
    trigger = event(transform={"x": x, "y": -y, "yaw": -math.degrees(yaw)})
    folder = make(tmp_path, events=[trigger], route=f'<routes><route id="0" town="{turn.town}">{text}</route></routes>')
    table = (folder / TABLE).read_text()
    (folder / TABLE).write_text(table.replace('"T"', f'"{turn.town}"'))
    (found,) = import_routes(folder)
    assert found.trigger is not None
    assert (found.trigger.x, found.trigger.y) == pytest.approx((x, y))
    for path in (folder / TABLE, folder / XML):
        path.write_text(path.read_text().replace(turn.town, "Nowhere"))
    with pytest.raises(FormatError, match="no trigger of RedlightRunning in Nowhere lies on the route"):
        import_routes(folder)
