"""`ssad train driver`: a driving system by reinforcement learning, from scenarios to weights with a card."""

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
from ssad.training.recipe import set_words
from ssad.training.reinforcement import (
    LEARNINGS,
    Say,
    begin_with,
    find_learning,
    finish,
    learn,
    make_model,
    require,
)
from ssad.world.env import VectorEnv, reward_of
from ssad.world.policy import Policy, PolicyDriver
from ssad.world.roads import load_town
from ssad.world.rollout import rollout
from ssad.world.world import World

VALIDATION_SEED = 1_000_003  # draws of the training scenarios that no training sees
MOST_VALIDATION = 96


@dataclass(frozen=True, slots=True)
class DriverPlan:
    """A training run.

    Attributes:
        algorithm: ppo, sac or td3.
        out: Folder to write to.
        scenarios: What to learn from, as `load_scenarios` takes it.
        test: What the weights are measured on in the end.
        changes: Changed values of the recipe.
        seconds: Time limit, s; None: none.
        device: Where the networks are trained.
        start: Folder of an earlier training with the same algorithm, whose networks are trained further.
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


def find_scenarios(refs: Sequence[str]) -> tuple[list[Scenario], dict[str, LaneGraph]]:
    """The scenarios of some sets and files, each once, and the lane graphs of their towns."""
    found = list({s.name: s for ref in refs for s in load_scenarios(ref)}.values())
    return found, {name: _town(name) for name in sorted({s.town for s in found})}


def draw_episodes(
    scenarios: Sequence[Scenario], graphs: Mapping[str, LaneGraph], *, draws: int, seed: int
) -> list[Episode]:
    """Episodes of scenarios: of each the nominal one, and draws of natural spread; draws without room are left out.

    Raises:
        RouteError: A nominal scenario cannot be built.
        ConfigError: There are no scenarios.
    """
    if not scenarios:
        raise ConfigError("there is no scenario to learn from")
    found = []
    for draw in range(draws):
        for scenario in scenarios:
            try:
                spread = 1.0 if draw else 0.0
                found.append(build_episode(scenario, graphs[scenario.town], seed=seed + draw, spread=spread))
            except RouteError:
                if draw == 0:
                    raise
    return found


def measure(driver: Driver, episodes: Sequence[Episode], graphs: Mapping[str, LaneGraph]) -> dict[str, float]:
    """Collision rate CR, route completion RC and share off the road OF of a driver in episodes."""
    rows = []
    for first in range(0, len(episodes), 64):
        world = World(episodes[first : first + 64], graphs)
        rows += [episode_metrics(trace) for trace in rollout(world, driver, policies=make_system)]
    off = [row.off_road / row.driven if row.driven else 0.0 for row in rows]
    count = len(rows)
    return {
        "CR": sum(row.collision for row in rows) / count,
        "RC": sum(row.route_completion for row in rows) / count,
        "OF": sum(off) / count,
    }


def run_driver_training(plan: DriverPlan, *, say: Say = print) -> Iterator[str]:
    """Train a driver, and write OUT/ALGORITHM.safetensors with its card, log.jsonl and curves.png.

    Args:
        plan: What to train.
        say: Called with a line about progress.

    Yields:
        Lines about what was written.

    Raises:
        ConfigError: The plan is not valid, or the training diverged.
        FormatError: An interrupted training is broken or another one.
    """
    learning = find_learning(LEARNINGS, plan.algorithm, dict(plan.changes))
    require()
    safeio.make_folder(plan.out)
    torch.set_num_threads(1)  # networks this small lose by a second thread
    reward = reward_of(learning.reward)
    scenarios, graphs = find_scenarios(plan.scenarios)
    for ref in plan.test:
        find_scenarios([ref])
    episodes = draw_episodes(scenarios, graphs, draws=learning.draws, seed=0)
    say(f"{len(episodes)} episodes of {len(scenarios)} scenarios in {', '.join(graphs)}")
    from ssad.world.sb3 import SB3VecEnv

    env = VectorEnv(
        episodes,
        graphs,
        learning.scenes,
        observation=learning.observation,  # type: ignore[arg-type]
        action=learning.action,  # type: ignore[arg-type]
        reward=lambda state: learning.reward_scale * reward(state),
        policies=make_system,
    )
    model = make_model(learning, SB3VecEnv(env), device=plan.device)
    begun = "" if plan.start is None else begin_with(model, learning, plan.start)
    held = draw_episodes(scenarios, graphs, draws=2, seed=VALIDATION_SEED)[len(scenarios) :]
    held = held[:: max(len(held) // MOST_VALIDATION, 1)]

    def validate(policy: Policy) -> dict[str, float]:
        found = measure(PolicyDriver(policy, name="candidate"), held, graphs)
        return found | {"score": found["RC"] - found["CR"] - 2.0 * found["OF"]}

    keys = (safeio.dump_json([e.key, e.seed]) for e in episodes)
    about = digest("driver training", *keys, *([begun] if begun else []))[:16]
    state = learn(
        model,
        learning,
        plan.out,
        validate=validate,
        say=say,
        seconds=plan.seconds,
        about=about,
    )
    if state["steps"] < learning.steps:
        say(f"stopped after {state['steps']} of {learning.steps} steps; run it again to go on")
    data = f"{', '.join(plan.scenarios)}: {len(scenarios)} scenarios in {', '.join(graphs)}"
    path = plan.out / f"{plan.algorithm}.safetensors"
    yield finish(path, learning, model, state=state, data=data, command=command_of(plan), test=measure_all(plan.test))


def measure_all(refs: Sequence[str]) -> Callable[[Driver], dict[str, float]]:
    """A function that measures a driver on the nominal episodes of some sets, as `SET_CR`, `SET_RC` and `SET_OF`."""

    def found(driver: Driver) -> dict[str, float]:
        metrics: dict[str, float] = {}
        for ref in refs:
            scenarios, graphs = find_scenarios([ref])
            measured = measure(driver, draw_episodes(scenarios, graphs, draws=1, seed=0), graphs)
            metrics |= {f"{Path(ref).stem}_{name}": round(value, 4) for name, value in measured.items()}
        return metrics

    return found


def command_of(plan: DriverPlan) -> str:
    """The command that trains this anew."""
    words = ["ssad", "train", "driver", plan.algorithm]
    if plan.scenarios != ("training",):
        words += ["--scenarios", ",".join(plan.scenarios)]
    if plan.test != ("precrash", "natural"):
        words += ["--test", ",".join(plan.test)]
    if plan.start is not None:
        words += ["--start", str(plan.start)]
    return shlex.join([*words, *set_words(plan.changes)])
