"""Kind `digital`: detectors x digital attacks x losses x budgets x steps over a data set in the nuScenes schema."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ssad.bench.digital_points import (
    ENSEMBLE,
    DigitalSuite,
    Point,
    bystander_points,
    guard_of,
    points_of,
    rows_of,
    system_name,
    transfers_of,
)
from ssad.bench.kind import Cell, Column, Job, Plan, Resources
from ssad.bench.kinds.detection import DetectorKind, data_of, detectors_of
from ssad.core import safeio
from ssad.core.errors import ConfigError
from ssad.core.types import F64, U8
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.scene import SceneData
from ssad.datasets.nuscenes.truth import GroundTruth
from ssad.evaluation.attack_scores import Match, by_distance, target_success, worst_of
from ssad.evaluation.attack_sheet import attack_sheet
from ssad.evaluation.attack_tally import sum_notes
from ssad.evaluation.attacked_scenes import AttackedScene, AttackSpec
from ssad.evaluation.chosen_object import chosen_places
from ssad.evaluation.picture_scores import match_pictures
from ssad.evaluation.scene_boxes import (
    Condition,
    Examination,
    ShiftedScene,
    boxes_path,
    find_boxes,
    picture_truth_of,
    read_scenes,
    score_found,
    score_pictures,
    system_of,
    truth_of,
)
from ssad.scenarios.static.digital.universal import UniversalFit


class Digital(DetectorKind):
    """See the module. A piece is a scene under an attack on one system, shown to all systems that need it."""

    name = "digital"
    suite = DigitalSuite
    columns = (*DetectorKind.columns, Column("drop", "share of the clean mAP that is lost", "", "higher"))
    factors = (
        "detector", "attack", "loss", "norm", "radius", "steps", "options", "source", "defence", "aware",
        "target", "subset",
    )  # fmt: skip

    def plan(self, suite: DigitalSuite, *, device: str = "cpu", check: bool = True) -> Plan:
        """Attacks, defences and detectors are built once, the data set is looked at."""
        points = points_of(suite)
        weights, detectors, tasks = detectors_of(suite, [*suite.detectors, *suite.transfer_detectors], flat=True)
        if suite.transfer_detectors and not suite.transfer:
            raise ConfigError(f"suite {suite.name}: transfer_detectors take part in the transfer, and it is empty")
        main = [text.partition("=")[0] for text in suite.detectors]
        data = data_of(suite)
        cells = []
        for detector in detectors:
            others = [other for other in detectors if other != detector]
            moved = [replace(one, source=other) for one in transfers_of(suite) for other in others]
            for point in [*(points if detector in main else bystander_points(suite)), *moved]:
                system = system_name(detector, point.defence)
                source = point.source or (system if point.aware or not point.defence else detector)
                about = point.specs[0].name if len(point.specs) == 1 else ENSEMBLE if point.specs else "clean"
                title = f"{system}/{about}{f'@{source}' if point.specs and source != system else ''}"
                title += f"/{point.scenes}" if point.scenes else ""
                inputs: list[Any] = [weights[detector], safeio.dump_json(data), device, suite.replicates]
                inputs += [weights[point.source]] if point.source else []
                told = {"attacks": [_told(one) for one in point.specs], "source": source, "scenes": point.scenes}
                fields = {"detector": detector, **_fields(point), "task": tasks[detector]}
                cells.append(self.make_cell(title, system, suite.seed, fields, told, *inputs))
        return Plan(self, suite, device, tuple(cells), {"weights": weights, "data": data}, {}, detectors)

    def prepare(self, plan: Plan, folder: Path, resources: Resources, *, retry: Sequence[Cell] = ()) -> dict[str, Any]:
        """See `DetectorKind`; says how many gradients the suite takes."""
        settings = super().prepare(plan, folder, resources, retry=retry)
        job, images = Job(folder, plan.device, settings), settings["images"]
        passes: dict[str, Any] = {
            f"{one.source}/{one.name}": one.spec.passes_in(images[one.scene])
            for cell in plan.cells for one in self.scenes(cell, job) if isinstance(one, AttackedScene)
        }  # fmt: skip
        count = len(plan.details)
        text = f"{sum(passes.values()):,} forward and backward passes for {count} detector{'s' if count != 1 else ''}"
        resources.console.print(f"{text} in all", highlight=False)
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
        """See `Kind`: the scenes whose boxes are still to be found.

        Clean scenes, which every cell is compared with, are done for all systems at once; so are pictures that are made
        against one system and shown to several.
        """
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
            for guard in dict.fromkeys(guard_of(suite, one) for one in suite.attacks if one.defence) if guard
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
        eye = Eye(examination, cell.system)
        whole = [ShiftedScene(None, 0, one.scene) for one in scenes[: len(scenes) // max(len(specs), 1)]]
        for one in whole:
            find_boxes(examination, one, [cell.system])
        truth = truth_of(examination, [one.scene for one in whole])
        clean, _ = read_scenes(examination, cell.system, whole)
        before = eye.score(clean, truth, replicates=count if not specs else 0)
        if not specs:
            return {**before, "metrics": before["metrics"] | eye.by_distance(clean, truth)}
        parts = [scenes[k : k + len(whole)] for k in range(0, len(scenes), len(whole))]
        found, noted = zip(*(read_scenes(examination, cell.system, part) for part in parts), strict=True)
        told: dict[str, Any] = {}
        boxes = found[0]
        if len(specs) > 1:
            candidates = dict(zip((spec.name for spec in specs), found, strict=True))
            told["worst"], boxes = worst_of(candidates, truth, eye.match(truth))
        after = eye.score(boxes, truth, replicates=count)
        metrics = after["metrics"] | eye.by_distance(boxes, truth)
        clean_score = before["metrics"]["mAP"]
        metrics["drop"] = round(1.0 - metrics["mAP"] / clean_score, 6) if clean_score > 0 else None
        if not specs[0].aim.everything and not eye.flat:
            places = self._places(examination, specs[0], whole)
            metrics |= target_success(clean, boxes, truth, specs[0].wanted, becomes=dict(specs[0].becomes), at=places)
        return {**after, **_noted(noted), **told, "metrics": metrics, "clean_mAP": clean_score}

    def _places(self, examination: Examination, spec: AttackSpec, scenes: Sequence[Condition]) -> dict[str, F64] | None:
        """Where the one object is that is attacked, by sample; None: more than one is. ConfigError: it is nowhere."""
        if not spec.object:
            return None
        with NuScenes(examination.root, examination.version) as data:
            parts = [chosen_places(data.scene(one.scene), spec.object, spec.wanted) for one in scenes]
        found = {token: place for part in parts for token, place in part.items()}
        if not found:
            raise ConfigError(f"object {spec.object}: no moment of these scenes has it; nothing was attacked")
        return found

    def sheet(
        self, examination: Examination, suite: DigitalSuite, cell: Cell | None = None
    ) -> tuple[Callable[[], U8], str]:
        """One moment under the attacks of the table."""
        rows = [one.specs[0] for one in rows_of(suite) if one.row and len(one.specs) == 1]
        if cell is not None:  # against the bare detector, also where the cell's pictures were made against another
            rows = [_told_spec(one) for one in cell.spec["attacks"]]
        specs = [one for one in dict.fromkeys(rows) if not isinstance(one.make(), UniversalFit)]
        caption = (
            f"What {examination.detectors[0][0]} is shown (left), what was changed (middle, magnified so that the "
            "largest change is black or white), what it finds (orange, score at least 0.3) and what is there (white)."
        )
        return lambda: attack_sheet(examination, suite.split, specs), caption


class Eye:
    """How the boxes of a system are scored: in the world those of 3D detectors, in the images those of 2D detectors.

    Attributes:
        flat: Whether it finds 2D boxes.
    """

    def __init__(self, examination: Examination, system: str) -> None:
        self._examination, self._detector = examination, system_of(examination, system)
        self.flat = self._detector.task == "2d"

    def score(self, boxes: Sequence[Any], truth: GroundTruth, *, replicates: int) -> dict[str, Any]:
        """See `score_found` and `score_pictures`."""
        if self.flat:
            return score_pictures(self._examination, self._detector, boxes, truth, replicates=replicates)
        return score_found(self._examination, boxes, truth, replicates=replicates)

    def match(self, truth: GroundTruth) -> Match | None:
        """What `worst_of` compares by."""
        if not self.flat:
            return None
        pictures = picture_truth_of(self._examination, truth)
        return lambda boxes: match_pictures(boxes, pictures, self._detector.classes)

    def by_distance(self, boxes: Sequence[Any], truth: GroundTruth) -> dict[str, float]:
        """See `by_distance`; boxes in images are at no distance."""
        return {} if self.flat else by_distance(boxes, truth)


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
    found = {
        "attack": spec.attack, "loss": spec.loss if spec.attack != "noise" else None, "norm": spec.norm,
        "radius": spec.radius, "steps": spec.steps, "options": _options(spec), "target": spec.target, **about,
    }  # fmt: skip
    if len(point.specs) > 1:
        members = ", ".join(" ".join(filter(None, [one.attack, one.loss, _options(one)])) for one in point.specs)
        found |= {"attack": ENSEMBLE, "loss": None, "steps": 0, "options": f"of {members}"}
    return found


def _options(spec: AttackSpec) -> str:
    others = [(key, value) for key, value in spec.options if key != "steps"]
    others += [("draws", spec.draws)] if spec.draws else []
    others += [("precision", spec.precision)] if spec.precision != "float32" else []
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
        "becomes": [list(pair) for pair in spec.becomes], "draws": spec.draws, "object": spec.object,
        "precision": spec.precision,
    }  # fmt: skip


def _told_spec(data: Mapping[str, Any]) -> AttackSpec:
    """The spec from plain data."""
    options = tuple((str(key), value) for key, value in data["options"])
    becomes = tuple((one, other) for one, other in data["becomes"])
    return AttackSpec(
        data["attack"], data["loss"], data["norm"], data["radius"], options, tuple(data["classes"]), becomes,
        data["draws"], data["object"], data["precision"],
    )  # fmt: skip
