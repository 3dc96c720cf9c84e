"""Custom: a scenario with actors, phases and paths written in YAML."""

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
    """Build the actors as written; an actor without phases stands still."""
    agents = []
    for actor in scenario.actors:
        is_moving = bool(actor.phases) and model(actor.model).kind != AgentKind.PROP
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
                controller=Controller.SCRIPT if is_moving else Controller.NONE,
                pose=actor.pose,
                target_speed=max((phase.speed for phase in actor.phases), default=0.0),
                phases=actor.phases,
                route=polyline_route(np.asarray(actor.path, dtype=np.float64)) if actor.path else None,
                body=actor.body,
            )
        )
    return agents


def _with_policy(actor: Actor, graph: LaneGraph) -> EpisodeAgent:
    """Build an actor that a driver controls, with the route along its path. RouteError without such a route."""
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
        body=actor.body,
    )


def _recorded(actor: Actor) -> EpisodeAgent:
    """Build an actor with a trajectory, at its pose and speed at the start or when it appears."""
    rows = np.array(actor.trajectory)
    start_time = float(np.clip(0.0, rows[0, 0], rows[-1, 0]))
    row = int(np.clip(np.searchsorted(rows[:, 0], start_time, side="right") - 1, 0, len(rows) - 2))
    (t, x, y, yaw), (t1, x1, y1, next_yaw) = rows[row].tolist(), rows[row + 1].tolist()
    fraction = (start_time - t) / (t1 - t)
    heading = yaw + fraction * float(wrap_angle(next_yaw - yaw))
    pose = Pose(x + fraction * (x1 - x), y + fraction * (y1 - y), heading)
    speed = ((x1 - x) * np.cos(heading) + (y1 - y) * np.sin(heading)) / (t1 - t)
    return EpisodeAgent(
        actor.name,
        actor.model,
        Controller.TRAJECTORY,
        pose,
        speed=float(speed),
        trajectory=actor.trajectory,
        body=actor.body,
    )


SCENARIO = ScenarioType(
    name="Custom",
    title="Custom",
    nhtsa="none: what its author wrote",
    build=build,
)
