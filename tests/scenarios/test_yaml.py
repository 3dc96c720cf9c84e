"""Scenario files: what is written is read back equal, and every mistake is named with its line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ssad.core.errors import ConfigError, SSADError, UnknownNameError
from ssad.core.types import (
    Actor,
    Condition,
    Limits,
    Phase,
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
)
from ssad.world.models import MODELS

number = st.floats(-1.0e5, 1.0e5, allow_subnormal=False)
positive = st.floats(1e-3, 1.0e4)
poses = st.builds(Pose, number, number, number)
light = st.sampled_from(["program", "off", "red", "green"])
texts = st.text(max_size=20).filter(lambda t: all(c.isprintable() for c in t))


@st.composite
def scenarios(draw: st.DrawFn) -> Scenario:
    kind = draw(st.sampled_from([*SCENARIOS, "Custom"]))
    actors: tuple[Actor, ...] = ()
    if kind == "Custom":
        condition = st.builds(
            Condition,
            st.sampled_from(["always", "ego_distance", "ego_speed", "travelled", "time"]),
            positive,
            st.just(0),
        )
        phase = st.builds(Phase, st.floats(0.0, 1.0).map(float), condition)
        body = st.sampled_from([m for m in MODELS if MODELS[m].max_speed >= 1.0])
        path = st.lists(st.tuples(number, number), min_size=2, max_size=4).map(tuple)
        actor = st.builds(Actor, texts, body, poses, st.lists(phase, max_size=3).map(tuple), path)
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
        limits=draw(st.builds(Limits, st.integers(1, 1000), positive, positive)),
        target_speed=draw(st.floats(0.5, 30.0)),
        seed=draw(st.integers(0, 2**40)),
        group=draw(texts),
        source=draw(texts),
    )


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
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
    assert scenario.actors[0].phases[1] == Phase(0.0, Condition("travelled", 20.0))
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
    ({"route": "[{x: 0, y: 0}]"}, 4, "at least two key points"),
    ({"route": "[{x: 0, y: 0}, {x: nine, y: 0}]"}, 4, 'route[1].x: should be a valid number, not "nine"'),
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
    assert len(load_scenarios("natural-twinford")) == 70
    assert len(load_scenarios("natural-crossgate")) == 80
    assert len(load_scenarios("natural")) == 150
    assert len({s.name for s in load_scenarios("natural") + precrash}) == 182
    assert load_scenarios("RightTurn/02") == (load_scenarios("RightTurn")[2],)
