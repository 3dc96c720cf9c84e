"""Observations of drivers outside the world: arrays of one step in the frame of each agent that they drive."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ssad.core.driving import LaneRelation, Observation, WorldState
from ssad.core.geometry import to_local
from ssad.core.types import F32, I8, I32, U8, AgentKind, Bool
from ssad.world.kernels.data import FAR

AHEAD = 40  # route points
NEAREST = 16  # rows of `others`
SIGHT = 60.0  # m


def observe(state: WorldState, agents: I32, ended: Bool, readings: Mapping[str, Any] | None = None) -> Observation:
    """Return the observation of agents [N, 2] (scene, agent); see `ssad.core.driving.Observation`. ended [B]."""
    scene, agent = np.asarray(agents, np.int32).T
    pose = state.pose[scene, agent]
    speed = state.speed[scene, agent]
    route, lane_offset, heading_error, route_point = _route(state, scene, agent, pose)
    neighbours, relation, turn_signal = _neighbours(state, scene, agent, pose)
    return Observation(
        scene=scene.copy(),
        agent=agent.copy(),
        time=state.time[scene].astype(np.float32),
        speed=speed,
        accel=state.accel[scene, agent],
        pose=pose,
        target_speed=state.target_speed[scene, agent],
        route=route.astype(np.float32),
        lane_offset=lane_offset.astype(np.float32),
        heading_error=heading_error.astype(np.float32),
        others=neighbours,
        others_lane=relation,
        signal=_signal(state, scene, route_point),
        done=ended[scene],
        others_turn_signal=turn_signal,
        readings={} if readings is None else readings,
    )


def _route(state: WorldState, scene: I32, agent: I32, own_pose: F32) -> tuple[Any, Any, Any, I32]:
    """`route`, `lane_offset`, `heading_error`, and [N] the nearest point in `state.roads`, -1 without a route."""
    first_point, point_count = np.moveaxis(state.route[scene, agent], -1, 0)
    indices = np.minimum(state.progress[scene, agent][:, None] + 1 + np.arange(AHEAD), point_count[:, None] - 1)
    route = to_local(own_pose[:, None], state.roads.path[np.maximum(indices + first_point[:, None], 0), :2])
    straight = np.stack([np.arange(1.0, AHEAD + 1), np.zeros(AHEAD)], 1)
    has_route = point_count > 1
    route = np.where(has_route[:, None, None], route, straight)
    nearest_point = np.where(has_route, first_point + state.progress[scene, agent], -1)
    point = state.roads.path[np.maximum(nearest_point, 0)]
    offset = np.where(has_route, to_local(point[:, :3], own_pose[:, :2])[:, 1], 0.0)
    heading_error = np.where(has_route, np.angle(np.exp(1j * (own_pose[:, 2] - point[:, 2]))), 0.0)
    return route, offset, heading_error, nearest_point


def _neighbours(state: WorldState, scene: I32, agent: I32, own_pose: F32) -> tuple[F32, U8, I8]:
    """`others`, `others_lane` and `others_turn_signal`."""
    pose, kind = state.pose[scene], state.kind[scene]
    positions = to_local(own_pose[:, None], pose[..., :2])
    distance = np.hypot(*np.moveaxis(pose[..., :2] - own_pose[:, None, :2], -1, 0))
    visible = state.active[scene] & (kind != AgentKind.NONE) & (distance <= SIGHT)
    row_index = np.arange(len(scene))
    visible[row_index, agent] = False
    # A stable sort: equally distant agents keep their order on every machine.
    nearest_order = np.argsort(np.where(visible, distance, np.inf), axis=1, kind="stable")[:, :NEAREST]
    row_index = row_index[:, None]
    size = state.size[scene]
    relative_yaw = np.angle(np.exp(1j * (pose[..., 2] - own_pose[:, None, 2])))
    columns = (positions[..., 0], positions[..., 1], relative_yaw, state.speed[scene], size[..., 0], size[..., 1], kind)
    features = np.stack([column.astype(np.float32) for column in columns], -1)
    features = np.where(visible[..., None], features, 0.0)[row_index, nearest_order]
    features_by_agent = np.zeros((len(scene), NEAREST, 7), np.float32)
    features_by_agent[:, : features.shape[1]] = features
    relation = np.zeros((len(scene), NEAREST), np.uint8)
    relations = lane_relations(state, scene, agent)[row_index, nearest_order]
    relation[:, : features.shape[1]] = np.where(visible[row_index, nearest_order], relations, LaneRelation.ELSEWHERE)
    turn_signal = np.zeros((len(scene), NEAREST), np.int8)
    shown = state.turn_signal[scene][row_index, nearest_order]
    turn_signal[:, : features.shape[1]] = np.where(visible[row_index, nearest_order], shown, 0)
    return features_by_agent, relation, turn_signal


def lane_relations(state: WorldState, scene: I32, agent: I32) -> U8:
    """Return the `LaneRelation` [N, A] of every agent of the scene to the observing agent."""
    roads = state.roads
    lane, own_lane = state.lane[scene], state.lane[scene, agent][:, None]
    on_road = (lane >= 0) & (own_lane >= 0)
    relations = np.zeros(lane.shape, np.uint8)
    first_point, point_count = np.moveaxis(state.route[scene, agent], -1, 0)
    indices = np.minimum(state.progress[scene, agent][:, None] + np.arange(int(SIGHT)), point_count[:, None] - 1)
    route_lanes = np.where((point_count > 1)[:, None], roads.lane[np.maximum(indices + first_point[:, None], 0)], -1)
    # In ascending precedence: later assignments overwrite earlier ones.
    relations[(lane >= 0) & (lane[:, :, None] == route_lanes[:, None]).any(-1)] = LaneRelation.ROUTE
    relations[on_road & (lane == roads.right[own_lane])] = LaneRelation.RIGHT
    relations[on_road & (lane == roads.left[own_lane])] = LaneRelation.LEFT
    relations[on_road & (lane == own_lane)] = LaneRelation.SAME
    return relations


def _signal(state: WorldState, scene: I32, at: I32) -> F32:
    """`signal`: state and metres to the stop line of the next one."""
    next_signal = np.where(at >= 0, state.roads.signal[at], -1)
    signal_rows = np.zeros((len(scene), 2), np.float32)
    # Without a signal ahead the lookup reads the last one, and `where` discards it.
    signal_rows[:, 0] = np.where(next_signal >= 0, state.signal[scene, next_signal], 0)
    signal_rows[:, 1] = np.where(next_signal >= 0, state.roads.rule[at, 1], FAR)
    return signal_rows
