"""Functions that several kernels use: angles, routes, signals, boxes, the lane under a point."""

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
    """Row k of a contiguous array, on CUDA read at once and not number by number, which is what rows[k] does there."""


@wp.func
def wrap(angle: float) -> float:
    """Angle in (-pi, pi]."""
    if wp.abs(angle) < 3.14:
        return angle  # the same bits, and no division
    return angle - 6.283185307179586 * wp.floor((angle + 3.141592653589793) / 6.283185307179586)


@wp.func
def route_at(roads: Roads, first: int, count: int, u: float) -> wp.vec3:
    """Pose (x, y, yaw) at `u` metres along a route; held at both ends."""
    t = wp.clamp(u, 0.0, float(count - 1))
    i = wp.min(int(t), count - 2)
    f = t - float(i)
    a = row(roads.path, first + i)
    b = row(roads.path, first + i + 1)
    return wp.vec3(a[0] + f * (b[0] - a[0]), a[1] + f * (b[1] - a[1]), a[2] + f * wrap(b[2] - a[2]))


@wp.func
def route_frame(roads: Roads, first: int, count: int, u: float) -> wp.vec4:
    """Point and unit heading (x, y, tx, ty) at `u` metres along a route; held at its start, straight on at its end."""
    t = wp.max(u, 0.0)
    i = wp.min(int(t), count - 2)
    f = t - float(i)
    a = row(roads.path, first + i)
    b = row(roads.path, first + i + 1)
    dx = b[0] - a[0]
    dy = b[1] - a[1]
    r = 1.0 / wp.sqrt(wp.max(dx * dx + dy * dy, 1.0e-12))
    return wp.vec4(a[0] + f * dx, a[1] + f * dy, dx * r, dy * r)


@wp.func
def height_of(bank: EpisodeArrays, roads: Roads, state: State, b: int, i: int) -> float:
    """Height of the road under an agent, m: its route's, where it is now; NaN without a route."""
    route = bank.route[state.episode[b], i]
    height = float(wp.nan)
    if route[1] > 1:
        height = roads.height[route[0] + state.progress[b, i]]
    return height


@wp.func
def on_track(roads: Roads, track: wp.vec2i, time: float) -> bool:
    """Whether a trajectory has its agent anywhere at `time`."""
    if track[1] < 1:
        return False
    return time >= roads.track[track[0]][0] - 1.0e-4 and time <= roads.track[track[0] + track[1] - 1][0] + 1.0e-4


@wp.func
def track_at(roads: Roads, track: wp.vec2i, time: float) -> wp.vec4:
    """x, y, yaw and speed along the heading (negative: backwards) on a trajectory of two rows or more at `time`."""
    low = int(0)
    high = track[1] - 1
    while high - low > 1:
        middle = (low + high) // 2
        if roads.track[track[0] + middle][0] <= time:
            low = middle
        else:
            high = middle
    p = row(roads.track, track[0] + low)
    q = row(roads.track, track[0] + high)
    span = wp.max(q[0] - p[0], 1.0e-6)
    f = wp.clamp((time - p[0]) / span, 0.0, 1.0)
    yaw = p[3] + f * wrap(q[3] - p[3])
    dx = q[1] - p[1]
    dy = q[2] - p[2]
    speed = (dx * wp.cos(yaw) + dy * wp.sin(yaw)) / span
    return wp.vec4(p[1] + f * dx, p[2] + f * dy, wrap(yaw), speed)


@wp.func
def sign_line(roads: Roads, first: int, at: int) -> int:
    """Route point of the line of the next stop sign from point `at` of a route on, or NO_LINE."""
    halt = roads.ahead[first + at]
    line = int(NO_LINE)
    if halt[0] < FAR:
        line = int(halt[1])
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
    t = time - program[1]
    t = t - program[0] * wp.floor(t / program[0])
    state = int(SignalState.RED)
    if t < program[2]:
        state = SignalState.GREEN
    elif t < program[2] + program[3]:
        state = SignalState.YELLOW
    return state


@wp.func
def axis_gap(dx: float, dy: float, ax: float, ay: float, reach: float) -> float:
    """Distance between two boxes along the axis (ax, ay); negative where they overlap on it."""
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
    """Whether two boxes (unit heading, half length, half width) overlap, q's centre being at (dx, dy) from p's."""
    c = wp.abs(pc * qc + ps * qs)
    s = wp.abs(pc * qs - ps * qc)
    if axis_gap(dx, dy, pc, ps, pl + ql * c + qw * s) > 0.0:
        return False
    if axis_gap(dx, dy, -ps, pc, pw + ql * s + qw * c) > 0.0:
        return False
    if axis_gap(dx, dy, qc, qs, ql + pl * c + pw * s) > 0.0:
        return False
    return axis_gap(dx, dy, -qs, qc, qw + pl * s + pw * c) <= 0.0


@wp.func
def boxes_touch(p: wp.vec3, pl: float, pw: float, q: wp.vec3, ql: float, qw: float) -> bool:
    """Whether two oriented boxes (pose, half length, half width) overlap: separating-axis test."""
    dx = q[0] - p[0]
    dy = q[1] - p[1]
    r = pl + pw + ql + qw
    if dx * dx + dy * dy > r * r:
        return False
    return frames_touch(dx, dy, wp.cos(p[2]), wp.sin(p[2]), pl, pw, wp.cos(q[2]), wp.sin(q[2]), ql, qw)


@wp.func
def lane_under(roads: Roads, town: int, x: float, y: float) -> wp.vec3:
    """Lane whose strip is under the point: (lane or -1, m left of its centre line, half width).

    Looks only at the grid cell of the point, which lists every strip that touches it.
    """
    grid = roads.grid[town]
    size = roads.grid_size[town]
    cx = int(wp.floor((x - grid[0]) * grid[2]))
    cy = int(wp.floor((y - grid[1]) * grid[2]))
    best = wp.vec3(-1.0, 0.0, 0.0)
    if cx < 0 or cy < 0 or cx >= size[0] or cy >= size[1]:
        return best
    cell = size[2] + cy * size[0] + cx
    least = FAR
    for k in range(roads.cell_first[cell], roads.cell_first[cell + 1]):
        m = roads.cell_segment[k]
        g = row(roads.segment, m)
        dx = g[2] - g[0]
        dy = g[3] - g[1]
        px = x - g[0]
        py = y - g[1]
        length2 = wp.max(dx * dx + dy * dy, 1.0e-9)
        raw = (px * dx + py * dy) / length2
        t = wp.clamp(raw, 0.0, 1.0)
        ex = px - t * dx
        ey = py - t * dy
        d2 = ex * ex + ey * ey
        half = roads.segment_half[m]
        h = half[0] + t * (half[1] - half[0])
        if d2 < least and d2 <= h * h:
            # past an end of the segment the strip goes on only as far as a bend needs
            over = (raw - t) * (raw - t) * length2
            if over < 0.25:
                least = d2
                side = 1.0
                if dx * py - dy * px < 0.0:
                    side = -1.0
                best = wp.vec3(float(roads.segment_lane[m]), side * wp.sqrt(d2), h)
    return best
