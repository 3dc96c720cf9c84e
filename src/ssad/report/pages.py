"""The page of a run: which section it has, and what the pages of all kinds share."""

from __future__ import annotations

import hashlib
import importlib.util
import math
from pathlib import Path
from typing import Any

import jinja2

from ssad.core import safeio
from ssad.metrics import METRICS
from ssad.report.artefacts import artefact_problems
from ssad.report.load import Run, load_run
from ssad.report.tables import Cell, Table, to_csv, write_tables

TABLE_HASH = "hash-of-the-main-table"  # stands on a page until its tables are known


def write_report(folder: Path | str) -> Path:
    """Write DIR/report.html and DIR/tables/*.csv|md|tex from the records in DIR.

    The page is that of the run's kind: `ssad.report.kinds.KIND` if there is such a module, else tables of all columns.
    Missing or altered artefacts are named on it.

    Args:
        folder: a run folder.

    Returns:
        Where the page is.

    Raises:
        StoreError: the folder holds no run, has no results, or cannot be written.
    """
    run = load_run(folder)
    page, tables = kind_module(run.kind).section(run)
    write_tables(run.folder, tables)
    page = page.replace(TABLE_HASH, table_hash(tables[0]) if tables else "none")
    path = run.folder / "report.html"
    safeio.write_atomic(path, page)
    return path


def table_hash(table: Table) -> str:
    """12 hex digits over every number of a table, to the last digit: equal runs have equal ones."""
    return hashlib.sha256(to_csv(table).encode()).hexdigest()[:12]


def kind_module(kind: str) -> Any:
    """The module with `section` and `summary` of a kind, the default one if it has none of its own."""
    name = f"ssad.report.kinds.{kind}"
    if not kind.isidentifier() or importlib.util.find_spec(name) is None:
        name = "ssad.report.default"
    return importlib.import_module(name)


def render(name: str, run: Run, **values: Any) -> str:
    """A page from its template and what all pages show; what it is given is escaped."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("ssad.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["heat"] = heat
    verdict = importlib.import_module("ssad.report.verdict").verdict(run)  # it knows pages of kinds, which know this
    return environment.get_template(name).render(
        **{
            "run": run,
            "suite": run.suite,
            "versions": run.header.get("versions", {}),
            "verdict": verdict,
            "problems": artefact_problems(run),
            "table_hash": TABLE_HASH,
            **values,
        }
    )


def heat(cell: Cell, symbol: str) -> str:
    """Background of a table cell, from good (0) to bad (1), as a CSS colour mix; none but for driving metrics."""
    metric = METRICS.get(symbol)
    if metric is None or math.isnan(cell.mean) or metric.unit not in ("", "m") or not metric.better:
        return ""
    scale = {"OR": 10.0, "DR": 5.0}.get(symbol, metric.scale)
    share = min(max(cell.mean / scale, 0.0), 1.0)
    bad = share if metric.better == "lower" else 1.0 - share
    return f"--bad:{100 * bad:.0f}%"
