"""Options of `ssad shift`, and the shards that the work is divided into."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from ssad.core.errors import ConfigError
from ssad.core.version import __version__
from ssad.scenarios.static.shifts import KNOWN, VERSIONS, Calibration, ShiftSpec
from ssad.scenarios.static.shifts.spec import LIDAR_VERSIONS

Labels = Literal["original", "transformed"]
Strength = int | Literal["random"]
SUBSAMPLING = ("auto", "444", "422", "420")


@dataclass(frozen=True, slots=True)
class Options:
    """Options of `ssad shift`. Files in which nothing changes are linked, so severity 0 reproduces the dataset.

    Attributes:
        source: A nuScenes root.
        out: Folder that gets one root for each pair of shift and severity.
        version: Version of the dataset.
        shifts: Names of the shifts.
        severities: 0 to 5, or "random".
        seed: Seed of all draws.
        calibration: Calibration of the shifts.
        labels: Set of boxes in sample_annotation.json; the other set is written beside it.
        scenes: Names of scenes; empty: all.
        sweeps: Whether files between key frames are shifted too; else they are linked.
        lidar: Whether LiDAR files are shifted too; else they are linked.
        quality: Quality of JPEG files.
        subsampling: Chroma subsampling of JPEG files; "auto": 444 for sensor noise, which 420 would weaken by
            29 %, else 420.
    """

    source: Path
    out: Path
    version: str
    shifts: tuple[str, ...]
    severities: tuple[Strength, ...] = ("random",)
    seed: int = 0
    calibration: Calibration = "physical"
    labels: Labels = "original"
    scenes: tuple[str, ...] = ()
    sweeps: bool = True
    lidar: bool = True
    quality: int = 95
    subsampling: str = "auto"

    def __post_init__(self) -> None:
        for name in ("shifts", "severities", "scenes"):  # a repeated name is written only once
            object.__setattr__(self, name, tuple(dict.fromkeys(getattr(self, name))))
        if not self.shifts or not self.severities:
            raise ConfigError("no shift or no severity to apply")
        if self.labels not in ("original", "transformed"):
            raise ConfigError(f"labels '{self.labels}': expected original or transformed")
        if self.subsampling not in SUBSAMPLING:
            raise ConfigError(f"subsampling '{self.subsampling}': expected auto, 444, 422 or 420")
        if not 1 <= self.quality <= 100:
            raise ConfigError(f"quality {self.quality}: expected 1 to 100")
        # Building the specs checks the names of shifts and severities before anything is written.
        for shard in self.shards(("",)):
            shard.spec()
        out, source = self.out.resolve(), self.source.resolve()
        if out == source or source in out.parents or out in source.parents:
            raise ConfigError(
                f"{self.out}: the output must lie outside of the dataset {self.source}, and not around it"
            )

    def absolute(self) -> Options:
        """Return the options with absolute folders, which other processes can resolve."""
        return replace(self, source=self.source.absolute(), out=self.out.absolute())

    def shards(self, scenes: tuple[str, ...]) -> list[Shard]:
        """Return one shard for each shift, severity and scene."""
        return [
            Shard(self, shift, severity, scene)
            for shift in self.shifts
            for severity in self.severities
            for scene in scenes
        ]

    def root(self, shift: str, severity: Strength) -> Path:
        """Return the nuScenes root of a shift and severity."""
        return self.out / f"{shift}-{severity}"


@dataclass(frozen=True, slots=True)
class Shard:
    """One scene under one shift: the unit of work of a worker.

    Attributes:
        options: Options of the command.
        shift: Name of the shift.
        severity: Requested severity.
        scene: Name of the scene.
    """

    options: Options = field(repr=False)
    shift: str
    severity: Strength
    scene: str

    @property
    def root(self) -> Path:
        """The nuScenes root that the shard belongs to."""
        return self.options.root(self.shift, self.severity)

    @property
    def is_random(self) -> bool:
        """True if the severity is drawn at random."""
        return self.severity == "random"

    @property
    def subsampling(self) -> str:
        """Chroma subsampling of the shard's JPEG files."""
        if self.options.subsampling != "auto":
            return self.options.subsampling
        return "444" if KNOWN[self.shift][0] == "sensor" else "420"

    def spec(self) -> ShiftSpec:
        """Return the shift; severity 1 stands for a random one until it is drawn."""
        severity = 1 if self.severity == "random" else self.severity
        return ShiftSpec(self.shift, severity, self.options.seed, self.options.calibration)

    def identity(self) -> Mapping[str, Any]:
        """Return all that determines the bytes of the files: shards of one identity and source are equal."""
        options = self.options
        return {
            "shift": self.shift,
            "severity": self.severity,
            "seed": options.seed,
            "calibration": options.calibration,
            "sweeps": options.sweeps,
            "lidar": options.lidar,
            "quality": options.quality,
            "subsampling": self.subsampling,
            "shift_version": VERSIONS[options.calibration],
            "lidar_version": LIDAR_VERSIONS[options.calibration],
            "ssad": __version__,
        }
