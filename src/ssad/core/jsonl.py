"""JSON lines on disk: one record a line, with recovery from interrupted writes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ssad.core import safeio
from ssad.core.errors import FormatError, StoreError


def read_lines(path: str | Path) -> list[dict[str, Any]]:
    """Return the complete records of a JSONL file; a torn last line is skipped, and a missing file has no records.

    Raises:
        StoreError: A line before the last is broken, or is no record with a key.
    """
    return scan_lines(path)[0]


def scan_lines(path: str | Path) -> tuple[list[dict[str, Any]], list[int]]:
    """Return the complete records as `read_lines` does, and the byte offset at which each record ends.

    Raises:
        StoreError: As for `read_lines`.
    """
    path = Path(path)
    records: list[dict[str, Any]] = []
    ends: list[int] = []
    if not path.exists():
        return records, ends
    # The part behind the last line break is empty or torn.
    complete_lines = safeio.read_bytes(path, limit=1 << 34).split(b"\n")[:-1]
    offset = 0
    for number, line in enumerate(complete_lines, 1):
        offset += len(line) + 1
        try:
            record = safeio.parse_json(line.decode(), f"{path}:{number}")
            if not isinstance(record, dict) or "key" not in record:
                raise FormatError(f"{path}:{number}: not a record")
        except (FormatError, UnicodeDecodeError):
            if number == len(complete_lines):  # the last line may be torn even if it ends (blocks lost in a power cut)
                break
            raise StoreError(f"{path}:{number}: this line is broken; mend or remove it, then run again") from None
        records.append(record)
        ends.append(offset)
    return records, ends
