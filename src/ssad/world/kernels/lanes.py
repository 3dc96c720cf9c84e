"""Intended path of an agent: its route, and the lane changes that lead beside it.

A lane change is a stretch of the route over which the agent moves from one number of lanes left of the route to
another (`State.shift`); the route's points hold the width of these lanes (`Roads.beside`).
"""

import warp as wp

from ssad.world.kernels.data import PerceivedAgents, Roads
from ssad.world.kernels.shared import route_at, route_frame

CHANGE_ACCEL = wp.constant(2.5)  # m/s^2 to the side in a lane change
ASIDE = wp.constant(4.5)  # m that a lane change may lead beside a route
PEAK = wp.constant(5.77)  # greatest second derivative of the quintic


@wp.func
def is_changing_lane(shift: wp.vec4) -> bool:
    """Return whether an agent is, or was, off its route: see `State.shift`."""
    return shift[2] != 0.0 or shift[3] != 0.0


@wp.func
def turn_signal(shift: wp.vec4, u: float) -> int:
    """Return the turn signal of an agent `u` metres along its route: 1 left, -1 right, 0 none."""
    signal = int(0)
    if u < shift[1]:
        if shift[3] > shift[2]:
            signal = 1
        elif shift[3] < shift[2]:
            signal = -1
    return signal


@wp.func
def lanes_left(shift: wp.vec4, u: float) -> float:
    """Return the intended number of lanes left of the route (negative: right) at `u` metres along it."""
    share = wp.clamp((u - shift[0]) / wp.max(shift[1] - shift[0], 1.0e-3), 0.0, 1.0)
    # a quintic: neither the heading nor the curvature jumps at the ends of the change
    return shift[2] + (shift[3] - shift[2]) * share * share * share * (10.0 + share * (6.0 * share - 15.0))


@wp.func
def metres_left(roads: Roads, first: int, count: int, shift: wp.vec4, u: float) -> float:
    """Return the intended distance left of the route at `u` metres along it, m."""
    lanes = lanes_left(shift, u)
    position = wp.clamp(u, 0.0, float(count - 1))
    index = wp.min(int(position), count - 2)
    fraction = position - float(index)
    start = roads.beside[first + index]
    end = roads.beside[first + index + 1]
    room = start[0] + fraction * (end[0] - start[0])
    if lanes < 0.0:
        room = start[2] + fraction * (end[2] - start[2])
    return lanes * room


@wp.func
def way_slope(roads: Roads, first: int, count: int, shift: wp.vec4, u: float) -> float:
    """Return the slope of the intended path against the route: metres to the left per metre."""
    after = metres_left(roads, first, count, shift, u + 0.5)
    return after - metres_left(roads, first, count, shift, u - 0.5)


@wp.func
def way_frame(roads: Roads, first: int, count: int, shift: wp.vec4, u: float) -> wp.vec4:
    """Return `route_frame` of the intended path: the route and the lane change beside it."""
    frame = route_frame(roads, first, count, u)
    if is_changing_lane(shift):
        left = metres_left(roads, first, count, shift, u)
        slope = way_slope(roads, first, count, shift, u)
        norm = 1.0 / wp.sqrt(1.0 + slope * slope)
        frame = wp.vec4(
            frame[0] - left * frame[3],
            frame[1] + left * frame[2],
            norm * (frame[2] - slope * frame[3]),
            norm * (frame[3] + slope * frame[2]),
        )
    return frame


@wp.func
def way_at(roads: Roads, first: int, count: int, shift: wp.vec4, u: float) -> wp.vec3:
    """Return `route_at` of the intended path."""
    pose = route_at(roads, first, count, u)
    if is_changing_lane(shift):
        left = metres_left(roads, first, count, shift, u)
        slope = way_slope(roads, first, count, shift, u)
        pose = wp.vec3(pose[0] - left * wp.sin(pose[2]), pose[1] + left * wp.cos(pose[2]), pose[2] + wp.atan(slope))
    return pose


@wp.func
def change_speed(shift: wp.vec4, u: float) -> float:
    """Return the speed at which the current lane change is comfortable, m/s."""
    speed = float(1000.0)
    if u < shift[1]:
        length = shift[1] - shift[0]
        # lanes are 3.5 m wide, more or less
        speed = length * wp.sqrt(CHANGE_ACCEL / (PEAK * 3.5 * wp.max(wp.abs(shift[3] - shift[2]), 0.1)))
    return speed


@wp.func
def on_oncoming_lane(roads: Roads, first: int, shift: wp.vec4) -> bool:
    """Return whether an agent at a route point uses the oncoming lane to pass."""
    return wp.max(shift[2], shift[3]) > 0.0 and roads.beside[first][1] < 0.0


@wp.func
def change_priority(perceived: PerceivedAgents, b: int, i: int, j: int, otherwise: bool) -> bool:
    """Return whether i goes before j where one of them changes lanes; else `otherwise`.

    Of each two exactly one goes first.
    An agent on the oncoming lane yields to that lane's traffic; of two in the same direction, the one in front goes.
    Agents that cannot be relied on are never required to give way.
    """
    own_change = perceived.change[b, i]
    other_change = perceived.change[b, j]
    goes_first = otherwise
    if perceived.gives_way[b, j] == 1 and (
        own_change[0] != 0 or own_change[1] != 0 or other_change[0] != 0 or other_change[1] != 0
    ):
        own_pose = perceived.pose[b, i]
        other_pose = perceived.pose[b, j]
        facing = wp.cos(other_pose[2] - own_pose[2])
        if facing < -0.5 and own_change[1] != other_change[1]:
            goes_first = other_change[1] == 1
        elif facing > 0.5:
            # along the mean of both headings, so that both see the same one in front
            x = wp.cos(own_pose[2]) + wp.cos(other_pose[2])
            y = wp.sin(own_pose[2]) + wp.sin(other_pose[2])
            lead = (own_pose[0] - other_pose[0]) * x + (own_pose[1] - other_pose[1]) * y
            goes_first = lead > 0.0 or (lead == 0.0 and i < j)
    return goes_first
