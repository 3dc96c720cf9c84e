"""Front page of a tour: question, verdict, main table and page of each part."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ssad.core.errors import SSADError
from ssad.core.folders import path_inside
from ssad.experiments.runs import kind_of_run, write_report
from ssad.report.default import result_table
from ssad.report.load import Run, load_run
from ssad.report.pages import render
from ssad.report.tables import Table
from ssad.report.verdict import complete_verdict

TEMPLATE = Path(__file__).with_name("page.html")


def summary(run: Run) -> Table:
    """Return the table for the terminal."""
    return replace(result_table(run), note="")


def section(run: Run) -> tuple[str, Sequence[Table]]:
    """Return the page and its tables; write the pages of the parts beside it."""
    reasons = {line["part"]: line["reason"] for line in run.failures}
    parts, tables = [], []
    for part_settings in run.suite["parts"]:
        name = str(part_settings["name"])
        part: dict[str, Any] = {"name": name, "trouble": reasons.get(name, ""), **_describe_part(part_settings)}
        part_run, problem = _read_run(path_inside(run.folder, name))
        part["trouble"] = part["trouble"] or problem
        if part_run is not None:
            write_report(part_run.folder)
            kind = kind_of_run(part_run)
            table = replace(kind.summary(part_run), name=name)
            tables.append(table)
            part |= {
                "title": str(part_run.suite.get("title") or name),
                "table": table,
                "verdict": complete_verdict(part_run, kind.verdict(part_run)),
                "command": part_run.command,
            }
            part["cells"] = f"{len(part_run.lines)} of {part_run.planned} cells"
            part["seconds"] = sum(float(line.get("wall_s") or 0.0) for line in part_run.lines)
        parts.append(part)
    return render(TEMPLATE, run, parts=parts, limits=run.suite.get("limits", [])), tables


def _describe_part(part: Mapping[str, Any]) -> dict[str, Any]:
    return {"question": part.get("question", ""), "limits": part.get("limits", "")}


def _read_run(folder: Path) -> tuple[Run | None, str]:
    """Return the run of a part, or None and why it cannot be read."""
    try:
        return load_run(folder), ""
    except SSADError as error:
        return None, str(error)
