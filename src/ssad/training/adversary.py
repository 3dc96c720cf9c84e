"""`ssad train adversary`: Adv.PPO, a policy that drives background vehicles into the ego's path, with its card."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from ssad.core import safeio
from ssad.core.driving import Driver
from ssad.core.errors import ConfigError, unknown_name
from ssad.core.generators import Base, Proposal
from ssad.core.seeding import digest
from ssad.core.types import Scenario
from ssad.drivers import make_system
from ssad.scenarios.dynamic.generate import Trials
from ssad.training.driver import VALIDATION_SEED, draw_episodes, find_scenarios
from ssad.training.recipe import command_line_changes
from ssad.training.reinforcement import (
    POLICY_RECIPES,
    PolicyRecipe,
    Say,
    find_policy_recipe,
    finish,
    make_model,
    train_policy,
)
from ssad.world.policy import Policy, PolicyDriver
from ssad.world.selection import FreaSelection

_SETTING: dict[str, Any] = {
    "observation": "adversary",
    "action": "adversary",
    "reward": "adversary",
    "draws": 6,
    "gamma": 0.98,
}
ADVERSARIES = {
    "adv-ppo": replace(
        POLICY_RECIPES["ppo"],
        steps=200_000,
        **_SETTING,
        lr=3e-4,
        noise=0.6,
        entropy=0.002,
        validate=50_000,
    )
}
ADVERSARIES |= {
    "frea": replace(ADVERSARIES["adv-ppo"], reward="feasible", steps=800_000, validate=250_000, seed=3),
    "adv-sac": replace(
        POLICY_RECIPES["sac"],
        steps=100_000,
        **_SETTING,
        lr=3e-4,
        batch=256,
        validate=25_000,
    ),
    "adv-ddpg": replace(
        POLICY_RECIPES["td3"],
        algorithm="ddpg",
        steps=100_000,
        **_SETTING,
        batch=256,
        validate=25_000,
    ),
    "adv-dqn": replace(
        POLICY_RECIPES["sac"],
        algorithm="dqn",
        steps=100_000,
        **_SETTING,
        lr=5e-4,
        batch=256,
        noise=0.05,
        validate=25_000,
    ),
}
"""How adversaries are trained."""
SCENARIOS = {"frea": ("training-lanes",)}
"""What they learn in unless told otherwise, where that is not the set `training`."""
REWARDS = ("adversary", "colliding", "feasible")
"""What they may learn from; see `ssad.training.adversary_env`."""


@dataclass(frozen=True, slots=True)
class AdversaryPlan:
    """Plan of an adversary training.

    Attributes:
        algorithm: A name of `ADVERSARIES`.
        out: Folder to write to.
        ego: Driving system under attack.
        scenarios: Training scenarios with natural traffic; empty: the default of the algorithm (`SCENARIOS`, or
            `training`).
        test: Scenarios of the final test.
        literal: Use equation 6 as printed for the reward.
        off_road: Cost of each step of an adversary off the road (the paper and FREA: 0).
        changes: Changed values of the recipe.
        seconds: Time limit, s; None: none.
    """

    algorithm: str
    out: Path
    ego: str = "autopilot"
    scenarios: tuple[str, ...] = ()
    test: tuple[str, ...] = ("natural",)
    literal: bool = False
    off_road: float = 0.5
    changes: tuple[tuple[str, Any], ...] = ()
    seconds: float | None = None

    def learned_in(self) -> tuple[str, ...]:
        """Return the sets and files of the training."""
        return self.scenarios or SCENARIOS.get(self.algorithm, ("training",))


def natural_scenarios(references: Sequence[str]) -> tuple[list[Scenario], dict[str, Any]]:
    """The scenarios of some sets that have background traffic, and the lane graphs of their towns."""
    scenarios, graphs = find_scenarios(references)
    with_traffic = [
        scenario for scenario in scenarios if scenario.type == "NaturalJunction" or scenario.traffic is not None
    ]
    return with_traffic, {name: graphs[name] for name in sorted({scenario.town for scenario in with_traffic})}


def measure_adversary(
    driver: Driver | None, ego: str, scenarios: Sequence[Scenario], graphs: Any, *, seed: int, count: int = 1
) -> dict[str, float]:
    """Measure the effect of adversaries on an ego.

    Args:
        driver: Driver of the agents selected by FREA's rules; None: no adversaries.
        ego: Driving system.
        scenarios: Scenarios of the test.
        graphs: Lane graphs of their towns.
        seed: Seed of the episodes.
        count: Simultaneous adversaries.

    Returns:
        Shares of the episodes: CR, the ego collides; valid, it collides with an adversary that stayed on the road and
        touched no other agent; off, an adversary left the road; others, an adversary touched another agent.
    """
    trials = Trials(lambda: make_system(ego), policies=make_system)
    drivers = {} if driver is None else {FreaSelection(count=count): driver}
    proposals = [
        (Base(episode, graphs[episode.town], None), Proposal(episode.scenario, drivers=drivers))  # type: ignore[arg-type]
        for episode in draw_episodes(scenarios, graphs, draws=1, seed=seed)
    ]
    outcomes = trials.run(proposals)
    shares = {
        "CR": [outcome.trace is not None and outcome.trace.end == "collision" for outcome in outcomes],
        "valid": [outcome.is_valid for outcome in outcomes],
        "off": [outcome.off_road for outcome in outcomes],
        "others": [outcome.hit_others for outcome in outcomes],
    }
    return {name: sum(values) / len(values) for name, values in shares.items()}


def run_adversary_training(plan: AdversaryPlan, *, report: Say = print) -> Iterator[str]:
    """Train an adversary, and write OUT/ALGORITHM.safetensors with its card, log.jsonl and curves.png.

    Args:
        plan: Plan of the training.
        report: Called with progress messages.

    Yields:
        Lines about what was written.

    Raises:
        ConfigError: The plan is not valid, there is no traffic to learn in, or the training diverged.
        FormatError: The checkpoint is broken or belongs to another training.
    """
    learning = find_policy_recipe(ADVERSARIES, plan.algorithm, dict(plan.changes))
    if learning.reward not in REWARDS:
        raise unknown_name("reward of an adversary", learning.reward, REWARDS)
    if plan.literal and learning.reward != "adversary":
        raise ConfigError(f"equation 6 as it is printed is no form of the reward {learning.reward}; leave one out")
    ego = make_system(plan.ego)
    safeio.make_folder(plan.out)
    torch.set_num_threads(1)
    scenarios, graphs = natural_scenarios(plan.learned_in())
    if not scenarios:
        raise ConfigError(
            f"{', '.join(plan.learned_in())}: no scenario has background traffic to take adversaries from"
        )
    episodes = draw_episodes(scenarios, graphs, draws=learning.draws, seed=0)
    report(f"{len(episodes)} episodes of {len(scenarios)} scenarios in {', '.join(graphs)}; ego: {plan.ego}")
    environment = _environment(learning, plan, episodes, graphs, ego)
    model = make_model(learning, environment)
    validation_setup = {"ego": plan.ego, "scenarios": scenarios, "graphs": graphs, "seed": VALIDATION_SEED}

    def validate(policy: Policy) -> dict[str, float]:
        metrics = measure_adversary(PolicyDriver(policy, name="candidate"), **validation_setup)  # type: ignore[arg-type]
        # CR says nothing about avoidable collisions: without a score the last weights are kept
        return metrics | ({} if learning.reward == "feasible" else {"score": metrics["valid"]})

    fingerprint = digest(
        "adversary training", plan.ego, plan.literal, plan.off_road, *(episode.key for episode in episodes)
    )[:16]
    state = train_policy(
        model, learning, plan.out, validate=validate, report=report, seconds=plan.seconds, metadata=fingerprint
    )
    if state["steps"] < learning.steps:
        report(f"stopped after {state['steps']} of {learning.steps} steps; run it again to go on")
    description = f"{', '.join(plan.learned_in())}: {len(scenarios)} scenarios with traffic in {', '.join(graphs)}"
    path = plan.out / f"{plan.algorithm}.safetensors"
    yield finish(
        path,
        learning,
        model,
        state=state,
        data=f"{description}; ego {plan.ego}",
        command=command_of(plan),
        test=measure_all(plan),
        metadata={"ego": plan.ego},
    )


def _environment(learning: PolicyRecipe, plan: AdversaryPlan, episodes: Any, graphs: Any, ego: Driver) -> Any:
    from ssad.training.reinforcement import import_sb3

    import_sb3()
    from ssad.training.adversary_env import AdversaryEnv

    return AdversaryEnv(
        episodes,
        graphs,
        learning.scenes,
        ego=ego,
        seed=learning.seed,
        reward=learning.reward,
        literal=plan.literal,
        off_road=plan.off_road,
        scale=learning.reward_scale,
        action=learning.action,
    )


def measure_all(plan: AdversaryPlan) -> Callable[[Driver], dict[str, float]]:
    """Return a test function of drivers in the sets of a plan: `SET_CR`, `SET_valid` and so on."""

    def test_driver(driver: Driver) -> dict[str, float]:
        metrics: dict[str, float] = {}
        for reference in plan.test:
            scenarios, graphs = natural_scenarios([reference])
            set_metrics = measure_adversary(driver, plan.ego, scenarios, graphs, seed=0)
            metrics |= {f"{Path(reference).stem}_{name}": round(value, 4) for name, value in set_metrics.items()}
        return metrics

    return test_driver


def command_of(plan: AdversaryPlan) -> str:
    """Return the command that repeats the training."""
    arguments = ["ssad", "train", "adversary", plan.algorithm]
    defaults = AdversaryPlan("", Path())
    arguments += ["--ego", plan.ego] if plan.ego != defaults.ego else []
    arguments += ["--scenarios", ",".join(plan.scenarios)] if plan.scenarios != defaults.scenarios else []
    arguments += ["--test", ",".join(plan.test)] if plan.test != defaults.test else []
    arguments += ["--literal"] if plan.literal else []
    arguments += ["--off-road", f"{plan.off_road:g}"] if plan.off_road != defaults.off_road else []
    return shlex.join([*arguments, *command_line_changes(plan.changes)])
