"""Flip rates between the conditions of runs: systems, or one system under several perturbations."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from ssad.metrics.sample_size import FlipRate, flip_rate
from ssad.metrics.uncertainty import CaseValue
from ssad.report.load import Run
from ssad.report.records import Line, case_of, metric_of, scenario_of

SUBJECT = "system"
SCENARIO_FACTORS = ("group",)
"""Factors of tables that belong to the scenario, and not to the condition in which it is met."""

Condition = tuple[str, tuple[str, ...], str]
"""System, its other factors, and the folder of its run where several runs have both."""


@dataclass(frozen=True)
class PairFlips:
    """Flip rate of two conditions.

    Attributes:
        rate: Symbol of the rate.
        first: Name of the first condition.
        second: Name of the second condition.
        flips: Their outcomes in the same cases.
    """

    rate: str
    first: str
    second: str
    flips: FlipRate


def pair_flips(runs: Sequence[Run], rates: Mapping[str, str], factors: Sequence[str]) -> list[PairFlips]:
    """Return the flip rates of all pairs that differ in their system alone, or in their other factors alone.

    Cases belong together if scenario, repetition and seed are the same.

    Args:
        runs: Runs of one kind.
        rates: Symbol of a rate -> metric that is above 0 where the event occurred.
        factors: Fields of the records that tell conditions apart; those of the scenario are ignored.
    """
    conditions = _conditions(runs, [name for name in factors if name not in (SUBJECT, *SCENARIO_FACTORS)])
    pairs = []
    for rate, metric in rates.items():
        values = {condition: _values(lines, metric) for condition, lines in conditions.items()}
        for first, second in itertools.combinations(values, 2):
            if first[0] == second[0] or first[1] == second[1]:
                flips = flip_rate(values[first], values[second])
                if flips is not None:
                    pairs.append(PairFlips(rate, _name(first), _name(second), flips))
    return pairs


def _conditions(runs: Sequence[Run], factors: Sequence[str]) -> dict[Condition, list[Line]]:
    """Return the lines of each condition, with the folder of its run where several runs have it."""
    lines_by_run = [(run, _key(line, factors), line) for run in runs for line in run.lines]
    places = Counter(key for key, _ in dict.fromkeys((key, run.folder) for run, key, _ in lines_by_run))
    conditions: dict[Condition, list[Line]] = {}
    for run, key, line in lines_by_run:
        folder = str(run.folder) if places[key] > 1 else ""
        conditions.setdefault((*key, folder), []).append(line)
    return conditions


def _key(line: Line, factors: Sequence[str]) -> tuple[str, tuple[str, ...]]:
    return str(line.get(SUBJECT) or ""), tuple(str(line.get(name) or "") for name in factors)


def _name(condition: Condition) -> str:
    subject, others, folder = condition
    name = " ".join(part for part in (subject, *others) if part)
    return f"{name} ({folder})" if folder else name


def _values(lines: Sequence[Line], metric: str) -> dict[str, CaseValue]:
    """Return whether the event occurred, 0 or 1, by scenario, repetition and seed."""
    values = {}
    for line in lines:
        number = metric_of(line, metric)
        case_value = case_of(line, math.nan if math.isnan(number) else float(number > 0.0))
        repetition = (line.get("spec") or {}).get("repetition", 0)
        key = f"{scenario_of(line)}#{repetition}#{line.get('seed', 0)}"
        values[key] = replace(case_value, cluster=str(line.get("cluster") or scenario_of(line)))
    return values
