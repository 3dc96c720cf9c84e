"""Kind `how-often`: how often a driving system fails where traffic has chance in it, by several estimators."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from ssad.bench.kind import Cell, Column, Job, Kind, Names, Plan, Replay, Resources, SuiteBase
from ssad.bench.kinds.driving import DrivingSuite, suite_scenarios
from ssad.core import safeio
from ssad.core.errors import ConfigError
from ssad.core.lane_graph import save_graph, town_file
from ssad.core.safeio import plain
from ssad.core.seeding import generator, seed32
from ssad.core.traces import first_difference, load_trace, save_trace
from ssad.core.types import EpisodeTrace
from ssad.jobs.machine import quiet_warp
from ssad.recording.closed_loop import scenario_json, system_of, system_version, town, town_version, type_version

Method = Literal["monte-carlo", "splitting", "importance"]


class NoiseSuite(BaseModel):
    """The chance in traffic: `ssad.world.noise.Noise`, in its own words."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)

    accel: float = Field(default=0.0, ge=0.0, le=10.0)
    accel_time: float = Field(default=1.0, gt=0.0)
    lapse: float = Field(default=0.0, ge=0.0, le=0.5)
    careless: float = Field(default=0.0, ge=0.0, le=0.5)
    choice_time: float = Field(default=1.0, gt=0.0)


class HowOftenSuite(SuiteBase):
    """Failure probabilities: scenarios x systems x methods.

    Attributes:
        systems: driving systems under test, such that remember nothing: the Autopilot, the blind one, learned policies.
        scenarios: as in a driving suite.
        noise: the chance in traffic.
        methods: estimators; each gets cells of its own.
        episodes: of Monte Carlo, and of importance sampling after it has learned.
        particles: of each repeat of splitting, and of the splitting that a proposal is first learned from.
        repeats: of splitting, independent of each other; at least 8 for an interval.
        components: of the learned proposal.
        batch: episodes side by side.
    """

    kind: Literal["how-often"] = "how-often"
    systems: Names
    scenarios: Names
    noise: NoiseSuite = NoiseSuite()
    methods: list[Method] = Field(default=["monte-carlo", "splitting", "importance"], min_length=1)
    episodes: int = Field(default=4000, ge=10)
    particles: int = Field(default=200, ge=10, le=100_000)
    repeats: int = Field(default=10, ge=1, le=1000)
    components: int = Field(default=2, ge=1, le=20)
    batch: int = Field(default=500, ge=1, le=1 << 21)

    def beside(self, path: Path) -> Self:
        """Scenario files are looked for in the working folder, then beside the suite."""
        return self.model_copy(update={"scenarios": self._driving().beside(path).scenarios})

    def _driving(self) -> DrivingSuite:
        return DrivingSuite(name=self.name, systems=self.systems, scenarios=self.scenarios)


class HowOften(Kind):
    """See the module."""

    name = "how-often"
    suite = HowOftenSuite
    factors = ("system", "group", "method")
    columns = (
        Column("per_million", "collisions in a million episodes", "", "lower"),
        Column("low", "lower 95 % limit"),
        Column("high", "upper 95 % limit"),
        Column("effective", "effective number of collisions", "", "higher"),
        Column("events", "collisions simulated"),
        Column("episodes", "episodes"),
        Column("work", "million agent-steps"),
        Column("training", "of these for learning"),
        Column("hours", "simulated", "h"),
        Column("km", "simulated", "km"),
        Column("per_hour", "collisions in 1,000 h", "", "lower"),
        Column("per_km", "collisions in 1,000 km", "", "lower"),
    )

    def plan(self, suite: HowOftenSuite, *, device: str = "cpu", check: bool = True) -> Plan:
        """Systems, scenarios and towns are looked up; with `check`, each is tried once."""
        systems = {name: system_version(name) for name in suite.systems}
        scenarios = suite_scenarios(suite._driving())
        towns = {name: town_version(town(name)) for name in sorted({s.town for s in scenarios})}
        cells = []
        for system in suite.systems:
            for scenario in scenarios:
                for method in suite.methods:
                    data = scenario_json(scenario)
                    seed = seed32("how often", suite.seed, safeio.dump_json(data), method)
                    spec = {
                        "scenario": data, "system": system, "method": method, "noise": suite.noise.model_dump(),
                        "episodes": suite.episodes, "particles": suite.particles, "repeats": suite.repeats,
                        "components": suite.components, "batch": suite.batch,
                    }  # fmt: skip
                    group = scenario.group or scenario.type
                    fields = {"system": system, "group": group, "method": method, "cluster": scenario.name}
                    versions = systems[system], towns[scenario.town], type_version(scenario.type)
                    name = f"{method}/{system}/{scenario.name}"
                    cells.append(self.make_cell(name, system, seed, fields, spec, *versions))
        if check:
            for cell in cells:
                process_of(cell, 1, device)
        return Plan(self, suite, device, tuple(cells), {"towns": towns, "systems": systems})

    def prepare(self, plan: Plan, folder: Path, resources: Resources, *, retry: Sequence[Cell] = ()) -> dict[str, Any]:
        """Copies of the towns lie beside the results."""
        for name in plan.inputs["towns"]:
            path = folder / "towns" / town_file(name)
            if not path.exists():
                save_graph(town(name), path)
        safeio.make_folder(folder / "traces")
        return {}

    def execute(self, cells: Sequence[Cell], job: Job) -> dict[str, dict[str, Any]]:
        """Estimates one cell's probability; keeps the likeliest collision it has found."""
        quiet_warp()
        return {cell.key: self._estimate(cell, job) for cell in cells}

    def _estimate(self, cell: Cell, job: Job) -> dict[str, Any]:
        from ssad.world.rare.brute import monte_carlo
        from ssad.world.rare.importance import importance, learn
        from ssad.world.rare.splitting import keys_of, splitting

        spec, random = cell.spec, generator("how often", cell.seed)
        crash: dict[str, Any] | None = None
        if spec["method"] == "splitting":
            process = process_of(cell, spec["particles"] * spec["repeats"], job.device)
            branched = splitting(process, random, repeats=spec["repeats"])
            found = branched.estimate()
            if branched.failed.any():
                row = int(np.flatnonzero(branched.failed)[0])
                crash = {"keys": {str(step): str(key) for step, key in keys_of(branched, row).items()}, "means": []}
        elif spec["method"] == "importance":
            process = process_of(cell, spec["particles"], job.device)
            proposal = learn(process, random, components=spec["components"], episodes=spec["episodes"] // 4)
            training = process.work()
            process = process_of(cell, spec["batch"], job.device)
            found, drawn = importance(process, proposal, random, episodes=spec["episodes"], training=training)
            if drawn.failed.any():
                row = int(np.argmax(np.where(drawn.failed, drawn.weight, 0.0)))
                part = int(drawn.component[row])
                means = proposal.means[part - 1].tolist() if part else []
                crash = {"keys": {"0": str(int(drawn.keys[row]))}, "means": means}
        else:
            process = process_of(cell, spec["batch"], job.device)
            *_, (found, keys) = monte_carlo(process, random, episodes=spec["episodes"])
            if len(keys):
                crash = {"keys": {"0": str(int(keys[0]))}, "means": []}
        hours, km = usual_episode(cell, job.device)
        agents = process.world.agents
        driven = found.work * process.world.dt / 3600.0 / agents
        metrics = {
            "per_million": 1e6 * found.probability, "low": 1e6 * found.low, "high": 1e6 * found.high,
            "effective": found.effective, "events": found.events, "episodes": found.episodes,
            "work": found.work / 1e6, "training": found.training / 1e6, "hours": driven, "km": driven * km / hours,
            "per_hour": 1e3 * found.probability / hours, "per_km": 1e3 * found.probability / km,
        }  # fmt: skip
        result: dict[str, Any] = {"metrics": plain(metrics), "case": cell.key, "n": found.episodes}
        if crash is not None:
            artefact = f"traces/{cell.key}.npz"
            save_trace(job.folder / artefact, run_again(cell, crash, job.device))
            result |= {"crash": crash, "artefacts": {"trace": artefact}}
        return result

    def replay(self, plan: Plan, cell: Cell, record: Mapping[str, Any], folder: Path) -> Replay:
        """Drives the collision that was kept again and compares every bit of its trace."""
        if "crash" not in record:
            raise ConfigError(f"{folder}: cell {cell.key} ({cell.name}) has found no collision to replay")
        quiet_warp()
        trace = run_again(cell, record["crash"], plan.device)
        recorded = load_trace(folder / record["artefacts"]["trace"])
        return Replay(cell, first_difference(recorded, trace), trace, town(trace.town))


def process_of(cell: Cell, rows: int, device: str) -> Any:
    """Rows of a cell's scenario with its driver and its noise.

    Raises:
        ConfigError: The driver remembers something, or the scenario is not one of the embedded world.
    """
    from ssad.world.rare.process import WorldProcess
    from ssad.world.rollout import Loop

    return WorldProcess(Loop(world_of(cell, rows, device, {}, []), {0: system_of(cell.system)}))


def world_of(cell: Cell, rows: int, device: str, keys: Mapping[int, int], means: Sequence[float]) -> Any:
    """A world of a cell's scenario; with keys, its futures are those."""
    from ssad.scenarios.dynamic import build_episode, scenario_from
    from ssad.world.noise import Noise
    from ssad.world.rare.process import Told
    from ssad.world.world import World

    scenario = scenario_from(cell.spec["scenario"])
    graph = town(scenario.town)
    episode = build_episode(scenario, graph, seed=scenario.seed)
    noise = Noise(**cell.spec["noise"], stretches=9)
    order = np.zeros(rows, np.int64)
    if keys:
        return Told([episode], {graph.name: graph}, keys=keys, means=means, device=device, noise=noise)
    return World([episode], {graph.name: graph}, assign=order, device=device, noise=noise)


def run_again(cell: Cell, crash: Mapping[str, Any], device: str) -> EpisodeTrace:
    """The trace of an episode by its keys from each step on, and by how means were moved."""
    from ssad.world.rollout import rollout

    keys = {int(step): int(key) for step, key in crash["keys"].items()}
    (trace,) = rollout(world_of(cell, 1, device, keys, crash["means"]), system_of(cell.system))
    return trace


def usual_episode(cell: Cell, device: str, rows: int = 200) -> tuple[float, float]:
    """How long an episode takes on average, h, and how far the ego gets, km."""
    from ssad.world.rare.brute import draw_keys, run

    process = process_of(cell, rows, device)
    process.reset(draw_keys(generator("how often", cell.seed, "usual"), rows))
    run(process)
    world = process.world
    hours = float(world.array("step").mean()) * world.dt / 3600.0
    return hours, float(world.array("ego.driven").mean()) / 1000.0
