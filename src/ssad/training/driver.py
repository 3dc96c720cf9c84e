"""`ssad train driver`: reinforcement learning of a driving system, from scenarios to weights with a card."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch

from ssad.core import safeio
from ssad.core.driving import Driver
from ssad.core.errors import ConfigError, RouteError
from ssad.core.lane_graph import LaneGraph
from ssad.core.seeding import digest
from ssad.core.types import Episode, Scenario
from ssad.drivers import make_system
from ssad.metrics import episode_metrics
from ssad.scenarios.dynamic import build_episode, load_scenarios
from ssad.training.recipe import command_line_changes
from ssad.training.reinforcement import (
    POLICY_RECIPES,
    Say,
    find_policy_recipe,
    finish,
    import_sb3,
    load_start_networks,
    make_model,
    train_policy,
)
from ssad.world.env import VectorEnv, reward_of
from ssad.world.policy import Policy, PolicyDriver
from ssad.world.roads import load_town
from ssad.world.rollout import rollout
from ssad.world.world import World

VALIDATION_SEED = 1_000_003  # seed of validation draws, disjoint from those of training
MOST_VALIDATION = 96


@dataclass(frozen=True, slots=True)
class DriverPlan:
    """Plan of a driver training.

    Attributes:
        algorithm: ppo, sac or td3.
        out: Folder to write to.
        scenarios: Training scenarios, as for `load_scenarios`.
        test: Scenarios of the final test.
        changes: Changed values of the recipe.
        seconds: Time limit, s; None: none.
        device: Device of the networks.
        start: Folder of an earlier training with the same algorithm, whose networks are the start.
    """

    algorithm: str
    out: Path
    scenarios: tuple[str, ...] = ("training",)
    test: tuple[str, ...] = ("precrash", "natural")
    changes: tuple[tuple[str, Any], ...] = ()
    seconds: float | None = None
    device: str = "cpu"
    start: Path | None = None


@lru_cache(maxsize=16)
def _town(name: str) -> LaneGraph:
    return load_town(name)


def find_scenarios(references: Sequence[str]) -> tuple[list[Scenario], dict[str, LaneGraph]]:
    """The scenarios of some sets and files, each once, and the lane graphs of their towns."""
    scenarios = list(
        {scenario.name: scenario for reference in references for scenario in load_scenarios(reference)}.values()
    )
    return scenarios, {town: _town(town) for town in sorted({scenario.town for scenario in scenarios})}


def natural_scenarios(references: Sequence[str]) -> tuple[list[Scenario], dict[str, LaneGraph]]:
    """The scenarios of some sets that have background traffic, and the lane graphs of their towns."""
    scenarios, graphs = find_scenarios(references)
    with_traffic = [
        scenario for scenario in scenarios if scenario.type == "NaturalJunction" or scenario.traffic is not None
    ]
    return with_traffic, {name: graphs[name] for name in sorted({scenario.town for scenario in with_traffic})}


def draw_episodes(
    scenarios: Sequence[Scenario], graphs: Mapping[str, LaneGraph], *, draws: int, seed: int
) -> list[Episode]:
    """Build nominal episodes of scenarios and random draws of natural spread; draws without room are skipped.

    Raises:
        RouteError: A nominal scenario cannot be built.
        ConfigError: There is no scenario.
    """
    if not scenarios:
        raise ConfigError("there is no scenario to learn from")
    episodes = []
    for draw in range(draws):
        for scenario in scenarios:
            try:
                spread = 1.0 if draw else 0.0
                episodes.append(build_episode(scenario, graphs[scenario.town], seed=seed + draw, spread=spread))
            except RouteError:
                if draw == 0:
                    raise
    return episodes


def measure(driver: Driver, episodes: Sequence[Episode], graphs: Mapping[str, LaneGraph]) -> dict[str, float]:
    """Return collision rate CR, route completion RC and off-road share OF of a driver."""
    metrics = []
    for start in range(0, len(episodes), 64):
        world = World(episodes[start : start + 64], graphs)
        metrics += [episode_metrics(trace) for trace in rollout(world, driver, policies=make_system)]
    off_road_shares = [
        episode_metric.off_road / episode_metric.driven if episode_metric.driven else 0.0 for episode_metric in metrics
    ]
    episode_count = len(metrics)
    return {
        "CR": sum(episode_metric.collision for episode_metric in metrics) / episode_count,
        "RC": sum(episode_metric.route_completion for episode_metric in metrics) / episode_count,
        "OF": sum(off_road_shares) / episode_count,
    }


def run_driver_training(plan: DriverPlan, *, report: Say = print) -> Iterator[str]:
    """Train a driver, and write OUT/ALGORITHM.safetensors with its card, log.jsonl and curves.png.

    Args:
        plan: Plan of the training.
        report: Called with progress messages.

    Yields:
        Lines about what was written.

    Raises:
        ConfigError: The plan is not valid, or the training diverged.
        FormatError: The checkpoint is broken or belongs to another training.
    """
    learning = find_policy_recipe(POLICY_RECIPES, plan.algorithm, dict(plan.changes))
    import_sb3()
    safeio.make_folder(plan.out)
    torch.set_num_threads(1)  # a second thread slows down networks this small
    reward = reward_of(learning.reward)
    scenarios, graphs = find_scenarios(plan.scenarios)
    for reference in plan.test:
        find_scenarios([reference])
    episodes = draw_episodes(scenarios, graphs, draws=learning.draws, seed=0)
    report(f"{len(episodes)} episodes of {len(scenarios)} scenarios in {', '.join(graphs)}")
    from ssad.world.sb3 import SB3VecEnv

    environment = VectorEnv(
        episodes,
        graphs,
        learning.scenes,
        observation=learning.observation,  # type: ignore[arg-type]
        action=learning.action,  # type: ignore[arg-type]
        reward=lambda state: learning.reward_scale * reward(state),
        policies=make_system,
    )
    model = make_model(learning, SB3VecEnv(environment), device=plan.device)
    start_hash = "" if plan.start is None else load_start_networks(model, learning, plan.start)
    # The first draw is nominal and part of the training; only the second one is held out.
    validation_episodes = draw_episodes(scenarios, graphs, draws=2, seed=VALIDATION_SEED)[len(scenarios) :]
    validation_episodes = validation_episodes[:: max(len(validation_episodes) // MOST_VALIDATION, 1)]

    def validate(policy: Policy) -> dict[str, float]:
        metrics = measure(PolicyDriver(policy, name="candidate"), validation_episodes, graphs)
        return metrics | {"score": metrics["RC"] - metrics["CR"] - 2.0 * metrics["OF"]}

    episode_keys = (safeio.dump_json([episode.key, episode.seed]) for episode in episodes)
    fingerprint = digest("driver training", *episode_keys, *([start_hash] if start_hash else []))[:16]
    state = train_policy(
        model,
        learning,
        plan.out,
        validate=validate,
        report=report,
        seconds=plan.seconds,
        metadata=fingerprint,
    )
    if state["steps"] < learning.steps:
        report(f"stopped after {state['steps']} of {learning.steps} steps; run it again to go on")
    description = f"{', '.join(plan.scenarios)}: {len(scenarios)} scenarios in {', '.join(graphs)}"
    path = plan.out / f"{plan.algorithm}.safetensors"
    yield finish(
        path, learning, model, state=state, data=description, command=command_of(plan), test=measure_all(plan.test)
    )


def measure_all(references: Sequence[str]) -> Callable[[Driver], dict[str, float]]:
    """A function that measures a driver on the nominal episodes of some sets, as `SET_CR`, `SET_RC` and `SET_OF`."""

    def test_driver(driver: Driver) -> dict[str, float]:
        metrics: dict[str, float] = {}
        for reference in references:
            scenarios, graphs = find_scenarios([reference])
            set_metrics = measure(driver, draw_episodes(scenarios, graphs, draws=1, seed=0), graphs)
            metrics |= {f"{Path(reference).stem}_{name}": round(value, 4) for name, value in set_metrics.items()}
        return metrics

    return test_driver


def command_of(plan: DriverPlan) -> str:
    """Return the command that repeats the training."""
    arguments = ["ssad", "train", "driver", plan.algorithm]
    if plan.scenarios != ("training",):
        arguments += ["--scenarios", ",".join(plan.scenarios)]
    if plan.test != ("precrash", "natural"):
        arguments += ["--test", ",".join(plan.test)]
    if plan.start is not None:
        arguments += ["--start", str(plan.start)]
    return shlex.join([*arguments, *command_line_changes(plan.changes)])
