"""Records of a results folder, checked: results.jsonl, episodes.jsonl, and seal.json, which counts their lines.

A line is written to episodes.jsonl, then one to results.jsonl, and then both are counted. So whenever a run is killed,
the files have at least the lines that are counted, and perhaps a torn one: fewer lines were removed by something else.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from ssad.core import safeio
from ssad.core.errors import StoreError
from ssad.core.folders import path_inside
from ssad.core.jsonl import REMEDY, JsonLines, check_lines, scan_lines, shown
from ssad.core.seals import SEAL, content_digest, unsealed

RESULTS, EPISODES, COUNTS = "results.jsonl", "episodes.jsonl", "seal.json"

MAX_NUMBER = 1e15
FIELD_LIMITS = {"n": (0.0, 1e12), "wall_s": (0.0, 1e9)}  # wall_s: 30 years
TEXTS = ("suite", "status", "reason")
MAPPINGS = ("metrics", "spec", "versions", "artefacts", "hashes")
TOLERANCE = 1e-6  # by which a rounded value may lie beyond a limit

ValueLimits = tuple[float | None, float | None]
"""Least and greatest possible value; None: no limit."""
SHARE: ValueLimits = (0.0, 1.0)
COUNT: ValueLimits = (0.0, 1e12)
NOT_NEGATIVE: ValueLimits = (0.0, None)
UNIT_LIMITS: Mapping[str, float] = {
    "m": 1e7,
    "km": 1e12,
    "s": 1e9,
    "h": 1e12,
    "m/s": 1e3,
    "m/s^2": 1e5,
    "m/s^3": 1e7,
    "rad/s": 1e3,
}
"""Greatest size of a metric by its unit, far beyond any drive: against slips, not a judgement."""


@dataclass(frozen=True)
class RunRecords:
    """Records of a results folder, without their seals.

    Attributes:
        results: Lines of results.jsonl in order; each of a finished cell.
        episodes: Lines of episodes.jsonl by key, of finished cells alone.
        sealed: Whether lines have seals; folders from before there were seals have none.
        whole: Whether the files have these lines and nothing else, such as the torn line of a run that was killed.
    """

    results: tuple[dict[str, Any], ...]
    episodes: Mapping[str, dict[str, Any]]
    sealed: bool
    whole: bool


def read_records(folder: Path, header: Mapping[str, Any]) -> RunRecords:
    """Read the records of a results folder and check them, line by line and against each other.

    Args:
        folder: The folder.
        header: Content of its run.json; `sealed` and `limits` matter.

    Raises:
        StoreError: A line is broken, doubled, changed, missing or out of place, or has an impossible value; or the two
            files contradict each other. The message names file, line, problem and remedy.
    """
    counts = _read_counts(folder)  # first: a run that goes on meanwhile only adds lines
    results, episodes = scan_lines(folder / RESULTS), scan_lines(folder / EPISODES)
    is_sealed = bool(header.get("sealed")) or any(SEAL in record for record in (*results.records, *episodes.records))
    limits = _read_limits(folder, header)
    positions = {
        lines.path.name: {str(record["key"]): number for number, record in enumerate(lines.records, 1)}
        for lines in (results, episodes)
    }
    for lines, other_lines in ((results, episodes), (episodes, results)):
        check_lines(
            lines,
            sealed=is_sealed,
            value_problem=partial(value_problem, limits=limits, is_result=lines is results),
            contradiction=partial(_contradiction, other_lines=other_lines, positions=positions[other_lines.path.name]),
        )
        if is_sealed:
            _check_count(lines, counts)
    unfinished_key = _check_pairs(results, episodes, positions, is_sealed=is_sealed)
    finished = tuple(unsealed(record) for record in results.records if record["key"] != unfinished_key)
    keys = {record["key"] for record in finished}
    finished_episodes = {record["key"]: unsealed(record) for record in episodes.records if record["key"] in keys}
    is_complete = len(finished) == len(results.records) and len(finished_episodes) == len(episodes.records)
    is_whole = is_complete and not (results.tail or episodes.tail)
    return RunRecords(finished, finished_episodes, is_sealed, is_whole)


def value_problem(record: Mapping[str, Any], limits: Mapping[str, ValueLimits], *, is_result: bool = True) -> str:
    """Return the first impossible value of a record in words; empty if there is none.

    Args:
        record: A line of results.jsonl or of episodes.jsonl.
        limits: Those of its metrics, by name.
        is_result: Whether it is a result, which has a status.
    """
    if is_result and "status" not in record:
        return "this line has no status, so it is no result of a cell"
    for name in TEXTS:
        if not isinstance(record.get(name), str | None):
            return f"{name} is {shown(record[name])}, which is no text"
    for name in MAPPINGS:
        if not isinstance(record.get(name), dict | None):
            return f"{name} is {shown(record[name])}, which is no object"
    for name, field_limits in FIELD_LIMITS.items():
        value = record.get(name)
        if value is not None and (problem := _number_problem(name, value, *field_limits)):
            return problem
    for name, value in (record.get("metrics") or {}).items():
        if value is not None and (
            problem := _number_problem(f"metrics.{name}", value, *limits.get(name, (None, None)))
        ):
            return problem
    return ""


def counts_text(counts: Mapping[str, int]) -> str:
    """Return the content of seal.json, of equal length for all counts, so that it can be written in place."""
    return "{" + ", ".join(f'"{name}": {counts[name]:12d}' for name in (EPISODES, RESULTS)) + "}\n"


def _number_problem(name: str, value: Any, low: float | None, high: float | None) -> str:
    if not isinstance(value, int | float):
        return f"{name} is {shown(value)}, which is no number"
    if not abs(value) <= MAX_NUMBER:  # true of NaN too
        return f"{name} is {shown(value)}, which is no plausible number"
    least, greatest = -math.inf if low is None else low, math.inf if high is None else high
    if least - TOLERANCE <= value <= greatest + TOLERANCE:
        return ""
    if low is not None and high is not None:
        return f"{name} is {shown(value)}, outside of [{low:g}, {high:g}]"
    return f"{name} is {shown(value)}, {'below' if value < least else 'above'} {least if value < least else greatest:g}"


def _contradiction(record: Mapping[str, Any], other_lines: JsonLines, positions: Mapping[str, int]) -> str:
    """Return the first value of a record that the line of its cell in the other file contradicts, in words."""
    line = positions.get(str(record["key"]))
    if line is None:
        return ""
    difference = _difference(record, other_lines.records[line - 1])
    return f"{difference} in {other_lines.path.name}:{line}" if difference else ""


def _difference(record: Mapping[str, Any], other_record: Mapping[str, Any]) -> str:
    """Return the first field or metric that two lines of a cell give different values, in words."""
    metrics, other_metrics = record.get("metrics"), other_record.get("metrics")
    groups = [(record, other_record, "")]
    if isinstance(metrics, dict) and isinstance(other_metrics, dict):
        groups.append((metrics, other_metrics, "metrics."))
    for values, other_values, prefix in groups:
        for name in values:
            if name in other_values and name not in (SEAL, "metrics") and values[name] != other_values[name]:
                return f"{prefix}{name} is {shown(values[name])} here and {shown(other_values[name])}"
    return ""


def _check_pairs(
    results: JsonLines, episodes: JsonLines, positions: Mapping[str, Mapping[str, int]], *, is_sealed: bool
) -> str:
    """Check that the lines of a cell in both files belong together.

    Returns:
        Key of the cell whose episode is the torn last line of its file, so that it has to run again; empty: none.

    Raises:
        StoreError: Two lines contradict each other, or a line has lost its counterpart.
    """
    unfinished_key = ""
    for number, record in enumerate(results.records, 1):
        key = record["key"]
        episode_line = positions[EPISODES].get(key)
        episode = None if episode_line is None else episodes.records[episode_line - 1]
        if not is_sealed:
            if episode is not None and (difference := _difference(record, episode)):
                raise results.error(number, f"{difference} in {EPISODES}:{episode_line}")
            continue
        digest = record[SEAL].get("episode")
        if digest == (None if episode is None else content_digest(episode)):
            continue
        if episode is not None:
            problem = f"the cell {key} was not written with its line {EPISODES}:{episode_line}"
            raise results.error(number, problem)
        if not episodes.tail or unfinished_key:
            raise results.error(number, f"the cell {key} has lost its line in {EPISODES}")
        unfinished_key = key
    return unfinished_key


def _check_count(lines: JsonLines, counts: Mapping[str, int] | None) -> None:
    """Raise StoreError if lines are missing at the end of a file, or its last line was broken after it was written."""
    line_count = len(lines.records)
    if counts is None:
        if line_count:
            raise StoreError(f"{lines.path.with_name(COUNTS)}: is missing, though the run has lines; {REMEDY}")
        return
    count = counts[lines.path.name]
    if lines.tail == "broken" and count > line_count:
        raise lines.error(line_count + 1, "this line was broken after it was written")
    if count > line_count + (lines.tail == "open"):
        raise lines.error(line_count + 1, f"this line is missing: the run wrote {count} lines")


def _read_counts(folder: Path) -> dict[str, int] | None:
    path = path_inside(folder, COUNTS)
    if not path.exists():
        return None
    counts = safeio.read_json(path)
    if not isinstance(counts, dict) or any(
        type(counts.get(name)) is not int or counts[name] < 0 for name in (RESULTS, EPISODES)
    ):
        raise StoreError(f"{path}: does not count the lines of {RESULTS} and {EPISODES}; {REMEDY}")
    return counts


def _read_limits(folder: Path, header: Mapping[str, Any]) -> Mapping[str, ValueLimits]:
    limits = header.get("limits") or {}
    if not isinstance(limits, dict) or not all(
        isinstance(pair, list)
        and len(pair) == 2
        and all(limit is None or isinstance(limit, int | float) for limit in pair)
        for pair in limits.values()
    ):
        raise StoreError(f"{folder / 'run.json'}: limits: not a pair of numbers for each metric; {REMEDY}")
    return {str(name): (low, high) for name, (low, high) in limits.items()}
