"""Kind `adversarial`: generators x base scenarios x driving systems; a search within a budget of rollouts a cell."""

from __future__ import annotations

import math
import time
from collections.abc import Hashable, Sequence
from itertools import product
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from ssad.core import safeio
from ssad.core.errors import ConfigError
from ssad.core.generators import Base, Outcome
from ssad.core.safeio import plain
from ssad.core.source import source_version
from ssad.core.traces import motion_hash, save_trace
from ssad.core.types import Scenario
from ssad.engine.kind import Cell, Column, Job, Names, Plan, Resources, check_distinct
from ssad.experiments.adversarial import page
from ssad.experiments.adversarial.found_collisions import (
    AVOIDERS,
    collides,
    grades,
    refusal,
    saved_collisions,
    transfer,
)
from ssad.experiments.adversarial.search_scores import likeness, reference, summary
from ssad.experiments.adversarial.verdict import verdict
from ssad.experiments.scenario_kind import ScenarioKind, ScenarioSuite, described
from ssad.report.load import Run
from ssad.report.tables import Table
from ssad.simulators.closed_loop import grades_of, system_version, town


class AdversarialSuite(ScenarioSuite):
    """One table: generators x scenarios x systems.

    Attributes:
        systems: driving systems under test.
        generators: names, or module:object.
        budget: rollouts that a generator may spend on a base.
        batch: how many of them it is asked for at once.
        repetitions: searches of each, with seeds of their own.
        keep: found scenarios that are saved, of each search, the most distinct first.
        grade: tell of each of these who could have avoided the collision (docs/careful.md).
        transfer: systems that the saved scenarios are also driven with.
        chunk: base scenarios that one generator works on side by side.
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
    """See the module."""

    name = "adversarial"
    suite = AdversarialSuite
    factors = ("generator", "system", "group")
    columns = (
        Column("applies", "generator applies"),
        Column("survived", "plain replay survived"),
        Column("CR", "collision found, adversary on the road and hitting nobody else", "", "higher"),
        Column("CR_any", "any collision with the adversary found", "", "higher"),
        Column("rollouts", "rollouts to the first", "", "lower"),
        Column("share", "share of rollouts that collide", "", "higher"),
        Column("distinct", "distinct collisions", "", "higher"),
        Column("off_road", "rollouts with the adversary off the road", "", "lower"),
        Column("hit_others", "rollouts with the adversary in others", "", "lower"),
        Column("moving", "collisions in which the ego moves", "", "higher"),
        Column("impact_speed", "impact speed", "m/s"),
        *(Column(f"avoided_by_{name}", f"saved collisions that {who} avoids") for name, who in AVOIDERS.items()),
        Column("attributable", "saved collisions that a careful driver avoids", "", "higher"),
        Column("attributable_moving", "the same, with the ego moving", "", "higher"),
        Column("acceleration", "largest acceleration of the adversary", "m/s^2"),
        Column("jerk", "largest jerk of the adversary", "m/s^3"),
        Column("within_limits", "collisions within the adversary's limits", "", "higher"),
        Column("replayed", "saved scenarios that collide again", "", "higher"),
        Column("realism", "realism score of the adversaries", "", "higher"),
        Column("w_speed", "Wasserstein distance of speed", "m/s", "lower"),
        Column("w_acceleration", "Wasserstein distance of acceleration", "m/s^2", "lower"),
        Column("w_yaw_rate", "Wasserstein distance of yaw rate", "rad/s", "lower"),
        Column("w_nearest", "Wasserstein distance of the nearest object", "m", "lower"),
        Column("seconds_first", "CPU time a scenario to the first", "s", "lower"),
        Column("seconds", "CPU time a scenario", "s", "lower"),
    )

    def plan(self, suite: AdversarialSuite, *, device: str = "cpu", check: bool = True) -> Plan:
        """Systems, generators, scenarios and towns are looked up; with `check`, each scenario is built once."""
        from ssad.scenarios.dynamic import build_episode
        from ssad.scenarios.dynamic.generate import generator_factory

        check_distinct(suite, "systems", suite.systems)
        check_distinct(suite, "generators", suite.generators)
        systems = {name: system_version(name) for name in dict.fromkeys([*suite.systems, *suite.transfer])}
        factories = {name: generator_factory(name) for name in suite.generators}
        generators = {name: source_version(factory.__module__) for name, factory in factories.items()}
        scenarios, towns = described(suite)
        if check:
            episodes = [build_episode(one.scenario, town(one.scenario.town), seed=0) for one in scenarios]
            for name, factory in factories.items():
                refused = [refusal(factory, episode) for episode in episodes]
                if all(refused):
                    raise ConfigError(f"generator {name}: {refused[0]}")
        others = [systems[name] for name in suite.transfer]
        # all generators and systems meet the same bases with the same seeds
        cells = tuple(
            self.scenario_cell(
                suite,
                one,
                systems[system],
                generators[generator],
                *others,
                system=system,
                title=f"{generator}/{system}/{one.scenario.name}{f'#{repetition}' if repetition else ''}",
                chance=("adversarial", repetition),
                fields={"generator": generator},
                generator=generator,
                repetition=repetition,
                budget=suite.budget,
                batch=suite.batch,
                keep=suite.keep,
                grade=suite.grade,
                transfer=list(suite.transfer),
            )
            for generator, system, one, repetition in product(
                suite.generators, suite.systems, scenarios, range(suite.repetitions)
            )
        )
        return Plan(self, suite, device, cells, {"towns": towns, "systems": systems, "generators": generators})

    def prepare(self, plan: Plan, folder: Path, resources: Resources, *, retry: Sequence[Cell] = ()) -> dict[str, Any]:
        """See `ScenarioKind`; makes room for what is found."""
        safeio.make_folder(folder / "found")
        return super().prepare(plan, folder, resources)

    def alike(self, cell: Cell) -> Hashable:
        """Cells of one generator and one system, whose bases it works on side by side."""
        return cell.fields["generator"], cell.system

    def execute(self, cells: Sequence[Cell], job: Job) -> dict[str, dict[str, Any]]:
        """Runs one generator on the bases that the system survives."""
        from ssad.drivers import make_system
        from ssad.scenarios.dynamic import scenario_from
        from ssad.scenarios.dynamic.generate import Trials, generator_factory, search

        system, spec = cells[0].system, cells[0].spec
        trials = Trials(lambda: make_system(system), make_system, device=job.device)
        scenarios = [scenario_from(cell.spec["scenario"]) for cell in cells]
        seeds = [cell.seed for cell in cells]
        driven = trials.bases([(s, town(s.town), seed) for s, seed in zip(scenarios, seeds, strict=True)])
        bases = {cell.key: base for cell, base in zip(cells, driven, strict=True)}
        factory = generator_factory(spec["generator"])
        alive: list[Cell] = []
        results: dict[str, dict[str, Any]] = {}
        for cell in cells:
            base = bases[cell.key]
            refused, survived = refusal(factory, base.episode), not collides(base)
            if survived and not refused:
                alive.append(cell)
                continue
            metrics: dict[str, Any] = {"applies": not refused, "survived": survived}
            results[cell.key] = {"metrics": metrics, "case": motion_hash(base.trace), "refused": refused}
        if not alive:
            return results
        began = time.process_time()
        chosen = [bases[cell.key] for cell in alive]
        generator = factory(chosen, seeds=[cell.seed for cell in alive], budget=spec["budget"])
        clock: dict[int, float] = {}  # rollouts of each base -> s for all bases
        outcomes = search(
            generator,
            chosen,
            trials,
            budget=spec["budget"],
            batch=spec["batch"],
            after=lambda asked: clock.update({asked: time.process_time() - began}),
        )
        usual = reference(job.folder, job.device)
        saved = [
            self._save(cell, base, row, job.folder) for cell, base, row in zip(alive, chosen, outcomes, strict=True)
        ]
        kept = self._drive_again(alive, chosen, [made for _, made in saved], trials)
        for cell, base, row, (about, _), more in zip(alive, chosen, outcomes, saved, kept, strict=True):
            metrics = {"applies": True, "survived": True, **summary(row), **more.pop("metrics")}
            metrics |= likeness(row, base.graph, usual)
            metrics["seconds"] = max(clock.values()) / len(alive)
            spent = [s for asked, s in clock.items() if metrics["CR"] and asked >= metrics["rollouts"]]
            metrics["seconds_first"] = min(spent, default=math.nan) / len(alive)
            results[cell.key] = {**about, **more, "metrics": plain(metrics), "case": cell.key, "n": len(row)}
        return results

    def _save(
        self, cell: Cell, base: Base, row: Sequence[Outcome], folder: Path
    ) -> tuple[dict[str, Any], list[Scenario]]:
        """Writes the most distinct collisions as scenarios, and keeps the trace of the first."""
        mark = f"-{cell.spec['repetition']}" if cell.spec["repetition"] else ""
        stem = f"{base.scenario.name}/{cell.spec['generator']}{mark}"
        artefacts = {"scenarios": f"found/{cell.key}.yaml", "trace": f"traces/{cell.key}.npz"}
        found, made = saved_collisions(folder / artefacts["scenarios"], base, row, keep=cell.spec["keep"], stem=stem)
        if not found:
            return {}, []
        assert found[0].trace is not None
        save_trace(folder / artefacts["trace"], found[0].trace)
        return {"artefacts": artefacts, "adversaries": list(found[0].adversaries)}, made

    def _drive_again(
        self, cells: Sequence[Cell], bases: Sequence[Base], made: Sequence[Sequence[Scenario]], trials: Any
    ) -> list[dict[str, Any]]:
        """Drives what was saved again, grades it, and drives it with other systems; of all cells side by side."""
        kept: list[dict[str, Any]] = [{"metrics": {"replayed": None}} for _ in cells]
        some = [k for k, scenarios in enumerate(made) if scenarios]
        # with another seed: what is saved must not depend on one
        seeds = [cells[k].seed + 1 for k in some]
        again = iter(
            trials.bases([(s, bases[k].graph, seed) for k, seed in zip(some, seeds, strict=True) for s in made[k]])
        )
        others = transfer(
            cells[0].spec["transfer"], [bases[k] for k in some], [made[k] for k in some], trials.device, seeds=seeds
        )
        hits = [[one for one in (next(again) for _ in made[k]) if collides(one)] for k in some]
        graded = cells[0].spec["grade"]
        found = iter(grades_of([(one.episode, one.trace) for row in hits for one in row if graded], trials.device))
        for k, row, moved in zip(some, hits, others, strict=True):
            metrics = {"replayed": len(row) / len(made[k])}
            if graded:
                metrics |= grades([next(found).metrics() for _ in row], row)
            kept[k] = {"metrics": metrics, "transfer": moved}
        return kept

    def page(self, run: Run) -> tuple[str, Sequence[Table]]:
        """Page of a run and its tables."""
        return page.section(run, self.verdict(run))

    def summary(self, run: Run) -> Table:
        """Main table of a run."""
        return page.summary(run)

    def verdict(self, run: Run) -> list[str]:
        """Findings of a run in sentences."""
        return verdict(run)
