"""Tasks on a Ray cluster: Ray schedules them, and a worker process runs each one as on a single machine.

A Ray worker keeps one child process (`ssad.engine.local`) and hands it one task after another. A task that raises,
hangs, dies or exhausts the memory is thereby distinct from a lost node: the former is an outcome, the latter is
repeated on another node. All nodes must see the same folders.
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
from ssad.engine.task import Task, TaskOutcome

LOST_NODES = 5  # repeats of a task whose node was lost
TASKS_PER_CPU = 2  # more than one, so that no CPU idles until the next task arrives

_BACKENDS: dict[str, LocalProcesses] = {}  # backends of this Ray worker, by the representation of their start


def _run_on_node(call: tuple[Any, Any, float], start: Start | None) -> Any:
    """Run a task of a Ray worker in its child process and return the fields of the outcome."""
    function, argument, timeout_s = call
    start_key = repr(start)
    # A child process is bound to its start, so another start needs another process.
    if start_key not in _BACKENDS:
        for other in _BACKENDS.values():
            other.close()
        _BACKENDS.clear()
        _BACKENDS[start_key] = LocalProcesses(1, start=start)
    node_backend = _BACKENDS[start_key]
    node_backend.submit(Task(function, argument, timeout_s))
    while True:
        for outcome in node_backend.wait(1.0):
            return outcome.status, outcome.value, outcome.reason, outcome.error, outcome.seconds


def _check_address(address: str) -> None:
    """Raise OSError unless a process listens at HOST:PORT; Ray itself would wait for minutes."""
    host, colon, port = address.rpartition("://")[2].rpartition(":")
    if colon and port.isdigit():
        socket.create_connection((host, int(port)), timeout=5.0).close()


class RayCluster:
    """Backend of a Ray cluster; see `ssad.engine.task.Backend`.

    Args:
        address: Address of a running cluster, "auto", or "local" to start one for the lifetime of this object.
        start: See `LocalProcesses`.
        gpu_share: Share of a GPU for each task; 0 requests none.

    Raises:
        ConfigError: Ray is not installed, or the cluster does not exist.
    """

    def __init__(self, address: str, *, start: Start | None = None, gpu_share: float = 0.0) -> None:
        try:
            import ray
        except ImportError:
            raise ConfigError(f"--ray needs the package ray; {install_extra('ray')}") from None
        self._ray = ray
        self._owns_ray = not ray.is_initialized()
        try:
            _check_address(address)
            if self._owns_ray:
                ray.init(address=address, log_to_driver=False, logging_level="ERROR")
        except Exception as error:
            reason = " ".join(str(error).split())
            raise ConfigError(f"no Ray cluster at '{address}': {reason}") from None
        import_path = [entry or os.getcwd() for entry in sys.path]
        environment = {name: os.environ[name] for name in os.environ if name.startswith("SSAD_")}
        environment["PYTHONPATH"] = os.pathsep.join(
            import_path
        )  # what is handed over is imported there before anything runs
        options: dict[str, Any] = {"num_cpus": 1, "max_retries": LOST_NODES, "runtime_env": {"env_vars": environment}}
        if gpu_share:
            options["num_gpus"] = gpu_share
        self._remote = ray.remote(**options)(_run_on_node)
        self._start = ray.put(start)
        self._tasks: dict[Any, Task] = {}

    @property
    def capacity(self) -> int:
        """Number of tasks that the backend accepts at a time; follows the size of the cluster."""
        return TASKS_PER_CPU * max(1, int(self._ray.cluster_resources().get("CPU", 1)))

    @property
    def busy(self) -> int:
        """Number of submitted tasks without an outcome."""
        return len(self._tasks)

    def submit(self, task: Task) -> None:
        """Submit a task; call only while `busy` is below `capacity`."""
        self._tasks[self._remote.remote((task.function, task.argument, task.timeout_s), self._start)] = task

    def wait(self, seconds: float) -> list[TaskOutcome]:
        """Return the outcomes of finished tasks, after at most `seconds`.

        Raises:
            SSADError: No worker can start.
        """
        if not self._tasks:
            time.sleep(seconds)
            return []
        ready, _ = self._ray.wait(list(self._tasks), timeout=seconds)
        outcomes = []
        for reference in ready:
            task = self._tasks.pop(reference)
            try:
                status, value, reason, error, elapsed_s = self._ray.get(reference)
            # A task's own errors are part of its outcome: an error here comes from the start of the worker.
            except self._ray.exceptions.RayTaskError as ray_error:
                cause = ray_error.cause
                raise (cause if isinstance(cause, SSADError) else StoreError(str(cause))) from None
            except self._ray.exceptions.RayError as ray_error:
                message = f"the cluster lost its node {LOST_NODES + 1} times: {' '.join(str(ray_error).split())[:200]}"
                status, value, reason, error, elapsed_s = "crashed", None, message, None, 0.0
            outcomes.append(TaskOutcome(task, status, value, reason, error, elapsed_s))
        return outcomes

    def close(self) -> None:
        """Cancel all running tasks, and shut the cluster down if this object started it."""
        for reference in self._tasks:
            with contextlib.suppress(self._ray.exceptions.RayError):
                self._ray.cancel(reference, force=True)
        self._tasks = {}
        if self._owns_ray:
            self._ray.shutdown()
