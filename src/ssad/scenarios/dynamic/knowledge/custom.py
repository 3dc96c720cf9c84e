"""Custom: a scenario whose author writes actors, phases and paths in the YAML itself."""

from __future__ import annotations

import numpy as np

from ssad.core.errors import RouteError
from ssad.core.lane_graph import LaneGraph
from ssad.core.rotations import wrap_angle
from ssad.core.types import Actor, AgentKind, Controller, EpisodeAgent, Pose, Route, Scenario
from ssad.scenarios.dynamic.knowledge._kind import ScenarioType
from ssad.scenarios.dynamic.knowledge._placing import polyline_route
from ssad.world.models import model
from ssad.world.roads import route_along


def build(scenario: Scenario, graph: LaneGraph, route: Route, rng: np.random.Generator) -> list[EpisodeAgent]:
    """The actors as they are written; one without phases stands still."""
    agents = []
    for actor in scenario.actors:
        moves = bool(actor.phases) and model(actor.model).kind != AgentKind.PROP
        if actor.trajectory:
            agents.append(_recorded(actor))
            continue
        if actor.policy:
            agents.append(_with_policy(actor, graph))
            continue
        agents.append(
            EpisodeAgent(
                name=actor.name,
                model=actor.model,
                controller=Controller.SCRIPT if moves else Controller.NONE,
                pose=actor.pose,
                target_speed=max((p.speed for p in actor.phases), default=0.0),
                phases=actor.phases,
                route=polyline_route(np.asarray(actor.path, dtype=np.float64)) if actor.path else None,
            )
        )
    return agents


def _with_policy(actor: Actor, graph: LaneGraph) -> EpisodeAgent:
    """An actor that a driver acts for, with the route that its path means. RouteError: there is no such route."""
    route = None
    if actor.path and model(actor.model).kind == AgentKind.WALKER:
        route = polyline_route(np.asarray(actor.path, np.float64))
    elif actor.path:
        try:
            route = route_along(graph, actor.path)
        except RouteError as error:
            raise RouteError(f"actor {actor.name}: {error}") from None
    return EpisodeAgent(
        actor.name,
        actor.model,
        Controller.EXTERNAL,
        actor.pose,
        target_speed=actor.target_speed,
        route=route,
        policy=actor.policy,
    )


def _recorded(actor: Actor) -> EpisodeAgent:
    """An actor with a trajectory, where it is and how fast at the start of the episode, or when it appears."""
    rows = np.array(actor.trajectory)
    now = float(np.clip(0.0, rows[0, 0], rows[-1, 0]))
    k = int(np.clip(np.searchsorted(rows[:, 0], now, side="right") - 1, 0, len(rows) - 2))
    (t, x, y, yaw), (t1, x1, y1, yaw1) = rows[k].tolist(), rows[k + 1].tolist()
    part = (now - t) / (t1 - t)
    turned = yaw + part * float(wrap_angle(yaw1 - yaw))
    pose = Pose(x + part * (x1 - x), y + part * (y1 - y), turned)
    speed = ((x1 - x) * np.cos(turned) + (y1 - y) * np.sin(turned)) / (t1 - t)
    return EpisodeAgent(
        actor.name, actor.model, Controller.TRAJECTORY, pose, speed=float(speed), trajectory=actor.trajectory
    )


SCENARIO = ScenarioType(
    name="Custom",
    title="Custom",
    nhtsa="none: what its author wrote",
    build=build,
)
