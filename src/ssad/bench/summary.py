"""The table that a run ends with: scenario groups x systems, with the main metrics."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from rich.table import Table

from ssad.bench.kind import Plan

SHOWN = ("CR", "OR", "DR", "RC")
"""Metrics of the table; the report has all of them, with intervals."""


def table(title: str, records: Sequence[Mapping[str, Any]]) -> Table:
    """A Rich table. A record that is not ok is a failed episode; the last rows are the means of the groups."""
    from rich import box

    from ssad.metrics import FAMILIES, Outcome, aggregate_groups

    rows = aggregate_groups((r["system"], Outcome.from_record(r)) for r in records)
    systems = list(dict.fromkeys(row.system for row in rows))
    averages = [name for name in FAMILIES.values() if any(row.group == name for row in rows)]
    groups = [*dict.fromkeys(row.group for row in rows if row.group not in averages), *averages]
    failed = sum(r["status"] != "ok" for r in records)
    result = Table(title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, pad_edge=False)
    result.caption = (
        "CR collisions per episode and its 95 % interval (below five scenarios: its range);\n"
        "OR m driven off the road; DR m from the route; RC share of the route"
        + (f"\n{failed} of {len(records)} episodes failed and count" if failed else "")
    )
    result.caption_justify = "left"
    result.add_column("scenario", no_wrap=True)
    result.add_column("system", overflow="fold")
    for name in ("n", "CR", "", *SHOWN[1:]):
        result.add_column(name, justify="right", no_wrap=True)
    for group in groups:
        last = group in averages
        found = {row.system: row.values for row in rows if row.group == group}
        for i, system in enumerate(s for s in systems if s in found):
            crash, *others = (found[system][metric] for metric in SHOWN)
            interval = f"{_shown(crash.low)}-{_shown(crash.high)}"
            cells = [_shown(crash.mean), interval, *(_shown(other.mean) for other in others)]
            end = i == len(found) - 1
            result.add_row(
                "" if i else group,
                system.rsplit(":", maxsplit=1)[-1],
                str(crash.n),
                *cells,
                style="bold" if last else None,
                end_section=end and not last and groups[groups.index(group) + 1 :][:1] == averages[:1],
            )
    return result


def shift_table(title: str, records: Sequence[Mapping[str, Any]]) -> Table:
    """A Rich table of a detection suite: shifts x detectors, mAP and NDS at "random", else means over severities."""
    from rich import box

    detectors = list(dict.fromkeys(r["detector"] for r in records))
    shifts = list(dict.fromkeys(r["shift"] for r in records))
    result = Table(title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, pad_edge=False)
    result.add_column("shift", no_wrap=True)
    for detector in detectors:
        result.add_column(f"{detector} mAP", justify="right")
        result.add_column("NDS", justify="right")
    drawn = any(r["severity"] == "random" for r in records)
    result.caption = f"percent; {'severities from 1 to 5' if drawn else 'means over the severities that ran'}"
    result.caption_justify = "left"
    for shift in shifts:
        row = [str(shift or "clean").replace("_", " ")]
        for detector in detectors:
            own = [r for r in records if r["detector"] == detector and r["shift"] == shift and r["status"] == "ok"]
            own = [r for r in own if r["severity"] == "random"] or own
            for metric in ("mAP", "NDS"):
                values = [r["metrics"][metric] for r in own]
                row.append(f"{100 * sum(values) / len(values):.1f}" if values else "failed")
        result.add_row(*row, end_section=shift is None)
    return result


def _shown(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.2f}"


def summary_table(plan: Plan, records: Sequence[Mapping[str, Any]]) -> Table:
    """What a run ends with on the terminal."""
    title = plan.suite.title or plan.suite.name
    if plan.kind.name == "driving":
        return table(title, records)
    if plan.kind.name == "detection":
        return shift_table(title, records)
    return plain_table(title, plan, records)


def plain_table(title: str, plan: Plan, records: Sequence[Mapping[str, Any]]) -> Table:
    """A row a record: its factors, then its metrics."""
    from rich import box

    result = Table(title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, pad_edge=False)
    for name in (*plan.kind.factors, *(column.name for column in plan.kind.columns)):
        result.add_column(name)
    for record in records:
        values = (record["metrics"].get(column.name) for column in plan.kind.columns)
        shown = ("failed" if record["status"] != "ok" else "n/a" if v is None else f"{v:.3g}" for v in values)
        result.add_row(*(str(record.get(name, "")) for name in plan.kind.factors), *shown)
    return result
