"""Kind `digital`: 3D detectors x digital attacks x losses x budgets x steps over a data set in the nuScenes schema."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

from ssad.bench.kind import Cell, Column, Job, Plan
from ssad.bench.kinds.detection import DetectorKind, DetectorSuite, data_of, detectors_of
from ssad.core import safeio
from ssad.core.errors import ConfigError
from ssad.core.types import U8
from ssad.evaluation.attack_sheet import attack_sheet
from ssad.evaluation.attacked_scenes import AttackedScene, AttackSpec, sum_notes, takes
from ssad.evaluation.scene_boxes import Condition, Examination, ShiftedScene, boxes_path, find_boxes, score_scenes
from ssad.scenarios.static.digital import default_loss, make_objective
from ssad.scenarios.static.digital.budget import Norm

Radius = Annotated[float, Field(ge=0.0, le=255.0 * 4000, allow_inf_nan=False)]
Steps = Annotated[int, Field(ge=1)]


class Method(BaseModel):
    """An attack as a suite names it.

    Attributes:
        name: of the attack (`ssad list attacks`).
        loss: what it ascends (default: what the attack is about).
        norm: of the budget.
        options: further settings, such as restarts.
    """

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)

    name: str = Field(min_length=1)
    loss: str | None = None
    norm: Literal["linf", "l2"] = "linf"
    options: dict[str, Any] = {}


class Entry(Method):
    """A row of the table: radius (8-bit code values) and steps, where they are not the suite's."""

    radius: Radius | None = None
    steps: Steps | None = None


class Sweep(Method):
    """A curve: an attack over radii at the suite's steps, and over steps at the suite's radius."""

    radii: list[Radius] = []
    steps: list[Steps] = []


class DigitalSuite(DetectorSuite):
    """One table: 3D detectors x digital attacks, beside the clean data and random noise of the same size.

    Attributes:
        attacks: names, or mappings with the keys of `Entry`.
        sweeps: curves.
        radius: 8-bit code values that a picture may be moved by, where an attack does not say it.
        steps: gradient steps, likewise.
        batch: camera images that are attacked at once on a GPU; where memory does not suffice they are fewer.
    """

    kind: Literal["digital"]
    attacks: list[Entry] = Field(
        default=[Entry(name="fgsm"), Entry(name="pgd"), Entry(name="cw"), Entry(name="pgd", loss="margin")],
        min_length=1,
    )
    sweeps: list[Sweep] = Field(default=[])
    radius: Radius = Field(default=5.0, gt=0.0)
    steps: Steps = 10
    batch: int = Field(default=12, ge=1)

    @field_validator("attacks", "sweeps", mode="before")
    @classmethod
    def _named(cls, value: Any) -> Any:
        """A name alone is an attack with nothing else said."""
        return [{"name": one} if isinstance(one, str) else one for one in value] if isinstance(value, list) else value


class Digital(DetectorKind):
    """See the module. An attack on a detector is of use for this detector alone: a piece is a scene under an attack on
    one detector."""

    name = "digital"
    suite = DigitalSuite
    columns = (*DetectorKind.columns, Column("drop", "share of the clean mAP that is lost", "", "higher"))
    factors = ("detector", "attack", "loss", "norm", "radius", "steps", "options")

    def plan(self, suite: DigitalSuite, *, device: str = "cpu", check: bool = True) -> Plan:
        """Attacks and detectors are built once, the data set is looked at."""
        named = [_spec(suite, one, one.radius, one.steps) for one in suite.attacks]
        if len(set(named)) != len(named):
            raise ConfigError(f"suite {suite.name}: attacks: one of them appears twice")
        table = {*named, *_with_noise(named)}
        specs = _with_noise([*named, *_swept(suite)])
        weights, detectors = detectors_of(suite)
        data = data_of(suite)
        cells = []
        for detector in detectors:
            for spec in [None, *specs]:
                title = f"{detector}/{spec.name if spec else 'clean'}"
                inputs = weights[detector], safeio.dump_json(data), device, suite.replicates
                fields = {"detector": detector, **_fields(spec), "row": spec is None or spec in table}
                told = {} if spec is None else _told(spec)
                cells.append(self.make_cell(title, detector, suite.seed, fields, told, *inputs))
        return Plan(self, suite, device, tuple(cells), {"weights": weights, "data": data}, {}, detectors)

    def order(self, cell: Cell) -> float:
        """Clean first, then the rows of the table, then the curves."""
        return 0 if not cell.spec else 1 if cell.fields["row"] else 2

    def scenes(self, cell: Cell, job: Job) -> list[Condition]:
        """See `DetectorKind`."""
        scenes = list(job.settings["scenes"])
        if not cell.spec:
            return [ShiftedScene(None, 0, scene) for scene in scenes]
        return [AttackedScene(_told_spec(cell.spec), scene, job.settings["batch"]) for scene in scenes]

    def pieces(self, cell: Cell, job: Job) -> Mapping[str, Any]:
        """Scenes whose boxes are still to be found; clean ones, which every cell is compared with, for all detectors
        at once."""
        found: dict[str, Any] = {}
        for scene in job.settings["scenes"]:
            clean = ShiftedScene(None, 0, scene)
            if not boxes_path(job.folder, cell.system, clean).is_file():
                found[clean.name] = {"scene": scene}
        for one in self.scenes(cell, job) if cell.spec else []:
            if not boxes_path(job.folder, cell.system, one).is_file():
                found[f"{cell.system}/{one.name}"] = {"scene": one.scene, "batch": job.settings["batch"], **cell.spec}
        return found

    def condition(self, data: Any) -> Condition:
        """See `DetectorKind`."""
        if "attack" not in data:
            return ShiftedScene(None, 0, data["scene"])
        return AttackedScene(_told_spec(data), data["scene"], data["batch"])

    def settings(self, suite: DigitalSuite) -> dict[str, Any]:
        """See `DetectorKind`."""
        return {"batch": suite.batch}

    def score(self, examination: Examination, cell: Cell, scenes: Sequence[Condition], job: Job) -> dict[str, Any]:
        """Metrics, what the attack took, and which share of the detector's clean mAP it took away."""
        count = job.settings["replicates"]
        if not cell.spec:
            return score_scenes(examination, cell.system, scenes, replicates=count, notes=lambda notes: {})
        found = score_scenes(examination, cell.system, scenes, replicates=count, notes=sum_notes)
        whole = [ShiftedScene(None, 0, one.scene) for one in scenes]
        for one in whole:
            find_boxes(examination, one, [cell.system])
        clean = score_scenes(examination, cell.system, whole, replicates=count, notes=lambda notes: {})
        before = clean["metrics"]["mAP"]
        drop = round(1.0 - found["metrics"]["mAP"] / before, 6) if before > 0 else None
        return {**found, "metrics": {**found["metrics"], "drop": drop}, "clean_mAP": before}

    def sheet(self, examination: Examination, suite: DigitalSuite) -> tuple[Callable[[], U8], str]:
        """One moment under the attacks of the table."""
        specs = list(dict.fromkeys(_spec(suite, one, one.radius, one.steps) for one in suite.attacks))
        caption = (
            f"What {examination.detectors[0][0]} is shown (left), what was changed (middle, magnified so that the "
            "largest change is black or white), what it finds (orange, score at least 0.3) and what is there (white)."
        )
        return lambda: attack_sheet(examination, suite.split, specs), caption


def _spec(suite: DigitalSuite, method: Method, radius: float | None, steps: int | None) -> AttackSpec:
    """An attack with all its settings; it is built, to see whether it takes them. ConfigError."""
    options = dict(method.options)
    if steps is not None or takes(method.name, "steps"):
        options.setdefault("steps", suite.steps if steps is None else steps)
    loss = method.loss or default_loss(method.name)
    make_objective(loss)
    norm: Norm = method.norm
    size = suite.radius if radius is None else radius
    if not size > 0:
        raise ConfigError(
            f"suite {suite.name}: attack {method.name}: the radius must be above 0; clean data always run"
        )
    try:
        safeio.dump_json(options)
        hash(spec := AttackSpec(method.name, loss, norm, float(size), tuple(sorted(options.items()))))
    except (TypeError, ValueError):
        raise ConfigError(
            f"suite {suite.name}: attack {method.name}: options are numbers and words, not {options}"
        ) from None
    spec.make()
    return spec


def _swept(suite: DigitalSuite) -> list[AttackSpec]:
    """The points of the curves; a radius of 0 is the clean data. ConfigError."""
    found = []
    for one in suite.sweeps:
        if not one.radii and not one.steps:
            raise ConfigError(f"suite {suite.name}: sweeps: {one.name} has neither radii nor steps")
        found += [_spec(suite, one, radius, None) for radius in one.radii if radius > 0]
        found += [_spec(suite, one, None, steps) for steps in one.steps]
    return found


def _with_noise(specs: Sequence[AttackSpec]) -> list[AttackSpec]:
    """Specs without doubles, noise of each size before them."""
    sizes = dict.fromkeys((spec.norm, spec.radius) for spec in specs)
    noise = [AttackSpec("noise", default_loss("noise"), norm, radius) for norm, radius in sizes]
    return list(dict.fromkeys([*noise, *specs]))


def _fields(spec: AttackSpec | None) -> dict[str, Any]:
    """Columns of a record that tell its attack."""
    if spec is None:
        return {"attack": None, "loss": None, "norm": None, "radius": 0.0, "steps": 0, "options": ""}
    others = [(key, value) for key, value in spec.options if key != "steps"]
    return {
        "attack": spec.attack, "loss": spec.loss if spec.attack != "noise" else None, "norm": spec.norm,
        "radius": spec.radius, "steps": spec.steps, "options": " ".join(f"{key}={value}" for key, value in others),
    }  # fmt: skip


def _told(spec: AttackSpec) -> dict[str, Any]:
    """A spec as plain data."""
    return {
        "attack": spec.attack, "loss": spec.loss, "norm": spec.norm, "radius": spec.radius,
        "options": [list(pair) for pair in spec.options],
    }  # fmt: skip


def _told_spec(data: Mapping[str, Any]) -> AttackSpec:
    """The spec from plain data."""
    options = tuple((str(key), value) for key, value in data["options"])
    return AttackSpec(data["attack"], data["loss"], data["norm"], data["radius"], options)
