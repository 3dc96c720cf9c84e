"""Plurals, and lines that fit a terminal without breaking words."""

from __future__ import annotations

import fcntl
import os
import struct
import termios
from pathlib import Path

import pytest

from ssad.core.wording import counted, plural, terminal_columns, wrapped_line

PATH = "/a/folder/with-hyphens/and/a/long/name/of/a/file/that/ends/beyond/the/line/of/a/terminal/scenarios.yaml"


@pytest.mark.parametrize(
    ("count", "noun", "text"),
    [(1, "cluster", "1 cluster"), (0, "actor", "0 actors"), (2, "box", "2 boxes"), (1200.0, "class", "1,200 classes")],
)
def test_a_number_has_the_form_of_its_noun(count: float, noun: str, text: str) -> None:
    assert counted(count, noun) == text
    assert plural(noun) in counted(2, noun)


def test_lines_break_at_spaces_alone() -> None:
    words = f"error: {PATH}: no such file or folder; choose another one, or make it with: ssad import map FILE.xodr"
    lines = wrapped_line(words, 40).splitlines()
    assert " ".join(line.strip() for line in lines) == words
    assert all(len(line) <= 40 for line in lines if PATH not in line)
    assert all(line.startswith("  ") for line in lines[1:])
    assert [line.strip() for line in lines[:2]] == ["error:", f"{PATH}:"]
    assert wrapped_line(words, 1000) == words


def test_only_a_terminal_has_a_width(tmp_path: Path) -> None:
    with open(tmp_path / "file", "w") as file:
        assert terminal_columns(file) is None
    master, slave = os.openpty()
    try:
        fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 57, 0, 0))
        with os.fdopen(slave, "w") as terminal:
            assert terminal_columns(terminal) == 57
    finally:
        os.close(master)
