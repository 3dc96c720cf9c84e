"""The child process that does the work: `python -m ssad.engine.worker IN OUT`, two file descriptors of pipes.

In come (import path, whether there is a start) once, then (function, argument) pairs, the start first. Out go (kind,
value) pairs: "ready"; "value"; "error", the exception of a user's mistake or a line of text; "fatal", it cannot start.
What the work prints goes to the process's own standard error, so it cannot disturb the answers.
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
    """Ask the kernel to end this process when its parent is killed (Linux; elsewhere end of input does it)."""
    with contextlib.suppress(Exception):
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)


def _read(orders: Connection, received: queue.SimpleQueue[Any]) -> None:
    """Hand over what comes in; end the process with the input, even in the middle of a task."""
    while True:
        try:
            received.put(orders.recv())
        except (EOFError, OSError):
            os._exit(0)
        except Exception as error:  # what came cannot be imported here
            received.put((_raise, describe(error)))


def _raise(text: str) -> None:
    raise ImportError(text)


def main(orders: int, answers: int) -> None:
    """Serve until the input ends."""
    _die_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    reader, out = Connection(orders), Connection(answers)
    path, starts = reader.recv()
    sys.path[:] = list(dict.fromkeys([*path, *sys.path]))
    received: queue.SimpleQueue[Any] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(reader, received), daemon=True).start()
    if starts:
        try:
            function, argument = received.get()
            function(argument)
        except Exception as error:
            out.send(("fatal", str(error) if isinstance(error, SSADError) else describe(error)))
            return
    out.send(("ready", None))
    while True:
        function, argument = received.get()
        try:
            message: tuple[str, Any] = ("value", function(argument))
        except SSADError as error:
            message = ("error", error)
        except (Exception, SystemExit) as error:
            message = ("error", describe(error))
        try:
            out.send(message)
        except Exception as error:  # whatever pickling raises
            out.send(("error", f"the result cannot be handed over: {describe(error)}"))


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
