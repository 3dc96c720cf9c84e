"""Live progress with the remaining time; plain lines where there is no terminal."""

from __future__ import annotations

import time
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

EVERY_S = 10.0  # between plain lines


class Live:
    """Context manager: a Rich progress bar on a terminal, else a line every ten seconds."""

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
        """Return the remaining time, from the cells finished by this process."""
        # Cells of an earlier, resumed run took no time in this process.
        finished = self.done - self.first
        if not finished or self.done >= self.total:
            return "eta --:--"
        seconds = round((time.monotonic() - self.began) / finished * (self.total - self.done))
        return f"eta {seconds // 60:02d}:{seconds % 60:02d}"

    def note(self) -> str:
        """Return the number of failures and the remaining time."""
        failed = f"{self.failed} failed  " if self.failed else ""
        return failed + self.left()

    def advance(self, ok: bool) -> None:
        """Count one more finished cell."""
        self.done += 1
        self.failed += not ok

    def show(self, done: int, of: int) -> None:
        """So many are done, of so many."""
        self.done, self.total = done, of
        self.tick()

    def tick(self) -> None:
        """Update the display."""
        if self.bar:
            self.bar.update(self.task, completed=self.done, total=self.total, note=self.note())
        elif time.monotonic() - self.said >= EVERY_S:
            self.said = time.monotonic()
            self.line()

    def line(self) -> None:
        """Print one plain line."""
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
        elif kind is None or self.done > self.first:  # an error before the first finished cell stands alone
            self.line()
