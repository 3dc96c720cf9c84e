"""Scenario files: what is written is read back equal, and every mistake is named with its line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ssad.core.errors import ConfigError, SSADError, UnknownNameError
from ssad.core.types import (
    Actor,
    Body,
    EpisodeLimits,
    LateralPhase,
    Phase,
    PhaseTrigger,
    Pose,
    Scenario,
    SignalPlan,
    TrafficPlan,
)
from ssad.scenarios.dynamic import (
    PRECRASH,
    SCENARIOS,
    load_scenarios,
    parameter_box,
    read_scenarios,
    save_scenarios,
    scenario_data,
    scenario_from,
    scenario_text,
    set_names,
)
from ssad.scenarios.dynamic.schema import check
from ssad.world.models import MODELS

number = st.floats(-1.0e5, 1.0e5, allow_subnormal=False)
positive = st.floats(1e-3, 1.0e4)
jerks = st.floats(1e-3, 100.0)
poses = st.builds(Pose, number, number, number)
light = st.sampled_from(["program", "off", "red", "green"])
texts = st.text(max_size=20).filter(lambda t: all(c.isprintable() for c in t))


@st.composite
def scenarios(draw: st.DrawFn) -> Scenario:
    kind = draw(st.sampled_from([*SCENARIOS, "Custom"]))
    actors: tuple[Actor, ...] = ()
    if kind == "Custom":
        condition = st.builds(
            PhaseTrigger,
            st.sampled_from(["always", "ego_distance", "ego_speed", "travelled", "time", "after"]),
            positive,
            st.just(0),
        )
        groups = st.lists(condition | st.builds(PhaseTrigger, all=st.tuples(condition, condition)), max_size=3).map(
            tuple
        )
        paced = st.fixed_dictionaries({}, optional={"acceleration": positive.map(lambda a: min(a, 9.0)), "jerk": jerks})
        phase = st.tuples(st.builds(Phase, st.floats(0.0, 1.0).map(float), condition), paced).map(
            lambda pair: replace(pair[0], **pair[1])
        )
        body = st.sampled_from([m for m in MODELS if MODELS[m].max_speed >= 1.0])
        path = st.lists(st.tuples(number, number), min_size=2, max_size=4).map(tuple)
        swerve = st.builds(LateralPhase, st.integers(-3, 3), st.floats(-5.0, 5.0), st.builds(PhaseTrigger, any=groups))
        size = st.builds(Body, length=st.none() | st.floats(0.5, 20.0), brake_build_up=st.none() | st.floats(0.0, 1.0))
        phases, lateral = (st.lists(kind, max_size=2).map(tuple) for kind in (phase, swerve))
        actor = st.builds(
            Actor, texts, body, poses, phases, path, body=size, speed=st.floats(0.0, 1.0), lateral=lateral
        )
        actors = tuple(draw(st.lists(actor, min_size=1, max_size=3)))
    box = parameter_box(kind)
    chosen = draw(st.sets(st.sampled_from(sorted(box))))
    parameters = {name: draw(st.floats(box[name].low, box[name].high)) for name in sorted(chosen)}
    return Scenario(
        name=draw(st.from_regex(r"[A-Za-z0-9][A-Za-z0-9_.\-]{0,8}(/[0-9]{2})?", fullmatch=True)),
        type=kind,
        town=draw(st.sampled_from(["ProvingGround", "Town05", "1e3", "null", "no"])),
        route=tuple(draw(st.lists(poses, min_size=2, max_size=4))),
        trigger=draw(st.none() | poses),
        placements=tuple(draw(st.lists(poses, max_size=2))),
        parameters=parameters,
        actors=actors,
        signals=draw(st.builds(SignalPlan, light, light, st.floats(0.0, 100.0))),
        traffic=draw(st.none() | st.builds(TrafficPlan, st.floats(0, 1), st.integers(0, 5), st.integers(5, 20))),
        limits=draw(st.builds(EpisodeLimits, st.integers(1, 1000), positive, positive)),
        target_speed=draw(st.floats(0.5, 30.0)),
        seed=draw(st.integers(0, 2**40)),
        group=draw(texts),
        source=draw(texts),
        ego_model=draw(st.sampled_from(["car", "truck"])),
        ego_body=draw(
            st.builds(Body, width=st.none() | st.floats(1.0, 3.0), max_brake=st.none() | st.floats(1.0, 9.0))
        ),
        friction=draw(st.sampled_from([0.9, 0.3])),
    )


@settings(max_examples=30, deadline=None)
@given(st.lists(scenarios(), min_size=1, max_size=3, unique_by=lambda s: s.name))
def test_round_trip(tmp_path: Path, several: list[Scenario]) -> None:
    path = tmp_path / "several.yaml"
    save_scenarios(path, several)
    assert read_scenarios(path) == tuple(several)
    save_scenarios(path, several[0])
    assert read_scenarios(path) == (several[0],)
    assert scenario_from(scenario_data(several[0])) == several[0]


def test_defaults_are_left_out() -> None:
    scenario = Scenario("a/0", "RightTurn", "T", (Pose(1.0, 2.0), Pose(3.0, 4.0, 1.5)), parameters={"speed": 9.0})
    assert scenario_text(scenario) == (
        "name: a/0\ntype: RightTurn\ntown: T\nroute:\n- {x: 1.0, y: 2.0}\n- {x: 3.0, y: 4.0, yaw: 1.5}\n"
        "parameters: {speed: 9.0}\n"
    )


CUSTOM = """\
name: my/overtaking-van
type: Custom
town: ProvingGround
route:
- {x: 0, y: 0}
- {x: 100, y: 0}
actors:
- name: van
  model: van
  pose: {x: 40, y: 0}
  phases:
  - speed: 6
    when: {kind: ego_distance, value: 30}
  - speed: 0
    when: {kind: travelled, value: 20}
- name: jogger
  model: walker
  pose: {x: 60, y: -6, yaw: 1.57}
  path: [[60, -6], [60, 6]]
  phases:
  - speed: 3.0
    when: {kind: time, value: 4}
"""


def test_a_custom_scenario_needs_no_python(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(CUSTOM)
    (scenario,) = load_scenarios(path)
    assert [a.name for a in scenario.actors] == ["van", "jogger"]
    assert scenario.actors[0].phases[1] == Phase(0.0, PhaseTrigger("travelled", 20.0))
    assert scenario.actors[1].path == ((60.0, -6.0), (60.0, 6.0))


GOOD: dict[str, Any] = {
    "name": "a",
    "type": "StraightObstacle",
    "town": "T",
    "route": "[{x: 0, y: 0}, {x: 9, y: 0}]",
}
BAD: list[tuple[dict[str, Any], int, str]] = [
    ({"nane": "b"}, 5, "nane: unknown key; known: name, type, town"),
    ({"type": "StraightObstacl"}, 2, "closest: StraightObstacle"),
    ({"type": "no_such_module:X"}, 2, "importing no_such_module failed"),
    ({"type": 3}, 2, "type: should be a valid string"),
    ({"name": "a b"}, 1, "'a b' is not a name"),
    ({"name": "../a"}, 1, "is not a name"),
    ({"town": "''"}, 3, "name the town"),
    (
        {"route": "[{x: 0, y: 0}, {x: 9, y: 0}]\nseed: 2000-01-01"},
        5,
        'seed: should be a valid integer, not "2000-01-01"',
    ),
    (
        {"town": "{long: [aaaaaaaaaaaaaaaaaaaa, bbbbbbbbbbbbbbbbbbbb, cccccccccccccccccc]}"},
        3,
        'a valid string, not {"long": ["aaaaaaaaaaaaaaaaaaaa", "bbbbbbbbbbbbbbbbbbbb",...',
    ),
    ({"route": "[{x: 0, y: 0}]"}, 4, "at least two key points"),
    (
        {"route": "[{x: 0, y: 0}, {x: nine, y: 0}]"},
        4,
        "route[1].x: expression 'nine': there is no parameter 'nine'; closest: ",
    ),
    ({"route": "[{x: 0, y: 0}, {x: '9', y: 0}]"}, 4, "route[1].x: should be a valid number"),
    ({"route": "[{x: 0, y: 0}, {x: 9, y: 0, z: 1}]"}, 4, "route[1].z: unknown key; known: x, y, yaw"),
    ({"route": "[{x: 0, y: 0}, {x: 9}]"}, 4, "key 'y' is missing"),
    ({"route": "[{x: 0, y: 0}, {x: .inf, y: 0}]"}, 4, "finite number"),
    ({"route": "[{x: 0, y: 0}, {x: 1e9, y: 0}]"}, 4, "beyond 100000 m"),
    ({"trigger": "[1, 2]"}, 5, "trigger"),
    ({"parameters": "{walker_speed: 9}"}, 5, "walker_speed: 9 is outside 0.5 to 4 m/s"),
    ({"parameters": "{walkerspeed: 2}"}, 5, "no such parameter; StraightObstacle has: trigger_distance"),
    ({"parameters": "{walker_speed: true}"}, 5, "should be a valid number"),
    ({"actors": "[{name: x, model: car, pose: {x: 0, y: 0}}]"}, 5, "only type Custom takes actors"),
    ({"signals": "{ego: blue}"}, 5, "\"blue\" is not one of 'program'"),
    ({"traffic": "{intensity: 2}"}, 5, "traffic.intensity: 2 is outside 0 to 1"),
    ({"traffic": "{minimum: 9, maximum: 3}"}, 5, "traffic.maximum"),
    ({"limits": "{max_steps: 0}"}, 5, "limits.max_steps: 0 is outside 1 to 100000"),
    ({"limits": "{max_steps: 1.5}"}, 5, "should be a valid integer"),
    ({"limits": "{max_time: -1}"}, 5, "limits.max_time: must be more than 0 s"),
    ({"target_speed": "0"}, 5, "target_speed: 0 is outside"),
    ({"seed": "-1"}, 5, "seed: must not be negative"),
    ({"seed": "[1, 2"}, 6, "not valid YAML"),
    ({"seed": "!!python/object/apply:os.system ['true']"}, 5, "is not allowed"),
    ({"type": "Custom", "parameters": "{speed: 1}"}, 5, "speed: no such parameter; Custom has: ego_speed, "),
    ({"type": "Custom", "actors": "[{name: x, model: caar, pose: {x: 0, y: 0}}]"}, 5, "closest: car"),
    ({"type": "Custom", "actors": "[{name: x, model: car, pose: {x: 0, y: 0}, path: [[0, 0]]}]"}, 5, "two points"),
    (
        {"type": "Custom", "actors": "[{name: x, model: walker, pose: {x: 0, y: 0}, phases: [{speed: 9}]}]"},
        5,
        "actors[0].phases[0].speed: 9 is outside 0 to 4 m/s (walker)",
    ),
    (
        {
            "type": "Custom",
            "actors": "[{name: x, model: car, pose: {x: 0, y: 0}, "
            "phases: [{speed: 9, when: {kind: ego_distance, value: 3, actor: 2}}]}]",
        },
        5,
        "when.actor: there are actors 0 to 0",
    ),
]


@pytest.mark.parametrize(("change", "line", "message"), BAD, ids=[str(sorted(c[0].items()))[:70] for c in BAD])
def test_bad_yaml_says_where_and_what(tmp_path: Path, change: dict[str, Any], line: int, message: str) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text("".join(f"{key}: {value}\n" for key, value in {**GOOD, **change}.items()))
    with pytest.raises(SSADError) as raised:
        load_scenarios(path)
    text = str(raised.value)
    assert message in text
    assert f"bad.yaml:{line}:" in text or "not valid YAML" in text
    assert "\n" not in text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected one scenario"),
        ("[]", "the list of scenarios is empty"),
        ("- 1", "a scenario is a mapping"),
        ("- {name: a, type: RightTurn, town: T, route: [{x: 0, y: 0}, {x: 1, y: 0}]}\n" * 2, "bad.yaml:2: [1].name"),
    ],
)
def test_bad_lists(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as raised:
        load_scenarios(path)
    assert message in str(raised.value)


def test_a_scenario_that_is_not_valid_is_not_written(tmp_path: Path) -> None:
    path = tmp_path / "x.yaml"
    bad = Scenario("a", "RightTurn", "T", (Pose(0, 0), Pose(1, 0)), parameters={"speed": 99.0})
    with pytest.raises(ConfigError, match=r"scenario a: parameters\.speed: 99 is outside"):
        save_scenarios(path, bad)
    assert not path.exists()


def test_folders_sets_and_names(tmp_path: Path, ssad_home: Path) -> None:
    first = Scenario("a", "RightTurn", "T", (Pose(0, 0), Pose(1, 0)))
    second = Scenario("b", "RightTurn", "T", (Pose(0, 0), Pose(1, 0)))
    save_scenarios(tmp_path / "set" / "1.yaml", first)
    save_scenarios(tmp_path / "set" / "2.yml", [second])
    assert load_scenarios(tmp_path / "set") == (first, second)
    with pytest.raises(ConfigError, match="import it: ssad import routes FOLDER"):
        load_scenarios("safebench")
    save_scenarios(ssad_home / "scenarios" / "safebench.yaml", [first, second])
    assert load_scenarios("safebench") == (first, second)
    assert load_scenarios("b") == (second,)
    save_scenarios(tmp_path / "set" / "3.yaml", first)
    with pytest.raises(ConfigError, match=r"scenario name 'a' is in 1\.yaml too"):
        load_scenarios(tmp_path / "set")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match="no scenario files"):
        load_scenarios(tmp_path / "empty")
    with pytest.raises(UnknownNameError, match="closest: precrash"):
        load_scenarios("precrsh")


def test_a_folder_does_not_hide_a_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("precrash", "mine"):
        save_scenarios(tmp_path / name / "x.yaml", Scenario("a", "RightTurn", "T", (Pose(0, 0), Pose(1, 0))))
    assert len(load_scenarios("precrash")) == 32
    assert [s.name for s in load_scenarios("mine")] == ["a"]


def test_a_class_of_ones_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "falling_tree.py").write_text(
        "from ssad.scenarios.dynamic import Parameter, ScenarioType\n"
        "TREE = ScenarioType('FallingTree', 'Falling tree', 'a tree falls', lambda s, g, r, rng: [],\n"
        "    parameters=(Parameter('height', 1.0, 9.0, 5.0, 'm', 'height of the tree'),))\n"
        "NOT_A_TYPE = 3\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    path = tmp_path / "tree.yaml"
    text = (
        "name: t\ntype: falling_tree:{}\ntown: T\nroute: [{{x: 0, y: 0}}, {{x: 9, y: 0}}]\nparameters: {{height: {}}}\n"
    )
    path.write_text(text.format("TREE", 3))
    assert load_scenarios(path)[0].parameters == {"height": 3.0}
    path.write_text(text.format("TREE", 30))
    with pytest.raises(ConfigError, match="30 is outside 1 to 9 m"):
        load_scenarios(path)
    path.write_text(text.format("NOT_A_TYPE", 3))
    with pytest.raises(ConfigError, match="expected a ScenarioType, found int"):
        load_scenarios(path)


def test_the_shipped_sets_have_the_numbers_of_the_paper() -> None:
    precrash = load_scenarios("precrash")
    assert [s.type for s in precrash] == [name for name in PRECRASH for _ in range(4)]
    assert {s.town for s in precrash} == {"ProvingGround"}
    assert len(load_scenarios("natural")) == 150
    assert sum(len(load_scenarios(f"natural-{town}")) for town in ("twinford", "crossgate")) == 150
    assert len(load_scenarios("natural-unselected")) == 150
    assert len(load_scenarios("natural-uniform")) == 150
    names = ("precrash", "natural", "natural-unselected", "natural-uniform")
    assert len({s.name for name in names for s in load_scenarios(name)}) == 482
    assert load_scenarios("RightTurn/02") == (load_scenarios("RightTurn")[2],)


PLAIN: dict[str, Any] = {"name": "a", "type": "RightTurn", "town": "T", "route": [{"x": 0, "y": 0}, {"x": 9, "y": 0}]}
START, END = PLAIN["route"]


def test_of_several_mistakes_the_misspelt_key_is_shown() -> None:
    data = {"name": "a", "type": "RightTurn", "twon": "T", "route": [{"x": 0, "y": 0}, {"x": 9, "y": 0}]}
    with pytest.raises(ConfigError, match="twon: unknown key; known: name, type, town, route"):
        scenario_from(data)
    with pytest.raises(ConfigError, match="key 'town' is missing"):
        scenario_from({key: value for key, value in data.items() if key != "twon"})
    for inner, known in (
        ({"signals": {"ega": "red"}}, r"signals\.ega: unknown key; known: ego, others, until"),
        ({"limits": {"max_step": 3}}, r"limits\.max_step: unknown key; known: max_steps, max_time, max_distance"),
        (
            {"traffic": {"maxi": 3}},
            r"traffic\.maxi: unknown key; known: intensity, minimum, maximum, wake_distance",
        ),
        (
            {"actors": [{"pose": {"x": 0, "y": 0}, "phases": [{"when": {"knd": 1}}]}]},
            r"when\.knd: unknown key; known: kind",
        ),
    ):
        with pytest.raises(ConfigError, match=known):
            scenario_from(data | {"town": "T"} | inner)
    with pytest.raises(ConfigError, match="a scenario is a mapping of keys, not 3"):
        scenario_from(3)
    loop: list[Any] = []
    loop.append(loop)
    with pytest.raises(ConfigError, match="not plain data: Circular reference"):
        scenario_from(data | {"town": loop})


@pytest.mark.parametrize(("length", "shown"), [(58, '"' + "x" * 58 + '"'), (59, '"' + "x" * 56 + "...")])
def test_long_values_are_cut(length: int, shown: str) -> None:
    with pytest.raises(ConfigError) as raised:
        scenario_from({**PLAIN, "seed": "x" * length})
    assert str(raised.value).endswith(f"not {shown}")


def actor(**changes: Any) -> dict[str, Any]:
    return {"type": "Custom", "actors": [{"name": "v", "model": "walker", "pose": {"x": 0, "y": 0}, **changes}]}


def waiting(**when: Any) -> dict[str, Any]:
    return actor(phases=[{"speed": 1.0, "when": {"kind": "time", **when}}])


# what is the last value allowed, what is the first one refused, and what is said about it
BOUNDS: list[tuple[dict[str, Any], dict[str, Any], str]] = [
    ({"target_speed": 60}, {"target_speed": 60.1}, "target_speed: 60.1 is outside 0 to 60 m/s"),
    ({"target_speed": 0.01}, {"target_speed": 0}, "target_speed: 0 is outside"),
    ({"seed": 0}, {"seed": -1}, "seed: must not be negative"),
    ({"limits": {"max_steps": 1}}, {"limits": {"max_steps": 0}}, "max_steps: 0 is outside 1 to 100000"),
    ({"limits": {"max_steps": 100000}}, {"limits": {"max_steps": 100001}}, "max_steps: 100001 is outside"),
    ({"limits": {"max_time": 0.01}}, {"limits": {"max_time": 0}}, "max_time: must be more than 0 s"),
    ({"limits": {"max_distance": 0.01}}, {"limits": {"max_distance": 0}}, "max_distance: must be more than 0 m"),
    ({"signals": {"until": 0}}, {"signals": {"until": -0.01}}, "until: must not be negative"),
    ({"traffic": {"intensity": 0}}, {"traffic": {"intensity": -0.01}}, "intensity: -0.01 is outside 0 to 1"),
    ({"traffic": {"intensity": 1}}, {"traffic": {"intensity": 1.01}}, "intensity: 1.01 is outside 0 to 1"),
    ({"traffic": {"minimum": 0}}, {"traffic": {"minimum": -1}}, "minimum: -1 is outside 0 to 64"),
    (
        {"traffic": {"minimum": 64, "maximum": 64}},
        {"traffic": {"minimum": 65, "maximum": 64}},
        "minimum: 65 is outside 0 to 64",
    ),
    ({"traffic": {"maximum": 64}}, {"traffic": {"maximum": 65}}, "maximum: 65 is outside minimum (5) to 64"),
    ({"traffic": {"maximum": 5}}, {"traffic": {"maximum": 4}}, "maximum: 4 is outside minimum (5) to 64"),
    ({"traffic": {"wake_distance": 0}}, {"traffic": {"wake_distance": -0.01}}, "wake_distance: must not be negative"),
    ({"traffic": {"draw": 0}}, {"traffic": {"draw": -1}}, "draw: must not be negative"),
    ({"route": [START, {"x": 1e5, "y": 0}]}, {"route": [START, {"x": 100001, "y": 0}]}, "route[1]: beyond 100000 m"),
    ({"route": [START, {"x": 9, "y": -1e5}]}, {"route": [START, {"x": 9, "y": -100001}]}, "route[1]: beyond"),
    ({"trigger": {"x": 0, "y": 0, "yaw": 1e5}}, {"trigger": {"x": 0, "y": 0, "yaw": 100001}}, "trigger: beyond 100000"),
    ({"placements": [END]}, {"placements": [END, {"x": 0, "y": 1e6}]}, "placements[1]: beyond 100000 m"),
    ({"route": [START, END]}, {"route": [START]}, "route: a route needs at least two key points"),
    (actor(pose={"x": 1e5, "y": 0}), actor(pose={"x": 100001, "y": 0}), "actors[0].pose: beyond 100000 m"),
    (actor(body={"length": 0.1}), actor(body={"length": 0.09}), "actors[0].body.length: 0.09 is outside 0.1 to 30 m"),
    (actor(body={"width": 5}), actor(body={"width": 5.01}), "actors[0].body.width: 5.01 is outside 0.1 to 5 m"),
    (actor(body={"height": 6}), actor(body={"height": 7}), "actors[0].body.height: 7 is outside 0.1 to 6 m"),
    (actor(body={"max_speed": 5}, phases=[{"speed": 5}]), actor(phases=[{"speed": 5}]), "speed: 5 is outside 0 to 4"),
    (actor(body={}), actor(body={"size": 3}), "body.size: unknown key; known: length, width, height, wheelbase"),
    (
        {"ego_body": {"brake_build_up": 0}},
        {"ego_body": {"brake_build_up": -1}},
        "brake_build_up: -1 is outside",
    ),
    (
        {"ego_body": {"max_brake": 9.5}},
        {"ego_body": {"max_brake": 0}},
        "max_brake: 0 is outside 0.1 to 30 m/s^2",
    ),
    ({"ego_model": "suv"}, {"ego_model": "suw"}, "ego_model: unknown model 'suw'"),
    ({"ego_model": "truck"}, {"ego_model": "walker"}, "ego_model: walker is no vehicle, which the ego must be"),
    ({"friction": 0.05}, {"friction": 0.04}, "friction: 0.04 is outside 0.05 to 1.5"),
    ({"friction": 1.5}, {"friction": 1.51}, "friction: 1.51 is outside 0.05 to 1.5"),
    (actor(path=[[0, 0], [1, 0]]), actor(path=[[0, 0]]), "actors[0].path: a path needs at least two points"),
    (actor(phases=[{"speed": 4}]), actor(phases=[{"speed": 4.01}]), "phases[0].speed: 4.01 is outside 0 to 4 m/s"),
    (actor(phases=[{"speed": 0}]), actor(phases=[{"speed": -0.01}]), "phases[0].speed: -0.01 is outside 0 to 4 m/s"),
    (waiting(value=0), waiting(value=-0.01), "phases[0].when.value: must not be negative"),
    (waiting(actor=0), waiting(actor=1), "phases[0].when.actor: there are actors 0 to 0"),
    (waiting(actor=0), waiting(actor=-1), "phases[0].when.actor: there are actors 0 to 0"),
    ({"type": "Custom"}, {"type": "Nothing"}, "type: "),
    ({"name": "a/b-1_c.d:e@f+g"}, {"name": "a//b"}, "name: 'a//b' is not a name; use letters, digits, and -_.:@+=/"),
    ({"parameters": {"speed": 17}}, {"parameters": {"speed": 17.01}}, "parameters.speed: 17.01 is outside 7 to 17 m/s"),
    (actor(), actor() | {"type": "RightTurn"}, "actors: only type Custom takes actors; RightTurn makes its own"),
]


@pytest.mark.parametrize(("allowed", "refused", "message"), BOUNDS, ids=[b[2][:40] for b in BOUNDS])
def test_where_the_bounds_are(allowed: dict[str, Any], refused: dict[str, Any], message: str) -> None:
    check(scenario_from(PLAIN | allowed))
    with pytest.raises(ConfigError) as raised:
        scenario_from(PLAIN | refused)
    assert message in str(raised.value)


def test_values_made_in_python_are_checked_too() -> None:
    good = scenario_from(PLAIN)
    for bad, says in (
        (replace(good, trigger=Pose(0.0, float("nan"))), r"scenario a: trigger: beyond 100000 m or not a number"),
        (replace(good, route=(Pose(0, 0), Pose(float("inf"), 0))), r"scenario a: route\[1\]: beyond"),
        (replace(good, town=""), r"scenario a: town: name the town"),
    ):
        with pytest.raises(ConfigError, match=says):
            check(bad)


def test_numpy_numbers_are_written_as_plain_ones() -> None:
    scenario = replace(scenario_from(PLAIN), route=(Pose(0, 0), Pose(9, 0)), parameters={"speed": np.float64(9.5)})
    data = scenario_data(scenario)
    assert (type(data["parameters"]["speed"]), data["parameters"]) == (float, {"speed": 9.5})
    assert list(data) == ["name", "type", "town", "route", "parameters"]


def test_nothing_cannot_be_saved_and_one_of_several_may_be_wrong(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="there is no scenario to save"):
        save_scenarios(tmp_path / "x.yaml", [])
    good = scenario_from(PLAIN)
    with pytest.raises(ConfigError, match="scenario b: seed"):
        scenario_text([good, replace(good, name="b", seed=-1)])
    two = tmp_path / "two.yaml"
    two.write_text(f"{scenario_text([good, replace(good, name='b')])}{scenario_text([replace(good, name='b')])}")
    with pytest.raises(ConfigError, match=r"\[2\]\.name: 'b' is the name of the scenario in line 7 too"):
        read_scenarios(two)


def test_names_of_sets(tmp_path: Path, ssad_home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    towns, learned = ("natural-crossgate", "natural-twinford"), ("training", "training-lanes")
    drawn = ("natural-uniform", "natural-unselected")
    signs = ("speed-signs", "stop-signs")
    shipped = tuple(sorted(("lane-keeping", "lane-traffic", "natural", *towns, *drawn, "precrash", *signs, *learned)))
    assert set_names() == shipped
    mine = scenario_from({**PLAIN, "name": "mine/0"})
    save_scenarios(ssad_home / "scenarios" / "mine.yaml", mine)
    assert set_names() == tuple(sorted(("mine", *shipped)))
    assert load_scenarios("mine") == load_scenarios("mine/0") == (mine,)
    # a set is read again once its file is another one
    save_scenarios(ssad_home / "scenarios" / "mine.yaml", [mine, replace(mine, name="mine/another")])
    assert len(load_scenarios("mine")) == 2
    # the shipped sets keep their names
    save_scenarios(ssad_home / "scenarios" / "precrash.yaml", mine)
    assert len(load_scenarios("precrash")) == 32
    assert {s.town for s in load_scenarios("natural-twinford")} == {"Twinford"}
    assert {s.town for s in load_scenarios("natural-crossgate")} == {"Crossgate"}
    # a class is that of the shipped scenarios
    assert [s.name for s in load_scenarios("RightTurn")] == [f"RightTurn/{k:02d}" for k in range(4)]
    assert len(load_scenarios("NaturalJunction")) == 150
    for name in ("safebench/RightTurn/00", "frea", "frea/Town05_00/00"):
        with pytest.raises(ConfigError, match=rf"scenario '{name}' is not in .*; import it: ssad import routes FOLDER"):
            load_scenarios(name)
    for name in ("mine/1", "NaturalJunctions", "natural/Twinford_00/99"):
        with pytest.raises(UnknownNameError):
            load_scenarios(name)
    for path in ("absent.yaml", "absent.yml", Path("absent")):
        with pytest.raises(SSADError, match=r"absent.*no such file"):
            load_scenarios(path)
