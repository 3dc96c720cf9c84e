"""What the Autopilot does about others: following, stopping for, and giving way. Its interaction terms.

Its acceleration is IDM's (Treiber et al. 2000): the free-road term under the route's speed profile (`drive`), and the
hardest interaction term of: whoever is in its corridor, the stop line of a red signal, and the near edge of a
predicted conflict that it must yield to (here).
"""

import warp as wp

from ssad.core.types import AgentKind, Controller, SignalState
from ssad.world.kernels.belief import light
from ssad.world.kernels.data import (
    FAR,
    HORIZON,
    LEADERS,
    NO_LEADER,
    REGISTERS,
    STRIDE,
    End,
    EpisodeArrays,
    Presence,
    Roads,
    Seen,
    State,
    TurnRank,
    Work,
)
from ssad.world.kernels.drive import room_behind
from ssad.world.kernels.lanes import ASIDE, change_priority, change_speed, changes, way_frame
from ssad.world.kernels.shared import (
    BRIDGE,
    IDM_ACCEL,
    boxes_touch,
    frames_touch,
    row,
    sign_line,
)

# unrolled, they take half as long again to compile, are no faster on a CPU, and half as fast on a GPU (H200)
wp.set_module_options({"max_unroll": 0})

IDM_BRAKE = wp.constant(3.0)
IDM_HEADWAY = wp.constant(1.2)
IDM_GAP = wp.constant(2.0)
SIGHT = wp.constant(60.0)
BACK_OUT = wp.constant(12.0)  # s after which one of two that stand nose to nose makes room
NOSE_TO_NOSE = wp.constant(4.5)  # m
MAKES_ROOM = wp.constant(9.0)  # m that who backs out leaves to the other
LOCKED = wp.constant(40.0)  # s (longer than the shipped scenarios) after which a two-wheeler leaves a junction
STANDS = wp.constant(0.2)  # m/s
LONGEST = wp.constant(5.2)  # half length of the longest model, m


@wp.func
def idm_gap(v: float, lead: float, gap: float) -> float:
    """IDM's interaction term, m/s^2 (negative): how hard to brake behind something `gap` metres ahead."""
    close = v * (v - lead) / (2.0 * wp.sqrt(IDM_ACCEL * IDM_BRAKE))
    wish = IDM_GAP + wp.max(0.0, v * IDM_HEADWAY + close)
    ratio = wish / wp.max(gap, 0.1)
    return -IDM_ACCEL * ratio * ratio


@wp.func
def lead_gap(
    roads: Roads,
    seen: Seen,
    b: int,
    j: int,
    route: wp.vec2i,
    shift: wp.vec4,
    u0: float,
    lon: float,
    own: wp.vec4,
    other: wp.vec2,
    heading: wp.vec2,
    margin: float,
    bend: float,
) -> wp.vec2:
    """Where the agent of row j stands on a route that begins `u0` metres along: (gap of bumpers or FAR, its speed).

    lon: metres j is ahead in the follower's frame, the first guess of its place; heading: j's unit heading; bend:
    metres that the route ahead leaves its straight line.
    """
    q = seen.pose[b, j]
    u = wp.clamp(lon, 0.0, SIGHT)
    lateral = float(0.0)
    rest = float(0.0)
    at = wp.vec4(0.0, 0.0, 1.0, 0.0)
    for _ in range(4):
        at = way_frame(roads, route[0], route[1], shift, u0 + u)
        rx = q[0] - at[0]
        ry = q[1] - at[1]
        rest = rx * at[2] + ry * at[3]
        lateral = ry * at[2] - rx * at[3]
        if wp.abs(rest) < 0.05:
            break
        u = wp.clamp(u + rest, 0.0, SIGHT)
    c = heading[0] * at[2] + heading[1] * at[3]
    s = wp.abs(heading[0] * at[3] - heading[1] * at[2])
    along = other[0] * wp.abs(c) + other[1] * s
    across = other[0] * s + other[1] * wp.abs(c)
    result = wp.vec2(FAR, 0.0)
    # in a bend the corners sweep wider than the body
    spot = route[0] + wp.clamp(int(u0 + u + 0.5), 0, route[1] - 1)
    sweep = wp.min(0.5 * wp.abs(roads.path[spot][3]) * own[0] * own[0], 1.0)
    # `rest` stays large where j is beside or beyond the ends of the stretch: a projection says nothing there
    if u > 0.0 and u < SIGHT and wp.abs(rest) < 1.0 and wp.abs(lateral) < own[1] + across + margin + sweep:
        result = wp.vec2(u - own[0] - along, seen.speed[b, j] * c)
    if result[0] >= FAR and bend > 1.5 and lon < 20.0:
        # in a tight bend a projection need not converge, and a long body leaves its corridor: drive it along and see
        # 0.2 m of room to either side, checked every metre
        for k in range(14):
            u = float(k + 1)
            at = way_frame(roads, route[0], route[1], shift, u0 + u)
            dx = q[0] - at[0]
            dy = q[1] - at[1]
            # a centimetre more than is asked, so that it never misses what the exact test finds
            if frames_touch(
                dx, dy, at[2], at[3], own[0] + 0.01, own[1] + 0.21, heading[0], heading[1], other[0], other[1]
            ):
                body = wp.vec3(at[0], at[1], wp.atan2(at[3], at[2]))
                if boxes_touch(body, own[0], own[1] + 0.2, q, other[0], other[1]):
                    result = wp.vec2(u - 1.0, seen.speed[b, j] * (heading[0] * at[2] + heading[1] * at[3]))
                    break
    return result


@wp.func
def line_ahead(roads: Roads, first: int, part: float, half: float) -> float:
    """Metres from a front to where it would wait before the next junction: its stop line, or the junction itself.

    first: the route point in the pool; part: metres beyond it; half: half length of the body.
    """
    rule = row(roads.rule, first)
    return wp.min(rule[1], rule[2]) - part - half


@wp.func
def inside(seen: Seen, b: int, j: int) -> bool:
    """Whether somebody's front has entered the junction."""
    return seen.way[b, j][1] < seen.half[b, j][0] - 1.0


@wp.func
def waits(
    bank: EpisodeArrays, roads: Roads, state: State, seen: Seen, b: int, me: int, i: int, j: int, e: int, dt: float
) -> bool:
    """Whether i, who is still before the junction, lets j go first, who is inside.

    Not if it can no longer stop with 4 m/s^2, nor on green (as `me` sees it) for someone who turns left from the other
    side.
    """
    way = seen.way[b, i]
    v = seen.speed[b, i]
    line = way[0] - seen.half[b, i][0]
    lets = v * v < 8.0 * (wp.max(line, 0.0) + 1.5)
    index = seen.signal[b, i]
    turns = seen.way[b, j][2] > way[2]
    if turns and index >= 0 and wp.cos(seen.pose[b, i][2] - seen.pose[b, j][2]) < -0.5:
        if light(bank, roads, state, seen, b, me, e, index, dt) == SignalState.GREEN:
            lets = False
    return lets


@wp.func
def clears(
    bank: EpisodeArrays, roads: Roads, state: State, seen: Seen, b: int, me: int, j: int, e: int, dt: float
) -> bool:
    """Whether j can no longer stop before the junction though its signal, as `me` sees it, is not green any more."""
    index = seen.signal[b, j]
    line = seen.way[b, j][0] - seen.half[b, j][0]
    v = seen.speed[b, j]
    late = bool(False)
    if index >= 0 and v * v >= 8.0 * (wp.max(line, 0.0) + 1.5):
        lit = light(bank, roads, state, seen, b, me, e, index, dt)
        late = lit == SignalState.YELLOW or lit == SignalState.RED
    return late


@wp.func
def first_there(far_i: float, v_i: float, i: int, far_j: float, v_j: float, j: int) -> bool:
    """Whether i is at a place sooner than j; the same bits whoever asks."""
    mine = far_i * (wp.max(v_j, 0.0) + 1.0)
    other = far_j * (wp.max(v_i, 0.0) + 1.0)
    return mine < other or (mine == other and i < j)


@wp.func
def has_priority(
    bank: EpisodeArrays, roads: Roads, state: State, seen: Seen, b: int, i: int, j: int, e: int, dt: float
) -> bool:
    """Whether i goes before j (rows of `seen`) where their paths cross; of each two exactly one goes first.

    Another Autopilot is relied on to give way, and so is the ego, whoever drives it: traffic does not know who is under
    test. Scripted actors and walkers are not. Whoever is inside the junction goes first (see `waits`), then who has got
    there too late to stop at a signal (see `clears`), then whoever has no stop or yield sign, straight before right
    before left, then whoever is nearer to it, then the lower number.
    """
    if seen.gives_way[b, j] == 0:
        return False
    a = seen.way[b, i]
    c = seen.way[b, j]
    inside_i = inside(seen, b, i)
    inside_j = inside(seen, b, j)
    if inside_i and not inside_j and waits(bank, roads, state, seen, b, i, j, i, e, dt):
        return True
    if inside_j and not inside_i and waits(bank, roads, state, seen, b, i, i, j, e, dt):
        return False
    if not inside_i and not inside_j:
        late_i = clears(bank, roads, state, seen, b, i, i, e, dt)
        late_j = clears(bank, roads, state, seen, b, i, j, e, dt)
        if late_i != late_j:
            return late_i
    if a[2] != c[2]:
        return a[2] < c[2]
    if wp.abs(a[1] - c[1]) > 1.0:
        return a[1] < c[1]
    if inside_i and inside_j:
        p = seen.pose[b, i]
        q = seen.pose[b, j]
        across = wp.sin(q[2] - p[2])
        if wp.abs(across) > 0.5:
            # who is first where their straight ways cross; who brakes for the other stays second
            dx = q[0] - p[0]
            dy = q[1] - p[1]
            far_i = (dx * wp.sin(q[2]) - dy * wp.cos(q[2])) / across
            far_j = (dx * wp.sin(p[2]) - dy * wp.cos(p[2])) / across
            return first_there(far_i, seen.speed[b, i], i, far_j, seen.speed[b, j], j)
    return i < j


@wp.func
def conflict_gap(
    roads: Roads,
    seen: Seen,
    b: int,
    j: int,
    route: wp.vec2i,
    shift: wp.vec4,
    u0: float,
    v: float,
    target: float,
    own: wp.vec4,
    other: wp.vec2,
    lat_margin: float,
) -> float:
    """Metres from i's front bumper to the near edge of its predicted conflict with j within 4 s, or FAR.

    i is where it intends to be, j where it will be if it keeps its speed along its own route (its heading if it has
    none); they are compared at the same time and half a second to either side.
    """
    gap = FAR
    u = float(0.0)
    w = v
    # so long that who is fast and short is not first before my way and then behind it
    long = wp.max(other[0], 0.5 * STRIDE * wp.abs(seen.speed[b, j]) - own[1])
    reach = own[0] + long + 2.0
    reach2 = reach * reach
    before = seen.pose[b, j]
    now = seen.forecast[b, j, 0]
    for k in range(HORIZON):
        # it slows down for bends as the route's speed profile says
        spot = route[0] + wp.clamp(int(u0 + u + 0.5), 0, route[1] - 1)
        after = wp.min(w + 2.0 * STRIDE, wp.min(wp.max(target, w), wp.max(roads.rule[spot][0], w - 4.0 * STRIDE)))
        u = u + 0.5 * (w + after) * STRIDE
        w = after
        at = way_frame(roads, route[0], route[1], shift, u0 + u)
        later = now
        if k + 1 < HORIZON:
            later = seen.forecast[b, j, k + 1]
        for n in range(3):
            q = now
            if n == 0:
                q = before
            elif n == 2:
                q = later
            rx = q[0] - at[0]
            ry = q[1] - at[1]
            if rx * rx + ry * ry < reach2:
                along = rx * at[2] + ry * at[3]
                across = ry * at[2] - rx * at[3]
                qc = wp.cos(q[2])
                qs = wp.sin(q[2])
                ct = wp.abs(qc * at[2] + qs * at[3])
                st = wp.abs(qs * at[2] - qc * at[3])
                he = long * ct + other[1] * st
                we = long * st + other[1] * ct
                if wp.abs(across) < own[1] + we + lat_margin and wp.abs(along) < own[0] + he + 1.0:
                    edge = u + along - he - own[0]
                    # already past the near edge with j behind the middle: braking would only stay in its way
                    if edge > 0.0 or along > 0.0:
                        gap = wp.min(gap, wp.max(edge, 0.0))
        before = now
        now = later
    return gap


@wp.func
def apart(
    seen: Seen,
    b: int,
    j: int,
    pose: wp.vec3,
    c: float,
    s: float,
    lon: float,
    lat: float,
    ahead: float,
    off: float,
) -> bool:
    """Whether j's next 4 s cannot meet mine, by the boxes that hold both in my frame: cheap and never wrong.

    lon, lat: where j is now; ahead: metres I can go; off: what bent paths and the bodies' reach add.
    """
    q = seen.forecast[b, j, HORIZON - 1]
    dx = q[0] - pose[0]
    dy = q[1] - pose[1]
    lon1 = dx * c + dy * s
    lat1 = dy * c - dx * s
    aside = wp.min(lat, lat1) > off or wp.max(lat, lat1) < -off
    return aside or wp.min(lon, lon1) - off > ahead or wp.max(lon, lon1) + off < 0.0


@wp.func
def look_around(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    seen: Seen,
    work: Work,
    b: int,
    i: int,
    agents: int,
    rows: int,
    dt: float,
):
    """An Autopilot's target speed, its reaction to signals, and whom it must look at more closely."""
    if state.active[b, i] != Presence.AWAKE:
        return
    e = state.episode[b]
    route = bank.route[e, i]
    if state.controller[b, i] != Controller.AUTOPILOT or route[1] < 2:
        return
    at = state.progress[b, i]
    first = route[0] + at
    rule = row(roads.rule, first)
    pose = state.pose[b, i]
    v = state.speed[b, i]
    own = bank.body[bank.model[e, i]]
    p = row(roads.path, first)
    part = (pose[0] - p[0]) * wp.cos(p[2]) + (pose[1] - p[1]) * wp.sin(p[2])
    cap = wp.min(rule[0], roads.rule[wp.min(first + 2, route[0] + route[1] - 1)][0])
    shift = state.shift[b, i]
    target = wp.min(wp.min(state.cruise[b, i], cap), change_speed(shift, float(at) + part))
    state.aim[b, i] = wp.vec2(float(at) + part, target)
    react = float(0.0)

    index = roads.path_signal[first]
    lit = int(SignalState.OFF)
    if index >= 0 and rule[1] - part < SIGHT + 40.0:
        lit = light(bank, roads, state, seen, b, i, e, index, dt)
    obeys = i > 0 or seen.believes[b] == 0 or seen.sign[b] == 1  # who does not know of a sign does not stop
    if obeys and lit == SignalState.OFF and state.halted[b, i] != sign_line(roads, route[0], at):
        ahead = roads.ahead[first][0] - part - own[0]
        if ahead > -0.5 and ahead < SIGHT + 20.0:
            react = idm_gap(v, 0.0, ahead + 1.0)
    if index >= 0:
        ahead = rule[1] - part - own[0]
        if ahead > -0.5 and ahead < SIGHT + 20.0:
            stop = lit == SignalState.RED
            if lit == SignalState.YELLOW:
                stop = v * v < 2.0 * 3.5 * wp.max(ahead, 0.0)
            if (
                lit == SignalState.RED
                and int(rule[3]) % int(TurnRank.YIELD) == TurnRank.RIGHT
                and state.waited[b, i] >= 1.0
            ):
                stop = False  # right turn on red, after a stop; it yields below
            if stop:
                react = wp.min(react, idm_gap(v, 0.0, ahead + 1.0))
    state.react[b, i] = react
    state.stalled[b, i] = 0
    work.leader[b, i] = NO_LEADER

    c = wp.cos(pose[2])
    s = wp.sin(pose[2])
    # how far ahead anybody matters: 4 s of driving, and the distance to brake in comfort
    goes = wp.max(target, v) * STRIDE * float(HORIZON)
    sees = wp.min(wp.max(goes, 15.0 + 3.0 * v), SIGHT)
    # a path that is not followed exactly leaves the straight line a little more
    bend = roads.bend[first] + 1.0
    if changes(shift):
        bend = bend + ASIDE + SIGHT * wp.abs(wp.sin(pose[2] - p[2]))
    low = wp.vec2(pose[0], pose[1])
    high = low
    for k in range(5):
        at_k = way_frame(roads, route[0], route[1], shift, float(at) + part + 0.2 * float(k + 1) * sees)
        low = wp.vec2(wp.min(low[0], at_k[0]), wp.min(low[1], at_k[1]))
        high = wp.vec2(wp.max(high[0], at_k[0]), wp.max(high[1], at_k[1]))
    # room for both bodies (LONGEST: of any model), and 2 m each that bends leave the chords between the five places
    pad = own[0] + LONGEST + 4.0
    if changes(shift):
        pad = pad + ASIDE
    low = wp.vec2(low[0] - pad, low[1] - pad)
    high = wp.vec2(high[0] + pad, high[1] + pad)
    from_row = int(0)
    to_row = agents
    if i == 0 and seen.believes[b] == 1:
        from_row = agents
        to_row = rows
    for j in range(from_row, to_row):
        if j != i and seen.kind[b, j] != AgentKind.NONE:
            box = seen.span[b, j]
            if box[0] < high[0] and box[2] > low[0] and box[1] < high[1] and box[3] > low[1]:
                other = seen.half[b, j]
                q = seen.pose[b, j]
                dx = q[0] - pose[0]
                dy = q[1] - pose[1]
                lon = dx * c + dy * s
                lat = dy * c - dx * s
                turn = q[2] - pose[2]
                facing = wp.cos(turn)
                # across straight lanes only the width of an aligned body counts
                wide = own[1] + other[0] * wp.abs(wp.sin(turn)) + other[1] * wp.abs(facing) + 1.0
                flags = int(0)
                near = q[0] < high[0] and q[0] > low[0] and q[1] < high[1] and q[1] > low[1]
                if near and lon > -bend - own[0] and wp.abs(lat) < bend + wide:
                    flags = 1
                if wp.abs(seen.speed[b, j]) > 0.2 and (lon >= 0.0 or facing <= 0.5 or wp.abs(lat) > wide):
                    # who is behind me in my lane and goes my way keeps its distance itself
                    bend_j = seen.way[b, j][3]
                    reach = wide
                    if bend_j > 1.0 or bend > 2.0:
                        reach = own[0] + other[0] + 2.0
                    if not apart(seen, b, j, pose, c, s, lon, lat, goes + own[0], bend + bend_j + reach):
                        flags = flags + 2
                if flags > 0 and wp.abs(seen.height[b, j] - seen.height[b, i]) > BRIDGE:
                    flags = 0  # one of us is on a bridge
                if flags > 0:
                    slot = wp.atomic_add(work.count, 0, 1)
                    work.pair[slot] = ((b * agents + i) * rows + j) * 4 + flags


@wp.kernel(enable_backward=False)
def sight(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    seen: Seen,
    work: Work,
    agents: int,
    rows: int,
    threads: int,
    dt: float,
):
    """For every Autopilot: its target speed, its reaction to signals, and whom it must look at more closely.

    The pairs go to a list that `meet` works through, so that the few that matter do not hold up the many that don't;
    their order does not matter, since only the hardest reaction counts.
    """
    b, first = wp.tid()
    if state.end[b] == End.RUNNING:
        for i in range(first, agents, threads):
            look_around(bank, roads, state, seen, work, b, i, agents, rows, dt)


@wp.kernel(enable_backward=False, cuda_max_registers=REGISTERS)
def meet(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    seen: Seen,
    work: Work,
    agents: int,
    rows: int,
    workers: int,
    dt: float,
):
    """Reactions of Autopilots to those whom `sight` listed: following, stopping for, and giving way."""
    tid = wp.tid()
    total = work.count[0]
    slot = int(tid)
    while slot < total:
        code = work.pair[slot]
        flags = code % 4
        code = code / 4
        j = code % rows
        code = code / rows
        i = code % agents
        b = code / agents
        e = state.episode[b]
        route = bank.route[e, i]
        shift = state.shift[b, i]
        pose = state.pose[b, i]
        q = seen.pose[b, j]
        v = wp.max(state.speed[b, i], 0.0)
        own = bank.body[bank.model[e, i]]
        other = seen.half[b, j]
        walks = seen.kind[b, j] == AgentKind.WALKER
        aim = state.aim[b, i]
        react = float(0.0)
        leads = int(0)
        first = route[0] + state.progress[b, i]
        part = aim[0] - float(state.progress[b, i])
        line = line_ahead(roads, first, part, own[0])
        if line > -1.0 and roads.rule[first][2] <= 0.0:
            # in the junction, and so short that its front seems to be before it
            if state.waited[b, i] > LOCKED:
                line = -FAR
        if flags != 2:
            c = wp.cos(pose[2])
            s = wp.sin(pose[2])
            heading = wp.vec2(wp.cos(q[2]), wp.sin(q[2]))
            lon = (q[0] - pose[0]) * c + (q[1] - pose[1]) * s
            stands = wp.abs(seen.speed[b, j]) < STANDS and heading[0] * c + heading[1] * s < 0.7
            margin = 0.3
            if walks:
                margin = 0.6
            bend = roads.bend[route[0] + state.progress[b, i]]
            if aim[0] < shift[1]:
                bend = bend + ASIDE
            lead = lead_gap(roads, seen, b, j, route, shift, aim[0], lon, own, other, heading, margin, bend)
            if lead[0] < FAR:
                react = idm_gap(v, wp.max(lead[1], 0.0), lead[0])
                wp.atomic_min(work.leader, b, i, int(100.0 * wp.clamp(lead[0], 0.0, SIGHT)) * LEADERS + j)
                if heading[0] * c + heading[1] * s > 0.7:
                    leads = 1
                near = NOSE_TO_NOSE
                if state.control[b, i][3] > 0.5:
                    near = MAKES_ROOM  # backs out already
                if stands and lead[0] < near and wp.min(state.waited[b, i], seen.waited[b, j]) > BACK_OUT:
                    # who has to wait makes room, or, if it has no room behind, the other one
                    from_row = int(0)
                    to_row = agents
                    if i == 0 and seen.believes[b] == 1:
                        from_row = agents
                        to_row = rows
                    if not has_priority(bank, roads, state, seen, b, i, j, e, dt):
                        state.stalled[b, i] = 1
                    elif not room_behind(seen, b, j, from_row, to_row):
                        state.stalled[b, i] = 1
                # a junction is entered only where there is room behind it
                room = roads.ahead[first][2] - part - own[0] + 2.0 * own[0] + 2.0
                if line > -1.0 and lead[0] > line + 3.0 and lead[0] < room and lead[1] < 1.5:
                    react = wp.min(react, idm_gap(v, 0.0, wp.max(line, 0.0) + 1.0))
        if flags >= 2 and leads == 0:
            margin = 0.4
            if walks:
                margin = 1.0
            gap = conflict_gap(roads, seen, b, j, route, shift, aim[0], v, aim[1], own, other, margin)
            if gap < FAR:
                goes_first = has_priority(bank, roads, state, seen, b, i, j, e, dt)
                goes_first = change_priority(seen, b, i, j, goes_first)
                if not goes_first and line > -1.0 and not walks and v * v < 8.0 * (line + 1.5):
                    # it is waited before the junction, not in it, but to turn left on green
                    index = roads.path_signal[first]
                    lit = int(SignalState.OFF)
                    if index >= 0 and roads.rule[first][1] < roads.rule[first][2] + 1.0:
                        lit = light(bank, roads, state, seen, b, i, e, index, dt)
                    entered = inside(seen, b, j)
                    crosses = wp.abs(wp.cos(q[2] - pose[2])) < 0.7
                    if lit == SignalState.OFF or lit == SignalState.RED or entered or crosses:
                        gap = wp.min(gap, wp.max(line, 0.0) + 1.0)
                # whoever stands and has to wait is not expected to go after all
                if not goes_first or (gap < 0.5 * v and wp.abs(seen.speed[b, j]) > STANDS):
                    react = wp.min(react, idm_gap(v, 0.0, gap))
        if react < 0.0:
            wp.atomic_min(state.react, b, i, react)
        slot = slot + workers
