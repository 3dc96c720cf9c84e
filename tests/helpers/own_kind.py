"""A kind of experiment in few lines: what a user of the engine writes. Its systems do what their names say."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from typing import Any, Literal

from helpers.deeds import DEEDS

from ssad.core.run_records import SHARE
from ssad.engine.kind import Cell, Column, Job, Kind, Names, SuiteBase


class DiceSuite(SuiteBase):
    """Systems x numbers."""

    kind: Literal["helpers.own_kind:Dice"] = "helpers.own_kind:Dice"
    systems: Names
    numbers: Names
    repetitions: int = 1
    chunk: int = 4


class Dice(Kind):
    """Throws a die for each number."""

    name, suite, factors = "dice", DiceSuite, ("system", "number")
    columns = (Column("value", "what the die shows", "", "higher", limits=SHARE),)

    def cells(self, suite: DiceSuite) -> Iterator[Cell]:
        for system in suite.systems:
            for number in suite.numbers:
                for repetition in range(suite.repetitions):
                    name, fields = f"{system}/{number}#{repetition}", {"system": system, "number": number}
                    yield self.make_cell(name, system, suite.seed + repetition, fields, {"repetition": repetition})

    def result(self, cell: Cell, job: Job) -> Mapping[str, Any]:
        print("noise on standard output", flush=True)
        deed = cell.fields["number"].split("-")[0]
        value: Any = int(hashlib.sha256(f"{cell.fields}{cell.seed}".encode()).hexdigest()[:8], 16) / 2**32
        value = DEEDS[deed]() if deed in DEEDS else value
        path = job.folder / "dice" / f"{cell.key}.txt"
        path.parent.mkdir(exist_ok=True)
        path.write_text(repr(value))
        return {
            "metrics": {"value": value},
            "artefacts": {"die": f"dice/{cell.key}.txt"},
            "episode": {"raw": repr(value)},
            "case": repr(value),
            "cluster": cell.fields["number"],
        }
