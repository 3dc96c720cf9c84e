"""What drivers outside the world see: arrays of one step in the frame of each agent that they drive."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ssad.core.driving import LaneRelation, Observation, WorldState
from ssad.core.geometry import to_local
from ssad.core.types import F32, I32, U8, AgentKind, Bool
from ssad.world.kernels.data import FAR

AHEAD = 40  # route points
NEAREST = 16  # rows of `others`
SIGHT = 60.0  # m


def observe(state: WorldState, agents: I32, ended: Bool, readings: Mapping[str, Any] | None = None) -> Observation:
    """What the agents [N, 2] (scene, agent) see; see `ssad.core.driving.Observation`. ended [B]."""
    scene, agent = np.asarray(agents, np.int32).T
    here = state.pose[scene, agent]
    speed = state.speed[scene, agent]
    route, offset, error, at = _route(state, scene, agent, here)
    others, relation = _others(state, scene, agent, here)
    return Observation(
        scene=scene.copy(),
        agent=agent.copy(),
        time=state.time[scene].astype(np.float32),
        speed=speed,
        accel=state.accel[scene, agent],
        pose=here,
        target_speed=state.target_speed[scene, agent],
        route=route.astype(np.float32),
        lane_offset=offset.astype(np.float32),
        heading_error=error.astype(np.float32),
        others=others,
        others_lane=relation,
        signal=_signal(state, scene, at),
        done=ended[scene],
        readings={} if readings is None else readings,
    )


def _route(state: WorldState, scene: I32, agent: I32, here: F32) -> tuple[Any, Any, Any, I32]:
    """`route`, `lane_offset`, `heading_error`, and [N] the nearest point in `state.roads`, -1 without a route."""
    first, count = np.moveaxis(state.route[scene, agent], -1, 0)
    index = np.minimum(state.progress[scene, agent][:, None] + 1 + np.arange(AHEAD), count[:, None] - 1)
    route = to_local(here[:, None], state.roads.path[np.maximum(index + first[:, None], 0), :2])
    straight = np.stack([np.arange(1.0, AHEAD + 1), np.zeros(AHEAD)], 1)
    has = count > 1
    route = np.where(has[:, None, None], route, straight)
    at = np.where(has, first + state.progress[scene, agent], -1)
    point = state.roads.path[np.maximum(at, 0)]
    offset = np.where(has, to_local(point[:, :3], here[:, :2])[:, 1], 0.0)
    error = np.where(has, np.angle(np.exp(1j * (here[:, 2] - point[:, 2]))), 0.0)
    return route, offset, error, at


def _others(state: WorldState, scene: I32, agent: I32, here: F32) -> tuple[F32, U8]:
    """`others` and `others_lane`."""
    pose, kind = state.pose[scene], state.kind[scene]
    place = to_local(here[:, None], pose[..., :2])
    distance = np.hypot(*np.moveaxis(pose[..., :2] - here[:, None, :2], -1, 0))
    there = state.active[scene] & (kind != AgentKind.NONE) & (distance <= SIGHT)
    rows = np.arange(len(scene))
    there[rows, agent] = False
    order = np.argsort(np.where(there, distance, np.inf), axis=1, kind="stable")[:, :NEAREST]
    rows = rows[:, None]
    size = state.size[scene]
    turn = np.angle(np.exp(1j * (pose[..., 2] - here[:, None, 2])))
    columns = (place[..., 0], place[..., 1], turn, state.speed[scene], size[..., 0], size[..., 1], kind)
    table = np.stack([column.astype(np.float32) for column in columns], -1)
    table = np.where(there[..., None], table, 0.0)[rows, order]
    others = np.zeros((len(scene), NEAREST, 7), np.float32)
    others[:, : table.shape[1]] = table
    relation = np.zeros((len(scene), NEAREST), np.uint8)
    found = lane_relations(state, scene, agent)[rows, order]
    relation[:, : table.shape[1]] = np.where(there[rows, order], found, LaneRelation.ELSEWHERE)
    return others, relation


def lane_relations(state: WorldState, scene: I32, agent: I32) -> U8:
    """[N, A] `LaneRelation` of every agent of the scene to the agent that looks."""
    roads = state.roads
    lane, mine = state.lane[scene], state.lane[scene, agent][:, None]
    on_road = (lane >= 0) & (mine >= 0)
    out = np.zeros(lane.shape, np.uint8)
    first, count = np.moveaxis(state.route[scene, agent], -1, 0)
    index = np.minimum(state.progress[scene, agent][:, None] + np.arange(int(SIGHT)), count[:, None] - 1)
    taken = np.where((count > 1)[:, None], roads.lane[np.maximum(index + first[:, None], 0)], -1)
    out[(lane >= 0) & (lane[:, :, None] == taken[:, None]).any(-1)] = LaneRelation.ROUTE
    out[on_road & (lane == roads.right[mine])] = LaneRelation.RIGHT
    out[on_road & (lane == roads.left[mine])] = LaneRelation.LEFT
    out[on_road & (lane == mine)] = LaneRelation.SAME
    return out


def _signal(state: WorldState, scene: I32, at: I32) -> F32:
    """`signal`: state and metres to the stop line of the next one."""
    lamp = np.where(at >= 0, state.roads.signal[at], -1)
    out = np.zeros((len(scene), 2), np.float32)
    out[:, 0] = np.where(lamp >= 0, state.signal[scene, lamp], 0)
    out[:, 1] = np.where(lamp >= 0, state.roads.rule[at, 1], FAR)
    return out
