"""A scene whose camera images a digital attack has changed, each by itself, and what the attack took.

The pictures are made against one system, the source, and may be shown to others as well: to other detectors (transfer),
or to the same detector behind a defence that the attack does not know.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Self, TypeVar

import numpy as np
import torch
from torch import Tensor

from ssad.core.detections import Truth
from ssad.core.errors import ConfigError
from ssad.core.images import read_image
from ssad.core.nuscenes_names import MMDET3D_CLASSES
from ssad.core.types import U8
from ssad.datasets.nuscenes.camera_truth import camera_truth
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.scene import SceneData, SensorFrame
from ssad.detectors.on_scenes import AT_ONCE, to_images
from ssad.experiments.perception.digital.attack_tally import Tally
from ssad.experiments.perception.digital.chosen_object import chosen_first
from ssad.experiments.perception.digital.saved_images import FOLDER, SavedPictures
from ssad.experiments.perception.scene_boxes import Examination, Shown, Watched, file_name, system_of
from ssad.scenarios.static.digital import (
    ATTACKS,
    Aim,
    Attack,
    Budget,
    make_attack,
    make_objective,
    px,
    run_attack,
)
from ssad.scenarios.static.digital.budget import LEVELS, Norm
from ssad.scenarios.static.digital.defences import RandomResize
from ssad.scenarios.static.digital.expectation import Expected
from ssad.scenarios.static.digital.gradient_check import check_gradient
from ssad.scenarios.static.digital.transfer import translate
from ssad.scenarios.static.digital.universal import UniversalFit
from ssad.scenarios.static.digital.victim import NothingToAttackError, Precision, Victim, steady

CAMERAS = 6  # of a sample, as nuScenes has them
_INSPECTED: dict[tuple[Any, ...], tuple[float | None, float | None]] = {}  # of this process


@dataclass(frozen=True, slots=True)
class AttackSpec:
    """An attack with all its settings.

    Attributes:
        attack: name (`ssad list attacks`).
        loss: what it ascends.
        norm: of the budget.
        radius: of the budget, in 8-bit code values.
        options: further settings of the attack, such as ("steps", 10), in order of their names.
        classes: names of the classes that are attacked; empty: all.
        becomes: (class, class that its objects should be taken for); empty: any other.
        draws: of a random defence that the attack knows, over which it ascends the mean loss; 0: it knows none.
        object: which object of each moment is attacked (see `chosen_object`); "": all.
        precision: of the gradients.
    """

    attack: str
    loss: str
    norm: Norm
    radius: float
    options: tuple[tuple[str, Any], ...] = ()
    classes: tuple[str, ...] = ()
    becomes: tuple[tuple[str, str], ...] = ()
    draws: int = 0
    object: str = ""
    precision: Precision = "float32"

    @classmethod
    def of_row(cls, row: Mapping[str, Any]) -> Self:
        """From what `row` gave, with further keys perhaps, where JSON has made lists of tuples."""
        told = {name: row[name] for name in cls.__slots__}
        pairs = {name: tuple((key, value) for key, value in told[name]) for name in ("options", "becomes")}
        return cls(**{**told, **pairs, "classes": tuple(told["classes"])})

    @property
    def row(self) -> dict[str, Any]:
        """Plain data."""
        return asdict(self)

    @property
    def name(self) -> str:
        """Such as "pgd-full-linf-5-steps10"; tells specs apart and can be a file's name."""
        parts = [
            self.attack,
            self.loss,
            self.norm,
            f"{self.radius:g}",
            *(f"{key}{value}" for key, value in self.options),
            *self.classes,
            *(f"{one}-to-{other}" for one, other in self.becomes),
            *([f"draws{self.draws}"] if self.draws else []),
            *([f"object-{self.object}"] if self.object else []),
            *([self.precision] if self.precision != "float32" else []),
        ]
        return file_name("-".join(parts))

    @property
    def steps(self) -> int:
        """Steps of gradient ascent: those it was told, 1 if it is white-box and takes no steps, else 0."""
        told = dict(self.options).get("steps")
        return int(told) if told is not None else int(self.make().access == "white-box")

    @property
    def aim(self) -> Aim:
        """Which objects are attacked, and what they should become."""
        return Aim(self.classes or None, (0,) if self.object else None, dict(self.becomes))

    @property
    def wanted(self) -> tuple[str, ...]:
        """Names of the classes whose objects are attacked; empty: all."""
        return tuple(one for one, _ in self.becomes) or self.classes

    @property
    def target(self) -> str:
        """Which objects are attacked and what they should become, in words: "nearest car", "car to bus"; "": all."""
        changes = [f"{one} to {other}" for one, other in self.becomes]
        return " ".join(filter(None, [self.object, ", ".join(changes or self.classes)]))

    @property
    def passes(self) -> int:
        """Forward and backward passes that an image takes."""
        restarts = int(dict(self.options).get("restarts", 0))
        return self.steps * (1 + restarts) * max(self.draws, 1) if self.make().access == "white-box" else 0

    def passes_in(self, images: int) -> int:
        """Forward and backward passes that all images of a scene take."""
        made = self.make()
        return made.passes if isinstance(made, UniversalFit) else self.passes * images

    def make(self) -> Attack:
        """The attack.

        Raises:
            UnknownNameError: there is no such attack.
            ConfigError: it refuses a setting.
        """
        found: Attack = make_attack(self.attack, **dict(self.options))
        return found


def takes(attack: str, option: str) -> bool:
    """Whether an attack of our own has an option.

    Args:
        attack: name.
        option: name of a setting, such as "steps".

    Raises:
        UnknownNameError: there is no such attack.
    """
    from ssad.core.registry import resolve

    build = resolve("attack", ATTACKS, attack)
    return callable(build) and option in inspect.signature(build).parameters


@dataclass(frozen=True, slots=True)
class AttackedScene:
    """One scene under one attack on one system; see `ssad.experiments.perception.scene_boxes.Condition`.

    Attributes:
        spec: the attack.
        scene: name of the scene.
        batch: camera images at once on a GPU; on the CPU it is one.
        source: name of the system that is attacked.
    """

    spec: AttackSpec
    scene: str
    batch: int = 12
    source: str = ""

    @property
    def name(self) -> str:
        """See `Condition`."""
        return f"{self.spec.name}{f'@{file_name(self.source)}' if self.source else ''}/{self.scene}"

    def shown(self, examination: Examination, data: NuScenes, detectors: Sequence[Watched]) -> Shown:
        """See `Condition`: all systems are shown the same pictures, which are made once, against the source.

        A missing or wrong gradient of the source is recorded, with its reason, as a failure of all cells that need the
        pictures.
        """
        source = next((one for one in detectors if one.name == self.source), None)
        if source is None:
            source = Watched(system_of(examination, self.source), self.source)
        saved = SavedPictures(examination.folder / FOLDER / self.name) if examination.device == "cpu" else None
        attacker = SceneAttacker(self, examination, data.scene(self.scene), source, saved)

        def look(frames: Sequence[SensorFrame]) -> list[U8]:
            pictures = attacker.look(frames)
            for one in detectors:
                if source.reason and one is not source and not one.reason:
                    one.reason = f"the attack on {self.source} failed: {source.reason}"
            return pictures

        # enough pictures at once to fill a batch, of one sample's cameras or of several
        at_once = max(AT_ONCE, math.ceil(self.batch / CAMERAS))
        return Shown(look, attacker.tally.notes, ahead=False, at_once=at_once, done=saved.forget if saved else _nothing)


@dataclass(slots=True)
class SceneAttacker:
    """Attacks the camera images of a scene, against one detector.

    An image's random numbers come from the seed of the suite and its own token, so the result depends on no other
    image.

    Attributes:
        view: The scene and its attack.
        examination: Data, device, seed.
        scene: The data.
        watched: The attacked system; what it raises is kept there.
        saved: Where pictures are kept until the scene is finished; None: nowhere.
        attack: The attack with its settings.
        tally: What was done.
        batch: Images at once; it shrinks when memory does not suffice.
    """

    view: AttackedScene
    examination: Examination
    scene: SceneData
    watched: Watched
    saved: SavedPictures | None = None
    attack: Attack = field(init=False)
    tally: Tally = field(init=False)
    batch: int = field(init=False)

    def __post_init__(self) -> None:
        self.attack = self.view.spec.make()
        defence = getattr(self.watched.detector, "defence", None)
        if self.view.spec.draws and isinstance(defence, RandomResize):
            self.attack = Expected(self.attack, defence, self.view.spec.draws)
        self.tally = Tally(self.attack.access)
        self.batch = 1 if self.examination.device == "cpu" else self.view.batch

    def look(self, frames: Sequence[SensorFrame]) -> list[U8]:
        """Attacked pictures of camera frames; the clean ones once the detector has failed.

        Raises:
            FormatError: a picture cannot be read.
        """
        pictures = [self._read(frame) for frame in frames]
        if self.watched.reason or not frames:
            return pictures
        try:
            if not self.tally.images:
                self._inspect()
                self._fit()
            for size in sorted({picture.shape[:2] for picture in pictures}):
                rows = [k for k, picture in enumerate(pictures) if picture.shape[:2] == size]
                for k, image in zip(
                    rows, self._all([frames[k] for k in rows], [pictures[k] for k in rows]), strict=True
                ):
                    pictures[k] = image
        except Exception as error:  # whatever a stranger's detector raises
            self.watched.failed(error)
        return pictures

    def _read(self, frame: SensorFrame) -> U8:
        return read_image(self.examination.root / frame.filename)

    def _truth(self, frame: SensorFrame, scene: SceneData | None = None) -> Truth:
        """What is in a frame, with the labels of the attacked detector; objects that it does not know are left out.

        Where one object is attacked it comes first; a frame without it is empty.
        """
        scene, spec = scene or self.scene, self.view.spec
        found = scene.annotations(frame.sample_token)
        if spec.object:
            found = chosen_first(scene, frame, spec.object, spec.wanted)
        truth, kept = translate(camera_truth(frame, found), MMDET3D_CLASSES, self.watched.classes)
        if spec.object and kept[:1] != (0,):  # the detector does not know the class of the chosen one
            truth = camera_truth(frame, found.take(np.arange(0)))
        return truth

    def _all(self, frames: Sequence[SensorFrame], pictures: Sequence[U8]) -> list[U8]:
        """Pictures of one size, in batches; smaller ones from where memory does not suffice."""
        found: list[U8] = []
        while len(found) < len(frames):
            part = slice(len(found), len(found) + self.batch)
            try:
                found += self._some(frames[part], pictures[part])
                continue
            except torch.OutOfMemoryError:
                count = len(frames[part])
                if count == 1:
                    raise
            self._halve(count)
        return found

    def _halve(self, count: int) -> None:
        """Fewer images at once from now on, which the record says."""
        torch.cuda.empty_cache()
        self.batch = count // 2
        self.tally.halved += 1

    def _some(self, frames: Sequence[SensorFrame], pictures: Sequence[U8]) -> list[U8]:
        """One batch."""
        saved = self.saved if len(frames) == 1 and self.attack.access != "none" else None
        if saved and (kept := saved.read(frames[0].token)):
            self.tally.absorb(kept[1])
            return [kept[0]]
        spec = self.view.spec
        budget = Budget(px(spec.radius), spec.norm)
        images, lens = self._tensors(frames, pictures)
        truth = [self._truth(frame) for frame in frames]
        active = self._attackable(images, lens, truth)
        out = list(pictures)
        self.tally.images += len(frames) - len(active)
        self.tally.idle += len(frames) - len(active)
        if not active:
            return out
        own = images[active]
        found = run_attack(
            self.attack,
            self.watched.detector,
            own,
            [truth[k] for k in active],
            budget,
            objective=spec.loss,
            aim=spec.aim,
            intrinsic=lens[active],
            check=False,
            precision=spec.precision,
            keys=[(self.examination.seed, frames[k].token) for k in active],
        )
        taken = Tally(self.attack.access)
        taken.add(found, own, budget)
        self.tally.absorb(taken.notes())
        codes = (found.images * LEVELS).round().to(torch.uint8).permute(0, 2, 3, 1).cpu().numpy()
        for k, picture in zip(active, codes, strict=True):
            out[k] = np.ascontiguousarray(picture)
        if saved:
            saved.write(frames[0].token, out[0], taken.notes())
        return out

    def _tensors(self, frames: Sequence[SensorFrame], pictures: Sequence[U8]) -> tuple[Tensor, Tensor]:
        """Images [B, 3, H, W] and intrinsics [B, 3, 3] on the device."""
        device = self.examination.device
        lens = np.stack([np.asarray(frame.intrinsic, np.float32) for frame in frames])
        return to_images(pictures, device), torch.from_numpy(lens).to(device)

    def _attackable(self, images: Tensor, lens: Tensor, truth: Sequence[Truth]) -> list[int]:
        """Images in which there is something to attack, for this loss: in any batch the same."""
        aim = self.view.spec.aim
        if not make_objective(self.view.spec.loss).needs_objects and aim.everything:
            return list(range(len(images)))
        detector: Any = self.watched.detector
        with steady(detector), torch.no_grad():
            places = aim.places(detector, detector.assign(detector.dense(images, lens), truth))
        return [k for k, any_ in enumerate(places.any(1).tolist()) if any_]

    def _inspect(self) -> None:
        """Check the gradient and the batch before the first attack on a scene.

        The gradient of the loss is compared with finite differences, on the image with most objects to attack; the
        coupling is how much this image's loss changes with what else is in the batch. Attacks on the same loss of the
        same system share the results. Pictures for the report's sheet, without a source, are of attacks that were
        checked.
        """
        if self.watched.task == "3d" and self.watched.classes != MMDET3D_CLASSES:
            raise ConfigError(f"{self.watched.detector.name} finds other classes than the ten of nuScenes")
        frames = _key_frames(self.scene)
        if self.attack.access == "none" or not self.view.source:
            return
        own, spec = self.examination, self.view.spec
        asked = (
            str(own.root),
            own.version,
            own.detectors,
            own.device,
            self.view.source,
            self.scene.record.name,
            spec.loss,
            spec.classes,
            spec.becomes,
            spec.object,
            self.attack.access,
        )
        if asked not in _INSPECTED:
            _INSPECTED[asked] = self._inspected(frames)
        self.tally.gradient_error, self.tally.coupling = _INSPECTED[asked]

    def _fit(self) -> None:
        """Find the change of a universal attack, on frames of this drive or of others."""
        while isinstance(self.attack, UniversalFit):
            try:
                self._fit_to(self.attack)
            except torch.OutOfMemoryError:
                if self.batch == 1:
                    raise
                self._halve(self.batch)

    def _fit_to(self, fit: UniversalFit) -> None:
        spec = self.view.spec
        detector, budget = self.watched.detector, Budget(px(spec.radius), spec.norm)
        victims = []
        with steady(detector):
            for frames, scene in self._fitted_to(fit):
                for k in range(0, len(frames), self.batch):
                    some = frames[k : k + self.batch]
                    truth = [self._truth(frame, scene) for frame in some]
                    images, lens = self._tensors(some, [self._read(frame) for frame in some])
                    objective = make_objective(spec.loss)
                    try:
                        victim = Victim(
                            detector, images, truth, objective, intrinsic=lens, aim=spec.aim, precision=spec.precision
                        )
                    except NothingToAttackError:
                        continue
                    if self.tally.gradient_error is None:
                        self.tally.gradient_error = check_gradient(victim)
                    victims.append(victim)
        self.attack = fit.fit(victims, budget)
        self.tally.gradients += sum(map(len, victims)) * (fit.steps + 1)

    def _fitted_to(self, fit: UniversalFit) -> list[tuple[list[SensorFrame], SceneData]]:
        """Frames spread evenly over this drive, or over others of the data set; ConfigError: there are no others."""
        own = self.scene.record.name
        if fit.over == "drive":
            return [(_spread(_key_frames(self.scene), fit.frames), self.scene)]
        with NuScenes(self.examination.root, self.examination.version) as data:
            names = _spread([one.name for one in data.scenes() if one.name != own], fit.frames)
            if not names:
                raise ConfigError(f"universal: there is no drive besides {own}; use over: drive, or more scenes")
            shares = [fit.frames * (k + 1) // len(names) - fit.frames * k // len(names) for k in range(len(names))]
            scenes = [data.scene(name) for name in names]
        return [(_spread(_key_frames(s), count), s) for s, count in zip(scenes, shares, strict=True)]

    def _inspected(self, frames: Sequence[SensorFrame]) -> tuple[float | None, float | None]:
        """Error of the gradient and coupling; None where there is nothing to look at."""
        names = self.view.spec.wanted or MMDET3D_CLASSES
        known = self.watched.classes
        wanted = torch.tensor([known.index(name) for name in names if name in known])
        counted = sorted(frames, key=lambda frame: -int(torch.isin(self._truth(frame).label, wanted).sum()))
        first = counted[0]
        alike = [f for f in counted[1:] if (f.width, f.height) == (first.width, first.height)][:1]
        if not len(self._truth(first).label):
            return None, None
        chosen = [first, *alike]
        images, lens = self._tensors(chosen, [self._read(frame) for frame in chosen])
        truth = [self._truth(frame) for frame in chosen]
        if 0 not in self._attackable(images[:1], lens[:1], truth[:1]):
            return None, None
        detector: Any = self.watched.detector
        error = coupling = None
        objective = make_objective(self.view.spec.loss)
        with steady(detector):
            aim = self.view.spec.aim
            alone = Victim(detector, images[:1], truth[:1], objective, intrinsic=lens[:1], aim=aim)
            if self.attack.access == "white-box":
                error = check_gradient(alone)
            if alike:
                both = Victim(detector, images, truth, objective, intrinsic=lens, aim=aim)
                own = float(alone.loss(alone.clean)[0])
                other = float(both.loss(both.clean)[0])
                coupling = abs(other - own) / max(abs(own), 1e-6)
        return error, coupling


def _nothing() -> None:
    """What is done where no pictures were saved."""


def _key_frames(scene: SceneData) -> list[SensorFrame]:
    return [frame for frame in scene.frames if frame.modality == "camera" and frame.key_frame]


T = TypeVar("T")


def _spread(values: Sequence[T], count: int) -> list[T]:
    """So many of some values, spread evenly; all if there are fewer."""
    many = min(count, len(values))
    return [values[(2 * k + 1) * len(values) // (2 * many)] for k in range(many)]
