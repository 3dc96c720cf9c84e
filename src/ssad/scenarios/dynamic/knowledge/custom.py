"""Custom: a scenario with actors, phases and paths written in YAML."""

from __future__ import annotations

import numpy as np

from ssad.core.errors import ConfigError, RouteError
from ssad.core.lane_graph import LaneGraph
from ssad.core.rotations import wrap_angle
from ssad.core.types import F32, Actor, AgentKind, Controller, EpisodeAgent, Pose, Route, Scenario
from ssad.scenarios.dynamic.knowledge._beside import lateral_targets
from ssad.scenarios.dynamic.knowledge._kind import ScenarioType
from ssad.scenarios.dynamic.knowledge._placing import polyline_route
from ssad.world.models import model
from ssad.world.roads import route_along
from ssad.world.scripts import meeting_point, straight_route

STRAIGHT_ON = 500.0  # m of the straight path of an actor that changes lanes without a path of its own


def build(scenario: Scenario, graph: LaneGraph, route: Route, rng: np.random.Generator) -> list[EpisodeAgent]:
    """Build the actors as written; an actor without phases keeps its speed, which is 0 unless the scenario says so."""
    agents = []
    for actor in scenario.actors:
        is_moving = bool(actor.phases or actor.lateral or actor.speed) and model(actor.model).kind != AgentKind.PROP
        if actor.trajectory:
            agents.append(_recorded(actor))
            continue
        if actor.policy:
            agents.append(_with_policy(actor, graph))
            continue
        actor_route = polyline_route(np.asarray(actor.path, dtype=np.float64)) if actor.path else None
        targets: tuple[F32, ...] = ()
        if actor.lateral:
            actor_route = actor_route or straight_route(actor.pose, STRAIGHT_ON)
            targets = lateral_targets(actor, graph, actor_route)
        agents.append(
            EpisodeAgent(
                name=actor.name,
                model=actor.model,
                controller=Controller.SCRIPT if is_moving else Controller.NONE,
                pose=actor.pose,
                speed=actor.speed,
                target_speed=max((phase.speed or 0.0 for phase in actor.phases), default=actor.speed),
                phases=actor.phases,
                route=actor_route,
                body=actor.body,
                lateral=actor.lateral,
                lateral_targets=targets,
            )
        )
    _check_meetings(agents, route)
    return agents


def _check_meetings(agents: list[EpisodeAgent], ego_route: Route) -> None:
    """Raise RouteError if a meeting point is not on the way of the agent that is to reach it."""
    ego = EpisodeAgent("ego", "car", Controller.EXTERNAL, Pose(0.0, 0.0), route=ego_route)
    agent_of = {"ego": ego} | {agent.name: agent for agent in agents}
    for agent in agents:
        for number, phase in enumerate(agent.phases):
            if phase.arrival is None:
                continue
            try:
                meeting_point(agent, phase.arrival.point)
                meeting_point(agent_of[phase.arrival.reference], phase.arrival.reference_point)
            except ConfigError as error:
                raise RouteError(f"actor {agent.name}: phase {number + 1}: {error}") from None


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
        speed=actor.speed,
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
