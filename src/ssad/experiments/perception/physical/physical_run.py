"""A physical run as its pages read it: records by attack, titles, controls, and scores in percent."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from ssad.metrics.attack_success import N0
from ssad.report.load import Run
from ssad.report.records import Line
from ssad.report.tables import TableCell

TITLES = {"adv-patch": "Adv. Patch", "das": "DAS", "tpa": "TPA", "vanishing": "vanishing (strong)"}
LIGHT = "light, "  # carriers of light attacks begin so; the hour follows
CONTROLS = ("random", "noise", "grey", "shuffled")

Shown = tuple[str, str, str]
"""Attack, carrier, and the detector that it was trained against ("" for what is not trained)."""


@dataclass(frozen=True)
class PhysicalRun:
    """A physical run and its records, several for a control that was drawn several times."""

    run: Run

    @cached_property
    def records(self) -> Mapping[tuple[str, str, str, Shown], list[Line]]:
        """Records by town of the test, view, detector, and attack."""
        lines_by_key: dict[tuple[str, str, str, Shown], list[Line]] = {}
        for line in self.run.lines:
            attack_key = (line["attack"], line["carrier"], line["source"])
            lines_by_key.setdefault((line["test"], line.get("view", "drive"), line["detector"], attack_key), []).append(
                line
            )
        return lines_by_key

    @property
    def pairs(self) -> list[tuple[str, str]]:
        """Towns of training and test."""
        return list(dict.fromkeys((line["train"], line["test"]) for line in self.run.lines))

    @property
    def detectors(self) -> list[str]:
        """Detectors that textures were trained against."""
        return list(self.run.suite["detectors"])

    @property
    def judges(self) -> list[str]:
        """All evaluated detectors."""
        return list(dict.fromkeys(line["detector"] for line in self.run.lines))

    @property
    def attacks(self) -> list[tuple[str, str]]:
        """Attacks and controls with their carriers, in the order of the suite, clean first."""
        return list(dict.fromkeys((line["attack"], line["carrier"]) for line in self.run.lines))

    def clean_lines(self, test: str, view: str, detector: str, carrier: str) -> list[Line]:
        """Return the records of the clean images for a carrier; for a light, those of its hour."""
        hours = {clean_carrier for name, clean_carrier in self.attacks if name == "clean"}
        carrier_hours = [hour for hour in hours if f"{carrier}, ".startswith(f"{hour}, ")]
        return self.lines(test, view, detector, ("clean", carrier_hours[0] if carrier_hours else ""))

    def all_lines(self, test: str, view: str, detector: str, carrier: str) -> list[Line]:
        """Return all records with a carrier, whatever the textures were trained against, in order of the suite."""
        return [
            line
            for (town, seen_from, judge, (_, own_carrier, _)), lines in self.records.items()
            if (town, seen_from, judge, own_carrier) == (test, view, detector, carrier)
            for line in lines
            if line["status"] == "ok"
        ]

    def lines(
        self, test: str, view: str, detector: str, attack: tuple[str, str], source: str | None = None
    ) -> list[Line]:
        """Records of an attack on a detector, of a texture that was trained against itself unless a source is said."""
        for trained_against in ((detector if source is None else source), ""):
            matches = self.records.get((test, view, detector, (*attack, trained_against)))
            if matches:
                return [line for line in matches if line["status"] == "ok"]
        return []


def title_of(attack: tuple[str, str]) -> str:
    """Return the title of an attack or control on a carrier."""
    name, carrier = attack
    prefix, _, remainder = name.partition(" ")
    if carrier.startswith(LIGHT):
        return f"{name}, {carrier.removeprefix(LIGHT)}"
    _, _, options = carrier.partition(", ")
    if prefix == "shuffled":
        title = f"shuffled {_attack(remainder)}"
    elif name in CONTROLS:
        return f"{name} {carrier}"
    else:
        title = _attack(name)
    return f"{title}, {options}" if options else title


def _attack(name: str) -> str:
    """Return the title of an attack's name, which may end in ", all sides"."""
    prefix, separator, remainder = name.partition(", ")
    return f"{TITLES.get(prefix, prefix)}{separator}{remainder}"


def score(lines: Sequence[Line], metric: str) -> TableCell:
    """Return a metric in percent, the mean over draws of a control, with its interval.

    The interval is over drives; of several draws it goes from the lowest to the highest end of theirs, so that it
    covers drives and draws. Where a draw has none it is the range of the draws. An attack success rate has no value in
    records without its n0, which tells whether the clean detector finds enough.
    """
    count_name = N0.get(metric)
    measured = [
        line
        for line in lines
        if line["metrics"].get(metric) is not None and (count_name is None or count_name in line["metrics"])
    ]
    if not measured:
        return TableCell(math.nan)
    if metric in N0.values():
        return TableCell.value(measured[0]["metrics"][metric], digits=0)
    percentages = [100.0 * float(line["metrics"][metric]) for line in measured]
    mean, count = (
        math.fsum(percentages) / len(percentages),
        int(measured[0]["metrics"][count_name] if count_name else measured[0]["n"]),
    )
    limits = [interval for line in measured if (interval := (line.get("intervals") or {}).get(metric))]
    # A draw without an interval has too few drives: only the spread of the draws is known.
    if len(limits) < len(measured) > 1:
        return TableCell(mean, min(percentages), max(percentages), count, clusters=len(percentages), method="range")
    low = 100.0 * min((float(interval[0]) for interval in limits), default=math.nan)
    high = 100.0 * max((float(interval[1]) for interval in limits), default=math.nan)
    return TableCell(mean, low, high, count, clusters=int(measured[0]["drives"]), method="given")


def floor_of(run: Run) -> float:
    """Return the floor of a run; runs that do not say it have the default of the suite."""
    return float(run.suite.get("floor", 0.9))


def is_control(name: str) -> bool:
    """Return whether a row such as "shuffled das" or "random laser" is a control, without training."""
    return name.split(maxsplit=1)[0] in CONTROLS


def learns_nothing(control: str, attack: str) -> bool:
    """Return whether it is a control of an attack.

    The control of a light ("random laser") counts only for its own kind ("laser, searches 4").
    """
    prefix, _, remainder = control.partition(" ")
    return prefix in CONTROLS and (prefix != "random" or remainder in ("", attack.partition(", ")[0]))


def lower(cell: TableCell) -> float:
    """Return the lower end of a cell's interval, or its number."""
    return cell.mean if math.isnan(cell.low) else cell.low
