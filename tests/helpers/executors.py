"""Executors that stand in for the world in tests of the runner: quick, and wicked on demand."""

from __future__ import annotations

import hashlib
import os
import signal
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

Cells = Sequence[Mapping[str, Any]]


def _result(cell: Mapping[str, Any], settings: Mapping[str, Any]) -> dict[str, Any]:
    """A result that depends on the cell alone; its trace file is written first, as the real executor does."""
    value = int(hashlib.sha256(f"{cell['key']}{cell['seed']}".encode()).hexdigest()[:8], 16) / 2**32
    artefact = f"traces/{cell['key']}.npz"
    if "folder" in settings:
        (Path(settings["folder"]) / artefact).write_text(repr(value))
    return {
        "key": cell["key"],
        "metrics": {"value": value},
        "n": 1,
        "end": "complete",
        "wall_s": time.perf_counter() % 1,
        "artefacts": {"trace": artefact},
    }


def good(cells: Cells, settings: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Prints noise, answers for every cell."""
    print("noise on standard output", flush=True)
    return [_result(cell, settings) for cell in cells]


def slow(cells: Cells, settings: Mapping[str, Any]) -> list[dict[str, Any]]:
    """10 ms a cell."""
    time.sleep(0.01 * len(cells))
    return good(cells, settings)


def wicked(cells: Cells, settings: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Does what the scenario's name says."""
    for cell in cells:
        deed = cell["scenario"]["name"].split("-")[0]
        if deed == "raise":
            raise ValueError("this one raises")
        if deed == "exit":
            sys.exit("this one leaves")
        if deed == "die":
            print("last words", file=sys.stderr, flush=True)
            os._exit(3)
        if deed == "segfault":
            os.kill(os.getpid(), signal.SIGSEGV)
        if deed == "hang":
            while True:
                time.sleep(1)
        if deed == "spin":
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
            while True:
                pass
        if deed == "liar":
            return [{"key": "another"}]
        if deed == "object":
            return [{"key": c["key"], "metrics": {"value": object()}} for c in cells]
        if deed == "nan":
            return [{"key": c["key"], "metrics": {"value": float("nan")}} for c in cells]
    return good(cells, settings)


def broken_start(cells: Cells, settings: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Never reached."""
    raise AssertionError


def run_in_child(folder: str, count: int, workers: int, chunk: int) -> None:
    """A whole run with `slow`, for tests that kill it."""
    from helpers.suites import fake_plan

    from ssad.bench.run import run

    run(
        fake_plan([f"s-{i}" for i in range(count)], chunk=chunk),
        folder,
        workers=workers,
        execute="helpers.executors:slow",
    )


if __name__ == "__main__":
    run_in_child(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]))
