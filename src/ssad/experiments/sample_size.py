"""CaseSample size of a suite: the cases that it has, and those that a difference of two rates needs."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from ssad.core import safeio
from ssad.core.errors import ConfigError
from ssad.core.registry import label_of
from ssad.core.wording import counted
from ssad.engine.kind import Cell, Kind, Plan, SuiteBase
from ssad.experiments.suites import KINDS, kind_of
from ssad.metrics.intervals import MIN_ROUTES
from ssad.metrics.sample_size import (
    CaseSample,
    FlipRate,
    detectable_difference,
    necessary_clusters,
    power,
    unpaired_power,
)
from ssad.report.flips import PairFlips, pair_flips
from ssad.report.load import Run, load_run

REFERENCE = Path(__file__).with_name("flip_rates.json")
"""Flip rates of the shipped systems; `python -m benchmarks.flip_rates` measures them."""

MAX_PAIRS = 6
"""Pairs of the first rate that are listed; of the other rates it is one."""

HEADS = ("rate", "pair", "difference", "flip rate", "design effect", "cases", "clusters", "unpaired", "suite detects")


@dataclass(frozen=True)
class Measurement:
    """Flip rates and their source.

    Attributes:
        pairs: Flip rates by rate and pair of conditions, without those in which no outcome differs.
        cases: Cases behind them.
        source: Source in words.
    """

    pairs: tuple[PairFlips, ...]
    cases: int
    source: str


@dataclass(frozen=True)
class Need:
    """Cases that a difference needs.

    Attributes:
        pair: Measured flip rate.
        clusters: Clusters of paired cases; None: no number is enough.
        unpaired_clusters: Clusters of each system if they meet different cases.
        detectable: Least difference that the suite detects, in hundredths.
    """

    pair: PairFlips
    clusters: int | None
    unpaired_clusters: int | None
    detectable: float | None


def sample_of(plan: Plan) -> CaseSample:
    """Return the cases of a plan: scenarios with their repetitions, which all systems meet, in their clusters."""
    clusters = {_case(cell): str(cell.fields.get("cluster") or _case(cell)) for cell in plan.cells}
    return CaseSample.of(clusters.values())


def sample_line(plan: Plan) -> str:
    """Return the number of cases and clusters of a plan in words."""
    sample = sample_of(plan)
    cells_per_case = max(Counter(_case(cell) for cell in plan.cells).values())
    cell_count = counted(cells_per_case, "cell")
    return f"cases: {sample.cases:.0f} in {counted(sample.clusters, 'cluster')}, each met by up to {cell_count}"


def check_rates(suite: SuiteBase) -> None:
    """Raise ConfigError if the cells of a suite have no rates: that takes no plan, which may need minutes."""
    kind = kind_of(suite.kind)
    if not kind.rates:
        kinds = ", ".join(name for name in KINDS if kind_of(name).rates)
        raise ConfigError(
            f"suite {suite.name}: --detect compares shares of cells, which kind '{kind.name}' does not have; "
            f"it works for suites of the kinds {kinds}"
        )


def detection_lines(plan: Plan, difference: float, *, target: float, folders: Sequence[Path] = ()) -> list[str]:
    """Return how many cases a difference of the plan's rates needs, a line each.

    Args:
        plan: Plan of a suite.
        difference: Difference that is to be detected, above 0.
        target: Power: probability that it is detected.
        folders: Runs whose flip rates are used; none: those of the reference.

    Raises:
        ConfigError: The kind has no rates, there are no flip rates for it, or a run is of another kind.
        StoreError: A folder holds no run with results.
    """
    kind = plan.kind
    check_rates(plan.suite)
    measurement = measure_runs(kind, folders) if folders else reference_measurement(plan)
    sample = sample_of(plan)
    # Pairs that differ by about as much come first: their flip rate is that of such a difference.
    pairs = sorted(measurement.pairs, key=lambda pair: abs(abs(pair.flips.difference) - difference))
    needs = {
        rate: [_need(pair, difference, sample, target=target) for pair in pairs if pair.rate == rate]
        for rate in kind.rates
    }
    return [
        f"to detect a difference of {difference:g} with 95 % confidence and a power of {target:g}:",
        *_table([HEADS, *_rows(needs, sample)]),
        *_remarks(needs, measurement, sample),
    ]


def measure_runs(kind: Kind, folders: Sequence[Path]) -> Measurement:
    """Return the flip rates of results folders.

    Args:
        kind: Kind of the runs.
        folders: Their folders.

    Raises:
        ConfigError: A run is of another kind, or no two conditions share a case.
        StoreError: A folder holds no run with results.
    """
    runs = [load_run(folder) for folder in dict.fromkeys(folders)]
    for run in runs:
        if run.kind != kind.name:
            raise ConfigError(f"{run.folder}: a run of kind '{run.kind}' says nothing about kind '{kind.name}'")
    return _measurement(kind, runs, f"measured in {', '.join(str(run.folder) for run in runs)}")


def reference_measurement(plan: Plan) -> Measurement:
    """Return the measured flip rates of shipped systems on the scenarios that are most like those of a suite.

    Args:
        plan: Plan of the suite.

    Raises:
        ConfigError: Nothing was measured for its kind.
    """
    data = safeio.read_json(REFERENCE)
    measurements = [entry for entry in data["measurements"] if entry["kind"] == plan.kind.name]
    if not measurements:
        raise ConfigError(
            f"suite {plan.suite.name}: no flip rates of kind '{plan.kind.name}' have been measured; "
            "run a part of the suite and name its folder: --runs FOLDER"
        )
    scenarios = set(plan.suite.scenarios)

    def likeness(entry: Mapping[str, Any]) -> float:
        return len(scenarios & set(entry["scenarios"])) / len(scenarios | set(entry["scenarios"]))

    best = max(measurements, key=likeness)
    source = f"measured on {' and '.join(best['scenarios'])} ({best['cases']} cases), commit {data['commit']}"
    if likeness(best) < 1.0:
        source += "; the scenarios of this suite are others: measure them with --runs FOLDER"
    systems = {label_of(cell.system) for cell in plan.cells}
    pairs = tuple(pair_from(entry) for entry in best["pairs"])
    if len(systems & set(best["systems"])) > 1:
        pairs = tuple(pair for pair in pairs if {pair.first, pair.second} <= systems)
    else:
        source += "; of shipped systems, since those of this suite were not measured"
    return Measurement(pairs, best["cases"], source)


def reference_entry(run: Run, kind: Kind, scenarios: Sequence[str], selection: Sequence[str]) -> dict[str, Any]:
    """Return the flip rates of a run as plain data for the reference.

    Args:
        run: The run.
        kind: Its kind.
        scenarios: References of its scenarios, such as the set natural.
        selection: Names of the scenarios that count.
    """
    lines = tuple(line for line in run.lines if line["spec"]["scenario"]["name"] in set(selection))
    measurement = _measurement(kind, [replace(run, lines=lines)], "")
    return {
        "kind": kind.name,
        "scenarios": list(scenarios),
        "systems": list(dict.fromkeys(str(line["system"]) for line in lines)),
        "cases": measurement.cases,
        "pairs": [_rounded(asdict(pair)) for pair in measurement.pairs],
    }


def _measurement(kind: Kind, runs: Sequence[Run], source: str) -> Measurement:
    pairs = pair_flips(runs, kind.rates, kind.factors)
    if not pairs:
        raise ConfigError(
            f"{', '.join(str(run.folder) for run in runs)}: no two systems or perturbations met the same cases; "
            "give a run, or several runs of one suite, with two of them"
        )
    cases = round(max(pair.flips.sample.cases for pair in pairs))
    return Measurement(tuple(pair for pair in pairs if pair.flips.flips), cases, source)


def _rounded(value: Any) -> Any:
    """Return plain data with four digits after the point; null for NaN."""
    if isinstance(value, Mapping):
        return {name: _rounded(part) for name, part in value.items()}
    if isinstance(value, float):
        return None if math.isnan(value) else round(value, 4)
    return value


def pair_from(entry: Mapping[str, Any]) -> PairFlips:
    """Return a flip rate from plain data, in which null stands for NaN."""
    numbers: dict[str, Any] = {name: math.nan if value is None else value for name, value in entry["flips"].items()}
    flips = FlipRate(**(numbers | {"sample": CaseSample(**numbers["sample"])}))
    return PairFlips(entry["rate"], entry["first"], entry["second"], flips)


def _need(pair: PairFlips, difference: float, sample: CaseSample, *, target: float) -> Need:
    flips = pair.flips
    # Where the cases of one cluster cannot be compared, they count as all alike.
    correlation, rate_correlation = (
        1.0 if math.isnan(value) else value for value in (flips.correlation, flips.rate_correlation)
    )
    flip_rate = max(flips.rate, difference)  # a difference flips at least as many cases
    return Need(
        pair,
        necessary_clusters(lambda size: power(difference, flip_rate, size, correlation), sample, target=target),
        necessary_clusters(
            lambda size: unpaired_power(difference, flips.mean_rate, size, rate_correlation), sample, target=target
        ),
        detectable_difference(flips.rate, sample, correlation, target=target),
    )


def _rows(needs: Mapping[str, Sequence[Need]], sample: CaseSample) -> Iterator[tuple[str, ...]]:
    """Yield the lines of the table: several pairs of the first rate, and the first pair of each other rate."""
    for rate_index, rate_needs in enumerate(needs.values()):
        for need in rate_needs[: 1 if rate_index else MAX_PAIRS]:
            flips = need.pair.flips
            yield (
                need.pair.rate,
                f"{need.pair.first}, {need.pair.second}",
                f"{abs(flips.difference):.2f}",
                f"{flips.rate:.2f} ({flips.flips} of {flips.sample.cases:.0f})",
                "n/a" if math.isnan(flips.design_effect) else f"{flips.design_effect:.1f}",
                _count(need.clusters, sample.mean_size),
                _count(need.clusters, 1.0),
                _count(need.unpaired_clusters, sample.mean_size),
                "nothing" if need.detectable is None else f"{need.detectable:.2f}",
            )
        hidden_count = len(rate_needs) - MAX_PAIRS
        if not rate_index and hidden_count > 0:
            yield (rate_needs[0].pair.rate, f"and {hidden_count} other pairs", *[""] * (len(HEADS) - 2))


def _remarks(needs: Mapping[str, Sequence[Need]], measurement: Measurement, sample: CaseSample) -> Iterator[str]:
    """Yield sentences about the suite, the measured flip rates and the columns."""
    size = f"The suite has {counted(sample.cases, 'case')} in {counted(sample.clusters, 'cluster')}"
    first_needs = next(iter(needs.values()))
    if sample.clusters < MIN_ROUTES:
        yield f"{size}: with fewer than {MIN_ROUTES} there is no interval, and no difference is detected."
    elif first_needs:
        enough_count = sum(need.clusters is not None and need.clusters <= sample.clusters for need in first_needs)
        yield f"{size}: enough for {enough_count} of {len(first_needs)} pairs in {first_needs[0].pair.rate}."
    else:
        yield f"{size}."
    silent = [rate for rate, rate_needs in needs.items() if not rate_needs]
    if silent:
        yield f"Unknown: {', '.join(silent)}; no outcome differs in {measurement.cases} cases."
    yield f"Flip rates: {measurement.source}."
    yield (
        "difference, flip rate, design effect: as measured; pairs that differ by about as much as is to be detected "
        "come first. A flip rate below that counts as that, since a difference flips at least as many cases."
    )
    yield (
        f"cases, clusters: paired, both systems in each, with {sample.mean_size:.1f} cases a cluster as in the suite; "
        "further cases on the same clusters are worth less."
    )
    yield "unpaired: cases of each of two systems that meet different ones, such as another seed or other scenarios."


def _table(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return rows as lines of aligned columns, the first two to the left."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            text.ljust(width) if index < 2 else text.rjust(width)
            for index, (text, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


def _count(clusters: int | None, mean_size: float) -> str:
    return "none" if clusters is None else f"{math.ceil(clusters * mean_size):,}"


def _case(cell: Cell) -> str:
    """Return a key of the case that a cell is: the scenario and its repetition, which other systems meet too."""
    scenario = cell.spec.get("scenario")
    return f"{scenario['name']}#{cell.spec.get('repetition', 0)}" if scenario else cell.name
