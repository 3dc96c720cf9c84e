"""Two or more runs side by side: differences cell by cell, with intervals and a test, and what changed between them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from ssad.core import safeio
from ssad.core.errors import ConfigError
from ssad.metrics import METRICS, CaseValue, Estimate, Outcome, paired_difference, replicate_difference, sign_flip_test
from ssad.report.load import Run, load_run
from ssad.report.pages import render
from ssad.report.tables import METHODS, Cell, Row, Table, write_tables

SHOWN = ("CR", "OR", "DR", "RC", "DS")
EVERYTHING = "all"
_SUBJECTS = ("system", "detector")


@dataclass(frozen=True)
class ComparedRun:
    """One of the runs that are compared.

    Attributes:
        label: What tables call it.
        run: The run.
    """

    label: str
    run: Run

    @cached_property
    def lines(self) -> Mapping[tuple[str, str], Mapping[str, Any]]:
        """(subject, cell without its subject) -> its line; the subject is the system or detector that is tested."""
        found = {}
        for line in self.run.lines:
            subject = next((str(line[name]) for name in _SUBJECTS if line.get(name)), "")
            name = self.run.names.get(line["key"], line["key"])
            found[subject, name.removeprefix(f"{subject}/")] = line
        return found

    @property
    def subjects(self) -> list[str]:
        """Systems or detectors, in the order of the suite."""
        return list(dict.fromkeys(subject for subject, _ in self.lines))


@dataclass(frozen=True)
class Comparison:
    """A run beside the first one.

    Attributes:
        first: The run that others are compared with.
        second: The run that is compared with it.
        table: Differences over all cells, or of each cell where the metrics are scores.
        groups: Differences in each group of scenarios; None where the metrics are scores.
        changes: What differs between the runs' headers, a line each.
        verdicts: Cells whose outcome changed, a line each.
        findings: What differs by more than chance, a sentence for each system or detector.
        equal: Cells whose metrics are equal to the last digit, of those that both runs measure.
        both: Cells that both have.
        only: How many cells only the first has, and only the second.
        left_out: Systems or detectors that only one of them has.
    """

    first: ComparedRun
    second: ComparedRun
    table: Table
    groups: Table | None
    changes: tuple[str, ...]
    verdicts: tuple[str, ...]
    findings: tuple[str, ...]
    equal: int
    both: int
    only: tuple[int, int]
    left_out: tuple[str, ...]


def compare_runs(folders: Sequence[Path]) -> list[Comparison]:
    """Compare runs with the first of them, cell by cell.

    Cells belong together if they have the same name: the same scenario and repetition, the same shift and severity,
    and the same system or detector. If the runs test one system each, these are compared, whatever they are called.

    Args:
        folders: Two or more run folders of one kind.

    Returns:
        A comparison for each folder but the first.

    Raises:
        ConfigError: Fewer than two folders, runs of different kinds, or runs that share no cell.
        StoreError: A folder holds no run with results.
    """
    if len(folders) < 2:
        raise ConfigError("compare needs at least two results folders, such as: ssad compare runs/a runs/b")
    labels = _labels(folders)
    runs = [ComparedRun(label, load_run(folder)) for label, folder in zip(labels, folders, strict=True)]
    for other in runs[1:]:
        if other.run.kind != runs[0].run.kind:
            kinds = f"{runs[0].run.kind} and {other.run.kind}"
            raise ConfigError(f"{other.run.folder}: runs of different kinds cannot be compared ({kinds})")
    return [_compare(runs[0], other, number) for number, other in enumerate(runs[1:], 1)]


def write_comparison(folders: Sequence[Path], out: Path) -> tuple[Path, list[Comparison]]:
    """Compare runs and write OUT/compare.html and OUT/tables/difference*.csv|md|tex.

    Args:
        folders: As for `compare_runs`.
        out: Where they go.

    Returns:
        Path of the page, and the comparisons.

    Raises:
        ConfigError: As for `compare_runs`.
        StoreError: A folder holds no run with results, or the files cannot be written.
    """
    found = compare_runs(folders)
    safeio.make_folder(out)
    write_tables(out, [table for each in found for table in (each.table, each.groups) if table])
    path = out / "compare.html"
    safeio.write_atomic(path, render("compare.html", found[0].first.run, comparisons=found))
    return path, found


def _labels(folders: Sequence[Path]) -> list[str]:
    """The shortest ends of the folders' paths that tell them apart."""
    parts = [folder.resolve().parts for folder in folders]
    for length in range(1, max(map(len, parts)) + 1):
        found = ["/".join(each[-length:]) for each in parts]
        if len(set(found)) == len(found):
            return found
    raise ConfigError("a run is compared with itself; give different folders")


def _compare(first: ComparedRun, second: ComparedRun, number: int) -> Comparison:
    pairs = _subject_pairs(first, second)
    rows: list[Row] = []
    verdicts: list[str] = []
    equal = both = 0
    only = [0, 0]
    for a, b in pairs:
        own = {name: line for (subject, name), line in first.lines.items() if subject == a}
        other = {name: line for (subject, name), line in second.lines.items() if subject == b}
        shared = [name for name in own if name in other]
        both += len(shared)
        only = [only[0] + len(own) - len(shared), only[1] + len(other) - len(shared)]
        equal += sum(_equal(_metrics(own[name]), _metrics(other[name])) for name in shared)
        title = a if a == b else f"{a} → {b}"
        verdicts += [f"{title}/{name}: {told}" for name in shared if (told := _verdict(own[name], other[name]))]
        if shared:
            rows += _rows(first.run, second.run, title, own, other)
    if not both:
        raise ConfigError(f"{second.run.folder}: it shares no cell with {first.run.folder}; run the same suite twice")
    note = (
        f"Difference: {second.label} minus {first.label}, over the cells that both have. p: how often chance alone "
        f"makes as large a difference (signs of the clusters' differences drawn anew). {METHODS}"
    )
    columns = (first.label, second.label, "difference", "p")
    name = "difference" if number == 1 else f"difference_{number}"
    whole = [row for row in rows if row.head[1] == EVERYTHING]
    title, heads = f"{second.label} beside {first.label}", (*_heads(first.run), "Metric")
    table = Table(name, title, heads, columns, tuple(whole or rows), note)
    apart = tuple(row for row in rows if row.head[1] != EVERYTHING)
    groups = Table(f"{name}_groups", "Each group of scenarios", heads, columns, apart, note) if whole else None
    left_out = {*first.subjects, *second.subjects} - {name for pair in pairs for name in pair}
    return Comparison(
        first,
        second,
        table,
        groups,
        changes=tuple(_changes(first.run, second.run)),
        verdicts=tuple(verdicts),
        findings=tuple(_findings(table)),
        equal=equal,
        both=both,
        only=(only[0], only[1]),
        left_out=tuple(sorted(left_out)),
    )


def _findings(table: Table) -> Iterator[str]:
    """Sentences about the differences that remain when as many are tested as the table has (Holm, 5 %)."""
    tested = [row for row in table.rows if not math.isnan(row.cells[-1].mean)]
    tested.sort(key=lambda row: row.cells[-1].mean)
    told: dict[str, list[str]] = {}
    for k, row in enumerate(tested):
        before, now, difference, p = row.cells
        if p.mean > 0.05 / (len(tested) - k):
            break
        what = " ".join(name for name in row.head[1:] if name != EVERYTHING)
        change = f"{difference.text} {difference.interval}".strip()
        told.setdefault(row.head[0], []).append(f"{what} {before.text} → {now.text} ({change})")
    for subject, changes in told.items():
        more = f" and {len(changes) - 4} more" if len(changes) > 4 else ""
        yield f"{subject}: {', '.join(changes[:4])}{more}: more than chance alone makes."
    if not tested:
        yield "There is too little data to tell a difference from chance."
    elif not told:
        yield "No difference is larger than chance alone makes."


def _equal(own: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    both = {name for name in own.keys() & other.keys() if own[name] is not None and other[name] is not None}
    return bool(both) and all(own[name] == other[name] for name in both)


def _heads(run: Run) -> tuple[str, str]:
    names = [name.replace("_", " ").capitalize() for name in run.header.get("factors") or ["system", "group"]]
    return names[0], names[1] if len(names) > 1 else "Group"


def _subject_pairs(first: ComparedRun, second: ComparedRun) -> list[tuple[str, str]]:
    """Which subject of the first run is compared with which of the second."""
    shared = [name for name in first.subjects if name in second.subjects]
    if shared:
        return [(name, name) for name in shared]
    if len(first.subjects) == len(second.subjects) == 1:
        return [(first.subjects[0], second.subjects[0])]
    raise ConfigError(
        f"{second.run.folder}: none of its systems or detectors is in {first.run.folder}, and there are several; "
        "compare runs of one each"
    )


def _rows(
    first: Run, second: Run, title: str, own: Mapping[str, Mapping[str, Any]], other: Mapping[str, Mapping[str, Any]]
) -> Iterator[Row]:
    """Differences of one subject: of all cells that both have if the metrics are means, then of each group."""
    if first.kind == "driving":
        groups = {EVERYTHING: list(own)} | {
            group: [name for name in own if own[name]["group"] == group]
            for group in dict.fromkeys(line["group"] for line in own.values())
        }
        for group, names in groups.items():
            ours, theirs = ({n: run[n] for n in names if n in run} for run in (own, other))
            if set(ours) & set(theirs):
                for symbol in SHOWN:
                    yield _driving_row(title, group, symbol, ours, theirs)
        return
    same = first.suite.get("seed") == second.suite.get("seed")
    for name in own:
        if name in other:
            for metric in _common_metrics(first, own[name], other[name]):
                yield _score_row(title, name, metric, own[name], other[name], paired=same)


def _driving_row(
    title: str, group: str, symbol: str, own: Mapping[str, Mapping[str, Any]], other: Mapping[str, Mapping[str, Any]]
) -> Row:
    metric = METRICS[symbol]
    kind = "share" if metric.kind == "share" else "mean"
    values = [{name: _case(line, metric.field, kind) for name, line in lines.items()} for lines in (own, other)]
    shared = set(own) & set(other)
    ran = [name for name in shared if not any(v[name].failed or math.isnan(v[name].value) for v in values)]
    found = paired_difference(values[1], values[0], kind=kind)  # type: ignore[arg-type]
    test = Cell(sign_flip_test(values[1], values[0]), digits=4)
    means = [Cell(math.fsum(v[name].value for name in ran) / len(ran) if ran else math.nan) for v in values]
    return Row((title, group, symbol), (*means, Cell.of(found), test))


def _case(line: Mapping[str, Any], field: str, kind: str) -> CaseValue:
    """What a line gives to a metric, without what a failed episode counts as: a pair needs two that ran."""
    outcome = Outcome.from_record(line)
    number = None if outcome.metrics is None else getattr(outcome.metrics, field)
    value = math.nan if number is None else float(number)
    if kind == "share" and not math.isnan(value):
        value = float(value > 0.0)
    return CaseValue(value, outcome.cluster, outcome.case, failed=outcome.metrics is None)


def _score_row(
    title: str, name: str, metric: str, own: Mapping[str, Any], other: Mapping[str, Any], *, paired: bool
) -> Row:
    """A score in each run; the interval of the difference where both resampled the same scenes in the same way."""
    a, b = float(own["metrics"][metric]), float(other["metrics"][metric])
    draws = [(line.get("replicates") or {}).get(metric) or [] for line in (own, other)]
    scenes, others = (int(line.get("scenes") or line.get("drives") or 0) for line in (own, other))
    found = Estimate(b - a, math.nan, math.nan, int(own.get("n", 1)), clusters=scenes)
    p = math.nan
    if paired and scenes == others and own.get("n") == other.get("n") and len(draws[0]) == len(draws[1]):
        found, p = _replicate_difference(b - a, [y - x for x, y in zip(*draws, strict=True)], found)
    return Row((title, name, metric), (Cell(a), Cell(b), Cell.of(found), Cell(p, digits=4)))


def _replicate_difference(value: float, draws: Sequence[float], bare: Estimate) -> tuple[Estimate, float]:
    """Interval and p-value of a difference of scores in [0, 1]; its limits are those of (1 + difference) / 2."""
    found = replicate_difference(value, draws, n=bare.n, clusters=bare.clusters)
    known = [d for d in draws if not math.isnan(d)]
    if math.isnan(found.low) or not known:
        return bare, math.nan
    beyond = min(sum(d <= 0.0 for d in known), sum(d >= 0.0 for d in known))
    return found, min(2.0 * (beyond + 1) / (len(known) + 1), 1.0)


def _common_metrics(run: Run, own: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """Metrics that both lines have a number for, in the order of the kind's columns."""
    mine, theirs = _metrics(own), _metrics(other)
    columns = [str(column["name"]) for column in run.header.get("columns") or []] or list(mine)
    return [name for name in columns if all(isinstance(values.get(name), int | float) for values in (mine, theirs))]


def _metrics(line: Mapping[str, Any]) -> Mapping[str, Any]:
    return line.get("metrics") or {} if line["status"] == "ok" else {}


def _verdict(own: Mapping[str, Any], other: Mapping[str, Any]) -> str:
    """How a cell's outcome changed: whether it ran, whether it collided; empty if it did not."""
    states = [_state(line) for line in (own, other)]
    return "" if states[0] == states[1] else f"{states[0]} before, {states[1]} now"


def _state(line: Mapping[str, Any]) -> str:
    if line["status"] != "ok":
        return str(line["status"])
    collided = _metrics(line).get("collision")
    return "ran" if collided is None else "collision" if collided else "no collision"


def _changes(first: Run, second: Run) -> Iterator[str]:
    """What the headers of two runs say that differs: code, versions, suite, systems, weights, towns."""
    for name in sorted(
        (set(first.header) | set(second.header)) - {"cells", "columns", "identity", "command", "started"}
    ):
        yield from _differences(name, first.header.get(name), second.header.get(name))


def _differences(name: str, a: Any, b: Any) -> Iterator[str]:
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        for key in sorted(set(a) | set(b)):
            yield from _differences(f"{name}.{key}", a.get(key), b.get(key))
    elif a != b:
        yield f"{name}: {_short(a)} → {_short(b)}"


def _short(value: Any) -> str:
    text = "nothing" if value is None else str(value)
    return text if len(text) <= 60 else text[:57] + "..."
