"""Observable state of all agents at the start of a step: the rows of `PerceivedAgents` that hold the truth.

No agent knows the intention of another, the ego's included. An agent that follows its route shows by its turn signal
how it leaves the next junction, and from there its lane leads to the junction after; beyond, it is expected to go
straight. Walkers and agents that have left their route have only their pose, speed and rate of turn.
"""

import warp as wp

from ssad.core.types import AgentKind, Controller
from ssad.world.kernels.data import (
    AS_IT_IS,
    FAR,
    HORIZON,
    STRIDE,
    End,
    EpisodeArrays,
    PerceivedAgents,
    Presence,
    Roads,
    State,
    TurnRank,
)
from ssad.world.kernels.lanes import ASIDE, is_changing_lane, on_oncoming_lane, turn_signal, way_at
from ssad.world.kernels.shared import row, signal_state, wrap

wp.set_module_options({"max_unroll": 0})  # see `traffic`

KEEPS = wp.constant(2.0)  # m from the nearest point of its route, up to which one keeps to it
ALONG = wp.constant(0.8)  # rad from its route's heading, likewise
STARTS = wp.constant(0.3)  # m/s^2
MOST_PULL = wp.constant(2.5)  # m/s^2 that is expected to last
MOST_START = wp.constant(6.0)  # m/s up to which it is
CLEARING = wp.constant(3.0)  # m/s
STRAIGHT_TURN = wp.constant(1.0e-3)  # 1/m, or rad: less is straight on
LARGEST_TURN = wp.constant(1.57)  # rad that one who has left its route is expected to turn


@wp.func
def light(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    perceived: PerceivedAgents,
    b: int,
    i: int,
    e: int,
    index: int,
    dt: float,
) -> int:
    """Return the state of a signal as agent i perceives it."""
    if i == 0 and perceived.believes[b] == 1 and perceived.light[b, index] != AS_IT_IS:
        return perceived.light[b, index]
    return signal_state(bank, roads, e, index, float(state.step[b]) * dt)


@wp.func
def keeps_route(roads: Roads, route: wp.vec2i, shift: wp.vec4, at: int, pose: wp.vec3) -> bool:
    """Return whether an agent is on its route and heads along it."""
    point = row(roads.path, route[0] + at)
    expected_pose = wp.vec3(point[0], point[1], point[2])
    if is_changing_lane(shift):
        expected_pose = way_at(roads, route[0], route[1], shift, float(at))
    dx = pose[0] - expected_pose[0]
    dy = pose[1] - expected_pose[1]
    return dx * dx + dy * dy < KEEPS * KEEPS and wp.abs(wrap(pose[2] - expected_pose[2])) < ALONG


@wp.func
def announced_distance(roads: Roads, route: wp.vec2i, at: int) -> float:
    """Return the distance along a route (m) up to which an agent that follows it shows its direction.

    That is the second junction ahead: the turn signal announces the next one, and its exit lane leads to the one
    after.
    """
    last = route[1] - 1
    end = float(at) + roads.ahead[route[0] + at][2]
    if end < float(last):
        end = end + roads.rule[route[0] + int(end)][2]
    return wp.min(end, float(last))


@wp.func
def pose_along_arc(pose: wp.vec3, distance: float, curvature: float) -> wp.vec3:
    """Return the pose after `distance` metres at a constant curvature, which ends after a quarter of a turn."""
    angle = wp.clamp(curvature * distance, -LARGEST_TURN, LARGEST_TURN)
    arc = distance
    remaining = float(0.0)
    if wp.abs(curvature * distance) > LARGEST_TURN:
        arc = angle / curvature
        remaining = distance - arc
    chord = arc
    if wp.abs(angle) > STRAIGHT_TURN:
        chord = 2.0 * arc / angle * wp.sin(0.5 * angle)
    yaw = pose[2] + angle
    x = pose[0] + chord * wp.cos(pose[2] + 0.5 * angle) + remaining * wp.cos(yaw)
    y = pose[1] + chord * wp.sin(pose[2] + 0.5 * angle) + remaining * wp.sin(yaw)
    return wp.vec3(x, y, yaw)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    float4* to = reinterpret_cast<float4*>(poses.data + at);
    to[0] = make_float4(p.c[0], p.c[1], p.c[2], q.c[0]);
    to[1] = make_float4(q.c[1], q.c[2], r.c[0], r.c[1]);
    to[2] = make_float4(r.c[2], s.c[0], s.c[1], s.c[2]);
#else
    poses.data[at] = p;
    poses.data[at + 1] = q;
    poses.data[at + 2] = r;
    poses.data[at + 3] = s;
#endif
""")
def put_four(poses: wp.array3d(dtype=wp.vec3), at: int, p: wp.vec3, q: wp.vec3, r: wp.vec3, s: wp.vec3):
    """Write four poses at flat index `at`, a multiple of 4, of a contiguous array; on CUDA in stores of 16 bytes."""


@wp.func
def ahead_at(
    roads: Roads,
    route: wp.vec2i,
    shift: wp.vec4,
    at: int,
    pose: wp.vec3,
    follows: bool,
    shown_distance: float,
    curvature: float,
    ahead: float,
) -> wp.vec3:
    """Return the predicted pose of an agent after `ahead` metres."""
    predicted = pose
    if not follows:
        predicted = pose_along_arc(pose, ahead, curvature)
    else:
        predicted = way_at(roads, route[0], route[1], shift, wp.min(float(at) + ahead, shown_distance))
        excess = float(at) + ahead - shown_distance
        if excess > 0.0:
            predicted = wp.vec3(
                predicted[0] + excess * wp.cos(predicted[2]), predicted[1] + excess * wp.sin(predicted[2]), predicted[2]
            )
    return predicted


@wp.func
def extend_box(box: wp.vec4, q: wp.vec3) -> wp.vec4:
    """Extend a box to contain a point."""
    return wp.vec4(wp.min(box[0], q[0]), wp.min(box[1], q[1]), wp.max(box[2], q[0]), wp.max(box[3], q[1]))


@wp.func
def fill_agent_row(
    bank: EpisodeArrays, roads: Roads, state: State, perceived: PerceivedAgents, b: int, i: int, dt: float
):
    """Fill the row of an agent."""
    if state.active[b, i] == Presence.ABSENT:
        perceived.kind[b, i] = AgentKind.NONE
        return
    e = state.episode[b]
    model = bank.model[e, i]
    body = bank.body[model]
    perceived.kind[b, i] = bank.kind[model]
    pose = state.pose[b, i]
    speed = state.speed[b, i]
    perceived.pose[b, i] = pose
    perceived.speed[b, i] = speed
    perceived.half[b, i] = wp.vec2(body[0], body[1])
    # traffic does not know who is under test: the ego is relied on like anybody, whoever drives it
    reliable = int(0)
    if i == 0 or (state.controller[b, i] == Controller.AUTOPILOT and state.active[b, i] == Presence.AWAKE):
        reliable = 1
    perceived.gives_way[b, i] = reliable
    perceived.waited[b, i] = state.waited[b, i]
    way = wp.vec4(FAR, FAR, float(TurnRank.STRAIGHT), 0.0)
    signal = int(-1)
    route = bank.route[e, i]
    at = state.progress[b, i]
    shift = state.shift[b, i]
    change = wp.vec2i(0, 0)
    height = float(wp.nan)
    if route[1] > 1:
        height = roads.height[route[0] + at]
    # NaN without a route: an unknown height never counts as another level.
    perceived.height[b, i] = height
    follows = route[1] > 1 and bank.kind[model] != AgentKind.WALKER
    if follows:
        follows = keeps_route(roads, route, shift, at, pose)
    if follows:
        route_point = route[0] + at
        rule = row(roads.rule, route_point)
        way = wp.vec4(wp.min(rule[1], rule[2]), rule[2], rule[3], roads.bend[route_point] + 0.5)
        signal = roads.path_signal[route_point]
        if is_changing_lane(shift) and state.controller[b, i] == Controller.AUTOPILOT:
            change[0] = turn_signal(shift, state.aim[b, i][0])
            if on_oncoming_lane(roads, route_point, shift):
                change[1] = 1
            way[3] = way[3] + ASIDE
    expected_speed = speed
    if follows and reliable == 1 and way[1] < body[0] - 1.0:
        expected_speed = wp.max(speed, CLEARING)  # whoever stands in a junction is expected to leave it
    if bank.style[e, i][0] > 0.0 and state.accel[b, i] > STARTS and speed > 0.1 and speed < MOST_START:
        # a driver that starts is expected to gain speed: its mean speed in the time ahead
        gain = 0.5 * STRIDE * float(HORIZON) * wp.min(state.accel[b, i], MOST_PULL)
        expected_speed = wp.max(expected_speed, wp.min(speed + gain, MOST_START))
    box = wp.vec4(pose[0], pose[1], pose[0], pose[1])
    flat_index = (b * perceived.forecast.shape[1] + i) * HORIZON
    if wp.abs(expected_speed) > 0.1:
        shown_until = float(0.0)
        curvature = float(0.0)
        if follows:
            shown_until = announced_distance(roads, route, at)
        elif wp.abs(speed) > 1.0:
            curvature = wrap(pose[2] - state.previous[b, i][2]) / (speed * dt)
            if wp.abs(curvature) > STRAIGHT_TURN:
                way[3] = 0.36 * wp.abs(expected_speed) * STRIDE * float(HORIZON)  # bound of a quarter turn
        for k in range(0, HORIZON, 4):
            stride = expected_speed * STRIDE
            first = ahead_at(roads, route, shift, at, pose, follows, shown_until, curvature, stride * float(k + 1))
            second = ahead_at(roads, route, shift, at, pose, follows, shown_until, curvature, stride * float(k + 2))
            third = ahead_at(roads, route, shift, at, pose, follows, shown_until, curvature, stride * float(k + 3))
            fourth = ahead_at(roads, route, shift, at, pose, follows, shown_until, curvature, stride * float(k + 4))
            put_four(perceived.forecast, flat_index + k, first, second, third, fourth)
            box = extend_box(extend_box(extend_box(extend_box(box, first), second), third), fourth)
    else:
        for k in range(0, HORIZON, 4):
            put_four(perceived.forecast, flat_index + k, pose, pose, pose, pose)
    perceived.span[b, i] = box
    perceived.way[b, i] = way
    perceived.signal[b, i] = signal
    perceived.change[b, i] = change


@wp.kernel(enable_backward=False)
def fill_all_rows(
    bank: EpisodeArrays, roads: Roads, state: State, perceived: PerceivedAgents, agents: int, threads: int, dt: float
):
    """Fill the row of every agent."""
    b, first_agent = wp.tid()
    if state.end[b] == End.RUNNING:
        for i in range(first_agent, agents, threads):
            fill_agent_row(bank, roads, state, perceived, b, i, dt)
