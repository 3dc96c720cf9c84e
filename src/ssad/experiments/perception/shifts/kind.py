"""Kind `detection`: 3D detectors x distribution shifts x severities over a data set in the nuScenes schema."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import product
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from ssad.core import safeio
from ssad.core.errors import ConfigError
from ssad.core.registry import Reference, label_of
from ssad.core.types import U8
from ssad.engine.kind import Cell, Job, Names
from ssad.experiments.perception.open_loop import CellDescription, DetectorSuite, OpenLoopKind
from ssad.experiments.perception.scene_boxes import Examination, SceneCondition
from ssad.experiments.perception.scored_data import Victims
from ssad.experiments.perception.sheets import STRONG, detection_sheet
from ssad.experiments.perception.shifts import page
from ssad.experiments.perception.shifts.verdict import verdict
from ssad.report.load import Run
from ssad.report.tables import Table
from ssad.scenarios.static.catalogue import parse_perturbation, registered_names
from ssad.scenarios.static.perturbation import Perturbation
from ssad.scenarios.static.shifts import KNOWN, SHIFTS, VERSIONS, Calibration, ShiftSpec, deal_severities
from ssad.scenarios.static.shifts.perturbation import Shift

OWN = "own"  # family of the shifts of packages and of the user
Severity = Annotated[int, Field(ge=1, le=5)] | Literal["random"]


class DetectionSuite(DetectorSuite):
    """One table: 3D detectors x shifts x severities, beside clean data; the first detector is the baseline of mCE.

    Attributes:
        shifts: Names, or module:object of a class with a method `shift` and an argument `severity`; arguments and a
            label may follow, as in mine:Haze?density=0.2@haze.
        severities: 1 to 5, or random (dealt to the scenes in equal shares; drawn by sample in the calibration of the
            paper).
        calibration: Calibration of the shifts.
    """

    kind: Literal["detection"]
    shifts: Names = Field(default=list(SHIFTS), min_length=1)
    severities: Annotated[list[Severity], Field(min_length=1)] = Field(default=[1, 2, 3, 4, 5, "random"], min_length=1)
    calibration: Literal["physical", "paper"] = "physical"


class Detection(OpenLoopKind):
    """See the module. Cells of all detectors share the work of shifting a scene: a piece is a scene under a shift."""

    name = "detection"
    suite = DetectionSuite
    factors = ("detector", "shift", "severity")
    families: ClassVar = {"shifts": "shift"}

    def check(self, suite: DetectionSuite) -> None:
        """Raise ConfigError for a shift or severity that appears twice or does not exist."""
        lists: dict[str, Sequence[object]] = {"shift": list(map(label_of, suite.shifts)), "severity": suite.severities}
        for key, values in lists.items():
            if len(set(values)) != len(values):
                raise ConfigError(f"suite {suite.name}: a {key} appears twice")
        for name in suite.shifts:
            shift_of(name, 1, suite.calibration)

    def rows(self, suite: DetectionSuite, victims: Victims, data: Mapping[str, Any]) -> Iterator[CellDescription]:
        """Yield the clean data, then each shift at each severity."""
        shifted = list(product(suite.shifts, suite.severities))
        for detector, (shift, severity) in product(victims.files, [(None, 0), *shifted]):
            name = label_of(shift) if shift else None
            family = family_of(shift) if shift else "clean"
            fields = {"detector": detector, "shift": name, "family": family, "severity": severity}
            spec = {"calibration": suite.calibration, "labels": "original", "shift": shift}
            title = f"{detector}/{name or 'clean'}/{severity}"
            version = shift_of(shift, 1, suite.calibration).version() if shift else ""
            yield CellDescription(title, detector, fields, spec, [safeio.dump_json(data), version])

    def versions(self, suite: DetectionSuite) -> dict[str, str]:
        """Return the version of the shifts."""
        return {"shifts": str(VERSIONS[suite.calibration])}

    def order(self, cell: Cell) -> float:
        """Clean first, then what the main table tells, the middle severity, the others."""
        severity = cell.fields["severity"]
        if cell.fields["shift"] is None:
            return 0
        return 1 if isinstance(severity, str) else 2 + abs(severity - 3)

    def scenes(self, cell: Cell, job: Job) -> list[SceneCondition]:
        """Return the scenes of a cell under its shift.

        A severity dealt to a scene is one of the five: its boxes are shared with that cell.
        """
        tokens: Mapping[str, str] = job.settings["scenes"]
        shift, severity, calibration = cell.spec["shift"], cell.fields["severity"], cell.spec["calibration"]
        is_dealt = severity == "random" and (calibration != "paper" or family_of(shift) == OWN)
        if shift is None or not is_dealt:
            return [shifted_scene(shift, severity, calibration, scene) for scene in tokens]
        # A shift of the user's own has no specification: it is dealt like uniform noise.
        spec = ShiftSpec(shift if shift in KNOWN else "uniform", seed=cell.seed, calibration=calibration)
        severity_by_token = deal_severities(spec, tokens.values())
        return [shifted_scene(shift, severity_by_token[token], calibration, scene) for scene, token in tokens.items()]

    def sheet(
        self, examination: Examination, suite: DetectionSuite, cell: Cell | None = None
    ) -> tuple[Callable[[], U8], str]:
        """Return a picture of one moment under each shift, and its caption."""
        shifts, severities = suite.shifts, suite.severities
        if cell is not None:
            shifts = [cell.spec["shift"]] if cell.spec["shift"] else []
            severities = [cell.fields["severity"]]
        severity = min(
            [level for level in severities if isinstance(level, int)] or [STRONG], key=lambda level: abs(level - STRONG)
        )
        caption = (
            f"What {examination.detectors[0][0]} finds (orange, score at least 0.3) and what is there (white), clean "
            f"and under each shift at severity {severity}."
        )
        perturbations = [shift_of(shift, severity, suite.calibration) for shift in shifts]
        return lambda: detection_sheet(examination, suite.split, perturbations), caption

    def page(self, run: Run) -> tuple[str, Sequence[Table]]:
        """Return the page of a run and its tables."""
        return page.section(run, self.verdict(run))

    def summary(self, run: Run) -> Table:
        """Return the main table of a run."""
        return page.summary(run)

    def verdict(self, run: Run) -> list[str]:
        """Return the findings of a run in sentences."""
        return verdict(run)


def shifted_scene(shift: str | None, severity: int | str, calibration: Calibration, scene: str) -> SceneCondition:
    """Return a scene under a shift at a severity; None: the clean scene."""
    return SceneCondition(scene, None if shift is None else shift_of(shift, severity, calibration))


def family_of(shift: str) -> str:
    """Return the family of a shift of SSAD; `OWN` for one of a package or of the user."""
    name = Reference.parse(shift).name
    is_own = name not in KNOWN and (":" in name or registered_names().get(name) == "shift")
    return OWN if is_own else ShiftSpec(shift).family


def shift_of(shift: str, severity: int | str, calibration: Calibration) -> Perturbation:
    """Return a shift at a severity.

    Args:
        shift: Name; of a shift of the user's own with arguments and label.
        severity: 1 to 5; "random" for a shift of SSAD alone.
        calibration: Calibration of the shifts of SSAD.

    Raises:
        UnknownNameError: There is no such shift.
        ConfigError: The user's shift cannot be made, or has no severities.
    """
    if family_of(shift) != OWN:
        return Shift(shift, severity, calibration)
    entry = parse_perturbation({"shift": shift})
    if not entry.has_severities:
        raise ConfigError(
            f"shift '{shift}' has no severities: give its class an argument severity, or name it in a suite of kind "
            "perception"
        )
    assert isinstance(severity, int)
    return entry.make(severity)
