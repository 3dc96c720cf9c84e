"""The seam of adversarial scenario generation: what a generator starts from, what it proposes, what came of it.

A generator is asked for proposals and told their outcomes, over and over, until the budget of rollouts is used up. It
knows neither the driving system nor the simulator: whoever runs it owns budget, seeds and records
(`ssad.scenarios.dynamic.generate`). What it finds is a `Scenario` that can be saved, listed and replayed.

A package offers its generators by name through entry points; without a package, a name of the form "module:object" is
imported from the working folder:

    [project.entry-points."ssad.generators"]
    my-search = "my_package.search:MySearch"

What every implementation owes its callers: the same bases, seeds and outcomes give the same proposals, to the bit, and
what it proposes for one base does not depend on which others share its batch. A search can therefore be resumed: it is
asked again, and told what is already known.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

from ssad.core.driving import Driver, Selector
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import MOVING, Episode, EpisodeTrace, Scenario


@dataclass(frozen=True)
class Base:
    """Starting point of a generator: a scenario, and its undisturbed course.

    Attributes:
        episode: The scenario made concrete, with the seed that all its rollouts share.
        graph: Lane graph of its town.
        trace: The episode driven by the system under test.
    """

    episode: Episode
    graph: LaneGraph
    trace: EpisodeTrace

    @property
    def scenario(self) -> Scenario:
        """The scenario, with the author's defaults filled in."""
        return self.episode.scenario


@dataclass(frozen=True)
class Proposal:
    """A candidate to be simulated: a scenario, or drivers that take over its agents.

    Attributes:
        scenario: The scenario.
        adversaries: Names of the agents whose motion the generator has chosen; without names and drivers, all
            moving agents other than the ego.
        drivers: Selector -> driver of the selected agents. An agent that is taken over at any moment is an
            adversary. Proposals that run side by side share a driver by sharing this mapping; its selectors see
            the scenes of all of them.
    """

    scenario: Scenario
    adversaries: tuple[str, ...] = ()
    drivers: Mapping[Selector, Driver] = field(default_factory=dict)


@dataclass(frozen=True)
class Outcome:
    """Result of a proposal; unmeasured values are None.

    Attributes:
        proposal: The proposal.
        failure: Reason why it could not be run, in one line ("" if it ran).
        trace: Trace of the episode.
        adversaries: Numbers of the agents that are adversaries in the trace.
        collision: Whether the ego touched an adversary.
        time: Time of that contact, s.
        impact_speed: Relative speed of the two bodies then, m/s.
        ego_speed: Speed of the ego then, m/s.
        gap: Minimum distance of the ego's body from an adversary's, m; 0 if they touched. None: no adversary
            present.
        off_road: Whether an adversary that is a vehicle was on the road, on the side of its direction, and left it; a
            cyclist may leave the road, but not ride against traffic.
        hit_others: Whether an adversary touched an agent other than the ego.
        acceleration: Largest acceleration of an adversary that is a vehicle from one step to the next, along its
            heading or across, m/s^2.
        jerk: Largest change of that along its heading, as means over half a second, m/s^3.
        within_limits: Whether all adversaries kept to the limits of their bodies and of a hard-braking driver.
    """

    proposal: Proposal
    failure: str = ""
    trace: EpisodeTrace | None = None
    adversaries: tuple[int, ...] = ()
    collision: bool = False
    time: float | None = None
    impact_speed: float | None = None
    ego_speed: float | None = None
    gap: float | None = None
    off_road: bool = False
    hit_others: bool = False
    acceleration: float | None = None
    jerk: float | None = None
    within_limits: bool | None = None

    @property
    def is_valid(self) -> bool:
        """True if the ego touched an adversary that stayed on its side of the road and hit no other agent."""
        return self.collision and not self.off_road and not self.hit_others

    @property
    def danger(self) -> float:
        """Scalar objective for searches; larger is worse for the ego.

        Without a collision it is minus the minimum gap in m (at least -100, also for failures). A collision adds a
        tenth of the impact speed in m/s, but one off the road or with further agents counts as a gap of 1 m.
        """
        if self.collision:
            return 0.1 * (self.impact_speed or 0.0) if self.is_valid else -1.0
        return -100.0 if self.gap is None else max(-self.gap, -100.0)

    @property
    def is_provable(self) -> bool:
        """True if the collision is valid and the ego moves: what a search can do for a proven collision."""
        return self.is_valid and self.ego_speed is not None and self.ego_speed > MOVING

    @property
    def proof_value(self) -> float:
        """Scalar objective for searches that seek proven collisions; larger is better.

        As `danger`, with 1 more for a collision that may be proven; a valid one with an ego that stands counts as a gap
        of half a metre.
        """
        if self.is_provable:
            return 1.0 + self.danger
        return -0.5 if self.is_valid else self.danger


@runtime_checkable
class Generator(Protocol):
    """A search for dangerous scenarios, in B bases side by side.

    Attributes:
        name: Name in tables.
    """

    name: str

    def ask(self, count: int) -> Sequence[Sequence[Proposal]]:
        """Propose the next candidates.

        Args:
            count: Maximum number of rollouts for each base.

        Returns:
            For each of the B bases 0 to `count` proposals; none: the search has nothing left to try there.
        """

    def tell(self, outcomes: Sequence[Sequence[Outcome]]) -> None:
        """Learn from the outcomes; called once after each `ask`.

        Args:
            outcomes: For each base, those of its proposals in their order.
        """


class GeneratorFactory(Protocol):
    """Creates a generator: the meaning of a generator's name. A class with this constructor is one."""

    def __call__(self, bases: Sequence[Base], *, seeds: Sequence[int], budget: int) -> Generator:
        """Begin a search.

        Args:
            bases: B of them.
            seeds: Root of the random numbers of each base.
            budget: Total number of rollouts for each base.

        Returns:
            The generator, which has not been asked yet.

        Raises:
            ConfigError: A base has nothing that the generator could change.
        """
