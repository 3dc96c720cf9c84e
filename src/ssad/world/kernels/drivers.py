"""Drivers of the population: how one of them follows, stops, errs and moves the pedals.

Each has parameters of its own: `style`, `manner` and `habit` of `EpisodeArrays`. A reaction is, as in `traffic`, m/s^2
and negative: here it is the acceleration that an agent or a place allows, less the driver's own acceleration.

A driver follows by the Intelligent Driver Model with its equilibrium at the desired gap (Treiber and Kesting 2013,
section 11.3.4), and brakes no harder than the situation needs. Before a stop the deceleration is nearly constant.
"""

import warp as wp

from ssad.world.kernels.data import FAR, Roads, State

wp.set_module_options({"max_unroll": 0})  # see `traffic`

LEADER_BRAKES = wp.constant(4.0)  # m/s^2 of braking that a driver allows for in its leader
STOPS_AT_YELLOW = wp.constant(3.05)  # m/s^2: half of drivers stop (Olson and Rothery 1962: between 2.44 and 3.66)
RUNS_RED = wp.constant(4.5)  # m/s^2: at a signal that turns red, a driver that would have to brake harder goes on
BEYOND_LINE = wp.constant(2.0)  # m beyond the stop line within which a driver at rest waits for green
STAYS_BELOW = wp.constant(1.5)  # m/s below which a driver beyond the line stays
SMOOTH = wp.constant(1.05)  # times the needed deceleration, with which a late driver brakes
FIRM = wp.constant(3.5)  # m/s^2 above which braking is no ordinary stop
RELEASE = wp.constant(1.8)  # times the ordinary jerk, from throttle to brake
HASTE = wp.constant(1.5)  # m/s^2 of demand up to which the jerk is the ordinary one; beyond, it grows with the demand
ATTENTIVE = wp.constant(0.3)  # share of the reaction time of a driver that is ready to brake, or creeps
PREPARED = wp.constant(40.0)  # m before a junction from which a driver is ready to brake
NOTICES = wp.constant(0.4)  # share of a change in demand that a driver adopts in a step
LOOKS_EVERY = wp.constant(3)  # steps after which a driver looks at crossing traffic again
RELAXES = wp.constant(0.8)  # share of the demand that remains when a driver sees that less is needed
HARDEST = wp.constant(9.0)  # m/s^2
CREEPS = wp.constant(4.0)  # m/s
CRUISES = wp.constant(8.0)  # m/s from which the reaction time is the full one
LAST_GAP = wp.constant(1.0)  # m that a late driver keeps to its stopping place
LAUNCH = wp.constant(0.6)  # share by which acceleration from rest is larger
LAUNCHED = wp.constant(8.0)  # m/s from which acceleration is ordinary
EARLY = wp.constant(1.4)  # times the comfortable deceleration, at most, when a driver begins to brake early
LONGEST_WAIT = wp.constant(20.0)  # s
PASS_GAP = wp.constant(1.0)  # m between a driver and a conflict when the other agent leaves it
YIELD_GAP = wp.constant(2.0)  # m before a conflict at which a driver comes to rest
YIELD_LEAST = wp.constant(0.4)  # m before a conflict at which a late driver stops
SLOWING = wp.constant(0.6)  # times the comfortable deceleration, before a bend
SAMPLES = wp.constant(8)  # points of the road ahead at which a driver looks for bends
LOOKS = wp.constant(200.0)  # m ahead that a driver looks for bends
DRIFT = wp.constant(20.0)  # s over which the misjudgement of gaps changes
LAPSE = wp.constant(2.0)  # s of an error
SWERVE = wp.constant(6.0)  # s over which the place in the lane changes
WANDER = wp.constant(0.05)  # m by which that place varies


@wp.func
def looks_at_crossing(state: State, b: int, i: int) -> bool:
    """Return whether a driver looks at crossing traffic in this step: every `LOOKS_EVERY` steps, not all at once."""
    return (state.step[b] + i) % LOOKS_EVERY == 0


@wp.func
def driver_power(own_speed: float, style: wp.vec4) -> float:
    """Return the acceleration that the driver wants on a free road, m/s^2: stronger from rest than while following.

    Source: the falling acceleration of starts, Long (2000), Transportation Research Record 1737.
    """
    return style[2] * (1.0 + LAUNCH * wp.clamp(1.0 - own_speed / LAUNCHED, 0.0, 1.0))


@wp.func
def follow_need(own_speed: float, leader_speed: float, room: float) -> float:
    """Return the deceleration that keeps a driver from using up its room, also if its leader brakes."""
    slower = wp.max(own_speed - leader_speed, 0.0)
    least_room = wp.max(room, 0.2)
    return wp.max(
        slower * slower / (2.0 * least_room),
        own_speed * own_speed / (2.0 * (least_room + leader_speed * leader_speed / (2.0 * LEADER_BRAKES))),
    )


@wp.func
def driver_follows(own_speed: float, leader_speed: float, gap: float, style: wp.vec4) -> float:
    """Return the reaction to a leader `gap` metres ahead that drives at `leader_speed` m/s."""
    closing = own_speed * (own_speed - leader_speed) / (2.0 * wp.sqrt(style[2] * style[3]))
    ratio = (style[1] + wp.max(0.0, own_speed * style[0] + closing)) / wp.max(gap, 0.1)
    power = driver_power(own_speed, style)
    wish = power * (1.0 - ratio * ratio)
    need = follow_need(own_speed, leader_speed, gap - 0.8 * style[1])
    if need > FIRM:
        # a late driver stops nearer to the leader
        need = wp.max(FIRM, follow_need(own_speed, leader_speed, gap - LAST_GAP))
    return wp.max(wish, -wp.max(style[3], SMOOTH * need)) - power


@wp.func
def driver_stops(own_speed: float, distance: float, style: wp.vec4) -> float:
    """Return the reaction to a place `distance` metres ahead of the front, before which the driver stops.

    It comes to rest about the standstill gap before the place, with the comfortable deceleration if there is time.
    """
    room = wp.max(distance - 0.8 * style[1], 0.3)
    need = own_speed * own_speed / (2.0 * room)
    share = need / style[3]
    power = driver_power(own_speed, style)
    allowed = power - (power + style[3]) * share * share
    if share > 1.0:
        # a late driver stops nearer to the place
        late = own_speed * own_speed / (2.0 * wp.max(distance - LAST_GAP, 0.3))
        allowed = -wp.max(style[3], late * wp.min(share, SMOOTH))
    if distance < style[1]:
        ratio = style[1] / wp.max(distance, 0.1)
        allowed = wp.min(allowed, wp.max(power * (1.0 - ratio * ratio), -style[3]))
    return allowed - power


@wp.func
def early_distance(distance: float, own_speed: float, accel: float, jerk: float, style: wp.vec4) -> float:
    """Return the distance to a stop less what the driver covers until it brakes comfortably, at least half of it."""
    lag = 0.5 * wp.max(accel + style[3], 0.0) / jerk
    return wp.max(distance - own_speed * lag, 0.5 * distance)


@wp.func
def early_react(react: float, early: float, own_speed: float, style: wp.vec4) -> float:
    """Return the reaction `early` to an earlier place, at most `EARLY` strong where `react` to the place asks less."""
    return wp.max(early, wp.min(react, -EARLY * style[3] - driver_power(own_speed, style)))


@wp.func
def driver_yields(own_speed: float, gap: float, style: wp.vec4) -> float:
    """Return the reaction to a conflict `gap` metres ahead of the front; its margins are room to stop in."""
    need = own_speed * own_speed / (2.0 * wp.max(gap - YIELD_GAP, 0.3))
    share = need / style[3]
    power = driver_power(own_speed, style)
    allowed = power - (power + style[3]) * share
    if share > 1.0:
        late = own_speed * own_speed / (2.0 * wp.max(gap - YIELD_LEAST, 0.3))
        if own_speed < CREEPS:
            late = wp.min(late, FIRM)  # half a metre less is no matter at such a speed
        allowed = -wp.max(style[3], late * wp.min(share, SMOOTH))
    if gap < YIELD_GAP + 0.5:
        # the nearer, the firmer it holds
        allowed = wp.min(allowed, -(0.8 - 0.6 * gap / (YIELD_GAP + 0.5)) * style[3])
    return allowed - power


@wp.func
def driver_arrives_after(own_speed: float, gap: float, time: float, style: wp.vec4) -> float:
    """Return the reaction with which the front is at a place `gap` metres ahead in `time` s, not at rest.

    -FAR where it would have to stop before.
    """
    react = -FAR
    room = gap - PASS_GAP
    if room > 0.5 * own_speed * time and time < LONGEST_WAIT:
        react = wp.min(
            2.0 * (room - own_speed * time) / wp.max(time * time, 0.01) - driver_power(own_speed, style), 0.0
        )
    return react


@wp.func
def driver_speed(roads: Roads, route: wp.vec2i, at: int, own_speed: float, pace: float, deceleration: float) -> float:
    """Return the speed from which the driver reaches every bend ahead at its speed there, slowing down early."""
    slope = 2.0 * SLOWING * deceleration
    reach = wp.min(own_speed * own_speed / slope + 8.0, LOOKS)
    squared_speed = float(FAR)
    for sample in range(SAMPLES):
        metres = int(reach * float(sample + 1) / float(SAMPLES))
        point = wp.min(at + metres, route[1] - 1)
        cap = pace * roads.rule[route[0] + point][0]
        squared_speed = wp.min(squared_speed, cap * cap + slope * float(point - at))
    return wp.min(pace * roads.rule[route[0] + at][0], wp.sqrt(squared_speed))


@wp.func
def driver_accelerates(own_speed: float, target: float, style: wp.vec4) -> float:
    """Return the acceleration on a free road, m/s^2; above the target speed a smooth return to it."""
    if own_speed > target:
        return wp.max(-1.5 * (own_speed - target), -style[3])
    ratio = own_speed / wp.max(target, 0.1)
    return driver_power(own_speed, style) * (1.0 - ratio * ratio * ratio * ratio)


@wp.func
def slow_noise(noise_key: int, time: float, period: float) -> float:
    """Return a standard normal number that changes over `period` s: a function of key and time alone."""
    place = time / period
    first = int(place)
    share = place - float(first)
    before = wp.randn(wp.rand_init(noise_key, first))
    after = wp.randn(wp.rand_init(noise_key, first + 1))
    share = share * share * (3.0 - 2.0 * share)
    mixed = before + share * (after - before)
    # a mixture of two is narrower than each of them
    return mixed / wp.sqrt((1.0 - share) * (1.0 - share) + share * share)


@wp.func
def judged_share(manner: wp.vec4, habit: wp.vec3, time: float) -> float:
    """Return the factor with which the driver misjudges gaps: log-normal, correlated over `DRIFT` s.

    Source: Treiber, Kesting and Helbing (2006), the estimation errors of the Human Driver Model.
    """
    share = float(1.0)
    if manner[3] > 0.0:
        share = wp.exp(manner[3] * wp.clamp(slow_noise(int(habit[2]), time, DRIFT), -3.0, 3.0))
    return share


@wp.func
def is_lapsed(habit: wp.vec3, time: float) -> bool:
    """Return whether the driver is in the midst of an error; each `LAPSE` s begin one with equal chance."""
    if habit[1] <= 0.0:
        return False
    chance = habit[1] * LAPSE / 3600.0
    return wp.randf(wp.rand_init(int(habit[2]) + 1, int(time / LAPSE))) < chance


@wp.func
def lane_place(habit: wp.vec3, time: float) -> float:
    """Return how far left of the lane's middle the driver wants to be, m."""
    return habit[0] + WANDER * wp.clamp(slow_noise(int(habit[2]) + 2, time, SWERVE), -2.0, 2.0)


@wp.func
def delay(reaction_time: float, speed: float, junction: float) -> float:
    """Return the time until a driver begins to brake, s; junction: m to the next one, 0 inside."""
    share = wp.clamp(speed / CRUISES, ATTENTIVE, 1.0)
    if junction < PREPARED:
        share = ATTENTIVE
    return reaction_time * share


@wp.func
def pedal_change(demand: float, accel: float, jerk: float, time_step: float) -> float:
    """Return the acceleration to which a driver comes in a step, from `accel` towards `demand`."""
    down = jerk * wp.clamp(-demand / HASTE, 1.0, 6.0)
    if accel > 0.0 and demand < 0.0:
        down = wp.max(down, RELEASE * jerk)
    return wp.clamp(demand, accel - down * time_step, accel + jerk * time_step)
