"""Tasks and their outcomes: the input and output of a pool."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

Status = Literal["ok", "failed", "timeout", "crashed"]


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """One call in a worker process: `function(argument)`.

    Args:
        function: A function of a module (not a lambda), so that another process can import it.
        argument: Argument of the call; it and the result are pickled for the transfer.
        timeout_s: Time after which the worker is killed, s; the start of the worker does not count.
        label: Identifies the task for the caller; it stays in this process.
    """

    function: Callable[[Any], Any]
    argument: Any
    timeout_s: float = float("inf")
    label: Any = None


@dataclass(frozen=True, slots=True)
class TaskOutcome:
    """Outcome of a task.

    Attributes:
        task: The task.
        status: ok; failed: it raised; timeout; crashed: its process ended, by itself, by a signal, or for lack
            of memory.
        value: Return value of the function.
        reason: Cause of a failure, one line.
        error: The `SSADError` that the function raised, if any.
        seconds: Wall time in the worker.
    """

    task: Task
    status: Status
    value: Any = None
    reason: str = ""
    error: Exception | None = None
    seconds: float = 0.0


class Backend(Protocol):
    """Execution of tasks: processes of this machine, a cluster, or the calling process. `close` ends it."""

    @property
    def capacity(self) -> int:
        """Number of tasks that the backend accepts at a time."""

    @property
    def busy(self) -> int:
        """Number of submitted tasks without an outcome."""

    def submit(self, task: Task) -> None:
        """Submit a task; call only while `busy` is below `capacity`."""

    def wait(self, seconds: float) -> Sequence[TaskOutcome]:
        """Return the outcomes of finished tasks, after at most `seconds`.

        Raises:
            SSADError: No worker can start.
        """

    def close(self) -> None:
        """End all running tasks."""
