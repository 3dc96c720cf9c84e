"""Arrays that the kernels share, as Warp structs.

Legend: B scenes, A agents, E episodes of the bank, P phases, G groups of conditions, C conditions, H words of history,
N route points of the pool, M lane segments, S signals.
"""

from enum import IntEnum
from typing import Any

import warp as wp

from ssad.core.types import End  # noqa: F401  kernels take all their codes from here

HORIZON = wp.constant(8)  # forecast points; `belief` writes four at a time
STRIDE = wp.constant(0.5)  # seconds between forecast points
FAR = wp.constant(1.0e6)
AS_IT_IS = wp.constant(-1)  # the state of a signal of which a belief says nothing
NO_LEADER = wp.constant(1 << 30)
LEADERS = wp.constant(1 << 12)

# On CUDA, by measurement on an H200 at 65,536 scenes: registers of a thread at most, which lets more threads be
# resident (where not said, as many as the compiler wants), and threads of a block. No result hangs on them.
REGISTERS = 64
REGISTERS_OF_MOTION = 48
BLOCK = 128


class PhaseCondition(IntEnum):
    """Start condition of a phase: the kinds of `ssad.core.types.PhaseTrigger`."""

    ALWAYS = 0
    EGO_DISTANCE = 1
    EGO_SPEED = 2
    TRAVELLED = 3
    TIME = 4
    AFTER = 5
    SPEED = 6
    RELATIVE_SPEED = 7
    ACCELERATION = 8
    STANDSTILL = 9
    DISTANCE = 10
    TIME_TO_COLLISION = 11
    TIME_HEADWAY = 12
    POSITION = 13
    PHASE_START = 14
    PHASE_END = 15


class Edge(IntEnum):
    """Change of a condition that counts: the words of `ssad.core.types.PhaseTrigger.edge`."""

    NONE = 0
    RISING = 1
    FALLING = 2
    BOTH = 3


class Measure(IntEnum):
    """Way to measure a distance: the words of `ssad.core.types.PhaseTrigger.measure`, in their order."""

    STRAIGHT = 0
    ROAD = 1
    LATERAL = 2


class SpeedShape(IntEnum):
    """Course of a speed or a lateral position: the words of `ssad.core.types.Shape`."""

    LINEAR = 0
    SINUSOIDAL = 1
    CUBIC = 2
    STEP = 3


class SpeedProfile(IntEnum):
    """Quantity that fixes the pace of a phase.

    LIMITED follows the target with limited acceleration and jerk; the others are given by a time, a distance, the
    greatest rate, nothing at all, a meeting, or a distance to another agent.
    """

    LIMITED = 0
    DURATION = 1
    DISTANCE = 2
    RATE = 3
    STEP = 4
    ARRIVAL = 5
    GAP = 6


class ScriptMotion(IntEnum):
    """Way in which a script moves its agent: not at all, by steering, exactly along its route, or as walkers walk."""

    NONE = 0
    STEERED = 1
    RAIL = 2
    WALK = 3


class WalkStatus(IntEnum):
    """Status of a walker of natural traffic; READY waits for vehicles alone, WAITING for a signal or a gap."""

    PAVEMENT = 0
    WAITING = 1
    READY = 2
    CROSSING = 3


class Presence(IntEnum):
    """Presence of an agent; it sleeps until the ego comes near."""

    ABSENT = 0
    ASLEEP = 1
    AWAKE = 2


class ContactPolicy(IntEnum):
    """Effect of a contact of the ego: the words of `ssad.core.types.EpisodeLimits.contact`."""

    END = 0
    COUNT = 1
    REMOVE = 2


class TurnRank(IntEnum):
    """Turn of a route at a junction, in the order of priority. RIGHT is to the near side, left in left-hand traffic."""

    STRAIGHT = 0
    RIGHT = 1
    LEFT = 2
    YIELD = 3  # added to the others on an approach with a stop or yield sign: whoever has none goes first


@wp.struct
class EpisodeArrays:
    """Arrays that do not change while an episode runs; scenes refer to them by episode number."""

    model: wp.array2d(dtype=wp.int32)  # [E, A] row of `body`, -1 empty slot
    controller: wp.array2d(dtype=wp.int32)  # [E, A] Controller at the start
    start: wp.array2d(dtype=wp.vec4)  # [E, A] x, y, yaw, speed
    # [E, A] driver: time gap s (0: the parameters that all Autopilots have), gap at rest m, acceleration, deceleration
    style: wp.array2d(dtype=wp.vec4)
    # [E, A] driver: desired speed over the limit, jerk m/s^3, reaction time s, estimation error
    manner: wp.array2d(dtype=wp.vec4)
    habit: wp.array2d(dtype=wp.vec3)  # [E, A] driver: place left of the lane's middle m, errors an hour, key
    courtesy: wp.array2d(dtype=wp.vec2)  # [E, A] driver: politeness (MOBIL), s that a lane change takes
    population: wp.array(dtype=wp.int32)  # [E] 1: somebody has a driver of the population
    cruise: wp.array2d(dtype=wp.vec2)  # [E, A] target speed m/s at the start, wake distance m (0: awake at once)
    route: wp.array2d(dtype=wp.vec2i)  # [E, A] first point in the pool, number of points
    track: wp.array2d(dtype=wp.vec2i)  # [E, A] first row in the pool of trajectories, number of rows
    script: wp.array2d(dtype=wp.vec4i)  # [E, A] first phase of the episode's, phases, lateral phases, ScriptMotion
    town: wp.array(dtype=wp.int32)  # [E]
    signal: wp.array2d(dtype=wp.int32)  # [E, S] forced SignalState, -1 none
    limits: wp.array(dtype=wp.vec4)  # [E] max steps, max time s, max distance m, override until s
    contact: wp.array(dtype=wp.int32)  # [E] ContactPolicy
    kind: wp.array(dtype=wp.int32)  # [models] AgentKind
    body: wp.array(dtype=wp.vec4)  # [models] half length, half width, wheelbase, max steer
    power: wp.array(dtype=wp.vec4)  # [models] max accel, max brake, max speed, s until the brakes have built up
    # [E] m/s^2 that the surface allows along the heading and across it, half length of the longest body m
    surface: wp.array(dtype=wp.vec3)


@wp.struct
class Roads:
    """Routes of all agents, lane segments of all towns with their grids, and signals."""

    path: wp.array(dtype=wp.vec4)  # [N] x, y, yaw, curvature
    rule: wp.array(dtype=wp.vec4)  # [N] speed cap, m to next stop line, m to next junction, TurnRank there
    bend: wp.array(dtype=wp.float32)  # [N] m that the next 64 m of path leave the straight line along its heading
    ahead: wp.array(dtype=wp.vec3)  # [N] m to the next stop sign's line, its route point, m to the next junction's end
    # [N] m to the lane's centre on the left (0: none) and how far it goes on (negative: oncoming lane); right likewise
    beside: wp.array(dtype=wp.vec4)
    height: wp.array(dtype=wp.float32)  # [N] m: what is much higher or lower is on, or below, a bridge
    path_signal: wp.array(dtype=wp.int32)  # [N] signal of the next stop line, -1 none
    track: wp.array(dtype=wp.vec4)  # [N] s, x, y, yaw: trajectories
    segment: wp.array(dtype=wp.vec4)  # [M] x0, y0, x1, y1
    segment_half: wp.array(dtype=wp.vec2)  # [M] half widths at both ends
    segment_lane: wp.array(dtype=wp.int32)  # [M] lane, counted over all towns
    lane_junction: wp.array(dtype=wp.int32)  # [L] 1 inside a junction
    cell_first: wp.array(dtype=wp.int32)
    cell_segment: wp.array(dtype=wp.int32)
    grid: wp.array(dtype=wp.vec4)  # [towns] origin x, origin y, cells a metre, 1 if turns on red are allowed
    grid_size: wp.array(dtype=wp.vec3i)  # [towns] nx, ny, first entry in cell_first
    signal_first: wp.array(dtype=wp.int32)  # [towns]
    signal_program: wp.array(dtype=wp.vec4)  # [S] cycle s, green from, green for, yellow for; cycle 0: off


@wp.struct
class State:
    """Changing state, one row per scene. `pose` is x, y, yaw; `previous` is the pose one step before."""

    episode: wp.array(dtype=wp.int32)  # [B]
    step: wp.array(dtype=wp.int32)  # [B]
    end: wp.array(dtype=wp.int32)  # [B] End
    controller: wp.array2d(dtype=wp.int32)  # [B, A] Controller
    policy: wp.array2d(dtype=wp.int32)  # [B, A] number of the driver that acts for it, -1 none
    note: wp.array2d(dtype=wp.int32)  # [B, A] what a selector has noted on it, 0 at the start
    cruise: wp.array2d(dtype=wp.float32)  # [B, A] target speed m/s
    pose: wp.array2d(dtype=wp.vec3)  # [B, A]
    previous: wp.array2d(dtype=wp.vec3)  # [B, A]
    speed: wp.array2d(dtype=wp.float32)  # [B, A]
    accel: wp.array2d(dtype=wp.float32)  # [B, A] m/s^2 along the heading
    wheel: wp.array2d(dtype=wp.float32)  # [B, A] front-wheel angle, rad
    braking: wp.array2d(dtype=wp.float32)  # [B, A] brake that has built up, 0 to 1
    active: wp.array2d(dtype=wp.int32)  # [B, A] Presence
    progress: wp.array2d(dtype=wp.int32)  # [B, A] nearest route point, never goes back
    phase: wp.array2d(dtype=wp.int32)  # [B, A] phases begun
    travelled: wp.array2d(dtype=wp.float32)  # [B, A] m
    halted: wp.array2d(dtype=wp.int32)  # [B, A] route point at whose stop sign it has stopped, -1 none
    stalled: wp.array2d(dtype=wp.int32)  # [B, A] 1: nose to nose with someone who goes first; it backs out
    waited: wp.array2d(dtype=wp.float32)  # [B, A] s at rest while wanting to go
    # [B, A] an Autopilot's lane change: where along its route it begins and ends (m), and how many lanes left of the
    # route it leads from and to
    shift: wp.array2d(dtype=wp.vec4)
    control: wp.array2d(dtype=wp.vec4)  # [B, A] throttle, brake, steer, reverse
    aim: wp.array2d(dtype=wp.vec2)  # [B, A] an Autopilot's place along its route m, and target speed m/s
    react: wp.array2d(dtype=wp.float32)  # [B, A] an Autopilot's hardest interaction term, m/s^2 (negative)
    # [B, A] of a driver of the population: s for which it has not reacted yet, and its reaction to others, m/s^2
    pending: wp.array2d(dtype=wp.vec2)
    lane: wp.array2d(dtype=wp.int32)  # [B, A] lane under the centre, -1 off the road
    lateral: wp.array2d(dtype=wp.vec2)  # [B, A] m left of that lane's centre line, half width of the lane there
    touch: wp.array2d(dtype=wp.int64)  # [B, A] agents touched now, one bit an agent


@wp.struct
class Scripts:
    """Phases of scripted agents and the conditions that start them, of all episodes of the bank one after the other.

    An agent's lateral phases follow its phases. Phases are numbered within their episode.
    """

    episode: wp.array(dtype=wp.vec4i)  # [E] first row of its phases, their number; first condition, their number
    begin: wp.array(dtype=wp.vec2i)  # [P] first group of conditions, number of groups: one of them must hold
    anytime: wp.array(dtype=wp.int32)  # [P] 1: does not wait for the phases before it
    motion: wp.array(dtype=wp.vec4)  # [P] speed m/s, acceleration m/s^2 (0: the model's), jerk m/s^3 (0: any), timing
    # [P] SpeedProfile, SpeedShape, agent (-1: none), 1 factor + 2 continuous + 4 there is a speed; of lateral phases
    # SpeedProfile, SpeedShape, first row and number of rows of `target`
    course: wp.array(dtype=wp.vec4i)
    # [P] point x, y, m along the agent's route (-1: it has none); of gaps m, s, 1 behind or -1 ahead of the other agent
    # (0: as it is), 1 between the bodies
    meeting: wp.array(dtype=wp.vec4)
    # [P] likewise for the other agent; of gaps acceleration, deceleration m/s^2, speed m/s (0: the model's)
    other_meeting: wp.array(dtype=wp.vec4)
    group: wp.array(dtype=wp.vec2i)  # [G] first condition, number of conditions: all of them must hold
    condition: wp.array(dtype=wp.vec4i)  # [C] PhaseCondition, agent, other agent (-1: the position), phase (-1: none)
    form: wp.array(dtype=wp.vec4i)  # [C] 1 above (0 below), Edge, 1 between the bodies, Measure
    number: wp.array(dtype=wp.vec4)  # [C] value, position x, y
    ring: wp.array(dtype=wp.vec3i)  # [C] first word of its history, bits (0: none), delay in steps
    target: wp.array(dtype=wp.float32)  # m left of the route to which lateral phases lead, at each route point


@wp.struct
class ScriptState:
    """Changing state of scripts. A stamp is 1 + the step at whose start something happens; 0: it has not happened."""

    begun: wp.array2d(dtype=wp.int32)  # [B, P] stamp of the begin of a phase
    ended: wp.array2d(dtype=wp.int32)  # [B, P] stamp of its end
    history: wp.array2d(dtype=wp.int32)  # [B, H] values of conditions in the last steps, a bit each
    running: wp.array2d(dtype=wp.vec2i)  # [B, A] 1 + the number of the running phase and lateral phase; 0: none
    # [B, A] speed at the start of the phase m/s, target m/s, duration s (of gaps: 1 behind, -1 ahead), accel m/s^2
    course: wp.array2d(dtype=wp.vec4)
    # [B, A] of the lateral phase: m left of the route at its start, place there m along the route, duration s or
    # length m, 1 if it is a length
    swerve: wp.array2d(dtype=wp.vec4)
    rail: wp.array2d(dtype=wp.vec2)  # [B, A] place m along the route and m left of it; only of agents on a rail
    goal: wp.array2d(dtype=wp.vec4)  # [B, A] x, y, yaw and speed at the end of the step; the pose only of the same


@wp.struct
class Walkers:
    """Walkers of natural traffic, the crossings that they use, and where the routes of vehicles lead over these.

    Legend: W crossings on walkers' ways, C crossings, G signals at crossings, V passages of routes over crossings. y is
    the distance from a crossing's first end, towards its second one.
    """

    agents: wp.array(dtype=wp.vec2i)  # [E] first walker, and the agent after the last one
    style: wp.array2d(dtype=wp.vec4)  # [E, A] margin s, half width of the way m, m left of its middle, m behind leader
    depth: wp.array2d(dtype=wp.float32)  # [E, A] m from the leader of a group to the last one
    leader: wp.array2d(dtype=wp.int32)  # [E, A] agent that decides, itself where it is alone; -1: no walker
    stages: wp.array2d(dtype=wp.vec2i)  # [E, A] first row of `stage`, number of rows
    stage: wp.array(dtype=wp.vec4)  # [W] m along the way to where it waits and to both kerbs, 1 (greater y) or -1
    stage_crossing: wp.array(dtype=wp.int32)  # [W] crossing
    crossing: wp.array(dtype=wp.vec4)  # [C] x, y of the first end, unit vector towards the second
    form: wp.array(dtype=wp.vec4)  # [C] half width m, y of both kerbs, 1 marked
    signals: wp.array(dtype=wp.vec2i)  # [C] first row of `signal`, number of rows
    signal: wp.array(dtype=wp.int32)  # [G] signal of the town
    part: wp.array(dtype=wp.vec3)  # [G] y between which its traffic passes, s that this traffic needs to come there
    next_passing: wp.array(dtype=wp.int32)  # [N] first row of `passing` that a vehicle there has not left; -1: none
    passing: wp.array(dtype=wp.vec3)  # [V] m along the route to both edges of the crossing, y there
    # [V] crossing, 1 if the route turns just before, 1 if the next row is one of the same route
    passing_crossing: wp.array(dtype=wp.vec3i)


@wp.struct
class WalkState:
    """Changing state of walkers of natural traffic."""

    rail: wp.array2d(dtype=wp.vec2)  # [B, A] place along its route, and left of it, m
    stage: wp.array2d(dtype=wp.int32)  # [B, A] crossings that lie behind it
    status: wp.array2d(dtype=wp.int32)  # [B, A] WalkStatus
    crossing: wp.array2d(dtype=wp.int32)  # [B, A] 1 + the crossing at which it waits or that it crosses; 0: none
    waited: wp.array2d(dtype=wp.float32)  # [B, A] s for which it has waited there
    yielded: wp.array2d(dtype=wp.int32)  # [B, A] 1: a vehicle has yielded to it there


@wp.struct
class PerceivedAgents:
    """Observable state of agents, the same for every observer: all that an Autopilot knows of others.

    The rows from 0 to A - 1 hold the truth about each agent; those from A on hold what the scene's ego believes to be
    around it.
    """

    kind: wp.array2d(dtype=wp.int32)  # [B, rows] AgentKind, NONE: nobody
    pose: wp.array2d(dtype=wp.vec3)  # [B, rows] x, y, yaw
    speed: wp.array2d(dtype=wp.float32)  # [B, rows] m/s along the heading
    half: wp.array2d(dtype=wp.vec2)  # [B, rows] half length, half width
    forecast: wp.array3d(dtype=wp.vec3)  # [B, rows, HORIZON] x, y, yaw where it will be if it keeps its speed
    span: wp.array2d(dtype=wp.vec4)  # [B, rows] least x, y and greatest x, y of the pose and its forecast
    # [B, rows] m from the centre to where it would wait (its stop line, or the junction) and to the next junction (FAR:
    # none), TurnRank there, and m that its path ahead leaves the straight line along its heading
    way: wp.array2d(dtype=wp.vec4)
    # [B, rows] turn signal of a lane change (1 left, -1 right, 0 none), and whether it is on an oncoming lane (1)
    change: wp.array2d(dtype=wp.vec2i)
    height: wp.array2d(dtype=wp.float32)  # [B, rows] m, of the road under it; NaN: not known
    signal: wp.array2d(dtype=wp.int32)  # [B, rows] signal of its next stop line, -1 none
    waited: wp.array2d(dtype=wp.float32)  # [B, rows] s at rest while wanting to go
    gives_way: wp.array2d(dtype=wp.int32)  # [B, rows] 1: can be relied on to give way
    believes: wp.array(dtype=wp.int32)  # [B] 1: the ego plans over the rows from A on, not over the truth
    told: wp.array(dtype=wp.int32)  # [B] step at which the ego was last told what to believe
    light: wp.array2d(dtype=wp.int32)  # [B, S] SignalState that such an ego believes, -1: as it is
    sign: wp.array(dtype=wp.int32)  # [B] 1: such an ego knows of the stop sign that it comes to next


@wp.struct
class Ego:
    """Record of each scene's ego in this step; all [B]."""

    contact: wp.array(dtype=wp.int32)  # Contact bits of contacts that began
    contact_agent: wp.array(dtype=wp.int32)
    touching: wp.array(dtype=wp.int64)  # agents touched in the step before
    off_road: wp.array(dtype=wp.int32)
    over_line: wp.array(dtype=wp.int32)
    invasion: wp.array(dtype=wp.int32)
    red_light: wp.array(dtype=wp.int32)
    stop_sign: wp.array(dtype=wp.int32)  # 1 if its tail crossed the line of a stop sign at which it had not stopped
    sign_line: wp.array(dtype=wp.int32)  # route point of the next stop sign's line
    complete: wp.array(dtype=wp.float32)  # percent
    mark: wp.array(dtype=wp.int32)  # last route point passed
    route_distance: wp.array(dtype=wp.float32)
    route_point: wp.array(dtype=wp.int32)  # the route's point that it is measured from
    driven: wp.array(dtype=wp.float32)


@wp.struct
class Work:
    """Pairs of agents that a step must look at more closely; rebuilt in every step."""

    count: wp.array(dtype=wp.int32)  # [2] entries of `pair` and of `meeting`
    pair: wp.array(dtype=wp.int32)  # ((scene * A + who) * A + whom) * 4 + flags (1 may lead, 2 may conflict)
    # (scene * A + who) * A + whom, of drivers of the population that look whether their paths meet
    meeting: wp.array(dtype=wp.int32)
    crossing: wp.array(dtype=wp.float32)  # m/s^2 of reaction to it as a leader, unless it is out of the way by then
    # [B, A] whom an Autopilot follows: gap in cm * LEADERS + row of `PerceivedAgents`, or NO_LEADER
    leader: wp.array2d(dtype=wp.int32)
    # [B, A] factor of the gaps that a driver judges, and 1 while it makes an error (late, and blind to priority)
    judgement: wp.array2d(dtype=wp.vec2)


def array_types(struct: Any) -> dict[str, Any]:
    """Return the array type (`dtype`, `ndim`) of each member of a struct by name, in their order."""
    return dict(struct.cls.__annotations__)
