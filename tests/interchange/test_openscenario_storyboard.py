"""Storyboards: what events state becomes phases that drive so, and triggers that never fire are named."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.command import ssad
from helpers.openscenario import LENGTH as ROAD_LENGTH
from helpers.openscenario import by_entity, by_time, document, event, lane_position, speed_action, start, write

from ssad.core.errors import FormatError
from ssad.core.types import Controller, EpisodeTrace, FollowingGap, LateralPhase, Phase, PhaseTrigger, Scenario
from ssad.interchange.export import export_openscenario
from ssad.interchange.openscenario_reader import read_openscenario, read_openscenario_set
from ssad.scenarios.dynamic import build_episode
from ssad.world.roads import load_town
from ssad.world.rollout import rollout
from ssad.world.world import World

STEP = 0.1  # s
LENGTH = 4.4  # m of the bodies


class Steady:
    """Drives at the target speed of the episode."""

    name = "steady"
    controller = Controller.FOLLOW

    def __init__(self, speed: float) -> None:
        self.target_speed = speed

    def reset(self, episodes: object) -> None: ...

    def act(self, view: object) -> None: ...


def drive(scenario: Scenario, speed: float) -> EpisodeTrace:
    town = load_town(scenario.town)
    episode = build_episode(scenario, town, seed=0)
    (trace,) = rollout(World([episode], {scenario.town: town}), Steady(speed))  # type: ignore[arg-type]
    return trace


def lane_change(lanes: int, shape: str, dimension: str, value: float, entity: str = "Ego", offset: float = 0) -> str:
    return (
        f'<LateralAction><LaneChangeAction targetLaneOffset="{offset}"><LaneChangeActionDynamics'
        f' dynamicsShape="{shape}" value="{value}" dynamicsDimension="{dimension}"/><LaneChangeTarget>'
        f'<RelativeTargetLane entityRef="{entity}" value="{lanes}"/></LaneChangeTarget></LaneChangeAction>'
        "</LateralAction>"
    )


def state(element: str, kind: str, value: str, delay: float = 0.0) -> str:
    return (
        f'<Condition name="state" delay="{delay}" conditionEdge="none"><ByValueCondition><StoryboardElementState'
        f'Condition storyboardElementType="{kind}" storyboardElementRef="{element}" state="{value}"/>'
        "</ByValueCondition></Condition>"
    )


def distance(value: float, *, kind: str = "longitudinal", freespace: str = "true", rule: str = "lessThan") -> str:
    return (
        f'<RelativeDistanceCondition entityRef="Target" relativeDistanceType="{kind}" value="{value}"'
        f' freespace="{freespace}" rule="{rule}"/>'
    )


def actor_of(folder: Path, *events: str, target: tuple[str, float] = ("", 10.0)) -> object:
    position = target[0] or lane_position(-2, 100)
    starts = start("Ego", lane_position(-1, 20), 15) + start("Target", position, target[1])
    return read_openscenario(write(folder, document(starts, "".join(events)))).scenario.actors[0]


def test_a_cut_in_of_r157_drives_as_written(tmp_path: Path) -> None:
    """Speeds, the distance of the trigger, the lateral speed and the braking after it, as computed by hand."""
    ego, target, gap, rate, braking = 54 / 3.6, 36 / 3.6, 30.0, 1.2, 2.0
    ahead = gap + 6.0 * (ego - target)
    starts = start("Ego", lane_position(-1, 5), ego) + start(
        "Target",
        f'<Position><RelativeLanePosition entityRef="Ego" dLane="-1" ds="{ahead}" offset="0"/></Position>',
        target,
    )
    near = by_entity("Ego", distance(gap), edge="rising")
    events = event("cut in", lane_change(0, "sinusoidal", "rate", rate), near)
    events += event("brake", speed_action(5, "linear", "rate", braking), state("cut in", "event", "completeState"))
    imported = read_openscenario(write(tmp_path, document(starts, events, stop=by_time(16))))
    assert imported.omissions == imported.doubts == ()
    limits = replace(imported.scenario.limits, contact="count")
    trace = drive(replace(imported.scenario, limits=limits), ego)
    time = np.arange(len(trace.x)) * STEP
    assert trace.speed[:40, 1] == pytest.approx(target, abs=1e-3)
    # The bodies are 30 m apart after (ahead - length - gap) / (difference of the speeds).
    begins = (ahead - LENGTH - gap) / (ego - target)
    takes = math.pi * 3.5 / (2.0 * rate)
    aside = trace.y[:, 1] - trace.y[0, 1]
    half = float(np.interp(0.5 * 3.5, aside[: int((begins + takes) / STEP)], time[: int((begins + takes) / STEP)]))
    assert half == pytest.approx(begins + 0.5 * takes, abs=0.01 * begins + STEP)
    assert np.abs(np.diff(aside)).max() / STEP == pytest.approx(rate, rel=0.01)
    assert aside[-1] == pytest.approx(3.5, abs=0.01)
    slower = np.diff(trace.speed[:, 1])
    braked = np.flatnonzero(slower < -0.5 * braking * STEP)
    assert time[braked[0]] == pytest.approx(begins + takes, abs=2 * STEP)
    assert slower[braked[1:-1]] == pytest.approx(-braking * STEP, rel=0.02)
    assert trace.speed[-1, 1] == pytest.approx(5.0, abs=0.01)


def test_actions_become_phases_with_their_dynamics(tmp_path: Path) -> None:
    relative = (
        '<LongitudinalAction><SpeedAction><SpeedActionDynamics dynamicsShape="sinusoidal" value="4"'
        ' dynamicsDimension="time"/><SpeedActionTarget><RelativeTargetSpeed entityRef="Ego" value="0.8"'
        ' speedTargetValueType="factor" continuous="false"/></SpeedActionTarget></SpeedAction></LongitudinalAction>'
    )
    profile = (
        '<LongitudinalAction><SpeedProfileAction followingMode="position"><SpeedProfileEntry speed="10" time="0"/>'
        '<SpeedProfileEntry speed="4" time="3"/><SpeedProfileEntry speed="6" time="2"/></SpeedProfileAction>'
        "</LongitudinalAction>"
    )
    offset = (
        '<LateralAction><LaneOffsetAction continuous="false"><LaneOffsetActionDynamics dynamicsShape="sinusoidal"'
        ' maxLateralAcc="0.5"/><LaneOffsetTarget><AbsoluteTargetLaneOffset value="1"/></LaneOffsetTarget>'
        "</LaneOffsetAction></LateralAction>"
    )
    meeting = (
        f'<SynchronizeAction masterEntityRef="Ego"><TargetPositionMaster>{lane_position(-1, 300)[10:-11]}'
        f"</TargetPositionMaster><TargetPosition>{lane_position(-2, 300)[10:-11]}</TargetPosition><FinalSpeed>"
        '<AbsoluteSpeed value="9"/></FinalSpeed></SynchronizeAction>'
    )
    actor = actor_of(
        tmp_path,
        event("brake", speed_action(3, "linear", "rate", 4), by_time(2)),
        event("match", relative, state("brake", "event", "completeState", delay=1)),
        event("profile", profile, state("match action", "action", "endTransition") + by_time(9)),
        event("left", lane_change(1, "cubic", "distance", 40, "Target", 0.25), by_time(1)),
        event("offset", offset, state("left", "event", "completeState")),
        event("meet", meeting, by_time(20)),
    )
    after = PhaseTrigger("phase_end", agent="Target", phase="brake", delay=1.0)
    assert actor.speed == 10.0  # type: ignore[attr-defined]
    phases = actor.phases  # type: ignore[attr-defined]
    assert phases[0] == Phase(3.0, PhaseTrigger("time", 2.0), name="brake", acceleration=4.0)
    matched = {"reference": "ego", "factor": True, "shape": "sinusoidal", "duration": 4.0}
    assert phases[1] == Phase(0.8, after, name="match", **matched)
    assert [(phase.speed, phase.duration) for phase in phases[2:4]] == [(4.0, 3.0), (6.0, 2.0)]
    assert phases[3].when == PhaseTrigger("phase_end", agent="Target", phase="profile")
    assert phases[4].arrival.point == pytest.approx((301.4, -5.25))
    assert phases[4].arrival.reference_point == pytest.approx((301.4, -1.75))
    left, aside = actor.lateral  # type: ignore[attr-defined]
    when = PhaseTrigger("time", 1.0)
    assert left == LateralPhase(1, offset=0.25, when=when, name="left", shape="cubic", distance=40.0)
    assert (aside.lanes, aside.offset) == (0, 1.0)
    assert aside.duration == pytest.approx(math.pi * math.sqrt(0.5 * 0.75 / 0.5))


@pytest.mark.parametrize(
    ("condition", "trigger"),
    [
        (by_time(3, delay=0.5), PhaseTrigger("time", 3.5)),
        (by_entity("Target", '<TraveledDistanceCondition value="12"/>'), PhaseTrigger("travelled", 12.0)),
        (
            by_entity("Ego", '<SpeedCondition value="9" rule="lessOrEqual"/>', edge="rising", delay=0.2),
            PhaseTrigger("speed", 9.0, agent="ego", rule="below", edge="rising", delay=0.2),
        ),
        (
            by_entity("Target", '<RelativeSpeedCondition entityRef="Ego" value="-2" rule="lessThan"/>'),
            PhaseTrigger("relative_speed", -2.0, reference="ego", rule="below"),
        ),
        (by_entity("Target", '<StandStillCondition duration="2"/>'), PhaseTrigger("standstill", 2.0)),
        (
            by_entity("Target", '<AccelerationCondition value="-1" rule="lessThan"/>', edge="falling"),
            PhaseTrigger("acceleration", -1.0, rule="below", edge="falling"),
        ),
        (
            by_entity("Ego", '<TimeHeadwayCondition entityRef="Target" value="1.5" freespace="true" rule="lessThan"/>'),
            PhaseTrigger("time_headway", 1.5, agent="ego", reference="Target", free_space=True),
        ),
        (
            by_entity(
                "Ego",
                '<TimeToCollisionCondition value="2.5" freespace="false" rule="lessThan"'
                ' relativeDistanceType="longitudinal"><TimeToCollisionConditionTarget><EntityRef entityRef="Target"/>'
                "</TimeToCollisionConditionTarget></TimeToCollisionCondition>",
            ),
            PhaseTrigger("time_to_collision", 2.5, agent="ego", reference="Target", measure="road"),
        ),
        (
            by_entity("Ego", f'<ReachPositionCondition tolerance="2">{lane_position(-1, 90)}</ReachPositionCondition>'),
            PhaseTrigger("position", 2.0, agent="ego", position=(91.4, -1.75)),
        ),
        (
            by_entity("Target", f"{distance(8, kind='lateral', freespace='false')}".replace('"Target"', '"Ego"')),
            PhaseTrigger("distance", 8.0, reference="ego", measure="lateral"),
        ),
        (
            by_entity("Ego", '<CollisionCondition><EntityRef entityRef="Target"/></CollisionCondition>'),
            PhaseTrigger("distance", 0.01, agent="ego", reference="Target", free_space=True),
        ),
        (
            by_time(3) + by_entity("Ego", distance(50)),
            PhaseTrigger(
                all=(
                    PhaseTrigger("time", 3.0),
                    PhaseTrigger("distance", 50.0, agent="ego", reference="Target", free_space=True, measure="road"),
                )
            ),
        ),
    ],
)
def test_conditions_become_triggers(condition: str, trigger: PhaseTrigger, tmp_path: Path) -> None:
    actor = actor_of(tmp_path, event("stop", speed_action(0, "linear", "rate", 3), condition))
    when = actor.phases[0].when  # type: ignore[attr-defined]
    if trigger.position is not None:
        assert when.position == pytest.approx(trigger.position, abs=1e-6)
        trigger = PhaseTrigger(trigger.kind, trigger.value, agent=trigger.agent, position=when.position)
    assert when == trigger


def test_groups_are_alternatives(tmp_path: Path) -> None:
    actor = actor_of(tmp_path, event("stop", speed_action(0, "linear", "rate", 3), by_time(9), by_time(4)))
    expected = PhaseTrigger(any=(PhaseTrigger("time", 9.0), PhaseTrigger("time", 4.0)))
    assert actor.phases[0].when == expected  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("condition", "reason"),
    [
        (by_time(0, rule="lessThan"), "the time is never below 0 s"),
        (by_entity("Ego", distance(0)), "RelativeDistanceCondition is never below 0"),
        (state("nothing", "event", "completeState"), "there is no event 'nothing'"),
        (state("stop", "event", "completeState"), "events wait for each other"),
        (state("maneuver", "maneuver", "completeState"), "events wait for each other"),
    ],
)
def test_a_trigger_that_never_fires_is_named_with_its_line(condition: str, reason: str, tmp_path: Path) -> None:
    starts = start("Ego", lane_position(-1, 20), 15) + start("Target", lane_position(-2, 100), 10)
    go = event(
        "stop", "<TeleportAction/>" if "each other" in reason else speed_action(0, "linear", "rate", 3), condition
    )
    path = write(tmp_path, document(starts, go))
    (doubt,) = read_openscenario_set(path).report.doubts.items()
    assert doubt[0] == f"the trigger of 'stop' can never fire: {reason}"
    name, line = doubt[1][0].rsplit(":", 1)
    assert name == str(path)
    assert condition.partition(">")[0] in path.read_text().splitlines()[int(line) - 1]
    refused = ssad("import", "openscenario", path, tmp_path / "out.yaml", "--strict")
    assert refused.returncode == 2
    assert len(refused.stderr.splitlines()) == 1
    assert not (tmp_path / "out.yaml").exists()


BRAKE = speed_action(0, "linear", "rate", 3)
TRAVELLED = by_entity("Target", '<TraveledDistanceCondition value="20"/>')


@pytest.mark.parametrize(
    ("action", "condition", "message"),
    [
        (BRAKE, by_time(3, rule="moreThan"), "SimulationTimeCondition: rule is 'moreThan'; known: greaterThan, "),
        (BRAKE, TRAVELLED.replace('Rule="any"', 'Rule="some"'), "triggeringEntitiesRule is 'some'; known: any, all, "),
        (speed_action(0, "linear", "time", -2), by_time(3), "SpeedActionDynamics: value is -2; a time is not negative"),
        (lane_change(0, "linear", "distance", -2), by_time(3), "value is -2; a distance is not negative"),
    ],
)
def test_values_that_the_standard_excludes_are_refused(
    action: str, condition: str, message: str, tmp_path: Path
) -> None:
    with pytest.raises(FormatError, match=r"test\.xosc:\d+: ") as error:
        actor_of(tmp_path, event("it", action, condition))
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("speed", "offset", "action", "condition", "doubt"),
    [
        (50, 0, BRAKE, by_time(3), "the ego starts with a speed of 40 m/s, not 50 m/s"),
        (15, 1.6, BRAKE, by_time(3), "the ego starts with a distance to the left of its route of 1 m, not 1.6 m"),
        (15, 0, BRAKE, by_time(70), "event 'it' of 'Target' waits for 70 s; the episode ends at 60 s"),
        (15, 0, BRAKE, by_time(3, rule="notEqualTo"), "the trigger of 'it' is not carried over"),
        (15, 0, BRAKE, TRAVELLED.replace('"any"', '"none"'), "the trigger of 'it' is not carried over"),
        (
            15,
            0,
            speed_action(0, "linear", "rate", 0),
            by_time(3),
            "a SpeedAction of 'Target' has the rate 0, with which its target is never reached: the speed stays as it "
            "is, and the action has no end",
        ),
        (
            15,
            0,
            BRAKE.replace('dynamicsDimension="rate"', ""),
            by_time(3),
            "dynamicsDimension is missing: taken as time",
        ),
    ],
)
def test_what_drives_otherwise_than_stated_is_a_doubt(
    speed: float, offset: float, action: str, condition: str, doubt: str, tmp_path: Path
) -> None:
    starts = start("Ego", lane_position(-1, 20, offset), speed) + start("Target", lane_position(-2, 100), 10)
    imported = read_openscenario(write(tmp_path, document(starts, event("it", action, condition))))
    assert doubt in imported.doubts


def test_the_length_of_the_ego_s_lane_is_that_of_the_road(tmp_path: Path) -> None:
    starts = start("Ego", lane_position(-1, 20), 40) + start("Target", lane_position(-2, 100), 10)
    report = read_openscenario_set(write(tmp_path, document(starts))).report
    (place,) = report.notes["the ego has no route: it follows its lane"]
    assert float(place.removesuffix(" m")) == pytest.approx(ROAD_LENGTH - 20, abs=2.0)


@pytest.mark.parametrize("others", [0, 1])
def test_an_event_may_wait_for_the_start_of_its_own_act(others: int, tmp_path: Path) -> None:
    brake = event("brake", speed_action(3, "linear", "rate", 4), state("act", "act", "startTransition"))
    change = event("change", lane_change(0, "sinusoidal", "time", 3), state("brake", "event", "completeState"))
    starts = start("Ego", lane_position(-1, 20), 15) + start("Target", lane_position(-2, 100), 10)
    imported = read_openscenario(write(tmp_path, document(starts, brake + others * change)))
    (phase,) = imported.scenario.actors[0].phases
    assert (phase.name, phase.when.kind) in {("brake", "always"), ("brake", "time")}
    assert len(imported.scenario.actors[0].lateral) == others
    assert not imported.doubts


@pytest.mark.parametrize("along", [20.0, 90.0, 250.0])
def test_the_ego_starts_where_the_file_says_on_a_route_that_begins_earlier(along: float, tmp_path: Path) -> None:
    waypoints = "".join(
        f'<Waypoint routeStrategy="shortest">{lane_position(-1, s)}</Waypoint>' for s in (20, 100, 200, 300)
    )
    route = (
        '<Private entityRef="Ego"><PrivateAction><RoutingAction><AssignRouteAction><Route name="way" closed="false">'
        f"{waypoints}</Route></AssignRouteAction></RoutingAction></PrivateAction></Private>"
    )
    starts = start("Ego", lane_position(-1, along), 15) + start("Target", lane_position(-2, 100), 10)
    imported = read_openscenario(write(tmp_path, document(starts + route)))
    town = load_town(imported.scenario.town)
    ego = build_episode(imported.scenario, town, seed=0).agents[0]
    stated = read_openscenario(write(tmp_path, document(starts))).scenario
    without_route = build_episode(stated, town, seed=0).agents[0]
    assert (ego.pose.x, ego.pose.y) == pytest.approx((without_route.pose.x, without_route.pose.y), abs=1e-3)
    assert ego.route is not None
    assert ego.route.length == pytest.approx(300 - along, abs=11.0)
    assert not imported.doubts


def test_long_chains_of_waiting_events_are_refused(tmp_path: Path) -> None:
    show = '<VisibilityAction graphics="true" traffic="true" sensors="true"/>'
    events = [event("brake", speed_action(3, "linear", "rate", 4), state("0", "event", "completeState"))]
    events += [event(f"{number}", show, state(f"{number + 1}", "event", "startTransition")) for number in range(300)]
    with pytest.raises(FormatError, match=r"test\.xosc:\d+: Storyboard\w*: '\d+' ends a chain of more than 50 events"):
        actor_of(tmp_path, *events, event("300", show, by_time(2)))


def keep(limits: str = "", **attributes: str) -> str:
    stated = {"entityRef": "Ego", "freespace": "true", "continuous": "true"} | attributes
    text = " ".join(f'{name}="{value}"' for name, value in stated.items())
    return (
        f"<LongitudinalAction><LongitudinalDistanceAction {text}>{limits}</LongitudinalDistanceAction>"
        "</LongitudinalAction>"
    )


def test_a_distance_to_another_entity_is_kept(tmp_path: Path) -> None:
    """As a gap with the limits of the file; the target falls back to it, and the exported file drives as this one."""
    limits = '<DynamicConstraints maxAcceleration="2" maxDeceleration="3" maxSpeed="30"/>'
    behind = keep(limits, distance="25", displacement="trailingReferencedEntity")
    starts = start("Ego", lane_position(-1, 40), 15) + start("Target", lane_position(-2, 10), 15)
    imported = read_openscenario(write(tmp_path, document(starts, event("keep", behind, by_time(1)), stop=by_time(12))))
    gap = FollowingGap(25.0, free_space=True, max_acceleration=2.0, max_deceleration=3.0, max_speed=30.0)
    assert imported.scenario.actors[0].phases == (
        Phase(when=PhaseTrigger("time", 1.0), name="keep", continuous=True, gap=gap),
    )
    assert imported.doubts == ()
    files, _ = export_openscenario([imported.scenario], tmp_path / "out")
    again = read_openscenario(next(path for path in files if path.suffix == ".xosc"))
    assert again.scenario.actors[0].phases[0].gap == gap
    trace = drive(imported.scenario, 15.0)
    assert trace.x[-1, 0] - trace.x[-1, 1] == pytest.approx(25.0 + LENGTH, abs=0.05)


def test_a_distance_without_limits_is_there_at_the_start(tmp_path: Path) -> None:
    """Between reference points and in time; in the middle of an episode nobody jumps, which is a doubt."""
    ahead = keep(timeGap="2", freespace="false", displacement="leadingReferencedEntity")
    starts = start("Ego", lane_position(-1, 20), 15)
    starts += start("Target", lane_position(-2, 30), 10, f"<PrivateAction>{ahead}</PrivateAction>")
    actor = read_openscenario(write(tmp_path, document(starts))).scenario.actors[0]
    assert actor.pose.x == pytest.approx(20.0 + 2.0 * 10.0 + 1.4)
    (phase,) = actor.phases
    assert phase.gap == FollowingGap(time=2.0, side="ahead")
    starts = start("Ego", lane_position(-1, 20), 15) + start("Target", lane_position(-2, 100), 10)
    late = read_openscenario(write(tmp_path, document(starts, event("late", keep(distance="9"), by_time(2)))))
    assert late.scenario.actors[0].phases[0].gap == FollowingGap(9.0, free_space=True, side="any")
    assert late.doubts == ("LongitudinalDistanceAction in event 'late': 'Target' drives there, it does not jump",)


WEATHER = '<GlobalAction><EnvironmentAction><Environment name="rain"/></EnvironmentAction></GlobalAction>'
FLASH = "<AppearanceAction><LightStateAction/></AppearanceAction>"
ACTIVATE = '<ActivateControllerAction longitudinal="true"/>'
ACTIVATE_EGO = f"<Private entityRef='Ego'><PrivateAction>{ACTIVATE}</PrivateAction></Private>"
STANDING = by_entity("Ego", '<StandStillCondition duration="2"/>')
TELEPORT = f"<TeleportAction>{lane_position(-1, 200)}</TeleportAction>"


@pytest.mark.parametrize(
    ("starts", "action", "stop", "line"),
    [
        (WEATHER, "", "", "not carried over: EnvironmentAction at the start"),
        ("", FLASH, "", "not carried over: LightStateAction in event 'it'"),
        ("", '<VisibilityAction graphics="false"/>', "", "not carried over: VisibilityAction in event 'it'"),
        (ACTIVATE_EGO, "", "", "not carried over: ActivateControllerAction at the start of 'Ego'"),
        ("", ACTIVATE.replace("true", "false"), "", "not carried over: ActivateControllerAction in event 'it'"),
        ("", ACTIVATE, "", "doubtful: ActivateControllerAction in event 'it' is not carried over"),
        ("", TELEPORT, "", "doubtful: TeleportAction in event 'it' is not carried over"),
        ("", "", STANDING, "doubtful: StandStillCondition of the stop trigger is not carried over"),
    ],
)
def test_strict_refuses_what_changes_motions(starts: str, action: str, stop: str, line: str, tmp_path: Path) -> None:
    """Weather, lights and controllers of the ego are named; other motions and other ends are refused."""
    starts += start("Ego", lane_position(-1, 20), 15) + start("Target", lane_position(-2, 100), 10)
    path = write(tmp_path, document(starts, event("it", action, by_time(1)) if action else "", stop=stop))
    done = ssad("import", "openscenario", path, tmp_path / "out.yaml")
    assert [text for text in done.stdout.splitlines() if text.startswith(("not carried over", "doubtful"))] == [line]
    strict = ssad("import", "openscenario", path, tmp_path / "strict.yaml", "--strict")
    if line.startswith("doubtful"):
        assert strict.returncode == 2
        assert line.partition(": ")[2] in strict.stderr
        assert not (tmp_path / "strict.yaml").exists()
    else:
        assert (tmp_path / "strict.yaml").read_bytes() == (tmp_path / "out.yaml").read_bytes()


def test_trajectories_of_every_shape_lie_where_they_are_stated(tmp_path: Path) -> None:
    """A clothoid that is an arc, a spline of a line and that arc, and a curve of order 2 through its control points."""
    here = lane_position(-2, 100)
    shapes = {
        "clothoid": '<Clothoid curvature="0.01" curvaturePrime="0" length="50" startTime="2" stopTime="7">'
        f"{here}</Clothoid>",
        "spline": '<ClothoidSpline><ClothoidSplineSegment curvatureStart="0" curvatureEnd="0" length="20">'
        f"<PositionStart>{here[10:-11]}</PositionStart></ClothoidSplineSegment><ClothoidSplineSegment"
        ' curvatureStart="0.01" curvatureEnd="0.01" length="50"/></ClothoidSpline>',
        "nurbs": '<Nurbs order="2">'
        + "".join(
            f"<ControlPoint>{lane_position(lane, s)}</ControlPoint>" for lane, s in ((-2, 100), (-2, 120), (-1, 140))
        )
        + "".join(f'<Knot value="{knot}"/>' for knot in (0, 0, 1, 2, 2))
        + "</Nurbs>",
    }
    arc = np.array([100.0 * math.sin(0.5), 100.0 * (1.0 - math.cos(0.5))])
    start_xy = np.array([100.0, -5.25])
    ends = {"clothoid": start_xy + arc, "spline": start_xy + arc + (20.0, 0.0), "nurbs": np.array([140.0, -1.75])}
    for name, shape in shapes.items():
        timing = "<Timing domainAbsoluteRelative='absolute' scale='1' offset='0'/>" if name == "clothoid" else "<None/>"
        follow = (
            f"<RoutingAction><FollowTrajectoryAction><TimeReference>{timing}</TimeReference>"
            f"<TrajectoryRef><Trajectory name='t' closed='false'><Shape>{shape}</Shape></Trajectory></TrajectoryRef>"
            "<TrajectoryFollowingMode followingMode='position'/></FollowTrajectoryAction></RoutingAction>"
        )
        actor = actor_of(tmp_path / name, event("follow", follow))
        rows = actor.trajectory  # type: ignore[attr-defined]
        path = np.array([row[1:3] for row in rows] if rows else actor.path)  # type: ignore[attr-defined]
        heading = 0.5 if name != "nurbs" else math.atan2(3.5, 20.0)
        centre = ends[name] + 1.4 * np.array([math.cos(heading), math.sin(heading)])
        assert np.hypot(*(path - centre).T).min() < 0.02, name
        if name == "clothoid":
            assert rows[0][0] == 0.0
            assert any(row[0] == pytest.approx(7.0) for row in rows)


def test_new_features_come_back_through_the_format(tmp_path: Path) -> None:
    """Dynamics, triggers, lanes and meetings: the exported file drives as the imported one."""
    actor_events = (
        event("brake", speed_action(4, "sinusoidal", "rate", 3), by_entity("Ego", distance(60), edge="rising")),
        event("go", speed_action(12, "linear", "time", 4), state("brake", "event", "completeState", delay=0.5)),
        event(
            "left",
            lane_change(1, "sinusoidal", "time", 3, "Target"),
            by_entity("Target", distance(9).replace('entityRef="Target"', 'entityRef="Ego"')),
            by_time(5),
        ),
    )
    starts = start("Ego", lane_position(-1, 20), 15) + start("Target", lane_position(-2, 100), 10)
    scenario = read_openscenario(write(tmp_path, document(starts, "".join(actor_events), stop=by_time(12)))).scenario
    files, _ = export_openscenario([scenario], tmp_path / "out")
    again = read_openscenario(next(path for path in files if path.suffix == ".xosc")).scenario
    assert again.town == scenario.town
    assert again.actors[0].body == scenario.actors[0].body
    assert again.ego_body == scenario.ego_body
    first, second = (drive(one, 15.0) for one in (scenario, again))
    assert len(first.x) == len(second.x) > 100
    assert np.hypot(first.x - second.x, first.y - second.y).max() < 0.01
    assert first.speed[:, 1].min() < 4.1
    assert first.y[-1, 1] - first.y[0, 1] == pytest.approx(3.5, abs=0.02)
