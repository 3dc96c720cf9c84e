"""Kind `driving`: driving systems x scenarios x repetitions in the embedded world; an episode a cell.

It also has what other kinds that drive scenarios need.
"""

from __future__ import annotations

import time
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import Field

from ssad.bench.kind import Cell, Column, Job, Kind, Names, Plan, Replay, Resources, SuiteBase, check_distinct
from ssad.core import safeio
from ssad.core.errors import ConfigError, SSADError, UnknownNameError
from ssad.core.lane_graph import SignKind, save_graph, town_file
from ssad.core.safeio import plain
from ssad.core.seeding import seed32
from ssad.core.traces import first_difference, load_trace, motion_hash, save_trace, trace_hash
from ssad.core.types import Episode, EpisodeTrace, Scenario
from ssad.jobs.machine import quiet_warp
from ssad.metrics import METRICS, episode_metrics
from ssad.recording.closed_loop import (
    HIGHWAY,
    HIGHWAY_TYPE,
    drive,
    embedded,
    episode_of,
    grade_of,
    in_highway,
    load_world,
    policies_of,
    scenario_json,
    system_version,
    town,
    town_version,
    type_version,
)

EMBEDDED = "embedded"  # the name of SSAD's own world as a simulator


class ScenarioSuite(SuiteBase):
    """What suites say that drive scenarios.

    Attributes:
        scenarios: what `load_scenarios` understands (sets, types, names, YAML files), or highway-env: that simulator's
            intersection and highway.
    """

    scenarios: Names

    def beside(self, path: Path) -> Self:
        """Scenario files are looked for in the working folder, then beside the suite."""

        def find(ref: str) -> str:
            near = path.parent / ref
            return str(near) if ref.endswith((".yaml", ".yml")) and not Path(ref).exists() and near.exists() else ref

        return self.model_copy(update={"scenarios": [find(ref) for ref in self.scenarios]})


@dataclass(frozen=True, slots=True)
class Described:
    """A scenario of a suite, as plain data, with the versions of its town, its type and its actors' drivers."""

    scenario: Scenario
    data: dict[str, Any]
    versions: tuple[str, ...]


class ScenarioKind(Kind):
    """Cells are scenarios that a system drives."""

    def scenario_cell(
        self,
        suite: ScenarioSuite,
        one: Described,
        *inputs: object,
        title: str,
        system: str,
        chance: tuple[object, ...],
        fields: Mapping[str, Any] | None = None,
        **spec: Any,
    ) -> Cell:
        """A cell in which a system meets a scenario.

        Args:
            suite: Of the cell.
            one: The scenario.
            inputs: What the result depends on besides the scenario and the cell's own description.
            title: Name of the cell.
            system: Name of the system.
            chance: What tells apart cells of a scenario that shall not meet the same chance.
            fields: Columns of the record besides system, group and cluster.
            spec: What a worker needs besides scenario and system.
        """
        kind, *others = chance
        seed = seed32(kind, suite.seed, safeio.dump_json(one.data), *others)
        scenario = one.scenario
        about = {"system": system, "group": scenario.group or scenario.type, "cluster": scenario.name}
        told = {"scenario": one.data, "system": system, **spec}
        return self.make_cell(title, system, seed, {**about, **(fields or {})}, told, *one.versions, *inputs)

    def prepare(self, plan: Plan, folder: Path, resources: Resources, *, retry: Sequence[Cell] = ()) -> dict[str, Any]:
        """Copies of the towns lie beside the results, so that a report can be made where they are not imported."""
        for name in plan.inputs["towns"]:
            path = folder / "towns" / town_file(name)
            if not path.exists():
                save_graph(town(name), path)
        safeio.make_folder(folder / "traces")
        return {}

    def start(self, job: Job) -> None:
        """Loads the world's kernels, which are compiled on first use."""
        load_world(job.device)

    def drive_again(self, plan: Plan, cell: Cell, record: Mapping[str, Any]) -> EpisodeTrace:
        """The drive of a record, once more. ConfigError: the kind's cells cannot be replayed."""
        raise ConfigError(f"{cell.name}: cells of kind '{self.name}' cannot be replayed")

    def replay(self, plan: Plan, cell: Cell, record: Mapping[str, Any], folder: Path) -> Replay:
        """Drives the episode again and compares every bit of its trace."""
        quiet_warp()
        trace = self.drive_again(plan, cell, record)
        recorded = load_trace(folder / record["artefacts"]["trace"])
        return Replay(cell, first_difference(recorded, trace), trace, town(trace.town))


class DrivingSuite(ScenarioSuite):
    """One table: systems x scenarios x repetitions.

    Attributes:
        systems: names, or module:object; arguments and a label may follow, as in mine:Mine?checkpoint=a.pt@first.
        simulator: embedded, SSAD's own world; or carla://HOST:PORT, a CARLA server (docs/carla.md).
        repetitions: episodes of each pair; the first is the nominal case.
        spread: how far the other repetitions are drawn around it, 1 being the natural spread (docs/scenarios.md); 0:
            not at all, then scenarios without traffic of their own give copies, which count once.
        witness: grade each collision: which careful drivers avoid it, and could anybody (docs/careful.md).
        pictures: what the report shows besides (shifts: contact sheets of the distribution shifts; camera: what the
            camera sees).
    """

    kind: Literal["driving"] = "driving"
    systems: Names
    simulator: str = EMBEDDED
    repetitions: int = Field(default=1, ge=1, le=100_000)
    spread: float = Field(default=1.0, ge=0, le=10, allow_inf_nan=False)
    timeout_s: float = Field(default=120.0, gt=0, allow_inf_nan=False)
    chunk: int = Field(default=16, ge=1, le=4096)
    witness: bool = True
    pictures: list[Literal["shifts", "camera"]] = Field(default=[])


class Driving(ScenarioKind):
    """See the module."""

    name = "driving"
    suite = DrivingSuite
    columns = tuple(Column(m.symbol, m.title, m.unit, m.better) for m in METRICS.values() if m.field)
    factors = ("system", "group")

    def plan(self, suite: DrivingSuite, *, device: str = "cpu", check: bool = True) -> Plan:
        """Systems, scenarios and towns are looked up; with `check`, each scenario is built once."""
        check_distinct(suite, "systems", suite.systems)
        systems = {name: system_version(name) for name in suite.systems}
        scenarios, towns = described(suite)
        away: dict[str, Any] = {} if suite.simulator == EMBEDDED else {"simulator": suite.simulator}
        if away:
            from ssad.interchange.carla_server import Server, probe

            server = Server.of(suite.simulator)
            if any(one.scenario.type == HIGHWAY_TYPE for one in scenarios):
                raise ConfigError(f"suite {suite.name}: scenarios of highway-env do not run in {server}")
            if check:
                probe(server)
        # the seed does not depend on the system: systems meet the same episodes
        cells = tuple(
            self.scenario_cell(
                suite,
                one,
                systems[system],
                system=system,
                chance=("episode", repetition),
                title=f"{system}/{one.scenario.name}{f'#{repetition}' if repetition else ''}",
                repetition=repetition,
                spread=suite.spread if repetition else 0.0,
                **away,
            )
            for system in suite.systems
            for one in scenarios
            for repetition in range(suite.repetitions)
        )
        if check:
            for cell in cells[: len(scenarios) * suite.repetitions : suite.repetitions]:
                _check(cell)
        return Plan(self, suite, device, cells, {"towns": towns, "systems": systems})

    def prepare(self, plan: Plan, folder: Path, resources: Resources, *, retry: Sequence[Cell] = ()) -> dict[str, Any]:
        """See `ScenarioKind`. ConfigError: a CARLA server on a cluster."""
        super().prepare(plan, folder, resources)
        if resources.ray and plan.suite.simulator != EMBEDDED:
            raise ConfigError(f"suite {plan.suite.name}: one worker drives {plan.suite.simulator}; leave out --ray")
        return {"witness": plan.suite.witness}

    def workers(self, plan: Plan, asked: int | None) -> int | None:
        """A CARLA server runs one world: one worker drives it."""
        return asked if asked == 0 or plan.suite.simulator == EMBEDDED else 1

    def alike(self, cell: Cell) -> Hashable:
        """Cells of a system in one simulator; CARLA drives one at a time."""
        return cell.key if "simulator" in cell.spec else (cell.system, in_highway(cell))

    def execute(self, cells: Sequence[Cell], job: Job) -> dict[str, dict[str, Any]]:
        """Drives the episodes as one batch of the world, measures them, writes their traces."""
        began = time.perf_counter()
        episodes, traces, measured = drive(cells, device=job.device)
        shared = (time.perf_counter() - began) / len(cells)
        results: dict[str, dict[str, Any]] = {}
        for cell, episode, trace in zip(cells, episodes, traces, strict=True):
            began = time.perf_counter()
            result = drive_record(cell, episode, trace, job.folder)
            if measured:
                result["metrics"]["lane_crossings"] = measured["lane_crossings"]
                result["measured"] = plain(measured)
            if job.settings["witness"] and trace.end == "collision" and embedded(cell):
                found = grade_of(episode, trace, job.device)
                result["metrics"] |= found.metrics()
                result["witness"] = plain(found.as_dict())
            results[cell.key] = result | {"wall_s": shared + time.perf_counter() - began}
        return results

    def drive_again(self, plan: Plan, cell: Cell, record: Mapping[str, Any]) -> EpisodeTrace:
        """See `ScenarioKind`."""
        _, (trace,), _ = drive([cell], device=plan.device)
        return trace

    def finish(self, plan: Plan, folder: Path) -> None:
        """The pictures that the suite asks for, made once beside its results."""
        from ssad.recording.run_pictures import write_pictures

        write_pictures(plan.suite.pictures, folder)


def drive_record(cell: Cell, episode: Episode, trace: EpisodeTrace, folder: Path) -> dict[str, Any]:
    """What a drive gives as the result of its cell; the trace is written."""
    artefact = f"traces/{cell.key}.npz"
    save_trace(folder / artefact, trace)
    signs = bool((town(trace.town).sign_kind == SignKind.STOP).any())
    metrics = plain(episode_metrics(trace, stop_signs=signs).as_dict())
    about = {"scenario": episode.scenario.name, "repetition": cell.spec["repetition"], "town": trace.town}
    about |= {"end": trace.end, "trace_hash": trace_hash(trace), "trace": artefact, "metrics": metrics}
    return {"metrics": metrics, "artefacts": {"trace": artefact}, "episode": about, "case": motion_hash(trace)}


def described(suite: ScenarioSuite) -> tuple[list[Described], dict[str, str]]:
    """All scenarios of a suite, in order, and the versions of their towns.

    Raises:
        ConfigError: There are no such scenarios, or two differ but share a name.
    """
    scenarios = suite_scenarios(suite)
    towns = {name: town_version(town(name)) for name in sorted({one.town for one in scenarios})}
    found = []
    for one in scenarios:
        policies = [system_version(name) for name in policies_of(one)]
        found.append(Described(one, scenario_json(one), (towns[one.town], type_version(one.type), *policies)))
    return found, towns


def suite_scenarios(suite: ScenarioSuite) -> tuple[Scenario, ...]:
    """All scenarios of a suite, in order, each once. ConfigError when two differ but share a name."""
    from ssad.interchange.highway_env import highway_scenarios
    from ssad.scenarios.dynamic import load_scenarios

    found: dict[str, Scenario] = {}
    for ref in suite.scenarios:
        try:
            loaded = highway_scenarios() if ref == HIGHWAY else load_scenarios(ref)
        except UnknownNameError as error:
            raise UnknownNameError(f"suite {suite.name}: {error}") from None
        for scenario in loaded:
            if found.setdefault(scenario.name, scenario) != scenario:
                raise ConfigError(
                    f"suite {suite.name}: two different scenarios are named '{scenario.name}' (one from {ref}); "
                    "rename one"
                )
    return tuple(found.values())


def _check(cell: Cell) -> None:
    try:
        episode_of(cell)
    except SSADError as error:
        name = f"scenario {cell.spec['scenario']['name']}"
        raise type(error)(str(error) if name in str(error) else f"{name}: {error}") from None
