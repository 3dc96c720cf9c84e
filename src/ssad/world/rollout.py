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


def _row(world: World) -> dict[str, npt.NDArray[np.generic]]:
    """One step of all scenes, in the terms and types of `EpisodeTrace`: first what all agents have, then the ego's."""
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
    agent: dict[str, Any] = {name: np.stack([row[name][b, :n] for row in rows[:steps]]) for name in _AGENT}
    ego: dict[str, Any] = {
        name: np.stack([row[name][b] for row in rows[:steps]]) for name in rows[0] if name not in _AGENT
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
        stop_sign=np.zeros(steps, np.uint8),
        signal_ids=near,
        signal=signal_states(episode, graph, times)[:, near],
        route=route.xy,
        end=ENDS[int(world.ended()[b])] or "max_steps",
        **agent,
        **ego,
    )
