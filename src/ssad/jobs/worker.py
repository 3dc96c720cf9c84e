"""The child process of the runner: reads chunks of cells from its standard input, answers on a pipe of its own.

Run as `python -m ssad.jobs.worker FD`. One JSON line in: {"cells": [...]}; one out: {"results": [...]} or
{"error": text}. The first line in is the set-up {"execute", "settings", "path"}; its answer is {"ready": true}.
What the executor prints goes to standard error, so it cannot disturb the answers.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import json
import os
import queue
import signal
import sys
import threading
from typing import Any

from ssad.core.errors import SSADError
from ssad.core.registry import describe


def _die_with_parent() -> None:
    """Ask the kernel to end this process when its parent is killed (Linux; elsewhere end of input does it)."""
    with contextlib.suppress(Exception):
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)


def _read(lines: queue.SimpleQueue[dict[str, Any]]) -> None:
    """Hand over the lines of standard input; end the process with the input, even in the middle of a chunk."""
    for line in sys.stdin.buffer:
        lines.put(json.loads(line))
    os._exit(0)


def main(descriptor: int) -> None:
    """Serve until the input ends."""
    _die_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the runner's to handle
    lines: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(lines,), daemon=True).start()
    with os.fdopen(descriptor, "wb", buffering=0) as answers:

        def answer(message: dict[str, Any]) -> None:
            data = memoryview(json.dumps(message, allow_nan=False).encode() + b"\n")
            while data:
                data = data[answers.write(data) or 0 :]

        setup = lines.get()
        sys.path[:] = list(dict.fromkeys([*setup["path"], *sys.path]))
        try:
            module_name, _, attribute = setup["execute"].partition(":")
            module = importlib.import_module(module_name)
            execute = getattr(module, attribute)
            if hasattr(module, "warm_up"):
                module.warm_up(setup["settings"])
        except Exception as error:
            answer({"fatal": str(error) if isinstance(error, SSADError) else describe(error)})
            return
        answer({"ready": True})
        while True:
            cells = lines.get()["cells"]
            try:
                message = {"results": execute(cells, setup["settings"])}
            except SSADError as error:
                message = {"error": str(error)}
            except (Exception, SystemExit) as error:
                message = {"error": describe(error)}
            try:
                answer(message)
            except (TypeError, ValueError) as error:
                answer({"error": f"the result is not plain data: {error}"})


if __name__ == "__main__":
    main(int(sys.argv[1]))
