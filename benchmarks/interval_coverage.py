"""How often the 95 % intervals hold, by simulation: python benchmarks/interval_coverage.py [--quick]

Draws data sets whose true mean is known, of the shapes that occur in a run, and counts how often the interval that
`ssad.metrics` gives holds it. Writes the tables between the markers in docs/results/intervals.md; with --quick it
prints them.
"""

from __future__ import annotations

import argparse
import zlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import NormalDist

import numpy as np
import numpy.typing as npt

from ssad.metrics.intervals import (
    LEVEL,
    MIN_CLUSTERS,
    MIN_ROUTES,
    Clusters,
    ConfidenceLimits,
    bounded_limits,
    difference_limits,
    mean_limits,
    replicate_limits,
    share_limits,
    t_quantile,
)

F64 = npt.NDArray[np.float64]
DOCUMENT = Path(__file__).resolve().parents[1] / "docs" / "results" / "intervals.md"
MARKERS = ("<!-- coverage: begin -->", "<!-- coverage: end -->")
SHARES = (0.01, 0.05, 0.1, 0.3, 0.5, 0.8, 0.95)
# clusters, cases in each
DESIGNS = ((8, 1), (32, 1), (150, 1), (5, 10), (8, 4), (32, 10), (150, 3))
CORRELATIONS = (0.0, 0.3, 0.8, 1.0)
STRATA = {
    "all 0.01": [0.01] * 8,
    "all 0.05": [0.05] * 8,
    "all 0.1": [0.1] * 8,
    "all 0.3": [0.3] * 8,
    "all 0.5": [0.5] * 8,
    "all 0.8": [0.8] * 8,
    "half 0, half 1": [0.0, 1.0] * 4,
    "half 0.05, half 0.95": [0.05, 0.95] * 4,
    "half 0.2, half 0.8": [0.2, 0.8] * 4,
    "half 0.1, half 1": [0.1, 1.0] * 4,
    "one 0.5, others 0": [0.5] + [0.0] * 7,
    "0.05 to 0.95": np.linspace(0.05, 0.95, 8).tolist(),
    "the paper's TD3": [1, 0.25, 0.75, 0, 1, 1, 1, 1],
}

ROUTE_COUNTS = (10, 15, 20, 38)
DESIGN_EFFECTS = (1.6, 2.5, 4.0, 5.1, 6.4)
"""From cases that are weakly alike to the greatest that a few routes of ten cases show."""
ROUTE_SHARES = (0.02, 0.05, 0.1, 0.3, 0.5)
FLIPS = ((0.02, 0.02), (0.05, 0.02), (0.1, 0.05), (0.3, 0.1), (0.5, 0.3))
"""Shares of the cases where only the first, and only the second system has the event."""
MAX_WIDTH_RATIO = 1.5


def design(clusters: int, cases: int, strata: int = 1) -> Clusters:
    """`clusters` clusters of `cases` cases in each of `strata` strata."""
    total = clusters * strata
    return Clusters(np.full(total, float(cases)), np.repeat(np.arange(strata), clusters))


def occurrences(
    random: np.random.Generator, draws: int, share: npt.ArrayLike, cases: int, correlation: float
) -> npt.NDArray[np.bool_]:
    """[draws, K, cases] whether an event occurs, its share [K] varying between clusters (beta-binomial)."""
    mean = np.broadcast_to(np.asarray(share, np.float64), (draws, np.size(share)))
    if correlation == 0.0:
        chance = mean
    elif correlation == 1.0:
        chance = (random.random(mean.shape) < mean).astype(np.float64)
    else:
        spread = (1.0 - correlation) / correlation
        inside = np.clip(mean, 1e-9, 1.0 - 1e-9)
        drawn = random.beta(inside * spread, (1.0 - inside) * spread)
        chance = np.where((mean <= 0.0) | (mean >= 1.0), mean, drawn)
    return random.random((*mean.shape, cases)) < chance[..., None]


def coverage(truth: float, low: F64, high: F64) -> tuple[float, float]:
    """Share of the intervals given that hold the truth (to rounding), and the share of data sets that have one."""
    given = ~np.isnan(low)
    held = (low <= truth + 1e-12) & (high >= truth - 1e-12)
    return (float(held[given].mean()) if given.any() else np.nan), float(given.mean())


def share_coverage(share: npt.ArrayLike, layout: Clusters, correlation: float, draws: int) -> float:
    """Coverage for the mean of events whose share is [K] in the clusters."""
    each = np.broadcast_to(np.asarray(share, np.float64), layout.size.shape)
    cases = int(layout.size[0])
    random = stream("share", each.tolist(), cases, correlation)
    sums = occurrences(random, draws, each, cases, correlation).sum(axis=2).astype(np.float64)
    found = bounded_limits(sums, layout, cap=2.0 * layout.size.sum())
    return coverage(float(layout.weight @ each), found.low, found.high)[0]


def completion(random: np.random.Generator, draws: int, clusters: int, cases: int, correlation: float) -> F64:
    """Route completion: 1, or with probability 0.1 uniform in [0.2, 1]; mean 0.96."""
    cut = occurrences(random, draws, [0.1] * clusters, cases, correlation)
    return np.where(cut, 0.2 + 0.8 * random.random(cut.shape), 1.0)


def poor_completion(random: np.random.Generator, draws: int, clusters: int, cases: int, correlation: float) -> F64:
    """Route completion: 1, or with probability 0.4 a value of the cluster, uniform in [0.2, 1]; mean 0.84."""
    cut = occurrences(random, draws, [0.4] * clusters, cases, correlation)
    return np.where(cut, 0.2 + 0.8 * random.random((draws, clusters, 1)), 1.0)


def off_road(random: np.random.Generator, draws: int, clusters: int, cases: int, correlation: float) -> F64:
    """Metres off the road: 0, or with probability 0.4 exponential with mean 2; mean 0.8."""
    gone = occurrences(random, draws, [0.4] * clusters, cases, correlation)
    return np.where(gone, random.exponential(2.0, gone.shape), 0.0)


def rarely_off_road(random: np.random.Generator, draws: int, clusters: int, cases: int, correlation: float) -> F64:
    """Metres off the road: 0, or with probability 0.1 exponential with mean 2; mean 0.2."""
    gone = occurrences(random, draws, [0.1] * clusters, cases, correlation)
    return np.where(gone, random.exponential(2.0, gone.shape), 0.0)


def rarely_far_off_road(random: np.random.Generator, draws: int, clusters: int, cases: int, correlation: float) -> F64:
    """The same with one distance a cluster."""
    gone = occurrences(random, draws, [0.1] * clusters, cases, correlation)
    return np.where(gone, random.exponential(2.0, (draws, clusters, 1)), 0.0)


def duration(random: np.random.Generator, draws: int, clusters: int, cases: int, correlation: float) -> F64:
    """Seconds driven: normal, mean 15, standard deviation 3."""
    shared = random.normal(size=(draws, clusters, 1)) * np.sqrt(correlation)
    return 15.0 + 3.0 * (shared + random.normal(size=(draws, clusters, cases)) * np.sqrt(1.0 - correlation))


def gap(random: np.random.Generator, draws: int, clusters: int, cases: int, correlation: float) -> F64:
    """Metres to the nearest agent: log-normal with sigma 0.5; mean 1.133."""
    shared = random.normal(size=(draws, clusters, 1)) * np.sqrt(correlation)
    return np.exp(0.5 * (shared + random.normal(size=(draws, clusters, cases)) * np.sqrt(1.0 - correlation)))


Draw = Callable[[np.random.Generator, int, int, int, float], F64]
MEANS: dict[str, tuple[Draw, float, bool]] = {
    "RC, 10 % below 1": (completion, 0.96, True),
    "RC, 40 % below 1": (poor_completion, 0.84, True),
    "OR, 60 % zeros": (off_road, 0.8, False),
    "OR, 90 % zeros": (rarely_off_road, 0.2, False),
    "OR, 90 % zeros, one distance a cluster": (rarely_far_off_road, 0.2, False),
    "TS, normal": (duration, 15.0, False),
    "MD, log-normal": (gap, float(np.exp(0.125)), False),
}
"""Name -> how it is drawn, its mean, whether it lies in [0, 1]."""


def mean_coverage(name: str, layout: Clusters, correlation: float, draws: int) -> tuple[float, float]:
    """Coverage for a mean, and the share of data sets that have an interval."""
    draw, truth, bounded = MEANS[name]
    random = stream(name, len(layout.size), layout.stratum.max(), float(layout.size[0]), correlation)
    sums = draw(random, draws, len(layout.size), int(layout.size[0]), correlation).sum(axis=2)
    found = bounded_limits(sums, layout) if bounded else mean_limits(sums, layout)
    return coverage(truth, found.low, found.high)


def precision(weight: F64, scene: npt.NDArray[np.intp], true: F64, objects: F64) -> F64:
    """[B] average precision of detections in order of score, scenes [C] weighed by weight [B, C]."""
    each = weight[:, scene]
    right, wrong = np.cumsum(each * true, axis=1), np.cumsum(each * (1.0 - true), axis=1)
    share = np.maximum.accumulate((right / np.maximum(right + wrong, 1e-9))[:, ::-1], axis=1)[:, ::-1]
    found = np.diff(right, axis=1, prepend=0.0) / np.maximum(weight @ objects, 1e-9)[:, None]
    return np.asarray((share * found).sum(axis=1))


def detections(
    random: np.random.Generator, scenes: int, recall: float, correlation: float
) -> tuple[npt.NDArray[np.intp], F64, F64]:
    """Detections of scenes in order of score: scene, whether it is true; objects in each scene."""
    spread = (1.0 - correlation) / correlation
    objects = random.poisson(8.0, scenes) + (random.random(scenes) < 0.3) * random.poisson(15.0, scenes)
    right = random.binomial(objects, random.beta(recall * spread, (1.0 - recall) * spread, scenes))
    wrong = random.poisson(random.gamma(1.0, 2.0, scenes))
    scene = np.concatenate([np.repeat(np.arange(scenes), right), np.repeat(np.arange(scenes), wrong)])
    true = np.repeat([1.0, 0.0], [right.sum(), wrong.sum()])
    score = np.where(true > 0.0, random.beta(4.0, 2.0, len(true)), random.beta(2.0, 4.0, len(true)))
    order = np.argsort(-score)
    return scene[order], true[order], objects.astype(np.float64)


def detection_coverage(scenes: int, recall: float, correlation: float, draws: int, replicates: int = 100) -> float:
    """Coverage for the average precision of a detector, by the bootstrap over scenes."""
    random = stream("detection", scenes, recall, correlation)
    many = 20_000
    truth = float(precision(np.ones((1, many)), *detections(random, many, recall, correlation))[0])
    values, variances = np.zeros(draws), np.zeros(draws)
    for k in range(draws):
        found = detections(random, scenes, recall, correlation)
        values[k] = precision(np.ones((1, scenes)), *found)[0]
        weight = random.multinomial(scenes, np.full(scenes, 1.0 / scenes), size=replicates).astype(np.float64)
        variances[k] = precision(weight, *found).var(ddof=1)
    low, high = replicate_limits(values, variances, scenes, bounded=True)
    return coverage(truth, low, high)[0]


def stream(*key: object) -> np.random.Generator:
    """A generator of its own for each simulation."""
    return np.random.Generator(np.random.Philox(zlib.crc32(repr(key).encode())))


def natural_sizes() -> F64:
    """[38] cases on each route of the set `natural-uniform`, in ascending order."""
    from ssad.experiments.scenario_kind import route_key
    from ssad.scenarios.dynamic import load_scenarios

    return np.sort(np.array([*Counter(map(route_key, load_scenarios("natural-uniform"))).values()], np.float64))


def route_layout(routes: int, natural: F64) -> Clusters:
    """Routes with unequal numbers of cases: `natural-uniform`; `frea`, 15 of 10; else twice those of the first."""
    if routes == len(natural):
        size = natural
    elif routes == 15:
        size = np.full(routes, 10.0)
    else:
        size = 2.0 * natural[np.linspace(0, len(natural) - 1, routes).round().astype(int)]
    return Clusters(size, np.zeros(routes, np.intp))


def correlation_of(design_effect: float, layout: Clusters) -> float:
    """Correlation of the cases of a cluster that makes a design effect; above 1 where none does."""
    return (design_effect - 1.0) / (float(layout.size @ layout.size) / float(layout.size.sum()) - 1.0)


def counts(
    random: np.random.Generator, draws: int, shares: Sequence[float], layout: Clusters, correlation: float
) -> list[F64]:
    """Numbers [draws, K] of cases with each of several exclusive events (Dirichlet-multinomial)."""
    shape, size = (draws, len(layout.size)), layout.size.astype(np.int64)
    all_shares = np.array([*shares, 1.0 - sum(shares)])
    if correlation >= 1.0:
        chance = random.multinomial(1, all_shares, shape).astype(np.float64)
    else:
        drawn = random.gamma(all_shares * (1.0 - correlation) / correlation, size=(*shape, len(all_shares))) + 1e-300
        chance = drawn / drawn.sum(axis=-1, keepdims=True)
    remaining_cases, remaining_chance, events = np.broadcast_to(size, shape), np.ones(shape), []
    for index in range(len(shares)):
        conditional = np.clip(chance[..., index] / np.maximum(remaining_chance, 1e-300), 0.0, 1.0)
        events.append(random.binomial(remaining_cases, conditional))
        remaining_cases, remaining_chance = remaining_cases - events[-1], remaining_chance - chance[..., index]
    return [event.astype(np.float64) for event in events]


@dataclass(frozen=True)
class RouteResult:
    """Coverage of the intervals in one simulation, and their mean width over that of two oracles.

    Attributes:
        coverage: Share of the intervals that hold the truth.
        width: Mean width over that of an oracle that knows the design effect: the same limits with the true effective
            number of cases.
        normal_width: Mean width over that of an oracle that knows the standard error: 3.92 standard errors.
    """

    coverage: float
    width: float
    normal_width: float

    @property
    def text(self) -> str:
        """As it stands in the tables."""
        return f"{percent(self.coverage)} ({self.width:.2f}, {self.normal_width:.2f})"


def route_result(shares: Sequence[float], layout: Clusters, design_effect: float, draws: int) -> RouteResult | None:
    """Result for one share, or for the difference of two; None where the routes are too small for the design effect."""
    correlation = correlation_of(design_effect, layout)
    if correlation > 1.0:
        return None
    cases = float(layout.size.sum())
    random = stream("routes", tuple(shares), layout.size.tolist(), design_effect)
    events = counts(random, draws, shares, layout, correlation)
    estimates = [bounded_limits(sums, layout, cap=2.0 * cases) for sums in events]
    oracles = [known_effect_limits(sums, layout, design_effect) for sums in events]
    low, high, known_low, known_high = (
        (estimates[0].low, estimates[0].high, oracles[0].low, oracles[0].high)
        if len(shares) == 1
        else (*difference_limits(*estimates), *difference_limits(*oracles))
    )
    truth = shares[0] - sum(shares[1:])
    standard_error = np.sqrt((sum(shares) - truth**2) * design_effect / cases)
    width = float((high - low).mean())
    return RouteResult(
        coverage(truth, low, high)[0],
        width / float((known_high - known_low).mean()),
        width / (2.0 * NormalDist().inv_cdf(0.5 + 0.5 * LEVEL) * standard_error),
    )


def known_effect_limits(sums: F64, layout: Clusters, design_effect: float) -> ConfidenceLimits:
    """Limits of the oracle that knows the design effect."""
    cases = float(layout.size.sum())
    mean = sums.sum(axis=1) / cases
    return ConfidenceLimits(mean, *share_limits(mean, np.full(mean.shape, cases / design_effect)), "beta")


def route_lines(draws: int) -> list[str]:
    """Coverage and width on routes like those of `natural-uniform` and `frea`, as Markdown."""
    natural = natural_sizes()
    lines = [
        "Routes with unequal numbers of cases, as those of "
        f"`natural-uniform` ({natural.sum():.0f} cases on {len(natural)}) and `frea` (150 on 15).",
        "The cases of a route are alike by the design effect (beta-binomial). In brackets: the mean width over that",
        "of an oracle that knows the design effect, and over that of one that knows the standard error. A dash: routes",
        "too small for the design effect.",
    ]
    for title, columns in (
        ("Shares", {f"p = {share:g}": (share,) for share in ROUTE_SHARES}),
        (
            "Paired differences, by the shares of only the first and only the second",
            {f"{first:g} and {second:g}": (first, second) for first, second in FLIPS},
        ),
    ):
        lines += ["", f"{title}:", "", *head("Routes, design effect", list(columns))]
        results: dict[str, RouteResult] = {}
        for routes in ROUTE_COUNTS:
            layout = route_layout(routes, natural)
            for design_effect in DESIGN_EFFECTS:
                cells = []
                for column, shares in columns.items():
                    result = route_result(shares, layout, design_effect, draws)
                    cells.append("–" if result is None else result.text)
                    if result is not None:
                        results[f"{routes} routes, {design_effect:g}, {column}"] = result
                lines.append(row(f"{routes}, {design_effect:g}", cells))
        lines += ["", *_route_summary(results)]
    return lines


def _route_summary(results: dict[str, RouteResult]) -> list[str]:
    """Lowest coverage of a table, and where its intervals are more than 1.5 times as wide as an oracle's."""
    lowest = min(results, key=lambda name: results[name].coverage)
    lines = [f"* Lowest coverage: {percent(results[lowest].coverage)} ({lowest})."]
    widths = {
        "the design effect": {name: result.width for name, result in results.items()},
        "the standard error": {name: result.normal_width for name, result in results.items()},
    }
    for oracle, ratios in widths.items():
        wide = {name: ratio for name, ratio in ratios.items() if ratio > MAX_WIDTH_RATIO}
        columns = ", ".join(dict.fromkeys(name.split(", ", 2)[2] for name in wide))
        where = f"; all in the columns {columns}" if wide else ""
        lines.append(
            f"* More than {MAX_WIDTH_RATIO:g} times as wide as the oracle that knows {oracle}: {len(wide)} of "
            f"{len(ratios)}, at most {max(ratios.values()):.2f}{where}."
        )
    return lines


Limits = Callable[[F64, Clusters, float], tuple[F64, F64]]


def limits_here(sums: F64, layout: Clusters, _: float) -> tuple[F64, F64]:
    """Limits of SSAD."""
    limits = bounded_limits(sums, layout, cap=2.0 * float(layout.size.sum()))
    return limits.low, limits.high


def limits_of_effective(sums: F64, layout: Clusters, *, kurtosis: bool) -> tuple[F64, F64]:
    """Beta limits whose design effect is taken as it is estimated (Korn and Graubard 1998).

    The degrees of freedom are clusters less one, or those of the variance: fewer with the kurtosis of the clusters.
    """
    cases, clusters = float(layout.size.sum()), len(layout.size)
    mean = sums.sum(axis=1) / cases
    squares = ((sums - layout.size * mean[:, None]) / cases) ** 2
    min_effective = 1.0 / float((layout.weight**2).sum())
    with np.errstate(divide="ignore", invalid="ignore"):
        excess = clusters * (squares**2).sum(axis=1) / squares.sum(axis=1) ** 2 - 1.0
        freedom = np.clip(np.nan_to_num(2.0 * clusters / excess), 1.0, clusters - 1.0) if kurtosis else clusters - 1.0
        variance = squares.sum(axis=1) * clusters / (clusters - 1.0)
        quantiles = NormalDist().inv_cdf(0.5 + 0.5 * LEVEL) / t_quantile(freedom)
        effective = np.nan_to_num(mean * (1.0 - mean) / variance * quantiles**2, nan=min_effective)
    return share_limits(mean, np.clip(effective, min_effective, 2.0 * cases))


def limits_of_likelihood(sums: F64, layout: Clusters, _: float) -> tuple[F64, F64]:
    """Limits where the profile likelihood of the beta-binomial falls by half a Student quantile squared."""
    from scipy.special import betaln

    share = np.unique(np.concatenate([np.geomspace(1e-4, 0.05, 50), np.linspace(0.05, 0.95, 91)]))
    correlation = np.array([1e-4, 0.03, 0.1, 0.2, 0.3, 0.45, 0.6, 0.75, 0.9, 0.999])[:, None]
    first, second = share * (1.0 - correlation) / correlation, (1.0 - share) * (1.0 - correlation) / correlation
    likelihood = np.zeros((len(sums), *first.shape))
    for size in np.unique(layout.size):
        numbers = np.arange(size + 1.0)
        members = sums[:, layout.size == size]
        tally = np.stack([(members == number).sum(axis=1) for number in numbers], axis=1).astype(np.float64)
        terms = betaln(first + numbers[:, None, None], second + size - numbers[:, None, None]) - betaln(first, second)
        likelihood += np.tensordot(tally, terms, 1)
    profile = likelihood.max(axis=1)
    is_inside = profile >= profile.max(axis=1, keepdims=True) - 0.5 * t_quantile(len(layout.size) - 1.0) ** 2
    first_inside, last_inside = is_inside.argmax(axis=1), len(share) - 1 - is_inside[:, ::-1].argmax(axis=1)
    ends = np.concatenate([[0.0], share, [1.0]])  # the next points of the grid outside: never too narrow
    return ends[first_inside], ends[last_inside + 2]


def limits_if_known(sums: F64, layout: Clusters, design_effect: float) -> tuple[F64, F64]:
    """Limits that know the design effect, unless no case is an event: then as many cases as clusters."""
    oracle = known_effect_limits(sums, layout, design_effect)
    nothing = share_limits(oracle.mean, np.full(oracle.mean.shape, 1.0 / float((layout.weight**2).sum())))
    has_events = sums.any(axis=1)
    return np.where(has_events, oracle.low, nothing[0]), np.where(has_events, oracle.high, nothing[1])


ALTERNATIVES: dict[str, Limits] = {
    "here": limits_here,
    "the same without room for alike cases": lambda sums, layout, _: limits_of_effective(sums, layout, kurtosis=True),
    "degrees of freedom: clusters less one": lambda sums, layout, _: limits_of_effective(sums, layout, kurtosis=False),
    "profile likelihood of beta-binomial counts": limits_of_likelihood,
    "design effect known unless there is no event": limits_if_known,
}


def alternative_lines(draws: int) -> list[str]:
    """Coverage and width of other intervals of a share on the same routes, as Markdown."""
    natural = natural_sizes()
    shares = sorted({*ROUTE_SHARES, *np.linspace(0.02, 0.26, 9).round(3).tolist()})
    held: dict[str, list[float]] = {name: [] for name in ALTERNATIVES}
    held_alike: dict[str, list[float]] = {name: [] for name in ALTERNATIVES}
    widths: dict[tuple[str, int], list[float]] = {}
    for routes in ROUTE_COUNTS:
        layout = route_layout(routes, natural)
        greatest = float(layout.size @ layout.size) / float(layout.size.sum())
        for design_effect in (*(effect for effect in DESIGN_EFFECTS if effect < greatest), greatest):
            for share in shares:
                random = stream("alternatives", routes, design_effect, share)
                (sums,) = counts(random, draws, (share,), layout, correlation_of(design_effect, layout))
                oracle = known_effect_limits(sums, layout, design_effect)
                for name, limits in ALTERNATIVES.items():
                    low, high = limits(sums, layout, design_effect)
                    target = held_alike if design_effect == greatest else held
                    target[name].append(coverage(share, low, high)[0])
                    if design_effect < greatest and share in ROUTE_SHARES:
                        ratio = float((high - low).mean() / (oracle.high - oracle.low).mean())
                        widths.setdefault((name, routes), []).append(ratio)
    lines = [
        f"Other intervals of a share on the same routes ({draws:,} data sets a cell, shares from {shares[0]:g} to "
        f"{shares[-1]:g}): the",
        "lowest coverage with the design effects above and where all cases of a route are alike, the mean width over",
        "that of the oracle that knows the design effect, and the greatest ratio by the number of routes.",
        "",
        *head(
            "Interval",
            ["lowest coverage", "lowest, all alike", "mean width", *(f"greatest, {k} routes" for k in ROUTE_COUNTS)],
        ),
    ]
    for name in ALTERNATIVES:
        ratios = [widths[name, routes] for routes in ROUTE_COUNTS]
        cells = [percent(min(held[name])), percent(min(held_alike[name])), f"{np.mean(np.concatenate(ratios)):.2f}"]
        lines.append(row(name, [*cells, *(f"{max(values):.2f}" for values in ratios)]))
    return lines


def exact_limits(method: str, n: int) -> tuple[F64, F64]:
    """Limits [n + 1] of a share, by the number of events in n independent cases."""
    from scipy import special, stats

    k = np.arange(n + 1.0)
    tail, z = 0.025, float(stats.norm.ppf(0.975))
    if method == "here":
        events = (np.arange(n)[None] < k[:, None]).astype(np.float64)
        found = bounded_limits(events, design(n, 1), cap=2.0 * n)
        return found.low, found.high
    if method == "Wilson":
        centre, half = k / n + z * z / (2 * n), z * np.sqrt(k / n * (1 - k / n) / n + z * z / (4 * n * n))
        return (centre - half) / (1 + z * z / n), (centre + half) / (1 + z * z / n)
    if method.startswith("logit"):  # with half an event on either side
        wide = (z if method == "logit" else stats.t.ppf(0.975, n - 1)) * np.sqrt(1 / (k + 0.5) + 1 / (n - k + 0.5))
        odds = np.log((k + 0.5) / (n - k + 0.5))
        return special.expit(odds - wide), special.expit(odds + wide)
    part = {"Clopper-Pearson": 0.0, "Jeffreys": 0.5}.get(method)
    if part is not None:
        low = special.betaincinv(np.maximum(k + part, 1e-300), n - k + 1 - part, tail)
        high = special.betaincinv(k + 1 - part, np.maximum(n - k + part, 1e-300), 1 - tail)
    else:  # mid-P: half of what was seen counts as more extreme
        low, high = np.zeros(n + 1), np.ones(n + 1)
        for _ in range(60):  # a bisection of all at once, the upper limit by symmetry
            middle = 0.5 * (low + high)
            beyond = stats.binom.sf(k, n, middle) + 0.5 * stats.binom.pmf(k, n, middle)
            low, high = np.where(beyond < tail, middle, low), np.where(beyond < tail, high, middle)
        high = 1.0 - low[::-1]
    return np.where(k == 0, 0.0, low), np.where(k == n, 1.0, high)


def exact_coverage(n: int, low: F64, high: F64, shares: F64) -> F64:
    """Coverage for the share of events in n independent cases, computed, not simulated."""
    from scipy import stats

    chance = stats.binom.pmf(np.arange(n + 1)[:, None], n, shares)
    held = (low[:, None] <= shares + 1e-12) & (high[:, None] >= shares - 1e-12)
    return np.asarray((chance * held).sum(axis=0))


def least_possible(n: int, shares: F64) -> F64:
    """The least coverage of 93 % or more that any interval can have: of an unbroken range of numbers of events."""
    from scipy import stats

    sums = np.concatenate([np.zeros((1, len(shares))), stats.binom.pmf(np.arange(n + 1)[:, None], n, shares)]).cumsum(0)
    ranges = np.stack([sums[b] - sums[a] for a in range(n + 1) for b in range(a + 1, n + 2)])
    return np.asarray(np.where(ranges >= 0.93, ranges, 1.0).min(axis=0))


def exact_lines() -> list[str]:
    """Methods for few independent cases, as Markdown: least and greatest coverage where p is from 0.1 to 0.9."""
    shares, counts = np.linspace(0.1, 0.9, 801), (5, 6, 8, 16, 32)
    lines = [
        "Few independent yes-or-no cases, computed: least–greatest coverage for p from 0.1 to 0.9. Last row: what no",
        "interval can go below where it is 93 or more.",
        "",
        *head("Method", [f"{n} cases" for n in counts]),
    ]
    for method in ("here", "Clopper-Pearson", "mid-P", "Wilson", "Jeffreys", "logit", "logit, Student"):
        found = [exact_coverage(n, *exact_limits(method, n), shares) for n in counts]
        lines.append(row(method, [f"{percent(one.min())}–{percent(one.max())}" for one in found]))
    found = [least_possible(n, shares) for n in counts]
    return [*lines, row("least possible", [f"{percent(one.min())}–{percent(one.max())}" for one in found])]


def row(head: str, cells: list[str]) -> str:
    """A line of a Markdown table."""
    return f"| {head} | " + " | ".join(cells) + " |"


def head(first: str, columns: list[str]) -> list[str]:
    """Head of a Markdown table."""
    return [row(first, columns), "|---|" + "---:|" * len(columns)]


def percent(value: float) -> str:
    """A coverage as it stands in the tables."""
    return "" if np.isnan(value) else f"{100 * value:.1f}"


def mean_cell(found: tuple[float, float]) -> str:
    """Coverage, with the share of data sets that have an interval if not all have; too few to tell: a dash."""
    held, given = found
    return percent(held) if given == 1.0 else f"{percent(held)} ({100 * given:.0f})" if given >= 0.1 else "–"


def tables(draws: int, detector_draws: int) -> list[str]:
    """All tables as Markdown."""
    lines = [
        f"{draws:,} data sets a cell (average precision: {detector_draws:,}); percent that hold the true mean.",
        "",
    ]
    lines += ["Shares (CR and the like). Clusters x cases in each, and how alike the cases of a cluster are:", ""]
    lines += head("Data", [f"p = {p:g}" for p in SHARES])
    for clusters, cases in DESIGNS:
        for correlation in CORRELATIONS if cases > 1 else (0.0,):
            name = f"{clusters} x {cases}" + (f", correlation {correlation:g}" if cases > 1 else "")
            found = [share_coverage(p, design(clusters, cases), correlation, draws) for p in SHARES]
            lines.append(row(name, [percent(value) for value in found]))
    lines += ["", *route_lines(draws), "", *alternative_lines(draws // 2), "", *exact_lines()]
    kinds = [(1, 0.0), *((10, c) for c in CORRELATIONS)]
    titles = ["1 case", *(f"10 cases, correlation {c:g}" for c in CORRELATIONS)]
    lines += ["", "The average of eight groups with four clusters each; p in the groups:", "", *head("p", titles)]
    for name, shares in STRATA.items():
        each = np.repeat(shares, 4)
        found = [share_coverage(each, design(4, cases, 8), c, draws) for cases, c in kinds]
        lines.append(row(name, [percent(value) for value in found]))
    lines += [
        "",
        "Means. In brackets: percent of the data sets that have an interval, where not all have one; a dash: fewer",
        "than 10. In the last rows the average of eight groups with four clusters each.",
        "",
        *head("Data", list(MEANS)),
    ]
    for clusters, cases in DESIGNS:
        for correlation in (0.0, 0.3, 0.8) if cases > 1 else (0.0,):
            name = f"{clusters} x {cases}" + (f", correlation {correlation:g}" if cases > 1 else "")
            found = [mean_cell(mean_coverage(n, design(clusters, cases), correlation, draws)) for n in MEANS]
            lines.append(row(name, found))
    for cases, correlation in ((1, 0.0), (10, 0.3), (10, 0.8)):
        name = f"8 groups, 4 x {cases}" + (f", correlation {correlation:g}" if cases > 1 else "")
        lines.append(row(name, [mean_cell(mean_coverage(n, design(4, cases, 8), correlation, draws)) for n in MEANS]))
    truths = ((0.3, 0.3), (0.5, 0.1), (0.8, 0.3), (0.1, 0.05))
    lines += ["", "Average precision, 100 replicates of the bootstrap over scenes:", ""]
    lines += head("Scenes", [f"recall {recall:g}, correlation {c:g}" for recall, c in truths])
    for scenes in (8, 24, 150):
        found = [detection_coverage(scenes, recall, c, detector_draws) for recall, c in truths]
        lines.append(row(str(scenes), [percent(value) for value in found]))
    return lines


def main() -> None:
    """Make the tables and write them into the document."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="few data sets; print, write nothing")
    quick = parser.parse_args().quick
    lines = tables(200, 20) if quick else tables(4000, 1000)
    if quick:
        print("\n".join(lines))
        return
    before, _, rest = DOCUMENT.read_text().partition(MARKERS[0])
    after = rest.partition(MARKERS[1])[2]
    DOCUMENT.write_text("\n".join([before + MARKERS[0], "", *lines, "", MARKERS[1] + after]))


if __name__ == "__main__":
    assert MIN_CLUSTERS == 5, "the designs begin at five clusters"
    assert min(ROUTE_COUNTS) == MIN_ROUTES, "the routes begin where intervals do"
    main()
