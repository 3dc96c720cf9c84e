"""Observations of learned drivers: SafeBench's four numbers, FREA's 4 x 6 rows, the road around, a view from above."""

import warp as wp

from ssad.core.types import AgentKind
from ssad.world.kernels.data import EpisodeArrays, Presence, Roads, State
from ssad.world.kernels.shared import lane_under, route_at, row, wrap

OBSERVATION = 28  # numbers in a row of `look`
CHANNELS = 4  # of `look_from_above`
ROAD = 21  # numbers in a row of `look_at_road`: under the centre, and at 4 x 5 points ahead
OFF_ROAD = wp.constant(-2.0)  # alignment of a point on no lane
GOAL_AHEAD = wp.constant(6.5)  # m along the ego's route from its centre to the adversary's goal
GOAL_RADIUS = wp.constant(2.0)  # m


@wp.func
def put_row(
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
    """Write one row of six numbers."""
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
    """Write the row of agent j in the observer's frame: x, y, length, width, relative yaw, speed; zeros for j < 0."""
    if j < 0:
        put_row(out, n, at, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        return
    other_pose = state.pose[b, j]
    c = wp.cos(pose[2])
    s = wp.sin(pose[2])
    dx = other_pose[0] - pose[0]
    dy = other_pose[1] - pose[1]
    body = bank.body[bank.model[e, j]]
    turn = wrap(other_pose[2] - pose[2])
    put_row(out, n, at, c * dx + s * dy, -s * dx + c * dy, 2.0 * body[0], 2.0 * body[1], turn, state.speed[b, j])


@wp.kernel(enable_backward=False)
def look(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    agents: int,
    observers: wp.array(dtype=wp.vec2i),
    out: wp.array2d(dtype=wp.float32),
):
    """Write observation rows [N, 28] of the agents `observers` (scene, agent).

    4 numbers of SafeBench, then FREA's rows: the agent itself, the two nearest vehicles within 25 m, and the route.

    SafeBench: lateral offset (left positive) to the route point about 4 m ahead, heading error there, speed, 1 if a
    vehicle stands or drives in the same lane within 15 m ahead. Route row: middle, length, ego width, relative yaw and
    distance of the longest chord over the next 11 m that no route point between leaves by more than 0.5 m.
    """
    n = wp.tid()
    b = observers[n][0]
    i = observers[n][1]
    e = state.episode[b]
    pose = state.pose[b, i]
    c = wp.cos(pose[2])
    s = wp.sin(pose[2])
    body = bank.body[bank.model[e, i]]
    hazard = float(0.0)
    first = int(-1)
    second = int(-1)
    first_distance2 = float(625.0)
    second_distance2 = float(625.0)
    lane = state.lane[b, i]
    for j in range(agents):
        if j != i and state.active[b, j] != Presence.ABSENT:
            other_pose = state.pose[b, j]
            dx = other_pose[0] - pose[0]
            dy = other_pose[1] - pose[1]
            distance2 = dx * dx + dy * dy
            kind = bank.kind[bank.model[e, j]]
            # 25 m squared; the kinds below WALKER are the vehicles.
            if distance2 < 625.0 and kind < AgentKind.WALKER:
                if distance2 < 225.0 and lane >= 0 and state.lane[b, j] == lane and dx * c + dy * s > 0.0:
                    hazard = 1.0
                if distance2 < first_distance2:
                    second = first
                    second_distance2 = first_distance2
                    first = j
                    first_distance2 = distance2
                elif distance2 < second_distance2:
                    second = j
                    second_distance2 = distance2
    out[n, 2] = state.speed[b, i]
    out[n, 3] = hazard
    put_row(out, n, 4, 0.0, 0.0, 2.0 * body[0], 2.0 * body[1], 0.0, state.speed[b, i])
    put_agent(bank, state, out, b, e, first, n, 10, pose)
    put_agent(bank, state, out, b, e, second, n, 16, pose)
    route = bank.route[e, i]
    if route[1] < 2:  # without a route: straight on
        out[n, 0] = 0.0
        out[n, 1] = 0.0
        put_row(out, n, 22, 7.5, 0.0, 11.0, 2.0 * body[1], 0.0, 7.5)
        return
    at = state.progress[b, i]
    last = route[1] - 1
    point = roads.path[route[0] + wp.min(at + 4, last)]
    lateral = -wp.sin(point[2]) * (pose[0] - point[0]) + wp.cos(point[2]) * (pose[1] - point[1])
    out[n, 0] = lateral
    out[n, 1] = wrap(pose[2] - point[2])
    chord_start = roads.path[route[0] + wp.min(at + 2, last)]
    reach = int(11)
    chord_found = int(0)
    chord_end = roads.path[route[0] + wp.min(at + 2 + reach, last)]
    while reach > 1 and chord_found == 0:
        chord_end = roads.path[route[0] + wp.min(at + 2 + reach, last)]
        chord_x = chord_end[0] - chord_start[0]
        chord_y = chord_end[1] - chord_start[1]
        chord_norm = wp.max(wp.sqrt(chord_x * chord_x + chord_y * chord_y), 1.0e-6)
        worst = float(0.0)
        for step in range(1, reach):
            middle_point = roads.path[route[0] + wp.min(at + 2 + step, last)]
            worst = wp.max(
                worst,
                wp.abs(chord_x * (middle_point[1] - chord_start[1]) - chord_y * (middle_point[0] - chord_start[0]))
                / chord_norm,
            )
        if worst <= 0.5:
            chord_found = 1
        else:
            reach = reach - 1
    middle_x = 0.5 * (chord_start[0] + chord_end[0]) - pose[0]
    middle_y = 0.5 * (chord_start[1] + chord_end[1]) - pose[1]
    span = wp.sqrt(
        (chord_end[0] - chord_start[0]) * (chord_end[0] - chord_start[0])
        + (chord_end[1] - chord_start[1]) * (chord_end[1] - chord_start[1])
    )
    turn = wrap(wp.atan2(chord_end[1] - chord_start[1], chord_end[0] - chord_start[0]) - pose[2])
    put_row(
        out,
        n,
        22,
        c * middle_x + s * middle_y,
        -s * middle_x + c * middle_y,
        span,
        2.0 * body[1],
        turn,
        wp.sqrt(middle_x * middle_x + middle_y * middle_y),
    )


@wp.kernel(enable_backward=False)
def look_as_adversary(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    agents: int,
    observers: wp.array(dtype=wp.vec2i),
    out: wp.array2d(dtype=wp.float32),
):
    """Write FREA's rows for an adversary [N, 24]: itself, the ego, the nearest other vehicle within 25 m, and its goal.

    Goal: the point of the ego's route that the ego reaches next, as x, y, radius, radius, relative yaw, distance.
    """
    n = wp.tid()
    b = observers[n][0]
    i = observers[n][1]
    e = state.episode[b]
    pose = state.pose[b, i]
    nearest = int(-1)
    # 25 m squared.
    min_distance2 = float(625.0)
    for j in range(1, agents):
        if j != i and state.active[b, j] != Presence.ABSENT and bank.kind[bank.model[e, j]] < AgentKind.WALKER:
            other_pose = state.pose[b, j]
            distance2 = (other_pose[0] - pose[0]) * (other_pose[0] - pose[0]) + (other_pose[1] - pose[1]) * (
                other_pose[1] - pose[1]
            )
            if distance2 < min_distance2:
                min_distance2 = distance2
                nearest = j
    put_agent(bank, state, out, b, e, i, n, 0, pose)
    put_agent(bank, state, out, b, e, 0, n, 6, pose)
    put_agent(bank, state, out, b, e, nearest, n, 12, pose)
    route = bank.route[e, 0]
    ego = state.pose[b, 0]
    point = roads.path[route[0] + state.progress[b, 0]]
    offset = (ego[0] - point[0]) * wp.cos(point[2]) + (ego[1] - point[1]) * wp.sin(point[2])
    goal = route_at(roads, route[0], route[1], float(state.progress[b, 0]) + offset + GOAL_AHEAD)
    dx = goal[0] - pose[0]
    dy = goal[1] - pose[1]
    c = wp.cos(pose[2])
    s = wp.sin(pose[2])
    goal_distance = wp.sqrt(dx * dx + dy * dy)
    put_row(
        out, n, 18, c * dx + s * dy, -s * dx + c * dy, GOAL_RADIUS, GOAL_RADIUS, wrap(goal[2] - pose[2]), goal_distance
    )


@wp.func
def alignment_at(roads: Roads, town: int, x: float, y: float, c: float, s: float) -> float:
    """Return the largest cosine between a course (c, s) and the lanes under a point; OFF_ROAD where there is none."""
    grid = roads.grid[town]
    size = roads.grid_size[town]
    column = int(wp.floor((x - grid[0]) * grid[2]))
    line = int(wp.floor((y - grid[1]) * grid[2]))
    best = float(OFF_ROAD)
    if column < 0 or line < 0 or column >= size[0] or line >= size[1]:
        return best
    cell = size[2] + line * size[0] + column
    for entry in range(roads.cell_first[cell], roads.cell_first[cell + 1]):
        segment = roads.cell_segment[entry]
        ends = row(roads.segment, segment)
        dx = ends[2] - ends[0]
        dy = ends[3] - ends[1]
        px = x - ends[0]
        py = y - ends[1]
        squared_length = wp.max(dx * dx + dy * dy, 1.0e-9)
        share = wp.clamp((px * dx + py * dy) / squared_length, 0.0, 1.0)
        away_x = px - share * dx
        away_y = py - share * dy
        half = roads.segment_half[segment]
        half_width = half[0] + share * (half[1] - half[0])
        if away_x * away_x + away_y * away_y <= half_width * half_width:
            best = wp.max(best, (dx * c + dy * s) / wp.sqrt(squared_length))
    return best


@wp.kernel(enable_backward=False)
def look_at_road(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    agents: int,
    observers: wp.array(dtype=wp.vec2i),
    out: wp.array2d(dtype=wp.float32),
):
    """Write how well the road fits the course of each observer [N, 21].

    First the cosine between its course and the lane under its centre that fits best, -2 off the road. Its course is
    that of its motion: it turns round in reverse. Then the same for points 0, 5, 10 and 20 m ahead, each 4 and 2 m to
    the left, in the middle, and 2 and 4 m to the right, with its heading as course and -1 off the road.
    """
    n = wp.tid()
    b = observers[n][0]
    i = observers[n][1]
    town = bank.town[state.episode[b]]
    pose = state.pose[b, i]
    c = wp.cos(pose[2])
    s = wp.sin(pose[2])
    motion = float(1.0)
    if state.speed[b, i] < 0.0:
        motion = -1.0
    out[n, 0] = alignment_at(roads, town, pose[0], pose[1], motion * c, motion * s)
    for station in range(4):
        ahead = 5.0 * float(station)
        if station == 3:
            ahead = 20.0
        for place in range(5):
            left = 4.0 - 2.0 * float(place)
            x = pose[0] + ahead * c - left * s
            y = pose[1] + ahead * s + left * c
            out[n, 1 + 5 * station + place] = wp.max(alignment_at(roads, town, x, y, c, s), -1.0)


@wp.kernel(enable_backward=False)
def look_from_above(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    agents: int,
    observers: wp.array(dtype=wp.vec2i),
    side: int,
    metre: float,
    behind: float,
    out: wp.array4d(dtype=wp.float32),
):
    """Draw [N, 4, side, side] pictures in the agent's frame, forward up: road, its route, agents, their speed / 20 m/s.

    metre: pixels a metre; behind: metres that are seen behind the agent's centre. Where it itself is, agents is 0.5.
    """
    n, line, column = wp.tid()
    b = observers[n][0]
    i = observers[n][1]
    e = state.episode[b]
    pose = state.pose[b, i]
    ahead = (float(side) - 0.5 - float(line)) / metre - behind
    left = (0.5 * float(side) - 0.5 - float(column)) / metre
    c = wp.cos(pose[2])
    s = wp.sin(pose[2])
    x = pose[0] + ahead * c - left * s
    y = pose[1] + ahead * s + left * c
    road = float(0.0)
    if lane_under(roads, bank.town[e], x, y)[0] >= 0.0:
        road = 1.0
    out[n, 0, line, column] = road
    path = float(0.0)
    route = bank.route[e, i]
    if route[1] > 1:
        at = state.progress[b, i]
        reach = int(float(side) / metre) + 1
        for index in range(at, wp.min(at + reach, route[1])):
            point = roads.path[route[0] + index]
            if (point[0] - x) * (point[0] - x) + (point[1] - y) * (point[1] - y) < 1.0:
                path = 1.0
    out[n, 1, line, column] = path
    occupied = float(0.0)
    speed = float(0.0)
    for j in range(agents):
        if state.active[b, j] != Presence.ABSENT:
            other_pose = state.pose[b, j]
            body = bank.body[bank.model[e, j]]
            dx = x - other_pose[0]
            dy = y - other_pose[1]
            other_cos = wp.cos(other_pose[2])
            other_sin = wp.sin(other_pose[2])
            if (
                wp.abs(dx * other_cos + dy * other_sin) <= body[0]
                and wp.abs(dy * other_cos - dx * other_sin) <= body[1]
            ):
                speed = state.speed[b, j] / 20.0
                occupied = 1.0
                if j == i:
                    occupied = 0.5
    out[n, 2, line, column] = occupied
    out[n, 3, line, column] = speed
