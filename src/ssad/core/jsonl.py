"""JSON lines on disk: one record a line, and what a kill in the middle of a write leaves behind."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ssad.core import safeio
from ssad.core.errors import FormatError, StoreError


def read_lines(path: str | Path) -> list[dict[str, Any]]:
    """Whole records of a JSONL file; a torn last line is left out, a file that is not there has none.

    Raises:
        StoreError: a line that is not the last is broken, or is no record with a key.
    """
    return scan_lines(path)[0]


def scan_lines(path: str | Path) -> tuple[list[dict[str, Any]], list[int]]:
    """`read_lines`, and the offset in bytes at which each record ends."""
    path = Path(path)
    records: list[dict[str, Any]] = []
    ends: list[int] = []
    if not path.exists():
        return records, ends
    whole = safeio.read_bytes(path, limit=1 << 34).split(b"\n")[:-1]
    offset = 0
    for number, line in enumerate(whole, 1):
        offset += len(line) + 1
        try:
            record = safeio.parse_json(line.decode(), f"{path}:{number}")
            if not isinstance(record, dict) or "key" not in record:
                raise FormatError(f"{path}:{number}: not a record")
        except (FormatError, UnicodeDecodeError):
            if number == len(whole):  # the last line may be torn even if it ends (blocks lost in a power cut)
                break
            raise StoreError(f"{path}:{number}: this line is broken; mend or remove it, then run again") from None
        records.append(record)
        ends.append(offset)
    return records, ends
