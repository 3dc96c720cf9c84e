"""What a system under test can do wrong, by name."""

from __future__ import annotations

import os
import signal
import sys
import time
from typing import Any


def _hold_memory() -> None:
    held = []
    while True:  # not faster than a busy parent looks at it: the machine itself must not run out
        held.append(bytearray(b"x" * (64 << 20)))
        time.sleep(0.05)


def _raise() -> None:
    raise ValueError("this one raises")


def _spin() -> None:
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
    while True:
        pass


def _die() -> None:
    print("last words", file=sys.stderr, flush=True)
    os._exit(3)


DEEDS: dict[str, Any] = {
    "raise": _raise,
    "exit": lambda: sys.exit("this one leaves"),
    "die": _die,
    "spin": _spin,
    "memory": _hold_memory,
    "segfault": lambda: os.kill(os.getpid(), signal.SIGSEGV),
    "hang": lambda: time.sleep(1e6),
    "object": object,
    "nan": lambda: float("nan"),
    "absurd": lambda: 7.5,
    "text": lambda: "much",
    "slow": lambda: time.sleep(0.03),
}
