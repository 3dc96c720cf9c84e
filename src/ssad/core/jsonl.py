"""JSON lines on disk: one record a line, with recovery from interrupted writes, and checks of their seals."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from ssad.core import safeio
from ssad.core.errors import FormatError, StoreError
from ssad.core.folders import path_inside
from ssad.core.seals import CHANGED, SEAL, seal_problem, unsealed

REMEDY = "restore the file from a copy, or run again into another folder"

Tail = Literal["", "open", "broken"]


@dataclass(frozen=True)
class JsonLines:
    """Content of a JSONL file.

    Attributes:
        path: The file.
        records: Complete records in order, with their seals.
        tail: What follows them: nothing, a part of a line without a line break ("open"), or a line that is no record
            ("broken").
    """

    path: Path
    records: tuple[dict[str, Any], ...] = ()
    tail: Tail = ""

    def error(self, line: int, problem: str, remedy: str = REMEDY) -> StoreError:
        """Return an error that names the file, a line (from 1), the problem and its remedy."""
        return StoreError(f"{self.path}:{line}: {problem}; {remedy}")


def scan_lines(path: str | Path) -> JsonLines:
    """Return the records of a JSONL file and what follows them; a missing file has none. Seals are not checked.

    Raises:
        StoreError: A line before the last is broken, or is no record with a key; a number is NaN or infinite; the
            file is a link that leads out of its folder.
    """
    lines = JsonLines(Path(path))
    if not path_inside(lines.path.parent, lines.path.name).exists():
        return lines
    *complete_lines, remainder = safeio.read_bytes(path, limit=1 << 34).split(b"\n")
    records: list[dict[str, Any]] = []
    for number, line in enumerate(complete_lines, 1):
        try:
            record = safeio.parse_json(line.decode(), f"{path}:{number}")
            if not isinstance(record, dict) or "key" not in record:
                raise FormatError(f"{path}:{number}: not a record")
        except (FormatError, UnicodeDecodeError):
            if constant := _constant(line):
                raise lines.error(number, f"{constant}, which is no number") from None
            if number == len(complete_lines):  # the last line may be torn even if it ends (blocks lost in a power cut)
                return JsonLines(lines.path, tuple(records), "broken")
            raise lines.error(number, "this line is broken", "mend or remove it, then run again") from None
        records.append(record)
    return JsonLines(lines.path, tuple(records), "open" if remainder else "")


def read_lines(path: str | Path) -> list[dict[str, Any]]:
    """Return the complete records of a JSONL file without their seals; a torn last line is skipped.

    Raises:
        StoreError: As for `scan_lines`; a key is there twice, or a seal is broken.
    """
    lines = scan_lines(path)
    check_lines(lines, sealed=any(SEAL in record for record in lines.records))
    return [unsealed(record) for record in lines.records]


def check_lines(
    lines: JsonLines,
    *,
    sealed: bool,
    value_problem: Callable[[Mapping[str, Any]], str] = lambda record: "",
    contradiction: Callable[[Mapping[str, Any]], str] = lambda record: "",
) -> None:
    """Check that no key is there twice and, of sealed lines, that all are in their place and unchanged.

    Args:
        lines: The lines.
        sealed: Whether every line must have a seal.
        value_problem: Function that returns the first impossible value of a record in words; empty: there is none.
        contradiction: Function that returns the first value of a changed record that another file contradicts.

    Raises:
        StoreError: A line fails a check.
    """
    first_lines: dict[Any, int] = {}
    for number, record in enumerate(lines.records, 1):
        key = record["key"]
        if not isinstance(key, str) or not key:
            raise lines.error(number, f"key is {shown(key)}, which is no key of a cell")
        if first_lines.setdefault(key, number) != number:
            raise lines.error(
                number, f"the cell {key} is there twice, first in line {first_lines[key]}", "remove this line"
            )
        problem = value_problem(record) or (seal_problem(record, number) if sealed else "")
        if problem == CHANGED and (detail := contradiction(record)):
            problem += f": {detail}"
        if problem:
            raise lines.error(number, problem)


def shown(value: Any) -> str:
    """Return a value as JSON, cut short."""
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 40 else text[:37] + "..."


def _constant(line: bytes) -> str:
    """Return the first NaN or infinity of a JSON text in words, such as "metrics.time is NaN"; empty without one."""
    try:
        return next(_constants(json.loads(line), ""), "")
    except (ValueError, RecursionError):
        return ""


def _constants(value: Any, location: str) -> Iterator[str]:
    if isinstance(value, float) and not math.isfinite(value):
        yield f"{location} is {json.dumps(value)}"
    elements = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for name, element in elements:
        yield from _constants(element, f"{location}.{name}".removeprefix("."))
