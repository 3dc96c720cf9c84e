"""Where and when the paths of two agents meet, as a driver of the population sees it.

The path of the other agent is laid over the driver's own: each place that the other one is expected at is located
along the way and beside it. The stretch that its body covers, and the times at which it enters and leaves it,
change smoothly from step to step, and so does the acceleration that they allow.
"""

import warp as wp

from ssad.world.kernels.data import FAR, HORIZON, STRIDE, PerceivedAgents, Roads
from ssad.world.kernels.lanes import way_frame
from ssad.world.kernels.shared import wrap

wp.set_module_options({"max_unroll": 0})  # see `traffic`

ALIGNED = wp.constant(0.7)  # cosine of two headings that lead the same way
SOON = wp.constant(0.5)  # s that a driver plans to arrive after another agent
SLOWS = wp.constant(1.5)  # m/s^2 with which an agent slows down to its top speed
MOST_GAIN = wp.constant(2.5)  # m/s^2
AIR = wp.constant(0.9)  # m before another body
BEHIND = wp.constant(20.0)  # m behind the driver from which places are located
PROJECTIONS = wp.constant(3)  # Newton steps that locate a place along the path
LONG = wp.constant(3.0)  # m, half length from which a body needs more room in bends
SWING = wp.constant(0.575)  # half of a wheelbase over half of a body
MOST_SWING = wp.constant(2.0)  # m of swing at most
LOCATED = wp.constant(1.5)  # m of error allowed in locating a place
STEEPEST = wp.constant(0.3)  # least share of a metre along the other side of a bend


@wp.struct
class Meeting:
    """Stretch of a driver's way that another agent covers when the driver would be there."""

    near: wp.float32  # m from the driver's front to the stretch, FAR: there is none
    far: wp.float32  # m that the driver has travelled when its rear has left the stretch
    begin: wp.float32  # s until the other agent enters the driver's way, 0: it is there
    end: wp.float32  # s until it has left it; FAR: it stays as long as it is foreseen
    joins: wp.int32  # 1: it drives along the driver's way
    gap: wp.float32  # m from the driver's front to its rear, measured along their paths, where it joins


@wp.func
def forecast_pose(perceived: PerceivedAgents, b: int, j: int, index: int) -> wp.vec3:
    """Return the pose of an agent `index` + 1 strides ahead; beyond its forecast it goes straight on."""
    if index < HORIZON:
        return perceived.forecast[b, j, index]
    last = perceived.forecast[b, j, HORIZON - 1]
    previous = perceived.forecast[b, j, HORIZON - 2]
    strides = float(index - HORIZON + 1)
    return wp.vec3(last[0] + strides * (last[0] - previous[0]), last[1] + strides * (last[1] - previous[1]), last[2])


@wp.func
def travel_distance(motion: wp.vec4, time: float) -> float:
    """Return the metres covered in `time` s; motion: see `find_meeting`."""
    driven = wp.max(time - motion[3], 0.0)
    change = motion[1]
    if motion[0] > motion[2]:
        change = -SLOWS
    changing = wp.min(driven, wp.abs(motion[2] - motion[0]) / wp.max(wp.abs(change), 0.01))
    return motion[0] * driven + change * changing * (driven - 0.5 * changing)


@wp.func
def accelerating_time(speed: float, acceleration: float, distance: float) -> float:
    """Return the time in which an agent that accelerates covers a distance."""
    pull = wp.clamp(acceleration, 0.3, MOST_GAIN)
    return (wp.sqrt(speed * speed + 2.0 * pull * distance) - speed) / pull


@wp.func
def gained_time(speed: float, acceleration: float, time: float) -> float:
    """Return how soon an agent is where it is in `time` s at its speed, if it accelerates."""
    if acceleration <= 0.01:
        return time
    return (wp.sqrt(speed * speed + 2.0 * acceleration * speed * time) - speed) / acceleration


@wp.func
def swing_out(curvature: float, half_length: float) -> float:
    """Return how far the front of a long body leads beside the path of its middle, m: by the slip of the bend."""
    return wp.min(SWING * wp.abs(curvature) * half_length * half_length, MOST_SWING)


@wp.func
def find_meeting(
    roads: Roads,
    perceived: PerceivedAgents,
    b: int,
    j: int,
    route: wp.vec2i,
    shift: wp.vec4,
    u0: float,
    lon: float,
    motion: wp.vec4,
    own_body: wp.vec4,
    other_body: wp.vec2,
    margin: float,
    before: wp.vec2,
    other_accel: float,
    strides: int,
) -> Meeting:
    """Find where the agent of row j is going to be in the way of a driver `u0` metres along it.

    lon: metres that j is ahead in the driver's frame; motion: the driver's speed, acceleration and top speed if nobody
    is in its way, and s until it starts; margin: m to either side of the driver's body; before: s that the driver
    wants to have left the stretch before j comes, and s more for each metre to it; j
    may go on to accelerate by `other_accel`; strides: how far
    ahead it looks.
    """
    meeting = Meeting()
    meeting.near = FAR
    meeting.far = 0.0
    meeting.begin = FAR
    meeting.end = FAR
    meeting.joins = 0
    meeting.gap = FAR
    other_speed = wp.max(wp.abs(perceived.speed[b, j]), 0.1)
    first = perceived.forecast[b, j, 0]
    pose = perceived.pose[b, j]
    # a forecast may be faster than its agent is now: of one that starts
    forecast_speed = wp.max(wp.length(wp.vec2(first[0] - pose[0], first[1] - pose[1])) / STRIDE, other_speed)
    # long enough that a fast, short agent is not before the way at one place and behind it at the next
    half_length = wp.max(other_body[0], 0.5 * STRIDE * forecast_speed - own_body[1])
    # further aside, no body reaches the way
    aside = own_body[1] + margin + half_length + other_body[1]
    reach = motion[2] * STRIDE * float(strides) + own_body[0] + half_length
    along = wp.clamp(lon, -BEHIND, reach)
    frame = way_frame(roads, route[0], route[1], shift, u0 + along)
    last_clearance = float(0.0)
    turned = float(0.0)
    time = float(0.0)
    covers = bool(False)
    entered = float(0.0)
    joins = bool(False)
    joined = float(0.0)
    sine = float(0.0)
    for place in range(strides + 1):
        last_time = time
        time = STRIDE * float(place)
        if forecast_speed > other_speed + 0.5:
            time = accelerating_time(other_speed, other_accel, forecast_speed * time)
        if place > 0:
            next_pose = forecast_pose(perceived, b, j, place - 1)
            turned = wrap(next_pose[2] - pose[2])
            step = (next_pose[0] - pose[0]) * frame[2] + (next_pose[1] - pose[1]) * frame[3]
            along = wp.clamp(along + step, -BEHIND, reach)
            pose = next_pose
        lateral = float(0.0)
        residual = float(0.0)
        for _ in range(PROJECTIONS):
            frame = way_frame(roads, route[0], route[1], shift, u0 + along)
            rel_x = pose[0] - frame[0]
            rel_y = pose[1] - frame[1]
            residual = rel_x * frame[2] + rel_y * frame[3]
            lateral = rel_y * frame[2] - rel_x * frame[3]
            if wp.abs(residual) < 0.1 or wp.abs(lateral) > aside + wp.abs(residual):
                break
            curvature = roads.path[route[0] + wp.clamp(int(u0 + along + 0.5), 0, route[1] - 1)][3]
            along = wp.clamp(along + residual / wp.max(1.0 - curvature * lateral, STEEPEST), -BEHIND, reach)
        clearance = wp.abs(lateral) - aside
        swing = float(0.0)
        if own_body[0] > LONG:
            # the body lags in bends: the front of a long one swings out
            point = route[0] + wp.clamp(int(u0 + along + 0.5), 0, route[1] - 1)
            swing = swing_out(roads.path[point][3], own_body[0])
        if other_body[0] > LONG and place > 0:
            swing = swing + swing_out(turned / wp.max(STRIDE * forecast_speed, 0.5), other_body[0])
        clearance = clearance - swing
        edge = float(0.0)
        exit = float(0.0)
        cosine = float(0.0)
        if clearance < 0.0 and wp.abs(residual) < LOCATED:
            other_cos = wp.cos(pose[2])
            other_sin = wp.sin(pose[2])
            cosine = other_cos * frame[2] + other_sin * frame[3]
            slant = other_sin * frame[2] - other_cos * frame[3]
            sine = wp.abs(slant)
            width = own_body[1] + margin + swing + other_body[1] * wp.abs(cosine)
            clearance = wp.abs(lateral) - (width + half_length * sine)
            # of a slanting body only the part beside the way counts
            back = -half_length
            front = half_length
            if sine > 0.02:
                left = (width - lateral) / slant
                right = (-width - lateral) / slant
                back = wp.clamp(wp.min(left, right), -half_length, half_length)
                front = wp.clamp(wp.max(left, right), -half_length, half_length)
            edge = along + wp.min(back * cosine, front * cosine) - other_body[1] * sine - own_body[0] - AIR
            exit = along + wp.max(back * cosine, front * cosine) + other_body[1] * sine + own_body[0]
        covered = clearance < 0.0 and along < reach and along > -BEHIND and wp.abs(residual) < LOCATED
        if covered:
            if not covers:
                entered = 0.0
                if place > 0:
                    entered = time - (time - last_time) * wp.clamp(
                        -clearance / wp.max(last_clearance - clearance, 0.01), 0.0, 1.0
                    )
            if cosine > ALIGNED and not joins:
                joins = bool(True)
                joined = along - other_speed * time - other_body[0] - own_body[0]
            # past the near edge with j behind the middle, braking would only stay in its way
            if edge > 0.0 or along > 0.0:
                rear = float(0.0)
                sooner = time
                if forecast_speed <= other_speed + 0.5:
                    sooner = gained_time(other_speed, wp.min(other_accel, MOST_GAIN), time)
                reserve = before[0] + before[1] * wp.max(edge, 0.0)
                if cosine > ALIGNED:
                    rear = travel_distance(motion, sooner) - reserve * other_speed
                else:
                    rear = travel_distance(motion, sooner - reserve)
                if meeting.near < FAR or (rear < exit and travel_distance(motion, time + SOON) > edge):
                    if meeting.near >= FAR:
                        meeting.begin = entered
                    meeting.near = wp.min(meeting.near, wp.max(edge, 0.0))
                    meeting.far = wp.max(meeting.far, exit)
                    if joins:
                        meeting.joins = 1
                        meeting.gap = joined
        elif covers:
            if meeting.near < FAR:
                meeting.end = time - (time - last_time) * wp.clamp(
                    clearance / wp.max(clearance - last_clearance, 0.01), 0.0, 1.0
                )
                break
            joins = bool(False)
        covers = covered
        last_clearance = clearance
    if meeting.joins == 1:
        meeting.end = meeting.begin + 2.0 * half_length / other_speed
    elif meeting.near < FAR and meeting.end >= FAR and sine > 0.5:
        meeting.end = time - last_clearance / (other_speed * sine)
    return meeting
