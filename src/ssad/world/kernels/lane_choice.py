"""Choice of lanes, and the kernel of all lane changes: Autopilots by `overtake`, drivers of the population by MOBIL.

A driver of the population weighs the acceleration that it gains on the lane beside against what its change costs the
driver behind it there, by the asymmetric rule of MOBIL (Kesting, Treiber and Helbing 2007): to pass, and to return when
the other lane is no better any more. It judges gaps by its own time gap, acceleration and comfortable deceleration,
shows its turn signal for `SIGNALS` s, gives the change up if the gap closes meanwhile, and takes as long as it is used
to for the change itself.
"""

import warp as wp

from ssad.core.types import AgentKind, Controller
from ssad.world.kernels.data import (
    FAR,
    LEADERS,
    NO_LEADER,
    REGISTERS,
    End,
    EpisodeArrays,
    PerceivedAgents,
    Presence,
    Roads,
    State,
    Work,
)
from ssad.world.kernels.drivers import HARDEST, driver_accelerates
from ssad.world.kernels.lanes import lanes_left, on_oncoming_lane
from ssad.world.kernels.overtake import (
    FIRM,
    PATIENCE,
    PULL_OUT,
    QUEUE,
    RAMP_LEAST,
    RAMP_TIME,
    VIEW,
    choose_lane,
    end_of_block,
    examine_lane,
    passing_time,
    place_beside,
    should_abort_passing,
    vec7,
    way_is_clear,
)
from ssad.world.kernels.shared import route_frame, row
from ssad.world.kernels.traffic import line_ahead, stop_before

wp.set_module_options({"max_unroll": 0})  # see `traffic`

THRESHOLD = wp.constant(0.2)  # m/s^2 of advantage below which a driver keeps its lane (MOBIL)
BIAS = wp.constant(0.2)  # m/s^2 for which the lane of the route is preferred (MOBIL's bias to the right)
SIGNALS = wp.constant(3.0)  # s that a driver indicates before it leaves its lane
SIGNALS_LEAST = wp.constant(1.0)  # s of it if there is little room
WAVERS = wp.constant(1.5)  # times its comfortable deceleration: a driver gives a change up if the gap demands more
DECIDES = wp.constant(5)  # steps between two decisions
SLOWER = wp.constant(0.8)  # m/s by which a leader has to be slower to be passed
SLOWS = wp.constant(-0.7)  # m/s^2: a leader that brakes harder is not passed
CLEARS = wp.constant(6.0)  # m ahead of the passed vehicle from which a driver returns
NEARS = wp.constant(0.35)  # share of the speed difference that is lost until then
QUEUE_SPEED = wp.constant(3.0)  # m/s of a vehicle that waits or joins a queue
STARTS = wp.constant(3.0)  # m/s below which a change begins almost from rest
PICKS_UP = wp.constant(1.0)  # m/s^2 of a starting follower
LONG_WAIT = wp.constant(15.0)  # s
LEAST_LENGTH = wp.constant(8.0)  # m of a change, also for two-wheelers
COMES_UP = wp.constant(8.0)  # s: a driver does not return behind a slower vehicle that it would reach sooner


@wp.func
def gap_acceleration(speed: float, other_speed: float, gap: float, style: wp.vec4) -> float:
    """Return the acceleration (m/s^2) behind a leader by the Intelligent Driver Model, however small the gap."""
    closing = speed * (speed - other_speed) / (2.0 * wp.sqrt(style[2] * style[3]))
    ratio = (style[1] + wp.max(0.0, speed * style[0] + closing)) / wp.max(gap, 0.1)
    return wp.max(style[2] * (1.0 - ratio * ratio), -HARDEST)


@wp.func
def lane_acceleration(speed: float, target: float, other_speed: float, gap: float, style: wp.vec4) -> float:
    """Return the acceleration on a lane, m/s^2: on a free road (gap FAR), or behind a leader."""
    free = driver_accelerates(speed, target, style)
    if gap >= FAR:
        return free
    return wp.min(free, gap_acceleration(speed, wp.max(other_speed, 0.0), gap, style))


@wp.func
def accepts_gap(lane_gaps: vec7, speed: float, delay: float, braking: float, style: wp.vec4) -> bool:
    """Return whether a driver accepts the gap on a lane that it reaches in `delay` s.

    Neither itself nor whoever is behind may have to brake by more than `braking` m/s^2, as the driver itself would.
    """
    front_speed = wp.max(lane_gaps[1], 0.0)
    front_gap = lane_gaps[0] - wp.max(speed - front_speed, 0.0) * delay
    rear_gap = lane_gaps[5] - wp.max(lane_gaps[6] - speed, 0.0) * delay
    accepted = lane_gaps[3] == 0.0
    if lane_gaps[0] < FAR:
        accepted = accepted and gap_acceleration(speed, front_speed, front_gap, style) > -braking
    if lane_gaps[5] < FAR:
        accepted = accepted and gap_acceleration(lane_gaps[6], speed, rear_gap, style) > -braking
    return accepted


@wp.func
def follower_loss(lane_gaps: vec7, speed: float, length: float, style: wp.vec4) -> float:
    """Return the loss of the follower on a lane if a vehicle of `length` m moves in ahead of it, m/s^2 (at most 0)."""
    loss = float(0.0)
    if lane_gaps[5] < FAR:
        without = float(0.0)
        if lane_gaps[0] < FAR:
            gap = lane_gaps[5] + length + lane_gaps[0]
            without = wp.min(gap_acceleration(lane_gaps[6], wp.max(lane_gaps[1], 0.0), gap, style), 0.0)
        behind = wp.min(gap_acceleration(lane_gaps[6], speed, lane_gaps[5], style), 0.0)
        loss = wp.min(behind - without, 0.0)
    return loss


@wp.func
def has_queue_ahead(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    perceived: PerceivedAgents,
    b: int,
    i: int,
    leader: int,
    e: int,
    rows: wp.vec2i,
    reach: float,
) -> bool:
    """Return whether another agent than the leader is slow or stands on i's lane within `reach` m: no way back."""
    route = bank.route[e, i]
    u0 = state.aim[b, i][0]
    pose = state.pose[b, i]
    own_body = bank.body[bank.model[e, i]]
    frame = route_frame(roads, route[0], route[1], u0)
    queue = bool(False)
    for j in range(rows[0], rows[1]):
        if j != i and j != leader and perceived.kind[b, j] != AgentKind.NONE and perceived.speed[b, j] < QUEUE_SPEED:
            other_pose = perceived.pose[b, j]
            dx = other_pose[0] - pose[0]
            dy = other_pose[1] - pose[1]
            if dx * dx + dy * dy < reach * reach:
                position = place_beside(roads, route, u0, dx * frame[2] + dy * frame[3], other_pose)
                width = own_body[1] + perceived.half[b, j][1]
                ahead = position[0] > 0.0 and position[0] < reach and position[3] < 1.0
                if ahead and position[2] > 0.5 and wp.abs(position[1]) < width:
                    queue = bool(True)
    return queue


@wp.func
def return_to_route(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    perceived: PerceivedAgents,
    work: Work,
    b: int,
    i: int,
    e: int,
    rows: wp.vec2i,
    decides: bool,
):
    """Let a driver beside its route begin to return, where it has to or where it loses nothing by it."""
    route = bank.route[e, i]
    shift = state.shift[b, i]
    u0 = state.aim[b, i][0]
    top = state.aim[b, i][1]
    route_point = route[0] + state.progress[b, i]
    offset = u0 - float(state.progress[b, i])
    speed = wp.max(state.speed[b, i], 0.0)
    style = bank.style[e, i]
    courtesy = bank.courtesy[e, i]
    own_body = bank.body[bank.model[e, i]]
    adjacent_lanes = row(roads.beside, route_point)
    shortest = wp.max(2.0 * RAMP_LEAST * own_body[0], LEAST_LENGTH)
    leads_on = wp.abs(adjacent_lanes[1]) - offset
    if shift[3] < 0.0:
        leads_on = adjacent_lanes[3] - offset
    oncoming = shift[3] > 0.0 and adjacent_lanes[1] < 0.0
    change_length = wp.max(shortest, courtesy[1] * speed)
    must_return = oncoming or leads_on < change_length + (4.0 + SIGNALS) * speed + 30.0
    if not must_return and not decides:
        return
    lane_gaps = examine_lane(bank, roads, state, perceived, b, i, e, rows, 0.0, speed, 0.0, 0.0)
    delay = SIGNALS
    if oncoming:
        delay = SIGNALS_LEAST
        change_length = wp.max(shortest, RAMP_TIME * speed)
    # it is back in its lane before the other lane ends, and before it stands behind a leader there
    front_speed = wp.max(lane_gaps[1], 0.0)
    front_room = lane_gaps[0] + 0.25 * front_speed * front_speed - 2.0
    length_room = wp.min(leads_on - 2.0, front_room)
    # where there is little room, rather a short signal than a short change
    lead = wp.clamp(length_room - wp.max(shortest, RAMP_TIME * speed), 0.0, delay * speed)
    begins = bool(False)
    if must_return:
        merge_gaps = lane_gaps
        if speed < STARTS:
            # while it moves in from rest, the follower may start, too; a driver that has waited long risks more
            pick_up = float(PICKS_UP)
            if state.waited[b, i] > LONG_WAIT:
                pick_up = 0.4 * PICKS_UP
            merge_gaps[6] = merge_gaps[6] + pick_up * SIGNALS
            merge_gaps[5] = merge_gaps[5] - 0.5 * pick_up * SIGNALS * SIGNALS
        begins = accepts_gap(merge_gaps, speed, lead / wp.max(speed, STARTS), wp.max(style[3], -FIRM), style)
    elif accepts_gap(lane_gaps, speed, delay, style[3], style):
        present_gap = FAR
        present_speed = float(0.0)
        leader = work.leader[b, i]
        if leader != NO_LEADER:
            present_gap = 0.01 * float(leader // LEADERS)
            other = leader % LEADERS
            turn = perceived.pose[b, other][2] - state.pose[b, i][2]
            present_speed = perceived.speed[b, other] * wp.cos(turn)
        comes_up = lane_gaps[0] < 15.0 + 3.0 * speed + COMES_UP * wp.max(speed - front_speed, 0.0)
        comes_up = comes_up and lane_gaps[1] < top - SLOWER
        gain = lane_acceleration(speed, top, lane_gaps[1], lane_gaps[0], style)
        gain = gain - lane_acceleration(speed, top, present_speed, present_gap, style)
        passing_gaps = examine_lane(bank, roads, state, perceived, b, i, e, rows, shift[3], speed, 0.0, 0.0)
        gain = gain - courtesy[0] * follower_loss(passing_gaps, speed, 2.0 * own_body[0], style)
        begins = not comes_up and gain >= THRESHOLD - BIAS
    if begins and front_room >= shortest:
        change_length = wp.clamp(length_room - lead, shortest, change_length)
        lanes = lanes_left(shift, u0)
        state.shift[b, i] = wp.vec4(u0 + lead, u0 + lead + change_length, lanes, 0.0)
    elif must_return and not oncoming:
        stop = leads_on - own_body[0] - shortest - 2.0
        if stop < 4.0 * speed + 20.0:
            state.react[b, i] = wp.min(state.react[b, i], stop_before(speed, stop, style))


@wp.func
def pass_leader(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    perceived: PerceivedAgents,
    work: Work,
    b: int,
    i: int,
    e: int,
    agents: int,
    rows: wp.vec2i,
    decides: bool,
):
    """Let a driver on its route begin to pass its leader, where that is an advantage and safe."""
    route = bank.route[e, i]
    shift = state.shift[b, i]
    u0 = state.aim[b, i][0]
    top = state.aim[b, i][1]
    route_point = route[0] + state.progress[b, i]
    offset = u0 - float(state.progress[b, i])
    adjacent_lanes = row(roads.beside, route_point)
    if adjacent_lanes[0] == 0.0 and adjacent_lanes[2] == 0.0:
        return
    leader = work.leader[b, i]
    j = leader % LEADERS
    gap = 0.01 * float(leader // LEADERS)
    speed = wp.max(state.speed[b, i], 0.0)
    style = bank.style[e, i]
    courtesy = bank.courtesy[e, i]
    own_body = bank.body[bank.model[e, i]]
    facing = wp.cos(perceived.pose[b, j][2] - state.pose[b, i][2])
    other_speed = perceived.speed[b, j] * facing
    stands = wp.abs(perceived.speed[b, j]) < 0.5
    if perceived.kind[b, j] == AgentKind.WALKER or (facing < 0.7 and not stands):
        return  # crosses
    if other_speed < -0.5 or perceived.change[b, j][0] != 0 or top - other_speed < SLOWER:
        return
    advantage = float(0.0)
    present = lane_acceleration(speed, top, other_speed, gap, style)
    line = line_ahead(roads, route_point, offset, 0.0)
    beyond = own_body[0] + gap + 2.0 * perceived.half[b, j][0]
    if stands:
        if gap > 12.0 + 2.5 * speed or perceived.waited[b, j] < PATIENCE or beyond > line - QUEUE:
            return
        beyond = end_of_block(bank, roads, state, perceived, b, i, e, rows, beyond, line)
        if beyond < 0.0:
            return
    else:
        if not decides or (shift[1] > 0.0 and u0 < shift[1] + 20.0):
            return  # has only just come back
        if j < agents:
            if state.accel[b, j] < SLOWS:
                return
        advantage = driver_accelerates(speed, top, style) - present
        if advantage < THRESHOLD + BIAS:
            return
        reach = wp.min(VIEW, line)
        if has_queue_ahead(bank, roads, state, perceived, b, i, j, e, rows, reach):
            return
    shortest = wp.max(2.0 * RAMP_LEAST * own_body[0], LEAST_LENGTH)
    duration = courtesy[1]
    # a driver that catches up with its leader loses some speed until it is past
    closing = wp.max(speed - wp.max(other_speed, 0.0), 0.0)
    change_length = wp.max(shortest, duration * (speed - NEARS * closing))
    # until it is back in its lane: a distance that grows by what the other goes until it is passed
    ramp = wp.max(shortest, RAMP_TIME * top)
    room = beyond + own_body[0] + CLEARS
    time = passing_time(speed, top, room + ramp)
    goal = room + ramp
    lead_time = float(0.0)
    if not stands:
        lead_time = SIGNALS
        time = passing_time(speed, top, room)
        for _ in range(3):
            time = wp.min(passing_time(speed, top, room + wp.max(other_speed, 0.0) * time), 60.0)
        goal = goal + wp.max(other_speed, 0.0) * (time + lead_time)
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
        if not decided and exists and leads_on > goal + 10.0 and (stands or line > goal + 5.0):
            wants = bool(True)
            lane_gaps = examine_lane(bank, roads, state, perceived, b, i, e, rows, share, speed, time, goal)
            safe = accepts_gap(lane_gaps, speed, lead_time, style[3], style)
            worth = bool(True)
            if option == 2:
                safe = lane_gaps[3] == 0.0 and lane_gaps[2] > FIRM and lane_gaps[4] == 0.0
                worth = lane_gaps[0] > gap + 20.0 or lane_gaps[1] > other_speed + 2.0
            elif stands:
                worth = lane_gaps[0] > gap + 20.0 or lane_gaps[1] > other_speed + 2.0
            else:
                gain = lane_acceleration(speed, top, lane_gaps[1], lane_gaps[0], style) - present
                gain = gain + courtesy[0] * follower_loss(lane_gaps, speed, 2.0 * own_body[0], style)
                worth = gain > THRESHOLD + BIAS
            if safe and worth:
                advance = float(0.0)
                if not stands and speed > 1.0:
                    advance = wp.min(wp.max(other_speed, 0.0) / speed, 1.0)
                lead = SIGNALS * speed
                option_shift = wp.vec4(u0 + lead, u0 + lead + change_length, 0.0, share)
                clear = way_is_clear(bank, roads, state, perceived, b, i, j, e, option_shift, beyond, advance)
                if not clear:
                    lead = SIGNALS_LEAST * speed
                    option_shift = wp.vec4(u0 + lead, u0 + lead + change_length, 0.0, share)
                    clear = way_is_clear(bank, roads, state, perceived, b, i, j, e, option_shift, beyond, advance)
                if not clear:
                    option_shift = wp.vec4(u0, u0 + wp.max(shortest, 2.0 * speed), 0.0, share)
                    clear = way_is_clear(bank, roads, state, perceived, b, i, j, e, option_shift, beyond, advance)
                if clear:
                    state.shift[b, i] = option_shift
                    decided = bool(True)
                elif stands and speed < 0.3:
                    state.stalled[b, i] = 1  # too near to pull out
    if stands and wants and not decided:
        reaction = stop_before(speed, wp.max(gap - PULL_OUT, 0.1), style)
        state.react[b, i] = wp.min(state.react[b, i], reaction)


@wp.func
def driver_chooses_lane(
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
    """Begin, give up or end a lane change of a driver of the population."""
    if state.active[b, i] != Presence.AWAKE:
        return
    e = state.episode[b]
    route = bank.route[e, i]
    if route[1] < 2:
        return
    shift = state.shift[b, i]
    u0 = state.aim[b, i][0]
    if shift[3] == 0.0 and u0 >= shift[1] and work.leader[b, i] == NO_LEADER:
        return
    rows = wp.vec2i(0, agents)
    if i == 0 and perceived.believes[b] == 1:
        rows = wp.vec2i(agents, all_rows)
    on_oncoming = on_oncoming_lane(roads, route[0] + state.progress[b, i], shift)
    if shift[3] > 0.0 and on_oncoming:
        if should_abort_passing(bank, roads, state, perceived, b, i, e, rows):
            return
    if u0 < shift[1]:
        if u0 < shift[0] and not on_oncoming:
            # it only indicates yet: the gap may close
            speed = wp.max(state.speed[b, i], 0.0)
            style = bank.style[e, i]
            lane_gaps = examine_lane(bank, roads, state, perceived, b, i, e, rows, shift[3], speed, 0.0, 0.0)
            if not accepts_gap(lane_gaps, speed, 0.0, wp.max(WAVERS * style[3], -FIRM), style):
                state.shift[b, i] = wp.vec4(u0, u0, shift[2], shift[2])
        return
    decides = state.step[b] % DECIDES == i % DECIDES
    if shift[3] != 0.0:
        return_to_route(bank, roads, state, perceived, work, b, i, e, rows, decides)
    else:
        pass_leader(bank, roads, state, perceived, work, b, i, e, agents, rows, decides)


@wp.kernel(enable_backward=False, cuda_max_registers=REGISTERS)
def change_lanes(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    perceived: PerceivedAgents,
    work: Work,
    agents: int,
    all_rows: int,
    threads: int,
):
    """Let every Autopilot begin a needed lane change where it is safe."""
    b, first = wp.tid()
    if state.end[b] == End.RUNNING:
        for i in range(first, agents, threads):
            if state.controller[b, i] == Controller.AUTOPILOT and bank.style[state.episode[b], i][0] > 0.0:
                driver_chooses_lane(bank, roads, state, perceived, work, b, i, agents, all_rows)
            else:
                choose_lane(bank, roads, state, perceived, work, b, i, agents, all_rows)
