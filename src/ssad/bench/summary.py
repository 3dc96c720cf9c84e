"""The table that a run ends with: systems x metrics x scenario groups."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rich.table import Table

if TYPE_CHECKING:
    from ssad.metrics import Estimate

SHOWN = ("CR", "OR", "DR", "RC")
"""Metrics of the table; the report has all of them."""

AVERAGE = "all"


def estimates(records: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, dict[str, Estimate]]]:
    """system -> group (and "all") -> metric -> Estimate. A record that is not ok counts as a failed episode."""
    from ssad.metrics import EpisodeMetrics, aggregate

    found: dict[str, dict[str, list[EpisodeMetrics | None]]] = {}
    for record in records:
        one = EpisodeMetrics.from_dict(record["metrics"]) if record["status"] == "ok" else None
        groups = found.setdefault(record["system"], {})
        for group in (record["group"], AVERAGE):
            groups.setdefault(group, []).append(one)
    return {
        system: {group: aggregate(episodes) for group, episodes in groups.items()} for system, groups in found.items()
    }


def table(title: str, records: Sequence[Mapping[str, Any]]) -> Table:
    """A Rich table; groups are rows and systems x metrics are columns, so that it fits a terminal."""
    systems = estimates(records)
    result = Table(title=title, title_justify="left", header_style="bold")
    result.add_column("scenario", no_wrap=True)
    result.add_column("n", justify="right")
    for system in systems:
        for i, metric in enumerate(SHOWN):
            name = system.rsplit(":", maxsplit=1)[-1]
            result.add_column(f"{name}\n{metric}" if i == 0 else f"\n{metric}", justify="right")
    groups = list(dict.fromkeys(r["group"] for r in records))
    for group in [*groups, AVERAGE]:
        members = [r for r in records if group in (r["group"], AVERAGE)]
        each = {r["system"]: sum(m["system"] == r["system"] for m in members) for r in members}
        cells = [group, str(max(each.values(), default=0))]
        for groups_of in systems.values():
            cells += [_shown(groups_of.get(group, {}).get(metric)) for metric in SHOWN]
        result.add_row(*cells, style="bold" if group == AVERAGE else None, end_section=group == groups[-1])
    failed = sum(r["status"] != "ok" for r in records)
    caption = "CR collisions per episode, OR m driven off road, DR m from the route, RC share of the route"
    result.caption = caption + (f"; {failed} of {len(records)} episodes failed" if failed else "")
    result.caption_justify = "left"
    return result


def _shown(estimate: Estimate | None) -> str:
    if estimate is None or estimate.mean is None or estimate.mean != estimate.mean:
        return "-"
    return f"{estimate.mean:.2f}"
