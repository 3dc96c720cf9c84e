"""From a scenario to a concrete episode on a lane graph."""

from __future__ import annotations

import dataclasses
import math
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
from ssad.scenarios.dynamic.knowledge._placing import shifted
from ssad.scenarios.dynamic.knowledge._remember import remembered
from ssad.scenarios.dynamic.sampling import sample_parameters
from ssad.scenarios.dynamic.schema import check, scenario_data
from ssad.world.models import model

EGO_MODEL = "car"
_ATTEMPTS = 8  # draws before a spread counts as impossible
_FORCED = {"off": SignalState.OFF, "red": SignalState.RED, "green": SignalState.GREEN}


def build_episode(scenario: Scenario, graph: LaneGraph, *, seed: int, spread: float = 0.0) -> Episode:
    """The scenario on its town's lane graph: ego route, actors, signals.

    Signals, traffic and the distance limit that the scenario leaves at their defaults are those of its type.

    Args:
        scenario: What happens.
        graph: Lane graph of the scenario's town.
        seed: What is random depends on this number, the scenario's name and its own seed alone: on no other episode,
            driver or machine.
        spread: How far the episode may differ from the nominal case. 0: parameters, the ego's start and its target
            speed are those of the scenario, and only random traffic depends on the seed. Above 0: they are drawn with
            `sample_parameters`, and drawn again if the actors have no room; 1 is the natural spread.

    Returns:
        The episode. Its scenario is the one drawn: built without spread and with the same seed it gives this episode.

    Raises:
        ConfigError: The scenario or the spread is not valid.
        RouteError: The town does not allow the scenario, or none of the draws has room for its actors.
    """
    check(scenario)
    try:
        route = _route(graph, scenario.route)
    except RouteError as error:
        raise RouteError(f"scenario {scenario.name}: {error}") from None
    if spread == 0.0:
        return _build(scenario, graph, route, seed)
    problem = None
    for attempt in range(_ATTEMPTS):
        random = generator("scenario", scenario.name, scenario.seed, seed, "spread", attempt)
        try:
            return _build(sample_parameters(scenario, random, spread=spread), graph, route, seed, everybody_apart=True)
        except RouteError as error:
            problem = error
    raise RouteError(
        f"{problem} (the last of {_ATTEMPTS} draws with seed {seed} and spread {spread:g}; a smaller spread may do)"
    )


def _build(scenario: Scenario, graph: LaneGraph, route: Route, seed: int, *, everybody_apart: bool = False) -> Episode:
    """The episode of just this scenario. everybody_apart: agents whose place was drawn must not touch either."""
    kind = scenario_type(scenario.type)
    scenario = _completed(scenario, kind)
    value = kind.values(scenario.parameters)
    ego = EpisodeAgent(
        name="ego",
        model=EGO_MODEL,
        controller=Controller.EXTERNAL,
        pose=_start(route, value["ego_longitudinal"], value["ego_lateral"], value["ego_heading"]),
        speed=value["ego_speed"],
        target_speed=scenario.target_speed,
        route=route,
    )
    fixed = scenario.traffic.draw if scenario.traffic else None
    draw = seed if fixed is None else fixed
    others = kind.build(scenario, graph, route, generator("scenario", scenario.seed, draw, "actors"))
    agents = (ego, *others)
    # traffic and an author's own actors stand where they stand in the nominal case: of them only the ego must be clear
    drawn = everybody_apart and any(parameter.spread for parameter in kind.parameters)
    _check_start(scenario, agents, movable=len(agents) if drawn else 1)
    return Episode(
        key=f"{scenario.name}@{digest(dump_json(scenario_data(scenario)), seed)[:12]}",
        scenario=scenario,
        town=scenario.town,
        agents=agents,
        signal_override=dict(_signals(graph, route, scenario.signals, kind.whole_town)),
        override_until=scenario.signals.until,
        limits=scenario.limits,
        seed=seed,
    )


@remembered()
def _route(graph: LaneGraph, keypoints: tuple[Pose, ...]) -> Route:
    """The route through key points; its arrays are read-only, since all episodes on it share them."""
    from ssad.world.roads import route_along

    route = route_along(graph, keypoints)
    for values in (route.xy, route.yaw, route.lane, route.speed_limit, route.width):
        values.setflags(write=False)
    return route


def _start(route: Route, forward: float, left: float, turn: float) -> Pose:
    """The pose `forward` m along a route and `left` m beside it, turned by `turn` rad."""
    if forward == left == turn == 0.0:
        return Pose(float(route.xy[0, 0]), float(route.xy[0, 1]), float(route.yaw[0]))
    at = min(forward / route.spacing, len(route.xy) - 1.0)
    index = min(int(at), len(route.xy) - 2)
    (x0, y0), (x1, y1) = route.xy[index : index + 2].tolist()
    yaw, after = route.yaw[index : index + 2].tolist()
    share = at - index
    bend = math.remainder(after - yaw, math.tau)
    return shifted(Pose(x0 + share * (x1 - x0), y0 + share * (y1 - y0), yaw + share * bend), 0.0, left, turn)


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


@remembered()
def _signals(graph: LaneGraph, route: Route, plan: SignalPlan, whole_town: bool) -> dict[int, SignalState]:
    """`forced_signals`, worked out once for a route."""
    return forced_signals(graph, route, plan, whole_town=whole_town)


def forced_signals(
    graph: LaneGraph, route: Route, plan: SignalPlan, *, whole_town: bool = False
) -> dict[int, SignalState]:
    """The states that a signal plan forces.

    Args:
        graph: Lane graph of the town.
        route: The ego's route.
        plan: State of the ego's signals (their stop line is on the route, or on a lane beside it with the same
            direction), and of the other ones of the junctions on the route.
        whole_town: The other ones are all the other signals that the map has.

    Returns:
        Signal index of the town -> state; signals that keep their program are left out.
    """
    lanes = np.unique(route.lane[route.lane >= 0])
    approach = {(int(graph.road[n]), int(graph.section[n]), int(np.sign(graph.lane_id[n]))) for n in lanes}
    own = {
        int(graph.stop_signal[k])
        for k, lane in enumerate(graph.stop_lane)
        if (int(graph.road[lane]), int(graph.section[lane]), int(np.sign(graph.lane_id[lane]))) in approach
    }
    junctions = {int(n) for n in np.unique(graph.junction[lanes]) if n >= 0}
    forced: dict[int, SignalState] = {}
    for signal in range(len(graph.signal_junction)):
        here = int(graph.signal_junction[signal]) in junctions
        want = plan.ego if signal in own and here else plan.others
        if want != "program" and (not graph.signal_virtual[signal] if whole_town else here):
            forced[signal] = _FORCED[want]
    return forced


def _check_start(scenario: Scenario, agents: Sequence[EpisodeAgent], *, movable: int) -> None:
    """RouteError if one of the first `movable` agents touches another one when the episode begins."""
    boxes = []
    here = [
        agent for agent in agents if not agent.trajectory or agent.trajectory[0][0] <= 0.0 <= agent.trajectory[-1][0]
    ]
    for agent in here:
        body = model(agent.model)
        boxes.append((agent.pose.x, agent.pose.y, agent.pose.yaw, body.length, body.width))
    for first, one in enumerate(boxes[:movable]):
        for second, other in enumerate(boxes[first + 1 :], first + 1):
            # most are too far apart to touch whichever way they are turned
            reach = 0.5 * (math.hypot(*one[3:]) + math.hypot(*other[3:]))
            if math.hypot(one[0] - other[0], one[1] - other[1]) <= reach and obb_distance(one, other) <= 0.0:
                raise RouteError(
                    f"scenario {scenario.name}: {here[second].name} stands in the {here[first].name} at the start; "
                    "move one of them"
                )
