"""`ssad train adversary`: policies that drive background vehicles and provoke collisions of the ego, with cards."""

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
from ssad.simulators.proofs import prove_collisions
from ssad.training.driver import VALIDATION_SEED, draw_episodes, natural_scenarios
from ssad.training.feasibility import FeasibleRegion
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

_SETTING: dict[str, Any] = {"draws": 6, "gamma": 0.98}
_PROVING: dict[str, Any] = {
    **_SETTING,
    "observation": "adversary-on-road",
    "action": "pedals",
    "reward": "proving",
}
_PAPER: dict[str, Any] = {**_SETTING, "observation": "adversary", "action": "adversary", "reward": "adversary"}
_PPO: dict[str, Any] = {"lr": 3e-4, "noise": 0.6, "entropy": 0.002}
_LONG: dict[str, Any] = {
    "lr": 5e-4,
    "noise": 0.4,
    "entropy": 0.002,
    "rollout": 64,
    "steps": 400_000,
    "validate": 50_000,
}
ADVERSARIES = {
    "adv-ppo": replace(POLICY_RECIPES["ppo"], **_PROVING, **_LONG),
    "adv-ppo-paper": replace(POLICY_RECIPES["ppo"], steps=200_000, **_PAPER, **_PPO, validate=50_000),
    "frea": replace(POLICY_RECIPES["ppo"], **_PROVING | {"reward": "lawful"}, **_LONG),
    "adv-sac": replace(POLICY_RECIPES["sac"], steps=100_000, **_PROVING, lr=3e-4, batch=256, validate=25_000),
    "adv-ddpg": replace(POLICY_RECIPES["td3"], algorithm="ddpg", steps=200_000, **_PROVING, batch=256, validate=50_000),
    "adv-dqn": replace(
        POLICY_RECIPES["sac"],
        algorithm="dqn",
        steps=100_000,
        **_PROVING,
        lr=5e-4,
        batch=256,
        noise=0.05,
        validate=25_000,
    ),
}
"""Recipes of adversaries. All seek proven collisions, except `frea` (lawful) and `adv-ppo-paper` (the paper's)."""
SCENARIOS = {name: ("training", "training-lanes") for name in ADVERSARIES if name != "adv-ppo-paper"}
"""Default training sets, where they are not `training` alone."""
ROAD_COSTS = {"adv-ppo-paper": 0.0}
"""Default costs of a step off the road, where they are not `ROAD_COST`."""
ROAD_COST = 0.5
WITH_REGION = ("frea",)
"""Adversaries that have the feasible region as a critic."""
REWARDS = ("adversary", "colliding", "feasible", "lawful", "proving")
"""Names of the rewards; see `ssad.training.adversary_env`."""


@dataclass(frozen=True, slots=True)
class AdversaryPlan:
    """Plan of an adversary training.

    Attributes:
        algorithm: A name of `ADVERSARIES`.
        out: Folder to write to.
        ego: Driving system under test.
        scenarios: Training scenarios with natural traffic; empty: the default of the algorithm (`SCENARIOS`, or
            `training`).
        test: Scenarios of the final test.
        literal: Use equation 6 as printed for the reward.
        off_road: Cost of each step of an adversary off the road; None: the default of the algorithm (`ROAD_COSTS`;
            the paper and FREA: 0).
        changes: Changed values of the recipe.
        seconds: Time limit, s; None: none.
        region: Weights of the feasible region that is the second critic of PPO; None: the shipped one for the
            algorithms of `WITH_REGION`, none for others.
        device: Device of the networks.
    """

    algorithm: str
    out: Path
    ego: str = "autopilot"
    scenarios: tuple[str, ...] = ()
    test: tuple[str, ...] = ("natural",)
    literal: bool = False
    off_road: float | None = None
    changes: tuple[tuple[str, Any], ...] = ()
    seconds: float | None = None
    region: Path | None = None
    device: str = "cpu"

    def learned_in(self) -> tuple[str, ...]:
        """Return the sets and files of the training."""
        return self.scenarios or SCENARIOS.get(self.algorithm, ("training",))

    def road_cost(self) -> float:
        """Return what a step off the road costs."""
        return ROAD_COSTS.get(self.algorithm, ROAD_COST) if self.off_road is None else self.off_road


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
        Shares of the episodes: proven, the ego is in a proven collision (`ssad.metrics.proven_collisions`); CR, it
        collides; valid, it collides with an adversary that stayed on its side of the road and touched no other agent;
        off, an adversary left its side of the road; others, an adversary touched another agent.
    """
    trials = Trials(lambda: make_system(ego), policies=make_system)
    drivers = {} if driver is None else {FreaSelection(count=count): driver}
    proposals = [
        (Base(episode, graphs[episode.town], None), Proposal(episode.scenario, drivers=drivers))  # type: ignore[arg-type]
        for episode in draw_episodes(scenarios, graphs, draws=1, seed=seed)
    ]
    outcomes = trials.run(proposals)
    collisions = [(base, outcome) for (base, _), outcome in zip(proposals, outcomes, strict=True)]
    shares = {
        "proven": prove_collisions(collisions, trials),
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
    region = _region(plan, learning)
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
    environment = _environment(learning, plan, episodes, graphs, ego=ego, region=region)
    model = make_model(learning, environment, device=plan.device, buffer=_buffer(environment, region))
    validation_setup = {"ego": plan.ego, "scenarios": scenarios, "graphs": graphs, "seed": VALIDATION_SEED}

    def validate(policy: Policy) -> dict[str, float]:
        metrics = measure_adversary(PolicyDriver(policy, name="candidate"), **validation_setup)  # type: ignore[arg-type]
        if learning.reward == "adversary":  # The paper's reward is for any collision.
            return metrics | {"score": metrics["CR"]}
        # Proven collisions are few, so the valid ones decide between policies with as many of them.
        return metrics | {"score": metrics["proven"] + 0.1 * metrics["valid"]}

    fingerprint = digest(
        "adversary training",
        plan.ego,
        plan.literal,
        plan.road_cost(),
        "" if region is None else region.hash,
        *(episode.key for episode in episodes),
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
        metadata={"ego": plan.ego} | ({} if region is None else {"region": region.hash[:12]}),
    )


def _region(plan: AdversaryPlan, learning: PolicyRecipe) -> FeasibleRegion | None:
    """Return the feasible region of a plan. ConfigError where no PPO learns from it."""
    if plan.region is None and plan.algorithm not in WITH_REGION:
        return None
    if learning.algorithm != "ppo":
        raise ConfigError(
            f"a feasible region is a critic of PPO, and {plan.algorithm} learns by {learning.algorithm}: "
            "leave out --region"
        )
    return FeasibleRegion.load(plan.region)


def _buffer(environment: Any, region: FeasibleRegion | None) -> tuple[Any, dict[str, Any]] | None:
    """Return the class of the rollout buffer and its arguments; None: that of stable-baselines3."""
    if region is None:
        return None
    from ssad.training.feasible_ppo import FeasibleBuffer

    return FeasibleBuffer, {"environment": environment}


def _environment(
    learning: PolicyRecipe,
    plan: AdversaryPlan,
    episodes: Any,
    graphs: Any,
    *,
    ego: Driver,
    region: FeasibleRegion | None,
) -> Any:
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
        off_road=plan.road_cost(),
        scale=learning.reward_scale,
        action=learning.action,
        observation=learning.observation,
        region=region,
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
    arguments += ["--off-road", f"{plan.off_road:g}"] if plan.off_road is not None else []
    arguments += ["--region", str(plan.region)] if plan.region is not None else []
    return shlex.join([*arguments, *command_line_changes(plan.changes)])
