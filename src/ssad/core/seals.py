"""Seals of records: the number of a line in its file and a digest of its content, against accident and bad editing.

A seal is no signature: whoever wants to can make one. See docs/reference/formats.md.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

from ssad.core import safeio

SEAL = "seal"
DIGEST_BYTES = 8
CHANGED = "this line was changed after it was written"


def content_digest(record: Mapping[str, Any]) -> str:
    """Return 16 hex digits of BLAKE2b over the canonical JSON of a record without its seal.

    Args:
        record: A record as read from a file. One that holds tuples or keys that are no texts has another digest.
    """
    content = {name: value for name, value in record.items() if name != SEAL}
    return hashlib.blake2b(safeio.dump_json(content).encode(), digest_size=DIGEST_BYTES).hexdigest()


def sealed(record: Mapping[str, Any], line: int, *, episode: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return a record with its seal, as plain JSON data.

    Args:
        record: The record.
        line: Its number in the file, from 1.
        episode: The line of episodes.jsonl that belongs to it, which the seal names by its digest.
    """
    # Through JSON first: a reader must find the values that the digest covers, tuples being lists.
    content = unsealed(safeio.parse_json(safeio.dump_json(dict(record))))
    seal: dict[str, Any] = {"line": line, "digest": content_digest(content)}
    if episode is not None:
        seal["episode"] = content_digest(safeio.parse_json(safeio.dump_json(dict(episode))))
    return content | {SEAL: seal}


def unsealed(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return a record without its seal."""
    return {name: value for name, value in record.items() if name != SEAL}


def seal_problem(record: Mapping[str, Any], line: int) -> str:
    """Return the problem of the seal of a record that stands in a line of a file; empty if it is intact."""
    seal = record.get(SEAL)
    if not isinstance(seal, dict) or type(seal.get("line")) is not int:
        return "this line has no seal, so ssad did not write it as it is"
    if seal["line"] != line:
        return f"this line was written as line {seal['line']}, so lines were removed or moved"
    try:
        is_intact = seal.get("digest") == content_digest(record)
    except (ValueError, RecursionError):  # 1e999 is read as infinity, which JSON does not have
        is_intact = False
    return "" if is_intact else CHANGED
