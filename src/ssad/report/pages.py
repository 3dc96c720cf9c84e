"""Pages of runs: rendering of a template, with the common parts of the pages of all kinds."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jinja2

from ssad.metrics import METRICS
from ssad.report.artefacts import artefact_problems
from ssad.report.load import Run
from ssad.report.matrix import matrix_text, run_matrices, shade
from ssad.report.tables import Table, TableCell, to_csv
from ssad.report.verdict import complete_verdict

TABLE_HASH = "hash-of-the-main-table"  # stands on a page until its tables are known


def table_hash(table: Table) -> str:
    """Return 12 hex digits over every number of a table, to the last digit: equal runs have equal ones.

    Measured times of the machine are left out: they differ from run to run.
    """
    return hashlib.sha256(to_csv(table, clock=False).encode()).hexdigest()[:12]


def render(template: str | Path, run: Run, *, verdict: Sequence[str] = (), **values: Any) -> str:
    """Render a page from its template, with the common parts of all pages; every value is escaped.

    Args:
        template: Name of a template of the report, or path of a template of a kind's own. It extends "base.html".
        run: The run.
        verdict: Leading sentences of the page (see `ssad.report.verdict.complete_verdict`).
        values: Further values of the template.
    """
    path = Path(template)
    loaders: list[jinja2.BaseLoader] = [jinja2.PackageLoader("ssad.report")]
    if path.is_absolute():
        # A kind's own folder first, so that its templates may replace those of the report.
        loaders.insert(0, jinja2.FileSystemLoader(path.parent))
    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader(loaders),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["heat"] = heat
    environment.filters["shade"] = shade
    environment.filters["matrix_text"] = matrix_text
    return environment.get_template(path.name).render(
        **{
            "run": run,
            "suite": run.suite,
            "versions": run.header.get("versions", {}),
            "verdict": complete_verdict(run, verdict),
            "problems": artefact_problems(run),
            "table_hash": TABLE_HASH,
            "matrices": run_matrices(run),
            **values,
        }
    )


def heat(cell: TableCell, symbol: str) -> str:
    """Background of a table cell, from good (0) to bad (1), as a CSS colour mix; none but for driving metrics.

    Where cases failed, the limit that is worse decides: what never ran is not coloured as good.
    """
    metric = METRICS.get(symbol)
    if metric is None or math.isnan(cell.mean) or metric.unit not in ("", "m") or not metric.better:
        return ""
    scale = {"OR": 10.0, "DR": 5.0}.get(symbol, metric.scale)
    worse_limit = cell.high if metric.better == "lower" else cell.low
    value = worse_limit if cell.failed and not math.isnan(worse_limit) else cell.mean
    fraction = min(max(value / scale, 0.0), 1.0)
    redness = fraction if metric.better == "lower" else 1.0 - fraction
    return f"--bad:{100 * redness:.0f}%"
