"""Kind `how-often`: how often a driving system fails where traffic has chance in it, by several estimators."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Annotated, Any, Literal

from pydantic import Field

from ssad.core.errors import ConfigError
from ssad.core.machine import start_warp_quietly
from ssad.core.run_records import NOT_NEGATIVE
from ssad.core.safeio import to_plain_json
from ssad.core.schema import Schema
from ssad.core.traces import save_trace
from ssad.core.types import EpisodeTrace, Scenario
from ssad.engine.kind import Cell, Column, Job, Names, Plan
from ssad.experiments.how_often.failure_rate import METHODS, ChanceEpisode, Method, first_obstacle
from ssad.experiments.how_often.verdict import contradictions, unbranched, verdict, without_interval
from ssad.experiments.scenario_kind import ScenarioKind, ScenarioSuite, describe_scenarios
from ssad.report import default
from ssad.report.load import Run
from ssad.report.tables import Table
from ssad.simulators.closed_loop import cached_town, policies_of, system_of, system_version
from ssad.world.rare.branching import refusal

SETTINGS = ("episodes", "particles", "repeats", "components", "batch")  # of the estimators, as suites name them


class NoiseSuite(Schema):
    """Random behaviour of traffic: the parameters of `ssad.world.noise.Noise`.

    Attributes:
        accel: Standard deviation of the acceleration of background vehicles, m/s^2.
        accel_time: Time constant of that acceleration, s.
        lapse: Share of the time in which the ego leaves its pedals as they are.
        careless: Share of the time in which background vehicles change lanes without looking.
        choice_time: Time constant of lapses and carelessness, s: about how long they last.
    """

    accel: float = Field(default=0.0, ge=0.0, le=10.0)
    accel_time: float = Field(default=1.0, gt=0.0)
    lapse: float = Field(default=0.0, ge=0.0, le=0.5)
    careless: float = Field(default=0.0, ge=0.0, le=0.5)
    choice_time: float = Field(default=1.0, gt=0.0)


class HowOftenSuite(ScenarioSuite):
    """Failure probabilities: scenarios x systems x methods.

    Attributes:
        systems: Driving systems under test.
        noise: Random behaviour of traffic.
        methods: Estimators; each gets cells of its own. auto: all for systems whose episodes can branch
            (`ssad.core.driving.Branching`), monte-carlo alone for others.
        episodes: Episodes of Monte Carlo, and of importance sampling after it has learned.
        particles: Particles of each repeat of splitting, and of the splitting that a proposal is first learned from.
        repeats: Independent repeats of splitting; at least 8 for an interval.
        components: Components of the learned proposal.
        batch: Episodes side by side.
    """

    kind: Literal["how-often"] = "how-often"
    systems: Names
    noise: NoiseSuite = NoiseSuite()
    methods: Literal["auto"] | Annotated[list[Method], Field(min_length=1)] = "auto"
    episodes: int = Field(default=4000, ge=10)
    particles: int = Field(default=200, ge=10, le=100_000)
    repeats: int = Field(default=10, ge=1, le=1000)
    components: int = Field(default=4, ge=1, le=20)
    batch: int = Field(default=500, ge=1, le=1 << 21)


class HowOften(ScenarioKind):
    """Kind `how-often`: one estimate of a failure probability for each system, scenario and method."""

    name = "how-often"
    suite = HowOftenSuite
    factors = ("system", "group", "method")
    columns = (
        Column("per_million", "collisions in a million episodes", "", "lower", limits=NOT_NEGATIVE),
        Column("low", "lower 95 % limit"),
        Column("high", "upper 95 % limit"),
        Column("effective", "effective number of collisions", "", "higher", limits=NOT_NEGATIVE),
        Column("events", "collisions simulated", limits=NOT_NEGATIVE),
        Column("episodes", "episodes", limits=NOT_NEGATIVE),
        Column("work", "million agent-steps", limits=NOT_NEGATIVE),
        Column("training", "of these for learning", limits=NOT_NEGATIVE),
        Column("hours", "simulated", "h", limits=NOT_NEGATIVE),
        Column("km", "simulated", "km", limits=NOT_NEGATIVE),
        Column("per_hour", "collisions in 1,000 h", "", "lower", limits=NOT_NEGATIVE),
        Column("per_km", "collisions in 1,000 km", "", "lower", limits=NOT_NEGATIVE),
    )

    def plan(self, suite: HowOftenSuite, *, device: str = "cpu", check: bool = True) -> Plan:
        """Look up systems, scenarios and towns, and choose methods; with `check`, try each once.

        Raises:
            ConfigError: The input is wrong, or every cell has a method that needs branches and a system without.
        """
        systems = {name: system_version(name) for name in suite.systems}
        scenarios, towns = describe_scenarios(suite, [column.name for column in self.columns])
        settings = {"noise": suite.noise.model_dump()} | {name: getattr(suite, name) for name in SETTINGS}
        cells = tuple(
            self.scenario_cell(
                suite,
                entry,
                systems[system],
                title=f"{method}/{system}/{entry.scenario.name}",
                system=system,
                chance=("how often", method),
                fields={"method": method},
                method=method,
                **settings,
            )
            for system, entry in product(suite.systems, scenarios)
            for method in methods_of(suite, system, entry.scenario)
        )
        if check:
            for cell in cells:
                chance_of(cell, device).process(1)
            refused = [cell.spec["method"] != "monte-carlo" and chance_of(cell, device).obstacle() for cell in cells]
            if all(refused):
                raise ConfigError(refusal(str(refused[0])))
        return Plan(self, suite, device, cells, {"towns": towns, "systems": systems})

    def result(self, cell: Cell, job: Job) -> dict[str, Any]:
        """Estimate the probability; keep the likeliest collision."""
        start_warp_quietly()
        episode = chance_of(cell, job.device)
        metrics, crash = episode.estimate(cell.spec["method"], **{name: cell.spec[name] for name in SETTINGS})
        result: dict[str, Any] = {"metrics": to_plain_json(metrics), "case": cell.key, "n": metrics["episodes"]}
        if obstacle := episode.obstacle():
            result["obstacle"] = obstacle
        if crash is None:
            return result
        artefact = f"traces/{cell.key}.npz"
        save_trace(job.folder / artefact, episode.run_again(crash))
        return result | {"crash": crash, "artefacts": {"trace": artefact}}

    def drive_again(self, plan: Plan, cell: Cell, record: Mapping[str, Any]) -> EpisodeTrace:
        """Drive the stored collision again.

        Raises:
            ConfigError: There is none.
        """
        if "crash" not in record:
            raise ConfigError(f"cell {cell.key} ({cell.name}) has found no collision to replay")
        return chance_of(cell, plan.device).run_again(record["crash"])

    def verdict(self, run: Run) -> list[str]:
        """Return the findings of a run in sentences."""
        return verdict(run)

    def summary(self, run: Run) -> Table:
        """Return the main table.

        Its note says which methods contradict each other, which systems lack some, and why limits are missing.
        """
        notes = [*contradictions(run), *unbranched(run), *without_interval(run)]
        return replace(default.summary(run), note="\n".join(notes))


def methods_of(suite: HowOftenSuite, system: str, scenario: Scenario) -> Sequence[Method]:
    """Return the methods of a suite for a system in a scenario."""
    if suite.methods != "auto":
        return suite.methods
    drivers = [system_of(name) for name in (system, *policies_of(scenario))]
    return ("monte-carlo",) if first_obstacle(drivers) else METHODS


def chance_of(cell: Cell, device: str) -> ChanceEpisode:
    """Return the scenario of a cell, with its driver and its noise."""
    from ssad.scenarios.dynamic import build_episode, scenario_from

    scenario = scenario_from(cell.spec["scenario"])
    graph = cached_town(scenario.town)
    episode = build_episode(scenario, graph, seed=scenario.seed)
    return ChanceEpisode(episode, graph, system_of(cell.system), cell.spec["noise"], device, cell.seed)
