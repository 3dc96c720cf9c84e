"""Runs that are killed with -9: one that stops itself in time, and the wait until all that it started is gone."""

from __future__ import annotations

import os
import subprocess
import time
from pathlib import Path

# For the beginning of a program: it stands still once `stop_at` cells are on record, so that it cannot end before it
# is killed, however late that comes.
STOPS = """
import os, signal
from ssad.engine.store import Store
_append = Store.append
def _append_and_stop(self, result, episode):
    _append(self, result, episode)
    if len(self.results) >= stop_at:
        os.kill(os.getpid(), signal.SIGSTOP)
Store.append = _append_and_stop
"""


def has_ended(process: int) -> bool:
    """Whether a process does nothing any more, though its parent may not have asked for its end."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0] in "ZX"
    except OSError:
        return True


def started_by(process: int) -> list[int]:
    """The children of a process that have not ended."""
    found = []
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, parent = status.read_text().rsplit(")", 1)[1].split()[:2]
        except OSError:
            continue
        if int(parent) == process and state not in "ZX":
            found.append(int(status.parent.name))
    return found


def wait_until_ended(processes: list[int], seconds: float = 120.0) -> None:
    """Wait for processes that are not children of this one; AssertionError if they outlive the time."""
    last = time.monotonic() + seconds
    while left := [process for process in processes if not has_ended(process)]:
        assert time.monotonic() < last, f"still there: {left}"
        time.sleep(0.005)


def wait_until_stopped(run: subprocess.Popen[bytes]) -> None:
    """Wait until a run stands still; AssertionError if it ends instead."""
    found = os.waitid(os.P_PID, run.pid, os.WSTOPPED | os.WEXITED | os.WNOWAIT)
    assert found is not None
    assert found.si_code == os.CLD_STOPPED, "it came to an end"


def kill_9(run: subprocess.Popen[bytes]) -> bool:
    """Kill a run, and wait until its workers are gone too: one in the middle of a system call ends a little later.

    Returns:
        Whether the run was still going.
    """
    workers = started_by(run.pid)
    going = run.poll() is None
    run.kill()
    run.wait()
    wait_until_ended(workers)
    return going
