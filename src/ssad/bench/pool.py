"""Work shared out over processes of this machine."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import wait
from multiprocessing.sharedctypes import Synchronized
from typing import TypeVar

from ssad.errors import StoreError

T = TypeVar("T")
R = TypeVar("R")


def spread(
    function: Callable[[T], R], tasks: Sequence[T], workers: int | None = None, *, gpus: Sequence[str] = ()
) -> Iterator[R]:
    """Results as they come, in any order; workers: how many processes (default: one a core), one: this one.

    gpus: the processes see one of these each, in turn (see `visible_gpus`). An error ends it, and what has not begun
    is not begun. StoreError: a process died.
    """
    count = min(workers or os.cpu_count() or 1, len(tasks))
    if count <= 1:
        yield from map(function, tasks)
        return
    spawn = multiprocessing.get_context("spawn")
    turn = spawn.Value("i", 0)
    threads = max((os.cpu_count() or 1) // count, 1)
    with ProcessPoolExecutor(
        count, mp_context=spawn, initializer=_begin, initargs=(turn, tuple(gpus), threads)
    ) as pool:
        futures = [pool.submit(function, task) for task in tasks]
        try:
            for future in as_completed(futures):
                yield future.result()
        except BrokenProcessPool:
            raise StoreError("a worker died (out of memory?); run the same command again to go on") from None
        except BaseException:
            for future in futures:
                future.cancel()
            raise


def visible_gpus() -> list[str]:
    """The CUDA devices that this process may use, as CUDA_VISIBLE_DEVICES names them."""
    given = os.environ.get("CUDA_VISIBLE_DEVICES")
    if given is not None:
        return [name.strip() for name in given.split(",") if name.strip()]
    import torch

    return [str(k) for k in range(torch.cuda.device_count())]


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
