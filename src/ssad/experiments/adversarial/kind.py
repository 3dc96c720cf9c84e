"""Kind `adversarial`: generators x base scenarios x driving systems; a search within a budget of rollouts a cell."""

from __future__ import annotations

import math
import time
from collections.abc import Hashable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import Field

from ssad.core import safeio
from ssad.core.errors import ConfigError
from ssad.core.generators import Base, Outcome
from ssad.core.registry import label_of
from ssad.core.run_records import COUNT, NOT_NEGATIVE, SHARE
from ssad.core.safeio import to_plain_json
from ssad.core.source import source_version
from ssad.core.traces import motion_hash, save_trace
from ssad.core.types import Scenario
from ssad.engine.kind import Cell, Column, Job, Names, Plan, Resources, check_distinct
from ssad.experiments.adversarial import page
from ssad.experiments.adversarial.found_collisions import (
    AVOIDERS,
    grades,
    has_collision,
    has_proof,
    refusal_reason,
    saved_collisions,
    transfer,
)
from ssad.experiments.adversarial.search_scores import realism_scores, summary
from ssad.experiments.adversarial.verdict import verdict
from ssad.experiments.scenario_kind import ScenarioKind, ScenarioSuite, describe_scenarios
from ssad.metrics.realism import traffic_reference
from ssad.report.load import Run
from ssad.report.tables import Table
from ssad.simulators.closed_loop import cached_town, grades_of, system_version


class AdversarialSuite(ScenarioSuite):
    """One table: generators x scenarios x systems.

    Attributes:
        systems: Driving systems under test.
        generators: Names, or module:object; arguments and a label may follow, as for systems.
        budget: Rollouts that a generator may spend on a base.
        batch: Rollouts that it proposes at once.
        repetitions: Searches of each, with seeds of their own.
        keep: Distinct collisions that are saved of each search; those that may be proven come first.
        grade: Whether to grade which careful drivers avoid each of these (docs/explanation/careful-drivers.md).
        transfer: Systems that the saved scenarios are also driven with.
        chunk: Base scenarios that one generator works on side by side.
    """

    kind: Literal["adversarial"] = "adversarial"
    systems: Names
    generators: Names
    budget: int = Field(default=64, ge=1, le=100_000)
    batch: int = Field(default=8, ge=1, le=1024)
    repetitions: int = Field(default=1, ge=1, le=1000)
    keep: int = Field(default=3, ge=0, le=100)
    grade: bool = True
    transfer: list[str] = Field(default_factory=list)
    chunk: int = Field(default=32, ge=1, le=1024)


class Adversarial(ScenarioKind):
    """Kind `adversarial`: a search for collisions by each generator, in each base scenario, against each system."""

    name = "adversarial"
    suite = AdversarialSuite
    factors = ("generator", "system", "group")
    rates: ClassVar[Mapping[str, str]] = {"proven": "proven", "CR_any": "CR_any", "CR": "CR"}
    columns = (
        Column("applies", "generator applies", limits=SHARE),
        Column("survived", "plain replay survived", limits=SHARE),
        Column("proven", "proven collision found", "", "higher", limits=SHARE),
        Column("CR_any", "any collision with the adversary found (raw CR)", "", "higher", limits=SHARE),
        Column("CR", "collision found, adversary on its side and hitting nobody else", "", "higher", limits=SHARE),
        Column("rollouts", "rollouts to the first", "", "lower", limits=COUNT),
        Column("share", "share of rollouts that collide", "", "higher", limits=SHARE),
        Column("distinct", "distinct collisions", "", "higher", limits=COUNT),
        Column("off_road", "rollouts with the adversary off its side of the road", "", "lower", limits=SHARE),
        Column("hit_others", "rollouts with the adversary in others", "", "lower", limits=SHARE),
        Column("moving", "collisions in which the ego moves", "", "higher", limits=SHARE),
        Column("impact_speed", "impact speed", "m/s", limits=NOT_NEGATIVE),
        *(
            Column(f"avoided_by_{name}", f"saved collisions that {who} avoids", limits=SHARE)
            for name, who in AVOIDERS.items()
        ),
        Column("attributable", "saved collisions that a careful driver avoids", "", "higher", limits=SHARE),
        Column("attributable_moving", "the same, with the ego moving", "", "higher", limits=SHARE),
        Column("acceleration", "largest acceleration of the adversary", "m/s^2", limits=NOT_NEGATIVE),
        Column("jerk", "largest jerk of the adversary", "m/s^3", limits=NOT_NEGATIVE),
        Column("within_limits", "collisions within the adversary's limits", "", "higher", limits=SHARE),
        Column("replayed", "saved scenarios that collide again", "", "higher", limits=SHARE),
        Column("realism", "realism score of the adversaries", "", "higher", limits=SHARE),
        Column("within_published", "adversaries within published human driving", "", "higher", limits=SHARE),
        Column("w_speed", "Wasserstein distance of speed", "m/s", "lower", limits=NOT_NEGATIVE),
        Column("w_acceleration", "Wasserstein distance of acceleration", "m/s^2", "lower", limits=NOT_NEGATIVE),
        Column("w_yaw_rate", "Wasserstein distance of yaw rate", "rad/s", "lower", limits=NOT_NEGATIVE),
        Column("w_nearest", "Wasserstein distance of the nearest object", "m", "lower", limits=NOT_NEGATIVE),
        Column("seconds_first", "CPU time a scenario to the first", "s", "lower", limits=NOT_NEGATIVE, clock=True),
        Column("seconds", "CPU time a scenario", "s", "lower", limits=NOT_NEGATIVE, clock=True),
    )

    def plan(self, suite: AdversarialSuite, *, device: str = "cpu", check: bool = True) -> Plan:
        """Look up systems, generators, scenarios and towns; with `check`, build each scenario once."""
        from ssad.scenarios.dynamic import build_episode
        from ssad.scenarios.dynamic.generate import generator_factory

        check_distinct(suite, "systems", suite.systems)
        check_distinct(suite, "generators", suite.generators)
        systems = {name: system_version(name) for name in dict.fromkeys([*suite.systems, *suite.transfer])}
        factories = {name: generator_factory(name) for name in suite.generators}
        generators = {name: source_version(factory.__module__) for name, factory in factories.items()}
        scenarios, towns = describe_scenarios(suite, [column.name for column in self.columns])
        if check:
            episodes = [
                build_episode(scenario.scenario, cached_town(scenario.scenario.town), seed=0) for scenario in scenarios
            ]
            for name, factory in factories.items():
                refusals = [refusal_reason(factory, episode) for episode in episodes]
                if all(refusals):
                    raise ConfigError(f"generator {name}: {refusals[0]}")
        transfer_versions = [systems[name] for name in suite.transfer]
        # all generators and systems meet the same bases with the same seeds
        cells = tuple(
            self.scenario_cell(
                suite,
                scenario,
                systems[system],
                generators[generator],
                *transfer_versions,
                system=system,
                title=(
                    f"{label_of(generator)}/{system}/{scenario.scenario.name}{f'#{repetition}' if repetition else ''}"
                ),
                chance=("adversarial", repetition),
                fields={"generator": label_of(generator)},
                generator=generator,
                repetition=repetition,
                budget=suite.budget,
                batch=suite.batch,
                keep=suite.keep,
                grade=suite.grade,
                transfer=list(suite.transfer),
            )
            for generator, system, scenario, repetition in product(
                suite.generators, suite.systems, scenarios, range(suite.repetitions)
            )
        )
        return Plan(self, suite, device, cells, {"towns": towns, "systems": systems, "generators": generators})

    def prepare(self, plan: Plan, folder: Path, resources: Resources, *, retry: Sequence[Cell] = ()) -> dict[str, Any]:
        """Store the towns as `ScenarioKind` does, and make the folder of saved collisions."""
        safeio.make_folder(folder / "found")
        return super().prepare(plan, folder, resources)

    def alike(self, cell: Cell) -> Hashable:
        """Return generator and system: the generator works on the bases of one system side by side."""
        return cell.spec["generator"], cell.system

    def execute(self, cells: Sequence[Cell], job: Job) -> dict[str, dict[str, Any]]:
        """Run one generator on the bases that the system survives."""
        from ssad.drivers import make_system
        from ssad.scenarios.dynamic import scenario_from
        from ssad.scenarios.dynamic.generate import Trials, generator_factory, search

        system, spec = cells[0].system, cells[0].spec
        trials = Trials(lambda: make_system(system), make_system, device=job.device)
        scenarios = [scenario_from(cell.spec["scenario"]) for cell in cells]
        seeds = [cell.seed for cell in cells]
        driven_bases = trials.bases(
            [(value, cached_town(value.town), seed) for value, seed in zip(scenarios, seeds, strict=True)]
        )
        bases = {cell.key: base for cell, base in zip(cells, driven_bases, strict=True)}
        factory = generator_factory(spec["generator"])
        surviving_cells: list[Cell] = []
        results: dict[str, dict[str, Any]] = {}
        for cell in cells:
            base = bases[cell.key]
            refusal, is_survived = refusal_reason(factory, base.episode), not has_collision(base)
            if is_survived and not refusal:
                surviving_cells.append(cell)
                continue
            metrics: dict[str, Any] = {"applies": not refusal, "survived": is_survived}
            results[cell.key] = {"metrics": metrics, "case": motion_hash(base.trace), "refused": refusal}
        if not surviving_cells:
            return results
        start_time = time.process_time()
        surviving_bases = [bases[cell.key] for cell in surviving_cells]
        generator = factory(surviving_bases, seeds=[cell.seed for cell in surviving_cells], budget=spec["budget"])
        time_by_rollouts: dict[int, float] = {}  # rollouts of each base -> s for all bases
        outcomes = search(
            generator,
            surviving_bases,
            trials,
            budget=spec["budget"],
            batch=spec["batch"],
            on_batch_end=lambda rollout_count: time_by_rollouts.update(
                {rollout_count: time.process_time() - start_time}
            ),
        )
        reference_motion = traffic_reference()
        saved = [
            self._save(cell, base, trial_outcomes, job.folder)
            for cell, base, trial_outcomes in zip(surviving_cells, surviving_bases, outcomes, strict=True)
        ]
        replays = self._drive_again(
            surviving_cells,
            surviving_bases,
            [saved_scenarios for _, saved_scenarios, _ in saved],
            [adversaries for _, _, adversaries in saved],
            trials,
        )
        for cell, base, trial_outcomes, (artefacts, _, _), replay_record in zip(
            surviving_cells, surviving_bases, outcomes, saved, replays, strict=True
        ):
            metrics = {"applies": True, "survived": True, **summary(trial_outcomes), **replay_record.pop("metrics")}
            if not metrics["CR"]:
                metrics["proven"] = False
            metrics |= realism_scores(trial_outcomes, base.graph, reference_motion)
            # All bases are searched side by side: each takes an equal part of the time.
            metrics["seconds"] = max(time_by_rollouts.values()) / len(surviving_cells)
            times_to_collision = [
                value
                for rollout_count, value in time_by_rollouts.items()
                if metrics["CR"] and rollout_count >= metrics["rollouts"]
            ]
            metrics["seconds_first"] = min(times_to_collision, default=math.nan) / len(surviving_cells)
            results[cell.key] = {
                **artefacts,
                **replay_record,
                "metrics": to_plain_json(metrics),
                "case": cell.key,
                "n": len(trial_outcomes),
            }
        return results

    def _save(
        self, cell: Cell, base: Base, row: Sequence[Outcome], folder: Path
    ) -> tuple[dict[str, Any], list[Scenario], list[tuple[str, ...]]]:
        """Write the most distinct collisions as scenarios, and the trace of the first; return also who attacked."""
        from ssad.scenarios.dynamic.outcome import adversary_names

        suffix = f"-{cell.spec['repetition']}" if cell.spec["repetition"] else ""
        stem = f"{base.scenario.name}/{cell.fields['generator']}{suffix}"
        artefacts = {"scenarios": f"found/{cell.key}.yaml", "trace": f"traces/{cell.key}.npz"}
        collisions, saved_scenarios = saved_collisions(
            folder / artefacts["scenarios"], base, row, limit=cell.spec["keep"], stem=stem
        )
        if not collisions:
            return {}, [], []
        assert collisions[0].trace is not None
        save_trace(folder / artefacts["trace"], collisions[0].trace)
        record = {"artefacts": artefacts, "adversaries": list(collisions[0].adversaries)}
        return record, saved_scenarios, [adversary_names(outcome) for outcome in collisions]

    def _drive_again(
        self,
        cells: Sequence[Cell],
        bases: Sequence[Base],
        scenarios_by_base: Sequence[Sequence[Scenario]],
        adversaries_by_base: Sequence[Sequence[tuple[str, ...]]],
        trials: Any,
    ) -> list[dict[str, Any]]:
        """Drive the saved scenarios again, grade and prove them, and drive them with other systems."""
        records: list[dict[str, Any]] = [{"metrics": {"replayed": None, "proven": None}} for _ in cells]
        cell_indices = [cell_index for cell_index, scenarios in enumerate(scenarios_by_base) if scenarios]
        # another seed: a saved collision must not depend on the seed of its search
        seeds = [cells[cell_index].seed + 1 for cell_index in cell_indices]
        replayed_bases = iter(
            trials.bases(
                [
                    (scenario, bases[cell_index].graph, seed)
                    for cell_index, seed in zip(cell_indices, seeds, strict=True)
                    for scenario in scenarios_by_base[cell_index]
                ]
            )
        )
        transfer_records = transfer(
            cells[0].spec["transfer"],
            [bases[cell_index] for cell_index in cell_indices],
            [scenarios_by_base[cell_index] for cell_index in cell_indices],
            trials.device,
            seeds=seeds,
        )
        replays = [[next(replayed_bases) for _ in scenarios_by_base[cell_index]] for cell_index in cell_indices]
        collisions = [[base for base in base_replays if has_collision(base)] for base_replays in replays]
        is_graded = cells[0].spec["grade"]
        collision_grades = iter(
            grades_of(
                [
                    (base.episode, base.trace)
                    for repeated_collisions in collisions
                    for base in repeated_collisions
                    if is_graded
                ],
                trials.device,
            )
        )
        for cell_index, base_replays, repeated_collisions, transfer_record in zip(
            cell_indices, replays, collisions, transfer_records, strict=True
        ):
            metrics: dict[str, Any] = {"replayed": len(repeated_collisions) / len(base_replays)}
            rows = [next(collision_grades).metrics() for _ in repeated_collisions] if is_graded else None
            metrics["proven"] = has_proof(base_replays, adversaries_by_base[cell_index], rows)
            if rows is not None:
                metrics |= grades(rows, repeated_collisions)
            records[cell_index] = {"metrics": metrics, "transfer": transfer_record}
        return records

    def page(self, run: Run) -> tuple[str, Sequence[Table]]:
        """Return the page of a run and its tables."""
        return page.section(run, self.verdict(run))

    def summary(self, run: Run) -> Table:
        """Return the main table of a run."""
        return page.summary(run)

    def verdict(self, run: Run) -> list[str]:
        """Return the findings of a run in sentences."""
        return verdict(run)
