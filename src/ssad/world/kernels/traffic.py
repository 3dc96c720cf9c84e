"""Reactions of the Autopilot to other agents: following, stopping for, and giving way. Its interaction terms.

Its acceleration is IDM's (Treiber et al. 2000): the free-road term under the route's speed profile (`drive`), and the
hardest interaction term of: whoever is in its corridor, the stop line of a red signal, and the near edge of a
predicted conflict that it must yield to (here).
"""

import warp as wp

from ssad.core.types import AgentKind, Controller, SignalState
from ssad.world.kernels.belief import extend_box, light
from ssad.world.kernels.data import (
    FAR,
    HORIZON,
    LEADERS,
    NO_LEADER,
    REGISTERS,
    STRIDE,
    End,
    EpisodeArrays,
    PerceivedAgents,
    Presence,
    Roads,
    ScriptMotion,
    State,
    TurnRank,
    Work,
)
from ssad.world.kernels.drive import room_behind
from ssad.world.kernels.drivers import (
    BEYOND_LINE,
    RUNS_RED,
    STAYS_BELOW,
    STOPS_AT_YELLOW,
    driver_follows,
    driver_speed,
    driver_stops,
    driver_yields,
    early_distance,
    early_react,
    is_lapsed,
    judged_share,
    looks_at_crossing,
)
from ssad.world.kernels.lanes import ASIDE, change_priority, change_speed, is_changing_lane, way_frame
from ssad.world.kernels.meeting import (
    ALIGNED,
    forecast_pose,
)
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
FAR_SIGHT = wp.constant(120.0)  # m, of drivers of the population
FAST = wp.constant(27.0)  # m/s: a driver that aims for more than any town's limit looks as far as a gentle stop takes
SIGHT_SHARE = wp.constant(0.2)  # s^2/m: distance of a stop at 2.5 m/s^2, per squared speed
BACK_OUT = wp.constant(12.0)  # s after which one of two vehicles nose to nose makes room
NOSE_TO_NOSE = wp.constant(4.5)  # m
MAKES_ROOM = wp.constant(9.0)  # m that a vehicle leaves to the other one when it backs out
JAMMED = wp.constant(45.0)  # s after which a driver makes room behind a vehicle that stands in a junction
CLOSED_UP = wp.constant(3.0)  # m
LOCKED = wp.constant(40.0)  # s (longer than the shipped scenarios) after which a two-wheeler leaves a junction
STANDS = wp.constant(0.2)  # m/s
APPROACH = wp.constant(25.0)  # m before a junction from which drivers look at crossing traffic
BACKS_TIME = wp.constant(2.0)  # s for which a vehicle is expected to go on backwards
LONGER = wp.constant(6)  # strides beyond the forecast
CROSSES = wp.constant(1.0)  # m/s of a crossing agent that is about to leave the path
LETS_TURN = wp.constant(1.0)  # m/s^2 of braking for a vehicle that turns and has entered the junction
INSIDE = wp.constant(10.0)  # m beyond its line in which a driver still stops for a vehicle in the junction
BESIDE_CYCLIST = wp.constant(1.0)  # m to the side that a driver leaves to a cyclist; else it follows
NARROW = wp.constant(0.5)  # m, half the width of a cyclist that passes a cyclist
PICKS_UP = wp.constant(2.0)  # m/s^2 that an Autopilot expects of itself


@wp.func
def sight_range(cruise: float) -> float:
    """Return how far an Autopilot looks along its route, m; cruise: the speed that it aims for, m/s."""
    reach = SIGHT
    if cruise > FAST:
        reach = SIGHT_SHARE * cruise * cruise
    return reach


@wp.func
def idm_gap(v: float, lead: float, gap: float) -> float:
    """Return IDM's interaction term, m/s^2 (negative): the braking behind an obstacle `gap` metres ahead."""
    closing_term = v * (v - lead) / (2.0 * wp.sqrt(IDM_ACCEL * IDM_BRAKE))
    desired_gap = IDM_GAP + wp.max(0.0, v * IDM_HEADWAY + closing_term)
    ratio = desired_gap / wp.max(gap, 0.1)
    return -IDM_ACCEL * ratio * ratio


@wp.func
def follow(v: float, lead: float, gap: float, style: wp.vec4) -> float:
    """Return the reaction to a leader; style: see `EpisodeArrays`."""
    if style[0] > 0.0:
        return driver_follows(v, lead, gap, style)
    return idm_gap(v, lead, gap)


@wp.func
def stop_before(v: float, gap: float, style: wp.vec4) -> float:
    """Return the reaction to a place `gap` metres ahead before which one stops."""
    if style[0] > 0.0:
        return driver_stops(v, gap, style)
    return idm_gap(v, 0.0, gap)


@wp.func
def stops_early(bank: EpisodeArrays, state: State, b: int, i: int, e: int, speed: float, distance: float) -> float:
    """Return the reaction to a place before which an agent stops, early enough for the jerk of its driver."""
    style = bank.style[e, i]
    react = stop_before(speed, distance, style)
    if style[0] > 0.0:
        early = early_distance(distance, speed, state.accel[b, i], bank.manner[e, i][1], style)
        react = early_react(react, stop_before(speed, early, style), speed, style)
    return react


@wp.func
def lead_gap(
    roads: Roads,
    perceived: PerceivedAgents,
    b: int,
    j: int,
    route: wp.vec2i,
    shift: wp.vec4,
    u0: float,
    lon: float,
    own_body: wp.vec4,
    other_body: wp.vec2,
    heading: wp.vec2,
    margin: float,
    bend: float,
    sight: float,
) -> wp.vec2:
    """Locate the agent of row j on a route that begins `u0` metres along: (gap of bumpers or FAR, its speed).

    lon: metres j is ahead in the follower's frame, the first guess of its place; heading: j's unit heading; bend:
    metres that the route ahead leaves its straight line.
    """
    other_pose = perceived.pose[b, j]
    along = wp.clamp(lon, 0.0, sight)
    lateral = float(0.0)
    residual = float(0.0)
    frame = wp.vec4(0.0, 0.0, 1.0, 0.0)
    for _ in range(4):
        frame = way_frame(roads, route[0], route[1], shift, u0 + along)
        rel_x = other_pose[0] - frame[0]
        rel_y = other_pose[1] - frame[1]
        residual = rel_x * frame[2] + rel_y * frame[3]
        lateral = rel_y * frame[2] - rel_x * frame[3]
        if wp.abs(residual) < 0.05:
            break
        along = wp.clamp(along + residual, 0.0, sight)
    cosine = heading[0] * frame[2] + heading[1] * frame[3]
    sine = wp.abs(heading[0] * frame[3] - heading[1] * frame[2])
    half_along = other_body[0] * wp.abs(cosine) + other_body[1] * sine
    half_across = other_body[0] * sine + other_body[1] * wp.abs(cosine)
    result = wp.vec2(FAR, 0.0)
    # in a bend the corners sweep wider than the body
    route_point = route[0] + wp.clamp(int(u0 + along + 0.5), 0, route[1] - 1)
    sweep = wp.min(0.5 * wp.abs(roads.path[route_point][3]) * own_body[0] * own_body[0], 1.0)
    # `rest` stays large where j is beside or beyond the ends of the stretch: a projection says nothing there
    if (
        along > 0.0
        and along < sight
        and wp.abs(residual) < 1.0
        and wp.abs(lateral) < own_body[1] + half_across + margin + sweep
    ):
        result = wp.vec2(along - own_body[0] - half_along, perceived.speed[b, j] * cosine)
    if result[0] >= FAR and bend > 1.5 and lon < 20.0:
        # in a tight bend a projection need not converge, and a long body leaves its corridor: drive it along and see
        # 0.2 m of room to either side, checked every metre
        for metre in range(14):
            along = float(metre + 1)
            frame = way_frame(roads, route[0], route[1], shift, u0 + along)
            dx = other_pose[0] - frame[0]
            dy = other_pose[1] - frame[1]
            # a centimetre more than is asked, so that it never misses what the exact test finds
            if frames_touch(
                dx,
                dy,
                frame[2],
                frame[3],
                own_body[0] + 0.01,
                own_body[1] + 0.21,
                heading[0],
                heading[1],
                other_body[0],
                other_body[1],
            ):
                body = wp.vec3(frame[0], frame[1], wp.atan2(frame[3], frame[2]))
                if boxes_touch(body, own_body[0], own_body[1] + 0.2, other_pose, other_body[0], other_body[1]):
                    result = wp.vec2(
                        along - 1.0, perceived.speed[b, j] * (heading[0] * frame[2] + heading[1] * frame[3])
                    )
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
def waiting_line(roads: Roads, first: int, part: float, half: float, waited: float) -> float:
    """Return `line_ahead` of an agent that reacts to others; -FAR for an agent that is locked in a junction.

    waited: s that it has stood.
    """
    line = line_ahead(roads, first, part, half)
    if line > -1.0 and roads.rule[first][2] <= 0.0:
        # in the junction, and so short that its front seems to be before it
        if waited > LOCKED:
            line = -FAR
    return line


@wp.func
def is_in_junction(perceived: PerceivedAgents, b: int, j: int) -> bool:
    """Return whether an agent's front has entered the junction."""
    return perceived.way[b, j][1] < perceived.half[b, j][0] - 1.0


@wp.func
def has_style(bank: EpisodeArrays, e: int, row_index: int) -> bool:
    """Return whether the agent of a row has a driver of the population.

    Who plans over a belief does not know who drives the vehicles in it: it expects such drivers where there are any.
    """
    if row_index < bank.style.shape[1]:
        return bank.style[e, row_index][0] > 0.0
    return bank.population[e] == 1


@wp.func
def is_waiting(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    perceived: PerceivedAgents,
    b: int,
    me: int,
    i: int,
    j: int,
    e: int,
    dt: float,
) -> bool:
    """Return whether i, still before the junction, lets j go first, which is inside.

    Not if it can no longer stop with 4 m/s^2, nor on green (as `me` perceives it) for an oncoming agent that turns
    left.
    """
    way = perceived.way[b, i]
    speed = perceived.speed[b, i]
    line = way[0] - perceived.half[b, i][0]
    index = perceived.signal[b, i]
    turns = perceived.way[b, j][2] > way[2]
    expected = float(4.0)
    room = wp.max(line, 0.0) + 1.5
    if has_style(bank, e, i):
        if turns:
            expected = LETS_TURN
        else:
            room = room + INSIDE
    yields = speed * speed < 2.0 * expected * room
    if turns and index >= 0 and wp.cos(perceived.pose[b, i][2] - perceived.pose[b, j][2]) < -0.5:
        if light(bank, roads, state, perceived, b, me, e, index, dt) == SignalState.GREEN:
            yields = False
    return yields


@wp.func
def is_clearing(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    perceived: PerceivedAgents,
    b: int,
    me: int,
    j: int,
    e: int,
    dt: float,
) -> bool:
    """Return whether j can no longer stop before the junction although its signal is not green for `me` any more."""
    index = perceived.signal[b, j]
    line = perceived.way[b, j][0] - perceived.half[b, j][0]
    speed = perceived.speed[b, j]
    too_late = bool(False)
    if has_style(bank, e, j) and perceived.way[b, j][0] > perceived.way[b, j][1] - 0.5:
        index = int(-1)  # its line is behind: the next signal is that of another junction
    if index >= 0 and speed * speed >= 8.0 * (wp.max(line, 0.0) + 1.5):
        signal_now = light(bank, roads, state, perceived, b, me, e, index, dt)
        too_late = signal_now == SignalState.YELLOW or signal_now == SignalState.RED
    return too_late


@wp.func
def arrives_first(far_i: float, v_i: float, i: int, far_j: float, v_j: float, j: int) -> bool:
    """Return whether i reaches a place sooner than j; bit-identical for either observer."""
    own_term = far_i * (wp.max(v_j, 0.0) + 1.0)
    other_term = far_j * (wp.max(v_i, 0.0) + 1.0)
    return own_term < other_term or (own_term == other_term and i < j)


@wp.func
def crosses_first(perceived: PerceivedAgents, b: int, i: int, j: int) -> bool:
    """Return whether i is first at the crossing of their straight paths; an agent that brakes for j stays second."""
    own_pose = perceived.pose[b, i]
    other_pose = perceived.pose[b, j]
    sine = wp.sin(other_pose[2] - own_pose[2])
    dx = other_pose[0] - own_pose[0]
    dy = other_pose[1] - own_pose[1]
    far_i = (dx * wp.sin(other_pose[2]) - dy * wp.cos(other_pose[2])) / sine
    far_j = (dx * wp.sin(own_pose[2]) - dy * wp.cos(own_pose[2])) / sine
    return arrives_first(far_i, perceived.speed[b, i], i, far_j, perceived.speed[b, j], j)


@wp.func
def has_priority(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    perceived: PerceivedAgents,
    b: int,
    i: int,
    j: int,
    e: int,
    dt: float,
) -> bool:
    """Return whether i goes before j (rows of `perceived`) where their paths cross; of each two exactly one goes first.

    Another Autopilot is relied on to give way, and so is the ego under any driver: traffic does not know which agent
    is under test. Scripted actors and walkers are not. Priority goes to the agent inside the junction (`is_waiting`),
    then to the one that is too late to stop at a signal (`is_clearing`), then to the one without a stop or yield sign,
    straight before right before left, then to the one nearer to it, then to the lower number.
    """
    if perceived.gives_way[b, j] == 0:
        return False
    own_way = perceived.way[b, i]
    other_way = perceived.way[b, j]
    inside_i = is_in_junction(perceived, b, i)
    inside_j = is_in_junction(perceived, b, j)
    if inside_i and not inside_j and is_waiting(bank, roads, state, perceived, b, i, j, i, e, dt):
        return True
    if inside_j and not inside_i and is_waiting(bank, roads, state, perceived, b, i, i, j, e, dt):
        return False
    if not inside_i and not inside_j:
        late_i = is_clearing(bank, roads, state, perceived, b, i, i, e, dt)
        late_j = is_clearing(bank, roads, state, perceived, b, i, j, e, dt)
        if late_i != late_j:
            return late_i
    if own_way[2] != other_way[2]:
        return own_way[2] < other_way[2]
    if wp.abs(own_way[1] - other_way[1]) > 1.0:
        return own_way[1] < other_way[1]
    if inside_i and inside_j and wp.abs(wp.sin(perceived.pose[b, j][2] - perceived.pose[b, i][2])) > 0.5:
        return crosses_first(perceived, b, i, j)
    return i < j


@wp.func
def looks_longer(rule: wp.vec4, offset: float, half: float, speed: float, style: wp.vec4) -> int:
    """Return the strides beyond the forecast that a driver of the population looks ahead: before it crosses traffic."""
    front = rule[2] - offset - half
    crosses = int(rule[3]) != int(TurnRank.STRAIGHT) or speed < 3.0
    extra = int(0)
    reach = float(APPROACH)
    if int(rule[3]) >= int(TurnRank.YIELD):
        reach = 2.0 * APPROACH
    if style[0] > 0.0 and front < reach and crosses:
        extra = LONGER
    return extra


@wp.func
def conflict_gap(
    roads: Roads,
    perceived: PerceivedAgents,
    b: int,
    j: int,
    route: wp.vec2i,
    shift: wp.vec4,
    u0: float,
    v: float,
    target: float,
    own_body: wp.vec4,
    other_body: wp.vec2,
    lat_margin: float,
) -> float:
    """Return the distance from i's front bumper to its predicted conflict with j, or FAR.

    i is predicted along its intention, j along its own route at constant speed (along its heading if it has none);
    they are compared at the same time and half a second to either side. The distance is to the near edge of the
    conflict. Drivers of the population look closer: `meeting`.
    """
    gap = FAR
    along = float(0.0)
    speed = v
    # Long enough that a fast, short agent does not skip from before the path to behind it.
    half_length = wp.max(other_body[0], 0.5 * STRIDE * wp.abs(perceived.speed[b, j]) - own_body[1])
    reach = own_body[0] + half_length + 2.0
    squared_reach = reach * reach
    before = perceived.pose[b, j]
    now = perceived.forecast[b, j, 0]
    for step in range(HORIZON):
        # it slows down for bends as the route's speed profile says
        route_point = route[0] + wp.clamp(int(u0 + along + 0.5), 0, route[1] - 1)
        next_speed = wp.min(
            speed + PICKS_UP * STRIDE,
            wp.min(wp.max(target, speed), wp.max(roads.rule[route_point][0], speed - 4.0 * STRIDE)),
        )
        along = along + 0.5 * (speed + next_speed) * STRIDE
        speed = next_speed
        frame = way_frame(roads, route[0], route[1], shift, u0 + along)
        later = now
        if step + 1 < HORIZON:
            later = perceived.forecast[b, j, step + 1]
        for moment in range(3):
            other_pose = now
            if moment == 0:
                other_pose = before
            elif moment == 2:
                other_pose = later
            rel_x = other_pose[0] - frame[0]
            rel_y = other_pose[1] - frame[1]
            if rel_x * rel_x + rel_y * rel_y < squared_reach:
                longitudinal = rel_x * frame[2] + rel_y * frame[3]
                lateral = rel_y * frame[2] - rel_x * frame[3]
                other_cos = wp.cos(other_pose[2])
                other_sin = wp.sin(other_pose[2])
                abs_cos = wp.abs(other_cos * frame[2] + other_sin * frame[3])
                abs_sin = wp.abs(other_sin * frame[2] - other_cos * frame[3])
                half_along = half_length * abs_cos + other_body[1] * abs_sin
                half_across = half_length * abs_sin + other_body[1] * abs_cos
                if (
                    wp.abs(lateral) < own_body[1] + half_across + lat_margin
                    and wp.abs(longitudinal) < own_body[0] + half_along + 1.0
                ):
                    edge = along + longitudinal - half_along - own_body[0]
                    # already past the near edge with j behind the middle: braking would only stay in its way
                    if edge > 0.0 or longitudinal > 0.0:
                        gap = wp.min(gap, wp.max(edge, 0.0))
        before = now
        now = later
    return gap


@wp.func
def is_natural_walker(bank: EpisodeArrays, e: int, j: int) -> bool:
    """Return whether a row of `PerceivedAgents` is a walker of natural traffic, for which `walkers` has the rules."""
    natural = bool(False)
    if j < bank.script.shape[1]:
        natural = bank.script[e, j][3] == ScriptMotion.WALK
    return natural


@wp.func
def cannot_meet(
    pose: wp.vec3,
    c: float,
    s: float,
    lon: float,
    lat: float,
    ahead: float,
    off: float,
    last_pose: wp.vec3,
) -> bool:
    """Return whether j's next seconds cannot meet i's, by bounding boxes in i's frame: cheap and never wrong.

    last_pose: j's last one;
    lon, lat: its place now; ahead: metres that i can travel; off: margin for bent paths and the bodies' reach.
    """
    dx = last_pose[0] - pose[0]
    dy = last_pose[1] - pose[1]
    last_lon = dx * c + dy * s
    last_lat = dy * c - dx * s
    aside = wp.min(lat, last_lat) > off or wp.max(lat, last_lat) < -off
    return aside or wp.min(lon, last_lon) - off > ahead or wp.max(lon, last_lon) + off < 0.0


@wp.func
def add_meeting(work: Work, code: int, crossing_react: float):
    """List a pair whose driver of the population foresees whether it would meet the other agent; see `Work`."""
    slot = wp.atomic_add(work.count, 1, 1)
    work.meeting[slot] = code
    work.crossing[slot] = crossing_react


@wp.func
def scan_agents(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    perceived: PerceivedAgents,
    work: Work,
    b: int,
    i: int,
    agents: int,
    rows: int,
    dt: float,
):
    """An Autopilot's target speed, its reaction to signals, and the agents that it must examine."""
    if state.active[b, i] != Presence.AWAKE:
        return
    e = state.episode[b]
    route = bank.route[e, i]
    if state.controller[b, i] != Controller.AUTOPILOT or route[1] < 2:
        return
    at = state.progress[b, i]
    first = route[0] + at
    road_rule = row(roads.rule, first)
    pose = state.pose[b, i]
    speed = state.speed[b, i]
    own_body = bank.body[bank.model[e, i]]
    point = row(roads.path, first)
    offset = (pose[0] - point[0]) * wp.cos(point[2]) + (pose[1] - point[1]) * wp.sin(point[2])
    style = bank.style[e, i]
    speed_cap = wp.min(road_rule[0], roads.rule[wp.min(first + 2, route[0] + route[1] - 1)][0])
    if style[0] > 0.0:
        time = float(state.step[b]) * dt
        manner = bank.manner[e, i]
        habit = bank.habit[e, i]
        speed_cap = driver_speed(roads, route, at, speed, manner[0], style[3])
        blind = float(0.0)
        if is_lapsed(habit, time):
            blind = 1.0
        work.judgement[b, i] = wp.vec2(judged_share(manner, habit, time), blind)
    shift = state.shift[b, i]
    target = wp.min(wp.min(state.cruise[b, i], speed_cap), change_speed(shift, float(at) + offset))
    state.aim[b, i] = wp.vec2(float(at) + offset, target)
    react = float(0.0)

    sight = sight_range(state.cruise[b, i])
    if style[0] > 0.0:
        sight = wp.max(sight, FAR_SIGHT)
    signal_index = roads.path_signal[first]
    signal_now = int(SignalState.OFF)
    if signal_index >= 0 and road_rule[1] - offset < sight + 40.0:
        signal_now = light(bank, roads, state, perceived, b, i, e, signal_index, dt)
    obeys = i > 0 or perceived.believes[b] == 0 or perceived.sign[b] == 1  # unaware of a sign, the ego does not stop
    if obeys and signal_now == SignalState.OFF and state.halted[b, i] != sign_line(roads, route[0], at):
        line_gap = roads.ahead[first][0] - offset - own_body[0]
        if line_gap > -0.5 and line_gap < sight + 20.0:
            react = stops_early(bank, state, b, i, e, speed, line_gap + 1.0)
    if signal_index >= 0:
        line_gap = road_rule[1] - offset - own_body[0]
        passed = float(-0.5)
        if style[0] > 0.0 and signal_now == SignalState.RED and speed < STAYS_BELOW:
            passed = -BEYOND_LINE
        if line_gap > passed and line_gap < sight + 20.0:
            stop = signal_now == SignalState.RED
            if signal_now == SignalState.YELLOW:
                stop = speed * speed < 2.0 * 3.5 * wp.max(line_gap, 0.0)
                if style[0] > 0.0:
                    stop = speed * speed < 2.0 * STOPS_AT_YELLOW * wp.max(line_gap, 0.5)
            elif style[0] > 0.0 and speed > 4.0 and speed * speed > 2.0 * RUNS_RED * wp.max(line_gap, 0.5):
                stop = False  # the decision to go was made at yellow
            if (
                signal_now == SignalState.RED
                and int(road_rule[3]) % int(TurnRank.YIELD) == TurnRank.RIGHT
                and state.waited[b, i] >= 1.0
                and roads.grid[bank.town[e]][3] > 0.0
            ):
                stop = False  # turn to the near side on red, after a stop, where allowed; it yields below
            if stop:
                react = wp.min(react, stops_early(bank, state, b, i, e, speed, line_gap + 1.0))
    state.react[b, i] = react
    state.stalled[b, i] = 0
    work.leader[b, i] = NO_LEADER

    c = wp.cos(pose[2])
    s = wp.sin(pose[2])
    # Range within which agents matter: 4 s of driving, and the distance of comfortable braking.
    extra = looks_longer(road_rule, offset, own_body[0], speed, style)
    travel = wp.max(target, speed) * STRIDE * float(HORIZON + extra)
    view_range = wp.min(wp.max(travel, 15.0 + 3.0 * speed), sight)
    if sight > SIGHT and style[0] == 0.0:
        view_range = wp.min(wp.max(view_range, SIGHT_SHARE * speed * speed), sight)
    # a path that is not followed exactly leaves the straight line a little more
    bend = roads.bend[first] + 1.0
    if is_changing_lane(shift):
        bend = bend + ASIDE + sight * wp.abs(wp.sin(pose[2] - point[2]))
    box_low = wp.vec2(pose[0], pose[1])
    box_high = box_low
    for corner in range(5):
        frame = way_frame(roads, route[0], route[1], shift, float(at) + offset + 0.2 * float(corner + 1) * view_range)
        box_low = wp.vec2(wp.min(box_low[0], frame[0]), wp.min(box_low[1], frame[1]))
        box_high = wp.vec2(wp.max(box_high[0], frame[0]), wp.max(box_high[1], frame[1]))
    # room for both bodies, and 2 m each that bends leave the chords between the five places
    padding = own_body[0] + bank.surface[e][2] + 4.0
    if is_changing_lane(shift):
        padding = padding + ASIDE
    box_low = wp.vec2(box_low[0] - padding, box_low[1] - padding)
    box_high = wp.vec2(box_high[0] + padding, box_high[1] + padding)
    from_row = int(0)
    to_row = agents
    if i == 0 and perceived.believes[b] == 1:
        from_row = agents
        to_row = rows
    # a driver of the population looks at crossing traffic in some steps only, and keeps in mind what it saw
    looks_aside = style[0] == 0.0 or looks_at_crossing(state, b, i)
    for j in range(from_row, to_row):
        if j != i and perceived.kind[b, j] != AgentKind.NONE:
            box = perceived.span[b, j]
            if not looks_aside:
                here = perceived.pose[b, j]
                box = wp.vec4(here[0], here[1], here[0], here[1])
            elif extra > 0:
                box = extend_box(box, forecast_pose(perceived, b, j, HORIZON - 1 + extra))
            if (
                box[0] < box_high[0]
                and box[2] > box_low[0]
                and box[1] < box_high[1]
                and box[3] > box_low[1]
                and not is_natural_walker(bank, e, j)
            ):
                other_half = perceived.half[b, j]
                other_pose = perceived.pose[b, j]
                dx = other_pose[0] - pose[0]
                dy = other_pose[1] - pose[1]
                longitudinal = dx * c + dy * s
                lateral = dy * c - dx * s
                turn = other_pose[2] - pose[2]
                facing = wp.cos(turn)
                # across straight lanes only the width of an aligned body counts
                half_width = own_body[1] + other_half[0] * wp.abs(wp.sin(turn)) + other_half[1] * wp.abs(facing) + 1.0
                flags = int(0)
                in_box = (
                    other_pose[0] < box_high[0]
                    and other_pose[0] > box_low[0]
                    and other_pose[1] < box_high[1]
                    and other_pose[1] > box_low[1]
                )
                if in_box and longitudinal > -bend - own_body[0] and wp.abs(lateral) < bend + half_width:
                    flags = 1
                if (
                    looks_aside
                    and wp.abs(perceived.speed[b, j]) > 0.2
                    and (longitudinal >= 0.0 or facing <= 0.5 or wp.abs(lateral) > half_width)
                ):
                    # An agent behind in the same lane and direction keeps its distance itself.
                    bend_j = perceived.way[b, j][3]
                    reach = half_width
                    if bend_j > 1.0 or bend > 2.0:
                        reach = own_body[0] + other_half[0] + 2.0
                    last_pose = perceived.forecast[b, j, HORIZON - 1]
                    if extra > 0:
                        last_pose = forecast_pose(perceived, b, j, HORIZON - 1 + extra)
                    if not cannot_meet(
                        pose, c, s, longitudinal, lateral, travel + own_body[0], bend + bend_j + reach, last_pose
                    ):
                        flags = flags + 2
                if flags > 0 and wp.abs(perceived.height[b, j] - perceived.height[b, i]) > BRIDGE:
                    flags = 0  # one of us is on a bridge
                code = (b * agents + i) * rows + j
                if flags == 2 and style[0] > 0.0:
                    add_meeting(work, code, 0.0)
                elif flags > 0:
                    slot = wp.atomic_add(work.count, 0, 1)
                    work.pair[slot] = code * 4 + flags


@wp.func
def waits_at_line(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    perceived: PerceivedAgents,
    b: int,
    i: int,
    j: int,
    e: int,
    goes_first: bool,
    line: float,
    dt: float,
) -> bool:
    """Return whether i waits for j before the junction and not in it, as all do except those that turn left on green.

    line: metres from its front to where it would wait.
    """
    speed = wp.max(state.speed[b, i], 0.0)
    waits = bool(False)
    if (
        not goes_first
        and line > -1.0
        and perceived.kind[b, j] != AgentKind.WALKER
        and speed * speed < 8.0 * (line + 1.5)
    ):
        first = bank.route[e, i][0] + state.progress[b, i]
        index = roads.path_signal[first]
        signal_now = int(SignalState.OFF)
        if index >= 0 and roads.rule[first][1] < roads.rule[first][2] + 1.0:
            signal_now = light(bank, roads, state, perceived, b, i, e, index, dt)
        entered = is_in_junction(perceived, b, j)
        crosses = wp.abs(wp.cos(perceived.pose[b, j][2] - state.pose[b, i][2])) < 0.7
        waits = signal_now == SignalState.OFF or signal_now == SignalState.RED or entered or crosses
    return waits


@wp.kernel(enable_backward=False, cuda_max_registers=REGISTERS)
def scan_all_agents(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    perceived: PerceivedAgents,
    work: Work,
    agents: int,
    rows: int,
    threads: int,
    dt: float,
):
    """For every Autopilot: its target speed, its reaction to signals, and the agents that it must examine.

    The pairs go to a list that `meet` works through, so that the few that matter do not hold up the many that don't;
    their order does not matter, since only the hardest reaction counts.
    """
    b, first = wp.tid()
    if state.end[b] == End.RUNNING:
        for i in range(first, agents, threads):
            scan_agents(bank, roads, state, perceived, work, b, i, agents, rows, dt)


@wp.kernel(enable_backward=False, cuda_max_registers=REGISTERS)
def react_to_agents(
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
    """Compute how Autopilots react to the agents that `scan_all_agents` listed: following, stopping, giving way."""
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
        other_pose = perceived.pose[b, j]
        speed = wp.max(state.speed[b, i], 0.0)
        own_body = bank.body[bank.model[e, i]]
        other_half = perceived.half[b, j]
        walks = perceived.kind[b, j] == AgentKind.WALKER
        aim = state.aim[b, i]
        react = float(0.0)
        crossing_react = float(0.0)
        leads = int(0)
        style = bank.style[e, i]
        judgement = wp.vec2(1.0, 0.0)
        if style[0] > 0.0:
            judgement = work.judgement[b, i]
        first = route[0] + state.progress[b, i]
        offset = aim[0] - float(state.progress[b, i])
        line = waiting_line(roads, first, offset, own_body[0], state.waited[b, i])
        c = wp.cos(pose[2])
        s = wp.sin(pose[2])
        longitudinal = (other_pose[0] - pose[0]) * c + (other_pose[1] - pose[1]) * s
        if flags != 2:
            heading = wp.vec2(wp.cos(other_pose[2]), wp.sin(other_pose[2]))
            stands = wp.abs(perceived.speed[b, j]) < STANDS and heading[0] * c + heading[1] * s < 0.7
            margin = 0.3
            if walks:
                margin = 0.6
            if style[0] > 0.0 and perceived.kind[b, j] == AgentKind.BICYCLE and own_body[1] > NARROW:
                margin = BESIDE_CYCLIST
            bend = roads.bend[route[0] + state.progress[b, i]]
            if aim[0] < shift[1]:
                bend = bend + ASIDE
            sight = sight_range(state.cruise[b, i])
            if style[0] > 0.0:
                sight = wp.max(sight, FAR_SIGHT)
            leader = lead_gap(
                roads,
                perceived,
                b,
                j,
                route,
                shift,
                aim[0],
                longitudinal,
                own_body,
                other_half,
                heading,
                margin,
                bend,
                sight,
            )
            if leader[0] < FAR:
                leader_gap = judgement[0] * leader[0]
                if style[0] > 0.0:
                    leader_gap = wp.max(leader_gap + BACKS_TIME * wp.min(perceived.speed[b, j], 0.0), 0.0)
                react = follow(speed, wp.max(leader[1], 0.0), leader_gap, style)
                if (
                    style[0] > 0.0
                    and (flags == 3 or not looks_at_crossing(state, b, i))
                    and not walks
                    and heading[0] * c + heading[1] * s < ALIGNED
                    and wp.abs(perceived.speed[b, j]) > CROSSES
                ):
                    # it leaves the way again: what counts is when
                    crossing_react = react
                    react = 0.0
                else:
                    wp.atomic_min(work.leader, b, i, int(100.0 * wp.clamp(leader[0], 0.0, sight)) * LEADERS + j)
                if heading[0] * c + heading[1] * s > 0.7:
                    leads = 1
                contact_range = NOSE_TO_NOSE
                if state.control[b, i][3] > 0.5:
                    contact_range = MAKES_ROOM  # backs out already
                if (
                    stands
                    and leader[0] < contact_range
                    and wp.min(state.waited[b, i], perceived.waited[b, j]) > BACK_OUT
                ):
                    # The agent without priority makes room, or the other one if it has no room behind.
                    from_row = int(0)
                    to_row = agents
                    if i == 0 and perceived.believes[b] == 1:
                        from_row = agents
                        to_row = rows
                    if not has_priority(bank, roads, state, perceived, b, i, j, e, dt):
                        state.stalled[b, i] = 1
                    elif not room_behind(perceived, b, j, from_row, to_row):
                        state.stalled[b, i] = 1
                if (
                    style[0] > 0.0
                    and leads == 1
                    and leader[0] < CLOSED_UP
                    and wp.min(state.waited[b, i], perceived.waited[b, j]) > JAMMED
                    and perceived.way[b, j][1] < other_half[0] + 0.5
                ):
                    state.stalled[b, i] = 1  # makes room for a vehicle that may have to back out of the junction
                # a junction is entered only where there is room behind it
                required_room = roads.ahead[first][2] - offset - own_body[0] + 2.0 * own_body[0] + 2.0
                # a driver of the population does not brake hard for it
                late = style[0] > 0.0 and speed * speed > 3.0 * style[3] * (wp.max(line, 0.0) + 0.5)
                if (
                    line > -1.0
                    and leader[0] > line + 3.0
                    and leader[0] < required_room
                    and leader[1] < 1.5
                    and not late
                ):
                    if style[0] > 0.0:
                        react = wp.min(react, driver_yields(speed, wp.max(line, 0.0), style))
                    else:
                        react = wp.min(react, idm_gap(speed, 0.0, wp.max(line, 0.0) + 1.0))
        if flags >= 2 and leads == 0:
            if style[0] > 0.0:
                add_meeting(work, work.pair[slot] / 4, crossing_react)
            else:
                margin = 0.4
                if walks:
                    margin = 1.0
                gap = conflict_gap(
                    roads, perceived, b, j, route, shift, aim[0], speed, aim[1], own_body, other_half, margin
                )
                if gap < FAR:
                    goes_first = has_priority(bank, roads, state, perceived, b, i, j, e, dt)
                    goes_first = change_priority(perceived, b, i, j, goes_first)
                    if waits_at_line(bank, roads, state, perceived, b, i, j, e, goes_first, line, dt):
                        gap = wp.min(gap, wp.max(line, 0.0) + 1.0)
                    # a standing agent that has to wait is not expected to go
                    if not goes_first or (gap < 0.5 * speed and wp.abs(perceived.speed[b, j]) > STANDS):
                        react = wp.min(react, idm_gap(speed, 0.0, gap))
        if react < 0.0:
            wp.atomic_min(state.react, b, i, react)
        slot = slot + workers
