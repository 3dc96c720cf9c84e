"""Wording of messages: plurals, and lines that fit a terminal."""

from __future__ import annotations

import os
import textwrap
from typing import TextIO

COLUMNS = 80  # of a line of text where the width of the terminal is unknown


def plural(noun: str) -> str:
    """Return the plural of a noun: "system" -> "systems", "loss" -> "losses", "box" -> "boxes"."""
    return f"{noun}es" if noun.endswith(("s", "x")) else f"{noun}s"


def counted(count: float, noun: str) -> str:
    """Return a whole number with its noun: "1 cluster", "0 clusters", "1,200 clusters".

    Args:
        count: The number.
        noun: The noun in the singular.
    """
    return f"{count:,.0f} {noun if count == 1 else plural(noun)}"


def wrapped_line(line: str, columns: int = COLUMNS) -> str:
    """Return a line broken at spaces into lines of at most `columns`; what continues it is indented.

    Words are never broken, so that paths can be copied: a word longer than `columns` has a line of its own.
    """
    return textwrap.fill(line, columns, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False)


def terminal_columns(stream: TextIO) -> int | None:
    """Return the width of the terminal that a stream writes to; None: it is no terminal but a file or a pipe."""
    if not stream.isatty():
        return None
    try:
        return os.get_terminal_size(stream.fileno()).columns or COLUMNS
    except (OSError, ValueError):
        return COLUMNS
