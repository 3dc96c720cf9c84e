"""Observation of the shipped learned drivers: the road ahead, obstacles expected on it and nearby agents."""

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
def distance_to_body(pose: wp.vec3, half_length: float, half_width: float, x: float, y: float) -> float:
    """Return the distance from a point to a body's outline, m; 0 inside."""
    c = wp.cos(pose[2])
    s = wp.sin(pose[2])
    dx = x - pose[0]
    dy = y - pose[1]
    along = wp.max(wp.abs(dx * c + dy * s) - half_length, 0.0)
    across = wp.max(wp.abs(dy * c - dx * s) - half_width, 0.0)
    return wp.sqrt(along * along + across * across)


@wp.func
def predicted_pose(pose: wp.vec3, speed: float, rate: float, time: float) -> wp.vec3:
    """Return the pose after `time` s at constant speed and rate of turn."""
    mean = pose[2] + 0.5 * rate * time
    x = pose[0] + speed * time * wp.cos(mean)
    y = pose[1] + speed * time * wp.sin(mean)
    return wp.vec3(x, y, pose[2] + rate * time)


@wp.func
def rank_distance(pose: wp.vec3, q: wp.vec3) -> float:
    """Return the distance to an agent, m; agents behind matter less, and count as twice as far."""
    dx = q[0] - pose[0]
    dy = q[1] - pose[1]
    distance = wp.sqrt(dx * dx + dy * dy)
    if wp.cos(pose[2]) * dx + wp.sin(pose[2]) * dy < -3.0:
        distance = 2.0 * distance
    return distance


@wp.kernel(enable_backward=False)
def look_at_traffic(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    agents: int,
    observers: wp.array(dtype=wp.vec2i),
    dt: float,
    out: wp.array2d(dtype=wp.float32),
):
    """Write rows [N, 69] of the agents `observers` (scene, agent); see `ssad.world.sensors.SENSORS`."""
    n = wp.tid()
    b = observers[n][0]
    i = observers[n][1]
    e = state.episode[b]
    pose = state.pose[b, i]
    c = wp.cos(pose[2])
    s = wp.sin(pose[2])
    route = bank.route[e, i]
    at = float(state.progress[b, i])
    remaining = float(SIGHT)
    offset = float(0.0)
    error = float(0.0)
    if route[1] > 1:
        point = roads.path[route[0] + state.progress[b, i]]
        at = at + (pose[0] - point[0]) * wp.cos(point[2]) + (pose[1] - point[1]) * wp.sin(point[2])
        offset = -wp.sin(point[2]) * (pose[0] - point[0]) + wp.cos(point[2]) * (pose[1] - point[1])
        error = wrap(pose[2] - point[2])
        remaining = wp.clamp(float(route[1] - 1) - at, 0.0, SIGHT)
    out[n, 0] = state.speed[b, i] / 10.0
    out[n, 1] = state.accel[b, i] / 5.0
    out[n, 2] = state.wheel[b, i] / 0.5
    out[n, 3] = state.cruise[b, i] / 10.0
    out[n, 4] = wp.clamp(offset / 2.0, -5.0, 5.0)
    out[n, 5] = error
    out[n, 6] = remaining / SIGHT
    for index in range(6):
        ahead = float(4 * (index + 1))
        if index > 2:
            ahead = float(18 + 8 * (index - 3))
        x = ahead
        y = float(0.0)
        if route[1] > 1:
            other_pose = route_at(roads, route[0], route[1], at + ahead)
            x = c * (other_pose[0] - pose[0]) + s * (other_pose[1] - pose[1])
            y = -s * (other_pose[0] - pose[0]) + c * (other_pose[1] - pose[1])
        out[n, 7 + 2 * index] = x / 20.0
        out[n, 8 + 2 * index] = y / 20.0
    gap = vec5()
    flow = vec5()
    for horizon in range(5):
        gap[horizon] = SIGHT
    for j in range(agents):
        if j != i and state.active[b, j] != Presence.ABSENT:
            other_pose = state.pose[b, j]
            x = c * (other_pose[0] - pose[0]) + s * (other_pose[1] - pose[1])
            y = -s * (other_pose[0] - pose[0]) + c * (other_pose[1] - pose[1])
            distance = wp.sqrt(x * x + y * y)
            turn = wrap(other_pose[2] - pose[2])
            # An agent that follows on the same path will not be ahead.
            follows = x < 0.0 and wp.abs(y) < 2.0 and wp.cos(turn) > 0.5
            if route[1] > 1 and distance < 2.0 * SIGHT and not follows:
                body = bank.body[bank.model[e, j]]
                speed = state.speed[b, j]
                rate = wp.clamp(wrap(other_pose[2] - state.previous[b, j][2]) / dt, -TURN, TURN)
                if wp.abs(speed) < 0.1 or state.step[b] == 0:
                    rate = 0.0
                reach = wp.sqrt(body[0] * body[0] + body[1] * body[1]) + BESIDE
                for horizon in range(5):
                    predicted = predicted_pose(other_pose, speed, rate, float(horizon))
                    for index in range(STATIONS):
                        station = 2.0 * float(index)
                        if station < gap[horizon] and station <= remaining:
                            road_point = route_at(roads, route[0], route[1], at + station)
                            dx = predicted[0] - road_point[0]
                            dy = predicted[1] - road_point[1]
                            if (
                                dx * dx + dy * dy < reach * reach
                                and distance_to_body(predicted, body[0], body[1], road_point[0], road_point[1]) < BESIDE
                            ):
                                gap[horizon] = station
                                flow[horizon] = speed * wp.cos(predicted[2] - road_point[2])
    for horizon in range(5):
        out[n, 19 + 2 * horizon] = gap[horizon] / SIGHT
        out[n, 20 + 2 * horizon] = flow[horizon] / 10.0
    last_rank = float(-1.0)
    for index in range(NEAR):
        best_rank = float(SIGHT)
        nearest = int(-1)
        for j in range(agents):
            if j != i and state.active[b, j] != Presence.ABSENT:
                distance = rank_distance(pose, state.pose[b, j])
                if distance > last_rank and distance < best_rank:
                    best_rank = distance
                    nearest = j
        last_rank = best_rank
        start_column = 29 + 8 * index
        for column in range(8):
            out[n, start_column + column] = 0.0
        if nearest >= 0:
            other_pose = state.pose[b, nearest]
            column = bank.model[e, nearest]
            body = bank.body[column]
            turn = wrap(other_pose[2] - pose[2])
            out[n, start_column] = (c * (other_pose[0] - pose[0]) + s * (other_pose[1] - pose[1])) / 25.0
            out[n, start_column + 1] = (-s * (other_pose[0] - pose[0]) + c * (other_pose[1] - pose[1])) / 25.0
            out[n, start_column + 2] = wp.cos(turn)
            out[n, start_column + 3] = wp.sin(turn)
            out[n, start_column + 4] = state.speed[b, nearest] / 10.0
            out[n, start_column + 5] = body[0] / 2.5
            out[n, start_column + 6] = body[1]
            if bank.kind[column] >= AgentKind.MOTORCYCLE and bank.kind[column] <= AgentKind.WALKER:
                out[n, start_column + 7] = 1.0
