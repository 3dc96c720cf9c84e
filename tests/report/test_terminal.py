"""Tables on a terminal: every name and number is complete, whatever the width."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from ssad.report.terminal import TerminalRow, TerminalTable

TITLE = "digital-quick with attacks pgd, mine:Lazy; radius 2; detectors yolov5n, yolov5s; seed 1; images 20 (slice 1/2)"
NOTE = "AP50: average precision at an overlap of 0.5.\nAvg. is the mean of all groups, each weighed the same as others."
COLUMNS = ("detector", "attack", "n", "collisions in a million episodes", "", "upper 95 % limit", "of these learned")
ROWS = (
    TerminalRow(("yolov5n-640", "pgd?steps=10", "20", "12345678", "[1111111, 22222222]", "33333333", "44444444")),
    TerminalRow(("", "universal", "20", "0.25", "[0.10, 0.90]", "0.95", "n/a"), ends_section=True),
    TerminalRow(("Avg.", "", "40", "0.50", "", "0.75", "n/a"), is_average=True),
)
TABLE = TerminalTable(TITLE, COLUMNS, ROWS, 2, NOTE)


def printed(width: int) -> list[str]:
    console = Console(file=io.StringIO(), width=width)
    console.print(TABLE)
    return console.file.getvalue().splitlines()  # type: ignore[attr-defined]


@pytest.mark.parametrize("width", [60, 80, 132, 300])
def test_no_word_or_number_is_lost_at_any_width(width: int) -> None:
    lines = printed(width)
    assert max(map(len, lines)) <= width
    words = " ".join(lines).split()
    texts = (TITLE, NOTE, *COLUMNS, *(text for row in ROWS for text in row.texts))
    assert {word for text in texts for word in text.split()} <= set(words)
    assert "…" not in " ".join(words)


def test_columns_that_do_not_fit_follow_beside_the_names_of_the_rows() -> None:
    assert TABLE.blocks(80) == [[0, 1, 2, 3, 4, 5], [0, 1, 6]]
    assert TABLE.blocks(50) == [[0, 1, 2], [0, 1, 3, 4], [0, 1, 5, 6]], "an interval stays beside its number"
    assert TABLE.blocks(300) == [[0, 1, 2, 3, 4, 5, 6]]
    assert sum(line.startswith(" yolov5n-640  pgd?steps=10") for line in printed(80)) == 2
