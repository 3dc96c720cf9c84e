"""One step of motion: kinematic bicycle with actuator limits, walkers, progress along routes."""

import warp as wp

from ssad.core.types import AgentKind, Controller
from ssad.world.kernels.data import REGISTERS_OF_MOTION, End, EpisodeArrays, Presence, Roads, State
from ssad.world.kernels.shared import lane_under, on_track, row, sign_line, track_at, wrap
from ssad.world.models import GRIP, REVERSE_SPEED, STEER_TIME, WALKER_RATE

vec5 = wp.types.vector(length=5, dtype=wp.float32)
GRIP_LIMIT = wp.constant(GRIP)
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
    control: wp.vec4,
    body: wp.vec4,
    power: wp.vec4,
    dt: float,
    n: int,
) -> vec5:
    """`n` sub-steps of the kinematic bicycle about the box centre (rear share 1/2): x, y, yaw, speed, wheel.

    Throttle gives up to power[0], brake up to power[1] against the motion; the wheel turns at its limited rate to
    steer * body[3]; yaw rate is cut at lateral acceleration GRIP_LIMIT.
    """
    h = dt / float(n)
    x = pose[0]
    y = pose[1]
    yaw = pose[2]
    v = speed
    w = wheel
    throttle = wp.clamp(control[0], 0.0, 1.0)
    brake = wp.clamp(control[1], 0.0, 1.0)
    aim = wp.clamp(control[2], -1.0, 1.0) * body[3]
    turn = body[3] * h / STEER_SECONDS
    for _ in range(n):
        w = w + wp.clamp(aim - w, -turn, turn)
        push = throttle * power[0]
        if control[3] > 0.5:
            push = -push
        before = v
        v = v + push * h
        drag = brake * power[1] * h
        if v > 0.0:
            v = wp.max(v - drag, 0.0)
        else:
            v = wp.min(v + drag, 0.0)
        v = wp.clamp(v, -REVERSE_LIMIT, power[2])
        mean = 0.5 * (before + v)
        slip = wp.atan(0.5 * wp.tan(w))
        rate = mean * wp.sin(slip) * 2.0 / body[2]
        cut = GRIP_LIMIT / wp.max(wp.abs(mean), 1.0e-3)
        rate = wp.clamp(rate, -cut, cut)
        heading = yaw + slip + 0.5 * rate * h
        x = x + mean * wp.cos(heading) * h
        y = y + mean * wp.sin(heading) * h
        yaw = yaw + rate * h
    out = vec5()
    out[0] = x
    out[1] = y
    out[2] = wrap(yaw)
    out[3] = v
    out[4] = w
    return out


@wp.func
def move_one(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    action: wp.array2d(dtype=wp.vec4),
    place: wp.array2d(dtype=wp.vec4),
    b: int,
    i: int,
    dt: float,
    substeps: int,
):
    """Advance an agent by dt; see `move`."""
    e = state.episode[b]
    who = state.controller[b, i]
    put = wp.vec4(0.0, 0.0, 0.0, 0.0)
    if who == Controller.TRAJECTORY:
        time = float(state.step[b] + 1) * dt
        track = bank.track[e, i]
        if on_track(roads, track, time):
            put = track_at(roads, track, time)
            if state.active[b, i] == Presence.ABSENT:
                state.pose[b, i] = wp.vec3(put[0], put[1], put[2])
            state.active[b, i] = Presence.AWAKE
        else:
            state.active[b, i] = Presence.ABSENT
    if state.active[b, i] == Presence.ABSENT:
        return
    m = bank.model[e, i]
    pose = state.pose[b, i]
    state.previous[b, i] = pose
    control = state.control[b, i]
    if who == Controller.EXTERNAL:
        control = action[b, i]
        state.control[b, i] = control
    speed = state.speed[b, i]
    kind = bank.kind[m]
    power = bank.power[m]
    if who == Controller.PLACED or who == Controller.TRAJECTORY:
        if who == Controller.PLACED:
            put = place[b, i]
        d = wp.length(wp.vec2(put[0] - pose[0], put[1] - pose[1]))
        state.travelled[b, i] = state.travelled[b, i] + d
        pose = wp.vec3(put[0], put[1], wrap(put[2]))
        speed = put[3]
    elif kind == AgentKind.WALKER:
        # throttle is the wanted speed over the model's top speed; a walker turns and stops at once
        aim = wp.clamp(control[0], 0.0, 1.0) * power[2]
        change = power[0] * dt
        after = speed + wp.clamp(aim - speed, -change, change)
        go = 0.5 * (speed + after) * dt
        if who == Controller.EXTERNAL:
            turned = pose[2] + wp.clamp(control[2], -1.0, 1.0) * WALKER_TURN * dt
            pose = wp.vec3(pose[0], pose[1], wrap(turned))
        pose = wp.vec3(pose[0] + go * wp.cos(pose[2]), pose[1] + go * wp.sin(pose[2]), pose[2])
        state.travelled[b, i] = state.travelled[b, i] + wp.abs(go)
        speed = after
    elif power[2] > 0.0:
        if speed != 0.0 or control[0] > 0.0:
            out = bicycle(pose, speed, state.wheel[b, i], control, bank.body[m], power, dt, substeps)
            moved = wp.vec3(out[0], out[1], out[2])
            d = wp.length(wp.vec2(moved[0] - pose[0], moved[1] - pose[1]))
            state.travelled[b, i] = state.travelled[b, i] + d
            pose = moved
            speed = out[3]
            state.wheel[b, i] = out[4]
    state.pose[b, i] = pose
    state.accel[b, i] = (speed - state.speed[b, i]) / dt
    state.speed[b, i] = speed

    # nearest route point within 12 m ahead of the last one
    route = bank.route[e, i]
    at = state.progress[b, i]
    if route[1] > 1:
        best = float(1.0e12)
        found = at
        last = wp.min(at + 12, route[1] - 1)
        k = at
        while k <= last:
            p = row(roads.path, route[0] + k)
            dx = pose[0] - p[0]
            dy = pose[1] - p[1]
            d2 = dx * dx + dy * dy
            if d2 < best:
                best = d2
                found = k
            elif k > found + 3:
                k = last
            k = k + 1
        at = found
        state.progress[b, i] = at
        if wp.abs(speed) < STOPPED and roads.ahead[route[0] + at][0] < BEFORE_LINE + bank.body[m][0]:
            state.halted[b, i] = sign_line(roads, route[0], at)
        if i > 0 and who == Controller.AUTOPILOT and at >= route[1] - 3:
            state.active[b, i] = Presence.ABSENT  # background traffic leaves at the end of its route

    under = lane_under(roads, bank.town[e], pose[0], pose[1])
    state.lane[b, i] = int(under[0])
    state.lateral[b, i] = wp.vec2(under[1], under[2])


@wp.kernel(enable_backward=False, cuda_max_registers=REGISTERS_OF_MOTION)
def move(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    action: wp.array2d(dtype=wp.vec4),
    place: wp.array2d(dtype=wp.vec4),
    agents: int,
    threads: int,
    dt: float,
    substeps: int,
):
    """Advance every agent by dt with its control (external ones with the action) and look where it is now.

    Agents that are placed are put at `place`: x, y, yaw, speed; those with a trajectory where it has them.
    """
    b, first = wp.tid()
    if state.end[b] == End.RUNNING:
        for i in range(first, agents, threads):
            move_one(bank, roads, state, action, place, b, i, dt, substeps)
