"""From a scenario to a concrete episode on a lane graph."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from ssad.core.errors import RouteError
from ssad.core.geometry import obb_distance
from ssad.core.lane_graph import LaneGraph
from ssad.core.safeio import dump_json
from ssad.core.seeding import digest, generator
from ssad.core.types import (
    Controller,
    Episode,
    EpisodeAgent,
    Limits,
    Pose,
    Route,
    Scenario,
    SignalPlan,
    SignalState,
)
from ssad.scenarios.dynamic.catalog import scenario_type
from ssad.scenarios.dynamic.knowledge._kind import ScenarioType
from ssad.scenarios.dynamic.schema import check, scenario_data
from ssad.world.models import model

EGO_MODEL = "car"
_FORCED = {"off": SignalState.OFF, "red": SignalState.RED, "green": SignalState.GREEN}


def build_episode(scenario: Scenario, graph: LaneGraph, *, seed: int) -> Episode:
    """The scenario on its town's lane graph: ego route, actors, signals. Deterministic in (scenario, seed).

    Signals, traffic and the distance limit that the scenario leaves at their defaults are those of its type.
    ConfigError if the scenario is not valid; RouteError if the town does not allow it.
    """
    from ssad.roads import route_along

    check(scenario)
    kind = scenario_type(scenario.type)
    scenario = _completed(scenario, kind)
    try:
        route = route_along(graph, scenario.route)
    except RouteError as error:
        raise RouteError(f"scenario {scenario.name}: {error}") from None
    ego = EpisodeAgent(
        name="ego",
        model=EGO_MODEL,
        controller=Controller.EXTERNAL,
        pose=Pose(float(route.xy[0, 0]), float(route.xy[0, 1]), float(route.yaw[0])),
        target_speed=scenario.target_speed,
        route=route,
    )
    others = kind.build(scenario, graph, route, generator("scenario", scenario.seed, seed, "actors"))
    _check_start(scenario, (ego, *others))
    return Episode(
        key=f"{scenario.name}@{digest(dump_json(scenario_data(scenario)), seed)[:12]}",
        scenario=scenario,
        town=scenario.town,
        agents=(ego, *others),
        signal_override=forced_signals(graph, route, scenario.signals, whole_town=kind.whole_town),
        override_until=scenario.signals.until,
        limits=scenario.limits,
        seed=seed,
    )


def _completed(scenario: Scenario, kind: ScenarioType) -> Scenario:
    """The scenario with what it leaves at the defaults taken from its type."""
    limits = scenario.limits
    if limits.max_distance == Limits().max_distance:
        limits = dataclasses.replace(limits, max_distance=kind.max_distance)
    return dataclasses.replace(
        scenario,
        signals=kind.signals if scenario.signals == SignalPlan() else scenario.signals,
        traffic=kind.traffic if scenario.traffic is None else scenario.traffic,
        limits=limits,
    )


def forced_signals(
    graph: LaneGraph, route: Route, plan: SignalPlan, *, whole_town: bool = False
) -> dict[int, SignalState]:
    """Signal -> forced state for a plan.

    `ego`: signals whose stop line is on the route, or on a lane beside it with the same direction;
    `others`: the other signals of the junctions on the route. whole_town: `others` are all the other
    signals that the map has.
    """
    lanes = np.unique(route.lane[route.lane >= 0])
    approach = {(int(graph.road[n]), int(graph.section[n]), int(np.sign(graph.lane_id[n]))) for n in lanes}
    own = {
        int(signal)
        for signal, lane in zip(graph.stop_signal, graph.stop_lane, strict=True)
        if (int(graph.road[lane]), int(graph.section[lane]), int(np.sign(graph.lane_id[lane]))) in approach
    }
    junctions = {int(n) for n in np.unique(graph.junction[lanes]) if n >= 0}
    forced: dict[int, SignalState] = {}
    for signal in range(len(graph.signal_junction)):
        here = int(graph.signal_junction[signal]) in junctions
        in_town = whole_town and not bool(graph.signal_virtual[signal])
        if whole_town and not in_town:
            continue
        want = plan.ego if signal in own and here else plan.others if here or in_town else "program"
        if want != "program":
            forced[signal] = _FORCED[want]
    return forced


def _check_start(scenario: Scenario, agents: Sequence[EpisodeAgent]) -> None:
    """RouteError if an actor stands in the ego when the episode begins."""
    boxes = [
        (a.pose.x, a.pose.y, a.pose.yaw, body.length, body.width) for a, body in ((a, model(a.model)) for a in agents)
    ]
    if len(boxes) < 2:
        return
    for agent, gap in zip(agents[1:], obb_distance(boxes[:1], boxes[1:]), strict=True):
        if gap <= 0.0:
            raise RouteError(f"scenario {scenario.name}: {agent.name} stands in the ego at the start; move one of them")
