"""Importance sampling: episodes in which chance is led towards failure, and each failure weighed by how likely it was.

The proposal is a mixture: the process as it is (the defence, which bounds every weight), and copies of it in which the
means of the normal numbers are moved. They are learned from failures: first from those that splitting finds, then, by
the cross-entropy method, from those of all rounds' episodes, each with its weight among all that was drawn. Two kinds
of copies cover failures that are too rare to be learned from: what is moved half as far, for failures that need less
than most, and what is moved some time later (`Process.later`), for those that come later than most. Without the copies
such a failure is drawn very seldom, and then its weight exceeds that of all others together. The weights are exact,
since the likelihood ratio of moved normal numbers needs only their sums.

Source: Owen and Zhou, "Safe and effective importance sampling" (2000), the mixture and its weights; Veach and Guibas,
"Optimally combining sampling techniques" (1995), the weights of several rounds together; Rubinstein and Kroese, "The
Cross-Entropy Method" (2004).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ssad.core.types import F64, Bool
from ssad.metrics.rare_events import RareEstimate, weighted_estimate
from ssad.world.noise import Keys
from ssad.world.rare.brute import draw_keys, run
from ssad.world.rare.process import Process
from ssad.world.rare.splitting import splitting

LATER = 0.2  # share of the copies that begin later


@dataclass(frozen=True)
class Proposal:
    """A mixture of the process as it is and of K moved ones.

    Attributes:
        share: [K + 1] of the components, the process as it is first.
        means: [K, D] by how much each moves the means of the normal numbers.
    """

    share: F64
    means: F64

    def spread(self) -> Proposal:
        """The same with a copy of each moved component that is moved half as far; the two share its share."""
        share = np.concatenate([self.share[:1], 0.5 * self.share[1:], 0.5 * self.share[1:]])
        return Proposal(share, np.vstack([0.5 * self.means, self.means]))

    def with_later(self, process: Process) -> Proposal:
        """The same with copies that begin later (`Process.later`) of its two moved components of the largest shares.

        The copies get the share `LATER`, or half of what is moved if that is less. Where nothing is moved, or the
        process has no later times, nothing changes.
        """
        moved = 1.0 - float(self.share[0])
        most = 1 + np.argsort(-self.share[1:])[:2]
        copies = [process.later(self.means[k - 1]) for k in most]
        weight = np.repeat(self.share[most], [len(one) for one in copies])
        if not weight.any():
            return self
        later = min(LATER, 0.5 * moved)
        kept = (1.0 - later / moved) * self.share[1:]
        share = np.concatenate([self.share[:1], kept, later * weight / weight.sum()])
        return Proposal(share, np.vstack([self.means, *copies]))

    def log_ratios(self, total: F64, count: F64) -> F64:
        """[n, K] log of each moved component's likelihood over that of the process as it is."""
        return np.asarray(total @ self.means.T - 0.5 * (count @ (self.means**2).T))

    def weights(self, total: F64, count: F64) -> F64:
        """[n] likelihood of the process as it is over that of the mixture: at most 1 / share[0]."""
        ratios = np.exp(np.minimum(self.log_ratios(total, count), 700.0))
        return np.asarray(1.0 / (self.share[0] + ratios @ self.share[1:]))


@dataclass(frozen=True)
class Sample:
    """Episodes from a proposal, [n].

    Attributes:
        failed: Which have failed.
        weight: How likely each was without the proposal, to how likely with it.
        total: [n, D] sums of the normal numbers.
        count: [n, D] how many they are.
        keys: Their keys.
        component: Which component of the proposal each is from, 0: the process as it is.
    """

    failed: Bool
    weight: F64
    total: F64
    count: F64
    keys: Keys
    component: npt.NDArray[np.int64]


def sample(process: Process, proposal: Proposal, random: np.random.Generator, *, episodes: int) -> Sample:
    """Run at least `episodes` episodes, whole batches, of a proposal."""
    parts: list[Sample] = []
    means = np.vstack([np.zeros(process.width), proposal.means])
    while sum(len(part.keys) for part in parts) < episodes:
        keys = draw_keys(random, process.batch)
        component = random.choice(len(proposal.share), process.batch, p=proposal.share)
        process.reset(keys)
        process.push(means[component])
        failed = run(process)
        total, count = process.totals()
        weight = proposal.weights(total, count)
        parts.append(Sample(failed, weight, total, count, keys, component))
    names = Sample.__dataclass_fields__
    return Sample(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def learn(
    process: Process,
    random: np.random.Generator,
    *,
    components: int = 4,
    rounds: int = 2,
    episodes: int = 1000,
    defence: float = 0.1,
    shrink: float = 20.0,
) -> Proposal:
    """Learn a proposal: from the failures that splitting finds, then by the cross-entropy method from weighted ones.

    Splitting begins because chance alone finds no failure to learn from, and a level of the score that many episodes
    reach need not have to do with failing. It may be off; only what is learned hangs on it, not the estimate.

    Args:
        process: The process; its batch is the number of splitting's particles.
        random: Source of chance.
        components: Moved components that are learned, so that several ways to fail can be; more are made of them, see
            `Proposal.with_later` and `Proposal.spread`.
        rounds: Of the cross-entropy method.
        episodes: Of each round.
        defence: Share of the process as it is.
        shrink: Steps of no movement that are added to what is learned from, so that few episodes move little.
    """
    found = splitting(process, random, repeats=1)
    best = process.score()
    chosen = found.failed if found.failed.any() else best >= np.quantile(best, 0.9)
    total, count = (values[chosen] for values in process.totals())
    weight = np.ones(len(total))
    drawn: list[tuple[Proposal, Sample]] = []
    for number in range(rounds + 1):
        fitted = _fit(total, count, weight, random, components=components, defence=defence, shrink=shrink)
        proposal = fitted.with_later(process)
        if number == rounds:
            break
        drawn.append((proposal, sample(process, proposal, random, episodes=episodes)))
        parts = [(s.total[s.failed], s.count[s.failed]) for _, s in drawn]
        if sum(len(part) for part, _ in parts) < 10:
            break  # too few to learn more from
        total, count = (np.concatenate(column) for column in zip(*parts, strict=True))
        # as if all had been drawn from the mixture of all rounds' proposals
        size = np.array([len(s.keys) for _, s in drawn], float)
        weight = 1.0 / sum(n / p.weights(total, count) for n, (p, _) in zip(size / size.sum(), drawn, strict=True))
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
) -> Proposal:
    """The mixture of moved processes under which weighted episodes are likeliest: expectation and maximisation."""
    weight = weight / weight.sum()
    size = 1.0 / float((weight**2).sum())  # episodes of equal weight that would say as much
    start = random.choice(len(weight), components, p=weight)
    means = 0.3 * total[start] / np.maximum(count[start], 1.0)
    share = np.full(components, 1.0 / components)
    for _ in range(30):
        logs = np.log(share) + Proposal(share, means).log_ratios(total, count)
        logs -= logs.max(axis=1, keepdims=True)
        belongs = np.exp(logs)
        belongs *= (size * weight / belongs.sum(axis=1))[:, None]
        means = (belongs.T @ total) / (belongs.T @ count + shrink)
        share = np.maximum(belongs.sum(axis=0) / size, 1e-3)
        share /= share.sum()
    return Proposal(np.concatenate([[defence], (1.0 - defence) * share]), means)


def importance(
    process: Process, proposal: Proposal, random: np.random.Generator, *, episodes: int, training: float = 0.0
) -> tuple[RareEstimate, Sample]:
    """Estimate the probability of failure with a proposal that does not depend on these episodes.

    Args:
        process: The process.
        proposal: What to draw from.
        random: Source of chance.
        episodes: How many, in whole batches.
        training: Agent-steps that learning the proposal took; they count.

    Returns:
        The estimate, and its episodes.
    """
    before = process.work()
    drawn = sample(process, proposal, random, episodes=episodes)
    values = np.where(drawn.failed, drawn.weight, 0.0)
    work = process.work() - before + training
    most = 1.0 / float(proposal.share[0])
    return weighted_estimate(values, "importance sampling", most=most, work=work, training=training), drawn
