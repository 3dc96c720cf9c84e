"""Live progress with the time that is left; plain lines where there is no terminal."""

from __future__ import annotations

import time
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

EVERY_S = 10.0  # from one plain line to the next


class Live:
    """A context: a Rich bar on a terminal, else a line every ten seconds."""

    def __init__(self, title: str, total: int, done: int, *, console: Console, unit: str = "cells") -> None:
        self.total, self.done, self.failed, self.first = total, done, 0, done
        self.title, self.console, self.unit = title, console, unit
        self.began = self.said = time.monotonic()
        self.bar: Progress | None = None
        if console.is_terminal:
            columns = (TextColumn("[bold]{task.description}"), BarColumn(), MofNCompleteColumn())
            tail = (TextColumn("{task.fields[note]}"), TimeElapsedColumn())
            self.bar = Progress(*columns, *tail, console=console, transient=True)
            self.task = self.bar.add_task(title, total=total, completed=done, note="")

    def left(self) -> str:
        """Time left, from the cells done so far in this process."""
        count = self.done - self.first
        if not count or self.done >= self.total:
            return "eta --:--"
        seconds = round((time.monotonic() - self.began) / count * (self.total - self.done))
        return f"eta {seconds // 60:02d}:{seconds % 60:02d}"

    def note(self) -> str:
        """Failures so far and the time left."""
        failed = f"{self.failed} failed  " if self.failed else ""
        return failed + self.left()

    def advance(self, ok: bool) -> None:
        """One more cell is done."""
        self.done += 1
        self.failed += not ok

    def show(self, done: int, of: int) -> None:
        """So many are done, of so many."""
        self.done, self.total = done, of
        self.tick()

    def tick(self) -> None:
        """Show where things are."""
        if self.bar:
            self.bar.update(self.task, completed=self.done, total=self.total, note=self.note())
        elif time.monotonic() - self.said >= EVERY_S:
            self.said = time.monotonic()
            self.line()

    def line(self) -> None:
        """One plain line."""
        self.console.print(f"{self.title}: {self.done}/{self.total} {self.unit}  {self.note()}")

    def __enter__(self) -> Self:
        if self.bar:
            self.bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.bar:
            self.bar.stop()
        elif kind is None or self.done > self.first:  # an error before anything was done is alone
            self.line()
