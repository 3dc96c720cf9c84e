"""Base of the kinds that drive scenarios: suites, cells, towns, records and replay of drives."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from ssad.core import safeio
from ssad.core.errors import ConfigError, UnknownNameError, unknown_name
from ssad.core.folders import path_inside
from ssad.core.lane_graph import SignKind, save_graph, town_file
from ssad.core.machine import start_warp_quietly
from ssad.core.safeio import to_plain_json
from ssad.core.schema import Schema
from ssad.core.seeding import digest, seed32
from ssad.core.traces import first_difference, load_trace, motion_hash, save_trace, trace_hash
from ssad.core.types import MOST_ERRORS, Episode, EpisodeTrace, Scenario
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

if TYPE_CHECKING:
    from ssad.scenarios.dynamic.parameters import GridPoint

DECLARED_GRID = "grid"
"""Entry of a sweep that stands for the grid which the scenario declares."""
SWEEP = "sweep."
"""Start of the names of the fields of cells and records that have the values of swept parameters."""


def _check_grid(entry: Any) -> Any:
    """Return an entry of a sweep. ValueError, for pydantic, if it is no grid."""
    from ssad.scenarios.dynamic.parameters import grid_values

    if entry != DECLARED_GRID:
        try:
            grid_values(entry)
        except ConfigError as error:
            raise ValueError(str(error)) from None
    return entry


class TrafficSuite(Schema):
    """Changes of the background traffic of scenarios; keys that are left out change nothing.

    Attributes:
        drivers: uniform, all vehicles with the Autopilot's parameters, or population, each with a driver drawn from
            published distributions (docs/explanation/traffic.md).
        errors: Errors of each driver of the population an hour.
        walkers: Number of walkers near the route.
        cyclists: Number of cyclists near the route.
    """

    drivers: Literal["uniform", "population"] | None = None
    errors: float | None = Field(default=None, ge=0.0, le=MOST_ERRORS, allow_inf_nan=False)
    walkers: int | None = Field(default=None, ge=0, le=40)
    cyclists: int | None = Field(default=None, ge=0, le=40)


class ScenarioSuite(SuiteBase):
    """Keys of suites that drive scenarios.

    Attributes:
        scenarios: Arguments of `load_scenarios` (sets, classes, module:object, names, YAML files), or highway-env:
            that simulator's intersection and highway.
        cluster: What is drawn independently of one another, for the intervals: towns' routes, each of which may have
            several scenarios, or scenarios.
        traffic: Changes of the background traffic of the scenarios that have some. Seeds stay the same, and with them
            the vehicles.
        sweep: Parameter of the scenarios -> its values: a list, {from: 0, to: 1, step: 0.25}, {from: 0, to: 1,
            count: 5}, or grid for those that the scenario declares. Each point of the grid is a scenario
            (docs/how-to/sweep-parameters.md).
        sweep_mode: Whether all combinations of the values are points (product), or the first values make the first
            point, the second ones the second, and so on (zip).
        matrix: Parameters in the rows and the columns of the matrix table; empty: the first two of the sweep that have
            several values.
        matrix_metric: Metric that it shows; empty: collisions.
    """

    scenarios: Names
    cluster: Literal["route", "scenario"] = "route"
    traffic: TrafficSuite = TrafficSuite()
    sweep: dict[str, Annotated[Any, AfterValidator(_check_grid)]] = Field(default={})
    sweep_mode: Literal["product", "zip"] = "product"
    matrix: Annotated[list[str], Field(max_length=2)] = Field(default=[])
    matrix_metric: str = ""

    @model_validator(mode="before")
    @classmethod
    def _choose_matrix(cls, data: Any) -> Any:
        """Fill in the default of `matrix`: records of a run keep the order of a list, not that of a mapping."""
        if not isinstance(data, dict) or data.get("matrix") or not isinstance(data.get("sweep"), dict):
            return data
        several = [name for name, entry in data["sweep"].items() if not (isinstance(entry, list) and len(entry) == 1)]
        return {**data, "matrix": (several or list(data["sweep"]))[:2]}

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
    """A scenario of a suite, as plain data, with the versions of its town, its type and its actors' drivers.

    Attributes:
        scenario: The scenario.
        data: Its plain data.
        versions: The versions.
        nominal: The scenario as it was loaded, which the suite's traffic and a sweep vary; its seed is theirs.
        point: Values of swept parameters.
    """

    scenario: Scenario
    data: dict[str, Any]
    versions: tuple[str, ...]
    nominal: Scenario
    point: Mapping[str, float]


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
        scenario, nominal = described_scenario.scenario, described_scenario.nominal
        # All points of a grid have the seed and the cluster of the nominal scenario: they differ in what is swept, and
        # are no independent draws.
        seed_data = described_scenario.data if nominal is scenario else scenario_json(nominal)
        seed = seed32(kind, suite.seed, safeio.dump_json(seed_data), *seed_parts)
        cluster = nominal.name if suite.cluster == "scenario" else route_key(nominal)
        identification: dict[str, Any] = {
            "system": system,
            "group": scenario.group or scenario.type,
            "cluster": cluster,
        }
        if described_scenario.point:
            identification["swept"] = nominal.name
            identification |= {f"{SWEEP}{name}": value for name, value in described_scenario.point.items()}
        cell_spec = {"scenario": described_scenario.data, "system": system, **spec}
        return self.make_cell(
            title, system, seed, {**identification, **(fields or {})}, cell_spec, *described_scenario.versions, *inputs
        )

    def plan_lines(self, plan: Plan) -> list[str]:
        """Return the size of the sweep of a plan; without a sweep nothing."""
        suite = plan.suite
        if not suite.sweep:
            return []
        from ssad.scenarios.dynamic.parameters import grid_values

        points = {cell.spec["scenario"]["name"]: cell.fields for cell in plan.cells}
        scenario_count = len({fields["swept"] for fields in points.values()})
        sizes = {
            name: len({fields[f"{SWEEP}{name}"] for fields in points.values()})
            if entry == DECLARED_GRID
            else len(grid_values(entry))
            for name, entry in suite.sweep.items()
        }
        is_zip = suite.sweep_mode == "zip"
        total = scenario_count * (min(sizes.values()) if is_zip else math.prod(sizes.values()))
        size_text = (" with " if is_zip else " x ").join(f"{name} {size}" for name, size in sizes.items())
        scenario_text = "" if scenario_count == 1 else f" of {scenario_count} scenarios"
        # Grids that several scenarios declare may have different sizes.
        is_complete = DECLARED_GRID not in suite.sweep.values() and total > len(points)
        excluded_text = f"; {total - len(points)} more violate a constraint or are not selected" if is_complete else ""
        return [f"sweep: {len(points)} grid points{scenario_text} ({size_text} values){excluded_text}"]

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


def describe_scenarios(suite: ScenarioSuite, metrics: Iterable[str]) -> tuple[list[DescribedScenario], dict[str, str]]:
    """Return all scenarios of a suite, in order, and the versions of their towns.

    Args:
        suite: The suite.
        metrics: Metrics of the kind, which a matrix table can show.

    Raises:
        ConfigError: There are no such scenarios, or two differ but share a name.
    """
    for name in suite.matrix:
        if name not in suite.sweep:
            raise suite.error(
                ("matrix",), f"'{name}' is not swept; the sweep has: {', '.join(suite.sweep) or 'nothing'}"
            )
    if suite.matrix_metric and suite.matrix_metric not in metrics:
        raise suite.error(("matrix_metric",), str(unknown_name("metric", suite.matrix_metric, metrics)))
    nominal_scenarios = suite_scenarios(suite)
    varied = {scenario.name: with_suite_traffic(suite, scenario) for scenario in nominal_scenarios}
    if suite.traffic != TrafficSuite() and all(varied[scenario.name] is scenario for scenario in nominal_scenarios):
        raise suite.error(("traffic",), "none of the scenarios has background traffic to change")
    towns = {
        name: town_version(cached_town(name)) for name in sorted({scenario.town for scenario in nominal_scenarios})
    }
    entries = []
    for nominal in nominal_scenarios:
        policies = [system_version(name) for name in policies_of(nominal)]
        versions = (towns[nominal.town], type_version(nominal.type), *policies)
        changed = varied[nominal.name]
        if not suite.sweep:
            entries.append(DescribedScenario(changed, scenario_json(changed), versions, nominal, {}))
        entries += [
            DescribedScenario(point.scenario, scenario_json(point.scenario), versions, nominal, point.values)
            for point in (swept_points(suite, changed) if suite.sweep else ())
        ]
    return entries, towns


def with_suite_traffic(suite: ScenarioSuite, scenario: Scenario) -> Scenario:
    """Return a scenario with the suite's changes of its background traffic; itself if it has none.

    Raises:
        ConfigError: The traffic is not valid; the message names the key, and its line where the suite has a file.
    """
    from ssad.scenarios.dynamic.catalogue import scenario_type
    from ssad.scenarios.dynamic.schema import check

    changes = suite.traffic.model_dump(exclude_none=True)
    if not changes:
        return scenario
    # A scenario that states no traffic has that of its type.
    traffic_plan = scenario.traffic or scenario_type(scenario.type).traffic
    if traffic_plan is None:
        return scenario
    changed = replace(scenario, traffic=replace(traffic_plan, **changes))
    try:
        check(changed)
    except ConfigError as error:
        raise suite.error(("traffic",), str(error)) from None
    return changed


def swept_points(suite: ScenarioSuite, scenario: Scenario) -> tuple[GridPoint, ...]:
    """Return a scenario at the points of a suite's sweep that meet its constraints.

    Raises:
        ConfigError: A parameter is unknown, or a value is out of its range; the message names the key, and its line
            where the suite has a file.
    """
    from ssad.scenarios.dynamic.parameters import GridError, grid_points, grid_values

    # In the order of the alphabet: a suite that is read from a run's record must give the same names.
    entries = sorted(suite.sweep.items())
    grids = {name: None if entry == DECLARED_GRID else grid_values(entry) for name, entry in entries}
    try:
        return grid_points(scenario, grids, zipped=suite.sweep_mode == "zip")
    except GridError as error:
        raise suite.error(("sweep", *filter(None, [error.name])), str(error)) from None


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
