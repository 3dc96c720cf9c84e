"""A scene whose camera images a digital attack has changed, each by itself, and the cost of the attack.

The images are made against one system, the source, and may be shown to others as well: to other detectors
(transfer), or to the same detector behind a defence that the attack does not know.
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
    """Attack with all its settings.

    Attributes:
        attack: name (`ssad list attacks`).
        loss: objective of the ascent.
        norm: of the budget.
        radius: of the budget, in 8-bit code values.
        options: further settings of the attack, such as ("steps", 10), in order of their names.
        classes: names of the attacked classes; empty: all.
        becomes: (class, target class of its objects); empty: any other.
        draws: draws of a random defence that the attack knows, over which it ascends the mean loss; 0: it knows
            none.
        object: attacked object of each moment (see `ssad.experiments.perception.digital.chosen_object`); "": all.
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
        """Rebuild a spec from its `row`, in which JSON has turned tuples into lists; further keys are ignored."""
        values = {name: row[name] for name in cls.__slots__}
        pairs = {name: tuple((key, value) for key, value in values[name]) for name in ("options", "becomes")}
        return cls(**{**values, **pairs, "classes": tuple(values["classes"])})

    @property
    def row(self) -> dict[str, Any]:
        """Plain data."""
        return asdict(self)

    @property
    def name(self) -> str:
        """Such as "pgd-full-linf-5-steps10"; it distinguishes specs and can be a file name."""
        name_parts = [
            self.attack,
            self.loss,
            self.norm,
            f"{self.radius:g}",
            *(f"{key}{value}" for key, value in self.options),
            *self.classes,
            *(f"{source_class}-to-{target_class}" for source_class, target_class in self.becomes),
            *([f"draws{self.draws}"] if self.draws else []),
            *([f"object-{self.object}"] if self.object else []),
            *([self.precision] if self.precision != "float32" else []),
        ]
        return file_name("-".join(name_parts))

    @property
    def steps(self) -> int:
        """Steps of gradient ascent: the option, 1 for a white-box attack without it, else 0."""
        steps_option = dict(self.options).get("steps")
        return int(steps_option) if steps_option is not None else int(self.make().access == "white-box")

    @property
    def aim(self) -> Aim:
        """Attacked objects, and their target classes."""
        return Aim(self.classes or None, (0,) if self.object else None, dict(self.becomes))

    @property
    def wanted(self) -> tuple[str, ...]:
        """Names of the classes whose objects are attacked; empty: all."""
        return tuple(source_class for source_class, _ in self.becomes) or self.classes

    @property
    def target(self) -> str:
        """Attacked objects and their target classes in words: "nearest car", "car to bus"; "": all."""
        changes = [f"{source_class} to {target_class}" for source_class, target_class in self.becomes]
        return " ".join(filter(None, [self.object, ", ".join(changes or self.classes)]))

    @property
    def passes(self) -> int:
        """Forward and backward passes per image."""
        restarts = int(dict(self.options).get("restarts", 0))
        return self.steps * (1 + restarts) * max(self.draws, 1) if self.make().access == "white-box" else 0

    def passes_in(self, images: int) -> int:
        """Return the forward and backward passes for all images of a scene."""
        attack = self.make()
        return attack.passes if isinstance(attack, UniversalFit) else self.passes * images

    def make(self) -> Attack:
        """Build the attack.

        Raises:
            UnknownNameError: unknown attack.
            ConfigError: it refuses a setting.
        """
        attack: Attack = make_attack(self.attack, **dict(self.options))
        return attack


def takes(attack: str, option: str) -> bool:
    """Return True if a built-in attack has an option.

    Args:
        attack: name.
        option: name of a setting, such as "steps".

    Raises:
        UnknownNameError: unknown attack.
    """
    from ssad.core.registry import resolve

    factory = resolve("attack", ATTACKS, attack)
    return callable(factory) and option in inspect.signature(factory).parameters


@dataclass(frozen=True, slots=True)
class AttackedScene:
    """One scene under one attack on one system; see `ssad.experiments.perception.scene_boxes.Condition`.

    Attributes:
        spec: the attack.
        scene: name of the scene.
        batch: camera images at once on a GPU; on the CPU it is one.
        source: name of the attacked system.
    """

    spec: AttackSpec
    scene: str
    batch: int = 12
    source: str = ""

    @property
    def name(self) -> str:
        """Place of the boxes of this attack, source and scene below the folder of a detector."""
        return f"{self.spec.name}{f'@{file_name(self.source)}' if self.source else ''}/{self.scene}"

    def shown(self, examination: Examination, data: NuScenes, detectors: Sequence[Watched]) -> Shown:
        """Return the attacked images: all systems see the same ones, which are made once, against the source.

        A missing or wrong gradient of the source is recorded, with its reason, as a failure of all cells that need
        the images.
        """
        source = next((detector for detector in detectors if detector.name == self.source), None)
        if source is None:
            source = Watched(system_of(examination, self.source), self.source)
        saved_pictures = SavedPictures(examination.folder / FOLDER / self.name) if examination.device == "cpu" else None
        attacker = SceneAttacker(self, examination, data.scene(self.scene), source, saved_pictures)

        def look(frames: Sequence[SensorFrame]) -> list[U8]:
            images = attacker.look(frames)
            for shown_detector in detectors:
                if source.reason and shown_detector is not source and not shown_detector.reason:
                    shown_detector.reason = f"the attack on {self.source} failed: {source.reason}"
            return images

        # enough pictures at once to fill a batch, of one sample's cameras or of several
        samples_per_call = max(AT_ONCE, math.ceil(self.batch / CAMERAS))
        return Shown(
            look,
            attacker.tally.notes,
            ahead=False,
            at_once=samples_per_call,
            done=saved_pictures.forget if saved_pictures else _nothing,
        )


@dataclass(slots=True)
class SceneAttacker:
    """Attacker of the camera images of a scene, against one detector.

    An image's random numbers come from the seed of the suite and its own token, so the result depends on no other
    image.

    Attributes:
        view: The scene and its attack.
        examination: Data, device, seed.
        scene: The data.
        watched: The attacked system; it stores its own errors.
        saved: Storage of images until the scene is finished; None: no storage.
        attack: The attack with its settings.
        tally: Cost of the attack.
        batch: Images at once; it shrinks if memory does not suffice.
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
        """Return the attacked images of camera frames; the clean ones once the detector has failed.

        Raises:
            FormatError: an image cannot be read.
        """
        images = [self._read(frame) for frame in frames]
        if self.watched.reason or not frames:
            return images
        try:
            if not self.tally.images:
                self._inspect()
                self._fit()
            # A batch is one tensor, so its images must be of one size.
            for image_size in sorted({image.shape[:2] for image in images}):
                rows = [row for row, image in enumerate(images) if image.shape[:2] == image_size]
                for row, attacked_image in zip(
                    rows, self._all([frames[row] for row in rows], [images[row] for row in rows]), strict=True
                ):
                    images[row] = attacked_image
        except Exception as error:  # whatever a stranger's detector raises
            self.watched.failed(error)
        return images

    def _read(self, frame: SensorFrame) -> U8:
        return read_image(self.examination.root / frame.filename)

    def _truth(self, frame: SensorFrame, scene: SceneData | None = None) -> Truth:
        """Return the truth of a frame, with the labels of the attacked detector; other classes are left out.

        If one object is attacked it comes first; a frame without it is empty.
        """
        scene, spec = scene or self.scene, self.view.spec
        visible_annotations = scene.annotations(frame.sample_token)
        if spec.object:
            visible_annotations = chosen_first(scene, frame, spec.object, spec.wanted)
        truth, kept_rows = translate(camera_truth(frame, visible_annotations), MMDET3D_CLASSES, self.watched.classes)
        if spec.object and kept_rows[:1] != (0,):  # the detector does not know the class of the chosen one
            truth = camera_truth(frame, visible_annotations.take(np.arange(0)))
        return truth

    def _all(self, frames: Sequence[SensorFrame], pictures: Sequence[U8]) -> list[U8]:
        """Pictures of one size, in batches; smaller ones from where memory does not suffice."""
        attacked_images: list[U8] = []
        while len(attacked_images) < len(frames):
            batch_slice = slice(len(attacked_images), len(attacked_images) + self.batch)
            try:
                attacked_images += self._some(frames[batch_slice], pictures[batch_slice])
                continue
            except torch.OutOfMemoryError:
                count = len(frames[batch_slice])
                if count == 1:
                    raise
            # Outside of the except block: the traceback would keep the tensors of the failed batch alive.
            self._halve(count)
        return attacked_images

    def _halve(self, count: int) -> None:
        """Halve the number of images at once from now on, which the record states."""
        torch.cuda.empty_cache()
        self.batch = count // 2
        self.tally.halved += 1

    def _some(self, frames: Sequence[SensorFrame], pictures: Sequence[U8]) -> list[U8]:
        """One batch."""
        saved_pictures = self.saved if len(frames) == 1 and self.attack.access != "none" else None
        if saved_pictures and (stored := saved_pictures.read(frames[0].token)):
            self.tally.absorb(stored[1])
            return [stored[0]]
        spec = self.view.spec
        budget = Budget(px(spec.radius), spec.norm)
        images, intrinsics = self._tensors(frames, pictures)
        truth = [self._truth(frame) for frame in frames]
        active = self._attackable(images, intrinsics, truth)
        result_images = list(pictures)
        self.tally.images += len(frames) - len(active)
        self.tally.idle += len(frames) - len(active)
        if not active:
            return result_images
        active_images = images[active]
        attacked = run_attack(
            self.attack,
            self.watched.detector,
            active_images,
            [truth[row] for row in active],
            budget,
            objective=spec.loss,
            aim=spec.aim,
            intrinsic=intrinsics[active],
            check=False,
            precision=spec.precision,
            keys=[(self.examination.seed, frames[row].token) for row in active],
        )
        batch_tally = Tally(self.attack.access)
        batch_tally.add(attacked, active_images, budget)
        self.tally.absorb(batch_tally.notes())
        code_values = (attacked.images * LEVELS).round().to(torch.uint8).permute(0, 2, 3, 1).cpu().numpy()
        for row, attacked_image in zip(active, code_values, strict=True):
            result_images[row] = np.ascontiguousarray(attacked_image)
        if saved_pictures:
            saved_pictures.write(frames[0].token, result_images[0], batch_tally.notes())
        return result_images

    def _tensors(self, frames: Sequence[SensorFrame], pictures: Sequence[U8]) -> tuple[Tensor, Tensor]:
        """Images [B, 3, H, W] and intrinsics [B, 3, 3] on the device."""
        device = self.examination.device
        intrinsics = np.stack([np.asarray(frame.intrinsic, np.float32) for frame in frames])
        return to_images(pictures, device), torch.from_numpy(intrinsics).to(device)

    def _attackable(self, images: Tensor, lens: Tensor, truth: Sequence[Truth]) -> list[int]:
        """Images in which there is something to attack, for this loss: in any batch the same."""
        aim = self.view.spec.aim
        if not make_objective(self.view.spec.loss).needs_objects and aim.everything:
            return list(range(len(images)))
        detector: Any = self.watched.detector
        with steady(detector), torch.no_grad():
            object_places = aim.places(detector, detector.assign(detector.dense(images, lens), truth))
        return [row for row, is_attackable in enumerate(object_places.any(1).tolist()) if is_attackable]

    def _inspect(self) -> None:
        """Check the gradient and the batch before the first attack on a scene.

        The gradient of the loss is compared with finite differences, on the image with most objects to attack; the
        coupling is the change of this image's loss with the rest of its batch. Attacks on the same loss of the
        same system share the results. Images for the report's sheet, without a source, are of attacks that were
        checked.
        """
        if self.watched.task == "3d" and self.watched.classes != MMDET3D_CLASSES:
            raise ConfigError(f"{self.watched.detector.name} finds other classes than the ten of nuScenes")
        frames = _key_frames(self.scene)
        if self.attack.access == "none" or not self.view.source:
            return
        settings, spec = self.examination, self.view.spec
        cache_key = (
            str(settings.root),
            settings.version,
            settings.detectors,
            settings.device,
            self.view.source,
            self.scene.record.name,
            spec.loss,
            spec.classes,
            spec.becomes,
            spec.object,
            self.attack.access,
        )
        if cache_key not in _INSPECTED:
            _INSPECTED[cache_key] = self._inspected(frames)
        self.tally.gradient_error, self.tally.coupling = _INSPECTED[cache_key]

    def _fit(self) -> None:
        """Find the perturbation of a universal attack, on frames of this drive or of others."""
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
                for start in range(0, len(frames), self.batch):
                    batch_frames = frames[start : start + self.batch]
                    truth = [self._truth(frame, scene) for frame in batch_frames]
                    images, intrinsics = self._tensors(batch_frames, [self._read(frame) for frame in batch_frames])
                    objective = make_objective(spec.loss)
                    try:
                        victim = Victim(
                            detector,
                            images,
                            truth,
                            objective,
                            intrinsic=intrinsics,
                            aim=spec.aim,
                            precision=spec.precision,
                        )
                    except NothingToAttackError:
                        continue
                    if self.tally.gradient_error is None:
                        self.tally.gradient_error = check_gradient(victim)
                    victims.append(victim)
        self.attack = fit.fit(victims, budget)
        self.tally.gradients += sum(map(len, victims)) * (fit.steps + 1)

    def _fitted_to(self, fit: UniversalFit) -> list[tuple[list[SensorFrame], SceneData]]:
        """Return frames spread evenly over this drive, or over others of the data set.

        Raises:
            ConfigError: The data set has no other drive.
        """
        scene_name = self.scene.record.name
        if fit.over == "drive":
            return [(_spread(_key_frames(self.scene), fit.frames), self.scene)]
        with NuScenes(self.examination.root, self.examination.version) as dataset:
            names = _spread([record.name for record in dataset.scenes() if record.name != scene_name], fit.frames)
            if not names:
                raise ConfigError(f"universal: there is no drive besides {scene_name}; use over: drive, or more scenes")
            # The shares differ by one at most, and their sum is exact.
            shares = [
                fit.frames * (index + 1) // len(names) - fit.frames * index // len(names) for index in range(len(names))
            ]
            scenes = [dataset.scene(other_name) for other_name in names]
        return [
            (_spread(_key_frames(other_scene), count), other_scene)
            for other_scene, count in zip(scenes, shares, strict=True)
        ]

    def _inspected(self, frames: Sequence[SensorFrame]) -> tuple[float | None, float | None]:
        """Return the error of the gradient and the coupling; None if it cannot be measured."""
        names = self.view.spec.wanted or MMDET3D_CLASSES
        detector_classes = self.watched.classes
        target_labels = torch.tensor([detector_classes.index(name) for name in names if name in detector_classes])
        frames_by_count = sorted(
            frames, key=lambda frame: -int(torch.isin(self._truth(frame).label, target_labels).sum())
        )
        richest_frame = frames_by_count[0]
        same_size_frames = [
            other_frame
            for other_frame in frames_by_count[1:]
            if (other_frame.width, other_frame.height) == (richest_frame.width, richest_frame.height)
        ][:1]
        if not len(self._truth(richest_frame).label):
            return None, None
        checked_frames = [richest_frame, *same_size_frames]
        images, intrinsics = self._tensors(checked_frames, [self._read(frame) for frame in checked_frames])
        truth = [self._truth(frame) for frame in checked_frames]
        if 0 not in self._attackable(images[:1], intrinsics[:1], truth[:1]):
            return None, None
        detector: Any = self.watched.detector
        error = coupling = None
        objective = make_objective(self.view.spec.loss)
        with steady(detector):
            aim = self.view.spec.aim
            single_victim = Victim(detector, images[:1], truth[:1], objective, intrinsic=intrinsics[:1], aim=aim)
            if self.attack.access == "white-box":
                error = check_gradient(single_victim)
            if same_size_frames:
                pair_victim = Victim(detector, images, truth, objective, intrinsic=intrinsics, aim=aim)
                single_loss = float(single_victim.loss(single_victim.clean)[0])
                pair_loss = float(pair_victim.loss(pair_victim.clean)[0])
                coupling = abs(pair_loss - single_loss) / max(abs(single_loss), 1e-6)
        return error, coupling


def _nothing() -> None:
    """Do nothing: no images were saved."""


def _key_frames(scene: SceneData) -> list[SensorFrame]:
    return [frame for frame in scene.frames if frame.modality == "camera" and frame.key_frame]


T = TypeVar("T")


def _spread(values: Sequence[T], count: int) -> list[T]:
    """Return this many of some values, spread evenly; all if there are fewer."""
    selected_count = min(count, len(values))
    return [values[(2 * index + 1) * len(values) // (2 * selected_count)] for index in range(selected_count)]
