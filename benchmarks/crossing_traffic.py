"""Traffic that crosses the ego's way: by schedule, in the world without an ego, and the outcomes of drivers there.

`python -m benchmarks.crossing_traffic --scenarios natural,natural-unselected` prints a table; `frea` too, once it has
been imported. `--page` writes the table into docs/results/traffic.md.

A schedule is the drive of a vehicle without other traffic: along its route, at its speed and acceleration. It needs no
world, so a choice by schedules does not change with the rules of the traffic.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from benchmarks.insert import insert
from ssad.core.geometry import obb_distance
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import F64, AgentKind, Bool, Controller, Episode, Route
from ssad.world.kernels.data import Presence
from ssad.world.models import agent_model
from ssad.world.world import World

PICK_UP = 2.5  # m/s^2 with which the ego is expected to start: the Autopilot's
TO_THE_SIDE = 2.5  # m/s^2 in bends
WITHIN = 4.0  # s between two at the same place that count as an encounter
ACROSS = 0.5  # rad between the paths of the ego and a crossing vehicle
BEND = 5.0  # m over which the curvature of a route is averaged: a kink between two lanes is no bend


def schedule(route: Route, speed: float, target: float, step: float, *, acceleration: float = PICK_UP) -> F64:
    """Return the places of a vehicle that is alone on its route.

    It accelerates up to its target speed, the limit, or what a bend allows.

    Args:
        route: Route.
        speed: Speed at the start, m/s.
        target: Target speed, m/s.
        step: Time between two places, s.
        acceleration: Acceleration and deceleration, m/s^2.

    Returns:
        [N, 3] x, y, yaw up to the end of the route.
    """
    yaw = np.unwrap(route.yaw.astype(np.float64))
    lag = max(round(BEND / route.spacing), 1)
    curvature = np.abs(yaw[lag:] - yaw[:-lag]) / (lag * route.spacing)
    bend = np.pad(curvature, (lag // 2, lag - lag // 2), mode="edge") if len(curvature) else np.zeros(len(yaw))
    limit = np.minimum(route.speed_limit, np.sqrt(TO_THE_SIDE / np.maximum(bend, 1e-6)))
    limit = np.minimum(limit, target).astype(np.float64)
    for index in range(len(limit) - 2, -1, -1):  # slow down before a bend, not in it
        limit[index] = min(limit[index], math.sqrt(limit[index + 1] ** 2 + 2.0 * acceleration * route.spacing))
    places, position, pace = [], 0.0, speed
    while position < route.length:
        places.append(position / route.spacing)
        pace = min(pace + acceleration * step, float(limit[int(places[-1])]))
        position += pace * step
    index = np.arange(len(yaw))
    return np.stack([np.interp(places, index, column) for column in (*route.xy.T, yaw)], 1)


def crosses(way: F64, size: F64, other: F64, other_size: F64, *, awake: Bool, step: float) -> bool:
    """Return whether a body crosses the ego's way within 4 s of the ego.

    Args:
        way: [T, 3] places of the ego, x, y, yaw.
        size: [2] length and width of the ego.
        other: [T, 3] places of the other one at the same times.
        other_size: [2] its length and width.
        awake: [T] whether it moves freely.
        step: Time between two places, s.
    """
    steps = np.arange(len(way))
    together = np.abs(steps[:, None] - steps) * step <= WITHIN
    reach = 0.5 * np.hypot(*other_size) + 0.5 * np.hypot(*size)
    near = np.hypot(other[:, None, 0] - way[:, 0], other[:, None, 1] - way[:, 1]) < reach
    across = np.abs(np.sin(other[:, None, 2] - way[:, 2])) > np.sin(ACROSS)
    rows, columns = np.nonzero(together & near & across & awake[:, None])
    if not len(rows):
        return False
    body = np.hstack([other[rows], np.tile(other_size, (len(rows), 1))])
    ego = np.hstack([way[columns], np.tile(size, (len(columns), 1))])
    return bool((obb_distance(body, ego) <= 0.0).any())


def scheduled_crossings(episode: Episode, step: float = 0.1) -> int:
    """Return the number of vehicles whose schedules cross that of the ego within 4 s.

    A vehicle sets out once the ego is within its wake distance.

    Args:
        episode: Episode; its walkers and scripted actors do not count.
        step: Time between two places, s.
    """
    ego = episode.agents[0]
    assert ego.route is not None
    way = schedule(ego.route, ego.speed, ego.target_speed, step)
    count = 0
    for agent in episode.agents[1:]:
        if agent.controller != Controller.AUTOPILOT or agent.route is None:
            continue
        pose = np.array([agent.pose.x, agent.pose.y, agent.pose.yaw])
        near = np.hypot(*(way[:, :2] - pose[:2]).T) < agent.wake_distance
        start = int(near.argmax()) if near.any() else len(way)
        start = start if agent.wake_distance > 0.0 else 0
        acceleration = PICK_UP if agent.driver is None else agent.driver.acceleration
        drive = schedule(agent.route, agent.speed, agent.target_speed, step, acceleration=acceleration)
        places = np.vstack([np.tile(pose, (start, 1)), drive])[: len(way)]
        places = np.vstack([places, np.tile(places[-1], (len(way) - len(places), 1))])
        bodies = [np.array([body.length, body.width]) for body in (agent_model(ego), agent_model(agent))]
        count += crosses(way, bodies[0], places, bodies[1], awake=np.arange(len(way)) >= start, step=step)
    return count


def crossings(episodes: Sequence[Episode], graphs: Mapping[str, LaneGraph]) -> npt.NDArray[np.intp]:
    """Return how many vehicles of each episode cross the ego's path in a world without the ego.

    Traffic wakes as if the ego kept its schedule, but does not see it.
    """
    world = World(episodes, graphs, ego=Controller.NONE)
    egos = [episode.agents[0] for episode in episodes]
    ways = [schedule(ego.route, ego.speed, ego.target_speed, world.dt) for ego in egos]
    size, kind = world.state().size.astype(np.float64), world.state().kind
    world.remove(np.broadcast_to(np.arange(world.agents) == 0, size.shape[:2]))
    poses, awake = [], []
    for step in range(max(map(len, ways))):
        pose = world.array("pose").copy()
        pose[:, 0] = [way[min(step, len(way) - 1)] for way in ways]  # where it would wake others
        world.put("pose", pose)
        poses.append(pose.astype(np.float64))
        awake.append(world.array("active") == Presence.AWAKE)
        world.step()
    where, there = np.stack(poses), np.stack(awake)
    counts = np.zeros(len(ways), np.intp)
    for row, way in enumerate(ways):
        vehicles = np.flatnonzero((kind[row] > AgentKind.NONE) & (kind[row] <= AgentKind.BICYCLE))
        for agent in vehicles[vehicles > 0].tolist():
            other, moves = where[: len(way), row, agent], there[: len(way), row, agent]
            counts[row] += crosses(way, size[row, 0], other, size[row, agent], awake=moves, step=world.dt)
    return counts


@lru_cache(maxsize=1)
def _drivers() -> dict[str, Any]:
    from ssad.drivers.builtin import Autopilot, Blind

    return {"Autopilot": Autopilot(), "blind": Blind()}


def row(name: str, repetitions: int) -> str:
    """One line of the table: how many vehicles cross in a set, and how often its drivers collide."""
    from benchmarks.belief import make_episodes, text
    from benchmarks.belief import row as outcome
    from ssad.world.rollout import rollout

    episodes, graphs = make_episodes(name, repetitions)
    count = crossings(episodes, graphs)
    cells = [name, str(len(episodes)), *(f"{v.mean():.2f}" for v in (count, count >= 1, count >= 2))]
    for driver in _drivers().values():
        found = outcome(rollout(World(episodes, graphs), driver), repetitions)
        cells += [text(found["CR"]), text(found["RC"])]
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    """Drive, print, and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenarios", default="natural,natural-unselected", help="sets, with commas")
    parser.add_argument("--repetitions", type=int, default=1)
    parser.add_argument("--page", action="store_true", help="write docs/results/traffic.md")
    given = parser.parse_args()
    heads = ["set", "episodes", "crossing vehicles", "share with one", "with two"]
    heads += [f"{kind}, {name}" for name in _drivers() for kind in ("CR", "RC")]
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    print("\n".join(lines))
    for name in given.scenarios.split(","):
        lines.append(row(name, given.repetitions))
        print(lines[-1], flush=True)
    if given.page:
        insert("results/traffic.md", "crossing traffic", ["", *lines])


if __name__ == "__main__":
    main()
