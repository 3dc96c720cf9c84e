"""Importance sampling: noise is steered towards failure, and each failure is weighted by its likelihood ratio.

The proposal is a mixture: the unchanged process (the defence, which bounds every weight), and components in which the
means of the normal numbers are shifted. The shifts are learned from failures: first from those of splitting, then, by
the cross-entropy method, from those of all rounds' episodes, each with its weight under everything drawn. Two kinds
of copies cover failures that are too rare to learn from: half the shift, for failures that need less than most, and a
delayed shift (`Process.later`), for those that come later than most. Without the copies such a failure is drawn very
seldom, and then its weight exceeds that of all others together. The weights are exact, since the likelihood ratio of
shifted normal numbers needs only their sums.

Source: Owen and Zhou, "Safe and effective importance sampling" (2000), the mixture and its weights; Veach and Guibas,
"Optimally combining sampling techniques" (1995), the weights of several rounds together; Rubinstein and Kroese, "The
Cross-Entropy Method" (2004).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ssad.core.columns import concatenate
from ssad.core.types import F64, Bool
from ssad.metrics.rare_events import RareEstimate, weighted_estimate
from ssad.world.noise import Keys
from ssad.world.rare.brute import draw_keys, run
from ssad.world.rare.process import Process
from ssad.world.rare.splitting import splitting

LATER = 0.2  # share of the copies that begin later


@dataclass(frozen=True)
class MixtureProposal:
    """Mixture of the unchanged process and K shifted ones.

    Attributes:
        share: [K + 1] weights of the components, the unchanged process first.
        means: [K, D] shift of the means of the normal numbers in each.
    """

    share: F64
    means: F64

    def spread(self) -> MixtureProposal:
        """Add a copy of each shifted component with half the shift; the two split its share."""
        share = np.concatenate([self.share[:1], 0.5 * self.share[1:], 0.5 * self.share[1:]])
        return MixtureProposal(share, np.vstack([0.5 * self.means, self.means]))

    def with_later(self, process: Process) -> MixtureProposal:
        """The same with copies that begin later (`Process.later`) of its two moved components of the largest shares.

        The copies get the share `LATER`, or half of what is moved if that is less. Where nothing is moved, or the
        process has no later times, nothing changes.
        """
        shifted_share = 1.0 - float(self.share[0])
        largest = 1 + np.argsort(-self.share[1:])[:2]
        copies = [process.later(self.means[component - 1]) for component in largest]
        copy_weights = np.repeat(self.share[largest], [len(copy) for copy in copies])
        if not copy_weights.any():
            return self
        delayed_share = min(LATER, 0.5 * shifted_share)
        remaining_share = (1.0 - delayed_share / shifted_share) * self.share[1:]
        share = np.concatenate([self.share[:1], remaining_share, delayed_share * copy_weights / copy_weights.sum()])
        return MixtureProposal(share, np.vstack([self.means, *copies]))

    def log_ratios(self, total: F64, count: F64) -> F64:
        """Return the log likelihood ratio [n, K] of each shifted component over the unchanged process."""
        return np.asarray(total @ self.means.T - 0.5 * (count @ (self.means**2).T))

    def weights(self, total: F64, count: F64) -> F64:
        """Return the likelihood ratio [n] of the unchanged process over the mixture: at most 1 / share[0]."""
        # exp(709) is the largest double; a larger ratio would overflow.
        ratios = np.exp(np.minimum(self.log_ratios(total, count), 700.0))
        return np.asarray(1.0 / (self.share[0] + ratios @ self.share[1:]))


@dataclass(frozen=True)
class WeightedEpisodes:
    """Episodes drawn from a proposal, [n].

    Attributes:
        failed: Mask of the failures.
        weight: Likelihood ratio of the unchanged process over the proposal.
        total: [n, D] sums of the normal numbers.
        count: [n, D] their counts.
        keys: Keys of the episodes.
        component: Component of the proposal that each is drawn from, 0: the unchanged process.
    """

    failed: Bool
    weight: F64
    total: F64
    count: F64
    keys: Keys
    component: npt.NDArray[np.int64]


def sample(
    process: Process, proposal: MixtureProposal, random: np.random.Generator, *, episodes: int
) -> WeightedEpisodes:
    """Run at least `episodes` episodes of a proposal, in whole batches."""
    parts: list[WeightedEpisodes] = []
    means = np.vstack([np.zeros(process.width), proposal.means])
    while sum(len(part.keys) for part in parts) < episodes:
        keys = draw_keys(random, process.batch)
        component = random.choice(len(proposal.share), process.batch, p=proposal.share)
        process.reset(keys)
        process.push(means[component])
        failed = run(process)
        total, count = process.totals()
        weight = proposal.weights(total, count)
        parts.append(WeightedEpisodes(failed, weight, total, count, keys, component))
    return concatenate(parts)


def learn(
    process: Process,
    random: np.random.Generator,
    *,
    components: int = 4,
    rounds: int = 2,
    episodes: int = 1000,
    defence: float = 0.1,
    shrink: float = 20.0,
) -> MixtureProposal:
    """Learn a proposal: from the failures that splitting finds, then by the cross-entropy method from weighted ones.

    Splitting begins because chance alone finds no failure to learn from, and a level of the score that many episodes
    reach need not have to do with failing. It may be off; only what is learned hangs on it, not the estimate.

    Args:
        process: The process; its batch is the number of splitting's particles.
        random: Source of chance.
        components: Moved components that are learned, so that several ways to fail can be; more are made of them, see
            `MixtureProposal.with_later` and `MixtureProposal.spread`.
        rounds: Of the cross-entropy method.
        episodes: Of each round.
        defence: Share of the process as it is.
        shrink: Steps of no movement that are added to what is learned from, so that few episodes move little.
    """
    initial = splitting(process, random, repeats=1)
    final_scores = process.score()
    informative = initial.failed if initial.failed.any() else final_scores >= np.quantile(final_scores, 0.9)
    total, count = (statistic[informative] for statistic in process.totals())
    weight = np.ones(len(total))
    history: list[tuple[MixtureProposal, WeightedEpisodes]] = []
    for round_index in range(rounds + 1):
        mixture = _fit(total, count, weight, random, components=components, defence=defence, shrink=shrink)
        proposal = mixture.with_later(process)
        if round_index == rounds:
            break
        history.append((proposal, sample(process, proposal, random, episodes=episodes)))
        parts = [(batch.total[batch.failed], batch.count[batch.failed]) for _, batch in history]
        if sum(len(total_rows) for total_rows, _ in parts) < 10:
            break  # too few to learn more from
        total, count = (np.concatenate(column) for column in zip(*parts, strict=True))
        # as if all had been drawn from the mixture of all rounds' proposals
        sizes = np.array([len(batch.keys) for _, batch in history], float)
        weight = 1.0 / sum(
            fraction / round_proposal.weights(total, count)
            for fraction, (round_proposal, _) in zip(sizes / sizes.sum(), history, strict=True)
        )
        # few episodes must not decide alone
        weight = np.minimum(weight, 10.0 * weight.mean())
    return proposal.spread()


def _fit(
    total: F64,
    count: F64,
    weight: F64,
    random: np.random.Generator,
    *,
    components: int,
    defence: float,
    shrink: float,
) -> MixtureProposal:
    """Fit the mixture that maximises the likelihood of weighted episodes, by expectation maximisation."""
    weight = weight / weight.sum()
    effective_size = 1.0 / float((weight**2).sum())  # episodes of equal weight that would say as much
    seeds = random.choice(len(weight), components, p=weight)
    means = 0.3 * total[seeds] / np.maximum(count[seeds], 1.0)
    shares = np.full(components, 1.0 / components)
    for _ in range(30):
        log_shares = np.log(shares) + MixtureProposal(shares, means).log_ratios(total, count)
        # The log-sum-exp shift: only ratios of the components matter.
        log_shares -= log_shares.max(axis=1, keepdims=True)
        responsibilities = np.exp(log_shares)
        responsibilities *= (effective_size * weight / responsibilities.sum(axis=1))[:, None]
        means = (responsibilities.T @ total) / (responsibilities.T @ count + shrink)
        # A component of share 0 could never recover, since its log would be minus infinity.
        shares = np.maximum(responsibilities.sum(axis=0) / effective_size, 1e-3)
        shares /= shares.sum()
    return MixtureProposal(np.concatenate([[defence], (1.0 - defence) * shares]), means)


def importance(
    process: Process, proposal: MixtureProposal, random: np.random.Generator, *, episodes: int, training: float = 0.0
) -> tuple[RareEstimate, WeightedEpisodes]:
    """Estimate the probability of failure with a proposal that does not depend on these episodes.

    Args:
        process: The process.
        proposal: Distribution to draw from.
        random: Source of randomness.
        episodes: Minimum number, in whole batches.
        training: Agent-steps spent on learning the proposal; they count as work.

    Returns:
        The estimate, and its episodes.
    """
    initial_work = process.work()
    episodes_drawn = sample(process, proposal, random, episodes=episodes)
    values = np.where(episodes_drawn.failed, episodes_drawn.weight, 0.0)
    work = process.work() - initial_work + training
    max_weight = 1.0 / float(proposal.share[0])
    return weighted_estimate(
        values, "importance sampling", max_weight=max_weight, work=work, training=training
    ), episodes_drawn
