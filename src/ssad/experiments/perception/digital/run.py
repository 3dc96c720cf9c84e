"""Records of a digital run, by detector and setting of the attack."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from ssad.core.registry import label_of, split_weights
from ssad.experiments.perception.shifts.page import cell_of, replicates_of
from ssad.metrics import replicate_difference
from ssad.report.load import Run
from ssad.report.tables import TableCell

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
    """Setting of an attack: all that tells one input of a detector from another.

    Attributes:
        attack: Name; "": the clean data.
        loss: Loss of the attack.
        norm: Norm of its budget.
        radius: Radius of its budget.
        steps: Its steps.
        options: Its options.
        source: Detector that the images were made against; "": the evaluated one.
        defence: Defence before the detector; "": none.
        aware: Whether the attack knows the defence.
        target: Target of a targeted attack.
        subset: Scenes of each town; 0: all.
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
        """Defence and scenes: scores are comparable where both are equal."""
        return self.defence, self.subset

    @property
    def is_plain(self) -> bool:
        """True for an untargeted attack on the bare evaluated detector."""
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
        """Number of scenes that were resampled for the intervals."""
        return max(int(record.get("scenes", 0)) for record in self.records.values())

    @property
    def detectors(self) -> list[str]:
        """Detectors in the order of the suite."""
        return [_called(text) for text in self.suite["detectors"]]

    @property
    def hardened(self) -> list[tuple[str, str]]:
        """Detectors with adversarially trained weights, each with its ordinary counterpart ("": none).

        It is the detector with the longest name that says the same before "@", or a part of it: of
        `fcos3d-light@robust` that is `fcos3d-light@control` before `fcos3d-light`.
        """
        names = [split_weights(text)[0] for text in self.suite.get("hardened", [])]
        ordinary = sorted((split_weights(text)[0] for text in self.suite["detectors"]), key=len, reverse=True)
        counterparts = (
            next((counterpart for counterpart in ordinary if name.startswith(counterpart.partition("@")[0])), "")
            for name in names
        )
        return [(_called(name), _called(counterpart)) for name, counterpart in zip(names, counterparts, strict=True)]

    @property
    def all_detectors(self) -> list[str]:
        """Detectors of the table, and those that take part in the transfer alone."""
        transfer_detectors = [_called(text) for text in self.suite.get("transfer_detectors", [])]
        return [*self.detectors, *transfer_detectors]

    def is_2d(self, detector: str) -> bool:
        """Return whether a detector finds 2D boxes."""
        return any(name == detector and record.get("task") == "2d" for (name, _), record in self.records.items())

    def metrics(self, detector: str) -> tuple[str, ...]:
        """Return the headline metrics of a detector."""
        return ("mAP",) if self.is_2d(detector) else ("mAP", "NDS")

    @property
    def note_on_2d(self) -> str:
        """Remark on 2D detectors for notes; "" where there is none."""
        names = [name for name in self.all_detectors if self.is_2d(name)]
        if not names:
            return ""
        return f" mAP of {' and '.join(names)}: AP50 of 2D boxes in the images, mean over the classes that are there."

    @property
    def settings(self) -> list[Setting]:
        """Settings of all attacks, in the order of the suite, the clean data first."""
        return list(dict.fromkeys(setting for _, setting in self.records))

    @property
    def rows(self) -> list[Setting]:
        """Settings of the table, without those that only curves need."""
        return list(dict.fromkeys(setting for (_, setting), record in self.records.items() if record["row"]))

    def record(self, detector: str, setting: Setting) -> Mapping[str, Any] | None:
        """Return a record; None if it is absent or failed."""
        candidate = self.records.get((detector, setting))
        return candidate if candidate is not None and candidate["status"] == "ok" else None

    def clean(self, detector: str, setting: Setting | None = None) -> Mapping[str, Any] | None:
        """Return the record of the clean data, of the scenes and behind the defence of a setting."""
        defence, subset = setting.system if setting else ("", 0)
        return self.record(detector, Setting(defence=defence, subset=subset))


def _called(text: str) -> str:
    """Return the label in the records of a detector of the suite."""
    return label_of(split_weights(text)[0])


@dataclass(frozen=True)
class Resampling:
    """Number of scenes that were resampled for one record: it may be fewer than for others."""

    scenes: int


def load_digital_run(run: Run) -> DigitalRun:
    """Return the records of a run folder."""
    return DigitalRun(run, {(_called(record["detector"]), setting_of(record)): record for record in run.lines})


def setting_of(record: Mapping[str, Any]) -> Setting:
    """Return the setting of a record; records of older versions have fewer fields."""
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
    """Return the title of an attack: its name and loss."""
    attack, loss = setting[:2]
    if not attack:
        return "clean"
    if attack == "ensemble":
        members = [text.split() for text in setting.options.removeprefix("of ").split(", ")]
        return f"worst of {', '.join(' '.join([TITLES.get(name, name), *remainder]) for name, *remainder in members)}"
    return f"{TITLES.get(attack, attack)}{f', {loss} loss' if loss else ''}"


def size_of(setting: Setting) -> str:
    """Return budget, steps and options in a few words."""
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
    """Return the scenes of the scores, in words."""
    return f"{setting.subset} of each town" if setting.subset else "all"


def defence_of(setting: Setting) -> str:
    """Return a defence in words."""
    name, _, options = setting.defence.partition(" ")
    return ", ".join(part for part in [DEFENCES.get(name, name), options] if part) if name else ""


def circumstances(setting: Setting) -> str:
    """Return source and defence of a setting, in words."""
    awareness = ("known to the attack" if setting.aware else "unknown to the attack") if setting.attack else ""
    parts = [f"made against {setting.source}" if setting.source else "", defence_of(setting)]
    return ", ".join(part for part in [*parts, awareness if setting.defence else ""] if part)


def metric_cell(record: Mapping[str, Any] | None, metric: str) -> TableCell:
    """Return a metric in percent with its interval over the record's own scenes; n/a where there is none."""
    return TableCell(math.nan) if record is None else cell_of(Resampling(int(record.get("scenes", 0))), record, metric)


def lost_cell(run: DigitalRun, detector: str, setting: Setting, metric: str) -> TableCell:
    """Return the share of the clean score that an attack removed, percent; the interval from paired replicates.

    A score that more than doubled has no interval.
    """
    clean_record, attacked = run.clean(detector, setting), run.record(detector, setting)
    if (
        clean_record is None
        or attacked is None
        or not clean_record["metrics"].get(metric)
        or attacked["metrics"].get(metric) is None
    ):
        return TableCell(math.nan)
    pairs = zip(replicates_of(clean_record, metric), replicates_of(attacked, metric), strict=True)
    value = 1.0 - attacked["metrics"][metric] / clean_record["metrics"][metric]
    if value < -1.0:  # else it lies in [-1, 1], as a difference of two scores does
        return TableCell(100.0 * value)
    return _difference(
        value,
        [1.0 - attacked_score / clean_score for clean_score, attacked_score in pairs if clean_score > 0],
        attacked,
    )


def gained_cell(run: DigitalRun, detectors: tuple[str, str], setting: Setting, metric: str) -> TableCell:
    """Return how much higher the first of two detectors scores, in points; the interval from paired replicates."""
    first_record, second_record = (run.record(name, setting) for name in detectors)
    if (
        first_record is None
        or second_record is None
        or first_record["metrics"].get(metric) is None
        or second_record["metrics"].get(metric) is None
    ):
        return TableCell(math.nan)
    pairs = zip(replicates_of(first_record, metric), replicates_of(second_record, metric), strict=True)
    return _difference(
        first_record["metrics"][metric] - second_record["metrics"][metric],
        [first_score - second_score for first_score, second_score in pairs],
        first_record,
    )


def _difference(value: float, replicates: Sequence[float], record: Mapping[str, Any]) -> TableCell:
    interval = replicate_difference(value, replicates, n=record["n"], clusters=int(record.get("scenes", 0)))
    return TableCell.of(interval.scaled(100.0))
