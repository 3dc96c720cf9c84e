"""The records of a digital run, by detector and by what it was shown."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from ssad.core.registry import label_of, split_weights
from ssad.experiments.perception.shifts.page import cell_of, replicates_of
from ssad.metrics import replicate_difference
from ssad.report.load import Run
from ssad.report.tables import Cell

TITLES = {
    "fgsm": "FGSM",
    "pgd": "PGD",
    "cw": "C&W",
    "cw-min": "C&W, least change",
    "apgd": "APGD",
    "square": "Square",
    "nes": "NES",
    "spsa": "SPSA",
}
DEFENCES = {"jpeg": "JPEG", "bits": "bit depth", "blur": "blur", "resize": "random resizing"}


class Setting(NamedTuple):
    """What tells what a detector was shown.

    Attributes:
        attack: name; "": the clean data.
        loss, norm, radius, steps, options: of the attack.
        source: detector that the pictures were made against; "": the one that is shown them.
        defence: before the detector; "": none.
        aware: whether the attack knows it.
        target: of a targeted attack.
        subset: scenes of each town; 0: all.
    """

    attack: str = ""
    loss: str = ""
    norm: str = ""
    radius: float = 0.0
    steps: int = 0
    options: str = ""
    source: str = ""
    defence: str = ""
    aware: bool = False
    target: str = ""
    subset: int = 0

    @property
    def system(self) -> tuple[str, int]:
        """What scores can be compared of: the defence before the detector, and the scenes."""
        return self.defence, self.subset

    @property
    def plain(self) -> bool:
        """Whether it is an attack on all objects of the bare detector that is shown the pictures."""
        return not self.source and not self.defence and not self.target


@dataclass(frozen=True)
class DigitalRun:
    """A digital run: its folder, and its records by detector and setting of the attack."""

    run: Run
    records: Mapping[tuple[str, Setting], Mapping[str, Any]]

    @property
    def suite(self) -> Mapping[str, Any]:
        """The resolved suite."""
        return self.run.suite

    @property
    def scenes(self) -> int:
        """How many scenes were resampled for the intervals."""
        return max(int(record.get("scenes", 0)) for record in self.records.values())

    @property
    def detectors(self) -> list[str]:
        """In the order of the suite."""
        return [_called(text) for text in self.suite["detectors"]]

    @property
    def hardened(self) -> list[tuple[str, str]]:
        """Detectors of adversarially trained weights, and of each the one that its name begins with ("": none)."""
        names = [split_weights(text)[0] for text in self.suite.get("hardened", [])]
        ordinary = sorted((split_weights(text)[0] for text in self.suite["detectors"]), key=len, reverse=True)
        beside = (next((one for one in ordinary if name.startswith(one)), "") for name in names)
        return [(_called(name), _called(one)) for name, one in zip(names, beside, strict=True)]

    @property
    def everyone(self) -> list[str]:
        """Those, and the detectors that take part in the transfer alone."""
        others = [_called(text) for text in self.suite.get("transfer_detectors", [])]
        return [*self.detectors, *others]

    def flat(self, detector: str) -> bool:
        """Whether a detector finds 2D boxes."""
        return any(name == detector and record.get("task") == "2d" for (name, _), record in self.records.items())

    def metrics(self, detector: str) -> tuple[str, ...]:
        """The headline metrics of a detector."""
        return ("mAP",) if self.flat(detector) else ("mAP", "NDS")

    @property
    def about_flat(self) -> str:
        """What a note says about 2D detectors; "" where there is none."""
        names = [name for name in self.everyone if self.flat(name)]
        if not names:
            return ""
        return f" mAP of {' and '.join(names)}: AP50 of 2D boxes in the images, mean over the classes that are there."

    @property
    def settings(self) -> list[Setting]:
        """Of all attacks, in the order of the suite, the clean data first."""
        return list(dict.fromkeys(setting for _, setting in self.records))

    @property
    def rows(self) -> list[Setting]:
        """Those of the table, without those that only curves need."""
        return list(dict.fromkeys(setting for (_, setting), record in self.records.items() if record["row"]))

    def record(self, detector: str, setting: Setting) -> Mapping[str, Any] | None:
        """A record that is there and not failed."""
        found = self.records.get((detector, setting))
        return found if found is not None and found["status"] == "ok" else None

    def clean(self, detector: str, like: Setting | None = None) -> Mapping[str, Any] | None:
        """The record of the clean data, of the scenes and behind the defence of a setting."""
        defence, subset = like.system if like else ("", 0)
        return self.record(detector, Setting(defence=defence, subset=subset))


def _called(text: str) -> str:
    """What records call a detector that a suite names."""
    return label_of(split_weights(text)[0])


@dataclass(frozen=True)
class Resampling:
    """How many scenes were resampled for one record: it may be of fewer than others."""

    scenes: int


def load_digital_run(run: Run) -> DigitalRun:
    """The records of a run folder."""
    return DigitalRun(run, {(_called(r["detector"]), setting_of(r)): r for r in run.lines})


def setting_of(record: Mapping[str, Any]) -> Setting:
    """What tells the attack of a record from others; records of older versions say less."""
    return Setting(
        record["attack"] or "",
        record["loss"] or "",
        record["norm"] or "",
        float(record["radius"]),
        int(record["steps"]),
        record["options"],
        _called(record.get("source", "")),
        record.get("defence", ""),
        bool(record.get("aware")),
        record.get("target", ""),
        int(record.get("subset", 0)),
    )


def title_of(setting: Setting) -> str:
    """What people call an attack: its name and loss."""
    attack, loss = setting[:2]
    if not attack:
        return "clean"
    if attack == "ensemble":
        members = [one.split() for one in setting.options.removeprefix("of ").split(", ")]
        return f"worst of {', '.join(' '.join([TITLES.get(name, name), *rest]) for name, *rest in members)}"
    return f"{TITLES.get(attack, attack)}{f', {loss} loss' if loss else ''}"


def size_of(setting: Setting) -> str:
    """Budget, steps and options in a few words."""
    attack, _, norm, radius, steps, options = setting[:6]
    if not attack:
        return ""
    parts = [
        f"{radius:g} px{' L2' if norm == 'l2' else ''}",
        f"{steps} step{'s' if steps != 1 else ''}" if steps else "",
    ]
    options = "" if attack == "ensemble" else options
    return ", ".join(part for part in [*parts, options, setting.target] if part)


def scenes_of(setting: Setting) -> str:
    """Of which scenes the scores are, in words."""
    return f"{setting.subset} of each town" if setting.subset else "all"


def defence_of(setting: Setting) -> str:
    """A defence in words."""
    name, _, options = setting.defence.partition(" ")
    return ", ".join(part for part in [DEFENCES.get(name, name), options] if part) if name else ""


def circumstances(setting: Setting) -> str:
    """What besides attack and budget tells a setting, in words."""
    known = ("known to the attack" if setting.aware else "unknown to the attack") if setting.attack else ""
    parts = [f"made against {setting.source}" if setting.source else "", defence_of(setting)]
    return ", ".join(part for part in [*parts, known if setting.defence else ""] if part)


def metric_cell(record: Mapping[str, Any] | None, metric: str) -> Cell:
    """A metric in percent with its interval over the record's own scenes; n/a where there is none."""
    return Cell(math.nan) if record is None else cell_of(Resampling(int(record.get("scenes", 0))), record, metric)


def lost_cell(run: DigitalRun, detector: str, setting: Setting, metric: str) -> Cell:
    """Share of the clean score that an attack took away, percent; the interval from paired replicates.

    A score that more than doubled has no interval.
    """
    clean, own = run.clean(detector, setting), run.record(detector, setting)
    if clean is None or own is None or not clean["metrics"].get(metric) or own["metrics"].get(metric) is None:
        return Cell(math.nan)
    pairs = zip(replicates_of(clean, metric), replicates_of(own, metric), strict=True)
    value = 1.0 - own["metrics"][metric] / clean["metrics"][metric]
    if value < -1.0:  # else it lies in [-1, 1], as a difference of two scores does
        return Cell(100.0 * value)
    return _difference(value, [1.0 - after / before for before, after in pairs if before > 0], own)


def gained_cell(run: DigitalRun, detectors: tuple[str, str], setting: Setting, metric: str) -> Cell:
    """How much higher the first of two detectors scores, in points; the interval from paired replicates."""
    one, other = (run.record(name, setting) for name in detectors)
    if one is None or other is None or one["metrics"].get(metric) is None or other["metrics"].get(metric) is None:
        return Cell(math.nan)
    pairs = zip(replicates_of(one, metric), replicates_of(other, metric), strict=True)
    return _difference(one["metrics"][metric] - other["metrics"][metric], [a - b for a, b in pairs], one)


def _difference(value: float, replicates: Sequence[float], record: Mapping[str, Any]) -> Cell:
    found = replicate_difference(value, replicates, n=record["n"], clusters=int(record.get("scenes", 0)))
    return Cell.of(found.scaled(100.0))
