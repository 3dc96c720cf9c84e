"""The way that an agent means to go: its route, and the lane changes that lead beside it.

A lane change is a stretch of the route over which the agent moves from one number of lanes left of the route to another
(`State.shift`); how many metres that is, the route's points know (`Roads.beside`).
"""

import warp as wp

from ssad.world.kernels.data import Roads, Seen
from ssad.world.kernels.shared import route_at, route_frame

CHANGE_ACCEL = wp.constant(2.5)  # m/s^2 to the side in a lane change
ASIDE = wp.constant(4.5)  # m that a lane change may lead beside a route
PEAK = wp.constant(5.77)  # greatest second derivative of the quintic


@wp.func
def changes(shift: wp.vec4) -> bool:
    """Whether an agent is, or was, anywhere but on its route: see `State.shift`."""
    return shift[2] != 0.0 or shift[3] != 0.0


@wp.func
def indicates(shift: wp.vec4, u: float) -> int:
    """The turn signal of who is `u` metres along its route: 1 left, -1 right, 0 none."""
    signal = int(0)
    if u < shift[1]:
        if shift[3] > shift[2]:
            signal = 1
        elif shift[3] < shift[2]:
            signal = -1
    return signal


@wp.func
def lanes_left(shift: wp.vec4, u: float) -> float:
    """How many lanes left of its route (negative: right) an agent means to be at `u` metres along it."""
    t = wp.clamp((u - shift[0]) / wp.max(shift[1] - shift[0], 1.0e-3), 0.0, 1.0)
    # a quintic: neither the heading nor the curvature jumps at the ends of the change
    return shift[2] + (shift[3] - shift[2]) * t * t * t * (10.0 + t * (6.0 * t - 15.0))


@wp.func
def metres_left(roads: Roads, first: int, count: int, shift: wp.vec4, u: float) -> float:
    """How many metres left of its route an agent means to be at `u` metres along it."""
    share = lanes_left(shift, u)
    t = wp.clamp(u, 0.0, float(count - 1))
    i = wp.min(int(t), count - 2)
    f = t - float(i)
    a = roads.beside[first + i]
    b = roads.beside[first + i + 1]
    room = a[0] + f * (b[0] - a[0])
    if share < 0.0:
        room = a[2] + f * (b[2] - a[2])
    return share * room


@wp.func
def way_slope(roads: Roads, first: int, count: int, shift: wp.vec4, u: float) -> float:
    """Metres that an agent means to move left a metre of its route."""
    after = metres_left(roads, first, count, shift, u + 0.5)
    return after - metres_left(roads, first, count, shift, u - 0.5)


@wp.func
def way_frame(roads: Roads, first: int, count: int, shift: wp.vec4, u: float) -> wp.vec4:
    """As `route_frame`, of the way that an agent means to go: its route and the lane change beside it."""
    at = route_frame(roads, first, count, u)
    if changes(shift):
        left = metres_left(roads, first, count, shift, u)
        slope = way_slope(roads, first, count, shift, u)
        r = 1.0 / wp.sqrt(1.0 + slope * slope)
        at = wp.vec4(
            at[0] - left * at[3], at[1] + left * at[2], r * (at[2] - slope * at[3]), r * (at[3] + slope * at[2])
        )
    return at


@wp.func
def way_at(roads: Roads, first: int, count: int, shift: wp.vec4, u: float) -> wp.vec3:
    """As `route_at`, of the way that an agent means to go."""
    q = route_at(roads, first, count, u)
    if changes(shift):
        left = metres_left(roads, first, count, shift, u)
        slope = way_slope(roads, first, count, shift, u)
        q = wp.vec3(q[0] - left * wp.sin(q[2]), q[1] + left * wp.cos(q[2]), q[2] + wp.atan(slope))
    return q


@wp.func
def change_speed(shift: wp.vec4, u: float) -> float:
    """Speed at which a lane change is comfortable while it lasts, m/s."""
    speed = float(1000.0)
    if u < shift[1]:
        length = shift[1] - shift[0]
        # lanes are 3.5 m wide, more or less
        speed = length * wp.sqrt(CHANGE_ACCEL / (PEAK * 3.5 * wp.max(wp.abs(shift[3] - shift[2]), 0.1)))
    return speed


@wp.func
def on_oncoming_lane(roads: Roads, first: int, shift: wp.vec4) -> bool:
    """Whether an agent at a route point passes somebody on the lane of those who come towards it."""
    return wp.max(shift[2], shift[3]) > 0.0 and roads.beside[first][1] < 0.0


@wp.func
def change_priority(seen: Seen, b: int, i: int, j: int, otherwise: bool) -> bool:
    """Whether i goes before j where one of them changes lane, of each two exactly one; else `otherwise`.

    Who passes on the oncoming lane lets those go whose lane it is; of two who go the same way, the one in front goes.
    Nobody who is not relied on has to give way.
    """
    a = seen.change[b, i]
    c = seen.change[b, j]
    first = otherwise
    if seen.gives_way[b, j] == 1 and (a[0] != 0 or a[1] != 0 or c[0] != 0 or c[1] != 0):
        p = seen.pose[b, i]
        q = seen.pose[b, j]
        facing = wp.cos(q[2] - p[2])
        if facing < -0.5 and a[1] != c[1]:
            first = c[1] == 1
        elif facing > 0.5:
            # along the mean of both headings, so that both see the same one in front
            x = wp.cos(p[2]) + wp.cos(q[2])
            y = wp.sin(p[2]) + wp.sin(q[2])
            lead = (p[0] - q[0]) * x + (p[1] - q[1]) * y
            first = lead > 0.0 or (lead == 0.0 and i < j)
    return first
