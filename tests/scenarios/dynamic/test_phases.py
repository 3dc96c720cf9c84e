"""Phases in scenario files: what they build, and one line for each mistake, with file and line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssad.core.errors import ConfigError, RouteError
from ssad.core.types import Arrival, Controller, Gap, LateralPhase, Phase, PhaseTrigger
from ssad.scenarios.dynamic import build_episode, read_scenarios, save_scenarios, scenario_from
from ssad.world.roads import load_town
from ssad.world.world import World

TEXT = """\
name: my/cut-in
type: Custom
town: ProvingGround
route:
- {x: 217.0, y: -5.25}
- {x: 317.0, y: -5.25}
actors:
- name: cutter
  model: car
  pose: {x: 240.0, y: -1.75}
  speed: 8.0
  phases:
  - {name: slow, speed: 4.0, acceleration: -2.0, when: {kind: time, value: 2.0}}
  lateral:
  - {lanes: -1, duration: 3.0, when: {kind: time_to_collision, value: 5.0, free_space: true}}
  - lanes: 1
    offset: 0.5
    rate: 1.0
    when:
      any:
      - {kind: phase_end, phase: slow, delay: 1.0}
      - all:
        - {kind: distance, value: 5.0, agent: ego, measure: road}
        - {kind: speed, value: 2.0, agent: ego}
- name: meeting
  model: bicycle
  pose: {x: 260.0, y: -12.0, yaw: 1.5708}
  speed: 2.0
  phases:
  - {speed: 3.0, arrival: {point: [260.0, -7.0], reference_point: [257.0, -5.25]}}
  - {gap: {time: 1.5, reference: cutter, max_speed: 5.0}, continuous: true}
"""


def test_a_file_with_all_kinds_of_phases(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(TEXT)
    (scenario,) = read_scenarios(path)
    cutter, meeting = scenario.actors
    assert cutter.speed == 8.0
    assert cutter.phases == (Phase(4.0, PhaseTrigger("time", 2.0), name="slow", acceleration=-2.0),)
    near = PhaseTrigger("distance", 5.0, agent="ego", measure="road")
    both = PhaseTrigger(all=(near, PhaseTrigger("speed", 2.0, agent="ego")))
    assert cutter.lateral[1] == LateralPhase(
        1, 0.5, PhaseTrigger(any=(PhaseTrigger("phase_end", phase="slow", delay=1.0), both)), rate=1.0
    )
    assert meeting.phases == (
        Phase(3.0, arrival=Arrival((260.0, -7.0), (257.0, -5.25))),
        Phase(gap=Gap(time=1.5, reference="cutter", max_speed=5.0), continuous=True),
    )
    save_scenarios(tmp_path / "again.yaml", scenario)
    assert read_scenarios(tmp_path / "again.yaml") == (scenario,)
    town = load_town("ProvingGround")
    episode = build_episode(scenario, town, seed=0)
    agent = episode.agents[1]
    # the lanes of this town are 3.5 m wide
    assert [float(target[0]) for target in agent.lateral_targets] == [-3.5, 0.5]
    world = World([episode], {"ProvingGround": town}, ego=Controller.FOLLOW)
    for _ in range(150):
        world.step()
    assert world.array("pose")[0, 1, 1] == pytest.approx(-1.75 + 0.5, abs=0.01)
    assert (world.array("script.begun")[0] > 0).all()


def data(**changes: Any) -> dict[str, Any]:
    """A scenario with actors `a`, with changes, and `b`, a standing car."""
    a = {"name": "a", "model": "car", "pose": {"x": 240.0, "y": -5.25}, **changes}
    b = {"name": "b", "model": "car", "pose": {"x": 260.0, "y": -5.25}, "phases": [{"speed": 1.0, "name": "one"}]}
    route = [{"x": 217.0, "y": -5.25}, {"x": 317.0, "y": -5.25}]
    return {"name": "x", "type": "Custom", "town": "ProvingGround", "route": route, "actors": [a, b]}


def phase(**changes: Any) -> dict[str, Any]:
    return data(phases=[{"speed": 5.0, **changes}])


def kept(**changes: Any) -> dict[str, Any]:
    return data(phases=[{"gap": {"distance": 5.0}, **changes}])


def swerve(**changes: Any) -> dict[str, Any]:
    return data(lateral=[changes])


def when(**trigger: Any) -> dict[str, Any]:
    return phase(when=trigger)


MEETING = {"point": [250.0, -5.25], "reference_point": [230.0, -5.25]}
REFUSED: list[tuple[dict[str, Any], str]] = [
    (data(speed=-1.0), "actors[0].speed: -1 is outside 0 to 50 m/s (car)"),
    (data(speed=51.0), "actors[0].speed: 51 is outside"),
    (data(phases=[{"name": "n"}]), "phases[0]: key 'speed' is missing"),
    (phase(acceleration=0.0), "phases[0].acceleration: 0 is 0 or beyond 100 m/s^2"),
    (phase(jerk=-1.0), "phases[0].jerk: -1 is outside 0 to 1000"),
    (phase(duration=0.0), "phases[0].duration: 0 is outside"),
    (phase(distance=-3.0), "phases[0].distance: -3 is outside"),
    (phase(duration=1.0, acceleration=2.0), "phases[0].duration: acceleration fixes the pace already"),
    (phase(shape="round"), 'phases[0].shape: "round" is not one of'),
    (phase(shape="sinusoidal"), "phases[0].shape: a sinusoidal course needs an acceleration, a duration or a distance"),
    (phase(shape="step", duration=1.0), "phases[0].duration: a step takes no time"),
    (phase(shape="cubic", acceleration=1.0, jerk=1.0), "phases[0].jerk: a jerk goes with the shape linear"),
    (phase(reference="c"), "phases[0].reference: there is no actor 'c'; there are: ego, a, b"),
    (phase(reference="a"), "phases[0].reference: 'a' is this actor itself"),
    (phase(reference="ego", factor=True, speed=-1.0), "phases[0].speed: a factor must not be negative"),
    (phase(factor=True), "phases[0].factor: needs a `reference`"),
    (phase(continuous=True), "phases[0].continuous: needs a `reference`"),
    (phase(reference="b", continuous=True, duration=1.0), "phases[0].continuous: a phase that follows"),
    (phase(arrival=MEETING, duration=2.0), "phases[0].arrival: an arrival sets the pace"),
    (phase(arrival={**MEETING, "point": [1e6, 0.0]}), "arrival.point: beyond 100000 m"),
    (phase(arrival={**MEETING, "reference": "c"}), "arrival.reference: there is no actor 'c'"),
    (phase(arrival={"point": [1.0, 2.0]}), "arrival: key 'reference_point' is missing"),
    (phase(gap={"distance": 5.0}), "phases[0].speed: a gap determines the speed; leave it out"),
    (kept(duration=2.0), "phases[0].duration: a gap determines the speed"),
    (data(phases=[{"gap": {"reference": "b"}}]), "phases[0].gap: needs a distance, a time or both"),
    (data(phases=[{"gap": {"distance": -1.0}}]), "phases[0].gap.distance: -1 is outside 0 to 10000"),
    (data(phases=[{"gap": {"time": 1.0, "max_deceleration": 0.0}}]), "phases[0].gap.max_deceleration: 0 is outside"),
    (data(phases=[{"gap": {"time": 1.0, "max_speed": 60.0}}]), "phases[0].gap.max_speed: 60 is outside 0 to 50"),
    (data(phases=[{"gap": {"time": 1.0, "reference": "c"}}]), "phases[0].gap.reference: there is no actor 'c'"),
    (data(phases=[{"gap": {"time": 1.0, "side": "left"}}]), 'phases[0].gap.side: "left" is not one of'),
    (data(phases=[{"gap": {"gap": 1.0}}]), "phases[0].gap.gap: unknown key; known: distance, time, reference"),
    (phase(accel=1.0), "phases[0].accel: unknown key; known: speed, when, name, acceleration"),
    (swerve(rate=-0.5), "lateral[0].rate: -0.5 is outside"),
    (swerve(rate=1.0, duration=2.0), "lateral[0].duration: rate fixes the pace already"),
    (swerve(lanes=11), "lateral[0].lanes: 11 is outside -10 to 10"),
    (swerve(offset=101.0), "lateral[0].offset: 101 is outside"),
    (swerve(lane=1), "lateral[0].lane: unknown key; known: lanes, offset"),
    (data(model="cone", lateral=[{"lanes": 1}]), "actors[0].lateral: nobody drives a cone"),
    (data(policy="blind", lateral=[{"lanes": 1}]), "lateral: an actor with a trajectory or a policy has no lateral"),
    (when(kind="distance", value=5.0, delay=-1.0), "when.delay: -1 is outside 0 to 600 s"),
    (when(kind="distance", value=5.0, position=[0.0, 1e6]), "when.position: beyond 100000 m"),
    (when(kind="time", value=1.0, measure="road"), "when.measure: the kind time has none; it goes with: distance"),
    (when(kind="speed", value=1.0, phase="x"), "when.phase: the kind speed has none"),
    (when(kind="distance", value=5.0, reference="a"), "when.reference: names the agent itself"),
    (when(kind="distance", value=5.0, agent="c"), "when.agent: there is no actor 'c'"),
    (when(kind="position", value=5.0), "when: key 'position' is missing"),
    (when(any=[{"kind": "time", "value": -1.0}]), "when.any[0].value: must not be negative"),
    (when(all=[{"kind": "near"}]), 'when.all[0].kind: "near" is not one of'),
    (when(any=[{"knd": "time"}]), "when.any[0].knd: unknown key; known: kind, value"),
    (when(kind="distance", value=5.0, actor=1), "when.actor: the kind distance names agents by `agent` and `ref"),
    (when(kind="phase_end", agent="b", phase="one", value=2.0), "when.value: the kind phase_end has none; `delay`"),
    # triggers of which it is certain that they never fire
    (when(kind="distance", value=0.0), "when.value: never fires: distance is never below 0"),
    (when(kind="always", edge="rising"), "when.edge: never fires: what always holds never changes"),
    (when(kind="phase_end", agent="b", phase="one", edge="falling"), "never fires: phase_end never ceases to hold"),
    (when(kind="phase_end", phase="two"), "when.phase: actor a has no phase 'two'; none of its phases has a name"),
    (when(kind="phase_end", agent="b", phase="two"), "actor b has no phase 'two'; its phases: one"),
    (when(kind="phase_start", agent="ego", phase="x"), "when.agent: the ego has no phases; name an actor"),
    (when(kind="phase_end"), "when: key 'phase' is missing"),
    (phase(name="p", when={"kind": "phase_start", "phase": "p"}), "phases[0].when: never fires: it waits for itself"),
    (
        data(
            phases=[
                {"speed": 1.0, "name": "p", "when": {"kind": "phase_end", "phase": "q"}},
                {"speed": 2.0, "name": "q", "anytime": True, "when": {"kind": "phase_start", "phase": "p"}},
            ]
        ),
        "phases[0].when: never fires",
    ),
    (
        data(
            phases=[{"speed": 0.0, "name": "p", "reference": "b", "continuous": True}],
            lateral=[{"lanes": 1, "when": {"kind": "phase_end", "phase": "p"}}],
        ),
        "lateral[0].when: never fires: it waits for itself, or for a phase that never begins or ends",
    ),
    (
        data(phases=[{"speed": 1.0, "name": "p"}, {"speed": 2.0, "name": "p"}]),
        "phases[0].name: 'p' names two phases of actor a",
    ),
]


@pytest.mark.parametrize(("scenario", "message"), REFUSED, ids=[message[:50] for _, message in REFUSED])
def test_mistakes_are_named_in_one_line(scenario: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as raised:
        scenario_from(scenario)
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    "scenario",
    [
        phase(reference="b", speed=-3.0, continuous=True),
        kept(continuous=True),
        phase(name="p", when={"any": [{"kind": "phase_start", "phase": "p"}, {"kind": "time", "value": 1.0}]}),
        when(kind="ego_distance", value=0.0),
        when(kind="acceleration", value=-4.0, rule="below", agent="b"),
        data(
            phases=[
                {"speed": 0.0, "name": "p", "reference": "b", "continuous": True},
                {"speed": 1.0, "when": {"kind": "time", "value": 3.0}},
            ],
            lateral=[{"lanes": 1, "when": {"kind": "phase_end", "phase": "p"}}],
        ),
    ],
)
def test_what_may_happen_is_allowed(scenario: dict[str, Any]) -> None:
    scenario_from(scenario)


def test_a_name_must_mean_one_agent() -> None:
    scenario = phase(reference="b")
    scenario["actors"].append({**scenario["actors"][1]})
    with pytest.raises(ConfigError, match=r"phases\[0\].reference: 'b' names more than one agent"):
        scenario_from(scenario)
    del scenario["actors"][0]["phases"]
    scenario_from(scenario)


def test_the_message_names_file_and_line(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(TEXT.replace("phase: slow", "phase: slower"))
    with pytest.raises(ConfigError, match=r"mine.yaml.*21.*actor cutter has no phase 'slower'; its phases: slow"):
        read_scenarios(path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"lateral": [{"lanes": 6}]},
            r"actor a: lateral phase 1: the road at \(240.0, -5.2\) has no lane 6 to the left",
        ),
        ({"lateral": [{"lanes": -2}]}, r"has no lane 2 to the right; change `lanes`, or give an `offset`"),
        (
            {"phases": [{"arrival": {**MEETING, "reference_point": [230.0, 20.0]}}]},
            r"actor a: phase 1: agent ego: the meeting point \(230, 20\) is 25.2 m off its path",
        ),
    ],
)
def test_what_the_road_does_not_have_is_named(changes: dict[str, Any], message: str) -> None:
    scenario = scenario_from(data(**changes))
    with pytest.raises(RouteError, match=message):
        build_episode(scenario, load_town("ProvingGround"), seed=0)


def test_lanes_are_counted_as_the_path_sees_them() -> None:
    """An actor against the traffic of its lane has the lanes on the other side."""
    town = load_town("ProvingGround")
    east = data(lateral=[{"lanes": 1}, {"lanes": 1}])
    west = data(pose={"x": 240.0, "y": -5.25, "yaw": float(np.pi)}, lateral=[{"lanes": -1}, {"lanes": -1}])
    for scenario, targets in ((east, [3.5, 7.0]), (west, [-3.5, -7.0])):
        agent = build_episode(scenario_from(scenario), town, seed=0).agents[1]
        np.testing.assert_allclose([target[0] for target in agent.lateral_targets], targets, atol=0.01)
