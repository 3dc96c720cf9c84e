"""What a worker process does with a chunk of cells: build the episodes, drive them as one batch, measure."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ssad.core import safeio
from ssad.core.traces import save_trace, trace_hash
from ssad.core.types import Episode, EpisodeTrace
from ssad.jobs.machine import quiet_warp

if TYPE_CHECKING:
    from ssad.core.protocols import DrivingSystem
    from ssad.roads import LaneGraph


@lru_cache(maxsize=8)
def town(name: str) -> LaneGraph:
    """A town, read once a process."""
    from ssad.roads import load_town

    return load_town(name)


@lru_cache(maxsize=4)
def _system(name: str) -> DrivingSystem:
    from ssad.drivers import make_system

    return make_system(name)


def warm_up(settings: Mapping[str, Any]) -> None:
    """Load the world's kernels (compiled on first use), so that no cell's time-out pays for it."""
    import warp

    import ssad.world.rollout  # noqa: F401  its kernels are what is loaded

    quiet_warp()
    warp.force_load(device=settings["device"])


def episode_of(cell: Mapping[str, Any]) -> Episode:
    """The concrete episode of a cell. RouteError, MapError or ConfigError when it cannot be built."""
    from ssad.scenarios.dynamic import build_episode, scenario_from

    scenario = scenario_from(cell["scenario"])
    return replace(build_episode(scenario, town(scenario.town), seed=cell["seed"]), key=cell["key"])


def drive(cells: Sequence[Mapping[str, Any]], *, device: str) -> tuple[list[Episode], list[EpisodeTrace]]:
    """Episodes and traces of cells that share a system, run as one batch."""
    from ssad.world.rollout import rollout

    episodes = [episode_of(cell) for cell in cells]
    graphs = {episode.town: town(episode.town) for episode in episodes}
    return episodes, rollout(episodes, graphs, _system(cells[0]["system"]), device=device)


def execute(cells: Sequence[Mapping[str, Any]], settings: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Results of a chunk of cells, in order; the traces are on disk when this returns.

    settings: folder (of the run), device, witness (search collisions for a way out). What goes wrong raises.
    """
    from ssad.metrics import episode_metrics

    began = time.perf_counter()
    folder = Path(settings["folder"])
    episodes, traces = drive(cells, device=settings["device"])
    shared = (time.perf_counter() - began) / len(cells)
    results = []
    for cell, episode, trace in zip(cells, episodes, traces, strict=True):
        began = time.perf_counter()
        artefact = f"traces/{cell['key']}.npz"
        save_trace(folder / artefact, trace)
        result = {
            "key": cell["key"],
            "metrics": plain(episode_metrics(trace).as_dict()),
            "n": 1,
            "end": trace.end,
            "town": trace.town,
            "trace_hash": trace_hash(trace),
            "artefacts": {"trace": artefact},
        }
        if settings.get("witness") and trace.end == "collision":
            speed = getattr(_system(cell["system"]), "target_speed", None)
            result["witness"] = witness(folder, episode, speed, settings["device"])
        results.append(result | {"wall_s": round(shared + time.perf_counter() - began, 4)})
    return results


def witness(folder: Path, episode: Episode, speed: float | None, device: str) -> dict[str, Any]:
    """Could anybody have avoided the collision, coming at the speed (m/s) of the system that had it?

    Searched once for an episode and speed, whichever systems collide in it.
    """
    from ssad.core.seeding import digest
    from ssad.world.witness import find_witness

    if speed is not None:
        ego = replace(episode.agents[0], target_speed=speed)
        episode = replace(episode, agents=(ego, *episode.agents[1:]))
    name = digest("witness", safeio.dump_json(_scenario(episode)), episode.seed, speed)[:16]
    path = folder / "witness" / f"{name}.json"
    if path.exists():
        found: dict[str, Any] = safeio.read_json(path)
        return found
    found = plain(find_witness(episode, town(episode.town), device=device).as_dict())
    safeio.write_atomic(path, safeio.dump_json(found) + "\n")
    return found


def _scenario(episode: Episode) -> dict[str, Any]:
    from ssad.bench.cells import scenario_json

    return scenario_json(episode.scenario)


def plain(value: Any) -> Any:
    """Plain JSON data; a number that is not finite (no such event) becomes None."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if hasattr(value, "item"):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
