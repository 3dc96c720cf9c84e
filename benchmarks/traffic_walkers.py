"""Walkers and cyclists in traffic beside published statistics: `python -m benchmarks.traffic --human --walkers 16`."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from ssad.core.lane_graph import LaneGraph
from ssad.core.types import AgentKind
from ssad.metrics.traffic_statistics import post_encroachment_times, visits
from ssad.world.kernels.data import Presence, WalkStatus
from ssad.world.roads.sidewalks import sidewalk_network
from ssad.world.world import World

NEAR = 12.0  # m around a crossing within which vehicles count for post-encroachment times
WAITED = 0.5  # s; a shorter stop is no wait
ABREAST = 0.9  # cosine of the headings of a cyclist and a vehicle that passes it
BESIDE = 3.5  # m between the bodies of a cyclist and a vehicle on the lane beside it
BESIDE_PUBLISHED = {
    "yields": "share of drivers who yield",
    "kerb wait": "longest wait at the kerb",
    "walker PET": "post-encroachment time of walkers",
    "walker speed": "walking speed at crossings",
    "cycling speed": "cycling speed",
    "cycling start": "acceleration of cyclists",
    "passing distance": "distance to a cyclist in passing",
}
DISTRIBUTIONS = (
    ("kerb wait", "wait at the kerb of those who wait, s"),
    ("walker speed", "walking speed on crossings, m/s"),
    ("walker PET", "post-encroachment time of walkers and vehicles, s"),
    ("cycling speed", "cycling speed far from others, m/s"),
    ("cycling start", "acceleration of cyclists from rest, m/s²"),
    ("passing distance", "distance between cyclists and vehicles that pass them, m"),
)
RATES = (
    ("crossings", "crossings per walker-hour"),
    ("waits", "share who waited"),
    ("yields", "share with a vehicle that yielded"),
    ("walker contacts", "contacts of vehicles with walkers per 100 vehicle-hours"),
    ("cyclist contacts", "with cyclists"),
)


def is_vehicle(kind: Any) -> Any:
    """Return where agents are motor vehicles; kind: `AgentKind`."""
    return (kind != AgentKind.WALKER) & (kind != AgentKind.BICYCLE) & (kind != AgentKind.NONE)


def count_contacts(fresh: Any, kind: Any) -> dict[str, int]:
    """Count the contacts that begin in a step: between vehicles, and of vehicles with walkers and cyclists.

    Args:
        fresh: [B, A] agents that each agent begins to touch, one bit an agent.
        kind: [B, A] AgentKind.
    """
    counts = {"contacts": 0, "walker contacts": 0, "cyclist contacts": 0}
    for scene, agent in np.argwhere((fresh != 0) & is_vehicle(kind)).tolist():
        for other in range(fresh.shape[1]):
            if not int(fresh[scene, agent]) >> other & 1:
                continue
            if kind[scene, other] == AgentKind.WALKER:
                counts["walker contacts"] += 1
            elif kind[scene, other] == AgentKind.BICYCLE:
                counts["cyclist contacts"] += 1
            elif other > agent or not is_vehicle(kind[scene, other]):
                counts["contacts"] += 1
    return counts


@dataclass
class WalkRecord:
    """Recorded values of walkers, cyclists and vehicles: arrays [T, N] over the steps that count and all agents."""

    pose: Any
    speed: Any
    acceleration: Any
    present: Any
    status: Any
    stage: Any
    waited: Any
    yielded: Any
    kind: Any
    scene: Any
    size: Any
    dt: float


class WalkRecorder:
    """Recorder of a world with walkers or cyclists, step by step."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.kind = world.bank.kind[world.assigned]
        self.has_walkers = bool((self.kind == AgentKind.WALKER).any())
        self.columns: dict[str, list[Any]] = defaultdict(list)

    def add(self) -> None:
        """Record the present step."""
        names = {"pose": "pose", "speed": "speed", "acceleration": "accel"}
        if self.has_walkers:
            names |= {name: f"walk.{name}" for name in ("status", "stage", "waited", "yielded")}
        for column, name in names.items():
            value = self.world.array(name)
            self.columns[column].append(value.reshape(-1, *value.shape[2:]).copy())
        self.columns["present"].append((self.world.array("active") != Presence.ABSENT).ravel())

    def record(self) -> WalkRecord:
        """Return everything that was recorded."""
        stacked = {name: np.stack(values) for name, values in self.columns.items()}
        for name in ("status", "stage", "waited", "yielded"):
            stacked.setdefault(name, np.zeros(stacked["speed"].shape, np.int32))
        world = self.world
        return WalkRecord(
            **stacked,
            kind=self.kind.ravel(),
            scene=np.repeat(np.arange(world.batch), world.agents),
            size=world.bank.size[world.assigned].reshape(-1, 2),
            dt=world.dt,
        )


def passing_distances(drive: WalkRecord) -> Iterator[float]:
    """Yield the least distance to the side of each vehicle that passes a cyclist in its direction, m."""
    vehicles = is_vehicle(drive.kind)
    for cyclist in np.flatnonzero(drive.kind == AgentKind.BICYCLE).tolist():
        others = np.flatnonzero(vehicles & (drive.scene == drive.scene[cyclist]))
        pose = drive.pose[:, cyclist].astype(np.float64)
        offset = drive.pose[:, others, :2] - pose[:, None, :2]
        cosine, sine = np.cos(pose[:, 2]), np.sin(pose[:, 2])
        ahead = offset[..., 0] * cosine[:, None] + offset[..., 1] * sine[:, None]
        aside = offset[..., 1] * cosine[:, None] - offset[..., 0] * sine[:, None]
        gap = np.abs(aside) - 0.5 * (drive.size[others, 1] + drive.size[cyclist, 1])
        abreast = np.abs(ahead) < 0.5 * (drive.size[others, 0] + drive.size[cyclist, 0])
        abreast &= np.cos(drive.pose[:, others, 2] - pose[:, None, 2]) > ABREAST
        abreast &= (gap < BESIDE) & drive.present[:, others] & drive.present[:, cyclist, None]
        for column in range(len(others)):
            edges = np.flatnonzero(np.diff(abreast[:, column].astype(np.int8), prepend=0, append=0))
            for first, after in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
                if first > 0 and after < len(gap) and ahead[first, column] * ahead[after - 1, column] < 0.0:
                    yield float(gap[first:after, column].min())


def walker_encroachments(drive: WalkRecord, graph: LaneGraph) -> Any:
    """Return the post-encroachment times of walkers on crossings and vehicles, s."""
    crossings = sidewalk_network(graph).crossings
    if not crossings:
        return np.zeros(0)
    tree = cKDTree(np.array([crossing.xy.mean(axis=0) for crossing in crossings]))
    near = np.isfinite(tree.query(drive.pose[..., :2], distance_upper_bound=NEAR)[0])
    walkers = drive.kind == AgentKind.WALKER
    on_road = (drive.status == WalkStatus.CROSSING) & walkers
    counted = drive.present & (on_road | (near & is_vehicle(drive.kind)))
    stays = visits(drive.pose.astype(np.float64), drive.size[:, 0].astype(np.float64), drive.scene, counted)
    return post_encroachment_times(stays, drive.dt, apart=walkers)


def measure_walkers(drive: WalkRecord, graph: LaneGraph) -> dict[str, dict[str, Any]]:
    """Return the statistics of walkers and cyclists: samples by name, and counts."""
    walkers, cyclists = drive.kind == AgentKind.WALKER, drive.kind == AgentKind.BICYCLE
    done = (drive.stage[1:] > drive.stage[:-1]) & walkers
    waited, yielded = drive.waited[:-1][done], drive.yielded[:-1][done]
    on_road = (drive.status == WalkStatus.CROSSING) & walkers & (drive.speed > 0.1)
    cycling = drive.present & cyclists
    free = cycling & (np.abs(drive.acceleration) < 0.1) & (drive.speed > 1.0)
    starting = cycling & (drive.acceleration > 0.1) & (drive.speed > 0.5) & (drive.speed < 2.5)
    return {
        "samples": {
            "kerb wait": waited[waited > WAITED],
            "walker speed": drive.speed[on_road][::10],
            "walker PET": walker_encroachments(drive, graph),
            "cycling speed": drive.speed[free][::20],
            "cycling start": drive.acceleration[starting][::10],
            "passing distance": np.array(list(passing_distances(drive))),
        },
        "counts": {
            "walker hours": float(drive.present[:, walkers].sum()) * drive.dt / 3600.0,
            "cyclist hours": float(cycling.sum()) * drive.dt / 3600.0,
            "crossings": float(done.sum()),
            "crossings with a wait": float((waited > WAITED).sum()),
            "crossings with a yield": float((yielded > 0).sum()),
        },
    }


def walker_rates(counts: dict[str, float]) -> dict[str, float]:
    """Return the rates of a town from its counts; NaN where there is nothing to divide by."""

    def ratio(part: str, whole: float) -> float:
        return counts[part] / whole if whole > 0.0 else float("nan")

    hundred_hours = counts["hours"] / 100.0
    return {
        "crossings": ratio("crossings", counts["walker hours"]),
        "waits": ratio("crossings with a wait", counts["crossings"]),
        "yields": ratio("crossings with a yield", counts["crossings"]),
        "walker contacts": ratio("walker contacts", hundred_hours),
        "cyclist contacts": ratio("cyclist contacts", hundred_hours),
    }
