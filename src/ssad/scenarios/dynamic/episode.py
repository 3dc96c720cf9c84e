"""Construction of a concrete episode from a scenario on a lane graph."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from ssad.core.errors import ConfigError, RouteError
from ssad.core.geometry import obb_distance
from ssad.core.lane_graph import TURN, LaneGraph
from ssad.core.rotations import wrap_scalar
from ssad.core.safeio import dump_json
from ssad.core.seeding import digest, generator
from ssad.core.types import (
    Controller,
    Episode,
    EpisodeAgent,
    EpisodeLimits,
    Pose,
    Route,
    Scenario,
    SignalPlan,
    SignalState,
)
from ssad.scenarios.dynamic.catalogue import scenario_type
from ssad.scenarios.dynamic.knowledge._caching import cached_by_identity
from ssad.scenarios.dynamic.knowledge._impact import place_actors
from ssad.scenarios.dynamic.knowledge._kind import ScenarioType
from ssad.scenarios.dynamic.knowledge._placing import move_pose
from ssad.scenarios.dynamic.knowledge.driver_population import with_driver
from ssad.scenarios.dynamic.knowledge.vulnerable_users import draw_cyclists, draw_walkers
from ssad.scenarios.dynamic.sampling import sample_parameters
from ssad.scenarios.dynamic.schema import check, scenario_data
from ssad.world.models import agent_model

_ATTEMPTS = 8  # draws before a spread is reported as impossible
_FORCED = {"off": SignalState.OFF, "red": SignalState.RED, "green": SignalState.GREEN}


def build_episode(scenario: Scenario, graph: LaneGraph, *, seed: int, spread: float = 0.0) -> Episode:
    """Build a scenario on its town's lane graph: ego route, actors, signals.

    Signals, traffic and the distance limit that the scenario leaves at their defaults are those of its type.

    Args:
        scenario: The scenario.
        graph: Lane graph of the scenario's town.
        seed: All random draws depend only on this number, the scenario's name and its own seed; never on other
            episodes, drivers or machines.
        spread: Size of the random variation around the nominal case. 0: parameters, the ego's start and its target
            speed are those of the scenario, and only random traffic depends on the seed. Above 0: they are drawn with
            `sample_parameters`, and drawn again if the actors have no room; 1 is the natural spread.

    Returns:
        The episode. Its scenario is the one drawn: built without spread and with the same seed it gives this episode.

    Raises:
        ConfigError: The scenario or the spread is not valid.
        RouteError: The town does not allow the scenario, or none of the draws has room for its actors.
    """
    check(scenario)
    route = _scenario_route(scenario, graph)
    if spread == 0.0:
        return _build_one(scenario, graph, route, seed)
    problem: ConfigError | RouteError | None = None
    for attempt in range(_ATTEMPTS):
        random = generator("scenario", scenario.name, scenario.seed, seed, "spread", attempt)
        drawn_scenario = sample_parameters(scenario, random, spread=spread)
        try:
            if scenario.expressions:  # a drawn parameter may give a key an impossible value, and the route another way
                check(drawn_scenario)
                route = _scenario_route(drawn_scenario, graph)
            return _build_one(drawn_scenario, graph, route, seed, require_clearance=True)
        except (ConfigError, RouteError) as error:
            problem = error
    raise RouteError(
        f"{problem} (the last of {_ATTEMPTS} draws with seed {seed} and spread {spread:g}; a smaller spread may do)"
    )


def _scenario_route(scenario: Scenario, graph: LaneGraph) -> Route:
    """Return the ego's route. RouteError, with the name of the scenario, if the town does not allow it."""
    try:
        return _route(graph, scenario.route)
    except RouteError as error:
        raise RouteError(f"scenario {scenario.name}: {error}") from None


def _build_one(
    scenario: Scenario, graph: LaneGraph, route: Route, seed: int, *, require_clearance: bool = False
) -> Episode:
    """Return the episode of this very scenario; everybody_apart: agents at drawn positions must not touch either."""
    scenario_kind = scenario_type(scenario.type)
    scenario = _fill_in_defaults(scenario, scenario_kind)
    values = scenario_kind.values(scenario.parameters)
    try:
        scenario = place_actors(scenario, route, values["ego_longitudinal"], values["ego_speed"])
    except RouteError as error:
        raise RouteError(f"scenario {scenario.name}: {error}") from None
    ego = EpisodeAgent(
        name="ego",
        model=scenario.ego_model,
        body=scenario.ego_body,
        controller=Controller.EXTERNAL,
        pose=_pose_beside_route(route, values["ego_longitudinal"], values["ego_lateral"], values["ego_heading"]),
        speed=values["ego_speed"],
        target_speed=scenario.target_speed,
        route=route,
    )
    fixed_draw = scenario.traffic.draw if scenario.traffic else None
    # A scenario with a fixed draw has the same traffic under every seed.
    draw = seed if fixed_draw is None else fixed_draw
    other_agents = scenario_kind.build(scenario, graph, route, generator("scenario", scenario.seed, draw, "actors"))
    if scenario.traffic and scenario.traffic.drivers == "population":
        other_agents = [
            with_driver(agent, scenario.seed, draw, number, errors=scenario.traffic.errors)
            for number, agent in enumerate(other_agents)
        ]
    if scenario.traffic:
        key = (scenario.seed, draw)
        cyclists = draw_cyclists(scenario.traffic, graph, route, other_agents, *key)
        standing = [ego, *other_agents, *cyclists]
        walkers = draw_walkers(scenario.traffic, graph, route, standing, scenario.limits.max_time, *key)
        other_agents = [*other_agents, *cyclists, *walkers]
    if scenario.signals.ego == "red" and not graph.turn_on_red[0] and near_side_turns(graph, route):
        raise RouteError(
            f"scenario {scenario.name}: its ego turns on red, which town '{graph.name}' forbids; choose another"
            " town, or import its map with --turn-on-red"
        )
    agents = (ego, *other_agents)
    # traffic and an author's own actors stand where they stand in the nominal case: of them only the ego must be clear
    is_varied = any(parameter.spread for parameter in scenario_kind.parameters)
    is_varied |= any(declaration.spread for declaration in scenario.declared.values())
    check_all = require_clearance and is_varied
    _check_start(scenario, agents, movable=len(agents) if check_all else 1)
    return Episode(
        key=f"{scenario.name}@{digest(dump_json(scenario_data(scenario)), seed)[:12]}",
        scenario=scenario,
        town=scenario.town,
        agents=agents,
        signal_override=dict(
            _cached_forced_signals(graph, route, scenario.signals, scenario.trigger, scenario_kind.whole_town)
        ),
        override_until=scenario.signals.until,
        limits=scenario.limits,
        seed=seed,
        friction=scenario.friction,
    )


@cached_by_identity()
def _route(graph: LaneGraph, keypoints: tuple[Pose, ...]) -> Route:
    """Return the route through key points; its arrays are read-only, since all its episodes share them."""
    from ssad.world.roads import route_along

    route = route_along(graph, keypoints)
    for column in (route.xy, route.yaw, route.lane, route.speed_limit, route.width):
        column.setflags(write=False)
    return route


def _pose_beside_route(route: Route, forward: float, left: float, turn: float) -> Pose:
    """Return the pose `forward` m along a route and `left` m beside it, turned by `turn` rad."""
    if forward == left == turn == 0.0:
        return Pose(float(route.xy[0, 0]), float(route.xy[0, 1]), float(route.yaw[0]))
    position = min(forward / route.spacing, len(route.xy) - 1.0)
    index = min(int(position), len(route.xy) - 2)
    (x0, y0), (x1, y1) = route.xy[index : index + 2].tolist()
    yaw, next_yaw = route.yaw[index : index + 2].tolist()
    share = position - index
    bend = math.remainder(next_yaw - yaw, math.tau)
    return move_pose(Pose(x0 + share * (x1 - x0), y0 + share * (y1 - y0), yaw + share * bend), 0.0, left, turn)


def _fill_in_defaults(scenario: Scenario, kind: ScenarioType) -> Scenario:
    """Return the scenario with the values that it leaves at the defaults taken from its type."""
    limits = scenario.limits
    if limits.max_distance == EpisodeLimits().max_distance:
        limits = dataclasses.replace(limits, max_distance=kind.max_distance)
    return dataclasses.replace(
        scenario,
        signals=kind.signals if scenario.signals == SignalPlan() else scenario.signals,
        traffic=kind.traffic if scenario.traffic is None else scenario.traffic,
        limits=limits,
    )


@cached_by_identity()
def _cached_forced_signals(
    graph: LaneGraph, route: Route, plan: SignalPlan, trigger: Pose | None, whole_town: bool
) -> dict[int, SignalState]:
    """Return `forced_signals`, cached for a route."""
    return forced_signals(graph, route, plan, trigger=trigger, whole_town=whole_town)


def forced_signals(
    graph: LaneGraph, route: Route, plan: SignalPlan, *, trigger: Pose | None = None, whole_town: bool = False
) -> dict[int, SignalState]:
    """Return the states that a signal plan forces.

    Args:
        graph: Lane graph of the town.
        route: The ego's route.
        plan: State of the ego's signals (stop line on the route, or on a parallel lane of the same direction), and of
            the other signals of the junctions on the route. Where the ego is to have red, only the junctions count at
            which the route turns to the near side, which it may do on red; a route without such a turn has red
            everywhere.
        trigger: The place that the scenario is built around. Of several turns to the near side, the ego has red at
            the one that follows it.
        whole_town: Apply the state of other signals to the whole map.

    Returns:
        Signal index of the town -> state; signals that keep their program are omitted.
    """
    lanes = np.unique(route.lane[route.lane >= 0])
    approach = {
        (int(graph.road[lane_index]), int(graph.section[lane_index]), bool(graph.forward[lane_index]))
        for lane_index in lanes
    }
    ego_signals = {
        int(graph.stop_signal[stop_index])
        for stop_index, lane in enumerate(graph.stop_lane)
        if (int(graph.road[lane]), int(graph.section[lane]), bool(graph.forward[lane])) in approach
    }
    junctions = {int(junction) for junction in np.unique(graph.junction[lanes]) if junction >= 0}
    route_junctions = junctions
    if plan.ego == "red":
        junctions = _red_junctions(graph, route, trigger) or junctions
    forced_states: dict[int, SignalState] = {}
    for signal in range(len(graph.signal_junction)):
        on_route_junction = int(graph.signal_junction[signal]) in junctions
        state_name = plan.ego if signal in ego_signals and on_route_junction else plan.others
        if not on_route_junction and int(graph.signal_junction[signal]) in route_junctions:
            crossing_state = "red" if plan.elsewhere == "green" else plan.elsewhere
            on_route_junction, state_name = True, plan.elsewhere if signal in ego_signals else crossing_state
        if state_name != "program" and (not graph.signal_virtual[signal] if whole_town else on_route_junction):
            forced_states[signal] = _FORCED[state_name]
    return forced_states


def _red_junctions(graph: LaneGraph, route: Route, trigger: Pose | None) -> set[int]:
    """Return the junctions at which the ego has red: its turns to the near side, or the next one of a trigger."""
    turns = near_side_turns(graph, route)
    if trigger is None or len(turns) < 2:
        return turns
    start = int(np.argmin(np.hypot(route.xy[:, 0] - trigger.x, route.xy[:, 1] - trigger.y)))
    junction = np.where(route.lane >= 0, graph.junction[np.maximum(route.lane, 0)], -1)
    following_turns = [int(number) for number in junction[start:] if int(number) in turns]
    return {following_turns[0]} if following_turns else turns


def near_side_turns(graph: LaneGraph, route: Route) -> set[int]:
    """Return the junctions at which a route turns to the near side: right, or left in left-hand traffic."""
    junction = np.where(route.lane >= 0, graph.junction[np.maximum(route.lane, 0)], -1)
    edges = np.flatnonzero(np.diff(junction, prepend=-1, append=-1))
    near_side = 1.0 if graph.left_hand[0] else -1.0
    return {
        int(junction[first])
        for first, after in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)
        if junction[first] >= 0
        and near_side * wrap_scalar(float(route.yaw[min(after, len(junction) - 1)] - route.yaw[max(first - 1, 0)]))
        > TURN
    }


def _check_start(scenario: Scenario, agents: Sequence[EpisodeAgent], *, movable: int) -> None:
    """Raise RouteError if one of the first `movable` agents touches another one at the start."""
    footprints = []
    present = [
        # Agents that appear later or have already left are absent at the start.
        agent
        for agent in agents
        if not agent.trajectory or agent.trajectory[0][0] <= 0.0 <= agent.trajectory[-1][0]
    ]
    for agent in present:
        body = agent_model(agent)
        footprints.append((agent.pose.x, agent.pose.y, agent.pose.yaw, body.length, body.width))
    for index, footprint in enumerate(footprints[:movable]):
        for other_index, other_footprint in enumerate(footprints[index + 1 :], index + 1):
            # cheap test first: most pairs are too far apart in any orientation
            reach = 0.5 * (math.hypot(*footprint[3:]) + math.hypot(*other_footprint[3:]))
            if (
                math.hypot(footprint[0] - other_footprint[0], footprint[1] - other_footprint[1]) <= reach
                and obb_distance(footprint, other_footprint) <= 0.0
            ):
                raise RouteError(
                    f"scenario {scenario.name}: {present[other_index].name} stands in the "
                    f"{present[index].name} at the start; "
                    "move one of them"
                )
