"""Work shared out over processes of this machine."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent import futures
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import wait
from multiprocessing.sharedctypes import Synchronized
from types import TracebackType
from typing import Any, Self, TypeVar

from ssad.core.errors import StoreError

T = TypeVar("T")
R = TypeVar("R")


def spread(
    function: Callable[[T], R], tasks: Sequence[T], workers: int | None = None, *, gpus: Sequence[str] = ()
) -> Iterator[R]:
    """Results as they come, in any order; workers: how many processes (default: one a core), one: this one.

    gpus: the processes see one of these each, in turn (see `visible_gpus`). An error ends it, and what has not begun
    is not begun. StoreError: a process died.
    """
    with Crew(min(workers or os.cpu_count() or 1, len(tasks)), gpus=gpus) as crew:
        for task in tasks:
            crew.add(function, task)
        yield from crew.results()


class Crew:
    """Processes that work through a queue, to which more may be added while results are read; a context.

    workers: how many processes; one (or fewer): this one. gpus, errors: see `spread`.
    """

    def __init__(self, workers: int, *, gpus: Sequence[str] = ()) -> None:
        self._urgent: deque[tuple[Callable[[Any], Any], Any]] = deque()
        self._queue: deque[tuple[Callable[[Any], Any], Any]] = deque()
        self._running: set[Future[Any]] = set()
        self._pool: ProcessPoolExecutor | None = None
        self._count = workers
        if workers > 1:
            spawn = multiprocessing.get_context("spawn")
            threads = max((os.cpu_count() or 1) // workers, 1)
            start = (spawn.Value("i", 0), tuple(gpus), threads)
            self._pool = ProcessPoolExecutor(workers, mp_context=spawn, initializer=_begin, initargs=start)

    def add(self, function: Callable[[Any], Any], task: Any, *, first: bool = False) -> None:
        """One more piece of work; first: before all that has not begun and was not added so."""
        (self._urgent if first else self._queue).append((function, task))

    def results(self) -> Iterator[Any]:
        """What the functions return, until nothing is left to do."""
        while self._urgent or self._queue or self._running:
            if self._pool is None:
                function, task = self._next()
                yield function(task)
                continue
            try:
                while (self._urgent or self._queue) and len(self._running) < self._count:
                    function, task = self._next()
                    self._running.add(self._pool.submit(function, task))
                done, self._running = futures.wait(self._running, return_when=futures.FIRST_COMPLETED)
            except BrokenProcessPool:
                raise _died() from None
            yield from (future.result() for future in done if future.exception() is None)
            for error in filter(None, (future.exception() for future in done)):
                raise _died() if isinstance(error, BrokenProcessPool) else error

    def _next(self) -> tuple[Callable[[Any], Any], Any]:
        return (self._urgent or self._queue).popleft()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)


def _died() -> StoreError:
    return StoreError("a worker died (out of memory?); run the same command again to go on")


def _begin(turn: Synchronized[int], gpus: tuple[str, ...], threads: int) -> None:
    """Makes a worker ready. threads: of the linear algebra in each, which would otherwise take every core in each."""
    for library in ("OMP", "OPENBLAS", "MKL"):  # read when NumPy is imported, which has not happened yet
        os.environ.setdefault(f"{library}_NUM_THREADS", str(threads))
    if gpus:
        with turn.get_lock():
            number = turn.value
            turn.value = number + 1
        os.environ["CUDA_VISIBLE_DEVICES"] = gpus[number % len(gpus)]
    _end_with_parent()


def _end_with_parent() -> None:
    """Ends this worker when the process that started it is gone, even by kill -9."""
    parent = multiprocessing.parent_process()

    def watch() -> None:
        if parent is not None:
            wait([parent.sentinel])
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
