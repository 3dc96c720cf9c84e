"""Frozen data types shared by all parts of SSAD.

Shape letters used in every docstring: B scenes of a batch, A agents of a scene, T steps, N points of a route,
L lanes, P points of lane centre lines, S signals, K a small fixed count.
Frames: world is right-handed, x east, y north, z up, yaw counter-clockwise from east; metres, seconds, radians.
CARLA's left-handed frame is converted only where CARLA's files are read.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from enum import IntEnum, IntFlag
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
I8 = npt.NDArray[np.int8]
I32 = npt.NDArray[np.int32]
U8 = npt.NDArray[np.uint8]
Bool = npt.NDArray[np.bool_]
_DTYPES = {"F32": np.float32, "F64": np.float64, "I8": np.int8, "I32": np.int32, "U8": np.uint8, "Bool": np.bool_}


def array_dtypes(table: Any) -> dict[str, np.dtype[Any]]:
    """Return the array fields of a dataclass.

    Args:
        table: A dataclass with postponed annotations.

    Returns:
        Name -> dtype of the constructor's fields annotated F32, F64, I8, I32, U8 or Bool, in their order.
    """
    return {
        table_field.name: np.dtype(_DTYPES[str(table_field.type)])
        for table_field in fields(table)
        if table_field.init and str(table_field.type) in _DTYPES
    }


class TurnSignal(IntEnum):
    """Turn signal that a vehicle shows."""

    RIGHT = -1
    NONE = 0
    LEFT = 1


class LaneType(IntEnum):
    """Use of a lane (OpenDRIVE lane types, reduced to the relevant ones)."""

    NONE = 0
    DRIVING = 1
    SHOULDER = 2
    SIDEWALK = 3
    PARKING = 4
    BIKING = 5
    MEDIAN = 6


class AgentKind(IntEnum):
    """Kind of an agent; NONE marks an empty slot of a batch."""

    NONE = 0
    CAR = 1
    TRUCK = 2
    BUS = 3
    MOTORCYCLE = 4
    BICYCLE = 5
    WALKER = 6
    PROP = 7


class Contact(IntFlag):
    """Objects that the ego touches; bits, since it can touch several at once."""

    NONE = 0
    VEHICLE = 1
    WALKER = 2
    CYCLIST = 4
    STATIC = 8


class SignalState(IntEnum):
    """State of a traffic signal; OFF does not control anything (priority rules hold)."""

    OFF = 0
    RED = 1
    YELLOW = 2
    GREEN = 3


class Controller(IntEnum):
    """Source of an agent's controls.

    Attributes:
        NONE: The agent stands still.
        EXTERNAL: It takes the action passed to `World.step`.
        AUTOPILOT: It follows its route, sees all agents and yields.
        FOLLOW: It keeps its route and target speed and ignores other agents.
        SCRIPT: It runs its phases.
        PLACED: It is placed by `World.place`, which mirrors another simulator.
        TRAJECTORY: It is at the positions of its timed rows, which replays a log.
    """

    NONE = 0
    EXTERNAL = 1
    AUTOPILOT = 2
    FOLLOW = 3
    SCRIPT = 4
    PLACED = 5
    TRAJECTORY = 6


class End(IntEnum):
    """Reason why an episode ended."""

    RUNNING = 0
    COLLISION = 1
    COMPLETE = 2
    MAX_STEPS = 3
    MAX_DISTANCE = 4
    MAX_TIME = 5


# names in traces; "" while the episode runs
ENDS = tuple("" if end == End.RUNNING else end.name.lower() for end in End)


@dataclass(frozen=True)
class Model:
    """Body and limits of an agent type. Metres, m/s, m/s^2, radians."""

    name: str
    kind: AgentKind
    length: float
    width: float
    height: float
    wheelbase: float = 0.0
    max_steer: float = 0.0
    max_accel: float = 0.0
    max_brake: float = 0.0
    max_speed: float = 0.0
    brake_build_up: float = 0.0  # s from the demand until the brakes reach it, in a linear rise


@dataclass(frozen=True)
class Body:
    """Dimensions and limits of one agent, in place of those of its model; None: as the model has it.

    Attributes:
        length: m, bumper to bumper.
        width: m.
        height: m.
        wheelbase: m; the axles lie half of it before and behind the middle of the body. None: the model's share of
            the length.
        max_accel: Maximum acceleration, m/s^2.
        max_brake: Maximum deceleration, m/s^2; the surface may allow less (`Scenario.friction`).
        max_speed: m/s.
        brake_build_up: Time in which the deceleration rises linearly from 0 to the demanded one, s.
    """

    length: float | None = None
    width: float | None = None
    height: float | None = None
    wheelbase: float | None = None
    max_accel: float | None = None
    max_brake: float | None = None
    max_speed: float | None = None
    brake_build_up: float | None = None


DEFAULT_FRICTION = 0.9  # of a dry road
MOVING = 0.5  # m/s; an agent that is slower stands


@dataclass(frozen=True)
class Pose:
    """A place in the world frame: x, y in metres, yaw in radians."""

    x: float
    y: float
    yaw: float = 0.0


TriggerKind = Literal[
    "always",
    "time",
    "after",
    "ego_distance",
    "ego_speed",
    "travelled",
    "speed",
    "relative_speed",
    "acceleration",
    "standstill",
    "distance",
    "time_to_collision",
    "time_headway",
    "position",
    "phase_start",
    "phase_end",
]
Shape = Literal["linear", "sinusoidal", "cubic", "step"]


@dataclass(frozen=True)
class PhaseTrigger:
    """Condition that starts a phase.

    The trigger holds if the condition of its `kind` holds, all triggers in `all` hold, and at least one in `any` holds
    (if there are any). An agent is named by the name of its actor, or `ego`.

    Attributes:
        kind: `always`: at once.
            `time`: `value` seconds have passed since the episode began.
            `after`: `value` seconds have passed since the phase before it began (the first phase: since the episode
            began).
            `ego_distance`: the centres of the ego and of actor number `actor` are less than `value` metres apart.
            `ego_speed`: the ego drives faster than `value` m/s.
            `travelled`: `agent` has moved more than `value` metres.
            `speed`, `acceleration`: that of `agent` is above `value` (m/s, m/s^2 along its heading).
            `relative_speed`: the speed of `agent` minus that of `reference` is above `value` m/s.
            `standstill`: `agent` has stood for `value` seconds.
            `distance`: `agent` is less than `value` metres from `reference`, or from `position`.
            `time_to_collision`: that distance over the speed at which it falls is below `value` seconds.
            `time_headway`: that distance over the speed of `agent` is below `value` seconds.
            `position`: `agent` is less than `value` metres from `position`.
            `phase_start`, `phase_end`: the phase `phase` of `agent` has begun; has ended, or another has overridden it.
        value: Threshold; units as above.
        actor: Number of the actor of `ego_distance`.
        agent: Agent whose quantity is measured; "": the actor itself.
        reference: Other agent; "": the ego, or the actor itself where `agent` is the ego.
        position: Point x, y in the world frame that takes the place of `reference`, m.
        rule: Whether the quantity has to be above or below `value`; "": as described with the kind.
        edge: Change of the condition that counts: `rising`, it begins to hold; `falling`, it ceases to; `both`; `none`,
            that it holds. With an edge it holds for one step, never in the first.
        delay: Time after which the condition counts, s: its value is that of `delay` seconds ago.
        free_space: Measure distances between the bodies instead of their centres.
        measure: `straight`: the shortest distance. `road`: along the path of `agent` (without a path: of `reference`,
            or along the heading of `agent`). `lateral`: across it.
        phase: Name of a phase, for `phase_start` and `phase_end`.
        all: Triggers that must all hold.
        any: Triggers of which one must hold.
    """

    kind: TriggerKind = "always"
    value: float = 0.0
    actor: int = 0
    agent: str = ""
    reference: str = ""
    position: tuple[float, float] | None = None
    rule: Literal["", "above", "below"] = ""
    edge: Literal["none", "rising", "falling", "both"] = "none"
    delay: float = 0.0
    free_space: bool = False
    measure: Literal["straight", "road", "lateral"] = "straight"
    phase: str = ""
    all: tuple[PhaseTrigger, ...] = ()
    any: tuple[PhaseTrigger, ...] = ()


@dataclass(frozen=True)
class Arrival:
    """Meeting of two agents: the actor reaches `point` at the time at which `reference` reaches `reference_point`.

    Attributes:
        point: Point x, y on the actor's path, or on the straight line ahead of it, m.
        reference_point: Point x, y on the way of the other agent, m.
        reference: Name of the other agent.
    """

    point: tuple[float, float]
    reference_point: tuple[float, float]
    reference: str = "ego"


@dataclass(frozen=True)
class FollowingGap:
    """Distance along the road that an actor keeps to another agent: `distance` plus `time` times a speed.

    The speed is that of whoever is behind, which makes `time` a time headway. The limits are those of the actor's
    motion; None: those of its model on the surface.

    Attributes:
        distance: m.
        time: s.
        reference: Name of the other agent.
        free_space: Measure between the bodies instead of their centres.
        side: Whether the actor stays `behind` the other agent or `ahead` of it; `any`: where it is when the phase
            begins.
        max_acceleration: m/s^2.
        max_deceleration: Magnitude, m/s^2.
        max_speed: m/s.
    """

    distance: float = 0.0
    time: float = 0.0
    reference: str = "ego"
    free_space: bool = False
    side: Literal["behind", "ahead", "any"] = "behind"
    max_acceleration: float | None = None
    max_deceleration: float | None = None
    max_speed: float | None = None


@dataclass(frozen=True)
class Phase:
    """One piece of a scripted behaviour: once `when` holds (latched, in order), drive at `speed` m/s.

    Without `acceleration`, `duration` and `distance`, a vehicle reaches the speed with the full acceleration or the
    full brakes of its model, and a walker at once. A phase that begins overrides the one that runs.

    Attributes:
        speed: Target speed, m/s. With `reference`: difference to its speed (or, with `factor`, multiple of it). With
            `arrival`: speed at the point; None: any. With `gap`: None.
        when: Condition that starts the phase.
        name: Name by which triggers refer to the phase.
        acceleration: Magnitude of the change of speed, m/s^2; a negative sign, for braking, has no further meaning.
            With a shape other than `linear`: its greatest magnitude.
        jerk: Greatest change of the acceleration, m/s^3; None: no limit. For the shape `linear`.
        shape: Course of the speed over time: `linear`; `sinusoidal`, half a period of a cosine; `cubic`, 3 s^2 - 2 s^3;
            `step`, at once.
        duration: Time until the speed is reached, s.
        distance: Distance over which the speed is reached, m.
        reference: Agent to whose speed `speed` refers; "": none.
        factor: Take `speed` as a multiple of the speed of `reference`, not as the difference to it.
        continuous: Go on following the speed of `reference`, not only that at the start of the phase. With `gap`: go on
            keeping it; otherwise the phase ends once the gap is reached, and the actor keeps its speed.
        arrival: Meeting that determines the speed in place of a target speed.
        anytime: Begin as soon as `when` holds, even if phases earlier in the list have not begun.
        gap: Distance to another agent that determines the speed in place of a target speed.
    """

    speed: float | None = None
    when: PhaseTrigger = field(default_factory=PhaseTrigger)
    name: str = ""
    acceleration: float | None = None
    jerk: float | None = None
    shape: Shape = "linear"
    duration: float | None = None
    distance: float | None = None
    reference: str = ""
    factor: bool = False
    continuous: bool = False
    arrival: Arrival | None = None
    anytime: bool = False
    gap: FollowingGap | None = None


@dataclass(frozen=True)
class LateralPhase:
    """One lateral motion: once `when` holds, change to another lane or another place in the lane.

    Lateral phases run beside the phases that determine the speed. One that begins overrides the one that runs. At most
    one of `duration`, `distance` and `rate` is given; without, the motion takes 3 s.

    Attributes:
        lanes: Lanes to the left of the lane to which the phase before it led (negative: right).
        offset: Distance left of the centre of that lane; without lane changes, left of the path, m.
        when: Condition that starts the phase.
        name: Name by which triggers refer to the phase.
        shape: Course of the lateral position: `sinusoidal`, `cubic`, `linear`, or `step`, at once.
        duration: Time that it takes, s.
        distance: Distance along the path that it takes, m.
        rate: Greatest lateral speed, m/s.
        anytime: Begin as soon as `when` holds, even if phases earlier in the list have not begun.
    """

    lanes: int = 0
    offset: float = 0.0
    when: PhaseTrigger = field(default_factory=PhaseTrigger)
    name: str = ""
    shape: Shape = "sinusoidal"
    duration: float | None = None
    distance: float | None = None
    rate: float | None = None
    anytime: bool = False


@dataclass(frozen=True)
class Impact:
    """Place where an actor and the front of the ego would touch if nobody acted; it determines the actor's start.

    The ego drives along its route at one speed, the actor straight ahead (along the route, if that is its heading) at
    its start speed. An actor without a speed stands where the impact is.

    Attributes:
        distance: Way of the ego from its start to the impact, m.
        location: Centre of the actor across the front of the ego, as a share of the ego's width: 0 is the ego's left
            edge, 0.5 its centre line, 1 its right edge.
        overlap: Share of the ego's width that the actor covers, in place of `location`; at 1, and where the actor is
            too narrow, the centre lines coincide.
        side: Side of the ego's centre line on which the centre of the actor is, with `overlap`.
        heading: Heading of the actor relative to the route, rad: 0 the same direction, pi oncoming, pi / 2 from the
            right to the left of the ego.
        ego_speed: Speed of the ego, m/s; None: that at its start, or its target speed if it starts from a standstill.
    """

    distance: float
    location: float = 0.5
    overlap: float | None = None
    side: Literal["left", "right"] = "left"
    heading: float = 0.0
    ego_speed: float | None = None


@dataclass(frozen=True)
class Actor:
    """A scripted participant of a scenario: pose in the world frame, phases, and an optional path to follow.

    Without `path` it goes straight along its heading; with it, it follows the polyline (x, y) in metres. It starts at
    `speed` m/s and keeps that until its first phase begins. Vehicles reach the speed of a phase by full throttle or
    full brake unless the phase says otherwise, walkers at once. `lateral` are lateral phases, which run at the same
    time.

    With `trajectory`, rows of time s, x, y m and yaw rad, it follows these positions, linearly interpolated,
    regardless of the other agents; before the first and after the last row it is absent.

    With `policy`, the name of a driver, that driver controls it; `path` is then its destination (key points along
    lanes; a walker's own line), at `target_speed` m/s on a free road.

    `body` states dimensions and limits that differ from those of the model.

    With `impact`, its pose and path follow from the place where it and the ego would collide; a file states neither.
    """

    name: str
    model: str
    pose: Pose
    phases: tuple[Phase, ...] = ()
    path: tuple[tuple[float, float], ...] = ()
    trajectory: tuple[tuple[float, float, float, float], ...] = ()
    policy: str = ""
    target_speed: float = 8.0
    body: Body = Body()
    speed: float = 0.0
    lateral: tuple[LateralPhase, ...] = ()
    impact: Impact | None = None


@dataclass(frozen=True)
class SignalPlan:
    """Behaviour of the signals of an episode.

    Attributes:
        ego: State of the signals that face the ego's route.
        others: State of all the others.
        until: Time at which the signals return to their programs, s.
        elsewhere: If the ego has red at one junction alone (`forced_signals`): the state of the signals that face it
            at the other junctions of its route. Where these are green, the others there are red.
    """

    ego: Literal["program", "off", "red", "green"] = "program"
    others: Literal["program", "off", "red", "green"] = "program"
    until: float = 60.0
    elsewhere: Literal["program", "off", "red", "green"] = "program"


MOST_ERRORS = 1800.0
"""Errors of a driver an hour at most: one error after the other, 2 s each."""


@dataclass(frozen=True)
class DriverStyle:
    """Parameters of one driver of background traffic, in place of those that all Autopilots have.

    Attributes:
        time_gap: Desired time gap to the leader, s.
        standstill_gap: Gap to a standing leader, m.
        acceleration: Acceleration from rest, m/s^2.
        deceleration: Comfortable deceleration, m/s^2.
        pace: Desired speed over the speed limit; lateral acceleration in bends goes with its square.
        jerk: Jerk of ordinary driving, m/s^3.
        reaction_time: Time until the driver begins to brake, or starts, s.
        estimation_error: Relative standard deviation of gaps as the driver judges them.
        lane_offset: Mean place left of the middle of the lane, m.
        errors: Errors an hour: a moment in which the driver reacts late and misses who has priority.
        key: Number from which the driver's errors are drawn, below 2^24.
        politeness: Weight of the acceleration that a lane change costs or brings others (MOBIL).
        change_duration: Time that a lane change takes where there is room, s.
    """

    time_gap: float
    standstill_gap: float
    acceleration: float
    deceleration: float
    pace: float = 1.0
    jerk: float = 3.0
    reaction_time: float = 0.0
    estimation_error: float = 0.0
    lane_offset: float = 0.0
    errors: float = 0.0
    key: int = 0
    politeness: float = 0.35
    change_duration: float = 5.0


@dataclass(frozen=True)
class WalkCrossing:
    """Place at which a walker's route leads over a road. Distances are along the route.

    Attributes:
        crossing: Number of the crossing in `ssad.world.roads.sidewalks.sidewalk_network`.
        wait: Distance to where the walker waits, m.
        kerb: Distance to the edge of the road, m.
        far: Distance to its opposite edge, m.
        forward: Whether it walks from the first end of the crossing to the second.
    """

    crossing: int
    wait: float
    kerb: float
    far: float
    forward: bool


@dataclass(frozen=True)
class WalkStyle:
    """Behaviour of a walker of natural traffic, in place of phases.

    Attributes:
        crossings: Roads that it crosses on its way, in order.
        margin: Time that it demands of a gap in traffic beyond the time to cross, s.
        room: Half width of the pavement that it can use, m.
        offset: Mean place left of the middle of the pavement, m.
        group: Name of the leader that decides when the group crosses; "": the walker decides itself.
        row: Distance at which it walks behind the leader, m.
        depth: Distance from a leader to the last walker of its group, m.
    """

    crossings: tuple[WalkCrossing, ...] = ()
    margin: float = 2.0
    room: float = 1.0
    offset: float = 0.0
    group: str = ""
    row: float = 0.0
    depth: float = 0.0


@dataclass(frozen=True)
class TrafficPlan:
    """Random background vehicles (FREA).

    Attributes:
        intensity: Share of the spawn points near the route that get a vehicle.
        minimum: Minimum number of vehicles.
        maximum: Maximum number of vehicles.
        wake_distance: Distance of the ego at which a vehicle wakes, m; 0: it is awake from the start.
        draw: Number of the draw of vehicles, which is then the same in every episode; None: the episode's seed.
        drivers: `uniform`: all vehicles have the Autopilot's parameters. `population`: each has a driver drawn from
            published distributions.
        errors: Errors of each driver of the population an hour, at most `MOST_ERRORS`; see `DriverStyle`.
        walkers: Number of walkers on the sidewalks near the route, alone and in groups; fewer where there is no room.
            They cross roads.
        cyclists: Number of cyclists on the driving lanes near the route; fewer where there is no room.
    """

    intensity: float = 0.3
    minimum: int = 5
    maximum: int = 18
    wake_distance: float = 50.0
    draw: int | None = None
    drivers: Literal["uniform", "population"] = "uniform"
    errors: float = 0.0
    walkers: int = 0
    cyclists: int = 0


@dataclass(frozen=True)
class EpisodeLimits:
    """Conditions that end an episode besides the end of the route.

    contact: effect of a contact of the ego: `end` the episode, only `count`, or `remove` the other agent and go
    on.
    """

    max_steps: int = 300
    max_time: float = 60.0
    max_distance: float = 1.0e9
    contact: Literal["end", "count", "remove"] = "end"


@dataclass(frozen=True)
class DeclaredParameter:
    """Number that a scenario names, so that its keys can use it and sweeps, searches and repetitions vary it.

    Attributes:
        value: Value that it has if nothing varies it, or an expression of other parameters.
        range: Minimum and maximum; searches cover it. None: no search varies the parameter.
        spread: Maximum deviation of a repetition from the value at spread 1; None: that of the class's parameter of
            this name, else 0.
        unit: Unit of the values, "" for a plain number.
        grid: Values of a sweep that takes the scenario's own grid.
        doc: Meaning of the number.
    """

    value: float | str
    range: tuple[float, float] | None = None
    spread: float | None = None
    unit: str = ""
    grid: tuple[float, ...] = ()
    doc: str = ""


@dataclass(frozen=True)
class Scenario:
    """A scenario as its author wrote it; round-trips through YAML.

    Numbers that the author wrote as expressions have their values, and the expressions stand in `expressions`:
    `ssad.scenarios.dynamic.with_parameters` evaluates them anew.

    Attributes:
        name: Name of the scenario.
        type: Scenario class (`StraightObstacle`, ..., `NaturalJunction`) that turns `route`, `trigger`,
            `placements` and `parameters` into actors; or `Custom`, which takes `actors` unchanged.
        town: Name of the town.
        route: Key points (x, y), m; at least two.
        trigger: The place that the scenario is built around.
        placements: Poses of actors fixed by the author.
        parameters: Values of the class's parameters.
        actors: Actors of a `Custom` scenario.
        signals: Plan of the traffic lights.
        traffic: Background traffic.
        limits: End conditions of the episode.
        target_speed: Target speed of the ego, m/s.
        seed: Seed of its random parts.
        group: Group that it belongs to in a set.
        source: Origin of the scenario.
        declared: Parameters that the scenario declares itself; in YAML they stand among `parameters`.
        expressions: Location of a number, such as `actors[0].phases[0].speed` -> its expression; in YAML it stands in
            the place of the number.
        constraints: Conditions on the parameters; sweeps, searches and repetitions leave out what violates one.
        ego_model: Name of the ego's model.
        ego_body: Dimensions and limits of the ego that differ from those of its model.
        friction: Coefficient of friction of the surface. Accelerations stay below friction * g, and the lateral grip
            of vehicles is proportional to it.
    """

    name: str
    type: str
    town: str
    route: tuple[Pose, ...]
    trigger: Pose | None = None
    placements: tuple[Pose, ...] = ()
    parameters: Mapping[str, float] = field(default_factory=dict)
    actors: tuple[Actor, ...] = ()
    signals: SignalPlan = field(default_factory=SignalPlan)
    traffic: TrafficPlan | None = None
    limits: EpisodeLimits = field(default_factory=EpisodeLimits)
    target_speed: float = 8.0
    seed: int = 0
    group: str = ""
    source: str = ""
    declared: Mapping[str, DeclaredParameter] = field(default_factory=dict)
    expressions: Mapping[str, str] = field(default_factory=dict)
    constraints: tuple[str, ...] = ()
    ego_model: str = "car"
    ego_body: Body = Body()
    friction: float = DEFAULT_FRICTION


@dataclass(frozen=True)
class Route:
    """A path along lanes, sampled every `spacing` metres.

    xy [N, 2] m, yaw [N] rad, lane [N] index into the town's lane graph (-1: off the graph), speed_limit [N] m/s,
    width [N] m of the lane under the path.
    """

    xy: F32
    yaw: F32
    lane: I32
    speed_limit: F32
    width: F32
    spacing: float = 1.0

    @property
    def length(self) -> float:
        """Length of the path, m."""
        return self.spacing * (len(self.xy) - 1)


@dataclass(frozen=True)
class EpisodeAgent:
    """One agent of a concrete episode: its start and its controller.

    Attributes:
        name: Name of the agent.
        model: Name of its model.
        controller: Source of its controls.
        pose: Start pose.
        speed: Start speed, m/s.
        target_speed: m/s.
        phases: Phases under SCRIPT.
        route: Route to follow.
        wake_distance: Distance of the ego at which it wakes, m; 0: it is awake from the start.
        trajectory: See `Actor`.
        policy: See `Actor`.
        body: Dimensions and limits that differ from those of the model.
        driver: Parameters of its driver under AUTOPILOT; None: those that all Autopilots have.
        lateral: Lateral phases under SCRIPT; they need a route.
        lateral_targets: Distance left of the route to which each lateral phase leads, at every route point [N], m.
        walk: Behaviour of a walker of natural traffic under SCRIPT; it needs a route and has no phases.
    """

    name: str
    model: str
    controller: Controller
    pose: Pose
    speed: float = 0.0
    target_speed: float = 8.0
    phases: tuple[Phase, ...] = ()
    route: Route | None = None
    wake_distance: float = 0.0
    trajectory: tuple[tuple[float, float, float, float], ...] = ()
    policy: str = ""
    body: Body = Body()
    lateral: tuple[LateralPhase, ...] = ()
    lateral_targets: tuple[F32, ...] = ()
    driver: DriverStyle | None = None
    walk: WalkStyle | None = None


@dataclass(frozen=True)
class Episode:
    """A scenario made concrete on a lane graph: everything a world needs to run it. Agent 0 is the ego.

    `PhaseTrigger.actor` counts the agents after the ego, in order: actor 0 is agent 1.

    Attributes:
        key: Key of the episode.
        scenario: The scenario.
        town: Name of the town.
        agents: The ego and all others.
        signal_override: Index of a signal of the town -> forced state, until `override_until`.
        override_until: s.
        limits: End conditions of the episode.
        seed: Seed of its random parts.
        friction: Coefficient of friction of the surface.
    """

    key: str
    scenario: Scenario
    town: str
    agents: tuple[EpisodeAgent, ...]
    signal_override: Mapping[int, SignalState] = field(default_factory=dict)
    override_until: float = 60.0
    limits: EpisodeLimits = field(default_factory=EpisodeLimits)
    seed: int = 0
    friction: float = DEFAULT_FRICTION


@dataclass(frozen=True)
class EpisodeTrace:
    """Record of one episode: T rows, for the start and each recorded step; A agents, of which 0 is the ego.

    Attributes:
        key: Key of the episode.
        town: Name of the town.
        dt: Time of a step, s.
        names: Names of the agents.
        models: Models of the agents.
        kind: `AgentKind` of the agents [A].
        length: [A], m.
        width: [A], m.
        x: [T, A], m.
        y: [T, A], m.
        yaw: [T, A], rad.
        speed: Signed, forward [T, A], m/s.
        active: Whether the agent is present [T, A].
        accel: Of the ego along its heading [T], m/s^2. This and all the following [T] are of the ego.
        contact: `Contact` bits of contacts that began in this step [T].
        contact_agent: Agent first touched in this step [T]; -1 none, -2 not an agent.
        off_road: [T].
        route_distance: Minimum distance to the rest of the route [T], m.
        route_complete: [T], percent.
        driven: Distance so far [T], m.
        lane_invasion: Lane markings crossed in this step [T].
        red_light: Stop lines of red lights run in this step [T].
        stop_sign: Lines of stop signs run in this step [T].
        throttle: Applied [T].
        brake: Applied [T].
        steer: Applied [T].
        signal_ids: Traffic lights whose states are recorded [S'].
        signal: Their states [T, S'].
        route: The ego's route [N, 2], m.
        end: Reason of the end (`collision`, `complete`, `max_steps`, `max_distance`, `max_time`).
        heights: Heights of the agents, m; empty where all agents have the dimensions of their models.
        turn_signal: `TurnSignal` of the agents [T, A]; [0, 0] in an episode without drivers of the population.
    """

    key: str
    town: str
    dt: float
    names: tuple[str, ...]
    models: tuple[str, ...]
    kind: U8
    length: F32
    width: F32
    x: F32
    y: F32
    yaw: F32
    speed: F32
    active: Bool
    accel: F32
    contact: U8
    contact_agent: I32
    off_road: Bool
    route_distance: F32
    route_complete: F32
    driven: F32
    lane_invasion: U8
    red_light: U8
    stop_sign: U8
    throttle: F32
    brake: F32
    steer: F32
    signal_ids: I32
    signal: U8
    route: F32
    end: str
    heights: tuple[float, ...] = ()
    turn_signal: I8 = field(default_factory=lambda: np.zeros((0, 0), np.int8))
