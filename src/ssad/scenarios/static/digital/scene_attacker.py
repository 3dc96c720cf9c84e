"""Attacks on the camera images of a recorded scene, each image by itself, and their cost.

The images are made against one system, the source, and may be shown to others as well: to other detectors
(transfer), or to the same detector behind a defence that the attack does not know.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from ssad.core.detections import Truth, to_images
from ssad.core.errors import ConfigError
from ssad.core.nuscenes_names import MMDET3D_CLASSES
from ssad.core.types import U8
from ssad.datasets.nuscenes.camera_truth import camera_truth
from ssad.datasets.nuscenes.files import read_frame_image
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.scene import SceneData, SensorFrame
from ssad.scenarios.static.digital import Attack, AttackResult, Budget, make_objective, px, run_attack
from ssad.scenarios.static.digital.budget import LEVELS
from ssad.scenarios.static.digital.chosen_object import chosen_first
from ssad.scenarios.static.digital.defences import RandomDefence
from ssad.scenarios.static.digital.expectation import Expected
from ssad.scenarios.static.digital.gradient_check import check_gradient
from ssad.scenarios.static.digital.reference_ensemble import compare_with_references, is_judged
from ssad.scenarios.static.digital.saved_images import SavedImages
from ssad.scenarios.static.digital.spec import AttackSpec
from ssad.scenarios.static.digital.tally import AttackTally
from ssad.scenarios.static.digital.transfer import translate
from ssad.scenarios.static.digital.universal import UniversalFit
from ssad.scenarios.static.digital.victim import NothingToAttackError, Victim, steady
from ssad.scenarios.static.perturbation import RecordedScene, SceneVictim

_INSPECTIONS: dict[tuple[Any, ...], tuple[float | None, float | None]] = {}  # of this process


@dataclass(slots=True)
class SceneAttacker:
    """Attacker of the camera images of a scene, against one detector.

    An image's random numbers come from the seed of the suite and its own token, so the result depends on no other
    image.

    Attributes:
        spec: The attack.
        recorded: The scene, its data set, device and seed.
        watched: The attacked system; it stores its own errors.
        source: Name of the attacked system; "": images for a sheet, whose attack was checked elsewhere.
        saved: Storage of images until the scene is finished; None: no storage.
        reference_images: Number of images of the scene on which the attack is compared with the reference ensemble,
            spread evenly over those with objects under attack.
        attack: The attack with its settings.
        tally: Cost of the attack.
        batch: Images at once; it shrinks if memory does not suffice.
    """

    spec: AttackSpec
    recorded: RecordedScene
    watched: SceneVictim
    source: str = ""
    saved: SavedImages | None = None
    reference_images: int = 0
    attack: Attack = field(init=False)
    tally: AttackTally = field(init=False)
    batch: int = field(init=False)
    _reference_tokens: frozenset[str] | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        self.attack = self.spec.make()
        self.attack = self._with_draws(self.attack)
        self.tally = AttackTally(self.attack.access)
        self.batch = 1 if self.recorded.device == "cpu" else self.recorded.batch

    def _with_draws(self, attack: Attack) -> Attack:
        """Return the attack, made to know the random defence of the detector if the spec says so."""
        defence = getattr(self.watched.detector, "defence", None)
        if self.spec.draws and isinstance(defence, RandomDefence):
            return Expected(attack, defence, self.spec.draws)
        return attack

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
                    rows, self._attack_all([frames[row] for row in rows], [images[row] for row in rows]), strict=True
                ):
                    images[row] = attacked_image
        except Exception as error:  # whatever a stranger's detector raises
            self.watched.failed(error)
        return images

    def _read(self, frame: SensorFrame) -> U8:
        return read_frame_image(self.recorded.root, frame)

    def _truth(self, frame: SensorFrame, scene: SceneData | None = None) -> Truth:
        """Return the truth of a frame, with the labels of the attacked detector; other classes are left out.

        If one object is attacked it comes first; a frame without it is empty.
        """
        scene, spec = scene or self.recorded.data, self.spec
        visible_annotations = scene.annotations(frame.sample_token)
        if spec.object:
            visible_annotations = chosen_first(scene, frame, spec.object, spec.wanted)
        truth, kept_rows = translate(camera_truth(frame, visible_annotations), MMDET3D_CLASSES, self.watched.classes)
        if spec.object and kept_rows[:1] != (0,):  # the detector does not know the class of the chosen one
            truth = camera_truth(frame, visible_annotations.take(np.arange(0)))
        return truth

    def _attack_all(self, frames: Sequence[SensorFrame], images: Sequence[U8]) -> list[U8]:
        """Attack images of one size in batches, in smaller ones once memory does not suffice."""
        attacked_images: list[U8] = []
        while len(attacked_images) < len(frames):
            batch_slice = slice(len(attacked_images), len(attacked_images) + self.batch)
            try:
                attacked_images += self._attack_batch(frames[batch_slice], images[batch_slice])
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

    def _attack_batch(self, frames: Sequence[SensorFrame], clean_images: Sequence[U8]) -> list[U8]:
        """Attack one batch."""
        saved_images = self.saved if len(frames) == 1 and self.attack.access != "none" else None
        if saved_images and (stored := saved_images.read(frames[0].token)):
            self.tally.absorb(stored[1])
            return [stored[0]]
        spec = self.spec
        budget = Budget(px(spec.radius), spec.norm)
        images, intrinsics = self._tensors(frames, clean_images)
        truth = [self._truth(frame) for frame in frames]
        active = self._attackable(images, intrinsics, truth)
        result_images = list(clean_images)
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
            keys=[(self.recorded.seed, frames[row].token) for row in active],
        )
        batch_tally = AttackTally(self.attack.access)
        batch_tally.add(attacked, active_images, budget)
        batch_tally.references = self._compare(
            [frames[row] for row in active], attacked, active_images, intrinsics[active]
        )
        self.tally.absorb(batch_tally.notes())
        code_values = (attacked.images * LEVELS).round().to(torch.uint8).permute(0, 2, 3, 1).cpu().numpy()
        for row, attacked_image in zip(active, code_values, strict=True):
            result_images[row] = np.ascontiguousarray(attacked_image)
        if saved_images:
            saved_images.write(frames[0].token, result_images[0], batch_tally.notes())
        return result_images

    def _compare(
        self, frames: Sequence[SensorFrame], attacked: AttackResult, images: Tensor, intrinsics: Tensor
    ) -> list[dict[str, Any]]:
        """Compare the attack with the reference ensemble on those of its images that were chosen for it."""
        rows = [row for row, frame in enumerate(frames) if frame.token in self._tokens_to_compare()]
        if not rows or not is_judged(self.spec.make()):
            return []
        spec, recording = self.spec, self.recorded
        gradients = max(attacked.cost.gradients, spec.steps * max(spec.draws, 1)) // max(spec.draws, 1)
        comparisons = compare_with_references(
            attacked.rows(rows),
            self.watched.detector,
            images[rows],
            [self._truth(frames[row]) for row in rows],
            Budget(px(spec.radius), spec.norm),
            objective=spec.loss,
            keys=[(recording.seed, frames[row].token) for row in rows],
            intrinsic=intrinsics[rows],
            aim=spec.aim,
            precision=spec.precision,
            gradients=gradients,
            with_draws=self._with_draws,
            cache_key=(
                str(recording.root),
                recording.version,
                recording.inputs,
                recording.device,
                self.source,
                spec.classes,
                spec.becomes,
                spec.object,
                spec.draws,
            ),
        )
        return [
            {"token": frames[row].token, "attack": spec.name, **comparison}
            for row, comparison in zip(rows, comparisons, strict=True)
        ]

    def _tokens_to_compare(self) -> frozenset[str]:
        """Return the tokens of the images on which the attack is compared with the reference ensemble."""
        if self._reference_tokens is None:
            frames = _key_frames(self.recorded.data) if self.reference_images else []
            candidates = [frame for frame in frames if len(self._truth(frame).label)]
            chosen = _spread_evenly(candidates, self.reference_images) if candidates else []
            self._reference_tokens = frozenset(frame.token for frame in chosen)
        return self._reference_tokens

    def _tensors(self, frames: Sequence[SensorFrame], images: Sequence[U8]) -> tuple[Tensor, Tensor]:
        """Return images [B, 3, H, W] and intrinsics [B, 3, 3] on the device."""
        device = self.recorded.device
        intrinsics = np.stack([np.asarray(frame.intrinsic, np.float32) for frame in frames])
        return to_images(images, device), torch.from_numpy(intrinsics).to(device)

    def _attackable(self, images: Tensor, intrinsics: Tensor, truth: Sequence[Truth]) -> list[int]:
        """Return the images with something to attack for this loss; the same in any batch."""
        aim = self.spec.aim
        if not make_objective(self.spec.loss).needs_objects and aim.attacks_all:
            return list(range(len(images)))
        detector: Any = self.watched.detector
        with steady(detector), torch.no_grad():
            object_places = aim.places(detector, detector.assign(detector.dense(images, intrinsics), truth))
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
        frames = _key_frames(self.recorded.data)
        if self.attack.access == "none" or not self.source:
            return
        recording, spec = self.recorded, self.spec
        cache_key = (
            str(recording.root),
            recording.version,
            recording.inputs,
            recording.device,
            self.source,
            self.recorded.data.record.name,
            spec.loss,
            spec.classes,
            spec.becomes,
            spec.object,
            self.attack.access,
        )
        if cache_key not in _INSPECTIONS:
            _INSPECTIONS[cache_key] = self._measure_checks(frames)
        self.tally.gradient_error, self.tally.coupling = _INSPECTIONS[cache_key]

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
        spec = self.spec
        detector, budget = self.watched.detector, Budget(px(spec.radius), spec.norm)
        victims = []
        with steady(detector):
            for frames, scene in self._frames_to_fit(fit):
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

    def _frames_to_fit(self, fit: UniversalFit) -> list[tuple[list[SensorFrame], SceneData]]:
        """Return frames spread evenly over this drive, or over others of the data set.

        Raises:
            ConfigError: The data set has no other drive.
        """
        scene_name = self.recorded.data.record.name
        if fit.over == "drive":
            return [(_spread_evenly(_key_frames(self.recorded.data), fit.frames), self.recorded.data)]
        with NuScenes(self.recorded.root, self.recorded.version) as dataset:
            names = _spread_evenly(
                [record.name for record in dataset.scenes() if record.name != scene_name], fit.frames
            )
            if not names:
                raise ConfigError(f"universal: there is no drive besides {scene_name}; use over: drive, or more scenes")
            # The shares differ by one at most, and their sum is exact.
            shares = [
                fit.frames * (index + 1) // len(names) - fit.frames * index // len(names) for index in range(len(names))
            ]
            scenes = [dataset.scene(other_name) for other_name in names]
        return [
            (_spread_evenly(_key_frames(other_scene), count), other_scene)
            for other_scene, count in zip(scenes, shares, strict=True)
        ]

    def _measure_checks(self, frames: Sequence[SensorFrame]) -> tuple[float | None, float | None]:
        """Return the error of the gradient and the coupling; None if it cannot be measured."""
        names = self.spec.wanted or MMDET3D_CLASSES
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
        objective = make_objective(self.spec.loss)
        with steady(detector):
            aim = self.spec.aim
            single_victim = Victim(detector, images[:1], truth[:1], objective, intrinsic=intrinsics[:1], aim=aim)
            if self.attack.access == "white-box":
                error = check_gradient(single_victim)
            if same_size_frames:
                pair_victim = Victim(detector, images, truth, objective, intrinsic=intrinsics, aim=aim)
                single_loss = float(single_victim.loss(single_victim.clean)[0])
                pair_loss = float(pair_victim.loss(pair_victim.clean)[0])
                coupling = abs(pair_loss - single_loss) / max(abs(single_loss), 1e-6)
        return error, coupling


def _key_frames(scene: SceneData) -> list[SensorFrame]:
    return [frame for frame in scene.frames if frame.modality == "camera" and frame.key_frame]


T = TypeVar("T")


def _spread_evenly(values: Sequence[T], count: int) -> list[T]:
    """Return this many of some values, spread evenly; all if there are fewer."""
    selected_count = min(count, len(values))
    return [values[(2 * index + 1) * len(values) // (2 * selected_count)] for index in range(selected_count)]
