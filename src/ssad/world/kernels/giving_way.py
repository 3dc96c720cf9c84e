"""Giving way of drivers of the population to the agents that they would meet.

`traffic` lists the pairs. They have a kernel of their own, so that its many registers and long loops do not slow down
the pairs that only follow.
"""

import warp as wp

from ssad.core.types import AgentKind
from ssad.world.kernels.data import (
    FAR,
    HORIZON,
    EpisodeArrays,
    PerceivedAgents,
    Roads,
    State,
    Work,
)
from ssad.world.kernels.drivers import (
    CREEPS,
    FIRM,
    YIELD_LEAST,
    driver_arrives_after,
    driver_follows,
    driver_power,
    driver_yields,
    early_distance,
    early_react,
)
from ssad.world.kernels.lanes import change_priority
from ssad.world.kernels.meeting import Meeting, find_meeting
from ssad.world.kernels.shared import row
from ssad.world.kernels.traffic import has_priority, is_in_junction, looks_longer, waiting_line, waits_at_line

wp.set_module_options({"max_unroll": 0})  # see `traffic`

PASSES = wp.constant(1.0)  # m/s of an agent that is about to pass a standing driver
SOON_THERE = wp.constant(5.0)  # s until it passes
LETS_BELOW = wp.constant(1.5)  # m/s of a starting driver that lets it pass
TOO_FAST = wp.constant(3.5)  # m/s above which a driver that has entered a stretch goes on
WAITING = wp.constant(2.0)  # m/s below which an agent seems to wait
PARALLEL = wp.constant(0.9)  # cosine of two headings
STOPS_THERE = wp.constant(0.5)  # m/s^2 of braking by which an agent is expected to stop
STARTS = wp.constant(0.3)  # m/s^2 from which a waiting agent starts
RELIES = wp.constant(4.0)  # m/s^2 of braking that a driver relies on others to do for it
MARGIN = wp.constant(1.0)  # s between a driver that gives way and the next agent
UNSURE = wp.constant(0.06)  # s/m by which the margin grows with distance
LEAST_MARGIN = wp.constant(0.3)  # s of margin of a driver that has priority
AFTERWARDS = wp.constant(0.3)  # s between an agent that was let pass and the driver
COVERED = wp.constant(0.05)  # s until the other agent arrives, below which it already covers the stretch
STARTS_BELOW = wp.constant(0.3)  # m/s
START_TIME = wp.constant(0.7)  # s that a start from rest takes longer: reaction, and jerk
PICKS_UP_SHARE = wp.constant(0.8)  # share of its acceleration that a driver expects of itself
STILL_STOPS = wp.constant(6.0)  # m/s^2 of needed braking up to which an agent that brakes is expected to stop
JOINS = wp.constant(3.0)  # m beside each other, up to which the agent with priority goes first at a merge
ENTERED = wp.constant(0.5)  # m before a covered stretch, from which a driver is in it
TURNS = wp.constant(6.5)  # m/s below which a braking agent is expected to wait before its turn
HOLDS = wp.constant(0.3)  # share of its acceleration, and m/s^2
DOUBTS = wp.constant(0.5)  # share of its comfortable deceleration, with which a driver brakes in doubt
WARY = wp.constant(2.2)  # m/s^2 that the other agent has to brake, below which a driver does not wait
BRAKES = wp.constant(1.0)  # m/s^2
AHEAD = wp.constant(8)  # m ahead, whose speed limit bounds the speed that a driver expects of itself


@wp.func
def meet_driver(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    perceived: PerceivedAgents,
    b: int,
    i: int,
    j: int,
    e: int,
    agents: int,
    lon: float,
    margin: float,
    goes_first: bool,
) -> Meeting:
    """Return where a driver of the population would meet an agent if it went on as it likes; see `find_meeting`."""
    style = bank.style[e, i]
    route = bank.route[e, i]
    own_body = bank.body[bank.model[e, i]]
    speed = wp.max(state.speed[b, i], 0.0)
    place = state.progress[b, i]
    aim = state.aim[b, i]
    soon = route[0] + wp.min(place + AHEAD, route[1] - 1)
    start = float(0.0)
    if speed < STARTS_BELOW:
        start = START_TIME
    top_speed = wp.min(aim[1], bank.manner[e, i][0] * roads.rule[soon][0])
    motion = wp.vec4(speed, PICKS_UP_SHARE * driver_power(speed, style), top_speed, start)
    rule = row(roads.rule, route[0] + place)
    extra = looks_longer(rule, aim[0] - float(place), own_body[0], speed, style)
    before = wp.vec2(LEAST_MARGIN, 0.0)
    other_accel = float(0.0)
    if j < agents:
        other_accel = state.accel[b, j]
    if not goes_first:
        before = wp.vec2(MARGIN, UNSURE)
    return find_meeting(
        roads,
        perceived,
        b,
        j,
        route,
        state.shift[b, i],
        aim[0],
        lon,
        motion,
        own_body,
        perceived.half[b, j],
        margin,
        before,
        other_accel,
        HORIZON + extra,
    )


@wp.func
def driver_gives_way(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    perceived: PerceivedAgents,
    meeting: Meeting,
    b: int,
    i: int,
    j: int,
    e: int,
    agents: int,
    line: float,
    goes_first: bool,
    dt: float,
) -> float:
    """Return the reaction of a driver of the population to an agent that it would meet.

    line: metres from its front to where it would wait.
    """
    style = bank.style[e, i]
    speed = wp.max(state.speed[b, i], 0.0)
    other_speed = wp.abs(perceived.speed[b, j])
    other_accel = float(0.0)
    if j < agents:
        other_accel = state.accel[b, j]
    is_there = meeting.begin < COVERED
    other_need = float(FAR)
    if not is_there:
        other_need = other_speed / (2.0 * meeting.begin)
    power = driver_power(speed, style)
    end = meeting.end
    if is_there and other_accel < -STOPS_THERE and other_speed < -2.0 * other_accel * end:
        end = FAR  # it may stop in the way
    early = early_distance(meeting.near, speed, state.accel[b, i], bank.manner[e, i][1], style)
    stop = early_react(driver_yields(speed, meeting.near, style), driver_yields(speed, early, style), speed, style)
    comes_after = driver_arrives_after(speed, meeting.near, end + AFTERWARDS, style)
    react = wp.max(stop, comes_after)
    if speed * end < meeting.near:
        react = wp.max(react, -style[3] - power)  # it has passed by then in any case
    # the other one stops if it goes on to brake a little harder than now
    stops = other_accel < -0.1 and other_speed < TURNS and other_speed < 2.0 * (BRAKES - other_accel) * meeting.begin
    stands = other_speed < WAITING and other_accel < STARTS
    if goes_first and ((stops and other_need < STILL_STOPS) or (stands and other_need < RELIES)):
        return 0.0  # the other one stops already, or waits
    if meeting.joins == 1 and perceived.kind[b, j] != AgentKind.WALKER:
        follows = wp.max(driver_follows(speed, other_speed, wp.max(meeting.gap, 1.0), style), -FIRM - power)
        lead = meeting.gap + bank.body[bank.model[e, i]][0] + perceived.half[b, j][0]
        parallel = wp.cos(perceived.pose[b, j][2] - state.pose[b, i][2]) > PARALLEL
        if line <= -1.0 or is_there or parallel:
            # where two ways become one, the driver behind makes room; side by side, the one without priority
            if lead > JOINS or (lead > -JOINS and not goes_first):
                return wp.min(follows, react)
            is_ahead = is_there or parallel or (lead < -JOINS and goes_first)
            if speed < LETS_BELOW and not goes_first and state.aim[b, i][0] < state.shift[b, i][1]:
                is_ahead = bool(False)  # a vehicle that changes lanes from rest is not ahead yet
            if is_ahead or (not goes_first and meeting.near < ENTERED and speed > TOO_FAST):
                return 0.0
        elif goes_first and lead > JOINS and is_in_junction(perceived, b, j):
            # it is going to be ahead: an early lift of the foot is enough
            return wp.max(follows, -style[3] - power)
        elif lead > 0.0:
            react = wp.max(react, follows)
    if goes_first and (other_need < WARY or (other_need < RELIES and meeting.near < ENTERED)):
        return 0.0  # the other one can stop
    if goes_first and other_need < RELIES:
        return -power - DOUBTS * style[3]  # it should, but does not yet
    if speed < LETS_BELOW and comes_after < -HOLDS * power:
        react = wp.min(react, -power - HOLDS)  # it does not start only to stop again
    if meeting.near < ENTERED and speed > LETS_BELOW and not is_there:
        # in the stretch already, it goes on if it leaves it in time
        sooner = meeting.begin
        if wp.min(speed * sooner + 0.5 * power * sooner * sooner, state.aim[b, i][1] * sooner) > meeting.far:
            return 0.0
    need = speed * speed / (2.0 * wp.max(meeting.near - YIELD_LEAST, 0.1))
    if need > STILL_STOPS and meeting.near < ENTERED and meeting.far < 2.0 * bank.body[bank.model[e, i]][0]:
        return 0.0  # most of the stretch lies behind
    if waits_at_line(bank, roads, state, perceived, b, i, j, e, goes_first, line, dt):
        # rolling beyond the line, it stops where the conflict is
        if speed * speed < 3.0 * style[3] * (line + 0.5) and line + 1.0 < meeting.near:
            stop = driver_yields(speed, wp.max(line, 0.0), style)
            if comes_after < -0.3 * power and speed < CREEPS:
                react = stop
            else:
                react = wp.min(react, wp.max(stop, comes_after))
    return react


@wp.kernel(enable_backward=False)
def give_way(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    perceived: PerceivedAgents,
    work: Work,
    agents: int,
    rows: int,
    workers: int,
    dt: float,
):
    """Compute how drivers of the population give way to the agents that they may meet: the list `Work.meeting`.

    It runs after `react_to_agents`, which adds the agents that may also lead.
    """
    tid = wp.tid()
    total = work.count[1]
    slot = int(tid)
    while slot < total:
        code = work.meeting[slot]
        j = code % rows
        code = code / rows
        i = code % agents
        b = code / agents
        e = state.episode[b]
        pose = state.pose[b, i]
        other_pose = perceived.pose[b, j]
        dx = other_pose[0] - pose[0]
        dy = other_pose[1] - pose[1]
        other_speed = wp.abs(perceived.speed[b, j])
        margin = 0.4
        if perceived.kind[b, j] == AgentKind.WALKER:
            margin = 1.0
        goes_first = has_priority(bank, roads, state, perceived, b, i, j, e, dt)
        goes_first = change_priority(perceived, b, i, j, goes_first) or work.judgement[b, i][1] > 0.0
        if wp.max(state.speed[b, i], 0.0) < LETS_BELOW and other_speed > PASSES:
            # a starting driver lets an agent pass that is about to
            if wp.length(wp.vec2(dx, dy)) < SOON_THERE * other_speed:
                goes_first = False
        longitudinal = dx * wp.cos(pose[2]) + dy * wp.sin(pose[2])
        meeting = meet_driver(bank, roads, state, perceived, b, i, j, e, agents, longitudinal, margin, goes_first)
        react = float(0.0)
        if meeting.begin > COVERED:
            react = work.crossing[slot]
        if meeting.near < FAR:
            place = state.progress[b, i]
            line = waiting_line(
                roads,
                bank.route[e, i][0] + place,
                state.aim[b, i][0] - float(place),
                bank.body[bank.model[e, i]][0],
                state.waited[b, i],
            )
            react = wp.min(
                react,
                driver_gives_way(bank, roads, state, perceived, meeting, b, i, j, e, agents, line, goes_first, dt),
            )
        if react < 0.0:
            wp.atomic_min(state.react, b, i, react)
        slot = slot + workers
