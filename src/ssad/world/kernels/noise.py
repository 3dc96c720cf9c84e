"""Randomness in traffic: uneven acceleration, careless lane changes, and the lapses of a driver.

All of it comes from standard normal numbers that depend only on the scene's key, the step and the agent. A scene
restored with its key therefore continues bit-exactly, and differently with another key. Two processes per agent
(Ornstein-Uhlenbeck, exact in discrete time) turn the numbers into behaviour.
"""

import warp as wp

from ssad.core.types import Controller
from ssad.world.kernels.data import End, EpisodeArrays, Presence, Roads, State
from ssad.world.kernels.lanes import lanes_left
from ssad.world.kernels.overtake import RAMP_LEAST


@wp.struct
class NoiseRule:
    """Parameters of the processes; see `ssad.world.noise.Noise`."""

    accel: wp.float32  # m/s^2, standard deviation
    keep: wp.vec2  # what is left of each process after a step
    lapse: wp.float32  # the ego does not attend while its second process is above this
    careless: wp.float32  # background traffic changes lane while its second process is above this (left) or below minus
    ramp: wp.float32  # s that such a lane change takes
    stretch: wp.int32  # steps of a stretch of `push` and `total`
    stretches: wp.int32


@wp.struct
class NoiseState:
    """Changing state of the processes, one row per scene."""

    key: wp.array(dtype=wp.uint64)  # [B]
    drift: wp.array2d(dtype=wp.vec2)  # [B, A] the two processes
    held: wp.array2d(dtype=wp.vec2)  # [B, A] throttle and brake of the last step in which it attended
    push: wp.array3d(dtype=wp.vec2)  # [B, A, L] by how much the mean of the normal numbers is moved
    total: wp.array3d(dtype=wp.vec2)  # [B, A, L] sum of the normal numbers so far, moved as they are


@wp.func
def mix_bits(word: wp.uint64) -> wp.uint64:
    """Return 64 bits, each of which depends on all bits of `word` (the finaliser of SplitMix64)."""
    mixed = word
    mixed = (mixed ^ (mixed >> wp.uint64(30))) * wp.uint64(0xBF58476D1CE4E5B9)
    mixed = (mixed ^ (mixed >> wp.uint64(27))) * wp.uint64(0x94D049BB133111EB)
    return mixed ^ (mixed >> wp.uint64(31))


@wp.func
def normals(key: wp.uint64, step: int, agent: int) -> wp.vec2:
    """Return two independent standard normal numbers (Box and Muller)."""
    counter = wp.uint64(step * 64 + agent + 1) * wp.uint64(0x9E3779B97F4A7C15)
    word = mix_bits(mix_bits(key + counter) ^ counter)
    scale = wp.float32(2.3283064365386963e-10)  # 2^-32
    # The half keeps the argument of the logarithm above 0.
    first_uniform = (wp.float32(wp.uint32(word >> wp.uint64(32))) + 0.5) * scale
    second_uniform = (wp.float32(wp.uint32(word & wp.uint64(0xFFFFFFFF))) + 0.5) * scale
    radius = wp.sqrt(-2.0 * wp.log(wp.min(first_uniform, 1.0)))
    return wp.vec2(
        radius * wp.cos(6.283185307179586 * second_uniform), radius * wp.sin(6.283185307179586 * second_uniform)
    )


@wp.func
def apply_noise(bank: EpisodeArrays, roads: Roads, state: State, rule: NoiseRule, noise: NoiseState, b: int, i: int):
    """Turn the processes of an agent into behaviour."""
    controller = state.controller[b, i]
    control = state.control[b, i]
    drift = noise.drift[b, i]
    if i == 0:
        if controller == Controller.AUTOPILOT or controller == Controller.FOLLOW:
            if drift[1] > rule.lapse:
                held_pedals = noise.held[b, i]
                state.control[b, i] = wp.vec4(held_pedals[0], held_pedals[1], control[2], control[3])
            else:
                noise.held[b, i] = wp.vec2(control[0], control[1])
        return
    if controller != Controller.AUTOPILOT or state.active[b, i] != Presence.AWAKE or control[3] > 0.5:
        return
    e = state.episode[b]
    speed = state.speed[b, i]
    if speed < 0.5 and control[1] > 0.0:
        return  # A standing agent has no reason to creep.
    power = bank.power[bank.model[e, i]]
    accel = control[0] * power[0] - control[1] * power[1] + rule.accel * drift[0]
    throttle = wp.clamp(accel / wp.max(power[0], 0.1), 0.0, 1.0)
    brake = wp.clamp(-accel / wp.max(power[1], 0.1), 0.0, 1.0)
    state.control[b, i] = wp.vec4(throttle, brake, control[2], control[3])
    route = bank.route[e, i]
    shift = state.shift[b, i]
    along = state.aim[b, i][0]
    if wp.abs(drift[1]) > rule.careless and route[1] > 1 and along >= shift[1] and shift[3] == 0.0:
        point = state.progress[b, i]
        adjacent_lanes = roads.beside[route[0] + point]
        change_length = wp.max(2.0 * RAMP_LEAST * bank.body[bank.model[e, i]][0], rule.ramp * speed)
        side = 1.0
        leads_on = adjacent_lanes[1]
        if drift[1] < 0.0:
            side = -1.0
            leads_on = adjacent_lanes[3]
        if leads_on - (along - float(point)) > change_length + 10.0:
            state.shift[b, i] = wp.vec4(along, along + change_length, lanes_left(shift, along), side)


@wp.kernel(enable_backward=False)
def advance_noise(
    bank: EpisodeArrays, roads: Roads, state: State, rule: NoiseRule, noise: NoiseState, agents: int, threads: int
):
    """Advance the processes of every agent and apply them; runs last before a step's motion."""
    b, first = wp.tid()
    if state.end[b] != End.RUNNING:
        return
    step = state.step[b]
    stretch = int(0)
    if step > 0:
        stretch = wp.min(1 + (step - 1) / rule.stretch, rule.stretches - 1)
    for i in range(first, agents, threads):
        normal = normals(noise.key[b], step, i) + noise.push[b, i, stretch]
        drift = normal
        if step > 0:
            previous = noise.drift[b, i]
            drift = wp.vec2(
                rule.keep[0] * previous[0] + wp.sqrt(1.0 - rule.keep[0] * rule.keep[0]) * normal[0],
                rule.keep[1] * previous[1] + wp.sqrt(1.0 - rule.keep[1] * rule.keep[1]) * normal[1],
            )
        noise.total[b, i, stretch] = noise.total[b, i, stretch] + normal
        noise.drift[b, i] = drift
        apply_noise(bank, roads, state, rule, noise, b, i)


@wp.kernel(enable_backward=False)
def reset_noise(
    state: State, noise: NoiseState, mask: wp.array(dtype=wp.int32), ended_too: int, agents: int, stretches: int
):
    """Reset the processes of scenes; scenes that restart by themselves get a new key. Like `restart`."""
    b = wp.tid()
    again = ended_too == 1 and state.end[b] != End.RUNNING
    if again:
        noise.key[b] = mix_bits(noise.key[b] + wp.uint64(0xD1B54A32D192ED03))
    if again or mask[b] == 1:
        for i in range(agents):
            noise.drift[b, i] = wp.vec2(0.0, 0.0)
            noise.held[b, i] = wp.vec2(0.0, 0.0)
            for stretch in range(stretches):
                noise.total[b, i, stretch] = wp.vec2(0.0, 0.0)
