"""Records of a driving run, and the numbers of its page, each computed once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from ssad.metrics import FAMILIES, EpisodeOutcome, Estimate, aggregate_groups
from ssad.report.load import Run
from ssad.report.paper import SCENARIOS

TYPES = {
    "NaturalJunction": "Natural",
    "Custom": "Own",
    "ssad.simulators.highway_env:SCENARIO": "highway-env",
}
FAMILY_TITLES = {"pre-crash": "pre-crash", "natural": "natural traffic", "other": "other routes"}


@dataclass(frozen=True)
class EpisodeRecord:
    """One finished episode: its line of results.jsonl, and why it ended."""

    key: str
    system: str
    group: str
    type: str
    scenario: str
    town: str
    status: str
    reason: str
    end: str
    outcome: EpisodeOutcome
    witness: Mapping[str, Any] | None
    trace: str

    @property
    def heading(self) -> str:
        """Heading of the episode: the paper's name of its scenario, or its type and group."""
        if self.group in SCENARIOS:
            return SCENARIOS[self.group]
        return self.group if self.group in ("", self.type) else f"{TYPES.get(self.type, self.type)}: {self.group}"


@dataclass(frozen=True)
class DrivingRun:
    """A driving run: its folder, its episodes, and its numbers."""

    run: Run
    records: tuple[EpisodeRecord, ...]

    @property
    def folder(self) -> Path:
        """Folder of the run."""
        return self.run.folder

    @cached_property
    def systems(self) -> list[str]:
        """Systems in the order of the suite."""
        return list(dict.fromkeys(record.system for record in self.records))

    @cached_property
    def headings(self) -> dict[str, str]:
        """Group, or average of a family -> heading; in the order of the suite, the averages last."""
        return {record.group: record.heading for record in self.records} | {name: name for name in FAMILIES.values()}

    @cached_property
    def numbers(self) -> dict[tuple[str, str], dict[str, Estimate]]:
        """(system, group or average of a family) -> symbol -> estimate: the source of every number on the page."""
        return {
            (row.system, row.group): row.values
            for row in aggregate_groups((record.system, record.outcome) for record in self.records)
        }

    def average(self, system: str, family: str) -> dict[str, Estimate] | None:
        """Return the average of a family's groups, or its only group; None if the system has none."""
        groups = [
            record.group for record in self.records if record.system == system and record.outcome.family == family
        ]
        return self.numbers.get((system, FAMILIES[family])) or (self.numbers[system, groups[0]] if groups else None)

    def is_measured(self, symbol: str) -> bool:
        """Return whether any episode measured a metric."""
        return any(values[symbol].n for values in self.numbers.values())


def load_episodes(run: Run) -> DrivingRun:
    """Return the episodes of a driving run."""
    return DrivingRun(run, tuple(_make_record(line, run.episodes.get(line["key"], {})) for line in run.lines))


def _make_record(line: Mapping[str, Any], episode: Mapping[str, Any]) -> EpisodeRecord:
    scenario = line["spec"]["scenario"]
    succeeded = line["status"] == "ok"
    return EpisodeRecord(
        key=line["key"],
        system=line["system"],
        group=line["group"],
        type=scenario["type"],
        scenario=scenario["name"],
        town=scenario["town"],
        status=line["status"],
        reason=line.get("reason", ""),
        end=episode.get("end", ""),
        outcome=EpisodeOutcome.from_record(line, episode.get("trace_hash", "")),
        witness=line.get("witness"),
        trace=line.get("artefacts", {}).get("trace", "") if succeeded else "",
    )
