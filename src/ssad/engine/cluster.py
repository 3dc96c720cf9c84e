"""Tasks on a Ray cluster: Ray's scheduler places them, a worker process of ours does each, as on one machine.

A Ray worker keeps one child process (`ssad.engine.local`) and hands it one task after the other, so that a task which
raises, hangs, dies or eats the memory is told apart from a node that is lost: the former is an outcome, the latter is
done again elsewhere. The cluster must see the same folders.
"""

from __future__ import annotations

import contextlib
import os
import socket
import sys
import time
from typing import Any

from ssad.core.errors import ConfigError, SSADError, StoreError, install_extra
from ssad.engine.local import LocalProcesses, Start
from ssad.engine.task import Outcome, Task

LOST_NODES = 5  # times that a task is done again because its node was lost
AHEAD = 2  # tasks at hand for each place of the cluster, so that none waits for the next

_BACKENDS: dict[str, LocalProcesses] = {}  # of this Ray worker, by start


def _on_node(parts: tuple[Any, Any, float], start: Start | None) -> Any:
    """What a Ray worker does with a task: has its child process do it, and says how that ended."""
    function, argument, timeout_s = parts
    name = repr(start)
    if name not in _BACKENDS:
        for other in _BACKENDS.values():
            other.close()
        _BACKENDS.clear()
        _BACKENDS[name] = LocalProcesses(1, start=start)
    backend = _BACKENDS[name]
    backend.submit(Task(function, argument, timeout_s))
    while True:
        for found in backend.wait(1.0):
            return found.status, found.value, found.reason, found.error, found.seconds


def _check_address(address: str) -> None:
    """Whether somebody listens at HOST:PORT; Ray itself would wait for minutes. OSError."""
    host, colon, port = address.rpartition("://")[2].rpartition(":")
    if colon and port.isdigit():
        socket.create_connection((host, int(port)), timeout=5.0).close()


class RayCluster:
    """The backend of a Ray cluster; see `ssad.engine.task.Backend`.

    Args:
        address: of a running cluster, "auto", or "local" to start one for as long as this lives.
        start: see `LocalProcesses`.
        gpu_share: of a GPU for each task; 0: none is asked for.

    Raises:
        ConfigError: Ray is not installed, or there is no such cluster.
    """

    def __init__(self, address: str, *, start: Start | None = None, gpu_share: float = 0.0) -> None:
        try:
            import ray
        except ImportError:
            raise ConfigError(f"--ray needs the package ray; {install_extra('ray')}") from None
        self._ray = ray
        self._own = not ray.is_initialized()
        try:
            _check_address(address)
            if self._own:
                ray.init(address=address, log_to_driver=False, logging_level="ERROR")
        except Exception as error:
            text = " ".join(str(error).split())
            raise ConfigError(f"no Ray cluster at '{address}': {text}") from None
        path = [p or os.getcwd() for p in sys.path]
        environment = {name: os.environ[name] for name in os.environ if name.startswith("SSAD_")}
        environment["PYTHONPATH"] = os.pathsep.join(path)  # what is handed over is imported there before anything runs
        options: dict[str, Any] = {"num_cpus": 1, "max_retries": LOST_NODES, "runtime_env": {"env_vars": environment}}
        if gpu_share:
            options["num_gpus"] = gpu_share
        self._remote = ray.remote(**options)(_on_node)
        self._start = ray.put(start)
        self._tasks: dict[Any, Task] = {}

    @property
    def capacity(self) -> int:
        """How many tasks it wants at hand; follows the size of the cluster."""
        return AHEAD * max(1, int(self._ray.cluster_resources().get("CPU", 1)))

    @property
    def busy(self) -> int:
        """How many tasks it has now."""
        return len(self._tasks)

    def submit(self, task: Task) -> None:
        """Take a task; only while `busy` is below `capacity`."""
        self._tasks[self._remote.remote((task.function, task.argument, task.timeout_s), self._start)] = task

    def wait(self, seconds: float) -> list[Outcome]:
        """See `Backend`.

        Raises:
            SSADError: No worker can start.
        """
        if not self._tasks:
            time.sleep(seconds)
            return []
        ready, _ = self._ray.wait(list(self._tasks), timeout=seconds)
        found = []
        for reference in ready:
            task = self._tasks.pop(reference)
            try:
                status, value, reason, error, spent = self._ray.get(reference)
            except self._ray.exceptions.RayTaskError as problem:
                cause = problem.cause
                raise (cause if isinstance(cause, SSADError) else StoreError(str(cause))) from None
            except self._ray.exceptions.RayError as problem:
                why = f"the cluster lost its node {LOST_NODES + 1} times: {' '.join(str(problem).split())[:200]}"
                status, value, reason, error, spent = "crashed", None, why, None, 0.0
            found.append(Outcome(task, status, value, reason, error, spent))
        return found

    def close(self) -> None:
        """End all that runs, and the cluster if it was started here."""
        for reference in self._tasks:
            with contextlib.suppress(self._ray.exceptions.RayError):
                self._ray.cancel(reference, force=True)
        self._tasks = {}
        if self._own:
            self._ray.shutdown()
