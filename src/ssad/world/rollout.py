"""Run a batch of episodes to their ends with a driving system, and keep what happened."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ssad.core.errors import ConfigError
from ssad.core.lane_graph import LaneGraph
from ssad.core.protocols import DrivingSystem
from ssad.core.types import Controller, Episode, EpisodeTrace
from ssad.world.kernels.data import End, Presence
from ssad.world.observation import make_observation
from ssad.world.world import ENDS, World, signal_states

_AGENT = ("x", "y", "yaw", "speed", "active")
_EGO = {
    "accel": np.float32,
    "contact": np.uint8,
    "contact_agent": np.int32,
    "off_road": np.bool_,
    "route_distance": np.float32,
    "route_complete": np.float32,
    "driven": np.float32,
    "lane_invasion": np.uint8,
    "red_light": np.uint8,
    "throttle": np.float32,
    "brake": np.float32,
    "steer": np.float32,
}


def _row(world: World) -> dict[str, npt.NDArray[np.generic]]:
    """One step of all scenes."""
    pose = world.array("pose")
    control = world.array("control")[:, 0]
    return {
        "x": pose[..., 0].copy(),
        "y": pose[..., 1].copy(),
        "yaw": pose[..., 2].copy(),
        "speed": world.array("speed").copy(),
        "active": world.array("active") != Presence.ABSENT,
        "accel": world.array("ego.accel").copy(),
        "contact": world.array("ego.contact").astype(np.uint8),
        "contact_agent": world.array("ego.contact_agent").copy(),
        "off_road": world.array("ego.off_road") != 0,
        "route_distance": world.array("ego.route_distance").copy(),
        "route_complete": world.array("ego.complete").copy(),
        "driven": world.array("ego.driven").copy(),
        "lane_invasion": world.array("ego.invasion").astype(np.uint8),
        # 2 marks a line already counted in the step before
        "red_light": (world.array("ego.red_light") == 1).astype(np.uint8),
        "throttle": control[:, 0].copy(),
        "brake": control[:, 1].copy(),
        "steer": control[:, 2].copy(),
    }


def rollout(
    episodes: Sequence[Episode],
    graphs: Mapping[str, LaneGraph],
    system: DrivingSystem,
    *,
    device: str = "cpu",
) -> list[EpisodeTrace]:
    """Traces of the episodes, in order, driven by `system`.

    Raises ConfigError if the system returns controls of a wrong shape or not finite; what the system raises passes.
    """
    speed = getattr(system, "target_speed", None)
    world = World(episodes, graphs, device=device, ego=system.controller, ego_speed=speed)
    external = system.controller == Controller.EXTERNAL
    if external:
        system.reset(episodes)
    rows = [_row(world)]
    lengths = np.zeros(world.batch, np.int64)
    most = max(e.limits.max_steps for e in episodes)
    limit = min(most, int(max(e.limits.max_time for e in episodes) / world.dt) + 1)
    for step in range(1, limit + 1):
        if external:
            given = np.asarray(system.act(make_observation(world)), np.float32)
            if given.ndim != 2 or given.shape[0] != world.batch or given.shape[1] not in (3, 4):
                raise ConfigError(
                    f"system {system.name}: act returned shape {given.shape}, expected ({world.batch}, 3): "
                    "throttle, brake, steer"
                )
            running = world.ended() == End.RUNNING
            if not np.isfinite(given[running]).all():
                raise ConfigError(f"system {system.name}: act returned a control that is not finite")
            world.set_actions(np.where(running[:, None], given, 0.0))
        running = world.ended() == End.RUNNING
        world.step()
        rows.append(_row(world))
        lengths[running] = step
        if (world.ended() != 0).all():
            break
    return [_trace(world, rows, b, int(lengths[b]) + 1) for b in range(world.batch)]


def _trace(world: World, rows: list[dict[str, npt.NDArray[np.generic]]], b: int, steps: int) -> EpisodeTrace:
    episode = world.episodes[b]
    graph = world.graphs[episode.town]
    n = len(episode.agents)
    kinds = world.kind[b, :n]
    models = world.bank.model.numpy()[b, :n]
    body = world.bank.body.numpy()[models]
    agent = {name: np.stack([row[name][b, :n] for row in rows[:steps]]) for name in _AGENT}
    ego: dict[str, npt.NDArray[Any]] = {
        name: np.array([row[name][b] for row in rows[:steps]], dtype) for name, dtype in _EGO.items()
    }
    times = np.arange(steps) * world.dt
    route = episode.agents[0].route
    assert route is not None  # checked when the world was built
    junctions = {int(graph.junction[k]) for k in np.unique(route.lane[route.lane >= 0])} - {-1}
    near = np.flatnonzero(np.isin(graph.signal_junction, sorted(junctions))).astype(np.int32)
    return EpisodeTrace(
        key=episode.key,
        town=episode.town,
        dt=world.dt,
        names=tuple(a.name for a in episode.agents),
        models=tuple(a.model for a in episode.agents),
        kind=kinds.astype(np.uint8),
        length=(2 * body[:, 0]).astype(np.float32),
        width=(2 * body[:, 1]).astype(np.float32),
        x=agent["x"],
        y=agent["y"],
        yaw=agent["yaw"],
        speed=agent["speed"],
        active=agent["active"],
        accel=ego["accel"],
        contact=ego["contact"],
        contact_agent=ego["contact_agent"],
        off_road=ego["off_road"],
        route_distance=ego["route_distance"],
        route_complete=ego["route_complete"],
        driven=ego["driven"],
        lane_invasion=ego["lane_invasion"],
        red_light=ego["red_light"],
        stop_sign=np.zeros(steps, np.uint8),
        throttle=ego["throttle"],
        brake=ego["brake"],
        steer=ego["steer"],
        signal_ids=near,
        signal=signal_states(episode, graph, times)[:, near],
        route=route.xy,
        end=ENDS[int(world.ended()[b])] or "max_steps",
    )
