"""Record of a system under a digital attack: scores, cost of the attack, and loss of clean mAP."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ssad.core.errors import ConfigError
from ssad.core.types import F64
from ssad.datasets.nuscenes.reader import NuScenes
from ssad.datasets.nuscenes.truth import GroundTruth
from ssad.detectors.image_scores import match_images
from ssad.experiments.perception.digital.attack_scores import Match, by_distance, target_success, worst_of
from ssad.experiments.perception.scene_boxes import (
    Examination,
    SceneCondition,
    find_boxes,
    picture_truth_of,
    read_scenes,
    score_boxes,
    system_of,
    truth_of,
)
from ssad.scenarios.static.digital.chosen_object import chosen_places
from ssad.scenarios.static.digital.spec import AttackSpec
from ssad.scenarios.static.digital.tally import sum_members


def attack_record(
    examination: Examination,
    system: str,
    specs: Sequence[AttackSpec],
    scenes: Sequence[SceneCondition],
    *,
    replicates: int,
) -> dict[str, Any]:
    """Return the metrics of a system under an attack, and the cost and effect of the attack.

    Args:
        examination: Data, detectors, device.
        system: System whose boxes are scored.
        specs: The attack; the members of an ensemble; empty: clean data.
        scenes: Conditions under the attack, those of an ensemble one member after another. Their boxes exist.
        replicates: Replicates of the bootstrap.

    Raises:
        ConfigError: The attack is about an object that these scenes do not have.
    """
    scorer = BoxScorer(examination, system)
    clean_scenes = [SceneCondition(condition.scene) for condition in scenes[: len(scenes) // max(len(specs), 1)]]
    # The clean boxes are a by-product of other cells; missing ones are found now.
    for condition in clean_scenes:
        find_boxes(examination, condition, [system])
    truth = truth_of(examination, [condition.scene for condition in clean_scenes])
    clean_boxes, _ = read_scenes(examination, system, clean_scenes)
    # Under an attack the clean score is only a reference; its intervals stand in the clean record.
    clean_result = score_boxes(examination, system, clean_boxes, truth, replicates=replicates if not specs else 0)
    if not specs:
        return {**clean_result, "metrics": clean_result["metrics"] | scorer.by_distance(clean_boxes, truth)}
    member_scenes = [scenes[start : start + len(clean_scenes)] for start in range(0, len(scenes), len(clean_scenes))]
    member_boxes, member_notes = zip(
        *(read_scenes(examination, system, scene_group) for scene_group in member_scenes), strict=True
    )
    worst_column: dict[str, Any] = {}
    boxes = member_boxes[0]
    if len(specs) > 1:
        candidates = dict(zip((spec.name for spec in specs), member_boxes, strict=True))
        worst_column["worst"], boxes = worst_of(candidates, truth, scorer.match(truth))
    attacked_result = score_boxes(examination, system, boxes, truth, replicates=replicates)
    metrics = attacked_result["metrics"] | scorer.by_distance(boxes, truth)
    clean_score = clean_result["metrics"]["mAP"]
    metrics["drop"] = round(1.0 - metrics["mAP"] / clean_score, 6) if clean_score > 0 else None
    if not specs[0].aim.attacks_all and not scorer.flat:
        places = _places(examination, specs[0], clean_scenes)
        metrics |= target_success(
            clean_boxes, boxes, truth, specs[0].wanted, target_classes=dict(specs[0].becomes), target_positions=places
        )
    return {
        **attacked_result,
        **sum_members(member_notes),
        **worst_column,
        "metrics": metrics,
        "clean_mAP": clean_score,
    }


class BoxScorer:
    """Comparisons of the boxes of a system: in the world for 3D detectors, in the images for 2D detectors.

    Attributes:
        flat: True if the system finds 2D boxes.
    """

    def __init__(self, examination: Examination, system: str) -> None:
        self._examination, self._detector = examination, system_of(examination, system)
        self.flat = self._detector.task == "2d"

    def match(self, truth: GroundTruth) -> Match | None:
        """Return the function by which `worst_of` compares; None: its default."""
        if not self.flat:
            return None
        picture_truth = picture_truth_of(self._examination, truth)
        return lambda boxes: match_images(boxes, picture_truth, self._detector.classes)

    def by_distance(self, boxes: Sequence[Any], truth: GroundTruth) -> dict[str, float]:
        """Return the scores by distance; boxes in images are at no distance."""
        return {} if self.flat else by_distance(boxes, truth)


def _places(examination: Examination, spec: AttackSpec, scenes: Sequence[SceneCondition]) -> dict[str, F64] | None:
    """Return the position of the attacked object by sample; None if more than one is attacked.

    Raises:
        ConfigError: No sample has the object.
    """
    if not spec.object:
        return None
    with NuScenes(examination.root, examination.version) as dataset:
        scene_places = [chosen_places(dataset.scene(condition.scene), spec.object, spec.wanted) for condition in scenes]
    place_by_token = {token: place for places_of_scene in scene_places for token, place in places_of_scene.items()}
    if not place_by_token:
        raise ConfigError(f"object {spec.object}: no moment of these scenes has it; nothing was attacked")
    return place_by_token
