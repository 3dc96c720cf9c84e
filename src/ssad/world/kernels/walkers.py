"""Walkers of natural traffic: how they walk, wait and cross, and how vehicles yield to them.

A walker follows its route along pavements and crossings. At the kerb it waits for the signals of the traffic that it
crosses, and for vehicles: at a crosswalk until each of them has yielded, can stop comfortably, or leaves a gap; without
a crosswalk until the gap is long enough. The gap is the critical headway of the Highway Capacity Manual (2010, chapter
19): the time to cross, and a margin. Groups wait for their leader and cross with it.

An Autopilot stops before a crossing for walkers that are on it and in its path. Before a crosswalk and in a turn it
also stops for waiting walkers, if it can do so comfortably. It does not react to walkers on the pavement.
"""

import warp as wp

from ssad.core.types import AgentKind, Controller, SignalState
from ssad.world.kernels.belief import keeps_route
from ssad.world.kernels.data import (
    FAR,
    End,
    EpisodeArrays,
    PerceivedAgents,
    Presence,
    Roads,
    ScriptMotion,
    ScriptState,
    State,
    Walkers,
    WalkState,
    WalkStatus,
)
from ssad.world.kernels.lanes import is_changing_lane
from ssad.world.kernels.shared import route_at, row, signal_state, wrap
from ssad.world.kernels.traffic import stop_before

wp.set_module_options({"max_unroll": 0})  # see `traffic`

NO_SIGNAL = wp.constant(0)  # results of `crossing_signal`
CLOSED = wp.constant(1)
OPEN = wp.constant(2)
GAPS = wp.constant(3)  # forced green: a walker can only cross in a gap
SETS_OFF = wp.constant(0.7)  # s that a standing walker needs to start
SPEEDS_UP = wp.constant(1.0)  # m/s^2 of a walker
SLOWS = wp.constant(2.0)  # m/s^2 of a walker
NEAR_KERB = wp.constant(2.5)  # s before the kerb from which a walker looks at the road
ON_ROAD = wp.constant(0.15)  # m before the kerb beyond which walkers do not turn back
SEES = wp.constant(150.0)  # m of a vehicle's route, and around a crossing
POLITE = wp.constant(2.0)  # m/s^2: a vehicle that can stop with less is relied on to yield at a crosswalk
NOTICE = wp.constant(0.7)  # s that walkers expect a vehicle to take until it brakes
FORCED = wp.constant(3.0)  # m/s^2: walkers do not make a vehicle brake harder
EMERGENCY = wp.constant(4.5)  # m/s^2: crossing walkers let a vehicle pass that would have to brake harder
YIELDING = wp.constant(0.7)  # m/s^2 of braking by which a walker sees that a vehicle yields
GAINS = wp.constant(0.8)  # m/s^2 that a walker expects an approaching vehicle to gain
SIDE = wp.constant(0.85)  # m from the side of a vehicle to the middle of a walker that crosses beside it
BESIDE = wp.constant(3.5)  # m that a lane-changing vehicle may be beside its route
STANDS = wp.constant(0.5)  # m/s
IMPATIENCE = wp.constant(60.0)  # s of waiting after which the margin is a fourth
HURRY = wp.constant(1.5)  # times its speed, with which a walker gets out of the way
PICKS_UP = wp.constant(1.5)  # m/s^2 that a driver expects of itself
CLEARS = wp.constant(0.7)  # s between a walker and the next vehicle
PASSES = wp.constant(1.5)  # s between a vehicle and the next walker
SLOW_ENOUGH = wp.constant(1.5)  # m/s
FRONT = wp.constant(1.0)  # m of a crossing in front of a standing vehicle that are enough to walk past
TOUCHES = wp.constant(0.4)  # m from the side of a vehicle to a walker's middle, below which the vehicle does not move
COMFORT = wp.constant(2.0)  # m/s^2 with which a driver brakes for a waiting walker
LINE = wp.constant(0.3)  # m by which a driver stops nearer to a crossing than its gap at rest
NOSE = wp.constant(0.8)  # m on a crossing up to which a vehicle still waits there
SIDESTEP = wp.constant(0.4)  # m/s to the side
SQUEEZES = wp.constant(0.3)  # m/s of a walker that passes another one in a narrow place
LEANS = wp.constant(0.35)  # rad from its way that a walker turns at most
AIR = wp.constant(0.15)  # m between walkers that pass each other
LOOKS_AHEAD = wp.constant(5.0)  # m within which a walker makes way
STRAGGLES = wp.constant(2.5)  # m behind its place, beyond which a walker no longer crosses with its group


@wp.func
def red_left(bank: EpisodeArrays, roads: Roads, e: int, index: int, time: float) -> float:
    """Return the time for which a signal that shows red goes on to do so, s."""
    if bank.signal[e, index] >= 0 and time < bank.limits[e][3]:
        return bank.limits[e][3] - time
    program = roads.signal_program[roads.signal_first[bank.town[e]] + index]
    cycle_time = time - program[1]
    return program[0] - (cycle_time - program[0] * wp.floor(cycle_time / program[0]))


@wp.func
def crossing_signal(
    bank: EpisodeArrays,
    roads: Roads,
    walkers: Walkers,
    e: int,
    crossing: int,
    stage: wp.vec4,
    progress: float,
    depth: float,
    speed: float,
    time: float,
) -> int:
    """Return whether the signals of the traffic that is crossed let a walker go: OPEN, CLOSED, GAPS or NO_SIGNAL.

    It may go while all of them are red for as long as it needs to leave the lanes of their traffic. progress: m beyond
    the kerb (negative: before it); depth: m from it to the last one of its group.
    """
    rows = walkers.signals[crossing]
    form = walkers.form[crossing]
    answer = int(NO_SIGNAL)
    for entry in range(rows[0], rows[0] + rows[1]):
        index = walkers.signal[entry]
        now = signal_state(bank, roads, e, index, time)
        if now == SignalState.RED:
            part = walkers.part[entry]
            way = part[1] - form[1]
            if stage[3] < 0.0:
                way = form[2] - part[0]
            needed = SETS_OFF + (way - progress + depth) / speed - part[2]
            if red_left(bank, roads, e, index, time) < needed:
                answer = CLOSED
            elif answer == NO_SIGNAL:
                answer = OPEN
        elif now == SignalState.GREEN and bank.signal[e, index] >= 0 and bank.limits[e][3] - time > 1000.0:
            if answer != CLOSED:
                answer = GAPS
        elif now != SignalState.OFF:
            answer = CLOSED
    return answer


@wp.func
def vehicle_place(
    bank: EpisodeArrays, roads: Roads, state: State, walkers: Walkers, b: int, i: int, e: int, crossing: int
) -> wp.vec4:
    """Locate a vehicle before or on a crossing: m from front to near edge, m until the rear has left it, y, turn.

    FAR: it does not come there. turn: 1 if it turns just before. A vehicle that has left its route, or has none, goes
    straight on.
    """
    pose = state.pose[b, i]
    body = bank.body[bank.model[e, i]]
    route = bank.route[e, i]
    at = state.progress[b, i]
    place = wp.vec4(FAR, FAR, 0.0, 0.0)
    follows = route[1] > 1
    if follows:
        follows = keeps_route(roads, route, state.shift[b, i], at, pose)
    if follows:
        point = row(roads.path, route[0] + at)
        along = float(at) + (pose[0] - point[0]) * wp.cos(point[2]) + (pose[1] - point[1]) * wp.sin(point[2])
        entry = walkers.next_passing[route[0] + at]
        while entry >= 0:
            passing = walkers.passing[entry]
            numbers = walkers.passing_crossing[entry]
            near = passing[0] - along - body[0]
            rear = passing[1] - along + body[0]
            if near > SEES:
                entry = -1
            elif numbers[0] == crossing and rear > 0.0:
                place = wp.vec4(near, rear, passing[2], float(numbers[1]))
                entry = -1
            elif numbers[2] == 1:
                entry = entry + 1
            else:
                entry = -1
    else:
        line = walkers.crossing[crossing]
        form = walkers.form[crossing]
        dx = pose[0] - line[0]
        dy = pose[1] - line[1]
        y = dx * line[2] + dy * line[3]
        aside = dy * line[2] - dx * line[3]
        heading_y = wp.cos(pose[2]) * line[2] + wp.sin(pose[2]) * line[3]
        heading_aside = wp.sin(pose[2]) * line[2] - wp.cos(pose[2]) * line[3]
        half_aside = body[0] * wp.abs(heading_aside) + body[1] * wp.abs(heading_y) + form[0]
        if wp.abs(aside) < half_aside:
            place = wp.vec4(0.0, 2.0 * body[0], y, 0.0)
        elif wp.abs(heading_aside) > 0.3 and aside * heading_aside < 0.0:
            ahead = wp.abs(aside / heading_aside)
            half = body[0] + form[0] / wp.abs(heading_aside)
            place = wp.vec4(ahead - half, ahead + half, y + heading_y * ahead, 0.0)
        if place[2] < form[1] - 2.0 or place[2] > form[2] + 2.0:
            place = wp.vec4(FAR, FAR, 0.0, 0.0)
    return place


@wp.func
def arrival(distance: float, speed: float, gain: float) -> float:
    """Return the time in which a vehicle covers a distance if it gains `gain` m/s^2, s."""
    return (wp.sqrt(speed * speed + 2.0 * gain * wp.max(distance, 0.0)) - speed) / gain


@wp.func
def lets_cross(
    place: wp.vec4,
    speed: float,
    accel: float,
    waited: float,
    enters: float,
    leaves: float,
    walking_speed: float,
    start: float,
    margin: float,
    yields: int,
) -> bool:
    """Return whether a vehicle lets a walker enter the road.

    Args:
        place: See `vehicle_place`.
        speed: Speed of the vehicle, m/s.
        accel: Its acceleration, m/s^2.
        waited: Time for which it has stood, s.
        enters: Distance from the walker to the way of the vehicle, m.
        leaves: Distance until the walker, or the last one of its group, has left that way, m.
        walking_speed: Speed of the walker, m/s.
        start: Time until it starts, s.
        margin: Time that it wants between itself and the vehicle, s.
        yields: 1 if the vehicle has to yield to it.
    """
    if leaves <= 0.0 or place[1] >= FAR:
        return True
    entry_time = start + wp.max(enters, 0.0) / walking_speed
    exit_time = start + leaves / walking_speed
    if place[0] <= 0.3:
        return speed > 1.0 and place[1] / speed + 0.3 < entry_time
    if speed < STANDS:
        return yields == 1 or waited > 1.0
    if speed * speed > 2.0 * FORCED * wp.max(place[0] - 0.3, 0.0):
        # too fast to stop, and past before the walker arrives
        return place[1] / speed + PASSES + 0.5 < entry_time
    gap_time = arrival(place[0], speed, GAINS)
    if gap_time > exit_time + margin:
        return True
    if yields == 1:
        polite = speed * speed < 2.0 * POLITE * (place[0] - 0.5 - speed * NOTICE)
        slowing = accel < -YIELDING and speed * speed < -2.0 * accel * place[0]
        return polite or slowing
    return False


@wp.func
def is_free(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    walkers: Walkers,
    b: int,
    e: int,
    crossing: int,
    stage: wp.vec4,
    progress: float,
    depth: float,
    walking_speed: float,
    start: float,
    margin: float,
    has_right: int,
    agents: int,
) -> bool:
    """Return whether all vehicles let a walker enter the road; has_right: 1 they must yield, 2 turning ones must."""
    line = walkers.crossing[crossing]
    form = walkers.form[crossing]
    kerb = form[1]
    if stage[3] < 0.0:
        kerb = form[2]
    free = bool(True)
    for i in range(agents):
        kind = bank.kind[wp.max(bank.model[e, i], 0)]
        if free and state.active[b, i] != Presence.ABSENT and kind != AgentKind.WALKER and kind != AgentKind.PROP:
            pose = state.pose[b, i]
            dx = pose[0] - line[0]
            dy = pose[1] - line[1]
            if dx * dx + dy * dy < SEES * SEES:
                place = vehicle_place(bank, roads, state, walkers, b, i, e, crossing)
                if place[1] < FAR:
                    half = bank.body[bank.model[e, i]][1] + SIDE
                    if is_changing_lane(state.shift[b, i]):
                        half = half + BESIDE
                    way = stage[3] * (place[2] - kerb) - progress
                    stood = state.waited[b, i]
                    if state.active[b, i] == Presence.ASLEEP:
                        stood = FAR  # parked
                    yields = int(0)
                    if has_right == 1 or (has_right == 2 and place[3] == 1.0):
                        yields = 1
                    free = lets_cross(
                        place,
                        wp.max(state.speed[b, i], 0.0),
                        state.accel[b, i],
                        stood,
                        way - half,
                        way + half + depth,
                        walking_speed,
                        start,
                        margin,
                        yields,
                    )
    return free


@wp.func
def speed_on_road(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    walkers: Walkers,
    b: int,
    e: int,
    crossing: int,
    stage: wp.vec4,
    progress: float,
    speed: float,
    cruise: float,
    agents: int,
) -> float:
    """Return the speed that a walker on the road wants: it stops for a vehicle that does not, and hurries from it."""
    line = walkers.crossing[crossing]
    form = walkers.form[crossing]
    kerb = form[1]
    if stage[3] < 0.0:
        kerb = form[2]
    wish = cruise
    for i in range(agents):
        kind = bank.kind[wp.max(bank.model[e, i], 0)]
        if state.active[b, i] != Presence.ABSENT and kind != AgentKind.WALKER and kind != AgentKind.PROP:
            pose = state.pose[b, i]
            dx = pose[0] - line[0]
            dy = pose[1] - line[1]
            if dx * dx + dy * dy < 60.0 * 60.0:
                place = vehicle_place(bank, roads, state, walkers, b, i, e, crossing)
                half = bank.body[bank.model[e, i]][1] + SIDE
                way = stage[3] * (place[2] - kerb) - progress
                vehicle_speed = wp.max(state.speed[b, i], 0.0)
                if place[1] < FAR and way + half > 0.0:
                    coming = vehicle_speed * vehicle_speed > 2.0 * EMERGENCY * wp.max(place[0] - 0.2, 0.05)
                    if place[0] > 0.3 and vehicle_speed < 1.0:
                        coming = bool(False)
                    arrives = wp.max(place[0], 0.0) / wp.max(vehicle_speed, 0.5)
                    gone = place[1] / wp.max(vehicle_speed, 0.1)
                    if way - half > 0.0:
                        if coming and arrives < (way + half) / wp.max(speed, 0.5) + 0.5:
                            if gone + 0.2 > (way - half) / wp.max(speed, 0.5):
                                wish = wp.min(wish, wp.sqrt(2.0 * SLOWS * 0.7 * wp.max(way - half - 0.1, 0.0)))
                    elif coming and place[0] > 0.3 and arrives < (way + half) / wp.max(speed, 0.5) + 1.0:
                        wish = wp.max(wish, HURRY * cruise)
    return wish


@wp.func
def make_way(
    bank: EpisodeArrays,
    state: State,
    walkers: Walkers,
    walk: WalkState,
    b: int,
    j: int,
    e: int,
    way_yaw: float,
    left: float,
    room: float,
    wish: float,
    agents: int,
) -> wp.vec2:
    """Return the place left of its way to which a walker goes, m, and the speed that bodies ahead leave to it, m/s.

    Two that meet pass on the right; whoever is slower is passed where there is room, or followed. Walkers do not stop
    for each other for ever: where there is no room they squeeze past.
    """
    pose = state.pose[b, j]
    cosine = wp.cos(way_yaw)
    sine = wp.sin(way_yaw)
    own_half = bank.body[bank.model[e, j]]
    style = walkers.style[e, j]
    edges = wp.vec2(-room - style[2], room - style[2])
    low = edges[0]
    high = edges[1]
    limit = wish
    for other in range(agents):
        if other != j and state.active[b, other] != Presence.ABSENT:
            other_pose = state.pose[b, other]
            dx = other_pose[0] - pose[0]
            dy = other_pose[1] - pose[1]
            body = bank.body[bank.model[e, other]]
            reach = LOOKS_AHEAD + body[0]
            if dx * dx + dy * dy < reach * reach:
                ahead = dx * cosine + dy * sine
                beside = dy * cosine - dx * sine
                facing = wp.cos(other_pose[2] - way_yaw)
                across = wp.abs(wp.sin(other_pose[2] - way_yaw))
                half_along = body[0] * wp.abs(facing) + body[1] * across
                half_across = body[0] * across + body[1] * wp.abs(facing)
                gap = ahead - half_along - own_half[0]
                width = half_across + own_half[1]
                other_speed = state.speed[b, other] * facing
                is_walker = bank.kind[bank.model[e, other]] == AgentKind.WALKER
                in_group = walkers.leader[e, other] == walkers.leader[e, j]
                if not is_walker:
                    width = width + 0.1
                reach_across = width + AIR
                crosses = is_walker and across > 0.8 and wp.abs(state.speed[b, other]) > 0.2
                is_beside = gap < 0.0 and ahead > -half_along - own_half[0] - 0.1
                is_slower = ahead > 0.0 and wish - other_speed > 0.1
                if (is_beside or (is_slower and not in_group)) and not crosses:
                    # right of a walker that is not clearly on the right; left of it if there is no room
                    left_of_it = beside < -0.05
                    if wp.abs(beside) < width:
                        if left_of_it and left + beside + reach_across > edges[1]:
                            left_of_it = bool(False)
                        elif not left_of_it and left + beside - reach_across < edges[0]:
                            left_of_it = left + beside + reach_across <= edges[1]
                    if left_of_it:
                        low = wp.max(low, left + beside + reach_across)
                    else:
                        high = wp.min(high, left + beside - reach_across)
                if ahead > 0.0:
                    is_blocked = wp.abs(beside) < width - 0.02
                    if is_blocked and is_walker:
                        least = wp.min(wish, SQUEEZES)
                        if walk.status[b, other] == WalkStatus.WAITING or walk.status[b, other] == WalkStatus.READY:
                            least = 0.0  # it stands at the kerb, and others that cross wait behind it
                        if facing < -0.3:
                            if gap < 1.5:
                                limit = wp.min(limit, wp.max(0.5 * wish, wp.min(wish, SQUEEZES)))
                        elif crosses:
                            if j > other and gap < 1.0:
                                limit = wp.min(limit, wp.max(gap - 0.1, least))
                        else:
                            follows = wp.max(other_speed, 0.0) + 0.8 * wp.max(gap - 0.1, 0.0)
                            limit = wp.min(limit, wp.max(follows, least))
                    elif is_blocked:
                        least = float(0.0)
                        if wp.abs(beside) > half_across and wp.abs(state.speed[b, other]) < 0.2:
                            least = wp.min(wish, SQUEEZES)  # along the side of a vehicle that stands
                        limit = wp.min(limit, wp.max(wp.sqrt(SLOWS * wp.max(gap - 0.4, 0.0)), least))
    place = wp.clamp(0.0, low, high)
    if low > high:
        place = 0.5 * (low + high)
    return wp.vec2(wp.clamp(place, edges[0], edges[1]), limit)


@wp.func
def walk_one(
    bank: EpisodeArrays,
    roads: Roads,
    walkers: Walkers,
    state: State,
    script: ScriptState,
    walk: WalkState,
    b: int,
    j: int,
    agents: int,
    dt: float,
):
    """Decide the motion of a walker in this step."""
    e = state.episode[b]
    route = bank.route[e, j]
    pose = state.pose[b, j]
    if state.controller[b, j] != Controller.SCRIPT:
        # another driver has it now; it would go on from where that one leaves it
        point = row(roads.path, route[0] + state.progress[b, j])
        dx = pose[0] - point[0]
        dy = pose[1] - point[1]
        walk.rail[b, j] = wp.vec2(
            float(state.progress[b, j]) + dx * wp.cos(point[2]) + dy * wp.sin(point[2]),
            dy * wp.cos(point[2]) - dx * wp.sin(point[2]),
        )
        walk.status[b, j] = WalkStatus.PAVEMENT
        walk.crossing[b, j] = 0
        return
    style = walkers.style[e, j]
    rail = walk.rail[b, j]
    speed = state.speed[b, j]
    cruise = state.cruise[b, j]
    time = float(state.step[b]) * dt
    leader = walkers.leader[e, j]
    leads = leader == j or state.active[b, leader] == Presence.ABSENT
    stages = walkers.stages[e, j]
    stage_number = walk.stage[b, j]
    status = int(WalkStatus.PAVEMENT)
    crossing = int(0)
    wish = cruise
    room = style[1]
    behind = float(0.0)
    if not leads:
        behind = walk.rail[b, leader][0] - style[3] - rail[0]
        leader_stages = walkers.stages[e, leader]
        if walk.stage[b, leader] == stage_number and stage_number < wp.min(stages[1], leader_stages[1]):
            own_way = walkers.stage[stages[0] + stage_number][0] - rail[0]
            behind = own_way - (walkers.stage[leader_stages[0] + stage_number][0] - walk.rail[b, leader][0]) - style[3]
        wish = cruise * wp.clamp(1.0 + 0.3 * behind, 0.6, 1.25)
    if stage_number < stages[1]:
        stage = walkers.stage[stages[0] + stage_number]
        if rail[0] > stage[2] + ON_ROAD:
            walk.stage[b, j] = stage_number + 1
            walk.waited[b, j] = 0.0
            walk.yielded[b, j] = 0
        else:
            number = walkers.stage_crossing[stages[0] + stage_number]
            progress = rail[0] - stage[1]
            to_wait = stage[0] - rail[0]
            if not leads:
                to_wait = to_wait - style[3]
            if progress > -ON_ROAD:
                status = WalkStatus.CROSSING
                crossing = number + 1
                room = wp.max(walkers.form[number][0] - 0.4, style[1])
                wish = speed_on_road(bank, roads, state, walkers, b, e, number, stage, progress, speed, wish, agents)
            elif to_wait < NEAR_KERB * cruise:
                crossing = number + 1
                status = WalkStatus.WAITING
                goes = bool(False)
                follows = not leads and behind < STRAGGLES
                depth = float(0.0)
                margin = style[0] * wp.clamp(1.0 - walk.waited[b, j] / IMPATIENCE, 0.25, 1.0)
                if leads:
                    depth = walkers.depth[e, j]
                may_go = bool(True)
                if follows:
                    # it goes when its leader has gone
                    may_go = walk.stage[b, leader] > stage_number or walk.status[b, leader] == WalkStatus.CROSSING
                    margin = 0.0
                start = float(0.0)
                if speed < 0.3:
                    start = SETS_OFF
                has_right = int(0)
                if walkers.form[number][3] > 0.5:
                    has_right = 1
                else:
                    has_right = 2
                if may_go:
                    signal = int(NO_SIGNAL)
                    if not follows:
                        signal = crossing_signal(bank, roads, walkers, e, number, stage, progress, depth, cruise, time)
                    if signal == GAPS:
                        has_right = 0
                    if signal != CLOSED:
                        if has_right > 0:
                            status = WalkStatus.READY
                        goes = is_free(
                            bank,
                            roads,
                            state,
                            walkers,
                            b,
                            e,
                            number,
                            stage,
                            progress,
                            depth,
                            cruise,
                            start,
                            margin,
                            has_right,
                            agents,
                        )
                if goes:
                    if to_wait < 0.5 * cruise:
                        status = WalkStatus.CROSSING
                else:
                    wish = wp.min(wish, wp.sqrt(2.0 * SPEEDS_UP * wp.max(to_wait, 0.0)))
                if speed < 0.3 and not goes:
                    walk.waited[b, j] = walk.waited[b, j] + dt
    walk.status[b, j] = status
    walk.crossing[b, j] = crossing
    here = route_at(roads, route[0], route[1], rail[0])
    way = make_way(bank, state, walkers, walk, b, j, e, here[2], rail[1], room, wish, agents)
    new_speed = wp.max(speed + wp.clamp(way[1] - speed, -SLOWS * dt, SPEEDS_UP * dt), 0.0)
    length = 0.5 * (speed + new_speed) * dt
    sidestep = float(0.0)
    if wish > 0.05:
        greatest = wp.min(SIDESTEP, LEANS * wp.max(speed, 0.4)) * dt
        sidestep = wp.clamp(way[0] - rail[1], -greatest, greatest)
    last = float(route[1] - 1)
    place = wp.min(rail[0] + length, last)
    if place >= last:
        new_speed = 0.0
    left = rail[1] + sidestep
    walk.rail[b, j] = wp.vec2(place, left)
    way_pose = route_at(roads, route[0], route[1], place)
    heading = pose[2]
    if length > 0.02:
        heading = way_pose[2] + wp.clamp(wp.atan2(sidestep, length), -LEANS, LEANS)
    script.goal[b, j] = wp.vec4(
        way_pose[0] - left * wp.sin(way_pose[2]),
        way_pose[1] + left * wp.cos(way_pose[2]),
        wrap(heading),
        new_speed,
    )
    # for displays and mirrors of the walker; here it moves by its goal
    top = bank.power[bank.model[e, j]][2]
    state.control[b, j] = wp.vec4(new_speed / wp.max(top, 0.1), 0.0, 0.0, 0.0)


@wp.kernel(enable_backward=False)
def walk_all(
    bank: EpisodeArrays,
    roads: Roads,
    walkers: Walkers,
    state: State,
    script: ScriptState,
    walk: WalkState,
    agents: int,
    dt: float,
):
    """Decide the motion of all walkers of natural traffic; one thread per scene."""
    b = wp.tid()
    if state.end[b] != End.RUNNING:
        return
    e = state.episode[b]
    rows = walkers.agents[e]
    for j in range(rows[0], rows[1]):
        if bank.script[e, j][3] == ScriptMotion.WALK and state.active[b, j] == Presence.AWAKE:
            walk_one(bank, roads, walkers, state, script, walk, b, j, agents, dt)


@wp.func
def yield_one(
    bank: EpisodeArrays,
    roads: Roads,
    walkers: Walkers,
    state: State,
    perceived: PerceivedAgents,
    walk: WalkState,
    b: int,
    i: int,
):
    """Add to an Autopilot's reaction what walkers at the crossings ahead demand of it."""
    if state.active[b, i] != Presence.AWAKE or state.controller[b, i] != Controller.AUTOPILOT:
        return
    e = state.episode[b]
    route = bank.route[e, i]
    if route[1] < 2 or (i == 0 and perceived.believes[b] == 1):
        return
    entry = walkers.next_passing[route[0] + state.progress[b, i]]
    if entry < 0:
        return
    speed = wp.max(state.speed[b, i], 0.0)
    aim = state.aim[b, i]
    body = bank.body[bank.model[e, i]]
    style = bank.style[e, i]
    rows = walkers.agents[e]
    comfort = float(COMFORT)
    if style[0] > 0.0:
        comfort = style[3]
    if state.accel[b, i] < -0.5:
        comfort = 1.5 * comfort  # a driver that brakes already goes on to do so
    half = body[1] + SIDE
    if is_changing_lane(state.shift[b, i]):
        half = half + BESIDE
    reach = 8.0 + speed + speed * speed / 2.0
    react = float(0.0)
    while entry >= 0:
        passing = walkers.passing[entry]
        numbers = walkers.passing_crossing[entry]
        near = passing[0] - aim[0] - body[0]
        rear = passing[1] - aim[0] + body[0]
        if near < reach and rear > 0.0:
            form = walkers.form[numbers[0]]
            for j in range(rows[0], rows[1]):
                if walk.crossing[b, j] == numbers[0] + 1 and walk.status[b, j] >= WalkStatus.READY:
                    stage = walkers.stage[walkers.stages[e, j][0] + walk.stage[b, j]]
                    kerb = form[1]
                    if stage[3] < 0.0:
                        kerb = form[2]
                    way = stage[3] * (passing[2] - kerb) - (walk.rail[b, j][0] - stage[1])
                    walking_speed = wp.max(state.cruise[b, j], 0.5)
                    exit_time = (way + half) / walking_speed
                    if state.speed[b, j] < 0.3:
                        exit_time = exit_time + SETS_OFF
                    entry_time = (way - half) / walking_speed
                    pick_up = float(PICKS_UP)
                    if speed > aim[1] - 0.5:
                        pick_up = 0.1
                    if (
                        way + half > 0.0
                        and exit_time + CLEARS > arrival(near, speed, pick_up)
                        and entry_time - PASSES < arrival(rear, speed, pick_up)
                    ):
                        stops = bool(False)
                        if walk.status[b, j] == WalkStatus.CROSSING:
                            # a vehicle on the crossing leaves it, unless a walker is about to pass its front
                            stops = near > -NOSE or way - body[1] < TOUCHES
                            if not stops and speed < SLOW_ENOUGH:
                                stops = rear - 2.0 * body[0] > FRONT
                            # a driver that cannot stop goes on if it is past before the walker arrives
                            if speed * speed > 2.0 * FORCED * wp.max(near, 0.1) and speed > SLOW_ENOUGH:
                                if entry_time > rear / speed + 0.3:
                                    stops = bool(False)
                        elif form[3] > 0.5 or numbers[1] == 1:
                            stops = near > 0.3 and speed * speed < 2.0 * comfort * wp.max(near - 0.5, 0.1)
                        if stops:
                            walk.yielded[b, j] = 1
                            react = wp.min(react, stop_before(speed, wp.max(near, 0.0) + LINE, style))
        entry = entry + 1
        if numbers[2] == 0 or near > reach:
            entry = -1
    if react < 0.0:
        state.react[b, i] = wp.min(state.react[b, i], react)


@wp.kernel(enable_backward=False)
def yield_to_walkers(
    bank: EpisodeArrays,
    roads: Roads,
    walkers: Walkers,
    state: State,
    perceived: PerceivedAgents,
    walk: WalkState,
    agents: int,
    threads: int,
):
    """Add to the reactions of all Autopilots what walkers demand; runs after `scan_all_agents`."""
    b, first = wp.tid()
    if state.end[b] == End.RUNNING:
        for i in range(first, agents, threads):
            yield_one(bank, roads, walkers, state, perceived, walk, b, i)


@wp.kernel(enable_backward=False)
def restart_walks(
    bank: EpisodeArrays,
    roads: Roads,
    walkers: Walkers,
    state: State,
    walk: WalkState,
    mask: wp.array(dtype=wp.int32),
    ended_too: int,
    agents: int,
):
    """Reset the walkers of scenes; runs before `restart_record`, which clears the reason of the end."""
    b = wp.tid()
    restarts = mask[b] == 1
    if ended_too == 1 and state.end[b] != End.RUNNING:
        restarts = True
    if not restarts:
        return
    e = state.episode[b]
    for j in range(agents):
        rail = wp.vec2(0.0, 0.0)
        route = bank.route[e, j]
        if bank.script[e, j][3] == ScriptMotion.WALK and route[1] > 1:
            start = bank.start[e, j]
            min_distance2 = float(1.0e12)
            for candidate in range(wp.min(13, route[1])):
                point = row(roads.path, route[0] + candidate)
                dx = start[0] - point[0]
                dy = start[1] - point[1]
                if dx * dx + dy * dy < min_distance2:
                    min_distance2 = dx * dx + dy * dy
                    along = dx * wp.cos(point[2]) + dy * wp.sin(point[2])
                    rail = wp.vec2(float(candidate) + along, dy * wp.cos(point[2]) - dx * wp.sin(point[2]))
        walk.rail[b, j] = rail
        walk.stage[b, j] = 0
        walk.status[b, j] = WalkStatus.PAVEMENT
        walk.crossing[b, j] = 0
        walk.waited[b, j] = 0.0
        walk.yielded[b, j] = 0
