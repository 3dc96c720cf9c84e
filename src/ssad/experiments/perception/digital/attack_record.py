"""The record of a system under a digital attack: scores, what the attack took, and what is lost of the clean mAP."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ssad.core.errors import ConfigError
from ssad.core.types import F64
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.truth import GroundTruth
from ssad.detectors.image_scores import match_pictures
from ssad.experiments.perception.digital.attack_scores import Match, by_distance, target_success, worst_of
from ssad.experiments.perception.digital.attack_tally import sum_members
from ssad.experiments.perception.digital.attacked_scenes import AttackSpec
from ssad.experiments.perception.digital.chosen_object import chosen_places
from ssad.experiments.perception.scene_boxes import (
    Condition,
    Examination,
    ShiftedScene,
    find_boxes,
    picture_truth_of,
    read_scenes,
    score_found,
    score_pictures,
    system_of,
    truth_of,
)


def attack_record(
    examination: Examination, system: str, specs: Sequence[AttackSpec], scenes: Sequence[Condition], *, replicates: int
) -> dict[str, Any]:
    """Metrics of a system, and what an attack took of them.

    Args:
        examination: Data, detectors, device.
        system: Whose boxes are scored.
        specs: The attack; of an ensemble its members; none: clean data.
        scenes: Under the attack; of an ensemble those of one member after another. Their boxes are there.
        replicates: Of the bootstrap.

    Raises:
        ConfigError: The attack is about an object that these scenes do not have.
    """
    eye = Eye(examination, system)
    whole = [ShiftedScene(None, 0, one.scene) for one in scenes[: len(scenes) // max(len(specs), 1)]]
    for one in whole:
        find_boxes(examination, one, [system])
    truth = truth_of(examination, [one.scene for one in whole])
    clean, _ = read_scenes(examination, system, whole)
    before = eye.score(clean, truth, replicates=replicates if not specs else 0)
    if not specs:
        return {**before, "metrics": before["metrics"] | eye.by_distance(clean, truth)}
    parts = [scenes[k : k + len(whole)] for k in range(0, len(scenes), len(whole))]
    found, noted = zip(*(read_scenes(examination, system, part) for part in parts), strict=True)
    told: dict[str, Any] = {}
    boxes = found[0]
    if len(specs) > 1:
        candidates = dict(zip((spec.name for spec in specs), found, strict=True))
        told["worst"], boxes = worst_of(candidates, truth, eye.match(truth))
    after = eye.score(boxes, truth, replicates=replicates)
    metrics = after["metrics"] | eye.by_distance(boxes, truth)
    clean_score = before["metrics"]["mAP"]
    metrics["drop"] = round(1.0 - metrics["mAP"] / clean_score, 6) if clean_score > 0 else None
    if not specs[0].aim.everything and not eye.flat:
        places = _places(examination, specs[0], whole)
        metrics |= target_success(clean, boxes, truth, specs[0].wanted, becomes=dict(specs[0].becomes), at=places)
    return {**after, **sum_members(noted), **told, "metrics": metrics, "clean_mAP": clean_score}


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


def _places(examination: Examination, spec: AttackSpec, scenes: Sequence[Condition]) -> dict[str, F64] | None:
    """Where the one object is that is attacked, by sample; None: more than one is. ConfigError: it is nowhere."""
    if not spec.object:
        return None
    with NuScenes(examination.root, examination.version) as data:
        parts = [chosen_places(data.scene(one.scene), spec.object, spec.wanted) for one in scenes]
    found = {token: place for part in parts for token, place in part.items()}
    if not found:
        raise ConfigError(f"object {spec.object}: no moment of these scenes has it; nothing was attacked")
    return found
