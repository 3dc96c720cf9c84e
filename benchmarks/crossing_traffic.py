"""How much traffic crosses the ego's way, counted without an ego, and what becomes of those who drive there.

`python -m benchmarks.crossing_traffic --scenarios natural,natural-unselected` prints a table; `frea` too, once it has
been imported. `--page` writes the table into docs/results/traffic.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from benchmarks.insert import insert
from ssad.core.geometry import obb_distance
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import Controller, Episode, Route
from ssad.world.kernels.data import Presence
from ssad.world.world import World

PICK_UP = 2.5  # m/s^2 with which the ego is expected to start: the Autopilot's
WITHIN = 4.0  # s between two at the same place that count as an encounter
ACROSS = 0.5  # rad between the way of the ego and who crosses it


def schedule(route: Route, speed: float, target: float, step: float) -> npt.NDArray[np.float64]:
    """Places [N, 3] (x, y, yaw) every `step` s of an ego that is alone: it drives as fast as it likes and may."""
    places, s, v = [], 0.0, speed
    while s < route.length:
        places.append(s / route.spacing)
        v = min(v + PICK_UP * step, target, float(route.speed_limit[int(places[-1])]))
        s += v * step
    index = np.arange(len(route.yaw))
    return np.stack([np.interp(places, index, column) for column in (*route.xy.T, np.unwrap(route.yaw))], 1)


def crossings(episodes: Sequence[Episode], graphs: Mapping[str, LaneGraph]) -> npt.NDArray[np.intp]:
    """How many vehicles of each episode cross the ego's way within 4 s of when it would be there; nobody drives it.

    Traffic wakes as if the ego came, but nobody sees one.
    """
    world = World(episodes, graphs, ego=Controller.NONE)
    ways = [schedule(e.agents[0].route, e.agents[0].speed, e.agents[0].target_speed, world.dt) for e in episodes]
    size = world.state().size.astype(np.float64)
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
    found = np.zeros(len(ways), np.intp)
    for b, way in enumerate(ways):
        steps = np.arange(len(way))
        together = np.abs(steps[:, None] - steps) * world.dt <= WITHIN
        for j in range(1, world.agents):
            other = where[: len(way), b, j]
            reach = 0.5 * np.hypot(*size[b, j]) + 0.5 * np.hypot(*size[b, 0])
            near = np.hypot(other[:, None, 0] - way[:, 0], other[:, None, 1] - way[:, 1]) < reach
            across = np.abs(np.sin(other[:, None, 2] - way[:, 2])) > np.sin(ACROSS)
            t, u = np.nonzero(together & near & across & there[: len(way), b, j, None])
            if len(t):
                body = np.hstack([other[t], np.tile(size[b, j], (len(t), 1))])
                ego = np.hstack([way[u], np.tile(size[b, 0], (len(u), 1))])
                found[b] += bool((obb_distance(body, ego) <= 0.0).any())
    return found


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
