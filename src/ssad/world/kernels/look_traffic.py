"""What the shipped learned drivers look at: the road ahead, who will be on it, and who is near, as numbers around 1."""

import warp as wp

from ssad.core.types import AgentKind
from ssad.world.kernels.data import EpisodeArrays, Presence, Roads, State
from ssad.world.kernels.shared import route_at, wrap

TRAFFIC = 69  # numbers in a row: 7 own, 6 x 2 of the road, 5 x 2 of who will be on it, 5 x 8 of who is near
NEAR = wp.constant(5)  # agents with a row of their own
SIGHT = wp.constant(50.0)  # m
BESIDE = wp.constant(1.5)  # m from the route's middle within which a body is on it: half an ego and a little air
STATIONS = wp.constant(25)  # points along the route, 2 m apart
TURN = wp.constant(1.0)  # rad/s: nobody is expected to turn faster

vec5 = wp.types.vector(length=5, dtype=wp.float32)


@wp.func
def beside(pose: wp.vec3, half_length: float, half_width: float, x: float, y: float) -> float:
    """Metres from a point to a body's outline; 0 inside."""
    c = wp.cos(pose[2])
    s = wp.sin(pose[2])
    dx = x - pose[0]
    dy = y - pose[1]
    along = wp.max(wp.abs(dx * c + dy * s) - half_length, 0.0)
    across = wp.max(wp.abs(dy * c - dx * s) - half_width, 0.0)
    return wp.sqrt(along * along + across * across)


@wp.func
def expected(pose: wp.vec3, speed: float, rate: float, time: float) -> wp.vec3:
    """Where somebody is after `time` s who keeps its speed and its rate of turn."""
    mean = pose[2] + 0.5 * rate * time
    x = pose[0] + speed * time * wp.cos(mean)
    y = pose[1] + speed * time * wp.sin(mean)
    return wp.vec3(x, y, pose[2] + rate * time)


@wp.func
def rank(pose: wp.vec3, q: wp.vec3) -> float:
    """Metres to somebody; who is behind matters less, and counts as twice as far."""
    dx = q[0] - pose[0]
    dy = q[1] - pose[1]
    far = wp.sqrt(dx * dx + dy * dy)
    if wp.cos(pose[2]) * dx + wp.sin(pose[2]) * dy < -3.0:
        far = 2.0 * far
    return far


@wp.kernel(enable_backward=False)
def look_at_traffic(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    agents: int,
    who: wp.array(dtype=wp.vec2i),
    dt: float,
    out: wp.array2d(dtype=wp.float32),
):
    """Write rows [N, 69] of the agents `who` (scene, agent); see `ssad.world.sensors.SENSORS`."""
    n = wp.tid()
    b = who[n][0]
    i = who[n][1]
    e = state.episode[b]
    pose = state.pose[b, i]
    c = wp.cos(pose[2])
    s = wp.sin(pose[2])
    route = bank.route[e, i]
    at = float(state.progress[b, i])
    rest = float(SIGHT)
    offset = float(0.0)
    error = float(0.0)
    if route[1] > 1:
        p = roads.path[route[0] + state.progress[b, i]]
        at = at + (pose[0] - p[0]) * wp.cos(p[2]) + (pose[1] - p[1]) * wp.sin(p[2])
        offset = -wp.sin(p[2]) * (pose[0] - p[0]) + wp.cos(p[2]) * (pose[1] - p[1])
        error = wrap(pose[2] - p[2])
        rest = wp.clamp(float(route[1] - 1) - at, 0.0, SIGHT)
    out[n, 0] = state.speed[b, i] / 10.0
    out[n, 1] = state.accel[b, i] / 5.0
    out[n, 2] = state.wheel[b, i] / 0.5
    out[n, 3] = state.cruise[b, i] / 10.0
    out[n, 4] = wp.clamp(offset / 2.0, -5.0, 5.0)
    out[n, 5] = error
    out[n, 6] = rest / SIGHT
    for k in range(6):
        ahead = float(4 * (k + 1))
        if k > 2:
            ahead = float(18 + 8 * (k - 3))
        x = ahead
        y = float(0.0)
        if route[1] > 1:
            q = route_at(roads, route[0], route[1], at + ahead)
            x = c * (q[0] - pose[0]) + s * (q[1] - pose[1])
            y = -s * (q[0] - pose[0]) + c * (q[1] - pose[1])
        out[n, 7 + 2 * k] = x / 20.0
        out[n, 8 + 2 * k] = y / 20.0
    gap = vec5()
    flow = vec5()
    for t in range(5):
        gap[t] = SIGHT
    for j in range(agents):
        if j != i and state.active[b, j] != Presence.ABSENT:
            q = state.pose[b, j]
            x = c * (q[0] - pose[0]) + s * (q[1] - pose[1])
            y = -s * (q[0] - pose[0]) + c * (q[1] - pose[1])
            far = wp.sqrt(x * x + y * y)
            turn = wrap(q[2] - pose[2])
            # who follows on the same way is not going to be ahead
            follows = x < 0.0 and wp.abs(y) < 2.0 and wp.cos(turn) > 0.5
            if route[1] > 1 and far < 2.0 * SIGHT and not follows:
                body = bank.body[bank.model[e, j]]
                speed = state.speed[b, j]
                rate = wp.clamp(wrap(q[2] - state.previous[b, j][2]) / dt, -TURN, TURN)
                if wp.abs(speed) < 0.1 or state.step[b] == 0:
                    rate = 0.0
                reach = wp.sqrt(body[0] * body[0] + body[1] * body[1]) + BESIDE
                for t in range(5):
                    z = expected(q, speed, rate, float(t))
                    for k in range(STATIONS):
                        there = 2.0 * float(k)
                        if there < gap[t] and there <= rest:
                            r = route_at(roads, route[0], route[1], at + there)
                            dx = z[0] - r[0]
                            dy = z[1] - r[1]
                            if dx * dx + dy * dy < reach * reach and beside(z, body[0], body[1], r[0], r[1]) < BESIDE:
                                gap[t] = there
                                flow[t] = speed * wp.cos(z[2] - r[2])
    for t in range(5):
        out[n, 19 + 2 * t] = gap[t] / SIGHT
        out[n, 20 + 2 * t] = flow[t] / 10.0
    last = float(-1.0)
    for k in range(NEAR):
        best = float(SIGHT)
        nearest = int(-1)
        for j in range(agents):
            if j != i and state.active[b, j] != Presence.ABSENT:
                far = rank(pose, state.pose[b, j])
                if far > last and far < best:
                    best = far
                    nearest = j
        last = best
        to = 29 + 8 * k
        for m in range(8):
            out[n, to + m] = 0.0
        if nearest >= 0:
            q = state.pose[b, nearest]
            m = bank.model[e, nearest]
            body = bank.body[m]
            turn = wrap(q[2] - pose[2])
            out[n, to] = (c * (q[0] - pose[0]) + s * (q[1] - pose[1])) / 25.0
            out[n, to + 1] = (-s * (q[0] - pose[0]) + c * (q[1] - pose[1])) / 25.0
            out[n, to + 2] = wp.cos(turn)
            out[n, to + 3] = wp.sin(turn)
            out[n, to + 4] = state.speed[b, nearest] / 10.0
            out[n, to + 5] = body[0] / 2.5
            out[n, to + 6] = body[1]
            if bank.kind[m] >= AgentKind.MOTORCYCLE and bank.kind[m] <= AgentKind.WALKER:
                out[n, to + 7] = 1.0
