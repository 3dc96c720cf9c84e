"""Kind `tour`: a suite that runs other suites, one after the other, each in its own folder; a cell is a part.

All parts are planned before anything runs. Each part runs through the engine as if it ran alone, so that it resumes,
isolates failures and can be replayed and reported alone (`ssad report DIR/PART`). A part that cannot run at all fails
alone. The page of the tour links to those of its parts.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from ssad.core import safeio
from ssad.core.errors import ConfigError, SSADError
from ssad.core.jsonl import read_lines
from ssad.core.run_records import COUNT, NOT_NEGATIVE
from ssad.core.schema import Schema
from ssad.engine.kind import Cell, CellError, Column, Job, Kind, Plan, Resources, SuiteBase
from ssad.experiments.suites import kind_of, load_suite
from ssad.experiments.tour import page
from ssad.report.load import Run
from ssad.report.tables import Table

TROUBLE_FILE = "trouble.txt"


class Part(Schema):
    """A suite of a tour.

    Attributes:
        name: Name of its folder.
        suite: Name of the suite, or a YAML file.
        settings: `key=value`, as for `--set`.
        question: Question that it answers, in one sentence.
        limits: Limits of its conclusions.
    """

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")
    suite: str
    settings: list[str] = Field(default=[])
    question: str = ""
    limits: str = ""


class TourSuite(SuiteBase):
    """Suites that run one after the other.

    Attributes:
        parts: The suites.
        limits: Limits of the conclusions of the whole.
    """

    kind: Literal["tour"] = "tour"
    parts: list[Part] = Field(min_length=1)
    limits: list[str] = Field(default=[])


class Tour(Kind):
    """Kind `tour`: each cell is the run of another suite."""

    name = "tour"
    suite = TourSuite
    columns = (
        Column("cells", "cells", limits=COUNT),
        Column("seconds", "seconds of work", "s", "lower", limits=NOT_NEGATIVE, clock=True),
    )
    factors = ("part",)

    def plan(self, suite: TourSuite, *, device: str = "cpu", check: bool = True) -> Plan:
        """Plan all parts."""
        names = [part.name for part in suite.parts]
        if len(set(names)) != len(names):
            raise ConfigError(f"suite {suite.name}: parts: a name appears twice")
        plans: dict[str, Plan] = {}
        cells = []
        for part in suite.parts:
            part_suite = load_suite(part.suite, part.settings)
            kind = kind_of(part_suite.kind)
            if isinstance(kind, Tour):
                raise ConfigError(f"suite {suite.name}: parts: {part.name} is a tour; name the suites that it runs")
            plans[part.name] = kind.plan(part_suite, device=device, check=check)
            fields = {"part": part.name, "kind_of_part": kind.name, "suite_of_part": part_suite.name}
            keys = [cell.key for cell in plans[part.name].cells]
            cells.append(self.make_cell(part.name, part.name, suite.seed, fields, {"part": part.name}, *keys))
        return Plan(self, suite, device, tuple(cells), {}, details=plans)

    def prepare(self, plan: Plan, folder: Path, resources: Resources, *, retry: Sequence[Cell] = ()) -> dict[str, Any]:
        """Run the missing cells of the parts; the reason why a part could not run is left in its folder."""
        from ssad.engine.run import run  # the engine imports this table of kinds

        retried_parts = {cell.system for cell in retry}
        for name, part in plan.details.items():
            part_folder = safeio.make_folder(folder / name)
            (part_folder / TROUBLE_FILE).unlink(missing_ok=True)
            try:
                run(part, part_folder, resources, retry=name in retried_parts)
                part.kind.finish(part, part_folder)
            except SSADError as error:
                safeio.write_atomic(part_folder / TROUBLE_FILE, str(error))
        return {}

    def result(self, cell: Cell, job: Job) -> dict[str, Any]:
        """Count the cells of the part."""
        return count_cells(job.folder, cell.system)

    def page(self, run: Run) -> tuple[str, Sequence[Table]]:
        """Return the page of a run and its tables."""
        return page.section(run)

    def summary(self, run: Run) -> Table:
        """Return the main table of a run."""
        return page.summary(run)


def count_cells(folder: Path, name: str) -> dict[str, Any]:
    """Return the cells of a part, and their seconds.

    Raises:
        CellError: The part could not run, or some of its cells failed.
    """
    trouble_file = folder / name / TROUBLE_FILE
    if trouble_file.is_file():
        raise CellError(safeio.read_text(trouble_file))
    lines = read_lines(folder / name / "results.jsonl")
    failures = [line for line in lines if line["status"] != "ok"]
    if failures or not lines:
        reason = failures[0]["reason"] if failures else "none ran"
        raise CellError(f"{len(failures)} of {len(lines)} cells failed: {reason}")
    seconds = sum(float(line.get("wall_s") or 0.0) for line in lines)
    metrics = {"cells": float(len(lines)), "seconds": round(seconds, 1)}
    return {"metrics": metrics, "artefacts": {"run": f"{name}/run.json"}}
