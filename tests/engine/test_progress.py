"""Progress: what a line says, and when."""

from __future__ import annotations

import io

import pytest
from helpers.clock import Clock, stopped
from rich.console import Console

from ssad.engine import progress
from ssad.engine.progress import LiveProgress


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    return stopped(monkeypatch, progress)


def plain() -> Console:
    return Console(file=io.StringIO(), width=100)


def text(console: Console) -> str:
    written = console.file.getvalue()  # type: ignore[attr-defined]
    assert isinstance(written, str)
    return written


def test_a_line_every_ten_seconds_and_one_at_the_end(clock: Clock) -> None:
    console = plain()
    with LiveProgress("suite", 20, 4, console=console) as live:
        live.tick()
        clock.now += 9.5
        live.tick()
        assert text(console) == "", "not yet"
        clock.now += 0.5
        live.advance(True)
        live.tick()
        assert text(console) == "suite: 5/20 cells  eta 02:30\n", "one cell took 10 s, 15 are left"
        live.tick()
        clock.now += 9.5
        live.tick()
        assert text(console).count("\n") == 1, "ten seconds from the last line, not from the beginning"
        live.advance(False)
        live.advance(False)
        clock.now += 0.5
        live.tick()
    first, second, last = text(console).splitlines()
    assert first != second
    assert second == last == "suite: 7/20 cells  2 failed  eta 01:27"


def test_time_left_is_told_once_something_was_done_and_until_all_is(clock: Clock) -> None:
    live = LiveProgress("recording", 3, 1, console=plain(), unit="scenes")
    clock.now += 61.0
    assert live.remaining_time() == "eta --:--", "what an earlier process did tells nothing"
    live.advance(True)
    assert live.remaining_time() == "eta 01:01"
    live.advance(True)
    assert live.remaining_time() == "eta --:--"
    live.line()
    assert text(live.console) == "recording: 3/3 scenes  eta --:--\n"


def test_counts_can_be_set(clock: Clock) -> None:
    console = plain()
    live = LiveProgress("toolbox", 2, 0, console=console)
    clock.now += 10.0
    live.show(4, 6)
    assert text(console) == "toolbox: 4/6 cells  eta 00:05\n"


def test_a_terminal_gets_a_bar_and_no_lines(clock: Clock) -> None:
    console = Console(file=io.StringIO(), force_terminal=True, width=100, _environ={})
    with LiveProgress("suite", 20, 4, console=console) as live:
        assert live.bar is not None
        (task,) = live.bar.tasks
        assert (task.description, task.completed, task.total) == ("suite", 4, 20)
        assert live.bar.live.is_started
        clock.now += 100.0
        live.advance(False)
        live.tick()
        assert (task.completed, task.fields["note"]) == (5, "1 failed  eta 25:00")
        live.bar.refresh()
        assert "5/20" in text(console)
        assert "1 failed" in text(console)
    assert not live.bar.live.is_started
    assert "cells" not in text(console)
