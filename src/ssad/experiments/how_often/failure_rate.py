"""How often a driving system fails in an episode whose traffic has chance in it, by several estimators."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from ssad.core.driving import Driver
from ssad.core.lane_graph import LaneGraph
from ssad.core.seeding import generator
from ssad.core.types import Episode, EpisodeTrace

Method = Literal["monte-carlo", "splitting", "importance"]
Crash = Mapping[str, Any]
"""A collision that was found: `keys`, the step from which each of its random keys holds; `means` that were moved."""


@dataclass(frozen=True, slots=True)
class ChanceEpisode:
    """An episode with chance in its traffic, and who drives it.

    Attributes:
        episode: Where, who and when.
        graph: Its town.
        driver: The system under test, which remembers nothing.
        noise: Fields of `ssad.world.noise.Noise`.
        device: Where the world computes.
        seed: Of the random numbers.
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
        from ssad.world.rare.process import Told
        from ssad.world.world import World

        noise = Noise(**self.noise, stretches=9)
        graphs = {self.episode.town: self.graph}
        if keys:
            return Told([self.episode], graphs, keys=keys, means=means, device=self.device, noise=noise)
        order = np.zeros(rows, np.int64)
        return World([self.episode], graphs, assign=order, device=self.device, noise=noise)

    def process(self, rows: int) -> Any:
        """So many copies with their driver, as the estimators take them.

        Raises:
            ConfigError: The driver remembers something, or the scenario is not one of the embedded world.
        """
        from ssad.world.rare.process import WorldProcess
        from ssad.world.rollout import Loop

        return WorldProcess(Loop(self.world(rows), {0: self.driver}))

    def run_again(self, crash: Crash) -> EpisodeTrace:
        """The trace of a collision that was found."""
        from ssad.world.rollout import rollout

        keys = {int(step): int(key) for step, key in crash["keys"].items()}
        (trace,) = rollout(self.world(1, keys, crash["means"]), self.driver)
        return trace

    def usual(self, rows: int = 200) -> tuple[float, float]:
        """How long an episode takes on average, h, and how far the ego gets, km."""
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
        """The probability of a collision.

        Args:
            method: The estimator.
            episodes: Of Monte Carlo, and of importance sampling after it has learned.
            particles: Of each repeat of splitting, and of the splitting that a proposal is first learned from.
            repeats: Of splitting.
            components: Of the learned proposal.
            batch: Episodes side by side.

        Returns:
            Metrics, and the likeliest collision that was found.
        """
        from ssad.world.rare.brute import monte_carlo
        from ssad.world.rare.importance import importance, learn
        from ssad.world.rare.splitting import keys_of, splitting

        random = generator("how often", self.seed)
        crash: dict[str, Any] | None = None
        if method == "splitting":
            process = self.process(particles * repeats)
            branched = splitting(process, random, repeats=repeats)
            found = branched.estimate()
            if branched.failed.any():
                row = int(np.flatnonzero(branched.failed)[0])
                crash = {"keys": {str(step): str(key) for step, key in keys_of(branched, row).items()}, "means": []}
        elif method == "importance":
            process = self.process(particles)
            proposal = learn(process, random, components=components, episodes=episodes // 4)
            training = process.work()
            process = self.process(batch)
            found, drawn = importance(process, proposal, random, episodes=episodes, training=training)
            if drawn.failed.any():
                row = int(np.argmax(np.where(drawn.failed, drawn.weight, 0.0)))
                part = int(drawn.component[row])
                means = proposal.means[part - 1].tolist() if part else []
                crash = {"keys": {"0": str(int(drawn.keys[row]))}, "means": means}
        else:
            process = self.process(batch)
            *_, (found, keys) = monte_carlo(process, random, episodes=episodes)
            if len(keys):
                crash = {"keys": {"0": str(int(keys[0]))}, "means": []}
        hours, km = self.usual()
        driven = found.work * process.world.dt / 3600.0 / process.world.agents
        metrics = {
            "per_million": 1e6 * found.probability,
            "low": 1e6 * found.low,
            "high": 1e6 * found.high,
            "effective": found.effective,
            "events": found.events,
            "episodes": found.episodes,
            "work": found.work / 1e6,
            "training": found.training / 1e6,
            "hours": driven,
            "km": driven * km / hours,
            "per_hour": 1e3 * found.probability / hours,
            "per_km": 1e3 * found.probability / km,
        }
        return metrics, crash
