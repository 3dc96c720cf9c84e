"""Base of the kinds that drive scenarios: suites, cells, towns, records and replay of drives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self

from ssad.core import safeio
from ssad.core.errors import ConfigError, UnknownNameError
from ssad.core.folders import path_inside
from ssad.core.lane_graph import SignKind, save_graph, town_file
from ssad.core.machine import start_warp_quietly
from ssad.core.safeio import to_plain_json
from ssad.core.seeding import digest, seed32
from ssad.core.traces import first_difference, load_trace, motion_hash, save_trace, trace_hash
from ssad.core.types import Episode, EpisodeTrace, Scenario
from ssad.engine.kind import Cell, Job, Kind, Names, Plan, Replay, Resources, SuiteBase
from ssad.metrics import episode_metrics
from ssad.simulators.closed_loop import (
    HIGHWAY,
    cached_town,
    load_kernels,
    policies_of,
    scenario_json,
    system_version,
    town_version,
    type_version,
)


class ScenarioSuite(SuiteBase):
    """Keys of suites that drive scenarios.

    Attributes:
        scenarios: Arguments of `load_scenarios` (sets, classes, module:object, names, YAML files), or highway-env:
            that simulator's intersection and highway.
        cluster: What is drawn independently of one another, for the intervals: towns' routes, each of which may have
            several scenarios, or scenarios.
    """

    scenarios: Names
    cluster: Literal["route", "scenario"] = "route"

    def beside(self, path: Path) -> Self:
        """Return the suite with its scenario files resolved: in the working folder, then beside the suite."""

        def find(reference: str) -> str:
            sibling = path.parent / reference
            return (
                str(sibling)
                if reference.endswith((".yaml", ".yml")) and not Path(reference).exists() and sibling.exists()
                else reference
            )

        return self.model_copy(update={"scenarios": [find(ref) for ref in self.scenarios]})


def route_key(scenario: Scenario) -> str:
    """Return a key of the town and the route of a scenario; scenarios with the same key points share it."""
    points = [(round(float(pose.x), 2) + 0.0, round(float(pose.y), 2) + 0.0) for pose in scenario.route]  # no -0.0
    return f"{scenario.town} {digest('route', scenario.town, points)[:8]}"


@dataclass(frozen=True, slots=True)
class DescribedScenario:
    """A scenario of a suite, as plain data, with the versions of its town, its type and its actors' drivers."""

    scenario: Scenario
    data: dict[str, Any]
    versions: tuple[str, ...]


class ScenarioKind(Kind):
    """Kind whose cells are scenarios that a system drives."""

    def scenario_cell(
        self,
        suite: ScenarioSuite,
        described_scenario: DescribedScenario,
        *inputs: object,
        title: str,
        system: str,
        chance: tuple[object, ...],
        fields: Mapping[str, Any] | None = None,
        **spec: Any,
    ) -> Cell:
        """Return a cell in which a system meets a scenario.

        Args:
            suite: Suite of the cell.
            described_scenario: The scenario.
            inputs: Inputs of the result besides the scenario and the cell's own description.
            title: Name of the cell.
            system: Name of the system.
            chance: Parts of the seed: cells of a scenario with equal parts have equal random numbers.
            fields: Columns of the record besides system, group and cluster.
            spec: Data for the worker besides scenario and system.
        """
        kind, *seed_parts = chance
        seed = seed32(kind, suite.seed, safeio.dump_json(described_scenario.data), *seed_parts)
        scenario = described_scenario.scenario
        cluster = scenario.name if suite.cluster == "scenario" else route_key(scenario)
        identification = {"system": system, "group": scenario.group or scenario.type, "cluster": cluster}
        cell_spec = {"scenario": described_scenario.data, "system": system, **spec}
        return self.make_cell(
            title, system, seed, {**identification, **(fields or {})}, cell_spec, *described_scenario.versions, *inputs
        )

    def prepare(self, plan: Plan, folder: Path, resources: Resources, *, retry: Sequence[Cell] = ()) -> dict[str, Any]:
        """Store copies of the towns beside the results, so that a report can be made where they are not imported."""
        for name in plan.inputs["towns"]:
            path = folder / "towns" / town_file(name)
            if not path.exists():
                save_graph(cached_town(name), path)
        safeio.make_folder(folder / "traces")
        return {}

    def start(self, job: Job) -> None:
        """Load the world's kernels, which are compiled on first use."""
        load_kernels(job.device)

    def drive_again(self, plan: Plan, cell: Cell, record: Mapping[str, Any]) -> EpisodeTrace:
        """Drive the cell of a record again and return its trace.

        Raises:
            ConfigError: The kind's cells cannot be replayed.
        """
        raise ConfigError(f"{cell.name}: cells of kind '{self.name}' cannot be replayed")

    def replay(self, plan: Plan, cell: Cell, record: Mapping[str, Any], folder: Path) -> Replay:
        """Drive the episode again and compare every bit of its trace."""
        start_warp_quietly()
        trace = self.drive_again(plan, cell, record)
        recorded = load_trace(path_inside(folder, record["artefacts"]["trace"]))
        return Replay(cell, first_difference(recorded, trace), trace, cached_town(trace.town))


def drive_record(cell: Cell, episode: Episode, trace: EpisodeTrace, folder: Path) -> dict[str, Any]:
    """Return the result of a cell from its drive, and write the trace."""
    artefact = f"traces/{cell.key}.npz"
    save_trace(folder / artefact, trace)
    has_stop_signs = bool((cached_town(trace.town).sign_kind == SignKind.STOP).any())
    metrics = to_plain_json(episode_metrics(trace, stop_signs=has_stop_signs).as_dict())
    episode_fields = {"scenario": episode.scenario.name, "repetition": cell.spec["repetition"], "town": trace.town}
    episode_fields |= {"end": trace.end, "trace_hash": trace_hash(trace), "trace": artefact, "metrics": metrics}
    return {"metrics": metrics, "artefacts": {"trace": artefact}, "episode": episode_fields, "case": motion_hash(trace)}


def describe_scenarios(suite: ScenarioSuite) -> tuple[list[DescribedScenario], dict[str, str]]:
    """Return all scenarios of a suite, in order, and the versions of their towns.

    Raises:
        ConfigError: There are no such scenarios, or two differ but share a name.
    """
    scenarios = suite_scenarios(suite)
    towns = {name: town_version(cached_town(name)) for name in sorted({scenario.town for scenario in scenarios})}
    entries = []
    for scenario in scenarios:
        policies = [system_version(name) for name in policies_of(scenario)]
        entries.append(
            DescribedScenario(
                scenario, scenario_json(scenario), (towns[scenario.town], type_version(scenario.type), *policies)
            )
        )
    return entries, towns


def suite_scenarios(suite: ScenarioSuite) -> tuple[Scenario, ...]:
    """Return all scenarios of a suite, in order, each once.

    Raises:
        ConfigError: Two differ but share a name.
    """
    from ssad.scenarios.dynamic import load_scenarios
    from ssad.simulators.highway_env import highway_scenarios

    scenarios_by_name: dict[str, Scenario] = {}
    for reference in suite.scenarios:
        try:
            scenarios = highway_scenarios() if reference == HIGHWAY else load_scenarios(reference)
        except UnknownNameError as error:
            raise UnknownNameError(f"suite {suite.name}: {error}") from None
        for scenario in scenarios:
            if scenarios_by_name.setdefault(scenario.name, scenario) != scenario:
                raise ConfigError(
                    f"suite {suite.name}: two different scenarios are named '{scenario.name}' (one from {reference}); "
                    "rename one"
                )
    return tuple(scenarios_by_name.values())
