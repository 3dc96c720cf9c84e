"""Tables that a benchmark writes into a page of docs, between two markers."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Sequence
from pathlib import Path

DOCS = Path(__file__).resolve().parents[1] / "docs"


def insert(page: str, mark: str, lines: Sequence[str]) -> None:
    """Put lines in the place of what stands between `<!-- MARK: begin -->` and `<!-- MARK: end -->` of a page."""
    path, begin, end = DOCS / page, f"<!-- {mark}: begin -->", f"<!-- {mark}: end -->"
    before, _, rest = path.read_text().partition(begin)
    path.write_text("\n".join([before + begin, *lines, end + rest.partition(end)[2]]))


def store_commit(page: str) -> None:
    """State the commit of this version, and its date, in the second line of a page of stored results."""
    words = ["git", "-C", str(DOCS), "log", "-1", "--format=%h (%cs)", "--abbrev=7"]
    commit = subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip()
    path = DOCS / page
    path.write_text(re.sub(r"(?<=Stored result\.\*\* Commit: )[^.]+", commit, path.read_text(), count=1))
