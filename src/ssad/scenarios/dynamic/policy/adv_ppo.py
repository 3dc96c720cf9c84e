"""Adv.PPO: learned policies that drive vehicles of the background traffic against the ego, one or several at once.

    from ssad.scenarios.dynamic.policy.adv_ppo import Adversary
    from ssad.world.selection import FreaSelection
    traces = rollout(world, {0: make_system("autopilot"), FreaSelection(count=1): Adversary()})

An adversary knows its goal, a point 6.5 m ahead of the ego on the ego's own route, and the road around it. It steers,
accelerates and brakes, and was rewarded for proven collisions (`ssad.world.rewards.proving`). The adversary of the
paper, `adv-ppo-paper`, was rewarded for reaching the goal (`ssad.world.rewards.adversary`). It does not observe the
road, and reverses instead of braking. `ssad train adversary` trains both.

Source: the paper, equation 6; FREA (Chen et al. 2024), its adversary `ppo`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ssad.core.driving import Driver, Selector
from ssad.core.errors import ConfigError
from ssad.core.generators import Base, Outcome, Proposal
from ssad.core.types import Controller
from ssad.world.policy import PolicyDriver, load_policy
from ssad.world.selection import VEHICLES, FreaSelection

SHIPPED = Path(__file__).parent / "weights"


class Adversary(PolicyDriver):
    """Driver of selected agents by a policy that observes the ego's upcoming route; deterministic, without memory."""

    def __init__(self, weights: str | Path | None = None, *, name: str = "adv-ppo") -> None:
        """Load the policy.

        Args:
            weights: NAME.safetensors with its card beside it, as `ssad train adversary` writes them; None: the
                shipped ones.
            name: Name in tables; without `weights` also the name of the shipped weights.

        Raises:
            FormatError: The weights are missing or broken, or are not those of a policy.
        """
        super().__init__(load_policy(SHIPPED / f"{name}.safetensors" if weights is None else weights), name=name)


class AdvPPO:
    """Adv.PPO: a learned policy drives the vehicle nearest to the ego, for proven collisions; one rollout a base."""

    name = "adv-ppo"

    def __init__(self, bases: Sequence[Base], *, seeds: Sequence[int], budget: int) -> None:
        """Check that every base has agents to take over; `seeds` and a `budget` beyond 1 have no effect."""
        for base in bases:
            if not any(_is_controllable(agent.controller) for agent in base.episode.agents[1:]):
                raise ConfigError(f"scenario {base.scenario.name}: {self.name} needs other agents than the ego")
        self._bases = tuple(bases)
        self._drivers: dict[Selector, Driver] = {FreaSelection(count=1, kinds=VEHICLES): Adversary(name=self.name)}
        self._has_proposed = False

    def ask(self, count: int) -> Sequence[Sequence[Proposal]]:
        """Propose each base itself, driven by the policy, once."""
        first_round, self._has_proposed = not self._has_proposed, True
        return [
            [Proposal(base.scenario, drivers=self._drivers)] if first_round and count else [] for base in self._bases
        ]

    def tell(self, outcomes: Sequence[Sequence[Outcome]]) -> None:
        """Ignore the outcomes: the policy is already trained."""


class PaperAdvPPO(AdvPPO):
    """Adv.PPO as in the paper: it seeks a point before the ego, on the road or off it, and cannot brake."""

    name = "adv-ppo-paper"


class Frea(AdvPPO):
    """FREA: Adv.PPO with a learned feasible region as a critic, which keeps the ego a way out."""

    name = "frea"


class AdvDDPG(AdvPPO):
    """Adv.PPO with a policy trained by deep deterministic policy gradient."""

    name = "adv-ddpg"


def _is_controllable(controller: Controller) -> bool:
    return controller in (Controller.AUTOPILOT, Controller.FOLLOW, Controller.SCRIPT, Controller.EXTERNAL)
