"""What learned drivers look at, for any agent: SafeBench's four numbers, FREA's 4 x 6 rows, and a view from above."""

import warp as wp

from ssad.core.types import AgentKind
from ssad.world.kernels.data import EpisodeArrays, Presence, Roads, State
from ssad.world.kernels.shared import lane_under, route_at, wrap

OBSERVATION = 28  # numbers in a row of `look`
CHANNELS = 4  # of `look_from_above`
GOAL_AHEAD = wp.constant(6.5)  # m along the ego's route from its centre to the adversary's goal
GOAL_RADIUS = wp.constant(2.0)  # m


@wp.func
def put(
    out: wp.array2d(dtype=wp.float32),
    n: int,
    at: int,
    x: float,
    y: float,
    l: float,
    w: float,
    r: float,
    v: float,
):
    """One row of six numbers."""
    out[n, at + 0] = x
    out[n, at + 1] = y
    out[n, at + 2] = l
    out[n, at + 3] = w
    out[n, at + 4] = r
    out[n, at + 5] = v


@wp.func
def put_agent(
    bank: EpisodeArrays,
    state: State,
    out: wp.array2d(dtype=wp.float32),
    b: int,
    e: int,
    j: int,
    n: int,
    at: int,
    pose: wp.vec3,
):
    """Row of agent j in the frame of who looks: x, y, length, width, relative yaw, speed; zeros for j < 0."""
    if j < 0:
        put(out, n, at, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        return
    q = state.pose[b, j]
    c = wp.cos(pose[2])
    s = wp.sin(pose[2])
    dx = q[0] - pose[0]
    dy = q[1] - pose[1]
    body = bank.body[bank.model[e, j]]
    turn = wrap(q[2] - pose[2])
    put(out, n, at, c * dx + s * dy, -s * dx + c * dy, 2.0 * body[0], 2.0 * body[1], turn, state.speed[b, j])


@wp.kernel(enable_backward=False)
def look(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    agents: int,
    who: wp.array(dtype=wp.vec2i),
    out: wp.array2d(dtype=wp.float32),
):
    """Write observation rows [N, 28] of the agents `who` (scene, agent).

    4 numbers of SafeBench, then FREA's rows: the agent itself, the two nearest vehicles within 25 m, and the route.

    SafeBench: lateral offset (left positive) to the route point about 4 m ahead, heading error there, speed, 1 if a
    vehicle stands or drives in the same lane within 15 m ahead. Route row: middle, length, ego width, relative yaw and
    distance of the longest chord over the next 11 m that no route point between leaves by more than 0.5 m.
    """
    n = wp.tid()
    b = who[n][0]
    i = who[n][1]
    e = state.episode[b]
    pose = state.pose[b, i]
    c = wp.cos(pose[2])
    s = wp.sin(pose[2])
    body = bank.body[bank.model[e, i]]
    hazard = float(0.0)
    first = int(-1)
    second = int(-1)
    d_first = float(625.0)
    d_second = float(625.0)
    lane = state.lane[b, i]
    for j in range(agents):
        if j != i and state.active[b, j] != Presence.ABSENT:
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
    out[n, 2] = state.speed[b, i]
    out[n, 3] = hazard
    put(out, n, 4, 0.0, 0.0, 2.0 * body[0], 2.0 * body[1], 0.0, state.speed[b, i])
    put_agent(bank, state, out, b, e, first, n, 10, pose)
    put_agent(bank, state, out, b, e, second, n, 16, pose)
    route = bank.route[e, i]
    if route[1] < 2:  # without a route: straight on
        out[n, 0] = 0.0
        out[n, 1] = 0.0
        put(out, n, 22, 7.5, 0.0, 11.0, 2.0 * body[1], 0.0, 7.5)
        return
    at = state.progress[b, i]
    last = route[1] - 1
    p = roads.path[route[0] + wp.min(at + 4, last)]
    left = -wp.sin(p[2]) * (pose[0] - p[0]) + wp.cos(p[2]) * (pose[1] - p[1])
    out[n, 0] = left
    out[n, 1] = wrap(pose[2] - p[2])
    a = roads.path[route[0] + wp.min(at + 2, last)]
    reach = int(11)
    found = int(0)
    z = roads.path[route[0] + wp.min(at + 2 + reach, last)]
    while reach > 1 and found == 0:
        z = roads.path[route[0] + wp.min(at + 2 + reach, last)]
        zx = z[0] - a[0]
        zy = z[1] - a[1]
        norm = wp.max(wp.sqrt(zx * zx + zy * zy), 1.0e-6)
        worst = float(0.0)
        for k in range(1, reach):
            m = roads.path[route[0] + wp.min(at + 2 + k, last)]
            worst = wp.max(worst, wp.abs(zx * (m[1] - a[1]) - zy * (m[0] - a[0])) / norm)
        if worst <= 0.5:
            found = 1
        else:
            reach = reach - 1
    mx = 0.5 * (a[0] + z[0]) - pose[0]
    my = 0.5 * (a[1] + z[1]) - pose[1]
    span = wp.sqrt((z[0] - a[0]) * (z[0] - a[0]) + (z[1] - a[1]) * (z[1] - a[1]))
    turn = wrap(wp.atan2(z[1] - a[1], z[0] - a[0]) - pose[2])
    put(out, n, 22, c * mx + s * my, -s * mx + c * my, span, 2.0 * body[1], turn, wp.sqrt(mx * mx + my * my))


@wp.kernel(enable_backward=False)
def look_as_adversary(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    agents: int,
    who: wp.array(dtype=wp.vec2i),
    out: wp.array2d(dtype=wp.float32),
):
    """Write FREA's rows for an adversary [N, 24]: itself, the ego, the nearest other vehicle within 25 m, and its goal.

    Goal: the point of the ego's route that the ego reaches next, as x, y, radius, radius, relative yaw, distance.
    """
    n = wp.tid()
    b = who[n][0]
    i = who[n][1]
    e = state.episode[b]
    pose = state.pose[b, i]
    nearest = int(-1)
    least = float(625.0)
    for j in range(1, agents):
        if j != i and state.active[b, j] != Presence.ABSENT and bank.kind[bank.model[e, j]] < AgentKind.WALKER:
            q = state.pose[b, j]
            d2 = (q[0] - pose[0]) * (q[0] - pose[0]) + (q[1] - pose[1]) * (q[1] - pose[1])
            if d2 < least:
                least = d2
                nearest = j
    put_agent(bank, state, out, b, e, i, n, 0, pose)
    put_agent(bank, state, out, b, e, 0, n, 6, pose)
    put_agent(bank, state, out, b, e, nearest, n, 12, pose)
    route = bank.route[e, 0]
    ego = state.pose[b, 0]
    p = roads.path[route[0] + state.progress[b, 0]]
    part = (ego[0] - p[0]) * wp.cos(p[2]) + (ego[1] - p[1]) * wp.sin(p[2])
    goal = route_at(roads, route[0], route[1], float(state.progress[b, 0]) + part + GOAL_AHEAD)
    dx = goal[0] - pose[0]
    dy = goal[1] - pose[1]
    c = wp.cos(pose[2])
    s = wp.sin(pose[2])
    far = wp.sqrt(dx * dx + dy * dy)
    put(out, n, 18, c * dx + s * dy, -s * dx + c * dy, GOAL_RADIUS, GOAL_RADIUS, wrap(goal[2] - pose[2]), far)


@wp.kernel(enable_backward=False)
def look_from_above(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    agents: int,
    who: wp.array(dtype=wp.vec2i),
    side: int,
    metre: float,
    behind: float,
    out: wp.array4d(dtype=wp.float32),
):
    """Draw [N, 4, side, side] pictures in the agent's frame, forward up: road, its route, agents, their speed / 20 m/s.

    metre: pixels a metre; behind: metres that are seen behind the agent's centre. Where it itself is, agents is 0.5.
    """
    n, row, column = wp.tid()
    b = who[n][0]
    i = who[n][1]
    e = state.episode[b]
    pose = state.pose[b, i]
    ahead = (float(side) - 0.5 - float(row)) / metre - behind
    left = (0.5 * float(side) - 0.5 - float(column)) / metre
    c = wp.cos(pose[2])
    s = wp.sin(pose[2])
    x = pose[0] + ahead * c - left * s
    y = pose[1] + ahead * s + left * c
    road = float(0.0)
    if lane_under(roads, bank.town[e], x, y)[0] >= 0.0:
        road = 1.0
    out[n, 0, row, column] = road
    path = float(0.0)
    route = bank.route[e, i]
    if route[1] > 1:
        at = state.progress[b, i]
        reach = int(float(side) / metre) + 1
        for k in range(at, wp.min(at + reach, route[1])):
            p = roads.path[route[0] + k]
            if (p[0] - x) * (p[0] - x) + (p[1] - y) * (p[1] - y) < 1.0:
                path = 1.0
    out[n, 1, row, column] = path
    there = float(0.0)
    speed = float(0.0)
    for j in range(agents):
        if state.active[b, j] != Presence.ABSENT:
            q = state.pose[b, j]
            body = bank.body[bank.model[e, j]]
            dx = x - q[0]
            dy = y - q[1]
            cj = wp.cos(q[2])
            sj = wp.sin(q[2])
            if wp.abs(dx * cj + dy * sj) <= body[0] and wp.abs(dy * cj - dx * sj) <= body[1]:
                speed = state.speed[b, j] / 20.0
                there = 1.0
                if j == i:
                    there = 0.5
    out[n, 2, row, column] = there
    out[n, 3, row, column] = speed
