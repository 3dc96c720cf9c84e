"""Kind `digital`: 3D detectors x digital attacks x losses x budgets x steps over a data set in the nuScenes schema."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

from ssad.bench.kind import Cell, Column, Job, Plan, Resources
from ssad.bench.kinds.detection import DetectorKind, DetectorSuite, data_of, detectors_of
from ssad.core import safeio
from ssad.core.errors import ConfigError, unknown_name
from ssad.core.nuscenes_names import MMDET3D_CLASSES
from ssad.core.types import U8
from ssad.datasets.nuscenes.scene import SceneData
from ssad.evaluation.attack_scores import by_distance, target_success, worst_of
from ssad.evaluation.attack_sheet import attack_sheet
from ssad.evaluation.attacked_scenes import AttackedScene, AttackSpec, sum_notes, takes
from ssad.evaluation.scene_boxes import (
    Condition,
    Examination,
    ShiftedScene,
    boxes_path,
    find_boxes,
    read_scenes,
    score_found,
    truth_of,
)
from ssad.scenarios.static.digital import default_loss, make_objective
from ssad.scenarios.static.digital.budget import Norm
from ssad.scenarios.static.digital.defences import make_defence

Radius = Annotated[float, Field(ge=0.0, le=255.0 * 4000, allow_inf_nan=False)]
Steps = Annotated[int, Field(ge=1)]
Scenes = Annotated[int, Field(ge=1)]
ENSEMBLE = "ensemble"
DRAWS = 4  # of a random defence that an attack knows, if the suite does not say it


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


class Row(Method):
    """An attack with its settings: radius (8-bit code values) and steps, where they are not the suite's; scenes: the
    first of each town, where it does not run on all."""

    radius: Radius | None = None
    steps: Steps | None = None
    scenes: Scenes | None = None


class Guard(BaseModel):
    """A defence before the detector: its name (jpeg, bits, blur, resize) and further settings."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)

    name: str = Field(min_length=1)
    options: dict[str, Any] = {}


class Entry(Row):
    """A row of a table.

    Attributes:
        defence: what stands before the detector; the clean data are scored behind it as well.
        aware: whether the attack knows the defence; it then ascends the loss through it, of a random one the mean over
            `draws` draws (default: 4). An attack that does not know it is made against the bare detector.
        draws: see `aware`.
        classes: the classes whose objects are attacked; empty: all.
        becomes: class -> class that its objects should be taken for.
        members: of the attack `ensemble`: the attacks of which the worst is kept at each moment.
    """

    defence: Guard | None = None
    aware: bool | None = None
    draws: Steps | None = None
    classes: list[str] = []
    becomes: dict[str, str] = {}
    members: list[Row] = []

    @field_validator("defence", "members", mode="before")
    @classmethod
    def _named(cls, value: Any) -> Any:
        """A name alone has nothing else said."""
        return {"name": value} if isinstance(value, str) else named(value)


class Sweep(Method):
    """A curve: an attack over radii at the suite's steps, and over steps at the suite's radius; scenes as in `Row`."""

    radii: list[Radius] = []
    steps: list[Steps] = []
    scenes: Scenes | None = None


def named(value: Any) -> Any:
    """Names in a list of attacks as attacks with nothing else said."""
    return [{"name": one} if isinstance(one, str) else one for one in value] if isinstance(value, list) else value


class DigitalSuite(DetectorSuite):
    """One table: 3D detectors x digital attacks, beside the clean data and random noise of the same size.

    Attributes:
        attacks: names, or mappings with the keys of `Entry`.
        sweeps: curves.
        transfer: attacks whose pictures, made against each detector, are shown to every other.
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
    transfer: list[Row] = Field(default=[])
    radius: Radius = Field(default=5.0, gt=0.0)
    steps: Steps = 10
    batch: int = Field(default=12, ge=1)

    @field_validator("attacks", "sweeps", "transfer", mode="before")
    @classmethod
    def _named(cls, value: Any) -> Any:
        """A name alone is an attack with nothing else said."""
        return named(value)


@dataclass(frozen=True)
class Guarded:
    """A defence with its settings: name, and options in order of their names."""

    name: str
    options: tuple[tuple[str, Any], ...] = ()

    @property
    def text(self) -> str:
        """Such as "jpeg quality=50"."""
        return " ".join([self.name, *(f"{key}={value}" for key, value in self.options)])


@dataclass(frozen=True)
class Point:
    """What a system is shown: the clean data, or attacks (several: the worst of them at each moment).

    Attributes:
        specs: the attacks; none: clean data.
        defence: before the detector.
        aware: whether the attacks know it.
        source: detector that is attacked, if it is not the one that is shown the pictures.
        scenes: the first of each town; 0: all.
        row: whether it stands in the main table.
    """

    specs: tuple[AttackSpec, ...] = ()
    defence: Guarded | None = None
    aware: bool = False
    source: str = ""
    scenes: int = 0
    row: bool = field(default=False, compare=False)


class Digital(DetectorKind):
    """See the module. An attack on a detector is of use for this detector alone: a piece is a scene under an attack on
    one detector."""

    name = "digital"
    suite = DigitalSuite
    columns = (*DetectorKind.columns, Column("drop", "share of the clean mAP that is lost", "", "higher"))
    factors = (
        "detector", "attack", "loss", "norm", "radius", "steps", "options", "source", "defence", "aware",
        "target", "subset",
    )  # fmt: skip

    def plan(self, suite: DigitalSuite, *, device: str = "cpu", check: bool = True) -> Plan:
        """Attacks, defences and detectors are built once, the data set is looked at."""
        points = _points(suite)
        weights, detectors = detectors_of(suite)
        data = data_of(suite)
        cells = []
        for detector in detectors:
            moved = [replace(one, source=other) for one in _moved(suite) for other in detectors if other != detector]
            for point in [*points, *moved]:
                system = system_name(detector, point.defence)
                source = point.source or (system if point.aware or not point.defence else detector)
                about = point.specs[0].name if len(point.specs) == 1 else ENSEMBLE if point.specs else "clean"
                title = f"{system}/{about}{f'@{source}' if point.specs and source != system else ''}"
                title += f"/{point.scenes}" if point.scenes else ""
                inputs: list[Any] = [weights[detector], safeio.dump_json(data), device, suite.replicates]
                inputs += [weights[point.source]] if point.source else []
                told = {"attacks": [_told(one) for one in point.specs], "source": source, "scenes": point.scenes}
                fields = {"detector": detector, **_fields(point)}
                cells.append(self.make_cell(title, system, suite.seed, fields, told, *inputs))
        return Plan(self, suite, device, tuple(cells), {"weights": weights, "data": data}, {}, detectors)

    def prepare(self, plan: Plan, folder: Path, resources: Resources, *, retry: Sequence[Cell] = ()) -> dict[str, Any]:
        """See `DetectorKind`; says how many gradients the suite takes."""
        settings = super().prepare(plan, folder, resources, retry=retry)
        job, images = Job(folder, plan.device, settings), settings["images"]
        passes: dict[str, Any] = {
            f"{one.source}/{one.name}": one.spec.passes * images[one.scene]
            for cell in plan.cells for one in self.scenes(cell, job) if isinstance(one, AttackedScene)
        }  # fmt: skip
        resources.console.print(
            f"{sum(passes.values()):,} forward and backward passes for {len(plan.details)} detectors at most",
            highlight=False,
        )
        return settings

    def order(self, cell: Cell) -> float:
        """Clean first, then the rows of the table, then the curves."""
        return 0 if not cell.spec["attacks"] else 1 if cell.fields["row"] else 2

    def scenes(self, cell: Cell, job: Job) -> list[Condition]:
        """See `DetectorKind`; of an ensemble those of one member after another."""
        towns: dict[str, list[str]] = {}
        for scene in job.settings["scenes"]:
            towns.setdefault(job.settings["towns"][scene], []).append(scene)
        kept = {scene for own in towns.values() for scene in own[: cell.spec["scenes"] or None]}
        scenes = [scene for scene in job.settings["scenes"] if scene in kept]
        if not cell.spec["attacks"]:
            return [ShiftedScene(None, 0, scene) for scene in scenes]
        batch, source = job.settings["batch"], cell.spec["source"]
        specs = [_told_spec(one) for one in cell.spec["attacks"]]
        return [AttackedScene(spec, scene, batch, source) for spec in specs for scene in scenes]

    def pieces(self, cell: Cell, job: Job) -> Mapping[str, Any]:
        """Scenes whose boxes are still to be found; clean ones, which every cell is compared with, for all systems at
        once, and so are pictures that are made against one system and shown to several."""
        found: dict[str, Any] = {}
        for one in self.scenes(cell, job):
            clean = ShiftedScene(None, 0, one.scene)
            if not boxes_path(job.folder, cell.system, clean).is_file():
                found[clean.name] = {"scene": one.scene}
            if isinstance(one, AttackedScene) and not boxes_path(job.folder, cell.system, one).is_file():
                told = {"scene": one.scene, "batch": one.batch, "source": one.source, **_told(one.spec)}
                found[f"{one.source}/{one.name}"] = told
        return found

    def condition(self, data: Any) -> Condition:
        """See `DetectorKind`."""
        if "attack" not in data:
            return ShiftedScene(None, 0, data["scene"])
        return AttackedScene(_told_spec(data), data["scene"], data["batch"], data["source"])

    def settings(self, suite: DigitalSuite) -> dict[str, Any]:
        """See `DetectorKind`."""
        defended = {
            system_name(detector, guard): [detector, guard.name, dict(guard.options)]
            for detector in (text.partition("=")[0] for text in suite.detectors)
            for guard in dict.fromkeys(_guard(suite, one) for one in suite.attacks if one.defence) if guard
        }  # fmt: skip
        return {"batch": suite.batch, "defended": defended}

    def about(self, scenes: Mapping[str, SceneData]) -> dict[str, Any]:
        """Towns, and numbers of camera images."""
        return {
            "towns": {name: scene.log.location if scene.log else "" for name, scene in scenes.items()},
            "images": {
                name: sum(frame.modality == "camera" and frame.key_frame for frame in scene.frames)
                for name, scene in scenes.items()
            },
        }

    def score(self, examination: Examination, cell: Cell, scenes: Sequence[Condition], job: Job) -> dict[str, Any]:
        """Metrics, what the attack took, and which share of the system's clean mAP it took away."""
        count, specs = job.settings["replicates"], [_told_spec(one) for one in cell.spec["attacks"]]
        whole = [ShiftedScene(None, 0, one.scene) for one in scenes[: len(scenes) // max(len(specs), 1)]]
        for one in whole:
            find_boxes(examination, one, [cell.system])
        truth = truth_of(examination, [one.scene for one in whole])
        clean, _ = read_scenes(examination, cell.system, whole)
        before = score_found(examination, clean, truth, replicates=count if not specs else 0)
        if not specs:
            return {**before, "metrics": before["metrics"] | by_distance(clean, truth)}
        parts = [scenes[k : k + len(whole)] for k in range(0, len(scenes), len(whole))]
        found, noted = zip(*(read_scenes(examination, cell.system, part) for part in parts), strict=True)
        told: dict[str, Any] = {}
        boxes = found[0]
        if len(specs) > 1:
            told["worst"], boxes = worst_of(dict(zip((spec.name for spec in specs), found, strict=True)), truth)
        after = score_found(examination, boxes, truth, replicates=count)
        metrics = after["metrics"] | by_distance(boxes, truth)
        clean_score = before["metrics"]["mAP"]
        metrics["drop"] = round(1.0 - metrics["mAP"] / clean_score, 6) if clean_score > 0 else None
        if specs[0].classes or specs[0].becomes:
            metrics |= target_success(
                clean, boxes, truth, classes=specs[0].classes, becomes=dict(specs[0].becomes)
            )  # fmt: skip
        return {**after, **_noted(noted), **told, "metrics": metrics, "clean_mAP": clean_score}

    def sheet(self, examination: Examination, suite: DigitalSuite) -> tuple[Callable[[], U8], str]:
        """One moment under the attacks of the table."""
        specs = list(dict.fromkeys(one.specs[0] for one in _named_points(suite) if one.row and len(one.specs) == 1))
        caption = (
            f"What {examination.detectors[0][0]} is shown (left), what was changed (middle, magnified so that the "
            "largest change is black or white), what it finds (orange, score at least 0.3) and what is there (white)."
        )
        return lambda: attack_sheet(examination, suite.split, specs), caption


def system_name(detector: str, guard: Guarded | None) -> str:
    """What a detector behind a defence is called."""
    return detector if guard is None else f"{detector}+{guard.text.replace(' ', '-')}"


def _guard(suite: DigitalSuite, entry: Entry) -> Guarded | None:
    """The defence of a row; it is built, to see whether it takes its options. ConfigError."""
    if entry.defence is None:
        if entry.aware:
            raise ConfigError(f"suite {suite.name}: attack {entry.name}: aware of which defence? it names none")
        return None
    make_defence(entry.defence.name, **entry.defence.options)
    found = Guarded(entry.defence.name, tuple(sorted(entry.defence.options.items())))
    if any(not isinstance(value, str | int | float) for _, value in found.options):
        raise ConfigError(f"suite {suite.name}: defence {found.name}: options are numbers and words")
    return found


def _named_points(suite: DigitalSuite) -> list[Point]:
    """The rows of the tables. ConfigError."""
    found = []
    for one in suite.attacks:
        guard = _guard(suite, one)
        if bool(one.members) != (one.name == ENSEMBLE):
            raise ConfigError(f"suite {suite.name}: attack {one.name}: an ensemble has members, no other attack has")
        specs = [_spec(suite, member, member.radius or one.radius, member.steps) for member in one.members]
        if len({(spec.norm, spec.radius) for spec in specs}) > 1:
            raise ConfigError(f"suite {suite.name}: attack {ENSEMBLE}: its members have different budgets")
        if not specs:
            draws = (one.draws or DRAWS) if guard and one.aware and hasattr(make_defence(guard.name), "drawn") else 0
            classes, becomes = tuple(one.classes), tuple(sorted(one.becomes.items()))
            for name in [*classes, *one.becomes, *one.becomes.values()]:
                if name not in MMDET3D_CLASSES:
                    raise unknown_name("class", name, MMDET3D_CLASSES)
            if becomes and (one.loss or default_loss(one.name)) != "mislabel":
                raise ConfigError(f"suite {suite.name}: attack {one.name}: becomes needs loss: mislabel")
            specs = [replace(_spec(suite, one, one.radius, one.steps), classes=classes, becomes=becomes, draws=draws)]
        found.append(
            Point(tuple(specs), guard, bool(one.aware), "", one.scenes or 0, row=guard is None and not one.scenes)
        )
    if len(set(found)) != len(found):
        raise ConfigError(f"suite {suite.name}: attacks: one of them appears twice")
    return found


def _points(suite: DigitalSuite) -> list[Point]:
    """All that every detector is shown, without transfer: the clean data first, then noise, rows and curves, each once;
    clean data on fewer scenes, and behind a defence, where something else is compared with them. ConfigError."""
    rows, curves, moved = _named_points(suite), _swept(suite), _moved(suite)
    bare = [
        replace(one, specs=(replace(one.specs[0], draws=0),), defence=None, aware=False, row=False)
        for one in rows if one.defence
    ]  # fmt: skip
    curves = [*curves, *bare]
    noise = [
        replace(one, specs=(AttackSpec("noise", default_loss("noise"), one.specs[0].norm, one.specs[0].radius),))
        for one in [*rows, *curves, *moved] if one.defence is None
    ]  # fmt: skip
    clean = [Point(scenes=one.scenes, defence=one.defence) for one in [*rows, *curves, *moved]]
    return list(dict.fromkeys([Point(row=True), *clean, *noise, *rows, *curves, *moved]))


def _moved(suite: DigitalSuite) -> list[Point]:
    """The attacks whose pictures are shown to other detectors. ConfigError."""
    return [Point((_spec(suite, one, one.radius, one.steps),), scenes=one.scenes or 0) for one in suite.transfer]


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


def _swept(suite: DigitalSuite) -> list[Point]:
    """The points of the curves; a radius of 0 is the clean data. ConfigError."""
    found = []
    for one in suite.sweeps:
        if not one.radii and not one.steps:
            raise ConfigError(f"suite {suite.name}: sweeps: {one.name} has neither radii nor steps")
        specs = [_spec(suite, one, radius, None) for radius in one.radii if radius > 0]
        specs += [_spec(suite, one, None, steps) for steps in one.steps]
        found += [Point((spec,), scenes=one.scenes or 0) for spec in specs]
    return found


def _fields(point: Point) -> dict[str, Any]:
    """Columns of a record that tell what its system was shown."""
    about = {
        "source": point.source, "defence": point.defence.text if point.defence else "", "aware": point.aware,
        "subset": point.scenes, "row": point.row,
    }  # fmt: skip
    if not point.specs:
        return {"attack": None, "loss": None, "norm": None, "radius": 0.0, "steps": 0, "options": "", "target": "",
                **about}  # fmt: skip
    spec = point.specs[0]
    target = [*spec.classes, *(f"{one} to {other}" for one, other in spec.becomes)]
    found = {
        "attack": spec.attack, "loss": spec.loss if spec.attack != "noise" else None, "norm": spec.norm,
        "radius": spec.radius, "steps": spec.steps, "options": _options(spec), "target": ", ".join(target), **about,
    }  # fmt: skip
    if len(point.specs) > 1:
        members = ", ".join(" ".join(filter(None, [one.attack, one.loss, _options(one)])) for one in point.specs)
        found |= {"attack": ENSEMBLE, "loss": None, "steps": 0, "options": f"of {members}"}
    return found


def _options(spec: AttackSpec) -> str:
    others = [(key, value) for key, value in spec.options if key != "steps"]
    others += [("draws", spec.draws)] if spec.draws else []
    return " ".join(f"{key}={value}" for key, value in others)


def _noted(noted: Sequence[Sequence[Mapping[str, Any]]]) -> dict[str, Any]:
    """What the attack took; of an ensemble what its members took together."""
    parts = [sum_notes(one) for one in noted]
    found = dict(parts[0])
    if len(parts) > 1:
        for name in ("gradients", "queries"):
            found[name] = sum(part[name] or 0.0 for part in parts)
        for name in ("change_px", "gradient_error", "coupling"):
            found[name] = max((part[name] for part in parts if part[name] is not None), default=None)
        found |= dict.fromkeys(("loss_before", "loss_after", "used"))
        found["idle"] = min(part["idle"] for part in parts)
    return found


def _told(spec: AttackSpec) -> dict[str, Any]:
    """A spec as plain data."""
    return {
        "attack": spec.attack, "loss": spec.loss, "norm": spec.norm, "radius": spec.radius,
        "options": [list(pair) for pair in spec.options], "classes": list(spec.classes),
        "becomes": [list(pair) for pair in spec.becomes], "draws": spec.draws,
    }  # fmt: skip


def _told_spec(data: Mapping[str, Any]) -> AttackSpec:
    """The spec from plain data."""
    options = tuple((str(key), value) for key, value in data["options"])
    becomes = tuple((one, other) for one, other in data["becomes"])
    return AttackSpec(
        data["attack"], data["loss"], data["norm"], data["radius"], options, tuple(data["classes"]), becomes,
        data["draws"],
    )  # fmt: skip
