"""Drives worth recording: a long random way of the ego through a town, with traffic all around it."""

from __future__ import annotations

import math

import numpy as np

from ssad.core.errors import ConfigError, MapError
from ssad.core.lane_graph import LaneGraph
from ssad.core.seeding import generator
from ssad.core.types import Controller, Episode, EpisodeAgent, LaneType, Limits, Pose, Route, Scenario, SignalPlan
from ssad.rendering.scene_objects import thinned
from ssad.rendering.street import STYLES, Street, build_street, cached_street
from ssad.scenarios.dynamic.episode import forced_signals
from ssad.scenarios.dynamic.knowledge.natural_junction import fits
from ssad.world.models import model
from ssad.world.roads.router import random_route

NEAR = 120.0  # m from the ego's way within which traffic starts
WAY = 260.0  # m of the ego's way that counts for this: what is driven in 30 s
MOST = 44  # vehicles
TOWN_SPEED = 12.0  # m/s that a driver who wants the most drives in town
FAST = 21.0  # m/s: on roads with a higher limit everybody wants to drive faster in proportion
TRIES = 8  # ways that are tried for a long vehicle, whose nose must stay in its lane
# body -> share; long vehicles and two-wheelers are more frequent than on real roads, so that each class is seen
MIX = {
    "car": 0.25,
    "suv": 0.14,
    "coupe": 0.06,
    "compact": 0.13,
    "van": 0.06,
    "motorcycle": 0.10,
    "bicycle": 0.09,
    "truck": 0.10,
    "bus": 0.07,
}

STREETS = ("town", "any")


def check_streets(streets: str) -> None:
    """ConfigError: no such kind of streets."""
    if streets not in STREETS:
        raise ConfigError(f"streets '{streets}'; choose from: {', '.join(STREETS)}")


def drive_street(graph: LaneGraph, streets: str, *, key: tuple[object, ...]) -> Street:
    """What stands along the roads in a drive.

    "town": what always stands there; "any": built for this key alone, in any style, so that a detector cannot learn a
    town by heart. ConfigError: neither.
    """
    check_streets(streets)
    if streets == "town":
        return cached_street(graph)
    draws = generator("drive street", graph.name, *key)
    return build_street(graph, seed=int(draws.integers(1, 2**31)), style=str(draws.choice(sorted(STYLES))))


def make_drive(graph: LaneGraph, *, key: tuple[object, ...], seconds: float, streets: str = "town") -> Episode:
    """One drive: ego first, all on Autopilot, signals green. Deterministic in the key. streets: see `thinned`.

    MapError: the town has no road to drive on.
    """
    mix = thinned(MIX, streets)
    draws = generator("drive", graph.name, *key)
    lanes = np.flatnonzero((graph.kind == LaneType.DRIVING) & (graph.junction < 0) & (graph.length > 25.0))
    if not len(lanes):
        raise MapError(f"town '{graph.name}' has no driving lane of 25 m or more; nothing can be recorded there")
    route = _way(graph, lanes, draws)
    wish = float(draws.uniform(7, 10)) * _haste(route)
    ego = EpisodeAgent("ego", "car", Controller.EXTERNAL, _pose(route), target_speed=wish, route=route)
    agents = [ego]
    way = route.xy[: int(WAY) : 5]
    density = float(draws.uniform(0.25, 0.8))
    spots = [
        (int(lane), float(s))
        for lane in lanes
        for s in np.arange(6.0 + draws.uniform(0, 8), float(graph.length[lane]) - 6.0, 15.0)
    ]
    for k in draws.permutation(len(spots)).tolist():
        if len(agents) > MOST:
            break
        lane, s = spots[k]
        x, y, yaw, _ = graph.at(lane, s)
        if np.hypot(way[:, 0] - x, way[:, 1] - y).min() > NEAR or draws.random() > density:
            continue
        body = str(draws.choice(list(mix), p=list(mix.values())))
        path = random_route(graph, lane, s, 400.0, draws)
        for _ in range(TRIES):
            if fits(body, path):
                break
            path = random_route(graph, lane, s, 400.0, draws)
        else:
            body = "compact"
        if body == "bicycle" and _haste(path) > 1.0:
            body = "motorcycle"  # nobody cycles on a motorway
        room = 0.5 * model(body).length + 4.0
        if any(math.hypot(a.pose.x - x, a.pose.y - y) < room + 0.5 * model(a.model).length for a in agents):
            continue
        wanted = 5.0 if body == "bicycle" else float(draws.uniform(5.5, 11.0)) * _haste(path)
        limit = float(graph.speed_limit[lane])
        pose = Pose(x, y, yaw)
        agents.append(
            EpisodeAgent(
                f"{body} {len(agents)}",
                body,
                Controller.AUTOPILOT,
                pose,
                min(wanted, limit) * 0.6,
                min(wanted, limit),
                route=path,
            )
        )
    name = "/".join(str(part) for part in key)
    ends = (agents[0].pose, Pose(float(route.xy[-1, 0]), float(route.xy[-1, 1]), float(route.yaw[-1])))
    steps = math.ceil(seconds / 0.1) + 2
    limits = Limits(max_steps=steps, max_time=2 * seconds + 60)
    scenario = Scenario(f"drive/{name}", "Custom", graph.name, ends, limits=limits)
    signals = forced_signals(graph, route, SignalPlan(ego="green", others="green", until=1e6), whole_town=True)
    return Episode(f"drive/{graph.name}/{name}", scenario, graph.name, tuple(agents), signals, 1e6, limits)


def _way(graph: LaneGraph, lanes: np.ndarray, draws: np.random.Generator) -> Route:
    """The longest of a few random ways."""
    found: Route | None = None
    for _ in range(8):
        lane = int(draws.choice(lanes))
        way = random_route(graph, lane, float(draws.uniform(4.0, 20.0)), 400.0, draws)
        if found is None or way.length > found.length:
            found = way
        if found.length > 395.0:
            break
    assert found is not None
    return found


def _haste(route: Route) -> float:
    """Times as fast as in town that somebody on this way wants to drive, where its roads and bends let them."""
    fastest = float(route.speed_limit.max())
    return fastest / TOWN_SPEED if fastest > FAST else 1.0


def _pose(route: Route) -> Pose:
    return Pose(float(route.xy[0, 0]), float(route.xy[0, 1]), float(route.yaw[0]))
