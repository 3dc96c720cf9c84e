"""Child process that runs tasks: `python -m ssad.engine.worker IN OUT`, two file descriptors of pipes.

Input: (import path, whether a start follows) once, then (function, argument) pairs, the start first. Output: (kind,
value) pairs: "ready"; "value"; "error" with the exception of a user's mistake or a line of text; "fatal" if the start
fails. Tasks print to the standard error of the process, so that they cannot disturb the answers.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import queue
import signal
import sys
import threading
from multiprocessing.connection import Connection
from typing import Any

from ssad.core.errors import SSADError
from ssad.core.registry import describe


def _die_with_parent() -> None:
    """Ask the kernel to kill this process when its parent dies (Linux; elsewhere the end of the input does)."""
    with contextlib.suppress(Exception):
        # 1 is PR_SET_PDEATHSIG of <sys/prctl.h>.
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)


def _read(requests: Connection, messages: queue.SimpleQueue[Any]) -> None:
    """Hand over what comes in; end the process with the input, even in the middle of a task."""
    while True:
        try:
            messages.put(requests.recv())
        except (EOFError, OSError):
            os._exit(0)
        except Exception as error:  # the message cannot be unpickled here, such as for a missing module
            messages.put((_raise, describe(error)))


def _raise(message: str) -> None:
    raise ImportError(message)


def main(request_descriptor: int, answer_descriptor: int) -> None:
    """Serve until the input ends."""
    _die_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    reader, writer = Connection(request_descriptor), Connection(answer_descriptor)
    import_path, has_start = reader.recv()
    sys.path[:] = list(dict.fromkeys([*import_path, *sys.path]))
    messages: queue.SimpleQueue[Any] = queue.SimpleQueue()
    # A thread of its own notices the end of the input while a task runs.
    threading.Thread(target=_read, args=(reader, messages), daemon=True).start()
    if has_start:
        try:
            function, argument = messages.get()
            function(argument)
        except Exception as error:
            writer.send(("fatal", str(error) if isinstance(error, SSADError) else describe(error)))
            return
    writer.send(("ready", None))
    while True:
        function, argument = messages.get()
        try:
            message: tuple[str, Any] = ("value", function(argument))
        except SSADError as error:
            message = ("error", error)
        except (Exception, SystemExit) as error:
            message = ("error", describe(error))
        try:
            writer.send(message)
        except Exception as error:  # pickling can raise any exception
            writer.send(("error", f"the result cannot be handed over: {describe(error)}"))


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
