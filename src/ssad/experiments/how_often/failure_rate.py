"""Failure probability of a driving system in an episode with random traffic, by several estimators."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from ssad.core.driving import Driver, step_options, steps_per_trace_step, with_finer_steps
from ssad.core.errors import ConfigError
from ssad.core.lane_graph import LaneGraph
from ssad.core.seeding import generator
from ssad.core.traces import merge_steps
from ssad.core.types import Episode, EpisodeTrace
from ssad.simulators.closed_loop import onboard_sensors, policies_of, requested_sensors
from ssad.world.rare.branching import branch_obstacle, refusal

Method = Literal["monte-carlo", "splitting", "importance"]
METHODS: tuple[Method, ...] = get_args(Method)
Crash = Mapping[str, Any]
"""A collision that was found: `keys`, the step from which each of its random keys holds; `means` that were moved."""


def first_obstacle(drivers: Sequence[Driver]) -> str:
    """Return why episodes of these drivers cannot branch, in a clause; "" where they can."""
    # All sensors that the engine renders keep a history of each episode.
    return next(filter(None, (branch_obstacle(driver, requested_sensors([driver])) for driver in drivers)), "")


@dataclass(frozen=True, slots=True)
class ChanceEpisode:
    """Episode with random traffic, and its driver.

    Attributes:
        episode: The episode.
        graph: Lane graph of its town.
        driver: The system under test.
        noise: Fields of `ssad.world.noise.Noise`.
        device: Device of the world.
        seed: Seed of the random numbers.
    """

    episode: Episode
    graph: LaneGraph
    driver: Driver
    noise: Mapping[str, Any]
    device: str
    seed: int

    def world(self, rows: int, keys: Mapping[int, int] | None = None, means: Sequence[float] = ()) -> Any:
        """A world of so many copies; with keys by step, one whose future is that."""
        from ssad.world.noise import Noise
        from ssad.world.rare.process import ReplayedWorld
        from ssad.world.world import World

        noise = Noise(**self.noise, stretches=9)
        graphs, episodes = {self.episode.town: self.graph}, with_finer_steps([self.episode], self.steps_in_one)
        options: dict[str, Any] = {"device": self.device, "noise": noise, **step_options(self.steps_in_one)}
        if keys:
            return ReplayedWorld(episodes, graphs, keys=keys, means=means, **options)
        return World(episodes, graphs, assign=np.zeros(rows, np.int64), **options)

    @property
    def steps_in_one(self) -> int:
        """Steps of the world in one of a trace: a driver is asked as often as its `period` says."""
        return steps_per_trace_step(self.driver)

    def drivers(self) -> list[Driver]:
        """Return the system under test and the drivers that actors of the scenario follow."""
        from ssad.drivers import make_system

        return [self.driver, *(make_system(name) for name in policies_of(self.episode.scenario))]

    def obstacle(self) -> str:
        """Return why the episode cannot branch, in a clause; "" where it can."""
        return first_obstacle(self.drivers())

    def _equipment(self) -> dict[str, Any]:
        """Return the sensors and the actors' drivers, as `Loop` and `rollout` take them."""
        drivers = self.drivers()
        for driver in drivers:
            if callable(getattr(driver, "to", None)):
                driver.to(self.device)  # type: ignore[attr-defined]
        policies = dict(zip(policies_of(self.episode.scenario), drivers[1:], strict=True))
        return {"sensors": onboard_sensors(drivers, self.device), "policies": policies.__getitem__}

    def process(self, rows: int) -> Any:
        """So many copies with their drivers, as the estimators take them.

        Raises:
            ConfigError: The scenario is not one of the embedded world.
        """
        from ssad.world.rare.process import WorldProcess
        from ssad.world.rollout import Loop

        return WorldProcess(Loop(self.world(rows), {0: self.driver}, **self._equipment()))

    def run_again(self, crash: Crash) -> EpisodeTrace:
        """The trace of a collision that was found."""
        from ssad.world.rollout import rollout

        keys = {int(step): int(key) for step, key in crash["keys"].items()}
        (trace,) = rollout(self.world(1, keys, crash["means"]), self.driver, **self._equipment())
        return merge_steps(trace, self.steps_in_one)

    def usual(self, rows: int) -> tuple[float, float]:
        """Return the mean duration of so many episodes, h, and the mean distance of the ego, km."""
        from ssad.world.rare.brute import draw_keys, run

        process = self.process(rows)
        process.reset(draw_keys(generator("how often", self.seed, "usual"), rows))
        run(process)
        world = process.world
        hours = float(world.array("step").mean()) * world.dt / 3600.0
        return hours, float(world.array("ego.driven").mean()) / 1000.0

    def estimate(
        self, method: Method, *, episodes: int, particles: int, repeats: int, components: int, batch: int
    ) -> tuple[dict[str, Any], Crash | None]:
        """Estimate the probability of a collision.

        Args:
            method: The estimator.
            episodes: Episodes of Monte Carlo, and of importance sampling after its learning phase.
            particles: Particles of each repeat of splitting, and of the splitting that a proposal is first learned
                from.
            repeats: Repeats of splitting.
            components: Components of the learned proposal.
            batch: Episodes side by side.

        Returns:
            Metrics, and the likeliest sampled collision.

        Raises:
            ConfigError: The method needs branches, and episodes of a driver cannot branch.
        """
        from ssad.world.rare.brute import monte_carlo
        from ssad.world.rare.importance import importance, learn
        from ssad.world.rare.splitting import keys_of, splitting

        if method != "monte-carlo" and (obstacle := self.obstacle()):
            raise ConfigError(refusal(obstacle))
        rng = generator("how often", self.seed)
        collision: dict[str, Any] | None = None
        if method == "splitting":
            process = self.process(particles * repeats)
            splitting_result = splitting(process, rng, repeats=repeats)
            failure_estimate = splitting_result.estimate()
            if splitting_result.failed.any():
                row = int(np.flatnonzero(splitting_result.failed)[0])
                collision = {
                    "keys": {str(step): str(key) for step, key in keys_of(splitting_result, row).items()},
                    "means": [],
                }
        elif method == "importance":
            process = self.process(particles)
            proposal = learn(process, rng, components=components, episodes=episodes // 4)
            training = process.work()
            process = self.process(batch)
            failure_estimate, importance_samples = importance(
                process, proposal, rng, episodes=episodes, training=training
            )
            if importance_samples.failed.any():
                # A large weight means that the failure is likely in the real traffic, not only in the proposal.
                row = int(np.argmax(np.where(importance_samples.failed, importance_samples.weight, 0.0)))
                component = int(importance_samples.component[row])
                means = proposal.means[component - 1].tolist() if component else []
                collision = {"keys": {"0": str(int(importance_samples.keys[row]))}, "means": means}
        else:
            process = self.process(batch)
            *_, (failure_estimate, keys) = monte_carlo(process, rng, episodes=episodes)
            if len(keys):
                collision = {"keys": {"0": str(int(keys[0]))}, "means": []}
        duration_hours, distance_km = self.usual(min(200, batch, episodes))
        driven_hours = failure_estimate.work * process.world.dt / 3600.0 / process.world.agents
        metrics = {
            "per_million": 1e6 * failure_estimate.probability,
            "low": 1e6 * failure_estimate.low,
            "high": 1e6 * failure_estimate.high,
            "effective": failure_estimate.effective,
            "events": failure_estimate.events,
            "episodes": failure_estimate.episodes,
            "work": failure_estimate.work / 1e6,
            "training": failure_estimate.training / 1e6,
            "hours": driven_hours,
            "km": driven_hours * distance_km / duration_hours,
            "per_hour": 1e3 * failure_estimate.probability / duration_hours,
            "per_km": 1e3 * failure_estimate.probability / distance_km,
        }
        return metrics, collision
