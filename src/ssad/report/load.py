"""A run folder as plain records, checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ssad.core import safeio
from ssad.core.errors import StoreError
from ssad.metrics import EpisodeMetrics
from ssad.report.paper import SCENARIOS

TYPES = {"NaturalJunction": "Natural", "Custom": "Own"}


@dataclass(frozen=True)
class Record:
    """One finished cell: its line of results.jsonl, and why its episode ended."""

    key: str
    system: str
    group: str
    type: str
    scenario: str
    town: str
    status: str
    reason: str
    end: str
    metrics: EpisodeMetrics | None
    witness: Mapping[str, Any] | None
    trace: str
    seed: int
    repetition: int

    @property
    def heading(self) -> str:
        """What the episode is shown under: the paper's name of its scenario, or its type and group."""
        if self.group in SCENARIOS:
            return SCENARIOS[self.group]
        return self.group if self.group in ("", self.type) else f"{TYPES.get(self.type, self.type)}: {self.group}"


@dataclass(frozen=True)
class Run:
    """All of a run folder that a report needs."""

    folder: Path
    header: Mapping[str, Any]
    records: tuple[Record, ...]
    planned: int

    @property
    def groups(self) -> list[str]:
        """Headings under which episodes are shown together, in the order of the suite."""
        return list(dict.fromkeys(r.heading for r in self.records))

    @property
    def systems(self) -> list[str]:
        """Systems in the order of the suite."""
        return list(dict.fromkeys(r.system for r in self.records))


def load_header(folder: Path | str) -> Mapping[str, Any]:
    """run.json of a run folder. StoreError if it does not hold a run."""
    folder = Path(folder)
    if not (folder / "run.json").is_file():
        raise StoreError(f"{folder}: no run here (run.json is missing); give a folder written by: ssad run")
    header: Mapping[str, Any] = safeio.read_json(folder / "run.json")
    return header


def load_run(folder: Path | str) -> Run:
    """Read run.json, results.jsonl and episodes.jsonl; a torn last line is left out.

    StoreError if the folder does not hold a run or the run has no result yet.
    """
    folder = Path(folder)
    header = load_header(folder)
    results = read_records(folder / "results.jsonl")
    if not results:
        raise StoreError(f"{folder}: the run has no results yet; run it again to go on")
    ends = {line["key"]: line.get("end", "") for line in read_records(folder / "episodes.jsonl")}
    order = {cell["key"]: k for k, cell in enumerate(header.get("cells", []))}
    records = [_record(line, ends.get(line["key"], "")) for line in results]
    records.sort(key=lambda r: order.get(r.key, len(order)))
    return Run(folder, header, tuple(records), max(len(order), len(records)))


def _record(line: Mapping[str, Any], end: str) -> Record:
    scenario = line["spec"]["scenario"]
    ok = line["status"] == "ok"
    return Record(
        key=line["key"],
        system=line["system"],
        group=line["group"],
        type=scenario["type"],
        scenario=scenario["name"],
        town=scenario["town"],
        status=line["status"],
        reason=line.get("reason", ""),
        end=end,
        metrics=EpisodeMetrics.from_dict(line["metrics"]) if ok else None,
        witness=line.get("witness"),
        trace=line.get("artefacts", {}).get("trace", "") if ok else "",
        seed=int(line.get("seed", 0)),
        repetition=int(line["spec"].get("repetition", 0)),
    )


def read_records(path: Path) -> list[dict[str, Any]]:
    """Lines of a JSONL file; what follows the last line end was torn by a kill and does not count."""
    if not path.is_file():
        return []
    whole = path.read_bytes().rpartition(b"\n")[0].decode("utf-8", "replace")
    out = []
    for number, text in enumerate(whole.splitlines(), start=1):
        if text.strip():
            line = safeio.parse_json(text, f"{path}:{number}")
            if not isinstance(line, dict) or "key" not in line:
                raise StoreError(f"{path}:{number}: not a record of a run")
            out.append(line)
    return out
