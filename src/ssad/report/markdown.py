"""All tables of a run as one Markdown page, which says where the numbers come from."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from ssad.report.load import Run
from ssad.report.tables import Table, to_markdown

SOFTWARE = ("python", "numpy", "torch", "warp-lang")
INPUT_TITLES = {"weights": "Weights", "systems": "Systems", "towns": "Towns"}


def run_markdown(run: Run, tables: Iterable[Table], verdict: Sequence[str] = ()) -> str:
    """Return the tables of a run as Markdown, after the title, the findings and the origin of the numbers.

    Args:
        run: The run; see `ssad.report.join.join_runs` for several.
        tables: Its tables; those without a row are left out.
        verdict: Findings in sentences.
    """
    blocks = [f"# {run.title}"]
    if not run.changed_settings and run.suite.get("description"):
        blocks.append(str(run.suite["description"]))
    if verdict:
        blocks.append("\n".join(f"* {sentence}" for sentence in verdict))
    blocks.append("\n".join(_origin(run)))
    for table in tables:
        if table.rows:
            blocks += [to_markdown(table).strip(), *_counts(table)]
    return "\n\n".join(blocks) + "\n"


def _origin(run: Run) -> list[str]:
    """Return the commands, versions and cells behind the numbers as lines of Markdown."""
    commands = run.header.get("commands") or [run.command]
    lines = ["```", *commands, "```", ""]
    versions = [line.get("versions") or {} for line in run.lines]
    header_versions = run.header.get("versions") or {}
    software = [
        f"SSAD {header_versions.get('ssad', 'of an unknown version')} (code {run.header.get('code', 'unknown')})"
    ]
    for name in SOFTWARE:
        numbers = sorted({str(line[name]) for line in (*versions, header_versions) if name in line})
        software += [f"{name} {' and '.join(numbers)}"] if numbers else []
    lines.append(f"* Software: {', '.join(software)}.")
    for key, title in INPUT_TITLES.items():
        inputs: Mapping[str, Any] = run.header.get(key) or {}
        input_lines = [f"`{name}` {version}" for name, version in inputs.items() if version]
        lines += [f"* {title}: {', '.join(input_lines)}."] if input_lines else []
    successful_lines = [line for line in run.lines if line["status"] == "ok"]
    devices = Counter(
        str((line.get("versions") or {}).get("device") or header_versions.get("device") or "an unknown device")
        for line in successful_lines
    )
    device_counts = " and ".join(f"{count:,} on {device}" for device, count in devices.items())
    lines.append(
        f"* Cells: {len(successful_lines):,} of {run.planned:,}{f', {device_counts}' if device_counts else ''}."
    )
    finished_keys = {line["key"] for line in run.lines}
    missing = [
        str(cell.get("name", cell["key"])) for cell in run.header.get("cells", ()) if cell["key"] not in finished_keys
    ]
    lines += [f"* Not run: {_listed(missing)}."] if missing else []
    reasons: dict[str, list[str]] = {}
    for line in run.failures:
        reasons.setdefault(str(line.get("reason") or line["status"]), []).append(
            run.names.get(line["key"], line["key"])
        )
    lines += [f"* Failed ({reason}): {_listed(names)}." for reason, names in reasons.items()]
    return lines


def _listed(names: Sequence[str], limit: int = 20) -> str:
    """Return names in a list, the number of the others at its end."""
    listed_names = ", ".join(f"`{name}`" for name in names[:limit])
    return f"{listed_names} and {len(names) - limit:,} more" if len(names) > limit else listed_names


def _counts(table: Table) -> list[str]:
    """Return in a sentence how many cases and clusters are behind a number of a table; empty if none is counted."""
    cells = [cell for row in table.rows if not row.published for cell in row.cells if cell.n]
    if not cells:
        return []
    clusters = [cell.clusters for cell in cells if cell.clusters]
    noun = "cluster" if clusters and max(clusters) == 1 else "clusters"
    cluster_text = f" in {_range(clusters)} {noun}" if clusters else ""
    return [f"n = {_range([cell.n for cell in cells])}{cluster_text}."]


def _range(counts: Sequence[int]) -> str:
    lowest, highest = min(counts), max(counts)
    return f"{lowest:,}" if lowest == highest else f"{lowest:,} to {highest:,}"
