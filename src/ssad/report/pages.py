"""What the report's pages share: templates, the colour of a cell, the command that makes a run again."""

from __future__ import annotations

import math

import jinja2

from ssad.metrics import METRICS
from ssad.report.tables import Cell


def template(name: str) -> jinja2.Template:
    """A page's template; what it is given is escaped."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("ssad.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["heat"] = heat
    return environment.get_template(name)


def heat(cell: Cell, symbol: str) -> str:
    """Background of a table cell, from good (0) to bad (1), as a CSS colour mix; none but for driving metrics."""
    metric = METRICS.get(symbol)
    if metric is None or math.isnan(cell.mean) or metric.unit not in ("", "m") or not metric.better:
        return ""
    scale = {"OR": 10.0, "DR": 5.0}.get(symbol, 1.0)
    share = min(max(cell.mean / scale, 0.0), 1.0)
    bad = share if metric.better == "lower" else 1.0 - share
    return f"--bad:{100 * bad:.0f}%"
