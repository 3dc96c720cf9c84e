"""Generators by name, and the loop that runs one: it owns the budget of rollouts, the seeds, and what is known."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.util import find_spec
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from ssad.core.driving import Choice, Driver, Policies, Selector, Sensor, WorldState
from ssad.core.errors import ConfigError, MissingExtraError, SSADError
from ssad.core.generators import Base, Generator, GeneratorFactory, Outcome, Proposal
from ssad.core.lane_graph import LaneGraph
from ssad.core.registry import names, resolve
from ssad.core.types import AgentKind, Bool, Controller, Episode, EpisodeTrace, Scenario
from ssad.scenarios.dynamic.episode import build_episode
from ssad.scenarios.dynamic.frozen import frozen
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
    "king": "ssad.scenarios.dynamic.transition.kinematics:King",
    "adv-ppo": "ssad.scenarios.dynamic.policy.adv_ppo:AdvPPO",
    "frea": "ssad.scenarios.dynamic.policy.adv_ppo:Frea",
    "adv-ddpg": "ssad.scenarios.dynamic.policy.adv_ppo:AdvDDPG",
    "cat": "ssad.scenarios.dynamic.transition.trajectory:Cat",
}
"""Name of a generator -> "module:object", a `GeneratorFactory`."""
SCENIC = "scenic:"
"""scenic:FILE.scenic is a generator that samples a Scenic program."""
_PROGRAMS = {SCENIC: "ssad.interchange.scenic_programs:ScenicSearch"}
BATCH = 8  # rollouts of a base side by side
SCENES = 256  # episodes of one world
_STILL = 0.05  # m; who moves less in an episode is no adversary


def generator_factory(name: str) -> GeneratorFactory:
    """What makes the generators of a name, an entry point or "module:object".

    Raises:
        UnknownNameError: There is none of that name; the message has the closest ones.
        ConfigError: It cannot be imported, or cannot be called.
    """
    if name.startswith(SCENIC):
        if find_spec("scenic") is None:
            raise MissingExtraError(f"generator '{name}'", "scenic")
        return partial(cast(Any, resolve("generator", _PROGRAMS, SCENIC)), name.removeprefix(SCENIC))
    found = resolve("generator", GENERATORS, name)
    if not callable(found):
        raise ConfigError(f"generator '{name}': expected a class or function (bases, *, seeds, budget)")
    return cast(GeneratorFactory, found)


def generator_list() -> dict[str, str]:
    """Name of each generator that can be asked for -> what it does, in a line."""
    rows = {}
    for name, where in names("generator", GENERATORS).items():
        try:
            about = (generator_factory(name).__doc__ or "").strip() if name in GENERATORS else ""
        except MissingExtraError as error:
            about = f"needs the extra {error.extra}"
        rows[name] = about.partition("\n")[0].rstrip(".") or where
    return rows


@dataclass(frozen=True)
class Trials:
    """Where proposals are driven: by which system, with what.

    Attributes:
        ego: Makes the driving system under test, a new one at each call.
        policies: Makes the drivers that scenarios name.
        sensors: What drivers may ask for besides those of the world.
        device: cpu or cuda.
    """

    ego: Callable[[], Driver]
    policies: Policies | None = None
    sensors: Mapping[str, Sensor] = field(default_factory=dict)
    device: str = "cpu"

    def base(self, scenario: Scenario, graph: LaneGraph, *, seed: int) -> Base:
        """A scenario as it is, driven once; see `bases`."""
        return self.bases([(scenario, graph, seed)])[0]

    def bases(self, scenarios: Sequence[tuple[Scenario, LaneGraph, int]]) -> list[Base]:
        """Scenarios as they are, each in its town and with its seed, driven once, side by side.

        Raises:
            SSADError: One cannot be built or driven.
        """
        found: list[Base] = []
        for start in range(0, len(scenarios), SCENES):
            part = scenarios[start : start + SCENES]
            episodes = [build_episode(scenario, graph, seed=seed) for scenario, graph, seed in part]
            traces, _ = self._drive(episodes, {scenario.town: graph for scenario, graph, _ in part}, {})
            rows = zip(episodes, part, traces, strict=True)
            found += [Base(episode, graph, trace) for episode, (_, graph, _), trace in rows]
        return found

    def run(self, proposals: Sequence[tuple[Base, Proposal]]) -> list[Outcome]:
        """Drive proposals, each in its base's town and with its seed; what cannot be built is a failed outcome."""
        outcomes: dict[int, Outcome] = {}
        groups: dict[int, list[tuple[int, Episode]]] = {}
        for k, (base, proposal) in enumerate(proposals):
            try:
                episode = build_episode(proposal.scenario, base.graph, seed=base.episode.seed)
            except SSADError as error:
                outcomes[k] = Outcome(proposal, failure=str(error))
                continue
            group = id(proposal.drivers) if proposal.drivers else 0
            groups.setdefault(group, []).append((k, episode))
        for members in groups.values():
            for start in range(0, len(members), SCENES):
                part = members[start : start + SCENES]
                drivers = proposals[part[0][0]][1].drivers
                graphs = {episode.town: proposals[k][0].graph for k, episode in part}
                traces, taken = self._drive([episode for _, episode in part], graphs, drivers)
                for (k, episode), trace, had in zip(part, traces, taken, strict=True):
                    base, proposal = proposals[k]
                    who = _adversaries(proposal, episode, trace, had)
                    outcomes[k] = measure(proposal, trace, base.graph, who)
        return [outcomes[k] for k in range(len(proposals))]

    def _drive(
        self, episodes: Sequence[Episode], graphs: Mapping[str, LaneGraph], drivers: Mapping[Selector, Driver]
    ) -> tuple[list[EpisodeTrace], npt.NDArray[np.bool_]]:
        """Traces of episodes, and [B, A] who was ever taken over by one of the drivers."""
        from ssad.world.rollout import rollout
        from ssad.world.world import World

        world = World(episodes, graphs, device=self.device)
        taken = np.zeros((world.batch, world.agents), bool)

        def watched(selector: Selector) -> Selector:
            def choose(state: WorldState) -> Bool | Choice:
                choice = selector(state)
                chosen = choice.agents if isinstance(choice, Choice) else np.asarray(choice, bool)
                np.logical_or(taken, chosen, out=taken)
                return choice

            return choose

        who: dict[int | Selector, Driver] = {0: self.ego()}
        who |= {watched(selector): driver for selector, driver in drivers.items()}
        return rollout(world, who, sensors=self.sensors, policies=self.policies), taken


def _adversaries(proposal: Proposal, episode: Episode, trace: EpisodeTrace, taken: Bool) -> list[int]:
    """Numbers of the agents that count as adversaries."""
    found = {k for k in range(1, len(episode.agents)) if taken[k]}
    found |= {k for k, agent in enumerate(episode.agents) if k and agent.name in proposal.adversaries}
    if not proposal.adversaries and not proposal.drivers:
        span = np.hypot(np.ptp(trace.x, axis=0), np.ptp(trace.y, axis=0))
        scripted = [agent.controller != Controller.NONE for agent in episode.agents]
        mobile = (trace.kind != AgentKind.PROP) & (np.asarray(scripted) | (span > _STILL))
        found |= set(np.flatnonzero(mobile).tolist()) - {0}
    return sorted(found)


def search(
    generator: Generator,
    bases: Sequence[Base],
    trials: Trials,
    *,
    budget: int,
    batch: int = BATCH,
    known: Sequence[Sequence[Outcome]] = (),
    after: Callable[[int], None] = lambda asked: None,
) -> list[list[Outcome]]:
    """Run a generator until each base has used its budget, or nothing more is proposed.

    Args:
        generator: The generator, not asked before.
        bases: The B bases that it was made for.
        trials: Where its proposals are driven.
        budget: Rollouts of each base.
        batch: Rollouts of each base that it is asked for at once.
        known: Outcomes of each base from a search that was cut short; these are told and not driven again.
        after: Called after each round with the rollouts that each base has been asked for so far.

    Returns:
        For each base its outcomes, in the order in which they were proposed.

    Raises:
        ConfigError: The generator proposes something else than what is known, or more than it may, or not for each
            base.
    """
    found: list[list[Outcome]] = [[] for _ in bases]
    known = known or [[] for _ in bases]
    asked = 0
    while asked < budget:
        count = min(batch, budget - asked)
        asked += count
        proposals = [list(row) for row in generator.ask(count)]
        if len(proposals) != len(bases) or any(len(row) > count for row in proposals):
            raise ConfigError(
                f"generator {generator.name}: expected up to {count} proposals for each of {len(bases)} bases, "
                f"not {[len(row) for row in proposals]}"
            )
        if not any(proposals):
            break
        told = [list(known[b][len(found[b]) : len(found[b]) + len(row)]) for b, row in enumerate(proposals)]
        for b, row in enumerate(proposals):
            for outcome, proposal in zip(told[b], row, strict=False):
                if outcome.proposal.scenario != proposal.scenario:
                    raise ConfigError(
                        f"generator {generator.name}: what is known of {bases[b].scenario.name} is of another search; "
                        "start anew"
                    )
        missing = [(b, p) for b, row in enumerate(proposals) for p in row[len(told[b]) :]]
        for (b, _), outcome in zip(missing, trials.run([(bases[b], p) for b, p in missing]), strict=True):
            told[b].append(outcome)
        generator.tell(told)
        for b, outcomes in enumerate(told):
            found[b] += outcomes
        after(asked)
    return found


def scenario_of(outcome: Outcome, base: Base, *, name: str) -> Scenario:
    """What a proposal has come to, as a scenario that can be saved and replays without the generator.

    A proposal of parameters stays one. With random traffic, or with drivers that take agents over, everybody but the
    ego repeats what happened.

    Args:
        outcome: Of a proposal that was driven.
        base: Its base.
        name: Of the scenario.

    Returns:
        The scenario.

    Raises:
        ConfigError: The proposal failed.
    """
    if outcome.trace is None:
        raise ConfigError(f"{name}: a proposal that failed is no scenario: {outcome.failure}")
    episode = build_episode(outcome.proposal.scenario, base.graph, seed=base.episode.seed)
    if outcome.proposal.drivers or episode.scenario.traffic is not None:
        return frozen(episode, outcome.trace, name=name)
    source = f"{base.scenario.name}, seed {base.episode.seed}"
    return replace(outcome.proposal.scenario, name=name, source=source)
