"""Contacts of all agents, and the record of each scene's ego: what the metrics are made of, and why it ended."""

import warp as wp

from ssad.core.types import AgentKind, Contact, Controller, SignalState
from ssad.world.kernels.data import (
    FAR,
    ContactPolicy,
    Ego,
    End,
    EpisodeArrays,
    Presence,
    Roads,
    Seen,
    State,
    TurnRank,
    Work,
)
from ssad.world.kernels.shared import BRIDGE, boxes_touch, height_of, on_track, row, sign_line, signal_state, wrap


@wp.func
def halfway(a: wp.vec3, b: wp.vec3) -> wp.vec3:
    """Pose half-way between two."""
    return wp.vec3(0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1]), a[2] + 0.5 * wrap(b[2] - a[2]))


@wp.func
def look_for_contacts(bank: EpisodeArrays, roads: Roads, state: State, b: int, i: int, agents: int):
    """Which agents an agent touches, at the end of the step and half-way through it; wakes it near the ego."""
    mask = wp.int64(0)
    if state.active[b, i] != Presence.ABSENT:
        e = state.episode[b]
        p = state.pose[b, i]
        p0 = state.previous[b, i]
        pb = bank.body[bank.model[e, i]]
        reach = pb[0] + pb[1]
        for j in range(agents):
            if j != i and state.active[b, j] != Presence.ABSENT:
                q = state.pose[b, j]
                dx = q[0] - p[0]
                dy = q[1] - p[1]
                qb = bank.body[bank.model[e, j]]
                r = reach + qb[0] + qb[1] + 4.0
                if dx * dx + dy * dy < r * r:
                    hit = boxes_touch(p, pb[0], pb[1], q, qb[0], qb[1])
                    if not hit:
                        q0 = state.previous[b, j]
                        hit = boxes_touch(halfway(p0, p), pb[0], pb[1], halfway(q0, q), qb[0], qb[1])
                    if hit:
                        higher = height_of(bank, roads, state, b, i) - height_of(bank, roads, state, b, j)
                        hit = not wp.abs(higher) > BRIDGE  # NaN: not known
                    if hit:
                        mask = mask | (wp.int64(1) << wp.int64(j))
        if state.active[b, i] == Presence.ASLEEP:
            ego = state.pose[b, 0]
            if wp.length(wp.vec2(ego[0] - p[0], ego[1] - p[1])) < bank.cruise[e, i][1]:
                state.active[b, i] = Presence.AWAKE
    state.touch[b, i] = mask


@wp.kernel(enable_backward=False)
def contact(bank: EpisodeArrays, roads: Roads, state: State, work: Work, agents: int, threads: int):
    """Contacts of all agents; wakes sleeping traffic."""
    b, first = wp.tid()
    if b == 0 and first == 0:
        work.count[0] = 0  # for the next step's `sight`
    if state.end[b] == End.RUNNING:
        for i in range(first, agents, threads):
            look_for_contacts(bank, roads, state, b, i, agents)


@wp.func
def contact_kind(kind: int) -> int:
    """Contact bit for an agent kind."""
    bit = int(Contact.VEHICLE)
    if kind == AgentKind.WALKER:
        bit = Contact.WALKER
    elif kind == AgentKind.BICYCLE:
        bit = Contact.CYCLIST
    elif kind == AgentKind.PROP:
        bit = Contact.STATIC
    return bit


@wp.kernel(enable_backward=False)
def record(bank: EpisodeArrays, roads: Roads, state: State, ego: Ego, agents: int, dt: float):
    """One row of the ego's record, what its contacts do, and the end of the episode; one thread a scene."""
    b = wp.tid()
    if state.end[b] != End.RUNNING:
        return
    e = state.episode[b]
    step = state.step[b] + 1
    state.step[b] = step
    time = float(step) * dt
    pose = state.pose[b, 0]
    before = state.previous[b, 0]
    body = bank.body[bank.model[e, 0]]

    # contacts that began in this step
    now = state.touch[b, 0]
    fresh = now & (~ego.touching[b])
    ego.touching[b] = now
    kinds = int(Contact.NONE)
    other = int(-1)
    if fresh != wp.int64(0):
        for j in range(1, agents):
            if ((fresh >> wp.int64(j)) & wp.int64(1)) == wp.int64(1):
                kinds = kinds | contact_kind(bank.kind[bank.model[e, j]])
                if other < 0:
                    other = j
    ego.contact[b] = kinds
    ego.contact_agent[b] = other
    policy = bank.contact[e]
    if policy == ContactPolicy.REMOVE:
        for j in range(1, agents):
            if ((fresh >> wp.int64(j)) & wp.int64(1)) == wp.int64(1):
                state.active[b, j] = Presence.ABSENT
                if state.controller[b, j] == Controller.TRAJECTORY:
                    state.controller[b, j] = Controller.NONE  # or it would be back in the next step

    # road
    lane = state.lane[b, 0]
    off = int(0)
    if lane < 0:
        off = 1
    ego.off_road[b] = off
    over = int(0)
    inside = int(0)
    if lane >= 0:
        inside = roads.lane_junction[lane]
        side = state.lateral[b, 0]
        if inside == 0 and wp.abs(side[0]) + body[1] > side[1]:
            over = 1
    elif ego.over_line[b] == 1 or off == 1:
        over = 1
    ego.invasion[b] = int(0)
    if over == 1 and ego.over_line[b] == 0:
        ego.invasion[b] = 1
    ego.over_line[b] = over

    # motion
    gone = wp.length(wp.vec2(pose[0] - before[0], pose[1] - before[1]))
    ego.driven[b] = ego.driven[b] + gone

    # route: a point is passed once the ego is beyond it, looking two points ahead (as SafeBench's route criterion)
    route = bank.route[e, 0]
    mark = ego.mark[b]
    passed = mark
    reach = wp.max(3, int(gone) + 2)  # beyond 20 m/s an ego passes more than two points a step
    for k in range(reach):
        n = mark + k
        if n < route[1]:
            p = row(roads.path, route[0] + n)
            if (pose[0] - p[0]) * wp.cos(p[2]) + (pose[1] - p[1]) * wp.sin(p[2]) > 0.0:
                passed = n
    mark = passed
    ego.mark[b] = mark
    last = route[1] - 1
    share = 100.0 * float(mark) / float(last)
    tail = roads.path[route[0] + last]
    to_end = wp.length(wp.vec2(pose[0] - tail[0], pose[1] - tail[1]))
    if share > 99.0 and to_end < 10.0:
        share = 100.0
    ego.complete[b] = wp.max(share, ego.complete[b])
    least = FAR
    near = mark
    for k in range(wp.max(mark - 1, 0), wp.min(mark + 64, last) + 1):
        p = row(roads.path, route[0] + k)
        dx = pose[0] - p[0]
        dy = pose[1] - p[1]
        d2 = dx * dx + dy * dy
        if d2 < least:
            least = d2
            near = k
    ego.route_distance[b] = wp.sqrt(least)
    ego.route_point[b] = near

    # red light: the tail crosses the stop line on red; a right turn after a stop is allowed
    p = row(roads.path, route[0] + near)
    c = wp.cos(p[2])
    s = wp.sin(p[2])
    left = -s * (pose[0] - p[0]) + c * (pose[1] - p[1])
    ran = int(0)
    back = near - int(body[0] + 1.0)
    if back >= 0 and wp.abs(left) < 4.0:
        rule = row(roads.rule, route[0] + back)
        index = roads.path_signal[route[0] + back]
        if index >= 0 and rule[1] <= wp.max(gone, 0.0) + 0.5 and rule[1] > -0.5:
            stopped_right = int(rule[3]) % int(TurnRank.YIELD) == TurnRank.RIGHT and state.waited[b, 0] >= 1.0
            if signal_state(bank, roads, e, index, time) == SignalState.RED and not stopped_right:
                ran = 1
    # rule[1] is whole metres: count a line once
    if ran == 1 and ego.red_light[b] == 0:
        ego.red_light[b] = 1
    elif ran == 1:
        ego.red_light[b] = 2
    else:
        ego.red_light[b] = 0

    # stop sign: the same, where no signal is lit and the ego has not stopped before the line
    missed = int(0)
    if back >= 0 and wp.abs(left) < 4.0:
        line = sign_line(roads, route[0], back)
        passed_line = ego.sign_line[b]
        if line > passed_line:
            ego.sign_line[b] = line
            if passed_line >= 0 and state.halted[b, 0] < passed_line:
                missed = 1
                index = roads.path_signal[route[0] + wp.min(passed_line, back)]
                if index >= 0 and signal_state(bank, roads, e, index, time) != SignalState.OFF:
                    missed = 0
    ego.stop_sign[b] = missed

    limits = bank.limits[e]
    end = int(End.RUNNING)
    if kinds != Contact.NONE and policy == ContactPolicy.END:
        end = End.COLLISION
    elif ego.complete[b] >= 100.0:
        end = End.COMPLETE
    elif float(step) >= limits[0]:
        end = End.MAX_STEPS
    elif ego.driven[b] >= limits[2]:
        end = End.MAX_DISTANCE
    elif time >= limits[1]:
        end = End.MAX_TIME
    state.end[b] = end


@wp.func
def put_back(bank: EpisodeArrays, roads: Roads, state: State, b: int, i: int):
    """Put an agent back to where its episode begins."""
    e = state.episode[b]
    start = bank.start[e, i]
    pose = wp.vec3(start[0], start[1], start[2])
    state.controller[b, i] = bank.controller[e, i]
    state.policy[b, i] = -1
    state.note[b, i] = 0
    state.cruise[b, i] = bank.cruise[e, i][0]
    state.pose[b, i] = pose
    state.previous[b, i] = pose
    state.speed[b, i] = start[3]
    state.accel[b, i] = 0.0
    state.wheel[b, i] = 0.0
    state.control[b, i] = wp.vec4(0.0, 0.0, 0.0, 0.0)
    state.progress[b, i] = 0
    state.phase[b, i] = 0
    state.since[b, i] = 0
    state.travelled[b, i] = 0.0
    state.waited[b, i] = 0.0
    state.halted[b, i] = -1
    state.stalled[b, i] = 0
    state.shift[b, i] = wp.vec4(0.0, 0.0, 0.0, 0.0)
    state.touch[b, i] = wp.int64(0)
    state.lateral[b, i] = wp.vec2(0.0, 0.0)
    state.lane[b, i] = -1
    state.aim[b, i] = wp.vec2(0.0, 0.0)
    state.react[b, i] = 0.0
    awake = int(Presence.AWAKE)
    if bank.model[e, i] < 0:
        awake = Presence.ABSENT
    elif bank.controller[e, i] == Controller.TRAJECTORY and not on_track(roads, bank.track[e, i], 0.0):
        awake = Presence.ABSENT
    elif bank.cruise[e, i][1] > 0.0:
        awake = Presence.ASLEEP
    state.active[b, i] = awake


@wp.kernel(enable_backward=False)
def restart(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    mask: wp.array(dtype=wp.int32),
    ended_too: int,
    agents: int,
    threads: int,
):
    """Put scenes back to the start of their episode: where mask is 1, or (ended_too) where the episode has ended."""
    b, first = wp.tid()
    go = mask[b] == 1
    if ended_too == 1 and state.end[b] != End.RUNNING:
        go = True
    if go:
        for i in range(first, agents, threads):
            put_back(bank, roads, state, b, i)


@wp.kernel(enable_backward=False)
def restart_record(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    seen: Seen,
    ego: Ego,
    mask: wp.array(dtype=wp.int32),
    ended_too: int,
):
    """The scene's own part of `restart`; runs after it, since it clears why the episode ended."""
    b = wp.tid()
    go = mask[b] == 1
    if ended_too == 1 and state.end[b] != End.RUNNING:
        go = True
    if not go:
        return
    mask[b] = 0
    state.step[b] = 0
    state.end[b] = End.RUNNING
    seen.believes[b] = 0
    ego.contact[b] = 0
    ego.contact_agent[b] = -1
    ego.touching[b] = wp.int64(0)
    ego.off_road[b] = 0
    ego.over_line[b] = 0
    ego.invasion[b] = 0
    ego.red_light[b] = 0
    ego.stop_sign[b] = 0
    ego.sign_line[b] = -1
    ego.complete[b] = 0.0
    ego.mark[b] = 0
    ego.route_distance[b] = 0.0
    ego.route_point[b] = 0
    ego.driven[b] = 0.0
