"""Controllers: Autopilot (perceives everything, yields) and route follower (perceives nothing).

The Autopilot is the background traffic and the ego baseline alike; its reactions to others are in `traffic`. Scripts
are in `script`.
"""

import warp as wp

from ssad.core.types import AgentKind, Controller
from ssad.world.kernels.data import (
    FAR,
    REGISTERS,
    End,
    EpisodeArrays,
    PerceivedAgents,
    Presence,
    Roads,
    ScriptMotion,
    State,
)
from ssad.world.kernels.drivers import (
    FIRM,
    HARDEST,
    NOTICES,
    RELAXES,
    delay,
    driver_accelerates,
    driver_power,
    is_lapsed,
    lane_place,
    looks_at_crossing,
    pedal_change,
)
from ssad.world.kernels.lanes import is_changing_lane, metres_left, way_slope
from ssad.world.kernels.shared import IDM_ACCEL, boxes_touch, lane_under, row, wrap

MOVES = wp.constant(0.5)  # m/s
BACK_STEP = wp.constant(1.0)  # m
BEHIND = wp.constant(20.0)  # m
HALTED = wp.constant(0.1)  # m/s
NOTICED = wp.constant(0.5)  # m/s^2 of a change of demand that a driver has to react to
STARTS = wp.constant(0.15)  # m/s^2: for less nobody starts
SHOCK = wp.constant(2.0)  # m/s^2 of it to which also one who brakes has to react
EASES = wp.constant(0.4)  # m/s^2 of braking at the very end of a stop


@wp.func
def idm_free(v: float, target: float) -> float:
    """Return IDM's free-road term, m/s^2; above the target speed a firm, bounded return to it."""
    if v > target:
        return wp.max(-2.0 * (v - target), -4.0)
    ratio = v / wp.max(target, 0.1)
    return IDM_ACCEL * (1.0 - ratio * ratio * ratio * ratio)


@wp.func
def steer_on_route(
    bank: EpisodeArrays, roads: Roads, state: State, b: int, i: int, e: int, v: float, aside: float
) -> float:
    """Return steering in [-1, 1]: the route's curvature slightly ahead, corrected critically damped in distance.

    aside: m left of the route on which to drive.
    """
    route = bank.route[e, i]
    at = state.progress[b, i]
    point = row(roads.path, route[0] + at)
    pose = state.pose[b, i]
    c = wp.cos(point[2])
    s = wp.sin(point[2])
    dx = pose[0] - point[0]
    dy = pose[1] - point[1]
    offset = c * dx + s * dy
    lateral = c * dy - s * dx - 0.5 * point[3] * offset * offset - aside
    # In reverse nothing is previewed.
    forward_speed = wp.max(v, 0.0)
    reference = wp.clamp(at + int(wp.floor(offset + 0.15 * forward_speed + 0.5)), 0, route[1] - 1)
    reference_curvature = roads.path[route[0] + reference][3]
    shift = state.shift[b, i]
    along = float(at) + offset
    if is_changing_lane(shift):
        lateral = lateral - metres_left(roads, route[0], route[1], shift, along)
        preview = along + 0.15 * forward_speed
        slope_ahead = way_slope(roads, route[0], route[1], shift, preview + 0.5)
        reference_curvature = (
            reference_curvature + slope_ahead - way_slope(roads, route[0], route[1], shift, preview - 0.5)
        )
    body = bank.body[bank.model[e, i]]
    # on the path the body lags by the slip of its curvature; taking the present slip would feed back on itself
    slip = wp.asin(wp.clamp(0.5 * reference_curvature * body[2], -0.95, 0.95))
    yaw = point[2] + point[3] * (offset + 0.1 * forward_speed)
    if is_changing_lane(shift):
        yaw = yaw + wp.atan(way_slope(roads, route[0], route[1], shift, along + 0.1 * forward_speed))
    heading_error = wp.clamp(wrap(pose[2] + slip - yaw), -1.2, 1.2)
    softening = 1.0 / (1.0 + 0.05 * v * v / 10.0)
    curvature = reference_curvature - 0.25 * softening * wp.clamp(lateral, -3.0, 3.0) - 0.9 * softening * heading_error
    # curvature k of the box centre: sin(slip) = k L / 2, tan(wheel) = 2 tan(slip)
    slip_sine = wp.clamp(0.5 * curvature * body[2], -0.95, 0.95)
    wheel = wp.atan(2.0 * slip_sine / wp.sqrt(1.0 - slip_sine * slip_sine))
    return wp.clamp(wheel / wp.max(body[3], 1.0e-3), -1.0, 1.0)


@wp.func
def driven_acceleration(
    bank: EpisodeArrays, roads: Roads, state: State, b: int, i: int, e: int, style: wp.vec4, dt: float
) -> float:
    """Return the acceleration to which a driver of the population comes in this step, m/s^2."""
    speed = state.speed[b, i]
    manner = bank.manner[e, i]
    last = state.accel[b, i]
    pending = state.pending[b, i][0]
    # predictions flicker from step to step: a driver sees them as one
    reaction = state.pending[b, i][1]
    asked = wp.max(state.react[b, i], -HARDEST)
    if asked < reaction:
        reaction = reaction + NOTICES * (asked - reaction)
    elif looks_at_crossing(state, b, i):
        reaction = reaction + RELAXES * (asked - reaction)
    demand = wp.min(driver_accelerates(speed, state.aim[b, i][1], style), driver_power(speed, style) + reaction)
    junction = roads.rule[bank.route[e, i][0] + state.progress[b, i]][2]
    if speed < HALTED:
        if demand <= STARTS:
            pending = 0.0
            demand = wp.min(demand, -STARTS)
        elif pending < manner[2]:
            pending = pending + dt
            demand = -style[3]
    elif demand < last - NOTICED and (last > -NOTICED or demand < last - SHOCK):
        # the foot leaves the throttle at once, and then reaches the brake
        if pending < delay(manner[2], speed, junction):
            pending = pending + dt
            demand = wp.min(last, 0.0)
    else:
        pending = 0.0
    if speed > HALTED and is_lapsed(bank.habit[e, i], float(state.step[b]) * dt):
        demand = wp.max(demand, last)
    state.pending[b, i] = wp.vec2(pending, reaction)
    if speed < 1.5 and demand > -FIRM:
        demand = wp.max(demand, -EASES - speed)  # comes to rest without a jolt
    accel = pedal_change(demand, last, manner[1], dt)
    if speed < HALTED and demand <= 0.0:
        accel = demand
    if speed < 0.0:
        accel = -style[3]  # the brake ends a way back
    return accel


@wp.func
def room_behind(perceived: PerceivedAgents, b: int, i: int, from_row: int, to_row: int) -> bool:
    """Return whether no agent in these rows of `perceived` is within a metre and a half behind a vehicle."""
    pose = perceived.pose[b, i]
    own_half = perceived.half[b, i]
    pose_behind = wp.vec3(pose[0] - 1.5 * wp.cos(pose[2]), pose[1] - 1.5 * wp.sin(pose[2]), pose[2])
    free = int(1)
    for j in range(from_row, to_row):
        if j != i and perceived.kind[b, j] != AgentKind.NONE:
            other_pose = perceived.pose[b, j]
            other_half = perceived.half[b, j]
            near = (
                wp.length(wp.vec2(other_pose[0] - pose_behind[0], other_pose[1] - pose_behind[1]))
                < own_half[0] + other_half[0] + 3.0
            )
            ahead = (other_pose[0] - pose[0]) * wp.cos(pose[2]) + (other_pose[1] - pose[1]) * wp.sin(pose[2])
            if (
                near
                and ahead < 0.5 * own_half[0]
                and boxes_touch(
                    pose_behind, own_half[0] + 0.3, own_half[1] + 0.3, other_pose, other_half[0], other_half[1]
                )
            ):
                free = 0
    return free == 1


@wp.func
def may_back_out(
    roads: Roads, perceived: PerceivedAgents, b: int, i: int, town: int, from_row: int, to_row: int
) -> bool:
    """Return whether a vehicle stays on the road if it backs out, and nobody moves in the half circle behind it."""
    pose = perceived.pose[b, i]
    c = wp.cos(pose[2])
    s = wp.sin(pose[2])
    may = lane_under(roads, town, pose[0] - BACK_STEP * c, pose[1] - BACK_STEP * s)[0] >= 0.0
    for j in range(from_row, to_row):
        if j != i and perceived.kind[b, j] != AgentKind.NONE and wp.abs(perceived.speed[b, j]) > MOVES:
            dx = perceived.pose[b, j][0] - pose[0]
            dy = perceived.pose[b, j][1] - pose[1]
            if dx * c + dy * s < 0.0 and dx * dx + dy * dy < BEHIND * BEHIND:
                may = bool(False)
    return may


@wp.func
def drive_one(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    perceived: PerceivedAgents,
    b: int,
    i: int,
    agents: int,
    rows: int,
    dt: float,
):
    """Compute the controls of an agent that is not external."""
    if state.active[b, i] == Presence.ABSENT:
        return
    e = state.episode[b]
    model = bank.model[e, i]
    controller = state.controller[b, i]
    speed = state.speed[b, i]
    if state.active[b, i] == Presence.ASLEEP:
        state.control[b, i] = wp.vec4(0.0, 1.0, 0.0, 0.0)
        return
    power = bank.power[model]
    target = state.cruise[b, i]
    if controller == Controller.NONE:
        state.control[b, i] = wp.vec4(0.0, 1.0, 0.0, 0.0)
    elif controller == Controller.SCRIPT:
        if bank.script[e, i][3] == ScriptMotion.NONE:  # `run_scripts` drives the others
            state.control[b, i] = wp.vec4(0.0, 1.0, 0.0, 0.0)
    elif controller == Controller.AUTOPILOT or controller == Controller.FOLLOW:
        steer = float(0.0)
        accel = float(0.0)
        style = bank.style[e, i]
        has_driver = controller == Controller.AUTOPILOT and style[0] > 0.0
        if bank.route[e, i][1] > 1:
            aside = float(0.0)
            if has_driver:
                aside = lane_place(bank.habit[e, i], float(state.step[b]) * dt)
            steer = steer_on_route(bank, roads, state, b, i, e, speed, aside)
        if has_driver:
            accel = driven_acceleration(bank, roads, state, b, i, e, style, dt)
        elif controller == Controller.AUTOPILOT:
            free = idm_free(speed, state.aim[b, i][1])
            accel = wp.min(free, state.react[b, i])
            if free > 0.0:
                accel = free + state.react[b, i]  # IDM: both terms add
        else:
            speed_cap = roads.rule[bank.route[e, i][0] + state.progress[b, i]][0]
            target_speed = wp.min(target, speed_cap)
            accel = wp.clamp(2.0 * (target_speed - speed), -power[1], power[0])
        throttle = wp.clamp(accel / wp.max(power[0], 0.1), 0.0, 1.0)
        brake = wp.clamp(-accel / wp.max(power[1], 0.1), 0.0, 1.0)
        if speed < 0.2 and accel <= 0.0 and not has_driver:
            brake = 1.0  # drivers of the population come to rest without a jolt
        state.control[b, i] = wp.vec4(throttle, brake, steer, 0.0)
        if controller == Controller.AUTOPILOT and state.stalled[b, i] == 1 and speed < 0.3:
            from_row = int(0)
            to_row = agents
            if i == 0 and perceived.believes[b] == 1:
                from_row = agents
                to_row = rows
            if room_behind(perceived, b, i, from_row, to_row) and (
                not has_driver or may_back_out(roads, perceived, b, i, bank.town[e], from_row, to_row)
            ):
                throttle = 0.0
                if speed > -1.0:
                    throttle = 0.4
                state.control[b, i] = wp.vec4(throttle, 0.0, 0.0, 1.0)
    if speed < 0.3:
        state.waited[b, i] = state.waited[b, i] + dt
    elif speed > 3.0:
        # A vehicle that stopped before a junction counts as stopped for it until it has passed it.
        junction = FAR
        if bank.route[e, i][1] > 1:
            junction = roads.rule[bank.route[e, i][0] + state.progress[b, i]][2]
        if junction > 10.0:
            state.waited[b, i] = 0.0


@wp.kernel(enable_backward=False, cuda_max_registers=REGISTERS)
def drive(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    perceived: PerceivedAgents,
    agents: int,
    rows: int,
    threads: int,
    dt: float,
):
    """Compute the controls of every agent that is not external, from the state of all at the start of the step."""
    b, first = wp.tid()
    if state.end[b] == End.RUNNING:
        for i in range(first, agents, threads):
            drive_one(bank, roads, state, perceived, b, i, agents, rows, dt)
