"""Kind `gap`: perceiving systems x scenarios x perturbations of their cameras x severities; an episode a cell.

The same drive gives metrics of the component, on the images of the driver itself, and metrics of the system.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from ssad.core import safeio
from ssad.core.errors import ConfigError
from ssad.core.folders import path_inside
from ssad.core.images import save_picture
from ssad.core.lane_graph import LaneGraph
from ssad.core.machine import start_warp_quietly
from ssad.core.run_records import NOT_NEGATIVE, SHARE
from ssad.core.traces import first_difference, load_trace
from ssad.core.types import EpisodeTrace
from ssad.drivers.lane_keeping.markings import RoadGrid
from ssad.drivers.perceiving.system import PerceivingSystem
from ssad.engine.kind import Cell, Column, Job, Plan, Replay, Resources, check_distinct
from ssad.experiments.gap import page
from ssad.experiments.gap.drive_sheet import RecordedDrive, drive_film, drive_sheet
from ssad.experiments.gap.perceiving_loop import drive_perceiving, drive_repaired, perturbation_of
from ssad.experiments.gap.verdict import verdict
from ssad.experiments.scenario_kind import (
    DescribedScenario,
    ScenarioKind,
    ScenarioSuite,
    describe_scenarios,
    drive_record,
)
from ssad.metrics.driving import LIMITS
from ssad.metrics.lane_keeping import lane_course, lane_metrics
from ssad.metrics.perception_in_drive import (
    BANDS,
    SIGN_BANDS,
    cause_of_collision,
    component_metrics,
    hard_braking,
    impact_speed,
    phantom_stop,
    sign_metrics,
)
from ssad.metrics.speed_limits import limit_metrics
from ssad.rendering.street import cached_street
from ssad.rendering.street_signs import limit_signs_of_route
from ssad.report.load import Run
from ssad.report.tables import Table
from ssad.scenarios.static.catalogue import NONE, PerturbationTable
from ssad.scenarios.static.perturbation import EGO, Perturbation
from ssad.scenarios.static.physical.textures.perturbation import signs_of_route
from ssad.simulators.closed_loop import build_requested_episode, cached_town, system_version

VIEW_AHEAD = RoadGrid().far  # m: range of the lane keeper
BESIDE_LANE = 12.0  # m from the route within which a speed-limit sign belongs to it
FRAME_INTERVAL = 0.2  # s from one frame of a film to the next


class GapSuite(ScenarioSuite, PerturbationTable):
    """Systems x scenarios x perturbations.

    Attributes:
        systems: Perceiving systems; names must differ.
        ceilings: Systems that receive the ground truth, without perturbations (`ssad list systems`).
        perturbations: Perturbations (docs/reference/gap.md); the clean condition always runs.
        severities: Severities 1 to 5 of the perturbations that set none of their own.
        repetitions: As in suites of kind driving.
        spread: As in suites of kind driving.
        sheets: Number of drives with pictures, collisions first.
        repair: Whether drives that end in a collision are repeated with the hit object detected at its true place,
            to tell whether this error alone causes the collision.
    """

    kind: Literal["gap"] = "gap"
    systems: list[PerceivingSystem] = Field(min_length=1)
    ceilings: list[str] = Field(default=["autopilot", "line-of-sight"])
    repetitions: int = Field(default=1, ge=1, le=100_000)
    spread: float = Field(default=1.0, ge=0, le=10, allow_inf_nan=False)
    timeout_s: float = Field(default=1200.0, gt=0, allow_inf_nan=False)
    chunk: int = Field(default=4, ge=1, le=4096)
    sheets: int = Field(default=6, ge=0)
    repair: bool = True

    def beside(self, path: Path) -> Self:
        """Return the suite with the files of scenarios and perturbations resolved."""
        return super().beside(path).with_files_beside(path.parent)


class Gap(ScenarioKind):
    """Kind `gap`: component and system metrics of the same drive under a perturbation."""

    name = "gap"
    suite = GapSuite
    columns = (
        Column("AP", "AP of all objects, on the drive's pictures", "", "higher", limits=SHARE),
        Column("recall", "recall of the objects in view, within 2 m", "", "higher", limits=SHARE),
        Column("missed_burst", "looks in a row that an object in view is missed", "", "lower", limits=NOT_NEGATIVE),
        Column("distance_share", "RMS error of the distances, as a share of them", "", "lower", limits=NOT_NEGATIVE),
        Column("target_recall", "recall of the object that matters", "", "higher", limits=SHARE),
        *(
            Column(f"target_recall_{a:.0f}_{b:.0f}", f"the same from {a:.0f} to {b:.0f} m", "", "higher", limits=SHARE)
            for a, b in BANDS
        ),
        Column("distance_error", "error of its distance", "m", "lower", limits=NOT_NEGATIVE),
        Column("phantoms", "phantoms a look", "", "lower", limits=NOT_NEGATIVE),
        Column("believed", "share of the steps in which it is believed where it is", "", "higher", limits=SHARE),
        Column("switches", "changes of its track", "", "lower", limits=NOT_NEGATIVE),
        Column("HOTA", "HOTA of what is believed", "", "higher", limits=SHARE),
        Column("MOTA", "MOTA of the same", "", "higher", limits=(None, 1.0)),
        Column("IDF1", "IDF1 of the same", "", "higher", limits=SHARE),
        Column("collision", "CR", "", "lower"),
        Column("impact_speed", "impact speed", "m/s", "lower"),
        Column("route_completion", "RC", "", "higher"),
        Column("min_ttc", "least time to collision", "s", "higher"),
        Column("stop_signs", "stop signs run", "", "lower"),
        Column("sign_recall", "share of the looks in which the stop sign ahead was read", "", "higher", limits=SHARE),
        *(
            Column(f"sign_recall_{a:.0f}_{b:.0f}", f"the same from {a:.0f} to {b:.0f} m", "", "higher", limits=SHARE)
            for a, b in SIGN_BANDS
        ),
        Column("sign_read_at", "m from a stop sign at which one was first read", "m", "higher", limits=NOT_NEGATIVE),
        Column("hard_braking", "times of braking above 4 m/s^2", "", "lower", limits=NOT_NEGATIVE),
        Column("phantom_stop_s", "time stood before a phantom", "s", "lower", limits=NOT_NEGATIVE),
        Column("off_road", "OR", "m", "lower", limits=NOT_NEGATIVE),
        Column("distance_to_route", "DR", "m", "lower", limits=NOT_NEGATIVE),
        Column("lane_deviation", "distance to the middle of the lane", "m", "lower", limits=NOT_NEGATIVE),
        Column("lane_deviation_max", "greatest distance to it", "m", "lower", limits=NOT_NEGATIVE),
        Column("lane_departure", "share of the drives that leave the lane", "", "lower", limits=SHARE),
        Column("departure_time", "time to the departure from the lane", "s", "higher", limits=NOT_NEGATIVE),
        Column("lane_error", "error of the detected middle of the lane", "m", "lower", limits=NOT_NEGATIVE),
        Column("lane_detection_rate", "share of the steps in which the lane was detected", "", "higher", limits=SHARE),
        Column("limit_known", "share of the steps past a sign with the right speed limit", "", "higher", limits=SHARE),
        Column("limit_error", "error of the speed limit that was read", "km/h", "lower", limits=NOT_NEGATIVE),
        Column("speeding", "speed above the posted limit", "km/h", "lower", limits=NOT_NEGATIVE),
        Column("speeding_max", "greatest speed above the posted limit", "km/h", "lower", limits=NOT_NEGATIVE),
    )
    factors = ("system", "perturbation", "severity")
    metric_limits = LIMITS
    rates: ClassVar[Mapping[str, str]] = {"CR": "collision"}

    def plan(self, suite: GapSuite, *, device: str = "cpu", check: bool = True) -> Plan:
        """Look up names and build detectors once; with `check`, build each scenario once."""
        check_distinct(suite, "systems", [entry.name for entry in suite.systems] + suite.ceilings)
        for system in suite.systems:
            system.check()
        versions = {entry.name: entry.version for entry in suite.systems}
        versions |= {name: system_version(name) for name in suite.ceilings}
        scenarios, towns = describe_scenarios(suite, [column.name for column in self.columns])
        conditions = conditions_of(suite)
        targeted = [condition for condition in conditions if condition.needs_target]
        targets: dict[tuple[str, str], int | None] = {}
        if check or targeted:
            for entry in scenarios:
                episode = build_requested_episode(self._cell(suite, entry, conditions[0], 0, "", EGO))
                for condition in targeted:
                    assert condition.perturbation is not None
                    agent = condition.perturbation.applies_to(episode, cached_town(entry.scenario.town))
                    targets[condition.title, entry.scenario.name] = agent
        cells = [
            self._cell(suite, entry, condition, repetition, versions[condition.system_name], target)
            for condition in conditions
            for entry in scenarios
            for target in [targets.get((condition.title, entry.scenario.name), None if condition.needs_target else EGO)]
            if target is not None
            for repetition in range(suite.repetitions)
        ]
        return Plan(self, suite, device, tuple(cells), {"towns": towns, "systems": versions})

    def _cell(  # noqa: PLR0917  # plain values
        self,
        suite: GapSuite,
        described_scenario: DescribedScenario,
        condition: Condition,
        repetition: int,
        version: str,
        target: int,
    ) -> Cell:
        """Return a cell.

        Its seed depends on the scenario and the repetition alone, so that all conditions meet the same drives.
        """
        system, perturbation = condition.system, condition.perturbation
        system_settings = None if isinstance(system, str) else system.model_dump(mode="json")
        condition_text = f"{condition.title}/" if perturbation is not None else ""
        severity = 0 if perturbation is None else perturbation.severity
        return self.scenario_cell(
            suite,
            described_scenario,
            version,
            suite.seed,
            "" if perturbation is None else perturbation.version(),
            system=condition.system_name,
            chance=("episode", repetition),
            title=(
                f"{condition.system_name}/{condition_text}{described_scenario.scenario.name}"
                f"{f'#{repetition}' if repetition else ''}"
            ),
            fields={
                "perturbation": NONE if perturbation is None else perturbation.name,
                "severity": severity,
                "family": NONE if perturbation is None else perturbation.family,
            },
            repetition=repetition,
            spread=suite.spread if repetition else 0.0,
            settings=system_settings,
            perturbation=condition.entry,
            severity=severity,
            repair=suite.repair and system_settings is not None,
            target=target,
        )

    def prepare(self, plan: Plan, folder: Path, resources: Resources, *, retry: Sequence[Cell] = ()) -> dict[str, Any]:
        """Store the towns as `ScenarioKind` does, and return the seed and whether sheets are made."""
        super().prepare(plan, folder, resources)
        return {"seed": plan.suite.seed, "sheets": plan.suite.sheets > 0}

    def alike(self, cell: Cell) -> Hashable:
        """Return town and condition: the street of a batch is then built once."""
        spec = cell.spec
        return spec["scenario"]["town"], cell.system, cell.fields["perturbation"], spec["severity"], spec["target"]

    def execute(self, cells: Sequence[Cell], job: Job) -> dict[str, dict[str, Any]]:
        """Drive the episodes as one batch, and measure component and system."""
        seed = job.settings["seed"]
        episodes, traces, perception = drive_perceiving(
            cells, device=job.device, seed=seed, image_interval=0.5 if job.settings["sheets"] else None
        )
        repair = cells[0].spec["repair"]
        repaired = drive_repaired(cells, traces, device=job.device, seed=seed) if repair else {}
        results: dict[str, dict[str, Any]] = {}
        for index, (cell, episode, trace) in enumerate(zip(cells, episodes, traces, strict=True)):
            result = drive_record(cell, episode, trace, job.folder)
            metrics = result["metrics"] | {"impact_speed": impact_speed(trace), "hard_braking": hard_braking(trace)}
            record_fields: dict[str, Any] = {name: result["episode"][name] for name in ("end", "trace_hash", "town")}
            if perception is not None:
                system, perceived = PerceivingSystem.model_validate(cell.spec["settings"]), perception.perception(index)
                metrics |= component_metrics(trace, perceived, phantom_score=system.tracking.high)
                metrics |= sign_metrics(trace, perceived, signs_of_route(cached_town(trace.town), trace.route))
                metrics["phantom_stop_s"] = phantom_stop(trace, perceived)
                if system.keeps_lane:
                    place = getattr(perturbation_of(cell.spec), "place_distance", None)
                    graph = cached_town(trace.town)
                    metrics |= lane_metrics(trace, graph, perceived.lanes, place=place, view=VIEW_AHEAD)
                    if system.set_speed is not None:
                        metrics |= limit_metrics(
                            trace, graph, perceived.limits, first_sign=first_limit_sign(trace, graph)
                        )
                    metrics |= {
                        name: None for name, value in metrics.items() if value is not None and math.isnan(value)
                    }
                    record_fields["lane"] = lane_course(trace, graph)
                record_fields["cause"] = cause_of_collision(trace, perceived)
                if job.settings["sheets"] and (sheet_images := perception.images(index)):
                    result["artefacts"]["sheet"] = f"sheets/{cell.key}.jpg"
                    safeio.make_folder(job.folder / "sheets")
                    picture = drive_sheet(trace, perceived, sheet_images, cached_town(trace.town))
                    save_picture(job.folder / result["artefacts"]["sheet"], picture)
            metrics = {name: round(value, 6) if isinstance(value, float) else value for name, value in metrics.items()}
            record_fields |= {"repaired": repaired[index]} if index in repaired else {}
            episode_line = result["episode"] | record_fields | {"metrics": metrics}
            results[cell.key] = result | record_fields | {"metrics": metrics, "episode": episode_line}
        return results

    def replay(self, plan: Plan, cell: Cell, record: Mapping[str, Any], folder: Path) -> Replay:
        """Drive the episode again and compare every bit of its trace; film it beside the clean drive."""
        start_warp_quietly()
        recorded = load_trace(path_inside(folder, record["artefacts"]["trace"]))
        spec, graph = cell.spec, cached_town(recorded.town)
        # The clean drive shows what the perturbation alone changes.
        clean_cell = replace(cell, spec={**spec, "perturbation": None})
        drives, replayed_traces = [], []
        for driven_cell in [cell] if spec["perturbation"] is None else [clean_cell, cell]:
            _, (trace,), perception = drive_perceiving(
                [driven_cell], device=plan.device, seed=plan.suite.seed, image_interval=FRAME_INTERVAL
            )
            replayed_traces.append(trace)
            if perception is not None:
                images = perception.images(0)
                title = (
                    f"{cell.fields['perturbation']} {spec['severity']}"
                    if driven_cell is cell and spec["severity"]
                    else "clean"
                )
                drives.append(RecordedDrive(title, trace, perception.perception(0), images))
        filmed_drives = [drive for drive in drives if drive.shots]
        drive_film_frames = (
            (drive_film(filmed_drives, graph, frame_interval=FRAME_INTERVAL), FRAME_INTERVAL) if filmed_drives else None
        )
        driver_perception = drives[-1] if drives and drives[-1].trace is replayed_traces[-1] else None
        return Replay(
            cell,
            first_difference(recorded, replayed_traces[-1]),
            replayed_traces[-1],
            graph,
            film=drive_film_frames,
            perception=driver_perception,
        )

    def page(self, run: Run) -> tuple[str, Sequence[Table]]:
        """Return the page of a run and its tables."""
        return page.section(run, self.verdict(run))

    def summary(self, run: Run) -> Table:
        """Return the main table of a run."""
        return page.summary(run)

    def verdict(self, run: Run) -> list[str]:
        """Return the findings of a run in sentences."""
        return verdict(run)


@dataclass(frozen=True)
class Condition:
    """A system under a perturbation.

    Attributes:
        system: The perceiving system, or the name of a ceiling.
        perturbation: The perturbation; None: clean.
        entry: The perturbation as the suite writes it.
    """

    system: str | PerceivingSystem
    perturbation: Perturbation | None = None
    entry: Any = None

    @property
    def system_name(self) -> str:
        """Name of the system."""
        return self.system if isinstance(self.system, str) else self.system.name

    @property
    def title(self) -> str:
        """Perturbation and severity, such as "fog-3"."""
        return NONE if self.perturbation is None else f"{self.perturbation.name}-{self.perturbation.severity}"

    @property
    def needs_target(self) -> bool:
        """True if the perturbation needs an agent, a sign or a place along the route to be on."""
        perturbation = self.perturbation
        return perturbation is not None and (perturbation.needs_target or perturbation.needs_place)


def conditions_of(suite: GapSuite) -> list[Condition]:
    """Return the conditions of a suite: ceilings first, then each system clean and perturbed.

    Raises:
        SSADError: A perturbation cannot be made, or appears twice.
    """
    try:
        suite.conditions()
    except ConfigError as error:
        raise type(error)(f"suite {suite.name}: {error}") from None
    perturbations = [
        (perturbation, entry.model_dump(mode="json"))
        for entry in suite.perturbations
        for perturbation in entry.at(suite.severities)
    ]
    conditions = [Condition(name) for name in suite.ceilings]
    for system in suite.systems:
        conditions.append(Condition(system))
        if not system.is_perfect:
            conditions += [Condition(system, perturbation, entry) for perturbation, entry in perturbations]
    return conditions


def first_limit_sign(trace: EpisodeTrace, graph: LaneGraph) -> float | None:
    """Return the distance along the route of a drive to its first speed-limit sign, m; None without one."""
    signs = limit_signs_of_route(
        cached_street(graph).limit_signs, trace.route[:, :2].astype(np.float64), within=BESIDE_LANE
    )
    return float(signs[0, 0]) if len(signs) else None
