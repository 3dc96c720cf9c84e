"""Pieces of work and what becomes of them: what a pool is given and what it gives back."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

Status = Literal["ok", "failed", "timeout", "crashed"]


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """One call in a worker process: `function(argument)`.

    Args:
        function: a function of a module (not a lambda), so that another process can import it.
        argument: what it is called with; it and the result are pickled on their way.
        timeout_s: seconds after which the worker is ended; the time to start a worker does not count.
        label: what the caller knows the task by; it stays in this process.
    """

    function: Callable[[Any], Any]
    argument: Any
    timeout_s: float = float("inf")
    label: Any = None


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a task ended.

    Attributes:
        task: the task.
        status: ok; failed: it raised; timeout; crashed: its process ended, by itself, by a signal, or for memory.
        value: what the function returned.
        reason: why it did not end well, one line.
        error: the `SSADError` that it raised, if it was one.
        seconds: wall time in the worker.
    """

    task: Task
    status: Status
    value: Any = None
    reason: str = ""
    error: Exception | None = None
    seconds: float = 0.0


class Backend(Protocol):
    """Where tasks run: processes of this machine, a cluster, or this very process. A context manager's `close`."""

    @property
    def capacity(self) -> int:
        """How many tasks it wants at hand at a time."""

    @property
    def busy(self) -> int:
        """How many it has now."""

    def submit(self, task: Task) -> None:
        """Take a task; only while `busy` is below `capacity`."""

    def wait(self, seconds: float) -> Sequence[Outcome]:
        """What has ended, after so many seconds at the latest.

        Raises:
            SSADError: No worker can start.
        """

    def close(self) -> None:
        """End all that runs."""
