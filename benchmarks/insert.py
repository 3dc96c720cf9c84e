"""Tables that a benchmark writes into a page of docs, between two markers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

DOCS = Path(__file__).resolve().parents[1] / "docs"


def insert(page: str, mark: str, lines: Sequence[str]) -> None:
    """Put lines in the place of what stands between `<!-- MARK: begin -->` and `<!-- MARK: end -->` of a page."""
    path, begin, end = DOCS / page, f"<!-- {mark}: begin -->", f"<!-- {mark}: end -->"
    before, _, rest = path.read_text().partition(begin)
    path.write_text("\n".join([before + begin, *lines, end + rest.partition(end)[2]]))
