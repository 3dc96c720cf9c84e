"""How well background traffic drives: contacts between vehicles, vehicles off the road, queues that do not clear.

`python -m benchmarks.traffic --hours 50` drives 50 vehicle-hours in every town that is here, imported ones too;
`--towns` takes names and files (.xodr, .npz), `--signals green` switches all real signals to green, as in recorded
drives, so that priority alone decides. Prints a table and where it happened. `--json FILE` keeps both after every batch
of scenes; run again, it goes on to `--hours`. `--page` writes the table of docs/results/traffic.md, with what other
files hold (`--also FILE`; `--first` numbers their scenes, so that they are other traffic).

`--human` measures how much the traffic is like that of people: headways, gaps, speeds, braking, junctions, signals,
lane changes, beside published figures. With `--page` it writes their tables and picture. With `--walkers` and
`--cyclists` it measures them too: crossings, waits, vehicles that yield, times between walkers and vehicles.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.insert import insert
from ssad.core.lane_graph import LaneGraph
from ssad.core.machine import start_warp_quietly
from ssad.core.seeding import generator
from ssad.core.types import (
    Controller,
    End,
    Episode,
    EpisodeAgent,
    EpisodeLimits,
    LaneType,
    Pose,
    Route,
    Scenario,
    SignalState,
    TrafficPlan,
)
from ssad.scenarios.dynamic.knowledge.driver_population import with_driver
from ssad.scenarios.dynamic.knowledge.natural_junction import fits_route
from ssad.scenarios.dynamic.knowledge.vulnerable_users import (
    EDGE,
    MAX_SPEED_LIMIT,
    cycling_route,
    cyclist,
    draw_walkers,
)
from ssad.world.episode_arrays import signal_programs
from ssad.world.kernels.data import Presence
from ssad.world.roads import load_town, random_route
from ssad.world.roads.library import BUILT_IN, town_names
from ssad.world.roads.query import LaneQuery
from ssad.world.world import VERSION, World

BODIES = {
    "car": 0.30,
    "suv": 0.20,
    "coupe": 0.10,
    "compact": 0.14,
    "van": 0.07,
    "motorcycle": 0.07,
    "truck": 0.07,
    "bus": 0.05,
}
APART = 16.0  # m between two vehicles at the start
ROUTES = 500  # of a town, from which each vehicle takes one
LENGTH = 3500.0  # m of a route
SETTLE = 10.0  # s at the start that do not count: vehicles begin where no traffic has put them
CYCLES = 3.0  # signal cycles after which a vehicle that stood all the time is in a queue that does not clear
LEAST_CYCLE = 32.0  # s, where a town has no signals
RECORDED = 8  # scenes side by side of which every step is kept
KINDS = ("contacts", "off_road", "stuck")

Row = dict[str, Any]  # of a town: its name, vehicle-hours, number of scenes, and what has happened, by kind


def upper_limit(count: int, share: float = 0.95) -> float:
    """Upper limit of the mean of a Poisson distribution of which `count` events were seen (one-sided)."""
    low, high = float(count), count + 10.0 * math.sqrt(count + 1.0) + 10.0
    for _ in range(80):
        mean = 0.5 * (low + high)
        below = sum(math.exp(k * math.log(mean) - mean - math.lgamma(k + 1)) for k in range(count + 1))
        low, high = (mean, high) if below > 1.0 - share else (low, mean)
    return high


def town_routes(graph: LaneGraph, count: int, length: float) -> list[Route]:
    """Random ways through a town; their starts are spread over all driving lanes outside junctions."""
    draws = generator("traffic routes", graph.name)
    lanes = np.flatnonzero((graph.kind == LaneType.DRIVING) & (graph.junction < 0) & (graph.length > 14.0))
    share = graph.length[lanes] / graph.length[lanes].sum()
    routes = []
    for lane in draws.choice(lanes, count, p=share).tolist():
        s = float(draws.uniform(6.0, graph.length[lane] - 6.0))
        routes.append(random_route(graph, lane, s, length, draws))
    return routes


def traffic(
    graph: LaneGraph,
    routes: Sequence[Route],
    vehicles: int,
    *,
    key: int,
    green: bool,
    drivers: str = "uniform",
    walkers: int = 0,
    cyclists: int = 0,
    seconds: float = 300.0,
    errors: float = 0.0,
) -> Episode:
    """Vehicles on ways drawn from `routes`, each as fast as it likes, up to the limit of its roads.

    Walkers walk for `seconds`. Drivers of the population make so many errors an hour each.
    """
    draws = generator("traffic", graph.name, key)
    agents: list[EpisodeAgent] = []
    for number in draws.permutation(len(routes)).tolist():
        if len(agents) == vehicles:
            break
        route = routes[number]
        x, y = (float(v) for v in route.xy[0])
        if any(math.hypot(a.pose.x - x, a.pose.y - y) < APART for a in agents):
            continue
        body = str(draws.choice(list(BODIES), p=list(BODIES.values())))
        body = body if fits_route(body, route) else "compact"
        wish = float(draws.uniform(0.75, 1.05)) * float(route.speed_limit.max())
        start = 0.6 * min(wish, float(route.speed_limit[0]))
        pose = Pose(x, y, float(route.yaw[0]))
        agent = EpisodeAgent(f"{body} {len(agents)}", body, Controller.AUTOPILOT, pose, start, wish, route=route)
        if drivers == "population":
            # how fast it likes to go is its driver's pace
            agent = replace(agent, target_speed=float(route.speed_limit.max()))
            agent = with_driver(agent, key, len(agents), errors=errors)
        agents.append(agent)
    if cyclists:
        agents += town_cyclists(graph, routes, agents, cyclists, key)
    plan = TrafficPlan(walkers=walkers)
    agents += draw_walkers(plan, graph, None, agents, seconds, "traffic", graph.name, key)
    limits = EpisodeLimits(max_steps=10**6, max_time=1e6, max_distance=1e9, contact="count")
    scenario = Scenario(f"traffic/{key}", "Custom", graph.name, (agents[0].pose, agents[0].pose), limits=limits)
    real = np.flatnonzero(~graph.signal_virtual).tolist()
    forced = dict.fromkeys(real, SignalState.GREEN) if green else {}
    return Episode(f"traffic/{graph.name}/{key}", scenario, graph.name, tuple(agents), forced, 1e6, limits)


def town_cyclists(
    graph: LaneGraph, routes: Sequence[Route], others: Sequence[EpisodeAgent], count: int, key: int
) -> list[EpisodeAgent]:
    """Draw cyclists on those of the ways that begin on an outermost lane."""
    draws = generator("traffic cyclists", graph.name, key)
    beside = graph.left if graph.left_hand[0] else graph.right
    agents: list[EpisodeAgent] = []
    for number in draws.permutation(len(routes)).tolist():
        if len(agents) == count:
            break
        route = routes[number]
        neighbour = int(beside[route.lane[0]])
        is_fast = float(route.speed_limit[0]) > MAX_SPEED_LIMIT
        if is_fast or (neighbour >= 0 and graph.kind[neighbour] == LaneType.DRIVING):
            continue
        path = cycling_route(graph, route, float(draws.uniform(*EDGE)))
        start = tuple(path.xy[0].tolist())
        if any(math.dist((agent.pose.x, agent.pose.y), start) < APART for agent in (*others, *agents)):
            continue
        agents.append(cyclist(f"cyclist {len(agents) + 1}", path, 0.0, draws))
    return agents


def patience(graph: LaneGraph) -> float:
    """Seconds that a vehicle may stand in a queue."""
    return CYCLES * max(float(signal_programs(graph)[:, 0].max(initial=0.0)), LEAST_CYCLE)


def between_lanes(graph: LaneGraph, place: Mapping[str, float]) -> bool:
    """Whether who is on no lane has one within half a metre on its left and on its right.

    The strips of two lanes side by side leave a narrow gap between them in a bend.
    """
    side = 0.5 * np.array([-math.sin(place["yaw"]), math.cos(place["yaw"])])
    here = np.array([place["x"], place["y"]])
    return bool(LaneQuery(graph).nearest([here + side, here - side]).is_inside.all())


def measure(graph: LaneGraph, episodes: Sequence[Episode], *, seconds: float, device: str = "cpu") -> dict[str, Any]:
    """Drive episodes in parallel for some seconds; return vehicle-hours, contacts, vehicles off the road and queues."""
    world = World(episodes, {graph.name: graph}, device=device)
    shape = (world.batch, world.agents)
    before, stood = np.zeros(shape, np.int64), np.zeros(shape)
    left, stuck = np.zeros(shape, bool), np.zeros(shape, bool)
    found: dict[str, list[dict[str, Any]]] = {kind: [] for kind in KINDS}
    steps, longest = 0, patience(graph)
    if device != "cpu":
        world.step()  # compiles
        world.reset()
        world.capture()

    def about(scene: int, agent: int) -> dict[str, Any]:
        x, y, yaw = world.array("pose")[scene, agent].tolist()
        return {
            "scene": episodes[scene].key,
            "agent": agent,
            "body": episodes[scene].agents[agent].model,
            "time": now,
            "x": round(x, 1),
            "y": round(y, 1),
            "yaw": round(yaw, 2),
            "speed": round(float(world.array("speed")[scene, agent]), 1),
        }

    for step in range(1, int(seconds / world.dt) + 1):
        world.step()
        now = round(step * world.dt, 1)
        touch = world.array("touch").copy()
        fresh, before = touch & ~before, touch
        if now <= SETTLE:
            continue
        # where the first vehicle is at the end of its way, the scene has ended and stands still
        here = (world.array("active") != Presence.ABSENT) & (world.ended() == End.RUNNING)[:, None]
        steps += int(here.sum())
        for scene, agent in np.argwhere(fresh != 0).tolist():
            for other in range(agent + 1, world.agents):
                if int(fresh[scene, agent]) >> other & 1:
                    found["contacts"].append(about(scene, agent) | {"other": about(scene, other)})
        for scene, agent in np.argwhere(here & (world.array("lane") < 0) & ~left).tolist():
            place = about(scene, agent)
            left[scene, agent] = not between_lanes(graph, place)
            found["off_road"] += [place] * int(left[scene, agent])
        stood = np.where(here & (world.array("speed") < 0.2), stood + world.dt, 0.0)
        for scene, agent in np.argwhere((stood > longest) & ~stuck).tolist():
            found["stuck"].append(about(scene, agent))
        stuck |= stood > longest
    return {"hours": steps * world.dt / 3600.0, **found}


def drive_batch(row: Row, graph: LaneGraph, routes: Sequence[Route], given: argparse.Namespace) -> None:
    """Add as many scenes to a town's row as its hours need, but no more than are driven side by side."""
    need = math.ceil((given.hours - row["hours"]) * 60.0 / (given.vehicles * given.minutes))
    keys = range(given.first + row["scenes"], given.first + row["scenes"] + max(1, min(given.scenes, need)))
    green = given.signals == "green"
    episodes = [traffic(graph, routes, given.vehicles, key=k, green=green, drivers=given.drivers) for k in keys]
    part = measure(graph, episodes, seconds=60.0 * given.minutes, device=given.device)
    row["scenes"] += len(keys)
    for name, value in part.items():
        row[name] += value


def rate(row: dict[str, Any]) -> tuple[float, float]:
    """Contacts per 100 vehicle-hours and their upper limit."""
    hundred = row["hours"] / 100.0
    return len(row["contacts"]) / hundred, upper_limit(len(row["contacts"])) / hundred


def kept(file: Path, about: dict[str, Any]) -> dict[str, Row]:
    """The rows of an earlier run, by town; SystemExit where it was another kind of traffic."""
    data = json.loads(file.read_text())
    other = [f"{name} {data.get(name)}" for name, value in about.items() if data.get(name) != value]
    if other:
        raise SystemExit(f"{file} holds other traffic ({', '.join(other)}); give another file")
    for row in data["towns"]:  # older files hold gaps between lanes, too
        graph = load_town(row["town"]) if row["off_road"] else None
        row["off_road"] = [place for place in row["off_road"] if graph and not between_lanes(graph, place)]
    return {row["town"]: row for row in data["towns"]}


def main() -> None:
    """Drive, print, and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--towns", default=",".join(town_names()), help="names or files, with commas")
    parser.add_argument("--human", action="store_true", help="statistics beside published ones of human driving")
    parser.add_argument("--hours", type=float, default=20.0, help="vehicle-hours in each town")
    parser.add_argument("--vehicles", type=int, default=40, help="in each scene")
    parser.add_argument("--minutes", type=float, default=5.0, help="of each scene")
    parser.add_argument("--scenes", type=int, default=128, help="at most so many side by side")
    parser.add_argument("--drivers", choices=("uniform", "population"), default="uniform")
    parser.add_argument("--walkers", type=int, default=0, help="walkers in each scene, with --human")
    parser.add_argument("--cyclists", type=int, default=0, help="cyclists in each scene, with --human")
    parser.add_argument("--signals", choices=("program", "green"), default="program")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--show", type=int, default=5, help="places of each kind to print for a town")
    parser.add_argument("--first", type=int, default=0, help="number of the first scene: others are other traffic")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--also", type=Path, nargs="*", default=[], help="files of --json whose towns are added")
    parser.add_argument("--page", action="store_true", help="write docs/results/traffic.md")
    given = parser.parse_args()
    start_warp_quietly()
    if given.human:
        compare_with_people(given)
        return
    traffic_of = {"world": VERSION, "vehicles": given.vehicles, "minutes": given.minutes, "signals": given.signals}
    traffic_of |= {} if given.drivers == "uniform" else {"drivers": given.drivers}
    about = traffic_of | {"first": given.first}
    rows = kept(given.json, about) if given.json and given.json.is_file() else {}
    heads = ("town", "hours", "contacts", "per 100 h", "95 % up", "off road", "stuck", "s")
    print("{:22} {:>7} {:>8} {:>9} {:>8} {:>8} {:>6} {:>6}".format(*heads))
    for name in filter(None, given.towns.split(",")):
        began = time.process_time()
        graph = load_town(name)
        empty = {"town": graph.name, "hours": 0.0, "scenes": 0, **{kind: [] for kind in KINDS}}
        row = rows.setdefault(graph.name, empty)
        routes = town_routes(graph, ROUTES, LENGTH) if row["hours"] < given.hours else []
        while row["hours"] < given.hours:
            drive_batch(row, graph, routes, given)
            if given.json:
                given.json.write_text(json.dumps(about | {"towns": [*rows.values()]}) + "\n", encoding="utf-8")
        print(_line(row), f"{time.process_time() - began:6.0f}", flush=True)
        for kind in KINDS:
            for one in row[kind][: given.show]:
                print("   ", kind, json.dumps(one), flush=True)
    every = [*rows.values(), *(row for file in given.also for row in kept(file, traffic_of).values())]
    total = together("all", every)
    print(_line(total))
    if given.page:
        towns = {row["town"]: [other for other in every if other["town"] == row["town"]] for row in every}
        own = together("our own", [row for row in every if row["town"] in BUILT_IN])
        page([*(together(town, parts) for town, parts in towns.items()), own, total])


def compare_with_people(given: argparse.Namespace) -> None:
    """Measure the traffic beside published statistics of human driving; print, and write."""
    from benchmarks.traffic_human import drive_town, group_name, load, show, write_page

    about = {"world": VERSION, "drivers": given.drivers, "vehicles": given.vehicles, "minutes": given.minutes}
    if given.walkers or given.cyclists:
        about |= {"walkers": given.walkers, "cyclists": given.cyclists}
    towns = load(given.json)["towns"] if given.json and given.json.is_file() else []
    measured = {town["town"] for town in towns}
    scenes = max(1, math.ceil(given.hours * 60.0 / (given.vehicles * given.minutes)))
    for name in filter(None, given.towns.split(",")):
        graph = load_town(name)
        if graph.name in measured:
            continue
        routes = town_routes(graph, ROUTES, LENGTH)
        keys = range(given.first, given.first + scenes)
        green = given.signals == "green"
        people = {"walkers": given.walkers, "cyclists": given.cyclists, "seconds": 60.0 * given.minutes}
        episodes = [
            traffic(graph, routes, given.vehicles, key=k, green=green, drivers=given.drivers, **people) for k in keys
        ]
        size = min(given.scenes, RECORDED)
        batches = [episodes[first : first + size] for first in range(0, scenes, size)]
        towns.append(drive_town(graph, batches, seconds=60.0 * given.minutes, device=given.device))
        if given.json:
            given.json.write_text(json.dumps(about | {"towns": towns}) + "\n", encoding="utf-8")
    show(towns)
    if given.page:
        runs = [load(file) for file in given.also]
        if towns:
            runs.insert(0, about | {"towns": towns})
        write_page({group_name(run): run["towns"] for run in runs})


def together(name: str, rows: Sequence[Row]) -> Row:
    """One row for several."""
    found = {kind: [one for row in rows for one in row[kind]] for kind in KINDS}
    return {"town": name, "hours": sum(row["hours"] for row in rows)} | found


def page(rows: Sequence[dict[str, Any]]) -> None:
    """Write the table of docs/results/traffic.md; the last two rows hold several towns."""
    lines = [
        "| town | vehicle-hours | contacts | per 100 h | upper 95 % limit | off the road | in a lasting queue |",
        "|---" * 7 + "|",
    ]
    for row in rows:
        mean, most = rate(row)
        lines.append(
            f"| {row['town']} | {row['hours']:,.0f} | {len(row['contacts'])} | {mean:.2f} | {most:.2f} | "
            f"{len(row['off_road'])} | {len(row['stuck'])} |"
        )
    towns = [rate(row)[0] for row in rows[:-2]]
    lines.append(f"| all, each town alike | | | {sum(towns) / len(towns):.2f} | | | |")
    insert("results/traffic.md", "traffic", lines)


def _line(row: dict[str, Any]) -> str:
    mean, most = rate(row)
    return (
        f"{row['town']:22} {row['hours']:7.1f} {len(row['contacts']):8} {mean:9.2f} {most:8.2f} "
        f"{len(row['off_road']):8} {len(row['stuck']):6}"
    )


if __name__ == "__main__":
    main()
