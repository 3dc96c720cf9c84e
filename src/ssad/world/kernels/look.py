"""Observations of the ego for learning: SafeBench's four numbers and FREA's 4 x 6 rows."""

import warp as wp

from ssad.core.types import AgentKind
from ssad.world.kernels.data import Ego, EpisodeArrays, Presence, Roads, State
from ssad.world.kernels.shared import wrap

OBSERVATION = 28  # numbers in a row of `look`


@wp.func
def put(
    out: wp.array2d(dtype=wp.float32),
    b: int,
    at: int,
    x: float,
    y: float,
    l: float,
    w: float,
    r: float,
    v: float,
):
    """One row of six numbers."""
    out[b, at + 0] = x
    out[b, at + 1] = y
    out[b, at + 2] = l
    out[b, at + 3] = w
    out[b, at + 4] = r
    out[b, at + 5] = v


@wp.func
def put_agent(
    bank: EpisodeArrays,
    state: State,
    out: wp.array2d(dtype=wp.float32),
    b: int,
    e: int,
    j: int,
    at: int,
    pose: wp.vec3,
):
    """Row of agent j in the ego's frame: x, y, length, width, relative yaw, speed; zeros for j < 0."""
    if j < 0:
        put(out, b, at, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        return
    q = state.pose[b, j]
    c = wp.cos(pose[2])
    s = wp.sin(pose[2])
    dx = q[0] - pose[0]
    dy = q[1] - pose[1]
    body = bank.body[bank.model[e, j]]
    turn = wrap(q[2] - pose[2])
    put(out, b, at, c * dx + s * dy, -s * dx + c * dy, 2.0 * body[0], 2.0 * body[1], turn, state.speed[b, j])


@wp.kernel(enable_backward=False)
def look(bank: EpisodeArrays, roads: Roads, state: State, ego: Ego, agents: int, out: wp.array2d(dtype=wp.float32)):
    """Write observation rows [B, 28]: 4 of SafeBench, then ego, two nearest vehicles within 25 m, and route (FREA).

    SafeBench: lateral offset (left positive) to the route point about 4 m ahead, heading error there, speed, 1 if a
    vehicle stands or drives in the same lane within 15 m ahead. Route row: middle, length, ego width, relative yaw and
    distance of the longest chord over the next 11 m that no route point between leaves by more than 0.5 m.
    """
    b = wp.tid()
    e = state.episode[b]
    pose = state.pose[b, 0]
    c = wp.cos(pose[2])
    s = wp.sin(pose[2])
    body = bank.body[bank.model[e, 0]]
    hazard = float(0.0)
    first = int(-1)
    second = int(-1)
    d_first = float(625.0)
    d_second = float(625.0)
    lane = state.lane[b, 0]
    for j in range(1, agents):
        if state.active[b, j] != Presence.ABSENT:
            q = state.pose[b, j]
            dx = q[0] - pose[0]
            dy = q[1] - pose[1]
            d2 = dx * dx + dy * dy
            kind = bank.kind[bank.model[e, j]]
            if d2 < 625.0 and kind < AgentKind.WALKER:
                if d2 < 225.0 and lane >= 0 and state.lane[b, j] == lane and dx * c + dy * s > 0.0:
                    hazard = 1.0
                if d2 < d_first:
                    second = first
                    d_second = d_first
                    first = j
                    d_first = d2
                elif d2 < d_second:
                    second = j
                    d_second = d2
    route = bank.route[e, 0]
    at = state.progress[b, 0]
    last = route[1] - 1
    p = roads.path[route[0] + wp.min(at + 4, last)]
    left = -wp.sin(p[2]) * (pose[0] - p[0]) + wp.cos(p[2]) * (pose[1] - p[1])
    out[b, 0] = left
    out[b, 1] = wrap(pose[2] - p[2])
    out[b, 2] = state.speed[b, 0]
    out[b, 3] = hazard
    put(out, b, 4, 0.0, 0.0, 2.0 * body[0], 2.0 * body[1], 0.0, state.speed[b, 0])
    put_agent(bank, state, out, b, e, first, 10, pose)
    put_agent(bank, state, out, b, e, second, 16, pose)
    a = roads.path[route[0] + wp.min(at + 2, last)]
    n = int(11)
    found = int(0)
    z = roads.path[route[0] + wp.min(at + 2 + n, last)]
    while n > 1 and found == 0:
        z = roads.path[route[0] + wp.min(at + 2 + n, last)]
        zx = z[0] - a[0]
        zy = z[1] - a[1]
        norm = wp.max(wp.sqrt(zx * zx + zy * zy), 1.0e-6)
        worst = float(0.0)
        for k in range(1, n):
            m = roads.path[route[0] + wp.min(at + 2 + k, last)]
            worst = wp.max(worst, wp.abs(zx * (m[1] - a[1]) - zy * (m[0] - a[0])) / norm)
        if worst <= 0.5:
            found = 1
        else:
            n = n - 1
    mx = 0.5 * (a[0] + z[0]) - pose[0]
    my = 0.5 * (a[1] + z[1]) - pose[1]
    span = wp.sqrt((z[0] - a[0]) * (z[0] - a[0]) + (z[1] - a[1]) * (z[1] - a[1]))
    turn = wrap(wp.atan2(z[1] - a[1], z[0] - a[0]) - pose[2])
    put(out, b, 22, c * mx + s * my, -s * mx + c * my, span, 2.0 * body[1], turn, wp.sqrt(mx * mx + my * my))
