"""Kind `tour`: a suite that runs other suites, one after the other, each in a folder of its own; a cell is a part.

All parts are planned before anything runs. Each part runs through the engine as if it ran alone, so that it resumes,
isolates failures and can be replayed and reported alone (`ssad report DIR/PART`). A part that cannot run at all fails
alone. The page of the tour leads to those of its parts.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from ssad.core import safeio
from ssad.core.errors import ConfigError, SSADError
from ssad.core.jsonl import read_lines
from ssad.core.schema import Schema
from ssad.engine.kind import Cell, CellError, Column, Job, Kind, Plan, Resources, SuiteBase
from ssad.experiments.suites import kind_of, load_suite
from ssad.experiments.tour import page
from ssad.report.load import Run
from ssad.report.tables import Table

TROUBLE = "trouble.txt"


class Part(Schema):
    """A suite of a tour.

    Attributes:
        name: of its folder.
        suite: name of the suite, or a YAML file.
        settings: `key=value`, as of `--set`.
        question: what it tests, in one sentence.
        limits: what it does not show.
    """

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")
    suite: str
    settings: list[str] = Field(default=[])
    question: str = ""
    limits: str = ""


class TourSuite(SuiteBase):
    """Suites that run one after the other.

    Attributes:
        parts: the suites.
        limits: what the whole does not show.
    """

    kind: Literal["tour"] = "tour"
    parts: list[Part] = Field(min_length=1)
    limits: list[str] = Field(default=[])


class Tour(Kind):
    """See the module."""

    name = "tour"
    suite = TourSuite
    columns = (
        Column("cells", "cells"),
        Column("seconds", "seconds of work", "s", "lower"),
    )
    factors = ("part",)

    def plan(self, suite: TourSuite, *, device: str = "cpu", check: bool = True) -> Plan:
        """Plans all parts."""
        names = [part.name for part in suite.parts]
        if len(set(names)) != len(names):
            raise ConfigError(f"suite {suite.name}: parts: a name appears twice")
        plans: dict[str, Plan] = {}
        cells = []
        for part in suite.parts:
            chosen = load_suite(part.suite, part.settings)
            kind = kind_of(chosen.kind)
            if isinstance(kind, Tour):
                raise ConfigError(f"suite {suite.name}: parts: {part.name} is a tour; name the suites that it runs")
            plans[part.name] = kind.plan(chosen, device=device, check=check)
            fields = {"part": part.name, "kind_of_part": kind.name, "suite_of_part": chosen.name}
            keys = [cell.key for cell in plans[part.name].cells]
            cells.append(self.make_cell(part.name, part.name, suite.seed, fields, {"part": part.name}, *keys))
        return Plan(self, suite, device, tuple(cells), {}, details=plans)

    def prepare(self, plan: Plan, folder: Path, resources: Resources, *, retry: Sequence[Cell] = ()) -> dict[str, Any]:
        """Runs what the parts lack; why a part could not run is left in its folder."""
        from ssad.engine.run import run  # the engine imports this table of kinds

        again = {cell.system for cell in retry}
        for name, part in plan.details.items():
            place = safeio.make_folder(folder / name)
            (place / TROUBLE).unlink(missing_ok=True)
            try:
                run(part, place, resources, retry=name in again)
                part.kind.finish(part, place)
            except SSADError as error:
                safeio.write_atomic(place / TROUBLE, str(error))
        return {}

    def result(self, cell: Cell, job: Job) -> dict[str, Any]:
        """Counts what the part has done."""
        return counted(job.folder, cell.system)

    def page(self, run: Run) -> tuple[str, Sequence[Table]]:
        """Page of a run and its tables."""
        return page.section(run)

    def summary(self, run: Run) -> Table:
        """Main table of a run."""
        return page.summary(run)


def counted(folder: Path, name: str) -> dict[str, Any]:
    """Cells of a part, and their seconds.

    Raises:
        CellError: The part could not run, or some of its cells failed.
    """
    trouble = folder / name / TROUBLE
    if trouble.is_file():
        raise CellError(safeio.read_text(trouble))
    lines = read_lines(folder / name / "results.jsonl")
    failed = [line for line in lines if line["status"] != "ok"]
    if failed or not lines:
        reason = failed[0]["reason"] if failed else "none ran"
        raise CellError(f"{len(failed)} of {len(lines)} cells failed: {reason}")
    seconds = sum(float(line.get("wall_s") or 0.0) for line in lines)
    metrics = {"cells": float(len(lines)), "seconds": round(seconds, 1)}
    return {"metrics": metrics, "artefacts": {"run": f"{name}/run.json"}}
