"""Base of the kinds that drive scenarios: suites, cells, towns, records and replay of drives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from ssad.core import safeio
from ssad.core.errors import ConfigError, UnknownNameError
from ssad.core.lane_graph import SignKind, save_graph, town_file
from ssad.core.machine import quiet_warp
from ssad.core.safeio import plain
from ssad.core.seeding import seed32
from ssad.core.traces import first_difference, load_trace, motion_hash, save_trace, trace_hash
from ssad.core.types import Episode, EpisodeTrace, Scenario
from ssad.engine.kind import Cell, Job, Kind, Names, Plan, Replay, Resources, SuiteBase
from ssad.metrics import episode_metrics
from ssad.simulators.closed_loop import (
    HIGHWAY,
    load_world,
    policies_of,
    scenario_json,
    system_version,
    town,
    town_version,
    type_version,
)


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
    from ssad.scenarios.dynamic import load_scenarios
    from ssad.simulators.highway_env import highway_scenarios

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
