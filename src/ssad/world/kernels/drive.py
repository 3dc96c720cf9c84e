"""Who drives how: Autopilot (sees everything, yields), route follower (sees nothing), scripted phases.

The Autopilot is the background traffic and the ego baseline alike; how it reacts to others is in `traffic`.
"""

import warp as wp

from ssad.core.types import AgentKind, Controller
from ssad.world.kernels.data import FAR, REGISTERS, End, EpisodeArrays, Presence, Roads, Seen, State, When
from ssad.world.kernels.lanes import changes, metres_left, way_slope
from ssad.world.kernels.shared import IDM_ACCEL, boxes_touch, row, wrap


@wp.func
def idm_free(v: float, target: float) -> float:
    """IDM's free-road term, m/s^2; above the target speed a firm, bounded return to it."""
    if v > target:
        return wp.max(-2.0 * (v - target), -4.0)
    r = v / wp.max(target, 0.1)
    return IDM_ACCEL * (1.0 - r * r * r * r)


@wp.func
def condition_holds(state: State, b: int, i: int, when: wp.vec3, dt: float) -> bool:
    """Whether a phase may begin; when: `When`, value, agent."""
    kind = int(when[0])
    ok = kind == When.ALWAYS
    if kind == When.EGO_DISTANCE:
        p = state.pose[b, 0]
        q = state.pose[b, int(when[2])]
        ok = wp.length(wp.vec2(p[0] - q[0], p[1] - q[1])) < when[1]
    elif kind == When.EGO_SPEED:
        ok = state.speed[b, 0] > when[1]
    elif kind == When.TRAVELLED:
        ok = state.travelled[b, i] > when[1]
    elif kind == When.TIME:
        ok = float(state.step[b]) * dt >= when[1] - 1.0e-4
    elif kind == When.AFTER:
        ok = float(state.step[b] - state.since[b, i]) * dt >= when[1] - 1.0e-4
    return ok


@wp.func
def steer_on_route(bank: EpisodeArrays, roads: Roads, state: State, b: int, i: int, e: int, v: float) -> float:
    """Steering in [-1, 1]: curvature of the route a moment ahead, corrected critically damped in distance."""
    route = bank.route[e, i]
    at = state.progress[b, i]
    p = row(roads.path, route[0] + at)
    pose = state.pose[b, i]
    c = wp.cos(p[2])
    s = wp.sin(p[2])
    dx = pose[0] - p[0]
    dy = pose[1] - p[1]
    part = c * dx + s * dy
    left = c * dy - s * dx - 0.5 * p[3] * part * part
    v0 = wp.max(v, 0.0)
    here = wp.clamp(at + int(wp.floor(part + 0.15 * v0 + 0.5)), 0, route[1] - 1)
    k_ref = roads.path[route[0] + here][3]
    shift = state.shift[b, i]
    u = float(at) + part
    if changes(shift):
        left = left - metres_left(roads, route[0], route[1], shift, u)
        then = u + 0.15 * v0
        more = way_slope(roads, route[0], route[1], shift, then + 0.5)
        k_ref = k_ref + more - way_slope(roads, route[0], route[1], shift, then - 0.5)
    body = bank.body[bank.model[e, i]]
    # on the path the body lags by the slip of its curvature; taking the present slip would feed back on itself
    slip = wp.asin(wp.clamp(0.5 * k_ref * body[2], -0.95, 0.95))
    yaw = p[2] + p[3] * (part + 0.1 * v0)
    if changes(shift):
        yaw = yaw + wp.atan(way_slope(roads, route[0], route[1], shift, u + 0.1 * v0))
    off = wp.clamp(wrap(pose[2] + slip - yaw), -1.2, 1.2)
    soft = 1.0 / (1.0 + 0.05 * v * v / 10.0)
    k = k_ref - 0.25 * soft * wp.clamp(left, -3.0, 3.0) - 0.9 * soft * off
    # curvature k of the box centre: sin(slip) = k L / 2, tan(wheel) = 2 tan(slip)
    sine = wp.clamp(0.5 * k * body[2], -0.95, 0.95)
    wheel = wp.atan(2.0 * sine / wp.sqrt(1.0 - sine * sine))
    return wp.clamp(wheel / wp.max(body[3], 1.0e-3), -1.0, 1.0)


@wp.func
def room_behind(seen: Seen, b: int, i: int, from_row: int, to_row: int) -> bool:
    """Whether nobody in these rows of `seen` is within a metre and a half behind a vehicle."""
    pose = seen.pose[b, i]
    own = seen.half[b, i]
    back = wp.vec3(pose[0] - 1.5 * wp.cos(pose[2]), pose[1] - 1.5 * wp.sin(pose[2]), pose[2])
    free = int(1)
    for j in range(from_row, to_row):
        if j != i and seen.kind[b, j] != AgentKind.NONE:
            q = seen.pose[b, j]
            other = seen.half[b, j]
            near = wp.length(wp.vec2(q[0] - back[0], q[1] - back[1])) < own[0] + other[0] + 3.0
            ahead = (q[0] - pose[0]) * wp.cos(pose[2]) + (q[1] - pose[1]) * wp.sin(pose[2])
            if near and ahead < 0.5 * own[0] and boxes_touch(back, own[0] + 0.3, own[1] + 0.3, q, other[0], other[1]):
                free = 0
    return free == 1


@wp.func
def drive_one(
    bank: EpisodeArrays, roads: Roads, state: State, seen: Seen, b: int, i: int, agents: int, rows: int, dt: float
):
    """Controls of an agent that is not external."""
    if state.active[b, i] == Presence.ABSENT:
        return
    e = state.episode[b]
    m = bank.model[e, i]
    who = state.controller[b, i]
    v = state.speed[b, i]
    if state.active[b, i] == Presence.ASLEEP:
        state.control[b, i] = wp.vec4(0.0, 1.0, 0.0, 0.0)
        return
    power = bank.power[m]
    target = state.cruise[b, i]
    count = bank.phase_count[e, i]
    if count > 0:
        n = state.phase[b, i]
        go = int(1)
        while n < count and go == 1:
            if condition_holds(state, b, i, bank.phase_when[e, i, n], dt):
                n = n + 1
                state.since[b, i] = 0
                if n < count and int(bank.phase_when[e, i, n][0]) == When.AFTER:
                    state.since[b, i] = state.step[b]
            else:
                go = 0
        state.phase[b, i] = n
        if n > 0:
            target = bank.phase_speed[e, i, n - 1]
        elif who == Controller.SCRIPT:
            target = 0.0
    if who == Controller.NONE:
        state.control[b, i] = wp.vec4(0.0, 1.0, 0.0, 0.0)
    elif who == Controller.SCRIPT:
        if count == 0:
            target = 0.0
        steer = float(0.0)
        if bank.route[e, i][1] > 1:
            steer = steer_on_route(bank, roads, state, b, i, e, v)
        throttle = float(0.0)
        brake = float(1.0)
        if bank.kind[m] == AgentKind.WALKER:
            throttle = target / power[2]
            brake = 0.0
        elif target > 0.0 and v <= target:
            throttle = 1.0
            brake = 0.0
        state.control[b, i] = wp.vec4(throttle, brake, steer, 0.0)
    elif who == Controller.AUTOPILOT or who == Controller.FOLLOW:
        steer = float(0.0)
        accel = float(0.0)
        if bank.route[e, i][1] > 1:
            steer = steer_on_route(bank, roads, state, b, i, e, v)
        if who == Controller.AUTOPILOT:
            free = idm_free(v, state.aim[b, i][1])
            accel = wp.min(free, state.react[b, i])
            if free > 0.0:
                accel = free + state.react[b, i]  # IDM: both terms add
        else:
            cap = roads.rule[bank.route[e, i][0] + state.progress[b, i]][0]
            aim = wp.min(target, cap)
            accel = wp.clamp(2.0 * (aim - v), -power[1], power[0])
        throttle = wp.clamp(accel / wp.max(power[0], 0.1), 0.0, 1.0)
        brake = wp.clamp(-accel / wp.max(power[1], 0.1), 0.0, 1.0)
        if v < 0.2 and accel <= 0.0:
            brake = 1.0
        state.control[b, i] = wp.vec4(throttle, brake, steer, 0.0)
        if who == Controller.AUTOPILOT and state.stalled[b, i] == 1 and v < 0.3:
            from_row = int(0)
            to_row = agents
            if i == 0 and seen.believes[b] == 1:
                from_row = agents
                to_row = rows
            if room_behind(seen, b, i, from_row, to_row):
                throttle = 0.0
                if v > -1.0:
                    throttle = 0.4
                state.control[b, i] = wp.vec4(throttle, 0.0, 0.0, 1.0)
    if v < 0.3:
        state.waited[b, i] = state.waited[b, i] + dt
    elif v > 3.0:
        # who stopped before a junction has stopped for it until it is behind
        junction = FAR
        if bank.route[e, i][1] > 1:
            junction = roads.rule[bank.route[e, i][0] + state.progress[b, i]][2]
        if junction > 10.0:
            state.waited[b, i] = 0.0


@wp.kernel(enable_backward=False, cuda_max_registers=REGISTERS)
def drive(bank: EpisodeArrays, roads: Roads, state: State, seen: Seen, agents: int, rows: int, threads: int, dt: float):
    """Controls of every agent that is not external, from the state of all at the start of the step."""
    b, first = wp.tid()
    if state.end[b] == End.RUNNING:
        for i in range(first, agents, threads):
            drive_one(bank, roads, state, seen, b, i, agents, rows, dt)
