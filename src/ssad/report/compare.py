"""Comparison of runs: differences cell by cell, with intervals and a test, and changes between their headers."""

from __future__ import annotations

import math
import os
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any
from urllib.parse import quote

from ssad.core import safeio
from ssad.core.errors import ConfigError
from ssad.metrics import (
    METRICS,
    CaseValue,
    EpisodeOutcome,
    Estimate,
    paired_difference,
    replicate_difference,
    sign_flip_test,
)
from ssad.metrics.intervals import MIN_ROUTES
from ssad.report.load import Run, load_run, read_as_kind
from ssad.report.pages import render
from ssad.report.tables import METHODS, Table, TableCell, TableRow, write_tables

REPORT = "report.html"
MAX_REPLAYS = 200  # replays that a page offers
SHOWN = ("CR", "OR", "DR", "RC", "DS")
EVERYTHING = "all"
_SUBJECTS = ("system", "detector")


@dataclass(frozen=True)
class ComparedRun:
    """One of the compared runs.

    Attributes:
        label: Label in tables.
        run: The run.
    """

    label: str
    run: Run

    @cached_property
    def lines(self) -> Mapping[tuple[str, str], Mapping[str, Any]]:
        """(subject, cell without its subject) -> its line; the subject is the system or detector under test."""
        lines_by_cell = {}
        for line in self.run.lines:
            subject = next((str(line[name]) for name in _SUBJECTS if line.get(name)), "")
            name = self.run.names.get(line["key"], line["key"])
            lines_by_cell[subject, name.removeprefix(f"{subject}/")] = line
        return lines_by_cell

    @property
    def subjects(self) -> list[str]:
        """Systems or detectors, in the order of the suite."""
        return list(dict.fromkeys(subject for subject, _ in self.lines))


@dataclass(frozen=True)
class Comparison:
    """A run beside the first one.

    Attributes:
        first: The reference run.
        second: The run that is compared with it.
        table: Differences over all cells, or of each cell where the metrics are scores.
        groups: Differences in each group of scenarios; None where the metrics are scores.
        changes: Differences between the runs' headers, a line each.
        verdicts: Cells whose outcome changed, a line each.
        findings: Differences larger than chance, a sentence for each system or detector.
        equal: Cells whose metrics are equal to the last digit, of those that both runs measure.
        both: Number of cells that both have.
        only: Number of cells that only the first has, and that only the second has.
        unpaired: Systems or detectors that are compared with none, of the first and of the second run.
        replays: Pairs of replays of the cells whose outcome changed, where both runs have a page with them.
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
    unpaired: tuple[tuple[str, ...], tuple[str, ...]]
    replays: tuple[ReplayPair, ...]

    @property
    def remarks(self) -> list[str]:
        """What is in one of the runs alone, in sentences."""
        sentences = [
            f"Only {compared_run.label} has {', '.join(names)}: compared with nothing."
            for compared_run, names in zip((self.first, self.second), self.unpaired, strict=True)
            if names
        ]
        if all(self.unpaired):
            sentences.append(
                f"To compare two systems of different names: --pair {self.unpaired[0][0]}={self.unpaired[1][0]}."
            )
        sentences += [
            f"{count} cells of the compared systems are in {compared_run.label} alone."
            for compared_run, count in zip((self.first, self.second), self.only, strict=True)
            if count
        ]
        return sentences


@dataclass(frozen=True)
class ReplayPair:
    """Replays of one cell in two runs.

    Attributes:
        title: Name of the cell, and how its outcome changed.
        first: Folder of the first run, and key of the cell in it.
        second: The same of the second run.
    """

    title: str
    first: tuple[Path, str]
    second: tuple[Path, str]


def compare_runs(folders: Sequence[Path], pairs: Sequence[str] = ()) -> list[Comparison]:
    """Compare runs with the first of them, cell by cell.

    Cells belong together if they have the same name: the same scenario and repetition, the same shift and severity,
    and the same system or detector. If the runs test one system each, these are compared, whatever they are called.

    Args:
        folders: Run folders of one kind: two or more, or one whose systems are paired.
        pairs: Systems or detectors that are compared, as FIRST=SECOND; empty: those of the same name.

    Returns:
        A comparison for each folder but the first.

    Raises:
        ConfigError: Too few folders, runs of different kinds, runs that share no cell, or a pair that they lack.
        StoreError: A folder holds no run with results.
    """
    if len(folders) == 1 and pairs:
        run = load_run(folders[0])
        label = folders[0].resolve().name
        with read_as_kind(run):
            return [_compare(ComparedRun(label, run), ComparedRun(label, run), 1, pairs)]
    if len(folders) < 2:
        raise ConfigError(
            "compare needs two results folders, such as: ssad compare runs/a runs/b; "
            "or one and two of its systems, such as: ssad compare runs/a --pair mine=autopilot"
        )
    labels = _labels(folders)
    runs = [ComparedRun(label, load_run(folder)) for label, folder in zip(labels, folders, strict=True)]
    for compared_run in runs[1:]:
        if compared_run.run.kind != runs[0].run.kind:
            kinds = f"{runs[0].run.kind} and {compared_run.run.kind}"
            raise ConfigError(f"{compared_run.run.folder}: runs of different kinds cannot be compared ({kinds})")
    comparisons = []
    for number, compared_run in enumerate(runs[1:], 1):
        with read_as_kind(runs[0].run, compared_run.run):
            comparisons.append(_compare(runs[0], compared_run, number, pairs))
    return comparisons


def write_comparison(folders: Sequence[Path], out: Path, pairs: Sequence[str] = ()) -> tuple[Path, list[Comparison]]:
    """Compare runs and write OUT/compare.html and OUT/tables/difference*.csv|md|tex.

    Args:
        folders: As for `compare_runs`.
        out: Output folder.
        pairs: As for `compare_runs`.

    Returns:
        Path of the page, and the comparisons.

    Raises:
        ConfigError: As for `compare_runs`.
        StoreError: A folder holds no run with results, or the files cannot be written.
    """
    comparisons = compare_runs(folders, pairs)
    safeio.make_folder(out)
    tables = [table for comparison in comparisons for table in (comparison.table, comparison.groups) if table]
    with read_as_kind(*(comparison.second.run for comparison in comparisons)):
        write_tables(out, tables)
    path = out / "compare.html"
    replays = [
        {
            "title": replay_pair.title,
            "first": _replay_address(out, *replay_pair.first),
            "second": _replay_address(out, *replay_pair.second),
        }
        for comparison in comparisons
        for replay_pair in comparison.replays[:MAX_REPLAYS]
    ]
    with read_as_kind(comparisons[0].first.run):
        page = render("compare.html", comparisons[0].first.run, comparisons=comparisons, replays=replays)
    safeio.write_atomic(path, page)
    return path, comparisons


def _replay_address(out: Path, folder: Path, key: str) -> str:
    """Return the address of a replay on the page of a run, relative to the page of the comparison."""
    page = os.path.relpath(folder.resolve() / REPORT, out.resolve())
    return f"{quote(page)}?replay#cell-{quote(key)}"


def _labels(folders: Sequence[Path]) -> list[str]:
    """Return the shortest ends of the folders' paths that tell them apart."""
    parts = [folder.resolve().parts for folder in folders]
    for length in range(1, max(map(len, parts)) + 1):
        labels = ["/".join(path_parts[-length:]) for path_parts in parts]
        if len(set(labels)) == len(labels):
            return labels
    raise ConfigError("a run is compared with itself; give different folders")


def _compare(first: ComparedRun, second: ComparedRun, number: int, wanted_pairs: Sequence[str]) -> Comparison:
    pairs = _wanted_pairs(first, second, wanted_pairs) if wanted_pairs else _subject_pairs(first, second)
    rows: list[TableRow] = []
    verdicts: list[str] = []
    replays: list[ReplayPair] = []
    equal = shared_count = 0
    clock_metrics = {column["name"] for column in first.run.header.get("columns") or [] if column.get("clock")}
    unshared_counts = [0, 0]
    for first_subject, second_subject in pairs:
        first_lines = {name: line for (subject, name), line in first.lines.items() if subject == first_subject}
        second_lines = {name: line for (subject, name), line in second.lines.items() if subject == second_subject}
        shared_names = [name for name in first_lines if name in second_lines]
        shared_count += len(shared_names)
        unshared_counts = [
            unshared_counts[0] + len(first_lines) - len(shared_names),
            unshared_counts[1] + len(second_lines) - len(shared_names),
        ]
        equal += sum(
            _equal(_metrics(first_lines[name]), _metrics(second_lines[name]), clock_metrics) for name in shared_names
        )
        title = first_subject if first_subject == second_subject else f"{first_subject} → {second_subject}"
        for name in shared_names:
            first_line, second_line = first_lines[name], second_lines[name]
            if verdict_change := _verdict(first_line, second_line):
                verdicts.append(f"{title}/{name}: {verdict_change}")
                if _has_replay(first, first_line) and _has_replay(second, second_line):
                    first_place = (first.run.folder, str(first_line["key"]))
                    second_place = (second.run.folder, str(second_line["key"]))
                    replays.append(ReplayPair(verdicts[-1], first_place, second_place))
        if shared_names:
            rows += _rows(first.run, second.run, title, first_lines, second_lines)
    if not shared_count:
        raise ConfigError(f"{second.run.folder}: it shares no cell with {first.run.folder}; run the same suite twice")
    note = (
        "Difference: the second minus the first, over the cells that both have. p: how often chance alone "
        f"gives as large a difference (signs of the clusters' differences drawn anew). {METHODS}"
    )
    labels = (first.label, second.label) if first.label != second.label else ("first", "second")
    columns = (*labels, "difference", "p")
    name = "difference" if number == 1 else f"difference_{number}"
    overall_rows = [row for row in rows if row.head[1] == EVERYTHING]
    title, heads = f"{second.label} beside {first.label}", (*_heads(first.run), "Metric")
    if first.run is second.run:
        title = f"{first.label}: {', '.join(f'{name} beside {other}' for other, name in pairs)}"
    table = Table(name, title, heads, columns, tuple(overall_rows or rows), note)
    group_rows = tuple(row for row in rows if row.head[1] != EVERYTHING)
    groups = (
        Table(f"{name}_groups", "Each group of scenarios", heads, columns, group_rows, note) if overall_rows else None
    )
    unpaired_first, unpaired_second = (
        tuple(name for name in compared_run.subjects if name not in {pair[side] for pair in pairs})
        for side, compared_run in enumerate((first, second))
    )
    return Comparison(
        first,
        second,
        table,
        groups,
        changes=tuple(_changes(first.run, second.run)),
        verdicts=tuple(verdicts),
        findings=tuple(_findings(table)),
        equal=equal,
        both=shared_count,
        only=(unshared_counts[0], unshared_counts[1]),
        unpaired=(unpaired_first, unpaired_second) if first.run is not second.run else ((), ()),
        replays=tuple(replays),
    )


def _findings(table: Table) -> Iterator[str]:
    """Yield sentences about the differences that remain significant after Holm's correction at 5 %."""
    tested_rows = [row for row in table.rows if not math.isnan(row.cells[-1].mean)]
    tested_rows.sort(key=lambda row: row.cells[-1].mean)
    changes_by_subject: dict[str, list[str]] = {}
    for rank, row in enumerate(tested_rows):
        first_cell, second_cell, difference, p_value = row.cells
        is_open = difference.failed > 0 and difference.low <= 0.0 <= difference.high
        # Holm: the k-th smallest p-value is compared with 5 % over the number of tests that are left.
        if p_value.mean > 0.05 / (len(tested_rows) - rank):
            break
        if is_open:  # the cells that failed may have been the other way round
            continue
        quantity = " ".join(name for name in row.head[1:] if name != EVERYTHING)
        change_text = f"{difference.text} {difference.interval}".strip()
        changes_by_subject.setdefault(row.head[0], []).append(
            f"{quantity} {first_cell.text} → {second_cell.text} ({change_text})"
        )
    for subject, changes in changes_by_subject.items():
        remainder = f" and {len(changes) - 4} more" if len(changes) > 4 else ""
        yield f"{subject}: {', '.join(changes[:4])}{remainder}: larger than chance explains."
    if not tested_rows:
        yield "There is too little data to tell a difference from chance."
    elif not changes_by_subject:
        yield "No difference is larger than chance explains."


def _equal(first_line: Mapping[str, Any], second_line: Mapping[str, Any], ignored: Container[str]) -> bool:
    shared_fields = {
        name
        for name in first_line.keys() & second_line.keys()
        if name not in ignored
        if first_line[name] is not None and second_line[name] is not None
    }
    return bool(shared_fields) and all(first_line[name] == second_line[name] for name in shared_fields)


def _heads(run: Run) -> tuple[str, str]:
    names = [name.replace("_", " ").capitalize() for name in run.header.get("factors") or ["system", "group"]]
    return names[0], names[1] if len(names) > 1 else "Group"


def _subject_pairs(first: ComparedRun, second: ComparedRun) -> list[tuple[str, str]]:
    """Return the pairs of subjects of the first and the second run that are compared."""
    shared_subjects = [name for name in first.subjects if name in second.subjects]
    if shared_subjects:
        return [(name, name) for name in shared_subjects]
    if len(first.subjects) == len(second.subjects) == 1:
        return [(first.subjects[0], second.subjects[0])]
    raise ConfigError(
        f"{second.run.folder}: none of its systems or detectors is in {first.run.folder}, and there are several; "
        "compare runs of one each"
    )


def _wanted_pairs(first: ComparedRun, second: ComparedRun, texts: Sequence[str]) -> list[tuple[str, str]]:
    """Return pairs of subjects from FIRST=SECOND; names may hold "=" themselves."""
    pairs = []
    for text in texts:
        parts = text.split("=")
        splits = [("=".join(parts[:count]), "=".join(parts[count:])) for count in range(1, len(parts))]
        known = [pair for pair in splits if pair[0] in first.subjects and pair[1] in second.subjects]
        if not known:
            raise ConfigError(
                f"--pair {text}: expected FIRST=SECOND with FIRST one of {', '.join(first.subjects)} "
                f"and SECOND one of {', '.join(second.subjects)}"
            )
        pairs.append(known[0])
    return pairs


def _has_replay(compared_run: ComparedRun, line: Mapping[str, Any]) -> bool:
    """Return whether the page of a run has a replay of a cell."""
    has_trace = bool((line.get("artefacts") or {}).get("trace"))
    return compared_run.run.kind == "driving" and has_trace and (compared_run.run.folder / REPORT).is_file()


def _rows(
    first: Run, second: Run, title: str, pairs: Mapping[str, Mapping[str, Any]], other: Mapping[str, Mapping[str, Any]]
) -> Iterator[TableRow]:
    """Yield the differences of one subject: of all shared cells if the metrics are means, then of each group."""
    if first.kind == "driving":
        groups = {EVERYTHING: list(pairs)} | {
            group: [name for name in pairs if pairs[name]["group"] == group]
            for group in dict.fromkeys(line["group"] for line in pairs.values())
        }
        for group, names in groups.items():
            first_group_lines, second_group_lines = (
                {cell_name: lines[cell_name] for cell_name in names if cell_name in lines} for lines in (pairs, other)
            )
            if set(first_group_lines) & set(second_group_lines):
                for symbol in SHOWN:
                    yield _driving_row(title, group, symbol, first_group_lines, second_group_lines)
        return
    same_seed = first.suite.get("seed") == second.suite.get("seed")
    for name in pairs:
        if name in other:
            for metric in _common_metrics(first, pairs[name], other[name]):
                yield _score_row(title, name, metric, pairs[name], other[name], paired=same_seed)


def _driving_row(
    title: str,
    group: str,
    symbol: str,
    first_lines: Mapping[str, Mapping[str, Any]],
    second_lines: Mapping[str, Mapping[str, Any]],
) -> TableRow:
    metric = METRICS[symbol]
    kind = "share" if metric.kind == "share" else "mean"
    values = [
        {name: _case(line, metric.field, kind) for name, line in lines.items()} for lines in (first_lines, second_lines)
    ]
    shared_names = set(first_lines) & set(second_lines)
    measured_names = [
        name
        for name in shared_names
        if not any(cases[name].failed or math.isnan(cases[name].value) for cases in values)
    ]
    difference = paired_difference(values[1], values[0], kind=kind, min_clusters=MIN_ROUTES)  # type: ignore[arg-type]
    p_value = TableCell(sign_flip_test(values[1], values[0]), digits=4, smallest=1e-4)
    means = [
        TableCell(
            math.fsum(cases[name].value for name in measured_names) / len(measured_names)
            if measured_names
            else math.nan
        )
        for cases in values
    ]
    return TableRow((title, group, symbol), (*means, TableCell.of(difference), p_value))


def _case(line: Mapping[str, Any], field: str, kind: str) -> CaseValue:
    """Return the value of a line in a metric; failed episodes have none, since a pair needs two that ran."""
    outcome = EpisodeOutcome.from_record(line)
    number = None if outcome.metrics is None else getattr(outcome.metrics, field)
    value = math.nan if number is None else float(number)
    if kind == "share" and not math.isnan(value):
        value = float(value > 0.0)
    return CaseValue(value, outcome.cluster, outcome.case, failed=outcome.metrics is None)


def _score_row(
    title: str, name: str, metric: str, first_lines: Mapping[str, Any], second_lines: Mapping[str, Any], *, paired: bool
) -> TableRow:
    """A score in each run; the interval of the difference where both resampled the same scenes in the same way."""
    first_score, second_score = float(first_lines["metrics"][metric]), float(second_lines["metrics"][metric])
    replicates = [(line.get("replicates") or {}).get(metric) or [] for line in (first_lines, second_lines)]
    scenes, other_scenes = (int(line.get("scenes") or line.get("drives") or 0) for line in (first_lines, second_lines))
    difference = Estimate(second_score - first_score, math.nan, math.nan, int(first_lines.get("n", 1)), clusters=scenes)
    p_value = math.nan
    if (
        paired
        and scenes == other_scenes
        and first_lines.get("n") == second_lines.get("n")
        and len(replicates[0]) == len(replicates[1])
    ):
        difference, p_value = _replicate_difference(
            second_score - first_score,
            [second_draw - first_draw for first_draw, second_draw in zip(*replicates, strict=True)],
            difference,
        )
    return TableRow(
        (title, name, metric),
        (
            TableCell(first_score),
            TableCell(second_score),
            TableCell.of(difference),
            TableCell(p_value, digits=4, smallest=1e-4),
        ),
    )


def _replicate_difference(value: float, replicates: Sequence[float], bare_estimate: Estimate) -> tuple[Estimate, float]:
    """Interval and p-value of a difference of scores in [0, 1]; its limits are those of (1 + difference) / 2."""
    difference = replicate_difference(value, replicates, n=bare_estimate.n, clusters=bare_estimate.clusters)
    finite = [replicate for replicate in replicates if not math.isnan(replicate)]
    if math.isnan(difference.low) or not finite:
        return bare_estimate, math.nan
    smaller_tail = min(sum(replicate <= 0.0 for replicate in finite), sum(replicate >= 0.0 for replicate in finite))
    # Two-sided; plus one, so that a finite number of draws never gives p = 0.
    return difference, min(2.0 * (smaller_tail + 1) / (len(finite) + 1), 1.0)


def _common_metrics(run: Run, first_lines: Mapping[str, Any], second_lines: Mapping[str, Any]) -> list[str]:
    """Return the metrics that both lines have a number for, in the order of the kind's columns."""
    first_metrics, second_metrics = _metrics(first_lines), _metrics(second_lines)
    columns = [str(column["name"]) for column in run.header.get("columns") or []] or list(first_metrics)
    return [
        name
        for name in columns
        if all(isinstance(values.get(name), int | float) for values in (first_metrics, second_metrics))
    ]


def _metrics(line: Mapping[str, Any]) -> Mapping[str, Any]:
    return line.get("metrics") or {} if line["status"] == "ok" else {}


def _verdict(first_line: Mapping[str, Any], second_line: Mapping[str, Any]) -> str:
    """Return how a cell's outcome changed: whether it ran, whether it collided; empty if it did not."""
    states = [_state(line) for line in (first_line, second_line)]
    return "" if states[0] == states[1] else f"{states[0]} before, {states[1]} now"


def _state(line: Mapping[str, Any]) -> str:
    if line["status"] != "ok":
        return str(line["status"])
    collided = _metrics(line).get("collision")
    return "ran" if collided is None else "collision" if collided else "no collision"


def _changes(first: Run, second: Run) -> Iterator[str]:
    """Yield the differences between the headers of two runs: code, versions, suite, systems, weights, towns."""
    unmentioned_keys = {"cells", "columns", "limits", "identity", "command", "started", "sealed"}
    for name in sorted((set(first.header) | set(second.header)) - unmentioned_keys):
        yield from _differences(name, first.header.get(name), second.header.get(name))


def _differences(name: str, first: Any, second: Any) -> Iterator[str]:
    if isinstance(first, Mapping) and isinstance(second, Mapping):
        for key in sorted(set(first) | set(second)):
            yield from _differences(f"{name}.{key}", first.get(key), second.get(key))
    elif first != second:
        yield f"{name}: {_short(first)} → {_short(second)}"


def _short(value: Any) -> str:
    value_text = "nothing" if value is None else str(value)
    return value_text if len(value_text) <= 60 else value_text[:57] + "..."
