"""Live progress with the remaining time; plain lines where there is no terminal."""

from __future__ import annotations

import time
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

EVERY_S = 10.0  # between plain lines


class LiveProgress:
    """Context manager: a Rich progress bar on a terminal, else a line every ten seconds."""

    def __init__(self, title: str, total: int, completed: int, *, console: Console, unit: str = "cells") -> None:
        self.total, self.completed, self.failed, self.resumed_count = total, completed, 0, completed
        self.title, self.console, self.unit = title, console, unit
        self.start_time = self.last_line_time = time.monotonic()
        self.bar: Progress | None = None
        if console.is_terminal:
            columns = (TextColumn("[bold]{task.description}"), BarColumn(), MofNCompleteColumn())
            status_columns = (TextColumn("{task.fields[note]}"), TimeElapsedColumn())
            self.bar = Progress(*columns, *status_columns, console=console, transient=True)
            self.task = self.bar.add_task(title, total=total, completed=completed, note="")

    def remaining_time(self) -> str:
        """Return the remaining time, from the cells finished by this process."""
        # Cells of an earlier, resumed run took no time in this process.
        finished_count = self.completed - self.resumed_count
        if not finished_count or self.completed >= self.total:
            return "eta --:--"
        seconds = round((time.monotonic() - self.start_time) / finished_count * (self.total - self.completed))
        return f"eta {seconds // 60:02d}:{seconds % 60:02d}"

    def status(self) -> str:
        """Return the number of failures and the remaining time."""
        failed = f"{self.failed} failed  " if self.failed else ""
        return failed + self.remaining_time()

    def advance(self, succeeded: bool) -> None:
        """Count one more finished cell."""
        self.completed += 1
        self.failed += not succeeded

    def show(self, completed: int, total: int) -> None:
        """Show how many units are completed, of how many."""
        self.completed, self.total = completed, total
        self.tick()

    def tick(self) -> None:
        """Update the display."""
        if self.bar:
            self.bar.update(self.task, completed=self.completed, total=self.total, note=self.status())
        elif time.monotonic() - self.last_line_time >= EVERY_S:
            self.last_line_time = time.monotonic()
            self.line()

    def line(self) -> None:
        """Print one plain line."""
        self.console.print(f"{self.title}: {self.completed}/{self.total} {self.unit}  {self.status()}")

    def __enter__(self) -> Self:
        if self.bar:
            self.bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.bar:
            self.bar.stop()
        elif (
            kind is None or self.completed > self.resumed_count
        ):  # an error before the first finished cell stands alone
            self.line()
