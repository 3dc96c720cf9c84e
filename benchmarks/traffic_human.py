"""Traffic beside published statistics of human driving: `python -m benchmarks.traffic --human`.

Drives scenes as `benchmarks.traffic` does, records every vehicle, and measures with `ssad.metrics.traffic_statistics`.
The published values come from `ssad.metrics.human_driving`, each with its certainty.
"""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import traffic_walkers
from benchmarks.insert import DOCS, insert
from benchmarks.traffic_walkers import (
    BESIDE_PUBLISHED,
    WalkRecord,
    WalkRecorder,
    count_contacts,
    is_vehicle,
    measure_walkers,
    walker_rates,
)
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import AgentKind, End, Episode
from ssad.metrics.human_driving import certainty_of, published, spread
from ssad.metrics.traffic_statistics import (
    begins,
    braking_onsets,
    critical_gap,
    distance,
    gap_choices,
    jerk,
    lane_changes,
    lateral_acceleration,
    post_encroachment_times,
    quantiles,
    queue_discharge,
    standstill_gaps,
    time_gaps,
    visits,
)
from ssad.world.episode_arrays import GREEN, YELLOW, signal_programs
from ssad.world.kernels.data import LEADERS, NO_LEADER, Presence
from ssad.world.world import World

SETTLE = 10.0  # s at the start that do not count
THRESHOLDS = (2.0, 4.0, 6.0)  # m/s^2 of braking onsets
LINE = 80.0  # m before a stop line within which who stands is in its queue
WAITS = 12.0  # m before a junction within which who stands waits for a gap
FREE = 40.0  # m from the next junction on which a driver is as fast as it likes
PICTURE = DOCS / "images" / "traffic_human.png"
# measured name -> published quantity
BESIDE = {
    "time gap": "time gap",
    "standstill gap": "standstill gap",
    "speed over limit": "desired speed over limit",
    "braking": "comfortable deceleration",
    "start": "acceleration from rest",
    "turn": "lateral acceleration in turns",
    "jerk": "jerk",
    "discharge headway": "discharge headway",
    "start-up lost time": "start-up lost time",
    "start at green": "start at green",
    "critical gap": "critical gap",
    "post-encroachment time": "post-encroachment time",
    "lane changes": "lane changes",
    "contacts": "contacts",
} | BESIDE_PUBLISHED


@dataclass
class Record:
    """Recorded values of a drive: arrays [T, N] over the steps that count and the vehicles of all scenes."""

    pose: Any
    speed: Any
    acceleration: Any
    present: Any
    lane: Any
    limit: Any
    cap: Any
    gap: Any
    leader_speed: Any
    line: Any
    junction: Any
    signal: Any
    phase: Any
    scene: Any
    length: Any
    contacts: Mapping[str, int]
    dt: float
    walks: WalkRecord | None = None


def record(graph: LaneGraph, episodes: Sequence[Episode], *, seconds: float, device: str = "cpu") -> Record:
    """Drive the scenes side by side and keep the vehicles that the world drives, step by step.

    Walkers and cyclists are kept for themselves: no statistic of vehicles counts them.
    """
    world = World(episodes, {graph.name: graph}, device=device)
    tables, route = world.bank.tables, world.bank.route[world.assigned]
    limits = np.append(graph.speed_limit, np.nan).astype(np.float32)
    half = 0.5 * world.bank.size[world.assigned][..., 0]
    programs = signal_programs(graph)
    scenes = np.repeat(np.arange(world.batch), world.agents).reshape(world.batch, world.agents)
    columns: dict[str, list[Any]] = defaultdict(list)
    kind = world.bank.kind[world.assigned]
    vehicles = is_vehicle(kind)
    walks = None if vehicles[kind != AgentKind.NONE].all() else WalkRecorder(world)
    contacts: Counter[str] = Counter()
    before = np.zeros((world.batch, world.agents), np.int64)
    if device != "cpu":
        world.step()  # compiles
        world.reset()
        world.capture()
    for step in range(1, int(seconds / world.dt) + 1):
        world.step()
        touch = world.array("touch").copy()
        fresh, before = touch & ~before, touch
        if step * world.dt <= SETTLE:
            continue
        contacts.update(count_contacts(fresh, kind))
        if walks is not None:
            walks.add()
        point = route[..., 0] + world.array("progress")
        pose, speed = world.array("pose").copy(), world.array("speed").copy()
        at = tables.path[point]
        offset = (pose[..., 0] - at[..., 0]) * np.cos(at[..., 2]) + (pose[..., 1] - at[..., 1]) * np.sin(at[..., 2])
        leader = world.work.leader.numpy()
        row = np.where(leader == NO_LEADER, 0, leader % LEADERS)
        follows = (leader != NO_LEADER) & (np.cos(pose[scenes, row, 2] - pose[..., 2]) > 0.7)
        lane = world.array("lane").copy()
        rule, signal = tables.rule[point], tables.signal[point]
        program = programs[np.maximum(signal, 0)]
        now = {
            "pose": pose,
            "speed": speed,
            "acceleration": world.array("accel").copy(),
            "present": (world.array("active") != Presence.ABSENT) & (world.ended() == End.RUNNING)[:, None] & vehicles,
            "lane": lane,
            "limit": limits[lane],
            "cap": rule[..., 0],
            "gap": np.where(follows, 0.01 * (leader // LEADERS), np.inf).astype(np.float32),
            "leader_speed": speed[scenes, row],
            "line": (rule[..., 1] - offset - half).astype(np.float32),
            "junction": np.where(rule[..., 2] > 0.0, rule[..., 2] - offset - half, -1.0).astype(np.float32),
            "signal": signal,
            "phase": np.where(
                (signal >= 0) & (program[..., 0] > 0.0),
                np.mod(step * world.dt - program[..., 1], np.maximum(program[..., 0], 1.0)),
                np.nan,
            ).astype(np.float32),
        }
        for name, value in now.items():
            columns[name].append(value.reshape(world.batch * world.agents, *value.shape[2:]))
    stacked = {name: np.stack(values) for name, values in columns.items()}
    return Record(
        **stacked,
        scene=scenes.ravel(),
        length=2.0 * half.ravel(),
        contacts=contacts,
        dt=world.dt,
        walks=None if walks is None else walks.record(),
    )


def crossings(drive: Record) -> tuple[Any, Any, Any]:
    """Return when stop lines of signals were crossed: s since green began, number of the queue, whether it stood."""
    # on red only who turns to the near side goes, who is no part of the discharge
    signalled = drive.present & (drive.signal >= 0) & (drive.phase < GREEN + YELLOW)
    crossed = signalled[:-1] & signalled[1:] & (drive.line[:-1] >= 0.0) & (drive.line[:-1] < 5.0)
    crossed &= (drive.line[1:] < 0.0) | (drive.line[1:] > drive.line[:-1] + 5.0)
    stood = np.zeros(drive.present.shape, bool)
    for step in range(1, len(stood)):
        ahead = (
            drive.present[step]
            & (drive.signal[step] >= 0)
            & (drive.line[step] < LINE)
            & (drive.signal[step] == drive.signal[step - 1])
        )
        stood[step] = ahead & (stood[step - 1] | (drive.speed[step] < 0.5))
    step, vehicle = np.nonzero(crossed)
    phase = drive.phase[step, vehicle].astype(np.float64)
    begin = np.round(step - phase / drive.dt).astype(np.int64)
    keys = np.stack([drive.scene[vehicle], drive.signal[step, vehicle], drive.lane[step, vehicle], begin // 20], 1)
    _, group = np.unique(keys, axis=0, return_inverse=True)
    return phase, group.ravel().astype(np.int64), stood[step, vehicle]


def waits(drive: Record) -> Any:
    """Return [E, 3] who waited before a junction without a signal, from which step on, and when it entered."""
    signalled = (drive.signal >= 0) & np.isfinite(drive.phase) & (drive.line < drive.junction + 3.0)
    near = drive.present & ~signalled & (drive.junction >= 0.0) & (drive.junction < WAITS)
    inside = drive.present & (drive.junction < 0.0)
    rows = []
    for step, vehicle in np.argwhere(begins(inside) & np.roll(near, 1, axis=0)).tolist():
        if step == 0:
            continue
        start = step
        while start > 0 and near[start - 1, vehicle]:
            start -= 1
        stood = np.flatnonzero(drive.speed[start:step, vehicle] < 0.5)
        if len(stood):
            rows.append((vehicle, start + int(stood[0]), step))
    return np.array(rows, np.int64).reshape(-1, 3)


def measure(drive: Record, graph: LaneGraph) -> dict[str, Any]:
    """Return the statistics of a drive: samples by name, counts, and the crossings of stop lines."""
    beside = graph.left.astype(np.int64), graph.right.astype(np.int64)
    present, dt = drive.present, drive.dt
    acceleration, speed = drive.acceleration.astype(np.float64), drive.speed.astype(np.float64)
    side = lateral_acceleration(speed, drive.pose[..., 2].astype(np.float64), present, dt)
    both = present[1:] & present[:-1]
    turning = (side > 0.5) & (drive.junction[1:] < 0.0)[both]
    inside = present & (drive.junction < 0.0)
    stays = visits(drive.pose.astype(np.float64), drive.length.astype(np.float64), drive.scene, inside)
    accepted, rejected = gap_choices(stays, waits(drive), dt)
    free = present & (drive.junction > FREE) & (drive.cap >= 0.98 * drive.limit) & (np.abs(acceleration) < 0.3)
    free &= (drive.gap > 60.0) | (drive.gap > 5.0 * speed)
    starting = present & (acceleration > 0.2) & (speed > 0.5) & (speed < 4.0)
    braking = present & (acceleration < -0.5)
    walkers = {"samples": {}, "counts": {}} if drive.walks is None else measure_walkers(drive.walks, graph)
    return {
        "samples": walkers["samples"]
        | {
            "speed": speed[present][::20],
            "speed over limit": (speed[free] / drive.limit[free])[::20],
            "time gap": time_gaps(drive.gap, speed, present)[::10],
            "standstill gap": standstill_gaps(drive.gap, speed, drive.leader_speed, present),
            "braking": -acceleration[braking][::10],
            "start": acceleration[starting][::10],
            "turn": side[turning][::10],
            "jerk": np.abs(jerk(acceleration, present, dt))[::10],
            "accepted gap": accepted,
            "rejected gap": rejected,
            "post-encroachment time": post_encroachment_times(stays, dt),
        },
        "counts": walkers["counts"]
        | dict(drive.contacts)
        | {
            "metres": distance(speed, present, dt),
            "hours": float(present.sum()) * dt / 3600.0,
            "lane changes": lane_changes(drive.lane.astype(np.int64), *beside, present),
            **{f"onsets {limit:g}": braking_onsets(acceleration, present, limit) for limit in THRESHOLDS},
        },
        "crossings": crossings(drive),
    }


def drive_town(
    graph: LaneGraph, batches: Sequence[Sequence[Episode]], *, seconds: float, device: str
) -> dict[str, Any]:
    """Drive batches of scenes one after the other and put their statistics together."""
    samples: dict[str, list[Any]] = defaultdict(list)
    counts: dict[str, float] = defaultdict(float)
    lines: list[tuple[Any, Any, Any]] = []
    queues = 0
    for batch in batches:
        part = measure(record(graph, batch, seconds=seconds, device=device), graph)
        for name, values in part["samples"].items():
            samples[name].append(np.asarray(values, np.float64))
        for name, value in part["counts"].items():
            counts[name] += value
        since, group, stood = part["crossings"]
        lines.append((since, group + queues, stood))
        queues += int(group.max(initial=-1)) + 1
    discharge = queue_discharge(*(np.concatenate(column) for column in zip(*lines, strict=True)))
    pooled = {name: np.concatenate(values) for name, values in samples.items()}
    pooled |= {"discharge headway": discharge.headways, "start at green": discharge.first}
    return summary(graph.name, pooled, counts, discharge.lost)


def summary(town: str, samples: Mapping[str, Any], counts: Mapping[str, float], lost: float) -> dict[str, Any]:
    """Return what is kept of a town: numbers, and a thinned sample of each distribution for the picture."""
    hundred_km, hundred_hours = counts["metres"] / 1e5, counts["hours"] / 100.0
    rates = {f"onsets {limit:g}": counts[f"onsets {limit:g}"] / hundred_km for limit in THRESHOLDS}
    return {
        "town": town,
        "km": counts["metres"] / 1e3,
        "hours": counts["hours"],
        "rates": rates
        | {
            "contacts": counts["contacts"] / hundred_hours,
            "lane changes": counts["lane changes"] / (counts["metres"] / 1e3),
            "critical gap": critical_gap(samples["accepted gap"], samples["rejected gap"]),
            "start-up lost time": lost,
        }
        | (walker_rates(dict(counts)) if counts["walker hours"] + counts["cyclist hours"] > 0.0 else {}),
        "distributions": {name: quantiles(values) for name, values in samples.items()},
        "quantiles": {
            name: np.round(np.quantile(values, np.linspace(0.0, 1.0, 101)), 3).tolist()
            for name, values in samples.items()
            if len(values)
        },
    }


def published_range(name: str) -> str:
    """Return the spread of the published values of a measured name, with a mark for what was not checked."""
    quantity = BESIDE.get(name)
    if quantity is None:
        return ""
    low, high = spread(quantity)
    text = f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}"
    return text + {"read": "", "cited": "", "memory": " (unchecked)"}[certainty_of(quantity)]


DISTRIBUTIONS = (
    ("time gap", "time gap of followers, s"),
    ("standstill gap", "gap between standing vehicles, m"),
    ("speed", "speed, m/s"),
    ("speed over limit", "free speed over the limit"),
    ("braking", "deceleration while braking, m/s²"),
    ("start", "acceleration from rest, m/s²"),
    ("turn", "acceleration to the side in turns, m/s²"),
    ("jerk", "jerk, m/s³"),
    ("discharge headway", "headway of a queue from the fourth vehicle on, s"),
    ("start at green", "from green to the first vehicle at the line, s"),
    ("accepted gap", "accepted gaps, s"),
    ("post-encroachment time", "post-encroachment time, s"),
)
RATES = (
    ("onsets 2", "braking onsets above 2 m/s² per 100 km"),
    ("onsets 4", "above 4 m/s²"),
    ("onsets 6", "above 6 m/s²"),
    ("contacts", "contacts per 100 vehicle-hours"),
    ("lane changes", "lane changes per km"),
    ("critical gap", "critical gap without signals, s"),
    ("start-up lost time", "start-up lost time, s"),
)


def rows_of(towns: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the tables of the page: rates by town, and distributions over all of them."""
    heads = ["town", "km", *(title for _, title in RATES)]
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for town in towns:
        cells = [f"{town['rates'][name]:.2f}" if np.isfinite(town["rates"][name]) else "" for name, _ in RATES]
        lines.append("| " + " | ".join([town["town"], f"{town['km']:,.0f}", *cells]) + " |")
    lines.append("| *published* | | " + " | ".join(published_range(name) for name, _ in RATES) + " |")
    heads = ["", *(town["town"] for town in towns), "published"]
    lines += ["", "Percentiles 5, 50 and 95 (jerk: 50, 95 and 99):", ""]
    lines += ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for name, title in DISTRIBUTIONS:
        keys = ("p50", "p95", "p99") if name == "jerk" else ("p5", "p50", "p95")
        cells = [
            " / ".join(f"{town['distributions'][name][key]:.2f}" for key in keys) if town["distributions"][name] else ""
            for town in towns
        ]
        lines.append("| " + " | ".join([title, *cells, published_range(name)]) + " |")
    return lines + walker_rows([town for town in towns if "crossings" in town["rates"]])


def walker_rows(towns: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the tables of walkers and cyclists; nothing without them."""
    if not towns:
        return []
    heads = ["town", *(title for _, title in traffic_walkers.RATES)]
    lines = ["", "Walkers and cyclists:", "", "| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for town in towns:
        values = [town["rates"][name] for name, _ in traffic_walkers.RATES]
        cells = [f"{value:.2f}" if value is not None and np.isfinite(value) else "" for value in values]
        lines.append("| " + " | ".join([town["town"], *cells]) + " |")
    published_cells = [published_range(name) for name, _ in traffic_walkers.RATES]
    lines.append("| *published* | " + " | ".join(published_cells) + " |")
    heads = ["", *(town["town"] for town in towns), "published"]
    lines += ["", "Percentiles 5, 50 and 95:", "", "| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for name, title in traffic_walkers.DISTRIBUTIONS:
        parts = [town["distributions"].get(name) for town in towns]
        cells = [" / ".join(f"{part[key]:.2f}" for key in ("p5", "p50", "p95")) if part else "" for part in parts]
        lines.append("| " + " | ".join([title, *cells, published_range(name)]) + " |")
    return lines


def draw(groups: Mapping[str, Sequence[Mapping[str, Any]]], file: Path) -> None:
    """Draw the distributions of all towns beside the spread of the published means.

    Args:
        groups: Name of the traffic, such as its drivers -> its towns.
        file: PNG.
    """
    import matplotlib.pyplot as plt

    names = [(name, title) for name, title in DISTRIBUTIONS if name != "speed"]
    figure, axes = plt.subplots(3, 4, figsize=(12.5, 7.2), layout="constrained")
    colours = ("#3b6ea8", "#c2571a", "#4f7f3b")
    for axis, (name, title) in zip(axes.flat, names, strict=False):
        quantity = BESIDE.get(name)
        if quantity is not None:
            low, high = spread(quantity)
            weak = certainty_of(quantity) == "memory"
            axis.axvspan(low, max(high, low * 1.002), color="#bbbbbb", alpha=0.25 if weak else 0.55, lw=0)
            for statistic in published(quantity):
                if statistic.mean is not None:
                    axis.axvline(statistic.mean, color="#888888", lw=0.7, ls=":" if weak else "-")
        for colour, (label, towns) in zip(colours, groups.items(), strict=False):
            for number, town in enumerate(towns):
                if name in town["quantiles"]:
                    share = np.linspace(0.0, 1.0, 101)
                    text = label if number == 0 else None
                    axis.plot(town["quantiles"][name], share, color=colour, lw=0.9, alpha=0.75, label=text)
        axis.set_title(title, fontsize=8)
        axis.tick_params(labelsize=7)
        axis.spines[["top", "right"]].set_visible(False)
        if name == "jerk":
            axis.set_xscale("symlog", linthresh=1.0)
    for axis in axes.flat[len(names) :]:
        axis.set_axis_off()
    handles, labels = axes.flat[0].get_legend_handles_labels()
    axes.flat[-1].legend(handles, labels, loc="center", fontsize=8, frameon=False)
    figure.supylabel("share below", fontsize=8)
    figure.savefig(file, dpi=100, pil_kwargs={"optimize": True})
    plt.close(figure)


def group_name(run: Mapping[str, Any]) -> str:
    """Return what a stored run is called on the page: its drivers, and who else takes part."""
    others = [f"{run[kind]} {kind}" for kind in ("walkers", "cyclists") if run.get(kind)]
    return ", with ".join([run["drivers"], *([" and ".join(others)] if others else [])])


def write_page(groups: Mapping[str, Sequence[Mapping[str, Any]]]) -> None:
    """Write the section of docs/results/traffic.md and its picture."""
    lines: list[str] = []
    for label, towns in groups.items():
        lines += [f"### Drivers: {label}", "", *rows_of(towns), ""]
    insert("results/traffic.md", "human", lines)
    draw(groups, PICTURE)


def load(file: Path) -> dict[str, Any]:
    """Return a stored run; SystemExit where the file is none."""
    data: dict[str, Any] = json.loads(file.read_text())
    if "drivers" not in data or "towns" not in data:
        raise SystemExit(f"{file} holds no statistics of traffic; make it with `benchmarks.traffic --human --json`")
    return data


def show(towns: Sequence[Mapping[str, Any]]) -> None:
    """Print the statistics of towns beside the published ones."""
    for line in rows_of(towns):
        print(line)
