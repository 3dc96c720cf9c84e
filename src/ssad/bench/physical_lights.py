"""Light attacks as cells of the kind `physical`: at an hour, on pictures rendered then, with random settings beside."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor

from ssad.bench.kind import Cell, CellError, Job, Kind, Plan
from ssad.camera.render import Weather
from ssad.camera.scene_edit import NO_EDIT, SceneEdit
from ssad.core.detections import Truth
from ssad.core.errors import ConfigError
from ssad.core.images import save_picture
from ssad.core.protocols import Detector
from ssad.detectors import make_detector
from ssad.evaluation.target_scores import Sighting, sightings, target_scores
from ssad.evaluation.target_sheet import target_sheet
from ssad.recording.lit_clips import LitClip, at_hour, lit_clips
from ssad.recording.target import TargetCar, parse_target
from ssad.recording.target_views import target_truth
from ssad.scenarios.static.physical.noninvasive import LitView, Projector, Target, make_light
from ssad.scenarios.static.physical.noninvasive.kept import LightFolder, LightSpec, budget_of
from ssad.scenarios.static.physical.optimise import View

RANDOM = "random"


class LightEntry(BaseModel):
    """Rows of the table for one light: searched, and with settings drawn at random.

    Attributes:
        name: an attack (`ssad.scenarios.static.physical.noninvasive`).
        hour: noon, low_sun, night, or recorded: as the pictures were.
        options: fields of the attack that differ.
        settings: of its search (`Budget`); of a projector, of `TextureAttack`.
    """

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)

    name: str = Field(min_length=1)
    hour: str = "night"
    options: dict[str, Any] = {}
    settings: dict[str, Any] = {}


def check_lights(suite: Any) -> None:
    """ConfigError, UnknownNameError: an attack, an hour or a setting that does not exist."""
    for entry in suite.lights:
        attack = make_light(entry.name, entry.options)
        at_hour(Weather(), entry.hour)
        try:
            if isinstance(attack, Projector):
                attack.training(**entry.settings)
            else:
                budget_of(entry.settings)
        except (TypeError, ConfigError) as error:
            raise ConfigError(f"suite {suite.name}: {entry.name}: {error}") from None


def light_cells(kind: Kind, suite: Any, weights: Mapping[str, str], device: str) -> Iterator[Cell]:
    """The cells of the lights of a suite: for each hour the clean pictures, then each attack and its controls."""
    check_lights(suite)
    for pair in suite.pairs:
        for detector in suite.detectors:
            rows: list[dict[str, Any]] = [
                {"attack": None, "of": None, "options": {}, "settings": {}, "hour": hour}
                for hour in dict.fromkeys(entry.hour for entry in suite.lights)
            ]
            for entry in suite.lights:
                row = {"attack": entry.name, "of": None, "options": entry.options, "settings": entry.settings}
                rows.append(row | {"hour": entry.hour})
                rows += [
                    {**row, "attack": RANDOM, "of": entry.name, "settings": {}, "hour": entry.hour, "number": number}
                    for number in range(suite.seeds)
                ]
            for row in rows:
                source = detector if row["attack"] not in (None, RANDOM) else ""
                light = {"number": 0, **row, "source": source, "pair": pair.model_dump()}
                name = "clean" if row["attack"] is None else f"{RANDOM} {row['of']}" if row["of"] else row["attack"]
                fields = {
                    "test": pair.test, "train": pair.train, "view": "drive", "detector": detector,
                    "carrier": f"light, {row['hour']}",
                    "attack": name, "source": source, "number": light["number"],
                }  # fmt: skip
                title = "/".join([detector, pair.test, name, row["hour"], _brief(row["options"]), str(light["number"])])
                inputs = suite.target, suite.behind, suite.size, suite.floor, suite.replicates, device
                spec = {"attack": None, "light": light}
                yield kind.make_cell(title, detector, suite.seed, fields, spec, *inputs, weights[detector])


def _brief(options: Mapping[str, Any]) -> str:
    return ",".join(f"{key}={value}" for key, value in options.items()) or "as it is"


def light_pieces(cell: Cell, job: Job) -> Mapping[str, Any]:
    """The search of a cell's light, unless it is done."""
    light = cell.spec["light"]
    if not light["source"] or _lights(job).kept(LightSpec.of_row(light)).is_file():
        return {}
    return {f"light {LightSpec.of_row(light).name}": dict(cell.spec)}


def light_edit(job: Job, light: Mapping[str, Any]) -> SceneEdit:
    """A light of a run as an edit of a scene; searched now if it has to be."""
    if light["attack"] is None:
        return NO_EDIT
    spec = LightSpec.of_row(light)
    car = parse_target(job.settings["target"])
    assert isinstance(car, TargetCar)
    town, count = spec.pair["train"], spec.pair["train_images"]

    def clips() -> Sequence[LitClip]:
        return _clips(_Pictures(job.folder / "data" / town, spec.hour, count, job.device))

    def truth_of(clip: LitClip) -> Truth:
        return target_truth(clip.clip.row, clip.clip.objects, detector().classes)

    def projected(edit: SceneEdit) -> list[View]:
        found = []
        for clip in clips():
            seen = clip.projected(edit)
            size = edit.textures[0].shape[1], edit.textures[0].shape[2]
            found.append(View(seen.prepare({0: size}, device=job.device), truth_of(clip)))
        return found

    def views() -> list[LitView]:
        return [LitView(clip.lit(job.device), truth_of(clip)) for clip in clips()]

    def detector() -> Detector:
        made: Detector = make_detector(spec.source, device=job.device)
        return made

    return _lights(job).edit(spec, Target(*car.full_size), views=views, projected=projected, detector=detector)


def light_result(cell: Cell, job: Job) -> dict[str, Any]:
    """Scores of a cell in the town of the test.

    Raises:
        CellError: The detector does not find the clean car at this hour.
    """
    light, settings = cell.spec["light"], job.settings
    pair, hour = light["pair"], light["hour"]
    pictures = _Pictures(job.folder / "data" / pair["test"], hour, pair["test_images"], job.device)
    clean = _clean_sightings(pictures, cell.system)
    before = target_scores(clean, replicates=settings["replicates"], seed=settings["seed"])
    if light["attack"] is None:
        return before
    floor, have = settings["floor"], before["metrics"]["AP50"] or 0.0
    if have < floor:
        raise CellError(
            f"{cell.system} finds the clean car ({hour}) with AP50 {have:.3f}, less than the floor of {floor:g}"
        )
    detector = make_detector(cell.system, device=job.device)
    found = list(sightings(detector, pictures.under(light_edit(job, light), detector)))
    own = target_scores(found, clean, replicates=settings["replicates"], seed=settings["seed"])
    kept, spec = _lights(job), LightSpec.of_row(light)
    path = kept.picture(spec) if kept.picture(spec).is_file() else kept.kept(spec)
    return {
        **own, "clean_AP50": have, "artefacts": {"light": str(path.relative_to(job.folder))}, **kept.history(spec),
    }  # fmt: skip


def light_sheet(plan: Plan, folder: Path) -> dict[str, str]:
    """One picture of the first test town under each light: DIR/pictures/lights.jpg; file name -> caption."""
    suite = plan.suite
    job = Job(folder, plan.device, {"target": suite.target, "seed": suite.seed})
    path, name, pair = folder / "pictures" / "lights.jpg", suite.detectors[0], suite.pairs[0]
    chosen: dict[str, Mapping[str, Any]] = {}
    for cell in plan.cells:
        light = cell.spec.get("light")
        if light and cell.system == name and light["pair"] == pair.model_dump() and light["number"] == 0:
            if light["attack"] is not None and not _lights(job).kept(LightSpec.of_row(light)).is_file():
                continue
            chosen.setdefault(f"{cell.fields['attack']}, {light['hour']} {_brief(light['options'])}", light)
    data = folder / "data" / pair.test
    if chosen and not path.is_file() and (data / "annotations").is_dir():
        shown, detector = [], make_detector(name, device=plan.device)
        for title, light in chosen.items():
            pictures = _Pictures(data, light["hour"], 1, plan.device)
            ((_, image, truth),) = pictures.under(light_edit(job, light), detector)
            shown.append((title, image))
        save_picture(path, target_sheet(detector, shown, truth.box[0].tolist(), plan.device))
    if not path.is_file():
        return {}
    return {path.name: f"What {name} finds (orange, score at least 0.25) in a picture of {pair.test} under each light."}


def _lights(job: Job) -> LightFolder:
    return LightFolder(job.folder / "lights", job.settings["seed"], job.device)


@dataclass(frozen=True, slots=True)
class _Pictures:
    """The first pictures of a recording at an hour.

    Attributes:
        folder: What `record_clips` wrote.
        hour: See `ssad.recording.lit_clips.HOURS`.
        count: Number of pictures.
        device: Where they are rendered and shown.
    """

    folder: Path
    hour: str
    count: int
    device: str

    def under(self, edit: SceneEdit, detector: Detector) -> Iterator[tuple[str, Tensor, Truth]]:
        """Drive, picture [1, 3, H, W] in 0 to 1 and truth, with an edit around the target."""
        for clip in _clips(self):
            truth = target_truth(clip.clip.row, clip.clip.objects, detector.classes)
            image = torch.from_numpy(clip.render(edit)).to(self.device).permute(2, 0, 1)[None].float() / 255
            yield f"{clip.clip.row['part']}/{clip.clip.row['attempt']}", image, truth


@lru_cache(maxsize=4)
def _clips(pictures: _Pictures) -> tuple[LitClip, ...]:
    """Kept, since their scenes take longer to make than their pictures."""
    return tuple(lit_clips(pictures.folder, pictures.hour, count=pictures.count, device=pictures.device))


@lru_cache(maxsize=16)
def _clean_sightings(pictures: _Pictures, detector: str) -> tuple[Sighting, ...]:
    """What a detector finds without an attack; kept, since every cell needs it."""
    made = make_detector(detector, device=pictures.device)
    return tuple(sightings(made, pictures.under(NO_EDIT, made)))
