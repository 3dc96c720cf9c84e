"""One step of motion: kinematic bicycle with actuator limits, walkers, progress along routes."""

import warp as wp

from ssad.core.types import AgentKind, Controller
from ssad.world.kernels.data import (
    REGISTERS_OF_MOTION,
    End,
    EpisodeArrays,
    Presence,
    Roads,
    ScriptMotion,
    ScriptState,
    State,
)
from ssad.world.kernels.shared import lane_under, on_track, row, sign_line, track_at, wrap
from ssad.world.models import REVERSE_SPEED, STEER_TIME, WALKER_RATE

vec6 = wp.types.vector(length=6, dtype=wp.float32)
STEER_SECONDS = wp.constant(STEER_TIME)
REVERSE_LIMIT = wp.constant(REVERSE_SPEED)
STOPPED = wp.constant(0.3)  # m/s: slower, a vehicle has stopped
BEFORE_LINE = wp.constant(4.0)  # m from the front to the line within which a stop at a stop sign counts
WALKER_TURN = wp.constant(WALKER_RATE)


@wp.func
def bicycle(
    pose: wp.vec3,
    speed: float,
    wheel: float,
    braking: float,
    control: wp.vec4,
    body: wp.vec4,
    power: wp.vec4,
    surface: wp.vec3,
    dt: float,
    n: int,
) -> vec6:
    """`n` sub-steps of the kinematic bicycle about the box centre (rear share 1/2): x, y, yaw, speed, wheel, braking.

    Throttle gives up to power[0], brake up to power[1] against the motion, neither more than surface[0]. The brake
    rises linearly to its demand in power[3] seconds and is released at once. The wheel turns at its limited rate to
    steer * body[3]; yaw rate is cut at lateral acceleration surface[1].
    """
    substep = dt / float(n)
    x = pose[0]
    y = pose[1]
    yaw = pose[2]
    new_speed = speed
    wheel_angle = wheel
    brake_level = braking
    throttle = wp.clamp(control[0], 0.0, 1.0)
    brake = wp.clamp(control[1], 0.0, 1.0)
    wheel_target = wp.clamp(control[2], -1.0, 1.0) * body[3]
    turn = body[3] * substep / STEER_SECONDS
    for _ in range(n):
        wheel_angle = wheel_angle + wp.clamp(wheel_target - wheel_angle, -turn, turn)
        acceleration = wp.min(throttle * power[0], surface[0])
        if control[3] > 0.5:
            acceleration = -acceleration
        before = new_speed
        new_speed = new_speed + acceleration * substep
        mean_brake = brake
        if power[3] > 0.0:
            released = wp.min(brake_level, brake)
            brake_level = wp.min(released + brake * substep / power[3], brake)
            mean_brake = 0.5 * (released + brake_level)
        else:
            brake_level = brake
        brake_step = wp.min(mean_brake * power[1], surface[0]) * substep
        if new_speed > 0.0:
            new_speed = wp.max(new_speed - brake_step, 0.0)
        else:
            new_speed = wp.min(new_speed + brake_step, 0.0)
        new_speed = wp.clamp(new_speed, -REVERSE_LIMIT, power[2])
        mean_speed = 0.5 * (before + new_speed)
        slip = wp.atan(0.5 * wp.tan(wheel_angle))
        yaw_rate = mean_speed * wp.sin(slip) * 2.0 / body[2]
        rate_limit = surface[1] / wp.max(wp.abs(mean_speed), 1.0e-3)
        yaw_rate = wp.clamp(yaw_rate, -rate_limit, rate_limit)
        heading = yaw + slip + 0.5 * yaw_rate * substep
        x = x + mean_speed * wp.cos(heading) * substep
        y = y + mean_speed * wp.sin(heading) * substep
        yaw = yaw + yaw_rate * substep
    result = vec6()
    result[0] = x
    result[1] = y
    result[2] = wrap(yaw)
    result[3] = new_speed
    result[4] = wheel_angle
    result[5] = brake_level
    return result


@wp.func
def move_one(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    script: ScriptState,
    action: wp.array2d(dtype=wp.vec4),
    place: wp.array2d(dtype=wp.vec4),
    b: int,
    i: int,
    dt: float,
    substeps: int,
):
    """Advance an agent by dt; see `move`."""
    e = state.episode[b]
    controller = state.controller[b, i]
    target_place = wp.vec4(0.0, 0.0, 0.0, 0.0)
    if controller == Controller.TRAJECTORY:
        time = float(state.step[b] + 1) * dt
        track = bank.track[e, i]
        if on_track(roads, track, time):
            target_place = track_at(roads, track, time)
            if state.active[b, i] == Presence.ABSENT:
                state.pose[b, i] = wp.vec3(target_place[0], target_place[1], target_place[2])
            state.active[b, i] = Presence.AWAKE
        else:
            state.active[b, i] = Presence.ABSENT
    if state.active[b, i] == Presence.ABSENT:
        return
    model = bank.model[e, i]
    pose = state.pose[b, i]
    state.previous[b, i] = pose
    control = state.control[b, i]
    if controller == Controller.EXTERNAL:
        control = action[b, i]
        state.control[b, i] = control
    speed = state.speed[b, i]
    kind = bank.kind[model]
    power = bank.power[model]
    is_scripted = int(0)
    is_placed = controller == Controller.PLACED or controller == Controller.TRAJECTORY
    if controller == Controller.SCRIPT:
        rows = bank.script[e, i]
        if rows[3] != ScriptMotion.NONE and state.active[b, i] == Presence.AWAKE:
            is_scripted = 1
            target_place = script.goal[b, i]
            is_placed = rows[3] >= ScriptMotion.RAIL
    if is_placed:
        if controller == Controller.PLACED:
            target_place = place[b, i]
        distance = wp.length(wp.vec2(target_place[0] - pose[0], target_place[1] - pose[1]))
        state.travelled[b, i] = state.travelled[b, i] + distance
        pose = wp.vec3(target_place[0], target_place[1], wrap(target_place[2]))
        speed = target_place[3]
    elif kind == AgentKind.WALKER:
        # The throttle is the desired speed over the model's top speed; a walker turns and stops at once.
        desired_speed = wp.clamp(control[0], 0.0, 1.0) * power[2]
        change = power[0] * dt
        new_speed = speed + wp.clamp(desired_speed - speed, -change, change)
        if is_scripted == 1:
            new_speed = target_place[3]
        step_length = 0.5 * (speed + new_speed) * dt
        if controller == Controller.EXTERNAL:
            turned = pose[2] + wp.clamp(control[2], -1.0, 1.0) * WALKER_TURN * dt
            pose = wp.vec3(pose[0], pose[1], wrap(turned))
        pose = wp.vec3(pose[0] + step_length * wp.cos(pose[2]), pose[1] + step_length * wp.sin(pose[2]), pose[2])
        state.travelled[b, i] = state.travelled[b, i] + wp.abs(step_length)
        speed = new_speed
    elif power[2] > 0.0:
        surface = bank.surface[e]
        if is_scripted == 1:
            # the speed is the script's: the pedals give this acceleration in the limits of nobody's engine and brakes
            acceleration = (target_place[3] - speed) / dt
            control = wp.vec4(0.0, 1.0, control[2], 0.0)
            if acceleration > 0.0:
                control = wp.vec4(1.0, 0.0, control[2], 0.0)
            power = wp.vec4(wp.abs(acceleration), wp.abs(acceleration), 1.0e3, 0.0)
            surface = wp.vec3(wp.abs(acceleration), surface[1], surface[2])
        if speed != 0.0 or control[0] > 0.0:
            result = bicycle(
                pose,
                speed,
                state.wheel[b, i],
                state.braking[b, i],
                control,
                bank.body[model],
                power,
                surface,
                dt,
                substeps,
            )
            moved = wp.vec3(result[0], result[1], result[2])
            distance = wp.length(wp.vec2(moved[0] - pose[0], moved[1] - pose[1]))
            state.travelled[b, i] = state.travelled[b, i] + distance
            pose = moved
            speed = result[3]
            if is_scripted == 1:
                speed = target_place[3]
            else:
                state.braking[b, i] = result[5]
            state.wheel[b, i] = result[4]
    state.pose[b, i] = pose
    state.accel[b, i] = (speed - state.speed[b, i]) / dt
    state.speed[b, i] = speed

    # nearest route point within 12 m ahead of the last one
    route = bank.route[e, i]
    at = state.progress[b, i]
    if route[1] > 1:
        best_distance2 = float(1.0e12)
        nearest = at
        last = wp.min(at + 12, route[1] - 1)
        candidate = at
        while candidate <= last:
            point = row(roads.path, route[0] + candidate)
            dx = pose[0] - point[0]
            dy = pose[1] - point[1]
            distance2 = dx * dx + dy * dy
            if distance2 < best_distance2:
                best_distance2 = distance2
                nearest = candidate
            # The distance grows again, so the nearest point lies behind.
            elif candidate > nearest + 3:
                candidate = last
            candidate = candidate + 1
        at = nearest
        state.progress[b, i] = at
        if wp.abs(speed) < STOPPED and roads.ahead[route[0] + at][0] < BEFORE_LINE + bank.body[model][0]:
            state.halted[b, i] = sign_line(roads, route[0], at)
        if i > 0 and controller == Controller.AUTOPILOT and at >= route[1] - 3:
            state.active[b, i] = Presence.ABSENT  # background traffic leaves at the end of its route

    lane_info = lane_under(roads, bank.town[e], pose[0], pose[1])
    state.lane[b, i] = int(lane_info[0])
    state.lateral[b, i] = wp.vec2(lane_info[1], lane_info[2])


@wp.kernel(enable_backward=False, cuda_max_registers=REGISTERS_OF_MOTION)
def move(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    script: ScriptState,
    action: wp.array2d(dtype=wp.vec4),
    place: wp.array2d(dtype=wp.vec4),
    agents: int,
    threads: int,
    dt: float,
    substeps: int,
):
    """Advance every agent by dt with its control (external ones with the action) and find the lane under it.

    Agents that are placed are put at `place`: x, y, yaw, speed; those with a trajectory follow it.
    """
    b, first = wp.tid()
    if state.end[b] == End.RUNNING:
        for i in range(first, agents, threads):
            move_one(bank, roads, state, script, action, place, b, i, dt, substeps)
