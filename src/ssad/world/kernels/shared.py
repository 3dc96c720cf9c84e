"""Functions that several kernels share: angles, routes, signals, boxes, the lane under a point."""

import warp as wp

from ssad.core.types import SignalState
from ssad.world.kernels.data import FAR, EpisodeArrays, Roads, State

IDM_ACCEL = wp.constant(2.5)
NO_LINE = wp.constant(1 << 30)
BRIDGE = wp.constant(4.5)  # m between two roads of which one leads over the other


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const float4 v = reinterpret_cast<const float4*>(rows.data)[k];
    return wp::vec_t<4, wp::float32>(v.x, v.y, v.z, v.w);
#else
    return rows.data[k];
#endif
""")
def row(rows: wp.array(dtype=wp.vec4), k: int) -> wp.vec4:
    """Return row k of a contiguous array, on CUDA read at once and not number by number as `rows[k]` would."""


@wp.func
def wrap(angle: float) -> float:
    """Wrap an angle to (-pi, pi]."""
    if wp.abs(angle) < 3.14:
        return angle  # the same bits, and no division
    return angle - 6.283185307179586 * wp.floor((angle + 3.141592653589793) / 6.283185307179586)


@wp.func
def route_at(roads: Roads, first: int, count: int, u: float) -> wp.vec3:
    """Return the pose (x, y, yaw) at `u` metres along a route; clamped at both ends."""
    position = wp.clamp(u, 0.0, float(count - 1))
    index = wp.min(int(position), count - 2)
    fraction = position - float(index)
    start = row(roads.path, first + index)
    end = row(roads.path, first + index + 1)
    return wp.vec3(
        start[0] + fraction * (end[0] - start[0]),
        start[1] + fraction * (end[1] - start[1]),
        start[2] + fraction * wrap(end[2] - start[2]),
    )


@wp.func
def route_frame(roads: Roads, first: int, count: int, u: float) -> wp.vec4:
    """Return point and unit heading (x, y, tx, ty) at `u` metres along a route; clamped at its start only."""
    position = wp.max(u, 0.0)
    index = wp.min(int(position), count - 2)
    fraction = position - float(index)
    start = row(roads.path, first + index)
    end = row(roads.path, first + index + 1)
    dx = end[0] - start[0]
    dy = end[1] - start[1]
    inverse_norm = 1.0 / wp.sqrt(wp.max(dx * dx + dy * dy, 1.0e-12))
    return wp.vec4(start[0] + fraction * dx, start[1] + fraction * dy, dx * inverse_norm, dy * inverse_norm)


@wp.func
def height_of(bank: EpisodeArrays, roads: Roads, state: State, b: int, i: int) -> float:
    """Return the height of the road under an agent, m: that of its nearest route point; NaN without a route."""
    route = bank.route[state.episode[b], i]
    height = float(wp.nan)
    if route[1] > 1:
        height = roads.height[route[0] + state.progress[b, i]]
    return height


@wp.func
def on_track(roads: Roads, track: wp.vec2i, time: float) -> bool:
    """Return whether a trajectory places its agent anywhere at `time`."""
    if track[1] < 1:
        return False
    return time >= roads.track[track[0]][0] - 1.0e-4 and time <= roads.track[track[0] + track[1] - 1][0] + 1.0e-4


@wp.func
def track_at(roads: Roads, track: wp.vec2i, time: float) -> wp.vec4:
    """Return x, y, yaw and speed (negative: reverse) at `time` on a trajectory of two or more rows."""
    low = int(0)
    high = track[1] - 1
    while high - low > 1:
        middle = (low + high) // 2
        if roads.track[track[0] + middle][0] <= time:
            low = middle
        else:
            high = middle
    start = row(roads.track, track[0] + low)
    end = row(roads.track, track[0] + high)
    span = wp.max(end[0] - start[0], 1.0e-6)
    fraction = wp.clamp((time - start[0]) / span, 0.0, 1.0)
    yaw = start[3] + fraction * wrap(end[3] - start[3])
    dx = end[1] - start[1]
    dy = end[2] - start[2]
    speed = (dx * wp.cos(yaw) + dy * wp.sin(yaw)) / span
    return wp.vec4(start[1] + fraction * dx, start[2] + fraction * dy, wrap(yaw), speed)


@wp.func
def sign_line(roads: Roads, first: int, at: int) -> int:
    """Return the route point of the next stop sign's line from point `at` of a route on, or NO_LINE."""
    stop_sign = roads.ahead[first + at]
    line = int(NO_LINE)
    if stop_sign[0] < FAR:
        line = int(stop_sign[1])
    return line


@wp.func
def signal_state(bank: EpisodeArrays, roads: Roads, e: int, index: int, time: float) -> int:
    """State of signal `index` of the episode's town at `time`: forced by the episode, else its fixed programme."""
    forced = bank.signal[e, index]
    if forced >= 0 and time < bank.limits[e][3]:
        return forced
    program = roads.signal_program[roads.signal_first[bank.town[e]] + index]
    if program[0] <= 0.0:
        return SignalState.OFF
    cycle_time = time - program[1]
    cycle_time = cycle_time - program[0] * wp.floor(cycle_time / program[0])
    state = int(SignalState.RED)
    if cycle_time < program[2]:
        state = SignalState.GREEN
    elif cycle_time < program[2] + program[3]:
        state = SignalState.YELLOW
    return state


@wp.func
def axis_gap(dx: float, dy: float, ax: float, ay: float, reach: float) -> float:
    """Return the distance between two boxes along the axis (ax, ay); negative where they overlap on it."""
    return wp.abs(dx * ax + dy * ay) - reach


@wp.func
def frames_touch(
    dx: float,
    dy: float,
    pc: float,
    ps: float,
    pl: float,
    pw: float,
    qc: float,
    qs: float,
    ql: float,
    qw: float,
) -> bool:
    """Return whether two boxes (unit heading, half length, half width) overlap; q is centred at (dx, dy) from p."""
    cosine = wp.abs(pc * qc + ps * qs)
    sine = wp.abs(pc * qs - ps * qc)
    if axis_gap(dx, dy, pc, ps, pl + ql * cosine + qw * sine) > 0.0:
        return False
    if axis_gap(dx, dy, -ps, pc, pw + ql * sine + qw * cosine) > 0.0:
        return False
    if axis_gap(dx, dy, qc, qs, ql + pl * cosine + pw * sine) > 0.0:
        return False
    return axis_gap(dx, dy, -qs, qc, qw + pl * sine + pw * cosine) <= 0.0


@wp.func
def boxes_touch(p: wp.vec3, pl: float, pw: float, q: wp.vec3, ql: float, qw: float) -> bool:
    """Return whether two oriented boxes (pose, half length, half width) overlap, by the separating-axis test."""
    dx = q[0] - p[0]
    dy = q[1] - p[1]
    reach = pl + pw + ql + qw
    if dx * dx + dy * dy > reach * reach:
        return False
    return frames_touch(dx, dy, wp.cos(p[2]), wp.sin(p[2]), pl, pw, wp.cos(q[2]), wp.sin(q[2]), ql, qw)


@wp.func
def lane_under(roads: Roads, town: int, x: float, y: float) -> wp.vec3:
    """Return the lane whose strip is under the point: (lane or -1, m left of its centre line, half width).

    Looks only at the grid cell of the point, which lists every strip that touches it.
    """
    grid = roads.grid[town]
    size = roads.grid_size[town]
    column = int(wp.floor((x - grid[0]) * grid[2]))
    line = int(wp.floor((y - grid[1]) * grid[2]))
    best = wp.vec3(-1.0, 0.0, 0.0)
    if column < 0 or line < 0 or column >= size[0] or line >= size[1]:
        return best
    cell = size[2] + line * size[0] + column
    min_distance2 = FAR
    for entry in range(roads.cell_first[cell], roads.cell_first[cell + 1]):
        segment = roads.cell_segment[entry]
        ends = row(roads.segment, segment)
        dx = ends[2] - ends[0]
        dy = ends[3] - ends[1]
        px = x - ends[0]
        py = y - ends[1]
        squared_length = wp.max(dx * dx + dy * dy, 1.0e-9)
        projection = (px * dx + py * dy) / squared_length
        share = wp.clamp(projection, 0.0, 1.0)
        away_x = px - share * dx
        away_y = py - share * dy
        distance2 = away_x * away_x + away_y * away_y
        half = roads.segment_half[segment]
        half_width = half[0] + share * (half[1] - half[0])
        if distance2 < min_distance2 and distance2 <= half_width * half_width:
            # past an end of the segment the strip goes on only as far as a bend needs
            overshoot = (projection - share) * (projection - share) * squared_length
            if overshoot < 0.25:
                min_distance2 = distance2
                side = 1.0
                if dx * py - dy * px < 0.0:
                    side = -1.0
                best = wp.vec3(float(roads.segment_lane[segment]), side * wp.sqrt(distance2), half_width)
    return best
