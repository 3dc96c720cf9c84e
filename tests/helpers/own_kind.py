"""A kind of experiment in few lines: what a user of the engine writes. Its systems do what their names say."""

from __future__ import annotations

import hashlib
import os
import signal
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from ssad.bench.kind import Cell, Column, Job, Kind, Names, Plan, SuiteBase


class DiceSuite(SuiteBase):
    """Systems x numbers."""

    kind: Literal["helpers.own_kind:Dice"] = "helpers.own_kind:Dice"
    systems: Names
    numbers: Names
    repetitions: int = 1
    batch: int = 4


class Dice(Kind):
    """Throws a die for each number."""

    name, suite, factors = "dice", DiceSuite, ("system", "number")
    columns = (Column("value", "what the die shows", "", "higher"),)

    def plan(self, suite: DiceSuite, *, device: str = "cpu", check: bool = True) -> Plan:
        cells = [
            self.make_cell(f"{s}/{n}#{r}", s, suite.seed + r, {"system": s, "number": n}, {"repetition": r})
            for s in suite.systems for n in suite.numbers for r in range(suite.repetitions)
        ]  # fmt: skip
        return Plan(self, suite, device, tuple(cells), {"systems": list(suite.systems)})

    def batches(self, plan: Plan, cells: Sequence[Cell], workers: int) -> list[list[Cell]]:
        return [list(cells[k : k + plan.suite.batch]) for k in range(0, len(cells), plan.suite.batch)]

    def execute(self, cells: Sequence[Cell], job: Job) -> Mapping[str, Mapping[str, Any]]:
        print("noise on standard output", flush=True)
        results: dict[str, Any] = {}
        for cell in cells:
            value: Any = int(hashlib.sha256(f"{cell.fields}{cell.seed}".encode()).hexdigest()[:8], 16) / 2**32
            deed = cell.fields["number"].split("-")[0]
            value = DEEDS[deed]() if deed in DEEDS else value
            path = job.folder / "dice" / f"{cell.key}.txt"
            path.parent.mkdir(exist_ok=True)
            path.write_text(repr(value))
            results["another" if deed == "liar" else cell.key] = {
                "metrics": {"value": value}, "artefacts": {"die": f"dice/{cell.key}.txt"},
                "episode": {"raw": repr(value)}, "case": repr(value), "cluster": cell.fields["number"],
            }  # fmt: skip
        return results


class SharedDice(Dice):
    """The same with work that systems share: a file a number and system; a system does what its name says."""

    patience = 2

    def pieces(self, cell: Cell, job: Job) -> Mapping[str, Any]:
        return {} if self._path(cell.system, cell.fields["number"], job).exists() else {cell.fields["number"]: None}

    def make(self, name: str, data: Any, systems: Sequence[str], job: Job) -> None:
        for system in systems:
            if system in DEEDS:
                DEEDS[system]()
            path = self._path(system, name, job)
            path.parent.mkdir(exist_ok=True)
            with path.open("a") as file:
                file.write("made\n")

    def execute(self, cells: Sequence[Cell], job: Job) -> Mapping[str, Mapping[str, Any]]:
        for cell in cells:
            if not self._path(cell.system, cell.fields["number"], job).exists():
                self.make(cell.fields["number"], None, [cell.system], job)
        return super().execute(cells, job)

    @staticmethod
    def _path(system: str, name: str, job: Job) -> Path:
        return job.folder / "pieces" / f"{system}-{name}"


def _hold_memory() -> None:
    held = []
    while True:
        held.append(bytearray(b"x" * (64 << 20)))


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
    "raise": _raise, "exit": lambda: sys.exit("this one leaves"), "die": _die, "spin": _spin, "memory": _hold_memory,
    "segfault": lambda: os.kill(os.getpid(), signal.SIGSEGV), "hang": lambda: time.sleep(1e6),
    "object": object, "nan": lambda: float("nan"), "slow": lambda: time.sleep(0.03),
}  # fmt: skip
