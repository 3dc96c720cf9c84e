"""Long bodies sweep more than their width in bends: whether they pass who stands on the oncoming lanes beside them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from helpers.quick import others_slow

from benchmarks.traffic import town_routes, traffic
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import Controller, Episode, EpisodeAgent, LaneType, Pose, Route
from ssad.scenarios.dynamic.knowledge.natural_junction import fits_route
from ssad.world.roads import load_town
from ssad.world.roads.library import BUILT_IN
from ssad.world.world import World


def waiting(graph: LaneGraph, route: Route, body: str) -> list[EpisodeAgent]:
    """Somebody at the end of every other lane beside a way, where it would wait for the junction."""
    found: list[EpisodeAgent] = []
    others = (graph.kind == LaneType.DRIVING) & (graph.junction < 0) & (graph.length > 12.0)
    others[route.lane[route.lane >= 0]] = False
    for lane in np.flatnonzero(others).tolist():
        span = graph.points(lane)
        u = float(graph.s[span][-1]) - (6.5 if body == "bus" else 4.0)
        x, y = (float(np.interp(u, graph.s[span], graph.xy[span, d])) for d in (0, 1))
        yaw = float(graph.yaw[span][np.searchsorted(graph.s[span], u) - 1])
        beside = np.hypot(*(route.xy - (x, y)).T).min() < 6.0
        if beside and all(np.hypot(x - other.pose.x, y - other.pose.y) > 11.0 for other in found):
            found.append(EpisodeAgent(f"{body} {lane}", body, Controller.NONE, Pose(x, y, yaw), 0.0, 0.0))
    return found


def drives(graph: LaneGraph, routes: Sequence[Route], body: str, others: Sequence[str]) -> list[Episode]:
    """One drive of a body on each way for each of the others, who wait on the other lanes."""
    alone = traffic(graph, routes, 1, key=0, green=True)
    egos = []
    for route in routes:
        x, y = map(float, route.xy[0])
        wish = float(route.speed_limit.max())
        start = Pose(x, y, float(route.yaw[0]))
        egos.append(replace(alone.agents[0], model=body, pose=start, speed=0.0, route=route, target_speed=wish))
    return [
        replace(alone, agents=(ego, *waiting(graph, route, other)))
        for ego, route in zip(egos, routes, strict=True)
        for other in others
    ]


@pytest.mark.parametrize("town", others_slow(BUILT_IN, ["Twinford"]))
@pytest.mark.parametrize("body", ["truck", "bus"])
def test_long_vehicles_pass_who_waits_on_the_oncoming_lanes(town: str, body: str) -> None:
    """On ways that they are given in traffic; on those that they are not given, some are blocked.

    In three towns there are bends in which a truck and a bus do not pass each other; buses wait in Twinford alone here.
    """
    graph = load_town(town)
    ways = town_routes(graph, 60, 400.0)  # in Oldmarket, no bus is given one
    given = [route for route in ways if fits_route(body, route)][:8]
    tight = [route for route in ways if not fits_route(body, route)][:8]
    others = ("car", "bus") if town == "Twinford" else ("car",)
    world = World(drives(graph, given + tight, body, others), {graph.name: graph})
    touched = np.zeros(world.batch, bool)
    for _ in range(900):
        world.step()
        touched |= world.array("touch")[:, 0] != 0
    complete = world.array("ego.complete")
    first = len(others) * len(given)
    assert not touched[:first].any()
    assert (complete[:first] > 99.0).all()
    if town == "Twinford":
        assert len(given) >= 3
        assert (touched[first:] | (complete[first:] < 99.0)).any()
