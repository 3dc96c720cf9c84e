"""Dice of other kinds: one with work that systems share, and one that answers for cells it was not asked about."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from helpers.deeds import DEEDS
from helpers.own_kind import Dice

from ssad.engine.kind import Cell, Job


class LyingDice(Dice):
    """Answers for another cell when the number is a liar."""

    def execute(self, cells: Sequence[Cell], job: Job) -> Mapping[str, Mapping[str, Any]]:
        found = super().execute(cells, job)
        return {"another" if cell.fields["number"] == "liar" else cell.key: found[cell.key] for cell in cells}


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

    def result(self, cell: Cell, job: Job) -> Mapping[str, Any]:
        if not self._path(cell.system, cell.fields["number"], job).exists():
            self.make(cell.fields["number"], None, [cell.system], job)
        return super().result(cell, job)

    @staticmethod
    def _path(system: str, name: str, job: Job) -> Path:
        return job.folder / "pieces" / f"{system}-{name}"
