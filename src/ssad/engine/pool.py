"""One pool for suites, recordings and the toolbox, on processes of this machine or on a Ray cluster."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from types import TracebackType
from typing import Any, Self

from ssad.core.errors import StoreError
from ssad.core.machine import default_workers, gpu_workers, visible_gpus
from ssad.engine.cluster import RayCluster
from ssad.engine.local import LocalProcesses, Start, ThisProcess
from ssad.engine.task import Backend, Task, TaskOutcome

TICK_S = 0.2


class Pool:
    """A queue of tasks before a backend; a context.

    Tasks may be added while outcomes are read. No task costs more than itself: see `TaskOutcome.status`.

    Args:
        backend: where the tasks run; see `open_pool`.
    """

    def __init__(self, backend: Backend) -> None:
        self.backend = backend
        self._urgent: deque[Task] = deque()
        self._queue: deque[Task] = deque()

    def add(self, task: Task, *, first: bool = False) -> None:
        """Add a task.

        Args:
            task: The task.
            first: Whether the task precedes all waiting tasks that were not added first themselves.
        """
        (self._urgent if first else self._queue).append(task)

    def drop(self, is_unwanted: Callable[[Task], bool]) -> list[Task]:
        """Remove the waiting tasks that `is_unwanted` selects, and return them."""
        dropped = [task for task in (*self._urgent, *self._queue) if is_unwanted(task)]
        self._urgent = deque(task for task in self._urgent if not is_unwanted(task))
        self._queue = deque(task for task in self._queue if not is_unwanted(task))
        return dropped

    def outcomes(self, tick: Callable[[], None] = lambda: None) -> Iterator[TaskOutcome]:
        """Yield the outcomes of all tasks as they end; `tick` is called several times a second.

        Raises:
            SSADError: no worker can start.
        """
        while self._urgent or self._queue or self.backend.busy:
            # Tasks stay in our queues as long as possible: only waiting tasks can be dropped or overtaken.
            while (self._urgent or self._queue) and self.backend.busy < self.backend.capacity:
                self.backend.submit((self._urgent or self._queue).popleft())
            yield from self.backend.wait(TICK_S)
            tick()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.backend.close()


def open_pool(
    tasks: int,
    *,
    workers: int | None = None,
    ray: str | None = None,
    device: str = "cpu",
    start: Start | None = None,
) -> Pool:
    """Open a pool for a number of tasks.

    Args:
        tasks: Largest number of simultaneous tasks; no more workers are started.
        workers: Processes of this machine (None: one per core, on GPUs as many as their memory allows); 0: the
            calling process, without isolation, for debugging.
        ray: Address of a Ray cluster to use instead; see `RayCluster`.
        device: cpu or cuda; on cuda each worker sees one of the visible GPUs.
        start: See `LocalProcesses`.

    Raises:
        ConfigError: The cluster does not exist.
    """
    gpus = visible_gpus() if device != "cpu" else []
    if ray is not None:
        gpu_share = 1.0 / max(1, gpu_workers(len(gpus)) // max(len(gpus), 1)) if device != "cpu" else 0.0
        return Pool(RayCluster(ray, start=start, gpu_share=gpu_share))
    if workers == 0:
        return Pool(ThisProcess(start))
    count = workers or min(gpu_workers(len(gpus)) or default_workers(), default_workers())
    count = max(1, min(count, tasks))
    return Pool(LocalProcesses(count, start=start, gpus=gpus, threads=max(1, default_workers() // count)))


def run_all(
    pool: Pool,
    function: Callable[[Any], Any],
    arguments: Sequence[Any],
    *,
    timeout_s: float = float("inf"),
    progress: Callable[[int, int], None] = lambda completed, total: None,
) -> list[Any]:
    """Call a function on each argument, for work whose parts are useful only together.

    Args:
        pool: Runs the calls; the pool is used up.
        function: See `Task`.
        arguments: Arguments of the calls, one task each; see `Task`.
        timeout_s: Time limit of a task, s; see `Task`.
        progress: Called with the number of finished tasks and the number of all tasks.

    Returns:
        The results, in the order of the arguments.

    Raises:
        SSADError: The first error that the function raised; no further task is started then.
        StoreError: Some tasks crashed or timed out; raised once all others have ended.
    """
    results: list[Any] = [None] * len(arguments)
    failures: list[str] = []
    with pool:
        for index, argument in enumerate(arguments):
            pool.add(Task(function, argument, timeout_s, label=index))
        for finished_count, outcome in enumerate(pool.outcomes(), 1):
            progress(finished_count, len(arguments))
            results[outcome.task.label] = outcome.value
            if outcome.error is not None:
                raise outcome.error
            if outcome.status != "ok":
                failures.append(outcome.reason)
    if failures:
        remainder = f" (and {len(failures) - 1} more)" if len(failures) > 1 else ""
        raise StoreError(
            f"{len(failures)} of {len(arguments)} parts failed: {failures[0]}{remainder}; run the same command again"
        )
    return results
