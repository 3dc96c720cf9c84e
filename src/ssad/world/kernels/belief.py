"""What can be known of everybody at the start of a step: the rows of `Seen` that hold the truth."""

import warp as wp

from ssad.core.types import AgentKind, Controller
from ssad.world.kernels.data import FAR, HORIZON, End, EpisodeArrays, Presence, Roads, Seen, State, TurnRank


@wp.kernel(enable_backward=False)
def see(bank: EpisodeArrays, roads: Roads, state: State, seen: Seen):
    """Fill every agent's own row."""
    b, i = wp.tid()
    if state.end[b] != End.RUNNING:
        return
    if state.active[b, i] == Presence.ABSENT:
        seen.kind[b, i] = AgentKind.NONE
        return
    e = state.episode[b]
    m = bank.model[e, i]
    body = bank.body[m]
    seen.kind[b, i] = bank.kind[m]
    seen.pose[b, i] = state.pose[b, i]
    seen.speed[b, i] = state.speed[b, i]
    seen.half[b, i] = wp.vec2(body[0], body[1])
    seen.span[b, i] = state.span[b, i]
    for k in range(HORIZON):
        seen.forecast[b, i, k] = state.forecast[b, i, k]
    way = wp.vec4(FAR, FAR, float(TurnRank.STRAIGHT), 0.0)
    signal = int(-1)
    route = bank.route[e, i]
    if route[1] > 1:
        at = route[0] + state.progress[b, i]
        rule = roads.rule[at]
        way = wp.vec4(wp.min(rule[1], rule[2]), rule[2], rule[3], roads.bend[at] + 0.5)
        signal = roads.path_signal[at]
    seen.way[b, i] = way
    seen.signal[b, i] = signal
    seen.waited[b, i] = state.waited[b, i]
    # traffic does not know who is under test: the ego is relied on like anybody, whoever drives it
    relied = int(0)
    if i == 0 or (state.controller[b, i] == Controller.AUTOPILOT and state.active[b, i] == Presence.AWAKE):
        relied = 1
    seen.gives_way[b, i] = relied
