"""Kind `adversarial`: generators x base scenarios x driving systems; a search within a budget of rollouts a cell."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from pydantic import Field

from ssad.bench.kind import Cell, Column, Job, Kind, Names, Plan, Resources, SuiteBase, grouped
from ssad.bench.kinds.driving import DrivingSuite, keep_towns, suite_scenarios
from ssad.core import safeio
from ssad.core.errors import ConfigError
from ssad.core.generators import Base, Outcome
from ssad.core.safeio import plain
from ssad.core.seeding import seed32
from ssad.core.source import source_version
from ssad.core.traces import motion_hash, save_trace
from ssad.core.types import Episode, Scenario
from ssad.evaluation.search_scores import MOVING, distinct, likeness, reference, summary
from ssad.recording.closed_loop import grade_of, load_world, scenario_json, system_version, town, town_version

AVOIDERS = {
    "cc": "CC", "reg157": "Reg157", "rss": "RSS", "fsm": "FSM", "limit": "a manoeuvre",
}  # fmt: skip
"""Short name in a grade -> who avoids a collision: the careful drivers, and the kinematic limit."""


class AdversarialSuite(SuiteBase):
    """One table: generators x scenarios x systems.

    Attributes:
        systems: driving systems under test.
        scenarios: base scenarios, as in a driving suite.
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
    scenarios: Names
    generators: Names
    budget: int = Field(default=64, ge=1, le=100_000)
    batch: int = Field(default=8, ge=1, le=1024)
    repetitions: int = Field(default=1, ge=1, le=1000)
    keep: int = Field(default=3, ge=0, le=100)
    grade: bool = True
    transfer: list[str] = Field(default_factory=list)
    chunk: int = Field(default=32, ge=1, le=1024)

    def beside(self, path: Path) -> Self:
        """Scenario files are looked for in the working folder, then beside the suite."""
        found = self._driving().beside(path).scenarios
        return self.model_copy(update={"scenarios": found})

    def _driving(self) -> DrivingSuite:
        return DrivingSuite(name=self.name, systems=self.systems, scenarios=self.scenarios)


class Adversarial(Kind):
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

        for key in ("systems", "generators"):
            if len(set(getattr(suite, key))) != len(getattr(suite, key)):
                raise ConfigError(f"suite {suite.name}: {key}: a name appears twice")
        systems = {
            name: system_version(name) for name in {**dict.fromkeys(suite.systems), **dict.fromkeys(suite.transfer)}
        }
        factories = {name: generator_factory(name) for name in suite.generators}
        generators = {name: source_version(f.__module__) for name, f in factories.items()}
        scenarios = suite_scenarios(suite._driving())
        towns = {name: town_version(town(name)) for name in sorted({s.town for s in scenarios})}
        if check:
            episodes = [build_episode(scenario, town(scenario.town), seed=0) for scenario in scenarios]
            for name, factory in factories.items():
                refused = [refusal(factory, episode) for episode in episodes]
                if all(refused):
                    raise ConfigError(f"generator {name}: {refused[0]}")
        cells = []
        for generator in suite.generators:
            for system in suite.systems:
                for scenario in scenarios:
                    data = scenario_json(scenario)
                    for repetition in range(suite.repetitions):
                        # all generators and systems meet the same bases with the same seeds
                        seed = seed32("adversarial", suite.seed, safeio.dump_json(data), repetition)
                        mark = f"#{repetition}" if repetition else ""
                        fields = {
                            "generator": generator, "system": system, "group": scenario.group or scenario.type,
                            "cluster": scenario.name,
                        }  # fmt: skip
                        spec = {
                            "scenario": data, "generator": generator, "system": system, "repetition": repetition,
                            "budget": suite.budget, "batch": suite.batch, "keep": suite.keep,
                        }  # fmt: skip
                        if suite.transfer:
                            spec["transfer"] = list(suite.transfer)
                        if not suite.grade:
                            spec["grade"] = False
                        others = [systems[name] for name in suite.transfer]
                        versions = systems[system], generators[generator], towns[scenario.town], *others
                        name = f"{generator}/{system}/{scenario.name}{mark}"
                        cells.append(self.make_cell(name, system, seed, fields, spec, *versions))
        inputs = {"towns": towns, "systems": systems, "generators": generators}
        return Plan(self, suite, device, tuple(cells), inputs)

    def prepare(self, plan: Plan, folder: Path, resources: Resources, *, retry: Sequence[Cell] = ()) -> dict[str, Any]:
        """Copies of the towns lie beside the results, so that a report can be made where they are not imported."""
        keep_towns(plan.inputs["towns"], folder)
        safeio.make_folder(folder / "found")
        return {}

    def batches(self, plan: Plan, cells: Sequence[Cell], workers: int) -> list[list[Cell]]:
        """Cells of one generator and one system, whose bases it works on side by side."""
        return grouped(cells, plan.suite.chunk, workers=workers, by=lambda c: (c.fields["generator"], c.system))

    def start(self, job: Job) -> None:
        """Loads the world's kernels, which are compiled on first use."""
        load_world(job.device)

    def execute(self, cells: Sequence[Cell], job: Job) -> dict[str, dict[str, Any]]:
        """Runs one generator on the bases that the system survives."""
        from ssad.drivers import make_system
        from ssad.scenarios.dynamic import scenario_from
        from ssad.scenarios.dynamic.generate import Trials, generator_factory, search

        system, spec = cells[0].system, cells[0].spec
        trials = Trials(lambda: make_system(system), make_system, device=job.device)
        bases = {}
        for cell in cells:
            scenario = scenario_from(cell.spec["scenario"])
            bases[cell.key] = trials.base(scenario, town(scenario.town), seed=cell.seed)
        factory = generator_factory(spec["generator"])
        alive: list[Cell] = []
        results: dict[str, dict[str, Any]] = {}
        for cell in cells:
            refused = refusal(factory, bases[cell.key].episode)
            survived = bases[cell.key].trace.end != "collision"
            if survived and not refused:
                alive.append(cell)
                continue
            metrics: dict[str, Any] = {"applies": not refused, "survived": survived}
            results[cell.key] = {"metrics": metrics, "case": motion_hash(bases[cell.key].trace), "refused": refused}
        if not alive:
            return results
        began = time.process_time()
        chosen = [bases[cell.key] for cell in alive]
        generator = factory(chosen, seeds=[cell.seed for cell in alive], budget=spec["budget"])
        clock: dict[int, float] = {}  # rollouts of each base -> s for all bases
        outcomes = search(
            generator, chosen, trials, budget=spec["budget"], batch=spec["batch"],
            after=lambda asked: clock.update({asked: time.process_time() - began}),
        )  # fmt: skip
        usual = reference(job.folder, job.device)
        for cell, base, row in zip(alive, chosen, outcomes, strict=True):
            about = self._save(cell, base, row, trials, job.folder)
            metrics = {
                "applies": True,
                "survived": True,
                **summary(row),
                **about.pop("metrics"),
                **likeness(row, base.graph, usual),
            }
            metrics["seconds"] = max(clock.values()) / len(alive)
            spent = [s for asked, s in clock.items() if metrics["CR"] and asked >= metrics["rollouts"]]
            metrics["seconds_first"] = min(spent, default=math.nan) / len(alive)
            results[cell.key] = {**about, "metrics": plain(metrics), "case": cell.key, "n": len(row)}
        return results

    def _save(self, cell: Cell, base: Base, row: Sequence[Outcome], trials: Any, folder: Path) -> dict[str, Any]:
        """Writes the most distinct collisions as scenarios, drives each again, and keeps the trace of the first."""
        from ssad.scenarios.dynamic import save_scenarios
        from ssad.scenarios.dynamic.generate import scenario_of

        found = distinct([outcome for outcome in row if outcome.valid])[: cell.spec["keep"]]
        if not found:
            return {"metrics": {"replayed": None}}
        mark = f"-{cell.spec['repetition']}" if cell.spec["repetition"] else ""
        made = [
            scenario_of(o, base, name=f"{base.scenario.name}/{cell.spec['generator']}{mark}-{n}")
            for n, o in enumerate(found)
        ]
        # with another seed: what is saved must not depend on one
        seed = cell.seed + 1
        again = [trials.base(scenario, base.graph, seed=seed) for scenario in made]
        hits = [one.trace.end == "collision" for one in again]
        artefacts = {"scenarios": f"found/{cell.key}.yaml", "trace": f"traces/{cell.key}.npz"}
        save_scenarios(folder / artefacts["scenarios"], made)
        assert found[0].trace is not None
        save_trace(folder / artefacts["trace"], found[0].trace)
        return {
            "artefacts": artefacts, "adversaries": list(found[0].adversaries),
            "metrics": {"replayed": float(np.mean(hits))}
            | (grades([one for one, hit in zip(again, hits, strict=True) if hit], trials.device)
               if cell.spec.get("grade", True) else {}),
            "transfer": transfer(cell.spec.get("transfer", []), base, made, trials.device, seed=seed),
        }  # fmt: skip


def grades(collisions: Sequence[Base], device: str) -> dict[str, float]:
    """Shares of collisions that each careful driver, any of them, and the kinematic limit avoid; {} without any."""
    if not collisions:
        return {}
    rows = [grade_of(base.episode, base.trace, device).metrics() for base in collisions]
    careful = [any(row[f"avoided_by_{name}"] for name in AVOIDERS if name != "limit") for row in rows]
    moving = [fine for fine, base in zip(careful, collisions, strict=True) if _moves(base)]
    shares = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    shares["attributable"] = float(np.mean(careful))
    return shares | ({"attributable_moving": float(np.mean(moving))} if moving else {})


def _moves(base: Base) -> bool:
    """Whether the ego moves when it is hit."""
    return abs(float(base.trace.speed[int(np.flatnonzero(base.trace.contact)[0]), 0])) > MOVING


def transfer(
    systems: Sequence[str], base: Base, made: Sequence[Scenario], device: str, *, seed: int
) -> dict[str, dict[str, float]]:
    """How other systems fare in what was found against one.

    Args:
        systems: The others.
        base: What was searched.
        made: What was found.
        device: Where the world computes.
        seed: Of the episodes.

    Returns:
        Name of a system -> `base`, whether it collides in the base, and `found`, the share of `made` in which it does.
    """
    from ssad.drivers import make_system
    from ssad.scenarios.dynamic.generate import Trials

    rows = {}
    for name in systems:
        trials = Trials(partial(make_system, name), make_system, device=device)
        hits = [
            float(trials.base(scenario, base.graph, seed=seed).trace.end == "collision")
            for scenario in (base.scenario, *made)
        ]
        rows[name] = {"base": hits[0], "found": float(np.mean(hits[1:]))}
    return rows


def refusal(factory: Any, episode: Episode) -> str:
    """Why a generator has nothing to change in an episode; "": it has."""
    check = getattr(factory, "check", None)
    try:
        if check is not None:
            check(episode)
    except ConfigError as error:
        return str(error)
    return ""
