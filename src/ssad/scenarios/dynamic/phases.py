"""Validation of the phases of actors: values, names, and triggers that can never fire."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from ssad.core.errors import ConfigError
from ssad.core.triggers import (
    AT_POSITION,
    EGO,
    PAIRS,
    PHASE_KINDS,
    QUANTITIES,
    all_phases,
    default_rule,
    trigger_groups,
)
from ssad.core.types import Actor, FollowingGap, LateralPhase, Phase, PhaseTrigger

MAX_ACCELERATION: Final = 100.0  # m/s^2
MAX_DELAY: Final = 600.0  # s
MAX_LANES: Final = 10
MAX_OFFSET: Final = 100.0  # m
MAX_TIME: Final = 1.0e4  # s, and m of a distance
_LISTS: Final = ("phases", "lateral")
# Keys of a phase that a gap takes the place of.
_WITHOUT_GAP: Final = (
    *("speed", "acceleration", "jerk", "shape", "duration", "distance", "reference", "factor", "arrival"),
)
# Quantities that are never negative: below 0 they cannot be, and below 0 they cannot fall.
_NEVER_NEGATIVE: Final = ("ego_distance", "travelled", "speed", *AT_POSITION)

Place = tuple[str | int, ...]
Problem = tuple[Place, str]
AnyPhase = Phase | LateralPhase


def phase_problems(actors: Sequence[Actor], max_speeds: Mapping[int, float]) -> Iterator[Problem]:
    """Yield the problems of the phases of all actors.

    Args:
        actors: The actors.
        max_speeds: Greatest speed of the model of each actor by its number, m/s.

    Yields:
        Location of the value, beginning with `actors`, and a message.
    """
    has_problem = False
    for index, max_speed in max_speeds.items():
        for location, message in _actor_problems(actors, index, max_speed):
            has_problem = True
            yield ("actors", index, *location), message
    if not has_problem:
        yield from _never_begins(actors)


def _actor_problems(actors: Sequence[Actor], index: int, max_speed: float) -> Iterator[Problem]:
    actor = actors[index]
    if not 0.0 <= actor.speed <= max_speed:
        yield ("speed",), f"{actor.speed:g} is outside 0 to {max_speed:g} m/s ({actor.model})"
    if actor.trajectory and actor.speed:
        yield ("speed",), "an actor with a trajectory has the speed of its rows"
    if actor.lateral and (actor.trajectory or actor.policy):
        yield ("lateral",), "an actor with a trajectory or a policy has no lateral phases"
    elif actor.lateral and not max_speed > 0.0:
        yield ("lateral",), f"nobody drives a {actor.model}"
    names = [phase.name for phase in all_phases(actor) if phase.name]
    for key in _LISTS:
        phases: Sequence[AnyPhase] = getattr(actor, key)
        for number, phase in enumerate(phases):
            place = (key, number)
            if phase.name and names.count(phase.name) > 1:
                yield (*place, "name"), f"'{phase.name}' names two phases of actor {actor.name}"
            if isinstance(phase, Phase):
                yield from _speed_problems(phase, place, actors, actor, max_speed)
            else:
                yield from _lateral_problems(phase, place)
            yield from _trigger_problems(phase.when, (*place, "when"), actors, index)
            try:
                trigger_groups(phase.when)
            except ConfigError as error:
                yield (*place, "when"), str(error)


def _speed_problems(
    phase: Phase, place: Place, actors: Sequence[Actor], actor: Actor, max_speed: float
) -> Iterator[Problem]:
    if phase.gap is not None:
        yield from _gap_problems(phase, place, actors, actor, max_speed)
        return
    if phase.speed is None:
        if phase.arrival is None:
            yield place, "key 'speed' is missing"
    elif phase.reference and phase.arrival is None:
        if not abs(phase.speed) <= MAX_ACCELERATION:
            yield (*place, "speed"), f"{phase.speed:g} is outside -{MAX_ACCELERATION:g} to {MAX_ACCELERATION:g}"
        elif phase.factor and phase.speed < 0.0:
            yield (*place, "speed"), "a factor must not be negative"
    elif not 0.0 <= phase.speed <= max_speed:
        yield (*place, "speed"), f"{phase.speed:g} is outside 0 to {max_speed:g} m/s ({actor.model})"
    if phase.acceleration is not None and not 0.0 < abs(phase.acceleration) <= MAX_ACCELERATION:
        yield (*place, "acceleration"), f"{phase.acceleration:g} is 0 or beyond {MAX_ACCELERATION:g} m/s^2"
    yield from _positive(phase.jerk, (*place, "jerk"), 10.0 * MAX_ACCELERATION)
    yield from _pace(
        phase.shape, place, acceleration=phase.acceleration, duration=phase.duration, distance=phase.distance
    )
    is_timed = phase.duration is not None or phase.distance is not None
    if phase.jerk is not None and (phase.shape != "linear" or is_timed):
        yield (
            (*place, "jerk"),
            "a jerk goes with the shape linear and an acceleration; the other courses have their own",
        )
    if phase.reference:
        yield from _agent_problem(phase.reference, (*place, "reference"), actors, actor.name)
    elif phase.factor or phase.continuous:
        key = "factor" if phase.factor else "continuous"
        yield (*place, key), "needs a `reference`, the agent to whose speed the phase refers"
    if phase.continuous and (is_timed or phase.shape != "linear"):
        yield (*place, "continuous"), "a phase that follows another agent has no duration, distance or shape"
    if phase.arrival is not None:
        if phase.reference or is_timed or phase.shape != "linear" or phase.jerk is not None:
            yield (
                (*place, "arrival"),
                "an arrival sets the pace; leave out reference, shape, duration, distance and jerk",
            )
        yield from _agent_problem(phase.arrival.reference, (*place, "arrival", "reference"), actors, actor.name)
        for key in ("point", "reference_point"):
            yield from _point_problem(getattr(phase.arrival, key), (*place, "arrival", key))


def _gap_problems(
    phase: Phase, place: Place, actors: Sequence[Actor], actor: Actor, max_speed: float
) -> Iterator[Problem]:
    gap = phase.gap or FollowingGap()
    for key in _WITHOUT_GAP:
        if getattr(phase, key) != getattr(Phase, key):
            yield (*place, key), "a gap determines the speed; leave it out (limits stand in the gap)"
    for key in ("distance", "time"):
        if not 0.0 <= getattr(gap, key) <= MAX_TIME:
            yield (*place, "gap", key), f"{getattr(gap, key):g} is outside 0 to {MAX_TIME:g}"
    if gap.distance == gap.time == 0.0:
        yield (*place, "gap"), "needs a distance, a time or both"
    yield from _positive(gap.max_acceleration, (*place, "gap", "max_acceleration"), MAX_ACCELERATION)
    yield from _positive(gap.max_deceleration, (*place, "gap", "max_deceleration"), MAX_ACCELERATION)
    yield from _positive(gap.max_speed, (*place, "gap", "max_speed"), max_speed)
    yield from _agent_problem(gap.reference, (*place, "gap", "reference"), actors, actor.name)


def _lateral_problems(phase: LateralPhase, place: Place) -> Iterator[Problem]:
    if abs(phase.lanes) > MAX_LANES:
        yield (*place, "lanes"), f"{phase.lanes} is outside -{MAX_LANES} to {MAX_LANES}"
    if not abs(phase.offset) <= MAX_OFFSET:
        yield (*place, "offset"), f"{phase.offset:g} is outside -{MAX_OFFSET:g} to {MAX_OFFSET:g} m"
    yield from _positive(phase.rate, (*place, "rate"), MAX_ACCELERATION)
    yield from _pace(phase.shape, place, rate=phase.rate, duration=phase.duration, distance=phase.distance)


def _pace(shape: str, place: Place, **values: float | None) -> Iterator[Problem]:
    """Yield the problems of the quantities that fix how fast a phase proceeds: one at most, none for a step."""
    for key in ("duration", "distance"):
        yield from _positive(values[key], (*place, key), MAX_TIME)
    stated = [key for key, value in values.items() if value is not None]
    if len(stated) > 1:
        yield (*place, stated[1]), f"{stated[0]} fixes the pace already; leave out one of them"
    if shape == "step" and stated:
        yield (*place, stated[0]), "a step takes no time; leave it out or choose another shape"
    if shape in ("sinusoidal", "cubic") and "acceleration" in values and not stated:
        yield (*place, "shape"), f"a {shape} course needs an acceleration, a duration or a distance"


def _positive(value: float | None, place: Place, limit: float) -> Iterator[Problem]:
    if value is not None and not 0.0 < value <= limit:
        yield place, f"{value:g} is outside 0 to {limit:g}"


def _point_problem(point: tuple[float, float], place: Place) -> Iterator[Problem]:
    if not all(abs(value) <= 1.0e5 for value in point):
        yield place, "beyond 100000 m or not a number"


def _agent_problem(name: str, place: Place, actors: Sequence[Actor], actor: str) -> Iterator[Problem]:
    names = [other.name for other in actors]
    if name == actor:
        yield place, f"'{name}' is this actor itself; name another agent"
    elif name != EGO and name not in names:
        yield place, f"there is no actor '{name}'; there are: {', '.join((EGO, *names))}"
    elif names.count(name) + (name == EGO) > 1:
        yield place, f"'{name}' names more than one agent; give each actor a name of its own"


def _trigger_problems(trigger: PhaseTrigger, place: Place, actors: Sequence[Actor], index: int) -> Iterator[Problem]:
    for key in ("all", "any"):
        for number, member in enumerate(getattr(trigger, key)):
            yield from _trigger_problems(member, (*place, key, number), actors, index)
    kind, actor = trigger.kind, actors[index]
    if not 0 <= trigger.actor < len(actors):
        yield (*place, "actor"), f"there are actors 0 to {len(actors) - 1}"
    if kind not in ("relative_speed", "acceleration") and not trigger.value >= 0.0:
        yield (*place, "value"), "must not be negative"
    if not 0.0 <= trigger.delay <= MAX_DELAY:
        yield (*place, "delay"), f"{trigger.delay:g} is outside 0 to {MAX_DELAY:g} s"
    for key, kinds, is_stated in (
        (
            "agent",
            (*PAIRS, *PHASE_KINDS, "travelled", "speed", "acceleration", "standstill", "position"),
            trigger.agent,
        ),
        ("reference", PAIRS, trigger.reference),
        ("position", AT_POSITION, trigger.position is not None),
        ("free_space", AT_POSITION[:3], trigger.free_space),
        ("measure", AT_POSITION, trigger.measure != "straight"),
        ("phase", PHASE_KINDS, trigger.phase),
        ("rule", (*QUANTITIES, "time", "after"), trigger.rule),
    ):
        if is_stated and kind not in kinds:
            yield (*place, key), f"the kind {kind} has none; it goes with: {', '.join(kinds)}"
            return
    for key, name in (("agent", trigger.agent), ("reference", trigger.reference)):
        if name and name != actor.name:
            yield from _agent_problem(name, (*place, key), actors, "")
    if trigger.actor and kind in (*PAIRS, *PHASE_KINDS, "speed", "acceleration", "standstill", "position"):
        yield (*place, "actor"), f"the kind {kind} names agents by `agent` and `reference`"
    if trigger.value and kind in PHASE_KINDS:
        yield (*place, "value"), f"the kind {kind} has none; `delay` waits after the phase"
    if kind == "position" and trigger.position is None:
        yield place, "key 'position' is missing"
    if trigger.position is not None:
        yield from _point_problem(trigger.position, (*place, "position"))
        if trigger.reference:
            yield (*place, "reference"), "the distance is that to `position`; leave out one of them"
    elif kind in PAIRS and (trigger.agent or actor.name) == (trigger.reference or _other(trigger, actor.name)):
        yield (*place, "reference"), "names the agent itself; a distance needs two"
    if kind in PHASE_KINDS:
        yield from _phase_reference_problem(trigger, place, actors, actor)
    yield from _constant_condition(trigger, place, actors)


def _other(trigger: PhaseTrigger, actor: str) -> str:
    return actor if trigger.agent == EGO else EGO


def _phase_reference_problem(
    trigger: PhaseTrigger, place: Place, actors: Sequence[Actor], actor: Actor
) -> Iterator[Problem]:
    target = next((other for other in actors if other.name == (trigger.agent or actor.name)), None)
    if target is None:
        yield (*place, "agent"), "the ego has no phases; name an actor"
        return
    names = [phase.name for phase in all_phases(target) if phase.name]
    if not trigger.phase:
        yield place, "key 'phase' is missing: the name of a phase"
    elif trigger.phase not in names:
        phase_names = f"its phases: {', '.join(names)}" if names else "none of its phases has a name"
        yield (*place, "phase"), f"actor {target.name} has no phase '{trigger.phase}'; {phase_names}"


def _constant_condition(trigger: PhaseTrigger, place: Place, actors: Sequence[Actor]) -> Iterator[Problem]:
    """Yield the problem of a condition of which it is certain that it never holds."""
    kind, rule = trigger.kind, trigger.rule or default_rule(trigger.kind)
    if kind in _NEVER_NEGATIVE and kind != "ego_distance" and rule == "below" and trigger.value == 0.0:
        yield (*place, "value"), f"never fires: {kind} is never below 0"
    if kind == "always" and trigger.edge != "none":
        yield (*place, "edge"), "never fires: what always holds never changes"
    elif trigger.edge == "falling" and (kind in PHASE_KINDS or (kind == "travelled" and rule == "above")):
        yield (*place, "edge"), f"never fires: {kind} never ceases to hold"
    elif kind in ("time", "after") and trigger.edge != "none" and rule == "below" and trigger.edge == "rising":
        yield (*place, "edge"), f"never fires: {kind} is below its value from the start"


@dataclass(frozen=True)
class _Node:
    """A phase among those of all actors: what it waits for."""

    place: tuple[str | int, ...]
    before: int  # phase that must begin first, -1: none
    after: int  # phase of the same list that may override it, -1: none
    groups: tuple[tuple[tuple[int, bool], ...], ...]  # phases that must have begun, or (True) ended
    endless: bool


def _never_begins(actors: Sequence[Actor]) -> Iterator[Problem]:
    """Yield the phases that wait for themselves, in a circle, or for an end that never comes."""
    numbers: dict[tuple[str, str], int] = {}
    count = 0
    for actor in actors:
        for phase in all_phases(actor):
            if phase.name:
                numbers.setdefault((actor.name, phase.name), count)
            count += 1
    nodes: list[_Node] = []
    for index, actor in enumerate(actors):
        for key in _LISTS:
            phases: Sequence[AnyPhase] = getattr(actor, key)
            first = len(nodes)
            before = -1
            for number, phase in enumerate(phases):
                groups = tuple(
                    tuple(
                        (numbers[condition.agent or actor.name, condition.phase], condition.kind == "phase_end")
                        for condition in group
                        if condition.kind in PHASE_KINDS
                    )
                    for group in trigger_groups(phase.when)
                )
                after = first + number + 1 if number + 1 < len(phases) else -1
                endless = isinstance(phase, Phase) and phase.continuous
                nodes.append(
                    _Node(("actors", index, key, number), -1 if phase.anytime else before, after, groups, endless)
                )
                if not phase.anytime:
                    before = first + number
    begins = [False] * len(nodes)

    def ends(number: int) -> bool:
        node = nodes[number]
        return begins[number] and (not node.endless or (node.after >= 0 and begins[node.after]))

    changes = True
    while changes:
        changes = False
        for number, node in enumerate(nodes):
            if begins[number] or (node.before >= 0 and not begins[node.before]):
                continue
            if any(all(ends(other) if is_end else begins[other] for other, is_end in group) for group in node.groups):
                begins[number] = changes = True
    for number, node in enumerate(nodes):
        waits_in_list = node.before >= 0 and not begins[node.before]
        if not begins[number] and not waits_in_list:
            yield (*node.place, "when"), "never fires: it waits for itself, or for a phase that never begins or ends"
