"""Contacts that human errors cause: `python -m benchmarks.traffic_errors --towns Crossgate --hours 100 --page`.

Drives the scenes of `benchmarks.traffic` with the population of drivers at several rates of errors, the same vehicles
at each, and counts the errors that are made and the contacts. `--page` writes the table of docs/results/traffic.md.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence

import numpy as np

from benchmarks.insert import insert
from benchmarks.traffic import LENGTH, ROUTES, SETTLE, town_routes, traffic, upper_limit
from ssad.core.lane_graph import LaneGraph
from ssad.core.machine import start_warp_quietly
from ssad.core.types import End, Episode
from ssad.world.kernels.data import Presence
from ssad.world.kernels.drivers import LAPSE
from ssad.world.roads import load_town
from ssad.world.world import World

MINUTES = 5.0  # of each scene
VEHICLES = 40  # in each scene


def count_errors(graph: LaneGraph, episodes: Sequence[Episode]) -> tuple[float, float, int]:
    """Return the vehicle-hours of scenes, the errors that drivers made and the contacts of vehicles."""
    world = World(episodes, {graph.name: graph})
    steps, lapsed_steps, contacts = 0, 0, 0
    before = np.zeros((world.batch, world.agents), np.int64)
    for step in range(1, int(60.0 * MINUTES / world.dt) + 1):
        world.step()
        touch = world.array("touch").copy()
        fresh, before = touch & ~before, touch
        if step * world.dt <= SETTLE:
            continue
        present = (world.array("active") != Presence.ABSENT) & (world.ended() == End.RUNNING)[:, None]
        steps += int(present.sum())
        lapsed_steps += int((world.work.judgement.numpy()[..., 1] > 0.5)[present].sum())
        contacts += sum(int(row).bit_count() for row in fresh.ravel().tolist()) // 2
    return steps * world.dt / 3600.0, lapsed_steps * world.dt / float(LAPSE), contacts


def row_of(graph: LaneGraph, errors: float, *, hours: float, first: int) -> str:
    """Return a row of the table: a town at a rate of errors."""
    routes = town_routes(graph, ROUTES, LENGTH)
    scenes = math.ceil(hours * 60.0 / (VEHICLES * MINUTES))
    driven, made, contacts = 0.0, 0.0, 0
    for key in range(first, first + scenes):
        episode = traffic(graph, routes, VEHICLES, key=key, green=False, drivers="population", errors=errors)
        part = count_errors(graph, [episode])
        driven, made, contacts = driven + part[0], made + part[1], contacts + part[2]
    hundred = driven / 100.0
    return (
        f"| {graph.name} | {errors:g} | {driven:,.0f} | {made:,.0f} | {errors * driven:,.0f} | {contacts} "
        f"| {contacts / hundred:.1f} | {upper_limit(contacts) / hundred:.1f} |"
    )


def main() -> None:
    """Drive, print, and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--towns", default="Crossgate", help="names, with commas")
    parser.add_argument("--errors", default="0,1,10,60", help="errors of each driver an hour, with commas")
    parser.add_argument("--hours", type=float, default=100.0, help="vehicle-hours for each town and rate")
    parser.add_argument("--first", type=int, default=0, help="number of the first scene")
    parser.add_argument("--page", action="store_true", help="write docs/results/traffic.md")
    given = parser.parse_args()
    start_warp_quietly()
    heads = (
        "town",
        "errors an hour",
        "vehicle-hours",
        "errors made",
        "expected",
        "contacts",
        "per 100 h",
        "upper 95 %",
    )
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    print("\n".join(lines))
    for town in given.towns.split(","):
        for errors in map(float, given.errors.split(",")):
            lines.append(row_of(load_town(town), errors, hours=given.hours, first=given.first))
            print(lines[-1], flush=True)
    if given.page:
        insert("results/traffic.md", "errors", lines)


if __name__ == "__main__":
    main()
