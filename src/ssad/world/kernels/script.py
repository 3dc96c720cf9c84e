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
GAP_TIME = wp.constant(0.5)  # s in which the error of a gap falls to 37 %
GAP_REACHED = wp.constant(0.02)  # m
GAP_CLOSING = wp.constant(0.05)  # m/s
PI = wp.constant(3.141592653589793)


@wp.func
def along_own_route(bank: EpisodeArrays, roads: Roads, state: State, scene_index: int, agent_index: int) -> float:
    """Return the place of an agent along its route, m."""
    route = bank.route[state.episode[scene_index], agent_index]
    at = state.progress[scene_index, agent_index]
    point = row(roads.path, route[0] + at)
    pose = state.pose[scene_index, agent_index]
    return float(at) + wp.cos(point[2]) * (pose[0] - point[0]) + wp.sin(point[2]) * (pose[1] - point[1])


@wp.func
def place_on_route(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    scene_index: int,
    agent_index: int,
    point_x: float,
    point_y: float,
    sign: float,
) -> wp.vec2:
    """Return how far ahead of an agent along its route a point is, times `sign`, and how far left of it, m."""
    route = bank.route[state.episode[scene_index], agent_index]
    pose = state.pose[scene_index, agent_index]
    own_place = along_own_route(bank, roads, state, scene_index, agent_index)
    frame = route_frame(roads, route[0], route[1], own_place)
    ahead = (point_x - pose[0]) * frame[2] + (point_y - pose[1]) * frame[3]
    lateral = float(0.0)
    for _ in range(SEARCH):
        place = own_place + ahead
        frame = route_frame(roads, route[0], route[1], place)
        # before its start and beyond its end a route goes straight on
        before_start = wp.min(place, 0.0)
        offset_x = point_x - frame[0] - before_start * frame[2]
        offset_y = point_y - frame[1] - before_start * frame[3]
        residual = offset_x * frame[2] + offset_y * frame[3]
        lateral = offset_y * frame[2] - offset_x * frame[3]
        if wp.abs(residual) < 1.0e-3:
            break
        ahead = ahead + residual
    own_frame = route_frame(roads, route[0], route[1], own_place)
    own_before = wp.min(own_place, 0.0)
    own_lateral = (pose[1] - own_frame[1] - own_before * own_frame[3]) * own_frame[2] - (
        pose[0] - own_frame[0] - own_before * own_frame[2]
    ) * own_frame[3]
    return wp.vec2(sign * ahead, sign * (lateral - own_lateral))


@wp.func
def ahead_and_left(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    scene_index: int,
    agent_index: int,
    other_index: int,
    point_x: float,
    point_y: float,
) -> wp.vec2:
    """Return how far ahead of an agent along the road a point is, and how far left, m; `other_index` stands there."""
    episode = state.episode[scene_index]
    pose = state.pose[scene_index, agent_index]
    offset_x = point_x - pose[0]
    offset_y = point_y - pose[1]
    result = wp.vec2(
        offset_x * wp.cos(pose[2]) + offset_y * wp.sin(pose[2]),
        offset_y * wp.cos(pose[2]) - offset_x * wp.sin(pose[2]),
    )
    if bank.route[episode, agent_index][1] > 1:
        result = place_on_route(bank, roads, state, scene_index, agent_index, point_x, point_y, 1.0)
    elif other_index >= 0:
        if bank.route[episode, other_index][1] > 1:
            result = place_on_route(bank, roads, state, scene_index, other_index, pose[0], pose[1], -1.0)
    return result


@wp.func
def point_to_box(point_x: float, point_y: float, pose: wp.vec3, half_length: float, half_width: float) -> float:
    """Return the distance of a point from a box, m; 0 inside."""
    cosine = wp.cos(pose[2])
    sine = wp.sin(pose[2])
    offset_x = point_x - pose[0]
    offset_y = point_y - pose[1]
    outside_x = wp.max(wp.abs(cosine * offset_x + sine * offset_y) - half_length, 0.0)
    outside_y = wp.max(wp.abs(cosine * offset_y - sine * offset_x) - half_width, 0.0)
    return wp.sqrt(outside_x * outside_x + outside_y * outside_y)


@wp.func
def corners_to_box(
    p: wp.vec3, half_length: float, half_width: float, q: wp.vec3, other_length: float, other_width: float
) -> float:
    """Return the smallest distance of the corners of box p from box q, m."""
    cosine = wp.cos(p[2])
    sine = wp.sin(p[2])
    distance = float(FAR)
    for corner in range(4):
        forward = half_length
        left = half_width
        if corner % 2 == 1:
            forward = -half_length
        if corner >= 2:
            left = -half_width
        point_x = p[0] + cosine * forward - sine * left
        point_y = p[1] + sine * forward + cosine * left
        distance = wp.min(distance, point_to_box(point_x, point_y, q, other_length, other_width))
    return distance


@wp.func
def half_extent(heading: float, body: wp.vec4, across: bool) -> float:
    """Return half the extent of a body turned by `yaw`, along an axis or across it, m."""
    cosine = wp.abs(wp.cos(heading))
    sine = wp.abs(wp.sin(heading))
    extent = cosine * body[0] + sine * body[1]
    if across:
        extent = sine * body[0] + cosine * body[1]
    return extent


@wp.func
def distance_and_closing(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    scene_index: int,
    agent_index: int,
    other_index: int,
    form: wp.vec4i,
    point_x: float,
    point_y: float,
) -> wp.vec2:
    """Return the distance of an agent from another one (-1: from the point x, y), and the speed at which it falls."""
    episode = state.episode[scene_index]
    pose = state.pose[scene_index, agent_index]
    speed = state.speed[scene_index, agent_index]
    velocity = wp.vec2(speed * wp.cos(pose[2]), speed * wp.sin(pose[2]))
    body = bank.body[bank.model[episode, agent_index]]
    other_velocity = wp.vec2(0.0, 0.0)
    other_pose = wp.vec3(point_x, point_y, pose[2])
    other_body = wp.vec4(0.0, 0.0, 0.0, 0.0)
    if other_index >= 0:
        other_pose = state.pose[scene_index, other_index]
        other_speed = state.speed[scene_index, other_index]
        other_velocity = wp.vec2(other_speed * wp.cos(other_pose[2]), other_speed * wp.sin(other_pose[2]))
        other_body = bank.body[bank.model[episode, other_index]]
    offset_x = other_pose[0] - pose[0]
    offset_y = other_pose[1] - pose[1]
    distance = float(0.0)
    closing = float(0.0)
    if form[3] == Measure.STRAIGHT:
        distance = wp.sqrt(offset_x * offset_x + offset_y * offset_y)
        if distance > 1.0e-6:
            closing = (
                offset_x * (velocity[0] - other_velocity[0]) + offset_y * (velocity[1] - other_velocity[1])
            ) / distance
        if form[2] == 1:
            if other_index < 0:
                distance = point_to_box(point_x, point_y, pose, body[0], body[1])
            elif boxes_touch(pose, body[0], body[1], other_pose, other_body[0], other_body[1]):
                distance = 0.0
            else:
                distance = wp.min(
                    corners_to_box(pose, body[0], body[1], other_pose, other_body[0], other_body[1]),
                    corners_to_box(other_pose, other_body[0], other_body[1], pose, body[0], body[1]),
                )
    else:
        place = ahead_and_left(bank, roads, state, scene_index, agent_index, other_index, other_pose[0], other_pose[1])
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
            own_place = body[0]
            if across:
                own_place = body[1]
            distance = wp.max(distance - own_place - half_extent(turn, other_body, across), 0.0)
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
    scene_index: int,
    condition: int,
    dt: float,
) -> bool:
    """Return whether a condition holds now, apart from its edge and delay."""
    who = scripts.condition[condition]
    form = scripts.form[condition]
    number = scripts.number[condition]
    kind = who[0]
    agent_index = who[1]
    other_index = who[2]
    step = state.step[scene_index]
    holds = kind == PhaseCondition.ALWAYS
    if kind == PhaseCondition.TIME:
        holds = float(step) * dt >= number[0] - ON_TIME
        if form[0] == 0:
            holds = not holds
    elif kind == PhaseCondition.AFTER:
        began = int(1)
        before = who[3]
        if before >= 0:
            began = script.begun[scene_index, before]
        if began > 0:
            holds = float(step + 1 - began) * dt >= number[0] - ON_TIME
            if form[0] == 0:
                holds = not holds
    elif kind == PhaseCondition.PHASE_START:
        began = script.begun[scene_index, who[3]]
        holds = began > 0 and began <= step + 1
    elif kind == PhaseCondition.PHASE_END:
        ended = script.ended[scene_index, who[3]]
        holds = ended > 0 and ended <= step + 1
    elif kind == PhaseCondition.EGO_DISTANCE:
        distance = distance_and_closing(bank, roads, state, scene_index, agent_index, other_index, form, 0.0, 0.0)
        holds = is_past(distance[0], number[0], form[0])
    elif kind == PhaseCondition.EGO_SPEED:
        holds = is_past(state.speed[scene_index, 0], number[0], form[0])
    elif kind == PhaseCondition.TRAVELLED:
        holds = is_past(state.travelled[scene_index, agent_index], number[0], form[0])
    elif kind != PhaseCondition.ALWAYS and state.active[scene_index, agent_index] != Presence.ABSENT:
        present = int(1)
        if other_index >= 0:
            if state.active[scene_index, other_index] == Presence.ABSENT:
                present = 0
        if present == 1:
            speed = wp.abs(state.speed[scene_index, agent_index])
            if kind == PhaseCondition.SPEED:
                holds = is_past(speed, number[0], form[0])
            elif kind == PhaseCondition.RELATIVE_SPEED:
                holds = is_past(speed - wp.abs(state.speed[scene_index, other_index]), number[0], form[0])
            elif kind == PhaseCondition.ACCELERATION:
                holds = is_past(state.accel[scene_index, agent_index], number[0], form[0])
            elif kind == PhaseCondition.STANDSTILL:
                if speed <= AT_REST:
                    # `remember` notes the step at which the agent was last found moving
                    rest = float(step - script.history[scene_index, scripts.ring[condition][0]]) * dt
                    holds = rest >= number[0] - ON_TIME
            else:
                measured = distance_and_closing(
                    bank, roads, state, scene_index, agent_index, other_index, form, number[1], number[2]
                )
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
def history_bit(scripts: Scripts, script: ScriptState, scene_index: int, condition: int, step: int) -> int:
    """Return the value of a condition in a step; 0 before the first one."""
    bit = int(0)
    if step >= 0:
        ring = scripts.ring[condition]
        word = ring[0]
        if scripts.condition[condition][0] == PhaseCondition.STANDSTILL:
            word = word + 1
        place = step % ring[1]
        bit = (script.history[scene_index, word + place // 32] >> (place % 32)) & 1
    return bit


@wp.func
def remember(
    bank: EpisodeArrays,
    roads: Roads,
    scripts: Scripts,
    state: State,
    script: ScriptState,
    scene_index: int,
    condition: int,
    dt: float,
):
    """Note the present value of a condition whose edge or delay counts."""
    step = state.step[scene_index]
    ring = scripts.ring[condition]
    who = scripts.condition[condition]
    word = ring[0]
    if who[0] == PhaseCondition.STANDSTILL:
        if wp.abs(state.speed[scene_index, who[1]]) > AT_REST:
            script.history[scene_index, word] = step + 1
        word = word + 1
    if ring[1] > 0:
        place = step % ring[1]
        mask = 1 << (place % 32)
        bits = script.history[scene_index, word + place // 32] & (~mask)
        if condition_value(bank, roads, scripts, state, script, scene_index, condition, dt):
            bits = bits | mask
        script.history[scene_index, word + place // 32] = bits


@wp.func
def condition_holds(
    bank: EpisodeArrays,
    roads: Roads,
    scripts: Scripts,
    state: State,
    script: ScriptState,
    scene_index: int,
    condition: int,
    dt: float,
) -> bool:
    """Return whether a condition holds, with its edge and delay."""
    ring = scripts.ring[condition]
    holds = False
    if ring[1] == 0:
        holds = condition_value(bank, roads, scripts, state, script, scene_index, condition, dt)
    else:
        step = state.step[scene_index] - ring[2]
        if step >= 0:
            now = history_bit(scripts, script, scene_index, condition, step)
            edge = scripts.form[condition][1]
            if edge == Edge.NONE:
                holds = now == 1
            elif step >= 1:
                before = history_bit(scripts, script, scene_index, condition, step - 1)
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
    scene_index: int,
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
                    if not condition_holds(bank, roads, scripts, state, script, scene_index, condition, dt):
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
def target_of(state: State, scene_index: int, motion: wp.vec4, course: wp.vec4i) -> float:
    """Return the target speed of a phase now, m/s."""
    target = motion[0]
    if course[2] >= 0:
        other_speed = wp.abs(state.speed[scene_index, course[2]])
        if (course[3] & 1) == 1:
            target = motion[0] * other_speed
        else:
            target = motion[0] + other_speed
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
def begin_phase(
    scripts: Scripts, state: State, script: ScriptState, scene_index: int, agent_index: int, phase: int, number: int
):
    """Begin a phase: note the speed that it starts from, its target, and how long it takes."""
    first = scripts.episode[state.episode[scene_index]][0]
    motion = scripts.motion[first + phase]
    course = scripts.course[first + phase]
    running = script.running[scene_index, agent_index]
    script.running[scene_index, agent_index] = wp.vec2i(number + 1, running[1])
    state.phase[scene_index, agent_index] = state.phase[scene_index, agent_index] + 1
    speed = state.speed[scene_index, agent_index]
    acceleration = script.course[scene_index, agent_index][3]
    target = speed
    duration = float(0.0)
    if course[0] != SpeedProfile.ARRIVAL and course[0] != SpeedProfile.GAP:
        target = target_of(state, scene_index, motion, course)
    if course[0] == SpeedProfile.STEP:
        state.speed[scene_index, agent_index] = target
        speed = target
        acceleration = 0.0
    elif course[0] == SpeedProfile.DURATION:
        duration = motion[3]
    elif course[0] == SpeedProfile.DISTANCE:
        duration = 2.0 * motion[3] / wp.max(speed + target, 0.01)
    elif course[0] == SpeedProfile.RATE:
        duration = steepest(course[1]) * wp.abs(target - speed) / motion[3]
    script.course[scene_index, agent_index] = wp.vec4(speed, target, duration, acceleration)


@wp.func
def begin_swerve(
    scripts: Scripts, state: State, script: ScriptState, scene_index: int, agent_index: int, phase: int, number: int
):
    """Begin a lateral phase: note the place that it starts from, and how long it takes."""
    first = scripts.episode[state.episode[scene_index]][0]
    motion = scripts.motion[first + phase]
    course = scripts.course[first + phase]
    running = script.running[scene_index, agent_index]
    script.running[scene_index, agent_index] = wp.vec2i(running[0], number + 1)
    rail = script.rail[scene_index, agent_index]
    extent = motion[3]
    is_length = float(0.0)
    if course[0] == SpeedProfile.STEP:
        extent = 0.0
    elif course[0] == SpeedProfile.DISTANCE:
        is_length = 1.0
    elif course[0] == SpeedProfile.RATE:
        change = target_left(scripts, course[2], course[3], rail[0]) - rail[1]
        extent = steepest(course[1]) * wp.abs(change) / motion[3]
    script.swerve[scene_index, agent_index] = wp.vec4(rail[1], rail[0], extent, is_length)


@wp.func
def begin_phases(
    bank: EpisodeArrays,
    roads: Roads,
    scripts: Scripts,
    state: State,
    script: ScriptState,
    scene_index: int,
    agent_index: int,
    dt: float,
) -> int:
    """Begin the phases of an agent whose conditions hold; return 1 if there are any."""
    episode = state.episode[scene_index]
    rows = bank.script[episode, agent_index]
    base = scripts.episode[episode][0]
    stamp = state.step[scene_index] + 1
    begins = int(0)
    waits = int(0)  # 1: a phase earlier in the list has not begun
    for k in range(rows[1] + rows[2]):
        if k == rows[1]:
            waits = 0
        phase = rows[0] + k
        if script.begun[scene_index, phase] == 0:
            if waits == 0 or scripts.anytime[base + phase] == 1:
                if may_begin(bank, roads, scripts, state, script, scene_index, base + phase, dt):
                    begins = 1
                    script.begun[scene_index, phase] = stamp
                    running = script.running[scene_index, agent_index]
                    before = running[0] - 1
                    if k >= rows[1]:
                        before = running[1] - 1
                        if before >= 0:
                            before = before + rows[1]
                    if before >= 0:
                        if script.ended[scene_index, rows[0] + before] == 0:
                            script.ended[scene_index, rows[0] + before] = stamp
                    if k < rows[1]:
                        begin_phase(scripts, state, script, scene_index, agent_index, phase, k)
                    else:
                        begin_swerve(scripts, state, script, scene_index, agent_index, phase, k - rows[1])
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
    scene_index: int,
    agents: int,
    dt: float,
) -> int:
    """Begin the phases of a scene whose conditions hold; return 1 if there are any, since others may wait for them."""
    episode = state.episode[scene_index]
    table = scripts.episode[episode]
    begins = int(0)
    for condition in range(table[2], table[2] + table[3]):
        if scripts.ring[condition][1] > 0 or scripts.condition[condition][0] == PhaseCondition.STANDSTILL:
            remember(bank, roads, scripts, state, script, scene_index, condition, dt)
    for agent_index in range(agents):
        kind = bank.script[episode, agent_index][3]
        if (kind == ScriptMotion.STEERED or kind == ScriptMotion.RAIL) and state.active[
            scene_index, agent_index
        ] == Presence.AWAKE:
            if begin_phases(bank, roads, scripts, state, script, scene_index, agent_index, dt) == 1:
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
        elapsed = wp.min(dt, rise)
        gain = start * elapsed + 0.5 * slope * elapsed * elapsed
        acceleration = start + slope * elapsed
        if dt > rise:
            elapsed = wp.min(dt - rise, hold)
            acceleration = peak
            gain = gain + peak * elapsed
            if dt > rise + hold:
                elapsed = dt - rise - hold
                gain = gain + peak * elapsed - 0.5 * jerk * elapsed * elapsed
                acceleration = peak - jerk * elapsed
        speed = current + sign * gain
        acceleration = sign * acceleration
    return wp.vec3(speed, acceleration, reached)


@wp.func
def metres_to(
    bank: EpisodeArrays, roads: Roads, state: State, scene_index: int, agent_index: int, point: wp.vec4
) -> float:
    """Return how far an agent has to go to a meeting point, m."""
    distance = float(0.0)
    pose = state.pose[scene_index, agent_index]
    if point[2] >= 0.0:
        distance = point[2] - along_own_route(bank, roads, state, scene_index, agent_index)
    else:
        distance = (point[0] - pose[0]) * wp.cos(pose[2]) + (point[1] - pose[1]) * wp.sin(pose[2])
    return distance


@wp.func
def meeting_speed(
    bank: EpisodeArrays,
    roads: Roads,
    scripts: Scripts,
    state: State,
    scene_index: int,
    agent_index: int,
    phase: int,
    limits: wp.vec2,
    max_speed: float,
    dt: float,
) -> wp.vec2:
    """Return the speed after dt with which an agent arrives in time, and 1 if it or the other has arrived."""
    motion = scripts.motion[phase]
    course = scripts.course[phase]
    current = state.speed[scene_index, agent_index]
    other_speed = wp.abs(state.speed[scene_index, course[2]])
    remaining = metres_to(bank, roads, state, scene_index, agent_index, scripts.meeting[phase])
    other_remaining = metres_to(bank, roads, state, scene_index, course[2], scripts.other_meeting[phase])
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
def gap_speed(
    bank: EpisodeArrays,
    roads: Roads,
    scripts: Scripts,
    state: State,
    scene_index: int,
    agent_index: int,
    phase: int,
    model_limits: wp.vec2,
    model_speed: float,
    side_before: float,
    dt: float,
) -> wp.vec4:
    """Return the speed after dt that keeps a distance, 1 if it has it by then, 1 behind or -1 ahead, the other's speed.

    The error e of the distance falls at the speed e / GAP_TIME where it is small, else at the speed from which the
    actor comes to the speed of the other one within its limit a: 2 a (e - a GAP_TIME^2 / 2) = r^2. Both hold at the end
    of the step, which makes the approach free of overshoot.
    """
    episode = state.episode[scene_index]
    gap = scripts.meeting[phase]
    constraint = scripts.other_meeting[phase]
    other_index = scripts.course[phase][2]
    pose = state.pose[scene_index, agent_index]
    other_pose = state.pose[scene_index, other_index]
    place = ahead_and_left(bank, roads, state, scene_index, agent_index, other_index, other_pose[0], other_pose[1])
    ahead = place[0]
    side = gap[2]
    if side == 0.0:
        side = side_before
    if side == 0.0:
        side = 1.0
        if ahead < 0.0:
            side = -1.0
    distance = gap[0]
    if gap[3] == 1.0:
        body = bank.body[bank.model[episode, agent_index]]
        other_body = bank.body[bank.model[episode, other_index]]
        distance = distance + body[0] + half_extent(other_pose[2] - pose[2], other_body, False)
    limits = model_limits
    if constraint[0] > 0.0:
        limits = wp.vec2(constraint[0], limits[1])
    if constraint[1] > 0.0:
        limits = wp.vec2(limits[0], constraint[1])
    max_speed = model_speed
    if constraint[2] > 0.0:
        max_speed = wp.min(max_speed, constraint[2])
    current = state.speed[scene_index, agent_index]
    other_before = state.speed[scene_index, other_index]
    other_speed = other_before + state.accel[scene_index, other_index] * dt
    if other_before >= 0.0:
        other_speed = wp.max(other_speed, 0.0)
    lag = 0.5 * dt
    if side > 0.0:
        lag = lag + gap[1]
    # the error at the end of the step is `error` less `lag` times the closing speed then
    error = ahead - 0.5 * (current - other_before) * dt - side * (distance + gap[1] * other_speed)
    sign = float(1.0)
    limit = limits[1]
    if error < 0.0:
        sign = -1.0
        limit = limits[0]
    closing = wp.abs(error) / (GAP_TIME + lag)
    if closing > limit * GAP_TIME:
        slowing = limit * lag
        remaining = wp.abs(error) - 0.5 * limit * GAP_TIME * GAP_TIME
        closing = wp.sqrt(slowing * slowing + 2.0 * limit * remaining) - slowing
    target = wp.clamp(other_speed + sign * closing, 0.0, max_speed)
    speed = current + wp.clamp(target - current, -limits[1] * dt, limits[0] * dt)
    difference = speed - other_speed
    reached = float(0.0)
    if wp.abs(error - lag * difference) < GAP_REACHED and wp.abs(difference) < GAP_CLOSING:
        reached = 1.0
    return wp.vec4(speed, reached, side, other_speed)


@wp.func
def next_speed(
    bank: EpisodeArrays,
    roads: Roads,
    scripts: Scripts,
    state: State,
    script: ScriptState,
    scene_index: int,
    agent_index: int,
    dt: float,
) -> float:
    """Return the speed of an agent at the end of the step; ends its phase if that is done by then."""
    episode = state.episode[scene_index]
    rows = bank.script[episode, agent_index]
    power = bank.power[bank.model[episode, agent_index]]
    current = state.speed[scene_index, agent_index]
    running = script.running[scene_index, agent_index][0]
    limits = wp.vec2(power[0], power[1])
    if bank.kind[bank.model[episode, agent_index]] != AgentKind.WALKER:
        limits = wp.vec2(wp.min(power[0], bank.surface[episode][0]), wp.min(power[1], bank.surface[episode][0]))
    level = state.braking[scene_index, agent_index]
    state.braking[scene_index, agent_index] = 0.0
    if running == 0:
        initial = bank.start[episode, agent_index][3]
        return current + wp.clamp(initial - current, -limits[1] * dt, limits[0] * dt)
    phase = rows[0] + running - 1
    base = scripts.episode[episode][0]
    motion = scripts.motion[base + phase]
    course = scripts.course[base + phase]
    profile = script.course[scene_index, agent_index]
    if motion[1] > 0.0:
        limits = wp.vec2(motion[1], motion[1])
    speed = profile[1]
    acceleration = float(0.0)
    is_done = int(0)
    if script.ended[scene_index, phase] > 0 and course[0] != SpeedProfile.LIMITED:
        # held; an agent that a mirrored simulator moves returns to its speed
        speed = current + wp.clamp(speed - current, -limits[1] * dt, limits[0] * dt)
    elif course[0] == SpeedProfile.LIMITED:
        target = profile[1]
        if (course[3] & 2) == 2:
            target = target_of(state, scene_index, motion, course)
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
                state.braking[scene_index, agent_index] = built_up
            speed = current + wp.clamp(target - current, -limits[1] * dt, limits[0] * dt)
            if wp.abs(speed - target) < ROUNDING:
                speed = target
                is_done = 1
            else:
                acceleration = (speed - current) / dt
        if (course[3] & 2) == 2:
            is_done = 0  # it follows on
    elif course[0] == SpeedProfile.ARRIVAL:
        meeting = meeting_speed(
            bank, roads, scripts, state, scene_index, agent_index, base + phase, limits, power[2], dt
        )
        speed = meeting[0]
        acceleration = (speed - current) / dt
        is_done = int(meeting[1])
        held = speed
        if (course[3] & 4) == 4:
            held = motion[0]
        script.course[scene_index, agent_index] = wp.vec4(profile[0], held, 0.0, acceleration)
    elif course[0] == SpeedProfile.GAP:
        gap_motion = gap_speed(
            bank, roads, scripts, state, scene_index, agent_index, base + phase, limits, power[2], profile[2], dt
        )
        speed = gap_motion[0]
        acceleration = (speed - current) / dt
        held = speed
        if (course[3] & 2) == 0 and gap_motion[1] == 1.0:
            is_done = 1
            held = wp.max(gap_motion[3], 0.0)
        profile = wp.vec4(profile[0], held, gap_motion[2], acceleration)
    else:
        elapsed = float(state.step[scene_index] + 2 - script.begun[scene_index, phase]) * dt
        if elapsed >= profile[2] - ON_TIME:
            is_done = 1
        else:
            share = elapsed / profile[2]
            speed = profile[0] + (profile[1] - profile[0]) * ease(course[1], share)
            acceleration = (profile[1] - profile[0]) * ease_slope(course[1], share) / profile[2]
    if is_done == 1 and script.ended[scene_index, phase] == 0:
        script.ended[scene_index, phase] = state.step[scene_index] + 2
    if course[0] != SpeedProfile.ARRIVAL:
        script.course[scene_index, agent_index] = wp.vec4(profile[0], profile[1], profile[2], acceleration)
    return wp.max(speed, 0.0)


@wp.func
def advance_on_rail(
    bank: EpisodeArrays,
    roads: Roads,
    scripts: Scripts,
    state: State,
    script: ScriptState,
    scene_index: int,
    agent_index: int,
    speed: float,
    dt: float,
) -> wp.vec3:
    """Move an agent along its route, `rail` metres left of it; return its pose at the end of the step."""
    episode = state.episode[scene_index]
    rows = bank.script[episode, agent_index]
    route = bank.route[episode, agent_index]
    rail = script.rail[scene_index, agent_index]
    length = 0.5 * (state.speed[scene_index, agent_index] + speed) * dt
    curvature = roads.path[route[0] + wp.clamp(int(rail[0] + 0.5), 0, route[1] - 1)][3]
    stretch = wp.max(1.0 - curvature * rail[1], 0.1)
    left = rail[1]
    running = script.running[scene_index, agent_index][1]
    target = rail[1]
    is_jump = int(0)
    is_over = int(0)
    phase = rows[0] + rows[1] + running - 1
    if running > 0:
        course = scripts.course[scripts.episode[episode][0] + phase]
        swerve = script.swerve[scene_index, agent_index]
        ahead = rail[0] + length / stretch
        target = target_left(scripts, course[2], course[3], ahead)
        share = float(1.0)
        if swerve[3] == 1.0:
            share = (ahead - swerve[1]) / wp.max(swerve[2], 1.0e-6)
        elif swerve[2] > 0.0:
            share = (float(state.step[scene_index] + 2 - script.begun[scene_index, phase]) * dt + ON_TIME) / swerve[2]
        if share >= 1.0:
            left = target
            is_over = 1
        else:
            left = swerve[0] + (target - swerve[0]) * ease(course[1], share)
        if course[0] == SpeedProfile.STEP and script.ended[scene_index, phase] == 0:
            is_jump = 1
    sidestep = left - rail[1]
    if is_jump == 0:
        max_sidestep = SIDESTEP * length
        if bank.kind[bank.model[episode, agent_index]] == AgentKind.WALKER:
            max_sidestep = length
        sidestep = wp.clamp(sidestep, -max_sidestep, max_sidestep)
        left = rail[1] + sidestep
    if is_over == 1 and script.ended[scene_index, phase] == 0:
        if wp.abs(left - target) < 1.0e-3:
            script.ended[scene_index, phase] = state.step[scene_index] + 2
    forward = length
    if is_jump == 0:
        forward = wp.sqrt(wp.max(length * length - sidestep * sidestep, 0.0))
    place = rail[0] + forward / stretch
    script.rail[scene_index, agent_index] = wp.vec2(place, left)
    last = float(route[1] - 1)
    point = route_at(roads, route[0], route[1], place)
    beyond = place - wp.clamp(place, 0.0, last)
    heading = point[2]
    if length > 1.0e-6 and is_jump == 0:
        heading = heading + wp.atan2(sidestep, forward)
    elif is_jump == 0:
        heading = state.pose[scene_index, agent_index][2]
    return wp.vec3(
        point[0] + beyond * wp.cos(point[2]) - left * wp.sin(point[2]),
        point[1] + beyond * wp.sin(point[2]) + left * wp.cos(point[2]),
        wrap(heading),
    )


@wp.func
def rail_under(bank: EpisodeArrays, roads: Roads, state: State, scene_index: int, agent_index: int) -> wp.vec2:
    """Return the place of an agent along its route and how far left of it that is, m."""
    route = bank.route[state.episode[scene_index], agent_index]
    point = row(roads.path, route[0] + state.progress[scene_index, agent_index])
    pose = state.pose[scene_index, agent_index]
    cosine = wp.cos(point[2])
    sine = wp.sin(point[2])
    offset_x = pose[0] - point[0]
    offset_y = pose[1] - point[1]
    return wp.vec2(
        float(state.progress[scene_index, agent_index]) + cosine * offset_x + sine * offset_y,
        cosine * offset_y - sine * offset_x,
    )


@wp.func
def run_one(
    bank: EpisodeArrays,
    roads: Roads,
    scripts: Scripts,
    state: State,
    script: ScriptState,
    scene_index: int,
    agent_index: int,
    dt: float,
):
    """Decide the motion of a scripted agent in this step."""
    episode = state.episode[scene_index]
    controller = state.controller[scene_index, agent_index]
    if controller != Controller.SCRIPT and bank.script[episode, agent_index][3] == ScriptMotion.RAIL:
        # another driver has it now; the script would go on from where that one leaves it
        script.rail[scene_index, agent_index] = rail_under(bank, roads, state, scene_index, agent_index)
    if controller == Controller.FOLLOW:
        if script.running[scene_index, agent_index][0] > 0:
            state.cruise[scene_index, agent_index] = script.course[scene_index, agent_index][1]
    elif controller == Controller.SCRIPT:
        power = bank.power[bank.model[episode, agent_index]]
        is_walker = bank.kind[bank.model[episode, agent_index]] == AgentKind.WALKER
        current = state.speed[scene_index, agent_index]
        speed = next_speed(bank, roads, scripts, state, script, scene_index, agent_index, dt)
        pose = wp.vec3(0.0, 0.0, 0.0)
        steer = float(0.0)
        if bank.script[episode, agent_index][3] == ScriptMotion.RAIL:
            pose = advance_on_rail(bank, roads, scripts, state, script, scene_index, agent_index, speed, dt)
        elif bank.route[episode, agent_index][1] > 1:
            steer = steer_on_route(bank, roads, state, scene_index, agent_index, episode, current, 0.0)
        script.goal[scene_index, agent_index] = wp.vec4(pose[0], pose[1], pose[2], speed)
        # pedals for whoever shows or mirrors the agent; here it moves by its goal
        acceleration = (speed - current) / dt
        throttle = wp.clamp(acceleration / wp.max(power[0], 0.1), 0.0, 1.0)
        brake = wp.clamp(-acceleration / wp.max(power[1], 0.1), 0.0, 1.0)
        if speed == 0.0:
            brake = 1.0
        if is_walker:
            throttle = speed / wp.max(power[2], 0.1)
            brake = 0.0
        state.control[scene_index, agent_index] = wp.vec4(throttle, brake, steer, 0.0)


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
    scene_index = wp.tid()
    if state.end[scene_index] != End.RUNNING:
        return
    episode = state.episode[scene_index]
    table = scripts.episode[episode]
    if table[1] > 0:
        begins = int(1)
        while begins == 1:
            begins = begin_all(bank, roads, scripts, state, script, scene_index, agents, dt)
    for agent_index in range(agents):
        kind = bank.script[episode, agent_index][3]
        if (kind == ScriptMotion.STEERED or kind == ScriptMotion.RAIL) and state.active[
            scene_index, agent_index
        ] == Presence.AWAKE:
            run_one(bank, roads, scripts, state, script, scene_index, agent_index, dt)


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
    scene_index = wp.tid()
    restarts = mask[scene_index] == 1
    if ended_too == 1 and state.end[scene_index] != End.RUNNING:
        restarts = True
    if not restarts:
        return
    for phase in range(phases):
        script.begun[scene_index, phase] = 0
        script.ended[scene_index, phase] = 0
    for word in range(words):
        script.history[scene_index, word] = 0
    episode = state.episode[scene_index]
    for agent_index in range(agents):
        script.running[scene_index, agent_index] = wp.vec2i(0, 0)
        script.course[scene_index, agent_index] = wp.vec4(0.0, 0.0, 0.0, 0.0)
        script.swerve[scene_index, agent_index] = wp.vec4(0.0, 0.0, 0.0, 0.0)
        script.goal[scene_index, agent_index] = wp.vec4(0.0, 0.0, 0.0, 0.0)
        rail = wp.vec2(0.0, 0.0)
        route = bank.route[episode, agent_index]
        if bank.script[episode, agent_index][3] == ScriptMotion.RAIL and route[1] > 1:
            start = bank.start[episode, agent_index]
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
            offset_x = start[0] - point[0]
            offset_y = start[1] - point[1]
            rail = wp.vec2(float(nearest) + cosine * offset_x + sine * offset_y, cosine * offset_y - sine * offset_x)
        script.rail[scene_index, agent_index] = rail
