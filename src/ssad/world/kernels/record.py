"""Contacts of all agents, and the record of each scene's ego for the metrics and the end of the episode."""

import warp as wp

from ssad.core.types import AgentKind, Contact, Controller, SignalState
from ssad.world.kernels.data import (
    FAR,
    ContactPolicy,
    Ego,
    End,
    EpisodeArrays,
    PerceivedAgents,
    Presence,
    Roads,
    State,
    TurnRank,
    Work,
)
from ssad.world.kernels.shared import BRIDGE, boxes_touch, height_of, on_track, row, sign_line, signal_state, wrap


@wp.func
def halfway_pose(a: wp.vec3, b: wp.vec3) -> wp.vec3:
    """Return the pose half-way between two."""
    return wp.vec3(0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1]), a[2] + 0.5 * wrap(b[2] - a[2]))


@wp.func
def look_for_contacts(bank: EpisodeArrays, roads: Roads, state: State, b: int, i: int, agents: int):
    """Find the agents that an agent touches at the end of the step and half-way through it; wake it near the ego."""
    mask = wp.int64(0)
    if state.active[b, i] != Presence.ABSENT:
        e = state.episode[b]
        own_pose = state.pose[b, i]
        own_previous = state.previous[b, i]
        own_body = bank.body[bank.model[e, i]]
        reach = own_body[0] + own_body[1]
        for j in range(agents):
            if j != i and state.active[b, j] != Presence.ABSENT:
                other_pose = state.pose[b, j]
                dx = other_pose[0] - own_pose[0]
                dy = other_pose[1] - own_pose[1]
                other_body = bank.body[bank.model[e, j]]
                reach_sum = reach + other_body[0] + other_body[1] + 4.0
                if dx * dx + dy * dy < reach_sum * reach_sum:
                    hit = boxes_touch(own_pose, own_body[0], own_body[1], other_pose, other_body[0], other_body[1])
                    if not hit:
                        other_previous = state.previous[b, j]
                        hit = boxes_touch(
                            halfway_pose(own_previous, own_pose),
                            own_body[0],
                            own_body[1],
                            halfway_pose(other_previous, other_pose),
                            other_body[0],
                            other_body[1],
                        )
                    if hit:
                        level_difference = height_of(bank, roads, state, b, i) - height_of(bank, roads, state, b, j)
                        hit = not wp.abs(level_difference) > BRIDGE  # NaN: unknown, as on one level
                    if hit:
                        mask = mask | (wp.int64(1) << wp.int64(j))
        if state.active[b, i] == Presence.ASLEEP:
            ego = state.pose[b, 0]
            if wp.length(wp.vec2(ego[0] - own_pose[0], ego[1] - own_pose[1])) < bank.cruise[e, i][1]:
                state.active[b, i] = Presence.AWAKE
    state.touch[b, i] = mask


@wp.kernel(enable_backward=False)
def contact(bank: EpisodeArrays, roads: Roads, state: State, work: Work, agents: int, threads: int):
    """Find the contacts of all agents; wake sleeping traffic."""
    b, first = wp.tid()
    if b == 0 and first == 0:
        work.count[0] = 0  # for the next step's `scan_all_agents`
        work.count[1] = 0
    if state.end[b] == End.RUNNING:
        for i in range(first, agents, threads):
            look_for_contacts(bank, roads, state, b, i, agents)


@wp.func
def contact_kind(kind: int) -> int:
    """Return the contact bit of an agent kind."""
    bit = int(Contact.VEHICLE)
    if kind == AgentKind.WALKER:
        bit = Contact.WALKER
    elif kind == AgentKind.BICYCLE:
        bit = Contact.CYCLIST
    elif kind == AgentKind.PROP:
        bit = Contact.STATIC
    return bit


@wp.kernel(enable_backward=False)
def record(bank: EpisodeArrays, roads: Roads, state: State, ego: Ego, agents: int, dt: float):
    """Update the ego's record, apply its contact policy and decide the end of the episode; one thread per scene."""
    b = wp.tid()
    if state.end[b] != End.RUNNING:
        return
    e = state.episode[b]
    step = state.step[b] + 1
    state.step[b] = step
    time = float(step) * dt
    pose = state.pose[b, 0]
    previous_pose = state.previous[b, 0]
    body = bank.body[bank.model[e, 0]]

    # contacts that began in this step
    touching = state.touch[b, 0]
    new_contacts = touching & (~ego.touching[b])
    ego.touching[b] = touching
    kinds = int(Contact.NONE)
    hit_agent = int(-1)
    if new_contacts != wp.int64(0):
        for j in range(1, agents):
            if ((new_contacts >> wp.int64(j)) & wp.int64(1)) == wp.int64(1):
                kinds = kinds | contact_kind(bank.kind[bank.model[e, j]])
                if hit_agent < 0:
                    hit_agent = j
    ego.contact[b] = kinds
    ego.contact_agent[b] = hit_agent
    policy = bank.contact[e]
    if policy == ContactPolicy.REMOVE:
        for j in range(1, agents):
            if ((new_contacts >> wp.int64(j)) & wp.int64(1)) == wp.int64(1):
                state.active[b, j] = Presence.ABSENT
                if state.controller[b, j] == Controller.TRAJECTORY:
                    state.controller[b, j] = Controller.NONE  # or it would be back in the next step

    # road
    lane = state.lane[b, 0]
    off_road = int(0)
    if lane < 0:
        off_road = 1
    ego.off_road[b] = off_road
    over_line = int(0)
    inside = int(0)
    if lane >= 0:
        inside = roads.lane_junction[lane]
        side = state.lateral[b, 0]
        if inside == 0 and wp.abs(side[0]) + body[1] > side[1]:
            over_line = 1
    elif ego.over_line[b] == 1 or off_road == 1:
        over_line = 1
    ego.invasion[b] = int(0)
    if over_line == 1 and ego.over_line[b] == 0:
        ego.invasion[b] = 1
    ego.over_line[b] = over_line

    # motion
    step_length = wp.length(wp.vec2(pose[0] - previous_pose[0], pose[1] - previous_pose[1]))
    ego.driven[b] = ego.driven[b] + step_length

    # route: a point is passed once the ego is beyond it, looking two points ahead (as SafeBench's route criterion)
    route = bank.route[e, 0]
    mark = ego.mark[b]
    passed = mark
    reach = wp.max(3, int(step_length) + 2)  # beyond 20 m/s an ego passes more than two points a step
    for candidate in range(reach):
        route_point = mark + candidate
        if route_point < route[1]:
            point = row(roads.path, route[0] + route_point)
            if (pose[0] - point[0]) * wp.cos(point[2]) + (pose[1] - point[1]) * wp.sin(point[2]) > 0.0:
                passed = route_point
    mark = passed
    ego.mark[b] = mark
    last = route[1] - 1
    share = 100.0 * float(mark) / float(last)
    last_point = roads.path[route[0] + last]
    to_end = wp.length(wp.vec2(pose[0] - last_point[0], pose[1] - last_point[1]))
    if share > 99.0 and to_end < 10.0:
        share = 100.0
    ego.complete[b] = wp.max(share, ego.complete[b])
    min_distance2 = FAR
    nearest_point = mark
    for candidate in range(wp.max(mark - 1, 0), wp.min(mark + 64, last) + 1):
        point = row(roads.path, route[0] + candidate)
        dx = pose[0] - point[0]
        dy = pose[1] - point[1]
        distance2 = dx * dx + dy * dy
        if distance2 < min_distance2:
            min_distance2 = distance2
            nearest_point = candidate
    ego.route_distance[b] = wp.sqrt(min_distance2)
    ego.route_point[b] = nearest_point

    # red light: the tail crosses the stop line on red; a town may allow a turn to the near side after a stop
    point = row(roads.path, route[0] + nearest_point)
    cosine = wp.cos(point[2])
    sine = wp.sin(point[2])
    lateral = -sine * (pose[0] - point[0]) + cosine * (pose[1] - point[1])
    ran_red = int(0)
    tail_point = nearest_point - int(body[0] + 1.0)
    if tail_point >= 0 and wp.abs(lateral) < 4.0:
        rule = row(roads.rule, route[0] + tail_point)
        index = roads.path_signal[route[0] + tail_point]
        if index >= 0 and rule[1] <= wp.max(step_length, 0.0) + 0.5 and rule[1] > -0.5:
            may_turn = int(rule[3]) % int(TurnRank.YIELD) == TurnRank.RIGHT and roads.grid[bank.town[e]][3] > 0.0
            stopped_right = may_turn and state.waited[b, 0] >= 1.0
            if signal_state(bank, roads, e, index, time) == SignalState.RED and not stopped_right:
                ran_red = 1
    # rule[1] is whole metres: count a line once
    if ran_red == 1 and ego.red_light[b] == 0:
        ego.red_light[b] = 1
    elif ran_red == 1:
        ego.red_light[b] = 2
    else:
        ego.red_light[b] = 0

    # stop sign: the same, where no signal is lit and the ego has not stopped before the line
    missed = int(0)
    if tail_point >= 0 and wp.abs(lateral) < 4.0:
        line = sign_line(roads, route[0], tail_point)
        passed_line = ego.sign_line[b]
        if line > passed_line:
            ego.sign_line[b] = line
            if passed_line >= 0 and state.halted[b, 0] < passed_line:
                missed = 1
                index = roads.path_signal[route[0] + wp.min(passed_line, tail_point)]
                if index >= 0 and signal_state(bank, roads, e, index, time) != SignalState.OFF:
                    missed = 0
    ego.stop_sign[b] = missed

    limits = bank.limits[e]
    end = int(End.RUNNING)
    if kinds != Contact.NONE and policy == ContactPolicy.END:
        end = End.COLLISION
    elif ego.complete[b] >= 100.0:
        end = End.COMPLETE
    elif float(step) >= limits[0]:
        end = End.MAX_STEPS
    elif ego.driven[b] >= limits[2]:
        end = End.MAX_DISTANCE
    elif time >= limits[1]:
        end = End.MAX_TIME
    state.end[b] = end


@wp.func
def reset_agent(bank: EpisodeArrays, roads: Roads, state: State, b: int, i: int):
    """Reset an agent to the start of its episode."""
    e = state.episode[b]
    start = bank.start[e, i]
    pose = wp.vec3(start[0], start[1], start[2])
    state.controller[b, i] = bank.controller[e, i]
    state.policy[b, i] = -1
    state.note[b, i] = 0
    state.cruise[b, i] = bank.cruise[e, i][0]
    state.pose[b, i] = pose
    state.previous[b, i] = pose
    state.speed[b, i] = start[3]
    state.accel[b, i] = 0.0
    state.wheel[b, i] = 0.0
    state.braking[b, i] = 0.0
    state.control[b, i] = wp.vec4(0.0, 0.0, 0.0, 0.0)
    state.progress[b, i] = 0
    state.phase[b, i] = 0
    state.travelled[b, i] = 0.0
    state.waited[b, i] = 0.0
    state.halted[b, i] = -1
    state.stalled[b, i] = 0
    state.shift[b, i] = wp.vec4(0.0, 0.0, 0.0, 0.0)
    state.touch[b, i] = wp.int64(0)
    state.lateral[b, i] = wp.vec2(0.0, 0.0)
    state.lane[b, i] = -1
    state.aim[b, i] = wp.vec2(0.0, 0.0)
    state.react[b, i] = 0.0
    state.pending[b, i] = wp.vec2(0.0, 0.0)
    presence = int(Presence.AWAKE)
    if bank.model[e, i] < 0:
        presence = Presence.ABSENT
    elif bank.controller[e, i] == Controller.TRAJECTORY and not on_track(roads, bank.track[e, i], 0.0):
        presence = Presence.ABSENT
    elif bank.cruise[e, i][1] > 0.0:
        presence = Presence.ASLEEP
    state.active[b, i] = presence


@wp.kernel(enable_backward=False)
def restart(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    mask: wp.array(dtype=wp.int32),
    ended_too: int,
    agents: int,
    threads: int,
):
    """Reset scenes to the start of their episode: where mask is 1, or (ended_too) where the episode has ended."""
    b, first = wp.tid()
    restarts = mask[b] == 1
    if ended_too == 1 and state.end[b] != End.RUNNING:
        restarts = True
    if restarts:
        for i in range(first, agents, threads):
            reset_agent(bank, roads, state, b, i)


@wp.kernel(enable_backward=False)
def restart_record(
    bank: EpisodeArrays,
    roads: Roads,
    state: State,
    perceived: PerceivedAgents,
    ego: Ego,
    mask: wp.array(dtype=wp.int32),
    ended_too: int,
):
    """Reset the scene's own arrays; runs after `restart`, since it clears the reason of the end."""
    b = wp.tid()
    restarts = mask[b] == 1
    if ended_too == 1 and state.end[b] != End.RUNNING:
        restarts = True
    if not restarts:
        return
    mask[b] = 0
    state.step[b] = 0
    state.end[b] = End.RUNNING
    perceived.believes[b] = 0
    ego.contact[b] = 0
    ego.contact_agent[b] = -1
    ego.touching[b] = wp.int64(0)
    ego.off_road[b] = 0
    ego.over_line[b] = 0
    ego.invasion[b] = 0
    ego.red_light[b] = 0
    ego.stop_sign[b] = 0
    ego.sign_line[b] = -1
    ego.complete[b] = 0.0
    ego.mark[b] = 0
    ego.route_distance[b] = 0.0
    ego.route_point[b] = 0
    ego.driven[b] = 0.0
