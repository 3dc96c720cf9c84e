"""`ssad train adversary`: Adv.PPO, a policy that drives background vehicles into an ego's way, with its card."""

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
from ssad.training.recipe import set_words
from ssad.training.reinforcement import LEARNINGS, Learning, Say, find_learning, finish, learn, make_model
from ssad.world.policy import Policy, PolicyDriver
from ssad.world.selection import FreaSelection

ADVERSARIES = {
    "adv-ppo": replace(
        LEARNINGS["ppo"],
        steps=200_000,
        observation="adversary",
        action="adversary",
        reward="adversary",
        draws=6,
        gamma=0.98,
        lr=3e-4,
        noise=0.6,
        entropy=0.002,
        validate=50_000,
    )
}
ADVERSARIES |= {
    "frea": replace(ADVERSARIES["adv-ppo"], reward="feasible", steps=800_000, validate=250_000, seed=3),
    "adv-sac": replace(
        LEARNINGS["sac"],
        steps=100_000,
        observation="adversary",
        action="adversary",
        reward="adversary",
        draws=6,
        gamma=0.98,
        lr=3e-4,
        batch=256,
        validate=25_000,
    ),
    "adv-ddpg": replace(
        LEARNINGS["td3"],
        algorithm="ddpg",
        steps=100_000,
        observation="adversary",
        action="adversary",
        reward="adversary",
        draws=6,
        gamma=0.98,
        batch=256,
        validate=25_000,
    ),
    "adv-dqn": replace(
        LEARNINGS["sac"],
        algorithm="dqn",
        steps=100_000,
        observation="adversary",
        action="adversary",
        reward="adversary",
        draws=6,
        gamma=0.98,
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
    """A training run.

    Attributes:
        algorithm: A name of `ADVERSARIES`.
        out: Folder to write to.
        ego: Driving system that it is trained against.
        scenarios: Natural traffic to learn in; none: the usual of the algorithm (`SCENARIOS`, or `training`).
        test: What the weights are measured on in the end.
        literal: Whether the reward is equation 6 as it is printed.
        off_road: What each step off the road costs an adversary (the paper and FREA: 0).
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
        """The sets and files that it learns in."""
        return self.scenarios or SCENARIOS.get(self.algorithm, ("training",))


def natural_only(refs: Sequence[str]) -> tuple[list[Scenario], dict[str, Any]]:
    """The scenarios of some sets that have background traffic, and the lane graphs of their towns."""
    found, graphs = find_scenarios(refs)
    kept = [s for s in found if s.type == "NaturalJunction" or s.traffic is not None]
    return kept, {name: graphs[name] for name in sorted({s.town for s in kept})}


def measure_adversary(
    driver: Driver | None, ego: str, scenarios: Sequence[Scenario], graphs: Any, *, seed: int, count: int = 1
) -> dict[str, float]:
    """What adversaries do to an ego.

    Args:
        driver: Drives those whom FREA's rules choose; None: nobody is chosen.
        ego: Driving system.
        scenarios: Where.
        graphs: Lane graphs of their towns.
        seed: Of the episodes.
        count: Adversaries at once.

    Returns:
        Shares of the episodes: CR, the ego collides with anybody; valid, with an adversary that stayed on the road and
        touched nobody else; off, an adversary left the road; others, one touched somebody else.
    """
    trials = Trials(lambda: make_system(ego), policies=make_system)
    drivers = {} if driver is None else {FreaSelection(count=count): driver}
    bases = [
        (Base(episode, graphs[episode.town], None), Proposal(episode.scenario, drivers=drivers))  # type: ignore[arg-type]
        for episode in draw_episodes(scenarios, graphs, draws=1, seed=seed)
    ]
    found = trials.run(bases)
    shares = {
        "CR": [o.trace is not None and o.trace.end == "collision" for o in found],
        "valid": [o.valid for o in found],
        "off": [o.off_road for o in found],
        "others": [o.hit_others for o in found],
    }
    return {name: sum(values) / len(values) for name, values in shares.items()}


def run_adversary_training(plan: AdversaryPlan, *, say: Say = print) -> Iterator[str]:
    """Train an adversary, and write OUT/ALGORITHM.safetensors with its card, log.jsonl and curves.png.

    Args:
        plan: What to train.
        say: Called with a line about progress.

    Yields:
        Lines about what was written.

    Raises:
        ConfigError: The plan is not valid, there is no traffic to learn in, or the training diverged.
        FormatError: An interrupted training is broken or another one.
    """
    learning = find_learning(ADVERSARIES, plan.algorithm, dict(plan.changes))
    if learning.reward not in REWARDS:
        raise unknown_name("reward of an adversary", learning.reward, REWARDS)
    if plan.literal and learning.reward != "adversary":
        raise ConfigError(f"equation 6 as it is printed is no form of the reward {learning.reward}; leave one out")
    ego = make_system(plan.ego)
    safeio.make_folder(plan.out)
    torch.set_num_threads(1)
    scenarios, graphs = natural_only(plan.learned_in())
    if not scenarios:
        raise ConfigError(
            f"{', '.join(plan.learned_in())}: no scenario has background traffic to take adversaries from"
        )
    episodes = draw_episodes(scenarios, graphs, draws=learning.draws, seed=0)
    say(f"{len(episodes)} episodes of {len(scenarios)} scenarios in {', '.join(graphs)}; ego: {plan.ego}")
    env = _environment(learning, plan, episodes, graphs, ego)
    model = make_model(learning, env)
    held = {"ego": plan.ego, "scenarios": scenarios, "graphs": graphs, "seed": VALIDATION_SEED}

    def validate(policy: Policy) -> dict[str, float]:
        found = measure_adversary(PolicyDriver(policy, name="candidate"), **held)  # type: ignore[arg-type]
        # of what could have been avoided CR says nothing: there the last weights count
        return found | ({} if learning.reward == "feasible" else {"score": found["valid"]})

    about = digest("adversary training", plan.ego, plan.literal, plan.off_road, *(e.key for e in episodes))[:16]
    state = learn(model, learning, plan.out, validate=validate, say=say, seconds=plan.seconds, about=about)
    if state["steps"] < learning.steps:
        say(f"stopped after {state['steps']} of {learning.steps} steps; run it again to go on")
    where = f"{', '.join(plan.learned_in())}: {len(scenarios)} scenarios with traffic in {', '.join(graphs)}"
    path = plan.out / f"{plan.algorithm}.safetensors"
    yield finish(
        path,
        learning,
        model,
        state=state,
        data=f"{where}; ego {plan.ego}",
        command=command_of(plan),
        test=measure_all(plan),
        about={"ego": plan.ego},
    )


def _environment(learning: Learning, plan: AdversaryPlan, episodes: Any, graphs: Any, ego: Driver) -> Any:
    from ssad.training.reinforcement import require

    require()
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
    """A function that measures a driver in the sets of a plan, as `SET_CR`, `SET_valid` and so on."""

    def found(driver: Driver) -> dict[str, float]:
        metrics: dict[str, float] = {}
        for ref in plan.test:
            scenarios, graphs = natural_only([ref])
            measured = measure_adversary(driver, plan.ego, scenarios, graphs, seed=0)
            metrics |= {f"{Path(ref).stem}_{name}": round(value, 4) for name, value in measured.items()}
        return metrics

    return found


def command_of(plan: AdversaryPlan) -> str:
    """The command that trains this anew."""
    words = ["ssad", "train", "adversary", plan.algorithm]
    usual = AdversaryPlan("", Path())
    words += ["--ego", plan.ego] if plan.ego != usual.ego else []
    words += ["--scenarios", ",".join(plan.scenarios)] if plan.scenarios != usual.scenarios else []
    words += ["--test", ",".join(plan.test)] if plan.test != usual.test else []
    words += ["--literal"] if plan.literal else []
    words += ["--off-road", f"{plan.off_road:g}"] if plan.off_road != usual.off_road else []
    return shlex.join([*words, *set_words(plan.changes)])
