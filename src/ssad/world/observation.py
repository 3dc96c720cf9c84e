"""What a driving system outside the world sees: arrays of one step in the ego's frame."""

from __future__ import annotations

import numpy as np

from ssad.core.geometry import to_local
from ssad.core.protocols import Observation
from ssad.core.types import AgentKind
from ssad.world.kernels.data import FAR, End, Presence
from ssad.world.world import World, signal_states

AHEAD = 40  # route points
NEAREST = 16  # rows of `others`
SIGHT = 60.0  # m


def make_observation(world: World) -> Observation:
    """The view of every ego of `world`; see `ssad.core.protocols.Observation`."""
    batch = world.batch
    pose = world.array("pose")
    speed = world.array("speed")
    episode = world.array("episode")
    here = pose[:, 0]
    first = world.bank.route.numpy()[episode, 0]
    at = world.array("progress")[:, 0]
    path = world.roads.path.numpy()
    index = np.minimum(at[:, None] + 1 + np.arange(AHEAD), first[:, 1:2] - 1) + first[:, :1]
    route = to_local(here[:, None], path[index, :2])
    point = path[first[:, 0] + at]
    offset = to_local(point[:, :3], here[:, :2])[:, 1]
    error = np.angle(np.exp(1j * (here[:, 2] - point[:, 2])))

    place = to_local(here[:, None], pose[..., :2])
    distance = np.hypot(*np.moveaxis(pose[..., :2] - here[:, None, :2], -1, 0))
    there = (world.array("active") != Presence.ABSENT) & (world.kind != AgentKind.NONE) & (distance <= SIGHT)
    there[:, 0] = False
    order = np.argsort(np.where(there, distance, np.inf), axis=1, kind="stable")[:, :NEAREST]
    rows = np.arange(batch)[:, None]
    models = np.maximum(world.bank.model.numpy()[episode], 0)
    body = world.bank.body.numpy()[models]
    turn = np.angle(np.exp(1j * (pose[..., 2] - here[:, None, 2])))
    columns = (place[..., 0], place[..., 1], turn, speed, 2 * body[..., 0], 2 * body[..., 1], world.kind)
    table = np.stack([column.astype(np.float32) for column in columns], -1)
    table = np.where(there[..., None], table, 0.0)[rows, order]
    others = np.zeros((batch, NEAREST, 7), np.float32)
    others[:, : table.shape[1]] = table

    signal = np.zeros((batch, 2), np.float32)
    signal[:, 1] = FAR
    rule = world.roads.rule.numpy()[first[:, 0] + at]
    lamp = world.roads.path_signal.numpy()[first[:, 0] + at]
    time = world.array("step") * world.dt
    for b in np.flatnonzero(lamp >= 0):
        e = world.episodes[int(episode[b])]
        signal[b, 0] = signal_states(e, world.graphs[e.town], time[b : b + 1])[0, lamp[b]]
        signal[b, 1] = rule[b, 1]
    return Observation(
        time=time.astype(np.float32),
        speed=speed[:, 0].copy(),
        accel=world.array("ego.accel").copy(),
        pose=here.copy(),
        target_speed=world.bank.cruise.numpy()[episode, 0, 0].copy(),
        route=route.astype(np.float32),
        lane_offset=offset.astype(np.float32),
        heading_error=error.astype(np.float32),
        others=others,
        signal=signal,
        done=world.ended() != End.RUNNING,
    )
