"""Generators by name, and the search loop, which owns the budget of rollouts, the seeds and the outcomes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from ssad.core.driving import (
    STEP,
    Choice,
    Driver,
    Policies,
    Selector,
    Sensor,
    WorldState,
    step_options,
    steps_per_trace_step,
    with_finer_steps,
)
from ssad.core.errors import ConfigError, MissingExtraError, SSADError
from ssad.core.generators import Base, Generator, GeneratorFactory, Outcome, Proposal
from ssad.core.lane_graph import LaneGraph
from ssad.core.registry import Reference, check_arguments, names, offered_names, resolve
from ssad.core.traces import merge_steps
from ssad.core.types import AgentKind, Bool, Controller, Episode, EpisodeTrace, Scenario
from ssad.scenarios.dynamic.episode import build_episode
from ssad.scenarios.dynamic.frozen import freeze_episode
from ssad.scenarios.dynamic.outcome import measure

_SEARCH = "ssad.scenarios.dynamic.search"
GENERATORS: dict[str, str] = {
    "random": f"{_SEARCH}.sampling:RandomSearch",
    "grid": f"{_SEARCH}.sampling:GridSearch",
    "halton": f"{_SEARCH}.sampling:HaltonSearch",
    "cma-es": f"{_SEARCH}.cma_es:CmaEs",
    "bayesian": f"{_SEARCH}.bayesian:Bayesian",
    "random-walk": f"{_SEARCH}.walk:RandomWalk",
    "forward-backward": f"{_SEARCH}.walk:ForwardBackward",
    "l2c": "ssad.scenarios.dynamic.policy.l2c:L2C",
    "adv-sim": "ssad.scenarios.dynamic.transition.adv_sim:AdvSim",
    "adv-traj": "ssad.scenarios.dynamic.transition.adv_traj:AdvTraj",
    "near-miss": "ssad.scenarios.dynamic.logged.near_miss:NearMisses",
    "king": "ssad.scenarios.dynamic.transition.king:King",
    "adv-ppo": "ssad.scenarios.dynamic.policy.adv_ppo:AdvPPO",
    "adv-ppo-paper": "ssad.scenarios.dynamic.policy.adv_ppo:PaperAdvPPO",
    "frea": "ssad.scenarios.dynamic.policy.adv_ppo:Frea",
    "adv-ddpg": "ssad.scenarios.dynamic.policy.adv_ppo:AdvDDPG",
    "cat": "ssad.scenarios.dynamic.transition.cat:Cat",
}
"""Name of a generator -> "module:object", a `GeneratorFactory`."""
FILE_GENERATORS = "ssad.generator_files"
"""Group of entry points of generators that read a file, named PREFIX:FILE, such as "scenic:brake.scenic".

Each is a function that takes FILE and returns a `GeneratorFactory`. Formats lie above scenarios in the order of
imports, so this module knows none of them.
"""
BATCH = 8  # rollouts of a base side by side
SCENES = 256  # episodes of one world
_STILL = 0.05  # m; an agent that moves less is no adversary


def generator_factory(name: str) -> GeneratorFactory:
    """Return the factory of a generator by name, entry point, PREFIX:FILE or "module:object".

    Args:
        name: Its name; arguments and a label may follow, as in "mine:Search?step=0.1@fine".

    Raises:
        MissingExtraError: It needs an extra that is not installed.
        UnknownNameError: No generator has that name; the message lists the closest ones.
        ConfigError: It cannot be imported, or cannot be called.
    """
    prefix, _, file = name.partition(":")
    if file and prefix in offered_names(FILE_GENERATORS):
        return cast(GeneratorFactory, resolve("generator_file", {}, prefix)(file))
    reference = Reference.parse(name)
    resolved = resolve("generator", GENERATORS, reference.name)
    if not callable(resolved):
        raise ConfigError(f"generator '{name}': expected a class or function (bases, *, seeds, budget)")
    if not reference.options:
        return cast(GeneratorFactory, resolved)
    check_arguments("generator", name, resolved, extra_arguments={"bases": (), "seeds": (), "budget": 0})
    return _WithArguments(resolved, reference.options)


class _WithArguments:
    """Factory of a generator with further arguments; its other attributes are those of the generator."""

    def __init__(self, factory: GeneratorFactory, arguments: Mapping[str, Any]) -> None:
        self._factory, self._arguments = factory, arguments
        self.__module__ = factory.__module__  # whose source is the version of the generator

    def __call__(self, bases: Sequence[Base], *, seeds: Sequence[int], budget: int) -> Generator:
        """Return a generator for some bases."""
        return self._factory(bases, seeds=seeds, budget=budget, **self._arguments)

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the generator, such as its method `check`."""
        return getattr(self._factory, name)


def generator_list() -> dict[str, str]:
    """Return the name of each available generator -> one line about it."""
    rows = {}
    for name, reference in names("generator", GENERATORS).items():
        try:
            summary = (generator_factory(name).__doc__ or "").strip() if name in GENERATORS else ""
        except MissingExtraError as error:
            summary = f"needs the extra {error.extra}"
        rows[name] = summary.partition("\n")[0].rstrip(".") or reference
    return rows


@dataclass(frozen=True)
class Trials:
    """Test bench of proposals: the driving system under test and its environment.

    Attributes:
        ego: Factory of the driving system under test, called once per batch.
        policies: Factory of the drivers that scenarios name.
        sensors: Sensors for drivers in addition to those of the world.
        device: cpu or cuda.
    """

    ego: Callable[[], Driver]
    policies: Policies | None = None
    sensors: Mapping[str, Sensor] = field(default_factory=dict)
    device: str = "cpu"

    def base(self, scenario: Scenario, graph: LaneGraph, *, seed: int) -> Base:
        """Drive an unchanged scenario once; see `bases`."""
        return self.bases([(scenario, graph, seed)])[0]

    def bases(self, scenarios: Sequence[tuple[Scenario, LaneGraph, int]]) -> list[Base]:
        """Drive unchanged scenarios once, each in its town and with its seed, side by side.

        Raises:
            SSADError: A scenario cannot be built or driven.
        """
        driven_traces: list[Base] = []
        for start in range(0, len(scenarios), SCENES):
            chunk = scenarios[start : start + SCENES]
            episodes = [build_episode(scenario, graph, seed=seed) for scenario, graph, seed in chunk]
            traces, _ = self._drive(episodes, {scenario.town: graph for scenario, graph, _ in chunk}, {})
            chunk_rows = zip(episodes, chunk, traces, strict=True)
            driven_traces += [Base(episode, graph, trace) for episode, (_, graph, _), trace in chunk_rows]
        return driven_traces

    def run(self, proposals: Sequence[tuple[Base, Proposal]]) -> list[Outcome]:
        """Drive proposals, each in its base's town and with its seed; a proposal that cannot be built fails."""
        outcomes: dict[int, Outcome] = {}
        proposals_by_drivers: dict[int, list[tuple[int, Episode]]] = {}
        for proposal_index, (base, proposal) in enumerate(proposals):
            try:
                episode = build_episode(proposal.scenario, base.graph, seed=base.episode.seed)
            except SSADError as error:
                outcomes[proposal_index] = Outcome(proposal, failure=str(error))
                continue
            # Scenes of one world share their drivers, so proposals are grouped by them.
            group_key = id(proposal.drivers) if proposal.drivers else 0
            proposals_by_drivers.setdefault(group_key, []).append((proposal_index, episode))
        for members in proposals_by_drivers.values():
            for start in range(0, len(members), SCENES):
                chunk = members[start : start + SCENES]
                drivers = proposals[chunk[0][0]][1].drivers
                graphs = {episode.town: proposals[proposal_index][0].graph for proposal_index, episode in chunk}
                traces, takeovers = self._drive([episode for _, episode in chunk], graphs, drivers)
                for (proposal_index, episode), trace, taken_over in zip(chunk, traces, takeovers, strict=True):
                    base, proposal = proposals[proposal_index]
                    adversary_indices = _adversaries(proposal, episode, trace, taken_over)
                    outcomes[proposal_index] = measure(proposal, trace, base.graph, adversary_indices)
        return [outcomes[proposal_index] for proposal_index in range(len(proposals))]

    def _drive(
        self, episodes: Sequence[Episode], graphs: Mapping[str, LaneGraph], drivers: Mapping[Selector, Driver]
    ) -> tuple[list[EpisodeTrace], npt.NDArray[np.bool_]]:
        """Return traces of episodes, and [B, A] the agents that one of the drivers ever took over."""
        from ssad.world.rollout import rollout
        from ssad.world.world import World

        ego = self.ego()
        steps_in_one = steps_per_trace_step(ego)
        if steps_in_one > 1 and drivers:
            raise ConfigError(
                f"system {ego.name} decides every {STEP / steps_in_one:g} s, and learned adversaries every {STEP:g} s: "
                "they cannot drive side by side; search with another generator, such as random"
            )
        finer_episodes = with_finer_steps(episodes, steps_in_one)
        world = World(finer_episodes, graphs, device=self.device, **step_options(steps_in_one))
        taken_over = np.zeros((world.batch, world.agents), bool)

        def recording_selector(selector: Selector) -> Selector:
            def choose(state: WorldState) -> Bool | Choice:
                choice = selector(state)
                selected = choice.agents if isinstance(choice, Choice) else np.asarray(choice, bool)
                np.logical_or(taken_over, selected, out=taken_over)
                return choice

            return choose

        driver_of: dict[int | Selector, Driver] = {0: ego}
        driver_of |= {recording_selector(selector): driver for selector, driver in drivers.items()}
        traces = rollout(world, driver_of, sensors=self.sensors, policies=self.policies)
        return [merge_steps(trace, steps_in_one) for trace in traces], taken_over


def _adversaries(proposal: Proposal, episode: Episode, trace: EpisodeTrace, taken_over: Bool) -> list[int]:
    """Return the indices of the agents that count as adversaries."""
    adversaries = {agent_index for agent_index in range(1, len(episode.agents)) if taken_over[agent_index]}
    adversaries |= {
        agent_index
        for agent_index, agent in enumerate(episode.agents)
        if agent_index and agent.name in proposal.adversaries
    }
    if not proposal.adversaries and not proposal.drivers:
        motion_extent = np.hypot(np.ptp(trace.x, axis=0), np.ptp(trace.y, axis=0))
        scripted = [agent.controller != Controller.NONE for agent in episode.agents]
        mobile = (trace.kind != AgentKind.PROP) & (np.asarray(scripted) | (motion_extent > _STILL))
        adversaries |= set(np.flatnonzero(mobile).tolist()) - {0}
    return sorted(adversaries)


def search(
    generator: Generator,
    bases: Sequence[Base],
    trials: Trials,
    *,
    budget: int,
    batch: int = BATCH,
    known_outcomes: Sequence[Sequence[Outcome]] = (),
    on_batch_end: Callable[[int], None] = lambda requested: None,
) -> list[list[Outcome]]:
    """Run a generator until each base has used its budget or no more proposals come.

    Args:
        generator: A new generator.
        bases: The B bases of the generator.
        trials: Test bench that drives the proposals.
        budget: Rollouts of each base.
        batch: Rollouts of each base per round.
        known_outcomes: Outcomes of each base from an interrupted search; these are not driven again.
        on_batch_end: Called after each round with the number of rollouts requested for each base so far.

    Returns:
        For each base its outcomes, in the order in which they were proposed.

    Raises:
        ConfigError: The generator deviates from the known outcomes, exceeds the batch, or omits a base.
    """
    collected: list[list[Outcome]] = [[] for _ in bases]
    known_outcomes = known_outcomes or [[] for _ in bases]
    requested = 0
    while requested < budget:
        batch_size = min(batch, budget - requested)
        proposals = [list(base_proposals) for base_proposals in generator.ask(batch_size)]
        if len(proposals) != len(bases) or any(len(base_proposals) > batch_size for base_proposals in proposals):
            raise ConfigError(
                f"generator {generator.name}: expected up to {batch_size} proposals for each of {len(bases)} bases, "
                f"not {[len(base_proposals) for base_proposals in proposals]}"
            )
        if not any(proposals):
            break
        # A generator may want fewer at once than the batch has room for; that costs none of its budget.
        requested += max(map(len, proposals))
        # A resumed search replays known outcomes, so the generator reaches the same state.
        batch_outcomes = [
            list(
                known_outcomes[base_index][
                    len(collected[base_index]) : len(collected[base_index]) + len(base_proposals)
                ]
            )
            for base_index, base_proposals in enumerate(proposals)
        ]
        for base_index, base_proposals in enumerate(proposals):
            for outcome, proposal in zip(batch_outcomes[base_index], base_proposals, strict=False):
                if outcome.proposal.scenario != proposal.scenario:
                    raise ConfigError(
                        f"generator {generator.name}: what is known of "
                        f"{bases[base_index].scenario.name} is of another search; "
                        "start anew"
                    )
        missing = [
            (base_index, pending)
            for base_index, base_proposals in enumerate(proposals)
            for pending in base_proposals[len(batch_outcomes[base_index]) :]
        ]
        for (base_index, _), outcome in zip(
            missing, trials.run([(bases[base_index], pending) for base_index, pending in missing]), strict=True
        ):
            batch_outcomes[base_index].append(outcome)
        generator.tell(batch_outcomes)
        for base_index, outcomes in enumerate(batch_outcomes):
            collected[base_index] += outcomes
        on_batch_end(requested)
    return collected


def scenario_of(outcome: Outcome, base: Base, *, name: str) -> Scenario:
    """Return the outcome of a proposal as a scenario that replays without the generator.

    A proposal of parameters is returned unchanged. With random traffic, or with drivers that take agents over, all
    agents but the ego repeat the recording.

    Args:
        outcome: Outcome of a driven proposal.
        base: Its base.
        name: Name of the new scenario.

    Returns:
        The scenario.

    Raises:
        ConfigError: The proposal failed.
    """
    if outcome.trace is None:
        raise ConfigError(f"{name}: a proposal that failed is no scenario: {outcome.failure}")
    episode = build_episode(outcome.proposal.scenario, base.graph, seed=base.episode.seed)
    if outcome.proposal.drivers or episode.scenario.traffic is not None:
        return freeze_episode(episode, outcome.trace, name=name)
    source = f"{base.scenario.name}, seed {base.episode.seed}"
    return replace(outcome.proposal.scenario, name=name, source=source)
