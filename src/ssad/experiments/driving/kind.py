"""Kind `driving`: driving systems x scenarios x repetitions in the embedded world; an episode a cell."""

from __future__ import annotations

import time
from collections.abc import Hashable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import Field

from ssad.core.errors import ConfigError, SSADError
from ssad.core.safeio import to_plain_json
from ssad.core.types import EpisodeTrace
from ssad.engine.kind import Cell, Column, Job, Names, Plan, Resources, check_distinct
from ssad.experiments.driving import page
from ssad.experiments.driving.verdict import verdict
from ssad.experiments.scenario_kind import (
    ScenarioKind,
    ScenarioSuite,
    describe_scenarios,
    drive_record,
)
from ssad.metrics import METRICS
from ssad.metrics.driving import LIMITS
from ssad.report.load import Run
from ssad.report.tables import Table
from ssad.simulators.closed_loop import (
    EMBEDDED,
    HIGHWAY_TYPE,
    build_requested_episode,
    drive,
    grade_of,
    is_carla,
    runs_embedded,
    runs_in_highway_env,
    simulator_version,
    system_version,
)


class DrivingSuite(ScenarioSuite):
    """One table: systems x scenarios x repetitions.

    Attributes:
        systems: names, or module:object; arguments and a label may follow, as in mine:Mine?checkpoint=a.pt@first.
        simulator: SSAD's own world, embedded, a CARLA server, carla://HOST:PORT (docs/how-to/use-carla.md), or
            module:object.
        repetitions: episodes of each pair; the first is the nominal case.
        spread: how far the other repetitions are drawn around it, 1 being the natural spread
            (docs/reference/scenarios.md); 0: not at all, then scenarios without traffic of their own give copies,
            which count once.
        witness: whether each collision is graded by the careful drivers that avoid it, and by a search for any way to
            avoid it (docs/explanation/careful-drivers.md).
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
    """Kind `driving`: one episode for each system, scenario and repetition."""

    name = "driving"
    suite = DrivingSuite
    columns = tuple(Column(m.symbol, m.title, m.unit, m.better) for m in METRICS.values() if m.field)
    factors = ("system", "group")
    metric_limits = LIMITS
    rates: ClassVar[Mapping[str, str]] = {m.symbol: m.field for m in METRICS.values() if m.kind == "share"}

    def plan(self, suite: DrivingSuite, *, device: str = "cpu", check: bool = True) -> Plan:
        """Look up systems, scenarios and towns; with `check`, build each scenario once."""
        check_distinct(suite, "systems", suite.systems)
        systems = {name: system_version(name) for name in suite.systems}
        scenarios, towns = describe_scenarios(suite, [column.name for column in self.columns])
        simulator_spec: dict[str, Any] = {} if suite.simulator == EMBEDDED else {"simulator": suite.simulator}
        inputs = []
        if simulator_spec and any(scenario.scenario.type == HIGHWAY_TYPE for scenario in scenarios):
            raise ConfigError(f"suite {suite.name}: scenarios of highway-env do not run in {suite.simulator}")
        if not is_carla(suite.simulator):
            inputs = [version] if (version := simulator_version(suite.simulator)) else []
        else:
            from ssad.simulators.carla.server import Server, check_version

            server = Server.of(suite.simulator)
            if check:
                check_version(server)
        # the seed does not depend on the system: systems meet the same episodes
        cells = tuple(
            self.scenario_cell(
                suite,
                scenario,
                systems[system],
                *inputs,
                system=system,
                chance=("episode", repetition),
                title=f"{system}/{scenario.scenario.name}{f'#{repetition}' if repetition else ''}",
                repetition=repetition,
                spread=suite.spread if repetition else 0.0,
                **simulator_spec,
            )
            for system in suite.systems
            for scenario in scenarios
            for repetition in range(suite.repetitions)
        )
        if check:
            # Cells of the first system, one a scenario: systems meet the same episodes.
            for cell in cells[: len(scenarios) * suite.repetitions : suite.repetitions]:
                _check(cell)
        return Plan(self, suite, device, cells, {"towns": towns, "systems": systems})

    def prepare(self, plan: Plan, folder: Path, resources: Resources, *, retry: Sequence[Cell] = ()) -> dict[str, Any]:
        """Store the towns as `ScenarioKind` does.

        Raises:
            ConfigError: A CARLA server on a cluster.
        """
        super().prepare(plan, folder, resources)
        if resources.ray and is_carla(plan.suite.simulator):
            raise ConfigError(f"suite {plan.suite.name}: one worker drives {plan.suite.simulator}; leave out --ray")
        return {"witness": plan.suite.witness}

    def workers(self, plan: Plan, requested: int | None) -> int | None:
        """Return one worker for a CARLA server, which runs one world."""
        return 1 if requested != 0 and is_carla(plan.suite.simulator) else requested

    def alike(self, cell: Cell) -> Hashable:
        """Return system and simulator; CARLA drives one cell at a time."""
        return cell.key if is_carla(cell.spec.get("simulator")) else (cell.system, runs_in_highway_env(cell))

    def execute(self, cells: Sequence[Cell], job: Job) -> dict[str, dict[str, Any]]:
        """Drive the episodes as one batch of the world, measure them, write their traces."""
        start_time = time.perf_counter()
        episodes, traces, simulator_counts = drive(cells, device=job.device)
        shared_seconds = (time.perf_counter() - start_time) / len(cells)
        results: dict[str, dict[str, Any]] = {}
        for cell, episode, trace in zip(cells, episodes, traces, strict=True):
            start_time = time.perf_counter()
            result = drive_record(cell, episode, trace, job.folder)
            if simulator_counts:
                result["metrics"]["lane_crossings"] = simulator_counts["lane_crossings"]
                result["measured"] = to_plain_json(simulator_counts)
            if job.settings["witness"] and trace.end == "collision" and runs_embedded(cell):
                grade = grade_of(episode, trace, job.device)
                result["metrics"] |= grade.metrics()
                result["witness"] = to_plain_json(grade.as_dict())
            results[cell.key] = result | {"wall_s": shared_seconds + time.perf_counter() - start_time}
        return results

    def drive_again(self, plan: Plan, cell: Cell, record: Mapping[str, Any]) -> EpisodeTrace:
        """Drive a cell again and return its trace."""
        _, (trace,), _ = drive([cell], device=plan.device)
        return trace

    def finish(self, plan: Plan, folder: Path) -> None:
        """Write the pictures that the suite requests, once, beside its results."""
        from ssad.experiments.driving.run_images import write_pictures

        write_pictures(plan.suite.pictures, folder)

    def page(self, run: Run) -> tuple[str, Sequence[Table]]:
        """Return the page of a run and its tables."""
        return page.section(run, self.verdict(run))

    def summary(self, run: Run) -> Table:
        """Return the main table of a run."""
        return page.summary(run)

    def verdict(self, run: Run) -> list[str]:
        """Return the findings of a run in sentences."""
        return verdict(run)


def _check(cell: Cell) -> None:
    try:
        build_requested_episode(cell)
    except SSADError as error:
        name = f"scenario {cell.spec['scenario']['name']}"
        raise type(error)(str(error) if name in str(error) else f"{name}: {error}") from None
