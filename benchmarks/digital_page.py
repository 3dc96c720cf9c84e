"""Write docs/results/digital.md from the tables of `ssad run digital`: python -m benchmarks.digital_page [RUN...]

benchmarks/results/digital holds the tables of runs, and run.json without its cells. With runs (folders) these are
stored first; several of them, such as the rest of one on another device, are joined.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.joined_runs import joined, summary_of
from benchmarks.provenance import origin, warning
from ssad.core.checkpoints import state_hash
from ssad.experiments.perception.digital.page import section
from ssad.experiments.perception.scene_boxes import detector_of
from ssad.experiments.suites import load_suite
from ssad.report.tables import to_markdown

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "digital"
PAGE = ROOT / "docs" / "results" / "digital.md"
TABLES = (
    "digital",
    "lost",
    "halving",
    "transfer",
    "defences",
    "hardened",
    "blackbox",
    "targets",
    "distances",
    "classes",
    "audit",
)


def store(folders: Sequence[Path]) -> None:
    """Keep what the page needs of runs."""
    run = joined(folders)
    tables = {table.name: table for table in section(run)[1]}
    for name in TABLES:
        (RESULTS / f"{name}.md").unlink(missing_ok=True)
        if name in tables:
            (RESULTS / f"{name}.md").write_text(to_markdown(tables[name]))
    (RESULTS / "run.json").write_text(json.dumps(summary_of(run), indent=1) + "\n")


def outdated() -> list[str]:
    """Detectors whose shipped weights are others than those that were attacked."""
    weights = json.loads((RESULTS / "run.json").read_text())["weights"]
    return [name for name, known in weights.items() if state_hash(detector_of(name, "", "cpu")) != known]


def grown(stored: dict[str, Any]) -> list[str]:
    """What the suite has by now that the stored run does not have: attacks of the table, detectors of the transfer."""
    suite = load_suite("digital").model_dump(mode="json")
    known, fresh = ([_said(one) for one in told["attacks"]] for told in (stored, suite))
    about = ("name", "loss", "object", "precision")
    names = dict.fromkeys(f"`{' '.join(str(one[k]) for k in about if k in one)}`" for one in fresh if one not in known)
    missing = [f"the attack{'s' if len(names) > 1 else ''} {', '.join(names)}"]
    others = [f"`{one}`" for one in suite["transfer_detectors"] if one not in stored.get("transfer_detectors", [])]
    hard = [f"`{one}`" for one in suite["hardened"] if one not in stored.get("hardened", [])]
    found = [*(missing if names else []), *([f"transfer to and from {' and '.join(others)}"] if others else [])]
    return found + ([f"the adversarially trained {' and '.join(hard)}"] if hard else [])


def _said(told: Any) -> Any:
    """What a suite says, without what it leaves open."""
    if isinstance(told, list):
        return [_said(one) for one in told]
    return {k: _said(v) for k, v in told.items() if v} if isinstance(told, dict) else told


def page() -> str:
    """The page."""
    about = json.loads((RESULTS / "run.json").read_text())
    data, weights = about["data"], about["weights"]
    old = outdated()
    towns = " and ".join(data["towns"])
    lines = ["# The shipped 3D detectors under digital attacks", ""]
    if outside := warning(about):
        lines += [f"> {outside}", ""]
    if old:
        lines += [f"> **Measured with earlier weights of {' and '.join(old)}.** Compare these numbers with each other,"]
        lines += ["> not with a new run.", ""]
    lines += [
        "`benchmarks/digital_page.py` makes this page from `benchmarks/results/digital`, which has the tables that",
        f"{'this command' if len(about['command']) == 1 else 'these commands'} wrote:",
        "```",
        *about["command"],
        "```",
        f"Data: {data['scenes']} drives of {data['seconds']:g} s in each of {towns}, which were not used for training;",
        f"six cameras, {data['width']} pixels wide. {origin(about)} Weights:",
        ", ".join(f"`{name}` {digest}" for name, digest in weights.items()) + ".",
        "What the attacks, losses and rules of the audit are: [digital attacks](../reference/attacks.md).",
    ]
    if len(about["ran"]) > 1:
        lines.append(f"{' and '.join(f'{count} cells on {device}' for device, count in about['ran'].items())}.")
        lines.append("A cell that failed on one device kept the scenes that it had finished there.")
    if gone := [*about["missing"], *about["failed"]]:
        lines.append(f"Not there, so n/a or without a row: {', '.join(f'`{one}`' for one in gone)}.")
    if new := grown(about["suite"]):
        lines.append(f"Added to the suite since, and not in these tables: {'; '.join(new)}.")
    lines.append("")
    for name in (name for name in TABLES if (RESULTS / f"{name}.md").is_file()):
        lines += [(RESULTS / f"{name}.md").read_text().strip(), ""]
    return "\n".join(lines)


if __name__ == "__main__":
    if sys.argv[1:]:
        store([Path(folder) for folder in sys.argv[1:]])
    PAGE.write_text(page())
