"""Custom: a scenario whose author writes actors, phases and paths in the YAML itself."""

from __future__ import annotations

import numpy as np

from ssad.core.lane_graph import LaneGraph
from ssad.core.types import AgentKind, Controller, EpisodeAgent, Route, Scenario
from ssad.scenarios.dynamic.knowledge._kind import ScenarioType
from ssad.scenarios.dynamic.knowledge._placing import polyline_route
from ssad.world.models import model


def build(scenario: Scenario, graph: LaneGraph, route: Route, rng: np.random.Generator) -> list[EpisodeAgent]:
    """The actors as they are written; one without phases stands still."""
    agents = []
    for actor in scenario.actors:
        moves = bool(actor.phases) and model(actor.model).kind != AgentKind.PROP
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


SCENARIO = ScenarioType(
    name="Custom",
    title="Custom",
    nhtsa="none: what its author wrote",
    build=build,
)
