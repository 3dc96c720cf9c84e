"""When the Autopilot changes lane: to pass whoever stands or creeps in its lane, and to come back.

The lane beside is taken where it is free: nobody on it would have to brake hard (the safety criterion of MOBIL,
Kesting et al. 2007), and it leads on for as long as the manoeuvre takes. An oncoming lane is used only to pass who
stands, where the line may be crossed and everybody who comes is far enough away; if somebody comes after all, it is
left again while there is room behind who stands. A queue is not passed.
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
    Presence,
    Roads,
    Seen,
    State,
    Work,
)
from ssad.world.kernels.lanes import lanes_left, metres_left, on_oncoming_lane, way_frame
from ssad.world.kernels.shared import boxes_touch, route_frame, row
from ssad.world.kernels.traffic import idm_gap, line_ahead

wp.set_module_options({"max_unroll": 0})  # see `traffic`

PATIENCE = wp.constant(3.0)  # s that somebody must have stood to be passed
QUEUE = wp.constant(25.0)  # m before a junction within which who stands waits for it
VIEW = wp.constant(150.0)  # m within which others count
FIRM = wp.constant(-3.0)  # m/s^2: nobody has to brake harder because of a lane change
SPEED_UP = wp.constant(1.2)  # m/s^2 counted on while passing
RAMP_TIME = wp.constant(3.0)  # s that a lane change takes
RAMP_LEAST = wp.constant(2.2)  # its least length in lengths of the body
PULL_OUT = wp.constant(5.0)  # m that are left to somebody who is going to be passed
APART = wp.constant(25.0)  # m between two who stand that are too few to come back between them

vec5 = wp.types.vector(length=5, dtype=wp.float32)


@wp.func
def place_beside(roads: Roads, route: wp.vec2i, u0: float, guess: float, q: wp.vec3) -> wp.vec4:
    """Where a pose is along a route from `u0` metres on: (m ahead, m left, cosine of the headings' difference, rest).

    rest: what is left of the search, m; where it is large the place is not known.
    """
    u = guess
    rest = float(0.0)
    left = float(0.0)
    at = wp.vec4(0.0, 0.0, 1.0, 0.0)
    for _ in range(5):
        at = route_frame(roads, route[0], route[1], u0 + u)
        # before its start a route goes straight back
        back = wp.min(u0 + u, 0.0)
        dx = q[0] - at[0] - back * at[2]
        dy = q[1] - at[1] - back * at[3]
        rest = dx * at[2] + dy * at[3]
        left = dy * at[2] - dx * at[3]
        if wp.abs(rest) < 0.05:
            break
        u = wp.clamp(u + rest, -VIEW, VIEW)
    return wp.vec4(u, left, wp.cos(q[2]) * at[2] + wp.sin(q[2]) * at[3], wp.abs(rest))


@wp.func
def gaps(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    seen: Seen,
    b: int,
    i: int,
    e: int,
    rows: wp.vec2i,
    share: float,
    v: float,
    horizon: float,
    goal: float,
) -> vec5:
    """Who is on a lane `share` lanes left of i's route: whether i can go there.

    horizon: s that i would be there, goal: metres it would have gone by then.
    Returns: gap in front m (FAR: nobody), speed of who is there, what the hardest-hit behind would have to brake,
    whether i would touch anybody (1.0), whether somebody comes too near by then (1.0).
    """
    route = bank.route[e, i]
    u0 = state.aim[b, i][0]
    pose = state.pose[b, i]
    own = bank.body[bank.model[e, i]]
    at = route_frame(roads, route[0], route[1], u0)
    front = FAR
    speed = float(0.0)
    behind = float(0.0)
    beside = float(0.0)
    comes = float(0.0)
    lane = wp.vec4(0.0, 1.0, share, share)
    for j in range(rows[0], rows[1]):
        if j != i and seen.kind[b, j] != AgentKind.NONE:
            q = seen.pose[b, j]
            dx = q[0] - pose[0]
            dy = q[1] - pose[1]
            if dx * dx + dy * dy < VIEW * VIEW:
                place = place_beside(roads, route, u0, dx * at[2] + dy * at[3], q)
                other = seen.half[b, j]
                c = place[2]
                s = wp.sqrt(wp.max(1.0 - c * c, 0.0))
                along = other[0] * wp.abs(c) + other[1] * s
                across = other[0] * s + other[1] * wp.abs(c)
                vj = seen.speed[b, j] * c
                off = place[1] - metres_left(roads, route[0], route[1], lane, u0 + place[0])
                # on its way to that lane, too
                meant = off
                if seen.change[b, j][0] != 0 and place[3] < 1.0:
                    then = seen.forecast[b, j, 3]
                    later = place_beside(roads, route, u0, place[0] + 2.0 * vj, then)
                    meant = later[1] - metres_left(roads, route[0], route[1], lane, u0 + later[0])
                near = wp.min(wp.abs(off), wp.abs(meant)) < own[1] + across + 0.3 or off * meant < 0.0
                if place[3] < 1.0 and near:
                    ahead = place[0] - along - own[0]
                    after = -place[0] - along - own[0]
                    if ahead > 0.0:
                        if ahead < front:
                            front = ahead
                            speed = vj
                        if vj < -0.5:
                            # it may get faster, by 1 m/s each second
                            reach = wp.max(-vj, wp.min(-vj + 0.5 * horizon, 14.0)) * (horizon + 1.0)
                            if place[0] - along - reach < goal + own[0] + 5.0:
                                comes = 1.0
                        elif c < -0.3 and place[0] - along < goal + own[0] + 5.0 + 0.5 * horizon * horizon:
                            comes = 1.0  # stands, and may start
                    elif after > 0.0:
                        if vj > 0.0:
                            behind = wp.min(behind, idm_gap(vj, wp.max(v, 0.0), after))
                        if after < 1.0:
                            beside = 1.0
                    else:
                        beside = 1.0
    return vec5(front, speed, behind, beside, comes)


@wp.func
def end_of_block(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    seen: Seen,
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
    own = bank.body[bank.model[e, i]]
    at = route_frame(roads, route[0], route[1], u0)
    rounds = int(0)
    grows = bool(True)
    while grows and beyond >= 0.0:
        grows = bool(False)
        reach = beyond + 2.0 * own[0] + APART
        for j in range(rows[0], rows[1]):
            if j != i and seen.kind[b, j] != AgentKind.NONE and beyond >= 0.0:
                q = seen.pose[b, j]
                dx = q[0] - pose[0]
                dy = q[1] - pose[1]
                if dx * dx + dy * dy < 1.3 * reach * reach:
                    place = place_beside(roads, route, u0, dx * at[2] + dy * at[3], q)
                    other = seen.half[b, j]
                    c = wp.abs(place[2])
                    s = wp.sqrt(wp.max(1.0 - c * c, 0.0))
                    along = other[0] * c + other[1] * s
                    within = place[0] - along < reach and place[0] + along > beyond + 0.5
                    if place[3] < 1.0 and wp.abs(place[1]) < own[1] + other[0] * s + other[1] * c and within:
                        if wp.abs(seen.speed[b, j]) < 0.5:
                            beyond = place[0] + along
                            grows = bool(True)
                        elif place[0] - along < beyond + 12.0:
                            beyond = -1.0  # a queue that begins to move
        rounds = rounds + 1
        if rounds > 4 or beyond > line - QUEUE:
            beyond = -1.0
    return beyond


@wp.func
def passing_time(v: float, top: float, distance: float) -> float:
    """Seconds that a distance takes from speed v, getting faster up to `top`."""
    faster = wp.max(top * top - v * v, 0.0) / (2.0 * SPEED_UP)
    time = (wp.sqrt(v * v + 2.0 * SPEED_UP * distance) - v) / SPEED_UP
    if distance > faster:
        time = wp.max(top - v, 0.0) / SPEED_UP + (distance - faster) / wp.max(top, 1.0)
    return time


@wp.func
def way_is_clear(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    seen: Seen,
    b: int,
    i: int,
    j: int,
    e: int,
    shift: wp.vec4,
    length: float,
) -> bool:
    """Whether i passes j without touching it, on a way of `length` metres from where it is, driven along it."""
    route = bank.route[e, i]
    u0 = state.aim[b, i][0]
    own = bank.body[bank.model[e, i]]
    other = seen.half[b, j]
    q = seen.pose[b, j]
    clear = bool(True)
    for k in range(int(length) + 1):
        at = way_frame(roads, route[0], route[1], shift, u0 + float(k))
        body = wp.vec3(at[0], at[1], wp.atan2(at[3], at[2]))
        if boxes_touch(body, own[0] + 0.2, own[1] + 0.3, q, other[0], other[1]):
            clear = bool(False)
            break
    return clear


@wp.func
def break_off(
    bank: EpisodeArrays, roads: Roads, state: State, seen: Seen, b: int, i: int, e: int, rows: wp.vec2i
) -> bool:
    """Go back behind who was to be passed on the oncoming lane, if somebody comes and there is room to stop there."""
    route = bank.route[e, i]
    shift = state.shift[b, i]
    own = bank.body[bank.model[e, i]]
    u0 = state.aim[b, i][0]
    v = wp.max(state.speed[b, i], 0.0)
    top = state.aim[b, i][1]
    shortest = 2.0 * RAMP_LEAST * own[0]
    home = gaps(bank, roads, state, seen, b, i, e, rows, 0.0, v, 0.0, 0.0)
    room = home[0] - wp.max(0.5 * v * v / -FIRM, shortest * lanes_left(shift, u0))
    if home[3] != 0.0 or home[0] >= FAR or home[1] > 0.5 or room < 1.0:
        return False
    line = line_ahead(roads, route[0] + state.progress[b, i], u0 - float(state.progress[b, i]), 0.0)
    beyond = end_of_block(bank, roads, state, seen, b, i, e, rows, own[0] + home[0], line)
    if beyond < 0.0:
        return False
    goal = beyond + own[0] + wp.max(shortest, RAMP_TIME * top)
    time = passing_time(v, top, goal)
    # less cautious than who has not begun yet, or it would give up what was allowed
    found = gaps(bank, roads, state, seen, b, i, e, rows, 1.0, v, wp.max(time - 1.0, 0.0), goal - 5.0)
    if found[4] == 0.0:
        return False
    ramp = wp.max(home[0] - PULL_OUT, shortest * lanes_left(shift, u0))
    state.shift[b, i] = wp.vec4(u0, u0 + wp.min(ramp, RAMP_TIME * v + shortest), lanes_left(shift, u0), 0.0)
    return True


@wp.func
def choose_lane(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    seen: Seen,
    work: Work,
    b: int,
    i: int,
    agents: int,
    all_rows: int,
):
    """Begin a lane change if an Autopilot wants one and it is safe; wait where a lane is about to end."""
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
    if i == 0 and seen.believes[b] == 1:
        rows = wp.vec2i(agents, all_rows)
    if shift[3] > 0.0 and on_oncoming_lane(roads, route[0] + state.progress[b, i], shift):
        if break_off(bank, roads, state, seen, b, i, e, rows):
            return
    if u0 < shift[1]:
        return  # changes lane already
    first = route[0] + state.progress[b, i]
    part = u0 - float(state.progress[b, i])
    v = wp.max(state.speed[b, i], 0.0)
    top = state.aim[b, i][1]
    own = bank.body[bank.model[e, i]]
    room = row(roads.beside, first)
    shortest = 2.0 * RAMP_LEAST * own[0]
    ramp = wp.max(shortest, RAMP_TIME * v)
    back = wp.max(shortest, RAMP_TIME * top)

    if shift[3] != 0.0:
        leads_on = wp.abs(room[1]) - part
        if shift[3] < 0.0:
            leads_on = room[3] - part
        oncoming = shift[3] > 0.0 and room[1] < 0.0
        found = gaps(bank, roads, state, seen, b, i, e, rows, 0.0, v, 0.0, 0.0)
        must = oncoming or leads_on < ramp + 4.0 * v + 30.0
        free = found[0] > 15.0 + 3.0 * v or found[1] > top - 1.0
        safe = found[3] == 0.0 and found[2] > FIRM and idm_gap(v, wp.max(found[1], 0.0), found[0]) > FIRM
        if safe and (must or free):
            ramp = wp.clamp(leads_on - 2.0, shortest, ramp)
            state.shift[b, i] = wp.vec4(u0, u0 + ramp, lanes_left(shift, u0), 0.0)
        elif must and not oncoming:
            stop = leads_on - own[0] - shortest
            if stop < 4.0 * v + 20.0:
                state.react[b, i] = wp.min(state.react[b, i], idm_gap(v, 0.0, stop))
        return

    j = leader % LEADERS
    gap = 0.01 * float(leader // LEADERS)
    q = seen.pose[b, j]
    pose = state.pose[b, i]
    facing = wp.cos(q[2] - pose[2])
    vj = seen.speed[b, j] * facing
    stands = wp.abs(seen.speed[b, j]) < 0.5
    if seen.kind[b, j] == AgentKind.WALKER or (facing < 0.7 and not stands):
        return  # crosses
    if gap > 12.0 + 2.5 * v or top - vj < wp.max(1.5, 0.08 * top) or vj < -0.5 or seen.change[b, j][0] != 0:
        return
    if room[0] == 0.0 and room[2] == 0.0:
        return
    line = line_ahead(roads, first, part, 0.0)
    beyond = own[0] + gap + 2.0 * seen.half[b, j][0]
    if stands:
        if seen.waited[b, j] < PATIENCE or beyond > line - QUEUE:
            return
        beyond = end_of_block(bank, roads, state, seen, b, i, e, rows, beyond, line)
        if beyond < 0.0:
            return
    elif shift[1] > 0.0 and u0 < shift[1] + 20.0:
        return  # has only just come back
    # until it is back in its lane: a distance that grows by what the other goes meanwhile
    goal = beyond + own[0] + 3.0 + back
    time = passing_time(v, top, goal)
    if not stands:
        for _ in range(3):
            time = passing_time(v, top, goal + wp.max(vj, 0.0) * time)
            time = wp.min(time, 60.0)
    goal = goal + wp.max(vj, 0.0) * time
    done = bool(False)
    wants = bool(False)
    for k in range(3):
        share = float(1.0)
        leads_on = room[1] - part
        exists = room[0] > 0.0 and room[1] > 0.0
        if k == 1:
            share = -1.0
            leads_on = room[3] - part
            exists = room[2] > 0.0
        if k == 2:
            leads_on = -room[1] - part
            exists = room[0] > 0.0 and room[1] < 0.0 and stands
        if not done and exists and leads_on > goal + 10.0:
            wants = bool(True)
            found = gaps(bank, roads, state, seen, b, i, e, rows, share, v, time, goal)
            safe = found[3] == 0.0 and found[2] > FIRM
            if k == 2:
                safe = safe and found[4] == 0.0
            # whoever is in front there must be worth it
            worth = found[0] > gap + 20.0 or found[1] > vj + 2.0
            if found[0] < FAR:
                worth = worth and idm_gap(v, wp.max(found[1], 0.0), found[0]) > FIRM
            if safe and worth:
                way = wp.vec4(u0, u0 + ramp, 0.0, share)
                if not way_is_clear(bank, roads, state, seen, b, i, j, e, way, beyond):
                    way = wp.vec4(u0, u0 + wp.max(shortest, 2.0 * v), 0.0, share)
                if way_is_clear(bank, roads, state, seen, b, i, j, e, way, beyond):
                    state.shift[b, i] = way
                    done = bool(True)
                elif stands and v < 0.3:
                    state.stalled[b, i] = 1  # too near to pull out
    if stands and wants and not done:
        state.react[b, i] = wp.min(state.react[b, i], idm_gap(v, 0.0, wp.max(gap - PULL_OUT, 0.1)))


@wp.kernel(enable_backward=False, cuda_max_registers=REGISTERS)
def change_lanes(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    seen: Seen,
    work: Work,
    agents: int,
    all_rows: int,
    threads: int,
):
    """Let every Autopilot begin a lane change that it wants, where that is safe."""
    b, first = wp.tid()
    if state.end[b] == End.RUNNING:
        for i in range(first, agents, threads):
            choose_lane(bank, roads, state, seen, work, b, i, agents, all_rows)
