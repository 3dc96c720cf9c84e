"""Lane changes of the Autopilot: to pass an agent that stands or creeps in its lane, and to return.

The lane beside is taken where it is free: no agent on it would have to brake hard (the safety criterion of MOBIL,
Kesting et al. 2007), and it continues for as long as the manoeuvre takes. An oncoming lane is used only to pass a
standing agent, where the marking may be crossed and all oncoming traffic is far enough away. If oncoming traffic
appears after all, the agent returns while there is room behind the obstacle. A queue is not passed.
"""

import warp as wp

from ssad.core.types import AgentKind, Controller
from ssad.world.kernels.data import (
    FAR,
    LEADERS,
    NO_LEADER,
    EpisodeArrays,
    PerceivedAgents,
    Presence,
    Roads,
    State,
    Work,
)
from ssad.world.kernels.lanes import lanes_left, metres_left, on_oncoming_lane, way_frame
from ssad.world.kernels.shared import boxes_touch, route_frame, row
from ssad.world.kernels.traffic import idm_gap, line_ahead, stop_before

wp.set_module_options({"max_unroll": 0})  # see `traffic`

PATIENCE = wp.constant(3.0)  # s that somebody must have stood to be passed
QUEUE = wp.constant(25.0)  # m before a junction within which who stands waits for it
VIEW = wp.constant(150.0)  # m within which others count
FIRM = wp.constant(-3.0)  # m/s^2: nobody has to brake harder because of a lane change
SPEED_UP = wp.constant(1.2)  # m/s^2 counted on while passing
RAMP_TIME = wp.constant(3.0)  # s that a lane change takes
RAMP_LEAST = wp.constant(2.2)  # its least length in lengths of the body
PULL_OUT = wp.constant(5.0)  # m that are left to somebody who is going to be passed
CLOSED_UP = wp.constant(0.1)  # m/s from the speed of its leader: who follows it at its distance
STEADY = wp.constant(0.1)  # m/s^2 of whom nothing but its leader holds up
APART = wp.constant(25.0)  # m between two who stand that are too few to come back between them

vec7 = wp.types.vector(length=7, dtype=wp.float32)


@wp.func
def place_beside(roads: Roads, route: wp.vec2i, u0: float, guess: float, q: wp.vec3) -> wp.vec4:
    """Locate a pose along a route from `u0` metres on: (m ahead, m left, cosine of the headings' difference, rest).

    rest: what is left of the search, m; where it is large the place is not known.
    """
    along = guess
    residual = float(0.0)
    lateral = float(0.0)
    frame = wp.vec4(0.0, 0.0, 1.0, 0.0)
    for _ in range(5):
        frame = route_frame(roads, route[0], route[1], u0 + along)
        # before its start a route goes straight back
        before_start = wp.min(u0 + along, 0.0)
        dx = q[0] - frame[0] - before_start * frame[2]
        dy = q[1] - frame[1] - before_start * frame[3]
        residual = dx * frame[2] + dy * frame[3]
        lateral = dy * frame[2] - dx * frame[3]
        if wp.abs(residual) < 0.05:
            break
        along = wp.clamp(along + residual, -VIEW, VIEW)
    return wp.vec4(along, lateral, wp.cos(q[2]) * frame[2] + wp.sin(q[2]) * frame[3], wp.abs(residual))


@wp.func
def examine_lane(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    perceived: PerceivedAgents,
    b: int,
    i: int,
    e: int,
    rows: wp.vec2i,
    share: float,
    v: float,
    horizon: float,
    goal: float,
) -> vec7:
    """Examine a lane `share` lanes left of i's route: whether i can go there.

    horizon: s that i would be there, goal: metres it would have travelled by then.
    Returns: gap in front m (FAR: none), speed of the agent there, braking of the hardest-hit agent behind,
    whether i would touch an agent (1.0), whether an agent comes too near by then (1.0), gap to the nearest agent behind
    m (FAR: none), its speed.
    """
    route = bank.route[e, i]
    u0 = state.aim[b, i][0]
    pose = state.pose[b, i]
    own_body = bank.body[bank.model[e, i]]
    frame = route_frame(roads, route[0], route[1], u0)
    front_gap = FAR
    front_speed = float(0.0)
    braking_behind = float(0.0)
    rear_gap = FAR
    rear_speed = float(0.0)
    blocked = float(0.0)
    oncoming = float(0.0)
    lane_shift = wp.vec4(0.0, 1.0, share, share)
    for j in range(rows[0], rows[1]):
        if j != i and perceived.kind[b, j] != AgentKind.NONE:
            other_pose = perceived.pose[b, j]
            dx = other_pose[0] - pose[0]
            dy = other_pose[1] - pose[1]
            if dx * dx + dy * dy < VIEW * VIEW:
                position = place_beside(roads, route, u0, dx * frame[2] + dy * frame[3], other_pose)
                other_half = perceived.half[b, j]
                cosine = position[2]
                sine = wp.sqrt(wp.max(1.0 - cosine * cosine, 0.0))
                half_along = other_half[0] * wp.abs(cosine) + other_half[1] * sine
                half_across = other_half[0] * sine + other_half[1] * wp.abs(cosine)
                other_speed = perceived.speed[b, j] * cosine
                lateral_offset = position[1] - metres_left(roads, route[0], route[1], lane_shift, u0 + position[0])
                # An agent that is moving onto that lane counts, too.
                intended_offset = lateral_offset
                if perceived.change[b, j][0] != 0 and position[3] < 1.0:
                    later_pose = perceived.forecast[b, j, 3]
                    later_position = place_beside(roads, route, u0, position[0] + 2.0 * other_speed, later_pose)
                    intended_offset = later_position[1] - metres_left(
                        roads, route[0], route[1], lane_shift, u0 + later_position[0]
                    )
                on_lane = (
                    wp.min(wp.abs(lateral_offset), wp.abs(intended_offset)) < own_body[1] + half_across + 0.3
                    or lateral_offset * intended_offset < 0.0
                )
                if position[3] < 1.0 and on_lane:
                    gap_ahead = position[0] - half_along - own_body[0]
                    gap_behind = -position[0] - half_along - own_body[0]
                    if gap_ahead > 0.0:
                        if gap_ahead < front_gap:
                            front_gap = gap_ahead
                            front_speed = other_speed
                        if other_speed < -0.5:
                            # it may get faster, by 1 m/s each second
                            reach = wp.max(-other_speed, wp.min(-other_speed + 0.5 * horizon, 14.0)) * (horizon + 1.0)
                            if position[0] - half_along - reach < goal + own_body[0] + 5.0:
                                oncoming = 1.0
                        elif (
                            cosine < -0.3
                            and position[0] - half_along < goal + own_body[0] + 5.0 + 0.5 * horizon * horizon
                        ):
                            oncoming = 1.0  # stands, and may start
                    elif gap_behind > 0.0:
                        if other_speed > 0.0:
                            braking_behind = wp.min(braking_behind, idm_gap(other_speed, wp.max(v, 0.0), gap_behind))
                        if gap_behind < rear_gap:
                            rear_gap = gap_behind
                            rear_speed = wp.max(other_speed, 0.0)
                        if gap_behind < 1.0:
                            blocked = 1.0
                    else:
                        blocked = 1.0
    return vec7(front_gap, front_speed, braking_behind, blocked, oncoming, rear_gap, rear_speed)


@wp.func
def end_of_block(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    perceived: PerceivedAgents,
    b: int,
    i: int,
    e: int,
    rows: wp.vec2i,
    beyond: float,
    line: float,
) -> float:
    """Metres to where everybody who stands in i's lane ends, if the first ends at `beyond`; -1: they are a queue.

    line: metres to where the lane's traffic would wait for a junction.
    """
    route = bank.route[e, i]
    u0 = state.aim[b, i][0]
    pose = state.pose[b, i]
    own_body = bank.body[bank.model[e, i]]
    frame = route_frame(roads, route[0], route[1], u0)
    rounds = int(0)
    grows = bool(True)
    while grows and beyond >= 0.0:
        grows = bool(False)
        reach = beyond + 2.0 * own_body[0] + APART
        for j in range(rows[0], rows[1]):
            if j != i and perceived.kind[b, j] != AgentKind.NONE and beyond >= 0.0:
                other_pose = perceived.pose[b, j]
                dx = other_pose[0] - pose[0]
                dy = other_pose[1] - pose[1]
                if dx * dx + dy * dy < 1.3 * reach * reach:
                    position = place_beside(roads, route, u0, dx * frame[2] + dy * frame[3], other_pose)
                    other_half = perceived.half[b, j]
                    cosine = wp.abs(position[2])
                    sine = wp.sqrt(wp.max(1.0 - cosine * cosine, 0.0))
                    half_along = other_half[0] * cosine + other_half[1] * sine
                    within = position[0] - half_along < reach and position[0] + half_along > beyond + 0.5
                    if (
                        position[3] < 1.0
                        and wp.abs(position[1]) < own_body[1] + other_half[0] * sine + other_half[1] * cosine
                        and within
                    ):
                        if wp.abs(perceived.speed[b, j]) < 0.5:
                            beyond = position[0] + half_along
                            grows = bool(True)
                        elif position[0] - half_along < beyond + 12.0:
                            beyond = -1.0  # a queue that begins to move
        rounds = rounds + 1
        if rounds > 4 or beyond > line - QUEUE:
            beyond = -1.0
    return beyond


@wp.func
def passing_time(v: float, top: float, distance: float) -> float:
    """Return the time (s) for a distance from speed v, accelerating up to `top`."""
    ramp_distance = wp.max(top * top - v * v, 0.0) / (2.0 * SPEED_UP)
    time = (wp.sqrt(v * v + 2.0 * SPEED_UP * distance) - v) / SPEED_UP
    if distance > ramp_distance:
        time = wp.max(top - v, 0.0) / SPEED_UP + (distance - ramp_distance) / wp.max(top, 1.0)
    return time


@wp.func
def way_is_clear(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    perceived: PerceivedAgents,
    b: int,
    i: int,
    j: int,
    e: int,
    shift: wp.vec4,
    length: float,
    advance: float,
) -> bool:
    """Return whether i passes j without contact, on a path of `length` metres from its place, driven along it.

    advance: metres that j goes on meanwhile, for each metre of the path.
    """
    route = bank.route[e, i]
    u0 = state.aim[b, i][0]
    own_body = bank.body[bank.model[e, i]]
    other_half = perceived.half[b, j]
    other_pose = perceived.pose[b, j]
    clear = bool(True)
    for step in range(int(length) + 1):
        frame = way_frame(roads, route[0], route[1], shift, u0 + float(step))
        body = wp.vec3(frame[0], frame[1], wp.atan2(frame[3], frame[2]))
        moved = advance * float(step)
        later_pose = wp.vec3(
            other_pose[0] + moved * wp.cos(other_pose[2]), other_pose[1] + moved * wp.sin(other_pose[2]), other_pose[2]
        )
        if boxes_touch(body, own_body[0] + 0.2, own_body[1] + 0.3, later_pose, other_half[0], other_half[1]):
            clear = bool(False)
            break
    return clear


@wp.func
def should_abort_passing(
    bank: EpisodeArrays, roads: Roads, state: State, perceived: PerceivedAgents, b: int, i: int, e: int, rows: wp.vec2i
) -> bool:
    """Abort passing on the oncoming lane if traffic comes and there is room to stop behind the obstacle."""
    route = bank.route[e, i]
    shift = state.shift[b, i]
    own_body = bank.body[bank.model[e, i]]
    u0 = state.aim[b, i][0]
    speed = wp.max(state.speed[b, i], 0.0)
    top = state.aim[b, i][1]
    shortest = 2.0 * RAMP_LEAST * own_body[0]
    own_lane = examine_lane(bank, roads, state, perceived, b, i, e, rows, 0.0, speed, 0.0, 0.0)
    stopping_room = own_lane[0] - wp.max(0.5 * speed * speed / -FIRM, shortest * lanes_left(shift, u0))
    if own_lane[3] != 0.0 or own_lane[0] >= FAR or own_lane[1] > 0.5 or stopping_room < 1.0:
        return False
    line = line_ahead(roads, route[0] + state.progress[b, i], u0 - float(state.progress[b, i]), 0.0)
    beyond = end_of_block(bank, roads, state, perceived, b, i, e, rows, own_body[0] + own_lane[0], line)
    if beyond < 0.0:
        return False
    goal = beyond + own_body[0] + wp.max(shortest, RAMP_TIME * top)
    duration = passing_time(speed, top, goal)
    # Less cautious than before the manoeuvre begins, or it would abort what has just been allowed.
    oncoming_lane = examine_lane(
        bank, roads, state, perceived, b, i, e, rows, 1.0, speed, wp.max(duration - 1.0, 0.0), goal - 5.0
    )
    if oncoming_lane[4] == 0.0:
        return False
    return_length = wp.max(own_lane[0] - PULL_OUT, shortest * lanes_left(shift, u0))
    state.shift[b, i] = wp.vec4(
        u0, u0 + wp.min(return_length, RAMP_TIME * speed + shortest), lanes_left(shift, u0), 0.0
    )
    return True


@wp.func
def choose_lane(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    perceived: PerceivedAgents,
    work: Work,
    b: int,
    i: int,
    agents: int,
    all_rows: int,
):
    """Begin a lane change if an Autopilot needs one and it is safe; wait where a lane is about to end."""
    if state.active[b, i] != Presence.AWAKE:
        return
    e = state.episode[b]
    route = bank.route[e, i]
    if state.controller[b, i] != Controller.AUTOPILOT or route[1] < 2:
        state.shift[b, i] = wp.vec4(0.0, 0.0, 0.0, 0.0)
        return
    shift = state.shift[b, i]
    leader = work.leader[b, i]
    if shift[3] == 0.0 and leader == NO_LEADER:
        return
    u0 = state.aim[b, i][0]
    rows = wp.vec2i(0, agents)
    if i == 0 and perceived.believes[b] == 1:
        rows = wp.vec2i(agents, all_rows)
    if shift[3] > 0.0 and on_oncoming_lane(roads, route[0] + state.progress[b, i], shift):
        if should_abort_passing(bank, roads, state, perceived, b, i, e, rows):
            return
    if u0 < shift[1]:
        return  # changes lane already
    route_point = route[0] + state.progress[b, i]
    offset = u0 - float(state.progress[b, i])
    speed = wp.max(state.speed[b, i], 0.0)
    top = state.aim[b, i][1]
    own_body = bank.body[bank.model[e, i]]
    adjacent_lanes = row(roads.beside, route_point)
    shortest = 2.0 * RAMP_LEAST * own_body[0]
    change_length = wp.max(shortest, RAMP_TIME * speed)
    return_length = wp.max(shortest, RAMP_TIME * top)

    if shift[3] != 0.0:
        leads_on = wp.abs(adjacent_lanes[1]) - offset
        if shift[3] < 0.0:
            leads_on = adjacent_lanes[3] - offset
        oncoming = shift[3] > 0.0 and adjacent_lanes[1] < 0.0
        lane_gaps = examine_lane(bank, roads, state, perceived, b, i, e, rows, 0.0, speed, 0.0, 0.0)
        must_return = oncoming or leads_on < change_length + 4.0 * speed + 30.0
        free = lane_gaps[0] > 15.0 + 3.0 * speed or lane_gaps[1] > top - 1.0
        safe = (
            lane_gaps[3] == 0.0
            and lane_gaps[2] > FIRM
            and idm_gap(speed, wp.max(lane_gaps[1], 0.0), lane_gaps[0]) > FIRM
        )
        if safe and (must_return or free):
            change_length = wp.clamp(leads_on - 2.0, shortest, change_length)
            state.shift[b, i] = wp.vec4(u0, u0 + change_length, lanes_left(shift, u0), 0.0)
        elif must_return and not oncoming:
            stop = leads_on - own_body[0] - shortest
            if stop < 4.0 * speed + 20.0:
                state.react[b, i] = wp.min(state.react[b, i], stop_before(speed, stop, bank.style[e, i]))
        return

    j = leader % LEADERS
    gap = 0.01 * float(leader // LEADERS)
    other_pose = perceived.pose[b, j]
    pose = state.pose[b, i]
    facing = wp.cos(other_pose[2] - pose[2])
    other_speed = perceived.speed[b, j] * facing
    stands = wp.abs(perceived.speed[b, j]) < 0.5
    if perceived.kind[b, j] == AgentKind.WALKER or (facing < 0.7 and not stands):
        return  # crosses
    if (
        gap > 12.0 + 2.5 * speed
        or top - other_speed < wp.max(1.5, 0.08 * top)
        or other_speed < -0.5
        or perceived.change[b, j][0] != 0
    ):
        return
    if adjacent_lanes[0] == 0.0 and adjacent_lanes[2] == 0.0:
        return
    line = line_ahead(roads, route_point, offset, 0.0)
    beyond = own_body[0] + gap + 2.0 * perceived.half[b, j][0]
    if stands:
        if perceived.waited[b, j] < PATIENCE or beyond > line - QUEUE:
            return
        beyond = end_of_block(bank, roads, state, perceived, b, i, e, rows, beyond, line)
        if beyond < 0.0:
            return
    elif shift[1] > 0.0 and u0 < shift[1] + 20.0:
        return  # has only just come back
    # until it is back in its lane: a distance that grows by what the other goes meanwhile
    goal = beyond + own_body[0] + 3.0 + return_length
    time = passing_time(speed, top, goal)
    if not stands:
        for _ in range(3):
            time = passing_time(speed, top, goal + wp.max(other_speed, 0.0) * time)
            time = wp.min(time, 60.0)
    goal = goal + wp.max(other_speed, 0.0) * time
    decided = bool(False)
    wants = bool(False)
    for option in range(3):
        share = float(1.0)
        leads_on = adjacent_lanes[1] - offset
        exists = adjacent_lanes[0] > 0.0 and adjacent_lanes[1] > 0.0
        if option == 1:
            share = -1.0
            leads_on = adjacent_lanes[3] - offset
            exists = adjacent_lanes[2] > 0.0
        if option == 2:
            leads_on = -adjacent_lanes[1] - offset
            exists = adjacent_lanes[0] > 0.0 and adjacent_lanes[1] < 0.0 and stands
        if not decided and exists and leads_on > goal + 10.0:
            wants = bool(True)
            lane_gaps = examine_lane(bank, roads, state, perceived, b, i, e, rows, share, speed, time, goal)
            safe = lane_gaps[3] == 0.0 and lane_gaps[2] > FIRM
            if option == 2:
                safe = safe and lane_gaps[4] == 0.0
            # The lane's leader must leave enough advantage.
            worth = lane_gaps[0] > gap + 20.0 or lane_gaps[1] > other_speed + 2.0
            if lane_gaps[0] < FAR:
                worth = worth and idm_gap(speed, wp.max(lane_gaps[1], 0.0), lane_gaps[0]) > FIRM
            if safe and worth:
                shift_option = wp.vec4(u0, u0 + change_length, 0.0, share)
                if not way_is_clear(bank, roads, state, perceived, b, i, j, e, shift_option, beyond, 0.0):
                    shift_option = wp.vec4(u0, u0 + wp.max(shortest, 2.0 * speed), 0.0, share)
                clear = way_is_clear(bank, roads, state, perceived, b, i, j, e, shift_option, beyond, 0.0)
                steady = wp.abs(state.accel[b, i]) < STEADY and wp.abs(speed - other_speed) < CLOSED_UP
                if not clear and not stands and steady and speed > 1.0:
                    # who follows a creeping leader is too near to pass it where it is now, but it goes on
                    advance = wp.min(other_speed / speed, 1.0)
                    clear = way_is_clear(bank, roads, state, perceived, b, i, j, e, shift_option, beyond, advance)
                if clear:
                    state.shift[b, i] = shift_option
                    decided = bool(True)
                elif stands and speed < 0.3:
                    state.stalled[b, i] = 1  # too near to pull out
    if stands and wants and not decided:
        reaction = stop_before(speed, wp.max(gap - PULL_OUT, 0.1), bank.style[e, i])
        state.react[b, i] = wp.min(state.react[b, i], reaction)
