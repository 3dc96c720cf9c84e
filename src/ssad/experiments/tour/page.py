"""The front page of a tour: what was tested, the verdict in plain words, the main table and the page of each part."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ssad.core.errors import SSADError
from ssad.experiments.runs import kind_of_run, write_report
from ssad.report.default import result_table
from ssad.report.load import Run, load_run
from ssad.report.pages import render
from ssad.report.tables import Table
from ssad.report.verdict import complete_verdict

TEMPLATE = Path(__file__).with_name("page.html")


def summary(run: Run) -> Table:
    """The table that is shown on the terminal."""
    return replace(result_table(run), note="")


def section(run: Run) -> tuple[str, Sequence[Table]]:
    """The page and its tables; writes the pages of the parts beside it."""
    reasons = {line["part"]: line["reason"] for line in run.failures}
    parts, tables = [], []
    for one in run.suite["parts"]:
        name = str(one["name"])
        part: dict[str, Any] = {"name": name, "trouble": reasons.get(name, ""), **_about(one)}
        found = _read(run.folder / name)
        if found is not None:
            write_report(found.folder)
            kind = kind_of_run(found)
            table = replace(kind.summary(found), name=name)
            tables.append(table)
            part |= {
                "title": str(found.suite.get("title") or name),
                "table": table,
                "verdict": complete_verdict(found, kind.verdict(found)),
                "command": found.command,
            }
            part["cells"] = f"{len(found.lines)} of {found.planned} cells"
            part["seconds"] = sum(float(line.get("wall_s") or 0.0) for line in found.lines)
        parts.append(part)
    return render(TEMPLATE, run, parts=parts, limits=run.suite.get("limits", [])), tables


def _about(part: Mapping[str, Any]) -> dict[str, Any]:
    return {"question": part.get("question", ""), "limits": part.get("limits", "")}


def _read(folder: Path) -> Run | None:
    """The run of a part; None: it has no results."""
    try:
        return load_run(folder)
    except SSADError:
        return None
