"""Published rates whose interval changed between two commits: the tables of docs/results/changed-intervals.md.

`python -m benchmarks.changed_rates COMMIT [--page]` compares the tables of docs/results at a commit with those of the
working tree, cell by cell: a cell is named by page, section, first columns of its row and head of its column.
`--page` writes the list.
"""

from __future__ import annotations

import argparse
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

from benchmarks.insert import insert

ROOT = Path(__file__).resolve().parents[1]
PAGES = Path("docs") / "results"
PAGE = "changed-intervals"
RATE = re.compile(r"[+-]?\d+(?:\.\d+)? (?:\[[^\]]*\d[^\]]*\]|\([^)]* over \d+ \w+\))")

Cell = tuple[str, str, str]
"""Section or title of the table, row and column."""


def rates(page: str) -> dict[Cell, str]:
    """Return the cells of a page that hold a rate with an interval or a range, by section, row and column."""
    found: dict[Cell, str] = {}
    for title, head, rows in _tables(page):
        for row in rows:
            name = _row_name(row)
            for column, text in zip(head, row, strict=False):
                if RATE.fullmatch(text):
                    found[title, name, column] = text
    return found


def _row_name(row: list[str]) -> str:
    """Return the columns before the first rate."""
    first = next((index for index, text in enumerate(row) if RATE.fullmatch(text)), len(row))
    return ", ".join(filter(None, row[:first]))


def _tables(page: str) -> Iterator[tuple[str, list[str], list[list[str]]]]:
    """Yield the title, the heads and the rows of each table; a title is the last heading or line that ends in a colon.

    What stands in brackets at the end of such a line is left out, as the number of routes was added to it.
    """
    title, head, rows = "", [], []
    for line in [*page.splitlines(), ""]:
        if line.startswith("|"):
            cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
            if not head:
                head = cells
            elif not all(re.fullmatch(r":?-+:?", cell) for cell in cells):
                rows.append(cells)
            continue
        if head:
            yield title, head, rows
            head, rows = [], []
        if line.startswith("#"):
            title = line.strip("# ")
        elif re.search(r":$", line):
            title = re.sub(r" \([^)]*\):$", "", line).rstrip(":")


def changes(commit: str) -> dict[str, list[tuple[Cell, str, str]]]:
    """Return the rates of each page that another interval stands beside than at a commit, with both."""
    changed: dict[str, list[tuple[Cell, str, str]]] = {}
    for path in sorted((ROOT / PAGES).glob("*.md")):
        old = subprocess.run(
            ["git", "show", f"{commit}:{PAGES.as_posix()}/{path.name}"],
            check=False,  # a page that the commit lacks has nothing to compare
            cwd=ROOT,
            capture_output=True,
            text=True,
        )
        if old.returncode or path.stem == PAGE:
            continue
        before, now = rates(old.stdout), rates(path.read_text(encoding="utf-8"))
        differing = [(cell, before[cell], now[cell]) for cell in now if before.get(cell, now[cell]) != now[cell]]
        if differing:
            changed[path.stem] = differing
    return changed


def lines(commit: str) -> list[str]:
    """Return the list as Markdown: a table for each page."""
    text: list[str] = []
    for page, differing in changes(commit).items():
        text += [f"## [{page}.md]({page}.md): {len(differing)} rates", ""]
        text += ["| table | row | rate | before | now |", "|---|---|---|---|---|"]
        text += [f"| {' | '.join(cell)} | {before} | {now} |" for cell, before, now in differing]
        text.append("")
    return text


def main() -> None:
    """Compare, print, and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("commit", help="commit of the pages before")
    parser.add_argument("--page", action="store_true", help=f"write docs/results/{PAGE}.md")
    given = parser.parse_args()
    text = lines(given.commit)
    print("\n".join(text))
    if given.page:
        insert(f"results/{PAGE}.md", "changed", text)


if __name__ == "__main__":
    main()
