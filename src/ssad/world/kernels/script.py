"""Scripted agents: conditions that start their phases, speed profiles, lateral profiles and meetings.

One thread handles all agents of a scene, so that a phase that begins is seen by every condition of the same step.
Speeds follow the profile of the phase, not the throttle: what a scenario states is what drives.
"""

import warp as wp

from ssad.core.types import AgentKind, Controller
from ssad.world.kernels.data import (
    FAR,
    Edge,
    End,
    EpisodeArrays,
    Measure,
    PhaseCondition,
    Presence,
    Roads,
    ScriptMotion,
    Scripts,
    ScriptState,
    SpeedProfile,
    SpeedShape,
    State,
)
from ssad.world.kernels.drive import steer_on_route
from ssad.world.kernels.shared import boxes_touch, route_at, route_frame, row, wrap

wp.set_module_options({"max_unroll": 0})  # see `traffic`

AT_REST = wp.constant(0.05)  # m/s
CLOSING = wp.constant(1.0e-3)  # m/s; below, nobody comes closer
ON_TIME = wp.constant(1.0e-4)  # s by which rounding may delay a time
SIDESTEP = wp.constant(0.7)  # greatest share of its speed that a vehicle moves sideways
ROUNDING = wp.constant(1.0e-4)  # m/s
SEARCH = wp.constant(8)  # corrections of a place along a route
PI = wp.constant(3.141592653589793)


@wp.func
def along_own_route(bank: EpisodeArrays, roads: Roads, state: State, scene: int, agent: int) -> float:
    """Return the place of an agent along its route, m."""
    route = bank.route[state.episode[scene], agent]
    at = state.progress[scene, agent]
    point = row(roads.path, route[0] + at)
    pose = state.pose[scene, agent]
    return float(at) + wp.cos(point[2]) * (pose[0] - point[0]) + wp.sin(point[2]) * (pose[1] - point[1])


@wp.func
def place_on_route(
    bank: EpisodeArrays, roads: Roads, state: State, scene: int, agent: int, x: float, y: float, sign: float
) -> wp.vec2:
    """Return how far ahead of an agent along its route a point is, times `sign`, and how far left of it, m."""
    route = bank.route[state.episode[scene], agent]
    pose = state.pose[scene, agent]
    own = along_own_route(bank, roads, state, scene, agent)
    frame = route_frame(roads, route[0], route[1], own)
    ahead = (x - pose[0]) * frame[2] + (y - pose[1]) * frame[3]
    lateral = float(0.0)
    for _ in range(SEARCH):
        place = own + ahead
        frame = route_frame(roads, route[0], route[1], place)
        # before its start and beyond its end a route goes straight on
        before_start = wp.min(place, 0.0)
        dx = x - frame[0] - before_start * frame[2]
        dy = y - frame[1] - before_start * frame[3]
        residual = dx * frame[2] + dy * frame[3]
        lateral = dy * frame[2] - dx * frame[3]
        if wp.abs(residual) < 1.0e-3:
            break
        ahead = ahead + residual
    own_frame = route_frame(roads, route[0], route[1], own)
    own_before = wp.min(own, 0.0)
    own_lateral = (pose[1] - own_frame[1] - own_before * own_frame[3]) * own_frame[2] - (
        pose[0] - own_frame[0] - own_before * own_frame[2]
    ) * own_frame[3]
    return wp.vec2(sign * ahead, sign * (lateral - own_lateral))


@wp.func
def ahead_and_left(
    bank: EpisodeArrays, roads: Roads, state: State, scene: int, agent: int, other: int, x: float, y: float
) -> wp.vec2:
    """Return how far ahead of an agent along the road a point is, and how far left, m; `other` stands there."""
    episode = state.episode[scene]
    pose = state.pose[scene, agent]
    dx = x - pose[0]
    dy = y - pose[1]
    result = wp.vec2(
        dx * wp.cos(pose[2]) + dy * wp.sin(pose[2]),
        dy * wp.cos(pose[2]) - dx * wp.sin(pose[2]),
    )
    if bank.route[episode, agent][1] > 1:
        result = place_on_route(bank, roads, state, scene, agent, x, y, 1.0)
    elif other >= 0:
        if bank.route[episode, other][1] > 1:
            result = place_on_route(bank, roads, state, scene, other, pose[0], pose[1], -1.0)
    return result


@wp.func
def point_to_box(x: float, y: float, pose: wp.vec3, half_length: float, half_width: float) -> float:
    """Return the distance of a point from a box, m; 0 inside."""
    cosine = wp.cos(pose[2])
    sine = wp.sin(pose[2])
    dx = x - pose[0]
    dy = y - pose[1]
    outside_x = wp.max(wp.abs(cosine * dx + sine * dy) - half_length, 0.0)
    outside_y = wp.max(wp.abs(cosine * dy - sine * dx) - half_width, 0.0)
    return wp.sqrt(outside_x * outside_x + outside_y * outside_y)


@wp.func
def corners_to_box(p: wp.vec3, pl: float, pw: float, q: wp.vec3, ql: float, qw: float) -> float:
    """Return the smallest distance of the corners of box p from box q, m."""
    cosine = wp.cos(p[2])
    sine = wp.sin(p[2])
    distance = float(FAR)
    for corner in range(4):
        forward = pl
        left = pw
        if corner % 2 == 1:
            forward = -pl
        if corner >= 2:
            left = -pw
        x = p[0] + cosine * forward - sine * left
        y = p[1] + sine * forward + cosine * left
        distance = wp.min(distance, point_to_box(x, y, q, ql, qw))
    return distance


@wp.func
def half_extent(yaw: float, body: wp.vec4, across: bool) -> float:
    """Return half the extent of a body turned by `yaw`, along an axis or across it, m."""
    cosine = wp.abs(wp.cos(yaw))
    sine = wp.abs(wp.sin(yaw))
    extent = cosine * body[0] + sine * body[1]
    if across:
        extent = sine * body[0] + cosine * body[1]
    return extent


@wp.func
def distance_and_closing(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    scene: int,
    agent: int,
    other: int,
    form: wp.vec4i,
    x: float,
    y: float,
) -> wp.vec2:
    """Return the distance of an agent from another one (-1: from the point x, y), and the speed at which it falls."""
    episode = state.episode[scene]
    pose = state.pose[scene, agent]
    speed = state.speed[scene, agent]
    velocity = wp.vec2(speed * wp.cos(pose[2]), speed * wp.sin(pose[2]))
    body = bank.body[bank.model[episode, agent]]
    point_x = x
    point_y = y
    other_velocity = wp.vec2(0.0, 0.0)
    other_pose = wp.vec3(x, y, pose[2])
    other_body = wp.vec4(0.0, 0.0, 0.0, 0.0)
    if other >= 0:
        other_pose = state.pose[scene, other]
        other_speed = state.speed[scene, other]
        point_x = other_pose[0]
        point_y = other_pose[1]
        other_velocity = wp.vec2(other_speed * wp.cos(other_pose[2]), other_speed * wp.sin(other_pose[2]))
        other_body = bank.body[bank.model[episode, other]]
    dx = point_x - pose[0]
    dy = point_y - pose[1]
    distance = float(0.0)
    closing = float(0.0)
    if form[3] == Measure.STRAIGHT:
        distance = wp.sqrt(dx * dx + dy * dy)
        if distance > 1.0e-6:
            closing = (dx * (velocity[0] - other_velocity[0]) + dy * (velocity[1] - other_velocity[1])) / distance
        if form[2] == 1:
            if other < 0:
                distance = point_to_box(x, y, pose, body[0], body[1])
            elif boxes_touch(pose, body[0], body[1], other_pose, other_body[0], other_body[1]):
                distance = 0.0
            else:
                distance = wp.min(
                    corners_to_box(pose, body[0], body[1], other_pose, other_body[0], other_body[1]),
                    corners_to_box(other_pose, other_body[0], other_body[1], pose, body[0], body[1]),
                )
    else:
        place = ahead_and_left(bank, roads, state, scene, agent, other, point_x, point_y)
        turn = other_pose[2] - pose[2]
        signed = place[0]
        closing = speed - (other_velocity[0] * wp.cos(pose[2]) + other_velocity[1] * wp.sin(pose[2]))
        across = form[3] == Measure.LATERAL
        if across:
            signed = place[1]
            closing = other_velocity[0] * wp.sin(pose[2]) - other_velocity[1] * wp.cos(pose[2])
        distance = wp.abs(signed)
        if signed < 0.0:
            closing = -closing
        if form[2] == 1:
            own = body[0]
            if across:
                own = body[1]
            distance = wp.max(distance - own - half_extent(turn, other_body, across), 0.0)
    return wp.vec2(distance, closing)


@wp.func
def is_past(value: float, threshold: float, above: int) -> bool:
    """Return whether a value is above a threshold, or below it."""
    result = value < threshold
    if above == 1:
        result = value > threshold
    return result


@wp.func
def condition_value(
    bank: EpisodeArrays,
    roads: Roads,
    scripts: Scripts,
    state: State,
    script: ScriptState,
    scene: int,
    condition: int,
    dt: float,
) -> bool:
    """Return whether a condition holds now, apart from its edge and delay."""
    who = scripts.condition[condition]
    form = scripts.form[condition]
    number = scripts.number[condition]
    kind = who[0]
    agent = who[1]
    other = who[2]
    step = state.step[scene]
    holds = kind == PhaseCondition.ALWAYS
    if kind == PhaseCondition.TIME:
        holds = float(step) * dt >= number[0] - ON_TIME
        if form[0] == 0:
            holds = not holds
    elif kind == PhaseCondition.AFTER:
        began = int(1)
        before = who[3]
        if before >= 0:
            began = script.begun[scene, before]
        if began > 0:
            holds = float(step + 1 - began) * dt >= number[0] - ON_TIME
            if form[0] == 0:
                holds = not holds
    elif kind == PhaseCondition.PHASE_START:
        began = script.begun[scene, who[3]]
        holds = began > 0 and began <= step + 1
    elif kind == PhaseCondition.PHASE_END:
        ended = script.ended[scene, who[3]]
        holds = ended > 0 and ended <= step + 1
    elif kind == PhaseCondition.EGO_DISTANCE:
        distance = distance_and_closing(bank, roads, state, scene, agent, other, form, 0.0, 0.0)
        holds = is_past(distance[0], number[0], form[0])
    elif kind == PhaseCondition.EGO_SPEED:
        holds = is_past(state.speed[scene, 0], number[0], form[0])
    elif kind == PhaseCondition.TRAVELLED:
        holds = is_past(state.travelled[scene, agent], number[0], form[0])
    elif kind != PhaseCondition.ALWAYS and state.active[scene, agent] != Presence.ABSENT:
        present = int(1)
        if other >= 0:
            if state.active[scene, other] == Presence.ABSENT:
                present = 0
        if present == 1:
            speed = wp.abs(state.speed[scene, agent])
            if kind == PhaseCondition.SPEED:
                holds = is_past(speed, number[0], form[0])
            elif kind == PhaseCondition.RELATIVE_SPEED:
                holds = is_past(speed - wp.abs(state.speed[scene, other]), number[0], form[0])
            elif kind == PhaseCondition.ACCELERATION:
                holds = is_past(state.accel[scene, agent], number[0], form[0])
            elif kind == PhaseCondition.STANDSTILL:
                if speed <= AT_REST:
                    # `remember` notes the step at which the agent was last found moving
                    rest = float(step - script.history[scene, scripts.ring[condition][0]]) * dt
                    holds = rest >= number[0] - ON_TIME
            else:
                measured = distance_and_closing(bank, roads, state, scene, agent, other, form, number[1], number[2])
                quantity = measured[0]
                if kind == PhaseCondition.TIME_TO_COLLISION:
                    quantity = FAR
                    if measured[1] > CLOSING:
                        quantity = measured[0] / measured[1]
                elif kind == PhaseCondition.TIME_HEADWAY:
                    quantity = FAR
                    if speed > CLOSING:
                        quantity = measured[0] / speed
                holds = is_past(quantity, number[0], form[0])
    return holds


@wp.func
def history_bit(scripts: Scripts, script: ScriptState, scene: int, condition: int, step: int) -> int:
    """Return the value of a condition in a step; 0 before the first one."""
    bit = int(0)
    if step >= 0:
        ring = scripts.ring[condition]
        word = ring[0]
        if scripts.condition[condition][0] == PhaseCondition.STANDSTILL:
            word = word + 1
        place = step % ring[1]
        bit = (script.history[scene, word + place // 32] >> (place % 32)) & 1
    return bit


@wp.func
def remember(
    bank: EpisodeArrays,
    roads: Roads,
    scripts: Scripts,
    state: State,
    script: ScriptState,
    scene: int,
    condition: int,
    dt: float,
):
    """Note the present value of a condition whose edge or delay counts."""
    step = state.step[scene]
    ring = scripts.ring[condition]
    who = scripts.condition[condition]
    word = ring[0]
    if who[0] == PhaseCondition.STANDSTILL:
        if wp.abs(state.speed[scene, who[1]]) > AT_REST:
            script.history[scene, word] = step + 1
        word = word + 1
    if ring[1] > 0:
        place = step % ring[1]
        mask = 1 << (place % 32)
        bits = script.history[scene, word + place // 32] & (~mask)
        if condition_value(bank, roads, scripts, state, script, scene, condition, dt):
            bits = bits | mask
        script.history[scene, word + place // 32] = bits


@wp.func
def condition_holds(
    bank: EpisodeArrays,
    roads: Roads,
    scripts: Scripts,
    state: State,
    script: ScriptState,
    scene: int,
    condition: int,
    dt: float,
) -> bool:
    """Return whether a condition holds, with its edge and delay."""
    ring = scripts.ring[condition]
    holds = False
    if ring[1] == 0:
        holds = condition_value(bank, roads, scripts, state, script, scene, condition, dt)
    else:
        step = state.step[scene] - ring[2]
        if step >= 0:
            now = history_bit(scripts, script, scene, condition, step)
            edge = scripts.form[condition][1]
            if edge == Edge.NONE:
                holds = now == 1
            elif step >= 1:
                before = history_bit(scripts, script, scene, condition, step - 1)
                rises = now == 1 and before == 0
                falls = now == 0 and before == 1
                holds = (rises and edge != Edge.FALLING) or (falls and edge != Edge.RISING)
    return holds


@wp.func
def may_begin(
    bank: EpisodeArrays,
    roads: Roads,
    scripts: Scripts,
    state: State,
    script: ScriptState,
    scene: int,
    phase: int,
    dt: float,
) -> bool:
    """Return whether all conditions of one of the groups of a phase hold."""
    begin = scripts.begin[phase]
    any_holds = int(0)
    for g in range(begin[0], begin[0] + begin[1]):
        if any_holds == 0:
            group = scripts.group[g]
            all_hold = int(1)
            for condition in range(group[0], group[0] + group[1]):
                if all_hold == 1:
                    if not condition_holds(bank, roads, scripts, state, script, scene, condition, dt):
                        all_hold = 0
            any_holds = all_hold
    return any_holds == 1


@wp.func
def ease(shape: int, share: float) -> float:
    """Return the part of a change that is done after a share of its time (or length)."""
    part = wp.clamp(share, 0.0, 1.0)
    done = part
    if shape == SpeedShape.SINUSOIDAL:
        done = 0.5 * (1.0 - wp.cos(PI * part))
    elif shape == SpeedShape.CUBIC:
        done = part * part * (3.0 - 2.0 * part)
    return done


@wp.func
def ease_slope(shape: int, share: float) -> float:
    """Return the derivative of `ease`."""
    part = wp.clamp(share, 0.0, 1.0)
    slope = float(1.0)
    if shape == SpeedShape.SINUSOIDAL:
        slope = 0.5 * PI * wp.sin(PI * part)
    elif shape == SpeedShape.CUBIC:
        slope = 6.0 * part * (1.0 - part)
    return slope


@wp.func
def steepest(shape: int) -> float:
    """Return the greatest derivative of `ease`."""
    slope = float(1.0)
    if shape == SpeedShape.SINUSOIDAL:
        slope = 0.5 * PI
    elif shape == SpeedShape.CUBIC:
        slope = 1.5
    return slope


@wp.func
def target_of(state: State, scene: int, motion: wp.vec4, course: wp.vec4i) -> float:
    """Return the target speed of a phase now, m/s."""
    target = motion[0]
    if course[2] >= 0:
        other = wp.abs(state.speed[scene, course[2]])
        if (course[3] & 1) == 1:
            target = motion[0] * other
        else:
            target = motion[0] + other
    return wp.max(target, 0.0)


@wp.func
def target_left(scripts: Scripts, first: int, count: int, u: float) -> float:
    """Return the distance left of the route to which a lateral phase leads, `u` metres along it."""
    position = wp.clamp(u, 0.0, float(count - 1))
    index = wp.max(wp.min(int(position), count - 2), 0)
    fraction = position - float(index)
    start = scripts.target[first + index]
    end = scripts.target[first + wp.min(index + 1, count - 1)]
    return start + fraction * (end - start)


@wp.func
def begin_phase(scripts: Scripts, state: State, script: ScriptState, scene: int, agent: int, phase: int, number: int):
    """Begin a phase: note the speed that it starts from, its target, and how long it takes."""
    first = scripts.episode[state.episode[scene]][0]
    motion = scripts.motion[first + phase]
    course = scripts.course[first + phase]
    running = script.running[scene, agent]
    script.running[scene, agent] = wp.vec2i(number + 1, running[1])
    state.phase[scene, agent] = state.phase[scene, agent] + 1
    speed = state.speed[scene, agent]
    acceleration = script.course[scene, agent][3]
    target = speed
    duration = float(0.0)
    if course[0] != SpeedProfile.ARRIVAL:
        target = target_of(state, scene, motion, course)
    if course[0] == SpeedProfile.STEP:
        state.speed[scene, agent] = target
        speed = target
        acceleration = 0.0
    elif course[0] == SpeedProfile.DURATION:
        duration = motion[3]
    elif course[0] == SpeedProfile.DISTANCE:
        duration = 2.0 * motion[3] / wp.max(speed + target, 0.01)
    elif course[0] == SpeedProfile.RATE:
        duration = steepest(course[1]) * wp.abs(target - speed) / motion[3]
    script.course[scene, agent] = wp.vec4(speed, target, duration, acceleration)


@wp.func
def begin_swerve(scripts: Scripts, state: State, script: ScriptState, scene: int, agent: int, phase: int, number: int):
    """Begin a lateral phase: note the place that it starts from, and how long it takes."""
    first = scripts.episode[state.episode[scene]][0]
    motion = scripts.motion[first + phase]
    course = scripts.course[first + phase]
    running = script.running[scene, agent]
    script.running[scene, agent] = wp.vec2i(running[0], number + 1)
    rail = script.rail[scene, agent]
    extent = motion[3]
    is_length = float(0.0)
    if course[0] == SpeedProfile.STEP:
        extent = 0.0
    elif course[0] == SpeedProfile.DISTANCE:
        is_length = 1.0
    elif course[0] == SpeedProfile.RATE:
        change = target_left(scripts, course[2], course[3], rail[0]) - rail[1]
        extent = steepest(course[1]) * wp.abs(change) / motion[3]
    script.swerve[scene, agent] = wp.vec4(rail[1], rail[0], extent, is_length)


@wp.func
def begin_phases(
    bank: EpisodeArrays,
    roads: Roads,
    scripts: Scripts,
    state: State,
    script: ScriptState,
    scene: int,
    agent: int,
    dt: float,
) -> int:
    """Begin the phases of an agent whose conditions hold; return 1 if there are any."""
    episode = state.episode[scene]
    rows = bank.script[episode, agent]
    base = scripts.episode[episode][0]
    stamp = state.step[scene] + 1
    begins = int(0)
    waits = int(0)  # 1: a phase earlier in the list has not begun
    for k in range(rows[1] + rows[2]):
        if k == rows[1]:
            waits = 0
        phase = rows[0] + k
        if script.begun[scene, phase] == 0:
            if waits == 0 or scripts.anytime[base + phase] == 1:
                if may_begin(bank, roads, scripts, state, script, scene, base + phase, dt):
                    begins = 1
                    script.begun[scene, phase] = stamp
                    running = script.running[scene, agent]
                    before = running[0] - 1
                    if k >= rows[1]:
                        before = running[1] - 1
                        if before >= 0:
                            before = before + rows[1]
                    if before >= 0:
                        if script.ended[scene, rows[0] + before] == 0:
                            script.ended[scene, rows[0] + before] = stamp
                    if k < rows[1]:
                        begin_phase(scripts, state, script, scene, agent, phase, k)
                    else:
                        begin_swerve(scripts, state, script, scene, agent, phase, k - rows[1])
                elif scripts.anytime[base + phase] == 0:
                    waits = 1
    return begins


@wp.func
def begin_all(
    bank: EpisodeArrays,
    roads: Roads,
    scripts: Scripts,
    state: State,
    script: ScriptState,
    scene: int,
    agents: int,
    dt: float,
) -> int:
    """Begin the phases of a scene whose conditions hold; return 1 if there are any, since others may wait for them."""
    episode = state.episode[scene]
    table = scripts.episode[episode]
    begins = int(0)
    for condition in range(table[2], table[2] + table[3]):
        if scripts.ring[condition][1] > 0 or scripts.condition[condition][0] == PhaseCondition.STANDSTILL:
            remember(bank, roads, scripts, state, script, scene, condition, dt)
    for agent in range(agents):
        if bank.script[episode, agent][3] != ScriptMotion.NONE and state.active[scene, agent] == Presence.AWAKE:
            if begin_phases(bank, roads, scripts, state, script, scene, agent, dt) == 1:
                begins = 1
    return begins


@wp.func
def limited_speed(current: float, rate: float, target: float, limit: float, jerk: float, dt: float) -> wp.vec3:
    """Return speed and acceleration after dt on the fastest way to a speed, and 1 if it is reached by then.

    The acceleration rises and falls by `jerk`, and stays within `limit`; it is 0 when the speed is reached.
    """
    # where the speed ends up if the acceleration is taken back at once
    stop = current + 0.5 * rate * wp.abs(rate) / jerk
    sign = float(1.0)
    if target < stop or (target == stop and rate > 0.0):
        sign = -1.0
    change = sign * (target - current)
    start = sign * rate
    peak = wp.sqrt(wp.max(jerk * change + 0.5 * start * start, 0.0))
    hold = float(0.0)
    if start > limit:
        peak = limit
        hold = wp.max(change - 0.5 * start * start / jerk, 0.0) / limit
    elif peak > limit:
        hold = (change + 0.5 * start * start / jerk - limit * limit / jerk) / limit
        peak = limit
    slope = jerk
    if peak < start:
        slope = -jerk
    rise = wp.abs(peak - start) / jerk
    fall = peak / jerk
    reached = float(0.0)
    speed = target
    acceleration = float(0.0)
    if rise + hold + fall <= dt + 1.0e-5:
        reached = 1.0
    else:
        t = wp.min(dt, rise)
        gain = start * t + 0.5 * slope * t * t
        acceleration = start + slope * t
        if dt > rise:
            t = wp.min(dt - rise, hold)
            acceleration = peak
            gain = gain + peak * t
            if dt > rise + hold:
                t = dt - rise - hold
                gain = gain + peak * t - 0.5 * jerk * t * t
                acceleration = peak - jerk * t
        speed = current + sign * gain
        acceleration = sign * acceleration
    return wp.vec3(speed, acceleration, reached)


@wp.func
def metres_to(bank: EpisodeArrays, roads: Roads, state: State, scene: int, agent: int, point: wp.vec4) -> float:
    """Return how far an agent has to go to a meeting point, m."""
    distance = float(0.0)
    pose = state.pose[scene, agent]
    if point[2] >= 0.0:
        distance = point[2] - along_own_route(bank, roads, state, scene, agent)
    else:
        distance = (point[0] - pose[0]) * wp.cos(pose[2]) + (point[1] - pose[1]) * wp.sin(pose[2])
    return distance


@wp.func
def meeting_speed(
    bank: EpisodeArrays,
    roads: Roads,
    scripts: Scripts,
    state: State,
    scene: int,
    agent: int,
    phase: int,
    limits: wp.vec2,
    max_speed: float,
    dt: float,
) -> wp.vec2:
    """Return the speed after dt with which an agent arrives in time, and 1 if it or the other has arrived."""
    motion = scripts.motion[phase]
    course = scripts.course[phase]
    current = state.speed[scene, agent]
    other_speed = wp.abs(state.speed[scene, course[2]])
    remaining = metres_to(bank, roads, state, scene, agent, scripts.meeting[phase])
    other_remaining = metres_to(bank, roads, state, scene, course[2], scripts.other_meeting[phase])
    has_final = (course[3] & 4) == 4
    target = current
    arrived = float(0.0)
    if other_remaining <= 0.5 * other_speed * dt or remaining <= 0.5 * current * dt:
        arrived = 1.0
        if has_final:
            target = motion[0]
    elif other_speed < CLOSING:
        target = 0.0  # it waits for the other to set off
    else:
        time = other_remaining / other_speed
        target = remaining / time
        if has_final and time > dt:
            # place as a cubic of time, with the final speed at its end
            acceleration = 6.0 * remaining / (time * time) - (4.0 * current + 2.0 * motion[0]) / time
            change = 6.0 * (current + motion[0]) / (time * time) - 12.0 * remaining / (time * time * time)
            target = current + acceleration * dt + 0.5 * change * dt * dt
    target = wp.clamp(target, 0.0, max_speed)
    return wp.vec2(current + wp.clamp(target - current, -limits[1] * dt, limits[0] * dt), arrived)


@wp.func
def next_speed(
    bank: EpisodeArrays,
    roads: Roads,
    scripts: Scripts,
    state: State,
    script: ScriptState,
    scene: int,
    agent: int,
    dt: float,
) -> float:
    """Return the speed of an agent at the end of the step; ends its phase if that is done by then."""
    episode = state.episode[scene]
    rows = bank.script[episode, agent]
    power = bank.power[bank.model[episode, agent]]
    current = state.speed[scene, agent]
    running = script.running[scene, agent][0]
    limits = wp.vec2(power[0], power[1])
    if bank.kind[bank.model[episode, agent]] != AgentKind.WALKER:
        limits = wp.vec2(wp.min(power[0], bank.surface[episode][0]), wp.min(power[1], bank.surface[episode][0]))
    level = state.braking[scene, agent]
    state.braking[scene, agent] = 0.0
    if running == 0:
        initial = bank.start[episode, agent][3]
        return current + wp.clamp(initial - current, -limits[1] * dt, limits[0] * dt)
    phase = rows[0] + running - 1
    base = scripts.episode[episode][0]
    motion = scripts.motion[base + phase]
    course = scripts.course[base + phase]
    profile = script.course[scene, agent]
    if motion[1] > 0.0:
        limits = wp.vec2(motion[1], motion[1])
    speed = profile[1]
    acceleration = float(0.0)
    is_done = int(0)
    if script.ended[scene, phase] > 0 and course[0] != SpeedProfile.LIMITED:
        # held; an agent that a mirrored simulator moves returns to its speed
        speed = current + wp.clamp(speed - current, -limits[1] * dt, limits[0] * dt)
    elif course[0] == SpeedProfile.LIMITED:
        target = profile[1]
        if (course[3] & 2) == 2:
            target = target_of(state, scene, motion, course)
        if motion[2] > 0.0:
            limit = limits[0]
            if target < current + 0.5 * profile[3] * wp.abs(profile[3]) / motion[2]:
                limit = limits[1]
            result = limited_speed(current, profile[3], target, limit, motion[2], dt)
            speed = result[0]
            acceleration = result[1]
            is_done = int(result[2])
        else:
            if motion[1] == 0.0 and power[3] > 0.0 and target < current - ROUNDING:
                # the brakes of the model build up
                built_up = wp.min(level + dt / power[3], 1.0)
                limits = wp.vec2(limits[0], wp.min(0.5 * (level + built_up) * power[1], limits[1]))
                state.braking[scene, agent] = built_up
            speed = current + wp.clamp(target - current, -limits[1] * dt, limits[0] * dt)
            if wp.abs(speed - target) < ROUNDING:
                speed = target
                is_done = 1
            else:
                acceleration = (speed - current) / dt
        if (course[3] & 2) == 2:
            is_done = 0  # it follows on
    elif course[0] == SpeedProfile.ARRIVAL:
        meeting = meeting_speed(bank, roads, scripts, state, scene, agent, base + phase, limits, power[2], dt)
        speed = meeting[0]
        acceleration = (speed - current) / dt
        is_done = int(meeting[1])
        held = speed
        if (course[3] & 4) == 4:
            held = motion[0]
        script.course[scene, agent] = wp.vec4(profile[0], held, 0.0, acceleration)
    else:
        elapsed = float(state.step[scene] + 2 - script.begun[scene, phase]) * dt
        if elapsed >= profile[2] - ON_TIME:
            is_done = 1
        else:
            share = elapsed / profile[2]
            speed = profile[0] + (profile[1] - profile[0]) * ease(course[1], share)
            acceleration = (profile[1] - profile[0]) * ease_slope(course[1], share) / profile[2]
    if is_done == 1 and script.ended[scene, phase] == 0:
        script.ended[scene, phase] = state.step[scene] + 2
    if course[0] != SpeedProfile.ARRIVAL:
        script.course[scene, agent] = wp.vec4(profile[0], profile[1], profile[2], acceleration)
    return wp.max(speed, 0.0)


@wp.func
def advance_on_rail(
    bank: EpisodeArrays,
    roads: Roads,
    scripts: Scripts,
    state: State,
    script: ScriptState,
    scene: int,
    agent: int,
    speed: float,
    dt: float,
) -> wp.vec3:
    """Move an agent along its route, `rail` metres left of it; return its pose at the end of the step."""
    episode = state.episode[scene]
    rows = bank.script[episode, agent]
    route = bank.route[episode, agent]
    rail = script.rail[scene, agent]
    length = 0.5 * (state.speed[scene, agent] + speed) * dt
    curvature = roads.path[route[0] + wp.clamp(int(rail[0] + 0.5), 0, route[1] - 1)][3]
    stretch = wp.max(1.0 - curvature * rail[1], 0.1)
    left = rail[1]
    running = script.running[scene, agent][1]
    target = rail[1]
    is_jump = int(0)
    is_over = int(0)
    phase = rows[0] + rows[1] + running - 1
    if running > 0:
        course = scripts.course[scripts.episode[episode][0] + phase]
        swerve = script.swerve[scene, agent]
        ahead = rail[0] + length / stretch
        target = target_left(scripts, course[2], course[3], ahead)
        share = float(1.0)
        if swerve[3] == 1.0:
            share = (ahead - swerve[1]) / wp.max(swerve[2], 1.0e-6)
        elif swerve[2] > 0.0:
            share = (float(state.step[scene] + 2 - script.begun[scene, phase]) * dt + ON_TIME) / swerve[2]
        if share >= 1.0:
            left = target
            is_over = 1
        else:
            left = swerve[0] + (target - swerve[0]) * ease(course[1], share)
        if course[0] == SpeedProfile.STEP and script.ended[scene, phase] == 0:
            is_jump = 1
    sidestep = left - rail[1]
    if is_jump == 0:
        max_sidestep = SIDESTEP * length
        if bank.kind[bank.model[episode, agent]] == AgentKind.WALKER:
            max_sidestep = length
        sidestep = wp.clamp(sidestep, -max_sidestep, max_sidestep)
        left = rail[1] + sidestep
    if is_over == 1 and script.ended[scene, phase] == 0:
        if wp.abs(left - target) < 1.0e-3:
            script.ended[scene, phase] = state.step[scene] + 2
    forward = length
    if is_jump == 0:
        forward = wp.sqrt(wp.max(length * length - sidestep * sidestep, 0.0))
    place = rail[0] + forward / stretch
    script.rail[scene, agent] = wp.vec2(place, left)
    last = float(route[1] - 1)
    point = route_at(roads, route[0], route[1], place)
    beyond = place - wp.clamp(place, 0.0, last)
    yaw = point[2]
    if length > 1.0e-6 and is_jump == 0:
        yaw = yaw + wp.atan2(sidestep, forward)
    elif is_jump == 0:
        yaw = state.pose[scene, agent][2]
    return wp.vec3(
        point[0] + beyond * wp.cos(point[2]) - left * wp.sin(point[2]),
        point[1] + beyond * wp.sin(point[2]) + left * wp.cos(point[2]),
        wrap(yaw),
    )


@wp.func
def rail_under(bank: EpisodeArrays, roads: Roads, state: State, scene: int, agent: int) -> wp.vec2:
    """Return the place of an agent along its route and how far left of it that is, m."""
    route = bank.route[state.episode[scene], agent]
    point = row(roads.path, route[0] + state.progress[scene, agent])
    pose = state.pose[scene, agent]
    cosine = wp.cos(point[2])
    sine = wp.sin(point[2])
    dx = pose[0] - point[0]
    dy = pose[1] - point[1]
    return wp.vec2(float(state.progress[scene, agent]) + cosine * dx + sine * dy, cosine * dy - sine * dx)


@wp.func
def run_one(
    bank: EpisodeArrays,
    roads: Roads,
    scripts: Scripts,
    state: State,
    script: ScriptState,
    scene: int,
    agent: int,
    dt: float,
):
    """Decide the motion of a scripted agent in this step."""
    episode = state.episode[scene]
    controller = state.controller[scene, agent]
    if controller != Controller.SCRIPT and bank.script[episode, agent][3] == ScriptMotion.RAIL:
        # another driver has it now; the script would go on from where that one leaves it
        script.rail[scene, agent] = rail_under(bank, roads, state, scene, agent)
    if controller == Controller.FOLLOW:
        if script.running[scene, agent][0] > 0:
            state.cruise[scene, agent] = script.course[scene, agent][1]
    elif controller == Controller.SCRIPT:
        power = bank.power[bank.model[episode, agent]]
        is_walker = bank.kind[bank.model[episode, agent]] == AgentKind.WALKER
        current = state.speed[scene, agent]
        speed = next_speed(bank, roads, scripts, state, script, scene, agent, dt)
        current = state.speed[scene, agent]
        pose = wp.vec3(0.0, 0.0, 0.0)
        steer = float(0.0)
        if bank.script[episode, agent][3] == ScriptMotion.RAIL:
            pose = advance_on_rail(bank, roads, scripts, state, script, scene, agent, speed, dt)
        elif bank.route[episode, agent][1] > 1:
            steer = steer_on_route(bank, roads, state, scene, agent, episode, current, 0.0)
        script.goal[scene, agent] = wp.vec4(pose[0], pose[1], pose[2], speed)
        # pedals for whoever shows or mirrors the agent; here it moves by its goal
        acceleration = (speed - current) / dt
        throttle = wp.clamp(acceleration / wp.max(power[0], 0.1), 0.0, 1.0)
        brake = wp.clamp(-acceleration / wp.max(power[1], 0.1), 0.0, 1.0)
        if speed == 0.0:
            brake = 1.0
        if is_walker:
            throttle = speed / wp.max(power[2], 0.1)
            brake = 0.0
        state.control[scene, agent] = wp.vec4(throttle, brake, steer, 0.0)


@wp.kernel(enable_backward=False)
def run_scripts(
    bank: EpisodeArrays,
    roads: Roads,
    scripts: Scripts,
    state: State,
    script: ScriptState,
    agents: int,
    dt: float,
):
    """Begin the phases whose conditions hold and decide the motion of all scripted agents; one thread per scene."""
    scene = wp.tid()
    if state.end[scene] != End.RUNNING:
        return
    episode = state.episode[scene]
    table = scripts.episode[episode]
    if table[1] > 0:
        begins = int(1)
        while begins == 1:
            begins = begin_all(bank, roads, scripts, state, script, scene, agents, dt)
    for agent in range(agents):
        if bank.script[episode, agent][3] != ScriptMotion.NONE and state.active[scene, agent] == Presence.AWAKE:
            run_one(bank, roads, scripts, state, script, scene, agent, dt)


@wp.kernel(enable_backward=False)
def restart_scripts(
    bank: EpisodeArrays,
    roads: Roads,
    scripts: Scripts,
    state: State,
    script: ScriptState,
    mask: wp.array(dtype=wp.int32),
    ended_too: int,
    agents: int,
    phases: int,
    words: int,
):
    """Reset the scripts of scenes; runs before `restart_record`, which clears the reason of the end."""
    scene = wp.tid()
    restarts = mask[scene] == 1
    if ended_too == 1 and state.end[scene] != End.RUNNING:
        restarts = True
    if not restarts:
        return
    for phase in range(phases):
        script.begun[scene, phase] = 0
        script.ended[scene, phase] = 0
    for word in range(words):
        script.history[scene, word] = 0
    episode = state.episode[scene]
    for agent in range(agents):
        script.running[scene, agent] = wp.vec2i(0, 0)
        script.course[scene, agent] = wp.vec4(0.0, 0.0, 0.0, 0.0)
        script.swerve[scene, agent] = wp.vec4(0.0, 0.0, 0.0, 0.0)
        script.goal[scene, agent] = wp.vec4(0.0, 0.0, 0.0, 0.0)
        rail = wp.vec2(0.0, 0.0)
        route = bank.route[episode, agent]
        if bank.script[episode, agent][3] == ScriptMotion.RAIL and route[1] > 1:
            start = bank.start[episode, agent]
            nearest = int(0)
            min_distance2 = float(1.0e12)
            for candidate in range(wp.min(13, route[1])):
                point = row(roads.path, route[0] + candidate)
                distance2 = (start[0] - point[0]) * (start[0] - point[0]) + (start[1] - point[1]) * (
                    start[1] - point[1]
                )
                if distance2 < min_distance2:
                    min_distance2 = distance2
                    nearest = candidate
            point = row(roads.path, route[0] + nearest)
            cosine = wp.cos(point[2])
            sine = wp.sin(point[2])
            dx = start[0] - point[0]
            dy = start[1] - point[1]
            rail = wp.vec2(float(nearest) + cosine * dx + sine * dy, cosine * dy - sine * dx)
        script.rail[scene, agent] = rail
